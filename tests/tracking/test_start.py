"""Where a whisker begins, found without a click in films with all that looks like one."""

import numpy as np
import pytest
from furry import Film, Setup

from vibrissa.io import VideoInfo, write_video
from vibrissa.tracking import TraceOptions, find_start, start_frames, trace_video
from vibrissa.tracking.trace.curves import Segment, joined, segments
from vibrissa.tracking.trace.scene import Scene, nth_largest
from vibrissa.tracking.trace.start import negative

SMALL = {"size": (320, 320), "frames": 16, "rate": 40.0}


@pytest.fixture(scope="module")
def films():
    """Films whose frames are spread over some whisks, made once."""
    made = {}

    def film(seed, **setup):
        key = seed, tuple(sorted(setup.items()))
        if key not in made:
            made[key] = Film(Setup(seed=seed, **{**SMALL, **setup}))
        return made[key]

    return film


def misses(film, start):
    """Distance of the bases from where the whisker leaves the fur, view by view, pixels."""
    true = [view[0][0] for view in film.curves]
    return [float(np.linalg.norm(b - t)) for b, t in zip(start.bases, true, strict=True)]


@pytest.mark.parametrize(
    ("seed", "setup"),
    [
        (200, {}),
        pytest.param(201, {}, marks=pytest.mark.slow),
        pytest.param(202, {"crf": 28}, marks=pytest.mark.slow),
        pytest.param(206, {"noise": 8.0}, marks=pytest.mark.slow),
        pytest.param(203, {"bright": True}, marks=pytest.mark.slow),
        pytest.param(207, {"still": True}, marks=pytest.mark.slow),
    ],
    ids=["left", "another", "compressed", "noisy", "bright", "at rest"],
)
def test_the_whisker_is_found_among_fur_glint_and_wires(films, seed, setup):
    film = films(seed, **setup)
    start = find_start(film.cameras, film.frames)
    assert max(misses(film, start)) < 5.0
    assert start.confidence > 0.5
    assert start.bright == setup.get("bright", False)
    assert bool(start.doubts) == setup.get("still", False)
    for view, line in enumerate(start.lines):
        away = np.linalg.norm(line[:, None] - film.curves[view][start.frame][None], axis=2)
        assert np.median(away.min(axis=1)) < 1.5


def test_a_lit_whisker_in_a_dark_field_begins_at_the_lit_face(films):
    """All grey values are below 100, as in films with little light that comes from in front."""
    film = films(202)
    lit = [
        [(26.0 + 0.5 * np.clip(170.0 - frame, 0.0, None)).astype(np.uint8) for frame in view]
        for view in film.frames
    ]
    start = find_start(film.cameras, lit)
    assert start.bright
    assert start.confidence > 0.8
    assert max(misses(film, start)) < 5.0


@pytest.mark.slow
def test_followed_from_there_no_frame_is_lost():
    film = Film(Setup(seed=200, **{**SMALL, "frames": 24, "rate": 500.0}))
    start = find_start(film.cameras, [view[::3] for view in film.frames])
    for view, frames in enumerate(film.frames):
        (row,) = trace_video(frames, [start.bases[view]], TraceOptions(bright=start.bright))
        for i, trace in enumerate(row):
            away = np.linalg.norm(trace.line[:, None] - film.curves[view][i][None], axis=2)
            assert np.median(away.min(axis=1)) < 1.5


@pytest.mark.parametrize("inside", [12.0, 28.0])
def test_a_click_inside_the_fur_is_for_the_whisker_that_leaves_it(films, inside):
    film = films(200)
    for view, frames in enumerate(film.frames):
        true = film.curves[view][0]
        ahead = true[20] - true[0]
        click = true[0] - inside * ahead / np.linalg.norm(ahead)
        (row,) = trace_video(frames[:1], [click])
        away = np.linalg.norm(row[0].line[:, None] - true[None], axis=2)
        assert np.median(away.min(axis=1)) < 1.5
        assert row[0].support > 0.7 * np.linalg.norm(np.diff(true, axis=0), axis=1).sum()


@pytest.mark.slow
def test_films_without_a_whisker_are_in_doubt(films):
    film = films(205, whisker=False)
    start = find_start(film.cameras, film.frames)
    assert start.bases is None or start.confidence < 0.5
    assert start.doubts


def test_a_wall_that_hides_the_tip_from_one_view_is_no_reason_for_doubt(films):
    film = films(202)
    line, front = film.curves[1][0], [frame.copy() for frame in film.frames[1]]
    at = int(line[int(0.45 * len(line)), 0])
    for frame in front:
        frame[:, slice(at, None) if line[-1, 0] > at else slice(at)] = 40
    start = find_start(film.cameras, [film.frames[0], front])
    assert max(misses(film, start)) < 3.0
    assert start.agreed == (10, 10)
    assert not start.doubts


