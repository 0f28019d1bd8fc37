"""Loads refuse what cannot be meant, and say what they got and what is allowed."""

import numpy as np
import pytest

import vibrissa as vb

Z = (0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"arc_length": 0.02}, "either magnitude and direction, or components"),
        (
            {"arc_length": 0.02, "magnitude": 1e-6, "direction": [0.0, -90.0]},
            "direction is an angle in rad; got 90, which looks like degrees",
        ),
        ({"arc_length": 0.02, "magnitude": 1e-6}, "either magnitude and direction, or components"),
        (
            {"arc_length": 0.02, "magnitude": 1e-6, "direction": 0.0, "components": (0, 0, 0)},
            "either magnitude and direction, or components",
        ),
        ({"arc_length": 0.0, "magnitude": 1e-6, "direction": 0.0}, "positive.* smallest is 0.0"),
        ({"arc_length": [0.02, -0.01], "components": (0, 1, 0)}, "positive.* smallest is -0.01"),
        ({"arc_length": 0.02, "components": (0, 1)}, "got 2 of them"),
        (
            {"arc_length": 0.02, "components": np.zeros((3, 2))},
            r"shape \(\.\.\., 3\); got \(3, 2\)",
        ),
        ({"arc_length": np.ones(2), "components": np.zeros((3, 3))}, r"arc_length \(2,\)"),
        ({"arc_length": "far", "components": (0, 1, 0)}, "arc_length must be numbers; got 'far'"),
        ({"arc_length": np.inf, "components": (0, 1, 0)}, "arc_length has 1 infinite"),
    ],
)
def test_forces(arguments, said):
    with pytest.raises(ValueError, match=said):
        vb.PointForce(**arguments)


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (0.02, r"shape \(\.\.\., 3\); got \(\)"),
        ([0.02, 0.01], r"got \(2,\)"),
        (np.zeros((3, 2)), r"got \(3, 2\)"),
        ([0.02, 0.01, np.inf], "1 infinite"),
        ([[0.02, 0.01], [0.02]], r"must be numbers; got \[\[0.02"),
        (None, "points"),
    ],
)
def test_points(points, said):
    with pytest.raises(ValueError, match=said):
        vb.PointContact(points)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"origin": (0.02, 0.0), "axis": Z}, r"origin must have shape \(\.\.\., 3\); got \(2,\)"),
        ({"origin": (0.02, 0.0, 0.0), "axis": (0, 0, 0)}, r"axis must not be \(0, 0, 0\)"),
        ({"origin": (0.02, 0.0, 0.0), "axis": Z, "radius": -1e-3}, "smallest is -0.001 m"),
        ({"origin": (0.02, 0.0, 0.0), "axis": Z, "radius": [0.0, 1e-3]}, "cannot be mixed"),
        ({"origin": np.zeros((2, 3)), "axis": np.ones((3, 3))}, r"origin \(2,\), axis \(3,\)"),
        ({"origin": (0.02, 0.0, 0.0), "axis": Z, "side": (1.0, 0.0)}, "side must have shape"),
    ],
)
def test_pegs(arguments, said):
    with pytest.raises(ValueError, match=said):
        vb.PegContact(**arguments)


def test_a_peg_goes_on_from_a_peg_of_the_same_whisker_only(parabola, straight):
    touched = vb.deflect(parabola, vb.PointContact([0.02, 0.005, 0.0]))
    with pytest.raises(ValueError, match="by a PegContact; got one by PointContact"):
        vb.PegContact((0.02, 0, 0), Z, start=touched)
    pushed = vb.deflect(parabola, vb.PegContact((0.02, 0.004, 0), Z, 1e-3, side=(0, 1, 0)))
    with pytest.raises(ValueError, match="either side or start"):
        vb.PegContact((0.02, 0, 0), Z, 1e-3, side=(0, 1, 0), start=pushed)
    with pytest.raises(ValueError, match="another whisker"):
        vb.deflect(straight, vb.PegContact((0.02, 0, 0), Z, 1e-3, start=pushed))


def test_deflect_takes_loads_only(parabola):
    with pytest.raises(ValueError, match=r"a PointForce, a PointContact or a PegContact; got list"):
        vb.deflect(parabola, [0.02, 0.0, 0.0])


@pytest.mark.parametrize("proximal", [0.0, 1.0, -0.3])
def test_the_proximal_limit_lies_on_the_whisker(parabola, proximal):
    with pytest.raises(ValueError, match=f"{proximal} L; it must be"):
        vb.deflect(parabola, vb.PointContact([0.02, 0.005, 0.0]), proximal=proximal)


# What is no error: a load without an answer is a row with a status.


