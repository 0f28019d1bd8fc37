"""Sections about a trial: what it is, what was done with it, and how well it was done.

Errors are given where the truth is part of the recording; without it there is
still what fits report of themselves. What a recording lacks is named with the verb that makes it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.contour import shape_from_dataset
from vibrissa.display import show
from vibrissa.evaluation import (
    ErrorRow,
    caution,
    contact_errors,
    deflection_angle,
    error_rows,
    signal_errors,
    spread,
    tracking_scores,
    truth_of,
)
from vibrissa.pipeline import compare_contacts, distances_by_class
from vibrissa.quantities import QUANTITIES, quantity
from vibrissa.recording import Recording
from vibrissa.report.page import Section, paragraph, shown_value, table
from vibrissa.signals import CIRCULAR, SIGNALS, base_signals, within_turn
from vibrissa.status import describe
from vibrissa.whisker import Whisker

Array = NDArray[np.float64]

STAGES = {"signals": "signals", "estimates": "estimate", "contour": "reconstruct"}
"""Groups of a recording, and the verbs that make them."""

# What can be compared.
_TRACKED = ("contact_point", "in_contact")
_FELT = ("force", "moment", "in_contact", "base_rotation")
_FOUND = ("contact_point", "contact_point_whisker", "in_contact")
_SPREADS = ("covariance", "contact_covariance", "candidates")

_SPREAD = ("median", "95 %")

_NOTHING = "No contact of this whisker was felt that there truly was: there is nothing to compare."

_SUSPECT = 1.5
"""Misfit from which another shape may go better."""


def trial_sections(recording: xr.DataTree, whisker: int = 0, seed: int = 0) -> list[Section]:
    """Tell what a recording is, what was done with it and how well.

    Parameters
    ----------
    recording : DataTree
        A trial.
    whisker : int
        Which one, from 0.
    seed : int
        Of the draws of what covariances predict.

    Returns
    -------
    list of Section
        The recording; settings; then tracking, signals, estimates and the contour, as far as
        they are there; statuses.

    Raises
    ------
    ValueError
        If there is no such whisker.
    """
    bent = Recording(recording).whisker(whisker)
    groups = {name: _one(recording, name, whisker) for name in ("", "signals", "estimates")}
    truth, true_whisker = None, bent
    if "truth" in recording.children:
        truth, true_whisker = truth_of(recording, whisker)
    parts = [
        Section("recording", "What was recorded", show(recording).html + bent._repr_html_()),
        Section("settings", "What was done, with which settings", _settings(recording)),
    ]
    if recording.sizes["whisker"] > 1:
        parts.append(Section("whiskers", "Whiskers", whiskers_table(recording, whisker)))
    root = groups[""]
    if "measured" in recording.children and root is not None and "in_contact" in root:
        parts.append(Section("tracked", "What was tracked", tracked_table(root)))
    if truth is not None:
        parts += _against_truth(recording, groups, truth, true_whisker, seed)
    if "contour" in recording.children:
        parts.append(Section("contour", "The contour", _contour(recording, seed)))
    counted = _statuses(groups)
    return [*parts, Section("statuses", "Statuses", counted)] if counted else parts


def _one(recording: xr.DataTree, name: str, whisker: int) -> xr.Dataset | None:
    """A group for one whisker."""
    group = Recording(recording).find(name)
    return None if group is None else group.whisker(whisker).data


def _settings(recording: xr.DataTree) -> str:
    """Attributes of the groups, and which stages are missing."""
    rows = [
        (str(group.path).strip("/") or "recording", str(name).replace("_", " "), _said(name, value))
        for group in recording.subtree
        if not group.path.startswith(("/whiskers", "/objects"))
        for name, value in group.attrs.items()
        if name != "kind"
    ]
    facts = table(
        [(f"{where}: {name}", value) for where, name, value in rows], caption="Settings by stage"
    )
    lacking = [
        f"There is no group {group}: `vibrissa {verb}` makes it."
        for group, verb in STAGES.items()
        if group not in recording.children
    ]
    if "truth" not in recording.children:
        lacking.append("There is no truth in this recording, so errors cannot be told.")
    return facts + "".join(paragraph(each, "note") for each in lacking)


def _said(name: object, value: object) -> str:
    """Write an attribute; what is known to be a signal's size in its unit."""
    if name == "felt_above":
        return f"M_B over {shown_value('MB', float(str(value)))}"
    if name == "noise" and isinstance(value, np.ndarray | list | tuple) and len(value) == 6:
        force, moment = np.split(np.asarray(value, dtype=np.float64), 2)
        sizes = (("force", force), ("moment", moment))
        return "; ".join(f"{each} {_one_or_all(each, sigma)}" for each, sigma in sizes)
    if name == "cutoff":
        return f"{float(str(value)):g} Hz"
    if isinstance(value, np.ndarray | list | tuple):
        return ", ".join(_said("", each) for each in value)
    return f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)