@pytest.mark.slow
def test_views_of_different_whiskers_are_in_doubt(films):
    """Each view shows a whisker, at other columns and in other frames than the other one."""
    one, other = films(200), films(201)
    for first, second in ((one, other), (other, one)):
        front = [np.roll(frame, 20, axis=1) for frame in second.frames[1]]
        start = find_start(first.cameras, [first.frames[0], front])
        assert start.bases is None or start.confidence < 0.5
        assert start.doubts


def test_bright_whiskers_begin_where_dark_ones_do(films):
    film = films(200)
    dark = find_start(film.cameras, film.frames)
    bright = find_start(film.cameras, [[negative(f) for f in view] for view in film.frames])
    assert (dark.bright, bright.bright) == (False, True)
    for a, b in zip(dark.bases, bright.bases, strict=True):
        # Grey values are rounded before and after the light is taken from them.
        np.testing.assert_allclose(a, b, atol=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [241, pytest.param(242, marks=pytest.mark.slow)])
def test_before_grey_fur_a_whisker_is_found_along_the_lines_of_sight_of_the_other_view(films, seed):
    """Grey fur behind it in the front view hides where it begins: only the top view shows that."""
    film = films(seed, cheek=True)
    start = find_start(film.cameras, film.frames)
    assert start.confidence > 0.5
    assert max(misses(film, start)) < 10.0
    true, line = film.curves[1][start.frame], start.lines[1]
    away = np.linalg.norm(line[:, None] - true[None], axis=2).min(axis=1)
    assert np.median(away) < 1.5
    assert np.mean(away < 4.0) > 0.9


@pytest.mark.slow
def test_before_grey_fur_it_is_followed_from_its_base():
    """Not only beyond the cheek, where it is dark before open ground."""
    film = Film(Setup(seed=101, frames=16, rate=250.0, cheek=True))
    true = film.curves[1]
    (row,) = trace_video(film.frames[1], [true[0][0]], TraceOptions(bright=False))
    shown = []
    for trace, curve in zip(row, true, strict=True):
        if len(trace.line):
            away = np.linalg.norm(trace.line[:, None] - curve[None], axis=2)
            assert np.median(away.min(axis=1)) < 1.5
            shown.append(np.mean(away.min(axis=0) < 2.0))
    assert len(shown) > 0.5 * len(row)
    assert np.median(shown) > 0.8


def test_fur_in_which_no_whisker_is_to_be_seen_is_in_doubt(films):
    """The top view shows a whisker, the front view grey fur and nothing else."""
    shown, empty = films(241, cheek=True), films(241, cheek=True, whisker=False)
    start = find_start(shown.cameras, [shown.frames[0], empty.frames[1]])
    assert start.bases is None or start.confidence < 0.5
    assert start.doubts


def test_one_frame_is_enough_on_even_ground(filmed):
    """Mirrored left to right, the bases are mirrored, but for what a pixel is rounded to."""
    frames = [view[0] for view in filmed.frames]
    bases = find_start(filmed.cameras, [[frame] for frame in frames]).bases
    width = frames[0].shape[1]
    mirrored = find_start(filmed.cameras, [[frame[:, ::-1]] for frame in frames]).bases
    for base, other in zip(bases, mirrored, strict=True):
        np.testing.assert_allclose([width - 1.0 - other[0], other[1]], base, atol=2.0)


def test_views_without_frames_are_refused(filmed):
    with pytest.raises(ValueError, match="every view needs as many"):
        find_start(filmed.cameras, [filmed.frames[0][:3], filmed.frames[1][:2]])
    with pytest.raises(ValueError, match="every view needs as many"):
        find_start(filmed.cameras, [[], []])


