"""Certificates that (F_x, M_B, M_D) locates every contact: boxes on which all signs are proved.

The lemma (theory page) requires signs of conditions on a solid domain of contacts and on some of
its faces; each is a *part* with a cover of its own:

- ``interior``: the whole domain;
- ``proximal``, ``distal``: the faces at the smallest and the largest arc length of a contact;
- ``fold``: the face of the largest force, beyond the fold, so that the domain contains Ω;
- ``rest``: contacts with less force than the domain's, which are within the cone.

For a straight whisker there is no cone, and no part ``rest``. For any other the lemma also requires
that M_D turns once while the direction of the force does; this is shown on one circle, and holds on
all of them because M_B is not zero.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from vibrissa.certificates.checker import covers, identity, refuse_incomplete
from vibrissa.certificates.conditions import (
    PLANAR,
    SPATIAL,
    Conditions,
    conditions_on,
    planar_conditions,
    spatial_conditions,
    spatial_point_conditions,
)
from vibrissa.certificates.domain import Bounds, bounds_of, is_planar, objection, room_within
from vibrissa.certificates.equations import ExactRod, exact_rod
from vibrissa.certificates.search import bounds, cover, volume
from vibrissa.contacts import need_map
from vibrissa.io import in_file, read_dataset, write_netcdf
from vibrissa.numerics import Array, IntArray, share_out
from vibrissa.signals import CONE

if TYPE_CHECKING:
    from vibrissa.contacts import ContactMap

#: Triplet to which certificates apply.
TRIPLET = "Fx MB MD"
KIND = "vibrissa certificate"
_ORDER = 8
_TOLERANCE = 1e-6  # ratio of the last Taylor coefficient to the states that determines a step
# Indices of the conditions of each part: for a straight whisker, and for any other.
_PLANAR = {"interior": [0, 1, 2, 3], "proximal": [0, 4], "distal": [0, 4], "fold": [0, 1]}
_SPATIAL = {"interior": [0, 1, 2, 3, 4], "proximal": [0, 1, 5, 6], "distal": [0, 1, 5, 6]}
_SPATIAL |= {"fold": [0], "rest": [0]}
# Indices of M_y and M_z among the conditions, and number of arcs of the circle of directions.
_MOMENT = [7, 8]
_ARCS = 48
_PROBES = 5  # number of contacts along each unknown at which signs are evaluated first
_BATCH = 2048  # number of boxes evaluated between two checks of the time
_SAVED_EVERY = 60.0  # interval at which an unfinished certificate is written, s

Progress = Callable[[int, int], None]


def enclose_conditions(
    tables: Conditions, rod: ExactRod, force: Bounds, boxes: Array, tolerance: float
) -> tuple[Array, Array]:
    """Enclose all conditions over boxes; also return relative widths, as `conditions_on`."""
    alike = np.lexsort(boxes[..., 0].T[::-1])  # neighbouring boxes need similar steps
    ordered = np.ascontiguousarray(boxes[alike])
    found = np.empty((len(boxes), len(tables.conditions), tables.unknowns + 3))
    widths = np.empty((len(boxes), tables.unknowns))
    given = tables, rod, force.packed(), ordered, _ORDER, tolerance, found, widths
    share_out(len(boxes), conditions_on, *given)
    back = np.argsort(alike)
    return found[back], widths[back]


@dataclass
class Part:
    """One part of the domain and the boxes that cover it: levels and indices, by unknown."""

    domain: Array
    certified: IntArray
    undecided: IntArray
    evaluated: int = 0

    @property
    def share(self) -> float:
        """Share of the part's volume that is certified."""
        return float(1.0 - volume(self.undecided).sum())

    @property
    def complete(self) -> bool:
        """Whether no box is undecided, and the certified boxes leave no gap."""
        return not len(self.undecided) and covers(self.certified)


