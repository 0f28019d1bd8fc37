# ruff: noqa: T201 -- a script that reports
"""How long one measurement takes, from Python, on one thread: median, 99 % and worst.

    python benchmarks/stream_latency.py [SAMPLES] [--json FILE]

A contact glides along the built-in γ whisker and around it while it is pushed harder and lighter,
with the noise of a sensor (1 µN, 0.02 µN·m); every answer is checked against the truth. Each sample
is timed by the clock on the wall, and by the time that the thread itself was running, which other
work on the machine does not lengthen by waiting: on an otherwise idle machine the two are the same.
The last line is the command: seconds of CPU that `vibrissa stream` takes from its start to the end
of its first answer, the least of some runs, with compiled kernels that are on the disk.
"""

import argparse
import gc
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ["VIBRISSA_THREADS"] = "1"

import numpy as np

import vibrissa as vb
from vibrissa.rod import discretize, fold_forces, stable_set
from vibrissa.sensors import Sensor
from vibrissa.signals import SIGNALS
from vibrissa.streaming import ContactStream, as_json

NAMES = ("wall_median", "wall_high", "wall_worst", "own_median", "own_high")
NOISE = np.repeat([1e-6, 2e-8], 3)


def glide(whisker, n):
    """Contacts between 0.5 L and 0.85 L, all around, at 20 to 80 % of what slips off."""
    t = np.linspace(0.0, 1.0, n)
    s, bearing = 0.675 + 0.175 * np.cos(9.0 * t), (0.5 + 6.0 * t) % (2.0 * np.pi)
    fold, unit = stable_set(whisker).fold, discretize(whisker).force
    most = fold_forces(fold, np.stack([s, np.cos(bearing), np.sin(bearing)], axis=-1))
    share = 0.5 - 0.3 * np.cos(31.0 * t)
    return vb.deflect(whisker, vb.PointForce(s * whisker.length, share * most * unit, bearing))


def measured(locate, rows):
    """Durations on the wall and of the thread, µs, and answers."""
    for row in rows[:50]:
        locate(row)
    wall, own, answers = np.empty(len(rows)), np.empty(len(rows)), []
    gc.collect()
    gc.disable()
    for i, row in enumerate(rows):
        a, b = time.perf_counter(), time.thread_time()
        answers.append(locate(row))
        own[i], wall[i] = time.thread_time() - b, time.perf_counter() - a
    gc.enable()
    return wall * 1e6, own * 1e6, answers


