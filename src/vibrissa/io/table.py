"""Text files: tables with names and units of columns, and settings (TOML).

**Tables** are read as spreadsheets and loggers write them: cells are separated by commas,
semicolons, tabs or blanks, whichever is most frequent in the first line; unless it is the comma,
numbers may have a decimal comma.

**Columns** may be named in various ways: a force along x as ``Fx``, ``fx``, ``Force X`` or
``wrench.force.x``, a moment as ``Mx``, ``Tx`` or ``torque_x``, followed by an optional unit:
``Fx_mN``, ``Fx (mN)``, ``Fx [mN]``, ``Fx/mN``. The default is the SI unit.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import product
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.io.paths import check_readable, refuse_whisk, replacing

_MISSING = frozenset({"", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--"})
_COMMA = re.compile(r"[+-]?(?:\d+,\d*|,\d+)(?:[eE][+-]?\d+)?")
_STATED = re.compile(r"sep=([,;\t])", re.IGNORECASE)
# Bytes of text in Latin-1, as written by spreadsheets with µ, ° and umlauts.
_SPREADSHEET = re.compile(rb"[\t\n\r\x20-\x7e\xa0-\xff]*")


def read_text(path: str | PathLike[str]) -> str:
    """Read a text file."""
    path = check_readable(path)
    refuse_whisk(path)
    content = path.read_bytes()
    utf16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if utf16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        if not _SPREADSHEET.fullmatch(content):
            at = error.start
            raise ValueError(
                f"{path} is not a text table in UTF-8: byte {at} is {content[at]:#04x}"
            ) from None
        text = content.decode("cp1252")
    if "\0" in text:
        raise ValueError(f"{path} is not a text table: byte {content.find(0)} is zero")
    return text


def table_rows(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and cells of each row of a table."""
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if lines and (stated := _STATED.fullmatch(lines[0][1].strip())):
        delimiter = stated[1]
        del lines[0]
    else:
        delimiter = delimiter_of(lines[0][1]) if lines else ","
    rows = [cells_of(line, delimiter) for _, line in lines]
    if delimiter != "," and not any("." in cell and is_number(cell) for r in rows for cell in r):
        rows = [[with_point(cell) for cell in row] for row in rows]
    # Spreadsheets also write columns to the right that are empty in every row.
    filled = max((i for row in rows for i, cell in enumerate(row, start=1) if cell), default=0)
    for (line, _), row in zip(lines, rows, strict=True):
        if any(row):
            yield line, row[:filled]


def delimiter_of(header: str) -> str:
    """Delimiter of the cells of a table, from its header."""
    most = max(",;\t", key=header.count)
    return most if header.count(most) or len(header.split()) < 2 else " "


def cells_of(line: str, delimiter: str) -> list[str]:
    """Split a line of a table into cells."""
    if delimiter == " ":
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter))]


def with_point(cell: str) -> str:
    """Replace the decimal comma of a number by a point; other text is unchanged."""
    return cell.replace(",", ".") if _COMMA.fullmatch(cell) else cell


def is_number(cell: str) -> bool:
    """Whether a cell is a number."""
    try:
        number(cell)
    except ValueError:
        return False
    return True


def number(cell: str) -> float:
    """Convert a cell to a number."""
    return float("nan") if cell.lower() in _MISSING else float(cell)


def read_rows(
    path: str | PathLike[str],
    rows: Iterator[tuple[int, list[str]]],
    width: int,
    columns: Sequence[int],
) -> NDArray[np.float64]:
    """Read some columns of numbers."""
    values, faults, commas = [], [], False
    for line, cells in rows:
        try:
            values.append([number(cells[column]) for column in columns])
            wrong = any(cells[width:])
        except (ValueError, IndexError):
            wrong = True
        if wrong:
            faults.append(f"line {line} reads {', '.join(cells)!r}")
            commas |= len(cells) > width or any(_COMMA.fullmatch(cell) for cell in cells)
    if faults:
        advice = "; decimal commas need semicolons or tabs between cells, and no points elsewhere"
        raise ValueError(
            f"{path} has cells that are not numbers, or rows without {width} cells: "
            f"{few_faults(faults)}{advice if commas else ''}"
        )
    return np.array(values, dtype=np.float64).reshape(-1, len(columns))


