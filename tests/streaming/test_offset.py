"""The offset of a sensor that drifts is followed while the whisker is free, and noticed if not."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli.app import app
from vibrissa.contacts import Estimator
from vibrissa.sensors import Sensor
from vibrissa.streaming import ContactStream, advice
from vibrissa.streaming.offset import Offset

NAMES = "Fx", "My", "Mz"
NOISE = np.array([1e-6, 2e-8, 2e-8])
DRIFT = 5.0 * NOISE / np.sqrt(60.0)  # five standard deviations of the noise in a minute
STEP = 0.02


@pytest.fixture(scope="module")
def gamma_map():
    return vb.ContactMap.simulate(vb.samples.gamma(), grid=False)


@pytest.fixture(scope="module")
def touches(gamma_map):
    """Readings (n, 3) of a minute with a contact of a second in every four, and its points."""
    load = vb.PointForce(np.full(50, 25e-3), 8e-5 * np.sin(np.pi * (np.arange(50) + 0.5) / 50), 1.0)
    bent = vb.deflect(gamma_map.whisker, load)
    wrench = np.concatenate([bent.force, bent.moment], axis=1)[:, [0, 4, 5]]
    free = np.zeros((150, 3))
    readings = np.tile(np.concatenate([free, wrench]), (15, 1))
    points = np.tile(np.concatenate([free * np.nan, bent.contact_point]), (15, 1))
    return readings, points


def answered(gamma_map, readings, drift):
    sensor = Sensor(NAMES, noise=NOISE, drift=drift)
    estimator = Estimator.of_sensor(gamma_map, sensor.with_new_offset(20), felt_above=5.0)
    running = ContactStream(estimator, NAMES, tare=20)
    rows = [dict(zip(NAMES, row.tolist(), strict=True)) for row in readings]
    lines = [json.dumps({"time": STEP * i} | row) for i, row in enumerate(rows)]
    return running, list(running.records(lines))


def drifted(readings, kind, speed=1.0):
    rng, time = np.random.default_rng(4), STEP * np.arange(len(readings))
    if kind == "linear":
        drift = speed * time[:, None] / 60.0 * 5.0 * NOISE * [1.0, -1.0, 1.0]
    else:
        drift = np.cumsum(rng.normal(size=readings.shape) * np.sqrt(STEP) * DRIFT, axis=0)
    return readings + drift + rng.normal(size=readings.shape) * NOISE


@pytest.mark.parametrize("kind", ["linear", pytest.param("walk", marks=pytest.mark.slow)])
def test_a_stated_drift_is_followed(gamma_map, touches, kind):
    readings, points = touches
    running, records = answered(gamma_map, drifted(readings, kind), DRIFT)
    free = np.isnan(points[:, 0])
    free[:20] = False
    assert {one["status"] for one, away in zip(records, free, strict=True) if away} == {"not_felt"}
    assert running.events["onset"] == 15
    squared = [
        away @ np.linalg.solve(np.array(one["covariance"]), away)
        for one, true in zip(records, points, strict=True)
        if one["status"] == "unique" and np.linalg.norm(one["force"]) > 3e-5
        for away in [np.array([one[name] for name in "xyz"]) - true]
    ]
    assert len(squared) > 400
    assert 0.2 < np.mean(squared) / 3.0 < 1.6
    assert not advice(running)


def test_after_a_long_contact_a_drifted_offset_is_not_taken_for_one(gamma_map, touches):
    readings = touches[0].copy()
    readings[:1500] = 0.0
    readings[100:1400] = touches[0][175]
    _, records = answered(gamma_map, drifted(readings, "linear", 4.0), 2.0 * DRIFT)
    statuses = np.array([one["status"] for one in records])
    assert (statuses[110:1400] == "unique").all()
    free = np.isnan(touches[1][:, 0])
    free[:1400], free[1400:1500] = False, True
    assert (statuses[free] == "not_felt").all()
    touching = np.linalg.norm(readings / NOISE, axis=1) > 30.0
    assert (statuses[1500:][touching[1500:]] == "unique").all()


def test_a_drift_that_is_not_stated_is_noticed(gamma_map, touches):
    running, records = answered(gamma_map, drifted(touches[0], "linear"), 0.0)
    free = np.isnan(touches[1][2000:, 0])
    felt = [one["status"] != "not_felt" for one in records[2000:]]
    assert np.mean(np.array(felt)[free]) > 0.1
    assert any("state (a larger) drift" in sentence for sentence in advice(running))
    quiet, _ = answered(gamma_map, drifted(touches[0][:1000], "linear"), 0.0)
    assert not advice(quiet)


@pytest.mark.parametrize("off", [0.0, pytest.param(2.5, marks=pytest.mark.slow)])
def test_a_table_off_zero_is_questioned(gamma_map, touches, tmp_path, off):
    gamma_map.save(tmp_path / "map.nc")
    noise = NOISE * (off + np.random.default_rng(3).normal(size=(400, 3)))
    table = tmp_path / "table.csv"
    rows = np.zeros((400, 6))
    rows[:, [0, 4, 5]] = touches[0][:400] + noise
    np.savetxt(table, rows, delimiter=",", header="Fx,Fy,Fz,Mx,My,Mz", comments="")
    command = ["estimate", str(table), "--map", str(tmp_path / "map.nc")]
    done = CliRunner().invoke(app, [*command, "-o", str(tmp_path / "out.csv")])
    assert done.exit_code == 0, done.output
    assert ("not zero on average" in done.output) == (off > 0.0)


def test_a_contact_that_grows_within_a_second_is_no_drift():
    """A reading that waits is not used if it follows the onset."""
    sensor = Sensor(NAMES, noise=NOISE, drift=DRIFT)
    offset, rng = Offset(sensor, 50), np.random.default_rng(6)
    for i in range(50):
        assert offset.missing
        offset.tare(0.01 * i, NOISE * rng.normal(size=3))
    before = offset.value
    onset, detected = 2.0, 2.8
    for time in np.arange(0.5, 6.0, 0.01):
        grown = 6.0 * NOISE * max(time - onset, 0.0) / (detected - onset)
        offset.follow(time, time < detected, onset, grown + NOISE * rng.normal(size=3))
    assert (np.abs(offset.value) < NOISE).all()
    assert (offset.value != before).all()
    with pytest.raises(ValueError, match="tare needs a sensor"):
        Offset(None, 3)
