"""Verdicts, resolution, critical cones and witnesses: what the figures say about given results."""

from itertools import combinations

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Wedge
from matplotlib.text import Text

from vibrissa.plots import critical_cones, resolution, verdict_table, witness_pair
from vibrissa.quantities import axis_label

SIGNALS = ("Fx", "FT", "FD", "Mx", "MB", "MD")
TRIPLETS = [" ".join(c) for c in combinations(SIGNALS, 3)]
REGIONS = ["all", "ELD", "CF", "CB", "ELD CF", "ELD CB"]
KINDS = np.array(["unique", "unique off a surface", "not unique"])
TOLERANCES = np.array([1e-6, 1e-4, 1e-3, 1e-2])


def verdicts() -> xr.Dataset:
    rng = np.random.default_rng(5)
    kind = rng.choice(KINDS, (20, 6), p=[0.2, 0.2, 0.6])
    apart = np.where((kind == "not unique")[..., None], rng.uniform(1e-3, 2e-2, (20, 6, 3)), np.nan)
    share = np.sort(rng.uniform(0.0, 1.0, (20, 6, 4)), axis=-1)
    cone = np.where(kind == "not unique", 0.1, 0.0)
    cells = ("triplet", "region")
    return xr.Dataset(
        {
            "verdict": (cells, kind),
            "witness_separation": ((*cells, "witness"), apart),
            "ambiguous_share": ((*cells, "signal_tolerance"), share),
            "critical_cone": (cells, cone),
            "notation": ("triplet", [f"note {i}" for i in range(20)]),
        },
        {"triplet": TRIPLETS, "region": REGIONS, "signal_tolerance": TOLERANCES},
        {"chosen_triplet": "Fx MB MD", "min_separation": 1e-3},
    )


def cones() -> xr.Dataset:
    curvature, ratio = np.linspace(0.0, 1.5, 6), np.array([1.0, 5.0, 15.0, 60.0])
    cone = np.radians(np.outer([1.0, 4.0, 8.0, 10.0], curvature))
    return (
        xr.Dataset(
            {"critical_cone": (("taper_ratio", "curvature"), cone)},
            {"taper_ratio": ratio, "curvature": curvature},
        )
        .expand_dims(triplet=["Fx MB MD", "Mx MB MD", "Fx FD MD"])
        .copy(deep=True)
    )


def witness() -> xr.Dataset:
    """Two invented contacts 10 mm apart with the same F_x, M_B and M_D."""
    s = np.linspace(0.0, 40e-3, 41)
    rest = np.stack([s, 0.0 * s, 0.0 * s], axis=1)
    bent = np.stack([rest + np.outer(s**2, [0.0, c, 0.0]) for c in (5.0, 8.0)])
    return xr.Dataset(
        {
            "rest": (("node", "space"), rest),
            "centerline": (("pair", "node", "space"), bent),
            "contact_point": (("pair", "space"), np.array([[0.02, 0.0, 0.0], [0.03, 0.0, 0.0]])),
            "force": (("pair", "space"), np.array([[0.0, 3e-5, 4e-5], [0.0, 1e-5, 0.0]])),
            "arc_length": ("pair", [0.0201, 0.0302]),
            "Fx": ("pair", [-1.25e-5, -1.25e-5]),
            "FT": ("pair", [5e-5, 1e-5]),
            "FD": ("pair", [0.9, 0.0]),
            "Mx": ("pair", [1e-7, 2e-7]),
            "MB": ("pair", [3e-6, 3e-6]),
            "MD": ("pair", [np.pi, -np.pi + 1e-12]),
        },
        attrs={"triplet": "Fx MB MD"},
    )


def texts(figure: Figure) -> list[str]:
    figure.draw_without_rendering()
    return [t.get_text() for t in figure.findobj(Text)]


@pytest.mark.parametrize("width", ["single", "double"])
def test_each_verdict_has_its_symbol(width) -> None:
    data = verdicts()
    figure = verdict_table(data, width=width)
    count = {kind: int((data.verdict == kind).sum()) + 1 for kind in KINDS}  # one in the key
    half = figure.findobj(Wedge)
    circles = figure.findobj(Circle)
    full = [c for c in circles if np.ptp(c.get_facecolor()[:3]) > 0.1]
    assert len(half) == count["unique off a surface"]
    assert len(full) == count["unique"]
    assert len(circles) == sum(count.values()) + count["unique"]
    written = texts(figure)
    words = {"unique (no counterexample found)", "unique off a surface", "not unique (witness)"}
    assert {*words, "note 0", "note 19", "all", "ELD\nCB"} <= set(written)
    assert written.count("$F_x$  $M_B$  $M_D$") == 1


