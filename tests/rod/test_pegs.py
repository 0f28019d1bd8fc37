"""Contact with pegs: lines, cylinders, sides, the tip, and pegs that move."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import vibrissa as vb
from vibrissa.rod import contact_tangents, discretize, fold_forces, solve_forces, stable_set

few = settings(max_examples=8)
OK, TIP, FREE = vb.Status.OK, vb.Status.TIP_CONTACT, vb.Status.NO_CONTACT
Z = np.array([0.0, 0.0, 1.0])


def sizes(v):
    return np.linalg.norm(v, axis=-1)


def across(v, axis):
    """Part of vectors normal to an axis."""
    unit = axis / sizes(axis)[..., None]
    return v - np.einsum("...i,...i->...", v, unit)[..., None] * unit


def tangent(bent):
    """Direction of the bent whisker just before the contact, from its shape."""
    n = 4001
    rows = np.flatnonzero(np.isfinite(bent.arc_length))
    line = bent.centerline(n)[rows]
    s = np.linspace(0.0, bent.whisker.length, n)
    here = np.searchsorted(s, bent.arc_length[rows] * (1.0 - 1e-12))
    found = np.full((*bent.arc_length.shape, 3), np.nan)
    chord = line[np.arange(rows.size), here] - line[np.arange(rows.size), here - 1]
    found[rows] = chord / sizes(chord)[:, None]
    return found


# A peg without thickness.


@few
@given(data=st.data(), tilt=st.floats(-1.0, 1.0))
def test_a_line_through_a_contact_holds_it_if_the_force_is_normal_to_it(gamma, loads, data, tilt):
    """The point's contact is the line's, if the line leaves the force no way to slide along it."""
    load = data.draw(loads).on(gamma, most=0.2)
    # A touch less deep than 1e-6 L is none, and on the very tip the tangent is free.
    touched = sizes(load.components) > 1e-3 * discretize(gamma).force
    touched &= load.arc_length < 0.999 * gamma.length
    load = vb.PointForce(load.arc_length[touched], components=load.components[touched])
    pushed = vb.deflect(gamma, load)
    along = across(tangent(pushed), pushed.force)
    sideways = np.cross(pushed.force, along)
    axis = sideways / sizes(sideways)[:, None] + np.sin(tilt) * along
    held = vb.deflect(
        gamma, vb.PegContact(pushed.contact_point - 0.01 * axis, axis, side=pushed.force)
    )
    np.testing.assert_array_equal(held.status, OK)
    np.testing.assert_allclose(held.arc_length, pushed.arc_length, rtol=0, atol=1e-8 * 0.04)
    assert (sizes(held.force - pushed.force) <= 1e-6 * sizes(pushed.force)).all()
    axis /= sizes(axis)[:, None]
    assert (np.abs(np.einsum("ni,ni->n", held.force, axis)) <= 1e-9 * sizes(held.force)).all()
    assert (sizes(across(held.contact_point - pushed.contact_point, axis)) <= 1e-10 * 0.04).all()


def test_a_line_near_the_tip_holds_the_bent_whisker(whisker):
    """Moved along its force it would pass by the tip of the resting whisker, without a touch."""
    d, rng = discretize(whisker), np.random.default_rng(17)
    n = 300
    s, bearing = rng.uniform(0.97, 0.999, n), rng.uniform(-np.pi, np.pi, n)
    contacts = np.stack([s, 0.0 * s, np.cos(bearing), np.sin(bearing)], axis=-1)
    share = rng.uniform(0.02, 0.2, n) * fold_forces(
        stable_set(whisker).fold, contacts[:, [0, 2, 3]]
    )
    contacts[:, 2:] *= share[:, None]
    pushed = vb.deflect(whisker, vb.PointForce(s * d.length, share * d.force, bearing))
    along = contact_tangents(d, contacts)
    axis = np.cross(pushed.force / sizes(pushed.force)[:, None], along)
    axis += rng.uniform(-0.8, 0.8, (n, 1)) * along
    held = vb.deflect(whisker, vb.PegContact(pushed.contact_point, axis, side=pushed.force))
    np.testing.assert_array_equal(held.status, OK)
    np.testing.assert_allclose(held.arc_length, pushed.arc_length, rtol=0, atol=1e-8 * d.length)
    assert (sizes(held.force - pushed.force) <= 1e-6 * sizes(pushed.force)).all()


def test_a_line_beyond_the_tip_holds_nothing(whisker):
    frame, tip = whisker.frame(whisker.length), whisker.position(whisker.length)
    beyond = tip + np.array([[1e-5], [1e-3], [1e-2]]) * frame[:, 0]
    for axis, side in ((frame[:, 2], frame[:, 1]), (frame[:, 1], frame[:, 2])):
        for push in (side, -side):
            bent = vb.deflect(whisker, vb.PegContact(beyond, axis, side=push))
            np.testing.assert_array_equal(bent.status, FREE)


def test_a_line_folds_at_half_the_force_at_which_a_point_does(straight):
    """A straight whisker at 0.35 L against a vertical line: free to slide along it, it slips early.

    The fold of each is the zero of its own Jacobian: ∂p/∂ξ for the point, ∂(p_x, p_y, F_z)/∂ξ for
    the line.
    """
    d = discretize(straight)
    share = np.linspace(0.0, 40.0, 4001)
    contacts = np.stack([0.35 + 0 * share, 0 * share, share, 0 * share], axis=-1)
    values, tangents = solve_forces(d, contacts, tangents=True)
    point = np.linalg.det(tangents[:, 3:])
    line = np.linalg.det(tangents[:, [3, 4, 2]])
    point_fold = np.flatnonzero(np.sign(point) != np.sign(point[0]))[0]
    line_fold = np.flatnonzero(np.sign(line) != np.sign(line[0]))[0]
    assert share[line_fold] / share[point_fold] == pytest.approx(0.56, abs=0.01)

    places = values[:, 3:] * d.length
    before, after = int(0.99 * line_fold), int(1.01 * line_fold)
    held = vb.deflect(straight, vb.PegContact(places[before], Z, side=[0, 1, 0]))
    assert held.status == OK
    np.testing.assert_allclose(held.contact_force[1] / d.force, share[before], rtol=1e-6)
    # The same place is held by the line with another contact, or with none ...
    slipped = vb.deflect(straight, vb.PegContact(places[after], Z, side=[0, 1, 0]))
    assert slipped.status == vb.Status.BEYOND_FOLD or slipped.arc_length < 0.35 * d.length
    # ... while the point holds it up to its own fold.
    rows = [before, after, int(0.99 * point_fold)]
    held = vb.deflect(straight, vb.PointContact(places[rows]))
    np.testing.assert_array_equal(held.status, OK)
    np.testing.assert_allclose(held.contact_force[:, 1] / d.force, share[rows], rtol=1e-5)


# A solid peg.


@pytest.fixture(scope="module")
def pegs(parabola):
    """Pegs of many directions, pushed up to 8 mm into the resting whisker from all sides."""
    rng = np.random.default_rng(11)
    n = 300
    s = rng.uniform(0.4, 0.9, n) * parabola.length
    bearing = rng.uniform(-np.pi, np.pi, n)
    frame = parabola.frame(s)
    push = frame[:, :, 1] * np.cos(bearing)[:, None] + frame[:, :, 2] * np.sin(bearing)[:, None]
    lean = rng.uniform(-0.5, 0.5, (n, 1))
    axis = np.cross(frame[:, :, 0], push) + lean * frame[:, :, 0]
    radius = rng.uniform(0.2e-3, 3e-3, n)
    depth = rng.uniform(0.0, 0.2, n) * s - radius - parabola.radius(s)
    return vb.PegContact(
        parabola.position(s) + depth[:, None] * push, axis, radius=radius, side=push
    )


def test_a_solid_peg_touches_along_its_normal_a_radius_away(parabola, pegs):
    bent = vb.deflect(parabola, pegs, steps=144)
    touching = bent.status == OK
    assert touching.mean() > 0.9
    assert not (bent.status == vb.Status.NOT_CONVERGED).any()
    away = across(bent.contact_point - pegs.origin, pegs.axis)[touching]
    thick = parabola.radius(bent.arc_length[touching])
    np.testing.assert_allclose(
        sizes(away), pegs.radius[touching] + thick, rtol=0, atol=1e-10 * parabola.length
    )
    force = bent.force[touching]
    pushing = sizes(force) > 1e-9
    unit = force[pushing] / sizes(force[pushing])[:, None]
    normal = away[pushing] / sizes(away[pushing])[:, None]
    np.testing.assert_allclose(unit, normal, rtol=0, atol=1e-8)
    along = tangent(bent)[touching][pushing]
    np.testing.assert_allclose(np.einsum("ni,ni->n", along, unit), 0.0, atol=1e-3)


def test_no_point_of_the_bent_whisker_is_inside_the_peg(parabola, pegs):
    bent = vb.deflect(parabola, pegs, steps=144)
    touching = bent.status == OK
    n = 801
    line = bent.centerline(n)[touching]
    s = np.linspace(0.0, parabola.length, n)
    away = sizes(across(line - pegs.origin[touching][:, None], pegs.axis[touching][:, None]))
    gap = away - pegs.radius[touching][:, None] - parabola.radius(s)
    # It touches where the centreline is nearest; the taper of 0.1° shifts that by a hair.
    assert gap.min() > -2e-8


def test_a_peg_that_does_not_reach_the_whisker_bends_nothing(parabola):
    radius = 1e-3
    x = 0.02
    y = 10.0 * x**2
    for side, gap in ((1.0, -3e-3), (-1.0, 3e-3)):
        bent = vb.deflect(parabola, vb.PegContact([x, y + gap, 0], Z, radius, side=[0, side, 0]))
        assert bent.status == FREE
        np.testing.assert_array_equal(bent.force, 0.0)
        np.testing.assert_array_equal(bent.moment, 0.0)
        assert np.isnan(bent.arc_length)
        np.testing.assert_allclose(bent.centerline(50), parabola.centerline(50), atol=1e-8)


def test_the_side_decides_where_the_whisker_lies(parabola):
    """The same peg on the whisker's way pushes it up or down, as asked."""
    peg = np.array([0.02, 10.0 * 0.02**2, 0.0])
    up = vb.deflect(parabola, vb.PegContact(peg, Z, 1e-3, side=[0, 1, 0]))
    down = vb.deflect(parabola, vb.PegContact(peg, Z, 1e-3, side=[0, -1, 0]))
    assert up.status == down.status == OK
    assert up.force[1] > 0 > down.force[1]
    assert up.contact_point[1] > peg[1] > down.contact_point[1]
    # Not asked, a solid peg pushes out the nearest way.
    nearer = vb.deflect(parabola, vb.PegContact(peg - [0, 3e-4, 0], Z, 1e-3))
    assert nearer.force[1] > 0
    # A line pushes from where the resting whisker is nearest.
    line = vb.deflect(parabola, vb.PegContact(peg + np.array([0, 2e-3, 0]), Z))
    assert line.status == OK
    assert line.force[1] > 0


