"""A sensor described once serves both ways, and known loads give back what it is."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli.app import app
from vibrissa.contacts.sensing.noise import SensorNoise
from vibrissa.sensors import (
    Sensor,
    SensorFrame,
    calibrate_frame,
    calibrate_mixing,
    calibrate_on_contacts,
    calibrate_weight,
    fit_stiffness,
    load_sensor,
    save_sensor,
    tare,
)


@pytest.fixture
def rng():
    return np.random.default_rng(4)


@pytest.fixture(scope="module")
def wire():
    """Steel, 300 mm, 1 mm thick at the base."""
    return vb.Whisker.straight(
        0.3, base_radius=0.5e-3, tip_radius=0.25e-3, youngs_modulus=200e9, poisson_ratio=0.29
    )


@pytest.fixture(scope="module")
def touched(wire):
    rng = np.random.default_rng(5)
    bearing = rng.uniform(-np.pi, np.pi, 60)
    load = vb.PointForce(rng.uniform(0.1, 0.3, 60), rng.uniform(0.01, 0.08, 60), bearing)
    return vb.deflect(wire, load)


def wrench_of(bent):
    return np.concatenate([bent.force, bent.moment], axis=-1)


def frames(rng, n):
    for i in range(n):
        turn = Rotation.random(random_state=rng.integers(1 << 30)).as_matrix()
        if i % 2:
            turn = turn @ np.diag([1.0, 1.0, -1.0])
        yield SensorFrame(turn, rng.normal(size=3) * 5e-3, reaction=bool(i // 2 % 2))


def test_a_force_has_the_moment_of_its_place_in_any_right_handed_frame(rng):
    """The frame is checked by geometry: the same force at the same place, in both frames."""
    for frame in list(frames(rng, 8))[::2]:
        place, force = rng.normal(size=(2, 3))
        at_base = np.concatenate([force, np.cross(place, force)])
        sign = -1.0 if frame.reaction else 1.0
        own_place = frame.axes.T @ (place - frame.position)
        own_force = sign * frame.axes.T @ force
        seen = np.concatenate([own_force, np.cross(own_place, own_force)])
        np.testing.assert_allclose(frame.to_base() @ seen, at_base, atol=1e-12)


def test_a_left_hand_has_moments_of_its_own_numbers(rng):
    frame = SensorFrame(("x", "-y", "z"), (0.0, 0.0, 0.01))
    assert frame.handedness == -1
    place, force = rng.normal(size=(2, 3))
    own_place = frame.axes.T @ (place - frame.position)
    own_force = frame.axes.T @ force
    seen = np.concatenate([own_force, np.cross(own_place, own_force)])
    at_base = np.concatenate([force, np.cross(place, force)])
    np.testing.assert_allclose(frame.to_base() @ seen, at_base, atol=1e-12)
    np.testing.assert_allclose(frame.from_base() @ at_base, seen, atol=1e-12)


@pytest.mark.parametrize(
    ("given_axes", "message"),
    [
        (("x", "x", "y"), "once each"),
        (np.diag([1.0, 1.0, 2.0]), "right angles"),
        (np.eye(2), "three columns"),
    ],
)
def test_what_are_no_axes_is_refused(given_axes, message):
    with pytest.raises(ValueError, match=message):
        SensorFrame(given_axes)


@pytest.mark.parametrize("name", ["noise", "bias", "largest", "mixing", "mixing_error"])
def test_masked_values_are_missing_not_numbers(name):
    shape = (6, 6) if name.startswith("mixing") else (6,)
    mask = np.broadcast_to(np.arange(6) == 2, shape)
    values = np.ma.masked_array(np.full(shape, 0.5), mask=mask)
    with pytest.raises(ValueError, match=name):
        Sensor(**{name: values})


def test_masked_frames_and_noise_are_refused():
    with pytest.raises(ValueError, match="position"):
        SensorFrame(position=np.ma.masked_array(np.zeros(3), mask=[0, 1, 0]))
    with pytest.raises(ValueError, match="finite variances"):
        SensorNoise.of(np.ma.masked_array(np.eye(6), mask=np.eye(6)), ("Fx",))


@given(st.integers(0, 2**32 - 1))
def test_felt_and_to_wrench_undo_read(seed):
    rng = np.random.default_rng(seed)
    frame = next(frames(rng, 1))
    k = int(rng.integers(6, 9))
    sensor = Sensor(
        [f"c{i}" for i in range(k)],
        rng.normal(size=(k, 6)),
        noise=0.0,
        bias=rng.normal(size=k),
        frame=frame,
        mass=0.01,
        mass_moment=rng.normal(size=3) * 1e-4,
    )
    wrench = rng.normal(size=(5, 6))
    turn = Rotation.random(5, random_state=seed).as_matrix()
    reading = sensor.read(np.arange(5.0), wrench, rotation=turn)
    found, _ = sensor.to_wrench(reading, turn)
    np.testing.assert_allclose(found, wrench, rtol=1e-6, atol=1e-7)
    with pytest.raises(ValueError, match="carries a mass"):
        sensor.compensated(reading)


def test_the_covariance_of_a_wrench_is_that_of_its_scatter(rng):
    sensor = Sensor(
        [f"c{i}" for i in range(8)], rng.normal(size=(8, 6)), noise=rng.uniform(0.1, 1.0, 8)
    )
    reading = sensor.read(np.arange(4000.0), np.zeros((4000, 6)))
    found, covariance = sensor.to_wrench(reading)
    np.testing.assert_allclose(np.cov(found.T), covariance, atol=0.08 * covariance.max())


def test_too_few_channels_make_no_wrench():
    with pytest.raises(ValueError, match="do not determine all six"):
        Sensor(("Fx", "My", "Mz")).to_wrench(np.zeros((2, 3)))


def test_a_sensor_is_read_as_it_was_written(tmp_path, rng):
    sensor = Sensor(
        ("strain a", "strain b"),
        rng.normal(size=(2, 6)),
        noise=[1e-3, 2e-3],
        bias=[0.1, -0.2],
        resolution=1e-4,
        relative_noise=0.01,
        frame=next(frames(rng, 1)),
        mass=0.02,
        mass_moment=(1e-5, 0.0, 2e-5),
    )
    save_sensor(tmp_path / "sensor.toml", sensor)
    same = load_sensor(tmp_path / "sensor.toml")
    assert same.channels == sensor.channels
    np.testing.assert_allclose(same.base_mixing, sensor.base_mixing, rtol=1e-12)
    for name in ("noise", "bias", "resolution", "mass_moment"):
        np.testing.assert_array_equal(getattr(same, name), getattr(sensor, name))
    np.testing.assert_array_equal(same.covariance([1.0, 2.0]), sensor.covariance([1.0, 2.0]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("channels = 3", "no sensor"),
        ('channels = ["Fx"]\nnois = 1.0', "has nois"),
        ('channels = ["Fx"\n', "it is not TOML"),
        ('[frame]\naxes = ["x", "y", "y"]', "once each"),
    ],
)
def test_a_file_that_describes_no_sensor_is_refused(tmp_path, text, message):
    (tmp_path / "sensor.toml").write_text(text)
    with pytest.raises(ValueError, match=message):
        load_sensor(tmp_path / "sensor.toml")


def test_mixing_and_offset_are_found_as_surely_as_said(wire, touched, rng):
    """Over repeated calibrations errors have the variances that each calibration states."""
    true = Sensor(
        ("a", "b"),
        [[0, 2.0, 0, 0, 0, 30.0], [0, 0, 1.5, 0, -20.0, 0]],
        noise=[2e-3, 3e-3],
        bias=[0.5, -1.0],
    )
    which, components = [1, 2, 4, 5], ("Fy", "Fz", "My", "Mz")
    errors = []
    for seed in range(40):
        readings = true.read(np.arange(60.0), wrench_of(touched), seed)
        found = calibrate_mixing(readings, wrench_of(touched), components=components)
        away = np.column_stack(
            [found.sensor.mixing[:, which] - true.mixing[:, which], found.sensor.bias - true.bias]
        )
        errors.append(
            [e @ np.linalg.solve(c, e) for e, c in zip(away, found.covariance, strict=True)]
        )
    assert np.mean(errors) == pytest.approx(5.0, rel=0.2)
    np.testing.assert_allclose(found.sensor.noise, true.noise, rtol=0.3)
    same = calibrate_on_contacts(wire, touched.contact_point, readings, components=components)
    np.testing.assert_allclose(same.sensor.mixing, found.sensor.mixing, rtol=0, atol=1e-5)


@pytest.mark.filterwarnings("ignore:. of 60 contacts are not possible")
def test_errors_of_contact_points_do_not_make_the_mixing_smaller(wire, touched):
    """Points are known to 1 mm; taken as exact, the gain is 1.4 % too small."""
    true = Sensor(
        ("a", "b"), [[0, 0, 0, 0, 21.0, 1.5], [0, 0, 0, 0, -0.8, 19.0]], 4e-3, bias=[0.3, -0.1]
    )
    rng = np.random.default_rng(5)
    options = {"components": ("My", "Mz"), "point_sigma": 1e-3, "noise": true.noise}
    squared, gain = [], []
    for seed in range(30):
        readings = true.read(np.arange(60.0), wrench_of(touched), seed)
        points = touched.contact_point + 1e-3 * rng.normal(size=(60, 3))
        found = calibrate_on_contacts(wire, points, readings, **options).sensor
        away = np.column_stack([found.mixing[:, 4:] - true.mixing[:, 4:], found.bias - true.bias])
        for error, covariance in zip(away, found.mixing_covariance[:, 4:, 4:], strict=True):
            squared.append(error @ np.linalg.solve(covariance, error) / 3.0)
        gain.append(np.sum(away[:, :2] * true.mixing[:, 4:]) / np.sum(true.mixing**2))
    assert 0.5 < np.mean(squared) < 1.5
    assert abs(np.mean(gain)) < 3.0 * np.std(gain) / np.sqrt(30.0)
    assert (found.noise >= true.noise).all()
    with pytest.raises(ValueError, match="point_sigma"):
        calibrate_on_contacts(wire, points, readings, point_sigma=-1e-3)


def test_loads_that_differ_by_their_errors_only_are_refused(wire, touched):
    """And noise that such errors hide is questioned."""
    readings, wrenches = wrench_of(touched)[:, 4:], wrench_of(touched)
    errors = np.diag([0, 0, 0, 0, 1.0, 1.0]) * wrenches[:, 4:].var()
    options = {"components": ("My", "Mz")}
    with pytest.raises(ValueError, match="no more than their stated errors"):
        calibrate_mixing(readings, wrenches, wrench_covariances=4.0 * errors, **options)
    with pytest.warns(UserWarning, match="do not determine the sensor's noise"):
        calibrate_mixing(readings, wrenches, wrench_covariances=1e-3 * errors, **options)


def test_channels_that_the_loads_do_not_explain_are_named(rng):
    """As where rows are shifted, a reading is wild, or a channel is not connected."""
    wrenches = rng.normal(size=(60, 6)) * np.repeat([5e-5, 1e-6], 3)
    readings = wrenches @ np.diag([1e4] * 3 + [1e6] * 3) + 1e-3 * rng.normal(size=(60, 6))
    for wrong in (np.roll(readings, 1, axis=0), np.where(readings == readings[3], 1e3, readings)):
        with pytest.warns(UserWarning, match="the loads explain only a part of the readings"):
            calibrate_mixing(wrong, wrenches)
    dead = np.where(np.arange(6) == 4, 0.3, readings)
    with pytest.raises(ValueError, match="channel 5 always read the same"):
        calibrate_mixing(dead, wrenches)
    with pytest.raises(ValueError, match="must not be negative"):
        calibrate_mixing(readings, wrenches, noise=-1.0)


def test_mixing_that_contacts_do_not_tell_is_refused(wire, touched, rng):
    """A straight whisker never twists; contacts in one plane leave the other open."""
    readings = rng.normal(size=(60, 2))
    with pytest.raises(ValueError, match="do not depend on Mx"):
        calibrate_on_contacts(wire, touched.contact_point, readings)
    load = vb.PointForce(np.full(20, 0.2), np.linspace(0.01, 0.08, 20), np.zeros(20))
    planar = wrench_of(vb.deflect(wire, load))
    with pytest.raises(ValueError, match="Fz"):
        calibrate_mixing(readings[:20], planar, components=("Fy", "Fz"))
    with pytest.raises(ValueError, match="do not determine 7 unknowns"):
        calibrate_mixing(readings[:3], np.eye(6)[:3])


def test_contacts_that_are_not_possible_are_left_out_by_name(wire, touched):
    """Row 3 is beyond the tip; most of the other rows decide."""
    points, loads = touched.contact_point[:8].copy(), wrench_of(touched)[:8]
    points[3] = [0.5, 0.0, 0.0]
    options = {"components": ("My", "Mz")}
    with pytest.warns(UserWarning, match=r"1 of 8 .*left out: 3 \(of the rows, from 0\)"):
        found = calibrate_on_contacts(wire, points, loads[:, 4:], **options).sensor
    np.testing.assert_allclose(found.mixing[:, 4:], np.eye(2), atol=1e-6)
    loads[0] = np.nan
    with pytest.warns(UserWarning, match=r"1 of 8 .*left out: 3 "):
        stiffness = fit_stiffness(wire, points, loads).stiffness
    assert stiffness == pytest.approx(wire.base_bending_stiffness, rel=1e-6)
    with pytest.raises(ValueError, match="2 of 3 contacts are not possible"):
        calibrate_on_contacts(wire, points[[3, 3, 4]], loads[[3, 3, 4], 4:], **options)
    with pytest.raises(ValueError, match="2 of 3 contacts are not possible"):
        fit_stiffness(wire, points[[3, 3, 4]], loads[[3, 3, 4]])


@pytest.mark.slow
def test_contacts_that_the_fitted_taper_makes_impossible_are_left_out(wire):
    """Point 13 is wrong: possible on the stated wire, but beyond the fold of the true one."""
    slim = wire.with_properties(base_radius=wire.base_radius, tip_radius=0.1e-3)
    rng = np.random.default_rng(5)
    load = vb.PointForce(*rng.uniform([[0.1], [0.005], [-3.0]], [[0.28], [0.03], [3.0]], (3, 20)))
    bent = vb.deflect(slim, load)
    points = bent.contact_point.copy()
    points[13] *= [1.0, 2.3, 2.3]
    with pytest.warns(UserWarning, match="1 of 20 .*left out: 13 "):
        found = fit_stiffness(wire, points, wrench_of(bent), taper=True)
    assert found.taper == pytest.approx(0.2, rel=1e-6)


@pytest.mark.parametrize("number", range(2))
def test_any_frame_is_found_from_known_loads(rng, number):
    frame = list(frames(rng, 4))[number]
    force = rng.normal(size=(30, 3)) * 0.2
    loads = np.concatenate([force, np.cross(rng.normal(size=(30, 3)) * 0.05, force)], axis=1)
    noise = np.repeat([1e-3, 1e-5], 3)
    away = []
    for _ in range(30):
        seen = loads @ frame.from_base().T + noise * rng.normal(size=(30, 6))
        found = calibrate_frame(seen, loads, force_noise=1e-3, moment_noise=1e-5)
        assert found.frame.handedness == frame.handedness
        assert found.frame.reaction == frame.reaction
        turn = Rotation.from_matrix(found.frame.axes @ frame.axes.T).as_rotvec()
        error = np.concatenate([turn, found.frame.position - frame.position])
        away.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(away) == pytest.approx(6.0, rel=0.35)


@pytest.mark.filterwarnings("ignore:the residuals are")
def test_covariances_of_frame_offset_and_weight_hold_what_the_misfit_shows(rng):
    """With readings eight times as noisy as stated, as by a table's vibration."""
    stated, actual = Sensor(noise=[3e-3] * 3 + [5e-5] * 3), 8.0
    squared = []
    for frame in frames(rng, 24):
        arms = np.repeat([[0.05, 0.0, 0.0], [0.1, 0.0, 0.0]], 6, axis=0)
        loads = np.tile(np.concatenate([np.eye(3), -np.eye(3)]), (2, 1))
        loads = np.concatenate([loads, np.cross(arms, loads)], axis=1)
        read = loads @ frame.from_base().T + actual * stated.noise * rng.normal(size=(12, 6))
        found = calibrate_frame(read, loads, force_noise=3e-3, moment_noise=5e-5)
        turn = Rotation.from_matrix(found.frame.axes @ frame.axes.T).as_rotvec()
        away = np.concatenate([turn, found.frame.position - frame.position])
        squared.append(away @ np.linalg.solve(found.covariance, away) / 6)
        held = replace(stated, frame=frame, bias=0.1, mass=0.05, mass_moment=(1e-4, 0.0, 2e-4))
        turns = Rotation.random(12, random_state=rng.integers(1 << 30)).as_matrix()
        free = replace(held, noise=actual * stated.noise)
        read = free.read(np.arange(12.0), np.zeros((12, 6)), rng.integers(1 << 30), turns)
        weighed = calibrate_weight(held, read, turns)
        away = np.array([*weighed.sensor.bias - 0.1, weighed.sensor.mass - 0.05])
        known = weighed.covariance[:7, :7]
        squared.append(away @ np.linalg.solve(known, away) / 7)
    for kind in (squared[::2], squared[1::2]):
        assert 0.6 < np.mean(kind) < 1.5


