"""Calibration from painted images of a checkerboard by cameras that are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vibrissa.cameras import Camera, calibrate, load_cameras, triangulate
from vibrissa.cli.app import app
from vibrissa.io import load_series, write_video

cv2 = pytest.importorskip("cv2")
typer_testing = pytest.importorskip("typer.testing")

SQUARE = 2e-3
CORNERS = (7, 5)


SIZE = (400, 300)
FINE = 3


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
    cameras, error, _ = calibrate(images, CORNERS, SQUARE)
    assert error < 0.1
    assert [c.name for c in cameras] == ["left", "right"]
    for found, true in zip(cameras, PAIR, strict=True):
        assert found.matrix[0, 0] == pytest.approx(true.matrix[0, 0], rel=0.005)
    # What matters is where the cameras stand relative to each other.
    turn, wanted = (b.rotation @ a.rotation.T for a, b in (cameras, PAIR))
    angle = Rotation.from_matrix(turn @ wanted.T).magnitude()
    assert np.degrees(angle) < 0.3


def distances(points):
    """Distances between points, which do not depend on the laboratory frame."""
    return np.linalg.norm(points[:, None] - points[None], axis=2)


def error_of(cameras, views):
    """Largest error of the distances between points that cameras see, relative to the largest."""
    points = np.random.default_rng(0).uniform(-5e-3, 5e-3, (20, 3))
    seen = triangulate(cameras, np.stack([view.project(points) for view in views]))[0]
    true = distances(points)
    return np.abs(distances(seen) - true).max() / true.max()


def test_lenses_and_poses_are_fitted_together(images):
    """One after the other, distances in space are wrong by 1 % although the pixels fit."""
    found = calibrate(images, CORNERS, SQUARE)
    assert error_of(found.cameras, PAIR) < 1e-3
    assert 0.1e-6 < found.point_sigma < 10e-6


@pytest.mark.parametrize("quarters", [1, 2])
def test_a_board_that_looks_the_same_after_a_rotation(images, quarters):
    """A second camera that is rolled finds the corners in another order."""
    rolled = [np.ascontiguousarray(np.rot90(image, quarters)) for image in images["right"]]
    cameras, error, _ = calibrate({"left": images["left"], "right": rolled}, CORNERS, SQUARE)
    assert error < 0.1

    class Rolled:
        def project(self, points):
            column, row = np.moveaxis(PAIR[1].project(points), -1, 0)
            across, down = SIZE[0] - 1, SIZE[1] - 1
            turned = (row, across - column) if quarters == 1 else (across - column, down - row)
            return np.stack(turned, axis=-1)

    assert error_of(cameras, (PAIR[0], Rolled())) < 2e-3


def test_one_moment_that_does_not_fit_is_named(images):
    """The second camera took it when the board was elsewhere."""
    turn, shift = np.array([0.1, 0.2, -0.1]), np.array([-6e-3, -4e-3, 0.0])
    series = {name: list(one) for name, one in images.items()}
    series["left"][4] = painted(sights(PAIR[0]), turn, shift)
    series["right"][4] = painted(sights(PAIR[1]), turn + 0.01, shift + 3e-4)
    with pytest.warns(UserWarning, match=r"number 5 \(from 1\) of the images used has an error of"):
        calibrate(series, CORNERS, SQUARE)


def calibrated_by_corners(monkeypatch, views, turns, noise, generator):
    """Calibration from noisy corners of boards with known rotations."""
    from vibrissa.cameras import calibration

    board = np.indices((*CORNERS, 1)).T.reshape(-1, 3) * SQUARE
    seen, images = [], {"left": [], "right": []}
    for turn in turns:
        rotation = Rotation.from_rotvec(turn)
        points = rotation.apply(board - board.mean(axis=0)) + generator.uniform(-2e-3, 2e-3, 3)
        for view, series in zip(views, images.values(), strict=True):
            series.append(np.full(SIZE[::-1], len(seen), np.uint8))
            blur = generator.normal(0.0, noise, (len(points), 2))
            seen.append(np.float32(view.project(points) + blur))
    monkeypatch.setattr(calibration, "_find_corners", lambda image, _: seen[image[0, 0]])
    return calibrate(images, CORNERS, SQUARE)


@pytest.mark.slow
def test_boards_seen_from_far_away(monkeypatch):
    """Their poses are ambiguous, and the orders of corners that these suggest are wrong."""
    generator = np.random.default_rng(201)
    matrix = [[20000.0, 0.0, 199.5], [0.0, 20000.0, 149.5], [0.0, 0.0, 1.0]]
    views = [
        Camera(matrix, Rotation.from_rotvec([0.1 * k, 0.6 * k, 0.0]).as_matrix(), shift, size=SIZE)
        for k, shift in enumerate(([0.0, 0.0, 1.7], [0.001, 0.0, 1.785]))
    ]
    turns = (generator.uniform(-0.3, 0.3, 3) for _ in range(10))
    assert calibrated_by_corners(monkeypatch, views, turns, 0.2, generator).error < 0.3


def test_boards_parallel_to_a_camera_do_not_determine_it(monkeypatch):
    """Reprojection errors are as small as ever; points were wrong by 4 % without a word."""
    from vibrissa.cameras import calibration

    generator = np.random.default_rng(3)
    turns = [[0.0, 0.0, turn] for turn in generator.uniform(-0.6, 0.6, 10)]
    with pytest.warns(UserWarning, match=r"hardly determine the cameras: .* board tilted"):
        found = calibrated_by_corners(monkeypatch, PAIR, turns, 0.1, generator)
    assert found.error < 0.2
    assert found.point_sigma > 30e-6
    monkeypatch.setattr(calibration._Bundle, "point_errors", lambda _: (np.inf, 8e-3))
    with pytest.raises(ValueError, match=r"do not determine the cameras\. Take more"):
        calibrated_by_corners(monkeypatch, PAIR, turns, 0.1, generator)


def test_images_that_no_cameras_explain(images):
    """Those of a mirror, which had a reprojection error of NaN, and those of other moments."""
    left, right = images["left"], images["right"]
    for wrong in ([image[:, ::-1].copy() for image in right], [*right[1:], right[0]]):
        with pytest.raises(ValueError, match="no cameras explain"):
            calibrate({"left": left, "right": wrong}, CORNERS, SQUARE)


def test_the_lens_is_not_bent_where_the_board_never_was(images):
    """All five coefficients of distortion put the corners of these images 43 and 78 pixels away."""
    corners = np.array([[0, 0], [SIZE[0] - 1, 0], [0, SIZE[1] - 1], [SIZE[0] - 1, SIZE[1] - 1]])
    middle = np.array(SIZE) / 2 - 0.5
    for found, true in zip(calibrate(images, CORNERS, SQUARE)[0], PAIR, strict=True):
        angles = [np.arccos(view.rays(corners)[1] @ view.rays(middle)[1]) for view in (found, true)]
        assert np.abs(angles[0] - angles[1]).max() * true.matrix[0, 0] < 10.0


def test_too_few_boards_say_so(images):
    few = {name: series[:2] for name, series in images.items()}
    with pytest.raises(ValueError, match="in 2 images"):
        calibrate(few, CORNERS, SQUARE)
    with pytest.raises(ValueError, match="as many each"):
        calibrate({"left": images["left"]}, CORNERS, SQUARE)


def run(*words):
    return typer_testing.CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture
def files(images, tmp_path):
    for name, series in images.items():
        for i, image in enumerate(series):
            cv2.imwrite(str(tmp_path / f"{name}_{i:02d}.png"), image)
    return tmp_path


def test_the_verb_writes_cameras_that_see_the_same_points(files):
    out = files / "cameras.toml"
    words = [
        "calibrate",
        "--pattern",
        "7x5",
        "--square",
        1e3 * SQUARE,
        *sorted(files.glob("*.png")),
    ]
    done = run(*words, "-o", out)
    assert done.exit_code == 0, done.exception
    assert "reprojection error 0.0" in done.stdout
    assert "mm from the first board's corner" in done.stdout
    cameras = load_cameras(out)
    assert error_of(cameras, PAIR) < 1e-3


def test_the_verb_takes_a_video_of_each_camera(images, tmp_path):
    for name, series in images.items():
        write_video(tmp_path / f"{name}.mkv", series)
    videos = [tmp_path / "left.mkv", tmp_path / "right.mkv"]
    series = load_series(videos, most=4)
    assert list(series) == ["left", "right"]
    for name, frames in series.items():
        np.testing.assert_array_equal(frames, [images[name][i] for i in (0, 3, 6, 9)])
    out = tmp_path / "cameras.toml"
    done = run("calibrate", "--pattern", "7x5", "--square", 1e3 * SQUARE, *videos, "-o", out)
    assert done.exit_code == 0, done.exception
    assert [camera.name for camera in load_cameras(out)] == ["left", "right"]


def test_what_cannot_be_calibrated_says_why(files):
    def said(*words, pattern="7x5", square=1e3 * SQUARE):
        done = run("calibrate", "--pattern", pattern, "--square", square, *words)
        assert done.exit_code != 0
        return str(done.exception)

    images = sorted(files.glob("*.png"))
    out = ("-o", files / "c.toml")
    assert "in mm is needed" in said(*images, *out, square=SQUARE)
    assert "as 9x6" in said(*images, *out, pattern="seven")
    assert "camera right has no image 9" in said(*images[:-1], *out)
    assert ".toml is needed" in said(*images, "-o", files / "c.csv")
    (files / "plain.png").write_bytes(images[0].read_bytes())
    assert "has no number" in said(*images, files / "plain.png", *out)
    cv2.imwrite(str(files / "left_00.png"), np.zeros((30, 40), np.uint8))
    assert "differ in size" in said(*images, *out)
