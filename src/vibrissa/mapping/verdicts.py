"""Which signals locate a contact: verdicts on triplets, with their evidence.

Two contacts with the same triplet are a *witness*: a proof that it does not locate the contact. The
verdict on a triplet and a region says whether there are witnesses outside the cone that is left
out; how they are searched for is told in :mod:`vibrissa.mapping.evidence`.

A whisker in one plane is special. There M_x is zero and F_D and M_D are constant for all contacts
in the plane, a surface of measure zero, so that a triplet with two of these cannot tell contacts in
the plane from each other although it may tell all others: it is *unique off a surface*.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from vibrissa.mapping.evidence import (
    OFF_SURFACE,
    WITNESSES,
    Answer,
    Question,
    answer,
    ask,
)
from vibrissa.mapping.fibres import corrected, units
from vibrissa.mapping.places import Domain
from vibrissa.mapping.resolution import TOLERANCES
from vibrissa.mapping.summary import choice, notation
from vibrissa.mapping.twins import AGREEMENT
from vibrissa.quantities import attributes
from vibrissa.rod.arrays import Array
from vibrissa.rod.batch import solve_forces
from vibrissa.rod.discretize import Discretization, discretize
from vibrissa.rod.reach import with_normal_force
from vibrissa.signals import CONE, REGIONS, SIGNALS, TRIPLETS, selection, signal_scales
from vibrissa.signals.base import signals_of

if TYPE_CHECKING:
    from vibrissa.mapping.contact_map import ContactMap

#: Contacts nearer to each other than this share of the length count as one.
SEPARATION = 0.025
#: How many contacts are tried.
SAMPLES = 4096
# Witnesses are found again with so many times the integration steps.
_FINER = 4
#: Off which surface a triplet of a planar whisker may be unique.
PLANE = "the plane of the whisker, z = 0"

Progress = Callable[[int, int], None]


def uniqueness(
    contacts: ContactMap,
    triplets: str | Sequence[str | tuple[str, ...]] = "all",
    regions: str | Sequence[str] = "all",
    *,
    min_separation: float = SEPARATION,
    cone: float = CONE,
    domain: Domain = "reachable",
    samples: int = SAMPLES,
    resolution: bool = True,
    seed: int = 0,
    progress: Progress | None = None,
) -> xr.Dataset:
    """Tell which triplets of signals locate the contact uniquely, region by region, with evidence.

    Parameters
    ----------
    contacts : ContactMap
        The whisker's map.
    triplets : "all" or sequence
        Which of the 20 triplets: names like ``"Fx MB MD"`` or tuples of signals.
    regions : "all" or sequence of str
        Which of ``"all"``, ``"ELD"`` (excluding large deflections), ``"CF"`` (concave forward),
        ``"CB"`` (concave backward), ``"ELD CF"``, ``"ELD CB"``; the text ``"all"`` means all six,
        a list ``["all"]`` the region of that name. Of a witness both contacts belong to the region.
    min_separation : float
        Contact points nearer to each other than this share of the length count as one.
    cone : float
        Contacts within this half angle about the resting whisker are left out, rad.
    domain : {"reachable", "paper"}
        All stable contacts, or those within the bounds of the paper's grid.
    samples : int
        How many contacts are tried; rounded up to a power of two.
    resolution : bool
        Whether the shares of contacts that are ambiguous within tolerances are computed too.
    seed : int
        Of the samples and of the search.
    progress : callable, optional
        Called as ``progress(done, total)`` after each triplet.

    Returns
    -------
    Dataset
        Over ``triplet`` and ``region``: ``verdict``; ``critical_cone`` (rad): the smallest cone
        without witnesses outside; ``minority_share``: share of the region's volume in which
        det ∂T/∂p has the rarer sign, and ``minority_share_one_side`` with the two sides of the
        whisker's plane taken apart (where T collapses on the plane, the sign may change there
        without a fold); ``fold_angle`` (rad): least and largest cone angle of contacts with the
        rarer sign on their side; ``twin_share``: share that has an exact twin;
        ``ambiguous_share``: share that has another contact farther than ``min_separation`` within
        a ``signal_tolerance``, a share of each signal's range; ``surface`` and ``surface_angle``
        (rad, for "unique off a surface"): off which surface, and the largest elevation from it of
        a contact that is ambiguous within the tolerance; ``witness_…``: the pairs of contacts
        farthest apart, with both contacts' arc length, force and point, the three signals, their
        relative difference (in :func:`vibrissa.deflect` with ``witness_steps``, the default but
        where signals depend on each other only as finely as the rod is integrated), the
        separation, and by how much the second contact moves when the pair is found again with
        four times the steps. ``region_share``: the regions' share of the
        contacts' space; ``notation``: the verdicts of a triplet in short. Attributes name the
        chosen triplet, the domain, the cone and the separation.

    Raises
    ------
    ValueError
        If a triplet or region is unknown, or a number is out of range.

    Examples
    --------
    >>> import vibrissa as vb
    >>> contacts = vb.ContactMap.simulate(vb.samples.straight(), grid=False)
    >>> found = vb.uniqueness(contacts, ["Fx MB MD"], resolution=False, samples=512)
    >>> str(found.verdict.sel(triplet="Fx MB MD", region="all").item())
    'unique'
    """
    names = TRIPLETS if isinstance(triplets, str) and triplets == "all" else _listed(triplets)
    wanted = REGIONS if isinstance(regions, str) and regions == "all" else _regions(regions)
    if not 0.0 < min_separation < 1.0:
        raise ValueError(
            f"min_separation is a share of the length, above 0 and below 1; got {min_separation}"
        )
    if not 0.0 <= cone < 0.5 * np.pi:
        raise ValueError(f"cone is a half angle in rad, from 0 to below π/2; got {cone}")
    if domain not in ("reachable", "paper"):
        raise ValueError(f"domain is 'reachable' or 'paper'; got {domain!r}")
    if samples < 16:
        raise ValueError(f"at least 16 samples are needed; got {samples}")
    question = ask(contacts, wanted, min_separation, cone, domain, samples, seed)
    answers = []
    for number, triplet in enumerate(names):
        answers.append(answer(question, triplet, resolution))
        if progress is not None:
            progress(number + 1, len(names))
    return _labelled(question, names, answers, resolution)


def _listed(triplets: str | Sequence[str | tuple[str, ...]]) -> tuple[tuple[str, ...], ...]:
    several = [triplets] if isinstance(triplets, str) else list(triplets)
    names = tuple(selection(triplet, exactly=3) for triplet in several)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"triplets must be named once each, at least one; got {triplets!r}")
    return names


def _regions(regions: str | Sequence[str]) -> tuple[str, ...]:
    several = [regions] if isinstance(regions, str) else list(regions)
    unknown = [region for region in several if region not in REGIONS]
    if unknown or not several or len(set(several)) < len(several):
        raise ValueError(f"regions are among {', '.join(REGIONS)}, once each; got {regions!r}")
    return tuple(several)


def _labelled(
    question: Question, names: tuple[tuple[str, ...], ...], answers: list[Answer], resolution: bool
) -> xr.Dataset:
    """Put everything into one dataset."""
    cell = ("triplet", "region")
    verdict = np.array([a.verdict for a in answers])
    data: dict[str, Any] = {
        "verdict": (cell, verdict, {"long_name": "whether the triplet locates the contact"}),
        "surface": (
            cell,
            np.where(verdict == OFF_SURFACE, PLANE, ""),
            {"long_name": "surface on which contacts cannot be told apart"},
        ),
        "critical_cone": (
            cell,
            np.stack([a.critical_cone for a in answers]),
            _about("rad", "smallest cone without witnesses outside it"),
        ),
        "minority_share": (
            cell,
            np.stack([a.local.minority for a in answers]),
            _about("1", "share in which det ∂T/∂p has the rarer sign"),
        ),
        "minority_share_one_side": (
            cell,
            np.stack([a.local.one_sided for a in answers]),
            _about("1", "the same with the sides of the whisker's plane taken apart"),
        ),
        "fold_angle": (
            (*cell, "bound"),
            np.stack([a.local.angle for a in answers]),
            _about("rad", "cone angles between which contacts have the rarer sign"),
        ),
        "twin_share": (
            cell,
            np.stack([a.twin_share for a in answers]),
            _about("1", "share that has an exact twin"),
        ),
    }
    if resolution:
        data["ambiguous_share"] = (
            (*cell, "signal_tolerance"),
            np.stack([a.ambiguous.T for a in answers]),
            _about("1", "share with another contact within the tolerance of the signals' ranges"),
        )
        data["surface_angle"] = (
            (*cell, "signal_tolerance"),
            np.stack([a.surface_angle.T for a in answers]),
            _about("rad", "elevation from the surface that ambiguous contacts reach"),
        )
    coords = {
        "triplet": [" ".join(triplet) for triplet in names],
        "region": list(question.regions),
        "signal_tolerance": list(TOLERANCES),
        "bound": ["least", "largest"],
        "pair": ["first", "second"],
        "space": ["x", "y", "z"],
        "component": ["fy", "fz"],
    }
    out = xr.Dataset(data, coords=coords).merge(_witnesses(question, names, answers))
    whisker, d = question.contacts.whisker, question.contacts.chart.discretization
    out.attrs = {
        "kind": "vibrissa uniqueness",
        "whisker": repr(whisker),
        "domain": question.domain,
        "cone": question.cone,
        "min_separation": question.separation * d.length,
        "samples": len(question.samples.chart),
        "steps": question.contacts.steps,
        "seed": question.seed,
        "volume_shares": ", ".join(
            f"{region} {share:.3f}"
            for region, share in zip(question.regions, question.volumes(), strict=True)
        ),
    }
    out["region_share"] = (
        "region",
        question.volumes(),
        _about("1", "share of the contacts' space"),
    )
    out["notation"] = (
        "triplet",
        [notation(out.verdict.sel(triplet=t)) for t in out.triplet.to_numpy()],
        {"long_name": "largest regions in which the triplet is unique; *: off a surface"},
    )
    out.attrs["chosen_triplet"], out.attrs["chosen_region"] = choice(out)
    return out


def _about(unit: str, long_name: str) -> dict[str, str]:
    return {"units": unit, "long_name": long_name}


def _witnesses(
    question: Question, names: tuple[tuple[str, ...], ...], answers: list[Answer]
) -> xr.Dataset:
    """Both contacts of each witness, in SI units, with how well they agree."""
    contacts = question.contacts
    shape = (len(names), len(question.regions), WITNESSES)
    arc_length, point = np.full((*shape, 2), np.nan), np.full((*shape, 2, 3), np.nan)
    force, signals = np.full((*shape, 2, 2), np.nan), np.full((*shape, 3), np.nan)
    apart, difference, shift = (np.full(shape, np.nan) for _ in range(3))
    for i, (triplet, found) in enumerate(zip(names, answers, strict=True)):
        which = [SIGNALS.index(name) for name in triplet]
        for j, pairs in enumerate(found.witnesses):
            n = len(pairs.apart)
            if not n:
                continue
            here = (i, j, slice(n))
            d = discretize(contacts.whisker, found.steps[j])
            finer = discretize(contacts.whisker, _FINER * found.steps[j])
            first, unit = pairs.first.contacts, units(contacts, pairs.second.contacts)
            target = pairs.first.signals[:, which]
            second, values, difference[here] = corrected(
                d, triplet, pairs.second.contacts, target, unit
            )
            both = np.stack([first, second], axis=1)
            places = np.stack([pairs.first.values, values], axis=1)
            arc_length[here], force[here] = both[..., 0] * d.length, both[..., 1:] * d.force
            point[here] = places[..., 3:] * d.length
            apart[here] = np.linalg.norm(point[here][:, 0] - point[here][:, 1], axis=1)
            signals[here] = target * signal_scales(triplet, d.force, d.moment)
            shift[here] = d.length * _moved(finer, triplet, first, second, values, unit)
    cell = ("triplet", "region", "witness")
    return xr.Dataset(
        {
            "witness_arc_length": ((*cell, "pair"), arc_length, attributes("arc_length")),
            "witness_contact_force": (
                (*cell, "pair", "component"),
                force,
                _about("N", "contact force across the whisker, along d1 and d2"),
            ),
            "witness_point": ((*cell, "pair", "space"), point, attributes("contact_point_whisker")),
            "witness_signals": (
                (*cell, "signal"),
                signals,
                _about("N, N m or rad", "signals of both, in the order of the triplet's name"),
            ),
            "witness_steps": (
                ("triplet", "region"),
                np.array([found.steps for found in answers]),
                _about("1", "integration steps with which the witnesses agree"),
            ),
            "witness_separation": (cell, apart, _about("m", "distance of the contact points")),
            "witness_difference": (
                cell,
                difference,
                _about("1", "largest difference of a signal, over |F|, |M| or in rad"),
            ),
            "witness_shift": (
                cell,
                shift,
                _about("m", f"move of the second contact at {_FINER} times the steps"),
            ),
        }
    )


def _moved(
    finer: Discretization,
    names: tuple[str, ...],
    first: Array,
    second: Array,
    values: Array,
    unit: Array,
) -> Array:
    """How far the second contact of each pair moves on a finer rod, over L."""
    which = [SIGNALS.index(name) for name in names]
    at_first, _ = solve_forces(finer, with_normal_force(first))
    target = signals_of(at_first[:, :3], np.cross(at_first[:, 3:], at_first[:, :3]))[:, which]
    _, found, misfit = corrected(finer, names, second, target, unit)
    moved = np.linalg.norm(found[:, 3:] - values[:, 3:], axis=1)
    return np.where(misfit <= AGREEMENT, moved, np.nan)
