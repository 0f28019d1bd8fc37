"""MATLAB files: the layouts that laboratories use, in both versions of the format."""

import struct
import zlib

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from vibrissa.io import load_matlab, load_tracks
from vibrissa.io.matlab import matlab_values

generator = np.random.default_rng(0)
LENGTHS = (5, 7, 0, 6)
FRAMES = [generator.uniform(1, 30, (n, 3)) for n in LENGTHS]


def objects(items):
    array = np.empty((1, len(items)), dtype=object)
    for i, item in enumerate(items):
        array[0, i] = item
    return array


def structs(frames, **more):
    """A struct array with x, y, z as column vectors."""
    fields = {
        axis: [one[:, i, None] for one in frames]
        for i, axis in enumerate("xyz"[: frames[0].shape[1]])
    }
    fields |= more
    array = np.empty((1, len(frames)), dtype=[(name, object) for name in fields])
    for name, values in fields.items():
        for i, value in enumerate(values):
            array[name][0, i] = value
    return array


def version_73(path, variables):
    """Write what `savemat` would, as MATLAB writes it to HDF5: transposed, with references."""
    path.write_bytes(b"")
    with h5py.File(path, "w", userblock_size=512) as file:
        references = file.create_group("#refs#")

        def refer(value):
            name = f"#refs#/{len(references)}"
            write(name, value)
            return file[name].ref

        def write(name, value):
            if isinstance(value, str):
                file[name] = np.array([[ord(c)] for c in value], dtype=np.uint16)
                file[name].attrs["MATLAB_class"] = np.bytes_(b"char")
                return
            value = np.atleast_2d(value)
            if value.dtype == object:
                file.create_dataset(
                    name, data=[[refer(v)] for v in value.ravel()], dtype=h5py.ref_dtype
                )
                file[name].attrs["MATLAB_class"] = np.bytes_(b"cell")
            elif value.dtype.names and value.size > 1:
                group = file.create_group(name)
                group.attrs["MATLAB_class"] = np.bytes_(b"struct")
                for field in value.dtype.names:
                    items = [[refer(v)] for v in value[field].ravel()]
                    group.create_dataset(field, data=items, dtype=h5py.ref_dtype)
            elif value.size == 0:
                file[name] = np.array(value.shape, dtype=np.uint64)
                file[name].attrs["MATLAB_class"] = np.bytes_(b"double")
                file[name].attrs["MATLAB_empty"] = np.uint8(1)
            else:
                file[name] = value.T
                file[name].attrs["MATLAB_class"] = np.bytes_(b"double")

        for name, value in variables.items():
            write(name, value)
    content = bytearray(path.read_bytes())
    content[:19] = b"MATLAB 7.3 MAT-file"
    path.write_bytes(content)


WRITERS = (savemat, version_73)


@pytest.fixture(params=WRITERS, ids=["v5", "v7.3"])
def write(request):
    return request.param


def check(tracks, frames=FRAMES, factor=1e-3):
    line = tracks["centerline"].isel(whisker=0).values
    assert line.shape == (len(frames), max(map(len, frames)), 3)
    for row, points in zip(line, frames, strict=True):
        np.testing.assert_allclose(row[: len(points)], points * factor)
        assert np.isnan(row[len(points) :]).all()


def test_struct_array(tmp_path, write):
    path = tmp_path / "tracked.mat"
    write(path, {"tracked_3D": structs(FRAMES), "C": np.eye(4), "note": "by hand"})
    check(load_tracks(path, unit="mm", fps=300.0))
    time = [np.array([[float(i)]]) for i in (3, 4, 6, 9)]
    write(path, {"tracked_3D": structs(FRAMES, time=time)})
    tracks = load_tracks(path, unit="mm", fps=300.0)
    np.testing.assert_array_equal(tracks["frame"], [3, 4, 6, 9])
    check(tracks)


def test_cell_arrays(tmp_path, write):
    path = tmp_path / "whisker.mat"
    write(path, {"trackerData": objects(FRAMES)})
    check(load_tracks(path, unit="mm"))
    write(path, {"trackerData": objects([one.T for one in FRAMES])})
    check(load_tracks(path, unit="mm"))
    triple = {f"{axis}w3d": objects([one[:, i] for one in FRAMES]) for i, axis in enumerate("xyz")}
    write(path, triple)
    check(load_tracks(path, unit="mm"))


