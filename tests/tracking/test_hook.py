"""A whisker whose base a neighbour that was cut covers, in all frames and both views."""

import numpy as np
import pytest

from vibrissa import Whisker
from vibrissa.recording import Recording
from vibrissa.tracking import RestShape, TrackOptions, track
from vibrissa.tracking.refine.hook import hook_of

PIXEL = 1e-4
NODES = 101
S = np.linspace(0.0, 1.0, NODES)


def shape_of(points, noise=0.0, seed=0):
    """A shape at rest with errors of neighbouring points that are alike."""
    errors = np.random.default_rng(seed).normal(size=(NODES + 8, 3))
    alike = np.stack([np.convolve(e, np.ones(9) / 3.0, mode="valid") for e in errors.T], axis=1)
    free = np.ones(9, dtype=bool)
    return RestShape(points + noise * alike, free, np.zeros(9), 1e-6)


def curved(bend, more=0.0):
    """A whisker of 25 mm that bends as s² and, less, as s⁴."""
    x = 25e-3 * S
    return np.stack([x, bend * x**2 + more * x**4, 0.3 * bend * x**2], axis=1)


def beside(size, end):
    """How far a hair that meets the whisker at a share of its length is from it."""
    aside = size * np.clip(1.0 - S / end, 0.0, None)
    return np.stack([0.0 * S, aside, -0.5 * aside], axis=1)


@pytest.mark.parametrize("bend", [0.0, 6.0, 20.0])
@pytest.mark.parametrize(("size", "end"), [(0.6e-3, 0.2), (0.1e-3, 0.1), (-0.2e-3, 0.26)])
def test_a_hook_is_what_a_smooth_whisker_does_not_have(bend, size, end):
    aside = beside(size, end)
    for seed in range(4):
        hook = hook_of(shape_of(curved(bend, 200.0) + aside, 0.3e-6, seed), PIXEL)
        error = np.linalg.norm(hook.aside - aside, axis=1)
        assert error.max() < 3.0 * hook.sigma
        assert hook.sigma < 0.4 * abs(size)
        assert abs(hook.count / NODES - end) < 0.1


@pytest.mark.parametrize("more", [0.0, 2e3, 2e4])
def test_a_smooth_whisker_has_no_hook(more):
    for bend in (0.0, 6.0, 20.0):
        for size in (0.0, 0.01e-3):
            shape = shape_of(curved(bend, more) + beside(size, 0.06), 0.5e-6)
            assert hook_of(shape, PIXEL) is None


@pytest.mark.parametrize("noise", [0.0, 0.2e-6, 3e-6])
@pytest.mark.parametrize("slope", [0.2, 1.4, 2.4])
def test_a_strongly_curved_whisker_has_no_hook(slope, noise):
    whisker = Whisker.parabola(length=40e-3, coefficient=0.5 * slope / 40e-3)
    assert hook_of(shape_of(whisker.position(40e-3 * S), noise), PIXEL) is None


@pytest.mark.parametrize("turn", [1.0, 1.5])
@pytest.mark.parametrize("along", [lambda s: (1.0 - s) ** 2, lambda s: np.exp(-5.0 * s)])
def test_a_whisker_that_is_curved_near_its_base_has_no_hook(turn, along):
    """Its curvature falls along it as that of no polynomial of low degree."""
    curvature = turn * along(S) / np.trapezoid(along(S), S)
    angle = np.cumsum(curvature) / NODES
    points = (
        30e-3
        / NODES
        * np.cumsum(np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1), axis=0)
    )
    for seed in range(4):
        assert hook_of(shape_of(points, 0.2e-6, seed), PIXEL) is None


def drawn_aside(camera_traces, size, count):
    """Traces of one whisker in one view that begin on a hair, so many pixels from it."""
    found = []
    for trace in camera_traces:
        line = trace.line.copy()
        ahead = line[min(8, len(line) - 1)] - line[0]
        across = np.array([-ahead[1], ahead[0]]) / np.linalg.norm(ahead)
        line[:count] += size * np.linspace(1.0, 0.0, count)[:, None] * across
        found.append(trace._replace(line=line))
    return found


