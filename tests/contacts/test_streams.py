"""Streams of any readings: mixes of components, fewer than three signals, uncertain stiffness."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vibrissa as vb
from vibrissa.sensors import Sensor, SensorFrame
from vibrissa.signals import SIGNALS


@pytest.fixture(scope="module")
def bent(gamma_map):
    """A contact that glides along the whisker and around it while it is pushed harder."""
    t = np.linspace(0.0, 1.0, 60)
    load = vb.PointForce((0.9 - 0.4 * t) * gamma_map.whisker.length, 1e-5 + 6e-5 * t, 0.5 + 2.5 * t)
    return vb.deflect(gamma_map.whisker, load)


def wrench_of(bent):
    return np.concatenate([bent.force, bent.moment], axis=-1)


NOISE = np.repeat([1e-6, 2e-8], 3)


@pytest.mark.parametrize("names", ["Fx MB MD", "Fx FT MB", "Fx FT FD MB MD", " ".join(SIGNALS)])
def test_a_stream_finds_the_same_as_a_cold_start(gamma_map, bent, names):
    """All candidates of each sample, whether the sample before is known or not."""
    signals = vb.base_signals(bent.force, bent.moment)
    rows = np.stack([signals[name] for name in names.split()], axis=-1)
    noise = np.diag(NOISE**2)
    stream, cold = (vb.Estimator(gamma_map, names, noise) for _ in range(2))
    for row in rows:
        cold.reset()
        warm, anew = stream(row), cold(row)
        assert warm.status == anew.status
        np.testing.assert_allclose(warm.candidates.point, anew.candidates.point, atol=1e-9)
        np.testing.assert_allclose(warm.covariance, anew.covariance, rtol=1e-5, atol=1e-18)


def test_a_sensor_of_six_components_is_the_same_as_the_signals(gamma_map, bent):
    """Left-handed, off centre, reporting the reaction, biased and carrying a mass."""
    frame = SensorFrame(("-y", "x", "-z"), (1e-3, -2e-3, 3e-3), reaction=True)
    assert frame.handedness == -1
    sensor = Sensor(
        noise=NOISE,
        bias=1e-3 * np.arange(6),
        frame=frame,
        mass=1e-3,
        mass_moment=(1e-6, 0.0, 2e-6),
    )
    turn = Rotation.random(len(bent.force), random_state=1).as_matrix()
    quiet = Sensor(
        noise=0.0, bias=sensor.bias, frame=frame, mass=1e-3, mass_moment=sensor.mass_moment
    )
    readings = quiet.read(np.arange(len(turn)), wrench_of(bent), rotation=turn)
    covariance = sensor.to_wrench(readings, turn)[1]
    by_sensor = vb.Estimator.of_sensor(gamma_map, sensor)
    by_name = vb.Estimator(gamma_map, SIGNALS, covariance)
    signals = vb.base_signals(bent.force, bent.moment)
    for i in range(0, len(turn), 5):
        one = by_sensor(readings[i], turn[i])
        other = by_name([float(signals[name][i]) for name in SIGNALS])
        assert one.status == other.status
        np.testing.assert_allclose(one.point, other.point, atol=1e-8)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-4)
        assert np.linalg.norm(one.point - bent.contact_point[i]) < 1e-8


@pytest.mark.parametrize("channels", [3, 4, 8])
def test_any_mix_of_components_locates_contacts(gamma_map, bent, channels):
    rng = np.random.default_rng(channels)
    mixing = rng.normal(size=(channels, 6)) / np.repeat([1e-5, 2e-7], 3)
    noise = rng.uniform(0.5, 1.5, channels) * 1e-3
    sensor = Sensor([f"c{i}" for i in range(channels)], mixing, noise)
    readings = wrench_of(bent) @ mixing.T
    locate = vb.Estimator.of_sensor(gamma_map, sensor)
    for i, reading in enumerate(readings):
        found = locate(reading)
        assert found.status in (vb.Status.UNIQUE, vb.Status.AMBIGUOUS)
        away = np.linalg.norm(found.candidates.point - bent.contact_point[i], axis=1)
        assert away.min() < 1e-8
        # Each candidate does give these readings.
        moment = np.cross(found.candidates.point, found.candidates.force)
        seen = np.concatenate([found.candidates.force, moment], axis=1) @ mixing.T
        assert np.abs((seen - reading) / noise).max() < 4.0
        np.testing.assert_allclose(seen[away.argmin()], reading, rtol=1e-4)


def test_scatter_of_a_mix_is_as_stated(gamma_map, bent):
    rng = np.random.default_rng(0)
    mixing = rng.normal(size=(4, 6)) / np.repeat([1e-5, 2e-7], 3)
    sensor = Sensor("abcd", mixing, 2e-3)
    locate = vb.Estimator.of_sensor(gamma_map, sensor)
    reading = wrench_of(bent)[40] @ mixing.T
    away = []
    for noise in rng.normal(size=(300, 4)) * 2e-3:
        found = locate(reading + noise)
        i = np.linalg.norm(found.candidates.point - bent.contact_point[40], axis=1).argmin()
        e = found.candidates.point[i] - bent.contact_point[40]
        away.append(e @ np.linalg.solve(found.candidates.covariance[i], e))
    assert np.mean(away) == pytest.approx(3.0, rel=0.2)


def test_readings_that_no_contact_gives(gamma_map):
    sensor = Sensor(("Fx", "Fy", "Mz", "My"), noise=[1e-6, 1e-6, 2e-8, 2e-8])
    locate = vb.Estimator.of_sensor(gamma_map, sensor)
    assert locate(np.zeros(4)).status == vb.Status.DEGENERATE
    assert locate([np.nan, 0.0, 0.0, 0.0]).status == vb.Status.MISSING
    assert locate([1.0, 1.0, 1.0, 1.0]).status == vb.Status.OUTSIDE_MAP
    assert locate([5e-5, -5e-5, 1e-6, -1e-6]).status == vb.Status.NOT_FRICTIONLESS


@pytest.mark.parametrize("how", ["My Mz", "MB MD", "Fx MB", "FT Mx"])
def test_two_signals_leave_a_curve_that_passes_through_the_contact(gamma_map, bent, how):
    names = how.split()
    if names[0] == "My":
        locate = vb.Estimator.of_sensor(gamma_map, Sensor(names, noise=2e-8))
        rows = bent.moment[:, 1:]
    else:
        signals = vb.base_signals(bent.force, bent.moment)
        rows = np.stack([signals[name] for name in names], axis=-1)
        locate = vb.Estimator(gamma_map, how, np.diag(NOISE**2))
    for i in range(5, 60, 9):
        found = locate(rows[i])
        assert found.status == vb.Status.UNDERDETERMINED
        assert found.n_candidates >= 4
        moment = np.cross(found.candidates.point, found.candidates.force)
        seen = np.concatenate([found.candidates.force, moment], axis=1)
        if names[0] == "My":
            back = seen[:, 4:]
        else:
            known = vb.base_signals(found.candidates.force, moment)
            back = np.stack([known[name] for name in names], axis=-1)
        np.testing.assert_allclose(
            back, np.broadcast_to(rows[i], back.shape), rtol=1e-5, atol=1e-14
        )
        # The true contact lies between neighbours along the curve.
        away = np.linalg.norm(found.candidates.point - bent.contact_point[i], axis=1)
        along = found.candidates.point[np.argsort(found.candidates.arc_length)]
        assert away.min() < np.linalg.norm(np.diff(along, axis=0), axis=1).max()
        e = bent.contact_point[i] - found.point
        assert e @ np.linalg.solve(found.covariance, e) < 20.0


def test_one_signal_leaves_a_surface(gamma_map, bent):
    locate = vb.Estimator(gamma_map, "MB", {"MB": 2e-8})
    size = np.hypot(bent.moment[30, 1], bent.moment[30, 2])
    found = locate([size])
    assert found.status == vb.Status.UNDERDETERMINED
    assert found.n_candidates > 30
    moment = np.cross(found.candidates.point, found.candidates.force)
    np.testing.assert_allclose(np.hypot(moment[:, 1], moment[:, 2]), size, rtol=1e-5)
    # All around the whisker, and all along it.
    assert np.ptp(found.candidates.arc_length) > 0.5 * gamma_map.whisker.length
    assert np.abs(found.candidates.point[:, 1:].mean(axis=0)).max() < 0.4 * gamma_map.whisker.length


def test_a_mix_that_tells_two_numbers_only_says_so(gamma_map, bent):
    mixing = np.zeros((3, 6))
    mixing[0, 4], mixing[1, 5], mixing[2, 4:] = 1.0, 1.0, (0.5, 2.0)
    locate = vb.Estimator.of_sensor(gamma_map, Sensor("abc", mixing, 1e-8))
    found = locate(mixing @ wrench_of(bent)[20])
    assert found.status == vb.Status.UNDERDETERMINED


@pytest.mark.parametrize(
    ("names", "given"),
    [
        ("Fx MB MD", "deviations"),
        (" ".join(SIGNALS), "covariance"),
        pytest.param("Fx MB MD", "covariance", marks=pytest.mark.slow),
        pytest.param(" ".join(SIGNALS), "deviations", marks=pytest.mark.slow),
    ],
)
def test_uncertain_stiffness_is_in_the_covariance(gamma_map, bent, names, given):
    """Whiskers 5 % stiffer or softer than the map's give contacts that scatter as stated."""
    rng = np.random.default_rng(6)
    noise = np.diag((0.3 * NOISE) ** 2)
    if given == "deviations":
        signals = vb.base_signals(bent.force[40], bent.moment[40])
        noise = {n: (3e-7 if n[0] == "F" else 6e-9) for n in ("Fx", "FT", "Mx", "MB")}
        noise |= {"FD": 3e-7 / float(signals["FT"]), "MD": 6e-9 / float(signals["MB"])}
    locate = vb.Estimator(gamma_map, names, noise, stiffness_sigma=0.05)
    narrow = vb.Estimator(gamma_map, names, noise)
    wrench = wrench_of(bent)[40]
    away, unaware = [], []
    for _ in range(300):
        one = (1.0 + 0.05 * rng.normal()) * wrench + 0.3 * NOISE * rng.normal(size=6)
        signals = vb.base_signals(one[:3], one[3:])
        row = [float(signals[name]) for name in names.split()]
        for estimator, out in ((locate, away), (narrow, unaware)):
            found = estimator(row)
            e = found.point - bent.contact_point[40]
            out.append(e @ np.linalg.solve(found.covariance, e))
    assert np.nanmean(away) == pytest.approx(3.0, rel=0.25)
    assert np.nanmean(unaware) > 10.0
    batch = gamma_map.estimate(
        dict(zip(names.split(), row, strict=True)), names, noise, stiffness_sigma=0.05
    )
    last = locate(row)
    # Weights depend on the contact, so they are settled to a share of the noise only.
    sigma = np.sqrt(np.trace(last.covariance))
    assert np.linalg.norm(batch.point - last.point) < 2e-3 * sigma
    np.testing.assert_allclose(batch.covariance, last.covariance, atol=0.01 * sigma**2)


def test_uncertain_stiffness_needs_noise(gamma_map):
    with pytest.raises(ValueError, match="give its noise"):
        vb.Estimator(gamma_map, stiffness_sigma=0.1)
    with pytest.raises(ValueError, match="from 0 to 1"):
        vb.Estimator(gamma_map, noise=np.diag(NOISE**2), stiffness_sigma=-0.1)
    with pytest.raises(ValueError, match="c1 has none"):
        vb.Estimator.of_sensor(gamma_map, Sensor(("c0", "c1"), np.eye(2, 6), [1.0, 0.0]))
    with pytest.raises(ValueError, match="read nothing"):
        vb.Estimator.of_sensor(gamma_map, Sensor(("c0",), np.zeros((1, 6)), 1.0))
