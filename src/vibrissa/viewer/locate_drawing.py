"""Candidates and errors as things to look at, and as words."""

from __future__ import annotations

import numpy as np

from vibrissa.quantities import to_display
from vibrissa.signals import SIGNALS
from vibrissa.status import Status
from vibrissa.viewer.bend_drawing import whisker_body
from vibrissa.viewer.drawing import FIT, GHOST, Array, Body, Drawing, Label, Thing
from vibrissa.viewer.locating import Located
from vibrissa.viewer.meshes import ellipsoid, error_ellipsoid
from vibrissa.viewer.readout import note, number, sentence, table
from vibrissa.whisker import Whisker

SIGMAS = 2.0
"""Standard deviations of the ellipsoids."""

MOST = 0.3
"""Longest semi-axis that is drawn, over the length: what is longer is as good as unknown."""


def locate_drawing(whisker: Whisker, found: Located, exaggeration: float) -> Drawing:
    """Draw the whisker in every other contact that feels the same, and the errors of all."""
    out: dict[str, Thing] = {}
    covariances = found.estimate.candidate_covariances
    others = set(found.others(whisker.length).tolist())
    for i, point in enumerate(found.points):
        if i in others:
            out[f"ghost {i}"] = whisker_body(whisker, found.lines[i], exaggeration, GHOST, 0.55)
            radius = float(to_display("length", 0.008 * whisker.length))
            ball = ellipsoid(_mm(point), radius * np.eye(3))
            out[f"ball {i}"] = Body(*ball, GHOST)
            apart = number("separation", float(found.distances[i]), 3)
            out[f"apart {i}"] = Label(_mm(point), f"feels the same, {apart} away")
        if np.isfinite(covariances[i]).all():
            most = MOST * whisker.length
            vertices, faces = error_ellipsoid(point, covariances[i], SIGMAS, most)
            out[f"error {i}"] = Body(_mm(vertices), faces, FIT, 0.45)
    return out


def of_located(whisker: Whisker, found: Located | None, status: Status) -> str:
    """What three signals tell: how many contacts, how far apart, how exact."""
    if found is None:
        return sentence(status)
    names = found.sensor.triplet
    felt = {name: float(found.signals[name]) for name in SIGNALS}
    chosen = {name: felt[name] for name in names}
    parts = [sentence(Status(int(found.estimate.status))), table(chosen, "Felt")]
    others = found.others(whisker.length)
    if others.size:
        farthest = number("separation", float(found.distances[others].max()), 3)
        parts.append(note(f"The farthest contact that feels the same is {farthest} away."))
    own = int(np.argmin(found.distances)) if found.points.size else -1
    if own >= 0 and np.isfinite(found.estimate.candidate_covariances[own]).all():
        spread = np.sqrt(np.diagonal(found.estimate.candidate_covariances[own]))
        errors = dict(zip(("sigma_x", "sigma_y", "sigma_z"), spread.tolist(), strict=True))
        parts.append(table(errors, f"Error of the contact point ({SIGMAS:.0f}σ drawn)"))
        if SIGMAS * spread.max() > MOST * whisker.length:
            parts.append(note("The ellipsoid is cut short: along it the place is unknown."))
    rest = {name: value for name, value in felt.items() if name not in names}
    parts.append(table(rest, "Not used"))
    return "".join(parts)


def _mm(values: Array) -> Array:
    return to_display("length", values)
