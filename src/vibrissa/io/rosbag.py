"""ROS 2 bags: wrenches in, contact points out (extra ``ros``: rosbags, which needs no ROS).

`geometry_msgs/WrenchStamped` is read, and `PoseStamped` or `TransformStamped` for the pose of the
base, from ROS 1 bags as well; `geometry_msgs/PointStamped` is written for contact points, and
`sensor_msgs/PointCloud2` for all candidates of a sample.
"""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_WRENCH = "geometry_msgs/msg/WrenchStamped"
_POINT = "geometry_msgs/msg/PointStamped"
_CLOUD = "sensor_msgs/msg/PointCloud2"
_POSE = "geometry_msgs/msg/PoseStamped"
_TRANSFORM = "geometry_msgs/msg/TransformStamped"
_SUFFIXES = {".bag", ".db3", ".mcap"}
# Of sensor_msgs/PointField: 64-bit floats.
_FLOAT64 = 8


def is_bag(path: str | PathLike[str]) -> bool:
    """Tell whether a path looks like a bag.

    Parameters
    ----------
    path : str or path
        A folder with ``metadata.yaml`` (ROS 2), or a file ending in .bag, .db3 or .mcap.

    Returns
    -------
    bool
        Whether it does.
    """
    path = Path(path)
    return (path / "metadata.yaml").is_file() or (path.is_file() and path.suffix in _SUFFIXES)


def bag_wrenches(
    path: str | PathLike[str], topic: str | None = None
) -> Iterator[tuple[float, Array, str]]:
    """Read wrenches from a bag, in the order of recording.

    Parameters
    ----------
    path : str or path
        Of the bag.
    topic : str, optional
        With WrenchStamped messages; by default the only one that has them.

    Yields
    ------
    time : float
        Of the message's header, s; where that is zero, when it was recorded.
    wrench : array (6,)
        Force, N, and torque, N·m.
    frame : str
        Name of the frame they are in.

    Raises
    ------
    FileNotFoundError
        If there is no such bag.
    ModuleNotFoundError
        If rosbags is not installed.
    ValueError
        If it is no bag, or the topic is not there or not the only one.
    """
    for time, message in _messages(path, topic, (_WRENCH,), "WrenchStamped"):
        f, t = message.wrench.force, message.wrench.torque
        yield time, np.array([f.x, f.y, f.z, t.x, t.y, t.z]), message.header.frame_id


def bag_poses(
    path: str | PathLike[str], topic: str | None = None
) -> Iterator[tuple[float, list[float], list[float]]]:
    """Read poses from a bag, in the order of recording.

    Parameters
    ----------
    path : str or path
        Of the bag.
    topic : str, optional
        With PoseStamped or TransformStamped messages; by default the only one that has them.

    Yields
    ------
    time : float
        Of the message's header, s; where that is zero, when it was recorded.
    position : list of 3 floats
        Where it is in its parent's frame, m.
    quaternion : list of 4 floats
        W, x, y, z; from its own to the parent's frame.

    Raises
    ------
    FileNotFoundError
        If there is no such bag.
    ModuleNotFoundError
        If rosbags is not installed.
    ValueError
        If it is no bag, or the topic is not there or not the only one.
    """
    kinds = (_POSE, _TRANSFORM)
    for time, message in _messages(path, topic, kinds, "PoseStamped or TransformStamped"):
        if hasattr(message, "pose"):
            p, q = message.pose.position, message.pose.orientation
        else:
            p, q = message.transform.translation, message.transform.rotation
        yield time, [p.x, p.y, p.z], [q.w, q.x, q.y, q.z]


def _messages(
    path: str | PathLike[str], topic: str | None, kinds: tuple[str, ...], named: str
) -> Iterator[tuple[float, Any]]:
    """Times and messages of some kinds on one topic."""
    rosbags = _library()
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no bag {path}")
    try:
        reader = rosbags.reader([path], default_typestore=rosbags.types)
        reader.open()
    except rosbags.fault as error:
        raise ValueError(f"{path} is no bag that can be read: {error}") from error
    try:
        fitting = [c for c in reader.connections if c.msgtype in kinds]
        there = sorted({c.topic for c in fitting})
        if topic is None and len(there) == 1:
            topic = there[0]
        if topic not in there:
            raise ValueError(f"{path}: {_which_topic(reader.connections, there, topic, named)}")
        chosen = [c for c in fitting if c.topic == topic]
        for connection, recorded, raw in reader.messages(connections=chosen):
            message: Any = reader.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp
            yield stamp.sec + 1e-9 * stamp.nanosec or 1e-9 * recorded, message
    finally:
        reader.close()


