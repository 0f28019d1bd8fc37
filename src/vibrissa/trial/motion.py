"""How the base of a whisker moves: whisking, given in closed form.

The laboratory frame has z up; the base sits near its origin, the whisker points along x (away from
the head) at azimuth 0, and protraction, which raises the azimuth, moves it toward y (forward):

    x_lab = R x_whisker + o,    R = R_z(azimuth) R_y(−elevation) R_x(roll)

so that the base tangent is (cos el cos az, cos el sin az, sin el). At zero angles the whisker's
intrinsic curvature bends its tip forward; pushed against something in front of it the whisker is
concave forward, and against something behind it concave backward.

Elevation and roll follow the azimuth by a fixed ratio (Knutsen, Biess & Ahissar 2008), row by row
of the mystacial array; on top come slow drifts of set point, amplitude, elevation and position,
sums of three sinusoids with random phases. All is smooth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

ELEVATION_PER_AZIMUTH: Mapping[str, float] = MappingProxyType(
    {"A": 0.12, "B": 0.30, "C": 0.30, "D": 0.14, "E": 0.02}
)
"""Elevation gained per azimuth by row (Knutsen et al. 2008)."""

ROLL_PER_AZIMUTH: Mapping[str, float] = MappingProxyType(
    {"A": -0.76, "B": -0.25, "C": 0.22, "D": 0.43, "E": 0.73}
)
"""Roll about the base tangent per azimuth by row (Knutsen et al. 2008)."""

_DRIFT = np.array([0.31, 0.57, 0.93])
"""Frequencies of the slow drifts, Hz: their common period is far longer than a trial."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Where the base is over time.

    Parameters
    ----------
    time : array (n,)
        Of the frames, s, rising.
    azimuth, elevation, roll : array (n,)
        Of the base, rad; see the module.
    base_position : array (n, 3)
        The base in the laboratory frame, m.

    Raises
    ------
    ValueError
        If shapes differ, a number is not finite or time does not rise.
    """

    time: Array
    azimuth: Array
    elevation: Array
    roll: Array
    base_position: Array

    def __post_init__(self) -> None:
        """Check every array."""
        n = np.size(self.time)
        faults = []
        for name in ("time", "azimuth", "elevation", "roll", "base_position"):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            shape = (n, 3) if name == "base_position" else (n,)
            if values.shape != shape:
                faults.append(f"{name} has shape {values.shape}; {shape} is needed")
            elif not np.isfinite(values).all():
                faults.append(f"{name} has values that are not finite")
            object.__setattr__(self, name, values)
        if not faults and (np.diff(self.time) <= 0.0).any():
            faults.append("time does not rise")
        if faults:
            raise ValueError("no motion: " + "; ".join(faults))

    @property
    def base_rotation(self) -> Array:
        """Rotations (n, 3, 3) from the whisker's to the laboratory frame."""
        return base_rotation(self.azimuth, self.elevation, self.roll)

    def __len__(self) -> int:
        return int(self.time.size)


def base_rotation(azimuth: ArrayLike, elevation: ArrayLike, roll: ArrayLike) -> Array:
    """Turn emergence angles into rotations.

    Parameters
    ----------
    azimuth, elevation, roll : array_like (...)
        Of the base, rad.

    Returns
    -------
    array (..., 3, 3)
        From the whisker's to the laboratory frame, R_z(azimuth) R_y(−elevation) R_x(roll).

    Examples
    --------
    >>> base_rotation(np.pi / 2, 0.0, 0.0).round(3)[:, 0]
    array([0., 1., 0.])
    """
    az, el, ro = np.broadcast_arrays(azimuth, elevation, roll)
    ca, sa = np.cos(az), np.sin(az)
    ce, se = np.cos(el), np.sin(el)
    cr, sr = np.cos(ro), np.sin(ro)
    tangent = np.stack([ca * ce, sa * ce, se], axis=-1)
    level = np.stack([-sa, ca, np.zeros_like(ca)], axis=-1)
    up = np.stack([-ca * se, -sa * se, ce], axis=-1)
    d1 = cr[..., None] * level + sr[..., None] * up
    d2 = cr[..., None] * up - sr[..., None] * level
    return np.stack([tangent, d1, d2], axis=-1)


def whisking(
    duration: float = 3.0,
    rate: float = 1000.0,
    *,
    frequency: float = 5.0,
    amplitude: float = np.radians(30.0),
    set_point: float = 0.0,
    elevation: float = 0.0,
    elevation_per_azimuth: float = ELEVATION_PER_AZIMUTH["C"],
    roll_per_azimuth: float = ROLL_PER_AZIMUTH["C"],
    variation: float = 0.05,
    elevation_drift: float = np.radians(4.0),
    position_drift: float = 1e-3,
    seed: int = 0,
) -> Motion:
    """Whisk: sweep back and forth, a little differently each time.

    Parameters
    ----------
    duration : float
        Of the trial, s.
    rate : float
        Frames per second.
    frequency : float
        Whisks per second.
    amplitude : float
        Half of the sweep, rad; the trial begins at the rear end of one.
    set_point : float
        Azimuth in the middle of the sweep, rad.
    elevation : float
        At the set point, rad.
    elevation_per_azimuth, roll_per_azimuth : float
        What elevation and roll gain per azimuth from the set point; row C by default.
    variation : float
        Largest drift of amplitude and of set point, as a share of the amplitude.
    elevation_drift : float
        Largest drift of the elevation, rad.
    position_drift : float
        Largest drift of the base along each axis of the laboratory, m.
    seed : int
        Of the drifts.

    Returns
    -------
    Motion
        Frames at 0, 1/rate, … below ``duration``.

    Raises
    ------
    ValueError
        If duration, rate or frequency are not positive, or less than two frames result.

    Examples
    --------
    >>> len(whisking(duration=1.0, rate=500.0))
    500
    """
    numbers = {"duration": duration, "rate": rate, "frequency": frequency}
    faults = [
        f"{name} is {value!r}; it must be positive"
        for name, value in numbers.items()
        if not (np.isfinite(value) and value > 0.0)
    ]
    if not faults and round(duration * rate) < 2:
        faults.append(f"{duration} s at {rate} frames/s are less than two frames")
    if faults:
        raise ValueError("no whisking: " + "; ".join(faults))
    time = np.arange(round(duration * rate)) / rate
    drifts = _drifts(time, 6, seed)
    size = amplitude * (1.0 + variation * drifts[0])
    offset = amplitude * variation * drifts[1] - size * np.cos(2.0 * np.pi * frequency * time)
    return Motion(
        time=time,
        azimuth=set_point + offset,
        elevation=elevation + elevation_per_azimuth * offset + elevation_drift * drifts[2],
        roll=roll_per_azimuth * offset,
        base_position=position_drift * drifts[3:].T,
    )


def _drifts(time: Array, count: int, seed: int) -> Array:
    """Smooth slow functions (count, n) of time (n,), s, within ±1."""
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (count, _DRIFT.size))
    angles = 2.0 * np.pi * _DRIFT[:, None] * time + phases[..., None]
    values: Array = np.sin(angles).mean(axis=1)
    return values
