"""What the figures say: labels, units, the data they show, and what they do without data."""

import re
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.image import imread

from vibrissa.numerics import contacts_in
from vibrissa.plots import (
    contour_views,
    estimated_against_true,
    save,
    signals_over_time,
    whisker_views,
)
from vibrissa.plots.signals import intervals
from vibrissa.plots.style import cyclic
from vibrissa.quantities import axis_label
from vibrissa.scene import SIGNALS, robust_limits
from vibrissa.status import Status

LINE = np.stack([np.linspace(0, 40e-3, 60), 10.0 * np.linspace(0, 40e-3, 60) ** 2, np.zeros(60)], 1)
RADIUS = np.linspace(100e-6, 7e-6, 60)
PEG = SimpleNamespace(origin=np.array([25e-3, 0, 0]), axis=np.array([0, 0, 1.0]), radius=1.35e-3)


def texts(figure: Figure) -> set[str]:
    """All that is written on it."""
    figure.draw_without_rendering()
    return {t.get_text() for t in figure.findobj(lambda a: hasattr(a, "get_text"))} - {""}


def signals(n: int = 200) -> xr.Dataset:
    time = np.arange(n) / 1000.0
    contact = (time > 0.05) & (time < 0.1)
    data = {name: ("time", 1e-6 * contact * np.sin(40.0 * time)) for name in SIGNALS}
    return xr.Dataset({**data, "in_contact": ("time", contact)}, {"time": time})


def contacts(n: int = 50) -> np.ndarray:
    turn = np.linspace(2.0, 4.0, n)
    around = np.stack([np.cos(turn), np.sin(turn), np.linspace(-3.0, 3.0, n)], axis=1)
    return PEG.origin + PEG.radius * around


def test_whisker_is_drawn_in_mm_with_its_taper() -> None:
    figure = whisker_views(LINE, RADIUS, name="gamma", magnification=4.0)
    assert {axis_label(n) for n in "xyz"} <= texts(figure)
    assert {"gamma", "width × 4\n43.9 mm long, radius 100 to 7 µm"} <= texts(figure)
    box = figure.axes[0].patches[0].get_path().get_extents()
    assert box.x0 == pytest.approx(-0.4, abs=1e-3)  # a disc of four times 0.1 mm about the base
    assert box.x1 == pytest.approx(40.0 + 4 * 7e-3, abs=1e-3)


def test_whisker_views_have_one_scale() -> None:
    assumed = texts(whisker_views(LINE, RADIUS, assumed=("radius", "Young's modulus")))
    assert any("assumed: radius\nassumed: Young's modulus" in text for text in assumed)
    figure = whisker_views(LINE, RADIUS)
    figure.draw_without_rendering()
    scales = [
        extent / np.ptp(limits)
        for axes in figure.axes
        for extent, limits in zip(axes.bbox.size, (axes.get_xlim(), axes.get_ylim()), strict=True)
    ]
    assert np.ptp(scales) < 1e-9 * scales[0]


def test_signals_are_shaded_in_contact_and_drawn_in_micronewton() -> None:
    figure = signals_over_time(signals(), signals())
    assert {axis_label(name) for name in (*SIGNALS, "time")} <= texts(figure)
    assert {"in contact", "measured", "true"} <= texts(figure)
    measured = figure.axes[0].lines[1].get_ydata()
    assert np.abs(measured).max() == pytest.approx(np.abs(signals().Fx).max() * 1e6)
    direction = figure.axes[4].lines[0].get_ydata()
    assert np.isfinite(direction).sum() == signals().in_contact.sum()


def test_intervals_reach_halfway_to_the_next_frames() -> None:
    found = intervals(np.arange(6.0), np.array([1, 1, 0, 0, 1, 0], dtype=bool))
    np.testing.assert_array_equal(found, [[0.0, 1.5], [3.5, 4.5]])


def test_frames_that_are_missing_do_not_divide_a_contact() -> None:
    touching = np.array([0, 1, 0, 1, 1, 0, 0, 1, 0], dtype=bool)
    seen = np.array([1, 1, 0, 1, 1, 0, 1, 1, 0], dtype=bool)
    assert contacts_in(touching, seen) == [(1, 5), (7, 8)]
    assert contacts_in(touching) == [(1, 2), (3, 5), (7, 8)]
    assert contacts_in(touching, np.zeros(9, dtype=bool)) == []
    data = signals().assign(status=("time", np.zeros(200, dtype=int)))
    data["in_contact"][60:63], data["status"][60:63] = False, Status.MISSING
    assert "in 1 contact" in "".join(texts(signals_over_time(data)))
    assert "in 2 contacts" in "".join(texts(signals_over_time(data.drop_vars("status"))))


