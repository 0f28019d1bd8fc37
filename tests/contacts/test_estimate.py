"""Estimates: what the forward solution felt leads back to the contact it came from."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.rod import contacts_at, determinant, discretize, solve_forces
from vibrissa.signals import TRIPLETS, within_cone

CANONICAL = ("Fx", "MB", "MD")


def random_contacts(contacts, n, rng):
    """Stable contacts found without the chart: uniform in arc length, bearing and share of the fold
    force, which is bracketed here by the sign of det ∂p/∂ξ along each ray."""
    rod = discretize(contacts.whisker)
    s, psi = rng.uniform(0.3, 1.0, n), rng.uniform(-np.pi, np.pi, n)
    direction = np.stack([np.cos(psi), np.sin(psi)], axis=1)

    def det(force, rays=slice(None)):
        force = force[:, None] * direction[rays]
        rows = np.concatenate([s[rays, None], np.zeros((len(force), 1)), force], axis=1)
        values, tangents = solve_forces(rod, rows, tangents=True)
        return determinant(tangents), values, rows

    rest = det(np.zeros(n))[0]
    unit = s / np.sqrt(rest)
    low, high = np.zeros(n), np.full(n, np.nan)
    rays = np.arange(n)
    for share in np.arange(1, 80) * 0.05:
        still = det(share * unit[rays], rays)[0] > 0.0
        high[rays[~still]] = share
        rays = rays[still]
        low[rays] = share
    for _ in range(20):
        middle = 0.5 * (low + high)
        stable = det(middle * unit)[0] > 0.0
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    _, values, rows = det(rng.uniform(0.0, 1.0, n) * low * unit)
    d = contacts.chart.discretization
    force, point = values[:, :3] * d.force, values[:, 3:] * d.length
    return point, force, rows[:, 0] * d.length


def recovered(contacts, triplet, n, rng):
    return found_again(contacts, triplet, random_contacts(contacts, n, rng))


def found_again(contacts, triplet, touched):
    point, force, arc_length = touched
    signals = vb.base_signals(force, np.cross(point, force))
    found = contacts.estimate(signals, using=triplet)
    away = (
        np.linalg.norm(found.candidates.point - point[:, None], axis=-1) / contacts.whisker.length
    )
    hit = np.nanmin(np.where(np.isnan(away), np.inf, away), axis=1) <= 1e-6
    return hit, within_cone(contacts.whisker, point), found, point, arc_length


def test_round_trip_on_the_default_whisker(gamma_map, rng):
    hit, cone, found, *_ = recovered(gamma_map, CANONICAL, 4000, rng)
    outside = ~cone
    assert outside.mean() > 0.9
    assert hit[outside].mean() >= 0.9999
    # Not all are unique (the determinant changes sign near rest), but nearly all.
    assert 0.99 < (found.n_candidates[outside] == 1).mean() < 1.0


@pytest.mark.parametrize(
    "whisker",
    [
        pytest.param(vb.Whisker.straight(0.03), marks=pytest.mark.slow),
        vb.Whisker.parabola(0.02, 41.0),
        pytest.param(
            vb.Whisker.parabola(0.05, 6.0, tip_radius=100e-6 / 40), marks=pytest.mark.slow
        ),
        vb.Whisker.from_curvature(
            0.25,
            lambda s: np.stack([0 * s, -2.0 + 0 * s, 3.0 + 0 * s], -1),
            base_radius=1e-3,
        ),
    ],
    ids=["straight", "strongly curved", "thin tip", "robot, out of plane"],
)
def test_round_trip_on_other_whiskers(whisker, rng):
    contact_map = vb.ContactMap.simulate(whisker, grid=False)
    hit, cone, *_ = recovered(contact_map, CANONICAL, 4000, rng)
    assert hit[~cone].mean() >= 0.999


def test_the_compliant_base_is_part_of_the_inversion(rng):
    whisker = vb.Whisker.parabola(0.04, 10.0, base_stiffness=(2e-5, 1e-5))
    contact_map = vb.ContactMap.simulate(whisker, grid=False)
    # Such a base folds the map from contacts to these signals; of two contacts next to that fold
    # one may be missed.
    hit, cone, *_ = recovered(contact_map, CANONICAL, 4000, rng)
    assert hit[~cone].mean() >= 0.998


@pytest.fixture(scope="module")
def some(gamma_map):
    return random_contacts(gamma_map, 500, np.random.default_rng(20))


@pytest.mark.parametrize("triplet", [t for t in TRIPLETS if t != CANONICAL], ids=" ".join)
def test_every_triplet_finds_the_contact_again(gamma_map, some, triplet):
    hit, cone, *_ = found_again(gamma_map, triplet, some)
    assert hit[~cone].mean() >= 0.997


@pytest.mark.parametrize(
    ("sample", "triplet", "least"),
    [
        ("straight", ("Fx", "FT", "MD"), 0.999),
        ("gamma", ("Fx", "FT", "MD"), 0.999),
        ("gamma", ("Mx", "MB", "MD"), 0.9995),
        ("gamma", ("Fx", "FT", "MB"), 0.997),
        ("gamma", ("FT", "FD", "MB"), 0.999),
        # Here the transverse force vanishes inside Ω, where its direction leaps.
        ("gamma", ("Fx", "FD", "MB"), 0.999),
        ("straight", ("FT", "FD", "MB"), 0.999),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, tuple) else str(x),
)
def test_contacts_next_to_a_fold_of_the_triplet_are_found(gamma_map, sample, triplet, least):
    rng = np.random.default_rng(1)
    straight = vb.samples.straight()
    contacts = gamma_map if sample == "gamma" else vb.ContactMap.simulate(straight, grid=False)
    chart, n = contacts.chart, 2000
    eta, psi, rho = rng.uniform(0, 1, n), rng.uniform(0, 2 * np.pi, n), rng.uniform(0.5, 0.999, n)
    xi = contacts_at(chart.fold, np.stack([eta, psi, rho], axis=-1))
    values, _ = solve_forces(chart.discretization, np.insert(xi, 1, 0.0, axis=1))
    point = values[:, 3:] * chart.discretization.length
    force = values[:, :3] * chart.discretization.force
    found = contacts.estimate(vb.base_signals(force, np.cross(point, force)), using=triplet)
    away = (
        np.linalg.norm(found.candidates.point - point[:, None], axis=-1) / contacts.whisker.length
    )
    hit = (away <= 1e-6).any(axis=1)
    assert hit.mean() >= least


def test_candidates_explain_the_signals_and_rise_in_force(gamma_map, rng):
    _, _, found, *_ = recovered(gamma_map, ("Fx", "FT", "MB"), 500, rng)
    several = found.n_candidates > 1
    assert several.any()
    for row in np.flatnonzero(several)[:20]:
        points = found.candidates.point[row, : found.n_candidates[row]]
        bent = vb.deflect(gamma_map.whisker, vb.PointContact(points))
        again = vb.base_signals(bent.force, bent.moment)
        for name in ("Fx", "FT", "MB"):
            np.testing.assert_allclose(again[name], again[name][0], rtol=1e-6)
        force = np.linalg.norm(bent.force, axis=-1)
        assert (np.diff(force) >= -1e-9 * force[1:]).all()


def test_covariance_predicts_the_scatter(gamma_map, rng):
    """Monte Carlo, where the deflection is large enough for the linearisation to hold."""
    bent = vb.deflect(gamma_map.whisker, vb.PointContact([0.024, 0.014, 0.002]))
    sigma = np.array([1e-7] * 3 + [2e-9] * 3)
    noisy = np.concatenate([bent.force, bent.moment]) + sigma * rng.normal(size=(4000, 6))
    found = gamma_map.estimate(vb.base_signals(noisy[:, :3], noisy[:, 3:]))
    exact = gamma_map.estimate(vb.base_signals(bent.force, bent.moment), noise=np.diag(sigma**2))
    scatter = np.cov(found.point.T)
    np.testing.assert_allclose(
        np.sqrt(np.diag(exact.covariance)), np.sqrt(np.diag(scatter)), rtol=0.06
    )
    np.testing.assert_array_equal(exact.candidates.covariance[0], exact.covariance)
    by_signal = {
        "Fx": sigma[0],
        "MB": sigma[3],
        "MD": sigma[3] / np.hypot(bent.moment[1], bent.moment[2]),
    }
    same = gamma_map.estimate(vb.base_signals(bent.force, bent.moment), noise=by_signal)
    np.testing.assert_allclose(same.covariance, exact.covariance, rtol=1e-9, atol=1e-22)


def test_statuses(gamma_map):
    whisker = gamma_map.whisker
    bent = vb.deflect(whisker, vb.PointContact([0.024, 0.014, 0.002]))
    good = vb.base_signals(bent.force, bent.moment)
    assert gamma_map.estimate(good).status == vb.Status.UNIQUE
    assert gamma_map.estimate({**good, "MB": np.nan}).status == vb.Status.MISSING

    impossible = gamma_map.estimate({"Fx": 5e-3, "MB": 1e-8, "MD": 1.0})
    assert impossible.status == vb.Status.NOT_FRICTIONLESS
    assert impossible.chi_squared > 0.1
    assert np.isnan(impossible.point).all()

    resting = gamma_map.estimate({"Fx": 0.0, "MB": 0.0, "MD": 0.0})
    assert resting.status == vb.Status.DEGENERATE

    near_base = vb.deflect(
        whisker, vb.PointForce(0.24 * whisker.length, magnitude=3e-4, direction=0.4)
    )
    below = gamma_map.estimate(vb.base_signals(near_base.force, near_base.moment))
    assert below.status == vb.Status.OUTSIDE_MAP


def test_bad_input_says_what_is_allowed(gamma_map):
    signals = {"Fx": 1e-5, "MB": 1e-7, "MD": 0.1}
    with pytest.raises(ValueError, match="signals lack MB, MD"):
        gamma_map.estimate({"Fx": 1e-5})
    with pytest.raises(ValueError, match="expected at least 3 different signals"):
        gamma_map.estimate(signals, using="MB MD")
    with pytest.raises(ValueError, match="MB is a size and cannot be negative"):
        gamma_map.estimate({**signals, "MB": -1e-7})
    with pytest.raises(ValueError, match="looks like degrees"):
        gamma_map.estimate({**signals, "MD": 90.0})
    with pytest.raises(ValueError, match="noise lacks MD"):
        gamma_map.estimate(signals, noise={"Fx": 1e-6, "MB": 1e-8})
    with pytest.raises(ValueError, match=r"got shape \(3, 3\)"):
        gamma_map.estimate(signals, noise=np.eye(3))
    with pytest.raises(ValueError, match=r"dataset or mapping with Fx, MB, MD, .*; got 5"):
        gamma_map.estimate(5)
    with pytest.raises(ValueError, match=r"must be standard deviations ≥ 0; got \{'Fx': 'a'"):
        gamma_map.estimate(signals, noise={"Fx": "a", "MB": 1e-8, "MD": 0.1})
    with pytest.raises(ValueError, match=r"6 × 6 covariance of \(F, M\); got 'a'"):
        gamma_map.estimate(signals, noise="a")
    with pytest.raises(ValueError, match=r"must be numbers; got \['a', 1, 2\]"):
        vb.Estimator(gamma_map)(["a", 1, 2])


def test_one_at_a_time_is_the_same(gamma_map, rng):
    _, _, found, point, _ = recovered(gamma_map, CANONICAL, 50, rng)
    bent = vb.deflect(gamma_map.whisker, vb.PointContact(point))
    signals = vb.base_signals(bent.force, bent.moment)
    locate = vb.Estimator(gamma_map, "MD Fx MB")
    for row in range(50):
        one = locate([signals[name][row].item() for name in ("MD", "Fx", "MB")])
        assert int(one.status) == found.status[row]
        np.testing.assert_allclose(one.point, found.point[row], atol=1e-9)
    assert locate([np.nan, 1e-5, 1e-7]).status == vb.Status.MISSING
    with pytest.raises(ValueError, match="3 signals"):
        locate([1.0, 2.0])


def test_rows_of_a_long_batch_are_those_of_a_short_one(gamma_map, rng):
    point, force, _ = random_contacts(gamma_map, 300, rng)
    signals = vb.base_signals(force, np.cross(point, force))[list(CANONICAL)]
    short = gamma_map.estimate(signals, using=CANONICAL)
    rows = np.arange(70_000) % 300  # more than are worked on at once, with a remainder
    long = gamma_map.estimate(signals.isel(sample=rows), using=CANONICAL)
    np.testing.assert_array_equal(long.status, short.status[rows])
    np.testing.assert_array_equal(long.n_candidates, short.n_candidates[rows])
    close = (
        1e-9 * gamma_map.whisker.length
    )  # contacts are solved side by side with their neighbours
    np.testing.assert_allclose(
        long.candidates.point, short.candidates.point[rows], rtol=0, atol=close
    )
    np.testing.assert_allclose(long.force, short.force[rows], rtol=1e-6)
