"""What is declared of a recording holds of those that are made, and the accessor keeps to it."""

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa import samples
from vibrissa.cli.app import app
from vibrissa.objects import Sphere, objects_datasets
from vibrissa.quantities import attributes
from vibrissa.recording import (
    VARIABLES,
    Group,
    Recording,
    coordinates,
    faults_in,
    recorded,
    recording_tree,
)
from vibrissa.simulation import facing_peg, measure, simulate, whisking

WHISKER = samples.gamma()
FRAMES, SPACE = 4, 3
PLAIN = {"float": np.float64, "bool": bool, "int": np.int64}


@pytest.fixture(scope="module")
def trial():
    return measure(simulate(WHISKER, whisking(duration=0.05, rate=100.0), facing_peg(WHISKER)))


def test_a_simulated_recording_is_as_declared(trial):
    for name in ("", "truth"):
        group = Recording(trial)[name]
        assert not faults_in(group.data)
        for variable in map(str, group.data.data_vars):
            about = VARIABLES[variable]
            assert name in about.groups, variable
            assert group.data[variable].dims == about.dims
            assert group.data[variable].attrs["units"] == attributes(variable)["units"]


@pytest.mark.parametrize("name", sorted(VARIABLES))
def test_values_come_back_in_the_declared_order(name):
    """Whatever the order of dimensions in the dataset, and of one whisker as of all."""
    about = VARIABLES[name]
    three = {"space", "space_", "whisker_axis", "head_axis"}
    sizes = [SPACE if dim in three else 2 + i for i, dim in enumerate(about.dims)]
    values = np.arange(np.prod(sizes)).reshape(sizes).astype(PLAIN[about.kind])
    data = xr.Dataset({name: recorded(name, values).transpose(*reversed(about.dims))})
    np.testing.assert_array_equal(Group(data)[name], values)
    assert Group(data)[name].dtype.kind == np.dtype(PLAIN[about.kind]).kind
    if "whisker" in about.dims:
        one = Group(data).whisker(1)[name]
        np.testing.assert_array_equal(one, values.take(1, axis=about.dims.index("whisker")))
        again = recorded(name, one)
        assert again.sizes["whisker"] == 1
        np.testing.assert_array_equal(again.values.take(0, axis=about.dims.index("whisker")), one)


def test_missing_truth_is_false_and_other_names_of_dimensions_are_known():
    touching = recorded("in_contact", np.array([[1.0], [np.nan], [0.0]]))
    group = Group(xr.Dataset({"in_contact": touching}))
    assert group["in_contact"].tolist() == [[True], [False], [False]]
    spread = recorded("contact_covariance", np.ones((FRAMES, 1, 3, 3)))
    data = xr.Dataset({"contact_covariance": spread}).rename(space_="space_2")
    assert Group(data)["contact_covariance"].shape == (FRAMES, 1, 3, 3)
    assert Group(data).known("arc_length") is None


@pytest.mark.parametrize(
    ("variable", "reason"),
    [
        (xr.Variable(("time", "space"), np.zeros((2, 2))), "space has 3 dimensions"),
        (xr.Variable(("time", "place"), np.zeros((2, 3))), "has the dimensions"),
        (xr.Variable(("time", "space"), np.array([["a"] * 3])), "not numbers"),
    ],
)
def test_what_is_of_another_shape_or_type_is_refused(variable, reason):
    with pytest.raises(ValueError, match=reason):
        Group(xr.Dataset({"force": variable}))["force"]


def test_what_is_missing_is_named(trial):
    recording = Recording(trial)
    with pytest.raises(ValueError, match=r"lacks trace; it has .*force"):
        recording.root["trace"]
    with pytest.raises(ValueError, match=r"no group signals .*truth"):
        recording["signals"]
    with pytest.raises(ValueError, match="whisker 3 was asked for"):
        recording.root.whisker(3)
    with pytest.raises(ValueError, match="the shapes of 1 whiskers, not of"):
        recording.whisker(1)
    with pytest.raises(ValueError, match="no cameras"):
        _ = recording.cameras
    with pytest.raises(ValueError, match="not a variable of a recording"):
        recorded("colour", np.zeros(3))
    with pytest.raises(ValueError, match="are needed"):
        recorded("force", np.zeros(3))


def test_whiskers_and_objects_come_back(trial):
    recording = Recording(trial)
    assert recording.names == [WHISKER.name]
    assert recording.whisker().length == WHISKER.length
    assert len(recording.pegs) == len(recording.objects) == 1
    known = recording.known("contact_point", ("estimates", "", "truth"))
    np.testing.assert_array_equal(known, recording["truth"]["contact_point"])


def _two_whiskers():
    """A recording of two whiskers of different length, without contacts."""
    time = np.arange(3.0)
    shapes = [vb.Whisker.straight(length, name=name) for length, name in ((0.03, "a"), (0.04, "b"))]
    still = np.tile(np.eye(3), (3, 2, 1, 1))
    values = {"base_position": np.zeros((3, 2, 3)), "base_rotation": still}
    root = xr.Dataset(
        {name: recorded(name, array) for name, array in values.items()},
        coordinates(time, ["a", "b"]),
    )
    return recording_tree(root, shapes, "made by hand")


