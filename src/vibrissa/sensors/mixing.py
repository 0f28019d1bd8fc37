"""A sensor's linear mix and offset from known wrenches: y = A w + b, channel by channel.

The wrenches are those of known loads, or of contacts of the whisker itself by its model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.numerics import Array
from vibrissa.rod import PointContact, deflect
from vibrissa.sensors.frame import SensorFrame
from vibrissa.sensors.regression import solve
from vibrissa.sensors.sensor import COMPONENTS, Sensor
from vibrissa.status import describe, is_ok

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker


_ROUNDING = 1e-6
"""Share of the largest component of its kind below which a component is rounding."""

_ADVICE = (
    "touch the whisker at other places and in other directions, or state by `components` what the "
    "channels cannot read"
)


@dataclass(frozen=True, eq=False)
class MixingCalibration:
    """A sensor's mixing as determined by known wrenches.

    Attributes
    ----------
    sensor : Sensor
        Sensor with the mixing (in the whisker's frame), offset and noise that were found, and their
        covariance.
    components : tuple of str
        Components that the channels may read.
    covariance : (k, p + 1, p + 1) array
        Covariance of each channel's mixing of these p components and, last, its offset.
    residual : (k,) array
        Root mean square residual of the mix, in the unit of the channel.
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
    resolution: ArrayLike = 0.0,
    largest: ArrayLike = np.inf,
) -> MixingCalibration:
    """Find linear mix, offset and noise of a sensor from known wrenches.

    Parameters
    ----------
    readings : array_like (n, k)
        Readings of the channels; rows with NaN are left out.
    wrenches : array_like (n, 6)
        Wrenches (F, M) at the whisker's base, whisker's frame, N and N·m: of known loads, or of
        contacts at known points. They count as exact.
    channels : sequence of str, optional
        Names of the k channels.
    components : sequence of str
        Components that a channel may read; the others' mixing is zero. Wrenches of a frictionless
        whisker are a small part of all: most have nearly no Mx.
    resolution, largest : array_like (k,)
        Step of the readings and size of the largest, as of `Sensor`, which keeps them. Rows with a
        saturated reading are left out, and the noise does not include rounding.

    Returns
    -------
    MixingCalibration
        Sensor with its uncertainty.

    Raises
    ------
    ValueError
        If shapes do not fit or the wrenches do not separate the components.
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
    known = (np.isfinite(y) & (np.abs(y) < largest)).all(axis=1) & np.isfinite(w).all(axis=1)
    if not known.any():
        raise ValueError(
            f"none of {len(y)} rows has both a reading and a load without NaN or saturation; at "
            f"least {len(which) + 2} are needed"
        )
    design = np.column_stack([_loaded(w[known])[:, which], np.ones(known.sum())])
    fit = solve(design, y[known], (*components, "the offset"), _ADVICE)
    free = known.sum() - design.shape[1]
    if free < 1:
        raise ValueError(
            f"{known.sum()} contacts are too few for {design.shape[1]} unknowns and the noise: "
            "add some"
        )
    variance = (fit.residuals**2).sum(axis=0) / free
    mixing = np.zeros((y.shape[1], 6))
    mixing[:, which] = fit.unknowns[:-1].T
    covariance = variance[:, None, None] * fit.spread
    whole = np.zeros((y.shape[1], 7, 7))
    whole[np.ix_(range(y.shape[1]), [*which, 6], [*which, 6])] = covariance
    sensor = Sensor(
        names,
        mixing,
        np.sqrt(np.maximum(variance - np.asarray(resolution) ** 2 / 12.0, 0.0)),
        fit.unknowns[-1],
        resolution=resolution,
        largest=largest,
        frame=SensorFrame(),
        mixing_covariance=whole,
    )
    residual = np.sqrt((fit.residuals**2).mean(axis=0))
    return MixingCalibration(sensor, tuple(components), covariance, residual)


def _loaded(wrenches: Array) -> Array:
    """Wrenches (n, 6) without components that are rounding compared with those of their kind."""
    out = wrenches.copy()
    for kind in (slice(0, 3), slice(3, 6)):
        size = np.abs(out[:, kind]).max(axis=0, initial=0.0)
        out[:, kind] *= size > _ROUNDING * size.max()
    return out


def wrenches_of_contacts(whisker: Whisker, points: ArrayLike) -> Array:
    """Wrenches at the base of frictionless contacts at known points."""
    contacts = np.asarray(points, dtype=np.float64)
    if contacts.ndim != 2 or contacts.shape[1] != 3:
        raise ValueError(f"contact points are (n, 3), m; got {contacts.shape}")
    bent = deflect(whisker, PointContact(contacts))
    bad = ~is_ok(bent.status) & np.isfinite(contacts).all(axis=1)
    if bad.any():
        reasons = "; ".join(f"{n} × {text}" for text, n in describe(bent.status[bad]).items())
        raise ValueError(f"{bad.sum()} of {bad.size} contacts are not possible: {reasons}")
    return np.concatenate([bent.force, bent.moment], axis=-1)


def calibrate_on_contacts(
    whisker: Whisker,
    points: ArrayLike,
    readings: ArrayLike,
    *,
    channels: Sequence[str] | None = None,
    components: Sequence[str] = COMPONENTS,
    resolution: ArrayLike = 0.0,
    largest: ArrayLike = np.inf,
) -> MixingCalibration:
    """Find linear mix, offset and noise of a sensor from contacts at known points.

    The whisker's stiffness becomes part of the mix: with twice the stiffness channels read half as
    much. So contacts found with that calibration are right in spite of a wrong stiffness, forces
    are not.

    Parameters
    ----------
    whisker : Whisker
        Whisker that the sensor holds.
    points : array_like (n, 3)
        Contact points on its centreline, whisker's frame, m; without friction.
    readings : array_like (n, k)
        Readings of the channels at these contacts; rows with NaN in either are left out.
    channels : sequence of str, optional
        Names of the k channels.
    components : sequence of str
        Components that a channel may read.
    resolution, largest : array_like (k,)
        Step of the readings and size of the largest, as of `calibrate_mixing`.

    Returns
    -------
    MixingCalibration
        Sensor with its uncertainty.

    Raises
    ------
    ValueError
        If a contact is not possible, or the contacts do not separate the components.
    """
    return calibrate_mixing(
        readings,
        wrenches_of_contacts(whisker, points),
        channels=channels,
        components=components,
        resolution=resolution,
        largest=largest,
    )
