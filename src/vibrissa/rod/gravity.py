"""A whisker under its own weight: its resting shape and its discretization for the kernels.

A gravitational acceleration g in the base frame gives the rod a weight (:mod:`vibrissa.rod.weight`)
and makes the resting shape sag. The sagged shape is followed from the weightless one while the
weight increases; if it loses stability on the way, as an upright whisker does that is too slender,
the whisker cannot be held in that orientation. For a base that turns, the sagged shape under a
nearby direction of gravity, which is computed once and cached, is the starting point instead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import interpolate
from vibrissa.numerics import Array, numbers, share_out
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

_MOST = 5e3  # largest gravity accepted, m/s²; accelerations of whisking are below 50 g
# Number of increments in which the weight is applied, and how often a failed one may be halved.
_STEPS, _HALVINGS = 8, 6
_NUDGE = 1e-5  # rotation of gravity in the finite differences of the stability test, rad
_SPACING = 0.05  # of directions, rad, and log sizes of gravity with cached resting shapes
_REST = np.array([[1.0, 0.0, 0.0, 0.0]])  # zero contact force: (s, f)
_NODES = 257  # number of nodes of the sagged curvature


class Traced(NamedTuple):
    """Shape of a solved whisker at m arc lengths, non-dimensional."""

    places: Array  # (m, 3), points of the centreline, whisker frame
    frames: Array  # (m, 3, 3), material frames, in columns
    moments: Array  # (m, 3), moments of the weight distal to each point, in the material frame


class Weighted(NamedTuple):
    """Solved contacts of a rod with weight, non-dimensional; derivatives only if requested."""

    # (n, 13): force F, contact point p, direction of weight ĝ, moment of the weight μ at the base,
    # and a number that vanishes where the whisker topples under its weight
    states: Array
    tangents: Array  # (n, 12, 4), derivatives of the first 12 by (s, f_x, f_y, f_z)
    directions: Array  # (n, 12, 3), derivatives of the first 12 by the direction of weight
    leans: Array  # (n, 3), directions of weight in the material frame at the tip


@dataclass(frozen=True)
class Resting:
    """A whisker sagging under its own weight; a :class:`Bendable`.

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
        return self._shape_at(s).places * self.length

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
        return self._shape_at(s).frames

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
        """Return a whisker without weight whose resting shape is the sagged one.

        Returns
        -------
        Whisker
            Whisker with the curvature of the sagged whisker.
        """
        whisker = self.whisker
        d = discretize(self)
        breaks = np.array([0.0, *whisker.breaks, whisker.length])
        s = np.unique(np.concatenate([np.linspace(0.0, whisker.length, _NODES), breaks]))
        moments = self._shape_at(s).moments * d.moment
        ratio = np.array([1.0 + whisker.poisson_ratio, 1.0, 1.0])
        # At a jump of the radius the moment is smooth, but the curvature is not.
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

    def _shape_at(self, s: Array) -> Traced:
        """Sagged shape at arc lengths s (m,), m."""
        if discretize(self).rod.weight is None:
            bare = self.whisker
            return Traced(bare.position(s) / self.length, bare.frame(s), np.zeros((len(s), 3)))
        lean = at_rest(self).leans[0]
        free = np.array([1.0, 0.0, 0.0, 0.0])
        return trace(discretize(self), free, lean, np.asarray(s) / self.length)


def resting(whisker: Whisker, gravity: ArrayLike) -> Resting:
    """Apply a whisker's weight to it, and check that it can be held so.

    Parameters
    ----------
    whisker : Whisker
        Whisker; its density must be known.
    gravity : (3,) array_like
        Gravitational minus base acceleration, whisker frame, m/s².

    Returns
    -------
    Resting
        Whisker that sags under its weight.

    Raises
    ------
    ValueError
        If the density is unknown, gravity is not three finite numbers of plausible size, or the
        whisker topples under its weight.
    """
    values = numbers("gravity", gravity)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ValueError(f"gravity is (x, y, z) in m/s², in the whisker frame; got {gravity!r}")
    if np.linalg.norm(values) > _MOST:
        raise ValueError(
            f"gravity is {np.linalg.norm(values):.4g} m/s²; at most {_MOST:g} is allowed "
            "(on earth it is 9.81): is it in mm/s²?"
        )
    if whisker.density is None:
        raise ValueError(
            "gravity requires the density of the whisker, which is not known: set it by "
            "with_properties(density=...), in kg/m³ (command line: --density)"
        )
    x, y, z = values.tolist()
    rest = Resting(whisker, (x, y, z))
    discretize(rest)  # raises a ValueError if there is no stable resting shape
    return rest


def near_direction(vector: Array, step: float) -> Array:
    """Vector (3,) of equal magnitude, in the nearest of directions spaced by ``step``, rad."""
    size = float(np.linalg.norm(vector))
    toward = np.round(vector / max(size, 1e-300) / step) * step
    return np.asarray(size * toward / max(float(np.linalg.norm(toward)), 1e-300))


