"""`vibrissa batch`: reconstruction of all recordings of a folder, with a table and a page."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import typer

import vibrissa as vb
from vibrissa.cli.estimate import EstimateOptions
from vibrissa.cli.inputs import objects_from, recording_from
from vibrissa.cli.options import with_options
from vibrissa.cli.reconstruct import ShapeOptions, stages
from vibrissa.cli.signals import SourceOptions
from vibrissa.cli.terminal import Tell, progress_bars, say, shown

# Files written to the folder by each run.
TABLE, PAGE = "summary.csv", "summary.html"
_COLUMNS = (
    *("file", "whiskers", "duration", "frames", "frames_in_contact", "contacts"),
    *("largest_force", "largest_moment", "estimated", "surface_distance"),
    *("shape", "x", "y", "z", "diameter", "diameter_sigma", "fitted", "fault"),
)
_HEADING = (
    *("recording", "whiskers", "duration", "frames", "in contact", "contacts", "largest force"),
    *("largest moment", "estimated", "distance from the object (median)", "object, or fault"),
)


@with_options()
def batch(
    folder: Path,
    wanted: ShapeOptions,
    source: SourceOptions,
    how: EstimateOptions,
    objects: Path | None = None,
    force: bool = False,
) -> None:
    """Reconstruct the object of every recording in a folder, and summarise all in a table and page.

    Each recording is processed as by `vibrissa reconstruct`, and the results are added to it.
    Recordings that have a contour are skipped unless --force is given, so that an interrupted run
    can be continued. A recording that fails does not stop the others: the table states the error,
    and the next run tries again; the exit status is then 1. The table is FOLDER/summary.csv, in SI
    units, and the page FOLDER/summary.html.
    Example: `vibrissa batch trials --shape sphere`
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} is not a folder; one with recordings is needed")
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".nc")
    # Names with a dot in front are of other systems' attributes of files, not of recordings.
    paths = [path for path in files if path.name[0] != "." and _is_recording(path)]
    if not paths:
        raise ValueError(
            f"{folder} contains no recordings; `vibrissa track` and `vibrissa import` create them"
        )
    table = folder / TABLE
    if table.exists() and not vb.io.read_text(table).startswith(",".join(_COLUMNS[:2])):
        raise ValueError(
            f"{table} is not a table of this command, which would replace it: rename it"
        )
    vb.io.check_writable(table)
    known = None if objects is None else objects_from(objects)
    rows, lines, kept = [], [], 0
    with progress_bars() as tell:
        for number, path in enumerate(paths):
            tell("recordings", number, len(paths))
            found, fault, made = _one(path, wanted, source, how, known, force, tell)
            kept += not (made or fault)
            rows.append(_cells(path, found, fault))
            lines.append(_shown(path, found, fault))
            # The table is complete up to here even if the next recording is interrupted.
            with suppress(OSError):
                vb.io.write_table(table, _COLUMNS, rows)
        tell("recordings", len(paths), len(paths))
    for row in rows:
        say(f"{row[0]}: {row[-1] or row[-2]}")
    failed = sum(bool(row[-1]) for row in rows)
    about = f"{len(rows)} recordings, {failed} with a fault"
    say(about)
    if kept:
        say(f"{kept} had a contour, which is unchanged; --force computes it again, as stated now")
    vb.io.write_table(table, _COLUMNS, rows)
    section = vb.report.Section("recordings", "Recordings", vb.report.table(lines, _HEADING))
    with vb.io.replacing(folder / PAGE) as part:
        part.write_text(
            vb.report.document(folder.resolve().name, about, [section]), encoding="utf-8"
        )
    say(f"wrote {table}\nwrote {folder / PAGE}")
    if failed:
        raise typer.Exit(1)


def _is_recording(path: Path) -> bool:
    """Whether a file is a recording, or may be a damaged one, rather than a map or signals."""
    try:
        return vb.io.recognise(path) in (vb.io.Kind.RECORDING, vb.io.Kind.UNKNOWN)
    except (ValueError, OSError):
        return True  # reading it will raise an error


def _one(
    path: Path,
    wanted: ShapeOptions,
    source: SourceOptions,
    how: EstimateOptions,
    objects: tuple[vb.objects.Surface, ...] | None,
    again: bool,
    tell: Tell,
) -> tuple[vb.pipeline.TrialSummary | None, str, bool]:
    """Reconstruct one recording: summary (or None), faults, and whether a contour was due."""
    faults: list[str] = []
    found, tree, made = None, None, False
    with _noted(faults):
        tree = vb.pipeline.without_faulty_stages(recording_from(path))
        if again or "contour" not in tree.children or vb.pipeline.edited(tree):
            known = vb.recording.Recording(tree).objects if objects is None else objects
            for stage, after in stages(tree, wanted, source, how, known, tell, str(path)):
                tree, made = after, True
                tell(f"{path.name}: {stage}", 1, 1)
    if tree is not None:
        with _noted(faults):
            if made:
                vb.io.save_recording(path, tree)
        with _noted(faults):  # groups may have been edited
            found = vb.pipeline.TrialSummary(tree)
    return found, "; ".join(dict.fromkeys(faults)), made


@contextmanager
def _noted(faults: list[str]) -> Iterator[None]:
    """Context that adds the text of an error to faults instead of raising it."""
    try:
        yield
    except (ValueError, OSError) as error:
        text = error.strerror if isinstance(error, OSError) else None
        faults.append(" ".join((text or str(error)).split()))


def _cells(path: Path, found: vb.pipeline.TrialSummary | None, fault: str) -> list[object]:
    """Row of the table."""
    if found is None:
        return [path.name, *[""] * (len(_COLUMNS) - 2), fault]
    names = " ".join(found.whiskers)
    numbers = (found.duration, found.frames, found.in_contact, found.contacts)
    sizes = (found.largest_force, found.largest_moment, found.estimated, found.distance)
    short = (_short(n) for n in (*numbers, *sizes))
    return [path.name, names, *short, *_object(found.shape), found.fitted, fault]


def _object(shape: vb.contour.FittedShape | None) -> list[object]:
    """Cells with kind, position and diameter of the fitted object, empty if not applicable."""
    if shape is None:
        return [""] * 6
    position = next(n for n, meant in shape.fields.items() if meant == "object_position")
    size: list[object] = ["", ""]
    if "radius" in shape.fields:
        size = [_short(2.0 * float(x)) for x in (getattr(shape, "radius"), shape.sigma["radius"])]  # noqa: B009
    return [shape.kind, *(_short(float(x)) for x in getattr(shape, position)), *size]


def _short(value: object) -> object:
    return f"{value:.6g}" if isinstance(value, float) else value


def _shown(path: Path, found: vb.pipeline.TrialSummary | None, fault: str) -> list[str]:
    """Row of the page, in display units."""
    if found is None:
        return [path.name, *[""] * (len(_HEADING) - 2), fault]

    def size(name: str, value: float) -> str:
        return shown(name, value, 3) if math.isfinite(value) else ""

    return [
        path.name,
        ", ".join(found.whiskers),
        f"{found.duration:g} s",
        *(str(n) if n is not None else "" for n in (found.frames, found.in_contact)),
        "" if found.contacts is None else str(found.contacts),
        size("force", found.largest_force),
        size("moment", found.largest_moment),
        str(found.estimated),
        size("surface_distance", found.distance),
        fault or found.fitted,
    ]
