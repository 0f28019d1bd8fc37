"""The reachable space and the solids of signals: areas, values and what is written on them."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

from vibrissa.plots import contact_surfaces, save, signal_clouds
from vibrissa.quantities import axis_label
from vibrissa.scene.solids import (
    SIGNALS,
    clip,
    column,
    level_surface,
    sample_contacts,
    skin,
    solid_surface,
    subdivide,
    values_of,
)

LENGTH, WIDEST, CONE = 40e-3, 0.8, np.deg2rad(2.0)
LINE = np.stack([np.linspace(0.0, LENGTH, 50), np.zeros(50), np.zeros(50)], axis=1)
OUTSIDE = column("deflection")


@pytest.fixture
def coarse(monkeypatch):
    """Surfaces that are quicker to make, where only what is written matters."""
    monkeypatch.setattr("vibrissa.scene.solids._SHAPE", (12, 24, 8))


def around(turn: np.ndarray) -> np.ndarray:
    return np.angle(np.exp(1j * turn))


def chart(pulled: float = 0.0, twist: float = 1e-6) -> xr.Dataset:
    """A whisker that is imagined to reach a part of a ball about its base, up to 0.8 rad aside."""
    axes = {
        "station": np.linspace(0.3, 1.0, 9),
        "bearing": np.linspace(0.0, 2.0 * np.pi, 17),
        "load": np.linspace(0.0, 1.0, 9),
    }
    s, b, q = np.meshgrid(*axes.values(), indexing="ij")
    aside = WIDEST * q
    way = [np.cos(aside), np.sin(aside) * np.cos(b), np.sin(aside) * np.sin(b)]
    dims = tuple(axes)
    signals = {
        "Fx": 1e-4 * (pulled - q**2),
        "FT": 1e-4 * q,
        "FD": around(b),
        "Mx": twist * q * np.sin(b),
        "MB": 1e-6 * q * s,
        "MD": around(b + 0.5 * np.pi),
    }
    return xr.Dataset(
        {
            "contact_point": ((*dims, "space"), LENGTH * s[..., None] * np.stack(way, axis=-1)),
            "arc_length": (dims, LENGTH * s),
            **{name: (dims, values) for name, values in signals.items()},
        },
        axes,
    )


def texts(figure: Figure) -> set[str]:
    """All that is written but the ticks of the axes in space, without drawing the surfaces."""
    return {t.get_text() for t in figure.findobj(lambda a: hasattr(a, "get_text"))} - {""}


def area(triangles: np.ndarray) -> float:
    a, b, c = np.moveaxis(triangles[..., :3], 1, 0)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def test_between_nodes_the_chart_goes_on() -> None:
    nodes = sample_contacts(chart(), LINE, shape=(20, 40, 20))
    point = nodes[..., :3]
    r = np.linalg.norm(point, axis=-1)
    np.testing.assert_allclose(values_of("r", nodes), r, rtol=1e-12)
    np.testing.assert_allclose(r[:, 0, 0], np.linspace(0.3, 1.0, 21) * LENGTH, rtol=1e-9)
    touched = nodes[:, :, 1:]
    bearing = np.arctan2(touched[..., 2], touched[..., 1])
    gap = around(values_of("MD", touched) - bearing - 0.5 * np.pi)
    assert np.abs(gap).max() < 1e-3
    # A cubic spline misses a circle with 16 nodes by h⁴/384.
    miss = 1e-4 * (2.0 * np.pi / 16.0) ** 4 / 384.0
    load = np.broadcast_to(np.linspace(0.0, 1e-4, 21), r.shape)
    np.testing.assert_allclose(values_of("FT", nodes), load, rtol=0.0, atol=1.1 * miss)
    aside = np.arctan2(np.hypot(point[..., 1], point[..., 2]), point[..., 0])
    # The nearest place on a straight whisker lies at r cos(aside).
    expected = r * (np.sin(aside) - np.cos(aside) * np.tan(CONE))
    np.testing.assert_allclose(values_of("deflection", nodes), expected, atol=3e-5)


def test_a_solid_has_the_surface_of_the_ball_it_is_cut_from() -> None:
    low, high = 0.3 * LENGTH, LENGTH
    caps = 2.0 * np.pi * (low**2 + high**2) * (np.cos(CONE) - np.cos(WIDEST))
    sides = np.pi * (high**2 - low**2) * (np.sin(CONE) + np.sin(WIDEST))
    whole = sample_contacts(chart(), LINE)
    assert area(solid_surface(whole, True, OUTSIDE)) == pytest.approx(caps + sides, rel=5e-3)
    quarter = sample_contacts(chart(), LINE, (0.0, 0.5 * np.pi))
    cuts = (high**2 - low**2) * (WIDEST - CONE)
    assert area(solid_surface(quarter, False, OUTSIDE)) == pytest.approx(
        0.25 * (caps + sides) + cuts, rel=5e-3
    )


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("r", 0.6 * LENGTH, 2.0 * np.pi * (0.6 * LENGTH) ** 2 * (np.cos(CONE) - np.cos(WIDEST))),
        ("theta", 1e-6, (WIDEST - CONE) * (1.0 - 0.3**2) * LENGTH**2),
        ("phi", 1e-6, (WIDEST - CONE) * (1.0 - 0.3**2) * LENGTH**2),
    ],
)
def test_surfaces_of_equal_coordinates_have_their_area(name, value, expected) -> None:
    surface = clip(level_surface(sample_contacts(chart(), LINE), column(name), value), OUTSIDE)
    assert area(surface) == pytest.approx(expected, rel=0.01)
    np.testing.assert_allclose(values_of(name, surface), value, atol=1e-12 + 1e-9 * value)


def test_clipping_parts_triangles_in_two() -> None:
    triangles = np.random.default_rng(3).normal(size=(200, 3, 4))
    over = clip(triangles, 3)
    mirrored = triangles * np.array([1.0, 1.0, 1.0, -1.0])
    under = clip(mirrored, 3)
    assert over[..., 3].min() > -1e-12
    assert area(over) + area(under) == pytest.approx(area(triangles), rel=1e-12)


def test_refining_keeps_the_surface() -> None:
    triangles = np.random.default_rng(4).normal(size=(20, 3, 4))
    finer = subdivide(triangles, np.arange(20) < 5, times=2)
    assert len(finer) == 15 + 5 * 16
    assert area(finer) == pytest.approx(area(triangles), rel=1e-12)
    np.testing.assert_allclose(finer.max(axis=(0, 1)), triangles.max(axis=(0, 1)))


def test_the_skin_of_a_full_turn_has_no_cuts() -> None:
    nodes = np.zeros((3, 5, 4, 4))
    assert len(skin(nodes, closed=True)) == 2 * (2 * 4 + 2 * 4 * 3)
    assert len(skin(nodes, closed=False)) == len(skin(nodes, closed=True)) + 2 * 2 * 2 * 3


@pytest.mark.parametrize("width", ["single", "double"])
def test_clouds_show_six_signals_in_display_units(width, coarse) -> None:
    figure = signal_clouds(chart(), LINE, width=width)
    written = texts(figure)
    assert {axis_label(name) for name in (*SIGNALS, "x", "y", "z")} <= written
    assert not any("F_x$ > 0" in text for text in written)
    bars = {axes.get_xlabel(): axes for axes in figure.axes}
    assert bars[axis_label("FT")].get_xlim()[1] == pytest.approx(100.0, rel=0.1)  # µN
    assert bars[axis_label("MD")].get_xlim() == (-180.0, 180.0)


def test_an_inset_shows_where_the_whisker_is_pulled(coarse) -> None:
    # F_x is largest, 0.3e-4 N less what the cone leaves out, next to rest.
    written = texts(signal_clouds(chart(pulled=0.3), LINE))
    assert {"$F_x$ > 0", "30 µN"} <= written


def test_no_twist_is_said_and_not_coloured(coarse) -> None:
    written = texts(signal_clouds(chart(twist=1e-20), LINE))
    assert "$M_x = 0$ everywhere" in written
    assert axis_label("Mx") not in written


@pytest.mark.parametrize("width", ["single", pytest.param("double", marks=pytest.mark.slow)])
def test_surfaces_are_labelled_in_mm_and_degrees(width, coarse, tmp_path) -> None:
    figure = contact_surfaces(chart(), LINE, width=width)
    written = texts(figure)
    assert {axis_label(n) for n in ("r", "theta", "phi", "x", "y", "z", "Fx")} <= written
    assert "$M_D$ = 180°" in written
    assert set("abcdefghi") <= written
    if width == "single":  # surfaces are painted as pixels
        assert save(figure, tmp_path / "surfaces", ["pdf"])[0].stat().st_size < 2e6


def test_incomplete_maps_are_refused() -> None:
    with pytest.raises(ValueError, match="lacks contact_point, MD"):
        signal_clouds(chart().drop_vars(["MD", "contact_point"]), LINE)
    with pytest.raises(ValueError, match="no dimension load"):
        contact_surfaces(chart().isel(load=0), LINE)
    with pytest.raises(ValueError, match="lacks some values"):
        signal_clouds(chart().where(chart()["load"] < 0.9), LINE)
    with pytest.raises(ValueError, match="single, double"):
        contact_surfaces(chart(), LINE, width="triple")  # type: ignore[arg-type]
