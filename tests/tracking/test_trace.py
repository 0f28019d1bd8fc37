"""Traces against the true middle of a filmed whisker."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from vibrissa.status import Status
from vibrissa.tracking import Trace, TraceOptions, find_whiskers, trace_video
from vibrissa.tracking.trace import ridge
from vibrissa.tracking.trace.curves import find_curves
from vibrissa.tracking.trace.ends import traced
from vibrissa.tracking.trace.scene import Scene
from vibrissa.tracking.trace.trace import (
    STEP,
    Clutter,
    arc_lengths,
    doubtful_frames,
    even,
    given,
    interpolated,
    tangent,
)


@pytest.fixture(scope="module")
def traces(filmed):
    bases = [filmed.truth["trace"].values[0, view, 0] for view in range(2)]
    return [trace_video(filmed.frames[view], [bases[view] + [2.0, -3.0]])[0] for view in range(2)]


def test_the_trial_touches_and_slips(filmed):
    touching = filmed.truth["status"].values == Status.OK
    assert touching.any()
    assert not touching[-1]


def test_the_middle_is_found_to_a_fraction_of_a_pixel(filmed, traces):
    for view in range(2):
        away = [filmed.errors(t.line, i, view)[0] for i, t in enumerate(traces[view])]
        assert np.median(np.concatenate(away)) < 0.03
        assert np.percentile(np.concatenate(away), 95) < 0.15


def test_no_frame_is_lost_or_wrong(filmed, traces):
    tips = []
    for view in range(2):
        for i, trace in enumerate(traces[view]):
            away, (base, tip) = filmed.errors(trace.line, i, view)
            assert np.median(away) < 0.15
            assert base < 2.0
            tips += [tip] if filmed.tip_shows(i, view) else []
            assert trace.confidence > 0.5
    assert np.median(tips) < 3.0
    assert np.mean(np.array(tips) < 4.0) > 0.9


def test_errors_are_as_large_as_they_say(filmed, traces):
    scaled = []
    for view in range(2):
        for i, trace in enumerate(traces[view]):
            inner = slice(5, len(trace.line) - 5)
            away, _ = filmed.errors(trace.line[inner], i, view)
            scaled.append(away / trace.sigma[inner])
    assert 0.2 < np.median(np.concatenate(scaled)) < 1.5


def test_what_the_peg_hides_is_bridged(filmed, traces):
    hidden = ~filmed.truth["trace_visible"].values[:, 1]
    assert hidden.any()
    for i in np.flatnonzero(hidden.any(axis=1)):
        trace = traces[1][i]
        assert not trace.seen.all()
        away, _ = filmed.errors(trace.line[~trace.seen], i, 1)
        assert away.max() < 1.0


def test_it_is_found_again_after_frames_without_it(filmed):
    frames = list(filmed.frames[0])
    blank = np.full_like(frames[0], 190)
    frames[8] = frames[9] = frames[10] = blank
    (row,) = trace_video(frames, [filmed.truth["trace"].values[0, 0, 0]])
    assert [len(row[i].line) for i in (8, 9, 10)] == [0, 0, 0]
    assert row[9].confidence == 0.0
    for i in (11, 12, 20):
        assert np.median(filmed.errors(row[i].line, i, 0)[0]) < 0.15


def test_one_whisker_is_found_by_itself(filmed):
    for view in range(2):
        found = find_whiskers(filmed.frames[view][0])
        base = filmed.truth["trace"].values[0, view, 0]
        assert found[0].from_face
        assert np.linalg.norm(found[0].trace.line[0] - base) < 2.0
    (row,) = trace_video(filmed.frames[0])
    assert np.median(filmed.errors(row[-1].line, len(row) - 1, 0)[0]) < 0.15


@pytest.mark.parametrize("miss", [(10.0, 8.0), (-10.0, 6.0), (15.0, 0.0)])
def test_a_click_need_not_be_exact(filmed, miss):
    base = filmed.truth["trace"].values[0, 0, 0]
    (row,) = trace_video(filmed.frames[0][:2], [base + miss])
    assert np.linalg.norm(row[0].line[0] - base) < 2.0
    assert np.median(filmed.errors(row[0].line, 0, 0)[0]) < 0.1


def two_lines(shift=0.0, size=(160, 200), seed=0):
    """Two dark lines out of a dark wall, moved down by a shift; their rows at each column."""
    x = np.arange(size[1], dtype=float)
    rows = [60.0 + shift + 0.1 * x, 72.0 + shift + 0.05 * x]
    y = np.arange(size[0])[:, None]
    image = np.full(size, 190.0)
    for row, end in zip(rows, (180, 170), strict=True):
        image -= 120.0 * np.exp(-0.5 * ((y - row) / 1.1) ** 2) * (x < end)
    image[:, :20] = 15.0
    image += np.random.default_rng(seed).normal(0.0, 2.0, size)
    return np.clip(image, 0, 255).astype(np.uint8), rows


def test_two_whiskers_are_told_apart_by_their_bases():
    frames = [two_lines(shift, seed=i)[0] for i, shift in enumerate(np.linspace(0.0, 30.0, 16))]
    traces = trace_video(frames, [(20.0, 62.0), (20.0, 73.0)], TraceOptions(shortest=30.0))
    for i, shift in enumerate(np.linspace(0.0, 30.0, 16)):
        _, rows = two_lines(shift)
        for row, trace in zip(rows, (t[i] for t in traces), strict=True):
            expected = np.interp(trace.line[:, 0], np.arange(200), row)
            assert np.median(np.abs(trace.line[:, 1] - expected)) < 0.1


def test_one_whisker_is_not_two():
    """Started at the same base twice, one of both is lost in every frame."""
    frames = [two_lines(0.0, seed=i)[0] for i in range(3)]
    first, second = trace_video(frames, [(20.0, 62.0), (20.0, 63.0)], TraceOptions(shortest=30.0))
    assert all(bool(len(a.line)) != bool(len(b.line)) for a, b in zip(first, second, strict=True))


def test_corrected_frames_are_taken_and_followed_both_ways():
    """Begun on the wrong whisker, one correction in the middle puts all frames right."""
    shifts = np.linspace(0.0, 20.0, 11)
    frames = [two_lines(shift, seed=i)[0] for i, shift in enumerate(shifts)]
    _, (_, lower) = two_lines(shifts[5])
    points = np.column_stack([[20.0, 90.0, 165.0], lower[[20, 90, 165]]])
    (row,) = trace_video(
        frames, [(20.0, 62.0)], TraceOptions(shortest=30.0), corrections={(5, 0): points}
    )
    np.testing.assert_allclose(row[5].line[0], points[0])
    for i, trace in enumerate(row):
        expected = np.interp(trace.line[:, 0], np.arange(200), two_lines(shifts[i])[1][1])
        assert np.median(np.abs(trace.line[:, 1] - expected)) < 0.1


def test_a_whisker_that_enters_later_is_followed_from_there_both_ways():
    """Next to one whose base is not stated, in a film whose first frames show the wall alone."""
    shifts = np.linspace(0.0, 22.0, 12)
    frames = [two_lines(shift, seed=i)[0] for i, shift in enumerate(shifts)]
    for frame in frames[:3]:
        frame[:, 20:] = 190
    base = (20.0, 62.0 + shifts[6])
    (row,) = trace_video(frames, [base], TraceOptions(shortest=30.0), begins=6)
    assert [len(trace.line) > 0 for trace in row] == [False] * 3 + [True] * 9
    for i in range(3, 12):
        expected = np.interp(row[i].line[:, 0], np.arange(200), two_lines(shifts[i])[1][0])
        assert np.median(np.abs(row[i].line[:, 1] - expected)) < 0.1
    begun = [[Trace.lost()] * 4]
    (again,) = trace_video(frames, [base], TraceOptions(shortest=30.0), begins=6, begun=begun)
    np.testing.assert_array_equal(again[3].line, row[3].line)


@pytest.mark.parametrize("fur", [25.0, 70.0])
def test_a_bright_whisker_begins_where_fur_in_line_with_it_ends(fur):
    """Seen from its tip, the whisker brightens too, but not at once."""
    generator = np.random.default_rng(2)
    y, x = np.mgrid[:120, :300]
    away = np.exp(-0.5 * ((y - 50.0 - 0.05 * x) / 1.2) ** 2)
    streak = fur * (1.0 + 0.4 * np.sin(x / 3.0)) * (x > 50)
    height = np.where(x < 100, streak, np.linspace(200.0, 10.0, 300)) * (x < 280)
    image = 40.0 + away * height + generator.normal(0.0, 2.0, away.shape)
    dark = np.asarray(255 - np.rint(image).astype(np.uint8))
    best = find_curves(dark, Scene.of([dark], 1.0), TraceOptions(bright=True))[0]
    np.testing.assert_allclose(best.line[[0, -1], 0], [100.0, 279.0], atol=4.0)


def test_what_is_done_is_gone_on_with_as_if_it_never_stopped(filmed):
    """Stopped after 15 frames, of which one showed nothing; then with whiskers never seen."""
    frames = [frame.copy() for frame in filmed.frames[0][:25]]
    frames[13][:] = 190
    base = filmed.truth["trace"].values[0, 0, 0]
    (whole,) = trace_video(frames, [base])
    begun = [whole[:15]]
    for bases in ([base], None):
        (again,) = trace_video(frames, bases, begun=begun)
        for a, b in zip(again[:15], whole[:15], strict=True):
            assert a is b
        for a, b in zip(again, whole, strict=True):
            np.testing.assert_allclose(a.line, b.line, atol=1e-3)
    lost = [Trace.lost()] * 15
    found = trace_video(frames, [base, base + 60.0], begun=[whole[:15], lost])
    assert len(found[0][-1].line)
    with pytest.raises(ValueError, match="show no whisker"):
        trace_video(frames, begun=[lost])


def tapered(angle, base=(60.0, 100.0), length=110.0, wide=1.2, wire=None, seed=0, size=200):
    """A tapered line that leaves a dark face to the right, and a still wire across at a column."""
    y, x = np.mgrid[:size, :size].astype(float)
    along = (x - base[0]) * np.cos(angle) + (y - base[1]) * np.sin(angle)
    across = (y - base[1]) * np.cos(angle) - (x - base[0]) * np.sin(angle)
    width = wide * np.clip(1.0 - 0.8 * along / length, 0.05, 1.0)
    grey = 190.0 - 140.0 * ((along > -5.0) & (along < length)) * np.exp(
        -0.5 * (across / width) ** 2
    )
    if wire is not None:
        grey = np.minimum(grey, 190.0 - 130.0 * np.exp(-0.5 * ((x - wire - 0.1 * y) / 1.2) ** 2))
    grey = np.where(x < base[0], 30.0, grey)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, grey.shape)
    return np.clip(np.rint(grey + noise), 0, 255).astype(np.uint8)


def shown_along(trace, angle, base=(60.0, 100.0)):
    """How far its points are from a line, and from where to where they are along it, pixels."""
    away = trace.line - base
    along = away @ [np.cos(angle), np.sin(angle)]
    return np.abs(away @ [-np.sin(angle), np.cos(angle)]).max(), along.min(), along.max()


def test_a_whisker_that_turns_by_20_degrees_a_frame_is_followed():
    angles = np.radians([0.0, 20.0, 0.0, -20.0, 0.0, 20.0])
    frames = [tapered(angle, seed=i) for i, angle in enumerate(angles)]
    (row,) = trace_video(frames, [(60.0, 100.0)])
    for trace, angle in zip(row, angles, strict=True):
        away, first, last = shown_along(trace, angle)
        assert away < 1.0
        assert first < 5.0
        assert last > 80.0


def test_a_still_wire_before_the_face_draws_no_trace_away():
    """It passes the base at ten pixels and hangs on the face as the whisker does."""
    angles = 0.25 * np.sin(np.arange(20.0))
    frames = [tapered(angle, wire=62.0, seed=i) for i, angle in enumerate(angles)]
    (row,) = trace_video(frames, [(60.0, 100.0)])
    for trace, angle in zip(row, angles, strict=True):
        away, first, last = shown_along(trace, angle)
        assert away < 2.0
        assert first < 6.0
        assert last > 80.0


def test_a_whisker_does_not_go_on_along_a_wire_that_begins_at_its_base():
    """It crosses the wire at small angles; there its tip was followed to the wire's end."""
    angles = 0.12 * np.sin(0.7 * np.arange(24.0))
    y, x = np.mgrid[:320, :320]
    wire = np.exp(-0.5 * ((y - 103.0 - 0.04 * (x - 60.0)) / 1.2) ** 2) * (x > 60)
    frames = [
        np.rint(tapered(angle, seed=i, size=320) * (1.0 - 0.25 * wire)).astype(np.uint8)
        for i, angle in enumerate(angles)
    ]
    (row,) = trace_video(frames, [(60.0, 100.0)])
    for trace, angle in zip(row, angles, strict=True):
        away, _, last = shown_along(trace, angle)
        assert away < 4.0
        assert 70.0 < last < 118.0


