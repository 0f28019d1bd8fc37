"""A whisker under two forces, against an integration from the base outward, and their detection."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli.app import app
from vibrissa.contacts import bent_by_forces

NOISE = np.diag([1e-6**2] * 3 + [2e-8**2] * 3)
DEVIATIONS = np.sqrt(np.diag(NOISE))
COUNT = 100


def outward(whisker, force, moment, arc, jump):
    """Position, frame and moment (SI) from the base to the tip, `jump` leaving at `arc`."""

    def rates(s, y, carried):
        q = Rotation.from_quat(y[3:7])
        stiffness = whisker.youngs_modulus * np.pi * whisker.radius(s) ** 4 / 4.0
        soft = np.array([1.0 + whisker.poisson_ratio, 1.0, 1.0]) / stiffness
        u = q.inv().apply(y[7:]) * soft + whisker.curvature(s)
        turn = 0.5 * np.append(y[6] * u + np.cross(y[3:6], u), -y[3:6] @ u)
        tangent = q.apply([1.0, 0.0, 0.0])
        return np.concatenate([tangent, turn, -np.cross(tangent, carried)])

    state = np.concatenate([np.zeros(3), [0.0, 0.0, 0.0, 1.0], moment])
    ends, out = (0.0, *arc), []
    for low, high, gone in zip(ends[:-1], ends[1:], (np.zeros(3), jump), strict=True):
        force = force - gone
        solved = solve_ivp(
            rates, (low, high), state, "DOP853", args=(force,), rtol=1e-11, atol=1e-15
        )
        state = solved.y[:, -1]
        out.append((state[:3], Rotation.from_quat(state[3:7]).as_matrix(), state[7:], force))
    return out


def test_two_forces_are_those_of_an_integration_outward():
    whisker = vb.Whisker.parabola(length=40e-3, coefficient=8.0)
    unit = whisker.base_bending_stiffness / whisker.length**2
    arc, forces = np.array([[0.5, 0.7]]), np.array([[[0.1, 0.5, 0.3], [-0.1, 0.4, -0.2]]])
    bent = bent_by_forces(whisker, arc, forces)
    scale = np.repeat([unit, unit * whisker.length], 3)
    wrench = bent.wrench[0] * scale
    # The first force in the base frame, by the frame at its contact.
    at = np.argmin(np.abs(bent.arc[0] - arc[0, 0]))
    jump = bent.frames[0, at] @ forces[0, 0] * unit
    first, last = outward(whisker, wrench[:3], wrench[3:], arc[0] * whisker.length, jump)
    np.testing.assert_allclose(first[0] / whisker.length, bent.contacts[0, 0], atol=2e-6)
    np.testing.assert_allclose(last[0] / whisker.length, bent.contacts[0, 1], atol=2e-6)
    np.testing.assert_allclose(first[1], bent.frames[0, at], atol=1e-5)
    np.testing.assert_allclose(last[2] / scale[3], 0.0, atol=2e-6)
    np.testing.assert_allclose(last[1].T @ last[3] / unit, forces[0, 1], atol=1e-5)


def test_one_force_is_that_of_deflect_also_on_a_compliant_base():
    for base in (None, (2e-4, 1e-4)):
        whisker = vb.samples.gamma().with_properties(base_stiffness=base)
        unit = whisker.base_bending_stiffness / whisker.length**2
        bent = bent_by_forces(whisker, np.array([[0.6]]), np.array([[[0.1, 0.5, -0.4]]]))
        load = vb.PointForce(0.6 * whisker.length, components=(0.1 * unit, 0.5 * unit, -0.4 * unit))
        known = vb.deflect(whisker, load)
        np.testing.assert_allclose(bent.wrench[0, :3] * unit, known.force, atol=2e-6 * unit)
        np.testing.assert_allclose(
            bent.contacts[0, 0] * whisker.length, known.contact_point, atol=2e-6 * whisker.length
        )
        line = bent.shape(np.linspace(0.0, 1.0, 21)[None])[0][0] * whisker.length
        np.testing.assert_allclose(line, known.centerline(21), atol=1e-5 * whisker.length)


def touched(whisker, apart, rubbing=0.0, seed=4):
    """Noisy wrenches, and noisy centrelines, of one contact or of two that far apart (over L)."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(0.5, 0.75, COUNT)
    arc = np.column_stack([middle - 0.5 * apart, middle + 0.5 * apart])[:, : 2 if apart else 1]
    size = rng.uniform(0.2, 0.8, (COUNT, 1)) * (1.1 - arc)
    angle = rng.uniform(-np.pi, np.pi, (COUNT, 1)) + 0.0 * arc
    along = rubbing * np.cos(rng.uniform(0.0, 2.0 * np.pi, arc.shape))
    forces = size[..., None] * np.stack([along, np.cos(angle), np.sin(angle)], axis=-1)
    bent = bent_by_forces(whisker, arc, forces)
    unit = whisker.base_bending_stiffness / whisker.length**2
    wrench = bent.wrench * np.repeat([unit, unit * whisker.length], 3)
    wrench += rng.normal(size=wrench.shape) * DEVIATIONS
    line = bent.shape(np.tile(np.linspace(0.02, 1.0, 25), (COUNT, 1)))[0] * whisker.length
    return wrench[:, :3], wrench[:, 3:], line + 2e-5 * rng.normal(size=line.shape)