# The tip.


def tip_pegs(whisker, n=40):
    """Pegs ahead of the tip that the whisker can only touch with it, from a graze to 3 mm."""
    end, frame = whisker.position(whisker.length), whisker.frame(whisker.length)
    radius = 1.35e-3
    ahead = np.linspace(0.2, 0.95, n)[:, None] * radius
    into = np.linspace(0.02, 0.4, n)[::-1, None] * radius
    reach = radius + whisker.radius(whisker.length)
    # The axis lies ahead of the tip and to the side that is not pushed.
    below = np.sqrt(reach**2 - ahead**2) - into
    return vb.PegContact(
        end + ahead * frame[:, 0] - below * frame[:, 1],
        frame[:, 2],
        radius=radius,
        side=frame[:, 1],
    )


def test_the_tip_touches_with_the_force_normal_to_the_peg(whisker):
    pegs = tip_pegs(whisker)
    bent = vb.deflect(whisker, pegs, steps=144)
    np.testing.assert_array_equal(bent.status, TIP)
    np.testing.assert_array_equal(bent.arc_length, whisker.length)
    away = across(bent.contact_point - pegs.origin, pegs.axis)
    reach = pegs.radius + whisker.radius(whisker.length)
    np.testing.assert_allclose(sizes(away), reach, rtol=0, atol=1e-10 * whisker.length)
    unit = bent.force / sizes(bent.force)[:, None]
    np.testing.assert_allclose(unit, away / sizes(away)[:, None], rtol=0, atol=1e-8)
    # The peg lies ahead, so it pushes back: friction-like in the whisker's frame, but normal.
    assert (bent.contact_force[:, 0] <= 0.0).all()
    assert (bent.contact_force[:, 0] < 0.0).any()


