"""`vibrissa track` on small videos."""

from itertools import islice

import numpy as np
import pytest

import vibrissa as vb
from vibrissa import Whisker
from vibrissa.cameras import orthogonal_views, save_cameras
from vibrissa.cli.app import app
from vibrissa.cli.track import TraceStatements
from vibrissa.io import (
    load_recording,
    load_traces,
    read_video,
    save_centerline,
    save_traces,
    write_video,
)
from vibrissa.objects import Peg
from vibrissa.recording import Recording
from vibrissa.simulation import Motion, film, simulate

typer_testing = pytest.importorskip("typer.testing")
CAMERAS = orthogonal_views(size=(192, 192), center=(4e-3, 0.0, 0.0))


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("videos")
    n = 16
    azimuth = np.linspace(-0.3, 0.1, n)
    whisker = Whisker.parabola(length=8e-3, coefficient=15.0)
    motion = Motion(np.arange(n) / 1000, azimuth, 0.1 + 0 * azimuth, 0 * azimuth, np.zeros((n, 3)))
    trial = simulate(whisker, motion, Peg([5e-3, 1.3e-3, 0.0], [0.0, 0.0, 1.0], 0.5e-3))
    paths = {"top": folder / "top.mkv", "front": folder / "front.mkv"}
    film(trial, paths, CAMERAS)
    save_cameras(folder / "cameras.toml", CAMERAS)
    return folder


def run(*words):
    return typer_testing.CliRunner().invoke(app, [str(word) for word in words])


def arguments(videos, *more):
    return ["track", videos / "top.mkv", videos / "front.mkv", *more]


def stated_bases():
    bases = [f"{x:.0f},{y:.0f}" for x, y in (c.project(np.zeros(3)) for c in CAMERAS)]
    return [word for base in bases for word in ("--base", base)]


@pytest.fixture(scope="module")
def tracked(videos, tmp_path_factory):
    """Folder with the recording of both videos, and what was printed."""
    folder = tmp_path_factory.mktemp("tracked")
    words = ("--cameras", videos / "cameras.toml", "-o", folder / "trial.nc")
    done = run(*arguments(videos, *words))
    assert done.exit_code == 0, done.exception
    return folder, done.stdout


def test_two_videos_become_a_recording(tracked):
    folder, text = tracked
    assert "in contact in" in text
    recording = load_recording(folder / "trial.nc")
    assert recording["trace"].shape[:3] == (16, 1, 2)
    np.testing.assert_allclose(recording["base_position"].values[0, 0], 0.0, atol=2e-4)
    assert sorted(p.name for p in folder.iterdir()) == ["start.png", "trial.nc"]


def test_what_is_taken_for_the_whisker_is_said_and_shown(tracked):
    folder, text = tracked
    (line,) = [line for line in text.splitlines() if "taken to begin at" in line]
    base = CAMERAS[0].project(np.zeros(3))
    said = np.array(line.split("begin at ")[1].split(" (top)")[0].split(","), dtype=float)
    assert np.linalg.norm(said - base) < 5.0
    assert "start.png" in line
    assert "1000 frames/s (--rate)" in text
    assert "pixel size" not in text
    assert (folder / "start.png").read_bytes().startswith(b"\x89PNG")


def test_views_that_contradict_each_other_are_refused_with_a_picture(videos, tmp_path):
    """Moved sideways by a fifth, the front view shows no base in the column of the top view."""
    frames = [np.roll(frame, 40, axis=1) for frame in read_video(videos / "front.mkv")]
    write_video(tmp_path / "moved.mkv", frames)
    words = ["track", videos / "top.mkv", tmp_path / "moved.mkv"]
    (tmp_path / "start.png").write_text("of another recording")
    (tmp_path / "other.nc").touch()
    done = run(*words, "--cameras", videos / "cameras.toml", "-o", tmp_path / "t.nc")
    assert done.exit_code != 0
    assert "--base X,Y --base X,Y" in str(done.exception)
    assert (tmp_path / "t.start.png").exists()
    assert (tmp_path / "start.png").read_text() == "of another recording"
    assert not (tmp_path / "t.nc").exists()


