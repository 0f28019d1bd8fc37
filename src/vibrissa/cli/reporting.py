"""`vibrissa report`: a trial or a map as one web page."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vibrissa.cli.terminal import Force, Tell, free, output, progress_bars, refuse

if TYPE_CHECKING:
    from xarray import DataTree

    from vibrissa.report import Section

_LARGEST = 15_000_000
"""Bytes of a page at most, as far as movies decide about it."""


def report(
    path: Annotated[
        Path,
        typer.Argument(help="The recording of a trial, or a map, NetCDF.", metavar="TRIAL | MAP"),
    ],
    target: Annotated[
        Path, typer.Option("--output", "-o", help="The page, .html.", metavar="FILE")
    ] = Path("report.html"),
    uniqueness: Annotated[
        Path | None,
        typer.Option(help="Of a map: saved result (.nc) of `vibrissa uniqueness`.", metavar="FILE"),
    ] = None,
    videos: Annotated[
        list[Path] | None,
        typer.Option(
            "--video", help="Of a trial: the video of a view, top and then front.", metavar="FILE"
        ),
    ] = None,
    chart: Annotated[
        Path | None,
        typer.Option("--map", help="Of a trial's whisker; simulated by default.", metavar="MAP"),
    ] = None,
    whisker: Annotated[
        int | None,
        typer.Option(help="Of a trial: which whisker, from 0; by default the one most in contact."),
    ] = None,
    films: Annotated[
        list[Path] | None,
        typer.Option(
            "--movie",
            help="A movie to be in the page, .mp4; may be repeated. Linked if the page would be "
            "larger than 15 MB.",
            metavar="FILE",
        ),
    ] = None,
    make_movies: Annotated[
        bool, typer.Option("--movies", help="Of a trial: make its movies beside the page first.")
    ] = False,
    seed: Annotated[
        int | None,
        typer.Option(
            help="Of a trial: of the draws behind what is predicted; 0 by default.", min=0
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Write a page that opens offline: what was done, how well, figures, a contour to turn.

    With SOURCE_DATE_EPOCH set, the same command gives the same page. Example: `vibrissa report
    trial.nc --video top.mp4 --video front.mp4 -o report.html`
    """
    import numpy as np

    from vibrissa.io import load_recording
    from vibrissa.io.paths import check_readable, check_writable, replacing
    from vibrissa.recording import Recording
    from vibrissa.report import (
        contacts_by_whisker,
        document,
        figure_sections,
        provenance,
        provenance_section,
    )

    check_writable(target, (".html", ".htm"))
    free([target], force)
    given = [path, *(file for file in (uniqueness, chart) if file), *(videos or []), *(films or [])]
    for file in given:
        check_readable(file)
    for film in films or []:
        if film.suffix.lower() != ".mp4":
            raise ValueError(f"--movie is {film}; a movie that ends in .mp4 is needed")
    kind = _kind(path)
    title = f"{'Trial' if kind == 'trial' else 'Map of contacts'}: {path.name}"
    with progress_bars() as tell:
        if kind == "trial":
            refuse({"--uniqueness": uniqueness}, f"{path} is a recording")
            trial = load_recording(path)
            whisker = int(np.argmax(contacts_by_whisker(trial))) if whisker is None else whisker
            sections, script, drawings = _of_trial(
                path, trial, videos or [], chart, whisker, seed or 0, tell
            )
            if trial.sizes["whisker"] > 1:
                title += f", whisker {Recording(trial).whisker(whisker).name}"
        else:
            options = {"--video": videos, "--map": chart, "--movies": make_movies}
            refuse(options | {"--whisker": whisker, "--seed": seed}, f"{path} is a map")
            sections, script, drawings = _of_map(path, uniqueness)
        sections.append(figure_sections(_drawn(drawings, tell)))
    movies = list(films or [])
    if make_movies:
        movies += _made(path, target, videos, chart, whisker or 0, force)
    # The page is the same, whether there was one before or not.
    command = ["vibrissa", *(word for word in sys.argv[1:] if word != "--force")]
    drawn = (seed or 0) if kind == "trial" else None
    origin = provenance_section(provenance(command, given, drawn))
    about = "From what a whisker feels at its base to what it touched, by vibrissa."
    if movies:
        sections.append(_movies(movies, target.parent, (title, about, sections, origin, script)))
    page = document(title, about, [*sections, origin], script)
    with replacing(target) as part:
        part.write_text(page, encoding="utf-8")
    size = target.stat().st_size / 1e6
    output.print(f"wrote {target}, {size:.1f} MB", highlight=False, soft_wrap=True)


