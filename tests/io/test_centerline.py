"""Centrelines as CSV: units from the header, and errors that name the line."""

import numpy as np
import pytest

from vibrissa import samples
from vibrissa.io import load_centerline, load_whisker, save_centerline

POINTS = samples.gamma().centerline(12)


@pytest.mark.parametrize(
    ("names", "factor"),
    [
        ("x_mm,y_mm,z_mm", 1e3),
        ("X_MM, Y_mm ,z_mm", 1e3),
        ("x,y,z", 1.0),
        ("x_m,y_m,z_m", 1.0),
        ("x_um,y_um,z_um", 1e6),
    ],
)
def test_the_header_tells_the_unit(tmp_path, names, factor):
    path = tmp_path / "a.csv"
    np.savetxt(path, POINTS * factor, delimiter=",", header=names, comments="")
    np.testing.assert_allclose(load_centerline(path), POINTS, rtol=0, atol=1e-15)


def test_written_and_read(tmp_path):
    path = tmp_path / "C2.csv"
    save_centerline(path, POINTS)
    np.testing.assert_allclose(load_centerline(path), POINTS, rtol=0, atol=1e-9)
    whisker = load_whisker(path, base_radius=80e-6)
    assert whisker.name == "C2"
    assert whisker.base_radius == 80e-6
    assert load_whisker(str(path), name="mine").name == "mine"


def test_comments_other_columns_and_no_z(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("\ufeff# a comment\n\nlabel,y_mm,x_mm\na,1,2\n# one more\nb,3,4\n")
    np.testing.assert_allclose(load_centerline(path), [[2e-3, 1e-3, 0], [4e-3, 3e-3, 0]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("# nothing\n", "is empty"),
        ("1,2,3\n4,5,6\n", "no header"),
        ("a,b,c\n1,2,3\n", "columns a, b, c"),
        ("x_mm,z_mm\n1,2\n", "columns x_mm, z_mm"),
        ("x_mm,y_mm,z\n1,2,3\n", "one unit"),
        ("x_mm,y_mm,z_mm\n1,2,3\n1,two,3\n1,2\n", "line 3 reads '1, two, 3'; line 4 reads '1, 2'"),
    ],
)
def test_bad_files(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        load_centerline(path)


def test_faults_name_the_file(tmp_path):
    path = tmp_path / "short.csv"
    path.write_text("x_mm,y_mm\n1,2\n2,3\n")
    with pytest.raises(ValueError, match=r"short.csv: .*at least 4"):
        load_whisker(path)
    with pytest.raises(FileNotFoundError):
        load_whisker(tmp_path / "none.csv")
    with pytest.raises(ValueError, match="shape"):
        save_centerline(path, [1, 2, 3])


RADII = np.linspace(100e-6, 7e-6, len(POINTS))


def table(tmp_path, header, *columns, delimiter=","):
    path = tmp_path / "b.csv"
    np.savetxt(path, np.column_stack(columns), delimiter=delimiter, header=header, comments="")
    return path


@pytest.mark.parametrize(
    ("header", "factor", "delimiter"),
    [
        ("x_mm,y_mm,z_mm,radius_um", 1e6, ","),
        ("x_mm,y_mm,z_mm,radius", 1e3, ","),
        ("X (mm);Y (mm);Z (mm);Diameter [µm]", 2e6, ";"),
        ("x/mm\ty/mm\tz/mm\tdiameter_mm", 2e3, "\t"),
    ],
)
def test_a_column_tells_the_radius(tmp_path, header, factor, delimiter):
    path = table(tmp_path, header, POINTS * 1e3, RADII * factor, delimiter=delimiter)
    whisker = load_whisker(path)
    np.testing.assert_allclose(whisker.base_radius, 100e-6, rtol=1e-6)
    np.testing.assert_allclose(whisker.tip_radius, 7e-6, rtol=1e-6)
    np.testing.assert_allclose(load_whisker(path, base_radius=50e-6).base_radius, 50e-6)


def test_the_thicker_end_is_the_base(tmp_path):
    header = "x_mm,y_mm,z_mm,radius_um"
    around = table(tmp_path, header, POINTS[::-1] * 1e3, RADII[::-1] * 1e6)
    whisker = load_whisker(around, noise=0.0)
    np.testing.assert_allclose(whisker.pose.origin, POINTS[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(whisker.base_radius, 100e-6, rtol=1e-6)
    assert "last point of the file" in whisker.notes[-1]
    said = load_whisker(around, noise=0.0, base="first")
    np.testing.assert_allclose(said.pose.origin, POINTS[-1], rtol=0, atol=1e-9)
    assert "last point" not in " ".join(said.notes)
    rod = table(tmp_path, header, POINTS[::-1] * 1e3, np.linspace(95, 100, len(POINTS)))
    np.testing.assert_allclose(load_whisker(rod, noise=0.0).pose.origin, POINTS[-1], atol=1e-9)


def test_radii_and_points_that_are_missing(tmp_path):
    radii = np.where(RADII < 20e-6, np.nan, RADII)
    gap = np.full((2, 4), np.nan)
    path = tmp_path / "b.csv"
    rows = np.vstack([np.column_stack([POINTS * 1e3, radii * 1e6]), gap])
    np.savetxt(path, rows, delimiter=",", header="x_mm,y_mm,z_mm,radius_um", comments="")
    whisker = load_whisker(path)
    assert whisker.tip_radius == pytest.approx(np.nanmin(radii), rel=1e-6)
    assert load_centerline(path).shape == POINTS.shape


@pytest.mark.parametrize(
    ("header", "coordinates", "radii", "message"),
    [
        ("x_mm,y_mm,z_mm,radius_um", 1e3, RADII * 1e6 - 20, r"positive; .* µm at point 11"),
        ("x_mm,y_mm,z_mm,radius_um", 1e3, RADII - RADII[-1], "0 µm at point 12"),
        ("x_mm,y_mm,z_mm,radius", 1e3, RADII * 1e6, r"radius is 1e\+05 µm on a whisker of 39"),
        ("x_mm,y_mm,z_mm,radius_um", 1e3, RADII, "called by its unit"),
        ("x_mm,y_mm,z_mm,ring", 1e6, RADII, r"micrometres as millimetres.*are in mm"),
        ("x_um,y_um,z_um,ring", 1e3, RADII, r"shorter than the 0\.5 mm.*are in um"),
        ("x,y,z,ring", 1e3, RADII, "millimetres given as metres.*are in m"),
    ],
)
def test_radii_and_units_that_cannot_be(tmp_path, header, coordinates, radii, message):
    with pytest.raises(ValueError, match=message):
        load_whisker(table(tmp_path, header, POINTS * coordinates, radii))


def test_two_columns_of_thickness(tmp_path):
    path = table(tmp_path, "x,y,z,radius_um,diameter_um", POINTS, RADII, RADII)
    with pytest.raises(ValueError, match="radius_um and diameter_um; one of them"):
        load_whisker(path)
