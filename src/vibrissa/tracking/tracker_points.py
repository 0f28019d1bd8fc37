"""Points of other trackers as traces in views, so that they are processed like videos.

Trackers give a few points along a whisker, in one or more views or in space. Points in views serve
as traces. Points in space are projected into two orthogonal cameras, perpendicular to the typical
direction of the whisker, so that no whisker points towards a camera.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from vibrissa.cameras import Camera, orthogonal_views
from vibrissa.deferred import interpolate, optimize
from vibrissa.numerics import Array, IntArray
from vibrissa.tracking.refine.rods import NODES
from vibrissa.tracking.trace.trace import STEP, Trace, arc_lengths, given

POINT_SIGMA = 0.5  # typical standard deviation of a tracked point across the whisker, pixels
_SHOWN = 12  # largest number of whiskers listed in a message
_FEWEST = 3  # smallest number of points of a trace
_CONFIDENT = 0.6  # confidence below which a tracker's point is dropped
_SPACING = 8.0  # distance of points along a trace below which they are averaged, pixels
_USUAL = 0.5  # share of the frames with a whisker above which it is tracked
_SHARE = 1e-3  # typical standard deviation of a point in space, as a share of the whisker's length
_WIDE = 1000.0  # width of the image of an added camera, pixels
_MARGIN = 20.0  # distance of the points from the border of such an image, pixels
_TESTED = 20  # largest number of frames from which the error between points is estimated
# The error of a line between points relative to that of a line without one of the points, whose
# gap is twice as wide; and the latter, in standard deviations of the points, due to their noise.
_NARROWER, _OF_NOISE = 0.25, 3.0
_STILLER = 3.0  # ratio by which a base moves more than a tip above which order is doubted
_SHORTEST = 3.0  # extent below which points can not be those of a whisker, pixels
_BASES = ("base", "root", "follicle")  # words that name the point at a whisker's base
_ARC_POINTS = 12  # number of points on an arc that represents a measured curvature


@dataclass(frozen=True)
class TrackerTraces:
    """Points of other trackers as traces in cameras."""

    cameras: tuple[Camera, ...]  # cameras of the views, or two added ones for points in space
    traces: list[list[list[Trace]]]  # by view, whisker and frame, as for `track`
    names: list[str]
    notes: tuple[str, ...]  # assumptions, a sentence each


def tracker_traces(
    tracks: xr.Dataset,
    cameras: Sequence[Camera] | None = None,
    *,
    pixel_size: float | None = None,
    names: Sequence[str] | None = None,
    sigma: float | None = None,
    tip: bool = True,
) -> TrackerTraces:
    """Convert the points of other trackers to traces, of which the last is the whisker's tip."""
    notes: list[str] = []
    tracks = _arcs(_from_base(_apart(tracks, notes), notes), notes)
    if "centerline" in tracks:
        points = _confident(tracks, "centerline", "confidence")
        views = None
    elif "trace" in tracks:
        name = "trace_confidence" if "trace_confidence" in tracks else "confidence"
        points = _confident(tracks, "trace", name)
        _check_images(points, [str(view) for view in tracks["view"].values])
        views = _views(points, tracks, cameras, pixel_size, notes)
    else:
        raise ValueError("the tracks hold neither a trace nor a centreline")
    known = [str(name) for name in tracks["whisker"].values]
    if tracks.attrs.get("identity") == "per frame":
        either = tracks.attrs.get("direction") == "either"
        points, known = _identified(points, known, names, either, notes)
    kept = _wanted(known, points, names)
    known, points = [known[k] for k in kept], points[:, kept]
    if views is None:
        points, views, sigma = _in_two_views(points, sigma, notes)
    scatter = POINT_SIGMA if sigma is None else sigma
    nodes, shown = _node_names(tracks), [camera.name for camera in views]
    for k, name in enumerate(known):
        notes += _order_faults(points[:, k], name, shown, nodes)
        for v, view in enumerate(shown):
            between = _interpolation_error(points[:, k, v], scatter)
            if between > scatter:
                notes.append(
                    f"{name}: its points in {view} are so far apart that the line between them has "
                    f"an error of some {between:.1f} pixels, which no covariance includes: track "
                    "more points along the whisker"
                )
    if tip and nodes and "tip" not in nodes[-1].lower():
        notes.append(
            f"the last point, {nodes[-1]}, is taken as the whisker's tip; if the whisker is "
            "longer, state its length (--length)"
        )
    traces = [
        [
            [_trace(points[i, k, v], scatter, tip, bool(nodes)) for i in range(len(points))]
            for k in range(len(known))
        ]
        for v in range(len(views))
    ]
    return TrackerTraces(tuple(views), traces, known, tuple(notes))


