"""Errors of gain, mixing and calibration are the same in all readings, and in the covariances."""

from dataclasses import replace

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.sensors import Sensor, calibrate_mixing, load_sensor, save_sensor
from vibrissa.signals import SIGNALS

NOISE = np.repeat([1e-6, 2e-8], 3)
TRIALS = 400
SETS = ["Fx MB MD", "FT MB MD", "Fx FT MB MD", " ".join(SIGNALS)]


@pytest.fixture(scope="module")
def bent(gamma_map):
    """A contact well away from rest and from slip."""
    load = vb.PointForce(0.65 * gamma_map.whisker.length, 5e-5, 2.0)
    return vb.deflect(gamma_map.whisker, load)


@pytest.fixture(scope="module")
def wrench(bent):
    return np.concatenate([bent.force, bent.moment])


def gauges(rng, rows):
    """Strain gauges that mix components; three read mostly Fx, My and Mz."""
    mostly = np.eye(6)[[0, 4, 5]] if rows == 3 else np.zeros((rows, 6))
    return (mostly + (0.1 if rows == 3 else 1.0) * rng.normal(size=(rows, 6))) / (10.0 * NOISE)


def nees(points, covariances, truth):
    """Errors squared, in standard deviations, of the candidate that is nearest in those."""
    away = points - truth
    solved = np.linalg.solve(covariances, away[..., None])[..., 0]
    return np.nanmin((away * solved).sum(axis=-1), axis=-1, initial=np.inf)


def is_three(values):
    """Whether their mean is three within statistics, which must be good enough to tell."""
    values = np.asarray(values)
    known = values[np.isfinite(values)]
    error = known.std() / np.sqrt(known.size)
    return known.size > 0.95 * values.size and error < 0.3 and abs(known.mean() - 3.0) < 4.0 * error


def located(estimator, reading, truth):
    found = estimator(reading)
    return nees(found.candidates.point, found.candidates.covariance, truth)


@pytest.mark.parametrize(
    ("which", "channels"),
    [
        ("gain", 3),
        ("mixing", 8),
        ("calibration", 3),
        *(
            pytest.param(which, channels, marks=pytest.mark.slow)
            for which, channels in (("gain", 6), ("gain", 8), ("mixing", 3), ("calibration", 8))
        ),
    ],
)
def test_a_wrong_matrix_makes_errors_as_stated(gamma_map, bent, wrench, rng, channels, which):
    """In each trial the sensor's matrix is wrong anew, by 1 %."""
    mixing = gauges(rng, channels)
    sensor = Sensor([f"c{i}" for i in range(channels)], mixing, noise=0.02)
    variances = np.pad((0.01 * mixing) ** 2, ((0, 0), (0, 1)))
    stated = {
        "gain": {"gain_error": 0.01},
        "mixing": {"mixing_error": 0.01 * np.abs(mixing)},
        "calibration": {"mixing_covariance": variances[:, :, None] * np.eye(7)},
    }
    known = vb.Estimator.of_sensor(gamma_map, replace(sensor, **stated[which]))
    unaware = vb.Estimator.of_sensor(gamma_map, sensor)
    away, narrow = [], []
    for _ in range(TRIALS):
        relative = 0.01 * rng.normal(size=(channels, 1 if which == "gain" else 6))
        reading = mixing * (1.0 + relative) @ wrench + 0.02 * rng.normal(size=channels)
        away.append(located(known, reading, bent.contact_point))
        narrow.append(located(unaware, reading, bent.contact_point))
    assert is_three(away)
    assert np.nanmean(narrow) > 10.0


