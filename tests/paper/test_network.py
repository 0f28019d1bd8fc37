"""The network: it learns contacts, fails where no function can, and stays near what it knows."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.identifiability import save_uniqueness
from vibrissa.paper import draw_contacts, estimate, train_network, with_network_errors
from vibrissa.signals import SIGNALS, within_cone

SMALL = {"samples": 4000, "held_out": 1000}


@pytest.fixture(scope="module")
def trained(gamma_map):
    return train_network(gamma_map, "Fx MB MD", **SMALL)


def test_draws_are_stable_contacts_outside_the_cone(gamma_map):
    drawn = draw_contacts(gamma_map, 500, seed=3)
    assert drawn.point.shape == (500, 3)
    assert not within_cone(gamma_map.whisker, drawn.point).any()
    bent = vb.deflect(gamma_map.whisker, vb.PointContact(drawn.point))
    assert (bent.status == vb.Status.OK).mean() > 0.99
    ok = bent.status == vb.Status.OK
    np.testing.assert_allclose(bent.force[ok], drawn.force[ok], atol=1e-6 * drawn.force.max())
    np.testing.assert_array_equal(draw_contacts(gamma_map, 500, seed=3).point, drawn.point)


def test_it_learns_a_triplet_that_locates_contacts(gamma_map, trained):
    median, most = trained.error_quantiles((0.5, 0.95)) / gamma_map.whisker.length
    assert median < 0.02
    assert most < 0.1
    # What it is scored on is what it answers.
    which = [SIGNALS.index(name) for name in trained.names]
    again = trained(trained.held_out.signals[:, which]) - trained.held_out.point
    np.testing.assert_allclose(np.linalg.norm(again, axis=1), trained.errors)


@pytest.mark.slow
def test_it_cannot_learn_a_triplet_that_does_not(trained):
    """Without axial signals a cylinder's tip and its middle feel alike."""
    cylinder = vb.ContactMap.simulate(vb.samples.straight_cylinder(), grid=False)
    network = train_network(cylinder, "FT FD MD", **SMALL)
    assert network.error_quantiles(0.5) > 5.0 * trained.error_quantiles(0.5)


def test_quantiles_of_a_part(trained):
    keep = np.zeros(trained.errors.size, dtype=bool)
    assert np.isnan(trained.error_quantiles(keep=keep)).all()
    keep[7] = True
    assert trained.error_quantiles(0.5, keep) == trained.errors[7]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_network(gamma_map):
    first, again, other = (
        train_network(gamma_map, "Fx MB MD", samples=500, held_out=50, seed=seed).errors
        for seed in (1, 1, 2)
    )
    np.testing.assert_allclose(first, again, rtol=1e-9)
    assert not np.allclose(first, other)


def test_estimates_by_network(gamma_map, trained, monkeypatch):
    monkeypatch.setattr("vibrissa.paper.lookup.train_network", lambda contacts, names: trained)
    drawn = draw_contacts(gamma_map, 200, seed=4)
    signals = dict(zip(SIGNALS, drawn.signals.T, strict=True))
    noise = {"Fx": 1e-6, "MB": 1e-8, "MD": 0.1}
    found = estimate(gamma_map, signals, method="network", noise=noise)
    assert (found.status == vb.Status.APPROXIMATE).mean() > 0.98
    away = np.linalg.norm(found.point - drawn.point, axis=1)
    assert np.nanmedian(away) < 0.02 * gamma_map.whisker.length
    assert np.isfinite(found.covariance).all(axis=(1, 2)).mean() > 0.98
    far = estimate(gamma_map, {"Fx": [1.0, np.nan], "MB": 1e-3, "MD": 0.0}, method="network")
    assert far.status.tolist() == [vb.Status.OUTSIDE_MAP, vb.Status.MISSING]
    assert np.isnan(far.point).all()


@pytest.mark.slow
def test_a_network_is_evidence_on_verdicts(tmp_path):
    # A small one, so that it is quick: it errs far more where contacts have the same signals.
    curved = vb.ContactMap.simulate(vb.samples.curved(), grid=False)
    verdicts = vb.uniqueness(
        curved, ["Fx FT MB", "Fx MB MD"], ["all"], samples=64, resolution=False
    )
    found = with_network_errors(curved, verdicts, samples=1500, held_out=500)
    error = found.network_error.sel(region="all")
    assert error.sizes["quantile"] == 2
    assert (error.sel(quantile=0.95) > error.sel(quantile=0.5)).all()
    assert float(error.sel(triplet="Fx FT MB", quantile=0.5)) > 4.0 * float(
        error.sel(triplet="Fx MB MD", quantile=0.5)
    )
    save_uniqueness(found, tmp_path / "u.csv")
    assert "network_error_0.95" in (tmp_path / "u.csv").read_text()


def test_what_it_refuses(gamma_map):
    with pytest.raises(ValueError, match="samples ≥ 100"):
        train_network(gamma_map, samples=10)
    with pytest.raises(ValueError, match="expected exactly 3 different signals"):
        train_network(gamma_map, "Fx FT MB MD")
