"""Calibration from painted images of a checkerboard by cameras that are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vibrissa.trial import Camera, calibrate

pytest.importorskip("cv2")

SQUARE = 2e-3
CORNERS = (7, 5)


SIZE = (400, 300)
FINE = 2


def camera(name, turn, shift):
    matrix = [[950.0, 0.0, 199.5], [0.0, 950.0, 149.5], [0.0, 0.0, 1.0]]
    rotation = Rotation.from_rotvec(turn).as_matrix()
    return Camera(matrix, rotation, shift, [-0.08], size=SIZE, name=name)


PAIR = (
    camera("left", [0.0, 0.0, 0.0], [0.0, 0.0, 0.08]),
    camera("right", [0.0, 0.6, 0.0], [0.002, 0.0, 0.085]),
)


def sights(view):
    """Lines of sight of all samples."""
    fine = (np.arange(FINE) + 0.5) / FINE - 0.5
    columns, rows = ((np.arange(n)[:, None] + fine).reshape(-1) for n in SIZE)
    return view.rays(np.stack(np.meshgrid(columns, rows), axis=-1))


def painted(sight, turn, shift):
    """The board as a camera sees it."""
    origin, direction = sight
    rotation = Rotation.from_rotvec(turn).as_matrix()
    along = ((shift - origin) @ rotation[:, 2]) / (direction @ rotation[:, 2])
    place = (origin + along[..., None] * direction - shift) @ rotation[:, :2] / SQUARE
    square = np.floor(place)
    board = (np.abs(square - np.array([3.0, 2.0]) + 0.5) < np.array([4.5, 3.5])).all(axis=-1)
    dark = board & (square.sum(axis=-1) % 2 == 0)
    grey = np.where(dark, 30.0, 220.0)
    return grey.reshape(SIZE[1], FINE, SIZE[0], FINE).mean(axis=(1, 3)).astype(np.uint8)


@pytest.fixture(scope="module")
def images():
    generator = np.random.default_rng(0)
    series = {view.name: [] for view in PAIR}
    seen = {view.name: sights(view) for view in PAIR}
    for _ in range(10):
        turn = generator.uniform(-0.45, 0.45, 3)
        shift = generator.uniform(-2e-3, 2e-3, 3) - np.array([6e-3, 4e-3, 0.0])
        for view in PAIR:
            series[view.name].append(painted(seen[view.name], turn, shift))
    return series


def test_cameras_are_found_again(images):
    cameras, error = calibrate(images, CORNERS, SQUARE)
    assert error < 0.1
    assert [c.name for c in cameras] == ["left", "right"]
    for found, true in zip(cameras, PAIR, strict=True):
        assert found.matrix[0, 0] == pytest.approx(true.matrix[0, 0], rel=0.02)
    # What matters is where the cameras stand relative to each other.
    turn, wanted = (b.rotation @ a.rotation.T for a, b in (cameras, PAIR))
    angle = Rotation.from_matrix(turn @ wanted.T).magnitude()
    assert np.degrees(angle) < 0.7


def test_too_few_boards_say_so(images):
    few = {name: series[:2] for name, series in images.items()}
    with pytest.raises(ValueError, match="in 2 images"):
        calibrate(few, CORNERS, SQUARE)
    with pytest.raises(ValueError, match="as many each"):
        calibrate({"left": images["left"]}, CORNERS, SQUARE)
