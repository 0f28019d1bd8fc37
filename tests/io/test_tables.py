"""Tables of signals and contacts: lossless, and errors that say what to do."""

import numpy as np
import pytest
import xarray as xr

from vibrissa import PointContact, Status, Whisker, deflect, samples
from vibrissa.io import check_scale, load_contacts, load_signals, save_contacts, save_signals

HEADER = "time,Fx,Fy,Fz,Mx,My,Mz"


def written(tmp_path, text):
    path = tmp_path / "signals.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_signals_come_back_to_the_last_bit(tmp_path):
    generator = np.random.default_rng(0)
    path = tmp_path / "signals.csv"
    signals = xr.Dataset(
        {
            "force": (("time", "space"), generator.normal(scale=1e-4, size=(9, 3))),
            "moment": (("time", "space"), generator.normal(scale=1e-6, size=(9, 3))),
        },
        {"time": np.arange(9) / 1000.0, "space": list("xyz")},
    )
    signals["force"].values[4] = np.nan
    save_signals(path, signals)
    again = load_signals(path)
    for name in ("time", "force", "moment"):
        np.testing.assert_array_equal(again[name], signals[name])
        assert again[name].attrs["units"]
    assert path.read_text().splitlines()[0] == HEADER


def test_headers_comments_and_missing_cells(tmp_path):
    path = written(
        tmp_path,
        "# from the robot\nMz_Nm,label,time_s,Fx_N,Fy,Fz,Mx,My\n"
        "1e-6,a,0,1e-6,2e-6,3e-6,4e-9,5e-9\n\n"
        "1e-6,b,1,nan,,3e-6,4e-9,5e-9\n",
    )
    signals = load_signals(path)
    np.testing.assert_array_equal(signals["force"], [[1e-6, 2e-6, 3e-6], [np.nan, np.nan, 3e-6]])
    np.testing.assert_array_equal(signals["moment"][0], [4e-9, 5e-9, 1e-6])


