"""Bent rods of many frames at once: their points, derivatives of these, and the roll they imply.

The part of a whisker without load keeps its curvature: if a whisker is bent in every frame, its
roll about the tangent at the base is the one with which bent rods come nearest to the shapes.

They are compared with the traces of one whisker over a trial, stored as arrays (`TraceSeries`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import transform
from vibrissa.numerics import Array, Mask
from vibrissa.rod import Discretization, discretize, shapes, solve_forces
from vibrissa.tracking.space.pose import BasePose
from vibrissa.tracking.trace.trace import Trace, arc_lengths, interpolated
from vibrissa.whisker import Whisker

NODES = 101  # number of points of a stored trace
_FLOOR = 0.05  # smallest standard deviation of a trace, pixels
_END = 1.0  # standard deviation of a trace's ends along it, pixels
# Distance, in pixels, from which the end of a trace is not the tip, and in standard deviations,
# from which an error shows that something else is wrong and is weighted down.
FAR = 6.0


@dataclass(frozen=True, eq=False)
class TraceSeries:
    """Traces of one whisker, NaN where it is lost."""

    line: Array  # (time, view, NODES, 2): column and row, equally spaced from base to tip
    sigma: Array  # (time, view, NODES): standard deviation across, pixels
    seen: Array  # (time, view, NODES): 1 where the whisker is seen, 0 where it is bridged
    confidence: Array  # (time, view), between 0 and 1
    ends: Array  # (time, view, 2): 1 where the whisker is seen to begin and to end there, else 0
    skew: Array  # (time, view): third cumulant of its darkness across it, pixels³
    shift: Array  # (time, view, 4): by how much a shaking camera moved the image; see `Trace`

    @classmethod
    def of(cls, traces: Sequence[Sequence[Trace]]) -> TraceSeries:
        """Resample traces."""
        shape = (len(traces[0]), len(traces), NODES)
        line, sigma, seen = np.full((*shape, 2), np.nan), np.full(shape, np.nan), np.zeros(shape)
        confidence, ends = np.zeros(shape[:2]), np.zeros((*shape[:2], 2))
        skew, shift = np.full(shape[:2], np.nan), np.zeros((*shape[:2], 4))
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
        return cls(line, sigma, seen, confidence, ends, skew, shift)

    def rows(self, frames: NDArray[np.intp]) -> TraceSeries:
        """Select frames."""
        return TraceSeries(*(getattr(self, each.name)[frames] for each in fields(self)))

    @cached_property
    def tangent(self) -> Array:
        """Directions (time, view, NODES, 2) of the traces."""
        tangent = np.gradient(self.line, axis=2)
        return np.asarray(tangent / np.linalg.norm(tangent, axis=3, keepdims=True))

    def equations(self, view: int, pixels: Array, slopes: Array) -> tuple[Array, Array, Array]:
        """Distances of points from the traces of a view, and their derivatives."""
        line, sigma, tangent = self.line[:, view], self.sigma[:, view], self.tangent[:, view]
        # All values of a lost trace are NaN, so any index will do.
        half = 0.5 * (line**2).sum(2)[:, None, :] - pixels @ np.swapaxes(line, 1, 2)
        near = np.argmin(half, axis=2)
        row = np.arange(len(line))[:, None]
        t, away = tangent[row, near], line[row, near] - pixels
        spacing = np.linalg.norm(line[:, 1] - line[:, 0], axis=1)
        along = (away * t).sum(axis=2)
        # Between two points of the trace its direction changes a little.
        other = np.clip(near - np.sign(along).astype(int), 0, NODES - 1)
        share = np.clip(np.abs(along) / spacing[:, None], 0.0, 1.0)[..., None]
        t = (1.0 - share) * t + share * tangent[row, other]
        t /= np.linalg.norm(t, axis=2, keepdims=True)
        chord = (1.0 - share) * line[row, near] + share * line[row, other] - pixels
        across = np.stack([-t[..., 1], t[..., 0]], axis=-1)
        miss = (chord * across).sum(axis=2)
        deviation = np.sqrt(sigma[row, near] ** 2 + _FLOOR**2)
        beyond = (np.abs(along) > 1.5 * spacing[:, None] + 1.0) | ~np.isfinite(miss)
        weight = np.where(beyond, 0.0, 1.0 / deviation)
        # An error far above the usual shows that something else is wrong.
        scaled = np.abs(miss) * weight
        weight = weight / np.sqrt(np.maximum(scaled / FAR, 1.0))
        across *= weight[..., None]
        rows = across[..., :1] * slopes[..., 0, :] + across[..., 1:] * slopes[..., 1, :]
        misses = miss * weight
        ends, gaps, shown = [], [], []
        for end in (0, -1):
            gap = ((line[:, end] - pixels[:, end]) * tangent[:, end]).sum(axis=1)
            counts = np.isfinite(gap) & (self.ends[:, view, end] > 0.5)
            counts &= (end == 0) | (np.abs(gap) < FAR)
            pull = np.einsum("ti,tij->tj", tangent[:, end], slopes[:, end]) / _END
            ends.append(np.where(counts[:, None], pull, 0.0))
            gaps.append(np.where(counts, gap / _END, 0.0))
            shown.append(np.where(counts, 1.0 / _END, 0.0))
        rows = np.concatenate([rows, np.stack(ends, axis=1)], axis=1)
        misses = np.concatenate([misses, np.stack(gaps, axis=1)], axis=1)
        weight = np.concatenate([weight, np.stack(shown, axis=1)], axis=1)
        return np.nan_to_num(rows), np.nan_to_num(misses), np.nan_to_num(weight)


UNKNOWNS = 10  # number of a frame's unknowns: shift (3), turn (3), s_c, f_x, f_y, f_z
_SAMPLES = 48  # number of points of a rod that are compared with the traces
# Arc lengths of contacts from which the fit may start, in units of L.
_STARTS = np.array([0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
# Weight of distances from the curves, in units of the usual one, as neighbours have errors in
# common; how far contacts usually slide from frame to frame, in units of L; and the distance of a
# rod that is not in balance.
_UNLIKE, _SLIDES, _WORST = 4.0, 0.05, 1e6
LIMITS = (0.1, 0.995)  # smallest and largest arc length of a contact, in units of L
# Steps of differences by arc length and force, in units of L and EI/L².
_STEPS = (1e-5, 1e-4, 1e-4, 1e-4)
_FRAMES, _TURNS = 9, 24  # numbers of frames and of rolls from which that of a bent whisker is found


@dataclass(frozen=True, eq=False)
class State:
    """Pose and contact of some frames."""

    rotation: Array
    position: Array
    contact: Array

    def moved(self, step: Array) -> State:
        """Change by (t, 10): shift, turn about the axes in which it is held, contact."""
        turn = transform.Rotation.from_rotvec(step[:, 3:6]).as_matrix()
        contact = self.contact + step[:, 6:]
        contact[:, 0] = np.clip(contact[:, 0], *LIMITS)
        return State(turn @ self.rotation, self.position + step[:, :3], contact)

    def rows(self, rows: NDArray[np.intp]) -> State:
        """Select frames."""
        return State(self.rotation[rows], self.position[rows], self.contact[rows])

    def put(self, rows: NDArray[np.intp], other: State) -> State:
        """The same with some frames of another state."""
        new = {name: array.copy() for name, array in vars(self).items()}
        for name, array in vars(other).items():
            new[name][rows] = array
        return State(**new)

    def step_to(self, other: State) -> Array:
        """Step (t, 10) that moves here to another state; see `moved`."""
        turn = other.rotation @ np.swapaxes(self.rotation, 1, 2)
        about = transform.Rotation.from_matrix(turn).as_rotvec()
        return np.concatenate(
            [other.position - self.position, about, other.contact - self.contact], axis=1
        )

    def scaled(self, ratio: float) -> State:
        """The same in units of another length; the ratio is the old one over the new."""
        contact = self.contact * [ratio, *[ratio**-2] * 3]
        return State(self.rotation, ratio * self.position, contact)


def bent(
    d: Discretization, state: State, touching: Mask, shown: float = 1.0
) -> tuple[Array, Array]:
    """Points of the visible share of the bent rods, and their derivatives."""
    s = np.linspace(0.0, shown, _SAMPLES)
    turned = rods(d, state.contact, s) @ np.swapaxes(state.rotation, 1, 2)
    slopes = np.zeros((*turned.shape, UNKNOWNS))
    slopes[..., :6] = pose_slopes(turned)
    rows = np.flatnonzero(touching)
    change = _differences(lambda contact: rods(d, contact, s), state.contact[rows])
    slopes[rows, ..., 6:] = state.rotation[rows, None] @ change
    return turned + state.position[:, None], slopes


def pose_slopes(turned: Array) -> Array:
    """Derivatives (..., 3, 6) of points, relative to the base, by its shift and its turn."""
    slopes = np.zeros((*turned.shape, 6))
    slopes[..., :3] = np.eye(3)
    x, y, z = np.moveaxis(turned, -1, 0)
    slopes[..., 0, 4], slopes[..., 0, 5] = z, -y
    slopes[..., 1, 3], slopes[..., 1, 5] = -z, x
    slopes[..., 2, 3], slopes[..., 2, 4] = y, -x
    return slopes


def _differences(values: Callable[[Array], Array], contact: Array) -> Array:
    """Central differences of values (t, ...) by the contact (t, 4); (t, ..., 4)."""
    columns = []
    for step, axis in zip(_STEPS, np.eye(4), strict=True):
        ahead, back = values(contact + step * axis), values(contact - step * axis)
        columns.append((ahead - back) / (2.0 * step))
    return np.stack(columns, axis=-1)


def rods(d: Discretization, contact: Array, s: Array) -> Array:
    """Points (t, n, 3) of rods with contacts (t, 4), whisker frame, units of L."""
    values, _ = solve_forces(d, contact)
    return shapes(d, values, np.ascontiguousarray(contact[:, 0]), s)


def contact_slopes(d: Discretization, state: State) -> tuple[Array, Array, Array]:
    """Contact points (t, 3) relative to the base, turned as it is, their derivatives (t, 3, 10).

    And those (t, 6, 4) of force and contact point, in the whisker's frame, by the contact.
    """
    point = solve_forces(d, state.contact)[0][:, 3:]
    slope = _differences(lambda each: solve_forces(d, each)[0], state.contact)
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
        for _ in range(5):
            now = rods(d, contact, s).reshape(len(rows), -1) * known
            columns = []
            for k in (2, 3):
                ahead = contact.copy()
                ahead[:, k] += 1e-4
                columns.append((rods(d, ahead, s).reshape(len(rows), -1) * known - now) / 1e-4)
            design = np.stack(columns, axis=-1)
            square = np.swapaxes(design, 1, 2) @ design
            right = (np.swapaxes(design, 1, 2) @ (wanted - now)[..., None])[..., 0]
            step = np.linalg.solve(square + 1e-9 * np.eye(2), right[..., None])[..., 0]
            size = np.linalg.norm(step, axis=1, keepdims=True)
            limit = 2.0 / place**2
            contact[:, 2:] += step * np.minimum(1.0, limit / np.maximum(size, 1e-12))
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
