"""Remarks on tracked whiskers: what to know before results are believed, one sentence each.

They report what would make results wrong without any other sign, and what to do about it: views
that do not show the same whisker, cameras that are not synchronous or that shake, ends that are not
seen, a whisker that leaves the plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np

from vibrissa.cameras import Camera
from vibrissa.numerics import Array, Mask
from vibrissa.tracking.recording import Tracked
from vibrissa.tracking.refine.optics import Optics
from vibrissa.tracking.refine.rods import TraceSeries
from vibrissa.tracking.space.frame_pairs import NEAR, clear_offsets
from vibrissa.tracking.space.rest_shape import Length
from vibrissa.tracking.trace.start import base_gap
from vibrissa.tracking.trace.steady import slow_motion
from vibrissa.tracking.trace.trace import Trace, doubtful_frames
from vibrissa.whisker import Whisker

# Relative variation of the seen length above which a whisker leaves the plane of a single view.
_SHORTENED = 0.04
# Misfit that is unusual, and the share of such frames above which there is a remark.
_STRANGE, _OFTEN = 2.0, 0.05
# Share of the uncertainty of contact points due to the cameras above which there is a remark.
_MOST = 0.7
_FUR_KNOWN = 0.25  # relative standard deviation of a stated length of fur
_NEAR = 2.0  # unusual distance between the bases of several views, pixels
# Slow motion of a camera above which there is a remark, pixels, and as a share of its shaking.
_SLOW, _MOSTLY = 0.25, 0.8
_BEYOND = 0.05  # share of the length beyond what is seen from which a contact is not seen
# Bending below which contacts are not detected, over the length, above which there is a remark.
_COARSE = 2e-3
_FEWEST = 8  # smallest number of frames to decide whether a whisker leaves the plane


def remarks_on_shaking(cameras: Sequence[Camera], traces: Sequence[Sequence[Trace]]) -> list[str]:
    """Report which cameras shake, and how accurately the shaking is measured."""
    shifts = [np.array([trace.shift for trace in row]) for row in traces]
    found = []
    for camera, shift in zip(cameras, shifts, strict=True):
        size, left = shift[:, :2].std(axis=0), shift[:, 2:].mean(axis=0)
        if size.any():
            found.append(
                f"{camera.name} shakes by {size[0]:.2f} pixels along columns and {size[1]:.2f} "
                "along rows (standard deviations), as what never moves in its images shows; traces "
                f"are moved back by that, which is known to {left[0]:.2f} and {left[1]:.2f} pixels."
            )
            slow = float(slow_motion(shift[:, None, :2]).max())
            if slow > max(_SLOW, _MOSTLY * float(size.max())):
                found[-1] += (
                    f" Part of it is slow, or a step, of {2.0 * slow:.1f} pixels: at which moment "
                    "the camera was where it was calibrated is not known, by which all contact "
                    "points may be shifted together (in their covariances)."
                )
        elif np.isnan(left).any() and any(other[:, :2].any() for other in shifts):
            found.append(
                f"nothing shows whether {camera.name} shakes, too: it is taken to do so as much as "
                "the other, in the covariances only."
            )
    return found


def remarks_on_optics(one: Tracked, optics: Optics, name: str) -> list[str]:
    """Report displacements of contact points due to unknown optics, if these dominate the error."""
    moved = np.linalg.norm(optics.displacements(one.fit.contact_point), axis=(0, 2))
    spread = np.sqrt(np.trace(one.fit.contact_covariance, axis1=1, axis2=2))
    if not np.isfinite(moved).any() or np.nanmedian(moved / spread) < _MOST:
        return []
    state = "State the distance of the lenses (--distance, in m; inf for telecentric ones), or c"
    state = "C" if optics.distance is not None else state
    return [
        f"{name}: the cameras are not calibrated, by which contact points are uncertain by "
        f"{1e6 * np.nanmedian(moved):.0f} µm (median; in the covariances, but an object fitted to "
        f"them errs as a whole). {state}alibrate them (vibrissa calibrate, --cameras)."
    ]


def unexplained_frames(misfit: Array) -> Mask:
    """Frames whose traces the rod does not explain, by their misfits; empty if they are few."""
    strange = np.nan_to_num(misfit) > _STRANGE
    return np.asarray(strange & (strange.mean() > _OFTEN))


def remarks_on(
    cameras: Sequence[Camera], series: TraceSeries, length: Length, misfit: Array, name: str
) -> list[str]:
    """Report what is unusual about a tracked whisker."""
    found = []
    gap = usual_gap(cameras, series)
    if gap > _NEAR:
        found.append(
            f"{name}: its base is seen {gap:.1f} pixels from where the other view shows it "
            "(median); with a good calibration it is less than one."
        )
    seen = np.isfinite(series.line[:, :, 0, 0])
    outside = int((seen & (series.ends[:, :, 0] < 0.5)).any(axis=1).sum())
    if outside:
        found.append(
            f"{name}: in {outside} frames a view does not show its base; they are left out."
        )
    strange = int(unexplained_frames(misfit).sum())
    if strange:
        found.append(
            f"{name}: in {strange} frames the bent rod does not explain the traces (trace_misfit "
            f"above {_STRANGE:g}): they are on something else, or its own inertia or a second "
            "contact bends it. The results of these frames are not to be believed."
        )
    if np.isnan(length.sigma):
        found.append(
            f"{name}: its tip is not seen, nor is it bent enough to show its length; it is "
            f"{1e3 * length.value:.1f} mm at least. Its true length is needed to find contacts: "
            "give --length."
        )
    elif length.sigma > 0.0 and not length.seen:
        found.append(
            f"{name}: its tip is too faint to be seen, or outside of the image; as it bends it is "
            f"{1e3 * length.value:.1f} ± {1e3 * length.sigma:.1f} mm long, which is counted in all "
            "covariances."
        )
    return found


def remarks_on_unseen_contacts(one: Tracked, name: str) -> list[str]:
    """Report contacts beyond what is seen of a whisker, as behind an object or off the image."""
    arcs = one.fit.arc_length
    shown = np.linalg.norm(np.diff(one.curves, axis=1), axis=2).sum(axis=1)
    far = _BEYOND * one.length.value
    count, unseen = int(np.isfinite(arcs).sum()), int((arcs > shown + far).sum())
    if not unseen:
        return []
    remedy = "" if one.length.seen else ", or give its length (--length)"
    return [
        f"not sure where {name} touches: in {unseen} of {count} frames in contact that is beyond "
        "what both views show of it, and follows from how the part before it bends. Film more of "
        f"the whisker{remedy}."
    ]


def remarks_on_rest(one: Tracked, name: str) -> list[str]:
    """Report contacts that are too light to be distinguished from errors of the traces."""
    least = one.shape.undetected
    if least <= _COARSE * one.length.value:
        return []
    free, count = int(one.shape.free.sum()), int(np.isfinite(one.shape.deviation).sum())
    return [
        f"{name}: its shapes in the {free} of {count} frames taken to be free of contact differ by "
        f"up to {1e6 * least:.0f} µm (root mean square along it), as traces scatter: contacts that "
        "bend it by less are not found, and their frames counted as free."
    ]


def remarks_on_row(exchanges: int, left_out: int, name: str) -> list[str]:
    """Frames in which a whisker of a row had another one's traces."""
    found = []
    if exchanges:
        found.append(
            f"{name}: in {exchanges} frames its trace was exchanged with a neighbour's, as its "
            "shape and base in both views then are those of the other frames."
        )
    if left_out:
        found.append(
            f"{name}: in {left_out} frames the bent rod does not explain the traces (a misfit "
            f"above {_STRANGE:g}), as where one of them is a neighbour's: they are left out "
            "(confidence 0, status MISSING). Compare traces and video (vibrissa correct)."
        )
    return found


