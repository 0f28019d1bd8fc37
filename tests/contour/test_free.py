"""A free surface goes through an object of no simple shape, as surely as it says."""

import numpy as np
import pytest

from vibrissa.contour import fit_free, shape_from_dataset, surface_grid
from vibrissa.contour.free_surface import Support, merge_neighbours

SEMIAXES = np.array([3e-3, 2e-3, 4e-3])
CENTER = np.array([20e-3, 1e-3, 0.0])


def ellipsoid(generator, n, share=0.3):
    """Points and normals on the part of an ellipsoid that faces the whisker."""
    u = generator.normal(size=(8 * n, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    u = u[u[:, 0] < -share][:n]
    normal = u / SEMIAXES
    return u * SEMIAXES + CENTER, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def outside(points):
    """Distance from the ellipsoid, to first order."""
    u = (points - CENTER) / SEMIAXES
    size = np.linalg.norm(u, axis=-1)
    return (size - 1.0) * size / np.linalg.norm(u / SEMIAXES, axis=-1)


@pytest.fixture
def contacts(joint_errors):
    """Contacts with the ellipsoid: a function of seed and number."""
    return lambda seed, n: _contacts(joint_errors, seed, n)


def _contacts(joint_errors, seed, n):
    generator = np.random.default_rng(seed)
    surface, normal = ellipsoid(generator, n)
    whisker = generator.uniform(20e-6, 60e-6, n)
    errors = joint_errors(generator, normal)
    moved = np.einsum("nij,nj->ni", errors, generator.normal(size=(n, 3)))
    covariance = errors @ np.swapaxes(errors, 1, 2)
    points = surface + whisker[:, None] * normal + moved[:, :3]
    known = {"covariance": covariance[:, :3, :3], "whisker_radius": whisker}
    return points, known | {"normals": normal + moved[:, 3:]}


@pytest.mark.slow
def test_it_is_as_sure_as_it_says(contacts):
    """Where contacts are, errors have the spread that it claims, and are smaller than theirs."""
    there, _ = ellipsoid(np.random.default_rng(99), 200, 0.35)
    scores, errors, raw = [], [], []
    for seed in range(6):
        points, known = contacts(seed, 300)
        fit = fit_free(points, base="sphere", **known)
        error = fit.signed_distance(there)
        scores.append(error / fit.distance_sigma(there))
        errors.append(error)
        raw.append(np.median(np.abs(outside(points) - known["whisker_radius"])))
    z = np.array(scores)
    # Scores of one surface go together; there are some twenty independent places on each.
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.3
    assert 0.88 < (np.abs(z) < 1.96).mean() < 0.99
    assert np.median(np.abs(errors)) < 0.4 * np.mean(raw)


def test_far_from_contacts_it_says_that_it_does_not_know(contacts):
    points, known = contacts(1, 200)
    fit = fit_free(points, **known)
    near, far = (CENTER + side * SEMIAXES * [1.0, 0.0, 0.0] for side in (-1.0, 1.0))
    assert fit.distance_sigma(near) < 40e-6
    assert fit.distance_sigma(far) > 20.0 * fit.distance_sigma(near)
    assert abs(fit.signed_distance(far)) < 3.0 * fit.distance_sigma(far)
    # Even of a shape that fits without any deviation.
    flat = np.random.default_rng(0).uniform(-5e-3, 5e-3, (80, 3)) * [1.0, 1.0, 0.0]
    plane = fit_free(flat)
    assert plane.base.kind == "plane"
    np.testing.assert_allclose(plane.signed_distance(flat), 0.0, atol=1e-6)
    assert plane.distance_sigma([15e-3, 0.0, 0.0]) > 0.2e-3


@pytest.mark.slow
def test_more_contacts_than_wanted_are_merged(contacts):
    points, known = contacts(2, 900)
    fit = fit_free(points, base="sphere", most=100, **known)
    assert 30 < len(fit.support.value) <= 100
    there, _ = ellipsoid(np.random.default_rng(99), 200, 0.35)
    assert np.sqrt(np.mean(fit.signed_distance(there) ** 2)) < 40e-6


def test_merging_keeps_what_is_known():
    generator = np.random.default_rng(0)
    whole = Support(
        generator.normal(size=(500, 3)), generator.normal(size=500), generator.uniform(1, 2, 500)
    )
    few = merge_neighbours(whole, 40)
    assert 20 < len(few.value) <= 40
    weights = [1.0 / s.variance for s in (whole, few)]
    assert weights[1].sum() == pytest.approx(weights[0].sum())
    means = [w @ s.value / w.sum() for w, s in zip(weights, (whole, few), strict=True)]
    assert means[1] == pytest.approx(means[0])
    assert merge_neighbours(whole, 500) is whole


def test_outliers_do_little_harm(contacts):
    points, known = contacts(3, 300)
    points[::15] += 2e-3 * np.random.default_rng(0).normal(size=points[::15].shape)
    points[4] = np.nan
    fit = fit_free(points, base="sphere", **known)
    there, _ = ellipsoid(np.random.default_rng(99), 200, 0.35)
    assert np.sqrt(np.mean(fit.signed_distance(there) ** 2)) < 60e-6
    assert np.delete(fit.inliers, slice(0, None, 15)).mean() > 0.95
    assert np.isnan(fit.residuals[4])
    assert not fit.inliers[4]


def test_normals_are_gradients_of_the_distance(contacts):
    points, known = contacts(4, 150)
    fit = fit_free(points, base="sphere", **known)
    there, normal = ellipsoid(np.random.default_rng(9), 50, 0.4)
    turned = np.arccos(np.einsum("ni,ni->n", fit.outward_normals(there), normal))
    assert np.median(turned) < 0.07
    assert turned.max() < 0.25
    ahead = fit.signed_distance(there + 1e-5 * fit.outward_normals(there))
    np.testing.assert_allclose(ahead - fit.signed_distance(there), 1e-5, rtol=0.02)


def test_grids_lie_on_the_surface(contacts):
    points, known = contacts(5, 150)
    for base in ("sphere", "cylinder", "plane"):
        fit = fit_free(points, base=base, **known)
        for shape in (fit, fit.base):
            grid = surface_grid(shape, points, 9)
            places = grid["surface_grid_point"]
            assert places.sizes == {"u": 9, "v": 9, "space": 3}
            known_there = grid["surface_sigma"].values < 0.2e-3
            assert known_there.mean() > 0.2
            gap = shape.signed_distance(places.values[known_there])
            np.testing.assert_allclose(gap, 0.0, atol=1e-9)
            middle = float(grid["surface_sigma"][4, 4])
            assert middle == pytest.approx(float(shape.distance_sigma(places.values[4, 4])))
            assert repr(fit).startswith("<free surface")
    with pytest.raises(ValueError, match="no points"):
        surface_grid(fit, np.full((3, 3), np.nan))
    with pytest.raises(ValueError, match="at least 2"):
        surface_grid(fit, points, 1)


def test_datasets_keep_it(contacts):
    points, known = contacts(6, 60)
    fit = fit_free(points, **known)
    stored = fit.to_dataset(("time", "whisker"), (60, 1))
    again = shape_from_dataset(stored)
    np.testing.assert_array_equal(again.signed_distance(points), fit.signed_distance(points))
    np.testing.assert_array_equal(again.residuals, fit.residuals)
    with pytest.raises(ValueError, match="lacks support_value"):
        shape_from_dataset(stored.drop_vars("support_value"))
    with pytest.raises(ValueError, match="deviates from 'cone'"):
        shape_from_dataset(stored.assign_attrs(base="cone"))


def test_what_is_no_surface_is_refused(contacts):
    points, known = contacts(7, 40)
    with pytest.raises(ValueError, match="'cone'"):
        fit_free(points, base="cone")
    with pytest.raises(ValueError, match="most is 5"):
        fit_free(points, most=5)
    with pytest.raises(ValueError, match="5 usable points; at least 6"):
        fit_free(points[:5])
    with pytest.raises(ValueError, match="on a line"):
        fit_free(np.linspace(0, 1, 20)[:, None] * [1e-3, 2e-3, 3e-3])
    with pytest.raises(ValueError, match=r"covariance has shape \(3, 3\)"):
        fit_free(points, **(known | {"covariance": np.eye(3)}))


def test_contacts_are_in_the_order_of_those_of_a_shape(contacts):
    points, known = contacts(3, 60)
    alike = fit_free(points, known["covariance"], known["whisker_radius"])
    named = fit_free(points, covariance=known["covariance"], whisker_radius=known["whisker_radius"])
    np.testing.assert_array_equal(alike.residuals, named.residuals)
