"""Which of several candidates: the one that goes on from the frames around."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def continuing_candidates(candidates: ArrayLike, frames: ArrayLike) -> NDArray[np.int64]:
    """Choose one candidate for each contact by where its neighbours in time are.

    While a whisker stays in touch its contact point moves little from frame to frame, least of all
    in the laboratory. So where signals have several explanations, the one nearest to the contact of
    the nearest frame with a single one is taken, within the same unbroken run of frames.

    Parameters
    ----------
    candidates : array_like (n, k, 3)
        Points, m, laboratory frame; the more plausible first, padded with NaN.
    frames : array_like (n,) of int
        Numbers of the frames, rising.

    Returns
    -------
    array (n,) of int
        Which candidate: the first where a run has no frame with a single one; -1 where there is
        none.

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
