"""The window for corrections, by events that a canvas without a screen sends."""

import numpy as np
import pytest
from matplotlib.backend_bases import KeyEvent, MouseEvent
from matplotlib.figure import Figure

from vibrissa.io import FrameReader, load_corrections, save_corrections, write_video
from vibrissa.plots.windows import Correction, correct

FRAMES = [np.full((60, 80), 10 * i, np.uint8) for i in range(25)]


class Person:
    """Somebody at a window."""

    def __init__(self, **how):
        self.saved = []
        self.window = Correction(
            how.pop("frames", FRAMES), how.pop("count", 25), save=self.saved.append, **how
        )
        self.canvas = self.window.figure.canvas
        self.canvas.draw()

    def click(self, column, row, button=1):
        axes = self.window.figure.axes[0]
        x, y = axes.transData.transform((column, row))
        MouseEvent("button_press_event", self.canvas, x, y, button)._process()

    def press(self, *keys):
        for key in keys:
            KeyEvent("key_press_event", self.canvas, key)._process()

    @property
    def title(self):
        return self.window.figure.axes[0].get_title()


def test_clicks_become_points_in_their_order_and_frame():
    person = Person()
    person.click(10, 20)
    person.click(30, 25)
    person.press("right", "right")
    person.click(40, 5.5)
    person.click(50, 6.5)
    person.click(60, 7.5)
    found = person.window.corrections
    assert list(found) == [(0, 0), (2, 0)]
    np.testing.assert_allclose(found[0, 0], [[10, 20], [30, 25]], atol=1e-9)
    np.testing.assert_allclose(found[2, 0], [[40, 5.5], [50, 6.5], [60, 7.5]], atol=1e-9)
    assert person.title == "frame 2 of 25, whisker 0, 3 points · not saved"


def test_keys_move_between_frames_and_stop_at_the_ends():
    person = Person()
    for key, frame in (("left", 0), ("up", 10), ("up", 20), ("up", 24), ("down", 14), ("left", 13)):
        person.press(key)
        assert person.window.frame == frame
    image = person.window.figure.axes[0].images[0]
    np.testing.assert_array_equal(image.get_array(), FRAMES[13])


def test_undo_goes_back_one_change_at_a_time_and_shows_it():
    person = Person()
    person.click(10, 20)
    person.click(30, 25)
    person.press("right")
    person.click(5, 5)
    person.press("d", "u", "u")
    assert person.window.frame == 1
    assert list(person.window.corrections) == [(0, 0)]
    person.press("u")
    assert person.window.frame == 0
    assert person.window.corrections == {}
    person.press("u", "u")
    assert "nothing to undo" in person.title


def test_points_and_traces_can_be_removed():
    person = Person()
    for x in (10, 30, 50):
        person.click(x, 20)
    person.click(29, 22, button=3)
    np.testing.assert_allclose(person.window.corrections[0, 0][:, 0], [10, 50], atol=1e-9)
    person.press("d")
    assert person.window.corrections == {}
    person.click(29, 22, button=3)
    person.press("delete")
    assert person.window.corrections == {}


def test_whiskers_are_kept_apart():
    person = Person()
    person.click(10, 20)
    person.click(30, 20)
    person.press("3")
    person.click(10, 40)
    person.click(30, 40)
    assert list(person.window.corrections) == [(0, 0), (0, 3)]


def test_double_clicks_and_clicks_beside_the_image_count_for_nothing():
    person = Person()
    person.click(10, 20)
    person.click(10.5, 20.5)
    person.click(300, 20)
    person.click(30, 20, button=2)
    person.press("s")
    assert person.saved == [{}]
    assert "1 with one point are left out" in person.title


def test_what_is_saved_is_what_the_reader_reads(tmp_path):
    path = tmp_path / "c.csv"
    generator = np.random.default_rng(0)
    save_corrections(path, {1: {(7, 0): [[1.0, 2.0], [3.0, 4.0]]}})
    before = load_corrections(path)
    window = Correction(
        FRAMES, 25, before[1], save=lambda found: save_corrections(path, {1: found})
    )
    window.go(3)
    for x, y in generator.uniform(5, 55, (4, 2)):
        window.add(x, y)
    assert window.changed
    window.close()
    assert not window.changed
    found = load_corrections(path)[1]
    assert list(found) == [(3, 0), (7, 0)]
    for key, points in window.corrections.items():
        np.testing.assert_array_equal(found[key], points)


def test_leaving_without_saving_saves_nothing():
    person = Person()
    person.click(10, 20)
    person.click(30, 20)
    person.press("escape", "q")
    person.window.close()
    assert person.saved == []


def test_the_next_lost_frame_is_found():
    line = np.column_stack([np.arange(20.0), np.full(20, 30.0)])
    traces = {(i, 0): line for i in range(25)}
    traces[8, 0] = np.full((20, 2), np.nan)
    del traces[11, 0]
    person = Person(traces=traces)
    person.press("l")
    assert person.window.frame == 8
    person.click(1, 2)
    person.press("left", "l")
    assert person.window.frame == 11
    person.press("l")
    assert person.window.frame == 11
    assert "no frame after this one is lost" in person.title


def test_a_video_that_ends_early_shows_its_last_frame(tmp_path):
    path = tmp_path / "v.mkv"
    write_video(path, FRAMES[:5])
    reader = FrameReader(path, memory=2 * 60 * 80)
    person = Person(frames=reader, count=2000)
    person.press("up")
    assert person.window.frame == 4
    assert "of 5" in person.title
    for i in (0, 4, 1, 3, 2):
        np.testing.assert_array_equal(reader[i], FRAMES[i])
    with pytest.raises(IndexError, match="there is no frame 5"):
        reader[5]
    with pytest.raises(IndexError, match="counted from 0"):
        reader[-1]


def test_without_a_screen_it_says_so():
    with pytest.raises(ValueError, match="no screen"):
        correct(FRAMES, 25)
    with pytest.raises(ValueError, match="there are 0 frames"):
        Correction([], 0, figure=Figure())


@pytest.mark.parametrize(
    ("points", "said"), [([[1.0, 2.0]], r"\(n, 2\), n ≥ 2"), ([[1, 2], [np.nan, 2]], "not finite")]
)
def test_what_cannot_be_a_correction_is_not_written(tmp_path, points, said):
    with pytest.raises(ValueError, match=said):
        save_corrections(tmp_path / "c.csv", {0: {(1, 0): points}})
    assert not list(tmp_path.iterdir())
