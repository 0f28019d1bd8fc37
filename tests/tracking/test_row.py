"""Several whiskers of one view, told apart: a filmed row whose truth is known."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from vibrissa import Whisker
from vibrissa.cameras import orthogonal_views
from vibrissa.simulation import ImageConditions, Motion, film_frames, simulate, with_true_traces
from vibrissa.tracking import Trace, trace_video
from vibrissa.tracking.trace import ridge, video
from vibrissa.tracking.trace.follower import start_at
from vibrissa.tracking.trace.row import follow_row

COUNT = 6
FRAMES = 30
RATE = 250.0
GAP = 0.5e-3
CAMERA = orthogonal_views(size=(420, 360), center=(9e-3, 0.0, 0.0))[0]


def one(index, generator):
    """A whisker of the row, whisking at 10 Hz: up to 6° from frame to frame."""
    t = np.arange(FRAMES) / RATE
    place = index - 0.5 * (COUNT - 1)
    amplitude = np.radians(25.0) * (1.0 + 0.1 * generator.normal())
    azimuth = np.radians(5.0) * place + amplitude * np.sin(20.0 * np.pi * t - 0.15 * index)
    elevation = np.radians(4.0 * generator.normal()) + 0.1 * azimuth
    whisker = Whisker.parabola(
        length=(20.0 - 2.0 * index) * 1e-3, coefficient=10.0 + 3.0 * index, name=f"w{index}"
    )
    base = np.tile([0.0, GAP * place, 0.0], (FRAMES, 1))
    return whisker, Motion(t, azimuth, elevation, 0.2 * azimuth, base)


@pytest.fixture(scope="module")
def row():
    """Frames of six whiskers, 9 pixels from each other, and their true middles."""
    generator = np.random.default_rng(0)
    order = sorted(range(COUNT), key=lambda k: abs(k - 2.5))
    whiskers, motions = zip(*(one(k, generator) for k in order), strict=True)
    recording = with_true_traces(simulate(whiskers, motions, []), [CAMERA])
    bare = film_frames(recording, CAMERA, ImageConditions(face=(0.0, 0.0, 0.0)), seed=1)
    frames = [behind_a_wall(frame) for frame in bare]
    return frames, recording["truth"]["trace"].values[:, :, 0]


def behind_a_wall(frame):
    """The face as a dark wall with a soft edge, where the whiskers begin."""
    bright = 1.0 / (1.0 + np.exp(-(np.arange(frame.shape[1]) - 54.0)))
    return (12.0 + bright * (frame - 12.0)).astype(np.uint8)


def curve(nodes):
    return CubicSpline(np.linspace(0.0, 1.0, len(nodes)), nodes)(np.linspace(0.0, 1.0, 400))


def whose(line, nodes):
    """Number of the true whisker on which a line lies over its first two thirds; −1 if on none."""
    part = line[: max(12, 2 * len(line) // 3)]
    away = [np.median(cKDTree(curve(each)).query(part)[0]) for each in nodes]
    return int(np.argmin(away)) if min(away) < 1.5 else -1


def names(traces, truth, first=0):
    """Whose each trace is, (time, whisker); −2 where it is lost."""
    return np.array(
        [
            [whose(t.line, truth[first + i]) if len(t.line) else -2 for t in each]
            for i, each in enumerate(zip(*traces, strict=True))
        ]
    )


def test_nobody_is_taken_for_another(row):
    frames, truth = row
    traces = trace_video(frames, truth[0, :, 0] + 1.5)
    found = names(traces, truth)
    right = found == np.arange(COUNT)
    assert right[found != -2].mean() >= 0.999
    assert (found == -2).mean() < 0.02


@pytest.mark.slow
def test_a_frame_without_whiskers_mixes_nobody_up(row):
    """Three frames are missing, in which the row moves by more than its spacing."""
    frames, truth = row
    seen = [frames[i] if i not in (8, 9, 10) else np.full_like(frames[0], 190) for i in range(20)]
    found = names(trace_video(seen, truth[0, :, 0]), truth)
    assert (found[8:11] == -2).all()
    right = found == np.arange(COUNT)
    assert right[found != -2].all()
    assert right[-5:].mean() > 0.6


def test_a_whisker_that_is_gone_is_lost_and_not_its_neighbour(row):
    """Painted over from the sixth frame on, its follower stays without a trace."""
    frames, truth = row
    followers = [start_at(base) for base in truth[0, :, 0]]
    traces = [follow_row(followers, frames[i], {}) for i in range(5)]
    for i in range(5, 15):
        frame = frames[i].copy()
        for x, y in curve(truth[i, 2]).astype(int):
            if x < 58:
                continue
            frame[y - 3 : y + 4, x - 2 : x + 3] = frame[y - 4 : y - 3, x - 2 : x + 3]
        traces.append(follow_row(followers, frame, {}))
    found = names(list(zip(*traces, strict=True)), truth)
    assert (found[4] == np.arange(COUNT)).all()
    others = [k for k in range(COUNT) if k != 2]
    assert (found[4:, others] == others).mean() > 0.97
    assert not np.isin(found[5:, 2], others).any()


def test_a_row_at_rest_is_not_renamed_for_a_hidden_whisker(row, monkeypatch):
    """Its neighbours' lines, and the next one, which nobody clicked, would give each a line."""
    monkeypatch.setattr(video, "neighbours", lambda *given: [])
    frames, truth = row
    order = np.argsort(truth[0, :, 0, 1])
    asked, hidden = order[:4], order[1]
    painted = frames[0].copy()
    for x, y in curve(truth[0, hidden]).astype(int):
        painted[y - 3 : y + 4, x - 2 : x + 3] = painted[y - 4 : y - 3, x - 2 : x + 3]
    at_rest = 12
    generator = np.random.default_rng(1)
    noise = generator.normal(size=(at_rest, *painted.shape))
    resting = [np.clip(painted + one, 0, 255).astype(np.uint8) for one in noise]
    traces = trace_video([*resting, *frames], truth[0, asked, 0], sample=frames)
    found = names(traces, np.concatenate([np.repeat(truth[:1], at_rest, axis=0), truth]))
    assert (found[:at_rest] == [order[0], -2, *order[2:4]]).mean() > 0.95
    assert (found[at_rest:, [0, 2, 3]] == order[[0, 2, 3]]).mean() > 0.9


