"""Verdicts: which signals locate a contact, with the evidence.

Two contacts with the same triplet are a *witness*: a proof that it does not locate the contact. The
verdict on a triplet and a region is whether there are witnesses outside the cone that is left out;
:mod:`vibrissa.identifiability.evidence` searches for them.

A whisker in one plane is special. There M_x is zero and F_D and M_D are constant for all contacts
in the plane, a surface of measure zero, so that a triplet with two of these cannot distinguish
contacts in the plane although it may distinguish all others: it is *unique off a surface*.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from vibrissa.certificates import TRIPLET, Certificate, outlook
from vibrissa.contacts import Domain, Progress
from vibrissa.identifiability.evidence import (
    EMPTY,
    NOT_UNIQUE,
    OFF_SURFACE,
    TOLERANCES,
    UNIQUE,
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
    equations,
    found_again,
    signal_columns,
    sizes,
    units,
)
from vibrissa.numerics import AnyArray, Array, cross, threads
from vibrissa.quantities import attributes
from vibrissa.rod import Discretization, discretize, solve_forces, with_normal_force
from vibrissa.signals import CONE, REGIONS, SIGNALS, TRIPLETS, selection, signal_scales, signals_of

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
    "critical_cone": ((), _about("rad", "largest cone that a witness found is outside of")),
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
    "twin_distance": ((), _about("m", "distance of exact twins, the median")),
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
    "difference": (
        (),
        _about("1", "largest difference of a signal on a finer rod, over |F|, |M| or in rad"),
    ),
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
    certificate: Certificate | None = None,
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
    certificate : Certificate, optional
        Proof for this whisker, of `vibrissa.certificates.certify`, that makes "unique" proved
        where it applies.
    progress : callable, optional
        Function called as ``progress(done, total)`` after each triplet.

    Returns
    -------
    Dataset
        Over ``triplet`` and ``region``: ``verdict``; ``evidence``: "proved" by the certificate,
        "no counterexample found" or "witness"; ``critical_cone`` (rad): the cone angle of the
        witness farthest from rest, a lower bound of the critical cone; ``minority_share``: share of
        the region's volume in which det ∂T/∂p has the rarer sign, and ``minority_share_one_side``
        with the two sides of the whisker's plane separated (where T collapses on the plane, the
        sign may change there without a fold); ``fold_angle`` (rad): least and largest cone angle
        of contacts with the rarer sign on their side; ``twin_share``: share that has an exact
        twin, and ``twin_distance``, the median distance of these (m); ``ambiguous_share``: share
        that has another contact farther than ``min_separation`` within
        a ``signal_tolerance``, a share of each signal's range; ``surface`` and ``surface_angle``
        (rad, for "unique off a surface"): off which surface, and the largest elevation from it of
        a contact that is ambiguous within the tolerance; ``witness_…``: the pairs of contacts
        farthest apart, with both contacts' arc length, force and point, the three signals, their
        relative difference when the pair is integrated more finely (the signals agree to 1e-10 in
        :func:`vibrissa.deflect` with ``witness_steps``, with which the rod has converged), the
        separation, and by how much the second contact moves when the pair is found again with
        four times the steps. ``region_share``: the regions' share of the
        contacts' space; ``notation``: the verdicts of a triplet in short. Attributes name the
        chosen triplet, the domain, the cone and the separation, and what a grid shows of a
        certificate for (F_x, M_B, M_D): whether one can exist outside the cone
        (``certificate_possible``), and outside which cone the determinant keeps its sign
        (``determinant_cone``, rad).

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
    if not hasattr(contact_map, "chart"):
        raise ValueError(
            f"a ContactMap is needed, such as ContactMap.simulate(whisker); got {contact_map!r}"
        )
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
    with ThreadPoolExecutor(threads()) as pool:  # half of the time is that of kernels
        try:
            for found in pool.map(lambda triplet: answer(question, triplet, resolution), names):
                answers.append(found)
                if progress is not None:
                    progress(len(answers), len(names))
        finally:
            pool.shutdown(cancel_futures=True)
    return _labelled(question, names, answers, certificate)


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
    certificate: Certificate | None,
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
    data["evidence"] = (
        ("triplet", "region"),
        _evidence(question, names, data["verdict"][1], certificate),
        {"long_name": "evidence for the verdict"},
    )
    surfaces = np.where(data["verdict"][1] == OFF_SURFACE, _surface(question), "")
    data["surface"] = (
        ("triplet", "region"),
        surfaces,
        {"long_name": "surface on which contacts have the same signals"},
    )
    shares = question.volumes()
    data["region_share"] = ("region", shares, _about("1", "share of the contacts' space"))
    coords = {
        "triplet": [" ".join(triplet) for triplet in names],
        "region": list(question.regions),
        "signal_tolerance": list(TOLERANCES),
        "bound": ["least", "largest"],
        "pair": ["first", "second"],
        "space": ["x", "y", "z"],
        "component": ["fy", "fz"],
    }
    data["notation"] = (
        "triplet",
        [notation(dict(zip(question.regions, row, strict=True))) for row in data["verdict"][1]],
        {"long_name": "largest regions in which the triplet is unique; *: off a surface"},
    )
    data |= _witnesses(question, names, answers)  # merging datasets would import dask
    out = xr.Dataset(data, coords=coords)
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
            f"{region} {share:.3f}" for region, share in zip(question.regions, shares, strict=True)
        ),
    }
    if TRIPLET in out.triplet.values and whisker.base_stiffness is None:
        seen = outlook(question.contact_map, question.cone)
        out.attrs["certificate_possible"] = int(seen.possible)
        out.attrs["determinant_cone"] = seen.determinant_cone
    out.attrs["chosen_triplet"], out.attrs["chosen_region"] = choice(out)
    return out


def _evidence(
    question: Question,
    names: tuple[tuple[str, ...], ...],
    verdict: AnyArray,
    certificate: Certificate | None,
) -> AnyArray:
    """Evidence of each verdict, (triplets, regions).

    A certificate is for all stable contacts outside a cone, and so for every region and domain.
    """
    words = {NOT_UNIQUE: "witness", EMPTY: ""}
    out = np.vectorize(lambda word: words.get(str(word), "no counterexample found"))(verdict)
    if certificate is None:
        return np.asarray(out)
    if not certificate.is_of(question.contact_map):
        raise ValueError("the certificate is of another whisker or for other arc lengths")
    if certificate.proved and certificate.cone <= question.cone:
        # In one plane F_x and M_B fix the contact but for a turn, which either direction shows.
        proved = (TRIPLET, "Fx FD MB") if certificate.straight else (TRIPLET,)
        rows = np.isin([" ".join(triplet) for triplet in names], proved)
        out[rows[:, None] & (verdict == UNIQUE)] = "proved"
    return np.asarray(out)


def _solved(d: Discretization, triplet: tuple[str, ...], xi: Array) -> tuple[Array, Array]:
    """Triplet and contact point of contacts."""
    values, _ = solve_forces(d, with_normal_force(xi))
    force, point = values[:, :3], values[:, 3:]
    return signals_of(force, cross(point, force))[:, signal_columns(triplet)], point


def _surface(question: Question) -> str:
    """Surface off which a triplet of a planar whisker may be unique."""
    y, z = question.normal[1:]
    turned = float(np.rad2deg(np.arctan2(-y, z)))
    where = "z = 0" if abs(turned) < 1e-6 else f"turned by {turned:.4g}° about x from z = 0"
    return f"the plane of the whisker, {where}"


def _witnesses(
    question: Question, names: tuple[tuple[str, ...], ...], answers: list[Answer]
) -> dict[str, Any]:
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
        FINER * np.array([found.steps for found in answers]),
        _about("1", "integration steps with which the witnesses agree"),
    )
    return data


def _witness(
    question: Question, triplet: tuple[str, ...], pairs: Pairs, steps: int
) -> dict[str, Array]:
    """Variables of the witnesses of one triplet and region, on a rod that has converged."""
    contact_map = question.contact_map
    d, finest = (discretize(contact_map.whisker, n * FINER * steps) for n in (1, 2))
    first, unit = pairs.first.xi, units(contact_map, pairs.second.xi)
    signals, point = _solved(d, triplet, first)
    second, values, _ = corrected(d, triplet, pairs.second.xi, signals, unit)
    both = np.stack([first, second], axis=1)
    point = d.length * np.stack([point, values[:, 3:]], axis=1)
    _, moved = found_again(contact_map, triplet, first, pairs.second.xi, steps)
    away, _, values = equations(finest, triplet, second, _solved(finest, triplet, first)[0])
    difference = np.abs(away / sizes(values, triplet)).max(axis=1)
    return {
        "arc_length": both[..., 0] * d.length,
        "contact_force": both[..., 1:] * d.force,
        "point": point,
        "signals": signals * signal_scales(triplet, d.force, d.moment),
        "separation": np.linalg.norm(point[:, 0] - point[:, 1], axis=1),
        "difference": difference,
        "shift": d.length * moved,
    }
