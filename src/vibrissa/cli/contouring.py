"""`vibrissa reconstruct`: from a recording to the object that was touched."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vibrissa.cli.terminal import fixed, numbers, output, progress_bars

if TYPE_CHECKING:
    import xarray as xr
    from rich.table import Table

    from vibrissa.contour import FittedShape
    from vibrissa.rod.surface import Surface

_TURNED = ("axis", "normal")


def reconstruct(
    recording: Annotated[
        Path,
        typer.Argument(help="A recording that was tracked or simulated, .nc.", metavar="TRIAL.nc"),
    ],
    path: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Where the recording goes with all that was found added, .nc; by default to "
            "where it is.",
            metavar="FILE",
        ),
    ] = None,
    csv: Annotated[
        Path | None,
        typer.Option(
            help="Where the contour points go; by default beside the recording, NAME_contour.csv.",
            metavar="FILE",
        ),
    ] = None,
    shape: Annotated[
        str, typer.Option(help="What was touched: cylinder, sphere, plane or free.")
    ] = "cylinder",
    axis: Annotated[
        str | None,
        typer.Option(help="Direction of a cylinder's axis, if it is known.", metavar="X,Y,Z"),
    ] = None,
    lean: Annotated[
        float | None,
        typer.Option(
            help="How far normals may lean from forces, degrees (standard deviation): by default "
            "5.7 for contacts from --wrench, which allows for friction, and else 0."
        ),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            help="What signals come from: contact point, rod or sensor (see `vibrissa signals`).",
            metavar="SOURCE",
        ),
    ] = None,
    cutoff: Annotated[
        float | None,
        typer.Option(help="Low pass of the pose the contact point is seen from, Hz: 85; 0: none."),
    ] = None,
    triplet: Annotated[
        str | None,
        typer.Option(
            "--signals",
            help="What contacts are estimated from (see `vibrissa estimate`): Fx,MB,MD.",
            metavar="A,B,C",
        ),
    ] = None,
    all_six: Annotated[
        bool, typer.Option("--wrench", help="Estimate from force and moment whole.")
    ] = False,
    charts: Annotated[
        list[Path] | None,
        typer.Option(
            "--map", help="Of the whisker (of several: one for each); simulated if not given."
        ),
    ] = None,
    whisker: Annotated[
        Path | None,
        typer.Option(help="Centreline as CSV, if the recording has no whisker.", metavar="FILE"),
    ] = None,
    force_noise: Annotated[
        float | None,
        typer.Option(help="Of a sensor's force component, µN, if not as recorded.", min=0.0),
    ] = None,
    moment_noise: Annotated[
        float | None,
        typer.Option(help="Of a sensor's moment component, µN·m, if not as recorded.", min=0.0),
    ] = None,
    objects: Annotated[
        Path | None,
        typer.Option(
            help="Recording whose objects are known, to compare with; by default TRIAL.nc.",
            metavar="FILE",
        ),
    ] = None,
) -> None:
    """Find the object that was touched from a recording alone.

    Signals and estimates that the recording already has are used; what is missing is made first, by
    defaults that are printed, and what options ask for is made anew. All is added to the recording
    as groups `signals`, `estimates` and `contour`; what it held before stays as it was. The contour
    points go to a table as well. Example: `vibrissa reconstruct trial.nc --shape cylinder`
    """
    from vibrissa.cli.feeling import described, signal_options
    from vibrissa.cli.locating import estimated, how_to
    from vibrissa.cli.recordings import (
        noise_from,
        recording_from,
        say,
        tell_statuses,
        tell_written,
        whiskers_for,
    )
    from vibrissa.contour import shape_from_dataset
    from vibrissa.io import save_contour, save_recording
    from vibrissa.io.paths import CSV, NETCDF, check_writable
    from vibrissa.pipeline import (
        compare_contacts,
        contour_points,
        distances_by_class,
        with_contour,
        with_signals,
    )
    from vibrissa.tracking.filtering import CUTOFF
    from vibrissa.trial import recorded_objects

    target = recording if path is None else path
    points = target.with_name(f"{target.stem}_contour.csv") if csv is None else csv
    check_writable(target, NETCDF)
    check_writable(points, CSV)
    direction = None if axis is None else numbers(axis, ("X", "Y", "Z"), "--axis")
    _check_shape(shape, direction is not None)
    how = how_to(triplet, "exact", all_six, charts, whisker)
    noise = noise_from(None, force_noise, moment_noise)
    tree = recording_from(recording)
    known = recorded_objects(tree if objects is None else recording_from(objects))
    with progress_bars() as tell:
        made = tree["signals"].attrs if "signals" in tree.children else None
        if made and whisker is not None and source is None and cutoff is None:
            # The same way, by another whisker.
            source, cutoff = made.get("source"), float(made.get("cutoff", 0.0))
        if source is not None or cutoff is not None or made is None:
            tell("signals", 0, 1)
            wanted = CUTOFF if cutoff is None else cutoff
            tree = with_signals(tree, **signal_options(tree, source, wanted, how.known))
            tell("signals", 1, 1)
        say(described(tree))
        asked = triplet or all_six or charts or noise is not None or whisker is not None
        if asked or "estimates" not in tree.children:
            tree, said = estimated(tree, how, noise, tell, str(recording))
            say(said)
        whiskers = whiskers_for(tree, how.known)
        tell(shape, 0, 1)
        leaning = None if lean is None else math.radians(lean)
        tree = with_contour(
            tree, shape, axis=direction, lean=leaning, whiskers=whiskers, objects=known
        )
        tell(shape, 1, 1)
    contour = tree["contour"].to_dataset()
    tell_statuses(tree["estimates"]["status"].values)
    fit = shape_from_dataset(contour)
    output.print(_table(fit, contour, known))
    output.print(_summary(fit, contour), highlight=False, soft_wrap=True)
    if known:
        compared = compare_contacts(tree, known, whiskers)
        output.print(_distances(distances_by_class(compared)["deflection_angle"]))
    save_recording(target, tree)
    save_contour(points, contour_points(tree, whiskers))
    tell_written(target)
    tell_written(points)


def _check_shape(shape: str, axis: bool) -> None:
    from typing import get_args

    from vibrissa.pipeline import Shape

    if shape not in get_args(Shape):
        raise ValueError(f"--shape is {shape!r}; one of {', '.join(get_args(Shape))} is needed")
    if axis and shape != "cylinder":
        raise ValueError(f"--axis is for a cylinder; --shape is {shape}")


def _table(fit: FittedShape, contour: xr.Dataset, known: tuple[Surface, ...]) -> Table:
    """The fitted object with its uncertainty, and how far it is from the known one."""
    import numpy as np
    from rich.table import Table

    from vibrissa.contour import FreeFit

    true = _matching(fit, contour, known)
    title = f"The {fit.kind}"
    if isinstance(fit, FreeFit):
        deviation = fixed("surface_distance", fit.amplitude, 0)
        title = f"A surface within about {deviation} of this {fit.base.kind}"
        fit = fit.base
    table = Table(title=title, title_justify="left")
    for name in ("", "fitted", "sigma", *(("known", "error") if true else ())):
        table.add_column(name, justify="right" if name else "left")
    for name, value, sigma in _parameters(fit):
        factor, unit = (1.0, "") if name in _TURNED else (1e3, " mm")
        values = np.atleast_1d(value)
        for i, pair in enumerate(zip(values, np.atleast_1d(sigma), strict=True)):
            label = name if values.size == 1 else f"{name}, {'xyz'[i]}"
            # Adding zero turns −0 into 0.
            cells = [f"{round(factor * float(x), 4) + 0.0:.4f}{unit}" for x in pair]
            if true:
                cells += true.get(label, ["", ""])
            table.add_row(label, *cells)
    if true and "tilt" in true:
        table.add_row("tilt", "", "", *true["tilt"])
    return table


def _parameters(fit: FittedShape) -> list[tuple[str, Any, Any]]:
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


def _matching(
    fit: FittedShape, contour: xr.Dataset, known: tuple[Surface, ...]
) -> dict[str, list[str]]:
    """Known value and error of each row, where a known object is of the fitted kind."""
    offset = next((n for n in ("axis_offset", "center_offset") if n in contour), None)
    if offset is None:
        return {}
    true: Any = known[int(contour["object_distance"].attrs["object"])]
    away = contour[offset].values
    rows = {}
    for i, letter in enumerate("xyz"):
        place = float(contour["object_position"].values[i] - away[i])
        rows[f"origin, {letter}"] = [f"{1e3 * place:.4f} mm", f"{1e3 * float(away[i]):.4f} mm"]
    error = float(contour["diameter_error"])
    rows["diameter"] = [f"{2e3 * float(true.radius):.4f} mm", f"{1e3 * error:.4f} mm"]
    if "axis_tilt" in contour:
        rows["tilt"] = ["", fixed("axis_tilt", float(contour["axis_tilt"]), 2)]
    return rows


def _summary(fit: FittedShape, contour: xr.Dataset) -> str:
    """How well contacts agree with the fitted object."""
    import numpy as np

    inside = int(fit.inliers.sum())
    found = int(np.isfinite(fit.residuals).sum())
    if not inside:
        return f"none of {found} contacts agrees with it: the object has another shape (--shape)"
    said = f"{inside} of {found} contacts agree with it, to {fixed('surface_distance', fit.rms, 1)}"
    if 2 * inside < found:
        said += "; most are too uncertain, or the object has another shape (--shape)"
    together = float(contour.attrs["frames_together"])
    if together > 1.5:
        said += f"; about {together:.0f} frames err together, which sigma takes into account"
    return said


def _distances(rows: xr.Dataset) -> Table:
    """Distances of contacts from the known object, by how far the whisker is bent."""
    import numpy as np
    from rich.table import Table

    predicted = bool(np.isfinite(rows["median_predicted"]).any())
    table = Table(
        title="Distance of contacts from the known object",
        title_justify="left",
        caption="* what the estimates' own covariance predicts" if predicted else None,
        caption_justify="left",
    )
    columns = ["median", "largest_95"]
    columns += ["median_predicted", "largest_95_predicted"] if predicted else []
    table.add_column("deflection angle")
    for name in ("contacts", "median", "95 %", *(("median*", "95 %*") if predicted else ())):
        table.add_column(name, justify="right")
    for k in range(rows.sizes["class"]):
        row = rows.isel({"class": k})
        if int(row["contacts"]):
            cells = [fixed("surface_distance", float(row[name]), 1) for name in columns]
            table.add_row(f"{row['label'].item()}°", str(int(row["contacts"])), *cells)
    return table
