"""`vibrissa sensitivity` prints and writes what the functions give."""

import re
import sys

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa import samples
from vibrissa.cli.app import app, main
from vibrissa.io import save_recording, save_signals
from vibrissa.recording import recorded

NOISE = np.diag(np.repeat([1e-12, 4e-16], 3))


def run(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments], env={"COLUMNS": "120"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return re.sub(r"[│┃\s]+", " ", result.output)


@pytest.fixture(scope="module")
def chart(tmp_path_factory):
    path = tmp_path_factory.mktemp("sensitivity") / "map.nc"
    vb.ContactMap.simulate(samples.gamma(), grid=False).save(path)
    return path


@pytest.fixture(scope="module")
def points():
    return np.array([[25e-3, 12e-3, 1e-3], [27e-3, 2e-3, -2e-3], [30e-3, 4e-3, 6e-3]])


@pytest.fixture(scope="module")
def wrench(points):
    """Signals of three contacts, and of a frame in which there is only noise."""
    bent = vb.deflect(samples.gamma(), vb.PointContact(points))
    force, moment = np.full((2, 4, 3), 1e-9)
    force[:3], moment[:3] = bent.force, bent.moment
    signals = {"force": (("time", "space"), force), "moment": (("time", "space"), moment)}
    return xr.Dataset(signals, {"time": np.arange(4.0)})


def test_the_whole_map(chart):
    out = chart.with_name("sensitivity.nc")
    text = run("sensitivity", chart, "-o", out)
    contact_map = vb.ContactMap.load(chart)
    wanted = vb.sensitivity(contact_map, noise=NOISE)
    with xr.open_dataset(out, engine="h5netcdf") as data:
        assert data.attrs["kind"] == "vibrissa sensitivity"
        np.testing.assert_array_equal(data["sensitivity"], wanted["sensitivity"])
        assert str(data["unit"].sel(coordinate="theta", signal="MB").values) == "rad/(N m)"
        np.testing.assert_array_equal(data["small_deflection"], wanted["small_deflection"])
    median = float(vb.sensitivity_findings(wanted).median_size.sel(coordinate="r", signal="MB"))
    assert f"r MB {median * 1e-3:.3g} mm/(µN·m)" in text
    best = vb.best_triplet(contact_map, NOISE)
    winner = str(best.triplet[np.argmax(best.share.values)].values)
    assert f"{winner} {100 * float(best.share.max()):.1f} %" in text
    assert f"wrote {out}" in text


@pytest.mark.slow
def test_twins_are_beside_the_advice(chart, monkeypatch, capsys):
    verdicts = chart.with_name("uniqueness.nc")
    asked = {"regions": ["all"], "samples": 64, "resolution": False}
    found = vb.uniqueness(vb.ContactMap.load(chart), ["Fx FT MD", "Fx MB MD"], **asked)
    vb.identifiability.save_uniqueness(found, verdicts)
    text = run("sensitivity", chart, "--uniqueness", verdicts)
    share, apart = float(found.twin_share[0, 0]), float(found.twin_distance[0, 0])
    assert 0.0 < share < 1.0
    assert f"{100.0 * share:.3g} %, {1e3 * apart:.2g} mm" in text
    other = chart.with_name("straight.nc")
    vb.ContactMap.simulate(samples.straight(), grid=False).save(other)
    arguments = ["sensitivity", str(other), "--uniqueness", str(verdicts)]
    monkeypatch.setattr(sys, "argv", ["vibrissa", *arguments])
    with pytest.raises(SystemExit):
        main()
    assert "another whisker" in capsys.readouterr().err


def test_a_trial_as_signals_or_as_contact_points(chart, points, wrench):
    table, recording = chart.with_name("signals.csv"), chart.with_name("trial.nc")
    save_signals(table, wrench)
    known = xr.Dataset({"contact_point_whisker": recorded("contact_point_whisker", points)})
    save_recording(
        recording, xr.DataTree.from_dict({"/": known.assign_attrs(kind="vibrissa recording")})
    )
    wanted = vb.sensitivity(vb.ContactMap.load(chart), "FT,MB,MD", points).sensitivity
    for path, rows in ((table, 4), (recording, 3)):
        out = chart.with_name("trial_sensitivity.nc")
        run("sensitivity", chart, "--trial", path, "--using", "FT,MB,MD", "-o", out, "--force")
        with xr.open_dataset(out, engine="h5netcdf") as data:
            assert data.sizes["time"] == rows
            assert np.isnan(data["sensitivity"][3:]).all()
            got = data["sensitivity"].to_numpy()[:3]
        scale = np.abs(wanted.to_numpy()).max(axis=(0, 1))
        np.testing.assert_allclose(got / scale, wanted / scale, atol=1e-4)


def test_a_trial_without_contact_is_refused(chart, wrench, monkeypatch, capsys):
    path = chart.with_name("idle.csv")
    save_signals(path, wrench.isel(time=[3, 3]).assign_coords(time=[0.0, 1.0]))
    arguments = ["vibrissa", "sensitivity", str(chart), "--trial", str(path)]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    assert "holds no contact" in capsys.readouterr().err