def _one_or_all(name: str, sigma: Array) -> str:
    """Standard deviations of three components."""
    told = [shown_value(name, float(each), 3) for each in sigma]
    return f"{told[0]} each" if len(set(told)) == 1 else ", ".join(told)


def _against_truth(
    recording: xr.DataTree,
    groups: dict[str, xr.Dataset | None],
    truth: xr.Dataset,
    whisker: Whisker,
    seed: int,
) -> Iterator[Section]:
    """Sections on stages that can be compared with the truth."""
    root, signals, estimates = groups.values()
    assert root is not None
    if "measured" in recording.children:
        lacking = _lacking(_TRACKED, root, truth)
        yield Section("tracking", "Tracking", lacking or tracking_tables(root, truth))
    if signals is not None:
        lacking = _lacking(_FELT, signals, truth, also_true=("contact_point_whisker",))
        yield Section("signals", "Signals", lacking or _signal_errors(signals, truth, whisker))
    if estimates is not None:
        lacking = _lacking(_FOUND, estimates, truth, also_found=_SPREADS)
        told = lacking or _contact_errors(estimates, truth, whisker, seed)
        yield Section("estimates", "Estimated contacts", told)


def _contact_errors(estimates: xr.Dataset, truth: xr.Dataset, whisker: Whisker, seed: int) -> str:
    """Tables of contacts felt, and of their errors."""
    told = _felt(estimates, truth)
    if np.isfinite(estimates["contact_point"].values).any():
        told += _errors(*error_rows(contact_errors(estimates, truth, whisker, seed)))
    else:
        told += paragraph(_NOTHING)
    warned = caution(estimates.attrs.get("source"))
    return told + (paragraph(warned, "note") if warned else "")


def _signal_errors(signals: xr.Dataset, truth: xr.Dataset, whisker: Whisker) -> str:
    """Tables of the errors of force and moment, and of the six signals."""
    rows, six = signal_rows(signals, truth, whisker), six_rows(signals, truth)
    if not rows or not six:
        return paragraph(_NOTHING)
    told = table(
        rows,
        ("deflection angle", "contacts", "force", "moment", "force, 95 %", "moment, 95 %"),
        "Error of force and moment, median",
        "Size of the error over that of the true vector, in the laboratory frame.",
    )
    return told + table(
        six,
        ("signal", "contacts", *_SPREAD, "largest", "true, median size"),
        "Error of the six signals",
        "Felt less true, each in its own whisker frame, where the whisker touches and was felt "
        "to; directions on the circle.",
    )


def _lacking(
    names: Sequence[str],
    found: xr.Dataset,
    truth: xr.Dataset,
    also_found: Sequence[str] = (),
    also_true: Sequence[str] = (),
) -> str:
    """A note on what is not there to be compared; nothing where all is."""
    told = []
    for where, data, also in (
        ("what was found", found, also_found),
        ("the truth in this recording", truth, also_true),
    ):
        absent = [name for name in (*names, *also) if name not in data.data_vars]
        if absent:
            told.append(f"{where} has no {', '.join(absent)}")
    return paragraph(f"Errors cannot be told: {'; '.join(told)}.", "note") if told else ""


