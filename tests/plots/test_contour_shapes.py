"""What figures of fitted shapes and of distances from known objects show."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.text import Text

from vibrissa.contour import compare_with, distances_by, fit_free, fit_shape
from vibrissa.objects import Plane, Sphere
from vibrissa.plots import contour_views, distances_by_class
from vibrissa.quantities import axis_label

BALL = Sphere(origin=[25e-3, 1e-3, 0.0], radius=4e-3)


def texts(figure: Figure) -> set[str]:
    """All that is written on it."""
    figure.draw_without_rendering()
    return {t.get_text() for t in figure.findobj(Text)} - {""}


def near_side(n: int = 120) -> np.ndarray:
    """Points on the half of the ball that faces the whisker."""
    normal = np.random.default_rng(0).normal(size=(n, 3))
    normal[:, 0] = -np.abs(normal[:, 0])
    return BALL.origin + BALL.radius * normal / np.linalg.norm(normal, axis=1, keepdims=True)


def lines(figure: Figure, panel: int) -> list[np.ndarray]:
    """Dashed curves of a panel, mm."""
    found = [
        path.vertices
        for drawn in figure.axes[panel].collections
        if drawn.get_zorder() == 4
        for path in drawn.get_paths()
    ]
    return [v for v in found if len(v)]


def test_a_fitted_sphere_is_drawn_in_outline() -> None:
    points = near_side() + 1e-3 * np.array([0.0, 0.0, 1.0])
    figure = contour_views(points, BALL, fit_shape("sphere", points))
    assert {"object, 8.00 mm", "fitted, 8.00 mm", "95 % band"} <= texts(figure)
    centre = 1e3 * BALL.origin + [0.0, 0.0, 1.0]
    for panel, view in enumerate(((0, 1), (0, 2), (1, 2))):
        (curve,) = lines(figure, panel)
        np.testing.assert_allclose(np.hypot(*(curve - centre[[*view]]).T), 4.0, atol=0.02)


def test_a_free_surface_ends_where_it_is_not_known() -> None:
    points = near_side(600)
    points = points[points[:, 0] < BALL.origin[0] - 0.8 * BALL.radius]
    points += 2e-5 * np.random.default_rng(3).normal(size=points.shape)
    figure = contour_views(points, BALL, fit_free(points, base="sphere"))
    assert "95 % band" in texts(figure)
    (curve,) = lines(figure, 0)
    assert curve[:, 0].max() < 1e3 * BALL.origin[0] + 2.0


def test_planes_and_what_lies_elsewhere_can_be_drawn() -> None:
    flat = np.random.default_rng(1).uniform(-4e-3, 4e-3, (60, 3)) * [1.0, 0.0, 1.0]
    wall = Plane(origin=[0.0, 0.0, 0.0], normal=[0.0, -1.0, 0.0])
    fitted = fit_shape("plane", flat, outside=[0.0, -1.0, 0.0])
    figure = contour_views(flat, wall, fitted)
    assert {"object", "fitted"} <= texts(figure)
    assert np.abs(np.concatenate(lines(figure, 0))[:, 1]).max() < 1e-6
    texts(contour_views(flat + 1.0, wall, fitted))


def test_distances_are_shown_beside_what_is_predicted() -> None:
    points = near_side() + 1e-4 * np.random.default_rng(2).normal(size=(120, 3))
    compared = compare_with(BALL, points, np.tile(1e-8 * np.eye(3), (120, 1, 1)))
    radial = np.linalg.norm(points, axis=1)
    summary = distances_by(compared, "r", radial)
    figure = distances_by_class([summary, distances_by(compared, "arc_length", radial)])
    assert {axis_label("r"), "by radial distance", "median, predicted", "95 %"} <= texts(figure)
    shown = figure.axes[0].get_lines()[0].get_ydata()
    np.testing.assert_allclose(shown, 1e6 * summary["median"])
    alone = distances_by(compare_with(BALL, points), "r", radial)
    assert "median, predicted" not in texts(distances_by_class([alone]))
    assert texts(distances_by_class([])) == {"no contacts"}
