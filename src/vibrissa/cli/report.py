"""`vibrissa report`: report on a trial or a map as one web page."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import numpy as np

import vibrissa as vb
from vibrissa.cli import figures
from vibrissa.cli.figures import Draw, TrialOptions
from vibrissa.cli.inputs import MAP, RECORDING, kind_in, recording_from
from vibrissa.cli.movie import FrameOptions, make_movies
from vibrissa.cli.options import check_new, refuse, with_options
from vibrissa.cli.terminal import Tell, progress_bars, say
from vibrissa.deferred import xr

_LARGEST = 15_000_000  # size of a page up to which movies are embedded, bytes
_TAGS = 10_000  # size reserved for the names and tags of movies, bytes

# Title, sections, script and figures of a page.
_Content: TypeAlias = "tuple[str, list[vb.report.Section], str, Mapping[str, Draw]]"


@with_options("the page, .html, by default next to its source and named after it")
def report(
    path: Path,
    of_trial: TrialOptions,
    target: Path | None = None,
    uniqueness: Path | None = None,
    movie: list[Path] | None = None,
    make: bool = False,
    seed: int | None = None,
    force: bool = False,
) -> None:
    """Write a self-contained page with results, errors, figures and an interactive contour.

    It shows the whisker longest in contact, unless --which selects another. The seed is that of the
    random draws for predicted errors. If SOURCE_DATE_EPOCH is set, the same command gives the same
    page.
    Example: `vibrissa report trial.nc --video top.mp4 --video front.mp4`
    """
    target = path.with_suffix(".html") if target is None else target
    check_new(target, (".html", ".htm"), force)
    movies = list(movie or [])
    files = [file for file in (path, uniqueness, of_trial.map) if file]
    given = [*files, *(of_trial.videos or []), *movies]
    for file in given:
        vb.io.check_readable(file)
    for file in movies:
        if file.suffix.lower() != ".mp4":
            raise ValueError(f"--movie is {file}; a movie ending in .mp4 is needed")
    is_trial = _is_trial(path)
    with progress_bars() as tell:
        if is_trial:
            refuse({"--uniqueness": uniqueness}, f"{path} is a recording")
            trial = vb.pipeline.without_faulty_stages(recording_from(path))
            of_trial = of_trial.of(trial)
            with vb.io.in_file(path):
                content = _of_trial(path, trial, of_trial, seed or 0, tell)
        else:
            unused = of_trial.given() | {"--make-movies": make, "--seed": seed}
            refuse(unused, f"{path} is a map")
            content = _of_map(path, uniqueness)
        title, sections, script, drawings = content
        drawn = figures.drawn(drawings, tell)
        pictures = {name: vb.plots.png(one) for name, one in drawn}
        sections.extend(vb.report.figure_sections(pictures))
    if make:
        kinds = ("signals", "contour")
        how = (kinds, of_trial, FrameOptions(), force)
        movies += sorted(make_movies(path, trial, target.parent, *how))
    # The page must not depend on whether it replaces another.
    command = ["vibrissa", *(word for word in sys.argv[1:] if word != "--force")]
    origin = vb.report.provenance_section(command, given, (seed or 0) if is_trial else None)
    about = "From the forces and moments at a whisker's base to the object that it touched."

    page = vb.report.document(title, about, [*sections, origin], script)
    if movies:
        room = _LARGEST - len(page.encode("utf-8")) - _TAGS
        sections.append(vb.report.movies_section(movies, target.parent, room))
        page = vb.report.document(title, about, [*sections, origin], script)
    with vb.io.replacing(target) as part:
        part.write_text(page, encoding="utf-8")
    say(f"wrote {target}, {target.stat().st_size / 1e6:.1f} MB")


def _is_trial(path: Path) -> bool:
    vb.io.refuse_whisk(path)
    kind = kind_in(path)
    if kind not in (RECORDING, MAP):
        raise ValueError(
            f"{path} contains {kind or 'data of another kind'}; a recording of a trial or a map of "
            "contacts is needed, as written by `vibrissa track` or `vibrissa map`"
        )
    return kind == RECORDING


def _of_trial(
    path: Path, trial: xr.DataTree, of_trial: TrialOptions, seed: int, tell: Tell
) -> _Content:
    """Contents of the page of a trial."""
    course = vb.scene.course_of(trial, of_trial.whisker)
    sections, script = vb.report.trial_sections(trial, of_trial.whisker, seed), ""
    drawings = figures.array_drawings(trial, "double")
    drawings |= figures.trial_drawings(path, trial, "double", of_trial, tell)
    if course.places is not None and np.isfinite(course.places).any():
        shown = ["Contact points in the laboratory"]
        shown += ["the known object"] if "objects" in trial.children else []
        shown += ["the fitted shape"] if "contour" in trial.children else []
        about = f"{', '.join(shown)}, and the whisker."
        script = _add_space(sections, about, lambda: vb.report.trial_in_space(trial, course))
    title = f"Trial: {path.name}"
    if trial.sizes["whisker"] > 1:
        title += f", whisker {vb.recording.Recording(trial).whisker(of_trial.whisker).name}"
    return title, sections, script, drawings


def _of_map(path: Path, uniqueness: Path | None) -> _Content:
    """Contents of the page of a map."""
    contact_map = vb.ContactMap.load(path)
    verdicts = None if uniqueness is None else figures.dataset_with(uniqueness, "verdict")
    sections = vb.report.chart_sections(contact_map, verdicts)
    drawings = dict(figures.map_drawings(contact_map, "double", verdicts, None))
    script = _add_space(
        sections, "All stable contacts of the whisker.", lambda: vb.in_space(contact_map)
    )
    return f"Map of contacts: {path.name}", sections, script, drawings


def _add_space(sections: list[vb.report.Section], about: str, draw: Draw) -> str:
    """Add a section with a 3D figure, if it can be drawn, and return its script."""
    if not vb.report.can_draw():
        say(vb.report.NO_SPACE)
        return ""
    section, script = vb.report.space_section(draw(), about)
    sections.append(section)
    return script
