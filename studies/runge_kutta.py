"""How many steps, stages and operations Runge-Kutta methods of several orders need for a contact.

    python studies/runge_kutta.py

prints a table in Markdown: for three whiskers, the fewest steps with which base force and contact
point of 400 random contacts are within 1e-6 while the tangent turns by less than 65°, and the
operations of a contact at the tip, counted by hand as in ``benchmarks/conftest.py``. It integrates
in NumPy, with the pieces of rod that the kernels use; the exact solution has 576 steps.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.integrate._ivp import dop853_coefficients as dop853
from scipy.integrate._ivp.rk import RK45

import vibrissa as vb
from vibrissa.rod import contact_tangents, discretize, fold_forces, solve_forces, stable_set

BUTCHER = (
    [
        [],
        [1 / 3],
        [0, 2 / 3],
        [1 / 12, 1 / 3, -1 / 12],
        [-1 / 16, 9 / 8, -3 / 16, -3 / 8],
        [0, 9 / 8, -3 / 8, -3 / 4, 1 / 2],
        [9 / 44, -9 / 11, 63 / 44, 18 / 11, 0, -16 / 11],
    ],
    [11 / 120, 0, 27 / 40, 27 / 40, -4 / 15, -4 / 15, 11 / 120],
)
METHODS = {
    "classical, order 4": ([[], [0.5], [0, 0.5], [0, 0, 1]], [1 / 6, 1 / 3, 1 / 3, 1 / 6]),
    "Dormand and Prince, order 5": ([RK45.A[i, :i] for i in range(6)], RK45.B),
    "Butcher, order 6 (in use)": BUTCHER,
    "Dormand and Prince, order 8": (
        [dop853.A[i, :i] for i in range(dop853.N_STAGES)],
        dop853.B,
    ),
}
WHISKERS = {
    "γ": vb.samples.gamma(),
    "straight": vb.Whisker.straight(39.4e-3),
    "parabola": vb.Whisker.parabola(39.4e-3, 10.0),
}
STEPS = (8, 10, 12, 14, 16, 18, 20, 24, 28, 32, 36, 44, 56, 72)


def slopes(rod, k, t, y):
    shape, n, q = rod.shape[k], y[:3], y[3:]
    cubics = sum(shape[:, power, None] * t**power for power in range(4))
    soft = cubics[3] ** -4
    compliance = np.stack([rod.twist[k] * soft, rod.bending[k] * soft, rod.bending[k] * soft])
    u = cubics[:3] + compliance * np.cross(q, n, axis=0)
    out = np.concatenate([np.cross(n, u, axis=0), np.cross(q, u, axis=0)])
    out[3] -= rod.extent[k]
    return out


def integrated(rod, contacts, method):
    """Base force and contact point (n, 6)."""
    stages, weights = method
    y = np.concatenate([contacts[:, 1:].T, np.zeros((3, len(contacts)))])
    for k in range(len(rod.start) - 1, -1, -1):
        h = np.clip(contacts[:, 0] - rod.start[k], 0.0, rod.width[k])
        rates = []
        for row in stages:
            at = y - h * sum(a * rate for a, rate in zip(row, rates, strict=True))
            left = h / rod.width[k] * (1.0 - sum(row))
            rates.append(slopes(rod, k, left, at))
        y = y - h * sum(b * rate for b, rate in zip(weights, rates, strict=True))
    return y.T


def operations(method) -> tuple[int, int]:
    """Of a step for the values, and with three tangents."""
    stages, weights = method
    fractions = {round(float(sum(row)), 9) for row in stages}
    sums = 12 * sum(np.count_nonzero(row) for row in (*stages, weights))
    sections = 30 * len(fractions - {1.0}) + 5 * (1.0 in fractions)
    value = sections + 34 * len(stages) + sums + sums // 12
    return value, value + 3 * (66 * len(stages) + sums)


def main() -> None:
    rng = np.random.default_rng(0)
    least = {name: [] for name in METHODS}
    for whisker in WHISKERS.values():
        s, bearing = rng.uniform(0.3, 0.95, 400), rng.uniform(-np.pi, np.pi, 400)
        way = np.stack([s, np.cos(bearing), np.sin(bearing)], axis=-1)
        force = fold_forces(stable_set(whisker).fold, way) * rng.uniform(0.0, 0.95, 400)
        rows = np.stack([s, 0.0 * s, force * way[:, 1], force * way[:, 2]], axis=-1)
        rows = rows[contact_tangents(discretize(whisker), rows)[:, 0] > np.cos(np.radians(65.0))]
        exact = solve_forces(discretize(whisker, 576), rows)[0]
        size = np.linalg.norm(exact[:, :3], axis=1)[:, None]
        scale = np.where(np.arange(6) < 3, size, 1.0)
        for name, method in METHODS.items():
            for steps in STEPS:
                rod = discretize(whisker, steps).rod
                if np.abs((integrated(rod, rows, method) - exact) / scale).max() < 1e-6:
                    least[name].append(len(rod.start))
                    break
            else:
                least[name].append(None)
    print("| method | stages | " + " | ".join(f"steps, {w}" for w in WHISKERS), end="")
    print(" | operations, most | with Jacobian |\n|---|" + "---:|" * (len(WHISKERS) + 3))
    for name, method in METHODS.items():
        cells = [str(steps or f"> {STEPS[-1]}") for steps in least[name]]
        value, jacobian = operations(method)
        counts = ["", ""]
        if None not in least[name]:
            counts = [f"{max(least[name]) * each / 1e3:.1f} k" for each in (value, jacobian)]
        print(f"| {name} | {len(method[0])} | " + " | ".join([*cells, *counts]) + " |")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.split("\n")[0]).parse_args()
    main()
