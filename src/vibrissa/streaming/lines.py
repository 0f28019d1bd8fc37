"""Lines of signals: CSV with a header, or one JSON object a line.

Both carry numbers by name, in SI units; signals of a table may be in others if its header states
them (:mod:`vibrissa.io.table`), and its cells may be separated by semicolons, tabs or blanks. The
pose of the base may be added: ``base_x``, ``base_y`` and ``base_z`` (m, laboratory), and a unit
quaternion ``base_qw``, ``base_qx``, ``base_qy``, ``base_qz`` that turns the whisker's into the
laboratory frame; and what an accelerometer reads there, ``imu_ax``, ``imu_ay``, ``imu_az`` (m/s²,
9.81 upward at rest), in the axes that poses are of. A JSON object may hold a pose and its time
alone. Fields that ROS adds are passed on unchanged: ``stamp_ns`` and ``recorded_ns`` (whole
numbers) and ``frame_id``.

Rows are read by the last header. So after a header that is refused no row is read until there is
another one.

Poses of the base may come at another rate: they are interpolated to the time of each sample.
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
from vibrissa.signals import SIGNALS

POSITION = ("base_x", "base_y", "base_z")  # columns with the position of the base
QUATERNION = ("base_qw", "base_qx", "base_qy", "base_qz")  # columns with its orientation
ACCELERATION = ("imu_ax", "imu_ay", "imu_az")  # columns with the reading of an accelerometer
_SHARED = (*POSITION, *QUATERNION, *ACCELERATION)

STAMP = "stamp_ns"  # column with the time stamp of ROS, ns
RECORDED = "recorded_ns"  # column with the time at which ROS recorded it, ns
FRAME = "frame_id"  # column with the name of the frame that ROS gives it
LONGEST = 65536  # characters that a line may have; a datagram holds no more
# What a header may call otherwise, or give in other units.
_SIGNALS = ("time", "Fx", "Fy", "Fz", "Mx", "My", "Mz", *SIGNALS)
_UNIT = 0.01  # a quaternion that was rounded is no longer of unit length by this much
_LATEST = 1e11  # seconds since any epoch are fewer; what is more is in a smaller unit
_FARTHEST = 1e9  # largest distance of a base, m; infinite ones are not numbers either
_DIGITS = frozenset("0123456789+-.")  # characters that a number in a table may begin with


class LineKind(Enum):
    """Kind of a line, by its first characters."""

    SAMPLE = auto()
    POSE = auto()
    OTHER = auto()


class Sample(NamedTuple):
    """One line: its number from 1, the named values, and the pose of the base, where it is there.

    Of several choices of names that were asked for, those that the line has; a pose that the line
    leaves empty is NaN, as is an acceleration. Passed on as they are: ``stamp_ns``, ``recorded_ns``
    and ``frame_id``.
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
    """Takes lines apart; the first one that is not JSON is a header, others may follow.

    Of several choices of names the first that a line has counts. Raw names are a sensor's channels,
    which are called as they are and have no units; channels that are Fx to Mz may also have the
    other names of these, such as ``wrench.force.x``. With the name of a whisker its own values are
    called ``name.value``, and lines that have only others' are passed over.
    """

    def __init__(self, *names: tuple[str, ...], raw: bool = False, whisker: str = "") -> None:
        self.names, self.raw = names, raw
        self._prefix = f"{whisker}." if whisker else ""
        self.number, self.headers = 0, 0
        self._header: list[str] | None = None
        self._delimiter = ","
        self._factors: dict[str, float] = {}
        self._refused = 0

    def __call__(self, line: str) -> Sample | None:
        """Read one line."""
        self.number += 1
        if len(line) > LONGEST:
            raise ValueError(f"a line of more than {LONGEST} characters")
        text = line.strip().lstrip("\ufeff")
        if not text or text.startswith("#"):
            return None
        known = self._object(text) if text.startswith("{") else self._row(text)
        if known is None or (self._prefix and self._of_others(known)):
            return None
        return self._sample(known)

    def _of_others(self, known: Mapping[str, object]) -> bool:
        """Whether a line has named values, and none that this whisker shares or owns."""
        wanted = {*_SHARED, *(name for names in self.names for name in names)}
        return any("." in name for name in known) and not wanted & set(known)

    def _own(self, name: str) -> str:
        """Name of a value without the whisker's."""
        return name.removeprefix(self._prefix) if self._prefix else name

    def kind(self, line: str) -> LineKind:
        """Tell what a line is without taking it apart."""
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
        # A first cell that is empty is an index without a name, or a number that is missing.
        named = self._header is None if cells[0] == "" else not is_number(cells[0])
        if named and self._heads(text):
            return None
        if self._header is None:
            refused = f": that of line {self._refused} was refused" if self._refused else ""
            raise ValueError(f"a row without a header that names its columns{refused}")
        if len(cells) > len(self._header) and not any(cells[len(self._header) :]):
            cells = cells[: len(self._header)]
        if len(cells) != len(self._header):
            raise ValueError(f"{len(cells)} cells; the header has {len(self._header)}")
        if self._delimiter != "," and not any("." in cell for cell in cells):
            cells = [with_point(cell) for cell in cells]
        known: dict[str, object] = dict(zip(self._header, cells, strict=True))
        for name, factor in self._factors.items():
            known[name] = factor * _number(name, known[name])
        return known

    def _heads(self, text: str) -> bool:
        """Take a line as the header if it is one.

        A ValueError if it is a header that cannot be used; rows are then not read.
        """
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
        self._refused = 0
        self.headers += 1
        return True

    def _like_header(self, cells: list[str]) -> bool:
        """Whether a line that cannot be used as a header is one, and not noise on a serial line."""
        if len(cells) < 2 or not all(cell[:1].isalpha() and not is_number(cell) for cell in cells):
            return False
        wanted = {"time", *_SHARED, *(name for names in self.names for name in names)}
        return len(cells) == len(self._header or ()) or any(
            cell in wanted or signal_column(cell)[0] for cell in cells
        )

    def _named(self, cells: list[str]) -> tuple[list[str], dict[str, float]]:
        """Names of columns as they are used here, and what makes their numbers SI."""
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
    """Values that are passed on as they are."""
    out: dict[str, Any] = {}
    for name in (STAMP, RECORDED):
        if known.get(name) in (None, ""):
            continue
        try:
            # Never by way of a float, which has not as many digits.
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
    """Return the rotation matrix of a quaternion."""
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


