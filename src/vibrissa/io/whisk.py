"""Reader of files of the tracker *whisk*: `.whiskers` (traces) and `.measurements`.

Files are little endian. A whiskers file consists of the header ``bwhiskbin1``; for each segment its
id, frame and number of points n with n times x, y, thickness and score as float32; and the number
of segments. The id numbers the segments of one frame and is not an identity; points run in either
direction; traces extend beyond the tip and into the face by some pixels. A measurements file
consists of the header ``measv3``, the numbers of rows and measures, and for each row (one per
trace) its frame, segment, state and measures. The state is the whisker's identity if whiskers have
been classified (−1: none), and otherwise the same for all.

Clack et al. 2012, doi:10.1371/journal.pcbi.1002591.
"""

from __future__ import annotations

import struct
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import xr
from vibrissa.io.paths import check_readable
from vibrissa.io.tracks import RawTracks
from vibrissa.numerics import Array

Numbers = NDArray[np.int64]

WHISKERS = b"bwhiskbin1\0\0"
MEASUREMENTS = b"measv3\0\0"

_MEASURES = 8
_SEGMENT = struct.Struct("<3i")
_MOST_BYTES = 2**31
_MOST_FRAMES = 10_000_000


def read_whiskers(path: str | PathLike[str]) -> RawTracks:
    """Read a whiskers file as raw tracks, with thickness in pixels and the tracker's score.

    A measurements file of the same name in the same folder states which end is the follicle and, if
    classified, the whisker of each segment. Without it, whisker i is the i-th segment of each
    frame, which is not an identity, and the direction of the points is unchanged.
    """
    path = check_readable(path)
    frames, ids, segments = _segments(path)
    measurements = path.with_suffix(".measurements")
    identity = ids
    about: dict[str, Any] = {"identity": "per frame", "direction": "either"}
    if measurements.is_file():
        rows = _rows(measurements)
        segments, identity = _matched(path, measurements, frames, ids, segments, rows)
        about = {"identity": _identity(rows)[1], "direction": "from the follicle"}
    kept = identity >= 0
    frames, identity = frames[kept], identity[kept]
    chosen = [segment for segment, keep in zip(segments, kept, strict=True) if keep]
    filled, whiskers, number = _table(path, frames, identity, chosen)
    measured = ("time", "whisker", "view", "node")
    return RawTracks(
        software="whisk",
        whiskers=whiskers,
        image=filled[..., :2],
        frames=number,
        extra={
            "thickness": xr.Variable(
                measured, filled[..., 2], {"units": "pixel", "long_name": "thickness of the trace"}
            ),
            "score": xr.Variable(
                measured, filled[..., 3], {"units": "1", "long_name": "score of the trace"}
            ),
        },
        about=about,
    )


def read_measurements(path: str | PathLike[str]) -> RawTracks:
    """Read a measurements file as raw tracks.

    Its ``trace`` has the nodes ``follicle`` and ``tip``; ``segment`` is the id of a trace in the
    whiskers file, −1 where there is none.
    """
    path = check_readable(path)
    rows = _rows(path)
    identity, kind = _identity(rows)
    kept = identity >= 0
    rows, identity = rows[kept], identity[kept]
    number, whiskers, place = _places(path, rows["frame"].astype(np.int64), identity)
    shape = (number.size, len(whiskers), 1)
    measures = np.full((*shape, _MEASURES), np.nan)
    measures[(*place, 0)] = rows["data"]
    segment = np.full(shape, -1)
    segment[(*place, 0)] = rows["segment"]
    columns = {
        "trace_length": (0, 1.0, "pixel", "length of the trace"),
        "score": (1, 1.0, "1", "score of the trace"),
        "angle": (2, np.pi / 180.0, "rad", "angle of the trace at the follicle"),
        "trace_curvature": (3, 1.0, "1/pixel", "curvature of the trace"),
    }
    dims = ("time", "whisker", "view")
    extra = {
        name: xr.Variable(
            dims, measures[..., column] * factor, {"units": unit, "long_name": long_name}
        )
        for name, (column, factor, unit, long_name) in columns.items()
    }
    extra["segment"] = xr.Variable(dims, segment, {"units": "1", "long_name": "id of the segment"})
    about: dict[str, Any] = {"identity": kind, "direction": "from the follicle"}
    if rows.size:
        face = rows["face"][0]
        about |= {"face": [int(x) for x in face], "face_axis": rows["axis"][0].decode("ascii")}
    return RawTracks(
        software="whisk",
        whiskers=whiskers,
        image=measures[..., 4:].reshape(*shape, 2, 2),
        nodes=("follicle", "tip"),
        frames=number,
        extra=extra,
        about=about,
    )


def _segments(path: Path) -> tuple[Numbers, Numbers, list[Array]]:
    """Frame, id and points (n, 4) of every segment."""
    content = path.read_bytes()
    if not content.startswith(WHISKERS[:10]):
        raise ValueError(f"{path} is not a whiskers file: it does not begin with bwhiskbin1")
    cut = f"{path} is cut short: its last segment is not whole, or the number of segments is wrong"
    if len(content) < len(WHISKERS) + 4:
        raise ValueError(cut)
    end = len(content) - 4
    (count,) = struct.unpack_from("<i", content, end)
    at, frames, ids, segments = len(WHISKERS), [], [], []
    while at < end:
        if at + _SEGMENT.size > end:
            raise ValueError(cut)
        number, frame, n = _SEGMENT.unpack_from(content, at)
        at += _SEGMENT.size
        if n < 0 or at + 16 * n > end:
            raise ValueError(cut)
        values = np.frombuffer(content, "<f4", 4 * n, at).reshape(4, n)
        segments.append(values.T.astype(np.float64))
        frames.append(frame)
        ids.append(number)
        at += 16 * n
    if count != len(segments):
        raise ValueError(cut)
    return np.array(frames, dtype=np.int64), np.array(ids, dtype=np.int64), segments


