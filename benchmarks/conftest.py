"""What each benchmark reports: microseconds for one of what it computes, beside a reference.

The table at the end comes from the best of several rounds, so that what else runs on the machine
counts least. Ratios compare CPU times of the same run, core for core, which other work hardly
changes; by the clock several cores are faster.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import vibrissa as vb
from vibrissa import samples
from vibrissa.numerics import threads
from vibrissa.rod import discretize, fold_forces, solve_forces, stable_set

_ROWS: list[tuple[str, float, float, float, str]] = []


@pytest.fixture(scope="session")
def whisker():
    """The built-in γ whisker."""
    return samples.gamma()


def best(work: Callable[[], object], rounds: int = 20) -> float:
    """Return the shortest of several CPU times, s."""
    durations = []
    for _ in range(rounds):
        begun = time.process_time()
        work()
        durations.append(time.process_time() - begun)
    return min(durations)


@dataclass(frozen=True)
class Contacts:
    """Contacts on the stable branch, up to 0.95 of the force that slips off."""

    rows: np.ndarray  # s_c and force, non-dimensional
    points: np.ndarray  # m

    @classmethod
    def sample(cls, whisker: vb.Whisker, n: int) -> Contacts:
        """Draw s_c, bearing and share of the fold's force, uniformly."""
        rng = np.random.default_rng(8)
        s, bearing = rng.uniform(0.3, 1.0, n), rng.uniform(-np.pi, np.pi, n)
        fold = stable_set(whisker).fold
        force = fold_forces(fold, np.stack([s, np.cos(bearing), np.sin(bearing)], axis=-1))
        force *= rng.uniform(0.0, 0.95, n)
        rows = np.stack([s, 0.0 * s, force * np.cos(bearing), force * np.sin(bearing)], axis=-1)
        return cls(rows, solve_forces(discretize(whisker), rows)[0][:, 3:] * whisker.length)


@pytest.fixture(scope="session")
def contacts(whisker):
    return Contacts.sample(whisker, 100_000)


@pytest.fixture(scope="session")
def scipy_solve(whisker):
    """CPU seconds for one force solve by SciPy's DOP853 at vibrissa's accuracy.

    The same six equations from the contact to the base, written out, with the curvature as cubics
    through its values at equal steps: as quick as a right-hand side in Python gets.
    """
    d = discretize(whisker)
    slope = whisker.tip_radius / whisker.base_radius - 1.0
    twist = 1.0 + whisker.poisson_ratio
    nodes = np.linspace(0.0, 1.0, 201)
    cubics = CubicSpline(nodes, whisker.curvature(nodes * whisker.length) * whisker.length).c
    table = np.moveaxis(cubics, 1, 0).reshape(200, 12).tolist()

    def rate(s: float, y: np.ndarray) -> list[float]:
        n0, n1, n2, q0, q1, q2 = y.tolist()
        k = min(int(200.0 * s), 199)
        t = s - k / 200.0
        a3, b3, e3, a2, b2, e2, a1, b1, e1, a0, b0, e0 = table[k]
        c = 1.0 / (1.0 + slope * s) ** 4
        a = a0 + t * (a1 + t * (a2 + t * a3)) + twist * c * (q1 * n2 - q2 * n1)
        b = b0 + t * (b1 + t * (b2 + t * b3)) + c * (q2 * n0 - q0 * n2)
        e = e0 + t * (e1 + t * (e2 + t * e3)) + c * (q0 * n1 - q1 * n0)
        return [
            n1 * e - n2 * b,
            n2 * a - n0 * e,
            n0 * b - n1 * a,
            q1 * e - q2 * b - 1.0,
            q2 * a - q0 * e,
            q0 * b - q1 * a,
        ]

    # A contact at 0.7 L, well bent.
    place = np.array([[0.7, np.cos(0.5), np.sin(0.5)]])
    force = 0.8 * fold_forces(stable_set(whisker).fold, place)[0]
    contact = np.array([[0.7, 0.0, force * np.cos(0.5), force * np.sin(0.5)]])

    def solve(rtol: float, atol: float = 1e-12) -> np.ndarray:
        start = np.array([0.0, *contact[0, 2:], 0.0, 0.0, 0.0])
        return solve_ivp(
            rate, (0.7, 0.0), start, method="DOP853", rtol=rtol, atol=max(atol, 1e-2 * rtol)
        ).y[:, -1]

    exact = solve_forces(discretize(whisker, 288), contact)[0][0]
    assert np.linalg.norm(solve(1e-12, 1e-14) - exact) < 1e-8
    error = np.linalg.norm(solve_forces(d, contact)[0][0] - exact)
    assert error < 1e-6
    # The loosest tolerance that is as accurate.
    for rtol in 10.0 ** -np.arange(3.0, 12.0, 0.5):
        if np.linalg.norm(solve(rtol) - exact) <= error:
            break
    seconds = best(lambda: solve(rtol))
    _ROWS.append((f"SciPy, one solve to the same {error:.0e}", seconds, seconds, 1.0, ""))
    return seconds


@pytest.fixture
def report(benchmark):
    """Measure, and put a line into the table: what, how many at once, reference, target."""

    def measure(
        what: str,
        work: Callable[[], object],
        each: int = 1,
        reference: float | None = None,
        target: str = "",
        rounds: int = 20,
    ) -> object:
        spent = []

        def counted() -> object:
            begun = time.process_time()
            answer = work()
            spent.append(time.process_time() - begun)
            return answer

        answer = benchmark.pedantic(counted, rounds=rounds, iterations=1, warmup_rounds=1)
        seconds, cpu = benchmark.stats.stats.min / each, min(spent[1:]) / each
        if cpu < 0.1 * seconds:  # another process did the work
            cpu = np.nan
        ratio = np.nan if reference is None else reference / cpu
        benchmark.extra_info.update(
            what=what,
            aim=target,
            seconds_each=seconds,
            cpu_seconds_each=None if np.isnan(cpu) else cpu,
            times_the_reference=None if reference is None else ratio,
        )
        _ROWS.append((what, seconds, cpu, ratio, target))
        return answer

    return measure


def pytest_terminal_summary(terminalreporter):
    if not _ROWS:
        return
    terminalreporter.section(f"best of the rounds, {threads()} threads")
    head = f"{'what':44} {'by the clock':>12} {'CPU':>10} {'SciPy / ours':>13}  target"
    terminalreporter.write_line(head)
    for what, *seconds, ratio, target in _ROWS:
        clock, cpu = (f"{s * 1e6:.2f} µs" if s < 0.01 else f"{s:.3f} s" for s in seconds)
        compared = "" if np.isnan(ratio) else f"{ratio:,.0f}"
        line = f"{what:44} {clock:>12} {cpu:>10} {compared:>13}  {target}"
        terminalreporter.write_line(line)
