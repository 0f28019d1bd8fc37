"""Verdicts on which triplets of signals locate contacts, with the evidence.

Two contacts with the same triplet are a *witness*: a proof that the triplet does not locate the
contact. The verdict on a triplet and a region states whether there are witnesses outside the
excluded cone; :mod:`vibrissa.identifiability.evidence` searches for them.

A planar whisker is special. For contacts in its plane, a surface of measure zero, M_x is zero and
F_D and M_D are constant, so a triplet with two of these cannot distinguish contacts in the plane,
although it may distinguish all others: it is *unique off a surface*.

Verdicts can be summarised in short notation, formatted as a table or written to files; they also
determine the triplet to use.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from vibrissa.certificates import TRIPLET, Certificate, outlook
from vibrissa.contacts import ContactMap, Domain, Progress, need_map
from vibrissa.identifiability.evidence import (
    EMPTY,
    NOT_UNIQUE,
    OFF_SURFACE,
    TOLERANCES,
    UNIQUE,
    WITNESSES,
    Evidence,
    Problem,
    gather_evidence,
    prepare,
)
from vibrissa.identifiability.twins import (
    FINER,
    Pairs,
    correct,
    equations,
    resolve_on_finer_rod,
    signals_and_points,
    sizes,
    units,
)
from vibrissa.io import check_writable, replacing, write_netcdf
from vibrissa.numerics import AnyArray, Array, on_one_core, threads
from vibrissa.quantities import attributes
from vibrissa.rod import discretize
from vibrissa.signals import CONE, REGIONS, SIGNALS, TRIPLETS, selection, signal_scales

# Regions contained in each region.
_SUBREGIONS = {
    "all": {"ELD", "CF", "CB", "ELD CF", "ELD CB"},
    "ELD": {"ELD CF", "ELD CB"},
    "CF": {"ELD CF"},
    "CB": {"ELD CB"},
    "ELD CF": set(),
    "ELD CB": set(),
}
_MARKS = {UNIQUE: "unique", OFF_SURFACE: "unique*", NOT_UNIQUE: "–"}
#: Suffixes of files to which verdicts can be written.
ENDINGS = (".nc", ".csv")
# Number of triplets per core above which each has one core, instead of sharing all of them.
_PER_CORE = 4
# Tolerance at which ambiguous shares decide between triplets that are unique in the same region.
_DECIDING = 1e-3


def notation(words: Mapping[str, str]) -> str:
    """Summarise a triplet's verdicts, given by region, in short notation."""
    word = {region: str(verdict) for region, verdict in words.items()}
    good = [region for region in word if word[region] in (UNIQUE, OFF_SURFACE)]
    # A part adds information only if it is unique where the whole is unique off a surface.
    largest = [
        region
        for region in good
        if not any(region in _SUBREGIONS[other] and word[other] == word[region] for other in good)
        and not any(region in _SUBREGIONS[other] and word[other] == UNIQUE for other in good)
    ]
    names = [
        ("All" if r == "all" else r) + ("*" if word[r] == OFF_SURFACE else "") for r in largest
    ]
    return " / ".join(names) or "–"


def choice(verdicts: xr.Dataset) -> tuple[str, str]:
    """Choose the triplet to use, with its region, as in the paper's Fig. 1C."""
    best: tuple[float, float, float] | None = None
    chosen = ("", "")
    share = verdicts.region_share.to_series()
    for triplet in verdicts.triplet.to_numpy():
        for region in verdicts.region.to_numpy():
            cell = verdicts.sel(triplet=triplet, region=region)
            word = str(cell.verdict.item())
            if word not in (UNIQUE, OFF_SURFACE):
                continue
            ambiguous = 0.0
            if "ambiguous_share" in verdicts:
                ambiguous = float(cell.ambiguous_share.sel(signal_tolerance=_DECIDING))
            rank = (-round(float(share[region]), 9), float(word == OFF_SURFACE), ambiguous)
            if best is None or rank < best:
                best, chosen = rank, (str(triplet), str(region))
    return chosen


def verdict_words(cell: xr.Dataset) -> str:
    """Format a verdict with its evidence, such as "unique (proved)"."""
    evidence = str(cell["evidence"].item()) if "evidence" in cell else ""
    return str(cell["verdict"].item()) + (f" ({evidence})" if evidence else "")


