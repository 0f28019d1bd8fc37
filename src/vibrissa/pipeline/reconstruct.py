"""The object that estimated contacts lie on, and how far it is from objects that are known.

Contact points lie on the whisker's centreline, its radius off the surface, which the fit takes into
account. All whiskers of a recording count together: they touch one object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.contour import (
    CylinderFit,
    FittedShape,
    FreeFit,
    SphereFit,
    axis_offset,
    fit_free,
    fit_shape,
)
from vibrissa.objects import Peg, Sphere, Surface
from vibrissa.pipeline.comparison import nearest_object
from vibrissa.pipeline.estimates import WHOLE
from vibrissa.pipeline.frames import EACH, estimates_in, whisker_radii
from vibrissa.quantities import attributes
from vibrissa.recording import Group, Recording
from vibrissa.whisker import Whisker

Array = NDArray[np.float64]

Shape = Literal["cylinder", "sphere", "plane", "free"]
"""What can be fitted to contacts."""

SOLVED_TO = 1e-6
"""Uncertainty of every contact apart from the signals', m: what the mechanics is solved to."""

LEAN = 0.1
"""How far the normal may lean from the force across the whisker where friction is allowed for.

As a standard deviation, rad. Friction along the whisker is seen in the wrench, and taken off;
across the whisker and along the object it is not. Pegs are found best with 0.05 to 0.3 at any
coefficient of friction up to 0.5, and hardly worse without friction (docs/honest-test.md).
"""


def reconstruct(
    recording: xr.DataTree,
    shape: Shape = "cylinder",
    *,
    axis: ArrayLike | None = None,
    lean: float | None = None,
    whiskers: Sequence[Whisker] | None = None,
    objects: Sequence[Surface] | None = None,
) -> xr.Dataset:
    """Fit an object to the estimated contacts of a recording.

    Parameters
    ----------
    recording : xarray.DataTree
        With a group ``estimates``; see `estimates_of`.
    shape : {"cylinder", "sphere", "plane", "free"}
        What the object is taken for; free: any smooth surface.
    axis : array_like (3,), optional
        Direction of a cylinder's axis, laboratory frame, where it is known.
    lean : float, optional
        See `fit_contacts`.
    whiskers : sequence of Whisker, optional
        One for each along the dimension ``whisker``; by default those of the recording.
    objects : sequence of Surface, optional
        Known objects in the laboratory to compare with; by default those of the recording.

    Returns
    -------
    xarray.Dataset
        The group ``contour`` of a recording, laboratory frame: ``object_position``,
        ``object_axis`` and ``object_radius``, as far as the shape has them, with
        ``parameter_covariance``; dims time, whisker: ``surface_distance`` from the fitted object,
        ``inlier`` and ``chi_squared``; attributes ``shape`` and ``misfit``, χ² per degree of
        freedom: much more than 1 says that the object has another shape.
        `vibrissa.contour.shape_from_dataset` makes the shape again. The covariance is larger by the
        misfit, and counts contacts of following frames as one where they err together:
        so many of them as the attribute ``frames_together`` says. With known objects also
        ``object_distance`` of each contact from the one that is nearest to them (attribute
        ``object``, its number), and for a cylinder beside a peg ``axis_offset``, ``axis_tilt`` and
        ``diameter_error``, for spheres ``center_offset`` and ``diameter_error``.

    Raises
    ------
    ValueError
        If there are no estimates, or too few, or they do not determine the object.
    """
    if shape not in get_args(Shape):
        raise ValueError(f"shape is {shape!r}; one of {', '.join(get_args(Shape))} is needed")
    estimates = estimates_in(recording)
    whiskers = Recording(recording).whiskers if whiskers is None else whiskers
    known = Recording(recording).objects if objects is None else tuple(objects)
    fit = fit_contacts(estimates, whiskers, shape, axis=axis, lean=lean)
    together = frames_together(scores_of(fit, estimates))
    fit = _less_sure(fit, together)
    each = {n: estimates[n].variable for n in EACH if n in estimates.coords}
    out = fit.to_dataset(EACH, tuple(estimates.sizes[n] for n in EACH), each)
    out.attrs |= {"reference_frame": "laboratory", "frames_together": together}
    out.attrs["misfit"] = fit.misfit
    out.attrs |= {n: estimates.attrs[n] for n in ("signals", "source") if n in estimates.attrs}
    if known:
        out = out.assign(_compared(fit, estimates, whiskers, known))
    return out


