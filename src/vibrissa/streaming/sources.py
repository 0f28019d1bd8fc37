"""Sources of lines: a file, pipe, serial device, UDP datagrams or ROS bag; and targets of answers.

A pipe holds its sender up until what it sent is read. Datagrams wait instead, and where more come
than can be answered, answers fall behind by as many as the system keeps, and what comes then is
lost. So of those that wait only the newest is answered (`NewestLines`).
"""

from __future__ import annotations

import json
import socket
import stat
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from heapq import merge
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from vibrissa.io import BagMessage, ContactBag, bag_poses, bag_wrenches
from vibrissa.streaming.contacts import COMPONENTS, ContactStreams
from vibrissa.streaming.lines import (
    FRAME,
    LONGEST,
    POSITION,
    QUATERNION,
    RECORDED,
    STAMP,
    LineKind,
)

_LARGEST = 65535  # a datagram holds no more
_WAITING = 1 << 22  # bytes that may wait to be read
# Seconds after which the newest datagram so far is answered, though others go on coming.
_DRAINED = 0.02
_POSES = 2  # poses that a motion is continued from
# Of Linux: the option of a socket that gives its counters, and which of them counts what is lost.
_COUNTERS, _LOST = 55, 8
_BACK = 0.2  # seconds after which a line that has closed is opened anew


def file_lines(
    path: Path, reconnect: bool = False, report: Callable[[str], None] | None = None
) -> Iterator[str]:
    """Read lines as they come, from a file, named pipe or device, until it ends."""
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    if not reconnect:
        try:
            with path.open(encoding="utf-8", errors="replace") as file:
                yield from bounded_lines(file)
        except OSError as fault:  # a device that was unplugged
            raise OSError(
                f"{path} was lost ({fault.strerror}); --reconnect waits until it opens again"
            ) from fault
        return
    if stat.S_ISREG(path.stat().st_mode):
        raise ValueError(f"{path} is a file, which ends; a named pipe or device opens anew")
    remark = report or (lambda sentence: None)
    closed = False
    while True:
        reason = ""
        try:
            with path.open(encoding="utf-8", errors="replace") as file:
                for line in bounded_lines(file):
                    if closed:
                        remark(f"{path} is open again")
                        closed = False
                    if line.endswith("\n") or len(line) > LONGEST:
                        yield line
        except OSError as fault:  # a device that was unplugged
            reason = f" ({fault.strerror})"
        if not closed:
            remark(f"{path} closed{reason}; waiting until it opens again")
        closed = True
        time.sleep(_BACK)


def bounded_lines(file: TextIO) -> Iterator[str]:
    """Read lines as they come; of longer ones only the first part is kept."""
    while line := file.readline(LONGEST + 1):
        yield line
        while len(line) > LONGEST and not line.endswith("\n"):
            line = file.readline(LONGEST + 1)


def udp_address(text: str) -> tuple[str, int]:
    """Read an address written as ``HOST:PORT``."""
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdigit() or int(port) > 65535:
        raise ValueError(f"an address is HOST:PORT, such as 127.0.0.1:5005; got {text!r}")
    return host.strip("[]"), int(port)


def udp_socket(host: str, port: int) -> socket.socket:
    """Open the socket that `udp_lines` reads."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    opened = socket.socket(family, socket.SOCK_DGRAM)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _WAITING)  # or what the system allows
    try:
        opened.bind((host, port))
    except OSError as error:
        opened.close()
        raise ValueError(f"no UDP socket at {host or '*'}:{port}: {error}") from error
    return opened


def udp_lines(opened: socket.socket) -> Iterator[str]:
    """Receive lines without end; a datagram holds one or several whole ones."""
    while True:
        yield from _text(opened.recv(_LARGEST))


def udp_lost(opened: socket.socket) -> int:
    """Count the datagrams that the system discarded because too many were waiting."""
    if sys.platform != "linux":
        return 0
    try:
        counters = opened.getsockopt(socket.SOL_SOCKET, _COUNTERS, 4 * (_LOST + 1))
    except OSError:
        return 0
    return int(struct.unpack_from("=I", counters, 4 * _LOST)[0])


class Answers:
    """Answers as messages to another program: a UDP datagram each, or lines of a TCP connection."""

    def __init__(self, text: str) -> None:
        scheme, mark, rest = text.partition("://")
        if not mark or scheme not in ("udp", "tcp"):
            raise ValueError(f"answers go to udp://HOST:PORT or tcp://HOST:PORT; got {text!r}")
        host, port = udp_address(rest)
        kind = socket.SOCK_DGRAM if scheme == "udp" else socket.SOCK_STREAM
        self._datagrams = scheme == "udp"
        try:
            family, *_, address = socket.getaddrinfo(host, port, type=kind)[0]
            self._socket = socket.socket(family, kind)
            if not self._datagrams:
                # A small line waits for nothing.
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                self._socket.connect(address)
            except OSError:
                self._socket.close()
                raise
        except OSError as error:
            raise ValueError(f"answers cannot go to {text}: {error}") from error

    def send(self, line: str) -> None:
        """Send one answer."""
        data = (line + "\n").encode()
        if not self._datagrams:
            self._socket.sendall(data)
            return
        with suppress(ConnectionRefusedError):
            self._socket.send(data)

    def __enter__(self) -> Answers:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()


class NewestLines:
    """Lines of the newest datagram that has come; iterates without end.

    Samples of datagrams before it are dropped and counted. Headers are not, nor poses that the
    motion of the base is continued from.
    """

    def __init__(self, opened: socket.socket, kind: Callable[[str], LineKind]) -> None:
        self.dropped = 0
        self._opened, self._kind = opened, kind

    def __iter__(self) -> Iterator[str]:
        """Receive."""
        while True:
            *before, newest = self._waiting(self._opened.recv(_LARGEST))
            yield from self._latest_poses([line for data in before for line in self._needed(data)])
            yield from _text(newest)

    def _waiting(self, first: bytes) -> list[bytes]:
        """All datagrams that wait, after one that does not any more."""
        datagrams, end = [first], time.monotonic() + _DRAINED
        self._opened.setblocking(False)
        try:
            while time.monotonic() < end:
                datagrams.append(self._opened.recv(_LARGEST))
        except BlockingIOError:
            pass
        finally:
            self._opened.setblocking(True)
        return datagrams

    def _needed(self, data: bytes) -> list[str]:
        """Lines of a datagram that is not the newest which later ones rely on."""
        lines = _text(data)
        kept = [line for line in lines if self._kind(line) is not LineKind.SAMPLE]
        self.dropped += len(lines) - len(kept)
        return kept

    def _latest_poses(self, lines: list[str]) -> list[str]:
        poses = [i for i, line in enumerate(lines) if self._kind(line) is LineKind.POSE]
        stale = set(poses[:-_POSES])
        return [line for i, line in enumerate(lines) if i not in stale]


def _text(data: bytes) -> list[str]:
    return data.decode("utf-8", errors="replace").splitlines()


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
