"""A trial as it is shown: what is known of it, in space, in images, over time."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import xarray as xr

import vibrissa as vb
from vibrissa.contour import fit_free, fit_shape
from vibrissa.io import Footage, write_video
from vibrissa.recording import Recording
from vibrissa.viewer.readout import CONTACT, chart, cursor
from vibrissa.viewer.trial import (
    LAYERS,
    fitted_body,
    legends,
    moment_drawing,
    picture,
    surroundings,
    touched,
    views,
    watched,
)

MM = 1e3


@pytest.fixture(scope="module")
def trial(recording):
    return watched(recording)


def test_a_trial_is_what_was_simulated(trial, recording):
    truth = recording["truth"].to_dataset()
    touching = truth["in_contact"].values.astype(bool)
    np.testing.assert_array_equal(trial.touching, touching)
    np.testing.assert_array_equal(trial.lines, truth["centerline"].values)
    np.testing.assert_array_equal(trial.contacts[touching], truth["contact_point"].values[touching])
    assert np.isnan(trial.contacts[~touching]).all()
    signals = vb.base_signals(recording["force"].values, recording["moment"].values)
    np.testing.assert_array_equal(trial.signals["MB"], signals["MB"])
    # A force in the laboratory is as large as at the base.
    sizes = np.linalg.norm(recording["force"].values, axis=-1)
    np.testing.assert_allclose(np.linalg.norm(trial.forces, axis=-1), sizes, atol=1e-12)


def test_stages_count_before_the_truth(recording):
    other = recording.copy()
    point = recording["truth"]["contact_point"] + 1e-3
    felt = recording["truth"]["in_contact"]
    other["estimates"] = xr.DataTree(
        xr.Dataset({"contact_point": point.drop_vars("time", errors="ignore"), "in_contact": felt})
    )
    shifted, plain = watched(other), watched(recording)
    np.testing.assert_allclose(shifted.contacts, plain.contacts + 1e-3)


def test_poses_alone_are_enough(recording):
    bare = recording.copy()
    bare.dataset = bare.to_dataset()[["base_position", "base_rotation"]]
    bare.dataset.attrs |= recording.attrs
    for group in ("truth", "cameras", "objects"):
        del bare[group]
    trial = watched(bare)
    rest = vb.samples.gamma().length
    size = np.linalg.norm(np.diff(trial.lines, axis=2), axis=-1).sum(axis=-1)
    np.testing.assert_allclose(size, rest, rtol=1e-3)
    assert not trial.touching.any()
    assert touched(trial, trial.frames - 1) == {}
    assert "whisker 0" in moment_drawing(trial, 3, 5.0)
    assert views(trial) == ()
    assert trial.onset_from(5) == trial.onset_from(5, ahead=False) == 5


def test_contacts_appear_one_by_one(trial):
    counts = [
        len(drawn["contacts"].points) if (drawn := touched(trial, frame)) else 0
        for frame in range(trial.frames)
    ]
    np.testing.assert_array_equal(counts, np.cumsum(trial.touching[:, 0]))


def test_onsets_are_reached_in_either_direction(trial):
    onsets = trial.onsets().tolist()
    assert len(onsets) > 1
    for frame, following in zip(onsets, onsets[1:] + onsets[:1], strict=True):
        assert trial.touching[frame, 0]
        assert not trial.touching[frame - 1, 0]
        assert trial.onset_from(frame) == following
        assert trial.onset_from(following, ahead=False) == frame
        assert trial.onset_from(frame + 1, ahead=False) == frame


def test_a_click_finds_the_contact_that_is_seen_there(trial):
    last = trial.frames - 1
    frames = np.flatnonzero(trial.touching[:, 0])
    point = trial.contacts[frames[0], 0]
    eye = point + np.array([0.02, -0.06, 0.05])
    size = 0.02 * trial.whiskers[0].length
    found = trial.contact_at(last, eye, 3.0 * (point - eye))
    assert np.linalg.norm(trial.contacts[found, 0] - point) < 3.0 * size
    assert trial.contact_at(int(frames[0]), eye, point - eye) == frames[0]
    assert trial.contact_at(int(frames[0]) - 1, eye, point - eye) is None  # not there yet
    assert trial.contact_at(last, eye, eye - point) is None  # behind the eye
    assert trial.contact_at(last, eye, np.array([1.0, 0.0, 0.0])) is None


def test_a_moment_shows_whisker_contact_and_force(trial):
    frame = int(np.argmax(np.nan_to_num(trial.signals["MB"][:, 0]) * trial.touching[:, 0]))
    drawn = moment_drawing(trial, frame, 5.0)
    assert {"whisker 0", "contact 0", "force 0"} <= drawn.keys()
    np.testing.assert_allclose(drawn["force 0"].end[0], trial.contacts[frame, 0] * MM)
    free = int(np.flatnonzero(~trial.touching[:, 0])[0])
    assert drawn.keys() - moment_drawing(trial, free, 5.0).keys() == {"contact 0", "force 0"}


def test_a_fitted_cylinder_lies_where_it_was_fitted(trial, recording):
    peg = Recording(recording).pegs[0]
    near = trial.contacts[trial.touching]
    normals = recording["truth"]["surface_normal"].values[trial.touching]
    fit = fit_shape("cylinder", near, whisker_radius=np.full(len(near), 50e-6), normals=normals)
    vertices, faces = fitted_body(fit.to_dataset(), near)
    assert faces.max() < len(vertices)
    np.testing.assert_allclose(fit.signed_distance(vertices[:-2]), 0.0, atol=1e-9)
    heights = [(points - peg.origin) @ peg.axis for points in (vertices, near)]
    assert heights[0].min() < heights[1].min() < heights[1].max() < heights[0].max()


@pytest.mark.parametrize(
    "fit", [partial(fit_shape, "sphere"), partial(fit_shape, "plane"), fit_free]
)
def test_other_fitted_shapes_have_a_picture_too(fit):
    rng = np.random.default_rng(0)
    toward = rng.normal(size=(60, 3)) * [0.4, 0.4, 0.0] + [0.0, 0.0, 1.0]
    points = 8e-3 * toward / np.linalg.norm(toward, axis=1, keepdims=True)
    shape = fit(points)
    vertices, faces = fitted_body(shape.to_dataset(), points)
    assert np.isfinite(vertices).all()
    assert faces.max() < len(vertices)
    np.testing.assert_allclose(shape.signed_distance(vertices), 0.0, atol=2e-4)


def test_an_unknown_shape_has_no_picture(trial):
    assert (
        fitted_body(xr.Dataset(attrs={"shape": "unheard of"}), trial.contacts[trial.touching])
        is None
    )


def test_surroundings_can_be_hidden(trial):
    assert {"object 0", "ruler"} <= set(surroundings(trial))
    assert surroundings(trial, layers=()) == {}


def test_contacts_can_be_hidden(trial):
    frame = int(np.flatnonzero(trial.touching[:, 0])[0])
    layers = set(LAYERS) - {"Contacts"}
    hidden = moment_drawing(trial, frame, 5.0).keys() - moment_drawing(trial, frame, 5.0, layers)
    assert hidden == {"contact 0"}


def test_pictures_show_the_trace_where_the_camera_sees_the_whisker(trial, recording):
    shown = views(trial)
    assert [view.name for view in shown] == ["top", "front"]
    frame = trial.onset_from(0)
    for view in shown:
        image = picture(view, trial, frame)
        blue = (image == [0, 150, 255]).all(axis=-1)
        places = trial.traces[frame, 0, view.number]
        inside = np.round((places - view.box[:2]) * view.scale).astype(int)
        height, width = blue.shape
        for x, y in inside[3:-3]:
            near = blue[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
            over = image[min(y, height - 1), min(x, width - 1)]  # the contact covers it
            assert near.any() or (over == CONTACT).all()
        dark = np.full(recording["cameras"]["image_size"].values[view.number][::-1], 9, np.uint8)
        assert (picture(view, trial, frame, dark) == 9).any()


def test_a_video_is_read_in_any_order(tmp_path):
    frames = [np.full((48, 64), value, np.uint8) for value in range(0, 250, 2)]
    for name, tolerance in (("a.mkv", 0), ("a.mp4", 3)):
        write_video(tmp_path / name, iter(frames), 50.0)
        footage = Footage(tmp_path / name)
        for number in (0, 1, 2, 100, 99, 98, 3, 124, 64, 64, 0):
            shown = footage.frame(number).astype(int)
            assert np.abs(shown - 2 * number).max() <= tolerance
        with pytest.raises(ValueError, match="ends before frame 125"):
            footage.frame(125)
        with pytest.raises(ValueError, match="numbered from 0"):
            footage.frame(-1)
        footage.close()


def test_the_chart_has_six_lines_and_shades_contacts(trial):
    signals = {name: values[:, 0] for name, values in trial.signals.items()}
    drawn = chart(trial.time, signals, trial.touching[:, 0])
    assert len(re.findall("<path ", drawn)) == 6
    assert len(re.findall("<rect ", drawn)) == len(trial.onsets())
    assert "nan" not in drawn
    assert 'data-cursor="0.5000"' in cursor(0.5)
    # Over the timeline it is as far along.
    assert re.findall('x1="[^"]*', cursor(0.5)) == re.findall('x1="[^"]*', cursor(0.5, strip=True))


def test_a_long_line_keeps_its_extremes():
    time = np.arange(20000) * 1e-3
    values = np.zeros(20000)
    values[12345] = 1e-6
    none = {name: np.zeros(20000) for name in ("FT", "FD", "Mx", "MB", "MD")}
    drawn = chart(time, {"Fx": values, **none}, values > 0.0)
    line = re.findall('<path d="([^"]*)"', drawn)[0]
    heights = [float(word) for word in re.findall(r"[ML][\d.]+ ([\d.]+)", line)]
    assert len(heights) < 1500
    assert max(heights) - min(heights) > 40.0


def test_a_recording_without_frames_is_refused():
    empty = xr.DataTree(xr.Dataset(coords={"time": np.empty(0), "whisker": ["a"]}))
    with pytest.raises(ValueError, match="no frames"):
        watched(empty)


def test_several_whiskers_are_drawn_each_in_its_colour(recording):
    both = {"/": recording.to_dataset(), "/truth": recording["truth"].to_dataset(inherit=False)}
    both = {
        name: xr.concat([data, data], "whisker", data_vars="minimal") for name, data in both.items()
    }
    both["/"] = both["/"].assign_coords(whisker=["left", "right"])
    groups = {**both, "/objects": recording["objects"].to_dataset(inherit=False)}
    groups["/objects/0"] = recording["objects/0"].to_dataset(inherit=False)
    for k in "01":
        groups[f"/whiskers/{k}"] = recording["whiskers/0"].to_dataset(inherit=False)
    trial = watched(xr.DataTree.from_dict(groups))
    assert trial.names == ("left", "right")
    assert trial.busiest == 0
    late = trial.touching & (
        [False, True] | (trial.time > np.median(trial.time[trial.touching[:, 0]]))[:, None]
    )
    assert replace(trial, touching=late).busiest == 1
    frame = trial.onset_from(0) + 3
    drawn = moment_drawing(trial, frame, 5.0)
    assert {"whisker 0", "whisker 1", "contact 0", "contact 1"} <= drawn.keys()
    cloud = touched(trial, frame)["contacts"]
    assert len(cloud.points) == 2 * int(trial.touching[: frame + 1, 0].sum())
    assert len(np.unique(cloud.colours, axis=0)) == 2
    whose, rest = legends(trial, ["Contacts", "Objects"])
    assert [words for _, words in whose.steps] == ["left", "right"]
    assert {colour for colour, _ in whose.steps} == {
        "rgb({}, {}, {})".format(*colour) for colour in np.unique(cloud.colours, axis=0).tolist()
    }
    assert [words for _, words in rest.steps] == ["object"]
