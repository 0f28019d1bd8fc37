"""A mesh is the body that it samples."""

import numpy as np
import pytest

from vibrissa import Status, samples
from vibrissa.objects import Box, Mesh, Peg
from vibrissa.recording import Recording
from vibrissa.rod import follow_surfaces
from vibrissa.simulation import simulate, whisking
from vibrissa.whisker import base_rotation

WHISKER = samples.gamma()
RADIUS = 1.35e-3


def cylinder(radius, sides, half, origin):
    """Corners and triangles of a closed prism."""
    angle = np.arange(sides) * 2.0 * np.pi / sides
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)
    up = np.array([0.0, 0.0, half])
    vertices = np.concatenate([ring - up, ring + up, [-up, up]]) + origin
    i = np.arange(sides)
    j = (i + 1) % sides
    below, above = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    faces = [
        np.stack([i, j, sides + j], axis=1),
        np.stack([i, sides + j, sides + i], axis=1),
        np.stack([j, i, below], axis=1),
        np.stack([sides + i, sides + j, above], axis=1),
    ]
    return vertices, np.concatenate(faces)


CUBE = (
    np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * 4e-3,
    np.array(
        [
            [[0, 1, 3], [0, 3, 2]],
            [[4, 6, 7], [4, 7, 5]],
            [[0, 4, 5], [0, 5, 1]],
            [[2, 3, 7], [2, 7, 6]],
            [[0, 2, 6], [0, 6, 4]],
            [[1, 5, 7], [1, 7, 3]],
        ]
    ).reshape(-1, 3),
)


@pytest.fixture(scope="module")
def peg():
    return Peg([0.62 * WHISKER.length, 0.0, 0.0], [0.0, 0.0, 1.0], RADIUS)


@pytest.fixture(scope="module")
def mesh(peg):
    return Mesh(*cylinder(RADIUS, 96, 9e-3, peg.origin), resolution=0.1e-3)


@pytest.mark.parametrize("flipped", [False, True])
def test_a_cube_is_a_box(flipped):
    vertices, faces = CUBE
    faces = faces[:, ::-1] if flipped else faces
    cube = Mesh(vertices, faces, resolution=0.1e-3)
    box = Box([2e-3, 2e-3, 2e-3], [4e-3, 4e-3, 4e-3])
    points = np.random.default_rng(0).uniform(-0.5e-3, 4.5e-3, (3000, 3))
    expected = box.signed_distance(points)
    error = np.abs(cube.signed_distance(points) - expected)
    # Edges are rounded by about the spacing.
    near = np.abs(expected) < 0.25e-3
    assert error[near].max() < 0.05e-3
    beside = np.sort(np.maximum(-points, points - 4e-3), axis=1)
    assert error[near & (beside[:, 1] < -0.8e-3)].max() < 1e-6


def test_its_geometry_is_that_of_its_distance(mesh, peg):
    generator = np.random.default_rng(1)
    points = peg.origin + generator.normal(scale=1.2e-3, size=(60, 3))
    points = points[np.abs(peg.signed_distance(points)) < 0.3e-3]
    assert len(points) > 5
    for point in points:
        distance, normal, turn = mesh.local_geometry(point)
        assert distance == pytest.approx(float(mesh.signed_distance(point)), abs=1e-12)
        step = 1e-8 * np.eye(3)
        slope = mesh.signed_distance(point + step) - mesh.signed_distance(point - step)
        np.testing.assert_allclose(normal, slope / np.linalg.norm(slope), atol=1e-5)
        numeric = [
            mesh.local_geometry(point + s)[1] - mesh.local_geometry(point - s)[1] for s in step
        ]
        np.testing.assert_allclose(turn, np.array(numeric).T / 2e-8, rtol=0, atol=5.0)


def test_a_cylinder_of_triangles_is_a_peg(mesh, peg):
    motion = whisking(0.2, 500.0, amplitude=np.radians(55.0), set_point=np.radians(-5.0), seed=1)
    for friction in (0.0, 0.3):
        found, expected = (
            follow_surfaces(
                WHISKER, [x], motion.base_rotation, motion.base_position, friction=friction
            )
            for x in (mesh, peg)
        )
        touching = [
            np.isin(x.bent.status, (Status.OK, Status.TIP_CONTACT)) for x in (found, expected)
        ]
        # Where exactly the whisker slips off may differ by a frame.
        assert (touching[0] != touching[1]).sum() <= 1
        both = touching[0] & touching[1]
        size = np.linalg.norm(expected.bent.force[both], axis=1).max()
        error = np.linalg.norm((found.bent.force - expected.bent.force)[both], axis=1) / size
        # The facets' normals are 1° away from the cylinder's, and their edges are smoothed.
        assert error.size >= 15
        assert error.max() < 0.02
        assert np.median(error) < 5e-4


def test_it_rides_along_in_a_recording(mesh):
    motion = whisking(0.002, 1000.0, set_point=-2.0)
    (read,) = Recording(simulate(WHISKER, motion, mesh)).objects
    points = mesh.origin + np.random.default_rng(3).normal(scale=1e-3, size=(10, 3))
    np.testing.assert_allclose(read.signed_distance(points), mesh.signed_distance(points))


def test_it_is_read_from_files(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    vertices, faces = CUBE
    trimesh.Trimesh(vertices * 1e3, faces).export(tmp_path / "cube.stl")
    cube = Mesh.load(tmp_path / "cube.stl", resolution=0.2e-3)
    np.testing.assert_allclose(np.ptp(cube.vertices, axis=0), 4e-3)
    with pytest.raises(FileNotFoundError, match="there is no file"):
        Mesh.load(tmp_path / "none.stl")


def test_faulty_meshes():
    vertices, faces = CUBE
    with pytest.raises(ValueError, match="not closed: 3 edges"):
        Mesh(vertices, faces[1:])
    with pytest.raises(ValueError, match="not closed"):
        Mesh(vertices, np.r_[faces[:1, ::-1], faces[1:]])
    with pytest.raises(ValueError, match="refer to vertices 0 to 9 of 8"):
        Mesh(vertices, np.r_[faces, [[0, 1, 9]]])
    with pytest.raises(ValueError, match="resolution is 1e-06"):
        Mesh(vertices, faces, resolution=1e-6)


def test_a_turned_mesh_is_turned():
    vertices, faces = CUBE
    turn = base_rotation(0.4, 0.2, 0.1)
    upright = Mesh(vertices, faces, resolution=0.1e-3)
    turned = Mesh(vertices @ turn.T, faces, resolution=0.1e-3)
    points = np.random.default_rng(0).uniform(-1e-3, 5e-3, (500, 3))
    points = points[np.abs(upright.signed_distance(points)) < 0.3e-3]
    away = turned.signed_distance(points @ turn.T) - upright.signed_distance(points)
    assert np.abs(away).max() < 0.05e-3
