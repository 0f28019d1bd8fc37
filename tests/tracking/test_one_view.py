"""One camera: what is in the plane of the image is right, and what is not is stated."""

import numpy as np
import pytest

from vibrissa import Whisker
from vibrissa.cameras import orthogonal_views, triangulate
from vibrissa.cli.app import app
from vibrissa.contour import shape_from_dataset
from vibrissa.io import load_recording, save_recording
from vibrissa.objects import Peg
from vibrissa.recording import ONE_VIEW, Recording
from vibrissa.simulation import Motion, film_frames, simulate
from vibrissa.tracking import TrackOptions, trace_video, track
from vibrissa.tracking.refine.optics import stated_lenses
from vibrissa.tracking.refine.tilt import plane_of
from vibrissa.tracking.space.rest_shape import rest_shape
from vibrissa.whisker import base_rotation

testing = pytest.importorskip("typer.testing")

CAMERA = orthogonal_views(size=(256, 256), center=(5e-3, 0.0, 0.0))[:1]
PEG = Peg([6e-3, 1.2e-3, 0.0], [0.0, 0.0, 1.0], 0.5e-3)
WHISKER = Whisker.parabola(length=10e-3, coefficient=15.0)


def film(elevation=0.0, sign=1.0, peg=PEG):
    """Sweep past a peg; rolled by half a turn the whisker bends the other way."""
    n = 48
    azimuth = sign * np.linspace(-0.10, 0.85, n)
    roll = np.full(n, 0.0 if sign > 0.0 else np.pi)
    trial = simulate(
        WHISKER,
        Motion(np.arange(n) / 1e3, azimuth, elevation * azimuth, roll, np.zeros((n, 3))),
        peg,
    )
    frames = film_frames(trial, CAMERA[0], seed=1)
    return trial, [trace_video(frames, [CAMERA[0].project(np.zeros(3))])]


@pytest.fixture(scope="module")
def flat():
    trial, traces = film()
    return trial, track(CAMERA, traces, 1000.0)


def of(tree, name):
    return tree[name].values[:, 0]


def check(trial, found):
    touched = of(trial, "truth/in_contact") > 0
    assert np.mean(touched == (of(found, "in_contact") > 0)) > 0.95
    both = touched & (of(found, "in_contact") > 0)
    error = np.linalg.norm(of(found, "contact_point") - of(trial, "truth/contact_point"), axis=1)
    assert np.median(error[both]) < 40e-6
    azimuth = of(found, "base_azimuth") - of(trial, "base_azimuth")
    assert np.nanmedian(np.abs(azimuth)) < np.radians(0.3)
    # Of the moment only the bending in the plane is there, and the force is in the plane.
    moment, force = of(found, "moment")[both], of(found, "force")[both]
    true_moment, true_force = of(trial, "truth/moment")[both], of(trial, "truth/force")[both]
    assert np.median(np.abs(moment[:, 2] / true_moment[:, 2] - 1.0)) < 0.03
    assert np.median(np.abs(force[:, 1] / true_force[:, 1] - 1.0)) < 0.05
    assert np.abs(moment[:, :2]).max() < 1e-6 * np.abs(moment[:, 2]).max()
    assert np.abs(force[:, 2]).max() < 1e-6 * np.abs(force).max()


def test_a_whisker_that_moves_in_the_plane_is_measured(flat):
    trial, found = flat
    check(trial, found)
    assert np.abs(of(found, "centerline")[..., 2]).max() < 1e-9
    assert Recording(found).planar
    assert ONE_VIEW in found.attrs["remarks"]
    assert "out of the image by" not in found.attrs["remarks"]


def test_a_line_that_no_rod_follows_is_no_contact_in_a_row():
    """In three free frames the second whisker's trace goes on along something straight."""
    trial, (rows,) = film()
    odd = list(rows[0])
    free, contact = slice(2, 5), of(trial, "truth/in_contact") > 0
    for i in range(2, 5):
        line = odd[i].line.copy()
        half = len(line) // 2
        line[half:, 1] += 0.3 * np.arange(len(line) - half)
        odd[i] = odd[i]._replace(line=line)
    found = track(CAMERA, [[rows[0], odd]], 1000.0)
    assert not contact[free].any()
    assert not (found["in_contact"].values[free] > 0).any()
    assert np.isfinite(found["centerline"].values[free, 0]).all()
    assert np.isnan(found["centerline"].values[free, 1]).all()
    assert np.mean((found["in_contact"].values[5:, 1] > 0) == contact[5:]) > 0.95
    assert "whisker 1: in 3 frames the bent rod does not explain" in found.attrs["remarks"]


@pytest.mark.slow
def test_a_peg_along_the_line_of_sight_is_reconstructed(flat, tmp_path):
    save_recording(tmp_path / "one.nc", flat[1])
    done = testing.CliRunner().invoke(app, ["reconstruct", str(tmp_path / "one.nc")])
    assert done.exit_code == 0, done.exception
    assert "One view shows the section of the object" in done.stdout
    assert "Fz, Mx and My are taken as 0" in done.output
    fit = shape_from_dataset(load_recording(tmp_path / "one.nc")["contour"].to_dataset())
    assert np.abs(fit.axis[2]) > 0.9999
    assert fit.radius == pytest.approx(PEG.radius, rel=0.15)


