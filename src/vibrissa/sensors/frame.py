"""How a sensor sits at the whisker: its axes, their handedness, its origin, and what it counts.

With the sensor's axes as the columns of Q, in the whisker's frame, and its origin at o,

    x = Q x_s + o,    F = σ Q F_s,    M = σ det(Q) Q M_s + o × F,

where σ = -1 for a sensor that reports the force with which it holds the whisker, instead of that of
the object on the whisker. Axes that form a left hand have det Q = -1, and moments that follow the
left hand: M_s = x_s × F_s in the sensor's own numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Axes that were typed with four digits are brought to right angles; worse ones are refused.
_ORTHOGONAL = 1e-3


@dataclass(frozen=True, eq=False)
class SensorFrame:
    """Where a sensor sits, relative to the whisker's frame at its base.

    Parameters
    ----------
    axes : array_like (3, 3) or sequence of str
        The sensor's axes as columns, in the whisker's frame; or where its x, y and z point to, as
        signed names: ``("x", "-z", "y")``. A left hand is allowed.
    position : array_like (3,)
        The point about which the sensor takes moments, whisker's frame, m.
    reaction : bool
        Whether the sensor reports the force that it exerts on the whisker, not the one that it
        feels: all six components then have the other sign.

    Raises
    ------
    ValueError
        If the axes are not at right angles, or something is not finite.

    Examples
    --------
    >>> SensorFrame(("x", "-y", "z")).handedness
    -1
    """

    axes: Any = ("x", "y", "z")
    position: Any = (0.0, 0.0, 0.0)
    reaction: bool = False

    def __post_init__(self) -> None:
        """Check, and bring the axes to right angles."""
        axes = _axes(self.axes)
        position = np.array(self.position, dtype=np.float64)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise ValueError(f"a sensor's position is three numbers, m; got {self.position!r}")
        object.__setattr__(self, "axes", axes)
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "reaction", bool(self.reaction))

    @property
    def handedness(self) -> int:
        """1 where the axes form a right hand, -1 where they form a left hand."""
        return 1 if np.linalg.det(self.axes) > 0.0 else -1

    def to_base(self) -> Array:
        """Return the matrix (6, 6) from the sensor's (F, M) to that at the whisker's base.

        Returns
        -------
        array (6, 6)
            SI units.
        """
        sign = -1.0 if self.reaction else 1.0
        force = sign * self.axes
        out = np.zeros((6, 6))
        out[:3, :3], out[3:, 3:] = force, self.handedness * force
        out[3:, :3] = cross_matrix(self.position) @ force
        return out

    def from_base(self) -> Array:
        """Return the matrix (6, 6) from (F, M) at the whisker's base to the sensor's.

        Returns
        -------
        array (6, 6)
            SI units.
        """
        return np.asarray(np.linalg.inv(self.to_base()))


def cross_matrix(a: Array) -> Array:
    """Matrix (..., 3, 3) with which a (..., 3) × b is a product."""
    out = np.zeros((*np.shape(a), 3))
    x, y, z = np.moveaxis(np.asarray(a), -1, 0)
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def _axes(given: Any) -> Array:
    if isinstance(given, str):
        given = given.replace(",", " ").split()
    if isinstance(given, Sequence) and all(isinstance(name, str) for name in given):
        return _named_axes(given)
    axes = np.array(given, dtype=np.float64)
    if axes.shape != (3, 3) or not np.isfinite(axes).all():
        raise ValueError(f"a sensor's axes are three columns of three numbers; got {given!r}")
    u, size, v = np.linalg.svd(axes)
    if np.abs(size - 1.0).max() > _ORTHOGONAL:
        raise ValueError(
            "a sensor's axes are of unit length and at right angles to each other; the stretches "
            f"of those given are {', '.join(f'{s:.4g}' for s in size)}, not 1"
        )
    return np.asarray(u @ v)


def _named_axes(names: Sequence[str]) -> Array:
    axes = np.zeros((3, 3))
    letters = [name.lstrip("+-") for name in names]
    if sorted(letters) != ["x", "y", "z"]:
        raise ValueError(
            f"a sensor's axes by name are x, y and z once each, with signs; got {list(names)!r}"
        )
    for column, (name, letter) in enumerate(zip(names, letters, strict=True)):
        axes["xyz".index(letter), column] = -1.0 if name.startswith("-") else 1.0
    return axes
