"""Errors of tracks, signals and contacts relative to the truth, for demo, reports and studies.

Predicted errors of contacts are sampled, not linearised: errors are drawn from the estimated
covariance of every contact, once per replicate, each replicate is scored like the trial itself, and
the median over replicates is the prediction.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from vibrissa.contour import CylinderFit, axis_offset
from vibrissa.numerics import Array
from vibrissa.objects import Peg
from vibrissa.pipeline import ANGLE_CLASSES
from vibrissa.recording import Group, Recording
from vibrissa.signals import cone_angle, spherical, within_turn
from vibrissa.whisker import Whisker

__all__ = [
    "Scores",
    "TrackingScores",
    "contact_errors",
    "signal_errors",
    "spread",
    "tracking_scores",
    "truth_of",
]
__dir__ = __all__.copy

ERRORS = ("error_r", "error_theta", "error_phi", "error_distance")
"""Names of the errors in r, θ, φ, and of the distance in space."""

REPLICATES = 25
ANGLES = ANGLE_CLASSES
"""Edges of the classes of deflection angle, degrees."""

_QUANTILES = (0.5, 0.95, 1.0)


@dataclass(frozen=True, eq=False)
class ErrorRow:
    """Measured and predicted errors in one quantity: median, 95 % quantile and largest."""

    quantity: str
    label: str
    contacts: int
    measured: Array
    predicted: Array


@dataclass(frozen=True, eq=False)
class Scores:
    """All scores of a trial.

    Parameters
    ----------
    touching : int
        Number of frames in which the whisker is truly in contact.
    detected : int
        Number of frames in which a contact is detected.
    false : int
        Number of frames in which a contact is detected but there is none.
    candidates : array (3,)
        Numbers of detected contacts with no, one, and several candidates.
    errors : tuple of ErrorRow
        Errors in r, θ, φ and in space, all contacts.
    by_angle : tuple of ErrorRow
        Errors in space by deflection angle.
    offset : array (3,)
        Vector from the peg's true axis to the fitted one, m, at the height of the contacts.
    tilt : float
        Angle between the axes, rad.
    diameter_error : float
        Error of the fitted peg's diameter, m.
    surface : array (3,)
        Median, 95 % quantile and largest distance of the contacts from the true surface, m.
    """

    touching: int
    detected: int
    false: int
    candidates: NDArray[np.int64]
    errors: tuple[ErrorRow, ...]
    by_angle: tuple[ErrorRow, ...]
    offset: Array
    tilt: float
    diameter_error: float
    surface: Array

    @property
    def share_with_one(self) -> float:
        """Share of detected contacts with exactly one candidate."""
        return float(self.candidates[1] / max(self.detected, 1))


def contact_errors(
    contacts: xr.Dataset, truth: xr.Dataset, whisker: Whisker, seed: int = 0
) -> xr.Dataset:
    """Compare contacts with the truth, frame by frame.

    Parameters
    ----------
    contacts : xarray.Dataset
        Dataset from `vibrissa.pipeline.estimates_of`, of one whisker, dimension time.
    truth : xarray.Dataset
        Truth of the recording, dimension time: ``contact_point``, ``contact_point_whisker``.
    whisker : Whisker
        True whisker, rather than the tracked one.
    seed : int
        Seed of the draws.

    Returns
    -------
    xarray.Dataset
        Dataset of dimensions time, replicate: the absolute value of each error, ``…_predicted`` and
        ``deflection_angle``. Errors in r, θ and φ are in the whisker frame, that in space is in the
        laboratory frame, so that it includes the error of the pose.
    """
    point, true = (d["contact_point_whisker"].values for d in (contacts, truth))
    draw = np.random.default_rng(seed).normal(size=(REPLICATES, len(point), 3))
    deviation = np.einsum("tij,rtj->rti", _square_roots(contacts["covariance"].values), draw)
    placed = np.einsum("tij,rtj->rti", _square_roots(contacts["contact_covariance"].values), draw)
    away = contacts["contact_point"].values - truth["contact_point"].values
    errors = _with_size(_errors(point, true), away)
    drawn = _with_size(_errors(point + deviation, point), placed)
    data = {name: ("time", errors[..., i]) for i, name in enumerate(ERRORS)}
    predicted = {
        f"{name}_predicted": (("replicate", "time"), drawn[..., i]) for i, name in enumerate(ERRORS)
    }
    angle = cone_angle(whisker, truth["contact_point_whisker"].values)
    angles = {"deflection_angle": ("time", angle)}
    return xr.Dataset({**data, **predicted, **angles}, {"time": contacts["time"]})


def _errors(estimated: Array, true: Array) -> Array:
    """Absolute errors (..., 3) in r, θ, φ."""
    away = within_turn(spherical(estimated) - spherical(true), [False, True, False])
    return np.asarray(np.abs(away))


def _with_size(errors: Array, away: Array) -> Array:
    """Append the magnitude of errors in space as a fourth column."""
    return np.concatenate([errors, np.linalg.norm(away, axis=-1, keepdims=True)], axis=-1)


def _square_roots(covariance: Array) -> Array:
    """Matrices A (n, 3, 3) with A Aᵀ = covariance, of any rank; NaN where the covariance is."""
    known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    size, direction = np.linalg.eigh(np.where(known[:, None, None], covariance, 0.0))
    root = direction * np.sqrt(np.maximum(size, 0.0))[:, None, :]
    return np.where(known[:, None, None], root, np.nan)


def score(
    contacts: xr.Dataset,
    truth: xr.Dataset,
    errors: xr.Dataset,
    fit: CylinderFit,
    peg: Peg,
    radius: Array,
) -> Scores:
    """Score a trial with a peg; ``radius`` (time,) is the whisker's at the contacts, m."""
    detected = contacts["in_contact"].values
    touching = truth["in_contact"].values
    number = contacts["candidates"].values[detected]
    known = np.isfinite(errors["error_distance"].values)
    of_all, by_angle = error_rows(errors)
    offset, tilt = axis_offset(fit.origin, fit.axis, peg.origin, peg.axis)
    gap = peg.signed_distance(contacts["contact_point"].values[known]) - radius[known]
    return Scores(
        touching=int(touching.sum()),
        detected=int(detected.sum()),
        false=int((detected & ~touching).sum()),
        candidates=np.array([(number == 0).sum(), (number == 1).sum(), (number > 1).sum()]),
        errors=of_all,
        by_angle=by_angle,
        offset=offset,
        tilt=tilt,
        diameter_error=float(fit.diameter - 2.0 * peg.radius),
        surface=_quantiles(np.abs(gap)),
    )


