"""What a filter states compared with posteriors sampled by brute force."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.rod import solve_forces
from vibrissa.signals import signals_of

NAMES = "Fx FT FD MB MD"
COMPONENTS = [0, 1, 2, 4, 5]  # of (F, M), whose noise is that of these signals


def wrenches(values):
    return np.concatenate([values[:, :3], np.cross(values[:, 3:], values[:, :3])], axis=1)


def measured(wrench, d):
    six = signals_of(wrench[:3] * d.force, wrench[3:] * d.moment)
    return six[[0, 1, 2, 4, 5]]


def sampled(contact_map, density, wrench, sigma, number=400_000):
    """Contact points, in L, and how probable they are given a wrench in units of the map."""
    rng, d = np.random.default_rng(0), contact_map.chart.discretization
    x, nodes = np.zeros((number, 4)), contact_map.chart.contacts
    x[:, 0] = rng.uniform(contact_map.chart.proximal, 1.0, number)
    last = nodes[:, 0, -1]
    most = np.interp(x[:, 0], last[:, 0], np.hypot(last[:, 1], last[:, 2]))
    force, bearing = most * rng.uniform(0.0, 0.7, number), rng.uniform(-np.pi, np.pi, number)
    x[:, 2], x[:, 3] = force * np.cos(bearing), force * np.sin(bearing)
    values, slopes = solve_forces(d, x, tangents=True)
    volume = np.linalg.det(slopes[:, 3:]) * force * most
    away = (wrenches(values) - wrench)[:, COMPONENTS] / sigma
    log = density(x[:, 0], values[:, 3:]) - 0.5 * (away**2).sum(axis=1)
    weight = np.where(volume > 0.0, np.exp(log - log.max()) * volume, 0.0)
    weight /= weight.sum()
    assert 1.0 / (weight**2).sum() > 300.0
    return values[:, 3:], weight


@pytest.mark.parametrize(("s", "force"), [(0.7, 0.03), (0.85, 0.04)])
def test_a_light_contact_that_begins_is_known_as_its_posterior_states(gamma_map, s, force):
    """Its mean is not drawn to where stations of the chart, or starts, are denser."""
    d, length, sigma, reach = gamma_map.chart.discretization, gamma_map.whisker.length, 0.01, 0.03
    x = np.array([[s, 0.0, 0.6 * force, 0.8 * force]])
    wrench = wrenches(solve_forces(d, x)[0])[0]
    noise = np.diag((sigma * np.repeat([d.force, d.moment], 3)) ** 2)
    locate = vb.Estimator(gamma_map, NAMES, noise, felt_above=1e-3)
    follow = vb.ContactFilter(locate, speed=1e-6 * length)
    follow(0.0, np.zeros(5), np.eye(3), np.zeros(3))
    known = follow(1e-3, measured(wrench, d), np.eye(3), [0.0, 0.0, reach * length])
    places = np.zeros((201, 4))
    places[:, 0] = np.linspace(0.0, 1.0, 201)
    rest = solve_forces(d, places)[0][:, 3:]

    def begins(along, points):
        at = np.stack([np.interp(along, places[:, 0], column) for column in rest.T], axis=1)
        return -1.5 * np.log(reach**2 + ((points - at) ** 2).sum(axis=1))

    points, probable = sampled(gamma_map, begins, wrench, sigma)
    mean = probable @ points
    spread = np.sqrt(probable @ ((points - mean) ** 2).sum(axis=1))
    assert spread > 0.04
    assert np.linalg.norm(known.point_whisker / length - mean) < 0.12 * spread
    away = points - known.point_whisker / length
    squares = (away * np.linalg.solve(known.covariance / length**2, away.T).T).sum(axis=1)
    assert 0.93 < probable @ (squares < 7.81) < 0.99
    assert probable @ (squares > 14.16) < 0.01


def test_a_contact_near_slip_off_is_not_lost_for_another(gamma_map):
    """Where noise carries the least χ² beyond the fold, the contact is at the fold."""
    d, length, sigma = gamma_map.chart.discretization, gamma_map.whisker.length, 0.03
    values, _ = solve_forces(d, np.array([[0.957, 0.0, -0.071, -0.064]]))
    wrench, point = wrenches(values)[0], values[0, 3:]
    noise = np.diag((sigma * np.repeat([d.force, d.moment], 3)) ** 2)
    squares = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        follow = vb.ContactFilter(vb.Estimator(gamma_map, NAMES, noise), speed=1e-3 * length)
        for i in range(20):
            known = follow(1e-3 * i, measured(wrench + sigma * rng.normal(size=6), d))
            away = known.point / length - point
            squares.append(away @ np.linalg.solve(known.covariance / length**2, away))
    assert np.mean(squares) < 6.0
    assert max(squares) < 40.0
