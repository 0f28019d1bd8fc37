"""`vibrissa stream`: estimation of contacts from a stream of signals."""

from __future__ import annotations

import gc
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from io import TextIOWrapper
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import typer

import vibrissa as vb
from vibrissa.cli import inputs
from vibrissa.cli.estimate import GravityOptions
from vibrissa.cli.options import numbers, refuse, with_options
from vibrissa.cli.terminal import Ended, ending_in_order, remark, remark_once

if TYPE_CHECKING:
    import socket

_SOON = 500  # number of samples after which advice is given for the first time; again at the end
_REPORTED = 1.0  # time between two reports of dropped samples, s
_MOUNT = ("X", "Y", "Z", "QW", "QX", "QY", "QZ")


@dataclass(frozen=True)
class LineOptions:
    """Options for the source of lines."""

    source: Path | None = None
    udp: str | None = None
    every: bool = False
    reconnect: bool = False
    topic: str | None = None
    pose_topic: str | None = None
    count: int | None = None

    def __post_init__(self) -> None:
        if self.source is not None and self.udp is not None:
            raise ValueError("give either a source or --udp")
        if self.source is not None:
            vb.io.refuse_whisk(self.source)
        if not self.bag:
            topics = {"--topic": self.topic, "--pose-topic": self.pose_topic}
            refuse(topics, "it applies to ROS bags, and the source is not one")
        if self.udp is None:
            refuse({"--every": self.every}, "samples are dropped only with --udp")
        if self.source is None or self.bag:
            refuse(
                {"--reconnect": self.reconnect}, "the source is neither a named pipe nor a device"
            )

    @property
    def bag(self) -> bool:
        """Whether the source is a ROS bag."""
        return self.source is not None and vb.io.is_bag(self.source)

    def lines(self, heard: socket.socket | None) -> Iterator[str]:
        """Yield lines as they arrive."""
        if heard is not None:
            return vb.streaming.udp_lines(heard)
        if self.source is None or str(self.source) == "-":
            refuse({"--reconnect": self.reconnect}, "standard input cannot be reopened")
            if isinstance(sys.stdin, TextIOWrapper):  # noise on a serial line must not end a stream
                sys.stdin.reconfigure(errors="replace")
            return vb.streaming.bounded_lines(sys.stdin)
        if self.bag:
            return vb.streaming.bag_lines(self.source, self.topic, self.pose_topic)
        if self.source.is_dir() or not self.source.exists():
            vb.io.check_readable(self.source)
        if self.reconnect and self.source.is_file():
            raise ValueError(f"{self.source} is a file; --reconnect is for named pipes and devices")
        return vb.streaming.file_lines(self.source, self.reconnect, remark)


@dataclass(frozen=True, kw_only=True)
class MeasurementOptions:
    """Options for the whiskers and the measurements at their bases."""

    map: list[str] | None = None
    proximal: float | None = None
    own: inputs.WhiskerOptions
    sensor: list[str] | None = None
    using: str | None = None
    noise: inputs.NoiseOptions
    assumed: inputs.AssumptionOptions
    weight: GravityOptions
    threshold: float = 5.0
    tare: int | None = None

    def __post_init__(self) -> None:
        if self.map:
            if self.own.whisker is not None:
                raise ValueError("give either --map or --whisker: a map already has its whisker")
            refuse({"--proximal": self.proximal}, "the --map has a proximal limit")
            refuse({"--density": self.weight.density}, "the map has that of its whisker")
        sensors = _named(self.sensor, "--sensor")
        if set(sensors) - {"", *self.whiskers}:
            raise ValueError(
                f"--sensor is of {', '.join(sensors)}; --map of {', '.join(self.whiskers) or 'one'}"
            )
        if not sensors:
            reason = "the offset is that of a sensor's channels: give the --sensor"
            refuse({"--tare": self.tare}, reason)
            return
        stated = {"--using": self.using, **self.noise.stated}
        refuse(stated, "channels and noise are those of the --sensor")
        errors = {f"--{name.replace('_', '-')}": v for name, v in self.assumed.errors.items()}
        errors.pop("--stiffness-sigma", None)
        refuse(errors, "the --sensor's file states gain_error and mixing_error")

    @property
    def whiskers(self) -> tuple[str, ...]:
        """Names of the whiskers, from their maps; a single whisker has an empty name."""
        return tuple(_named(self.map, "--map")) or ("",)

    def contact_map(self, name: str) -> vb.ContactMap:
        """Read or simulate the map of a whisker."""
        if self.map:
            return vb.ContactMap.load(Path(_named(self.map, "--map")[name]), grid=False)
        whisker = self.weight.of(self.own.read())
        inputs.print_notes(whisker)
        remark(f"no map given; simulating that of {whisker!r}")
        return vb.ContactMap.simulate(
            whisker, grid=False, proximal=inputs.smallest_arc(self.proximal)
        )

    def described(self, name: str) -> vb.sensors.Sensor | None:
        """Read the sensor of a whisker: its own, or the common one."""
        sensors = _named(self.sensor, "--sensor")
        path = sensors.get(name, sensors.get(""))
        return None if path is None else vb.sensors.load_sensor(path)

    def estimator(self, name: str, sensor: vb.sensors.Sensor | None) -> vb.Estimator:
        """Create the estimator of a whisker."""
        if sensor is not None and self.tare:
            sensor = sensor.with_new_offset(self.tare)
        contact_map = self.contact_map(name)
        remark_once(self.weight.doubts(contact_map.whisker))
        return inputs.estimator_of(
            contact_map,
            sensor,
            self.using or "Fx,MB,MD",
            self.noise,
            self.assumed,
            self.weight.known,
            self.threshold,
        )


