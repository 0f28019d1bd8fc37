"""A trial keeps to the geometry and the mechanics, frame by frame."""

import numpy as np
import pytest

from vibrissa import Status, samples
from vibrissa.objects import Peg
from vibrissa.recording import Recording
from vibrissa.simulation import Motion, facing_peg, measure, simulate, sweep_past, whisking
from vibrissa.whisker import base_rotation

WHISKER = samples.gamma()
PEG = facing_peg(WHISKER)


def short_motion(**changes):
    return sweep_past(WHISKER, PEG, duration=0.4, rate=250.0, **changes)


@pytest.fixture(scope="module")
def motion():
    return short_motion(seed=3)


@pytest.fixture(scope="module")
def trial(motion):
    return simulate(WHISKER, motion, PEG)


def in_contact(trial):
    return trial["truth"]["in_contact"].values[:, 0]


def from_axis(points, peg):
    away = points - peg.origin
    return np.linalg.norm(away - (away @ peg.axis)[..., None] * peg.axis, axis=-1)


def test_the_surfaces_touch_in_every_contact(trial):
    contact = in_contact(trial)
    truth = trial["truth"].isel(whisker=0).to_dataset()
    points = truth["contact_point"].values[contact]
    s = truth["arc_length"].values[contact]
    np.testing.assert_allclose(
        from_axis(points, PEG), PEG.radius + WHISKER.radius(s), rtol=0, atol=1e-9 * WHISKER.length
    )


def test_the_whisker_never_enters_the_peg(trial):
    line = trial["truth"]["centerline"].values[:, 0]
    s = np.linspace(0.0, WHISKER.length, line.shape[1])
    gap = from_axis(line, PEG) - PEG.radius - WHISKER.radius(s)
    # Between its recorded points the whisker may come nearer than they do; they may not be inside.
    assert gap.min() > -1e-8


def test_forces_are_normal_to_peg_and_whisker(trial, motion):
    contact = in_contact(trial)
    truth = trial["truth"].isel(whisker=0).to_dataset()
    turned = np.einsum("tij,tj->ti", motion.base_rotation, truth["force"].values)[contact]
    away = truth["contact_point"].values[contact] - PEG.origin
    outward = away - (away @ PEG.axis)[:, None] * PEG.axis
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    size = np.linalg.norm(turned, axis=1)
    side = truth["status"].values[contact] == Status.OK
    assert size.min() > 0.0
    np.testing.assert_allclose(turned / size[:, None], outward, rtol=0, atol=1e-6)
    assert side.any()


def test_moment_is_point_times_force(trial):
    contact = in_contact(trial)
    truth = trial["truth"].isel(whisker=0).to_dataset()
    p, force, moment = (
        truth[name].values[contact] for name in ("contact_point_whisker", "force", "moment")
    )
    np.testing.assert_allclose(np.cross(p, force), moment, rtol=1e-12)


def test_without_contact_nothing_is_felt_and_nothing_is_known_of_a_point(trial):
    free = ~in_contact(trial)
    truth = trial["truth"].isel(whisker=0).to_dataset()
    assert free.any()
    assert (truth["status"].values[free] == Status.NO_CONTACT).all()
    assert (truth["force"].values[free] == 0.0).all()
    assert (truth["moment"].values[free] == 0.0).all()
    assert np.isnan(truth["contact_point"].values[free]).all()
    assert np.isnan(truth["arc_length"].values[free]).all()


def test_it_slips_past_on_both_sides(trial):
    """Touched from the back going forward and from the front going back, in turn, never through."""
    contact = in_contact(trial)
    y = trial["truth"]["contact_point"].values[:, 0, 1] - PEG.origin[1]
    starts = np.flatnonzero(np.diff(np.r_[False, contact].astype(int)) == 1)
    ends = np.flatnonzero(np.diff(np.r_[contact, False].astype(int)) == -1)
    assert len(starts) >= 4
    sides = []
    for first, last in zip(starts, ends, strict=True):
        side = np.sign(y[first : last + 1])
        assert (side == side[0]).all()
        sides.append(side[0])
    assert sides[0] == -1.0
    assert (np.diff(sides) != 0.0).all()


