"""A stream of measurements: the same answers as in a batch, one at a time, and in sequence."""

import copy
import pickle

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.signals import SIGNALS

SIGMA = np.repeat([1e-6, 2e-8], 3)


@pytest.fixture(scope="module")
def sweep(gamma_map):
    """A contact that glides along the whisker while it is pushed harder."""
    whisker = gamma_map.whisker
    t = np.linspace(0.0, 1.0, 40)
    force = 2e-5 + 6e-5 * t
    load = vb.PointForce((0.75 - 0.3 * t) * whisker.length, force, 0.5 + 1.5 * t)
    bent = vb.deflect(whisker, load)
    return bent, vb.base_signals(bent.force, bent.moment)


@pytest.mark.parametrize(
    "names", ["MD Fx MB", "Fx FT MB", "MB Fx FT MD", "Fx FT Mx MB", " ".join(SIGNALS)]
)
@pytest.mark.parametrize("noise", [None, np.diag(SIGMA**2)], ids=["no noise", "noise"])
def test_a_stream_is_the_same_as_a_batch(gamma_map, sweep, names, noise):
    bent, signals = sweep
    locate = vb.Estimator(gamma_map, names, noise)
    batch = gamma_map.estimate(signals, names, noise)
    rows = np.stack([signals[name] for name in names.split()], axis=-1)
    followed = []
    for i, one in enumerate(locate(row) for row in rows):
        assert int(one.status) == batch.status[i]
        np.testing.assert_allclose(one.point, batch.point[i], atol=1e-9)
        np.testing.assert_allclose(one.candidates.arc_length[0], batch.arc_length[i], atol=1e-9)
        np.testing.assert_allclose(one.covariance, batch.covariance[i], rtol=1e-5, atol=1e-15)
        followed.append(one.candidates.point[one.continuing])
        away = np.linalg.norm(one.candidates.point - bent.contact_point[i], axis=-1)
        assert away.min() < 1e-8
    # One branch, after one taken first (of Fx, FT and MB alone) has come to its end.
    path = np.linalg.norm(np.diff(bent.contact_point, axis=0), axis=1).max()
    assert np.linalg.norm(np.diff(followed[8:], axis=0), axis=1).max() < 2.0 * path


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_a_copy_goes_on_as_the_original(gamma_map, sweep, copied):
    """As where processes share the work."""
    first, second = (sweep[1][["Fx", "MB", "MD"]].to_array().values.T)[:2]
    of_sensor = vb.Estimator.of_sensor(gamma_map, vb.sensors.Sensor(noise=SIGMA))
    bent = sweep[0]
    np.testing.assert_array_equal(
        copied(of_sensor)(np.append(bent.force[0], bent.moment[0])).point,
        of_sensor(np.append(bent.force[0], bent.moment[0])).point,
    )
    follow = vb.ContactFilter(vb.Estimator(gamma_map, noise=np.diag(SIGMA**2)))
    follow(0.0, first)
    other = copied(follow)
    np.testing.assert_array_equal(other(1e-3, second).point, follow(1e-3, second).point)


def test_under_noise_a_stream_is_the_same(gamma_map, sweep, rng):
    bent, _ = sweep
    noise = np.diag(SIGMA**2)
    wrench = np.concatenate([bent.force, bent.moment], axis=1) + SIGMA * rng.normal(size=(40, 6))
    signals = vb.base_signals(wrench[:, :3], wrench[:, 3:])
    for names in ("Fx FT MB MD", " ".join(SIGNALS)):
        locate = vb.Estimator(gamma_map, names, noise)
        batch = gamma_map.estimate(signals, names, noise)
        rows = np.stack([signals[name] for name in names.split()], axis=-1)
        found = np.array([locate(row).point for row in rows])
        sigma = np.sqrt(np.trace(batch.covariance, axis1=1, axis2=2))
        away = np.linalg.norm(found - batch.point, axis=1) / sigma
        assert away.max() < 1e-3


