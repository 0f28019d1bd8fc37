"""NWB: recordings that other programs can read, and poses that others wrote."""

from datetime import UTC, datetime

import h5py
import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

from vibrissa.io import (
    Kind,
    RawTracks,
    Session,
    join_views,
    labelled,
    load_nwb_series,
    load_tracks,
    recognise,
    save_nwb,
)
from vibrissa.quantities import attributes

pynwb = pytest.importorskip("pynwb")
ndx_pose = pytest.importorskip("ndx_pose")

START = datetime(2024, 5, 6, 12, 0, tzinfo=UTC)
SUBJECT = {"subject_id": "rat1", "species": "Rattus norvegicus", "sex": "F", "age": "P90D"}
SESSION = Session(START, subject=SUBJECT, about={"experimenter": ["Doe, Jane"]})
VIEWS = ("top", "front")


def cameras():
    """As the group of a recording: one perspective, one orthographic."""
    matrix = np.array([np.diag([2000.0, 2000.0, 1.0]), np.diag([17000.0, 17000.0, 1.0])])
    turn = np.array([np.eye(3), [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]])
    return xr.Dataset(
        {
            "camera_matrix": (("view", "row", "column"), matrix),
            "camera_rotation": (("view", "row", "column"), turn),
            "camera_translation": (("view", "row"), np.array([[0, 0, 0.3], [0.0, 0, 0]])),
            "camera_distortion": (("view", "coefficient"), np.zeros((2, 8))),
            "projection": ("view", ["perspective", "orthographic"]),
        },
        {"view": list(VIEWS)},
    )


def made():
    rng = np.random.default_rng(0)
    n, w, k = 40, 2, 5
    image = rng.uniform(1, 900, (n, w, 2, k, 2))
    space = rng.uniform(-0.02, 0.02, (n, w, k, 3))
    image[3, 1, 0, 2] = space[5, 0] = np.nan
    raw = RawTracks(
        "vibrissa",
        ["C1", "C2"],
        image=image,
        space=space,
        image_confidence=rng.uniform(0, 1, (n, w, 2, k)),
        views=VIEWS,
        nodes=[f"node_{i}" for i in range(k)],
        unit="m",
    )
    data = labelled(raw, "trial.nc", fps=1000.0)
    touching = np.zeros((n, w), dtype=bool)
    touching[10:20, 0] = touching[30:, 0] = touching[:4, 1] = True
    frames = {"force": "whisker", "moment": "whisker", "contact_point": "laboratory"}
    for name, scale in (("force", 1e-4), ("moment", 1e-6), ("contact_point", 1e-2)):
        values = np.where(touching[..., None], rng.normal(scale=scale, size=(n, w, 3)), np.nan)
        about = {**attributes(name), "reference_frame": frames[name]}
        data[name] = (("time", "whisker", "space"), values, about)
    data["in_contact"] = (("time", "whisker"), touching, attributes("in_contact"))
    data.attrs = {"kind": "vibrissa recording"}
    return xr.DataTree.from_dict({"/": data, "cameras": cameras()})


@pytest.fixture
def recording():
    return made()


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """The bytes of its file, for tests that spoil it."""
    path = tmp_path_factory.mktemp("nwb") / "trial.nwb"
    save_nwb(path, made(), SESSION)
    return path.read_bytes()


def test_written_and_read_again(tmp_path, recording):
    path = tmp_path / "trial.nwb"
    save_nwb(path, recording, SESSION)
    assert recognise(path) == "NWB file"
    tracks = load_tracks(path).sel(view=list(VIEWS))  # NWB keeps no order of cameras
    data = recording.to_dataset()
    for name in ("trace", "centerline", "trace_confidence"):
        np.testing.assert_allclose(tracks[name], data[name], rtol=1e-12, atol=1e-18)
    for name in ("whisker", "view", "node"):
        assert list(tracks[name].values) == list(data[name].values)
    np.testing.assert_allclose(tracks["time"], data["time"], atol=1e-12)
    assert tracks["centerline"].attrs["units"] == "m"
    assert tracks["centerline"].attrs["reference_frame"] == "laboratory"


