"""Smooth surface of arbitrary shape through contact points, with its uncertainty.

Contacts cover an object partially and unevenly, and their errors differ by a factor of a hundred.
The surface is therefore modelled as a smooth deviation from the simple shape that fits best (plane,
sphere or cylinder, with signed distance d₀): the zero set of

    f(x) = d₀(x) + g(x₀),

where x₀ is the foot of x on the simple shape and g a Gaussian process in space with covariance

    a² (1 + r + r²/3) exp(−r) + ∂d₀/∂θ · B · ∂d₀/∂θ′,    r = √5 |x − x′| / ℓ:

smooth deviations (Matérn 5/2) of amplitude a and length ℓ, with the simple shape's parameters θ
left free (universal kriging): B is diagonal, the points' extent squared for lengths, one for
directions.

Each contact states that f is zero at the point p − ρ n of the surface, with the variance ∇f·Σ∇f of
its error normal to the surface, so that errors along it matter in proportion to its slope (as in
McHutchon & Rasmussen, NIPS 2011). Away from all contacts g returns to zero and its standard
deviation to a and more: the simple shape, with a corresponding uncertainty. This is why the
deviation is modelled and not the signed distance itself, which would be arbitrary far from the
points. Because g is evaluated at the foot, the gradient of f along the base's normals is one. With
g at x itself, g = −d₀ would explain all contacts, which are on the surface only, without defining a
surface. With positions in space as inputs, the surface may close around a cylinder or a sphere
without a seam.

**The fit** determines the base, the deviation from it, and the amplitude and length.

Amplitude a and length ℓ maximise the likelihood within bounds. a is at least a tenth of the points'
extent, or of the radius of the base if that is smaller, even if no deviation is seen: that an
object is cylindrical where it was touched does not mean that it is so elsewhere. ℓ is between a
tenth of that size and that size. The cost grows with the third power of the number of points; at
most 600 are used, after merging neighbours, and 200 for a and ℓ.

A contact with a residual of more than four standard deviations is an outlier: at first relative to
the median of its neighbours, then to the surface, in both cases scaled by the others' scatter.

Normals help to find the base and the location of contacts on it. A contact point is often poorly
known along the surface (0.1 to 1 mm) and its normal well (10 mrad, on a peg some 10 µm of its
circumference). With N, T and H normal, tangents and curvature of the base at x₀, the surface is at
a height h above it at the offset τ from x₀, where

    Tᵀ (p − ρ n − x₀) = τ,    N·(p − ρ n − x₀) = h,    Tᵀ (n − N) = TᵀHT τ − ∇h,

with the errors of p and n, and the unknown slope ∇h of the surface as a further error of n. These
equations are solved by weighted least squares, and x₀ is moved until τ is zero. Without normals x₀
is the foot of the point.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.contour.fit import TO_SIGMA, fit_shape
from vibrissa.contour.fitted_shape import (
    FLOOR,
    FittedShape,
    check_complete,
    check_contacts,
    excess_of,
    rows_of,
)
from vibrissa.contour.simple_shapes import SHAPES, SimpleShape, frame_across
from vibrissa.deferred import linalg, spatial
from vibrissa.numerics import Array, Mask
from vibrissa.quantities import attributes

_BLOCK = 4096  # number of rows processed at a time, which limits the memory
_STEP = 1e-4  # step of finite differences, over the length
_FINER = 0.9  # ratio of the edges of successive cubes in which neighbours are merged
_FINEST = 1e-3  # edge of the smallest cubes, over the points' extent


class Support(NamedTuple):
    """Values (n,) that determine a surface, at positions (n, 3), with variances (n,)."""

    position: Array
    value: Array
    variance: Array


def merge_neighbours(support: Support, most: int) -> Support:
    """Merge neighbours until at most ``most`` values are left.

    Space is divided into cubes with the smallest edge for which at most that many are occupied. The
    values in a cube are replaced by their mean at the mean position, weighted by inverse variances,
    assuming that the surface is smooth on this scale; its variance is that of the weighted mean.
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
    """Index of the occupied cube of each position."""
    cube = np.floor(position / edge).astype(np.int64)
    return np.unique(cube, axis=0, return_inverse=True)[1].reshape(-1)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class FreeFit(FittedShape):
    """A fitted smooth surface, in the frame of the points.

    Attributes
    ----------
    base : CylinderFit, SphereFit or PlaneFit
        Simple shape from which the surface deviates.
    support : Support
        Positions (n, 3) on the base, m, values (n,) of the deviation, which is added to the base's
        signed distance, m, and their variances, m².
    amplitude : float
        Prior standard deviation of the deviation, m.
    length : float
        Length scale of the deviation, m.
    covariance : array (k, k)
        Covariance of the base's parameters.
    inliers : array (n,) of bool
        Points within four standard deviations.
    chi_squared : array (n,)
        Squared distances of the points used, over the sum of their variance and the surface's.
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
        object.__setattr__(self, "_weights", linalg.cho_solve((root, True), value))

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the base's parameters."""
        return self.base.parameters

    def __repr__(self) -> str:
        return (
            f"<free surface over {len(self.support.value)} positions, "
            f"{self.amplitude * 1e3:.3f} mm in {self.length * 1e3:.3f} mm about {self.base!r}>"
        )

    def deviation(self, points: ArrayLike) -> tuple[Array, Array]:
        """Compute the deviation, which is added to the base's signed distance.

        Parameters
        ----------
        points : array_like (..., 3)
            Points in the frame of the fit, m.

        Returns
        -------
        mean, sigma : array (...)
            Mean of the deviation, m, negative where the surface is outside the base, and its
            standard deviation, m.
        """
        p = np.asarray(points, dtype=np.float64)
        rows = self._feet(p.reshape(-1, 3))
        mean, variance = np.empty(len(rows)), np.empty(len(rows))
        for part in _row_blocks(len(rows)):
            shared = self._kernel(rows[part], self.support.position)
            mean[part] = shared @ self._weights
            explained = linalg.solve_triangular(self._root, shared.T, lower=True)
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
        for part in _row_blocks(len(feet)):
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

    def _parameter_variables(self) -> tuple[dict[str, Any], dict[str, Any]]:
        rows: dict[str, tuple[tuple[str, ...], Any]] = {
            "support_point": (("support", "space"), self.support.position),
            "support_value": (("support",), self.support.value),
            "support_variance": (("support",), self.support.variance),
            "shape_amplitude": ((), self.amplitude),
            "shape_length": ((), self.length),
        }
        own = {name: (dims, values, attributes(name)) for name, (dims, values) in rows.items()}
        return self.base._parameter_variables()[0] | own, {"base": self.base.kind}

    @classmethod
    def _from_dataset(cls, dataset: xr.Dataset) -> Self:
        kind = dataset.attrs.get("base")
        if kind not in SHAPES:
            raise ValueError(
                f"a free surface deviates from {kind!r}; {', '.join(SHAPES)} are known"
            )
        support = ("support_point", "support_value", "support_variance")
        check_complete(dataset, cls.kind, {*support, "shape_amplitude", "shape_length"})
        base = SHAPES[kind]._from_dataset(dataset)
        return cls(
            base=base,
            support=Support(*(dataset[name].values for name in support)),
            amplitude=float(dataset["shape_amplitude"]),
            length=float(dataset["shape_length"]),
            covariance=base.covariance,
            **rows_of(dataset),
        )


