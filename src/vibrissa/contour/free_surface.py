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

**The fit** determines the base, the deviation from it, and how far and fast that varies.

Amplitude a and length ℓ maximise the likelihood within bounds. a is at least a tenth of the points'
extent, or of the radius of the base if that is smaller, even if no deviation is seen: that an
object is a cylinder where it was touched does not mean that it is one elsewhere. ℓ is at most that
size, and no less than a tenth of it. The cost grows with the third power of the number of points;
at most 600 are used, neighbours being merged, 200 for a and ℓ.

A contact that is missed by more than four standard deviations is an outlier: at first by the median
of its neighbours, then by the surface, and in both cases by how far the others scatter.

Normals help to find the base and the location of contacts on it. A contact point is often known
badly along the surface (0.1 to 1 mm) and its normal well (10 mrad, on a peg some 10 µm of its
circumference). With N, T and H normal, tangents and curvature of the base at x₀, the surface is at
a height h above it at the offset τ from x₀, where

    Tᵀ (p − ρ n − x₀) = τ,    N·(p − ρ n − x₀) = h,    Tᵀ (n − N) = TᵀHT τ − ∇h,

with the errors of p and n, and the unknown slope ∇h of the surface as one more error of n. Solved
by weighted least squares, x₀ being moved until τ is zero. Without normals it is the foot of the
point.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple, Self, Unpack

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.contour.fit import TO_SIGMA, fit_shape
from vibrissa.contour.fitted_shape import (
    FLOOR,
    ContactArrays,
    FittedShape,
    check_complete,
    checked,
    excess_of,
    rows_of,
)
from vibrissa.contour.simple_shapes import SHAPES, SimpleShape, frame_across
from vibrissa.deferred import linalg, spatial
from vibrissa.numerics import Array, Mask
from vibrissa.quantities import attributes

_AT_ONCE = 4096  # rows that are done at once, so that intermediate arrays do not fill the memory
_STEP = 1e-4  # step of differences, as a share of the length
_FINER = 0.9  # edge of the next smaller cubes that neighbours are merged in
_FINEST = 1e-3  # edge of the smallest cubes, as a share of the points' extent


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


# Largest deviations from a base, as a share of those from simpler ones, for it to be chosen. Where
# a sphere fits, a plane is no worse only if the object is flat; a cylinder must fit well, as an
# object that is round at its ends does not deviate smoothly from one.
_BETTER = {"plane": 1.0, "sphere": 0.9, "cylinder": 0.5}
_MOST = 0.95  # share of the contacts whose deviations are at most these
# Bounds of amplitude and length, as shares of the points' extent or the base's radius.
_AMPLITUDES = (0.1, 2.0)
_LENGTHS = (0.1, 1.0)
_FOR_BOUNDS = 200  # number of positions that amplitude and length are estimated from, at most
_OUTLIER = 4.0  # miss, in standard deviations, from which a contact is an outlier
# Standard deviation, as a share of radius and extent, up to which contacts are used. A contact far
# along a round surface is mostly there by error, and always outside of it.
_SHARP = 0.1
_FEW = 50  # number of the sharpest contacts to use if fewer are left, or less than a quarter
# Standard deviation of the surface's slope against its base, at first and at least.
_SLOPE, _LEAST_SLOPE = 0.2, 0.02
_NEIGHBOURS = 9  # number of contacts whose median an outlier is found by at first
_ROUNDS = 2  # number of times that the deviation is fitted, with the slope of the fit before
_PLACING_ROUNDS = 5  # largest number of moves of a contact's foot until its offset is zero
# Bounds of the variance that no covariance contains, in units of the extent squared.
_NOISES = (1e-10, 1e-2)
_FLOOR = 1e-9  # standard deviation, m, of a contact that is stated to be exact
_TINY = 1e-12  # standard deviation, m, of a distance at least


def fit_free(
    points: ArrayLike, base: str | None = None, most: int = 600, **contacts: Unpack[ContactArrays]
) -> FreeFit:
    """Fit a smooth surface of any shape to contact points on parts of it.

    Parameters
    ----------
    points : array_like (n, 3)
        Contact points on the whisker's centreline, m, in any one frame; rows with NaN are left out.
    base : {"plane", "sphere", "cylinder"}, optional
        Simple shape that the surface deviates from; by default the simplest from which less simple
        ones are not much nearer to the points.
    most : int
        Number of positions that the points are merged to at most; the time grows with the third
        power.
    **contacts
        covariance, whisker_radius, normals, normal_covariance and point_normal_covariance, as for
        `fit_shape`.

    Returns
    -------
    FreeFit
        Surface with its uncertainty.

    Raises
    ------
    ValueError
        If shapes are wrong, if there are fewer than 6 points, if a covariance is none, if the base
        is unknown, or if the points determine none, as on a line.
    """
    if base is not None and base not in SHAPES:
        raise ValueError(f"base is {base!r}; it must be one of {', '.join(SHAPES)}")
    if most < 6:
        raise ValueError(f"most is {most}; at least 6 positions are needed")
    given = checked("surface", points, least=6, **contacts)
    # Rows that are not usable for the base are not usable for what deviates from it.
    rows = np.flatnonzero(given.usable)
    known = {name: v for name, v in contacts.items() if name != "whisker_radius" and v is not None}
    picked = {name: np.asarray(v, dtype=np.float64)[rows] for name, v in known.items()}
    p = np.asarray(points, dtype=np.float64)[rows]
    radius = given.touches.whisker_radius * given.extent
    shape = _base(p, radius, picked, (base,) if base else tuple(SHAPES))
    touches = given.touches
    normal = shape.outward_normals(p) if touches.normal is None else touches.normal
    spread = np.zeros((len(p), 3, 3)) if touches.covariance is None else touches.covariance
    unit = np.repeat([given.extent, 1.0], 3)[: spread.shape[1]]
    touched = _Contacts(p - radius[:, None] * normal, touches.normal, spread * unit[:, None] * unit)
    fit, squares, sharp = _with_deviation(shape, touched, given.extent, most)
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


