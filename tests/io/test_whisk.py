"""Files of whisk: made here byte by byte, and one real file where it lies beside the project."""

import struct
from pathlib import Path

import numpy as np
import pytest

from vibrissa.contacts import ContactMap
from vibrissa.io import Kind, join_views, load_tracks

REAL = Path(__file__).parents[3] / "shared" / "formats" / "test.measurements"


def segment(length, seed):
    """Columns x, y, thickness and score (n, 4) of a trace, as float32 holds them."""
    generator = np.random.default_rng(seed)
    along = np.arange(length, dtype=float)
    x, y = 100 + along, 200 + 10 * seed + 0.01 * along**2
    rest = generator.uniform(1, 3, (length, 2))
    return np.column_stack([x, y, rest]).astype(np.float32)


# Two whiskers in three frames, in changing order and direction, and a hair that is none.
SEGMENTS = {
    (10, 0): segment(30, 1),
    (10, 1): segment(25, 2),
    (11, 0): segment(26, 2)[::-1],
    (11, 1): segment(31, 1),
    (11, 2): segment(5, 7),
    (12, 0): segment(29, 1)[::-1],
}
STATES = {(10, 0): 0, (10, 1): 1, (11, 0): 1, (11, 1): 0, (11, 2): -1, (12, 0): 0}


def whiskers_file(path, segments=SEGMENTS):
    parts = [b"bwhiskbin1\0\0"]
    for (frame, number), points in segments.items():
        parts += [struct.pack("<3i", number, frame, len(points)), points.T.tobytes()]
    path.write_bytes(b"".join([*parts, struct.pack("<i", len(segments))]))
    return path


def measurements_file(path, states=STATES):
    """One line a segment, last to first as whisk writes them; follicles are at the smaller x."""
    parts = [b"measv3\0\0", struct.pack("<2i", len(states), 8)]
    for row, (key, state) in enumerate(reversed(states.items())):
        points = SEGMENTS[key]
        ends = points[[0, -1], :2] if points[0, 0] < points[-1, 0] else points[[-1, 0], :2]
        data = [len(points), 5.0, 90.0, 0.002, *ends.ravel()]
        numbers = (row, *key, state, 886, 162, 4, 5, 0, 8)
        parts.append(struct.pack("<10ic8d8d", *numbers, b"y", *data, *[0.0] * 8))
    path.write_bytes(b"".join(parts))
    return path


def test_traces_alone(tmp_path):
    tracks = load_tracks(whiskers_file(tmp_path / "a.whiskers"), fps=500.0, view="top")
    assert tracks.attrs["identity"] == "per frame"
    assert tracks["trace"].shape == (3, 3, 1, 31, 2)
    np.testing.assert_allclose(tracks["time"], [0.02, 0.022, 0.024])
    for (frame, number), points in SEGMENTS.items():
        found = tracks.isel(time=frame - 10, whisker=number, view=0)
        np.testing.assert_array_equal(found["trace"][: len(points)], points[:, :2])
        np.testing.assert_array_equal(found["thickness"][: len(points)], points[:, 2])
        np.testing.assert_array_equal(found["score"][: len(points)], points[:, 3])
        assert np.isnan(found["trace"][len(points) :]).all()
    assert np.isnan(tracks["trace"].isel(time=2, whisker=[1, 2])).all()


def test_measurements_give_identity_and_direction(tmp_path):
    path = whiskers_file(tmp_path / "a.whiskers")
    measurements_file(tmp_path / "a.measurements")
    tracks = load_tracks(path)
    assert tracks.attrs["identity"] == "classified"
    assert list(tracks["whisker"].values) == ["0", "1"]
    for (frame, number), points in SEGMENTS.items():
        state = STATES[frame, number]
        if state < 0:
            continue
        points = points if points[0, 0] < points[-1, 0] else points[::-1]
        found = tracks["trace"].isel(time=frame - 10, whisker=state, view=0)
        np.testing.assert_array_equal(found[: len(points)], points[:, :2])
    both = join_views(load_tracks(path, view="top"), load_tracks(path, view="front"))
    assert both["trace"].shape == (3, 2, 2, *tracks["trace"].shape[3:])


