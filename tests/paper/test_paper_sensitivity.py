"""The paper's sensitivity, its findings and its solid of contacts, against what is exact."""

from dataclasses import replace

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.numerics import contact_weights, weighted_quantile
from vibrissa.paper import central_differences, error_solid, interpolation_errors, signal_slice
from vibrissa.signals import spherical, within_turn


@pytest.fixture(scope="module")
def nodes(gamma_map):
    return vb.sensitivity(gamma_map)


@pytest.fixture(scope="module")
def some_points(nodes):
    """Contact points well away from rest and from the fold, within the paper's bounds."""
    flat = nodes.stack(contact=("station", "bearing", "load")).reset_index("contact")
    usual = (
        (flat["load"] > 0.4) & (flat["load"] < 0.9) & (flat.station > 0.35) & (flat.station < 0.95)
    )
    usual &= ~flat.small_deflection & flat.within_paper_bounds
    rows = np.random.default_rng(20).choice(np.flatnonzero(usual), 200, replace=False)
    return flat.contact_point.isel(contact=rows).transpose("contact", "space").to_numpy()


def nearest(estimate, points):
    """Of each measurement's candidates the one nearest to a point."""
    away = np.linalg.norm(estimate.candidates.point - points[:, None], axis=-1)
    away = np.where(np.isfinite(away), away, np.inf)
    return estimate.candidates.point[np.arange(len(points)), np.argmin(away, axis=1)]


def test_differences_on_an_exact_table_are_the_derivatives(gridded_map, some_points):
    points = some_points[:15]
    exact = vb.sensitivity(gridded_map, at=points)
    grid = gridded_map.grid
    reached = (grid.status == vb.Status.OK).to_numpy()
    span = [np.ptp(grid[n].to_numpy()[reached]) for n in ("Fx", "MB")]
    low = [grid[n].to_numpy()[reached].min() for n in ("Fx", "MB")]

    def inversion(places, values):
        def look_up(wanted):
            signals = {
                "Fx": low[0] + wanted[:, 0] * span[0],
                "MB": low[1] + wanted[:, 1] * span[1],
                "MD": -np.pi + wanted[:, 2] * 2.0 * np.pi,
            }
            return spherical(nearest(gridded_map.estimate(signals), points))

        return look_up

    found = central_differences(gridded_map, at=points, interpolation=inversion, step=1e-7)
    for name in ("sensitivity", "point_sensitivity"):
        got, wanted = found[name].to_numpy(), exact[name].to_numpy()
        scale = np.linalg.norm(wanted, axis=1, keepdims=True)
        assert np.nanmedian(np.abs(got - wanted) / scale) < 1e-4


def test_differences_come_nearer_on_a_finer_table(gridded_map, some_points):
    points = some_points
    exact = vb.sensitivity(gridded_map, at=points).sensitivity
    thinned = replace(
        gridded_map,
        grid=gridded_map.grid.isel(theta=slice(None, None, 3), phi=slice(None, None, 3)),
    )
    errors = []
    for contacts in (thinned, gridded_map):
        found = central_differences(contacts, at=points, interpolation="linear")
        away = np.abs(found.sensitivity - exact) / np.abs(exact)
        errors.append(np.nanmedian(away))
    # In r, where both have the paper's 15 steps, neither is better.
    assert errors[1] < 0.85 * errors[0]


def test_differences_have_ellipsoids_and_need_a_grid(gridded_map, gamma_map, some_points):
    noise = np.diag(np.repeat([1e-12, 4e-16], 3))
    found = central_differences(gridded_map, at=some_points, noise=noise, interpolation="linear")
    exact = vb.sensitivity(gridded_map, at=some_points, noise=noise)
    assert found.predicted_error.dims == exact.predicted_error.dims
    assert 0.7 < float((found.predicted_error / exact.predicted_error).median()) < 1.4
    with pytest.raises(ValueError, match="has no grid"):
        central_differences(gamma_map)
    with pytest.raises(ValueError, match="step"):
        central_differences(gridded_map, step=0.0)


