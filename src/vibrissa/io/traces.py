"""Traces on their way: what is done of a video, kept while the rest is traced.

A file holds the traces of some whiskers from the first frame on, as one array of points with their
number per frame, and a key of the video and the settings.

Corrected traces as CSV: points that a person has confirmed.

Columns ``view,frame,whisker,x,y``: the points of a whisker in one frame of one view (a number from
0), from base to tip, column and row in pixels, a line each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.io.paths import replacing
from vibrissa.io.table import Table, write_table

Array = NDArray[np.float64]
Row = tuple[Array, Array, NDArray[np.bool_], float, bool, bool]
"""Points (n, 2), standard deviations (n,), seen (n,), confidence, whether base and tip are."""


def save_traces(path: str | PathLike[str], key: str, traces: Sequence[Sequence[Row]]) -> None:
    """Write traces."""
    rows = [row for whisker in traces for row in whisker]
    columns = [np.concatenate([row[k] for row in rows]) if rows else np.empty(0) for k in range(3)]
    with replacing(path) as part, part.open("wb") as file:
        np.savez_compressed(
            file,
            key=np.array(key),
            whiskers=np.array(len(traces)),
            count=np.array([len(row[0]) for row in rows], dtype=np.int64),
            confidence=np.array([row[3] for row in rows]),
            ends=np.array([row[4:6] for row in rows], dtype=bool).reshape(-1, 2),
            line=columns[0].reshape(-1, 2),
            sigma=columns[1],
            seen=columns[2].astype(bool),
        )


def load_traces(path: str | PathLike[str], key: str) -> list[list[Row]] | None:
    """Read traces."""
    if not Path(path).is_file():
        return None
    try:
        with np.load(path) as file:
            if str(file["key"]) != key:
                return None
            count, whiskers = file["count"], int(file["whiskers"])
            parts = [np.split(file[name], np.cumsum(count)[:-1]) for name in _COLUMNS]
            confidence, ends = file["confidence"], file["ends"]
    except (OSError, ValueError, KeyError, BadZipFile):
        return None
    rows = [
        (line, sigma, seen, float(sure), bool(base), bool(tip))
        for line, sigma, seen, sure, (base, tip) in zip(*parts, confidence, ends, strict=True)
    ]
    each = len(rows) // max(whiskers, 1)
    return [rows[k * each : (k + 1) * each] for k in range(whiskers)]


_COLUMNS = ("line", "sigma", "seen")


CORRECTION_COLUMNS = ("view", "frame", "whisker", "x", "y")


def load_corrections(path: str | PathLike[str]) -> dict[int, dict[tuple[int, int], Array]]:
    """Read corrected traces.

    Parameters
    ----------
    path : str or path
        CSV file.

    Returns
    -------
    dict
        By view: by frame and whisker the points (n, 2) from base to tip, column and row.
    """
    table = Table(path, CORRECTION_COLUMNS)
    values = np.stack([table.numbers(name) for name in CORRECTION_COLUMNS], axis=1)
    numbers = values[:, :3]
    wrong = ~np.isfinite(values).all(axis=1) | (numbers < 0.0).any(axis=1)
    table.refuse(wrong | (numbers != np.round(numbers)).any(axis=1), "no point of a trace")
    points: dict[int, dict[tuple[int, int], list[Array]]] = {}
    for (view, frame, whisker), place in zip(
        numbers.astype(int).tolist(), values[:, 3:], strict=True
    ):
        points.setdefault(view, {}).setdefault((frame, whisker), []).append(place)
    short = [(v, *key) for v, each in points.items() for key, p in each.items() if len(p) < 2]
    if short:
        view, frame, whisker = short[0]
        raise ValueError(
            f"{path}: whisker {whisker} in frame {frame} of view {view} has one point; from base "
            "to tip at least two are needed"
        )
    return {view: {key: np.array(p) for key, p in each.items()} for view, each in points.items()}


def save_corrections(
    path: str | PathLike[str], corrections: Mapping[int, Mapping[tuple[int, int], ArrayLike]]
) -> None:
    """Write corrected traces so that `load_corrections` reads them.

    Parameters
    ----------
    path : str or path
        CSV file; an existing one is replaced once the new one is complete.
    corrections : mapping
        By view: by frame and whisker the points (n, 2) from base to tip, column and row.

    Raises
    ------
    ValueError
        If a trace has less than two points, or one that is not finite.
    """
    rows: list[list[float]] = []
    for view, each in sorted(corrections.items()):
        for (frame, whisker), points in sorted(each.items()):
            array = np.asarray(points, dtype=np.float64)
            if array.ndim != 2 or array.shape[1:] != (2,) or len(array) < 2:
                raise ValueError(
                    f"whisker {whisker} in frame {frame} of view {view}: points of shape "
                    f"{array.shape}; (n, 2), n ≥ 2, is needed"
                )
            if not np.isfinite(array).all():
                raise ValueError(
                    f"whisker {whisker} in frame {frame} of view {view} has points that are not "
                    "finite"
                )
            rows += [[view, frame, whisker, *place] for place in array.tolist()]
    write_table(path, CORRECTION_COLUMNS, rows)
