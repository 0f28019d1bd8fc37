"""Parsing of lines of signals, CSV with a header or one JSON object per line, and poses over time.

Both formats contain named numbers in SI units. The header of a table may state other units for
signals (:mod:`vibrissa.io.table`), and cells may be separated by semicolons, tabs or blanks. Lines
may also contain the pose of the base: ``base_x``, ``base_y`` and ``base_z`` (m, laboratory frame),
and a unit quaternion ``base_qw``, ``base_qx``, ``base_qy``, ``base_qz`` from the whisker frame to
the laboratory frame; and the readings of an accelerometer there, ``imu_ax``, ``imu_ay``, ``imu_az``
(m/s², 9.81 upward at rest), in the axes of the poses. A JSON object may contain a pose and its time
only. Fields of ROS are passed on unchanged: ``stamp_ns`` and ``recorded_ns`` (whole numbers) and
``frame_id``.

Rows refer to the last header, or to it and to a line of units that follows it. After an invalid
header, rows are errors until the next header.

Poses of the base may arrive at another rate and are interpolated to the time of each sample.
"""

from __future__ import annotations

import csv
import json
import math
from collections import deque
from collections.abc import Mapping, Sequence
from enum import Enum, auto
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import transform
from vibrissa.io import (
    cells_of,
    check_one_column_each,
    delimiter_of,
    is_number,
    number,
    signal_column,
    signal_columns,
    with_point,
)
from vibrissa.numerics import Array, rotation_matrices
from vibrissa.sensors import COMPONENTS
from vibrissa.signals import SIGNALS

POSITION = ("base_x", "base_y", "base_z")  # columns with the position of the base
QUATERNION = ("base_qw", "base_qx", "base_qy", "base_qz")  # columns with its orientation
ACCELERATION = ("imu_ax", "imu_ay", "imu_az")  # columns with the reading of an accelerometer
_SHARED = (*POSITION, *QUATERNION, *ACCELERATION)

STAMP = "stamp_ns"  # column with the time stamp of ROS, ns
RECORDED = "recorded_ns"  # column with the time at which ROS recorded it, ns
FRAME = "frame_id"  # column with the name of the frame that ROS gives it
LONGEST = 65536  # largest number of characters of a line, which exceeds the size of a datagram
# Columns for which a header may use other names or units.
_SIGNALS = ("time", *COMPONENTS, *SIGNALS)
_UNIT = 0.01  # largest deviation of a rounded quaternion from unit length
_LATEST = 1e11  # largest plausible time since any epoch, s
_FARTHEST = 1e9  # largest plausible coordinate of a base, m
_SEPARATORS = frozenset({"sep=,", "sep=;", "sep=\t", "sep="})
_DIGITS = frozenset("0123456789+-.")  # characters with which a number in a table may begin


class LineKind(Enum):
    """Kind of a line, by its first characters."""

    SAMPLE = auto()
    POSE = auto()
    OTHER = auto()


class Sample(NamedTuple):
    """Contents of one line: its number from 1, the named values, and the pose of the base, if any.

    If there are several choices of names, the values are those of the first that the line has. An
    empty pose or acceleration is NaN. ``stamp_ns``, ``recorded_ns`` and ``frame_id`` are passed on
    unchanged.
    """

    line: int
    time: float | None
    names: tuple[str, ...]
    values: Array
    rotation: Array | None
    position: Array | None
    passed: Mapping[str, Any] = MappingProxyType({})
    acceleration: Array | None = None


