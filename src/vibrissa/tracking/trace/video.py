"""Traces of one video: whiskers followed from frame to frame, with interruption and resumption.

Neighbours of the requested whiskers are followed too, so that none takes their lines. In some
frames, lines that move and leave the face are found, and the motion of the face between these
frames from their beginnings. Lines that begin at one position on the face belong to one hair or
whisker; a whisker is sometimes as long as others. A hair may be joined to the end of a whisker that
it crosses: in some of the frames all are begun together, which assigns that end to the whisker.
"""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.io import (
    Frame,
    load_traces,
    read_video,
    save_traces,
    video_frames,
    video_info,
    without_part,
)
from vibrissa.numerics import Array, Mask, without_blas_threads
from vibrissa.tracking.trace.curves import Curve, find_curves, find_whiskers
from vibrissa.tracking.trace.follower import Follower, features_of, start_at
from vibrissa.tracking.trace.identity import Seen, decided, settle_crossings
from vibrissa.tracking.trace.row import CLICK, follow_row, from_click, moving
from vibrissa.tracking.trace.scene import Scene
from vibrissa.tracking.trace.start import FRAMES, is_bright, negative
from vibrissa.tracking.trace.steady import Steady
from vibrissa.tracking.trace.trace import Trace, TraceOptions, between_whiskers, given, overlap

_MOVED = 0.4  # share of a line that moves, from which it may be a whisker
# Smallest length of a neighbour, pixels and as a share of those that are asked for, and smallest
# share of the frames in which a line begins there.
_HAIR, _COMPARABLE, _OFTEN = 80.0, 0.3, 0.3
# Largest distances of two beginnings of one whisker, and by which the face moves, pixels.
_STRAYS, _FARTHEST = 4.0, 25.0
# Distance from a base up to which a line begins at it, across: it may do so farther along itself.
_OTHER = 6.0
_TOGETHER = 0.5  # share of those that are asked for with which a neighbour is seen together
_BEGUN = 3  # number of frames in which a neighbour is looked for; most of them must show it


def neighbours(
    frames: Sequence[Frame], clicks: Array, scene: Scene, options: TraceOptions
) -> list[Array]:
    """Bases (2,), in the first of some frames, of whiskers other than those clicked (n, 2)."""
    if scene.background is None:
        return []
    moves = [
        [c for c in find_curves(frame, scene, options) if c.from_face and c.moved > _MOVED]
        for frame in frames
    ]
    shifts, places = _on_face(moves)
    whose = [
        [_nearest(curve.line[0] - shift, places) for curve in curves]
        for shift, curves in zip(shifts, moves, strict=True)
    ]
    length = np.zeros((len(frames), len(places)))
    away = np.full((len(frames), len(clicks), len(places)), np.inf)
    for i, curves in enumerate(moves):
        for place, curve in zip(whose[i], curves, strict=True):
            length[i, place] = max(length[i, place], curve.length)
            far = [from_click(click, curve.line - shifts[i]) for click in clicks]
            away[i, :, place] = np.minimum(away[i, :, place], far)
    nearest = away.min(axis=0)
    asked = [int(np.argmin(row)) for row in nearest if row.min(initial=np.inf) < 2.0 * CLICK]
    if len(set(asked)) < len(clicks):
        return []
    often = (length > 0.0).mean(axis=0) >= _OFTEN
    longest = length.max(axis=0)
    # In a single frame the face may have moved otherwise than was found.
    apart = np.ma.masked_invalid(away.min(axis=1))
    usual = np.ma.median(apart, axis=0).filled(0.0)  # type: ignore[no-untyped-call]
    often &= (longest > _HAIR) & (usual > _OTHER)
    others = [k for k in np.flatnonzero(often) if k not in asked]
    if not others:
        return []
    # What is joined to a whisker's end, or is that whisker elsewhere, is not seen together with it.
    least = np.full(len(asked) + len(others), max(_HAIR, _COMPARABLE * longest[asked].max()))
    least[: len(asked)] = np.minimum(_HAIR, 0.5 * longest[asked])
    found = list[Array]()
    for k in others:
        # Where it is farthest from the others these are least likely to be taken for it.
        some = np.argsort(-apart[:, k].filled(-np.inf))
        next_to, shown = int(nearest[:, k].argmin()), 0
        for i in some[:_BEGUN]:
            every = [start_at(at + shifts[i], options) for at in (*clicks, *found, places[k])]
            seen = [trace.support for trace in follow_row(every, frames[i], {}, scene=scene)]
            long = np.array(seen) > least[: len(seen)]
            together = long[: len(asked)].mean() >= _TOGETHER
            shown += bool(long[-1] and long[next_to] and together)
        if 2 * shown > _BEGUN:
            found.append(places[k])
    return found


