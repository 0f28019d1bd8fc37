"""An array of whiskers as labelled datasets, and back.

/              whisker, node, space: side, row, column, base_position, base_rotation, angles,
               length, base_radius, tip_radius, centerline; head's frame
/whiskers/0    the first whisker along the dimension ``whisker``, without loss; and so on
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from vibrissa.quantities import attributes
from vibrissa.whisker.emergence import angles_of

if TYPE_CHECKING:
    from vibrissa.whisker.identity import Identity
    from vibrissa.whisker.model import Whisker

KIND = "vibrissa whisker array"
"""What the attribute ``kind`` of the tree says."""

NODES = 33
"""Points of the centrelines that come along."""

_OF_HEAD = "In the head's frame: origin at the snout, x to the animal's right, y forward, z up."


def array_tree(whiskers: Iterable[Whisker], identities: Iterable[Identity]) -> xr.DataTree:
    """Write an array of whiskers."""
    them, which = list(whiskers), list(identities)
    rotation = np.stack([w.pose.rotation for w in them])
    angles = angles_of(rotation)
    line = np.stack([w.pose.to_source(w.centerline(NODES)) for w in them])
    framed: dict[str, tuple[tuple[str, ...], Any]] = {
        "base_position": (("whisker", "space"), np.stack([w.pose.origin for w in them])),
        "base_rotation": (("whisker", "space", "whisker_axis"), rotation),
        "base_azimuth": (("whisker",), angles[:, 0]),
        "base_elevation": (("whisker",), angles[:, 1]),
        "base_roll": (("whisker",), angles[:, 2]),
        "centerline": (("whisker", "node", "space"), line),
    }
    variables = {
        name: xr.Variable(
            dims, values, attributes(name) | {"description": _OF_HEAD, "reference_frame": "head"}
        )
        for name, (dims, values) in framed.items()
    }
    for name in ("length", "base_radius", "tip_radius"):
        values = np.array([getattr(w, name) for w in them])
        variables[name] = xr.Variable("whisker", values, attributes(name))
    labels = {
        "whisker": [w.name for w in them],
        "side": ("whisker", [one.side for one in which]),
        "row": ("whisker", [one.row for one in which]),
        "column": ("whisker", [one.column for one in which]),
        "space": list("xyz"),
        "whisker_axis": list("xyz"),
    }
    groups: dict[str, xr.Dataset] = {"/": xr.Dataset(variables, labels, {"kind": KIND})}
    for i, whisker in enumerate(them):
        groups[f"/whiskers/{i}"] = whisker.to_dataset().drop_dims("node")
    return xr.DataTree.from_dict(groups)


def whiskers_of(tree: xr.DataTree) -> list[Whisker]:
    """Make the whiskers of a tree again."""
    from vibrissa.whisker.model import Whisker

    kind = tree.attrs.get("kind")
    if kind != KIND or "whiskers" not in tree.children:
        raise ValueError(f"this holds {kind or 'data of another kind'}, not an array of whiskers")
    own = tree.children["whiskers"].children
    return [Whisker.from_dataset(own[i].to_dataset(inherit=False)) for i in sorted(own, key=int)]
