"""The bent centreline."""

import numpy as np
import pytest

import vibrissa as vb


def sizes(v):
    return np.linalg.norm(v, axis=-1)


@pytest.fixture(scope="module")
def bent(gamma):
    """Contacts from light to near slipping, at many places, one of them at the tip."""
    s = np.array([0.3, 0.5, 0.7, 0.9, 1.0])[:, None] * gamma.length
    force = np.array([1e-8, 1e-6, 1e-5]) * (1.0 - 0.95 * s / gamma.length) ** 2
    return vb.deflect(gamma, vb.PointForce(s, force, 2.0), steps=72)


def test_it_starts_at_the_base_along_x(bent):
    line = bent.centerline(2001)
    np.testing.assert_array_equal(line[..., 0, :], 0.0)
    first = line[..., 1, :] / sizes(line[..., 1, :])[..., None]
    np.testing.assert_allclose(first[..., 0], 1.0, atol=1e-5)


def test_it_passes_through_the_contact(bent):
    n = 1001
    line = bent.centerline(n)
    node = np.rint(bent.arc_length / bent.whisker.length * (n - 1)).astype(int)
    here = np.take_along_axis(line, node[..., None, None], axis=-2)[..., 0, :]
    np.testing.assert_allclose(here, bent.contact_point, rtol=0, atol=1e-7 * bent.whisker.length)


def test_it_keeps_its_length(bent):
    chords = sizes(np.diff(bent.centerline(20001), axis=-2)).sum(axis=-1)
    np.testing.assert_allclose(chords, bent.whisker.length, rtol=1e-7)


def test_nodes_do_not_depend_on_how_many_are_asked_for(bent):
    fine, coarse = bent.centerline(401), bent.centerline(5)
    np.testing.assert_allclose(coarse, fine[..., ::100, :], rtol=0, atol=1e-8 * 0.04)


def test_beyond_the_contact_it_has_its_shape_at_rest(gamma, bent):
    """Whatever lies beyond is carried along as a rigid body: all distances are those at rest."""
    line, rest = bent.centerline(201), gamma.centerline(201)
    for i, s in enumerate(bent.arc_length[:, 0] / gamma.length):
        free = int(np.ceil(s * 200 - 1e-9))
        for shape in line[i]:
            apart = sizes(shape[free:, None] - shape[None, free:])
            known = sizes(rest[free:, None] - rest[None, free:])
            np.testing.assert_allclose(apart, known, rtol=0, atol=1e-8 * gamma.length)


def test_up_to_the_contact_the_moment_bends_it(straight):
    """The curvature of a planar whisker is M / EI, with M the force times its lever."""
    s, n = 0.8 * straight.length, 4001
    bent = vb.deflect(straight, vb.PointForce(s, 1e-5, 0.0), steps=144)
    line = bent.centerline(n)
    h = straight.length / (n - 1)
    second = (line[2:] - 2.0 * line[1:-1] + line[:-2]) / h**2
    first = (line[2:] - line[:-2]) / (2.0 * h)
    curvature = np.cross(first, second)[:, 2]
    lever = np.cross(bent.contact_point - line[1:-1], bent.force)[:, 2]
    at = np.linspace(0.0, straight.length, n)[1:-1]
    inertia = np.pi * straight.radius(at) ** 4 / 4.0
    expected = np.where(at < s, lever / (straight.youngs_modulus * inertia), 0.0)
    away = np.abs(at - s) > 2.0 * h
    np.testing.assert_allclose(curvature[away], expected[away], rtol=0, atol=1e-3 * expected.max())


def test_without_contact_it_is_at_rest_and_without_an_answer_missing(parabola):
    peg = vb.PegContact([[0.02, -0.01, 0], [0.02, -0.5, 0]], (0, 0, 1), 1e-3, side=(0, 1, 0))
    free = vb.deflect(parabola, peg)
    np.testing.assert_array_equal(free.status, vb.Status.NO_CONTACT)
    np.testing.assert_allclose(free.centerline(77)[0], parabola.centerline(77), atol=1e-8)
    lost = vb.deflect(parabola, vb.PointContact([[0.0, 0.03, 0.0], [np.nan, 0.0, 0.0]]))
    assert np.isnan(lost.centerline(9)).all()


def test_a_compliant_base_turns_the_whole_whisker(gamma):
    stiffness = gamma.base_bending_stiffness / gamma.length
    soft = gamma.with_properties(base_stiffness=(stiffness, stiffness))
    bent = vb.deflect(soft, vb.PointForce(0.6 * gamma.length, 2e-6, 1.0), steps=144)
    line = bent.centerline(20001)
    tangent = (line[1] - line[0]) / sizes(line[1] - line[0])
    # The joint turns by the moment over its stiffness (both in the undeflected base frame).
    turn = bent.moment / stiffness
    angle = sizes(turn)
    x, unit = np.array([1.0, 0.0, 0.0]), turn / angle
    turned = (
        np.cos(angle) * x
        + np.sin(angle) * np.cross(unit, x)
        + (1.0 - np.cos(angle)) * unit * (unit @ x)
    )
    np.testing.assert_allclose(tangent, turned, rtol=0, atol=1e-3)
    node = round(0.6 * 20000)
    np.testing.assert_allclose(line[node], bent.contact_point, rtol=0, atol=1e-8 * gamma.length)


def test_two_points_are_the_least(bent):
    with pytest.raises(ValueError, match="at least 2 points; got n=1"):
        bent.centerline(1)


def test_it_says_what_became_of_its_loads(bent, parabola):
    assert repr(bent) == "<Deflection of (5, 3) by PointForce: ok 15>"
    lost = vb.deflect(parabola, vb.PointContact([0.0, 0.03, 0.0]))
    assert repr(lost).startswith("<Deflection of one by PointContact: ")