@dataclass(frozen=True)
class FollowOptions:
    """Options for filtering contacts over time, and for the mounting of the whisker."""

    filter: bool = False
    speed: float | None = None
    slip_speed: float | None = None
    mount: list[str] | None = None

    def __post_init__(self) -> None:
        if not self.filter:
            refuse({"--speed": self.speed}, "only the filter uses it: add --filter")

    def poses(self, name: str) -> vb.streaming.Poses:
        """Create the poses of the carrier on which a whisker is mounted."""
        mounts = _named(self.mount, "--mount")
        if (mount := mounts.get(name, mounts.get(""))) is None:
            return vb.streaming.Poses()
        values = numbers(mount, _MOUNT, "--mount")
        return vb.streaming.Poses(
            vb.streaming.rotation_of(values[3:]), [1e-3 * x for x in values[:3]]
        )

    def running(
        self,
        estimator: vb.Estimator,
        sensor: vb.sensors.Sensor | None,
        whisker: str,
        bag: bool,
        tare: int,
    ) -> vb.streaming.ContactStream:
        """Create the converter from lines to contacts."""
        speed = None if self.speed is None else 1e-3 * self.speed
        filtered = vb.ContactFilter(estimator, speed=speed) if self.filter else None
        names = None if sensor is None else tuple(sensor.channels)
        if bag and names is not None and not set(names) <= set(vb.streaming.COMPONENTS):
            raise ValueError(
                f"a bag of wrenches contains {', '.join(vb.streaming.COMPONENTS)}; the sensor has "
                f"{', '.join(names)}"
            )
        slip = None if self.slip_speed is None else 1e-3 * self.slip_speed
        poses = self.poses(whisker)
        return vb.streaming.ContactStream(
            estimator, names, filtered, poses, tare, whisker=whisker, slip_speed=slip
        )


def _named(given: list[str] | None, option: str) -> dict[str, str]:
    """Values of an option by whisker: NAME=VALUE, or one value without a name."""
    pairs = [one.rpartition("=") if "=" in one else ("", "", one) for one in given or ()]
    names = [name for name, _, _ in pairs]
    if len(set(names)) < len(names) or ("" in names and len(names) > 1):
        raise ValueError(
            f"{option} is given {len(names)} times; several whiskers need names, as in "
            f"{option} left=VALUE {option} right=VALUE"
        )
    return {name: value for name, _, value in pairs}


@with_options()
def stream(
    source: LineOptions,
    measured: MeasurementOptions,
    follow: FollowOptions,
    bag: Path | None = None,
    answers: str | None = None,
) -> None:
    """Estimate contacts while signals arrive; the result for each sample is one line of JSON.

    Lines are CSV with a header, or JSON objects, in SI units, with the signals used or Fx, Fy, Fz,
    Mx, My, Mz; a column time is passed on. The result for an unreadable line is its number and the
    error; after an invalid header, rows are errors until the next header. Points are in the whisker
    frame, m; with --filter also in the laboratory frame (lab_x, ...). The field event states onset,
    loss and slip of a contact. For several whiskers, --map left=left.nc --map right=right.nc, lines
    contain left.Fx, right.Fx and so on. Stop with Ctrl-C or any signal.
    Example: `vibrissa stream --udp 127.0.0.1:5005 --map wire.nc --sensor sensor.toml`
    """
    sensors = {name: measured.described(name) for name in measured.whiskers}
    with ending_in_order(), _without_long_collections() as settled, ExitStack() as opened:
        writer = None
        if bag is not None:
            frame = "laboratory" if follow.filter else "whisker"
            writer = opened.enter_context(
                vb.io.ContactBag(bag, frame=frame, whiskers=measured.whiskers)
            )
        sent = None if answers is None else opened.enter_context(vb.streaming.Answers(answers))
        heard = None
        if source.udp is not None:
            # Opened before the map is computed, so that no datagram is lost.
            address = vb.streaming.udp_address(source.udp)
            heard = opened.enter_context(vb.streaming.udp_socket(*address))
            remark("listening at {}:{}".format(*heard.getsockname()[:2]))
        lines: Iterable[str] = source.lines(heard)
        running = vb.streaming.ContactStreams(
            [
                follow.running(
                    measured.estimator(name, sensor), sensor, name, source.bag, measured.tare or 0
                )
                for name, sensor in sensors.items()
            ]
        )
        running.warm_up()
        settled()
        losses = None if heard is None else _Losses(heard)
        if losses is not None:
            remark("ready")
            if not source.every:
                lines = losses.newest(running)
        recorder = None
        if writer is not None:
            same = all(
                one is None or (one.frame.to_base() == vb.sensors.SensorFrame().to_base()).all()
                for one in sensors.values()
            )
            recorder = vb.streaming.ContactRecorder(writer, running, same, follow.filter, remark)
        try:
            _write(running, islice(lines, source.count), recorder, losses, sent)
        except Ended as signalled:  # the normal end
            remark(f"stopped: {signalled}")
        lost = "" if losses is None else losses.described()
    for one in running.streams:
        _report(one, lost, follow.filter)
    if recorder is not None and recorder.broken:
        raise typer.Exit(1)