# Pegs that move, frame by frame.


@pytest.fixture(scope="module")
def sweep(parabola):
    """A vertical peg of 2.7 mm moves down across the whisker, at 0.6 L, 0.8 L and 0.9 L at once."""
    x = np.array([0.6, 0.8, 0.9]) * parabola.length
    frames = np.linspace(3e-3, -25e-3, 57)
    places = np.stack(
        [x + 0 * frames[:, None], 10.0 * x**2 + frames[:, None], np.zeros((57, 3))], axis=-1
    )
    bent = [vb.deflect(parabola, vb.PegContact(places[0], Z, 1.35e-3, side=[0, -1, 0]))]
    for place in places[1:]:
        bent.append(vb.deflect(parabola, vb.PegContact(place, Z, 1.35e-3, start=bent[-1])))
    return places, bent


def test_a_moving_peg_pushes_slips_past_and_leaves_the_whisker_free(parabola, sweep):
    _, bent = sweep
    status = np.array([b.status for b in bent])
    for column in status.T:
        touching = np.isin(column, (OK, TIP))
        first, last = np.flatnonzero(touching)[[0, -1]]
        assert (column[:first] == FREE).all()
        assert touching[first : last + 1].all()
        # One frame says that the whisker slips; then it is free, on the other side.
        assert column[last + 1] in (vb.Status.BEYOND_FOLD, vb.Status.BEYOND_TIP)
        assert (column[last + 2 :] == FREE).all()
        assert last - first > 20