@pytest.mark.parametrize("turn", [0.01, 0.03])
def test_a_wide_whisker_that_hardly_moves_is_not_divided_out(turn):
    """What it leaves of itself in the background had drawn traces aside by 0.5 to 0.9 pixels."""
    angles = turn * np.sin(np.arange(20.0))
    wide = {"wide": 3.0, "length": 230.0, "size": 320}
    frames = [tapered(angle, seed=i, **wide) for i, angle in enumerate(angles)]
    (row,) = trace_video(frames, [(60.0, 100.0)])
    for trace, angle in zip(row, angles, strict=True):
        assert shown_along(trace, angle)[0] < 0.25


def with_stub(aside, turn, seed):
    """A whisker at a face, and another one next to it, at another angle, that was cut."""
    frame = tapered(0.05, length=170.0, wide=1.3, seed=seed, size=260).astype(float)
    y, x = np.mgrid[:260, :260].astype(float)
    along = (x - 60.0) * np.cos(turn) + (y - 100.0 - aside) * np.sin(turn)
    across = (y - 100.0 - aside) * np.cos(turn) - (x - 60.0) * np.sin(turn)
    stub = 130.0 * ((along > -5.0) & (along < 34.0)) * np.exp(-0.5 * (across / 1.4) ** 2)
    frame = np.where(x < 60.0, frame, np.maximum(frame - stub, 40.0))
    return np.rint(frame).astype(np.uint8)


