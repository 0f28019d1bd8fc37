"""A peg whose place is unknown: found by its outline, and fitted with the contacts."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from vibrissa import Whisker
from vibrissa.cameras import Camera, orthogonal_views
from vibrissa.objects import Box, Peg
from vibrissa.recording import Recording
from vibrissa.simulation import Motion, simulate
from vibrissa.tracking import TrackOptions, trace_video, track
from vibrissa.tracking.refine.edge import OFFSETS, place_of_outline
from vibrissa.tracking.refine.fit import RodFit, Touches
from vibrissa.tracking.refine.peg import PEG_UNKNOWNS, UNITS, UncertainPeg
from vibrissa.tracking.refine.problem import Smoother
from vibrissa.tracking.refine.silhouette import (
    _edges,
    _largest_near,
    _median,
    _View,
    explains,
    on_peg,
    peg_in_images,
)
from vibrissa.tracking.space.rest_shape import _free

SIZE, PIXEL, HALF = 260, 100e-6, 20e-3


@pytest.mark.parametrize("count", [1, 2, 7, 30])
def test_medians_of_images_are_those_of_numpy(count):
    frames = np.random.default_rng(count).integers(0, 256, (count, 9, 12)).astype(np.uint8)
    np.testing.assert_array_equal(_median(list(frames)), np.median(frames, axis=0))


def test_largest_values_nearby_are_those_of_scipy():
    values = np.random.default_rng(0).normal(size=(9, 12))
    np.testing.assert_array_equal(_largest_near(values), maximum_filter(values, 5))


def lenses():
    """Two lenses at 0.5 m, one above and one in front."""
    focal = 0.5 / PIXEL
    matrix = np.array([[focal, 0.0, 129.5], [0.0, focal, 129.5], [0.0, 0.0, 1.0]])
    top = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    front = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    far = np.array([0.0, 0.0, 0.5])
    return [Camera(matrix, axes, far, size=(SIZE, SIZE)) for axes in (top, front)]


def drawn(camera, inside, seed=0):
    """Image of a solid, whose inside is told for points along lines of sight (n, point, 3)."""
    rows, columns = np.mgrid[:SIZE, :SIZE].reshape(2, -1)
    pixels = np.stack([columns, rows], axis=1)
    if camera.projection == "perspective":
        lens = -camera.rotation.T @ camera.translation
        ways = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(camera.matrix).T
        ways = ways @ camera.rotation
        far = np.linspace(0.475, 0.525, 200)
        covered = np.zeros(len(pixels), dtype=bool)
        for t in far:
            covered |= inside(lens + t * ways)
    else:
        across = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(camera.matrix).T
        covered = np.zeros(len(pixels), dtype=bool)
        for t in np.linspace(-0.025, 0.025, 200):
            covered |= inside((across * [1.0, 1.0, 0.0] + [0.0, 0.0, t]) @ camera.rotation)
    image = np.where(covered.reshape(SIZE, SIZE), 40.0, 190.0)
    noise = np.random.default_rng(seed).normal(0.0, 1.5, image.shape)
    return np.clip(gaussian_filter(image, 0.8) + noise, 0, 255).astype(np.uint8)


def within(peg):
    """Whether points are in a peg of finite length."""

    def inside(points):
        along = (points - peg.origin) @ peg.axis
        return (np.abs(along) < HALF) & (peg.signed_distance(points) < 0.0)

    return inside


def touches_of(peg, slid=0.0, whisker=40e-6):
    """Contacts of a whisker along x with the near side of a peg, moved along it by an error."""
    angle = np.linspace(-0.25, 0.25, 12)
    first = np.cross(peg.axis, [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    normals = -np.cos(angle)[:, None] * first - np.sin(angle)[:, None] * np.cross(first, peg.axis)
    tangents = np.cross(normals, peg.axis)
    heights = np.linspace(-1e-3, 1e-3, 12)[:, None] * peg.axis
    points = peg.origin + heights + (peg.radius + whisker) * normals + slid * tangents
    return Touches(points, normals, tangents, np.full(12, whisker), 1e-3)


LEANING = [
    [0.15, 0.25, 1.0],
    [-0.2, 0.05, 1.0],
    [0.01, 0.03, 1.0],  # the lens above looks along it
]


@pytest.mark.parametrize("axis", LEANING)
def test_a_peg_is_measured_by_its_outline(axis):
    """Contacts that are wrong by 0.8 mm along the whisker do not displace it."""
    peg = Peg([1e-3, 2e-3, 0.5e-3], axis, 1.1e-3)
    cameras = lenses()
    sample = [[drawn(camera, within(peg))] * 3 for camera in cameras]
    found = peg_in_images(cameras, sample, touches_of(peg, slid=0.8e-3))
    assert found is not None
    shift = peg.origin - found.expected.origin
    middle = shift - (shift @ peg.axis) * peg.axis
    assert np.linalg.norm(middle) < 60e-6
    assert abs(found.expected.radius - peg.radius) < 20e-6
    assert np.arccos(abs(found.expected.axis @ peg.axis)) < np.radians(0.7)
    # And as exactly as is stated.
    frame = found.at(np.eye(PEG_UNKNOWNS)[0]).origin - found.expected.origin
    assert abs(middle @ frame) / 1e-3**2 < 4.0 * np.sqrt(found.covariance[0, 0])


@pytest.mark.parametrize("response", [lambda x: x**0.45, lambda x: np.clip(2.2 * x - 0.6, 0, 1)])
def test_a_peg_is_as_thick_as_is_stated_to_cameras_that_are_not_linear(response):
    """Where grey values change fastest is not where half of the light is."""
    peg = Peg([1e-3, 2e-3, 0.5e-3], [0.15, 0.25, 1.0], 1.1e-3)
    cameras = lenses()
    sample = []
    for camera in cameras:
        image = 255.0 * response(drawn(camera, within(peg)) / 255.0)
        sample.append([image.astype(np.uint8)] * 3)
    found = peg_in_images(cameras, sample, touches_of(peg))
    assert found is not None
    assert abs(found.expected.radius - peg.radius) < 2.5 * found.radius_sigma


def test_a_reflection_on_a_peg_is_no_outline():
    """It leaves a dark band to each side of it, with edges as a thinner peg would have."""
    peg = Peg([1e-3, 2e-3, 0.5e-3], [0.15, 0.25, 1.0], 1.35e-3)
    core, cameras = within(Peg(peg.origin, peg.axis, 0.6 * peg.radius)), lenses()
    sample = []
    for camera in cameras:
        image = drawn(camera, within(peg))
        image[drawn(camera, core) < 115] = 130
        sample.append([image] * 3)
    found = peg_in_images(cameras, sample, touches_of(peg))
    assert found is not None
    assert abs(found.expected.radius - peg.radius) < 20e-6


def lit(camera, peg, light):
    """Image of a peg on a dark ground, bright where its surface faces the light."""
    rows, columns = np.mgrid[:SIZE, :SIZE].reshape(2, -1)
    lens = -camera.rotation.T @ camera.translation
    pixels = np.stack([columns, rows, np.ones(len(rows))], axis=1)
    ways = pixels @ np.linalg.inv(camera.matrix).T @ camera.rotation
    flat = ways - (ways @ peg.axis)[:, None] * peg.axis
    away = lens - peg.origin
    away -= (away @ peg.axis) * peg.axis
    square, pull = (flat**2).sum(axis=1), flat @ away
    hit = pull**2 - square * (away @ away - peg.radius**2)
    far = (-pull - np.sqrt(np.maximum(hit, 0.0))) / square
    normal = (away + far[:, None] * flat) / peg.radius
    shade = 40.0 + 60.0 * np.clip(normal @ (light / np.linalg.norm(light)), 0.0, None)
    image = np.where(hit > 0.0, shade, 28.0).reshape(SIZE, SIZE)
    noise = np.random.default_rng(0).normal(0.0, 1.5, image.shape)
    return np.clip(gaussian_filter(image, 0.8) + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("light", [[0.3, -0.5, 0.8], [-0.6, 0.1, 0.4]])
def test_the_steepest_point_of_a_lit_peg_is_not_its_outline(light):
    """It is up to a pixel inside of it, where the surface turns toward the light."""
    peg = Peg([1e-3, 2e-3, 0.5e-3], LEANING[0], 1.1e-3)
    cameras = lenses()
    sample = [[lit(camera, peg, np.array(light))] * 3 for camera in cameras]
    found = peg_in_images(cameras, sample, touches_of(peg))
    assert found is not None
    error = abs(found.expected.radius - peg.radius)
    assert error < 3.0 * found.radius_sigma
    assert error < 25e-6


def test_an_outline_that_shading_hides_is_uncertain():
    off = OFFSETS - 0.4
    sharp = 100.0 * norm.cdf(-off / 0.8)
    soft = 100.0 * np.clip(-off, 0.0, None) / 4.0
    noise = np.random.default_rng(0).normal(0.0, 0.5, (40, len(off)))
    place, sigma = place_of_outline(sharp + noise, 12.0)
    assert abs(place - 0.4) < min(3.0 * sigma, 0.1)
    place, unsure = place_of_outline(soft + noise, 12.0)
    assert unsure > 2.0 * sigma
    assert abs(place - 0.4) < 3.0 * unsure


def test_what_is_beyond_an_image_is_not_black():
    """Three pixels beyond the outline the image ends."""
    peg = Peg([0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 1.1e-3)
    camera = lenses()[0]
    frames = [drawn(camera, within(peg))]
    whole = _View.of(camera, frames, peg.origin)
    end = int(whole.project(peg.radius * np.array([1.0, 0.0, 0.0]))[0]) + 4
    parts = {name: getattr(whole, name)[..., :end] for name in ("bright", "slopes", "near")}
    edges = _edges(replace(whole, **parts), peg, np.zeros(0), 2.0, with_ends=False)
    assert all(len(part.miss) > 20 for part in edges)
    assert min(part.bright.min() for part in edges) > 0.15


def test_too_few_points_do_not_show_an_outline():
    assert place_of_outline(np.zeros((3, len(OFFSETS))), 12.0) == (0.0, np.inf)
    assert place_of_outline(np.zeros((30, len(OFFSETS))), 12.0) == (0.0, np.inf)


@pytest.mark.parametrize("radius", [0.06e-3, 0.15e-3])
def test_a_line_is_no_peg(radius):
    """Any two lines in two views meet in space."""
    wire, cameras = Peg([1e-3, 2e-3, 0.5e-3], [0.15, 0.25, 1.0], radius), lenses()
    sample = [[drawn(camera, within(wire))] * 3 for camera in cameras]
    assert peg_in_images(cameras, sample, touches_of(wire)) is None


def test_what_is_not_a_peg_is_not_taken_for_one():
    cameras = lenses()
    peg = Peg([1e-3, 2e-3, 0.5e-3], [0.1, 0.2, 1.0], 1.1e-3)
    empty = [[np.full((SIZE, SIZE), 190, dtype=np.uint8)] * 3] * 2
    assert peg_in_images(cameras, empty, touches_of(peg)) is None

    def ball(points):
        return np.linalg.norm(points - peg.origin, axis=-1) < 3e-3

    def half(points):
        return points[..., 1] > 2e-3

    for solid in (ball, half):
        sample = [[drawn(camera, solid)] * 3 for camera in cameras]
        assert peg_in_images(cameras, sample, touches_of(peg)) is None
    # One view is not enough, nor are few contacts.
    right = [[drawn(camera, within(peg))] * 3 for camera in cameras]
    assert peg_in_images(cameras[:1], right[:1], touches_of(peg)) is None
    few = Touches(*(part[:3] for part in touches_of(peg)[:4]), 1e-3)
    assert peg_in_images(cameras, right, few) is None
    assert peg_in_images(cameras, right, touches_of(peg)._replace(sigma=np.nan)) is None


def test_a_peg_that_contacts_contradict_is_not_taken():
    peg = Peg([1e-3, 2e-3, 0.5e-3], [0.1, 0.2, 1.0], 1.1e-3)
    seen = UncertainPeg(peg, 1e-4 * np.eye(PEG_UNKNOWNS))
    whisker = Whisker.straight(20e-3)
    arcs, ones = np.linspace(8e-3, 12e-3, 12), np.ones(14)
    normals = touches_of(peg).normals
    on = peg.origin + (peg.radius + whisker.radius(arcs))[:, None] * normals

    def explained(points, misfit=1.0, found=seen):
        free = np.full((2, 3), np.nan)
        fit = SimpleNamespace(
            contact_point=np.concatenate([points, free]),
            arc_length=np.append(arcs, [np.nan, np.nan]),
            misfit=np.append(np.full(12, misfit), [1.0, 1.0]),
        )
        return explains(seen, found, ones, fit, whisker)

    assert explained(on)
    assert explained(on, 1.1)
    assert not explained(on, 1.5)
    assert not explained(on + 0.3e-3 * normals)
    assert not explained(on, found=None)
    # It is 0.2 mm from where it is seen, 20 standard deviations.
    other = replace(seen, expected=seen.at(np.array([0.2, 0.0, 0.0, 0.0, 0.0])))
    np.testing.assert_allclose(seen.differs(other.expected), 400.0, rtol=1e-6)
    moved = on + (other.expected.origin - peg.origin)
    assert not explained(moved, found=other)


def test_only_a_certain_force_is_that_of_something_else_than_the_peg():
    """Contacts on the peg, off it with a force of 1 and of 4 deviations, and a free frame."""
    peg, whisker = Peg([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 1e-3), Whisker.straight(20e-3)
    arc = np.array([10e-3, 10e-3, 10e-3, np.nan])
    away = 1e-3 + whisker.radius(10e-3) + np.array([0.0, 2e-3, 2e-3, np.nan])
    size = 1e-6 * np.array([1.0, 1.0, 4.0, 0.0])[:, None]
    points = away[:, None] * [1.0, 0.0, 0.0]
    spread = np.tile(1e-12 * np.eye(6), (4, 1, 1))
    known = np.isfinite(arc)[:, None, None] * np.ones((4, 2, 15))
    fit = RodFit(
        np.tile(np.eye(3), (4, 1, 1)), points, arc, points, points, spread[:, :3, :3], known,
        size * [0.0, 1.0, 0.0], size * [0.0, 0.0, 1e-2], spread, spread, spread,
        np.zeros((4, 5, 3)), np.ones(4),
    )  # fmt: skip
    new = on_peg(UncertainPeg(peg, np.eye(PEG_UNKNOWNS)), fit, whisker)
    assert ((new.force != 0.0).any(axis=1) == [True, False, True, False]).all()
    assert (np.isfinite(new.arc_length) == [True, False, True, False]).all()
    assert np.isnan(new.shared[1, :, [0, 2, 9, 14]]).all()
    assert np.isfinite(new.shared[1, :, 3:9]).all()
    for name, value in vars(fit).items():
        np.testing.assert_array_equal(getattr(new, name)[[0, 2, 3]], value[[0, 2, 3]])
    assert np.isfinite(fit.contact_point[1]).all()


def test_derivatives_by_the_peg():
    peg = Peg([1e-3, 2e-3, 0.5e-3], [0.1, 0.2, 1.0], 1.1e-3)
    uncertain = UncertainPeg(peg, np.eye(PEG_UNKNOWNS))
    random = np.random.default_rng(0)
    points = peg.origin + random.normal(0.0, 2e-3, (6, 3))
    tangents = random.normal(size=(6, 3))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    at = 0.01 * random.normal(size=PEG_UNKNOWNS)
    (distance, normal, curvature), nearer, tilted = uncertain.geometry(at, points, tangents)
    for i, point in enumerate(points):
        known = uncertain.at(at).local_geometry(point)
        np.testing.assert_allclose(distance[i], known[0], atol=1e-15)
        np.testing.assert_allclose(normal[i], known[1], atol=1e-12)
        np.testing.assert_allclose(curvature[i], known[2], rtol=1e-9, atol=1e-6)
    for k, one in enumerate(1e-5 * np.eye(PEG_UNKNOWNS)):
        ahead, behind = (
            uncertain.geometry(at + sign * one, points, tangents)[0] for sign in (1.0, -1.0)
        )
        by_distance = (ahead[0] - behind[0]) / 2e-5
        by_angle = ((ahead[1] - behind[1]) * tangents).sum(axis=1) / 2e-5
        np.testing.assert_allclose(nearer[:, k], by_distance, atol=0.02 * UNITS[k])
        np.testing.assert_allclose(
            tilted[:, k], by_angle, atol=0.02 * np.abs(by_angle).max() + 1e-9
        )


def test_unknowns_that_all_frames_share():
    """Against the dense normal equations."""
    random = np.random.default_rng(1)
    count, n, k = 6, 10, PEG_UNKNOWNS
    root = random.normal(size=(count, n, n))
    hessian = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(n)
    gradient = random.normal(size=(count, n))
    smoother = Smoother(hessian, gradient)
    dense, right = np.zeros((count * n + k, count * n + k)), np.zeros(count * n + k)
    for i in range(count):
        dense[i * n : (i + 1) * n, i * n : (i + 1) * n] = hessian[i]
    right[: count * n] = gradient.reshape(-1)
    at = np.array([0, 2, 3, 5])
    rows, common = random.normal(size=(4, n)), random.normal(size=(4, k))
    values = random.normal(size=4)
    smoother.add_rows(at, rows, values, common)
    for i, row, other, value in zip(at, rows, common, values, strict=True):
        whole = np.zeros(count * n + k)
        whole[i * n : (i + 1) * n], whole[count * n :] = row, other
        dense += np.outer(whole, whole)
        right -= whole * value
    information, before = np.diag(np.arange(1.0, k + 1.0)), random.normal(size=k)
    smoother.add_prior(information, before)
    dense[count * n :, count * n :] += information
    right[count * n :] -= information @ before
    step, shared = smoother.solved()
    expected = np.linalg.solve(dense, right)
    np.testing.assert_allclose(step.reshape(-1), expected[: count * n], rtol=1e-7)
    np.testing.assert_allclose(shared, expected[count * n :], rtol=1e-7)
    inverse = np.linalg.inv(dense)
    np.testing.assert_allclose(
        smoother.shared_covariance, inverse[count * n :, count * n :], rtol=1e-7
    )
    total = smoother.covariances() + np.einsum(
        "ktu,ktv->tuv", smoother.by_shared(), smoother.by_shared()
    )
    blocks = [inverse[i * n : (i + 1) * n, i * n : (i + 1) * n] for i in range(count)]
    np.testing.assert_allclose(total, blocks, rtol=1e-6, atol=1e-9)


def test_contacts_are_fitted_on_a_peg_that_images_show(filmed, traced):
    """Also where one camera looks exactly along it, tips are not seen and the taper is wrong."""
    (peg,) = Recording(filmed.recording).objects
    truth, errors = filmed.truth, []
    cut = [[[_without_tip(trace) for trace in row] for row in view] for view in traced]
    thin = TrackOptions(properties={"base_radius": 1e-4, "tip_radius": 3e-6})
    for sample in ((), filmed.frames):
        found = track(filmed.cameras, cut, 1000.0, thin, sample=sample)
        data = found.to_dataset().isel(whisker=0)
        both = (truth["in_contact"].values > 0) & (data["in_contact"].values > 0)
        points = data["contact_point"].values[both]
        errors.append(np.linalg.norm(points - truth["contact_point"].values[both], axis=1))
        shown = [line for line in found.attrs.get("remarks", "").splitlines() if "peg" in line]
        assert bool(shown) == bool(sample)
    assert re.search(r"diameter (0\.99|1\.00)", shown[0])
    for share in (50, 95):
        assert np.percentile(errors[1], share) < 0.7 * np.percentile(errors[0], share)
    assert np.abs(peg.signed_distance(points)).max() < 60e-6


@pytest.mark.parametrize(("turned", "side"), [(45.0, 1e-3), (60.0, 1.4e-3)])
def test_contacts_are_not_fitted_on_a_post_with_corners(make_filmed, turned, side):
    """Its outlines are those of a round peg, but the whisker touches one of its edges."""
    whisker, ahead = Whisker.parabola(length=10e-3, coefficient=15.0), np.linspace(-0.1, 0.95, 40)
    motion = Motion(np.arange(40) / 1e3, ahead, 0.05 + 0.2 * ahead, 0.2 * ahead, np.zeros((40, 3)))
    turn = Rotation.from_euler("z", turned, degrees=True).as_matrix()
    post = Box([6e-3, 0.5e-3 + 0.7 * side, 0.0], [side, side, 20e-3], turn, edge_radius=5e-5)
    filmed = make_filmed(simulate(whisker, motion, post))
    traced = [trace_video(frames) for frames in filmed.frames]
    found = [track(filmed.cameras, traced, 1000.0, sample=s) for s in (filmed.frames, ())]
    for name in ("contact_point", "force"):
        with_images, without = (one[name].values for one in found)
        np.testing.assert_array_equal(with_images, without)
    assert "bends otherwise than on it" in found[0].attrs["remarks"]
    assert "touches a peg" not in found[0].attrs["remarks"]


@pytest.mark.parametrize("count", [5, 12])
def test_without_contacts_no_peg_is_looked_for(filmed, traced, count):
    free = np.flatnonzero(filmed.truth["in_contact"].values == 0)[:count]
    some = [[[row[i] for i in free] for row in view] for view in traced]
    found = track(filmed.cameras, some, 1000.0, sample=filmed.frames)
    assert not found["in_contact"].values.any()


def _without_tip(trace):
    part = slice(0, 3 * len(trace.line) // 4)
    line, sigma, seen = trace.line[part], trace.sigma[part], trace.seen[part]
    return trace._replace(line=line, sigma=sigma, seen=seen, tip_seen=False)


def test_contacts_are_sure_somewhere():
    """Deviations by errors of traces that vary with the pose are not contacts."""
    um = 1e-6 * np.array([2, 3, 5, 40, 300, 900, 6, 8, 7, 9, 6, 3, np.nan, 2, 6, 60, 20, 5, 3, 2])
    free = _free(um, *(np.full(len(um), limit) for limit in (4e-6, 11e-6)))
    # The frame before a contact, and those in which it ends, belong to it.
    touching = np.flatnonzero(~free & np.isfinite(um))
    assert touching.tolist() == [2, 3, 4, 5, 6, 14, 15, 16, 17]
    assert not free[12]


def test_orthographic_cameras_show_it_too():
    cameras = [
        replace(c, matrix=np.diag([1.0 / PIXEL, 1.0 / PIXEL, 1.0]) + _shift())
        for c in orthogonal_views(PIXEL, (SIZE, SIZE))
    ]
    peg = Peg([0.5e-3, 1e-3, 0.5e-3], [0.15, 0.25, 1.0], 1.1e-3)
    sample = [[drawn(camera, within(peg))] * 3 for camera in cameras]
    found = peg_in_images(cameras, sample, touches_of(peg))
    assert found is not None
    assert abs(found.expected.radius - peg.radius) < 20e-6


def _shift():
    at = np.zeros((3, 3))
    at[:2, 2] = 129.5
    return at
