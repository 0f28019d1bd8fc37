"""From the files of other trackers to a contour, by the command line alone."""

import csv
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cameras import orthogonal_views, save_cameras
from vibrissa.cli.app import app
from vibrissa.io import RawTracks, join_views, labelled, load_recording, save_tracks
from vibrissa.objects import Peg
from vibrissa.recording import Recording
from vibrissa.simulation import Motion, simulate
from vibrissa.tracking import TrackOptions, track, tracker_traces

NODES = 9
CAMERAS = orthogonal_views(size=(400, 400), center=(5e-3, 0.0, 0.0))
PEG = Peg([9e-3, 5.1e-3, 0.0], [0.0, 0.0, 1.0], 3e-3)


@pytest.fixture(scope="module")
def trial():
    """A short whisk into a peg and back, and the points of its whisker in space."""
    t = np.arange(40) / 1000.0
    azimuth = -0.15 + 0.45 * np.sin(np.pi * t / t[-1])
    motion = Motion(t, azimuth, 0.0 * t, 0.0 * t, np.zeros((40, 3)))
    recording = simulate(vb.Whisker.parabola(length=15e-3, coefficient=12.0), motion, PEG)
    truth = Recording(recording)["truth"]
    assert 12 < truth["in_contact"].sum() < 34
    line = truth["centerline"]
    chosen = np.linspace(0, line.shape[2] - 1, NODES).round().astype(int)
    return truth, line[:, :, chosen]


def deeplabcut(path, pixels):
    """Write points (time, node, 2) as DeepLabCut does, with some noise."""
    noisy = pixels + np.random.default_rng(1).normal(0.0, 0.1, pixels.shape)
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["scorer"] + ["net"] * 3 * NODES)
        table.writerow(["bodyparts"] + [f"w{i}" for i in range(NODES) for _ in range(3)])
        table.writerow(["coords"] + ["x", "y", "likelihood"] * NODES)
        for i, row in enumerate(noisy):
            table.writerow([i, *(v for x, y in row for v in (x, y, 0.99))])
    return path


def tables(folder, views):
    """A table of DeepLabCut for each view."""
    return [deeplabcut(folder / f"{name}.csv", pixels) for name, pixels in views.items()]


def labels(folder, views):
    """One file of labels of SLEAP for both videos, the front first, by sleap-io itself."""
    sio = pytest.importorskip("sleap_io")
    skeleton = sio.Skeleton([sio.Node(f"w{i}") for i in range(NODES)])
    track, frames = sio.Track("w"), []
    videos = {name: sio.Video(f"{name}.mp4", open_backend=False) for name in reversed(views)}
    for name, video in videos.items():
        for i, points in enumerate(views[name]):
            scores = np.full(NODES, 0.9)
            instance = sio.PredictedInstance.from_numpy(
                points, skeleton=skeleton, point_scores=scores, score=0.9, track=track
            )
            frames.append(sio.LabeledFrame(video, i, [instance]))
    path = folder / "labels.slp"
    sio.Labels(frames, list(videos.values()), [skeleton], [track]).save(path, embed=False)
    return [path]


def analysis(folder, views):
    """An analysis file of SLEAP for each view, in SLEAP's own layout."""
    for name, pixels in views.items():
        with h5py.File(folder / f"{name}.h5", "w") as file:
            file["tracks"] = pixels.transpose(2, 1, 0)[None]
            file["point_scores"] = np.full((1, NODES, len(pixels)), 0.9)
            file["node_names"] = np.array([f"w{i}" for i in range(NODES)], dtype="S")
            file["track_names"] = np.array(["w"], dtype="S")
    return [folder / f"{name}.h5" for name in views]


def movement(folder, views):
    """One dataset of movement with both views, the front first."""
    points = np.stack([views[name].transpose(0, 2, 1) for name in reversed(views)])
    poses = xr.Dataset(
        {"position": (("view", "time", "space", "keypoint", "individual"), points[..., None])},
        {"view": list(reversed(views)), "time": np.arange(points.shape[1]) / 1000.0},
        {"fps": 1000.0, "time_unit": "seconds", "source_software": "LightningPose"},
    )
    names = {"space": ["x", "y"], "keypoint": [f"w{i}" for i in range(NODES)], "individual": ["w"]}
    poses.assign_coords(names).to_netcdf(folder / "poses.nc", engine="h5netcdf")
    return [folder / "poses.nc"]