def shape_from_dataset(dataset: xr.Dataset) -> FittedShape:
    """Restore a fitted shape from its dataset.

    Parameters
    ----------
    dataset : xarray.Dataset
        Dataset from ``FittedShape.to_dataset``.

    Returns
    -------
    CylinderFit, SphereFit, PlaneFit or FreeFit
        Restored shape, with flattened residuals and inliers.
    """
    kinds: dict[str, type[FittedShape]] = {**SHAPES, FreeFit.kind: FreeFit}
    kind = dataset.attrs.get("shape")
    if kind not in kinds:
        raise ValueError(f"the shape is {kind!r}; it must be one of {', '.join(kinds)}")
    return kinds[kind]._from_dataset(dataset)


def _row_blocks(count: int) -> list[slice]:
    """Blocks of rows that are processed together."""
    return [slice(start, start + _BLOCK) for start in range(0, count, _BLOCK)]


# Largest deviation from a base, over the least deviation from simpler ones, at which it is chosen.
# Where a sphere fits, a plane fits as well only if the object is flat; a cylinder must fit well,
# because an object with rounded ends does not deviate smoothly from one.
_BETTER = {"plane": 1.0, "sphere": 0.9, "cylinder": 0.5}
_MOST = 0.95  # quantile of the contacts' deviations that is compared
# Bounds of amplitude and length, over the smaller of the points' extent and the base's radius.
_AMPLITUDES = (0.1, 2.0)
_LENGTHS = (0.1, 1.0)
_FOR_BOUNDS = 200  # largest number of positions from which amplitude and length are estimated
_OUTLIER = 4.0  # residual, in standard deviations, above which a contact is an outlier
# Standard deviation, over radius or extent, above which contacts are not used. A contact that is
# displaced far along a round surface is displaced mostly by its error, and always outward.
_PRECISE = 0.1
_FEW = 50  # number of most precise contacts used if fewer are left, or less than a quarter
# Standard deviation of the surface's slope relative to its base: initial and least value.
_SLOPE, _LEAST_SLOPE = 0.2, 0.02
_NEIGHBOURS = 9  # number of contacts in the median by which outliers are found at first
_ROUNDS = 2  # number of fits of the deviation, each with the slope of the previous one
_PLACING_ROUNDS = 5  # number of moves of a contact's foot toward zero offset
# Bounds of the noise variance in excess of the covariances, over the extent squared.
_NOISES = (1e-10, 1e-2)
_FLOOR = 1e-9  # standard deviation, m, of a contact that is stated to be exact
_TINY = 1e-12  # smallest standard deviation of a distance, m


