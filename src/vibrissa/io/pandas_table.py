"""Tables that pandas wrote to HDF5, read without pandas.

Its two formats: "table", one compound dataset whose column names are pickled in attributes, and
"fixed", plain arrays of values, levels and labels. The pickles are opened with a reader that knows
lists, tuples, text and numbers only, so that no file can run code.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Names = list[tuple[str, ...]]

_HARMLESS = {
    ("numpy", "dtype"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "scalar"),
    ("_codecs", "encode"),
}


def pandas_tables(file: h5py.File) -> Iterator[tuple[str, h5py.Group]]:
    """Find the tables of a file.

    Parameters
    ----------
    file : h5py.File
        Open for reading.

    Yields
    ------
    tuple of str and h5py.Group
        Name and group of every pandas table at the top.
    """
    for name, group in file.items():
        if isinstance(group, h5py.Group) and _text(group.attrs.get("pandas_type", "")) in (
            "frame",
            "frame_table",
        ):
            yield name, group


def read_table(group: h5py.Group) -> tuple[Names, Array, list[str]]:
    """Read one table of numbers.

    Parameters
    ----------
    group : h5py.Group
        Of `pandas_tables`.

    Returns
    -------
    names : list of tuple of str
        Of the columns, level by level.
    values : array (rows, columns)
        NaN where missing.
    index : list of str
        Of the rows.

    Raises
    ------
    ValueError
        If its columns cannot be told.
    """
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
        columns = _unpickled(table.attrs[f"{block}_kind"])
        names += [column if isinstance(column, tuple) else (column,) for column in columns]
    values = [np.asarray(rows[block], dtype=np.float64).reshape(len(rows), -1) for block in blocks]
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
        block = np.asarray(group[f"block{i}_values"][:], dtype=np.float64)
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


class _Reader(pickle.Unpickler):
    """Unpickle text and numbers in lists and tuples, and nothing that runs."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _HARMLESS:
            return super().find_class(module, name)
        raise ValueError(f"a column's name is a pickled {module}.{name}, which is not read")


def _unpickled(value: Any) -> list[Any]:
    content = value.encode("latin-1") if isinstance(value, str) else bytes(value)
    try:
        names = _Reader(io.BytesIO(content)).load()
    except (pickle.UnpicklingError, EOFError, AttributeError, IndexError, KeyError) as error:
        raise ValueError(f"the names of its columns cannot be read ({error})") from error
    if not isinstance(names, list):
        raise ValueError(f"the names of its columns are a {type(names).__name__}, not a list")
    return names
