"""The moving whisker: beams that vibrate, statics at rest, Newton's laws at the base."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.ndimage import gaussian_filter1d

import vibrissa as vb
from vibrissa.numerics import exponential
from vibrissa.objects import Peg
from vibrissa.rod import follow_surfaces
from vibrissa.simulation import (
    Dynamics,
    Motion,
    facing_peg,
    resonances,
    simulate,
    sweep_past,
    whisking,
)
from vibrissa.simulation.chain import Chain, configure, inertia, jacobian
from vibrissa.simulation.dynamics import move_dynamically
from vibrissa.status import Status
from vibrissa.whisker import base_rotation

WHISKER = vb.samples.gamma()
DENSITY = 1300.0


def beam(whisker, elements=60):
    """Frequencies of the straight tapered beam by Hermite's finite elements, Hz."""
    x = np.linspace(0.0, whisker.length, elements + 1)
    stiffness = np.zeros((2 * elements + 2, 2 * elements + 2))
    mass = stiffness.copy()
    nodes, weights = np.polynomial.legendre.leggauss(6)
    for e in range(elements):
        h = x[e + 1] - x[e]
        rows = slice(2 * e, 2 * e + 4)
        for t, w in zip(0.5 * (nodes + 1.0), 0.5 * h * weights, strict=True):
            a = float(whisker.radius(x[e] + t * h))
            u = 1.0 - t
            shape = np.array([u**2 * (1 + 2 * t), h * t * u**2, t**2 * (3 - 2 * t), -h * t**2 * u])
            bend = np.array([12 * t - 6, h * (6 * t - 4), 6 - 12 * t, h * (6 * t - 2)]) / h**2
            area = np.pi * a**2
            stiffness[rows, rows] += (
                w * whisker.youngs_modulus * area * a**2 / 4 * np.outer(bend, bend)
            )
            mass[rows, rows] += w * DENSITY * area * np.outer(shape, shape)
    squares = eigh(stiffness[2:, 2:], mass[2:, 2:], eigvals_only=True)
    return np.sqrt(squares) / (2.0 * np.pi)


def settled(turn, duration, start=-0.7, rate=1000.0):
    """Turn the base smoothly, and hold it."""
    n = round(duration * rate)
    moving = n // 3
    angle = np.concatenate([np.linspace(start, turn, moving), np.full(n - moving, turn)])
    angle = gaussian_filter1d(angle, 0.006 * rate)
    return Motion(np.arange(n) / rate, angle, 0 * angle, 0 * angle, np.zeros((n, 3)))


def felt(motion, moments):
    turn = motion.base_rotation
    return tuple(
        np.einsum("tji,tj->ti", turn, np.array([getattr(m, name) for m in moments]))
        for name in ("force", "moment")
    )


@pytest.mark.parametrize("whisker", [vb.samples.straight(), vb.samples.straight_cylinder()])
def test_resonances_are_those_of_the_beam(whisker):
    expected = beam(whisker)
    errors = []
    for segments in (16, 32):
        found = resonances(whisker, Dynamics((DENSITY, DENSITY), segments=segments), 4)
        # Twice each, in two directions.
        np.testing.assert_allclose(found[0], found[1], rtol=1e-9)
        errors.append(np.abs(found[[0, 2]] / expected[:2] - 1.0))
    assert errors[1].max() < 3e-3
    # Of second order in the segments' length.
    assert (errors[0] / errors[1] > 3.3).all()


def test_a_uniform_beam_has_its_closed_form():
    whisker = vb.samples.straight_cylinder()
    a = whisker.base_radius
    speed = np.sqrt(whisker.youngs_modulus / DENSITY) * a / 2.0
    expected = np.array([1.8751040687, 4.6940911330]) ** 2 * speed / whisker.length**2 / 2.0 / np.pi
    np.testing.assert_allclose(beam(whisker)[:2], expected, rtol=1e-6)


def test_a_compliant_base_is_slower():
    soft = WHISKER.with_properties(base_stiffness=(2e-5, 2e-5))
    assert resonances(soft)[0] < 0.9 * resonances(WHISKER)[0]
    hard = WHISKER.with_properties(base_stiffness=(1.0, 1.0))
    np.testing.assert_allclose(resonances(hard)[0], resonances(WHISKER)[0], rtol=1e-3)


