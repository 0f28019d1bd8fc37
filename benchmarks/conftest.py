"""What each benchmark reports: the time of one of what it computes, beside two references.

The table at the end comes from the best of several rounds, so that what else runs on the machine
counts least. Times are CPU times, core for core, which other work hardly changes; next to each a
matrix product (dgemm) is timed, since clocks of shared machines swing by two, and the flops that it
does in the same time are compared with ``stored.json`` (``--store`` renews it). Nothing fails for
being slow.
"""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from threadpoolctl import threadpool_limits

import vibrissa as vb
from vibrissa import samples
from vibrissa.numerics import threads
from vibrissa.rod import discretize, fold_forces, solve_forces, stable_set

STORED = Path(__file__).parent / "stored.json"
_ROWS: list[dict[str, Any]] = []


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
    row = dict.fromkeys(("dgemm_flops", "share_of_dgemm"), None)
    row |= {"what": f"SciPy, one solve to the same {error:.0e}", "aim": ""}
    row |= {"seconds_each": seconds, "cpu_seconds_each": seconds, "times_the_reference": 1.0}
    _ROWS.append(row)
    return seconds


def dgemm() -> float:
    """Rate of a matrix product on one core, flop/s: what this machine does at its best, now."""
    a = np.random.default_rng(1).normal(size=(512, 512))
    with threadpool_limits(1, user_api="blas"):
        return 2.0 * 512**3 / best(lambda: a @ a, rounds=10)


@pytest.fixture(scope="session")
def flops_of(whisker, contacts):
    """Floating-point operations that a contact needs on average: its steps, to its own place.

    A step has four cubics and a compliance at five fractions of it (four of 30 operations, and 5
    where it ends), curvature and slopes at seven stages (34 each), and 24 sums of six numbers with
    20 coefficients. A tangent has slopes at seven stages (66 each) and the same sums.
    """
    steps = np.searchsorted(discretize(whisker).rod.start, contacts.rows[:, 0]).mean()
    sums = 24 * 6 * 2

    def count(tangents: int = 0) -> float:
        step = 4 * 30 + 5 + 7 * 34 + sums + 20 + tangents * (7 * 66 + sums)
        return float(steps * step)

    return count


@pytest.fixture
def report(benchmark):
    """Measure, and put a line into the table; beside it a matrix product."""

    def measure(
        what: str,
        work: Callable[[], object],
        each: int = 1,
        reference: float | None = None,
        target: str = "",
        rounds: int = 20,
        flops: float | None = None,
    ) -> object:
        spent, rate = [], dgemm()

        def counted() -> object:
            begun = time.process_time()
            answer = work()
            spent.append(time.process_time() - begun)
            return answer

        answer = benchmark.pedantic(counted, rounds=rounds, iterations=1, warmup_rounds=1)
        rate = max(rate, dgemm())
        seconds, cpu = benchmark.stats.stats.min / each, min(spent[1:]) / each
        measured = cpu >= 0.1 * seconds  # else another process did the work
        row = {
            "what": what,
            "aim": target,
            "seconds_each": seconds,
            "cpu_seconds_each": cpu if measured else None,
            "times_the_reference": reference / cpu if measured and reference else None,
            "dgemm_flops": rate * cpu if measured else None,
            "share_of_dgemm": flops / (rate * cpu) if flops else None,
        }
        benchmark.extra_info.update(row)
        _ROWS.append(row)
        return answer

    return measure


def pytest_addoption(parser):
    parser.addoption("--store", action="store_true", help="keep the result to compare with")


def pytest_terminal_summary(terminalreporter, config):
    if not _ROWS:
        return
    stored = json.loads(STORED.read_text()) if STORED.exists() else {"machine": "", "rows": {}}
    write = terminalreporter.write_line
    terminalreporter.section(f"best of the rounds, {threads()} threads")
    write(f"{machine()}; dgemm {dgemm() / 1e9:.0f} GFlop/s a core")
    write("flop: what dgemm does in the same CPU time; compared with the stored result in those")
    write(
        f"{'what':48} {'clock':>9} {'CPU':>9} {'flop':>8} {'of dgemm':>9} {'SciPy':>7} "
        f"{'stored':>7}  aim"
    )
    for row in _ROWS:
        clock, cpu = (_seconds(row[name]) for name in ("seconds_each", "cpu_seconds_each"))
        flops, share, ratio = (
            row[name] for name in ("dgemm_flops", "share_of_dgemm", "times_the_reference")
        )
        before = stored["rows"].get(row["what"])
        cells = (
            f"{flops:.2g}" if flops else "",
            f"{share:.0%}" if share else "",
            f"× {ratio:,.0f}" if ratio else "",
            f"× {flops / before:.2f}" if flops and before else "",
        )
        write(
            "{:48} {:>9} {:>9} {:>8} {:>9} {:>7} {:>7}  {}".format(
                row["what"], clock, cpu, *cells, row["aim"]
            )
        )
    if stored["rows"]:
        write(f"stored: {stored['machine']}")
    if config.getoption("--store"):
        rows = stored["rows"] | {
            row["what"]: float(f"{row['dgemm_flops']:.3g}") for row in _ROWS if row["dgemm_flops"]
        }
        STORED.write_text(
            json.dumps({"machine": machine(), "rows": rows}, indent=1, ensure_ascii=False) + "\n"
        )


def _seconds(value: float | None) -> str:
    if value is None:
        return ""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if value >= 0.1 * size:
            return f"{value / size:.2f} {unit}"
    return f"{value * 1e6:.2f} µs"


def machine() -> str:
    """Processor, cores and versions."""
    model, info = platform.machine(), Path("/proc/cpuinfo")
    if info.exists():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = names[0].split(":", 1)[1].strip() if names else model
    return (
        f"{model}, {threads()} cores, Python {platform.python_version()}, Numba {numba.__version__}"
    )
