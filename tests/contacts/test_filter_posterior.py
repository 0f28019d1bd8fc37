"""What a filter states compared with posteriors sampled by brute force."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.rod import contacts_at, solve_forces, stable_set
from vibrissa.signals import signals_of

NAMES = "Fx FT FD MB MD"
COMPONENTS = [0, 1, 2, 4, 5]  # of (F, M), whose noise is that of these signals


def wrenches(values):
    return np.concatenate([values[:, :3], np.cross(values[:, 3:], values[:, :3])], axis=1)


def measured(wrench, d):
    six = signals_of(wrench[:3] * d.force, wrench[3:] * d.moment)
    return six[[0, 1, 2, 4, 5]]


def sampled(contact_map, density, wrench, sigma, largest=np.inf, number=400_000):
    """Contact points, in L, and how probable they are given a wrench in units of the map."""
    rng, d = np.random.default_rng(0), contact_map.chart.discretization
    x, nodes = np.zeros((number, 4)), contact_map.chart.contacts
    x[:, 0] = rng.uniform(contact_map.chart.proximal, 1.0, number)
    last = nodes[:, 0, -1]
    fold = np.interp(x[:, 0], last[:, 0], np.hypot(last[:, 1], last[:, 2]))
    most = np.minimum(0.7 * fold, largest)
    force, bearing = most * rng.uniform(0.0, 1.0, number), rng.uniform(-np.pi, np.pi, number)
    x[:, 2], x[:, 3] = force * np.cos(bearing), force * np.sin(bearing)
    values, slopes = solve_forces(d, x, tangents=True)
    volume = np.linalg.det(slopes[:, 3:]) * force * most
    away = (wrenches(values) - wrench)[:, COMPONENTS] / sigma
    log = density(x[:, 0], values[:, 3:]) - 0.5 * (away**2).sum(axis=1)
    weight = np.where(volume > 0.0, np.exp(log - log.max()) * volume, 0.0)
    weight /= weight.sum()
    assert 1.0 / (weight**2).sum() > 300.0
    return values[:, 3:], weight


def onset(contact_map, wrenches_seen, sigma, reach):
    """What a filter knows after samples of a contact that has just begun, and π(s, p)."""
    d, length = contact_map.chart.discretization, contact_map.whisker.length
    noise = np.diag((sigma * np.repeat([d.force, d.moment], 3)) ** 2)
    locate = vb.Estimator(contact_map, NAMES, noise, felt_above=1e-12)
    follow = vb.ContactFilter(locate, speed=1e-6 * length)
    follow(0.0, np.zeros(5), np.eye(3), np.zeros(3))
    for i, wrench in enumerate(wrenches_seen):
        moved = [0.0, 0.0, reach * length]
        known = follow(1e-3 * (i + 1), measured(wrench, d), np.eye(3), moved)
    places = np.zeros((201, 4))
    places[:, 0] = np.linspace(0.0, 1.0, 201)
    rest = solve_forces(d, places)[0][:, 3:]

    def begins(along, points):
        at = np.stack([np.interp(along, places[:, 0], column) for column in rest.T], axis=1)
        return -1.5 * np.log(reach**2 + ((points - at) ** 2).sum(axis=1))

    return known, begins


def held(known, points, probable, length):
    """Probabilities of the regions of 95 % and of three standard deviations that are stated."""
    away = points - known.point_whisker / length
    squares = (away * np.linalg.solve(known.covariance / length**2, away.T).T).sum(axis=1)
    return probable @ (squares < 7.81), probable @ (squares < 14.16)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("s", "force"), [(0.7, 0.03), pytest.param(0.85, 0.04, marks=pytest.mark.slow)]
)
def test_a_light_contact_that_begins_is_known_as_its_posterior_states(gamma_map, s, force):
    """Its mean is not drawn to where stations of the chart, or starts, are denser."""
    d, length, sigma = gamma_map.chart.discretization, gamma_map.whisker.length, 0.01
    wrench = wrenches(solve_forces(d, np.array([[s, 0.0, 0.6 * force, 0.8 * force]]))[0])[0]
    known, begins = onset(gamma_map, [wrench], sigma, 0.03)
    points, probable = sampled(gamma_map, begins, wrench, sigma)
    mean = probable @ points
    spread = np.sqrt(probable @ ((points - mean) ** 2).sum(axis=1))
    assert spread > 0.04
    assert np.linalg.norm(known.point_whisker / length - mean) < 0.12 * spread
    most, nearly_all = held(known, points, probable, length)
    assert 0.93 < most < 0.99
    assert nearly_all > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, pytest.param(0.2, marks=pytest.mark.slow), 1.0])
def test_contacts_lighter_than_the_noise_are_as_unknown_as_their_posterior(gamma_map, share):
    """Ten samples, also of a contact without any force: only where it is not is then known."""
    d, sigma = gamma_map.chart.discretization, 0.01
    force = share * sigma
    wrench = wrenches(solve_forces(d, np.array([[0.7, 0.0, 0.6 * force, 0.8 * force]]))[0])[0]
    seen = wrench + (sigma if share else 1e-11) * np.random.default_rng(3).normal(size=(10, 6))
    known, begins = onset(gamma_map, seen, sigma, 0.03)
    few = sigma / np.sqrt(10.0)
    points, probable = sampled(gamma_map, begins, seen.mean(axis=0), few, largest=0.06)
    most, nearly_all = held(known, points, probable, gamma_map.whisker.length)
    assert most > 0.85
    assert nearly_all > 0.95


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


@pytest.mark.parametrize("names", ["Fx MB MD", pytest.param("FT FD MB", marks=pytest.mark.slow)])
def test_a_first_sample_near_slip_off_is_known_as_well_as_stated(gamma_map, names):
    """No twin is certain only by its volume, and regions are not flat."""
    d, length, rng = (
        gamma_map.chart.discretization,
        gamma_map.whisker.length,
        np.random.default_rng(0),
    )
    noise = np.repeat([1e-6, 2e-8], 3)
    follow = vb.ContactFilter(vb.Estimator(gamma_map, names, np.diag(noise**2)))
    root = np.sqrt([0.97, 0.995])
    drawn = rng.uniform([0.1, -np.pi, root[0]], [1.0, np.pi, root[1]], (60, 3))
    x = np.insert(contacts_at(stable_set(gamma_map.whisker).fold, drawn), 1, 0.0, axis=1)
    values, _ = solve_forces(d, x)
    wrench = wrenches(values) * np.repeat([d.force, d.moment], 3) + noise * rng.normal(size=(60, 6))
    squares = []
    for one, point in zip(wrench, values[:, 3:] * length, strict=True):
        follow.reset()
        signals = vb.base_signals(one[:3], one[3:])
        known = follow(0.0, [float(signals[name]) for name in names.split()])
        if known.probability > 0.99:
            away = known.point - point
            squares.append(away @ np.linalg.solve(known.covariance, away))
    assert len(squares) >= 15
    assert np.mean(np.array(squares) > 14.16) < 0.05  # 0.27 % in theory


def test_a_contact_that_jumps_is_followed_at_once(gamma_map):
    """Most of the probability is where the first sample after the jump locates the contact."""
    d, names, sigma = gamma_map.chart.discretization, "Fx MB MD", np.repeat([1e-6, 2e-8], 3)
    rng = np.random.default_rng(3)
    follow = vb.ContactFilter(vb.Estimator(gamma_map, names, np.diag(sigma**2)))
    near = []
    for place in range(12):
        bearing, force = rng.uniform(-np.pi, np.pi), rng.uniform(0.05, 0.2)
        x = [rng.uniform(0.4, 0.8), 0.0, force * np.cos(bearing), force * np.sin(bearing)]
        values, _ = solve_forces(d, np.array([x]))
        wrench = np.concatenate([values[0, :3] * d.force, wrenches(values)[0, 3:] * d.moment])
        for i in range(5):
            seen = wrench + sigma * rng.normal(size=6)
            six = signals_of(seen[:3], seen[3:])
            known = follow(2e-3 * (5 * place + i), six[[0, 4, 5]])
            if i == 0 and place:
                away, spread = known.points - known.located.point, 10.0 * known.located.covariance
                far = (away * np.linalg.solve(spread, away.T).T).sum(axis=1)
                near.append(known.probabilities[far < 1.0].sum())
    assert np.mean(np.array(near) > 0.9) > 0.6


def test_samples_of_a_bent_valley_do_not_shorten_it(gamma_map):
    """A light contact near the base: its arc length remains nearly as unknown as by one sample."""
    d, sigma = gamma_map.chart.discretization, 0.01
    values, _ = solve_forces(d, np.array([[0.4, 0.0, 0.03, 0.03]]))
    noise = np.diag((sigma * np.repeat([d.force, d.moment], 3)) ** 2)
    squares = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        follow = vb.ContactFilter(vb.Estimator(gamma_map, NAMES, noise), speed=1e-3 * d.length)
        for i in range(12):
            seen = wrenches(values)[0] + sigma * rng.normal(size=6)
            known = follow(2e-3 * i, measured(seen, d))
        away = known.point - values[0, 3:] * d.length
        squares.append(away @ np.linalg.solve(known.covariance, away))
    assert np.mean(squares) < 6.0