@pytest.mark.parametrize("which", ["gain", "mixing"])
@pytest.mark.parametrize("names", SETS)
def test_stated_errors_of_components_are_in_the_covariance(gamma_map, bent, wrench, names, which):
    """In batches and one at a time alike; of cross-talk all is drawn, forces among themselves."""
    rng = np.random.default_rng(7)
    stated = {f"{which}_sigma": 0.005}
    noise = np.diag((0.05 * NOISE) ** 2)
    away = rng.normal(size=(TRIALS, 6)) if which == "gain" else rng.normal(size=(TRIALS, 6, 6))
    wrong = 0.005 * away * wrench
    if which == "mixing":
        wrong = (wrong * np.kron(np.eye(2), np.ones((3, 3)))).sum(axis=-1)
    measured = wrench + wrong + 0.05 * NOISE * rng.normal(size=(TRIALS, 6))
    signals = vb.base_signals(measured[:, :3], measured[:, 3:])
    found = gamma_map.estimate(signals, names, noise, **stated)
    assert is_three(nees(found.candidates.point, found.candidates.covariance, bent.contact_point))
    unaware = gamma_map.estimate(signals, names, noise)
    narrow = nees(unaware.candidates.point, unaware.candidates.covariance, bent.contact_point)
    assert np.median(narrow) > 5.0
    locate = vb.Estimator(gamma_map, names, noise, **stated)
    rows = np.stack([signals[name] for name in names.split()], axis=-1)
    for i in range(0, TRIALS, 40):
        one = locate(rows[i])
        sigma = np.sqrt(np.trace(one.covariance))
        assert np.linalg.norm(found.point[i] - one.point) < 2e-3 * sigma
        np.testing.assert_allclose(found.covariance[i], one.covariance, atol=0.01 * sigma**2)


@pytest.mark.parametrize("stated", ["stiffness_sigma", "gain_sigma", "mixing_sigma"])
def test_stated_errors_are_in_the_covariance_of_a_whole_wrench(gamma_map, stated):
    rng = np.random.default_rng(8)
    whisker = gamma_map.whisker
    load = vb.PointForce(0.6 * whisker.length, components=(5e-6, 4e-5, 1e-5))
    bent = vb.deflect(whisker, load)
    wrench = np.concatenate([bent.force, bent.moment])
    shape = {"stiffness_sigma": (1,), "gain_sigma": (6,), "mixing_sigma": (6, 6)}[stated]
    wrong = 0.005 * rng.normal(size=(TRIALS, *shape)) * wrench
    if stated == "mixing_sigma":
        wrong = (wrong * np.kron(np.eye(2), np.ones((3, 3)))).sum(axis=-1)
    measured = wrench + wrong + 0.05 * NOISE * rng.normal(size=(TRIALS, 6))
    given = (whisker, measured[:, :3], measured[:, 3:])
    noise = np.diag((0.05 * NOISE) ** 2)
    found = vb.estimate_from_wrench(*given, noise=noise, **{stated: 0.005})
    narrow = vb.estimate_from_wrench(*given, noise=noise)
    one = (slice(None), None)
    assert is_three(nees(found.point[one], found.covariance[one], bent.contact_point))
    assert np.mean(nees(narrow.point[one], narrow.covariance[one], bent.contact_point)) > 6.0


def test_covariances_along_bent_valleys_hold_what_they_state(gamma_map):
    """They were wide enough for one region only, and none was valid: kurtosis was the judge."""
    rng = np.random.default_rng(8)
    load = vb.PointForce(0.85 * gamma_map.whisker.length, components=(1e-6, 1e-5, 2e-6))
    bent = vb.deflect(gamma_map.whisker, load)
    wrench = np.concatenate([bent.force, bent.moment])
    measured = wrench * (1.0 + 0.001 * rng.normal(size=(1000, 1)))
    measured += 0.05 * NOISE * rng.normal(size=(1000, 6))
    found = vb.estimate_from_wrench(
        gamma_map.whisker,
        measured[:, :3],
        measured[:, 3:],
        noise=np.diag((0.05 * NOISE) ** 2),
        stiffness_sigma=0.001,
    )
    assert found.covariance_valid.mean() > 0.9
    squares = nees(found.point[:, None], found.covariance[:, None], bent.contact_point)
    assert 0.93 < (squares < 7.81).mean() < 0.985
    assert (squares > 14.16).mean() < 0.006


