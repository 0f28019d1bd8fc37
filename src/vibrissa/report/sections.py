"""Sections of a report on a trial, with its stages and errors, and on a contact map.

Errors are stated if the recording contains the truth; otherwise the uncertainties of the fits are.
Missing stages are named with the command that computes them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa import evaluation
from vibrissa.contacts import ContactMap, friction_assumed
from vibrissa.contour import shape_from_dataset
from vibrissa.display import show
from vibrissa.identifiability import verdict_rows
from vibrissa.io import events_in
from vibrissa.numerics import Array
from vibrissa.pipeline import compare_contacts, distances_by_class
from vibrissa.quantities import QUANTITIES, quantity, shown_unit, to_display
from vibrissa.recording import Recording
from vibrissa.report.page import Section, Tile, paragraph, shown_value, table, tiles, with_sigma
from vibrissa.signals import CIRCULAR, SIGNALS, base_signals, cone_angle, within_turn
from vibrissa.status import Status, describe
from vibrissa.whisker import Whisker

# Groups of a recording, and the commands that compute them.
STAGES = {"signals": "signals", "estimates": "estimate", "contour": "reconstruct"}
# Variables of tracking, signals and estimates that are compared with the truth.
_TRACKED = ("contact_point", "in_contact")
_FELT = ("force", "moment", "in_contact", "base_rotation")
_FOUND = ("contact_point", "contact_point_whisker", "in_contact")
_SPREADS = ("covariance", "contact_covariance", "candidates")
_SPREAD = ("median", "95 %")
_DISTANCES = ("median", "largest_95", "median_predicted", "largest_95_predicted")
_NOTHING = "None of this whisker's true contacts was detected, so there is nothing to compare."
_SIGNAL_NAMES = {"wrench": "all components of force and moment"}
_MOST_EVENTS = 60
_FARTHEST = 0.1  # largest distance from an object that is stated, m
_SUSPECT = 1.5  # misfit above which another shape may fit better


def trial_sections(recording: xr.DataTree, whisker: int = 0, seed: int = 0) -> list[Section]:
    """Sections that describe a recording, its stages and their errors."""
    bent = Recording(recording).whisker(whisker)
    found = {name: Recording(recording).find(name) for name in ("", "signals", "estimates")}
    groups = {
        name: None if group is None else group.whisker(whisker).data
        for name, group in found.items()
    }
    truth, true_whisker = None, bent
    if "truth" in recording.children:
        truth, true_whisker = evaluation.truth_of(recording, whisker)
    parts = [
        Section("results", "Results", _results(recording, groups, truth, true_whisker, seed)),
        Section("recording", "Recording", show(recording).html + bent._repr_html_()),
        Section("settings", "Settings", _settings(recording)),
    ]
    if recording.sizes["whisker"] > 1:
        parts.append(Section("whiskers", "Whiskers", whiskers_table(recording, whisker)))
    root = groups[""]
    if "measured" in recording.children and root is not None and "in_contact" in root:
        parts.append(Section("tracked", "Tracking", tracked_table(root)))
    if truth is not None and root is not None:  # stages that can be compared with the truth
        if "measured" in recording.children:
            text = _lacking(_TRACKED, root, truth) or tracking_tables(root, truth)
            parts.append(Section("tracking", "Tracking, against the truth", text))
        if (signals := groups["signals"]) is not None:
            text = _lacking(_FELT, signals, truth, also_true=("contact_point_whisker",))
            text = text or _signal_errors(signals, truth, true_whisker)
            parts.append(Section("signals", "Signals", text))
        if (estimates := groups["estimates"]) is not None:
            text = _lacking(_FOUND, estimates, truth, also_found=_SPREADS)
            text = text or _contact_errors(estimates, truth, true_whisker, seed)
            parts.append(Section("estimates", "Estimated contacts", text))
    if "contour" in recording.children:
        parts.append(Section("contour", "Contour", _contour(recording, seed)))
    happened = _events(recording)
    parts += [Section("events", "Events", happened)] if happened else []
    counted = _statuses(groups)
    return [*parts, Section("statuses", "Statuses", counted)] if counted else parts


def _results(
    recording: xr.DataTree,
    groups: dict[str, xr.Dataset | None],
    truth: xr.Dataset | None,
    whisker: Whisker,
    seed: int,
) -> str:
    """Main numbers of a trial: contacts, their error, the object's size and the misfit."""
    if (estimates := groups["estimates"]) is None:
        missing = "no contacts yet: `vibrissa estimate` adds them"
        found = [Tile("–", missing), Tile("–", "error of the contact point: no contacts yet")]
    else:
        located = np.isfinite(estimates["contact_point"].values).all(axis=-1)
        detected = estimates["in_contact"].values.astype(bool)
        number = f"{int((located & detected).sum())} of {int(detected.sum())}"
        found = [
            Tile(number, "contacts located of those detected"),
            _error_tile(estimates, truth, whisker, seed),
        ]
    if "contour" not in recording.children:
        missing = "no contour yet: `vibrissa reconstruct` adds it"
        return tiles([*found, Tile("–", missing), Tile("–", "misfit of the shape: no contour yet")])
    fit = shape_from_dataset(recording["contour"].to_dataset())
    size = Tile(f"{fit.kind}", "shape fitted to the contacts")
    if "radius" in fit.sigma:
        diameter = 2.0 * float(getattr(fit, "radius"))  # noqa: B009
        width, sigma = with_sigma("object_radius", diameter, 2.0 * fit.sigma["radius"])
        width = width.removesuffix(sigma.rpartition(" ")[2]).strip()
        size = Tile(f"{width} ± {sigma}", f"diameter of the {fit.kind} fitted to the contacts")
    misfit = Tile(
        f"{float(f'{fit.misfit:.2g}'):,g}", "misfit (χ² per degree of freedom; 1 is expected)"
    )
    return tiles([*found, size, misfit])