def test_clicks_are_saved_and_used_again(videos, tmp_path, monkeypatch):
    """A window in which both bases, a mask and the scale are shown, and a second run without it."""
    out, begun = tmp_path / "t.nc", []

    def pick(images, names, clicks, save):
        bases = [tuple(camera.project(np.zeros(3)).tolist()) for camera in CAMERAS]
        mask = ((150.0, 0.0), (191.0, 0.0), (191.0, 40.0))
        views = [vb.io.ViewClicks((base,), (mask,)) for base in bases]
        save(vb.io.Clicks(tuple(views), (), 60e-6))
        return vb.io.Clicks(tuple(views), (), 60e-6)

    def trace(path, kept, bases, options, mask=None, **more):
        begun.append((bases, int(mask.sum())))
        raise ValueError("enough")

    monkeypatch.setattr("vibrissa.plots.pick", pick)
    monkeypatch.setattr("vibrissa.tracking.trace_file", trace)
    run(*arguments(videos, "--pick", "-o", out))
    (tmp_path / "t.clicks.toml").rename(tmp_path / "kept.toml")
    run(*arguments(videos, "--clicks", tmp_path / "kept.toml", "-o", out))
    (tmp_path / "kept.toml").rename(tmp_path / "t.clicks.toml")
    done = run(*arguments(videos, "-o", out))
    assert begun[0][0][0] == pytest.approx(CAMERAS[0].project(np.zeros(3)), abs=0.01)
    assert begun[0][1] > 700
    for other in begun[1:]:
        np.testing.assert_allclose(other[0], begun[0][0], atol=0.01)
        assert other[1] == begun[0][1]
    line = " ".join(done.stdout.split())
    assert "is used: bases of 1 whiskers, 2 masks and regions, a pixel of 0.06 mm" in line


@pytest.mark.slow
def test_a_mask_hides_what_is_in_it_and_a_region_what_is_not(videos, tmp_path):
    """The whisker's half beyond a column is masked: no part of it is seen there."""
    cameras = ["--cameras", videos / "cameras.toml"]
    square = [f"{a},{b}" for a, b in ((110, 0), (192, 0), (192, 192), (110, 192))]
    image = np.zeros((192, 192), np.uint8)
    image[:, :110] = 255
    write_video(tmp_path / "shown.mkv", [image])
    out = tmp_path / "t.nc"
    words = ["--mask", "0:" + " ".join(square), "--region", f"1:{tmp_path / 'shown.mkv'}"]
    done = run(*arguments(videos, *cameras, *words, "-o", out))
    assert done.exit_code == 0, done.exception
    seen = load_recording(out)["trace"].values[:, 0]
    whole = 0.5 * np.nanmax(CAMERAS[0].project(np.array([8e-3, 0.0, 0.0])))
    assert np.nanmax(seen[..., 0]) > whole
    assert np.nanmax(seen[..., 0]) < 130.0
    done = run(*arguments(videos, "--mask", "2:1,1 2,2 3,1", "-o", tmp_path / "u.nc"))
    assert "with a view from 0 to 1" in str(done.exception)


@pytest.mark.slow
def test_the_stated_radius_is_that_of_the_base_inside_the_fur(videos, tmp_path):
    """The whisker is thinner where the fur ends; the error of all forces is one number."""
    out = tmp_path / "t.nc"
    cameras = ["--cameras", videos / "cameras.toml"]
    done = run(*arguments(videos, *cameras, "--base-radius", 0.05, "--fur", 0.8, "-o", out))
    assert done.exit_code == 0, done.exception
    whisker = Recording(load_recording(out)).whisker()
    tip, length = 50e-6 / 15.0, whisker.length
    edge = 50e-6 - (50e-6 - tip) * 0.8e-3 / (length + 0.8e-3)
    np.testing.assert_allclose(whisker.radius(np.array([0.0, length])), [edge, tip], rtol=1e-9)
    # Forces at a length of fur that is 0.2 mm off, by the fourth power of the radius.
    other = 50e-6 - (50e-6 - tip) * 1.0e-3 / (length + 1.0e-3)
    percent = 100.0 * (1.0 - (other / edge) ** 4)
    note = " ".join(done.stdout.split()).split("forces and moments, ")[1].split(" %")[0]
    assert float(note) == pytest.approx(percent, rel=0.2)
    done = run(*arguments(videos, "--fur", 0.8, "--whisker", out, "-o", tmp_path / "u.nc"))
    assert "cut it there" in str(done.exception)


