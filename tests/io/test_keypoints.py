"""Tables of DeepLabCut, LightningPose and Anipose, SLEAP's files, and datasets of movement.

They are made with the programs' own libraries where these are installed, else by hand.
"""

import itertools
import pickle
import warnings

import h5py
import numpy as np
import pandas as pd
import pytest
import xarray as xr

from vibrissa.io import Kind, load_tracks, recognise

PARTS = ("base", "low", "high", "tip")


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def deeplabcut(rng, individuals=("",), axes="xy", scorer="DLC_resnet50"):
    """A table as DeepLabCut's, and its points (time, whisker, node, axis) and likelihoods."""
    points = rng.uniform(1, 900, (5, len(individuals), 4, len(axes)))
    sure = rng.uniform(0, 1, points.shape[:-1])
    points[2, -1, 1] = np.nan
    coords = [*axes, "likelihood"]
    levels = [[scorer], list(individuals), PARTS, coords]
    names = ["scorer", "individuals", "bodyparts", "coords"]
    if individuals == ("",):
        del levels[1], names[1]
    columns = pd.MultiIndex.from_product(levels, names=names)
    values = np.concatenate([points, sure[..., None]], axis=-1)
    return pd.DataFrame(values.reshape(5, -1), columns=columns), points, sure


def check_image(tracks, points, sure, whiskers, nodes=PARTS, rtol=0):
    assert list(tracks["whisker"].values) == list(whiskers)
    assert list(tracks["node"].values) == list(nodes)
    np.testing.assert_allclose(tracks["trace"].isel(view=0), points, rtol=rtol)
    known = np.isfinite(points).all(axis=-1)
    np.testing.assert_allclose(
        tracks["confidence"].isel(view=0).values[known], sure[known], rtol=1e-6
    )
    assert np.isnan(tracks["confidence"].isel(view=0).values[~known]).all()


@pytest.mark.parametrize("individuals", [("",), ("C1", "C2")])
@pytest.mark.parametrize("ending", ["csv", "table.h5", "fixed.h5"])
def test_deeplabcut(tmp_path, rng, individuals, ending):
    table, points, sure = deeplabcut(rng, individuals)
    path = tmp_path / f"video.{ending}"
    if ending == "csv":
        table.to_csv(path)
    else:
        pytest.importorskip("tables")
        kind = "table" if "table" in ending else "fixed"
        table.to_hdf(path, key="df_with_missing", format=kind, mode="w")
    tracks = load_tracks(path, fps=100.0, view="top")
    check_image(tracks, points, sure, ["whisker"] if individuals == ("",) else individuals)
    assert tracks.attrs["source_software"] == "DeepLabCut"
    assert tracks.attrs["scorer"] == "DLC_resnet50"
    np.testing.assert_allclose(tracks["time"], np.arange(5) / 100.0)


def test_points_that_deeplabcut_triangulated(tmp_path, rng):
    table, points, _ = deeplabcut(rng, axes="xyz")
    path = tmp_path / "video.csv"
    table.to_csv(path)
    with pytest.raises(ValueError, match="unit of its points"):
        load_tracks(path)
    line = load_tracks(path, unit="um")["centerline"]
    np.testing.assert_allclose(line, points * 1e-6)


def test_labelled_images_and_ensembles(tmp_path, rng):
    """Frames are numbered by the images' names; other coordinates are left alone."""
    table, points, _ = deeplabcut(rng)
    table = table.drop(columns="likelihood", level="coords")
    images = [f"img{i:05d}.png" for i in (3, 8, 12, 40, 41)]
    folder = ["labeled-data"] * 5, ["video"] * 5
    table.index = pd.MultiIndex.from_arrays([*folder, images])
    path = tmp_path / "CollectedData.csv"
    table.to_csv(path)
    tracks = load_tracks(path)
    np.testing.assert_array_equal(tracks["frame"], [3, 8, 12, 40, 41])
    np.testing.assert_array_equal(tracks["trace"].isel(view=0), points)

    table, points, sure = deeplabcut(rng, scorer="heatmap_tracker")
    for part in PARTS:
        table["heatmap_tracker", part, "x_ens_var"] = 7.0
    table.to_csv(path)
    tracks = load_tracks(path)
    check_image(tracks, points, sure, ["whisker"])
    assert tracks.attrs["source_software"] == "LightningPose"


