"""The figure of a face shows its whiskers, what they touch and where, in mm and to one scale."""

import numpy as np
import pytest
import xarray as xr

import vibrissa as vb
from vibrissa.objects import Box, Mesh, Peg, Plane, Sphere, objects_datasets
from vibrissa.plots import array_views
from vibrissa.plots.array import ROW_COLOURS
from vibrissa.scene import head_surfaces, object_surface
from vibrissa.simulation import array_whisking, simulate

ARRAY = vb.whisker_array(rows="BC", columns=[1, 2])
BALL = Sphere([24e-3, 6e-3, -8e-3], 8e-3)
VIEWS = [(0, 1), (0, 2), (1, 2)]


@pytest.fixture(scope="module")
def trial():
    motions = array_whisking(ARRAY, 0.1, 200.0)
    return simulate(ARRAY, motions, [BALL, Plane([0.0, 0.0, -60e-3], [0.0, 0.0, 1.0])])


def drawn(axes):
    """Lines of a panel by their numbers of points."""
    return [np.array(line.get_data()) for line in axes.lines]


def test_an_array_at_rest_to_one_scale():
    figure = array_views(ARRAY.to_tree())
    figure.draw_without_rendering()
    flat = figure.axes[:3]
    scales = [
        axes.bbox.size[k] / abs(np.ptp(limits))
        for axes in flat
        for k, limits in enumerate((axes.get_xlim(), axes.get_ylim()))
    ]
    assert np.ptp(scales) < 1e-9 * scales[0]
    lines = ARRAY.centerlines() * 1e3
    for axes, view in zip(flat, VIEWS, strict=True):
        for line, shown in zip(lines, drawn(axes), strict=False):
            np.testing.assert_allclose(shown, line[:, view].T, atol=1e-12)
    # From the front one sees the animal's right on the left.
    assert flat[1].get_xlim()[0] > flat[1].get_xlim()[1]
    assert [line.get_color() for line in flat[0].lines[:4]] == [ROW_COLOURS[r] for r in "BBCC"]


def test_contact_points_of_a_trial(trial):
    truth = trial["truth"].to_dataset()
    touching = truth["in_contact"].values
    assert touching.any()
    frame = int(touching.sum(axis=1).argmax())
    figure = array_views(trial)
    shown = np.concatenate(drawn(figure.axes[0])[len(ARRAY) : 2 * len(ARRAY)], axis=1)
    points = truth["contact_point"].transpose("whisker", "time", "space").values
    wanted = points[touching.T][:, :2].T * 1e3
    np.testing.assert_allclose(shown, wanted, atol=1e-12)
    now = drawn(figure.axes[0])[-1]
    np.testing.assert_allclose(
        now.T, truth["contact_point"].values[frame, touching[frame]][:, :2] * 1e3
    )
    texts = [text.get_text() for text in figure.texts]
    count, when = int(touching[frame].sum()), f"{trial['time'].values[frame]:.3f} s"
    assert any(text.endswith(f"; {count} touch at {when}") for text in texts)


def test_a_recording_without_truth_shows_its_own_points(trial):
    known = trial.to_dataset().assign(
        contact_point=trial["truth"]["contact_point"], centerline=trial["truth"]["centerline"]
    )
    plain = xr.DataTree(known)
    assert array_views(plain, contacts="/", frame=3, width="single").axes
    with pytest.raises(ValueError, match="no contact points in its group 'estimates'"):
        array_views(plain, contacts="estimates")
    with pytest.raises(ValueError, match="frame is 999"):
        array_views(trial, frame=999)
    with pytest.raises(ValueError, match="no centrelines"):
        array_views(xr.DataTree(known.drop_vars("centerline")))


def test_objects_as_triangles_lie_on_their_surfaces(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.icosphere(subdivisions=1, radius=4.0).export(tmp_path / "ball.ply")
    limits = np.array([[-30.0, 30.0], [-20.0, 40.0], [-50.0, 10.0]])
    things = [
        BALL,
        Peg([20e-3, 0.0, 0.0], [0.1, 0.0, 1.0], 2e-3),
        Plane([0.0, 10e-3, 0.0], [0.0, -1.0, 0.2]),
        Box([10e-3, 0.0, 0.0], [4e-3, 6e-3, 8e-3]),
        Mesh.load(tmp_path / "ball.ply", 1e-3),
    ]
    for thing, dataset in zip(things, objects_datasets(things).values(), strict=True):
        corners = object_surface(dataset, limits)[0] * 1e-3
        loose = 2e-4 if isinstance(thing, Mesh) else 1e-12
        np.testing.assert_allclose(thing.signed_distance(corners), 0.0, atol=loose)
    with pytest.raises(ValueError, match="of kind 'torus'"):
        object_surface(xr.Dataset(attrs={"kind": "torus"}), limits)


def test_the_sketched_head_holds_the_bases_and_moves():
    skin = head_surfaces(np.eye(3), np.zeros(3))[0].reshape(-1, 3)
    for whisker in vb.whisker_array().values():
        away = np.linalg.norm(skin - whisker.pose.origin * 1e3, axis=1).min()
        assert away < 2.0
    moved = head_surfaces(np.eye(3), np.array([0.0, 0.0, 5e-3]))[0].reshape(-1, 3)
    np.testing.assert_allclose(moved - skin, np.tile([0.0, 0.0, 5.0], (len(skin), 1)), atol=1e-12)