@pytest.mark.parametrize("width", [pytest.param("single", marks=pytest.mark.slow), "double"])
def test_what_is_proved_has_a_symbol_of_its_own(width) -> None:
    data = verdicts()
    evidence = np.where(data.verdict == "unique", "proved", "witness")
    figure = verdict_table(data.assign(evidence=(data.verdict.dims, evidence)), width=width)
    rings = [c for c in figure.findobj(Circle) if not c.get_fill()]
    assert len(rings) == int((data.verdict == "unique").sum()) + 1  # one in the key
    assert "unique (proved)" in texts(figure)
    assert "unique (proved)" not in texts(verdict_table(data, width=width))


def test_separations_are_in_mm_and_cones_in_degrees() -> None:
    data = verdicts()
    written = texts(verdict_table(data))
    largest = data.witness_separation.max("witness").values
    for value in largest[np.isfinite(largest)]:
        assert f"{1e3 * value:.1f}" in written
    assert f"≥{np.degrees(0.1):.1f}°" in written  # a lower bound


def test_the_share_of_contacts_with_a_twin_is_next_to_the_verdict() -> None:
    data = verdicts()
    share = np.linspace(0.0, 0.95, data.sizes["triplet"])
    column = np.tile(share[:, None], (1, data.sizes["region"]))
    written = texts(verdict_table(data.assign(twin_share=(("triplet", "region"), column))))
    assert "have a\ntwin" in written
    assert f"{100.0 * share[-1]:.2g} %" in written
    assert ("rare" if data.verdict[0, 0] == "not unique" else "none") in written


def test_ambiguous_shares_are_drawn_in_percent() -> None:
    data = verdicts()
    figure = resolution(data, width="single")
    assert len(figure.axes) == 6
    lines = figure.axes[2].lines
    assert len(lines) == 20
    drawn = sorted(line.get_ydata()[0] for line in lines)
    expected = sorted(100.0 * data.ambiguous_share.sel(region="CF").values[:, 0])
    np.testing.assert_allclose(drawn, expected)
    assert "other triplets" in texts(figure)


def test_critical_cones_are_drawn_in_degrees_and_gaps_stay_open() -> None:
    data = cones()
    data["critical_cone"][1, 0, :2] = np.nan
    figure = critical_cones(data, width="single")
    mesh = figure.axes[0].collections[0]
    assert mesh.get_array().max() == pytest.approx(15.0)
    assert np.isnan(np.ma.filled(figure.axes[1].collections[0].get_array(), np.nan)).sum() == 2
    assert "critical cone (°); dots: none; hatched: not computed" in texts(figure)


@pytest.mark.parametrize("width", ["single", "double"])
def test_witness_lists_all_six_signals_and_the_distance(width) -> None:
    written = texts(witness_pair(witness(), width=width))
    assert written.count("−12.50000") == 2  # µN
    assert written.count("3.000000") == 2  # µN·m
    assert {"50.00", "10.00", "20.10"} <= set(written)
    assert any("10.00 mm = 0.250 $L$" in text for text in written)
    assert any(r"$1 \cdot 10^{-12}$" in text for text in written)  # π and −π are the same
    assert {axis_label(n) for n in "xyz"} <= set(written)


def test_incomplete_results_are_refused() -> None:
    with pytest.raises(ValueError, match="no verdict over triplet and region"):
        verdict_table(verdicts().drop_vars("verdict"))
    with pytest.raises(ValueError, match=r"unknown verdicts \['maybe'\]"):
        verdict_table(_with_maybe())
    with pytest.raises(ValueError, match="ambiguous_share"):
        resolution(verdicts().drop_vars("ambiguous_share"))
    with pytest.raises(ValueError, match="taper_ratio"):
        critical_cones(cones().isel(taper_ratio=0))
    with pytest.raises(ValueError, match="lacks rest, MD"):
        witness_pair(witness().drop_vars(["rest", "MD"]))
    with pytest.raises(ValueError, match="a pair of contacts; got 1"):
        witness_pair(witness().isel(pair=[0]))
    with pytest.raises(ValueError, match="missing values in force"):
        witness_pair(witness().assign(force=witness().force * np.nan))
    with pytest.raises(ValueError, match="'nothing'"):
        witness_pair(witness().assign_attrs(triplet="nothing"))


def _with_maybe() -> xr.Dataset:
    data = verdicts()
    data["verdict"][0, 0] = "maybe"
    return data
