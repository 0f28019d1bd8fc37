"""`vibrissa figures`: figures of a map, a trial or an array, also for movies and reports."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

import vibrissa as vb
from vibrissa.cli.inputs import map_of, recording_from
from vibrissa.cli.options import Format, free, refuse, with_options
from vibrissa.cli.terminal import Tell, progress_bars, remark, say
from vibrissa.deferred import xr

Draw = Callable[[], Any]  # draws a figure when it is called
NODES = 101  # number of points of a drawn whisker
_LIGHT, _DARK = 235.0, 70.0  # grey values of background and objects without a video
_VIEWS = 2  # largest number of drawn views
# Groups searched, in this order, for the contact points in an array's figure.
_CONTACTS = ("estimates", "truth")


@dataclass(frozen=True)
class TrialOptions:
    """Options for figures of a trial, and the selection of a whisker."""

    videos: list[Path] | None = None
    map: Path | None = None
    which: int | None = None

    def given(self) -> dict[str, object]:
        """Options by their names."""
        return {"--video": self.videos, "--map": self.map, "--which": self.which}

    def of(self, trial: xr.DataTree) -> TrialOptions:
        """Options for a trial, with the whisker longest in contact unless one is chosen."""
        if self.which is not None:
            return self
        longest = int(np.argmax(vb.report.contacts_by_whisker(trial)))
        if len(names := vb.recording.Recording(trial).names) > 1:
            remark(
                f"of {len(names)} whiskers, the one longest in contact is shown: {names[longest]} "
                f"(--which {longest}; others by --which)"
            )
        return replace(self, which=longest)

    @property
    def whisker(self) -> int:
        """Index of the whisker."""
        return self.which or 0

    def contact_map(self, trial: xr.DataTree, tell: Tell) -> vb.ContactMap:
        """Read or simulate the map of a trial's whisker."""
        own = vb.recording.Recording(trial).whisker(self.whisker)
        if self.map is None:
            return map_of(own, tell)
        found = vb.ContactMap.load(self.map)
        if not np.isclose(found.whisker.length, own.length, rtol=1e-6):
            raise ValueError(
                f"{self.map} is the map of a whisker of {1e3 * found.whisker.length:.3f} mm, but "
                f"that of the trial has {1e3 * own.length:.3f} mm: omit --map to simulate its map"
            )
        return found


def sights_of(
    trial: xr.DataTree, course: vb.scene.Course, videos: Sequence[Path], rows: NDArray[np.intp]
) -> list[vb.plots.Sight]:
    """Views of some frames of a trial, from videos or drawn."""
    cameras = _cameras(trial)
    if videos and len(videos) != len(cameras):
        raise ValueError(
            f"the trial has {len(cameras)} cameras; there are {len(videos)} videos: give one "
            "--video for each"
        )
    sights = []
    for number, camera in enumerate(cameras[:_VIEWS]):
        images: Iterable[Any]
        if videos:
            frames = rows if course.frames is None else course.frames[rows, number]
            listed = [int(frame) for frame in frames]
            _check_video(videos[number], camera, listed)
            images = vb.io.video_frames(videos[number], listed)
        else:  # the objects on a uniform background
            things = list(vb.recording.Recording(trial).objects)
            middle = np.nanmean(course.position, axis=0)
            covered = vb.simulation.silhouette(camera, things, middle, 0.7)
            image = np.asarray(_LIGHT * (1.0 - covered) + _DARK * covered, dtype=np.uint8)
            images = repeat(image)
        sights.append(vb.plots.Sight(camera, images))
    return sights


def _cameras(trial: xr.DataTree) -> tuple[vb.cameras.Camera, ...]:
    """Cameras of a recording; for a simulated trial without cameras, two suitable ones."""
    if "cameras" in trial.children:
        return vb.recording.Recording(trial).cameras
    if "truth" in trial.children and "centerline" in trial["truth"]:
        return vb.simulation.views_of(trial)
    return ()


def _check_video(video: Path, camera: vb.cameras.Camera, frames: Sequence[int]) -> None:
    info = vb.io.video_info(video)
    if (info.width, info.height) != tuple(camera.size):
        raise ValueError(
            f"{video} has {info.width} × {info.height} pixels, the camera {camera.name!r} has "
            f"{camera.size[0]} × {camera.size[1]}: is it the video of another view?"
        )
    if 0 < info.frames <= max(frames):
        raise ValueError(f"{video} has {info.frames} frames; frame {max(frames)} is needed")


def fits_of(trial: xr.DataTree) -> list[vb.contour.FittedShape]:
    """Shapes fitted to the contacts of a trial."""
    if "contour" not in trial.children:
        return []
    return [vb.contour.shape_from_dataset(trial["contour"].to_dataset())]