@pytest.mark.slow
def test_several_trials_go_to_a_folder(videos, tmp_path):
    (tmp_path / "second_top.mkv").write_bytes((videos / "top.mkv").read_bytes())
    words = [videos / "top.mkv", videos / "front.mkv", tmp_path / "second_top.mkv"]
    words += [videos / "front.mkv", "--cameras", videos / "cameras.toml"]
    folder = tmp_path / "new"
    done = run("track", *words, "-o", folder)
    assert done.exit_code == 0, done.exception
    one, two = (load_recording(folder / name) for name in ("top.nc", "second_top.nc"))
    np.testing.assert_array_equal(one["force"].values, two["force"].values)
    done = run("track", *words, "-o", tmp_path / "one.nc")
    assert "a folder is needed" in str(done.exception)


def test_what_is_traced_is_not_traced_again(videos, tmp_path, monkeypatch):
    """Stopped in the second video, the first is not looked at again."""
    import vibrissa.tracking.trace.video as view

    out = tmp_path / "trial.nc"
    follow, calls = view.follow_all, []

    def stopping(*what):
        calls.append(1)
        if len(calls) == 20:
            raise KeyboardInterrupt
        return follow(*what)

    monkeypatch.setattr(view, "follow_all", stopping)
    words = arguments(videos, "--cameras", videos / "cameras.toml", "-o", out, *stated_bases())
    run(*words)
    assert len(calls) == 20
    assert not out.exists()
    done = run(*words)
    assert done.exit_code == 0, done.exception
    assert len(calls) == 20 + (32 - 19)
    assert out.exists()


@pytest.mark.slow
def test_what_is_known_besides_the_videos_is_used(videos, tmp_path):
    out, head = tmp_path / "trial.nc", tmp_path / "head.csv"
    names = "frame,x,y,z,azimuth,elevation,roll"
    head.write_text("\n".join([names, *(f"{i},0.001,0,0,0,0,0" for i in range(16))]))
    objects = tmp_path / "peg.toml"
    objects.write_text("[[object]]\nposition = [5.0, 1.3, 0.0]\ndiameter = 1.0\n")
    whisker = tmp_path / "whisker.csv"
    save_centerline(whisker, Whisker.parabola(length=8e-3, coefficient=15.0).centerline(60))
    words = arguments(videos, "--cameras", videos / "cameras.toml", "-o", out)
    done = run(*words, "--head", head, "--objects", objects, "--whisker", whisker)
    assert done.exit_code == 0, done.exception
    assert "contact point (nearest to the object)" in done.stdout
    recording = load_recording(out)
    place = recording["base_position"].values - recording["base_position_head"].values
    np.testing.assert_allclose(place[:, 0], np.tile([1e-3, 0.0, 0.0], (16, 1)), atol=1e-12)
    assert len(Recording(recording).objects) == 1
    assert Recording(recording).whisker().length == pytest.approx(8e-3, rel=1e-3)
    told = run("info", out).stdout
    assert "contact point (nearest to the object)" in " ".join(told.split())
    for table, kind in ((head, "the head's pose"), (whisker, "centreline of a whisker")):
        assert kind in run("info", table).stdout
    head.write_text(head.read_text().rsplit("\n", 3)[0])
    done = run(*words, "--head", head, "--force")
    assert "missing for 3 frames of the video, the first of which is 13" in str(done.exception)
    done = run(*words, "--contact", head, "--objects", objects, "--force")
    assert "give one" in str(done.exception)