def _has(names: Sequence[str], *data: xr.Dataset | None) -> bool:
    """Whether all of some datasets have all of some variables."""
    return all(each is not None and set(names) <= set(each.data_vars) for each in data)


def tracking_tables(root: xr.Dataset, truth: xr.Dataset) -> str:
    """Tell the errors of what was tracked."""
    scores = tracking_scores(root, truth)
    touching = [data["in_contact"].values.astype(bool) for data in (root, truth)]
    both = touching[0] & touching[1]
    views = root["view"].values if len(scores.trace) else ()
    named = [
        (f"trace, {view} view", "trace", each)
        for view, each in zip(views, scores.trace, strict=True)
    ]
    named += [
        ("centreline", "centerline", scores.centerline),
        ("base", "base_position", scores.base),
    ]
    lines = [
        (label, *_spread_cells(name, each))
        for label, name, each in named
        if np.isfinite(each).any()
    ]
    rows = [(quantity("contact_point").long_name, *_spread_cells("contact_point", scores.contact))]
    for name in ("arc_length", "force", "moment"):
        if name not in root or name not in truth:
            continue
        away = root[name].values[both] - truth[name].values[both]
        size = np.linalg.norm(away, axis=-1) if away.ndim > 1 else np.abs(away)
        rows.append((quantity(name).long_name, *_spread_cells(name, spread(size))))
    drawn = table(
        lines,
        ("distance from the true line", *_SPREAD),
        "Tracked and true lines",
        "Of points of the trace that were seen, of all of the centreline, and of the base from the "
        "true one.",
    )
    return (drawn if lines else "") + table(
        rows,
        ("error of", *_SPREAD),
        "Tracked against true",
        f"Of {int(both.sum())} frames that are in contact and were found to be. Contact is told "
        f"from none in {100 * scores.told:.1f} % of {both.size} frames.",
    )


def _spread_cells(name: str, values: Array) -> list[str]:
    return [shown_value(name, float(value), 3) for value in values]


def six_rows(signals: xr.Dataset, truth: xr.Dataset) -> list[tuple[str, ...]]:
    """Sum up the errors of the six signals."""
    both = truth["in_contact"].values.astype(bool) & signals["in_contact"].values.astype(bool)
    felt, true = (base_signals(data["force"], data["moment"]) for data in (signals, truth))
    rows = []
    for name, direction in zip(SIGNALS, CIRCULAR, strict=True):
        away = within_turn(felt[name].values[both] - true[name].values[both], direction)
        size = np.abs(away)
        size = size[np.isfinite(size)]
        if not size.size:
            continue
        values = (*spread(size), size.max())
        usual = np.nan if direction else float(np.nanmedian(np.abs(true[name].values[both])))
        cells = (shown_value(name, float(value), 3) for value in (*values, usual))
        rows.append((quantity(name).long_name, str(size.size), *cells))
    return rows


def signal_rows(signals: xr.Dataset, truth: xr.Dataset, whisker: Whisker) -> list[tuple[str, ...]]:
    """Sum up errors of force and moment by deflection angle."""
    angle = deflection_angle(truth, whisker)
    rows = []
    for row in signal_errors(signals, truth, angle):
        shares = [*row.force, *row.moment]
        cells = (f"{100 * shares[i]:.3g} %" for i in (0, 2, 1, 3))
        rows.append((row.label, str(row.contacts), *cells))
    return rows


def _felt(estimates: xr.Dataset, truth: xr.Dataset) -> str:
    """How many contacts were felt and found."""
    felt = estimates["in_contact"].values.astype(bool)
    touching = truth["in_contact"].values.astype(bool)
    number = estimates["candidates"].values[felt]
    rows = [
        ("frames in contact", str(int(touching.sum()))),
        ("contacts felt", str(int(felt.sum()))),
        ("of these false", str(int((felt & ~touching).sum()))),
        ("with no candidate", str(int((number == 0).sum()))),
        ("with exactly one candidate", str(int((number == 1).sum()))),
        ("with several candidates", str(int((number > 1).sum()))),
    ]
    return table(rows, caption="Contacts")


