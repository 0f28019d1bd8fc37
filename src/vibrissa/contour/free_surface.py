"""A smooth surface of any shape through contact points, with the uncertainty that these leave.

Contacts cover only part of an object, unevenly, and their errors differ by a hundred times. So the
surface is what deviates smoothly from the simple shape that fits best (plane, sphere or cylinder,
signed distance d₀): the zero set of

    f(x) = d₀(x) + g(x₀),

x₀ being the foot of x on the simple shape and g a Gaussian process in space of covariance

    a² (1 + r + r²/3) exp(−r) + ∂d₀/∂θ · B · ∂d₀/∂θ′,    r = √5 |x − x′| / ℓ:

smooth deviations (Matérn 5/2) of amplitude a and length ℓ, while the simple shape's parameters θ
are left open (universal kriging): B is diagonal, the points' extent squared for
lengths, one for directions.

Each contact states that f is zero at the point p − ρ n of the surface, with the variance ∇f·Σ∇f of
its error across the surface, so that errors along it count by its slope (as in McHutchon &
Rasmussen, NIPS 2011). Where nothing was touched g returns to zero, and its standard deviation to
a and beyond: the simple shape, not known to be there. That is why the deviation is modelled, and
not the signed distance itself, which far from all points would be anything. Because g is evaluated
at the foot, f grows by one a metre along the base's normals; g at x itself would not do, as
contacts are on the surface only, where g = −d₀ explains them all with no surface left. With
positions in space as inputs the surface may close round a cylinder or a sphere without a seam.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_solve, solve_triangular

from vibrissa.contour.fitted_shape import FittedShape, check_complete, rows_of
from vibrissa.contour.simple_shapes import SHAPES, SimpleShape
from vibrissa.contour.touches import FLOOR
from vibrissa.deferred import spatial
from vibrissa.numerics import Array
from vibrissa.quantities import attributes

_AT_ONCE = 4096
"""Rows that are done at once, so that intermediate arrays do not fill the memory."""

_STEP = 1e-4
"""Step of differences, as a share of the length."""

_FINER = 0.9
"""Edge of the next smaller cubes that neighbours are merged in."""

_FINEST = 1e-3
"""Edge of the smallest cubes, as a share of the points' extent."""


class Support(NamedTuple):
    """Values (n,) that a surface is made from, at positions (n, 3), with variances (n,)."""

    position: Array
    value: Array
    variance: Array


def merged(support: Support, most: int) -> Support:
    """Merge neighbours until no more are left than wanted.

    Space is divided into cubes, whose edge is the smallest for which no more are occupied than
    wanted. What is in one cube becomes one value at the mean position, all weighed by the inverse
    of their variances, as by a surface that is smooth on this scale; its variance is that of the
    weighted mean.
    """
    if len(support.value) <= most:
        return support
    position = support.position - support.position.min(axis=0)
    edge = float(position.max())
    cell = _cells(position, edge)
    while edge > _FINEST * float(position.max()):
        finer = _cells(position, _FINER * edge)
        if finer.max() >= most:
            break
        edge, cell = _FINER * edge, finer
    weight = 1.0 / support.variance
    total = np.bincount(cell, weight)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(cell, weight * values) / total)

    middle = np.stack([mean(x) for x in support.position.T], axis=1)
    return Support(middle, mean(support.value), 1.0 / total)