class Lines:
    """Parser of lines of CSV or JSON; of several choices of names, the first that a line has.

    ``raw`` names are those of a sensor's channels, which must match exactly and have no units. For
    a named ``whisker``, values are named ``name.value``, and lines with only those of others are
    ignored.
    """

    def __init__(self, *names: tuple[str, ...], raw: bool = False, whisker: str = "") -> None:
        self.names, self.raw = names, raw
        self._prefix = f"{whisker}." if whisker else ""
        self.number, self.headers = 0, 0
        self._header: list[str] | None = None
        self._heading: list[str] = []  # cells of a header that no line has followed yet
        self._delimiter = ","
        self._factors: dict[str, float] = {}
        self._refused = 0

    def __call__(self, line: str) -> Sample | None:
        """Parse one line; None for a header or a line of other whiskers."""
        self.number += 1
        if len(line) > LONGEST:
            raise ValueError(f"a line of more than {LONGEST} characters")
        text = line.strip().lstrip("\ufeff")
        # Spreadsheets state the separator in a line of its own.
        if not text or text.startswith("#") or text.lower() in _SEPARATORS:
            return None
        known = self._object(text) if text.startswith("{") else self._row(text)
        if known is None or (self._prefix and self._of_others(known)):
            return None
        return self._sample(known)

    def _of_others(self, known: Mapping[str, object]) -> bool:
        """Whether a line has only values of other whiskers."""
        wanted = {*_SHARED, *(name for names in self.names for name in names)}
        return any("." in name for name in known) and not wanted & set(known)

    def _own(self, name: str) -> str:
        """Name of a value without the name of the whisker."""
        return name.removeprefix(self._prefix) if self._prefix else name

    def kind(self, line: str) -> LineKind:
        """Kind of a line, without parsing it."""
        text = line.lstrip()
        if not text.startswith("{"):
            return LineKind.SAMPLE if text[:1] in _DIGITS else LineKind.OTHER
        if any(f'"{self._prefix}{name}"' in text for names in self.names for name in names):
            return LineKind.SAMPLE
        return LineKind.POSE if f'"{QUATERNION[0]}"' in text else LineKind.OTHER

    def _chosen(self, what: str, there: list[str]) -> tuple[str, ...]:
        for names in self.names:
            if set(names) <= set(there):
                return names
        choices = "; or ".join(
            ", ".join(name for name in names if name not in there) for names in self.names
        )
        raise ValueError(f"{what} lacks {choices} (it has {', '.join(there)})")

    def _object(self, text: str) -> dict[str, object]:
        try:
            known = json.loads(text)
        except (json.JSONDecodeError, RecursionError) as error:
            raise ValueError(f"not JSON: {error}") from None
        return {self._own(str(name)): value for name, value in known.items()}

    def _row(self, text: str) -> dict[str, object] | None:
        try:
            cells = cells_of(text, delimiter_of(text) if self._header is None else self._delimiter)
        except csv.Error as error:
            raise ValueError(f"no CSV: {error}") from None
        # An empty first cell is either an index without a name, or a missing number.
        named = self._header is None if cells[0] == "" else not is_number(cells[0])
        heading, self._heading = self._heading, []
        if named and (self._units(heading, cells) or self._heads(text)):
            return None
        if self._header is None:
            refused = f": that of line {self._refused} was refused" if self._refused else ""
            raise ValueError(f"a row without a header that names its columns{refused}")
        if len(cells) > len(self._header) and not any(cells[len(self._header) :]):
            cells = cells[: len(self._header)]
        if "time" in self._header and not any(cells):  # as spreadsheets end tables
            return None
        if len(cells) != len(self._header):
            raise ValueError(f"{len(cells)} cells; the header has {len(self._header)}")
        if self._delimiter != "," and not any("." in cell for cell in cells):
            cells = [with_point(cell) for cell in cells]
        known: dict[str, object] = dict(zip(self._header, cells, strict=True))
        for name, factor in self._factors.items():
            known[name] = factor * _number(name, known[name])
        return known

    def _heads(self, text: str) -> bool:
        """Whether a line is a header, which is then used; raise ValueError if it is not valid."""
        delimiter = delimiter_of(text)
        cells = cells_of(text, delimiter)
        names, factors = self._named(cells)
        fits = any(set(choice) <= set(names) for choice in self.names)
        if not fits and self._header is not None and not self._like_header(cells):
            return False
        self._header, self._refused = None, self.number
        lacks = "the header"
        if self.raw:
            lacks = "the header (channels are called as the sensor's are, without units)"
        self._chosen(lacks, names)
        used = {name for choice in self.names for name in choice} | {"time", *_SHARED}
        twice = {cell for cell, name in zip(cells, names, strict=True) if name in used}
        if twice := {cell for cell in twice if cells.count(cell) > 1}:
            raise ValueError(f"{lacks} has {', '.join(sorted(twice))} more than once")
        if not self.raw:
            check_one_column_each(cells, [name for name in _SIGNALS if name in used])
        self._header, self._factors, self._delimiter = names, factors, delimiter
        self._refused, self._heading = 0, [] if self.raw else cells_of(text, delimiter)
        self.headers += 1
        return True

    def _units(self, heading: list[str], units: list[str]) -> bool:
        """Whether a line states the units of the columns of a header, which are then used."""
        if len(heading) != len(units) or any(is_number(unit) for unit in units if unit):
            return False
        cells = [f"{name} ({unit})" for name, unit in zip(heading, units, strict=True)]
        strange = signal_columns([self._own(cell) for cell in cells], _SIGNALS)[1]
        names, factors = self._named(cells)
        if strange or not any(set(choice) <= set(names) for choice in self.names):
            return False
        self._header, self._factors = names, factors
        return True

    def _like_header(self, cells: list[str]) -> bool:
        """Whether an invalid header is a header at all, rather than noise on a serial line."""
        if len(cells) < 2 or not all(cell[:1].isalpha() and not is_number(cell) for cell in cells):
            return False
        wanted = {"time", *_SHARED, *(name for names in self.names for name in names)}
        return len(cells) == len(self._header or ()) or any(
            cell in wanted or signal_column(cell)[0] for cell in cells
        )

    def _named(self, cells: list[str]) -> tuple[list[str], dict[str, float]]:
        """Canonical names of columns, and the factors to SI units."""
        names = cells = [self._own(cell) for cell in cells]
        found, _ = signal_columns(cells, _SIGNALS)
        factors = {}
        for name, (place, factor) in found.items():
            if self.raw and name != "time":
                # Only the sensor states units; a header may call a component otherwise.
                if name in names or cells[place].rstrip()[-1:].lower() not in "xyz":
                    continue
                factor = 1.0
            names[place] = name
            if factor != 1.0:
                factors[name] = factor
        return names, factors

    def _sample(self, known: dict[str, object]) -> Sample:
        timed = "time" in known or STAMP in known
        alone = (timed and {*POSITION, *QUATERNION} <= set(known)) and not any(
            name in known for names in self.names for name in names
        )
        names = () if alone else self._chosen("it", list(known))
        passed = _passed(known)
        time = passed[STAMP] / 1e9 if STAMP in passed else None
        if "time" in known:
            time = _number("time", known["time"])
        if time is not None and not math.isfinite(time):
            raise ValueError(f"time is {known['time']!r}; a finite number is needed, s")
        if time is not None and abs(time) > _LATEST:
            raise ValueError(
                f"time is {known['time']}, more than any date in seconds: it seems to be in ms, µs "
                "or ns"
            )
        values = np.array([_number(name, known[name]) for name in names])
        rotation = position = acceleration = None
        if set(ACCELERATION) <= set(known):
            acceleration = np.array([_number(name, known[name]) for name in ACCELERATION])
        if set(POSITION) <= set(known):
            position = np.array([_number(name, known[name]) for name in POSITION])
            if (np.abs(position) > _FARTHEST).any():
                raise ValueError(f"the base is at {position.tolist()}; its position is in m")
        if set(QUATERNION) <= set(known):
            rotation = rotation_of([_number(name, known[name]) for name in QUATERNION])
        return Sample(self.number, time, names, values, rotation, position, passed, acceleration)