def test_while_it_touches_the_past_of_a_peg_does_not_matter(parabola, sweep):
    places, bent = sweep
    for place, moved in zip(places, bent, strict=True):
        rest = vb.deflect(parabola, vb.PegContact(place, Z, 1.35e-3, side=[0, -1, 0]))
        touching = np.isin(moved.status, (OK, TIP))
        np.testing.assert_array_equal(rest.status[touching], moved.status[touching])
        np.testing.assert_allclose(
            rest.force[touching], moved.force[touching], rtol=0, atol=1e-8 * 1e-4
        )


def test_after_the_slip_a_peg_coming_back_pushes_the_other_way(parabola, sweep):
    places, bent = sweep
    back = bent[-1]
    touched = np.zeros(3, bool)
    for place in places[::-1]:
        back = vb.deflect(parabola, vb.PegContact(place, Z, 1.35e-3, start=back))
        now = np.isin(back.status, (OK, TIP))
        assert (back.force[now, 1] > 0.0).all()
        touched |= now
    assert touched.all()


def test_a_free_start_keeps_the_side_even_if_the_peg_jumps_past(parabola):
    """A peg above the whisker that is next seen deep below its resting place has pushed it down."""
    place = np.array([0.025, 10.0 * 0.025**2, 0.0])
    up = np.array([0.0, 3e-3, 0.0])
    free = vb.deflect(parabola, vb.PegContact(place + up, Z, 1e-3, side=[0, -1, 0]))
    assert free.status == FREE
    bent = vb.deflect(parabola, vb.PegContact(place - up, Z, 1e-3, start=free))
    assert bent.status == OK
    assert bent.force[1] < 0