def scores_of(fit: FittedShape, estimates: xr.Dataset) -> Array:
    """Give the distances of contacts from a fitted shape in standard deviations."""
    normal, spread = (_rows(estimates[n]) for n in ("contact_normal", "contact_covariance"))
    variance = np.einsum("ni,nij,nj->n", normal, spread, normal) + SOLVED_TO**2
    scores = fit.residuals / np.sqrt(np.where(np.isfinite(variance), variance, 1.0))
    scores[~fit.inliers] = np.nan
    return scores.reshape(tuple(estimates.sizes[name] for name in EACH))


def _less_sure(fit: FittedShape, together: float) -> FittedShape:
    """The same fit with all variances larger by a factor."""
    covariance = together * fit.covariance
    if not isinstance(fit, FreeFit):
        return replace(fit, covariance=covariance)
    support = fit.support._replace(variance=together * fit.support.variance)
    base = replace(fit.base, covariance=covariance)
    return replace(fit, base=base, support=support, covariance=covariance)


def frames_together(scores: ArrayLike) -> float:
    """Tell how many following frames err together, on average.

    Contacts that were tracked err alike from frame to frame, as the whisker's shape and the base's
    pose do, so that a hundred of them tell less than a hundred of a sensor.
    """
    z = np.asarray(scores, dtype=np.float64)
    known = np.isfinite(z)
    z = np.where(known, z, 0.0)
    count = int(known.sum())
    if count < 2 or not z.any():
        return 1.0
    variance = float((z**2).sum()) / count
    total = 1.0
    for lag in range(1, len(z)):
        pairs = int((known[lag:] & known[:-lag]).sum())
        if pairs == 0:
            break
        correlation = float((z[lag:] * z[:-lag]).sum()) / pairs / variance
        if correlation < 2.0 / np.sqrt(pairs):
            break
        total += 2.0 * correlation
    return total


def fit_contacts(
    estimates: xr.Dataset,
    whiskers: Sequence[Whisker],
    shape: Shape = "cylinder",
    *,
    axis: ArrayLike | None = None,
    lean: float | None = None,
) -> FittedShape:
    """Fit a shape to contacts in the laboratory.

    Parameters
    ----------
    estimates : xarray.Dataset
        Of `estimates_of`, dims time, whisker.
    whiskers : sequence of Whisker
        That touched it.
    shape : {"cylinder", "sphere", "plane", "free"}
        Which.
    axis : array_like (3,), optional
        Direction of a cylinder's axis where it is known.
    lean : float, optional
        Standard deviation of the angle between the surface's normal and the force across the
        whisker, rad; by default `LEAN` for contacts from the whole wrench, which allows for
        friction, and 0 for others, which are of a whisker without friction.

    Returns
    -------
    CylinderFit, SphereFit, PlaneFit or FreeFit
        Each contact counts by its covariance, where that is known, and tells the normal of the
        surface by the direction of its force. Rows are frames × whiskers.

    Raises
    ------
    ValueError
        If there are too few contacts, or they do not determine the shape.
    """
    if shape not in get_args(Shape):
        raise ValueError(f"shape is {shape!r}; one of {', '.join(get_args(Shape))} is needed")
    if axis is not None and shape != "cylinder":
        raise ValueError(f"an axis is given; only a cylinder has one, and the shape is {shape!r}")
    count = estimates.sizes["whisker"]
    if len(whiskers) != count:
        raise ValueError(f"there are estimates of {count} whiskers; {len(whiskers)} are given")
    spread = _rows(estimates["contact_covariance"])
    if lean and not np.isfinite(spread).any():
        raise ValueError(
            f"lean is {lean!r}, but these contacts have no covariance, without which it cannot "
            "count: estimate them with the noise of the signals"
        )
    if lean is None:
        lean = LEAN if estimates.attrs.get("signals") == WHOLE else 0.0
    if not (np.isfinite(lean) and lean >= 0.0):
        raise ValueError(f"lean is {lean!r}; an angle from 0 is needed, rad")
    points = _rows(estimates["contact_point"])
    known: dict[str, Any] = {
        "normals": _rows(estimates["contact_normal"]),
        "whisker_radius": whisker_radii(estimates, whiskers).reshape(-1),
    }
    if np.isfinite(spread).any():
        known["covariance"] = spread + SOLVED_TO**2 * np.eye(3)
        for name in ("normal_covariance", "point_normal_covariance"):
            known[name] = _rows(estimates[name])
        across = np.eye(3) - known["normals"][:, :, None] * known["normals"][:, None, :]
        known["normal_covariance"] = known["normal_covariance"] + lean**2 * across
    try:
        if shape == "free":
            return fit_free(points, **known)
        return fit_shape(shape, points, axis=axis, **known)
    except ValueError as fault:
        found = int(np.isfinite(points).all(axis=1).sum())
        raise ValueError(
            f"{fault} (contacts were estimated in {found} of {len(points)} frames)"
        ) from None


