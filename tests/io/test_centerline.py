"""Centrelines as CSV: units from the header, and errors that name the line."""

import numpy as np
import pytest

from vibrissa import samples
from vibrissa.io import load_centerline, load_whisker, save_centerline
from vibrissa.whisker import Whisker, morphology

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
    # Radii from elsewhere leave the base where the file shows it.
    for elsewhere in ({"rat": "C2"}, {"base_radius": 50e-6}):
        other = load_whisker(around, noise=0.0, **elsewhere)
        np.testing.assert_allclose(other.pose.origin, POINTS[0], rtol=0, atol=1e-9)
        assert other.base_radius < 90e-6
        assert "last point of the file" in other.notes[-1]


@pytest.mark.parametrize(
    ("radii", "turned"),
    [
        (np.linspace(95.0, 100.0, len(POINTS)), True),
        (np.where(np.arange(len(POINTS)) < 7, 80.0, 96.0), True),
        (97.0 + 3.0 * np.sin(2.5 * np.arange(len(POINTS))), False),
        (np.linspace(100.0, 95.0, len(POINTS)), False),
    ],
)
def test_radii_tell_the_base_of_rods_with_little_taper(tmp_path, radii, turned):
    rod = table(tmp_path, "x_mm,y_mm,z_mm,radius_um", POINTS * 1e3, radii)
    whisker = load_whisker(rod, noise=0.0)
    np.testing.assert_allclose(whisker.pose.origin, POINTS[-1 if turned else 0], atol=1e-9)
    assert ("last point of the file" in " ".join(whisker.notes)) == turned
    shown = abs(radii[-1] - radii[0]) > 4.0
    assert ("first point of the file was taken" in " ".join(whisker.notes)) != shown


def test_a_point_in_two_rows_states_a_jump(tmp_path):
    """Jumps of a stepped rod, exactly where the file has them, and base and tip the other way."""
    line = np.column_stack([np.linspace(0.0, 30.0, 11), np.zeros((11, 2))])
    rows = np.sort(np.append(np.arange(11), [3, 7]))
    radii = np.repeat([20.0, 50.0, 80.0], [4, 5, 4])
    whisker = load_whisker(table(tmp_path, "x_mm,y_mm,z_mm,radius_um", line[rows], radii))
    np.testing.assert_allclose(whisker.breaks, [9e-3, 21e-3], rtol=1e-9)
    np.testing.assert_allclose(whisker.radius([1e-3, 12e-3, 25e-3]), [80e-6, 50e-6, 20e-6])
    assert "jumps at 2 arc lengths" in " ".join(whisker.notes)


def test_what_a_file_does_not_state_is_noted(tmp_path):
    path = table(tmp_path, "x_mm,y_mm,z_mm", POINTS * 1e3)
    about = ("radius assumed", "Young's modulus assumed", "Poisson's ratio assumed")
    notes = load_whisker(path).notes
    for begin in about:
        assert sum(note.startswith(begin) for note in notes) == 1, begin
    stated = load_whisker(path, base_radius=9e-5, tip_radius=5e-6, youngs_modulus=2e9)
    assert [begin for begin in about if begin in " ".join(stated.notes)] == [about[2]]
    measured = table(tmp_path, "x_mm,y_mm,z_mm,radius_um", POINTS * 1e3, RADII * 1e6)
    assert "radius assumed" not in " ".join(load_whisker(measured).notes)


@pytest.mark.parametrize("radii", [(), (RADII * 1e6,)])
def test_a_centreline_without_z_is_noted(tmp_path, radii):
    rest = ",radius_um" * len(radii)
    flat = load_whisker(table(tmp_path, f"x_mm,y_mm{rest}", POINTS[:, :2] * 1e3, *radii))
    assert "the file has no column z" in flat.notes[-1]
    spatial = load_whisker(table(tmp_path, f"x_mm,y_mm,z_mm{rest}", POINTS * 1e3, *radii))
    assert "no column z" not in " ".join(spatial.notes)


