"""A prior leaves out candidates, and the status says what is left."""

import itertools

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.signals import REGIONS, concave_backward
from vibrissa.status import Status

NOISE = np.diag(np.repeat([1e-6, 2e-8], 3) ** 2)


@pytest.fixture(scope="module")
def bent(gamma_map):
    rng = np.random.default_rng(11)
    n, whisker = 300, gamma_map.whisker
    at = rng.uniform(0.35, 0.95, n) * whisker.length
    load = vb.PointForce(at, rng.uniform(5e-6, 8e-5, n), rng.uniform(-np.pi, np.pi, n))
    bent = vb.deflect(whisker, load)
    kept = np.flatnonzero(bent.status == vb.Status.OK)
    return bent.force[kept], bent.moment[kept], bent.contact_point[kept]


PRIORS = [
    vb.Prior("CB"),
    vb.Prior("ELD CF"),
    vb.Prior(least_force=1e-5, greatest_force=5e-5),
    vb.Prior({"r": (0.02, 0.035), "phi": (-0.2, 0.4)}),
    vb.Prior({"theta": (0.2, -0.1)}),
]


def reference(prior, whisker, points, forces):
    """The prior again, from contact point and base force."""
    size = np.linalg.norm(forces, axis=-1)
    good = (size >= prior.least_force) & (size <= prior.greatest_force)
    if prior.region == "CB":
        good &= concave_backward(whisker, points)
    elif prior.region == "ELD CF":
        turned = vb.deflect(whisker, vb.PointContact(points)).centerline(401)
        ahead = turned[..., 1:, 0] - turned[..., :-1, 0]
        away = np.linalg.norm(turned[..., 1:, :] - points[..., None, :], axis=-1).argmin(axis=-1)
        good &= np.take_along_axis(ahead, away[..., None], axis=-1)[..., 0] >= 0.0
        good &= ~concave_backward(whisker, points)
    elif prior.region != "all":
        x, y, z = np.moveaxis(points, -1, 0)
        r, theta = np.linalg.norm(points, axis=-1), np.arctan2(y, x)
        if "r" in prior.region:
            good &= (r >= 0.02) & (r <= 0.035)
            good &= (np.arcsin(z / r) >= -0.2) & (np.arcsin(z / r) <= 0.4)
        else:
            good &= (theta >= 0.2) | (theta <= -0.1)
    return good


@pytest.mark.parametrize("prior", PRIORS, ids=str)
@pytest.mark.parametrize(
    ("names", "noise"),
    [
        ("FT FD MB", None),
        ("Fx FT MB", NOISE),
        pytest.param("FT FD MB", NOISE, marks=pytest.mark.slow),
    ],
    ids=["exact", "noise", "noise, another triplet"],
)
def test_candidates_are_those_that_are_possible(gamma_map, bent, names, noise, prior):
    """The same as without a prior, but for those that it excludes; and one at a time alike."""
    signals = vb.base_signals(*bent[:2])
    whole = gamma_map.estimate(signals, names, noise)
    some = gamma_map.estimate(signals, names, noise, prior=prior)
    locate = vb.Estimator(gamma_map, names, noise, prior=prior)
    rows = np.stack([signals[name] for name in names.split()], axis=-1)
    fewer = displaced = 0
    around = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
    around *= 3.0 / np.linalg.norm(around, axis=1, keepdims=True)
    around = np.concatenate([around * share for share in (1.0, 2 / 3, 1 / 3, 1 / 6)])
    for i in range(len(rows)):
        n = whole.n_candidates[i]
        points, forces = whole.candidates.point[i, :n], whole.candidates.force[i, :n]
        good = reference(prior, gamma_map.whisker, points, forces)
        fewer += good.sum() < n
        if noise is not None and n and not good.any() and some.n_candidates[i]:
            # Noise has displaced a possible contact: the region is within three sigma.
            size, axes = np.linalg.eigh(whole.candidates.covariance[i, :n])
            near = points[:, None] + (around * np.sqrt(size)[:, None]) @ np.swapaxes(axes, 1, 2)
            alike = np.broadcast_to(forces[:, None], near.shape)
            good = np.array(
                [
                    reference(prior, gamma_map.whisker, *one).any()
                    for one in zip(near, alike, strict=True)
                ]
            )
            if prior.region != "ELD CF":  # which also depends on the force at each point
                np.testing.assert_array_equal(
                    some.candidates.point[i, : some.n_candidates[i]], points[good]
                )
            displaced += 1
            continue
        assert some.n_candidates[i] == good.sum()
        np.testing.assert_array_equal(some.candidates.point[i, : good.sum()], points[good])
        assert np.isnan(some.candidates.point[i, good.sum() :]).all()
        expected = {0: Status.OUTSIDE_PRIOR, 1: Status.UNIQUE}.get(good.sum(), Status.AMBIGUOUS)
        if noise is not None and good.any():
            left = whole.candidates.probability[i, :n][good]
            sure = len(left) == 1 or left[0] > 0.95 * left.sum() > 0.0
            expected = Status.UNIQUE if sure else Status.AMBIGUOUS
        answered = whole.status[i] in (Status.UNIQUE, Status.AMBIGUOUS)
        fewer_here = good.sum() < n
        assert some.status[i] == (expected if answered and fewer_here else whole.status[i])
        if i % 20 == 0:
            locate.reset()
            one = locate(rows[i])
            assert one.status == some.status[i]
            np.testing.assert_allclose(one.candidates.point, points[good], atol=1e-8)
    assert 0 < fewer < len(rows)
    assert displaced < len(rows) / 3
    kept = some.n_candidates > 0
    np.testing.assert_array_equal(some.point[kept], some.candidates.point[kept, 0])
    same = kept & (some.point == whole.point).all(axis=-1)
    valid = some.candidates.covariance_valid[..., 0], whole.candidates.covariance_valid[..., 0]
    np.testing.assert_array_equal(valid[0][same], valid[1][same])
    assert not some.covariance_valid[~kept].any()


