"""A recording read by name: checked arrays, and the whiskers, cameras and objects of the trial."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.cameras import Camera, cameras_dataset, cameras_from_dataset
from vibrissa.io import RECORDING_KIND
from vibrissa.objects import Peg, Surface, object_from_dataset, objects_datasets
from vibrissa.recording.schema import ordered
from vibrissa.whisker import Whisker

ONE_VIEW = (
    "one view: the whisker is taken to move and bend in the plane of the image, z = 0. Measured "
    "are base, azimuth, curvature, contact and, in the plane, force (Fx, Fy) and bending moment "
    "(Mz). Not measured, and given as 0: elevation, depth, force across the plane (Fz), and the "
    "moments Mx and My; roll is 0° or 180°. What turns out of the plane looks shorter and bent."
)
"""Variables of a trial that was filmed by one camera."""


@dataclass(frozen=True, eq=False)
class Group:
    """One group of a recording, or one whisker of it, as arrays by name.

    Parameters
    ----------
    data : xarray.Dataset
        Variables of the group.
    name : str
        Name of the group; empty for the recording itself.
    """

    data: xr.Dataset
    name: str = ""

    def __contains__(self, name: object) -> bool:
        """Whether there is a variable of that name."""
        return name in self.data

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Give a variable in the declared order of dimensions; ValueError if it is missing."""
        values = self.get(name)
        if values is None:
            here = f"the group {self.name} of the recording" if self.name else "the recording"
            got = ", ".join(sorted(map(str, self.data.data_vars))) or "no variables"
            raise ValueError(f"{here} lacks {name}; it has {got}")
        return values

    def get(self, name: str) -> NDArray[Any] | None:
        """Give a variable in the declared order of dimensions.

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
            If it has other dimensions or sizes than declared, or holds no numbers.
        """
        return ordered(name, self.data[name].variable) if name in self.data else None

    def known(self, name: str) -> NDArray[Any] | None:
        """Give a variable of which something is known.

        Parameters
        ----------
        name : str
            Name of a declared variable.

        Returns
        -------
        array or None
            Values; None if it is missing or not finite anywhere.
        """
        values = self.get(name)
        return None if values is None or not np.isfinite(values).any() else values

    def whisker(self, index: int) -> Group:
        """Take one whisker.

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
        """Take one whisker after the other.

        Returns
        -------
        iterator of Group
            One for each whisker.
        """
        return (self.whisker(k) for k in range(self.data.sizes.get("whisker", 1)))


@dataclass(frozen=True, eq=False)
class Recording:
    """All that is known of a trial.

    Parameters
    ----------
    tree : xarray.DataTree
        Recording as `vibrissa.io.load_recording`, simulation and tracking return it.
    """

    tree: xr.DataTree

    def find(self, name: str) -> Group | None:
        """Find a group.

        Parameters
        ----------
        name : str
            Name of the group; empty for the recording itself.

        Returns
        -------
        Group or None
            Group with the coordinates of the recording; None if there is none of that name.
        """
        node = self.tree.children.get(name) if name else self.tree
        return None if node is None else Group(node.to_dataset(), name)

    def __getitem__(self, name: str) -> Group:
        """Give a group by name; ValueError if there is none."""
        group = self.find(name)
        if group is None:
            got = ", ".join(sorted(self.tree.children)) or "no groups"
            raise ValueError(f"the recording has no group {name} (it has {got})")
        return group

    def __contains__(self, name: object) -> bool:
        """Whether there is a group of that name."""
        return name in self.tree.children

    @property
    def root(self) -> Group:
        """Variables of the recording itself."""
        return self[""]

    @property
    def names(self) -> list[str]:
        """Names of the whiskers, along the dimension ``whisker``."""
        return [str(name) for name in np.atleast_1d(self.root.data["whisker"].values)]

    def known(self, name: str, groups: Sequence[str]) -> NDArray[Any] | None:
        """Give a variable from the first group in which something is known of it.

        Parameters
        ----------
        name : str
            Name of a declared variable.
        groups : sequence of str
            Names of groups, the most trusted first; empty for the recording itself.

        Returns
        -------
        array or None
            Values in the declared order; None if no group has any.
        """
        for group in filter(None, map(self.find, groups)):
            values = group.known(name)
            if values is not None:
                return values
        return None

    def whisker(self, index: int = 0) -> Whisker:
        """Make a whisker of the recording again.

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
            If the recording carries no such whisker.
        """
        whiskers = self.tree.children.get("whiskers")
        if whiskers is None or str(index) not in whiskers.children:
            count = 0 if whiskers is None else len(whiskers.children)
            raise ValueError(
                f"whisker {index} was asked for; the recording carries {count} of them"
            )
        return Whisker.from_dataset(whiskers.children[str(index)].to_dataset(inherit=False))

    @property
    def whiskers(self) -> list[Whisker]:
        """Whiskers of the recording, made again."""
        return [self.whisker(k) for k in range(self.tree.sizes["whisker"])]

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Cameras of a filmed or tracked recording, made again; ValueError if it has none."""
        if "cameras" not in self:
            raise ValueError("the recording has no cameras")
        return cameras_from_dataset(self["cameras"].data)

    @property
    def planar(self) -> bool:
        """Whether one camera alone has seen the trial, so that it is known in a plane only."""
        return "cameras" in self and self["cameras"].data.sizes.get("view") == 1

    @property
    def objects(self) -> tuple[Surface, ...]:
        """Objects of the recording, made again, in the laboratory frame; there may be none."""
        objects = self.tree.children.get("objects")
        if objects is None:
            return ()
        numbers = sorted(objects.children, key=int)
        return tuple(object_from_dataset(objects.children[i].to_dataset()) for i in numbers)

    @property
    def pegs(self) -> tuple[Peg, ...]:
        """Pegs of the recording, made again, in the laboratory frame; there may be none."""
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
    """Put a recording together."""
    tree = {"/": root.assign_attrs(kind=RECORDING_KIND, origin=origin)}
    tree |= {f"/{name}": data for name, data in (groups or {}).items()}
    if cameras:
        tree["/cameras"] = cameras_dataset(cameras).drop_vars("view")
    for i, whisker in enumerate(whiskers):
        # Its centreline is for readers of lone whisker files, and its nodes are others than ours.
        tree[f"/whiskers/{i}"] = whisker.to_dataset().drop_dims("node")
    if objects is not None:
        tree["/objects"] = xr.Dataset(attrs={"reference_frame": "laboratory"})
        # The coordinates of the root are seen from below.
        tree |= {
            f"/objects/{i}": data.drop_vars("space")
            for i, data in objects_datasets(objects).items()
        }
    return xr.DataTree.from_dict(tree)