def test_forces_beyond_the_tip_and_missing_forces_are_rows(parabola):
    s = parabola.length * np.array([0.5, 1.0, 1.0 + 1e-12, 1.01, np.nan])
    bent = vb.deflect(parabola, vb.PointForce(s, 1e-7, 0.0))
    ok, beyond, missing = vb.Status.OK, vb.Status.BEYOND_TIP, vb.Status.MISSING
    np.testing.assert_array_equal(bent.status, [ok, ok, ok, beyond, missing])
    assert np.isfinite(bent.force[:3]).all()
    assert np.isnan(bent.force[3:]).all()
    nothing = vb.deflect(parabola, vb.PointForce(0.02, components=(0.0, np.nan, 0.0)))
    assert nothing.status == missing


def test_a_force_beyond_all_bounds_is_a_row(parabola):
    bent = vb.deflect(parabola, vb.PointForce(0.03, [1e-6, 1e3], 0.0))
    assert bent.status[0] == vb.Status.OK
    assert bent.status[1] == vb.Status.TOO_STRONG


def test_loads_stay_as_they_were_given(parabola):
    """Changing an array after it was handed over changes no load."""
    point = np.array([0.02, 0.005, 0.0])
    load = vb.PointContact(point)
    before = vb.deflect(parabola, load).force
    point[:] = 0.0
    np.testing.assert_array_equal(vb.deflect(parabola, load).force, before)


# Input that no measurement has, but that a file may.


@pytest.mark.parametrize("far", [1e10, 1e155, 1e300, 1.7e308])
def test_a_point_at_the_end_of_the_world_is_out_of_reach(gamma, far):
    points = gamma.position(np.array([0.5, 0.5, 0.7]) * gamma.length)
    points[1] = [far, -far, far]
    status = vb.deflect(gamma, vb.PointContact(points)).status
    assert status[0] == status[2] == vb.Status.OK
    assert status[1] in (vb.Status.BEYOND_FOLD, vb.Status.BEYOND_TIP)


@pytest.mark.parametrize("far", [1e155, 1e300])
def test_pegs_of_any_size_have_a_status(gamma, far):
    load = vb.PegContact([[far, 0, 0], [0.02, far, 0], [0.02, 0.005, far]], [0, 0, far])
    reasons = (vb.Status.NO_CONTACT, vb.Status.BEYOND_FOLD, vb.Status.BEYOND_TIP)
    assert np.isin(vb.deflect(gamma, load).status[:2], reasons).all()
    short = vb.PegContact([0.02, 0.005, 0.0], [0, 0, 1 / far], side=[0, 1 / far, 0])
    same = vb.PegContact([0.02, 0.005, 0.0], [0, 0, 1], side=[0, 1, 0])
    np.testing.assert_array_equal(vb.deflect(gamma, short).force, vb.deflect(gamma, same).force)


def test_what_is_masked_is_missing(gamma):
    points = np.stack([gamma.position(0.6 * gamma.length)] * 3)
    hidden = np.zeros((3, 3), dtype=bool)
    hidden[1], hidden[2, 1] = True, True
    ok, missing = vb.Status.OK, vb.Status.MISSING
    bent = vb.deflect(gamma, vb.PointContact(np.ma.masked_array(points, hidden)))
    np.testing.assert_array_equal(bent.status, [ok, missing, missing])
    force = np.ma.masked_array([1e-6, 1e-6], [False, True])
    bent = vb.deflect(gamma, vb.PointForce(0.5 * gamma.length, force, 0.0))
    np.testing.assert_array_equal(bent.status, [ok, missing])


@pytest.mark.parametrize(
    "points",
    [
        np.ones(3, dtype=complex),
        np.array(["1", "2", "3"]),
        np.array(["2026-01-01"] * 3, dtype="M8[s]"),
        [True, False, True],
        [10**400, 0, 0],
    ],
)
def test_what_is_no_number_is_refused(points):
    with pytest.raises(ValueError, match="points must be numbers; got"):
        vb.PointContact(points)


@pytest.mark.parametrize("steps", [3, -1, 36.5, 10**9, np.nan])
def test_steps_are_a_whole_number_within_bounds(gamma, steps):
    with pytest.raises(ValueError, match="whole number from 4 to"):
        vb.deflect(gamma, vb.PointForce(0.02, 1e-6, 0.0), steps=steps)


@pytest.mark.parametrize(("ratio", "bend"), [(262.0, 0.5), (976.0, 2.0), (1e4, 1.0)])
def test_needles_are_touched_like_other_whiskers(ratio, bend):
    """So thin at the tip that its fold is beyond what can be integrated."""
    curvature = np.array([0.0, 0.0, bend]) / 0.04
    whisker = vb.Whisker.from_curvature(
        0.04, lambda s: curvature + 0.0 * np.asarray(s)[..., None], tip_radius=100e-6 / ratio
    )
    s = np.linspace(0.31, 0.99, 20) * whisker.length
    points = whisker.position(s) + 1e-6 * whisker.frame(s)[:, :, 1]
    bent = vb.deflect(whisker, vb.PointContact(points))
    np.testing.assert_array_equal(bent.status, vb.Status.OK)
    np.testing.assert_allclose(bent.arc_length, s, rtol=0, atol=2e-6)
