"""Which signals locate a contact: verdicts on triplets, with their evidence.

Two contacts with the same triplet are a *witness*: a proof that it does not locate the contact. The
verdict on a triplet and a region says whether there are witnesses outside the cone that is left
out; how they are searched for is told in :mod:`vibrissa.identifiability.evidence`.

A whisker in one plane is special. There M_x is zero and F_D and M_D are constant for all contacts
in the plane, a surface of measure zero, so that a triplet with two of these cannot tell contacts in
the plane from each other although it may tell all others: it is *unique off a surface*.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from vibrissa.contacts.contact_map import Domain, Progress
from vibrissa.identifiability.evidence import answer, ask
from vibrissa.identifiability.evidence_dataset import labelled
from vibrissa.signals import CONE, REGIONS, SIGNALS, TRIPLETS, selection

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

#: Contacts nearer to each other than this share of the length count as one.
SEPARATION = 0.025
#: How many contacts are tried.
SAMPLES = 4096


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
    """Tell which triplets of signals locate the contact uniquely, region by region, with evidence.

    Parameters
    ----------
    contact_map : ContactMap
        The whisker's map.
    triplets : "all" or sequence
        Which of the 20 triplets: names like ``"Fx MB MD"`` or tuples of signals; or three signals.
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
    return labelled(question, names, answers, resolution)


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