def test_rows_of_deeplabcut_that_are_written_twice_keep_their_number(tmp_path, rng):
    """So that they are noticed where frames are compared."""
    path = tmp_path / "video.csv"
    deeplabcut(rng)[0].to_csv(path)
    text = path.read_text()
    path.write_text(text + text.splitlines()[-1] + "\n")
    assert load_tracks(path)["frame"].values.tolist() == [0, 1, 2, 3, 4, 4]


def test_deeplabcut_saved_by_a_spreadsheet(tmp_path, rng):
    """Semicolons and decimal commas, UTF-16, empty columns to the right, words for missing."""
    table, points, _ = deeplabcut(rng)
    path = tmp_path / "t.csv"
    table.to_csv(path, na_rep="NA")
    plain = path.read_text().splitlines()
    european = "\r\n".join(line.replace(",", ";").replace(".", ",") for line in plain)
    contents = (
        "\n".join(f"{line},," for line in plain).encode(),
        european.encode("utf-8-sig"),
        european.replace(";", "\t").encode("utf-16"),
    )
    for content in contents:
        path.write_bytes(content)
        tracks = load_tracks(path)
        np.testing.assert_allclose(tracks["trace"][:, :, 0], points)
        assert recognise(path) == Kind.DEEPLABCUT


def test_bad_deeplabcut(tmp_path, rng):
    path = tmp_path / "video.csv"
    deeplabcut(rng)[0].to_csv(path)
    text = path.read_text()
    for spoilt, message in (
        ("", "is empty"),
        (text[: text.index("bodyparts")], "cut short"),
        (text[: text.index("coords") + 8], "different length|no rows"),
        (text[:-30], "line 8|8 has"),
        ("\n".join(text.split("\n")[:3]) + "\n", "no rows"),
        (text.rstrip() + "abc\n", "line 8 has cells that are not numbers"),
        (text.replace("coords,x,y,", "coords,x,x,"), "same name"),
        ("a,b,c\n1,2,3\n", "not a table of DeepLabCut"),
        (text[text.index("bodyparts") :], "header rows are bodyparts, coords; it lacks scorer"),
        (text.split("\n", 1)[0] + "\n" + text, "line 2 is the header row scorer a second time"),
        (text + text, "line 9 repeats the header row"),
    ):
        path.write_text(spoilt)
        with pytest.raises(ValueError, match=message) as caught:
            load_tracks(path, Kind.DEEPLABCUT)
        assert "video.csv" in str(caught.value)


_DTYPE = b"cnumpy\ndtype\n(V%s\nI00\nI01\ntR(I3\nV|\nN%sI%d\nI1\nI%d\ntb"
_OBJECT = _DTYPE % (b"O8", b"NN", -1, 63)
_POINTER = _DTYPE % (b"V8", b"(Va\nt(dVa\n(" + _OBJECT + b"I0\nts", 8, 0)
PICKLES = {
    "code": b"cos\nsystem\n(S'true'\ntR.",
    # A record with an object, of which the file chooses the pointer.
    "pointer": b"(lp0\n(Vs\nVa\ncnumpy._core.multiarray\nscalar\n("
    + _POINTER
    + b"c_codecs\nencode\n(VAAAAAAAA\nVlatin1\ntRtRta.",
    "persistent": b"(lp0\nPx\na.",
    "circle": b"(lp0\ng0\na.",
    "no list": b"Vx\n.",
    "cut": b"(lp0\n(Vs\n",
    "empty": b".",
}


@pytest.mark.parametrize("pickled", PICKLES.values(), ids=PICKLES)
def test_a_column_name_runs_no_code(tmp_path, rng, pickled):
    """The bytes of the second take the interpreter down where they are unpickled."""
    pytest.importorskip("tables")
    path = tmp_path / "video.h5"
    deeplabcut(rng)[0].to_hdf(path, key="df", format="table", mode="w")
    with h5py.File(path, "r+") as file:
        file["df/table"].attrs["values_block_0_kind"] = np.bytes_(pickled)
    with pytest.raises(ValueError, match=r"video\.h5"):
        load_tracks(path)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_names_are_read_of_every_protocol(tmp_path, rng, protocol):
    pytest.importorskip("tables")
    path = tmp_path / "video.h5"
    table, points, sure = deeplabcut(rng)
    table.to_hdf(path, key="df", format="table", mode="w")
    pickled = pickle.dumps(list(table.columns), protocol)
    with h5py.File(path, "r+") as file:
        file["df/table"].attrs["values_block_0_kind"] = np.bytes_(pickled)
    check_image(load_tracks(path), points, sure, ["whisker"])