def test_findings_of_a_straight_whisker_follow_from_its_symmetry():
    straight = vb.ContactMap.simulate(vb.samples.straight(), grid=False)
    found = vb.sensitivity_findings(vb.sensitivity(straight))
    # About its axis all is the same: M_D turns the contact and leaves r alone.
    assert float(found.share_of_motion.sel(coordinate="r", signal="MD")) < 1e-20
    np.testing.assert_allclose(found.share_of_motion.sum("coordinate"), 1.0)
    ratio = found.backward_over_forward.stack(entry=("coordinate", "signal"))
    np.testing.assert_allclose(ratio.drop_sel(entry=("r", "MD")), 1.0, atol=1e-3)


def test_the_papers_findings_hold_for_the_gamma_whisker(nodes):
    found = vb.sensitivity_findings(nodes)
    assert float(found.share_of_motion.sel(coordinate="r", signal="MD")) < 0.25
    sizes = found.small_over_large.sel(signal=["Fx", "MB"])
    assert (sizes > 1.0).all()
    ratio = found.backward_over_forward.sel(coordinate="theta", signal="MB")
    assert not 0.5 < float(ratio) < 2.0


def test_findings_ask_only_the_region(nodes):
    region = nodes.concave_backward & ~nodes.small_deflection
    found = vb.sensitivity_findings(nodes, region)
    sizes = np.abs(nodes.sensitivity.sel(coordinate="r", signal="Fx")).to_numpy()[region.to_numpy()]
    volume = nodes.volume.to_numpy()[region.to_numpy()]
    wanted = weighted_quantile(sizes, volume)
    assert float(found.median_size.sel(coordinate="r", signal="Fx")) == pytest.approx(float(wanted))
    assert np.isnan(found.backward_over_forward).all()
    assert contact_weights(nodes, region).sum() == pytest.approx(volume.sum())


def test_a_slice_holds_one_signal_and_is_exact(gridded_map):
    found = signal_slice(gridded_map, points=24)
    there = np.isfinite(found.r.to_numpy())
    assert 0.2 < there.mean() < 0.95
    points = found.contact_point.to_numpy()[there]
    bent = vb.deflect(gridded_map.whisker, vb.PointContact(points))
    signals = vb.base_signals(bent.force, bent.moment)
    fx, mb = np.meshgrid(found.Fx, found.MB, indexing="ij")
    assert found.r.dims == ("Fx", "MB")
    # A point near rest tells its force no better than it is met.
    strong = mb[there] > 1e-7
    np.testing.assert_allclose(signals.MB[strong], mb[there][strong], rtol=1e-4)
    np.testing.assert_allclose(signals.Fx[strong], fx[there][strong], rtol=1e-3, atol=2e-8)
    np.testing.assert_allclose(signals.MD[strong], -0.5 * np.pi, atol=1e-4)
    error = found.error_distance.to_numpy()[there]
    assert 0.0 < np.nanmedian(error) < 2e-3
    with pytest.raises(ValueError, match="to be fixed"):
        signal_slice(gridded_map, {"Mx": 0.0})


def test_contacts_between_the_grid_have_errors(gridded_map):
    found = error_solid(gridded_map, stride=6)
    assert np.isfinite(found.error_distance).sum() > 50
    # On the grid itself there is none.
    on_grid = vb.sensitivity(gridded_map, at="grid").isel(contact=slice(None, None, 97))
    assert np.nanmedian(interpolation_errors(gridded_map, on_grid, interpolation="linear")) < 1e-8
    assert np.nanmedian(found.error_distance) > 1e-5


def test_directions_a_turn_away_are_looked_up_at_the_same_place(gridded_map):
    at = gridded_map.to_dataset("paper").isel(
        station=slice(None, None, 3), bearing=slice(None, None, 4)
    )
    turned = at.assign(MD=at["MD"] + 2.0 * np.pi)
    errors = interpolation_errors(gridded_map, at, interpolation="linear")
    assert np.isfinite(errors).sum() > 50
    np.testing.assert_allclose(
        interpolation_errors(gridded_map, turned, interpolation="linear"), errors
    )
    directions = np.array([[1.5 * np.pi, 5.0], [-np.pi, -5.0], [np.pi, 0.0]])
    wanted = [[-0.5 * np.pi, 5.0], [np.pi, -5.0], [np.pi, 0.0]]
    np.testing.assert_allclose(within_turn(directions, np.array([True, False])), wanted)
