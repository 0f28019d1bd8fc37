"""Rods with steps and kinks against an integration that starts anew at each of them."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vibrissa as vb
from vibrissa.rod import discretize

LENGTH = 40e-3
E, NU = 3e9, 0.38


def ramp(s):
    return np.array([0.0, -2.0 + 100.0 * s, 8.0 + 300.0 * s])


def integrated(load, curvature, radius, breaks):
    """Base force and contact point of a force at the contact, from the contact to the base."""
    contact, force = load

    def rates(s, y, low, high):
        s = min(max(s, low), high)
        n, q = y[:3], y[3:]
        bending = E * np.pi * radius(s) ** 4 / 4.0
        u = curvature(s) + np.cross(q, n) / (bending * np.array([1.0 / (1.0 + NU), 1.0, 1.0]))
        return np.concatenate([np.cross(n, u), np.cross(q, u) - [1.0, 0.0, 0.0]])

    y = np.append(force, np.zeros(3))
    for low, high in list(pairwise([0.0, *(b for b in breaks if b < contact), contact]))[::-1]:
        # Each piece sees its own side of the steps at its ends.
        inside = (low + 1e-15, high - 1e-15)
        found = solve_ivp(rates, (high, low), y, "DOP853", args=inside, rtol=1e-11, atol=1e-16)
        y = found.y[:, -1]
    return y[:3], y[3:]


def worst(whisker, curvature, radius, breaks, loads=6, seed=0):
    """Largest relative error of force, moment and contact point of loads up to about 60°."""
    random = np.random.default_rng(seed)
    s = random.uniform(0.3, 0.95, loads) * LENGTH
    angle, turned = random.uniform(-np.pi, np.pi, loads), np.radians(random.uniform(2, 60, loads))
    force = np.zeros((loads, 3))
    for i in range(loads):
        x = np.linspace(0.0, s[i], 400)
        soft = np.mean((s[i] - x) * 4.0 / (E * np.pi * radius(x) ** 4)) * s[i]
        force[i, 1:] = turned[i] / soft * np.array([np.cos(angle[i]), np.sin(angle[i])])
    bent = vb.deflect(whisker, vb.PointForce(s, components=force))
    assert (bent.status == vb.Status.OK).all()
    error = 0.0
    for i in range(loads):
        known, point = integrated((s[i], force[i]), curvature, radius, breaks)
        moment = np.cross(point, known)
        error = max(
            error,
            np.linalg.norm(bent.force[i] - known) / np.linalg.norm(known),
            np.linalg.norm(bent.moment[i] - moment) / np.linalg.norm(moment),
            np.linalg.norm(bent.contact_point[i] - point) / LENGTH,
        )
    return error


def staircase(edges, radii):
    edges = np.asarray(edges)
    return lambda s: np.asarray(radii)[np.searchsorted(edges, s, side="right")]


EDGES = LENGTH * np.array([0.11, 0.2, 0.34, 0.42, 0.57, 0.61, 0.78, 0.9])
RADII = 1e-6 * np.array([100.0, 96.0, 70.0, 75.0, 52.0, 46.0, 40.0, 31.0, 22.0])


def sides(edges, radii, gap):
    """Two samples for each step, so far apart, and base and tip."""
    s = np.concatenate([[0.0], np.repeat(edges, 2) + np.tile([-gap, gap], len(edges)) / 2])
    return np.column_stack([np.append(s, LENGTH), np.repeat(radii, 2)])


@pytest.mark.parametrize(
    "radius",
    [
        sides(EDGES, RADII, 0.0),
        sides(EDGES, RADII, 1e-7),
        staircase(EDGES, RADII),
    ],
    ids=["stated", "close", "function"],
)
def test_a_stepped_rod_meets_an_independent_integration(radius):
    whisker = vb.Whisker.from_curvature(LENGTH, ramp, radius=radius)
    np.testing.assert_allclose(whisker.breaks, EDGES, rtol=0, atol=1e-12)
    assert worst(whisker, ramp, staircase(EDGES, RADII), EDGES) <= 2e-6


def test_twenty_steps_among_many_samples():
    """The samples say where the steps are to within their distance: the middle is what is taken."""
    edges = np.linspace(0.0, LENGTH, 21)[1:-1]
    radius = staircase(edges, np.linspace(100e-6, 15e-6, 20))
    s = np.linspace(0.0, LENGTH, 340)
    whisker = vb.Whisker.from_curvature(LENGTH, ramp, radius=np.column_stack([s, radius(s)]))
    middles = (s[:-1] + s[1:])[np.diff(radius(s)) < 0.0] / 2.0
    np.testing.assert_allclose(whisker.breaks, middles, rtol=0, atol=1e-12)
    steps = staircase(middles, np.linspace(100e-6, 15e-6, 20))
    assert worst(whisker, ramp, steps, middles) <= 2e-6


@pytest.mark.parametrize("sampled", [True, False])
def test_a_kinked_rod_meets_an_independent_integration(sampled):
    kink = 0.43 * LENGTH

    def radius(s):
        return 80e-6 * np.minimum(1.0, 1.0 - 0.8 * (s - kink) / (LENGTH - kink))

    s = np.linspace(0.0, LENGTH, 57)
    given = np.column_stack([s, radius(s)]) if sampled else radius
    whisker = vb.Whisker.from_curvature(LENGTH, ramp, radius=given)
    np.testing.assert_allclose(whisker.breaks, [kink], rtol=0, atol=1e-9)
    assert worst(whisker, ramp, radius, [kink]) <= 2e-6


def test_a_short_steep_piece_has_steps_enough():
    """Of two steps, in each of which the radius fell by 30 %, the error was 2.6e-6."""
    kinks = LENGTH * np.array([0.623, 0.707, 0.749])
    places, radii = [0.0, *kinks, LENGTH], 1e-6 * np.array([100.0, 90.1, 88.1, 46.8, 12.0])

    def radius(s):
        return np.interp(s, places, radii)

    whisker = vb.Whisker.from_curvature(LENGTH, ramp, radius=radius, breaks=tuple(kinks))
    assert worst(whisker, ramp, radius, kinks, loads=3, seed=13) <= 1e-6


@pytest.mark.parametrize(
    ("radius", "breaks"),
    [
        (lambda s: 1e-4 * (1.0 - 0.8 * np.exp(-(((s / LENGTH - 0.3) / 0.06) ** 2))), ()),
        (lambda s: 1e-4 * (1.0 - 0.7 * np.exp(-s / LENGTH / 0.05)), ()),
        (staircase(EDGES[:2], 1e-6 * np.array([100.0, 25.0, 100.0])), EDGES[:2]),
    ],
    ids=["waist", "neck", "hinge"],
)
def test_contacts_of_a_rod_that_turns_in_a_hinge(radius, breaks):
    """A thin part that takes all the turning had too few steps: forces were up to 13 % wrong."""
    whisker = vb.Whisker.straight(LENGTH, radius=radius, breaks=breaks)
    arc_length = LENGTH * np.array([0.65, 0.8, 0.95])
    x = np.linspace(0.0, LENGTH, 4000)
    soft = np.array([np.mean(np.where(x < s, (s - x) / radius(x) ** 4, 0.0)) for s in arc_length])
    size = np.radians([40.0, 25.0, 55.0]) * E * np.pi / 4.0 / (soft * LENGTH)
    forces = np.column_stack([0.0 * size, size, 0.0 * size])
    known = [
        integrated(load, lambda s: np.zeros(3), radius, breaks)
        for load in zip(arc_length, forces, strict=True)
    ]
    force, point = (np.array(part) for part in zip(*known, strict=True))
    bent = vb.deflect(whisker, vb.PointContact(point))
    np.testing.assert_allclose(bent.arc_length, arc_length, rtol=2e-6)
    error = np.linalg.norm(bent.force - force, axis=1) / np.linalg.norm(force, axis=1)
    assert error.max() <= 2e-6


def test_noise_of_radii_is_not_taken_for_hinges():
    """Its changes counted twice: 2,170 steps, where 300 resolve them."""
    s = np.linspace(0.0, LENGTH, 200)
    radius = 1e-4 * (1.0 - 0.9 * s / LENGTH) * np.random.default_rng(1).normal(1.0, 0.2, len(s))
    radius = np.maximum(radius, 5e-6)
    whisker = vb.Whisker.straight(LENGTH, radius=np.column_stack([s, radius]))
    changes = np.abs(np.diff(np.log(radius))).sum()
    assert len(discretize(whisker).rod.start) < 8.0 * changes


def test_a_bend_in_the_curvature_that_was_not_stated():
    corner = 0.37 * LENGTH

    def curvature(s):
        return np.array([0.0, 0.0, 5.0 if s < corner else 45.0])

    whisker = vb.Whisker.from_curvature(LENGTH, curvature)
    np.testing.assert_allclose(whisker.breaks, [corner], rtol=0, atol=1e-12)
    assert worst(whisker, curvature, whisker.radius, [corner]) <= 2e-6


@pytest.mark.parametrize("count", [120, pytest.param(250, marks=pytest.mark.slow)])
def test_noise_of_measured_radii_averages_out(count):
    """Noise of 1 % makes no breaks, and its mean, not a few samples of it, is what bends."""
    s = np.linspace(0.0, LENGTH, count)
    noise = np.random.default_rng(count).standard_normal(count)
    radius = 100e-6 * (1.0 - 0.9 * s / LENGTH) * (1.0 + 0.01 * noise)
    whisker = vb.Whisker.straight(LENGTH, radius=np.column_stack([s, radius]))
    assert whisker.breaks == ()
    assert "scatter" in whisker.notes[0]
    known = [k for k in whisker.section_radius.knots if 0.0 < k < LENGTH]
    found = worst(whisker, lambda s: np.zeros(3), whisker.radius, known, loads=2)
    # A tenth of what the noise itself does to the compliance ∝ r⁻⁴.
    assert found <= 0.1 * 4.0 * 0.01 / np.sqrt(count)


@pytest.mark.parametrize(
    ("at", "width", "turn", "twist"),
    [
        (0.0, 0.05, 1.0, 0.0),
        (0.07, 0.016, 0.8, 0.6),
        (0.19, 0.016, 1.6, -1.0),
        (0.8, 0.03, 1.7, 0.0),
    ],
)
def test_steps_are_shorter_where_a_whisker_turns_sharply(at, width, turn, twist):
    """As in a hook; without a load it has its own shape."""
    length = 0.04

    def curvature(s):
        bump = np.exp(-0.5 * ((s / length - at) / width) ** 2) / (2.5 * width * length)
        return bump[..., None] * np.array([twist, 0.6 * turn, 0.8 * turn]) + [0.0, 10.0, 5.0]

    whisker = vb.Whisker.from_curvature(length, curvature, base_radius=5e-5, tip_radius=5e-6)
    s = np.array([0.35, 0.6, 0.95]) * length
    faint = 1e-9 * whisker.base_bending_stiffness / length**2
    bent = vb.deflect(whisker, vb.PointForce(s, components=np.tile([0.0, faint, 0.0], (3, 1))))
    places = [whisker.position(one) for one in s]
    np.testing.assert_allclose(bent.contact_point, places, atol=2e-6 * length)