def chain_state(theta, chain):
    m = chain.joints.size
    frames, pivots, turns = np.empty((m + 1, 3, 3)), np.empty((m, 3)), np.empty((m, 3, 3))
    base = np.array([1e-3, 2e-3, 3e-3])
    rotation = base_rotation(0.3, 0.2, 0.1)
    configure(*exponential(theta), chain.joints, rotation, base, frames, pivots, turns)
    return frames, pivots, turns, base


def test_derivatives_of_the_chain():
    chain = Chain.of(WHISKER, (1200.0, 1600.0), 8)
    generator = np.random.default_rng(1)
    theta = chain.rest + generator.normal(scale=0.2, size=chain.rest.shape)

    def points(theta):
        frames, pivots, _, base = chain_state(theta, chain)
        return chain.places(frames, pivots, base, chain.mass_arc, chain.mass_link)

    _, pivots, turns, _ = chain_state(theta, chain)
    places = points(theta)
    numeric = np.empty((*places.shape, theta.size))
    for k in range(theta.size):
        step = 1e-6 * (np.arange(theta.size) == k).reshape(theta.shape)
        numeric[..., k] = (points(theta + step) - points(theta - step)) / 2e-6
    for i in (0, 5, len(places) - 1):
        found = jacobian(places[[i]], chain.mass_link[[i]], np.ones(1), pivots, turns)
        np.testing.assert_allclose(found, numeric[i], rtol=0, atol=1e-10)
    pull = generator.normal(size=places.shape)
    residual, matrix = np.empty(theta.size), np.empty((theta.size, theta.size))
    inertia(places, chain.mass, chain.mass_link, pull, pivots, turns, residual, matrix)
    np.testing.assert_allclose(residual, np.einsum("nik,ni->k", numeric, pull), atol=1e-8)
    expected = np.einsum("n,nik,nil->kl", chain.mass, numeric, numeric)
    np.testing.assert_allclose(matrix, expected, rtol=0, atol=1e-8 * expected.max())


@pytest.mark.slow
def test_at_rest_it_is_static():
    peg = Peg([0.62 * WHISKER.length, 0.0, 0.0], [0.0, 0.0, 1.0], 1.35e-3, stiffness=200.0)
    motion = settled(-0.1, 0.15)
    expected = follow_surfaces(WHISKER, [peg], motion.base_rotation, motion.base_position).bent
    errors = []
    for segments in (8, 16):
        dynamics = Dynamics(segments=segments, step=2e-4)
        moments = move_dynamically(WHISKER, [peg], motion, dynamics)
        force, moment = felt(motion, moments)
        errors.append(
            max(
                np.linalg.norm(force[-1] - expected.force[-1]) / np.linalg.norm(expected.force[-1]),
                np.linalg.norm(moment[-1] - expected.moment[-1])
                / np.linalg.norm(expected.moment[-1]),
            )
        )
        (contact,) = moments[-1].contacts
        assert contact.arc_length == pytest.approx(expected.arc_length[-1], rel=2e-3)
    assert errors[1] < 0.015
    assert errors[0] / errors[1] > 3.0


def test_it_rings_at_its_resonance_and_the_ringing_decays():
    ratio = 0.05
    dynamics = Dynamics(segments=12, damping_ratio=ratio)
    motion = settled(0.1, 0.2, start=0.0)
    whisker = vb.samples.straight()
    _, moment = felt(motion, move_dynamically(whisker, [], motion, dynamics))
    start = 85
    swing, time = moment[start:, 2], motion.time[start:]
    crossing = np.flatnonzero(np.diff(np.sign(swing)) != 0)
    exact = time[crossing] - swing[crossing] * 1e-3 / np.diff(swing)[crossing]
    frequency = 0.5 / np.diff(exact).mean()
    (expected,) = resonances(whisker, dynamics, 1)
    assert frequency == pytest.approx(expected * np.sqrt(1.0 - ratio**2), rel=0.02)
    peaks = np.abs([swing[a:b].min() + swing[a:b].max() for a, b in pairwise(crossing)])
    decrement = -np.polyfit(np.arange(len(peaks)), np.log(peaks), 1)[0]
    assert decrement / np.pi == pytest.approx(ratio, rel=0.1)
    # With the ratio of real whiskers it is gone, to a tenth, within 20 to 50 ms.
    decay = np.log(10.0) / (0.14 * 2.0 * np.pi * resonances(WHISKER)[0])
    assert 0.02 < decay < 0.06


