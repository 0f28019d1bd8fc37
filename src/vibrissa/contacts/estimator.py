"""One measurement at a time, in microseconds: for streams, without labelled datasets around it.

Each measurement is searched for in the whole map, so that no candidate is lost by looking only near
the last one; the search tree leads to the contacts in the time that a fit from the last one takes.
The contact that was followed so far is one more place to start from, and it tells which candidate
goes on from it.

Fewer than three signals leave a curve or a surface of contacts: see
:mod:`~vibrissa.contacts.ambiguity`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contacts.located import Located, nowhere
from vibrissa.contacts.noise import by_stiffness, common_errors, sensor_noise
from vibrissa.contacts.prior import Prior, located_where_allowed
from vibrissa.contacts.readout import Measurement, Mixed, Named
from vibrissa.contacts.sensor_readout import ByName, readout_of
from vibrissa.contacts.single_search import ExactSearch, LeastSquaresSearch, SetSearch
from vibrissa.sensors import GRAVITY, Sensor
from vibrissa.signals import selection
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

_UNKNOWNS = 3
# What is larger is brought to this: no less absurd, in any unit, and its square is still a number.
_LARGEST = 1e100


class Estimator:
    """Locate contacts from a stream of signals.

    Parameters
    ----------
    contact_map : ContactMap
        The whisker's map.
    triplet : str or sequence of str
        The signals that the stream carries, in this order; fewer than three do not determine a
        contact, but leave a curve or surface of them.
    noise : mapping or (6, 6) array_like, optional
        Standard deviation of each signal, or covariance of (F, M), SI units: gives covariances, and
        weighs more than three signals.
    stiffness_sigma : float
        Relative standard deviation of the whisker's bending stiffness E r⁴, in the covariances:
        √(σ_E² + 16 σ_r²) of those of modulus and radius. It needs noise.
    felt_above : float
        Signals within so many standard deviations of zero are ``NOT_FELT``; 0, the default,
        locates all. It needs noise.
    gain_sigma : float or (6,) array_like
        Relative standard deviation of the sensor's gains, of all or each of Fx, Fy, Fz, Mx, My, Mz.
    mixing_sigma : float or (6, 6) array_like
        Standard deviations of what each of these reads of all six; or one number, relative: of the
        cross-talk among forces, and among moments.
    prior : Prior, optional
        Which contacts are possible; others are left out of the candidates.

    See Also
    --------
    Estimator.of_sensor : From the raw readings of a sensor, however it mixes and is mounted.
    """

    def __init__(
        self,
        contact_map: ContactMap,
        triplet: str | Sequence[str] = ("Fx", "MB", "MD"),
        noise: Mapping[str, float] | ArrayLike | None = None,
        stiffness_sigma: float = 0.0,
        felt_above: float = 0.0,
        gain_sigma: float | ArrayLike = 0.0,
        mixing_sigma: float | ArrayLike = 0.0,
        prior: Prior | None = None,
    ) -> None:
        names = selection(triplet, least=1)
        order = triplet.replace(",", " ").split() if isinstance(triplet, str) else list(triplet)
        errors = common_errors(stiffness_sigma, gain_sigma, mixing_sigma)
        sensor = sensor_noise(noise, names, errors)
        self._order: list[int] | None = [order.index(name) for name in names]
        if felt_above > 0.0 and sensor is None:
            raise ValueError("what is felt is judged by the noise, and there is none")
        self._start(contact_map, Named(contact_map, names, sensor), len(names), felt_above, prior)

    @classmethod
    def of_sensor(
        cls,
        contact_map: ContactMap,
        sensor: Sensor,
        stiffness_sigma: float = 0.0,
        felt_above: float = 0.0,
        prior: Prior | None = None,
    ) -> Estimator:
        """Locate contacts from a sensor's raw readings.

        Parameters
        ----------
        contact_map : ContactMap
            The whisker's map.
        sensor : Sensor
            What it reads, how it is mounted, its noise and the errors of its gain, mixing and
            calibration, all in the covariances; offset and weight are taken away.
        stiffness_sigma : float
            Relative standard deviation of the whisker's bending stiffness.
        felt_above : float
            Readings within so many standard deviations of zero are ``NOT_FELT``; 0 locates all.
        prior : Prior, optional
            Which contacts are possible.

        Returns
        -------
        Estimator
            To be called with readings, and where the sensor carries a mass with the rotation.

        Raises
        ------
        ValueError
            If a channel has no noise, or channels do not tell anything.
        """
        out = cls.__new__(cls)
        h, covariance = sensor.base_mixing, sensor.covariance()
        noise = np.diag(covariance)
        if not (noise > 0.0).all():
            silent = [n for n, v in zip(sensor.channels, noise, strict=True) if not v > 0.0]
            raise ValueError(f"readings are weighed by their noise; {', '.join(silent)} has none")
        if not h.any():
            raise ValueError("the sensor's channels read nothing of force and moment")
        errors = np.concatenate([by_stiffness(h, stiffness_sigma), sensor.common_errors])
        readout = readout_of(contact_map, h, covariance, errors)
        out._order = None
        out._start(contact_map, readout, len(sensor.channels), felt_above, prior)
        out._sensor = sensor
        return out

    def _start(
        self,
        contact_map: ContactMap,
        readout: ByName | Named | Mixed,
        width: int,
        felt_above: float,
        prior: Prior | None,
    ) -> None:
        self.prior = prior
        self.felt_above = float(felt_above)
        self._sensor: Sensor | None = None
        self._components = readout if isinstance(readout, ByName) else None
        self.readout = readout.named if isinstance(readout, ByName) else readout
        self._width = width
        self.contact_map = contact_map
        told, named = self.readout.told, isinstance(self.readout, Named)
        self._determining = told < _UNKNOWNS or not named or contact_map.determines(self.names)
        self._search = self._chosen_search()

    def _chosen_search(self) -> ExactSearch | LeastSquaresSearch | SetSearch:
        """How contacts are looked for, by how many independent numbers a measurement tells."""
        contact_map, readout = self.contact_map, self.readout
        if readout.told < _UNKNOWNS:
            return SetSearch(contact_map, readout)
        if isinstance(readout, Named) and len(readout.names) == _UNKNOWNS:
            return ExactSearch(contact_map, readout)
        return LeastSquaresSearch(contact_map, readout)

    @property
    def noisy(self) -> bool:
        """Whether noise is known, so that there are covariances."""
        return self.readout.noisy

    @property
    def names(self) -> tuple[str, ...]:
        """Signals that contacts are found from, in canonical order; none of a mix of components."""
        return self.readout.names if isinstance(self.readout, Named) else ()

    @property
    def announced(self) -> tuple[str, ...]:
        """Names of the numbers of one measurement, in their order."""
        if self._sensor is not None:
            return tuple(self._sensor.channels)
        order = np.argsort(self._order or range(len(self.names))).tolist()
        return tuple(self.names[i] for i in order)

    @property
    def sensor(self) -> Sensor | None:
        """The sensor whose readings it takes, if it is of one."""
        return self._sensor

    def reset(self) -> None:
        """Forget the measurement before, as when the whisker has lost touch."""
        self._search.forget()

    def __call__(
        self,
        signals: ArrayLike,
        rotation: ArrayLike | None = None,
        gravity: ArrayLike = GRAVITY,
    ) -> Located:
        """Locate one measurement."""
        return self.locate(self.measurement(signals, rotation, gravity))

    def measurement(
        self,
        signals: ArrayLike,
        rotation: ArrayLike | None = None,
        gravity: ArrayLike = GRAVITY,
    ) -> Measurement:
        """Check one measurement and make it non-dimensional; as for calling the estimator.

        Parameters
        ----------
        signals : (k,) array_like
            The signals or readings.
        rotation : (3, 3) array_like, optional
            From the whisker's to the laboratory frame.
        gravity : (3,) array_like
            In the laboratory frame, m/s².

        Returns
        -------
        Measurement
            For `locate`; NaN for what is missing.
        """
        try:
            values = np.asarray(signals, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"one measurement has {self._width} numbers; got {signals!r}"
            ) from error
        if values.shape != (self._width,):
            raise ValueError(f"one measurement has {self._width} signals; got shape {values.shape}")
        if not max(map(abs, values.tolist())) < _LARGEST:
            values = np.where(np.isinf(values), np.nan, np.clip(values, -_LARGEST, _LARGEST))
        if self._sensor is not None:
            values = self._sensor.compensated(values, rotation, gravity)
            if self._components is not None:
                values = self._components.signals(values)
        elif self._order is not None:
            values = values[self._order]
        return self.readout.scaled(values)

    def locate(self, measurement: Measurement) -> Located:
        """Locate one measurement.

        Parameters
        ----------
        measurement : Measurement
            Of `measurement`.

        Returns
        -------
        Located
            The contact, all candidates, and the status.
        """
        nothing = self.nothing_in(measurement)
        if nothing is None:
            found = self._search(measurement)
            if self.prior is None:
                return found
            return located_where_allowed(
                self.prior, self.contact_map, self.readout, measurement, found
            )
        self._search.forget()
        return nowhere(nothing)

    def nothing_in(self, measurement: Measurement) -> Status | None:
        """Why a measurement is not worth a search: ``MISSING``, ``NOT_FELT``, ``DEGENERATE``.

        Parameters
        ----------
        measurement : Measurement
            Of `measurement`.

        Returns
        -------
        Status or None
            None where it is worth one.
        """
        if not all(map(math.isfinite, measurement.measured.tolist())):
            return Status.MISSING
        if self.felt_above > 0.0 and not self.readout.felt(measurement, self.felt_above):
            return Status.NOT_FELT
        return None if self._determining else Status.DEGENERATE
