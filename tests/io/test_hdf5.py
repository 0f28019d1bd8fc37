"""Files that are damaged, or made to do harm, end in one line that names them."""

import random
import warnings

import h5py
import numpy as np
import pytest
import xarray as xr
from h5py import h5d, h5s, h5t
from typer.testing import CliRunner

from vibrissa import samples
from vibrissa.cli.app import app
from vibrissa.io import (
    COMPRESSED,
    kind_of,
    load_recording,
    load_signals,
    load_tracks,
    netcdf,
    netcdf_image,
    read_dataset,
    read_tree,
    recognise,
    save_recording,
    write_netcdf,
)
from vibrissa.simulation import facing_peg, measure, simulate, whisking

WHISKER = samples.gamma()


@pytest.fixture(scope="module")
def trial():
    return measure(simulate(WHISKER, whisking(duration=0.12, rate=100.0), facing_peg(WHISKER)))


@pytest.fixture(scope="module")
def content(trial, tmp_path_factory):
    """Bytes of files as they should be, by name."""
    path = tmp_path_factory.mktemp("good") / "trial.nc"
    save_recording(path, trial)
    rng = np.random.default_rng(0)
    names = ("time", "space", "keypoint", "individual")
    poses = xr.Dataset(
        {"position": (names, rng.uniform(1, 30, (5, 2, 4, 1)))},
        {"time": np.arange(5) / 50.0, "space": ["x", "y"], "keypoint": list("abcd")},
        {"fps": 50.0, "time_unit": "seconds", "ds_type": "poses"},
    ).assign_coords(individual=["C1"])
    return {"trial.nc": path.read_bytes(), "poses.nc": bytes(netcdf_image(poses))}


def external_link(file):
    file["there"] = h5py.ExternalLink("/etc/other.h5", "/data")


def external_group(file):
    del file["truth"]
    file["truth"] = h5py.ExternalLink("other.h5", "/truth")


def external_storage(file):
    file.create_dataset("bytes", (8,), "u1", external=[("/etc/hostname", 0, 8)])


def virtual(file):
    layout = h5py.VirtualLayout((4,), "f8")
    layout[:] = h5py.VirtualSource("other.h5", "data", (4,))
    file.create_virtual_dataset("joined", layout)


def terabytes(file):
    file.create_dataset("huge", (10**6, 10**6), "f8", chunks=(100, 100), compression="gzip")


def many_gigabytes(file):
    for i in range(20):
        file.create_dataset(f"huge{i}", (10**4, 10**4), "f8", chunks=(100, 100))


def wide_text(file):
    file.create_dataset("text", (10,), "S500000000")


def one_chunk(file):
    file.create_dataset("chunk", (1,), "f8", maxshape=(None,), chunks=(10**8,))


def in_a_circle(file):
    file["truth/again"] = file["/"]


def twice(file):
    file["whiskers/again"] = file["truth"]


def by_name(file):
    file["truth/again"] = h5py.SoftLink("/")


def opaque(file):
    kind = h5t.create(h5t.OPAQUE, 8)
    kind.set_tag(b"NUMPY:|O8")
    h5d.create(file.id, b"chosen", kind, h5s.create_simple((3,)))


def too_many_scales(file):
    scales = file["truth/force"].attrs["DIMENSION_LIST"]
    del file["truth/force"]
    file["truth/force"] = np.zeros(5)
    file["truth/force"].attrs.create("DIMENSION_LIST", scales)


def reference(file):
    del file["whiskers/0/section_error"]
    file["whiskers/0"].create_dataset("section_error", data=file.ref, dtype=h5py.ref_dtype)


def compound(file):
    del file["whiskers/0/length"]
    file["whiskers/0/length"] = np.zeros(2, [("a", "f8"), ("b", "S3")])


def nothing(file):
    del file["truth/force"]
    file["truth/force"] = h5py.Empty("f8")


def of_other_shape(file):
    del file["whiskers/0/length"]
    file["whiskers/0/length"] = np.ones((2, 2))
    for name in ("x", "y"):
        file[f"whiskers/0/{name}"] = np.zeros(2)
        file[f"whiskers/0/{name}"].make_scale(name)
    for i, name in enumerate(("x", "y")):
        file["whiskers/0/length"].dims[i].attach_scale(file[f"whiskers/0/{name}"])


def no_utf8(file):
    file.attrs["source"] = "vibrissa recor\udc94ing".encode("utf-8", "surrogateescape")