def _node_names(tracks: xr.Dataset) -> list[str]:
    """Names of the points along a whisker; None if they are numbered."""
    if "node" not in tracks.coords or tracks["node"].dtype.kind not in "UO":
        return []
    return [str(name) for name in tracks["node"].values]


def _apart(tracks: xr.Dataset, notes: list[str]) -> xr.Dataset:
    """Separate whiskers that are named as points of one animal, such as C1_base … C2_tip."""
    names = _node_names(tracks)
    if tracks.sizes.get("whisker") != 1 or not names:
        return tracks
    cut = [re.split(r"[_\-. ]", name, maxsplit=1) for name in names]
    turned = [name[::-1] for name in names]
    back = [[p[::-1] for p in re.split(r"[_\-. ]", name, maxsplit=1)] for name in turned]
    # The whisker is named first or last; its points are next to each other in the file.
    groups = next((found for pairs in (cut, back) if (found := _groups(pairs))), None)
    if groups is None:
        return tracks
    parts = [
        tracks.isel(node=rows).assign_coords(node=nodes, whisker=[name])
        for name, (rows, nodes) in groups.items()
    ]
    notes.append(
        f"by the names of their points these are {len(parts)} whiskers: {', '.join(groups)}"
    )
    together: dict[str, Any] = {"data_vars": "minimal", "coords": "minimal", "compat": "override"}
    return xr.concat(parts, "whisker", combine_attrs="override", **together)


def _groups(pairs: list[list[str]]) -> dict[str, tuple[list[int], list[str]]] | None:
    """Rows and names of the points of each whisker, if all have the same ones in sequence."""
    if any(len(pair) != 2 for pair in pairs):
        return None
    found: dict[str, tuple[list[int], list[str]]] = {}
    for row, (whisker, node) in enumerate(pairs):
        rows, nodes = found.setdefault(whisker, ([], []))
        if rows and rows[-1] != row - 1:
            return None
        rows.append(row)
        nodes.append(node)
    (_, first), *others = found.values()
    alike = all(nodes == first for _, nodes in others)
    return found if others and alike and len(first) >= _FEWEST else None


def _from_base(tracks: xr.Dataset, notes: list[str]) -> xr.Dataset:
    """Sort points whose names differ by numbers, and reverse those that run from tip to base."""
    names = [name.lower() for name in _node_names(tracks)]
    # The last number of a name counts: C1_1, C1_10, C1_2.
    parts = [re.fullmatch(r"(.*?)(\d+)(\D*)", name) for name in names]
    numbers = [int(part[2]) for part in parts if part]
    numbered = len({part and (part[1], part[3]) for part in parts}) == 1
    # Numbers that decrease may be intended; spreadsheets sort names: w1, w10, w2.
    if numbered and sorted(numbers) not in (numbers, numbers[::-1]):
        notes.append(
            f"the points are in the order {', '.join(names)} in the file: they were sorted by "
            "their numbers, as nodes run from base to tip"
        )
        return tracks.isel(node=np.argsort(numbers, kind="stable"))
    if not names or "tip" not in names[0] or not any(base in names[-1] for base in _BASES):
        return tracks
    notes.append(
        f"the points run from {names[0]} to {names[-1]} by their names: their order was reversed, "
        "as nodes run from base to tip"
    )
    return tracks.isel(node=slice(None, None, -1))


def _confident(tracks: xr.Dataset, name: str, confidence: str) -> Array:
    """Points (time, whisker[, view], node, axis), NaN where the tracker's confidence is low."""
    points = np.array(tracks[name].values, dtype=np.float64)
    if confidence in tracks:
        sure = tracks[confidence].values
        points[sure < _CONFIDENT] = np.nan
        if not np.isfinite(points).any() and np.isfinite(sure).any():
            raise ValueError(
                f"no point has a confidence of {_CONFIDENT:g} or more; the largest is "
                f"{np.nanmax(sure):.2g}"
            )
    return points


