"""Movies of trials: what moves is where it should be, in frames and in the file."""

import signal
import sys
from itertools import repeat

import av
import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli import movie as movie_module
from vibrissa.cli.app import app, main
from vibrissa.cli.figures import sights_of
from vibrissa.cli.movie import FrameOptions
from vibrissa.io import save_recording, video_frames, video_info, write_movie, write_video
from vibrissa.plots import Sight, contour_frames, signal_frames
from vibrissa.plots.movies import _SIDE_BOXES, _SIGHT_BOXES, HEIGHT, SIZE, WIDTH
from vibrissa.plots.overview import Window, part_of
from vibrissa.scene import course_of

RED = np.array([232, 0, 11])
ORANGE = np.array([213, 94, 0])
GREY = np.full((300, 300), 200, np.uint8)


def near(frame, colour, box=(0.0, 0.0, WIDTH, HEIGHT)):
    """Pixels (column, row) of a colour within a box in mm."""
    left, bottom, wide, tall = np.array(box) * SIZE[0] / WIDTH
    rows = slice(int(SIZE[1] - bottom - tall), int(SIZE[1] - bottom))
    columns = slice(int(left), int(left + wide))
    away = np.abs(frame[rows, columns, :3].astype(int) - colour).max(axis=-1)
    found = np.argwhere(away < 40)[:, ::-1]
    return found + np.array([columns.start, rows.start])


@pytest.fixture(scope="module")
def samples():
    whisker = vb.Whisker.straight(40e-3)
    return vb.ContactMap.simulate(whisker, grid=False, cells=(8, 16, 8)).to_dataset()


@pytest.fixture
def coarse(monkeypatch):
    """Solids that are quicker to make."""
    monkeypatch.setattr("vibrissa.scene.solids._SHAPE", (12, 24, 8))


def line():
    return np.linspace([0.0, 0.0, 0.0], [40e-3, 0.0, 0.0], 20)