def test_blocks_are_numbers(tmp_path, rng):
    """What pandas cannot store as numbers it pickles."""
    pytest.importorskip("tables")
    path = tmp_path / "video.h5"
    table = deeplabcut(rng)[0].astype(object)
    table.iloc[0, 0] = "one"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        table.to_hdf(path, key="df", format="fixed", mode="w")
    with pytest.raises(ValueError, match=r"video\.h5.*numbers are needed"):
        load_tracks(path)


def anipose(rng):
    points = rng.uniform(-20, 20, (6, 3, 3))
    table = {}
    for i, part in enumerate(PARTS[:3]):
        table |= {f"{part}_{axis}": points[:, i, j] for j, axis in enumerate("xyz")}
        table |= {f"{part}_error": rng.uniform(0, 2, 6), f"{part}_ncams": np.full(6, 2.0)}
        table[f"{part}_score"] = rng.uniform(0, 1, 6)
    table |= {f"M_{i}{j}": float(i == j) for i, j in itertools.product(range(3), repeat=2)}
    table |= {f"center_{i}": 0.0 for i in range(3)}
    return pd.DataFrame({**table, "fnum": np.arange(6)}), points


def test_anipose(tmp_path, rng):
    table, points = anipose(rng)
    points[2, 1] = np.nan
    table.loc[2, ["low_x", "low_y", "low_z", "low_error", "low_ncams"]] = np.nan
    table.loc[2, "low_score"] = 2.0
    path = tmp_path / "trial.csv"
    table.to_csv(path, index=False)
    tracks = load_tracks(path, unit="mm", fps=300.0, reference_frame="board")
    np.testing.assert_allclose(tracks["centerline"].isel(whisker=0), points * 1e-3)
    assert list(tracks["node"].values) == list(PARTS[:3])
    assert tracks["centerline"].attrs["reference_frame"] == "board"
    assert np.isnan(tracks["confidence"].values[2, 0, 1])
    np.testing.assert_allclose(tracks["reprojection_error"][:, 0, 0], table["base_error"])
    with pytest.raises(ValueError, match="unit of its points"):
        load_tracks(path)
    with pytest.raises(ValueError, match="reach across"):
        load_tracks(path, unit="m")
    table.drop(columns="tip_z", errors="ignore").drop(columns="low_z").to_csv(path, index=False)
    with pytest.raises(ValueError, match="lacks low_z"):
        load_tracks(path, Kind.ANIPOSE, unit="mm")
    path.write_text(path.read_text()[:-30])
    with pytest.raises(ValueError, match="cells; the file may be cut short"):
        load_tracks(path, Kind.ANIPOSE, unit="mm")


def poses(rng, plural, flat=True):
    names = ("individuals", "keypoints") if plural else ("individual", "keypoint")
    axes = ["x", "y"] if flat else ["x", "y", "z"]
    points = rng.uniform(1, 30, (5, len(axes), 4, 2))
    points[1, :, 2, 0] = np.nan
    return xr.Dataset(
        {
            "position": (("time", "space", names[1], names[0]), points),
            "confidence": (("time", names[1], names[0]), rng.uniform(0, 1, (5, 4, 2))),
        },
        {
            "time": np.arange(5) / 50.0,
            "space": axes,
            names[1]: list(PARTS),
            names[0]: ["C1", "C2"],
        },
        {"fps": 50.0, "time_unit": "seconds", "ds_type": "poses", "source_software": "SLEAP"},
    )


@pytest.mark.parametrize("plural", [True, False])
def test_movement(tmp_path, rng, plural):
    data = poses(rng, plural)
    path = tmp_path / "poses.nc"
    data.to_netcdf(path, engine="h5netcdf")
    tracks = load_tracks(path)
    points = np.moveaxis(data["position"].values, (3, 2, 1), (1, 2, 3))
    check_image(tracks, points, np.swapaxes(data["confidence"].values, 1, 2), ["C1", "C2"])
    np.testing.assert_allclose(tracks["time"], data["time"])
    np.testing.assert_array_equal(tracks["frame"], np.arange(5))
    with pytest.raises(ValueError, match="50 frames per second"):
        load_tracks(path, fps=100.0)
    data = poses(rng, plural, flat=False)
    data.attrs |= {"space_unit": "mm", "time_unit": "frames"}
    data.assign_coords(time=np.arange(5)).to_netcdf(path, engine="h5netcdf")
    tracks = load_tracks(path, fps=50.0)
    np.testing.assert_allclose(
        tracks["centerline"], 1e-3 * np.moveaxis(data["position"].values, (3, 2, 1), (1, 2, 3))
    )
    poses(rng, plural).assign_attrs(space_unit="mm").to_netcdf(path, engine="h5netcdf")
    with pytest.raises(ValueError, match="pixels are needed"):
        load_tracks(path, Kind.MOVEMENT)
    poses(rng, plural).drop_vars("position").to_netcdf(path, engine="h5netcdf")
    with pytest.raises(ValueError, match="not a poses dataset"):
        load_tracks(path, Kind.MOVEMENT)