def _arcs(tracks: xr.Dataset, notes: list[str]) -> xr.Dataset:
    """Place points on an arc of the measured curvature, if only both ends are given."""
    if "trace_curvature" not in tracks or tracks.sizes.get("node") != 2:
        return tracks
    ends, curvature = tracks["trace"].values, tracks["trace_curvature"].values[..., None]
    chord = ends[..., 1, :] - ends[..., 0, :]
    length = np.linalg.norm(chord, axis=-1, keepdims=True)
    half = np.arcsin(np.clip(0.5 * curvature * length, -0.9, 0.9))
    across = np.stack([-chord[..., 1], chord[..., 0]], axis=-1)
    # On an arc that turns by 2·half, at the angles `along` from its middle.
    along = np.linspace(-1.0, 1.0, _ARC_POINTS) * half
    straight = np.broadcast_to(np.linspace(0.0, 1.0, _ARC_POINTS), along.shape)
    bent = np.abs(half) > 1e-6
    sine = np.where(bent, np.sin(half), 1.0)
    share = np.where(bent, 0.5 + 0.5 * np.sin(along) / sine, straight)
    # Positive curvature turns from the columns towards the rows: the arc bulges the other way.
    bulge = np.where(bent, -0.5 * (np.cos(along) - np.cos(half)) / sine, 0.0)
    middle = ends[..., 0, :][..., None, :]
    points = (
        middle + share[..., None] * chord[..., None, :] + bulge[..., None] * across[..., None, :]
    )
    notes.append(
        "the file contains follicle, tip and mean curvature: the whisker is approximated by an arc "
        "between them; its shape is in the .whiskers file of the same name"
    )
    kept = tracks.drop_dims("node")
    return kept.assign(trace=(tracks["trace"].dims, points)).assign_attrs(tracks.attrs)


def _check_images(points: Array, views: Sequence[str]) -> None:
    """Raise ValueError if points (time, whisker, view, node, 2) cannot be those of images."""
    most = int(np.isfinite(points).all(axis=4).sum(axis=3).max(initial=0))
    if most < 2:
        raise ValueError(f"no image has two known points of a whisker; the most are {most}")
    low, high = (np.where(np.isnan(points), end, points) for end in (np.inf, -np.inf))
    longest = float((high.max(axis=3) - low.min(axis=3)).max(initial=-np.inf))
    if 0.0 <= longest < _SHORTEST:
        raise ValueError(
            f"no whisker is longer than {longest:.2g} pixels: are its points in pixels, or in "
            "shares of the image?"
        )
    for one, other in itertools.combinations(range(len(views)), 2):
        if np.array_equal(points[:, :, one], points[:, :, other], equal_nan=True):
            raise ValueError(
                f"the views {views[one]} and {views[other]} have the same points: is a file given "
                "twice?"
            )


def _views(
    points: Array,
    tracks: xr.Dataset,
    cameras: Sequence[Camera] | None,
    pixel_size: float | None,
    notes: list[str],
) -> tuple[Camera, ...]:
    """Cameras of the views; without a calibration one or two orthogonal ones."""
    count = points.shape[2]
    if cameras is not None:
        shown = [str(name) for name in tracks["view"].values]
        if len(cameras) != count:
            raise ValueError(
                f"there are {len(cameras)} cameras for {count} views: {', '.join(shown)}"
            )
        # Files name their views in any order, often after the camera: camera_top, topDLC.
        fitting = [
            [camera for camera in cameras if camera.name == name]
            or [camera for camera in cameras if camera.name in name]
            for name in shown
        ]
        if sorted(c.name for each in fitting for c in each) == sorted(c.name for c in cameras):
            return tuple(each[0] for each in fitting)
        pairs = zip(shown, cameras, strict=True)
        listed = ", ".join(f"{name} is {camera.name}" for name, camera in pairs)
        notes.append(f"views are not named after cameras and are assigned in order: {listed}")
        return tuple(cameras)
    if count > 2:
        raise ValueError(f"{count} views need calibrated cameras")
    if pixel_size is None:
        raise ValueError(
            "points in images need calibrated cameras, or the size of a pixel: --cameras or "
            "--pixel-size (command line), cameras or pixel_size (Python)"
        )
    size = np.ceil(np.nanmax(points, axis=(0, 1, 2, 3)) + 1.0).astype(int)
    return orthogonal_views(pixel_size, (int(size[0]), int(size[1])))[:count]