def _errors(of_all: Sequence[ErrorRow], by_angle: Sequence[ErrorRow]) -> str:
    """Errors of estimated contacts, and what their covariance predicts."""
    names = (*_SPREAD, "largest", *(f"{name}*" for name in _SPREAD))
    note = "* what the estimates' own covariance predicts"
    all_rows = [(quantity(row.quantity).long_name, *_cells(row)) for row in of_all]
    class_rows = [(row.label, *_cells(row)) for row in by_angle]
    told = table(all_rows, ("of", "contacts", *names), "Error of the contact point", note)
    return told + table(
        class_rows,
        ("deflection angle", "contacts", *names),
        "Error in space by deflection angle",
        note,
    )


def _cells(row: ErrorRow) -> list[str]:
    values = (*row.measured, *row.predicted[:2])
    return [str(row.contacts), *(shown_value(row.quantity, float(value)) for value in values)]


def _contour(recording: xr.DataTree, seed: int) -> str:
    """The fit with its uncertainty, and how far it and the contacts are from a known object."""
    data = recording["contour"].to_dataset()
    fit = shape_from_dataset(data)
    sigma = fit.sigma
    rows = []
    for name, meant in fit.fields.items():
        values = np.atleast_1d(getattr(fit, name))
        own = [p for p in fit.parameters if p.startswith(name)]
        for parameter, value in zip(own, values, strict=True):
            label = parameter.replace("_", ", ")
            rows.append(
                (
                    label,
                    shown_value(meant, float(value), 6),
                    shown_value(meant, sigma[parameter], 3),
                )
            )
    told = table(
        rows,
        ("parameter", "fitted", "standard deviation"),
        f"The fitted {fit.kind}",
        f"{int(fit.inliers.sum())} contacts fit; root mean square of their distances: "
        f"{shown_value('surface_distance', fit.rms)}. Misfit {fit.misfit:.3g}: χ² per degree of "
        "freedom, about 1 where the shape and what is said of the errors are right.",
    )
    if fit.kind != "free" and fit.misfit > _SUSPECT:
        told += paragraph(
            "Contacts lie farther from it than their covariance allows: it may be of another shape "
            "(`vibrissa reconstruct --shape`), or the noise larger than it is said to be.",
            "note",
        )
    compared = [
        (quantity(name).long_name, _component_text(name, data[name].values))
        for name in ("axis_offset", "axis_tilt", "diameter_error", "radius_error", "center_offset")
        if name in data and name in QUANTITIES
    ]
    if compared:
        told += table(compared, caption="Fitted less known object")
    return told + _distances(recording, seed)


def _component_text(name: str, values: Array) -> str:
    """A number, or a vector in parentheses with its size."""
    if values.ndim == 0:
        return shown_value(name, float(values))
    each = ", ".join(shown_value(name, float(value)) for value in values)
    return f"({each}); size {shown_value(name, float(np.linalg.norm(values)))}"


def _distances(recording: xr.DataTree, seed: int) -> str:
    """Distances of contacts from the object that is known."""
    estimates = _one(recording, "estimates", 0)
    if not _has(("contact_point", "contact_covariance"), estimates):
        return ""
    assert estimates is not None
    points = recording["estimates"].to_dataset()["contact_point"].values
    if not Recording(recording).objects or not np.isfinite(points).any():
        return ""
    classes = distances_by_class(compare_contacts(recording, seed=seed))
    parts = []
    for name, sums in classes.items():
        known = quantity(name)
        unit = f" ({known.display_unit})" if known.display_unit else ""
        rows = [
            (
                str(sums["label"].values[i]),
                str(int(sums["contacts"].values[i])),
                *(
                    shown_value("surface_distance", float(sums[column].values[i]))
                    for column in (
                        "median",
                        "largest_95",
                        "median_predicted",
                        "largest_95_predicted",
                    )
                ),
            )
            for i in range(sums.sizes["class"])
        ]
        heading = (f"{known.long_name}{unit}", "contacts", *_SPREAD, *(f"{s}*" for s in _SPREAD))
        caption = f"Distance of contacts from the known object, by {known.long_name}"
        parts.append(table(rows, heading, caption))
    return "".join(parts) + paragraph("* what the covariance of the contacts predicts", "note")