def test_a_free_whisker_is_on_the_side_it_slipped_to(trial):
    """Where it crosses the peg's distance from the base, it lies ahead of the peg or behind it."""
    contact = in_contact(trial)
    y = trial["truth"]["contact_point"].values[:, 0, 1] - PEG.origin[1]
    line = trial["truth"]["centerline"].values[:, 0]
    slipped = np.flatnonzero(contact[:-1] & ~contact[1:])
    for frame in slipped:
        i = np.argmin(np.abs(line[frame + 1, :, 0] - PEG.origin[0]))
        assert np.sign(line[frame + 1, i, 1] - PEG.origin[1]) == -np.sign(y[frame])


def test_fine_frames_and_coarse_frames_agree():
    """What happens in a frame does not depend on how many there were before."""
    fine = simulate(WHISKER, short_motion(), PEG)["truth"]
    coarse_motion = sweep_past(WHISKER, PEG, duration=0.4, rate=125.0)
    coarse = simulate(WHISKER, coarse_motion, PEG)["truth"]
    both = fine["in_contact"].values[::2, 0] & coarse["in_contact"].values[:, 0]
    assert both.sum() >= 0.9 * coarse["in_contact"].values.sum()
    np.testing.assert_allclose(
        fine["contact_point_whisker"].values[::2][both],
        coarse["contact_point_whisker"].values[both],
        rtol=0,
        atol=1e-7 * WHISKER.length,
    )


def test_moving_the_laboratory_changes_nothing_that_is_felt(trial, motion):
    turn = base_rotation(0.7, -0.4, 1.1)
    shift = np.array([0.1, -0.2, 0.05])

    class Carried(Motion):
        @property
        def base_rotation(self):
            return turn @ motion.base_rotation

    carried = Carried(
        motion.time,
        motion.azimuth,
        motion.elevation,
        motion.roll,
        motion.base_position @ turn.T + shift,
    )
    peg = Peg(turn @ PEG.origin + shift, turn @ PEG.axis, PEG.radius)
    moved = simulate(WHISKER, carried, peg)
    for name in ("force", "moment", "contact_point_whisker"):
        expected = trial["truth"][name].values
        scale = np.nanmax(np.abs(expected))
        np.testing.assert_allclose(moved["truth"][name].values, expected, rtol=0, atol=1e-7 * scale)
    np.testing.assert_array_equal(moved["truth"]["status"].values, trial["truth"]["status"].values)
    points = trial["truth"]["contact_point"].values @ turn.T + shift
    np.testing.assert_allclose(moved["truth"]["contact_point"].values, points, rtol=0, atol=1e-8)


def test_every_variable_is_labelled(trial):
    for group in ("/", "/truth", "/objects", "/whiskers/0"):
        for name, variable in trial[group].to_dataset().data_vars.items():
            assert {"units", "long_name"} <= set(variable.attrs), (group, name)


def test_whisker_and_peg_ride_along(trial):
    whisker = Recording(trial).whisker()
    np.testing.assert_array_equal(whisker.centerline(7), WHISKER.centerline(7))
    (peg,) = Recording(trial).pegs
    np.testing.assert_array_equal(peg.origin, PEG.origin)
    with pytest.raises(ValueError, match="shapes of 1 whiskers"):
        Recording(trial).whisker(1)


def test_the_sensor_adds_its_noise_and_no_more(trial):
    noisy = measure(trial, force_noise=2e-6, moment_noise=3e-8, seed=4)
    for name, sigma in (("force", 2e-6), ("moment", 3e-8)):
        noise = noisy[name].values - trial["truth"][name].values
        # 300 numbers: their standard deviation is within 4 of its own standard deviations, 4 %.
        assert noise.std() == pytest.approx(sigma, rel=0.17)
        assert noisy[name].attrs["noise"] == sigma
    np.testing.assert_array_equal(measure(trial, 0.0, 0.0)["force"], trial["truth"]["force"])
    assert "noise" not in trial["force"].attrs
    with pytest.raises(ValueError, match="force_noise"):
        measure(trial, force_noise=-1.0)