def _identified(
    points: Array, names: list[str], asked: Sequence[str] | None, either: bool, notes: list[str]
) -> tuple[Array, list[str]]:
    """Points of whiskers with a constant identity, from base to tip, and their names.

    The tracker numbered them in each frame and view anew. Those asked for are returned, or else the
    longest of each view.
    """
    if asked is not None and min(points.shape[1:3]) > 1:
        raise ValueError(
            f"the tracker numbered {len(names)} whiskers in each view anew, so that it is unknown "
            "which belong together: omit --names, for the longest in each view, or "
            "identify them in the tracker (by the state of Whisk's measurements)"
        )
    notes.append("the tracker did not identify whiskers over time: each is followed by its ends")
    views = [_followed(points[:, :, [v]], either) for v in range(points.shape[2])]
    if either:
        notes.append("the end of each whisker that moves less is used as its base")
    if asked is not None:
        return np.concatenate(views, axis=2), names
    longest = [_longest(names, view, notes) for view in views]
    one = [view[:, [k]] for view, k in zip(views, longest, strict=True)]
    return np.concatenate(one, axis=2), [names[longest[0]]]


def _followed(points: Array, either: bool) -> Array:
    """Points (time, whisker, 1, node, axis) of one view, in the order of whiskers' first frames."""
    ends = _ends(points)
    out = np.full_like(points, np.nan)
    last = ends[0].copy()
    out[0] = points[0]
    for i in range(1, len(points)):
        same = np.linalg.norm(last[:, None] - ends[i][None], axis=-1).sum(axis=-1)
        turned = np.linalg.norm(last[:, None] - ends[i][None, :, ::-1], axis=-1).sum(axis=-1)
        cost = np.fmin(same, turned) if either else same
        rows, columns = optimize.linear_sum_assignment(np.where(np.isnan(cost), 1e6, cost))
        for row, column in zip(rows, columns, strict=True):
            if not np.isfinite(ends[i, column]).all():
                continue
            if np.isfinite(cost[row, column]):
                swap = either and turned[row, column] < same[row, column]
            elif np.isnan(last[row]).any():
                swap = False  # a whisker seen for the first time
            else:
                continue
            out[i, row] = _turned(points[i, column]) if swap else points[i, column]
            last[row] = ends[i, column, ::-1] if swap else ends[i, column]
    if either:
        spread = np.nanstd(_ends(out), axis=0).sum(axis=-1)
        for k in np.flatnonzero(spread[:, 0] > spread[:, 1]):
            out[:, k] = [_turned(one) for one in out[:, k]]
    return out


def _ends(points: Array) -> Array:
    """First and last known points (time, whisker, 2, axis) of a single view."""
    first = points[:, :, 0]
    known = np.asarray(np.isfinite(first).all(axis=-1))
    number = known.shape[-1]
    last = number - 1 - np.argmax(known[..., ::-1], axis=-1)
    begin, end = (
        np.take_along_axis(first, at[..., None, None], axis=-2)[..., 0, :]
        for at in (np.argmax(known, axis=-1), last)
    )
    return np.stack([begin, end], axis=-2)


def _turned(points: Array) -> Array:
    """Points (view, node, axis) in reverse order, the missing ones last."""
    out = np.full_like(points, np.nan)
    for view, one in enumerate(points):
        known = one[np.isfinite(one).all(axis=-1)]
        out[view, : len(known)] = known[::-1]
    return out


def _wanted(names: list[str], points: Array, asked: Sequence[str] | None) -> list[int]:
    """Indices of the whiskers to track."""
    if asked is not None:
        if unknown := sorted(set(asked) - set(names)):
            raise ValueError(f"there is no whisker {', '.join(unknown)}; these are {names}")
        return [names.index(name) for name in asked]
    return [int(k) for k in _often(names, points)]


