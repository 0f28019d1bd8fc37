"""Checked contacts as used in fits, and the base class of fitted shapes.

For a fit contacts are shifted by their mean and scaled by their extent. In the laboratory frame
contacts are at x_lab = R x_whisker + o; of several candidates the one that continues its neighbours
in time is chosen.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Protocol, Self, TypedDict, Unpack

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.deferred import special
from vibrissa.numerics import AnyArray, Array, Mask, numbers, vectors
from vibrissa.quantities import QUANTITIES, attributes

# Smallest standard deviation, over the points' extent, which replaces zero noise.
FLOOR = 1e-7
# Distance from the middle of the contacts, over the largest without the farthest contacts, above
# which these are ignored; and how many they are at most, as a share.
_ASTRAY, _FARTHEST = 100.0, 0.02
# Median standard deviation of contacts, and radius of the whisker, m, above which they may be, and
# above the extent of the contacts are, in other units.
_VAGUE, _STOUT = 2e-3, 5e-3
# Extent of contacts, m, above which they may be, and extent over the whisker's radius, above both
# of which they are in other units: a whisker may have a sharp tip.
_LONG, _SLIM = 1.0, 2e4
# Smallest variance of a combination, over that of the point or normal.
_FINE = 1e-10
# Largest asymmetry of a covariance that is attributed to rounding, over its largest element.
_LOPSIDED = 1e-6
# Largest negative eigenvalue of a covariance that is attributed to rounding, over the largest.
_NEGATIVE = 1e-8
_SINGLE = 1e-5  # the same for covariances of single precision, which are only drawn


class Touches(NamedTuple):
    """Contacts in units of their extent, with normals, covariances and shared errors if known."""

    position: Array
    whisker_radius: Array
    normal: Array | None
    covariance: Array | None
    shared: Array | None = None

    def rows(self, which: Mask) -> Touches:
        """Select contacts."""
        normal = None if self.normal is None else self.normal[which]
        spread = None if self.covariance is None else self.covariance[which]
        shared = None if self.shared is None else self.shared[which]
        return Touches(self.position[which], self.whisker_radius[which], normal, spread, shared)

    @property
    def joint(self) -> bool:
        """Whether the covariance includes that of the normals."""
        return self.covariance is not None and self.covariance.shape[1] == 6

    def weights(self) -> Array:
        """Weights (n,) of the points by their total variance, at most 1."""
        if self.covariance is None:
            return np.ones(len(self.position))
        spread = np.trace(self.covariance[:, :3, :3], axis1=1, axis2=2) + FLOOR**2
        return np.asarray(spread.min() / spread)

    @property
    def point_covariance(self) -> Array | None:
        """Covariances (n, 3, 3) of the points alone."""
        return None if self.covariance is None else self.covariance[:, :3, :3]


@dataclass(frozen=True, eq=False)
class Checked:
    """Usable contacts, and the mean and extent by which they are scaled."""

    usable: Mask
    touches: Touches
    mean: Array
    extent: float


class ContactArrays(TypedDict, total=False):
    """Optional properties of contacts other than their points; see `fit_shape`."""

    covariance: ArrayLike | None
    whisker_radius: ArrayLike | None
    normals: ArrayLike | None
    normal_covariance: ArrayLike | None
    point_normal_covariance: ArrayLike | None
    shared: ArrayLike | None


def check_contacts(
    what: str, points: ArrayLike, *, least: int, **contacts: Unpack[ContactArrays]
) -> Checked:
    """Check contacts, select the usable ones, and scale them by their extent."""
    if unknown := sorted(contacts.keys() - ContactArrays.__annotations__.keys()):
        known = ", ".join(ContactArrays.__annotations__)
        raise TypeError(f"unknown property of contacts: {', '.join(unknown)}; {known} are known")
    shape = np.shape(points)
    if len(shape) != 2 or shape[1] != 3:
        raise ValueError(f"no {what}: points have shape {shape}; (n, 3) is needed")
    n = shape[0]
    given: dict[str, Any] = {"points": points, "whisker_radius": 0.0}
    given |= {name: values for name, values in contacts.items() if values is not None}
    allowed: dict[str, list[tuple[int, ...]]] = {
        "points": [(n, 3)],
        "normals": [(n, 3)],
        "whisker_radius": [(n,), ()],
    }
    arrays, faults = {}, []
    for name, values in given.items():
        arrays[name] = numbers(name, values)
        if name == "shared":
            allowed[name] = [(n, *arrays[name].shape[1:2], 6)]
        shapes = allowed.get(name, [(n, 3, 3)])
        if arrays[name].shape not in shapes:
            wanted = " or ".join(map(str, shapes))
            faults.append(f"{name} has shape {arrays[name].shape}; {wanted} is needed")
    needs = {
        "normal_covariance": ("normals", "covariance"),
        "point_normal_covariance": ("normal_covariance",),
        "shared": ("normal_covariance",),
    }
    for name, others in needs.items():
        lacking = [other for other in others if other not in arrays]
        if name in arrays and lacking:
            faults.append(f"{name} is given without {' and '.join(lacking)}")
    if (arrays["whisker_radius"] < 0.0).any():
        faults.append(f"whisker_radius is negative, {arrays['whisker_radius'].min()} m")
    if faults:
        raise ValueError(f"no {what}: " + "; ".join(faults))
    arrays["whisker_radius"] = np.broadcast_to(arrays["whisker_radius"], (n,))
    return _scale_contacts(what, arrays, n, least)


def check_variances(values: AnyArray) -> None:
    """Raise ValueError if eigenvalues (..., 3) of covariances, in ascending order, are negative."""
    if (values[..., 0] < -_SINGLE * np.abs(values).max(axis=-1)).any():
        raise ValueError("the covariance is invalid: a variance is negative")


def _scale_contacts(what: str, arrays: dict[str, Array], n: int, least: int) -> Checked:
    """Select the usable contacts and scale them."""
    usable = np.ones(n, dtype=bool)
    for values in arrays.values():
        usable &= np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    if "normals" in arrays:
        length = np.linalg.norm(arrays["normals"], axis=1)
        usable &= length > 0.0
    if usable.sum() >= least:  # one that is wildly wrong would set the scale of all others
        middle = np.median(arrays["points"][usable], axis=0)
        away = np.linalg.norm(arrays["points"] - middle, axis=1)
        # Most contacts may be at one point, where an object was touched for long.
        most = max(1, int(_FARTHEST * usable.sum()))
        reach = _ASTRAY * np.sort(away[usable])[-1 - most]
        usable &= (away <= reach) | (reach == 0.0)
    if usable.sum() < least:
        raise ValueError(f"no {what}: {usable.sum()} usable points; at least {least} are needed")
    kept = {name: values[usable] for name, values in arrays.items()}
    mean = kept["points"].mean(axis=0)
    centered = kept["points"] - mean
    extent = float(np.sqrt((centered**2).sum(axis=1).mean()))
    radius = float(np.median(kept["whisker_radius"]))
    if radius > max(_STOUT, extent):
        raise ValueError(
            f"no {what}: whisker_radius, {radius:.3g} m, is larger than the extent of the "
            f"contacts, {extent:.3g} m; both must be in m"
        )
    if extent > max(_LONG, _SLIM * radius) and radius > 0.0:
        raise ValueError(
            f"no {what}: the contacts extend over {extent:.3g} m, {extent / radius:.2g} times "
            "whisker_radius; both must be in m"
        )
    if extent > _LONG or radius > _STOUT:
        warnings.warn(
            f"the contacts extend over {extent:.3g} m, and whisker_radius is {radius:.3g} m: are "
            "they in other units than m?",
            stacklevel=4,
        )
    size = np.linalg.svd(centered, compute_uv=False)
    if not size[1] > FLOOR * size[0]:
        raise ValueError(f"no {what}: all points are on a line, or the same")
    normal = kept["normals"] / length[usable][:, None] if "normals" in kept else None
    if (spread := _covariance(what, kept, np.flatnonzero(usable), extent)) is not None:
        variance = np.trace(spread[:, :3, :3], axis1=1, axis2=2) / 3.0
        if (sigma := extent * float(np.sqrt(np.median(variance)))) > max(_VAGUE, extent):
            warnings.warn(
                f"the median standard deviation of the contacts, {1e3 * sigma:.2g} mm, is larger "
                f"than their extent, {1e3 * extent:.2g} mm: they hardly show a shape, or the "
                "covariance is not in m²",
                stacklevel=4,
            )
    shared = kept["shared"] / np.repeat([extent, 1.0], 3) if "shared" in kept else None
    touches = Touches(centered / extent, kept["whisker_radius"] / extent, normal, spread, shared)
    return Checked(usable, touches, mean, extent)


def _covariance(
    what: str, kept: dict[str, Array], rows: NDArray[np.intp], extent: float
) -> Array | None:
    """Covariances (n, 3, 3) or (n, 6, 6) in units of the extent, or None."""
    if "covariance" not in kept:
        return None
    out = kept["covariance"] / extent**2
    if "normal_covariance" in kept:
        cross = kept.get("point_normal_covariance", np.zeros_like(out)) / extent
        turned = np.swapaxes(cross, 1, 2)
        out = np.block([[out, cross], [turned, kept["normal_covariance"]]])
    least, largest = np.linalg.eigvalsh(out)[:, [0, -1]].T
    skew = np.abs(out - np.swapaxes(out, 1, 2)).max(axis=(1, 2))
    faults = {
        "it is not symmetric": skew > _LOPSIDED * np.abs(out).max(axis=(1, 2)),
        "a variance is negative": least < -_NEGATIVE * np.abs(largest),
        "it is zero (without noise, leave it out)": ~out[:, :3, :3].any(axis=(1, 2)),
    }
    for fault, bad in faults.items():
        if bad.any():
            first = rows[np.argmax(bad)]
            raise ValueError(f"no {what}: the covariance of point {first} is invalid: {fault}")
    return np.asarray(out)


def whiten(misses: Array, covariance: Array, shared: Array | None = None) -> Array:
    """Express residuals (n, m) in standard deviations, uncorrelated.

    Their covariance is block diagonal, ``covariance`` (n, m, m), plus G Gᵀ for their changes
    ``shared`` (n, m, k) by one standard deviation of each error that all of them share. In units of
    the blocks it is I + G Gᵀ, whose inverse square root is I − G f(GᵀG) Gᵀ with
    f(x) = 1 / (1 + x + √(1 + x)): residuals of a contact remain those of this contact.
    """
    m = misses.shape[1]
    # Rounding must not make the least noisy combination appear exact.
    floor = FLOOR**2 + _FINE * np.trace(covariance, axis1=1, axis2=2)
    root = np.linalg.cholesky(covariance + floor[:, None, None] * np.eye(m))
    out = np.asarray(np.linalg.solve(root, misses[..., None])[..., 0])
    if shared is None:
        return out
    g = np.linalg.solve(root, shared).reshape(out.size, shared.shape[2])
    size, turn = np.linalg.eigh(g.T @ g)
    size = 1.0 + np.maximum(size, 0.0)
    known = turn @ ((turn.T @ (g.T @ out.reshape(-1))) / (size + np.sqrt(size)))
    return np.asarray(out - (g @ known).reshape(out.shape))


def to_laboratory(points: ArrayLike, base_rotation: ArrayLike, base_position: ArrayLike) -> Array:
    """Transform points from the whisker's to the laboratory frame."""
    p, rotation = numbers("points", points), numbers("base_rotation", base_rotation)
    turned = np.einsum("...ij,...j->...i", rotation, p)
    return np.asarray(turned + numbers("base_position", base_position))


