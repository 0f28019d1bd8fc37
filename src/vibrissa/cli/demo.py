"""`vibrissa demo`: demonstration of the whole pipeline on a simulated trial."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import vibrissa as vb
from vibrissa.cli.figures import NODES, TrialOptions, saved, trial_drawings
from vibrissa.cli.inputs import WhiskerOptions, print_notes, recording_from
from vibrissa.cli.options import with_options
from vibrissa.cli.terminal import Row, Tell, print_table, progress_bars, say, shown

if TYPE_CHECKING:
    from vibrissa.demo import DemoResult, Located
_SENSED = "measured by a sensor"
_SEEN = "the paper's method"
_COORDINATES = {"error_r": "r", "error_theta": "θ", "error_phi": "φ", "error_distance": "3D"}


@with_options("all files, in a folder")
def demo(
    own: WhiskerOptions,
    target: Path = Path("vibrissa-demo"),
    full: bool | None = None,
    seed: int | None = None,
    noise: bool = True,
    tracking: bool = True,
    duration: float | None = None,
    rate: float | None = None,
) -> None:
    """Simulate whisking against a peg, with videos and a sensor, and reconstruct the peg.

    A whisker sweeps past a peg and back in front of two cameras. The pose of its base is tracked,
    contact points are estimated from three signals at the base, and the peg is fitted to these. All
    stages are compared with the truth. After Ctrl-C the same command continues.
    Example: `vibrissa demo --output try --seed 1`
    """
    from vibrissa.demo import DURATION, FULL_DURATION, run_demo

    if duration is not None and full is not None:
        raise ValueError("give either --duration or one of --full and --quick")
    vb.io.check_folder(target)
    whisker = own.read()
    say(repr(whisker))
    print_notes(whisker)
    if duration is None:
        duration = FULL_DURATION if full else DURATION
    with progress_bars() as tell:
        result = run_demo(
            whisker,
            target,
            seed=seed or 0,
            noise=noise,
            duration=duration,
            rate=1000.0 if rate is None else rate,
            video=tracking,
            progress=tell,
        )
        pictures = _pictures(result, target, tell)
    _report(result, noise)
    for file in (*result.files, *pictures):
        say(f"wrote {file}")


def _pictures(result: DemoResult, folder: Path, tell: Tell) -> list[Path]:
    """Draw the figures of the trial, and signals over the space of all contacts."""
    from vibrissa.demo import video_files

    videos = None if result.tracking is None else video_files(folder)
    given, path = TrialOptions(videos, folder / "map.nc"), folder / "trial.nc"
    drawings = trial_drawings(path, recording_from(path), "double", given, tell)
    contact_map = result.contact_map
    line = contact_map.whisker.centerline(NODES)
    drawings["signal_space"] = lambda: vb.plots.signal_clouds(contact_map.to_dataset(), line)
    return saved(drawings, folder, ("png",), tell)


def _report(result: DemoResult, noise: bool) -> None:
    sensed, seen = result.sensed, result.seen
    scores = sensed.scores
    none, one, several = scores.candidates
    least = shown("MB", sensed.contacts.attrs["felt_above"], 3)
    away = shown("peg_position", float((scores.offset**2).sum() ** 0.5), 2)
    say()
    used = ", ".join(sensed.contacts.attrs["signals"].split())
    say(f"From ({used}) alone the peg is located with an error of {away}.")
    say(
        f"{scores.touching} of {sensed.contacts.sizes['time']} frames are in contact; in "
        f"{scores.detected} a contact was measured (M_B over {least}), {scores.false} of them false"
    )
    say(
        f"{one} of these ({100 * scores.share_with_one:.1f} %) have exactly one candidate, {none} "
        f"none, {several} several: the one that continues the neighbouring frames is chosen"
    )
    say()
    if result.tracking is not None:
        _print_tracking(result.tracking)
    if seen is not None:
        _print_signals(sensed, seen)
    _print_errors("Error of the contact point", "of", scores.errors, noise)
    _print_errors("3D error by deflection angle", "angle", scores.by_angle, noise)
    if seen is not None:
        title = f"The same by {_SEEN}*, signals and map being of one model"
        _print_errors(title, "angle", seen.scores.by_angle, False)
        say(f"* {vb.evaluation.caution(seen.contacts.attrs['source'])}")
        say()
    _print_peg(result)


def _print_tracking(scores: vb.evaluation.TrackingScores) -> None:
    views, lengths = ("top", "front"), ("centreline in space", "base", "contact point")
    rows = [
        (f"trace, {name}", *(f"{value:.3f} px" for value in pixels))
        for name, pixels in zip(views, scores.trace, strict=True)
    ]
    errors = (scores.centerline, scores.base, scores.contact)
    rows += [
        (name, *(f"{1e6 * value:.1f} µm" for value in values))
        for name, values in zip(lengths, errors, strict=True)
    ]
    print_table(
        ["error of", "median", "95 %"],
        rows,
        f"Tracking: {scores.lost} of {scores.frames} frames lost, contact classified correctly "
        f"in {100 * scores.classified:.1f} %",
    )


def _print_signals(sensed: Located, seen: Located) -> None:
    """Print errors of force and moment by deflection angle, from both sources."""
    of_seen = {row.label: row for row in seen.signals}
    rows = []
    for row in sensed.signals:
        cells = [row.label]
        for name in ("force", "moment"):
            for source in (row, of_seen.get(row.label)):
                error = None if source is None else getattr(source, name)[0]
                cells.append("–" if error is None else f"{100 * error:.2g} %")
        rows.append(cells)
    columns = ["angle", "force: sensor", _SEEN, "moment: sensor", _SEEN]
    print_table(columns, rows, "Signals, median error by deflection angle")


def _print_errors(
    title: str, first: str, rows: Sequence[vb.evaluation.ErrorRow], noise: bool
) -> None:
    """Print actual errors and, with noise, predicted ones."""
    cells: list[Row] = []
    for row in rows:
        values = [*row.measured, *(row.predicted[:2] if noise else ())]
        numbers = [shown(row.quantity, float(value), 3) for value in values]
        name = row.label if first == "angle" else _COORDINATES[row.quantity]
        cells.append([name, str(row.contacts), *numbers])
    print_table(
        [first, "contacts", "median", "95 %", "largest", *(["median*", "95 %*"] * noise)],
        cells,
        title,
        "* what the estimates' own covariance predicts" if noise else None,
    )


def _print_peg(result: DemoResult) -> None:
    """Print the fitted and the true peg."""
    from rich.text import Text

    found = {_SENSED: result.sensed}
    if result.seen is not None:
        found[_SEEN] = result.seen
    rows: list[Row | None] = []
    for name, one in found.items():
        fit, scores = one.fit, one.scores
        true = fit.origin - scores.offset
        if len(found) > 1:
            rows.append([Text(name, style="bold")])
        values = [
            (f"axis, {axis}", fit.origin[i], true[i], scores.offset[i], fit.origin_sigma[i])
            for i, axis in enumerate("xy")
        ]
        diameter = (fit.diameter, 2 * result.peg.radius, scores.diameter_error, fit.diameter_sigma)
        for label, *lengths in (*values, ("diameter", *diameter)):
            rows.append([label, *(f"{1e3 * float(value):.4f} mm" for value in lengths)])
        rows += [["tilt", "", "", shown("base_azimuth", scores.tilt, 2), ""], None]
    print_table(["", "fitted", "true", "error", "its sigma"], rows, "The peg")
