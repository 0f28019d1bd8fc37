"""The whisker at rest, and where it is held, from its shapes in space over time.

Whatever bends the whisker changes its shape; how it is held only moves it. Frames whose shapes are
the same but for a rigid motion are therefore taken for frames without contact, if there are enough
of them: the largest such group. Their mean, each moved to where it fits best, is the rest shape.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vibrissa.whisker import Whisker

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Counts = NDArray[np.intp]

_COMMON = 0.85
"""Share of the usual length over which shapes are compared: tips are uncertain."""

_LEAST = 0.4
"""Share of that which must be seen to say whether the whisker is bent."""

_NEAR = 4.0
_LONGER = 1.1
_STILL = 0.01
_ENDS = 3
"""Frames at rest that show the tip, from which the length is taken."""

_SMOOTH = 4.0
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class RestShape:
    """The whisker at rest and where it would be if it were not bent.

    Parameters
    ----------
    points : array (n, 3)
        The mean shape, of unit spacing in arc length, in the frame of the best free frame, m.
    free : array (time,)
        Frames without contact.
    deviation : array (time,)
        Root mean square distance of each shape from the rest shape put on it, m; NaN where the
        whisker is missing.
    noise : float
        Usual deviation of the free frames, m.
    whole : bool
        Whether it ends at the whisker's tip; if not, its tip is not seen.
    """

    points: Array
    free: Mask
    deviation: Array
    noise: float
    whole: bool = True

    @property
    def spacing(self) -> float:
        """Of the points, m."""
        return float(np.median(np.linalg.norm(np.diff(self.points, axis=0), axis=1)))

    @property
    def length(self) -> float:
        """Along the points, m."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


def rest_shape(curves: Array, least: float = 0.1, tips: Mask | None = None) -> RestShape:
    """Find the rest shape among the shapes of a trial.

    Parameters
    ----------
    curves : array (time, node, 3)
        The whisker in every frame, equally spaced from base to tip, m; NaN where it is missing.
    least : float
        Share of the frames that are free of contact, at least.
    tips : array (time,), optional
        Frames in which the curve ends at the whisker's tip; by default all.

    Returns
    -------
    RestShape
        Points, free frames and deviations.

    Raises
    ------
    ValueError
        If the whisker is seen in less than three frames.
    """
    seen = np.isfinite(curves).all(axis=(1, 2))
    if seen.sum() < 3:
        raise ValueError(
            f"the whisker is seen in {int(seen.sum())} frames; at least 3 are needed for its shape"
        )
    shapes, known, compared, whole = _compared(curves[seen])
    part = shapes[whole, :compared]
    chords = np.linalg.norm(part[:, ::4, None, :] - part[:, None, ::4, :], axis=-1)
    best, near = _largest_group(chords.reshape(len(part), -1), least)
    group = np.flatnonzero(seen)[whole][near]
    length, ends = _length(curves[group], None if tips is None else tips[group])
    # The same once more, at places that divide this length evenly.
    first = np.flatnonzero(whole)[best]
    shapes, known, compared, whole = _compared(curves[seen], length / (curves.shape[1] - 1))
    near = np.isin(np.flatnonzero(seen)[whole], group)
    if not near.any():
        raise ValueError("no frame free of contact shows nearly the whole length of the whisker")
    part = shapes[whole, :compared]
    # The first may show less of the length than is compared now.
    mean = shapes[first, :compared] if whole[first] else part[near][0]
    deviation = np.full(len(shapes), np.inf)
    for _ in range(_ROUNDS):
        mean = np.median(_onto(part[near], mean), axis=0)
        deviation[whole] = _deviations(part, mean)
        usual = float(np.median(deviation[whole][near]))
        near = deviation[whole] < max(_NEAR * usual, 1e-9)
    rotation, shift = motions(part[near], mean)
    moved = np.einsum("tij,tnj->tni", rotation, shapes[whole][near]) + shift[:, None]
    points = np.nanmedian(moved[:, : curves.shape[1]], axis=0)
    # Where less of the whisker is seen, what is seen says whether it is bent.
    for i in np.flatnonzero(~whole & (known >= _LEAST * compared)):
        n = min(int(known[i]), len(points))
        deviation[i] = _deviations(shapes[i : i + 1, :n], points[:n])[0]
    noise = float(np.median(deviation[whole][near]))
    out = np.full(len(curves), np.nan)
    out[seen] = np.where(np.isfinite(deviation), deviation, np.nan)
    with np.errstate(invalid="ignore"):
        free = out < max(_NEAR * noise, 1e-9)
    return RestShape(points, free, out, noise, ends)


def _compared(curves: Array, spacing: float | None = None) -> tuple[Array, Counts, int, Mask]:
    """Shapes at equal lengths, how far each goes, how much is compared, and which show that."""
    _, shapes = aligned_lengths(curves, spacing)
    known = np.isfinite(shapes[:, :, 0]).sum(axis=1)
    compared = int(_COMMON * (curves.shape[1] - 1)) + 1
    whole = known >= compared
    if whole.sum() < 3:
        raise ValueError("hardly any two frames show the whisker over the same length")
    return shapes, known, compared, whole


