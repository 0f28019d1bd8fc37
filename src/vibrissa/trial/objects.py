"""What a whisker meets in the laboratory: a straight peg, so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.quantities import attributes

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Peg:
    """A solid straight cylinder without ends.

    Parameters
    ----------
    origin : array_like (3,)
        A point of its axis in the laboratory frame, m.
    axis : array_like (3,)
        Direction of its axis in the laboratory frame, of any length but zero; kept as a unit
        vector.
    radius : float
        Radius of its surface, m.

    Raises
    ------
    ValueError
        If a number is missing, the axis is zero or the radius is not positive.

    Examples
    --------
    >>> Peg(origin=[25e-3, 0.0, 0.0], axis=[0.0, 0.0, 1.0], radius=1.35e-3)
    Peg(origin=(25.000, 0.000, 0.000) mm, axis=(0.000, 0.000, 1.000), diameter 2.700 mm)
    """

    origin: Array
    axis: Array
    radius: float

    def __post_init__(self) -> None:
        """Check and make the arrays read-only."""
        faults = []
        vectors = {}
        for name in ("origin", "axis"):
            vector = np.array(getattr(self, name), dtype=np.float64)
            if vector.shape != (3,) or not np.isfinite(vector).all():
                faults.append(f"{name} is {vector.tolist()}; three finite numbers are needed")
            vectors[name] = vector
        size = float(np.linalg.norm(vectors["axis"]))
        if size == 0.0:
            faults.append("axis is (0, 0, 0), which is no direction")
        if not (np.isfinite(self.radius) and self.radius > 0.0):
            faults.append(f"radius is {self.radius!r}; it must be positive, in m")
        if faults:
            raise ValueError("no peg: " + "; ".join(faults))
        # What already is a unit vector stays as it is, to the last bit, so that files keep it.
        if abs(size - 1.0) > 4.0 * np.finfo(np.float64).eps:
            vectors["axis"] = vectors["axis"] / size
        for name, vector in vectors.items():
            vector.flags.writeable = False
            object.__setattr__(self, name, vector)
        object.__setattr__(self, "radius", float(self.radius))

    def in_whisker_frame(
        self, base_rotation: ArrayLike, base_position: ArrayLike
    ) -> tuple[Array, Array]:
        """Say where the peg is as seen from the base of the whisker.

        Parameters
        ----------
        base_rotation : array_like (..., 3, 3)
            From the whisker's to the laboratory frame.
        base_position : array_like (..., 3)
            The base in the laboratory frame, m.

        Returns
        -------
        tuple of arrays (..., 3)
            A point of the axis, m, and its unit direction, in the whisker's frame.
        """
        rotation = np.asarray(base_rotation, dtype=np.float64)
        away = self.origin - np.asarray(base_position, dtype=np.float64)
        origin = np.einsum("...ji,...j->...i", rotation, away)
        return origin, np.einsum("...ji,j->...i", rotation, self.axis)

    def __repr__(self) -> str:
        """Show it in mm."""
        origin = ", ".join(f"{x * 1e3:.3f}" for x in self.origin)
        axis = ", ".join(f"{x:.3f}" for x in self.axis)
        return f"Peg(origin=({origin}) mm, axis=({axis}), diameter {self.radius * 2e3:.3f} mm)"


def pegs_dataset(pegs: Sequence[Peg]) -> xr.Dataset:
    """Write pegs as a dataset.

    Parameters
    ----------
    pegs : sequence of Peg
        Any number, laboratory frame.

    Returns
    -------
    xarray.Dataset
        Dims object, space: peg_position, peg_axis, peg_radius.
    """
    rows: dict[str, tuple[tuple[str, ...], Array]] = {
        "peg_position": (("object", "space"), np.array([p.origin for p in pegs]).reshape(-1, 3)),
        "peg_axis": (("object", "space"), np.array([p.axis for p in pegs]).reshape(-1, 3)),
        "peg_radius": (("object",), np.array([p.radius for p in pegs], dtype=np.float64)),
    }
    variables = {
        name: xr.Variable(dims, values, attributes(name)) for name, (dims, values) in rows.items()
    }
    return xr.Dataset(variables, {"space": list("xyz")}, {"reference_frame": "laboratory"})


def pegs_from_dataset(dataset: xr.Dataset) -> tuple[Peg, ...]:
    """Read the pegs that `pegs_dataset` wrote.

    Parameters
    ----------
    dataset : xarray.Dataset
        Dims object, space.

    Returns
    -------
    tuple of Peg
        Row by row.
    """
    return tuple(
        Peg(origin, axis, float(radius))
        for origin, axis, radius in zip(
            dataset["peg_position"].values,
            dataset["peg_axis"].values,
            dataset["peg_radius"].values,
            strict=True,
        )
    )