def _often(names: list[str], points: Array) -> IntArray:
    """Indices of the whiskers that are seen in half of the frames."""
    known = np.isfinite(points).all(axis=-1)
    seen = (known.sum(axis=-1) >= _FEWEST).reshape(len(points), len(names), -1).all(axis=-1)
    share = seen.mean(axis=0)
    often = np.flatnonzero(share >= _USUAL)
    if not often.size:
        raise ValueError(
            f"no whisker has {_FEWEST} points or more in half of the frames: "
            f"{names[int(np.argmax(share))]} has them in {100.0 * share.max():.0f} % (points whose "
            f"confidence is below {_CONFIDENT:g} are dropped)"
        )
    return often


def _longest(names: list[str], points: Array, notes: list[str]) -> int:
    """Index of the longest whisker of those often seen in a view (time, whisker, 1, node, axis)."""
    often = _often(names, points)
    steps = np.linalg.norm(np.diff(points[:, :, 0], axis=2), axis=-1)
    length = np.nanmedian(np.nansum(steps, axis=-1), axis=0)
    longest = int(often[np.argmax(length[often])])
    if often.size > 1:
        notes.append(
            f"{often.size} whiskers are seen in half of the frames; the longest, {names[longest]}, "
            f"is used: choose others with --names ({', '.join(names[k] for k in often[:_SHOWN])}"
            f"{', …' if often.size > _SHOWN else ''})"
        )
    return longest


def _order_faults(points: Array, name: str, views: Sequence[str], nodes: list[str]) -> list[str]:
    """Notes on points (time, view, node, 2) of one whisker that may not run from base to tip."""
    each_view = np.moveaxis(points, 1, 0)
    notes = []
    for view, each in zip(views, each_view, strict=True):
        if not np.isfinite(each[:, 0]).all(axis=-1).any():
            base = f"{nodes[0]}, " if nodes else ""
            raise ValueError(f"{name}: its first point, {base}the base, is never known in {view}")
    base, tip = (np.median([_motion(each[:, k]) for each in each_view]) for k in (0, -1))
    if base > _STILLER * tip:
        notes.append(
            f"{name}: the first point, the base, moves by {base:.0f} pixels and the last by "
            f"{tip:.0f} (standard deviations): if the points run from tip to base, all results are "
            "wrong"
        )
    for view, each in zip(views, each_view, strict=True):
        known = np.isfinite(each).all(axis=-1).any(axis=0)
        if (gaps := np.flatnonzero(~known[: np.flatnonzero(known)[-1]])).size:
            listed = ", ".join(nodes[k] if nodes else f"point {k}" for k in gaps)
            notes.append(
                f"{name}: {listed} is never known in {view}, where the line between its neighbours "
                "is used instead"
            )
        folds = [_folded(one) for one in each]
        if not (often := [fold for fold in folds if fold is not None]):
            continue
        node = max(set(often), key=often.count)
        notes.append(
            f"{name}: in {len(often)} of {len(folds)} frames its points fold back in {view}, most "
            f"often at {nodes[node] if nodes else f'point {node}'}; these frames are left out, as "
            "the points may be exchanged"
        )
    return notes


def _interpolation_error(points: Array, sigma: float) -> float:
    """Error of the lines between points (time, node, 2), pixels, from lines without one of them."""
    away = []
    for row in points[np.linspace(0, len(points) - 1, min(len(points), _TESTED)).astype(int)]:
        known = row[np.isfinite(row).all(axis=1)]
        if len(known) < _FEWEST or _folded(row) is not None:
            continue
        kept = _thinned(known)
        s = arc_lengths(kept)
        for i in range(1, len(kept) - 1):
            rest = np.delete(np.arange(len(kept)), i)
            line = interpolate.make_interp_spline(s[rest], kept[rest], k=min(3, len(rest) - 1))
            away.append(np.linalg.norm(line(s[i]) - kept[i]))
    excess = np.percentile(away, 90.0) ** 2 - (_OF_NOISE * sigma) ** 2 if away else 0.0
    return float(_NARROWER * np.sqrt(max(excess, 0.0)))


def _motion(points: Array) -> float:
    """Standard deviation of the position of a point (time, 2); NaN if it is never known."""
    known = points[np.isfinite(points).all(axis=1)]
    return float(np.linalg.norm(known.std(axis=0))) if len(known) else np.nan


