"""Shapes as triangles: closed, the right way out, the right size."""

import numpy as np
import pytest

from vibrissa.objects import Box, Peg, Plane, Sphere
from vibrissa.scene import cylinder, ellipsoid, error_ellipsoid, tube
from vibrissa.viewer.trial import object_body


def volume(vertices, faces):
    """Enclosed; positive where triangles turn outward."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0


def edges_close(vertices, faces):
    """Whether each edge belongs to one triangle in each direction."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[(vertices[edges[:, 0]] != vertices[edges[:, 1]]).any(axis=1)]
    forth = {tuple(edge) for edge in edges.tolist()}
    return all((b, a) in forth for a, b in forth)


def test_a_tube_is_closed_and_has_the_volume_of_its_cone():
    s = np.linspace(0.0, 1.0, 200)
    arc = np.stack([np.sin(s), 1.0 - np.cos(s), 0.0 * s], axis=1)
    radius = 0.05 * (1.0 - 0.9 * s)
    vertices, faces = tube(arc, radius, 48)
    assert edges_close(vertices, faces)
    exact = np.pi * np.trapezoid(radius**2, s)
    assert volume(vertices, faces) == pytest.approx(exact, rel=0.01)
    away = np.linalg.norm(vertices[:-2].reshape(200, 48, 3) - arc[:, None], axis=2)
    np.testing.assert_allclose(away, np.repeat(radius[:, None], 48, axis=1))


def test_a_tube_turns_around_without_folding():
    turn = np.linspace(0.0, 1.9 * np.pi, 150)
    ring = np.stack([np.cos(turn), np.sin(turn), 0.05 * turn], axis=1)
    vertices, _ = tube(ring, np.full(150, 0.1), 8)
    assert np.isfinite(vertices).all()


def test_cylinder_and_ellipsoid_enclose_their_volumes():
    vertices, faces = cylinder(np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.0, 1.0]), 0.5, 4.0, 96)
    assert volume(vertices, faces) == pytest.approx(np.pi, rel=0.01)
    axes = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0] * [3.0, 2.0, 1.0]
    vertices, faces = ellipsoid(np.ones(3), axes, 96)
    assert volume(vertices, faces) == pytest.approx(8.0 * np.pi, rel=0.01)


def test_an_error_ellipsoid_is_where_the_density_is_equal():
    covariance = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 0.5]])
    vertices, _ = error_ellipsoid(np.array([1.0, 0.0, 0.0]), covariance, 2.0)
    away = vertices - [1.0, 0.0, 0.0]
    squared = np.einsum("ij,jk,ik->i", away, np.linalg.inv(covariance), away)
    np.testing.assert_allclose(squared, 4.0)


@pytest.mark.parametrize(
    "thing",
    [
        Peg([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 0.4),
        Sphere([1.0, 0.0, 0.0], 2.0),
        Plane([0.0, 0.0, 1.0], [0.0, 1.0, 1.0]),
        Box([0.0, 0.0, 0.0], [1.0, 2.0, 3.0]),
    ],
)
def test_vertices_of_objects_lie_on_their_surface(thing):
    body = object_body(thing, 5.0, np.zeros(3))
    distance = thing.signed_distance(1e-3 * body.vertices)
    np.testing.assert_allclose(distance, 0.0, atol=1e-12)
    assert body.faces.min() == 0
    assert body.faces.max() == len(body.vertices) - 1