def test_misfits_are_those_of_the_contact_that_is_left(gamma_map, bent):
    """Where noisy signals have several contacts, and the first is excluded by its force."""
    rng = np.random.default_rng(3)
    noise = {"Fx": 1e-6, "FT": 1e-6, "Mx": 2e-8, "MB": 2e-8}
    true = vb.base_signals(*bent[:2])
    signals = {
        name: np.abs(true[name].values + sigma * rng.normal(size=len(bent[0])))
        if name in ("FT", "MB")
        else true[name].values + sigma * rng.normal(size=len(bent[0]))
        for name, sigma in noise.items()
    }
    whole = gamma_map.estimate(signals, tuple(noise), noise)
    several = np.flatnonzero(whole.n_candidates > 1)
    assert several.size >= 20
    alike = 0
    for i in several[:20]:
        first, second = np.linalg.norm(whole.candidates.force[i, :2], axis=-1)
        limits = {"greatest_force" if first > second else "least_force": 0.5 * (first + second)}
        one, prior = {name: values[i] for name, values in signals.items()}, vb.Prior(**limits)
        some = gamma_map.estimate(one, tuple(noise), noise, prior=prior)
        assert some.chi_squared == pytest.approx(
            misfit_of(some.force, some.point, one, noise), abs=1e-5
        )
        located = vb.Estimator(gamma_map, tuple(noise), noise, prior=prior)(list(one.values()))
        if located.n_candidates:
            alike += 1
            own = misfit_of(located.candidates.force[0], located.point, one, noise)
            assert located.chi_squared == pytest.approx(own, abs=1e-5)
    assert alike > 15


def misfit_of(force, point, signals, noise):
    """χ² of signals with independent noise."""
    at_contact = vb.base_signals(force, np.cross(point, force))
    return sum(((float(at_contact[n]) - signals[n]) / noise[n]) ** 2 for n in noise)


@pytest.mark.parametrize("using", ["Fx MB MD", "Fx FT MB MD", "wrench"])
def test_contacts_that_noise_displaces_beyond_the_region_have_an_answer(gamma_map, bent, using):
    """They were drawn from the region, so that at most a few are three sigma away from it."""
    inside = np.abs(np.linalg.norm(bent[2], axis=1) - 0.025) < 0.004
    force, moment, points = (one[inside] for one in bent)
    rng = np.random.default_rng(1)
    sigma = np.sqrt(np.diag(NOISE))
    wrench = np.concatenate([force, moment], axis=1) + sigma * rng.normal(size=(len(force), 6))
    signals = vb.base_signals(wrench[:, :3], wrench[:, 3:])
    if using == "wrench":
        signals = {"force": wrench[:, :3], "moment": wrench[:, 3:]}
    prior = vb.Prior({"r": (0.021, 0.029)})
    found = gamma_map.estimate(signals, using, NOISE, prior=prior)
    free = gamma_map.estimate(signals, using, NOISE)
    assert (np.abs(np.linalg.norm(free.point, axis=1) - 0.025) > 0.004).sum() > 3
    assert (found.status == Status.OUTSIDE_PRIOR).mean() < 0.02
    away = found.point - points
    near = np.einsum("ni,nij,nj->n", away, np.linalg.inv(found.covariance), away) < 7.815
    assert near.mean() > 0.9


