"""Tracks of other programs: every reader gives the same structure, and says what is wrong."""

import numpy as np
import pytest
import xarray as xr

from vibrissa.io import RawTracks, join_views, labelled, load_tracks, save_tracks

generator = np.random.default_rng(0)
IMAGE = generator.uniform(10, 1000, (6, 2, 1, 4, 2))
SPACE = generator.uniform(-20e-3, 20e-3, (6, 2, 4, 3))
SURE = generator.uniform(0, 1, (6, 2, 4))
NODES = ("base", "low", "high", "tip")


def flat(**more):
    raw = {"software": "test", "whiskers": ["C1", "C2"], "image": IMAGE.copy(), "nodes": NODES}
    return RawTracks(**{**raw, **more})


def deep(**more):
    raw = {"software": "test", "whiskers": ["C1", "C2"], "space": SPACE * 1e3, "nodes": NODES}
    return RawTracks(**{**raw, **more})


def check_structure(tracks):
    """What every dataset of tracks has in common."""
    assert tracks.attrs["kind"] == "vibrissa tracks"
    assert tracks.attrs["source"]
    assert tracks.attrs["source_software"]
    for name, variable in tracks.variables.items():
        if variable.dtype.kind == "f":
            assert variable.attrs.get("units"), name
            assert variable.attrs.get("long_name"), name
    assert tracks["confidence"].dims[:2] == ("time", "whisker")
    if "trace" in tracks:
        assert tracks["trace"].dims == ("time", "whisker", "view", "node", "image_axis")
        assert tracks["trace"].attrs["units"] == "pixel"
        assert list(tracks["image_axis"].values) == ["column", "row"]
        assert {"view", "whisker", "time", "frame"} <= set(tracks.coords)
    if "centerline" in tracks:
        assert tracks["centerline"].dims == ("time", "whisker", "node", "space")
        assert tracks["centerline"].attrs["units"] == "m"
        assert tracks["centerline"].attrs["reference_frame"]


def test_labels_are_put_on():
    tracks = labelled(flat(), "a.csv", fps=500.0, view="top")
    check_structure(tracks)
    np.testing.assert_array_equal(tracks["trace"], IMAGE)
    np.testing.assert_allclose(tracks["time"], np.arange(6) / 500.0)
    assert list(tracks["view"].values) == ["top"]
    assert np.isnan(tracks["confidence"]).all()
    tracks = labelled(deep(), "a.csv", unit="mm", reference_frame="head")
    check_structure(tracks)
    np.testing.assert_allclose(tracks["centerline"], SPACE, rtol=1e-15)
    assert tracks["centerline"].attrs["reference_frame"] == "head"
    assert tracks["time"].attrs["units"] == "frame"


def test_gaps_in_time_are_gaps_in_frames():
    """A movie from which frames were cut is not shorter; irregular times leave the order."""
    time = np.array([0.0, 2.0, 4.0, 10.0, 12.1, 14.0]) * 1e-3
    assert labelled(flat(time=time), "a", view="top")["frame"].values.tolist() == [0, 1, 2, 5, 6, 7]
    time[1] = 1e-5
    assert labelled(flat(time=time), "a", view="top")["frame"].values.tolist() == list(range(6))


def test_missing_is_nan_and_never_zero():
    image, sure = IMAGE.copy(), SURE[:, :, None].copy()
    image[1, 0, 0, 2] = 0.0
    image[2, 0, 0, 2] = 0.0, 5.0
    image[3, 0, 0, 1] = np.nan, 5.0
    sure[1, 0, 0, 2] = 0.0
    tracks = labelled(flat(image=image, image_confidence=sure), "a.csv")
    gone = np.isnan(tracks["trace"].values).all(axis=-1)
    assert set(zip(*np.nonzero(gone), strict=True)) == {(1, 0, 0, 2), (3, 0, 0, 1)}
    np.testing.assert_array_equal(np.isnan(tracks["confidence"]), gone)
    assert not (np.isnan(tracks["trace"].values).any(axis=-1) ^ gone).any()
    # Somebody is sure of it: the corner of the image.
    sure[1, 0, 0, 2] = 0.9
    tracks = labelled(flat(image=image, image_confidence=sure), "a.csv")
    assert tracks["trace"].values[1, 0, 0, 2].tolist() == [0.0, 0.0]
    # A base may be at the origin, a whole whisker not.
    space = SPACE.copy()
    space[:, :, 0] = 0.0
    space[3, 1] = 0.0
    line = labelled(deep(space=space), "a.csv", unit="m")["centerline"]
    assert (line[:3, :, 0] == 0.0).all()
    assert np.isnan(line[3, 1]).all()


