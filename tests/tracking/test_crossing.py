"""Whiskers that cross before a furry face: each stays itself, beyond the crossing too."""

import numpy as np
import pytest
from rows import RowFilm, scored

from vibrissa.tracking import Trace, trace_video
from vibrissa.tracking.trace.ridge import measured, noise_level
from vibrissa.tracking.trace.scene import Scene
from vibrissa.tracking.trace.trace import TraceOptions, between_whiskers
from vibrissa.tracking.trace.video import neighbours


@pytest.fixture(scope="module")
def crossing():
    """Three whiskers that cross in both views, in the first frame already."""
    return RowFilm(1, 3, frames=12)


@pytest.mark.parametrize(
    ("view", "inside"),
    [(0, 0.0), (1, 25.0), pytest.param(0, 25.0, marks=pytest.mark.slow)],
    ids=["top, at the base", "front, inside the fur", "top, inside the fur"],
)
def test_crossing_whiskers_stay_themselves(crossing, view, inside):
    truth = crossing.truth[view]
    ahead = truth[0, :, 2] - truth[0, :, 0]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    traces = trace_video(crossing.images[view], truth[0, :, 0] - inside * ahead)
    score = scored(traces, truth)
    assert np.isfinite(score).mean() > 0.6
    assert (score[np.isfinite(score)] == 1.0).mean() > 0.97


@pytest.mark.parametrize(
    "asked", [(0, 1), pytest.param((0, 2), marks=pytest.mark.slow)], ids=["two above", "both outer"]
)
def test_neighbours_that_nobody_asked_for_keep_their_ends(crossing, asked):
    """If the third is not followed, one of the two goes on as it in a third of the images."""
    truth = crossing.truth[1]
    traces = trace_video(crossing.images[1], truth[0, asked, 0])
    assert len(traces) == 2
    every = [[Trace.lost()] * len(truth) for _ in range(3)]
    for k, row in zip(asked, traces, strict=True):
        every[k] = row
    score = scored(every, truth)[:, asked]
    assert np.isfinite(score).sum() > 12
    assert (score[np.isfinite(score)] == 1.0).mean() > 0.97


@pytest.mark.parametrize(
    "asked", [1, *(pytest.param(outer, marks=pytest.mark.slow) for outer in (0, 2))]
)
def test_a_single_click_in_a_row_keeps_its_whisker(crossing, asked):
    """By itself it goes on as another one where they cross, in half of the images and more."""
    truth = crossing.truth[0]
    (row,) = trace_video(crossing.images[0], truth[0, [asked], 0])
    every = [[Trace.lost()] * len(truth) for _ in range(3)]
    every[asked] = row
    assert (scored(every, truth)[:, asked] == 1.0).all()


def test_neighbours_are_all_others(crossing):
    truth = crossing.truth[0][0, :, 0]
    frames = crossing.images[0][::2]
    scene = Scene.of(frames, 1.0)
    found = neighbours(frames, truth[:1], scene, TraceOptions())
    assert np.linalg.norm(np.array(found) - truth[1:], axis=1).max() < 8.0
    assert not neighbours(frames, truth, scene, TraceOptions())


def test_straight_whiskers_that_cross_in_one_place_keep_their_ends():
    """From the first frame on three cross within 100 pixels; only how they bend shows the order."""
    several = RowFilm(21, 3, frames=4)
    truth = several.truth[1]
    traces = trace_video(several.images[1], truth[0, :, 0])
    score = scored(traces, truth)
    assert (score[np.isfinite(score)] == 1.0).all()
    # The ends of two of them are apart from all others; the third's is on the second's.
    tips = np.array([[trace.line[-1] for trace in row] for row in traces[:2]])
    away = np.linalg.norm(tips - truth[:, :2, -1].swapaxes(0, 1), axis=2)
    assert np.median(away) < 3.0


def test_nothing_is_measured_where_another_line_is():
    """A line at 10 pixels from another is measured, where they cross it is bridged."""
    y, x = np.mgrid[:120, :240].astype(float)
    slope = np.tan(0.15)
    other = 60.0 + slope * (x - 120.0)
    depth = 90.0 * np.exp(-0.5 * ((y - 60.0) / 1.3) ** 2)
    depth = np.maximum(depth, 110.0 * np.exp(-0.5 * ((y - other) / 1.3) ** 2))
    frame = (200.0 - depth).astype(np.uint8)
    column = np.arange(20.0, 220.0, 2.0)
    lines = [
        np.stack([column, 60.0 + 0.0 * column], axis=1),
        np.stack([column, 60.0 + slope * (column - 120.0)], axis=1),
    ]
    own, _ = between_whiskers(lines, None, frame.shape)
    options, noise = TraceOptions(), noise_level(frame)
    line, along = measured(frame, lines[0], 2, noise, options, 0, own)
    crossed = np.abs(column - 120.0) * slope < 4.0
    assert not along.seen[crossed].any()
    assert along.seen[np.abs(column - 120.0) * slope > 8.0].all()
    assert along.sigma[crossed].max() > 5.0 * along.sigma[~crossed].min()
    np.testing.assert_allclose(line[:, 1], 60.0, atol=0.3)
