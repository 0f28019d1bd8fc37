"""Videos that look otherwise: bright whiskers, no face, tips not seen, views that differ."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from vibrissa import Whisker
from vibrissa.simulation import ImageConditions, film_frames
from vibrissa.tracking import (
    Trace,
    TraceOptions,
    TraceSeries,
    find_start,
    is_bright,
    trace_video,
    track,
)
from vibrissa.tracking.recording import remarks_on
from vibrissa.tracking.refine.fit import _lit
from vibrissa.tracking.refine.problem import _LENGTHS, _correlation, trace_variance
from vibrissa.tracking.space.frame_pairs import clear_offsets
from vibrissa.tracking.space.rest_shape import (
    Length,
    RestShape,
    lengthened,
    likeliest_length,
    likeliest_taper,
    seen_length,
)
from vibrissa.tracking.trace.scene import Scene
from vibrissa.tracking.trace.steady import Steady
from vibrissa.tracking.trace.trace import given


def image(begin, end, fade=0.0, noise=2.0, seed=0, size=(120, 200)):
    """One dark line from column to column, on light ground, without a face."""
    x, y = np.arange(size[1], dtype=float), np.arange(size[0])[:, None]
    share = 1.0 - fade * np.clip((x - begin) / (end - begin), 0.0, 1.0)
    dark = 120.0 * share * np.exp(-0.5 * ((y - 50.0 - 0.1 * x) / 1.1) ** 2)
    picture = 190.0 - dark * ((x >= begin) & (x < end))
    picture += np.random.default_rng(seed).normal(0.0, noise, size)
    return np.clip(picture, 0, 255).astype(np.uint8)


def test_without_a_face_a_whisker_begins_where_its_line_does():
    frames = [image(30 + i, 170, seed=i) for i in range(4)]
    (row,) = trace_video(frames, [(30.0, 53.0)], TraceOptions(shortest=30.0))
    for i, trace in enumerate(row):
        assert trace.line[0, 0] == pytest.approx(30.0 + i, abs=2.0)
        assert trace.line[-1, 0] == pytest.approx(170.0, abs=2.5)
        assert trace.base_seen
        assert trace.tip_seen


@pytest.mark.parametrize(
    ("picture", "base", "tip"),
    [
        (image(30, 170), True, True),
        (image(30, 200), True, False),
        (image(-5, 170), False, True),
        (image(30, 170, fade=1.0, noise=9.0), True, False),
        (image(30, 170, fade=0.85, noise=16.0), True, True),
    ],
    ids=["whole", "out at the tip", "out at the base", "fading", "no darker than noise"],
)
def test_an_end_that_is_not_seen_is_told(picture, base, tip):
    ((trace,),) = trace_video([picture], [(30.0 if base else 3.0, 53.0)])
    assert (trace.base_seen, trace.tip_seen) == (base, tip)


def test_a_base_that_is_seen_now_here_now_there_loses_no_whisker():
    """Blocks of compression move the edge of the face along the whisker, which moves across."""
    begins = [30, 37, 30, 30, 37, 37, 30, 37]
    frames = [np.roll(image(begin, 170, seed=i), 3 * i, axis=0) for i, begin in enumerate(begins)]
    (row,) = trace_video(frames, [(30.0, 53.0)], TraceOptions(shortest=30.0))
    for i, (trace, begin) in enumerate(zip(row, begins, strict=True)):
        assert trace.line[0] == pytest.approx([begin, 50.0 + 0.1 * begin + 3 * i], abs=2.0)


def test_nothing_is_traced_without_light():
    """In frames 8 and 9 the lamp is off; the whisker is found again after them."""
    frames = [image(30, 170, seed=i) for i in range(20)]
    for i in (8, 9):
        frames[i] = np.asarray(frames[i] * 0.1 + 2.0, dtype=np.uint8)
    (row,) = trace_video(frames, [(30.0, 53.0)], TraceOptions(shortest=30.0))
    assert [i for i, trace in enumerate(row) if not len(trace.line)] == [8, 9]


def test_overexposed_ground_may_be_searched_for_bright_whiskers():
    """Its negative is black, by which nothing can be divided."""
    frames = [image(30 + i, 170, seed=i) for i in range(20)]
    frames = [np.where(frame > 140, 0, 255 - frame).astype(np.uint8) for frame in frames]
    scene = Scene.of(frames).with_still(np.array([[30.0, 53.0]]), frames)
    assert np.median(scene.background) == 0.0
    assert np.isfinite(scene.still.factor).all()


def test_wires_are_removed_though_the_lamp_is_off_in_a_third_of_the_frames():
    """Dark frames do not show that nothing stands there."""
    random = np.random.default_rng(0)
    empty = np.full((240, 320), 200.0)
    empty[:, 100:104] = 120.0
    frames = [empty + random.normal(0.0, 2.0, empty.shape) for _ in range(30)]
    for frame in frames[:20:2]:
        frame[:] = 0.0
    taken = [frame.astype(np.uint8) for frame in frames]
    scene = Scene.of(taken).with_still(np.array([[50.0, 120.0]]), taken)
    assert scene.without_still(taken[3])[50:190, 100:104].mean() == pytest.approx(200.0, abs=3.0)


def test_halos_of_whiskers_do_not_join_a_peg_to_the_face():
    """Side light makes one side of each whisker bright: what they sweep seems to be uneven."""
    random = np.random.default_rng(0)
    rows, columns = np.mgrid[:200, :300]
    empty = np.where(columns < 50, 30.0, 170.0)
    empty[(np.abs(rows - 60) < 10) & (columns > 85)] = 50.0
    before = (columns > 50) & (columns < 250) & (empty > 100.0)
    bases = np.array([[52.0, row] for row in (80.0, 95.0, 110.0, 125.0)])
    frames = []
    for _ in range(30):
        picture = empty + random.normal(0.0, 4.0, empty.shape)
        for (_, row), slope in zip(bases, random.uniform(-0.5, 0.3, len(bases)), strict=True):
            away = (rows - row - slope * (columns - 50)) / np.hypot(1.0, slope) / 1.2
            dark, halo = np.exp(-0.5 * away**2), np.exp(-0.5 * (away - 3.0) ** 2)
            picture -= before * (80.0 * dark - 48.0 * halo)
        frames.append(np.clip(picture, 0, 255).astype(np.uint8))
    scene = Scene.of(frames).with_still(bases, frames)
    peg = scene.without_still(frames[3])[55:65, 150:280]
    assert peg.mean() == pytest.approx(170.0, abs=8.0)


def test_bright_whiskers_are_traced_as_dark_ones(filmed):
    frames = filmed.frames[0][:2]
    negative = [np.asarray(255 - frame) for frame in frames]
    assert is_bright(negative[:1])
    assert not is_bright(frames[:1])
    for one, other in zip(trace_video(frames)[0], trace_video(negative)[0], strict=True):
        np.testing.assert_array_equal(one.line, other.line)


def test_views_together_decide_whether_whiskers_are_bright():
    """A view with a dark line at the base, as next to a peg with stripes, is not asked alone."""
    line = 190.0 - image(30, 170)
    striped = 100.0 - 0.4 * line + 0.3 * np.roll(line, 10, axis=0)
    both = [np.clip(one, 0, 255).astype(np.uint8) for one in (60.0 + line, striped)]
    base = [(30.0, 53.0)]
    assert not is_bright(both[1:], [base])
    assert is_bright(both, [base, base])


def test_one_glint_next_to_several_bases_makes_their_whiskers_not_bright():
    """It is sharper than any of the whiskers, and as near to their bases."""
    x, y = np.arange(200.0), np.arange(120.0)[:, None]
    bases = [(30.0, row) for row in (40.0, 48.0, 56.0, 64.0)]
    picture = 120.0 - 40.0 * sum(
        np.exp(-0.5 * ((y - row - (row - 52.0) * (x - 30.0) / 90.0) / 1.1) ** 2) for _, row in bases
    ) * ((x > 30.0) & (x < 110.0))
    picture += 100.0 * np.exp(-0.5 * ((y - 52.0) / 1.1) ** 2) * (x > 30.0)
    noisy = picture + np.random.default_rng(0).normal(0.0, 2.0, picture.shape)
    frame = np.clip(noisy, 0, 255).astype(np.uint8)
    assert not is_bright([frame], [bases])
    assert is_bright([frame], [[(30.0, 52.0)]])


def test_views_together_say_where_the_whisker_begins(filmed):
    frames = [view[0] for view in filmed.frames]
    bases = find_start(filmed.cameras, [[frame] for frame in frames]).bases
    for view, base in enumerate(bases):
        assert np.linalg.norm(base - filmed.truth["trace"].values[0, view, 0]) < 2.0
    # The same columns are the same x: moved sideways nothing fits.
    apart = [[frames[0]], [np.roll(frames[1], 40, axis=1)]]
    assert find_start(filmed.cameras, apart).bases is None


def past_a_peg(away, grey, seed):
    """A straight line before the edge of a peg with a dark stripe, so far from it, and its row."""
    x, y = np.arange(240.0), np.arange(140.0)[:, None]
    line = 70.0 - away
    whisker = 0.4 * np.exp(-0.5 * ((y - line) / 1.1) ** 2) * (x >= 20.0)
    inward = 22.0 - np.hypot(x - 150.0, y - 92.0)
    peg = 1.0 / (1.0 + np.exp(np.clip(-3.0 * inward, -40.0, 40.0)))
    body = grey * (1.0 - 0.8 * np.exp(-0.5 * ((inward - 4.0) / 1.2) ** 2))
    picture = (190.0 * (1.0 - peg) + body * peg) * (1.0 - whisker)
    picture += np.random.default_rng(seed).normal(0.0, 2.0, picture.shape)
    return np.clip(picture, 0, 255).astype(np.uint8), line


@pytest.mark.parametrize(("grey", "at"), [(25.0, 1.0), (130.0, -1.5)], ids=["dark", "shiny"])
def test_the_edge_of_what_never_moves_draws_no_trace_aside(grey, at):
    away = [*np.linspace(16.0, at, 15), *[at] * 15, *np.linspace(at, 16.0, 10)]
    frames, lines = zip(*(past_a_peg(a, grey, i) for i, a in enumerate(away)), strict=True)
    (row,) = trace_video(list(frames), [(20.0, lines[0])], TraceOptions(shortest=60.0))
    for trace, line in zip(row, lines, strict=True):
        beside = np.abs(trace.line[:, 0] - 150.0) < 20.0
        assert beside.sum() > 15
        assert np.abs(trace.line[beside, 1] - line).max() < 0.4
    # Where whisker and edge coincide the trace is less certain than elsewhere.
    sigma = row[20].sigma
    near, far = (np.abs(row[20].line[:, 0] - at) < 10.0 for at in (150.0, 70.0))
    assert sigma[near].max() > 1.5 * sigma[far].max()


@pytest.mark.parametrize("side", [0.0, 0.6])
def test_a_lit_flank_is_seen(filmed, side):
    """It draws a trace to the other side; no fit shows that, but the skew of the profile does."""
    conditions = ImageConditions(side_light=side)
    frames = list(film_frames(filmed.recording, filmed.cameras[0], conditions))[:3]
    (row,) = trace_video(frames, [filmed.curve(0, 0)[0]])
    error = [np.median(filmed.errors(one.line, i, 0)[0]) for i, one in enumerate(row)]
    skew = abs(np.median([one.skew for one in row]))
    assert (skew > 0.2 and np.median(error) > 0.1) if side else skew < 0.05
    # A flank that is lit in the image beyond the whisker shifts its thin outer part as well.
    outer = [filmed.errors(one.line[-20:], i, 0)[0] for i, one in enumerate(row)]
    problem = SimpleNamespace(
        traces=SimpleNamespace(skew=np.array([[one.skew] for one in row])),
        whisker=Whisker.parabola(length=10e-3, coefficient=15.0),
        head=SimpleNamespace(put_in=lambda points: points),
        start=SimpleNamespace(position=np.zeros((1, 3))),
        d=SimpleNamespace(length=10e-3),
        cameras=filmed.cameras,
    )
    halo = _lit(problem, 0)[1]
    assert (np.median(outer) < 2.5 * halo < 4.0 * np.median(outer)) if side else halo == 0.0


def test_frames_of_another_size_are_refused():
    with pytest.raises(ValueError, match="frame 1 has 100 × 120 pixels"):
        trace_video([image(30, 170), image(30, 170)[:, :100]], [(30.0, 53.0)])


def test_a_length_is_found_where_it_costs_least():
    def cost(length):
        return 7.0 + ((length - 33e-3) / 0.4e-3) ** 2

    found = likeliest_length(30e-3, cost)
    assert found.value == pytest.approx(33e-3, rel=1e-3)
    # Bending shows the inverse of the length.
    assert found.sigma == pytest.approx(np.hypot(0.4e-3, 0.025 * 33e-3**2 / 30e-3), rel=0.01)
    # What is cheapest if shorter than what is seen is hardly longer than what is seen.
    assert likeliest_length(34e-3, cost).value == pytest.approx(34e-3, abs=0.2e-3)
    # It may be far longer than what is seen, or anything.
    far = likeliest_length(20e-3, lambda length: ((20e-3 / length - 0.5) / 0.02) ** 2)
    assert far.value == pytest.approx(40e-3, rel=0.02)
    unknown = likeliest_length(30e-3, lambda length: 0.0)
    assert unknown.value > 33e-3
    assert unknown.value - 2.0 * unknown.sigma < 30e-3


def test_a_length_of_which_only_the_least_is_known_is_among_the_likely_ones():
    """Of a long whisker bends no longer show how long it is, but that it is not short."""
    found = likeliest_length(20e-3, lambda length: 140.0 * np.exp((20e-3 - length) / 1.5e-3))
    assert found.value - 2.0 * found.sigma < 24e-3 < found.value < found.value + found.sigma < 60e-3
    assert found.sigma > 4e-3


def test_a_taper_is_what_bending_and_what_is_usual_show():
    found, sigma = likeliest_taper(0.025, -0.04, lambda share: ((share - 0.05) / 0.004) ** 2)
    shown = 0.025**2 / (0.025**2 + 0.004**2 + 0.014**2)
    assert found == pytest.approx(0.05 * shown, rel=0.02)
    assert sigma == pytest.approx(0.025 * np.sqrt(1.0 - shown), rel=0.02)
    # What bending does not show stays as it is usual.
    found, sigma = likeliest_taper(0.025, -0.04, lambda share: 3.0)
    assert abs(found) < 0.1 * 0.025
    assert sigma == pytest.approx(0.025, rel=0.1)
    assert likeliest_taper(0.025, -0.04, lambda share: 1e4 * (share + 0.5))[0] >= -0.04


def test_a_shape_goes_on_as_it_bends():
    s = np.linspace(0.0, 20e-3, 101)
    curve = 0.05 * np.stack([np.sin(s / 0.05), 1.0 - np.cos(s / 0.05), 0.0 * s], axis=1)
    shape = RestShape(curve[:81], np.ones(3, bool), np.zeros(3), 0.0)
    longer = lengthened(shape, 20e-3)
    assert longer.length == pytest.approx(20e-3, rel=2e-3)
    assert np.abs(longer.points - curve).max() < 20e-6
    # By less than the distance of its points, too.
    assert lengthened(shape, 16.1e-3).length == pytest.approx(16.1e-3, rel=1e-4)


def test_a_length_is_as_uncertain_as_what_tapers():
    """A tip that is seen does not show how thick the whisker is before it."""
    s = np.linspace(0.0, 20e-3, 33)
    lines = 10e3 * np.stack([s, 0.0 * s], axis=1) * np.ones((5, 1, 1, 1))
    lengths = np.full(5, 20e-3)
    assert seen_length(lengths, lines).sigma == pytest.approx(0.7 / 10e3)
    assumed = seen_length(lengths, lines, tapers=False)
    assert assumed.sigma == pytest.approx(np.hypot(0.7 / 10e3, 0.5e-3))


def test_traces_are_trusted_as_far_as_their_residuals_allow():
    """Residuals of known variance and correlation, and a frame that fits badly."""
    generator = np.random.default_rng(0)
    noise, share = generator.normal(size=(200, 48)), 0.6
    for k in range(1, 48):
        noise[:, k] = share * noise[:, k - 1] + np.sqrt(1.0 - share**2) * noise[:, k]
    together = (1.0 + share) / (1.0 - share)
    none, still = [np.zeros((200, 48, 1))], np.zeros((200, 1, 1))
    (found,) = trace_variance([2.0 * noise], none, still, 0.04)
    assert np.median(found) == pytest.approx(4.0 * together, rel=0.25)
    noise[7] *= 10.0
    (worse,) = trace_variance([2.0 * noise], none, still, 0.04)
    assert (worse[7] > 10.0 * np.median(found)).all()
    # Where they are smaller than was claimed, that counts as well, to a limit.
    (finer,) = trace_variance([0.3 * noise[8:]], [none[0][8:]], still[8:], 0.04)
    assert np.median(finer) == pytest.approx(0.09 * together, rel=0.25)
    (least,) = trace_variance([0.01 * noise[:5]], [none[0][:5]], still[:5], 0.04)
    assert (least > 1e-3).all()


def test_errors_that_the_fit_follows_count_too():
    """Errors that are alike over a tenth of the whisker; the fit follows most of them."""
    generator, share = np.random.default_rng(1), np.exp(-1.0 / 4.0)
    noise = generator.normal(size=(200, 48))
    for k in range(1, 48):
        noise[:, k] = share * noise[:, k - 1] + np.sqrt(1.0 - share**2) * noise[:, k]
    basis = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, 48), 7))[0]
    left = noise - noise @ basis @ basis.T
    designs, covariance = (
        np.broadcast_to(basis, (200, 48, 7)),
        np.broadcast_to(np.eye(7), (200, 7, 7)),
    )
    (found,) = trace_variance([left], [designs], covariance, 0.04, even=True)
    assert np.median(found) == pytest.approx((1.0 + share) / (1.0 - share), rel=0.3)


def test_what_the_fit_leaves_is_that_of_the_whole_matrices():
    """The length of correlation whose R V Rᵀ, written out, is most like the residuals."""
    generator = np.random.default_rng(2)
    designs, miss = generator.normal(size=(2, 30, 24, 6)), generator.normal(size=(30, 48))
    miss[generator.random(miss.shape) < 0.1] = 0.0
    design = np.concatenate(designs, axis=1) * (miss != 0.0)[:, :, None]
    covariance = np.linalg.inv(np.swapaxes(design, 1, 2) @ design)
    found = _correlation(miss, np.arange(30), (design @ covariance, design), 2)
    known = (miss != 0.0)[:, :, None] * np.eye(48)
    remains = known - design @ covariance @ np.swapaxes(design, 1, 2)
    apart = np.abs(np.subtract.outer(np.arange(24), np.arange(24)))

    def lagged(moments):
        return np.array(
            [
                sum(np.trace(moments[v : v + 24, v : v + 24], lag) for v in (0, 24))
                for lag in range(13)
            ]
        )

    shown, best = lagged(miss.T @ miss), []
    for length in _LENGTHS:
        errors = np.kron(np.eye(2), np.exp(-apart / length))
        moments = lagged((remains @ errors @ np.swapaxes(remains, 1, 2)).sum(axis=0))
        differs = ((shown / shown[0] - moments / moments[0]) ** 2).sum()
        best.append((differs, 1.0 / np.tanh(0.5 / length), moments[0] / (miss != 0.0).sum()))
    assert found == pytest.approx(min(best)[1:], rel=1e-12)


def test_parts_of_a_whisker_are_trusted_as_far_as_their_residuals_allow():
    """The last quarter of one view scatters three times as much as all else."""
    noise = np.random.default_rng(0).normal(size=(2, 100, 48))
    noise[1, :, 36:] *= 3.0
    none, still = [np.zeros((100, 48, 1))] * 2, np.zeros((100, 1, 1))
    first, second = trace_variance(list(noise), none, still, 0.04)
    for view, points, expected in ((first, slice(0, 48), 1.0), (second, slice(0, 34), 1.0)):
        assert np.median(view[:, points]) == pytest.approx(expected, rel=0.25)
    assert np.median(second[:, 38:48]) == pytest.approx(9.0, rel=0.25)
    same = trace_variance(list(noise), none, still, 0.04, even=True)
    assert all(np.ptp(view, axis=1).max() == 0.0 for view in same)


def test_frames_that_the_rod_does_not_explain_are_noted(filmed):
    nothing = np.full((20, 2, 101, 2), np.nan)
    numbers = (np.zeros((20, *shape)) for shape in ((2,), (2, 2), (2,), (2, 4), (2,)))
    series = TraceSeries(nothing, *[nothing[..., 0]] * 2, *numbers)
    misfit = np.where(np.arange(20) < 3, 5.0, 0.3)
    length = Length(10e-3, 0.0)
    (said,) = remarks_on(filmed.cameras, series, length, misfit, "C2")
    assert said.startswith("C2: in 3 frames the bent rod does not explain")
    assert remarks_on(filmed.cameras, series, length, np.full(20, 0.3), "C2") == []


def test_cameras_out_of_step_are_noticed(filmed, traced):
    rows = [view[0] for view in traced]
    assert not clear_offsets(*filmed.cameras, *rows).shifts.any()
    assert (clear_offsets(*filmed.cameras, rows[0], rows[1][3:], 0).shifts == -3).all()


def test_a_base_that_begins_elsewhere_for_a_while_is_no_offset(filmed):
    """Hairs cover it, twice in one view and three times in the other, one after another."""
    rows = []
    for begins in ((8, 58), (20, 70, 95)):
        column = np.full(118, 100.0)
        for begin in begins:
            column[begin : begin + 11] -= 2.0
        lines = [np.column_stack([c + np.arange(5.0), np.full(5, 90.0)]) for c in column]
        shape = np.full(5, 0.1), np.ones(5, dtype=bool)
        rows.append([Trace(line, *shape, 1.0, tip_seen=False) for line in lines])
    assert not clear_offsets(*filmed.cameras, *rows, 0).shifts.any()


@pytest.fixture(scope="module")
def shaken(filmed):
    """Traces of the trial by cameras that shake, each by itself, and by how much they do."""
    shifts = 0.3 * np.random.default_rng(1).normal(size=(2, len(filmed.frames[0]), 2))
    rows = []
    for frames, shift in zip(filmed.frames, shifts, strict=True):
        moved = [
            ndimage.shift(frame.astype(float), d[::-1], mode="nearest").clip(0, 255).astype("uint8")
            for frame, d in zip(frames, shift, strict=True)
        ]
        rows.append(trace_video(moved))
    return rows, shifts


def test_a_camera_that_shakes_is_held_still(filmed, traced, shaken):
    """The front view's only still edge is upright: what shifts it along that is not known."""
    (top,), (front,) = shaken[0]
    away = np.array([trace.shift for trace in top])[:, :2] - shaken[1][0]
    assert np.sqrt((away**2).mean(axis=0)).max() < 0.06
    assert max(top[0].shift[2:]) < 0.1
    assert front[0].shift[2] < 0.1 < 0.2 < front[0].shift[3]
    off = [np.median(filmed.errors(one.line, i, 0)[0]) for i, one in enumerate(top)]
    assert np.median(off) < 0.06 < 0.1 < np.median(np.abs(shaken[1]))
    assert not any(any(trace.shift[:2]) for (row,) in traced for trace in row)