@pytest.mark.slow
def test_a_whisker_that_bends_the_other_way_is_measured():
    """Its roll is half a turn, of which noise makes either sign."""
    peg = Peg([6e-3, -1.2e-3, 0.0], [0.0, 0.0, 1.0], 0.5e-3)
    trial, traces = film(sign=-1.0, peg=peg)
    found = track(CAMERA, traces, 1000.0)
    check(trial, found)
    np.testing.assert_allclose(np.abs(of(found, "base_roll")), np.pi, atol=1e-6)


@pytest.mark.slow
def test_a_whisker_that_leaves_the_plane_is_noted_with_numbers():
    trial, traces = film(elevation=0.8, peg=Peg([0.05, 0.05, 0.0], [0.0, 0.0, 1.0], 1e-3))
    found = track(CAMERA, traces, 1000.0)
    (line,) = [one for one in found.attrs["remarks"].splitlines() if "turned out of" in one]
    turned = float(line.split("by up to ")[1].split("°")[0])
    elevation = np.degrees(of(trial, "base_elevation"))
    assert turned == pytest.approx(np.percentile(elevation, 95.0), abs=8.0)


@pytest.mark.parametrize("elevation", [0.3, 0.6])
def test_turning_out_of_the_plane_is_not_contact(elevation):
    """By up to 15° or 29°; the projected whisker is more curved, but up to its tip."""
    trial, traces = film(elevation=elevation)
    found = track(CAMERA, traces, 1000.0)
    touched = of(trial, "truth/in_contact") > 0
    both = of(found, "in_contact") > 0
    assert np.mean(touched == both) > 0.95
    # The rod bends in the plane that has turned, and what is given is its projection.
    assert np.mean(of(found, "trace_misfit")[~both]) < 1.0
    for name in ("contact_point", "centerline"):
        assert np.nanmax(np.abs(of(found, name)[..., 2])) == 0.0
    assert np.abs(of(found, "force")[:, 2]).max() == np.abs(of(found, "moment")[:, :2]).max() == 0.0


def test_a_lens_moves_contacts_at_unknown_depths():
    """A known lens does so as one whose distance is stated; a telecentric one does not."""
    _, traces = film()
    lens = stated_lenses(CAMERA, 0.05)
    ways = [
        (CAMERA, TrackOptions()),
        (CAMERA, TrackOptions(rough=True, distance=0.05)),
        (lens, TrackOptions()),
    ]
    spread = []
    for cameras, options in ways:
        found = track(cameras, traces, 1000.0, options)
        covariance = of(found, "contact_covariance")[of(found, "in_contact") > 0]
        spread.append(np.median(covariance[:, 0, 0]))
    assert lens[0].projection == "perspective"
    assert spread[2] == pytest.approx(spread[1], rel=0.2)
    assert spread[1] > 1.3 * spread[0]


@pytest.mark.parametrize(("bend", "turns"), [(0.0, 0.0), (0.5, 0.0), (8.0, 0.0), (8.0, 0.5)])
def test_errors_of_traces_of_a_nearly_straight_whisker_are_no_turn(bend, turns):
    """They change its apparent curvature as much as a turn by tens of degrees would."""
    rng, s, frames = np.random.default_rng(0), np.linspace(0.0, 20e-3, 101), 80
    turn = turns * np.abs(np.sin(np.linspace(0.0, 9.0, frames)))[:, None]
    shapes = np.stack(np.broadcast_arrays(np.cos(turn) * s, bend * s**2, 0.0), axis=-1)
    waves = np.cos(np.pi * np.outer(s / s[-1], np.arange(12)))
    shapes[..., :2] += 0.4e-6 * np.einsum("nk,tki->tni", waves, rng.normal(size=(frames, 12, 2)))
    azimuth = 0.8 * np.sin(np.linspace(0.0, 9.0, frames))
    curves = np.einsum("tij,tnj->tni", base_rotation(azimuth, 0.0 * azimuth, 0.0 * azimuth), shapes)
    plane = plane_of(curves, rest_shape(curves), np.ones(frames, dtype=bool))
    assert plane.turned == pytest.approx(turns, abs=0.1)


def test_a_known_whisker_is_laid_into_the_plane():
    trial, traces = film()
    found = track(CAMERA, traces, 1000.0, TrackOptions(whisker=WHISKER))
    check(trial, found)
    crooked = Whisker.from_curvature(
        10e-3, lambda s: np.stack([0 * s, 60.0 * (s > 6e-3), 60.0 + 0 * s], -1)
    )
    with pytest.raises(ValueError, match="leaves its plane by"):
        track(CAMERA, traces, 1000.0, TrackOptions(whisker=crooked))


def test_points_of_one_camera_are_in_the_plane(rng):
    points = np.column_stack([rng.uniform(-5e-3, 5e-3, (20, 2)), np.zeros(20)])
    found, covariance = triangulate(CAMERA, CAMERA[0].project(points)[None], 0.5)
    np.testing.assert_allclose(found, points, atol=1e-12)
    np.testing.assert_allclose(covariance[0], np.diag([1.0, 1.0, 0.0]) * (0.5 * 58e-6) ** 2)
    with pytest.raises(ValueError, match="looks along the plane"):
        triangulate(orthogonal_views()[1:], np.zeros((1, 3, 2)))


def test_a_moving_head_needs_two_views(flat):
    _, traces = film()
    with pytest.raises(ValueError, match="head moves in space"):
        track(CAMERA, traces, 1000.0, head=flat[0].to_dataset())