@pytest.mark.parametrize("claimed", [None, 0, 90], ids=["right", "none", "too many"])
@pytest.mark.parametrize("offset", [0, 2, -3])
def test_frames_of_the_same_moments_are_read(tmp_path, monkeypatch, claimed, offset):
    """Each frame is as grey as its number says, whatever the file says of how many there are."""
    videos = [tmp_path / "top.mkv", tmp_path / "front.mkv"]
    for video in videos:
        write_video(video, [np.full((32, 32), 5 * i, np.uint8) for i in range(40)])
    if claimed is not None:
        info = VideoInfo(32, 32, claimed, 50.0, "ffv1")
        monkeypatch.setattr("vibrissa.tracking.trace.video.video_info", lambda video: info)
    numbers, (first, second) = start_frames(videos, offset)
    assert len(numbers) >= 25
    assert [int(f[0, 0]) // 5 for f in first] == numbers
    assert [int(f[0, 0]) // 5 for f in second] == [n + offset for n in numbers]


@pytest.mark.parametrize("seed", range(3))
def test_the_background_is_an_order_statistic(seed):
    generator = np.random.default_rng(seed)
    frames = generator.integers(0, 256, (11, 6, 7)).astype(np.uint8)
    out = np.empty((6, 7), np.float32)
    for rank in (1, 3, 11):
        nth_largest(frames, np.ones(11, np.float32), rank, out)
        np.testing.assert_allclose(out, np.sort(frames, axis=0)[-rank], rtol=1e-6)


def dark_line(angle, size=160, gap=0.0, noise=1.5):
    """A dark line through the middle of an even image, and how far each pixel is along it."""
    y, x = np.mgrid[:size, :size] - 0.5 * (size - 1)
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    shown = (np.abs(along) < 60.0) & (np.abs(along) >= 0.5 * gap)
    image = 180.0 - 70.0 * shown * np.exp(-0.5 * (across / 1.2) ** 2)
    image += np.random.default_rng(0).normal(0.0, noise, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("angle", np.linspace(0.0, np.pi, 9)[:-1])
def test_a_line_of_any_direction_is_one_segment_in_its_middle(angle):
    frame = dark_line(angle)
    scene = Scene.of([frame])
    found = segments(scene.difference(frame), scene.bodies(frame))
    (line,) = [one for one in found if len(one.points) > 60]
    x, y = (line.points - 0.5 * (frame.shape[0] - 1)).T
    across = y * np.cos(angle) - x * np.sin(angle)
    assert np.abs(across[4:-4]).max() < 0.3  # ends are drawn aside by noise
    assert np.hypot(np.ptp(x), np.ptp(y)) == pytest.approx(120.0, abs=6.0)


@pytest.mark.parametrize("angle", [0.3, 1.4, 2.5])
def test_parts_of_one_line_are_joined_and_parallel_lines_are_not(angle):
    frame = dark_line(angle, gap=20.0)
    scene = Scene.of([frame])
    bodies = scene.bodies(frame)
    found = segments(scene.difference(frame), bodies)
    assert max(len(one.points) for one in found) < 60
    assert max(np.ptp(one.points, axis=0).max() for one in joined(found, bodies)) > 80
    # Where a whisker begins nothing goes on.
    middle = np.full((1, 2), 0.5 * (frame.shape[0] - 1.0))
    assert len(joined(found, bodies, middle)) == len(found)
    x = np.arange(50.0)
    beside = [
        Segment(np.stack([x + 55.0 * k, 40.0 + 9.0 * k + 0.0 * x], axis=1), np.full(50, 20.0))
        for k in range(2)
    ]
    assert len(joined(beside, bodies)) == 2


def test_the_first_frame_that_shows_the_whisker_is_reported(films):
    film = films(200)
    frames = [[np.max(view, axis=0)] * 5 + list(view[5:]) for view in film.frames]
    start = find_start(film.cameras, frames)
    assert start.begins >= 5
    true = [view[start.begins][0] for view in film.curves]
    for base, at in zip(start.bases, true, strict=True):
        assert np.linalg.norm(base - at) < 25.0


def test_a_base_outside_of_the_image_is_in_doubt(films):
    film = films(200)
    begin, *_, end = film.curves[0][0][:, 0].astype(int)
    part = slice(begin + 15, None) if end > begin else slice(None, begin - 15)
    start = find_start(film.cameras, [[frame[:, part] for frame in view] for view in film.frames])
    assert any("cuts off its base" in why for why in start.doubts)


def test_flickering_light_moves_nothing(films):
    film = films(200)
    lamp = 0.75 + 0.25 * np.cos(np.arange(SMALL["frames"]))
    dim = [
        [np.asarray(np.rint(f * s), dtype=np.uint8) for f, s in zip(view, lamp, strict=True)]
        for view in film.frames
    ]
    start = find_start(film.cameras, dim)
    assert max(misses(film, start)) < 5.0
    assert not start.doubts


def test_saturated_ground_shows_no_tip(films):
    """Thin tips are not seen there, at different lengths in the views."""
    film = films(200)
    bright = [
        [np.clip(2.0 * frame, 0, 255).astype(np.uint8) for frame in view] for view in film.frames
    ]
    assert min((view[0] == 255).mean() for view in bright) > 0.3
    start = find_start(film.cameras, bright)
    assert max(misses(film, start)) < 5.0
    assert not start.doubts


def test_a_lamp_that_is_off_at_first_hides_no_whisker(films):
    """Divided by their brightness, dark frames are noise, which is no background."""
    film, generator = films(200), np.random.default_rng(0)
    lamp = np.where(np.arange(SMALL["frames"]) < 0.2 * SMALL["frames"], 0.05, 1.0)
    dim = [
        [
            np.asarray(
                np.rint(f * s + generator.integers(0, 5, f.shape) * (s < 1.0)), dtype=np.uint8
            )
            for f, s in zip(view, lamp, strict=True)
        ]
        for view in film.frames
    ]
    start = find_start(film.cameras, dim)
    assert lamp[start.begins] == 1.0
    true = [view[start.begins][0] for view in film.curves]
    for base, at in zip(start.bases, true, strict=True):
        assert np.linalg.norm(base - at) < 5.0
