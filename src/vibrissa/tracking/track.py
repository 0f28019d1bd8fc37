"""From traces in two views to a recording: shape, pose, contact and wrench of every frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.cameras.camera import Camera
from vibrissa.objects import Surface
from vibrissa.tracking.contact import Contacts, contacts_at, given_contacts
from vibrissa.tracking.dataset import tracked_recording
from vibrissa.tracking.filtering import CUTOFF
from vibrissa.tracking.head import HeadPose
from vibrissa.tracking.length import (
    Length,
    lengthened,
    likeliest_length,
    with_length_unsure,
)
from vibrissa.tracking.pose import BasePose, base_pose
from vibrissa.tracking.refine import Refined, RefineOptions, cost_of, refine
from vibrissa.tracking.remarks import check_views, remarks_on, remarks_on_time
from vibrissa.tracking.rest import RestShape, known_rest, rest_shape, whisker_at_rest
from vibrissa.tracking.roll import rolled
from vibrissa.tracking.sight import Sight
from vibrissa.tracking.space import merge
from vibrissa.tracking.timing import paired_frames
from vibrissa.tracking.trace import Trace
from vibrissa.whisker import Whisker

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

Progress = Callable[[str, int, int], None]
"""Called with what is being done, and how much of how much is."""

_ANY_ROLL = np.radians(10.0)

_FEWEST, _FRAMES = 8, 24
"""Frames in contact from which a length is taken: at least, at most."""

_LONGER = 2.0
"""By how many standard deviations another length differs, to see what hangs on it."""


@dataclass(frozen=True)
class TrackOptions:
    """How traces become a recording.

    Parameters
    ----------
    cutoff : float, optional
        Of the zero-phase low pass on the base's pose, Hz; None filters nothing.
    offset : int, optional
        Frames by which the other cameras began before the first; None finds it, and dropped frames.
    free : float
        Share of the frames that are free of contact, at least.
    refine : RefineOptions
        Of the fit of the rod.
    properties : mapping
        Radius and material of the whisker; see `vibrissa.Whisker`.
    whisker : Whisker, optional
        The whisker at rest, where it is known: its base is where it leaves the face. By default it
        is taken from the frames that are free of contact.
    """

    cutoff: float | None = CUTOFF
    offset: int | None = 0
    free: float = 0.1
    refine: RefineOptions = field(default_factory=RefineOptions)
    properties: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    whisker: Whisker | None = None


@dataclass(frozen=True, eq=False)
class Tracked:
    """One whisker, tracked.

    Parameters
    ----------
    whisker : Whisker
        At rest.
    sight : Sight
        Its traces.
    curves : array (time, node, 3)
        Merged from the views, laboratory frame, m.
    covariance : array (time, node, 3, 3)
        Of the curves, m².
    shape : RestShape
        What it was taken from.
    pose : BasePose
        How it is held relative to the head, filtered, the paper's way.
    unfiltered : BasePose
        The same before filtering.
    touching : array (time,)
        Frames in contact.
    refined : Refined
        The rod that fits the traces.
    head : HeadPose
        The head in these frames.
    length : Length
        Of the whisker; its standard deviation is 0 where its tip is seen or it is given.
    contacts : Contacts, optional
        Contact points that do not come from the rod.
    """

    whisker: Whisker
    sight: Sight
    curves: Array
    covariance: Array
    shape: RestShape
    pose: BasePose
    unfiltered: BasePose
    touching: Mask
    refined: Refined
    head: HeadPose
    length: Length
    contacts: Contacts | None = None


def track(
    cameras: Sequence[Camera],
    traces: Sequence[Sequence[Sequence[Trace]]],
    rate: float,
    options: TrackOptions | None = None,
    *,
    names: Sequence[str] | None = None,
    head: xr.Dataset | None = None,
    contacts: xr.Dataset | None = None,
    objects: Sequence[Surface] = (),
    progress: Progress | None = None,
) -> xr.DataTree:
    """Make a recording of the traces of one or more whiskers.

    Parameters
    ----------
    cameras : sequence of Camera
        The views.
    traces : sequence of sequence of sequence of Trace
        View by view, whisker by whisker, frame by frame; the same whiskers in every view.
    rate : float
        Frames per second.
    options : TrackOptions, optional
        How.
    names : sequence of str, optional
        Of the whiskers.
    head : xarray.Dataset, optional
        How the head moves; see `vibrissa.io.load_head`. The motion of the base is then smoothed,
        filtered and given as angles relative to the head.
    contacts : xarray.Dataset, optional
        Contact points that were tracked otherwise; see `vibrissa.io.load_contact_points`.
    objects : sequence of Surface, optional
        What stands there, laboratory frame. Without ``contacts``, the point of the whisker nearest
        to any of them is where the contact is.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    xarray.DataTree
        A recording. Its base pose, contact and wrench are those of the rod that fits the traces;
        the group ``measured`` holds what was measured before: the whisker merged from the views
        with its uncertainty, the pose the paper's way, and the contact points of ``contacts`` or
        ``objects`` beside those of the rod. The attribute ``remarks``, if there is one, says what
        is to be known before it is believed, a sentence a line. Of several whiskers, one that
        cannot be tracked (it is seen in too few frames, or the views show different ones) is left
        out, and a remark says why.

    Raises
    ------
    ValueError
        If views and whiskers do not fit together, or no whisker can be tracked.
    """
    options = options or TrackOptions()
    counts = {len(view) for view in traces}
    if len(traces) != len(cameras) or len(counts) != 1 or 0 in counts:
        raise ValueError(
            f"{len(cameras)} cameras and {[len(view) for view in traces]} whiskers in the views do "
            "not fit: every view needs all whiskers"
        )
    if not (np.isfinite(rate) and rate > 0.0):
        raise ValueError(f"rate is {rate!r}; it must be positive, in frames per second")
    timed = _best_seen(traces)
    pairs = paired_frames(cameras, timed, options.offset)
    moving = None if head is None else HeadPose.of(head, pairs[:, 0], rate)
    found, remarks = [], remarks_on_time(cameras, timed, options.offset)
    count = counts.pop()
    for k in range(count):
        rows = [[view[k][i] for i in pairs[:, v]] for v, view in enumerate(traces)]
        name = names[k] if names is not None else f"whisker {k}"
        try:
            one = track_whisker(cameras, rows, rate, options, name, progress, moving)
            other = None
            if contacts is not None:
                other = given_contacts(contacts, cameras, pairs, rate, k, one.refined)
            elif objects:
                other = contacts_at(objects, one.curves, one.touching, one.refined)
            found.append(replace(one, contacts=other))
            remarks += remarks_on(cameras, one.sight, one.length, one.refined.misfit, name)
        except Exception as fault:  # whatever it is, it must not cost the others
            if count == 1:
                raise
            reason = " ".join(str(fault).split()) or type(fault).__name__
            remarks.append(f"{name} could not be tracked and is left out: {reason}")
    if not found:
        raise ValueError(f"no whisker could be tracked: {'; '.join(remarks)}")
    recording = tracked_recording(cameras, found, pairs, rate, moving, objects, options.cutoff)
    if remarks:
        recording.attrs["remarks"] = "\n".join(remarks)
    return recording


def _best_seen(traces: Sequence[Sequence[Sequence[Trace]]]) -> list[Sequence[Trace]]:
    """Traces, view by view, of the whisker that is least often lost."""
    seen = [[sum(len(trace.line) > 0 for trace in row) for row in view] for view in traces]
    best = int(np.argmax(np.min(seen, axis=0)))
    return [view[best] for view in traces]


def track_whisker(
    cameras: Sequence[Camera],
    traces: Sequence[Sequence[Trace]],
    rate: float,
    options: TrackOptions,
    name: str = "whisker",
    progress: Progress | None = None,
    head: HeadPose | None = None,
) -> Tracked:
    """Track one whisker in space.

    Parameters
    ----------
    cameras : sequence of Camera
        The views.
    traces : sequence of sequence of Trace
        View by view, frame by frame, frames that belong together.
    rate : float
        Frames per second.
    options : TrackOptions
        How.
    name : str
        Of the whisker.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.
    head : HeadPose, optional
        The head in these frames; by default it does not move.

    Returns
    -------
    Tracked

    Raises
    ------
    ValueError
        If it is seen in too few frames, or the views show different whiskers.
    """
    tell = progress or _silent
    count = len(traces[0])
    sight = Sight.of(traces)
    check_views(cameras, sight, name)
    curves = []
    for i, views in enumerate(zip(*traces, strict=True)):
        curves.append(merge(cameras, views))
        tell(f"{name} in space", i + 1, count)
    points = np.array([curve.points for curve in curves])
    tell(f"contact of {name}", 0, 2)
    head = head or HeadPose.still(count)
    on_head = head.seen_from(points)
    tips: Mask = np.all(sight.ends[:, :, 1] > 0.5, axis=1)
    shape, whisker = _at_rest(on_head, options, name, tips)
    tell(f"contact of {name}", 1, 2)
    known = np.isfinite(points).all(axis=(1, 2))
    touching = known & ~shape.free
    how = options.refine
    if not shape.free.any():
        # Nothing but the bent shapes shows how the whisker is rolled.
        how = replace(how, roll=max(how.roll, _ANY_ROLL))
    fit = _Fit(cameras, sight, on_head, touching, rate, options, how, head)
    length = Length(whisker.length, 0.0)
    if options.whisker is None and not shape.whole:
        length = fit.length(shape)
        shape = lengthened(shape, length.value)
        whisker = whisker_at_rest(shape, name, **options.properties)
    unfiltered, pose = fit.pose(shape, whisker)
    refined = fit.refined(whisker, pose)
    if length.sigma > 0.0:
        longer = lengthened(shape, length.value + _LONGER * length.sigma)
        other = whisker_at_rest(longer, name, **options.properties)
        further = fit.refined(other, fit.pose(longer, other)[1])
        refined = with_length_unsure(refined, further, 1.0 / _LONGER)
    tell(f"contact of {name}", 2, 2)
    covariance = np.array([curve.covariance for curve in curves])
    return Tracked(
        whisker, sight, points, covariance, shape, pose, unfiltered, touching, refined, head, length
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    """Rods that are fitted to the same traces."""

    cameras: Sequence[Camera]
    sight: Sight
    curves: Array
    touching: Mask
    rate: float
    options: TrackOptions
    how: RefineOptions
    head: HeadPose

    def pose(self, shape: RestShape, whisker: Whisker) -> tuple[BasePose, BasePose]:
        """How it is held, unfiltered and filtered."""
        unfiltered = base_pose(self.curves, shape, whisker)
        pose = unfiltered.filtered(self.rate, self.options.cutoff)
        return unfiltered, pose if shape.free.any() else rolled(pose, self.curves, whisker)

    def refined(self, whisker: Whisker, pose: BasePose) -> Refined:
        return refine(
            self.cameras,
            self.sight,
            whisker,
            pose,
            self.touching,
            self.curves,
            self.rate,
            self.how,
            self.curves.shape[1],
            self.head,
        )

    def length(self, shape: RestShape) -> Length:
        """Of a whisker whose tip is not seen, from some of the frames in contact."""
        rows = np.flatnonzero(self.touching)
        if len(rows) < _FEWEST:
            return Length(shape.length, np.nan)
        rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), _FRAMES)).astype(int)]
        curves = np.full_like(self.curves, np.nan)
        curves[rows] = self.curves[rows]
        cost = cost_of(
            self.cameras, self.sight, self.touching, curves, self.rate, self.how, self.head
        )

        def of(length: float) -> float:
            longer = lengthened(shape, length)
            whisker = whisker_at_rest(longer, **self.options.properties)
            return cost(whisker, self.pose(longer, whisker)[1])

        return likeliest_length(shape.length, of)


def _at_rest(
    curves: Array, options: TrackOptions, name: str, tips: Mask
) -> tuple[RestShape, Whisker]:
    """Take the rest shape from the frames, or as it is known."""
    if options.whisker is not None:
        whisker = options.whisker.with_properties(name=name)
        return known_rest(curves, whisker, options.free), whisker
    shape = rest_shape(curves, options.free, tips)
    return shape, whisker_at_rest(shape, name, **options.properties)


def _silent(stage: str, done: int, total: int) -> None:
    pass
