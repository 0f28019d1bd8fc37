"""Reading of wrenches from and writing of contact points to ROS bags (by rosbags, without ROS).

`geometry_msgs/WrenchStamped` is read, and `PoseStamped` or `TransformStamped` for the pose of the
base, from bags of ROS 1 and ROS 2. For each sample, `geometry_msgs/PointStamped` and
`PoseWithCovarianceStamped` are written for the contact point, `WrenchStamped` for the force there,
and `sensor_msgs/PointCloud2` for all candidates. Time stamps are integer nanoseconds throughout, as
seconds since 1970 in a 64-bit float are rounded to a quarter of a microsecond.

A bag written by rosbags is readable only after it has been closed. As a stream may be interrupted
at any time, bags are written here directly (SQLite, schema 4, and ``metadata.yaml`` of version 9),
and both files are updated every half second.
"""

from __future__ import annotations

import json
import shutil
import sqlite3
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from functools import partial
from os import PathLike
from pathlib import Path
from types import SimpleNamespace, TracebackType
from typing import Any, Final, NamedTuple

import numpy as np

from vibrissa.numerics import Array

_WRENCH = "geometry_msgs/msg/WrenchStamped"
_POINT = "geometry_msgs/msg/PointStamped"
_CLOUD = "sensor_msgs/msg/PointCloud2"
_POSE = "geometry_msgs/msg/PoseStamped"
_TRANSFORM = "geometry_msgs/msg/TransformStamped"
_UNCERTAIN = "geometry_msgs/msg/PoseWithCovarianceStamped"
_MCAP = ".mcap"
_SUFFIXES = {".bag", ".db3", _MCAP}
# Topics of the contact point, its covariance, the force, and all candidates.
_TOPICS = {
    _POINT: "/contact_point",
    _UNCERTAIN: "/contact_pose",
    _WRENCH: "/contact_force",
    _CLOUD: "/contact_candidates",
}
_FLOAT32 = 7  # of sensor_msgs/PointField: 32-bit floats
# Variance of a uniformly distributed angle.
_ANY_ANGLE = np.pi**2 / 3.0
_SECOND = 1_000_000_000
_LARGEST_SECOND = 2**31 - 1  # seconds of a ROS time stamp are 32-bit numbers
_KEPT_EVERY = 0.5  # time between two updates of a bag, s


def is_bag(path: str | PathLike[str]) -> bool:
    """Whether a path looks like a bag."""
    path = Path(path)
    return (path / "metadata.yaml").is_file() or (path.is_file() and path.suffix in _SUFFIXES)


class BagMessage(NamedTuple):
    """Message of a bag: times of measurement and of recording, ns, and values in SI units."""

    stamp: int
    recorded: int
    frame: str
    values: list[float]


def bag_topics(path: str | PathLike[str]) -> dict[str, tuple[str, int]]:
    """List the topics of a bag: type and number of messages."""
    with _opened(path) as reader:
        return {c.topic: (c.msgtype, c.msgcount) for c in reader.connections}


@contextmanager
def _opened(path: str | PathLike[str]) -> Iterator[Any]:
    """Open a bag for reading."""
    rosbags = _library()
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no bag {path}")
    with _readable(path):
        # Let SQLite roll back the unfinished transaction of a killed process. The library opens
        # databases as immutable and would not do so.
        files = [path] if path.is_file() else path.glob("*.db3")
        for file in files:
            if Path(f"{file}-journal").exists():
                with closing(sqlite3.connect(file)) as database:
                    database.execute("SELECT count(*) FROM sqlite_master").fetchone()
        reader = rosbags.reader([path], default_typestore=rosbags.types)
        reader.open()
    try:
        yield reader
    finally:
        with suppress(Exception):  # a damaged bag may be open only partially
            reader.close()


def bag_wrenches(path: str | PathLike[str], topic: str | None = None) -> Iterator[BagMessage]:
    """Read wrenches from a bag, in the order of recording."""

    def values(message: Any) -> list[float]:
        f, t = message.wrench.force, message.wrench.torque
        return [f.x, f.y, f.z, t.x, t.y, t.z]

    return _messages(path, topic, (_WRENCH,), "WrenchStamped", values)


