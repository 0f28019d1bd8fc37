"""Tables, as all verbs print them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.text import Text

from vibrissa.cli.terminal import output

Row = Sequence[str | Text]
"""The cells of a row."""


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

    table = Table(
        title=title,
        caption=caption,
        title_justify="left",
        caption_justify="left",
        show_header=any(columns),
    )
    for number, name in enumerate(columns):
        table.add_column(name, justify="left" if number in left else "right")
    for row in rows:
        if row is None:
            table.add_section()
        else:
            table.add_row(*row)
    output.print(table)


def print_properties(rows: Iterable[tuple[str, str]]) -> None:
    """Print names and values, without lines between them."""
    from rich.table import Table

    table = Table(show_header=False, box=None)
    table.add_column()
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(Text(name, style="bold"), value)
    output.print(table, highlight=False)
