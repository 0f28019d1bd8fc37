"""Discretization of a whisker: non-dimensional rod steps with polynomial curvature and radius.

Lengths are divided by L, forces by EI/L² and moments by EI/L, with EI the bending stiffness at the
base. On each step the intrinsic curvature and the radius are the cubics through their values at the
step's four Gauss points: their error, orthogonal to all cubics, costs only O(h⁸) at the step's
end. Where curvature or radius are rough within a step, as noisy measured radii are, this would be
no better than four samples of them; there the cubics instead have the moments of order 0 to 3 of
the curvature and of the compliance ∝ r⁻⁴ over the step, so that noise averages out as in the rod.

Steps are shorter where the whisker is thin (width ∝ radius^0.4, the best exponent between 0.2 and 1
for the reference loads), follow the total turning of the intrinsic curvature, and never straddle a
kink.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, singledispatch
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vibrissa.numerics import Array

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

#: Steps along a whisker: base force and contact point within 1e-6 (relative) of the exact solution
#: while the tangent turns by less than about 65°, within 1e-4 up to slip-off.
STEPS = 36
#: Largest number of steps; more only adds rounding error.
MOST_STEPS = 2**8 * STEPS
# Largest mean turning of the resting whisker per step, rad, and largest of a step where it turns
# sharply, as in a hook; a helical whisker gets more steps for it.
_TURN_PER_STEP, _SHARPEST = 0.08, 0.16
_NEAR = 50  # half width of the surroundings of a sharp turn, of 2048 parts of the length
_TAPER_EXPONENT = 0.4
# Least number of steps, of STEPS, over which the radius falls by a factor e.
_STEPS_PER_CHANGE = 6.0
# Radius beyond a point over that at it, above which it is a hinge; and mean excess compliance of
# hinges, over that of the rod beyond them, at which they take half of the turning.
_HINGE, _SPREAD = 1.25, 0.3
# Steps of a compliant base, for each unit of its compliance in L/EI; a soft one turns by up to π.
_JOINT_STEPS, _LEAST_JOINT_STEPS, _MOST_JOINT_STEPS = 40, 4, 16
_ORDER = 4
# Error of a step's cubics, relative to the largest value, above which moments are matched.
_ROUGH = 1e-4


class Bendable(Protocol):
    """A body that can be loaded: a whisker with or without its weight."""

    def __hash__(self) -> int:
        """Hash, because results are cached."""

    @property
    def length(self) -> float:
        """Length, m."""

    @property
    def base_radius(self) -> float:
        """Radius at the base, m."""

    @property
    def tip_radius(self) -> float:
        """Radius at the tip, m."""

    def radius(self, s: Array) -> Array:
        """Radii at arc lengths s, m."""

    def position(self, s: Array) -> Array:
        """Points of the resting whisker at increasing arc lengths, m."""

    def frame(self, s: Array) -> Array:
        """Material frames of the resting whisker at arc lengths s, in columns."""


class Weight(NamedTuple):
    """Weight of a rod, non-dimensional, in the form used by the kernels."""

    # (n, 8) Weight of everything distal to a point of each step, over EI/L²: polynomials in the
    # fraction of the step, constant term first.
    beyond: Array
    toward: Array  # (3,), unit vector along which weight acts, base frame
    at_tip: Array  # (3,), the same in the material frame at the tip of the resting whisker


class Rod(NamedTuple):
    """A rod in n steps from base to tip, non-dimensional, in the form used by the kernels."""

    start: Array  # (n,), arc length at which each step begins, over L; negative in a compliant base
    width: Array  # (n,), length of each step in arc length, over L
    extent: Array  # (n,), centreline length per arc length: 1 in the whisker, 0 in a compliant base
    # (n,) Torsional compliance where the radius is the base's, over the bending compliance there.
    twist: Array
    bending: Array  # (n,), bending compliance where the radius is the base's; 1 in the whisker
    # (n, 4, 4) Cubics in the fraction of the step, constant term first: the three intrinsic
    # curvatures (times L), and the radius over the base radius.
    shape: Array
    weight: Weight | None = None  # None if weight is neglected


@dataclass(frozen=True, eq=False)
class Discretization:
    """Rod for the kernels, and the units that make their results dimensional.

    Attributes
    ----------
    rod : Rod
        The steps.
    length : float
        Unit of length: that of the whisker, m.
    force : float
        Unit of force, EI/L² at the base, N.
    moment : float
        Unit of moment, EI/L at the base, N·m.
    radius : float
        Radius at the base, over L.
    """

    rod: Rod
    length: float
    force: float
    moment: float
    radius: float


@lru_cache(maxsize=64)
def discretize(whisker: Bendable, steps: int = STEPS) -> Discretization:
    """Discretize a whisker for the kernels; cached.

    Parameters
    ----------
    whisker : Bendable
        Whisker to be bent, by itself or under its weight.
    steps : int
        Number of integration steps along it, at least; a corkscrew gets more.

    Returns
    -------
    Discretization
        Rod and units.
    """
    return discretized(whisker, steps)


def check_whisker(whisker: object) -> None:
    """Raise a ValueError if ``whisker`` is not one, before a cache requires its hash."""
    kind = type(whisker)  # the class, so that no property is computed
    if not (hasattr(kind, "position") and hasattr(kind, "radius")):
        raise ValueError(f"a Whisker is needed; got {kind.__name__}")


@singledispatch
def discretized(whisker: Any, steps: int) -> Discretization:
    """Discretize a whisker, or an object of another registered type, without the cache."""
    if not 4 <= steps <= MOST_STEPS or int(steps) != steps:
        raise ValueError(f"steps is {steps}; it must be a whole number from 4 to {MOST_STEPS}")
    steps, length = int(steps), whisker.length
    nodes = _nodes(whisker, steps)
    width = np.diff(nodes)
    fractions = (np.polynomial.legendre.leggauss(_ORDER)[0] + 1.0) / 2.0
    samples = _scaled(whisker, nodes[:-1, None] + width[:, None] * fractions)
    to_cubic = np.linalg.inv(np.vander(fractions, _ORDER, increasing=True))
    shape = np.einsum("ij,njc->nci", to_cubic, samples)
    _match_moments(whisker, nodes, shape)
    n = width.size
    ones = np.ones(n)
    rod = Rod(nodes[:-1].copy(), width, ones, ones * (1.0 + whisker.poisson_ratio), ones, shape)
    stiffness = whisker.base_bending_stiffness
    if whisker.base_stiffness is not None:
        turning = _JOINT_STEPS * stiffness / length / min(whisker.base_stiffness)
        pieces = int(np.ceil(np.clip(turning, _LEAST_JOINT_STEPS, _MOST_JOINT_STEPS)))
        pieces *= max(1, steps // STEPS)
        rod = _with_joint(rod, pieces, stiffness / length, *whisker.base_stiffness)
    return Discretization(
        rod=Rod._make([*(np.ascontiguousarray(a, dtype=np.float64) for a in rod[:-1]), None]),
        length=length,
        force=stiffness / length**2,
        moment=stiffness / length,
        radius=whisker.base_radius / length,
    )


def weight_beyond(rod: Rod, weight: float) -> Array:
    """Weight distal to each point, as the polynomials of :class:`Weight`."""
    radius = rod.shape[:, 3]
    integral = np.zeros((len(radius), 8))  # of radius² over the step, from its start
    for i in range(4):
        for j in range(4):
            integral[:, i + j + 1] += radius[:, i] * radius[:, j] / (i + j + 1)
    integral *= (weight * rod.width * rod.extent)[:, None]
    whole = integral.sum(axis=1)
    out = -integral
    out[:, 0] += whole[::-1].cumsum()[::-1]
    return out


def _nodes(whisker: Whisker, steps: int) -> Array:
    """Step boundaries in units of L, denser where the whisker is thin or turns sharply."""
    s = np.linspace(0.0, 1.0, 2049)
    middle = 0.5 * (s[1:] + s[:-1]) * whisker.length
    turning = np.linalg.norm(whisker.curvature(middle), axis=-1) * whisker.length
    finer = steps / STEPS
    steps = max(steps, int(np.ceil(turning.mean() / _TURN_PER_STEP)))
    radius = whisker.radius(middle)
    density = (radius / whisker.base_radius) ** -_TAPER_EXPONENT
    steep = np.abs(np.diff(np.log(radius)))
    ends = np.array([0.0, *(np.array(whisker.breaks) / whisker.length), 1.0])
    steep[np.searchsorted(middle, ends[1:-1] * whisker.length) - 1] = 0.0  # possible jumps
    hinged = _hinged(radius, np.append(steep, 0.0))
    sharp = finer * turning / turning.size / _SHARPEST / steps
    if (sharp > (usual := density / density.sum())).any():
        # Steps next to a sharp turn, which it reaches into, must not be long either.
        near = sliding_window_view(np.pad(sharp, _NEAR, "edge"), 2 * _NEAR + 1).max(axis=1)
        hinged += np.maximum(near - usual, 0.0)
    cumulated = np.concatenate([[0.0], np.cumsum(density + density.sum() * hinged)])
    cumulated /= cumulated[-1]
    edges = np.interp(ends, s, cumulated)
    # A short, steep piece of a rod with kinks would otherwise have too few steps.
    changes = np.diff(np.interp(ends * whisker.length, middle[1:], np.cumsum(steep)))
    shares = np.maximum(np.diff(edges) * (1.0 + hinged.sum()), changes * _STEPS_PER_CHANGE / STEPS)
    counts = np.maximum(1, np.ceil(shares * steps - 1e-9)).astype(int)
    pieces = [
        np.interp(np.linspace(a, b, n + 1)[:-1], cumulated, s)
        for a, b, n in zip(edges[:-1], edges[1:], counts, strict=True)
    ]
    # Kinks are placed exactly, not as interpolated in the table above.
    for piece, kink in zip(pieces[1:], whisker.breaks, strict=True):
        piece[0] = kink / whisker.length
    return np.concatenate([*pieces, [1.0]])


def _hinged(radius: Array, steep: Array) -> Array:
    """Additional steps where a rod is thinner than beyond: a strong load turns such a hinge far."""
    beyond = np.maximum.accumulate(radius[::-1])[::-1]
    slack: Array = np.maximum((beyond / radius / _HINGE) ** 4 - 1.0, 0.0)
    if slack.any():
        turns = slack.mean() / (slack.mean() + _SPREAD)
        changes = np.where(slack > 0.0, steep, 0.0) * (_STEPS_PER_CHANGE / STEPS)
        slack = turns * slack / slack.sum() + changes
    return slack


def _scaled(whisker: Whisker, s: Array) -> Array:
    """Curvatures times L, and radius over base radius, at arc lengths in units of L."""
    arc_length = s * whisker.length
    curvature = whisker.curvature(arc_length) * whisker.length
    radius = whisker.radius(arc_length) / whisker.base_radius
    return np.concatenate([curvature, radius[..., None]], axis=-1)


def _match_moments(whisker: Whisker, nodes: Array, shape: Array) -> None:
    """Replace the cubics (n, 4, 4) of steps within which curvature or radius are rough."""
    knots = [
        p.knots / whisker.length for p in (whisker.intrinsic_curvature, whisker.section_radius)
    ]
    joints = np.unique(np.clip(np.concatenate([nodes, *knots]), 0.0, 1.0))
    joints = joints[np.append(True, np.diff(joints) > 1e-12)]
    abscissae, weights = np.polynomial.legendre.leggauss(2 * _ORDER)
    half = np.diff(joints)[:, None] / 2.0
    s = joints[:-1, None] + half * (1.0 + abscissae)
    step = np.searchsorted(nodes, s[:, 0], side="right") - 1
    width = np.diff(nodes)[step, None]
    t, weight = (s - nodes[step, None]) / width, half * weights / width
    values = _scaled(whisker, s)
    cubics = np.einsum(
        "mci,mji->mjc", shape[step], np.vander(t.ravel(), 4, True).reshape(*t.shape, 4)
    )
    misfit = np.abs(cubics - values).max(axis=1)
    largest = np.append(np.full(3, np.abs(values[..., :3]).max()), 0.0)
    largest = np.where(np.arange(4) < 3, largest, values[..., 3].min(axis=1)[:, None])
    rough = misfit > _ROUGH * largest
    for k in np.unique(step[rough.any(axis=1)]):
        rows = step == k
        at, w = t[rows].ravel(), weight[rows].ravel()
        for component in np.flatnonzero(rough[rows].any(axis=0)):
            known = values[rows, :, component].ravel()
            match = _radius_cubic if component == 3 else _curvature_cubic
            shape[k, component] = match(at, w, known, shape[k, component])


def _curvature_cubic(t: Array, weight: Array, values: Array, _: Array) -> Array:
    """Coefficients of the cubic with the moments of ``values`` at ``t``."""
    legendre = np.polynomial.legendre.legvander(2.0 * t - 1.0, 3)
    matrix = (weight[:, None] * legendre).T @ np.vander(t, 4, increasing=True)
    return np.asarray(np.linalg.solve(matrix, (weight * values) @ legendre), dtype=np.float64)


def _radius_cubic(t: Array, weight: Array, radius: Array, cubic: Array) -> Array:
    """Coefficients of the cubic r for which r⁻⁴ has the moments of radius⁻⁴, by Newton's method."""
    legendre = weight[:, None] * np.polynomial.legendre.legvander(2.0 * t - 1.0, 3)
    powers = np.vander(t, 4, increasing=True)
    moments = radius**-4.0 @ legendre
    found: Array = cubic
    for _ in range(30):
        r = powers @ found
        if not (0.5 * radius.min() < r.min() and r.max() < 2.0 * radius.max()):
            return cubic
        misfit = r**-4.0 @ legendre - moments
        if np.abs(misfit).max() < 1e-12 * moments[0]:
            return found
        slope = legendre.T @ (-4.0 * r[:, None] ** -5.0 * powers)
        found = found - np.asarray(np.linalg.solve(slope, misfit), dtype=np.float64)
    return cubic


def _with_joint(rod: Rod, n: int, moment_scale: float, bending: float, twist: float) -> Rod:
    """Prepend a compliant base to the rod: n steps of zero extent, as compliant as the joint.

    These steps rotate the frame under the moment without displacing it, so together they act as a
    torsion spring and need no equations of their own.
    """
    unit = np.zeros((n, 4, 4))
    unit[:, 3, 0] = 1.0
    joint = Rod(
        start=np.arange(-n, 0) / n,
        width=np.full(n, 1.0 / n),
        extent=np.zeros(n),
        twist=np.full(n, moment_scale / twist),
        bending=np.full(n, moment_scale / bending),
        shape=unit,
    )
    parts = [np.concatenate(pair) for pair in zip(joint[:-1], rod[:-1], strict=True)]
    return Rod._make([*parts, None])