def test_what_is_not_there_is_said(gamma_map, sweep):
    _, signals = sweep
    names = "Fx FT MB MD"
    locate = vb.Estimator(gamma_map, names, np.diag(SIGMA**2))
    good = [signals[name][5].item() for name in names.split()]
    assert locate(good).status == vb.Status.UNIQUE
    lost = locate([np.nan, *good[1:]])
    assert lost.status == vb.Status.MISSING
    assert np.isnan(lost.point).all()
    assert lost.candidates.point.shape == (0, 3)
    again = locate(good)
    assert again.status == vb.Status.UNIQUE
    assert locate([good[0], 0.2 * good[1], *good[2:]]).status == vb.Status.NOT_FRICTIONLESS
    with pytest.raises(ValueError, match=r"has 4 signals; got shape \(3,\)"):
        locate(good[:3])
    with pytest.raises(ValueError, match="noise lacks MB, MD"):
        vb.Estimator(gamma_map, names, {"Fx": 1e-6, "FT": 1e-6})


@pytest.fixture(scope="module")
def straight_map():
    return vb.ContactMap.simulate(vb.samples.straight(), grid=False)


@pytest.mark.parametrize("noise", ["deviations", "covariance", None])
@pytest.mark.parametrize("names", ["FT FD MB MD", "Fx FT FD MB", "Fx FD MB MD"])
def test_a_contact_that_turns_is_weighed_anew(straight_map, rng, names, noise):
    """One size of force in any direction: weights depend on the direction.

    Noise that is larger than stated leaves much of the signals unexplained; the fits of a stream
    and of a batch then end a small share of a standard deviation apart.
    """
    whisker, n = straight_map.whisker, 12
    bent = vb.deflect(
        whisker, vb.PointForce(0.6 * whisker.length, 1e-4, rng.uniform(-np.pi, np.pi, n))
    )
    clean = vb.base_signals(bent.force, bent.moment)
    sigma = {
        name: 0.1 if name in ("FD", "MD") else 0.01 * np.abs(clean[name]).max().item()
        for name in SIGNALS
    }
    rows = np.stack([clean[name] + sigma[name] * rng.normal(size=n) for name in names.split()], -1)
    given = {
        "deviations": sigma,
        "covariance": np.diag(np.repeat([sigma["FT"], sigma["MB"]], 3) ** 2),
        None: None,
    }[noise]
    locate = vb.Estimator(straight_map, names, given)
    batch = straight_map.estimate(dict(zip(names.split(), rows.T, strict=True)), names, given)
    found = [locate(row) for row in rows]
    assert [int(one.status) for one in found] == batch.status.tolist()
    stream = np.array([one.point for one in found])
    apart = np.linalg.norm(stream - batch.point, axis=1)
    spread = np.sqrt(np.trace(batch.covariance, axis1=1, axis2=2))
    unexplained = (batch.status == vb.Status.NOT_FRICTIONLESS) & (given is not None)
    allowed = np.where(unexplained, 1e-2 * spread, 1e-6 * whisker.length)
    assert (apart <= allowed).all(), apart / allowed


def test_a_stream_says_as_a_batch_why_nothing_explains_signals(gamma_map):
    whisker = gamma_map.whisker
    near = vb.deflect(whisker, vb.PointForce(0.25 * whisker.length, 2e-4, 0.7), proximal=0.1)
    signals = vb.base_signals(near.force, near.moment)
    cases = {
        "Fx MB MD": [[0, 0, 0], [0, 0, 1.0], [1, 1, 0.1], [1e-5, 1e-9, 1], "near"],
        "Fx FT MB MD": [[0, 0, 0, 0], [1, 1, 1, 1], "near"],
    }
    for text, rows in cases.items():
        names = text.split()
        own = [float(signals[name]) for name in names]
        rows = np.array([own if row == "near" else row for row in rows])
        batch = gamma_map.estimate(dict(zip(names, rows.T, strict=True)), names)
        assert {vb.Status.DEGENERATE, vb.Status.OUTSIDE_MAP} <= set(batch.status.tolist())
        assert batch.status[-1] == vb.Status.OUTSIDE_MAP
        locate = vb.Estimator(gamma_map, names)
        for i, row in enumerate(rows):
            one = locate(row)
            assert one.status == batch.status[i]
            np.testing.assert_allclose(one.chi_squared, batch.chi_squared[i], rtol=1e-6)


