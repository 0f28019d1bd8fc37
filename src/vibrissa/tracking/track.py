"""From traces in one or more views to a recording: shape, pose, contact and wrench in every frame.

Remarks state what to know before the results are believed (`vibrissa.tracking.recording`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.cameras import Camera
from vibrissa.io import Frame
from vibrissa.numerics import Array, Mask, without_blas_threads
from vibrissa.objects import Surface
from vibrissa.recording import ONE_VIEW
from vibrissa.tracking.recording import (
    Tracked,
    check_views,
    contacts_at,
    given_contacts,
    outside_video,
    pixel_at,
    remarks_on,
    remarks_on_bases,
    remarks_on_following,
    remarks_on_fur,
    remarks_on_hook,
    remarks_on_optics,
    remarks_on_peg,
    remarks_on_plane,
    remarks_on_rest,
    remarks_on_row,
    remarks_on_shaking,
    remarks_on_time,
    remarks_on_unseen_contacts,
    scale_sigma,
    tracked_recording,
    unexplained_frames,
)
from vibrissa.tracking.refine.continuation import continued
from vibrissa.tracking.refine.fit import Fitter, RodFit
from vibrissa.tracking.refine.hook import hook_of, off_hook, straightened
from vibrissa.tracking.refine.inertia import inertia_of
from vibrissa.tracking.refine.optics import (
    Optics,
    rough_optics,
    unchecked_optics,
    with_depth_unsure,
    with_optics_unsure,
    with_shift_unsure,
)
from vibrissa.tracking.refine.peg import UncertainPeg
from vibrissa.tracking.refine.problem import FitOptions
from vibrissa.tracking.refine.rods import TraceSeries, rolled
from vibrissa.tracking.refine.silhouette import bends_otherwise, explains, on_peg, peg_in_images
from vibrissa.tracking.refine.taper import some_in_contact, tapered_as_it_bends
from vibrissa.tracking.refine.tilt import Plane, known_flat, plane_of, projected, unturned
from vibrissa.tracking.space.curve import (
    HiddenPart,
    all_merged,
    begun_together,
    merged,
    shown_by_one,
)
from vibrissa.tracking.space.exchange import Known, exchanged
from vibrissa.tracking.space.frame_pairs import best_seen, paired_frames
from vibrissa.tracking.space.frame_steps import without_repeats
from vibrissa.tracking.space.pose import CUTOFF, BasePose, HeadPose, base_pose, rolled_over
from vibrissa.tracking.space.rest_shape import (
    LEAST_SEEN,
    Astray,
    Length,
    RestShape,
    known_rest,
    lengthened,
    likeliest_length,
    rest_shape,
    seen_length,
    stated_length,
    unseen_part,
    whisker_at_rest,
)
from vibrissa.tracking.trace.blur import with_blur
from vibrissa.tracking.trace.trace import Trace
from vibrissa.whisker import Whisker

Progress = Callable[[str, int, int], None]
"""Function that is called with the name of a stage, and how much of how much is done."""

# Standard deviation of a roll that is determined by bent shapes only, rad.
_ANY_ROLL = np.radians(10.0)
# Misfit, absolute and relative to the usual one, below which the traces of a row are its whiskers'.
_WELL, _WORSE = 1.0, 3.0
# Misfit over the usual one above which frames of a row are left out, and share that must remain.
_MORE, _EXPLAINED = 2.0, 0.1
# Errors of traces that vary with the pose only, pixels: by light, fur, lenses and what is behind;
# and in a row, where they are next to crossings.
_ASTRAY, _CROSSED = 0.1, 0.4


@dataclass(frozen=True)
class TrackOptions:
    """Options that turn traces into a recording.

    Parameters
    ----------
    cutoff : float, optional
        Cut-off frequency of the zero-phase low pass on the base's pose, Hz; None filters nothing.
    offset : int, optional
        Number of frames by which the other cameras began before the first; None: it is found, and
        dropped frames too.
    free : float
        Smallest share of the frames that are free of contact.
    fit : FitOptions
        Settings of the fit of the rod.
    properties : mapping
        Radius and material of the whisker; see `vibrissa.Whisker`.
    whisker : Whisker, optional
        Whisker at rest, where it is known: its base is where it leaves the face. By default it is
        taken from the frames that are free of contact.
    length : float, optional
        Length of the whisker from where it leaves the face, m, where it is known but for its shape.
        By default it is seen, or inferred from how the whisker bends.
    fur : float
        Length of the whisker that fur hides in the view that shows most of it, m: stated radii at
        the base are those before it.
    rough : bool
        Whether the cameras, orthographic ones, are not calibrated: what the views show of a free
        whisker then corrects them, where they cannot explain it.
    distance : float, optional
        Approximate distance of rough cameras from what they see, m; by default they are far away.
    """

    cutoff: float | None = CUTOFF
    offset: int | None = 0
    free: float = 0.1
    fit: FitOptions = field(default_factory=FitOptions)
    properties: Mapping[str, Any] = field(default_factory=dict)
    whisker: Whisker | None = None
    length: float | None = None
    fur: float = 0.0
    rough: bool = False
    distance: float | None = None

    @property
    def scaled(self) -> bool:
        """Whether forces have the scale of a radius at the base, which is stated."""
        return bool({"base_radius", "rat"} & self.properties.keys())

    @property
    def at_base(self) -> dict[str, Any]:
        """Radius, material and hidden length of the whisker, as arguments of `whisker_at_rest`."""
        return {**self.properties, "hidden": self.fur}


@without_blas_threads
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
    sample: Sequence[Sequence[Frame]] = (),
    progress: Progress | None = None,
) -> xr.DataTree:
    """Make a recording of the traces of one or more whiskers.

    Parameters
    ----------
    cameras : sequence of Camera
        Cameras of the views.
    traces : sequence of sequence of sequence of Trace
        Traces view by view, whisker by whisker, frame by frame; the same whiskers in every view.
    rate : float
        Frames per second.
    options : TrackOptions, optional
        Settings of tracking.
    names : sequence of str, optional
        Names of the whiskers.
    head : xarray.Dataset, optional
        Pose of the head; see `vibrissa.io.load_head`. The motion of the base is then smoothed,
        filtered and given as angles relative to the head.
    contacts : xarray.Dataset, optional
        Contact points that were tracked otherwise; see `vibrissa.io.load_contact_points`.
    objects : sequence of Surface, optional
        Objects in the laboratory frame, on which contacts of the fitted rod are. Without
        ``contacts``, the point of the measured whisker nearest to any of them is compared with it.
    sample : sequence of sequence of array (height, width), optional
        Frames of each view spread over the film, in which a peg that a whisker touches is looked
        for if there are no ``objects``. One whose outline is an edge in both views, and that
        explains the contacts, is fitted with them: its place, direction and radius are what images
        and contacts together show.
    progress : callable, optional
        Function that is called as ``progress(stage, done, total)``.

    Returns
    -------
    xarray.DataTree
        Recording. Its base pose, contact and wrench are those of the rod that fits the traces; the
        group ``measured`` holds what was measured before: the whisker merged from the views with
        its uncertainty, the pose by the paper's method, and the contact points of ``contacts`` or
        ``objects`` next to those of the rod. The attribute ``remarks``, if there is one, states
        what is to be known before it is believed, a sentence a line. Of several whiskers, one that
        cannot be tracked (it is seen in too few frames, or the views show different ones) is left
        out, and a remark gives the reason.

    Raises
    ------
    ValueError
        If views and whiskers do not fit together, or no whisker can be tracked.
    """
    options = options or TrackOptions()
    count = _whiskers_in(traces, len(cameras))
    if sample and len(sample) != len(cameras):
        raise ValueError(f"sample has frames of {len(sample)} views; there are {len(cameras)}")
    if not (np.isfinite(rate) and rate > 0.0):
        raise ValueError(f"rate is {rate!r}; it must be positive, in frames per second")
    timed = best_seen(traces)
    pairs = paired_frames(cameras, traces, options.offset)
    if head is not None and len(cameras) == 1:
        raise ValueError("the head moves in space, which one view does not show: leave it out")
    optics, doubts = None, list[str]()
    if options.rough and len(cameras) > 1:
        optics, cameras, doubts = _corrected(cameras, timed, pairs, options.distance)
    moving = None if head is None else HeadPose.of(head, pairs[:, 0], rate)
    found, remarks = list[Tracked](), doubts + remarks_on_time(cameras, traces, options.offset)
    called = [f"whisker {k}" for k in range(count)] if names is None else list(names)
    timed_rows = [[[row[i] for i in pairs[:, v]] for row in view] for v, view in enumerate(traces)]
    rows = [list(row) for row in zip(*timed_rows, strict=True)]

    def tracked(k: int, used: Sequence[Sequence[Trace]]) -> Tracked:
        given = called[k], progress, moving, objects, sample, count > 1, hidden[k], optics
        return track_whisker(cameras, used, rate, options, *given)

    known = partial(known_of, cameras, rate=rate, options=options.fit)
    kept, repeats = without_repeats(cameras, rows)
    begun = [begun_together(cameras, row) for row in kept]
    hidden = [shown_by_one(cameras, *both) for both in zip(kept, begun, strict=True)]
    remarks += repeats + remarks_on_shaking(cameras, timed) + [ONE_VIEW] * (len(cameras) == 1)
    together, before, changes = _sorted_out(cameras, begun, tracked, known)
    for k, name in enumerate(called):
        remarks += remarks_on_following(cameras, rows[k], name)
        remarks += remarks_on_bases(cameras, kept[k], begun[k], options.scaled, name)
        try:
            one = before[k] if k in before else tracked(k, together[k])
            if count > 1:
                one, left_out = _without_contradictions(one, len(cameras) == 1)
                remarks += remarks_on_row(changes[k][0], changes[k][1] + left_out, name)
            if contacts is not None:
                other = given_contacts(contacts, cameras, pairs, rate, k, one.fit)
                one = replace(one, contacts=other)
            elif objects:
                one = replace(one, contacts=contacts_at(objects, one.curves, one.touching, one.fit))
            one = _with_cameras_unsure(cameras, one, options, optics)
            remarks += remarks_on_optics(one, optics, name)
            found.append(one)
            remarks += _remarks_on_one(cameras, one, options.fur, name, bool(objects))
        except Exception as fault:  # no error of one whisker may discard the others
            if count == 1:
                raise
            reason = " ".join(str(fault).split()) or type(fault).__name__
            remarks.append(f"{name} could not be tracked and is left out: {reason}")
    if contacts is not None:
        remarks += outside_video(contacts, pairs, rate)
    if not found:
        raise ValueError(f"no whisker could be tracked: {'; '.join(remarks)}")
    recording = tracked_recording(cameras, found, pairs, rate, moving, objects, options.cutoff)
    if remarks:
        recording.attrs["remarks"] = "\n".join(remarks)
    return recording


def _with_cameras_unsure(
    cameras: Sequence[Camera], one: Tracked, options: TrackOptions, optics: Optics | None
) -> Tracked:
    """Whisker with what is not known of the cameras in its covariances."""
    fit = with_shift_unsure(cameras, one.fit, one.traces.shift)
    fit = with_depth_unsure(cameras, fit, options.rough, options.distance)
    return replace(one, fit=fit if optics is None else with_optics_unsure(fit, optics))


def _whiskers_in(traces: Sequence[Sequence[Sequence[Trace]]], views: int) -> int:
    """Number of whiskers; raise a ValueError if the views do not all have them."""
    counts = [len(view) for view in traces]
    if len(counts) != views or len(set(counts)) != 1 or 0 in counts:
        raise ValueError(
            f"{views} cameras and {counts} whiskers in the views do not fit: every view needs all "
            "whiskers"
        )
    return counts[0]


def _remarks_on_one(
    cameras: Sequence[Camera], one: Tracked, fur: float, name: str, stated: bool
) -> list[str]:
    """Report what is to be known of one whisker; whether it touches stated objects is given."""
    remarks = remarks_on_fur(one, fur, name) + remarks_on_hook(one, name)
    remarks += [one.inertia.remark(name)] if one.inertia else []
    remarks += remarks_on(cameras, one.traces, one.length, one.fit.misfit, name)
    # Known objects locate contacts that are not seen.
    if not stated and one.peg is None:
        remarks += remarks_on_unseen_contacts(one, name)
    remarks += remarks_on_peg(one, name) + remarks_on_rest(one, name)
    return remarks + (remarks_on_plane(one, name) if len(cameras) == 1 else [])


def _sorted_out(
    cameras: Sequence[Camera],
    begun: Sequence[list[list[Trace]]],
    tracked: Callable[[int, Sequence[Sequence[Trace]]], Tracked],
    known_by: Callable[[Tracked], Known],
) -> tuple[list[list[list[Trace]]], dict[int, Tracked], dict[int, tuple[int, int]]]:
    """Traces, exchanged where in doubt; whiskers that keep theirs; and changes.

    Changes are, for each whisker, the numbers of frames with exchanged traces and without any.
    """
    first, known = dict[int, Tracked](), list[Known | None]()
    if len(begun) == 1 or len(cameras) == 1:
        return list(begun), first, dict.fromkeys(range(len(begun)), (0, 0))
    for k, row in enumerate(begun):
        with suppress(Exception):  # it is tried again, and its fault stated then
            first[k] = tracked(k, row)
        one = first.get(k)
        known.append(None if one is None else known_by(one))
    found, changes = exchanged(cameras, begun, known), dict[int, tuple[int, int]]()
    for k, (row, new) in enumerate(zip(begun, found, strict=True)):
        points = [np.array([[len(t.line) for t in view] for view in one]) for one in (row, new)]
        same = np.array(
            [[a is b for a, b in zip(*both, strict=True)] for both in zip(row, new, strict=True)]
        )
        shown, left = ((one > 0).all(axis=0) for one in points)
        changes[k] = int((left & ~same.all(axis=0)).sum()), int((shown & ~left).sum())
        if not same.all():
            first.pop(k, None)
    return found, first, changes


def _contradicted(misfit: Array) -> Mask:
    """Frames explained far worse than usual; none if the rod, itself wrong, explains hardly any."""
    known = misfit[np.isfinite(misfit)]
    usual = float(np.median(known)) if known.size else 0.0
    strange = unexplained_frames(misfit) & (misfit > _MORE * usual)
    return np.asarray(strange & (strange.sum() < (1.0 - _EXPLAINED) * known.size))


def known_of(cameras: Sequence[Camera], one: Tracked, rate: float, options: FitOptions) -> Known:
    """Shape and position of a whisker by the frames that the rod explains as well as usual."""
    misfit, wrong = one.fit.misfit, _contradicted(one.fit.misfit)
    usual = np.nanmedian(misfit) if np.isfinite(misfit).any() else 0.0
    doubtful = ~(misfit <= max(_WELL, _WORSE * usual)) | wrong

    def bent(frames: Sequence[int], pairs: Sequence[Sequence[Trace]]) -> Array:
        return _misfits_bent(cameras, one, frames, pairs, rate, options)

    touched = one.touching & ~doubtful
    return Known(
        one.curves,
        one.shape.points,
        doubtful,
        wrong,
        bent if touched.any() else None,
        max(_WELL, float(np.median(misfit[touched])) if touched.any() else 0.0),
    )


def _misfits_bent(
    cameras: Sequence[Camera],
    one: Tracked,
    frames: Sequence[int],
    pairs: Sequence[Sequence[Trace]],
    rate: float,
    options: FitOptions,
) -> Array:
    """Misfits of the bent rod to pairs of traces, each for itself; infinite if they show none."""
    # A frame without traces between them, so that none continues the one before.
    apart = [
        [t for trace in view for t in (trace, Trace.lost())] for view in zip(*pairs, strict=True)
    ]
    head = one.head.rows(np.repeat(np.asarray(frames, dtype=np.intp), 2))
    curves = head.seen_from(
        np.array([curve.points for curve in merged(cameras, zip(*apart, strict=True))])
    )
    none = np.zeros(len(curves), dtype=bool)
    shape = replace(
        one.shape,
        free=np.concatenate([one.shape.still, none]),
        deviation=np.concatenate([one.shape.deviation, np.full(len(curves), np.nan)]),
        ringing=None,
    )
    every = np.concatenate([one.head.seen_from(one.curves), curves])
    pose = base_pose(every, shape, one.whisker).rows(slice(len(one.curves), None))
    fitter = Fitter(cameras, TraceSeries.of(apart), ~none, curves, rate, options, head)
    return fitter.misfits(one.whisker, pose)[::2]


def _without_contradictions(one: Tracked, flat: bool) -> tuple[Tracked, int]:
    """Whisker of a row without the frames that the rod does not explain, and their number."""
    # One view does not show all of its motion; contacts there may be a neighbour's line.
    strange = _contradicted(one.fit.misfit) & (one.touching | (not flat))
    if not strange.any():
        return one, 0
    values = {name: array.copy() for name, array in vars(one.fit).items()}
    for array in values.values():
        array[strange] = np.nan
    fit = replace(one.fit, **values)
    return replace(one, fit=fit, touching=one.touching & ~strange), int(strange.sum())


def _corrected(
    cameras: Sequence[Camera],
    traces: Sequence[Sequence[Trace]],
    pairs: NDArray[np.int64],
    distance: float | None,
) -> tuple[Optics, Sequence[Camera], list[str]]:
    """Errors of the cameras inferred from a free whisker, corrected cameras, and remarks."""
    rows = [[view[i] for i in pairs[:, v]] for v, view in enumerate(traces)]
    optics = rough_optics(cameras, rows, distance)
    stated = "orthographic cameras" if distance is None else f"lenses at {distance:g} m"
    if optics is None:
        doubt = f"too few frames show a free whisker to check that {stated} explain the views."
        optics = unchecked_optics(cameras, distance)
        return optics, optics.cameras, [doubt]
    if not optics.needed:
        optics = optics.as_stated()
        return optics, optics.cameras, []
    return (
        optics,
        optics.cameras,
        [
            f"cameras: {stated}, as they are stated, leave {optics.before:.2f} pixels of what the "
            f"views show of the free whisker unexplained, these leave {optics.after:.2f} and are "
            f"used: {optics}. Calibrated cameras (vibrissa calibrate, --cameras) are better."
        ],
    )


_NOTHING = HiddenPart()


def track_whisker(
    cameras: Sequence[Camera],
    traces: Sequence[Sequence[Trace]],
    rate: float,
    options: TrackOptions,
    name: str = "whisker",
    progress: Progress | None = None,
    head: HeadPose | None = None,
    objects: Sequence[Surface] = (),
    sample: Sequence[Sequence[Frame]] = (),
    row: bool = False,
    hidden: HiddenPart = _NOTHING,
    optics: Optics | None = None,
) -> Tracked:
    """Track one whisker, or one of a row, from traces of frames that belong together, by view."""
    report = progress or (lambda stage, done, total: None)
    traces, blur = with_blur(traces)
    series = TraceSeries.of(traces)
    check_views(cameras, series, name)
    curves = all_merged(cameras, traces, partial(report, f"{name} in space"))
    points = np.array([curve.points for curve in curves])
    report(f"contact of {name}", 0, 2)
    head = head or HeadPose.still(len(points))
    on_head = head.seen_from(points)
    tips: Mask = np.all(series.ends[:, :, 1] > 0.5, axis=1)
    sparse = any(trace.sparse for view in traces for trace in view)
    pixel, flat, scaled = pixel_at(cameras, on_head), len(cameras) == 1, options.scaled
    astray = Astray((_CROSSED if row and not sparse else _ASTRAY) * pixel, blur * pixel)
    rest = partial(_at_rest, options, name, tips, flat, sparse, astray)
    light, used, swings = points, series, np.zeros(len(points))
    shape, whisker = rest(on_head, swings)
    inertia = inertia_of(
        points, shape, whisker, lambda c, e: rest(head.seen_from(c), e)[0], rate, pixel, scaled
    )
    if inertia is not None:
        light, swings = points - inertia.displacement, inertia.unsure
        used, on_head = inertia.without(cameras, series, points), head.seen_from(light)
        shape, whisker = rest(on_head, swings)
    plane = plane_of(on_head, shape, tips) if flat else Plane(None, np.zeros(len(points)))
    if plane.head is not None:
        on_head = unturned(on_head, plane.head)
        shape, whisker = rest(on_head, swings)
    hook = None if row or sparse or options.whisker is not None else hook_of(shape, pixel)
    if hook is not None:
        on_head = straightened(on_head, shape, whisker, base_pose(on_head, shape, whisker), hook)
        shape, whisker = rest(on_head, swings, hook.share)
    used, fitted = off_hook(cameras, used, light, hook)
    if not flat:
        shape = replace(shape, free=shape.free & ~rolled_over(on_head, shape, whisker))
    report(f"contact of {name}", 1, 2)
    touching = np.isfinite(points).all(axis=(1, 2)) & ~shape.free
    within = plane.head or head
    fitter = Fitter(cameras, fitted, touching, on_head, rate, options.fit, within, objects)
    fitter = replace(fitter, unsure=plane.unsure, hook=hook, inertia=inertia)
    fitter = replace(fitter, displaced=None if optics is None else optics.displacements)
    more = hidden.before(shape.length) * scaled
    used_options = replace(options, fur=options.fur + more)
    found = _found(fitter, shape, whisker, used, tips, sparse, used_options, sample)
    report(f"contact of {name}", 2, 2)
    return Tracked(
        whisker=found.whisker,
        traces=replace(series, seen=used.seen),
        curves=points,
        covariance=np.array([curve.covariance for curve in curves]),
        shape=found.shape,
        pose=found.pose,
        unfiltered=found.unfiltered,
        touching=touching & (found.fit.force != 0.0).any(axis=1),
        fit=found.fit if plane.head is None else projected(found.fit, plane.head),
        head=head,
        length=found.length,
        scale=scale_sigma(found.whisker, options.fur, more) if scaled else np.nan,
        peg=found.peg,
        unlike=found.unlike,
        hook=hook,
        inertia=inertia,
        turned=plane.turned,
    )


def _found(
    fitter: Fitter,
    shape: RestShape,
    whisker: Whisker,
    shown: TraceSeries,
    tips: Mask,
    sparse: bool,
    options: TrackOptions,
    sample: Sequence[Sequence[Frame]],
) -> _Bent:
    """Fit a whisker of a shape at rest, and the peg that it touches."""
    tapers = bool(options.properties.keys() & {"tip_radius", "radius"})
    further = None
    if options.whisker is None:
        whisker = whisker_at_rest(shape, whisker.name, **options.at_base)
        further = continued(shape, fitter.curves, fitter.cameras, shown, fitter.head, tapers)
    if further is not None:
        shape = further[0]
        whisker = whisker_at_rest(shape, whisker.name, **options.at_base)
    smoothness = fitter.options
    if sparse:
        smoothness = replace(smoothness, sharpest=max(smoothness.sharpest, 1.0))
    if not shape.free.any():
        # Only the bent shapes determine the roll.
        smoothness = replace(smoothness, roll=max(smoothness.roll, _ANY_ROLL))
    fitter = replace(fitter, options=smoothness)
    begun = _Begun(shape, whisker, further and further[1], tips, tapers)
    found = None
    if sample and not fitter.objects:
        found = _on_peg(fitter, begun, options, sample)
    return found or _bent(fitter, begun, options)


class _Begun(NamedTuple):
    """A whisker at rest before it is known how it bends."""

    shape: RestShape
    whisker: Whisker
    continued: Length | None  # where one view shows more of it than all
    tips: Mask
    tapers: bool  # whether its taper is stated


class _Bent(NamedTuple):
    """A whisker and its length by how it bends, and its fit."""

    whisker: Whisker
    shape: RestShape
    length: Length
    pose: BasePose
    unfiltered: BasePose
    fit: RodFit
    peg: UncertainPeg | None  # that it touches, where that was unknown
    unlike: UncertainPeg | None = None  # a peg that images show, but not how it bends


def _on_peg(
    fitter: Fitter, begun: _Begun, options: TrackOptions, sample: Sequence[Sequence[Frame]]
) -> _Bent | None:
    """The same with a peg that images show; None if there is none that explains the contacts."""
    shape, whisker = begun.shape, begun.whisker
    touches, misfit = fitter.touches(whisker, _poses(fitter, shape, whisker, options)[1])
    peg = peg_in_images(fitter.cameras, sample, touches)
    if peg is None:
        return None
    on = replace(fitter, peg=peg)
    found = _bent(on, begun, options)
    if found.peg is None or not explains(peg, found.peg, misfit, found.fit, found.whisker):
        return None
    if bends_otherwise(on.excess(found.whisker, found.pose)):
        return _bent(fitter, begun, options)._replace(unlike=peg)
    return found._replace(fit=on_peg(found.peg, found.fit, found.whisker))


def _bent(fitter: Fitter, begun: _Begun, options: TrackOptions) -> _Bent:
    """Length or taper of a whisker, its pose, and the fit of the rod."""
    shape, whisker, further, tips, tapers = begun
    length = Length(whisker.length, 0.0)
    if options.whisker is None and options.length is not None:
        length = unseen_part(shape, stated_length(shape, options.length, tapers))
    elif options.whisker is None and shape.whole:
        lengths = np.linalg.norm(np.diff(fitter.curves[shape.free & tips], axis=1), axis=2).sum(1)
        length = further or seen_length(lengths, fitter.traces.line, tapers)
    elif options.whisker is None:
        length = unseen_part(shape, _length(fitter, shape, options))
    if further is not None:
        length = length._replace(shown=further.shown, bending=further.bending)
    if length.value > length.shown:
        shape = lengthened(shape, length.value)
        whisker = whisker_at_rest(shape, whisker.name, **options.at_base)
    unfiltered, pose = _poses(fitter, shape, whisker, options)
    if length.seen and not tapers:
        whisker, length = tapered_as_it_bends(fitter, whisker, length, pose)
    fit, peg = fitter.fit(whisker, pose, fitter.curves.shape[1], length)
    if fitter.inertia is not None:
        # A peg is where contacts are, not where they would be without mass.
        fit = fit.swung(fitter.inertia, whisker.length)
    return _Bent(whisker, shape, length, pose, unfiltered, fit, peg)


def _at_rest(
    options: TrackOptions,
    name: str,
    tips: Mask,
    flat: bool,
    sparse: bool,
    astray: Astray,
    curves: Array,
    swings: Array,
    hidden: float = 0.0,
) -> tuple[RestShape, Whisker]:
    """Rest shape from the frames, without a share at the base, or of the known whisker.

    ``swings`` are errors (time,) of the curves by what inertia bends.
    """
    astray = astray._replace(motion=np.hypot(astray.motion, swings))
    if options.whisker is not None:
        whisker = options.whisker.with_properties(name=name)
        if flat:
            return known_flat(curves, whisker, options.free)
        return known_rest(curves, whisker, options.free), whisker
    shape = replace(rest_shape(curves, options.free, tips, astray, hidden), sparse=sparse)
    return shape, whisker_at_rest(shape, name, **options.at_base)


def _poses(
    fitter: Fitter, shape: RestShape, whisker: Whisker, options: TrackOptions
) -> tuple[BasePose, BasePose]:
    """Pose of the base, unfiltered and filtered."""
    unfiltered = base_pose(fitter.curves, shape, whisker)
    pose = unfiltered.filtered(fitter.rate, options.cutoff)
    return unfiltered, pose if shape.free.any() else rolled(pose, fitter.curves, whisker)


def _length(fitter: Fitter, shape: RestShape, options: TrackOptions) -> Length:
    """Length of a whisker with an unseen tip, from some of the frames in contact."""
    # All lengths are compared by the same frames: short traces have no pose for the longest.
    longest = lengthened(shape, shape.length / LEAST_SEEN)
    pose = _poses(fitter, longest, whisker_at_rest(longest, **options.at_base), options)[1]
    posed = np.isfinite(pose.rotation).all(axis=(1, 2))
    some = some_in_contact(replace(fitter, touching=fitter.touching & posed))
    if some is None:
        # Few bent frames do not show it, so that it is only known what is usual.
        touched = bool(fitter.touching.any())
        return (
            likeliest_length(shape.length, lambda _: 0.0)
            if touched
            else Length(shape.length, np.nan)
        )
    cost = some.costs(shape.length)

    def of(length: float) -> float:
        longer = lengthened(shape, length)
        whisker = whisker_at_rest(longer, **options.at_base)
        found = _poses(fitter, longer, whisker, options)[1]
        # Where it has none, that for the longest is a start, too.
        lost = ~np.isfinite(found.rotation).all(axis=(1, 2))
        values = {name: array.copy() for name, array in vars(found).items()}
        for name, array in values.items():
            array[lost] = getattr(pose, name)[lost]
        return cost(whisker, BasePose(**values))

    return likeliest_length(shape.length, of)
