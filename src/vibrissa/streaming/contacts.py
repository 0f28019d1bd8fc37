"""Streams of contact records, for output as JSON lines, from streams of samples."""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np

from vibrissa.contacts import (
    SLIPPING,
    Contact,
    ContactEvents,
    ContactFilter,
    Estimator,
    Followed,
    Place,
)
from vibrissa.numerics import Array
from vibrissa.rod import PointForce, deflect
from vibrissa.sensors import COMPONENTS, GRAVITY
from vibrissa.signals import SIGNALS, signals_of
from vibrissa.status import Event
from vibrissa.streaming.lines import FRAME, LineKind, Lines, Poses, Sample
from vibrissa.streaming.offset import OFF_ZERO, Offset, Zero

_ANEW = 1.0  # decrease of time above which the sender has restarted, s
_SLOW = 0.9  # interval of samples from which the unit of time is probably smaller than s
# Statuses that state neither contact nor its absence.
_SILENT = ("missing", "tare", "degenerate")
_MESSAGE = 400  # largest length of a message about an unreadable line, which may quote the line


class ContactStream:
    """Converter from lines of signals to records of contacts.

    Parameters
    ----------
    estimator : Estimator
        Estimator of contacts from single samples.
    names : sequence of str, optional
        Channels of a sensor that a line must contain, in this order. By default the estimator's
        signals, or the components of force and moment from which they are computed, whichever the
        first line has.
    follow : ContactFilter, optional
        Filter of contacts over time, with the pose of the base if known, with the same estimator.
    poses : Poses, optional
        Poses of the base, with its position on the carrier whose poses the lines contain.
    tare : int
        Number of initial complete samples without contact from which the offset of the sensor is
        measured again. Requires the estimator of a sensor.
    whisker : str
        Name of the whisker, if lines contain signals of several: its own are named ``name.Fx`` and
        so on, and lines without any of them are ignored.
    slip_speed : float, optional
        Speed of a contact point in the laboratory frame above which it slips, m/s; by default two
        lengths of the whisker per second.
    clock : callable, optional
        Time of a sample whose line has none, s; called once per such sample. By default the time
        since the stream was created.

    Attributes
    ----------
    samples, faults, untimed : int
        Numbers of samples so far, of unreadable lines, and of samples without a time, which get the
        time of the clock.
    statuses, events : Counter
        Numbers of samples by status, and by event.
    poses : Poses
        Poses of the base.
    clock : callable
        Time of a sample whose line has none.
    friction : float
        Standard deviation of the ratio of forces, as in `vibrissa.contacts.Contacts`.
    laboratory : str
        Name of the frame of the poses, if they state it; otherwise empty.
    """

    def __init__(
        self,
        estimator: Estimator,
        names: tuple[str, ...] | None = None,
        follow: ContactFilter | None = None,
        poses: Poses | None = None,
        tare: int = 0,
        whisker: str = "",
        slip_speed: float | None = None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self._offset = Offset(estimator.sensor, tare)
        self._zero = Zero(self._offset.follows)
        by_name = estimator.announced
        self._announced = by_name
        choices = (names,) if names else (by_name, _components(by_name))
        self.lines = Lines(*choices, raw=bool(names), whisker=whisker)
        self.whisker = whisker
        if slip_speed is None:
            slip_speed = SLIPPING * estimator.contact_map.whisker.length
        self._events = ContactEvents(slip_speed)
        self.samples, self.faults = 0, 0
        self._estimator, self._follow = estimator, follow
        self.friction = estimator.friction
        self._which = [SIGNALS.index(name) for name in by_name] if names is None else []
        begun, self._time = time.monotonic(), -math.inf
        self.clock = clock or (lambda: time.monotonic() - begun)
        self.statuses: Counter[str] = Counter()
        self.events: Counter[str] = Counter()
        self._headers = 0
        self.poses = poses or Poses()
        self.laboratory = ""
        self.slow, self.untimed, self.repeated, self.unused = 0, 0, 0, False
        self._values: list[float] = []

    def records(self, lines: Iterable[str]) -> Iterator[dict[str, Any]]:
        """Convert lines to records, one per sample and one per unreadable line.

        Parameters
        ----------
        lines : iterable of str
            Lines in order of arrival.

        Yields
        ------
        dict
            Record for JSON: ``time``, ``status`` and the contact, with the unchanged ``stamp_ns``,
            ``recorded_ns`` and ``frame_id`` of the line; ``whisker``, if it has a name; ``event``
            (``onset``, ``loss`` or ``slip``), if there is one; and in contact the time of its
            onset, ``onset_time`` with ``onset_sigma``. For an unreadable line, ``line`` and
            ``error``.
        """
        for line in lines:
            try:
                if (sample := self.lines(line)) is None:
                    continue
                if not sample.names:
                    self._put(sample)
                    continue
                record = self.record(sample)
            except ValueError as fault:
                self.faults += 1
                message = str(fault)
                if len(message) > _MESSAGE:
                    message = f"{message[:_MESSAGE]} …"
                yield {"line": self.lines.number, "error": message}
                continue
            self.samples += 1
            self.statuses[record["status"]] += 1
            if "event" in record:
                self.events[record["event"]] += 1
            yield record

    def _forget(self) -> None:
        self._time = -math.inf
        self._events.forget()
        self.poses.forget()
        self._offset.forget()
        (self._follow or self._estimator).reset()

    def warm_up(self) -> None:
        """Process one sample of each kind, so that later samples do not wait for code to load.

        These are a contact, a light contact, a free whisker and a wrench that no contact explains.
        """
        whisker, sensor = self._estimator.contact_map.whisker, self._estimator.sensor
        size = 0.5 * whisker.base_bending_stiffness / whisker.length**2
        bent = deflect(whisker, PointForce(0.7 * whisker.length, size, 0.5))
        contact, turn = np.concatenate([bent.force, bent.moment]), np.eye(3)
        for k, share in enumerate((1.0, 0.9, 0.0, -1.0)):
            wrench = share * contact
            if sensor is None:
                values = signals_of(wrench[:3], wrench[3:])[self._which]
            else:
                values = sensor.read([0.0], wrench[None], rotation=turn[None])[0]
            if sensor is None or sensor.mass == 0.0:
                self._estimator(values)  # the resting shape of lines without a pose is another one
            self._estimator(values, turn)
            if self._follow is not None:
                self._follow(1e-3 * k, values, turn)
        if self._follow is not None:
            self._follow.reset()
        self._estimator.restart()

    def record(self, sample: Sample) -> dict[str, Any]:
        """Estimate the contact of one sample.

        Parameters
        ----------
        sample : Sample
            Sample with values in the order of the names.

        Returns
        -------
        dict
            Record for JSON.
        """
        self.untimed += sample.time is None
        time = self.clock() if sample.time is None else sample.time
        # After a header any decrease of time is a restart. Senders may repeat headers, as UDP does
        # not guarantee delivery.
        if time < self._time - (_ANEW if self.lines.headers == self._headers else 0.0):
            self._forget()
        self._headers = self.lines.headers
        self.slow += sample.time is not None and time > self._time + _SLOW > -math.inf
        self._time = max(self._time, time)
        before, self._values = self._values, sample.values.tolist()
        rotation, position = self._pose(sample, time)
        sensor, gravity = self._estimator.sensor, None
        if sample.acceleration is not None:
            rotation = np.eye(3) if rotation is None else rotation
            gravity = -rotation @ self.poses.in_base(sample.acceleration)
            heavy = self._estimator.weighted or (sensor is not None and sensor.mass > 0.0)
            self.unused = not heavy
        if rotation is None and sensor is not None and sensor.mass > 0.0:
            raise ValueError(
                "the sensor carries a mass, so the base's rotation is needed: base_qw, base_qx, "
                "base_qy and base_qz in the line, or a pose before it; or what an accelerometer "
                "reads: imu_ax, imu_ay and imu_az"
            )
        known = {"time": time, **sample.passed}
        if self.whisker:
            known["whisker"] = self.whisker
        if self._offset.missing:
            reading = self._compensated(sample.values, rotation, gravity)
            if not np.isfinite(reading).all():
                return known | {"status": "missing"}
            self._offset.tare(time, reading)
            return known | {"status": "tare"}
        values = sample.values - self._offset.value
        if self._offset.follows:
            left = self._compensated(values, rotation, gravity)
            if self._offset.hides(time, left, self._estimator.felt_above):
                values = values - left
        if gravity is not None and not np.isfinite(gravity).all():
            values = np.full_like(values, np.nan)
        if self._which and sample.names != self._announced:
            wrench = np.zeros(6)
            wrench[[COMPONENTS.index(name) for name in sample.names]] = values
            values = signals_of(wrench[:3], wrench[3:])[self._which]
        measurement = self._estimator.measurement(values, rotation, gravity)
        if self._follow is None:
            found = self._estimator.locate(measurement)
            known |= located_record(found)
            place, spread = found.point, found.covariance
            reliable = found.covariance_valid or not self._estimator.noisy
            if rotation is not None:
                place, spread = rotation @ place, rotation @ spread @ rotation.T
            if position is not None:
                place = place + position
        else:
            followed = self._follow(time, values, rotation, position, gravity)
            known |= followed_record(followed, rotation)
            place, spread, reliable = followed.point, followed.covariance, True
        status = known["status"]
        self.repeated += before == self._values and status != "not_felt"
        excess = self._estimator.readout.excess(measurement) / self._offset.unsteadiness
        event = self._events(
            time,
            None if status in _SILENT else status != "not_felt",
            excess,
            Place(place, spread, reliable, rotation, position) if status == "unique" else None,
        )
        if event != Event.NONE:
            known["event"] = event.name.lower()
        begun, sigma = self._events.onset
        if status == "not_felt":
            self._zero.put(excess)
        if self._offset.follows and status not in _SILENT:
            reading = self._compensated(sample.values, rotation, gravity)
            self._offset.follow(time, status == "not_felt", begun, reading)
        return known | ({"onset_time": begun, "onset_sigma": sigma} if begun == begun else {})

    def _put(self, sample: Sample) -> None:
        """Store a pose that arrived without signals."""
        assert sample.time is not None
        assert sample.rotation is not None
        assert sample.position is not None
        self.laboratory = sample.passed.get(FRAME, self.laboratory)
        self.poses.put(sample.time, sample.rotation, sample.position)

    def _pose(self, sample: Sample, time: float) -> tuple[Array | None, Array | None]:
        """Pose of the base: that of the line, or the one interpolated from earlier poses."""
        rotation, position = sample.rotation, sample.position
        if rotation is not None and position is not None and np.isfinite(rotation).all():
            return self.poses.put(time, rotation, position)
        return self.poses.at(time) or (rotation, position)

    def _compensated(self, values: Array, rotation: Array | None, gravity: Array | None) -> Array:
        """Readings without the sensor's stated offset and the weight of all that it carries."""
        sensor = self._estimator.sensor
        assert sensor is not None
        left = sensor.compensated(values, rotation, GRAVITY if gravity is None else gravity)
        return left - self._estimator.reading_at_rest(rotation, gravity)

    @property
    def tare_missing(self) -> int:
        """Number of complete samples that are still needed to determine the offset."""
        return self._offset.missing

    @property
    def tare_scatter(self) -> float:
        """Largest standard deviation of a channel in the samples to tare with, over its noise."""
        return self._offset.scatter

    @property
    def off_zero(self) -> bool:
        """Whether the signals of the free whisker have been far from zero on average."""
        return self._zero.off


class ContactStreams:
    """Streams of several whiskers whose signals are in the same lines.

    Parameters
    ----------
    streams : sequence of ContactStream
        Stream of each whisker, with its name.
    """

    def __init__(self, streams: Sequence[ContactStream]) -> None:
        names = [one.whisker for one in streams]
        if len(set(names)) < len(names) or (len(names) > 1 and "" in names) or not names:
            raise ValueError(f"whiskers need different names; got {names}")
        self.streams, self._clock = tuple(streams), streams[0].clock

    def records(self, lines: Iterable[str]) -> Iterator[dict[str, Any]]:
        """Convert lines to records, one for each whisker with signals in a line.

        Parameters
        ----------
        lines : iterable of str
            Lines in order of arrival.

        Yields
        ------
        dict
            Record as from `ContactStream.records`; one error for a line that no whisker can read.
        """
        for line in lines:
            now = cache(self._clock)  # the whiskers of a line without a time are read at one time
            for one in self.streams:
                one.clock = now
            found = [record for one in self.streams for record in one.records((line,))]
            good = [record for record in found if "error" not in record]
            yield from good or found[:1]

    @property
    def samples(self) -> int:
        """Number of samples of all whiskers so far."""
        return sum(one.samples for one in self.streams)

    def warm_up(self) -> None:
        """Process one sample of each kind; see `ContactStream.warm_up`."""
        for one in self.streams:
            one.warm_up()

    def kind(self, line: str) -> LineKind:
        """Kind of a line; see `Lines.kind`.

        Parameters
        ----------
        line : str
            Line with or without its end.

        Returns
        -------
        LineKind
            Kind of the line; a sample if it is one for any of the whiskers.
        """
        kinds = [one.lines.kind(line) for one in self.streams]
        return next((kind for kind in (LineKind.SAMPLE, LineKind.POSE) if kind in kinds), kinds[0])


def _components(signals: tuple[str, ...]) -> tuple[str, ...]:
    """Components of force and moment that signals are computed from."""
    of = {"Fx": "Fx", "FT": "Fy Fz", "FD": "Fy Fz", "Mx": "Mx", "MB": "My Mz", "MD": "My Mz"}
    needed = " ".join(of[name] for name in signals).split()
    return tuple(name for name in COMPONENTS if name in needed)


def located_record(found: Contact) -> dict[str, Any]:
    """Record of the contact of a single sample, whisker frame, SI units."""
    record: dict[str, Any] = {"status": found.status.name.lower()}
    if not found.n_candidates:
        return record
    record |= _place(found.point)
    record["arc_length"] = found.arc_length
    record["force"] = found.force.tolist()
    record |= _sigma(found.covariance)
    record["covariance"] = found.covariance.tolist()
    record["chi_squared"] = found.chi_squared
    record["friction"] = found.friction
    record["continuing"] = found.continuing
    record["candidates"] = found.candidates.point.tolist()
    return record


def followed_record(known: Followed, rotation: Array | None = None) -> dict[str, Any]:
    """Record of a contact estimated by a filter."""
    record: dict[str, Any] = {"status": known.status.name.lower()}
    if not len(known.points):
        return record
    record |= _place(known.point_whisker)
    record |= dict(zip(("lab_x", "lab_y", "lab_z"), known.point.tolist(), strict=True))
    turn = np.eye(3) if rotation is None else rotation
    record |= _sigma(turn.T @ known.covariance @ turn)
    record["lab_covariance"] = known.covariance.tolist()
    record |= {f"lab_{name}": value for name, value in _sigma(known.covariance).items()}
    record["velocity"] = known.velocity.tolist()
    record["friction"] = 0.0  # a filter requires an estimator without friction
    record["probability"] = known.probability
    record["hypotheses"] = known.points.tolist()
    record["probabilities"] = known.probabilities.tolist()
    return record


def as_json(record: dict[str, Any]) -> str:
    """Format a record as one line of JSON; numbers that are not finite become null."""
    try:
        return _ENCODER.encode(record)
    except ValueError:
        return _ENCODER.encode(_finite(record))


_ENCODER = json.JSONEncoder(ensure_ascii=False, allow_nan=False)


def _place(point: Array) -> dict[str, float]:
    x, y, z = point.tolist()  # for a single point, ten times as fast as NumPy
    r = math.hypot(x, y, z)
    return {"x": x, "y": y, "z": z, "r": r, "theta": math.atan2(y, x), "phi": math.asin(z / r)}


def _sigma(covariance: Array) -> dict[str, float]:
    sigma = np.sqrt(covariance.diagonal()).tolist()
    return dict(zip(("sigma_x", "sigma_y", "sigma_z"), sigma, strict=True))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


_NEARLY_ALL = 0.9  # share of samples above which a wrong unit of time is suspected
# Share of samples with signals that no contact explains, and their number, from which a general
# error is suspected: noise alone leaves one in a thousand unexplained.
_MANY, _SEVERAL = 0.2, 5
_REPEATED = 100  # number of repeated readings of a contact, from which they are questioned
_UNSTEADY = 3.0  # scatter of the samples to tare with, over the noise, from which it is questioned
_FAST = 0.02  # share of poses at an implausible speed above which their unit is questioned


def advice(stream: ContactStream) -> list[str]:
    """Advice on common mistakes that the statuses of all samples suggest."""
    counts, total = stream.statuses, stream.samples
    measured = total - counts["missing"] - counts["tare"]
    touching = measured - counts["not_felt"]
    unexplained = counts["outside_map"] + counts["not_frictionless"]
    out = []
    if stream.unused:
        out.append(
            "The accelerometer's readings change nothing: neither the whisker (gravity, with its "
            "density) nor the sensor has a weight."
        )
    if unexplained > _MANY * touching and (unexplained >= _SEVERAL or unexplained == touching):
        larger = (
            "are larger than any that this whisker can give"
            if counts["outside_map"] > unexplained / 2
            else "are explained by no frictionless contact of this whisker"
        )
        out.append(
            f"{unexplained} of {touching} samples with signals {larger}: are they in N and N·m (or "
            "in the units of the sensor's mixing), is the offset removed, and are the sensor's "
            "axes, sign and weight, the base's rotation and the whisker's stiffness right? The "
            "other contacts may be wrong as well."
        )
    if stream.tare_scatter > _UNSTEADY:
        out.append(
            f"The samples to tare with scatter by {stream.tare_scatter:.0f} times the noise: was "
            "the whisker touched or moved meanwhile? Then the offset and all contacts are wrong. "
            "Otherwise the stated noise is too small."
        )
    if measured > 0 and not touching:
        out.append(
            "No signal was far enough from zero for a contact: are the signals in N and N·m, and "
            "is the stated noise right?"
        )
    if total and counts["missing"] == total:
        out.append(
            "All samples are incomplete: a number or the pose at that time is missing, or readings "
            "have reached the sensor's largest reading."
        )
    if stream.off_zero:
        out.append(OFF_ZERO)
    if stream.repeated > max(_MANY * touching, _REPEATED):
        out.append(
            f"{stream.repeated} of {touching} samples with signals have exactly the readings of "
            "the one before. Either the sensor is slower than the lines, and readings are older "
            "than their times and poses state: send each reading once. Or its resolution is "
            "coarser than its noise, and must be stated."
        )
    if stream.slow > _NEARLY_ALL * max(total - 1, 1):
        out.append("Samples are a second or more apart: is their time in s?")
    if stream.poses.too_fast > _FAST * stream.poses.number > 0:
        out.append("The base moves at more than 20 m/s: is its position in m, its time in s?")
    return out
