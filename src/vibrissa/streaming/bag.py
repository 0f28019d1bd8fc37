"""ROS bags as a source of lines, and as a place for the contacts that are found."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from heapq import merge
from pathlib import Path
from typing import Any

import numpy as np

from vibrissa.io import BagMessage, ContactBag, bag_poses, bag_wrenches
from vibrissa.streaming.contacts import COMPONENTS, ContactStreams
from vibrissa.streaming.lines import FRAME, POSITION, QUATERNION, RECORDED, STAMP


def bag_lines(source: Path, topic: str | None, pose_topic: str | None) -> Iterator[str]:
    """Read lines from a bag, poses and wrenches in the order of their times."""

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

    Points are in the frame of the measurements (same), that of a sensor unless it is mounted
    otherwise than along the whisker, or are followed in the laboratory.
    """

    def __init__(
        self,
        bag: ContactBag,
        running: ContactStreams,
        same: bool,
        follow: bool,
        remark: Callable[[str], None],
    ) -> None:
        self._bag, self._follow, self._remark = bag, follow, remark
        self._poses = {one.whisker: one for one in running.streams}
        self._same = same
        self.broken = False

    def put(self, record: dict[str, Any]) -> None:
        """Write the record of a sample; those of faults are left out."""
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
            self._bag.write(
                stamp,
                point,
                points,
                np.array(likely),
                frame,
                recorded,
                covariance=record.get("lab_covariance" if self._follow else "covariance"),
                force=record.get("force"),
                whisker=record.get("whisker", ""),
            )
        except ValueError as fault:
            self._remark(f"not in the bag: {fault}")
        except OSError as fault:
            self.broken = True
            self._remark(f"{fault}; the stream goes on without it")

    def _frame(self, record: dict[str, Any]) -> str | None:
        """Name of the frame that points are in, where the input states it."""
        running = self._poses[record.get("whisker", "")]
        if self._follow and running.poses.number:
            return running.laboratory or None
        return record.get(FRAME) if self._same else None
