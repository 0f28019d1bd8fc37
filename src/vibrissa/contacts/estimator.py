"""Estimator of contacts for one measurement at a time, with its signals, noise and prior.

Many measurements at once pass through the same kernels (:mod:`~vibrissa.contacts.engine.search`).
Each is searched for in the whole map, so that no candidate is missed by searching only near the
last one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contacts.charted_whisker import ChartedWhisker, need_map
from vibrissa.contacts.contacts import Candidates, Contact, contact_of, nowhere
from vibrissa.contacts.engine.ambiguity import Ambiguity
from vibrissa.contacts.engine.prior import Prior, among_allowed, possible_candidates, refuse_tip
from vibrissa.contacts.engine.readout import ByName, Measurement, Mixed, Named, readout_of
from vibrissa.contacts.engine.search import LARGEST, STATUSES, UNKNOWNS, Search
from vibrissa.contacts.joint.forward import Gravity
from vibrissa.contacts.joint.joint_fit import JointFit, soft_base
from vibrissa.contacts.joint_estimate import JointEstimate
from vibrissa.contacts.sensing.channels import CHANNELS, channels_of
from vibrissa.contacts.sensing.noise import by_stiffness, common_errors, sensor_noise
from vibrissa.numerics import Array, Vector, numbers, rotation_matrices
from vibrissa.rod import PointContact, deflect
from vibrissa.sensors import GRAVITY, Sensor
from vibrissa.signals import selection
from vibrissa.status import Status

# Smallest arc length, over L, of contacts from whose measurements the weight is subtracted.
LEAST = 0.05


class Estimator:
    """Locate contacts one measurement at a time, in microseconds.

    Parameters
    ----------
    contact_map : ContactMap
        Map of the whisker's contacts.
    using : str or sequence of str
        Signals of a measurement, in this order; fewer than three do not determine a contact, but
        leave a curve or surface of contacts.
    noise : mapping or (6, 6) array_like, optional
        Standard deviation of each signal, or covariance of (F, M), SI units. Covariances of
        contacts are computed from it, and it weights the signals if they are more than three.
    stiffness_sigma : float
        Relative standard deviation of the whisker's bending stiffness E r⁴, part of the
        covariances: √(σ_E² + 16 σ_r²) for those of modulus and radius. It requires noise.
    felt_above : float
        Number of standard deviations within which signals count as zero, ``NOT_FELT``; 0, the
        default, locates all. It requires noise.
    gain_sigma : float or (6,) array_like
        Relative standard deviation of the sensor's gain, for all or each of Fx, Fy, Fz, Mx, My, Mz.
    mixing_sigma : float or (6, 6) array_like
        Standard deviation of the response of each of these to each of the six components; or one
        number, the relative standard deviation of the cross-talk among forces and among moments.
    prior : Prior, optional
        Possible contacts; others are left out of the candidates.
    compliance_sigma : float
        Standard deviation of the base's compliance, rad/(N·m), as in `ContactMap.estimate`, for
        three signals or more. It requires noise, and takes a millisecond more.
    friction : float
        Standard deviation of the ratio of the force along the whisker to that across it, as in
        `ContactMap.estimate`, for three signals or more; it takes some tens of milliseconds more.
    gravity : Gravity or (3,) array_like, optional
        Gravity under which the whisker bends, as in `ContactMap.estimate`, for three signals or
        more; it takes some tens of milliseconds more. For measurements with the rotation of the
        base, it is in the laboratory frame, and without a `Gravity.tare` the sensor is taken to
        have been tared in the first pose.

    See Also
    --------
    Estimator.of_sensor : From the raw readings of a sensor, however it mixes and is mounted.
    """

    friction = 0.0
    _base: JointFit | None = None
    _joint: JointEstimate | None = None
    _untared: JointEstimate | None = None
    _again: Callable[..., Estimator]

    def __init__(
        self,
        contact_map: ChartedWhisker,
        using: str | Sequence[str] = ("Fx", "MB", "MD"),
        noise: Mapping[str, float] | ArrayLike | None = None,
        stiffness_sigma: float = 0.0,
        felt_above: float = 0.0,
        gain_sigma: float | ArrayLike = 0.0,
        mixing_sigma: float | ArrayLike = 0.0,
        prior: Prior | None = None,
        compliance_sigma: float = 0.0,
        friction: float = 0.0,
        gravity: Gravity | ArrayLike | None = None,
    ) -> None:
        need_map(contact_map)
        if isinstance(using, Sensor) or isinstance(noise, Sensor):
            raise ValueError(
                "readings of a Sensor are located by Estimator.of_sensor(contact_map, sensor)"
            )
        names = selection(using, least=1)
        given = using.replace(",", " ").split() if isinstance(using, str) else using
        order = [selection([name], least=1)[0] for name in given]
        errors = common_errors(stiffness_sigma, gain_sigma, mixing_sigma)
        sensor = sensor_noise(noise, names, errors, contact_map.whisker)
        places = [order.index(name) for name in names]
        self._order: list[int] | None = places if places != sorted(places) else None
        if felt_above > 0.0 and sensor is None:
            raise ValueError("contact is detected by comparison with the noise; noise is needed")
        readout = Named(contact_map, names, sensor)
        self._start(contact_map, readout, len(names), felt_above, prior)
        stated = (noise, stiffness_sigma, felt_above, gain_sigma, mixing_sigma, prior)
        self._again = partial(_on_map, Estimator, names, *stated)
        self._allow(stiffness_sigma, compliance_sigma, friction, Gravity.of(gravity))

    def _allow(
        self, stiffness: float, compliance: float, friction: float, gravity: Gravity | None
    ) -> None:
        """Set up weight, friction and an uncertain base."""
        stated = {"compliance_sigma": compliance, "friction": friction, "gravity": gravity}
        if not any(stated.values()):
            return
        if self._search is None or not isinstance(self.readout, Named):
            raise ValueError(f"{', '.join(stated)} are for three signals or more")
        refuse_tip(self.prior, f"of {', '.join(stated)} one is stated")
        contact_map, sensor = self.contact_map, self.readout.sensor
        if gravity is None and not friction:
            rod = contact_map.whisker, contact_map.steps
            self._base = soft_base(*rod, self.readout.channels, sensor, compliance)
            return
        self.friction = friction
        self._joint = self._untared = JointEstimate(
            contact_map.whisker,
            contact_map,
            self.names,
            sensor,
            self.prior,
            gravity=gravity,
            friction=friction,
            compliance_sigma=compliance,
            stiffness_sigma=stiffness,
            without_weight=self._sensor is not None and self._sensor.mass > 0.0,
        )

    @classmethod
    def of_sensor(
        cls,
        contact_map: ChartedWhisker,
        sensor: Sensor,
        stiffness_sigma: float = 0.0,
        felt_above: float = 0.0,
        prior: Prior | None = None,
        gravity: Gravity | ArrayLike | None = None,
    ) -> Estimator:
        """Locate contacts from a sensor's raw readings.

        Parameters
        ----------
        contact_map : ContactMap
            Map of the whisker's contacts.
        sensor : Sensor
            Sensor with its channels, mounting, noise and the errors of its gain, mixing and
            calibration, all in the covariances; offset and weight are taken away.
        stiffness_sigma : float
            Relative standard deviation of the whisker's bending stiffness.
        felt_above : float
            Number of standard deviations, of noise and drift, within which readings count as zero,
            ``NOT_FELT``; 0 locates all.
        prior : Prior, optional
            Possible contacts.
        gravity : Gravity or (3,) array_like, optional
            Gravity that the whisker bends under, as of `Estimator`, for sensors whose channels
            determine the six signals. The mass of a sensor includes the whisker's, as found by
            `calibrate_weight` with the whisker mounted, unless `Gravity.tare` is stated: zeros,
            if it is without the whisker.

        Returns
        -------
        Estimator
            Estimator for readings, and where the sensor carries a mass for readings and rotation.

        Raises
        ------
        ValueError
            If a channel has no noise, or channels do not tell anything.
        """
        if not isinstance(sensor, Sensor):
            raise ValueError(
                "a Sensor is needed; signals by name and their noise are stated by "
                f"Estimator(contact_map, using, noise); got {sensor!r}"
            )
        out = cls.__new__(cls)
        h, covariance = sensor.base_mixing, sensor.covariance()
        noise = np.diag(covariance)
        if not (noise > 0.0).all():
            silent = [n for n, v in zip(sensor.channels, noise, strict=True) if not v > 0.0]
            raise ValueError(f"readings are weighed by their noise; {', '.join(silent)} has none")
        if not h.any():
            raise ValueError("the sensor's channels read nothing of force and moment")
        shared = by_stiffness(h, stiffness_sigma), sensor.common_errors, sensor.drift_errors
        errors = np.concatenate(shared)
        readout = readout_of(contact_map, h, covariance, errors)
        out._order = None
        out._start(contact_map, readout, len(sensor.channels), felt_above, prior)
        out.felt_above *= sensor.unsteadiness
        out._sensor = sensor
        stated = (stiffness_sigma, felt_above, prior)
        out._again = partial(_on_map, Estimator.of_sensor, sensor, *stated)
        out._allow(stiffness_sigma, 0.0, 0.0, Gravity.of(gravity))
        return out

    def _start(
        self,
        contact_map: ChartedWhisker,
        readout: ByName | Named | Mixed,
        width: int,
        felt_above: float,
        prior: Prior | None,
    ) -> None:
        if not (prior is None or isinstance(prior, Prior)):
            raise ValueError(f"prior is a Prior; got {prior!r}")
        if not 0.0 <= felt_above < math.inf:
            raise ValueError(f"felt_above is a number of standard deviations; got {felt_above!r}")
        self.prior = prior
        self.felt_above = float(felt_above)
        self._sensor: Sensor | None = None
        self._components = readout if isinstance(readout, ByName) else None
        self.readout = readout.named if isinstance(readout, ByName) else readout
        self._width = width
        self.contact_map = contact_map
        rank, named = self.readout.rank, isinstance(self.readout, Named)
        self._determining = rank < UNKNOWNS or not named or contact_map.determines(self.names)
        self._search = Search(contact_map, self.readout) if rank >= UNKNOWNS else None
        self._ambiguity = None
        if rank < UNKNOWNS:
            refuse_tip(prior, f"{rank} do not determine a contact")
            self._ambiguity = Ambiguity(contact_map.chart, self.readout)
        self._last: Array | None = None

    def __repr__(self) -> str:
        of = self.contact_map.whisker
        return f"<Estimator from ({', '.join(self.announced)}) of {of!r}>"

    @property
    def softened(self) -> bool:
        """Whether friction, the weight, the sag or the base is uncertain."""
        return self._base is not None or (self._joint is not None and self._joint.uncertain)

    @property
    def noisy(self) -> bool:
        """Whether the noise is known, so that there are covariances."""
        return self.readout.noisy

    @property
    def names(self) -> tuple[str, ...]:
        """Signals used for estimates, in canonical order; none for mixed components."""
        return self.readout.names if isinstance(self.readout, Named) else ()

    @cached_property
    def announced(self) -> tuple[str, ...]:
        """Names of the values of one measurement, in order."""
        if self._sensor is not None:
            return tuple(self._sensor.channels)
        order = np.argsort(self._order or range(len(self.names))).tolist()
        return tuple(self.names[i] for i in order)

    @property
    def sensor(self) -> Sensor | None:
        """The sensor whose readings are the measurements, if there is one."""
        return self._sensor

    def reset(self) -> None:
        """Discard the measurement before, as when contact has been lost."""
        self._last = None
        if self._joint is not None:
            self._joint.forget()

    def restart(self) -> None:
        """Discard all measurements: the sensor counts as tared in the next pose."""
        self.reset()
        self._joint = self._untared

    def __call__(
        self,
        signals: ArrayLike,
        rotation: ArrayLike | None = None,
        gravity: ArrayLike | None = None,
    ) -> Contact:
        """Locate one measurement."""
        return self.locate(self.measurement(signals, rotation, gravity))

    def measurement(
        self,
        signals: ArrayLike,
        rotation: ArrayLike | None = None,
        gravity: ArrayLike | None = None,
    ) -> Measurement:
        """Check one measurement and make it non-dimensional; as for calling the estimator.

        Parameters
        ----------
        signals : (k,) array_like
            Signals or readings, SI units.
        rotation : (3, 3) array_like, optional
            Rotation from the whisker's to the laboratory frame.
        gravity : (3,) array_like, optional
            Gravity minus the acceleration of the base, m/s², for the whisker and for what the
            sensor carries: laboratory frame, or without a rotation the whisker's. By default that
            which was stated, or standard gravity.

        Returns
        -------
        Measurement
            Input of `locate`; NaN for what is missing.
        """
        values = numbers("a measurement", signals, self.announced)
        if values.shape != (self._width,):
            raise ValueError(f"one measurement has {self._width} signals; got shape {values.shape}")
        if not max(map(abs, values.tolist())) < LARGEST:
            values = np.where(np.isinf(values), np.nan, np.clip(values, -LARGEST, LARGEST))
        if rotation is not None:
            rotation = rotation_matrices("rotation", rotation)
        elif gravity is not None:
            rotation = np.eye(3)
        if self._sensor is not None:
            stated = None if self._joint is None else self._joint.laboratory_gravity
            pull = next((one for one in (gravity, stated) if one is not None), GRAVITY)
            values = self._sensor.compensated(values, rotation, pull)
            if self._components is not None:
                values = self._components.signals(values)
        elif self._order is not None:
            values = values[self._order]
        if self._joint is not None:
            if rotation is not None:
                self._joint = self._joint.turned(rotation, gravity)
            values = self._joint.untared(values[None])[0]
        return self.readout.scaled(values)

    def reading_at_rest(self, rotation: Array | None, gravity: Array | None) -> Array | float:
        """Readings of a sensor due to the weight of the free whisker since the tare.

        Parameters
        ----------
        rotation : array (3, 3) or None
            Rotation of the base, from the whisker frame to that of gravity.
        gravity : array (3,) or None
            Gravity minus the acceleration of the base, m/s²; by default the one stated at first.

        Returns
        -------
        array (k,) or float
            The readings, in units of the sensor's channels; 0 without weight or rotation.
        """
        if self._joint is None or self._sensor is None or rotation is None:
            return 0.0
        self._joint = self._joint.turned(rotation, gravity)
        d = self._joint.d
        scale = np.repeat([d.force, d.moment], 3)
        return np.asarray(self._sensor.base_mixing @ (scale * self._joint.forward.shift))

    def locate(self, measurement: Measurement) -> Contact:
        """Locate one measurement.

        Parameters
        ----------
        measurement : Measurement
            Result of `measurement`.

        Returns
        -------
        Contact
            The contact, all candidates, and the status.
        """
        d = self.contact_map.chart.discretization
        if (nothing := self.nothing_in(measurement)) is not None:
            self.reset()
            return nowhere(nothing, math.nan, d)
        if self._search is None:
            return self._sampled(measurement)
        if self._joint is not None:
            found, codes = self._joint.following(measurement.measured[None] * self._joint.scale)
            status, chi_squared = STATUSES[int(codes[0])], float(found.chi_squared[0, 0])
        else:
            found, status, chi_squared = self._search.one(measurement)
        if self.prior is not None and self._joint is None:
            pair = measurement.measured[None], measurement.target[None]
            found, codes, chi = among_allowed(
                self.prior,
                self.contact_map,
                self.readout,
                pair,
                found,
                np.array([int(status)]),
                np.array([chi_squared]),
            )
            status, chi_squared = STATUSES[int(codes[0])], float(chi[0])
        if self._base is not None:
            flat, target = measurement.measured[None], measurement.target[None]
            found, codes, chi = self._base.allow(flat, target, found, np.array([int(status)]))
            status, chi_squared = STATUSES[int(codes[0])], float(chi[0])
        number, continuing = int(found.number[0]), 0
        if number > 1 and self._last is not None:
            away = found.values[0, :number, 3:] - self._last
            continuing = int((away * away).sum(axis=1).argmin())
        self._last = found.values[0, continuing, 3:] if number else None
        return contact_of(
            found, status, chi_squared, d, self.names, continuing, friction=self.friction
        )

    @property
    def weighted(self) -> bool:
        """Whether the whisker bends under its weight."""
        return self._joint is not None and self._joint.forward.weighted

    def sagged(self) -> Estimator:
        """Return an estimator of a whisker without weight that has the sagged shape at rest.

        Returns
        -------
        Estimator
            The same signals, noise and prior.
        """
        assert self._joint is not None
        return self._again(contact_map=self._joint.sagged)

    @property
    def resting(self) -> Vector:
        """Gravity under which that whisker rests in the last pose, whisker frame, m/s²."""
        assert self._joint is not None
        return self._joint.shape

    def rests_nearly(self, before: Vector) -> bool:
        """Return whether the whisker rests nearly as under another gravity.

        Parameters
        ----------
        before : tuple of float
            Gravity of another pose, whisker frame, m/s².

        Returns
        -------
        bool
            Whether the sagged shape is nearly the same.
        """
        assert self._joint is not None
        return self._joint.nearly(self._joint.shape, before)

    def of_sagged(
        self, measurement: Measurement, sagged: Estimator
    ) -> tuple[Measurement, Status | None]:
        """Return what the sagged whisker without weight would measure of the same contact point.

        Parameters
        ----------
        measurement : Measurement
            Measurement of this estimator.
        sagged : Estimator
            Estimator of the sagged whisker.

        Returns
        -------
        Measurement
            The same with what noise adds to more than three signals; NaN where there is no contact.
        Status or None
            Reason why there is none.
        """
        assert self._joint is not None
        nothing = self.nothing_in(measurement)
        if nothing is not None:
            self.reset()
            return measurement, nothing
        names = self._joint.channels.names
        found, status = self._joint.following(measurement.measured[None] * self._joint.scale)
        d, target = self._joint.d, np.full(len(names), np.nan)
        if found.number[0]:
            there = PointContact(found.values[0, 0, 3:] * d.length)
            bent = deflect(sagged.contact_map.whisker, there, proximal=LEAST)
            values = np.concatenate([bent.force / d.force, bent.contact_point / d.length])
            which = [CHANNELS.index(name) for name in names]
            weighted = self._joint.forward.values(found.x[:, 0])
            away = channels_of(values[None]) - channels_of(weighted)
            target = measurement.target + away[0, which]
        if not np.isfinite(target).all():
            reason = Status(int(status[0]))
            # A contact that the sagged whisker without weight cannot have is beyond its map.
            nothing = Status.OUTSIDE_MAP if reason in (Status.UNIQUE, Status.AMBIGUOUS) else reason
        return self.readout.scaled(self._joint.signals_of(target[None])[0]), nothing

    def nothing_in(self, measurement: Measurement) -> Status | None:
        """Reason why a measurement needs no search: ``MISSING``, ``NOT_FELT``, ``DEGENERATE``.

        Parameters
        ----------
        measurement : Measurement
            Result of `measurement`.

        Returns
        -------
        Status or None
            None where it is worth one.
        """
        if not all(map(math.isfinite, measurement.measured.tolist())):
            return Status.MISSING
        if self.felt_above > 0.0 and not self.readout.detected(measurement, self.felt_above):
            return Status.NOT_FELT
        return None if self._determining else Status.DEGENERATE

    def _sampled(self, measurement: Measurement) -> Contact:
        """Samples of the curve or surface of contacts that explain fewer than three signals."""
        assert self._ambiguity is not None
        d, readout = self.contact_map.chart.discretization, self.readout
        if readout.nothing(measurement):
            return nowhere(Status.DEGENERATE, math.nan, d)
        found, middle, covariance = self._ambiguity.samples(measurement)
        if not found.number[0]:
            beyond = readout.beyond(measurement)
            return nowhere(Status.OUTSIDE_MAP if beyond else Status.NOT_FRICTIONLESS, math.nan, d)
        if self.prior is not None:
            kept = np.flatnonzero(
                possible_candidates(self.prior, self.contact_map.whisker, d, found, near=False)[0]
            )
            if not kept.size:
                return nowhere(Status.OUTSIDE_PRIOR, 0.0, d)
            if kept.size < found.number[0]:
                found = Candidates(np.array([kept.size]), *(part[:, kept] for part in found[1:]))
                points = found.values[0, :, 3:]
                middle = int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmin())
                away = points - points[middle]
                covariance = away.T @ away / kept.size + found.covariances[0].mean(axis=0)
        if not readout.noisy:
            covariance[:], found.covariances[:] = np.nan, np.nan
        status, size = Status.UNDERDETERMINED, d.length**2
        return contact_of(found, status, 0.0, d, self.names, middle, middle, covariance * size)


def _on_map(
    made: Callable[..., Estimator], *stated: object, contact_map: ChartedWhisker
) -> Estimator:
    return made(contact_map, *stated)
