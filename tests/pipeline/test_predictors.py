"""The table of predictors, against a trial whose every number is known in closed form."""

from datetime import UTC, datetime

import numpy as np
import pytest
import xarray as xr
from scipy.io import loadmat
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli.app import app
from vibrissa.io import Session, load_nwb_series, save_nwb, save_predictors
from vibrissa.pipeline import PREDICTORS, predictors
from vibrissa.recording import ONE_VIEW, coordinates, recorded, recording_tree

TIME = np.arange(200) / 1000.0


@pytest.fixture(scope="module")
def trial():
    """Two whiskers that turn about z while their force swings; one is lost for a while."""
    n = len(TIME)
    swing = np.sin(2.0 * np.pi * 5.0 * TIME)
    force = np.zeros((n, 2, 3))
    force[:, 0, 1], force[:, 1, 0] = 1e-4 * swing, -2e-4
    moment = np.zeros((n, 2, 3))
    moment[:, 0, 2] = 3e-6 * swing
    force[40:50, 1] = np.nan
    turn = Rotation.from_rotvec(0.3 * swing[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    values = {
        "force": force,
        "moment": moment,
        "base_rotation": np.stack([turn, turn], axis=1),
        "base_position": np.zeros((n, 2, 3)),
        "in_contact": np.abs(force).sum(axis=-1) > 5e-5,
        "status": np.zeros((n, 2), dtype=np.int8),
    }
    root = xr.Dataset(
        {name: recorded(name, array) for name, array in values.items()},
        coordinates(TIME, ["C1", "C2"]),
    )
    return recording_tree(root, [vb.samples.gamma()] * 2, "made by hand")


def test_columns_and_rates(trial):
    table = predictors(trial)
    assert len(PREDICTORS) == 16
    assert table.attrs["predictors"].split() == list(PREDICTORS)
    omega = 2.0 * np.pi * 5.0
    inner = slice(1, -1)
    one = table.sel(whisker="C1")
    np.testing.assert_allclose(one["FT"], np.abs(one["Fy"]), atol=1e-18)
    np.testing.assert_allclose(one["base_azimuth"], 0.3 * np.sin(omega * TIME), atol=1e-12)
    for name, size in (("Fy_rate", 1e-4), ("Mz_rate", 3e-6), ("base_azimuth_rate", 0.3)):
        expected = size * omega * np.cos(omega * TIME)
        np.testing.assert_allclose(one[name][inner], expected[inner], atol=2e-4 * size * omega)
    assert one["Fy_rate"].attrs["units"] == "N/s"
    assert all(one[name].attrs["units"] and one[name].attrs["long_name"] for name in one)
    other = table.sel(whisker="C2")
    assert np.isnan(other["Fx_rate"].values[39:51]).all()
    assert np.isfinite(other["Fx_rate"].values[60:]).all()


def test_one_view_shows_half_of_the_predictors(trial):
    """What one camera does not show is rounding noise, and a model would scale it up."""
    filmed = trial.copy()
    filmed.attrs["remarks"] = f"{ONE_VIEW}\nsomething else"
    names = predictors(filmed).attrs["predictors"].split()
    columns = ("Fx", "Fy", "Mz", "base_azimuth")
    assert names == [*columns, *(f"{name}_rate" for name in columns)]


def test_plain_numbers_in_other_units_are_noted(trial):
    """Where the attribute is lost, nothing but their size shows that these are µN."""
    data = trial.to_dataset()
    data["force"] = data["force"].variable.copy(data=1e6 * data["force"].values)
    with pytest.warns(UserWarning, match="times this whisker.s scale") as notes:
        predictors(recording_tree(data, [vb.samples.gamma()] * 2, "made by hand"))
    assert [str(note.message)[:2] for note in notes] == ["C1", "C2"]


@pytest.mark.slow
def test_nwb_holds_what_other_formats_hold(trial, tmp_path):
    """Estimates and signals are not called as what was tracked, and onsets may have no sigma."""
    h5py = pytest.importorskip("h5py")
    pytest.importorskip("ndx_pose")
    shape = (len(TIME), 2)
    point = np.where(trial["in_contact"].values[..., None], 1e-2, np.nan) * np.ones(3)
    event = np.zeros(shape, dtype=np.int8)
    event[10, 0] = vb.status.Event.ONSET
    onset = np.full(shape, np.nan)
    onset[10:, 0] = TIME[10]
    tracked = trial.copy()
    tracked.dataset = tracked.to_dataset().assign(contact_point=recorded("contact_point", point))
    known = {"contact_point": point + 1e-4, "event": event, "onset_time": onset}
    known |= {"onset_sigma": np.full(shape, np.nan)}
    about = {name: recorded(name, values) for name, values in known.items()}
    tracked["/estimates"] = xr.DataTree(xr.Dataset(about, attrs={"friction": 0.0}))
    wrench = {name: recorded(name, 0.9 * trial[name].values) for name in ("force", "moment")}
    tracked["/signals"] = xr.DataTree(xr.Dataset(wrench))
    table = predictors(tracked)
    save_nwb(tmp_path / "t.nwb", tracked, Session(datetime(2026, 3, 1, tzinfo=UTC)), table)
    with h5py.File(tmp_path / "t.nwb") as file:
        found = file["processing/behavior"]
        for name, column in (
            ("estimates_contact_point", "contact_point_y"),
            ("signals_force", "Fy"),
        ):
            series = found[f"{name}_C1"]["data"][:, 1]
            np.testing.assert_array_equal(series, table[column].sel(whisker="C1"))
        np.testing.assert_array_equal(found["contact_point_C1"]["data"], point[:, 0])
        assert "signals_base_position_C1" not in found
        assert "that of the estimates" in found["contact_point_C1"].attrs["description"]
        assert found["signals_moment_C1"].attrs["description"].endswith("NaN where there is none")
        assert file["intervals/contact_events/start_time"][:].tolist() == [TIME[10]]
        # nwbinspector objects to intervals without a duration.
        assert file["intervals/contact_events/stop_time"][0] == pytest.approx(TIME[11])
    assert load_nwb_series(tmp_path / "t.nwb")["force"].equals(trial["force"])


def test_a_recording_without_forces_says_what_to_run(trial):
    root = trial.to_dataset().drop_vars(["force", "moment"])
    with pytest.raises(ValueError, match="vibrissa signals"):
        predictors(recording_tree(root, [vb.samples.gamma()] * 2, "made by hand"))


def test_read_by_pandas_and_in_matlabs_layout(trial, tmp_path):
    pandas = pytest.importorskip("pandas")
    table = predictors(trial)
    save_predictors(tmp_path / "t.csv", table)
    frame = pandas.read_csv(tmp_path / "t.csv", comment="#")
    assert len(frame) == 2 * len(TIME)
    assert set(PREDICTORS) <= set(frame.columns)
    first = frame[frame.whisker == "C1"]
    np.testing.assert_array_equal(first["Mz_rate"], table["Mz_rate"].sel(whisker="C1"))
    assert set(first["in_contact"]) == {0, 1}
    named = tmp_path / "named.csv"
    save_predictors(named, table.assign_coords(whisker=["C#1", "C2"]))
    again = pandas.read_csv(named, comment="#")
    np.testing.assert_array_equal(again["Mz"], frame["Mz"])
    assert set(again["whisker"]) == {"C#1", "C2"}
    described = [line for line in (tmp_path / "t.csv").read_text().splitlines() if line[0] == "#"]
    assert len(described) == len(table) + 1
    save_predictors(tmp_path / "t.mat", table)
    found = loadmat(tmp_path / "t.mat", squeeze_me=True, simplify_cells=True)
    np.testing.assert_array_equal(found["Mz"], table["Mz"].values)
    assert found["units"]["Mz_rate"] == "N m/s"
    assert list(found["whisker"]) == ["C1", "C2"]
    assert list(found["predictors"]) == list(PREDICTORS)


def test_nwb_holds_them_and_is_valid(trial, tmp_path):
    pynwb = pytest.importorskip("pynwb")
    inspector = pytest.importorskip("nwbinspector")
    table = predictors(trial)
    subject = {"subject_id": "rat7", "species": "Rattus norvegicus"}
    session = Session(datetime(2026, 3, 1, 14, 30, tzinfo=UTC), subject=subject)
    # Contacts that a sensor located, which the recording holds in another group.
    points = np.stack([i + table["Fx"].values for i in range(3)], axis=-1)
    estimates = xr.Dataset({"contact_point": recorded("contact_point", points)}, table.coords)
    trial = trial.copy()
    trial["estimates"] = estimates.assign_attrs(friction=0.0)
    save_nwb(tmp_path / "t.nwb", trial, session, predictors(trial))
    with pynwb.NWBHDF5IO(tmp_path / "t.nwb", "r") as file:
        series = file.read().processing["behavior"]["predictors_C1"]
        assert series.comments.split() == list(PREDICTORS)
        np.testing.assert_array_equal(series.data[:, 1], table["Fy"].sel(whisker="C1"))
        points = file.read().processing["behavior"]["contact_point_C2"].data[:]
        np.testing.assert_array_equal(points, table["Fx"].values[:, 1:] + [0.0, 1.0, 2.0])
        about = file.read().processing["behavior"]["contact_point_C2"].description
        assert "no friction assumed" in about
    least = inspector.Importance.BEST_PRACTICE_VIOLATION
    worst = inspector.inspect_nwbfile(nwbfile_path=tmp_path / "t.nwb")
    assert [m.message for m in worst if m.importance.value >= least.value] == []


def test_frames_that_tracking_lost_do_not_divide_a_contact(trial, tmp_path):
    """Not in the summary, the list of contacts, and NWB; nor is a gap at its end contact."""
    h5py = pytest.importorskip("h5py")
    root = trial.to_dataset()
    touching, status = (root[name].values.copy() for name in ("in_contact", "status"))
    touching[:], touching[20:60] = False, True
    touching[30:33], status[30:33], status[60:65] = False, vb.Status.MISSING, vb.Status.MISSING
    root = root.assign(in_contact=(("time", "whisker"), touching)).assign(
        status=(("time", "whisker"), status, root["status"].attrs)
    )
    root["in_contact"].attrs = trial["in_contact"].attrs
    tree = recording_tree(root, [vb.samples.gamma()] * 2, "made by hand")
    assert vb.pipeline.TrialSummary(tree).contacts == 2
    # The command reads only what a summary needs.
    vb.io.save_recording(tmp_path / "t.nc", tree)
    shown = CliRunner().invoke(app, ["info", str(tmp_path / "t.nc")]).output
    assert "contacts  2, in 37 frames" in shown
    listed = vb.pipeline.contact_events(root)
    assert listed["onset"].values.tolist() == [TIME[20]] * 2
    assert listed["release"].values.tolist() == [TIME[60]] * 2
    save_nwb(tmp_path / "t.nwb", tree, Session(datetime(2026, 3, 1, tzinfo=UTC)))
    with h5py.File(tmp_path / "t.nwb") as file:
        assert file["intervals/contacts/start_time"][:].tolist() == [TIME[20]] * 2


def test_info_describes_exported_tables(trial, tmp_path):
    """They are neither signals nor files of trackers, and equal tables are equal files."""
    from vibrissa.io import recognise, save_contour

    table = predictors(trial)
    for name in ("a.csv", "a.mat", "b.mat"):
        save_predictors(tmp_path / name, table)
    assert (tmp_path / "a.mat").read_bytes() == (tmp_path / "b.mat").read_bytes()
    points = {name: ("contact", [0.0, 1.0]) for name in ("time", "x", "y", "z")}
    save_contour(tmp_path / "a_contour.csv", xr.Dataset(points))
    save_nwb(tmp_path / "a.nwb", trial, Session(datetime.now(UTC)), predictors=table)
    for name, verb in (("a.csv", "export"), ("a.mat", "export"), ("a_contour.csv", "reconstruct")):
        assert recognise(tmp_path / name).endswith(f"as vibrissa {verb} writes it")
        said = CliRunner().invoke(app, ["info", str(tmp_path / name)]).output
        assert "commands take the recording" in said or "no command takes the table" in said
    said = " ".join(CliRunner().invoke(app, ["info", str(tmp_path / "a.nwb")]).output.split())
    assert "writes it: base_position, base_rotation, force, moment" in said
    assert "`vibrissa import` the tracked points, if any" in said
