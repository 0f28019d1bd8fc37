"""Whiskers side by side in one group of a file come back each as it was."""

import h5netcdf
import numpy as np
import pytest
import xarray as xr

import vibrissa as vb
from vibrissa.io import RECORDING_KIND, load_recording, save_recording
from vibrissa.io.recording import separate_whiskers, stacked_whiskers

WHISKERS = [
    vb.Whisker.parabola(40e-3, 10.0, name="β"),
    vb.Whisker.straight(25e-3, name="stiff base", base_stiffness=(1e-6, 2e-6)),
    vb.Whisker.from_curvature(
        30e-3, lambda s: (0.0, 0.0, 20 + 2e3 * s), breaks=(0.01,), name='"quoted"'
    ),
]


def tree(whiskers, **other):
    groups = {
        "/": xr.Dataset({"kept": ("whisker", np.arange(3.0))}, attrs={"kind": RECORDING_KIND})
    }
    groups["/truth"] = xr.Dataset({"flag": ("whisker", [True, False, True])})
    for i, whisker in enumerate(whiskers):
        groups[f"/whiskers/{i}"] = whisker.to_dataset().drop_dims("node")
    return xr.DataTree.from_dict(groups | other)


def test_whiskers_of_different_sizes_share_a_group(tmp_path):
    recording = tree(WHISKERS)
    path = tmp_path / "trial.nc"
    save_recording(path, recording)
    with h5netcdf.File(path) as file:
        assert not file["whiskers"].groups
        assert file["whiskers/length"].shape == (3,)
        assert np.isnan(file["whiskers/curvature_knots"][1, -1])
    again = load_recording(path)
    xr.testing.assert_identical(again, recording)
    assert [node.path for node in again.subtree] == [node.path for node in recording.subtree]
    for i, whisker in enumerate(WHISKERS):
        back = vb.Whisker.from_dataset(again[f"whiskers/{i}"].to_dataset(inherit=False))
        np.testing.assert_array_equal(back.centerline(9), whisker.centerline(9))
        assert (back.name, back.breaks, back.notes) == (whisker.name, whisker.breaks, whisker.notes)
        assert back.base_stiffness == whisker.base_stiffness


def test_files_with_a_group_a_whisker_are_read(tmp_path):
    recording = tree(WHISKERS)
    recording.to_netcdf(tmp_path / "before.nc", engine="h5netcdf")
    xr.testing.assert_identical(load_recording(tmp_path / "before.nc"), recording)


def odd_dims(recording):
    del recording["whiskers"]["2"]


def odd_kind(recording):
    one = recording["whiskers/1"].to_dataset(inherit=False)
    recording["whiskers/1"] = xr.DataTree(one.assign(length=one["length"].astype("f4")))


def odd_attribute(recording):
    recording["whiskers/1"].attrs["name"] = 3


def odd_units(recording):
    recording["whiskers/1"]["length"].attrs["units"] = "mm"


def odd_variables(recording):
    recording["whiskers/1"]["extra"] = 1.0


def one_only(recording):
    del recording["whiskers"]["1"], recording["whiskers"]["2"]


@pytest.mark.parametrize(
    "change", [odd_dims, odd_kind, odd_attribute, odd_units, odd_variables, one_only]
)
def test_what_does_not_fit_keeps_its_groups(change):
    recording = tree(WHISKERS)
    assert set(stacked_whiskers(recording).groups) == {"/", "/truth", "/whiskers"}
    change(recording)
    assert stacked_whiskers(recording) is recording
    assert separate_whiskers(recording) is recording


def test_whiskers_that_are_all_the_same(tmp_path):
    recording = tree(WHISKERS[:1] * 3)
    save_recording(tmp_path / "trial.nc", recording)
    xr.testing.assert_identical(load_recording(tmp_path / "trial.nc"), recording)