def bag_poses(path: str | PathLike[str], topic: str | None = None) -> Iterator[BagMessage]:
    """Read poses from a bag, in the order of recording."""

    def values(message: Any) -> list[float]:
        if hasattr(message, "pose"):
            p, q = message.pose.position, message.pose.orientation
        else:
            p, q = message.transform.translation, message.transform.rotation
        return [p.x, p.y, p.z, q.w, q.x, q.y, q.z]

    kinds = (_POSE, _TRANSFORM)
    return _messages(path, topic, kinds, "PoseStamped or TransformStamped", values)


def _messages(
    path: str | PathLike[str],
    topic: str | None,
    kinds: tuple[str, ...],
    named: str,
    values: Callable[[Any], list[float]],
) -> Iterator[BagMessage]:
    """Messages of some kinds on one topic."""
    path = Path(path)
    with _opened(path) as reader:
        fitting = [c for c in reader.connections if c.msgtype in kinds]
        there = sorted({c.topic for c in fitting})
        # A sensor's readings are not the forces at contacts that were estimated from them.
        measured = [name for name in there if not name.endswith(_TOPICS[_WRENCH])]
        if topic is None and len(measured) == 1:
            topic = measured[0]
        if topic not in there:
            there = there if topic else measured
            raise ValueError(f"{path}: {_which_topic(reader.connections, there, topic, named)}")
        messages = iter(reader.messages(connections=[c for c in fitting if c.topic == topic]))
        while True:
            with _readable(path):
                if (following := next(messages, None)) is None:
                    return
                connection, recorded, raw = following
                message: Any = reader.deserialize(raw, connection.msgtype)
                stamp = _SECOND * message.header.stamp.sec + message.header.stamp.nanosec
                read = BagMessage(
                    stamp or recorded, recorded, message.header.frame_id, values(message)
                )
            yield read


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Convert the library's errors for damaged bags to ValueError."""
    try:
        yield
    except Exception as error:
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        raise ValueError(f"{path} is not a bag that can be read: {reason}") from error


def _which_topic(connections: Any, there: list[str], topic: str | None, named: str) -> str:
    """Describe why the topic to read from is not determined."""
    if there:
        lacks = "" if topic is None else f"there is no {topic!r} with {named}; "
        return f"{lacks}name one of those with {named} messages: {', '.join(there)}"
    others = sorted(
        f"{name} (estimated forces at contacts)" if kind == _WRENCH else f"{name} ({kind})"
        for name, kind in {(c.topic, c.msgtype) for c in connections}
    )
    return f"it has no topic with {named} messages, only {', '.join(others) or 'none at all'}"


