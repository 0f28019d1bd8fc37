"""Contacts of a whisker with weight, friction or an uncertain base, or with several of these.

The resting whisker sags under its weight. A weightless whisker with this resting shape proposes
contacts: near the truth if gravity acts across the whisker, and within a few per cent of the length
if it acts along it, except on nearly uniform whiskers, along which contacts are sought
(:mod:`~vibrissa.contacts.joint.along_whisker`). They are then fitted to the signals with the full
weight and all uncertain parameters (:mod:`~vibrissa.contacts.joint.joint_fit`). With unknown
friction, curves of contacts are traced from there (:mod:`~vibrissa.contacts.joint.friction`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contacts.charted_whisker import ChartedWhisker
from vibrissa.contacts.contacts import THREE_SIGMA, Candidates, Contacts, contacts_of
from vibrissa.contacts.engine.prior import Prior, possible_candidates, refuse_tip
from vibrissa.contacts.engine.readout import Named
from vibrissa.contacts.engine.search import Search, check_scale, estimate
from vibrissa.contacts.fitting.least_squares import Fits
from vibrissa.contacts.joint.along_whisker import evenly_weighted, leave_few_paths, sought_along
from vibrissa.contacts.joint.fold import held_back, is_near_fold
from vibrissa.contacts.joint.forward import Forward, Gravity, finite
from vibrissa.contacts.joint.friction import along_curves, check_ratio, or_without
from vibrissa.contacts.joint.joint_fit import Joint, JointFit, check_compliance
from vibrissa.contacts.sensing.channels import (
    CHANNELS,
    WRENCH,
    Channels,
    channels_of,
    friction_angle,
)
from vibrissa.contacts.sensing.noise import Noise, SensorNoise, explained, sensor_noise
from vibrissa.contacts.uncertainty.posterior import ranked
from vibrissa.contacts.uncertainty.valleys import LIKELY_FRICTION
from vibrissa.contacts.wrench import PROXIMAL, by_probability, chosen, estimate_components
from vibrissa.deferred import xr
from vibrissa.numerics import AnyArray, Array, IntArray, Vector
from vibrissa.rod import Discretization, Resting, solve_forces
from vibrissa.signals import (
    SIGNALS,
    check_signals,
    labelled_wrench,
    measured,
    selection,
    signal_scales,
)
from vibrissa.status import Status
from vibrissa.whisker import Whisker

_EXACT = 1e-8  # tolerance for exact signals, in χ² of signals known to 1 %
# Noise, in units of force and moment and in rad, within which the weightless whisker proposes
# contacts for signals that it does not explain exactly.
_NEAR = 0.01
# Rounds of corrections of what it proposes; and the resolution in which proposals are the same.
_CORRECTIONS, _ALIKE = 3, 1e-4
_MOST = 8
# Difference of arc lengths, over L, within which two contacts are the same.
_SAME = 0.03
_NO_ERRORS = np.zeros((0, 6, 7))
_NO_STATUS = np.array([int(Status.NOT_FRICTIONLESS)])
_WEIGHTLESS = 1e-9  # gravity, m/s², below which the base is in free fall
# Of three signals with all of these unknown, regions hold half to two thirds of the contacts.
_SEPARATE = 4
# Displacement of a contact, of its arc length (over L) and of its force (over its size), within
# which it continues the one before; and that since the last search, above which others may have
# become possible. Noise may move it farther.
_NEAR_ARC, _NEAR_FORCE = (0.02, 0.05), (0.1, 0.3)
# Displacement of the tip, over L, due to a turn of the base within which one resting shape proposes
# contacts; and the least and the largest such turn, rad.
_AS_BENT, _LEAST_TURN, _LARGEST_TURN = 0.01, 0.2, 1.0
_FINEST_TURN = 0.02  # spacing of directions, rad, below which resting shapes are not made anew
_SHAPES = 8  # number of maps of sagged whiskers that are kept
_FLAT = 1e-12  # smallest variance, over the largest, of covariances that are joined
_SAME_SAG = 3e-4  # standard deviation of the tip's sag, over L, that a filter neglects


class _Path(NamedTuple):
    """Last contact of a sequence and the one last searched for, and the shape that proposed them.

    x (2, 4) and contact points (2, 3), over L.
    """

    x: Array
    points: Array
    shape: Vector | None

    def onward(self, found: Candidates) -> _Path | None:
        """Path on to the first candidate of a measurement; None if it is far from both contacts."""
        x, point, covariance = found.x[0, 0], found.values[0, 0, 3:], found.covariances[0, 0]
        size, near = math.hypot(*x[1:].tolist()), np.zeros(2, np.bool_)
        for i, (arc, *force) in enumerate((x - self.x).tolist()):
            near[i] = abs(arc) <= _NEAR_ARC[i] and math.hypot(*force) <= size * _NEAR_FORCE[i]
        if not near.all() and np.isfinite(covariance).all():
            apart = point - self.points
            back = np.linalg.pinv(covariance, hermitian=True)
            near |= (apart @ back * apart).sum(axis=1) <= 2.0 * THREE_SIGMA
        if not near.all():
            return None
        return self._replace(x=np.stack([x, self.x[1]]), points=np.stack([point, self.points[1]]))


class _Searches(NamedTuple):
    """Searches for contacts of the weightless whisker with a sagged shape.

    For signals without noise, near and exact ones; and for the stated noise. Empty and None if the
    signals do not determine contacts.
    """

    shape: Vector | None
    exact: list[Search]
    noisy: Search | None


class JointEstimate:
    """Estimates contacts with weight, friction and uncertain parameters of the rod."""

    def __init__(
        self,
        whisker: Whisker,
        contact_map: ChartedWhisker | None,
        names: tuple[str, ...],
        sensor: SensorNoise | None,
        prior: Prior | None,
        *,
        gravity: Gravity | None = None,
        friction: float = 0.0,
        compliance_sigma: float = 0.0,
        stiffness_sigma: float = 0.0,
        same_friction: bool = False,
        without_weight: bool = False,
    ) -> None:
        refuse_tip(prior, "friction, weight or an uncertain base is stated")
        if sensor is None and gravity is not None and gravity.uncertain:
            raise ValueError(
                "the uncertainty of the weight adds to that of a sensor: give its noise"
            )
        if friction != 0.0:
            check_ratio(friction, sensor)
            if len(names) < _SEPARATE and (gravity is not None or compliance_sigma != 0.0):
                raise ValueError(
                    "friction together with weight or an uncertain base needs at least "
                    f"{_SEPARATE} signals, such as Fx, FT, MB and MD; got {', '.join(names)}"
                )
        check_compliance(compliance_sigma, sensor, whisker)
        self.whisker, self.contact_map, self.names = whisker, contact_map, names
        self.sensor, self.prior, self.gravity = sensor, prior, gravity
        self._how: dict[str, Any] = {
            "friction": friction,
            "compliance_sigma": compliance_sigma,
            "stiffness_sigma": stiffness_sigma,
            "same_friction": same_friction,
            "without_weight": without_weight,
        }
        self._lab, self._proposing = gravity, None if gravity is None else gravity.acceleration
        self._path: _Path | None = None
        self._searches: _Searches | None = None
        self.forward = Forward.of(whisker, gravity, compliance_sigma, stiffness_sigma)
        self.d, whole = self.forward.d, names == WRENCH
        self.channels = Channels(WRENCH, WRENCH) if whole else Channels.of(names)
        self.scale = signal_scales(names, self.d.force, self.d.moment)
        self._telling = self.channels
        if not whole and whisker.is_straight and whisker.base_stiffness is None:
            # A contact does not twist a straight whisker with weight, but that with its shape.
            self._telling = Channels.of(tuple(name for name in names if name != "Mx"))
        self._least = _least_noise(sensor, names, self.d)
        self._step = self.forward.direction_step(self._least)
        self._shift = _shifts(self.channels.names, self.forward.shift)
        least = PROXIMAL if whole or contact_map is None else contact_map.chart.proximal
        self._fit = JointFit(self.forward, self.channels, sensor, least, friction=whole)
        self._rubbing = None
        if friction != 0.0:
            self._rubbing = JointFit(self.forward, self.channels, sensor, least, True, friction)

    def __call__(self, values: Array) -> tuple[Candidates, IntArray]:
        """Candidates of measurements (n, k), SI units, tared in this pose, and their statuses."""
        flat = values / self.scale
        targets = self.channels.targets(flat)
        found, status = self._without_friction(values, flat, targets)
        if self._rubbing is not None:
            x = found.x[:, 0]
            known = np.full((len(x), 9 if self.forward.weighted else 6), np.nan)
            some = np.isfinite(x).all(axis=1)
            known[some] = self.forward.values(x[some])
            without, found = found, along_curves(self._rubbing, flat, targets, x, known)
            if len(self.names) >= _SEPARATE:
                alike = self._how["same_friction"]
                found = or_without(found, without, self._rubbing.ratio_sigma, alike)
            some = found.number > 0
            status[some] = by_probability(found)[some]
            degrees = len(self.names) - len(self._rubbing.free) + 1
            far = found.chi_squared[:, 0] > explained(degrees)
            status[some & far] = int(Status.NOT_ONE_CONTACT)
            lost = np.flatnonzero(~some & (without.number > 0))
            for ours, theirs in zip(found[1:], without[1:], strict=True):
                ours[lost, 0] = theirs[lost, 0]
            found.number[lost] = 1
        return self._possible(found, status)

    def following(self, values: Array) -> tuple[Candidates, IntArray]:
        """The same for one measurement (1, k) after another.

        If the contact before was certain, and one near it explains the measurement, others are not
        searched for until the contact has moved, or the base has turned, by more than a little.
        """
        path, self._path = self._path, None
        if path is not None and path.shape == self._proposing and self.forward.weighted:
            flat = values / self.scale
            targets = self.channels.targets(flat)
            start = np.zeros(1, np.int64), path.x[:1], _NO_STATUS
            found, status = self._possible(*self._fitted(flat, targets, *start))
            self._path = path.onward(found) if status[0] == Status.UNIQUE else None
            if self._path is not None:
                return found, status
        found, status = self(values)
        if self.forward.weighted and self._rubbing is None and status[0] == Status.UNIQUE:
            both = found.x[0, [0, 0]], found.values[0, [0, 0], 3:]
            self._path = _Path(*both, self._proposing)
        return found, status

    def forget(self) -> None:
        """Search for the next contact everywhere, as when this one has been lost."""
        self._path = None

    def _possible(self, found: Candidates, status: IntArray) -> tuple[Candidates, IntArray]:
        """Candidates that the prior allows, and the statuses."""
        if self.prior is None:
            return found, status
        some = found.number > 0
        found = found.allowed_first(possible_candidates(self.prior, self.whisker, self.d, found))
        with np.errstate(invalid="ignore"):
            found.probability[:] /= np.nansum(found.probability, axis=1, keepdims=True)
        explained_now = np.isin(status, (int(Status.UNIQUE), int(Status.AMBIGUOUS)))
        left = some & (found.number > 0) & explained_now
        status[left] = by_probability(found)[left]
        status[some & (found.number == 0)] = int(Status.OUTSIDE_PRIOR)
        return found, status

    @property
    def uncertain(self) -> bool:
        """Whether friction, the weight or the base is uncertain, or the stiffness and so the sag.

        A small uncertainty of the sag is neglected: an uncertain stiffness is an error of gain.
        """
        weight = self.gravity is not None and self.gravity.uncertain
        if self._rubbing or self._how["compliance_sigma"] or weight:
            return True
        return self.forward.weighted and self._how["stiffness_sigma"] * self._sag > _SAME_SAG

    @property
    def sagged(self) -> ChartedWhisker:
        """Map of a weightless whisker with the sagged shape, or nearly so."""
        assert self.contact_map is not None
        return _sagged(self.contact_map, self.shape)

    @property
    def shape(self) -> Vector:
        """Gravity of that shape, whisker frame, m/s²; noise hides the difference from this pose."""
        assert self.gravity is not None
        # A deviation δ of the tip, over L, is a force of 3 δ.
        hidden = self._least / (3.0 * max(self._sag, 1e-300))
        return self.gravity.nearly(1.0, min(max(2.0 * hidden, _FINEST_TURN), _LEAST_TURN))

    def nearly(self, now: Vector, before: Vector) -> bool:
        """Whether the resting shapes under two accelerations, m/s², are nearly the same."""
        assert self._lab is not None
        return math.dist(now, before) < self._turn * math.hypot(*self._lab.acceleration)

    def direction(self, rotation: Array) -> tuple[float, ...]:
        """Gravity of the laboratory frame in the frame of a base turned by (3, 3)."""
        if self._lab is None or not np.isfinite(rotation).all():
            return ()
        return self._lab.turned(rotation, self._step).acceleration

    @property
    def laboratory_gravity(self) -> Vector | None:
        """Stated gravity in the frame that rotations of the base lead to."""
        return None if self._lab is None else self._lab.acceleration

    def turned(self, rotation: Array, gravity: ArrayLike | None = None) -> JointEstimate:
        """The same estimate for a turned base (3, 3), with gravity in the laboratory frame.

        Gravity is the stated one, or ``gravity`` (3,), already reduced by the base's acceleration.
        """
        if (stated := self._lab) is None:
            return self
        lab = stated
        if gravity is not None:
            x, y, z = np.asarray(gravity, dtype=np.float64).tolist()
            lab = replace(stated, acceleration=(x, y, z))
        if not (np.isfinite(rotation).all() and np.isfinite(lab.acceleration).all()):
            return self
        weight = lab.turned(rotation, self._step)
        if weight == self.gravity:
            return self
        names = self.names, self.sensor, self.prior
        out = JointEstimate(self.whisker, self.contact_map, *names, gravity=weight, **self._how)
        # Contacts are proposed by resting shapes under gravity of the stated size, which are few.
        now = max(float(np.linalg.norm(weight.acceleration)), _WEIGHTLESS)
        out._proposing = weight.nearly(float(np.linalg.norm(stated.acceleration)) / now)
        before = self._proposing if self._path is not None else None
        if before is not None and self.nearly(out._proposing, before):
            out._proposing = before
        # The first pose is that of the tare, unless readings are without weight in every pose.
        out._lab = stated if self._how["without_weight"] else replace(stated, tare=weight.tare)
        out._step, out._turn = self._step, self._turn
        out._path, out._searches = self._path, self._searches
        return out

    @cached_property
    def _turn(self) -> float:
        """Turn of the base, rad, up to which a resting shape proposes contacts."""
        return float(np.clip(_AS_BENT / max(self._sag, 1e-300), _LEAST_TURN, _LARGEST_TURN))

    @property
    def _sag(self) -> float:
        """Sag of the tip, over L, of a level cylinder; it is about half as large with a taper."""
        assert self._lab is not None
        assert self.whisker.density is not None
        load = self.whisker.density * float(np.linalg.norm(self._lab.acceleration))
        stiffness = self.whisker.youngs_modulus * self.whisker.base_radius**2
        return 0.5 * load * self.whisker.length**3 / stiffness

    def untared(self, values: Array) -> Array:
        """Measurements (n, k), SI units, as if the sensor had been tared in this pose."""
        if not self._shift.any():
            return values
        targets = self.channels.targets(values / self.scale) - self._shift
        return self.signals_of(targets)

    def signals_of(self, targets: Array) -> Array:
        """Signals (n, k), SI units, of channels."""
        values = targets.copy()
        for i in self.channels.pairs():
            y, z = targets[:, i], targets[:, i + 1]
            values[:, i], values[:, i + 1] = np.hypot(y, z), np.arctan2(z, y)
        return values * self.scale

    @property
    def _noise(self) -> Noise | None:
        """The stated noise."""
        if self.sensor is None:
            return None
        return self.sensor.deviations if self.sensor.wrench is None else self.sensor.wrench

    def _without_friction(
        self, values: Array, flat: Array, targets: Array
    ) -> tuple[Candidates, IntArray]:
        """Candidates without friction, except for the wrench."""
        if self.forward.weighted or self.contact_map is None:
            return self._fitted(flat, targets, *self._proposed(targets))
        errors = _NO_ERRORS if self.sensor is None else self.sensor.errors
        signals = dict(zip(self.names, values.T, strict=True))
        one = estimate(self.contact_map, signals, self.names, self._noise, errors, None)
        found = Candidates.room(len(flat), 1)
        found.x[:, 0, 0] = one.arc_length / self.d.length
        found.x[:, 0, 1:] = one.contact_force / self.d.force
        found.values[:, 0, :3] = one.force / self.d.force
        found.values[:, 0, 3:] = one.point / self.d.length
        found.covariances[:, 0] = one.covariance / self.d.length**2
        found.chi_squared[:, 0], found.valid[:, 0] = one.chi_squared, one.covariance_valid
        found = found._replace(number=np.isfinite(found.x[:, 0, 0]).astype(np.int64))
        status = one.status.copy()
        if self.forward.errors:
            found, status, _ = self._fit.allow(flat, targets, found, status)
        return found, status

    def _proposed(self, targets: Array) -> tuple[IntArray, Array, IntArray]:
        """Contacts of the weightless whisker of the sagged shape: near ones and exact ones.

        Rows and contacts x (m, 4) to start from, and statuses of rows (n,) without any.

        Signals just beyond those of its map have no exact contact; light contacts are found from
        the near ones.
        """
        values, names = self.signals_of(targets), self.channels.signals
        if names == WRENCH or self.contact_map is None:
            rod, signals = self.forward.rod, dict(zip(names, values.T, strict=True))
            shape = rod.shape() if isinstance(rod, Resting) else rod
            one = estimate_components(shape, signals, None, _NO_ERRORS, None)
            d, own = self.d, one.candidates
            x = np.concatenate(
                [own.arc_length[..., None] / d.length, own.contact_force / d.force], axis=-1
            )
            status = np.asarray(one.status)
        else:
            x, status = self._exact(values)
        row, place = np.nonzero(np.isfinite(x[..., 0]))
        starts = row, x[row, place]
        if self.forward.weighted and names != WRENCH and self.contact_map is not None:
            starts = self._farther(targets, *starts)
        return *starts, status

    def _farther(self, targets: Array, row: IntArray, x: Array) -> tuple[IntArray, Array]:
        """Proposals x (m, 4) of rows, and others that fits from these do not reach."""
        along = leave_few_paths(self._telling.signals)
        # With the moment and a direction the force at each arc length is known: there is one path.
        if not (along and "MB" in self._telling.signals):
            row, x = self._corrected(targets, row, x)
        if not along or not row.size:
            return row, x
        evenly = evenly_weighted(self.forward, self._telling, self._fit.least)
        rest = self._told(self.signals_of(targets) / self.scale)
        rows, sought = sought_along(evenly, *rest, row, x)
        return np.append(row, rows), np.concatenate([x, sought])

    def _corrected(self, targets: Array, row: IntArray, x: Array) -> tuple[IntArray, Array]:
        """Proposals x (m, 4) of rows, and what they become for corrected targets.

        The sagged weightless whisker has other signals than that with weight, by a difference that
        varies little along the map. Subtracted from the measured ones, as it is at a proposal, it
        leads to contacts that a fit from that proposal does not reach.
        """
        rod = self.sagged.chart.discretization
        index = [CHANNELS.index(name) for name in self.channels.names]
        rows, starts = [row], [x]
        for _ in range(_CORRECTIONS):
            more = channels_of(self.forward.values(x)) - channels_of(solve_forces(rod, x)[0])
            found, _ = self._exact(self.signals_of(targets[row] - more[:, index]))
            each, place = np.nonzero(np.isfinite(found[..., 0]))
            rows.append(row[each])
            starts.append(found[each, place])
            away = np.abs(found[..., 0] - x[:, :1])
            known = np.isfinite(away).any(axis=1)
            nearest = np.where(np.isfinite(away), away, np.inf).argmin(axis=1)[known]
            row, x = row[known], found[known, nearest]
        row, x = np.concatenate(rows), np.concatenate(starts)
        alike = np.column_stack([row, (x / _ALIKE).round()])
        kept = np.sort(np.unique(alike, axis=0, return_index=True)[1])
        return row[kept], x[kept]

    def _exact(self, values: Array) -> tuple[Array, IntArray]:
        """Contacts (n, m, 4) of the sagged whisker for signals without noise, and statuses (n,)."""
        flat = values / self.scale
        check_scale(flat, self.names)
        known = np.isfinite(flat).all(axis=1)
        status = np.where(known, int(Status.DEGENERATE), int(Status.MISSING))
        x = [np.full((len(flat), 1, 4), np.nan)]
        for search in self._sagged_searches().exact:
            found, reason, _ = search.batch(*self._told(flat))
            status = reason if len(x) == 1 else status
            x.append(found.x)
        return np.concatenate(x, axis=1), status

    def _fitted(
        self, flat: Array, targets: Array, row: IntArray, seeds: Array, reasons: IntArray
    ) -> tuple[Candidates, IntArray]:
        """Candidates in order, and statuses, from starts of rows; reasons for rows without any."""
        n, fitting = len(flat), self._fit
        fits = fitting.fit(flat[row], targets[row], seeds)
        degrees = fitting.degrees(flat[row], fits.values)
        exact = self.sensor is None and degrees == 0
        limit = _EXACT if exact else explained(degrees)
        if self.forward.weighted and not fitting.friction:
            fits = held_back(fitting, flat, targets, row, fits, limit)
        doubt = np.linalg.norm(fits.contacts[:, 1:], axis=1)
        if fitting.friction:
            doubt = fits.misfits + (friction_angle(fits.contacts) / LIKELY_FRICTION) ** 2
        kept = chosen(n, row, fits, doubt, limit, _MOST)
        found = Candidates.room(n, _MOST)._replace(
            number=kept.number,
            x=kept.contacts,
            values=kept.values[..., :6],
            chi_squared=kept.misfits,
        )
        row, place = np.nonzero(np.isfinite(kept.misfits))
        if self.sensor is not None and row.size:
            parts: list[Any] = [part[row, place] for part in kept[1:]]
            parts.append(np.ones(len(row), np.bool_))
            found = self._ranked(flat[row], targets[row], Fits(*parts), found)
        status = by_probability(found)
        unexplained = Status.NOT_ONE_CONTACT if fitting.friction else Status.NOT_FRICTIONLESS
        status[~(found.chi_squared[:, 0] <= limit)] = int(unexplained)
        none = found.number == 0
        status[none] = reasons[none]
        if exact:
            lost = status == int(unexplained)
            found = found.allowed_first(np.isfinite(found.chi_squared) & ~lost[:, None])
        return found, status

    def _ranked(self, flat: Array, targets: Array, fits: Fits, found: Candidates) -> Candidates:
        """Candidates by probability, with their covariances."""
        row, place = np.nonzero(np.isfinite(found.chi_squared))
        joint = self._fit.joint(flat, targets, fits)
        covariance, valid = self._fit.to_second_order(joint, fits)
        if self.forward.weighted and self.contact_map is not None and self.names != WRENCH:
            covariance, valid = self._as_sagged(joint, fits, covariance, valid)
        found.values[row, place] = joint.values[:, :6]
        found.covariances[row, place], found.valid[row, place] = covariance, valid
        log = 0.5 * np.linalg.slogdet(covariance)[1] - 0.5 * fits.misfits
        if self._fit.friction:
            log -= 0.5 * (friction_angle(fits.contacts) / LIKELY_FRICTION) ** 2
        weight = np.full(found.chi_squared.shape, -np.inf)
        weight[row, place] = np.where(np.isfinite(log), log, -np.inf)
        probability, order = ranked(weight, found.number)
        return found.ordered(order, found.number)._replace(probability=probability)

    def _as_sagged(
        self, joint: Joint, fits: Fits, covariance: Array, valid: AnyArray
    ) -> tuple[Array, AnyArray]:
        """Covariances, or those of the same forces on the sagged weightless whisker if larger."""
        if (search := self._sagged_searches().noisy) is None:
            return covariance, np.zeros_like(valid)
        rod = search.contact_map.chart.discretization
        signals = channels_of(solve_forces(rod, fits.contacts)[0])
        flat = signals[:, [SIGNALS.index(name) for name in self.names]]
        found, _, _ = search.batch(*self._told(flat))
        away = np.abs(found.x[..., 0] - fits.contacts[:, :1])
        away[np.arange(away.shape[1]) >= found.number[:, None]] = np.inf
        each, place = np.arange(len(away)), np.where(np.isfinite(away), away, np.inf).argmin(axis=1)
        own, linear = found.covariances[each, place], found.valid[each, place]
        known = np.isfinite(own).all(axis=(1, 2)) & (away[each, place] < _SAME)
        own = np.where(known[:, None, None], own + self._fit.shared(joint), covariance)
        larger = np.trace(own, axis1=1, axis2=2) > np.trace(covariance, axis1=1, axis2=2)
        out = np.where(larger[:, None, None], own, covariance)
        # Their folds differ, and near these the regions, which are thin sheets, do as well.
        bent = known & np.isfinite(covariance).all(axis=(1, 2))
        bent &= is_near_fold(self.forward, fits)
        out[bent] = _at_least(covariance[bent], own[bent])
        return out, valid & known & linear

    def _told(self, flat: Array) -> tuple[Array, Array]:
        """Those of the signals (n, k) by which contacts are sought, and their channels."""
        flat = flat[:, [self.names.index(name) for name in self._telling.signals]]
        return flat, self._telling.targets(flat)

    def _sagged_searches(self) -> _Searches:
        """Searches on the sagged whisker, kept as long as its shape proposes contacts."""
        if self._searches is None or self._searches.shape != self._proposing:
            assert self.contact_map is not None
            assert self._proposing is not None
            sagged, own, exact = _sagged(self.contact_map, self._proposing), None, []
            names = self._telling.signals
            if len(names) >= 3 and sagged.determines(names):
                near = dict(zip(self.names, (_NEAR * self.scale).tolist(), strict=True))
                near = {name: near[name] for name in names}
                exact = [
                    Search(sagged, Named(sagged, names, sensor))
                    for sensor in (SensorNoise.of(near, names), None)
                ]
                if self.sensor is not None:
                    own = Search(sagged, Named(sagged, names, self.sensor))
            self._searches = _Searches(self._proposing, exact, own)
        return self._searches


def _at_least(a: Array, b: Array) -> Array:
    """Covariances (n, 3, 3) of which no direction has less variance than in either of two."""
    variance, axes = np.linalg.eigh(a)
    root = axes * np.sqrt(np.maximum(variance, _FLAT * variance[:, -1:]))[:, None]
    back = np.linalg.pinv(root)
    times, axes = np.linalg.eigh(back @ b @ np.swapaxes(back, 1, 2))
    root = root @ axes * np.sqrt(np.maximum(times, 1.0))[:, None]
    return np.asarray(root @ np.swapaxes(root, 1, 2))


@lru_cache(maxsize=_SHAPES)
def _sagged(contact_map: ChartedWhisker, gravity: Vector) -> ChartedWhisker:
    """Map of a weightless whisker with the shape under this gravity, m/s²."""
    return contact_map.sagged(gravity)


def _least_noise(sensor: SensorNoise | None, names: tuple[str, ...], d: Discretization) -> float:
    """Smallest standard deviation of a signal, or of a mix of components, non-dimensional."""
    if sensor is None:
        return 0.0
    if sensor.deviations is not None:
        scales = signal_scales(names, d.force, d.moment)
        return float(min(sensor.deviations[name] / scales[i] for i, name in enumerate(names)))
    assert sensor.wrench is not None
    scales = signal_scales(WRENCH, d.force, d.moment)
    least = np.linalg.eigvalsh(sensor.wrench / np.outer(scales, scales))[0]
    return float(np.sqrt(max(least, 0.0)))


def _shifts(names: tuple[str, ...], shift: Array) -> Array:
    """Change of channels due to a shift of (F, M)."""
    out = np.zeros(len(names))
    for i, name in enumerate(names):
        if name in WRENCH:
            out[i] = shift[WRENCH.index(name)]
        elif shift[[1, 2] if name.startswith("F") else [4, 5]].any():
            pair = "FT and FD" if name.startswith("F") else "MB and MD"
            raise ValueError(f"a tare under another gravity needs both {pair}; got {name} alone")
    return out


def estimate_jointly(
    whisker: Whisker,
    contact_map: ChartedWhisker | None,
    signals: xr.Dataset | Mapping[str, ArrayLike],
    using: str | Sequence[str],
    noise: Noise | None,
    errors: Array,
    prior: Prior | None,
    *,
    gravity: Gravity | None = None,
    friction: float = 0.0,
    compliance_sigma: float = 0.0,
    stiffness_sigma: float = 0.0,
    same_friction: bool = False,
    rotation: Array | None = None,
) -> Contacts:
    """Estimate contacts with weight, friction and uncertain parameters; see `ContactMap.estimate`.

    With rotations of the base (..., 3, 3), gravity is that of the laboratory frame.
    """
    names = WRENCH if using == "wrench" else selection(using)
    sensor = sensor_noise(noise, names, errors, whisker)
    if names == WRENCH and "force" in signals and "moment" in signals:
        force, moment, dims, coords = labelled_wrench(signals["force"], signals["moment"])
        values = np.concatenate([force, moment], axis=-1)
    else:
        values, dims, coords = measured(signals, names)
    if names != WRENCH:
        check_signals(values, names)
    find = JointEstimate(
        whisker,
        contact_map,
        names,
        sensor,
        prior,
        gravity=gravity,
        friction=friction,
        compliance_sigma=compliance_sigma,
        stiffness_sigma=stiffness_sigma,
        same_friction=same_friction,
    )
    flat, shape = values.reshape(-1, len(names)), values.shape[:-1]
    if rotation is None or gravity is None:
        found, status = find(find.untared(flat))
    elif rotation.shape[:-2] not in ((), shape):
        raise ValueError(
            f"base_rotation has shape {rotation.shape}; {(3, 3)} or {(*shape, 3, 3)} is needed"
        )
    else:
        turns = np.broadcast_to(rotation, (*shape, 3, 3)).reshape(-1, 3, 3)
        found, status = _in_poses(find, flat, turns)
    chi_squared = found.chi_squared[:, 0].copy()
    assumed = np.inf if names == WRENCH else friction
    return contacts_of(found, status, chi_squared, find.d, names, shape, dims, coords, assumed)


def _in_poses(find: JointEstimate, flat: Array, rotation: Array) -> tuple[Candidates, IntArray]:
    """Candidates of measurements in turned poses, grouped by the direction of gravity."""
    posed = finite(rotation)
    flat = np.where(posed[:, None], flat, np.nan)
    rows: dict[tuple[float, ...], list[int]] = {}
    for i, turn in enumerate(rotation):
        find = find.turned(turn) if posed[i] and not rows else find
        rows.setdefault(find.direction(turn), []).append(i)
    parts, statuses = [], []
    for some in rows.values():
        now = find.turned(rotation[some[0]])
        found, status = now(now.untared(flat[some]))
        parts.append(found)
        statuses.append(status)
    back = np.argsort(np.concatenate(list(rows.values())))
    whole: list[Any] = [part[back] for part in Candidates.joined(parts)]
    return Candidates(*whole), np.concatenate(statuses)[back]
