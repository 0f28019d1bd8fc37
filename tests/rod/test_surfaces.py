"""Contacts with surfaces meet the geometry and the laws of friction, and agree with the pegs'."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.objects import Box, Peg, Plane, Sphere
from vibrissa.rod import contact_state, discretize, follow_surfaces
from vibrissa.simulation import whisking
from vibrissa.status import Status
from vibrissa.whisker import base_rotation

WHISKER = vb.samples.gamma()
LENGTH = WHISKER.length
TILTED = base_rotation(0.3, 0.2, -0.1)
OBJECTS = {
    "peg": Peg([0.62 * LENGTH, 0.0, 0.0], [0.1, 0.05, 1.0], 1.35e-3),
    "sphere": Sphere([0.6 * LENGTH, 0.0, 1e-3], 4e-3),
    "plane": Plane([0.0, 9e-3, 0.0], [0.0, -1.0, 0.05]),
    "box": Box([0.6 * LENGTH, 0.0, 0.0], [4e-3, 5e-3, 30e-3], TILTED),
    "rounded box": Box([0.6 * LENGTH, 0.0, 0.0], [4e-3, 5e-3, 30e-3], edge_radius=0.5e-3),
    "soft peg": Peg([0.62 * LENGTH, 0.0, 0.0], [0.0, 0.0, 1.0], 1.35e-3, stiffness=2.0),
    "soft sphere": Sphere([0.6 * LENGTH, 0.0, 1e-3], 4e-3, stiffness=5.0),
}


def sweep(name, rate=500.0):
    wide = name != "plane"
    return whisking(
        0.2,
        rate,
        amplitude=np.radians(55.0 if wide else 35.0),
        set_point=np.radians(-5.0 if wide else 0.0),
        seed=1,
    )


def followed(name, friction=0.0, **changes):
    motion = sweep(name, **changes)
    thing = OBJECTS[name]
    found = follow_surfaces(
        WHISKER, [thing], motion.base_rotation, motion.base_position, friction=friction
    )
    return motion, thing, found


def touching(found):
    return np.isin(found.bent.status, (Status.OK, Status.TIP_CONTACT))


def pressing_and_friction(motion, found):
    force = np.einsum("nij,nj->ni", motion.base_rotation, found.bent.force)
    pressing = np.einsum("ni,ni->n", force, found.normal)
    return pressing, force - pressing[:, None] * found.normal


def tangents(motion, found):
    """Of the whisker at its contacts, laboratory frame."""
    d = discretize(WHISKER)
    out = np.full((len(motion), 3), np.nan)
    state = np.empty((9, 5))
    for i in np.flatnonzero(touching(found)):
        contact = np.r_[found.bent.arc_length[i] / d.length, found.bent.contact_force[i] / d.force]
        contact_state(d.rod, contact, state)
        out[i] = motion.base_rotation[i] @ state[6:, 0]
    return out


def test_derivatives_of_the_contact_state():
    rod = discretize(WHISKER).rod
    generator = np.random.default_rng(2)
    for _ in range(5):
        contact = np.r_[generator.uniform(0.2, 0.9), 0.3 * generator.normal(size=3)]
        state, plus, minus = (np.empty((9, 5)) for _ in range(3))
        contact_state(rod, contact, state)
        for j in range(4):
            step = 1e-6 * (np.arange(4) == j)
            contact_state(rod, contact + step, plus)
            contact_state(rod, contact - step, minus)
            numeric = (plus[:, 0] - minus[:, 0]) / 2e-6
            # The integration's own error depends on where in a step the contact is.
            scale = 1.0 + np.abs(numeric).max()
            np.testing.assert_allclose(state[:, 1 + j], numeric, rtol=0, atol=2e-6 * scale)
        assert np.linalg.norm(state[6:, 0]) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("name", OBJECTS)
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_the_surfaces_touch_and_the_force_is_in_the_cone(name, friction):
    motion, thing, found = followed(name, friction)
    bent, contact = found.bent, touching(found)
    assert contact.sum() >= 6
    assert set(np.unique(bent.status)) <= {Status.OK, Status.TIP_CONTACT, Status.NO_CONTACT}
    pressing, along = (x[contact] for x in pressing_and_friction(motion, found))
    assert (pressing >= 0.0).all()
    point = np.einsum("nij,nj->ni", motion.base_rotation, bent.contact_point)
    point = (point + motion.base_position)[contact]
    gap = thing.signed_distance(point) - WHISKER.radius(bent.arc_length[contact])
    # Where the whisker passes on from one edge to another, one contact is not quite enough.
    exact = bent.residual[contact] < 1e-9
    assert (~exact).sum() <= (2 if "box" in name else 0)
    gap, pressing, along = gap[exact], pressing[exact], along[exact]
    contact[contact] = exact
    np.testing.assert_allclose(gap, -pressing / thing.stiffness, rtol=0, atol=1e-9 * LENGTH)
    size = np.linalg.norm(along, axis=1)
    assert (size <= friction * pressing + 1e-9 * pressing.max()).all()
    sliding = found.sliding[contact]
    np.testing.assert_allclose(
        size[sliding], friction * pressing[sliding], rtol=0, atol=1e-9 * pressing.max()
    )
    on = found.surface_point[contact]
    np.testing.assert_allclose(thing.signed_distance(on), 0.0, atol=1e-9)
    np.testing.assert_allclose(
        np.cross(bent.contact_point, bent.force)[contact], bent.moment[contact], rtol=1e-12
    )


@pytest.mark.parametrize("name", ["sphere", "plane", "rounded box"])
def test_the_side_lies_along_the_surface_and_the_tip_points_at_it(name):
    motion, _, found = followed(name, 0.2)
    toward = np.einsum("ni,ni->n", tangents(motion, found), found.normal)
    side = found.bent.status == Status.OK
    np.testing.assert_allclose(toward[side], 0.0, atol=1e-8)
    tip = found.bent.status == Status.TIP_CONTACT
    assert (toward[tip] <= 1e-8).all()
    assert tip.any() == (name == "plane")


@pytest.mark.parametrize("whisker", [WHISKER, vb.samples.curved_cylinder()])
def test_pegs_agree_with_the_solver_of_pegs(whisker):
    motion = whisking(0.2, 500.0, amplitude=np.radians(60.0), seed=4, frequency=6.0)
    for peg in (
        Peg([0.62 * LENGTH, 0.0, 0.0], [0.1, 0.05, 1.0], 1.35e-3),
        Peg([0.85 * LENGTH, 0.0, 0.0], [-0.1, 0.1, 1.0], 0.2e-3),
    ):
        found = follow_surfaces(whisker, [peg], motion.base_rotation, motion.base_position).bent
        turn = motion.base_rotation
        origins = np.einsum("tji,tj->ti", turn, peg.origin - motion.base_position)
        axes = peg.axis @ turn
        last = None
        for i, (origin, axis) in enumerate(zip(origins, axes, strict=True)):
            load = vb.PegContact(origin, axis, peg.radius, start=last)
            bent = vb.deflect(whisker, load)
            if bent.status in (Status.BEYOND_FOLD, Status.BEYOND_TIP):
                bent = vb.deflect(whisker, vb.PegContact(origin, axis, peg.radius))
            last = bent
            assert found.status[i] == bent.status
            if bent.status != Status.NO_CONTACT:
                scale = 1e-7 * np.nanmax(np.abs(found.force))
                np.testing.assert_allclose(found.force[i], bent.force, rtol=0, atol=scale)
                np.testing.assert_allclose(
                    found.arc_length[i], bent.arc_length, rtol=0, atol=1e-8 * LENGTH
                )


def test_little_friction_changes_little():
    _, _, without = followed("peg")
    _, _, less = followed("peg", 1e-4)
    _, _, more = followed("peg", 2e-4)
    both = touching(without) & touching(less) & touching(more)
    assert (touching(without) == touching(less)).all()
    scale = np.abs(without.bent.force[both]).max()
    one, two = (np.abs(x.bent.force - without.bent.force)[both].max() / scale for x in (less, more))
    assert two == pytest.approx(2.0 * one, rel=0.05)
    assert one < 5e-4


def slid(motion, found):
    """How far the whisker's material slid over the surface from frame to frame, (n - 1, 3)."""
    tangent = tangents(motion, found)
    point = np.einsum("nij,nj->ni", motion.base_rotation, found.bent.contact_point)
    point = point + motion.base_position
    rolled = 0.5 * (tangent[1:] + tangent[:-1]) * np.diff(found.bent.arc_length)[:, None]
    way = np.diff(point, axis=0) - rolled
    normal = found.normal[1:]
    return way - np.einsum("ni,ni->n", way, normal)[:, None] * normal