@pytest.mark.parametrize("known", [pytest.param(True, marks=pytest.mark.slow), False])
def test_what_is_not_known_of_shaking_is_in_covariances(filmed, shaken, known):
    traces = shaken[0]
    if not known:
        nothing = (0.0, 0.0, np.nan, np.nan)
        traces = [traces[0], [[trace._replace(shift=nothing) for trace in traces[1][0]]]]
    found = track(filmed.cameras, traces, 1000.0)
    assert "top shakes by 0.2" in found.attrs["remarks"]
    assert ("front shakes by 0.3" in found.attrs["remarks"]) is known
    assert ("it is unknown whether front shakes" in found.attrs["remarks"]) is not known
    away = found["contact_point"].values[:, 0] - filmed.truth["contact_point"].values
    spread = found["contact_covariance"].values[:, 0]
    rows = np.isfinite(away).all(axis=1) & np.isfinite(spread).all(axis=(1, 2))
    chi = np.einsum("ti,tij,tj->t", away[rows], np.linalg.inv(spread[rows]), away[rows])
    assert rows.sum() > 15
    assert (chi < 7.8).mean() > 0.85


def test_dirt_on_the_sensor_does_not_hide_that_a_camera_shakes():
    """It stands still in the images, unlike all else that does not move."""
    random = np.random.default_rng(3)
    y, x = np.mgrid[0:200, 0:240].astype(float)
    spots = [(30, 150), (60, 170), (100, 40), (210, 150), (150, 180), (200, 20)]
    dirt = 1.0 - 0.2 * sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / 18.0) for a, b in spots)
    shifts = 0.4 * random.normal(size=(30, 2))
    shifts -= shifts.mean(axis=0)
    frames = []
    for i, (right, down) in enumerate(shifts):
        u, v = x - right, y - down
        peg = 0.8 / (1.0 + np.exp((np.hypot(u - 170.0, v - 60.0) - 12.0) / 0.7))
        whisker = 0.6 * np.exp(-((v - 60.0 - 3.0 * i - 0.2 * u) ** 2) / 3.0) * (u < 120.0)
        grey = 190.0 * (1.0 - np.maximum(peg, whisker)) * dirt + random.normal(0.0, 2.0, x.shape)
        frames.append(grey.clip(0, 255).round().astype(np.uint8))
    steady = Steady.of(Scene.of(frames).with_still(np.array([[0.0, 60.0]]), frames), frames)
    found = np.array([steady.moved_back(frame)[1] for frame in frames])
    assert np.abs(found[:, :2] - shifts).max() < 0.05
    assert found[:, 2:].max() < 0.05