def _passed(known: Mapping[str, object]) -> dict[str, Any]:
    """Values that are passed on unchanged."""
    out: dict[str, Any] = {}
    for name in (STAMP, RECORDED):
        if known.get(name) in (None, ""):
            continue
        try:
            # Not converted by a float, which would lose digits.
            out[name] = int(str(known[name]))
        except ValueError:
            out[name] = None
        if out[name] is None or abs(out[name]) >= 2**63:
            raise ValueError(f"{name} is {known[name]!r}; a whole number of ns is needed")
    if isinstance(frame := known.get(FRAME), str):
        out[FRAME] = frame
    return out


def _number(name: str, value: object) -> float:
    """Number in a cell; empty and null are missing."""
    if value is None or value == "":
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(f"{name} is {value!r}, which is not a number")
    try:
        return number(value) if isinstance(value, str) else float(value)
    except OverflowError:
        raise ValueError(f"{name} is larger than any number that can be used") from None
    except ValueError:
        raise ValueError(f"{name} is {value!r}, which is not a number") from None


def rotation_of(quaternion: Sequence[float]) -> Array:
    """Rotation matrix of a quaternion."""
    q = np.array(quaternion)
    size = math.hypot(*quaternion)
    if not math.isfinite(size):
        return np.full((3, 3), np.nan)
    if abs(size - 1.0) > _UNIT:
        raise ValueError(f"the quaternion {q.tolist()} is of length {size:.4g}, not 1")
    w, x, y, z = (q / size).tolist()
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