def _on_face(moves: Sequence[Sequence[Curve]]) -> tuple[list[Array], Array]:
    """Shift of the face in each frame, and where lines begin on it in the first."""
    shifts, places = [np.zeros(2)], np.array([c.line[0] for c in moves[0]]).reshape(-1, 2)
    for curves in moves[1:]:
        at = np.array([curve.line[0] for curve in curves]).reshape(-1, 2)
        between = (at[None] - places[:, None]).reshape(-1, 2)
        tried = np.concatenate([shifts[-1][None], between])
        tried = tried[np.hypot(*tried.T) < _FARTHEST]
        distance = np.linalg.norm(
            at[None, :, None] - tried[:, None, None] - places[None, None], axis=3
        ).min(axis=2, initial=_STRAYS)
        shifts.append(tried[np.argmin((distance**2).sum(axis=1))])
        for begin in at - shifts[-1]:
            if not len(places) or np.hypot(*(places - begin).T).min() > _STRAYS:
                places = np.concatenate([places, begin[None]])
    return shifts, places


def _nearest(at: Array, places: Array) -> int:
    return int(np.argmin(np.hypot(*(places - at).T)))


# Points (n, 2) along a whisker from base to tip, column and row, by frame and whisker.
Corrections = Mapping[tuple[int, int], ArrayLike]
_BACK = 64  # largest number of frames before its own that a correction can change
_AGREES = 0.9  # share of a line along another one above which both are the same
# Factor of the jump of a single whisker before grey fur, where its base is less certain.
_FAINT = 2.4
_LOOKED = 9  # number of frames in which neighbours, and whether whiskers move, are searched
_SPAN = 400  # number of frames at the beginning of a film from which those for its start are taken


Shift = tuple[float, float, float, float]
"""Shift of an image by a camera that shakes, as in `Trace`."""

_STEADY: Shift = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What is around whiskers in a video, and frames without it.

    Parameters
    ----------
    bright : bool
        Whether whiskers are bright on dark.
    scene : Scene
        Parts of the image that never move.
    steady : Steady, optional
        Shaking of the camera, if that is known.
    sample : list of array (height, width)
        Frames spread over the video, with dark whiskers, as by a camera that does not shake.
    """

    bright: bool
    scene: Scene
    steady: Steady | None
    sample: list[Frame]

    @classmethod
    def of(
        cls,
        frames: Sequence[Frame],
        starts: Array,
        options: TraceOptions,
        mask: Mask | None,
        bright: bool,
    ) -> Surroundings:
        """Surroundings of whiskers that begin somewhere, (n, 2), by frames spread over a video."""
        sample = [negative(f) if bright else f for f in frames]
        scene = _scene(sample, starts, options, mask)
        steady = Steady.of(scene, sample)
        if steady is not None and steady.at.size:
            sample = [steady.moved_back(f)[0] for f in sample]
            scene = _scene(sample, starts, options, mask)
        return cls(bright, scene, steady, sample)

    def clear(self, frame: Frame) -> tuple[Frame, Shift]:
        """Dark whiskers of a frame without what never moves, and its shift; none without light."""
        frame = negative(frame) if self.bright else frame
        shift = _STEADY
        if not self.scene.lit(frame):
            return np.full_like(frame, np.iinfo(frame.dtype).max), shift
        if self.steady is not None:
            frame, shift = self.steady.moved_back(frame)
        return self.scene.without_still(frame), shift

    def finish(
        self,
        traces: list[list[Trace]],
        corrections: Container[tuple[int, int]],
        shifts: Sequence[Shift],
    ) -> None:
        """Cut traces along static edges, if no person gave them; add the camera's shifts."""
        for k, row in enumerate(traces):
            row[:] = [
                t if (i, k) in corrections else self.scene.before_edge(t) for i, t in enumerate(row)
            ]
            if self.steady is not None:
                row[:] = [t._replace(shift=s) for t, s in zip(row, shifts, strict=True)]


