"""How all whiskers of a face move: each about its own rest pose, on a head that moves.

Every whisker protracts by the same angle, forward on both sides, about the pose in which it rests
on the face (`vibrissa.whisker.array`); elevation and roll follow by the ratios of its row (Knutsen,
Biess & Ahissar 2008). The two sides are mirror images of each other. The face is no obstacle:
neither whiskers nor objects are kept out of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.simulation.motion import ELEVATION_PER_AZIMUTH, ROLL_PER_AZIMUTH, Motion, whisking
from vibrissa.whisker.array import WhiskerArray
from vibrissa.whisker.emergence import angles_of, base_rotation, mirrored

Array = NDArray[np.float64]


def array_whisking(
    array: WhiskerArray,
    duration: float = 0.5,
    rate: float = 1000.0,
    *,
    head_rotation: ArrayLike | None = None,
    head_position: ArrayLike | None = None,
    **motion: Any,
) -> dict[str, Motion]:
    """Whisk with all whiskers.

    Parameters
    ----------
    array : WhiskerArray
        On the face.
    duration : float
        Of the trial, s.
    rate : float
        Frames per second.
    head_rotation : array_like (n, 3, 3) or (3, 3), optional
        From the head's to the laboratory frame; by default they are the same.
    head_position : array_like (n, 3) or (3,), optional
        The snout in the laboratory, m; by default its origin.
    **motion
        What else `shared_whisking` takes: frequency, amplitude, set point, …

    Returns
    -------
    dict of str to Motion
        By the whiskers' names, n frames each.

    Raises
    ------
    ValueError
        As `whisking` and `Motion.on_head` do.

    Examples
    --------
    >>> from vibrissa import whisker_array
    >>> sorted(array_whisking(whisker_array("left", rows="C", columns=[1, 2]), duration=0.1))
    ['LC1', 'LC2']
    """
    common = shared_whisking(duration, rate, **motion)
    return protracted(array, common, head_rotation, head_position)


def shared_whisking(
    duration: float = 0.5,
    rate: float = 1000.0,
    *,
    frequency: float = 8.0,
    amplitude: float = np.radians(25.0),
    set_point: float = np.radians(25.0),
    position_drift: float = 0.0,
    **motion: Any,
) -> Motion:
    """Whisk about rest, in the way that all whiskers of an array share.

    Parameters
    ----------
    duration : float
        Of the trial, s.
    rate : float
        Frames per second.
    frequency : float
        Whisks per second.
    amplitude : float
        Half of the sweep, rad; 0 holds the whiskers still, but for drifts.
    set_point : float
        How far forward of the pose of rest the middle of the sweep lies, rad.
    position_drift : float
        Largest drift of the bases on the face, m.
    **motion
        What else `whisking` takes, but for ``row`` and the ratios, which are those of each row.

    Returns
    -------
    Motion
        Its azimuth is the protraction from rest; for `protracted`.

    Raises
    ------
    ValueError
        As `whisking` does.
    """
    return whisking(
        duration,
        rate,
        frequency=frequency,
        amplitude=amplitude,
        set_point=set_point,
        position_drift=position_drift,
        elevation_per_azimuth=0.0,
        roll_per_azimuth=0.0,
        **motion,
    )


def protracted(
    array: WhiskerArray,
    motion: Motion,
    head_rotation: ArrayLike | None = None,
    head_position: ArrayLike | None = None,
) -> dict[str, Motion]:
    """Let one motion be that of all whiskers, each from its own pose of rest.

    Parameters
    ----------
    array : WhiskerArray
        On the face.
    motion : Motion
        Its azimuth is the angle by which whiskers are protracted from rest, to which each row's
        elevation and roll are added; its own elevation, roll and displacement (of the right side,
        mirrored on the left one) come on top.
    head_rotation : array_like (n, 3, 3) or (3, 3), optional
        From the head's to the laboratory frame; by default they are the same.
    head_position : array_like (n, 3) or (3,), optional
        The snout in the laboratory, m; by default its origin.

    Returns
    -------
    dict of str to Motion
        By the whiskers' names.

    Raises
    ------
    ValueError
        As `Motion.on_head` does.
    """
    turn = np.eye(3) if head_rotation is None else head_rotation
    shift = np.zeros(3) if head_position is None else head_position
    flat = np.array([-1.0, 1.0, 1.0])
    moves = {}
    for name, whisker in array.items():
        identity = array.identity(name)
        left = identity.side == "left"
        rest = angles_of(whisker.pose.rotation)
        # On the left the angles of the mirror image count, and are mirrored back in the end.
        azimuth, elevation, roll = mirrored(rest) if left else rest
        angles = np.stack(
            [
                azimuth + motion.azimuth,
                elevation + ELEVATION_PER_AZIMUTH[identity.row] * motion.azimuth + motion.elevation,
                roll + ROLL_PER_AZIMUTH[identity.row] * motion.azimuth + motion.roll,
            ],
            axis=-1,
        )
        azimuth, elevation, roll = (mirrored(angles) if left else angles).T
        place = whisker.pose.origin + motion.base_position * (flat if left else 1.0)
        moves[name] = Motion(motion.time, azimuth, elevation, roll, place).on_head(turn, shift)
    return moves


def head_path(
    time: ArrayLike,
    position: ArrayLike = (0.0, 0.0, 0.0),
    angles: ArrayLike = (0.0, 0.0, 0.0),
    *,
    to_position: ArrayLike | None = None,
    to_angles: ArrayLike | None = None,
) -> tuple[Array, Array]:
    """Move a head from one pose to another, smoothly, beginning and ending at rest.

    Parameters
    ----------
    time : array_like (n,)
        Of the frames, s.
    position : array_like (3,)
        Of the snout in the beginning, laboratory frame, m.
    angles : array_like (3,)
        Of the head in the beginning, rad: azimuth turns it to its left, elevation raises its right
        side, roll raises its snout (`base_rotation`).
    to_position, to_angles : array_like (3,), optional
        The same in the end; by default as in the beginning.

    Returns
    -------
    tuple of array (n, 3, 3) and array (n, 3)
        Rotations from the head's to the laboratory frame, and places of the snout, m.
    """
    t = np.asarray(time, dtype=np.float64)
    share = (t - t[0]) / (t[-1] - t[0])
    # The path of least jerk.
    share = (share**3 * (10.0 - 15.0 * share + 6.0 * share**2))[:, None]
    ends = [(position, to_position), (angles, to_angles)]
    place, turned = (
        np.asarray(a) + share * (np.asarray(a if b is None else b) - np.asarray(a)) for a, b in ends
    )
    return base_rotation(*turned.T), place
