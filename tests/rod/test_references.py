"""The rod against solutions it did not make: integration, closed form, another program, a paper."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import vibrissa as vb
from vibrissa.rod import discretize, solve_forces

LENGTH = 39.4e-3


def relative(found, known):
    """|found - known| / |known| of vectors in the last axis."""
    return np.linalg.norm(found - known, axis=-1) / np.linalg.norm(known, axis=-1)


# An independent integration of the continuous rod, from the base outward.


def ramp(s):
    out_of_plane = np.maximum(0.0, 15.0 * (s - 0.6 * LENGTH) / (0.4 * LENGTH))
    return np.stack([0.0 * s, out_of_plane, 5.0 + 400.0 * s], axis=-1)


@pytest.fixture(scope="module")
def kirchhoff(reference):
    """Error of p/L, F/|F| and M/|M|, the worst of 120 loads, for a number of steps."""
    straight = [0.0, 0.0, 0.0]
    whiskers = {
        "K1": vb.Whisker.from_curvature(LENGTH, lambda s: [0.0, 0.0, 12.0]),
        "K2": vb.Whisker.from_curvature(LENGTH, ramp, breaks=(0.6 * LENGTH,)),
        "K3": vb.Whisker.from_curvature(LENGTH, lambda s: straight),
    }
    cases = reference("kirchhoff")["cases"]
    assert len(cases) == 120

    def worst(**settings):
        error = 0.0
        for name, whisker in whiskers.items():
            rows = [case for case in cases if case[0] == name]
            s, force, angle = np.array([case[1:4] for case in rows]).T
            p, f, m = (np.array([case[i] for case in rows]) for i in (4, 5, 6))
            bent = vb.deflect(whisker, vb.PointForce(s * LENGTH, force, angle), **settings)
            assert (bent.status == vb.Status.OK).all()
            error = max(
                error,
                np.linalg.norm(bent.contact_point - p, axis=1).max() / LENGTH,
                relative(bent.force, f).max(),
                relative(bent.moment, m).max(),
            )
        return error

    return worst


def test_the_default_steps_meet_an_independent_integration(kirchhoff):
    assert kirchhoff() <= 2e-6


def test_finer_steps_meet_it_to_nine_digits(kirchhoff):
    assert kirchhoff(steps=144) <= 1e-9


def test_the_error_falls_with_the_sixth_power_of_the_steps(kirchhoff):
    coarse, middle, fine = (kirchhoff(steps=steps) for steps in (36, 72, 144))
    assert np.log2(coarse / fine) / 2 >= 5.5
    assert np.log2(middle / fine) >= 5.5


# The straight cantilever in closed form, by elliptic integrals.


@pytest.fixture(scope="module")
def cantilever(reference):
    """Worst error of the tip's place and of the base force for a number of steps."""
    rod = vb.Whisker.straight(LENGTH, tip_radius=100e-6)
    rows = reference("elliptic")["rows"]
    load, q, slope, x, y = (np.array(column) for column in zip(*rows, strict=True))
    unit = rod.base_bending_stiffness / LENGTH**2
    follower = load == "follower"
    # A dead load stays along y, seen from a tip that has turned; a follower normal to the tip.
    along = np.where(follower, 0.0, q * np.sin(slope))
    across = np.where(follower, q, q * np.cos(slope))
    direction = np.where(follower, slope, 0.0)
    force = q[:, None] * np.stack([-np.sin(direction), np.cos(direction), 0 * q], axis=-1)

    def worst(**settings):
        load = vb.PointForce(LENGTH, components=(along * unit, across * unit, 0.0))
        bent = vb.deflect(rod, load, **settings)
        tip = np.stack([x, y, 0 * x], axis=-1)
        return max(
            np.linalg.norm(bent.contact_point / LENGTH - tip, axis=1).max(),
            relative(bent.force / unit, force).max(),
        )

    return worst


def test_a_cantilever_bends_as_the_elliptic_integrals_say(cantilever):
    assert cantilever() <= 2e-6
    assert cantilever(steps=144) <= 1e-9


def test_a_cantilever_converges_with_the_sixth_power(cantilever):
    assert np.log2(cantilever(steps=18) / cantilever(steps=72)) / 2 >= 5.5


# Elastica3D, the solver of the paper: first order in its node spacing.


