"""Estimates from more than three signals, and how far covariances can be relied on."""

from itertools import combinations

import numpy as np
import pytest
import xarray as xr

import vibrissa as vb
from vibrissa.rod import contacts_at
from vibrissa.signals import SIGNALS

SIGMA = np.repeat([1e-6, 2e-8], 3)
SETS = [names for k in (4, 5, 6) for names in combinations(SIGNALS, k)]


def touched(contacts, n, rng, least=0.2, friction=0.0):
    """Contacts from a share of ``least`` of the fold's load on."""
    place = np.stack(
        [rng.uniform(0, 1, n), rng.uniform(-np.pi, np.pi, n), rng.uniform(least, 0.98, n)], axis=1
    )
    chart = contacts.chart
    s, fy, fz = contacts_at(chart.fold, place).T
    unit = chart.discretization.force
    fx = friction * np.hypot(fy, fz)
    whisker = contacts.whisker
    force = tuple(unit * f for f in (fx, fy, fz))
    return vb.deflect(whisker, vb.PointForce(s * whisker.length, components=force))


def noisy_signals(bent, n, rng, sigma=SIGMA):
    wrench = np.concatenate([bent.force, bent.moment]) + sigma * rng.normal(size=(n, 6))
    return vb.base_signals(wrench[:, :3], wrench[:, 3:])


@pytest.mark.parametrize("names", SETS, ids=" ".join)
def test_every_larger_set_finds_the_contact_again(gamma_map, rng, names):
    bent = touched(gamma_map, 60, rng)
    found = gamma_map.estimate(vb.base_signals(bent.force, bent.moment), names)
    away = np.linalg.norm(found.candidates.point - bent.contact_point[:, None], axis=-1)
    assert (np.nanmin(away, axis=1) <= 1e-9).mean() >= 0.98
    assert (found.chi_squared < 1e-12).mean() >= 0.98
    assert np.isin(found.status, (vb.Status.UNIQUE, vb.Status.AMBIGUOUS)).all()


@pytest.mark.parametrize("names", ["Fx FT MB MD", "Fx FT FD MB MD", "Fx FT FD Mx MB MD"])
def test_covariance_predicts_the_scatter(gamma_map, rng, names):
    bent = vb.deflect(gamma_map.whisker, vb.PointContact([0.022, 0.012, 0.002]))
    sigma = 0.2 * SIGMA
    noise = np.diag(sigma**2)
    exact = gamma_map.estimate(vb.base_signals(bent.force, bent.moment), names, noise)
    assert exact.covariance_valid
    found = gamma_map.estimate(noisy_signals(bent, 2000, rng, sigma), names, noise)
    assert (found.status == vb.Status.UNIQUE).mean() > 0.99
    np.testing.assert_allclose(
        np.sqrt(np.diag(exact.covariance)), found.point.std(axis=0), rtol=0.08
    )
    # χ² of as many degrees of freedom as signals are left over.
    assert found.chi_squared.mean() == pytest.approx(len(names.split()) - 3, rel=0.15)


def test_more_signals_locate_better(gamma_map, rng):
    bent = vb.deflect(gamma_map.whisker, vb.PointContact([0.022, 0.012, 0.002]))
    signals, noise = vb.base_signals(bent.force, bent.moment), np.diag(SIGMA**2)
    size = [
        np.trace(gamma_map.estimate(signals, names, noise).covariance)
        for names in ("Fx MB MD", "Fx FT MB MD", "Fx FT FD MB MD", "Fx FT FD Mx MB MD")
    ]
    assert (np.diff(size) <= 1e-12 * size[0]).all()
    assert size[-1] < 0.9 * size[0]


def test_noise_of_rank_five_tells_as_much(gamma_map):
    """A sensor model that obeys M · F = 0 has a singular covariance; here that loses nothing."""
    bent = vb.deflect(gamma_map.whisker, vb.PointContact([0.022, 0.012, 0.002]))
    signals = vb.base_signals(bent.force, bent.moment)
    normal = SIGMA * np.concatenate([bent.moment, bent.force])
    away = np.eye(6) - np.outer(normal, normal) / (normal @ normal)
    full = np.diag(SIGMA**2)
    singular = np.diag(SIGMA) @ away @ away.T @ np.diag(SIGMA)
    names = "Fx FT FD Mx MB MD"
    one, other = (gamma_map.estimate(signals, names, noise) for noise in (full, singular))
    assert np.linalg.matrix_rank(singular / np.outer(SIGMA, SIGMA)) == 5
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-6, atol=1e-14)
    np.testing.assert_allclose(other.point, one.point, atol=1e-9)