class Table:
    """A table with one header line; errors name the file and the lines."""

    def __init__(self, path: str | PathLike[str], expected: Sequence[str] = ()) -> None:
        self.path = Path(path)
        rows = list(table_rows(read_text(path)))
        self.names = rows[0][1] if rows else []
        self.lines = [line for line, _ in rows[1:]]
        self.rows = [cells for _, cells in rows[1:]]
        if not rows or (expected and tuple(self.names) != tuple(expected)):
            got = f"has the columns {', '.join(self.names)}" if rows else "is empty"
            needed = f"; {', '.join(expected)} are needed" if expected else ""
            raise ValueError(f"{path} {got}{needed}")
        if len(set(self.names)) != len(self.names):
            raise ValueError(f"{path} has two columns of the same name: {', '.join(self.names)}")
        if not self.rows and not expected:
            raise ValueError(f"{path} has a header but no rows")
        faults = [
            f"line {line} has {len(cells)} cells"
            for line, cells in zip(self.lines, self.rows, strict=True)
            if len(cells) != len(self.names)
        ]
        if faults:
            raise ValueError(
                f"{path} has {len(self.names)} columns, but {few_faults(faults)}; the file may be "
                "cut short"
            )

    def text(self, name: str) -> list[str]:
        """Cells of a column as text."""
        at = self.names.index(name)
        return [cells[at] for cells in self.rows]

    def numbers(self, name: str, *, labels: bool = False) -> NDArray[np.float64]:
        """Numbers of a column, NaN if missing or, if ``labels`` are allowed, not numbers."""
        values, faults = np.full(len(self.rows), np.nan), []
        for i, cell in enumerate(self.text(name)):
            try:
                values[i] = number(cell)
            except ValueError:
                faults.append(f"line {self.lines[i]} reads {cell!r}")
        if faults and not (labels and np.isnan(values).all()):
            raise ValueError(
                f"{self.path}: column {name} has cells that are not numbers: {few_faults(faults)}"
            )
        return values

    def refuse(self, wrong: NDArray[np.bool_], what: str) -> None:
        """Raise ValueError if any row is wrong, quoting the first of them."""
        for i in np.flatnonzero(wrong):
            cells = ",".join(self.rows[i])
            raise ValueError(f"{self.path}: line {self.lines[i]} reads {cells!r}, which is {what}")


def read_numbers(path: str | PathLike[str]) -> tuple[list[str], NDArray[np.float64]]:
    """Read a table of numbers with one header line; return names and values."""
    table = Table(path)
    columns = [table.numbers(name, labels=True) for name in table.names]
    return table.names, np.stack(columns, axis=1)


def table_text(
    header: Sequence[str], rows: Iterable[Sequence[object]], quoted: bool = False
) -> str:
    """Format a table as text with full precision; ``quoted`` puts words in quotation marks."""
    out = io.StringIO()
    writer = csv.writer(
        out, lineterminator="\n", quoting=csv.QUOTE_NONNUMERIC if quoted else csv.QUOTE_MINIMAL
    )
    writer.writerow(header)
    writer.writerows(rows)
    return out.getvalue()


def write_table(
    path: str | PathLike[str], header: Sequence[str], rows: Iterable[Sequence[object]]
) -> None:
    """Write a table as CSV."""
    text = table_text(header, rows)
    with replacing(path) as part:
        part.write_bytes(text.encode("utf-8"))


def few_faults(faults: Sequence[str]) -> str:
    """Join the first five faults, and count the others."""
    more = "" if len(faults) <= 5 else f"; and {len(faults) - 5} more lines"
    return "; ".join(faults[:5]) + more