@pytest.fixture(scope="module")
def w1(reference):
    """Elastica3D's whisker, y = A x² and z = B max(0, σ - 0.6 L)², its curvature worked out here.

    The curve is parametrised by the arc length σ of the parabola; the frame turns along without
    rotating about the tangent: d1' = -(k·d1) t, with k the curvature vector.
    """
    a, kink = 10.0, 0.6 * LENGTH
    b = 1.5e-3 / (0.4 * LENGTH) ** 2

    def tangent_and_curvature(x, sigma, out):
        slope = 2.0 * a * x
        c = np.hypot(1.0, slope)
        rise, bend = (2.0 * b * (sigma - kink), 2.0 * b) if out else (0.0, 0.0)
        g = np.hypot(1.0, rise)
        t = np.array([1.0 / c, slope / c, rise]) / g
        second = np.array([-slope, 1.0, 0.0]) * 2.0 * a / c**4 + np.array([0.0, 0.0, bend])
        return t, (second - t * (t @ second)) / g**2, c, g

    def rate(out):
        def along(_, y):
            t, k, c, g = tangent_and_curvature(y[0], y[1], out)
            return [1.0 / (c * g), 1.0 / g, *(-(k @ y[2:]) * t)]

        return along

    pieces, start = [], [0.0, 0.0, 0.0, 1.0, 0.0]
    for out, span in ((False, (0.0, kink)), (True, (kink, LENGTH))):
        piece = solve_ivp(
            rate(out), span, start, method="DOP853", rtol=1e-12, atol=1e-14, dense_output=True
        )
        start = piece.y[:, -1]
        pieces.append(piece.sol)

    def curvature(s):
        if np.ndim(s):
            return np.array([curvature(one) for one in s])
        out = s >= kink
        y = pieces[out](s)
        t, k, _, _ = tangent_and_curvature(y[0], y[1], out)
        return np.array([0.0, -k @ np.cross(t, y[2:]), k @ y[2:]])

    whisker = vb.Whisker.from_curvature(LENGTH, curvature, breaks=(kink,))
    np.testing.assert_allclose(
        whisker.position(LENGTH), reference("elastica3d")["tip"], rtol=0, atol=1e-12
    )
    return whisker


def orders(errors):
    """Observed orders of convergence, over the last two doublings of the nodes."""
    return np.log2(errors[-3:-1] / errors[-2:])


def test_elastica3d_forces_converge_to_ours_with_first_order(w1, reference):
    observed = []
    for (s, force, zeta), *conditions in reference("elastica3d")["force_mode"]:
        # The force of its last, finest run says which way its frame is rolled against ours: not at
        # all where the whisker is planar, by up to 0.016 rad where it is not.
        for nodes in conditions:
            runs = np.array(nodes)
            limit = (8.0 * runs[-1] - 6.0 * runs[-2] + runs[-3]) / 3.0

            def ours_rolled(roll, s=s, force=force, zeta=zeta):
                bent = vb.deflect(w1, vb.PointForce(s, force, zeta + np.pi + roll[0]))
                return np.concatenate([bent.force, bent.moment, bent.contact_point])

            def miss(roll, ours_rolled=ours_rolled, known=limit[:3] / force, force=force):
                return ours_rolled(roll)[:3] / force - known

            roll = least_squares(miss, 0.0).x
            assert abs(roll[0]) < (1e-3 if s <= 0.6 * LENGTH * (1.0 + 1e-9) else 0.02)
            ours = ours_rolled(roll)
            for part in (slice(0, 3), slice(3, 6), slice(6, 9)):
                assert relative(limit[part], ours[part]) < 1e-3
                observed.append(orders(relative(runs[:, part], ours[part])))
    # The errors of some runs change sign on the way, so that single orders scatter.
    assert np.median(observed) == pytest.approx(1.0, abs=0.02)
    assert np.quantile(observed, [0.25, 0.75]) == pytest.approx(1.0, abs=0.1)