def _scene(
    frames: Sequence[Frame], starts: Array, options: TraceOptions, mask: Mask | None
) -> Scene:
    """Scene of whiskers that begin somewhere, (n, 2); those that move are none of its lines."""
    scene = Scene.of(frames, options.scale, mask).with_still(starts, frames)
    if scene.still is None or not scene.still.resting.any():
        return scene
    moves = moving(frames[:: max(len(frames) // _LOOKED, 1)], scene, starts, options)
    return scene.with_still(starts, frames, moves) if moves.any() else scene


@without_blas_threads
def trace_video(
    frames: Iterable[Frame],
    bases: Sequence[ArrayLike] | None = None,
    options: TraceOptions | None = None,
    *,
    corrections: Corrections | None = None,
    begun: Sequence[Sequence[Trace]] = (),
    kept: list[list[Trace]] | None = None,
    sample: Sequence[Frame] | None = None,
    mask: Mask | None = None,
    begins: int = 0,
    progress: Callable[[int], None] | None = None,
) -> list[list[Trace]]:
    """Trace whiskers from frame to frame.

    Parameters
    ----------
    frames : iterable of array (height, width)
        Grey values.
    bases : sequence of array_like (2,), optional
        Column and row where each whisker leaves the face in frame ``begins``, to about 10 pixels.
        By default one whisker, the one that is best seen.
    options : TraceOptions, optional
        Settings of tracing.
    corrections : mapping, optional
        Points (n, 2) along whiskers in some frames, by frame and whisker: taken as they are, and
        followed forward, and backward as far as that changes anything, at most 64 frames.
    begun : sequence of sequence of Trace
        Traces of the first frames, made before: taken as they are.
    kept : list, optional
        List that is filled with the result while it is made, for the case of an interruption.
    sample : sequence of array (height, width), optional
        Frames spread over the film, which show what never moves; by default 30 among the first 400
        of ``frames`` if they are a sequence, else the first 30.
    mask : array (height, width) of bool, optional
        Pixels in which no whisker is measured.
    begins : int
        Number of the first frame that shows them. From there they are followed backward, too.
    progress : callable, optional
        Function that is called after every frame with the number of frames done.

    Returns
    -------
    list of list of Trace
        Traces of each whisker, frame by frame; empty ones where it was not found.

    Raises
    ------
    ValueError
        If none is found in the first frame, frames differ in size, or a correction is for none.
    """
    options = options or TraceOptions()
    corrections = corrections or {}
    traces: list[list[Trace]] = [] if kept is None else kept
    begins = min([begins, *(frame for frame, _ in corrections)])
    begun = begun if begun and len(begun[0]) > begins else ()
    done = len(begun[0]) if begun else 0
    recent: deque[Frame] = deque(maxlen=max(_BACK, begins))
    seen, shifts = list[Seen](), list[Shift]()
    source = iter(frames)
    first = list(islice(source, FRAMES))
    if not first:
        return traces
    if sample is None:
        whole = frames if isinstance(frames, Sequence) else first
        sample = [whole[i] for i in _spread(len(whole))]
    bright, shape = is_bright(first[:1], [bases], options), first[0].shape
    start = negative(first[0]) if bright else first[0]
    followers = _begun(start, bases, begun, options)
    starts = np.array([f.base for f in followers] if bases is None else bases, dtype=np.float64)
    alike = [f for f in sample if f.shape == shape]
    around = Surroundings.of(alike, starts, options, mask, bright)
    scene = around.scene
    (still,) = between_whiskers([None], scene.bits, start.shape)
    for follower in followers:
        follower.clutter = still.still_only
        if len(followers) == 1 and scene.still is not None and scene.still.before_body:
            follower.options = replace(options, jump=_FAINT * options.jump)
    traces[:] = [list(row) for row in begun] or [[] for _ in followers]
    if wrong := sorted({k for _, k in corrections if not 0 <= k < len(followers)}):
        raise ValueError(
            f"corrections are for whiskers {wrong}; there are {len(followers)}, from 0"
        )
    if not done and (len(followers) > 1 or not corrections):
        # Neighbours are followed too, so that their lines are not taken, but not returned. A person
        # may correct which of the lines is the only whisker.
        some = around.sample[:: max(len(alike) // _LOOKED, 1)]
        clear = [scene.without_still(f) for f in (start, *some)]
        for base in neighbours(clear, starts, scene, options):
            followers.append(replace(start_at(base, options), clutter=still.still_only))
            starts = np.concatenate([starts, base[None]])
    for i, frame in enumerate(_of_one_size(chain(first, source))):
        frame, shift = around.clear(frame)
        shifts.append(shift)
        if i < max(done, begins):
            recent.append(frame)
            before = [row[i] for row in traces] if done else [Trace.lost()] * len(followers)
            if len(followers) > 1:
                seen.append(_seen_before(frame, before, followers))
            for row, trace in zip(() if done else traces, before, strict=False):
                row.append(trace)
            continue
        known = {k: np.asarray(at) - shift[:2] for (j, k), at in corrections.items() if j == i}
        found = follow_all(followers, frame, known, seen, scene)
        for trace, row in zip(found, traces, strict=False):
            row.append(trace)
        for k in range(len(traces)):
            if (k in known or i == begins) and len(traces[k][i].line):
                _backward(traces[k], recent, followers[k], k, corrections, seen)
        recent.append(frame)
        if progress is not None:
            progress(i + 1)
    if len(followers) > 1 and done < len(traces[0]):
        for row, new in zip(traces, _over_all_frames(seen, starts, options), strict=False):
            row[:] = new
    around.finish(traces, corrections, shifts)
    return traces


def _over_all_frames(
    seen: Sequence[Seen], bases: Array, options: TraceOptions
) -> list[list[Trace]]:
    """Traces of all whiskers, their lines and far ends decided over all frames."""
    ways = list(zip(seen, decided(seen, bases), strict=True))
    rows = [
        [one.lines[way[k]] if way[k] >= 0 else Trace.lost() for one, way in ways]
        for k in range(len(bases))
    ]
    return settle_crossings(rows, [one.fixed for one in seen], options)


def _of_one_size(frames: Iterable[Frame]) -> Iterator[Frame]:
    """The same frames, which must not differ in size."""
    shape: tuple[int, ...] = ()
    for i, frame in enumerate(frames):
        shape = shape or frame.shape
        if frame.shape != shape:
            raise ValueError(
                f"frame {i} has {frame.shape[1]} × {frame.shape[0]} pixels and those before it "
                f"{shape[1]} × {shape[0]}: a video is needed whose frames are of one size"
            )
        yield frame


def _begun(
    frame: Frame,
    bases: Sequence[ArrayLike] | None,
    begun: Sequence[Sequence[Trace]],
    options: TraceOptions,
) -> list[Follower]:
    """Followers of whiskers that begin in the first frame, or of whiskers traced before."""
    if begun:
        starts = bases if bases is not None else [None] * len(begun)
        return [_resumed(row, base, options) for row, base in zip(begun, starts, strict=True)]
    if bases is None:
        found = find_whiskers(frame, options)
        if not found:
            raise ValueError("no whisker was found in the first frame: give where one begins")
        bases = [found[0].trace.line[0]]
    return [start_at(base, options) for base in bases]


def _resumed(row: Sequence[Trace], base: ArrayLike | None, options: TraceOptions) -> Follower:
    """Follower after traces of an earlier run."""
    if base is None:
        base = next((trace.line[0] for trace in row if len(trace.line)), None)
    if base is None:
        raise ValueError("the frames that were traced before show no whisker")
    follower = start_at(base, options)
    for trace in row:
        if len(trace.line):
            follower.accept(trace)
        else:
            follower.lose()
    return follower


def _seen_before(frame: Frame, found: Sequence[Trace], followers: Sequence[Follower]) -> Seen:
    """Result for a frame that is not traced again."""
    lines = [trace for trace in found if len(trace.line)]
    features = [features_of(frame, trace, followers[0].clutter) for trace in lines]
    chosen, rest = [], iter(range(len(lines)))
    for follower, trace in zip(followers, found, strict=True):
        chosen.append(next(rest) if len(trace.line) else -1)
        if chosen[-1] >= 0:
            follower.remember(features[chosen[-1]])
    return Seen(lines, features, chosen, clear=min(chosen) >= 0)


def follow_all(
    followers: Sequence[Follower],
    frame: Frame,
    known: Mapping[int, ArrayLike],
    seen: list[Seen],
    scene: Scene | None = None,
) -> list[Trace]:
    """Find every whisker in the next frame."""
    if len(followers) > 1:
        return follow_row(followers, frame, known, seen, scene)
    (follower,) = followers
    if not known:
        if follower.last is None:
            (trace,) = follow_row(followers, frame, known, scene=scene)
            if len(trace.line):
                return [trace]
        return [follower.follow(frame)]
    trace = given(known[0])
    follower.restart(trace)
    return [trace]


def _backward(
    row: list[Trace],
    recent: Sequence[Frame],
    ahead: Follower,
    whisker: int,
    corrections: Corrections,
    seen: Sequence[Seen],
) -> None:
    """Trace backward from a corrected frame, the last of the row, until nothing changes."""
    follower = Follower(row[-1].line[0], ahead.options, clutter=ahead.clutter.still_only)
    follower.restart(row[-1])
    for back, frame in enumerate(reversed(recent)):
        i = len(row) - 2 - back
        if (i, whisker) in corrections:
            return
        trace = follower.follow(frame)
        if overlap(trace.line, row[i].line, 1.0) > _AGREES:
            return
        # The longer seen line is right; a whisker lost before is found now.
        if trace.support > 0.9 * row[i].support:
            row[i] = trace
            if seen:
                seen[i].settle(whisker, trace)


def _spread(count: int) -> NDArray[np.intp]:
    """Indices of frames, out of so many, by which a film's start and static objects are found."""
    span = min(_SPAN, count)
    return np.unique(np.linspace(0, span - 1, min(FRAMES, span)).astype(int))


def partial_traces(recording: str | PathLike[str], view: int) -> Path:
    """File that stores the traces of a view until their recording is written."""
    recording = Path(recording)
    return recording.with_name(f".{recording.name}.view{view}.npz")


def start_frames(
    videos: Sequence[str | PathLike[str]], offset: int = 0
) -> tuple[list[int], list[list[Frame]]]:
    """Read frames of the beginning of a film, view by view, from which its whisker can be found.

    Their numbers in the first video are returned too; the others began ``offset`` frames earlier.
    """
    firsts = [max(-offset, 0), *(max(offset, 0) for _ in videos[1:])]
    pairs = list(zip(videos, firsts, strict=True))
    left = [(video_info(video).frames or _SPAN + first) - first for video, first in pairs]
    rows = _spread(max(1, min(left)))
    try:
        frames = [list(video_frames(video, first + rows)) for video, first in pairs]
    except ValueError:
        # The number of frames that a file states may be wrong.
        rows = np.arange(FRAMES)
        frames = [list(islice(read_video(v), first, first + FRAMES)) for v, first in pairs]
    count = min(len(view) for view in frames)
    if not count:
        raise ValueError(f"{', '.join(map(str, videos))}: there is no frame of all views")
    return (firsts[0] + rows[:count]).tolist(), [view[:count] for view in frames]


def trace_file(
    video: str | PathLike[str],
    partial: str | PathLike[str],
    bases: Any = None,
    options: TraceOptions | None = None,
    *,
    corrections: Corrections | None = None,
    sample: Sequence[Frame] | None = None,
    mask: Mask | None = None,
    begins: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> list[list[Trace]]:
    """Trace the whiskers of a video file, or resume an interrupted run; as `trace_video` otherwise.

    Traces are kept in the file ``partial``, also when the work is stopped by an exception such as
    ``KeyboardInterrupt``; the caller removes it at the end. Traces of another video, or of other
    settings, are not used.
    """
    video, partial = Path(video), Path(partial)
    about = without_part(video)[0].stat()
    fixed = sorted((key, np.asarray(at).tolist()) for key, at in (corrections or {}).items())
    key = (
        f"{video.resolve()} {about.st_size} {about.st_mtime_ns} {bases} {begins} {fixed} {options}"
    )
    key += "" if mask is None else f" {zlib.crc32(np.packbits(mask).tobytes())}"
    begun = [[Trace(*row) for row in whisker] for whisker in load_traces(partial, key) or []]
    kept: list[list[Trace]] = []
    total = max(video_info(video).frames, 1)

    def report(done: int) -> None:
        if progress is not None:
            progress(done, max(total, done))

    try:
        traces = trace_video(
            read_video(video),
            bases,
            options,
            corrections=corrections,
            begun=begun,
            kept=kept,
            sample=start_frames([video])[1][0] if sample is None else sample,
            mask=mask,
            begins=begins,
            progress=report,
        )
    finally:
        if kept and kept[0]:
            done = min(len(row) for row in kept)
            save_traces(partial, key, [[t[:8] for t in row[:done]] for row in kept])
    total = len(traces[0])
    report(total)
    return traces
