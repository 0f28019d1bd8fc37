"""Contacts of the tip whose force is oblique, against an integration that vibrissa did not make."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import vibrissa as vb
from vibrissa.cli.inputs import AssumptionOptions

SETS = ("Fx MB MD", "Fx FT MB MD", "Fx FT FD Mx MB MD")
LENGTH = 0.1


@pytest.fixture(scope="module")
def rod():
    """A tapered plastic whisker, ten centimetres long, with its map."""
    whisker = vb.Whisker.parabola(
        LENGTH, 2.0, base_radius=5e-4, tip_radius=1.7e-4, youngs_modulus=2.3e9
    )
    return vb.ContactMap.simulate(whisker, grid=False)


@pytest.fixture(scope="module")
def touched(rod):
    """Wrench and tip of whiskers that press on plates, by frames carried from the tip to the base.

    The whisker is integrated in the frame of its tip, with its force there; then all is turned into
    the frame of its base.
    """
    whisker, rng = rod.whisker, np.random.default_rng(4)
    unit = whisker.base_bending_stiffness / LENGTH**2
    wrenches, points = [], []
    for _ in range(12):
        slope, bearing = rng.uniform(0.4, 1.1), rng.uniform(0.0, 2.0 * np.pi)
        toward = [-np.sin(slope), np.cos(slope) * np.cos(bearing), np.cos(slope) * np.sin(bearing)]
        force = rng.uniform(0.08, 0.14) * unit * np.array(toward)

        def rates(s, y, force=force):
            turn = Rotation.from_quat(y[3:7])
            stiffness = whisker.youngs_modulus * np.pi * whisker.radius(s) ** 4 / 4.0
            moment = np.cross(-y[:3], force)  # of the force at the tip, the origin
            soft = np.array([1.0 + whisker.poisson_ratio, 1.0, 1.0]) / stiffness
            u = turn.inv().apply(moment) * soft + whisker.curvature(s)
            q = y[3:7]
            spin = 0.5 * np.append(q[3] * u + np.cross(q[:3], u), -q[:3] @ u)
            return np.concatenate([turn.apply([1.0, 0.0, 0.0]), spin])

        start = np.concatenate([np.zeros(3), [0.0, 0.0, 0.0, 1.0]])
        base = solve_ivp(rates, (LENGTH, 0.0), start, "DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
        turn = Rotation.from_quat(base[3:]).inv()
        points.append(turn.apply(-base[:3]))
        at_base = turn.apply(force)
        wrenches.append([*at_base, *np.cross(points[-1], at_base)])
    return np.array(wrenches), np.array(points)


def noise_of(rod, share):
    unit = rod.whisker.base_bending_stiffness / LENGTH**2
    return np.diag(np.repeat([share * unit, share * unit * LENGTH], 3) ** 2)


@pytest.mark.parametrize("using", SETS)
def test_an_oblique_force_at_the_tip_is_found(rod, touched, using):
    wrench, points = touched
    signals = vb.base_signals(wrench[:, :3], wrench[:, 3:])
    noise = noise_of(rod, 1e-6)
    without = rod.estimate(signals, using, noise)
    away = np.linalg.norm(without.point - points, axis=1)
    assert np.median(away) > 1e-4
    found = rod.estimate(signals, using, noise, prior=vb.Prior(tip=0.1))
    np.testing.assert_array_equal(found.status, vb.Status.TIP_CONTACT)
    np.testing.assert_allclose(found.point, points, atol=1e-5 * LENGTH)
    np.testing.assert_array_equal(found.arc_length, LENGTH)
    assert (found.contact_force[:, 0] < 0.0).all()
    rows = np.stack([signals[name] for name in using.split()], axis=-1)
    one = vb.Estimator(rod, using, noise, prior=vb.Prior(tip=0.1))(rows[0])
    assert one.status == vb.Status.TIP_CONTACT
    np.testing.assert_allclose(one.point, found.point[0], atol=1e-12)


@pytest.mark.parametrize(
    "using", [SETS[0], *(pytest.param(s, marks=pytest.mark.slow) for s in SETS[1:])]
)
def test_regions_hold_the_tip(rod, touched, using):
    """Of 10 draws of noise each; chi-square of three degrees of freedom is 3 in the mean."""
    wrench, points = (np.repeat(part, 10, axis=0) for part in touched)
    noise = noise_of(rod, 1e-3)
    rng = np.random.default_rng(1)
    drawn = wrench + rng.normal(size=wrench.shape) * np.sqrt(np.diag(noise))
    signals = vb.base_signals(drawn[:, :3], drawn[:, 3:])
    found = rod.estimate(signals, using, noise, prior=vb.Prior(tip=0.1))
    tip = found.status == vb.Status.TIP_CONTACT
    assert tip.mean() > 0.9
    away = (found.point - points)[tip]
    size = np.einsum("ni,nij,nj->n", away, np.linalg.inv(found.covariance[tip]), away)
    assert 0.9 <= np.mean(size < 7.815) <= 1.0
    assert 2.0 < size.mean() < 4.0
    assert found.covariance_valid[tip].mean() > 0.9


@pytest.mark.slow
def test_regions_of_a_slender_tip_are_as_wide_as_what_it_can_touch():
    """The γ whisker's tip is so soft that noise leaves open much of what it holds."""
    contact_map = vb.ContactMap.simulate(vb.samples.gamma(), grid=False)
    whisker, rng, n = contact_map.whisker, np.random.default_rng(0), 40
    unit = whisker.base_bending_stiffness / whisker.length**2
    slope, bearing = rng.uniform(0.1, 0.5, n), rng.uniform(0.0, 2.0 * np.pi, n)
    force = [-np.sin(slope), np.cos(slope) * np.cos(bearing), np.cos(slope) * np.sin(bearing)]
    force = rng.uniform(0.025, 0.04, n) * unit * np.array(force)
    bent = vb.deflect(whisker, vb.PointForce(whisker.length, components=tuple(force)))
    sigma = 7e-3 * unit * np.repeat([1.0, whisker.length], 3)
    drawn = sigma * rng.normal(size=(n, 6))
    signals = vb.base_signals(bent.force + drawn[:, :3], bent.moment + drawn[:, 3:])
    for using in SETS[::2]:
        found = contact_map.estimate(signals, using, np.diag(sigma**2), prior=vb.Prior(tip=0.5))
        tip = found.status == vb.Status.TIP_CONTACT
        assert tip.mean() > 0.9
        assert found.covariance_valid[tip].mean() > 0.95  # also where the side is probable, too
        away = found.point - bent.contact_point
        size = np.einsum("ni,nij,nj->n", away, np.linalg.inv(found.covariance), away)
        assert np.mean(size < 7.815) >= 0.9
        assert np.sort(size)[-3] < 20.0