def remarks_on_following(
    cameras: Sequence[Camera], rows: Sequence[Sequence[Trace]], name: str
) -> list[str]:
    """Report views in which a whisker is often lost, or differs from the frame before."""
    counts = [int(doubtful_frames(row).sum()) for row in rows]
    return [
        f"not sure: in {count} of {len(row)} frames {camera.name} loses {name}, or sees its length "
        "jump or a hook in it, as if something else was followed. Compare traces and video "
        "(vibrissa correct)."
        for camera, row, count in zip(cameras, rows, counts, strict=True)
        if count
    ]


def remarks_on_bases(
    cameras: Sequence[Camera],
    shown: Sequence[Sequence[Trace]],
    used: Sequence[Sequence[Trace]],
    name: str,
) -> list[str]:
    """Report views in which a whisker is seen from closer to its base than in the other view."""
    found = []
    for camera, before, after in zip(cameras, shown, used, strict=True):
        cut = [a.length - b.length for a, b in zip(before, after, strict=True) if len(a.line)]
        if cut and np.median(cut) > _NEAR:
            found.append(
                f"{name}: {camera.name} shows it from {np.median(cut):.0f} pixels nearer to its "
                "base on than the other view (median); it is taken to begin where both show it."
            )
    return found


def force_scale_sigma(whisker: Whisker, fur: float) -> float:
    """Common relative error of all forces due to fur of unknown length over the base."""
    at_edge, at_tip = whisker.radius(np.array([0.0, whisker.length]))
    # Forces scale with the fourth power of the radius, which decreases linearly along the whisker.
    return float(4.0 * (1.0 - at_tip / at_edge) / whisker.length * _FUR_KNOWN * fur)