def error_rows(errors: xr.Dataset) -> tuple[tuple[ErrorRow, ...], tuple[ErrorRow, ...]]:
    """Summarise errors of contacts, for all and by deflection angle."""
    known = np.isfinite(errors["error_distance"].values)
    angle = np.degrees(errors["deflection_angle"].values)
    by_angle = []
    for low, high in itertools.pairwise(ANGLES):
        rows = known & (angle >= low) & (angle < high)
        if rows.any():
            by_angle.append(_error_row(errors, "error_distance", angle_label(low, high), rows))
    return tuple(_error_row(errors, name, "all", known) for name in ERRORS), tuple(by_angle)


def angle_label(low: float, high: float) -> str:
    """Label of a class of deflection angle."""
    return f"{low:g}–{high:g}°" if high < ANGLES[-1] else f"over {low:g}°"


def _error_row(errors: xr.Dataset, name: str, label: str, rows: NDArray[np.bool_]) -> ErrorRow:
    """Summarise the errors of some frames in one quantity."""
    drawn = errors[f"{name}_predicted"].values[:, rows]
    drawn = drawn[:, np.isfinite(drawn).all(axis=0)]
    predicted = np.median([_quantiles(replicate) for replicate in drawn], axis=0)
    measured = _quantiles(errors[name].values[rows])
    return ErrorRow(name, label, int(rows.sum()), measured, predicted)


def _quantiles(values: Array) -> Array:
    """Median, 95 % quantile and largest of values (n,)."""
    if values.size == 0:
        return np.full(len(_QUANTILES), np.nan)
    return np.asarray(np.quantile(values, _QUANTILES))


_SPREAD = (50.0, 95.0)


