"""Contacts to a free surface: its base, what deviates from it, and how far and fast that varies.

a and ℓ maximise the likelihood within bounds. a is at least a tenth of the points' extent, or of
the radius of the base if that is smaller, even if no deviation is seen: that an object is a
cylinder where it was touched does not say that it is one elsewhere. ℓ is at most that size, and no
less than a tenth of it. Normals help to find the base, and to tell where on it the contacts are
(`vibrissa.contour.placing`).

The cost grows with the third power of the number of points; at most 600 are used, neighbours being
merged (`vibrissa.contour.merging`), 200 for a and ℓ.

A contact that is missed by more than four standard deviations is an outlier: at first by the median
of its neighbours, then by the surface, and in both cases by how far the others scatter.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from vibrissa.contour.cylinder import fit_cylinder
from vibrissa.contour.free import FreeFit
from vibrissa.contour.goodness import excess_of
from vibrissa.contour.merging import Support, merged
from vibrissa.contour.placing import Contacts, placed
from vibrissa.contour.plane import fit_plane
from vibrissa.contour.shape import FittedShape
from vibrissa.contour.sphere import fit_sphere
from vibrissa.contour.touches import FLOOR, Array, Mask, checked

BASES = ("plane", "sphere", "cylinder")
"""What a free surface may deviate from, the simpler first."""

_FITS: dict[str, Callable[..., FittedShape]] = {
    "plane": fit_plane,
    "sphere": fit_sphere,
    "cylinder": fit_cylinder,
}

_BETTER = {"plane": 1.0, "sphere": 0.9, "cylinder": 0.5}
"""How much smaller than those from simpler bases deviations must be for a base to be taken.

Where a sphere goes, a plane is no worse only if the object is flat; a cylinder must fit, as what is
round at its ends does not deviate smoothly from one.
"""

_MOST = 0.95
"""Share of the contacts that these deviations are not exceeded by."""

_AMPLITUDES = (0.1, 2.0)
_LENGTHS = (0.1, 1.0)
"""Bounds of amplitude and length, as shares of the points' extent or the base's radius."""

_FOR_BOUNDS = 200
_OUTLIER = 4.0
_SHARP = 0.1
"""Standard deviation, as a share of radius and extent, up to which contacts are used.

What is seen far along a round surface mostly is there by error, and always outside of it.
"""

_FEW = 50
"""If that leaves fewer, or less than a quarter, as many of the sharpest are used."""

_SLOPE, _LEAST_SLOPE = 0.2, 0.02
"""Standard deviation of the surface's slope against its base, at first and at least."""

_NEIGHBOURS = 9
_ROUNDS = 2

_NOISES = (1e-10, 1e-2)
"""Bounds of the variance of what no covariance tells, in units of the extent squared."""

_TINY = 1e-12
_TO_SIGMA = 1.4826