def test_loads_taken_for_readings_are_noticed(rng):
    """The frame would be the inverse one, with equal residuals."""
    frame = SensorFrame(("y", "-x", "z"), (0.01, 0.0, 0.0))
    force = rng.normal(size=(12, 3))
    arms = np.repeat([[0.05, 0.0, 0.0], [0.1, 0.0, 0.0]], 6, axis=0)
    loads = np.concatenate([force, np.cross(arms, force)], axis=1)
    noise = np.repeat([1e-2, 2e-4], 3)
    readings = loads @ frame.from_base().T + noise * rng.normal(size=(12, 6))
    stated = {"force_noise": noise[0], "moment_noise": noise[3]}
    assert calibrate_frame(readings, loads, **stated).misfit < 2.0
    with pytest.warns(UserWarning, match="are `readings` and `wrenches` exchanged"):
        calibrate_frame(loads, readings, **stated)


@pytest.mark.parametrize("wrong", ["columns", "mm"])
def test_moments_that_fit_no_frame_are_not_blamed_on_too_few_loads(rng, wrong):
    pulls = np.tile(2.0 * np.eye(3), (2, 1))
    arms = np.repeat([[0.05, 0.0, 0.0], [0.2, 0.0, 0.0]], 3, axis=0)
    loads = np.concatenate([pulls, np.cross(arms, pulls)], axis=1)
    frame = SensorFrame(Rotation.random(random_state=2).as_matrix(), [2e-3, -3e-3, -0.01])
    noise = np.repeat([3e-3, 8e-5], 3)
    read = loads @ frame.from_base().T + noise * rng.normal(size=loads.shape)
    stated = {"force_noise": noise[0], "moment_noise": noise[3]}
    assert calibrate_frame(read, loads, **stated).misfit < 2.0
    if wrong == "columns":
        loads = loads[:, [1, 0, 2, 3, 4, 5]]
    else:
        loads[:, 3:] *= 1e3
    with pytest.raises(ValueError, match="neither a right-handed sensor nor a left-handed"):
        calibrate_frame(read, loads, **stated)