HARMFUL = (
    (external_link, "out of the file"),
    (external_group, "out of the file"),
    (external_storage, "other files"),
    (virtual, "other files"),
    (terabytes, "8e.03 GB, more than"),
    (many_gigabytes, "GB, more than"),
    (wide_text, "GB, more than"),
    (one_chunk, "GB, more than"),
    (in_a_circle, "several places"),
    (twice, "several places"),
    (by_name, "soft link"),
    (opaque, "opaque"),
    (too_many_scales, "scales of others"),
    (reference, "section_error is neither numbers nor text"),
    (compound, "length is neither numbers nor text"),
    (nothing, "force is neither numbers nor text"),
    (of_other_shape, "not a recording in a known form, or damaged"),
    (no_utf8, "can't decode byte 0x94"),
)


@pytest.mark.parametrize(("spoil", "said"), HARMFUL, ids=lambda one: getattr(one, "__name__", ""))
def test_what_could_do_harm_is_refused(tmp_path, content, spoil, said):
    path = tmp_path / "trial.nc"
    path.write_bytes(content["trial.nc"])
    with h5py.File(path, "r+") as file:
        spoil(file)
    with pytest.raises(ValueError, match=said) as caught:
        load_recording(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("verb", "lost"),
    [
        ("info", "objects/0/object_radius"),
        ("export", "objects/0/object_radius"),
        ("export", "whiskers/0"),
        ("signals", "whiskers/0"),
        ("movie", "time"),
        ("report", "time"),
        ("figures", "time"),
    ],
)
def test_the_file_is_named_whose_object_or_whisker_is_damaged(
    tmp_path, monkeypatch, content, verb, lost
):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "trial.nc"
    path.write_bytes(content["trial.nc"])
    with h5py.File(path, "r+") as file:
        if lost == "time":
            file[lost][:] = file[lost][:][::-1]
        else:
            del file[lost]
            file[lost] = b"x"
    result = CliRunner().invoke(app, [verb, str(path)])
    assert isinstance(result.exception, ValueError)
    assert str(path) in str(result.exception)


def test_a_heap_through_which_there_is_no_end(tmp_path, content):
    """Zeros over text of any length, of which the library would take nothing again and again."""
    spoilt = bytearray(content["trial.nc"])
    start = spoilt.index(b"GCOL")
    spoilt[start + 16 : start + 512] = bytes(496)
    path = tmp_path / "trial.nc"
    path.write_bytes(spoilt)
    with pytest.raises(ValueError, match=r"trial\.nc: a heap of text is damaged"):
        load_recording(path)


def test_what_compresses_well_is_read(tmp_path, monkeypatch):
    """Nothing but zeros is a thousandth of its size, and no harm is meant."""
    monkeypatch.setattr(netcdf, "ALWAYS_ALLOWED", 1 << 20)
    path = tmp_path / "zeros.nc"
    data = xr.Dataset({"zeros": (("time", "node"), np.zeros((4_000, 1000)))})
    encoding = {"zeros": {**COMPRESSED, "compression_opts": 9}}
    write_netcdf(path, data, {"/": encoding})
    assert data.nbytes > netcdf.ALWAYS_ALLOWED > 10 * path.stat().st_size
    assert data.nbytes > 400 * path.stat().st_size
    assert read_dataset(path).identical(data)


def tree_in(path):
    return read_tree(path, kind_of(path), "a tree")


def test_groups_and_names_go_through_unchanged(tmp_path, trial):
    """As xarray's own files: a coordinate of a group above is written once."""
    ours, theirs = tmp_path / "ours.nc", tmp_path / "theirs.nc"
    write_netcdf(ours, trial)
    trial.to_netcdf(theirs, engine="h5netcdf")
    assert tree_in(ours).identical(tree_in(theirs))
    with h5py.File(ours) as one, h5py.File(theirs) as other:
        names = [[], []]
        one.visit(names[0].append)
        other.visit(names[1].append)
    assert sorted(names[0]) == sorted(names[1])