@pytest.mark.slow
def test_samples_of_a_curve_are_those_that_are_possible(gamma_map, bent):
    """Two signals leave a curve of contacts; of it the part on one side is left."""
    signals = vb.base_signals(*bent[:2])
    prior = vb.Prior("CB")
    some = vb.Estimator(gamma_map, "FT MB", NOISE, prior=prior)
    whole = vb.Estimator(gamma_map, "FT MB", NOISE)
    partly = 0
    for i in range(0, len(bent[0]), 10):
        row = [float(signals[name][i]) for name in ("FT", "MB")]
        known, free = some(row), whole(row)
        good = concave_backward(gamma_map.whisker, free.candidates.point)
        if not good.any():
            assert known.status in (Status.OUTSIDE_PRIOR, free.status)
            continue
        partly += not good.all()
        np.testing.assert_array_equal(known.candidates.point, free.candidates.point[good])
        assert (known.point == known.candidates.point).all(axis=1).any()
        away = known.candidates.point - known.point
        scatter = away.T @ away / len(away)
        assert np.linalg.eigvalsh(known.covariance - scatter).min() > -1e-12
    assert partly > 5


@pytest.mark.slow
def test_a_filter_begins_where_contacts_are_possible(gamma_map, bent):
    i = int(np.flatnonzero(concave_backward(gamma_map.whisker, bent[2]))[0])
    signals = vb.base_signals(bent[0][i], bent[1][i])
    row = [float(signals[name]) for name in ("FT", "MB")]
    for region, holds in (("CB", True), ("CF", False)):
        locate = vb.Estimator(gamma_map, "FT MB", NOISE, prior=vb.Prior(region))
        found = vb.ContactFilter(locate)(0.0, row)
        assert len(found.points)
        assert (concave_backward(gamma_map.whisker, found.points) == holds).all()


def test_a_whole_wrench_knows_a_prior_too(gamma_map, bent):
    force, moment, points = bent
    back = concave_backward(gamma_map.whisker, points)
    some = vb.estimate_from_wrench(gamma_map.whisker, force, moment, prior=vb.Prior("CB"))
    whole = vb.estimate_from_wrench(gamma_map.whisker, force, moment)
    alone = whole.n_candidates == 1
    np.testing.assert_array_equal(some.status[alone & back], whole.status[alone & back])
    assert (some.status[alone & ~back] == Status.OUTSIDE_PRIOR).all()
    assert np.isnan(some.point[alone & ~back]).all()
    np.testing.assert_allclose(some.point[back & alone], points[back & alone], atol=1e-7)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"region": "left"}, "one of " + ", ".join(REGIONS)),
        ({"region": {"x": (0.0, 1.0)}}, "limits of r, theta, phi"),
        ({"region": {}}, "limits of r, theta, phi"),
        ({"region": {"r": (2.0, 1.0)}}, "least value first"),
        ({"region": {"r": 1.0}}, "between two numbers"),
        ({"least_force": 2.0, "greatest_force": 1.0}, "0 ≤ least < greatest"),
        ({"least_force": -1.0}, "0 ≤ least < greatest"),
        ({"greatest_force": np.nan}, "0 ≤ least < greatest"),
    ],
)
def test_what_is_no_prior_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        vb.Prior(**given)


def test_a_region_in_mm_is_refused(gamma_map, bent):
    """No contact is there: all answers would be outside of the prior."""
    signals = vb.base_signals(*bent[:2])
    for limits in ((5.0, 30.0), (5e-6, 3e-5)):  # and mm as metres
        with pytest.raises(ValueError, match="no contact of a whisker"):
            gamma_map.estimate(signals, noise=NOISE, prior=vb.Prior({"r": limits}))


@pytest.mark.parametrize(
    "given", [{"least_force": 5.0}, {"least_force": 1e-9}, {"greatest_force": 50.0}], ids=str
)
def test_forces_in_other_units_are_refused(gamma_map, bent, given):
    """They would leave out all contacts, or none."""
    signals = vb.base_signals(*bent[:2])
    with pytest.raises(ValueError, match=f"{next(iter(given))} is .* N: is it in N"):
        gamma_map.estimate(signals, noise=NOISE, prior=vb.Prior(**given))
