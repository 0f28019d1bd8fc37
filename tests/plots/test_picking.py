"""What is clicked in the window of `vibrissa track --pick`, without a screen."""

import numpy as np
import pytest
from matplotlib.backend_bases import KeyEvent, MouseEvent

from vibrissa.io import Clicks, ViewClicks
from vibrissa.plots import pick
from vibrissa.plots.windows import Picking, Picks

EMPTY = Picks(Clicks((ViewClicks(), ViewClicks())))


def after(picks, *done):
    """Keys are strings, clicks (view, column, row)."""
    for one in done:
        picks = picks.pressed(one) if isinstance(one, str) else picks.clicked(*one)
    return picks


def test_bases_are_clicked_view_by_view():
    first, second = after(EMPTY, (0, 5, 6), (1, 5, 9), (0, 7, 8)).clicks.views
    assert first.base == ((5.0, 6.0), (7.0, 8.0))
    assert second.base == ((5.0, 9.0),)


def test_a_polygon_is_closed_with_enter_and_has_three_corners():
    corners = [(1, 0, 0), (1, 4, 0)]
    assert after(EMPTY, "m", *corners, "enter").clicks == EMPTY.clicks
    done = after(EMPTY, "m", *corners, (1, 4, 4), "enter", "r", (1, 0, 0), *corners, "enter")
    assert done.clicks.views[1].mask == (((0.0, 0.0), (4.0, 0.0), (4.0, 4.0)),)
    assert len(done.clicks.views[1].region) == 1
    assert done.points == ()


def test_corners_of_one_polygon_are_in_one_view():
    assert after(EMPTY, "m", (0, 1, 1), (1, 2, 2), (1, 3, 3)).points == ((2.0, 2.0), (3.0, 3.0))


def test_a_known_length_gives_the_scale():
    done = after(EMPTY, "l", (0, 10, 10), (0, 40, 50), *"2.x5", "enter")
    assert done.clicks.pixel_size == pytest.approx(2.5e-3 / 50.0)
    assert after(EMPTY, "l", (0, 10, 10), *"2.5", "enter").clicks.pixel_size is None
    assert after(EMPTY, "l", (0, 1, 1), (0, 2, 2), "0", "enter").clicks.pixel_size is None


def test_the_window_hands_over_clicks_and_takes_them_back():
    saved = []
    images = [np.full((40, 60), 100, np.uint8)] * 2
    window = Picking(images, ["top", "front"], EMPTY, saved.append)
    canvas = window.figure.canvas
    for view, (x, y) in ((0, (10.0, 20.0)), (1, (12.0, 5.0)), (1, (50.0, 30.0))):
        at = window.figure.axes[view].transData.transform((x, y))
        canvas.callbacks.process(
            "button_press_event", MouseEvent("button_press_event", canvas, *at, 1)
        )
    for key in ("u", "s"):
        canvas.callbacks.process("key_press_event", KeyEvent("key_press_event", canvas, key))
    ((first, second),) = [clicks.views for clicks in saved]
    np.testing.assert_allclose([first.base[0], second.base[0]], [[10.0, 20.0], [12.0, 5.0]])
    assert len(second.base) == 1
    window.close()
    assert len(saved) == 1


def test_without_a_screen_options_are_named():
    with pytest.raises(ValueError, match="--base, --mask"):
        pick([np.zeros((4, 4), np.uint8)], ["top"], None, print)
