"""Films: the light that a whisker takes, where it is dark, what hides it, and noise."""

import numpy as np
import pytest

from vibrissa import Whisker
from vibrissa.cameras import orthogonal_views
from vibrissa.io import read_video
from vibrissa.objects import Peg, Sphere
from vibrissa.simulation import (
    ImageConditions,
    Motion,
    film,
    film_frames,
    simulate,
    with_true_traces,
)

WHISKER = Whisker.parabola(length=10e-3, coefficient=15.0)
PEG = Peg([6e-3, 2.4e-3, 0.0], [0.0, 0.0, 1.0], 1e-3)
QUIET = ImageConditions(
    gain=1e9, read_noise=0.0, unevenness=0.0, face=(0.0, 0.0, 0.0), exposure=0.0
)
CAMERAS = orthogonal_views(size=(256, 256), center=(5e-3, 0.0, 0.0))


@pytest.fixture(scope="module")
def trial():
    """Pushed from behind against a peg that is out of reach at first."""
    n = 8
    azimuth = np.linspace(-0.3, 0.2, n)
    still = np.zeros(n)
    motion = Motion(np.arange(n) / 1000, azimuth, 0.1 + still, still, np.zeros((n, 3)))
    return simulate(WHISKER, motion, PEG)


def truth(recording):
    return recording["truth"].to_dataset().isel(whisker=0)


def test_the_light_that_is_missing_is_the_whisker_s_shadow(trial):
    """Blur moves light but takes none: the sum over the image is the strip's area."""
    free = trial.isel(time=[0])
    no_peg = free.drop_nodes("objects")
    (frame,) = film_frames(no_peg, CAMERAS[0], QUIET)
    missing = (QUIET.light - frame.astype(float)).sum()
    line = CAMERAS[0].project(truth(free)["centerline"].values[0])
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    middle = (np.arange(32) + 0.5) / 32 * WHISKER.length
    area = (steps * 2.0 * WHISKER.radius(middle) / 58e-6).sum()
    # Rounding to whole grey values loses a little where the shadow is faint.
    assert missing == pytest.approx(QUIET.light * QUIET.contrast * area, rel=0.02)


def test_the_whisker_is_where_it_is(trial):
    """Centre of darkness across the whisker, at places far from its ends."""
    no_peg = trial.isel(time=[0]).drop_nodes("objects")
    for camera in CAMERAS:
        (frame,) = film_frames(no_peg, camera, QUIET)
        line = camera.project(truth(no_peg)["centerline"].values[0])
        for column in (90, 120, 150):
            dark = QUIET.light - frame[:, column].astype(float)
            middle = (dark * np.arange(256)).sum() / dark.sum()
            assert middle == pytest.approx(np.interp(column, line[:, 0], line[:, 1]), abs=0.05)


def test_the_peg_hides_what_is_behind_it(trial):
    """Seen from the front the whisker that pushes a peg from behind runs behind it."""
    filmed = with_traces(trial)
    last = filmed["truth"].to_dataset().isel(time=-1, whisker=0)
    assert bool(last["in_contact"])
    top, front = last["trace_visible"].values
    x = last["centerline"].values[:, 0]
    np.testing.assert_array_equal(~front, np.abs(x - PEG.origin[0]) < PEG.radius)
    assert top.all()
    frame = list(film_frames(trial, CAMERAS[1], QUIET))[-1]
    column = round(float(CAMERAS[1].project(PEG.origin)[0]))
    assert np.ptp(frame[:, column]) <= 1
    assert frame[0, column] == pytest.approx(QUIET.dark, abs=1)


def with_traces(trial):
    from vibrissa.simulation import with_true_traces

    return with_true_traces(trial, CAMERAS)


def test_noise_is_shot_and_read_noise(trial):
    look = ImageConditions(
        light=160.0, unevenness=0.0, gain=20.0, read_noise=2.0, face=(0.0, 0.0, 0.0)
    )
    (frame,) = film_frames(trial.isel(time=[0]), CAMERAS[0], look, seed=3)
    corner = frame[:40, :].astype(float)
    assert corner.mean() == pytest.approx(160.0, abs=0.1)
    assert corner.var() == pytest.approx(160.0 / 20.0 + 4.0 + 1.0 / 12.0, rel=0.03)
    assert abs(np.corrcoef(corner[:-1].ravel(), corner[1:].ravel())[0, 1]) < 0.03


def test_the_same_seed_is_the_same_film(trial):
    one, two, other = (
        list(film_frames(trial.isel(time=[0, 1]), CAMERAS[0], seed=seed)) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, two)
    assert (one[0] != other[0]).mean() > 0.5


def test_movement_smears_but_loses_no_light(trial):
    no_peg = trial.isel(time=slice(0, 3)).drop_nodes("objects")
    long = ImageConditions(
        gain=1e9, read_noise=0.0, unevenness=0.0, face=(0.0, 0.0, 0.0), exposure=5e-4
    )
    sharp, smeared = (
        200.0 - list(film_frames(no_peg, CAMERAS[0], look))[1].astype(float)
        for look in (QUIET, long)
    )
    assert smeared.sum() == pytest.approx(sharp.sum(), rel=0.03)
    far = slice(150, 190)
    assert smeared[:, far].max() < 0.6 * sharp[:, far].max()


def test_the_base_comes_out_of_the_face(trial):
    (frame,) = film_frames(trial.isel(time=[0]), CAMERAS[0], ImageConditions(read_noise=0.0))
    base = CAMERAS[0].project(truth(trial)["centerline"].values[0, 0]).round().astype(int)
    assert frame[base[1], base[0] - 8] < 30
    assert frame[base[1] - 8, base[0] + 8] > 120


