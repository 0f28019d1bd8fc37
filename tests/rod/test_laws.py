"""Laws that every deflection by a known force obeys."""

from threading import get_ident

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import vibrissa as vb
from vibrissa.numerics import on_one_core, share_out
from vibrissa.rod import discretize, shapes, solve_forces

few = settings(max_examples=8)


def sizes(v):
    return np.linalg.norm(v, axis=-1)


def agree(found, expected, share):
    """Vectors agree within a share of their size."""
    assert (sizes(found - expected) <= share * sizes(expected)).all()


def steps_ends(whisker, n=12):
    """Arc lengths (over L) at which steps of the integration end, and their neighbours."""
    start = discretize(whisker).rod.start
    ends = start[start > 0.3][:: max(1, (start > 0.3).sum() // n)][:n]
    return np.concatenate([ends, np.nextafter(ends, 0.0), np.nextafter(ends, 1.0)])


@few
@given(data=st.data())
def test_the_moment_is_normal_to_the_force_and_the_force_keeps_its_size(whisker, loads, data):
    load = data.draw(loads).on(whisker)
    size = sizes(load.components)
    # By default to 1e-4 at the fold, where the tangent has turned by more than a right angle.
    np.testing.assert_allclose(sizes(vb.deflect(whisker, load).force), size, rtol=1e-4, atol=0)
    bent = vb.deflect(whisker, load, steps=144)
    np.testing.assert_allclose(sizes(bent.force), size, rtol=1e-7, atol=0)
    dot = np.einsum("ni,ni->n", bent.moment, bent.force)
    assert (np.abs(dot) <= 1e-13 * sizes(bent.moment) * size).all()


@few
@given(data=st.data())
def test_without_friction_the_force_is_normal_to_the_bent_whisker(whisker, loads, data):
    """The tangent comes from the bent shape, integrated from the base outward."""
    load = data.draw(loads).on(whisker)
    bent = vb.deflect(whisker, load, steps=144)
    d = discretize(whisker, 144)
    values = np.concatenate([bent.force / d.force, bent.contact_point / d.length], axis=1)
    nearby = 1e-6
    for i, s in enumerate(bent.arc_length / d.length):
        behind, here = shapes(d, values[i : i + 1], np.array([s]), np.array([s - nearby, s]))[0]
        np.testing.assert_allclose(here, values[i, 3:], rtol=0, atol=1e-8)
        # A chord this short is the tangent up to half its turning: the whisker's curvature here.
        turning = 4.0 * nearby
        assert abs((here - behind) @ bent.force[i]) <= turning * nearby * sizes(bent.force[i])


@few
@given(data=st.data())
def test_a_planar_whisker_bends_in_mirror_images(parabola, loads, data):
    load = data.draw(loads).on(parabola)
    mirror = np.array([1.0, 1.0, -1.0])
    bent = vb.deflect(parabola, load)
    image = vb.deflect(
        parabola, vb.PointForce(load.arc_length, components=load.components * mirror)
    )
    for ours, theirs in (
        (bent.force * mirror, image.force),
        (bent.moment * -mirror, image.moment),
        (bent.contact_point * mirror, image.contact_point),
    ):
        agree(theirs, ours, 1e-12)


@few
@given(data=st.data(), stiffer=st.floats(1e-3, 500.0))
def test_stiffness_scales_forces_and_moves_no_shape(gamma, loads, data, stiffer):
    load = data.draw(loads).on(gamma)
    bent = vb.deflect(gamma, load)
    other = gamma.with_properties(youngs_modulus=stiffer * gamma.youngs_modulus)
    same = vb.deflect(other, vb.PointForce(load.arc_length, components=stiffer * load.components))
    np.testing.assert_allclose(same.contact_point, bent.contact_point, rtol=0, atol=1e-12 * 0.04)
    agree(same.force, stiffer * bent.force, 1e-10)
    agree(same.moment, stiffer * bent.moment, 1e-10)


@few
@given(data=st.data(), longer=st.floats(0.1, 10.0), thicker=st.floats(0.3, 3.0))
def test_forces_scale_with_the_fourth_power_of_the_radius(gamma, loads, data, longer, thicker):
    """EI / L² is the only scale of force: radius⁴ / length²."""
    load = data.draw(loads).on(gamma)
    bent = vb.deflect(gamma, load)
    scale = thicker**4 / longer**2
    other = gamma.scaled(length_factor=longer, radius_factor=thicker)
    same = vb.deflect(
        other, vb.PointForce(longer * load.arc_length, components=scale * load.components)
    )
    point = longer * bent.contact_point
    np.testing.assert_allclose(same.contact_point, point, rtol=0, atol=1e-11 * other.length)
    agree(same.force, scale * bent.force, 1e-9)
    agree(same.moment, scale * longer * bent.moment, 1e-9)


@few
@given(data=st.data(), kept=st.floats(0.75, 0.99))
def test_what_lies_beyond_the_contact_does_not_matter(gamma, loads, data, kept):
    drawn = data.draw(loads)
    s = np.minimum(drawn.s, kept) * gamma.length
    force = drawn.forces(gamma, most=0.7)
    bent = vb.deflect(gamma, vb.PointForce(s, force, drawn.bearing), steps=144)
    cut = gamma.trimmed(kept * gamma.length)
    same = vb.deflect(cut, vb.PointForce(s, force, drawn.bearing), steps=144)
    np.testing.assert_allclose(same.contact_point, bent.contact_point, rtol=0, atol=1e-9 * 0.04)
    agree(same.force, bent.force, 1e-8)


@pytest.mark.parametrize("base", [None, (2e-6, 3e-6)], ids=["rigid", "compliant"])
@settings(max_examples=5)
@given(data=st.data())
def test_tangents_are_derivatives(gamma, loads, data, base):
    """∂(F, p)/∂(s, f_y, f_z) against central differences, clamped or on a soft base."""
    whisker = gamma.with_properties(base_stiffness=base)
    d = discretize(whisker, 144)
    load = data.draw(loads).on(whisker, most=0.6)
    contacts = np.concatenate(
        [load.arc_length[:, None] / d.length, load.components / d.force], axis=1
    )
    step = 2e-6
    # Not across the tip, nor across the kink of this whisker's curvature.
    contacts[:, 0] = np.minimum(contacts[:, 0], 1.0 - step)
    contacts[np.abs(contacts[:, 0] - 0.5) < step, 0] += 2.0 * step
    tangents = solve_forces(d, contacts, tangents=True)[1]
    for j, column in enumerate((0, 2, 3)):
        ahead, behind = contacts.copy(), contacts.copy()
        ahead[:, column] += step
        behind[:, column] -= step
        slope = (solve_forces(d, ahead)[0] - solve_forces(d, behind)[0]) / (2.0 * step)
        largest = np.abs(tangents[:, :, j]).max(axis=1, keepdims=True)
        assert (np.abs(tangents[:, :, j] - slope) <= 1e-6 * np.maximum(1.0, largest)).all()


def test_nothing_happens_where_steps_of_the_integration_meet(parabola):
    d = discretize(parabola)
    s = steps_ends(parabola)
    contacts = np.stack([s, 0.0 * s, 0.2 * (1.0 - s), 0.1 * (1.0 - s)], axis=-1)
    step = 1e-5
    values, tangents = solve_forces(d, contacts, tangents=True)
    ahead, behind = contacts.copy(), contacts.copy()
    ahead[:, 0] += step
    behind[:, 0] -= step
    after, before = solve_forces(d, ahead)[0], solve_forces(d, behind)[0]
    np.testing.assert_allclose(0.5 * (before + after), values, rtol=0, atol=1e-9)
    np.testing.assert_allclose(tangents[:, :, 0], (after - before) / (2 * step), rtol=0, atol=1e-6)


# A base that gives way.


def soft(whisker, factor):
    """The same whisker on a base ``factor`` times as stiff as itself (EI / L)."""
    stiffness = factor * whisker.base_bending_stiffness / whisker.length
    return whisker.with_properties(base_stiffness=(stiffness, 0.7 * stiffness))


@pytest.mark.filterwarnings("ignore:base_stiffness is")
@few
@given(data=st.data())
def test_a_stiffer_base_comes_ever_nearer_to_a_clamp(gamma, loads, data):
    load = data.draw(loads).on(gamma)
    clamped = vb.deflect(gamma, load).contact_point
    apart = [
        sizes(vb.deflect(soft(gamma, factor), load).contact_point - clamped).max() / gamma.length
        for factor in (1e3, 1e6, 1e9)
    ]
    assert apart[0] < 0.1
    assert apart[1] < 2e-3 * apart[0] + 1e-14
    assert apart[2] < 1e-8


@few
@given(data=st.data())
def test_a_soft_base_turns_by_moment_over_stiffness(gamma, loads, data):
    """For small loads: bending about y and z by M / k, twist by M_x / k_twist."""
    tiny = 1e-6
    load = data.draw(loads).on(gamma, most=tiny)
    base = soft(gamma, 1.0)
    clamped, bent = vb.deflect(gamma, load), vb.deflect(base, load)
    bending, twist = base.base_stiffness
    turn = clamped.moment / np.array([twist, bending, bending])
    moved = np.cross(turn, clamped.contact_point)
    assert (
        sizes(bent.contact_point - clamped.contact_point - moved)
        <= 1e-3 * sizes(moved) + 1e-13 * gamma.length
    ).all()
    # The base itself stays where it is, and the bent whisker leaves it at that angle.
    line = bent.centerline(1001)
    np.testing.assert_array_equal(line[:, 0], 0.0)
    slope = (line[:, 1] - clamped.centerline(1001)[:, 1]) / (gamma.length / 1000)
    expected = np.cross(turn, [1.0, 0.0, 0.0])
    assert (sizes(slope - expected) <= 1e-2 * sizes(turn) + 1e-10).all()


# How it is computed does not matter.


def many_loads(whisker, n=3000):
    rng = np.random.default_rng(5)
    s = rng.uniform(0.3, 1.0, n) * whisker.length
    strength = 0.3 * discretize(whisker).force
    return vb.PointForce(s, strength * rng.uniform(0, 1, n), rng.uniform(-np.pi, np.pi, n))


@pytest.mark.parametrize("threads", ["many", "0", "1.5"])
def test_a_number_of_cores_is_needed(gamma, monkeypatch, threads):
    monkeypatch.setenv("VIBRISSA_THREADS", threads)
    with pytest.raises(ValueError, match=f"VIBRISSA_THREADS is '{threads}'"):
        vb.deflect(gamma, many_loads(gamma))


def test_one_thread_and_many_agree_to_the_bit(gamma, monkeypatch):
    load = many_loads(gamma)
    results = []
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("VIBRISSA_THREADS", threads)
        forces = vb.deflect(gamma, load)
        points = vb.deflect(gamma, vb.PointContact(forces.contact_point))
        results.append((forces.force, forces.moment, points.force, points.status))
    for other in results[1:]:
        for ours, theirs in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_a_task_on_one_core_stays_in_its_thread(monkeypatch):
    monkeypatch.setenv("VIBRISSA_THREADS", "2")
    parts = []
    note = on_one_core(lambda: share_out(1000, lambda *part: parts.append((*part, get_ident()))))
    note()
    assert parts == [(0, 1000, get_ident())]
    share_out(1000, lambda *part: parts.append(part))
    assert len(parts) > 2


def test_a_load_does_not_depend_on_its_company(gamma):
    load = many_loads(gamma, 9)
    together = vb.deflect(gamma, load)
    for i in range(9):
        alone = vb.deflect(gamma, vb.PointForce(load.arc_length[i], components=load.components[i]))
        np.testing.assert_array_equal(alone.force, together.force[i])
        np.testing.assert_array_equal(alone.contact_point, together.contact_point[i])
        point = vb.deflect(gamma, vb.PointContact(together.contact_point[i]))
        same = vb.deflect(gamma, vb.PointContact(together.contact_point))
        np.testing.assert_allclose(point.force, same.force[i], rtol=1e-9, atol=1e-20)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (0,), (2, 0)])
