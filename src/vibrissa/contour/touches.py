"""Contacts as fits use them: checked, about their mean, in units of their extent.

Contact points in the laboratory, x_lab = R x_whisker + o, and which of several candidates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.numerics import Array, Mask

FLOOR = 1e-7
"""Smallest standard deviation, as a share of the points' extent, where their noise is zero."""

_FINE = 1e-10
"""Variance of the least noisy combination as a share of that of the point or normal, at least."""

_NEGATIVE = 1e-8
"""Largest negative eigenvalue of a covariance by rounding, as a share of the largest."""


class Touches(NamedTuple):
    """Contacts in units of their extent, with what is known of them."""

    position: Array
    whisker_radius: Array
    normal: Array | None
    covariance: Array | None

    def rows(self, which: Mask) -> Touches:
        """Some of the contacts."""
        normal = None if self.normal is None else self.normal[which]
        spread = None if self.covariance is None else self.covariance[which]
        return Touches(self.position[which], self.whisker_radius[which], normal, spread)

    @property
    def joint(self) -> bool:
        """Whether the normals' covariance is known too."""
        return self.covariance is not None and self.covariance.shape[1] == 6

    def weights(self) -> Array:
        """Weight (n,) of each point, whatever the direction of its error; at most 1."""
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
    """Contacts that can be used."""

    usable: Mask
    touches: Touches
    mean: Array
    extent: float


class ContactArrays(TypedDict, total=False):
    """Optional facts on contacts in addition to their points; see `fit_shape`."""

    covariance: ArrayLike | None
    whisker_radius: ArrayLike | None
    normals: ArrayLike | None
    normal_covariance: ArrayLike | None
    point_normal_covariance: ArrayLike | None


def checked(
    what: str, points: ArrayLike, *, least: int, **contacts: Unpack[ContactArrays]
) -> Checked:
    """Check contacts and bring them into units of their extent."""
    if unknown := sorted(contacts.keys() - ContactArrays.__annotations__.keys()):
        known = ", ".join(ContactArrays.__annotations__)
        raise TypeError(f"of contacts {', '.join(unknown)} is given; {known} can be")
    n = _number(what, points)
    given: dict[str, Any] = {"points": points, "whisker_radius": 0.0}
    given |= {name: values for name, values in contacts.items() if values is not None}
    allowed: dict[str, list[tuple[int, ...]]] = {
        "points": [(n, 3)],
        "normals": [(n, 3)],
        "whisker_radius": [(n,), ()],
    }
    arrays, faults = {}, []
    for name, values in given.items():
        arrays[name] = np.asarray(values, dtype=np.float64)
        shapes = allowed.get(name, [(n, 3, 3)])
        if arrays[name].shape not in shapes:
            wanted = " or ".join(map(str, shapes))
            faults.append(f"{name} has shape {arrays[name].shape}; {wanted} is needed")
    needs = {
        "normal_covariance": ("normals", "covariance"),
        "point_normal_covariance": ("normal_covariance",),
    }
    for name, others in needs.items():
        lacking = [other for other in others if other not in arrays]
        if name in arrays and lacking:
            faults.append(f"{name} is given without {' and '.join(lacking)}")
    if faults:
        raise ValueError(f"no {what}: " + "; ".join(faults))
    arrays["whisker_radius"] = np.broadcast_to(arrays["whisker_radius"], (n,))
    return _scaled(what, arrays, n, least)


def _number(what: str, points: ArrayLike) -> int:
    shape = np.shape(points)
    if len(shape) != 2 or shape[1] != 3:
        raise ValueError(f"no {what}: points have shape {shape}; (n, 3) is needed")
    return int(shape[0])