def verdict_table(verdicts: xr.Dataset) -> str:
    """Format verdicts as a text table.

    Parameters
    ----------
    verdicts : Dataset
        Verdicts from :func:`vibrissa.uniqueness`.

    Returns
    -------
    str
        Row for each triplet: critical cone or verdict in each region, short notation, and twins;
        followed by notes.
    """
    rows, notes = verdict_rows(verdicts)
    width = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = [
        "  ".join(c.ljust(w) for c, w in zip(row, width, strict=True)).rstrip() for row in rows
    ]
    return "\n".join([*lines, "", *notes])


def verdict_rows(verdicts: xr.Dataset) -> tuple[list[list[str]], list[str]]:
    """Arrange verdicts as the cells of a table, and notes."""
    regions = [str(r) for r in verdicts.region.to_numpy()]
    rows = [["triplet", *regions, "in short", "twins"]]
    for triplet in verdicts.triplet.to_numpy():
        row = [str(triplet)]
        for region in regions:
            cell = verdicts.sel(triplet=triplet, region=region)
            word = str(cell.verdict.item())
            mark = _MARKS.get(word, word)
            proved = "evidence" in cell and str(cell.evidence.item()) == "proved"
            found = np.rad2deg(float(cell.critical_cone))
            angle = f"≥{np.floor(10.0 * found) / 10.0:.1f}°"  # a lower bound
            row.append(angle if word == NOT_UNIQUE else mark + " (proved)" * proved)
        rows.append(
            [*row, str(verdicts.notation.sel(triplet=triplet).item()), twins_of(verdicts, triplet)]
        )
    chosen, region = verdicts.attrs["chosen_triplet"], verdicts.attrs["chosen_region"]
    use = "none is unique"
    if chosen:
        cell = verdicts.sel(triplet=chosen, region=region)
        use = f"({chosen.replace(' ', ', ')}), {verdict_words(cell)} in: {region}"
        if str(cell["verdict"].item()) == OFF_SURFACE:
            use += f"; not for contacts in or near {_plane(verdicts)}, which it does not locate"
    cone = np.rad2deg(verdicts.attrs["cone"])
    return rows, [
        f"≥ an angle: not unique (witness), twins exist that far from rest, maybe farther. "
        f"Unique: unique (no counterexample found), unless proved. *: off {_plane(verdicts)}.",
        f"Twins: share of the contacts of {regions[0]} that have one, and their median distance.",
        f"Contacts within {cone:.3g}° of rest left out; domain: {verdicts.attrs['domain']}; "
        f"contacts nearer than {1e3 * verdicts.attrs['min_separation']:.3g} mm count as one.",
        f"The triplet to use: {use}.{_rarest(verdicts)}",
        *_certificate_note(verdicts),
    ]


def _rarest(verdicts: xr.Dataset) -> str:
    """Note on the triplet that is not unique in the first region but has the fewest twins."""
    cells = verdicts.isel(region=0)
    share = cells.twin_share.where(cells.verdict == NOT_UNIQUE)
    if not share.notnull().any():
        return ""
    triplet = str(share.idxmin("triplet").item())
    name = f"({triplet.replace(' ', ', ')})"
    return f" Of the others fewest twins: {name}, {twins_of(verdicts, triplet)}."


def twins_of(verdicts: xr.Dataset, triplet: str) -> str:
    """Format the share of contacts in the first region that have a twin, and their distance."""
    if triplet not in verdicts["triplet"]:
        return "not asked"
    cell = verdicts.sel(triplet=triplet).isel(region=0)
    if str(cell.verdict.item()) != NOT_UNIQUE or "twin_distance" not in cell:
        return "–"
    share, distance = float(cell.twin_share), float(cell.twin_distance)
    if not share > 0.0:
        return "rare pairs"
    apart = f", {1e3 * distance:.2g} mm" if np.isfinite(distance) else ""
    return f"{100.0 * share:.3g} %{apart}"


def _certificate_note(verdicts: xr.Dataset) -> list[str]:
    """Note on what a grid shows about the possibility of a proof."""
    if "determinant_cone" not in verdicts.attrs:
        return []
    angle, cone = (np.rad2deg(verdicts.attrs[name]) for name in ("determinant_cone", "cone"))
    signs = f"(Fx, MB, MD): on a grid, the signs that a proof outside {cone:.3g}° needs are"
    if verdicts.attrs["certificate_possible"]:
        keeps = (
            f"; the determinant keeps its sign outside {angle:.2f}°" if 0.0 < angle < np.inf else ""
        )
        return [f"{signs} right{keeps}."]
    where = "no proof of this kind can exist"
    if 0.0 < angle < np.inf:
        where = f"no proof can exclude a cone smaller than {max(angle, cone):.2f}°"
    return [f"{signs} wrong; {where}."]


