"""What the figures of sensitivity say: units, the data they show, what they do without data."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.text import Text

import vibrissa as vb
from vibrissa.plots import sensitivity_panels, solid_slices, style
from vibrissa.plots.sensitivity import derivative_label
from vibrissa.quantities import axis_label, quantity

NAMES = ("Fx", "MB", "MD")


def texts(figure):
    """All that is written on it."""
    figure.draw_without_rendering()
    return {t.get_text() for t in figure.findobj(Text)} - {""}


@pytest.fixture
def derivatives():
    """Invented derivatives: each is its signal in display units, times a number of its own."""
    rng = np.random.default_rng(3)
    n = 4000
    size = np.array([1e-6, 1e-6, np.pi / 180.0])
    shown = np.stack([rng.uniform(-50, 5, n), rng.uniform(0, 20, n), rng.uniform(-180, 180, n)])
    data = {name: ("contact", s * u) for name, s, u in zip(NAMES, shown, size, strict=True)}
    factor = np.array([1e3, 180.0 / np.pi, 180.0 / np.pi])
    jacobian = shown.T[:, None, :] * np.arange(1, 4)[:, None] / factor[:, None] / size
    flags = {
        "small_deflection": ("contact", np.arange(n) < 100),
        "concave_backward": ("contact", shown[2] > 0.0),
    }
    return xr.Dataset(
        {**data, **flags, "sensitivity": (("contact", "coordinate", "signal"), jacobian)},
        {"coordinate": ["r", "theta", "phi"], "signal": list(NAMES)},
    )


def test_the_title_has_the_numbers_of_the_table(gridded_map):
    """They are those of the contacts that are drawn, which can be the paper's grid only."""
    for at in (None, "grid"):
        found = vb.sensitivity(gridded_map, at=at)
        ratios = vb.sensitivity_findings(found)["small_over_large"].sel(coordinate="r")
        title = next(t for t in texts(sensitivity_panels(found)) if t.startswith("Noise moves"))
        for name in ("MB", "Fx"):
            ratio = float(ratios.sel(signal=name, sorted_by=name))
            assert f"{ratio:.0f} times ($\\partial r/\\partial {quantity(name).symbol}" in title
        assert ("in the paper's grid" in title) == (at == "grid")


@pytest.mark.parametrize("width", [pytest.param("single", marks=pytest.mark.slow), "double"])
def test_panels_are_in_the_papers_order_and_in_display_units(derivatives, width):
    figure = sensitivity_panels(derivatives, width=width)
    said = texts(figure)
    labels = {derivative_label(c, n) for c in ("r", "theta", "phi") for n in NAMES}
    assert labels | {axis_label(n) for n in NAMES} <= said
    assert "$\\partial r/\\partial M_B$ (mm per µN·m)" in said
    panels = figure.axes
    assert panels[0].get_ylabel() == derivative_label("r", "MD")
    assert panels[8].get_ylabel() == derivative_label("phi", "Fx")
    assert panels[6].get_xlim() == (-180.0, 180.0)
    # ∂φ/∂M_B was made three times M_B: the axis holds 99 % of the one, and the bands of the other.
    low, high = panels[7].get_xlim()
    assert high == pytest.approx(20.0, rel=0.02)
    np.testing.assert_allclose(panels[7].get_ylim(), [3.0 * low, 3.0 * high], atol=2.5)
    for line in panels[7].lines[1:]:
        median = line.get_xydata()
        median = median[np.isfinite(median).all(axis=1)]
        assert len(median) > 20
        np.testing.assert_allclose(median[:, 1], 3.0 * median[:, 0], rtol=0.02, atol=0.2)


def test_bands_hold_half_and_four_fifths_of_the_contacts(derivatives):
    rng = np.random.default_rng(5)
    even = derivatives.sensitivity.copy(data=rng.uniform(-1.0, 1.0, derivatives.sensitivity.shape))
    panel = sensitivity_panels(derivatives.assign(sensitivity=even)).axes[0]
    heights = [np.ptp(one.get_paths()[0].vertices[:, 1]) for one in panel.collections[:2]]
    unit = 1e3 * np.pi / 180.0  # mm per degree
    np.testing.assert_allclose(np.array(heights) / unit, [1.6, 1.0], rtol=0.35)
    assert panel.get_ylim()[1] == pytest.approx(0.8 * unit, rel=0.15)


