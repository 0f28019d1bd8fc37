"""Arrays of whiskers on the command line: simulated, looked into, drawn."""

import re

import numpy as np
import pytest
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli.app import app
from vibrissa.io import load_recording, save_array
from vibrissa.simulation import read_script

RUN = CliRunner()


def done(*words):
    result = RUN.invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    path = tmp_path_factory.mktemp("array") / "own.csv"
    save_array(path, vb.whisker_array(names=["C2", "C3"]))
    return path


@pytest.mark.slow
def test_simulated_looked_into_and_drawn(own, tmp_path):
    trial = tmp_path / "face.nc"
    quick = ("--duration", 0.1, "--rate", 250, "--no-noise")
    said = done("simulate", "--array", own, "--object", "plane", *quick, "-o", trial)
    assert "4 whiskers (2 left, 2 right)" in said
    assert "4 of 4 whiskers touched; contacts: LC2 1, LC3 1, RC2 1, RC3 1" in said
    recording = load_recording(trial)
    assert recording.sizes["whisker"] == 4
    np.testing.assert_allclose(recording["head_position"].values[-1], [0, 14e-3, 0], atol=1e-12)
    said = done("figures", trial, "-o", tmp_path, "--format", "png")
    assert (tmp_path / "array.png").stat().st_size > 10_000
    assert re.search(r"of 4 whiskers, the one longest in contact is shown: [LR]C\d \(", said)
    told = done("info", trial)
    assert "4: LC2, LC3, RC2, RC3" in told
    assert "whiskers" in told
    assert "curvature_knots" not in told


def test_an_array_is_looked_into_and_drawn(own, tmp_path):
    said = done("info", own)
    assert "table of whiskers" in said
    assert "4: 2 left, 2 right" in said
    assert "RC3" in said
    done("figures", own, "-o", tmp_path, "--format", "png", "--width", "single")
    assert (tmp_path / "array.png").exists()


def read(text, folder, **changes):
    return read_script(text, folder, lambda path: vb.samples.gamma(), **changes)


def test_arrays_in_the_text_of_a_trial(own):
    plan = read(
        """
        duration = 0.1
        [array]
        file = "own.csv"
        side = "left"
        [motion]
        amplitude = 10
        set_point = 5
        [head]
        to_angles = [20, 0, 0]
        [[object]]
        kind = "sphere"
        position = [0, 30, 0]
        diameter = 10
        """,
        own.parent,
        rate=200.0,
    )
    assert list(plan.whisker) == ["LC2", "LC3"]
    assert list(plan.motion) == ["LC2", "LC3"]
    turn = plan.motion["LC2"].head_rotation
    np.testing.assert_allclose(turn[0], np.eye(3), atol=1e-14)
    assert np.degrees(np.arctan2(turn[-1][1, 0], turn[-1][0, 0])) == pytest.approx(20.0)
    some = read("[array]\nrows = 'C'\ncolumns = [0]", own.parent, duration=0.1, side="right")
    assert list(some.whisker) == ["Rγ"]
    named = read("", own.parent, duration=0.1, whiskers=["alpha"], object="peg")
    assert list(named.whisker) == ["Lα", "Rα"]


def test_a_table_of_protraction(own, tmp_path):
    (tmp_path / "motion.csv").write_text("time,azimuth\n0,0\n0.05,0.5\n0.1,0\n")
    text = "array = {}\n[motion]\nkind = 'table'\nfile = 'motion.csv'"
    moves = read(text, tmp_path, whiskers=["C2"], rate=200.0).motion
    gained = moves["RC2"].azimuth - moves["RC2"].azimuth[0]
    assert gained.max() == pytest.approx(0.5, abs=0.01)
    np.testing.assert_allclose(moves["LC2"].azimuth - moves["LC2"].azimuth[0], -gained, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "changes", "said"),
    [
        ("[array]\nfil = 'x'", {}, "has fil"),
        ("[whisker]\nfile = 'x.csv'", {"array": "average"}, "both a whisker and an array"),
        ("", {"array": "average", "object": "torus"}, "of kind 'torus'"),
        ("[[object]]\nposition = [1, 2, 3]", {"object": "peg"}, "already has objects"),
        ("[motion]\nkind = 'past'", {"whiskers": ["C2"]}, "of kind 'past'"),
        ("[motion]\nrow = 'C'", {"whiskers": ["C2"]}, "has row"),
        ("", {"whiskers": ["C9"]}, "reach to column 6"),
    ],
)
def test_what_cannot_be(own, text, changes, said):
    with pytest.raises(ValueError, match=said):
        read(text, own.parent, **changes)