def nwb(folder, views):
    """One NWB file with a pose of each camera, by ndx-pose itself, sorted as HDF5 does."""
    pynwb, ndx_pose = pytest.importorskip("pynwb"), pytest.importorskip("ndx_pose")
    start = datetime(2026, 1, 1, tzinfo=UTC)
    file = pynwb.NWBFile("poses", "poses", start)
    names = [f"w{i}" for i in range(NODES)]
    skeleton = ndx_pose.Skeleton(name="whisker", nodes=names)
    module = file.create_processing_module("behavior", "poses")
    module.add(ndx_pose.Skeletons(skeletons=[skeleton]))
    for view, pixels in views.items():
        series = [
            ndx_pose.PoseEstimationSeries(
                name=name, data=pixels[:, i], unit="pixels", reference_frame="image", rate=1000.0
            )
            for i, name in enumerate(names)
        ]
        pose = ndx_pose.PoseEstimation(
            name=f"camera_{view}", pose_estimation_series=series, skeleton=skeleton
        )
        module.add(pose)
    with pynwb.NWBHDF5IO(folder / "poses.nwb", "w") as out:
        out.write(file)
    return [folder / "poses.nwb"]


def run(*words):
    done = CliRunner().invoke(app, [str(word) for word in words])
    if done.exception and not isinstance(done.exception, SystemExit):
        raise done.exception
    return " ".join(done.output.split())


def errors(path, truth):
    """Distances of contact points from the true ones, m."""
    both = (
        truth["in_contact"][:, 0]
        & (recording := Recording(load_recording(path))).root["in_contact"][:, 0]
    )
    assert both.sum() >= 0.8 * truth["in_contact"].sum()
    away = recording.root["contact_point"] - truth["contact_point"]
    return np.linalg.norm(away[both, 0], axis=-1)


@pytest.mark.parametrize(
    "write",
    [
        tables,
        pytest.param(labels, marks=pytest.mark.slow),
        pytest.param(analysis, marks=pytest.mark.slow),
        pytest.param(movement, marks=pytest.mark.slow),
    ],
)
def test_two_views_to_a_recording(trial, tmp_path, write):
    truth, line = trial
    save_cameras(tmp_path / "cameras.toml", CAMERAS)
    files = write(tmp_path, {camera.name: camera.project(line[:, 0]) for camera in CAMERAS})
    # What info names is typed, with what only the user knows in place of the capitals.
    _, _, command = run("info", files[0]).partition("vibrissa import")
    typed = command.partition(" -o trial.nc")[0].replace("FRAMES_A_SECOND", "1000")
    typed = typed.replace("[FILE of the other view]", str(files[-1])).replace(
        "--pixel-size MM (or --cameras CAMERAS.toml)", f"--cameras {tmp_path / 'cameras.toml'}"
    )
    out = tmp_path / "t.nc"
    run("import", files[0], *typed.split()[1:], "-o", out)
    assert np.median(errors(out, truth)) < 1.5e-4
    assert "vibrissa reconstruct" in run("info", out)


def test_points_are_ordered_and_separated_by_their_names(trial):
    """As in a project of DeepLabCut for one animal with the whiskers C1 and C2."""
    raw = RawTracks(
        "test",
        ["w"],
        image=np.stack([camera.project(trial[1]) for camera in CAMERAS], axis=2),
        views=[c.name for c in CAMERAS],
        fps=1000.0,
    )
    plain = labelled(raw, "a")
    count = plain.sizes["node"]
    along = ["base", *(f"p{i}" for i in range(1, count - 1)), "tip"]
    found = tracker_traces(plain.assign_coords(node=along), CAMERAS)
    turned = plain.isel(node=slice(None, None, -1)).assign_coords(node=along[::-1])
    again = tracker_traces(turned, CAMERAS)
    assert any("from tip to base" in note for note in again.notes)
    assert not any("by their names" in note for note in found.notes)
    np.testing.assert_array_equal(again.traces[0][0][5].line, found.traces[0][0][5].line)
    for label in ("{0}_{1}", "{1}_{0}", "{0}.{1}"):
        both = xr.concat(
            [plain.assign_coords(node=[label.format(w, n) for n in along]) for w in ("C1", "C2")],
            "node",
        )
        two = tracker_traces(both, CAMERAS)
        assert two.names == ["C1", "C2"]
        for k in range(2):
            one = two.traces[1][k][5].line
            np.testing.assert_array_equal(one, found.traces[1][0][5].line)
    # Names with a number each are not whiskers.
    numbered = plain.assign_coords(node=[f"w_{i}" for i in range(count)])
    assert len(tracker_traces(numbered, CAMERAS).names) == 1


