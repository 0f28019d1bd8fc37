"""Data model of a recording (all data of a trial), and accessors to its variables.

Each variable is a row of ``recording.csv``: its dimensions, frame, type and the groups that may
contain it, of which ``/`` is the root.

    /            measured or tracked variables of the trial, and the pose of the base
    /truth       true values of these and other variables (simulated trials only)
    /measured    results of tracking before the rod was fitted
    /signals     force, moment and the six signals of every frame
    /estimates   contact points estimated from the signals
    /whiskers/0  the first whisker along the dimension ``whisker``, and so on
    /cameras     the views
    /objects/0   the first object in the laboratory, and so on

No group is named ``whisker``, as groups and dimensions of a file share one name space. Missing
values are NaN. Force and moment act at the whisker's base; the force is that of the object on the
whisker. In the root they are the readings of the sensor, with or without contact, and contact
points are estimates. Units and long names are those of :mod:`vibrissa.quantities`.
"""

from __future__ import annotations

import csv
import sys
import warnings
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.cameras import Camera, cameras_dataset, cameras_from_dataset
from vibrissa.deferred import xr
from vibrissa.io import RECORDING_KIND
from vibrissa.objects import Peg, Surface, object_from_dataset, objects_datasets
from vibrissa.quantities import attributes, unit_fault
from vibrissa.status import Event, Status, flag_attributes
from vibrissa.whisker import Whisker

__all__ = ["VARIABLES", "Group", "Recording"]
__dir__ = __all__.copy


@dataclass(frozen=True)
class RecordedVariable:
    """Declaration of one variable of a recording.

    It states the dimensions in the order of the arrays that `Group` returns; the groups that may
    contain the variable, where the empty name stands for the root; the frame of its components,
    empty if it has none; and the type of its values, "float", "bool" or "int".
    """

    dims: tuple[str, ...]
    groups: tuple[str, ...]
    frame: str = ""
    kind: str = "float"


_TABLE = csv.DictReader(Path(__file__).with_suffix(".csv").read_text("utf-8").splitlines())
_VECTOR = ("time", "whisker", "space")

VARIABLES: Mapping[str, RecordedVariable] = MappingProxyType(
    {
        row["name"]: RecordedVariable(
            tuple(row["dims"].split()),
            tuple(group.strip("/") for group in row["groups"].split()),
            row["frame"],
            row["kind"],
        )
        for row in _TABLE
    }
)
"""Declarations of all variables over the frames of a recording, by name."""

# Dimensions of components, which a selection of one frame, whisker or view keeps.
_AXES = frozenset({"space", "whisker_axis", "head_axis", "space_"})
_SELECTED = frozenset({"time", "whisker", "view"})
# Alternative names of dimensions, for datasets with two of the same kind.
_ALSO_CALLED = MappingProxyType({"true_node": "node", "space_2": "space_"})
_NUMBERS = "fiub"
# Required labels of dimensions whose values are accessed by position.
_LABELS = MappingProxyType(
    {
        "space": ["x", "y", "z"],
        "whisker_axis": ["x", "y", "z"],
        "head_axis": ["x", "y", "z"],
        "image_axis": ["column", "row"],
    }
)
_SKEW = 1e-3  # largest deviation of a rotation times its transpose from the identity
_OF = "recorded_as"  # attribute of a whisker's group: its label along the dimension ``whisker``


def recorded(name: str, values: ArrayLike) -> xr.Variable:
    """Create a labelled variable of a recording from an array."""
    about = _declared(name)
    array = np.asarray(values)
    if "whisker" in about.dims and array.ndim == len(about.dims) - 1:
        array = np.expand_dims(array, about.dims.index("whisker"))
    if array.ndim != len(about.dims):
        raise ValueError(
            f"{name} has the shape {array.shape}; ({', '.join(about.dims)}) are needed"
        )
    plain = name.removeprefix("unfiltered_")
    labels: dict[str, Any] = dict(attributes(plain))
    if plain != name:
        labels["long_name"] += ", unfiltered"
    if about.frame:
        labels["reference_frame"] = about.frame
    if name in ("status", "event"):
        labels |= flag_attributes(Event if name == "event" else Status)
    return xr.Variable(about.dims, array, labels)