def _plane(verdicts: xr.Dataset) -> str:
    names = sorted({str(s) for s in verdicts.surface.to_numpy().ravel()} - {""})
    return " or ".join(names) or "a surface of measure zero"


def save_uniqueness(verdicts: xr.Dataset, path: str | PathLike[str]) -> None:
    """Write verdicts with their evidence to a NetCDF or CSV file."""
    path = Path(path)
    check_writable(path, ENDINGS)
    if path.suffix == ".nc":
        write_netcdf(path, verdicts)
    else:
        with replacing(path) as part:
            part.write_text(_to_csv(verdicts), encoding="utf-8")


def _to_csv(verdicts: xr.Dataset) -> str:
    plain = [n for n, v in verdicts.data_vars.items() if v.dims == ("triplet", "region")]
    header = ["triplet", "region", *map(str, plain)]
    spread = [n for n in ("ambiguous_share", "surface_angle") if n in verdicts]
    header += [f"{n}_{t:g}" for n in spread for t in verdicts.signal_tolerance.to_numpy()]
    trained: list[float] = (
        verdicts["quantile"].values.tolist() if "network_error" in verdicts else []
    )
    header += [f"network_error_{q:g}" for q in trained]
    header += ["witness_separation", "witness_difference"]
    header += [
        f"witness_{v}_{i}" for i in (1, 2) for v in ("arc_length", "fy", "fz", "x", "y", "z")
    ]
    lines = [",".join(header)]
    for triplet in verdicts.triplet.to_numpy():
        for region in verdicts.region.to_numpy():
            cell = verdicts.sel(triplet=triplet, region=region)
            first = cell.isel(witness=0)
            values = [cell[n].item() for n in plain]
            values += [float(x) for n in spread for x in cell[n].to_numpy()]
            values += [float(cell["network_error"].sel(quantile=q)) for q in trained]
            values += [float(first.witness_separation), float(first.witness_difference)]
            for pair in ("first", "second"):
                one = first.sel(pair=pair)
                values += [float(one.witness_arc_length), *one.witness_contact_force.to_numpy()]
                values += list(one.witness_point.to_numpy())
            lines.append(",".join([str(triplet), str(region), *map(_cell, values)]))
    return "\n".join(lines) + "\n"


def _cell(value: object) -> str:
    if isinstance(value, str):
        return f'"{value}"' if "," in value else value
    return repr(float(value))  # type: ignore[arg-type]


