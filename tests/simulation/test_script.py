"""A trial as a text says it is the trial that is simulated."""

from pathlib import Path

import numpy as np
import pytest

from vibrissa import samples
from vibrissa.cli.app import app
from vibrissa.io import load_recording
from vibrissa.objects import Box, Mesh, Peg, Plane, Sphere
from vibrissa.recording import Recording
from vibrissa.simulation import EXAMPLE, read_script


def whisker_of(path):
    return samples.gamma() if path is None else samples.curved()


def read(text, folder=Path(), **changes):
    return read_script(text, folder, whisker_of, **changes)


def test_nothing_said_is_the_trial_of_the_demo():
    plan = read("", duration=0.2, rate=500.0)
    (peg,) = plan.objects
    assert isinstance(peg, Peg)
    assert len(plan.motion) == 100
    assert plan.friction == 0.0
    np.testing.assert_allclose(plan.sensor.noise, [1e-6] * 3 + [0.02e-6] * 3)
    assert (read("", duration=0.2, rate=500.0, noise=False).sensor.noise == 0.0).all()


def test_the_example_says_the_defaults():
    named = read(EXAMPLE.replace("duration = 3.5 ", "duration = 0.3 "), rate=250.0)
    bare = read("[[object]]\nposition = [26, 0, 0]", duration=0.3, rate=250.0)
    np.testing.assert_array_equal(named.motion.azimuth, bare.motion.azimuth)
    np.testing.assert_array_equal(named.motion.base_position, bare.motion.base_position)
    assert repr(named.objects) == repr(bare.objects)
    for name in ("noise", "bias", "drift", "resolution"):
        np.testing.assert_array_equal(getattr(named.sensor, name), getattr(bare.sensor, name))


def test_all_kinds_of_objects(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.icosphere(subdivisions=2, radius=3.0).export(tmp_path / "ball.ply")
    plan = read(
        """
        friction = 0.3
        motion = {kind = "whisking", amplitude = 20, set_point = 5, elevation_drift = 0, row = "A"}
        head = {position = [1, 2, 3], angles = [90, 0, 0]}
        [[object]]
        kind = "sphere"
        position = [20, 0, 1]
        diameter = 8
        [[object]]
        kind = "plane"
        position = [0, 12, 0]
        normal = [0, -1, 0]
        stiffness = 3
        [[object]]
        kind = "box"
        position = [20, 0, 1]
        size = [2, 3, 4]
        angles = [30, 0, 0]
        edge_radius = 0.2
        [[object]]
        kind = "mesh"
        file = "ball.ply"
        resolution = 0.4
        [sensor]
        channels = ["My", "Mz"]
        moment_resolution = 0.1
        """,
        tmp_path,
        duration=0.1,
        seed=3,
    )
    sphere, plane, box, mesh = plan.objects
    assert [type(x) for x in plan.objects] == [Sphere, Plane, Box, Mesh]
    assert (sphere.radius, plane.stiffness, box.edge_radius) == (4e-3, 3.0, 0.2e-3)
    np.testing.assert_allclose(box.rotation[:, 0], [np.cos(np.pi / 6), 0.5, 0.0])
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), 6e-3, rtol=0.01)
    np.testing.assert_allclose(plan.motion.head_position[0], [1e-3, 2e-3, 3e-3])
    assert np.degrees(np.ptp(plan.motion.azimuth)) < 45.0
    assert plan.sensor.channels == ("My", "Mz")
    np.testing.assert_allclose(plan.sensor.resolution, 0.1e-6)
    assert plan.friction == 0.3


