"""Pinhole cameras without calibration: errors of contact points and the coverage of their regions.

``python studies/rough_cameras.py SEED...`` films a whisk of a whisker of 30–36 mm past a peg
through lenses at 0.6 m, 150 µm a pixel, by `pinhole_film`, and tracks it with cameras that are
taken to be orthographic, orthographic but rough (as without ``--distance``), rough at 0.6 m, and
known.
"""

import argparse

import numpy as np
from pinhole_film import film, views

from vibrissa import Whisker
from vibrissa.cameras import orthogonal_views
from vibrissa.objects import Peg
from vibrissa.simulation import Motion, simulate
from vibrissa.tracking import TrackOptions, trace_video, track
from vibrissa.tracking.refine.optics import stated_lenses

PIXEL, SIZE, DISTANCE, RATE = 150e-6, 360, 0.6, 500.0
HELD = 7.815
"""χ² of three numbers that 95 % are below."""


def whisk(seed, frames=90, *share):
    """A whisk that rises as it protracts, past a peg that leans, at a share of the length."""
    rng = np.random.default_rng(seed)
    whisker = Whisker.parabola(length=rng.uniform(30e-3, 36e-3), coefficient=rng.uniform(4.0, 9.0))
    phase = np.linspace(0.0, 1.0, frames)
    azimuth = -0.5 + 1.25 * np.sin(0.9 * np.pi * phase) + rng.uniform(-0.05, 0.05)
    elevation = 0.1 + 0.35 * azimuth + rng.uniform(-0.1, 0.1)
    shift = np.outer(np.sin(np.pi * phase), rng.uniform(-0.6e-3, 0.6e-3, 3))
    base = np.array([-15e-3, -1e-3, 0.0]) + shift
    angle, away = rng.uniform(0.3, 0.45), rng.uniform(*(share or (0.5, 0.6))) * whisker.length
    axis = np.array([*rng.uniform(-0.1, 0.1, 2), 1.0])
    origin = base[0] + away * np.array([np.cos(angle), np.sin(angle), 0.0])
    peg = Peg(origin, axis / np.linalg.norm(axis), rng.uniform(1.0e-3, 1.6e-3))
    motion = Motion(np.arange(frames) / RATE, azimuth, elevation, 0.3 * azimuth, base)
    return simulate(whisker, motion, peg), peg


def scores(trial, found):
    """Contact error (µm), what is stated, and shares of 95 % regions that hold the truth."""
    truth, data = trial["truth"].to_dataset(), found.to_dataset()
    both = (truth["in_contact"].values[:, 0] > 0) & (data["in_contact"].values[:, 0] > 0)
    error = (data["contact_point"].values - truth["contact_point"].values)[:, 0][both]
    spread = data["contact_covariance"].values[:, 0][both]
    held = np.einsum("ti,tij,tj->t", error, np.linalg.inv(spread), error) < HELD
    base = data["base_position"].values[:, 0] - trial["base_position"].values[:, 0]
    known = np.isfinite(base).all(axis=1)
    own = data["pose_covariance"].values[known, 0, :3, :3]
    kept = np.einsum("ti,tij,tj->t", base[known], np.linalg.inv(own), base[known]) < HELD
    half, most = 1e6 * np.percentile(np.linalg.norm(error, axis=1), [50, 95])
    stated = 1e6 * np.median(np.sqrt(np.trace(spread, axis1=1, axis2=2)))
    return f"{half:.0f} ({most:.0f}) | {stated:.0f} | {held.mean():.2f} | {kept.mean():.2f}"


def main(seeds):
    cameras = orthogonal_views(PIXEL, (SIZE, SIZE))
    ways = {
        "orthographic": (cameras, TrackOptions()),
        "rough": (cameras, TrackOptions(rough=True)),
        "rough, 0.6 m": (cameras, TrackOptions(rough=True, distance=DISTANCE)),
        "known": (stated_lenses(cameras, DISTANCE), TrackOptions()),
    }
    print("| seed | cameras | contact, µm | stated | holds contact | holds base |")
    for seed in seeds:
        trial, peg = whisk(seed)
        lenses = views(DISTANCE, pixel=PIXEL, size=SIZE)
        frames = film(trial, lenses, (peg.origin, peg.axis, peg.radius), seed=seed)
        begin = trial["base_position"].values[0, 0]
        traces = [
            trace_video(video, [lens(begin)]) for video, lens in zip(frames, lenses, strict=True)
        ]
        for name, (views_, options) in ways.items():
            found = track(views_, traces, RATE, options)
            print(f"| {seed} | {name} | {scores(trial, found)} |", flush=True)
            for line in found.attrs.get("remarks", "").splitlines():
                print(f"  {line}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("seeds", nargs="*", type=int, default=[2], help="films; 2 by default")
    main(parser.parse_args().seeds)
