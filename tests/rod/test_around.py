"""Several contacts at once, against closed forms, other solvers and an independent integration."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import vibrissa as vb
from vibrissa.objects import Peg, Placement, Plane, Sphere
from vibrissa.rod import discretize
from vibrissa.rod.obstacles import Grid, Obstacles, solve_with_moving_nodes, strain_under_force

LENGTH = 0.1
AT_ORIGIN = Placement(np.eye(3), np.zeros(3))


@pytest.fixture(scope="module")
def wire():
    """A curved wire that tapers a little."""
    return vb.Whisker.from_curvature(
        LENGTH, lambda s: [0.0, 0.0, 8.0], base_radius=2e-4, tip_radius=1e-4
    )


def outward(whisker, force, moment, contacts):
    """Places of contacts and what is left of force and moment at the tip, in space."""
    stiffness = whisker.base_bending_stiffness

    def rates(s, y):
        turn = Rotation.from_quat(y[3:7])
        tangent = turn.apply([1.0, 0.0, 0.0])
        inner = turn.inv().apply(y[10:])
        soft = (whisker.radius(s) / whisker.base_radius) ** -4.0 / stiffness
        u = whisker.curvature(s) + soft * inner * [1.0 + whisker.poisson_ratio, 1.0, 1.0]
        x, w = y[3:6], y[6]
        spin = 0.5 * np.r_[w * u + np.cross(x, u), -x @ u]
        return np.r_[tangent, spin, np.zeros(3), -np.cross(tangent, y[7:10])]

    y, here, places = np.r_[np.zeros(6), 1.0, force, moment], 0.0, []
    for s, push in [*contacts, (whisker.length, np.zeros(3))]:
        if s > here:
            y = solve_ivp(rates, (here, s), y, "DOP853", rtol=1e-11, atol=1e-14).y[:, -1]
        places.append(y[:3])
        y = np.r_[y[:7], y[7:10] - push, y[10:]]
        here = s
    return np.array(places[:-1]), y[7:10], y[10:]


def test_an_arc_has_the_closed_form():
    # Uniform, of curvature 2 - 1.2 s: from s = 0.5 to 0.8, where that is the peg's, it lies on the
    # peg. There the moment is the difference of curvatures, the shear its slope.
    inner, outer, jump = 0.5, 0.8, 1.0
    intrinsic = np.poly1d([-1.2, 2.0])
    bend = intrinsic(outer)
    n = np.array([bend * (intrinsic(inner) - bend), -1.2 - jump])

    def rates(s, y):
        across = np.cos(y[0]) * n[1] - np.sin(y[0]) * n[0]
        return [intrinsic(s) + y[3], np.cos(y[0]), np.sin(y[0]), -across]

    start = [0.0, 0.0, 0.0, bend - intrinsic(inner)]
    angle, x, y, moment = solve_ivp(rates, (inner, 0.0), start, rtol=1e-11, atol=1e-13).y[:, -1]
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    centre, force = turn @ ([0.0, 1.0 / bend] - np.array([x, y])), turn @ n

    whisker = vb.Whisker.from_curvature(
        LENGTH,
        lambda s: [0.0, 0.0, intrinsic(s / LENGTH) / LENGTH],
        base_radius=1e-4,
        tip_radius=1e-4,
    )
    peg = Peg([*centre * LENGTH, 0.0], [0.0, 0.0, 1.0], LENGTH / bend - 1e-4)
    bent = vb.deflect_around(whisker, peg)
    d = discretize(whisker)
    np.testing.assert_allclose(bent.force[0] / d.force, [*force, 0.0], atol=2e-5)
    np.testing.assert_allclose(bent.moment[0] / d.moment, [0.0, 0.0, moment], atol=1e-5)
    s = bent.arc_length[0] / LENGTH
    assert s[0] == pytest.approx(inner, abs=0.02)
    assert np.nanmax(s) == pytest.approx(outer, abs=0.02)
    push = np.linalg.norm(bent.contact_force[0], axis=1) / d.force
    assert push[0] == pytest.approx(jump, abs=0.01)
    assert np.nansum(push[s > 0.75]) == pytest.approx(1.2, abs=0.02)


@pytest.mark.parametrize("base_stiffness", [None, (0.05, 0.05)])
def test_one_contact_is_that_of_a_peg(base_stiffness):
    whisker = vb.Whisker.parabola(40e-3, 10.0, tip_radius=1e-4, base_stiffness=base_stiffness)
    d, grid = discretize(whisker), Grid.of(whisker)
    for radius, depth in ((1.35e-3, 0.8e-3), (10e-3, 3e-3)):
        place = whisker.position(np.array([0.0, 24e-3]))[1] + [0.0, depth - radius, 0.0]
        axis = [0.2, 0.0, 1.0]
        exact = vb.deflect(whisker, vb.PegContact(place, axis, radius, side=[0.0, 1.0, 0.0]))
        arc, point = float(exact.arc_length) / d.length, exact.contact_point / d.length
        strain = strain_under_force(grid, arc, exact.force / d.force, point)
        pressing = np.zeros((1, grid.s.size))
        found = solve_with_moving_nodes(
            whisker,
            Obstacles([Peg(place, axis, radius)], AT_ORIGIN, d.length),
            grid,
            strain,
            pressing,
        )
        s, _, places, push = found.contacts()
        assert s == pytest.approx([arc], abs=1e-5)
        np.testing.assert_allclose(places[0], point, atol=1e-5)
        np.testing.assert_allclose(
            push[0] * d.force, exact.force, atol=3e-5 * np.linalg.norm(exact.force)
        )


OBSTACLES = {
    "tip and side of a large peg": Peg([0.055, 0.135, 0.0], [0.3, 0.0, 1.0], 0.14),
    "a wall": Plane([0.0, 0.0045, 0.0], [0.05, -1.0, 0.1]),
    "a ball": Sphere([0.05, 0.136, 0.03], 0.14),
    "two pegs": [
        Peg([0.05, 0.001, 0.0], [0.1, 0.0, 1.0], 0.012),
        Peg([0.08, 0.044, 0.0], [0.0, 0.2, 1.0], 0.003),
    ],
}


@pytest.mark.parametrize("name", OBSTACLES)
def test_it_is_in_equilibrium_and_outside(wire, name):
    objects = OBSTACLES[name]
    if name == "a wall":
        wire = vb.Whisker.parabola(40e-3, 10.0)
    solids = objects if isinstance(objects, list) else [objects]
    bent = vb.deflect_around(wire, objects)
    kept = np.isfinite(bent.arc_length[0])
    assert bent.status[0] == vb.Status.OK
    assert repr(bent) == "<ObstacleDeflection at 1 placements: ok 1>"
    assert kept.sum() > 1
    assert bent.second_contact[0]
    s, push = bent.arc_length[0, kept], bent.contact_force[0, kept]
    places, force, moment = outward(
        wire, bent.force[0], bent.moment[0], list(zip(s, push, strict=True))
    )
    np.testing.assert_allclose(places, bent.contact_point[0, kept], atol=1e-5 * wire.length)
    assert np.abs(force).max() < 1e-12
    assert np.linalg.norm(moment) < 1e-4 * np.linalg.norm(bent.moment[0])
    for point, f, which, arc in zip(places, push, bent.surface[0, kept], s, strict=True):
        distance, normal, _ = solids[which].local_geometry(point)
        assert distance == pytest.approx(wire.radius(arc), abs=1e-5 * wire.length)
        assert f @ normal == pytest.approx(np.linalg.norm(f), rel=1e-6)
    line, radius = bent.centerline(201)[0], wire.radius(np.linspace(0.0, wire.length, 201))
    clear = min((solid.signed_distance(line) - radius)[10:].min() for solid in solids)
    assert clear > -1e-5 * wire.length


def test_the_thick_side_of_a_step_rests_on_a_pipe():
    radii = [(0.0, 3e-4), (0.06, 3e-4), (0.06, 1.5e-4), (LENGTH, 1.5e-4)]
    wire = vb.Whisker.from_curvature(LENGTH, lambda s: [0.0, 0.0, 8.0], radius=radii)
    pipe = Peg([0.055, 0.139, 0.0], [0.0, 0.0, 1.0], radius=0.14)
    bent = vb.deflect_around(wire, pipe)
    assert bent.status[0] == vb.Status.OK
    assert bent.second_contact[0]
    s = np.linspace(0.0, wire.length, 2001)
    thick = np.maximum(wire.radius(s), wire.radius(s, side="left"))
    gap = pipe.signed_distance(bent.centerline(2001)[0]) - thick
    assert gap[s > 0.1 * wire.length].min() > -1e-5 * wire.length


def test_it_goes_on_from_placement_to_placement(wire):
    peg = Peg([0.055, 0.14, 0.0], [0.3, 0.0, 1.0], 0.14)
    depth = np.linspace(-2e-3, 5e-3, 8)
    way = np.outer(depth, [0.0, 1.0, 0.0])
    bent = vb.deflect_around(wire, peg, base_position=way)
    alone = vb.deflect_around(wire, peg, base_position=way[-1])
    assert bent.several[-1]
    np.testing.assert_allclose(bent.force[-1], alone.force[0], rtol=1e-3, atol=1e-6)
    assert (np.diff(np.linalg.norm(bent.force, axis=1)) > 0.0).all()


def test_where_objects_push_a_rod_free_one_contact_is_all_that_is_stated():
    """The far peg holds the rod until it meets the near one, too; together they let it go."""
    rod = vb.Whisker.straight(0.2, base_radius=0.5e-3, tip_radius=0.25e-3, youngs_modulus=120e9)
    pegs = [
        Peg([0.15243439, 0.008, 0.0], [0.0, 0.0, 1.0], 1.5e-3),
        Peg([0.07567826, 0.01818337, 0.0], [0.1, 0.0, 1.0], 2e-3),
    ]
    time = np.linspace(0.0, 0.6, 13)[:, None]
    turns = Rotation.from_rotvec(0.44613 * time * [0.0, 0.0, 1.0]).as_matrix()
    way = [0.0, 0.0, -0.02] - 0.069605 * time * [1.0, 0.0, 0.0]
    bent = vb.deflect_around(rod, pegs, base_rotation=turns, base_position=way)
    assert bent.second_contact[-1]
    assert not bent.several[-1]
    assert np.isfinite(bent.arc_length[-1]).sum() == 1
    assert bent.overlap[-1] > 0.0


def test_bad_input_is_refused(wire):
    soft = Sphere([0.05, 0.0, 0.0], 0.01, stiffness=10.0)
    with pytest.raises(ValueError, match="rigid objects only; got Sphere"):
        vb.deflect_around(wire, soft)
    with pytest.raises(ValueError, match="2 rotations and 3 positions"):
        vb.deflect_around(
            wire, OBSTACLES["a wall"], np.tile(np.eye(3), (2, 1, 1)), np.zeros((3, 3))
        )
    with pytest.raises(ValueError, match=r"rotation matrices, .* got shape \(3,\)"):
        vb.deflect_around(wire, OBSTACLES["a wall"], np.zeros(3))