def _which_topic(connections: Any, there: list[str], topic: str | None, named: str) -> str:
    """Say why it is open from which topic messages are read."""
    if there:
        lacks = "" if topic is None else f"there is no {topic!r} with {named}; "
        return f"{lacks}name one of those with {named} messages: {', '.join(there)}"
    others = sorted({f"{c.topic} ({c.msgtype})" for c in connections})
    return f"it has no topic with {named} messages, only {', '.join(others) or 'none at all'}"


class ContactBag:
    """Writes contact points and clouds of candidates into a ROS 2 bag; a context manager.

    Parameters
    ----------
    path : str or path
        Of the bag, a folder that must not exist.
    frame : str
        Name of the frame that points are in.
    point_topic, cloud_topic : str
        Where to write them.

    Raises
    ------
    FileExistsError
        If there is something at the path.
    ModuleNotFoundError
        If rosbags is not installed.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        frame: str = "whisker",
        point_topic: str = "/contact_point",
        cloud_topic: str = "/contact_candidates",
    ) -> None:
        self._rosbags = _library()
        path = Path(path)
        if path.exists():
            raise FileExistsError(f"{path} exists; a bag is written to a new folder")
        if not path.parent.is_dir():
            raise FileNotFoundError(f"there is no folder {path.parent}")
        self.frame = frame
        self._writer = self._rosbags.writer(path, version=self._rosbags.version)
        self._topics = {_POINT: point_topic, _CLOUD: cloud_topic}
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> ContactBag:
        """Open the bag."""
        self._writer.open()
        for kind, topic in self._topics.items():
            self._connections[kind] = self._writer.add_connection(
                topic, kind, typestore=self._rosbags.types
            )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close it."""
        self._writer.close()

    def write(self, time: float, point: Array | None, candidates: Array, values: Array) -> None:
        """Write one sample.

        Parameters
        ----------
        time : float
            Of it, s.
        point : (3,) array or None
            The contact, m; None for none.
        candidates : (k, 3) array
            Points of the cloud, m.
        values : (k,) array
            Their probabilities, field ``probability`` of the cloud.
        """
        types = self._rosbags.types.types
        sec, nanosec = divmod(round(time * 1e9), 1_000_000_000)
        stamp = types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id=self.frame)
        if point is not None:
            place = types["geometry_msgs/msg/Point"](*(float(x) for x in point))
            self._put(_POINT, sec, nanosec, types[_POINT](header=header, point=place))
        table = np.column_stack([candidates, values]).astype("<f8")
        names = ("x", "y", "z", "probability")
        fields = [
            types["sensor_msgs/msg/PointField"](name, 8 * i, _FLOAT64, 1)
            for i, name in enumerate(names)
        ]
        cloud = types[_CLOUD](
            header=header,
            height=1,
            width=len(table),
            fields=fields,
            is_bigendian=False,
            point_step=32,
            row_step=32 * len(table),
            data=np.frombuffer(table.tobytes(), dtype=np.uint8),
            is_dense=True,
        )
        self._put(_CLOUD, sec, nanosec, cloud)

    def _put(self, kind: str, sec: int, nanosec: int, message: Any) -> None:
        raw = self._rosbags.types.serialize_cdr(message, kind)
        self._writer.write(self._connections[kind], 1_000_000_000 * sec + nanosec, raw)


class _Rosbags:
    """The parts of the library that are used."""

    def __init__(self) -> None:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.rosbag2 import Writer
        from rosbags.typesys import Stores, get_typestore

        self.reader, self.writer, self.fault = AnyReader, Writer, AnyReaderError
        self.version = Writer.VERSION_LATEST
        self.types: Any = get_typestore(Stores.ROS2_HUMBLE)


def _library() -> _Rosbags:
    try:
        return _Rosbags()
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "bags are read and written by rosbags: pip install 'vibrissa[ros]'"
        ) from error
