"""The contact at a given point: the inverse of bending by a known force, or a reason for none."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.interpolate import CubicSpline

import vibrissa as vb
from vibrissa.rod import discretize, fold_forces, solve_forces, stable_set

few = settings(max_examples=8)


def sizes(v):
    return np.linalg.norm(v, axis=-1)


def det(whisker, bent):
    """Det ∂p/∂ξ of deflections, relative to its value at rest at the same arc length."""
    d = discretize(whisker)
    contacts = np.concatenate(
        [bent.arc_length[..., None] / d.length, bent.contact_force / d.force], axis=-1
    ).reshape(-1, 4)
    rest = contacts * [1.0, 0.0, 0.0, 0.0]
    loaded, unloaded = (solve_forces(d, c, tangents=True)[1][:, 3:] for c in (contacts, rest))
    return np.linalg.det(loaded) / np.linalg.det(unloaded)


@few
@given(data=st.data())
def test_the_contact_point_of_a_force_gives_the_force_back(whisker, loads, data):
    load = data.draw(loads).on(whisker, most=0.95)
    pushed = vb.deflect(whisker, load)
    touched = vb.deflect(whisker, vb.PointContact(pushed.contact_point))
    assert (touched.status == vb.Status.OK).all()
    length, force = whisker.length, discretize(whisker).force
    # The equations are met to 1e-11 L; toward the fold a contact is that much looser.
    loose = 1.0 / det(whisker, pushed)
    assert (sizes(touched.contact_point - pushed.contact_point) <= 1e-10 * length).all()
    assert (np.abs(touched.arc_length - pushed.arc_length) <= 1e-9 * loose * length).all()
    assert (sizes(touched.force - pushed.force) <= 1e-9 * loose * force).all()
    assert (touched.residual <= 1e-10).all()
    assert (touched.contact_force[:, 0] == 0.0).all()


@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (0,)])
def test_points_of_any_shape(gamma, shape):
    rng = np.random.default_rng(1)
    s, angle = rng.uniform(0.4, 0.95, shape) * gamma.length, rng.uniform(-np.pi, np.pi, shape)
    pushed = vb.deflect(gamma, vb.PointForce(s, 1e-7, angle))
    touched = vb.deflect(gamma, vb.PointContact(pushed.contact_point))
    assert touched.status.shape == shape
    np.testing.assert_allclose(touched.arc_length, s, rtol=1e-7)
    np.testing.assert_allclose(touched.force, pushed.force, rtol=0, atol=1e-12)


def test_stiffness_scales_the_force_at_a_point(gamma):
    rng = np.random.default_rng(2)
    n = 200
    load = vb.PointForce(
        rng.uniform(0.35, 0.9, n) * gamma.length, 2e-6, rng.uniform(-np.pi, np.pi, n)
    )
    points = vb.PointContact(vb.deflect(gamma, load).contact_point)
    bent = vb.deflect(gamma, points)
    same = vb.deflect(gamma.with_properties(youngs_modulus=2.0 * gamma.youngs_modulus), points)
    np.testing.assert_allclose(same.arc_length, bent.arc_length, rtol=1e-9)
    np.testing.assert_allclose(same.force, 2.0 * bent.force, rtol=0, atol=1e-14)


def test_trimming_the_tip_leaves_proximal_contacts_alone(gamma):
    rng = np.random.default_rng(3)
    n = 200
    load = vb.PointForce(
        rng.uniform(0.3, 0.69, n) * gamma.length, 1e-5, rng.uniform(-np.pi, np.pi, n)
    )
    points = vb.PointContact(vb.deflect(gamma, load).contact_point)
    bent = vb.deflect(gamma, points, steps=144)
    cut = vb.deflect(gamma.trimmed(0.7 * gamma.length), points, steps=144)
    np.testing.assert_array_equal(cut.status, vb.Status.OK)
    np.testing.assert_allclose(cut.arc_length, bent.arc_length, rtol=1e-8)
    assert (sizes(cut.force - bent.force) <= 1e-8 * sizes(bent.force)).all()


def test_a_compliant_base_answers_as_the_force_solve_does(gamma, loads):
    stiffness = gamma.base_bending_stiffness / gamma.length
    soft = gamma.with_properties(base_stiffness=(3.0 * stiffness, 2.0 * stiffness))
    rng = np.random.default_rng(4)
    n = 300
    s, angle = rng.uniform(0.3, 1.0, n), rng.uniform(-np.pi, np.pi, n)
    force = 0.5 * discretize(gamma).force * (1.0 - 0.98 * s) ** 2 * rng.uniform(0.0, 1.0, n)
    pushed = vb.deflect(soft, vb.PointForce(s * soft.length, force, angle))
    assert (det(soft, pushed) > 0.1).all()
    touched = vb.deflect(soft, vb.PointContact(pushed.contact_point))
    np.testing.assert_array_equal(touched.status, vb.Status.OK)
    np.testing.assert_allclose(touched.arc_length, pushed.arc_length, rtol=1e-8)
    np.testing.assert_allclose(touched.force, pushed.force, rtol=0, atol=1e-8 * force.max())


# Points that the resting whisker touches, or nearly.


@few
@given(s=st.floats(0.302, 0.998), off=st.sampled_from([0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3]))
def test_a_point_on_the_resting_whisker_needs_no_force(whisker, s, off):
    d = discretize(whisker)
    point = whisker.position(s * d.length) + off * d.length * whisker.frame(s * d.length)[:, 1]
    bent = vb.deflect(whisker, vb.PointContact(point))
    assert bent.status == vb.Status.OK
    assert abs(bent.arc_length / d.length - s) <= 2.0 * off + 1e-7
    # At the tip 1 N bends thousands of times as far as at 0.3 L.
    assert sizes(bent.force) / d.force <= 150.0 * off + 1e-7


# A curved and nearly cylindrical whisker, bent far enough, passes again through points that it
# touches at rest: there the answer is the contact that grows from rest.


def along_the_path_from_rest(d, s, ends, steps):
    """Contacts (n, 4) at points ``ends``, followed from rest at s by Newton's method."""
    contacts = np.stack([s, 0.0 * s, 0.0 * s, 0.0 * s], axis=-1)
    begins = solve_forces(d, contacts)[0][:, 3:]
    for part in np.arange(1, steps + 1) / steps:
        for _ in range(8):
            values, tangents = solve_forces(d, contacts, tangents=True)
            left = values[:, 3:] - (begins + part * (ends - begins))
            contacts[:, [0, 2, 3]] -= np.linalg.solve(tangents[:, 3:], left[..., None])[..., 0]
        assert (np.linalg.det(tangents[:, 3:]) > 0.0).all()
        assert (sizes(left) <= 1e-12).all()
    return contacts


