"""The pose of the base at the time of each sample, from poses that come at another rate."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import transform
from vibrissa.numerics import Array

# A motion is continued past the last pose for so many times the step between the last two.
_LONGEST = 5.0
# Nothing that holds a whisker is as fast, m/s.
_TOO_FAST = 50.0


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
        self._turn = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
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
