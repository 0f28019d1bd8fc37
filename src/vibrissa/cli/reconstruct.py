"""`vibrissa reconstruct`: reconstruction of the touched object from a recording."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

import vibrissa as vb
from vibrissa.cli import inputs
from vibrissa.cli.estimate import EstimateOptions, estimated
from vibrissa.cli.options import numbers, with_options
from vibrissa.cli.signals import SourceOptions, described
from vibrissa.cli.terminal import Tell, fixed, print_table, progress_bars, remark, say
from vibrissa.deferred import xr

_SUSPECT = 1.5  # χ² per degree of freedom above which other shapes are compared
# Predicted distance, m, larger than a whisker, above which the contact is undetermined.
_ANYWHERE = 0.1
_TURNED = ("axis", "normal")  # parameters of a shape that are directions, not lengths


@dataclass(frozen=True)
class ShapeOptions:
    """Options for the shape of the object."""

    shape: Literal["cylinder", "sphere", "plane", "free"] = "cylinder"
    axis: str | None = None
    lean: float | None = None

    def __post_init__(self) -> None:
        self.keywords()
        if self.axis is not None and self.shape != "cylinder":
            raise ValueError(f"--axis is for a cylinder; --shape is {self.shape}")
        if self.lean is not None and not 0.0 <= self.lean < 90.0:
            raise ValueError(f"--lean is {self.lean:g}; it must be from 0 to 90 degrees")

    def keywords(self) -> dict[str, Any]:
        """Keyword arguments of fits."""
        axis = None if self.axis is None else numbers(self.axis, ("X", "Y", "Z"), "--axis")
        return {"axis": axis, "lean": None if self.lean is None else math.radians(self.lean)}


@with_options("the recording with all that was found added, by default where it is")
def reconstruct(
    recording: Path,
    wanted: ShapeOptions,
    source: SourceOptions,
    how: EstimateOptions,
    objects: Path | None = None,
    target: Path | None = None,
    csv: Path | None = None,
    force: bool = False,
) -> None:
    """Reconstruct the touched object from a recording.

    Existing signals and estimates are used. Missing ones are computed first, with defaults that are
    printed, and those that options change are computed again. Results are added to the recording as
    groups `signals`, `estimates` and `contour`; its other groups are kept. The contour points are
    also written to a table; an existing table is replaced only if it contains the recording's
    previous contour.
    The contacts are compared with --objects, by default those of the recording.
    Example: `vibrissa reconstruct trial.nc --shape cylinder`
    """
    inputs.refuse_tracks(recording)
    target = target or recording
    points = target.with_name(f"{target.stem}_contour.csv") if csv is None else csv
    vb.io.check_writable(target, vb.io.NETCDF)
    vb.io.check_writable(points, vb.io.CSV)
    tree = vb.pipeline.without_faulty_stages(inputs.recording_from(recording))
    own = not force and _of_contour(points, tree, how.own)
    inputs.free_beside(recording, [target] if own else [target, points], force)
    known = (
        vb.recording.Recording(tree).objects if objects is None else inputs.objects_from(objects)
    )
    with progress_bars() as tell:
        made = []
        try:
            for name, after in stages(tree, wanted, source, how, known, tell, str(recording)):
                made.append(name)
                tree = after
        except ValueError as fault:
            if not made:
                raise
            vb.io.save_recording(target, tree)
            raise ValueError(f"{fault}; {' and '.join(made)} are in {target}") from None
    whiskers = how.known.in_recording(tree)
    _report(tree, known, whiskers, wanted)
    vb.io.save_recording(target, tree)
    vb.io.save_contour(points, vb.pipeline.contour_points(tree, whiskers))
    inputs.print_written(target, recording, "contour")
    inputs.print_written(points)


def stages(
    tree: xr.DataTree,
    wanted: ShapeOptions,
    source: SourceOptions,
    how: EstimateOptions,
    known: tuple[vb.objects.Surface, ...],
    tell: Tell,
    name: str,
) -> Iterator[tuple[str, xr.DataTree]]:
    """Yield the name of each due stage, and the recording after it."""
    # Existing signals may be those of another whisker.
    again = how.own.whisker is not None and "signals" in tree.children
    asked = {"signals": source.given or again, "estimates": how.given}
    if not source.given:
        source = SourceOptions.of(tree)
    due = vb.pipeline.due_stages(
        tree, "contour", [stage for stage, wants in asked.items() if wants]
    )
    if "signals" in due:
        tell("signals", 0, 1)
        tree = vb.pipeline.with_signals(tree, **source.as_keywords(tree, how.known, how.proximal))
        tell("signals", 1, 1)
        yield "signals", tree
    if "signals" in tree.children:
        remark(described(tree))
    if "estimates" in due:
        tree, used = estimated(tree, how, tell, name)
        remark(used)
        yield "estimates", tree
    tell(wanted.shape, 0, 1)
    whiskers = how.known.in_recording(tree)
    yield (
        "contour",
        vb.pipeline.with_group(
            tree,
            "contour",
            vb.pipeline.reconstruct(
                tree, wanted.shape, whiskers=whiskers, objects=known, **wanted.keywords()
            ),
        ),
    )
    tell(wanted.shape, 1, 1)


def _of_contour(points: Path, tree: xr.DataTree, own: inputs.WhiskerOptions) -> bool:
    """Whether a table contains the contour of the recording, so that replacing it loses nothing."""
    if not points.is_file() or not {"estimates", "contour"} <= set(tree.children):
        return False
    try:
        return vb.io.holds_contour(points, vb.pipeline.contour_points(tree, own.in_recording(tree)))
    except ValueError:
        return False


def _report(
    tree: xr.DataTree,
    known: tuple[vb.objects.Surface, ...],
    whiskers: list[vb.Whisker],
    wanted: ShapeOptions,
) -> None:
    """Report on frames, object, and distances of contacts from a known object."""
    contour, estimates = (tree[name].to_dataset() for name in ("contour", "estimates"))
    shapes, fit = None, vb.contour.shape_from_dataset(contour)
    if wanted.shape != "free" and fit.misfit > _SUSPECT:
        shapes = vb.pipeline.compare_shapes(estimates, whiskers, **wanted.keywords())
    inputs.print_statuses(estimates["status"].values)
    _print_object(fit, contour, known)
    for line in (_agreement(fit, contour), *_judgement(fit, shapes)):
        say(line)
    if known:
        compared = vb.pipeline.compare_contacts(tree, known, whiskers)
        _print_distances(vb.pipeline.distances_by_class(compared)["deflection_angle"])
    if vb.recording.Recording(tree).planar:
        say(
            "One view shows the section of the object in its plane: a cylinder is taken to be "
            "along the line of sight; how it is tilted, and what is in front or behind, is not "
            "measured."
        )
    if warning := vb.evaluation.caution(contour.attrs.get("source")):
        say(warning)


def _print_object(
    fit: vb.contour.FittedShape, contour: xr.Dataset, known: tuple[vb.objects.Surface, ...]
) -> None:
    """Print the fitted object with its uncertainty, and its distance from the known one."""
    true = _matching(contour, known)
    title = f"The {fit.kind}"
    if isinstance(fit, vb.contour.FreeFit):
        deviation = fixed("surface_distance", fit.amplitude, 0)
        title = f"A surface within about {deviation} of this {fit.base.kind}"
        fit = fit.base
    rows = []
    for name, value, sigma in _parameters(fit):
        factor, unit = (1.0, "") if name in _TURNED else (1e3, " mm")
        values = np.atleast_1d(value)
        for i, pair in enumerate(zip(values, np.atleast_1d(sigma), strict=True)):
            label = name if values.size == 1 else f"{name}, {'xyz'[i]}"
            cells = [f"{factor * float(x):z.4f}{unit}" for x in pair]
            rows.append([label, *cells, *(true.get(label, ["", ""]) if true else ())])
    if "tilt" in true:
        rows.append(["tilt", "", "", *true["tilt"]])
    print_table(["", "fitted", "sigma", *(("known", "error") if true else ())], rows, title)


def _parameters(fit: vb.contour.FittedShape) -> list[tuple[str, Any, Any]]:
    """Name, value and standard deviation of each parameter; diameters instead of radii."""
    rows = []
    for name in fit.fields:
        value = getattr(fit, name)
        sigma = [s for parameter, s in fit.sigma.items() if parameter.startswith(name)]
        if name == "radius":
            rows.append(("diameter", 2.0 * value, [2.0 * s for s in sigma]))
        else:
            rows.append((name, value, sigma))
    return rows


def _matching(contour: xr.Dataset, known: tuple[vb.objects.Surface, ...]) -> dict[str, list[str]]:
    """Known value and error of each row, if a known object has the fitted shape."""
    offset = next((n for n in ("axis_offset", "center_offset") if n in contour), None)
    if offset is None:
        return {}
    true: Any = known[int(contour["object_distance"].attrs["object"])]
    away = contour[offset].values
    rows = {}
    for letter, position, error in zip(
        "xyz", contour["object_position"].values - away, away, strict=True
    ):
        rows[f"origin, {letter}"] = [f"{1e3 * float(x):.4f} mm" for x in (position, error)]
    diameters = 2.0 * float(true.radius), float(contour["diameter_error"])
    rows["diameter"] = [f"{1e3 * x:.4f} mm" for x in diameters]
    if "axis_tilt" in contour:
        rows["tilt"] = ["", fixed("axis_tilt", float(contour["axis_tilt"]), 2)]
    return rows


def _agreement(fit: vb.contour.FittedShape, contour: xr.Dataset) -> str:
    """Description of the agreement of contacts with the fitted object."""
    found, used = int(np.isfinite(fit.residuals).sum()), int(fit.used.sum())
    inside = int((fit.used & fit.inliers).sum())
    share = f"all {used}" if used < inside + 1 else f"{inside} of {used}"
    text = f"{share} contacts agree with it"
    if inside:
        text += (
            f" and are {fixed('surface_distance', fit.median, 1)} from it in the median, "
            f"{fixed('surface_distance', fit.rms, 1)} root mean square"
        )
    if found > used:
        text += f"; too uncertain to be used: {found - used}"
    together = float(contour.attrs["frames_together"])
    if together > 1.5:
        text += f"; sigma allows for errors that about {together:.0f} successive frames share"
    return text


def _judgement(fit: vb.contour.FittedShape, shapes: xr.Dataset | None) -> Iterator[str]:
    """Yield remarks on whether another shape fits the contacts better."""
    if fit.misfit > vb.pipeline.AGREES:
        yield (
            f"The contacts do not fit a {fit.kind}{_by(fit.misfit)}: the object has another "
            "shape (--shape), or there is more than the noise, such as friction, or base poses or "
            "times that are not those of the signals; sigma is as much larger, but does not "
            "describe an object of another shape"
        )
    if shapes is None or fit.kind not in shapes["shape"].values:
        return
    if not shapes["evidence"].sel(shape=fit.kind).item() > vb.pipeline.STRONG:
        return
    best = shapes.isel(shape=int(np.nanargmin(shapes["evidence"].values)))
    kind, misfit = str(best["shape"].item()), float(best["misfit"])
    if misfit < vb.pipeline.AGREES:
        yield f"A {kind} fits them better{_by(misfit)}: --shape {kind}"
    elif fit.misfit > vb.pipeline.AGREES:
        yield f"No simple shape fits them, a {kind} best{_by(misfit)}: --shape free"


def _by(misfit: float) -> str:
    return f" (χ² per degree of freedom {misfit:.3g})"


def _distance(value: float) -> str:
    """Format a distance; light contacts may be anywhere along the whisker."""
    return "not determined" if value > _ANYWHERE else fixed("surface_distance", value, 1)


def _print_distances(rows: xr.Dataset) -> None:
    """Print distances of contacts from the known object, by deflection angle."""
    predicted = bool(np.isfinite(rows["median_predicted"]).any())
    names = ["median", "largest_95"]
    names += ["median_predicted", "largest_95_predicted"] if predicted else []
    cells = []
    for k in range(rows.sizes["class"]):
        row = rows.isel({"class": k})
        if count := int(row["contacts"]):
            values = [_distance(float(row[name])) for name in names]
            cells.append([f"{row['label'].item()}°", str(count), *values])
    print_table(
        ["deflection angle", "contacts", "median", "95 %", *(["median*", "95 %*"] * predicted)],
        cells,
        "Distance of contacts from the known object",
        "* what the estimates' own covariance predicts" if predicted else None,
    )
