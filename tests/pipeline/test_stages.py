"""Which stages of a recording are due."""

import numpy as np
import pytest
import xarray as xr

import vibrissa as vb
from vibrissa.pipeline import STAGES, check_recording, due_stages, with_group
from vibrissa.recording import coordinates, faults_in, recorded, recording_tree


@pytest.mark.parametrize(
    ("there", "last", "asked", "due"),
    [
        ((), "contour", (), STAGES),
        ((), "signals", (), ("signals",)),
        (("signals",), "signals", (), ("signals",)),
        (("signals",), "contour", (), ("estimates", "contour")),
        (STAGES, "contour", (), ("contour",)),
        (STAGES, "contour", ("estimates",), ("estimates", "contour")),
        (STAGES, "contour", ("signals",), STAGES),
        # Estimates that came without their signals are used as they are.
        (("estimates",), "contour", (), ("contour",)),
    ],
)
def test_what_is_missing_or_asked_for_is_due_and_all_that_depends_on_it(there, last, asked, due):
    groups = {f"/{name}": xr.Dataset({"x": ("time", np.zeros(1))}) for name in there}
    assert due_stages(xr.DataTree.from_dict({"/": xr.Dataset(), **groups}), last, asked) == due


@pytest.fixture(scope="module")
def stages():
    """Signals and estimates of two whiskers, of which no value matters here."""
    n = 6
    rng = np.random.default_rng(1)
    values = {name: rng.normal(size=(n, 2, 3)) for name in ("force", "moment", "base_position")}
    values["base_position"] *= 1e-3
    values["base_rotation"] = np.tile(np.eye(3), (n, 2, 1, 1))
    values |= {"in_contact": np.ones((n, 2), dtype=bool), "status": np.zeros((n, 2), dtype=np.int8)}
    held = {name: recorded(name, array) for name, array in values.items()}
    root = xr.Dataset(held, coordinates(np.arange(n) / 100.0, ["a", "b"]))
    shape = vb.Whisker.straight(0.04)
    tree = recording_tree(root.drop_vars("status"), [shape, shape], "made by hand")
    tree = with_group(tree, "signals", root)
    points = {name: recorded(name, rng.normal(size=(n, 2, 3))) for name in ("contact_point",)}
    return with_group(tree, "estimates", root[["status"]].assign(points))


def _changed(tree, group, name):
    data = (tree[group] if group else tree).to_dataset(inherit=False)
    values = data[name].values.copy()
    values[2, 1] = ~values[2, 1] if values.dtype == bool else values[2, 1] * (1.0 + 1e-15)
    out = tree.copy()
    (out[group] if group else out).dataset = data.assign({name: data[name].copy(data=values)})
    return out


@pytest.mark.parametrize(
    ("group", "name", "stage"),
    [
        ("", "force", "signals"),
        ("", "base_position", "signals"),
        ("signals", "moment", "estimates"),
        ("signals", "in_contact", "estimates"),
    ],
)
def test_what_was_edited_since_a_stage_was_made_is_stated(stages, group, name, stage):
    with pytest.warns(UserWarning, match=f"edited after its {stage} had been computed"):
        check_recording(_changed(stages, group, name))
    due = STAGES[STAGES.index(stage) :]
    assert due_stages(_changed(stages, group, name), "contour") == due


def test_times_that_seem_to_be_in_milliseconds_are_noted(stages):
    def timed(step):
        data = stages["signals"].to_dataset()[["base_position", "status"]].drop_vars("status")
        data = xr.concat([data] * 3, "time").assign_coords(time=step * np.arange(18))
        return xr.DataTree(data)

    with pytest.warns(UserWarning, match="frames 2 s apart: its time has to be in seconds"):
        check_recording(timed(2.0))
    check_recording(timed(2e-3))


def test_bases_that_seem_to_move_in_millimetres_are_noted(stages):
    data = stages["signals"].to_dataset()[["base_position"]]
    data = xr.concat([data] * 3, "time").assign_coords(time=2e-3 * np.arange(18))
    along = 2e-3 * np.sin(np.arange(18.0))[:, None, None] * np.ones(3)
    moving = data.assign(base_position=data["base_position"] + along)
    check_recording(xr.DataTree(moving))
    with pytest.warns(
        UserWarning, match=r"the base moves at [0-9.e+]+ m/s: is base_position in mm"
    ):
        check_recording(xr.DataTree(1e3 * moving))


def test_what_no_group_can_hold_is_refused(stages):
    data = stages["signals"].to_dataset()
    turned = data["base_rotation"].copy(data=data["base_rotation"].values * [1.0, 1.0, -1.0])
    status = data["status"].copy(data=np.full((6, 2), 99))
    assert faults_in(data.assign(base_rotation=turned)) == [
        "base_rotation is not a rotation in some frames"
    ]
    assert faults_in(data.assign(status=status)) == ["status holds 99, which is not a status"]


def test_selected_frames_and_whiskers_were_not_edited(stages, tmp_path):
    vb.io.save_recording(tmp_path / "t.nc", stages)
    for tree in (stages, vb.load_recording(tmp_path / "t.nc")):
        check_recording(tree)
        check_recording(tree.isel(time=slice(1, 4)))
        check_recording(tree.isel(whisker=[1]))
    # A wrench is not what a contour would be made of.
    check_recording(_changed(stages, "estimates", "contact_point"))


def test_a_selection_without_frames_or_of_one_whisker_is_named(stages):
    with pytest.raises(ValueError, match="it has 0 frames of 2 whiskers"):
        due_stages(stages.isel(time=slice(0)), "contour")
    with pytest.raises(ValueError, match=r"isel\(whisker=\[0\]\)"):
        due_stages(stages.isel(whisker=0), "contour")


def test_other_stages_are_refused():
    with pytest.raises(ValueError, match="one of signals, estimates, contour"):
        due_stages(xr.DataTree(), "tracks")