def test_the_base_accelerates_the_mass():
    n, acceleration = 200, np.array([3.0, 2.0, -1.0])
    time = np.arange(n) / 1000.0
    place = 0.5 * acceleration * time[:, None] ** 2
    still = np.zeros(n)
    motion = Motion(time, still, still, still, place)
    dynamics = Dynamics(segments=8, damping_ratio=0.5)
    force, _ = felt(motion, move_dynamically(WHISKER, [], motion, dynamics))
    chain = Chain.of(WHISKER, dynamics.density, 8)
    np.testing.assert_allclose(force[-1], -chain.mass.sum() * acceleration, rtol=2e-3)
    s = np.linspace(0.0, WHISKER.length, 4001)
    density = 1220.0 + (1632.0 - 1220.0) * s / WHISKER.length
    mass = np.trapezoid(density * np.pi * WHISKER.radius(s) ** 2, s)
    assert chain.mass.sum() == pytest.approx(mass, rel=1e-3)


@pytest.mark.slow
def test_finer_steps_agree():
    motion = whisking(0.1, 1000.0, amplitude=0.6, elevation_drift=0.0, position_drift=0.0)
    felt_at = [
        felt(motion, move_dynamically(WHISKER, [], motion, Dynamics(segments=8, step=step)))[1]
        for step in (5e-4, 2.5e-4, 1.25e-4)
    ]
    coarse, fine = (np.abs(a - b)[20:].max() for a, b in pairwise(felt_at))
    assert coarse / fine > 3.0
    assert fine < 0.01 * np.abs(felt_at[-1]).max()


def test_a_dynamic_trial_is_recorded():
    peg = Peg([0.62 * WHISKER.length, 0.0, 0.0], [0.0, 0.0, 1.0], 1.35e-3)
    motion = settled(-0.15, 0.1)
    trial = simulate(WHISKER, motion, peg, dynamics=Dynamics(segments=10), friction=0.2)
    truth = trial["truth"].to_dataset().isel(whisker=0)
    contact = truth["in_contact"].values
    assert contact[-1]
    assert not contact[0]
    assert "with inertia" in trial.attrs["origin"]
    assert set(np.unique(truth["status"].values)) == {Status.OK, Status.NO_CONTACT}
    away = peg.signed_distance(truth["contact_point"].values[contact])
    radius = WHISKER.radius(truth["arc_length"].values[contact])
    assert (np.abs(away - radius) < 10e-6).all()
    np.testing.assert_allclose(
        peg.signed_distance(truth["surface_point"].values[contact]), 0.0, atol=1e-9
    )
    push = np.einsum("ti,ti->t", truth["contact_force"].values, truth["surface_normal"].values)
    assert (push[contact] > 0.0).all()
    # It has mass: the base feels something before the contact, and other than the contact's force.
    assert np.abs(truth["force"].values[~contact]).max() > 1e-7
    base = trial["base_position"].values[:, 0]
    np.testing.assert_allclose(truth["centerline"].values[:, 0], base, atol=1e-12)


def test_faults():
    with pytest.raises(ValueError, match=r"step is 0\.0; it must be positive"):
        Dynamics(step=0.0)
    with pytest.raises(ValueError, match="segments is 3"):
        Dynamics(segments=3)
    with pytest.raises(ValueError, match="damping_ratio is -1"):
        Dynamics(damping_ratio=-1.0)


def test_the_force_vanishes_when_a_whisker_slips_off():
    # In one step the tip is in the object without a force, and far from it with one.
    peg = facing_peg(WHISKER, 0.65)
    whole = sweep_past(WHISKER, peg, 0.6, 5000.0, seed=0, frequency=5.0)
    names = ("time", "azimuth", "elevation", "roll", "base_position")
    motion = Motion(*(getattr(whole, name)[450:930] for name in names))
    moments = move_dynamically(WHISKER, [peg], motion, Dynamics(step=2e-4))
    force = np.array([np.linalg.norm(one.contact_force) for one in moments])
    last = np.flatnonzero(np.isfinite(force))[-1]
    assert last > 450
    assert force[last] < 0.1 * force[last - 50]