def test_estimates_lie_on_the_identity_in_mm_and_degrees() -> None:
    true = np.random.default_rng(0).uniform(0.01, 0.04, (40, 3))
    estimated = true.copy()
    estimated[3] = np.nan
    figure = estimated_against_true(true, estimated, time=np.arange(40.0), colour=true[:, 1])
    wanted = {
        f"true {axis_label('r')}",
        f"estimated {axis_label('phi')}",
        axis_label("error_theta"),
    }
    assert wanted | {axis_label("deflection_angle"), axis_label("time")} <= texts(figure)
    for column, factor in ((0, 1e3), (1, np.degrees(1.0))):
        dots = figure.axes[column].collections[0].get_offsets()
        assert len(dots) == 39
        np.testing.assert_allclose(dots[:, 0], dots[:, 1])
        assert dots[:, 0].max() == pytest.approx(np.delete(true, 3, 0)[:, column].max() * factor)


def test_contour_shows_points_peg_and_fit_in_mm() -> None:
    points = contacts()
    points[0] = np.nan
    spread = np.tile(1e-10 * np.diag([4.0, 1.0, 1.0]), (50, 1, 1))
    shade = np.linspace(0.1, 0.5, 50)
    figure = contour_views(points, PEG, PEG, colour=shade, covariance=spread)
    wanted = {axis_label("deflection_angle"), "peg, 2.70 mm", "fitted, 2.70 mm", "95 % ellipses"}
    assert wanted | {axis_label(n) for n in "xyz"} <= texts(figure)
    top = figure.axes[0]
    ellipses = next(c for c in top.collections if isinstance(c, EllipseCollection))
    widths = 2.0 * ellipses._widths  # Matplotlib keeps half of what it is given
    np.testing.assert_allclose(widths, 2.0 * 20e-3 * np.sqrt(5.9915), rtol=1e-4)
    dots = next(c for c in top.collections if c is not ellipses)
    assert len(dots.get_offsets()) == 49
    outline = top.patches[0].get_xy()
    np.testing.assert_allclose(np.hypot(*(outline - [25.0, 0.0]).T), 1.35)


def test_contours_state_the_distance_of_the_whisker_from_the_surface() -> None:
    whisker = 60e-6
    peg = SimpleNamespace(**vars(PEG))
    peg.signed_distance = lambda p: np.hypot(*(p - PEG.origin)[:, :2].T) - PEG.radius
    points = contacts()
    points[:, :2] += (points - PEG.origin)[:, :2] * whisker / PEG.radius
    assert "the whisker's centreline is within 0.06 mm" in "".join(
        texts(contour_views(points, peg))
    )
    figure = contour_views(points + 1e-6, peg, whisker_radius=np.full(50, whisker))
    assert re.search("the whisker is within [0-9.]+ µm of", "".join(texts(figure)))
    assert "the whisker is within 0.00" not in "".join(texts(figure))
    figure = contour_views(points, peg, whisker_radius=np.full(50, whisker))
    assert "the whisker is on the" in "".join(texts(figure))  # not within 4e-15 mm


def test_what_a_figure_shows_is_written_above_it(tmp_path) -> None:
    rng = np.random.default_rng(3)
    true = np.stack([np.full(101, 25e-3), *rng.uniform(-0.5, 0.5, (2, 101))], axis=1)
    errors = np.stack([np.linspace(0.0, 2e-3, 101), np.full(101, 0.01), np.zeros(101)], axis=1)
    figure = estimated_against_true(true, true + errors, colour=np.arange(101.0), colour_name="MB")
    finding = next(text for text in figure.texts if "101 contacts" in text.get_text())
    assert "1 mm in $r$, 0.57° in" in finding.get_text()  # the errors are 0 to 2 mm, and 0.01 rad
    tracked = estimated_against_true(true, true + errors, known_as="tracked")
    assert "median difference from tracked ones 1 mm" in "".join(texts(tracked))
    wide, tall = figure.get_size_inches()
    (file,) = save(figure, tmp_path / "a", ["png"])
    rows, columns = imread(file).shape[:2]
    assert columns == pytest.approx(300 * wide, abs=2)
    assert 300 * (tall + 4.0 / 25.4) < rows < 300 * (tall + 8.0 / 25.4)
    # The sentence is above all panels.
    top = max(axes.get_position().y1 for axes in figure.axes)
    assert finding.get_position()[1] > 1.0 > top


