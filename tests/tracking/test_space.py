"""From two views to space: matching, uncertainty, timing, filtering."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vibrissa.cameras import Camera, orthogonal_views
from vibrissa.tracking import Trace, low_pass, merge, paired_frames, usual_cutoff
from vibrissa.tracking.recording import remarks_on_time
from vibrissa.tracking.refine import continuation
from vibrissa.tracking.space.curve import begun_together, merged, shown_by_one
from vibrissa.tracking.space.exchange import Known, exchanged
from vibrissa.tracking.space.frame_pairs import clear_offsets, dropped_frames
from vibrissa.tracking.space.frame_steps import repeated_frames, without_repeats
from vibrissa.tracking.space.pose import base_pose, rolled_over
from vibrissa.tracking.space.rest_shape import RestShape, whisker_at_rest
from vibrissa.tracking.trace.start import base_gap
from vibrissa.tracking.trace.trace import even
from vibrissa.whisker import base_rotation

LENGTH = 30e-3


def curve(azimuth, bend=12.0, count=200):
    """A whisker in space that bends up and forward, m."""
    s = np.linspace(0.0, LENGTH, count)
    flat = np.stack([s, bend * s**2, 0.6 * bend * s**2 * s / LENGTH], axis=1)
    return flat @ Rotation.from_euler("z", azimuth).as_matrix().T


def perspective_pair():
    views = []
    for name, turn in (("left", [0.2, 0.4, 0.0]), ("right", [1.4, 0.1, 0.2])):
        matrix = [[6000.0, 0.0, 511.5], [0.0, 6000.0, 511.5], [0.0, 0.0, 1.0]]
        rotation = Rotation.from_rotvec(turn).as_matrix()
        views.append(Camera(matrix, rotation, [-0.01, 0.0, 0.35], [-0.1, 0.05], name=name))
    return tuple(views)


def traced(camera, points, generator=None, noise=0.03):
    line = even(camera.project(points))
    if generator is not None:
        line = line + generator.normal(0.0, noise, line.shape)
    n = len(line)
    return Trace(line, np.full(n, noise), np.ones(n, dtype=bool), 1.0)


@pytest.mark.parametrize("points", [15, 40])
def test_views_begin_where_both_show_the_whisker(points):
    """Hairs hide the base in one view, two pixels a point; the other shows it from there."""
    cameras = PAIRS["orthogonal"]
    rows = [[traced(camera, curve(0.1 * i)) for i in range(3)] for camera in cameras]
    hidden = [
        Trace(t.line[points:], t.sigma[points:], t.seen[points:], t.confidence) for t in rows[0]
    ]
    for shown in (begun_together(cameras, [hidden, rows[1]]), begun_together(cameras, rows)):
        for both in zip(*shown, strict=True):
            assert base_gap(cameras, np.stack([trace.line[0] for trace in both])) < 2.0
    assert all(a is b for a, b in zip(rows[1], shown[1], strict=True))
    true = [curve.length for curve in merged(cameras, zip(*rows, strict=True))]
    begun = begun_together(cameras, [hidden, rows[1]])
    left = [curve.length for curve in merged(cameras, zip(*begun, strict=True))]
    more = shown_by_one(cameras, [hidden, rows[1]], begun)
    assert more.more == pytest.approx(float(np.median(np.subtract(true, left))), abs=1e-4)
    assert shown_by_one(cameras, rows, rows).before(0.0) == 0.0
    other = [traced(cameras[1], curve(0.1 * i) + np.array([0.0, 0.0, 8e-3])) for i in range(3)]
    elsewhere = begun_together(cameras, [rows[0], [farther(trace) for trace in other]])
    assert [len(trace.line) for trace in elsewhere[0]] == [len(trace.line) for trace in rows[0]]


def farther(trace):
    """The same 60 pixels to the right: it is another whisker."""
    return trace._replace(line=trace.line + np.array([60.0, 0.0]))


PAIRS = {"orthogonal": orthogonal_views(center=(0.01, 0.005, 0.0)), "any": perspective_pair()}


@pytest.mark.parametrize("pair", PAIRS.values(), ids=PAIRS.keys())
@pytest.mark.parametrize("azimuth", [-0.9, 0.0, 0.7])
def test_a_curve_in_space_is_found_again(pair, azimuth):
    points = curve(azimuth)
    found = merge(pair, [traced(camera, points) for camera in pair])
    dense = CubicSpline(np.linspace(0, 1, 200), points)(np.linspace(0, 1, 4000))
    distance, _ = cKDTree(dense).query(found.points)
    assert distance.max() < 20e-6
    assert np.linalg.norm(found.points[0] - points[0]) < 20e-6
    true = np.linalg.norm(np.diff(dense, axis=0), axis=1).sum()
    assert found.length == pytest.approx(true, rel=5e-3)


def test_across_the_views_errors_are_as_large_as_they_say():
    generator = np.random.default_rng(0)
    pair, points = PAIRS["orthogonal"], curve(0.3)
    dense = CubicSpline(np.linspace(0, 1, 200), points)(np.linspace(0, 1, 4000))
    z = []
    for _ in range(20):
        found = merge(pair, [traced(c, points, generator, 0.1) for c in pair])
        _, near = cKDTree(dense).query(found.points)
        for j in range(10, 90, 10):
            tangent = dense[near[j] + 1] - dense[near[j] - 1]
            across = np.cross(tangent, [0.0, 0.0, 1.0])
            across /= np.linalg.norm(across)
            miss = (found.points[j] - dense[near[j]]) @ across
            z.append(miss / np.sqrt(across @ found.covariance[j] @ across))
    assert 0.3 < np.std(z) < 1.5


def test_along_the_epipolar_direction_it_is_honest():
    """In a plane of one x, which of its heights belongs to which y no view tells."""
    pair = orthogonal_views(center=(0.0, 0.012, 0.012))
    s = np.linspace(0.0, LENGTH, 200)
    spread = []
    for angle in (0.5, np.pi / 2 - 0.02):
        bow = np.sin(angle) * np.stack([s + 8.0 * s**2, s - 8.0 * s**2], axis=1)
        points = np.column_stack([np.cos(angle) * s, bow])
        found = merge(pair, [traced(camera, points) for camera in pair])
        across = np.array([0.0, 1.0, -1.0]) / np.sqrt(2.0)
        spread.append(np.sqrt(across @ found.covariance[50] @ across))
    assert spread[0] < 20e-6
    assert spread[1] > 5.0 * spread[0]


def test_a_view_that_ends_early_ends_the_curve():
    pair, points = PAIRS["orthogonal"], curve(0.2)
    found = merge(pair, [traced(pair[0], points), traced(pair[1], points[:150])])
    assert found.length == pytest.approx(
        merge(pair, [traced(c, points[:150]) for c in pair]).length, rel=0.01
    )


def test_many_frames_are_merged_as_one_by_one():
    pair = PAIRS["any"]
    frames = [[traced(c, curve(a, count=n)) for c in pair] for a, n in ((0.2, 200), (0.5, 90))]
    frames.insert(1, [Trace.lost(), frames[0][1]])
    for found, views in zip(merged(pair, frames), frames, strict=True):
        for one, other in zip(found, merge(pair, views), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-9)


def test_without_a_trace_there_is_no_curve():
    pair = PAIRS["orthogonal"]
    found = merge(pair, [traced(pair[0], curve(0.2)), Trace.lost()])
    assert np.isnan(found.points).all()
    with pytest.raises(ValueError, match="one each is needed"):
        merge(pair, [Trace.lost()])


def moving(pair, count=120, late=0, dropped=()):
    """Traces of a whisk; the second camera begins late and drops frames."""
    azimuth = 0.6 * np.sin(2.0 * np.pi * np.arange(count + 60) / 70.0)
    first = [traced(pair[0], curve(a)) for a in azimuth[:count]]
    numbers = [i for i in range(late, count + late) if i not in dropped]
    return first, [traced(pair[1], curve(azimuth[i])) for i in numbers], numbers


@pytest.mark.parametrize("pair", PAIRS.values(), ids=PAIRS.keys())
def test_the_offset_between_cameras_and_dropped_frames_are_found(pair):
    first, second, numbers = moving(pair, late=7, dropped=(60, 61))
    pairs = paired_frames(pair, [[first], [second]], None)
    moments = np.array(numbers)[pairs[:, 1]]
    wrong = pairs[:, 0] != moments
    assert len(pairs) > 100
    # Where the whisker turns back, frames before and after a gap look alike.
    assert wrong.mean() < 0.05


@pytest.mark.parametrize("pair", PAIRS.values(), ids=PAIRS.keys())
def test_an_offset_is_found_of_views_that_show_the_whisker_along_itself(pair):
    """Where it ends is seen with errors along it, by which lines of sight pass each other."""
    generator = np.random.default_rng(1)
    first, second, numbers = moving(pair, late=7)
    for trace in (*first, *second):
        for end, step in ((0, 1), (-1, -1)):
            ahead = trace.line[end + step] - trace.line[end]
            trace.line[end] += generator.normal(0.0, 4.0) * ahead / np.linalg.norm(ahead)
    pairs = paired_frames(pair, [[first], [second]], None)
    assert np.mean(pairs[:, 0] != np.array(numbers)[pairs[:, 1]]) < 0.05
    (said,) = remarks_on_time(pair, [[first], [second]], None)
    assert "-7 frames" in said
    assert (clear_offsets(*pair, first, second, 0).shifts == -7).all()
    assert (clear_offsets(*pair, first, second, -7).shifts == -7).all()


def test_errors_that_follow_the_motion_are_no_offset():
    """Fur that moves with the whisker covers its base, and the tips are not seen."""
    pair = PAIRS["orthogonal"]
    rows = [[t._replace(tip_seen=False) for t in row] for row in moving(pair)[:2]]
    for i, trace in enumerate(rows[1]):
        trace.line[0] += 3.0 * np.cos(2.0 * np.pi * i / 70.0 + 0.5)
    pairs = paired_frames(pair, [[row] for row in rows], None)
    assert (pairs[:, 0] == pairs[:, 1]).all()
    (said,) = remarks_on_time(pair, [[row] for row in rows], None)
    assert "do not determine their offset, and 0 is kept" in said
    assert remarks_on_time(pair, [[row] for row in rows], 0) == []


@pytest.mark.parametrize("view", [0, 1])
@pytest.mark.parametrize("gap", [1, 2])
def test_frames_that_one_camera_dropped_have_no_partner(view, gap):
    """The whisker takes several steps at once in one view; ends that are hidden show nothing."""
    generator, pair = np.random.default_rng(5), PAIRS["orthogonal"]
    azimuth = 0.6 * np.sin(2.0 * np.pi * np.arange(70) / 70.0 - 1.2)
    rows = [[traced(camera, curve(a), generator) for a in azimuth] for camera in pair]
    rows = [[t._replace(tip_seen=False, base_seen=False) for t in row] for row in rows]
    assert dropped_frames(pair, [[row] for row in rows]) == []
    del rows[view][20 : 20 + gap], rows[1 - view][-gap:]
    ((of, frame, count, certain),) = dropped_frames(pair, [[row] for row in rows])
    assert (of, frame, count, certain) == (view, 20, gap, True)
    pairs = paired_frames(pair, [[row] for row in rows], 0)
    moments = pairs + gap * (pairs >= 20) * (np.arange(2) == view)
    assert (moments[:, 0] == moments[:, 1]).all()
    assert len(pairs) == 70 - 2 * gap
    (remark,) = remarks_on_time(pair, [[row] for row in rows], 0)
    assert f"{pair[view].name} dropped {gap} frame" in remark
    assert (f"later ones are {gap} too early" in remark) == (view == 0)
    assert dropped_frames(pair[:1], [rows[view : view + 1]]) == []


def test_a_dropped_frame_is_not_sure_if_the_ends_contradict_it():
    """From frame 20 on one view shows what is between them where it is a frame later."""
    generator, pair = np.random.default_rng(5), PAIRS["orthogonal"]
    azimuth = 0.6 * np.sin(2.0 * np.pi * np.arange(70) / 70.0 - 1.2)
    rows = [[[traced(camera, curve(a), generator) for a in azimuth]] for camera in pair]
    row = rows[1][0]
    for i in range(20, 69):
        line = np.concatenate([row[i].line[:1], row[i + 1].line[1:-1], row[i].line[-1:]])
        row[i] = row[i + 1]._replace(line=line)
    (gap,) = dropped_frames(pair, rows)
    assert (gap.view, gap.frame, gap.certain) == (1, 20, False)
    pairs = paired_frames(pair, rows, 0)
    assert (pairs[:, 0] == pairs[:, 1]).all()


@pytest.mark.parametrize("pair", PAIRS.values(), ids=PAIRS.keys())
def test_ends_that_hardly_move_do_not_contradict_a_dropped_frame(pair):
    """The base moves by its noise only; no frame pairs are better than others by it."""
    azimuth = 0.6 * np.sin(2.0 * np.pi * np.arange(70) / 70.0 - 1.2)
    for seed in range(4):
        generator = np.random.default_rng(seed)
        rows = [[traced(camera, curve(a), generator) for a in azimuth] for camera in pair]
        rows = [[t._replace(tip_seen=False) for t in row] for row in rows]
        for trace in [*rows[0], *rows[1]]:
            trace.line[0] += generator.normal(0.0, 0.5, 2)
        del rows[0][20], rows[1][-1]
        (gap,) = dropped_frames(pair, [[row] for row in rows])
        assert gap == (0, 20, 1, True)


def test_frames_that_one_camera_dropped_after_the_other_one():
    """Later frames are simultaneous again, which contradicts neither gap."""
    generator, pair = np.random.default_rng(1), PAIRS["any"]
    azimuth = 0.6 * np.sin(2.0 * np.pi * np.arange(340) / 70.0 - 1.2)
    rows = [[traced(camera, curve(a), generator) for a in azimuth] for camera in pair]
    del rows[1][20], rows[0][120]
    gaps = dropped_frames(pair, [[row] for row in rows])
    assert gaps == [(1, 20, 1, True), (0, 120, 1, True)]
    pairs = paired_frames(pair, [[row] for row in rows], 0)
    moments = pairs + (pairs >= np.array([120, 20]))
    assert (moments[:, 0] == moments[:, 1]).all()
    assert len(pairs) == 338


def test_a_frame_is_dropped_for_all_whiskers_of_a_row():
    """One whisker that takes two steps at once while the others do not is followed wrongly."""
    generator, pair = np.random.default_rng(5), PAIRS["orthogonal"]
    azimuth = 0.6 * np.sin(2.0 * np.pi * np.arange(70) / 70.0 - 1.2)
    even = [[traced(camera, curve(a), generator) for a in azimuth] for camera in pair]
    late = [even[0][:20] + even[0][21:], even[1][:-1]]
    even = [row[:-1] for row in even]
    assert len(dropped_frames(pair, [[a, a, b] for a, b in zip(late, even, strict=True)])) == 1
    assert dropped_frames(pair, [[a, b, b] for a, b in zip(late, even, strict=True)]) == []


def test_what_lets_go_in_both_views_is_no_dropped_frame():
    generator, pair = np.random.default_rng(6), PAIRS["orthogonal"]
    azimuth = 0.6 * np.sin(2.0 * np.pi * np.delete(np.arange(70), 20) / 70.0 - 0.8)
    rows = [[traced(camera, curve(a), generator) for a in azimuth] for camera in pair]
    assert dropped_frames(pair, [[row] for row in rows]) == []


def test_frames_that_repeat_the_one_before_are_left_out():
    """Frames that were dropped and filled, one, and three in a row."""
    generator = np.random.default_rng(4)
    pair = PAIRS["orthogonal"]
    azimuth = 0.6 * np.sin(2.0 * np.pi * np.arange(70) / 70.0)
    rows = [[traced(camera, curve(a), generator) for a in azimuth] for camera in pair]
    assert without_repeats(pair, [rows]) == ([rows], [])
    for i in (30, 40, 41, 42):
        rows[0][i] = rows[0][i - 1]._replace(line=rows[0][i - 1].line + 0.02)
    ((first, second),), (remark,) = without_repeats(pair, [rows])
    assert [i for i, trace in enumerate(first) if not len(trace.line)] == [30, 40, 41, 42]
    assert second == rows[1]
    assert f"{pair[0].name}: 4 of 70 frames repeat the one before (30, 40, 41, 42)" in remark
    # A whisker of a row that stops alone does so by itself.
    moving = [[traced(camera, curve(a), generator) for a in azimuth] for camera in pair]
    assert without_repeats(pair, [rows, moving])[1] == []
    assert len(without_repeats(pair, [rows, rows, moving])[1]) == 1


def test_a_repeated_frame_in_which_an_object_lets_go_is_found():
    """The farther half was held back; the nearer one moves evenly."""
    azimuth, camera = 0.02 * np.arange(20), PAIRS["orthogonal"][0]
    free, share = [curve(a) for a in azimuth], np.linspace(0.0, 1.0, 200)[:, None] ** 2
    held = [shape + share * (free[8] - shape) for shape in free]
    row = [traced(camera, one) for one in free[:8] + held[8:13] + held[12:13] + free[14:]]
    assert repeated_frames(row) == {13}


@pytest.mark.parametrize("steps", [(0, 0, 0, 4, 4), (4, 4, 0, 0, 0), (4, 2, 0, -2, -4), (9, 9, 40)])
def test_sudden_stops_and_starts_are_no_repeated_frames(steps):
    azimuth = 0.01 * np.cumsum(np.repeat(steps, 2))
    camera = PAIRS["orthogonal"][0]
    assert repeated_frames([traced(camera, curve(a)) for a in azimuth]) == set()


def test_a_given_offset_is_used():
    pair = PAIRS["orthogonal"]
    first, second, _ = moving(pair, count=20)
    pairs = paired_frames(pair, [[first], [second]], 3)
    np.testing.assert_array_equal(pairs, np.stack([np.arange(17), np.arange(3, 20)], axis=1))
    with pytest.raises(ValueError, match="no frames belong together"):
        paired_frames(pair, [[first], [second]], 50)
    assert not remarks_on_time(pair, [[first], [second]], 50)
    pairs = paired_frames(pair, [[[first[0]] + [Trace.lost()] * 19], [second]], None)
    assert (pairs[:, 0] == pairs[:, 1]).all()


def test_the_filter_shifts_nothing_and_stops_what_is_fast():
    t = np.arange(1000) / 1000.0
    slow, fast = np.sin(2 * np.pi * 8.0 * t), np.sin(2 * np.pi * 300.0 * t)
    out = low_pass(np.stack([slow, fast], axis=1), 1000.0, 85.0)
    np.testing.assert_allclose(out[50:-50, 0], slow[50:-50], atol=1e-3)
    assert np.abs(out[50:-50, 1]).max() < 0.01
    lag = np.argmax(np.correlate(out[:, 0], slow, "full")) - 999
    assert lag == 0


def test_by_default_a_slow_film_is_not_filtered():
    assert [usual_cutoff(rate) for rate in (60.0, 170.0, 171.0)] == [None, None, 85.0]


def test_the_filter_keeps_gaps():
    values = np.linspace(0.0, 1.0, 60)
    values[20:25] = np.nan
    out = low_pass(values, 1000.0)
    np.testing.assert_array_equal(np.isnan(out), np.isnan(values))
    np.testing.assert_allclose(out[30:50], values[30:50], atol=1e-6)
    np.testing.assert_array_equal(low_pass(values, 1000.0, None), values)
    with pytest.raises(ValueError, match="below half of"):
        low_pass(values, 100.0, 85.0)


@pytest.mark.parametrize(
    "kept",
    [
        np.r_[0:400, 600:1000],  # cut out
        np.r_[0:500, 500:1000:4],  # the rate changes
        np.delete(np.arange(1000), [200, 201, 350, 700, 703]),  # dropped
    ],
)
def test_the_filter_does_not_take_frames_that_are_missing_for_a_jump(kept):
    t = np.arange(1000) / 1000.0
    slow = np.sin(2 * np.pi * 5.3 * t)
    out = low_pass(slow[kept], t[kept], 85.0)
    inner = (kept > 30) & (kept < 970)
    np.testing.assert_allclose(out[inner], slow[kept][inner], atol=5e-3)
    assert np.abs(low_pass(slow[kept], 1000.0, 85.0) - slow[kept])[inner].max() > 0.01


def test_the_filter_leaves_single_frames_and_refuses_slow_ones():
    t = np.array([0.0, 0.001, 0.002, 0.003, 0.5, 0.9])
    np.testing.assert_array_equal(low_pass(t**2, t, 85.0)[4:], t[4:] ** 2)
    with pytest.raises(ValueError, match="below half of 1 frames/s"):
        low_pass(t, np.arange(6.0), 85.0)


def test_contact_that_makes_a_whisker_look_rolled_leaves_its_roll():
    """Bent against its own bend, a whisker has for some frames a shape that it has when rolled."""
    s = np.linspace(0.0, 25e-3, 101) / 30e-3
    own = 30e-3 * np.stack([np.sin(s), 1.0 - np.cos(s), 0.0 * s], axis=1)
    azimuth = np.linspace(-0.5, 0.5, 40)
    roll, bent = 0.3 * azimuth, np.arange(18, 24)
    seen = roll.copy()
    # The first frame of a contact, in which it is light; and one in which it is not.
    seen[17] += 0.2
    seen[bent] += 2.0
    curves = base_rotation(azimuth, np.full(40, 0.1), seen) @ own.T
    curves = np.swapaxes(curves, 1, 2)
    free = ~np.isin(np.arange(40), bent)
    free[20] = True
    shape = RestShape(curves[0], free, np.zeros(40), 1e-6)
    whisker = whisker_at_rest(shape)
    assert np.flatnonzero(rolled_over(curves, shape, whisker)).tolist() == [20]
    free[20] = False
    found = base_pose(curves, shape, whisker)
    np.testing.assert_allclose(
        (found.roll - found.roll[0])[bent], (roll - roll[0])[bent], atol=0.03
    )


@pytest.fixture(scope="module")
def two_known():
    """Two whiskers in six frames that cross in the front view, the last three of them in doubt."""
    cameras, frames, bases = PAIRS["orthogonal"], 6, ([0.0, -1e-3, -5e-4], [0.0, 1e-3, 2e-3])
    shapes = [
        [curve(azimuth + 0.02 * i, bend) + base for i in range(frames)]
        for azimuth, bend, base in zip((0.1, -0.1), (12.0, -6.0), bases, strict=True)
    ]
    right = [[[traced(camera, p) for p in points] for camera in cameras] for points in shapes]
    doubtful = np.isin(np.arange(frames), [3, 4, 5])
    curves = [
        np.array([merge(cameras, both).points for both in zip(*r, strict=True)]) for r in right
    ]
    known = [Known(points, points[0], doubtful, doubtful) for points in curves]
    return cameras, right, known


def test_far_ends_that_were_exchanged_in_one_view_are_put_right(two_known):
    """In frames 3 and 4 each of two whiskers that cross goes on as the other in the front view."""
    cameras, right, known = two_known
    swapped = [[list(view) for view in row] for row in right]
    for i in (3, 4):
        (a, one), (b, other) = cut_at_crossing(right[0][1][i], right[1][1][i])
        swapped[0][1][i] = joined(one, a, other, b)
        swapped[1][1][i] = joined(other, b, one, a)
    # In frame 5 whisker 0 is on something that is no whisker of this row.
    swapped[0][1][5] = traced(cameras[1], curve(0.2, -25.0) + np.array([0.0, -1e-3, -5e-4]))
    found = exchanged(cameras, swapped, known)
    for k, row in enumerate(found):
        for i in range(5):
            away = cKDTree(right[k][1][i].line).query(row[1][i].line)[0]
            assert away.max() < 2.0
            np.testing.assert_array_equal(row[0][i].line, right[k][0][i].line)
    assert [len(found[0][v][5].line) for v in range(2)] == [0, 0]
    np.testing.assert_array_equal(found[1][1][5].line, right[1][1][5].line)


def test_a_whisker_that_a_view_lost_is_given_no_line_of_another(two_known):
    """In frame 4 of the front view the first whisker is lost, and the second near where it is."""
    cameras, right, known = two_known
    rows = [[list(view) for view in row] for row in right]
    rows[0][1][4], rows[1][1][4] = Trace.lost(), right[0][1][4]
    found = exchanged(cameras, rows, known)
    assert [len(found[0][v][4].line) for v in range(2)] == [0, 0]
    for i in (3, 5):
        np.testing.assert_array_equal(found[0][1][i].line, right[0][1][i].line)


def cut_at_crossing(one, other):
    away = np.linalg.norm(one.line[:, None] - other.line[None], axis=2)
    a, b = np.unravel_index(np.argmin(away), away.shape)
    return (a, one), (b, other)


def joined(one, a, other, b):
    line = np.concatenate([one.line[:a], other.line[b:]])
    return Trace(line, np.full(len(line), 0.03), np.ones(len(line), dtype=bool), 1.0)


def test_a_whisker_is_not_continued_beyond_the_tip_that_is_shown(monkeypatch):
    """Where its tip is not shown, its trace seems to go on along a neighbour."""
    points, pair = curve(0.0), PAIRS["orthogonal"]
    shape = RestShape(points, np.ones(16, dtype=bool), np.zeros(16), 1e-6)
    tip = np.arange(16) < 7
    posed = SimpleNamespace(
        longer=lambda *_: np.where(tip, 0.0, 50.0),
        reached=lambda view, points, pixels: 6e-5 * pixels,
        traces=SimpleNamespace(ends=np.repeat(tip, 4).reshape(16, 2, 2)),
    )
    monkeypatch.setattr(continuation, "_posed", lambda *_: posed)
    assert continuation.continued(shape, None, pair, None, None, False) is None
