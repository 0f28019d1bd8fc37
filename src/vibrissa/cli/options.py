"""Options and arguments of the command line, each defined once for all verbs.

Lengths are in mm, forces in µN, moments in µN·m and angles in degrees, unless the help of an option
states another unit. The options of a verb are the parameters of its function, whose types define
the possible values. `options.csv` describes them, one row per option, with further rows for verbs
in which an option differs: `track|import.whisker`.
"""

from __future__ import annotations

import csv
import inspect
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import StrEnum
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, cast, get_type_hints

import typer

import vibrissa as vb

_NAMED = 3  # number of files named in one message


class Option(NamedTuple):
    """Description of an option.

    By default it has the name of the parameter and, for a switch that is on by default, also the
    name of the opposite; an argument has no names.
    """

    help: str
    metavar: str | None = None
    names: str | None = None
    least: float | None = None


def _options() -> dict[tuple[str, str], Option]:
    """Read the table next to this module."""
    rows = csv.DictReader(Path(__file__).with_suffix(".csv").read_text("utf-8").splitlines())
    found: dict[tuple[str, str], Option] = {}
    for row in rows:
        verbs, _, name = row["name"].rpartition(".")
        least = json.loads(row["least"] or "null")
        about = Option(row["help"], row["metavar"] or None, row["names"] or None, least)
        found |= {(verb, name): about for verb in verbs.split("|")}
    return found


OPTIONS = _options()  # options by verb ("" for all others) and name of the parameter
Source = Literal["contact-point", "rod", "sensor"]
Method = Literal["exact", "lookup", "lookup-linear", "network"]


class Region(StrEnum):
    """Named regions of contacts."""

    ALL = "all"
    ELD = "ELD"
    CF = "CF"
    CB = "CB"
    ELD_CF = "ELD CF"
    ELD_CB = "ELD CB"


class Format(StrEnum):
    """Formats of figures."""

    PNG = "png"
    PDF = "pdf"
    SVG = "svg"


Verb = TypeVar("Verb", bound=Callable[..., None])


def with_options(output: str = "") -> Callable[[Verb], Verb]:
    """Decorator that declares the parameters of a verb, and fields of data classes, as options.

    ``output`` describes the output that the verb writes to its parameter ``target``.
    """

    def decorated(verb: Verb) -> Verb:
        hints = get_type_hints(verb, include_extras=True)
        given = inspect.signature(verb).parameters.values()
        # Modules are named after their verbs.
        kind = verb.__module__.rpartition(".")[2].rstrip("_")
        flat = _flat({one.name: (hints[one.name], one.default) for one in given}, kind, output)

        @wraps(verb)
        def called(**values: Any) -> None:
            _spare_inputs(values)
            verb(**_filled({one.name: hints[one.name] for one in given}, values))

        called.__annotations__ = {one.name: one.annotation for one in flat}
        called.__signature__ = inspect.Signature(flat)  # type: ignore[attr-defined]
        return cast(Verb, called)

    return decorated


def _flat(kinds: Mapping[str, tuple[Any, Any]], verb: str, output: str) -> list[inspect.Parameter]:
    """Parameters of a verb, with data classes replaced by their fields."""
    found = []
    for name, (kind, default) in kinds.items():
        if is_dataclass(kind):
            hints = get_type_hints(kind, include_extras=True)
            inside = {one.name: (hints[one.name], one.default) for one in fields(kind)}
            found += _flat(inside, verb, output)
            continue
        default = inspect.Parameter.empty if default is MISSING else default
        declared = _declared(name, default, verb, output)
        annotation = Annotated[kind, declared]  # type: ignore[valid-type]
        # Keyword-only parameters without a default may follow those with one.
        how = inspect.Parameter.KEYWORD_ONLY
        found.append(inspect.Parameter(name, how, default=default, annotation=annotation))
    return found


def _declared(name: str, default: Any, verb: str, output: str) -> Any:
    """Declare an option, or an argument, to Typer."""
    if name == "target":
        text = f"Where the result goes: {output}."
        return typer.Option("--output", "-o", help=text, metavar="PATH")
    plain = name.rstrip("_")
    about = OPTIONS.get((verb, plain)) or OPTIONS["", plain]
    if about.names == "argument":
        return typer.Argument(help=about.help, metavar=about.metavar)
    names = f"--{plain.replace('_', '-')}"
    if default is True:
        names += names.replace("--", "/--no-", 1)
    return typer.Option(
        about.names or names, help=about.help, metavar=about.metavar, min=about.least
    )


def _filled(kinds: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of a verb, with data classes constructed from their fields."""
    found = {}
    for name, kind in kinds.items():
        if is_dataclass(kind):
            found[name] = cast(type, kind)(**_filled(get_type_hints(kind), values))
        else:
            found[name] = values[name]
    return found


def numbers(text: str, names: Sequence[str], option: str) -> list[float]:
    """Parse numbers separated by commas."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != len(names) or not all(map(math.isfinite, values)):
        raise ValueError(f"{option} is {text!r}; {','.join(names)} are needed")
    return values


# Options that name files to write, and arguments to which some verbs add a stage.
_WRITTEN, _EXTENDED = ("target", "csv", "events"), ("recording", "signals")


def _spare_inputs(values: Mapping[str, Any]) -> None:
    """Raise ValueError if a result would replace a file that is read, also with --force."""
    for name in _WRITTEN:
        if (path := values.get(name)) is None:
            continue
        read = {
            other: [one for one in _listed(value) if isinstance(one, Path)]
            for other, value in values.items()
            if other not in _WRITTEN
        }
        added = name == "target" and vb.io.is_netcdf(path)
        if not (added and any(same_file(path, *read.get(other, ())) for other in _EXTENDED)):
            spare(path, *(one for files in read.values() for one in files))


def _listed(value: Any) -> Sequence[Any]:
    """The value if it is a list, else a list with it."""
    return value if isinstance(value, list | tuple) else [value]


def same_file(path: Path, *others: Path) -> bool:
    """Whether a path leads to one of some other files."""
    return path.is_file() and any(one.is_file() and path.samefile(one) for one in others)


def spare(path: Path, *read: Path) -> None:
    """Raise ValueError if a result would replace one of the files that are read."""
    if same_file(path, *read):
        raise ValueError(f"{path} is read, and would be replaced by the result: state another file")


def free(files: Iterable[Path], force: bool) -> None:
    """Raise FileExistsError if files exist and must not be replaced."""
    if there := [str(file) for file in files if not force and file.exists()]:
        more = f" and {len(there) - _NAMED} more" if len(there) > _NAMED else ""
        are = "is" if len(there) == 1 else "are"
        raise FileExistsError(
            f"{', '.join(there[:_NAMED])}{more} {are} there already: write elsewhere with "
            "--output, or replace with --force"
        )


def check_new(path: Path, endings: Sequence[str], force: bool) -> None:
    """Raise an error if a file cannot be written, or exists and must not be replaced."""
    vb.io.check_writable(path, endings)
    free([path], force)


def refuse(options: Mapping[str, object], reason: str) -> None:
    """Raise ValueError if options are given that would have no effect."""
    given = [  # zero counts as given
        n for n, v in options.items() if v is not None and v is not False and v not in ([], ())
    ]
    if given:
        raise ValueError(f"{', '.join(given)} cannot be used: {reason}")
