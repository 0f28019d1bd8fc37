"""Consoles, tables, progress bars and signals; numbers in display units."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from textwrap import fill
from typing import Any

from rich.console import Console
from rich.text import Text

from vibrissa.quantities import quantity
from vibrissa.sketch import progress

# Console for results, written as they are: names of files and whiskers may have brackets.
output = Console(markup=False, emoji=False)
# Console for progress and messages, so that results can be piped.
errors = Console(stderr=True, markup=False, emoji=False)
# Called with what is being done, and how much of how much is.
Tell = Callable[[str, int, int], None]


def say(line: str = "") -> None:
    """Print a line of the results."""
    _print(output, line)


def remark(line: str) -> None:
    """Print a line that is not a result: what is assumed, or done by default."""
    _print(errors, line)


def _print(console: Console, line: str) -> None:
    """Print a line as it is, but in a terminal broken between words, which leaves paths whole."""
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
    """Show a bar for each stage that is reported."""
    return progress(errors)


@contextmanager
def stoppable() -> Iterator[Callable[[], bool]]:
    """Take Ctrl-C as the wish to stop soon; a second one stops at once."""
    asked = False

    def ask(number: int, frame: object) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    # Elsewhere than in the main thread there is no Ctrl-C to take.
    before = None
    if threading.current_thread() is threading.main_thread():
        before = signal.signal(signal.SIGINT, ask)
    try:
        yield lambda: asked
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)


# What does not end a process by itself, cannot be taken, or is a fault of the process.
_LEFT_ALONE = (
    *("SIGKILL", "SIGSTOP", "SIGCHLD", "SIGURG", "SIGWINCH", "SIGCONT", "SIGTSTP", "SIGTTIN"),
    *("SIGTTOU", "SIGINFO", "SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL", "SIGTRAP", "SIGSYS"),
)


class Ended(KeyboardInterrupt):
    """A signal asked the process to end."""


@contextmanager
def ending_in_order() -> Iterator[None]:
    """Raise `Ended` at a signal that would end the process; while that is done others wait.

    Signals that are ignored (``nohup``) or handled otherwise are left as they are.
    """
    taken: dict[int, Any] = {}

    def end(number: int, frame: object) -> None:
        for each in taken:
            signal.signal(each, signal.SIG_IGN)
        raise Ended(signal.strsignal(number) or f"signal {number}")

    # Elsewhere than in the main thread no signal can be taken.
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
    """Write an SI value with the unit in which it is shown."""
    return _with_unit(f"{value * quantity(name).display_factor:.{digits}g}", name)


def fixed(name: str, value: float, decimals: int = 4) -> str:
    """Write an SI value with the unit in which it is shown, to so many decimals there."""
    # Adding zero turns −0 into 0.
    number = round(value * quantity(name).display_factor, decimals) + 0.0
    return _with_unit(f"{number:.{decimals}f}", name)


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
    """Print rows of cells; ``None`` is a line between two sections.

    The columns numbered in ``left`` are text, the others numbers, which are aligned at the right.
    Without names of columns there is no head.
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
    """Print names and values, without lines between them; ``next`` is a command to be copied."""
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
        # On one line, whatever the width of the terminal.
        output.print(Text.assemble((" next: ", "bold"), command), soft_wrap=True)