def test_loads_that_leave_the_frame_open_are_refused(rng):
    force = np.outer(rng.uniform(0.1, 1.0, 10), [0.0, 0.0, 1.0])
    loads = np.concatenate([force, np.zeros((10, 3))], axis=1)
    with pytest.raises(ValueError, match="one line"):
        calibrate_frame(loads, loads, force_noise=1e-3, moment_noise=1e-5)
    force = rng.normal(size=(10, 3)) * [1.0, 1.0, 0.0]
    loads = np.concatenate([force, np.cross([0.0, 0.0, 0.01], force)], axis=1)
    with pytest.raises(ValueError, match="one plane"):
        calibrate_frame(loads, loads, force_noise=1e-3, moment_noise=1e-5)
    for noise in ([1e-3] * 3, np.inf, None):
        with pytest.raises(ValueError, match="force_noise must be one finite number"):
            calibrate_frame(loads, loads, force_noise=noise, moment_noise=1e-5)


def test_offset_and_weight_are_found_from_free_poses(rng):
    true = Sensor(noise=np.repeat([1e-3, 1e-5], 3), bias=rng.normal(size=6), mass=0.03)
    true = Sensor(noise=true.noise, bias=true.bias, mass=0.03, mass_moment=(1e-4, 2e-4, -3e-4))
    turn = Rotation.random(25, random_state=3).as_matrix()
    readings = true.read(np.arange(25.0), np.zeros((25, 6)), seed=1, rotation=turn)
    found = calibrate_weight(Sensor(noise=true.noise), readings, turn)
    away = np.concatenate(
        [
            found.sensor.bias - true.bias,
            [found.sensor.mass - true.mass],
            found.sensor.mass_moment - true.mass_moment,
        ]
    )
    assert away @ np.linalg.solve(found.covariance, away) < 25.0  # χ² of 10
    assert np.abs(found.sensor.compensated(readings, turn)).max() < 5e-3
    tared = calibrate_weight(Sensor(noise=true.noise), readings[:1])
    assert np.abs(tared.sensor.compensated(readings[:1])).max() < 1e-12
    drifted = Sensor(noise=true.noise, bias=true.bias + 0.1, mass=0.03, mass_moment=(1e-4, 0, 0))
    later = drifted.read(np.arange(400.0), np.zeros((400, 6)), rotation=[turn[3]] * 400)
    again = tare(Sensor(noise=true.noise, mass=0.03, mass_moment=(1e-4, 0, 0)), later, turn[3])
    np.testing.assert_allclose(again.bias, drifted.bias, atol=5 * 1e-3 / 20)
    with pytest.raises(ValueError, match="no reading without NaN"):
        tare(Sensor(), np.full((2, 6), np.nan))
    still = np.broadcast_to(turn[0], (25, 3, 3))
    with pytest.raises(ValueError, match="hold the whisker free of contact in more"):
        calibrate_weight(Sensor(), readings, still)