@dataclass(frozen=True, eq=False)
class TrackingScores:
    """Errors of tracking: medians and 95 % quantiles, SI units except for pixels.

    Parameters
    ----------
    frames, lost : int
        Number of frames, and of those in which the whisker was not found.
    trace : array (view, 2)
        Distance of traced points from the true whisker in the image, pixels; without views if
        traces are unknown.
    centerline : array (2,)
        Errors of points in space from the whisker's centreline, m.
    base : array (2,)
        Errors of the whisker's base, m.
    contact : array (2,)
        Errors of the contact point, m, in frames that are in contact and were found to be.
    classified : float
        Share of the frames in which contact is classified correctly.
    """

    frames: int
    lost: int
    trace: Array
    centerline: Array
    base: Array
    contact: Array
    classified: float


@dataclass(frozen=True, eq=False)
class SignalRow:
    """Relative errors (2,) of force and moment in a class of deflection angle, laboratory frame."""

    label: str
    contacts: int
    force: Array
    moment: Array


def tracking_scores(tracked: xr.Dataset, truth: xr.Dataset) -> TrackingScores:
    """Compare tracking results with the truth.

    Parameters
    ----------
    tracked : xarray.Dataset
        Tracked recording of one whisker: ``in_contact``, ``contact_point``, and if known ``trace``,
        ``trace_visible``, ``centerline``, ``base_position``, ``confidence``.
    truth : xarray.Dataset
        Truth of the same whisker in the same frames, from `truth_of`.

    Returns
    -------
    TrackingScores
        Errors; NaN for what is unknown in either.
    """
    unknown = np.full(2, np.nan)
    touching = [Group(data)["in_contact"] for data in (tracked, truth)]
    away = _distances(tracked, truth, "contact_point")[touching[0] & touching[1]]
    base = centerline = unknown
    if "base_position" in tracked and "base_position" in truth:
        base = spread(_distances(tracked, truth, "base_position"))
    if "centerline" in tracked and "centerline" in truth:
        lines = [Group(data)["centerline"] for data in (tracked, truth)]
        centerline = spread(distances_from_curves(lines[0], refine_curves(lines[1])))
    lost = int((tracked["confidence"].values == 0.0).sum()) if "confidence" in tracked else 0
    return TrackingScores(
        frames=tracked.sizes["time"],
        lost=lost,
        trace=_trace_errors(tracked, truth),
        centerline=centerline,
        base=base,
        contact=spread(away),
        classified=float((touching[0] == touching[1]).mean()),
    )


def _distances(tracked: xr.Dataset, truth: xr.Dataset, name: str) -> Array:
    """Distances (time,) of a point from the true one."""
    pair = [Group(data)[name] for data in (tracked, truth)]
    return np.asarray(np.linalg.norm(pair[0] - pair[1], axis=-1))


def _trace_errors(tracked: xr.Dataset, truth: xr.Dataset) -> Array:
    """Median and 95 % quantile of the distances of visible traced points, view by view."""
    if "trace" not in tracked or "trace" not in truth:
        return np.empty((0, 2))
    traced, true = (np.swapaxes(Group(data)["trace"], 0, 1) for data in (tracked, truth))
    seen = np.ones(traced.shape[:3], dtype=bool)
    if "trace_visible" in tracked:
        seen = np.swapaxes(Group(tracked)["trace_visible"], 0, 1)
    views = zip(traced, map(refine_curves, true), seen, strict=True)
    return np.array([spread(distances_from_curves(a, b)[visible]) for a, b, visible in views])


def signal_errors(signals: xr.Dataset, truth: xr.Dataset, angle: Array) -> tuple[SignalRow, ...]:
    """Compare force and moment with the truth, by deflection angle.

    Parameters
    ----------
    signals : xarray.Dataset
        Dataset of the group ``signals``, one whisker.
    truth : xarray.Dataset
        Truth of the same whisker in the same frames, from `truth_of`.
    angle : array (time,)
        Deflection angle, rad.

    Returns
    -------
    tuple of SignalRow
        Errors in each class that has frames.
    """
    errors = {}
    for name in ("force", "moment"):
        found, true = (_in_laboratory(data, name) for data in (signals, truth))
        with np.errstate(invalid="ignore", divide="ignore"):
            errors[name] = np.linalg.norm(found - true, axis=1) / np.linalg.norm(true, axis=1)
    known = Group(truth)["in_contact"] & Group(signals)["in_contact"]
    known &= np.isfinite(errors["force"]) & np.isfinite(errors["moment"])
    rows = []
    for low, high in itertools.pairwise(ANGLES):
        some = known & (angle >= np.radians(low)) & (angle < np.radians(high))
        if some.any():
            both = (spread(errors[name][some]) for name in ("force", "moment"))
            rows.append(SignalRow(angle_label(low, high), int(some.sum()), *both))
    return tuple(rows)