def test_contacts_of_the_side_remain(rod):
    arc = np.linspace(0.4, 0.9, 12) * LENGTH
    bent = vb.deflect(rod.whisker, vb.PointForce(arc, 8e-3, np.linspace(0.0, 6.0, 12)))
    assert (bent.status == vb.Status.OK).all()
    signals = vb.base_signals(bent.force, bent.moment)
    for using in SETS:
        plain, found = (
            rod.estimate(signals, using, noise_of(rod, 1e-4), prior=prior)
            for prior in (None, vb.Prior(tip=0.1))
        )
        np.testing.assert_array_equal(found.point, plain.point)
        np.testing.assert_array_equal(found.status, plain.status)
        np.testing.assert_allclose(found.probability, plain.probability, atol=0.02)


def test_what_cannot_be_compared_is_refused(rod, touched):
    wrench, _ = touched
    signals = vb.base_signals(wrench[:, :3], wrench[:, 3:])
    noise, tip = noise_of(rod, 1e-3), vb.Prior(tip=0.1)
    with pytest.raises(ValueError, match=r"probability below 1; got 1\.0"):
        vb.Prior(tip=1.0)
    with pytest.raises(ValueError, match="and their noise"):
        rod.estimate(signals, SETS[0], prior=tip)
    with pytest.raises(ValueError, match="friction, weight"):
        rod.estimate(signals, SETS[0], noise, prior=tip, friction=0.3)
    with pytest.raises(ValueError, match="by itself"):
        vb.estimate_from_wrench(rod.whisker, wrench[:, :3], wrench[:, 3:], noise=noise, prior=tip)
    with pytest.raises(ValueError, match="do not determine"):
        vb.Estimator(rod, "Fx MB", noise, prior=tip)
    with pytest.raises(ValueError, match="a filter"):
        vb.ContactFilter(vb.Estimator(rod, SETS[0], noise, prior=tip))


def test_the_command_has_it_as_a_prior():
    stated = AssumptionOptions(tip=10.0)
    assert stated.prior == vb.Prior(tip=0.1)
    assert stated.described() == "; the tip touched with a probability of 10 %"
    assert AssumptionOptions().prior is None