def coordinates(time: ArrayLike, names: Sequence[str]) -> dict[Hashable, Any]:
    """Coordinates of a recording."""
    return {
        "time": xr.Variable("time", np.asarray(time), attributes("time")),
        "whisker": list(names),
        "space": list("xyz"),
        "whisker_axis": list("xyz"),
    }


def faults_in(data: xr.Dataset) -> list[str]:
    """List faults of the variables of a recording or of one of its groups."""
    known = {name: data[name].variable for name in VARIABLES if name in data}
    faults = [_fault(name, variable, frozenset()) for name, variable in known.items()]
    faults += [
        unit_fault(name, variable.attrs["units"])
        for name, variable in known.items()
        if "units" in variable.attrs
    ]
    for dim, labels in _LABELS.items():
        got = data[dim].values.tolist() if dim in data.coords else labels
        if got != labels:
            faults.append(f"{dim} is {', '.join(map(str, got))}; {', '.join(labels)} is needed")
    codes = known["status"].values if "status" in known else np.zeros(0)
    if len(wrong := np.setdiff1d(codes[codes == codes], list(Status))):
        faults.append(f"status holds {', '.join(map(str, wrong[:3]))}, which is not a status")
    for name in () if any(faults) else known.keys() & {"base_rotation", "head_rotation"}:
        turned = ordered(name, known[name])
        turned = turned[np.isfinite(turned).all(axis=(-2, -1))]
        away = np.abs(np.swapaxes(turned, -2, -1) @ turned - np.eye(3)).max(initial=0.0)
        if away > _SKEW or (np.linalg.det(turned) < 0.0).any():
            faults.append(f"{name} is not a rotation in some frames")
    return [fault for fault in faults if fault]


def ordered(name: str, variable: xr.Variable) -> NDArray[Any]:
    """Values of a variable in the declared order of dimensions and type.

    Missing booleans are False, a missing status is that of missing data, and infinite components of
    vectors count as missing.
    """
    if fault := _fault(name, variable, _SELECTED):
        raise ValueError(fault)
    wanted = _declared(name)
    called = {_ALSO_CALLED.get(str(dim), str(dim)): dim for dim in variable.dims}
    values = variable.transpose(*(called[dim] for dim in wanted.dims if dim in called)).values
    if wanted.kind == "bool":
        return np.asarray(np.nan_to_num(values) > 0.0)
    if wanted.dims == _VECTOR:
        return np.where(np.isfinite(values), values, np.nan)
    if name == "status":
        return np.asarray(np.nan_to_num(values, nan=int(Status.MISSING)), dtype=np.int8)
    return np.asarray(values, dtype=np.float64) if wanted.kind == "float" else values


def _declared(name: str) -> RecordedVariable:
    if name not in VARIABLES:
        raise ValueError(f"{name} is not a variable of a recording; these are {list(VARIABLES)}")
    return VARIABLES[name]


def _fault(name: str, variable: xr.Variable, selected: frozenset[str]) -> str:
    """Describe the fault of a variable, which may lack selected dimensions; empty if none."""
    dims = _declared(name).dims
    sizes = {_ALSO_CALLED.get(str(dim), str(dim)): n for dim, n in variable.sizes.items()}
    if not set(dims) - selected <= set(sizes) <= set(dims):
        got = ", ".join(map(str, variable.dims))
        return f"{name} has the dimensions ({got}); ({', '.join(dims)}) are needed"
    if any(sizes[axis] != 3 for axis in _AXES & set(sizes)):
        return f"{name} has sizes {dict(variable.sizes)}; space has 3 dimensions"
    if variable.dtype.kind not in _NUMBERS:
        return f"{name} holds {variable.dtype}, not numbers"
    return ""


ONE_VIEW = (
    "one view: the whisker is taken to move and bend in the plane of the image, z = 0. Measured "
    "are base, azimuth, curvature, contact and, in the plane, force (Fx, Fy) and bending moment "
    "(Mz). Not measured, and given as 0: elevation, depth, force across the plane (Fz), and the "
    "moments Mx and My; roll is 0° or 180°. What turns out of the plane looks shorter and bent."
)
"""Variables of a trial filmed by one camera."""