def test_results_have_the_shape_of_the_loads(gamma, shape):
    s = np.full(shape, 0.6 * gamma.length)
    bent = vb.deflect(gamma, vb.PointForce(s, 1e-6, 0.3))
    for name in ("force", "moment", "contact_point", "contact_force"):
        assert getattr(bent, name).shape == (*shape, 3)
    for name in ("arc_length", "residual", "status"):
        assert getattr(bent, name).shape == shape
    assert bent.centerline(7).shape == (*shape, 7, 3)
    again = vb.deflect(gamma, vb.PointContact(bent.contact_point))
    assert again.status.shape == shape
    assert (again.status == vb.Status.OK).all()


def test_loads_broadcast(gamma):
    s = np.array([[0.5], [0.8]]) * gamma.length
    angle = np.array([0.0, 1.0, 2.0])
    bent = vb.deflect(gamma, vb.PointForce(s, 1e-6, angle))
    assert bent.force.shape == (2, 3, 3)
    one = vb.deflect(gamma, vb.PointForce(s[1, 0], 1e-6, angle[2]))
    np.testing.assert_array_equal(bent.force[1, 2], one.force)


def test_a_contact_by_itself_has_the_tangents_that_it_has_among_others(gamma):
    d, rng = discretize(gamma), np.random.default_rng(11)
    x = np.column_stack([rng.uniform(0.3, 1.0, 9), rng.normal(size=(9, 3)) * [0.0, 0.3, 0.3]])
    values, tangents = solve_forces(d, x, tangents=True)
    for row in range(9):
        one, by_itself = solve_forces(d, x[row : row + 1], tangents=True)
        np.testing.assert_array_equal(one[0], values[row])
        np.testing.assert_array_equal(by_itself[0], tangents[row])
