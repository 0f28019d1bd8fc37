"""A folder of recordings in one command: one fault stops nothing, and done is done."""

import csv
import errno

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli.app import app
from vibrissa.io import load_recording, save_recording
from vibrissa.objects import Peg
from vibrissa.simulation import Motion, measure, simulate


def run(*words):
    done = CliRunner().invoke(app, [str(word) for word in words])
    if done.exception and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.output


def trial(path, peg):
    t = np.arange(40) / 1000.0
    azimuth = -0.15 + 0.45 * np.sin(np.pi * t / t[-1])
    motion = Motion(t, azimuth, 0.1 * azimuth, 0.0 * t, np.zeros((40, 3)))
    whisker = vb.Whisker.parabola(length=15e-3, coefficient=12.0)
    save_recording(path, measure(simulate(whisker, motion, peg)))


@pytest.mark.slow
def test_a_folder_is_done_once_and_summarised(tmp_path):
    near = Peg([9e-3, 2.6e-3, 0.0], [0.0, 0.0, 1.0], 0.5e-3)
    trial(tmp_path / "touch.nc", near)
    trial(tmp_path / "miss.nc", Peg([90e-3, 2.6e-3, 0.0], [0.0, 0.0, 1.0], 0.5e-3))
    (tmp_path / "broken.nc").write_bytes((tmp_path / "touch.nc").read_bytes()[:5000])
    (tmp_path / "notes.txt").write_text("not a recording")
    (tmp_path / "other.nc").write_text("not a recording")
    (tmp_path / "nothing.nc").touch()
    text = run("batch", tmp_path, "--axis", "0,0,1")
    assert "5 recordings, 4 with a fault" in text
    with (tmp_path / "summary.csv").open() as file:
        rows = {row["file"]: row for row in csv.DictReader(file)}
    assert set(rows) == {"broken.nc", "miss.nc", "nothing.nc", "other.nc", "touch.nc"}
    for name in ("broken.nc", "nothing.nc", "other.nc"):
        assert name in rows[name]["fault"]
    assert rows["miss.nc"]["frames_in_contact"] == "0"
    assert rows["miss.nc"]["fault"]
    touch = rows["touch.nc"]
    assert touch["fault"] == ""
    assert "cylinder" in touch["fitted"]
    assert touch["shape"] == "cylinder"
    fit = load_recording(tmp_path / "touch.nc")["contour"]
    assert float(touch["diameter"]) == pytest.approx(2.0 * fit["object_radius"].item(), rel=1e-5)
    assert float(touch["x"]) == pytest.approx(fit["object_position"].values[0], rel=1e-5)
    assert rows["miss.nc"]["diameter"] == ""
    truth = load_recording(tmp_path / "touch.nc")["truth"]
    assert int(touch["contacts"]) == 1
    assert 0 < int(touch["frames_in_contact"]) <= int(truth["in_contact"].sum())
    assert "touch.nc" in (tmp_path / "summary.html").read_text(encoding="utf-8")
    # The recording's own inertia is stated, as by every verb that uses the sensor's signals.
    assert "which --inertia removes" not in text
    tree = load_recording(tmp_path / "touch.nc")
    tree.attrs["origin"] = "simulated: with inertia, damping ratio 0.14, frictionless"
    (tmp_path / "moving").mkdir()
    save_recording(tmp_path / "moving" / "trial.nc", tree)
    text = run("batch", tmp_path / "moving", "--force", "--axis", "0,0,1")
    assert "with the whisker's inertia, which --inertia removes" in " ".join(text.split())
    before = (tmp_path / "touch.nc").stat().st_mtime_ns
    run("batch", tmp_path, "--axis", "0,0,1")
    assert (tmp_path / "touch.nc").stat().st_mtime_ns == before


