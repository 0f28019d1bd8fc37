"""Maps as NetCDF files: for a person in the root, for the solver in the group ``chart``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from vibrissa.io import COMPRESSED, kind_of, naming, read_tree, write_netcdf
from vibrissa.rod import Fold, StableSet, discretize
from vibrissa.whisker import Whisker

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

_KIND = "vibrissa contact map"
_NODE = ("station", "bearing", "load")


def save_map(contact_map: ContactMap, path: Path) -> None:
    """Write a map; a file that exists is replaced only when the new one is complete."""
    chart = contact_map.chart
    raw = xr.Dataset(
        {
            "stations": ("station", chart.stations),
            "bearings": ("bearing", chart.bearings),
            "loads": ("load", chart.loads),
            "bounds": ("bound", chart.fold.bounds),
            "fold": (("station", "bearing", "derivative"), chart.fold.log_force),
            "folded": (("station", "bearing"), chart.folded),
            "contacts": ((*_NODE, "unknown"), chart.contacts),
            "values": ((*_NODE, "value"), chart.values),
            "tangents": ((*_NODE, "value", "unknown"), chart.tangents),
            "frames": ((*_NODE, "unknown", "coordinate"), chart.frames),
        },
        attrs={"description": "non-dimensional: lengths over L, forces over EI/L²"},
    )
    for name, variable in raw.data_vars.items():
        variable.attrs |= {"units": "1", "long_name": f"chart: {name}, non-dimensional"}
    root = contact_map.to_dataset()
    root.attrs |= {"kind": _KIND, "steps": contact_map.steps}
    groups = {"/": root, "whisker": contact_map.whisker.to_dataset(), "chart": raw}
    if contact_map.grid is not None:
        groups["grid"] = contact_map.grid
    tree = xr.DataTree.from_dict(groups)
    grid = [] if contact_map.grid is None else list(map(str, contact_map.grid.data_vars))
    write_netcdf(path, tree, {"/grid": dict.fromkeys(grid, COMPRESSED)})


def load_map(path: Path) -> ContactMap:
    """Read a map; raise a ValueError if the file is not one."""
    kind = kind_of(path)
    if kind != _KIND:
        raise ValueError(f"{path} holds {kind or 'data of another kind'}, not a contact map")
    tree = read_tree(path)
    missing = [name for name in ("whisker", "chart") if name not in tree.children]
    if missing:
        raise ValueError(f"{path} lacks the group {' and '.join(missing)} of a contact map")
    with naming(path, "a contact map"):
        return _from_tree(tree)


def _from_tree(tree: xr.DataTree) -> ContactMap:
    from vibrissa.contacts.contact_map import ContactMap

    whisker = Whisker.from_dataset(tree["whisker"].to_dataset())
    steps = int(tree.attrs["steps"])
    raw = {str(name): np.asarray(v) for name, v in tree["chart"].to_dataset().variables.items()}
    chart = StableSet(
        discretization=discretize(whisker, steps),
        stations=raw["stations"],
        bearings=raw["bearings"],
        loads=raw["loads"],
        fold=Fold(raw["bounds"], np.ascontiguousarray(raw["fold"])),
        contacts=raw["contacts"],
        values=raw["values"],
        tangents=raw["tangents"],
        frames=raw["frames"],
        folded=raw["folded"].astype(bool),
    )
    grid = None
    if "grid" in tree.children:
        # Files keep a coordinate of the root only there.
        grid = tree.children["grid"].to_dataset(inherit=False)
        grid = grid.assign_coords(space=["x", "y", "z"])
    return ContactMap(whisker, chart, steps, grid)
