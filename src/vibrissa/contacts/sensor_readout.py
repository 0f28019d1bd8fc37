"""What a sensor's channels tell: whole signals by name where they can, else a mix."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vibrissa.contacts.noise import SensorNoise
from vibrissa.contacts.readout import Mixed, Named
from vibrissa.numerics import Array
from vibrissa.sensors import COMPONENTS
from vibrissa.signals import SIGNALS

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

_UNKNOWNS = 3
# Components that together are signals; a sensor that reads these reads signals by name.
_BY_NAME = (("Fx",), ("Fy", "Fz"), ("Mx",), ("My", "Mz"))


class ByName:
    """A sensor whose channels tell whole signals: its readings as those."""

    def __init__(self, named: Named, back: Array, places: list[int]) -> None:
        self.named, self._back, self._places = named, back, places
        self._wrench = np.zeros(6)

    def signals(self, values: Array) -> Array:
        """Turn readings (k,) into the signals."""
        w = self._wrench
        w[self._places] = self._back @ values
        fx, fy, fz, mx, my, mz = w.tolist()
        known = {
            "Fx": fx,
            "FT": float(np.hypot(fy, fz)),
            "FD": float(np.arctan2(fz, fy)),
            "Mx": mx,
            "MB": float(np.hypot(my, mz)),
            "MD": float(np.arctan2(mz, my)),
        }
        return np.array([known[name] for name in self.named.names])


def readout_of(
    contact_map: ContactMap, h: Array, covariance: Array, errors: Array
) -> ByName | Mixed:
    """Signals by name if the channels tell these and nothing else, or a mix."""
    read = [name for name, column in zip(COMPONENTS, h.T, strict=True) if column.any()]
    whole = [group for group in _BY_NAME if set(group) <= set(read)]
    places = [COMPONENTS.index(name) for name in read]
    own = h[:, places]
    complete = sum(map(len, whole)) == len(read) and len(read) >= _UNKNOWNS
    if not complete or np.linalg.matrix_rank(own / np.linalg.norm(own, axis=0)) < len(read):
        return Mixed(contact_map, h, covariance, errors)
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    back = np.linalg.pinv(root @ own) @ root
    wrench = np.zeros((6, 6))
    wrench[np.ix_(places, places)] = back @ covariance @ back.T
    names = {
        ("Fx",): ("Fx",),
        ("Fy", "Fz"): ("FT", "FD"),
        ("Mx",): ("Mx",),
        ("My", "Mz"): ("MB", "MD"),
    }
    chosen = [name for group in whole for name in names[group]]
    signals = tuple(name for name in SIGNALS if name in chosen)
    wrong = np.zeros((len(errors), 6, 7))
    wrong[:, places] = back @ errors
    noise = SensorNoise.of(0.5 * (wrench + wrench.T), signals, wrong)
    return ByName(Named(contact_map, signals, noise), np.asarray(back, dtype=np.float64), places)
