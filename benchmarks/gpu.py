# ruff: noqa: T201 -- a script that reports
"""What a GPU does in a second, and whether its answers are those of the CPU.

    python benchmarks/gpu.py [--contacts 1048576] [--points 262144]

prints a table in Markdown: contacts a second of all cores of this machine, of the GPU with the
transfer of contacts and results, and of the GPU alone on arrays that it holds, with the largest
difference of the answers. Contacts are spread over the stable set of the built-in γ whisker.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import cuda

import vibrissa as vb
from vibrissa.numerics import Translation, threads
from vibrissa.rod import discretize, fold_forces, point_solver, solve_forces, stable_set


def contacts_of(whisker: vb.Whisker, n: int) -> np.ndarray:
    """Draw s_c, bearing and share of the fold's force, uniformly; non-dimensional (s, f)."""
    rng = np.random.default_rng(8)
    s, bearing = rng.uniform(0.3, 1.0, n), rng.uniform(-np.pi, np.pi, n)
    way = np.stack([s, np.cos(bearing), np.sin(bearing)], axis=-1)
    force = fold_forces(stable_set(whisker).fold, way) * rng.uniform(0.0, 0.95, n)
    return np.stack([s, 0.0 * s, force * way[:, 1], force * way[:, 2]], axis=-1)


def seconds(work: Callable[[str], object], device: str, rounds: int = 5) -> float:
    """Shortest of several times by the clock, after a first call that is not counted."""
    work(device)
    taken = []
    for _ in range(rounds):
        begun = time.perf_counter()
        work(device)
        cuda.synchronize()
        taken.append(time.perf_counter() - begun)
    return min(taken)


def resident(work: Callable[[str], object]) -> float:
    """Time of the GPU within a call, s, by its own events around each launch."""
    spent = []
    plain = Translation.launch

    def timed(*args: Any) -> None:
        begun, ended = cuda.event(), cuda.event()
        begun.record()
        plain(*args)
        ended.record()
        ended.synchronize()
        spent.append(1e-3 * begun.elapsed_time(ended))

    Translation.launch = staticmethod(timed)
    try:
        work("cuda")
        spent.clear()
        work("cuda")
    finally:
        Translation.launch = staticmethod(plain)
    return sum(spent)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--contacts", type=int, default=1 << 20)
    parser.add_argument("--points", type=int, default=1 << 18)
    options = parser.parse_args()
    whisker = vb.samples.gamma()
    d, solver = discretize(whisker), point_solver(whisker, 0.3, 36)
    rows = contacts_of(whisker, options.contacts)
    points = solve_forces(d, rows[: options.points])[0][:, 3:]
    load = vb.PointContact(points * whisker.length)
    works: dict[str, tuple[int, Callable[[str], Any]]] = {
        "forces": (len(rows), lambda on: solve_forces(d, rows, device=on)[0]),
        "with Jacobian": (len(rows), lambda on: solve_forces(d, rows, True, on)[1]),
        "contact points": (len(points), lambda on: solver.solve(points, on).values),
        "`deflect` by points": (len(points), lambda on: vb.deflect(whisker, load, device=on).force),
    }
    name = cuda.get_current_device().name if hasattr(cuda, "get_current_device") else "simulator"
    print(f"{name if isinstance(name, str) else name.decode()} and {threads()} cores\n")
    print("| a second | cores | GPU with transfer | GPU alone | difference |")
    print("|---|---:|---:|---:|---:|")
    for what, (n, work) in works.items():
        one, other = work("cpu"), work("cuda")
        difference = np.nanmax(np.abs(one - other)) / np.nanmax(np.abs(one))
        times = seconds(work, "cpu"), seconds(work, "cuda"), resident(work)
        cells = " | ".join(f"{n / t:.3g}" for t in times)
        print(f"| {what} | {cells} | {difference:.1e} |", flush=True)


if __name__ == "__main__":
    main()