# A motion is continued past the last pose for so many times the step between the last two.
_LONGEST = 5.0
_TOO_FAST = 50.0  # nothing that holds a whisker is as fast, m/s


class Pose(NamedTuple):
    """Pose of the whisker's base.

    Attributes
    ----------
    rotation : (3, 3) array
        Rotation from the whisker's to the laboratory frame.
    position : (3,) array
        Position of the base in the laboratory, m.
    """

    rotation: Array
    position: Array


class Poses:
    """Poses as they come; between the last two, and past them, they change evenly.

    Parameters
    ----------
    rotation : (3, 3) array_like, optional
        Rotation from the whisker's frame to that of what carries it, where poses are those of a
        carrier such as a robot's flange.
    position : (3,) array_like, optional
        Position of the whisker's base in the carrier's frame, m.

    Attributes
    ----------
    number : int
        Number of poses so far.
    too_fast : int
        Number of poses at a speed of more than 50 m/s, which are in other units.
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
        """Begin anew."""
        self._last.clear()

    def in_base(self, vector: Array) -> Array:
        """Turn a vector of the carrier's axes into the whisker's frame.

        Parameters
        ----------
        vector : (3,) array
            Vector, of any unit.

        Returns
        -------
        (3,) array
            The same in the whisker's frame.
        """
        return np.asarray(vector @ self._turn)

    def _base(self, rotation: Array, position: Array) -> Pose:
        """Pose of the base from that of what carries it."""
        return Pose(rotation @ self._turn, position + rotation @ self._place)

    def put(self, time: float, rotation: Array, position: Array) -> Pose:
        """Take a pose; one that is not finite or not later than the last is not remembered.

        Parameters
        ----------
        time : float
            Time of the pose, s, by the clock of the samples.
        rotation : (3, 3) array
            Rotation from the carrier's to the laboratory frame.
        position : (3,) array
            Position of the carrier in the laboratory, m.

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
            Pose of the base; None before the first. One alone holds at all times; past the last of
            several the motion continues for five times the step between the last two, and then it
            is not known (NaN).
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