@dataclass(repr=False)
class Certificate:
    """Boxes that prove that a whisker's (F_x, M_B, M_D) locates each contact outside a cone.

    Parameters
    ----------
    rod : ExactRod
        Whisker as polynomials with exact coefficients.
    bounds : Bounds
        Bounds on the force.
    stations : (2^k + 1,) array
        Arc lengths between which boxes are divided.
    straight : bool
        Whether the whisker is straight, so that contacts in one plane represent all.
    sign : float
        Sign of the determinant.
    cone : float
        Half angle of the excluded cone about the resting whisker, rad.
    parts : dict of Part
        Boxes of each part.
    whisker : str
        Description of the whisker.
    turns : bool
        Whether M_D is proved to turn once while the direction of the force does.
    refuted : str
        Statement of where a condition certainly fails; empty if nowhere.
    seconds : float
        Time spent, s.
    """

    rod: ExactRod
    bounds: Bounds
    stations: Array
    straight: bool
    sign: float
    cone: float
    parts: dict[str, Part]
    whisker: str = ""
    turns: bool = False
    refuted: str = ""
    seconds: float = 0.0
    _tables: dict[str, Conditions] = field(default_factory=dict, compare=False)

    def __repr__(self) -> str:
        return f"<{self.summary()}>"

    @property
    def proved(self) -> bool:
        """Whether the theorem follows: all signs are proved everywhere."""
        turns = self.straight or self.turns
        return turns and not self.refuted and all(p.complete for p in self.parts.values())

    @property
    def _which(self) -> dict[str, list[int]]:
        """Indices of the conditions of each part."""
        return _PLANAR if self.straight else _SPATIAL

    @property
    def share(self) -> float:
        """Share of the domain's volume on which the signs are proved."""
        return self.parts["interior"].share

    @property
    def identity(self) -> str:
        """Hash of all that the certificate states."""
        return identity(self.to_dataset())

    def summary(self) -> str:
        """State in words what is proved and what is not.

        Returns
        -------
        str
            One sentence, and the undecided parts if there are any.
        """
        left = np.rad2deg(self.cone)
        where = f" outside the cone of {left:.3g}°" if self.cone > 0.0 else ""
        if self.proved:
            number = sum(len(part.certified) for part in self.parts.values())
            return (
                f"Certificate: (Fx, MB, MD) is unique (proved){where}, for contacts from "
                f"{self.parts['interior'].domain[0, 0]:.3g} L to the tip, by {number} boxes found "
                f"in {self.seconds:.0f} s."
            )
        if self.refuted:
            return f"No certificate{where}: {self.refuted}."
        shares = ", ".join(f"{n} {_percent(p)} %{self._left(p)}" for n, p in self.parts.items())
        return f"Certificate{where} not finished: proved so far {shares}; run again to continue."

    def _left(self, part: Part) -> str:
        """Describe where boxes of a part are undecided, by ranges of the unknowns."""
        if not len(part.undecided):
            return ""
        boxes = bounds(part.undecided, part.domain, self.stations)
        ends = zip(boxes[..., 0].min(axis=0), boxes[..., 1].max(axis=0), strict=True)
        unknowns = "sℓ" if self.straight else "sφℓ"
        ranges = (f"{x} {a:.3g} to {b:.3g}" for x, (a, b) in zip(unknowns, ends, strict=True))
        return f" (undecided: {', '.join(ranges)})"

    def is_of(self, contact_map: ContactMap) -> bool:
        """Whether the certificate applies to a map's whisker and covers the map's arc lengths.

        Parameters
        ----------
        contact_map : ContactMap
            Map of a whisker.

        Returns
        -------
        bool
            Whether the polynomials are the same, and the domain reaches as far proximally.
        """
        if contact_map.whisker.base_stiffness is not None:
            return False
        rod = exact_rod(contact_map.whisker)
        same = all(np.array_equal(a, b) for a, b in zip(self.rod, rod, strict=True))
        return same and bool(self.parts["interior"].domain[0, 0] <= contact_map.chart.proximal)

    def evaluate(self, name: str, boxes: Array, which: list[int]) -> tuple[Array, Array]:
        """Enclose conditions of a part over boxes.

        Parameters
        ----------
        name : str
            Name of the part.
        boxes : (n, unknowns, 2) array
            Bounds of the unknowns.
        which : list of int
            Indices of the conditions to return.

        Returns
        -------
        conditions : (n, c, unknowns + 3) array
            Centres, contributions of the unknowns and of their products, and remainders.
        widths : (n, unknowns) array
            Relative widths due to each unknown.
        """
        kind = name if name in ("fold", "rest") else ""
        if kind not in self._tables:
            if self.straight:
                self._tables[kind] = planar_conditions(fold=bool(kind))
            elif kind:
                self._tables[kind] = spatial_point_conditions(kind)
            else:
                self._tables[kind] = spatial_conditions(self.sign)
        found, widths = enclose_conditions(
            self._tables[kind], self.rod, self.bounds, boxes, _TOLERANCE
        )
        return found[:, which], widths

    def probe(self) -> None:
        """Check signs at single contacts; one that is not proved there cannot be on boxes."""
        names = PLANAR if self.straight else SPATIAL
        for part in ("interior", "proximal", "distal"):
            which = self._which[part]
            low, high = self.parts[part].domain.T
            share = np.meshgrid(*[np.linspace(0.02, 1.0, _PROBES)] * len(low), indexing="ij")
            at = low + (high - low) * np.stack([one.ravel() for one in share], axis=1)
            found, _ = self.evaluate(part, np.stack([at, at], axis=-1), which)
            centre, reach = found[..., 0], found[..., 1:].sum(axis=-1)
            doubtful = np.argwhere(~(centre > reach))
            if doubtful.size:
                wrong = np.argwhere(centre < -reach)
                row, column = (wrong if wrong.size else doubtful)[0]
                where = ", ".join(f"{x:.4g}" for x in at[row])
                what = "is certainly wrong" if wrong.size else "cannot be distinguished from zero"
                unknowns = "(s, ℓ)" if self.straight else "(s, φ, ℓ)"
                sign = f"the sign of the {names[which[column]]} {what}"
                self.refuted = f"{sign} at {unknowns} = ({where})"
                return
        if not self.straight and not self.turns:
            self.refuted = "M_D cannot be shown to turn once while the direction of the force does"

    def pursue(self, name: str, most: int) -> None:
        """Decide more boxes of a part.

        Parameters
        ----------
        name : str
            Name of the part.
        most : int
            Approximate number of boxes to evaluate.
        """
        part, which = self.parts[name], self._which[name]

        def where(boxes: IntArray) -> Array:
            return bounds(boxes, part.domain, self.stations)

        free = part.domain[:, 0] < part.domain[:, 1]
        found = cover(
            lambda boxes: self.evaluate(name, where(boxes), which), part.undecided, most, free
        )
        part.certified = np.concatenate([part.certified, found.certified])
        part.undecided = found.undecided
        part.evaluated += found.evaluated
        if len(found.refuted):
            box = where(found.refuted)[0].tolist()
            self.refuted = f"a sign is certainly wrong in the part {name}, box {box}"

    def _direction_turns_once(self) -> bool:
        """Whether M_D is proved to turn once with the direction, on the circle s = 1, ℓ = 1/2."""
        low, high = self.parts["interior"].domain[1]
        ends = np.linspace(low, high, _ARCS + 1)
        boxes = np.tile([[1.0, 1.0], [0.0, 0.0], [0.5, 0.5]], (_ARCS, 1, 1))
        boxes[:, 1] = np.stack([ends[:-1], ends[1:]], axis=1)
        found = self.evaluate("distal", boxes, _MOMENT)[0]
        centre, reach = found[..., 0], found[..., 1:].sum(axis=-1)
        # Each arc's moments are within 45° of their centre, so neighbouring centres turn by less
        # than 90°. A half circle turns by π, because its ends are their own mirror images.
        near = 2.01 * (reach**2).sum(axis=1) < (centre**2).sum(axis=1)
        angle = np.arctan2(centre[:, 1], centre[:, 0])
        if low < 0.0:
            angle = np.append(angle, angle[:1])
        turn = float(np.unwrap(angle)[-1] - angle[0])
        return bool(near.all()) and abs(turn - (2.0 * np.pi if low < 0.0 else np.pi)) < 1.5

    def to_dataset(self) -> xr.Dataset:
        """Convert the certificate to a dataset.

        Returns
        -------
        Dataset
            Dataset of all fields, without loss.
        """
        data = {f"rod_{n}": (_dims(n, a), a) for n, a in self.rod._asdict().items()}
        data["factors"] = (("polynomial", "power"), self.bounds.factors)
        data["stations"] = (("station",), self.stations)
        for name, part in self.parts.items():
            data[f"{name}_domain"] = (("unknown", "end"), part.domain)
            for kind in ("certified", "undecided"):
                boxes = getattr(part, kind).astype(np.int32)
                data[f"{name}_{kind}"] = ((f"{name}_{kind}_box", "unknown", "level_index"), boxes)
        out = xr.Dataset(data).copy(deep=True)  # independent of the certificate's arrays
        out.attrs = {
            "kind": KIND,
            "triplet": TRIPLET,
            "whisker": self.whisker,
            "proved": int(self.proved),
            "share": self.share,
            "refuted": self.refuted,
            "straight": int(self.straight),
            "sign": self.sign,
            "cone": self.cone,
            "alpha": self.bounds.alpha,
            "room": self.bounds.room,
            "turns": int(self.turns),
            "order": _ORDER,
            "seconds": self.seconds,
            "evaluated": [part.evaluated for part in self.parts.values()],
        }
        out.attrs["identity"] = identity(out)
        return out

    @classmethod
    def from_dataset(cls, data: xr.Dataset) -> Certificate:
        """Restore a certificate from its dataset.

        Parameters
        ----------
        data : Dataset
            Dataset from `to_dataset`.

        Returns
        -------
        Certificate
            Certificate that was converted.

        Raises
        ------
        ValueError
            If the dataset is not a certificate, or has been modified.
        """
        if data.attrs.get("kind") != KIND:
            raise ValueError(
                f"not a certificate: its kind is {data.attrs.get('kind', 'missing')!r}"
            )
        if identity(data) != data.attrs.get("identity"):
            raise ValueError(
                "the certificate has been modified since it was written, or is of another version: "
                "compute a new one, in another file"
            )
        refuse_incomplete(data)
        evaluated = np.atleast_1d(data.attrs["evaluated"])
        parts = {
            name: Part(
                data[f"{name}_domain"].values,
                data[f"{name}_certified"].values.astype(np.int64),
                data[f"{name}_undecided"].values.astype(np.int64),
                int(number),
            )
            for name, number in zip(
                _PLANAR if data.attrs["straight"] else _SPATIAL, evaluated, strict=True
            )
        }
        attrs = data.attrs
        return cls(
            ExactRod(*(data[f"rod_{name}"].values for name in ExactRod._fields)),
            Bounds(float(attrs["alpha"]), data["factors"].values, float(attrs["room"])),
            data["stations"].values,
            bool(attrs["straight"]),
            float(attrs["sign"]),
            float(attrs["cone"]),
            parts,
            str(attrs["whisker"]),
            bool(attrs["turns"]),
            str(attrs["refuted"]),
            float(attrs["seconds"]),
        )

    def save(self, path: str | PathLike[str]) -> None:
        """Write the certificate as NetCDF.

        Parameters
        ----------
        path : str or path
            File, ``.nc``.
        """
        write_netcdf(Path(path), self.to_dataset())