def _scaled(what: str, arrays: dict[str, Array], n: int, least: int) -> Checked:
    usable = np.ones(n, dtype=bool)
    for values in arrays.values():
        usable &= np.isfinite(values.reshape(n, -1)).all(axis=1)
    if "normals" in arrays:
        length = np.linalg.norm(arrays["normals"], axis=1)
        usable &= length > 0.0
    if usable.sum() < least:
        raise ValueError(f"no {what}: {usable.sum()} usable points; at least {least} are needed")
    kept = {name: values[usable] for name, values in arrays.items()}
    mean = kept["points"].mean(axis=0)
    centered = kept["points"] - mean
    extent = float(np.sqrt((centered**2).sum(axis=1).mean()))
    size = np.linalg.svd(centered, compute_uv=False)
    if not size[1] > FLOOR * size[0]:
        raise ValueError(f"no {what}: all points are on a line, or the same")
    normal = kept["normals"] / length[usable][:, None] if "normals" in kept else None
    spread = _covariance(what, kept, np.flatnonzero(usable), extent)
    touches = Touches(centered / extent, kept["whisker_radius"] / extent, normal, spread)
    return Checked(usable, touches, mean, extent)


def _covariance(
    what: str, kept: dict[str, Array], rows: NDArray[np.intp], extent: float
) -> Array | None:
    """Covariances (n, 3, 3) or (n, 6, 6), in units of the extent; or none."""
    if "covariance" not in kept:
        return None
    out = kept["covariance"] / extent**2
    if "normal_covariance" in kept:
        cross = kept.get("point_normal_covariance", np.zeros_like(out)) / extent
        turned = np.swapaxes(cross, 1, 2)
        out = np.block([[out, cross], [turned, kept["normal_covariance"]]])
    least, largest = np.linalg.eigvalsh(out)[:, [0, -1]].T
    bad = np.flatnonzero(least < -_NEGATIVE * np.abs(largest))
    if bad.size:
        raise ValueError(
            f"no {what}: the covariance of point {rows[bad[0]]} is not one: a variance is negative"
        )
    return np.asarray(out)


def whitened(misses: Array, covariance: Array) -> Array:
    """Express misses in standard deviations."""
    m = misses.shape[1]
    # Rounding must not make the least noisy combination look exact.
    floor = FLOOR**2 + _FINE * np.trace(covariance, axis1=1, axis2=2)
    root = np.linalg.cholesky(covariance + floor[:, None, None] * np.eye(m))
    return np.asarray(np.linalg.solve(root, misses[..., None])[..., 0])


def to_laboratory(points: ArrayLike, base_rotation: ArrayLike, base_position: ArrayLike) -> Array:
    """Transform points from the whisker's to the laboratory frame."""
    p = np.asarray(points, dtype=np.float64)
    turned = np.einsum("...ij,...j->...i", np.asarray(base_rotation, dtype=np.float64), p)
    return np.asarray(turned + np.asarray(base_position, dtype=np.float64))


def covariance_to_laboratory(covariance: ArrayLike, base_rotation: ArrayLike) -> Array:
    """Transform covariances of points from the whisker's to the laboratory frame."""
    rotation = np.asarray(base_rotation, dtype=np.float64)
    turned = rotation @ np.asarray(covariance, dtype=np.float64) @ np.swapaxes(rotation, -1, -2)
    return np.asarray(turned, dtype=np.float64)


def continuing_candidates(candidates: ArrayLike, frames: ArrayLike) -> NDArray[np.int64]:
    """Choose one candidate for each contact by its neighbours in time.

    During a contact its point moves little from frame to frame, least of all in the laboratory. So
    where signals have several explanations, the one nearest to the contact of the nearest frame
    with a single one is chosen, within the same unbroken run of frames.

    Parameters
    ----------
    candidates : array_like (n, k, 3)
        Candidate points, m, laboratory frame; the more plausible first, padded with NaN.
    frames : array_like (n,) of int
        Numbers of the frames, rising.

    Returns
    -------
    array (n,) of int
        Number of the candidate: the first where a run has no frame with a single one; -1 where
        there is none.

    Raises
    ------
    ValueError
        If shapes do not fit.

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
