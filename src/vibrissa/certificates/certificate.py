"""A certificate that (F_x, M_B, M_D) locates every contact: boxes on which all signs are certain.

The lemma (theory page) needs signs of conditions on a solid domain of contacts and on some of its
faces; each is a *part* with a cover of its own:

- ``interior``: the whole domain;
- ``proximal``, ``distal``: the faces at the smallest and the largest arc length of a contact;
- ``fold``: the face of the largest force, beyond the fold, so that the domain holds Ω.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from vibrissa.certificates.conditions import (
    Conditions,
    conditions_on,
    planar_conditions,
    spatial_conditions,
)
from vibrissa.certificates.domain import Bounds, bounds_of
from vibrissa.certificates.equations import ExactRod, exact_rod
from vibrissa.certificates.search import Cover, cover, volume
from vibrissa.io import read_dataset, write_netcdf
from vibrissa.numerics import Array, IntArray, share_out
from vibrissa.signals import CONE

if TYPE_CHECKING:
    from vibrissa.contacts import ContactMap

#: The triplet that certificates are for.
TRIPLET = "Fx MB MD"
KIND = "vibrissa certificate"
_ORDER = 8
# Share of the states to which the last Taylor coefficient falls in a step, by part.
_TOLERANCES = {"interior": 1e-5, "proximal": 1e-6, "distal": 1e-6, "fold": 1e-6}
# Conditions by part: of the straight whisker, and of any.
_WANTED = {"interior": ((0, 1, 2), (0, 1, 2, 3)), "proximal": ((3,), (0, 4, 5))}
_WANTED |= {"distal": _WANTED["proximal"], "fold": ((0, 1), (0,))}
# Boxes that are evaluated between two looks at the clock.
_AT_A_TIME = 2048
# How often a certificate that is being made is written, s.
_SAVED_EVERY = 60.0

Progress = Callable[[int, int], None]


@dataclass
class Part:
    """One part of the domain and the boxes that cover it.

    Parameters
    ----------
    domain : (unknowns, 2) array
        Bounds of the unknowns; equal ones where a face fixes one.
    certified, undecided : (n, unknowns, 2) arrays
        Levels and indices of boxes.
    evaluated : int
        Number of boxes evaluated so far.
    """

    domain: Array
    certified: IntArray
    undecided: IntArray
    evaluated: int = 0

    @property
    def share(self) -> float:
        """Share of the part's volume that is certified."""
        return float(1.0 - volume(self.undecided).sum())