@pytest.mark.slow
def test_a_calibration_from_data_is_as_sure_as_it_says(gamma_map, bent, wrench, rng, tmp_path):
    """Each trial calibrates anew by a few known loads, by way of a file; then a contact is felt."""
    mixing = gauges(rng, 6)
    true = Sensor([f"c{i}" for i in range(6)], mixing, noise=0.02, bias=rng.normal(size=6))
    away, narrow = [], []
    for trial in range(80):
        loads = rng.normal(size=(30, 6)) * np.repeat([5e-6, 1e-7], 3)
        readings = true.read(np.arange(30.0), loads, seed=trial)
        save_sensor(tmp_path / "sensor.toml", calibrate_mixing(readings, loads).sensor)
        sensor = load_sensor(tmp_path / "sensor.toml")
        reading = true.read([0.0], wrench[None], seed=1000 + trial)[0]
        surely = replace(sensor, mixing_covariance=None)
        for one, out in ((sensor, away), (surely, narrow)):
            estimator = vb.Estimator.of_sensor(gamma_map, one)
            out.append(located(estimator, reading, bent.contact_point))
    assert np.mean(away) == pytest.approx(3.0, abs=4.0 * np.std(away) / np.sqrt(len(away)))
    assert np.mean(narrow) > 10.0


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 30])
def test_a_filter_does_not_average_an_error_of_gain_away(gamma_map, bent, wrench, number):
    """After many samples of a contact that stands still the covariance holds the error."""
    rng = np.random.default_rng(9)
    noise = np.diag((0.3 * NOISE) ** 2)
    locate = vb.Estimator(gamma_map, SIGNALS, noise, gain_sigma=0.02)
    follow = vb.ContactFilter(locate, speed=1e-4)
    away = []
    for _ in range(30):
        gain = 1.0 + 0.02 * rng.normal(size=6)
        follow.reset()
        for i in range(number):
            one = gain * wrench + 0.3 * NOISE * rng.normal(size=6)
            signals = vb.base_signals(one[:3], one[3:])
            found = follow(1e-3 * i, [float(signals[name]) for name in SIGNALS])
        e = found.point - bent.contact_point
        away.append(e @ np.linalg.solve(found.covariance, e))
    assert np.mean(away) == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / len(away)))


def test_what_is_stated_is_checked(gamma_map):
    noise = np.diag(NOISE**2)
    with pytest.raises(ValueError, match="give its noise"):
        vb.Estimator(gamma_map, gain_sigma=0.01)
    with pytest.raises(ValueError, match=r"gain_sigma is one .* shape \(6,\); got \[0.1, 0.1\]"):
        vb.Estimator(gamma_map, noise=noise, gain_sigma=[0.1, 0.1])
    with pytest.raises(ValueError, match="mixing_sigma is a relative standard deviation"):
        vb.Estimator(gamma_map, noise=noise, mixing_sigma=-0.1)
    for wrong, message in (
        ({"gain_error": -0.1}, "gain_error is -0.1"),
        ({"mixing_error": np.ones((2, 6))}, r"\(6, 6\) is needed"),
        ({"mixing_covariance": np.ones((6, 6))}, r"finite \(6, 7, 7\) is needed"),
        ({"mixing_covariance": np.tile(-np.eye(7), (6, 1, 1))}, "negative eigenvalues"),
        ({"mixing_covariance": np.tile(np.eye(7)[::-1], (6, 1, 1))}, "negative eigenvalues"),
        ({"mixing_covariance": np.tile(np.eye(7, k=1), (6, 1, 1))}, "not symmetric"),
    ):
        with pytest.raises(ValueError, match=message):
            Sensor(**wrong)


@pytest.mark.parametrize("using", [" ".join(SIGNALS), "Fx FT FD MB MD"])
def test_errors_far_above_the_noise_leave_regions_as_stated(gamma_map, using):
    """Of a whisker 5 % stiffer or softer, by a sensor so good that this is all of the error."""
    rng, length = np.random.default_rng(3), gamma_map.whisker.length
    arc = rng.uniform(0.35, 0.9, 400) * length
    size = 3e-3 * (0.35 * length / arc) ** 5 * rng.uniform(0.3, 1.0, 400)
    load = vb.PointForce(arc, size, rng.uniform(-np.pi, np.pi, 400))
    bent = vb.deflect(gamma_map.whisker, load)
    sigma, stiffer = np.repeat([1e-7, 2e-9], 3), 1.0 + 0.05 * rng.normal(size=(400, 1))
    wrench = stiffer * np.concatenate([bent.force, bent.moment], axis=1)
    wrench += sigma * rng.normal(size=wrench.shape)
    signals = vb.base_signals(wrench[:, :3], wrench[:, 3:])
    found = gamma_map.estimate(signals, using, np.diag(sigma**2), stiffness_sigma=0.05)
    sure = found.covariance_valid & (found.status == vb.Status.UNIQUE)
    assert sure.mean() > 0.8
    away = (found.point - bent.contact_point)[sure]
    squares = (away * np.linalg.solve(found.covariance[sure], away[..., None])[..., 0]).sum(axis=1)
    assert np.mean(squares < 7.81) > 0.92
    assert squares.max() < 25.0
