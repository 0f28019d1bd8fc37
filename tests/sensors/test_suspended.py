"""A whisker on a compliant suspension: model, calibration, sweeps, by contacts of `deflect`."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli.app import app
from vibrissa.sensors import (
    Stage,
    StageSweep,
    SuspendedWhisker,
    ThinPlate,
    calibrate_suspension,
    follow_sweep,
    load_sensor,
    load_suspended,
)
from vibrissa.whisker import Pose

WIRE = vb.Whisker.parabola(
    50e-3, 4.0, base_radius=1e-4, tip_radius=1e-4, youngs_modulus=200e9, poisson_ratio=0.3
)
EI, LENGTH = WIRE.base_bending_stiffness, WIRE.length
TURN, SHIFT = 0.4 * LENGTH / EI, 3e-3 * LENGTH**3 / EI
CHANNELS = ("sx", "sy", "sz")
RNG = np.random.default_rng(0)
# Counts by rotation (rad), shift over L, and products of rotations: a magnet over a Hall sensor.
READOUT = np.concatenate(
    [
        np.zeros((3, 1)),
        RNG.normal(scale=4000.0, size=(3, 3)),
        RNG.normal(scale=9000.0, size=(3, 3)),
        RNG.normal(scale=3000.0, size=(3, 6)),
    ],
    axis=1,
)
TRUE = SuspendedWhisker(
    WIRE, TURN, SHIFT, [0.5e-3, 1e-3, 0.0], 0.0, CHANNELS, READOUT, noise=[5.0, 5.0, 5.0]
)


def points(number, seed=1):
    """Points that a probe can push the wire to."""
    rng = np.random.default_rng(seed)
    rest = WIRE.position(rng.uniform(0.25, 0.8, number) * LENGTH)
    angle, size = rng.uniform(-np.pi, np.pi, number), rng.uniform(0.02, 0.25, number)
    aside = np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    return rest + size[:, None] * np.linalg.norm(rest, axis=1)[:, None] * aside


def test_rotation_agrees_with_a_whisker_whose_base_is_a_spring():
    soft = replace(WIRE, base_stiffness=(1.0 / TURN, 1.0 / TURN))
    at = points(20)
    bent = vb.deflect(soft, vb.PointContact(at), proximal=0.1)
    sensor = SuspendedWhisker(WIRE, TURN, 0.0)
    contacts, status = sensor.solve(at)
    good = bent.status == vb.Status.OK
    assert good.sum() >= 15
    np.testing.assert_array_equal(status[good], int(vb.Status.OK))
    np.testing.assert_allclose(contacts[good, 0] * LENGTH, bent.arc_length[good], rtol=2e-4)
    turned = sensor.touches(contacts).features[good, 1:4]
    np.testing.assert_allclose(turned, TURN * bent.moment[good], atol=2e-4)


def test_shift_is_that_of_a_rigid_base_moved_by_the_force():
    sensor = SuspendedWhisker(WIRE, 0.0, SHIFT)
    at = points(20)
    contacts, _ = sensor.solve(at)
    force = sensor.touches(contacts).force * EI / LENGTH**2
    bent = vb.deflect(WIRE, vb.PointContact(at - SHIFT * force), proximal=0.1)
    good = bent.status == vb.Status.OK
    assert good.sum() >= 15
    np.testing.assert_allclose(force[good], bent.force[good], atol=1e-5 * np.abs(force).max())


def test_a_pivot_off_the_base_is_a_rotation_about_the_base_and_a_shift():
    about = np.array([0.0, 3e-3, 0.0])
    sensor = SuspendedWhisker(WIRE, TURN, 0.0, about)
    touch = sensor.touches(np.array([[0.6, 0.5, 0.3]]))
    turn = vb.whisker.Pose().rotation + 0.0
    angle = touch.features[0, 1:4]
    size = np.linalg.norm(angle)
    axis = angle / size
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = turn + np.sin(size) * cross + (1.0 - np.cos(size)) * cross @ cross
    plain = SuspendedWhisker(WIRE, 0.0, 0.0).touches(np.array([[0.6, 0.5, 0.3]]))
    moved = about + turn @ (plain.points[0] * LENGTH - about)
    np.testing.assert_allclose(touch.points[0] * LENGTH, moved, atol=1e-12)
    moment = np.cross(plain.points[0] * LENGTH - about, plain.force[0] * EI / LENGTH**2)
    np.testing.assert_allclose(angle, TURN * moment, rtol=1e-12)


@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_derivatives_are_those_of_differences(friction):
    sensor = replace(TRUE, friction=friction, residual=plate())
    at = np.array([[0.4, 0.8, 0.2], [0.7, -0.5, 0.6]])
    touch, step = sensor.touches(at), 1e-5
    _, slopes = sensor.readings(touch)
    for k in range(3):
        ahead, back = (sensor.touches(at + sign * step * np.eye(3)[k]) for sign in (1, -1))
        change = (ahead.points - back.points) / (2 * step)
        np.testing.assert_allclose(change, touch.point_slopes[:, :, k], atol=2e-6)
        change = (sensor.readings(ahead)[0] - sensor.readings(back)[0]) / (2 * step)
        np.testing.assert_allclose(change, slopes[:, :, k], rtol=1e-4, atol=1e-2)


def plate():
    at = points(60, seed=5)
    return ThinPlate.fit(at, 1e3 * np.sin(60.0 * at), ratio=1e-9)


def test_a_thin_plate_passes_through_its_data_and_fills_the_gaps():
    at = points(200, seed=5)
    values = np.sin(60.0 * at)
    exact = ThinPlate.fit(at, values, ratio=1e-10)
    np.testing.assert_allclose(exact(at)[0], values, atol=1e-5)
    noisy = values + np.random.default_rng(2).normal(scale=0.05, size=values.shape)
    found = ThinPlate.fit(at, noisy)
    assert np.all((found.noise > 0.025) & (found.noise < 0.1))
    between = points(50, seed=6)
    assert np.sqrt(np.mean((found(between)[0] - np.sin(60.0 * between)) ** 2)) < 0.05


@pytest.mark.slow
def test_two_compliances_are_found_where_the_pivot_is_the_base():
    plain, at = replace(TRUE, pivot=np.zeros(3)), points(60)
    found = calibrate_suspension(WIRE, at, plain.read(at, seed=3)[0], free=2)
    assert found.names == ("log rotation compliance", "log shift compliance")
    off = np.abs(found.values - np.log([0.4, 3e-3]))
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(off < 3.0 * sigma), (off, sigma)
    assert sigma[0] < 0.5
    assert found.undetermined == ()
    np.testing.assert_array_less(found.sensor.noise, 10.0)


def test_calibration_recovers_compliances_and_predicts_to_the_noise():
    at = points(90)
    readings, status = TRUE.read(at, seed=3)
    assert (status == int(vb.Status.OK)).mean() > 0.8
    found = calibrate_suspension(WIRE, at, readings, channels=CHANNELS, free=5)
    truth = np.array([np.log(0.4), np.log(3e-3), 0.01, 0.02, 0.0])
    off = found.values - truth
    assert np.all(np.abs(off) < 4.0 * np.sqrt(np.diag(found.covariance)))
    assert np.all(np.abs(off) < [1.0, 2.5, 0.1, 0.1, 0.1])
    np.testing.assert_array_less(found.sensor.noise, 12.0)
    others = points(80, seed=9)
    expected, good = TRUE.read(others)
    predicted, _ = found.sensor.read(others)
    rows = (good == int(vb.Status.OK)) & np.isfinite(predicted).all(axis=1)
    assert np.sqrt(np.mean((predicted - expected)[rows] ** 2)) < 8.0


def test_what_touches_do_not_determine_is_named():
    straight = np.array(
        [WIRE.position(0.5 * LENGTH) + np.array([0, 1e-3 * k, 0]) for k in range(1, 31)]
    )
    readings, _ = TRUE.read(straight, seed=1)
    found = calibrate_suspension(WIRE, straight, readings, free=11)
    assert "base x / L" in found.undetermined


@pytest.mark.slow
def test_a_touch_that_is_far_from_all_others_is_left_out():
    at = points(60)
    readings, status = TRUE.read(at, seed=3)
    good = np.flatnonzero(status == int(vb.Status.OK))
    wrong = good[[7, 30]]
    slipped = readings.copy()
    slipped[wrong, 1] += np.array([0.2, -0.25]) * np.ptp(readings[good, 1])
    others = points(80, seed=9)
    expected, _ = TRUE.read(others)

    def error(calibration):
        return np.sqrt(np.nanmean((calibration.sensor.read(others)[0] - expected) ** 2))

    clean = calibrate_suspension(WIRE, at, readings, free=5)
    found = calibrate_suspension(WIRE, at, slipped, free=5)
    assert not clean.outliers.any()
    np.testing.assert_array_equal(np.flatnonzero(found.outliers), wrong)
    assert not found.used[wrong].any()
    assert error(found) < 1.3 * error(clean)


def test_too_few_or_idle_touches_are_refused():
    at = points(30)
    readings, _ = TRUE.read(at)
    with pytest.raises(ValueError, match="too few"):
        calibrate_suspension(WIRE, at[:10], readings[:10])
    with pytest.raises(ValueError, match="sy"):
        calibrate_suspension(WIRE, at, readings * [1, 0, 1], channels=CHANNELS)
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        calibrate_suspension(WIRE, at[:, :2], readings)
    for sigma in (0.15, -1e-3, np.nan):
        with pytest.raises(ValueError, match=r"base_sigma is .* m; more than 0"):
            calibrate_suspension(WIRE, at, readings, base_sigma=sigma)
    with pytest.raises(ValueError, match=r"0 of 30 touches.* Are origin, axes and unit"):
        calibrate_suspension(WIRE, at + 0.05, readings)


def swept(steps=80):
    """A wire on a spring, carried past a cylinder; contact points by `deflect`, and positions."""
    soft = replace(WIRE, base_stiffness=(1.0 / TURN, 1.0 / TURN))
    radius, axis = 6e-3, np.array([30e-3, 6e-3 + WIRE.position(30e-3)[1], 0.0])
    base = np.stack(
        [np.linspace(0, 4e-3, steps), np.linspace(-3e-3, 7e-3, steps), 0 * np.arange(steps)]
    )
    base = base.T
    peg = vb.PegContact(axis - base, [0.0, 0.0, 1.0], radius=radius, side=[0.0, -1.0, 0.0])
    bent = vb.deflect(soft, peg, proximal=0.2)
    return base, axis, radius, bent


def read_by_spring(bent):
    """Sensor and readings of a wire on a spring, with noise of 5 counts."""
    sensor = replace(TRUE, shift_compliance=0.0, pivot=np.zeros(3), noise=[10.0, 10.0, 10.0])
    on = bent.status == vb.Status.OK
    theta = np.where(on[:, None], TURN * bent.moment, 0.0)
    i, j = np.triu_indices(3)
    n = len(theta)
    features = np.concatenate(
        [np.ones((n, 1)), theta, np.zeros((n, 3)), theta[:, i] * theta[:, j]], axis=1
    )
    noise = np.random.default_rng(0).normal(scale=5.0, size=(n, 3))
    return sensor, features @ READOUT.T + noise, on


def test_a_sweep_finds_onset_contact_points_and_normals():
    base, axis, radius, bent = swept()
    sensor, readings, on = read_by_spring(bent)
    assert 30 < on.sum() < 80
    found = follow_sweep(sensor, readings, base)
    both = found.in_contact & on
    assert not (found.in_contact & ~on).any()
    assert both.sum() >= on.sum() - 8
    gap = np.linalg.norm((found.points - axis)[both][:, :2], axis=1) - radius
    sigma = np.sqrt(
        np.einsum("ki,kij,kj->k", found.normal[both], found.covariance[both], found.normal[both])
    )
    assert np.abs(gap).max() < 0.3e-3
    assert np.median(np.abs(gap)) < 0.1e-3
    assert np.mean((gap / sigma) ** 2) < 2.0
    away = found.points[both] - (bent.contact_point[both] + base[both])
    assert np.median(np.linalg.norm(away, axis=1)) < 1e-3
    outward = (found.points[both] - axis)[:, :2] / radius
    assert np.median(np.abs(np.sum(outward * found.normal[both][:, :2], axis=1))) > 0.98


def test_a_sweep_of_nothing_or_with_another_rest_is_refused():
    with pytest.raises(ValueError, match="got 0 readings"):
        follow_sweep(TRUE, np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(ValueError, match=r"rest \(3,\) or \(5, 3\) is needed; got \(2,\)"):
        follow_sweep(TRUE, np.zeros((5, 3)), np.zeros((5, 3)), rest=[0.0, 0.0])


def test_contacts_do_not_depend_on_how_often_samples_are_taken():
    """The same motion and readings, four times as many samples: nothing new is known."""
    base, _, _, bent = swept()
    sensor, readings, _ = read_by_spring(bent)
    often = np.linspace(0, len(base) - 1, 4 * (len(base) - 1) + 1)

    def between(values):
        return np.stack([np.interp(often, np.arange(len(values)), v) for v in values.T], axis=1)

    few = follow_sweep(sensor, readings, base)
    many = follow_sweep(sensor, between(readings), between(base))
    rows = np.flatnonzero(few.in_contact)[5:-5]
    assert many.in_contact[4 * rows].all()
    spread = np.einsum("kii->ki", few.covariance[rows]) ** 0.5
    ratio = np.einsum("kii->ki", many.covariance[4 * rows]) ** 0.5 / spread
    away = np.abs(many.points[4 * rows] - few.points[rows]) / spread
    assert 0.85 < np.median(ratio) < 1.15
    assert np.median(away) < 0.2


def test_contacts_do_not_depend_on_where_the_search_starts(monkeypatch):
    """For a sensor that explains the readings badly, which converges slowly."""
    base, _, _, bent = swept()
    sensor, readings, on = read_by_spring(bent)
    off = replace(sensor, shift_compliance=SHIFT, pivot=[1e-3, 3e-3, -1e-3], drift=40.0)
    readings = readings + on[:, None] * np.array([1.0, -1.0, 1.0])
    found = []
    for start in (0.45, 0.85):
        monkeypatch.setattr("vibrissa.sensors.suspended._STARTS", (start,))
        found.append(follow_sweep(off, readings, base, rest=np.zeros(3)).points)
    assert np.nanmax(np.abs(found[0] - found[1])) < 1e-7


def test_rest_may_be_stated_for_each_sample_of_a_sweep():
    base, _, _, bent = swept()
    sensor, readings, on = read_by_spring(bent)
    drifting = np.linspace(0.0, 80.0, len(base))[:, None] * np.array([0.0, 1.0, -1.0])
    true = follow_sweep(sensor, readings, base, rest=np.zeros(3))
    found = follow_sweep(sensor, readings + drifting, base, rest=drifting)
    np.testing.assert_allclose(found.points[on], true.points[on], atol=1e-6)
    unknown = follow_sweep(sensor, readings + drifting, base, rest=np.zeros(3))
    both = on & unknown.in_contact & true.in_contact
    assert np.linalg.norm((unknown.points - true.points)[both], axis=1).max() > 0.2e-3


def test_drift_between_recordings_is_in_the_covariance():
    """Readings that are 60 counts off: where that is stated, errors are as predicted."""
    base, _, _, bent = swept()
    sensor, readings, on = read_by_spring(bent)
    readings = readings + 60.0 * on[:, None] * np.array([1.0, -1.0, 1.0])

    def squared_over_predicted(sensor):
        found = follow_sweep(sensor, readings, base)
        both = found.in_contact & on
        away = (found.points - bent.contact_point - base)[both][:, :2]
        spread = found.covariance[both][:, :2, :2]
        return np.mean(np.einsum("ki,kij,kj->k", away, np.linalg.inv(spread), away)) / 2.0

    assert squared_over_predicted(sensor) > 3.0
    assert squared_over_predicted(replace(sensor, drift=60.0)) < 1.5
    with pytest.raises(ValueError, match="drift"):
        replace(sensor, drift=[1.0, 2.0])


def test_an_error_that_all_readings_share_moves_contacts_as_their_shared_errors_state():
    base, _, _, bent = swept()
    sensor, readings, on = read_by_spring(bent)
    found = follow_sweep(sensor, readings, base)
    both = found.in_contact & on
    moved = follow_sweep(sensor, readings + 10.0 * on[:, None] * np.array([1.0, -1.0, 1.0]), base)
    away = (moved.points - found.points)[both].ravel()
    shared = found.shared[:, both].reshape(len(found.shared), -1)
    amount = np.linalg.lstsq(shared.T, away, rcond=None)[0]
    assert np.linalg.norm(away - amount @ shared) < 0.3 * np.linalg.norm(away)
    assert np.abs(amount).max() < 3.0  # standard deviations
    own = found.covariance - np.einsum("mka,mkb->kab", found.shared, found.shared)
    assert np.linalg.eigvalsh(own[both]).min() > -1e-6 * np.abs(found.covariance[both]).max()
    assert not found.shared[:, ~found.in_contact].any()


@pytest.mark.slow
def test_with_many_touches_a_process_takes_what_the_rod_leaves():
    at = points(110)
    readings = TRUE.read(at, seed=3)[0]
    found = calibrate_suspension(WIRE, at, readings, drift=[1.0, 2.0, 3.0], free=5)
    assert len(found.names) == 5
    assert found.sensor.residual is not None
    np.testing.assert_array_equal(found.sensor.drift, [1.0, 2.0, 3.0])


@pytest.mark.slow
def test_the_pose_is_free_where_the_base_is_not_where_it_is_stated():
    """Chosen by regions that are left out; the readings elsewhere are then predicted better."""
    at = points(110)
    readings = TRUE.read(at, seed=3)[0]
    moved = replace(WIRE, pose=Pose(np.eye(3), [0.0, 1.0e-3, 0.5e-3]))
    found = calibrate_suspension(moved, at, readings, base_sigma=1e-3)
    assert "base y / L" in found.names
    others = points(60, seed=9)
    expected = TRUE.read(others)[0]
    fixed = calibrate_suspension(moved, at, readings, base_sigma=1e-3, free=2)

    def error(calibration):
        return np.sqrt(np.nanmean((calibration.sensor.read(others)[0] - expected) ** 2))

    assert error(found) < 0.6 * error(fixed)


STAGE = """
readings = ["sx", "sy", "sz"]
position = ["px", "py", "pz"]
[touches]
file = "touches.csv"
origin = [10, 20, 30]
axes = ["y", "x", "-z"]
[[shape]]
file = "top.csv"
columns = {x = "py", y = "px"}
[[shape]]
file = "side.csv"
columns = {x = "py", z = "pz"}
[sweep]
moves = "sensor"
"""


def written(folder, at, readings, text=STAGE):
    """Tables of touches and of the shape, and their description, in a folder."""
    # The stage's x is the sensor's y, its z points down.
    stage = np.array([10.0, 20.0, 30.0]) + 1e3 * at[:, [1, 0, 2]] * [1, 1, -1]
    rest = np.array([[10.0, 20.0, 30.0, 1.0, 2.0, 3.0]])
    table = np.concatenate([rest, np.concatenate([stage, readings + np.array([1, 2, 3])], axis=1)])
    header = "px,py,pz,sx,sy,sz"
    np.savetxt(folder / "touches.csv", table, delimiter=",", header=header, comments="")
    line = 1e3 * WIRE.centerline(40)
    shown = {"top.csv": line[:, [1, 0]], "side.csv": line[:, [0, 2]]}
    names = {"top.csv": "px,py", "side.csv": "py,pz"}
    for name, columns in shown.items():
        np.savetxt(folder / name, columns, delimiter=",", header=names[name], comments="")
    (folder / "stage.toml").write_text(text)
    return ["calibrate", str(folder / "stage.toml"), "-o", str(folder / "s.nc")], header


def test_a_channel_that_saturates_is_said_and_can_be_left_out(tmp_path):
    at = points(36)
    readings, status = TRUE.read(at, seed=4)
    readings, at = readings[status == 0], at[status == 0]
    most = np.quantile(np.abs(readings[:, 0]), 0.7)
    clipped = np.clip(readings, [-most, -np.inf, -np.inf], [most, np.inf, np.inf])
    command, _ = written(tmp_path, at, clipped)
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    said = " ".join(done.output.split())
    assert "sx reads" in said
    assert "does it saturate" in said
    assert "much noise of sx:" in said
    text = STAGE.replace("[[shape]]", f"largest = [{most - 1.5}, 1e9, 1e9]\n[[shape]]", 1)
    touches = Stage(text, tmp_path).touches()
    assert len(touches.points) == (np.abs(readings[:, 0] + 1.0) < most - 1.5).sum()
    with pytest.raises(ValueError, match="or one per channel"):
        Stage(text.replace(", 1e9]", "]"), tmp_path).touches()


@pytest.mark.slow
def test_the_command_line_names_touches_that_are_left_out(tmp_path):
    at = points(36)
    readings, status = TRUE.read(at, seed=4)
    readings, at = readings[status == 0], at[status == 0]
    readings[4, 2] += 0.3 * np.ptp(readings[:, 2])
    command, _ = written(tmp_path, at, readings)
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    said = " ".join(done.output.split())
    assert f"{len(at) - 1} touches; left out as far from all others: 5 (" in said


def test_the_command_line_goes_from_tables_to_contacts(tmp_path):
    at = points(60)
    readings, status = TRUE.read(at, seed=4)
    readings, at = readings[status == 0], at[status == 0]
    command, header = written(tmp_path, at, readings)
    run = CliRunner().invoke
    done = run(app, command)
    assert done.exit_code == 0, done.output
    sensor, known = load_suspended(tmp_path / "s.nc")
    assert known.channels == CHANNELS
    predicted, _ = sensor.read(at)
    expected, _ = TRUE.read(at)
    assert np.sqrt(np.nanmean((predicted - expected - [1, 2, 3]) ** 2)) < 60.0
    base = np.stack([np.linspace(0, 4, 40), np.linspace(-3, 7, 40), np.zeros(40)], axis=1)
    read = np.tile([1.0, 2.0, 3.0], (40, 1))
    read[20:] += np.linspace(100.0, 600.0, 20)[:, None]
    sweep = np.concatenate([base, read], axis=1)
    np.savetxt(tmp_path / "w.csv", sweep, delimiter=",", header=header, comments="")
    given = ["estimate", str(tmp_path / "w.csv"), "--sensor", str(tmp_path / "s.nc")]
    done = run(app, [*given, "-o", str(tmp_path / "c.csv")])
    assert done.exit_code == 0, done.output
    contacts = np.genfromtxt(tmp_path / "c.csv", delimiter=",", names=True)
    assert contacts.size == 40
    assert not contacts["in_contact"][:19].any()
    assert np.isfinite(contacts["x"]).sum() == contacts["in_contact"].sum() >= 18
    done = run(app, [*given, "-o", str(tmp_path / "c.nc")])
    assert done.exit_code == 0, done.output
    recording = vb.load_recording(tmp_path / "c.nc")
    assert recording["contact_shared"].sizes["error"] >= 3
    point = recording["estimates"]["contact_point"].values[:, 0]
    np.testing.assert_allclose(point[:, 0], contacts["x"], atol=1e-9)
    said = run(app, ["info", str(tmp_path / "c.nc")]).output
    assert "40 frames, without times" in said
    assert "estimates (missing: contour)" in said
    with pytest.warns(UserWarning, match="do not fit the shape"):
        vb.io.save_recording(tmp_path / "c.nc", vb.pipeline.with_contour(recording, "plane"))
    assert "next: vibrissa report" in run(app, ["info", str(tmp_path / "c.nc")]).output
    done = run(app, ["report", str(tmp_path / "c.nc")])
    assert "vibrissa signals" not in done.output
    given[1] = str(tmp_path / "touches.csv")
    done = run(app, [*given, "-o", str(tmp_path / "t.csv")])
    assert "has the touches of the calibration; a sweep is needed" in str(done.exception)
    given[1] = str(tmp_path / "w.csv")
    for name, step in (("stage.toml", "calibrate"), ("s.nc", "estimate SWEEP.csv --sensor")):
        done = run(app, ["info", str(tmp_path / name)])
        assert f"next: vibrissa {step}" in done.output
    with pytest.raises(ValueError, match="only for sweeps"):
        load_sensor(tmp_path / "s.nc")
    # Positions in other units, missing readings, and readings in other units.
    wrong = [sweep.copy() for _ in range(3)]
    wrong[0][:, :3] *= 1e3
    wrong[1][7, 4] = np.nan
    wrong[2][:, 3:] /= 1e3
    said = ["unit of the positions", "missing in 1 samples (from 0: 7)", "units of the calibration"]
    for table, what in zip(wrong, said, strict=True):
        np.savetxt(tmp_path / "w.csv", table, delimiter=",", header=header, comments="")
        done = run(app, [*given, "-o", str(tmp_path / "c.csv"), "--force"])
        assert what in f"{done.exception} {' '.join(done.output.split())}"


def test_a_unit_or_an_origin_that_cannot_be_right_is_named(tmp_path):
    at = points(30)
    written(tmp_path, at, TRUE.read(at)[0])
    for unit in ("m", "um"):
        with pytest.raises(ValueError, match=f"the unit '{unit}' right"):
            Stage(f"unit = '{unit}'\n{STAGE}", tmp_path).whisker()
    text = STAGE.replace("[10, 20, 30]\n", "[0, 0, 0]\nfarthest = 10\n")
    with pytest.raises(ValueError, match=r"no row is a touch; probes are 3\d.* mm from the base"):
        Stage(text, tmp_path).touches()


def test_the_recording_of_a_sweep_gives_the_object():
    """Contacts by `deflect` along 1.6 mm of a cylinder, which there is nearly a plane."""
    base, _, _, bent = swept()
    sensor, readings, on = read_by_spring(bent)
    found = follow_sweep(sensor, readings, base)
    sweep = StageSweep(readings, base, np.eye(3))
    recording = vb.pipeline.swept_recording(sensor, sweep, found)
    alone = recording.copy(deep=False)
    alone.dataset = alone.to_dataset().drop_dims("error")
    fit, less = (
        vb.contour.shape_from_dataset(vb.pipeline.reconstruct(one, "plane"))
        for one in (recording, alone)
    )
    true = (bent.contact_point + base)[on].mean(axis=0)
    normal = fit.normal
    away = np.dot(fit.origin - true, normal)
    spread = [np.sqrt(np.trace(one.covariance)) for one in (fit, less)]
    assert abs(normal[1]) > 0.99
    assert abs(away) < 0.2e-3
    assert spread[0] > spread[1]  # what contacts share is not averaged away


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (("[sweep]", "[swept]"), "swept"),
        (('moves = "sensor"', 'moves = "table"'), "moves"),
        (("unit", "unit"), None),
        (('"px", "py", "pz"', '"px", "py"'), "position"),
    ],
)
def test_a_wrong_description_is_refused(change, named, tmp_path):
    if named is None:
        text, named = 'unit = "inch"\n' + STAGE, "inch"
    else:
        text = STAGE.replace(*change)
    np.savetxt(
        tmp_path / "w.csv", np.zeros((3, 6)), delimiter=",", header="px,py,pz,sx,sy,sz", comments=""
    )
    with pytest.raises(ValueError, match=named):
        Stage(text, tmp_path).sweep(tmp_path / "w.csv")


@pytest.mark.parametrize(
    ("stated", "drift"),
    [("", [0, 0, 0]), ("rest = [0, 0, 4]", [1, 2, 1]), ("drift = [4, 5, 6]", [4, 5, 6])],
)
def test_drift_is_stated_or_seen_at_the_base(stated, drift, tmp_path):
    """Rows with the probe at the base read what the free wire reads in this recording."""
    rows = [[10, 20, 30, 1, 2, 3], [10, 20, 30, 1, 2, 3], [12, 21, 30, 9, 9, 9]]
    header = "px,py,pz,sx,sy,sz"
    np.savetxt(tmp_path / "touches.csv", rows, delimiter=",", header=header, comments="")
    touches = Stage(STAGE.replace("[[shape]]", f"{stated}\n[[shape]]", 1), tmp_path).touches()
    np.testing.assert_array_equal(touches.drift, drift)
    assert len(touches.points) == 1


def test_a_pose_moves_the_base_in_the_sensors_frame():
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = replace(
        TRUE, whisker=replace(WIRE, pose=Pose(turn, [1e-3, 2e-3, 3e-3])), pivot=[-1e-3, 0.5e-3, 0.0]
    )
    at = np.array([[0.5, 0.6, -0.2]])
    plain = TRUE.touches(at)
    np.testing.assert_allclose(
        moved.touches(at).points[0] * LENGTH, turn @ plain.points[0] * LENGTH + [1e-3, 2e-3, 3e-3]
    )
