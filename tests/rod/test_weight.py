"""A whisker under its weight, against an integration in the laboratory frame."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import vibrissa as vb
from vibrissa.rod import STEPS, discretize, gravity

G = 9.81
LEVEL, UPRIGHT, OBLIQUE = (0.0, 0.0, -G), (-G, 0.0, 0.0), (-0.5 * G, 0.5 * G, -0.7 * G)


def rod(length, base, tip, modulus, density, bend=0.0):
    """A tapered rod of constant curvature."""
    return vb.Whisker.from_curvature(
        length,
        lambda s: np.stack([0.0 * s, 0.0 * s, bend + 0.0 * s], axis=-1),
        base_radius=base,
        tip_radius=tip,
        youngs_modulus=modulus,
        density=density,
    )


RODS = {
    "PLA": rod(0.25, 2e-3, 0.8e-3, 2.3e9, 1240.0),
    "steel": rod(0.3, 0.5e-3, 0.25e-3, 200e9, 7850.0),
    "nitinol": rod(0.15, 0.15e-3, 0.08e-3, 60e9, 6450.0),
    "curved": rod(0.12, 0.2e-3, 0.1e-3, 3e9, 1500.0, bend=6.0),
}


def laboratory(whisker, gravity, s_c, force, moment, bend):
    """Moment at the tip, place and frame at the contact, from the wrench at the base outward.

    Position, quaternion, and moment in the base frame, with everything in SI units.
    """
    length, r0, r1 = whisker.length, whisker.base_radius, whisker.tip_radius
    weight = whisker.density * np.pi * np.asarray(gravity)

    def rates(s, y, loaded):
        q = Rotation.from_quat(y[3:7])
        radius = r0 + (r1 - r0) * s / length
        stiffness = whisker.youngs_modulus * np.pi * radius**4 / 4.0
        local = q.inv().apply(y[7:])
        u = local / stiffness * [1.0 + whisker.poisson_ratio, 1.0, 1.0] + [0.0, 0.0, bend]
        beyond = weight * (length - s) * (radius**2 + radius * r1 + r1**2) / 3.0
        tangent = q.apply([1.0, 0.0, 0.0])
        w = y[6]
        turn = 0.5 * np.append(w * u + np.cross(y[3:6], u), -y[3:6] @ u)
        return np.concatenate([tangent, turn, -np.cross(tangent, beyond + loaded * force)])

    start = np.concatenate([np.zeros(3), [0.0, 0.0, 0.0, 1.0], moment])
    options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-14}
    at = solve_ivp(rates, (0.0, s_c), start, args=(1.0,), **options).y[:, -1]
    end = solve_ivp(rates, (s_c, length), at, args=(0.0,), **options).y[:, -1]
    return end[7:], at[:3], Rotation.from_quat(at[3:7]).as_matrix()


@pytest.mark.parametrize(
    ("name", "gravity", "load"),
    [
        ("PLA", LEVEL, (0.7, 0.1, 1.0, -0.6)),
        ("PLA", UPRIGHT, (0.9, 0.0, -0.4, 1.5)),
        ("steel", OBLIQUE, (0.5, 0.0, 1.5, 1.0)),
        pytest.param("steel", UPRIGHT, (0.8, -0.2, 1.0, 0.2), marks=pytest.mark.slow),
        pytest.param("nitinol", LEVEL, (0.6, 0.0, -1.0, 1.2), marks=pytest.mark.slow),
        pytest.param("nitinol", UPRIGHT, (0.95, 0.0, 0.7, 0.7), marks=pytest.mark.slow),
        ("nitinol", OBLIQUE, (0.4, 0.0, 2.0, -2.0)),
        ("curved", OBLIQUE, (0.75, 0.1, 0.8, -0.9)),
    ],
)
def test_force_is_that_of_the_laboratory_frame(name, gravity, load):
    whisker, bend = RODS[name], 6.0 if name == "curved" else 0.0
    unit = whisker.base_bending_stiffness / whisker.length**2
    s_c, components = load[0] * whisker.length, tuple(f * unit for f in load[1:])
    bent = vb.deflect(whisker, vb.PointForce(s_c, components=components), gravity=gravity, steps=96)
    rest = vb.resting(whisker, gravity)
    moment = bent.moment + rest.moment
    scale = unit * whisker.length

    left, place, frame = laboratory(whisker, gravity, s_c, bent.force, moment, bend)
    np.testing.assert_allclose(left / scale, 0.0, atol=1e-8)
    np.testing.assert_allclose(bent.contact_point, place, atol=1e-8 * whisker.length)
    np.testing.assert_allclose(frame.T @ bent.force / unit, load[1:], atol=1e-8)
    line = bent.centerline(21)
    along = np.linalg.norm(np.diff(line, axis=0), axis=1)
    assert np.all(along <= whisker.length / 20 * (1 + 1e-9))
    ahead = vb.deflect(
        whisker, vb.PointForce(0.5 * whisker.length, 0.0, 0.0), gravity=gravity
    ).centerline(21)
    np.testing.assert_allclose(ahead, rest.centerline(21), atol=1e-7 * whisker.length)


def test_rest_is_that_of_the_laboratory_frame():
    whisker = RODS["nitinol"]
    rest = vb.resting(whisker, LEVEL)
    left, _, _ = laboratory(whisker, LEVEL, 0.5 * whisker.length, np.zeros(3), rest.moment, 0.0)
    assert np.abs(left).max() < 1e-7 * np.abs(rest.moment).max()
    np.testing.assert_allclose(rest.force, whisker.mass * np.array(LEVEL), rtol=1e-9)
    sag = -rest.centerline(2)[-1, 2]
    assert 8.0e-3 < sag < 8.4e-3  # 8.2 mm by another program


def test_points_and_pegs_invert_forces():
    whisker = RODS["nitinol"]
    unit = whisker.base_bending_stiffness / whisker.length**2
    forces = vb.PointForce(
        np.linspace(0.4, 0.95, 6) * whisker.length, np.linspace(0.02, 1.5, 6) * unit, np.arange(6.0)
    )
    pushed = vb.deflect(whisker, forces, gravity=OBLIQUE)
    held = vb.deflect(whisker, vb.PointContact(pushed.contact_point), gravity=OBLIQUE)
    assert (held.status == vb.Status.OK).all()
    np.testing.assert_allclose(held.force, pushed.force, atol=1e-8 * unit)
    np.testing.assert_allclose(held.moment, pushed.moment, atol=1e-8 * unit * whisker.length)
    # A peg along the direction that the force leaves free meets the whisker in the same contact.
    i = 3
    frame_axis = np.cross(pushed.force[i], [1.0, 0.0, 0.0])
    peg = vb.PegContact(pushed.contact_point[i], frame_axis, side=pushed.force[i])
    leaning = vb.deflect(whisker, peg, gravity=OBLIQUE)
    assert leaning.status == vb.Status.OK
    np.testing.assert_allclose(leaning.force @ frame_axis, 0.0, atol=1e-9 * unit)
    away = vb.PegContact([0.1, 0.1, 0.1], [0.0, 0.0, 1.0], radius=1e-3)
    free = vb.deflect(whisker, away, gravity=OBLIQUE)
    assert free.status == vb.Status.NO_CONTACT
    assert not free.moment.any()


def test_gravity_for_each_load_and_a_base_that_accelerates():
    whisker = RODS["PLA"]
    load = vb.PointForce(np.full(3, 0.15), 0.3, 1.0)
    each = vb.deflect(whisker, load, gravity=[LEVEL, UPRIGHT, LEVEL])
    one = vb.deflect(whisker, vb.PointForce(0.15, 0.3, 1.0), gravity=UPRIGHT)
    np.testing.assert_array_equal(each.force[1], one.force)
    np.testing.assert_array_equal(each.force[0], each.force[2])
    assert np.abs(each.moment[0] - each.moment[1]).max() > 1e-4
    none = vb.deflect(whisker, load, gravity=np.zeros(3))
    np.testing.assert_array_equal(none.moment, vb.deflect(whisker, load).moment)


def test_what_is_wrong_is_said():
    load = vb.PointForce(0.02, 1e-5, 0.0)
    with pytest.raises(ValueError, match="density"):
        vb.deflect(vb.samples.gamma(), load, gravity=LEVEL)
    with pytest.raises(ValueError, match="broadcast"):
        vb.deflect(RODS["PLA"], load, gravity=np.zeros((4, 3)) + 1.0).force  # noqa: B018
    with pytest.raises(ValueError, match="m/s²"):
        vb.resting(RODS["PLA"], (0.0, 9.81))
    with pytest.raises(ValueError, match="in mm/s²"):
        vb.deflect(RODS["PLA"], load, gravity=1e3 * np.array(LEVEL)).force  # noqa: B018


def test_an_upright_cylinder_stands_as_high_as_greenhill_found():
    modulus, density, radius = 3e9, 1200.0, 0.1e-3
    height = np.cbrt(7.83735 * modulus * radius**2 / (4.0 * density * G))
    vb.resting(rod(0.99 * height, radius, radius, modulus, density), UPRIGHT)
    tall = rod(1.01 * height, radius, radius, modulus, density)
    with pytest.raises(ValueError, match="topples in gravity"):
        vb.resting(tall, UPRIGHT)
    vb.resting(tall, (G, 0.0, 0.0))


def test_a_rod_under_weight_is_solved_once(monkeypatch):
    """With or without the default number of steps, and for an accelerometer's noisy sizes."""
    bent = gravity.resting(RODS["curved"], LEVEL)
    assert discretize(bent) is discretize(bent, STEPS)
    monkeypatch.setattr(gravity, "_lean_by_increments", None)
    for scale in (1.001, 0.999, 1.0 + 1e-15):
        gravity.resting(RODS["curved"], scale * np.array(LEVEL))


def test_a_light_whisker_that_hardly_sags_is_not_questioned():
    """Its curvature would be small for a shape that was stated."""
    light = vb.Whisker.straight(5e-3, base_radius=25e-6, tip_radius=2e-6, density=1300.0)
    sagged = gravity.resting(light, LEVEL).shape()
    assert 0.0 < np.abs(sagged.curvature(0.0)[1:]).max() < 0.1
