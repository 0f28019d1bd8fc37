"""Whisker arrays of a face: measured whiskers, or those of an average rat (`morphology`).

The pose of each whisker refers to the head's frame: origin at the tip of the snout, x to the
animal's right, y forward along the midline, z up.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from numbers import Integral
from typing import Any, Literal, Unpack

import numpy as np

from vibrissa.deferred import xr
from vibrissa.numerics import Array
from vibrissa.quantities import attributes
from vibrissa.sketch import BENT, Mark, card, shown, views
from vibrissa.whisker import morphology
from vibrissa.whisker.model import Whisker
from vibrissa.whisker.morphology import ROWS, Identity, Side, published_radii
from vibrissa.whisker.pose import Pose, angles_of, base_rotation, mirrored
from vibrissa.whisker.section import Properties

BOTH: tuple[Side, Side] = ("left", "right")  # sides of an animal
NODES = 33  # points of the stored centrelines
_OF_HEAD = "In the head's frame: origin at the snout, x to the animal's right, y forward, z up."


class WhiskerArray(Mapping[str, Whisker]):
    """Whiskers by name, each with its pose in the head's frame.

    Names have the form of `vibrissa.whisker.morphology`: ``LC2``, ``Rγ``. Other spellings are
    accepted in look-ups (``left C2``, ``Rgamma``), also without the side where only one side has
    such a whisker.

    Parameters
    ----------
    whiskers : iterable of Whisker
        Whiskers, identified by their names; where a name has no side, that of its base is used.

    Raises
    ------
    ValueError
        If there are none, two have the same name, a name is not that of a whisker, or a base is on
        another side than the name states.

    Examples
    --------
    >>> whisker_array(side="right")["gamma"].length
    0.0508...
    """

    kind = "vibrissa whisker array"

    def __init__(self, whiskers: Iterable[Whisker]) -> None:
        found = sorted((_with_identity(w) for w in whiskers), key=lambda pair: pair[0].sort_key)
        names = [identity.name for identity, _ in found]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"no array of whiskers: there are two of {', '.join(twice)}")
        if not found:
            raise ValueError("no array of whiskers: it is empty")
        self._identities = {identity.name: identity for identity, _ in found}
        self._whiskers = {whisker.name: whisker for _, whisker in found}

    def __getitem__(self, name: str) -> Whisker:
        return self._whiskers[self._key(name)]

    def __iter__(self) -> Iterator[str]:
        return iter(self._whiskers)

    def __len__(self) -> int:
        return len(self._whiskers)

    def _key(self, name: str) -> str:
        if not isinstance(name, str):
            raise KeyError(f"{name!r} is not a whisker's name; this array has {', '.join(self)}")
        if name in self._whiskers:
            return name
        try:
            identity = Identity.of(name)
        except ValueError as fault:
            raise KeyError(str(fault)) from None
        keys = [one.name for one in _on_sides([identity], BOTH) if one.name in self._whiskers]
        if len(keys) != 1:
            why = f"it may be {' or '.join(keys)}" if keys else "there is no such whisker"
            raise KeyError(f"{name!r}: {why}; this array has {', '.join(self)}")
        return keys[0]

    def identity(self, name: str) -> Identity:
        """Return side, row and column of a whisker.

        Parameters
        ----------
        name : str
            Any of its names.

        Returns
        -------
        Identity
        """
        return self._identities[self._key(name)]

    def select(
        self,
        *,
        side: str = "both",
        rows: Iterable[str] | None = None,
        columns: Iterable[int] | None = None,
        names: Iterable[str] | None = None,
    ) -> WhiskerArray:
        """Select some of the whiskers.

        Parameters
        ----------
        side : {"both", "left", "right"}
            Side to keep.
        rows : iterable of str, optional
            Rows to keep, such as ``"ABC"``; all by default.
        columns : iterable of int, optional
            Columns to keep, 0 being the Greek one; all by default.
        names : iterable of str, optional
            Whiskers to keep, on both sides unless the name states one; all by default.

        Returns
        -------
        WhiskerArray
            Array of these only.
        """
        columns, names = _several(columns), _several(names)
        keep = None if rows is None else {row.upper() for row in rows}
        which = None if columns is None else set(columns)
        kept = [
            name
            for name, identity in self._identities.items()
            if identity.side in sides(side)
            and (keep is None or identity.row in keep)
            and (which is None or identity.column in which)
        ]
        if names is not None:
            wanted = [Identity.of(name) for name in names]
            meant = {one.name for one in _on_sides(wanted, BOTH)}
            kept = [name for name in kept if name in meant]
            for one in wanted:
                if not any(name.endswith(one.name) for name in kept):
                    raise ValueError(f"{one.name} is not among {', '.join(self)}")
        return WhiskerArray([self._whiskers[name] for name in kept])

    def centerlines(self, n: int = 33) -> Array:
        """Points of the whiskers at rest.

        Parameters
        ----------
        n : int
            Points of each, equally spaced in arc length.

        Returns
        -------
        array (whisker, n, 3)
            m, head's frame.
        """
        return np.stack([w.pose.to_source(w.centerline(n)) for w in self.values()])

    def to_tree(self) -> xr.DataTree:
        """Convert the array to labelled datasets, without loss.

        Returns
        -------
        xarray.DataTree
            Table along the dimension ``whisker`` at the top: side, row, column, pose, length, radii
            and centreline, head's frame. In the groups ``whiskers/0``, … each whisker's own
            dataset.
        """
        them, which = list(self.values()), list(self._identities.values())
        rotation = np.stack([w.pose.rotation for w in them])
        angles = angles_of(rotation)
        framed: dict[str, tuple[tuple[str, ...], Any]] = {
            "base_position": (("whisker", "space"), np.stack([w.pose.origin for w in them])),
            "base_rotation": (("whisker", "space", "whisker_axis"), rotation),
            "base_azimuth": (("whisker",), angles[:, 0]),
            "base_elevation": (("whisker",), angles[:, 1]),
            "base_roll": (("whisker",), angles[:, 2]),
            "centerline": (("whisker", "node", "space"), self.centerlines(NODES)),
        }
        variables = {
            name: xr.Variable(
                dims,
                values,
                attributes(name) | {"description": _OF_HEAD, "reference_frame": "head"},
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
        groups: dict[str, xr.Dataset] = {"/": xr.Dataset(variables, labels, {"kind": self.kind})}
        for i, whisker in enumerate(them):
            groups[f"/whiskers/{i}"] = whisker.to_dataset().drop_dims("node")
        return xr.DataTree.from_dict(groups)

    @classmethod
    def from_tree(cls, tree: xr.DataTree) -> WhiskerArray:
        """Restore an array from its tree.

        Parameters
        ----------
        tree : xarray.DataTree
            Result of `to_tree`.

        Returns
        -------
        WhiskerArray
        """
        kind = tree.attrs.get("kind")
        if kind != cls.kind or "whiskers" not in tree.children:
            raise ValueError(
                f"this holds {kind or 'data of another kind'}, not an array of whiskers"
            )
        own = tree.children["whiskers"].children
        datasets = (own[i].to_dataset(inherit=False) for i in sorted(own, key=int))
        return cls(Whisker.from_dataset(dataset) for dataset in datasets)

    def __repr__(self) -> str:
        lengths = [w.length * 1e3 for w in self.values()]
        sides = [
            f"{count} {side}"
            for side in ("left", "right")
            if (count := sum(i.side == side for i in self._identities.values()))
        ]
        names = list(self)
        return (
            f"WhiskerArray: {len(self)} whiskers ({', '.join(sides)}), {min(lengths):.1f} to "
            f"{max(lengths):.1f} mm long: {', '.join(names[:6])}{', …' if len(names) > 6 else ''}"
        )

    def _repr_html_(self) -> str:
        """Picture of all whiskers in the head's frame, from above and from behind."""
        lengths = [w.length for w in self.values()]
        rows = [
            ("whiskers", f"{len(self)}: {', '.join(self)}"),
            ("lengths", f"{shown('length', min(lengths))} to {shown('length', max(lengths))}"),
        ]
        return card("WhiskerArray", rows, views([Mark(self.centerlines(), BENT)]))