def test_points_in_the_order_of_a_spreadsheet_are_sorted_by_their_numbers(trial):
    image = np.stack([camera.project(trial[1]) for camera in CAMERAS], axis=2)
    raw = RawTracks("test", ["w"], image=image, views=[c.name for c in CAMERAS], fps=1000.0)
    names = [f"C1_{i}" for i in (1, 2, 3, 4, 5, 6, 7, 8, 10)]
    plain = labelled(replace(raw, nodes=names), "a")
    found = tracker_traces(plain, CAMERAS)
    again = tracker_traces(plain.sel(node=sorted(names)), CAMERAS)  # C1_1, C1_10, C1_2
    assert "sorted by their numbers" in again.notes[0]
    np.testing.assert_array_equal(again.traces[0][0][5].line, found.traces[0][0][5].line)
    downward = plain.isel(node=slice(None, None, -1))
    assert not any("sorted" in note for note in tracker_traces(downward, CAMERAS).notes)


def test_points_that_mislead_are_noticed(trial):
    """Exchanged in frames, from tip to base, few, without a base, or of other names in a view."""
    image = np.stack([camera.project(trial[1]) for camera in CAMERAS], axis=2)

    def raw(points):
        return RawTracks("test", ["w"], image=points, views=[c.name for c in CAMERAS], fps=1000.0)

    assert not tracker_traces(labelled(raw(image), "a"), CAMERAS).notes
    swapped = image.copy()
    swapped[::4, :, 0, [3, 5]] = image[::4, :, 0, [5, 3]]
    found = tracker_traces(labelled(raw(swapped), "a"), CAMERAS)
    seen = [len(trace.line) > 0 for trace in found.traces[0][0]]
    assert seen == [i % 4 > 0 for i in range(len(image))]
    assert "10 of 40 frames" in found.notes[0]
    found = tracker_traces(labelled(raw(image[..., ::-1, :]), "a"), CAMERAS)
    assert "from tip to base" in found.notes[0]
    few = tracker_traces(labelled(raw(image[..., ::4, :]), "a"), CAMERAS)
    assert any("track more points" in note for note in few.notes)
    image[:, :, 1, 4] = np.nan
    without = tracker_traces(labelled(raw(image), "a"), CAMERAS)
    assert f"point 4 is never known in {CAMERAS[1].name}" in without.notes[0]
    image[:, :, 1, 0] = np.nan
    with pytest.raises(ValueError, match=f"never known in {CAMERAS[1].name}"):
        tracker_traces(labelled(raw(image), "a"), CAMERAS)
    one = RawTracks("test", ["w"], image=image[:, :, :1], nodes=list("abcdefghi"), fps=1000.0)
    other = replace(one, nodes=list("jklmnopqr"))
    with pytest.raises(ValueError, match="no node in common"):
        join_views(labelled(one, "a", view="top"), labelled(other, "b", view="front"))


def test_points_that_no_images_can_have_are_refused(trial):
    image = np.stack([camera.project(trial[1]) for camera in CAMERAS], axis=2)

    def refused(message, points=image, sure=0.9):
        raw = RawTracks(
            "test",
            ["w"],
            image=points,
            image_confidence=np.full(points.shape[:-1], sure),
            views=["top", "front"],
            fps=1000.0,
        )
        with pytest.raises(ValueError, match=message):
            tracker_traces(labelled(raw, "a.csv"), CAMERAS)

    refused("confidence of 0.6 or more; the largest is 0.3", sure=0.3)
    refused("up to 99; numbers from 0 to 1", sure=99.0)
    refused("shares of the image", points=image / 400.0)
    refused("top and front have the same points", points=image[:, :, [0, 0]])
    refused("two known points of a whisker; the most are 0", points=np.full_like(image, np.nan))
    refused("two known points of a whisker; the most are 1", points=image[..., :1, :])