def test_what_is_given_is_nobody_elses(row):
    frames, truth = row
    followers = [start_at(base) for base in truth[0, :2, 0]]
    traces = follow_row(followers, frames[0], {1: curve(truth[0, 0])[::40]})
    assert not len(traces[0].line)
    assert whose(traces[1].line, truth[0]) == 0


def test_a_click_where_no_line_begins_takes_nobody_elses(row):
    """All clicks are inside the face, one of them next to that of another whisker."""
    frames, truth = row
    clicks = truth[0, :, 0] - [4.0, 0.0]
    clicks = np.vstack([clicks, clicks[0] + np.array([0.0, 3.6])])
    traces = follow_row([start_at(click) for click in clicks], frames[0], {})
    found = [whose(trace.line, truth[0]) if len(trace.line) else -2 for trace in traces]
    assert found == [*range(COUNT), -2]


def test_a_whisker_that_goes_on_as_a_hair_before_its_base_is_taken_and_not_the_next_hair():
    y, x = np.mgrid[:130, :200]
    whisker = np.hypot(y - 60.0 - 2e-3 * (x - 25.0) ** 2, np.maximum(np.abs(x - 97.0) - 72.0, 0.0))
    hair = np.hypot(x - 50.0 + 0.1 * (y - 67.0), np.maximum(np.abs(y - 89.0) - 22.0, 0.0))
    dark = np.exp(-0.5 * (np.minimum(whisker, hair) / 1.4) ** 2)
    frame = 190.0 - 90.0 * dark + np.random.default_rng(0).normal(size=dark.shape)
    (trace,) = follow_row([start_at((50.0, 61.0))], frame.astype(np.uint8), {})
    assert trace.line[-1, 0] > 150.0


def test_a_wire_that_begins_at_the_base_is_not_the_whisker(row):
    """It is longer than the whisker, and as near to the click."""
    frames, truth = row
    base = truth[0, 5, 0]
    y, x = np.mgrid[: frames[0].shape[0], : frames[0].shape[1]]
    away = (y - base[1] + 4.0 + 0.8 * (x - base[0])) / np.hypot(1.0, 0.8)
    wire = np.where(x > 54, 1.0 - 0.25 * np.exp(-0.5 * (away / 1.2) ** 2), 1.0)
    shown = [(frame * wire).astype(np.uint8) for frame in frames]
    (traces,) = trace_video(shown, [base + np.array([1.5, -2.5])])
    assert (names([traces], truth) == 5).all()


def test_nothing_is_found_in_nothing():
    frame = np.clip(np.random.default_rng(0).normal(180.0, 3.0, (90, 120)), 0, 255)
    followers = [start_at((20.0, 30.0)), start_at((20.0, 40.0))]
    for _ in range(2):
        traces = follow_row(followers, frame.astype(np.uint8), {})
        assert [len(trace.line) for trace in traces] == [0, 0]
    assert isinstance(traces[0], Trace)


def test_noise_of_compressed_video_is_what_lines_stand_out_from():
    """Averaged over 3×3 pixels noise hardly differs from pixel to pixel, but is there."""
    generator = np.random.default_rng(0)
    white = generator.normal(size=(300, 300))
    smooth = sum(np.roll(white, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 3.0
    level = ridge.noise_level(np.clip(150.0 + 6.0 * smooth, 0, 255).astype(np.uint8))
    assert level > 6.0