def fit_free(
    points: ArrayLike,
    covariance: ArrayLike | None = None,
    whisker_radius: ArrayLike | None = None,
    *,
    base: str | None = None,
    most: int = 600,
    **contacts: Any,
) -> FreeFit:
    """Fit a smooth surface of arbitrary shape to contact points on parts of it.

    Parameters
    ----------
    points : array_like (n, 3)
        Contact points on the whisker's centreline, m, in any common frame; rows with NaN are
        ignored.
    covariance : array_like (n, 3, 3), optional
        Covariance of each point, m².
    whisker_radius : array_like (n,) or float, optional
        Radius of the whisker at each contact, m; 0 by default.
    base : {"plane", "sphere", "cylinder"}, optional
        Simple shape from which the surface deviates; by default the simplest from which less simple
        ones do not fit much better.
    most : int
        Largest number of positions to which the points are merged; the time grows with its third
        power.
    **contacts
        Further properties of the contacts: normals, normal_covariance and point_normal_covariance,
        as for `fit_shape`.

    Returns
    -------
    FreeFit
        Surface with its uncertainty.

    Raises
    ------
    ValueError
        If shapes are wrong, if there are fewer than 6 points, if a covariance is invalid, if the
        base is unknown, or if the points do not determine it, such as points on a line.
    """
    if base is not None and base not in SHAPES:
        raise ValueError(f"base is {base!r}; it must be one of {', '.join(SHAPES)}")
    if most < 6:
        raise ValueError(f"most is {most}; at least 6 positions are needed")
    contacts["covariance"], contacts["whisker_radius"] = covariance, whisker_radius
    given = check_contacts("surface", points, least=6, **contacts)
    # Rows that cannot be used for the base cannot be used for the deviation either.
    rows = np.flatnonzero(given.usable)
    known = {name: v for name, v in contacts.items() if name != "whisker_radius" and v is not None}
    picked = {name: np.asarray(v, dtype=np.float64)[rows] for name, v in known.items()}
    p = np.asarray(points, dtype=np.float64)[rows]
    radius = given.touches.whisker_radius * given.extent
    shape = _select_base(p, radius, picked, (base,) if base else tuple(SHAPES))
    touches = given.touches
    normal = shape.outward_normals(p) if touches.normal is None else touches.normal
    spread = np.zeros((len(p), 3, 3)) if touches.covariance is None else touches.covariance
    unit = np.repeat([given.extent, 1.0], 3)[: spread.shape[1]]
    touched = _Contacts(p - radius[:, None] * normal, touches.normal, spread * unit[:, None] * unit)
    fit, squares, sharp = _fit_deviation(shape, touched, given.extent, most)
    residuals, chi_squared = np.full((2, given.usable.size), np.nan)
    residuals[rows] = fit.signed_distance(p) - radius
    chi_squared[rows] = np.where(sharp, squares, np.nan)
    inliers = np.zeros(given.usable.size, dtype=bool)
    inliers[rows] = squares < _OUTLIER**2 * max(1.0, excess_of(squares[sharp], 1))
    return replace(
        fit,
        residuals=residuals,
        inliers=inliers,
        chi_squared=chi_squared,
        equations=0 if touches.covariance is None else 1,
    )