def _in_laboratory(data: xr.Dataset, name: str) -> Array:
    """Rotate vectors (time, 3) from the whisker to the laboratory frame."""
    known = Group(data)
    return np.asarray(np.einsum("tij,tj->ti", known["base_rotation"], known[name]))


def refine_curves(curves: Array, times: int = 8) -> Array:
    """Interpolate more points of smooth curves, whose chords would cut across bends."""
    steps = np.arange(curves.shape[1])
    at = np.linspace(0.0, steps[-1], times * int(steps[-1]) + 1)
    before = np.minimum(at.astype(int), steps[-1] - 1)
    share = (at - before)[:, None]
    fine = (1.0 - share) * curves[:, before] + share * curves[:, before + 1]
    known = np.isfinite(curves).all(axis=(1, 2))
    if known.any():
        fine[known] = make_interp_spline(steps, curves[known], axis=1)(at)
    return np.asarray(fine)


def distances_from_curves(points: Array, curves: Array) -> Array:
    """Distances of points (time, n, d) from curves (time, m, d), frame by frame."""
    out = np.full(points.shape[:2], np.nan)
    for i, (some, curve) in enumerate(zip(points, curves, strict=True)):
        start, step = curve[:-1], np.diff(curve, axis=0)
        away = some[:, None] - start
        squared = np.einsum("md,md->m", step, step)
        share = np.clip(np.einsum("nmd,md->nm", away, step) / squared, 0.0, 1.0)
        foot = away - share[..., None] * step
        distance = np.linalg.norm(foot, axis=-1)
        known = np.isfinite(distance).any(axis=1)
        out[i, known] = np.nanmin(distance[known], axis=1)
    return out


def spread(values: Array) -> Array:
    """Median and 95 % quantile of the known values.

    Parameters
    ----------
    values : array
        Values of any shape; NaN is ignored.

    Returns
    -------
    array (2,)
        Quantiles; NaN if no value is known.
    """
    known = values[np.isfinite(values)]
    return np.percentile(known, _SPREAD) if known.size else np.full(2, np.nan)


_POSE = ("base_position", "base_rotation")

_CIRCULAR = (
    "The model computes signals for the contact that was tracked, and inverts them: this tests "
    "tracking and inversion, not what a whisker measures."
)


def with_truth(tracked: xr.DataTree, simulated: xr.DataTree) -> xr.DataTree:
    """Add the truth of a simulated trial to its tracked recording."""
    groups = {group.path: group.to_dataset(inherit=False) for group in tracked.subtree}
    for group in simulated.subtree:
        if group.path.startswith(("/truth", "/objects")):
            # The curves of the truth have different nodes.
            data = group.to_dataset(inherit=False)
            groups[group.path] = data.rename(node="true_node") if "node" in data.dims else data
        elif group.path.startswith("/whiskers"):
            groups[f"/truth{group.path}"] = group.to_dataset(inherit=False)
    root = simulated.to_dataset()
    groups["/truth"] = groups["/truth"].assign({name: root[name].variable for name in _POSE})
    return xr.DataTree.from_dict(groups)


def truth_of(recording: xr.DataTree, whisker: int = 0) -> tuple[xr.Dataset, Whisker]:
    """Return the truth of one whisker.

    Parameters
    ----------
    recording : xarray.DataTree
        Recording with a group ``truth``, simulated or from `with_truth`.
    whisker : int
        Index of the whisker along the dimension ``whisker``.

    Returns
    -------
    truth : xarray.Dataset
        Truth, dimension time, with the true ``base_position`` and ``base_rotation`` if they are
        known.
    whisker : Whisker
        True whisker; the tracked one if no other is known.
    """
    group = recording.children["truth"]
    truth = group.to_dataset()
    if "measured" not in recording.children:
        root = recording.to_dataset()
        truth = truth.assign({n: root[n] for n in _POSE if n in root and n not in truth})
    known = group if "whiskers" in group.children else recording
    return Group(truth).whisker(whisker).data, Recording(known).whisker(whisker)


def caution(source: object) -> str | None:
    """State what the errors of contacts do not test, given the source of their signals."""
    return _CIRCULAR if source in ("contact point", "rod") else None
