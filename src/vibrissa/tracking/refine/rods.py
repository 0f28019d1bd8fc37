"""Bent rods of many frames at once: their points, derivatives of these, and the roll they imply.

The part of a whisker without load keeps its curvature: if a whisker is bent in every frame, its
roll about the tangent at the base is the one with which bent rods come nearest to the shapes.

They are compared with the traces of one whisker over a trial, stored as arrays (`TraceSeries`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import Array, Mask, exponential, kernel
from vibrissa.rod import Discretization, discretize, shapes, solve_forces
from vibrissa.tracking.refine.peg import PEG_UNKNOWNS
from vibrissa.tracking.space.pose import BasePose
from vibrissa.tracking.trace.trace import Trace, arc_lengths, interpolated, nearest
from vibrissa.whisker import Whisker

NODES = 101  # number of points of a stored trace
_FLOOR = 0.05  # smallest standard deviation of a trace, pixels
_END = 1.0  # standard deviation of a trace's ends along it, pixels
# Distance, in pixels, from which the end of a trace is not the tip, and in standard deviations,
# from which an error shows that something else is wrong and is weighted down.
FAR = 6.0
# The same in standard deviations of where a trace begins.
_SPREAD = 3.0


@dataclass(frozen=True, eq=False)
class TraceSeries:
    """Traces of one whisker, NaN where it is lost."""

    line: Array  # (time, view, NODES, 2): column and row, equally spaced from base to tip
    sigma: Array  # (time, view, NODES): standard deviation across, pixels
    seen: Array  # (time, view, NODES): 1 where the whisker is seen, 0 where it is bridged
    confidence: Array  # (time, view), between 0 and 1
    # (time, view, 2): 1 where the whisker is seen to begin and to end there, less if that counts
    # less, else 0.
    ends: Array
    skew: Array  # (time, view): third cumulant of its darkness across it, pixels³
    shift: Array  # (time, view, 4): by how much a shaking camera moved the image; see `Trace`
    begin: Array  # (time, view): standard deviation of where it begins along it, pixels

    @classmethod
    def of(cls, traces: Sequence[Sequence[Trace]]) -> TraceSeries:
        """Resample traces."""
        shape = (len(traces[0]), len(traces), NODES)
        line, sigma, seen = np.full((*shape, 2), np.nan), np.full(shape, np.nan), np.zeros(shape)
        confidence, ends = np.zeros(shape[:2]), np.zeros((*shape[:2], 2))
        skew, shift = np.full(shape[:2], np.nan), np.zeros((*shape[:2], 4))
        begin = np.full(shape[:2], _END)
        for view, row in enumerate(traces):
            for i, trace in enumerate(row):
                n = len(trace.line)
                shift[i, view] = trace.shift
                if n < 2:
                    continue
                columns = np.column_stack([trace.line, trace.sigma, trace.seen])
                even = interpolated(np.linspace(0.0, n - 1.0, NODES), np.arange(n), columns)
                line[i, view], sigma[i, view], seen[i, view] = (
                    even[:, :2],
                    even[:, 2],
                    even[:, 3] > 0.5,
                )
                confidence[i, view], skew[i, view] = trace.confidence, trace.skew
                ends[i, view] = trace.base_seen, trace.tip_seen
                begin[i, view] = max(trace.begin_sigma, _END)
        return cls(line, sigma, seen, confidence, ends, skew, shift, begin)

    def rows(self, frames: NDArray[np.intp]) -> TraceSeries:
        """Select frames."""
        return TraceSeries(*(getattr(self, each.name)[frames] for each in fields(self)))

    @cached_property
    def tangent(self) -> Array:
        """Directions (time, view, NODES, 2) of the traces."""
        tangent = np.gradient(self.line, axis=2)
        return np.asarray(tangent / np.linalg.norm(tangent, axis=3, keepdims=True))

    @property
    def begun_apart(self) -> bool:
        """Whether views disagree in some frames about where the whisker begins."""
        return bool((self.begin > _END).any())

    @cached_property
    def longest(self) -> Array:
        """Largest distance (time, view) of neighbouring points of the traces, pixels."""
        return np.asarray(np.linalg.norm(np.diff(self.line, axis=2), axis=3).max(axis=2))

    def equations(self, view: int, pixels: Array, slopes: Array) -> tuple[Array, Array, Array]:
        """Distances of points, and of the ends, from a view's traces, derivatives, and weights."""
        count, n, _, unknowns = slopes.shape
        rows = np.zeros((count, n + 2, unknowns))
        misses, weights = np.zeros((2, count, n + 2))
        traces = self.line, self.sigma, self.tangent, self.ends, self.longest, self.begin
        compare(traces, view, pixels, np.ascontiguousarray(slopes), (rows, misses, weights))
        return rows, misses, weights


