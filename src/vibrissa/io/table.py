"""Tables as text: lines of cells."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from os import PathLike

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