@pytest.mark.parametrize(
    ("aside", "turn"), [(-6.0, 0.05), (6.0, 0.05), (7.0, -0.1), (-7.0, 0.12), (9.0, -0.15)]
)
def test_a_whisker_begins_neither_on_a_cut_one_nor_where_that_ends(aside, turn):
    """From a line that begins on the cut one as from its own."""
    x = np.arange(60.0, 230.0, 2.0)
    own = np.stack([x, 100.0 + 0.05 * (x - 60.0)], axis=1)
    other = own.copy()
    other[:17, 1] += aside + (turn - 0.05) * (x[:17] - 60.0)
    other[17:25, 1] = np.linspace(other[16, 1], own[25, 1], 10)[1:-1]
    for seed in range(3):
        frame = with_stub(aside, turn, seed)
        for line in (own, other):
            trace, from_face = traced(frame, ridge.noise_level(frame), line, TraceOptions())
            away, first, last = shown_along(trace, 0.05)
            assert from_face
            assert away < 1.5
            assert abs(first) < 2.0
            assert last > 130.0


def still(dark, seed, count=20):
    """A frame of a film, without what stands still in it and makes the ground darker."""
    noise = np.random.default_rng(seed)
    frames = [
        np.clip(np.rint(190.0 * (1.0 - dark(i)) + noise.normal(0.0, 0.5, (200, 200))), 0, 255)
        for i in range(count)
    ]
    frames = [frame.astype(np.uint8) for frame in frames]
    return Scene.of(frames).with_still(np.array([[10.0, 100.0]]), frames).without_still(frames[3])


