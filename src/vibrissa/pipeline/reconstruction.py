"""Reconstruction of the touched object from contacts, and comparison with known objects.

Contact points are on the whisker's centreline, one whisker radius off the surface, which the fit
takes into account. All whiskers of a recording are assumed to touch the same object.

Shapes are compared by χ² per degree of freedom, which is 1 if shape and noise are correct, and by
the Bayesian information criterion on the contacts that all fits use. The effective number of
contacts is reduced if their errors are correlated from frame to frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.contour import (
    CylinderFit,
    FittedShape,
    FreeFit,
    SphereFit,
    axis_offset,
    compare_with,
    distances_by,
    evidence_of,
    fit_free,
    fit_shape,
)
from vibrissa.numerics import Array
from vibrissa.objects import Peg, Sphere, Surface
from vibrissa.pipeline.checks import EACH, estimates_in, whisker_radii
from vibrissa.pipeline.estimates import WHOLE
from vibrissa.quantities import attributes
from vibrissa.recording import Group, Recording
from vibrissa.signals import nearest_on_rest
from vibrissa.status import Status, describe
from vibrissa.whisker import Whisker

Shape = Literal["cylinder", "sphere", "plane", "free"]  # shapes that can be fitted to contacts
# Numerical error of every contact point, m: the tolerance of the mechanics.
SOLVED_TO = 1e-6
# Share of the variance of shared errors that may be neglected in their effect on the object.
_LEFT_OUT = 1e-4
# Share of the variance of friction across the whisker that contacts do not share.
_ALONE = 0.2
# Quantile of the measured friction ratios that is taken for the coefficient, and its range.
_STEADY, _SMOOTHEST, _ROUGHEST = 0.9, 0.01, 0.3


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
        Recording with a group ``estimates``; see `estimates_of`.
    shape : {"cylinder", "sphere", "plane", "free"}
        Shape of the object; "free" is any smooth surface.
    axis : array_like (3,), optional
        Direction of a cylinder's axis, laboratory frame, where it is known.
    lean : float, optional
        Standard deviation of the angle between normals and forces, rad, as for `fit_contacts`.
    whiskers : sequence of Whisker, optional
        Whiskers along the dimension ``whisker``; by default those of the recording.
    objects : sequence of Surface, optional
        Known objects in the laboratory frame to compare with; by default those of the recording.

    Returns
    -------
    xarray.Dataset
        Group ``contour`` of a recording, laboratory frame: ``object_position``,
        ``object_axis`` and ``object_radius``, as far as the shape has them, with
        ``parameter_covariance``; dimensions time, whisker: ``surface_distance`` from the fitted
        object, ``inlier`` and ``chi_squared``; attributes ``shape`` and ``misfit``, χ² per degree
        of freedom, of which a value much above 1 means that the object has another shape.
        `vibrissa.contour.shape_from_dataset` restores the shape. The covariance is scaled by the
        misfit and by the attribute ``frames_together``, the number of consecutive frames whose
        errors are correlated. For simple shapes it includes the errors that all contacts of a
        tracked recording share (its ``contact_shared``). With known objects also
        ``object_distance`` of each contact from the object nearest to all contacts (attribute
        ``object``, its index); for a cylinder compared with a peg ``axis_offset``, ``axis_tilt``
        and ``diameter_error``; for spheres ``center_offset`` and ``diameter_error``.

    Raises
    ------
    ValueError
        If there are no estimates or too few, or they do not determine the object.
    """
    _check_shape(shape)
    estimates = estimates_in(recording)
    whiskers = Recording(recording).whiskers if whiskers is None else whiskers
    known = Recording(recording).objects if objects is None else tuple(objects)
    fit = fit_contacts(estimates, whiskers, shape, axis=axis, lean=lean)
    together = frames_together(scores_of(fit, estimates))
    fit = _widened(fit, together)
    if not isinstance(fit, FreeFit):
        moved = _moved_together(recording, estimates)
        options: dict[str, Any] = {"axis": axis, "lean": lean, "start": fit}
        others = [fit_contacts(one, whiskers, shape, **options) for one in moved]
        fit = _with_shared_errors(fit, others)
    each = {n: estimates[n].variable for n in EACH if n in estimates.coords}
    out = fit.to_dataset(EACH, tuple(estimates.sizes[n] for n in EACH), each)
    out.attrs |= {"reference_frame": "laboratory", "frames_together": together}
    out.attrs["misfit"] = fit.misfit
    out.attrs |= {n: estimates.attrs[n] for n in ("signals", "source") if n in estimates.attrs}
    if known:
        out = out.assign(_compared(fit, estimates, whiskers, known))
    return out