def test_signals_from_netcdf(tmp_path):
    path = tmp_path / "signals.nc"
    names = HEADER.split(",")
    table = xr.Dataset(
        {n: ("time", np.full(4, (1e-6 if i < 4 else 1e-8) * i)) for i, n in enumerate(names) if i}
    )
    table = table.assign_coords(time=np.arange(4.0))
    table.to_netcdf(path, engine="h5netcdf")
    np.testing.assert_array_equal(load_signals(path)["force"][0], [1e-6, 2e-6, 3e-6])
    table.drop_vars(["Fy", "Mz"]).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(ValueError, match="lacks Fy, Mz"):
        load_signals(path)
    table.assign(Fy=table["Fy"].expand_dims(a=2)).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(ValueError, match="along time"):
        load_signals(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("# nothing\n", "is empty"),
        (HEADER + "\n", "no rows"),
        ("time,Fx,Fy,Mx,My\n0,0,0,0,0\n", "lacks Fz, Mz. It has the columns time, Fx"),
        (
            "time,Fx_g,Fy_raw,Fz,Mx,My,Mz\n",
            "Fx_g, Fy_raw are in no units that are known, such as N, mN",
        ),
        ("0,0,0,0,0,0,0\n", "first line is numbers"),
        (HEADER + "\n1700000000100000000,0,0,0,0,0,0\n", r"time is 1\.7e\+18 s in row 1.*time_ns"),
        (HEADER + "\ns,N,N,N,Nm,ounce,Nm\n", r"My \(ounce\) are in no units"),
        (HEADER + "\n0,0,0,5,0,0,0,0,0,0\n", "line 2 reads.*decimal commas need semicolons"),
        (HEADER.replace(",", ";") + "\n0.5;1,5;0;0;0;0;0\n", "line 2 reads.*no points elsewhere"),
        (HEADER + "\n0,0,0,0,0,0,0\n1,0,zero,0,0,0,0\n2,0\n", "line 3 reads '1, 0, zero.*line 4"),
        (HEADER + "\n0,12000,0,0,0,0,0\n", r"Fx reaches 1\.2e\+04 N.*must be"),
        (HEADER + "\n0,0,0,0,0,0,-7000\n", r"Mz reaches 7e\+03 N·m"),
        (HEADER + "\n0,0,inf,0,0,0,0\n", "Fy has infinite"),
    ],
)
def test_bad_signals(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        load_signals(written(tmp_path, text))


NUMBERS = [[0.0, 1e-6, 2e-6, 3e-6, 4e-9, 5e-9, 6e-9], [1.5, 1.25e-6, 0.0, -3e-6, 4e-9, 0.0, 6e-9]]


def as_text(delimiter=",", header=HEADER, decimal=".", end="\n"):
    rows = [delimiter.join(repr(x).replace(".", decimal) for x in row) for row in NUMBERS]
    return end.join([header.replace(",", delimiter), *rows]) + end


MICRO = "Time (ms),fx [µN],Force Y (µN),Fz/uN,Mx (mN·mm),ty_µN_m,Torque Z [mN mm]"


@pytest.mark.parametrize(
    ("content", "factors"),
    [
        (as_text().encode("utf-8-sig"), 1),
        (as_text(end="\r\n").encode(), 1),
        (as_text("\t").encode("utf-16"), 1),
        (as_text("  ").encode(), 1),
        (as_text(";", decimal=",").encode(), 1),
        (("sep=;\n" + as_text(";")).encode(), 1),
        ((as_text() + ",,,,,,\n").encode(), 1),
        (
            as_text(header=HEADER + "\nms,uN,uN,uN,uNm,mNmm,uNm").encode(),
            [1e-3, *[1e-6] * 6],
        ),
        (as_text().replace("\n1.5", ",\n1.5").encode(), 1),
        (as_text(";", MICRO, ",").encode("cp1252"), [1e-3, *[1e-6] * 3, *[1e-6] * 3]),
    ],
)
def test_tables_as_spreadsheets_and_loggers_write_them(tmp_path, content, factors):
    path = tmp_path / "signals.csv"
    path.write_bytes(content)
    expected = np.array(NUMBERS) * factors
    signals = load_signals(path)
    np.testing.assert_allclose(signals["time"], expected[:, 0], rtol=1e-15)
    np.testing.assert_allclose(signals["force"], expected[:, 1:4], rtol=1e-15)
    np.testing.assert_allclose(signals["moment"], expected[:, 4:], rtol=1e-15)
    assert signals.attrs["notes"] == []


def test_missing_cells_and_columns_that_are_something_else(tmp_path):
    text = "T,max,Fx_raw," + HEADER + "\n20,1,x,0,NA,2e-6,null,,1e-8,#N/A\n"
    signals = load_signals(written(tmp_path, text))
    np.testing.assert_array_equal(signals["force"], [[np.nan, 2e-6, np.nan]])
    np.testing.assert_array_equal(signals["moment"], [[np.nan, 1e-8, np.nan]])


def test_rows_without_time_are_numbered(tmp_path):
    names = HEADER.removeprefix("time,")
    signals = load_signals(written(tmp_path, names + "\n" + 2 * "1e-6,2e-6,0,0,1e-8,3e-8\n"))
    np.testing.assert_array_equal(signals["time"], [0.0, 1.0])
    np.testing.assert_array_equal(signals["force"][1], [1e-6, 2e-6, 0.0])
    np.testing.assert_array_equal(signals["moment"][1], [0.0, 1e-8, 3e-8])
    assert "numbered from 0" in signals.attrs["notes"][0]


def test_time_that_does_not_rise_is_told(tmp_path):
    rows = "".join(f"{time},1e-6,0,0,1e-8,0,0\n" for time in (0, 1, 1, "", 2, 0))
    signals = load_signals(written(tmp_path, HEADER + "\n" + rows))
    missing, back, still = signals.attrs["notes"]
    assert "time is missing in 1 of 6 rows, first in row 4" in missing
    assert "goes back in 1 of 6 rows, first in row 6, from 2 to 0 s" in back
    assert "stands still in 1 of 6 rows, first in row 3" in still


def test_time_in_milliseconds_is_noted(tmp_path):
    def notes(step):
        rows = "".join(f"{step * i},1e-6,0,0,1e-8,0,0\n" for i in range(12))
        return load_signals(written(tmp_path, HEADER + "\n" + rows)).attrs["notes"]

    assert notes(0.002) == []
    assert "time_ms" in notes(2)[0]


def test_force_and_moment_in_each_other_s_columns_are_suspected(tmp_path):
    rows = "\n0,1e-6,0,0,0,5e-5,0"
    with pytest.raises(ValueError, match="in each other's columns"):
        load_signals(written(tmp_path, HEADER + rows))


def bent_signals(whisker):
    bent = deflect(whisker, PointContact([[25e-3, 12e-3, 1e-3], [27e-3, 2e-3, -2e-3], [0, 0, 0]]))
    columns = ("time", "space")
    nothing = np.zeros((20, 3))
    return xr.Dataset(
        {
            "force": (columns, np.vstack([nothing, bent.force])),
            "moment": (columns, np.vstack([nothing, bent.moment])),
        },
        {"time": np.arange(23.0), "space": list("xyz")},
    )


@pytest.mark.parametrize(
    ("force", "moment", "message"),
    [
        (1e3, 1.0, r"inconsistent.*forces look like mN"),
        (1e9, 1.0, r"reaches .* N.*must be in N and N·m"),
        (1.0, 1e3, r"inconsistent.*moments look like"),
        (1.0, 1e10, r"reaches .* N·m.*must be in N and N·m"),
        (1e2, 1e5, r"inconsistent.*moments look like"),
    ],
)
def test_units_that_do_not_belong_together(tmp_path, force, moment, message):
    path = tmp_path / "signals.csv"
    signals = bent_signals(samples.gamma())
    save_signals(path, signals)
    load_signals(path)
    signals["force"] *= force
    signals["moment"] *= moment
    save_signals(path, signals)
    with pytest.raises(ValueError, match=rf"signals.csv: .*{message}"):
        load_signals(path)


def test_signals_too_large_for_the_whisker(tmp_path):
    whisker = samples.gamma()
    signals = bent_signals(whisker).isel(time=slice(19, None))
    wrench = np.array([signals["force"], signals["moment"]])
    check_scale(*wrench, whisker)
    check_scale(*(wrench * np.nan), whisker)
    check_scale(*wrench[:, :0], whisker)
    with pytest.raises(ValueError, match=r"force reaches .* N, .* moment reaches .* 1e-3"):
        check_scale(*(wrench * 1e3), whisker)
    check_scale(*(wrench * 1e3), Whisker.straight(length=0.15, base_radius=1e-3))


def test_a_column_that_is_there_twice_is_refused(tmp_path):
    """Else one of both would be taken in silence."""
    for other in ("Fx", "fx", "Fx_mN"):
        path = written(tmp_path, f"time,Fx,{other},Fy,Fz,Mx,My,Mz\n0,1,2,3,4,5,6,7\n")
        with pytest.raises(ValueError, match=f"Fx, {other} are 2 columns of Fx"):
            load_signals(path)


def test_no_file(tmp_path):
    for load in (load_signals, load_contacts):
        with pytest.raises(FileNotFoundError):
            load(tmp_path / "none.csv")
    with pytest.raises(FileNotFoundError):
        load_signals(tmp_path / "none.nc")


def contacts():
    generator = np.random.default_rng(1)
    names = ("x", "y", "z", "r", "theta", "phi", "sigma_x", "sigma_y", "sigma_z")
    data = xr.Dataset({n: ("time", generator.normal(size=5)) for n in names})
    data["x"].values[2] = np.nan
    status = [Status.UNIQUE, Status.AMBIGUOUS, Status.MISSING, Status.UNIQUE, Status.OUTSIDE_MAP]
    data["status"] = ("time", np.array(status, dtype=np.int8))
    return data.assign_coords(time=np.arange(5) * 1e-3)


def test_contacts_come_back(tmp_path):
    path = tmp_path / "contacts.csv"
    save_contacts(path, contacts())
    lines = path.read_text().splitlines()
    assert lines[0] == "time,x,y,z,r,theta,phi,sigma_x,sigma_y,sigma_z,status"
    assert lines[2].endswith(",ambiguous")
    again = load_contacts(path)
    for name, column in contacts().variables.items():
        np.testing.assert_array_equal(again[name], column)
        assert "units" in again[name].attrs


def test_estimates_are_written_as_they_are(gamma_map, tmp_path):
    """They had to be taken apart into columns, and the messages did not help with it."""
    path = tmp_path / "contacts.csv"
    signals = {"Fx": [-65e-6, -60e-6], "MB": [1.6e-6, 1.5e-6], "MD": [1.88, 1.9]}
    noise = {"Fx": 1e-6, "MB": 2e-8, "MD": 0.01}
    found = gamma_map.estimate(signals, noise=noise)
    for written in (found, found.to_dataset()):
        save_contacts(path, written)
        again = load_contacts(path)
        np.testing.assert_array_equal(np.column_stack([again[n] for n in "xyz"]), found.point)
        np.testing.assert_allclose(again["sigma_y"], np.sqrt(found.covariance[:, 1, 1]))
        np.testing.assert_array_equal(again["status"], found.status)
        np.testing.assert_array_equal(again["time"], [0.0, 1.0])
    recorded = found.to_dataset().rename(covariance="contact_covariance")
    with pytest.raises(ValueError, match="contacts lack time, x, y, z"):
        save_contacts(path, recorded)
    one = gamma_map.estimate({name: values[0] for name, values in signals.items()})
    with pytest.raises(ValueError, match="one contact in each row"):
        save_contacts(path, one)


def test_columns_that_are_not_known_are_missing(tmp_path):
    path = tmp_path / "contacts.csv"
    save_contacts(path, contacts().drop_vars(["sigma_x", "r"]))
    assert np.isnan(load_contacts(path)["r"]).all()


def test_bad_contacts(tmp_path):
    path = tmp_path / "contacts.csv"
    with pytest.raises(ValueError, match="lack z, status"):
        save_contacts(path, contacts().drop_vars(["z", "status"]))
    with pytest.raises(ValueError, match="one dim time"):
        save_contacts(path, contacts().assign(x=contacts()["x"].expand_dims(a=1)))
    assert not path.exists()
    save_contacts(path, contacts())
    text = path.read_text()
    for spoilt, message in (
        ("", "is empty"),
        (text.replace("theta", "azimuth"), "azimuth"),
        (text.replace("ambiguous", "perhaps"), "line 3 reads"),
        (text + "1,2,3\n", "11 columns, but line 7 has 3 cells"),
    ):
        path.write_text(spoilt)
        with pytest.raises(ValueError, match=message):
            load_contacts(path)


def test_signals_of_several_whiskers_are_not_those_of_one(tmp_path):
    path = tmp_path / "signals.csv"
    head, row = "time,whisker,Fx,Fy,Fz,Mx,My,Mz", "-1e-5,2e-5,0,0,0,4e-7"
    path.write_text(f"{head}\n0,C1,{row}\n1,C1,{row}\n")
    assert load_signals(path).sizes["time"] == 2
    path.write_text(f"{head}\n0,C1,{row}\n0,C2,{row}\n")
    with pytest.raises(ValueError, match="2 whiskers, C1, C2"):
        load_signals(path)
