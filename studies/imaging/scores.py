"""How far tracked whiskers are from the truth."""

from __future__ import annotations

import time
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from imaging.cases import Case, Filmed, filmed
from vibrissa.recording import Recording
from vibrissa.tracking import (
    FRAMES,
    Start,
    Trace,
    TraceOptions,
    TrackOptions,
    find_start,
    trace_video,
    track,
)

Array = NDArray[np.float64]

WRONG = 1.0
"""Pixels from the true whisker, in the median of a frame: beyond, a trace is of something else."""


def tracked(case: Case, seed: int = 0) -> dict[str, Any]:
    """Track a case; what came of it."""
    film = filmed(case, seed)
    out: dict[str, Any] = {"name": case.name, "group": case.group}
    begun = time.process_time()
    properties = {
        name: getattr(case.whisker, name)
        for name in ("base_radius", "tip_radius", "youngs_modulus", "poisson_ratio")
    }
    with warnings.catch_warnings(record=True) as found_contact:
        warnings.simplefilter("always")
        try:
            start = started(film)
            traces = [
                trace_video(frames, [base], TraceOptions(bright=start.bright))
                for frames, base in zip(film.frames, start.bases, strict=True)
            ]
            out |= trace_scores(film, traces)
            options = TrackOptions(properties=properties, offset=case.offset)
            found = track(film.cameras, traces, case.rate, options)
            out |= rod_scores(film, found)
            out["remarks"] = found.attrs.get("remarks", "").splitlines()
        except Exception as error:  # what a user would read
            out["error"] = f"{type(error).__name__}: {error}"
    out["found_contact"] = sorted({str(one.message) for one in found_contact})
    out["cpu"] = time.process_time() - begun
    return out


def started(film: Filmed) -> Start:
    """Where the whisker begins, from frames as `vibrissa track` reads them."""
    count = min(len(frames) for frames in film.frames)
    rows = np.unique(np.linspace(0, count - 1, min(FRAMES, count)).astype(int))
    start = find_start(film.cameras, [[view[i] for i in rows] for view in film.frames])
    if start.bases is None:
        raise ValueError(f"the base of the whisker was not found: {start.doubts[0]}")
    return start


def trace_scores(film: Filmed, traces: list[list[list[Trace]]]) -> dict[str, Any]:
    truth = film.trial["truth"].to_dataset().isel(whisker=0)
    away, wrong, lost, tips, scaled, count = [], 0, 0, [], [], 0
    for view, (row,) in enumerate(traces):
        for i, trace in zip(film.shown[view], row, strict=True):
            count += 1
            if not len(trace.line):
                lost += 1
                continue
            miss, tip = _misses(truth["trace"].values[i, view], trace.line)
            wrong += int(np.median(miss) > WRONG)
            away.append(miss)
            inner = slice(5, -5)
            scaled.append(miss[inner] / trace.sigma[inner])
            tips.append(tip)
    if not away:
        return {"lost": lost, "frames": count}
    every = np.concatenate(away)
    return {
        "frames": count,
        "lost": lost,
        "wrong": wrong,
        "trace": [float(np.median(every)), float(np.percentile(every, 95))],
        "trace_scaled": float(np.median(np.concatenate(scaled)) / 0.6745),
        "tip": float(np.median(tips)),
        "confidence": float(np.mean([t.confidence for (row,) in traces for t in row])),
    }


def _misses(nodes: Array, line: Array) -> tuple[Array, float]:
    """Distances of points from the true curve, and how much of its end is missing, pixels."""
    curve = CubicSpline(np.linspace(0.0, 1.0, len(nodes)), nodes)(np.linspace(0.0, 1.0, 3000))
    tangent = np.gradient(curve, axis=0)
    size = np.linalg.norm(tangent, axis=1, keepdims=True)
    tangent /= size
    _, near = cKDTree(curve).query(line)
    gap = line - curve[near]
    across = np.abs(gap[:, 0] * tangent[near, 1] - gap[:, 1] * tangent[near, 0])
    far = np.linalg.norm(gap, axis=1)
    # Beyond the ends the whisker's own direction counts, within reason.
    miss = np.where(far < 5.0, across, far)
    return miss, float(size[near[-1] :].sum())


def rod_scores(film: Filmed, found: Any) -> dict[str, Any]:
    data = found.to_dataset().isel(whisker=0)
    rows = film.shown[0][data["frame"].values[:, 0]]
    truth = film.trial["truth"].to_dataset().isel(whisker=0, time=rows)
    known = data["confidence"].values > 0.0
    truly, found_contact = truth["in_contact"].values > 0, data["in_contact"].values > 0
    whisker, true = Recording(found).whisker(), Recording(film.trial).whisker()
    both = truly & found_contact
    gap = data["contact_point"].values - truth["contact_point"].values
    size = np.linalg.norm(gap, axis=1)[both]
    spread = data["contact_covariance"].values[both]
    fine = np.isfinite(size) & np.isfinite(spread).all(axis=(1, 2))
    squares = np.array(
        [g @ np.linalg.solve(c, g) for g, c in zip(gap[both][fine], spread[fine], strict=True)]
    )
    claimed = np.sqrt(np.einsum("tii->t", spread[fine]))
    force = np.linalg.norm(data["moment"].values - truth["moment"].values, axis=1)
    strong = np.linalg.norm(truth["moment"].values, axis=1)
    bent = both & (strong > 0.1 * strong.max())

    def two(values: Array) -> list[float]:
        return [float(q) for q in np.percentile(values, [50.0, 95.0])] if values.size else []

    return {
        "rows": len(rows),
        "missing": int((~known).sum()),
        "right": float((truly == found_contact)[known].mean()) if known.any() else np.nan,
        "touching": [int(truly.sum()), int(found_contact.sum())],
        "contact": two(size[np.isfinite(size)]),
        "claimed": two(claimed),
        # 2.37 is the median of the square of three standard normal numbers.
        "over": float(np.sqrt(np.median(squares) / 2.366)) if squares.size else np.nan,
        "moment": two(force[bent] / strong[bent]),
        "length": float(whisker.length / true.length - 1.0),
        "misfit": float(np.nanmedian(data["trace_misfit"].values)),
    }
