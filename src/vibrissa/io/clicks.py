"""Clicks of a person in the images of a recording: bases, masks, regions, the scale; TOML.

    videos = ["top.mp4", "front.mp4"]
    pixel_size = 0.058                                # mm
    [[view]]
    base = [[61.0, 304.0]]                            # whisker by whisker, in the first frame
    mask = [[[270.0, 0.0], [310.0, 0.0], [290.0, 300.0]]]     # corners of each polygon
    region = [[[0.0, 0.0], [400.0, 0.0], [400.0, 511.0], [0.0, 511.0]]]

Column and row, pixels. A mask is left out; where there are regions, all else is.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.io.paths import check_writable
from vibrissa.io.toml import check_keys, in_file, number_array, quoted, read_toml
from vibrissa.numerics import Mask

Points = tuple[tuple[float, float], ...]

_FEWEST = 3
"""Number of corners of a polygon, at least."""


@dataclass(frozen=True)
class ViewClicks:
    """Clicks in one view."""

    base: Points = ()
    mask: tuple[Points, ...] = ()
    region: tuple[Points, ...] = ()

    def masked(self, size: Sequence[int]) -> Mask | None:
        """Find the pixels of an image without whiskers."""
        masked = _inside(self.mask, size) if self.mask else None
        return together([masked, ~_inside(self.region, size) if self.region else None])


def together(masks: Iterable[Mask | None]) -> Mask | None:
    """Join masks of one view; None if there is none."""
    shown = [mask for mask in masks if mask is not None]
    if len({mask.shape for mask in shown}) > 1:
        sizes = sorted({f"{mask.shape[1]} × {mask.shape[0]}" for mask in shown})
        raise ValueError(f"masks of one view have {' and '.join(sizes)} pixels; give the video's")
    return np.logical_or.reduce(shown) if shown else None


@dataclass(frozen=True)
class Clicks:
    """Clicks in the images of all views."""

    views: tuple[ViewClicks, ...]
    videos: tuple[str, ...] = ()
    pixel_size: float | None = None


def _inside(polygons: Iterable[Points], size: Sequence[int]) -> Mask:
    """Pixels (height, width) whose middle is in any of some polygons."""
    width, height = size
    x, y = np.arange(width)[None], np.arange(height)[:, None]
    whole = np.zeros((height, width), dtype=bool)
    for polygon in polygons:
        inside = np.zeros_like(whole)
        for (x0, y0), (x1, y1) in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            if y0 != y1:
                # A ray to the right crosses the outline an odd number of times.
                crossing = x0 + (y - y0) * ((x1 - x0) / (y1 - y0))
                inside ^= ((y0 > y) != (y1 > y)) & (x < crossing)
        whole |= inside
    return whole


def polygon_of(points: ArrayLike, name: str) -> Points:
    """Check the corners of a polygon, (n, 2)."""
    array = number_array(points, name, "corners [column, row] are needed")
    if array.ndim != 2 or array.shape[1] != 2 or len(array) < _FEWEST:
        raise ValueError(f"{name} is {quoted(points)}; corners, three at least, are needed")
    return tuple((float(x), float(y)) for x, y in array)


def load_clicks(path: str | PathLike[str]) -> Clicks:
    """Read what was shown in the images of a recording."""
    table = read_toml(path)
    with in_file(path):
        check_keys(table, {"videos", "pixel_size", "view"}, "it")
        views = table.get("view")
        if not isinstance(views, list) or not all(isinstance(view, dict) for view in views):
            raise ValueError("it has no [[view]]; one for each view is needed")
        size = table.get("pixel_size")
        if size is not None:
            size = 1e-3 * float(number_array(size, "pixel_size"))
            if not 0.0 < size < np.inf:
                raise ValueError(f"pixel_size is {1e3 * size:g}; mm, more than 0, are needed")
        read = tuple(_view(view, i) for i, view in enumerate(views))
        return Clicks(read, tuple(map(str, table.get("videos", ()))), size)


def _view(table: dict[str, Any], number: int) -> ViewClicks:
    check_keys(table, {"base", "mask", "region"}, f"view {number}")
    bases = number_array(table.get("base", []), f"base of view {number}")
    if bases.size and (bases.ndim != 2 or bases.shape[1] != 2 or not np.isfinite(bases).all()):
        raise ValueError(f"base of view {number} is {quoted(table['base'])}; [[x, y], …] is needed")
    areas = {}
    for name in ("mask", "region"):
        polygons = table.get(name, [])
        if not isinstance(polygons, list):
            raise ValueError(f"{name} of view {number} is {quoted(polygons)}; a list is needed")
        areas[name] = tuple(polygon_of(one, f"{name} of view {number}") for one in polygons)
    return ViewClicks(tuple((float(x), float(y)) for x, y in bases.reshape(-1, 2)), **areas)


def save_clicks(path: str | PathLike[str], clicks: Clicks) -> None:
    """Write what was shown in the images of a recording."""
    check_writable(path, (".toml",))
    lines = [f"videos = {json.dumps(clicks.videos, ensure_ascii=False)}"]
    if clicks.pixel_size is not None:
        lines.append(f"pixel_size = {1e3 * clicks.pixel_size!r}")
    for view in clicks.views:
        lines.append("\n[[view]]")
        names = ("base", "mask", "region")
        lines += [f"{name} = {_listed(getattr(view, name))}" for name in names]
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _listed(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_listed, value))}]"
    return repr(round(float(value), 2))