def test_the_soft_edge_of_a_shadow_is_no_line():
    """Its outer part, left when the rest was divided out, had drawn traces along it."""
    _, x = np.mgrid[:200, :200].astype(float)
    shadow = 0.3 / ((1.0 + np.exp((90.0 - x) / 3.0)) * (1.0 + np.exp((x - 130.0) / 3.0)))
    assert np.ptp(np.median(still(lambda _: shadow, 1), axis=0)) < 0.03 * 190.0


def test_a_wire_that_compression_lets_flicker_is_no_whisker():
    """It had been taken for a whisker that moves by less than its width, and left in the images."""
    y, x = np.mgrid[:200, :200].astype(float)
    wire = 0.4 * np.exp(-0.5 * ((x - 120.0 - 0.1 * y) / 1.3) ** 2)
    frame = still(lambda i: wire * (1.0 + 0.06 * np.sin(2.0 * i)), 2)
    assert np.percentile(frame, 1.0) > 170.0


def test_a_trace_with_a_hook_is_in_doubt():
    s = np.arange(0.0, 120.0, 2.0)
    bend = np.where(s > 90.0, (s - 90.0) / 20.0, 0.0)
    turns = np.stack([np.cos(bend), np.sin(bend)], axis=1)
    hooked = given(np.cumsum(2.0 * turns, axis=0))
    straight = given(np.stack([s, 0.002 * s**2], axis=1))
    assert doubtful_frames([hooked, *[straight] * 9]).tolist() == [True] + 9 * [False]
    assert not doubtful_frames([hooked, *[straight] * 30]).any()