def _error_tile(
    estimates: xr.Dataset, truth: xr.Dataset | None, whisker: Whisker, seed: int
) -> Tile:
    """Median error of contact points: actual if the truth is known, otherwise predicted."""
    known = np.isfinite(estimates["contact_point"].values).any()
    if truth is not None and known and not _lacking(_FOUND, estimates, truth, _SPREADS):
        rows, _ = evaluation.error_rows(evaluation.contact_errors(estimates, truth, whisker, seed))
        for row in rows:
            if row.quantity == "error_distance":
                error = shown_value(row.quantity, float(row.measured[0]), 2)
                predicted = shown_value(row.quantity, float(row.predicted[0]), 2)
                return Tile(error, f"median error of the contact point (predicted: {predicted})")
    if "contact_covariance" not in estimates or not known:
        return Tile("–", "error of the contact point: unknown without noise or ground truth")
    sigma = np.sqrt(np.trace(estimates["contact_covariance"].values, axis1=-2, axis2=-1))
    error = shown_value("contact_point", float(np.nanmedian(sigma)), 2)
    return Tile(error, "predicted error of the contact point, median")


# Labels of settings, by attribute.
_LABELS = {
    "origin": "origin",
    "source": "source of the signals",
    "signals": "signals used",
    "friction": "friction along the whisker",
    "noise": "sensor noise, standard deviation",
    "felt_above": "contact is detected for",
    "shape": "fitted shape",
    "cutoff": "low-pass filter of the pose",
    "frames_together": "frames with correlated errors",
    "remarks": "remarks",
}


def _settings(recording: xr.DataTree) -> str:
    """Settings of the stages, and missing stages."""
    rows = [
        (f"{group.path.strip('/') or 'recording'}: {label}", _shown_setting(name, value))
        for group in recording.subtree
        if not group.path.startswith(("/whiskers", "/objects"))
        for name, label in _LABELS.items()
        if (value := group.attrs.get(name)) is not None
    ]
    facts = table(rows, caption="Settings by stage")
    lacking = [
        f"The stage {group} is missing: `vibrissa {verb}` adds it."
        for group, verb in STAGES.items()
        if group not in recording.children
    ]
    if "truth" not in recording.children:
        lacking.append("This recording holds no ground truth, so errors cannot be computed.")
    return facts + "".join(paragraph(each, "note") for each in lacking)


