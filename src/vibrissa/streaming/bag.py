"""ROS bags as a source of lines, and as a place for the contacts that are found."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from heapq import merge
from pathlib import Path
from typing import Any

import numpy as np

from vibrissa.io import BagMessage, ContactBag, bag_poses, bag_wrenches
from vibrissa.sensors import Sensor
from vibrissa.streaming.contacts import COMPONENTS, ContactStream
from vibrissa.streaming.lines import FRAME, POSITION, QUATERNION, RECORDED, STAMP


def bag_lines(source: Path, topic: str | None, pose_topic: str | None) -> Iterator[str]:
    """Read lines from a bag, poses and wrenches in the order of their times.

    Parameters
    ----------
    source : Path
        The bag.
    topic : str, optional
        Topic of the wrenches; the only one by default.
    pose_topic : str, optional
        Topic of the poses; none are read by default.

    Yields
    ------
    str
        One line a message, as a stream would have received it.
    """

    def named(messages: Iterator[BagMessage], names: tuple[str, ...]) -> Iterator[dict[str, Any]]:
        for stamp, recorded, frame, values in messages:
            about = {STAMP: stamp, RECORDED: recorded, FRAME: frame}
            yield about | dict(zip(names, values, strict=True))

    poses: Iterator[dict[str, Any]] = iter(())
    if pose_topic is not None:
        poses = named(bag_poses(source, pose_topic), (*POSITION, *QUATERNION))
    wrenches = named(bag_wrenches(source, topic), COMPONENTS)
    for message in merge(poses, wrenches, key=lambda one: one[STAMP]):
        yield json.dumps(message)


class ContactRecorder:
    """Writer of records to a bag, as long as that can be written; the stream goes on without.

    Parameters
    ----------
    bag : ContactBag
        Open bag.
    running : ContactStream
        Stream whose records are written.
    sensor : Sensor or None
        Sensor at the base, which defines the frame of the points.
    follow : bool
        Whether contacts are followed in the laboratory.
    remark : callable
        Function that reports a sentence to the user.
    """

    def __init__(
        self,
        bag: ContactBag,
        running: ContactStream,
        sensor: Sensor | None,
        follow: bool,
        remark: Callable[[str], None],
    ) -> None:
        self._bag, self._running, self._follow, self._remark = bag, running, follow, remark
        # Points are in the whisker's frame, which is the sensor's unless that is mounted otherwise.
        self._same = sensor is None or np.array_equal(sensor.frame.to_base(), np.eye(6))
        self.broken = False

    def put(self, record: dict[str, Any]) -> None:
        """Write the record of a sample; those of faults are left out.

        Parameters
        ----------
        record : dict
            Record of the stream.
        """
        if self.broken or "error" in record:
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
            self._remark(f"not in the bag: {fault}")
        except OSError as fault:
            self.broken = True
            self._remark(f"{fault}; the stream goes on without it")

    def _frame(self, record: dict[str, Any]) -> str | None:
        """Name of the frame that points are in, where the input states it."""
        if self._follow and self._running.poses.number:
            return self._running.laboratory or None
        return record.get(FRAME) if self._same else None