@pytest.mark.parametrize("row", [[-1e-5, 1e-6, 200.0], [-1e-5, -1e-6, 2.0]])
def test_a_stream_refuses_what_a_batch_refuses(gamma_map, row):
    for locate in (
        vb.Estimator(gamma_map),
        lambda row: gamma_map.estimate(dict(zip(("Fx", "MB", "MD"), row, strict=True))),
    ):
        with pytest.raises(ValueError, match=r"looks like degrees|cannot be negative"):
            locate(row)


@pytest.mark.parametrize(
    "names", ["Fx FD MD", "FT FD MD", "FD MB MD", "Fx Mx MB", "FT Mx MD", "Fx FD Mx MD"]
)
def test_signals_that_determine_no_contact_locate_none(straight_map, names):
    """On a straight whisker M_D follows from F_D, and M_x = 0."""
    whisker = straight_map.whisker
    bent = vb.deflect(whisker, vb.PointForce(0.6 * whisker.length, 1e-4, [0.3, 1.0, -2.0]))
    signals = vb.base_signals(bent.force, bent.moment)
    rows = np.stack([signals[name] for name in names.split()], axis=-1)
    rows[2, 0] = np.nan
    expected = [vb.Status.DEGENERATE] * 2 + [vb.Status.MISSING]
    found = straight_map.estimate(dict(zip(names.split(), rows.T, strict=True)), names)
    assert found.status.tolist() == expected
    assert np.isnan(found.point).all()
    assert (found.n_candidates == 0).all()
    assert not straight_map.determines(names)
    locate = vb.Estimator(straight_map, names)
    stream = [locate(row) for row in rows]
    assert [one.status for one in stream] == expected
    assert all(np.isnan(one.point).all() for one in stream)


def test_other_signals_determine_contacts(straight_map, gamma_map):
    for names in ("Fx MB MD", "FT FD MB", "FT FD Mx MB", " ".join(SIGNALS)):
        assert straight_map.determines(names)
    for names in ("Fx FD MD", "FD MB MD", "Fx Mx MB"):
        assert gamma_map.determines(names)


@pytest.mark.parametrize("using", ["Fx MB MD", "FT MB MD", "Fx FT MB MD", "Fx FT FD Mx MB MD"])
@pytest.mark.parametrize("noisy", [False, True])
def test_many_at_once_and_one_at_a_time_have_the_same_answers(gamma_map, using, noisy):
    """Light and heavy contacts, with signals carried out of what contacts give by noise."""
    rng = np.random.default_rng(12)
    nodes = gamma_map.to_dataset()
    which = rng.integers(0, nodes.status.size, 60)
    force, moment = (nodes[name].to_numpy().reshape(-1, 3)[which] for name in ("force", "moment"))
    force = force + rng.normal(0.0, SIGMA[:3], force.shape)
    moment = moment + rng.normal(0.0, SIGMA[3:], moment.shape)
    signals = vb.base_signals(force, moment)
    noise = np.diag(SIGMA**2) if noisy else None
    many = gamma_map.estimate(signals, using, noise)
    locate = vb.Estimator(gamma_map, using, noise)
    rows = np.stack([signals[name].to_numpy() for name in using.split()], axis=-1)
    for i, row in enumerate(rows):
        one = locate(row)
        assert one.status == many.status[i]
        assert one.n_candidates == many.n_candidates[i]
        assert one.covariance_valid == many.covariance_valid[i]
        n, length = one.n_candidates, gamma_map.whisker.length
        np.testing.assert_allclose(
            one.candidates.point, many.candidates.point[i, :n], atol=1e-7 * length
        )
        np.testing.assert_allclose(one.probability, many.probability[i], atol=1e-6)
