"""An average rat's whiskers are those of the published equations and sit on a face."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vibrissa as vb
from vibrissa.whisker import Identity, Pose, angles_of, base_rotation, mirrored, morphology

ARRAY = vb.whisker_array()
MM = 1e-3


def tangent(whisker):
    return whisker.pose.rotation[:, 0]


def bend(whisker):
    """Unit vector toward which a whisker is concave, in the head's frame."""
    return whisker.pose.rotation[:, 1]


# Published values


def test_c2_is_as_curved_as_published():
    assert morphology.curvature_coefficient(2) * MM == pytest.approx(0.0233, abs=5e-5)
    # y = A x² has the curvature 2 A at its vertex.
    np.testing.assert_allclose(ARRAY["LC2"].curvature(0.0), [0.0, 0.0, 2 * 23.3], atol=0.1)


@pytest.mark.parametrize(
    ("name", "length"), [("α", 46.4022), ("C2", 34.9846), ("E1", 47.3606), ("C6", 3.2598)]
)
def test_lengths_with_the_greek_column_counted_as_one(name, length):
    assert ARRAY[f"R{name}"].length == pytest.approx(length * MM, rel=1e-6)


def test_radii_with_the_greek_column_counted_as_zero():
    # D = 0.041 + 0.002 S + 0.011 row − 0.0039 column, mm.
    assert ARRAY["Rγ"].base_radius == pytest.approx(
        0.5 * MM * (0.041 + 0.002 * ARRAY["Rγ"].length / MM + 0.033), rel=1e-9
    )
    assert ARRAY["RC2"].base_radius == pytest.approx(
        0.5 * MM * (0.041 + 0.002 * 34.9846 + 0.033 - 0.0078), rel=1e-6
    )
    assert morphology.radius_slope(1, 0) == pytest.approx(0.00137)
    alpha = ARRAY["Rα"]
    assert alpha.base_radius - alpha.tip_radius == pytest.approx(0.00137 * alpha.length)


def test_where_base_and_slope_contradict_each_other_the_tip_stays_and_says_so():
    assert morphology.base_radius(3, 3, 0.0271) < morphology.radius_slope(3, 3) * 0.0271
    whisker = ARRAY["LC3"]
    assert whisker.base_radius / whisker.tip_radius == pytest.approx(morphology.MOST_TAPER)
    assert any("slope" in note for note in whisker.notes)
    ratios = [w.base_radius / w.tip_radius for w in ARRAY.values()]
    assert min(ratios) > 1.0
    assert max(ratios) <= morphology.MOST_TAPER * (1 + 1e-9)


def test_no_whisker_is_more_curved_than_any_measured():
    for name, whisker in ARRAY.items():
        coefficient = morphology.curvature_coefficient(ARRAY.identity(name).column)
        assert coefficient < morphology.curvature_bound(whisker.length)
    assert morphology.curvature_bound(0.0) * MM == pytest.approx(0.171)


def test_base_points_lie_on_the_ellipsoid():
    rows, columns = np.meshgrid(np.arange(1, 6), np.arange(7))
    points = morphology.base_point(rows, columns)
    # Its axes by another construction.
    turn = Rotation.from_euler("ZYX", [106.51, -2.5211, -19.5401], degrees=True).as_matrix()
    local = (points / MM - [1.9128, -7.6549, -5.4439]) @ turn
    np.testing.assert_allclose(
        ((local / [9.5304, 5.5393, 6.9745]) ** 2).sum(axis=-1), 1.0, rtol=1e-12
    )


def test_projections_are_those_of_the_base_tangents():
    # θ is seen from above, φ from the front.
    for name, whisker in ARRAY.select(side="right").items():
        one = ARRAY.identity(name)
        theta, phi, _, _ = morphology.projection_angles(one.row_number, one.column)
        x, y, z = tangent(whisker)
        assert np.arctan2(x, -y) == pytest.approx(theta, abs=1e-12)
        assert np.arctan(z / x) == pytest.approx(phi, abs=1e-12)


@pytest.mark.parametrize(
    ("column", "rest"),
    [(0, 48.0), (1, 57.8), (2, 69.4), (3, 80.2), (4, 90.8), (5, 101.4), (6, 111.9)],
)
def test_row_c_rests_at_the_angles_of_another_paper(column, rest):
    # Hobbs, Towal & Hartmann (2015), PLoS Comput Biol 11:e1004109, Table 4; 0° is backward.
    x, y, _ = tangent(ARRAY[f"RC{column}"])
    assert np.degrees(np.arctan2(x, -y)) == pytest.approx(rest, abs=1.0)


# Plausibility on the face