def test_a_whisker_may_end_beyond_its_last_point(trial):
    """Points without names end where the line does; of named ones the last is the tip."""
    image = np.stack([camera.project(trial[1]) for camera in CAMERAS], axis=2)
    image[..., 6:, :] = np.nan
    about = {"image": image, "views": [c.name for c in CAMERAS], "fps": 1000.0}
    named = labelled(RawTracks("test", ["w"], nodes=[f"w{i}" for i in range(NODES)], **about), "a")
    ragged = labelled(RawTracks("test", ["w"], **about), "a")
    assert tracker_traces(ragged, CAMERAS).traces[0][0][5].tip_seen
    assert not tracker_traces(named, CAMERAS).traces[0][0][5].tip_seen
    ends = named.isel(node=slice(0, 6))
    found = tracker_traces(ends, CAMERAS)
    assert "w5, is taken as the whisker's tip" in found.notes[0]
    assert found.traces[0][0][5].tip_seen
    assert not tracker_traces(ends, CAMERAS, tip=False).traces[0][0][5].tip_seen


def test_lines_between_few_points_are_not_trusted_beyond_their_noise(trial):
    """From Python too, without an option."""
    image = np.stack([camera.project(trial[1]) for camera in CAMERAS], axis=2)
    raw = RawTracks("test", ["w"], image=image, views=[c.name for c in CAMERAS], fps=1000.0)
    found = tracker_traces(labelled(raw, "a"), CAMERAS)
    plain = [
        [[trace._replace(sparse=False) for trace in row] for row in view] for view in found.traces
    ]
    spread = []
    # Where the taper is assumed, that is most of the uncertainty.
    stated = TrackOptions(properties={"base_radius": 1e-4, "tip_radius": 1e-4 / 15.0})
    for traces in (found.traces, plain):
        done = track(found.cameras, traces, 1000.0, stated).to_dataset()
        spread.append(np.nanmedian(done["contact_covariance"].values[..., 0, 0]))
    assert spread[0] > 4.0 * spread[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("write", "program"),
    [(nwb, "NWB"), pytest.param(labels, "SLEAP", marks=pytest.mark.slow)],
)
def test_two_views_to_the_contour(trial, tmp_path, write, program):
    line = trial[1]
    save_cameras(tmp_path / "cameras.toml", CAMERAS)
    noise = np.random.default_rng(1).normal(0.0, 0.1, (2, *line[:, 0, :, :2].shape))
    seen = [camera.project(line[:, 0]) for camera in CAMERAS] + noise
    names = [camera.name for camera in CAMERAS]
    files = write(tmp_path, dict(zip(names, seen, strict=True)))
    with pytest.raises(ValueError, match="vibrissa import"):
        run("reconstruct", files[0])
    with pytest.raises(ValueError, match="--cameras or --pixel-size"):
        run("import", *files, "--rate", 1000, "-o", tmp_path / "t.nc")
    out = tmp_path / "t.nc"
    run("import", *files, "--cameras", tmp_path / "cameras.toml", "--rate", 1000, "-o", out)
    run("reconstruct", out, "--axis", "0,0,1")
    fitted = load_recording(out)["contour"]
    # The short arc that was touched leaves the radius open; the object's side is determined.
    radius, sigma = fitted["object_radius"].item(), fitted["parameter_covariance"].values[-1, -1]
    assert abs(radius - PEG.radius) < 4.0 * sigma**0.5
    points = load_recording(out)["estimates"]["contact_point"].values[:, 0]
    points = points[np.isfinite(points).all(axis=1)]
    from_axis = np.linalg.norm(points[:, :2] - PEG.origin[:2], axis=1)
    assert np.median(np.abs(from_axis - PEG.radius)) < 1.5e-4
    text = run("info", out)
    assert "signals, estimates, contour" in text
    assert f"tracked by {program}" in text
    assert "pose_covariance" not in text
    assert "pose_covariance" in run("info", out, "--all")


@pytest.mark.slow
def test_points_in_space_and_one_view_of_a_plane(trial, tmp_path):
    truth, line = trial
    noise = np.random.default_rng(2).normal(0.0, 5e-6, line.shape)
    raw = RawTracks("test", ["w"], space=line + noise, unit="m", fps=1000.0)
    save_tracks(tmp_path / "space.nc", labelled(raw, "space"))
    run("import", tmp_path / "space.nc", "-o", tmp_path / "a.nc")
    assert np.median(errors(tmp_path / "a.nc", truth)) < 1.5e-4
    top = deeplabcut(tmp_path / "top.csv", CAMERAS[0].project(line[:, 0]))
    how = ("--pixel-size", 0.058, "--rate", 1000)
    assert "plane" in run("import", top, *how, "-o", tmp_path / "b.nc")
    # Of one view the place of the image in the laboratory is not known: distances are.
    found = Recording(load_recording(tmp_path / "b.nc")).root
    both = truth["in_contact"][:, 0] & found["in_contact"][:, 0]
    assert both.sum() > 10
    arcs = found["arc_length"][both, 0] - truth["arc_length"][both, 0]
    assert np.median(np.abs(arcs)) < 3e-4