def _statuses(groups: dict[str, xr.Dataset | None]) -> str:
    """In how many frames each group has which status."""
    counts = {
        name or "recording": describe(data["status"].values)
        for name, data in groups.items()
        if data is not None and "status" in data
    }
    if not counts:
        return ""
    sentences = dict.fromkeys(sentence for each in counts.values() for sentence in each)
    rows = [(each, *(str(count[each]) for count in counts.values())) for each in sentences]
    return table(rows, ("status", *counts), "Number of frames")


def whiskers_table(recording: xr.DataTree, chosen: int) -> str:
    """Tell which whiskers touched for how long, and how strongly."""
    names = [str(name) for name in recording.coords["whisker"].values]
    touching = contacts_by_whisker(recording)
    force = Recording(recording).root.get("force")
    rows = []
    for k in np.flatnonzero(touching):
        largest = np.nan
        if force is not None:
            size = np.linalg.norm(force[:, k], axis=1)
            largest = float(np.max(size, initial=0.0, where=np.isfinite(size)))
        rows.append((names[k], str(k), str(touching[k]), shown_value("force", largest)))
    told = paragraph(
        f"Signals and estimated contacts below are of whisker {names[chosen]}, number {chosen}; "
        "`--which` chooses another. The contour is of all."
    )
    if not rows:
        return told + paragraph(f"None of the {len(names)} whiskers is known to touch anything.")
    heading = ("whisker", "number", "frames in contact", "largest force")
    note = f"{len(names) - len(rows)} others are not known to touch anything."
    return told + table(rows, heading, "Whiskers that touch", note)


def contacts_by_whisker(recording: xr.DataTree) -> NDArray[np.int64]:
    """Count frames in contact by what tells of it first: estimates, signals, tracking, truth.

    Parameters
    ----------
    recording : DataTree
        A trial.

    Returns
    -------
    array (whiskers,) of int
        Frames; zero where nothing tells.
    """
    trial = Recording(recording)
    for group in map(trial.find, ("estimates", "signals", "", "truth")):
        if group is not None and "in_contact" in group:
            return np.asarray(group["in_contact"].sum(axis=0), dtype=np.int64)
    return np.zeros(recording.sizes["whisker"], dtype=np.int64)


def tracked_table(root: xr.Dataset) -> str:
    """Tell what tracking found, and how well by its own account."""
    touching = root["in_contact"].values.astype(bool)
    rows = [
        ("frames", str(touching.size)),
        ("of these in contact", str(int(touching.sum()))),
        ("lost", str(int((~np.isfinite(root["base_position"].values)).any(axis=-1).sum()))),
    ]
    for name in ("force", "moment"):
        size = np.linalg.norm(root[name].values, axis=-1)[touching] if name in root else []
        if np.isfinite(size).any():
            middle, largest = float(np.nanmedian(size)), float(np.nanmax(size))
            told = f"{shown_value(name, middle)}, up to {shown_value(name, largest)}"
            rows.append((f"{quantity(name).long_name}, in contact", told))
    if "contact_covariance" in root:
        covariance = root["contact_covariance"].values[touching]
        sigma = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
        if np.isfinite(sigma).any():
            told = shown_value("contact_point", float(np.nanmedian(sigma)), 3)
            rows.append(("standard deviation of the contact point", f"{told}, median, in space"))
    return table(rows, caption="By the rod that fits the images")
