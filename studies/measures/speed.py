"""Speed: the benchmarks, each with its reference in the same run, and one sample at a time."""

import json
import os
import platform
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pages import few, table

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
QUICK = "force_to_signals or points or one_"


def blocks(quick: bool) -> dict[str, str]:
    """All of the page's section on speed; three minutes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "found.json"
        chosen = ["-k", QUICK] if quick else []
        run(
            "-m",
            "pytest",
            BENCHMARKS,
            "-q",
            "-p",
            "no:cacheprovider",
            *chosen,
            "--benchmark-json",
            path,
        )
        found = json.loads(path.read_text())["benchmarks"]
        run(BENCHMARKS / "stream_latency.py", 300 if quick else 3000, "--json", path)
        streams = json.loads(path.read_text())
    return {
        "machine": machine(),
        "speed of the rod": speeds(found, "test_rod"),
        "speed of estimates": speeds(found, "test_estimates"),
        "streams": latencies(streams),
    }


def run(*arguments: object) -> None:
    """Python in the repository's folder; it fails loudly."""
    words = [sys.executable, *map(str, arguments)]
    subprocess.run(words, check=True, cwd=BENCHMARKS.parent, stdout=sys.stderr)


def machine() -> str:
    """What it was measured on, in words."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = names[0].split(":", 1)[1].strip() if names else model
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    packages = ", ".join(f"{name} {version(name.lower())}" for name in ("NumPy", "Numba", "SciPy"))
    return (
        f"{cores} cores of {model}, {platform.system()}, Python {platform.python_version()}, "
        f"{packages}. Other work at the start: a load of {os.getloadavg()[0]:.1f} on these cores."
    )


def speeds(found: list[dict[str, Any]], module: str) -> str:
    rows = []
    for one in found:
        if module not in one["fullname"]:
            continue
        info = one["extra_info"]
        ratio, cpu = info["times_the_reference"], info["cpu_seconds_each"]
        times = "" if ratio is None else few(ratio)
        share = info["share_of_dgemm"]
        part = "" if share is None else f"{100 * share:.0f} %"
        spent = "" if cpu is None else duration(cpu)
        clock = duration(info["seconds_each"])
        rows.append([info["what"], times, spent, part, clock, info["aim"]])
    head = ["what", "times as fast as SciPy", "CPU each", "flop rate over dgemm's"]
    head += ["wall-clock time each", "aim, wall-clock"]
    return table(head, rows)


def duration(seconds: float) -> str:
    """With a unit."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= 0.1 * size:
            return f"{few(seconds / size)} {unit}"
    return f"{few(1e6 * seconds)} µs"


def latencies(found: list[dict[str, Any]]) -> str:
    rows = [
        [
            one["what"],
            *(duration(1e-6 * one[f"own_{name}"]) for name in ("median", "high")),
            *(duration(1e-6 * one[f"wall_{name}"]) for name in ("median", "high", "worst")),
            few(1e6 / one["own_median"]),
        ]
        for one in found
    ]
    head = ["", "median", "99 %", "wall: median", "wall: 99 %", "wall: worst", "a second (median)"]
    return table(head, rows)
