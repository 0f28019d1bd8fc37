"""Recordings as NetCDF-4 files with groups, without loss.

Floats are stored exactly; arrays are compressed. Any reader of NetCDF or HDF5 can open the files;
groups and variables are described by their attributes and in :mod:`vibrissa.recording`.

In memory every whisker has its own group, ``/whiskers/0``, ``/whiskers/1``, … The time to read or
write a file depends on the number of variables rather than on its size: sixty whiskers of fourteen
variables each would take ten seconds. In files, two or more whiskers are therefore stacked in one
group ``/whiskers`` along the dimension ``whisker``, with text variables for their individual
attributes (name, notes). If whiskers differ in size along a dimension, the shorter ones are padded
with NaN, and a variable ``size_of_DIMENSION`` contains the true sizes.

Whiskers that cannot be stacked keep their own groups, as do those of older files.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from vibrissa.deferred import xr
from vibrissa.io.netcdf import COMPRESSED, naming, read_tree, write_netcdf
from vibrissa.quantities import QUANTITIES, unit_fault
from vibrissa.whisker import Whisker

GROUP = "whiskers"

RECORDING_KIND = "vibrissa recording"  # value of the attribute ``kind`` of a recording
_SMALLEST = 1000
# Order of dimensions of variables over frames, and groups that have none of these.
_DIMS = (
    *("time", "whisker", "error", "view", "channel", "pose", "node", "component", "pose_", ...),
    *("space", "image_axis", "component_", "whisker_axis", "head_axis", "space_", "space_2"),
)
_WITHOUT_FRAMES = {GROUP, "cameras", "objects"}


def save_recording(path: str | PathLike[str], recording: xr.DataTree) -> None:
    """Write a recording.

    Parameters
    ----------
    path : str or path
        Path, usually with the ending ``.nc``; an existing file is replaced once the new one is
        complete.
    recording : xarray.DataTree
        Recording, with the attribute ``kind``.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    ValueError
        If the tree is not a recording.
    """
    if recording.attrs.get("kind") != RECORDING_KIND:
        kind = recording.attrs.get("kind", "nothing")
        raise ValueError(
            f"this is not a recording: its attribute kind is {kind!r}, not {RECORDING_KIND!r}"
        )
    written = stacked_whiskers(recording)
    encoding = {
        group.path: {
            str(name): COMPRESSED
            for name, variable in group.to_dataset(inherit=False).data_vars.items()
            if variable.dtype.kind in "fiub" and variable.size >= _SMALLEST
        }
        for group in written.subtree
    }
    write_netcdf(path, written, encoding)


def load_recording(path: str | PathLike[str]) -> xr.DataTree:
    """Read a recording.

    Parameters
    ----------
    path : str or path
        NetCDF file that `save_recording` wrote.

    Returns
    -------
    xarray.DataTree
        Recording, in memory; dimensions are in the usual order, whatever their order in the file.
    """
    path = Path(path)
    tree = read_tree(path, RECORDING_KIND, "a recording")
    with naming(path, "a recording"):
        tree = separate_whiskers(tree)
        for group in tree.children[GROUP].children.values() if GROUP in tree.children else ():
            Whisker.from_dataset(group.to_dataset(inherit=False))
        check_units(tree)
    for node in (tree, *tree.children.values()):
        if node.name not in _WITHOUT_FRAMES:
            data = node.to_dataset(inherit=False)
            node.dataset = data.map(_in_order, keep_attrs=True)
    return tree


def _in_order(variable: xr.DataArray) -> xr.DataArray:
    """Variable with its dimensions in the usual order."""
    return variable.transpose(
        *sorted(variable.dims, key=lambda dim: _DIMS.index(dim if dim in _DIMS else ...))
    )


def check_units(tree: xr.DataTree) -> None:
    """Raise ValueError for units in a file that are not SI units; warn if units are missing."""
    faults, unstated = [], set()
    for group in tree.subtree:
        for name, variable in group.to_dataset(inherit=False).variables.items():
            if (quantity := QUANTITIES.get(str(name).removeprefix("unfiltered_"))) is None:
                continue
            if not variable.attrs.get("units"):
                unstated |= {str(name)} if quantity.unit != "1" else set()
            elif fault := unit_fault(str(name), variable.attrs["units"]):
                faults.append(f"{group.path.strip('/')} {fault}".strip())
    if faults:
        raise ValueError(f"the recording cannot be used: {'; '.join(faults)}")
    if unstated:
        warnings.warn(
            f"the recording states no units of {', '.join(sorted(unstated))}; SI units are assumed",
            stacklevel=3,
        )


_WHISKER = "whisker"
_OWN = "attributes_of_each"
_SIZE = "size_of_"


def stacked_whiskers(tree: xr.DataTree) -> xr.DataTree:
    """Stack the whiskers of a tree in one group, if possible."""
    group = tree.children.get(GROUP)
    if group is None or len(group.children) < 2 or group.to_dataset(inherit=False).variables:
        return tree
    count = len(group.children)
    if set(group.children) != {str(i) for i in range(count)}:
        return tree
    if group.attrs or tree.sizes.get(_WHISKER, count) != count:
        return tree
    each = [group.children[str(i)] for i in range(count)]
    if any(one.children for one in each):
        return tree
    together = _stacked([one.to_dataset(inherit=False) for one in each])
    return tree if together is None else _with_group(tree, {f"/{GROUP}": together})


def separate_whiskers(tree: xr.DataTree) -> xr.DataTree:
    """Split stacked whiskers into one group each."""
    group = tree.children.get(GROUP)
    if group is None or _OWN not in group.attrs:
        return tree
    together = group.to_dataset(inherit=False)
    each = {f"/{GROUP}/{i}": _unstacked(together, i) for i in range(together.sizes[_WHISKER])}
    return _with_group(tree, {f"/{GROUP}": xr.Dataset()} | each)


def _with_group(tree: xr.DataTree, groups: Mapping[str, xr.Dataset]) -> xr.DataTree:
    """Replace the groups of whiskers of a tree, and keep other groups and their order."""
    out: dict[str, xr.Dataset] = {}
    for node in tree.subtree:
        if node.path == f"/{GROUP}":
            out |= groups
        elif not node.path.startswith(f"/{GROUP}/"):
            out[node.path] = node.to_dataset(inherit=False)
    return xr.DataTree.from_dict(out, name=tree.name)


def _stacked(each: Sequence[xr.Dataset]) -> xr.Dataset | None:
    """Stack several whiskers in one dataset; None if this would lose information."""
    first = each[0]
    own = [
        name
        for name in first.attrs
        if any(one.attrs.get(name) != first.attrs[name] for one in each)
    ]
    uneven = {dim for dim in first.sizes if len({one.sizes.get(dim) for one in each}) > 1}
    if not all(_alike(one, first, own, uneven) for one in each):
        return None
    variables = {
        name: xr.Variable(
            (_WHISKER, *variable.dims), _filled([one[name].values for one in each]), variable.attrs
        )
        for name, variable in first.data_vars.items()
    }
    for dim in sorted(map(str, uneven)):
        about = {"units": "1", "long_name": f"size of each whisker along {dim}"}
        variables[f"{_SIZE}{dim}"] = xr.Variable(_WHISKER, [one.sizes[dim] for one in each], about)
    for name in own:
        about = {"long_name": f"attribute {name} of each whisker"}
        variables[name] = xr.Variable(_WHISKER, [one.attrs[name] for one in each], about)
    same = {name: value for name, value in first.attrs.items() if name not in own}
    return xr.Dataset(variables, first.coords, same | {_OWN: " ".join(own)})


def _alike(one: xr.Dataset, first: xr.Dataset, own: Sequence[str], uneven: set[Any]) -> bool:
    """Whether a whisker can be stacked with the first without loss."""
    if set(one.attrs) != set(first.attrs) or set(own) & set(map(str, first.variables)):
        return False
    if not all(type(one.attrs[name]) is str and name.isidentifier() for name in own):
        return False
    if list(one.variables) != list(first.variables) or set(one.coords) != set(first.coords):
        return False
    return all(
        bool(one.variables[name].identical(variable))  # type: ignore[no-untyped-call]
        if name in first.coords
        else _fits(one.variables[name], variable, uneven)
        for name, variable in first.variables.items()
    )


def _fits(one: xr.Variable, first: xr.Variable, uneven: set[Any]) -> bool:
    if one.dims != first.dims or one.dtype != first.dtype or one.attrs != first.attrs:
        return False
    return _WHISKER not in one.dims and (one.dtype.kind == "f" or not uneven.intersection(one.dims))


def _filled(each: Sequence[np.ndarray]) -> np.ndarray:
    """Stack arrays, padding smaller ones with NaN."""
    shape = np.max([one.shape for one in each], axis=0).astype(int)
    if all(one.shape == tuple(shape) for one in each):
        return np.stack(each)
    values = np.full((len(each), *shape), np.nan, dtype=each[0].dtype)
    for row, one in zip(values, each, strict=True):
        row[tuple(slice(size) for size in one.shape)] = one
    return values


def _unstacked(together: xr.Dataset, index: int) -> xr.Dataset:
    """Extract one whisker from a stack."""
    own = str(together.attrs[_OWN]).split()
    attrs = {key: value for key, value in together.attrs.items() if key != _OWN}
    attrs |= {name: str(together[name].values[index]) for name in own}
    size = {
        dim: int(together[_SIZE + str(dim)].values[index])
        for dim in together.sizes
        if _SIZE + str(dim) in together
    }
    known = {*own, *(f"{_SIZE}{dim}" for dim in size)}
    variables = {}
    for name, variable in together.variables.items():
        if name in known or name == _WHISKER:
            continue
        dims = variable.dims
        values = variable.values
        if _WHISKER in dims:
            dims, values = dims[1:], values[index]
        within = tuple(slice(size.get(dim)) for dim in dims)
        variables[name] = xr.Variable(dims, np.array(values[within]), variable.attrs)
    labels = [name for name in together.coords if name in variables]
    return xr.Dataset(variables, attrs=attrs).set_coords(labels)
