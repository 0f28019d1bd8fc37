"""Which signals locate a contact: verdicts on triplets, with their evidence.

Two contacts with the same triplet are a *witness*: a proof that it does not locate the contact. The
verdict on a triplet and a region is whether there are witnesses outside the cone that is left out;
:mod:`vibrissa.identifiability.evidence` searches for them.

A whisker in one plane is special. There M_x is zero and F_D and M_D are constant for all contacts
in the plane, a surface of measure zero, so that a triplet with two of these cannot distinguish
contacts in the plane although it may distinguish all others: it is *unique off a surface*.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from vibrissa.contacts import Domain, Progress
from vibrissa.identifiability.evidence import (
    OFF_SURFACE,
    TOLERANCES,
    WITNESSES,
    Answer,
    Question,
    answer,
    ask,
)
from vibrissa.identifiability.summary import choice, notation
from vibrissa.identifiability.twins import (
    FINER,
    Pairs,
    corrected,
    found_again,
    signal_columns,
    units,
)
from vibrissa.numerics import Array
from vibrissa.quantities import attributes
from vibrissa.rod import discretize
from vibrissa.signals import CONE, REGIONS, SIGNALS, TRIPLETS, selection, signal_scales

if TYPE_CHECKING:
    from vibrissa.contacts import ContactMap

#: Contacts nearer to each other than this share of the length count as one.
SEPARATION = 0.025
#: Number of contacts that are tried.
SAMPLES = 4096


def _about(unit: str, long_name: str) -> dict[str, str]:
    return {"units": unit, "long_name": long_name}


# Variables over (triplet, region) and further dimensions, with their attributes.
_VARIABLES: dict[str, tuple[tuple[str, ...], dict[str, str]]] = {
    "verdict": ((), {"long_name": "whether the triplet locates the contact"}),
    "critical_cone": ((), _about("rad", "smallest cone without witnesses outside it")),
    "minority_share": ((), _about("1", "share in which det ∂T/∂p has the rarer sign")),
    "minority_share_one_side": (
        (),
        _about("1", "the same with the sides of the whisker's plane separated"),
    ),
    "fold_angle": (
        ("bound",),
        _about("rad", "cone angles between which contacts have the rarer sign"),
    ),
    "twin_share": ((), _about("1", "share that has an exact twin")),
    "ambiguous_share": (
        ("signal_tolerance",),
        _about("1", "share with another contact within the tolerance of the signals' ranges"),
    ),
    "surface_angle": (
        ("signal_tolerance",),
        _about("rad", "elevation of ambiguous contacts from the surface, the largest"),
    ),
}
# Variables of witnesses, over (triplet, region, witness) and further dimensions.
_WITNESS_VARIABLES: dict[str, tuple[tuple[str, ...], dict[str, Any]]] = {
    "arc_length": (("pair",), attributes("arc_length")),
    "contact_force": (
        ("pair", "component"),
        _about("N", "contact force across the whisker, along d1 and d2"),
    ),
    "point": (("pair", "space"), attributes("contact_point_whisker")),
    "signals": (
        ("signal",),
        _about("N, N m or rad", "signals of both, in the order of the triplet's name"),
    ),
    "separation": ((), _about("m", "distance of the contact points")),
    "difference": ((), _about("1", "largest difference of a signal, over |F|, |M| or in rad")),
    "shift": ((), _about("m", f"move of the second contact at {FINER} times the steps")),
}
_SIZES = {"pair": 2, "component": 2, "space": 3, "signal": 3}


def uniqueness(
    contact_map: ContactMap,
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
    """Decide which triplets of signals locate the contact uniquely, by region, with evidence.

    Parameters
    ----------
    contact_map : ContactMap
        The whisker's map.
    triplets : "all" or sequence
        Triplets, of the 20: names like ``"Fx MB MD"`` or tuples of signals; or three signals.
    regions : "all" or sequence of str
        Regions: ``"all"``, ``"ELD"`` (excluding large deflections), ``"CF"`` (concave forward),
        ``"CB"`` (concave backward), ``"ELD CF"``, ``"ELD CB"``; the text ``"all"`` means all six,
        a list ``["all"]`` the region of that name. Of a witness both contacts belong to the region.
    min_separation : float
        Distance, as a share of the length, below which two contact points count as one.
    cone : float
        Half angle about the resting whisker within which contacts are left out, rad.
    domain : {"reachable", "paper"}
        Domain of contacts: all stable ones, or those within the bounds of the paper's grid.
    samples : int
        Number of contacts that are tried; rounded up to a power of two.
    resolution : bool
        Whether the shares of contacts that are ambiguous within tolerances are computed too.
    seed : int
        Seed of the samples and of the search.
    progress : callable, optional
        Function called as ``progress(done, total)`` after each triplet.

    Returns
    -------
    Dataset
        Over ``triplet`` and ``region``: ``verdict``; ``critical_cone`` (rad): the smallest cone
        without witnesses outside; ``minority_share``: share of the region's volume in which
        det ∂T/∂p has the rarer sign, and ``minority_share_one_side`` with the two sides of the
        whisker's plane separated (where T collapses on the plane, the sign may change there
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
    >>> contact_map = vb.ContactMap.simulate(vb.samples.straight(), grid=False)
    >>> found = vb.uniqueness(contact_map, ["Fx MB MD"], resolution=False, samples=512)
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
    question = ask(contact_map, wanted, min_separation, cone, domain, samples, seed)
    answers = []
    for number, triplet in enumerate(names):
        answers.append(answer(question, triplet, resolution))
        if progress is not None:
            progress(number + 1, len(names))
    return _labelled(question, names, answers)


