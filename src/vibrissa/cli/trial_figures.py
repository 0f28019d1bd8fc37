"""The figures of a trial."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vibrissa.cli.terminal import Tell, output

if TYPE_CHECKING:
    import xarray as xr

    from vibrissa.plots import Course
    from vibrissa.whisker import Whisker

Draw = Callable[[], Any]
_NODES = 101


def trial_drawings(
    path: Path,
    width: Any,
    videos: Sequence[Path],
    chart: Path | None,
    whisker: int,
    tell: Tell,
    colour: str = "time",
) -> dict[str, Draw]:
    """Say what can be drawn of a trial; what cannot is told, with the verb that makes it."""
    from vibrissa.io import load_recording
    from vibrissa.plots import course_of
    from vibrissa.recording import Recording

    trial = load_recording(path)
    course = course_of(trial, whisker)
    _say_what_is_lacking(course, trial, path)
    bent = Recording(trial).whisker(whisker)
    drawings = dict(_of_contacts(trial, course, bent, (width, colour)))
    if course.signals is not None:
        drawings |= _of_signals(trial, course, bent, width, (videos, chart, whisker, tell))
    return drawings


def _say_what_is_lacking(course: Course, trial: xr.DataTree, path: Path) -> None:
    lacking = []
    if course.signals is None:
        lacking.append(f"no signals: `vibrissa signals {path}` makes them")
    if course.estimated is None and "estimates" in trial.children:
        lacking.append("no estimated contacts of this whisker")
    elif course.estimated is None:
        lacking.append(f"no estimated contacts: `vibrissa estimate {path}` makes them")
    if course.places is None:
        lacking.append(f"no contact points: `vibrissa reconstruct {path}` makes them")
    for reason in lacking:
        output.print(f"{path} has {reason}", highlight=False, soft_wrap=True)


def _of_contacts(
    trial: xr.DataTree, course: Course, whisker: Whisker, look: tuple[Any, str]
) -> Iterator[tuple[str, Draw]]:
    """Figures of the whisker and of contact points."""
    from vibrissa import plots
    from vibrissa.cli.trial_views import bodies_of, fits_of
    from vibrissa.contacts.contact_map import spherical
    from vibrissa.contour import CylinderFit
    from vibrissa.objects import Peg

    width, colour = look
    by: Any = "time" if colour == "time" else "deflection_angle"
    line = whisker.centerline(_NODES)
    radius = whisker.radius(np.linspace(0.0, whisker.length, _NODES))
    assumed = whisker.assumed
    yield (
        "whisker",
        lambda: plots.whisker_views(line, radius, name=whisker.name, assumed=assumed, width=width),
    )
    angles = plots.deflection_angles(course, line)
    bodies, fits = bodies_of(trial), fits_of(trial)
    places, known, estimated = course.places, course.known, course.estimated
    if places is not None:
        peg = next((body for body in bodies if isinstance(body, Peg)), None)
        fit = next((shape for shape in fits if isinstance(shape, CylinderFit)), None)
        yield (
            "contact_places",
            lambda: plots.contact_places(course, line, bodies, fits, colour=by, width=width),
        )
        yield (
            "contour",
            lambda: plots.contour_views(places, peg, fit, colour=angles, width=width),
        )
    if known is not None and estimated is not None:
        yield (
            "estimates",
            lambda: plots.estimated_against_true(
                spherical(known),
                spherical(estimated),
                time=course.time,
                colour=angles,
                known_as=course.known_as,
            ),
        )


def _of_signals(
    trial: xr.DataTree,
    course: Course,
    whisker: Whisker,
    width: Any,
    given: tuple[Sequence[Path], Path | None, int, Tell],
) -> Iterator[tuple[str, Draw]]:
    """Figures of signals."""
    from vibrissa import plots
    from vibrissa.cli.trial_views import map_of, sights_of

    videos, chart, number, tell = given
    samples = map_of(trial, chart, number, tell).to_dataset()
    rows = plots.telling_rows(course)
    if width == "single":
        rows = rows[-1:]
    sights = sights_of(trial, course, videos, rows)
    line = whisker.centerline(_NODES)
    signals = trial["signals"].to_dataset()
    yield (
        "trial",
        lambda: plots.trial_overview(course, samples, line, sights, rows, width=width),
    )
    yield "signals", lambda: plots.signals_over_time(signals, whisker=number, width=width)