def _length(curves: Array, tips: Mask | None) -> tuple[float, bool]:
    """Length of the whisker, m, and whether its tip is seen."""
    lengths = np.linalg.norm(np.diff(curves, axis=1), axis=2).sum(axis=1)
    ends = np.ones(len(curves), dtype=bool) if tips is None else tips
    whole = bool(ends.sum() >= _ENDS)
    # A part of a tip may be missed, but hardly is more seen than there is.
    return float(np.percentile(lengths[ends] if whole else lengths, 75.0)), whole


def known_rest(curves: Array, whisker: Whisker, least: float = 0.1) -> RestShape:
    """Find the frames in which a known whisker is at rest."""
    seen = np.isfinite(curves).all(axis=(1, 2))
    if seen.sum() < 3:
        raise ValueError(f"the whisker is seen in {int(seen.sum())} frames; 3 are needed at least")
    spacing, shapes = aligned_lengths(curves[seen])
    shown = spacing * (curves.shape[1] - 1)
    if shown > _LONGER * whisker.length:
        raise ValueError(
            f"the whisker is seen over {shown * 1e3:.1f} mm, but the known one is "
            f"{whisker.length * 1e3:.1f} mm long: it is another, or the scale is wrong"
        )
    s = np.arange(int(whisker.length / spacing) + 1) * spacing
    points = whisker.pose.to_source(whisker.position(np.minimum(s, whisker.length)))
    compared = int(_COMMON * (curves.shape[1] - 1)) + 1
    known = np.isfinite(shapes[:, :, 0]).sum(axis=1)
    out = np.full(len(curves), np.nan)
    for row, shape, count in zip(np.flatnonzero(seen), shapes, known, strict=True):
        n = min(int(count), len(points), compared)
        if n >= _LEAST * compared:
            out[row] = _deviations(shape[None, :n], points[:n])[0]
    lowest = np.sort(out[np.isfinite(out)])
    noise = float(np.median(lowest[: max(3, round(least * len(lowest)))]))
    free = np.zeros(len(curves), dtype=bool)
    if noise < _STILL * whisker.length:
        with np.errstate(invalid="ignore"):
            free = out < _NEAR * noise
    return RestShape(points, free, out, noise)


def _deviations(shapes: Array, target: Array) -> Array:
    square = ((_onto(shapes, target) - target) ** 2).sum(axis=2)
    return np.asarray(np.sqrt(square.mean(axis=1)))


def whisker_at_rest(shape: RestShape, name: str = "tracked", **properties: float) -> Whisker:
    """Make a whisker of the rest shape.

    Parameters
    ----------
    shape : RestShape
        Of the tracked frames.
    name : str
        Of the whisker.
    **properties
        Radius and material; see `vibrissa.Whisker`.

    Returns
    -------
    Whisker
        Its pose leads to the frame of the shape's points.
    """
    # Errors of neighbouring points go together, so that they look smoother than they are right.
    noise = _SMOOTH * shape.noise
    return Whisker.from_points(shape.points, noise=noise, name=name, **properties)  # type: ignore[arg-type]


def aligned_lengths(curves: Array, spacing: float | None = None) -> tuple[float, Array]:
    """Cut curves at the same arc lengths."""
    steps = np.linalg.norm(np.diff(curves, axis=1), axis=2)
    lengths = steps.sum(axis=1)
    count = curves.shape[1]
    # Some frames may show less of the whisker, hardly any more.
    if spacing is None:
        spacing = float(np.percentile(lengths, 75.0)) / (count - 1)
    s = np.arange(int(1.05 * count)) * spacing
    shapes = np.full((len(curves), len(s), 3), np.nan)
    for i, (curve, step) in enumerate(zip(curves, steps, strict=True)):
        at = np.concatenate([[0.0], np.cumsum(step)])
        at[-1] *= 1.0 + 1e-9
        for k in range(3):
            shapes[i, :, k] = np.interp(s, at, curve[:, k], right=np.nan)
    return spacing, shapes


def _largest_group(signatures: Array, least: float) -> tuple[int, Mask]:
    """Frame that has the nearest neighbours, and which frames are near it."""
    distance = np.sqrt(
        np.maximum(
            (signatures**2).sum(1)[:, None]
            + (signatures**2).sum(1)[None, :]
            - 2.0 * signatures @ signatures.T,
            0.0,
        )
    )
    rank = max(2, round(least * len(signatures)))
    radius = np.sort(distance, axis=1)[:, min(rank, len(signatures) - 1)]
    best = int(np.argmin(radius))
    return best, distance[best] <= max(2.0 * float(radius[best]), 1e-12)


def motions(shapes: Array, target: Array) -> tuple[Array, Array]:
    """Find the rigid motions that bring shapes nearest to a target."""
    n = min(shapes.shape[1], len(target))
    a, b = shapes[:, :n], target[:n]
    middle, goal = a.mean(axis=1), b.mean(axis=0)
    u, _, vt = np.linalg.svd(np.einsum("tni,nj->tij", a - middle[:, None], b - goal))
    sign = np.linalg.det(u @ vt)
    u[:, :, 2] *= sign[:, None]
    rotation = np.swapaxes(u @ vt, 1, 2)
    return rotation, goal - np.einsum("tij,tj->ti", rotation, middle)


def _onto(shapes: Array, target: Array) -> Array:
    rotation, shift = motions(shapes, target)
    moved: Array = np.einsum("tij,tnj->tni", rotation, shapes) + shift[:, None]
    return moved
