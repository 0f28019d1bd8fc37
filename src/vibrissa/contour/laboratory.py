"""Contact points in the laboratory, x_lab = R x_whisker + o, and which of several candidates."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.numerics import Array


def to_laboratory(points: ArrayLike, base_rotation: ArrayLike, base_position: ArrayLike) -> Array:
    """Transform points from the whisker's to the laboratory frame."""
    p = np.asarray(points, dtype=np.float64)
    turned = np.einsum("...ij,...j->...i", np.asarray(base_rotation, dtype=np.float64), p)
    return np.asarray(turned + np.asarray(base_position, dtype=np.float64))


def covariance_to_laboratory(covariance: ArrayLike, base_rotation: ArrayLike) -> Array:
    """Transform covariances of points from the whisker's to the laboratory frame."""
    rotation = np.asarray(base_rotation, dtype=np.float64)
    turned = rotation @ np.asarray(covariance, dtype=np.float64) @ np.swapaxes(rotation, -1, -2)
    return np.asarray(turned, dtype=np.float64)


def continuing_candidates(candidates: ArrayLike, frames: ArrayLike) -> NDArray[np.int64]:
    """Choose one candidate for each contact by its neighbours in time.

    During a contact its point moves little from frame to frame, least of all in the laboratory. So
    where signals have several explanations, the one nearest to the contact of the nearest frame
    with a single one is chosen, within the same unbroken run of frames.

    Parameters
    ----------
    candidates : array_like (n, k, 3)
        Candidate points, m, laboratory frame; the more plausible first, padded with NaN.
    frames : array_like (n,) of int
        Numbers of the frames, rising.

    Returns
    -------
    array (n,) of int
        Number of the candidate: the first where a run has no frame with a single one; -1 where
        there is none.

    Raises
    ------
    ValueError
        If shapes do not fit.

    Examples
    --------
    >>> near, far = [0.0, 0.0, 0.0], [9.0, 0.0, 0.0]
    >>> nothing = [np.nan] * 3
    >>> continuing_candidates([[near, nothing], [far, near]], [4, 5]).tolist()
    [0, 1]
    """
    points = np.asarray(candidates, dtype=np.float64)
    number = np.asarray(frames)
    if points.ndim != 3 or points.shape[2] != 3 or number.shape != points.shape[:1]:
        raise ValueError(
            f"candidates have shape {points.shape} and frames {number.shape}; (n, k, 3) and (n,) "
            "are needed"
        )
    count = np.isfinite(points).all(axis=2).sum(axis=1)
    chosen = np.where(count > 0, 0, -1)
    run = np.cumsum(np.diff(number, prepend=number[:1]) > 1)
    for row in np.flatnonzero(count > 1):
        single = np.flatnonzero((count == 1) & (run == run[row]))
        if single.size:
            nearest = single[np.argmin(np.abs(number[single] - number[row]))]
            away = np.linalg.norm(points[row] - points[nearest, 0], axis=1)
            chosen[row] = np.nanargmin(away)
    return chosen
