"""Sources of lines (file, pipe, serial device, UDP, ROS bag), and destinations of results.

A pipe blocks its sender until data are read. Datagrams are queued instead: if more arrive than can
be processed, results would lag behind by the length of the system's queue, and further datagrams
would be lost. Therefore only the newest of the waiting datagrams is processed (`NewestLines`).
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
from vibrissa.sensors import COMPONENTS
from vibrissa.streaming.contacts import ContactStreams
from vibrissa.streaming.lines import FRAME, LONGEST, POSITION, QUATERNION, RECORDED, STAMP, LineKind

_LARGEST = 65535  # largest size of a datagram, bytes
_WAITING = 1 << 22  # requested size of the receive buffer, bytes
# Time after which the newest datagram so far is processed although others keep arriving, s.
_DRAINED = 0.02
_POSES = 2  # number of poses needed to extrapolate a motion
# On Linux, the socket option that returns counters, and the index of lost datagrams among these.
_COUNTERS, _LOST = 55, 8
_BACK = 0.2  # time after which a closed source is reopened, s


def file_lines(
    path: Path, reconnect: bool = False, report: Callable[[str], None] | None = None
) -> Iterator[str]:
    """Yield lines of a file, named pipe or device as they arrive, until it ends."""
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
        raise ValueError(f"{path} is a file; only a named pipe or device can be reopened")
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
    """Yield lines as they arrive, truncated to the largest length."""
    while line := file.readline(LONGEST + 1):
        yield line
        while len(line) > LONGEST and not line.endswith("\n"):
            line = file.readline(LONGEST + 1)


def udp_address(text: str) -> tuple[str, int]:
    """Parse an address ``HOST:PORT``."""
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdigit() or int(port) > 65535:
        raise ValueError(f"an address is HOST:PORT, such as 127.0.0.1:5005; got {text!r}")
    return host.strip("[]"), int(port)


def udp_socket(host: str, port: int) -> socket.socket:
    """Open a UDP socket for `udp_lines`."""
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
    """Yield lines of datagrams indefinitely; a datagram contains one or several complete lines."""
    while True:
        yield from _text(opened.recv(_LARGEST))


def udp_lost(opened: socket.socket) -> int:
    """Number of datagrams that the system discarded because its queue was full."""
    if sys.platform != "linux":
        return 0
    try:
        counters = opened.getsockopt(socket.SOL_SOCKET, _COUNTERS, 4 * (_LOST + 1))
    except OSError:
        return 0
    return int(struct.unpack_from("=I", counters, 4 * _LOST)[0])


class Answers:
    """Output of results to another program, as UDP datagrams or lines of a TCP connection."""

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
                # Send short lines without delay.
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                self._socket.connect(address)
            except OSError:
                self._socket.close()
                raise
        except OSError as error:
            raise ValueError(f"answers cannot go to {text}: {error}") from error

    def send(self, line: str) -> None:
        """Send one result."""
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
    """Endless iterator over the lines of the newest datagram.

    Samples of earlier waiting datagrams are dropped and counted; headers, and the poses needed to
    extrapolate the motion of the base, are kept.
    """

    def __init__(self, opened: socket.socket, kind: Callable[[str], LineKind]) -> None:
        self.dropped = 0
        self._opened, self._kind = opened, kind

    def __iter__(self) -> Iterator[str]:
        while True:
            *before, newest = self._waiting(self._opened.recv(_LARGEST))
            yield from self._latest_poses([line for data in before for line in self._needed(data)])
            yield from _text(newest)

    def _waiting(self, first: bytes) -> list[bytes]:
        """All waiting datagrams, after the first one received."""
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
        """Lines of an older datagram that later ones depend on."""
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
    """Yield poses and wrenches of a bag as lines, in order of time."""

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
    """Writer of records to a bag; if writing fails, the stream continues without it.

    Points are in the frame of the measurements if ``same`` is true, as for a sensor aligned with
    the whisker, or in the laboratory frame if contacts are followed there.
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
        """Write the record of a sample; records of errors are ignored."""
        if self.broken or "error" in record:
            return
        points = np.reshape(record.get("hypotheses", record.get("candidates", [])), (-1, 3))
        likely = record.get("probabilities", np.full(len(points), 1.0 / max(len(points), 1)))
        names = ("lab_x", "lab_y", "lab_z") if self._follow else ("x", "y", "z")
        point = np.array([record[name] for name in names]) if "x" in record else None
        if (stamp := record.get(STAMP)) is None:
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
        """Name of the frame of points, if the input states it."""
        running = self._poses[record.get("whisker", "")]
        if self._follow and running.poses.number:
            return running.laboratory or None
        return record.get(FRAME) if self._same else None