def test_moments_alone_weigh_no_mass(rng):
    true = Sensor(("My", "Mz"), noise=1e-6, bias=[1e-3, 2e-3], mass=0.05, mass_moment=(3e-4, 0, 0))
    turn = Rotation.random(25, random_state=3).as_matrix()
    readings = true.read(np.arange(25.0), np.zeros((25, 6)), rotation=turn)
    found = calibrate_weight(Sensor(("My", "Mz"), noise=1e-6), readings, turn)
    assert found.sensor.mass == 0.0
    np.testing.assert_allclose(found.sensor.mass_moment, true.mass_moment, atol=1e-6)
    assert np.abs(found.sensor.compensated(readings, turn)).max() < 1e-5


def test_stiffness_is_found_as_surely_as_said(wire, touched):
    """The truth is 12 % stiffer; radius known to 2 %, so the modulus to 8 %."""
    sensor = Sensor(noise=np.repeat([0.02, 1e-3], 3))
    stiff = wire.with_properties(youngs_modulus=1.12 * wire.youngs_modulus)
    bent = vb.deflect(stiff, vb.PointContact(touched.contact_point))
    away = []
    for seed in range(30):
        readings = sensor.read(np.arange(60.0), wrench_of(bent), seed)
        found = fit_stiffness(wire, touched.contact_point, readings, sensor)
        true = stiff.base_bending_stiffness
        away.append(np.log(found.stiffness / true) / found.stiffness_sigma)
    assert np.mean(np.square(away)) == pytest.approx(1.0, rel=0.5)
    assert found.misfit == pytest.approx(1.0, rel=0.2)
    assert found.radius == wire.base_radius
    assert found.radius_sigma == 0.02
    expected = np.hypot(4.0 * 0.02, found.stiffness_sigma)
    assert found.modulus_sigma == pytest.approx(expected, rel=1e-9)
    by = np.array([1.0, 4.0])  # what loads do tell
    assert np.sqrt(by @ found.covariance @ by) == pytest.approx(found.stiffness_sigma, rel=1e-6)
    assert found.whisker.base_bending_stiffness == pytest.approx(found.stiffness, rel=1e-12)