def _base(
    points: Array, radius: Array, known: dict[str, Array], kinds: tuple[str, ...]
) -> SimpleShape:
    """The simplest shape from which less simple ones are not much nearer to the points."""
    best, least, fault = None, np.inf, ""
    # On an object of another shape points and normals may contradict each other.
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
            sigma = np.maximum(_across(fit.outward_normals(points), known["covariance"]), _TINY)
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


def _across(normal: Array, covariance: Array) -> Array:
    """Standard deviations (n,) along normals."""
    variance = np.einsum("ni,nij,nj->n", normal, covariance, normal)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _with_deviation(
    base: SimpleShape, contacts: _Contacts, extent: float, most: int
) -> tuple[FreeFit, Array, Mask]:
    """Fit the deviation from a base, again and again: with its slopes, without outliers."""
    scale = min(extent, float(getattr(base, "radius", np.inf)))
    slope, inside, fit = _SLOPE, None, None
    for _ in range(_ROUNDS):
        there = _placed(base, contacts, slope)
        known = _sharp(there.covariance, scale)
        bent = base._curvature(there.foot) @ there.covariance
        # A point that is scattered along a curved surface lies farther out in the mean.
        value = 0.5 * np.trace(bent, axis1=1, axis2=2) - there.height
        normal = (base if fit is None else fit).outward_normals(there.foot)
        variance = _across(normal, there.covariance) ** 2 + (FLOOR * extent) ** 2
        variance = variance + 0.5 * np.einsum("nij,nji->n", bent, bent)
        if inside is None:
            inside = _like_neighbours(there.foot, value, variance)
        rows = known & inside
        support = Support(there.foot[rows], value[rows], variance[rows])
        amplitude, length, noise = _varying(merged(support, min(_FOR_BOUNDS, most)), scale)
        few = merged(support._replace(variance=support.variance + noise), most)
        fit = FreeFit(
            covariance=base.covariance,
            base=base,
            support=few,
            amplitude=amplitude,
            length=length,
        )
        mean, unsure = fit.deviation(there.foot)
        miss = np.abs(value - mean) / np.sqrt(variance + unsure**2)
        usual = max(1.0, TO_SIGMA * float(np.median(miss[known])))
        inside = np.asarray(miss < _OUTLIER * usual)
        slope = max(_LEAST_SLOPE, np.sqrt(5.0 / 3.0) * amplitude / length)
    assert fit is not None
    return fit, miss**2, known


def _sharp(covariance: Array, scale: float) -> Mask:
    """Contacts whose position is known well, or at least better than that of most."""
    widest = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1].clip(0.0))
    enough = min(len(widest), max(_FEW, len(widest) // 4))
    return np.asarray(widest <= max(_SHARP * scale, np.sort(widest)[enough - 1]))


def _like_neighbours(position: Array, value: Array, variance: Array) -> Mask:
    """Contacts that are not far from the median of those about them."""
    _, near = spatial.cKDTree(position).query(position, min(_NEIGHBOURS, len(position)))
    away = value - np.median(value[near], axis=1)
    usual = TO_SIGMA * float(np.median(np.abs(away)))
    return np.asarray(np.abs(away) < _OUTLIER * np.sqrt(variance + usual**2))


def _varying(support: Support, scale: float) -> tuple[float, float, float]:
    """Amplitude and length, m, and the variance that no covariance contains, m²."""
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
    """Usable contacts, SI units: points of the surface, normals, covariances."""

    surface: Array
    normal: Array | None
    covariance: Array


class _Placed(NamedTuple):
    """Contacts on a simple shape."""

    foot: Array
    height: Array
    covariance: Array


def _placed(base: SimpleShape, contacts: _Contacts, slope: float) -> _Placed:
    """Place contacts on a simple shape."""
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
        # The location belongs to the shape; the height was found above its tangent plane.
        foot = moved - base.signed_distance(moved)[:, None] * base.outward_normals(moved)
    height = np.einsum("ni,ni->n", p - foot, base.outward_normals(foot))
    if contacts.normal is None:
        return _Placed(foot, height, contacts.covariance)
    # Given the location that was chosen, the height above it is that of the last round.
    bent = np.einsum("ni,nij,nj->n", offset[:, :2], _bending(base, foot, axes), offset[:, :2])
    height = offset[:, 2] + 0.5 * bent
    return _Placed(foot, height, np.swapaxes(axes, 1, 2) @ covariance @ axes)


def _equations(
    base: SimpleShape, contacts: _Contacts, foot: Array, axes: Array, slope: float
) -> tuple[Array, Array, Array]:
    """Measurements (n, m), their derivatives by offset and height (n, m, 3), their covariance."""
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
    """Curvature (n, 2, 2) along the tangents."""
    across = axes[:, :2]
    return np.asarray(across @ base._curvature(foot) @ np.swapaxes(across, 1, 2))


def _axes(normal: Array) -> Array:
    """Two tangents and the normal, in rows, (n, 3, 3)."""
    return np.concatenate([frame_across(normal), normal[:, None]], axis=1)
