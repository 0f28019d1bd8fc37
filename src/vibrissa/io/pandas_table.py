"""Tables that pandas wrote to HDF5, read without pandas.

Its two formats: "table", one compound dataset whose column names are pickled in attributes, and
"fixed", plain arrays of values, levels and labels. Nothing is unpickled, since a pickle can run
code and build objects of chosen bytes: names are read off its text, and blocks that are no numbers
are refused.
"""

from __future__ import annotations

import pickletools
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Names = list[tuple[str, ...]]


def pandas_tables(file: h5py.File) -> Iterator[tuple[str, h5py.Group]]:
    """Find the tables of a file."""
    for name, group in file.items():
        if isinstance(group, h5py.Group) and _text(group.attrs.get("pandas_type", "")) in (
            "frame",
            "frame_table",
        ):
            yield name, group


def read_table(group: h5py.Group) -> tuple[Names, Array, list[str]]:
    """Read one table of numbers."""
    table = _text(group.attrs["pandas_type"]) == "frame_table"
    names, values, index = _appendable(group) if table else _fixed(group)
    if sum(block.shape[1] for block in values) != len(names):
        raise ValueError(f"the table {group.name} has other columns than names")
    return names, np.concatenate(values, axis=1), index


def _appendable(group: h5py.Group) -> tuple[Names, list[Array], list[str]]:
    table = group["table"]
    rows = table[:]
    blocks = [name for name in table.dtype.names if name.startswith("values_block_")]
    names: Names = []
    for block in blocks:
        names += _column_names(table.attrs[f"{block}_kind"])
    values = [_numbers(block, rows[block]).reshape(len(rows), -1) for block in blocks]
    return _as_text(names), values, _index(rows["index"]) if "index" in rows.dtype.names else []


def _fixed(group: h5py.Group) -> tuple[Names, list[Array], list[str]]:
    names: Names = []
    values = []
    for i in range(int(group.attrs["nblocks"])):
        items = f"block{i}_items"
        if f"{items}_level0" not in group:
            columns = [(name,) for name in group[items].asstr()[:]]
        else:
            count = int(group.attrs[f"{items}_nlevels"])
            levels = [group[f"{items}_level{k}"][:] for k in range(count)]
            labels = [_labels(group, items, k) for k in range(count)]
            columns = list(
                zip(
                    *(level[label] for level, label in zip(levels, labels, strict=True)),
                    strict=True,
                )
            )
        names += columns
        block = _numbers(f"block{i}_values", group[f"block{i}_values"][:])
        values.append(block.reshape(-1, len(columns)))
    return _as_text(names), values, _index(group["axis1"][:]) if "axis1" in group else []


def _labels(group: h5py.Group, items: str, k: int) -> NDArray[np.integer[Any]]:
    name = f"{items}_label{k}" if f"{items}_label{k}" in group else f"{items}_code{k}"
    labels: NDArray[np.integer[Any]] = group[name][:]
    return labels


def _index(values: NDArray[Any]) -> list[str]:
    return [_text(value) for value in values.tolist()] if values.ndim == 1 else []


def _as_text(names: Names) -> Names:
    return [tuple(_text(part) for part in name) for name in names]


def _text(value: Any) -> str:
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)


def _column_names(value: Any) -> Names:
    """Names of columns from a pickle, of which nothing is run.

    A pickle is a program, so it is not unpickled: its instructions are listed, and those that lay
    text, numbers, tuples and lists upon each other are followed. No other has a meaning here.
    """
    content = value.encode("latin-1") if isinstance(value, str) else bytes(value)
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    for operation, argument, _ in pickletools.genops(content):
        name = operation.name
        if name.endswith(_PLAIN):
            stack.append(argument)
        elif name in ("MARK", "EMPTY_LIST", "EMPTY_TUPLE"):
            stack.append({"MARK": _MARK, "EMPTY_LIST": [], "EMPTY_TUPLE": ()}[name])
        elif name in ("LIST", "TUPLE"):
            stack.append({"LIST": list, "TUPLE": tuple}[name](_above_mark(stack)))
        elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
            count = int(name[-1])
            stack[-count:] = [tuple(stack[-count:])]
        elif name in ("APPEND", "APPENDS"):
            more = [stack.pop()] if name == "APPEND" else _above_mark(stack)
            stack[-1].extend(more)
        elif name.endswith("GET"):
            stack.append(memo[int(argument or 0)])
        elif name.endswith("PUT") or name == "MEMOIZE":
            memo[len(memo) if argument is None else int(argument)] = stack[-1]
        elif name not in ("PROTO", "FRAME", "STOP"):
            raise ValueError(
                f"the names of its columns are a pickle with {name} {argument or ''}, which is not "
                "read: text in lists and tuples is; save the table as CSV"
            )
    return _checked_names(stack)


_PLAIN = ("INT", "INT1", "INT2", "LONG", "LONG1", "FLOAT", "STRING", "UNICODE")
_MARK = object()


def _above_mark(stack: list[Any]) -> list[Any]:
    """Take what lies above the last mark off a stack, and the mark."""
    at = len(stack) - 1
    while stack[at] is not _MARK:  # from above: a pickle may be made of marks
        at -= 1
    taken = stack[at + 1 :]
    del stack[at:]
    return taken


def _checked_names(stack: list[Any]) -> Names:
    """What is left of a pickle, if it is a list of text or of tuples of text."""
    if len(stack) != 1 or not isinstance(stack[0], list):
        raise ValueError("the names of its columns are no list")
    names: Names = [name if isinstance(name, tuple) else (name,) for name in stack[0]]
    if not all(isinstance(part, str | int | float) for name in names for part in name):
        raise ValueError("the names of its columns are more than text and numbers")
    return names


def _numbers(name: str, data: Any) -> Array:
    """Values as they are, if they are numbers: those of other types may be pickles."""
    if data.dtype.kind not in "fiub":
        raise ValueError(f"{name} is of type {data.dtype}; numbers are needed")
    return np.asarray(data, dtype=np.float64)
