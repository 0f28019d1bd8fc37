"""Low-pass filtering over time without phase shift, across missing frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.signal import butter, sosfiltfilt

Array = NDArray[np.float64]

CUTOFF = 85.0
"""The paper's cut-off, Hz."""

_ORDER = 2


def low_pass(values: ArrayLike, rate: float, cutoff: float | None = CUTOFF) -> Array:
    """Filter a signal forward and backward, so that nothing is shifted in time.

    Parameters
    ----------
    values : array_like (time, ...)
        The signal; NaN where it is missing.
    rate : float
        Frames per second.
    cutoff : float, optional
        Frequency at which half of the power of a wave is left by each of both passes, Hz; None
        filters nothing.

    Returns
    -------
    array (time, ...)
        The filtered signal, missing where it was missing. Gaps are bridged by straight lines for
        the filter only.

    Raises
    ------
    ValueError
        If the cut-off is not below half the rate.
    """
    array = np.array(values, dtype=np.float64)
    if cutoff is None:
        return array
    if not 0.0 < cutoff < 0.5 * rate:
        raise ValueError(
            f"cutoff is {cutoff!r} Hz; it must be positive and below half of {rate} frames/s"
        )
    flat = array.reshape(len(array), -1)
    known = np.isfinite(flat)
    sections = butter(_ORDER, cutoff, fs=rate, output="sos")
    pad = min(len(flat) - 1, round(3.0 * rate / cutoff))
    frames = np.arange(len(flat))
    for k in range(flat.shape[1]):
        if known[:, k].sum() < 2:
            continue
        whole = np.interp(frames, frames[known[:, k]], flat[known[:, k], k])
        filtered = sosfiltfilt(sections, whole, padlen=pad)
        flat[:, k] = np.where(known[:, k], filtered, np.nan)
    return flat.reshape(array.shape)