def contour_points(recording: xr.DataTree, whiskers: Sequence[Whisker] | None = None) -> xr.Dataset:
    """List the contacts of all whiskers as points of a contour, laboratory frame.

    Parameters
    ----------
    recording : xarray.DataTree
        With a group ``estimates``, and ``contour`` if an object was fitted.
    whiskers : sequence of Whisker, optional
        By default those of the recording.

    Returns
    -------
    xarray.Dataset
        Dim contact, by time: ``time``, ``whisker``, the contact point ``x``, ``y``, ``z`` with
        ``sigma_x``, …, ``normal_x``, …, the point ``surface_x``, … of the object's surface, one
        whisker radius away, and where an object was fitted ``surface_distance`` and ``inlier``;
        the columns of `vibrissa.io.save_contour`.

    Raises
    ------
    ValueError
        If there are no estimates.
    """
    estimates = estimates_in(recording)
    known = Recording(recording).whiskers if whiskers is None else whiskers
    point = _rows(estimates["contact_point"])
    normal = _rows(estimates["contact_normal"])
    radius = whisker_radii(estimates, known).reshape(-1, 1)
    variance = np.einsum("nii->ni", _rows(estimates["contact_covariance"]))
    vectors = {"": point, "sigma_": np.sqrt(variance), "normal_": normal}
    vectors["surface_"] = point - radius * normal
    there = np.isfinite(point).all(axis=1)
    time, name = np.meshgrid(estimates["time"], estimates["whisker"], indexing="ij")
    columns = {"time": time.reshape(-1), "whisker": name.reshape(-1)}
    for prefix, values in vectors.items():
        columns |= {f"{prefix}{letter}": values[:, i] for i, letter in enumerate("xyz")}
    if "contour" in recording.children:
        contour = recording["contour"].to_dataset()
        columns |= {n: _rows(contour[n]) for n in ("surface_distance", "inlier")}
    return xr.Dataset({column: ("contact", v[there]) for column, v in columns.items()})


def _rows(variable: xr.DataArray) -> Array:
    """Values (frames × whiskers, ...)."""
    values = variable.transpose(*EACH, ...).values
    return np.asarray(values.reshape(-1, *values.shape[2:]))


def _compared(
    fit: FittedShape,
    estimates: xr.Dataset,
    whiskers: Sequence[Whisker],
    objects: Sequence[Surface],
) -> dict[str, Any]:
    """Distances of contacts from the known object nearest to them, and of the fit from it."""
    number = nearest_object(estimates, whiskers, objects)
    points = Group(estimates)["contact_point"]
    there = np.isfinite(points).all(axis=-1)
    gap = np.full(there.shape, np.nan)
    gap[there] = objects[number].signed_distance(points[there])
    gap -= whisker_radii(estimates, whiskers)
    about = attributes("object_distance") | {"object": number}
    out: dict[str, Any] = {"object_distance": (EACH, gap, about)}
    true = objects[number]
    if isinstance(true, Peg) and isinstance(fit, CylinderFit):
        offset, tilt = axis_offset(fit.origin, fit.axis, true.origin, true.axis)
        out["axis_offset"] = ("space", offset, attributes("axis_offset"))
        out["axis_tilt"] = ((), tilt, attributes("axis_tilt"))
    elif isinstance(true, Sphere) and isinstance(fit, SphereFit):
        offset = fit.origin - true.origin
        out["center_offset"] = ("space", offset, attributes("center_offset"))
    else:
        return out
    error = float(fit.diameter - 2.0 * true.radius)
    out["diameter_error"] = ((), error, attributes("diameter_error"))
    return out