def test_errors_of_contact_points_are_part_of_the_uncertainty(wire, touched):
    """Points are known to 1 mm; taken as exact, the mean χ² of the stiffness is above 3."""
    sensor = Sensor(noise=np.repeat([1e-3, 1e-4], 3))
    readings = sensor.read(np.arange(60.0), wrench_of(touched))
    rng = np.random.default_rng(4)
    sigma = np.full(60, 1e-3)
    sigma[::3] = 0.2e-3
    away, misfit = [], []
    for rows in rng.permuted(np.tile(np.arange(60), (12, 1)), axis=1)[:, :20]:
        points = touched.contact_point[rows] + sigma[rows, None] * rng.normal(size=(20, 3))
        found = fit_stiffness(wire, points, readings[rows], sensor, point_sigma=sigma[rows, None])
        away.append(np.log(found.stiffness / wire.base_bending_stiffness) / found.stiffness_sigma)
        misfit.append(found.misfit)
    assert 0.4 < np.mean(np.square(away)) < 2.0
    assert np.mean(misfit) == pytest.approx(1.0, abs=0.2)
    for wrong in (-1e-3, np.full(20, 1e-3), np.nan):
        with pytest.raises(ValueError, match="point_sigma"):
            fit_stiffness(wire, points, readings[rows], sensor, point_sigma=wrong)


def test_an_exact_stiffness_has_an_uncertainty_too(wire, touched):
    """Differences relative to the unknown, the logarithm of 1, would vanish."""
    found = fit_stiffness(
        wire, touched.contact_point[:8], wrench_of(touched)[:8], point_sigma=1e-5, radius_sigma=0.0
    )
    assert found.stiffness == pytest.approx(wire.base_bending_stiffness, rel=1e-9)
    assert 1e-6 < found.stiffness_sigma < 1e-3


