"""Shapes are found again from contacts whose points and normals err together, as they say."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vibrissa.contour import (
    axis_offset,
    compare_with,
    fit_shape,
    shape_from_dataset,
)
from vibrissa.contour.fitted_shape import whiten
from vibrissa.objects import Peg

CENTER = np.array([25e-3, 1e-3, -2e-3])
RADIUS = 2e-3
KINDS = ("cylinder", "sphere", "plane")


def touched(kind, generator, n):
    """Contacts on part of a shape about CENTER: points, normals, whisker radii."""
    whisker = generator.uniform(20e-6, 60e-6, n)
    if kind == "plane":
        flat = generator.uniform(-4e-3, 4e-3, (n, 2))
        normal = np.broadcast_to([0.0, -0.6, 0.8], (n, 3)).copy()
        inside = flat @ np.array([[1.0, 0.0, 0.0], [0.0, 0.8, 0.6]])
        return CENTER + inside + whisker[:, None] * normal, normal, whisker
    azimuth = generator.uniform(-0.8, 0.8, n) + np.where(np.arange(n) % 2, 0.5, -0.5) * np.pi
    high = generator.uniform(-3e-3, 3e-3, n) if kind == "cylinder" else np.zeros(n)
    tilt = np.zeros(n) if kind == "cylinder" else generator.uniform(-0.6, 0.6, n)
    normal = np.stack(
        [np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), np.sin(tilt)], axis=1
    )
    upward = high[:, None] * np.array([0.0, 0.0, 1.0])
    return CENTER + upward + (RADIUS + whisker)[:, None] * normal, normal, whisker


def noisy(kind, joint_errors, generator, n):
    points, normal, whisker = touched(kind, generator, n)
    errors = joint_errors(generator, normal)
    drawn = np.einsum("nij,nj->ni", errors, generator.normal(size=(n, 3)))
    covariance = errors @ np.swapaxes(errors, 1, 2)
    known = {
        "covariance": covariance[:, :3, :3],
        "whisker_radius": whisker,
        "normals": normal + drawn[:, 3:],
        "normal_covariance": covariance[:, 3:, 3:],
        "point_normal_covariance": covariance[:, :3, 3:],
    }
    return points + drawn[:, :3], known


def scores(kind, fit):
    """Errors of a fit in standard deviations."""
    sigma = fit.sigma
    if kind == "plane":
        height = (fit.origin - CENTER) @ np.array([0.0, -0.6, 0.8])
        tilt = fit.normal[:2] - np.array([0.0, -0.6])
        spread = np.array([0.0, -0.6, 0.8])
        away = np.sqrt(spread @ fit.covariance[:3, :3] @ spread)
        return [height / away, *(tilt / [sigma["normal_x"], sigma["normal_y"]])]
    out = [(fit.radius - RADIUS) / sigma["radius"]]
    if kind == "cylinder":
        offset, _ = axis_offset(fit.origin, fit.axis, CENTER, (0.0, 0.0, 1.0))
        out += list(offset[:2] / [sigma["origin_x"], sigma["origin_y"]])
        return out + list(fit.axis[:2] / [sigma["axis_x"], sigma["axis_y"]])
    return out + list((fit.origin - CENTER) / np.sqrt(np.diag(fit.covariance)[:3]))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cylinder", "sphere", "plane"])
def test_no_bias_and_an_honest_spread(kind, joint_errors):
    """Over thirty draws errors are as large as the covariance says, and have no bias."""
    found = []
    for seed in range(30):
        points, known = noisy(kind, joint_errors, np.random.default_rng(seed), 150)
        found.append(scores(kind, fit_shape(kind, points, **known)))
    z = np.array(found)
    k = z.shape[1]
    # The mean of 30 scores has a standard deviation of 0.18, their spread one of 0.13.
    assert (np.abs(z.mean(axis=0)) < 0.6).all()
    assert (z.std(axis=0) > 0.65).all()
    assert (z.std(axis=0) < 1.45).all()
    # 95 % of 30 k nearly independent scores, within three standard deviations
    assert abs((np.abs(z) < 1.96).mean() - 0.95) < 3.0 * np.sqrt(0.05 * 0.95 / (30 * k))


@pytest.mark.parametrize(
    "kind", ["cylinder", pytest.param("sphere", marks=pytest.mark.slow), "plane"]
)
def test_a_wrong_shape_is_told_by_its_misfit_and_is_unsure(kind, joint_errors):
    points, known = noisy(kind, joint_errors, np.random.default_rng(4), 150)
    right = fit_shape(kind, points, **known)
    # The median of 150 scores of three degrees of freedom has a standard deviation of 9 %.
    assert right.misfit == pytest.approx(1.0, abs=0.3)
    assert right.used.all()
    wrong = [name for name in KINDS if name != kind and kind != "plane"]
    for fit in (fit_shape(name, points, **known) for name in wrong):
        assert fit.misfit > 100.0
        # What it claims to know of its place is as much worse.
        assert fit.sigma["origin_x"] > 10.0 * right.sigma["origin_x"]
    points[::10] += 2e-3
    assert fit_shape(kind, points, **known).misfit == pytest.approx(1.0, abs=0.5)


def test_without_noise_there_is_no_misfit():
    points, normal, whisker = touched("sphere", np.random.default_rng(5), 40)
    assert np.isnan(fit_shape("sphere", points, whisker_radius=whisker, normals=normal).misfit)


def test_normals_with_their_covariance_tell_the_axis(joint_errors):
    points, known = noisy("cylinder", joint_errors, np.random.default_rng(0), 150)
    exact = {name: known[name] for name in ("covariance", "whisker_radius", "normals")}
    sigma, coarse = (fit_shape("cylinder", points, **how).sigma for how in (known, exact))
    assert sigma["axis_x"] < 0.7 * coarse["axis_x"]
    assert sigma["radius"] < coarse["radius"]


@pytest.mark.parametrize("kind", ["cylinder", "sphere", "plane"])
@pytest.mark.parametrize("normals", [False, True])
def test_exact_contacts_give_the_shape_back(kind, normals):
    generator = np.random.default_rng(5)
    points, normal, whisker = touched(kind, generator, 40)
    given = {"normals": normal} if normals else {}
    if kind == "plane" and not normals:
        given["outside"] = CENTER + np.array([0.0, -1e-2, 1e-2])
    fit = fit_shape(kind, points, whisker_radius=whisker, **given)
    np.testing.assert_allclose(fit.signed_distance(points), whisker, rtol=0, atol=1e-10)
    np.testing.assert_allclose(fit.outward_normals(points), normal, rtol=0, atol=1e-6)
    assert fit.rms < 1e-10
    assert fit.inliers.all()
    assert fit.kind in repr(fit)


@pytest.mark.parametrize("kind", ["cylinder", "sphere", "plane"])
@pytest.mark.parametrize("known", [False, True])
def test_outliers_do_little_harm(kind, known):
    generator = np.random.default_rng(7)
    points, _, whisker = touched(kind, generator, 200)
    points = points + generator.normal(scale=1e-5, size=points.shape)
    points[::10] += generator.normal(scale=2e-3, size=points[::10].shape)
    covariance = np.broadcast_to(1e-10 * np.eye(3), (200, 3, 3)) if known else None
    fit = fit_shape(kind, points, covariance, whisker)
    if kind == "plane":
        assert abs(fit.normal @ [0.0, -0.6, 0.8]) > np.cos(2e-3)
    else:
        assert abs(fit.radius - RADIUS) < 15e-6
        origin = axis_offset(fit.origin, (0, 0, 1), CENTER, (0, 0, 1))[0]
        assert np.linalg.norm(origin) < 15e-6
    assert fit.inliers[::10].mean() < 0.3
    assert np.delete(fit.inliers, slice(0, None, 10)).mean() > 0.97


def test_a_plane_faces_the_free_side():
    generator = np.random.default_rng(1)
    points, normal, whisker = touched("plane", generator, 30)
    assert fit_shape("plane", points, normals=-normal).normal @ normal[0] < -0.999
    assert fit_shape("plane", points).normal[2] > 0.0
    below = fit_shape("plane", points, outside=CENTER - normal[0], whisker_radius=whisker)
    assert below.normal @ normal[0] < -0.99


@pytest.mark.parametrize("kind", ["cylinder", "sphere", "plane"])
def test_a_fit_to_similar_points_leads_to_the_same_shape(kind, joint_errors):
    points, known = noisy(kind, joint_errors, np.random.default_rng(2), 60)
    start = fit_shape(kind, points + np.array([0.3e-3, -0.2e-3, 0.1e-3]), **known)
    searched, fit = fit_shape(kind, points, **known), fit_shape(kind, points, **known, start=start)
    for name in fit.fields:
        np.testing.assert_allclose(getattr(fit, name), getattr(searched, name), 1e-4, 1e-9)
    sigma, known_sigma = (np.sqrt(np.diag(one.covariance)) for one in (fit, searched))
    np.testing.assert_allclose(sigma, known_sigma, 1e-3, 1e-9)
    other = "plane" if kind == "sphere" else "sphere"
    with pytest.raises(ValueError, match=f"start is a {kind}"):
        fit_shape(other, points, start=start)


@pytest.mark.parametrize("kind", ["cylinder", "sphere"])
def test_outliers_weigh_the_same_in_every_frame(kind, joint_errors):
    points, known = noisy(kind, joint_errors, np.random.default_rng(2), 60)
    points[::7] += 1e-3
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    turned = {"whisker_radius": known.pop("whisker_radius"), "normals": known["normals"] @ turn.T}
    fit = fit_shape(kind, points, whisker_radius=turned["whisker_radius"], **known)
    turned |= {name: turn @ each @ turn.T for name, each in known.items() if name != "normals"}
    again = fit_shape(kind, points @ turn.T, **turned)
    assert again.radius == pytest.approx(fit.radius, abs=1e-3 * fit.sigma["radius"])


@pytest.mark.parametrize("kind", ["cylinder", "sphere", "plane"])
def test_datasets_keep_fits(kind, joint_errors):
    points, known = noisy(kind, joint_errors, np.random.default_rng(2), 60)
    points[7] = np.nan
    fit = fit_shape(kind, points, **known)
    stored = fit.to_dataset(("time", "whisker"), (30, 2), {"time": np.arange(30) * 1e-3})
    assert stored["surface_distance"].dims == ("time", "whisker")
    assert stored.attrs["shape"] == kind
    assert stored["object_position"].attrs["units"] == "m"
    again = shape_from_dataset(stored)
    assert again.equations == fit.equations == 3
    assert again.misfit == fit.misfit
    for name in (*fit.fields, "covariance", "residuals", "inliers", "chi_squared"):
        np.testing.assert_array_equal(getattr(again, name), getattr(fit, name))
    with pytest.raises(ValueError, match="lacks inlier"):
        shape_from_dataset(stored.drop_vars("inlier"))
    with pytest.raises(ValueError, match="None"):
        shape_from_dataset(stored.assign_attrs(shape=None))
    for name in {"object_radius", "object_axis"} & set(stored):
        with pytest.raises(ValueError, match="which is not valid"):
            shape_from_dataset(stored.assign({name: -0.5 * stored[name]}))


def test_residuals_of_a_sphere_are_distances(joint_errors):
    points, known = noisy("sphere", joint_errors, np.random.default_rng(3), 60)
    fit = fit_shape("sphere", points, **known)
    expected = np.linalg.norm(points - fit.origin, axis=1) - fit.radius - known["whisker_radius"]
    np.testing.assert_allclose(fit.residuals, expected, rtol=0, atol=1e-12)
    cylinder = fit_shape("cylinder", points, **known)
    gap = Peg(cylinder.origin, cylinder.axis, cylinder.radius).signed_distance(points)
    np.testing.assert_allclose(cylinder.signed_distance(points), gap, rtol=0, atol=1e-12)


def test_what_is_no_shape_is_refused(joint_errors):
    points, known = noisy("sphere", joint_errors, np.random.default_rng(4), 40)
    angle = np.linspace(0.0, 2.0 * np.pi, 40)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(40)], axis=1)
    with pytest.raises(ValueError, match="do not determine one"):
        fit_shape("sphere", circle)
    assert fit_shape("sphere", circle, normals=circle).radius == pytest.approx(1.0)
    line = np.linspace(0, 1, 20)[:, None] * [1e-3, 2e-3, 3e-3]
    for kind in ("sphere", "plane"):
        with pytest.raises(ValueError, match="on a line"):
            fit_shape(kind, line)
    with pytest.raises(ValueError, match="'cone'"):
        fit_shape("cone", points)
    with pytest.raises(ValueError, match="axis is given"):
        fit_shape("sphere", points, axis=[0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match="4 usable points; at least 5"):
        fit_shape("sphere", points[:4])
    with pytest.raises(ValueError, match="3 usable points; at least 4"):
        fit_shape("plane", points[:3])
    with pytest.raises(ValueError, match="without normals and covariance"):
        fit_shape("sphere", points, normal_covariance=known["normal_covariance"])
    with pytest.raises(ValueError, match="without normal_covariance"):
        fit_shape("sphere", points, point_normal_covariance=known["point_normal_covariance"])
    wrong = known["covariance"].copy()
    wrong[3, 0, 0] = -1.0
    with pytest.raises(ValueError, match="point 3"):
        fit_shape("sphere", points, wrong)
    masked = np.ma.masked_array(points, mask=np.arange(40)[:, None] == [[3, 3, 3]])
    spoilt = np.ma.masked_array(points + (masked.mask * 1.0), mask=masked.mask)
    radii = [fit_shape("sphere", one, known["covariance"]).radius for one in (masked, spoilt)]
    assert radii[0] == radii[1]
    for call in (
        lambda: fit_shape("sphere", points, whisker_radius=-50e-6),
        lambda: compare_with(Peg([0, 0, 0], [0, 0, 1], 1e-3), points, whisker_radius=-50e-6),
    ):
        with pytest.raises(ValueError, match="whisker_radius is negative"):
            call()
    with pytest.raises(ValueError, match="outside is"):
        fit_shape("plane", points, outside=[0.0, 1.0])


def test_covariances_and_units_that_cannot_be_meant():
    """Asymmetric covariances and points in mm were accepted; zeros made points exact."""
    generator = np.random.default_rng(2)
    points = generator.normal(size=(20, 3))
    points = 2e-3 * points / np.linalg.norm(points, axis=1)[:, None]
    covariance = np.tile((2e-5) ** 2 * np.eye(3), (20, 1, 1))
    lopsided, exact = covariance.copy(), covariance.copy()
    lopsided[5, 0, 2] = 0.5 * covariance[5, 0, 0]
    exact[7] = 0.0
    with pytest.raises(ValueError, match="point 5 is invalid: it is not symmetric"):
        fit_shape("sphere", points, lopsided)
    with pytest.raises(ValueError, match="point 7 is invalid: it is zero"):
        fit_shape("sphere", points, exact)
    with pytest.raises(ValueError, match="point 5 is invalid: it is not symmetric"):
        fit_shape("sphere", points, covariance, 0.0, points, normal_covariance=lopsided)
    with pytest.warns(UserWarning, match=r"extend over .* are they in other units than m\?"):
        fit_shape("sphere", 1e3 * points, 1e6 * covariance, 1e3 * 50e-6)


@pytest.mark.slow
def test_a_cylinder_of_few_points_does_not_end_in_another_one():
    """Whichever way its axis points in the frame of the points, its fit is as good as the truth."""
    rng, sigma, radius = np.random.default_rng(4), 1e-4, 8e-3
    for _ in range(40):
        *across, axis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        angle, height = rng.uniform(-1.25, 1.25, 8), rng.uniform(-1.0, 1.0, 8) * 2.0 * radius
        outward = np.cos(angle)[:, None] * across[0] + np.sin(angle)[:, None] * across[1]
        points = radius * outward + height[:, None] * axis + sigma * rng.normal(size=(8, 3))
        found = fit_shape("cylinder", points, np.tile(sigma**2 * np.eye(3), (8, 1, 1)))
        gaps = np.linalg.norm(points - (points @ axis)[:, None] * axis, axis=1) - radius
        assert found.chi_squared.sum() < ((gaps / sigma) ** 2).sum() + 0.5


def test_errors_that_contacts_share_are_weighted_as_their_covariance_says():
    generator = np.random.default_rng(3)
    n, m, k = 7, 3, 2
    misses, shared = generator.normal(size=(n, m)), generator.normal(size=(n, m, k))
    root = generator.normal(size=(n, m, m))
    covariance = root @ np.swapaxes(root, 1, 2)
    whole = np.zeros((n, m, n, m))
    whole[np.arange(n), :, np.arange(n)] = covariance
    whole = whole.reshape(n * m, n * m)
    by_error = shared.reshape(n * m, k)
    whole += by_error @ by_error.T
    expected = misses.reshape(-1) @ np.linalg.solve(whole, misses.reshape(-1))
    assert (whiten(misses, covariance, shared) ** 2).sum() == pytest.approx(expected, rel=1e-6)
    none = whiten(misses, covariance, shared[..., :0])
    np.testing.assert_array_equal(none, whiten(misses, covariance))


def test_a_cylinder_is_as_near_as_stated_where_all_normals_are_turned_alike(joint_errors):
    """As by friction along it: normals turn about the tangents of the whisker."""
    generator = np.random.default_rng(11)
    squares = {True: [], False: []}
    for _ in range(20):
        points, known = noisy("cylinder", joint_errors, generator, 60)
        tangent = np.cross(np.array([0.0, 0.0, 1.0]), known["normals"])
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        each = 0.1 * np.stack([np.ones(60), known["normals"][:, 0]], axis=1)
        turns = Rotation.from_rotvec((each @ generator.normal(size=2))[:, None] * tangent)
        known["normals"] = turns.apply(known["normals"])
        turned = turns.as_matrix()
        known["normal_covariance"] = turned @ known["normal_covariance"] @ np.swapaxes(turned, 1, 2)
        known["point_normal_covariance"] = known["point_normal_covariance"] @ np.swapaxes(
            turned, 1, 2
        )
        shared = np.zeros((60, 2, 6))
        shared[:, :, 3:] = each[:, :, None] * np.cross(tangent, known["normals"])[:, None]
        for stated in squares:
            more = {"shared": shared} if stated else {}
            fit = fit_shape("cylinder", points, **known, **more)
            size = np.sqrt(np.diag(fit.covariance)[[3, 4, 6]])
            squares[stated].append(((fit.axis[0], fit.axis[1], fit.radius - RADIUS) / size) ** 2)
    score = {stated: np.sqrt(np.mean(values, axis=0)) for stated, values in squares.items()}
    assert (score[True] < 1.5).all()
    assert score[False][:2].max() > 5.0
    with pytest.raises(ValueError, match="shared is given without"):
        fit_shape("cylinder", points, shared=shared)


def test_a_point_far_away_does_not_set_the_scale_of_the_others(joint_errors):
    points, known = noisy("cylinder", joint_errors, np.random.default_rng(4), 100)
    points[7] = [1.0, -2.0, 0.5]
    fit = fit_shape("cylinder", points, **known)
    assert abs(fit.radius - RADIUS) < 4.0 * fit.sigma["radius"] < 0.1e-3
    assert not fit.inliers[7]


def test_contacts_count_where_most_of_them_are_at_one_point(joint_errors):
    """An object was touched for long at one point, and then elsewhere."""
    points, known = noisy("cylinder", joint_errors, np.random.default_rng(4), 100)
    rows = np.r_[np.zeros(200, dtype=int), np.arange(100)]
    points, known = points[rows], {name: values[rows] for name, values in known.items()}
    points[:200] += 1e-7 * np.random.default_rng(5).normal(size=(200, 3))
    assert fit_shape("cylinder", points, **known).inliers[200:].mean() > 0.9


def test_standard_deviations_and_millimetres_are_not_taken_for_what_is_needed(joint_errors):
    points, known = noisy("cylinder", joint_errors, np.random.default_rng(4), 100)
    alike = np.broadcast_to(4e-5 * np.eye(3), (100, 3, 3))  # m, not m²
    with (
        pytest.warns(UserWarning, match="covariance is not in m²"),
        pytest.raises(ValueError, match="hollow"),
    ):
        fit_shape("cylinder", points, alike, known["whisker_radius"])
    with pytest.raises(ValueError, match="larger than the extent of the contacts"):
        fit_shape("cylinder", points, known["covariance"], 1e3 * known["whisker_radius"])
    with pytest.raises(ValueError, match="times whisker_radius"):
        fit_shape("cylinder", 1e3 * points, known["covariance"], known["whisker_radius"])


def test_a_whisker_may_be_sharp(joint_errors):
    points, known = noisy("sphere", joint_errors, np.random.default_rng(4), 100)
    assert fit_shape("sphere", points, known["covariance"], 1e-8).size > 0.0


def test_no_cylinder_is_infinitely_large():
    """Forces that are not the normals: the refined radius was kilometres, and 'all agreed'."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        angle = rng.uniform(-0.6, 0.6, 60)
        points = 1.5e-3 * np.stack([np.cos(angle), np.sin(angle), rng.uniform(-2, 2, 60)], -1)
        points += 1e-4 * rng.normal(size=points.shape)
        covariance = np.tile(1e-8 * np.eye(3), (60, 1, 1))
        normals = np.tile([1.0, 0.0, 0.0], (60, 1))
        spread = np.tile(1e-5 * np.eye(3), (60, 1, 1))
        # A candidate for the axis is along these normals, which is no reason for warnings either.
        with pytest.raises(ValueError, match="none of finite size fits"):
            fit_shape(
                "cylinder", points, covariance, 5e-5, normals=normals, normal_covariance=spread
            )


def test_arguments_in_another_order_or_of_another_shape_are_named(joint_errors):
    points, known = noisy("sphere", joint_errors, np.random.default_rng(4), 100)
    with pytest.raises(ValueError, match=r"shape is array.*; it must be one of"):
        fit_shape(points, "sphere")
    fit = fit_shape("sphere", points, **known)
    for method in (fit.signed_distance, fit.outward_normals, fit.distance_sigma):
        with pytest.raises(ValueError, match=r"must have shape \(..., 3\)"):
            method(points[:, :2])


def test_a_stout_rod_may_touch_a_small_part_of_a_plane():
    """A robot's whisker of 1 mm radius, whose contacts are within half a millimetre."""
    points = np.random.default_rng(4).normal(size=(40, 3)) * [4e-4, 4e-4, 1e-6]
    fit = fit_shape("plane", points, np.tile(1e-12 * np.eye(3), (40, 1, 1)), 1e-3)
    assert abs(fit.normal[2]) > 0.999