def _select_base(
    points: Array, radius: Array, known: dict[str, Array], kinds: tuple[str, ...]
) -> SimpleShape:
    """The simplest shape from which less simple ones do not fit much better."""
    best, least, fault = None, np.inf, ""
    # For an object of another shape, points and normals may contradict each other.
    alone = {name: v for name, v in known.items() if name == "covariance"}
    for kind, given in ((kind, given) for kind in kinds for given in (known, alone)):
        if given is alone and len(known) == len(alone):
            continue
        try:
            fit = fit_shape(kind, points, whisker_radius=radius, **given)
        except ValueError as error:
            fault = str(error)
            continue
        sigma = np.ones(len(points))
        if "covariance" in known:
            sigma = np.maximum(
                _sigma_along(fit.outward_normals(points), known["covariance"]), _TINY
            )
        miss = float(np.quantile(np.abs(fit.residuals) / sigma, _MOST))
        if miss < _BETTER[kind] * least:
            best, least = fit, miss
    if best is None:
        raise ValueError(f"no surface: {fault}")
    if best.kind == "plane" and "normals" in known:
        turned = float(np.median(known["normals"] @ best.outward_normals(points[:1])[0]))
        if turned < 0.0:
            best = fit_shape("plane", points, known.get("covariance"), radius, known["normals"])
    return best


def _sigma_along(normal: Array, covariance: Array) -> Array:
    """Standard deviations (n,) along normals."""
    variance = np.einsum("ni,nij,nj->n", normal, covariance, normal)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _fit_deviation(
    base: SimpleShape, contacts: _Contacts, extent: float, most: int
) -> tuple[FreeFit, Array, Mask]:
    """Fit the deviation from a base repeatedly, with its slopes and without outliers."""
    scale = min(extent, float(getattr(base, "radius", np.inf)))
    slope, inside, fit = _SLOPE, None, None
    for _ in range(_ROUNDS):
        there = _place_contacts(base, contacts, slope)
        known = _is_precise(there.covariance, scale)
        bent = base._curvature(there.foot) @ there.covariance
        # A point that is scattered along a curved surface is farther out on average.
        value = 0.5 * np.trace(bent, axis1=1, axis2=2) - there.height
        normal = (base if fit is None else fit).outward_normals(there.foot)
        variance = _sigma_along(normal, there.covariance) ** 2 + (FLOOR * extent) ** 2
        variance = variance + 0.5 * np.einsum("nij,nji->n", bent, bent)
        if inside is None:
            inside = _agrees_with_neighbours(there.foot, value, variance)
        rows = known & inside
        support = Support(there.foot[rows], value[rows], variance[rows])
        amplitude, length, noise = _fit_hyperparameters(
            merge_neighbours(support, min(_FOR_BOUNDS, most)), scale
        )
        few = merge_neighbours(support._replace(variance=support.variance + noise), most)
        fit = FreeFit(
            covariance=base.covariance, base=base, support=few, amplitude=amplitude, length=length
        )
        mean, unsure = fit.deviation(there.foot)
        miss = np.abs(value - mean) / np.sqrt(variance + unsure**2)
        usual = max(1.0, TO_SIGMA * float(np.median(miss[known])))
        inside = np.asarray(miss < _OUTLIER * usual)
        slope = max(_LEAST_SLOPE, np.sqrt(5.0 / 3.0) * amplitude / length)
    assert fit is not None
    return fit, miss**2, known