def test_prior_uncertainty_decides_what_moves(wire, touched):
    bent = vb.deflect(
        wire.with_properties(youngs_modulus=1.1 * wire.youngs_modulus),
        vb.PointContact(touched.contact_point),
    )
    sensor = Sensor(noise=np.repeat([1e-5, 1e-6], 3))
    given = (wire, touched.contact_point, wrench_of(bent), sensor)
    exact_modulus = fit_stiffness(*given, modulus_sigma=0.0, radius_sigma=np.inf)
    assert exact_modulus.modulus == wire.youngs_modulus
    assert exact_modulus.radius == pytest.approx(1.1**0.25 * wire.base_radius, rel=1e-6)
    both = fit_stiffness(*given, modulus_sigma=0.08, radius_sigma=0.02)
    assert both.modulus == pytest.approx(1.1**0.5 * wire.youngs_modulus, rel=1e-6)
    assert both.stiffness == pytest.approx(1.1 * wire.base_bending_stiffness, rel=1e-6)
    with pytest.raises(ValueError, match="E r⁴ only"):
        fit_stiffness(*given, modulus_sigma=np.inf, radius_sigma=np.inf)
    with pytest.raises(ValueError, match="modulus_sigma is 10; it is relative"):
        fit_stiffness(*given, modulus_sigma=10.0)
    with pytest.raises(ValueError, match="more than the whisker is long"):
        fit_stiffness(*given, point_sigma=1.0)
    with pytest.raises(ValueError, match="no reading with a contact point"):
        fit_stiffness(wire, np.empty((0, 3)), np.empty((0, 6)), sensor)
    with pytest.raises(TypeError, match=r"save_sensor\(path, sensor\) needs a Sensor"):
        save_sensor(sensor, "sensor.toml")


@pytest.mark.slow
def test_taper_is_found_where_contacts_lie_at_several_places(wire, touched):
    sensor = Sensor(noise=np.repeat([1e-3, 1e-4], 3))
    true = wire.with_properties(base_radius=wire.base_radius, tip_radius=0.35e-3)
    bent = vb.deflect(true, vb.PointContact(touched.contact_point))
    readings = sensor.read(np.arange(60.0), wrench_of(bent))
    found = fit_stiffness(wire, touched.contact_point, readings, sensor, taper=True)
    assert abs(np.log(found.taper / 0.7)) < 4.0 * found.taper_sigma
    assert found.taper_sigma < 0.05
    blind = fit_stiffness(wire, touched.contact_point, readings, sensor)
    assert blind.misfit > 3.0


@pytest.mark.slow
def test_the_base_is_found_where_contacts_are_known(wire, touched):
    sensor = Sensor(noise=np.repeat([1e-3, 1e-4], 3))
    unit = wire.base_bending_stiffness / wire.length
    soft = wire.with_properties(base_stiffness=(20.0 * unit, 20.0 * unit))
    bent = vb.deflect(soft, vb.PointContact(touched.contact_point))
    readings = sensor.read(np.arange(60.0), 1.1 * wrench_of(bent))
    found = fit_stiffness(wire, touched.contact_point, readings, sensor, base=True)
    true = 22.0 * unit  # a tenth stiffer, as the wire
    away = 1.0 / found.base_stiffness - 1.0 / true
    assert abs(away) < 4.0 * found.compliance_sigma < 0.4 / true
    assert abs(found.stiffness / (1.1 * wire.base_bending_stiffness) - 1.0) < 0.02
    assert found.whisker.base_stiffness == pytest.approx((found.base_stiffness,) * 2)
    assert fit_stiffness(wire, touched.contact_point, readings, sensor).misfit > 2.0


def test_two_moments_tell_stiffness_too(wire, touched):
    sensor = Sensor(("My", "Mz"), noise=1e-4)
    readings = sensor.read(np.arange(60.0), wrench_of(touched))
    found = fit_stiffness(wire, touched.contact_point, readings, sensor)
    away = np.log(found.stiffness / wire.base_bending_stiffness) / found.stiffness_sigma
    assert abs(away) < 4.0
    with pytest.raises(ValueError, match="do not increase with the loads: check"):
        fit_stiffness(wire, touched.contact_point, -readings, sensor)


def test_a_weight_that_comes_out_negative_is_said(rng):
    """Far from zero it is a fault of sign; within noise there is no mass."""
    turn = Rotation.random(25, random_state=3).as_matrix()
    noise = np.repeat([1e-3, 1e-5], 3)
    heavy = Sensor(noise=noise, mass=0.03)
    readings = heavy.read(np.arange(25.0), np.zeros((25, 6)), rotation=turn)
    with pytest.raises(ValueError, match=r"weigh -30 ± .* g.*reaction"):
        calibrate_weight(Sensor(noise=noise), readings, turn, gravity=(0.0, 0.0, 9.81))
    bias = rng.normal(size=6)
    empty = Sensor(noise=noise, bias=bias)
    found = [
        calibrate_weight(
            Sensor(noise=noise), empty.read(np.arange(25.0), np.zeros((25, 6)), seed), turn
        )
        for seed in range(6)
    ]
    weightless = [one for one in found if one.sensor.mass == 0.0]
    assert 0 < len(weightless) < 6
    for one in weightless:
        assert not one.covariance[6].any()
        away = one.sensor.bias - bias
        assert away @ np.linalg.solve(one.covariance[:6, :6], away) < 25.0


