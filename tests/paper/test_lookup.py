"""The paper's look-up table: near the exact contact, NaN outside, no seam."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.paper import LookupTable, draw_contacts, estimate
from vibrissa.paper.lookup import cartesian
from vibrissa.signals import SIGNALS, nearest_on_rest

CANONICAL = ("Fx", "MB", "MD")


@pytest.fixture(scope="module")
def drawn(gridded_map):
    return draw_contacts(gridded_map, 500, seed=1)


def signals_of(drawn):
    return dict(zip(SIGNALS, drawn.signals.T, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["lookup", "lookup-linear"])
def test_between_grid_points_the_table_is_near_the_truth(gridded_map, drawn, method):
    found = estimate(gridded_map, signals_of(drawn), CANONICAL, method=method)
    inside = found.n_candidates == 1
    assert inside.mean() > 0.8
    assert (found.status[inside] == vb.Status.APPROXIMATE).all()
    assert (found.status[~inside] == vb.Status.OUTSIDE_MAP).all()
    assert np.isnan(found.point[~inside]).all()
    away = np.linalg.norm(found.point - drawn.point, axis=1)[inside] / gridded_map.whisker.length
    # The grid's radii are 0.05 L apart: an interpolation is some way off, and never as far as that.
    assert 1e-3 < np.median(away) < 0.02
    assert np.quantile(away, 0.95) < 0.1


def test_on_grid_points_it_is_exact(gridded_map):
    grid = gridded_map.grid.isel(r=6)
    reached = grid.where(grid.status == vb.Status.OK)
    found = estimate(gridded_map, reached, CANONICAL, method="lookup")
    theta, phi = np.meshgrid(grid.theta, grid.phi, indexing="ij")
    point = cartesian(np.stack([np.full_like(theta, grid.r), theta, phi], axis=-1))
    distance, arc_length = nearest_on_rest(gridded_map.whisker, point)
    kept = (distance > np.tan(np.deg2rad(2.5)) * arc_length) & (found.n_candidates == 1)
    assert kept.sum() > 50
    np.testing.assert_allclose(found.point[kept], point[kept], atol=1e-7)
    assert np.nanmax(found.chi_squared[kept]) < 1e-4


def test_the_seam_at_a_half_turn_does_not_show(gridded_map, drawn):
    """Contacts that push the whisker to one side have moments about +z or -z: M_D near ±π/2, and
    those above or below it M_D near 0 and π. Just before and behind π the answers agree."""
    table = LookupTable.of(gridded_map, CANONICAL)
    rows = drawn.signals[:, [0, 4, 5]]
    before, behind = rows.copy(), rows.copy()
    before[:, 2], behind[:, 2] = np.pi - 1e-9, -np.pi + 1e-9
    a, b = table(before), table(behind)
    both = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    # The hulls end half a radian behind the seam, each on its own side.
    assert both.mean() > 0.9 * np.isfinite(a).all(axis=1).mean()
    away = np.linalg.norm(a - b, axis=1)[both]
    # Signals drawn like this also lie where no contact is, and there neighbours are far away.
    assert np.median(away) < 1e-9
    assert np.quantile(away, 0.75) < 1e-5


def test_directions_as_components_are_nearer(gridded_map, drawn):
    rows = drawn.signals[:, [0, 4, 5]]
    error = [
        np.linalg.norm(
            LookupTable.of(gridded_map, CANONICAL, components)(rows) - drawn.point, axis=1
        )
        for components in (False, True)
    ]
    assert np.nanmedian(error[1]) < np.nanmedian(error[0])


def test_covariance_is_that_of_the_exact_estimate_within_the_tables_resolution(gridded_map, drawn):
    noise = {"Fx": 1e-6, "MB": 1e-8, "MD": 1e-2}
    rough = estimate(gridded_map, signals_of(drawn), CANONICAL, method="lookup", noise=noise)
    exact = gridded_map.estimate(signals_of(drawn), CANONICAL, noise)
    size = [np.sqrt(np.trace(e.covariance, axis1=1, axis2=2)) for e in (rough, exact)]
    both = np.isfinite(size[0]) & np.isfinite(size[1])
    assert both.mean() > 0.8
    assert 0.7 < np.median(size[0][both] / size[1][both]) < 1.4
    assert not rough.covariance_valid.any()
    wrench = np.diag([1e-6] * 3 + [1e-8] * 3) ** 2
    by_wrench = estimate(gridded_map, signals_of(drawn), CANONICAL, method="lookup", noise=wrench)
    assert np.isfinite(by_wrench.covariance).all(axis=(1, 2)).mean() > 0.8


def test_what_has_no_answer(gridded_map):
    found = estimate(
        gridded_map,
        {"Fx": [1.0, np.nan], "MB": [1.0, 1e-7], "MD": [0.0, 0.0]},
        CANONICAL,
        method="lookup",
    )
    assert found.status.tolist() == [vb.Status.OUTSIDE_MAP, vb.Status.MISSING]
    assert np.isnan(found.point).all()
    assert found.n_candidates.tolist() == [0, 0]
    assert found.to_dataset().status.shape == (2,)


def test_shapes_are_kept(gridded_map, drawn):
    signals = {name: column[:6].reshape(2, 3) for name, column in signals_of(drawn).items()}
    found = estimate(gridded_map, signals, CANONICAL, method="lookup-linear")
    assert found.point.shape == (2, 3, 3)
    assert found.candidates.point.shape == (2, 3, 1, 3)


def test_what_it_refuses(gridded_map, drawn):
    signals = signals_of(drawn)
    with pytest.raises(ValueError, match="three signals; got 4"):
        estimate(gridded_map, signals, "Fx FT MB MD", method="lookup")
    with pytest.raises(ValueError, match="method is one of 'lookup'"):
        estimate(gridded_map, signals, CANONICAL, method="cubic")
    bare = vb.ContactMap(gridded_map.whisker, gridded_map.chart)
    with pytest.raises(ValueError, match="grid=True"):
        estimate(bare, signals, CANONICAL, method="lookup")
