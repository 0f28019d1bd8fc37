"""`vibrissa stream`: contacts while signals come in."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from io import TextIOWrapper
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vibrissa.cli.terminal import errors, refuse

if TYPE_CHECKING:
    from vibrissa.io.rosbag import ContactBag
    from vibrissa.mapping import ContactMap, Estimator
    from vibrissa.sensing import Sensor
    from vibrissa.streaming import ContactStream, Poses

# Advice is given once after so many samples, and at the end.
_SOON = 500


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
    stiffness_sigma: Annotated[
        float,
        typer.Option(help="Standard deviation of the whisker's bending stiffness, %.", min=0.0),
    ] = 0.0,
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
    that cannot be read gives a line with its number and the error. Points are in the whisker's
    frame, m; with --filter also in the laboratory's (lab_x, ...). Stop with Ctrl-C.
    Example: `vibrissa stream --udp 127.0.0.1:5005 --map wire.nc --sensor sensor.toml`
    """
    from vibrissa.cli.recordings import usual_noise
    from vibrissa.io.rosbag import is_bag
    from vibrissa.sensing import load_sensor

    if source is not None and udp is not None:
        raise ValueError("give either a source or --udp")
    if sensor is not None:
        options = {"--signals": signals, "--force-noise": force_noise}
        reason = "channels and noise are those of the --sensor"
        refuse(options | {"--moment-noise": moment_noise}, reason)
    else:
        refuse({"--tare": tare}, "the offset is that of a sensor's channels: give the --sensor")
    if not follow:
        refuse({"--speed": speed}, "it is of the filter: add --filter")
    described = None if sensor is None else load_sensor(sensor)
    from_bag = source is not None and is_bag(source)
    if not from_bag:
        refuse(
            {"--topic": topic, "--pose-topic": pose_topic},
            "it is of a ROS bag, and the source is none",
        )
    poses = _poses(mount)
    with ExitStack() as opened:
        writer = None if bag is None else opened.enter_context(_bag(bag, follow))
        lines = (
            _bag_lines(source, topic, pose_topic)
            if source is not None and from_bag
            else _lines(source, udp, opened)
        )
        contacts = _map(chart, whisker)
        estimator = _estimator(
            contacts,
            described,
            signals or "Fx,MB,MD",
            usual_noise(force_noise, moment_noise),
            stiffness_sigma,
            felt,
        )
        running = _stream(estimator, described, from_bag, follow, speed, poses, tare or 0)
        running.warm_up()
        if udp is not None:
            errors.print("ready", highlight=False)
        with suppress(KeyboardInterrupt):  # the usual end
            _write(running, islice(lines, count), writer)
    if follow and not running.poses.number:
        errors.print("no pose came: the base was taken to stand still", highlight=False)
    errors.print(
        f"{running.samples} samples, {running.faults} lines that could not be read",
        highlight=False,
    )
    _advise(running)


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


def _lines(source: Path | None, udp: str | None, opened: ExitStack) -> Iterator[str]:
    """Lines as they come; a socket is open before the map is made, so that none are lost."""
    from vibrissa.io.paths import check_readable
    from vibrissa.streaming.sources import file_lines, udp_address, udp_lines, udp_socket

    if udp is not None:
        heard = opened.enter_context(udp_socket(*udp_address(udp)))
        host, port = heard.getsockname()[:2]
        errors.print(f"listening at {host}:{port}", highlight=False)
        return udp_lines(heard)
    if source is None or str(source) == "-":
        if isinstance(sys.stdin, TextIOWrapper):  # noise on a serial line must not end a stream
            sys.stdin.reconfigure(errors="replace")
        return iter(sys.stdin.readline, "")
    if source.is_dir() or not source.exists():
        check_readable(source)
    return file_lines(source)


def _bag_lines(source: Path, topic: str | None, pose_topic: str | None) -> Iterator[str]:
    """Lines as they would have come, poses and wrenches in the order of their times."""
    import json
    from heapq import merge

    from vibrissa.io.rosbag import bag_poses, bag_wrenches
    from vibrissa.streaming.contacts import COMPONENTS
    from vibrissa.streaming.lines import POSITION, QUATERNION

    wrenches: Iterator[tuple[float, dict[str, float]]] = (
        (time, dict(zip(COMPONENTS, wrench.tolist(), strict=True)))
        for time, wrench, _ in bag_wrenches(source, topic)
    )
    poses: Iterator[tuple[float, dict[str, float]]] = iter(())
    if pose_topic is not None:
        poses = (
            (time, dict(zip((*POSITION, *QUATERNION), [*place, *turn], strict=True)))
            for time, place, turn in bag_poses(source, pose_topic)
        )
    for time, values in merge(poses, wrenches, key=lambda timed: timed[0]):
        yield json.dumps({"time": time} | values)


def _map(chart: Path | None, whisker: Path | None) -> ContactMap:
    from vibrissa.cli.sources import map_from, whisker_from
    from vibrissa.mapping import ContactMap

    if chart is not None and whisker is not None:
        raise ValueError("give either --map or --whisker: a map already has its whisker")
    if chart is not None:
        return map_from(chart)
    chosen = whisker_from(whisker)
    errors.print(f"no map given; simulating that of {chosen!r}", highlight=False, soft_wrap=True)
    return ContactMap.simulate(chosen, grid=False)


def _estimator(
    contacts: ContactMap,
    sensor: Sensor | None,
    signals: str,
    noise: tuple[float, float],
    stiffness_sigma: float,
    felt: float,
) -> Estimator:
    import numpy as np

    from vibrissa.mapping import Estimator

    share = 0.01 * stiffness_sigma
    if sensor is not None:
        return Estimator.of_sensor(contacts, sensor, share, felt)
    covariance = np.diag(np.repeat([1e-6 * noise[0], 1e-6 * noise[1]], 3) ** 2)
    return Estimator(contacts, signals, covariance, share, felt)


def _stream(
    estimator: Estimator,
    sensor: Sensor | None,
    from_bag: bool,
    follow: bool,
    speed: float | None,
    poses: Poses,
    tare: int,
) -> ContactStream:
    from vibrissa.mapping import ContactFilter
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


def _write(running: ContactStream, lines: Iterator[str], writer: ContactBag | None) -> None:
    """Print records as they come, each at once; stop quietly when nobody reads any more."""
    from vibrissa.streaming.contacts import as_json

    try:
        for record in running.records(lines):
            sys.stdout.write(as_json(record) + "\n")
            sys.stdout.flush()
            if writer is not None and "error" not in record:
                _put(writer, record)
            if running.samples == _SOON:
                _advise(running)
    except BrokenPipeError:
        # What is flushed at the end must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _put(writer: ContactBag, record: dict[str, Any]) -> None:
    import numpy as np

    followed = "hypotheses" in record
    points = np.reshape(record.get("hypotheses", record.get("candidates", [])), (-1, 3))
    likely = record.get("probabilities", [1.0 / len(points)] * len(points) if len(points) else [])
    names = ("lab_x", "lab_y", "lab_z") if followed else ("x", "y", "z")
    point = np.array([record[name] for name in names]) if "x" in record else None
    writer.write(record["time"], point, points, np.array(likely))
