import numpy as np
import pytest

from vibrissa.quantities import QUANTITIES, attributes, axis_label, quantity, to_display

FACTORS = {
    ("m", "mm"): 1e3,
    ("m", "µm"): 1e6,
    ("m^2", "mm²"): 1e6,
    ("1/m", "1/mm"): 1e-3,
    ("N", "µN"): 1e6,
    ("N m", "µN·m"): 1e6,
    ("N m^2", "nN·m²"): 1e9,
    ("N m/rad", "µN·m/rad"): 1e6,
    ("Pa", "GPa"): 1e-9,
    ("N/m", "N/m"): 1.0,
    ("kg/m^3", "kg/m³"): 1.0,
    ("rad", "°"): 180 / np.pi,
    ("1", "%"): 100.0,
    ("1", ""): 1.0,
    ("s", "s"): 1.0,
    ("N^2", "N²"): 1.0,
    ("s", "ms"): 1e3,
    ("pixel", "px"): 1.0,
}


@pytest.mark.parametrize("name", QUANTITIES)
def test_row_is_complete(name):
    q = QUANTITIES[name]
    assert q.name == name
    assert q.symbol
    assert q.unit
    assert q.long_name
    assert q.description.endswith(".")


@pytest.mark.parametrize("name", [n for n, q in QUANTITIES.items() if "(" not in q.unit])
def test_display_factor_is_that_of_the_units(name):
    q = QUANTITIES[name]
    assert q.display_factor == FACTORS[q.unit, q.display_unit]


@pytest.mark.parametrize("name", QUANTITIES)
def test_axis_label_is_valid_mathtext(name):
    from matplotlib.mathtext import MathTextParser

    MathTextParser("path").parse(axis_label(name))


def test_names_of_the_contract_are_there():
    signals = ["Fx", "FT", "FD", "Mx", "MB", "MD"]
    table = ["time", "Fx", "Fy", "Fz", "Mx", "My", "Mz"]
    points = ["x", "y", "z", "r", "theta", "phi", "sigma_x", "sigma_y", "sigma_z", "status"]
    recording = ["base_position", "base_rotation", "centerline", "trace", "arc_length", "force"]
    recording += ["contact_point", "contact_point_whisker", "moment", "in_contact", "confidence"]
    assert set(QUANTITIES) >= {*signals, *table, *points, *recording}


def test_table_is_read_only():
    with pytest.raises(TypeError):
        QUANTITIES["Fx"] = QUANTITIES["Fy"]


def test_units_survive_a_file(tmp_path):
    """No unit may be one that xarray takes for a time and converts when it reads."""
    import xarray as xr

    dataset = xr.Dataset({name: ((), 1.5, attributes(name)) for name in QUANTITIES})
    dataset.to_netcdf(tmp_path / "all.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "all.nc", engine="h5netcdf") as back:
        xr.testing.assert_identical(back.load(), dataset)


def test_labels_and_values_as_shown():
    assert axis_label("Fx") == "$F_x$ (µN)"
    assert axis_label("residual") == r"$\varepsilon$"
    assert attributes("r")["units"] == "m"
    np.testing.assert_allclose(to_display("theta", [[np.pi, -np.pi / 2]]), [[180.0, -90.0]])


def test_unknown_name_is_told_what_is_close():
    with pytest.raises(
        ValueError, match=r"'force_x' is not a quantity; did you mean one of .*force"
    ):
        quantity("force_x")
    with pytest.raises(ValueError, match="Fx"):
        attributes("???")