@pytest.mark.parametrize("friction", [0.1, 0.5])
def test_friction_opposes_sliding(friction):
    motion, _, found = followed("plane", friction, rate=2000.0)
    way = slid(motion, found)
    _, along = pressing_and_friction(motion, found)
    both = touching(found)[1:] & touching(found)[:-1]
    work = np.einsum("ni,ni->n", way, along[1:])
    lost = np.linalg.norm(way, axis=1) * np.linalg.norm(along[1:], axis=1)
    moving = both & found.sliding[1:] & (np.linalg.norm(way, axis=1) > 1e-6)
    assert moving.sum() > 20
    # Frames that were cut into steps turn a little between them.
    np.testing.assert_allclose(work[moving], -lost[moving], rtol=0.02)


@pytest.mark.slow
def test_strong_friction_holds_the_material_on_a_thin_peg():
    peg = Peg([0.62 * LENGTH, 0.0, 0.0], [0.0, 0.0, 1.0], 20e-6)
    turn = np.linspace(-0.6, 0.1, 141)
    rotations = base_rotation(turn, 0.0 * turn, 0.0 * turn)
    found = follow_surfaces(WHISKER, [peg], rotations, np.zeros((turn.size, 3)), friction=20.0)
    held = touching(found) & ~found.sliding
    assert held.sum() >= 20
    # It rolls on the peg by no more than that and the whisker are thick.
    assert np.ptp(found.bent.arc_length[held]) < 150e-6
    assert np.ptp(found.bent.contact_force[held, 0]) > 0.0
    point = np.einsum("nij,nj->ni", rotations, found.bent.contact_point)[held]
    assert np.ptp(point, axis=0).max() < 150e-6