def continuing_candidates(candidates: ArrayLike, frames: ArrayLike) -> NDArray[np.int64]:
    """Select one candidate for each contact by continuity in time.

    During a contact the contact point moves little from frame to frame, especially in the
    laboratory. If the signals of a frame have several explanations, the candidate closest to the
    contact of the nearest frame with only one is selected, within the same unbroken run of frames.

    Parameters
    ----------
    candidates : array_like (n, k, 3)
        Candidate points, m, laboratory frame; the most plausible first, padded with NaN.
    frames : array_like (n,) of int
        Frame numbers, increasing.

    Returns
    -------
    array (n,) of int
        Index of the selected candidate: 0 if the run has no frame with a single candidate, -1 if
        there is no candidate.

    Examples
    --------
    >>> near, far = [0.0, 0.0, 0.0], [9.0, 0.0, 0.0]
    >>> nothing = [np.nan] * 3
    >>> continuing_candidates([[near, nothing], [far, near]], [4, 5]).tolist()
    [0, 1]
    """
    points = np.asarray(candidates, dtype=np.float64)
    number = np.asarray(frames)
    if points.ndim != 3 or points.shape[2] != 3 or number.shape != points.shape[:1]:
        raise ValueError(
            f"candidates have shape {points.shape} and frames {number.shape}; (n, k, 3) and (n,) "
            "are needed"
        )
    count = np.isfinite(points).all(axis=2).sum(axis=1)
    chosen = np.where(count > 0, 0, -1)
    run = np.cumsum(np.diff(number, prepend=number[:1]) > 1)
    for row in np.flatnonzero(count > 1):
        single = np.flatnonzero((count == 1) & (run == run[row]))
        if single.size:
            nearest = single[np.argmin(np.abs(number[single] - number[row]))]
            away = np.linalg.norm(points[row] - points[nearest, 0], axis=1)
            chosen[row] = np.nanargmin(away)
    return chosen