@pytest.mark.parametrize(
    ("dash", "held", "end"), [(8, 0.0, 100.0), (40, 0.0, 210.0), (8, 0.02, 178.0)]
)
def test_a_speck_far_behind_an_object_is_not_the_whisker(dash, held, end):
    """What hides it for long may hide where it ends; a line behind that is its other part.

    If the line is known from another view, so is the speck if it is on it.
    """
    frame = np.full((80, 260), 180.0)
    frame[40, 20:100] = frame[40, 170 : 170 + dash] = 60.0
    rng = np.random.default_rng(0)
    frame = gaussian_filter(frame, 1.0) + rng.normal(0.0, 2.0, frame.shape)
    bits = np.zeros(frame.shape, np.uint32)
    bits[:, 100:170] = 1
    guess = np.stack([np.arange(20.0, 230.0, 2.0), np.full(105, 40.0)], axis=1)
    clutter = Clutter(bits, 1)
    trace, _ = traced(
        frame.astype(np.uint8), 2.0, guess, TraceOptions(), clutter=clutter, held=held
    )
    assert trace.line[-1, 0] == pytest.approx(end, abs=5.0)


def test_saturated_ground_hides_the_noise():
    """A fifth of an image shows it, as bodies, whiskers and wires do."""
    rng = np.random.default_rng(0)
    image = np.full((200, 300), 290.0)
    image[:, :60] = 120.0
    frame = np.clip(image + rng.normal(0.0, 4.0, image.shape), 0, 255).astype(np.uint8)
    assert ridge.noise_level(frame) == pytest.approx(4.0, rel=0.1)
    assert ridge.noise_level(frame[:, 70:]) < 0.5


def test_what_shows_nothing_of_a_whisker_is_lost():
    """Behind something static, and in noise before it: it had become a line of one point."""
    noise = 2.0
    for seed, last, hidden in ((534, 96.0, slice(84, 175)), (627, 142.0, slice(106, 133))):
        rng = np.random.default_rng(seed)
        frame = np.clip(150.0 + rng.normal(0.0, noise, (80, 200)), 0, 255).astype(np.uint8)
        bits = np.zeros(frame.shape, np.uint32)
        bits[:, hidden] = 1
        x = np.arange(40.0, last + 1.0, 2.0)
        guess = np.stack([x, np.full(len(x), 40.0)], axis=1)
        trace, _ = traced(frame, noise, guess, TraceOptions(), clutter=Clutter(bits, 1))
        assert not len(trace.line)


def test_a_whisker_that_rests_is_not_divided_out():
    frames = [tapered(0.1, seed=i) for i in range(20)]
    (row,) = trace_video(frames, [(60.0, 100.0)])
    assert min(trace.support for trace in row) > 80.0


@pytest.mark.parametrize("wide", [0.8, 1.5, 4.0])
def test_a_whisker_begins_at_its_wide_end(wide):
    """Also where it is wider than what lines are smoothed by, which makes its base fainter."""
    frame = tapered(0.2, wide=wide)
    curves = find_curves(frame, Scene.of([frame]), TraceOptions())
    (forward,) = [one for one in curves if one.from_face]
    others = [one.score for one in curves if not one.from_face]
    assert forward.length > 70.0
    assert forward.score > 2.0 * max(others)


@pytest.mark.parametrize("seed", range(4))
def test_where_nothing_is_seen_there_is_no_whisker(seed):
    """A line laid over noise, wherever it is, gives an empty trace and no error."""
    generator = np.random.default_rng(seed)
    frame = np.clip(generator.normal(150.0, 3.0, (80, 80)), 0, 255).astype(np.uint8)
    angle = generator.uniform(0.0, 2.0 * np.pi)
    along = np.arange(0.0, 80.0, 2.0)[:, None] * [np.cos(angle), np.sin(angle)]
    trace, from_face = traced(frame, 3.0, 40.0 + along, TraceOptions())
    assert trace.support < 20.0
    assert not from_face


