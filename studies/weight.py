"""Contacts of whiskers that bend under their weight, compared with the same without weight.

`python studies/weight.py [--count 60] [--seed 7] [--page]`: three straight, tapered rods held
level, upright and oblique; contacts of random arc length, direction and force, 2° to 25°; noise of
1/1000 EI/L² and EI/L. With `--page` the table goes to `docs/friction-weight.md`. `--reference`
writes `tests/data/weighted_contacts.csv`: contacts by an integration in the laboratory frame, which
vibrissa has no part in.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from pages import put, table
from scipy.optimize import root

import vibrissa as vb

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "rod"))

from test_weight import LEVEL, OBLIQUE, RODS, UPRIGHT, laboratory

ROOT = Path(__file__).parents[1]
NAMES = {"PLA": "PLA 250 mm", "steel": "steel 300 mm", "nitinol": "nitinol 150 mm"}
HELD = {"none": None, "level": LEVEL, "upright": UPRIGHT, "oblique": OBLIQUE}
SETS = (("Fx", "MB", "MD"), ("Fx", "FT", "FD", "Mx", "MB", "MD"), "wrench")
HEAD = ("rod", "held", "F_x, M_B, M_D", "six signals", "wrench", "ignored: three, six, wrench")
LOADS = ((0.6, 0.7, 0.9), (0.8, -0.4, 0.7))


def bent_at_random(whisker, gravity, count, seed=7):
    """Contacts that are the same for every gravity, and their noisy force and moment."""
    rng = np.random.default_rng(seed)
    length = whisker.length
    unit = whisker.base_bending_stiffness / length**2
    arc, angle = rng.uniform(0.35, 0.95, count), rng.uniform(0.0, 2.0 * np.pi, count)
    force = np.deg2rad(rng.uniform(2.0, 25.0, count)) / arc**2 * unit
    bent = vb.deflect(whisker, vb.PointForce(arc * length, force, angle), gravity=gravity)
    noise = 1e-3 * unit * rng.normal(size=(2, count, 3))
    return bent, bent.force + noise[0], bent.moment + noise[1] * length


def located(contact_map, using, force, moment, **how):
    """Contacts from noisy force and moment."""
    unit = contact_map.whisker.base_bending_stiffness / contact_map.whisker.length**2
    covariance = np.diag(np.repeat([1e-3, 1e-3 * contact_map.whisker.length], 3) * unit) ** 2
    signals = vb.base_signals(force, moment)
    if using == "wrench":
        signals = {"force": force, "moment": moment}
    return contact_map.estimate(signals, using, covariance, **how)


def median_error(found, bent):
    """Median error, mm, and the share of contacts in their 95 % regions, %."""
    away = found.point - bent.contact_point
    inverse = np.linalg.pinv(found.covariance, rcond=1e-12)
    inside = np.einsum("ni,nij,nj->n", away, inverse, away) < 7.81
    return 1e3 * np.nanmedian(np.linalg.norm(away, axis=1)), 100.0 * inside.mean()


def rows(count, seed):
    """Rows of the table: error, relative to that without weight, and share in 95 % regions."""
    for name, title in NAMES.items():
        contact_map = vb.ContactMap.simulate(RODS[name], grid=False)
        without = {}
        for held, gravity in HELD.items():
            bent, force, moment = bent_at_random(RODS[name], gravity, count, seed)
            cells, ignored = [], []
            for using in SETS:
                found = located(contact_map, using, force, moment, gravity=gravity)
                error, inside = median_error(found, bent)
                without.setdefault(using, error)
                cells.append(f"{error:.2f} (× {error / without[using]:.2f}; {inside:.0f} %)")
                blind = located(contact_map, using, force, moment)
                ignored.append(f"{median_error(blind, bent)[0]:.2f}")
            yield [title, held, *cells, ", ".join(ignored)]


def reference():
    """Rods, gravity, and contacts (s, F, M tared, p) by the laboratory frame's integration."""
    for number, name in enumerate(NAMES):
        whisker = RODS[name]
        unit, length = whisker.base_bending_stiffness / whisker.length**2, whisker.length
        scale = np.repeat([unit, unit * length], 3)
        for held, gravity in enumerate((LEVEL, UPRIGHT, OBLIQUE)):
            arc, *across = LOADS[(number + held) % 2]
            load = vb.PointForce(arc * length, components=(0.0, *(f * unit for f in across)))
            bent, rest = vb.deflect(whisker, load, gravity=gravity), vb.resting(whisker, gravity)

            def miss(x, whisker=whisker, gravity=gravity, arc=arc, across=across, scale=scale):
                wrench = x * scale
                end, _, frame = laboratory(
                    whisker, gravity, arc * whisker.length, wrench[:3], wrench[3:], 0.0
                )
                local = frame.T @ x[:3]
                return np.concatenate([end / scale[3], local - [0.0, *across]])

            start = np.concatenate([bent.force, bent.moment + rest.moment]) / scale
            wrench = root(miss, 1.02 * start, tol=1e-12).x * scale
            free = root(
                lambda m, w=whisker, g=gravity, k=scale[3]: (
                    laboratory(w, g, 0.5 * w.length, np.zeros(3), m * k, 0.0)[0] / k
                ),
                1.02 * rest.moment / scale[3],
                tol=1e-12,
            )
            wrench[3:] -= free.x * scale[3]
            whole = wrench[3:] + free.x * scale[3]
            point = laboratory(whisker, gravity, arc * length, wrench[:3], whole, 0.0)[1]
            yield name, *gravity, arc * length, *wrench, *point


def main():
    """Print the table, or write it or the reference."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--page", action="store_true")
    parser.add_argument("--reference", action="store_true")
    asked = parser.parse_args()
    if asked.reference:
        lines = ["rod,gx,gy,gz,arc_length,Fx,Fy,Fz,Mx,My,Mz,x,y,z"]
        for name, *numbers in reference():
            lines.append(",".join([name, *(f"{value:.12g}" for value in numbers)]))
        (ROOT / "tests" / "data" / "weighted_contacts.csv").write_text("\n".join(lines) + "\n")
        return
    text = table(HEAD, list(rows(asked.count, asked.seed)))
    print(text)
    if asked.page:
        put(ROOT / "docs" / "friction-weight.md", {"weight": text})


if __name__ == "__main__":
    main()
