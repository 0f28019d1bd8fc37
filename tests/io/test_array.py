"""Arrays of whiskers go to files and come back; what is wrong with a lab's table is told."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.io import Kind, load_array, recognise, save_array, save_centerline, save_recording

SOME = vb.whisker_array(rows="CE", columns=[0, 1, 3])
MM = 1e-3


@pytest.mark.parametrize("ending", ["nc", "csv"])
def test_round_trip(tmp_path, ending):
    path = tmp_path / f"rat.{ending}"
    save_array(path, SOME)
    again = load_array(path)
    assert list(again) == list(SOME)
    # A table holds 12 digits.
    loose = 0.0 if ending == "nc" else 1e-12
    np.testing.assert_allclose(again.centerlines(), SOME.centerlines(), rtol=0, atol=loose)
    for name, whisker in SOME.items():
        assert again[name].base_radius == pytest.approx(whisker.base_radius, rel=1e-9)
        assert again[name].tip_radius == pytest.approx(whisker.tip_radius, rel=1e-9)
    assert recognise(path) == (Kind.ARRAY if ending == "nc" else Kind.ARRAY_TABLE)


def test_files_with_a_group_a_whisker(tmp_path):
    path = tmp_path / "before.nc"
    few = vb.WhiskerArray(list(SOME.values())[:2])
    few.to_tree().to_netcdf(path, engine="h5netcdf")
    np.testing.assert_array_equal(load_array(path).centerlines(), few.centerlines())


def test_a_folder_of_centrelines(tmp_path):
    lines = SOME.centerlines(201)
    for name, line in zip(["Lgamma", "left_C1", "C3"], lines[:3], strict=True):
        save_centerline(tmp_path / f"{name}.csv", line)
    (tmp_path / "readme.txt").write_text("not a whisker")
    array = load_array(tmp_path, noise=0.0)
    assert list(array) == ["Lγ", "LC1", "LC3"]
    np.testing.assert_allclose(array.centerlines(), SOME.centerlines()[:3], rtol=0, atol=2e-6)
    assert array["LC1"].base_radius == pytest.approx(SOME["LC1"].base_radius, rel=1e-4)
    (tmp_path / "nose.csv").write_text("x_mm,y_mm,z_mm\n0,0,0\n")
    with pytest.raises(ValueError, match=r"nose\.csv: 'nose' is not a whisker's name"):
        load_array(tmp_path)


HEADER = "name,x_mm,y_mm,z_mm,azimuth_deg,elevation_deg,roll_deg,length_mm,coefficient_per_mm"


def written(tmp_path, text):
    path = tmp_path / "own.csv"
    path.write_text(text)
    return path


def test_a_labs_table(tmp_path):
    text = f"# our rat\n{HEADER},note\nC2,6,-4,1,10,5,-90,30,0.02,long\n"
    text += "gamma,-6,-9,1,170,5,-90,50,-0.01,\n"
    array = load_array(written(tmp_path, text))
    assert list(array) == ["Lγ", "RC2"]
    whisker = array["C2"]
    np.testing.assert_allclose(whisker.pose.origin, [6 * MM, -4 * MM, MM])
    assert whisker.length == pytest.approx(30 * MM)
    # Its published base radius, by name and its own length.
    assert whisker.base_radius == pytest.approx(0.5 * MM * (0.041 + 0.06 + 0.033 - 0.0078))
    # Rolled by −90° a whisker bends down; a negative coefficient bends it up.
    assert whisker.pose.rotation[2, 1] < -0.99
    assert array["gamma"].pose.rotation[2, 1] > 0.99


def test_a_table_with_rotations(tmp_path):
    turn = SOME["RC1"].pose.rotation.round(6)
    cells = ",".join(f"{x:.6f}" for x in turn.ravel())
    names = ",".join(f"r{i}{j}" for i in "123" for j in "123")
    text = f"name,x_m,y_m,z_m,{names},length_mm,coefficient_per_m,base_radius_um,tip_radius_um\n"
    text += f"RC1,0.006,-0.004,0,{cells},30,15,80,4\n"
    whisker = load_array(written(tmp_path, text))["C1"]
    np.testing.assert_allclose(whisker.pose.rotation, turn, atol=2e-6)
    assert whisker.base_radius == pytest.approx(80e-6)
    with pytest.raises(ValueError, match=r"line 2: .*not a rotation"):
        load_array(written(tmp_path, text.replace(cells, ",".join("1" * 9))))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("# none", "is empty"),
        ("name,length_mm\n", "no rows"),
        ("x_mm,y_mm\n1,2\n", "name, x_mm"),
        ("name,x_mm,y_mm,z_mm\nC2,1,2,3\n", "no column length_"),
        (f"{HEADER}\nC2,6,-4,1,10,5,-90,30\n", "9 columns, but line 2 has 8 cells"),
        (f"{HEADER}\nC2,6,-4,1,ten,5,-90,30,0.02\n", "no number for azimuth"),
        (f"{HEADER}\nC2,6,-4,1,10,5,-90,3000,0.02\n", "line 2: .*length is 3 m"),
        (f"{HEADER}\nF2,6,-4,1,10,5,-90,30,0.02\n", "line 2: 'F2' is not a whisker's name"),
        (f"{HEADER}\nLC2,6,-4,1,10,5,-90,30,0.02\n", "on the right side"),
        (f"{HEADER}\nC2,nan,-4,1,10,5,-90,30,0.02\n", "origin"),
    ],
)
def test_what_is_wrong_is_told(tmp_path, text, said):
    with pytest.raises(ValueError, match=said):
        load_array(written(tmp_path, text))


def test_what_is_more_curved_than_any_whisker_is_warned_of(tmp_path):
    path = written(tmp_path, f"{HEADER}\nC2,6,-4,1,10,5,-90,30,0.2\n")
    with pytest.warns(UserWarning, match="C2: its coefficient, 0.2 per mm.*check the units"):
        load_array(path)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_array(tmp_path / "none.csv")
    zarr = tmp_path / "trial.nwb.zarr"
    zarr.mkdir()
    (zarr / ".zgroup").write_text("{}")
    with pytest.raises(ValueError, match="is a Zarr folder, as NWB can be kept in"):
        load_array(zarr)
    (zarr / ".zgroup").rename(zarr / "session.nwb")
    with pytest.raises(ValueError, match=r"is a folder of session\.nwb"):
        load_array(zarr)
    (zarr / "session.nwb").unlink()
    for name in ("C2", "contacts", "touches"):
        (zarr / f"{name}.csv").write_text("x_mm,y_mm,z_mm\n0,0,0\n10,0,0\n20,1,0\n30,3,0\n")
    with pytest.raises(ValueError, match=r": contacts\.csv, touches\.csv: .*'touches'") as fault:
        load_array(zarr)
    assert str(fault.value).count("row and column") == 1
    (zarr / "C2.csv").unlink()
    with pytest.raises(ValueError, match=r"is a folder of contacts\.csv; touches\.csv; one of cen"):
        load_array(zarr)
    (zarr / "contacts.csv").unlink()
    (zarr / "touches.csv").unlink()
    zarr.rmdir()
    with pytest.raises(ValueError, match="is a folder of nothing"):
        load_array(tmp_path)
    bent = vb.WhiskerArray([vb.samples.gamma().with_properties(name="Lgamma")])
    with pytest.raises(ValueError, match="not a planar parabola"):
        save_array(tmp_path / "bent.csv", bent)
    assert not (tmp_path / "bent.csv").exists()
    with pytest.raises(ValueError, match="not a recording"):
        save_recording(tmp_path / "array.nc", SOME.to_tree())