def test_elastica3d_contacts_converge_to_ours_with_first_order(w1, reference):
    cases = reference("elastica3d")["point_mode"]
    points = np.array([case[0] for case in cases])
    bent = vb.deflect(w1, vb.PointContact(points))
    # Of the last one it finds no contact but the nearest it can get: see the next test.
    np.testing.assert_array_equal(bent.status[:-1], vb.Status.OK)
    observed = []
    for i, case in enumerate(cases[:-1]):
        runs = np.array(case[1:])
        for ours, part in ((bent.force[i], slice(0, 3)), (bent.moment[i], slice(3, 6))):
            assert relative(2.0 * runs[-1, part] - runs[-2, part], ours) < 1e-3
            observed.append(orders(relative(runs[:, part], ours)))
    assert np.ravel(observed) == pytest.approx(1.0, abs=0.05)


def test_where_the_whisker_has_slipped_elastica3d_stops_at_the_fold(w1, reference):
    point, *runs = reference("elastica3d")["point_mode"][-1]
    assert vb.deflect(w1, vb.PointContact(point)).status == vb.Status.BEYOND_FOLD

    d = discretize(w1)

    def solved(xi):
        values, tangents = solve_forces(d, np.array([[xi[0], 0.0, xi[1], xi[2]]]), tangents=True)
        return values[0], tangents[0]

    def miss(xi):
        return solved(xi)[0][3:] - np.array(point) / LENGTH

    nearest = least_squares(miss, [0.92, -0.18, -0.03], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    # The nearest contact to the point is on the fold, 0.4 mm short of it ...
    values, tangents = solved(nearest.x)
    _, at_rest = solved([nearest.x[0], 0.0, 0.0])
    assert abs(np.linalg.det(tangents[3:])) < 1e-5 * np.linalg.det(at_rest[3:])
    assert np.linalg.norm(miss(nearest.x)) * LENGTH == pytest.approx(0.41e-3, rel=0.01)
    # ... and that is where its search ended, without saying so.
    assert relative(np.array(runs[-1][:3]), values[:3] * d.force) < 3e-3


# Figure 8 of Quist & Hartmann 2012.


def test_the_published_whisk_against_an_object_is_met():
    """Quist & Hartmann 2012 (J Neurophysiol 107:2298), Fig. 8, as converged values.

    An object touches the resting whisker halfway; the base then turns toward it by θ. Seen from the
    whisker the object moves by -θ on its circle.
    """
    whisker = vb.Whisker.parabola(35e-3, 23.3, base_radius=81.5e-6)
    x, y, _ = whisker.position(17.5e-3)
    turned = -np.radians([5.0, 10.0, 15.0, 20.0, 25.0, 30.0])
    cos, sin = np.cos(turned), np.sin(turned)
    points = np.stack([x * cos - y * sin, x * sin + y * cos, 0.0 * turned], axis=-1)
    bent = vb.deflect(whisker, vb.PointContact(points))

    fx = [21.9, 29.4, 20.8, -5.0, -47.8, -106.6]
    fy = [-42.4, -92.2, -145.0, -196.3, -241.1, -274.3]
    mz = [-0.803, -1.650, -2.516, -3.374, -4.197, -4.953]
    assert (bent.status == vb.Status.OK).all()
    assert (relative(bent.force[:, :2] * 1e6, np.stack([fx, fy], axis=-1)) < 5e-3).all()
    np.testing.assert_allclose(bent.moment[:, 2] * 1e6, mz, rtol=5e-3)
    np.testing.assert_allclose(bent.force[:, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(bent.moment[:, :2], 0.0, atol=1e-15)


@pytest.mark.parametrize(("taper", "slimming"), [(1.0, 0.0), (0.0, 1.0)], ids=["cylinder", "cone"])
def test_small_angles_follow_beam_theory(taper, slimming):
    """M = 3 EI θ / r for a cylinder, 3 EI_base θ (1 - r/L) / r for a cone (a tip of nothing)."""
    angle, r = 1e-4, np.array([0.3, 0.5, 0.7, 0.9]) * LENGTH
    rod = vb.Whisker.straight(LENGTH, tip_radius=max(taper, 1e-4) * 100e-6)
    points = np.stack([r * np.cos(angle), r * np.sin(angle), 0.0 * r], axis=-1)
    bent = vb.deflect(rod, vb.PointContact(points))
    expected = 3.0 * rod.base_bending_stiffness * angle * (1.0 - slimming * r / LENGTH) / r
    np.testing.assert_allclose(bent.moment[:, 2], expected, rtol=1e-3)