def _shown_setting(name: object, value: object) -> str:
    """Format an attribute, with its unit if it is a physical quantity."""
    if name == "felt_above":
        return f"bending moments above {shown_value('MB', float(str(value)), 2)}"
    if name == "signals":
        return _SIGNAL_NAMES.get(str(value), ", ".join(str(value).split()))
    if name == "noise" and isinstance(value, np.ndarray | list | tuple) and len(value) == 6:
        force, moment = np.split(np.asarray(value, dtype=np.float64), 2)
        texts = []
        for each, sigma in (("force", force), ("moment", moment)):
            sizes = [shown_value(each, float(component)) for component in sigma]
            one = f"{sizes[0]} each" if len(set(sizes)) == 1 else ", ".join(sizes)
            texts.append(f"{each} {one}")
        return "; ".join(texts)
    if name == "friction":
        return friction_assumed(float(str(value)))
    if name == "cutoff":
        return f"{float(str(value)):g} Hz"
    if isinstance(value, np.ndarray | list | tuple):
        return ", ".join(_shown_setting("", each) for each in value)
    return f"{value:.3g}" if isinstance(value, float | np.floating) else str(value)


def _contact_errors(estimates: xr.Dataset, truth: xr.Dataset, whisker: Whisker, seed: int) -> str:
    """Tables of detected contacts, their candidates and their errors."""
    detected = estimates["in_contact"].values.astype(bool)
    touching = truth["in_contact"].values.astype(bool)
    status = estimates["status"].values[detected]
    without = estimates["candidates"].values[detected] == 0
    rows = [
        ("frames in contact", str(int(touching.sum()))),
        ("contacts detected", str(int(detected.sum()))),
        ("false detections", str(int((detected & ~touching).sum()))),
        ("without an answer", str(int(without.sum()))),
        ("unique", str(int((status == Status.UNIQUE).sum()))),
        ("ambiguous", str(int((status == Status.AMBIGUOUS).sum()))),
    ]
    text = table(rows, caption="Contacts")
    if np.isfinite(estimates["contact_point"].values).any():
        errors = evaluation.contact_errors(estimates, truth, whisker, seed)
        of_all, by_angle = evaluation.error_rows(errors)
        names = ("contacts", *_SPREAD, "largest", *(f"{name}*" for name in _SPREAD))
        note = "* what the estimates' own covariance predicts"
        all_rows = [(quantity(row.quantity).long_name, *_cells(row)) for row in of_all]
        text += table(all_rows, ("of", *names), "Error of the contact point", note)
        class_rows, title = [(row.label, *_cells(row)) for row in by_angle], "Error in space by "
        text += table(class_rows, ("deflection angle", *names), f"{title}deflection angle", note)
    else:
        text += paragraph(_NOTHING)
    return text + _caution(estimates)


def _caution(found: xr.Dataset) -> str:
    warned = evaluation.caution(found.attrs.get("source"))
    return paragraph(warned, "note") if warned else ""


def _signal_errors(signals: xr.Dataset, truth: xr.Dataset, whisker: Whisker) -> str:
    """Tables of the errors of force and moment, and of the six signals."""
    rows, six = signal_rows(signals, truth, whisker), six_rows(signals, truth)
    if not rows or not six:
        return paragraph(_NOTHING)
    text = table(
        rows,
        ("deflection angle", "contacts", "force", "moment", "force, 95 %", "moment, 95 %"),
        "Error of force and moment, median",
        "Size of the error over that of the true vector, in the laboratory frame.",
    )
    return text + table(
        six,
        ("signal", "contacts", *_SPREAD, "largest", "true, median size"),
        "Error of the six signals",
        "Measured minus true, each in its own whisker frame, in frames of true and detected "
        "contact; directions on the circle.",
    )


def _lacking(
    names: Sequence[str],
    found: xr.Dataset,
    truth: xr.Dataset,
    also_found: Sequence[str] = (),
    also_true: Sequence[str] = (),
) -> str:
    """Note on quantities missing for a comparison; empty if there are none."""
    text = []
    for where, data, also in (
        ("the result", found, also_found),
        ("the truth in this recording", truth, also_true),
    ):
        if absent := [name for name in (*names, *also) if name not in data.data_vars]:
            text.append(f"{where} lacks {', '.join(absent)}")
    return paragraph(f"Errors cannot be computed: {'; '.join(text)}.", "note") if text else ""