def test_what_the_file_does_not_say_is_needed_and_what_it_says_stands():
    with pytest.raises(ValueError, match=r"a.csv: the unit .* one of m, cm, mm.*does not state"):
        labelled(deep(), "a.csv")
    with pytest.raises(ValueError, match="'inch' is not known"):
        labelled(deep(), "a.csv", unit="inch")
    with pytest.raises(ValueError, match=r"in m its whiskers reach across [23]\d.*unit= in"):
        labelled(deep(), "a.csv", unit="m")
    with pytest.raises(ValueError, match="the unit 'mm', but 'm' is given"):
        labelled(deep(unit="mm"), "a.csv", unit="m")
    with pytest.raises(ValueError, match="states 500 frames per second, but 1000"):
        labelled(flat(fps=500.0), "a.csv", fps=1000.0)
    with pytest.raises(ValueError, match="must be positive"):
        labelled(flat(), "a.csv", fps=0.0)
    with pytest.raises(ValueError, match="2 views, a, b"):
        labelled(flat(image=np.repeat(IMAGE, 2, axis=2), views=["a", "b"]), "a.csv", view="c")
    for shape, what in (((0, 2, 1, 4, 2), "frame"), ((6, 0, 1, 4, 2), "whisker")):
        with pytest.raises(ValueError, match=f"contains no {what}"):
            labelled(flat(image=np.zeros(shape)), "a.csv")


def test_views_are_joined_by_frame_and_name():
    top = labelled(flat(frames=np.arange(6)), "top.csv", fps=1000.0, view="top")
    image = IMAGE[:, :1, :, :3] + 1.0
    front = RawTracks("test", ["C1"], image=image, nodes=NODES[:3], frames=np.arange(2, 8))
    front = labelled(front, "front.csv", fps=1000.0, view="front")
    both = join_views(top, front)
    check_structure(both)
    assert list(both["view"].values) == ["top", "front"]
    np.testing.assert_array_equal(both["frame"], np.arange(8))
    np.testing.assert_allclose(both["time"], np.arange(8) / 1000.0)
    seen = both["trace"].sel(view="front", whisker="C1", node=list(NODES[:3]))
    np.testing.assert_array_equal(seen[2:], image[:, 0, 0])
    assert np.isnan(seen[:2]).all()
    assert np.isnan(both["trace"].sel(view="front", whisker="C2")).all()
    np.testing.assert_array_equal(both["trace"].sel(view="top")[:6], IMAGE[:, :, 0])
    with pytest.raises(ValueError, match="names must differ"):
        join_views(top, top)
    with pytest.raises(ValueError, match="give fps to all"):
        join_views(top, labelled(flat(), "a.csv", view="b"))
    with pytest.raises(ValueError, match="apart"):
        join_views(top, labelled(flat(), "a.csv", view="b", fps=250.0))
    with pytest.raises(ValueError, match="needs a trace"):
        join_views(top, labelled(deep(), "a.csv", unit="mm"))


@pytest.mark.parametrize("ending", [".nc", ".csv"])
@pytest.mark.parametrize("fps", [None, 1000.0])
def test_written_and_read(tmp_path, ending, fps):
    image, space = IMAGE.copy(), SPACE.copy()
    image[2, 1, 0, 3] = space[4, 0] = np.nan
    labels = {} if fps is None else {"fps": fps}
    frames = np.array([3, 4, 5, 7, 8, 9])
    for name, tracks in (
        ("image", labelled(flat(image=image, frames=frames), "a.csv", view="top", **labels)),
        ("space", labelled(deep(space=space, frames=frames), "a.csv", unit="m", **labels)),
    ):
        path = tmp_path / f"{name}{ending}"
        save_tracks(path, tracks)
        again = load_tracks(path)
        check_structure(again)
        for one in tracks.variables:
            np.testing.assert_array_equal(again[one], tracks[one], err_msg=one)
            assert again[one].attrs == tracks[one].attrs


