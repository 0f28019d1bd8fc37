"""What all fitted shapes have in common, and how they are stored."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.contour.goodness import excess_of
from vibrissa.contour.touches import Array, Mask
from vibrissa.quantities import QUANTITIES, attributes


class Body(Protocol):
    """Anything with a surface: a fitted shape, or an object of a trial."""

    def signed_distance(self, points: ArrayLike, /) -> Array:
        """Tell how far points (..., 3) are from its surface, m; negative inside."""


@dataclass(frozen=True, eq=False)
class FittedShape(ABC):
    """A shape that was fitted to contacts, in the frame of their points.

    Attributes
    ----------
    covariance : array (k, k)
        Of its parameters, in the order of ``parameters``, SI units.
    residuals : array (n,)
        Distances of the whisker's surface from the shape's, m, positive outside; NaN for
        points that were missing.
    inliers : array (n,) of bool
        Points that were used and lie within what four standard deviations are in one dimension.
    chi_squared : array (n,)
        By how much the equations of each point are missed, squared, in standard deviations; NaN for
        points that were not used.
    equations : int
        How many each has: the distance and, where they count, those of its normal; 0 if the noise
        is known from the scatter alone.
    """

    covariance: Array = field(repr=False)
    residuals: Array = field(repr=False)
    inliers: Mask = field(repr=False)
    chi_squared: Array = field(repr=False)
    equations: int = field(repr=False)

    kind: ClassVar[str]
    fields: ClassVar[dict[str, str]]
    """Its attributes, and the quantities that they are."""

    def signed_distance(self, points: ArrayLike) -> Array:
        """Tell how far points are from its surface.

        Parameters
        ----------
        points : array_like (..., 3)
            In the frame of the fit, m.

        Returns
        -------
        array (...)
            Distances, m; negative inside.
        """
        return self._distance(np.asarray(points, dtype=np.float64))

    def outward_normals(self, points: ArrayLike) -> Array:
        """Give the outward normals of its surface nearest to points.

        Parameters
        ----------
        points : array_like (..., 3)
            In the frame of the fit, m.

        Returns
        -------
        array (..., 3)
            Unit vectors; NaN where there is none, as on the axis.
        """
        return self._normals(np.asarray(points, dtype=np.float64))

    def distance_sigma(self, points: ArrayLike) -> Array:
        """Tell how surely distances from its surface are known.

        Parameters
        ----------
        points : array_like (..., 3)
            In the frame of the fit, m.

        Returns
        -------
        array (...)
            Standard deviation by the uncertainty of the parameters, m.
        """
        slopes = self._slopes(np.asarray(points, dtype=np.float64))
        variance = np.einsum("...i,ij,...j->...", slopes, self.covariance, slopes)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    @abstractmethod
    def _distance(self, points: Array) -> Array:
        """See `signed_distance`."""

    @abstractmethod
    def _normals(self, points: Array) -> Array:
        """See `outward_normals`."""

    @abstractmethod
    def _curvature(self, points: Array) -> Array:
        """Derivatives (..., 3, 3) of the normals where the surface is."""

    @abstractmethod
    def _slopes(self, points: Array) -> Array:
        """Derivatives (..., k) of the distance by the parameters."""

    def __repr__(self) -> str:
        """Show it in mm, with standard deviations."""
        said = []
        for name, quantity in self.fields.items():
            value = np.atleast_1d(getattr(self, name))
            rows = [i for i, p in enumerate(self.parameters) if p.startswith(name)]
            sigma = np.sqrt(np.diag(self.covariance)[rows])
            length = QUANTITIES[quantity].unit == "m"
            factor, unit, digits = (1e3, " mm", 3) if length else (1.0, "", 4)
            numbers = [
                f"{factor * v:.{digits}f} ± {factor * s:.{digits}f}"
                for v, s in zip(value, sigma, strict=True)
            ]
            listed = numbers[0] if len(numbers) == 1 else f"({', '.join(numbers)})"
            said.append(f"{name} {listed}{unit}")
        return f"<{self.kind} fitted to {int(self.inliers.sum())} contacts: {', '.join(said)}>"

    @property
    def parameters(self) -> tuple[str, ...]:
        """What rows and columns of the covariance are."""
        names: list[str] = []
        for name in self.fields:
            size = np.size(getattr(self, name))
            names += [name] if size == 1 else [f"{name}_{letter}" for letter in "xyz"]
        return tuple(names)

    @property
    def rms(self) -> float:
        """Root mean square of the inliers' residuals, m; NaN if there are none."""
        size = self.residuals[self.inliers]
        return float(np.sqrt(np.mean(size**2))) if size.size else float("nan")

    @property
    def used(self) -> Mask:
        """Points (n,) that were used: not missing, nor too uncertain for a shape this small."""
        return np.asarray(np.isfinite(self.chi_squared))

    @property
    def misfit(self) -> float:
        """χ² per degree of freedom, by the median; NaN if the points' noise is not known.

        1 where shape and noise are right; much more says that the points are of another shape, or
        noisier than they say. Few outliers hardly change it. The covariance is as much larger.
        """
        return excess_of(self.chi_squared, self.equations)

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each parameter, SI units."""
        deviations = np.sqrt(np.diag(self.covariance))
        return {n: float(s) for n, s in zip(self.parameters, deviations, strict=True)}

    def to_dataset(
        self,
        dims: Sequence[str] = ("point",),
        shape: tuple[int, ...] | None = None,
        coords: Any = None,
    ) -> xr.Dataset:
        """Write it as a dataset.

        Parameters
        ----------
        dims : sequence of str
            Of the points that it was fitted to, such as ``("time", "whisker")``.
        shape : tuple of int, optional
            Of these points, where they were flattened.
        coords : mapping, optional
            Of these dims.

        Returns
        -------
        xarray.Dataset
            Its parameters as ``object_position``, ``object_axis`` and ``object_radius``,
            ``parameter_covariance``, and along ``dims`` ``surface_distance``, ``inlier`` and
            ``chi_squared``; the attribute ``shape`` says what it is.
        """
        data: dict[str, Any] = {}
        for name, quantity in self.fields.items():
            value = np.asarray(getattr(self, name), dtype=np.float64)
            data[quantity] = (("space",)[: value.ndim], value, attributes(quantity))
        size = self.residuals.shape if shape is None else shape
        square = ("parameter", "parameter_2")
        data["parameter_covariance"] = (square, self.covariance, attributes("parameter_covariance"))
        each = {
            "surface_distance": self.residuals,
            "inlier": self.inliers,
            "chi_squared": self.chi_squared,
        }
        for name, values in each.items():
            data[name] = (tuple(dims), values.reshape(size), attributes(name))
        known = {"space": list("xyz"), "parameter": list(self.parameters)}
        about = {"shape": self.kind, "equations": self.equations}
        return xr.Dataset(data, {**(coords or {}), **known}, about)
