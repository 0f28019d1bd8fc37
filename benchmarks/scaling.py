# ruff: noqa: T201 -- a script that reports
"""What simulating, tracking, estimating and keeping a study's cells cost as they grow.

    python benchmarks/scaling.py [simulate] [track] [estimate] [store]

prints a table in Markdown for docs/scaling.md: CPU time of this process, all its threads together,
after a first call that is not counted, and memory of the results; and for each what is fixed and
what grows, by least squares of relative errors, with the size that is farthest from that line.
Without arguments all of it.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

import vibrissa as vb
from vibrissa.cameras import orthogonal_views
from vibrissa.paper import draw_contacts
from vibrissa.signals import SIGNALS
from vibrissa.simulation import array_whisking, facing_peg, film_frames, simulate, sweep_past
from vibrissa.tracking import TrackOptions, trace_video, track

RATE = 500.0
TRIPLET = ("Fx", "MB", "MD")
Row = tuple[str, str, float, float, str]
"""What, how much of it, CPU s, CPU s of one, and what else is told."""


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """What work gives, and the least of three times: others on the machine only add to it."""
    taken = []
    for _ in range(3):
        begun = time.process_time()
        found = work()
        taken.append(time.process_time() - begun)
    return found, min(taken)


def simulated() -> Iterator[Row]:
    whisker = vb.samples.gamma()
    peg = facing_peg(whisker)

    several = [whisker.with_properties(name=str(k)) for k in range(4)]
    for frames, copies in ((100, 1), (200, 1), (400, 1), (100, 2), (100, 4)):
        motion = sweep_past(whisker, peg, duration=frames / RATE, rate=RATE)
        tree, seconds = timed(lambda m=motion, n=copies: simulate(several[:n], [m] * n, peg))
        count = tree["time"].size * copies
        size = sum(node.to_dataset().nbytes for node in tree.subtree)
        told = f"{size / count / 1e3:.1f} kB a frame"
        yield "simulate", f"{tree['time'].size} frames × {copies}", seconds, seconds / count, told
    array = vb.whisker_array(side="right", rows="C")
    motions = array_whisking(array, 40 / RATE, RATE)
    tree, seconds = timed(lambda: simulate(array, motions, peg))
    count = tree["time"].size * len(array)
    size = f"{tree['time'].size} frames × {len(array)} of an array"
    yield "simulate", size, seconds, seconds / count, ""


def tracked() -> Iterator[Row]:
    whisker = vb.samples.gamma()
    peg, most = facing_peg(whisker), 120
    motion = sweep_past(whisker, peg, duration=most / RATE, rate=RATE)
    trial = simulate(whisker, motion, peg)
    cameras = orthogonal_views(0.12e-3, (360, 360), center=[15e-3, 2e-3, 0.0])
    films = [list(film_frames(trial, camera)) for camera in cameras]
    known = {"base_radius": whisker.base_radius, "tip_radius": whisker.tip_radius}
    options = TrackOptions(properties=known)
    traces = [trace_video(film) for film in films]
    for frames in (most // 4, most // 2, most):
        _, seconds = timed(lambda n=frames: [trace_video(film[:n]) for film in films])
        yield "trace, 360² pixels", f"{frames} frames × 2 views", seconds, seconds / frames / 2, ""
    track(cameras, traces, RATE, options)
    for frames, copies in ((most // 2, 1), (most, 1), (most, 2)):
        some = [[one[:frames] for one in view] * copies for view in traces]
        tree, seconds = timed(lambda some=some: track(cameras, some, RATE, options))
        size = sum(node.to_dataset().nbytes for node in tree.subtree)
        told = f"{size / frames / copies / 1e3:.1f} kB a frame"
        each = seconds / frames / copies
        yield "track, of traces", f"{frames} frames × {copies}", seconds, each, told


def estimated() -> Iterator[Row]:
    whisker = vb.samples.gamma()
    contact_map = vb.ContactMap.simulate(whisker, grid=False)
    for count in (1, 10, 100, 1_000, 10_000, 100_000):
        signals = draw_contacts(contact_map, count, seed=1).signals
        known = {name: signals[:, SIGNALS.index(name)] for name in TRIPLET}
        contact_map.estimate({name: known[name][:10] for name in known}, TRIPLET)
        _, seconds = timed(lambda known=known: contact_map.estimate(known, TRIPLET))
        yield f"estimate, ({', '.join(TRIPLET)})", f"{count} frames", seconds, seconds / count, ""


def kept() -> Iterator[Row]:
    from vibrissa.sweeps import Store, open_sweep, read_study
    from vibrissa.sweeps.study import answer

    text = '[[whiskers]]\nkind = "random"\ncount = {}\nlength = [20, 60]\n[[tasks]]\nkind = "map"'
    for count in (1_000, 10_000):
        study, reading = timed(lambda n=count: read_study(text.format(n), Path()))
        yield "sweep: read the study", f"{count} whiskers", reading, reading / count, ""
        cells = list(study.cells())
        found = answer(cells[0])
        folder = Path(tempfile.mkdtemp())
        try:
            with Store(folder / "s", study) as store:
                store.write(cells[0], found)
                begun = time.process_time()
                for cell in cells[1:]:
                    store.write(cell, found)
                seconds = time.process_time() - begun
            files = [one for one in folder.rglob("*") if one.is_file()]
            size = sum(one.stat().st_size for one in files)
            told = f"{len(files)} files, {size / count:.0f} B a cell"
            yield "sweep: write", f"{count} cells", seconds, seconds / count, told

            def resume(path: Path = folder / "s", study: Any = study) -> None:
                with Store(path, study) as store:
                    assert (store.statuses() == 1).all()

            _, seconds = timed(resume)
            yield "sweep: go on from", f"{count} cells", seconds, seconds / count, ""
            _, seconds = timed(lambda path=folder / "s": open_sweep(path).load())
            yield "sweep: open", f"{count} cells", seconds, seconds / count, ""
        finally:
            shutil.rmtree(folder)


PARTS = {"simulate": simulated, "track": tracked, "estimate": estimated, "store": kept}


def readable(seconds: float) -> str:
    if seconds >= 0.1:
        return f"{seconds:.2f} s"
    return f"{seconds * 1e3:.2f} ms" if seconds >= 1e-4 else f"{seconds * 1e6:.1f} µs"


def fitted(rows: list[Row]) -> Iterator[str]:
    """Lines of the table: cost = fixed + each × number, for what was measured at several sizes."""
    for what in dict.fromkeys(row[0] for row in rows):
        sizes = [row[1] for row in rows if row[0] == what]
        seconds, each = np.array([row[2:4] for row in rows if row[0] == what]).T
        if len(sizes) < 3:
            continue
        number = seconds / each
        (fixed, slope), _ = nnls(
            np.column_stack([1.0 / seconds, number / seconds]), np.ones(len(sizes))
        )
        away = seconds / (fixed + slope * number) - 1.0
        worst = int(np.abs(away).argmax())
        line = f"{readable(fixed)} + {readable(slope)} × number"
        yield f"| {what} | line | {line} | | {100 * away[worst]:+.0f} % at {sizes[worst]} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="by default all")
    print("| what | how much | CPU | of one | |\n|---|---|---:|---:|---|")
    rows: list[Row] = []
    for part in parser.parse_args().parts or PARTS:
        for row in PARTS[part]():
            rows.append(row)
            what, size, seconds, each, told = row
            print(
                f"| {what} | {size} | {readable(seconds)} | {readable(each)} | {told} |", flush=True
            )
    print("\n".join(fitted(rows)))


if __name__ == "__main__":
    main()
