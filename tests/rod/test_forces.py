"""Known forces of any size: the equilibrium that grows from rest, or a status."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp

import vibrissa as vb
from vibrissa.rod import discretize

OK, TOO_STRONG = vb.Status.OK, vb.Status.TOO_STRONG


def sizes(v):
    return np.linalg.norm(v, axis=-1)


def integrated(whisker, s, force):
    """Base force and contact point by another integrator: the six equations from the contact."""
    stiffness = whisker.youngs_modulus * np.pi / 4.0

    def rate(x, y):
        n, q = y[:3] * scale, y[3:]
        bending = stiffness * whisker.radius(x) ** 4
        moment = np.cross(q, n) / bending * [1.0 + whisker.poisson_ratio, 1.0, 1.0]
        u = whisker.curvature(x) + moment
        return np.concatenate([np.cross(n, u) / scale, np.cross(q, u) - [1.0, 0.0, 0.0]])

    scale = sizes(force)
    start = np.concatenate([force / scale, np.zeros(3)])
    end = solve_ivp(rate, (s, 0.0), start, method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
    return end[:3] * scale, end[3:]


@pytest.mark.parametrize(
    "components", [(0, 1e-3, 0), (0, -4e-3, 7e-3), (3e-3, 1e-3, -2e-3), (-2e-2, 5e-3, 1e-2)]
)
def test_strong_forces_meet_an_independent_integration(gamma, components):
    s = 0.6 * gamma.length
    bent = vb.deflect(gamma, vb.PointForce(s, components=components))
    assert bent.status == OK
    force, point = integrated(gamma, s, np.array(components, dtype=float))
    assert sizes(bent.force - force) <= 1e-4 * sizes(force)
    assert sizes(bent.contact_point - point) <= 1e-4 * gamma.length


def test_one_newton_has_its_equilibrium():
    whisker = vb.samples.gamma()
    bent = vb.deflect(whisker, vb.PointForce(0.5 * whisker.length, 1.0, [0.0, 1.0, -2.0]))
    np.testing.assert_array_equal(bent.status, OK)
    np.testing.assert_allclose(sizes(bent.force), 1.0, rtol=1e-4)


def test_the_equilibrium_grows_from_rest_with_the_force(gamma):
    share = np.linspace(0.0, 1.0, 4001)
    force = share[:, None] * [1e-3, -2e-3, 1e-3]
    bent = vb.deflect(gamma, vb.PointForce(0.7 * gamma.length, components=force))
    np.testing.assert_array_equal(bent.status, OK)
    rest = gamma.position(0.7 * gamma.length)
    assert sizes(bent.contact_point[0] - rest) <= 1e-9 * gamma.length
    assert (sizes(np.diff(bent.contact_point, axis=0)) <= 0.02 * gamma.length).all()


@settings(max_examples=40)
@given(
    size=st.floats(-12.0, 308.0),
    lean=st.floats(-1.5, 1.5),
    bearing=st.floats(-3.0, 3.0),
    s=st.floats(0.01, 1.0),
)
def test_any_force_has_its_equilibrium_or_is_too_strong(gamma, size, lean, bearing, s):
    across = np.cos(lean) * np.array([np.cos(bearing), np.sin(bearing)])
    components = 10.0**size * np.array([np.sin(lean), *across])
    bent = vb.deflect(gamma, vb.PointForce(s * gamma.length, components=components))
    assert bent.status in (OK, TOO_STRONG)
    if bent.status == OK:
        assert abs(sizes(bent.force / 10.0**size) - 1.0) <= 2e-4
    else:
        assert size > -5.0
        assert np.isnan([*bent.force, *bent.contact_point, bent.arc_length]).all()


def test_the_line_of_a_strongly_bent_whisker_passes_through_its_contact(gamma):
    n = 401
    force = np.array([1e-6, 1e-4, 1e-3, 1e-2, 1e-1])
    bent = vb.deflect(gamma, vb.PointForce(0.6 * gamma.length, force, 0.5))
    np.testing.assert_array_equal(bent.status, OK)
    line = bent.centerline(n)
    assert (sizes(line[:, 240] - bent.contact_point) <= 2e-4 * gamma.length).all()
    assert (sizes(np.diff(line, axis=1)) <= (1.0 + 1e-4) * gamma.length / (n - 1)).all()


def test_a_soft_base_follows_strong_forces_as_well(gamma):
    """Its own steps are halved with the others."""
    d = discretize(gamma)
    soft = gamma.with_properties(base_stiffness=(0.3 * d.moment, 0.2 * d.moment))
    load = vb.PointForce(0.5 * gamma.length, 60.0 * d.force, [0.0, 0.7, 2.0])
    bent, finer = vb.deflect(soft, load), vb.deflect(soft, load, steps=36 * 32)
    np.testing.assert_array_equal(bent.status, OK)
    assert (sizes(bent.contact_point - finer.contact_point) <= 2e-4 * gamma.length).all()


def test_a_soft_base_that_turns_far_is_as_accurate_as_the_whisker(gamma):
    stiffness = discretize(gamma).moment / 6.0
    soft = gamma.with_properties(base_stiffness=(stiffness, stiffness))
    fold = vb.ContactMap.simulate(soft, cells=(4, 8, 4), grid=False).to_dataset().fold_force[2]
    load = vb.PointForce(0.65 * gamma.length, 0.9 * fold.values, fold.bearing.values)
    bent = vb.deflect(soft, load, steps=36 * 8)
    np.testing.assert_array_equal(bent.status, OK)
    found = vb.deflect(soft, vb.PointContact(bent.contact_point))
    np.testing.assert_allclose(found.arc_length, bent.arc_length, atol=2e-5 * gamma.length)
    np.testing.assert_allclose(found.force, bent.force, atol=1e-5 * sizes(bent.force).max())
