"""`vibrissa uniqueness`: a table for people, files with the evidence."""

import sys

import pytest
import xarray as xr
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli.app import app, main


@pytest.fixture(scope="module")
def chart(tmp_path_factory):
    path = tmp_path_factory.mktemp("uniqueness") / "map.nc"
    whisker = vb.Whisker.parabola(length=40e-3, coefficient=0.82 / 40e-3)
    vb.ContactMap.simulate(whisker, grid=False).save(path)
    return path


def test_verdicts_and_a_witness(chart, tmp_path):
    out = tmp_path / "u.nc"
    arguments = ["--using", "Fx,MB,MD", "--samples", "512", "--no-resolution", "-o", str(out)]
    result = CliRunner().invoke(app, ["uniqueness", str(chart), *arguments])
    assert result.exit_code == 0, result.output
    assert "Fx MB MD" in result.output
    assert "A witness for (Fx, MB, MD)" in result.output
    with xr.open_dataset(out, engine="h5netcdf") as found:
        assert found.verdict.sel(region="all").item() == "not unique"
        apart = 1e3 * float(found.witness_separation.max())
        where = found.notation.item()
    assert f"{apart:.4g} mm apart" in result.output
    about = CliRunner().invoke(app, ["info", str(out)]).output
    assert f"Fx MB MD ({where})" in about
    assert "witness_point" not in about
    assert "witness_point" in CliRunner().invoke(app, ["info", str(out), "--all"]).output


def test_cone_and_region(chart):
    arguments = ["--using", "Fx MB MD", "--region", "all", "--cone", "8", "--samples", "512"]
    result = CliRunner().invoke(app, ["uniqueness", str(chart), *arguments, "--no-resolution"])
    assert result.exit_code == 0, result.output
    words = "unique (no counterexample found)"
    assert f"The triplet to use: (Fx, MB, MD), {words} in: all." in result.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--using", "Fx,MB"], "exactly 3"),
        (["--region", "up"], "is not one of"),
        (["--domain", "mars"], "is not one of"),
        (["-o", "verdicts.txt"], ".nc or .csv is needed"),
    ],
)
def test_faults_are_one_message(chart, monkeypatch, capsys, arguments, message):
    monkeypatch.setattr(sys, "argv", ["vibrissa", "uniqueness", str(chart), *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    assert message in capsys.readouterr().err.replace("\n", " ")
