"""How far from rest contacts of a whisker have twins, by an optimisation from random pairs.

`python studies/farthest_twins.py` takes pairs of contacts with the same signals from searches with
two seeds, and maximises the smaller of their cone angles with equal signals and the least distance
as constraints (sequential quadratic programming). It prints where each begins and ends. With
`--whiskers FILES` it begins at random pairs of these whiskers, whose signals need not be equal, and
prints the largest angles for (F_x, M_B, M_D).
"""

import argparse
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import vibrissa as vb
from vibrissa.identifiability import evidence, twins
from vibrissa.rod import chart_of, contacts_at, solve_forces, with_normal_force
from vibrissa.signals import circular_among, cone_angle, signals_of, within_turn

TRIPLETS = (("Fx", "MB", "MD"), ("Fx", "FD", "MD"), ("Mx", "MB", "MD"))
APART, STARTS, STEP = 0.025, 9, 1e-6
RANDOM, MISFIT = 60, 1e-8
UNIT = np.tile([1.0, np.pi, 1.0], 2)


def searched(contact_map, names, seed):
    """Charts (k, 6) of pairs, the farthest from rest in different parts of the chart."""
    cone = np.deg2rad(2.0)
    problem = evidence.prepare(contact_map, ("all",), APART, cone, "reachable", 1024, seed)
    samples = problem.samples
    found = twins.twins(contact_map, names, samples.chart, samples.contacts, "reachable")
    rng = np.random.default_rng(seed)
    search = twins.Search(contact_map, names, APART, "reachable")
    more = twins.better_twins(search, found, ("all",), rng)
    pairs = twins.concatenate([found, more])
    pairs = pairs.rows(pairs.apart >= APART)
    order = np.argsort(-pairs.angle)
    part = np.floor(pairs.chart[order] * [6.0, 6.0 / np.pi, 6.0])
    first = np.sort(np.unique(part, axis=0, return_index=True)[1])[:STARTS]
    best = pairs.rows(order[first])
    return np.hstack([best.chart, chart_of(contact_map.chart.fold, best.second.xi)])


def ascended(contact_map, names, start):
    """Smaller cone angle of a pair, and of the pair where it ends, with its misfit."""
    whisker, d = contact_map.whisker, contact_map.chart.discretization
    moves = STEP * np.concatenate([np.zeros((1, 6)), np.eye(6), -np.eye(6)])

    def conditions(pair):
        chart = (pair * UNIT).reshape(-1, 3)
        values, _ = solve_forces(d, with_normal_force(contacts_at(contact_map.chart.fold, chart)))
        force, point = values[:, :3], values[:, 3:]
        signals = signals_of(force, np.cross(point, force))[:, twins.signal_columns(names)]
        gap = within_turn(signals[1::2] - signals[::2], circular_among(names))
        angle = cone_angle(whisker, point * d.length).reshape(-1, 2)
        apart = np.linalg.norm(point[1::2] - point[::2], axis=1) - APART
        return np.column_stack([gap / twins.sizes(values[::2], names), angle, apart])

    @lru_cache(maxsize=1)
    def linear(x):
        x = np.frombuffer(x)
        near = conditions(x[:6] + moves)
        slope = np.zeros((6, 7))
        slope[:, :6] = (near[1:7] - near[7:]).T / (2.0 * STEP)
        slope[3:5, 6] = -1.0
        return near[0] - x[6] * np.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.0]), slope

    def part(kind, which):
        value, slope = (lambda x, i=i: linear(x.tobytes())[i][which] for i in (0, 1))
        return {"type": kind, "fun": value, "jac": slope}

    begin = np.append(start / UNIT, 0.0)
    begin[6] = conditions(begin[None, :6])[0, 3:5].min()
    share = [(0.0, 1.0), (None, None), (0.01, 1.0 - 1e-7)]
    found = minimize(
        lambda x: -x[6],
        begin,
        jac=lambda x: -np.eye(7)[6],
        method="SLSQP",
        bounds=[*share, *share, (0.0, None)],
        constraints=[part("eq", slice(3)), part("ineq", slice(3, 6))],
        options={"ftol": 1e-9},
    )
    return begin[6], found.x[6], np.abs(linear(found.x.tobytes())[0][:3]).max()


def of_the_gamma_whisker():
    contact_map = vb.ContactMap.simulate(vb.samples.gamma(), grid=False)
    for names in TRIPLETS:
        for seed in (0, 1):
            for start in searched(contact_map, names, seed):
                began, ended, misfit = ascended(contact_map, names, start)
                ends = f"{np.rad2deg(began):.3f}° → {np.rad2deg(ended):.4f}°"
                print(" ".join(names), f"seed {seed}: {ends}, misfit {misfit:.0e}", flush=True)


def from_random_pairs(path):
    contact_map = vb.ContactMap.simulate(vb.load_whisker(path), grid=False)
    rng, reached = np.random.default_rng(7), []
    for k in range(RANDOM):
        one = rng.uniform([0.0, 0.0, 0.02], [1.0, 2.0 * np.pi, 1.0])
        other = one + rng.normal(0.0, [0.08, 0.3, 0.1]) * (1 if k % 2 else 3)
        other[[0, 2]] = np.clip(other[[0, 2]], [0.0, 0.02], [1.0, 0.999])
        _, ended, misfit = ascended(contact_map, TRIPLETS[0], np.concatenate([one, other]))
        if misfit < MISFIT:
            reached.append(np.rad2deg(ended))
    best = ", ".join(f"{angle:.3f}°" for angle in sorted(reached)[:-6:-1])
    print(
        f"{path.stem}: {len(reached)} of {RANDOM} end at equal signals, farthest {best}", flush=True
    )


parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--whiskers", nargs="+", type=Path, help="digitised centrelines")
chosen = parser.parse_args()
if chosen.whiskers:
    for path in chosen.whiskers:
        from_random_pairs(path)
else:
    of_the_gamma_whisker()
