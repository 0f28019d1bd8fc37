"""Verdicts and their evidence as one labelled dataset, in SI units."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from vibrissa.identifiability.confirm import FINER, found_again
from vibrissa.identifiability.evidence import OFF_SURFACE, WITNESSES, Answer, Question
from vibrissa.identifiability.fibres import corrected, units
from vibrissa.identifiability.resolution import TOLERANCES
from vibrissa.identifiability.summary import choice, notation
from vibrissa.quantities import attributes
from vibrissa.rod import discretize
from vibrissa.signals import SIGNALS, signal_scales


def labelled(
    question: Question,
    names: tuple[tuple[str, ...], ...],
    answers: list[Answer],
    resolution: bool,
) -> xr.Dataset:
    """Put everything into one dataset."""
    cell = ("triplet", "region")
    verdict = np.array([a.verdict for a in answers])
    data: dict[str, Any] = {
        "verdict": (cell, verdict, {"long_name": "whether the triplet locates the contact"}),
        "surface": (
            cell,
            np.where(verdict == OFF_SURFACE, _surface(question), ""),
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
    """Off which surface a triplet of a planar whisker may be unique."""
    y, z = question.normal[1:]
    turned = float(np.rad2deg(np.arctan2(-y, z)))
    where = "z = 0" if abs(turned) < 1e-6 else f"turned by {turned:.4g}° about x from z = 0"
    return f"the plane of the whisker, {where}"


def _about(unit: str, long_name: str) -> dict[str, str]:
    return {"units": unit, "long_name": long_name}


def _witnesses(
    question: Question, names: tuple[tuple[str, ...], ...], answers: list[Answer]
) -> xr.Dataset:
    """Both contacts of each witness, in SI units, with how well they agree."""
    contact_map = question.contact_map
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
            d = discretize(contact_map.whisker, found.steps[j])
            first, unit = pairs.first.contacts, units(contact_map, pairs.second.contacts)
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
            _, moved = found_again(contact_map, triplet, first, second, found.steps[j])
            shift[here] = d.length * moved
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
                _about("m", f"move of the second contact at {FINER} times the steps"),
            ),
        }
    )
