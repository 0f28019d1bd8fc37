"""A sensor's linear mix and offset from known wrenches: y = A w + b, channel by channel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.sensors.frame import SensorFrame
from vibrissa.sensors.linear import solve
from vibrissa.sensors.sensor import COMPONENTS, Sensor

Array = NDArray[np.float64]

# A component this much smaller than the others of its kind is rounding.
_ROUNDING = 1e-6
_ADVICE = (
    "touch the whisker at other places and in other directions, or say by `components` what the "
    "channels cannot read"
)


@dataclass(frozen=True, eq=False)
class MixingCalibration:
    """What known wrenches tell about a sensor.

    Attributes
    ----------
    sensor : Sensor
        With the mixing (in the whisker's frame), offset and noise that were found, and their
        covariance.
    components : tuple of str
        Which components the channels may read.
    covariance : (k, p + 1, p + 1) array
        Of each channel's mixing of these p components and, last, its offset.
    residual : (k,) array
        RMS of what the mix leaves unexplained, in the unit of the channel.
    """

    sensor: Sensor
    components: tuple[str, ...]
    covariance: Array
    residual: Array


def calibrate_mixing(
    readings: ArrayLike,
    wrenches: ArrayLike,
    *,
    channels: Sequence[str] | None = None,
    components: Sequence[str] = COMPONENTS,
) -> MixingCalibration:
    """Find linear mix, offset and noise of a sensor from known wrenches.

    Parameters
    ----------
    readings : array_like (n, k)
        Of the channels; rows with NaN are left out.
    wrenches : array_like (n, 6)
        (F, M) at the whisker's base, whisker's frame, N and N·m: of known loads, or of contacts at
        known points. They count as exact.
    channels : sequence of str, optional
        Names of the k channels.
    components : sequence of str
        Those that a channel may read; the others' mixing is zero. A frictionless whisker makes few
        of the wrenches there are: most hold nearly no Mx.

    Returns
    -------
    MixingCalibration
        The sensor, and how surely it is known.

    Raises
    ------
    ValueError
        If shapes do not fit or the wrenches do not tell the components apart.
    """
    y, w = np.asarray(readings, dtype=np.float64), np.asarray(wrenches, dtype=np.float64)
    if y.ndim != 2 or w.shape != (len(y), 6):
        raise ValueError(
            f"readings (n, k) and wrenches (n, 6) are needed; got {y.shape} and {w.shape}"
        )
    unknown = [name for name in components if name not in COMPONENTS]
    if unknown or not components:
        raise ValueError(f"components are of {', '.join(COMPONENTS)}; got {list(components)}")
    names = tuple(channels or (f"channel {i + 1}" for i in range(y.shape[1])))
    if len(names) != y.shape[1]:
        raise ValueError(f"{y.shape[1]} channels have {len(names)} names: {', '.join(names)}")
    which = [COMPONENTS.index(name) for name in components]
    known = np.isfinite(y).all(axis=1) & np.isfinite(w).all(axis=1)
    if not known.any():
        raise ValueError(
            f"none of {len(y)} rows has both a reading and a load without NaN; at least "
            f"{len(which) + 2} are needed"
        )
    design = np.column_stack([_loaded(w[known])[:, which], np.ones(known.sum())])
    found = solve(design, y[known], (*components, "the offset"), _ADVICE)
    free = known.sum() - design.shape[1]
    if free < 1:
        raise ValueError(
            f"{known.sum()} contacts leave nothing to judge {design.shape[1]} unknowns by: add some"
        )
    variance = (found.residuals**2).sum(axis=0) / free
    mixing = np.zeros((y.shape[1], 6))
    mixing[:, which] = found.unknowns[:-1].T
    covariance = variance[:, None, None] * found.spread
    whole = np.zeros((y.shape[1], 7, 7))
    whole[np.ix_(range(y.shape[1]), [*which, 6], [*which, 6])] = covariance
    sensor = Sensor(
        names,
        mixing,
        np.sqrt(variance),
        found.unknowns[-1],
        frame=SensorFrame(),
        mixing_covariance=whole,
    )
    residual = np.sqrt((found.residuals**2).mean(axis=0))
    return MixingCalibration(sensor, tuple(components), covariance, residual)


def _loaded(wrenches: Array) -> Array:
    """Wrenches (n, 6) without components that are but rounding next to those of their kind."""
    out = wrenches.copy()
    for kind in (slice(0, 3), slice(3, 6)):
        size = np.abs(out[:, kind]).max(axis=0, initial=0.0)
        out[:, kind] *= size > _ROUNDING * size.max()
    return out
