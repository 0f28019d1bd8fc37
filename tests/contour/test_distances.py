"""Points are compared with what they should lie on, and with what their covariance says."""

import numpy as np
import pytest

from vibrissa.contour import compare_with, distances_by, ellipsoids, fit_shape
from vibrissa.objects import Peg, Plane, Sphere


def scattered(body, n=3000, sigma=(30e-6, 60e-6)):
    """Points about a plane or peg that err by their covariance; their sigma grows."""
    generator = np.random.default_rng(0)
    flat = generator.uniform(-5e-3, 5e-3, (n, 3))
    if isinstance(body, Peg):
        turn = generator.uniform(0.0, 2.0 * np.pi, n)
        normal = np.stack([np.cos(turn), np.sin(turn), np.zeros(n)], axis=1)
        flat = body.radius * normal + flat * [0.0, 0.0, 1.0]
    else:
        normal, flat = np.broadcast_to([0.0, 0.0, 1.0], (n, 3)), flat * [1.0, 1.0, 0.0]
    size = np.linspace(*sigma, n)
    root = size[:, None, None] * np.array([[1.0, 0.0, 0.0], [2.0, 5.0, 0.0], [0.3, 0.0, 1.0]])
    radius = generator.uniform(20e-6, 60e-6, n)
    points = flat + radius[:, None] * normal
    points = points + np.einsum("nij,nj->ni", root, generator.normal(size=(n, 3)))
    return points, root @ np.swapaxes(root, 1, 2), radius, size


@pytest.mark.parametrize(
    "body",
    [
        Plane(origin=[0.0, 0.0, 0.0], normal=[0.0, 0.0, 1.0]),
        Peg(origin=[0.0, 0.0, 0.0], axis=[0.0, 0.0, 1.0], radius=1.35e-3),
    ],
)
def test_distances_are_as_predicted_where_the_covariance_is_right(body):
    points, covariance, radius, size = scattered(body)
    points[5], covariance[6] = np.nan, np.nan
    compared = compare_with(body, points, covariance, radius)
    np.testing.assert_allclose(
        compared["surface_distance"].values, body.signed_distance(points) - radius
    )
    assert np.isnan(compared["surface_distance"][5])
    assert np.isnan(compared["surface_distance_predicted"][:, 6]).all()
    summed = distances_by(compared, "arc_length", size, np.linspace(30e-6, 60e-6, 4))
    assert summed["contacts"].sum() == 2999
    # The median of 1000 sizes is known to some 4 %, 95 % of them to some 5 %.
    for name in ("median", "largest_95"):
        np.testing.assert_allclose(summed[name], summed[f"{name}_predicted"], rtol=0.12)
    assert (np.diff(summed["median"]) > 0.0).all()
    assert summed.attrs["quantity"] == "arc_length"


def test_classes_are_as_full_as_each_other_by_default():
    body = Sphere(origin=[0.0, 0.0, 0.0], radius=1e-3)
    points = np.random.default_rng(1).normal(size=(50, 2, 3)) * 1e-3
    compared = compare_with(body, points, dims=("time", "whisker"))
    assert compared["surface_distance"].dims == ("time", "whisker")
    summed = distances_by(compared, "r", np.linalg.norm(points, axis=-1))
    assert summed["contacts"].values.tolist() == [20] * 5
    assert np.isnan(summed["median_predicted"]).all()
    assert str(summed["label"].values[0]).count("–") == 1
    empty = distances_by(compared, "r", np.linalg.norm(points, axis=-1), [0.0, 1e-9, 1.0])
    assert empty["contacts"].values.tolist() == [0, 100]
    assert np.isnan(empty["median"][0])


def test_a_fitted_shape_is_compared_like_an_object():
    generator = np.random.default_rng(2)
    normal = generator.normal(size=(60, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    compared = compare_with(fit_shape("sphere", normal), 1.5 * normal, whisker_radius=0.25)
    np.testing.assert_allclose(compared["surface_distance"], 0.25, atol=1e-6)


def test_what_does_not_fit_is_refused():
    body = Sphere(origin=[0.0, 0.0, 0.0], radius=1e-3)
    compared = compare_with(body, np.ones((4, 3)))
    with pytest.raises(ValueError, match="points have shape"):
        compare_with(body, np.ones(3))
    with pytest.raises(ValueError, match="covariance has shape"):
        compare_with(body, np.ones((4, 3)), np.eye(3))
    with pytest.raises(ValueError, match="not a known quantity"):
        distances_by(compared, "colour", np.ones(4))
    with pytest.raises(ValueError, match="values have shape"):
        distances_by(compared, "r", np.ones(3))
    with pytest.raises(ValueError, match="edges are"):
        distances_by(compared, "r", np.ones(4), [1.0, 1.0])
    with pytest.raises(ValueError, match="no classes"):
        distances_by(compared, "r", np.full(4, np.nan))


def test_ellipsoids_hold_the_share_that_they_should():
    generator = np.random.default_rng(3)
    root = generator.normal(size=(3, 3))
    covariance = root @ root.T
    draws = generator.normal(size=(20000, 3)) @ root.T
    for share in (0.5, 0.95):
        made = ellipsoids(covariance, share)
        assert np.linalg.det(made.directions) == pytest.approx(1.0)
        assert (np.diff(made.semiaxes) <= 0.0).all()
        within = (((draws @ made.directions.T) / made.semiaxes) ** 2).sum(axis=1) < 1.0
        assert within.mean() == pytest.approx(share, abs=0.01)
    many = ellipsoids(np.stack([covariance, np.full((3, 3), np.nan)]))
    assert np.isnan(many.semiaxes[1]).all()
    with pytest.raises(ValueError, match="share is 1"):
        ellipsoids(covariance, 1.0)
    with pytest.raises(ValueError, match="covariance has shape"):
        ellipsoids(np.ones(3))


def test_negative_variances_and_other_things_than_objects_are_refused():
    points = np.random.default_rng(0).normal(size=(5, 3)) * 1e-3
    wrong = np.broadcast_to(-1e-9 * np.eye(3), (5, 3, 3))
    ball = Sphere([0.0, 0.0, 0.0], 1e-3)
    with pytest.raises(ValueError, match="a variance is negative"):
        compare_with(ball, points, wrong)
    with pytest.raises(ValueError, match="a variance is negative"):
        ellipsoids(wrong)
    with pytest.raises(ValueError, match="an object or a fitted shape is needed"):
        compare_with("sphere", points)
    axis = np.random.default_rng(1).normal(size=(50, 3, 1))
    single = np.float32(1e-4 * axis @ np.swapaxes(axis, 1, 2))  # rounding makes some indefinite
    assert np.linalg.eigvalsh(single.astype(float)).min() < 0.0
    ellipsoids(single)