def arched(bend, ratio):
    """A whisker of constant curvature that turns by ``bend`` (rad)."""
    curvature = np.array([0.0, 0.0, bend]) / 69.4e-3
    return vb.Whisker.from_curvature(
        69.4e-3,
        lambda s: curvature + 0.0 * np.asarray(s)[..., None],
        base_radius=97e-6,
        tip_radius=97e-6 / ratio,
    )


@pytest.fixture(scope="module", params=[(0.9, 1.062), (1.0, 1.0)])
def cylinder(request):
    return arched(*request.param)


@pytest.mark.parametrize("off", [0.0, 3e-9, 3e-6, 1e-3, 6e-3])
def test_a_light_contact_is_light_on_a_cylinder_too(cylinder, off):
    d = discretize(cylinder)
    s = np.linspace(0.31, 0.99, 69)
    bearing = np.arange(69) * 2.4
    frame = cylinder.frame(s * d.length)
    aside = frame[:, :, 1] * np.cos(bearing)[:, None] + frame[:, :, 2] * np.sin(bearing)[:, None]
    points = cylinder.position(s * d.length) + off * d.length * aside
    expected = along_the_path_from_rest(d, s, points / d.length, 1)
    bent = vb.deflect(cylinder, vb.PointContact(points))
    np.testing.assert_array_equal(bent.status, vb.Status.OK)
    np.testing.assert_allclose(bent.arc_length / d.length, expected[:, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(bent.contact_force / d.force, expected[:, 1:], rtol=0, atol=1e-7)


@pytest.fixture(scope="module")
def corkscrew():
    """As thick at its tip, and so curved in space that one point may be held in two ways."""

    def curvature(s):
        s = np.asarray(s)[..., None] / 69.4e-3
        turns = [2.0 + 0.0 * s, 1.5 * np.cos(2.0 * s), 1.5 * np.sin(3.0 * s)]
        return np.concatenate(turns, axis=-1) / 69.4e-3

    return vb.Whisker.from_curvature(69.4e-3, curvature, base_radius=97e-6, tip_radius=97e-6)


def test_where_two_contacts_are_at_one_point_the_lighter_one_is_the_answer(corkscrew):
    d, fold = discretize(corkscrew), stable_set(corkscrew).fold
    rng = np.random.default_rng(6)
    s, bearing = rng.uniform(0.31, 0.99, 3000), rng.uniform(-np.pi, np.pi, 3000)
    known = np.stack([s, 0.0 * s, np.cos(bearing), np.sin(bearing)], axis=-1)
    share = rng.uniform(0.3, 0.95, 3000)
    known[:, 2:] *= (share * fold_forces(fold, known[:, [0, 2, 3]]))[:, None]
    points = solve_forces(d, known)[0][:, 3:]
    bent = vb.deflect(corkscrew, vb.PointContact(points * d.length))
    np.testing.assert_array_equal(bent.status, vb.Status.OK)
    found = np.column_stack([bent.arc_length / d.length, bent.contact_force / d.force])
    others = np.abs(found[:, 0] - known[:, 0]) > 1e-6
    assert 50 < others.sum() < 300
    assert (sizes(found[others, 1:]) < sizes(known[others, 1:])).all()
    assert (sizes(solve_forces(d, found)[0][:, 3:] - points) < 1e-10).all()
    for share in np.linspace(0.0, 1.0, 101):  # each is connected to rest
        for contacts in (known[others], found[others]):
            along = solve_forces(d, contacts * [1.0, share, share, share], tangents=True)[1]
            assert (np.linalg.det(along[:, 3:]) > 0.0).all()


def test_just_before_the_proximal_limit_a_cylinder_is_not_touched_elsewhere(cylinder):
    points = cylinder.position(np.linspace(0.2, 0.2999, 40) * cylinder.length)
    status = vb.deflect(cylinder, vb.PointContact(points)).status
    np.testing.assert_array_equal(status, vb.Status.TOO_PROXIMAL)


@pytest.mark.parametrize(("turn", "ratio"), [(0.9, 1.062), (1.2, 1.02)])
def test_a_cylinder_slips_off_first_where_it_may_in_two_ways(turn, ratio):
    """In its plane and out of it at nearly the same force; one ray missed that."""
    chart = stable_set(arched(turn, ratio))
    folds = np.insert(chart.contacts[:, :-1, -1].reshape(-1, 3), 1, 0.0, axis=1)
    for share in np.linspace(0.3, 0.99, 70):
        contacts = folds * [1.0, 1.0, share, share]
        tangents = solve_forces(chart.discretization, contacts, tangents=True)[1]
        assert (np.linalg.det(tangents[:, 3:]) > 0.0).all()


@few
@given(data=st.data())
def test_the_answer_is_connected_to_rest(cylinder, loads, data):
    """Half way to the fold: followed from rest in small steps, by the test's own code."""
    load = data.draw(loads).on(cylinder, most=0.5)
    points = vb.deflect(cylinder, load).contact_point
    bent = vb.deflect(cylinder, vb.PointContact(points))
    d = discretize(cylinder)
    s = bent.arc_length / d.length
    force = bent.contact_force / d.force
    contacts = np.concatenate([s[:, None], force], axis=1)
    for share in np.linspace(0.0, 1.0, 21):
        values, tangents = solve_forces(d, contacts * [1.0, share, share, share], tangents=True)
        assert (np.linalg.det(tangents[:, 3:]) > 0.0).all()
    assert (sizes(values[:, 3:] * d.length - points) <= 1e-10 * d.length).all()


# Points out of reach, and why.


@pytest.fixture(scope="module")
def edge(gamma):
    """Contacts at the fold in some directions, found by bisecting the force."""
    d = discretize(gamma)
    s, angle = np.meshgrid([0.4, 0.6, 0.8], np.arange(8) * np.pi / 4, indexing="ij")
    s, angle = s.ravel(), angle.ravel()

    def tangents(force, rays=slice(None)):
        contacts = np.stack(
            [s[rays], 0 * force, force * np.cos(angle[rays]), force * np.sin(angle[rays])], axis=-1
        )
        return solve_forces(d, contacts, tangents=True)

    def stable(force, rays=slice(None)):
        return np.linalg.det(tangents(force, rays)[1][:, 3:]) > 0.0

    low, high, rays = np.zeros_like(s), np.zeros_like(s), np.arange(s.size)
    while rays.size:
        high[rays] += 0.02
        rays = rays[stable(high[rays], rays)]
        low[rays] = high[rays]
    for _ in range(50):
        middle = 0.5 * (low + high)
        held = stable(middle)
        low, high = np.where(held, middle, low), np.where(held, high, middle)
    values, slopes = tangents(low)
    left, singular, _ = np.linalg.svd(slopes[:, 3:])
    assert (singular[:, 2] < 1e-9).all()
    normal = left[:, :, 2]
    # The image of the stable contacts lies on the side toward less force.
    inward = np.einsum("ni,ni->n", normal, tangents(0.99 * low)[0][:, 3:] - values[:, 3:])
    return values[:, 3:], -np.sign(inward)[:, None] * normal


@pytest.mark.parametrize("step", [1e-6, 1e-4, 1e-3, 1e-2])
def test_beyond_the_fold_the_whisker_has_slipped_off(gamma, edge, step):
    places, outward = edge
    inside = vb.deflect(gamma, vb.PointContact((places - step * outward) * gamma.length))
    beyond = vb.deflect(gamma, vb.PointContact((places + step * outward) * gamma.length))
    np.testing.assert_array_equal(inside.status, vb.Status.OK)
    assert (det(gamma, inside) > 0.0).all()
    np.testing.assert_array_equal(beyond.status, vb.Status.BEYOND_FOLD)
    assert np.isnan(beyond.force).all()
    assert np.isnan(beyond.contact_point).all()


@pytest.mark.parametrize("step", [1e-6, 1e-4, 1e-3, 1e-2, 0.3])
def test_beyond_the_tip_the_whisker_is_too_short(whisker, step):
    along = whisker.frame(whisker.length)[:, 0] * whisker.length
    tip = whisker.position(whisker.length)
    assert vb.deflect(whisker, vb.PointContact(tip + step * along)).status == vb.Status.BEYOND_TIP
    assert vb.deflect(whisker, vb.PointContact(tip - step * along)).status == vb.Status.OK


def test_too_near_the_base_is_a_matter_of_the_limit(whisker):
    points = whisker.position(np.array([0.1, 0.25, 0.299, 0.301]) * whisker.length)
    status = vb.deflect(whisker, vb.PointContact(points)).status
    np.testing.assert_array_equal(status[:3], vb.Status.TOO_PROXIMAL)
    assert status[3] == vb.Status.OK
    nearer = vb.deflect(whisker, vb.PointContact(points), proximal=0.1)
    np.testing.assert_array_equal(nearer.status, vb.Status.OK)
    np.testing.assert_allclose(nearer.arc_length / whisker.length, [0.1, 0.25, 0.299, 0.301])


def test_absurd_points_are_refused_not_solved(whisker):
    points = np.array([[10.0, 0, 0], [-0.01, 0, 0], [0, 0.03, 0], [0, 0, 0], [0, 0, -5.0]])
    status = vb.deflect(whisker, vb.PointContact(points)).status
    refusals = (vb.Status.BEYOND_FOLD, vb.Status.BEYOND_TIP, vb.Status.TOO_PROXIMAL)
    assert np.isin(status, refusals).all()


def test_missing_rows_stay_missing_and_stop_nobody(gamma):
    points = gamma.position(np.array([0.5, 0.6, 0.7]) * gamma.length)
    points[1, 2] = np.nan
    bent = vb.deflect(gamma, vb.PointContact(points))
    ok, missing = vb.Status.OK, vb.Status.MISSING
    np.testing.assert_array_equal(bent.status, [ok, missing, ok])
    assert np.isnan(bent.moment[1]).all()
    assert np.isfinite(bent.moment[[0, 2]]).all()


def test_the_paper_s_grid_is_answered_to_the_last_point(gamma):
    """All points get a contact or a reason; none is left unconverged (coarser than the paper)."""
    r = np.linspace(0.3, 1.0, 8) * gamma.length
    theta, phi = np.radians(np.linspace(-65, 65, 27)), np.radians(np.linspace(-60, 60, 25))
    r, theta, phi = np.meshgrid(r, theta, phi, indexing="ij")
    flat = r * np.cos(phi)
    points = np.stack([flat * np.cos(theta), flat * np.sin(theta), r * np.sin(phi)], axis=-1)
    bent = vb.deflect(gamma, vb.PointContact(points))
    assert bent.status.shape == (8, 27, 25)
    assert not (bent.status == vb.Status.NOT_CONVERGED).any()
    ok = bent.status == vb.Status.OK
    assert 0.2 < ok.mean() < 0.9
    assert (sizes(bent.contact_point - points)[ok] <= 1e-9 * gamma.length).all()
    found = vb.deflect(gamma, vb.PointContact(points[ok]))
    assert (det(gamma, found) > -1e-5).all()


def test_the_answer_is_the_same_every_time(gamma):
    points = gamma.position(np.linspace(0.35, 0.95, 40) * gamma.length) + np.array([0, 2e-3, 1e-3])
    first, second = (vb.deflect(gamma, vb.PointContact(points)) for _ in range(2))
    np.testing.assert_array_equal(first.force, second.force)
    np.testing.assert_array_equal(first.status, second.status)


@pytest.mark.parametrize("cells", [(1, 2, 2), (2, 3, 2), (3, 4, 2), (8, 12, 2)])
def test_the_fold_between_nodes_is_the_spline_through_them(gamma, cells):
    """With few nodes, too, where not-a-knot splines are parabolas."""
    chart = stable_set(gamma, cells=cells)
    value, in_s, in_psi, in_both = np.moveaxis(chart.fold.log_force, -1, 0)
    eta = np.linspace(0.0, 1.0, cells[0] + 1)
    around = CubicSpline(chart.bearings, value, axis=1, bc_type="periodic")(chart.bearings, 1)
    assert in_psi == pytest.approx(around, abs=1e-12)
    assert in_s == pytest.approx(CubicSpline(eta, value)(eta, 1), abs=1e-12)
    assert in_both == pytest.approx(CubicSpline(eta, around)(eta, 1), abs=1e-11)