def array_drawings(trial: xr.DataTree, width: Any) -> dict[str, Draw]:
    """Figure of a trial with several whiskers; empty for one."""
    groups = {name: group for name in _CONTACTS if (group := trial.get(name)) is not None}
    groups["/"] = trial
    contacts = [name for name, group in groups.items() if "contact_point" in group.data_vars]
    lines = any("centerline" in group.data_vars for group in groups.values())
    if trial.sizes.get("whisker", 0) < 2 or not contacts or not lines:
        return {}
    return {"array": lambda: vb.plots.array_views(trial, contacts=contacts[0], width=width)}


def map_drawings(
    contact_map: vb.ContactMap, width: Any, verdicts: xr.Dataset | None, cones: xr.Dataset | None
) -> Iterator[tuple[str, Draw]]:
    """Yield the figures of a map."""
    whisker, samples = contact_map.whisker, contact_map.to_dataset()
    line = whisker.centerline(NODES)
    gridded = contact_map.grid is not None

    def solid() -> Any:
        """Slice at M_D = −π/2, and all contacts with the errors of a look-up in the grid."""
        errors = vb.paper.error_solid(contact_map) if gridded else None
        return vb.plots.solid_slices(vb.paper.signal_slice(contact_map), errors, width=width)

    def panels() -> Any:
        """Derivatives at the contacts of the paper's grid if there is one, or of the map."""
        found = vb.sensitivity(contact_map, at="grid" if gridded else None)
        return vb.plots.sensitivity_panels(found, width=width)

    yield "whisker", _whisker_drawing(whisker, width)
    yield "signal_space", lambda: vb.plots.signal_clouds(samples, line, width=width)
    yield "contact_surfaces", lambda: vb.plots.contact_surfaces(samples, line, width=width)
    yield "sensitivity", panels
    yield "solid", solid
    if cones is not None:
        yield "critical_cones", lambda: vb.plots.critical_cones(cones, width=width)
    if verdicts is None:
        return
    yield "verdicts", lambda: vb.plots.verdict_table(verdicts, width=width)
    if "ambiguous_share" in verdicts:
        yield "resolution", lambda: vb.plots.resolution(verdicts, width=width)
    triplets = (*vb.plots.HIGHLIGHTED, str(verdicts.attrs.get("chosen_triplet", "")))
    for name, pair in vb.identifiability.witness_pairs(whisker, verdicts, triplets):
        drawn = partial(vb.plots.witness_pair, pair, width=width)
        yield f"witness_{name.replace(' ', '_')}", drawn


def _whisker_drawing(whisker: vb.Whisker, width: Any) -> Draw:
    return lambda: vb.plots.whisker_views(
        whisker.centerline(NODES),
        whisker.radius(np.linspace(0.0, whisker.length, NODES)),
        name=whisker.name,
        assumed=whisker.assumed,
        width=width,
    )


def trial_drawings(
    path: Path,
    trial: xr.DataTree,
    width: Any,
    given: TrialOptions,
    tell: Tell,
    colour: str = "time",
) -> dict[str, Draw]:
    """Figures of a trial; missing stages are printed, with the verb that computes them."""
    given = given.of(trial)
    course = vb.scene.course_of(trial, given.whisker)
    for _, reason in lacking_of(course, trial, path):
        say(f"{path} has {reason}")
    whisker = vb.recording.Recording(trial).whisker(given.whisker)
    drawings = {"whisker": _whisker_drawing(whisker, width)}
    drawings |= _contact_drawings(trial, course, whisker, given.whisker, width, colour)
    if course.signals is None:
        return drawings
    samples = given.contact_map(trial, tell).to_dataset()
    rows = vb.plots.key_frames(course)
    if width == "single":
        rows = rows[-1:]
    sights = sights_of(trial, course, given.videos or (), rows)
    line, signals = whisker.centerline(NODES), trial["signals"].to_dataset()
    return drawings | {
        "trial": lambda: vb.plots.trial_overview(course, samples, line, sights, rows, width=width),
        "signals": lambda: vb.plots.signals_over_time(signals, whisker=given.whisker, width=width),
    }


def lacking_of(
    course: vb.scene.Course, trial: xr.DataTree, path: Path
) -> Iterator[tuple[str, str]]:
    """Yield what a trial lacks, with the verb that computes it, by the picture that needs it."""
    if course.signals is None and str(trial.attrs.get("origin")).startswith("swept"):
        yield "signals", "no signals: contacts of a sweep are estimated without them"
    elif course.signals is None:
        yield "signals", f"no signals: `vibrissa signals {path}` makes them"
    if course.estimated is None and "estimates" in trial.children:
        yield "estimates", "no estimated contacts of this whisker"
    elif course.estimated is None:
        yield "estimates", f"no estimated contacts: `vibrissa estimate {path}` makes them"
    if course.places is None:
        yield "contour", f"no contact points: `vibrissa reconstruct {path}` makes them"


