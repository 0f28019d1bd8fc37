"""`vibrissa signals`, `estimate` and `reconstruct` on recordings."""

import csv

import numpy as np
import pytest
import xarray as xr

from vibrissa.cli.app import app
from vibrissa.contacts import ContactMap
from vibrissa.io import load_contacts, load_recording, load_signals, save_recording
from vibrissa.recording import Recording

typer_testing = pytest.importorskip("typer.testing")


def run(*words):
    return typer_testing.CliRunner().invoke(app, [str(word) for word in words])


def done(*words):
    result = run(*words)
    assert result.exit_code == 0, result.exception
    return result.stdout


def fault(*words):
    result = run(*words)
    assert isinstance(result.exception, ValueError | OSError), result.exception
    return str(result.exception)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A simulated trial, and one as a tracker would have left it."""
    path = tmp_path_factory.mktemp("stages")
    done("simulate", "--duration", 0.36, "--rate", 300, "--seed", 2, "-o", path / "sim.nc")
    trial = load_recording(path / "sim.nc")
    ContactMap.simulate(Recording(trial).whisker(), grid=False).save(path / "map.nc")
    root, truth = trial.to_dataset(), trial["truth"].to_dataset()
    kept = root.drop_vars(["force", "moment"])
    kept = kept.assign(contact_point=truth["contact_point"], in_contact=truth["in_contact"])
    groups = {
        group.path: group.to_dataset(inherit=False)
        for group in trial.subtree
        if group.path.startswith("/whiskers")
    }
    save_recording(path / "tracked.nc", xr.DataTree.from_dict({**groups, "/": kept}))
    save_recording(path / "bare.nc", xr.DataTree(kept))
    return path


@pytest.fixture(scope="module")
def whole(folder, tmp_path_factory):
    """The simulated trial with all stages, its contour and what was printed."""
    path = tmp_path_factory.mktemp("whole")
    words = ("--map", folder / "map.nc", "-o", path / "t.nc")
    text = done("reconstruct", folder / "sim.nc", *words)
    return path, text


@pytest.fixture
def work(whole, tmp_path):
    """A copy of it to work on, with its table."""
    for name in ("t.nc", "t_contour.csv"):
        (tmp_path / name).write_bytes((whole[0] / name).read_bytes())
    return tmp_path / "t.nc"


def test_a_recording_goes_through_the_stages(folder, tmp_path):
    work = tmp_path / "trial.nc"
    work.write_bytes((folder / "sim.nc").read_bytes())
    text = done("signals", work)
    assert "gamma: in contact in" in text
    assert set(load_recording(work).children) >= {"signals", "truth"}
    text = done("estimate", work, "--map", folder / "map.nc")
    assert "Exactly one contact" in text
    estimates = load_recording(work)["estimates"]
    assert estimates.attrs["signals"] == "Fx MB MD"
    text = done("reconstruct", work)
    assert "The cylinder" in text
    assert "diameter" in text
    assert "2.7000 mm" in text
    assert "deflection angle" in text
    after = load_recording(work)
    before = load_recording(folder / "sim.nc")
    for group in before.subtree:
        xr.testing.assert_identical(
            after[group.path].to_dataset(inherit=False), group.to_dataset(inherit=False)
        )
    np.testing.assert_array_equal(after["estimates"]["contact_point"], estimates["contact_point"])
    rows = list(csv.DictReader((tmp_path / "trial_contour.csv").read_text().splitlines()))
    found = np.isfinite(estimates["contact_point"].values[:, 0, 0])
    assert len(rows) == found.sum()
    expected = estimates["contact_point"].values[found, 0]
    np.testing.assert_array_equal([[float(r[c]) for c in "xyz"] for r in rows], expected)
    assert {r["whisker"] for r in rows} == {"gamma"}
    assert {r["inlier"] for r in rows} <= {"0", "1"}
    surface = np.array([[float(r[f"surface_{c}"]) for c in "xyz"] for r in rows])
    radius = np.linalg.norm(surface - expected, axis=1)
    assert ((radius > 6e-6) & (radius < 101e-6)).all()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["trial.nc", "trial_contour.csv"]


def test_one_command_does_all_by_defaults_that_it_says(folder, tmp_path):
    out = tmp_path / "out.nc"
    words = ("reconstruct", folder / "tracked.nc", "--objects", folder / "sim.nc", "-o", out)
    result = run(*words, "--csv", tmp_path / "points.csv")
    assert result.exit_code == 0, result.exception
    said = result.stderr
    assert "filtered at 85 Hz, Young's modulus 3 GPa" in said
    assert "no map given; simulating that of Whisker 'gamma'" in said
    assert "signals (Fx, MB, MD)" in said
    contour = load_recording(out)["contour"]
    assert abs(float(contour["diameter_error"])) < 0.1e-3
    assert np.linalg.norm(contour["axis_offset"]) < 0.1e-3
    assert (tmp_path / "points.csv").exists()
    assert set(load_recording(folder / "tracked.nc").children) == {"whiskers"}


@pytest.mark.slow
def test_the_table_of_a_contour_goes_along_with_it_and_nothing_else_does(work, tmp_path):
    """A second shape needs no --force, for what the table held is what the recording held."""
    table = tmp_path / "t_contour.csv"
    first = table.read_text()
    done("reconstruct", work, "--shape", "sphere")
    second = table.read_text()
    assert second != first
    table.write_text(second + "# a note of mine\n")
    result = run("reconstruct", work)
    assert isinstance(result.exception, FileExistsError)
    assert table.read_text().endswith("of mine\n")
    other = tmp_path / "other.nc"
    other.write_bytes(work.read_bytes())
    assert isinstance(run("reconstruct", other, "--csv", table).exception, FileExistsError)
    done("reconstruct", work, "--force")


def test_what_is_asked_for_is_made_anew(work):
    first = load_recording(work)
    done("reconstruct", work, "--axis", "0,0,1")
    second = load_recording(work)
    assert second["contour"]["object_axis"].values.tolist() == [0, 0, 1]
    xr.testing.assert_identical(second["estimates"], first["estimates"])
    done("reconstruct", work, "--using", "wrench", "--force-noise", "2", "--force")
    other = load_recording(work)
    assert other["estimates"].attrs["signals"] == "wrench"
    xr.testing.assert_identical(other["signals"], first["signals"])
    done("signals", work)
    assert "estimates" not in load_recording(work).children


@pytest.mark.slow
def test_contacts_near_the_base_can_be_left_out(work):
    """As with `estimate`; the map is simulated, and the contacts are estimated anew."""
    result = run("reconstruct", work, "--proximal", 0.6, "--force")
    if result.exit_code:  # perhaps too few contacts are left for a peg
        assert "estimates are in" in str(result.exception)
    estimates = load_recording(work)["estimates"]
    found = estimates["arc_length"].values
    assert (found[np.isfinite(found)] >= 0.6 * 40e-3 - 1e-9).all()


def test_a_shape_that_does_not_fit_is_said(whole, work):
    _, text = whole
    assert "agree with it" in text
    assert "another shape" not in text
    assert "better" not in text
    text = " ".join(done("reconstruct", work, "--shape", "plane", "--force").split())
    assert "do not fit a plane" in text
    assert "another shape (--shape)" in text
    assert "A cylinder fits them better" in text


@pytest.mark.slow
def test_another_whisker_makes_signals_and_contacts_anew(folder, tmp_path):
    work = tmp_path / "t.nc"
    done("signals", folder / "tracked.nc", "--cutoff", 60, "-o", work)
    done("reconstruct", work, "--map", folder / "map.nc")
    first = load_recording(work)
    soft = Recording(first).whisker().with_properties(youngs_modulus=1.5e9)
    ContactMap.simulate(soft, grid=False).save(tmp_path / "soft.nc")
    done("reconstruct", work, "--whisker", tmp_path / "soft.nc", "--force")
    other = load_recording(work)
    assert other["signals"].attrs == first["signals"].attrs
    for group in ("signals", "estimates"):
        half = 0.5 * first[group]["force"].values
        np.testing.assert_allclose(other[group]["force"].values, half, rtol=1e-3, atol=1e-9)


def test_tables_come_out_too(folder, tmp_path):
    done("signals", folder / "sim.nc", "-o", tmp_path / "s.csv")
    table = load_signals(tmp_path / "s.csv")
    trial = load_recording(folder / "sim.nc")
    np.testing.assert_array_equal(table["force"], trial["force"].values[:, 0])
    done("estimate", folder / "sim.nc", "--map", folder / "map.nc", "-o", tmp_path / "c.csv")
    done("estimate", tmp_path / "s.csv", "--map", folder / "map.nc", "-o", tmp_path / "d.csv")
    one, other = (load_contacts(tmp_path / name) for name in ("c.csv", "d.csv"))
    sure = one["status"].values == 20
    assert sure.sum() > 20
    for name in ("x", "y", "z", "sigma_x"):
        np.testing.assert_allclose(one[name][sure], other[name][sure], rtol=1e-9)


@pytest.mark.parametrize("verb", ["signals", "estimate", "reconstruct"])
def test_files_that_are_no_recordings_are_refused(folder, tmp_path, verb):
    empty, text = tmp_path / "empty.nc", tmp_path / "text.nc"
    empty.write_bytes(b"")
    text.write_text("time,x\n")
    assert "no file" in fault(verb, tmp_path / "none.nc")
    assert "empty" in fault(verb, empty)
    assert "NetCDF" in fault(verb, text) or "lacks" in fault(verb, text)
    if verb != "estimate":
        assert "contact map" in fault(verb, folder / "map.nc")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty.nc", "text.nc"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("signals", "bare.nc"), "give its centreline with --whisker"),
        (("signals", "sim.nc", "--source", "rod"), "need wrench_covariance"),
        (("signals", "sim.nc", "--source", "contact-point"), "need contact_point"),
        (("signals", "tracked.nc", "--cutoff", 400), "below half of"),
        (("signals", "tracked.nc", "--cutoff", 0.06), "longer than the recording"),
        (("export", "."), "is a folder; the name of a file is needed"),
        (("signals", "sim.nc", "-o", "s.txt"), ".csv is needed"),
        (("estimate", "sim.nc", "--map", "map.nc", "--map", "map.nc"), "2 --map for 1 whiskers"),
        (
            ("reconstruct", "sim.nc", "--shape", "plane", "--axis", "0,0,1"),
            "--axis is for a cylinder",
        ),
        (("reconstruct", "sim.nc", "--axis", "1,2"), "X,Y,Z are needed"),
        (("reconstruct", "sim.nc", "-o", "s.csv"), ".nc"),
        (("reconstruct", "bare.nc"), "--whisker"),
    ],
)
def test_what_does_not_fit_is_said(folder, monkeypatch, words, said):
    monkeypatch.chdir(folder)
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    assert said in fault(*words)
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


@pytest.mark.slow
def test_a_whisker_that_is_missing_can_be_given(folder, tmp_path):
    out = tmp_path / "given.nc"
    done("signals", folder / "bare.nc", "--whisker", folder / "map.nc", "-o", out)
    done("estimate", out, "--map", folder / "map.nc")
    done("reconstruct", out, "--whisker", folder / "map.nc")
    assert "contour" in load_recording(out).children
    done("reconstruct", folder / "bare.nc", "--map", folder / "map.nc", "-o", out, "--force")
    assert "contour" in load_recording(out).children


def test_too_few_contacts_are_said_and_what_was_made_is_kept(folder, tmp_path):
    trial = load_recording(folder / "sim.nc")
    short = tmp_path / "short.nc"
    save_recording(short, trial.isel(time=slice(0, 4)))
    said = fault("reconstruct", short, "--map", folder / "map.nc")
    assert "no cylinder" in said
    assert "of 4 frames" in said
    assert "signals and estimates are in" in said
    assert set(load_recording(short).children) >= {"signals", "estimates"}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["short.nc"]
    before = short.read_bytes()
    assert "are in" not in fault("reconstruct", short)
    assert short.read_bytes() == before