def test_noise_by_signal_is_the_same_as_by_component(gamma_map):
    """Where it is small: else that of a direction changes with the size that may be true."""
    bent = vb.deflect(gamma_map.whisker, vb.PointContact([0.022, 0.012, 0.002]))
    signals, sigma = vb.base_signals(bent.force, bent.moment), 0.1 * SIGMA
    by_signal = dict.fromkeys(("Fx", "FT"), sigma[0]) | {"MB": sigma[3], "Mx": sigma[3]}
    by_signal["FD"] = sigma[0] / signals.FT.item()
    by_signal["MD"] = sigma[3] / signals.MB.item()
    for names in ("Fx FT MB MD", "Fx FT FD Mx MB MD", "Fx FD Mx MD"):
        one = gamma_map.estimate(signals, names, np.diag(sigma**2))
        other = gamma_map.estimate(signals, names, by_signal)
        np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-6, atol=1e-16)


def test_friction_shows_in_the_misfit(gamma_map, rng):
    noise = np.diag((0.1 * SIGMA) ** 2)
    shares = []
    for friction in (0.0, 0.4):
        bent = touched(gamma_map, 100, rng, least=0.5, friction=friction)
        signals = vb.base_signals(bent.force, bent.moment)
        found = gamma_map.estimate(signals, SIGNALS, noise)
        there = found.status == vb.Status.NOT_FRICTIONLESS
        shares.append(there.mean())
    assert shares[0] == 0.0
    assert shares[1] > 0.7  # near the tip forces are lost in noise
    assert np.isfinite(found.point[there]).any()  # the frictionless contact that comes nearest
    assert (found.chi_squared[there] > 16.0).all()


def test_candidates_have_everything(gamma_map, rng):
    bent = touched(gamma_map, 200, rng)
    signals = vb.base_signals(bent.force, bent.moment)
    for names in ("Fx FT MB", "Fx FT Mx MB"):
        found = gamma_map.estimate(signals, names, noise=np.diag(SIGMA**2))
        assert (found.n_candidates > 1).any()
        there = np.arange(found.candidates.point.shape[1]) < found.n_candidates[:, None]
        s, force = found.candidates.arc_length[there], found.candidates.force[there]
        assert np.isfinite(found.candidates.covariance[there]).all(axis=(1, 2)).mean() > 0.99
        assert np.isnan(found.candidates.point[~there]).all()
        np.testing.assert_array_equal(found.arc_length, found.candidates.arc_length[:, 0])
        np.testing.assert_allclose(
            found.candidates.moment[there], np.cross(found.candidates.point[there], force)
        )
        again = vb.estimate_from_wrench(gamma_map.whisker, force, found.candidates.moment[there])
        np.testing.assert_allclose(again.arc_length, s, atol=1e-5 * gamma_map.whisker.length)


@pytest.mark.slow
def test_linear_is_where_the_prediction_holds(gamma_map, rng):
    """Monte Carlo: flagged linear, the scatter is as predicted; elsewhere it mostly is not."""
    bent = touched(gamma_map, 40, rng, least=0.1)
    noise = np.diag(SIGMA**2)
    for names in ("Fx MB MD", "Fx FT FD Mx MB MD"):
        exact = gamma_map.estimate(vb.base_signals(bent.force, bent.moment), names, noise)
        ratios = []
        for row in range(40):
            wrench = np.concatenate([bent.force[row], bent.moment[row]])
            noisy = wrench + SIGMA * rng.normal(size=(300, 6))
            found = gamma_map.estimate(vb.base_signals(noisy[:, :3], noisy[:, 3:]), names, noise)
            away = np.linalg.norm(found.candidates.point - exact.point[row], axis=-1)
            near = np.nanargmin(np.where(np.isnan(away), np.inf, away), axis=1)
            scatter = np.nanvar(found.candidates.point[np.arange(300), near], axis=0).sum()
            ratios.append(np.sqrt(scatter / np.trace(exact.covariance[row])))
        ratios, linear = np.array(ratios), exact.candidates.covariance_valid[..., 0]
        assert 5 <= linear.sum() <= 36
        assert (np.abs(np.log(ratios[linear])) < np.log(1.3)).mean() >= 0.95, ratios[linear]
        assert (np.abs(np.log(ratios[~linear])) > np.log(1.3)).mean() > 0.4, ratios[~linear]


