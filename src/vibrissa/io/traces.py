"""Traces on their way: what is done of a video, kept while the rest is traced.

A file holds the traces of some whiskers from the first frame on, as one array of points with their
number per frame, and a key that says of which video and with which settings.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from vibrissa.io.replace import replacing

Array = NDArray[np.float64]
Row = tuple[Array, Array, NDArray[np.bool_], float, bool, bool]
"""Points (n, 2), standard deviations (n,), seen (n,), confidence, whether base and tip are."""


def save_traces(path: str | PathLike[str], key: str, traces: Sequence[Sequence[Row]]) -> None:
    """Write traces.

    Parameters
    ----------
    path : str or path
        Where; an existing file is replaced once the new one is complete.
    key : str
        Of what they are.
    traces : sequence of sequence of tuple
        Whisker by whisker, frame by frame: line, sigma, seen, confidence, base and tip seen.
    """
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
    """Read traces.

    Parameters
    ----------
    path : str or path
        Of `save_traces`.
    key : str
        Of what they must be.

    Returns
    -------
    list of list of tuple, or None
        As they were; None if there is no such file, or it is of something else, or damaged.
    """
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