def test_trees_are_read_as_xarray_reads_them(tmp_path, trial):
    kinds = xr.Dataset(
        {
            "text": ("name", ["a", "bcd", ""]),
            "flag": ("name", [True, False, True]),
            "whole": ("name", np.arange(3, dtype=np.int8)),
            "holes": (("name", "free"), np.array([[np.nan, 1.0]] * 3)),
            "nothing": (("name", "zero"), np.zeros((3, 0))),
            "alone": 2.5,
            "word": "µN",
        },
        {
            "name": ["x", "yy", "z"],
            "when": ("name", np.array([0, 1, 7]).astype("M8[ns]")),
        },
        {"empty": "", "numbers": [1, 2], "number": 3.0, "unit": "µN"},
    )
    for tree in (trial, xr.DataTree.from_dict({"/": kinds[["name"]], "/below/it": kinds})):
        write_netcdf(tmp_path / "tree.nc", tree)
        found = tree_in(tmp_path / "tree.nc")
        with xr.open_datatree(tmp_path / "tree.nc", engine="h5netcdf") as known:
            xr.testing.assert_identical(found, known.load())
            for one, other in zip(found.subtree, known.subtree, strict=True):
                kept = {name: variable.dtype for name, variable in other.variables.items()}
                assert {name: variable.dtype for name, variable in one.variables.items()} == kept


@pytest.mark.parametrize("shape", [(3,), (2, 3)])
def test_numbers_without_named_dimensions_are_refused(tmp_path, trial, shape):
    write_netcdf(tmp_path / "trial.nc", trial)
    with h5py.File(tmp_path / "trial.nc", "a") as file:
        file["foreign"] = np.zeros(shape)
    with pytest.raises(ValueError, match="foreign has dimensions without names"):
        load_recording(tmp_path / "trial.nc")


def removed(file, chosen):
    """Delete a variable, a group, or an attribute of one."""
    held = []
    file.visit(held.append)
    name = chosen.choice(held)
    attributes = file[name].attrs
    if len(attributes) and chosen.random() < 0.5:
        del attributes[chosen.choice(sorted(attributes))]
    else:
        del file[name]


def exchanged(file, chosen):
    """Give a variable other values, of another type or shape."""
    held = []
    file.visititems(lambda name, item: held.append(name) if hasattr(item, "shape") else None)
    name = chosen.choice(held)
    attributes = dict(file[name].attrs)
    del file[name]
    values = chosen.choice([np.zeros(3), np.array(1.0), np.array([b"ab"] * 3), np.full((2, 2), 7)])
    file[name] = values
    for key, value in attributes.items():
        if key not in ("DIMENSION_LIST", "REFERENCE_LIST", "CLASS", "NAME"):
            file[name].attrs[key] = value


def spoilt_attribute(file, chosen):
    held = []
    file.visititems(lambda name, item: held.append(name) if len(item.attrs) else None)
    attributes = file[chosen.choice(held)].attrs
    wrong = [b"\xff\xfe", -1, np.nan, "x", np.arange(3), h5py.Empty("f"), ""]
    attributes[chosen.choice(sorted(attributes))] = chosen.choice(wrong)


def damaged(content, path, chosen):
    """Write a file after some accident."""
    spoilt = bytearray(content)
    size = len(spoilt)
    accident = chosen.choice(["cut", "zeros", removed, exchanged, spoilt_attribute])
    if accident == "cut":
        del spoilt[chosen.randrange(1, size) :]
    elif accident == "zeros":
        at = chosen.randrange(size - 512)
        spoilt[at : at + 512] = bytes(512)
    path.write_bytes(spoilt)
    if callable(accident):
        with h5py.File(path, "r+") as file:
            accident(file, chosen)


def fault(read, path):
    try:
        read(path)
    except ValueError as error:
        return str(error)
    return None


@pytest.mark.parametrize(
    "seed", [*range(4), *(pytest.param(i, marks=pytest.mark.slow) for i in range(4, 10))]
)
@pytest.mark.parametrize("name", ["trial.nc", "poses.nc"])
def test_damage_ends_in_one_line(tmp_path, content, name, seed):
    """Or the file can be read all the same; thousands more are tried by hand."""
    path = tmp_path / name
    damaged(content[name], path, random.Random(f"{name} {seed}"))
    readers = (recognise, kind_of, load_tracks, *([load_recording] if name == "trial.nc" else ()))
    for read in readers:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            said = fault(read, path)
        assert said is None or (str(path) in said and "\n" not in said), (read, said)


def test_columns_that_are_no_numbers_are_said_with_the_file(tmp_path):
    path = tmp_path / "signals.nc"
    names = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
    data = xr.Dataset({name: ("time", np.zeros(3)) for name in names}, {"time": np.arange(3.0)})
    write_netcdf(path, data.assign(Fx=("time", ["a", "b", "c"])))
    with pytest.raises(ValueError, match=r"signals\.nc: could not convert"):
        load_signals(path)