def main(samples, path=None):
    whisker = vb.samples.gamma()
    contact_map = vb.ContactMap.simulate(whisker, grid=False)
    bent = glide(whisker, samples)
    wrench = np.concatenate([bent.force, bent.moment], axis=1)
    wrench += NOISE * np.random.default_rng(0).normal(size=wrench.shape)
    signals = vb.base_signals(wrench[:, :3], wrench[:, 3:])
    clean = vb.base_signals(bent.force, bent.moment)
    covariance = np.diag(NOISE**2)
    cases = {}
    for what, names, noise in (
        ("three signals", ("Fx", "MB", "MD"), None),
        ("three signals, with covariance", ("Fx", "MB", "MD"), covariance),
        ("four signals, with covariance", ("Fx", "FT", "MB", "MD"), covariance),
        ("six signals", SIGNALS, None),
        ("six signals, with covariance", SIGNALS, covariance),
    ):
        felt = clean if noise is None else signals
        rows = np.stack([felt[name].to_numpy() for name in names], axis=-1)
        cases[what] = (vb.Estimator(contact_map, names, noise), rows)
    rows = np.stack([clean[name].to_numpy() for name in SIGNALS], axis=-1)
    rubbed = rows * np.where(np.arange(6) == 0, 1.5, 1.0)
    cases["six signals that no contact explains"] = (
        vb.Estimator(contact_map, SIGNALS, covariance),
        rubbed[: samples // 5],
    )
    mixing = np.random.default_rng(3).normal(size=(4, 6)) / np.repeat([1e-5, 2e-7], 3)
    mixed = Sensor("abcd", mixing, np.sqrt(mixing**2 @ NOISE**2))
    cases["four channels that mix all components"] = (
        vb.Estimator.of_sensor(contact_map, mixed),
        wrench @ mixing.T,
    )
    pair = Sensor(("My", "Mz"), noise=NOISE[4:])
    cases["two moments: a curve of contacts"] = (
        vb.Estimator.of_sensor(contact_map, pair),
        wrench[: samples // 10, 4:],
    )
    filters = {
        "filter, three signals": vb.Estimator(contact_map, ("Fx", "MB", "MD"), covariance),
        "filter, two moments": vb.Estimator.of_sensor(contact_map, pair),
    }
    for what, estimator in filters.items():
        rows = np.stack([signals[name].to_numpy() for name in ("Fx", "MB", "MD")], axis=-1)
        rows = wrench[:, 4:] if "two" in what else rows
        cases[what] = (Stepped(vb.ContactFilter(estimator, speed=0.5)), rows[: samples // 3])
    cases["a line of a stream, three signals"] = (
        Answered(filters["filter, three signals"]),
        [",".join(map(repr, row)) for row in wrench.tolist()],
    )
    print(f"{'µs':40}{'wall: median':>14}{'99 %':>8}{'worst':>8}{'own: median':>14}{'99 %':>8}")
    found = []
    for what, (locate, rows) in cases.items():
        wall, own, answers = measured(locate, rows)
        if not any(word in what for word in ("filter", "no contact", "line")):
            points = bent.contact_point[: len(answers)]
            near = [
                np.linalg.norm(one.candidates.point - point, axis=1).min(initial=np.inf)
                for one, point in zip(answers, points, strict=True)
            ]
            assert np.median(near) < 0.1 * whisker.length
        figures = [np.median(wall), np.quantile(wall, 0.99), wall.max()]
        print(f"{what:40}{figures[0]:14.0f}{figures[1]:8.0f}{figures[2]:8.0f}", end="")
        figures += [np.median(own), np.quantile(own, 0.99)]
        print(f"{figures[3]:14.0f}{figures[4]:8.0f}")
        found.append({"what": what, **dict(zip(NAMES, map(float, figures), strict=True))})
    print(f"first answer of the command: {started(contact_map, wrench[0]):.2f} s of CPU")
    if path is not None:
        path.write_text(json.dumps(found))


class Answered:
    """A stream that turns a line into a line."""

    def __init__(self, estimator):
        self.stream = ContactStream(estimator)
        self.out = os.open(os.devnull, os.O_WRONLY)
        self.stream.warm_up()
        list(self.stream.records(["Fx,Fy,Fz,Mx,My,Mz"]))

    def __call__(self, line):
        for record in self.stream.records((line,)):
            os.write(self.out, f"{as_json(record)}\n".encode())


def started(contact_map, wrench, runs=5):
    """Least seconds of CPU of runs of the command with one sample."""
    with tempfile.TemporaryDirectory() as folder:
        contact_map.save(Path(folder) / "map.nc")
        lines = "Fx,Fy,Fz,Mx,My,Mz\n" + ",".join(map(repr, wrench.tolist())) + "\n"
        words = ["stream", "--map", f"{folder}/map.nc", "--force-noise", "1", "--moment-noise"]
        code = "from vibrissa.cli import main; main()"
        least = np.inf
        for _ in range(runs):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            command = [sys.executable, "-c", code, *words, "0.02"]
            subprocess.run(command, input=lines, text=True, check=True, capture_output=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            spent = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
            least = min(least, spent)
    return least


class Stepped:
    """A filter that is given the time of each sample: one millisecond after the last."""

    def __init__(self, follow):
        self.follow, self.time = follow, 0.0

    def __call__(self, row):
        self.time += 1e-3
        return self.follow(self.time, row)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("samples", nargs="?", type=int, default=3000)
    parser.add_argument("--json", type=Path, help="file for the numbers, µs")
    chosen = parser.parse_args()
    main(chosen.samples, chosen.json)