def test_a_trial_that_nobody_traced_comes_back_with_its_poses(tmp_path, recording):
    path = tmp_path / "simulated.nwb"
    root = recording.to_dataset()[["force", "moment", "contact_point", "in_contact"]]
    n, w = root.sizes["time"], root.sizes["whisker"]
    turned = Rotation.random(n * w, random_state=1).as_matrix().reshape(n, w, 3, 3)
    head = Rotation.random(n, random_state=2).as_matrix()
    each = {"base_position": 1e-3 * turned[..., 0], "contact_point_whisker": 1e-2 * turned[..., 1]}
    root = root.assign({k: (("time", "whisker", "space"), v) for k, v in each.items()})
    root["base_rotation"] = (("time", "whisker", "space", "whisker_axis"), turned)
    root["head_position"] = (("time", "space"), 1e-2 * head[..., 0])
    root["head_rotation"] = (("time", "space", "head_axis"), head)
    save_nwb(path, root, SESSION)
    found = load_nwb_series(path)
    assert set(found.data_vars) == set(root.data_vars) - {"in_contact"}
    for name in found.data_vars:
        assert found[name].dims == root[name].dims
        np.testing.assert_array_equal(found[name].values, root[name].values)
        assert found[name].attrs["units"]
    np.testing.assert_allclose(found["time"], root["time"], atol=1e-12)
    assert list(found["whisker"].values) == ["C1", "C2"]
    with pytest.raises(ValueError, match="read by load_nwb_series"):
        load_tracks(path)
    nwbinspector = pytest.importorskip("nwbinspector")
    bad = ("ERROR", "PYNWB_VALIDATION", "CRITICAL")
    messages = nwbinspector.inspect_nwbfile(nwbfile_path=str(path))
    assert [m.message for m in messages if m.importance.name in bad] == []


def test_series_of_others_are_not_ours(tmp_path):
    path = tmp_path / "other.nwb"
    foreign(path, ())
    with pytest.raises(ValueError, match="not written by save_nwb"):
        load_nwb_series(path)


def test_what_another_program_finds(tmp_path, recording):
    path = tmp_path / "trial.nwb"
    save_nwb(path, recording, SESSION)
    data = recording.to_dataset()
    with pynwb.NWBHDF5IO(str(path), "r", load_namespaces=True) as io:
        file = io.read()
        behavior = file.processing["behavior"]
        for name, unit in (("force", "newtons"), ("moment", "newton-metres")):
            for i, whisker in enumerate(("C1", "C2")):
                series = behavior[f"{name}_{whisker}"]
                assert series.unit == unit
                assert "reference_frame: whisker" in series.description
                np.testing.assert_array_equal(series.data[:], data[name][:, i])
                assert series.rate == pytest.approx(1000.0)
        assert behavior["contact_point_C1"].unit == "meters"
        assert behavior["contact_point_C1"].reference_frame == "laboratory"
        pose = behavior["C2"]
        assert isinstance(pose, ndx_pose.MultiCameraPoseEstimation)
        top = file.devices["top"]
        assert isinstance(top, ndx_pose.CalibratedCamera)
        np.testing.assert_allclose(top.intrinsic_matrix[:], np.diag([2000.0, 2000.0, 1.0]))
        assert pose.pose_estimations["front"].device is file.devices["front"]
        assert "pixels per metre" in file.devices["front"].description
        assert list(pose.skeleton.nodes[:]) == [f"node_{i}" for i in range(5)]
        contacts = file.intervals["contacts"].to_dataframe()
    assert list(contacts["whisker"]) == ["C2", "C1", "C1"]
    np.testing.assert_allclose(contacts["start_time"], [0.0, 0.010, 0.030])
    np.testing.assert_allclose(contacts["stop_time"], [0.004, 0.020, 0.040])


