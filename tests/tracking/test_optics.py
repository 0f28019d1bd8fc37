"""Cameras that are known only roughly: what a free whisker shows of them, from exact traces."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from vibrissa.cameras import orthogonal_views, triangulate
from vibrissa.tracking import Trace
from vibrissa.tracking.refine.fit import RodFit
from vibrissa.tracking.refine.optics import (
    Optics,
    rough_optics,
    stated_lenses,
    unchecked_optics,
    with_optics_unsure,
)
from vibrissa.tracking.refine.rods import deformations
from vibrissa.tracking.space.frame_pairs import clear_offsets

PIXEL = 150e-6
STATED = orthogonal_views(PIXEL, (400, 400))
TOP = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
FRONT = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]
"""Directions right, down and forward of the views; the front one is mirrored."""


def pinhole(points, axes, distance):
    """Pixels by the equations of a lens, which share nothing with the cameras under test."""
    right, down, ahead = np.moveaxis(points @ np.array(axes).T, -1, 0)
    scale = distance / (distance + ahead) / PIXEL
    return 199.5 + np.stack([right * scale, down * scale], axis=-1)


def sweep(count=30):
    """A rigid whisker of 36 mm that turns through 70° and up and down through 60°."""
    x = np.linspace(0.0, 34e-3, 101)
    line = np.column_stack([x, 8.0 * x**2, 0.0 * x])
    u = np.linspace(0.0, 1.0, count)
    turns = np.column_stack([0.6 * np.sin(7.0 * u), 0.5 * np.sin(5.0 * u), 0.4 * np.cos(4.0 * u)])
    base = np.column_stack([-14.0 + u, 2.0 + np.sin(6.0 * u), u**2]) * 1e-3
    turned = Rotation.from_euler("zyx", turns).as_matrix() @ line.T
    return np.swapaxes(turned, 1, 2) + base[:, None]


def traces(lines, axes, distance):
    sigma, seen = np.full(lines.shape[1], 0.02), np.ones(lines.shape[1], dtype=bool)
    distances = np.broadcast_to(distance, len(axes))
    views = [pinhole(lines, axis, far) for axis, far in zip(axes, distances, strict=True)]
    return [[Trace(line, sigma, seen, 1.0) for line in view] for view in views]


def turned(axes, angle):
    """A view that is turned about its own direction to the right."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]]) @ np.array(axes)


@pytest.fixture(scope="module")
def lenses():
    """A lens at 0.3 m in each view, the second turned by 4° from where it is stated."""
    lines = sweep()
    views = traces(lines, [TOP, turned(FRONT, np.radians(4.0))], 0.3)
    return lines, views, rough_optics(STATED, views)


def test_lenses_that_orthographic_cameras_cannot_explain_are_found(lenses):
    lines, views, found = lenses
    assert found.needed
    assert found.before > 3.0 * found.after
    assert (np.abs(found.values[:2] - 1.0 / 0.3) < 3.0 * found.sigma[:2] + 0.1).all()
    pixels = np.stack([[trace.line for trace in view] for view in views])
    errors = [
        np.linalg.norm(triangulate(cameras, pixels)[0] - lines, axis=-1).max()
        for cameras in (STATED, found.cameras)
    ]
    assert errors[0] > 2e-3
    assert errors[1] < 0.3 * errors[0]
    assert "turned by" in str(found)


