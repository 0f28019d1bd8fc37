"""A sensor reads the wrench with the errors that it was given."""

import numpy as np
import pytest

from vibrissa import samples
from vibrissa.io import load_recording, save_recording
from vibrissa.sensors import Sensor
from vibrissa.simulation import facing_peg, measure, simulate, sweep_past

TIME = np.arange(4000) / 1000.0
WRENCH = np.random.default_rng(0).normal(size=(4000, 6)) * [1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6]


@pytest.fixture(scope="module")
def trial():
    whisker = samples.gamma()
    peg = facing_peg(whisker)
    return simulate(whisker, sweep_past(whisker, peg, duration=0.2, rate=200.0), peg)


def test_a_perfect_sensor_reads_the_wrench():
    np.testing.assert_array_equal(Sensor(noise=0.0).read(TIME, WRENCH), WRENCH)


def test_white_noise_is_as_strong_as_it_says():
    error = Sensor(noise=[1e-6, 2e-6, 3e-6, 1e-8, 2e-8, 3e-8]).read(TIME, WRENCH) - WRENCH
    expected = np.array([1e-6, 2e-6, 3e-6, 1e-8, 2e-8, 3e-8])
    np.testing.assert_allclose(error.std(axis=0), expected, rtol=0.06)


def test_bias_and_gain_are_constant_and_relative_noise_grows_with_the_signal():
    still = np.zeros((4000, 6))
    bias = np.arange(6.0) * 1e-6
    np.testing.assert_allclose(Sensor(noise=0.0, bias=bias).read(TIME, still), still + bias)
    gain = Sensor(noise=0.0, gain_error=0.05).read(TIME, WRENCH, seed=2) / WRENCH - 1.0
    np.testing.assert_allclose(gain, np.broadcast_to(gain[0], gain.shape), atol=1e-12)
    assert 0.005 < np.abs(gain[0]).max() < 0.2
    relative = Sensor(noise=0.0, relative_noise=0.1).read(TIME, WRENCH) / WRENCH - 1.0
    assert relative.std() == pytest.approx(0.1, rel=0.03)


def test_drift_is_a_random_walk():
    drift = Sensor(noise=0.0, drift=1e-6)
    ends = [drift.read(TIME, np.zeros((4000, 6)), seed)[[0, 1000, 3999]] for seed in range(60)]
    first, second, last = np.moveaxis(np.array(ends), 1, 0)
    assert (first == 0.0).all()
    # 360 walks: their spread is known to 4 %.
    assert second.std() == pytest.approx(1e-6, rel=0.12)
    assert last.std() == pytest.approx(2e-6, rel=0.12)


def test_readings_are_rounded():
    reading = Sensor(noise=0.0, resolution=[1e-5] * 3 + [0.0] * 3).read(TIME, WRENCH)
    steps = reading[:, :3] / 1e-5
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert np.abs(reading - WRENCH).max() <= 0.5e-5 * (1.0 + 1e-9)
    np.testing.assert_array_equal(reading[:, 3:], WRENCH[:, 3:])


def test_some_channels_and_mixes_of_them(trial, tmp_path):
    mixing = np.zeros((2, 6))
    mixing[0, 1], mixing[0, 5], mixing[1, 4] = 1.0, -100.0, 50.0
    robot = Sensor(channels=("strain a", "strain b"), mixing=mixing, noise=0.0)
    measured = measure(trial, sensor=robot)
    truth = trial["truth"]
    wrench = np.concatenate([truth["force"].values, truth["moment"].values], axis=-1)[:, 0]
    np.testing.assert_allclose(measured["reading"].values[:, 0], wrench @ mixing.T)
    assert "force" not in measured.data_vars
    save_recording(tmp_path / "robot.nc", measured)
    read = load_recording(tmp_path / "robot.nc")
    np.testing.assert_array_equal(read["mixing"].values, mixing)
    assert list(read["channel"].values) == ["strain a", "strain b"]
    some = measure(trial, sensor=Sensor(channels=("Fx", "Mz")))
    error = some["reading"].values[:, 0] - wrench[:, [0, 5]]
    np.testing.assert_allclose(error.std(axis=0), [1e-6, 0.02e-6], rtol=0.5)


def test_missing_frames_stay_missing():
    wrench = np.where(np.arange(4000)[:, None] == 7, np.nan, WRENCH)
    reading = Sensor(drift=1e-6, resolution=1e-9).read(TIME, wrench)
    assert np.isnan(reading).all(axis=1).sum() == 1


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"channels": ("Fx", "Q")}, "not among Fx"),
        ({"noise": -1.0}, "noise is -1"),
        ({"bias": [1.0, 2.0]}, r"bias has shape \(2,\)"),
        ({"channels": ("a",), "mixing": np.eye(6)}, r"mixing has shape \(6, 6\)"),
        ({"gain_error": -0.1}, "gain_error is"),
    ],
)
def test_faults(given, message):
    with pytest.raises(ValueError, match=message):
        Sensor(**given)