@pytest.mark.parametrize("by_whisker", [True, False])
def test_bases_are_stated_by_whisker_or_by_view(capsys, by_whisker):
    """By view they are easily stated in the other order, so that it is said what was read."""
    by_view = ["10,11", "20,21", "30,31", "40,41"]
    stated = ["10,11,30,31", "20,21,40,41"] if by_whisker else by_view
    found = TraceStatements(base=stated).bases(CAMERAS, None)
    assert found == [[[10, 11], [20, 21]], [[30, 31], [40, 41]]]
    said = " ".join(capsys.readouterr().err.split())
    assert ("the first 2 are taken for those of the first view" in said) is not by_whisker


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--base", "20,30"), "all views need as many"),
        (("--base", "20,30,40"), "x of view 0,y of view 0,x of view 1,y of view 1 are needed"),
        (("--offset", "some"), "a number of frames or auto"),
        (("--pixel-size", "0"), "--pixel-size is 0 mm"),
        (("--base-width", "nan"), "--base-width is nan"),
        (("--jump", "-1"), "--jump is -1"),
        (("--fur", "30"), "--fur is 30 mm; 0 to 20"),
        (("--region", "0:1,1 2,2"), "at least three corners"),
        (("--pixel-size", "58"), "11.136 m wide; it must be in mm"),
        (("--pixel-size", "1e-6"), "m wide; it must be in mm"),
        (("--length", "0.03"), "--length is 0.03 mm; 0.5 to 500 mm"),
        (("--base-radius", "0.1", "--tip-radius", "0.2"), "are they exchanged?"),
        (("--rate", "0"), "--rate is 0"),
        (("--rate", "170", "--cutoff", "85"), "below half of 170 frames/s"),
        (("--cutoff", "0.06"), "longer than the recording"),
        (("--base-radius", "-1"), "--base-radius is -1"),
        (("--rat", "C2", "--base-radius", "0.1"), "--rat determines the radii"),
        (("--rat", "Z9"), "Z9"),
        (("--base-end", "last"), "--base-end needs a --whisker"),
        (("--base", "20,30", "--base", "20,192"), "outside of view 1, 192 × 192 pixels"),
    ],
)
def test_what_cannot_be_tracked_says_why_before_the_work(videos, tmp_path, monkeypatch, more, said):
    monkeypatch.setattr("vibrissa.tracking.trace_file", None)
    done = run(*arguments(videos, *more, "-o", tmp_path / "t.nc"))
    assert done.exit_code != 0
    assert said in str(done.exception)


def test_one_video_is_not_two_views(videos, tmp_path):
    done = run("track", videos / "top.mkv", videos / "top.mkv", "-o", tmp_path / "t.nc")
    assert "a video is given twice" in str(done.exception)


def test_videos_that_differ_in_length_are_told(videos, tmp_path):
    write_video(tmp_path / "front.mkv", islice(read_video(videos / "front.mkv"), 13))
    words = ["track", videos / "top.mkv", tmp_path / "front.mkv"]
    done = run(*words, "--cameras", videos / "cameras.toml", "-o", tmp_path / "t.nc")
    assert done.exit_code == 0, done.exception
    told = " ".join(done.stdout.split())
    assert "front.mkv 13); 13 of each are used" in told
    assert load_recording(tmp_path / "t.nc").sizes["time"] == 13


def test_traces_are_kept_for_their_own_video_only(tmp_path):
    line = np.arange(6.0).reshape(3, 2)
    row = (line, np.ones(3), np.ones(3, dtype=bool), 0.5, True, False, 0.2, False)
    lost = (np.empty((0, 2)), np.empty(0), np.empty(0, dtype=bool), 0.0, True, True, 0.0, False)
    save_traces(tmp_path / "t.npz", "this", [[row, lost], [lost, row]])
    ((first, second), (third, fourth)) = load_traces(tmp_path / "t.npz", "this")
    np.testing.assert_array_equal(first[0], row[0])
    assert len(second[0]) == len(third[0]) == 0
    assert fourth[3:] == row[3:]
    assert load_traces(tmp_path / "t.npz", "other") is None
    assert load_traces(tmp_path / "none.npz", "this") is None
    (tmp_path / "t.npz").write_bytes(b"damaged")
    assert load_traces(tmp_path / "t.npz", "this") is None