def test_a_rod_longer_than_any_whisker_is_confirmed(trial, tmp_path):
    """The option that the message advises was refused without a --whisker."""
    noise = np.random.default_rng(2).normal(0.0, 5e-4, trial[1].shape)
    raw = RawTracks("test", ["w"], space=50.0 * trial[1] + noise, unit="m", fps=1000.0)
    save_tracks(tmp_path / "rod.nc", labelled(raw, "rod"))
    how = ("import", tmp_path / "rod.nc", "--base-radius", 1, "-o", tmp_path / "a.nc")
    with pytest.raises(ValueError, match="--any-length"):
        run(*how)
    assert "mm long, in contact in" in run(*how, "--any-length")
    with pytest.raises(ValueError, match="and any other with --any-length"):
        run(*how, "--length", 760, "--force")
    text = run(*how, "--length", 760, "--any-length", "--fur", 20, "--force")
    assert "20 ± 5 mm of its base are taken to be hidden by fur" in text


@pytest.mark.slow
def test_a_table_of_anipose_to_a_recording(trial, tmp_path):
    truth, line = trial
    points = 1e3 * line[:, 0] + np.random.default_rng(2).normal(0.0, 5e-3, line[:, 0].shape)
    with (tmp_path / "pose-3d.csv").open("w", newline="") as file:
        table = csv.writer(file)
        kinds = ("x", "y", "z", "error", "ncams", "score")
        table.writerow([*(f"w{i}_{kind}" for i in range(NODES) for kind in kinds), "fnum"])
        for k, row in enumerate(points):
            table.writerow([*(cell for point in row for cell in (*point, 0.4, 2, 0.98)), k])
    _, _, command = run("info", tmp_path / "pose-3d.csv").partition("pose-3d.csv --unit mm")
    typed = command.partition(" -o ")[0].replace("FRAMES_A_SECOND", "1000").split()
    out = tmp_path / "t.nc"
    run("import", tmp_path / "pose-3d.csv", "--unit", "mm", *typed, "--rat", "C5", "-o", out)
    assert np.median(errors(out, truth)) < 1.5e-4
    whisker = Recording(load_recording(out)).whiskers[0]
    published = vb.Whisker.straight(whisker.length, rat="C5")
    assert whisker.base_radius == pytest.approx(published.base_radius, rel=1e-3)
    with h5py.File(out, "r+") as file:
        file["base_position"][:] += 1000.0
    with pytest.raises(ValueError, match="lengths of the whisker from the base"):
        run("info", out)


def test_the_frame_rate_is_asked_for_and_views_are_matched_by_name(trial, tmp_path):
    files = tables(tmp_path, {"top": trial[1][:, 0, :, :2], "front": trial[1][:, 0, :, 1:]})
    with pytest.raises(ValueError, match="--rate"):
        run("import", *files, "--pixel-size", 0.05, "-o", tmp_path / "t.nc")
    single = tmp_path / "single.csv"
    single.write_text("frame,node,column,row\n7,0,1,1\n7,1,9,2\n")
    with pytest.raises(ValueError, match="contains one frame"):
        run("import", single, "--rate", 500, "-o", tmp_path / "t.nc")
    numbers = np.array([7, 8, 8])
    twice = RawTracks("test", ["w"], image=np.ones((3, 1, 1, 5, 2)), frames=numbers, fps=500.0)
    save_tracks(tmp_path / "twice.nc", labelled(twice, "a"))
    with pytest.raises(ValueError, match="frame 8 follows frame 8"):
        run("import", tmp_path / "twice.nc", "-o", tmp_path / "t.nc")
    late = tmp_path / "late.csv"
    late.write_text("\n".join(["frame,node,column,row", *(f"{i},0,1,1" for i in (90, 91))]))
    early = tmp_path / "early.csv"
    early.write_text("\n".join(["frame,node,column,row", *(f"{i},0,1,1" for i in (0, 1))]))
    with pytest.raises(ValueError, match="no frames in common"):
        run("import", early, late, "--rate", 500, "-o", tmp_path / "t.nc")
    image = np.random.default_rng(5).uniform(0.0, 300.0, (4, 1, 2, 5, 2))
    for views, order, guessed in (
        (("front", "top"), [1, 0], False),
        (("camera_front", "camera_top"), [1, 0], False),
        (("left", "right"), [0, 1], True),
        (("stop", "top"), [0, 1], True),  # both hold the name of one camera
    ):
        raw = RawTracks("test", ["w"], image=image, views=views, fps=500.0)
        found = tracker_traces(labelled(raw, "a"), CAMERAS)
        assert [camera.name for camera in found.cameras] == [CAMERAS[i].name for i in order]
        assert any("in order" in note for note in found.notes) == guessed


