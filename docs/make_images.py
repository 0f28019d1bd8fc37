"""Make the figures of these pages anew: ``python docs/make_images.py [FOLDER] [NAME ...]``.

The folder is ``docs/images`` by default; without names all are made. Nothing in them is random, so
an unchanged program gives the same figures. Verdicts take a minute or two for each whisker, the
critical cones ten minutes or more.
"""

import io
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from PIL import Image
from title_picture import title_picture
from tracking_picture import tracking_picture

import vibrissa as vb
from vibrissa import plots
from vibrissa.contour import compare_with, distances_by, shape_from_dataset
from vibrissa.identifiability import critical_cones, witness_pairs
from vibrissa.paper import error_solid, signal_slice
from vibrissa.pipeline import with_contour, with_estimates
from vibrissa.plots import style
from vibrissa.recording import Recording
from vibrissa.scene import course_of, deflection_angles
from vibrissa.signals import nearest_on_rest
from vibrissa.simulation import (
    array_whisking,
    facing_peg,
    film_frames,
    head_path,
    measure,
    simulate,
    sweep_past,
    views_of,
    with_true_traces,
    within_reach,
)

WIDTH = 1200
WIDER = {"title": 1360}
LEVELS = {
    "title": 48,
    "signal_space": 48,
    "solid": 32,
    "trial": 32,
    "movie_signals": 64,
    "movie_contour": 64,
    "contour": 48,
    "contour_free": 48,
    "contact_places": 48,
}
"""Of red, green and blue in figures for which 256 colours are too few."""

GROWING, SMALL = 40, (800, 450)
"""Frames of the animated picture, and its size, pixels."""

CURVATURES = np.arange(8) / 5.0
TAPER_RATIOS = (1.0, 2.0, 4.0, 8.0, 15.0, 30.0, 60.0)


@cache
def chart() -> vb.ContactMap:
    """Map of the γ whisker."""
    return vb.ContactMap.simulate(vb.samples.gamma())


@cache
def verdicts() -> xr.Dataset:
    """Verdicts on the γ whisker."""
    return vb.uniqueness(chart())


def witness(whisker: vb.Whisker, found: xr.Dataset, triplet: str) -> Figure:
    """Two contacts with the same signals."""
    return plots.witness_pair(dict(witness_pairs(whisker, found, [triplet]))[triplet])


def c2() -> Figure:
    """A witness for a whisker that is more curved than the γ whisker."""
    whisker = vb.Whisker.parabola(length=40e-3, coefficient=20.5, name="A·L = 0.82")
    contact_map = vb.ContactMap.simulate(whisker, grid=False)
    found = vb.uniqueness(contact_map, ["Fx MB MD"], ["all"], resolution=False)
    return witness(whisker, found, "Fx MB MD")


def up_to_the_fold() -> Figure:
    """The γ whisker pushed aside at one point, forward and backward, until it would slip off."""
    whisker = vb.samples.gamma()
    start = whisker.centerline(1001)[650]
    aside = np.linspace(0.0, 0.6, 601)[1:] * whisker.length
    ways = np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    bent = vb.deflect(whisker, vb.PointContact(start + aside[:, None] * ways[:, None]))
    shown = []
    for way, status in enumerate(bent.status):
        last = np.flatnonzero(status == vb.Status.OK)[-1]
        rows = np.linspace(0, last, 4).round().astype(int)[1:]
        shown += [(way, row) for row in (rows[::-1] if way == 0 else rows)]
    these = tuple(np.transpose(shown))
    return plots.bent_views(
        whisker.centerline(101),
        bent.centerline(101)[these],
        bent.contact_point[these],
        bent.force[these],
    )


@cache
def trial() -> xr.DataTree:
    """Half a second of whisking past a peg, measured with a noisy sensor, and its contour."""
    whisker = chart().whisker
    peg = facing_peg(whisker)
    motion = sweep_past(whisker, peg, 0.5, seed=1)
    measured = measure(simulate(whisker, motion, peg), seed=1)
    return with_contour(with_true_traces(measured, views_of(measured)))


@cache
def long_trial() -> xr.DataTree:
    """The same for one and a half seconds."""
    whisker = chart().whisker
    peg = facing_peg(whisker)
    motion = sweep_past(whisker, peg, 1.5, seed=1)
    return with_contour(measure(simulate(whisker, motion, peg), seed=1))


