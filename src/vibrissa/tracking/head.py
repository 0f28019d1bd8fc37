"""How the head moves while its whiskers are filmed, and how things lie relative to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

Array = NDArray[np.float64]

_LATE = 1e-6
"""By how much of a frame a table of times may be too short."""


@dataclass(frozen=True, eq=False)
class HeadPose:
    """Where the head is and how it is turned.

    Parameters
    ----------
    position : array (time, 3)
        Origin of the head's in the laboratory frame, m.
    rotation : array (time, 3, 3)
        From the head's to the laboratory frame.
    """

    position: Array
    rotation: Array

    @classmethod
    def still(cls, count: int) -> HeadPose:
        """Make a head whose frame is that of the laboratory.

        Parameters
        ----------
        count : int
            Frames.

        Returns
        -------
        HeadPose
        """
        return cls(np.zeros((count, 3)), np.broadcast_to(np.eye(3), (count, 3, 3)))

    @classmethod
    def of(cls, table: xr.Dataset, frames: NDArray[np.int64], rate: float) -> HeadPose:
        """Find the head's pose in some frames.

        Parameters
        ----------
        table : xarray.Dataset
            Dim time or frame: ``head_position`` and ``head_rotation``, as `vibrissa.io.load_head`
            gives them, or a recording's.
        frames : array (n,)
            Frames of the first video.
        rate : float
            Frames per second.

        Returns
        -------
        HeadPose
            Frame by frame; between rows of a table over time it moves straight and turns steadily.

        Raises
        ------
        ValueError
            If the table does not tell of all frames.
        """
        place = np.asarray(table["head_position"].values, dtype=np.float64)
        turn = np.asarray(table["head_rotation"].values, dtype=np.float64)
        if "frame" in table["head_position"].dims:
            known = table["frame"].values
            rows = np.clip(np.searchsorted(known, frames), 0, len(known) - 1)
            missing = frames[known[rows] != frames]
            if missing.size:
                raise ValueError(
                    f"the head's pose is given for {len(known)} frames, {known[0]} to "
                    f"{known[-1]}; it is missing for {missing.size} frames of the video, the first "
                    f"of which is {missing[0]}"
                )
            return cls(place[rows], turn[rows])
        known, wanted = table["time"].values, frames / rate
        late = _LATE / rate
        if len(known) < 2 or wanted[0] < known[0] - late or wanted[-1] > known[-1] + late:
            raise ValueError(
                f"the head's pose is given from {known[0]:g} to {known[-1]:g} s in {len(known)} "
                f"rows; the video lasts from {wanted[0]:g} to {wanted[-1]:g} s"
            )
        at = np.clip(wanted, known[0], known[-1])
        between = np.stack([np.interp(at, known, place[:, k]) for k in range(3)], axis=1)
        return cls(between, Slerp(known, Rotation.from_matrix(turn))(at).as_matrix())

    def rows(self, frames: NDArray[np.intp]) -> HeadPose:
        """Choose frames.

        Parameters
        ----------
        frames : array (n,)
            Which.

        Returns
        -------
        HeadPose
            Of those.
        """
        return HeadPose(self.position[frames], self.rotation[frames])

    def seen_from(self, points: Array) -> Array:
        """Take points of the laboratory's frame to the head's.

        Parameters
        ----------
        points : array (time, ..., 3)
            In the laboratory's frame, m.

        Returns
        -------
        array (time, ..., 3)
            In the head's, m.
        """
        away = points - self.position.reshape(-1, *[1] * (points.ndim - 2), 3)
        return np.asarray(np.einsum("tji,t...j->t...i", self.rotation, away))

    def put_in(self, points: Array) -> Array:
        """Take points of the head's frame to the laboratory's.

        Parameters
        ----------
        points : array (time, ..., 3)
            In the head's frame, m.

        Returns
        -------
        array (time, ..., 3)
            In the laboratory's, m.
        """
        turned = np.einsum("tij,t...j->t...i", self.rotation, points)
        return np.asarray(turned + self.position.reshape(-1, *[1] * (points.ndim - 2), 3))
