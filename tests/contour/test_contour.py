"""A cylinder is found again from points on parts of it, as well as it says."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from vibrissa.contour import (
    axis_offset,
    fit_shape,
    to_laboratory,
)
from vibrissa.objects import Peg

RADIUS = 1.35e-3


def rotation(generator):
    q, r = np.linalg.qr(generator.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def touches(generator, n=300, turn=None, center=(25e-3, 1e-3, -2e-3)):
    """Contacts on back and front of a peg: points, normals, whisker radii."""
    turn = np.eye(3) if turn is None else turn
    angle = generator.uniform(-0.5, 0.5, n) + np.where(np.arange(n) % 2, 0.5, -0.5) * np.pi
    normal = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)
    radius = generator.uniform(20e-6, 60e-6, n)
    height = generator.uniform(-4e-3, 4e-3, n)
    local = normal * (RADIUS + radius)[:, None] + height[:, None] * np.array([0.0, 0.0, 1.0])
    return local @ turn.T + np.asarray(center), normal @ turn.T, radius


def noise_along_x(generator, n, across=3e-6, along=(1e-5, 6e-5)):
    """Covariances that are long near x, as those of contact points along the whisker are."""
    azimuth = generator.uniform(-0.4, 0.4, n)
    long = np.stack([np.cos(azimuth), np.sin(azimuth), 0.1 * np.ones(n)], axis=1)
    long /= np.linalg.norm(long, axis=1, keepdims=True)
    size = np.exp(generator.uniform(*np.log(along), n))
    return across**2 * np.eye(3) + size[:, None, None] ** 2 * np.einsum("ni,nj->nij", long, long)


def drawn(generator, covariance):
    root = np.linalg.cholesky(covariance)
    return np.einsum("nij,nj->ni", root, generator.normal(size=covariance.shape[:2]))


@settings(max_examples=6)
@given(seed=st.integers(0, 10_000), normals=st.booleans(), known=st.booleans())
def test_exact_points_give_the_cylinder_back(seed, normals, known):
    generator = np.random.default_rng(seed)
    turn = rotation(generator)
    center = generator.uniform(-0.05, 0.05, 3)
    points, normal, radius = touches(generator, 60, turn, center)
    fit = fit_shape(
        "cylinder",
        points,
        whisker_radius=radius,
        axis=-turn[:, 2] if known else None,
        normals=normal if normals else None,
    )
    offset, tilt = axis_offset(fit.origin, fit.axis, center, turn[:, 2])
    assert np.linalg.norm(offset) < 1e-9
    assert tilt < 1e-6
    assert fit.radius == pytest.approx(RADIUS, abs=1e-9)
    assert fit.rms < 1e-9
    assert fit.diameter == 2.0 * fit.radius


# Without normals a bias that grows with the square of the noise is left.
@pytest.mark.slow
@pytest.mark.parametrize(("normals", "along"), [(False, (4e-6, 2e-5)), (True, (1e-5, 6e-5))])
def test_uncertainty_is_what_it_says(normals, along):
    """Over many noisy trials errors have the spread that the covariance gives, and no bias."""
    scores = []
    for seed in range(40):
        generator = np.random.default_rng(seed)
        points, normal, radius = touches(generator, 120)
        covariance = noise_along_x(generator, len(points), along=along)
        noisy = points + drawn(generator, covariance)
        fit = fit_shape("cylinder", noisy, covariance, radius, normals=normal if normals else None)
        offset, _ = axis_offset(fit.origin, fit.axis, (25e-3, 1e-3, -2e-3), (0, 0, 1))
        scores.append(
            [*(offset[:2] / fit.origin_sigma[:2]), (fit.radius - RADIUS) / (fit.diameter_sigma / 2)]
        )
    spread = np.std(scores, axis=0)
    # The standard deviation of 40 scores is known to 11 %.
    assert (spread > 0.7).all()
    assert (spread < 1.35).all()
    assert (np.abs(np.mean(scores, axis=0)) < 0.6).all()


def test_normals_make_it_more_accurate():
    generator = np.random.default_rng(0)
    points, normal, radius = touches(generator)
    covariance = noise_along_x(generator, len(points))
    noisy = points + drawn(generator, covariance)
    without = fit_shape("cylinder", noisy, covariance, radius)
    fit = fit_shape("cylinder", noisy, covariance, radius, normals=3.0 * normal)
    assert fit.diameter_sigma < 0.7 * without.diameter_sigma
    assert fit.origin_sigma[0] < 0.7 * without.origin_sigma[0]


def test_outliers_and_useless_points_do_little_harm():
    generator = np.random.default_rng(1)
    points, normal, radius = touches(generator)
    covariance = noise_along_x(generator, len(points))
    noisy = points + drawn(generator, covariance)
    noisy[::20] += generator.normal(scale=1e-3, size=noisy[::20].shape)
    covariance[5::20] *= 1e4
    noisy[5::20] += generator.normal(scale=5e-3, size=noisy[5::20].shape)
    noisy[3] = np.nan
    for known in (None, normal):
        fit = fit_shape("cylinder", noisy, covariance, radius, normals=known)
        offset, _ = axis_offset(fit.origin, fit.axis, (25e-3, 1e-3, -2e-3), (0, 0, 1))
        assert np.linalg.norm(offset) < 40e-6
        assert abs(fit.radius - RADIUS) < 20e-6
        assert not fit.inliers[5::20].any()
        assert not fit.inliers[3]
        assert np.isnan(fit.residuals[3])
        assert fit.inliers.sum() > 0.85 * len(points)


def test_residuals_are_distances_between_the_surfaces():
    generator = np.random.default_rng(2)
    points, _, radius = touches(generator, 40)
    points = points + generator.normal(scale=1e-5, size=points.shape)
    fit = fit_shape("cylinder", points, whisker_radius=radius)
    expected = Peg(fit.origin, fit.axis, fit.radius).signed_distance(points) - radius
    np.testing.assert_allclose(fit.residuals, expected, rtol=0, atol=1e-12)
    # Without a covariance the scatter tells the noise.
    assert 0.5e-6 < fit.diameter_sigma < 50e-6


def test_what_is_no_cylinder_is_refused():
    generator = np.random.default_rng(3)
    points, normal, radius = touches(generator, 20)
    with pytest.raises(ValueError, match="5 usable points; at least 6"):
        fit_shape("cylinder", points[:5])
    with pytest.raises(ValueError, match="0 usable"):
        fit_shape("cylinder", np.full((9, 3), np.nan))
    with pytest.raises(ValueError, match="on a line"):
        fit_shape("cylinder", np.linspace(0, 1, 20)[:, None] * [1e-3, 2e-3, 3e-3])
    with pytest.raises(ValueError, match="on a line"):
        fit_shape("cylinder", np.ones((20, 3)))
    with pytest.raises(ValueError, match=r"shape \(20, 2\)"):
        fit_shape("cylinder", points[:, :2])
    with pytest.raises(ValueError, match=r"whisker_radius has shape.*covariance has shape"):
        fit_shape(
            "cylinder", points, covariance=np.eye(3), whisker_radius=radius[:3], normals=normal
        )
    with pytest.raises(ValueError, match="axis is"):
        fit_shape("cylinder", points, axis=[0, 0, 0])


@given(seed=st.integers(0, 10_000))
def test_frames_lead_there_and_back(seed):
    generator = np.random.default_rng(seed)
    turn = np.stack([rotation(generator) for _ in range(5)])
    base = generator.normal(size=(5, 3))
    points = generator.normal(size=(5, 3))
    lab = to_laboratory(points, turn, base)
    back = np.einsum("nji,nj->ni", turn, lab - base)
    np.testing.assert_allclose(back, points, atol=1e-12)


def test_offset_and_tilt():
    offset, tilt = axis_offset([1.0, 2.0, 9.0], [0, 1e-8, -1.0], [0.5, 2.0, 0.0], [0, 0, 5.0])
    np.testing.assert_allclose(offset, [0.5, 0.0, 0.0])
    assert tilt == pytest.approx(1e-8)


@pytest.mark.parametrize("seed", [0, 1])
def test_normals_that_contradict_the_points_give_no_hollow_cylinder(seed):
    generator = np.random.default_rng(seed)
    n = 100
    points, normal, radius = touches(generator, n)
    normal = normal + generator.normal(size=(n, 3))
    points = points + 2e-3 * generator.normal(size=(n, 3))
    normal = normal * np.where(generator.uniform(size=(n, 1)) < 0.5, -1.0, 1.0)
    covariance = noise_along_x(generator, n, across=1e-4, along=(1e-4, 1e-3))
    with pytest.raises(ValueError, match="no cylinder"):
        fit_shape("cylinder", points, covariance, radius, normals=normal)


def test_a_thin_cylinder_has_a_positive_radius():
    """Contacts with noise on a short arc fit radii below zero as often as above; none is hollow."""
    true, sigma, n = 20e-6, 2e-4, 60
    for seed in range(4):
        generator = np.random.default_rng(seed)
        angle = generator.uniform(-0.5, 0.5, n)
        normal = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)
        height = generator.uniform(-4e-3, 4e-3, n)
        points = true * normal + height[:, None] * np.array([0.0, 0.0, 1.0])
        points = points + sigma * generator.normal(size=(n, 3))
        covariance = np.broadcast_to(sigma**2 * np.eye(3), (n, 3, 3))
        fitted = fit_shape("cylinder", points, covariance, np.zeros(n), normals=normal)
        assert fitted.radius > 0.0
        assert abs(fitted.radius - true) < 3.0 * fitted.sigma["radius"]