@dataclass
class Certificate:
    """Boxes that prove that a whisker's (F_x, M_B, M_D) locates every contact outside a cone.

    Parameters
    ----------
    rod : ExactRod
        Whisker as polynomials with exact coefficients.
    bounds : Bounds
        Bounds on the force.
    straight : bool
        Whether the whisker is straight, so that contacts in one plane stand for all.
    sign : float
        Sign of the determinant.
    cone : float
        Half angle about the resting whisker that is left out, rad.
    parts : dict of Part
        Boxes by part.
    whisker : str
        Description of the whisker.
    refuted : str
        Where a condition certainly fails; empty if nowhere.
    seconds : float
        Time spent, s.
    """

    rod: ExactRod
    bounds: Bounds
    straight: bool
    sign: float
    cone: float
    parts: dict[str, Part]
    whisker: str = ""
    refuted: str = ""
    seconds: float = 0.0
    _tables: dict[bool, Conditions] = field(default_factory=dict, repr=False, compare=False)

    @property
    def proved(self) -> bool:
        """Whether the theorem follows: all signs are certain everywhere.

        Never of a curved whisker: that M_D turns once, and that what is left out is within the
        cone, is not shown yet.
        """
        decided = all(not len(part.undecided) for part in self.parts.values())
        return self.straight and decided and not self.refuted

    @property
    def share(self) -> float:
        """Share of the domain's volume on which the signs are certain."""
        return self.parts["interior"].share

    @property
    def identity(self) -> str:
        """Hash of the whisker and the domain."""
        digest = hashlib.sha256()
        for array in (*self.rod, self.bounds.packed(), self.parts["interior"].domain):
            digest.update(np.ascontiguousarray(array, dtype=np.float64).tobytes())
        return digest.hexdigest()[:16]

    def summary(self) -> str:
        """State in words what is proved and what is not.

        Returns
        -------
        str
            One sentence, and one for each part that is not decided.
        """
        left = np.rad2deg(self.cone)
        where = f" outside the cone of {left:.3g}°" if self.cone > 0.0 else ""
        number = sum(len(part.certified) for part in self.parts.values())
        if self.proved:
            return (
                f"Certificate: (Fx, MB, MD) is unique (proved){where}, by {number} boxes found in "
                f"{self.seconds:.0f} s."
            )
        if self.refuted:
            return f"No certificate{where}: a sign is wrong, {self.refuted}."
        shares = ", ".join(f"{n} {100.0 * p.share:.3f} %" for n, p in self.parts.items())
        return f"Certificate{where} not finished: certain by now {shares}; run again to continue."

    def is_of(self, contact_map: ContactMap) -> bool:
        """Whether it is of a map's whisker, and reaches as near to the base as the map does.

        Parameters
        ----------
        contact_map : ContactMap
            Map of a whisker.

        Returns
        -------
        bool
            Whether the polynomials are the same.
        """
        if contact_map.whisker.base_stiffness is not None:
            return False
        rod = exact_rod(contact_map.whisker)
        same = all(np.array_equal(a, b) for a, b in zip(self.rod, rod, strict=True))
        return same and bool(self.parts["interior"].domain[0, 0] <= contact_map.chart.proximal)

    def evaluate(self, name: str, boxes: Array) -> tuple[Array, Array]:
        """Enclose the conditions of a part.

        Parameters
        ----------
        name : str
            Name of the part.
        boxes : (n, unknowns, 2) array
            Bounds of the unknowns.

        Returns
        -------
        conditions : (n, c, unknowns + 2) array
            Centres, shares of the unknowns and remainders.
        widths : (n, unknowns) array
            Relative widths by unknown.
        """
        fold = name == "fold"
        if fold not in self._tables:
            tables = (
                planar_conditions(fold) if self.straight else spatial_conditions(self.sign, fold)
            )
            self._tables[fold] = tables
        tables = self._tables[fold]
        unknowns = tables.unknowns
        found = np.empty((len(boxes), len(tables.conditions), unknowns + 2))
        widths = np.empty((len(boxes), unknowns))
        bound, tolerance = self.bounds.packed(), _TOLERANCES[name]
        share_out(
            len(boxes),
            lambda first, end: conditions_on(
                tables, self.rod, bound, boxes, _ORDER, tolerance, found, widths, first, end
            ),
        )
        return found[:, _WANTED[name][0 if self.straight else 1]], widths

    def pursue(self, name: str, most: int) -> None:
        """Decide more boxes of a part.

        Parameters
        ----------
        name : str
            Name of the part.
        most : int
            Number of boxes that are evaluated, about.
        """
        part = self.parts[name]
        found: Cover = cover(
            lambda boxes: self.evaluate(name, boxes), part.domain, part.undecided, most
        )
        part.certified = np.concatenate([part.certified, found.certified])
        part.undecided = found.undecided
        part.evaluated += found.evaluated
        if found.refuted.size:
            self.refuted = f"{name}: in {found.refuted.tolist()}"

    def to_dataset(self) -> xr.Dataset:
        """Write it as a dataset.

        Returns
        -------
        Dataset
            All of it, without loss.
        """
        data = {f"rod_{n}": (_dims(n, a), a) for n, a in self.rod._asdict().items()}
        data["factors"] = (("polynomial", "power"), self.bounds.factors)
        for name, part in self.parts.items():
            data[f"{name}_domain"] = (("unknown", "end"), part.domain)
            for kind in ("certified", "undecided"):
                boxes = getattr(part, kind).astype(np.int32)
                data[f"{name}_{kind}"] = ((f"{name}_{kind}_box", "unknown", "level_index"), boxes)
        out = xr.Dataset(data)
        out.attrs = {
            "kind": KIND,
            "triplet": TRIPLET,
            "whisker": self.whisker,
            "identity": self.identity,
            "proved": int(self.proved),
            "share": self.share,
            "refuted": self.refuted,
            "straight": int(self.straight),
            "sign": self.sign,
            "cone": self.cone,
            "alpha": self.bounds.alpha,
            "order": _ORDER,
            "seconds": self.seconds,
            "evaluated": [self.parts[name].evaluated for name in _WANTED],
        }
        return out

    @classmethod
    def from_dataset(cls, data: xr.Dataset) -> Certificate:
        """Make a certificate again from its dataset.

        Parameters
        ----------
        data : Dataset
            Dataset that `to_dataset` wrote.

        Returns
        -------
        Certificate
            The certificate.

        Raises
        ------
        ValueError
            If the dataset is not a certificate, or its numbers are not those it was written with.
        """
        if data.attrs.get("kind") != KIND:
            raise ValueError(
                f"not a certificate: its kind is {data.attrs.get('kind', 'missing')!r}"
            )
        evaluated = np.atleast_1d(data.attrs["evaluated"])
        parts = {
            name: Part(
                data[f"{name}_domain"].values,
                data[f"{name}_certified"].values.astype(np.int64),
                data[f"{name}_undecided"].values.astype(np.int64),
                int(number),
            )
            for name, number in zip(_WANTED, evaluated, strict=True)
        }
        out = cls(
            ExactRod(*(data[f"rod_{name}"].values for name in ExactRod._fields)),
            Bounds(float(data.attrs["alpha"]), data["factors"].values),
            bool(data.attrs["straight"]),
            float(data.attrs["sign"]),
            float(data.attrs["cone"]),
            parts,
            str(data.attrs["whisker"]),
            str(data.attrs["refuted"]),
            float(data.attrs["seconds"]),
        )
        if out.identity != data.attrs["identity"]:
            raise ValueError("the certificate's numbers are not those that it was written with")
        return out

    def save(self, path: str | PathLike[str]) -> None:
        """Write it as NetCDF.

        Parameters
        ----------
        path : str or path
            File, ``.nc``.
        """
        write_netcdf(Path(path), self.to_dataset())