def test_pegs_of_any_shape(parabola):
    heights = np.linspace(-1e-3, 1e-3, 6).reshape(2, 3)
    places = np.stack([0.025 + 0 * heights, 10 * 0.025**2 + heights, 0 * heights], axis=-1)
    bent = vb.deflect(parabola, vb.PegContact(places, Z, 1e-3, side=[0, 1, 0]))
    assert bent.status.shape == (2, 3)
    assert bent.centerline(5).shape == (2, 3, 5, 3)
    none = vb.deflect(parabola, vb.PegContact(np.zeros((0, 3)), Z, 1e-3, side=[0, 1, 0]))
    assert none.force.shape == (0, 3)
    one = vb.deflect(parabola, vb.PegContact(places[1, 2], Z, 1e-3, side=[0, 1, 0]))
    np.testing.assert_allclose(one.force, bent.force[1, 2], rtol=1e-8, atol=1e-16)


def test_a_missing_peg_stops_nobody(parabola):
    places = np.array([[0.025, 0.006, 0], [np.nan, 0, 0], [0.03, 0.008, 0]])
    bent = vb.deflect(parabola, vb.PegContact(places, Z, 1e-3, side=[0, 1, 0]))
    np.testing.assert_array_equal(bent.status, [OK, vb.Status.MISSING, OK])
    next_frame = vb.deflect(parabola, vb.PegContact(places[::-1], Z, 1e-3, start=bent))
    assert next_frame.status[1] == vb.Status.MISSING
    assert (next_frame.status[[0, 2]] != vb.Status.MISSING).all()


@pytest.mark.filterwarnings("ignore:base_stiffness is")
def test_a_compliant_base_gives_way_to_a_peg(parabola):
    stiffness = parabola.base_bending_stiffness / parabola.length
    peg = vb.PegContact([0.025, 0.0065, 0], Z, 1e-3, side=[0, 1, 0])
    clamped = vb.deflect(parabola, peg)
    soft, stiff = (
        vb.deflect(parabola.with_properties(base_stiffness=(k * stiffness, k * stiffness)), peg)
        for k in (5.0, 1e8)
    )
    assert soft.status == stiff.status == OK
    assert sizes(soft.force) < 0.9 * sizes(clamped.force)
    np.testing.assert_allclose(stiff.force, clamped.force, rtol=0, atol=1e-6 * sizes(clamped.force))


def test_mirror_images(parabola):
    rng = np.random.default_rng(3)
    n = 60
    origin = np.stack([rng.uniform(0.015, 0.03, n), rng.uniform(0, 9e-3, n), 0 * rng.random(n)], -1)
    axis = np.stack([rng.uniform(-0.4, 0.4, n), rng.uniform(-0.4, 0.4, n), np.ones(n)], -1)
    mirror = np.array([1.0, 1.0, -1.0])
    bent = vb.deflect(parabola, vb.PegContact(origin, axis, 1e-3, side=[0, 1, 0]))
    image = vb.deflect(parabola, vb.PegContact(origin, axis * mirror, 1e-3, side=[0, 1, 0]))
    np.testing.assert_array_equal(image.status, bent.status)
    known = bent.status == OK
    assert known.mean() > 0.5
    scale = sizes(bent.force[known])[:, None] + 1e-9
    assert (np.abs(image.force[known] - mirror * bent.force[known]) <= 1e-7 * scale).all()
