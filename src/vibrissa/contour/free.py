"""A smooth surface of any shape through contact points, as sure as these make it.

Contacts cover only part of an object, unevenly, and their errors differ by a hundred times. So the
surface is what deviates smoothly from the simple shape that fits best (plane, sphere or cylinder,
signed distance d₀): the zero set of

    f(x) = d₀(x) + g(x₀),

x₀ being the foot of x on the simple shape and g a Gaussian process in space of covariance

    a² (1 + r + r²/3) exp(−r) + ∂d₀/∂θ · B · ∂d₀/∂θ′,    r = √5 |x − x′| / ℓ:

smooth deviations (Matérn 5/2) of amplitude a and length ℓ, while the simple shape's parameters θ
are left open (universal kriging): B is diagonal, the points' extent squared for
lengths, one for directions.

Each contact says that f is zero at the point p − ρ n of the surface, with the variance ∇f·Σ∇f of
its error across the surface, so that errors along it count by its slope (as in McHutchon &
Rasmussen, NIPS 2011). Where nothing was touched g goes back to zero, and its standard deviation to
a and beyond: the simple shape, not known to be there. That is why the deviation is modelled, and
not the signed distance itself, which far from all points would be anything. Because g is taken at
the foot, f grows by one a metre along the base's normals; g at x itself would not do, as contacts
lie on the surface only, where g = −d₀ explains them all with no surface left. With places in space
as inputs the surface may close round a cylinder or a sphere without a seam.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.linalg import cho_solve, solve_triangular
from scipy.spatial.distance import cdist

from vibrissa.contour.merging import Support
from vibrissa.contour.shape import FittedShape
from vibrissa.contour.touches import FLOOR, Array
from vibrissa.quantities import attributes

_AT_ONCE = 4096
_STEP = 1e-4
"""Of differences, as a share of the length."""


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class FreeFit(FittedShape):
    """A smooth surface, in the frame of the points.

    Attributes
    ----------
    base : CylinderFit, SphereFit or PlaneFit
        What it deviates from.
    support : Support
        Places (n, 3) on the base, m, what has to be added to the base's signed distance there, m,
        and the variances of that, m².
    amplitude : float
        Standard deviation of the deviation before anything is touched, m.
    length : float
        Over which it changes, m.
    covariance : array (k, k)
        Of the base's parameters.
    residuals : array (n,)
        Distances of the whisker's surface from the fitted one, m, positive outside; NaN for
        points that were missing.
    inliers : array (n,) of bool
        Points that lie within four standard deviations.
    chi_squared : array (n,)
        Squared distances of the points used, over their variance and that of the surface.
    equations : int
        1; 0 if the points' noise is not known.
    """

    base: FittedShape
    support: Support = field(repr=False)
    amplitude: float
    length: float

    _loose: Array = field(init=False, repr=False)
    _root: Array = field(init=False, repr=False)
    _weights: Array = field(init=False, repr=False)

    kind: ClassVar[str] = "free"
    fields: ClassVar[dict[str, str]] = {}

    def __post_init__(self) -> None:
        """Condition the process on its support."""
        place, value, variance = self.support
        extent = np.sqrt(((place - place.mean(axis=0)) ** 2).sum(axis=1).mean())
        turning = np.array([p.startswith(("axis", "normal")) for p in self.base.parameters])
        object.__setattr__(self, "_loose", np.where(turning, 1.0, extent**2))
        noise = np.maximum(variance, (FLOOR * self.length) ** 2)
        root = np.linalg.cholesky(self._kernel(place, place) + np.diag(noise))
        object.__setattr__(self, "_root", root)
        object.__setattr__(self, "_weights", cho_solve((root, True), value))

    @property
    def parameters(self) -> tuple[str, ...]:
        """Those of the base."""
        return self.base.parameters

    def __repr__(self) -> str:
        """Show it in mm."""
        return (
            f"<free surface over {len(self.support.value)} places, {self.amplitude * 1e3:.3f} mm "
            f"in {self.length * 1e3:.3f} mm about {self.base!r}>"
        )

    def deviation(self, points: ArrayLike) -> tuple[Array, Array]:
        """Tell what is added to the base's signed distance.

        Parameters
        ----------
        points : array_like (..., 3)
            In the frame of the fit, m.

        Returns
        -------
        mean, sigma : array (...)
            Of that, m; negative where the surface is outside of the base.
        """
        p = np.asarray(points, dtype=np.float64)
        rows = self._feet(p.reshape(-1, 3))
        mean, variance = np.empty(len(rows)), np.empty(len(rows))
        for part in _parts(len(rows)):
            shared = self._kernel(rows[part], self.support.place)
            mean[part] = shared @ self._weights
            told = solve_triangular(self._root, shared.T, lower=True)
            prior = self.amplitude**2 + self.base._slopes(rows[part]) ** 2 @ self._loose
            variance[part] = prior - (told**2).sum(axis=0)
        sigma = np.sqrt(np.maximum(variance, 0.0))
        return mean.reshape(p.shape[:-1]), sigma.reshape(p.shape[:-1])

    def distance_sigma(self, points: ArrayLike) -> Array:
        """Tell how surely distances from the surface are known.

        Parameters
        ----------
        points : array_like (..., 3)
            In the frame of the fit, m.

        Returns
        -------
        array (...)
            Standard deviation, m; large far from all contacts.
        """
        p = np.asarray(points, dtype=np.float64)
        return np.asarray(self.deviation(p)[1] / np.linalg.norm(self._gradient(p), axis=-1))

    def _distance(self, points: Array) -> Array:
        size = np.linalg.norm(self._gradient(points), axis=-1)
        return np.asarray(self._level(points) / size)

    def _normals(self, points: Array) -> Array:
        gradient = self._gradient(points)
        return np.asarray(gradient / np.linalg.norm(gradient, axis=-1, keepdims=True))

    def _slopes(self, points: Array) -> Array:
        return self.base._slopes(points)

    def _curvature(self, points: Array) -> Array:
        return self.base._curvature(points)

    def _feet(self, points: Array) -> Array:
        """Where points (n, 3) are seen on the base."""
        distance = self.base.signed_distance(points)[:, None]
        return np.asarray(points - distance * self.base.outward_normals(points))

    def _level(self, points: Array) -> Array:
        """F (...)."""
        feet = self._feet(points.reshape(-1, 3))
        added = np.empty(len(feet))
        for part in _parts(len(feet)):
            added[part] = self._kernel(feet[part], self.support.place) @ self._weights
        return np.asarray(self.base.signed_distance(points) + added.reshape(points.shape[:-1]))

    def _gradient(self, points: Array) -> Array:
        """∇f (..., 3)."""
        step = _STEP * self.length
        steps = step * np.eye(3)
        ahead, back = (self._level(points[..., None, :] + sign * steps) for sign in (1.0, -1.0))
        return np.asarray((ahead - back) / (2.0 * step))

    def _kernel(self, first: Array, second: Array) -> Array:
        """Covariances (n, m) of the deviations at places (n, 3) and (m, 3)."""
        far = np.sqrt(5.0) / self.length * cdist(first, second)
        free = self.amplitude**2 * (1.0 + far + far**2 / 3.0) * np.exp(-far)
        slopes = self.base._slopes(first), self.base._slopes(second)
        return np.asarray(free + (slopes[0] * self._loose) @ slopes[1].T)

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
            That of the base, with this surface's ``surface_distance`` and ``inlier``, and what it
            is made from: ``support_point``, ``support_value``, ``support_variance``,
            ``shape_amplitude``, ``shape_length``; attributes ``shape`` and ``base``.
        """
        base = replace(
            self.base,
            residuals=self.residuals,
            inliers=self.inliers,
            chi_squared=self.chi_squared,
            equations=self.equations,
        )
        data = base.to_dataset(dims, shape, coords)
        rows: dict[str, tuple[tuple[str, ...], Any]] = {
            "support_point": (("support", "space"), self.support.place),
            "support_value": (("support",), self.support.value),
            "support_variance": (("support",), self.support.variance),
            "shape_amplitude": ((), self.amplitude),
            "shape_length": ((), self.length),
        }
        made = {name: (d, values, attributes(name)) for name, (d, values) in rows.items()}
        return data.assign(made).assign_attrs(shape=self.kind, base=self.base.kind)


def _parts(count: int) -> list[slice]:
    """Rows to be done at once, so that what is between does not fill the memory."""
    return [slice(start, start + _AT_ONCE) for start in range(0, count, _AT_ONCE)]