def test_statuses(gamma_map):
    bent = vb.deflect(gamma_map.whisker, vb.PointContact([0.024, 0.014, 0.002]))
    good = vb.base_signals(bent.force, bent.moment)
    names = "Fx FT MB MD"

    def status(signals, using=names):
        return gamma_map.estimate(signals, using).status

    assert status(good) == vb.Status.UNIQUE
    assert status({**good, "MB": np.nan}) == vb.Status.MISSING
    assert status(dict.fromkeys(SIGNALS, 0.0)) == vb.Status.DEGENERATE
    assert status({**good, "FT": 3.0 * good["FT"]}) == vb.Status.NOT_FRICTIONLESS
    # Millinewtons taken for newtons.
    for triplet in (names, "Fx MB MD"):
        wrong = {n: good[n] * (1.0 if n in ("FD", "MD") else 1e5) for n in SIGNALS}
        assert status(wrong, triplet) == vb.Status.OUTSIDE_MAP
    near = vb.deflect(
        gamma_map.whisker,
        vb.PointForce(0.24 * gamma_map.whisker.length, magnitude=3e-4, direction=0.4),
    )
    assert status(vb.base_signals(near.force, near.moment)) == vb.Status.OUTSIDE_MAP


def test_coordinates_are_kept(gamma_map, rng):
    bent = touched(gamma_map, 6, rng)
    labels = {"dims": ("time", "space"), "coords": {"time": 0.1 * np.arange(6)}}
    force, moment = xr.DataArray(bent.force, **labels), xr.DataArray(bent.moment, **labels)
    signals = vb.base_signals(force, moment.transpose("space", "time"))
    np.testing.assert_array_equal(signals.time, force.time)
    for given in (signals, dict(signals.data_vars)):
        data = gamma_map.estimate(given, "Fx MB MD").to_dataset()
        assert data.contact_point.dims == ("time", "space")
        np.testing.assert_array_equal(data.time, force.time)
    shifted = {**signals.data_vars, "MD": signals.MD.assign_coords(time=signals.time + 1.0)}
    with pytest.raises(ValueError, match="coordinates do not agree"):
        gamma_map.estimate(shifted)
    with pytest.raises(ValueError, match="must have them too"):
        gamma_map.estimate({**signals.data_vars, "MD": np.zeros(6)})


def test_without_noise_nothing_scatters(gamma_map):
    bent = vb.deflect(gamma_map.whisker, vb.PointContact([0.024, 0.014, 0.002]))
    signals = vb.base_signals(bent.force, bent.moment)
    for names in ("Fx MB MD", "Fx FT FD Mx MB MD"):
        found = gamma_map.estimate(signals, names, noise=np.zeros((6, 6)))
        assert found.status == vb.Status.UNIQUE
        # What is exact counts as a millionth of a unit of force and moment: some ten nanometres.
        assert np.sqrt(np.trace(found.covariance)) < 1e-7
        assert found.covariance_valid
    # A signal known exactly next to others that are not.
    exact = dict.fromkeys(("Fx", "FD", "MB", "MD"), 0.0) | {"FT": 1e-6, "Mx": 2e-8}
    found = gamma_map.estimate(signals, SIGNALS, exact)
    assert np.sqrt(np.trace(found.covariance)) < 1e-9


def test_a_missing_signal_is_missing_whatever_the_others(gamma_map):
    rows = {"Fx": [np.nan, 1.0], "FT": 1.0, "MB": 1e-7, "MD": [0.1, np.nan]}
    found = gamma_map.estimate(rows, "Fx FT MB MD")
    assert found.status.tolist() == [vb.Status.MISSING] * 2