def _is_precise(covariance: Array, scale: float) -> Mask:
    """Whether contacts are precisely located, or at least more precisely than most."""
    widest = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1].clip(0.0))
    enough = min(len(widest), max(_FEW, len(widest) // 4))
    return np.asarray(widest <= max(_PRECISE * scale, np.sort(widest)[enough - 1]))


def _agrees_with_neighbours(position: Array, value: Array, variance: Array) -> Mask:
    """Whether contacts are close to the median of their neighbours."""
    _, near = spatial.cKDTree(position).query(position, min(_NEIGHBOURS, len(position)))
    away = value - np.median(value[near], axis=1)
    usual = TO_SIGMA * float(np.median(np.abs(away)))
    return np.asarray(np.abs(away) < _OUTLIER * np.sqrt(variance + usual**2))


def _fit_hyperparameters(support: Support, scale: float) -> tuple[float, float, float]:
    """Estimate amplitude and length, m, and the noise variance in excess of covariances, m²."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

    squares = (_AMPLITUDES[0] ** 2, _AMPLITUDES[1] ** 2)
    best, most = None, -np.inf
    for start in _LENGTHS:
        kernel = ConstantKernel(squares[0] * 4.0, squares) * Matern(start, _LENGTHS, nu=2.5)
        process = GaussianProcessRegressor(
            kernel + WhiteKernel(1e-6, _NOISES), alpha=support.variance / scale**2
        )
        with warnings.catch_warnings():
            # Amplitudes and lengths at their bounds are expected.
            warnings.simplefilter("ignore", ConvergenceWarning)
            process.fit(support.position / scale, support.value / scale)
        likelihood = float(process.log_marginal_likelihood_value_)
        if likelihood > most:
            best, most = process.kernel_, likelihood
    assert best is not None
    amplitude = float(np.sqrt(best.k1.k1.constant_value)) * scale
    return (
        amplitude,
        float(best.k1.k2.length_scale) * scale,
        float(best.k2.noise_level) * scale**2,
    )


class _Contacts(NamedTuple):
    """Usable contacts in SI units: points of the surface, normals, covariances."""

    surface: Array
    normal: Array | None
    covariance: Array


class _PlacedContacts(NamedTuple):
    """Contacts on a simple shape: feet, heights above them, and covariances."""

    foot: Array
    height: Array
    covariance: Array


def _place_contacts(base: SimpleShape, contacts: _Contacts, slope: float) -> _PlacedContacts:
    """Determine the feet of contacts on a simple shape, and their heights."""
    p = contacts.surface
    foot = p - base.signed_distance(p)[:, None] * base.outward_normals(p)
    for _ in range(1 if contacts.normal is None else _PLACING_ROUNDS):
        normal = base.outward_normals(foot)
        axes = _axes(normal)
        seen, design, spread = _equations(base, contacts, foot, axes, slope)
        weight = np.linalg.inv(spread)
        turned = np.swapaxes(design, 1, 2) @ weight
        covariance = np.linalg.inv(turned @ design)
        offset = (covariance @ turned @ seen[..., None])[..., 0]
        moved = foot + np.einsum("ni,nij->nj", offset[:, :2], axes[:, :2])
        # The foot must be on the shape; the height was computed above the tangent plane.
        foot = moved - base.signed_distance(moved)[:, None] * base.outward_normals(moved)
    height = np.einsum("ni,ni->n", p - foot, base.outward_normals(foot))
    if contacts.normal is None:
        return _PlacedContacts(foot, height, contacts.covariance)
    # The height above the final foot is that of the last round.
    bent = np.einsum("ni,nij,nj->n", offset[:, :2], _bending(base, foot, axes), offset[:, :2])
    height = offset[:, 2] + 0.5 * bent
    return _PlacedContacts(foot, height, np.swapaxes(axes, 1, 2) @ covariance @ axes)


def _equations(
    base: SimpleShape, contacts: _Contacts, foot: Array, axes: Array, slope: float
) -> tuple[Array, Array, Array]:
    """Measurements (n, m), derivatives by offset and height (n, m, 3), and covariance."""
    n = len(foot)
    seen = np.einsum("nij,nj->ni", axes, contacts.surface - foot)
    design = np.broadcast_to(np.eye(3), (n, 3, 3))
    if contacts.normal is None:
        spread = axes @ contacts.covariance @ np.swapaxes(axes, 1, 2)
        return seen, design, spread + _FLOOR**2 * np.eye(3)
    across = axes[:, :2]
    turned = np.einsum("nij,nj->ni", across, contacts.normal)
    bending = np.concatenate([_bending(base, foot, axes), np.zeros((n, 2, 1))], axis=2)
    by = np.zeros((n, 5, 6))
    by[:, :3, :3], by[:, 3:, 3:] = axes, across
    if contacts.covariance.shape[1] == 3:
        by = by[:, :, :3]
    spread = by @ contacts.covariance @ np.swapaxes(by, 1, 2)
    spread = spread + np.diag([_FLOOR**2] * 3 + [slope**2] * 2)
    return (
        np.concatenate([seen, turned], axis=1),
        np.concatenate([design, bending], axis=1),
        spread,
    )


def _bending(base: SimpleShape, foot: Array, axes: Array) -> Array:
    """Curvature (n, 2, 2) along the two tangents."""
    across = axes[:, :2]
    return np.asarray(across @ base._curvature(foot) @ np.swapaxes(across, 1, 2))


def _axes(normal: Array) -> Array:
    """Two tangents and the normal, in rows, (n, 3, 3)."""
    return np.concatenate([frame_across(normal), normal[:, None]], axis=1)
