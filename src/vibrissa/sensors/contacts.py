"""Calibration on contacts of the whisker itself: the rod says what they feel like."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.rod import PointContact, deflect
from vibrissa.sensors.mixing import MixingCalibration, calibrate_mixing
from vibrissa.sensors.sensor import COMPONENTS
from vibrissa.status import describe, is_ok

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

Array = NDArray[np.float64]


def wrenches_of_contacts(whisker: Whisker, points: ArrayLike) -> Array:
    """Wrenches at the base of frictionless contacts at known points."""
    places = np.asarray(points, dtype=np.float64)
    if places.ndim != 2 or places.shape[1] != 3:
        raise ValueError(f"contact points are (n, 3), m; got {places.shape}")
    bent = deflect(whisker, PointContact(places))
    bad = ~is_ok(bent.status) & np.isfinite(places).all(axis=1)
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
) -> MixingCalibration:
    """Find linear mix, offset and noise of a sensor from contacts at known points.

    The whisker's stiffness becomes part of the mix: a whisker taken for twice as stiff gives
    channels that read half as much. So contacts found with that calibration are right even so,
    forces are not.

    Parameters
    ----------
    whisker : Whisker
        That the sensor holds.
    points : array_like (n, 3)
        Contact points on its centreline, whisker's frame, m; without friction.
    readings : array_like (n, k)
        Of the channels at these contacts; rows with NaN, here or there, are left out.
    channels : sequence of str, optional
        Names of the k channels.
    components : sequence of str
        Those that a channel may read.

    Returns
    -------
    MixingCalibration
        The sensor, and how surely it is known.

    Raises
    ------
    ValueError
        If a contact is not possible, or the contacts do not tell the components apart.
    """
    return calibrate_mixing(
        readings,
        wrenches_of_contacts(whisker, points),
        channels=channels,
        components=components,
    )