def test_measurements_alone(tmp_path):
    tracks = load_tracks(measurements_file(tmp_path / "a.measurements"), fps=500.0)
    assert list(tracks["node"].values) == ["follicle", "tip"]
    assert tracks["trace"].shape == (3, 2, 1, 2, 2)
    points = SEGMENTS[11, 0]
    found = tracks.isel(time=1, whisker=1, view=0)
    np.testing.assert_array_equal(found["trace"], points[[-1, 0], :2])
    assert found["trace_length"] == len(points)
    np.testing.assert_allclose(found["angle"], np.pi / 2)
    assert found["segment"] == 0
    assert np.isnan(tracks["trace"].isel(time=2, whisker=1)).all()
    assert tracks["segment"].isel(time=2, whisker=1) == -1
    assert tracks.attrs["face_axis"] == "y"


def test_without_classification_the_state_is_no_identity(tmp_path):
    tracks = load_tracks(measurements_file(tmp_path / "a.measurements", dict.fromkeys(STATES, 0)))
    assert tracks.attrs["identity"] == "per frame"
    assert tracks.sizes["whisker"] == 3


def test_files_that_do_not_belong_together(tmp_path):
    whiskers = {key: points for key, points in SEGMENTS.items() if key[0] != 12}
    path = whiskers_file(tmp_path / "a.whiskers", whiskers)
    measurements_file(tmp_path / "a.measurements")
    with pytest.raises(ValueError, match=r"a.measurements does not belong to .*a.whiskers"):
        load_tracks(path)


def test_whole_or_refused(tmp_path):
    """A file cut at any place is an error that names it."""
    for make, kind in (
        (whiskers_file, Kind.WHISKERS),
        (measurements_file, Kind.MEASUREMENTS),
    ):
        path = make(tmp_path / "whole")
        content = path.read_bytes()
        cut = tmp_path / "cut"
        for end in [*range(1, 60), *range(60, len(content), 97), len(content) - 1]:
            cut.write_bytes(content[:end])
            with pytest.raises(ValueError, match="cut"):
                load_tracks(cut, kind)
        cut.write_bytes(content + b"\0")
        with pytest.raises(ValueError, match="cut"):
            load_tracks(cut, kind)
        cut.write_bytes(b"")
        with pytest.raises(ValueError, match="is empty"):
            load_tracks(cut, kind)
        cut.write_bytes(b"something else, long enough to be one")
        with pytest.raises(ValueError, match="is no"):
            load_tracks(cut, kind)
    nothing = whiskers_file(tmp_path / "nothing", {})
    with pytest.raises(ValueError, match="contains no whiskers"):
        load_tracks(nothing)


@pytest.mark.skipif(not REAL.is_file(), reason="the real file is not part of the project")
def test_a_real_file():
    tracks = load_tracks(REAL, fps=500.0)
    assert tracks.sizes["time"] == 200
    assert int(np.isfinite(tracks["trace_length"]).sum()) == 6289
    # The row that stands first in the file: frame 199, segment 27.
    last = tracks.isel(time=199, view=0).sel(whisker="27")
    assert float(last["trace_length"]) == pytest.approx(41.7609863, abs=1e-7)
    np.testing.assert_allclose(last["trace"][1], [570.664612, 205.521011], atol=1e-6)
    # What whisk says of length and ends agrees: a trace is no shorter than its chord.
    chord = np.linalg.norm(np.diff(tracks["trace"].values, axis=-2)[..., 0, :], axis=-1)
    ratio = (tracks["trace_length"].values / chord)[np.isfinite(chord)]
    assert ratio.min() > 0.99
    assert np.median(ratio) < 1.1


def test_no_map_is_a_file_of_whisk_and_it_is_said_what_takes_it(tmp_path):
    measurements_file(tmp_path / "b.measurements")
    with pytest.raises(ValueError, match=r"b.measurements contains measurements .*vibrissa import"):
        ContactMap.load(tmp_path / "b.measurements")


def test_curvatures_survive_the_joining_of_views(tmp_path):
    """Without them two points, follicle and tip, are all that is left of a whisker."""
    path = measurements_file(tmp_path / "a.measurements")
    views = [load_tracks(path, fps=500.0, view=view) for view in ("top", "front")]
    joined = join_views(*views)
    assert joined["trace_curvature"].sizes["view"] == 2
    own = views[1]["trace_curvature"].isel(view=0)
    np.testing.assert_array_equal(joined["trace_curvature"].isel(view=1), own)