def test_contacts_that_are_not_known_are_left_out(wire, touched):
    readings = wrench_of(touched)[:, [4, 5]]
    points = touched.contact_point.copy()
    points[3] = np.nan
    found, clean = (
        calibrate_on_contacts(wire, p, y, components=("My", "Mz"))
        for p, y in (
            (points, readings),
            (np.delete(points, 3, axis=0), np.delete(readings, 3, axis=0)),
        )
    )
    np.testing.assert_allclose(found.sensor.mixing, clean.sensor.mixing, rtol=1e-9)
    with pytest.raises(ValueError, match="none of 60 rows"):
        calibrate_on_contacts(wire, np.full((60, 3), np.nan), readings)
    with pytest.raises(ValueError, match=r"points are \(n, 3\)"):
        calibrate_on_contacts(wire, points[:, :2], readings)


def test_contacts_that_leave_something_open_are_refused_by_name(wire):
    """All in one plane, all at one place, too few."""
    flat = vb.deflect(wire, vb.PointForce(np.linspace(0.1, 0.3, 20), 0.03, np.zeros(20)))
    readings = np.zeros((20, 2))
    with pytest.raises(ValueError, match="do not depend on Fz, My: touch the whisker at other"):
        calibrate_on_contacts(
            wire, flat.contact_point, readings, components=("Fy", "Fz", "My", "Mz")
        )
    with pytest.raises(ValueError, match="3 equations do not determine 5 unknowns: touch"):
        calibrate_on_contacts(
            wire, flat.contact_point[:3], readings[:3], components=("Fy", "Fz", "My", "Mz")
        )


@pytest.mark.parametrize(
    ("time", "said"), [([0.0, 0.2, 0.1], "0.1 s after 0.2 s"), ([0.0, np.nan, 1.0], "nan s")]
)
def test_time_that_falls_or_is_not_finite_is_refused(time, said):
    with pytest.raises(ValueError, match=said):
        Sensor(drift=1e-6).read(time, np.zeros((3, 6)))
    with pytest.raises(ValueError, match=r"wrenches \(n, 6\) are needed"):
        Sensor().read(np.arange(3.0), np.zeros((2, 6)))


def test_a_saturated_reading_tells_nothing(tmp_path):
    sensor = Sensor(("My", "Mz"), noise=1e-9, bias=[0.5, 0.0], largest=[1.0, np.inf])
    readings = sensor.read(np.arange(3.0), np.outer([0.1, 0.4, 3.0], [0, 0, 0, 0, 1.0, 1.0]))
    assert readings[2, 0] == 1.0
    felt = sensor.compensated(readings)
    np.testing.assert_allclose(felt[:2, 0], [0.1, 0.4], atol=1e-7)
    assert np.isnan(felt[2, 0])
    assert np.isfinite(felt[:, 1]).all()
    save_sensor(tmp_path / "sensor.toml", sensor)
    np.testing.assert_array_equal(load_sensor(tmp_path / "sensor.toml").largest, sensor.largest)
    with pytest.raises(ValueError, match=r"largest is 0\.0; it must be positive"):
        Sensor(largest=0.0)


def test_a_makers_matrix_may_be_given_either_way_round(tmp_path, rng):
    """Volts per N and N·m of a sensor of 2 cm: its readings per N·m are the larger ones."""
    mixing = rng.normal(size=(6, 6)) * np.repeat([0.02, 1.0], 3)
    path = tmp_path / "sensor.toml"

    def described(**matrices):
        names = ", ".join(f'"ch{i}"' for i in range(6))
        lines = [f"{name} = {matrix.tolist()}" for name, matrix in matrices.items()]
        path.write_text("\n".join([f"channels = [{names}]", "noise = 1e-3", *lines]))
        return load_sensor(path)

    back = np.linalg.inv(mixing)
    np.testing.assert_allclose(described(mixing=mixing).mixing, mixing)
    np.testing.assert_allclose(described(calibration=back).mixing, mixing, rtol=1e-9)
    with pytest.raises(ValueError, match="name it calibration"):
        described(mixing=back)
    with pytest.raises(ValueError, match="name it mixing"):
        described(calibration=mixing)
    with pytest.raises(ValueError, match="one of them"):
        described(calibration=back, mixing=mixing)
    with pytest.raises(ValueError, match="no inverse"):
        described(calibration=np.diag([1.0, 1, 1, 1e-2, 1e-2, 0]))
    with pytest.raises(ValueError, match="six rows"):
        described(calibration=back[:3])


@pytest.mark.parametrize("name", ["mixing", "calibration"])
def test_a_sensor_that_hardly_reads_moments_is_doubted(name, tmp_path):
    """A channel for each component, 12 N or 0.5 N·m per volt, with the matrix the other way."""
    matrix = np.diag([12.0, 12.0, 16.0, 0.5, 0.5, 0.4])
    path = tmp_path / "sensor.toml"

    def described(matrix):
        channels = [f"ch{i}" for i in range(6)]
        path.write_text(f"channels = {channels}\nnoise = 1e-3\n{name} = {matrix.tolist()}")
        return load_sensor(path)

    given = np.linalg.inv(matrix) if name == "calibration" else matrix
    with pytest.warns(UserWarning, match="is the matrix the inverse"):
        described(given)
    assert described(np.linalg.inv(given)).mixing[0, 0] == pytest.approx(1.0 / 12.0)