@pytest.mark.parametrize("whisker", [samples.straight(), WHISKER.scaled(0.15), WHISKER.scaled(1.5)])
def test_whiskers_of_other_lengths_slip_past_too(whisker):
    peg = facing_peg(whisker)
    trial = simulate(whisker, sweep_past(whisker, peg, duration=0.21, rate=200.0), peg)
    contact = in_contact(trial)
    y = trial["truth"]["contact_point"].values[contact, 0, 1]
    assert not np.isin(trial["truth"]["status"].values, [Status.NOT_CONVERGED]).any()
    assert (y < 0.0).any()
    assert (y > 0.0).any()
    assert not contact[-1]


class TestMotion:
    def test_rotations_are_rotations_and_point_where_the_angles_say(self):
        generator = np.random.default_rng(0)
        az, el, ro = generator.uniform(-1.5, 1.5, (3, 20))
        rotation = base_rotation(az, el, ro)
        np.testing.assert_allclose(
            rotation @ np.swapaxes(rotation, 1, 2),
            np.broadcast_to(np.eye(3), (20, 3, 3)),
            atol=1e-14,
        )
        np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
        tangent = rotation[:, :, 0]
        np.testing.assert_allclose(np.arctan2(tangent[:, 1], tangent[:, 0]), az)
        np.testing.assert_allclose(np.arcsin(tangent[:, 2]), el)
        rolled = np.swapaxes(base_rotation(az, el, 0.0), 1, 2) @ rotation
        np.testing.assert_allclose(np.arctan2(rolled[:, 2, 1], rolled[:, 1, 1]), ro)

    def test_it_is_smooth_and_within_its_bounds(self):
        motion = whisking(amplitude=0.5, set_point=0.1, variation=0.1, position_drift=1e-3)
        assert len(motion) == 3000
        assert np.abs(motion.azimuth - 0.1).max() <= 0.5 * 1.2
        assert np.abs(motion.base_position).max() <= 1e-3
        # Of a sinusoid of amplitude a at f: the second difference over dt² is at most a (2πf)².
        acceleration = np.diff(motion.azimuth, 2) * 1000.0**2
        assert np.abs(acceleration).max() < 0.5 * 1.25 * (2.0 * np.pi * 5.0) ** 2

    def test_seeds_differ_and_repeat(self):
        first, again, other = (whisking(seed=seed).azimuth for seed in (1, 1, 2))
        np.testing.assert_array_equal(first, again)
        assert np.abs(first - other).max() > 1e-3

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"duration": 0.0}, "duration is 0.0"),
            ({"rate": float("nan")}, "rate is nan"),
            ({"duration": 1e-3}, "fewer than two frames"),
            ({"frequency": 8000.0}, "8000 whisks/s are more than"),
        ],
    )
    def test_faults(self, changes, message):
        with pytest.raises(ValueError, match=message):
            whisking(**changes)

    def test_faulty_arrays(self):
        one = np.zeros(3)
        with pytest.raises(ValueError, match=r"roll has shape \(2,\).*base_position has shape"):
            Motion(np.arange(3.0), one, one, np.zeros(2), one)
        with pytest.raises(ValueError, match="time does not increase"):
            Motion(one, one, one, one, np.zeros((3, 3)))


def test_faulty_pegs_and_plans():
    with pytest.raises(ValueError, match=r"axis is \(0, 0, 0\).*radius is -1"):
        Peg([0, 0, 0], [0, 0, 0], -1.0)
    with pytest.raises(ValueError, match="no room"):
        facing_peg(WHISKER.scaled(0.05))
    with pytest.raises(ValueError, match="row is 'F'"):
        sweep_past(WHISKER, PEG, row="F")
    with pytest.raises(ValueError, match="does not meet"):
        sweep_past(WHISKER, Peg([1.0, 0, 0], [0, 0, 1], 1e-3))