def tracking_tables(root: xr.Dataset, truth: xr.Dataset) -> str:
    """Tables of the errors of tracking."""
    scores = evaluation.tracking_scores(root, truth)
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
        rows.append((quantity(name).long_name, *_spread_cells(name, evaluation.spread(size))))
    drawn = table(
        lines,
        ("distance from the true line", *_SPREAD),
        "Tracked and true lines",
        "Distances of the visible points of the trace, of all points of the centreline, and of the "
        "base from the true one.",
    )
    return (drawn if lines else "") + table(
        rows,
        ("error of", *_SPREAD),
        "Tracked against true",
        f"Over {int(both.sum())} frames of true and detected contact. Contact is classified "
        f"correctly in {100 * scores.classified:.1f} % of {both.size} frames.",
    )


def _spread_cells(name: str, values: Array) -> list[str]:
    return [shown_value(name, float(value)) for value in values]


def six_rows(signals: xr.Dataset, truth: xr.Dataset) -> list[tuple[str, ...]]:
    """Rows of a table of the errors of the six signals."""
    both = truth["in_contact"].values.astype(bool) & signals["in_contact"].values.astype(bool)
    detected, true = (base_signals(data["force"], data["moment"]) for data in (signals, truth))
    rows = []
    for name, direction in zip(SIGNALS, CIRCULAR, strict=True):
        away = within_turn(detected[name].values[both] - true[name].values[both], direction)
        size = np.abs(away)
        size = size[np.isfinite(size)]
        if not size.size:
            continue
        values = (*evaluation.spread(size), size.max())
        usual = np.nan if direction else float(np.nanmedian(np.abs(true[name].values[both])))
        cells = (shown_value(name, float(value)) for value in (*values, usual))
        rows.append((quantity(name).long_name, str(size.size), *cells))
    return rows


def signal_rows(signals: xr.Dataset, truth: xr.Dataset, whisker: Whisker) -> list[tuple[str, ...]]:
    """Rows of a table of the errors of force and moment by deflection angle."""
    angle = cone_angle(whisker, truth["contact_point_whisker"].values)
    rows = []
    for row in evaluation.signal_errors(signals, truth, angle):
        shares = [*row.force, *row.moment]
        cells = (f"{100 * shares[i]:.3g} %" for i in (0, 2, 1, 3))
        rows.append((row.label, str(row.contacts), *cells))
    return rows


def _cells(row: evaluation.ErrorRow) -> list[str]:
    values = (*row.measured, *row.predicted[:2])
    return [str(row.contacts), *(shown_value(row.quantity, float(value)) for value in values)]


def _contour(recording: xr.DataTree, seed: int) -> str:
    """Fitted shape with its uncertainty, and distances from a known object."""
    data = recording["contour"].to_dataset()
    fit = shape_from_dataset(data)
    sigma = fit.sigma
    rows = []
    for name, meant in fit.fields.items():
        values = np.atleast_1d(getattr(fit, name))
        own = [p for p in fit.parameters if p.startswith(name)]
        label, factor = ("diameter", 2.0) if name == "radius" else (name, 1.0)
        for parameter, value in zip(own, factor * values, strict=True):
            shown = parameter.replace(name, label).replace("_", ", ")
            rows.append((shown, *with_sigma(meant, float(value), factor * sigma[parameter])))
    text = table(
        rows,
        ("parameter", "fitted", "standard deviation"),
        f"The fitted {fit.kind}",
        f"{int(fit.inliers.sum())} contacts fit; their distances from it: "
        f"{shown_value('surface_distance', fit.median)} in the median, "
        f"{shown_value('surface_distance', fit.rms)} root mean square. "
        f"Misfit {float(f'{fit.misfit:.3g}'):,g}: χ² per degree of freedom, about 1 where the "
        "shape and the stated noise are right.",
    )
    text += _caution(data)
    if fit.kind != "free" and fit.misfit > _SUSPECT:
        text += paragraph(
            "Contacts are farther from it than their covariance allows: the object may have "
            "another shape (`vibrissa reconstruct --shape`), or the noise may be larger "
            "than stated.",
            "note",
        )
    compared = [
        (quantity(name).long_name, _component_text(name, data[name].values))
        for name in ("axis_offset", "axis_tilt", "diameter_error", "radius_error", "center_offset")
        if name in data and name in QUANTITIES
    ]
    if compared:
        text += table(compared, caption="Fitted minus known object")
    return text + _distances(recording, seed)


