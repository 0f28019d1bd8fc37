"""Tables over a video: how the head moves, and contact points that were tracked otherwise."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vibrissa.io import load_contact_points, load_head
from vibrissa.whisker import base_rotation

TURNS = Rotation.random(6, rng=np.random.default_rng(0)).as_matrix()
ROWS = np.arange(6.0)
PLACES = np.random.default_rng(1).normal(scale=0.01, size=(6, 3))


def written(path, names, *columns):
    rows = np.column_stack(columns)
    path.write_text(
        ",".join(names) + "\n" + "\n".join(",".join(map(repr, r)) for r in rows.tolist())
    )
    return path


def quaternions(turns):
    return Rotation.from_matrix(turns).as_quat()[:, [3, 0, 1, 2]]


MATRIX = [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]


@pytest.mark.parametrize(
    ("names", "values"),
    [
        (["qw", "qx", "qy", "qz"], quaternions(TURNS)),
        (["qw", "qx", "qy", "qz"], -np.round(quaternions(TURNS), 4)),
        (MATRIX, TURNS.reshape(-1, 9)),
    ],
)
def test_every_way_of_orientation_is_the_same_rotation(tmp_path, names, values):
    path = written(
        tmp_path / "h.csv", ["frame", "x", "y", "z", *names], np.arange(6.0), PLACES, values
    )
    head = load_head(path)
    np.testing.assert_allclose(head["head_rotation"].values, TURNS, atol=1e-3)
    np.testing.assert_array_equal(head["head_position"].values, PLACES)
    np.testing.assert_array_equal(head["frame"].values, np.arange(6))


def test_angles_are_those_of_a_base(tmp_path):
    angles = np.random.default_rng(2).uniform(-1.0, 1.0, (6, 3))
    names = ["time", "azimuth", "elevation", "roll", "x", "y", "z"]
    path = written(tmp_path / "h.csv", names, np.arange(6) / 500, angles, PLACES)
    head = load_head(path)
    np.testing.assert_allclose(head["head_rotation"].values, base_rotation(*angles.T), atol=1e-12)
    assert head["head_position"].attrs["reference_frame"] == "laboratory"


def test_faults_of_a_head_are_named(tmp_path):
    q = quaternions(TURNS)
    names = ["frame", "x", "y", "z", "qw", "qx", "qy", "qz"]

    def load(frames=ROWS, places=PLACES, turns=q, names=names):
        return load_head(written(tmp_path / "h.csv", names, frames, places, turns))

    with pytest.raises(ValueError, match=r"not of unit length: 2 in row 3"):
        load(turns=q * np.where(np.arange(6) == 2, 2.0, 1.0)[:, None])
    with pytest.raises(
        ValueError, match=r"frame does not increase: 2 is followed by 1 \(rows 3 and 4"
    ):
        load(frames=np.array([0.0, 1, 2, 1, 4, 5]))
    with pytest.raises(ValueError, match="missing in rows 5"):
        load(places=np.where(np.arange(6)[:, None] == 4, np.nan, PLACES))
    with pytest.raises(ValueError, match=r"frame 0\.5 in row 2"):
        load(frames=np.arange(6) * 0.5)
    with pytest.raises(ValueError, match="an orientation are"):
        load(names=[*names[:-1], "other"])
    with pytest.raises(ValueError, match="either time or frame"):
        load(names=["number", *names[1:]])
    steep = ["frame", "x", "y", "z", "azimuth", "elevation", "roll"]
    with pytest.raises(ValueError, match="angles are in rad"):
        load(names=steep, turns=np.full((6, 3), 40.0))
    with pytest.raises(ValueError, match="matrices mirror"):
        load(names=[*names[:4], *MATRIX], turns=-TURNS.reshape(-1, 9))
    with pytest.raises(ValueError, match="not orthogonal"):
        load(names=[*names[:4], *MATRIX], turns=1.1 * TURNS.reshape(-1, 9))


def test_contact_points_in_the_laboratory(tmp_path):
    path = written(
        tmp_path / "c.csv",
        ["frame", "whisker", "x", "y", "z"],
        [3.0, 3.0, 5.0],
        [0.0, 1.0, 1.0],
        PLACES[:3],
    )
    points = load_contact_points(path)["contact_point"]
    assert dict(points.sizes) == {"frame": 2, "whisker": 2, "space": 3}
    np.testing.assert_array_equal(points.sel(frame=5, whisker=1), PLACES[2])
    assert np.isnan(points.sel(frame=5, whisker=0)).all()


def test_contact_points_in_the_views(tmp_path):
    path = written(
        tmp_path / "c.csv",
        ["view", "frame", "x", "y"],
        [0.0, 1.0, 0.0],
        [7.0, 7.0, 9.0],
        PLACES[:3, :2],
    )
    pixels = load_contact_points(path)["contact_pixel"]
    np.testing.assert_array_equal(pixels.sel(frame=7, view=1, whisker=0), PLACES[1, :2])
    assert np.isnan(pixels.sel(frame=9, view=1)).all()


def test_faults_of_contact_points_are_named(tmp_path):
    def load(names, *columns):
        return load_contact_points(written(tmp_path / "c.csv", names, *columns))

    with pytest.raises(ValueError, match="rows 2 repeat a contact of an earlier row"):
        load(["frame", "x", "y", "z"], [1.0, 1.0], PLACES[:2])
    with pytest.raises(ValueError, match="view 0 only"):
        load(["view", "frame", "x", "y"], [0.0, 0.0], [1.0, 2.0], PLACES[:2, :2])
    with pytest.raises(ValueError, match="view, frame, x, y are needed"):
        load(["time", "x", "y"], [1.0, 2.0], PLACES[:2, :2])
    with pytest.raises(ValueError, match="whisker is not a whole number"):
        load(["frame", "whisker", "x", "y", "z"], [1.0, 2.0], [-1.0, 0.0], PLACES[:2])
