"""Tracking of films by another renderer: traces, contact, wrench, base and the peg, against truth.

``python studies/tracking.py [SEED ...] [--part films|rows|ways] [--page]`` films whisks past a peg
through lenses at 0.6 m, 100 µm a pixel, each under another of six kinds of conditions, and tracks
them with the base clicked where it truly is; whether that would have been found without a click is
judged apart. Then rows of whiskers that cross, and three of the films as a laboratory without
clicks, with a mirror or with one camera has them. By default seeds 61 to 66, on which no number was
set; three minutes on a free core, of which ``--part`` makes one part only. ``--page`` writes the
tables into `docs/tracking-films.md` and `docs/tracking-rows.md`, else they are printed.
"""

import argparse
import sys
import tempfile
import time
from itertools import cycle
from pathlib import Path

import numpy as np
from pages import few, put, table
from pinhole_film import Look, film, views
from rough_cameras import whisk
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree
from scipy.stats import chi2

from vibrissa.cameras import orthogonal_views
from vibrissa.contour import shape_from_dataset
from vibrissa.io import read_video, write_video
from vibrissa.pipeline import placed_by, signals_of, with_contour, with_group
from vibrissa.sensors import FORCE_NOISE, MOMENT_NOISE
from vibrissa.simulation import measure
from vibrissa.tracking import TrackOptions, find_start, trace_video, track
from vibrissa.tracking.refine.optics import stated_lenses

ROOT = Path(__file__).parents[1]

PIXEL, SIZE, DISTANCE, RATE, FRAMES = 100e-6, 400, 0.6, 500.0, 60
KINDS = {
    "dull peg, no fur": Look(),
    "shiny peg, fur": Look(shine=110.0, fur=60),
    "light from the side": Look(side=60.0, shine=90.0, fur=60),
    "JPEG of quality 35": Look(quality=35, shine=110.0, fur=60),
    "defocus, noise of 4": Look(blur=1.6, noise=4.0, fur=40),
    "slips off": Look(shine=110.0, fur=60),
}
OUTER = {"slips off": (0.78, 0.85)}
"""Distance of the peg from the base, as a share of the whisker's length, where it is not usual."""
HEAD = (
    "film",
    "lost, wrong",
    "wrong near contact, %",
    "contact right, %",
    "contact, µm (95 %)",
    "held: contact",
    "wrench",
    "base",
    "radius of the peg, µm",
    "axis, µm",
    "axis by a sensor, µm",
    "start, px (confidence)",
    "ms",
)
ROWS = ((31, 3), (32, 3), (33, 4), (34, 5))
WARM = 10
"""Number of frames before the time of a frame is taken: the first ones find light and whisker."""
ROW_HEAD = ("film", "whiskers", "view", "images", "right, %", "lost, %", "swapped, %", "ms")
WAYS = (62, 65, 66)
WAY_HEAD = (
    "film",
    "filmed or started",
    "lost, wrong",
    "contact right, %",
    "contact, µm (95 %)",
    "held: contact",
)
NEAR = 3e-3
"""Distance from a contact within which a trace is near it, m."""


def traces_against(found, lenses, truth, touching):
    """Numbers of images lost and wrong, and the share of contact images wrong near the contact."""
    lost, wrong, near = 0, 0, []
    share = np.linspace(0.0, 1.0, truth["centerline"].shape[1])
    for rows, lens in zip(found, lenses, strict=True):
        for i, trace in enumerate(rows[0]):
            if not len(trace.line):
                lost += 1
                continue
            dense = CubicSpline(share, truth["centerline"][i])(np.linspace(0.0, 1.0, 1500))
            away, nearest = cKDTree(lens(dense)).query(trace.line)
            wrong += bool(np.median(away) > 1.0)
            apart = np.linalg.norm(dense[nearest] - truth["contact_point"][i], axis=1)
            if touching[i] and (apart < NEAR).any():
                near.append(bool((away[apart < NEAR] > 1.0).any()))
    return lost, wrong, float(np.mean(near))