def test_a_base_is_on_the_whisker_and_not_on_a_hair(filmed, traced):
    """It moves with the whisker, as what grows next to it does."""
    truth = filmed.recording.to_dataset().isel(whisker=0)
    turned, away, lost, said = [], [], [], []
    hooked = [
        [drawn_aside(view[0], size, 14)] for view, size in zip(traced, (4.0, -3.0), strict=True)
    ]
    for traces in (traced, hooked):
        data = track(filmed.cameras, traces, 1000.0).to_dataset().isel(whisker=0)
        tangent = data["base_rotation"].values[:, :, 0] * truth["base_rotation"].values[:, :, 0]
        turned.append(np.median(np.arccos(np.clip(tangent.sum(axis=1), -1.0, 1.0))))
        error = data["base_position"].values - truth["base_position"].values
        away.append(np.median(np.linalg.norm(error, axis=1)))
        said.append("on something else" in data.attrs.get("remarks", ""))
        lost.append((data["trace_visible"].values[..., 6:12] == 0.0).mean())
    assert turned[1] < turned[0] + np.radians(1.0)
    assert away[1] < away[0] + 50e-6
    assert lost[0] < 0.1 < 0.9 < lost[1]
    assert said == [False, True]


def test_a_base_that_one_view_hides_in_some_frames_is_one_point(filmed, traced):
    """There it is shown from 24 pixels farther out only, and where it ends shows where it is."""
    true = filmed.recording.to_dataset().isel(whisker=0)["base_position"].values
    some = np.arange(len(true)) // 8 % 2 == 1
    later = [
        t._replace(line=t.line[12:], sigma=t.sigma[12:], seen=t.seen[12:]) if hidden else t
        for t, hidden in zip(traced[0][0], some, strict=True)
    ]
    data = track(filmed.cameras, [[later], traced[1]], 1000.0).to_dataset().isel(whisker=0)
    away = np.linalg.norm(data["base_position"].values - true, axis=1)
    assert np.nanmedian(away[some]) < 0.3e-3
    assert np.nanmedian(away[~some]) < 0.3e-3


def test_a_radius_is_stated_where_most_of_a_base_is_shown(filmed, traced):
    """In free frames one view shows it from 24 pixels farther out only, as does the rest shape."""
    free = (filmed.truth["force"].values == 0.0).all(axis=1)
    later = [
        t._replace(line=t.line[12:], sigma=t.sigma[12:], seen=t.seen[12:]) if hidden else t
        for t, hidden in zip(traced[0][0], free, strict=True)
    ]
    options = TrackOptions(properties={"base_radius": 50e-6})
    radii = []
    for rows in (traced[0], [later]):
        whisker = Recording(track(filmed.cameras, [rows, traced[1]], 1000.0, options)).whisker()
        at = 1.0 - (50e-6 - whisker.radius(0.0)) / (50e-6 - whisker.radius(whisker.length))
        radii.append((at, whisker.length))
    assert radii[0][0] > 0.98
    assert radii[1][0] == pytest.approx(radii[1][1] / radii[0][1], abs=0.05)
    assert radii[1][0] < 0.95


def test_a_whisker_of_which_a_view_shows_a_stub_is_not_located(filmed, traced):
    """It follows a neighbour that was cut at a fifth of the length that the other view shows."""
    short = []
    for trace in traced[0][0]:
        n = len(trace.line) // 5
        part = {name: getattr(trace, name)[:n] for name in ("line", "sigma", "seen")}
        short.append(trace._replace(**part))
    with pytest.raises(ValueError, match="too little of one whisker to locate it: top over"):
        track(filmed.cameras, [[short], traced[1]], 1000.0)
