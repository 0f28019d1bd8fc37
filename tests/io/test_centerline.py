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
        ("x_mm,y_mm,z_mm\n1,2,3\n1,two,3\n1,2\n", "line 3 reads '1,two,3'; line 4 reads '1,2'"),
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