def sides(side: str) -> tuple[Side, ...]:
    """Sides denoted by ``both``, ``left`` or ``right``; raise a ValueError for anything else."""
    meant = BOTH if side == "both" else tuple(one for one in BOTH if one == side)
    if not meant:
        raise ValueError(f"side is {side!r}; both, left or right is needed")
    return meant


def _on_sides(identities: Iterable[Identity], on: Sequence[Side]) -> list[Identity]:
    """Identities on the given sides, or on their own side where they state one."""
    return [one.on(s) for one in identities for s in ((one.side,) if one.side else on)]


def _with_identity(whisker: Whisker) -> tuple[Identity, Whisker]:
    """Identify a whisker, with its side, and give it the standard name."""
    identity = Identity.of(whisker.name)
    x = float(whisker.pose.origin[0])
    there: Side = "right" if x > 0.0 else "left"
    if identity.side is None:
        identity = identity.on(there)
    elif x != 0.0 and identity.side != there:
        raise ValueError(
            f"{whisker.name} has its base at x = {x * 1e3:.2f} mm, which is on the {there} side: "
            "in the head's frame x points to the animal's right"
        )
    same = whisker.name == identity.name
    return identity, whisker if same else replace(whisker, name=identity.name)


def whisker_array(
    side: Literal["both", "left", "right"] = "both",
    rows: Iterable[str] = ROWS,
    columns: Iterable[int] = range(7),
    *,
    names: Iterable[str] | None = None,
    **properties: Unpack[Properties],
) -> WhiskerArray:
    """Create an average rat's whiskers from the published equations.

    Parameters
    ----------
    side : {"both", "left", "right"}
        Side of the animal.
    rows : iterable of {"A", "B", "C", "D", "E"}
        Rows to include, from the top down.
    columns : iterable of int
        Columns to include, from the back to the front; 0 is the Greek one. Of these rows and
        columns only measured whiskers are created: A0 to A4, B0 to B5, C0 to C6, D0 to D6 and E1 to
        E6, 31 on each side.
    names : iterable of str, optional
        Whiskers to create instead of rows and columns, such as ``["C2", "left gamma"]``; on the
        given side(s) unless the name states one. Whiskers that were never measured cause a warning.
    **properties
        Radius and material instead of the published ones and the defaults; see `Whisker`.

    Returns
    -------
    WhiskerArray
        Whiskers with poses in the head's frame: origin at the tip of the snout, x to the animal's
        right, y forward, z up.

    Raises
    ------
    ValueError
        If there is no such side, row, column or whisker, or no whisker is left.

    Warns
    -----
    UserWarning
        If a whisker lies outside the range in which the equations were measured, or is more curved
        than any measured one.

    References
    ----------
    Towal et al. (2011) and Belli et al. (2017): see `vibrissa.whisker.morphology`.

    Examples
    --------
    >>> len(whisker_array()), list(whisker_array("left", rows="C", columns=[0, 1]))
    (62, ['LC1', 'Lγ'])
    """
    columns, names = _several(columns), _several(names)
    if names is not None:
        identities = [Identity.of(name) for name in names]
        if away := [one.name for one in identities if one.side not in (None, *sides(side))]:
            raise ValueError(f"{', '.join(away)} are not on the requested {side} side")
        if set(rows) != set("ABCDE") or set(columns) != set(range(7)):
            raise ValueError("names and rows or columns were both given; give one of them")
        wanted = _on_sides(identities, sides(side))
    else:
        wanted = [
            Identity(row.upper(), int(column), s)
            for s in sides(side)
            for row in rows
            for column in columns
        ]
        wanted = [one for one in wanted if one.column in morphology.MEASURED[one.row]]
    return WhiskerArray([average_whisker(one, **properties) for one in wanted])


