"""`vibrissa sensitivity`: sensitivity of the contact point to changes of the signals."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import vibrissa as vb
from vibrissa.cli.figures import dataset_with
from vibrissa.cli.inputs import RECORDING, NoiseOptions, kind_in, wrench_from
from vibrissa.cli.options import check_new, with_options
from vibrissa.cli.terminal import Row, print_table, progress_bars, say, shown
from vibrissa.deferred import xr

_SHOWN = 5  # number of triplets shown


@with_options("everything, NetCDF (.nc), SI units; by default nowhere")
def sensitivity(
    path: Path,
    noise: NoiseOptions,
    using: str = "Fx,MB,MD",
    trial: Path | None = None,
    uniqueness: Path | None = None,
    target: Path | None = None,
    force: bool = False,
) -> None:
    """Compute how the contact point depends on three signals, and which triplet is best.

    Derivatives are exact, and computed for the contacts of --trial or for all contacts of the map.
    Contacts within 2° of rest are omitted from the tables but included in the file.
    Example: `vibrissa sensitivity map.nc --using Fx,MB,MD -o sensitivity.nc`
    """
    if target is not None:
        check_new(target, vb.io.NETCDF, force)
    names = vb.signals.selection([name.strip() for name in using.split(",")], exactly=3)
    contact_map = vb.ContactMap.load(path)
    verdicts = None if uniqueness is None else dataset_with(uniqueness, "twin_share")
    if verdicts is not None and verdicts.attrs.get("whisker") != repr(contact_map.whisker):
        raise ValueError(f"{uniqueness} is of another whisker than {path}")
    covariance = noise.matrix()
    moment_noise = float(np.sqrt(0.5 * (covariance[4, 4] + covariance[5, 5])))
    at = None if trial is None else _contacts_of(trial, moment_noise)
    with progress_bars() as tell:
        tell("derivatives", 0, 2)
        found = vb.sensitivity(contact_map, names, at, noise=covariance)
        tell("derivatives", 1, 2)
        rivals = vb.best_triplet(contact_map, covariance, at)
        tell("derivatives", 2, 2)
    if not vb.numerics.contact_weights(found).any():
        raise ValueError(f"{trial or path} holds no contact farther than 2° from rest")
    say(repr(contact_map.whisker))
    _print_derivatives(vb.sensitivity_findings(found))
    _print_rivals(rivals, names, noise.described(), verdicts)
    if target is not None:
        floats = [str(name) for name, v in found.data_vars.items() if v.dtype.kind == "f"]
        about = found.assign_attrs(kind="vibrissa sensitivity")
        vb.io.write_netcdf(target, about, {"/": dict.fromkeys(floats, vb.io.COMPRESSED)})
        say(f"wrote {target}")


def _contacts_of(path: Path, moment_noise: float) -> xr.Dataset:
    """Contact points of a trial or else its signals; NaN where M_B is within five deviations."""
    if kind_in(path) == RECORDING:
        recording = vb.load_recording(path).to_dataset(inherit=False)
        if "contact_point_whisker" in recording:
            return recording
    wrench = wrench_from(path)
    touching = (
        vb.base_signals(wrench["force"], wrench["moment"])["MB"]
        > vb.signals.DETECTED * moment_noise
    )
    return wrench[["force", "moment"]].where(touching)


def _print_derivatives(findings: xr.Dataset) -> None:
    """Print median sizes of derivatives, their variation, and differences between the sides."""
    by = [str(n) for n in findings["sorted_by"].values]
    rows: list[list[str] | None] = []
    for signal in map(str, findings["signal"].values):
        below = vb.quantities.quantity(signal)
        for coordinate in ("r", "theta", "phi"):
            above = vb.quantities.quantity(coordinate)
            entry = findings.sel(coordinate=coordinate, signal=signal)
            factor = above.display_factor / below.display_factor
            unit = below.display_unit
            rows.append(
                [
                    {"theta": "θ", "phi": "φ"}.get(coordinate, coordinate),
                    signal,
                    f"{float(entry['median_size']) * factor:.3g}",
                    f"{above.display_unit}/{f'({unit})' if '·' in unit else unit}",
                    *(_ratio(float(entry["small_over_large"].sel(sorted_by=n))) for n in by),
                    _ratio(float(entry["backward_over_forward"])),
                    f"{100.0 * float(entry['share_of_motion']):.0f} %",
                ]
            )
        rows.append(None)
    print_table(
        ["of", "by", "median", "unit", *(f"× small {n}" for n in by), "CB/CF", "motion"],
        rows,
        "Sensitivity of the contact point",
        "medians of absolute values. × small: where that signal is in its smallest fifth, "
        "over where it is in its largest; CB/CF: concave backward over concave forward; motion: "
        "share of the contact's squared motion along this coordinate",
        left=(0, 1, 3),
    )


def _ratio(value: float) -> str:
    return f"{value:.0f}" if value >= 10.0 else f"{value:.2g}"


def _print_rivals(
    rivals: xr.Dataset, names: tuple[str, ...], noise: str, verdicts: xr.Dataset | None
) -> None:
    """Print the triplets that are most often best, and the requested one."""
    from rich.text import Text

    order = np.argsort(-rivals["share"].values, kind="stable")
    best = [i for i in order[:_SHOWN] if rivals["share"].values[i] > 0.0]
    asked = list(rivals["triplet"].values).index(" ".join(names))
    rows: list[Row] = []
    for i in dict.fromkeys([*best, asked]):
        row, of = rivals.isel(triplet=i), str(rivals["triplet"].values[i])
        twins = [] if verdicts is None else [vb.identifiability.twins_of(verdicts, of)]
        rows.append(
            [
                Text(of, style="bold" if i == asked else ""),
                f"{100.0 * float(row['share']):.1f} %",
                _error(float(row["median_error"])),
                _error(float(row["median_error_where_best"])),
                f"{100.0 * float(row['determined']):.1f} %",
                *twins,
            ]
        )
    last = (
        "whether a triplet is unique is another question: vibrissa uniqueness, and --uniqueness"
        if verdicts is None
        else "twins: share of contacts that have another with the same signals, and their distance"
    )
    print_table(
        ["triplet", "best in", "median error", "where best", "determines"]
        + ["twins"] * (verdicts is not None),
        rows,
        f"Which triplet for a sensor with {noise}",
        f"3D error (RMS) predicted for small noise; {last}",
    )


def _error(value: float) -> str:
    return shown("predicted_error", value, 3) if value == value else "-"