_UNIT = 1e-6  # largest deviation of the length of a stored direction from 1
DIRECTION = "object_axis"  # quantity of unit vectors; other parameters are lengths


class Body(Protocol):
    """An object with a surface: a fitted shape, or an object of a trial."""

    def signed_distance(self, points: ArrayLike, /) -> Array:
        """Signed distances of points (..., 3) from its surface, m; negative inside."""


def _empty() -> Array:
    return np.empty(0)


@dataclass(frozen=True, eq=False, repr=False)
class FittedShape(ABC):
    """A shape fitted to contacts, in the frame of their points.

    Attributes
    ----------
    covariance : array (k, k)
        Covariance of the parameters, in the order of ``parameters``, SI units.
    residuals : array (n,)
        Distances of the whisker's surface from the shape's, m, positive outside; NaN for missing
        points.
    inliers : array (n,) of bool
        Points that were used and whose residual is at most that of four standard deviations in one
        dimension.
    chi_squared : array (n,)
        Squared residuals of each point's equations, in standard deviations; NaN for unused points.
    equations : int
        Number of equations per point: the distance and, if used, those of the normal; 0 if the
        noise was estimated from the scatter.
    """

    covariance: Array = field(default_factory=_empty)
    residuals: Array = field(default_factory=_empty)
    inliers: Mask = field(default_factory=lambda: np.empty(0, dtype=bool))
    chi_squared: Array = field(default_factory=_empty)
    equations: int = 0

    kind: ClassVar[str]
    fields: ClassVar[dict[str, str]]
    """Names of the parameters, and their quantities."""

    def signed_distance(self, points: ArrayLike) -> Array:
        """Compute signed distances of points from the surface.

        Parameters
        ----------
        points : array_like (..., 3)
            Points in the frame of the fit, m.

        Returns
        -------
        array (...)
            Distances, m; negative inside.
        """
        return self._distance(vectors("points", points))

    def outward_normals(self, points: ArrayLike) -> Array:
        """Compute outward normals of the surface at the points nearest to given points.

        Parameters
        ----------
        points : array_like (..., 3)
            Points in the frame of the fit, m.

        Returns
        -------
        array (..., 3)
            Unit vectors; NaN where undefined, as on the axis.
        """
        normal = self._normals(vectors("points", points))
        return np.where(normal.any(axis=-1, keepdims=True), normal, np.nan)

    def distance_sigma(self, points: ArrayLike) -> Array:
        """Compute the standard deviation of distances from the surface.

        Parameters
        ----------
        points : array_like (..., 3)
            Points in the frame of the fit, m.

        Returns
        -------
        array (...)
            Standard deviation due to the uncertainty of the parameters, m.
        """
        return self._sigma(vectors("points", points))

    def _sigma(self, points: Array) -> Array:
        """Standard deviation of distances (...); see `distance_sigma`."""
        slopes = self._slopes(points)
        variance = np.einsum("...i,ij,...j->...", slopes, self.covariance, slopes)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    @abstractmethod
    def _distance(self, points: Array) -> Array:
        """Signed distances (...); see `signed_distance`."""

    @abstractmethod
    def _normals(self, points: Array) -> Array:
        """Unit normals (..., 3); zero where undefined."""

    @abstractmethod
    def _curvature(self, points: Array, height: Array | float = 0.0) -> Array:
        """Derivatives (..., 3, 3) of the normals at a height above the surface."""

    @abstractmethod
    def _slopes(self, points: Array) -> Array:
        """Derivatives (..., k) of the distance with respect to the parameters."""

    def __repr__(self) -> str:
        shown = []
        for name, quantity in self.fields.items():
            value = np.atleast_1d(getattr(self, name))
            rows = [i for i, p in enumerate(self.parameters) if p.startswith(name)]
            sigma = np.sqrt(np.diag(self.covariance)[rows])
            length = QUANTITIES[quantity].unit == "m"
            factor, unit, digits = (1e3, " mm", 3) if length else (1.0, "", 4)
            if name == "radius":  # shown as for known objects
                name, factor = "diameter", 2.0 * factor
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
        """Whether parameters (k,) are components of a unit vector rather than lengths."""
        counts = [np.size(getattr(self, name)) for name in self.fields]
        return np.repeat([q == DIRECTION for q in self.fields.values()], counts)

    @property
    def rms(self) -> float:
        """Root mean square of the inliers' residuals, m; NaN without inliers."""
        size = self.residuals[self.inliers]
        return float(np.sqrt(np.mean(size**2))) if size.size else float("nan")

    @property
    def median(self) -> float:
        """Median absolute residual of the inliers, m; NaN without inliers."""
        size = np.abs(self.residuals[self.inliers])
        return float(np.median(size)) if size.size else float("nan")

    @property
    def used(self) -> Mask:
        """Points (n,) used in the fit: neither missing nor too uncertain for the shape's size."""
        return np.asarray(np.isfinite(self.chi_squared))

    @property
    def misfit(self) -> float:
        """χ² per degree of freedom, by the median; NaN if the points' noise is unknown.

        It is 1 if shape and noise are right, and much larger if the points belong to another shape
        or are noisier than stated. Few outliers hardly change it. The covariance is scaled by it.
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
        """Convert the fitted shape to a dataset.

        Parameters
        ----------
        dims : sequence of str
            Dimensions of the points used in the fit, such as ``("time", "whisker")``.
        shape : tuple of int, optional
            Shape of these points, if they were flattened.
        coords : mapping, optional
            Coordinates of these dimensions.

        Returns
        -------
        xarray.Dataset
            Parameters as ``object_position``, ``object_axis`` and ``object_radius``,
            ``parameter_covariance``, and along ``dims`` ``surface_distance``, ``inlier`` and
            ``chi_squared``; the attribute ``shape`` is the kind. A free surface is stored as its
            base with ``support_point``, ``support_value``, ``support_variance``,
            ``shape_amplitude`` and ``shape_length``, and the attribute ``base``.
        """
        data, about = self._parameter_variables()
        size = self.residuals.shape if shape is None else shape
        square = ("parameter", "parameter_2")
        data["parameter_covariance"] = (square, self.covariance, attributes("parameter_covariance"))
        rows = (self.residuals, self.inliers, self.chi_squared)
        for name, values in zip(_POINT_VARIABLES, rows, strict=True):
            data[name] = (tuple(dims), values.reshape(size), attributes(name))
        known = {"space": list("xyz"), "parameter": list(self.parameters)}
        about |= {"shape": self.kind, "equations": self.equations}
        return xr.Dataset(data, {**(coords or {}), **known}, about)

    def _parameter_variables(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Variables and attributes of the parameters in the dataset."""
        data: dict[str, Any] = {}
        for name, quantity in self.fields.items():
            value = np.asarray(getattr(self, name), dtype=np.float64)
            data[quantity] = (("space",)[: value.ndim], value, attributes(quantity))
        return data, {}

    @classmethod
    def _from_dataset(cls, dataset: xr.Dataset) -> Self:
        """Restore a shape of this kind from its dataset."""
        check_complete(dataset, cls.kind, {"parameter_covariance", *cls.fields.values()})
        values: dict[str, Any] = {}
        for name, quantity in cls.fields.items():
            value = dataset[quantity].values.astype(np.float64)
            right = bool(np.isfinite(value).all()) and (name != "radius" or value > 0.0)
            if not right or (quantity == DIRECTION and abs(np.linalg.norm(value) - 1.0) > _UNIT):
                raise ValueError(f"{name} of a fitted {cls.kind} is {value}, which is not valid")
            values[name] = float(value) if value.ndim == 0 else value
        return cls(covariance=dataset["parameter_covariance"].values, **rows_of(dataset), **values)


# Variables along the points to which a shape was fitted.
_POINT_VARIABLES = ("surface_distance", "inlier", "chi_squared")


def check_complete(dataset: xr.Dataset, kind: str, names: set[str]) -> None:
    """Raise a ValueError if variables of a stored shape are missing."""
    if missing := sorted((names | set(_POINT_VARIABLES)) - set(dataset.data_vars)):
        raise ValueError(f"a fitted {kind} lacks {', '.join(missing)}")


def rows_of(dataset: xr.Dataset) -> dict[str, Any]:
    """Residuals, inliers and squared residuals, flattened, and the number of equations."""
    residuals, inliers, squares = (dataset[name].values.reshape(-1) for name in _POINT_VARIABLES)
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
    return float(np.median(known) / special.chdtri(equations, 0.5))


def evidence_of(chi_squared: Array, unknowns: int) -> float:
    """Bayesian information criterion of a shape, robust to few outliers."""
    cost = 8.0 * (np.sqrt(1.0 + 0.25 * chi_squared) - 1.0)
    return float(cost.sum() + unknowns * np.log(max(chi_squared.size, 1)))
