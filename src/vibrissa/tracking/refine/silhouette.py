"""The peg that a whisker touches, found by its outline in images without whiskers.

The rod that was fitted to the traces shows where a whisker touches, but hardly how far along it:
by up to a millimetre. Across it the contact is known well, and the force is normal to the surface.
Among cylinders that touch there, of all radii and directions of the axis, and farther or less far
along the whisker, those are selected whose outlines are edges in the images of both views; then the
edges are measured, and the cylinder is fitted to them by least squares.

The outline of a cylinder consists of two lines, those of points whose normals n are normal to the
line of sight: with e the unit vector from the axis to the lens, w its length, and f = a × e,

    n = (R/w) e ± √(1 − (R/w)²) f.

At both of its lines a body is darker than what is around it, or at both brighter: else the two
could be the same edge. Of cylinders with such outlines the thickest is preferred, as thinner ones
are between an edge and a reflection. Dark lines, of which any two in two views meet in space, are
no cylinders. A view nearly along the axis shows hardly more than the ends of the peg, whose
contours are arcs from line to line; their heights are further unknowns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras import Camera
from vibrissa.deferred import ndimage
from vibrissa.io import Frame
from vibrissa.numerics import Array
from vibrissa.objects import Peg
from vibrissa.tracking.refine.edge import OFFSETS, place_of_outline
from vibrissa.tracking.refine.fit import RodFit, Touches
from vibrissa.tracking.refine.peg import PEG_UNKNOWNS, UNITS, UncertainPeg
from vibrissa.whisker import Whisker

_HALF = 8e-3  # length of the outline to each side of the contact that is compared, m
_AROUND = 16e-3  # half of the side of the part of an image that is searched, m
_DIRECTIONS = 16  # number of directions of edges that are distinguished
_SMOOTH = 1.0  # smoothing of images before edges are taken, pixels
# Change of brightness by pixel, as a share of the light, that is certainly an edge, and at least.
_CLEAR, _LEAST = 0.04, 0.012
_NEARLY = 2  # distance from an edge up to which an outline is on it at first, pixels
# Cylinders that are tried: directions of the axis to that across whisker and force, radii, m, and
# steps along the whisker, m, and the smallest and largest distance over which these are tried.
_TILTS = np.radians(np.arange(-75.0, 75.1, 7.5))
_RADII = np.geomspace(0.2e-3, 4e-3, 16)
_LEAN = 0.15  # range of the angle between axis and surface, due to errors of the force, rad
_SLIDE, _SLIDES, _FARTHEST = 0.35e-3, 3e-3, 6e-3
_GAP = 1.5e-4  # distance of contacts from a cylinder that is as bad as an outline without edge, m
_GAPS = 0.6  # weight of that
_THICKER = 0.15  # weight of twice the radius, as a share of an outline
_SEEN = 0.6  # share of each outline that must be an edge
# Length of the outline's lines in an image, in radii, from which ends are not needed.
_BROAD = 1.5
# Tilts of the axis, shifts of it, m, and heights of ends, m, that are tried for such a view.
_LEANS, _SHIFTS = np.linspace(-0.25, 0.25, 26), np.linspace(-1.5e-3, 1.5e-3, 21)
_RISE = 1.5e-3
_HEIGHTS = np.arange(2e-3, 45e-3, _RISE)
_TRIES = 6  # number of leans from which the peg is measured
_FAR_END = 0.5  # weight of the end that does not face the lens, which may be hidden
_ARC = 21  # number of points of the contour of an end
_POINTS = 65  # number of points of a line of the outline
_WINDOWS = (4.0, 3.0, 2.0, 2.0, 1.5, 1.5)  # largest distances of edges, pixels, step by step
_SHADED = (2.0, 2.0, 2.0)  # the same, where the shading of the peg is considered
_OFF = 0.7  # distance of an edge from the outline that makes it doubtful, pixels
_EDGE = 0.1  # standard deviation of where an edge is along all of an outline, pixels
# Standard deviation of the distance by which all outlines seem farther out, or all farther in, as a
# camera that does not respond to light linearly, or saturates, shows them, pixels.
_RESPONSE = 0.07
_TOGETHER = 256  # number of cylinders that are compared at once, the likeliest first
_FEWEST, _MOST_CONTACTS = 5, 25  # smallest number of contacts, and of those that are compared
# Standard deviation of all unknowns before, in their units; and if one view alone shows the peg.
_PRIOR, _NEARBY = 3.0, 0.5
# Smallest radius, pixels: both edges of a thinner peg are smoothed into those of a line.
_THINNEST = 2.5
_SMALLEST = 8  # smallest side of a part of an image, pixels
_INSIDE = 0.2  # share of an outline that must be in the image
_OUTWARD = 1e-5  # distance by which a point is moved to see what is outward, m
_ALONG_SIGHT = 1e-9  # smallest distance of an axis from a line of sight along it, m
_STEP, _HEIGHT = 1e-3, 1e-2  # step of differences; unit of the heights of ends, m
_LONG = 15.0  # extent, pixels, by which a line determines one number more
_FINE, _UPHILL = 0.25, 8  # distance of points across an outline, pixels; and of a top, in these
_RIGHT = 0.5  # root mean square distance of edges above which it is not a cylinder, pixels


# χ² of the difference of a peg with its contacts from that in the images, above which they are not
# on it; errors that contacts share make it up to 100.
_ELSEWHERE = 250.0
# Distance of contacts from the peg that they touch, m; and misfit of traces with it, over that
# without it, from which they touch something else.
_ON_PEG, _WORSE = 1e-4, 1.3
# What it costs in a frame that its contact is on a peg, and tangent to it, is at most χ² of two
# numbers if errors explain it: its median, and the standard deviation of the median of n, times √n.
_USUAL_COST, _VARIES = 2.0 * np.log(2.0), 2.0
_CERTAIN = 2.0  # force over its standard deviation from which a contact off the peg is one


def explains(
    seen: UncertainPeg, peg: UncertainPeg | None, misfit: Array, fit: RodFit, whisker: Whisker
) -> bool:
    """Whether contacts are on a peg, where it is seen, and traces fit as well as without it."""
    if peg is None or seen.differs(peg.expected) > _ELSEWHERE:
        return False
    known = np.isfinite(fit.contact_point).all(axis=1)
    gap = peg.expected.signed_distance(fit.contact_point[known])
    gap -= whisker.radius(fit.arc_length[known])
    before, after, free = (
        float(np.median(part[np.isfinite(part)])) if np.isfinite(part).any() else 0.0
        for part in (misfit[known], fit.misfit[known], fit.misfit[~known])
    )
    touches = np.mean(np.abs(gap) < _ON_PEG) >= _SEEN
    return bool(touches and after < _WORSE * max(before, free))


def bends_otherwise(excess: Array) -> bool:
    """Whether contacts on a peg cost too much in most frames; see `Fitter.excess`.

    A post with corners, or an elliptic one, may look like a round peg in both views.
    """
    n = len(excess)
    return n > 0 and bool(np.median(excess) > _USUAL_COST + _VARIES / np.sqrt(n))


def on_peg(peg: UncertainPeg, fit: RodFit, whisker: Whisker) -> RodFit:
    """A fit without contacts that are off the peg, and whose forces might as well be zero.

    Errors of traces that vary with the motion, as by its blur, bend a whisker in air.
    """
    gap = peg.expected.signed_distance(fit.contact_point) - whisker.radius(fit.arc_length)
    size = np.linalg.norm(fit.force, axis=1)
    spread = np.einsum("ti,tij,tj->t", fit.force, fit.wrench_covariance[:, :3, :3], fit.force)
    air = (gap > _ON_PEG) & (size**2 < _CERTAIN * np.sqrt(np.maximum(spread, 0.0)))
    values = {name: array.copy() for name, array in vars(fit).items()}
    for name in ("force", "moment", "wrench_covariance", "pose_wrench_covariance"):
        values[name][air] = 0.0
    for name in ("arc_length", "contact_point_whisker", "contact_point", "contact_covariance"):
        values[name][air] = np.nan
    values["shared"][air, :, :3] = values["shared"][air, :, 9:] = np.nan
    return RodFit(**values)


class _Cylinders(NamedTuple):
    """Cylinders by points on their axes (n, 3), unit axes (n, 3), and radii (n,)."""

    origin: Array
    axis: Array
    radius: Array

    @classmethod
    def of(cls, pegs: Sequence[Peg]) -> _Cylinders:
        """Collect pegs."""
        return cls(*(np.array([getattr(p, name) for p in pegs]) for name in cls._fields))

    def rows(self, rows: NDArray[np.intp]) -> _Cylinders:
        """Select cylinders."""
        return _Cylinders(*(part[rows] for part in self))


class _Outline(NamedTuple):
    """Points (..., point, 3) of the outline of cylinders, and normals of these there."""

    points: Array
    normals: Array


@dataclass(frozen=True, eq=False)
class _View:
    """Edges in the part of an image around the contacts."""

    camera: Camera
    bright: Array  # (row, column): cubic splines of the brightness, as a share of the light
    slopes: Array  # (2, row, column): change of brightness, smoothed, along columns and rows
    near: Array  # (direction, row, column): 1 where it is brighter toward it nearby, to 0
    corner: Array  # column and row of the first pixel

    @classmethod
    def of(cls, camera: Camera, frames: Sequence[Frame], center: Array) -> _View | None:
        """Static edges around a point; None if it is not in the images."""
        at, by = (part[0] for part in camera.project_with_slopes(center[None]))
        reach = _AROUND * float(np.linalg.norm(by, axis=1).max())
        shape = np.array(frames[0].shape[::-1])
        low = np.clip(np.floor(at - reach), 0, shape).astype(int)
        high = np.clip(np.ceil(at + reach), 0, shape).astype(int)
        if ((at < 0) | (at >= shape)).any() or (high - low).min() < _SMALLEST:
            return None
        # The median shows no whisker that moves.
        cut = [frame[low[1] : high[1], low[0] : high[0]] for frame in frames]
        part = _median(cut)
        part /= max(float(np.quantile(part, 0.9)), 1.0)
        down, right = np.gradient(ndimage.gaussian_filter(part, _SMOOTH))
        near = []
        for angle in np.arange(_DIRECTIONS) * 2.0 * np.pi / _DIRECTIONS:
            toward = np.cos(angle) * right + np.sin(angle) * down
            near.append(np.clip((_largest_near(toward) - _LEAST) / (_CLEAR - _LEAST), 0.0, 1.0))
        bright, slopes = ndimage.spline_filter(part), np.stack([right, down])
        return cls(camera, bright, slopes, np.array(near), low)

    @property
    def size(self) -> Array:
        """Number of columns and rows."""
        return np.array(self.near.shape[:0:-1])

    def project(self, points: Array) -> Array:
        """Columns and rows in the part, of points (..., 3)."""
        at = self.camera.project(points.reshape(-1, 3)) - self.corner
        return np.asarray(at.reshape(*points.shape[:-1], 2))

    def scale(self, point: Array) -> float:
        """Pixels per metre at a point (3,)."""
        return float(np.linalg.norm(self.camera.project_with_slopes(point[None])[1][0], 2))

    def sight(self, points: Array) -> Array:
        """Vectors from points (n, 3) to the lens, or vectors toward it if it is far away."""
        if self.camera.projection == "perspective":
            return np.asarray(-self.camera.rotation.T @ self.camera.translation - points)
        return np.broadcast_to(-1e3 * self.camera.rotation[2], points.shape)

    def _around(self, cylinders: _Cylinders) -> tuple[Array, Array, Array]:
        """Unit vectors (n, 3) across axes toward the lens and aside, and angles (n,) of lines."""
        axis = cylinders.axis
        away = self.sight(cylinders.origin)
        away = away - (away * axis).sum(axis=1, keepdims=True) * axis
        far = np.linalg.norm(away, axis=1)
        far = np.maximum(far, _ALONG_SIGHT)
        ahead = away / far[:, None]
        return ahead, np.cross(axis, ahead), np.arccos(np.minimum(cylinders.radius / far, 1.0))

    def lines(self, cylinders: _Cylinders, heights: Array) -> _Outline:
        """The two lines (n, 2, point, 3) of the outline, at heights (point,) along the axes."""
        origin, axis, radius = cylinders
        ahead, aside, angle = self._around(cylinders)
        angle = np.stack([angle, -angle], axis=1)[..., None]
        normals = np.cos(angle) * ahead[:, None] + np.sin(angle) * aside[:, None]
        on = origin[:, None] + radius[:, None, None] * normals
        points = on[:, :, None] + heights[:, None] * axis[:, None, None]
        return _Outline(points, np.broadcast_to(normals[:, :, None], points.shape))

    def end(self, cylinders: _Cylinders, heights: Array) -> _Outline:
        """Contours (n, point, 3) of ends at heights (n,) along the axes."""
        origin, axis, radius = cylinders
        ahead, aside, angle = self._around(cylinders)
        faces = (self.sight(origin + heights[:, None] * axis) * axis).sum(axis=1) * heights > 0.0
        # From line to line, around the back of an end that faces the lens.
        first = np.where(faces, angle, -angle)
        last = np.where(faces, 2.0 * np.pi - angle, angle)
        turn = (first[:, None] + (last - first)[:, None] * np.linspace(0.1, 0.9, _ARC))[..., None]
        normals = np.cos(turn) * ahead[:, None] + np.sin(turn) * aside[:, None]
        on = (origin + heights[:, None] * axis)[:, None] + radius[:, None, None] * normals
        return _Outline(on, normals)

    def traced(self, outline: _Outline) -> tuple[Array, Array]:
        """Columns and rows (..., 2) of an outline, and vectors normal to it that point outward."""
        at = self.project(outline.points)
        way = np.gradient(at, axis=-2)
        normal = np.stack([way[..., 1], -way[..., 0]], axis=-1)
        middle = at.shape[-2] // 2
        beyond = outline.points[..., middle, :] + _OUTWARD * outline.normals[..., middle, :]
        out = ((self.project(beyond) - at[..., middle, :]) * normal[..., middle, :]).sum(axis=-1)
        return at, np.where(out[..., None, None] < 0.0, -normal, normal)

    def edges(self, outline: _Outline) -> tuple[Array, NDArray[np.bool_]]:
        """How near points of outlines are to edges (2, ..., point), and which are in the image.

        To edges of a body that is darker than what is around it, and of a brighter one.
        """
        at, normal = self.traced(outline)
        angle = np.arctan2(normal[..., 1], normal[..., 0]) * (0.5 * _DIRECTIONS / np.pi)
        index = np.rint(angle).astype(int)
        column, row = np.moveaxis(np.rint(at), -1, 0)
        inside = (column >= 0) & (column < self.size[0]) & (row >= 0) & (row < self.size[1])
        pixel = np.where(inside, column + row * self.size[0], 0).astype(int)
        near = self.near.reshape(_DIRECTIONS, -1)
        edges = [near[(index + turned) % _DIRECTIONS, pixel] for turned in (0, _DIRECTIONS // 2)]
        return np.where(inside, edges, 0.0), inside

    def shares(self, outline: _Outline) -> Array:
        """How much of each part of outlines is an edge (2, ...); little if it is hardly shown."""
        edges, inside = self.edges(outline)
        count = np.maximum(inside.sum(axis=-1), _INSIDE * inside.shape[-1])
        return np.asarray(edges.sum(axis=-1) / count)

    def extent(self, peg: Peg) -> list[tuple[float, float]]:
        """Range of heights (m) of each end, below and above, by where the lines end."""
        found = []
        for sign in (-1.0, 1.0):
            lines = self.lines(_Cylinders.of([peg]), sign * np.append(0.0, _HEIGHTS))
            edges, inside = self.edges(lines)
            seen = edges[:, 0].mean(axis=1).max(axis=0) > _SEEN
            last = int(np.argmin(np.append(seen, False)))
            shown = inside[0].all(axis=0)
            beyond = last < len(shown) and bool(shown[last])
            low = float(np.append(0.0, _HEIGHTS)[max(last - 1, 0)])
            found.append((low - _RISE, low + 2.0 * _RISE if beyond else np.inf))
        return found


def _median(frames: Sequence[Frame]) -> Array:
    """Median of images, pixel by pixel: by sorting whole images, a tenth of the usual time."""
    images, last = list(frames), len(frames) - 1
    for step in range(len(images)):
        for i in range(step % 2, last, 2):
            pair = images[i], images[i + 1]
            images[i], images[i + 1] = np.minimum(*pair), np.maximum(*pair)
    return np.asarray(0.5 * (images[last // 2].astype(np.float64) + images[-(-last // 2)]))


def _largest_near(values: Array) -> Array:
    """Largest value within `_NEARLY` pixels along rows and columns."""
    for axis in (0, 1):
        near = np.moveaxis(values.copy(), axis, 0)
        given = np.moveaxis(values, axis, 0)
        for k in range(1, _NEARLY + 1):
            np.maximum(near[:-k], given[k:], out=near[:-k])
            np.maximum(near[k:], given[:-k], out=near[k:])
        values = np.moveaxis(near, 0, axis)
    return values


def peg_in_images(
    cameras: Sequence[Camera], sample: Sequence[Sequence[Frame]], touches: Touches
) -> UncertainPeg | None:
    """Find the peg that is touched in frames of two views; None if no cylinder shows in both."""
    if len(touches.points) < _FEWEST or not all(np.isfinite(part).all() for part in touches):
        return None
    away = np.linalg.norm(touches.points - np.median(touches.points, axis=0), axis=1)
    middle = int(away.argmin())
    center = touches.points[middle]
    views = [_View.of(*pair, center) for pair in zip(cameras, sample, strict=True)]
    if len(views) != 2 or any(view is None for view in views):
        return None
    seen = [view for view in views if view is not None]
    peg = _likeliest(seen, touches, middle)
    if peg is None:
        return None
    sights = [view.sight(peg.origin[None])[0] for view in seen]
    shown = [float(np.linalg.norm(np.cross(peg.axis, s)) / np.linalg.norm(s)) for s in sights]
    least = int(np.argmin(shown))
    if 2.0 * _HALF * shown[least] > _BROAD * peg.radius:
        found = _accepted(_measured(seen, peg), seen)
        if found is not None:
            return found
    others = [view for i, view in enumerate(seen) if i != least]
    broad = _measured(others, peg, prior=_NEARBY)
    if broad is None:
        return None
    for tried, ends in _with_ends(seen[least], others[0], broad.peg, touches):
        found = _accepted(_measured(seen, tried, ends, seen[least]), seen)
        if found is not None:
            return found
    return None


def _likeliest(views: Sequence[_View], touches: Touches, middle: int) -> Peg | None:
    """The best of many cylinders that one of the contacts may touch."""
    center, normal, along = (part[middle] for part in touches[:3])
    aside = np.cross(normal, along)
    reach = min(max(_SLIDES, 3.0 * touches.sigma), _FARTHEST)
    heights = np.linspace(-_HALF, _HALF, _POINTS // 3)
    grid = [_TILTS, _RADII, np.arange(-reach, reach + _SLIDE, _SLIDE), np.zeros(1)]
    for finer in (True, False):
        tilt, radius, slide, lean = np.array(np.meshgrid(*grid)).reshape(4, -1)
        axis = np.cos(tilt)[:, None] * aside + np.sin(tilt)[:, None] * along
        axis = np.cos(lean)[:, None] * axis + np.sin(lean)[:, None] * normal
        across = normal - (axis @ normal)[:, None] * axis
        across *= ((radius + touches.radius[middle]) / np.linalg.norm(across, axis=1))[:, None]
        tried = _Cylinders(center + slide[:, None] * along - across, axis, radius)
        part = _sides(views[0], tried, heights) - _gaps(tried, touches, slide)
        part += _THICKER * np.log2(radius / _RADII[0])
        score = np.full(len(part), -np.inf)
        for some in np.array_split(np.argsort(-part), -(-len(part) // _TOGETHER)):
            # The other view adds at most 1.
            if part[some[0]] + 1.0 < score.max():
                break
            score[some] = part[some] + _sides(views[1], tried.rows(some), heights)
        best = int(score.argmax())
        if finer:
            fine = np.linspace(-0.5, 0.5, 5)
            grid = [
                tilt[best] + np.ptp(_TILTS[:2]) * fine,
                radius[best] * (_RADII[1] / _RADII[0]) ** fine,
                slide[best] + _SLIDE * fine,
                _LEAN * fine,
            ]
    found = tried.rows(np.array([best]))
    if min(float(_sides(view, found, heights)[0]) for view in views) < 0.5 * _SEEN:
        return None
    return Peg(*(part[0] for part in found))


def _sides(view: _View, tried: _Cylinders, heights: Array) -> Array:
    """How much (n,) of the two lines of cylinders is an edge, of a dark or a bright body."""
    return np.asarray(view.shares(view.lines(tried, heights)).mean(axis=-1).max(axis=0))


def _gaps(tried: _Cylinders, touches: Touches, slide: Array) -> Array:
    """Loss (n,) by distances of cylinders from contacts, which are moved along the whisker."""
    some = slice(None, None, -(-len(touches.points) // _MOST_CONTACTS))
    away = touches.points[some] + slide[:, None, None] * touches.tangents[some]
    away = away - tried.origin[:, None]
    away -= np.einsum("cni,ci->cn", away, tried.axis)[..., None] * tried.axis[:, None]
    gap = np.linalg.norm(away, axis=2) - tried.radius[:, None] - touches.radius[some]
    return np.asarray(_GAPS * np.minimum((gap / (3.0 * _GAP)) ** 2, 1.0).mean(axis=1))


def _with_ends(
    view: _View, other: _View, peg: Peg, touches: Touches
) -> Iterator[tuple[Peg, Array]]:
    """Pegs and heights of their ends, as far as they are seen, by a view along them; best first.

    They are moved and lean along the line of sight of the other view, which does not show that.
    """
    aside = other.sight(peg.origin[None])[0]
    aside = aside - (aside @ peg.axis) * peg.axis
    aside /= np.linalg.norm(aside)
    leans, shift = np.array(np.meshgrid(_LEANS, _SHIFTS)).reshape(2, -1)
    axis = peg.axis + leans[:, None] * aside
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    tried = _Cylinders(peg.origin + shift[:, None] * aside, axis, np.full(len(leans), peg.radius))
    heights = np.linspace(-_HALF, _HALF, _POINTS // 2)
    score = _sides(view, tried, heights)
    # Contacts may be elsewhere along the whisker.
    slides = np.arange(-touches.sigma, 1.01 * touches.sigma, max(_SLIDE, 0.2 * touches.sigma))
    score -= np.min([_gaps(tried, touches, np.full(len(leans), s)) for s in slides], axis=0)
    facing = np.sign(view.sight(peg.origin[None])[0] @ peg.axis)
    ends, shares = [], []
    for (low, high), sign in zip(other.extent(peg), (-1.0, 1.0), strict=True):
        heights = sign * _HEIGHTS[(low <= _HEIGHTS) & (high >= _HEIGHTS)]
        if not len(heights):
            continue
        each = [view.shares(view.end(tried, np.full(len(leans), h))) for h in heights]
        share = np.max(each, axis=1)
        score += (1.0 if sign == facing else _FAR_END) * share.max(axis=0)
        ends.append(heights[share.argmax(axis=0)])
        shares.append(share.max(axis=0))
    for lean in _LEANS[np.argsort(-score.reshape(len(_SHIFTS), -1).max(axis=0))[:_TRIES]]:
        best = int(np.where(leans == lean, score, -np.inf).argmax())
        found = [e[best] for e, s in zip(ends, shares, strict=True) if s[best] > _SEEN]
        yield Peg(*(part[best] for part in tried)), np.array(found)


class _Measured(NamedTuple):
    """A peg with its covariance, and the edges at its outline."""

    peg: Peg
    covariance: Array
    parts: list[_Part]


def _measured(
    views: Sequence[_View],
    start: Peg,
    ends: Array | None = None,
    along: _View | None = None,
    prior: float = _PRIOR,
) -> _Measured | None:
    """Fit a cylinder to the edges at its outline, and to its ends in a view along it."""
    peg, ends = start, np.zeros(0) if ends is None else ends
    for step, window in enumerate(_WINDOWS + _SHADED):
        parts = [
            part
            for view in views
            for part in _edges(view, peg, ends, window, with_ends=view is along)
        ]
        if step >= len(_WINDOWS):
            parts = [part.shaded() for part in parts]
        count = PEG_UNKNOWNS + len(ends)
        information, pull = np.eye(count) / prior**2, np.zeros(count)
        for part in parts:
            information += part.by.T @ (part.weight[:, None] * part.by)
            pull += part.by.T @ (part.weight * part.miss)
        covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        change = covariance @ pull
        peg = UncertainPeg(peg, np.eye(PEG_UNKNOWNS)).at(change[:PEG_UNKNOWNS])
        ends = ends + _HEIGHT * change[PEG_UNKNOWNS:]
    if not any(len(part.miss) for part in parts):
        return None
    return _Measured(peg, covariance[:PEG_UNKNOWNS, :PEG_UNKNOWNS], parts)


def _accepted(found: _Measured | None, views: Sequence[_View]) -> UncertainPeg | None:
    """The peg, if all parts of its outline are edges, and it is thicker than a line."""
    if found is None:
        return None
    if found.peg.radius * min(view.scale(found.peg.origin) for view in views) < _THINNEST:
        return None
    miss = np.concatenate([part.miss * (_EDGE / part.sigma) for part in found.parts])
    if min(part.share for part in found.parts) < _SEEN or np.mean(miss**2) > _RIGHT**2:
        return None
    covariance = found.covariance.copy()
    scale = np.mean([view.scale(found.peg.origin) for view in views])
    covariance[-1, -1] += (_RESPONSE / scale / UNITS[-1]) ** 2
    return UncertainPeg(found.peg, covariance)


class _Part(NamedTuple):
    """Edges along a part of an outline: distances (n,), derivatives (n, unknown), and weights."""

    miss: Array
    by: Array
    certain: float  # number of numbers that it determines
    share: float  # of it that is an edge
    bright: Array  # (n, offset): brightness across it
    radius: float  # of the peg, pixels
    place: float = 0.0  # where all of it is, by the brightness across it, pixels
    sigma: float = _EDGE  # standard deviation of that, pixels

    @property
    def weight(self) -> Array:
        """Weights (n,) of the distances, which are all together as certain as the line."""
        alike = self.certain / (self.sigma**2 * max(len(self.miss), 1))
        return np.asarray(alike / (1.0 + ((self.miss - self.place) / _OFF) ** 2) ** 2)

    def shaded(self) -> _Part:
        """The part where the brightness across it shows that it is, instead of its steepest."""
        place, sigma = place_of_outline(self.bright, self.radius)
        if not np.isfinite(sigma):
            return self
        moved = self.miss + place - np.median(self.miss)
        return self._replace(miss=moved, place=place, sigma=float(np.hypot(sigma, _EDGE)))


def _edges(view: _View, peg: Peg, ends: Array, window: float, with_ends: bool) -> list[_Part]:
    """Edges near the outline of a peg in a view."""
    uncertain = UncertainPeg(peg, np.eye(PEG_UNKNOWNS))
    changed = [peg, *(uncertain.at(_STEP * one) for one in np.eye(PEG_UNKNOWNS))]
    changed += [peg] * len(ends)
    cylinders = _Cylinders.of(changed)
    heights = np.tile(ends, (len(changed), 1))
    for k in range(len(ends)):
        heights[1 + PEG_UNKNOWNS + k, k] += _STEP * _HEIGHT
    low, high = max(-_HALF, ends.min(initial=-_HALF)), min(_HALF, ends.max(initial=_HALF))
    lines = view.lines(cylinders, np.linspace(low, high, _POINTS))
    outlines = [_Outline(*(part[:, side] for part in lines)) for side in range(2)]
    if with_ends:
        outlines = [view.end(cylinders, height) for height in heights.T] or outlines
    parts = []
    for outline in outlines:
        at, normal = view.traced(_Outline(*(part[0] for part in outline)))
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        inside = np.all((at > window) & (at < view.size - 1 - window), axis=1)
        miss, found = _nearest_edges(view.slopes, at, normal, window)
        found &= inside
        moved = view.project(outline.points[1:])[:, found]
        by = np.moveaxis(((moved - at[found]) * normal[found]).sum(axis=-1), 0, 1) / _STEP
        # A long line determines two numbers, its place and its direction; a short one hardly one.
        extent = float(np.linalg.norm(np.ptp(at[found], axis=0))) if found.any() else 0.0
        certain = min(2.0, 0.2 + extent / _LONG)
        share = found.sum() / inside.sum() if inside.sum() > _INSIDE * len(at) else 1.0
        across = (at[found, None] + OFFSETS[:, None] * normal[found, None])[..., ::-1]
        bright = ndimage.map_coordinates(
            view.bright, np.moveaxis(across, -1, 0), mode="nearest", prefilter=False
        )
        pixels = peg.radius * view.scale(peg.origin)
        parts.append(_Part(miss[found], by, certain, float(share), bright, pixels))
    return parts


def _nearest_edges(
    slopes: Array, line: Array, normal: Array, window: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Distances (n,) of the strongest edges from points of an outline, and where there are any."""
    off = np.arange(-window, window + 0.01, _FINE)
    at = line[:, None] + off[:, None] * normal[:, None]
    along, down = (
        ndimage.map_coordinates(slope, [at[..., 1], at[..., 0]], order=1, mode="nearest")
        for slope in slopes
    )
    rise = along * normal[:, :1] + down * normal[:, 1:]
    # The body is darker than what is around it along all of the outline, or brighter.
    rise *= np.sign(np.sum(np.median(rise, axis=0))) or 1.0
    # Of two clear edges the nearer one is taken, even if the other is that of a glint.
    best = (np.minimum(rise, _CLEAR) * np.exp(-0.5 * (off / window) ** 2)).argmax(axis=1)
    each, last = np.arange(len(best)), len(off) - 1
    for _ in range(_UPHILL):
        around = np.clip(best[:, None] + np.array([0, -1, 1]), 0, last)
        best = around[each, rise[each[:, None], around].argmax(axis=1)]
    best = best.clip(1, last - 1)
    before, top, after = (rise[each, best + k] for k in (-1, 0, 1))
    bend = before - 2.0 * top + after
    share = np.where(bend < 0.0, 0.5 * (before - after) / np.where(bend < 0.0, bend, -1.0), 0.0)
    miss = off[best] + _FINE * np.clip(share, -1.0, 1.0)
    return miss, (top > _LEAST) & (np.abs(miss) < window - 0.1)
