"""Recordings come back from their files as they went in."""

import os

import h5py
import numpy as np
import pytest
import xarray as xr

from vibrissa import samples
from vibrissa.io import kind_of, load_recording, save_recording
from vibrissa.recording import Recording
from vibrissa.simulation import facing_peg, measure, simulate, whisking

WHISKER = samples.gamma()
PEG = facing_peg(WHISKER)


@pytest.fixture(scope="module")
def recording():
    return measure(simulate(WHISKER, whisking(duration=0.12, rate=100.0), PEG))


def test_nothing_is_lost(tmp_path, recording):
    path = tmp_path / "trial.nc"
    save_recording(path, recording)
    again = load_recording(path)
    xr.testing.assert_identical(again, recording)
    for node, other in zip(recording.subtree, again.subtree, strict=True):
        for name, variable in node.data_vars.items():
            assert other[name].dtype == variable.dtype, name
    np.testing.assert_array_equal(Recording(again).whisker().centerline(9), WHISKER.centerline(9))
    assert kind_of(path) == "vibrissa recording"


def test_dimensions_are_in_the_usual_order_whatever_the_file(tmp_path, recording):
    """As after editing with other programs; readers take arrays by position."""
    edited = recording.copy()
    for group in (edited, edited["truth"]):
        data = group.to_dataset(inherit=False)
        group.dataset = data.transpose(*list(data.sizes)[::-1])
    assert edited["force"].dims != recording["force"].dims
    save_recording(tmp_path / "trial.nc", edited)
    xr.testing.assert_identical(load_recording(tmp_path / "trial.nc"), recording)


def test_the_file_is_replaced_whole_or_not_at_all(tmp_path, recording):
    path = tmp_path / "trial.nc"
    save_recording(path, recording)
    before = path.read_bytes()
    spoilt = recording.copy()
    spoilt.dataset = recording.to_dataset().assign(broken=("time", [object()] * 12))
    with pytest.raises((TypeError, ValueError)):
        save_recording(path, spoilt)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["trial.nc"]
    save_recording(path, recording)
    xr.testing.assert_identical(load_recording(path), recording)


def test_what_is_no_recording(tmp_path, recording):
    with pytest.raises(ValueError, match="not a recording"):
        save_recording(tmp_path / "a.nc", xr.DataTree(xr.Dataset()))
    with pytest.raises(FileNotFoundError, match="folder"):
        save_recording(tmp_path / "none" / "a.nc", recording)
    with pytest.raises(ValueError, match="is a folder"):
        save_recording(tmp_path, recording)
    with pytest.raises(FileNotFoundError, match="there is no file"):
        load_recording(tmp_path / "none.nc")
    with pytest.raises(ValueError, match="is a folder"):
        load_recording(tmp_path)
    path = tmp_path / "whisker.nc"
    WHISKER.to_dataset().to_netcdf(path, engine="h5netcdf")
    with pytest.raises(ValueError, match="contains vibrissa whisker, not a recording"):
        load_recording(path)
    xr.Dataset({"a": 1.0}).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(ValueError, match="another kind"):
        load_recording(path)


def test_a_recording_whose_time_was_deleted_is_said_to_be_incomplete(tmp_path, recording):
    save_recording(tmp_path / "trial.nc", recording)
    with h5py.File(tmp_path / "trial.nc", "r+") as file:
        del file["time"]
    with pytest.raises(ValueError, match=r"trial\.nc is incomplete .* deleted"):
        load_recording(tmp_path / "trial.nc")


def test_damaged_files(tmp_path, recording):
    path = tmp_path / "trial.nc"
    save_recording(path, recording)
    whole = path.read_bytes()
    for content, message in (
        (b"", "is empty"),
        (whole[: len(whole) // 2], "cut off"),
        (b"time,Fx\n1,2\n", "another format"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            load_recording(path)
