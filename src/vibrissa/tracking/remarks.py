"""What is to be known of tracked whiskers before they are believed.

What makes results wrong without any sign in them is looked for, and said in a sentence each, with
what to do: views that do not show the same, cameras out of step, ends that are not seen.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras.camera import Camera
from vibrissa.tracking.begin import base_gap
from vibrissa.tracking.length import Length
from vibrissa.tracking.sight import Sight
from vibrissa.tracking.timing import better_offset
from vibrissa.tracking.trace import Trace

Array = NDArray[np.float64]

_NEAR = 2.0
_FAR = 10.0
"""Pixels by which bases seen by several views miss each other: more than usual; not the same."""

_STRANGE, _OFTEN = 2.0, 0.05
"""Misfit that is not usual, and the share of the frames with it that is worth a sentence."""

_SHARE = 0.03
"""The same as a share of the whisker's length in the images."""


def check_views(cameras: Sequence[Camera], sight: Sight, name: str) -> None:
    """Make sure that views show one whisker."""
    gap = _gap(cameras, sight)
    lengths = np.linalg.norm(np.diff(sight.line, axis=2), axis=3).sum(axis=2)
    allowed = max(_FAR, _SHARE * float(np.nanmax(lengths, initial=0.0)))
    if gap > allowed:
        raise ValueError(
            f"the views do not show one whisker: where they see the base of {name}, their lines of "
            f"sight pass each other by {gap:.0f} pixels (median). Say where it begins in each view "
            "(--base), and check the order of the videos and the cameras' calibration."
        )


def remarks_on(
    cameras: Sequence[Camera], sight: Sight, length: Length, misfit: Array, name: str
) -> list[str]:
    """Say what is unusual about a tracked whisker."""
    found = []
    gap = _gap(cameras, sight)
    if gap > _NEAR:
        found.append(
            f"{name}: its base is seen {gap:.1f} pixels from where the other view says (median); "
            "with a good calibration it is less than one."
        )
    seen = np.isfinite(sight.line[:, :, 0, 0])
    outside = int((seen & (sight.ends[:, :, 0] < 0.5)).any(axis=1).sum())
    if outside:
        found.append(
            f"{name}: in {outside} frames a view does not show its base; they are left out."
        )
    strange = int((np.nan_to_num(misfit) > _STRANGE).sum())
    if strange > _OFTEN * len(misfit):
        found.append(
            f"{name}: in {strange} frames the bent rod does not explain the traces (trace_misfit "
            f"above {_STRANGE:g}): they are on something else, or its own inertia or a second "
            "contact bends it. What is said of these frames is not to be believed."
        )
    if np.isnan(length.sigma):
        found.append(
            f"{name}: its tip is not seen, nor is it bent enough to tell its length; it is "
            f"{1e3 * length.value:.1f} mm at least, and contacts are off if it is more: give "
            "--whisker."
        )
    elif length.sigma > 0.0:
        found.append(
            f"{name}: its tip is too faint to be seen, or outside of the image; as it bends it is "
            f"{1e3 * length.value:.1f} ± {1e3 * length.sigma:.1f} mm long, which is counted in all "
            "covariances."
        )
    return found


def remarks_on_time(
    cameras: Sequence[Camera], traces: Sequence[Sequence[Trace]], offset: int | None
) -> list[str]:
    """Say whether cameras seem to be out of step."""
    if offset is None:
        return []
    found = []
    for camera, row in zip(cameras[1:], traces[1:], strict=True):
        shifts = better_offset(cameras[0], camera, traces[0], row, offset)
        if shifts.size:
            listed = ", ".join(map(str, shifts))
            found.append(
                f"{cameras[0].name} and {camera.name} are out of step: with an offset of {listed} "
                f"frames instead of {offset} they agree better. Track with --offset auto."
            )
    return found


def _gap(cameras: Sequence[Camera], sight: Sight) -> float:
    """Usual distance of the base from where the views together see it, pixels."""
    rows = (sight.ends[:, :, 0] > 0.5).all(axis=1)
    if not rows.any():
        return 0.0
    return float(np.median(base_gap(cameras, np.swapaxes(sight.line[rows, :, 0], 0, 1))))
