"""Consoles, tables, progress bars and signals; numbers in display units."""

from __future__ import annotations

import codecs
import io
import re
import signal
import sys
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from textwrap import fill
from typing import Any, TextIO

from rich.console import Console
from rich.text import Text

from vibrissa.quantities import quantity
from vibrissa.sketch import progress

# Console for results, without markup, as names of files and whiskers may contain brackets.
output = Console(markup=False, emoji=False)
# Console for progress and messages, so that results can be piped.
errors = Console(stderr=True, markup=False, emoji=False)
_LATER = 0.01  # time after which an interrupt that was lost is repeated, s
# Function called with the current stage, the steps done and the total steps.
Tell = Callable[[str, int, int], None]


def spell_out() -> None:
    """Print what a stream's encoding lacks in other characters, as where Windows pipes output."""
    codecs.register_error("spelt", _spelt)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="spelt")


def _spelt(fault: UnicodeError) -> tuple[str | bytes, int]:
    """Replace one character: a unit must not become ambiguous, and frames remain frames."""
    assert isinstance(fault, UnicodeEncodeError)
    character = fault.object[fault.start]
    frame = "─" <= character <= "╿"
    other = "u" if character == "µ" else "-" if frame else f"\\u{ord(character):04x}"
    return other, fault.start + 1


def say(line: str = "") -> None:
    """Print a line of the results."""
    _print(output, line)


def remark(line: str) -> None:
    """Print a remark that is not a result, such as an assumption or a default."""
    _print(errors, line)


def remark_once(lines: Iterable[str]) -> None:
    """Print notes of several whiskers; those that differ only in numbers once, with a count."""
    alike: dict[str, list[str]] = {}
    for line in lines:
        alike.setdefault(_without_numbers(line), []).append(line)
    for first, *others in alike.values():
        remark(f"note: {first}" + f" ({len(others)} more like this)" * bool(others))


@contextmanager
def warnings_as_notes() -> Iterator[None]:
    """Context that prints warnings as notes, those that differ only in numbers once."""
    usual, counts = warnings.showwarning, Counter[str]()
    first: dict[str, str] = {}

    def note(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if category is not UserWarning:
            usual(message, category, filename, lineno, file, line)
            return
        text = str(message)
        kind = _without_numbers(text)
        counts[kind] += 1
        if kind not in first:
            first[kind] = text
            remark(f"note: {text}")

    warnings.showwarning = note
    try:
        yield
    finally:
        warnings.showwarning = usual
        for kind, count in counts.items():
            if count > 1:
                remark(f"note: {count - 1} more like this: {first[kind]}")


def _without_numbers(text: str) -> str:
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", text)


def _print(console: Console, line: str) -> None:
    """Print a line, in a terminal broken between words so that paths remain whole."""
    if console.is_terminal and len(line) > console.width:
        indent = " " * (len(line) - len(line.lstrip()))
        line = fill(
            line,
            console.width,
            subsequent_indent=indent,
            break_long_words=False,
            break_on_hyphens=False,
        )
    console.print(line, highlight=False, soft_wrap=True)


def progress_bars() -> AbstractContextManager[Tell]:
    """Context that shows a progress bar for each reported stage."""
    return progress(errors)


@contextmanager
def stoppable() -> Iterator[Callable[[], bool]]:
    """Context in which Ctrl-C requests a stop, and a second Ctrl-C stops immediately."""
    asked = False

    def ask(number: int, frame: object) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    # Only the main thread can handle Ctrl-C.
    before = None
    if threading.current_thread() is threading.main_thread():
        before = signal.signal(signal.SIGINT, ask)
    try:
        yield lambda: asked
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)


