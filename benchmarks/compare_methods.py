# ruff: noqa: T201 -- a script that reports
"""Exact estimates beside the paper's ways: 3D errors by deflection angle, without noise.

Random contacts of Ω within the bounds of the paper's grid, off its points, on the built-in γ
whisker; what they feel is known exactly, and each method gets three signals of it.

    python benchmarks/compare_methods.py [--contacts 20000] [--triplet "Fx MB MD"]

prints two tables in Markdown: errors, and times. Contacts with several candidates count by the
nearest of them in the column "exact", and their share is printed.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import vibrissa as vb
from vibrissa.contacts import within_paper_bounds
from vibrissa.evaluation import ANGLES
from vibrissa.paper import DrawnContacts, LookupTable, draw_contacts
from vibrissa.signals import SIGNALS, nearest_on_rest, selection

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Result:
    """Errors (n,) of one method, m, NaN where it has no answer, and CPU times, s."""

    name: str
    errors: Array
    prepared: float
    each: float


def timed(work: Callable[[], object]) -> tuple[object, float]:
    begun = time.process_time()
    answer = work()
    return answer, time.process_time() - begun


def estimate(contacts, signals, triplet, method):
    if method == "exact":
        return contacts.estimate(signals, triplet)
    return vb.paper.estimate(contacts, signals, triplet, method=method)


def by_estimate(contacts, drawn, rows, triplet, method, name) -> Result:
    signals = dict(zip(SIGNALS, drawn.signals[rows].T, strict=True))
    few = {key: column[:1] for key, column in signals.items()}
    _, first = timed(lambda: estimate(contacts, few, triplet, method))
    found, all_of_them = timed(lambda: estimate(contacts, signals, triplet, method))
    away = np.linalg.norm(found.candidates.point - drawn.point[rows, None], axis=-1)
    errors = np.where(np.isnan(away), np.inf, away).min(axis=1)
    errors[np.isinf(errors)] = np.nan
    if method == "exact":
        print(f"Several candidates: {(found.n_candidates > 1).mean():.2%} of contacts.\n")
    return Result(name, errors, first, all_of_them / len(errors))


def by_components(contacts, drawn: DrawnContacts, rows, triplet) -> Result:
    values = drawn.signals[rows][:, [SIGNALS.index(name) for name in triplet]]
    table, prepared = timed(lambda: LookupTable.of(contacts, triplet, components=True))
    found, all_of_them = timed(lambda: table(values))
    errors = np.linalg.norm(found - drawn.point[rows], axis=1)
    return Result("natural, components", errors, prepared, all_of_them / len(errors))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--contacts", type=int, default=20_000)
    parser.add_argument("--triplet", default="Fx MB MD")
    options = parser.parse_args()
    triplet = selection(options.triplet, exactly=3)
    whisker = vb.samples.gamma()
    contact_map = vb.ContactMap.simulate(whisker)
    drawn = draw_contacts(contact_map, options.contacts, seed=5, near_rest=True)
    rows = np.flatnonzero(within_paper_bounds(whisker, drawn.point))
    distance, arc_length = nearest_on_rest(whisker, drawn.point[rows])
    angle = np.degrees(np.arctan2(distance, arc_length))
    # Compiled kernels load once; what follows is the methods' own time.
    warm = dict(zip(SIGNALS, drawn.signals[:2].T, strict=True))
    contact_map.estimate(warm, "FT Mx MB")
    vb.paper.estimate(contact_map, warm, "FT Mx MB", method="lookup")
    results = [
        by_estimate(contact_map, drawn, rows, triplet, "exact", "exact"),
        by_estimate(contact_map, drawn, rows, triplet, "lookup", "natural"),
        by_estimate(contact_map, drawn, rows, triplet, "lookup-linear", "linear"),
        by_components(contact_map, drawn, rows, triplet),
        by_estimate(contact_map, drawn, rows, triplet, "network", "network"),
    ]
    print("Median / 95 % of the 3D error, mm; in brackets the share without an answer.\n")
    print("| deflection | contacts | " + " | ".join(r.name for r in results) + " |")
    print("|---|---:|" + "---:|" * len(results))
    for low, high in [*itertools.pairwise(ANGLES), (ANGLES[1], ANGLES[-1])]:
        kept = (angle >= low) & (angle < high)
        cells = []
        for result in results:
            errors = result.errors[kept]
            median, most = 1e3 * np.nanquantile(errors, (0.5, 0.95))
            none = np.isnan(errors).mean()
            cells.append(f"{median:.2g} / {most:.2g}" + (f" ({none:.1%})" if none else ""))
        print(f"| {low:g}–{high:g}° | {kept.sum()} | " + " | ".join(cells) + " |")
    print("\n| method | to prepare, s | each in a batch, µs |\n|---|---:|---:|")
    for r in results:
        print(f"| {r.name} | {r.prepared:.1f} | {1e6 * r.each:.0f} |")


if __name__ == "__main__":
    main()