@pytest.mark.parametrize("kept", [[1], [1, 0]])
def test_selected_whiskers_keep_their_shapes(kept, tmp_path):
    """Groups are of no dimension, so that selection along ``whisker`` leaves them as they are."""
    part = _two_whiskers().isel(whisker=kept)
    vb.io.save_recording(tmp_path / "part.nc", part)
    for tree in (part, vb.load_recording(tmp_path / "part.nc")):
        found = Recording(tree)
        assert [one.name for one in found.whiskers] == found.names


def test_renamed_whiskers_are_in_order_and_other_labels_are_refused():
    tree = _two_whiskers()
    tree.dataset = tree.to_dataset().assign_coords(whisker=["c", "d"])
    with pytest.warns(UserWarning, match="matched in order: c has that of a, d has that of b"):
        assert [one.name for one in Recording(tree).whiskers] == ["a", "b"]
    with pytest.raises(ValueError, match="contains the shapes of a, b"):
        _ = Recording(tree.isel(whisker=[1])).whiskers


@pytest.mark.parametrize(
    ("edit", "fault"),
    [
        (
            lambda d: d.assign(base_position=d["base_position"].assign_attrs(units="mm")),
            "base_position is in mm; m is",
        ),
        (
            lambda d: d.assign_coords(time=d["time"].assign_attrs(units="ms")),
            "time is in ms; s is needed",
        ),
        (lambda d: d.isel(space=[1, 2, 0]), "space is y, z, x; x, y, z is needed"),
        (lambda d: d.drop_vars("time"), "without a coordinate time"),
        (lambda d: d.drop_vars("whisker"), "without a coordinate whisker"),
        (lambda d: d.isel(whisker=0), r"lacks the dimensions whisker.*isel\(whisker=\[0\]\)"),
        (lambda d: d.assign_coords(whisker=["a", "a"]), "share a name"),
        (lambda d: d.assign_coords(time=d["time"].values.astype("M8[ns]")), "numbers are needed"),
    ],
)
def test_what_was_edited_by_hand_is_refused(edit, fault):
    data = edit(_two_whiskers().to_dataset())
    with pytest.raises(ValueError, match=fault):
        vb.pipeline.check_recording(xr.DataTree(data))


def test_faults_of_the_truth_are_named():
    tree = _two_whiskers()
    tree["truth"] = xr.DataTree(tree.to_dataset()[["base_position"]] * 1e3)
    tree["truth/base_position"].attrs["units"] = "mm"
    with pytest.raises(ValueError, match="in the group truth, base_position is in mm; m is"):
        vb.pipeline.check_recording(tree)


@pytest.mark.parametrize(
    "place",
    [
        "time",
        "objects/0",
        *(
            pytest.param(at, marks=pytest.mark.slow)
            for at in ("base_position", "whiskers/0/length")
        ),
    ],
)
def test_units_that_a_file_does_not_state_are_named(place, tmp_path):
    tree = _two_whiskers()
    tree["objects/0"] = _ball()
    at = tree[place]["object_radius"] if place == "objects/0" else tree[place]
    del at.attrs["units"]
    vb.io.save_recording(path := tmp_path / "bare.nc", tree)
    name = "object_radius" if place == "objects/0" else place.split("/")[-1]
    with pytest.warns(UserWarning, match=f"no units of {name}; SI units are assumed"):
        vb.load_recording(path)
    if place == "time":
        with pytest.warns(UserWarning, match="no units of time"):
            CliRunner().invoke(app, ["info", str(path)])


def test_objects_may_have_names_and_single_whiskers_no_dimension(tmp_path):
    tree = _two_whiskers()
    tree["objects/ball"] = _ball()
    assert len(Recording(tree).objects) == 1
    assert [one.name for one in Recording(tree.isel(whisker=1)).whiskers] == ["b"]


def test_single_precision_is_enough(tmp_path):
    tree = _two_whiskers()
    tilted = vb.Whisker.from_points(vb.Whisker.straight(0.03).centerline(9) @ _turned(0.7))
    tree["whiskers/0"].dataset = tilted.to_dataset().drop_dims("node").assign_attrs(name="a")
    vb.io.save_recording(path := tmp_path / "single.nc", tree.map_over_datasets(_single))
    np.testing.assert_allclose(Recording(vb.load_recording(path)).whisker().length, 0.03, rtol=1e-6)


def _ball():
    (data,) = objects_datasets([Sphere([0.0, 0.0, 0.0], 1e-3)]).values()
    return xr.DataTree(data.drop_vars("space"))


def _turned(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _single(data):
    wide = [name for name, variable in data.data_vars.items() if variable.dtype == np.float64]
    return data.assign({name: data[name].astype(np.float32) for name in wide})


def test_info_states_what_is_wrong(tmp_path):
    vb.io.save_recording(tmp_path / "back.nc", _two_whiskers().isel(time=slice(None, None, -1)))
    done = CliRunner().invoke(app, ["info", str(tmp_path / "back.nc")])
    assert "time does not increase" in str(done.exception)
