"""From points to whiskers: any frame, any spacing, noise or none."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from vibrissa import load_whisker, samples
from vibrissa.whisker import Whisker

REAL = sorted((Path(__file__).parents[3] / "shared" / "real_whiskers").glob("[0-9]*.csv"))
GAMMA = samples.gamma()


def digitized(n, noise=0.0, seed=0, whisker=GAMMA):
    points = whisker.centerline(n)
    return points + np.random.default_rng(seed).normal(0.0, noise, points.shape)


def apart(found, true):
    """Root mean square distance of a found whisker, in its source frame, from the true one."""
    near = found.pose.to_source(found.centerline(200))
    fine = true.pose.to_source(true.centerline(4001))
    gaps = np.linalg.norm(near[:, None] - fine, axis=2).min(axis=1)
    return np.sqrt(np.mean(gaps**2))


def bending(whisker, share):
    return np.linalg.norm(whisker.curvature(share * whisker.length), axis=-1)


@pytest.mark.parametrize("n", [14, 50, 500])
def test_without_noise_the_curve_comes_back(n):
    whisker = Whisker.from_points(digitized(n), noise=0.0)
    assert whisker.length == pytest.approx(GAMMA.length, abs=50e-6 * (14 / n) ** 3)
    share = np.linspace(0.0, 0.9, 50)
    np.testing.assert_allclose(bending(whisker, share), bending(GAMMA, share), atol=3 * (14 / n))
    on_points = np.linspace(0, whisker.length, n)
    np.testing.assert_allclose(
        whisker.pose.to_source(whisker.position(on_points)), digitized(n), atol=2e-6
    )


def test_interpolation_error_falls_with_the_points():
    smooth = Whisker.parabola(40e-3, 10.0)
    errors = []
    for n in (8, 16, 32):
        found = Whisker.from_points(smooth.centerline(n), noise=0.0)
        errors.append(np.abs(found.centerline(50) - smooth.centerline(50)).max())
    assert errors[1] < errors[0] / 7
    assert errors[2] < errors[1] / 7
    assert errors[2] < 0.2e-6


@pytest.mark.parametrize("stated", [False, True])
@pytest.mark.parametrize("noise", [0.05e-3, 0.2e-3])
@pytest.mark.parametrize(
    "n",
    [10, pytest.param(50, marks=pytest.mark.slow), 500, pytest.param(2000, marks=pytest.mark.slow)],
)
def test_noise_is_smoothed_away(n, noise, stated):
    whisker = Whisker.from_points(digitized(n, noise, seed=n), noise=noise if stated else None)
    assert apart(whisker, GAMMA) < noise * (1.6 if n == 10 else 0.7)
    # Base and tip are seen as well as the points at the ends.
    assert whisker.length == pytest.approx(GAMMA.length, abs=4 * noise)
    share = np.linspace(0.1, 0.9, 80)
    error = np.sqrt(np.mean((bending(whisker, share) - bending(GAMMA, share)) ** 2))
    assert error < 12.0


def test_noise_is_estimated():
    points = digitized(200, 0.1e-3, seed=3)
    note = Whisker.from_points(points).notes[0]
    assert "estimated at 0.1 mm" in note or "estimated at 0.09" in note or "at 0.11 mm" in note
    assert "noise of its points" not in " ".join(Whisker.from_points(points, noise=1e-4).notes)


@pytest.mark.parametrize("seed", [0, 1])
def test_points_that_show_no_more_than_a_parabola_make_a_planar_whisker(seed):
    # Verdicts on signals that lose a dimension in its plane depend on it.
    along = np.linspace(0.0, 20e-3, 9)
    points = np.column_stack([along, 10.0 * along**2, np.zeros(9)])
    points += np.random.default_rng(seed).normal(0.0, 0.2e-3, points.shape)
    turn = Rotation.from_euler("xyz", [0.4, -1.1, 2.0])
    whisker = Whisker.from_points(turn.apply(points))
    assert not whisker.is_straight
    assert np.abs(whisker.centerline(51)[:, 2]).max() < 1e-12 * whisker.length


def test_shape_and_pose_belong_together():
    points = Rotation.from_euler("xyz", [1, 2, 3]).apply(digitized(30))
    points += np.array([0.01, 0.02, 0.03])
    whisker = Whisker.from_points(points, noise=0.0)
    np.testing.assert_allclose(whisker.pose.origin, points[0], atol=1e-12)
    np.testing.assert_allclose(whisker.frame(0.0), np.eye(3), atol=1e-14)
    np.testing.assert_allclose(
        whisker.pose.to_source(whisker.position(whisker.length)), points[-1], atol=1e-10
    )
    assert not whisker.curvature(np.linspace(0, whisker.length, 9))[:, 0].any()


angles = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
shifts = st.tuples(*[st.floats(-0.2, 0.2)] * 3)


@pytest.mark.slow
@settings(max_examples=15)
@given(angles, shifts, st.booleans())
def test_any_frame_gives_the_same_whisker(euler, shift, noisy):
    points = digitized(20, 0.1e-3 if noisy else 0.0)
    turn = Rotation.from_euler("xyz", euler)
    here = Whisker.from_points(points)
    there = Whisker.from_points(turn.apply(points) + shift)
    assert there.length == pytest.approx(here.length, rel=1e-10)
    np.testing.assert_allclose(there.centerline(20), here.centerline(20), atol=1e-10)
    np.testing.assert_allclose(
        there.pose.rotation, turn.as_matrix() @ here.pose.rotation, atol=1e-8
    )
    np.testing.assert_allclose(
        there.pose.origin, turn.as_matrix() @ here.pose.origin + shift, atol=1e-10
    )


@settings(max_examples=10)
@given(angles)
def test_the_proximal_part_lies_flat_and_bends_to_y(euler):
    points = Rotation.from_euler("xyz", euler).apply(digitized(25, 0.05e-3))
    whisker = Whisker.from_points(points)
    proximal = whisker.position(np.linspace(0, 0.7 * whisker.length, 200))
    assert proximal[:, 1].mean() > 0.0
    flat = np.sum(proximal[:, 2] ** 2)
    for roll in (-0.01, 0.01):
        turned = proximal @ Rotation.from_euler("x", roll).as_matrix()
        assert np.sum(turned[:, 2] ** 2) > flat


@pytest.mark.parametrize("base", ["last", [1e-3, -1e-3, 0.5e-3], [1e-3, 0.0]])
def test_tip_first_is_turned_around(base):
    points = digitized(20, 0.05e-3)
    forward = Whisker.from_points(points, base="first")
    backward = Whisker.from_points(points[::-1], base=base)
    assert backward.length == forward.length
    np.testing.assert_array_equal(backward.centerline(9), forward.centerline(9))


def test_base_hint_that_does_not_tell():
    points = digitized(20)
    with pytest.raises(ValueError, match="does not identify the base"):
        Whisker.from_points(points, base=(points[0] + points[-1]) / 2)
    # Millimetres, of a point near the first, were nearer to the last.
    with pytest.raises(ValueError, match="does not identify the base"):
        Whisker.from_points(points, base=points[0] + [0.5, 0.2, 0.0])
    with pytest.raises(ValueError, match="standard deviation of a coordinate, in m"):
        Whisker.from_points(points, noise=0.01)
    with pytest.raises(ValueError, match='"first", "last"'):
        Whisker.from_points(points, base="tip")
    with pytest.raises(ValueError, match="finite point"):
        Whisker.from_points(points, base=[0.0])


def test_two_columns_mean_a_plane():
    points = Whisker.parabola(40e-3, -8.0).pose.to_source(
        Whisker.parabola(40e-3, -8.0).centerline(15)
    )
    whisker = Whisker.from_points(points[:, :2], noise=0.0)
    assert np.abs(whisker.curvature(np.linspace(0, whisker.length, 20))[:, 1]).max() < 1e-9
    assert whisker.position(whisker.length)[1] > 0.0
    # y up means z down: it was rolled over.
    np.testing.assert_allclose(whisker.pose.rotation[:, 2], [0, 0, -1], atol=1e-12)


def test_uneven_spacing_and_clusters():
    share = np.linspace(0, 1, 400) ** 3
    points = GAMMA.position(share * GAMMA.length)
    points += np.random.default_rng(0).normal(0, 0.1e-3, points.shape)
    assert apart(Whisker.from_points(points), GAMMA) < 0.05e-3


def test_pixels_of_a_camera():
    points = np.round(digitized(300) / 58e-6) * 58e-6
    points = points[np.sort(np.unique(points, axis=0, return_index=True)[1])]
    assert apart(Whisker.from_points(points), GAMMA) < 20e-6


@pytest.mark.parametrize("noise", [0.0, 0.1e-3])
@pytest.mark.parametrize("direction", [(1, 2, 2), (-3, 0, 0), (0, -3, 0), (3, 0, 0)])
def test_straight_points_keep_the_nearest_roll(direction, noise):
    axis = np.array(direction) / 3.0
    points = np.outer(np.linspace(0.0, 40e-3, 30), axis) + np.array([0.1, 0, 0])
    points += np.random.default_rng(2).normal(0.0, noise, points.shape)
    whisker = Whisker.from_points(points)
    assert whisker.is_straight
    assert any("straight" in note for note in whisker.notes)
    assert whisker.length == pytest.approx(40e-3, abs=4 * noise + 1e-12)
    tangent = whisker.pose.rotation[:, 0]
    np.testing.assert_allclose(tangent, axis, atol=0.01)
    # The least turn is the one by the angle between the two x axes, no more.
    angle = Rotation.from_matrix(whisker.pose.rotation).magnitude()
    assert angle == pytest.approx(np.arccos(np.clip(tangent[0], -1, 1)), abs=1e-6)


def test_a_robots_whisker():
    true = Whisker.parabola(0.3, 1.5, base_radius=4e-3)
    found = Whisker.from_points(true.centerline(12), base_radius=4e-3)
    assert apart(found, true) < 0.1e-3


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((5, 4)), r"shape \(5, 4\)"),
        (np.zeros(5), r"shape \(5,\)"),
        (digitized(3), "points is 3; at least 4"),
        (np.zeros((5, 3)), "rows 1, 2, 3, 4 repeat.*all points coincide"),
        (digitized(20)[[*range(10), *range(9, 20)]], "rows 10 repeat"),
        (digitized(20) * 1e3, "millimetres given as metres"),
        (digitized(20) * 1e-3, "converted once too often"),
        (
            np.ma.masked_array(digitized(20), mask=np.arange(20)[:, None] == 5 * np.ones(3)),
            "rows 5",
        ),
    ],
)
def test_bad_points(points, message):
    with pytest.raises(ValueError, match=message):
        Whisker.from_points(points)


def test_all_faults_of_points_come_in_one_message():
    points = digitized(20) * 1e3
    points[[3, 7], 1] = np.nan, np.inf
    points[11] = points[10]
    with pytest.raises(ValueError, match=r"rows 3, 7 are not.*rows 11 repeat.*millimetres"):
        Whisker.from_points(points)
    with pytest.raises(ValueError, match="noise is -1"):
        Whisker.from_points(digitized(20), noise=-1)


@pytest.mark.parametrize("n", [6, 14, 50, 500])
@pytest.mark.parametrize("true", [GAMMA, samples.straight()])
def test_points_out_of_order(n, true):
    points = digitized(n, whisker=true)
    shuffled = np.random.default_rng(0).permutation(points)
    rotated = np.concatenate([points[n // 2 :], points[: n // 2]])
    for disordered in (shuffled, rotated):
        with pytest.raises(ValueError, match="order"):
            Whisker.from_points(disordered)


@pytest.mark.slow
@pytest.mark.skipif(not REAL, reason="no digitised whiskers beside the repository")
def test_real_whiskers_load():
    assert len(REAL) == 28
    for path in REAL:
        whisker = load_whisker(path)
        assert whisker.name == path.stem
        s = np.linspace(0.0, whisker.length, 200)
        # A whisker turns by about a radian; none turns by more than 3.2 per length anywhere.
        assert (bending(whisker, s / whisker.length) * whisker.length).max() < 3.2
        assert whisker.position(s)[:, 1].mean() >= 0.0
        assert sum("estimated" in note for note in whisker.notes) == 1


@pytest.mark.parametrize("n", [4, 5, 7])
def test_few_points_of_a_curved_whisker_are_not_taken_for_a_straight_one(n):
    """Seven per cent of the length off the chord is curvature, whatever a test could prove."""
    whisker = Whisker.from_points(Whisker.parabola(0.04, 10.0).centerline(n))
    assert not whisker.is_straight
    assert whisker.length == pytest.approx(0.04, rel=2e-3)