def test_a_film_is_two_videos_and_the_truth_beside_them(trial, tmp_path):
    told = []
    paths = {"top": tmp_path / "top.mkv", "front": tmp_path / "front.mkv"}
    filmed = film(trial, paths, CAMERAS, progress=lambda done, total: told.append((done, total)))
    assert told == [(i + 1, 16) for i in range(16)]
    for path in paths.values():
        assert np.array(list(read_video(path))).shape == (8, 256, 256)
    trace = filmed["truth"]["trace"]
    assert trace.dims == ("time", "whisker", "view", "node", "image_axis")
    assert list(filmed["cameras"]["view"].values) == ["top", "front"]
    line = truth(trial)["centerline"].values
    np.testing.assert_allclose(trace.values[:, 0, 1], CAMERAS[1].project(line))


def test_what_cannot_be_filmed_says_why(trial, tmp_path):
    with pytest.raises(ValueError, match="no true centrelines"):
        film(trial.drop_nodes("truth"), {"top": "a.mkv", "front": "b.mkv"})
    with pytest.raises(ValueError, match="they must agree"):
        film(trial, {"top": tmp_path / "a.mkv"})
    with pytest.raises(ValueError, match=r"contrast is 2\.0"):
        ImageConditions(contrast=2.0)


def test_shadows_of_objects_are_as_large_as_they_are():
    """A sphere's and a box's area in both views, to a fraction of a pixel's edge."""
    from vibrissa.simulation import silhouette

    size = 58e-6
    center = np.array([5e-3, 0.0, 0.0])
    sphere = Sphere([4e-3, 1e-3, -1e-3], 1.7e-3)
    for camera in CAMERAS:
        shadow = silhouette(camera, [sphere], center, 0.7)
        assert shadow.sum() * size**2 == pytest.approx(np.pi * 1.7e-3**2, rel=2e-3)
        rows, columns = np.indices(shadow.shape)
        middle = [(shadow * x).sum() / shadow.sum() for x in (columns, rows)]
        np.testing.assert_allclose(middle, camera.project([4e-3, 1e-3, -1e-3]), atol=0.02)


def test_hidden_is_what_is_behind():
    from vibrissa.simulation.film import hidden

    sphere = Sphere([5e-3, 0.0, 0.0], 1e-3)
    points = np.array(
        [[5e-3, -2e-3, 0.0], [5e-3, 2e-3, 0.0], [5e-3, 0.0, 2e-3], [5e-3, 0.0, -2e-3]]
    )
    np.testing.assert_array_equal(hidden(points, CAMERAS[1], [sphere]), [1, 0, 0, 0])
    np.testing.assert_array_equal(hidden(points, CAMERAS[0], [sphere]), [0, 0, 0, 1])


@pytest.fixture(scope="module")
def plain():
    """A short trial of one whisker, and the camera that sees it against its cheek."""
    whisker = Whisker.parabola(length=20e-3, coefficient=5.0)
    t = np.arange(3) / 500.0
    motion = Motion(t, 0.05 * np.arange(3), np.zeros(3), np.zeros(3), np.zeros((3, 3)))
    cameras = orthogonal_views(size=(320, 240), center=(8e-3, 0.0, 0.0))
    recording = with_true_traces(simulate([whisker], [motion], []), cameras)
    return recording, cameras


def shots(plain, view, **conditions):
    recording, cameras = plain
    made = ImageConditions(read_noise=0.0, gain=1e9, **conditions)
    frames = list(film_frames(recording, cameras[view], made, seed=3))
    trace = recording["truth"]["trace"].values[:, 0, view]
    return np.array(frames, dtype=float), trace


def test_wires_stand_still_and_are_dark(plain):
    without, _ = shots(plain, 0)
    wired, _ = shots(plain, 0, wires=2)
    wire = without - wired > 30.0
    assert wire[0].sum() > 200
    assert (wire[0] & wire[1] & wire[2]).sum() > 0.9 * wire[0].sum()


def test_before_the_cheek_the_whisker_has_the_contrast_that_is_stated(plain):
    """In the view along y alone; beyond the cheek it is as dark as before."""
    free, trace = shots(plain, 1)
    faint, _ = shots(plain, 1, cheek=15.0)
    for at, low, high in ((6, 8.0, 24.0), (22, 40.0, 200.0)):
        column, row = np.round(trace[0, at]).astype(int)
        strip = faint[0, row - 12 : row + 13, column - 3 : column + 4].mean(axis=1)
        assert low < np.median(strip) - strip[11:14].min() < high
    np.testing.assert_array_equal(shots(plain, 0, cheek=15.0)[0], shots(plain, 0)[0])
    assert (free != faint).any()


def test_the_lit_flank_is_bright_and_the_other_is_not(plain):
    dark, trace = shots(plain, 0)
    lit, _ = shots(plain, 0, side_light=0.5)
    column, row = np.round(trace[0, 14]).astype(int)
    gain = (lit - dark)[0, row - 5 : row + 6, column]
    flanks = gain[:5].max(), gain[6:].max()
    assert max(flanks) > 15.0
    assert min(flanks) < 5.0


def test_fur_moves_with_the_face_and_has_the_texture_that_is_stated(plain):
    bare, _ = shots(plain, 0)
    furry, _ = shots(plain, 0, fur=6.0)
    inside = bare[0] < 20.0
    inside[:, 70:] = False
    assert 4.0 < (furry - bare)[0][inside].std() < 9.0
    beyond = (bare[0] > 100.0) & (bare[0] - furry[0] > 20.0)
    assert beyond.sum() > 30  # hairs