@kernel
def compare(traces: Any, view: int, pixels: Any, slopes: Any, found: Any) -> None:
    """Compare points with the traces of a view; all remains 0 where a trace is lost."""
    line, sigma, tangent, ends, longest, begin = traces
    rows, misses, weights = found
    n, nodes = pixels.shape[1], line.shape[2]
    for t in range(pixels.shape[0]):
        path, way = line[t, view], tangent[t, view]
        spacing = math.hypot(path[1, 0] - path[0, 0], path[1, 1] - path[0, 1])
        near = before = 0
        if not spacing > 0.0:
            continue
        for j in range(n):
            x, y = pixels[t, j, 0], pixels[t, j, 1]
            guess = min(max(2 * near - before, 0), nodes - 1)
            before, near = near, nearest(path, 0, nodes, x, y, longest[t, view], guess)
            along = (path[near, 0] - x) * way[near, 0] + (path[near, 1] - y) * way[near, 1]
            if not abs(along) <= 1.5 * spacing + 1.0:
                continue
            # Between two points of the trace its direction changes a little.
            other = min(max(near + (1 if along < 0.0 else -1), 0), nodes - 1)
            share = min(abs(along) / spacing, 1.0)
            tx = (1.0 - share) * way[near, 0] + share * way[other, 0]
            ty = (1.0 - share) * way[near, 1] + share * way[other, 1]
            size = math.sqrt(tx * tx + ty * ty)
            dx = (1.0 - share) * path[near, 0] + share * path[other, 0] - x
            dy = (1.0 - share) * path[near, 1] + share * path[other, 1] - y
            miss = (dy * tx - dx * ty) / size
            weight = 1.0 / math.sqrt(sigma[t, view, near] ** 2 + _FLOOR**2)
            # An error far above the usual shows that something else is wrong.
            weight /= math.sqrt(max(abs(miss) * weight / FAR, 1.0))
            misses[t, j], weights[t, j] = miss * weight, weight
            for k in range(slopes.shape[3]):
                pull = tx * slopes[t, j, 1, k] - ty * slopes[t, j, 0, k]
                rows[t, j, k] = pull / size * weight
        for end in range(2):
            j, i = (0, 0) if end == 0 else (n - 1, nodes - 1)
            tx, ty = way[i, 0], way[i, 1]
            gap = (path[i, 0] - pixels[t, j, 0]) * tx + (path[i, 1] - pixels[t, j, 1]) * ty
            # Where the whisker is taken to begin elsewhere at first, it also ends there.
            most = np.inf if end == 0 else max(FAR, _SPREAD * begin[t, view])
            counts = ends[t, view, end]
            if counts > 0.0 and abs(gap) * counts < most:
                sure = counts / (begin[t, view] if end == 0 else _END)
                misses[t, n + end], weights[t, n + end] = gap * sure, sure
                for k in range(slopes.shape[3]):
                    pull = tx * slopes[t, j, 0, k] + ty * slopes[t, j, 1, k]
                    rows[t, n + end, k] = pull * sure