@contextmanager
def _without_long_collections() -> Iterator[Callable[[], None]]:
    """Suspend garbage collection during loading: it takes longer than a sample may wait."""

    def settled() -> None:
        gc.freeze()
        gc.enable()

    gc.disable()
    try:
        yield settled
    finally:
        gc.enable()
        gc.unfreeze()


def _report(running: vb.streaming.ContactStream, lost: str, follow: bool) -> None:
    if follow and not running.poses.number:
        remark("no pose was received: the base was assumed to be at rest")
    whose = f"{running.whisker}: " if running.whisker else ""
    friction = vb.contacts.friction_assumed(running.friction)
    unread = f"{running.faults} lines that could not be read{lost}"
    remark(f"{whose}{running.samples} samples, {unread}; {friction}")
    if running.statuses:
        remark(whose + ", ".join(f"{name}: {n}" for name, n in running.statuses.most_common()))
    if running.events:
        remark(whose + ", ".join(f"{name}: {n}" for name, n in running.events.items()))
    if running.tare_missing:
        remark(f"{whose}--tare: {running.tare_missing} more complete samples are needed")
    _advise(running)


def _advise(running: vb.streaming.ContactStream) -> None:
    for sentence in vb.streaming.advice(running):
        remark(_of(running, sentence))


def _of(running: vb.streaming.ContactStream, sentence: str) -> str:
    return f"{running.whisker}: {sentence}" if running.whisker else sentence


class _Losses:
    """Counter of UDP samples without a result, reported once per second."""

    def __init__(self, heard: socket.socket) -> None:
        self._heard = heard
        self._lines: vb.streaming.NewestLines | None = None
        self._before, self._next = (0, 0), 0.0

    def newest(self, running: vb.streaming.ContactStreams) -> vb.streaming.NewestLines:
        """Lines of the newest datagrams only."""
        self._lines = vb.streaming.NewestLines(self._heard, running.kind)
        return self._lines

    def report(self) -> None:
        """Report the number of lost samples if it has grown, at most once per second."""
        if (now := time.monotonic()) < self._next:
            return
        self._next = now + _REPORTED
        if (counts := self._counts()) != self._before:
            self._before = counts
            remark(f"so far{self.described()[1:]}")

    def described(self) -> str:
        """Description of all lost samples for the end of a sentence; empty if there are none."""
        dropped, lost = self._counts()
        text = f", {dropped} samples dropped because newer ones had come" if dropped else ""
        return text + (f", {lost} datagrams lost because too many waited" if lost else "")

    def _counts(self) -> tuple[int, int]:
        return 0 if self._lines is None else self._lines.dropped, vb.streaming.udp_lost(self._heard)


def _write(
    running: vb.streaming.ContactStreams,
    lines: Iterator[str],
    recorder: vb.streaming.ContactRecorder | None,
    losses: _Losses | None,
    sent: vb.streaming.Answers | None,
) -> None:
    """Print each record immediately; stop quietly if the output is closed."""
    drifted: set[str] = set()
    try:
        for record in running.records(lines):
            # The bag is written first, so that it has all printed results after any signal.
            if recorder is not None:
                recorder.put(record)
            answer = vb.streaming.as_json(record)
            sys.stdout.write(answer + "\n")
            sys.stdout.flush()
            if sent is not None:
                try:
                    sent.send(answer)
                except OSError as fault:
                    remark(f"answers are no longer sent: {fault}")
                    sent = None
            if losses is not None:
                losses.report()
            for one in running.streams:
                if running.samples == _SOON:
                    _advise(one)
                if one.off_zero and one.whisker not in drifted:
                    drifted.add(one.whisker)
                    remark(_of(one, vb.streaming.OFF_ZERO))
    except BrokenPipeError:
        # Flushing at exit must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