#: Distance below which two contacts count as one, over the length.
SEPARATION = 0.025
#: Number of contacts that are sampled.
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
        Map of the whisker.
    triplets : "all" or sequence
        Triplets, of the 20: names like ``"Fx MB MD"`` or tuples of signals; or three signals.
    regions : "all" or sequence of str
        Regions: ``"all"``, ``"ELD"`` (excluding large deflections), ``"CF"`` (concave forward),
        ``"CB"`` (concave backward), ``"ELD CF"``, ``"ELD CB"``; the text ``"all"`` means all six,
        a list ``["all"]`` the region of that name. Both contacts of a witness are in the region.
    min_separation : float
        Distance, as a share of the length, below which two contact points count as one.
    cone : float
        Half angle of the cone about the resting whisker within which contacts are omitted, rad.
    domain : {"reachable", "paper"}
        Domain of contacts: all stable ones, or those within the bounds of the paper's grid.
    samples : int
        Number of contacts that are sampled; rounded up to a power of two.
    resolution : bool
        Whether to compute the shares of contacts that are ambiguous within tolerances as well.
    seed : int
        Seed of the samples and of the search.
    certificate : Certificate, optional
        Proof for this whisker, from `vibrissa.certificates.certify`, with which "unique" is proved
        where the proof applies.
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
        (rad, for "unique off a surface"): the surface, and the largest elevation above it of a
        contact that is ambiguous within the tolerance; ``witness_…``: the pairs of contacts
        farthest apart, with both contacts' arc length, force and point, the three signals, their
        relative difference when the pair is integrated more finely (the signals agree to 1e-10 in
        :func:`vibrissa.deflect` with ``witness_steps``, with which the rod has converged), the
        separation, and the displacement of the second contact when the pair is found again with
        four times the steps. ``region_share``: the regions' share of the
        volume of contact points; ``notation``: the verdicts of a triplet in short. Attributes name
        the chosen triplet, the domain, the cone and the separation, and what a grid shows about a
        certificate for (F_x, M_B, M_D): whether one can exist outside the cone
        (``certificate_possible``), and outside which cone the determinant keeps its sign
        (``determinant_cone``, rad).

    Examples
    --------
    >>> import vibrissa as vb
    >>> contact_map = vb.ContactMap.simulate(vb.samples.straight(), grid=False)
    >>> found = vb.uniqueness(contact_map, ["Fx MB MD"], resolution=False, samples=512)
    >>> str(found.verdict.sel(triplet="Fx MB MD", region="all").item())
    'unique'
    """
    need_map(contact_map)
    names = (
        TRIPLETS if isinstance(triplets, str) and triplets == "all" else _parse_triplets(triplets)
    )
    wanted = REGIONS if isinstance(regions, str) and regions == "all" else _parse_regions(regions)
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
    problem = prepare(contact_map, wanted, min_separation, cone, domain, samples, seed)
    gather: Callable[[tuple[str, ...]], Evidence] = partial(
        gather_evidence, problem, resolution=resolution
    )
    if len(names) >= _PER_CORE * threads():
        gather = on_one_core(gather)
    results = []
    with ThreadPoolExecutor(threads()) as pool:  # kernels, half of the time, release the GIL
        try:
            for found in pool.map(gather, names):
                results.append(found)
                if progress is not None:
                    progress(len(results), len(names))
        finally:
            pool.shutdown(cancel_futures=True)
    return _to_dataset(problem, names, results, certificate)


def _parse_triplets(triplets: str | Sequence[str | tuple[str, ...]]) -> tuple[tuple[str, ...], ...]:
    """Parse triplets, given as names, tuples of signals, or one triplet's three signals."""
    several: list[str | tuple[str, ...]] = (
        [triplets] if isinstance(triplets, str) else list(triplets)
    )
    if several and all(triplet in SIGNALS for triplet in several):
        several = [tuple(map(str, several))]  # one triplet, signal by signal
    names = tuple(selection(triplet, exactly=3) for triplet in several)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"triplets must be named once each, at least one; got {triplets!r}")
    return names


def _parse_regions(regions: str | Sequence[str]) -> tuple[str, ...]:
    """Parse regions, and raise a ValueError if one is unknown or repeated."""
    several = [regions] if isinstance(regions, str) else list(regions)
    unknown = [region for region in several if region not in REGIONS]
    if unknown or not several or len(set(several)) < len(several):
        raise ValueError(f"regions are among {', '.join(REGIONS)}, once each; got {regions!r}")
    return tuple(several)


def _to_dataset(
    problem: Problem,
    names: tuple[tuple[str, ...], ...],
    results: list[Evidence],
    certificate: Certificate | None,
) -> xr.Dataset:
    """Dataset of all verdicts and evidence."""
    data: dict[str, Any] = {
        name: (("triplet", "region", *dims), np.stack([a.variables[name] for a in results]), about)
        for name, (dims, about) in _VARIABLES.items()
        if name in results[0].variables
    }
    data["evidence"] = (
        ("triplet", "region"),
        _evidence(problem, names, data["verdict"][1], certificate),
        {"long_name": "evidence for the verdict"},
    )
    surfaces = np.where(data["verdict"][1] == OFF_SURFACE, _surface(problem), "")
    data["surface"] = (
        ("triplet", "region"),
        surfaces,
        {"long_name": "surface on which contacts have the same signals"},
    )
    shares = problem.volumes()
    data["region_share"] = ("region", shares, _about("1", "share of the contacts' space"))
    coords = {
        "triplet": [" ".join(triplet) for triplet in names],
        "region": list(problem.regions),
        "signal_tolerance": list(TOLERANCES),
        "bound": ["least", "largest"],
        "pair": ["first", "second"],
        "space": ["x", "y", "z"],
        "component": ["fy", "fz"],
    }
    data["notation"] = (
        "triplet",
        [notation(dict(zip(problem.regions, row, strict=True))) for row in data["verdict"][1]],
        {"long_name": "largest regions in which the triplet is unique; *: off a surface"},
    )
    data |= _witnesses(problem, names, results)  # merging datasets would import dask
    out = xr.Dataset(data, coords=coords)
    whisker, d = problem.contact_map.whisker, problem.contact_map.chart.discretization
    out.attrs = {
        "kind": "vibrissa uniqueness",
        "whisker": repr(whisker),
        "domain": problem.domain,
        "cone": problem.cone,
        "min_separation": problem.separation * d.length,
        "samples": len(problem.samples.chart),
        "steps": problem.contact_map.steps,
        "seed": problem.seed,
        "volume_shares": ", ".join(
            f"{region} {share:.3f}" for region, share in zip(problem.regions, shares, strict=True)
        ),
    }
    if TRIPLET in out.triplet.values and whisker.base_stiffness is None:
        seen = outlook(problem.contact_map, problem.cone)
        out.attrs["certificate_possible"] = int(seen.possible)
        out.attrs["determinant_cone"] = seen.determinant_cone
    out.attrs["chosen_triplet"], out.attrs["chosen_region"] = choice(out)
    return out


