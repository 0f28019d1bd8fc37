"""One whisker of a recorded trial as plain arrays, frame by frame, for drawing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.numerics import Array, Mask
from vibrissa.recording import Group, Recording
from vibrissa.scene.solids import nearest_at_rest

TRIPLET = ("Fx", "MB", "MD")
"""Signals that are drawn, those of the paper."""


@dataclass(frozen=True, eq=False)
class Course:
    """One whisker of a trial, frame by frame; None or NaN where the recording lacks data.

    Parameters
    ----------
    time : array (n,)
        Time of each frame, s.
    touching : array (n,) of bool
        Frames in contact.
    signals : dict of str to array (n,), optional
        F_x, M_B, M_D, SI units; NaN out of contact if they are known in contact only.
    known : array (n, 3), optional
        Contact points for comparison, whisker frame, m.
    known_as : str
        Kind of the known points: "true" or "tracked".
    estimated : array (n, 3), optional
        Contact points estimated from signals, whisker frame, m.
    places : array (n, 3), optional
        Contact points, laboratory frame, m: estimated ones if there are any, else known ones.
    places_as : str
        Kind of these points: "estimated", "tracked" or "true".
    centerline : array (n, k, 3), optional
        Deflected whisker from base to tip, laboratory frame, m.
    traces : tuple of array (n, k, 2)
        Traced part of the deflected whisker in the images, view by view, pixels.
    position : array (n, 3)
        Position of the base, laboratory frame, m.
    rotation : array (n, 3, 3)
        Rotation from the whisker's to the laboratory frame.
    frames : array (n, views) of int, optional
        Frame number of each view's video at each time.
    head : tuple of array (n, 3) and array (n, 3, 3), optional
        Position of the head, laboratory frame, m, and rotation from its frame to the laboratory's.
    """

    time: Array
    touching: Mask
    signals: dict[str, Array] | None
    known: Array | None
    known_as: str
    estimated: Array | None
    places: Array | None
    places_as: str
    centerline: Array | None
    traces: tuple[Array, ...]
    position: Array
    rotation: Array
    frames: Array | None
    head: tuple[Array, Array] | None

    def at_base(self, points: Array) -> Array:
        """Transform points from the laboratory to the whisker frame, frame by frame.

        Parameters
        ----------
        points : array (n, ..., 3)
            Points, laboratory frame, m.

        Returns
        -------
        array (n, ..., 3)
            Points in the whisker frame, m.
        """
        shape = (len(self.time),) + (1,) * (points.ndim - 2) + (3,)
        moved = points - self.position.reshape(shape)
        return np.asarray(np.einsum("n...i,nij->n...j", moved, self.rotation))


def course_of(trial: xr.DataTree, whisker: int = 0) -> Course:
    """Extract what is drawn from a recording.

    The groups ``signals``, ``estimates`` and ``truth`` are used if they exist. Contacts are
    compared with the truth, or else with the tracked contacts.

    Parameters
    ----------
    trial : DataTree
        Recording with dims time, whisker, ...; SI units.
    whisker : int
        Index of the whisker.

    Returns
    -------
    Course
        Data of that whisker.
    """
    lacking = [n for n in ("time", "base_position", "base_rotation") if n not in trial.variables]
    if lacking:
        raise ValueError(f"the recording lacks {', '.join(lacking)}")
    found = (Recording(trial).find(name) for name in ("", "signals", "estimates", "truth"))
    nothing = Group(xr.Dataset())
    root, signals, estimates, truth = (
        nothing if each is None else each.whisker(whisker) for each in found
    )
    tracked = "measured" in trial.children
    known, known_as = truth.known("contact_point_whisker"), "true"
    if known is None and tracked:
        known, known_as = root.known("contact_point_whisker"), "tracked"
    estimated = estimates.known("contact_point_whisker")
    if estimated is None and not tracked:
        estimated = root.known("contact_point_whisker")
    places, places_as = estimates.known("contact_point"), "estimated"
    if places is None:
        places, places_as = root.known("contact_point"), "tracked" if tracked else "estimated"
    if places is None:
        places, places_as = truth.known("contact_point"), "true"
    line = root.known("centerline")
    traced = next((data["trace"] for data in (root, truth) if "trace" in data), None)
    nowhere = np.zeros(root.data.sizes["time"], dtype=bool)
    stated = (
        each["in_contact"] for each in (signals, estimates, root, truth) if "in_contact" in each
    )
    return Course(
        time=np.asarray(root.data["time"].values, dtype=np.float64),
        touching=next(stated, nowhere),
        signals=_signals(signals),
        known=known,
        known_as=known_as,
        estimated=estimated,
        places=places,
        places_as=places_as,
        centerline=truth.known("centerline") if line is None else line,
        traces=() if traced is None else tuple(np.swapaxes(traced, 0, 1)),
        position=root["base_position"],
        rotation=root["base_rotation"],
        frames=root.get("frame"),
        head=_head(root),
    )


def _signals(data: Group) -> dict[str, Array] | None:
    """Signals of the triplet, if all are known."""
    found = {name: data.known(name) for name in TRIPLET}
    known = {name: values for name, values in found.items() if values is not None}
    return known if len(known) == len(TRIPLET) else None


def _head(root: Group) -> tuple[Array, Array] | None:
    """Position and rotation of the head, if known."""
    position, rotation = (root.known(name) for name in ("head_position", "head_rotation"))
    return None if position is None or rotation is None else (position, rotation)


def deflection_angles(course: Course, centerline: ArrayLike) -> Array:
    """Angles (n,) at the base between contacts and a resting whisker (k, 3), m; NaN if free.

    The tangent is the distance from the resting whisker over the arc length of its closest point.
    """
    angles = np.full(len(course.time), np.nan)
    if course.places is None:
        return angles
    own = course.at_base(course.places)
    rows = np.isfinite(own).all(axis=1)
    if rows.any():
        angles[rows] = np.arctan2(*nearest_at_rest(own[rows], np.asarray(centerline, np.float64)))
    return angles
