"""Anipose's table of triangulated points (CSV): ``tip_x, tip_y, tip_z, tip_error, tip_ncams, …``.

The unit is that of the calibration board, mostly mm, which the file does not say. Points have
already been turned by the matrix M and moved to the center that stand in its last columns.

Calibrations of cameras as TOML, as Anipose and aniposelib write them.

    [cam_0]
    name = "top"
    size = [1024, 1024]
    matrix = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    distortions = [k1, k2, p1, p2, k3]
    rotation = [rx, ry, rz]
    translation = [tx, ty, tz]

The rotation is a vector along the axis, as long as the angle, rad; the translation has the unit of
the board that calibrated the cameras, usually mm. An orthographic camera, which Anipose does not
know, has ``projection = "orthographic"`` besides, and pixels per unit on its matrix's diagonal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from vibrissa.deferred import xr
from vibrissa.io.paths import replacing
from vibrissa.io.table import read_numbers
from vibrissa.io.toml import in_file, number_array, quoted, read_toml
from vibrissa.io.tracks import SPACE, RawTracks
from vibrissa.numerics import Array


def read_anipose(path: str | PathLike[str]) -> RawTracks:
    """Read a table of Anipose as raw tracks; ``cameras`` is how many saw each point."""
    path = Path(path)
    names, values = read_numbers(path)
    parts = [name.removesuffix("_ncams") for name in names if name.endswith("_ncams")]
    missing = [
        f"{part}_{axis}" for part in parts for axis in "xyz" if f"{part}_{axis}" not in names
    ]
    if not parts or missing:
        got = f"it lacks {', '.join(missing)}" if missing else "no column ends in _ncams"
        raise ValueError(f"{path} is not a table of Anipose: {got}")

    def column(part: str, what: str) -> Array:
        name = f"{part}_{what}"
        return values[:, names.index(name)] if name in names else np.full(len(values), np.nan)

    points = np.stack(
        [np.stack([column(part, axis) for axis in "xyz"], axis=-1) for part in parts], axis=1
    )
    measured = {
        what: np.stack([column(part, what) for part in parts], axis=1)[:, None]
        for what in ("score", "error", "ncams")
    }
    # Where no camera saw a point the score is a placeholder above 1.
    score = np.where(measured["score"] > 1.0, np.nan, measured["score"])
    frames = values[:, names.index("fnum")] if "fnum" in names else np.arange(len(values))
    about = {"reprojection_error": ("pixel", "error"), "cameras": ("1", "ncams")}
    return RawTracks(
        software="Anipose",
        whiskers=["whisker"],
        space=points[:, None],
        space_confidence=score,
        nodes=parts,
        frames=frames.astype(np.int64),
        extra={
            name: xr.Variable(
                SPACE[:-1],
                measured[what],
                {"units": unit, "long_name": name.replace("_", " ")},
            )
            for name, (unit, what) in about.items()
        },
    )


_CAMERA_NEEDED = ("size", "matrix", "rotation", "translation")
_SHAPES = {"size": (2,), "matrix": (3, 3), "rotation": (3,), "translation": (3,), "distortions": ()}
_NUMBERS = {
    "size": "width and height",
    "matrix": "three rows of three numbers",
    "rotation": "three numbers",
    "translation": "three numbers",
    "distortions": "a list of numbers",
}


def read_calibration(path: str | PathLike[str]) -> list[dict[str, Any]]:
    """Read the calibration of each camera."""
    path = Path(path)
    cameras = []
    for name, table in read_toml(path).items():
        if not isinstance(table, dict) or name == "metadata":
            continue
        missing = [key for key in _CAMERA_NEEDED if key not in table]
        if missing:
            raise ValueError(f"{path}: [{name}] has no {', '.join(missing)}")
        with in_file(f"{path}: [{name}]"):
            cameras.append({"name": name} | table | _checked(table))
    if not cameras:
        raise ValueError(f"{path} holds no camera")
    return cameras


def _checked(table: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers of a camera, each checked for its shape."""
    out: dict[str, Any] = {}
    for key, shape in _SHAPES.items():
        values = number_array(table.get(key, []), key)
        if values.shape != shape and not (key == "distortions" and values.ndim == 1):
            raise ValueError(f"{key} is {quoted(table[key])}; {_NUMBERS[key]} are needed")
        if not np.isfinite(values).all():
            raise ValueError(f"{key} is {quoted(table[key])}; its numbers must be finite")
        out[key] = values.tolist()
    kind = table.get("projection", "perspective")
    if kind not in ("perspective", "orthographic"):
        raise ValueError(f"projection is {quoted(kind)}; perspective or orthographic is needed")
    width, height = out["size"]
    if not (width % 1.0 == height % 1.0 == 0.0 and min(width, height) >= 1.0):
        raise ValueError(f"size is {quoted(table['size'])}; whole numbers of pixels are needed")
    out["size"] = [int(width), int(height)]
    return out


def write_calibration(path: str | PathLike[str], cameras: Sequence[Mapping[str, Any]]) -> None:
    """Write a calibration that `read_calibration` reads."""
    lines = []
    for i, camera in enumerate(cameras):
        lines.append(f"[cam_{i}]")
        lines += [f"{key} = {_toml(value)}" for key, value in camera.items()]
        lines.append("")
    with replacing(path) as part:
        part.write_text("\n".join([*lines, "[metadata]", "adjusted = false", ""]), encoding="utf-8")


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, int | float):
        return repr(value)
    return "[" + ", ".join(_toml(part) for part in value) + "]"