def test_times_in_milliseconds_are_questioned(trial, tmp_path):
    rows = [
        f"{i},{k},{column:.3f},{row:.3f}"
        for i, points in enumerate(CAMERAS[0].project(trial[1][:, 0]))
        for k, (column, row) in enumerate(points)
    ]
    table = tmp_path / "film.csv"
    table.write_text("\n".join(["time,node,column,row", *rows]))
    out = tmp_path / "trial.nc"
    said = run("import", table, "--pixel-size", "0.058", "--base-radius", "0.05", "-o", out)
    assert "frames are 1 s apart: time has to be in seconds" in said


def test_ends_and_curvature_make_an_arc():
    radius, angles = 300.0, np.linspace(0.2, 0.9, 12)
    circle = radius * np.stack([np.sin(angles), 1.0 - np.cos(angles)], axis=-1) + 50.0
    raw = RawTracks(
        "whisk",
        ["0"],
        image=np.tile(circle[[0, -1]], (4, 1, 1, 1, 1)),
        nodes=("follicle", "tip"),
        fps=500.0,
    )
    tracks = labelled(raw, Path("a.measurements"))
    curvature = (("time", "whisker", "view"), np.full((4, 1, 1), 1.0 / radius))
    found = tracker_traces(tracks.assign(trace_curvature=curvature), pixel_size=6e-5)
    trace = found.traces[0][0][0]
    center = np.array([50.0, 50.0 + radius])
    away = np.linalg.norm(trace.line - center, axis=1)
    np.testing.assert_allclose(away, radius, atol=0.05)
    assert any("arc" in note for note in found.notes)


def test_whiskers_without_identity_are_followed_from_their_base():
    rng = np.random.default_rng(4)
    swing = 0.2 * np.sin(np.linspace(0.0, 6.0, 30))
    along = np.linspace(0.0, 200.0, 40)
    image = np.full((30, 2, 1, 40, 2), np.nan)
    for i, angle in enumerate(swing):
        order = rng.permutation(2)
        for k, (base, size) in enumerate(((100.0, 1.0), (300.0, 0.5))):
            way = size * along[:, None] * [np.cos(angle), np.sin(angle)] + [50.0, base]
            image[i, order[k], 0] = way if rng.random() < 0.5 else way[::-1]
    about = {"identity": "per frame", "direction": "either"}
    tracks = labelled(RawTracks("whisk", ["0", "1"], image=image, fps=500.0, about=about), "a")
    found = tracker_traces(tracks, pixel_size=6e-5)
    bases = np.array([trace.line[0] for trace in found.traces[0][0]])
    np.testing.assert_allclose(bases, np.tile([50.0, 100.0], (30, 1)), atol=1e-6)
    both = tracker_traces(tracks, pixel_size=6e-5, names=["0", "1"])
    rows = sorted(float(view[0].line[0, 1]) for view in both.traces[0])
    np.testing.assert_allclose(rows, [100.0, 300.0], atol=1e-6)
    with pytest.raises(ValueError, match="there is no whisker 7"):
        tracker_traces(tracks, pixel_size=6e-5, names=["7"])
    # A second view whose numbers are unrelated.
    image = np.concatenate([image, image[:, ::-1] + [0.0, 20.0]], axis=2)
    views = [camera.name for camera in CAMERAS]
    raw = RawTracks("whisk", ["0", "1"], views=views, image=image, fps=500.0, about=about)
    tracks = labelled(raw, "a")
    found = tracker_traces(tracks, CAMERAS)
    for view, base in zip(found.traces, (100.0, 120.0), strict=True):
        assert [trace.line[0, 1] for trace in view[0]] == pytest.approx([base] * 30)
    with pytest.raises(ValueError, match="in each view anew"):
        tracker_traces(tracks, CAMERAS, names=["0"])
    with pytest.raises(ValueError, match="size of a pixel"):
        tracker_traces(tracks)