def test_published_radii_where_the_caller_asks(tmp_path):
    path = table(tmp_path, "x_mm,y_mm,z_mm", POINTS * 1e3)
    whisker = load_whisker(path, rat="left C2")
    length = whisker.length
    assert whisker.base_radius == pytest.approx(float(morphology.base_radius(3, 2, length)))
    assert whisker.tip_radius == pytest.approx(float(morphology.tip_radius(3, 2, length)))
    assert "published regressions" in " ".join(whisker.notes)
    assert "radius assumed" not in " ".join(whisker.notes)
    again = Whisker.from_dataset(whisker.to_dataset())
    assert again.notes == whisker.notes
    # Of a whisker known by its length only, radii are among those of whiskers of that length.
    short = Whisker.straight(6.5e-3, rat="any")
    every = [
        morphology.base_radius(row, column, 6.5e-3) for row in range(1, 6) for column in (5, 6)
    ]
    assert min(every) < short.base_radius < max(every)
    with pytest.raises(ValueError, match="rat and a radius"):
        load_whisker(path, rat="C2", base_radius=1e-4)
    with pytest.raises(ValueError, match="F9"):
        load_whisker(path, rat="F9")


@pytest.mark.parametrize(
    ("name", "length", "beyond"),
    [
        ("C2", 43e-3, ""),
        ("C2", 12e-3, "12 mm is far from the 35 mm"),
        ("any", 70e-3, "70 mm is far from the 3.3 to 53 mm"),
        ("any", 4e-3, ""),
        ("A6", 10e-3, "in row A were measured for columns 0 to 4"),
    ],
)
def test_published_radii_beyond_their_data_are_noted(name, length, beyond):
    (note,) = Whisker.straight(length, rat=name).notes
    assert beyond in note
    assert ("extrapolated" in note) == bool(beyond)


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
        ("x_mm,y_mm,z_mm,radius_um", 1e3, RADII, "must state its unit"),
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


def test_what_a_file_leaves_open_is_noted(tmp_path):
    """A base without numbers moved the base by a row, and a column "rayon" was passed over."""
    points = samples.gamma().centerline(21) * 1e3
    lines = ["x (mm);y (mm);z (mm);rayon (mm)"]
    lines += [";".join(f"{v:.6f}" for v in [*point, 0.1]).replace(".", ",") for point in points]
    path = tmp_path / "moustache.csv"
    path.write_text("\n".join(lines))
    notes = load_whisker(path).notes
    assert any("rayon (mm)" in note for note in notes)
    assert any("first point of the file was taken as the base" in note for note in notes)
    assert not any("taken as the base" in note for note in load_whisker(path, base="last").notes)
    lines[1] = "n/a;n/a;n/a;0,1"
    path.write_text("\n".join(lines) + "\n;;;\n")
    notes = [note for note in load_whisker(path).notes if "left out" in note]
    assert len(notes) == 1
    assert notes[0].endswith("an end of the whisker among them: row 1")


def test_points_of_several_whiskers_are_refused_by_their_column(tmp_path):
    path = tmp_path / "all.csv"
    rows = [f"{name},{x},{x * x / 80},0" for name in ("C1", "C2") for x in range(0, 31, 3)]
    path.write_text("\n".join(["whisker,x_mm,y_mm,z_mm", *rows]))
    with pytest.raises(ValueError, match="2 whiskers by its column whisker: C1; C2"):
        load_whisker(path)
    path.write_text("\n".join(["whisker,x_mm,y_mm,z_mm", *rows[:11]]))
    assert load_whisker(path).length > 0.03


def test_millimetres_under_the_header_of_metres_name_the_remedy(tmp_path):
    path = tmp_path / "w.csv"
    path.write_text("\n".join([",X,Y,Z", *(f"{i},{i},{i * i / 80},0" for i in range(30))]))
    with pytest.raises(ValueError, match="millimetres must be named x_mm, y_mm, z_mm"):
        load_whisker(path)
