"""Objects as labelled datasets, and back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from vibrissa.objects.mesh import Mesh
from vibrissa.objects.solids import Box, Peg, Plane, Sphere
from vibrissa.objects.surface import Surface
from vibrissa.quantities import attributes

_FIELDS: dict[str, tuple[type, dict[str, str]]] = {
    "peg": (
        Peg,
        {"origin": "object_position", "axis": "object_axis", "radius": "object_radius"},
    ),
    "sphere": (Sphere, {"origin": "object_position", "radius": "object_radius"}),
    "plane": (Plane, {"origin": "object_position", "normal": "object_axis"}),
    "box": (
        Box,
        {
            "origin": "object_position",
            "size": "object_size",
            "rotation": "object_rotation",
            "edge_radius": "object_edge_radius",
        },
    ),
    "mesh": (
        Mesh,
        {
            "vertices": "object_vertices",
            "faces": "object_faces",
            "resolution": "object_resolution",
        },
    ),
}
_STIFFNESS = {"stiffness": "object_stiffness"}
_DIMS: dict[str, tuple[str, ...]] = {
    "object_position": ("space",),
    "object_axis": ("space",),
    "object_size": ("object_axes",),
    "object_rotation": ("space", "object_axes"),
    "object_vertices": ("vertex", "space"),
    "object_faces": ("triangle", "corner"),
}


def objects_datasets(objects: Sequence[Surface]) -> dict[str, xr.Dataset]:
    """Write objects as datasets."""
    return {str(i): _dataset(thing) for i, thing in enumerate(objects)}


def _dataset(thing: Surface) -> xr.Dataset:
    for kind, (known, fields) in _FIELDS.items():
        if isinstance(thing, known):
            rows = {
                name: xr.Variable(
                    _DIMS.get(name, ()), np.asarray(getattr(thing, field)), attributes(name)
                )
                for field, name in (fields | _STIFFNESS).items()
            }
            about = {"kind": kind, "reference_frame": "laboratory"}
            return xr.Dataset(rows, {"space": list("xyz")}, about)
    raise ValueError(f"{thing!r} is none of {', '.join(_FIELDS)}, and cannot be written")


def object_from_dataset(dataset: xr.Dataset) -> Surface:
    """Restore an object from its dataset."""
    kind = dataset.attrs.get("kind")
    if kind not in _FIELDS:
        raise ValueError(f"the object is of kind {kind!r}; it must be one of {', '.join(_FIELDS)}")
    known, fields = _FIELDS[kind]
    missing = sorted({*fields.values(), *_STIFFNESS.values()} - set(dataset.data_vars))
    if missing:
        raise ValueError(f"a {kind} in a file lacks {', '.join(missing)}")
    values = {field: dataset[name].values for field, name in (fields | _STIFFNESS).items()}
    restored: Surface = known(**values)
    return restored
