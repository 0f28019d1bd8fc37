"""`vibrissa estimate --around`: contacts with a known object that the whisker lies along."""

import numpy as np
import pytest
import xarray as xr

import vibrissa as vb
from vibrissa.cli.app import app
from vibrissa.io import load_contacts, save_recording, save_signals
from vibrissa.objects import Plane
from vibrissa.simulation import Motion, measure, simulate

typer_testing = pytest.importorskip("typer.testing")
WALL = Plane([0.0, 6e-3, 0.0], [0.05, -1.0, -0.3])
TOML = """[[object]]
kind = "plane"
position = [0.0, 6.0, 0.0]
normal = [0.05, -1.0, -0.3]
"""


def run(*words):
    return typer_testing.CliRunner().invoke(app, ["estimate", *(str(word) for word in words)])


@pytest.fixture
def wall(tmp_path):
    (tmp_path / "wall.toml").write_text(TOML)
    return tmp_path / "wall.toml"


def test_a_table_is_estimated_around_a_wall(wall, tmp_path):
    """The wall is 0.4 mm nearer than it is thought to be, and the γ whisker touches it twice."""
    shift = np.array([0.0, -0.4e-3, 0.0])
    bent = vb.deflect_around(vb.samples.gamma(), WALL, base_position=-shift)
    wrench = np.zeros((2, 6))
    wrench[1] = np.concatenate([bent.force[0], bent.moment[0]])
    dims = ("time", "space")
    data = {"force": (dims, wrench[:, :3]), "moment": (dims, wrench[:, 3:])}
    save_signals(tmp_path / "s.csv", xr.Dataset(data, {"time": [0.0, 1.0]}))
    known = ("--around", wall, "--position-sigma", 1)
    # No candidates are written, so that those of others stay, and those of contacts replaced do not
    (tmp_path / "c_candidates.csv").touch()
    result = run(tmp_path / "s.csv", *known, "-o", tmp_path / "c.csv")
    assert result.exit_code == 0, result.exception
    assert (tmp_path / "c_candidates.csv").exists()
    again = run(tmp_path / "s.csv", *known, "-o", tmp_path / "c.csv")
    assert "c_candidates.csv are there already" in str(again.exception)
    again = run(tmp_path / "s.csv", *known, "-o", tmp_path / "c.csv", "--force")
    assert again.exit_code == 0, again.exception
    assert not (tmp_path / "c_candidates.csv").exists()
    assert "whose position is known to 1 mm; no friction assumed" in " ".join(result.output.split())
    found = load_contacts(tmp_path / "c.csv")
    assert found["status"].values.tolist() == [vb.Status.NO_CONTACT, vb.Status.OK]
    assert found["event"].values.tolist() == [vb.status.Event.NONE, vb.status.Event.ONSET]
    one = found.isel(time=1)
    away = [float(one[a]) for a in "xyz"] - bent.contact_point[0, 0]
    assert np.linalg.norm(away) < 0.2e-3
    assert one.arc_length == pytest.approx(bent.arc_length[0, 0], abs=0.3e-3)
    assert one.last_arc_length == pytest.approx(np.nanmax(bent.arc_length), abs=0.3e-3)
    off = [float(one[f"shift_{a}"]) for a in "xyz"] - shift
    assert abs(off @ WALL.normal) < 0.15e-3


def test_objects_of_a_recording_are_where_its_poses_see_them(tmp_path):
    """The table is in the whisker's frame, and the shift in that of the laboratory."""
    place = np.array([0.1, 0.2, -0.1])
    angles = np.tile([[1.0], [0.2], [0.3]], 2)
    turn = Motion(np.arange(2.0), *angles, np.zeros((2, 3))).base_rotation[0]
    normal = turn @ WALL.normal
    wall = Plane(place + turn @ [0.0, 6e-3, 0.0], normal)
    motion = Motion(np.arange(2) * 1e-3, *angles, place + np.outer([20e-3, 0.0], normal))
    trial = measure(simulate(vb.samples.gamma(), motion, wall, nodes=9), seed=1)
    moved = trial.to_dataset()
    moved["base_position"] = moved["base_position"] + 0.3e-3 * normal
    groups = {g.path: g.to_dataset(inherit=False) for g in trial.subtree}
    save_recording(tmp_path / "t.nc", xr.DataTree.from_dict({**groups, "/": moved}))
    known = ("--around", tmp_path / "t.nc", "--position-sigma", 1)
    result = run(tmp_path / "t.nc", *known, "-o", tmp_path / "c.csv")
    assert result.exit_code == 0, result.exception
    assert "noise as the recording states" in " ".join(result.output.split())
    found = load_contacts(tmp_path / "c.csv")
    assert found["status"].values.tolist() == [vb.Status.NOT_FELT, vb.Status.OK]
    one = found.isel(time=1)
    off = [float(one[f"shift_{a}"]) for a in "xyz"] - 0.3e-3 * normal
    assert abs(off @ normal) < 0.15e-3
    bent = vb.deflect_around(vb.samples.gamma(), wall, turn, place)
    assert np.linalg.norm([float(one[a]) for a in "xyz"] - bent.contact_point[0, 0]) < 0.4e-3


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--around wall.toml", "--around and --position-sigma belong together"),
        ("--position-sigma 1", "--around and --position-sigma belong together"),
        ("--around wall.toml --position-sigma 1 --using Fx,MB,MD", "--using cannot be used"),
        ("--around wall.toml --position-sigma 1 --tip 5", "takes no other prior"),
        ("--around wall.toml --position-sigma 0", "position_sigma is positive, m; got 0.0"),
    ],
)
def test_what_goes_with_known_objects(wall, tmp_path, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.csv").write_text("Fx,Fy,Fz,Mx,My,Mz\n0,0,0,0,0,0\n")
    result = run("s.csv", *words.split())
    assert isinstance(result.exception, ValueError), result.output
    assert said in str(result.exception)