def test_medians_of_bunched_signals_do_not_zigzag(derivatives):
    """As on the paper's grid, whose radii contribute in turn."""
    rng = np.random.default_rng(7)
    bunch = rng.integers(0, 25, 4000)
    moment = 0.8 * bunch + rng.uniform(0.3, 0.5, 4000)
    slope = moment + (-1.0) ** bunch + rng.normal(size=4000)
    shown = derivatives.sensitivity.copy()
    shown.loc[{"coordinate": "r", "signal": "MB"}] = slope
    bunched = derivatives.assign(MB=("contact", moment * 1e-6), sensitivity=shown)
    for line in sensitivity_panels(bunched).axes[1].lines[1:]:
        median = line.get_ydata()
        median = median[np.isfinite(median)]
        assert np.abs(np.diff(median)).sum() < 1.1 * np.ptp(median)


def test_a_conclusion_breaks_where_its_line_is_full():
    """Commands of formulas are as wide as the letters that they print."""
    figure = style.new_figure("double", 50.0, None)
    words = " ".join([r"$\partial r$"] * 12)
    style.conclude(figure, words)
    assert figure.texts[-1].get_text() == words


def plane(scale=1.0):
    fx, mb = np.meshgrid(np.linspace(-5e-5, 5e-6, 20), np.linspace(0, 1e-5, 18), indexing="ij")
    inside = np.where(mb > -0.1 * fx, 1.0, np.nan)
    data = {
        "r": 0.03 - 1e3 * mb,
        "theta": 2e4 * fx,
        "phi": scale * (0.1 - 1e4 * mb),
        "error_distance": 1e-5 + 10.0 * mb,
    }
    return xr.Dataset(
        {name: (("Fx", "MB"), values * inside) for name, values in data.items()},
        {
            "Fx": ("Fx", fx[:, 0], {"linear_width": 5e-6}),
            "MB": ("MB", mb[0], {"linear_width": 5e-6}),
        },
        {"triplet": "Fx MB MD", "fixed": "MD", "value": -0.5 * np.pi},
    )


def solid(n=500):
    rng = np.random.default_rng(4)
    return xr.Dataset(
        {
            "Fx": ("contact", rng.uniform(-5e-5, 0, n)),
            "MB": ("contact", rng.uniform(0, 1e-5, n)),
            "MD": ("contact", rng.uniform(-np.pi, np.pi, n)),
            "error_distance": ("contact", rng.uniform(1e-5, 1e-3, n)),
        }
    )


@pytest.mark.parametrize("width", ["single", "double"])
def test_slices_and_the_cut_solid(width):
    figure = solid_slices(plane(), solid(), width=width)
    said = texts(figure)
    assert {axis_label(n) for n in ("Fx", "MB", "My", "Mz", "error_distance")} <= said
    assert {"radial distance (mm)", "azimuth (°)", "elevation (°)", "3D error (mm)"} <= said
    axes = next(a for a in figure.axes if hasattr(a, "get_zlim"))
    x, *_ = axes.collections[0]._offsets3d
    assert 100 < len(x) < 400  # the half before the slice is taken away
    assert np.max(x) < 0.5


def test_a_slice_alone_and_one_in_a_plane():
    figure = solid_slices(plane(scale=1e-6))
    assert "zero: in the whisker's plane" in texts(figure)
    assert len(figure.axes) >= 4


def test_nothing_to_draw_and_wrong_input(derivatives):
    nothing = derivatives.assign(small_deflection=~derivatives.small_deflection | True)
    assert texts(sensitivity_panels(nothing)) == {"no contacts"}
    assert texts(solid_slices(plane() * np.nan)) == {"no contacts"}
    with pytest.raises(ValueError, match=r"vibrissa\.sensitivity"):
        sensitivity_panels(derivatives.drop_vars("sensitivity"))
    with pytest.raises(ValueError, match="lack concave_backward"):
        sensitivity_panels(derivatives.drop_vars("concave_backward"))
    with pytest.raises(ValueError, match="lacks phi"):
        solid_slices(plane().drop_vars("phi"))
    with pytest.raises(ValueError, match="solid lacks MD"):
        solid_slices(plane(), solid().drop_vars("MD"))