UNKNOWNS = 10  # number of a frame's unknowns: shift (3), turn (3), s_c, f_x, f_y, f_z
_SAMPLES = 48  # number of points of a rod that are compared with the traces
# Contact of a free frame: no force, half-way along the whisker.
REST = np.array([0.5, 0.0, 0.0, 0.0])
# Arc lengths of contacts from which the fit may start, in units of L.
_STARTS = np.array([0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
# Weight of distances from the curves, in units of the usual one, as neighbours have errors in
# common; how far contacts usually slide from frame to frame, in units of L; and the distance of a
# rod that is not in balance.
_UNLIKE, _SLIDES, _WORST = 4.0, 0.05, 1e6
_CLOSE = 0.01  # step of forces, as a share of the largest one, after which there are no more
LIMITS = (0.1, 0.995)  # smallest and largest arc length of a contact, in units of L
_STEP = 1e-6  # step of differences by arc length and force, in units of L and EI/L²
_WILD = 1e6  # slopes of points of a rod, in units of L, above which it is not in equilibrium
_TINY = 1e-12  # sine of a turn below which its angle is the same
_FRAMES, _TURNS = 9, 24  # numbers of frames and of rolls from which that of a bent whisker is found


@dataclass(frozen=True, eq=False)
class State:
    """Pose and contact of some frames."""

    rotation: Array
    position: Array
    contact: Array
    peg: Array = field(default_factory=lambda: np.zeros(PEG_UNKNOWNS))  # see `UncertainPeg`

    def moved(self, step: Array, peg: Array | float = 0.0) -> State:
        """Change by (t, 10): shift, turn about the axes in which it is held, contact."""
        turn = exponential(step[:, 3:6])[0]
        contact = self.contact + step[:, 6:]
        contact[:, 0] = np.clip(contact[:, 0], *LIMITS)
        position = self.position + step[:, :3]
        return State(turn @ self.rotation, position, contact, self.peg + peg)

    def rows(self, rows: NDArray[np.intp]) -> State:
        """Select frames."""
        return State(self.rotation[rows], self.position[rows], self.contact[rows], self.peg)

    def put(self, rows: NDArray[np.intp], other: State) -> State:
        """The same with some frames of another state."""
        new = self.rotation.copy(), self.position.copy(), self.contact.copy()
        for own, array in zip(new, (other.rotation, other.position, other.contact), strict=True):
            own[rows] = array
        return State(*new, self.peg)

    def step_to(self, other: State) -> Array:
        """Step (t, 10) that moves here to another state; see `moved`."""
        about = turns(other.rotation @ np.swapaxes(self.rotation, 1, 2))
        return np.concatenate(
            [other.position - self.position, about, other.contact - self.contact], axis=1
        )

    def scaled(self, ratio: float) -> State:
        """The same in units of another length; the ratio is the old one over the new."""
        contact = self.contact * [ratio, *[ratio**-2] * 3]
        return State(self.rotation, ratio * self.position, contact, self.peg)


def turns(rotation: Array) -> Array:
    """Rotation vectors (t, 3) of rotations (t, 3, 3) by less than half a turn."""
    (_, xy, xz), (yx, _, yz), (zx, zy, _) = np.moveaxis(rotation, 0, -1)
    sine = 0.5 * np.stack([zy - yz, xz - zx, yx - xy], axis=1)
    size = np.maximum(np.sqrt((sine**2).sum(axis=1)), _TINY)
    angle = np.arctan2(size, 0.5 * (np.trace(rotation, axis1=1, axis2=2) - 1.0))
    return np.asarray(sine * (angle / size)[:, None])


class Bent(NamedTuple):
    """Points of bent rods relative to their bases, and how they move with their contacts."""

    turned: Array  # (t, n, 3), turned as the base is, units of L
    rows: NDArray[np.intp]  # (t,): where `change` has a frame; −1 without contact
    change: Array  # (4, n touching, n, 3): derivatives by the contact, whisker's frame
    rotation: Array  # (t, 3, 3) of the base

    @classmethod
    def of(cls, d: Discretization, state: State, touching: Mask, shown: float = 1.0) -> Bent:
        """Bend the visible share of rods."""
        loaded = state.contact[touching]
        # All rods without contact have the shape at rest.
        every = np.concatenate([REST[None], loaded, _ahead(loaded)])
        points, ahead = np.split(
            rods(d, every, np.linspace(0.0, shown, _SAMPLES)), [1 + len(loaded)]
        )
        ahead = ahead.reshape(4, len(loaded), _SAMPLES, 3)
        rows = np.where(touching, np.cumsum(touching) - 1, -1)
        with np.errstate(
            invalid="ignore", over="ignore"
        ):  # rods without equilibrium, which are `wild`
            turned = points[1 + rows] @ np.swapaxes(state.rotation, 1, 2)
            change = (ahead - points[1:]) / _STEP
        return cls(turned, rows, change, state.rotation)

    @property
    def wild(self) -> Mask:
        """Rods (t,) that are not in equilibrium."""
        wild: Mask = np.asarray(~np.isfinite(self.turned).all(axis=(1, 2)))
        wild[self.rows >= 0] |= ~(np.abs(self.change).max(axis=(0, 2, 3)) < _WILD)
        return wild

    def tangents(self, arcs: Array) -> tuple[Array, Array]:
        """Tangents (t, 3) at contacts' arc lengths (t,), and derivatives (t, 3, unknown)."""
        ends = np.clip(arcs[:, None] * (_SAMPLES - 1) + [-1.0, 1.0], 0.0, _SAMPLES - 1.0)
        low = np.minimum(ends.astype(int), _SAMPLES - 2)
        share = (ends - low)[..., None]

        def chords(points: Array, rows: NDArray[np.intp]) -> Array:
            t = np.arange(len(rows))[:, None]
            before, after = points[t, low[rows]], points[t, low[rows] + 1]
            return np.asarray(np.diff((1.0 - share[rows]) * before + share[rows] * after, axis=1))

        every, touching = np.arange(len(arcs)), np.flatnonzero(self.rows >= 0)
        chord = chords(self.turned, every)[:, 0]
        size = np.linalg.norm(chord, axis=1)
        tangent = chord / size[:, None]
        slopes = np.zeros((len(arcs), 3, UNKNOWNS))
        slopes[..., 3:6] = pose_slopes(tangent)[..., 3:]
        own = np.stack([chords(one, touching)[:, 0] for one in self.change], axis=-1)
        own = self.rotation[touching] @ own
        t = touching[:, None]
        ahead = self.turned[t, low[touching] + 1] - self.turned[t, low[touching]]
        own[..., 0] += (ahead[:, 1] - ahead[:, 0]) * (_SAMPLES - 1)
        along = tangent[touching]
        own -= along[:, :, None] * (along[:, None] @ own)
        slopes[touching, :, 6:] = own / size[touching, None, None]
        return tangent, slopes

    def normal(
        self, head: Array, rows: Array, misses: Array, weight: Array, hessian: Array, pull: Array
    ) -> Array:
        """Add weighted equations to normal equations; return the derivatives (t, n + 2, unknown).

        Rows (t, n + 2, 3) are derivatives by points, laboratory frame, in units of L, and ``head``
        the rotation (t, 3, 3) of the head.
        """
        design = np.empty((*misses.shape, UNKNOWNS))
        given = rows, misses, weight
        add_normal(self, np.ascontiguousarray(head), given, (design, hessian, pull))
        return design


@kernel
def add_normal(bent: Any, head: Any, equations: Any, normal: Any) -> None:
    """Add weighted equations to normal equations, and fill in their derivatives."""
    turned, at, change, rotation = bent
    rows, misses, weight = equations
    design, hessian, pull = normal
    n = turned.shape[1]
    row = np.empty(UNKNOWNS)
    for t in range(turned.shape[0]):
        for j in range(n + 2):
            i = j if j < n else (0 if j == n else n - 1)
            for a in range(3):
                row[a] = 0.0
                for b in range(3):
                    row[a] += rows[t, j, b] * head[t, b, a]
            x, y, z = turned[t, i, 0], turned[t, i, 1], turned[t, i, 2]
            row[3] = y * row[2] - z * row[1]
            row[4] = z * row[0] - x * row[2]
            row[5] = x * row[1] - y * row[0]
            for k in range(4):
                row[6 + k] = 0.0
            for b in range(3 if at[t] >= 0 else 0):
                own = (
                    row[0] * rotation[t, 0, b]
                    + row[1] * rotation[t, 1, b]
                    + row[2] * rotation[t, 2, b]
                )
                for k in range(4):
                    row[6 + k] += own * change[k, at[t], i, b]
            for a in range(UNKNOWNS):
                left = row[a] * weight[t, j]
                design[t, j, a] = left
                pull[t, a] += left * misses[t, j]
                for b in range(UNKNOWNS):
                    hessian[t, a, b] += left * row[b]


def placed(d: Discretization, state: State, shown: float = 1.0) -> Array:
    """Points (t, n, 3) of the visible share of the bent rods, units of L."""
    points = rods(d, state.contact, np.linspace(0.0, shown, _SAMPLES))
    return np.asarray(points @ np.swapaxes(state.rotation, 1, 2) + state.position[:, None])


def deformations(shifts: Array, points: Array, rotation: Array, free: Mask) -> Array:
    """How shifts (error, t, n, 3) of a whisker's points bend it, or seem to bend it.

    The rigid motion nearest to them is a motion of its base, and their mean over free frames,
    relative to the base, is a change of its shape at rest.
    """
    around = points - points.mean(axis=1, keepdims=True)
    motions = pose_slopes(around)
    inverse = np.linalg.inv(np.einsum("tnij,tnik->tjk", motions, motions))
    poses = np.einsum("tjk,tnik,etni->etj", inverse, motions, shifts)
    left = shifts - np.einsum("tnij,etj->etni", motions, poses)
    if free.any():
        rest = np.einsum("tij,etni->etnj", rotation[free], left[:, free]).mean(axis=1)
        left = left - np.einsum("tij,enj->etni", rotation, rest)
    return np.asarray(left)


def pose_slopes(turned: Array) -> Array:
    """Derivatives (..., 3, 6) of points, relative to the base, by its shift and its turn."""
    slopes = np.zeros((*turned.shape, 6))
    slopes[..., :3] = np.eye(3)
    x, y, z = np.moveaxis(turned, -1, 0)
    slopes[..., 0, 4], slopes[..., 0, 5] = z, -y
    slopes[..., 1, 3], slopes[..., 1, 5] = -z, x
    slopes[..., 2, 3], slopes[..., 2, 4] = y, -x
    return slopes


def _ahead(contact: Array) -> Array:
    """Contacts (4 t, 4) of which one value after the other is larger by a step."""
    return np.asarray((contact + _STEP * np.eye(4)[:, None]).reshape(-1, 4))


def rods(d: Discretization, contact: Array, s: Array) -> Array:
    """Points (t, n, 3) of rods with contacts (t, 4), whisker frame, units of L."""
    values, _ = solve_forces(d, contact)
    return shapes(d, values, np.ascontiguousarray(contact[:, 0]), s)


def contact_slopes(d: Discretization, state: State) -> tuple[Array, Array, Array]:
    """Contact points (t, 3) relative to the base, turned as it is, their derivatives (t, 3, 10).

    And those (t, 6, 4) of force and contact point, in the whisker's frame, by the contact.
    """
    value = solve_forces(d, state.contact)[0]
    ahead = solve_forces(d, _ahead(state.contact))[0].reshape(4, *value.shape)
    point, slope = value[:, 3:], np.moveaxis((ahead - value) / _STEP, 0, -1)
    turned = np.einsum("tij,tj->ti", state.rotation, point)
    both = np.concatenate([pose_slopes(turned), state.rotation @ slope[:, 3:]], axis=-1)
    return turned, both, slope


def first_contacts(d: Discretization, state: State, curves: Array, touching: Mask) -> Array:
    """Contacts (n, 4) of the touching frames that make the rod most similar to the curves.

    A light contact looks the same in many positions: among all paths along the whisker from frame
    to frame, the most probable is chosen.
    """
    contacts, costs = _contacts_at(d, state, curves, np.flatnonzero(touching))
    if not costs.size:
        return np.empty((0, 4))
    unlike = _UNLIKE * costs / np.median(costs.min(axis=0))
    apart = 0.5 * ((_STARTS[:, None] - _STARTS) / _SLIDES) ** 2
    total, before = unlike[:, 0], []
    for after in unlike.T[1:]:
        ways = total[:, None] + apart
        before.append(ways.argmin(axis=0))
        total = ways.min(axis=0) + after
    way = [int(total.argmin())]
    for back in reversed(before):
        way.append(int(back[way[-1]]))
    return np.asarray(contacts[way[::-1], np.arange(len(way))])


def _contacts_at(
    d: Discretization, state: State, curves: Array, rows: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Best contacts (start, n, 4) of some frames for each start, and distances (start, n)."""
    if not rows.size:
        return np.empty((len(_STARTS), 0, 4)), np.empty((len(_STARTS), 0))
    s = np.linspace(0.0, 0.95, 25)
    cut = [interpolated(s * d.length, arc_lengths(curve), curve, np.nan) for curve in curves[rows]]
    target = np.stack(cut) / d.length
    away = target - state.position[rows, None]
    wanted = np.einsum("tji,tnj->tni", state.rotation[rows], away).reshape(len(rows), -1)
    known = np.isfinite(wanted)
    wanted = np.where(known, wanted, 0.0)
    contacts, costs = [], []
    for place in _STARTS:
        contact = np.zeros((len(rows), 4))
        contact[:, 0] = place
        limit, tried = 2.0 / place**2, contact[:1]  # before the first step all are alike
        for _ in range(5):
            now = rods(d, tried, s).reshape(len(tried), -1) * known
            columns = []
            for k in (2, 3):
                ahead = tried.copy()
                ahead[:, k] += 1e-4
                columns.append((rods(d, ahead, s).reshape(len(tried), -1) * known - now) / 1e-4)
            design = np.stack(columns, axis=-1)
            square = np.swapaxes(design, 1, 2) @ design
            right = (np.swapaxes(design, 1, 2) @ (wanted - now)[..., None])[..., 0]
            step = np.linalg.solve(square + 1e-9 * np.eye(2), right[..., None])[..., 0]
            size = np.linalg.norm(step, axis=1, keepdims=True)
            contact[:, 2:] += step * np.minimum(1.0, limit / np.maximum(size, 1e-12))
            if size.max() < _CLOSE * limit:
                break
            tried = contact
        missed = rods(d, contact, s).reshape(len(rows), -1) * known - wanted
        contacts.append(contact)
        costs.append((missed**2).sum(axis=1))
    return np.stack(contacts), np.nan_to_num(np.stack(costs), nan=_WORST)


def rolled(pose: BasePose, curves: Array, whisker: Whisker) -> BasePose:
    """Pose with the roll that the bent shapes show."""
    known = np.flatnonzero(np.isfinite(pose.azimuth) & np.isfinite(curves).all(axis=(1, 2)))
    frames = known[np.linspace(0, len(known) - 1, min(_FRAMES, len(known))).astype(int)]
    d = discretize(whisker)

    def cost(roll: float) -> float:
        turned = replace(pose, roll=np.full(len(pose.azimuth), roll)).rotation[frames]
        state = State(turned, pose.position[frames] / d.length, np.zeros((len(frames), 4)))
        costs = _contacts_at(d, state, curves[frames], np.arange(len(frames)))[1]
        return float(costs.min(axis=0).sum())

    best, step = 0.0, 2.0 * np.pi / _TURNS
    tries = best + step * np.arange(_TURNS)
    while step > np.radians(1.0):
        best = float(tries[np.argmin([cost(roll) for roll in tries])])
        step /= 3.0
        tries = best + step * np.arange(-2, 3)
    roll = np.where(np.isfinite(pose.roll), best, np.nan)
    return replace(pose, roll=roll)