def _check_shape(shape: str) -> None:
    if shape not in get_args(Shape):
        raise ValueError(f"shape is {shape!r}; one of {', '.join(get_args(Shape))} is needed")


def scores_of(fit: FittedShape, estimates: xr.Dataset) -> Array:
    """Distances (time, whisker) of contacts from a fitted shape, in standard deviations."""
    normal, spread = (_rows(estimates[n]) for n in ("contact_normal", "contact_covariance"))
    variance = np.einsum("ni,nij,nj->n", normal, spread, normal) + SOLVED_TO**2
    scores = fit.residuals / np.sqrt(np.where(np.isfinite(variance), variance, 1.0))
    scores[~fit.inliers] = np.nan
    return scores.reshape(tuple(estimates.sizes[name] for name in EACH))


def _widened(fit: FittedShape, together: float) -> FittedShape:
    """Copy of a fit with all variances multiplied by ``together``."""
    covariance = together * fit.covariance
    if not isinstance(fit, FreeFit):
        return replace(fit, covariance=covariance)
    support = fit.support._replace(variance=together * fit.support.variance)
    base = replace(fit.base, covariance=covariance)
    return replace(fit, base=base, support=support, covariance=covariance)


def _moved_together(recording: xr.DataTree, estimates: xr.Dataset) -> Iterator[xr.Dataset]:
    """Yield estimates displaced by the few independent errors that all frames share."""
    root, found = Recording(recording).root, Group(estimates)
    point, normal = found["contact_point"], found["contact_normal"]
    inertia, count = found.get("contact_inertia"), root.data.sizes.get("error", 0)
    inertia = np.zeros((0, *point.shape[:2], 6)) if inertia is None else np.moveaxis(inertia, 2, 0)
    moves = np.zeros((count + len(inertia), 2, *point.shape))
    if not len(moves):
        return
    moves[count:] = np.stack(np.split(inertia, 2, axis=-1), axis=1)
    for k, (moved, turned) in enumerate(moves[:count]):
        # NaN where the contact was not tracked: its displacement is unknown and set to zero below.
        moved[:] = root["contact_shared"][:, :, k]
        if "pose_shared" in root:
            pose = np.nan_to_num(root["pose_shared"][:, :, k])
            turned[:] = np.cross(pose[..., 3:], normal)
            if estimates.attrs.get("source") == "sensor":
                moved[:] = pose[..., :3] + np.cross(pose[..., 3:], point - root["base_position"])
                if "contact_shared" in found:
                    moved += np.nan_to_num(found["contact_shared"][:, :, k])
    moves = np.nan_to_num(moves)
    size = np.sqrt((moves**2).mean(axis=(0, 2, 3, 4), keepdims=True))
    each = np.divide(moves, size, out=np.zeros(moves.shape), where=size > 0.0)
    mix, share, _ = np.linalg.svd(each.reshape(len(each), -1), full_matrices=False)
    few = mix[:, np.cumsum(share[::-1] ** 2)[::-1] > _LEFT_OUT * (share**2).sum()]
    for moved, turned in np.tensordot((few * np.sign(few.sum(axis=0))).T, moves, 1):
        yield estimates.assign(
            contact_point=((*EACH, "space"), point + moved),
            contact_normal=((*EACH, "space"), normal + turned),
        )