# Largest extrapolation beyond the last pose, in units of the interval between the last two.
_LONGEST = 5.0
_TOO_FAST = 20.0  # implausible speed of a base, m/s


class Pose(NamedTuple):
    """Pose of the whisker's base.

    Attributes
    ----------
    rotation : (3, 3) array
        Rotation from the whisker frame to the laboratory frame.
    position : (3,) array
        Position of the base in the laboratory frame, m.
    """

    rotation: Array
    position: Array


class Poses:
    """Interpolation and extrapolation of incoming poses at constant velocity.

    Parameters
    ----------
    rotation : (3, 3) array_like, optional
        Rotation from the whisker frame to the frame of its carrier, if poses are those of a
        carrier, such as the flange of a robot.
    position : (3,) array_like, optional
        Position of the whisker's base in the carrier's frame, m.

    Attributes
    ----------
    number : int
        Number of poses so far.
    too_fast : int
        Number of poses at a speed of more than 20 m/s, which suggests wrong units.
    """

    def __init__(
        self, rotation: ArrayLike | None = None, position: ArrayLike | None = None
    ) -> None:
        self._turn = np.eye(3) if rotation is None else rotation_matrices("rotation", rotation)
        self._place = np.zeros(3) if position is None else np.asarray(position, dtype=np.float64)
        if self._turn.shape != (3, 3) or self._place.shape != (3,):
            raise ValueError(
                f"a pose is (3, 3) and (3,); got {self._turn.shape} and {self._place.shape}"
            )
        self._last: deque[tuple[float, Pose]] = deque(maxlen=2)
        self.number, self.too_fast = 0, 0

    def forget(self) -> None:
        """Discard all poses."""
        self._last.clear()

    def in_base(self, vector: Array) -> Array:
        """Rotate a vector from the carrier's frame to the whisker frame.

        Parameters
        ----------
        vector : (3,) array
            Vector, in any unit.

        Returns
        -------
        (3,) array
            Vector in the whisker frame.
        """
        return np.asarray(vector @ self._turn)

    def _base(self, rotation: Array, position: Array) -> Pose:
        """Pose of the base from that of the carrier."""
        return Pose(rotation @ self._turn, position + rotation @ self._place)

    def put(self, time: float, rotation: Array, position: Array) -> Pose:
        """Add a pose; it is not stored if it is not finite or not later than the last.

        Parameters
        ----------
        time : float
            Time of the pose, s, by the clock of the samples.
        rotation : (3, 3) array
            Rotation from the carrier's frame to the laboratory frame.
        position : (3,) array
            Position of the carrier in the laboratory frame, m.

        Returns
        -------
        Pose
            Pose of the base.
        """
        base = self._base(rotation, position)
        if not (np.isfinite(rotation).all() and np.isfinite(position).all()):
            return base
        if self._last:
            before, old = self._last[-1]
            if time <= before:
                return base
            moved = float(np.linalg.norm(position - old.position))
            self.too_fast += moved > _TOO_FAST * (time - before)
        self._last.append((time, Pose(rotation, position)))
        self.number += 1
        return base

    def at(self, time: float) -> Pose | None:
        """Pose of the base at a time.

        Parameters
        ----------
        time : float
            Time of a sample, s.

        Returns
        -------
        Pose or None
            Pose of the base; None before the first pose. A single pose holds at all times. Beyond
            the last of several poses, the motion is extrapolated for five times the interval
            between the last two; after that the pose is unknown (NaN).
        """
        if not self._last:
            return None
        if len(self._last) == 1:
            return self._base(*self._last[0][1])
        (t0, first), (t1, second) = self._last
        share = (time - t0) / (t1 - t0)
        if not -_LONGEST <= share <= 1.0 + _LONGEST:
            return Pose(np.full((3, 3), np.nan), np.full(3, np.nan))
        turn = transform.Rotation.from_matrix(first.rotation.T @ second.rotation).as_rotvec()
        rotation = first.rotation @ transform.Rotation.from_rotvec(share * turn).as_matrix()
        return self._base(rotation, first.position + share * (second.position - first.position))