def _evidence(
    problem: Problem,
    names: tuple[tuple[str, ...], ...],
    verdict: AnyArray,
    certificate: Certificate | None,
) -> AnyArray:
    """Evidence for verdicts (triplets, regions); a certificate covers every region and domain."""
    words = {NOT_UNIQUE: "witness", EMPTY: ""}
    out = np.vectorize(lambda word: words.get(str(word), "no counterexample found"))(verdict)
    if certificate is None:
        return np.asarray(out)
    if not certificate.is_of(problem.contact_map):
        raise ValueError("the certificate is of another whisker or for other arc lengths")
    if certificate.proved and certificate.cone <= problem.cone:
        # For a straight whisker F_x and M_B fix the contact up to a rotation about its axis, which
        # F_D fixes as well as M_D.
        proved = (TRIPLET, "Fx FD MB") if certificate.straight else (TRIPLET,)
        rows = np.isin([" ".join(triplet) for triplet in names], proved)
        out[rows[:, None] & (verdict == UNIQUE)] = "proved"
    return np.asarray(out)


def _surface(problem: Problem) -> str:
    """Describe the surface off which a triplet of a planar whisker may be unique."""
    y, z = problem.normal[1:]
    turned = float(np.rad2deg(np.arctan2(-y, z)))
    where = "z = 0" if abs(turned) < 1e-6 else f"turned by {turned:.4g}° about x from z = 0"
    return f"the plane of the whisker, {where}"


def _witnesses(
    problem: Problem, names: tuple[tuple[str, ...], ...], results: list[Evidence]
) -> dict[str, Any]:
    """Both contacts of each witness, in SI units, and how well they agree."""
    cells = (len(names), len(problem.regions), WITNESSES)
    arrays = {
        name: np.full((*cells, *(_SIZES[dim] for dim in dims)), np.nan)
        for name, (dims, _) in _WITNESS_VARIABLES.items()
    }
    for i, (triplet, found) in enumerate(zip(names, results, strict=True)):
        for j, pairs in enumerate(found.witnesses):
            if n := len(pairs.apart):
                for name, values in _witness(problem, triplet, pairs, found.steps[j]).items():
                    arrays[name][i, j, :n] = values
    data: dict[str, Any] = {
        f"witness_{name}": (("triplet", "region", "witness", *dims), arrays[name], about)
        for name, (dims, about) in _WITNESS_VARIABLES.items()
    }
    data["witness_steps"] = (
        ("triplet", "region"),
        FINER * np.array([found.steps for found in results]),
        _about("1", "integration steps with which the witnesses agree"),
    )
    return data


def _witness(
    problem: Problem, triplet: tuple[str, ...], pairs: Pairs, steps: int
) -> dict[str, Array]:
    """Variables of the witnesses of one triplet and region, on a rod that has converged."""
    contact_map = problem.contact_map
    d, finest = (discretize(contact_map.whisker, n * FINER * steps) for n in (1, 2))
    first, unit = pairs.first.xi, units(contact_map, pairs.second.xi)
    signals, point = signals_and_points(d, triplet, first)
    second, values, _ = correct(d, triplet, pairs.second.xi, signals, unit)
    both = np.stack([first, second], axis=1)
    point = d.length * np.stack([point, values[:, 3:]], axis=1)
    _, moved = resolve_on_finer_rod(contact_map, triplet, first, pairs.second.xi, steps)
    away, _, values = equations(
        finest, triplet, second, signals_and_points(finest, triplet, first)[0]
    )
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