def test_a_stiffer_object_gives_way_less():
    motion = sweep("peg")
    hard = followed("peg")[2]
    errors = []
    for stiffness in (1e3, 1e4):
        peg = Peg(OBJECTS["peg"].origin, OBJECTS["peg"].axis, 1.35e-3, stiffness)
        soft = follow_surfaces(WHISKER, [peg], motion.base_rotation, motion.base_position)
        both = touching(hard) & touching(soft)
        errors.append(np.abs(soft.bent.force - hard.bent.force)[both].max())
    assert errors[1] == pytest.approx(0.1 * errors[0], rel=0.1)


def test_it_passes_on_from_edge_to_edge_and_not_through_the_box():
    _, box, found = followed("rounded box", rate=1000.0)
    contact = np.flatnonzero(touching(found))
    groups = np.split(contact, np.flatnonzero(np.diff(contact) > 1) + 1)
    for group in groups:
        side = np.sign(found.surface_point[group, 1] - box.origin[1])
        assert (side == side[0]).all()
    jumps = np.abs(np.diff(found.bent.arc_length[groups[0]]))
    assert jumps.max() > 2e-3


def test_the_first_of_two_holds_the_whisker():
    near = Peg([0.5 * LENGTH, 0.0, 0.0], [0.0, 0.0, 1.0], 1e-3)
    far = Peg([0.75 * LENGTH, 6e-3, 0.0], [0.0, 0.0, 1.0], 1e-3)
    turn = np.linspace(-0.6, 0.3, 91)
    rotations = base_rotation(turn, 0.0 * turn, 0.0 * turn)
    place = np.zeros((turn.size, 3))
    alone = follow_surfaces(WHISKER, [near], rotations, place)
    both = follow_surfaces(WHISKER, [far, near], rotations, place)
    held = both.surface == 1
    assert held.sum() > 10
    assert both.surface[np.flatnonzero(touching(both))[0]] == 1
    np.testing.assert_allclose(both.bent.force[held], alone.bent.force[held], rtol=1e-9)


def test_a_whisker_begins_outside_on_the_nearest_side():
    rotation = base_rotation(-0.26, 0.0, 0.0)[None]
    found = follow_surfaces(WHISKER, [OBJECTS["peg"]], rotation, np.zeros((1, 3)))
    assert touching(found).all()
    peg = OBJECTS["peg"]
    load = vb.PegContact(peg.origin @ rotation[0], peg.axis @ rotation[0], peg.radius)
    bent = vb.deflect(WHISKER, load)
    np.testing.assert_allclose(found.bent.force[0], bent.force, rtol=1e-7)


def test_faulty_friction():
    with pytest.raises(ValueError, match=r"friction is -0\.1"):
        follow_surfaces(WHISKER, [], np.eye(3)[None], np.zeros((1, 3)), friction=-0.1)