_SCHEMA = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(
    id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL
);
CREATE TABLE topics(
    id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
    serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL,
    type_description_hash TEXT NOT NULL
);
CREATE TABLE message_definitions(
    id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
    encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL
);
CREATE TABLE messages(
    id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
    data BLOB NOT NULL
);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO schema(schema_version, ros_distro) VALUES (4, 'rosbags');
"""
_METADATA_VERSION: Final = 9


class ContactBag:
    """Context manager that writes contacts of one or several whiskers to a ROS 2 bag.

    A folder is consistent every half second, however the process ends, unless the power fails. An
    MCAP file is written under a temporary name and renamed once it is complete.

    The folder, or the file ending in ``.mcap``, must not exist. With names of whiskers, topics
    start with these: ``/left/contact_point``.
    """

    def __init__(
        self, path: str | PathLike[str], frame: str = "whisker", whiskers: Sequence[str] = ("",)
    ) -> None:
        self._types = _library().types
        self._path = Path(path)
        if self._path.exists():
            raise FileExistsError(f"{path} exists; a bag is written to a new folder or file")
        if not self._path.parent.is_dir():
            raise FileNotFoundError(f"there is no folder {self._path.parent}")
        self.frame = frame
        self._topics = {
            (name, kind): f"/{name}{topic}" if name else topic
            for name in whiskers
            for kind, topic in _TOPICS.items()
        }
        self._numbers = {key: k for k, key in enumerate(self._topics, start=1)}
        self._mcap: Any = None
        self._counts = dict.fromkeys(self._numbers.values(), 0)
        self._begin, self._end, self._counted = 2**63 - 1, 0, 0
        self._lock, self._closed = threading.Lock(), threading.Event()
        self._fault: OSError | None = None

    def __enter__(self) -> ContactBag:
        if self._path.suffix == _MCAP:
            self._part = self._path.with_name(f"{self._path.stem}.part")
            self._mcap = _library().mcap(self._part)
            self._mcap.open()
            self._connections = [
                self._mcap.add_connection(topic, kind, typestore=self._types)
                for (_, kind), topic in self._topics.items()
            ]
            return self
        self._path.mkdir()
        file = self._path / f"{self._path.name}.db3"
        self._database = sqlite3.connect(file, check_same_thread=False)
        # Waiting for the disk would delay samples. Pending samples stay in memory, so that between
        # updates the file is valid for readers that do not support journals.
        self._database.executescript(
            f"PRAGMA synchronous = OFF; PRAGMA cache_spill = OFF; {_SCHEMA}"
        )
        for (name, kind), number in self._numbers.items():
            definition, _ = self._types.generate_msgdef(kind, ros_version=2)
            digest = self._types.hash_rihs01(kind)
            topic = number, self._topics[name, kind], kind, "cdr", "[]", digest
            self._database.execute("INSERT INTO topics VALUES (?, ?, ?, ?, ?, ?)", topic)
            if number <= len(_TOPICS):
                row = number, kind, "ros2msg", definition, digest
                self._database.execute(
                    "INSERT INTO message_definitions VALUES (?, ?, ?, ?, ?)", row
                )
        self._keep()
        self._keeper = threading.Thread(target=self._keep_on, daemon=True)
        self._keeper.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._mcap is not None:
            self._mcap.close()
            (written,) = self._part.glob(f"*{_MCAP}")
            written.replace(self._path)
            shutil.rmtree(self._part)
            return
        self._closed.set()
        self._keeper.join()
        with closing(self._database):
            if self._fault is None:
                self._keep()

    def write(
        self,
        stamp: int,
        point: Array | None,
        candidates: Array,
        values: Array,
        frame: str | None = None,
        recorded: int | None = None,
        *,
        covariance: Array | None = None,
        force: Array | None = None,
        whisker: str = "",
    ) -> None:
        """Write one sample of a whisker, with the point's covariance (3, 3) and the force (3,)."""
        if self._fault is not None:
            raise self._fault
        types = self._types.types
        sec, nanosec = divmod(stamp, _SECOND)
        if not -_LARGEST_SECOND <= sec <= _LARGEST_SECOND:
            raise ValueError(f"a ROS time stamp holds 32 bits of seconds; {sec} s are too many")
        ros_time = types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
        header = types["std_msgs/msg/Header"](
            stamp=ros_time, frame_id=self.frame if frame is None else frame
        )
        at = stamp if recorded is None else recorded
        messages = {_CLOUD: self._cloud(header, candidates, values)}
        if point is not None:
            place = types["geometry_msgs/msg/Point"](*(float(x) for x in point))
            messages = {_POINT: types[_POINT](header=header, point=place), **messages}
            if covariance is not None:
                messages[_UNCERTAIN] = self._uncertain(header, place, covariance)
        if force is not None:
            vector = types["geometry_msgs/msg/Vector3"]
            pair = vector(*(float(x) for x in force)), vector(0.0, 0.0, 0.0)
            wrench = types["geometry_msgs/msg/Wrench"](*pair)
            messages[_WRENCH] = types[_WRENCH](header=header, wrench=wrench)
        rows = [
            (self._numbers[whisker, kind], at, bytes(self._types.serialize_cdr(message, kind)))
            for kind, message in messages.items()
        ]
        if self._mcap is not None:
            with _kept(self._path):
                for number, when, data in rows:
                    self._mcap.write(self._connections[number - 1], when, data)
            return
        with self._lock, _kept(self._path):
            self._database.executemany(
                "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows
            )

    def _uncertain(self, header: Any, place: Any, covariance: Array) -> Any:
        """Pose message of a contact point, with an unknown orientation."""
        types = self._types.types
        whole = _ANY_ANGLE * np.eye(6)
        whole[:3, :3] = covariance
        level = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        pose = types["geometry_msgs/msg/Pose"](place, level)
        return types[_UNCERTAIN](
            header=header, pose=types["geometry_msgs/msg/PoseWithCovariance"](pose, whole.ravel())
        )

    def _cloud(self, header: Any, candidates: Array, values: Array) -> Any:
        types = self._types.types
        table = np.column_stack([candidates, values]).astype("<f4")
        names = ("x", "y", "z", "probability")
        fields = [
            types["sensor_msgs/msg/PointField"](name, 4 * i, _FLOAT32, 1)
            for i, name in enumerate(names)
        ]
        return types[_CLOUD](
            header=header,
            height=1,
            width=len(table),
            fields=fields,
            is_bigendian=False,
            point_step=16,
            row_step=16 * len(table),
            data=np.frombuffer(table.tobytes(), dtype=np.uint8),
            is_dense=True,
        )

    def _keep_on(self) -> None:
        """Update the bag regularly, also while no samples arrive."""
        while not self._closed.wait(_KEPT_EVERY):
            try:
                self._keep()
            except OSError as fault:
                self._fault = fault
                return

    def _keep(self) -> None:
        """Write the samples since the last update, and the metadata."""
        with self._lock, _kept(self._path):
            # Messages are counted here, as an exception may interrupt `write` at any line.
            new = self._database.execute(
                "SELECT topic_id, count(*), min(timestamp), max(timestamp), max(id) FROM messages "
                "WHERE id > ? GROUP BY topic_id",
                [self._counted],
            ).fetchall()
            if self._counted and not new:
                return
            for number, count, begin, end, last in new:
                self._counts[number] += count
                self._begin, self._end = min(self._begin, begin), max(self._end, end)
                self._counted = max(self._counted, last)
            # JSON is YAML.
            text = json.dumps({"rosbag2_bagfile_information": self._metadata()}, indent=1)
            self._database.execute(
                "INSERT OR REPLACE INTO metadata VALUES (1, ?, ?)", [_METADATA_VERSION, text]
            )
            self._database.commit()
            part = self._path / "metadata.yaml.part"
            part.write_text(text, encoding="utf-8")
            part.replace(self._path / "metadata.yaml")

    def _metadata(self) -> dict[str, Any]:
        file = f"{self._path.name}.db3"
        spans = {
            "starting_time": {"nanoseconds_since_epoch": self._begin},
            "duration": {"nanoseconds": max(self._end - self._begin, 0)},
            "message_count": sum(self._counts.values()),
        }
        topics = [
            {
                "topic_metadata": {
                    "name": self._topics[name, kind],
                    "type": kind,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [],
                    "type_description_hash": self._types.hash_rihs01(kind),
                },
                "message_count": self._counts[number],
            }
            for (name, kind), number in self._numbers.items()
        ]
        return {
            "version": _METADATA_VERSION,
            "storage_identifier": "sqlite3",
            "relative_file_paths": [file],
            **spans,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": file, **spans}],
            "custom_data": None,
            "ros_distro": "rosbags",
        }


@contextmanager
def _kept(path: Path) -> Iterator[None]:
    """Convert errors of the database to an OSError that names the bag."""
    try:
        yield
    except (sqlite3.Error, OSError) as fault:
        raise OSError(f"the bag {path} cannot be written: {fault}") from fault


def _library() -> SimpleNamespace:
    """Parts of rosbags that are used here."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "bags are read and written by rosbags: pip install 'vibrissa[ros]'"
        ) from error
    mcap = partial(Writer, version=_METADATA_VERSION, storage_plugin=StoragePlugin.MCAP)
    return SimpleNamespace(reader=AnyReader, types=get_typestore(Stores.ROS2_HUMBLE), mcap=mcap)