@pytest.mark.parametrize(
    "session",
    [SESSION, pytest.param(Session(START), marks=pytest.mark.slow)],
    ids=["told", "untold"],
)
def test_nwbinspector_finds_nothing_critical(tmp_path, recording, session):
    nwbinspector = pytest.importorskip("nwbinspector")
    path = tmp_path / "trial.nwb"
    save_nwb(path, recording, session)
    messages = list(nwbinspector.inspect_nwbfile(nwbfile_path=str(path)))
    bad = ("ERROR", "PYNWB_VALIDATION", "CRITICAL")
    assert [m.message for m in messages if m.importance.name in bad] == []


def test_tracks_without_cameras_and_uneven_times(tmp_path, recording):
    path = tmp_path / "tracks.nwb"
    data = recording.to_dataset()[["trace", "trace_confidence"]]
    data = data.rename(trace_confidence="confidence").isel(time=[0, 1, 3, 4, 9, 10, 11])
    save_nwb(path, data, SESSION)
    tracks = load_tracks(path).sel(view=list(VIEWS))
    np.testing.assert_allclose(tracks["trace"], data["trace"])
    np.testing.assert_allclose(tracks["time"], data["time"])
    np.testing.assert_allclose(tracks["confidence"], data["confidence"])


def test_what_cannot_be_written(tmp_path, recording):
    path = tmp_path / "trial.nwb"
    path.write_text("old")
    data = recording.to_dataset()
    with pytest.raises(ValueError, match=r"ends in .nc; .nwb is needed"):
        save_nwb(tmp_path / "a.nc", recording, SESSION)
    with pytest.raises(ValueError, match="nothing to write"):
        save_nwb(path, data[["in_contact"]], SESSION)
    with pytest.raises(ValueError, match="no dimension whisker"):
        save_nwb(path, data.isel(whisker=0), SESSION)
    frames = data.assign_coords(time=("time", np.arange(40.0), {"units": "frame"}))
    with pytest.raises(ValueError, match="not in seconds"):
        save_nwb(path, frames, SESSION)
    with pytest.raises(ValueError, match="time zone"):
        Session(datetime(2024, 5, 6))
    # pynwb finds the fault only while it writes.
    with pytest.raises(Exception, match="bogus"):
        save_nwb(path, recording, Session(START, about={"bogus": 1}))
    assert path.read_text() == "old"
    assert [one.name for one in tmp_path.iterdir()] == ["trial.nwb"]


def foreign(path, devices, whiskers=("A",), timestamps=None, unit="pixels"):
    """As other programs write poses: one PoseEstimation a camera or an animal."""
    file = pynwb.NWBFile("session", "id", START)
    behavior = file.create_processing_module("behavior", "poses")
    points = np.random.default_rng(1).uniform(1, 900, (6, 2, 2))
    skeleton = ndx_pose.Skeleton(name="whisker", nodes=["tip", "base"])
    behavior.add(ndx_pose.Skeletons(skeletons=[skeleton]))
    for i, name in enumerate(whiskers):
        device = None
        if devices:
            device = file.devices.get(devices[i]) or file.create_device(devices[i])
        clock = {"rate": 50.0, "starting_time": 1.0}
        if timestamps is not None:
            clock = {"timestamps": timestamps + i}
        series = [
            ndx_pose.PoseEstimationSeries(
                name=node,
                data=points[:, j] + 100 * i,
                unit=unit,
                reference_frame="unknown",
                confidence=np.full(6, 0.5),
                conversion=2.0,
                **clock,
            )
            for j, node in enumerate(("base", "tip"))
        ]
        behavior.add(
            ndx_pose.PoseEstimation(
                name=name, pose_estimation_series=series, device=device, skeleton=skeleton
            )
        )
    with pynwb.NWBHDF5IO(str(path), "w") as io:
        io.write(file)
    return points


