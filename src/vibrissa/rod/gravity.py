"""A whisker under its weight: the resting shape, and what the kernels need.

A gravitational acceleration g in the base frame gives the rod a weight (:mod:`vibrissa.rod.weight`)
and the whisker a resting shape that sags. That shape is followed from the weightless one while the
weight grows; if it loses its stability on the way, as an upright whisker does that is too slender
to stand, the whisker cannot be held so. Where the base turns, the shape under gravity of about the
same direction is followed instead, which is solved once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import interpolate
from vibrissa.numerics import Array, share_out
from vibrissa.rod.discretization import (
    STEPS,
    Discretization,
    Weight,
    discretize,
    discretized,
    weight_beyond,
)
from vibrissa.rod.weight import STATES, evaluate_weighted, trace_weighted

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

#: Standard gravity, m/s².
STANDARD = 9.80665
_MOST = 1e4  # more than this (m/s²) is doubted: forces of whisking are below 50 g
# The weight grows to its size in so many steps, and a step that fails is halved so often.
_STEPS, _HALVINGS = 8, 6
_NUDGE = 1e-5  # by so much (rad) gravity is turned to see whether a whisker stands
_NEAR = 0.05  # how far apart directions are that resting shapes are followed to others from, rad
_REST = np.array([[1.0, 0.0, 0.0, 0.0]])  # no contact: (s, f)
_NODES = 257  # nodes of the sagged curvature


class Traced(NamedTuple):
    """A whisker followed from tip to base, at m arc lengths, non-dimensional."""

    places: Array  # (m, 3), points of the centreline, whisker frame
    frames: Array  # (m, 3, 3), material frames, in columns
    moments: Array  # (m, 3), moments of the weight beyond each, in the material frame


class Weighted(NamedTuple):
    """Solved contacts of a rod with weight, non-dimensional.

    Attributes
    ----------
    states : (n, 13) array
        Force F and contact point p, direction of weight ĝ, moment of the weight μ at the base, and
        a number that vanishes where the whisker bends over under its weight.
    tangents : (n, 12, 4) array
        Derivatives of all but the last by (s, f_x, f_y, f_z); no rows unless wanted.
    directions : (n, 12, 3) array
        Derivatives of the values by the direction of weight; no rows unless wanted.
    leans : (n, 3) array
        Directions of weight in the material frame at the tip.
    """

    states: Array
    tangents: Array
    directions: Array
    leans: Array


@dataclass(frozen=True)
class Resting:
    """A whisker under its weight at rest, with what a whisker has that loads ask for.

    Attributes
    ----------
    whisker : Whisker
        Whisker without weight.
    gravity : tuple of float
        Gravitational minus base acceleration, whisker frame, m/s².
    """

    whisker: Whisker
    gravity: tuple[float, float, float]

    @property
    def length(self) -> float:
        """Length, m."""
        return self.whisker.length

    @property
    def base_radius(self) -> float:
        """Radius at the base, m."""
        return self.whisker.base_radius

    @property
    def tip_radius(self) -> float:
        """Radius at the tip, m."""
        return self.whisker.tip_radius

    def radius(self, s: ArrayLike) -> Array:
        """Radius at arc lengths, m.

        Parameters
        ----------
        s : array_like
            Arc lengths, m.

        Returns
        -------
        array
            Radii, m.
        """
        return self.whisker.radius(s)

    def position(self, s: Array) -> Array:
        """Points of the sagged centreline.

        Parameters
        ----------
        s : (m,) array
            Arc lengths, m, increasing.

        Returns
        -------
        (m, 3) array
            Points, whisker frame, m.
        """
        return self._traced(s).places * self.length

    def frame(self, s: Array) -> Array:
        """Material frames of the sagged whisker.

        Parameters
        ----------
        s : (m,) array
            Arc lengths, m, increasing.

        Returns
        -------
        (m, 3, 3) array
            Tangent, d1 and d2 in columns.
        """
        return self._traced(s).frames

    @property
    def force(self) -> Array:
        """Force of the weight on the base at rest, N, shape (3,)."""
        d = discretize(self)
        if d.rod.weight is None:
            return np.zeros(3)
        return np.asarray(d.rod.weight.beyond[0, 0] * d.force * d.rod.weight.toward)

    @property
    def moment(self) -> Array:
        """Moment of the weight about the base at rest, N·m, shape (3,)."""
        d = discretize(self)
        if d.rod.weight is None:
            return np.zeros(3)
        return np.asarray(at_rest(self).states[0, 9:12] * d.moment)

    def centerline(self, n: int = 101) -> Array:
        """Points of the sagged centreline, equally spaced in arc length.

        Parameters
        ----------
        n : int
            Number of points.

        Returns
        -------
        (n, 3) array
            Points from base to tip, whisker frame, m.
        """
        return self.position(np.linspace(0.0, self.length, n))

    def shape(self) -> Whisker:
        """A whisker without weight that has the sagged shape at rest.

        Returns
        -------
        Whisker
            Whisker that has no weight and that shape at rest.
        """
        whisker = self.whisker
        d = discretize(self)
        breaks = np.array([0.0, *whisker.breaks, whisker.length])
        s = np.unique(np.concatenate([np.linspace(0.0, whisker.length, _NODES), breaks]))
        moments = self._traced(s).moments * d.moment
        ratio = np.array([1.0 + whisker.poisson_ratio, 1.0, 1.0])
        # At a jump of the radius the moment is smooth, the curvature is not.
        smooth = interpolate.CubicSpline(s, moments)

        def curvature(at: ArrayLike) -> Array:
            arc = np.asarray(at, dtype=np.float64)
            bending = whisker.youngs_modulus * np.pi / 4.0 * whisker.radius(arc) ** 4
            return np.asarray(whisker.curvature(arc) + smooth(arc) * ratio / bending[..., None])

        shaped = type(whisker).from_curvature(
            whisker.length, curvature, breaks=whisker.breaks, any_length=True
        )
        return replace(
            whisker, intrinsic_curvature=shaped.intrinsic_curvature, breaks=shaped.breaks
        )

    def _traced(self, s: Array) -> Traced:
        if discretize(self).rod.weight is None:
            bare = self.whisker
            return Traced(bare.position(s) / self.length, bare.frame(s), np.zeros((len(s), 3)))
        lean = at_rest(self).leans[0]
        free = np.array([1.0, 0.0, 0.0, 0.0])
        return trace(discretize(self), free, lean, np.asarray(s) / self.length)


def resting(whisker: Whisker, gravity: ArrayLike) -> Resting:
    """Check gravity, and put a whisker under its weight.

    Parameters
    ----------
    whisker : Whisker
        Whisker; its density must be known.
    gravity : (3,) array_like
        Gravitational minus base acceleration, whisker frame, m/s².

    Returns
    -------
    Resting
        Whisker under its weight.

    Raises
    ------
    ValueError
        If the density is not known, gravity is not three numbers of a sensible size, or the whisker
        cannot hold itself.
    """
    values = np.asarray(gravity, dtype=np.float64)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ValueError(f"gravity is (x, y, z) in m/s², in the whisker frame; got {gravity!r}")
    if np.linalg.norm(values) > _MOST:
        raise ValueError(
            f"gravity is {np.linalg.norm(values):.4g} m/s²; at most {_MOST:g} is allowed "
            "(on earth it is 9.81)"
        )
    if whisker.density is None:
        raise ValueError(
            "gravity needs the density of the whisker, and it is not known: "
            "with_properties(density=...), in kg/m³ (command line: --density)"
        )
    x, y, z = values.tolist()
    rest = Resting(whisker, (x, y, z))
    discretize(rest)  # or the reason why it has no rest
    return rest


def near_direction(vector: Array, step: float) -> Array:
    """Vector (3,) of the same size in the nearest of directions a step (rad) apart."""
    size = float(np.linalg.norm(vector))
    toward = np.round(vector / max(size, 1e-300) / step) * step
    return np.asarray(size * toward / max(float(np.linalg.norm(toward)), 1e-300))


@discretized.register(Resting)
def _with_weight(whisker: Resting, steps: int) -> Discretization:
    gravity = np.array(whisker.gravity)
    if not gravity.any():
        return discretize(whisker.whisker, steps)
    x, y, z = near_direction(gravity, _NEAR).tolist()
    near = _near(Resting(whisker.whisker, (x, y, z)), steps)
    if near is not None:
        loaded = _loaded(whisker, steps, 1.0, near)
        solved = evaluated(loaded, _REST, leans=near[None], tangents=True)
        if _stands(loaded, solved):
            return _loaded(whisker, steps, 1.0, solved.leans[0])
    return _loaded(whisker, steps, 1.0, _grown(whisker, steps))


@lru_cache(maxsize=64)
def _near(whisker: Resting, steps: int) -> Array | None:
    """Direction of weight at the tip under gravity of about some direction, if there is a rest."""
    try:
        return _grown(whisker, steps)
    except ValueError:
        return None


def _loaded(whisker: Resting, steps: int, share: float, lean: Array) -> Discretization:
    """Rod with a share of its weight."""
    bare, density = discretize(whisker.whisker, steps), whisker.whisker.density
    gravity = np.array(whisker.gravity)
    size = float(np.linalg.norm(gravity))
    assert density is not None
    area = np.pi * (bare.radius * bare.length) ** 2
    beyond = weight_beyond(bare.rod, share * density * area * size * bare.length / bare.force)
    return replace(bare, rod=bare.rod._replace(weight=Weight(beyond, gravity / size, lean)))


def _grown(whisker: Resting, steps: int) -> Array:
    """Direction of weight at the tip of the resting whisker, followed while the weight grows."""
    lean = np.asarray(whisker.whisker.frame(whisker.length)).T @ whisker.gravity
    lean /= np.linalg.norm(lean)
    done, stride = 0.0, 1.0 / _STEPS
    while done < 1.0:
        share = min(1.0, done + stride)
        loaded = _loaded(whisker, steps, share, lean)
        solved = evaluated(loaded, _REST, leans=lean[None], tangents=True)
        if _stands(loaded, solved):
            done, lean = share, solved.leans[0]
        elif stride > 0.5**_HALVINGS / _STEPS:
            stride *= 0.5
        else:
            raise ValueError(
                f"this whisker cannot hold itself in gravity {whisker.gravity} m/s²: it bends "
                f"over under {done:.0%} of its weight; it is stiffer when thicker, shorter, "
                "hanging, or of a larger youngs_modulus"
            )
    return lean


def _stands(d: Discretization, solved: Weighted) -> bool:
    """Whether a resting whisker is stable, as it is without weight.

    The direction of weight at the tip, by that at the base, is then a rotation; where one of its
    two eigenvalues, or both at once as in a straight upright rod, passes through zero, the whisker
    bends over.
    """
    weight = d.rod.weight
    assert weight is not None
    if not (np.isfinite(solved.states).all() and solved.states[0, -1] > 0.0):
        return False
    lean = solved.leans[0]
    frame = trace(d, _REST[0], lean, np.ones(1)).frames[0]
    total = 0.0
    for across in np.linalg.svd(weight.toward[None])[2][1:]:
        toward = weight.toward + _NUDGE * across
        turned = replace(d, rod=d.rod._replace(weight=weight._replace(toward=toward)))
        nudged = evaluated(turned, _REST, leans=lean[None]).leans[0]
        total += float((nudged - lean) @ (frame.T @ across)) / _NUDGE
    return total > 0.0


def evaluated(
    d: Discretization, contacts: Array, leans: Array | None = None, tangents: bool = False
) -> Weighted:
    """Solve contacts of a rod with weight, (s, f) being known."""
    rod, n = d.rod, len(contacts)
    weight = rod.weight
    assert weight is not None
    out = Weighted(
        np.empty((n, STATES + 1)),
        np.empty((n if tangents else 0, STATES, 4)),
        np.empty((n if tangents else 0, STATES, 3)),
        np.full((n, 3), np.nan) if leans is None else np.array(leans, dtype=np.float64),
    )
    kept = np.ascontiguousarray(contacts, dtype=np.float64)
    share_out(
        n,
        lambda first, last: evaluate_weighted(
            rod,
            weight,
            kept,
            out.leans,
            out.states,
            out.tangents,
            out.directions,
            first,
            last,
        ),
    )
    return out


@lru_cache(maxsize=64)
def at_rest(whisker: Resting, steps: int = STEPS) -> Weighted:
    """Solve the resting whisker; cached."""
    return evaluated(discretize(whisker, steps), _REST, tangents=True)


def moved_moments(d: Discretization, contacts: Array) -> Array:
    """What the weight's moment about the base has changed by since rest, non-dimensional."""
    out = np.zeros((len(contacts), 3))
    if d.rod.weight is None:
        return out
    rows = np.flatnonzero(np.isfinite(contacts).all(axis=1))
    rest = evaluated(d, _REST).states[0, 9:12]
    out[rows] = evaluated(d, contacts[rows]).states[:, 9:12] - rest
    return out


def trace(d: Discretization, contact: Array, lean: Array, s: Array) -> Traced:
    """Follow one solved whisker."""
    m = len(s)
    axes, ends, moments = np.empty((m + 1, 3, 3)), np.empty((m + 1, 3)), np.empty((m + 1, 3))
    assert d.rod.weight is not None
    trace_weighted(d.rod, d.rod.weight, contact, lean, np.ascontiguousarray(s), axes, ends, moments)
    # Axis i is aᵢ in the base frame and Rᵀaᵢ in the material frame.
    frames = np.einsum("ia,mib->mab", axes[-1], axes[:-1])
    places = ends[-1] - np.einsum("mab,mb->ma", frames, ends[:-1])
    return Traced(places, frames, moments[:-1])
