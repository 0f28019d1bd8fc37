"""Whiskers that lie along an object: errors if one contact is assumed, and if all are modelled.

`python studies/around.py [--count N] [--page]`: whiskers are pressed against an object whose
position is known to 1 mm along each axis, so far that they touch it more than once; force and
moment have noise of a share of EI/L² and EI/L. The truth is solved with 160 elements, estimates
with 32, then 96. `--page` writes the table to `docs/several-contacts.md`.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from pages import put, table

import vibrissa as vb
from vibrissa.objects import Peg, Placement, Plane, Sphere
from vibrissa.rod import NearObjects

SIGMA, FINE, WITHIN_95 = 1e-3, 160, 7.815
WIRE = vb.Whisker.from_curvature(0.1, lambda s: [0.0, 0.0, 8.0], base_radius=0.2e-3)
HEAD = ("whisker, noise", "object", "one contact", "all contacts", "in the 95 % region")
HEAD = (*HEAD, "not explained, %", "shift off the surface, mm", "s each")


def _pipe(depth, tilt):
    return Peg([0.055, 0.141 - depth, 0.0], [tilt, 0.0, 1.0], 0.14)


def _wall(depth, tilt):
    return Plane([0.0, 0.0105 - depth, 0.0], [0.05, -1.0, tilt])


def _ball(depth, tilt):
    return Sphere([0.05, 0.1415 - depth, 0.05 * tilt], 0.14)


CASES = {
    ("wire, 100 mm, ratio 1, 0.5 %", "pipe of 280 mm"): (WIRE, _pipe, 0.01, 0.005),
    ("γ, 40 mm, ratio 15, 0.7 %", "wall"): (vb.samples.gamma(), _wall, 0.006, 0.007),
    ("plastic, 100 mm, ratio 3, 0.3 %", "ball of 280 mm"): (
        vb.Whisker.from_curvature(
            0.1,
            lambda s: [0.0, 0.0, 8.0],
            base_radius=5e-4,
            tip_radius=1.7e-4,
            youngs_modulus=2.3e9,
        ),
        _ball,
        0.01,
        0.003,
    ),
}


def measured(whisker, make, deepest, rng):
    """Object as it is thought to be, true equilibrium and shift of one that touches twice."""
    while True:
        thought = make(rng.uniform(0.0, deepest), rng.uniform(-0.4, 0.4))
        shift = SIGMA * rng.normal(size=3)
        place = Placement(np.eye(3), -shift)
        near = NearObjects(whisker, thought, FINE)
        if not vb.deflect_around(whisker, thought, base_position=-shift).several[0]:
            continue
        found = near.from_outside(place, np.zeros(3))
        if found is not None and found.contacts()[0][0] > 0.3:
            return thought, found, shift


def row(whisker, make, deepest, level, asked):
    """Numbers of one whisker and object."""
    rng = np.random.default_rng(asked.seed)
    unit = whisker.base_bending_stiffness / whisker.length**2
    scale = np.repeat([unit, unit * whisker.length], 3)
    names = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
    noise = dict(zip(names, level * scale, strict=True))
    out, spent = [], 0.0
    for _ in range(asked.count):
        thought, found, shift = measured(whisker, make, deepest, rng)
        point = found.first_contact()[1] * whisker.length
        wrench = scale * (found.wrench() + level * rng.normal(size=6))
        one = vb.estimate_from_wrench(whisker, wrench[:3], wrench[3:], noise=noise)
        begun = time.process_time()
        every = vb.estimate_around(
            whisker, wrench[:3], wrench[3:], thought, noise=noise, position_sigma=SIGMA
        )
        spent += time.process_time() - begun
        away = every.contact_point_whisker.values - point
        spread = every.covariance.values
        off = (every.object_shift.values - shift) @ found.contacts()[3][0]
        out.append(
            [
                np.linalg.norm(one.point - point),
                np.linalg.norm(away),
                np.median(np.linalg.norm(rng.multivariate_normal(0.0 * away, spread, 200), axis=1)),
                away @ np.linalg.pinv(spread, rcond=1e-9, hermitian=True) @ away < WITHIN_95,
                int(every.status) != vb.Status.OK,
                abs(off) / np.linalg.norm(found.contacts()[3][0]),
            ]
        )
    single, error, predicted, within, bad, off = np.array(out, dtype=float).T
    return [
        f"{1e3 * np.nanmedian(single):.2f}",
        f"{1e3 * np.nanmedian(error):.2f} ({1e3 * np.nanmedian(predicted):.2f})",
        f"{100 * within.mean():.0f} %",
        f"{100 * bad.mean():.0f}",
        f"{1e3 * np.nanmedian(off):.3f}",
        f"{spent / asked.count:.1f}",
    ]


def main():
    """Print the table, or write it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=30, help="measurements of each")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--page", action="store_true")
    asked = parser.parse_args()
    every = [[*names, *row(*case, asked)] for names, case in CASES.items()]
    block = table(HEAD, every, texts=2)
    print(block)
    if asked.page:
        put(Path(__file__).parents[1] / "docs" / "several-contacts.md", {"around": block})


if __name__ == "__main__":
    main()