def fit_free(
    points: ArrayLike,
    covariance: ArrayLike | None = None,
    whisker_radius: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    normal_covariance: ArrayLike | None = None,
    point_normal_covariance: ArrayLike | None = None,
    base: str | None = None,
    most: int = 600,
) -> FreeFit:
    """Fit a smooth surface of any shape to contact points on parts of it.

    Parameters
    ----------
    points : array_like (n, 3)
        Contact points on the whisker's centreline, m, in any one frame; rows with NaN are left out.
    covariance : array_like (n, 3, 3), optional
        Of each point, m². Without it all points count the same, and their scatter tells the noise.
    whisker_radius : array_like (n,) or float, optional
        Of the whisker at each contact, m; 0 by default.
    normals : array_like (n, 3), optional
        Outward normals of the surface at the contacts, such as the directions of the contact
        forces; of any length but zero.
    normal_covariance : array_like (n, 3, 3), optional
        Of each unit normal.
    point_normal_covariance : array_like (n, 3, 3), optional
        Of each point (rows) with its unit normal (columns), m; none by default.
    base : {"plane", "sphere", "cylinder"}, optional
        What the surface deviates from; by default the simplest from which less simple ones are
        not much nearer to the points.
    most : int
        To how many places the points are merged at most; the time grows with the third power.

    Returns
    -------
    FreeFit
        The surface with its uncertainty.

    Raises
    ------
    ValueError
        If shapes are wrong, if there are fewer than 6 points, if a covariance is none, if the base
        is unknown, or if the points determine none, as on a line.
    """
    if base is not None and base not in BASES:
        raise ValueError(f"base is {base!r}; one of {', '.join(BASES)} is known")
    if most < 6:
        raise ValueError(f"most is {most}; at least 6 places are needed")
    given = checked(
        "surface",
        points,
        covariance,
        whisker_radius,
        normals,
        normal_covariance,
        point_normal_covariance,
        least=6,
    )
    # Rows that are not usable for the base are not usable for what deviates from it.
    rows = np.flatnonzero(given.usable)
    known = {
        "covariance": covariance,
        "normals": normals,
        "normal_covariance": normal_covariance,
        "point_normal_covariance": point_normal_covariance,
    }
    picked = {n: np.asarray(v, dtype=np.float64)[rows] for n, v in known.items() if v is not None}
    p = np.asarray(points, dtype=np.float64)[rows]
    radius = given.touches.whisker_radius * given.extent
    shape = _base(p, radius, picked, (base,) if base else BASES)
    touches = given.touches
    normal = shape.outward_normals(p) if touches.normal is None else touches.normal
    spread = np.zeros((len(p), 3, 3)) if touches.covariance is None else touches.covariance
    unit = np.repeat([given.extent, 1.0], 3)[: spread.shape[1]]
    contacts = Contacts(p - radius[:, None] * normal, touches.normal, spread * unit[:, None] * unit)
    fit, squares, sharp = _surface(shape, contacts, given.extent, most)
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
) -> FittedShape:
    """The simplest shape from which less simple ones are not much nearer to the points."""
    best, least, said = None, np.inf, ""
    # On an object of another shape points and normals may contradict each other.
    alone = {name: v for name, v in known.items() if name == "covariance"}
    for kind, given in ((kind, given) for kind in kinds for given in (known, alone)):
        if given is alone and len(known) == len(alone):
            continue
        try:
            fit = _FITS[kind](points, whisker_radius=radius, **given)
        except ValueError as error:
            said = str(error)
            continue
        sigma = np.ones(len(points))
        if "covariance" in known:
            sigma = np.maximum(_across(fit.outward_normals(points), known["covariance"]), _TINY)
        miss = float(np.quantile(np.abs(fit.residuals) / sigma, _MOST))
        if miss < _BETTER[kind] * least:
            best, least = fit, miss
    if best is None:
        raise ValueError(f"no surface: {said}")
    if best.kind == "plane" and "normals" in known:
        turned = float(np.median(known["normals"] @ best.outward_normals(points[:1])[0]))
        if turned < 0.0:
            best = fit_plane(points, known.get("covariance"), radius, known["normals"])
    return best


def _across(normal: Array, covariance: Array) -> Array:
    """Standard deviations (n,) along normals."""
    variance = np.einsum("ni,nij,nj->n", normal, covariance, normal)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _surface(
    base: FittedShape, contacts: Contacts, extent: float, most: int
) -> tuple[FreeFit, Array, Mask]:
    """Fit the deviation from a base, again and again: with its slopes, without outliers.

    Also gives the squared misses (n,), in standard deviations, and which contacts were used.
    """
    scale = min(extent, _size(base))
    slope, inside, fit = _SLOPE, None, None
    for _ in range(_ROUNDS):
        there = placed(base, contacts, slope)
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
        fit = _made(base, few, amplitude, length)
        mean, unsure = fit.deviation(there.foot)
        miss = np.abs(value - mean) / np.sqrt(variance + unsure**2)
        usual = max(1.0, _TO_SIGMA * float(np.median(miss[known])))
        inside = np.asarray(miss < _OUTLIER * usual)
        slope = max(_LEAST_SLOPE, np.sqrt(5.0 / 3.0) * amplitude / length)
    assert fit is not None
    return fit, miss**2, known


def _sharp(covariance: Array, scale: float) -> Mask:
    """Contacts whose place is known well, or at least better than that of most."""
    widest = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1].clip(0.0))
    enough = min(len(widest), max(_FEW, len(widest) // 4))
    return np.asarray(widest <= max(_SHARP * scale, np.sort(widest)[enough - 1]))


def _like_neighbours(place: Array, value: Array, variance: Array) -> Mask:
    """Contacts that are not far from the median of those about them."""
    _, near = cKDTree(place).query(place, min(_NEIGHBOURS, len(place)))
    away = value - np.median(value[near], axis=1)
    usual = _TO_SIGMA * float(np.median(np.abs(away)))
    return np.asarray(np.abs(away) < _OUTLIER * np.sqrt(variance + usual**2))


def _size(base: FittedShape) -> float:
    return float(getattr(base, "radius", np.inf))


def _made(base: FittedShape, support: Support, amplitude: float, length: float) -> FreeFit:
    """A surface, as yet without residuals."""
    return FreeFit(
        covariance=base.covariance,
        residuals=np.empty(0),
        inliers=np.empty(0, dtype=bool),
        chi_squared=np.empty(0),
        equations=0,
        base=base,
        support=support,
        amplitude=amplitude,
        length=length,
    )


def _varying(support: Support, scale: float) -> tuple[float, float, float]:
    """Amplitude and length, m, and the variance of what no covariance tells, m²."""
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
            # That a bound is reached is what bounds are for.
            warnings.simplefilter("ignore", ConvergenceWarning)
            process.fit(support.place / scale, support.value / scale)
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