def _component_text(name: str, values: Array) -> str:
    """Format a number, or a vector in parentheses with its length."""
    if values.ndim == 0:
        return shown_value(name, float(values), 2)
    each = ", ".join(shown_value(name, float(value), 2) for value in values)
    return f"({each}); size {shown_value(name, float(np.linalg.norm(values)), 2)}"


def _distances(recording: xr.DataTree, seed: int) -> str:
    """Distances of contacts from the known object."""
    trial = Recording(recording)
    estimates = trial.find("estimates")
    if estimates is None or "contact_covariance" not in estimates or not trial.objects:
        return ""
    if estimates.known("contact_point") is None:
        return ""
    classes = distances_by_class(compare_contacts(recording, seed=seed))
    parts = []
    for name, sums in classes.items():
        known = quantity(name)
        unit = f" ({known.display_unit})" if known.display_unit else ""
        rows = [
            (
                str(row["label"].item()),
                str(int(row["contacts"])),
                *(_distance(float(row[column])) for column in _DISTANCES),
            )
            for row in (sums.isel({"class": i}) for i in range(sums.sizes["class"]))
        ]
        heading = (f"{known.long_name}{unit}", "contacts", *_SPREAD, *(f"{s}*" for s in _SPREAD))
        caption = f"Distance of contacts from the known object, by {known.long_name}"
        parts.append(table(rows, heading, caption))
    return "".join(parts) + paragraph("* what the covariance of the contacts predicts", "note")


def _distance(value: float) -> str:
    """Write a distance; the lightest contacts' predictions have no upper limit."""
    return "over 100 mm" if value > _FARTHEST else shown_value("surface_distance", value)


def _events(recording: xr.DataTree) -> str:
    """Table of onset, loss and slip of all whiskers, with their times."""
    group = Recording(recording).find("estimates")
    found = [] if group is None else sorted(events_in(group.data))
    rows = []
    for time, name, event, sigma in found[:_MOST_EVENTS]:
        when = f"{time:.4f} s" if np.isnan(sigma) else with_sigma("time", time, sigma)[0]
        rows.append((f"{event} {name}", when, shown_value("onset_sigma", sigma, 2)))
    if not rows:
        return ""
    note = "An onset is dated by the readings from then on, with its standard deviation."
    if len(found) > len(rows):
        note += f" The first {len(rows)} of {len(found)} are shown; `vibrissa export` writes all."
    return table(rows, ("event", "time", "σ"), "Onset, loss and slip of contacts", note)


def _statuses(groups: dict[str, xr.Dataset | None]) -> str:
    """Count the frames of each group by status."""
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
    """Table of the whiskers in contact, with duration and force."""
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
    text = paragraph(
        f"Signals and estimated contacts are those of whisker {names[chosen]}, number {chosen}; "
        "`--which` chooses another. The contour is of all."
    )
    if not rows:
        return text + paragraph(f"None of the {len(names)} whiskers is known to touch an object.")
    heading = ("whisker", "number", "frames in contact", "largest force")
    note = f"{len(names) - len(rows)} others are not known to touch an object."
    return text + table(rows, heading, "Whiskers that touch", note)


def contacts_by_whisker(recording: xr.DataTree) -> NDArray[np.int64]:
    """Frames in contact of each whisker, from estimates, signals, tracking or truth."""
    trial = Recording(recording)
    for group in map(trial.find, ("estimates", "signals", "", "truth")):
        if group is not None and "in_contact" in group:
            return np.asarray(group["in_contact"].sum(axis=0), dtype=np.int64)
    return np.zeros(recording.sizes["whisker"], dtype=np.int64)


def tracked_table(root: xr.Dataset) -> str:
    """Table of the results of tracking, with their standard deviations."""
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
            text = f"{shown_value(name, middle)}, up to {shown_value(name, largest)}"
            rows.append((f"{quantity(name).long_name}, in contact", text))
    if "contact_covariance" in root:
        covariance = root["contact_covariance"].values[touching]
        sigma = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
        if np.isfinite(sigma).any():
            text = shown_value("contact_point", float(np.nanmedian(sigma)))
            rows.append(("standard deviation of the contact point", f"{text}, median, in space"))
    return table(rows, caption="By the rod that fits the images")