def _with_shared_errors(fit: FittedShape, others: Sequence[FittedShape]) -> FittedShape:
    """Add to a fit's covariance the effect of shared errors: differences from ``others``."""

    def numbers(one: FittedShape) -> Array:
        return np.concatenate([np.ravel(getattr(one, name)) for name in one.fields])

    covariance = fit.covariance.copy()
    for other in others:
        apart = numbers(other) - numbers(fit)
        covariance += np.outer(apart, apart)
    return replace(fit, covariance=covariance)


def frames_together(scores: ArrayLike) -> float:
    """Mean number of consecutive frames whose errors are correlated.

    Errors of tracked contacts, such as those of the whisker's shape and the base pose, are similar
    from frame to frame, so that a hundred of them hold less information than a hundred of a sensor.
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
    start: FittedShape | None = None,
) -> FittedShape:
    """Fit a shape to contacts in the laboratory frame.

    Parameters
    ----------
    estimates : xarray.Dataset
        Dataset of `estimates_of`, dimensions time, whisker.
    whiskers : sequence of Whisker
        Whiskers that touched the object.
    shape : {"cylinder", "sphere", "plane", "free"}
        Shape of the object.
    axis : array_like (3,), optional
        Direction of a cylinder's axis where it is known.
    lean : float, optional
        Standard deviation of the angle between the surface normal and the force across the
        whisker, rad, which friction along the object causes. By default it follows from the
        friction along the whisker for contacts from the full wrench, which measures it, and is the
        assumed ``friction`` for others.
    start : CylinderFit, SphereFit or PlaneFit, optional
        Fit to similar contacts; see `vibrissa.contour.fit_shape`.

    Returns
    -------
    CylinderFit, SphereFit, PlaneFit or FreeFit
        Fitted shape. Contacts are weighted by their covariance, where known, and the direction of
        the force serves as the surface normal. Rows are frames × whiskers.

    Raises
    ------
    ValueError
        If there are too few contacts, or they do not determine the shape.
    """
    _check_shape(shape)
    if axis is not None and shape != "cylinder":
        raise ValueError(f"an axis is given for the shape {shape!r}; only a cylinder has one")
    count = estimates.sizes["whisker"]
    if len(whiskers) != count:
        raise ValueError(f"there are estimates of {count} whiskers; {len(whiskers)} are given")
    spread = _rows(estimates["contact_covariance"])
    if lean and not np.isfinite(spread).any():
        raise ValueError(
            f"lean is {lean!r}, but these contacts have no covariance, so that it has no effect: "
            "estimate them with the noise of the signals"
        )
    if lean is None:
        lean = _expected_lean(estimates)
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
        if lean:
            own, known["shared"] = _by_friction(estimates, lean, alone=shape == "free")
            known["normal_covariance"] = known["normal_covariance"] + own
    try:
        if shape == "free":
            return fit_free(points, **known)
        return fit_shape(shape, points, axis=axis, start=start, **known)
    except ValueError as fault:
        found = np.isfinite(points).all(axis=1)
        codes = estimates["status"].values.reshape(-1)
        lost = ~found & np.isin(codes, (Status.UNIQUE, Status.AMBIGUOUS))
        reasons = describe(codes[~found & ~lost]).most_common(2)
        if lost.any():
            reasons.append(("The pose of the base is not known", int(lost.sum())))
        others = "".join(f"; {count} frames: {why.rstrip('.')}" for why, count in reasons)
        raise ValueError(
            f"{fault} (contacts were estimated in {found.sum()} of {len(points)} frames{others})"
        ) from None


def _expected_lean(estimates: xr.Dataset) -> float:
    """Standard deviation of the angle between normals and forces, rad, that friction causes.

    The wrench measures the friction along the whisker; that across it has the same coefficient. For
    other signals it is the friction that was assumed.
    """
    if estimates.attrs.get("signals") != WHOLE:
        return float(estimates.attrs.get("friction", 0.0))
    spread = np.einsum("nii->n", _rows(estimates["normal_covariance"]))
    ratio = np.abs(np.tan(_rows(estimates["friction_angle"])))
    known = np.isfinite(spread + ratio)
    if not known.any():
        return _ROUGHEST
    # Noise increases the ratio where contacts are light.
    best = known & (spread <= np.median(spread[known]))
    return float(np.clip(np.quantile(ratio[best], _STEADY), _SMOOTHEST, _ROUGHEST))


def _by_friction(estimates: xr.Dataset, lean: float, *, alone: bool) -> tuple[Array, Array]:
    """Errors of normals by friction across the whisker, along the object.

    Such friction rotates the force about the whisker's tangent t, and the normal n by φ t × n. It
    is opposite to the motion along the object, which is similar for similar contacts: φ is mostly a
    linear function of the normal, with coefficients that all contacts share.

    The results are the covariance (n, 3, 3) of each normal and changes (n, 4, 6) of points and
    normals by one standard deviation of each coefficient. If ``alone``, or if the tangents are not
    known, each contact has its own error only.
    """
    normal = _rows(estimates["contact_normal"])
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    if "contact_tangent" not in estimates:  # the error is in an unknown direction
        across = np.eye(3) - normal[:, :, None] * normal[:, None, :]
        return lean**2 * across, np.zeros((len(normal), 0, 6))
    turned = lean * np.cross(_rows(estimates["contact_tangent"]), normal)
    own = 1.0 if alone else _ALONE
    each = np.concatenate([np.ones((len(normal), 1)), normal], axis=1)
    shared = np.zeros((len(normal), 4, 6))
    shared[:, :, 3:] = np.sqrt(0.5 * (1.0 - own)) * each[:, :, None] * turned[:, None]
    return own * turned[:, :, None] * turned[:, None, :], shared


def contour_points(recording: xr.DataTree, whiskers: Sequence[Whisker] | None = None) -> xr.Dataset:
    """Table of all contacts as points of a contour, laboratory frame, dimension ``contact``."""
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
    """Values (frames × whiskers, ...) of a variable over time and whisker."""
    values = variable.transpose(*EACH, ...).values
    return np.asarray(values.reshape(-1, *values.shape[2:]))


def _compared(
    fit: FittedShape, estimates: xr.Dataset, whiskers: Sequence[Whisker], objects: Sequence[Surface]
) -> dict[str, Any]:
    """Variables that compare contacts and fit with the known object nearest to the contacts."""
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


# Shapes with few parameters.
SIMPLE: tuple[Shape, ...] = tuple(shape for shape in get_args(Shape) if shape != "free")
# Largest χ² per degree of freedom of a shape that agrees with the contacts: twice their noise.
AGREES = 4.0
STRONG = 10.0  # smallest difference of the information criterion that prefers one shape to another


def compare_shapes(
    estimates: xr.Dataset,
    whiskers: Sequence[Whisker],
    *,
    axis: ArrayLike | None = None,
    lean: float | None = None,
) -> xr.Dataset:
    """Fit all simple shapes to contacts and compare them.

    Parameters
    ----------
    estimates : xarray.Dataset
        Dataset of `estimates_of`, dimensions time, whisker.
    whiskers : sequence of Whisker
        Whiskers that touched the object.
    axis : array_like (3,), optional
        Direction of a cylinder's axis where it is known.
    lean : float, optional
        Standard deviation of the angle between normals and forces, rad, as for `fit_contacts`.

    Returns
    -------
    xarray.Dataset
        Dataset of dimension ``shape``: ``misfit``, χ² per degree of freedom, and ``evidence``, the
        excess of its information criterion over that of the best shape, for which it is 0. Both are
        NaN for shapes that cannot be fitted, and for all if the noise of the contacts is unknown.
    """
    fits: dict[str, FittedShape] = {}
    for shape in SIMPLE:
        known = axis if shape == "cylinder" else None
        try:
            fits[shape] = fit_contacts(estimates, whiskers, shape, axis=known, lean=lean)
        except ValueError:
            continue  # contacts may not determine every shape
    misfit, evidence = np.full((2, len(SIMPLE)), np.nan)
    if fits and min(fit.equations for fit in fits.values()) > 0:
        rows = np.all([fit.used for fit in fits.values()], axis=0)
        for i, shape in enumerate(SIMPLE):
            if shape in fits:
                fit = fits[shape]
                misfit[i] = fit.misfit
                unknowns = int(np.linalg.matrix_rank(fit.covariance, hermitian=True))
                evidence[i] = evidence_of(fit.chi_squared[rows], unknowns)
        best = fits[SIMPLE[int(np.nanargmin(evidence))]]
        together = frames_together(scores_of(best, estimates))
        evidence = (evidence - np.nanmin(evidence)) / together
    return xr.Dataset(
        {
            "misfit": ("shape", misfit, {"units": "1", "long_name": "χ² per degree of freedom"}),
            "evidence": ("shape", evidence, {"units": "1", "long_name": "evidence against it"}),
        },
        {"shape": list(SIMPLE)},
    )


# Edges of the classes of deflection angle, degrees.
ANGLE_CLASSES = (0.0, 2.0, 5.0, 10.0, 15.0, 90.0)


def nearest_object(
    estimates: xr.Dataset, whiskers: Sequence[Whisker], objects: Sequence[Surface]
) -> int:
    """Index of the object with the smallest median distance from the contacts."""
    if not objects:
        raise ValueError("no object is known to compare with")
    points = Group(estimates)["contact_point"]
    there = np.isfinite(points).all(axis=-1)
    if not there.any():
        raise ValueError("there are no contacts to compare with the objects")
    radius = whisker_radii(estimates, whiskers)[there]
    medians = [
        np.median(np.abs(thing.signed_distance(points[there]) - radius)) for thing in objects
    ]
    return int(np.argmin(medians))


def compare_contacts(
    recording: xr.DataTree,
    objects: Sequence[Surface] | None = None,
    whiskers: Sequence[Whisker] | None = None,
    seed: int = 0,
) -> xr.Dataset:
    """Compare contacts with the nearest known object, as `vibrissa.contour.compare_with` does."""
    estimates = estimates_in(recording)
    trial, contacts = Recording(recording), Group(estimates)
    known = trial.objects if objects is None else tuple(objects)
    touching = trial.whiskers if whiskers is None else whiskers
    number = nearest_object(estimates, touching, known)
    spread = contacts["contact_covariance"]
    out = compare_with(
        known[number],
        contacts["contact_point"],
        spread if np.isfinite(spread).any() else None,
        whisker_radii(estimates, touching),
        dims=EACH,
        coords={name: estimates[name].variable for name in EACH if name in estimates.coords},
        seed=seed,
    )
    local = contacts["contact_point_whisker"]
    angle = np.full(local.shape[:2], np.nan)
    for k, whisker in enumerate(touching):
        rows = np.flatnonzero(np.isfinite(local[:, k]).all(axis=1))
        distance, arc_length = nearest_on_rest(whisker, local[rows, k])
        angle[rows, k] = np.arctan2(distance, arc_length)
    by = {"deflection_angle": angle, "r": np.linalg.norm(local, axis=-1)}
    if "signals" in trial:
        by["MB"] = trial["signals"]["MB"]
    out = out.assign({name: (EACH, v, attributes(name)) for name, v in by.items()})
    return out.assign_attrs(object=number)


def distances_by_class(compared: xr.Dataset) -> dict[str, xr.Dataset]:
    """Summarise distances from a known object by classes of deflection angle, r and M_B."""
    tables = {}
    for name in ("deflection_angle", "r", "MB"):
        if name in compared:
            edges = np.deg2rad(ANGLE_CLASSES) if name == "deflection_angle" else None
            tables[name] = distances_by(compared, name, compared[name].values, edges)
    return tables