@pytest.mark.slow
def test_one_video_is_tracked_in_its_plane_and_reconstructed(videos, tmp_path):
    out = tmp_path / "side.nc"
    words = ["track", videos / "top.mkv", "--pixel-size", 0.058, "-o", out]
    done = run(*words)
    assert done.exit_code == 0, done.exception
    assert "note: one view:" in done.stdout
    recording = load_recording(out)
    assert recording["trace"].shape[:3] == (16, 1, 1)
    assert run("signals", out).exit_code == 0
    assert "Not measured" in run("info", out).stdout


def test_a_mirror_gives_two_views_in_one_video(videos, tmp_path):
    """The second view is left of the first, and its left and right are exchanged."""
    both = [list(islice(read_video(videos / f"{name}.mkv"), 5)) for name in ("top", "front")]
    for name, frames in zip(("top", "front"), both, strict=True):
        write_video(tmp_path / f"{name}.mkv", frames)
    frames = [np.hstack([front[:, ::-1], top]) for top, front in zip(*both, strict=True)]
    write_video(tmp_path / "mirror.mkv", frames)
    views = ["192,0,192,192", "0,0,192,192:mirrored"]
    for name, words in {
        "one.nc": ["--views", *views],
        "two.nc": ["--views", " ".join(views)],
    }.items():
        done = run("track", tmp_path / "mirror.mkv", *words, "-o", tmp_path / name)
        assert done.exit_code == 0, done.exception
    done = run("track", tmp_path / "top.mkv", tmp_path / "front.mkv", "-o", tmp_path / "files.nc")
    assert done.exit_code == 0, done.exception
    assert "pixel size assumed, not stated: 0.058 mm" in " ".join(done.stdout.split())
    one, two, files = (
        load_recording(tmp_path / f"{name}.nc")["trace"].values for name in ("one", "two", "files")
    )
    np.testing.assert_array_equal(one, files)
    np.testing.assert_array_equal(two, files)


@pytest.mark.slow
def test_frames_that_the_rod_does_not_explain_are_in_doubt_and_swapped_names_noted(
    videos, tmp_path, monkeypatch
):
    for name, other in (("top", "front"), ("front", "top")):
        (tmp_path / f"{name}.mkv").symlink_to(videos / f"{other}.mkv")
    monkeypatch.setattr("vibrissa.tracking.unexplained_frames", lambda misfit: misfit > 0.0)
    words = ["track", tmp_path / "front.mkv", tmp_path / "top.mkv", "-o", tmp_path / "t.nc"]
    done = run(*words)
    assert done.exit_code == 0, done.exception
    line = " ".join(done.stdout.split())
    assert "front.mkv is used as the top view and top.mkv as the front view" in line
    assert "not sure that what is followed" in line
    assert (tmp_path / "doubt.png").exists()


@pytest.mark.parametrize("view", ["0,0,192", "0,0,192,500", "0,0,192,192:turned", "0,0,0,192"])
def test_views_that_cannot_be_are_refused(videos, tmp_path, view):
    done = run("track", videos / "top.mkv", "--views", view, "-o", tmp_path / "t.nc")
    assert done.exit_code != 0
    assert "COLUMN,ROW,WIDTH,HEIGHT" in str(done.exception)


def test_a_whisker_that_is_often_lost_is_in_doubt_with_a_picture(videos, tmp_path):
    """The front view shows no whisker in every third frame."""
    frames = list(read_video(videos / "front.mkv"))
    light = np.full_like(frames[0], np.percentile(frames[0], 80))
    shown = [light if i % 3 == 2 else frame for i, frame in enumerate(frames)]
    write_video(tmp_path / "front.mkv", shown)
    words = ["track", videos / "top.mkv", tmp_path / "front.mkv", "-o", tmp_path / "t.nc"]
    done = run(*words, "--cameras", videos / "cameras.toml", *stated_bases())
    assert done.exit_code == 0, done.exception
    line = " ".join(done.stdout.split())
    assert "not sure: in 5 of 16 frames front loses whisker 0" in line
    assert "doubt.png" in line
    assert (tmp_path / "doubt.png").exists()