def remarks_on_fur(one: Tracked, fur: float, name: str) -> list[str]:
    """Report the common error of all forces due to fur of unknown length over the base."""
    if fur == 0.0:
        return []
    percent = 100.0 * force_scale_sigma(one.whisker, fur)
    hidden = f"{1e3 * fur:g} ± {1e3 * _FUR_KNOWN * fur:.2g} mm"
    return [
        f"{name}: {hidden} of its base are taken to be hidden by fur; what is not known of that is "
        f"one error of all its forces and moments, {percent:.1f} % (standard deviation), which is "
        "in no covariance. They are those where the fur ends."
    ]


def remarks_on_plane(one: Tracked, name: str) -> list[str]:
    """Report how far a whisker may leave the plane of the only view, and the effect on contacts."""
    tips = one.traces.ends.all(axis=(1, 2)) & np.isfinite(one.curves).all(axis=(1, 2))
    if tips.sum() < _FEWEST:
        return [f"{name}: too few frames show its tip to see whether it leaves the plane."]
    lengths = np.linalg.norm(np.diff(one.curves[tips], axis=1), axis=2).sum(axis=1)
    short, long = np.percentile(lengths, [5.0, 95.0])
    turned = float(np.arccos(short / long))
    seen = f"{name}: it is seen {1e3 * short:.1f} to {1e3 * long:.1f} mm long (5 and 95 % of the "
    if short > (1.0 - _SHORTENED) * long:
        away = np.linalg.norm(one.fit.contact_point - one.fit.position, axis=1)
        deep = np.sin(turned) * float(np.nan_to_num(away).max())
        return [
            f"{seen}frames that show its tip), which does not exclude that it leaves the plane by "
            f"{np.degrees(turned):.0f}°: contact points may be {1e3 * deep:.1f} mm nearer to the "
            "camera or farther from it, which is in no covariance."
        ]
    return [
        f"{seen}frames that show its tip), as if it turned out of the image by up to "
        f"{np.degrees(turned):.0f}°. Contact is then not distinguished from turning, and forces "
        "and contact points of such frames are not to be believed. A second view (or a mirror, "
        "--views) shows it."
    ]


def remarks_on_time(
    cameras: Sequence[Camera], traces: Sequence[Sequence[Trace]], offset: int | None
) -> list[str]:
    """Report cameras that do not seem to be synchronous, and offsets that were found."""
    found = []
    for camera, row in zip(cameras[1:], traces[1:], strict=True):
        shifts, determined = clear_offsets(cameras[0], camera, traces[0], row, offset or 0)
        runs = [shift for shift, _ in groupby(shifts.tolist())]
        listed, names = ", ".join(map(str, runs)), f"{cameras[0].name} and {camera.name}"
        if offset is None and determined:
            found.append(
                f"{names}: the offset that was found is {listed} frames (to within {NEAR}); if it "
                "cannot be, state it (--offset)."
            )
        elif offset is None:
            found.append(
                f"{names}: the views do not determine their offset, and 0 is kept; if they did not "
                "start together, state it (--offset)."
            )
        elif runs != [offset]:
            found.append(
                f"{names} are out of step: with an offset of {listed} "
                f"frames instead of {offset} they agree better. Track with --offset auto; in files "
                "of other trackers, correct the numbers of the frames."
            )
    return found


def usual_gap(cameras: Sequence[Camera], series: TraceSeries) -> float:
    """Typical distance of the base in each view from where all views together locate it, pixels."""
    rows = (series.ends[:, :, 0] > 0.5).all(axis=1)
    if not rows.any():
        return 0.0
    return float(np.median(base_gap(cameras, np.swapaxes(series.line[rows, :, 0], 0, 1))))