def test_poses_of_others(tmp_path):
    path = tmp_path / "other.nwb"
    points = foreign(path, ())
    tracks = load_tracks(path, view="top")
    assert list(tracks["whisker"].values) == ["A"]
    assert list(tracks["node"].values) == ["tip", "base"]
    np.testing.assert_allclose(tracks["trace"][:, 0, 0], 2.0 * points[:, ::-1])
    np.testing.assert_allclose(tracks["time"], 1.0 + np.arange(6) / 50.0)
    np.testing.assert_allclose(tracks["confidence"], 0.5)

    points = foreign(path, ("left", "right"), ("poses_left", "poses_right"))
    tracks = load_tracks(path)
    assert list(tracks["view"].values) == ["left", "right"]
    assert list(tracks["whisker"].values) == ["whisker"]
    np.testing.assert_allclose(tracks["trace"][:, 0, 1], 2.0 * (points[:, ::-1] + 100))

    foreign(path, ("left", "left"), ("A", "B"))
    assert load_tracks(path)["trace"].shape == (6, 2, 1, 2, 2)
    front = tmp_path / "front.nwb"
    foreign(front, ("left", "left"), ("A", "B"))
    both = join_views(load_tracks(path, view="top"), load_tracks(front, view="front"))
    assert both.sizes["view"] == 2

    foreign(path, (), ("A", "B"), timestamps=np.arange(6) * 0.1)
    with pytest.raises(ValueError, match=r"other.nwb has poses at different times"):
        load_tracks(path)
    foreign(path, (), unit="furlongs")
    with pytest.raises(ValueError, match="positions in furlongs"):
        load_tracks(path)


def test_bad_files(tmp_path, stored):
    path = tmp_path / "bad.nwb"
    with pynwb.NWBHDF5IO(str(path), "w") as io:
        io.write(pynwb.NWBFile("session", "id", START))
    with pytest.raises(ValueError, match=r"bad.nwb has no poses"):
        load_tracks(path)
    path.write_bytes(stored[: len(stored) // 2])
    with pytest.raises(ValueError, match=r"bad.nwb cannot be read as an? "):
        load_tracks(path)
    with h5py.File(path, "w") as file:
        file["a"] = 1
    with pytest.raises(ValueError, match="not an NWB file"):
        load_tracks(path, Kind.NWB)


def without(*names):
    def change(series):
        for name in names:
            if name in series:
                del series[name]

    return change


def instead(name, values):
    def change(series):
        if name in series:
            del series[name]
        series[name] = values

    return change


SPOILT = (
    (without("data"), "has no data"),
    (without("timestamps", "starting_time"), "neither timestamps nor a starting_time"),
    (instead("timestamps", np.array([b"now"] * 40)), "numbers are needed"),
    (instead("data", np.array([b"ab"] * 40)), "numbers are needed"),
    (instead("data", np.zeros(40)), r"shape \(40,\)"),
    (instead("confidence", np.array([b"ab"] * 40)), "numbers are needed"),
    (instead("confidence", np.zeros(3)), "confidence of another size"),
    (lambda series: series["data"].attrs.__setitem__("conversion", "mm"), "not a number"),
    (lambda series: series["data"].attrs.__setitem__("unit", "feet"), "has nodes in feet and in"),
    (instead("timestamps", 1.0 + np.arange(40)), "times that differ from those of"),
)


@pytest.mark.parametrize(("spoil", "said"), SPOILT)
def test_what_is_wrong_with_a_series_is_said(tmp_path, stored, spoil, said):
    path = tmp_path / "bad.nwb"
    path.write_bytes(stored)
    with h5py.File(path, "r+") as file:
        found = []
        file.visititems(
            lambda name, item: (
                found.append(name)
                if item.attrs.get("neurodata_type") == "PoseEstimationSeries"
                else None
            )
        )
        spoil(file[found[0]])
    with pytest.raises(ValueError, match=said) as caught:
        load_tracks(path)
    assert str(path) in str(caught.value)
    assert "Error(" not in str(caught.value)


def test_what_is_wrong_with_forces_is_said(tmp_path, stored):
    path = tmp_path / "bad.nwb"
    path.write_bytes(stored)
    for values, said in ((np.zeros((40, 2)), r"shape \(40, 2\)"), ([b"a"] * 40, "numbers are")):
        with h5py.File(path, "r+") as file:
            instead("data", values)(file["processing/behavior/force_C1"])
        with pytest.raises(ValueError, match=said):
            load_nwb_series(path)