def test_a_stated_distance_is_used():
    lines = sweep()
    views = traces(lines, [TOP, FRONT], 0.4)
    found = rough_optics(STATED, views, 0.4)
    np.testing.assert_allclose(1.0 / found.values[:2], 0.4, rtol=0.02)
    exact = stated_lenses(STATED, 0.4)
    for view, axes in zip(exact, (TOP, FRONT), strict=True):
        np.testing.assert_allclose(view.project(lines), pinhole(lines, axes, 0.4), atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("distance", [None, 0.4])
def test_a_front_view_that_is_not_mirrored_is_seen_from_its_other_side(distance):
    """Its image is that of the mirrored one, but what is nearer to the lens is farther."""
    lines = sweep()
    views = traces(lines, [TOP, FRONT], [0.4, -0.4])
    found = rough_optics(STATED, views, distance)
    assert found.values[1] < -2.0 * found.sigma[1]
    assert "on its other side" in str(found)
    pixels = np.stack([[trace.line for trace in view] for view in views])
    away = triangulate(found.cameras, pixels)[0] - lines
    moved = np.linalg.norm(found.displacements(lines), axis=(0, -1))
    assert (np.linalg.norm(away, axis=-1) < 3.0 * moved + 2e-5).all()


@pytest.mark.slow
def test_frames_in_contact_are_no_evidence_of_lenses():
    """Half of the frames are bent as in contact, by less than wrong lenses would bend them."""
    lines = sweep(60)
    s = np.linspace(0.0, 1.0, lines.shape[1])
    lines[30:] += (0.9e-3 * np.linspace(0.2, 1.0, 30)[:, None] * s**2)[..., None] * [0.0, 1.0, 0.3]
    found = rough_optics(STATED, traces(lines, [TOP, FRONT], 1e6))
    assert max(found.before, found.after) < 0.01
    assert not found.needed
    assert (np.abs(found.values) < 3.0 * found.sigma + 1e-3).all()


@pytest.mark.slow
def test_turns_that_are_not_known_are_in_the_displacements():
    """A whisker that hardly moves leaves a turn of the front view about its columns unknown."""
    lines = sweep()
    still = np.repeat(lines[:1], 20, axis=0) + 1e-5 * np.arange(20)[:, None, None]
    found = rough_optics(STATED, traces(still, [TOP, FRONT], 1e6)).as_stated()
    moved = np.linalg.norm(found.displacements(np.array([[10e-3, 0.0, 8e-3]])), axis=(0, -1))
    assert moved[0] > 8e-3 * found.sigma[2:5].max() * 0.5


def test_a_base_that_fur_hides_in_one_view_is_no_evidence_of_optics():
    """The second view shows 0.7 mm less of the whisker at its base in all frames."""
    top, front = traces(sweep(), [TOP, FRONT], 0.4)
    shown = [Trace(one.line[2:], one.sigma[2:], one.seen[2:], 1.0) for one in front]
    found = rough_optics(STATED, [top, shown])
    wrong = found.values - [2.5, 2.5, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert wrong @ np.linalg.solve(found.covariance, wrong) < 14.1
    assert (np.abs(wrong[:2]) < 0.5).all()


def test_cameras_that_no_free_frame_can_check_are_as_unsure_as_they_were_stated():
    one = unchecked_optics(STATED[:1], 0.5)
    assert one.cameras[0].projection == "perspective"
    np.testing.assert_allclose([one.values, one.sigma], [[2.0], [0.2]])
    both = unchecked_optics(STATED)
    assert [camera.projection for camera in both.cameras] == ["orthographic"] * 2
    assert np.linalg.norm(both.displacements(np.full(3, 20e-3))) > 1e-3


def test_only_what_rigid_motions_and_one_shape_do_not_explain_bends_a_whisker():
    points = sweep(12)[:, ::10]
    free = np.arange(12) < 6
    rng = np.random.default_rng(1)
    turns = 1e-3 * rng.normal(size=(12, 1, 3))
    rotation = Rotation.from_rotvec(rng.normal(size=(12, 3))).as_matrix()
    shape = np.zeros((points.shape[1], 3))
    shape[:, 1] = np.linspace(-1e-4, 1e-4, len(shape)) ** 2
    start = rotation[:1].swapaxes(1, 2) @ points[0].T
    same = (rotation @ start).swapaxes(1, 2)
    moved = np.cross(turns, same) + 1e-4 * rng.normal(size=(12, 1, 3))
    moved = moved + (rotation @ shape.T).swapaxes(1, 2)
    left = deformations(moved[None], same, rotation, free)
    np.testing.assert_allclose(left, 0.0, atol=1e-15)
    moved[9] += same[9] ** 2
    left = deformations(moved[None], same, rotation, free)
    assert np.abs(left[0, 9]).max() > 1e-5
    np.testing.assert_allclose(np.delete(left, 9, axis=1), 0.0, atol=1e-15)


def test_orthographic_views_are_explained_by_what_was_stated():
    found = rough_optics(STATED, traces(sweep(), [TOP, FRONT], 1e6))
    assert not found.needed
    assert found.before < 0.05


@pytest.mark.slow
def test_cameras_that_explain_the_views_are_not_known_worse_than_before():
    """Other optics explain them as well, but far from what was stated."""
    lines = sweep()
    still = np.repeat(lines[:1], 20, axis=0) + 1e-5 * np.arange(20)[:, None, None]
    found = rough_optics(STATED, traces(still, [TOP, FRONT], 1e6))
    far = replace(found, values=found.stated + 3.0 * found.prior)
    more = (far.as_stated().covariance - found.covariance) / np.outer(found.prior, found.prior)
    assert np.linalg.eigvalsh(more)[-1] == pytest.approx(len(found.prior))
    near = replace(found, values=found.stated + 0.9 * found.prior)
    assert near.as_stated().covariance - found.covariance == pytest.approx(
        0.81 * np.outer(found.prior, found.prior)
    )


@pytest.mark.slow
def test_what_is_not_known_of_lenses_moves_points_away_from_the_middle():
    lines = sweep()
    # A whisker that hardly moves does not show how far the lenses are.
    still = np.repeat(lines[:1], 20, axis=0) + 1e-5 * np.arange(20)[:, None, None]
    found = rough_optics(STATED, traces(still, [TOP, FRONT], 1e6)).as_stated()
    points = np.array([[0.0, 0.0, 0.0], [10e-3, 0.0, 8e-3]])
    alone = np.diag(np.where(np.arange(7) == 0, found.sigma**2, 1e-30))
    moved = replace(found, covariance=alone).displacements(points)
    np.testing.assert_allclose(moved[:, 0], 0.0, atol=1e-9)
    # A lens above at 1/s instead of infinity shows (10, 0, 8) mm larger by 8 mm · s.
    assert moved[0, 1, 0] == pytest.approx(0.5 * 10e-3 * 8e-3 * found.sigma[0], rel=0.1)


def test_no_offset_is_noted_where_none_explains_the_misfit():
    """Lenses and angles that were not stated make lines of sight pass each other."""
    lines = sweep(100)
    wrong = traces(lines, [TOP, turned(FRONT, np.radians(10.0))], 0.3)
    assert not clear_offsets(*STATED, *wrong, 0).shifts.any()


def test_no_offset_is_noted_for_a_base_that_hairs_displace():
    """One view sees the base 3 pixels too far to the right, and later too far to the left."""
    moved = np.arange(100)[:, None, None] * [0.1 * PIXEL, 0.0, 0.0]
    seen = traces(sweep(2)[:1] + moved, [TOP, FRONT], 1e6)
    for i, trace in enumerate(seen[1]):
        trace.line[0, 0] += 3.0 if i < 50 else -3.0
    assert not clear_offsets(*STATED, *seen, 0).shifts.any()


@pytest.mark.parametrize("late", [1, 3])
def test_an_offset_is_noted_in_a_short_film(late):
    """The second of two telecentric cameras, otherwise as stated, began later."""
    lines = sweep(40)
    seen = traces(lines, [TOP, FRONT], 1e6)
    assert (clear_offsets(*STATED, seen[0], seen[1][late:], 0).shifts == -late).all()
    assert not clear_offsets(*STATED, *seen, 0).shifts.any()


def test_a_turn_that_traces_show_is_used_though_little_is_left_unexplained():
    found = rough_optics(STATED, traces(sweep(), [TOP, turned(FRONT, np.radians(2.0))], 1e6))
    assert found.before < 0.05
    assert found.needed
    assert np.degrees(np.linalg.norm(found.values[2:5])) == pytest.approx(2.0, abs=0.1)


@pytest.mark.slow
def test_optics_are_no_surer_than_errors_that_neighbouring_points_and_frames_share():
    misses = []
    for seed in range(5):
        noise = np.random.default_rng(seed).normal(size=(2, *sweep().shape[:2], 2))
        wrong = gaussian_filter(2.0 * noise, (0.0, 3.0, 8.0, 0.0))
        views = [
            [one._replace(line=one.line + error) for one, error in zip(*both, strict=True)]
            for both in zip(traces(sweep(), [TOP, FRONT], 1e6), wrong, strict=True)
        ]
        found = rough_optics(STATED, views)
        misses.append((found.values - found.stated) / found.sigma)
    assert np.sqrt(np.mean(np.square(misses))) < 1.2


@pytest.mark.parametrize(("error", "size"), [(2, 0.05), (3, 0.05), (4, 0.05), (5, 0.02)])
def test_directions_and_loads_are_as_uncertain_as_the_cameras(error, size):
    """A turn of the front view about one of its axes, and its scale."""
    rotation = Rotation.from_rotvec([[0.1, 0.2, 0.3], [-0.4, 0.1, 0.9]]).as_matrix()
    base = np.array([[1e-3, 2e-3, -1e-3], [0.0, 1e-3, 2e-3]])
    tangent, load = rotation[:, :, 0], np.array([[1.0, -2.0, 0.5], [0.0, 1.0, 1.0]])
    covariance = np.diag(np.where(np.arange(7) == error, size**2, 1e-20))
    none = np.zeros(7)
    found = Optics(STATED, STATED, none, covariance, none, none, 0.0, 0.0)
    exact = {field.name: np.zeros((2, 1)) for field in fields(RodFit)}
    exact |= {f"{name}_covariance": np.zeros((2, 6, 6)) for name in ("pose", "wrench")}
    exact |= {"contact_covariance": np.zeros((2, 3, 3)), "shared": np.zeros((2, 0, 15))}
    exact |= {"pose_wrench_covariance": np.zeros((2, 6, 6)), "rotation": rotation}
    exact |= {"position": base, "contact_point": base + 5e-3 * tangent}
    fit = with_optics_unsure(RodFit(**exact | {"force": load, "moment": 1e-3 * load}), found)
    # Only the front shows z, and both views show x, of which half is by the front.
    stretch = {
        2: np.outer([0.0, 0.0, 1.0], [0.0, 1.0, 0.0]),
        3: 0.5 * np.outer([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
        4: 0.5 * np.outer([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]) - np.outer([0, 0, 1.0], [1.0, 0, 0]),
        5: np.diag([0.5, 0.0, 1.0]),
    }[error]
    change = size * tangent @ stretch.T
    along = (change * tangent).sum(axis=1, keepdims=True)
    across = np.linalg.norm(change - along * tangent, axis=1)
    turns = np.cross(fit.shared[:, error, 6:9], tangent)
    np.testing.assert_allclose(np.linalg.norm(turns, axis=1), across, atol=0.1 * size)
    np.testing.assert_allclose(
        np.einsum("tii->t", fit.pose_covariance[:, :3, :3]),
        (found.displacements(base) ** 2).sum(axis=(0, 2)),
    )
    seen = np.einsum("tij,tj->ti", rotation, load)
    deformed = np.linalg.norm(0.5 * size * seen @ (stretch + stretch.T), axis=1)
    spread = np.sqrt(np.einsum("tii->t", fit.wrench_covariance[:, :3, :3]))
    np.testing.assert_allclose(spread, deformed, atol=0.1 * size)
    np.testing.assert_allclose(
        fit.wrench_covariance[:, 3:, 3:], 1e-6 * fit.wrench_covariance[:, :3, :3], rtol=1e-9
    )