def test_a_sensor_far_from_the_whisker_is_doubted(tmp_path):
    path = tmp_path / "sensor.toml"
    for away in (0.02, 20.0):
        path.write_text(f"noise = 1e-3\n[frame]\nposition = [{away}, 0.0, 0.0]")
        if away < 1.0:
            assert load_sensor(path).frame.position[0] == away
            continue
        with pytest.warns(UserWarning, match="position is 20 m from the base of the whisker: is"):
            load_sensor(path)


def test_a_mixing_keeps_saturation_and_resolution(rng):
    """Saturated rows would tilt the mix, and rounding is not counted as noise twice."""
    true = Sensor(("a",), [[0, 0, 0, 0, 1.0, 0]], noise=1e-3, resolution=0.02, largest=[1.0])
    wrenches = np.zeros((400, 6))
    wrenches[:, 4] = rng.uniform(-1.5, 1.5, 400)
    readings = true.read(np.arange(400.0), wrenches, seed=3)
    found = calibrate_mixing(
        readings, wrenches, components=("My",), resolution=0.02, largest=1.0
    ).sensor
    assert found.mixing[0, 4] == pytest.approx(1.0, abs=5e-3)
    assert found.resolution[0] == 0.02
    assert found.largest[0] == 1.0
    assert found.noise[0] < 3e-3
    plain = calibrate_mixing(readings, wrenches, components=("My",)).sensor
    assert plain.mixing[0, 4] < 0.95


def test_channels_may_read_in_any_unit(rng):
    """Mixing converts them; components themselves are in SI units."""
    wrenches = rng.normal(size=(50, 6)) * ([1e-3] * 3 + [1e-5] * 3)
    values = 1e3 * wrenches + rng.normal(size=(50, 6)) * 1e-6
    readings = xr.DataArray(values, dims=("time", "channel"), attrs={"units": "mN, N·mm"})
    found = calibrate_mixing(readings, wrenches, channels=[f"c{i}" for i in range(6)])
    assert np.allclose(np.diag(found.sensor.mixing), 1e3, rtol=0.01)
    assert np.isfinite(found.sensor.compensated(readings)).all()
    with pytest.raises(ValueError, match="readings is stated in mN"):
        Sensor().compensated(readings)


def test_components_in_other_units_need_one_number(rng):
    wrench = rng.normal(size=(3, 6))
    sensor = Sensor(mixing=1e3, noise=1e-9)  # mN and mN·m
    np.testing.assert_allclose(sensor.read(np.arange(3.0), wrench), 1e3 * wrench, rtol=1e-6)
    two = Sensor(("Fx", "Mz"), mixing=[1e3, 1e6])
    assert (two.mixing[0, 0], two.mixing[1, 5], np.count_nonzero(two.mixing)) == (1e3, 1e6, 2)
    with pytest.raises(ValueError, match="one number per channel"):
        Sensor(("Fx", "Mz"), mixing=[1e3, 1e3, 1e3])


def test_usual_mistakes_of_calibrations_are_said(wire, touched, rng):
    """Another unit, rotations the wrong way, a base taken for the tip, a diameter for a radius."""
    noise = np.repeat([1e-3, 1e-5], 3)
    loads = rng.normal(size=(12, 6))
    with pytest.raises(ValueError, match=r"1e\+03 times the loads"):
        calibrate_frame(1e3 * loads, loads, force_noise=1e-3, moment_noise=1e-5)
    turn = Rotation.random(25, random_state=3).as_matrix()
    heavy = Sensor(noise=noise, mass=0.03, mass_moment=(3e-4, 0, 0), largest=[9.0, *5 * [8.0]])
    readings = heavy.read(np.arange(25.0), np.zeros((25, 6)), rotation=turn)
    with pytest.warns(UserWarning, match="from the whisker frame to the laboratory frame"):
        calibrate_weight(Sensor(noise=noise), readings, turn.transpose(0, 2, 1))
    with pytest.warns(UserWarning, match="carry 30 kg"):
        calibrate_weight(Sensor(noise=1e3 * noise), 1e3 * readings, turn)
    in_mn = Sensor(mixing=1e3, noise=1e3 * noise)
    with pytest.warns(UserWarning, match="are the readings and the sensor's noise in the same"):
        calibrate_weight(in_mn, readings, turn)
    readings[0, 0] = 9.0  # saturated
    assert calibrate_weight(replace(heavy, mass=0.0), readings, turn).misfit < 2.0
    points, wrench = touched.contact_point, wrench_of(touched)
    thin = wire.with_properties(base_radius=0.25e-3, tip_radius=0.5e-3)
    assert "thicker than the base" in repr(thin)
    with pytest.warns(UserWarning, match="which end is the base"):
        fit_stiffness(thin, points, wrench, Sensor(noise=noise))
    thick = wire.scaled(radius_factor=2.0)
    with pytest.warns(UserWarning, match=r"is 0\.0625 times .* whether the radius is a diameter"):
        fit_stiffness(thick, points, wrench, Sensor(noise=noise), modulus_sigma=0.1)


def test_a_sensor_file_can_be_looked_into(tmp_path):
    frame = SensorFrame(("x", "-z", "-y"), (-0.03, 0.0, 0.0))
    save_sensor(tmp_path / "s.toml", Sensor(("My",), mixing=1e3, noise=0.1, frame=frame, mass=0.01))
    said = CliRunner().invoke(app, ["info", str(tmp_path / "s.toml")]).output
    for part in ("1000 My + 0, noise 0.1", "left-handed, origin at (-30.00", "10 g"):
        assert part in said