def _kind(path: Path) -> str:
    from vibrissa.io import is_netcdf, kind_of
    from vibrissa.io.paths import refuse_whisk

    refuse_whisk(path)
    kind = kind_of(path) if is_netcdf(path) else None
    kinds = {"vibrissa recording": "trial", "vibrissa contact map": "map"}
    if kind not in kinds:
        raise ValueError(
            f"{path} holds {kind or 'data of another kind'}; a recording of a trial or a map of "
            "contacts is needed, as `vibrissa track` or `vibrissa map` writes them"
        )
    return kinds[kind]


def _of_trial(
    path: Path,
    trial: DataTree,
    videos: list[Path],
    chart: Path | None,
    whisker: int,
    seed: int,
    tell: Tell,
) -> tuple[list[Section], str, Mapping[str, Callable[[], Any]]]:
    """Sections, script and figures."""
    import numpy as np

    from vibrissa.cli.array_figures import array_drawings
    from vibrissa.cli.trial_figures import trial_drawings
    from vibrissa.cli.trial_views import fits_of
    from vibrissa.plots import course_of
    from vibrissa.report import contacts_in_space, space_section, trial_sections

    course = course_of(trial, whisker)
    sections = trial_sections(trial, whisker, seed)
    drawings = array_drawings(path, "double")
    drawings |= trial_drawings(path, "double", videos, chart, whisker, tell)
    if course.places is None or not np.isfinite(course.places).any():
        return sections, "", drawings
    if not _can_draw():
        return sections, "", drawings
    things = trial["objects"].children.values() if "objects" in trial.children else ()
    picture = contacts_in_space(course, [thing.to_dataset() for thing in things], fits_of(trial))
    shown = ["Contact points in the laboratory"]
    shown += ["the object as known"] if things else []
    shown += ["as fitted"] if "contour" in trial.children else []
    about = f"{', '.join(shown)}, and the whisker."
    section, script = space_section(picture, about)
    return [*sections, section], script, drawings


def _of_map(
    path: Path, uniqueness: Path | None
) -> tuple[list[Section], str, Mapping[str, Callable[[], Any]]]:
    """Sections, script and figures."""
    from vibrissa.cli.figures import dataset_with, map_drawings
    from vibrissa.cli.sources import map_from
    from vibrissa.report import chart_sections, reachable_space, space_section

    contact_map = map_from(path)
    verdicts = None if uniqueness is None else dataset_with(uniqueness, "verdict")
    sections = chart_sections(contact_map, verdicts)
    drawings = dict(map_drawings(contact_map, "double", verdicts, None))
    if not _can_draw():
        return sections, "", drawings
    picture = reachable_space(contact_map.to_dataset(), contact_map.whisker.centerline(101))
    section, script = space_section(picture, "All contacts that the whisker can hold.")
    return [*sections, section], script, drawings


def _can_draw() -> bool:
    """Whether there can be a picture in 3D; says so if not."""
    from vibrissa.report.space import MISSING, can_draw

    if not can_draw():
        output.print(MISSING, highlight=False, soft_wrap=True, markup=False)
    return can_draw()


def _drawn(drawings: Mapping[str, Callable[[], Any]], tell: Tell) -> dict[str, bytes]:
    from vibrissa.plots import png

    pictures = {}
    for i, (name, draw) in enumerate(drawings.items()):
        tell("figures", i, len(drawings))
        pictures[name] = png(draw())
    tell("figures", len(drawings), len(drawings))
    return pictures


def _made(
    path: Path,
    target: Path,
    videos: list[Path] | None,
    chart: Path | None,
    whisker: int,
    force: bool,
) -> list[Path]:
    """Make the movies that the trial allows, beside the page."""
    from vibrissa.cli.filming import movie

    folder = target.parent
    before = {file: file.stat().st_mtime_ns for file in folder.glob(f"{path.stem}-*.mp4")}
    movie(path, folder, videos=videos, chart=chart, whisker=whisker, force=force)
    after = sorted(folder.glob(f"{path.stem}-*.mp4"))
    return [file for file in after if before.get(file) != file.stat().st_mtime_ns]


def _movies(
    movies: list[Path], folder: Path, page: tuple[str, str, list[Section], Section, str]
) -> Section:
    """The movies, within what the rest of the page leaves."""
    from vibrissa.report import document, movies_section

    title, about, sections, origin, script = page
    rest = document(title, about, [*sections, origin], script)
    # Some room for the names and tags of movies.
    room = _LARGEST - len(rest.encode("utf-8")) - 10_000
    return movies_section(movies, folder, room)
