"""Figures of trials: what is drawn is what is known of them."""

from itertools import repeat

import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli.app import app
from vibrissa.io import save_recording
from vibrissa.objects import Peg, Plane, Sphere
from vibrissa.plots import Sight, contact_places, key_frames, trial_overview
from vibrissa.plots.space import draw_body, draw_head, head_of, one_scale, room_for
from vibrissa.plots.style import RED
from vibrissa.scene import course_of, deflection_angles

GREY = np.full((300, 300), 200, np.uint8)
LINE = np.linspace([0.0, 0.0, 0.0], [40e-3, 0.0, 0.0], 20)


@pytest.fixture(scope="module")
def samples():
    whisker = vb.Whisker.straight(40e-3)
    return vb.ContactMap.simulate(whisker, grid=False, cells=(8, 16, 8)).to_dataset()


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Solids that are quicker to make."""
    monkeypatch.setattr("vibrissa.scene.solids._SHAPE", (12, 24, 8))


def texts(figure: Figure) -> set[str]:
    return {text.get_text() for text in figure.findobj(Text)} - {""}


def dots(axes) -> np.ndarray:
    """What is scattered over a panel last."""
    found = [c for c in axes.collections if isinstance(c, PathCollection)]
    return np.asarray(found[-1].get_offsets())


@pytest.mark.parametrize(
    ("width", "images"), [("double", 4), pytest.param("single", 2, marks=pytest.mark.slow)]
)
def test_an_overview_shows_whisker_signals_and_contacts(known, samples, width, images):
    course = course_of(known.recording())
    rows = key_frames(course)
    sights = [Sight(view, repeat(GREY)) for view in known.views]
    figure = trial_overview(course, samples, LINE, sights, rows, width=width)
    figure.draw_without_rendering()
    shown = [axes for axes in figure.axes if axes.images]
    assert len(shown) == images
    truth = known.recording()["truth"]["centerline"].values[rows[-1], 0]
    for axes, view in zip(shown[-2:], known.views, strict=True):
        (line,) = (one for one in axes.lines if one.get_color() == RED)
        np.testing.assert_allclose(line.get_xydata(), view.project(truth))
        point = view.project(known.estimated_radius * truth[-1] / known.length)
        np.testing.assert_allclose(dots(axes), [point], atol=1e-6)
    words = texts(figure)
    assert {"$t$ (s)", "$F_x$ (µN)", "$M_B$ (µN·m)", "$M_D$ (°)", "$r$ (mm)"} <= words
    assert ("true $r$ (mm)" in words) == (width == "double")
    wide, tall = 25.4 * figure.get_size_inches()
    assert wide == pytest.approx({"double": 178.0, "single": 85.0}[width])
    assert tall < 240.0


def test_an_overview_does_without_cameras_and_truth(known, samples):
    trial = known.recording(estimates=False)
    figure = trial_overview(course_of(trial), samples, LINE)
    assert not any(axes.images for axes in figure.axes)
    assert "estimated" not in texts(figure)
    with pytest.raises(ValueError, match="no signals"):
        trial_overview(course_of(known.recording(signals=False)), samples, LINE)
    sights = [Sight(known.views[0], repeat(GREY))]
    with pytest.raises(ValueError, match="1 views in 3 frames"):
        trial_overview(course_of(trial), samples, LINE, sights, [1, 2, 3])


def test_telling_frames_are_those_bent_most_to_either_side(known):
    trial = known.recording()
    signals = trial["signals"].to_dataset()
    # The whisker is pushed one way, then the other, then again the first.
    bent = np.array([0, 0, 0, 0, 3, 5, 2, 1, 4, 9, 6, 1])
    turn = np.where((np.arange(12) < 6) | (np.arange(12) > 9), 1.5, -1.6)
    trial["signals"] = signals.assign(
        MB=(("time", "whisker"), 1e-7 * bent[:, None]), MD=(("time", "whisker"), turn[:, None])
    )
    np.testing.assert_array_equal(key_frames(course_of(trial)), [9, 10])
    without = course_of(known.recording(signals=False))
    assert without.touching[key_frames(without)].all()


def test_contacts_lie_where_they_are_in_both_frames(known):
    course = course_of(known.recording())
    figure = contact_places(course, LINE, [known.peg])
    figure.draw_without_rendering()
    about, front, top, side, _ = figure.axes
    mm = 1e3 * known.estimated_radius
    turn = known.azimuth[known.touching]
    np.testing.assert_allclose(dots(about), np.tile([mm, 0.0], (8, 1)), atol=1e-9)
    np.testing.assert_allclose(dots(front), np.tile([mm, 0.0], (8, 1)), atol=1e-9)
    np.testing.assert_allclose(dots(top), mm * np.stack([np.cos(turn), np.sin(turn)], 1))
    np.testing.assert_allclose(dots(side)[:, 0], mm * np.sin(turn))
    for axes in figure.axes[:4]:
        box = axes.get_window_extent()
        spans = np.ptp(axes.get_xlim()) / box.width, np.ptp(axes.get_ylim()) / box.height
        assert spans[0] == pytest.approx(spans[1])
    assert {"$x$ (mm)", "$y$ (mm)", "$z$ (mm)", "$t$ (s)"} <= texts(figure)
    # A frame whose base is missing is left out.
    course.position[np.flatnonzero(course.touching)[2]] = np.nan
    assert len(dots(contact_places(course, LINE).axes[2])) == 7


def test_contacts_are_coloured_by_deflection(known):
    trial = known.recording()
    own = trial["estimates"]["contact_point_whisker"].values
    lab = trial["estimates"]["contact_point"].values
    # All lie on the straight resting whisker; one is moved aside by a tenth of its distance.
    # The resting whisker is sampled every 20 µm.
    angles = deflection_angles(course_of(trial), LINE)
    np.testing.assert_allclose(angles[4:], 0.0, atol=10e-6 / known.estimated_radius)
    moved = lab.copy()
    moved[8, 0, 2] += 2.6e-3
    data = trial["estimates"].to_dataset()
    trial["estimates"] = data.assign(contact_point=(data["contact_point"].dims, moved))
    course = course_of(trial)
    angles = deflection_angles(course, LINE)
    assert np.isnan(angles[:4]).all()
    assert angles[8] == pytest.approx(np.arctan(0.1), rel=1e-3)
    assert own.shape == lab.shape
    assert "$\\delta$ (°)" in texts(contact_places(course, LINE, colour="deflection_angle"))
    with pytest.raises(ValueError, match="colour is 'size'"):
        contact_places(course, LINE, colour="size")


def test_without_contacts_there_is_a_sentence(known):
    trial = known.recording(estimates=False)
    trial["truth"] = trial["truth"].to_dataset().drop_vars("contact_point")
    assert texts(contact_places(course_of(trial), LINE)) == {"no contacts"}


def test_the_head_is_where_the_whisker_begins(known):
    trial = known.recording()
    head = head_of(course_of(trial))
    np.testing.assert_allclose(head.axes, np.eye(3), atol=1e-9)
    # The base is on the right of the snout, behind its tip.
    assert head.snout[0] < 0.0 < head.snout[1]
    data = trial.to_dataset()
    mirrored = data["base_rotation"].values * np.array([-1.0, 1.0, 1.0])[:, None]
    mirrored[..., :, 2] *= -1.0  # a rotation again
    trial.dataset = data.assign(base_rotation=(data["base_rotation"].dims, mirrored))
    left = head_of(course_of(trial))
    np.testing.assert_allclose(left.snout, head.snout * [-1.0, 1.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(left.axes[:, 1], [0.0, 1.0, 0.0], atol=1e-9)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    snout = np.array([1e-3, 20e-3, 0.0])
    moving = data.assign(
        head_position=(("time", "space"), np.tile(snout, (12, 1))),
        head_rotation=(("time", "space", "head_axis"), np.tile(turn, (12, 1, 1))),
    )
    trial.dataset = moving
    told = head_of(course_of(trial))
    np.testing.assert_allclose(told.snout, snout)
    np.testing.assert_allclose(told.axes, turn, atol=1e-12)
    axes = Figure().add_subplot()
    draw_head(axes, told, (0, 1))
    outline = np.asarray(axes.patches[0].get_xy())
    # Turned by a right angle it looks toward −x, its tip near the snout.
    assert outline[:, 0].min() == pytest.approx(1.0, abs=1.0)
    assert outline[:, 0].max() > 40.0


def test_outlines_are_those_of_the_bodies():
    limits = np.array([[0.0, 20.0], [-10.0, 10.0], [-10.0, 10.0]])
    sphere = Sphere(np.array([10e-3, 0.0, 0.0]), 4e-3)
    peg = Peg(np.array([10e-3, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), 3e-3)
    for body, view, radius in ((sphere, (0, 1), 4.0), (sphere, (1, 2), 4.0), (peg, (0, 1), 3.0)):
        axes = Figure().add_subplot()
        draw_body(axes, body, view, limits, "true")
        outline = np.concatenate([p.vertices for p in axes.collections[-1].get_paths()])
        middle = [10.0, 0.0] if view == (0, 1) else [0.0, 0.0]
        np.testing.assert_allclose(np.hypot(*(outline - middle).T), radius, atol=0.03)
    axes = Figure().add_subplot()
    # However deep one looks, nothing is overlooked.
    deep = np.array([[0.0, 20.0], [-90.0, 110.0], [-10.0, 10.0]])
    draw_body(axes, peg, (0, 2), deep, "fitted")
    outline = np.concatenate([p.vertices for p in axes.collections[-1].get_paths()])
    np.testing.assert_allclose(np.abs(outline[:, 0] - 10.0), 3.0, atol=0.03)
    # A wall that one looks at fills the panel, and is not drawn; from the side it is a half.
    wall = Plane(np.array([0.0, 5e-3, 0.0]), np.array([0.0, -1.0, 0.0]))
    axes = Figure().add_subplot()
    draw_body(axes, wall, (0, 2), limits, "true")
    assert not axes.collections
    draw_body(axes, wall, (0, 1), limits, "true")
    outline = np.concatenate([p.vertices for p in axes.collections[-1].get_paths()])
    np.testing.assert_allclose(outline[:, 1], 5.0, atol=1e-6)


def test_limits_hold_contacts_and_the_object_that_ends_nearby():
    points = np.stack([np.full(50, 7.0), np.linspace(-1, 1, 50), np.linspace(-3, 3, 50)], 1)
    peg = Peg(np.array([10e-3, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), 3e-3)
    limits = room_for(points, [peg])
    assert limits[0, 0] < 7.0
    assert limits[0, 1] > 12.5
    assert limits[2, 1] < 6.0
    ends = one_scale(limits, [(0, 1), (1, 2)], [(40.0, 30.0), (40.0, 30.0)])
    scales = np.ptp(ends, axis=2) / [40.0, 30.0]
    np.testing.assert_allclose(scales, scales[0, 0])
    for view, both in zip([(0, 1), (1, 2)], ends, strict=True):
        for n, (low, high) in zip(view, both, strict=True):
            assert low <= limits[n, 0] + 1e-9
            assert high >= limits[n, 1] - 1e-9


def test_a_traced_whisker_is_red():
    red, green, blue = to_rgb(RED)
    assert red > 0.8 > 0.2 > max(green, blue)


def run(*arguments):
    return CliRunner().invoke(app, ["figures", *map(str, arguments)])


@pytest.mark.slow
@pytest.mark.usefixtures("coarse")
def test_the_verb_draws_a_trial(known, tmp_path):
    path = tmp_path / "trial.nc"
    save_recording(path, known.recording())
    done = run(path, "-o", tmp_path / "out", "--format", "png")
    assert done.exit_code == 0, done.output
    names = {"whisker", "trial", "signals", "contact_places", "contour", "estimates"}
    files = {file.stem: file for file in (tmp_path / "out").iterdir()}
    assert set(files) == names
    assert all(file.stat().st_size > 10_000 for file in files.values())


@pytest.mark.usefixtures("coarse")
def test_the_verb_says_what_a_trial_lacks(known, tmp_path):
    path = tmp_path / "trial.nc"
    save_recording(path, known.recording(signals=False, estimates=False))
    done = run(path, "-o", tmp_path / "out", "--format", "png", "--colour", "deflection")
    said = " ".join(done.output.split())
    assert done.exit_code == 0, done.output
    assert f"no signals: `vibrissa signals {path}` makes them" in said
    assert f"no estimated contacts: `vibrissa estimate {path}` makes them" in said
    names = {file.stem for file in (tmp_path / "out").iterdir()}
    assert names == {"whisker", "contact_places", "contour"}
    wrong = run(path, "-o", tmp_path / "out", "--colour", "size")
    assert wrong.exit_code == 2
    assert "'size' is not one of" in wrong.output
    refused = run(path, "-o", tmp_path / "out", "--cones", path)
    assert isinstance(refused.exception, ValueError)