def _listed(triplets: str | Sequence[str | tuple[str, ...]]) -> tuple[tuple[str, ...], ...]:
    several: list[str | tuple[str, ...]] = (
        [triplets] if isinstance(triplets, str) else list(triplets)
    )
    if several and all(triplet in SIGNALS for triplet in several):
        several = [tuple(map(str, several))]  # one triplet, signal by signal
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
    question: Question,
    names: tuple[tuple[str, ...], ...],
    answers: list[Answer],
) -> xr.Dataset:
    """All verdicts and evidence as one dataset."""
    data: dict[str, Any] = {
        name: (
            ("triplet", "region", *dims),
            np.stack([a.variables[name] for a in answers]),
            about,
        )
        for name, (dims, about) in _VARIABLES.items()
        if name in answers[0].variables
    }
    surfaces = np.where(data["verdict"][1] == OFF_SURFACE, _surface(question), "")
    data["surface"] = (
        ("triplet", "region"),
        surfaces,
        {"long_name": "surface on which contacts have the same signals"},
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
    whisker, d = question.contact_map.whisker, question.contact_map.chart.discretization
    out.attrs = {
        "kind": "vibrissa uniqueness",
        "whisker": repr(whisker),
        "domain": question.domain,
        "cone": question.cone,
        "min_separation": question.separation * d.length,
        "samples": len(question.samples.chart),
        "steps": question.contact_map.steps,
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


def _surface(question: Question) -> str:
    """Surface off which a triplet of a planar whisker may be unique."""
    y, z = question.normal[1:]
    turned = float(np.rad2deg(np.arctan2(-y, z)))
    where = "z = 0" if abs(turned) < 1e-6 else f"turned by {turned:.4g}° about x from z = 0"
    return f"the plane of the whisker, {where}"


def _witnesses(
    question: Question, names: tuple[tuple[str, ...], ...], answers: list[Answer]
) -> xr.Dataset:
    """Both contacts of each witness, in SI units, with how well they agree."""
    cells = (len(names), len(question.regions), WITNESSES)
    arrays = {
        name: np.full((*cells, *(_SIZES[dim] for dim in dims)), np.nan)
        for name, (dims, _) in _WITNESS_VARIABLES.items()
    }
    for i, (triplet, found) in enumerate(zip(names, answers, strict=True)):
        for j, pairs in enumerate(found.witnesses):
            if n := len(pairs.apart):
                for name, values in _witness(question, triplet, pairs, found.steps[j]).items():
                    arrays[name][i, j, :n] = values
    data: dict[str, Any] = {
        f"witness_{name}": (("triplet", "region", "witness", *dims), arrays[name], about)
        for name, (dims, about) in _WITNESS_VARIABLES.items()
    }
    data["witness_steps"] = (
        ("triplet", "region"),
        np.array([found.steps for found in answers]),
        _about("1", "integration steps with which the witnesses agree"),
    )
    return xr.Dataset(data)


def _witness(
    question: Question, triplet: tuple[str, ...], pairs: Pairs, steps: int
) -> dict[str, Array]:
    """Variables of the witnesses of one triplet and region."""
    contact_map = question.contact_map
    d = discretize(contact_map.whisker, steps)
    target = pairs.first.signals[:, signal_columns(triplet)]
    unit = units(contact_map, pairs.second.xi)
    second, values, difference = corrected(d, triplet, pairs.second.xi, target, unit)
    both = np.stack([pairs.first.xi, second], axis=1)
    point = d.length * np.stack([pairs.first.values[:, 3:], values[:, 3:]], axis=1)
    _, moved = found_again(contact_map, triplet, pairs.first.xi, second, steps)
    return {
        "arc_length": both[..., 0] * d.length,
        "contact_force": both[..., 1:] * d.force,
        "point": point,
        "signals": target * signal_scales(triplet, d.force, d.moment),
        "separation": np.linalg.norm(point[:, 0] - point[:, 1], axis=1),
        "difference": difference,
        "shift": d.length * moved,
    }