def _several(given: Any) -> Any:
    """Several columns or names, of which one may be given alone."""
    return [given] if isinstance(given, (str, Integral)) else given


def average_whisker(identity: Identity, **properties: Unpack[Properties]) -> Whisker:
    """Create one whisker of an average rat; see `whisker_array`."""
    if identity.side is None:
        raise ValueError(f"{identity.name} does not state a side; left or right is needed")
    row, column = identity.row_number, identity.column
    length = float(morphology.arc_length(row, column))
    coefficient = float(morphology.curvature_coefficient(column))
    if column > 6 or length <= 0.0:
        raise ValueError(f"{identity.name}: the equations reach to column 6, not {column}")
    notes = _range_notes(identity, length, coefficient)
    for note in notes:
        warnings.warn(f"{identity.name}: {note}", stacklevel=3)
    radii = dict(
        zip(("base_radius", "tip_radius"), published_radii(identity.name, length), strict=True)
    )
    own = {"base_radius", "tip_radius", "radius", "rat"} & set(properties)
    if not own and radii["tip_radius"] == radii["base_radius"] / morphology.MOST_TAPER:
        notes.append(
            "the published radius slope gives a tip radius near or below zero; base radius over "
            f"{morphology.MOST_TAPER:g} is used instead"
        )
    stated: Any = ({} if own else radii) | dict(properties) | {"name": identity.name}
    whisker = Whisker.parabola(length, coefficient, **stated)
    angles = morphology.emergence_angles(row, column)
    place = morphology.base_point(row, column)
    if identity.side == "left":
        angles, place = mirrored(angles), place * [-1.0, 1.0, 1.0]
    pose = Pose(base_rotation(*angles), place)
    return replace(whisker, pose=pose, notes=(*whisker.notes, *notes))


def _range_notes(identity: Identity, length: float, coefficient: float) -> list[str]:
    """Notes on what lies outside the range of the equations."""
    notes = [note] if (note := morphology.beyond_columns(identity)) else []
    bound = float(morphology.curvature_bound(length))
    if coefficient > bound:
        notes.append(
            f"its coefficient {coefficient * 1e-3:.4f} per mm is larger than the "
            f"{bound * 1e-3:.4f} per mm of the most curved whiskers of its length"
        )
    return notes