def test_motions_from_tables(tmp_path):
    time = np.linspace(0.0, 0.1, 11)
    rows = ["time,azimuth,x", *(f"{t},{np.sin(10 * t)},{0.01 * t}" for t in time)]
    (tmp_path / "motion.csv").write_text("\n".join(rows))
    (tmp_path / "head.csv").write_text("time,z\n0,0\n1,0.01\n")
    plan = read(
        'motion = {kind = "table", file = "motion.csv"}\nhead = {file = "head.csv"}', tmp_path
    )
    np.testing.assert_allclose(plan.motion.azimuth, np.sin(10 * plan.motion.time), atol=1e-3)
    expected = np.stack([plan.motion.time] * 3, axis=1) * [0.01, 0.0, 0.01]
    np.testing.assert_allclose(plan.motion.base_position, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("duration = ", "not TOML"),
        ("speed = 3", "the trial has speed; known are"),
        ("duration = 'long'", "duration is 'long'; a number is needed"),
        ("motion = 3", r"written as a table, \[motion\]"),
        ("[motion]\nkind = 'swim'", "kind is 'swim'"),
        ("[object]\nkind = 'peg'", "double brackets"),
        ("[[object]]\nkind = 'cloud'", "kind is 'cloud'"),
        ("[[object]]\nkind = 'peg'", "position is None; three numbers"),
        ("[[object]]\nkind = 'sphere'\naxis = [0, 0, 1]", "kind sphere has axis"),
        ("[sensor]\nforce = 1", "has force; known are"),
        ("[motion]\nrow = 'Q'\nkind = 'whisking'", "row is 'Q'"),
        ("[motion]\namplitude = 500\nkind = 'whisking'", "azimuth is an angle in rad"),
        ("[array]\nrows = 'A'\nwhiskers = ['C2']", "has both whiskers and rows"),
        ("[array]\nside = 'left'\nwhiskers = ['RC2']", "RC2 are not on the requested left side"),
        ("[head]\nfile = 'head.csv'\nposition = [1, 0, 0]", "has position; known are file"),
        ("duration = 1\n[motion]\nkind = 'table'\nfile = 'motion.csv'", "has its own"),
        ("[dynamics]\ndamping_ratio = 14", "14 % is 0.14"),
        ("[dynamics]\ndensity = [1.2, 1.6]", "1 g/cm³ is 1000"),
        ("[sensor]\ngain_error = 5", "it is a share: 5 % is"),
    ],
)
def test_faults(text, message):
    with pytest.raises(ValueError, match=message):
        read(text)


def test_faulty_tables(tmp_path):
    (tmp_path / "motion.csv").write_text("time,pitch\n0,0\n1,0.01\n")
    with pytest.raises(ValueError, match="has columns time, pitch and 2 rows"):
        read('motion = {kind = "table", file = "motion.csv"}', tmp_path)
    for rows in ("0,0\n2,0.01\n1,0.02", "0,0\n1,nan"):
        (tmp_path / "head.csv").write_text(f"time,z\n{rows}\n")
        with pytest.raises(ValueError, match="missing, or time that does not increase"):
            read('head = {file = "head.csv"}', tmp_path)


def test_the_command_writes_a_recording(tmp_path, capsys):
    (tmp_path / "trial.toml").write_text("friction = 0.2\n[[object]]\nposition = [26, 0, 0]\n")
    path = tmp_path / "out.nc"
    arguments = [tmp_path / "trial.toml", "-o", path, "--duration", "0.2", "--rate", "200"]
    app(["simulate", *map(str, arguments)], standalone_mode=False)
    trial = load_recording(path)
    assert trial.sizes["time"] == 40
    assert "friction 0.2" in trial.attrs["origin"]
    assert trial["force"].attrs["noise"] == pytest.approx(1e-6)
    (peg,) = Recording(trial).objects
    assert peg.origin[0] == pytest.approx(26e-3)
    said = capsys.readouterr().out
    assert "1 contact, up to" in said
    assert "µN·m" in said
    app(["simulate", "--example"], standalone_mode=False)
    assert capsys.readouterr().out == EXAMPLE


def test_dynamics_are_asked_for():
    text = "[dynamics]\ndensity = [1000, 1100]\nstep = 0.2"
    plan = read(text, duration=0.1, rate=250.0)
    assert plan.dynamics.density == (1000.0, 1100.0)
    assert plan.dynamics.step == pytest.approx(2e-4)
    assert read("", duration=0.1, rate=250.0).dynamics is None
    assert read("", duration=0.1, rate=250.0, dynamic=True).dynamics.segments == 32
    with pytest.raises(ValueError, match="density is 3"):
        read("[dynamics]\ndensity = 3", duration=0.1)


def test_a_mesh_without_a_file_is_told_what_it_needs(tmp_path):
    with pytest.raises(ValueError, match="an object of kind mesh needs a file"):
        read('[[object]]\nkind = "mesh"\n', tmp_path)
