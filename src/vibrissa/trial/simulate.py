"""A trial, frame by frame: the base moves, the whisker bends, slips and springs free.

Each frame goes on from the one before: the peg, seen from the base, moves a little, and the contact
slides along with it on the stable branch and on its side of the peg. Where that branch ends the
whisker has slipped off; it springs back to rest, clear of the peg (or against it, wherever the peg
stands in the way of rest), and meets it next from the side where it then is. A whisker is
therefore never pulled through a peg. Quasi-static, without friction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.rod import Deflection, PegContact, deflect
from vibrissa.status import Status
from vibrissa.trial.motion import Motion
from vibrissa.trial.objects import Peg
from vibrissa.trial.recording import trial_recording
from vibrissa.whisker import Whisker

NODES = 33
"""Points of the recorded centrelines."""

Array = NDArray[np.float64]

Progress = Callable[[int, int], None]
"""Called with the number of frames done and of all frames."""

_SLIPPED = (Status.BEYOND_FOLD, Status.BEYOND_TIP)


def simulate(
    whisker: Whisker,
    motion: Motion,
    peg: Peg,
    *,
    nodes: int = NODES,
    progress: Progress | None = None,
) -> xr.DataTree:
    """Simulate a trial of one whisker against one peg.

    Parameters
    ----------
    whisker : Whisker
        That whisks.
    motion : Motion
        Of its base.
    peg : Peg
        In the laboratory.
    nodes : int
        Points of the recorded centrelines, equally spaced in arc length.
    progress : callable, optional
        Told after every frame how many are done, of how many.

    Returns
    -------
    xarray.DataTree
        A recording (`vibrissa.trial.recording`): what a perfect sensor at the base reads, where the
        base is, and everything else in the group ``truth``.
    """
    origins, axes = peg.in_whisker_frame(motion.base_rotation, motion.base_position)
    frames: list[Deflection] = []
    latest: Deflection | None = None
    for i, (origin, axis) in enumerate(zip(origins, axes, strict=True)):
        bent = _next(whisker, latest, PegContact(origin, axis, peg.radius))
        frames.append(bent)
        # Of a frame without an answer nothing is known, so the next goes on from the one before.
        if Status(int(bent.status)).ok:
            latest = bent
        if progress is not None:
            progress(i + 1, len(motion))
    return trial_recording(whisker, motion, peg, _stacked(frames, origins, axes, peg), nodes)


def _next(whisker: Whisker, before: Deflection | None, load: PegContact) -> Deflection:
    """Bend the whisker in one frame, going on from an earlier one."""
    if before is None:
        return deflect(whisker, load)
    moved = deflect(whisker, PegContact(load.origin, load.axis, load.radius, start=before))
    if Status(int(moved.status)) in _SLIPPED:
        return deflect(whisker, load)
    return moved


def _stacked(frames: Sequence[Deflection], origins: Array, axes: Array, peg: Peg) -> Deflection:
    """Make one deflection of many."""
    return Deflection(
        whisker=frames[0].whisker,
        load=PegContact(origins, axes, peg.radius),
        force=np.array([f.force for f in frames]),
        moment=np.array([f.moment for f in frames]),
        contact_point=np.array([f.contact_point for f in frames]),
        arc_length=np.array([f.arc_length for f in frames]),
        contact_force=np.array([f.contact_force for f in frames]),
        residual=np.array([f.residual for f in frames]),
        status=np.array([f.status for f in frames]),
        steps=frames[0].steps,
    )