def test_matrices_padded_with_zeros_or_nan(tmp_path, write):
    path = tmp_path / "whisker.mat"
    for padding in (0.0, np.nan):
        padded = np.full((4, 7, 3), padding)
        for row, points in zip(padded, FRAMES, strict=True):
            row[: len(points)] = points
        write(path, {axis: padded[..., i] for i, axis in enumerate("XYZ")})
        check(load_tracks(path, unit="mm"))


def test_one_array(tmp_path, write):
    path = tmp_path / "whisker.mat"
    whole = generator.uniform(1, 30, (4, 6, 3))
    for array in (whole, whole.transpose(1, 2, 0), whole.transpose(2, 1, 0)):
        write(path, {"points": array})
        check(load_tracks(path, unit="mm"), list(whole))


def test_traces_of_several_whiskers_in_pixels(tmp_path, write):
    """As whisk's own exporter gives them: an entry a segment, with time and id."""
    flat = [one[:, :2] for one in FRAMES if len(one)]
    time, who = [0, 0, 1], [0, 1, 0]
    scalars = {"time": time, "id": who}
    more = {name: [np.array([[v]]) for v in values] for name, values in scalars.items()}
    path = tmp_path / "whiskers.mat"
    write(path, {"whiskers": structs(flat, **more)})
    trace = load_tracks(path, view="top")["trace"].isel(view=0).values
    assert trace.shape == (2, 2, 7, 2)
    for points, i, j in zip(flat, time, who, strict=True):
        np.testing.assert_allclose(trace[i, j, : len(points)], points)
    assert np.isnan(trace[1, 1]).all()


def test_several_variables_must_be_chosen_from(tmp_path, write):
    path = tmp_path / "both.mat"
    write(path, {"left": structs(FRAMES), "right": structs(FRAMES[::-1])})
    with pytest.raises(ValueError, match="in left and in right; choose one by variable="):
        load_matlab(path, unit="mm")
    check(load_matlab(path, "right", unit="mm"), FRAMES[::-1])
    with pytest.raises(ValueError, match="no whiskers frame by frame in middle; it has left"):
        load_matlab(path, "middle", unit="mm")


def test_bad_files(tmp_path, write):
    path = tmp_path / "bad.mat"
    write(path, {"a": np.eye(4)})
    with pytest.raises(ValueError, match=r"bad.mat has no whiskers frame by frame; it has a"):
        load_tracks(path, unit="mm")
    write(path, {"w": structs(FRAMES)})
    with pytest.raises(ValueError, match="unit of its points"):
        load_tracks(path)
    content = path.read_bytes()
    for end in (20, 200, len(content) // 2):
        path.write_bytes(content[:end])
        with pytest.raises(ValueError, match=r"bad.mat"):
            load_tracks(path, unit="mm")
    path.write_bytes(b"")
    with pytest.raises(ValueError, match="is empty"):
        load_matlab(path)
    path.write_bytes(b"no MATLAB file at all, but long enough" * 9)
    with pytest.raises(ValueError, match="cannot be read as a MATLAB file"):
        load_matlab(path)


@pytest.mark.parametrize("kind", [0, 8, 10, 11, 19, 255])
@pytest.mark.parametrize("compressed", [False, True])
def test_elements_of_no_kind_are_refused(tmp_path, kind, compressed):
    """Of some of these kinds the library that reads them takes the interpreter down."""
    path = tmp_path / "a.mat"
    savemat(path, {"x": np.arange(8.0)})
    content = bytearray(path.read_bytes())
    tag = struct.pack("<II", 9, 8 * 8)
    assert content.count(tag) == 1
    content[content.index(tag)] = kind
    if compressed:
        packed = zlib.compress(content[128:])
        content[128:] = struct.pack("<II", 15, len(packed)) + packed
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"a\.mat.*of the unknown type {kind}"):
        matlab_values(path)