def test_before_streaked_fur_a_whisker_begins_where_it_does():
    """A line on grey fur, of which streaks go its way; each trace begins from that before it.

    From each frame to the next the fur is a little elsewhere, as the head moves.
    """
    begins = []
    for seed in range(8):
        generator = np.random.default_rng([seed, 91])
        fur = gaussian_filter(generator.standard_normal((160, 420)), (1.0, 2.6))
        fur = 105.0 + 5.0 * fur / fur.std()
        x, row = np.arange(300.0), np.arange(120.0)[:, None]
        depth = 22.0 * np.exp(-0.5 * ((row - 55.0 - 0.05 * x) / 1.1) ** 2) * (x >= 100.0)
        line = np.column_stack([np.arange(100.0, 280.0, 2.0), 60.0 + np.arange(0.0, 9.0, 0.1)])
        for frame in range(12):
            image = fur[10:130, 3 * frame : 3 * frame + 300] - depth
            image = np.round(image + generator.normal(0.0, 2.0, image.shape)).astype(np.uint8)
            line = traced(image, ridge.noise_level(image), line, TraceOptions())[0].line
            begins.append(line[0, 0])
    assert np.median(np.abs(np.array(begins) - 100.0)) < 1.0
    assert np.mean(np.abs(np.array(begins) - 100.0) < 6.0) > 0.7


def test_progress_and_faults():
    told = []
    frames = [two_lines()[0]] * 3
    trace_video(frames, [(20.0, 62.0)], progress=told.append)
    assert told == [1, 2, 3]
    with pytest.raises(ValueError, match="no whisker was found"):
        trace_video([np.full((80, 80), 120, np.uint8)])
    with pytest.raises(ValueError, match="a column and a row"):
        trace_video(frames, [(1.0, 2.0, 3.0)])
    with pytest.raises(ValueError, match=r"whiskers \[1\]"):
        trace_video(frames, [(20.0, 62.0)], corrections={(0, 1): [[0, 0], [1, 1]]})
    with pytest.raises(ValueError, match="n ≥ 2, are needed"):
        trace_video(frames, [(20.0, 62.0)], corrections={(0, 0): [[0, 0]]})
    with pytest.raises(ValueError, match=r"turns back at \(40.0, 60.0\)"):
        trace_video(frames, [(20.0, 62.0)], corrections={(0, 0): [[20, 62], [40, 60], [30, 61]]})


@pytest.mark.parametrize("sigma", [1.0, 2.5, 6.0])
def test_noise_is_estimated(sigma):
    generator = np.random.default_rng(0)
    slope = np.linspace(60.0, 190.0, 300)
    image = slope + generator.normal(0.0, sigma, (300, 300))
    assert ridge.noise_level(np.clip(image, 0, 255).astype(np.uint8)) == pytest.approx(
        sigma, rel=0.1
    )


def test_smoothing_keeps_parabolas_and_bridges_gaps():
    """Against the dense normal equations; columns are smoothed alike."""
    x = np.linspace(0.0, 1.0, 80)
    y = 3.0 + 2.0 * x - 5.0 * x**2
    weight = np.ones(80)
    weight[30:45] = 0.0
    line = np.stack([y, 2.0 * y], axis=1)
    np.testing.assert_allclose(ridge.smooth(line, weight, 1e4), line, atol=1e-3)
    dense = np.diff(np.eye(80), n=3, axis=0)
    noisy = line + np.random.default_rng(1).normal(size=(80, 2))
    matrix = np.diag(weight + 1e-6) + 1e4 * dense.T @ dense
    expected = np.linalg.solve(matrix, weight[:, None] * (noisy - noisy[0])) + noisy[0]
    np.testing.assert_allclose(ridge.smooth(noisy, weight, 1e4), expected, rtol=1e-6)


@pytest.mark.parametrize("start", [0.0, -7.0, 3.3])
def test_points_a_step_apart_are_those_of_linear_interpolation(start):
    line = np.cumsum(np.random.default_rng(1).normal(1.0, 0.6, (40, 2)), axis=0)
    s = arc_lengths(line)
    at = np.arange(start, s[-1], STEP)
    first = line[0] + np.outer(at, line[4] - line[0]) / s[4]
    expected = np.where(at[:, None] < 0.0, first, interpolated(at, s, line))
    np.testing.assert_allclose(even(line, start), expected, atol=1e-12)
    # A line of whole steps keeps its last point, despite rounding.
    straight = np.outer(np.arange(0.0, 30.1, 0.1), [0.6, 0.8])
    assert len(even(straight)) == 16
    np.testing.assert_array_equal(even(line[:1]), line[:1])
    np.testing.assert_allclose(tangent(line), np.gradient(line, axis=0), atol=1e-14)
