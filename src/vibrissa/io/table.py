"""Tables as text: lines of cells."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from vibrissa.io.paths import check_readable


def read_text(path: str | PathLike[str]) -> str:
    """Read a text file.

    Parameters
    ----------
    path : str or path
        In UTF-8, with or without the byte order mark that spreadsheets put first.

    Returns
    -------
    str
        All of it.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is a folder, empty, or no text.
    """
    path = check_readable(path)
    content = path.read_bytes()
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        at = error.start
        raise ValueError(
            f"{path} is no table as text in UTF-8: byte {at} is {content[at]:#04x}"
        ) from None
    if "\0" in text:
        raise ValueError(f"{path} is no table as text: byte {content.find(0)} is zero")
    return text


def table_rows(text: str) -> Iterator[tuple[int, list[str]]]:
    """Take a table apart.

    Parameters
    ----------
    text : str
        All of a CSV file.

    Yields
    ------
    tuple of int and list of str
        Number and cells, without blanks around them, of every line that is neither empty nor a
        comment (#).
    """
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, [cell.strip() for cell in next(csv.reader([line]))]


def read_numbers(path: str | PathLike[str]) -> tuple[list[str], NDArray[np.float64]]:
    """Read a table of numbers under one line of names.

    Parameters
    ----------
    path : str or path
        CSV; an empty cell, and one that says nan, is missing.

    Returns
    -------
    names : list of str
        Of the columns.
    values : array (rows, columns)
        Also cells that are no numbers are NaN, where their column has no number at all: labels.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is empty, has two columns of one name, or lines of another length or with a cell that
        is no number in a column of numbers; all bad lines are named.
    """
    rows = table_rows(read_text(path))
    header = next(rows, None)
    if header is None:
        raise ValueError(f"{path} is empty")
    names = header[1]
    if len(set(names)) != len(names):
        raise ValueError(f"{path} has two columns of the same name: {', '.join(names)}")
    lines = list(rows)
    if not lines:
        raise ValueError(f"{path} has a header but no rows")
    faults = [f"line {line} has {len(c)} cells" for line, c in lines if len(c) != len(names)]
    if faults:
        raise ValueError(
            f"{path} has {len(names)} columns, but {_few(faults)}; the file may be cut short"
        )
    columns = [
        _numbers(path, name, [(line, cells[i]) for line, cells in lines])
        for i, name in enumerate(names)
    ]
    return names, np.stack(columns, axis=1)


def _numbers(
    path: str | PathLike[str], name: str, cells: list[tuple[int, str]]
) -> NDArray[np.float64]:
    """Read one column; labels are NaN."""
    values, faults = np.full(len(cells), np.nan), []
    for i, (line, cell) in enumerate(cells):
        try:
            values[i] = float(cell) if cell else np.nan
        except ValueError:
            faults.append(f"line {line} reads {cell!r}")
    if faults and np.isfinite(values).any():
        raise ValueError(f"{path}: column {name} has cells that are no numbers: {_few(faults)}")
    return values


def _few(faults: list[str]) -> str:
    more = "" if len(faults) <= 5 else f"; and {len(faults) - 5} more lines"
    return "; ".join(faults[:5]) + more