def _cells(position: Array, edge: float) -> NDArray[np.intp]:
    """Number of the occupied cube of each position."""
    cube = np.floor(position / edge).astype(np.int64)
    return np.unique(cube, axis=0, return_inverse=True)[1].reshape(-1)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class FreeFit(FittedShape):
    """A smooth surface, in the frame of the points.

    Attributes
    ----------
    base : CylinderFit, SphereFit or PlaneFit
        Simple shape that the surface deviates from.
    support : Support
        Positions (n, 3) on the base, m, values (n,) to be added to the base's signed distance
        there, m, and the variances of these, m².
    amplitude : float
        Standard deviation of the deviation before anything is touched, m.
    length : float
        Length over which the deviation changes, m.
    covariance : array (k, k)
        Covariance of the base's parameters.
    inliers : array (n,) of bool
        Points within four standard deviations.
    chi_squared : array (n,)
        Squared distances of the points used, over their variance and that of the surface.
    """

    base: SimpleShape
    support: Support
    amplitude: float
    length: float

    _loose: Array = field(init=False)
    _root: Array = field(init=False)
    _weights: Array = field(init=False)

    kind: ClassVar[str] = "free"
    fields: ClassVar[dict[str, str]] = {}

    def __post_init__(self) -> None:
        """Condition the process on its support."""
        position, value, variance = self.support
        extent = np.sqrt(((position - position.mean(axis=0)) ** 2).sum(axis=1).mean())
        object.__setattr__(self, "_loose", np.where(self.base.directions, 1.0, extent**2))
        noise = np.maximum(variance, (FLOOR * self.length) ** 2)
        root = np.linalg.cholesky(self._kernel(position, position) + np.diag(noise))
        object.__setattr__(self, "_root", root)
        object.__setattr__(self, "_weights", cho_solve((root, True), value))

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the base's parameters."""
        return self.base.parameters

    def __repr__(self) -> str:
        """Show it in mm."""
        return (
            f"<free surface over {len(self.support.value)} positions, "
            f"{self.amplitude * 1e3:.3f} mm in {self.length * 1e3:.3f} mm about {self.base!r}>"
        )

    def deviation(self, points: ArrayLike) -> tuple[Array, Array]:
        """Deviation: what is added to the base's signed distance.

        Parameters
        ----------
        points : array_like (..., 3)
            Points in the frame of the fit, m.

        Returns
        -------
        mean, sigma : array (...)
            Mean of the deviation, m, negative where the surface is outside of the base, and its
            standard deviation, m.
        """
        p = np.asarray(points, dtype=np.float64)
        rows = self._feet(p.reshape(-1, 3))
        mean, variance = np.empty(len(rows)), np.empty(len(rows))
        for part in _parts(len(rows)):
            shared = self._kernel(rows[part], self.support.position)
            mean[part] = shared @ self._weights
            explained = solve_triangular(self._root, shared.T, lower=True)
            prior = self.amplitude**2 + self.base._slopes(rows[part]) ** 2 @ self._loose
            variance[part] = prior - (explained**2).sum(axis=0)
        sigma = np.sqrt(np.maximum(variance, 0.0))
        return mean.reshape(p.shape[:-1]), sigma.reshape(p.shape[:-1])

    def _sigma(self, points: Array) -> Array:
        slope = np.linalg.norm(self._gradient(points), axis=-1)
        return np.asarray(self.deviation(points)[1] / slope)

    def _distance(self, points: Array) -> Array:
        size = np.linalg.norm(self._gradient(points), axis=-1)
        return np.asarray(self._level(points) / size)

    def _normals(self, points: Array) -> Array:
        gradient = self._gradient(points)
        return np.asarray(gradient / np.linalg.norm(gradient, axis=-1, keepdims=True))

    def _slopes(self, points: Array) -> Array:
        return self.base._slopes(points)

    def _curvature(self, points: Array, height: Array | float = 0.0) -> Array:
        return self.base._curvature(points, height)

    def _feet(self, points: Array) -> Array:
        """Feet of points (n, 3) on the base."""
        distance = self.base.signed_distance(points)[:, None]
        return np.asarray(points - distance * self.base.outward_normals(points))

    def _level(self, points: Array) -> Array:
        """Function f (...), zero on the surface."""
        feet = self._feet(points.reshape(-1, 3))
        added = np.empty(len(feet))
        for part in _parts(len(feet)):
            added[part] = self._kernel(feet[part], self.support.position) @ self._weights
        return np.asarray(self.base.signed_distance(points) + added.reshape(points.shape[:-1]))

    def _gradient(self, points: Array) -> Array:
        """∇f (..., 3)."""
        step = _STEP * self.length
        steps = step * np.eye(3)
        ahead, back = (self._level(points[..., None, :] + sign * steps) for sign in (1.0, -1.0))
        return np.asarray((ahead - back) / (2.0 * step))

    def _kernel(self, first: Array, second: Array) -> Array:
        """Covariances (n, m) of the deviations at points (n, 3) and (m, 3)."""
        far = np.sqrt(5.0) / self.length * spatial.distance.cdist(first, second)
        free = self.amplitude**2 * (1.0 + far + far**2 / 3.0) * np.exp(-far)
        slopes = self.base._slopes(first), self.base._slopes(second)
        return np.asarray(free + (slopes[0] * self._loose) @ slopes[1].T)

    def _written(self) -> tuple[dict[str, Any], dict[str, Any]]:
        rows: dict[str, tuple[tuple[str, ...], Any]] = {
            "support_point": (("support", "space"), self.support.position),
            "support_value": (("support",), self.support.value),
            "support_variance": (("support",), self.support.variance),
            "shape_amplitude": ((), self.amplitude),
            "shape_length": ((), self.length),
        }
        own = {name: (dims, values, attributes(name)) for name, (dims, values) in rows.items()}
        return self.base._written()[0] | own, {"base": self.base.kind}

    @classmethod
    def _stored(cls, dataset: xr.Dataset) -> Self:
        kind = dataset.attrs.get("base")
        if kind not in SHAPES:
            raise ValueError(
                f"a free surface deviates from {kind!r}; {', '.join(SHAPES)} are known"
            )
        support = ("support_point", "support_value", "support_variance")
        check_complete(dataset, cls.kind, {*support, "shape_amplitude", "shape_length"})
        base = SHAPES[kind]._stored(dataset)
        return cls(
            base=base,
            support=Support(*(dataset[name].values for name in support)),
            amplitude=float(dataset["shape_amplitude"]),
            length=float(dataset["shape_length"]),
            covariance=base.covariance,
            **rows_of(dataset),
        )


def shape_from_dataset(dataset: xr.Dataset) -> FittedShape:
    """Restore a fitted shape from the dataset that it was written to.

    Parameters
    ----------
    dataset : xarray.Dataset
        Dataset of ``FittedShape.to_dataset``.

    Returns
    -------
    CylinderFit, SphereFit, PlaneFit or FreeFit
        Shape as it was; residuals and inliers in one row.

    Raises
    ------
    ValueError
        If its kind is unknown, or something is missing.
    """
    kinds: dict[str, type[FittedShape]] = {**SHAPES, FreeFit.kind: FreeFit}
    kind = dataset.attrs.get("shape")
    if kind not in kinds:
        raise ValueError(f"the shape is {kind!r}; it must be one of {', '.join(kinds)}")
    return kinds[kind]._stored(dataset)


def _parts(count: int) -> list[slice]:
    """Rows that are done together."""
    return [slice(start, start + _AT_ONCE) for start in range(0, count, _AT_ONCE)]
