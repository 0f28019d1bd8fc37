"""Speed of the inversion: many measurements at once, and one at a time. Answers are checked."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.contacts.fitting.inversion import invert
from vibrissa.rod import discretize, solve_forces
from vibrissa.signals import SIGNALS

TRIPLET = ("Fx", "MB", "MD")
NOISE = np.diag([1e-6] * 3 + [2e-8] * 3) ** 2


@pytest.fixture(scope="module")
def contacts_map(whisker):
    return vb.ContactMap.simulate(whisker, grid=False)


@pytest.fixture(scope="module")
def measured(whisker, contacts):
    """Contact points and the signals they give."""
    d = discretize(whisker)
    values, _ = solve_forces(d, contacts.rows)
    force, point = values[:, :3] * d.force, values[:, 3:] * d.length
    return point, vb.base_signals(force, np.cross(point, force))


@pytest.mark.quick
def test_batch_of_estimates(contacts_map, measured, scipy_solve, report):
    point, signals = measured
    chart = contacts_map.chart
    tree = contacts_map.tree(TRIPLET)
    scale = np.array([chart.discretization.force, chart.discretization.moment, 1.0])
    targets = np.stack([signals[name].to_numpy() for name in TRIPLET], axis=-1) / scale
    found = report(
        "three signals → all contacts",
        lambda: invert(chart, tree, TRIPLET, targets),
        len(targets),
        scipy_solve,
        "2 µs",
        rounds=8,
    )
    away = np.linalg.norm(
        found.values[..., 3:] * chart.discretization.length - point[:, None], axis=-1
    )
    hit = (
        np.nanmin(np.where(np.isnan(away), np.inf, away), axis=1)
        < 1e-6 * chart.discretization.length
    )
    assert hit.mean() > 0.999


def test_batch_of_labelled_estimates(contacts_map, measured, scipy_solve, report):
    _, signals = measured
    found = report(
        "the same as a dataset, with covariances",
        lambda: contacts_map.estimate(signals, TRIPLET, NOISE),
        signals.sizes["sample"],
        scipy_solve,
        rounds=5,
    )
    assert np.isfinite(found.covariance[found.n_candidates > 0]).all()


def test_batch_of_six_signals(contacts_map, measured, scipy_solve, report):
    point, signals = measured
    some = signals.isel(sample=slice(10_000))
    found = report(
        "six signals by least squares, with covariances",
        lambda: contacts_map.estimate(some, SIGNALS, NOISE),
        some.sizes["sample"],
        scipy_solve,
        rounds=3,
    )
    away = np.linalg.norm(found.point - point[:10_000], axis=1)
    assert (away < 1e-9).mean() > 0.99


def test_batch_of_wrenches(whisker, measured, contacts_map, scipy_solve, report):
    point, signals = measured
    bent = contacts_map.estimate(signals.isel(sample=slice(10_000)), SIGNALS)
    found = report(
        "force and moment → contact and friction",
        lambda: vb.estimate_from_wrench(whisker, bent.force, bent.moment),
        10_000,
        scipy_solve,
        rounds=3,
    )
    away = np.linalg.norm(found.point - point[:10_000], axis=1)
    assert (away < 1e-4 * whisker.length).mean() > 0.98


def test_one_measurement_of_six_signals_at_a_time(contacts_map, scipy_solve, report):
    t = np.linspace(0.0, 1.0, 300)
    length = contacts_map.whisker.length
    load = vb.PointForce((0.75 - 0.3 * t) * length, 2e-5 + 6e-5 * t, 0.5 + 1.5 * t)
    bent = vb.deflect(contacts_map.whisker, load)
    signals = vb.base_signals(bent.force, bent.moment)
    rows = np.stack([signals[name].to_numpy() for name in SIGNALS], axis=-1)
    locate = vb.Estimator(contacts_map, SIGNALS)
    found = report(
        "six signals at a time, from Python",
        lambda: [locate(row) for row in rows],
        len(rows),
        scipy_solve,
        "100 µs",
        rounds=5,
    )
    assert all(np.isfinite(one.point).all() for one in found)


@pytest.mark.quick
def test_one_estimate_at_a_time(contacts_map, measured, scipy_solve, report):
    _, signals = measured
    rows = np.stack([signals[name].to_numpy() for name in TRIPLET], axis=-1)[:500]
    locate = vb.Estimator(contacts_map, TRIPLET)
    found = report(
        "one measurement at a time, from Python",
        lambda: [locate(row) for row in rows],
        len(rows),
        scipy_solve,
        "25 µs",
        rounds=10,
    )
    assert all(np.isfinite(one.point).all() for one in found)