def test_contours_of_other_options_are_kept_and_said(tmp_path):
    """And a shape that contacts do not fit is called so in the table."""
    trial(tmp_path / "touch.nc", Peg([9e-3, 2.6e-3, 0.0], [0.0, 0.0, 1.0], 0.5e-3))
    first = " ".join(run("batch", tmp_path, "--shape", "plane").split())
    assert "had a contour" not in first
    again = " ".join(run("batch", tmp_path, "--axis", "0,0,1").split())
    assert "plane fitted" in again
    assert "1 had a contour, which is unchanged; --force computes it again" in again
    for text in (first, (tmp_path / "summary.csv").read_text(encoding="utf-8")):
        assert "the contacts do not fit it (χ² per degree of freedom" in text


def test_links_and_groups_that_were_edited_stop_nothing(tmp_path):
    trial(tmp_path / "miss.nc", Peg([90e-3, 2.6e-3, 0.0], [0.0, 0.0, 1.0], 0.5e-3))
    tree = load_recording(tmp_path / "miss.nc")
    tree["/contour"] = xr.DataTree(xr.Dataset(attrs={"shape": "cylinder"}))
    save_recording(tmp_path / "lacking.nc", tree)
    (tmp_path / "gone.NC").symlink_to(tmp_path / "nowhere.nc")
    result = CliRunner().invoke(app, ["batch", str(tmp_path)])
    assert "3 recordings, 3 with a fault" in result.output
    assert result.exit_code == 1
    with (tmp_path / "summary.csv").open() as file:
        faults = {row["file"]: row["fault"] for row in csv.DictReader(file)}
    assert "there is no file" in faults["gone.NC"]
    assert "lacks" in faults["lacking.nc"]
    (tmp_path / "summary.csv").write_text("my,own\n")
    with pytest.raises(ValueError, match=r"summary.csv is not a table of this command"):
        run("batch", tmp_path)
    assert (tmp_path / "summary.csv").read_text() == "my,own\n"


def test_recordings_that_cannot_be_saved_do_not_stop_the_others(tmp_path, monkeypatch):
    """A full disk, or a folder of another user behind a link."""
    for name in ("a.nc", "b.nc"):
        trial(tmp_path / name, Peg([90e-3, 2.6e-3, 0.0], [0.0, 0.0, 1.0], 0.5e-3))
    table, wrote = tmp_path / "summary.csv", vb.io.write_table

    def full(path, *_):
        raise OSError(errno.ENOSPC, f"{path} cannot be written: No space left on device")

    def once(path, header, rows):
        if len(rows) == 1:
            full(path)
        wrote(path, header, rows)

    monkeypatch.setattr(vb.io, "save_recording", full)
    monkeypatch.setattr(vb.io, "write_table", once)
    result = CliRunner().invoke(app, ["batch", str(tmp_path)])
    assert "2 recordings, 2 with a fault" in result.output
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["file"] for row in rows] == ["a.nc", "b.nc"]
    assert all("cannot be written: No space left" in row["fault"] for row in rows)
    assert all(row["frames"] == "40" for row in rows)


def test_hidden_files_are_not_recordings(tmp_path):
    (tmp_path / "._touch.nc").write_bytes(b"\0\5\x16\7 attributes of a file")
    with pytest.raises(ValueError, match="contains no recordings"):
        run("batch", tmp_path)


def test_a_table_of_each_recording(tmp_path):
    peg = Peg([9e-3, 2.6e-3, 0.0], [0.0, 0.0, 1.0], 0.5e-3)
    files = [tmp_path / "a.nc", tmp_path / "b.nc"]
    for file in files:
        trial(file, peg)
    run("export", *files, "--to", "mat")
    assert all(file.with_suffix(".mat").exists() for file in files)
    with pytest.raises(ValueError, match="--output cannot be used"):
        run("export", *files, "-o", tmp_path / "c.csv")
    files[1].with_suffix(".csv").touch()
    with pytest.raises(FileExistsError):
        run("export", *files)
    assert not files[0].with_suffix(".csv").exists()
