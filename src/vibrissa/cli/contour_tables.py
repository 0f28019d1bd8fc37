"""What `vibrissa reconstruct` prints of the object that it found."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vibrissa.cli.terminal import fixed

if TYPE_CHECKING:
    from collections.abc import Iterator

    import xarray as xr
    from rich.table import Table

    from vibrissa.contour import FittedShape
    from vibrissa.objects.surface import Surface

_TURNED = ("axis", "normal")


def object_table(fit: FittedShape, contour: xr.Dataset, known: tuple[Surface, ...]) -> Table:
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


def summary(fit: FittedShape, contour: xr.Dataset, shapes: xr.Dataset | None) -> list[str]:
    """Say how well contacts agree with the fitted object, and whether it has another shape."""
    import numpy as np

    found, used = int(np.isfinite(fit.residuals).sum()), int(fit.used.sum())
    inside = int((fit.used & fit.inliers).sum())
    said = f"{inside} of {used} contacts that were used agree with it"
    if inside:
        said += f", to {fixed('surface_distance', fit.rms, 1)}"
    if used < inside + 1:
        said = said.replace(f"{inside} of {used}", f"all {used}")
    if found > used:
        said += f"; {found - used} more are too uncertain to be used"
    together = float(contour.attrs["frames_together"])
    if together > 1.5:
        said += f"; about {together:.0f} frames err together, which sigma takes into account"
    return [said, *_judgement(fit, shapes)]


def _judgement(fit: FittedShape, shapes: xr.Dataset | None) -> Iterator[str]:
    """Whether the contacts are of another shape."""
    import numpy as np

    from vibrissa.pipeline.shapes import GOES, STRONG

    if fit.misfit > GOES:
        yield (
            f"The contacts do not go with a {fit.kind}{_by(fit.misfit)}: the object has another "
            "shape (--shape), or there is more than the noise, such as friction; sigma is as much "
            "larger, but says nothing of an object of another shape"
        )
    if shapes is None or fit.kind not in shapes["shape"].values:
        return
    if not shapes["evidence"].sel(shape=fit.kind).item() > STRONG:
        return
    best = shapes.isel(shape=int(np.nanargmin(shapes["evidence"].values)))
    kind, misfit = str(best["shape"].item()), float(best["misfit"])
    if misfit < GOES:
        yield f"A {kind} goes better with them{_by(misfit)}: --shape {kind}"
    elif fit.misfit > GOES:
        yield f"No simple shape goes with them, a {kind} best{_by(misfit)}: --shape free"


def _by(misfit: float) -> str:
    return f" (χ² per degree of freedom {misfit:.3g})"


def distance_table(rows: xr.Dataset) -> Table:
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
