"""Fitted shapes: surfaces with the uncertainty of their parameters, and how they are stored."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol, Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.special import chdtri

from vibrissa.numerics import Array, Mask
from vibrissa.quantities import QUANTITIES, attributes

DIRECTION = "object_axis"
"""Quantity of unit vectors; all other parameters are lengths."""


class Body(Protocol):
    """Anything with a surface: a fitted shape, or an object of a trial."""

    def signed_distance(self, points: ArrayLike, /) -> Array:
        """Signed distances of points (..., 3) from its surface, m; negative inside."""


def _nothing() -> Array:
    return np.empty(0)


@dataclass(frozen=True, eq=False, repr=False)
class FittedShape(ABC):
    """A shape that was fitted to contacts, in the frame of their points.

    Attributes
    ----------
    covariance : array (k, k)
        Covariance of the parameters, in the order of ``parameters``, SI units.
    residuals : array (n,)
        Distances of the whisker's surface from the shape's, m, positive outside; NaN for
        points that were missing.
    inliers : array (n,) of bool
        Points that were used and whose misfit is at most that of four standard deviations in one
        dimension.
    chi_squared : array (n,)
        Squared misfits of each point's equations, in standard deviations; NaN for points that were
        not used.
    equations : int
        Number of equations of each point: the distance and, where they count, those of its normal;
        0 if the noise is known from the scatter alone.
    """

    covariance: Array = field(default_factory=_nothing)
    residuals: Array = field(default_factory=_nothing)
    inliers: Mask = field(default_factory=lambda: np.empty(0, dtype=bool))
    chi_squared: Array = field(default_factory=_nothing)
    equations: int = 0

    kind: ClassVar[str]
    fields: ClassVar[dict[str, str]]
    """Names of the parameters, and the quantities that they are."""

    def signed_distance(self, points: ArrayLike) -> Array:
        """Signed distances of points from the surface.

        Parameters
        ----------
        points : array_like (..., 3)
            Points in the frame of the fit, m.

        Returns
        -------
        array (...)
            Distances, m; negative inside.
        """
        return self._distance(np.asarray(points, dtype=np.float64))

    def outward_normals(self, points: ArrayLike) -> Array:
        """Outward normals of the surface nearest to points.

        Parameters
        ----------
        points : array_like (..., 3)
            Points in the frame of the fit, m.

        Returns
        -------
        array (..., 3)
            Unit vectors; NaN where there is none, as on the axis.
        """
        normal = self._normals(np.asarray(points, dtype=np.float64))
        return np.where(normal.any(axis=-1, keepdims=True), normal, np.nan)

    def distance_sigma(self, points: ArrayLike) -> Array:
        """Standard deviation of distances from the surface.

        Parameters
        ----------
        points : array_like (..., 3)
            Points in the frame of the fit, m.

        Returns
        -------
        array (...)
            Standard deviation by the uncertainty of the parameters, m.
        """
        return self._sigma(np.asarray(points, dtype=np.float64))

    def _sigma(self, points: Array) -> Array:
        """See `distance_sigma`."""
        slopes = self._slopes(points)
        variance = np.einsum("...i,ij,...j->...", slopes, self.covariance, slopes)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    @abstractmethod
    def _distance(self, points: Array) -> Array:
        """See `signed_distance`."""

    @abstractmethod
    def _normals(self, points: Array) -> Array:
        """Unit normals (..., 3); zero where there is none."""

    @abstractmethod
    def _curvature(self, points: Array, height: Array | float = 0.0) -> Array:
        """Derivatives (..., 3, 3) of the normals at a height above the surface."""

    @abstractmethod
    def _slopes(self, points: Array) -> Array:
        """Derivatives (..., k) of the distance with respect to the parameters."""

    def __repr__(self) -> str:
        """Show the parameters in mm, with standard deviations."""
        shown = []
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
            shown.append(f"{name} {listed}{unit}")
        return f"<{self.kind} fitted to {int(self.inliers.sum())} contacts: {', '.join(shown)}>"

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the rows and columns of the covariance."""
        names: list[str] = []
        for name in self.fields:
            size = np.size(getattr(self, name))
            names += [name] if size == 1 else [f"{name}_{letter}" for letter in "xyz"]
        return tuple(names)

    @property
    def directions(self) -> Mask:
        """Parameters (k,) that are components of a unit vector, and not lengths."""
        counts = [np.size(getattr(self, name)) for name in self.fields]
        return np.repeat([q == DIRECTION for q in self.fields.values()], counts)

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

        1 where shape and noise are right; much more means that the points are of another shape, or
        noisier than stated. Few outliers hardly change it. The covariance is as much larger.
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
        """Write the fitted shape as a dataset.

        Parameters
        ----------
        dims : sequence of str
            Dimensions of the points that it was fitted to, such as ``("time", "whisker")``.
        shape : tuple of int, optional
            Shape of these points, where they were flattened.
        coords : mapping, optional
            Coordinates of these dimensions.

        Returns
        -------
        xarray.Dataset
            Parameters as ``object_position``, ``object_axis`` and ``object_radius``,
            ``parameter_covariance``, and along ``dims`` ``surface_distance``, ``inlier`` and
            ``chi_squared``; the attribute ``shape`` is its kind. A free surface is written as its
            base with ``support_point``, ``support_value``, ``support_variance``,
            ``shape_amplitude`` and ``shape_length``, and the attribute ``base``.
        """
        data, about = self._written()
        size = self.residuals.shape if shape is None else shape
        square = ("parameter", "parameter_2")
        data["parameter_covariance"] = (square, self.covariance, attributes("parameter_covariance"))
        rows = (self.residuals, self.inliers, self.chi_squared)
        for name, values in zip(_EACH, rows, strict=True):
            data[name] = (tuple(dims), values.reshape(size), attributes(name))
        known = {"space": list("xyz"), "parameter": list(self.parameters)}
        about |= {"shape": self.kind, "equations": self.equations}
        return xr.Dataset(data, {**(coords or {}), **known}, about)

    def _written(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Variables of the parameters, and attributes, of the dataset."""
        data: dict[str, Any] = {}
        for name, quantity in self.fields.items():
            value = np.asarray(getattr(self, name), dtype=np.float64)
            data[quantity] = (("space",)[: value.ndim], value, attributes(quantity))
        return data, {}

    @classmethod
    def _stored(cls, dataset: xr.Dataset) -> Self:
        """Restore a shape of this kind from its dataset."""
        check_complete(dataset, cls.kind, {"parameter_covariance", *cls.fields.values()})
        values: dict[str, Any] = {}
        for name, quantity in cls.fields.items():
            value = dataset[quantity].values.astype(np.float64)
            values[name] = float(value) if value.ndim == 0 else value
        return cls(covariance=dataset["parameter_covariance"].values, **rows_of(dataset), **values)


_EACH = ("surface_distance", "inlier", "chi_squared")
"""Variables of the points that a shape was fitted to."""


def check_complete(dataset: xr.Dataset, kind: str, names: set[str]) -> None:
    """Make sure that a stored shape has all its variables."""
    missing = sorted((names | set(_EACH)) - set(dataset.data_vars))
    if missing:
        raise ValueError(f"a fitted {kind} lacks {', '.join(missing)}")


def rows_of(dataset: xr.Dataset) -> dict[str, Any]:
    """Residuals, inliers and squared misfits in one row."""
    residuals, inliers, squares = (dataset[name].values.reshape(-1) for name in _EACH)
    return {
        "residuals": residuals,
        "inliers": inliers.astype(bool),
        "chi_squared": squares,
        "equations": int(dataset.attrs.get("equations", 0)),
    }


def excess_of(chi_squared: Array, equations: int) -> float:
    """χ² per degree of freedom by the median, which few outliers hardly change."""
    known = chi_squared[np.isfinite(chi_squared)]
    if not known.size or equations < 1:
        return float("nan")
    return float(np.median(known) / chdtri(equations, 0.5))


def evidence_of(chi_squared: Array, unknowns: int) -> float:
    """Bayesian information criterion of a shape, which few outliers change little."""
    cost = 8.0 * (np.sqrt(1.0 + 0.25 * chi_squared) - 1.0)
    return float(cost.sum() + unknowns * np.log(max(chi_squared.size, 1)))
