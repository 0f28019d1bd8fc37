"""Forward model of contacts: readings of a rod with weight and with uncertain parameters.

A contact x = (s, f) determines the base force and the contact point (F, p), and under weight also
the change μ of the weight's moment about the base since rest. A sensor that was tared at rest
then reads

    F = φ(0),   M = p × F + μ,

so that M · F ≠ 0. If it was tared under another gravity, it reads the difference of the two resting
wrenches in addition, which is the same for every contact.

Parameters of the rod that are uncertain are further unknowns c ~ N(0, 1): the direction of gravity,
the density, the compliance of the base. Their effect on readings and contact point at a fixed x is
taken to first order, as the change for one standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contacts.fitting.least_squares import Fits, fit
from vibrissa.contacts.joint.weighted_fit import Aim, fit_weighted
from vibrissa.contacts.sensing.channels import FITTED, wrenches_of
from vibrissa.deferred import transform
from vibrissa.numerics import AnyArray, Array, relative, share_out
from vibrissa.rod import (
    STEPS,
    Resting,
    discretize,
    evaluated,
    near_direction,
    resting,
    solve_forces,
)
from vibrissa.whisker import Whisker

_NUDGE = 1e-4  # turn of gravity (rad) and relative change of density for derivatives
_RIGID = 1e9  # stiffness of a rigid base, relative to the whisker
_AHEAD = 1e-5  # relative step of the force along the whisker for its derivatives
# Spacing of the directions of gravity for which a turning whisker is solved, largest and smallest,
# and of those whose resting shapes propose contacts, rad; and the change of a measurement, in
# standard deviations, that the former may cause.
_DIRECTIONS, _FINEST, _SHAPES, _UNSEEN = 2e-4, 1e-9, 0.2, 0.03
# Rows of a solved rod with weight: force, contact point, moment of the weight.
_CAUSED = [0, 1, 2, 3, 4, 5, 9, 10, 11]


@dataclass(frozen=True)
class Gravity:
    """Gravity that a whisker bends under, and how well it is known.

    Attributes
    ----------
    acceleration : (3,) array_like
        Gravitational acceleration minus that of the base, whisker frame, m/s², such as
        ``(0, 0, -9.81)`` for a level whisker.
    tare : (3,) array_like, optional
        Gravity, whisker frame, m/s², when the sensor was tared with the whisker at rest; by default
        as it is now. Zeros: a sensor that reads the weight.
    direction_sigma : float
        Standard deviation of gravity's direction about each axis across it, rad.
    density_sigma : float
        Relative standard deviation of the whisker's density.
    """

    acceleration: tuple[float, float, float]
    tare: tuple[float, float, float] | None = None
    direction_sigma: float = 0.0
    density_sigma: float = 0.0

    def __post_init__(self) -> None:
        relative("density_sigma", self.density_sigma)
        if not 0.0 <= self.direction_sigma <= np.pi:
            raise ValueError(
                f"direction_sigma is a standard deviation in rad, not negative, up to π; got "
                f"{self.direction_sigma!r}"
            )
        for name in ("acceleration", "tare"):
            if (value := getattr(self, name)) is None:
                continue
            if np.shape(value) != (3,):
                raise ValueError(f"{name} is (x, y, z) in m/s²; got {value!r}")
            # An array cannot be the key of what is kept for each gravity.
            object.__setattr__(self, name, tuple(map(float, value)))

    @property
    def uncertain(self) -> bool:
        """Whether its direction or the density is uncertain."""
        return self.direction_sigma > 0.0 or self.density_sigma > 0.0

    @classmethod
    def of(cls, gravity: Gravity | ArrayLike | None) -> Gravity | None:
        """Read gravity, stated as such or as an acceleration; None where there is none.

        Parameters
        ----------
        gravity : Gravity, (3,) array_like or None
            Gravity, or its acceleration, m/s².

        Returns
        -------
        Gravity or None
            Gravity, unless it is zero and the sensor was tared under it.
        """
        if gravity is None:
            return None
        if not isinstance(gravity, Gravity):
            values = np.asarray(gravity, dtype=np.float64)
            if values.shape != (3,):
                raise ValueError(
                    f"gravity is (x, y, z) in m/s², in the whisker frame; got {gravity!r}"
                )
            gravity = cls((float(values[0]), float(values[1]), float(values[2])))
        return gravity if any(gravity.acceleration) or gravity.tare is not None else None

    def turned(self, rotation: Array, step: float = _DIRECTIONS) -> Gravity:
        """Gravity of the laboratory frame in the frame of a turned whisker.

        Parameters
        ----------
        rotation : (3, 3) array
            Rotation of the base, from the whisker's to the laboratory frame.
        step : float
            Angle between neighbouring directions, rad.

        Returns
        -------
        Gravity
            Gravity in the nearest of directions a step apart, so that those of a slowly moving
            whisker are not all different; without another tare it is of this pose.
        """
        x, y, z = near_direction(rotation.T @ self.acceleration, step).tolist()
        return replace(self, acceleration=(x, y, z), tare=self.tare or (x, y, z))

    def nearly(self, share: float, step: float = _SHAPES) -> tuple[float, float, float]:
        """A share of the acceleration, in the nearest of directions some degrees apart.

        Parameters
        ----------
        share : float
            Share of its size.
        step : float
            Angle between neighbouring directions, rad.

        Returns
        -------
        tuple of float
            Acceleration, m/s².
        """
        x, y, z = near_direction(share * np.array(self.acceleration), step).tolist()
        return x, y, z


def read_at_rest(whisker: Whisker, gravity: Gravity, rotation: Array | None, n: int) -> Array:
    """Readings of a tared sensor for a free whisker in n poses (n, 6), N and N·m."""
    if rotation is None:
        there = Forward.of(whisker, gravity)
        return np.tile(there.shift * np.repeat([there.d.force, there.d.moment], 3), (n, 1))
    lab, known, out = gravity, {}, np.full((n, 6), np.nan)
    for i in np.flatnonzero(finite(rotation)):
        now = lab.turned(rotation[i], _FINEST)
        lab = replace(lab, tare=now.tare)
        if now not in known:
            known[now] = read_at_rest(whisker, now, None, 1)[0]
        out[i] = known[now]
    return out


class Solved(NamedTuple):
    """Contacts and their effects at the base.

    x (n, 4); (F, p) or (F, p, μ) (n, 6 or 9) and their derivatives with respect to x (n, 6 or 9,
    4); directions of gravity at the tip (n, 3), from which the next solution starts.
    """

    x: Array
    values: Array
    tangents: Array
    leans: Array


class Forward:
    """Rod with its uncertain parameters, which all measurements share; constructed by :meth:`of`.

    ``shift`` (6,) is the reading in addition to (F, M) due to the pose at the tare,
    non-dimensional; ``errors`` are rods that differ in one parameter, each with the standard
    deviation of that parameter in units of the difference.
    """

    def __init__(self, rod: Whisker | Resting, steps: int, before: Resting | None = None) -> None:
        self.rod, self.d = rod, discretize(rod, steps)
        self.shift, self._rest = np.zeros(6), np.zeros(3)
        self.errors: list[tuple[Forward, float]] = []
        if isinstance(rod, Resting):
            self._rest = rod.moment / self.d.moment
            if before is not None:
                self.shift[:3] = (rod.force - before.force) / self.d.force
                self.shift[3:] = (rod.moment - before.moment) / self.d.moment

    @classmethod
    def of(
        cls,
        whisker: Whisker,
        gravity: Gravity | None = None,
        compliance_sigma: float = 0.0,
        stiffness_sigma: float = 0.0,
        steps: int = STEPS,
    ) -> Forward:
        """Set up a whisker under gravity, with the standard deviations of uncertain parameters."""

        def bent(whisker: Whisker, turn: transform.Rotation | None = None) -> Forward:
            if gravity is None:
                return cls(whisker, steps)
            now, before = (
                None
                if pull is None
                else resting(whisker, np.array(pull) if turn is None else turn.apply(pull))
                for pull in (gravity.acceleration, gravity.tare)
            )
            assert now is not None
            return cls(now, steps, before)

        out = bent(whisker)
        if gravity is not None:
            if gravity.direction_sigma > 0.0:
                for axis in np.linalg.svd(np.array([gravity.acceleration]))[2][1:]:
                    turned = bent(whisker, transform.Rotation.from_rotvec(_NUDGE * axis))
                    out.errors.append((turned, gravity.direction_sigma / _NUDGE))
            # A stiffer whisker bends less under the same weight, as a lighter one does.
            lighter = float(np.hypot(gravity.density_sigma, stiffness_sigma))
            if lighter > 0.0:
                assert whisker.density is not None
                heavier = whisker.with_properties(density=whisker.density * (1.0 + _NUDGE))
                out.errors.append((bent(heavier), lighter / _NUDGE))
        if compliance_sigma > 0.0:
            stiff = _RIGID * whisker.base_bending_stiffness / whisker.length
            soft = 1.0 / np.array(whisker.base_stiffness or (stiff, stiff))
            for bending, twist in 1.0 / (soft + compliance_sigma * np.eye(2)):
                base = replace(whisker, base_stiffness=(float(bending), float(twist)))
                out.errors.append((bent(base), 1.0))
        return out

    def direction_step(self, noise: float) -> float:
        """Spacing of the directions of gravity, rad, whose effect is hidden in the noise."""
        if not isinstance(self.rod, Resting):
            return _DIRECTIONS
        force, moment = self.rod.force / self.d.force, self.rod.moment / self.d.moment
        weight = max(float(np.abs(force).max()), float(np.abs(moment).max()))
        return min(max(_UNSEEN * noise / weight, _FINEST), _DIRECTIONS)

    @property
    def weighted(self) -> bool:
        """Whether the rod has weight."""
        return self.d.rod.weight is not None

    def values(self, x: Array, leans: Array | None = None) -> Array:
        """(F, p) or (F, p, μ) (n, 6 or 9) for contacts x (n, 4)."""
        if not self.weighted:
            return solve_forces(self.d, x)[0]
        return self._since_rest(evaluated(self.d, x, leans).states[:, _CAUSED])

    def _since_rest(self, values: Array) -> Array:
        values[:, 6:] -= self._rest
        return values

    def solved(self, x: Array, leans: Array | None = None) -> Solved:
        """Contacts x (n, 4) of the rod with weight, with derivatives."""
        out = evaluated(self.d, x, leans, tangents=True)
        values = self._since_rest(out.states[:, _CAUSED])
        return Solved(x, values, out.tangents[:, _CAUSED], out.leans)

    def near(self, x: Array) -> tuple[Array, Array]:
        """Values for contacts x (n, 4) and their derivatives with respect to x."""
        if self.weighted:
            return self.solved(x)[1:3]
        values, exact = solve_forces(self.d, x, tangents=True)
        step = _AHEAD * np.linalg.norm(x[:, 1:], axis=1)
        ahead = x.copy()
        ahead[:, 1] += step
        slopes = np.empty((len(x), 6, 4))
        slopes[..., [0, 2, 3]] = exact
        slopes[..., 1] = (solve_forces(self.d, ahead)[0] - values) / step[:, None]
        return values, slopes

    def by_errors(self, x: Array, values: Array) -> tuple[Array, Array]:
        """Change of readings and of (F, p), (n, 6, k) each, for one standard deviation."""
        wrench = np.zeros((len(x), 6, len(self.errors)))
        moved = np.zeros_like(wrench)
        for k, (other, share) in enumerate(self.errors):
            there = other.values(x)
            change = wrenches_of(there) - wrenches_of(values) + other.shift - self.shift
            wrench[..., k], moved[..., k] = share * change, share * (there - values)[:, :6]
        return wrench, moved

    def fit(
        self,
        names: tuple[str, ...],
        targets: Array,
        weights: Array,
        x: Array,
        known: Solved | None = None,
        *,
        friction: bool,
        least: float,
    ) -> tuple[Fits, Solved | None]:
        """Fit contacts to channels from starts x (n, 4), as :func:`~.least_squares.fit` does.

        The names end with ``ratio`` and ``s`` if these are held. With weight, starts that are
        ``known`` are not solved again, and the fitted contacts are returned in this form too.
        """
        if not self.weighted:
            fits = fit(self.d, names, targets, weights, x, friction=friction, least=least)
            return fits, None
        if known is None:
            known = self.solved(x if friction else x * [1.0, 0.0, 1.0, 1.0])
        rod, misfit = self.d.rod, np.empty(len(x))
        assert rod.weight is not None
        codes = np.array([FITTED.index(name) for name in names])
        aim = Aim(codes, self._rest, friction, float(least))
        out = Solved(*(np.array(part, order="C") for part in known))
        whole = np.ascontiguousarray(targets), np.ascontiguousarray(weights)
        share_out(len(x), fit_weighted, rod, rod.weight, aim, *whole, *out, misfit)
        return Fits(*out[:3], misfit, np.isfinite(misfit)), out


def finite(values: Array) -> AnyArray:
    """Whether each row (n,) of values (n, ...) is finite."""
    return np.asarray(np.isfinite(values).reshape(len(values), -1).all(axis=1))