def load_certificate(path: str | PathLike[str]) -> Certificate:
    """Read a certificate from a file.

    Parameters
    ----------
    path : str or path
        File written by `Certificate.save`.

    Returns
    -------
    Certificate
        Certificate in the file.
    """
    with in_file(path):
        return Certificate.from_dataset(read_dataset(Path(path)))


def _percent(part: Part) -> str:
    """Certified share of a part, in percent; 100 only if nothing is left."""
    return "100" if part.complete else f"{np.floor(1e5 * part.share) / 1e3:.3f}"


def _dims(name: str, array: Array) -> tuple[str, ...]:
    """Dimension names of an array of the rod."""
    return tuple(f"{name}_{i}_{size}" for i, size in enumerate(array.shape))


def prepare_certificate(contact_map: ContactMap, cone: float = CONE) -> Certificate:
    """Set up a certificate with all boxes undecided."""
    whisker = contact_map.whisker
    straight = bool(whisker.is_straight)
    if straight:
        cone = 0.0
    elif not cone > 0.0:
        raise ValueError("a curved whisker's certificate needs a cone about rest; got 0")
    rod = exact_rod(whisker)
    near = contact_map.chart.proximal
    room = 0.0 if straight else room_within(rod, cone)
    force = bounds_of(contact_map, room)
    stations = _stations(rod, near)
    turn = float(np.nextafter(np.pi, 4.0))
    angles = [] if straight else [[0.0 if is_planar(whisker) else -turn, turn]]
    unknowns = 2 if straight else 3
    whole = np.zeros((len(stations) - 1, unknowns, 2), dtype=np.int64)
    whole[:, 0, 0] = np.log2(len(whole)).astype(int)
    whole[:, 0, 1] = np.arange(len(whole))
    ends: dict[str, tuple[list[float], list[float]]] = {
        "interior": ([near, 1.0], [0.0, 1.0]),
        "proximal": ([near, near], [0.0, 1.0]),
        "distal": ([1.0, 1.0], [0.0, 1.0]),
        "fold": ([near, 1.0], [1.0, 1.0]),
        "rest": ([near, 1.0], [0.0, 1.0]),
    }
    parts = {}
    for name in _PLANAR if straight else _SPATIAL:
        reach, load = ends[name]
        start = whole if reach[0] < reach[1] else 0 * whole[:1]
        parts[name] = Part(np.array([reach, *angles, load]), start[:0], start)
    out = Certificate(rod, force, stations, straight, 1.0, cone, parts, f"{whisker!r}")
    if not straight:  # the sign at one contact, which the cover then proves everywhere
        middle = np.array([[[0.65, 0.65], [1.0, 1.0], [0.5, 0.5]]])
        out.sign = float(np.sign(out.evaluate("interior", middle, [4])[0][0, 0, 0]))
        out._tables.clear()
        out.turns = out._direction_turns_once()
    return out