def test_whiskers_point_outward_and_their_bases_are_on_their_side():
    for name, whisker in ARRAY.items():
        sign = -1.0 if name[0] == "L" else 1.0
        assert sign * whisker.pose.origin[0] > 3 * MM
        assert sign * tangent(whisker)[0] > 0.5
        assert whisker.pose.origin[1] < 0.0


def test_both_sides_are_mirror_images():
    mirror = np.array([-1.0, 1.0, 1.0])
    left, right = ARRAY.select(side="left"), ARRAY.select(side="right")
    assert len(left) == len(right) == 31
    np.testing.assert_allclose(left.centerlines(9), right.centerlines(9) * mirror, atol=1e-15)


def test_poses_are_rotations():
    for whisker in ARRAY.values():
        np.testing.assert_allclose(
            whisker.pose.rotation.T @ whisker.pose.rotation, np.eye(3), atol=1e-14
        )
        assert np.linalg.det(whisker.pose.rotation) == pytest.approx(1.0)


def test_rows_fan_out_and_row_c_is_level():
    elevation = {
        row: [np.degrees(angles_of(w.pose.rotation)[1]) for w in ARRAY.select(rows=row).values()]
        for row in "ABCDE"
    }
    assert max(map(abs, elevation["C"])) < 5.0
    middles = [np.mean(elevation[row]) for row in "ABCDE"]
    assert (np.diff(middles) < -10.0).all()
    heights = [np.mean([w.pose.origin[2] for w in ARRAY.select(rows=r).values()]) for r in "ABCDE"]
    assert (np.diff(heights) < 0.0).all()


def test_greek_whiskers_are_hindmost_and_longest():
    for row in "ABCD":
        whiskers = list(ARRAY.select(side="right", rows=row).values())
        assert (np.diff([w.pose.origin[1] for w in whiskers]) > 0.0).all()
        assert (np.diff([tangent(w)[1] for w in whiskers]) > 0.0).all()
        assert (np.diff([w.length for w in whiskers]) < 0.0).all()


def test_whiskers_are_concave_downward_and_the_front_ones_forward():
    assert bend(ARRAY["Rγ"])[2] < -0.9
    assert bend(ARRAY["RC1"])[2] < -0.99
    assert bend(ARRAY["RC6"])[1] > 0.9
    assert bend(ARRAY["LC6"])[1] > 0.9
    for row in "ABCDE":
        # Forward about the horizontal: the bend's share along the level vector that points forward.
        level = [
            bend(w) @ np.array([-tangent(w)[1], tangent(w)[0], 0.0])
            for w in ARRAY.select(side="right", rows=row).values()
        ]
        assert (np.diff(level) > 0.0).all()


# Names


@pytest.mark.parametrize(
    ("said", "name"),
    [
        ("C2", "C2"),
        ("lc2", "LC2"),
        ("left C2", "LC2"),
        ("C2_right", "RC2"),
        ("R-gamma", "Rγ"),
        ("γ", "γ"),
        ("c0", "γ"),
        ("delta left", "Lδ"),
        ("E06", "E6"),
    ],
)
def test_names_in_many_spellings(said, name):
    assert Identity.of(said).name == name


@pytest.mark.parametrize("said", ["", "F1", "C", "2C", "epsilon", "LC2R", "C12", "whisker"])
def test_what_is_no_name(said):
    with pytest.raises(ValueError, match="not a whisker's name"):
        Identity.of(said)


def test_whiskers_are_found_by_any_name():
    assert ARRAY["left gamma"] is ARRAY["Lγ"]
    assert ARRAY.select(side="left")["gamma"] is ARRAY["Lγ"]
    with pytest.raises(KeyError, match="it may be Lγ or Rγ"):
        _ = ARRAY["gamma"]
    with pytest.raises(KeyError, match="no such whisker"):
        _ = ARRAY["LA6"]
    with pytest.raises(KeyError, match="not a whisker's name"):
        _ = ARRAY["nose"]


def test_choosing():
    assert list(vb.whisker_array("left", rows="ce", columns=[0, 6])) == ["Lγ", "LC6", "LE6"]
    assert list(vb.whisker_array(names=["C2", "left alpha"])) == ["Lα", "LC2", "RC2"]
    assert list(ARRAY.select(names=["C2", "left alpha"])) == ["Lα", "LC2", "RC2"]
    assert list(ARRAY.select(side="right", columns=[6])) == ["RC6", "RD6", "RE6"]
    with pytest.raises(ValueError, match="A6 is not among"):
        ARRAY.select(names=["A6"])
    with pytest.raises(ValueError, match="row is 'F'"):
        vb.whisker_array(rows="F")
    with pytest.raises(ValueError, match="side is 'up'"):
        vb.whisker_array("up")
    with pytest.raises(ValueError, match="it is empty"):
        vb.whisker_array(rows="E", columns=[0])