def _folded(points: Array) -> int | None:
    """Number of the point (n, 2) at which a line turns back on itself; None if it does not."""
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    step = np.diff(points[known], axis=0)
    # Near points may be in any order within their noise.
    far = np.linalg.norm(step, axis=1) > _SPACING
    back = (step[1:] * step[:-1]).sum(axis=1) < 0.0
    folds = np.flatnonzero(back & far[1:] & far[:-1])
    return int(known[folds[0] + 1]) if folds.size else None


def _in_two_views(
    space: Array, sigma: float | None, notes: list[str]
) -> tuple[Array, tuple[Camera, ...], float]:
    """Project points in space (time, whisker, node, 3) into two cameras; sigma in pixels."""
    every = space.reshape(-1, 3)
    every = every[np.isfinite(every).all(axis=1)]
    low, high = every.min(axis=0), every.max(axis=0)
    direction = np.nanmean(space[:, :, -1] - space[:, :, 0], axis=(0, 1))
    if not np.isfinite(direction).all() or not direction.any():
        direction = high - low
    cameras = _looking_across(0.5 * (low + high), float(np.linalg.norm(high - low)), direction)
    lengths = np.nansum(np.linalg.norm(np.diff(space, axis=2), axis=-1), axis=-1)
    if sigma is None:
        sigma = _SHARE * float(np.median(lengths[lengths > 0.0]))
    notes.append("points in space are tracked as two orthogonal views would show them")
    points = np.stack([camera.project(space) for camera in cameras], axis=2)
    return points, cameras, sigma * float(cameras[0].matrix[1, 1])


def _looking_across(middle: Array, extent: float, direction: Array) -> tuple[Camera, Camera]:
    """Two orthogonal cameras that share an axis along a direction; the second sees z upward."""
    along = np.array([direction[0], direction[1], 0.0])
    if np.linalg.norm(along) < 0.3 * np.linalg.norm(direction):
        along = direction
    along = along / np.linalg.norm(along)
    up = np.array([0.0, 0.0, 1.0]) if abs(along[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    up = up - (up @ along) * along
    up /= np.linalg.norm(up)
    side = np.cross(up, along)
    pixels = (_WIDE - 2.0 * _MARGIN) / extent
    center = 0.5 * (_WIDE - 1.0)
    matrix = np.array([[pixels, 0.0, center], [0.0, pixels, center], [0.0, 0.0, 1.0]])
    cameras = []
    for name, down in (("above", -side), ("across", -up)):
        rotation = np.array([along, down, np.cross(along, down)])
        size = (int(_WIDE), int(_WIDE))
        cameras.append(
            Camera(
                matrix,
                rotation,
                -rotation @ middle,
                size=size,
                projection="orthographic",
                name=name,
            )
        )
    return cameras[0], cameras[1]


def _trace(points: Array, sigma: float, tip: bool, named: bool) -> Trace:
    """Trace through the points (n, 2) of a whisker, from its base; lost without its base.

    The last of ``named`` points is the tip; lines of points without names differ in their number.
    """
    known = np.asarray(np.isfinite(points).all(axis=1))
    near_base = known[: max(1, len(points) // 4)].any()
    if known.sum() < _FEWEST or not near_base or _folded(points) is not None:
        return Trace.lost()
    kept = _thinned(points[known])
    step = np.linalg.norm(np.diff(kept, axis=0), axis=1)
    kept = kept[np.concatenate([[True], step > 1e-3])]
    if len(kept) < 2 or step.sum() < 2.0 * STEP:
        return Trace.lost()
    trace = given(kept)
    # Interpolated points between those of the tracker are not further measurements.
    scale = max(1.0, NODES / len(kept)) ** 0.5
    return trace._replace(
        sigma=np.full(len(trace.line), sigma * scale),
        base_seen=bool(known[0]),
        tip_seen=tip and (bool(known[-1]) or (not named and known.argmin() == known.sum())),
        sparse=True,
    )


def _thinned(points: Array) -> Array:
    """Average points that are nearer to each other than `_SPACING`; ends are kept."""
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    groups = int(length / _SPACING)
    if len(points) < 3 or groups >= len(points) - 2:
        return points
    inner = [group.mean(axis=0) for group in np.array_split(points[1:-1], max(groups, 1))]
    return np.vstack([points[:1], *inner, points[-1:]])