@pytest.fixture(scope="module")
def whisker():
    return vb.Whisker.parabola(length=40e-3, coefficient=8.0)


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "rubbing"), [(0.0, 0.0), (0.3, 0.2)])
def test_false_alarms_are_as_rare_as_stated(whisker, friction, rubbing):
    force, moment, line = touched(whisker, 0.0, rubbing)
    for shape in ({}, {"centerline": line, "centerline_sigma": 2e-5}):
        found = vb.second_contact(
            whisker, force, moment, noise=NOISE, friction=friction, false_alarms=0.2, **shape
        )
        # 0.2 of 100: 20 ± 4.
        assert 8 <= found.second_contact.sum() <= 32
        assert (found.one_contact < 0.001).sum() <= 2


@pytest.mark.slow
def test_the_shape_shows_a_second_contact_that_the_wrench_hides(whisker):
    force, moment, line = touched(whisker, 0.2)
    blind = vb.second_contact(whisker, force, moment, noise=NOISE)
    known = {"centerline": line, "centerline_sigma": 2e-5}
    found = vb.second_contact(whisker, force, moment, noise=NOISE, **known)
    assert found.second_contact.mean() > 0.9
    assert blind.second_contact.mean() < 0.7
    # Wherever the tracked pose is: the shape counts up to a rigid motion.
    turned = Rotation.from_rotvec([0.02, -0.03, 0.01]).apply(line.reshape(-1, 3))
    moved = {"centerline": turned.reshape(line.shape) + 2e-4, "centerline_sigma": 2e-5}
    again = vb.second_contact(whisker, force, moment, noise=NOISE, **moved)
    assert (again.second_contact == found.second_contact).mean() > 0.95


def test_what_is_missing_or_wrong(whisker):
    force, moment, line = touched(whisker, 0.0)
    force[3], moment[5], force[7], moment[7] = np.nan, np.nan, 0.0, 0.0
    found = vb.second_contact(whisker, force, moment, noise=NOISE)
    assert np.flatnonzero(np.isnan(found.one_contact)).tolist() == [3, 5, 7]
    assert not found.second_contact[[3, 5, 7]].any()
    alone = vb.second_contact(whisker, force[0], moment[0], noise=NOISE)
    assert alone.one_contact == found.one_contact[0]
    shape = {"centerline": line[:2], "centerline_sigma": 2e-5}
    absurd = vb.second_contact(whisker, 1e5 * force[:2], moment[:2], noise=NOISE, **shape)
    assert absurd.second_contact.all()
    wrong = (
        ({"friction": -1.0}, "friction"),
        ({"false_alarms": 0.0}, "false_alarms"),
        ({"centerline": line[:-1], "centerline_sigma": 1e-5}, "centerline has shape"),
        ({"centerline": line}, "centerline_sigma"),
    )
    for bad, message in wrong:
        with pytest.raises(ValueError, match=message):
            vb.second_contact(whisker, force, moment, noise=NOISE, **bad)