def _rows(path: Path) -> NDArray[Any]:
    """Read every row of a measurements file."""
    content = check_readable(path).read_bytes()
    if not content.startswith(MEASUREMENTS[:6]):
        raise ValueError(f"{path} is not a measurements file: it does not begin with measv3")
    if len(content) < len(MEASUREMENTS) + 8:
        raise ValueError(f"{path} is cut short: its header is not whole")
    count, n = struct.unpack_from("<2i", content, len(MEASUREMENTS))
    if n != _MEASURES:
        raise ValueError(f"{path} has {n} measures a row; {_MEASURES} are known")
    whole = np.dtype(
        [
            ("row", "<i4"),
            ("frame", "<i4"),
            ("segment", "<i4"),
            ("state", "<i4"),
            ("face", "<i4", 2),
            ("follicle_columns", "<i4", 2),
            ("velocity_valid", "<i4"),
            ("n", "<i4"),
            ("axis", "S1"),
            ("data", "<f8", n),
            ("velocity", "<f8", n),
        ]
    )
    start = len(MEASUREMENTS) + 8
    if len(content) != start + count * whole.itemsize:
        have = (len(content) - start) / whole.itemsize
        raise ValueError(f"{path} is cut short: its header states {count} rows, it has {have:.1f}")
    rows = np.frombuffer(content, whole, count, start)
    return rows[np.lexsort((rows["segment"], rows["frame"]))]


def _identity(rows: NDArray[Any]) -> tuple[Numbers, str]:
    """Whisker of each row, −1 for none, and a description of how it is known."""
    state = rows["state"].astype(np.int64)
    classified = state >= 0
    pairs = np.stack([rows["frame"], state], axis=1)[classified]
    if classified.any() and len(np.unique(pairs, axis=0)) == len(pairs):
        return state, "classified"
    return rows["segment"].astype(np.int64), "per frame"


def _matched(
    path: Path,
    measurements: Path,
    frames: Numbers,
    ids: Numbers,
    segments: list[Array],
    rows: NDArray[Any],
) -> tuple[list[Array], Numbers]:
    """Orient segments from follicle to tip; also return their identities, −1 for none."""
    identity, _ = _identity(rows)
    found = {
        (int(row["frame"]), int(row["segment"])): (int(who), row["data"][4:6])
        for row, who in zip(rows, identity, strict=True)
    }
    turned, who = [], np.full(len(segments), -1)
    for i, (key, points) in enumerate(
        zip(zip(frames.tolist(), ids.tolist(), strict=True), segments, strict=True)
    ):
        if key in found and len(points):
            who[i], follicle = found.pop(key)
            first, last = np.linalg.norm(points[[0, -1], :2] - follicle, axis=1)
            points = points if first <= last else points[::-1]
        turned.append(points)
    if found:
        raise ValueError(
            f"{measurements} does not belong to {path}: it measures {len(found)} segments that "
            "the whiskers file does not have"
        )
    return turned, who


def _places(
    path: Path, frames: Numbers, identity: Numbers
) -> tuple[Numbers, list[str], tuple[Numbers, Numbers]]:
    """All frames from first to last, names of whiskers, and the indices of each row in these."""
    if not frames.size:
        raise ValueError(f"{path} contains no whiskers")
    if frames.max() - frames.min() > _MOST_FRAMES or frames.min() < 0:
        raise ValueError(
            f"{path} is damaged: its frames are numbered from {frames.min()} to {frames.max()}"
        )
    number = np.arange(frames.min(), frames.max() + 1)
    whiskers, column = np.unique(identity, return_inverse=True)
    pairs = np.stack([frames, identity], axis=1)
    if len(np.unique(pairs, axis=0)) != len(pairs):
        raise ValueError(f"{path} has the same segment twice in one frame")
    if 64.0 * number.size * whiskers.size > _MOST_BYTES:
        raise ValueError(f"{path} has {number.size} frames of {whiskers.size} whiskers: too many")
    return number, [str(one) for one in whiskers], (frames - number[0], column)


def _table(
    path: Path, frames: Numbers, identity: Numbers, segments: list[Array]
) -> tuple[Array, list[str], Numbers]:
    """Columns (n, whiskers, 1, nodes, 4) of all segments, NaN beyond their end."""
    number, whiskers, (row, column) = _places(path, frames, identity)
    longest = max(len(segment) for segment in segments)
    shape = (number.size, len(whiskers), 1, longest, 4)
    if 8 * np.prod(shape, dtype=np.float64) > _MOST_BYTES:
        raise ValueError(
            f"{path} has {number.size} frames of up to {len(whiskers)} segments with up to "
            f"{longest} points, too many to hold: give nodes=, such as 50, or classify the whiskers"
        )
    filled = np.full(shape, np.nan)
    for i, segment in enumerate(segments):
        filled[row[i], column[i], 0, : len(segment)] = segment
    return filled, whiskers, number