def contour() -> Figure:
    """Its contacts and the peg that was fitted to them."""
    course, (peg,) = course_of(long_trial()), Recording(long_trial()).objects
    return plots.contour_views(
        course.places,
        peg,
        shape_from_dataset(long_trial()["contour"].to_dataset()),
        colour=deflection_angles(course, line()),
        whisker_radius=chart().whisker.radius(
            long_trial()["estimates"]["arc_length"].isel(whisker=0).values
        ),
    )


def filmed(rows: Sequence[int], of: Callable[[], xr.DataTree] = trial) -> list[plots.Sight]:
    """Both views of some of its frames."""
    shown = of().isel(time=rows)
    return [plots.Sight(camera, film_frames(shown, camera)) for camera in views_of(of())]


def overview() -> Figure:
    """The trial at a glance."""
    course = course_of(trial())
    rows = plots.key_frames(course)
    return plots.trial_overview(course, chart().to_dataset(), line(), filmed(rows), rows)


def places() -> Figure:
    """Its contacts about the whisker and in the laboratory."""
    course, fit = course_of(trial()), shape_from_dataset(trial()["contour"].to_dataset())
    return plots.contact_places(course, line(), Recording(trial()).objects, [fit])


def signal_movie() -> np.ndarray:
    """A frame of the movie of signals."""
    course = course_of(trial())
    rows = [0, plots.key_frames(course)[-1] - 4, len(course.time) - 1]
    return list(plots.signal_frames(course, chart().to_dataset(), line(), rows))[1]


def contour_movie() -> np.ndarray:
    """A frame of the movie of the contour."""
    course = course_of(trial())
    rows = [0, plots.key_frames(course)[-1] - 4, len(course.time) - 1]
    return list(
        plots.contour_frames(course, line(), filmed(rows), rows, Recording(trial()).objects)
    )[1]


def growing() -> list[np.ndarray]:
    """The movie of the contour of the long trial in few frames."""
    course = course_of(long_trial())
    rows = np.linspace(0, len(course.time) - 1, GROWING).astype(int).tolist()
    objects = Recording(long_trial()).objects
    return list(plots.contour_frames(course, line(), filmed(rows, long_trial), rows, objects))


def line() -> np.ndarray:
    """Centreline of the γ whisker."""
    return chart().whisker.centerline(101)


def touching_array() -> Figure:
    """All whiskers of a face and a sphere, with the contacts that are estimated."""
    rat = vb.whisker_array()
    time = np.arange(500) / 1000
    turn, place = head_path(time, to_position=[0, 14e-3, 0])
    motions = array_whisking(rat, 0.5, 1000, head_rotation=turn, head_position=place)
    measured = measure(simulate(rat, motions, within_reach(rat, "sphere")))
    return plots.array_views(with_estimates(measured), contacts="estimates")


def free_surface() -> Figure:
    """A box that all whiskers of a face touch, and a surface of any shape through the contacts."""
    rat = vb.whisker_array()
    time = np.arange(500) / 1000
    turn, place = head_path(time, to_position=[0, 14e-3, 0])
    motions = array_whisking(rat, 0.5, 1000, head_rotation=turn, head_position=place)
    box = within_reach(rat, "box")
    measured = with_contour(measure(simulate(rat, motions, box)), "free")
    estimates = measured["estimates"].to_dataset()
    points = estimates["contact_point"].transpose("time", "whisker", "space").values
    spread = estimates["contact_covariance"].transpose("time", "whisker", ...).values
    when = np.repeat(time, points.shape[1])
    return plots.contour_views(
        points.reshape(-1, 3),
        box,
        shape_from_dataset(measured["contour"].to_dataset()),
        colour=when,
        colour_name="time",
        covariance=spread.reshape(-1, 3, 3),
    )