def test_the_command_line_marks_second_contacts(whisker, tmp_path):
    rows = []
    for apart in (0.0, 0.3):
        force, moment, _ = touched(whisker, apart)
        rows += np.column_stack([force, moment])[:40].tolist()
    lines = ["time,Fx,Fy,Fz,Mx,My,Mz"]
    lines += [",".join(f"{v:.9g}" for v in (1e-3 * i, *row)) for i, row in enumerate(rows)]
    (tmp_path / "signals.csv").write_text("\n".join(lines) + "\n")
    vb.ContactMap.simulate(whisker, grid=False, cells=(2, 4, 2)).save(tmp_path / "map.nc")
    where = ["--map", tmp_path / "map.nc", "-o", tmp_path / "contacts.csv"]
    words = ["estimate", tmp_path / "signals.csv", "--using", "wrench", "--second-contacts", 1]
    result = CliRunner().invoke(app, [str(word) for word in (*words, *where)])
    assert result.exit_code == 0, result.output
    table = np.genfromtxt(
        tmp_path / "contacts.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"
    )
    marked = table["status"] == "not_one_contact"
    assert (marked == (table["one_contact"] < 0.01)).all()
    assert marked[:40].sum() <= 2
    assert vb.io.load_contacts(tmp_path / "contacts.csv").sizes["time"] == 80
    words += ["--compliance-sigma", 3, "--force"]
    result = CliRunner().invoke(app, [str(word) for word in (*words, *where)])
    assert "compliance of the base" in " ".join(result.output.split()), result.output
    softer = vb.io.load_contacts(tmp_path / "contacts.csv")
    stated = softer["sigma_x"].values[:40] / table["sigma_x"][:40]
    assert np.nanmedian(stated) > 1.001


def test_shapes_and_forces_in_other_units_or_frames_are_not_two_contacts():
    whisker = vb.samples.gamma()
    bent = vb.deflect(whisker, vb.PointContact([24e-3, 13e-3, 2e-3]))
    line = bent.centerline(25)
    noise = np.diag([1e-12] * 3 + [4e-16] * 3)

    def found(scale=1.0, points=line, sigma=20e-6):
        return vb.second_contact(
            whisker,
            scale * bent.force,
            scale * bent.moment,
            noise=noise,
            centerline=points,
            centerline_sigma=sigma,
        )

    assert not found().second_contact
    for points in (1e3 * line, line + np.array([0.1, 0.2, 0.0])):
        with pytest.raises(ValueError, match=r"from the base of a whisker of 0\.04"):
            found(points=points)
    assert not found(points=line[8:20]).second_contact
    for points in (line[::-1], line[20:8:-1]):
        with pytest.raises(ValueError, match="from the base to the tip"):
            found(points=points)
    with pytest.raises(ValueError, match="centerline_sigma is 20 m"):
        found(sigma=20.0)
    with pytest.raises(ValueError, match="are these mN, µN"):
        found(scale=1e6)
    # Light contacts in mN, most rows without any
    near = vb.deflect(
        whisker, vb.PointContact(whisker.position(28e-3) + np.array([0.0, 1e-3, 0.0]))
    )
    some = np.arange(9)[:, None] > 6
    with pytest.warns(UserWarning, match="are these mN, µN"):
        vb.second_contact(whisker, some * near.force * 1e3, some * near.moment * 1e3, noise=noise)


def test_large_forces_near_the_base_are_not_in_other_units():
    """A peg at a twelfth of the length; warnings are errors."""
    gamma = vb.samples.gamma()
    arc = gamma.length / 12.0
    size = np.array([0.0, gamma.base_bending_stiffness / arc**2, 0.0])
    bent = vb.deflect(gamma, vb.PointForce(np.full(3, arc), components=[size] * 3))
    assert np.linalg.norm(bent.moment, axis=-1).min() > (
        10.0 * gamma.base_bending_stiffness / gamma.length
    )
    found = vb.second_contact(gamma, bent.force, bent.moment, noise=NOISE)
    assert not found["second_contact"].any()
    with pytest.warns(UserWarning, match="are these mN, µN"):
        vb.second_contact(gamma, 30.0 * bent.force, 30.0 * bent.moment, noise=900.0 * NOISE)
