"""What figures and movies of a trial need of its recording, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.plots.chart import nearest_at_rest
from vibrissa.plots.style import Array, Mask

TRIPLET = ("Fx", "MB", "MD")
"""The signals that are drawn, those of the paper."""


@dataclass(frozen=True, eq=False)
class Course:
    """One whisker of a trial, frame by frame; what the recording lacks is None, or NaN.

    Parameters
    ----------
    time : array (n,)
        s.
    touching : array (n,) of bool
        In which frames it is in contact.
    signals : dict of str to array (n,), optional
        F_x, M_B, M_D, SI units; NaN out of contact where they are only known there.
    known : array (n, 3), optional
        Contact points to compare with, whisker frame, m.
    known_as : str
        What these are: "true" or "tracked".
    estimated : array (n, 3), optional
        Contact points estimated from signals, whisker frame, m.
    places : array (n, 3), optional
        Contact points, laboratory frame, m: estimated ones if there are any, else known ones.
    places_as : str
        What these are: "estimated", "tracked" or "true".
    centerline : array (n, k, 3), optional
        The deflected whisker from base to tip, laboratory frame, m.
    traces : tuple of array (n, k, 2)
        The same in the images, view by view, pixels, as far as it was traced.
    position : array (n, 3)
        Of the base, laboratory frame, m.
    rotation : array (n, 3, 3)
        From the whisker's to the laboratory frame.
    frames : array (n, views) of int, optional
        Which frame of each view's video belongs to each time.
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
        """Take points of the laboratory to the whisker's frame, frame by frame.

        Parameters
        ----------
        points : array (n, ..., 3)
            Laboratory frame, m.

        Returns
        -------
        array (n, ..., 3)
            Whisker frame, m.
        """
        shape = (len(self.time),) + (1,) * (points.ndim - 2) + (3,)
        moved = points - self.position.reshape(shape)
        return np.asarray(np.einsum("n...i,nij->n...j", moved, self.rotation))


def course_of(trial: xr.DataTree, whisker: int = 0) -> Course:
    """Take what is drawn out of a recording.

    The groups ``signals``, ``estimates`` and ``truth`` are used as far as they are there. What
    contacts are compared with is the truth, or else the tracked contacts.

    Parameters
    ----------
    trial : DataTree
        A recording, dims time, whisker, ...; SI units.
    whisker : int
        Which one, along the dimension ``whisker``.

    Returns
    -------
    Course
        Of that whisker.

    Raises
    ------
    ValueError
        If there is no such whisker, or the recording has no times or does not say how the base is
        held.
    """
    lacking = [n for n in ("time", "base_position", "base_rotation") if n not in trial.variables]
    if lacking:
        raise ValueError(f"the recording lacks {', '.join(lacking)}")
    groups = {name: _one(trial, name, whisker) for name in ("", "signals", "estimates", "truth")}
    root, signals, estimates, truth = groups.values()
    tracked = "measured" in trial.children
    known = _values(truth, "contact_point_whisker")
    known_as = "true"
    if known is None and tracked:
        known, known_as = _values(root, "contact_point_whisker"), "tracked"
    estimated = _values(estimates, "contact_point_whisker")
    if estimated is None and not tracked:
        estimated = _values(root, "contact_point_whisker")
    places, places_as = _values(estimates, "contact_point"), "estimated"
    if places is None:
        places, places_as = _values(root, "contact_point"), "tracked" if tracked else "estimated"
    if places is None:
        places, places_as = _values(truth, "contact_point"), "true"
    line = _values(root, "centerline")
    order = (signals, estimates, root, truth)
    return Course(
        time=np.asarray(root["time"].values, dtype=np.float64),
        touching=_touching(order, root.sizes["time"]),
        signals=_signals(signals),
        known=known,
        known_as=known_as,
        estimated=estimated,
        places=places,
        places_as=places_as,
        centerline=_values(truth, "centerline") if line is None else line,
        traces=_traces(root, truth),
        position=np.asarray(root["base_position"].values, dtype=np.float64),
        rotation=np.asarray(root["base_rotation"].values, dtype=np.float64),
        frames=root["frame"].values if "frame" in root else None,
        head=_head(root),
    )


def _one(trial: xr.DataTree, name: str, whisker: int) -> xr.Dataset:
    """One whisker of a group; an empty dataset if there is no such group."""
    if name and name not in trial.children:
        return xr.Dataset()
    data = (trial[name] if name else trial).to_dataset()
    count = data.sizes.get("whisker", 1)
    if not 0 <= whisker < count:
        raise ValueError(f"whisker {whisker} was asked for; the recording has {count} of them")
    return data.isel(whisker=whisker) if "whisker" in data.dims else data


def _values(data: xr.Dataset, name: str) -> Array | None:
    """Values over time; None where nothing is known."""
    if name not in data:
        return None
    found = data[name]
    values = found.transpose("time", *(dim for dim in found.dims if dim != "time")).values
    return np.asarray(values, dtype=np.float64) if np.isfinite(values).any() else None


def _signals(data: xr.Dataset) -> dict[str, Array] | None:
    found = {name: _values(data, name) for name in TRIPLET}
    known = {name: values for name, values in found.items() if values is not None}
    return known if len(known) == len(TRIPLET) else None


def _touching(order: tuple[xr.Dataset, ...], count: int) -> Mask:
    """In contact as the first says that knows."""
    for data in order:
        if "in_contact" in data:
            values = data["in_contact"].values.astype(np.float64)
            return np.asarray(np.nan_to_num(values) > 0.5)
    return np.zeros(count, dtype=bool)


def _head(root: xr.Dataset) -> tuple[Array, Array] | None:
    position, rotation = (_values(root, name) for name in ("head_position", "head_rotation"))
    return None if position is None or rotation is None else (position, rotation)


def _traces(root: xr.Dataset, truth: xr.Dataset) -> tuple[Array, ...]:
    """Traces in each view: tracked ones, or else true ones."""
    for data in (root, truth):
        if "trace" in data and "view" in data["trace"].dims:
            return tuple(data["trace"].transpose("view", "time", ..., "image_axis").values)
    return ()


def deflection_angles(course: Course, centerline: ArrayLike) -> Array:
    """Angle by which contacts lie beside the resting whisker.

    Parameters
    ----------
    course : Course
        Of the trial.
    centerline : array_like (k, 3)
        Of the resting whisker, whisker frame, m.

    Returns
    -------
    array (n,)
        Of each frame, rad: its tangent is the distance of the contact from the resting whisker over
        the arc length of the point of it that is nearest; NaN without contact.
    """
    angles = np.full(len(course.time), np.nan)
    if course.places is None:
        return angles
    own = course.at_base(course.places)
    rows = np.isfinite(own).all(axis=1)
    if rows.any():
        angles[rows] = np.arctan2(*nearest_at_rest(own[rows], np.asarray(centerline, np.float64)))
    return angles


def spherical(points: Array) -> Array:
    """Give the spherical coordinates of contact points."""
    x, y, z = np.moveaxis(points, -1, 0)
    away = np.hypot(x, y)
    return np.stack([np.hypot(away, z), np.arctan2(y, x), np.arctan2(z, away)], axis=-1)
