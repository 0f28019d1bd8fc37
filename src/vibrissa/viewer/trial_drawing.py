"""A moment of a trial as things to look at."""

from __future__ import annotations

import numpy as np
import xarray as xr

from vibrissa.contour import CylinderFit, SphereFit, shape_from_dataset, surface_grid
from vibrissa.objects import Surface, objects_datasets
from vibrissa.plots.things import object_surface
from vibrissa.quantities import to_display
from vibrissa.viewer.bend_drawing import arrow, whisker_body
from vibrissa.viewer.bending import force_scale
from vibrissa.viewer.drawing import (
    CONTACT,
    FIT,
    OBJECT,
    Array,
    Body,
    Bytes,
    Cloud,
    Drawing,
    Ints,
    Thing,
)
from vibrissa.viewer.meshes import cylinder, ellipsoid, sheet
from vibrissa.viewer.watching import Watched

POINTS = 4000
"""Most contact points that are drawn."""

_COLOURS = np.array(
    [CONTACT, (0, 114, 178), (204, 121, 167), (0, 158, 115), (230, 159, 0), (86, 180, 233)]
)


def extent(trial: Watched) -> tuple[Array, float]:
    """Middle, mm, and size, mm, of where whiskers go."""
    points = trial.lines.reshape(-1, 3)
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    return _mm(0.5 * (low + high)), float(_mm(np.linalg.norm(high - low)))


def moment_drawing(trial: Watched, frame: int, exaggeration: float) -> Drawing:
    """Draw whiskers, forces and contacts of one frame."""
    out: dict[str, Thing] = {}
    for i, whisker in enumerate(trial.whiskers):
        line = trial.lines[frame, i]
        if not np.isfinite(line).all():
            continue
        out[f"whisker {i}"] = whisker_body(whisker, line, exaggeration)
        at, force = trial.contacts[frame, i], trial.forces[frame, i]
        if not np.isfinite(at).all():
            continue
        radius = float(_mm(0.012 * whisker.length))
        vertices, faces = ellipsoid(_mm(at), radius * np.eye(3))
        out[f"contact {i}"] = Body(vertices, faces, CONTACT)
        size = float(np.linalg.norm(force))
        if np.isfinite(size) and size > 0.0:
            reach = 0.3 * whisker.length * np.sqrt(size / force_scale(whisker))
            start, thickness = at - reach * force / size, float(_mm(0.006 * whisker.length))
            out[f"force {i}"] = arrow(start, at, thickness)
    return out


def touched(trial: Watched, frame: int) -> Drawing:
    """All contact points up to a frame, each whisker's in its own colour."""
    points, colours = trial.contacts[: frame + 1], _whisker_colours(trial)
    known = np.isfinite(points).all(axis=-1)
    which = np.nonzero(known)[1]
    chosen = points[known]
    step = max(1, int(np.ceil(trial.felt.sum() / POINTS)))
    if not chosen.size:
        return {}
    size = float(_mm(0.011 * trial.whiskers[0].length))
    return {"contacts": Cloud(_mm(chosen[::step]), colours[which[::step]], size)}


def _whisker_colours(trial: Watched) -> Bytes:
    count = np.arange(len(trial.whiskers)) % len(_COLOURS)
    return np.asarray(_COLOURS[count], dtype=np.uint8)


def surroundings(trial: Watched, objects: bool = True, fit: bool = True) -> Drawing:
    """What stands still: objects and the shape fitted to the contacts."""
    middle, size = extent(trial)
    near = _known(trial)
    centre = np.mean(near, axis=0) if near.size else middle / to_display("length", 1.0)
    out: dict[str, Thing] = {}
    if objects:
        for i, thing in enumerate(trial.objects):
            out[f"object {i}"] = object_body(thing, 0.6 * size, _mm(centre))
    if fit and trial.contour is not None:
        body = fitted_body(trial.contour, near)
        if body is not None:
            out["fit"] = Body(_mm(body[0]), body[1], FIT, 0.4, "double")
    return out


def object_body(thing: Surface, extent: float, near: Array) -> Body:
    """An object; what has no end is shown within a cube, mm wide, about a place (3,), mm."""
    half = 0.5 * extent
    (held,) = objects_datasets([thing]).values()
    vertices, faces = object_surface(held, np.stack([near - half, near + half], axis=1))
    return Body(vertices, faces, OBJECT, 0.55, "double")


def _known(trial: Watched) -> Array:
    points = trial.contacts.reshape(-1, 3)
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def fitted_body(contour: xr.Dataset, near: Array) -> tuple[Array, Ints] | None:
    """Vertices, m, and triangles of a fitted shape; None for what has no picture."""
    try:
        shape = shape_from_dataset(contour)
    except ValueError:
        return None
    if isinstance(shape, SphereFit):
        return ellipsoid(shape.origin, shape.radius * np.eye(3), 48)
    if not near.size:
        return None
    if isinstance(shape, CylinderFit):
        along = (near - shape.origin) @ shape.axis
        middle = shape.origin + 0.5 * (along.min() + along.max()) * shape.axis
        length = 1.3 * float(np.ptp(along)) + 2.0 * shape.radius
        return cylinder(middle, shape.axis, shape.radius, length)
    grid = surface_grid(shape, near)["surface_grid_point"].to_numpy()
    return sheet(grid)


def _mm(values: object) -> Array:
    return to_display("length", np.asarray(values, dtype=np.float64))