def test_cursors_go_on_and_dots_move_while_there_is_contact(known, samples, coarse):
    course = course_of(known.recording())
    rows = [1, 5, 8, 11]
    frames = list(signal_frames(course, samples, line(), rows))
    assert [frame.shape for frame in frames] == [(720, 1280, 4)] * 4
    below, above = (0.0, 0.0, WIDTH, 48.0), (0.0, 50.0, WIDTH, HEIGHT - 50.0)
    places = [near(frame, ORANGE, below)[:, 0] for frame in frames]
    # Half of the cursors lie in the left column, as far as time has gone.
    left = [np.median(place[place < 640]) for place in places]
    shares = (np.array(left) - left[0]) / (left[-1] - left[0])
    np.testing.assert_allclose(shares, [0.0, 0.4, 0.7, 1.0], atol=0.01)
    dots = [near(frame, ORANGE, above) for frame in frames]
    assert len(dots[0]) < 20 < min(map(len, dots[1:]))
    third = SIZE[0] / 3
    for part in range(3):
        middle = [d[(d[:, 0] // third).astype(int) == part].mean(axis=0) for d in dots[1:]]
        assert np.all(np.diff(np.array(middle)[:, 1]) > 3.0), "F_x falls"


def test_the_whisker_is_red_where_it_is_traced(known):
    course = course_of(known.recording())
    rows = [0, 6, 11]
    sights = [Sight(view, repeat(GREY)) for view in known.views]
    frames = list(contour_frames(course, line(), sights, rows, [known.peg]))
    truth = known.recording()["truth"]["centerline"].values[:, 0]
    for view, box in zip(known.views, _SIGHT_BOXES, strict=True):
        pixels = view.project(truth)
        low, high = part_of(pixels, box[2:], view.size)
        scale = SIZE[0] / WIDTH
        for row, frame in zip(rows, frames, strict=True):
            share = (pixels[row] - low) / (high - low)
            corner = np.array([box[0], HEIGHT - box[1] - box[3]])
            wanted = (corner + share * np.array(box[2:])) * scale
            found = near(frame, RED, box)
            fine = np.linspace(wanted[0], wanted[-1], 400)
            to_line = np.linalg.norm(found[:, None] - fine, axis=-1)
            assert to_line.min(axis=1).max() < 3.0, "nothing red elsewhere"
            # The contact is drawn over a bit of it.
            hidden = np.linalg.norm(fine - fine[int(400 * 26 / 40)], axis=1) < 10.0
            assert to_line.min(axis=0)[~hidden].max() < 8.0, "red dots all along"


def test_contacts_stay_from_frame_to_frame(known):
    course = course_of(known.recording())
    frames = list(contour_frames(course, line(), [], range(12), [known.peg]))
    for box in _SIDE_BOXES:
        left, bottom, wide, tall = np.array(box) * SIZE[0] / WIDTH
        panel = [
            f[int(SIZE[1] - bottom - tall) : int(SIZE[1] - bottom), int(left) : int(left + wide)]
            for f in frames
        ]
        painted = [(np.ptp(p[..., :3].astype(int), axis=-1) > 60).sum() for p in panel]
        assert painted[-1] > painted[4] > painted[0] - 400
    # The outline of the peg appears with them, wholly in the last frame.
    peg = [(np.abs(p[..., :3].astype(int) - 140).max(axis=-1) < 25).sum() for p in panel]
    assert peg[-1] > peg[-2] + 50 > peg[0]
    # In between two frames none is left out.
    frames = list(contour_frames(course, line(), [], range(12)))
    (last,) = list(contour_frames(course, line(), [], [11]))
    jump = list(contour_frames(course, line(), [], [0, 11]))[-1]
    assert (np.abs(jump[370:].astype(int) - frames[-1][370:]).max(axis=-1) > 30).sum() < 30
    assert (np.abs(last[370:].astype(int) - frames[-1][370:]).max(axis=-1) > 30).sum() > 30


def test_a_window_averages_over_areas():
    generator = np.random.default_rng(1)
    image = generator.integers(0, 255, (40, 60)).astype(np.uint8)
    halves = Window(np.array([9.5, 3.5]), np.array([29.5, 15.5]), (60, 40), (10, 6)).of(image)
    wanted = image[4:16, 10:30].reshape(6, 2, 10, 2).mean(axis=(1, 3))
    assert np.abs(halves - wanted).max() <= 1.0
    beyond = Window(np.array([-10.5, -0.5]), np.array([9.5, 19.5]), (60, 40), (20, 20)).of(image)
    np.testing.assert_array_equal(beyond[:, 10:], image[:20, :10])
    assert np.ptp(beyond[:, :10]) == 0
    with pytest.raises(ValueError, match="the camera has 60 × 40"):
        Window(np.zeros(2), np.ones(2), (60, 40), (4, 4)).of(image.T)


def test_a_movie_is_one_that_any_player_shows(tmp_path):
    sent = np.zeros((6, 48, 64, 4), np.uint8)
    sent[:, :, :32] = [220, 30, 30, 255]
    for k in range(6):
        sent[k, 16:32, 32 + 4 * k : 40 + 4 * k] = [30, 60, 220, 255]
    path = tmp_path / "a.mp4"
    assert write_movie(path, iter(sent), rate=25.0) == 6
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert float(stream.average_rate) == 25.0
        got = np.array([frame.to_ndarray(format="rgb24") for frame in container.decode(stream)])
    assert got.shape == (6, 48, 64, 3)
    assert np.abs(got[:, 4:44, 4:28].astype(int) - [220, 30, 30]).max() < 12
    blue = [np.argwhere(f[..., 2] > 150)[:, 1].mean() for f in got]
    np.testing.assert_allclose(np.diff(blue), 4.0, atol=0.5)


def test_movies_that_cannot_be_written_leave_nothing(tmp_path):
    odd = np.zeros((2, 47, 64, 3), np.uint8)
    with pytest.raises(ValueError, match="even height and width"):
        write_movie(tmp_path / "a.mp4", odd)
    with pytest.raises(ValueError, match=r"must end in \.mp4"):
        write_movie(tmp_path / "a.avi", odd)
    with pytest.raises(ValueError, match="no frames"):
        write_movie(tmp_path / "a.mp4", [])
    with pytest.raises(ValueError, match="rate is 0"):
        write_movie(tmp_path / "a.mp4", [], 0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", ["mkv", "mp4"])
def test_single_frames_are_those_of_the_whole_video(tmp_path, ending):
    generator = np.random.default_rng(0)
    sent = generator.integers(0, 255, (12, 32, 48)).astype(np.uint8)
    path = tmp_path / f"a.{ending}"
    write_video(path, sent, quality=0)
    got = list(video_frames(path, [1, 4, 4, 11]))
    np.testing.assert_array_equal(got, sent[[1, 4, 4, 11]])
    with pytest.raises(ValueError, match="no frame 12"):
        list(video_frames(path, [3, 12]))
    with pytest.raises(ValueError, match="must not decrease"):
        list(video_frames(path, [3, 2]))


def test_frames_are_chosen_by_time():
    time = np.arange(3500) * 1e-3
    rows = FrameOptions().rows(time)
    assert 30.0 <= rows.size / 25.0 <= 60.0
    np.testing.assert_array_equal(
        FrameOptions(25.0, 10, 0.1, 0.13).rows(time), [100, 110, 120, 130]
    )
    for wrong in ({"fps": 0.0}, {"step": 0}, {"start": 4.0}):
        with pytest.raises(ValueError, match=r"--fps|--step|no frames from"):
            FrameOptions(**wrong).rows(time)


@pytest.fixture
def trial(known, tmp_path):
    path = tmp_path / "trial.nc"
    save_recording(path, known.recording())
    return path


def run(*arguments):
    return CliRunner().invoke(app, ["movie", *map(str, arguments)])


@pytest.mark.slow
def test_the_verb_makes_both_movies(trial, tmp_path, coarse):
    done = run(trial, "-o", tmp_path / "new", "--step", 2)
    assert done.exit_code == 0, done.output
    for name in ("trial-signals.mp4", "trial-contour.mp4"):
        info = video_info(tmp_path / "new" / name)
        assert (info.width, info.height, info.frames, info.codec) == (1280, 720, 6, "h264")


def test_videos_are_shown(known, trial, tmp_path):
    videos = []
    for view, grey in zip(known.views, (60, 180), strict=True):
        videos += ["--video", tmp_path / f"{view.name}.mkv"]
        write_video(videos[-1], repeat_frames(grey, 12))
    target = tmp_path / "a.mp4"
    done = run(trial, "-o", target, "--kind", "contour", "--from", 0.002, "--until", 0.004, *videos)
    assert done.exit_code == 0, done.output
    frames = list(video_frames(target, [0, 1, 2]))
    for box, grey in zip(_SIGHT_BOXES, (60, 180), strict=True):
        left, bottom, wide, tall = np.array(box) * SIZE[0] / WIDTH
        row, column = int(SIZE[1] - bottom - 0.9 * tall), int(left + 0.5 * wide)
        seen = [int(frame[row, column]) for frame in frames]
        np.testing.assert_allclose(seen, grey + np.arange(2, 5), atol=2.0)


def test_frames_are_those_that_belong_to_the_times(known, tmp_path):
    trial = known.recording()
    late = np.stack([np.arange(12), np.arange(12) + 3], axis=1)
    trial.dataset = trial.to_dataset().assign(frame=(("time", "view"), late))
    videos = []
    for view in known.views:
        videos.append(tmp_path / f"{view.name}.mkv")
        write_video(videos[-1], repeat_frames(50, 15))
    sights = sights_of(trial, course_of(trial), videos, np.array([0, 5, 11]))
    shown = [[int(image[0, 0]) for image in sight.images] for sight in sights]
    assert shown == [[50, 55, 61], [53, 58, 64]]
    write_video(videos[1], repeat_frames(50, 14))
    with pytest.raises(ValueError, match="has 14 frames; frame 14 is needed"):
        sights_of(trial, course_of(trial), videos, np.array([0, 11]))


def repeat_frames(grey, count):
    """Each frame one grey value lighter."""
    return [np.full((300, 300), grey + k, np.uint8) for k in range(count)]


@pytest.mark.slow
def test_stopped_it_leaves_what_was_done(trial, tmp_path, monkeypatch):
    made = movie_module._frames

    def interrupted(*arguments):
        for k, frame in enumerate(made(*arguments)):
            if k == 2:
                signal.raise_signal(signal.SIGINT)
            yield frame

    monkeypatch.setattr(movie_module, "_frames", interrupted)
    done = run(trial, "-o", tmp_path / "a.mp4", "--kind", "contour")
    assert done.exit_code == 130
    assert "stopped after 3 of 12 frames" in done.output
    assert not (tmp_path / "a.mp4").exists()
    assert len(list(video_frames(tmp_path / "a-part.mp4", [0, 1, 2]))) == 3


def fault(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["vibrissa", "movie", *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    return " ".join(capsys.readouterr().err.split())


def test_what_is_lacking_is_said_with_the_verb_that_makes_it(
    known, trial, tmp_path, monkeypatch, capsys
):
    bare = tmp_path / "bare.nc"
    save_recording(bare, known.recording(signals=False))
    said = fault(monkeypatch, capsys, bare, "--kind", "signals", "-o", tmp_path / "none")
    assert f"no signals: `vibrissa signals {bare}` makes them" in said
    nowhere = (trial, "-o", tmp_path / "none")
    assert "is not one of" in fault(monkeypatch, capsys, *nowhere, "--kind", "x")
    assert "choose one --kind" in fault(monkeypatch, capsys, trial, "-o", tmp_path / "a.mp4")
    video = tmp_path / "small.mkv"
    write_video(video, [np.zeros((20, 20), np.uint8)] * 12)
    assert "give one --video for each" in fault(
        monkeypatch, capsys, *nowhere, "--kind", "contour", "--video", video
    )
    said = fault(
        monkeypatch, capsys, *nowhere, *("--kind", "contour", "--video", video, "--video", video)
    )
    assert "20 × 20 pixels, the camera 'top' has 300 × 300" in said
    # Before the first movie is drawn, if there are two.
    assert "give one --video for each" in fault(monkeypatch, capsys, *nowhere, "--video", video)
    assert not (tmp_path / "none").exists()


def test_frames_without_contacts_or_signals_are_refused(known, samples):
    course = course_of(known.recording(signals=False))
    with pytest.raises(ValueError, match="no signals"):
        signal_frames(course, samples, line(), [0])
    with pytest.raises(ValueError, match="no contact points"):
        contour_frames(course, line(), [], [0, 3])
    with pytest.raises(ValueError, match="no frames"):
        contour_frames(course, line(), [], [])
    with pytest.raises(ValueError, match="whisker 1 was asked for"):
        course_of(known.recording(), 1)
    with pytest.raises(ValueError, match="lacks base_position"):
        course_of(xr.DataTree(xr.Dataset({"a": ("time", [1.0])}, {"time": [0.0]})))
