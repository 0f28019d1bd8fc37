"""A trial, frame by frame: the base moves, the whisker bends, slips and springs free.

Each frame goes on from the one before: the objects, seen from the base, move a little, and the
contact sticks or slides along on the stable branch (:mod:`vibrissa.rod.surfaces`). Where that
branch ends the whisker has slipped off; it springs back to rest, clear of the object (or against
it, wherever it stands in the way of rest), and meets it next from the side where it then is. A
whisker is therefore never pulled through a peg. Quasi-static.

One contact is simulated at a time, that with the object met first. Where the bent whisker reaches
into another object, or into the same one elsewhere, the truth says so (``second_contact``) and how
far (``overlap``): there the wrench lacks what the second contact would add.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.rod.surface import Surface
from vibrissa.rod.surfaces import SurfaceDeflection, follow_surfaces
from vibrissa.status import Status
from vibrissa.trial.motion import Motion
from vibrissa.trial.recording import trial_recording
from vibrissa.whisker import Whisker

NODES = 33
"""Points of the recorded centrelines."""

_LOOK_AT = 129
"""Points along the whisker at which a second contact is looked for."""

_ASIDE = 0.03
"""How far from the contact another one of the same object is one, as a share of the length."""

_FRAMES_AT_ONCE = 512

Array = NDArray[np.float64]

Progress = Callable[[int, int], None]
"""Called with the number of frames done and of all frames."""


def simulate(
    whisker: Whisker,
    motion: Motion,
    objects: Surface | Sequence[Surface],
    *,
    friction: float = 0.0,
    nodes: int = NODES,
    progress: Progress | None = None,
) -> xr.DataTree:
    """Simulate a trial of one whisker among objects.

    Parameters
    ----------
    whisker : Whisker
        That whisks.
    motion : Motion
        Of its base.
    objects : Peg, Sphere, Plane, Box, Mesh or a sequence of them
        In the laboratory. The one met first holds the whisker.
    friction : float
        Coulomb's coefficient between whisker and objects.
    nodes : int
        Points of the recorded centrelines, equally spaced in arc length.
    progress : callable, optional
        Told after every frame how many are done, of how many.

    Returns
    -------
    xarray.DataTree
        A recording (`vibrissa.trial.recording`): what a perfect sensor at the base reads, where the
        base is, and everything else in the group ``truth``.

    Raises
    ------
    ValueError
        If the friction is negative.
    """
    solids = list(objects) if isinstance(objects, Sequence) else [objects]
    found = follow_surfaces(
        whisker,
        solids,
        motion.base_rotation,
        motion.base_position,
        friction=friction,
        progress=progress,
    )
    touch = "frictionless" if friction == 0.0 else f"friction {friction:g}"
    return trial_recording(
        whisker,
        motion,
        solids,
        found,
        _overlap(whisker, motion, solids, found),
        nodes,
        f"simulated: quasi-static, {touch}",
    )


def _overlap(
    whisker: Whisker, motion: Motion, solids: Sequence[Surface], found: SurfaceDeflection
) -> Array:
    """How far (n,) the bent whisker reaches into objects away from its contact, m."""
    bent, rotation, position = found.bent, motion.base_rotation, motion.base_position
    s = np.linspace(0.0, whisker.length, _LOOK_AT)
    radius = whisker.radius(s)
    deepest = np.zeros(len(motion))
    # A whisker at rest was looked at when it was found to be free.
    touching = np.flatnonzero(np.isin(bent.status, (Status.OK, Status.TIP_CONTACT)))
    lines = bent.centerline(_LOOK_AT)
    for first in range(0, touching.size, _FRAMES_AT_ONCE):
        rows = touching[first : first + _FRAMES_AT_ONCE]
        line = np.einsum("tij,tkj->tki", rotation[rows], lines[rows]) + position[rows, None]
        beside = np.abs(s - bent.arc_length[rows, None]) < _ASIDE * whisker.length
        for i, solid in enumerate(solids):
            gap = solid.signed_distance(line) - radius
            gap[beside & (found.surface[rows, None] == i)] = np.inf
            deepest[rows] = np.maximum(deepest[rows], -gap.min(axis=1))
    return deepest