def sleap_analysis(path, points, sure, dims=None):
    """As SLEAP writes it: (track, xy, node, frame); or with named dimensions."""
    with h5py.File(path, "w") as file:
        if dims is None:
            file["tracks"], file["point_scores"] = (
                points.transpose(1, 3, 2, 0),
                sure.T.swapaxes(0, 1),
            )
        else:
            file["tracks"], file["point_scores"] = points, sure
            file["tracks"].attrs["dims"] = '["frame", "track", "node", "xy"]'
            file["point_scores"].attrs["dims"] = '["frame", "track", "node"]'
        file["node_names"] = [part.encode() for part in PARTS]
        file["track_names"] = [b"C1", b"C2"]
        file["track_occupancy"] = np.ones((len(points), 2))


@pytest.mark.parametrize("dims", [None, "named"])
def test_sleap_analysis(tmp_path, rng, dims):
    points, sure = rng.uniform(1, 900, (7, 2, 4, 2)), rng.uniform(0, 1, (7, 2, 4))
    points[3, 1, 2] = np.nan
    path = tmp_path / "a.analysis.h5"
    sleap_analysis(path, points, sure, dims)
    check_image(load_tracks(path), points, sure, ["C1", "C2"])
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(
        ValueError, match=r"a.analysis.h5 cannot be read as an analysis file of SLEAP.*cut off"
    ):
        load_tracks(path, Kind.SLEAP_ANALYSIS)
    with h5py.File(path, "w") as file:
        file["tracks"] = points
    with pytest.raises(ValueError, match="lacks tracks or node_names"):
        load_tracks(path, Kind.SLEAP_ANALYSIS)


@pytest.mark.parametrize("tracked", [True, False])
def test_sleap_labels(tmp_path, rng, tracked):
    sio = pytest.importorskip("sleap_io")
    skeleton = sio.Skeleton(nodes=list(PARTS), edges=[("base", "low"), ("low", "high")])
    video = sio.Video(filename="video.mp4", open_backend=False)
    ids = [sio.Track("C1"), sio.Track("C2")] if tracked else [None]
    points, sure = rng.uniform(1, 900, (5, len(ids), 4, 2)), rng.uniform(0, 1, (5, len(ids), 4))
    points[2, 0, 1] = np.nan
    frames = []
    for i in range(5):
        instances = [
            sio.PredictedInstance.from_numpy(
                points[i, j], skeleton=skeleton, point_scores=sure[i, j], score=1.0, track=track
            )
            for j, track in enumerate(ids)
        ]
        frames.append(sio.LabeledFrame(video=video, frame_idx=i + 2, instances=instances))
    labels = sio.Labels(frames, videos=[video], skeletons=[skeleton])
    labels.update()
    if not tracked:  # Listed tracks that no instance has left no point.
        labels.tracks.extend([sio.Track("C1"), sio.Track("C2")])
    path = tmp_path / "labels.slp"
    sio.save_slp(labels, str(path))
    tracks = load_tracks(path)
    whiskers = ["C1", "C2"] if tracked else ["whisker"]
    first = int(np.flatnonzero(tracks["frame"] == 2)[0])
    tracks = tracks.isel(time=slice(first, None))
    np.testing.assert_array_equal(tracks["frame"], np.arange(2, 7))
    check_image(tracks, points, sure, whiskers, rtol=1e-6)  # sleap-io gives float32
    if tracked:
        path = tmp_path / "labels.h5"
        for preset in ("matlab", "standard"):
            sio.save_analysis_h5(labels, str(path), preset=preset)
            dense = load_tracks(path)
            np.testing.assert_allclose(dense["trace"].isel(view=0)[-5:], points)
    content = (tmp_path / "labels.slp").read_bytes()
    path = tmp_path / "cut.slp"
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"cut.slp"):
        load_tracks(path, Kind.SLEAP_LABELS)