def held(error, covariance):
    """Share of errors (n, k) that 95 % regions hold."""
    known = np.isfinite(error).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    error, covariance = error[known], covariance[known]
    square = np.einsum("ti,ti->t", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    return float((square < chi2.ppf(0.95, error.shape[1])).mean())


def wrench_held(data, truth, turned, rows):
    """Share of components of force and moment that 95 % intervals hold, laboratory axes."""
    turn = data["base_rotation"].values[:, 0]
    spread = data["wrench_covariance"].values[:, 0]
    inside = []
    for k, name in enumerate(("force", "moment")):
        own = np.einsum("tij,tj->ti", turn, data[name].values[:, 0])
        true = np.einsum("tij,tj->ti", turned, truth[name])
        block = spread[:, 3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        sigma = np.sqrt(np.einsum("tij,tjk,tik->ti", turn, block, turn))
        inside.append((np.abs(own - true) < 1.96 * sigma)[rows])
    return float(np.mean(inside))


def by_sensor(trial, recording, seed):
    """The tracked recording with contacts by a sensor of usual noise at the whisker's base."""
    read = signals_of(measure(trial, FORCE_NOISE, MOMENT_NOISE, seed), "sensor")
    return with_group(recording, "signals", placed_by(read, recording))


def peg_errors(recording, peg):
    """Errors of the fitted radius and axis, with their standard deviations, µm."""
    try:
        fit = shape_from_dataset(with_contour(recording)["contour"].to_dataset())
    except ValueError:
        return "none", "none"
    at = peg.origin + ((fit.origin - peg.origin) @ peg.axis) * peg.axis - fit.origin
    at -= (at @ fit.axis) * fit.axis
    across = np.eye(3) - np.outer(fit.axis, fit.axis)
    spread = np.sqrt(np.trace(across @ fit.covariance[:3, :3] @ across))
    numbers = (fit.radius - peg.radius, fit.sigma["radius"], np.linalg.norm(at), spread)
    error, sigma, offset, about = (f"{1e6 * x:.0f}".replace("-", "−") for x in numbers)
    return f"{error} ± {sigma}", f"{offset} ± {about}"


def sample_of(frames):
    """Frames of each view spread over the film."""
    return [[view[i] for i in np.linspace(0, FRAMES - 1, 30).astype(int)] for view in frames]


def start_of(cameras, frames, truth):
    """Distance of the base that is found without a click, in the worse view, and confidence."""
    start = find_start(cameras, sample_of(frames))
    if start.bases is None:
        return "refused"
    # The base is that of the first of these frames that shows it: any of them will do.
    bases = zip(start.bases, truth, strict=True)
    away = max(float(np.linalg.norm(line - base, axis=1).min()) for base, line in bases)
    return f"{away:.1f} ({start.confidence:.2f})"


class Clock:
    """CPU time of each frame after the first ones, ms."""

    def __init__(self):
        self.times = []

    def __call__(self, done):
        self.times.append(1e3 * time.process_time())

    @property
    def each(self):
        return (self.times[-1] - self.times[WARM - 1]) / (len(self.times) - WARM)


def filmed(name, look, seed):
    """A film: trial, peg, lenses, frames, stated cameras and truth."""
    trial, peg = whisk(seed, FRAMES, *OUTER.get(name, ()))
    lenses = views(DISTANCE, pixel=PIXEL, size=SIZE)
    frames = film(trial, lenses, (peg.origin, peg.axis, peg.radius), look, seed=seed)
    cameras = stated_lenses(orthogonal_views(PIXEL, (SIZE, SIZE)), DISTANCE)
    truth = {n: v.values[:, 0] for n, v in trial["truth"].to_dataset().data_vars.items()}
    return trial, peg, lenses, frames, cameras, truth


def one_film(name, look, seed):
    """One row of the table."""
    trial, peg, lenses, frames, cameras, truth = filmed(name, look, seed)
    base = trial["base_position"].values[:, 0]
    clocks = [Clock() for _ in lenses]
    traces = [
        trace_video(v, [lens(base[0])], progress=clock)
        for v, lens, clock in zip(frames, lenses, clocks, strict=True)
    ]
    spent = np.mean([clock.each for clock in clocks])
    touching = truth["in_contact"] > 0
    lost, wrong, near = traces_against(traces, lenses, truth, touching)
    recording = track(cameras, traces, RATE, TrackOptions(), sample=sample_of(frames))
    data = recording.to_dataset()
    stated = data["in_contact"].values[:, 0] > 0
    both = touching & stated
    away = (data["contact_point"].values[:, 0] - truth["contact_point"])[both]
    half, most = 1e6 * np.percentile(np.linalg.norm(away, axis=1), [50, 95])
    shares = (
        held(away, data["contact_covariance"].values[both, 0]),
        wrench_held(data, truth, trial["base_rotation"].values[:, 0], both),
        held(
            data["base_position"].values[:, 0] - base, data["pose_covariance"].values[:, 0, :3, :3]
        ),
    )
    return [
        f"{name}, {seed}",
        f"{lost}, {wrong} of {2 * FRAMES}",
        f"{100 * near:.0f}",
        f"{100 * float((stated == touching).mean()):.1f}",
        f"{half:.0f} ({most:.0f})",
        *(f"{100 * share:.0f} %" for share in shares),
        *peg_errors(recording, peg),
        peg_errors(by_sensor(trial, recording, seed), peg)[1],
        start_of(cameras, frames, [lens(base) for lens in lenses]),
        few(spent),
    ]


def row_films():
    """Rows of the table of several whiskers, one for each film and view."""
    sys.path.insert(0, str(ROOT / "tests" / "tracking"))
    from rows import RowFilm, scored

    for seed, count in ROWS:
        several = RowFilm(seed, count, frames=30)
        for view, camera in enumerate(several.cameras):
            clock = Clock()
            begin = several.truth[view][0, :, 0]
            traces = trace_video(several.images[view], begin, progress=clock)
            score = scored(traces, several.truth[view])
            clear = score[np.isfinite(score)]
            shares = (f"{100.0 * float(np.mean(clear == kind)):.1f}" for kind in (1, 0, -1))
            about = (str(seed), str(count), camera.name, str(len(clear)))
            yield [*about, *shares, f"{clock.each:.0f}"]


def way_films():
    """Rows of the table of other ways to film: without clicks, by a mirror, in one view."""
    for seed in WAYS:
        name, look = list(KINDS.items())[(seed - 61) % len(KINDS)]
        trial, _, lenses, frames, cameras, truth = filmed(name, look, seed)
        clicked = [lens(trial["base_position"].values[0, 0]) for lens in lenses]
        found = find_start(cameras, sample_of(frames)).bases
        ways = {"clicked": (frames, clicked), "without clicks": (frames, found)}
        with tempfile.TemporaryDirectory() as folder:
            # The second view is left of the first, as a mirror shows it.
            both = [np.hstack([front[:, ::-1], top]) for top, front in zip(*frames, strict=True)]
            path = Path(folder) / "mirror.mp4"
            write_video(path, both)
            parts = (f"{SIZE},0,{SIZE},{SIZE}", f"0,0,{SIZE},{SIZE}:mirrored")
            ways["mirror, H.264"] = (
                [list(read_video(f"{path}#{part}")) for part in parts],
                clicked,
            )
        ways["one view, in its plane"] = (frames[:1], clicked[:1])
        for way, (shown, bases) in ways.items():
            if bases is None:
                yield [f"{name}, {seed}", way, "refused", "–", "–", "–"]
                continue
            yield [f"{name}, {seed}", way, *one_way(shown, bases, lenses, cameras, truth)]


def one_way(frames, bases, lenses, cameras, truth):
    """Images lost and wrong, frames with right contact, its error, µm, and what regions hold."""
    count = len(frames)
    traces = [trace_video(v, [base]) for v, base in zip(frames, bases, strict=True)]
    touching = truth["in_contact"] > 0
    lost, wrong, _ = traces_against(traces, lenses[:count], truth, touching)
    some = sample_of(frames)
    data = track(cameras[:count], traces, RATE, TrackOptions(), sample=some).to_dataset()
    stated = data["in_contact"].values[:, 0] > 0
    both, axes = touching & stated, slice(0, 1 + count)
    away = (data["contact_point"].values[:, 0] - truth["contact_point"])[both, axes]
    half, most = 1e6 * np.percentile(np.linalg.norm(away, axis=1), [50, 95])
    return [
        f"{lost}, {wrong} of {count * FRAMES}",
        f"{100 * float((stated == touching).mean()):.1f}",
        f"{half:.0f} ({most:.0f})",
        f"{100 * held(away, data['contact_covariance'].values[both, 0, axes, axes]):.0f} %",
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("seeds", nargs="*", type=int, default=range(61, 67), metavar="SEED")
    parser.add_argument("--page", action="store_true", help="write the tables into the page")
    parser.add_argument("--part", choices=PARTS, help="make one table only")
    chosen = parser.parse_args()
    pages = [ROOT / "docs" / f"tracking-{name}.md" for name in ("films", "rows")]
    for name, (head, texts, rows) in PARTS.items():
        if chosen.part not in (None, name):
            continue
        lines = []
        for line in rows(chosen.seeds) if name == "films" else rows():
            lines.append(line)
            print(" | ".join(line), flush=True)
        if chosen.page:
            put(pages, {name: table(head, lines, texts)})


def single_films(seeds):
    """Rows of the table of single whiskers."""
    for seed, (name, look) in zip(seeds, cycle(KINDS.items()), strict=False):
        try:
            yield one_film(name, look, seed)
        except ValueError as fault:
            yield [f"{name}, {seed}", *["–"] * (len(HEAD) - 2), f"refused: {fault}"]


PARTS = {
    "films": (HEAD, 1, single_films),
    "rows": (ROW_HEAD, 3, row_films),
    "ways": (WAY_HEAD, 2, way_films),
}


if __name__ == "__main__":
    main()