@discretized.register(Resting)
@lru_cache(maxsize=64)  # for calls with and without a number of steps
def _with_weight(whisker: Resting, steps: int) -> Discretization:
    """Discretize a whisker with its weight."""
    gravity = np.array(whisker.gravity)
    if not gravity.any():
        return discretize(whisker.whisker, steps)
    # An accelerometer's readings have noise: sizes are rounded too, last digits included.
    size = float(np.linalg.norm(gravity))
    toward = np.round(gravity / size / _SPACING)
    toward *= np.exp(_SPACING * np.round(np.log(size) / _SPACING)) / np.linalg.norm(toward)
    x, y, z = toward.tolist()
    if (near := _cached_lean(Resting(whisker.whisker, (x, y, z)), steps)) is not None:
        loaded = _rod_with_weight(whisker, steps, 1.0, near)
        solved = evaluated(loaded, _REST, leans=near[None], tangents=True)
        if _is_stable(loaded, solved):
            weight = loaded.rod.weight
            assert weight is not None
            weight = weight._replace(at_tip=solved.leans[0])
            return replace(loaded, rod=loaded.rod._replace(weight=weight))
    return _rod_with_weight(whisker, steps, 1.0, _lean_by_increments(whisker, steps))


@lru_cache(maxsize=64)
def _cached_lean(whisker: Resting, steps: int) -> Array | None:
    """Direction of weight at the tip of the resting whisker, or None if it topples; cached."""
    try:
        return _lean_by_increments(whisker, steps)
    except ValueError:
        return None


def _rod_with_weight(whisker: Resting, steps: int, share: float, lean: Array) -> Discretization:
    """Rod with a share of its weight, and an estimate of the direction of weight at the tip."""
    bare, density = discretize(whisker.whisker, steps), whisker.whisker.density
    gravity = np.array(whisker.gravity)
    size = float(np.linalg.norm(gravity))
    assert density is not None
    area = np.pi * (bare.radius * bare.length) ** 2
    beyond = weight_beyond(bare.rod, share * density * area * size * bare.length / bare.force)
    return replace(bare, rod=bare.rod._replace(weight=Weight(beyond, gravity / size, lean)))


def _lean_by_increments(whisker: Resting, steps: int) -> Array:
    """Direction of weight at the tip of the resting whisker, followed as the weight increases."""
    lean = np.asarray(whisker.whisker.frame(whisker.length)).T @ whisker.gravity
    lean /= np.linalg.norm(lean)
    done, stride = 0.0, 1.0 / _STEPS
    while done < 1.0:
        share = min(1.0, done + stride)
        loaded = _rod_with_weight(whisker, steps, share, lean)
        solved = evaluated(loaded, _REST, leans=lean[None], tangents=True)
        if _is_stable(loaded, solved):
            done, lean = share, solved.leans[0]
        elif stride > 0.5**_HALVINGS / _STEPS:
            stride *= 0.5
        else:
            raise ValueError(
                f"this whisker topples in gravity {whisker.gravity} m/s², under {done:.0%} of its "
                "weight; a whisker that is thicker, shorter, hanging, or of a larger "
                "youngs_modulus is more stable"
            )
    return lean


def _is_stable(d: Discretization, solved: Weighted) -> bool:
    """Whether a resting whisker is stable and connected to the weightless one.

    Without weight, the derivative of the direction of weight at the base by that at the tip is a
    rotation, that of the tip's frame. Where one of its two eigenvalues relative to that frame, or
    both at once as in a straight upright rod, passes through zero, the whisker topples.
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
    """Evaluate a rod with weight at contacts (s, f) (n, 4), and solve for their ``leans``."""
    n = len(contacts)
    out = Weighted(
        np.empty((n, STATES + 1)),
        np.empty((n if tangents else 0, STATES, 4)),
        np.empty((n if tangents else 0, STATES, 3)),
        np.full((n, 3), np.nan) if leans is None else np.array(leans, dtype=np.float64),
    )
    kept = np.ascontiguousarray(contacts, dtype=np.float64)
    filled = out.leans, out.states, out.tangents, out.directions
    share_out(n, evaluate_weighted, d.rod, d.rod.weight, kept, *filled)
    return out


@lru_cache(maxsize=64)
def at_rest(whisker: Resting, steps: int = STEPS) -> Weighted:
    """Evaluate the resting whisker; cached."""
    return evaluated(discretize(whisker, steps), _REST, tangents=True)


def moved_moments(d: Discretization, contacts: Array) -> Array:
    """Change of the weight's moment about the base since rest (n, 3), non-dimensional."""
    out = np.zeros((len(contacts), 3))
    if d.rod.weight is None:
        return out
    rows = np.flatnonzero(np.isfinite(contacts).all(axis=1))
    rest = evaluated(d, _REST).states[0, 9:12]
    out[rows] = evaluated(d, contacts[rows]).states[:, 9:12] - rest
    return out


def trace(d: Discretization, contact: Array, lean: Array, s: Array) -> Traced:
    """Positions, frames and moments of one solved whisker at arc lengths s."""
    m = len(s)
    axes, ends, moments = np.empty((m + 1, 3, 3)), np.empty((m + 1, 3)), np.empty((m + 1, 3))
    assert d.rod.weight is not None
    trace_weighted(d.rod, d.rod.weight, contact, lean, np.ascontiguousarray(s), axes, ends, moments)
    # Axis i is aᵢ in the base frame and Rᵀaᵢ in the material frame.
    frames = np.einsum("ia,mib->mab", axes[-1], axes[:-1])
    places = ends[-1] - np.einsum("mab,mb->ma", frames, ends[:-1])
    return Traced(places, frames, moments[:-1])