@dataclass(frozen=True, eq=False)
class Group:
    """Access to the variables of one group, or of one whisker in it, as arrays by name.

    Parameters
    ----------
    data : xarray.Dataset
        Variables of the group.
    name : str
        Name of the group; empty for the root.
    """

    data: xr.Dataset
    name: str = ""

    def __contains__(self, name: object) -> bool:
        return name in self.data

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Values in the declared order of dimensions; raise ValueError if they are missing."""
        if (values := self.get(name)) is None:
            here = f"the group {self.name} of the recording" if self.name else "the recording"
            got = ", ".join(sorted(map(str, self.data.data_vars))) or "no variables"
            raise ValueError(f"{here} lacks {name}; it has {got}")
        return values

    def get(self, name: str) -> NDArray[Any] | None:
        """Values of a variable in the declared order of dimensions.

        Parameters
        ----------
        name : str
            Name of a declared variable.

        Returns
        -------
        array or None
            Values; None if it is missing.

        Raises
        ------
        ValueError
            If it has other dimensions or sizes than declared, or is not numeric.
        """
        return ordered(name, self.data[name].variable) if name in self.data else None

    def known(self, name: str) -> NDArray[Any] | None:
        """Values of a variable that is not entirely missing.

        Parameters
        ----------
        name : str
            Name of a declared variable.

        Returns
        -------
        array or None
            Values; None if it is missing or nowhere finite.
        """
        values = self.get(name)
        return None if values is None or not np.isfinite(values).any() else values

    def whisker(self, index: int) -> Group:
        """Select one whisker.

        Parameters
        ----------
        index : int
            Number of the whisker along the dimension ``whisker``.

        Returns
        -------
        Group
            Group without that dimension; the same group if it has none.

        Raises
        ------
        ValueError
            If there is no such whisker.
        """
        count = self.data.sizes.get("whisker", 1)
        if not 0 <= index < count:
            raise ValueError(f"whisker {index} was asked for; the recording has {count} of them")
        if "whisker" not in self.data.dims:
            return self
        return Group(self.data.isel(whisker=index), self.name)

    def each_whisker(self) -> Iterator[Group]:
        """Iterate over the whiskers.

        Returns
        -------
        iterator of Group
            Groups of single whiskers.
        """
        return (self.whisker(k) for k in range(self.data.sizes.get("whisker", 1)))


def _number(key: str) -> tuple[int, str]:
    """Sort key of groups named by numbers."""
    return (int(key), "") if key.isdecimal() else (sys.maxsize, key)


@dataclass(frozen=True, eq=False)
class Recording:
    """Access to the groups of a recording, and to its whiskers, cameras and objects.

    Parameters
    ----------
    tree : xarray.DataTree
        Recording, as returned by `vibrissa.io.load_recording`, simulation and tracking.
    """

    tree: xr.DataTree

    def find(self, name: str) -> Group | None:
        """Find a group.

        Parameters
        ----------
        name : str
            Name of the group; empty for the root.

        Returns
        -------
        Group or None
            Group with the coordinates of the recording; None if it does not exist.
        """
        node = self.tree.children.get(name) if name else self.tree
        return None if node is None else Group(node.to_dataset(), name)

    def __getitem__(self, name: str) -> Group:
        """Group by name; raise ValueError if it does not exist."""
        if (group := self.find(name)) is None:
            got = ", ".join(sorted(self.tree.children)) or "no groups"
            raise ValueError(f"the recording has no group {name} (it has {got})")
        return group

    def __contains__(self, name: object) -> bool:
        return name in self.tree.children

    @property
    def root(self) -> Group:
        """Variables of the root."""
        return self[""]

    @property
    def names(self) -> list[str]:
        """Names of the whiskers along the dimension ``whisker``."""
        return [str(name) for name in np.atleast_1d(self.root.data["whisker"].values)]

    def known(self, name: str, groups: Sequence[str]) -> NDArray[Any] | None:
        """Values of a variable from the first group in which it is not entirely missing.

        Parameters
        ----------
        name : str
            Name of a declared variable.
        groups : sequence of str
            Names of groups in order of priority; the empty name stands for the root.

        Returns
        -------
        array or None
            Values in the declared order of dimensions; None if no group has any.
        """
        for group in filter(None, map(self.find, groups)):
            if (values := group.known(name)) is not None:
                return values
        return None

    def whisker(self, index: int = 0) -> Whisker:
        """Restore a whisker of the recording.

        Parameters
        ----------
        index : int
            Number of the whisker along the dimension ``whisker``.

        Returns
        -------
        Whisker
            Whisker as it was recorded.

        Raises
        ------
        ValueError
            If the recording does not contain this whisker.
        """
        groups = self._whisker_groups()
        if not 0 <= index < len(groups):
            raise ValueError(
                f"the recording has the shapes of {len(groups)} whiskers, not of whisker {index}"
            )
        return Whisker.from_dataset(groups[index].to_dataset(inherit=False))

    def _whisker_groups(self) -> list[xr.DataTree]:
        """Groups of the whiskers along the dimension ``whisker``, matched by label.

        Labels survive selection. If no group has a label of that dimension, as after renaming, the
        groups are assigned in order, with a warning if they have different labels.
        """
        whiskers = self.tree.children.get("whiskers")
        children = {} if whiskers is None else whiskers.children
        groups = [children[key] for key in sorted(children, key=_number)]
        labels = [str(one.attrs.get(_OF, one.attrs.get("name", ""))) for one in groups]
        names = self.names if "whisker" in self.tree.coords else []
        if not groups or labels == names:
            return groups
        if len(set(labels)) == len(labels) and set(names) and set(names) <= set(labels):
            return [groups[labels.index(name)] for name in names]
        if len(groups) != self.tree.sizes.get("whisker") or set(names) & set(labels):
            raise ValueError(
                f"the whiskers are named {', '.join(names) or 'nothing'}; the recording contains "
                f"the shapes of {', '.join(labels)}"
            )
        if len(set(labels)) > 1:
            pairs = ", ".join(f"{a} has that of {b}" for a, b in zip(names, labels, strict=False))
            warnings.warn(
                f"whiskers and shapes have different names and are matched in order: {pairs}",
                stacklevel=3,
            )
        return groups

    @property
    def whiskers(self) -> list[Whisker]:
        """Whiskers of the recording, restored."""
        return [self.whisker(k) for k in range(len(self.names))]

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Cameras of a filmed or tracked recording; raise ValueError if there are none."""
        if "cameras" not in self:
            raise ValueError("the recording has no cameras")
        return cameras_from_dataset(self["cameras"].data)

    @property
    def planar(self) -> bool:
        """Whether the trial was filmed by a single camera, so that it is known in a plane only."""
        return "cameras" in self and self["cameras"].data.sizes.get("view") == 1

    @property
    def objects(self) -> tuple[Surface, ...]:
        """Objects of the recording in the laboratory frame; may be empty."""
        if (objects := self.tree.children.get("objects")) is None:
            return ()
        names = sorted(objects.children, key=_number)
        return tuple(object_from_dataset(objects.children[i].to_dataset()) for i in names)

    @property
    def pegs(self) -> tuple[Peg, ...]:
        """Pegs of the recording in the laboratory frame; may be empty."""
        return tuple(thing for thing in self.objects if isinstance(thing, Peg))