def _stations(rod: ExactRod, near: float) -> Array:
    """2^k + 1 arc lengths that include the ends of the rod's pieces."""
    stations = [near, *rod.edges[rod.edges > near].tolist()]
    while (len(stations) - 1) & (len(stations) - 2):
        widest = int(np.argmax(np.diff(stations))) + 1
        stations.insert(widest, 0.5 * (stations[widest - 1] + stations[widest]))
    return np.array(stations)


def certify(
    contact_map: ContactMap,
    cone: float = CONE,
    *,
    path: str | PathLike[str] | None = None,
    seconds: float = 3600.0,
    progress: Progress | None = None,
) -> Certificate:
    """Prove that (F_x, M_B, M_D) locates every contact of a whisker outside a cone.

    Parameters
    ----------
    contact_map : ContactMap
        Map of the whisker; its base must be rigid.
    cone : float
        Half angle about the resting whisker within which contacts are excluded, rad; ignored for
        a straight whisker, which needs none.
    path : str or path, optional
        File to which the certificate is written every minute; an existing one of the same whisker
        and domain is continued.
    seconds : float
        Time after which the search stops, s, possibly with undecided boxes.
    progress : callable, optional
        Function called as ``progress(done, total)`` with thousandths of the domain.

    Returns
    -------
    Certificate
        Certificate; ``proved`` if no box is undecided and all signs are right.

    Raises
    ------
    ValueError
        If the base is compliant, or the file is a certificate of another whisker or domain.
    """
    need_map(contact_map)
    before = load_certificate(path) if path is not None and Path(path).exists() else None
    if before is None or not sum(len(part.certified) for part in before.parts.values()):
        if not 0.0 <= cone < 0.5 * np.pi:
            raise ValueError(f"cone is a half angle in rad, from 0 to below π/2; got {cone!r}")
        out = prepare_certificate(contact_map, cone)
        out.refuted = objection(contact_map, cone)
        if not out.refuted:
            out.probe()
    elif before.is_of(contact_map) and (before.straight or np.isclose(before.cone, cone)):
        out = before
    else:
        raise ValueError(f"{path} is a certificate of another whisker or domain")
    began = saved = time.monotonic()
    spent = out.seconds
    try:
        for name, part in sorted(out.parts.items(), key=lambda one: one[0] == "interior"):
            while len(part.undecided) and not out.refuted and time.monotonic() - began <= seconds:
                out.pursue(name, _BATCH)
                now = time.monotonic()
                out.seconds = spent + now - began
                if progress is not None:
                    total = sum(p.share for p in out.parts.values())
                    progress(int(1000.0 * total), 1000 * len(out.parts))
                if path is not None and now - saved > _SAVED_EVERY:
                    out.save(path)
                    saved = now
    finally:  # also if interrupted
        if path is not None:
            out.save(path)
    return out