def repeat_lost_interrupts() -> None:
    """Raise KeyboardInterrupt again where Python only prints it.

    In callbacks, as those of the compiler or at the end of an import, Python ignores exceptions, so
    that Ctrl-C would have no effect.
    """
    if not hasattr(signal, "pthread_kill"):  # Windows
        return
    usual = sys.unraisablehook

    def hook(lost: sys.UnraisableHookArgs) -> None:
        error = lost.exc_value
        if not isinstance(error, KeyboardInterrupt):
            usual(lost)
            return

        def again(number: int, frame: object) -> None:
            signal.signal(number, before)
            raise error

        before = signal.signal(signal.SIGINT, again)
        # Later, as an exception raised here would be ignored too; as a signal, which ends waiting.
        main = threading.main_thread().ident
        threading.Timer(_LATER, signal.pthread_kill, (main, signal.SIGINT)).start()

    sys.unraisablehook = hook


# Signals that do not end a process by default, cannot be handled, or are faults of the process.
_LEFT_ALONE = (
    *("SIGKILL", "SIGSTOP", "SIGCHLD", "SIGURG", "SIGWINCH", "SIGCONT", "SIGTSTP", "SIGTTIN"),
    *("SIGTTOU", "SIGINFO", "SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL", "SIGTRAP", "SIGSYS"),
)


class Ended(KeyboardInterrupt):
    """Raised at a signal that ends the process."""


@contextmanager
def ending_in_order() -> Iterator[None]:
    """Raise `Ended` at a signal that would end the process, unless it is ignored or handled."""
    taken: dict[int, Any] = {}

    def end(number: int, frame: object) -> None:
        for each in taken:
            signal.signal(each, signal.SIG_IGN)
        raise Ended(signal.strsignal(number) or f"signal {number}")

    # Only the main thread can handle signals.
    if threading.current_thread() is threading.main_thread():
        ending = (signal.SIG_DFL, signal.default_int_handler)
        left = {getattr(signal, name, None) for name in _LEFT_ALONE}
        for number in signal.valid_signals() - left:
            if signal.getsignal(number) in ending:
                taken[number] = signal.signal(number, end)
    try:
        yield
    finally:
        for each, before in taken.items():
            signal.signal(each, before)


def shown(name: str, value: float, digits: int = 4) -> str:
    """Format an SI value in its display unit."""
    return _with_unit(f"{value * quantity(name).display_factor:.{digits}g}", name)


def fixed(name: str, value: float, decimals: int = 4) -> str:
    """Format an SI value in its display unit, with a fixed number of decimals."""
    return _with_unit(f"{value * quantity(name).display_factor:z.{decimals}f}", name)


def _with_unit(number: str, name: str) -> str:
    unit = quantity(name).display_unit
    return f"{number}{'' if unit in ('', '°') else ' '}{unit}"


Row = Sequence[str | Text]  # the cells of a row


def print_table(
    columns: Sequence[str],
    rows: Iterable[Row | None],
    title: str | None = None,
    caption: str | None = None,
    *,
    left: Sequence[int] = (0,),
) -> None:
    """Print rows of cells; ``None`` stands for a line between two sections.

    Columns with an index in ``left`` are text, aligned left; the others are numbers, aligned right.
    Without names of columns there is no header.
    """
    from rich.table import Table

    # Title and caption may be wider than the table.
    if title:
        output.print(Text(title, style="table.title"))
    table = Table(show_header=any(columns))
    for number, name in enumerate(columns):
        table.add_column(name, justify="left" if number in left else "right")
    for row in rows:
        if row is None:
            table.add_section()
        else:
            table.add_row(*row)
    output.print(table)
    if caption:
        output.print(Text(caption, style="table.caption"))


def print_properties(rows: Iterable[tuple[str, str]]) -> None:
    """Print names and values; the value of ``next`` is a command that can be copied."""
    from rich.table import Table

    table = Table(show_header=False, box=None)
    table.add_column()
    table.add_column(overflow="fold")
    commands = []
    for name, value in rows:
        if name == "next":
            commands.append(value)
        else:
            table.add_row(Text(name, style="bold"), Text(value))
    output.print(table, highlight=False)
    for command in commands:
        # The command is not wrapped, whatever the width of the terminal.
        output.print(Text.assemble((" next: ", "bold"), command), soft_wrap=True)
