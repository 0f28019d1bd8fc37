"""Speed of the inversion: many measurements at once, and one at a time. Answers are checked."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.mapping.inversion import invert
from vibrissa.rod.batch import solve_forces
from vibrissa.rod.discretize import discretize

TRIPLET = ("Fx", "MB", "MD")


@pytest.fixture(scope="module")
def contacts_map(whisker):
    return vb.ContactMap.simulate(whisker, grid=False)


@pytest.fixture(scope="module")
def felt(whisker, contacts):
    """Contact points and the signals they give."""
    d = discretize(whisker)
    values, _ = solve_forces(d, contacts.rows)
    force, point = values[:, :3] * d.force, values[:, 3:] * d.length
    return point, vb.base_signals(force, np.cross(point, force))


def test_batch_of_estimates(contacts_map, felt, scipy_solve, report):
    point, signals = felt
    chart = contacts_map.chart
    tree = contacts_map.tree(TRIPLET)
    scale = np.array([chart.discretization.force, chart.discretization.moment, 1.0])
    targets = np.stack([signals[name].to_numpy() for name in TRIPLET], axis=-1) / scale
    found = report(
        "three signals → all contacts",
        lambda: invert(chart, tree, TRIPLET, targets),
        len(targets),
        scipy_solve,
        "3.3 µs",
        rounds=20,
    )
    away = np.linalg.norm(
        found.values[..., 3:] * chart.discretization.length - point[:, None], axis=-1
    )
    hit = (
        np.nanmin(np.where(np.isnan(away), np.inf, away), axis=1)
        < 1e-6 * chart.discretization.length
    )
    assert hit.mean() > 0.999


def test_batch_of_labelled_estimates(contacts_map, felt, scipy_solve, report):
    _, signals = felt
    noise = np.diag([1e-6] * 3 + [2e-8] * 3) ** 2
    found = report(
        "the same as a dataset, with covariances",
        lambda: contacts_map.estimate(signals, TRIPLET, noise),
        signals.sizes["sample"],
        scipy_solve,
        rounds=5,
    )
    assert np.isfinite(found.covariance[found.n_candidates > 0]).all()


def test_one_estimate_at_a_time(contacts_map, felt, scipy_solve, report):
    _, signals = felt
    rows = np.stack([signals[name].to_numpy() for name in TRIPLET], axis=-1)[:500]
    locate = vb.Estimator(contacts_map, TRIPLET)
    found = report(
        "one measurement at a time, from Python",
        lambda: [locate(row) for row in rows],
        len(rows),
        scipy_solve,
        "100 µs",
        rounds=10,
    )
    assert all(np.isfinite(one.point).all() for one in found)
