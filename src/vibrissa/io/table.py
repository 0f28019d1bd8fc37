"""Tables as text: lines of cells."""

from __future__ import annotations

import csv
from collections.abc import Iterator


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