def distances() -> Figure:
    """Contacts of the trial from the peg that was touched."""
    estimates = trial()["estimates"].to_dataset().isel(whisker=0)
    whisker, (peg,) = chart().whisker, Recording(trial()).objects
    own = estimates["contact_point_whisker"].values
    away, along = nearest_on_rest(whisker, own)
    arc_length = estimates["arc_length"].values
    radius = np.full(arc_length.shape, np.nan)
    known = np.isfinite(arc_length)
    radius[known] = whisker.radius(arc_length[known])
    compared = compare_with(
        peg,
        estimates["contact_point"].values,
        estimates["contact_covariance"].values,
        radius,
        dims=("time",),
    )
    measured = trial()["signals"].to_dataset().isel(whisker=0)
    classes = np.radians([0.0, 5.0, 10.0, 15.0, 90.0])
    return plots.distances_by_class(
        [
            distances_by(compared, "deflection_angle", np.arctan2(away, along), classes),
            distances_by(compared, "r", np.linalg.norm(own, axis=-1)),
            distances_by(compared, "MB", measured["MB"].values),
        ]
    )


FIGURES: dict[str, Callable[[], Figure | np.ndarray | list[np.ndarray]]] = {
    "title": lambda: title_picture(long_trial(), chart()),
    "contour": contour,
    "array": lambda: plots.array_views(vb.whisker_array().to_tree()),
    "array_trial": touching_array,
    "bent": up_to_the_fold,
    "signal_space": lambda: plots.signal_clouds(chart().to_dataset(), line()),
    "contact_surfaces": lambda: plots.contact_surfaces(chart().to_dataset(), line()),
    "sensitivity": lambda: plots.sensitivity_panels(vb.sensitivity(chart(), at="grid")),
    "solid": lambda: plots.solid_slices(signal_slice(chart()), error_solid(chart())),
    "verdicts": lambda: plots.verdict_table(verdicts()),
    "resolution": lambda: plots.resolution(verdicts()),
    "witness_Mx_MB_MD": lambda: witness(chart().whisker, verdicts(), "Mx MB MD"),
    "witness_curved": c2,
    "tracking": tracking_picture,
    "trial": overview,
    "contact_places": places,
    "movie_signals": signal_movie,
    "movie_contour": contour_movie,
    "growing": growing,
    "contour_free": free_surface,
    "contour_distances": distances,
    "critical_cones": lambda: plots.critical_cones(critical_cones(CURVATURES, TAPER_RATIOS)),
}


def save(figure: Figure | np.ndarray | list[np.ndarray], path: Path) -> None:
    """Write a figure, a frame of a movie, or several as an animated picture."""
    if isinstance(figure, list):
        frames = [
            Image.fromarray(frame[..., :3]).resize(SMALL, Image.Resampling.LANCZOS)
            for frame in figure
        ]
        # One palette, so that nothing flickers: greys for films, the colours of time, and red.
        grey = np.linspace(0.0, 1.0, 64)[:, None] * np.ones(3)
        bright = np.vstack([style.sequential()(np.linspace(0.0, 1.0, 30))[:, :3], [[0.85, 0, 0]]])
        colours = [grey, *(share * bright + 1.0 - share for share in (1.0, 0.5)), 0.5 * bright[-1:]]
        palette = Image.new("P", (1, 1))
        palette.putpalette((255 * np.vstack(colours)).round().astype(int).ravel().tolist())
        first, *others = [frame.quantize(palette=palette, dither=0) for frame in frames]
        times = [120] * len(others) + [3000]  # ms; the whole contour stays
        how = {"save_all": True, "append_images": others, "duration": times, "loop": 0}
        first.save(path.with_suffix(".gif"), optimize=True, **how)
        return
    if isinstance(figure, Figure):
        drawn = io.BytesIO()
        figure.savefig(drawn, format="png")
        image = Image.open(drawn)
    else:
        image = Image.fromarray(figure[..., :3])
    save_small(image, path)


def save_small(image: Image.Image, path: Path) -> None:
    """Write an image 1200 pixels wide, or wider, in as many colours as need be."""
    width = WIDER.get(path.stem, WIDTH)
    height = round(image.height * width / image.width)
    small = image.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)
    if path.stem in LEVELS:
        steps = LEVELS[path.stem] - 1
        rounded = [round(round(v / 255 * steps) * 255 / steps) for v in range(256)]
        small.point(rounded * 3).save(path, optimize=True)
    else:
        small.quantize(256, Image.Quantize.MEDIANCUT).save(path, optimize=True)


def main() -> None:
    """Make what the command line asks for."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images"
    folder.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[2:] or FIGURES:
        save(FIGURES[name](), folder / f"{name}.png")


if __name__ == "__main__":
    main()