def test_bands_of_a_rolling_shutter_are_no_shaking():
    """A lamp on alternating current: where a peg ends, it is brighter than at its sides."""
    random, (y, x) = np.random.default_rng(4), np.mgrid[0:300, 0:240].astype(float)
    frames = []
    for i in range(30):
        peg = 0.8 / (1.0 + np.exp((np.abs(x - 150.0 - 0.05 * y) - 14.0) / 0.6))
        peg /= 1.0 + np.exp((80.0 - y) / 0.6)
        whisker = 0.6 * np.exp(-((y - 60.0 - 2.0 * i - 0.2 * x) ** 2) / 3.0) * (x < 120.0)
        lamp = 1.0 + 0.3 * np.sin(2.6 * i + 5.6 * y / 300.0)
        grey = 170.0 * lamp * (1.0 - np.maximum(peg, whisker))
        frames.append((grey + random.normal(0.0, 1.0, x.shape)).clip(0, 255).astype(np.uint8))
    steady = Steady.of(Scene.of(frames).with_still(np.array([[0.0, 60.0]]), frames), frames)
    assert steady is None or not any(any(steady.moved_back(f)[1][:2]) for f in frames)


def test_a_camera_that_was_moved_may_have_been_calibrated_before_or_after(filmed, traced):
    """Half-way through the film it moves by a pixel: all is half a pixel off, and said to be."""
    half, moved = len(traced[0][0]) // 2, []
    for (row,) in traced:
        sides = np.where(np.arange(len(row)) < half, -0.5, 0.5)
        moved.append(
            [
                [
                    one._replace(line=one.line + 0.5, shift=(side, side, 0.03, 0.03))
                    for one, side in zip(row, sides, strict=True)
                ]
            ]
        )
    found = track(filmed.cameras, moved, 1000.0)
    assert "Part of this is slow, or a step, of 1.0 pixels" in found.attrs["remarks"]
    away = found["contact_point"].values[:, 0] - filmed.truth["contact_point"].values
    spread, shared = (found[f"contact_{name}"].values[:, 0] for name in ("covariance", "shared"))
    rows = np.isfinite(away).all(axis=1) & np.isfinite(spread).all(axis=(1, 2))
    chi = np.einsum("ti,tij,tj->t", away[rows], np.linalg.inv(spread[rows]), away[rows])
    assert (chi < 7.8).mean() > 0.9
    alone = spread[rows] - np.einsum("tei,tej->tij", shared[rows], shared[rows])
    assert (np.linalg.eigvalsh(alone) > -1e-15).all()


def test_a_trace_ends_where_it_goes_on_along_a_static_edge():
    """The edge of a thick rod; a whisker that crosses it, or that rests all the time, is kept."""
    row, column = np.mgrid[:200, :300]
    rod = (row > 90) & (row < 125) & (column > 100)
    rest = np.abs(row - 150) < 2
    frame = np.where(rod, 60, np.where(rest, 90, 180)).astype(np.uint8)
    scene = Scene.of([frame] * 8)

    def left(points):
        return len(scene.before_edge(given(points)).line)

    along = [[20.0, 40.0], [110.0, 88.0], [125.0, 90.0], [290.0, 90.0]]
    assert 30 < left(along) < 65
    across = given([[20.0, 40.0], [290.0, 184.0]])
    assert left(across.line) == len(across.line)
    resting = given([[10.0, 150.0], [290.0, 150.0]])
    assert left(resting.line) == len(resting.line)
    assert not scene.before_edge(given(along)).tip_seen