def _contact_drawings(
    trial: xr.DataTree,
    course: vb.scene.Course,
    whisker: vb.Whisker,
    number: int,
    width: Any,
    colour: str,
) -> dict[str, Draw]:
    """Figures of contact points."""
    by: Any = "time" if colour == "time" else "deflection_angle"
    line = whisker.centerline(NODES)
    angles = vb.scene.deflection_angles(course, line)
    bodies, fits = list(vb.recording.Recording(trial).objects), fits_of(trial)
    points, known, estimated = course.places, course.known, course.estimated
    group = {"estimated": "estimates", "true": "truth"}.get(course.places_as, "")
    arc = vb.recording.Recording(trial).known("arc_length", [group])
    drawings: dict[str, Draw] = {}
    if points is not None:
        drawings["contact_places"] = lambda: vb.plots.contact_places(
            course, line, bodies, fits, colour=by, width=width
        )
        drawings["contour"] = lambda: vb.plots.contour_views(
            points,
            next(iter(bodies), None),
            next(iter(fits), None),
            colour=angles,
            whisker_radius=None if arc is None else whisker.radius(arc[:, number]),
            width=width,
        )
    if known is not None and estimated is not None:
        drawings["estimates"] = lambda: vb.plots.estimated_against_true(
            vb.signals.spherical(known),
            vb.signals.spherical(estimated),
            time=course.time,
            colour=angles,
            known_as=course.known_as,
        )
    return drawings


@with_options("figures, in a folder")
def figures(
    path: Path,
    of_trial: TrialOptions,
    target: Path = Path("figures"),
    format_: list[Format] | None = None,
    width: Literal["single", "double"] = "double",
    uniqueness: Path | None = None,
    cones: Path | None = None,
    colour: Literal["time", "deflection"] | None = None,
    force: bool = False,
) -> None:
    """Draw all figures of a map, a trial or an array.

    For a map: whisker, signals over space, surfaces, sensitivity; with a saved result of `vibrissa
    uniqueness` also the verdicts, the resolution and pairs of contacts with the same signals. For a
    trial: frames, signals and their trajectory in the solids of a map, contacts relative to the
    whisker and in the laboratory, estimates, contour. For an array of whiskers, or a trial of
    several: the face, the whiskers and the objects.
    Example: `vibrissa figures map.nc -o figures --width single`
    """
    endings = tuple(dict.fromkeys(map(str, format_ or ("png", "pdf"))))
    vb.io.check_folder(target)
    verdicts = None if uniqueness is None else dataset_with(uniqueness, "verdict")
    sweep = None if cones is None else dataset_with(cones, "critical_cone")
    with progress_bars() as tell:
        kind = None if path.is_dir() else vb.io.recognise(path)
        if kind == vb.io.Kind.RECORDING:
            refuse({"--uniqueness": uniqueness, "--cones": cones}, f"{path} is a recording")
            trial = recording_from(path)
            drawings = array_drawings(trial, width)
            drawings |= trial_drawings(path, trial, width, of_trial, tell, colour or "time")
        else:
            refuse(of_trial.given() | {"--colour": colour}, f"{path} is not a recording")
        if kind in (None, vb.io.Kind.ARRAY, vb.io.Kind.ARRAY_TABLE):
            face = vb.load_array(path).to_tree()
            drawings = {"array": lambda: vb.plots.array_views(face, width=width)}
        elif kind != vb.io.Kind.RECORDING:
            drawings = dict(map_drawings(vb.ContactMap.load(path), width, verdicts, sweep))
        free([target / f"{name}.{ending}" for name in drawings for ending in endings], force)
        target.mkdir(parents=True, exist_ok=True)
        files = saved(drawings, target, endings, tell)
    for file in files:
        say(f"wrote {file}")


def saved(
    drawings: dict[str, Draw], folder: Path, endings: Sequence[str], tell: Tell
) -> list[Path]:
    """Draw figures into a folder."""
    figures = drawn(drawings, tell)
    return [
        file for name, figure in figures for file in vb.plots.save(figure, folder / name, endings)
    ]


def drawn(drawings: Mapping[str, Draw], tell: Tell) -> Iterator[tuple[str, Any]]:
    """Yield figures one after the other."""
    for i, (name, draw) in enumerate(drawings.items()):
        tell("figures", i, len(drawings))
        yield name, draw()
    tell("figures", len(drawings), len(drawings))


def dataset_with(path: Path, needed: str) -> xr.Dataset:
    """Read a dataset that contains a given variable."""
    if path.suffix.lower() in vb.io.CSV:
        raise ValueError(f"{path} is a table; the result saved as NetCDF (-o FILE.nc) is needed")
    kind = vb.io.kind_of(path)
    data = vb.io.read_dataset(path)
    if needed not in data:
        raise ValueError(
            f"{path} contains {kind or 'data of another kind'}, and no variable {needed!r}"
        )
    return data