def test_what_cannot_be_written(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("old")
    both = labelled(deep(image=IMAGE), "a.nc", unit="mm")
    check_structure(both)
    for tracks, name, message in (
        (both, "a.csv", "drop trace or centerline"),
        (xr.Dataset(), "a.csv", "not tracks"),
        (both, "a.txt", "ends in .txt"),
    ):
        with pytest.raises(ValueError, match=message):
            save_tracks(tmp_path / name, tracks)
    assert path.read_text() == "old"
    save_tracks(tmp_path / "a.nc", both)
    again = load_tracks(tmp_path / "a.nc")
    assert again["trace_confidence"].dims == ("time", "whisker", "view", "node")
    with pytest.raises(ValueError, match="which states"):
        load_tracks(tmp_path / "a.nc", unit="mm")


def test_a_frame_rate_that_contradicts_the_times_is_refused(tmp_path):
    """It was ignored: times of a file, or its own, were kept without a word."""
    path = tmp_path / "points.csv"
    path.write_text("time,x_mm,y_mm,z_mm\n" + "".join(f"{k / 1000},1,2,3\n" for k in range(5)))
    for file in (path, tmp_path / "own.nc"):
        tracks = load_tracks(file, fps=1000.0)
        with pytest.raises(ValueError, match="states 1000 frames per second, but 500 is given"):
            load_tracks(file, fps=500.0)
        save_tracks(tmp_path / "own.nc", tracks)
    save_tracks(tmp_path / "frames.nc", labelled(deep(image=IMAGE), "a.nc", unit="mm"))
    found = load_tracks(tmp_path / "frames.nc", fps=3.0)
    np.testing.assert_allclose(found["time"], found["frame"] / 3.0)
    assert found["time"].attrs["units"] == "s"


def test_somebody_elses_table(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("# by hand\nTime,X_mm,y_mm,z_mm,note\n0,1,2,3,a\n0,2,3,4,b\n0.01,1,2,3,\n")
    tracks = load_tracks(path)
    check_structure(tracks)
    np.testing.assert_allclose(tracks["time"], [0.0, 0.01])
    line = tracks["centerline"].sel(whisker="whisker").values
    np.testing.assert_allclose(line[0], [[1e-3, 2e-3, 3e-3], [2e-3, 3e-3, 4e-3]], rtol=1e-12)
    np.testing.assert_allclose(line[1, 0], [1e-3, 2e-3, 3e-3], rtol=1e-12)
    assert np.isnan(line[1, 1]).all()


def test_units_of_time_and_points_in_the_header(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("Time (ms),x (mm),y (mm),z [mm]\n0,0,0,0\n0,9,0,0\n2,0,0,0\n2,9,1,0\n")
    tracks = load_tracks(path)
    np.testing.assert_allclose(tracks["time"], [0.0, 2e-3])
    np.testing.assert_allclose(tracks["centerline"][1, 0, 1], [9e-3, 1e-3, 0.0])
    path.write_text(path.read_text().replace("(mm)", "(um)").replace("[mm]", "[um]"))
    with pytest.raises(ValueError, match=r"0\.0005 to 1 m are possible.*correct the header"):
        load_tracks(path)
    # Without a unit in the header the unit may be stated.
    path.write_text("frame,x,y,z\n0,0,0,0\n0,9,0,0\n")
    with pytest.raises(ValueError, match=r"--unit of import"):
        load_tracks(path)
    np.testing.assert_allclose(load_tracks(path, unit="mm")["centerline"].values.max(), 9e-3)
    path.write_text("frame,x_mm,y_mm,z_mm\n0,0,0,0\n,9,0,0\n")
    with pytest.raises(ValueError, match="line 3"):
        load_tracks(path)


def test_rows_come_in_any_order_where_nodes_are_numbers(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("frame,node,column,row\r\n0,10,3,0\r\n0,2,2,0\r\n1,0,4,0\r\n0,0,1,0\r\n")
    tracks = load_tracks(path)
    assert tracks["node"].values.tolist() == ["0", "2", "10"]
    np.testing.assert_equal(tracks["trace"].values[0, 0, 0, :, 0], [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,x,y\n0,1,2\n", r"columns frame, x, y; column, row or x_px, y_px .pixels., or x"),
        ("frame,x,y,z\n", "no rows"),
        ("frame,x,y,z\n0,1,2\n", "4 columns, but line 2 has 3 cells"),
        ("frame,x,y,z\n0,1,2,b\n", "column z has cells that are not numbers: line 2"),
        ("frame,whisker,node,x,y,z\n0,a,0,1,2,3\n0,a,0,1,2,3\n", "same point of a whisker twice"),
        ("a,b\n1,2\n", "not contain tracks in a known format"),
    ],
)
def test_bad_tables(tmp_path, text, message):
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        load_tracks(path)
    assert "points.csv" in str(caught.value)


def test_tracks_of_a_recording(tmp_path):
    from vibrissa.io import save_recording

    tracks = labelled(deep(image=IMAGE), "a.nc", unit="mm", fps=1000.0)
    tracks.attrs = {"kind": "vibrissa recording"}
    path = tmp_path / "trial.nc"
    save_recording(path, xr.DataTree(tracks))
    check_structure(load_tracks(path))
    save_recording(path, xr.DataTree(tracks[["confidence"]]))
    with pytest.raises(ValueError, match="without a trace or a centreline"):
        load_tracks(path)