# Factors of unit prefixes; µ is written u.
_SMALLER = {"": 1.0, "m": 1e-3, "u": 1e-6, "n": 1e-9}
LENGTHS: Mapping[str, float] = MappingProxyType({"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6})
_UNITS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "time": {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
        "length": LENGTHS,
        "force": {f"{p}N": factor for p, factor in _SMALLER.items()},
        "moment": {
            f"{p}N{unit}": factor * LENGTHS[unit]
            for (p, factor), unit in product(_SMALLER.items(), ("m", "cm", "mm"))
        },
        "angle": {"rad": 1.0, "deg": 0.017453292519943295, "°": 0.017453292519943295},
    }
)
_KINDS = {"t": "time", "F": "force", "M": "moment", "T": "force", "B": "moment", "D": "angle"}

_COMPONENT = re.compile(
    r"(?:.*[./])?(force|moment|torque|[FMT])[ _.]?([xyz])(?![a-z0-9])(.*)", re.IGNORECASE
)
# A capital T alone stands for temperature.
_OTHER = re.compile(r"((?i:FT|FD|MB|MD|time[ _]?stamp|time)|t)(?![A-Za-z0-9])(.*)")
_BETWEEN = re.compile(r"[\s·⋅×*.^_-]")


def signal_column(header: str) -> tuple[str, float | None]:
    """Signal of a column by its header, and the factor of its unit, None if unknown."""
    text = header.strip()
    if text.lower() == "stamp":  # as a header of ROS; with a unit it is one of `streaming.lines`
        return "time", 1.0
    if match := _COMPONENT.fullmatch(text):
        name = ("F" if match[1][0] in "Ff" else "M") + match[2].lower()
        return name, unit_factor(match[3], "force" if name[0] == "F" else "moment")
    if match := _OTHER.fullmatch(text):
        known = match[1].upper()
        name = "time" if known[0] == "T" else known
        kind = "time" if name == "time" else _KINDS[known[1]]
        return name, unit_factor(match[2], kind)
    return "", None


def unit_factor(text: str, kind: str) -> float | None:
    """Factor of a unit of some kind to SI; None if unknown."""
    bare = text.strip().lstrip("_/,: ").strip("()[] ")
    unit = _BETWEEN.sub("", bare).replace("µ", "u").replace("μ", "u")
    if kind in ("time", "length"):
        unit = unit.lower()
    return _UNITS[kind].get(unit) if unit else 1.0


def units_of(kind: str) -> str:
    """List the units of a kind, for messages."""
    return ", ".join(_UNITS[kind])


def check_one_column_each(header: Sequence[str], names: Sequence[str]) -> None:
    """Raise ValueError for two columns of one signal; names with a dot belong to other whiskers."""
    known = {cell: signal_column(cell) for cell in header if "." not in cell}
    for name in names:
        here = [c for c in header if known.get(c, ("", None))[0] == name and known[c][1]]
        # A second column of time, in other units, is common; a second force is an error.
        if len(here) > 1 and not (name == "time" and here.count(name) == 1):
            raise ValueError(f"{', '.join(here)} are {len(here)} columns of {name}; one is needed")


def signal_columns(
    header: Sequence[str], names: Sequence[str]
) -> tuple[dict[str, tuple[int, float]], dict[str, list[str]]]:
    """Find signals among columns."""
    known = [signal_column(cell) for cell in header]
    found: dict[str, tuple[int, float]] = {}
    strange: dict[str, list[str]] = {}
    for name in names:
        here = [i for i, (which, _) in enumerate(known) if which == name]
        here.sort(key=lambda i: header[i] != name)
        if usable := [(i, factor) for i in here if (factor := known[i][1]) is not None]:
            found[name] = usable[0]
        elif here:
            strange[name] = [header[i] for i in here]
    return found, strange


_QUOTED = 60  # largest number of characters quoted of a wrong value

_THREE_NUMBERS = "three numbers are needed"


def read_toml(path: str | PathLike[str]) -> dict[str, Any]:
    """Read a TOML file."""
    path = check_readable(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        byte = f"byte {error.start} is {error.object[error.start]:#04x}"
        raise ValueError(f"{path} is not TOML in UTF-8: {byte}") from None
    with in_file(path):
        return parsed_toml(text)


def parsed_toml(text: str) -> dict[str, Any]:
    """Parse TOML."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"it is not TOML: {error}") from None
    except RecursionError:
        raise ValueError(
            "it is not a settings file of vibrissa: its values are nested too deeply"
        ) from None


@contextmanager
def in_file(path: object) -> Iterator[None]:
    """Add the name of the file to errors caused by its content."""
    try:
        yield
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: {error}") from error


def number_array(
    value: Any, name: str, needed: str = "numbers, or lists of as many each, are needed"
) -> NDArray[np.float64]:
    """Array from a number or nested lists of numbers in TOML."""
    try:
        if _numeric(value):
            return np.array(value, dtype=np.float64)
    except (ValueError, OverflowError):  # lists of different lengths, or 1 with 400 zeros
        pass
    raise ValueError(f"{name} is {quoted(value)}; {needed}")


def check_keys(table: Mapping[str, Any], allowed: set[str], where: str) -> None:
    """Raise a ValueError if a table has an unknown key."""
    if unknown := sorted(set(table) - allowed):
        raise ValueError(
            f"{where} has {', '.join(unknown)}; known are {', '.join(sorted(allowed))}"
        )


def subtable(table: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Table [name] of a table; empty by default."""
    value = table.get(name, {})
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} is {quoted(value)}; it is written as a table, [{name}]")
    return value


def one_number(table: Mapping[str, Any], name: str, default: float) -> float:
    """Number of a table, finite if it is there."""
    value = table.get(name, default)
    array = number_array(value, name, "a number is needed")
    if array.ndim or (name in table and not np.isfinite(array)):
        raise ValueError(f"{name} is {quoted(value)}; a number is needed")
    return float(array)


def three_numbers(table: Mapping[str, Any], name: str, default: Any = None) -> NDArray[np.float64]:
    """Three numbers of a table."""
    value = table.get(name, default)
    array = number_array(list(value) if isinstance(value, tuple) else value, name, _THREE_NUMBERS)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"{name} is {quoted(value)}; {_THREE_NUMBERS}")
    return array


def quoted(value: object) -> str:
    """Quote the beginning of a value."""
    try:
        text = repr(value)
    except ValueError:  # a whole number of more digits than Python writes
        text = "a number of thousands of digits"
    return text if len(text) <= _QUOTED else text[:_QUOTED] + "…"


def _numeric(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_numeric, value))
    return isinstance(value, int | float) and not isinstance(value, bool)