def recording_tree(
    root: xr.Dataset,
    whiskers: Sequence[Whisker],
    origin: str,
    *,
    groups: Mapping[str, xr.Dataset] | None = None,
    objects: Sequence[Surface] | None = None,
    cameras: Sequence[Camera] = (),
) -> xr.DataTree:
    """Assemble a recording from its root, whiskers and further groups."""
    tree = {"/": root.assign_attrs(kind=RECORDING_KIND, origin=origin)}
    tree |= {f"/{name}": data for name, data in (groups or {}).items()}
    if cameras:
        tree["/cameras"] = cameras_dataset(cameras).drop_vars("view")
    for i, (whisker, label) in enumerate(zip(whiskers, root["whisker"].values, strict=True)):
        # The stored centreline serves readers of whisker files, and its dimension node would
        # conflict with that of the recording.
        own = whisker.to_dataset().drop_dims("node")
        tree[f"/whiskers/{i}"] = own.assign_attrs({_OF: str(label)})
    if objects is not None:
        tree["/objects"] = xr.Dataset(attrs={"reference_frame": "laboratory"})
        # Groups inherit the coordinates of the root.
        tree |= {
            f"/objects/{i}": data.drop_vars("space")
            for i, data in objects_datasets(objects).items()
        }
    return xr.DataTree.from_dict(tree)