def test_a_tilted_peg_is_cut_at_the_height_of_the_points() -> None:
    axis = np.array([np.sin(0.3), 0.0, np.cos(0.3)])
    tilted = SimpleNamespace(origin=PEG.origin, axis=axis, radius=PEG.radius)
    points = contacts() + np.array([0.0, 0.0, 5e-3])
    outline = contour_views(points, tilted).axes[0].patches[0].get_xy()
    middle = 25.0 + 5.0 * np.tan(0.3)
    np.testing.assert_allclose(
        [outline[:, 0].min(), outline[:, 0].max()],
        middle + 1.35 / np.cos(0.3) * np.array([-1.0, 1.0]),
        atol=1e-3,
    )


def test_figures_without_data_say_so() -> None:
    nothing = np.full((3, 3), np.nan)
    assert texts(whisker_views(nothing, 1e-4)) == {"no whisker"}
    assert texts(signals_over_time(signals(0))) == {"no signals"}
    assert texts(estimated_against_true(nothing, nothing)) == {"no contacts"}
    assert texts(contour_views(np.empty((0, 3)), PEG)) == {"no contacts"}


def test_one_contact_and_missing_signals_can_be_drawn() -> None:
    point = np.array([[25e-3, 0.1, 0.2]])
    assert "no contacts" not in texts(estimated_against_true(point, point, time=[0.0]))
    assert "no contacts" not in texts(contour_views(point))
    texts(signals_over_time(signals().where(lambda d: d.time > 0.1)[["Fx", "MD"]]))
    texts(signals_over_time(signals(1)))


def test_wrong_input_is_told_apart() -> None:
    with pytest.raises(ValueError, match=r"covariance has shape \(2, 3\)"):
        contour_views(contacts(), covariance=np.zeros((2, 3)))
    with pytest.raises(ValueError, match="base_signals"):
        signals_over_time(xr.Dataset({"force": ("time", [0.0])}, {"time": [0.0]}))
    with pytest.raises(ValueError, match="single, double"):
        whisker_views(LINE, RADIUS, width="triple")  # type: ignore[arg-type]


def test_files_are_written_the_same_each_time(tmp_path) -> None:
    for name in ("one", "two"):
        figure = whisker_views(LINE, RADIUS)
        files = [*save(figure, tmp_path / name), *save(figure, tmp_path / name, ["svg"])]
    assert [f.name for f in files] == ["two.png", "two.pdf", "two.svg"]
    for file in files:
        assert file.read_bytes() == file.with_stem("one").read_bytes()


OKLAB = (
    # Linear sRGB to cones, and their cube roots to lightness, a and b (B. Ottosson 2020).
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ],
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ],
)
DEUTERANOPE = [[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]]
"""Linear sRGB as seen without medium cones (Viénot, Brettel & Mollon 1999)."""


def test_cyclic_colours_close_turn_evenly_and_differ_without_medium_cones() -> None:
    encoded = cyclic()(np.linspace(0.0, 1.0, 513)[:-1])[:, :3]
    linear = np.where(encoded < 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    first, second = map(np.array, OKLAB)
    for seen, even, apart in ((np.eye(3), 2.0, 0.25), (DEUTERANOPE, 4.0, 0.12)):
        rgb = np.clip(linear @ np.transpose(seen), 0.0, 1.0)
        lab = np.cbrt(rgb @ first.T) @ second.T
        steps = np.linalg.norm(np.roll(lab, -1, axis=0) - lab, axis=1)
        assert steps.max() < even * np.median(steps)
        assert np.linalg.norm(np.roll(lab, 256, axis=0) - lab, axis=1).min() > apart


def test_robust_limits_never_collapse() -> None:
    assert np.ptp(robust_limits([np.nan])) > 0.0
    assert np.ptp(robust_limits([3e-9, 3e-9])) > 0.0
    np.testing.assert_array_equal(robust_limits([-2.0, 1.0], 1.0, symmetric=True), [-2.0, 2.0])


def test_plots_leave_pyplot_and_the_solver_alone() -> None:
    code = (
        "import sys, numpy as np, vibrissa.plots as p;"
        "p.contour_views(np.ones((4, 3))).draw_without_rendering();"
        "print([m for m in ('matplotlib.pyplot', 'numba', 'vibrissa.rod') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]", done.stdout