def load_certificate(path: str | PathLike[str]) -> Certificate:
    """Read a certificate.

    Parameters
    ----------
    path : str or path
        File that `Certificate.save` wrote.

    Returns
    -------
    Certificate
        The certificate.
    """
    return Certificate.from_dataset(read_dataset(Path(path)))


def _dims(name: str, array: Array) -> tuple[str, ...]:
    return tuple(f"{name}_{i}_{size}" for i, size in enumerate(array.shape))


def prepared(contact_map: ContactMap, cone: float = CONE) -> Certificate:
    """Set up a certificate, with nothing decided yet.

    Parameters
    ----------
    contact_map : ContactMap
        Map of the whisker.
    cone : float
        Half angle about the resting whisker within which contacts are left out, rad; a straight
        whisker needs none.

    Returns
    -------
    Certificate
        The certificate to be pursued.
    """
    whisker = contact_map.whisker
    straight = bool(whisker.is_straight)
    if straight:
        cone = 0.0
    bounds = bounds_of(contact_map, cone)
    near = contact_map.chart.proximal
    planar = not np.any(whisker.intrinsic_curvature.coefficients[..., :2])
    turn = float(np.nextafter(np.pi, 4.0))
    angles = [] if straight else [[0.0 if planar else -turn, turn]]
    start = np.zeros((1, 2 if straight else 3, 2), dtype=np.int64)
    parts = {
        name: Part(np.array([reach, *angles, load]), start[:0], start)
        for name, reach, load in (
            ("interior", [near, 1.0], [0.0, 1.0]),
            ("proximal", [near, near], [0.0, 1.0]),
            ("distal", [1.0, 1.0], [0.0, 1.0]),
            ("fold", [near, 1.0], [1.0, 1.0]),
        )
    }
    out = Certificate(exact_rod(whisker), bounds, straight, 1.0, cone, parts, f"{whisker!r}")
    if not straight:  # the sign at one contact, which the cover then shows everywhere
        middle = np.array([[[0.65, 0.65], [1.0, 1.0], [0.5, 0.5]]])
        out.sign = float(np.sign(out.evaluate("interior", middle)[0][0, 3, 0]))
        out._tables.clear()
    return out


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
        Map of the whisker; of a rigid base.
    cone : float
        Half angle about the resting whisker within which contacts are left out, rad; a straight
        whisker needs none.
    path : str or path, optional
        File that the certificate is written to, every minute; one of the same whisker and domain
        that is there already is continued.
    seconds : float
        Time after which the search stops, s, with some of the domain undecided.
    progress : callable, optional
        Function called as ``progress(done, total)`` with thousandths of the domain.

    Returns
    -------
    Certificate
        The certificate, with what is undecided; ``proved`` where nothing is.

    Raises
    ------
    ValueError
        If the base is compliant, or the file is a certificate of another whisker or domain.
    """
    out = prepared(contact_map, cone)
    if path is not None and Path(path).exists():
        before = load_certificate(path)
        if before.identity != out.identity:
            raise ValueError(f"{path} is a certificate of another whisker or domain")
        out = before
    began, saved = time.monotonic(), time.monotonic()
    spent = out.seconds
    for name in _WANTED:
        part = out.parts[name]
        while len(part.undecided) and not out.refuted:
            out.pursue(name, _AT_A_TIME)
            now = time.monotonic()
            out.seconds = spent + now - began
            if progress is not None:
                progress(int(1000.0 * sum(p.share for p in out.parts.values())), 4000)
            if path is not None and now - saved > _SAVED_EVERY:
                out.save(path)
                saved = now
            if now - began > seconds:
                break
    if path is not None:
        out.save(path)
    return out