# Range


def test_outside_the_range_of_the_equations_it_warns():
    with pytest.warns(UserWarning, match="A5: outside the range"):
        whisker = vb.whisker_array("left", names=["A5"])["A5"]
    assert any("outside the range" in note for note in whisker.notes)
    with pytest.warns(UserWarning, match="outside"):
        own = vb.whisker_array("left", names=["A5"], base_radius=1e-4)["A5"]
    assert any("outside the range" in note for note in own.notes)
    with pytest.raises(ValueError, match="reach to column 6"):
        vb.whisker_array(names=["A7"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        vb.whisker_array()


def test_own_properties_replace_the_published_radii():
    whisker = vb.whisker_array("left", names=["C2"], base_radius=1e-4, youngs_modulus=2e9)["C2"]
    assert whisker.base_radius == pytest.approx(1e-4)
    assert whisker.tip_radius == pytest.approx(1e-4 / 15)
    assert whisker.youngs_modulus == 2e9


# Angles


def test_angles_are_found_again_and_mirrored():
    angles = np.random.default_rng(5).uniform(-1.4, 1.4, (50, 3))
    rotation = base_rotation(*angles.T)
    np.testing.assert_allclose(angles_of(rotation), angles, atol=1e-12)
    flat = np.diag([-1.0, 1.0, 1.0])
    # The image of a whisker in its own x–y plane: its z axis turns round, to be right-handed.
    image = flat @ rotation @ np.diag([1.0, 1.0, -1.0])
    np.testing.assert_allclose(base_rotation(*mirrored(angles).T), image, atol=1e-12)


# A lab's own


def test_an_array_is_made_of_any_whiskers():
    pose = Pose(np.eye(3), [5 * MM, -3 * MM, 0.0])
    own = replace(vb.Whisker.straight(0.03, name="d3"), pose=pose)
    array = vb.WhiskerArray([own])
    assert list(array) == ["RD3"]
    with pytest.raises(ValueError, match="on the right side"):
        vb.WhiskerArray([replace(own, name="LD3")])
    with pytest.raises(ValueError, match="two of RD3"):
        vb.WhiskerArray([own, replace(own, name="Rd3")])


def test_it_shows_itself_in_a_notebook():
    html = ARRAY._repr_html_()
    assert "62: Lα" in html
    assert "3.3" in html
    assert "<svg" in html


def test_datasets_without_loss():
    tree = ARRAY.to_tree()
    root = tree.to_dataset()
    assert root["base_position"].attrs["units"] == "m"
    assert root["base_position"].attrs["reference_frame"] == "head"
    assert root["row"].sel(whisker="Lγ") == "C"
    again = vb.WhiskerArray.from_tree(tree)
    assert list(again) == list(ARRAY)
    np.testing.assert_array_equal(again.centerlines(), ARRAY.centerlines())
    assert again["LC2"].notes == ARRAY["LC2"].notes
    with pytest.raises(ValueError, match="not an array"):
        vb.WhiskerArray.from_tree(tree["whiskers"])


def test_one_name_or_column_may_be_given_alone_and_others_are_no_names():
    assert list(ARRAY.select(names="C1")) == ["LC1", "RC1"]
    assert list(ARRAY.select(side="left", rows="C", columns=2)) == ["LC2"]
    assert list(vb.whisker_array("left", rows="C", columns=2)) == ["LC2"]
    assert list(vb.whisker_array("left", names="gamma")) == ["Lγ"]
    assert list(vb.whisker_array("left", rows="C", columns=np.arange(3)[2])) == ["LC2"]
    for other in (3, None, slice(2)):
        with pytest.raises(KeyError, match="not a whisker's name"):
            ARRAY[other]


@pytest.mark.parametrize(
    ("column", "factor", "doubt"),
    [
        ("x_mm", 1e3, "m apart"),
        ("[xyz]_mm", 1e-3, "overlap"),
        ("(azimuth|elevation|roll)_deg", np.pi / 180.0, "as if they were in radians"),
        ("roll_deg", 1e3, "more than two turns"),
    ],
)
def test_poses_in_other_units_are_questioned(tmp_path, column, factor, doubt):
    vb.io.save_array(tmp_path / "rat.csv", ARRAY)
    header, *rows = [line.split(",") for line in (tmp_path / "rat.csv").read_text().splitlines()]
    for row in rows:
        for i, name in enumerate(header):
            if re.fullmatch(column, name):
                row[i] = str(factor * float(row[i]))
    vb.io.write_table(tmp_path / "other.csv", header, rows)
    with pytest.warns(UserWarning, match=doubt):
        vb.load_array(tmp_path / "other.csv")
    vb.load_array(tmp_path / "rat.csv")  # without a warning
