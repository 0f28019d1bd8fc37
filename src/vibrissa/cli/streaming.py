"""`vibrissa stream`: contacts while signals come in."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from io import TextIOWrapper
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vibrissa.cli.assumptions import (
    Assumed,
    GainSigma,
    GreatestForce,
    LeastForce,
    MixingSigma,
    Proximal,
    Region,
    StiffnessSigma,
    assumed,
    smallest_arc,
)
from vibrissa.cli.terminal import Ended, ending_in_order, errors, refuse

if TYPE_CHECKING:
    import socket

    from vibrissa.contacts import ContactMap, Estimator
    from vibrissa.io.rosbag import ContactBag
    from vibrissa.sensors import Sensor
    from vibrissa.streaming import ContactStream, NewestLines, Poses

# Advice is given once after so many samples, and at the end.
_SOON = 500
# Seconds between two reports of samples that are dropped.
_REPORTED = 1.0


def stream(
    source: Annotated[
        Path | None,
        typer.Argument(
            help="A file, named pipe or serial device with lines, or a ROS bag; by default "
            "standard input.",
            metavar="SOURCE",
        ),
    ] = None,
    udp: Annotated[
        str | None,
        typer.Option(help="Receive lines as UDP datagrams here instead.", metavar="HOST:PORT"),
    ] = None,
    every: Annotated[
        bool,
        typer.Option(
            "--every",
            help="Answer every sample that comes by UDP, however late; by default the newest, and "
            "those before it that wait are dropped and counted.",
        ),
    ] = False,
    reconnect: Annotated[
        bool,
        typer.Option(
            "--reconnect",
            help="Wait for a named pipe or serial device that closes to open again.",
        ),
    ] = False,
    chart: Annotated[
        Path | None,
        typer.Option("--map", help="Of the whisker; simulated if not given.", metavar="FILE"),
    ] = None,
    whisker: Annotated[
        Path | None,
        typer.Option(help="Centreline as CSV, where no map is given.", metavar="FILE"),
    ] = None,
    sensor: Annotated[
        Path | None,
        typer.Option(
            help="Description of the sensor, TOML: the lines then carry its channels, raw.",
            metavar="FILE",
        ),
    ] = None,
    signals: Annotated[
        str | None,
        typer.Option(
            help="Without a sensor: the signals to use, of Fx, FT, FD, Mx, MB, MD; by default "
            "Fx,MB,MD. The lines carry these, or Fx, Fy, Fz, Mx, My, Mz.",
            metavar="A,B,C",
        ),
    ] = None,
    force_noise: Annotated[
        float | None,
        typer.Option(
            help="Without a sensor: standard deviation of a force component, µN; 1 by default.",
            min=0.0,
        ),
    ] = None,
    moment_noise: Annotated[
        float | None,
        typer.Option(
            help="Without a sensor: standard deviation of a moment component, µN·m; 0.02 by "
            "default.",
            min=0.0,
        ),
    ] = None,
    stiffness_sigma: StiffnessSigma = 0.0,
    gain_sigma: GainSigma = 0.0,
    mixing_sigma: MixingSigma = 0.0,
    region: Region = None,
    least_force: LeastForce = None,
    greatest_force: GreatestForce = None,
    proximal: Proximal = None,
    felt: Annotated[
        float,
        typer.Option(help="Standard deviations from zero at which a contact is felt.", min=0.0),
    ] = 5.0,
    follow: Annotated[
        bool,
        typer.Option(
            "--filter",
            help="Follow contacts over time, with the pose of the base: base_x, base_y, base_z (m) "
            "and base_qw, base_qx, base_qy, base_qz, in each line or in lines of their own.",
        ),
    ] = False,
    speed: Annotated[
        float | None,
        typer.Option(
            help="How fast contacts move in the laboratory, for the filter, mm/s; by default a "
            "quarter of the whisker's length a second.",
        ),
    ] = None,
    mount: Annotated[
        str | None,
        typer.Option(
            help="Poses are of a robot's flange; where the whisker's base is on it: mm, and a "
            "quaternion from the whisker's to the flange's frame.",
            metavar="X,Y,Z,QW,QX,QY,QZ",
        ),
    ] = None,
    tare: Annotated[
        int | None,
        typer.Option(
            help="The first N samples are of a free whisker, and give the sensor's offset anew.",
            min=1,
            metavar="N",
        ),
    ] = None,
    topic: Annotated[
        str | None,
        typer.Option(help="Of WrenchStamped in a bag, where there are several.", metavar="NAME"),
    ] = None,
    pose_topic: Annotated[
        str | None,
        typer.Option(
            help="Of PoseStamped or TransformStamped in a bag: poses of the base, or the flange.",
            metavar="NAME",
        ),
    ] = None,
    bag: Annotated[
        Path | None,
        typer.Option(
            "--bag-out",
            help="Write PointStamped and PointCloud2 to this new ROS 2 bag as well.",
            metavar="FOLDER",
        ),
    ] = None,
    count: Annotated[
        int | None, typer.Option(help="Stop after so many lines.", min=1, metavar="N")
    ] = None,
) -> None:
    """Find contacts while signals come in, one line of JSON each.

    Lines are CSV with a header, or JSON objects, in SI units; a column time is passed on. A line
    that cannot be read gives a line with its number and the error; after a header that cannot be
    used, rows wait for another one. Points are in the whisker's frame, m; with --filter also in the
    laboratory's (lab_x, ...). Stop with Ctrl-C or any signal.
    Example: `vibrissa stream --udp 127.0.0.1:5005 --map wire.nc --sensor sensor.toml`
    """
    from vibrissa.cli.recordings import usual_noise
    from vibrissa.io.paths import refuse_whisk
    from vibrissa.io.rosbag import is_bag
    from vibrissa.sensors import load_sensor

    if source is not None and udp is not None:
        raise ValueError("give either a source or --udp")
    if sensor is not None:
        options = {"--signals": signals, "--force-noise": force_noise}
        reason = "channels and noise are those of the --sensor"
        refuse(options | {"--moment-noise": moment_noise}, reason)
        stated = {"--gain-sigma": gain_sigma or None, "--mixing-sigma": mixing_sigma or None}
        refuse(stated, "the --sensor's file states gain_error and mixing_error")
    else:
        refuse({"--tare": tare}, "the offset is that of a sensor's channels: give the --sensor")
    if not follow:
        refuse({"--speed": speed}, "it is of the filter: add --filter")
    described = None if sensor is None else load_sensor(sensor)
    if source is not None:
        refuse_whisk(source)
    from_bag = source is not None and is_bag(source)
    if not from_bag:
        refuse(
            {"--topic": topic, "--pose-topic": pose_topic},
            "it is of a ROS bag, and the source is none",
        )
    if udp is None:
        refuse({"--every": every}, "only of what comes by --udp are samples dropped")
    if source is None or from_bag:
        refuse({"--reconnect": reconnect}, "the source is neither a named pipe nor a device")
    poses = _poses(mount)
    with ending_in_order(), ExitStack() as opened:
        writer = None if bag is None else opened.enter_context(_bag(bag, follow))
        heard = None if udp is None else _socket(udp, opened)
        lines: Iterable[str] = (
            _bag_lines(source, topic, pose_topic)
            if source is not None and from_bag
            else _lines(source, reconnect, heard)
        )
        contacts = _map(chart, whisker, proximal)
        estimator = _estimator(
            contacts,
            described,
            signals or "Fx,MB,MD",
            usual_noise(force_noise, moment_noise),
            assumed(stiffness_sigma, gain_sigma, mixing_sigma, region, least_force, greatest_force),
            felt,
            tare or 0,
        )
        running = _stream(estimator, described, from_bag, follow, speed, poses, tare or 0)
        running.warm_up()
        losses = None if heard is None else _Losses(heard)
        if heard is not None and losses is not None:
            errors.print("ready", highlight=False)
            if not every:
                lines = losses.newest(running)
        keep = None if writer is None else _Keeper(writer, running, described, follow)
        try:
            _write(running, islice(lines, count), keep, losses)
        except Ended as signalled:  # the usual end
            errors.print(f"stopped: {signalled}", highlight=False)
        lost = "" if losses is None else losses.told()
    if follow and not running.poses.number:
        errors.print("no pose came: the base was taken to stand still", highlight=False)
    errors.print(
        f"{running.samples} samples, {running.faults} lines that could not be read{lost}",
        highlight=False,
        soft_wrap=True,
    )
    _advise(running)
    if keep is not None and keep.broken:
        raise typer.Exit(1)


def _advise(running: ContactStream) -> None:
    from vibrissa.streaming import advice

    for sentence in advice(running):
        errors.print(sentence, highlight=False, soft_wrap=True)


def _poses(mount: str | None) -> Poses:
    """Poses of what the whisker is mounted on."""
    from vibrissa.streaming import Poses
    from vibrissa.streaming.lines import rotation_of

    if mount is None:
        return Poses()
    try:
        numbers = [float(part) for part in mount.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 7:
        raise ValueError(f"--mount is X,Y,Z,QW,QX,QY,QZ, seven numbers; got {mount!r}")
    return Poses(rotation_of(numbers[3:]), [1e-3 * x for x in numbers[:3]])


def _socket(udp: str, opened: ExitStack) -> socket.socket:
    """Listen before the map is made, so that nothing is lost."""
    from vibrissa.streaming.sources import udp_address, udp_socket

    heard = opened.enter_context(udp_socket(*udp_address(udp)))
    host, port = heard.getsockname()[:2]
    errors.print(f"listening at {host}:{port}", highlight=False)
    return heard


def _lines(source: Path | None, reconnect: bool, heard: socket.socket | None) -> Iterator[str]:
    """Lines as they come."""
    from vibrissa.io.paths import check_readable
    from vibrissa.streaming.sources import bounded_lines, file_lines, udp_lines

    if heard is not None:
        return udp_lines(heard)
    if source is None or str(source) == "-":
        refuse({"--reconnect": reconnect}, "standard input does not open again")
        if isinstance(sys.stdin, TextIOWrapper):  # noise on a serial line must not end a stream
            sys.stdin.reconfigure(errors="replace")
        return bounded_lines(sys.stdin)
    if source.is_dir() or not source.exists():
        check_readable(source)
    if reconnect and source.is_file():
        raise ValueError(f"{source} is a file, which ends; --reconnect is for pipes and devices")
    return file_lines(source, reconnect, lambda said: errors.print(said, highlight=False))


class _Losses:
    """Samples that came by UDP and are not answered, told once a second while there are more."""

    def __init__(self, heard: socket.socket) -> None:
        self._heard = heard
        self._lines: NewestLines | None = None
        self._before, self._next = (0, 0), 0.0

    def newest(self, running: ContactStream) -> NewestLines:
        """Lines of which only the newest are passed on."""
        from vibrissa.streaming import NewestLines

        self._lines = NewestLines(self._heard, running.lines.kind)
        return self._lines

    def report(self) -> None:
        """Say how many there are so far, if it is time to, and there are more."""
        if (now := time.monotonic()) < self._next:
            return
        self._next = now + _REPORTED
        if (counts := self._counts()) != self._before:
            self._before = counts
            errors.print(f"so far{self.told()[1:]}", highlight=False, soft_wrap=True)

    def told(self) -> str:
        """All of them, as the end of a sentence; nothing where there are none."""
        dropped, lost = self._counts()
        said = f", {dropped} samples dropped because newer ones had come" if dropped else ""
        return said + (f", {lost} datagrams lost because too many waited" if lost else "")

    def _counts(self) -> tuple[int, int]:
        from vibrissa.streaming.sources import udp_lost

        return 0 if self._lines is None else self._lines.dropped, udp_lost(self._heard)


def _bag_lines(source: Path, topic: str | None, pose_topic: str | None) -> Iterator[str]:
    """Lines as they would have come, poses and wrenches in the order of their times."""
    import json
    from heapq import merge

    from vibrissa.io.rosbag import BagMessage, bag_poses, bag_wrenches
    from vibrissa.streaming.contacts import COMPONENTS
    from vibrissa.streaming.lines import FRAME, POSITION, QUATERNION, RECORDED, STAMP

    def named(messages: Iterator[BagMessage], names: tuple[str, ...]) -> Iterator[dict[str, Any]]:
        for stamp, recorded, frame, values in messages:
            said = {STAMP: stamp, RECORDED: recorded, FRAME: frame}
            yield said | dict(zip(names, values, strict=True))

    poses: Iterator[dict[str, Any]] = iter(())
    if pose_topic is not None:
        poses = named(bag_poses(source, pose_topic), (*POSITION, *QUATERNION))
    wrenches = named(bag_wrenches(source, topic), COMPONENTS)
    for message in merge(poses, wrenches, key=lambda one: one[STAMP]):
        yield json.dumps(message)


def _map(chart: Path | None, whisker: Path | None, proximal: float | None) -> ContactMap:
    from vibrissa.cli.sources import map_from, tell_notes, whisker_from
    from vibrissa.contacts import ContactMap

    if chart is not None and whisker is not None:
        raise ValueError("give either --map or --whisker: a map already has its whisker")
    if chart is not None:
        refuse({"--proximal": proximal}, "it is of a map that is simulated, and --map is given")
        return map_from(chart)
    chosen = whisker_from(whisker)
    tell_notes(chosen)
    errors.print(f"no map given; simulating that of {chosen!r}", highlight=False, soft_wrap=True)
    return ContactMap.simulate(chosen, grid=False, proximal=smallest_arc(proximal))


def _estimator(
    contact_map: ContactMap,
    sensor: Sensor | None,
    signals: str,
    noise: tuple[float, float],
    beforehand: Assumed,
    felt: float,
    tare: int,
) -> Estimator:
    import numpy as np

    from vibrissa.contacts import Estimator

    prior = beforehand.prior
    if sensor is not None:
        stiffness = beforehand.errors.get("stiffness_sigma", 0.0)
        if tare:
            sensor = sensor.with_new_offset(tare)
        return Estimator.of_sensor(contact_map, sensor, stiffness, felt, prior)
    covariance = np.diag(np.repeat([1e-6 * noise[0], 1e-6 * noise[1]], 3) ** 2)
    return Estimator(
        contact_map, signals, covariance, felt_above=felt, prior=prior, **beforehand.errors
    )


def _stream(
    estimator: Estimator,
    sensor: Sensor | None,
    from_bag: bool,
    follow: bool,
    speed: float | None,
    poses: Poses,
    tare: int,
) -> ContactStream:
    from vibrissa.contacts import ContactFilter
    from vibrissa.streaming import ContactStream

    filtered = None
    if follow:
        filtered = ContactFilter(estimator, speed=None if speed is None else 1e-3 * speed)
    names = None if sensor is None else tuple(sensor.channels)
    if from_bag and sensor is not None and not set(names or ()) <= set(_wrench_names()):
        raise ValueError(
            f"a bag of wrenches carries {', '.join(_wrench_names())}; the sensor has "
            f"{', '.join(sensor.channels)}"
        )
    return ContactStream(estimator, names, filtered, poses, tare)


def _wrench_names() -> tuple[str, ...]:
    from vibrissa.streaming.contacts import COMPONENTS

    return COMPONENTS


def _bag(path: Path, follow: bool) -> ContactBag:
    from vibrissa.io.rosbag import ContactBag

    return ContactBag(path, frame="laboratory" if follow else "whisker")


def _write(
    running: ContactStream,
    lines: Iterator[str],
    keep: _Keeper | None,
    losses: _Losses | None,
) -> None:
    """Print records as they come, each at once; stop quietly when nobody reads any more."""
    from vibrissa.streaming.contacts import as_json

    try:
        for record in running.records(lines):
            # First, so that all that was answered is in the bag, wherever a signal comes.
            if keep is not None and "error" not in record:
                keep(record)
            sys.stdout.write(as_json(record) + "\n")
            sys.stdout.flush()
            if losses is not None:
                losses.report()
            if running.samples == _SOON:
                _advise(running)
    except BrokenPipeError:
        # What is flushed at the end must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class _Keeper:
    """Puts records into the bag as long as it can be written; the stream goes on without."""

    def __init__(
        self, bag: ContactBag, running: ContactStream, sensor: Sensor | None, follow: bool
    ) -> None:
        import numpy as np

        self._bag, self._running, self._follow = bag, running, follow
        # Points are in the whisker's frame, which is the sensor's unless that is mounted otherwise.
        self._same = sensor is None or np.array_equal(sensor.frame.to_base(), np.eye(6))
        self.broken = False

    def __call__(self, record: dict[str, Any]) -> None:
        """Put a record of a sample."""
        import numpy as np

        from vibrissa.streaming.lines import RECORDED, STAMP

        if self.broken:
            return
        points = np.reshape(record.get("hypotheses", record.get("candidates", [])), (-1, 3))
        likely = record.get("probabilities", np.full(len(points), 1.0 / max(len(points), 1)))
        names = ("lab_x", "lab_y", "lab_z") if self._follow else ("x", "y", "z")
        point = np.array([record[name] for name in names]) if "x" in record else None
        stamp = record.get(STAMP)
        if stamp is None:
            stamp = round(record["time"] * 1e9)
        frame, recorded = self._frame(record), record.get(RECORDED)
        try:
            self._bag.write(stamp, point, points, np.array(likely), frame, recorded)
        except ValueError as fault:
            errors.print(f"not in the bag: {fault}", highlight=False, soft_wrap=True)
        except OSError as fault:
            self.broken = True
            errors.print(f"{fault}; the stream goes on without it", highlight=False, soft_wrap=True)

    def _frame(self, record: dict[str, Any]) -> str | None:
        """Name of the frame that points are in, where the input says it."""
        from vibrissa.streaming.lines import FRAME

        if self._follow and self._running.poses.number:
            return self._running.laboratory or None
        return record.get(FRAME) if self._same else None
