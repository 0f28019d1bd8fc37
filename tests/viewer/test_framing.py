"""What is shown stands in the middle of what the panel leaves free, as large as fits."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed", exc_type=ImportError)

import vibrissa as vb
from vibrissa.scene import Label
from vibrissa.viewer.map import frame_drawing, overview, solids
from vibrissa.viewer.page import PANEL, Framing, Shot, framed
from vibrissa.viewer.state import charted

FOV = np.deg2rad(75.0)


def on_screen(place, position, look_at, width, height):
    """Pixels from the left and from the top."""
    ahead = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    away = place - position
    focal = 0.5 * height / np.tan(0.5 * FOV)
    seen = np.array([away @ right, -away @ np.cross(right, ahead)]) / (away @ ahead)
    return 0.5 * np.array([width, height]) + focal * seen


def _finish(coroutine):
    """Run what awaits nothing, without a loop: that of a browser under test may be running."""
    with pytest.raises(StopIteration):
        coroutine.send(None)


@pytest.mark.parametrize(
    ("width", "height"), [(1280, 720), (1920, 1080), (900, 480), (480, 800), (3000, 500)]
)
def test_the_centre_is_in_the_middle_of_what_is_free(width, height):
    shot = Shot(np.array([16.0, 4.0, -2.0]), 38.0, np.array([0.15, -0.8, 0.6]))
    position, look_at = framed(shot, width, height, FOV)
    phone = width < 0.65 * height  # there the panel is below, over 55 % of the height
    free = width if phone else max(width - PANEL * height, 0.5 * width)
    middle = 0.225 * height if phone else 0.5 * height
    seen = on_screen(shot.centre, position, look_at, width, height)
    np.testing.assert_allclose(seen, [0.5 * free, middle], atol=1e-6)
    assert np.linalg.norm(position - look_at) >= shot.distance * (1.0 - 1e-12)
    # 1.25 times the distance fits beside the panel.
    aside = np.cross(look_at - position, [0.0, 0.0, 1.0])
    aside *= 0.5 * 1.25 * shot.distance / np.linalg.norm(aside)
    ends = [on_screen(shot.centre + s * aside, position, look_at, width, height) for s in (-1, 1)]
    assert ends[0][0] >= -1e-6
    assert ends[1][0] <= free + 1e-6


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (1280, 800), (1920, 1080)])
def test_no_label_of_the_map_hides_another(width, height):
    """A letter is 7 × 16 pixels."""
    drawn = solids(charted(vb.samples.gamma()), cut=True)
    middle, distance, way, tall = overview(drawn.length)
    position, look_at = framed(Shot(middle, distance, np.array(way), tall), width, height, FOV)
    boxes = {}
    for mark in frame_drawing(drawn, 5.0).values():
        if isinstance(mark, Label):
            left, bottom = on_screen(mark.position, position, look_at, width, height)
            boxes[mark.text] = np.array(
                [[left, bottom - 16.0], [left + 7.0 * len(mark.text), bottom]]
            )
    assert len(boxes) > 8
    free = width - PANEL * height
    for text, box in boxes.items():
        assert box[1, 0] < free, text
        for other, second in boxes.items():
            apart = (box[0] > second[1]).any() or (second[0] > box[1]).any()
            assert apart or text == other, (text, other)


def test_what_is_tall_is_above_the_panel_of_a_phone():
    shot = Shot(np.array([16.0, 4.0, -2.0]), 38.0, np.array([0.15, -0.8, 0.0]), height=1.6)
    width, height = 390, 844
    position, look_at = framed(shot, width, height, FOV)
    up = np.array([0.0, 0.0, 0.8 * shot.distance])
    rows = [on_screen(shot.centre + s * up, position, look_at, width, height)[1] for s in (1, -1)]
    assert rows[0] >= -1e-6
    assert rows[1] <= 0.45 * height + 1e-6


def _window(number):
    """A window that has not been told where its camera belongs, and what its camera calls."""
    heard = []
    camera = SimpleNamespace(
        image_width=390,
        image_height=844,
        fov=FOV,
        on_update=heard.append,
        position=(300.0, 300.0, 300.0),
        look_at=(0.0, 0.0, 0.0),
    )
    return SimpleNamespace(camera=camera, client_id=number, atomic=nullcontext), heard


def _server(windows):
    """A server with these windows, and what it calls when one connects."""
    came = []
    start = SimpleNamespace(fov=FOV, position=(3.0, 3.0, 3.0))
    clients = dict(enumerate(windows))
    server = SimpleNamespace(
        initial_camera=start, on_client_connect=came.append, get_clients=lambda: clients
    )
    return server, came


def test_a_window_that_missed_its_camera_gets_it_again_and_one_that_was_turned_keeps_its_own():
    shot = Shot(np.array([16.0, 4.0, -2.0]), 38.0, np.array([0.15, -0.8, 0.6]))
    window, heard = _window(0)
    sight = window.camera
    began = sight.position
    server, came = _server([])
    framing = Framing(server)
    framing.show(shot)
    came[0](window)
    # The page was not ready for its own, and has that of the graphics or the first of the server.
    for reported in (began, server.initial_camera.position):
        sight.position = reported
        _finish(heard[0](sight))
        np.testing.assert_allclose(sight.position, framed(shot, 390, 844, FOV)[0])
        assert framing.turned is None
    # Nor is it turned if it reports the camera of an earlier view after a new one was shown.
    earlier = sight.position
    server.get_clients()[0] = window
    framing.show(Shot(np.zeros(3), 50.0, np.array([0.0, -1.0, 0.3])))
    newest, sight.position = sight.position, earlier
    _finish(heard[0](sight))
    assert sight.position == newest
    assert framing.turned is None
    sight.position = (1.0, 2.0, 3.0)
    _finish(heard[0](sight))
    assert sight.position == (1.0, 2.0, 3.0)
    np.testing.assert_allclose(framing.turned[:3], sight.position)


def test_a_window_that_connects_after_a_link_was_opened_gets_the_camera_of_the_link():
    window, heard = _window(0)
    server, came = _server([])
    framing = Framing(server)
    framing.show(Shot(np.zeros(3), 38.0, np.array([0.15, -0.8, 0.6])))
    position, target = np.array([1.0, 2.0, 30.0]), np.array([4.0, 5.0, 6.0])
    framing.place(position, target)
    began = window.camera.position
    came[0](window)
    np.testing.assert_allclose(window.camera.position, position)
    np.testing.assert_allclose(window.camera.look_at, target)
    window.camera.position = began  # the page was not ready for it
    _finish(heard[0](window.camera))
    np.testing.assert_allclose(window.camera.position, position)
    _finish(heard[0](window.camera))
    np.testing.assert_allclose(framing.turned, [*position, *target])
