"""Cameras: projection against its definition, and back again."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vibrissa.cameras import (
    Camera,
    cameras_dataset,
    cameras_from_dataset,
    load_cameras,
    orthogonal_views,
    save_cameras,
    triangulate,
)


def perspective(turn, distance=0.3, name="camera"):
    return Camera(
        matrix=[[5000.0, 0.0, 500.0], [0.0, 5100.0, 400.0], [0.0, 0.0, 1.0]],
        rotation=Rotation.from_rotvec(turn).as_matrix(),
        translation=[0.001, -0.002, distance],
        distortion=[-0.2, 0.1, 1e-3, -2e-3, 0.05],
        size=(1000, 800),
        name=name,
    )


PAIRS = {
    "orthogonal": orthogonal_views(center=(0.01, 0.0, -0.002)),
    "perspective": (
        perspective([0.1, 0.05, -0.3], name="left"),
        perspective([0.0, 1.2, 0.1], name="right"),
    ),
}
POINTS = np.random.default_rng(0).uniform(-0.02, 0.02, (4, 5, 3))


@pytest.fixture(params=PAIRS.values(), ids=PAIRS.keys())
def pair(request):
    return request.param


def test_the_views_of_the_paper():
    top, front = orthogonal_views(pixel_size=58e-6)
    middle = np.array([511.5, 511.5])
    np.testing.assert_allclose(top.project([0.0, 0.0, 7.0]), middle)
    np.testing.assert_allclose(top.project([58e-6, 116e-6, 0.0]) - middle, [1.0, -2.0])
    np.testing.assert_allclose(front.project([58e-6, 7.0, 116e-6]) - middle, [1.0, -2.0])


def test_one_ray_leads_to_the_camera_from_where_it_looks():
    top, front = orthogonal_views()
    np.testing.assert_allclose(top.rays([3.0, 4.0])[1], [0.0, 0.0, -1.0])
    np.testing.assert_allclose(front.rays([3.0, 4.0])[1], [0.0, -1.0, 0.0])


def test_projection_with_distortion_is_opencv_s():
    camera = perspective([0.1, 0.05, -0.3])
    k1, k2, p1, p2, k3 = camera.distortion[:5]
    for point in POINTS.reshape(-1, 3):
        x, y, z = camera.rotation @ point + camera.translation
        x, y = x / z, y / z
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        np.testing.assert_allclose(camera.project(point), [5000 * u + 500, 5100 * v + 400])


def test_pixels_are_the_same_with_and_without_slopes(pair):
    points = np.random.default_rng(3).uniform(-0.02, 0.02, (7, 2, 3))
    for camera in (*pair, *orthogonal_views()):
        np.testing.assert_allclose(
            camera.project(points), camera.project_with_slopes(points)[0], rtol=1e-13
        )


def test_slopes_are_derivatives(pair):
    for camera in pair:
        _, slopes = camera.project_with_slopes(POINTS)
        for axis in range(3):
            step = 1e-6 * np.eye(3)[axis]
            change = (camera.project(POINTS + step) - camera.project(POINTS - step)) / 2e-6
            np.testing.assert_allclose(slopes[..., axis], change, rtol=1e-5, atol=1e-3)


def test_rays_pass_through_what_is_seen(pair):
    for camera in pair:
        origin, direction = camera.rays(camera.project(POINTS))
        miss = np.cross(POINTS - origin, direction)
        np.testing.assert_allclose(miss, 0.0, atol=1e-12)


def test_two_views_give_the_point_back(pair):
    pixels = np.stack([camera.project(POINTS) for camera in pair])
    points, covariance = triangulate(pair, pixels)
    np.testing.assert_allclose(points, POINTS, atol=1e-10)
    assert covariance.shape == (4, 5, 3, 3)


def test_the_covariance_of_a_point_is_its_scatter(pair):
    generator = np.random.default_rng(1)
    point, sigma = POINTS[0, 0], np.array([0.3, 0.6])
    clean = np.stack([camera.project(point) for camera in pair])[:, None]
    noise = generator.normal(size=(2, 4000, 2)) * sigma[:, None, None]
    points, covariance = triangulate(pair, clean + noise, sigma[:, None])
    whitened = np.linalg.solve(np.linalg.cholesky(covariance[0]), (points - point).T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(3), atol=0.1)


def test_a_missing_pixel_is_a_missing_point(pair):
    pixels = np.stack([camera.project(POINTS[0]) for camera in pair])
    pixels[1, 2] = np.nan
    points, _ = triangulate(pair, pixels)
    assert np.isnan(points[2]).all()
    np.testing.assert_allclose(np.delete(points, 2, 0), np.delete(POINTS[0], 2, 0), atol=1e-10)


def test_behind_a_camera_nothing_is_seen():
    assert np.isnan(perspective([0.0, 0.0, 0.0]).project([0.0, 0.0, -1.0])).all()


def test_files_and_datasets_keep_cameras(pair, tmp_path):
    save_cameras(tmp_path / "c.toml", pair)
    for again in (load_cameras(tmp_path / "c.toml"), cameras_from_dataset(cameras_dataset(pair))):
        for camera, same in zip(pair, again, strict=True):
            assert (same.name, same.size) == (camera.name, camera.size)
            np.testing.assert_allclose(same.project(POINTS), camera.project(POINTS), rtol=1e-12)


def test_a_file_of_anipose(tmp_path):
    """As aniposelib writes it, in mm."""
    (tmp_path / "calibration.toml").write_text(
        '[cam_0]\nname = "A"\nsize = [ 640, 480,]\n'
        "matrix = [ [ 800.0, 0.0, 319.5,], [ 0.0, 800.0, 239.5,], [ 0.0, 0.0, 1.0,],]\n"
        "distortions = [ -0.1, 0.0, 0.0, 0.0, 0.0,]\nrotation = [ 0.0, 0.0, 0.0,]\n"
        "translation = [ 0.0, 0.0, 100.0,]\n\n[metadata]\nadjusted = false\nerror = 0.3\n"
    )
    (camera,) = load_cameras(tmp_path / "calibration.toml")
    np.testing.assert_allclose(camera.project([0.0, 0.0, 0.0]), [319.5, 239.5])
    radial = 1.0 - 0.1 * 0.01
    np.testing.assert_allclose(camera.project([0.01, 0.0, 0.0]), [319.5 + 80.0 * radial, 239.5])


_OTHERWISE_WHOLE = (
    "[cam_0]\nsize = [640, 480]\nmatrix = [[800, 0, 320], [0, 800, 240], [0, 0, 1]]\n"
    "distortions = [0, 0, 0, 0, 0]\ntranslation = [0, 0, 100]\n"
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[cam_0\n", "not TOML"),
        ("[metadata]\nadjusted = true\n", "no camera"),
        ("[cam_0]\nsize = [1, 1]\n", "has no matrix, rotation, translation"),
        (_OTHERWISE_WHOLE + "rotation = [0, 90, 0]\n", r"rotation is \[0, 90, 0\]"),
        (_OTHERWISE_WHOLE + "rotation = [0, 0, 0]\nfisheye = true\n", "fisheye is true"),
    ],
)
def test_a_calibration_that_is_none_says_why(text, said, tmp_path):
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(ValueError, match=said):
        load_cameras(tmp_path / "c.toml")


def test_what_cannot_be_a_camera_says_why():
    with pytest.raises(ValueError, match="a mirror is a negative focal length"):
        Camera(np.eye(3), np.diag([1.0, 1.0, -1.0]), np.zeros(3))
    with pytest.raises(ValueError, match="pixel_size"):
        orthogonal_views(pixel_size=0.0)
    with pytest.raises(ValueError, match="do not fit"):
        triangulate(PAIRS["orthogonal"][:1], np.zeros((2, 2)))
    with pytest.raises(ValueError, match="do not fit"):
        triangulate(PAIRS["orthogonal"], np.zeros((2, 3)))
    for sigma in (-1.0, 0.0):
        with pytest.raises(ValueError, match="sigma is a positive standard deviation"):
            triangulate(PAIRS["orthogonal"], np.zeros((2, 2)), sigma)
    with pytest.raises(ValueError, match="columns and rows of its images"):
        Camera(np.eye(3), np.eye(3), np.zeros(3), size=(1024,))