def chart_sections(contact_map: ContactMap, verdicts: xr.Dataset | None = None) -> list[Section]:
    """Sections on a contact map and on the signals that locate its contacts."""
    samples = contact_map.to_dataset()
    about = Section("map", "The map", contact_map._repr_html_() + _ranges(samples))
    results = Section("results", "Results", _map_results(samples, verdicts))
    if verdicts is None:
        advice = paragraph(
            "Uniqueness has not been tested: `vibrissa uniqueness MAP -o FILE.nc` tests it, and "
            "`--uniqueness FILE.nc` shows the verdicts here."
        )
        return [results, about, Section("verdicts", "Verdicts", advice)]
    body = _verdicts(verdicts) + _witnesses(verdicts)
    return [results, about, Section("verdicts", "Which triplets are unique", body)]


def _map_results(samples: xr.Dataset, verdicts: xr.Dataset | None) -> str:
    """Main numbers of a map: the triplet to use, and what contacts have at most."""
    triplet = Tile("–", "triplet of signals to use: not tested")
    number = Tile("–", "triplets that locate all contacts: not tested")
    if verdicts is not None and "region" in verdicts.dims:
        all_of = verdicts["verdict"].isel(region=0).values
        region = str(verdicts["region"].values[0])
        unique = int((all_of == "unique").sum())
        number = Tile(f"{unique} of {all_of.size}", f"triplets unique for region: {region}")
        chosen = str(verdicts.attrs.get("chosen_triplet", ""))
        triplet = Tile(chosen or "none", "triplet of signals to use, as far as was searched")
    nearest, farthest = (
        f"{end:.3g}" for end in np.nanquantile(to_display("r", samples["r"]), [0, 1])
    )
    reach = Tile(f"{nearest} to {farthest} mm", "distance of the contacts from the base")
    moment = shown_value("MB", float(samples["MB"].max()))
    return tiles([triplet, number, reach, Tile(moment, "largest bending moment")])


def _ranges(samples: xr.Dataset) -> str:
    """Ranges of signals over all contacts, and their statuses."""
    rows = []
    for name in (*SIGNALS, "r", "theta", "phi"):
        factor, unit = shown_unit(name, samples[name].values)
        values = factor * samples[name].values
        ends = (
            (f"{end:.4g}" if abs(end) >= 1e-4 else f"{end:.6f}").replace("-", "−")
            for end in (np.nanmin(values), np.nanmax(values))
        )
        rows.append((f"{quantity(name).long_name} ({unit})", *ends))
    ranges = table(rows, ("quantity", "smallest", "largest"), "Ranges over all contacts of the map")
    counts = describe(samples["status"].values).most_common()
    ended = [(sentence, str(count)) for sentence, count in counts]
    return ranges + table(ended, ("status", "contacts"), "What limits the contacts")


def _verdicts(verdicts: xr.Dataset) -> str:
    if "critical_cone" not in verdicts or "notation" not in verdicts:
        rows = [
            (str(triplet), *(str(v) for v in verdicts["verdict"].sel(triplet=triplet).values))
            for triplet in verdicts["triplet"].values
        ]
        return table(rows, ("triplet", *map(str, verdicts["region"].values)), "Verdicts")
    (heading, *cells), notes = verdict_rows(verdicts)
    return table(cells, heading, "Verdicts by region") + "".join(
        paragraph(note, "note") for note in notes
    )


def _witnesses(verdicts: xr.Dataset) -> str:
    """Table of the most distant pair of contacts with the same signals, by triplet."""
    if "witness_separation" not in verdicts:
        return ""
    apart = verdicts["witness_separation"].transpose("triplet", "region", "witness").values
    rows = []
    for triplet, cells in zip(verdicts["triplet"].values, apart, strict=True):
        if np.isfinite(cells).any():
            region, _ = np.unravel_index(int(np.nanargmax(cells)), cells.shape)
            farthest = float(to_display("contact_point", np.nanmax(cells)))
            name = str(verdicts["region"].values[region])
            rows.append((str(triplet), name, f"{farthest:.3f} mm"))
    if not rows:
        return paragraph("No two contacts with the same signals were found.")
    return table(
        rows,
        ("triplet", "region", "distance"),
        "Farthest pairs of contacts with the same signals",
        "Each pair proves that the triplet does not locate contacts in the region.",
    )
