"""Wrench that inertia and damping add while a whisker is held at known points.

The chain of :mod:`vibrissa.simulation.dynamics` is moved at its base and slides, without friction,
through a given point of the laboratory while it is in contact there, and vibrates freely otherwise.
A chain without mass and damping that goes through the same points has the same contact points in
statics, so that the difference of their wrenches is what a measured wrench has too much. The error
of the chain, of second order in its links, is in both.
"""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import AnyArray, Array
from vibrissa.simulation.chain import Chain, bezier
from vibrissa.simulation.dynamics import (
    Contact,
    Dynamics,
    Path,
    Walk,
    damping_time,
    frequencies,
)
from vibrissa.whisker import Whisker

_SEGMENTS = 16
"""Number of segments of the chains."""

_STEP = 0.4
"""Longest step, as a share of the time in which the first vibration turns by one radian."""

_HOLD = 5e3
"""Stiffness with which a point is held, over EI/L³ at the base."""

_WEIGHTLESS = 1e-6
"""Share of the mass that the chain without mass has."""

_PROXIMAL = 0.02
"""Smallest arc length at which a chain is held, over L."""


def inertial_wrench(
    whisker: Whisker,
    dynamics: Dynamics,
    time: Array,
    rotation: Array,
    position: Array,
    points: Array,
    arc_length: Array,
    most: float = np.inf,
) -> Array:
    """Part of the wrench (n, 6) at the base that is due to inertia and damping, SI units.

    Points of the centreline are held, laboratory frame, NaN where nothing is touched; only the
    first arc length of a contact counts. Where a chain without mass would need a force above
    ``most``, the point of the nearest frame takes its place, or the contact ends.
    """
    frame = float(time[-1] - time[0]) / (len(time) - 1)
    chain = Chain.of(whisker, dynamics.density, _SEGMENTS)
    parts = int(np.ceil(frame * 2.0 * np.pi * float(frequencies(chain, 1)[0]) / _STEP))
    damping = damping_time(chain, dynamics.damping_ratio)
    light = Chain.of(whisker, (_WEIGHTLESS * dynamics.density[0],) * 2, _SEGMENTS)
    still = Path(time, rotation, position, frame)
    for instead in (_nearest, _until, None):
        resting, force = _Held(whisker, light, 0.0, frame).wrench(still, points, arc_length)
        if instead is None or not (force > most).any():
            break
        points = instead(points, force > most)
    path = Path(time, rotation, position, frame / parts)
    moving, _ = _Held(whisker, chain, damping, path.step).wrench(path, points, arc_length)
    return moving - resting


def _nearest(points: Array, wrong: AnyArray) -> Array:
    """Points of which those that are wrong are those of the nearest other frames."""
    right = np.flatnonzero(np.isfinite(points).all(axis=1) & ~wrong)
    if not right.size:
        return np.full_like(points, np.nan)
    out = points.copy()
    for row in np.flatnonzero(wrong):
        out[row] = points[right[np.argmin(np.abs(right - row))]]
    return out


def _until(points: Array, wrong: AnyArray) -> Array:
    """Points of contacts that end where they are wrong."""
    out = points.copy()
    for row in range(len(points)):
        if wrong[row] or (row and np.isfinite(points[row - 1]).all() and np.isnan(out[row - 1, 0])):
            out[row] = np.nan
    return out


class _Held(Walk):
    """Chain that slides through one point."""

    turned = 1e-6
    rounds = 12

    def __init__(self, whisker: Whisker, chain: Chain, damping: float, step: float) -> None:
        bending = whisker.youngs_modulus * np.pi / 4.0 * whisker.base_radius**4
        stiffness = _HOLD * bending / whisker.length**3
        super().__init__(whisker, chain, (), damping, (stiffness,), 0.0, step)
        self._point: Array | None = None
        self._at = 0.0

    def wrench(self, path: Path, points: Array, arc_length: Array) -> tuple[Array, Array]:
        """Wrench (n, 6) and force (n,) that holds the point in every frame."""
        parts = (path.count - 1) // (len(points) - 1)
        turns, places = path.at(np.arange(path.count))
        # A point is held from its first frame to its last; NaN on either side gives NaN.
        time = np.arange(path.count) / parts
        first = time.astype(int)
        share = (time - first)[:, None]
        held = np.where(
            share > 0.0,
            (1.0 - share) * points[first] + share * points[np.minimum(first + 1, len(points) - 1)],
            points[first],
        )
        self.begin(turns[:4], places[:4])
        out, force = np.empty((len(points), 6)), np.zeros(len(points))
        for number, (turn, place, point) in enumerate(zip(turns, places, held, strict=True)):
            there = bool(np.isfinite(point).all())
            if there and self._point is None:
                self._at = float(arc_length[first[number]])
            self._point = point if there else None
            moment = self.step(turn, place)
            if share[number, 0] == 0.0:
                out[first[number]] = np.concatenate([moment.force @ turn, moment.moment @ turn])
                gaps = [contact.gap for contact in moment.contacts]
                force[first[number]] = self._stiffness[0] * np.linalg.norm(gaps)
        return out, force

    def _contacts(self) -> list[Contact]:
        """Contact with the point, in two directions across the whisker."""
        if self._point is None:
            return []
        nodes = self._chain.nodes
        for _ in range(3):
            segment = int(np.clip(np.searchsorted(nodes, self._at) - 1, 0, nodes.size - 2))
            part = (self._at - nodes[segment]) / (nodes[segment + 1] - nodes[segment])
            controls = self._state.controls[segment]
            weights = bezier(np.array(part))
            place = weights @ controls
            tangent = (1.0 - part) * (controls[1] - controls[0]) + part * (
                controls[2] - controls[1]
            )
            tangent /= np.linalg.norm(tangent)
            moved = self._at + float((self._point - place) @ tangent)
            self._at = float(np.clip(moved, _PROXIMAL * nodes[-1], nodes[-1]))
        away = place - self._point
        return [
            Contact(0, self._at, segment, weights, place, float(away @ one), one)
            for one in np.linalg.svd(tangent[None])[2][1:]
        ]
