"""`vibrissa track`: tracking of whiskers in videos."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import vibrissa as vb
from vibrissa.cli import inputs
from vibrissa.cli.options import free, numbers, refuse, with_options
from vibrissa.cli.terminal import progress_bars, remark, say, shown
from vibrissa.deferred import xr

if TYPE_CHECKING:
    _Traces = Sequence[Sequence[Sequence[vb.tracking.Trace]]]

_NARROWEST, _WIDEST = 1e-3, 1.0  # plausible widths of a view, m
_FINEST = 3.0  # width of a whisker's base in the images for which tracing is tuned, pixels
# Misfit of traces, in standard deviations, above which the rod does not explain them.
_POOR = 2.0
_VIEW = re.compile(r"\d+,\d+,\d+,\d+(:[a-z]+)*")  # part of the images of a video
_NEAREST, _FARTHEST = 0.03, 30.0  # smallest and largest distance of a lens, m
_RATE = 1000.0

_HALF = 127  # grey value above which a pixel of a mask image is bright
# Reason for showing a frame in which the whisker may have been lost.
_LOST = "here a whisker is lost, has a hook, or differs much in length from the frame before"
_INTERLACED = (
    "not sure: {} is interlaced, its odd and even rows show different moments, and what moves is "
    "seen twice. Separate them first (ffmpeg -i VIDEO -vf bwdif=send_field NEW), which doubles "
    "--rate"
)
_UNEXPLAINED = "here the bent rod explains the traces worst: one of them may be on something else"


@dataclass(frozen=True)
class FilmOptions:
    """Options for cameras and recording of the videos."""

    pixel_size: float | None = None
    distance: float | None = None
    rate: float | None = None
    cameras: Path | None = None
    views: list[str] | None = None
    offset: str = "0"

    def __post_init__(self) -> None:
        if self.offset != "auto" and not self.offset.lstrip("+-").isdigit():
            raise ValueError(f"--offset is {self.offset!r}; a number of frames or auto is needed")
        if not 0.0 < self.frames_per_second < math.inf:
            raise ValueError(f"--rate is {self.rate:g}; it must be positive, in frames per second")
        if self.cameras is not None:
            given = {"--pixel-size": self.pixel_size, "--distance": self.distance}
            refuse(given, "the --cameras determine it")
        far = self.distance is None or math.isinf(self.distance)
        if self.distance is not None and not (far or _NEAREST <= self.distance <= _FARTHEST):
            raise ValueError(
                f"--distance is {self.distance:g} m; {_NEAREST:g} to {_FARTHEST:g} m are allowed, "
                "or inf for telecentric lenses"
            )

    @property
    def frames_per_second(self) -> float:
        """Frame rate, 1000 Hz by default."""
        return _RATE if self.rate is None else self.rate

    def split(self, stated: Sequence[Path]) -> list[Path]:
        """Videos of the views: files or, with --views, parts of them."""
        # Parts after the first are parsed as positional arguments.
        more = [str(video) for video in stated if self.views and _VIEW.fullmatch(str(video))]
        videos = [video for video in stated if str(video) not in more]
        parts = [part for text in self.views or () for part in text.split()] + more
        for part in parts:
            if not _VIEW.fullmatch(part):
                raise ValueError(
                    f"--views is {part!r}; COLUMN,ROW,WIDTH,HEIGHT of each view are needed, "
                    "optionally followed by :mirrored or :flipped"
                )
        return [Path(f"{v}#{part}") for v in videos for part in parts] if parts else videos

    def seen_by(self, videos: Sequence[Path]) -> tuple[vb.cameras.Camera, ...]:
        """Cameras of the views, calibrated or orthogonal."""
        if self.cameras is not None:
            return _calibrated(self.cameras, videos)
        if len(videos) % 2 and len(videos) > 1:
            raise ValueError(f"{len(videos)} videos: give one or two per trial, or their --cameras")
        sizes = [(info.width, info.height) for info in map(vb.io.video_info, videos)]
        if len(set(sizes)) > 1:
            raise ValueError(f"the videos differ in size, {sorted(set(sizes))}: give --cameras")
        pixel_size = vb.cameras.PIXEL_SIZE if self.pixel_size is None else 1e-3 * self.pixel_size
        wide = pixel_size * sizes[0][0]
        if not _NARROWEST <= wide <= _WIDEST:
            raise ValueError(
                f"--pixel-size is {1e3 * pixel_size:g} mm, which makes the views {wide:g} m wide; "
                "it must be in mm, such as 0.058"
            )
        return vb.cameras.orthogonal_views(pixel_size, sizes[0])[: len(videos)]


@dataclass(frozen=True)
class TraceStatements:
    """Options for the appearance of whiskers in the images, and the positions of their bases."""

    base: list[str] | None = None
    base_width: float = _FINEST
    jump: float = 5.0
    bright: bool | None = None
    clicks: Path | None = None
    pick: bool = False
    mask: list[str] | None = None
    region: list[str] | None = None

    def __post_init__(self) -> None:
        for name, pixels in (("base-width", self.base_width), ("jump", self.jump)):
            if not 0.0 < pixels < math.inf:
                raise ValueError(f"--{name} is {pixels:g}; it must be positive, in pixels")

    def trace_options(self) -> vb.tracking.TraceOptions:
        """Options of tracing."""
        scale = max(self.base_width / _FINEST, 1.0)
        return vb.tracking.TraceOptions(scale=scale, jump=self.jump, bright=self.bright)

    def stored(self, videos: Sequence[Path], target: Path, count: int) -> vb.io.Clicks | None:
        """Read and report earlier clicks in these videos of one or more trials."""
        names = tuple(video.name for video in videos)
        file = self.clicks or clicks_of(target)
        if self.clicks is None and (len(videos) > count or not file.exists()):
            return None
        if self.pick and not file.exists():
            return None
        found = vb.io.load_clicks(file)
        if len(found.views) != count:
            raise ValueError(f"{file} has {len(found.views)} views; there are {count}")
        if self.clicks is None and found.videos != names:
            say(f"{file} is not used: it belongs to {', '.join(found.videos)}")
            return None
        bases = len(found.views[0].base)
        areas = sum(len(view.mask) + len(view.region) for view in found.views)
        scale = "" if found.pixel_size is None else f", a pixel of {1e3 * found.pixel_size:.4g} mm"
        say(f"{file} is used: bases of {bases} whiskers, {areas} masks and regions{scale}")
        return found

    def bases(
        self, cameras: Sequence[vb.cameras.Camera], clicks: vb.io.Clicks | None
    ) -> list[list[list[float]] | None]:
        """Bases in each view; None if they have to be found."""
        views, stated = len(cameras), self.base or []
        whole = views > 1 and any(text.count(",") > 1 for text in stated)
        names = [f"{axis} of view {v}" for v in range(views) for axis in "xy"]
        rows = [numbers(text, names if whole else ["x", "y"], "--base") for text in stated]
        if whole:
            points = [row[2 * v : 2 * v + 2] for v in range(views) for row in rows]
        else:
            points = rows
        if len(points) % views:
            raise ValueError(
                f"there are {len(points)} --base for {views} views; all views need as many"
            )
        each = len(points) // views
        if not whole and min(views, each) > 1:
            remark(
                f"--base: the first {each} are taken for those of the first view. A whisker in all "
                f"views is --base {','.join(['x,y'] * views)}"
            )
        found = [points[v * each : (v + 1) * each] for v in range(views)]
        if not points and clicks is not None:
            found = [[list(point) for point in view.base] for view in clicks.views]
        counts = [len(view) for view in found]
        if len(set(counts)) > 1:
            raise ValueError(f"the views have {counts} bases; all views need as many")
        if not any(found):
            return [None] * views
        for i, camera in enumerate(cameras):
            width, height = camera.size
            for x, y in found[i]:
                if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
                    raise ValueError(
                        f"--base {x:g},{y:g} is outside of view {i}, {width} × {height} pixels"
                    )
        return list(found)

    def masks(
        self, cameras: Sequence[vb.cameras.Camera], clicks: vb.io.Clicks | None
    ) -> list[vb.numerics.Mask | None]:
        """Masks of the pixels of each view that are excluded from tracking; None for no mask."""
        views = list(clicks.views if clicks else [vb.io.ViewClicks()] * len(cameras))
        images: list[list[vb.numerics.Mask]] = [[] for _ in views]
        for name, stated in (("mask", self.mask), ("region", self.region)):
            for text in stated or ():
                number, _, area = text.partition(":")
                if not number.isdigit() or int(number) >= len(views) or not area:
                    raise ValueError(
                        f"--{name} is {text!r}; VIEW:X,Y X,Y X,Y… or VIEW:IMAGE is needed, with "
                        f"a view from 0 to {len(views) - 1}"
                    )
                view = int(number)
                if Path(area).suffix and Path(area).exists():
                    shown = next(iter(vb.io.read_video(Path(area)))) > _HALF
                    images[view].append(shown if name == "mask" else ~shown)
                    continue
                corners = [numbers(one, ("x", "y"), f"--{name}") for one in area.split()]
                polygon = vb.io.polygon_of(corners, f"--{name} {text}")
                known = (*getattr(views[view], name), polygon)
                views[view] = replace(views[view], **{name: known})
        return [
            vb.io.together([view.masked(camera.size), *image])
            for view, camera, image in zip(views, cameras, images, strict=True)
        ]


def clicks_of(recording: Path) -> Path:
    """File in which the clicks for a recording are stored."""
    return recording.with_name(f"{recording.stem}.clicks.toml")


def _picked(
    videos: Sequence[Path], names: Sequence[str], file: Path, clicks: vb.io.Clicks | None
) -> vb.io.Clicks:
    """Open a window with the first frames, and save the clicks."""
    images = [next(iter(vb.io.read_video(video))) for video in videos]
    known = tuple(video.name for video in videos)

    def save(shown: vb.io.Clicks) -> None:
        vb.io.save_clicks(file, replace(shown, videos=known))
        say(f"wrote {file}; it is used again by vibrissa track, or with --clicks {file}")

    return vb.plots.pick(images, names, clicks, save)


@dataclass(frozen=True)
class KnownOptions:
    """Options for data in addition to the videos."""

    corrections: Path | None = None
    head: Path | None = None
    contact: Path | None = None
    objects: Path | None = None
    find_peg: bool = True

    def alone(self) -> dict[str, Path | None]:
        """Options that apply to a single trial only."""
        return {"--corrections": self.corrections, "--head": self.head, "--contact": self.contact}

    def corrected(self, views: int) -> Any:
        """Read corrected traces by view."""
        fixed = {} if self.corrections is None else vb.io.load_corrections(self.corrections)
        if unknown := sorted(view for view in fixed if view >= views):
            raise ValueError(
                f"{self.corrections} corrects view {unknown[0]}; views are counted from 0"
            )
        for view, each in fixed.items():
            for (frame, whisker), points in each.items():
                about = f"{self.corrections}, view {view}, frame {frame}, whisker {whisker}"
                with vb.io.in_file(about):
                    vb.tracking.given(points)
        return fixed

    def read(self, video: Path, rate: float) -> dict[str, Any]:
        """Read head, contact points and objects; return keyword arguments of tracking."""
        if self.contact is not None and self.objects is not None:
            raise ValueError("--contact and --objects both state where the contact is; give one")
        known: dict[str, Any] = {}
        if self.head is not None:
            # Read the pose of the head, and check in advance that it is known in all frames.
            if self.head.suffix.lower() in vb.io.NETCDF:
                head = vb.load_recording(self.head).to_dataset()
                if "head_rotation" not in head:
                    raise ValueError(f"{self.head} is a recording without the pose of a head")
            else:
                head = vb.io.load_head(self.head)
            if frames := vb.io.video_info(video).frames:
                vb.tracking.HeadPose.of(head, np.arange(frames), rate)
            known["head"] = head
        if self.contact is not None:
            known["contacts"] = vb.io.load_contact_points(self.contact)
        if self.objects is not None:
            known["objects"] = inputs.objects_from(self.objects)
        return known


@with_options("the recording, .nc; of several trials a folder for them")
def track(
    videos: list[Path],
    target: Path,
    filmed: FilmOptions,
    traced: TraceStatements,
    known: KnownOptions,
    own: inputs.TrackedOptions,
    base_radius: float | None = None,
    tip_radius: float | None = None,
    length: float | None = None,
    fur: float = 0.0,
    cutoff: float | None = None,
    force: bool = False,
) -> None:
    """Track a whisker in videos: its shape, pose and contact, and force and moment at its base.

    Two views determine it in space. With one view it is assumed to move and bend in the image
    plane; what this neglects is printed. A mirror gives two views in one video, which --views
    separates.

    The whisker at rest is that of --whisker, or is determined from frames without contact; the
    default radius of its base is 0.1 mm. With --objects or --contact the contact is compared with
    independent data. The result is a recording. After Ctrl-C the same command continues.
    Example: `vibrissa track top.mp4 front.mp4 --pixel-size 0.058 --rate 1000 -o trial.nc`
    """
    videos = filmed.split(videos)
    for video in videos:
        inputs.refuse_tracks(video)
    views = filmed.seen_by(videos)
    trials = _trials(videos, len(views), target, {**known.alone(), "--pick": traced.pick})
    free(trials, force)
    clicks = traced.stored(videos, target, len(views))
    if traced.pick:
        file = traced.clicks or clicks_of(target)
        clicks = _picked(videos, [view.name for view in views], file, clicks)
    if clicks and clicks.pixel_size and filmed.cameras is None and filmed.pixel_size is None:
        views = replace(filmed, pixel_size=1e3 * clicks.pixel_size).seen_by(videos)
    rate = filmed.frames_per_second
    lasts = (vb.io.video_info(videos[0]).frames or math.inf) / rate
    how = vb.tracking.TrackOptions(
        cutoff=inputs.filtered_at(cutoff, rate, lasts),
        offset=None if filmed.offset == "auto" else int(filmed.offset),
        rough=filmed.cameras is None and filmed.distance != math.inf,
        distance=filmed.distance,
        length=own.tracked_length(length),
        fur=own.hidden(fur),
        **own.tracked(base_radius, tip_radius),
    )
    job = _Job(
        cameras=views,
        rate=rate,
        bases=traced.bases(views, clicks),
        masks=traced.masks(views, clicks),
        corrections=known.corrected(len(views)),
        options=traced.trace_options(),
        how=how,
        known=known.read(videos[0], rate),
        find_peg=known.find_peg,
    )
    _report_assumed(filmed, clicks)
    _report_swapped(videos, filmed)
    for file, trial in trials.items():
        others = [
            *trials,
            *(path for kind in vb.io.NETCDF for path in file.parent.glob(f"*{kind}")),
        ]
        alone = all(path == file for path in others)
        job.track(trial, file, alone)


@dataclass(frozen=True)
class _Job:
    """Settings and steps of tracking, shared by trials with the same cameras."""

    cameras: tuple[vb.cameras.Camera, ...]
    rate: float
    bases: Sequence[Any]
    masks: Sequence[vb.numerics.Mask | None]
    corrections: Any
    options: vb.tracking.TraceOptions
    how: vb.tracking.TrackOptions
    known: Mapping[str, Any]
    find_peg: bool

    def track(self, videos: Sequence[Path], recording: Path, alone: bool) -> None:
        """Track one trial and report the results; images of a single trial have short names."""
        start, doubt = (
            recording.with_name(f"{'' if alone else f'{recording.stem}.'}{kind}.png")
            for kind in ("start", "doubt")
        )
        numbers, frames = vb.tracking.start_frames(videos, self.how.offset or 0)
        combed = [v.name for v, some in zip(videos, frames, strict=True) if vb.io.interlaced(some)]
        if combed:
            say(_INTERLACED.format(" and ".join(combed)))
        begins = 0
        if self.bases[0] is None:
            bases, begins, options = self._found(videos, numbers, frames, start)
        else:
            firsts = [next(vb.io.video_frames(video, [0])) for video in videos]
            bright = vb.tracking.is_bright(firsts, self.bases, self.options)
            bases, options = self.bases, replace(self.options, bright=bright)
        kept = [vb.tracking.partial_traces(recording, view) for view in range(len(videos))]
        with progress_bars() as tell:
            traces = [
                vb.tracking.trace_file(
                    path,
                    kept[view],
                    bases[view],
                    options,
                    corrections=self.corrections.get(view, {}),
                    sample=frames[view],
                    mask=self.masks[view],
                    begins=begins + (self.how.offset or 0) * (view > 0),
                    progress=partial(tell, f"trace {path.name}"),
                )
                for view, path in enumerate(videos)
            ]
            traces, anew = vb.tracking.retraced(
                self.cameras,
                [partial(vb.io.read_video, path) for path in videos],
                bases,
                traces,
                options,
                offset=self.how.offset,
                corrections=self.corrections,
                samples=frames,
                masks=self.masks,
                progress=lambda view, done: tell(
                    f"trace {videos[view].name} anew", done, len(traces[view][0])
                ),
            )
            if (lost := _where_lost(traces)) is not None:
                self._show_doubt(videos, traces, [lost] * len(videos), _LOST, doubt)
            result = vb.tracking.track(
                self.cameras,
                traces,
                self.rate,
                self.how,
                sample=frames if self.find_peg else (),
                progress=tell,
                **self.known,
            )
        if anew:
            remarks = [*anew, result.attrs.get("remarks", "")]
            result.attrs["remarks"] = "\n".join(remarks).strip()
        unexplained = None if lost is not None else _where_unexplained(result)
        if unexplained is not None:
            self._show_doubt(videos, traces, unexplained, _UNEXPLAINED, doubt)
        _compare_lengths(videos, traces, result.sizes["time"])
        vb.io.save_recording(recording, result)
        for file in kept:
            file.unlink(missing_ok=True)
        print_tracked(result, recording)

    def _found(
        self,
        videos: Sequence[Path],
        numbers: Sequence[int],
        frames: Sequence[Sequence[vb.io.Frame]],
        picture: Path,
    ) -> tuple[Sequence[Any], int, vb.tracking.TraceOptions]:
        """Find the start of the whiskers and the first frame that shows them; save an image."""
        start = vb.tracking.find_start(self.cameras, frames, self.options, self.masks)
        names = [camera.name for camera in self.cameras]
        images = [view[start.frame] for view in frames]
        remarks = [
            f"frame {numbers[start.frame]} of {videos[0].name}: {why}" for why in start.doubts
        ]
        shown = [(start.lines, start.confidence), *((o.lines, o.confidence) for o in start.others)]
        figure = vb.plots.start_views(images, shown, names, remarks)
        vb.plots.save(figure, picture.with_suffix(""), ("png",))
        if start.bases is None:
            raise ValueError(
                f"the base of the whisker was not found: {start.doubts[0]}. See {picture}, and "
                "state where the whisker leaves the face, once for each view: "
                + " ".join("--base X,Y" for _ in videos)
                + " (or click it: --pick)"
            )
        _report_start(start, names, picture)
        options = replace(self.options, bright=start.bright)
        return [[base.tolist()] for base in start.bases], numbers[start.begins], options

    def _show_doubt(
        self, videos: Sequence[Path], traces: _Traces, at: Sequence[int], why: str, picture: Path
    ) -> None:
        """Save an image of one frame of each view with its traces, and report the reason."""
        images = [next(vb.io.video_frames(v, [i])) for v, i in zip(videos, at, strict=True)]
        names = [f"{camera.name}, frame {i}" for camera, i in zip(self.cameras, at, strict=True)]
        whiskers = [
            [row[i] for row, i in zip(whisker, at, strict=True)]
            for whisker in zip(*traces, strict=True)
        ]
        shown = [([t.line for t in one], max(t.confidence for t in one)) for one in whiskers]
        figure = vb.plots.start_views(images, shown, names, [f"not sure: {why}"])
        vb.plots.save(figure, picture.with_suffix(""), ("png",))
        say(f"not sure that what is followed is the whisker in every frame: see {picture}")


def _where_lost(traces: _Traces) -> int | None:
    """Frame in which whiskers seem to be lost; None if there is none."""
    count = min(len(view[0]) for view in traces)
    rows = [row[:count] for view in traces for row in view]
    wrong = np.any([vb.tracking.doubtful_frames(row) for row in rows], axis=0)
    return int(np.flatnonzero(wrong)[wrong.sum() // 2]) if wrong.any() else None


def _where_unexplained(result: xr.DataTree) -> list[int] | None:
    """Frame of each view with the largest misfit; None if the rods explain enough frames."""
    data = result.to_dataset()
    misfit = np.nan_to_num(data["trace_misfit"].values)
    if not any(vb.tracking.unexplained_frames(one).any() for one in misfit.T):
        return None
    numbers: list[int] = data["frame"].values[int(misfit.max(axis=1).argmax())].tolist()
    return numbers


def _calibrated(path: Path, videos: Sequence[Path]) -> tuple[vb.cameras.Camera, ...]:
    """Read calibrated cameras, and check them against the sizes of the videos."""
    cameras = inputs.cameras_from(path)
    if len(videos) % len(cameras):
        raise ValueError(f"{path} contains {len(cameras)} cameras; there are {len(videos)} videos")
    for i, video in enumerate(videos):
        camera, info = cameras[i % len(cameras)], vb.io.video_info(video)
        if (info.width, info.height) != tuple(camera.size):
            raise ValueError(
                f"{video} is {info.width} × {info.height} pixels; {path} calibrates camera "
                f"{camera.name!r} for {camera.size[0]} × {camera.size[1]}: calibrate with images "
                "of the video's size, or give the videos in the cameras' order"
            )
    return cameras


def _trials(
    videos: Sequence[Path], count: int, recording: Path, alone: Mapping[str, object]
) -> dict[Path, Sequence[Path]]:
    """Videos of each trial, by the path of its recording."""
    trials = [videos[i : i + count] for i in range(0, len(videos), count)]
    files = [recording]
    if len(trials) > 1:
        refuse(alone, "it applies to one trial: track this trial alone")
        if recording.suffix and not recording.is_dir():
            raise ValueError(
                f"--output is {recording}; {len(videos)} videos, {count} per trial, are "
                f"{len(trials)} trials, for which a folder is needed"
            )
        files = [recording / f"{trial[0].stem}.nc" for trial in trials]
        if len(set(files)) < len(files):
            raise ValueError("two trials would have the same file: their first videos share a name")
        recording.mkdir(parents=True, exist_ok=True)
    for file, trial in zip(files, trials, strict=True):
        vb.io.check_writable(file, vb.io.NETCDF)
        # One video cannot show a whisker from two sides.
        if len({path.resolve() for path in trial}) < len(trial):
            names = ", ".join(map(str, trial))
            raise ValueError(f"{names}: a video is given twice; each view needs its own")
    return dict(zip(files, trials, strict=True))


def _compare_lengths(videos: Sequence[Path], traces: Sequence[Sequence[Any]], used: int) -> None:
    """Report videos that differ in length."""
    frames = [len(view[0]) for view in traces]
    if len(set(frames)) > 1:
        listed = ", ".join(f"{path} {n}" for path, n in zip(videos, frames, strict=True))
        say(
            f"the videos differ in frames ({listed}); {used} of each are used: if the cameras did "
            "not start together or dropped frames, track with --offset auto"
        )


def _report_assumed(filmed: FilmOptions, clicks: vb.io.Clicks | None) -> None:
    """Report assumptions about the cameras that are not stated."""
    if filmed.pixel_size is None and filmed.cameras is None and not (clicks and clicks.pixel_size):
        say(
            f"note: pixel size assumed, not stated: {1e3 * vb.cameras.PIXEL_SIZE:g} mm; all "
            "lengths are proportional to it (--pixel-size, or the scale of --pick)"
        )
    if filmed.rate is None:
        say(f"note: rate assumed, not stated: {_RATE:g} frames/s (--rate)")


def _report_swapped(videos: Sequence[Path], filmed: FilmOptions) -> None:
    """Warn of videos whose names suggest that the views are swapped."""
    if filmed.cameras is not None or len(videos) < 2:
        return
    names = [view.name for view in filmed.seen_by(videos)]
    stems = [re.split(r"[\W_]+", path.stem.lower()) for path in videos[:2]]
    if names[1] in stems[0] and names[0] in stems[1]:
        say(
            f"note: {videos[0].name} is used as the {names[0]} view and {videos[1].name} as the "
            f"{names[1]} view. If it is the opposite, results are those of a mirror image, "
            "which fits the videos equally well: only their order decides"
        )


def _report_start(start: vb.tracking.Start, names: Sequence[str], picture: Path) -> None:
    """Report the start of the whiskers and its image."""
    bases = start.bases or []
    points = " and ".join(
        f"{column:.0f},{row:.0f} ({name})" for name, (column, row) in zip(names, bases, strict=True)
    )
    say(
        f"the whisker is taken to begin at {points}, as in {start.agreed[0]} of {start.agreed[1]} "
        f"frames, with confidence {start.confidence:.2f}: see {picture}"
    )
    if start.doubts:
        say(
            f"not sure: {'; '.join(start.doubts)}. If it is not the whisker, click where that "
            f"leaves the face (--pick), or state it: {' '.join('--base X,Y' for _ in names)}"
        )
    for number, other in enumerate(start.others, 2):
        stated = " ".join(f"--base {x:.0f},{y:.0f}" for x, y in other.bases)
        say(f"number {number} in the picture, confidence {other.confidence:.2f}: {stated}")


def print_tracked(result: xr.DataTree, path: Path) -> None:
    """Report the results for each whisker."""
    data = result.to_dataset()
    for k, name in enumerate(data["whisker"].values):
        one = data.isel(whisker=k)
        misfit = float(one["trace_misfit"].median())
        length = vb.recording.Recording(result).whisker(k).length
        say(
            f"{name}: {shown('length', length)} long, in contact in "
            f"{int(np.nansum(one['in_contact'].values))} of {one.sizes['time']} frames, lost in "
            f"{int((one['confidence'] == 0.0).sum())}; the rod fits the traces to {misfit:.2f} "
            "standard deviations"
        )
        if misfit > _POOR:
            say(
                "  The bent rod does not explain the traces: perhaps too few frames are free of "
                "contact, or the traces are wrong; see trace_misfit and deviation."
            )
        for line in compared_contacts(result, k):
            say(f"  {line}")
    inputs.print_notes(
        *(vb.recording.Recording(result).whisker(k) for k in range(data.sizes["whisker"]))
    )
    for line in result.attrs.get("remarks", "").splitlines():
        say(f"note: {line}")
    say(f"wrote {path}")


def compared_contacts(recording: xr.DataTree, whisker: int) -> Iterator[str]:
    """Compare contact points from other sources with those of the fitted rod."""
    measured = recording.children.get("measured")
    if measured is None or "contact_difference" not in measured:
        return
    one = measured.to_dataset().isel(whisker=whisker)
    away = one["contact_difference"].values
    of_rod = recording.to_dataset()["arc_length"].isel(whisker=whisker)
    along = one["arc_length"].values - of_rod.values
    both = np.isfinite(away) & np.isfinite(along)
    found = int(np.isfinite(one["contact_point"].values).all(axis=-1).sum())
    source = one["contact_point"].attrs["source"]
    if not both.any():
        yield f"contact point ({source}): in {found} frames, in none of them has the rod one"
        return
    half, most = np.percentile(away[both], [50.0, 95.0])
    yield (
        f"contact point ({source}): in {found} frames; in {int(both.sum())} the rod has one too, "
        f"{shown('contact_difference', half, 3)} away (median; 95 % within "
        f"{shown('contact_difference', most, 3)}), "
        f"{shown('contact_difference', float(np.median(along[both])), 3)} farther out along the "
        "whisker"
    )
