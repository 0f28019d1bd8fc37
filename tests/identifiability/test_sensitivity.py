"""Derivatives of the contact point against inversion itself, and what is made of them."""

import numpy as np
import pytest
import xarray as xr

import vibrissa as vb
from vibrissa.numerics import weighted_quantile
from vibrissa.signals import TRIPLETS, spherical

NOISE = np.diag(np.repeat([1e-12, 4e-16], 3))


@pytest.fixture(scope="module")
def nodes(gamma_map):
    return vb.sensitivity(gamma_map, noise=NOISE)


@pytest.fixture(scope="module")
def straight_map():
    return vb.ContactMap.simulate(vb.samples.straight(), grid=False)


def some(nodes, rng, n=30):
    """Contacts well away from rest and from the fold, as one row."""
    flat = nodes.stack(contact=("station", "bearing", "load")).reset_index("contact")
    load = flat["load"]
    usual = (load > 0.4) & (load < 0.9) & ~flat.small_deflection
    usual &= (flat.station > 0.35) & (flat.station < 0.95)
    return flat.isel(contact=rng.choice(np.flatnonzero(usual), n, replace=False))


def nearest(estimate, points):
    """Of each measurement's candidates the one nearest to a point."""
    away = np.linalg.norm(estimate.candidates.point - points[:, None], axis=-1)
    away = np.where(np.isfinite(away), away, np.inf)
    return estimate.candidates.point[np.arange(len(points)), np.argmin(away, axis=1)]


@pytest.mark.parametrize("triplet", ["Fx MB MD", "Fx FT FD", "FT Mx MB", "FD Mx MD"])
def test_derivatives_are_those_of_the_inversion(gamma_map, nodes, rng, triplet):
    names = triplet.split()
    at = some(nodes, rng)
    points = at.contact_point.transpose("contact", "space").to_numpy()
    found = vb.sensitivity(gamma_map, triplet, points)
    measured = np.stack([found[name].to_numpy() for name in names], axis=1)
    for j, name in enumerate(names):
        by = found.point_sensitivity.sel(signal=name).to_numpy()
        # A step that moves the contact by about a micrometre.
        step = (1e-6 / np.linalg.norm(by, axis=1))[:, None] * np.eye(3)[j]
        ends = [
            nearest(
                gamma_map.estimate(dict(zip(names, (measured + side).T, strict=True)), triplet),
                points,
            )
            for side in (step, -step)
        ]
        for got, wanted in (
            (by, ends[0] - ends[1]),
            (
                found.sensitivity.sel(signal=name).to_numpy(),
                spherical(ends[0]) - spherical(ends[1]),
            ),
        ):
            wanted = wanted / (2.0 * step[:, j : j + 1])
            error = np.linalg.norm(got - wanted, axis=1) / np.linalg.norm(wanted, axis=1)
            # A few lie so near a fold of the triplet that a micrometre leads over it.
            assert np.isfinite(error).mean() > 0.9
            assert np.nanmedian(error) < 1e-5
            assert np.nanquantile(error, 0.9) < 1e-3


def test_every_entry_has_its_unit(nodes):
    units = {
        (c, s): str(nodes.sensitivity.sel(coordinate=c, signal=s).unit.values)
        for c in ("r", "phi")
        for s in ("Fx", "MB", "MD")
    }
    assert units[("r", "Fx")] == "m/N"
    assert units[("r", "MB")] == "m/(N m)"
    assert units[("phi", "MD")] == "rad/rad"
    assert str(nodes.point_unit.sel(space="x", signal="MD").values) == "m/rad"
    assert all({"units", "long_name"} <= set(v.attrs) for v in nodes.data_vars.values())


def test_points_signals_and_recordings_give_the_same(gamma_map, nodes, rng):
    at = some(nodes, rng, 12)
    points = at.contact_point.transpose("contact", "space").to_numpy()
    points[3] = np.nan
    wanted = at.sensitivity.transpose("contact", "coordinate", "signal").to_numpy()
    by_points = vb.sensitivity(gamma_map, at=points)
    given = by_points.sensitivity.to_numpy()
    known = np.arange(12) != 3
    np.testing.assert_allclose(given[known], wanted[known], rtol=1e-5, atol=1e-9)
    assert np.isnan(given[3]).all()
    assert by_points.status[3] == vb.Status.MISSING
    labelled = xr.Dataset(
        {"contact_point_whisker": (("time", "whisker", "space"), points[:, None])}
    )
    recording = xr.DataTree.from_dict({"/": labelled.assign_coords(time=np.arange(12) * 1e-3)})
    from_recording = vb.sensitivity(gamma_map, at=recording)
    assert from_recording.sensitivity.dims == ("time", "coordinate", "signal")
    assert from_recording.time[-1] == pytest.approx(0.011)
    np.testing.assert_array_equal(from_recording.sensitivity, given)
    signals = {name: at[name].to_numpy() for name in ("Fx", "MB", "MD")}
    by_signals = vb.sensitivity(gamma_map, at=signals)
    same = known & (by_signals.status == vb.Status.UNIQUE).to_numpy()
    assert same.sum() > 6
    error = np.abs(by_signals.sensitivity.to_numpy() - wanted)[same]
    assert (error < 1e-4 * (np.abs(wanted) + np.median(np.abs(wanted), axis=0))[same]).all()


def test_at_rest_and_in_the_plane_there_are_no_infinities(gamma_map, straight_map):
    rest = gamma_map.whisker.position(np.linspace(0.4, 0.9, 4) * gamma_map.whisker.length)
    for triplet in TRIPLETS:
        found = vb.sensitivity(gamma_map, triplet, rest, noise=NOISE)
        assert not np.isinf(found.sensitivity).any()
        assert not np.isinf(found.predicted_error).any()
    assert np.isnan(vb.sensitivity(gamma_map, at=rest * np.nan).sensitivity).all()
    # A straight whisker feels no M_x, wherever it is touched.
    touched = straight_map.to_dataset().contact_point.to_numpy()[2:15:4, ::5, 4:14:3]
    for triplet in TRIPLETS:
        if "Mx" in triplet:
            assert np.isnan(vb.sensitivity(straight_map, triplet, touched).sensitivity).all()


def test_ellipsoids_are_those_of_the_covariance_of_estimates(gamma_map, nodes, rng):
    """With noise so small that the first order, which sensitivity is, is all there is."""
    at = some(nodes, rng, 20)
    signals = {name: at[name].to_numpy() for name in ("Fx", "MB", "MD")}
    little = 1e-8 * np.asarray(NOISE)
    estimated = gamma_map.estimate(signals, noise=little)
    found = vb.sensitivity(gamma_map, at=signals, noise=little)
    largest = np.abs(found.covariance.values).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(
        found.covariance / largest, estimated.covariance / largest, atol=1e-3
    )
    found = vb.sensitivity(gamma_map, at=signals, noise=NOISE)
    axes, sizes = found.axis_directions.to_numpy(), found.semi_axes.to_numpy()
    again = axes @ (sizes[..., None] ** 2 * np.swapaxes(axes, -1, -2))
    np.testing.assert_allclose(again, found.covariance, atol=1e-9 * np.abs(again).max())
    assert (np.diff(sizes, axis=-1) <= 0.0).all()
    np.testing.assert_allclose(found.predicted_error, np.linalg.norm(sizes, axis=-1))
    sigma = {"Fx": 1e-6, "MB": 2e-8, "MD": 0.01}
    diagonal = vb.sensitivity(gamma_map, at=signals, noise=sigma)
    by = diagonal.point_sensitivity * [sigma[str(n)] for n in diagonal.signal.values]
    np.testing.assert_allclose(diagonal.predicted_error, np.sqrt((by**2).sum(("space", "signal"))))


def test_regions_and_volume(gridded_map, nodes, rng):
    at = some(nodes, rng, 40)
    bent = vb.deflect(
        gridded_map.whisker,
        vb.PointContact(at.contact_point.transpose("contact", "space").to_numpy()),
    )
    line = bent.centerline(2001)
    node = np.rint(bent.arc_length / gridded_map.whisker.length * 2000).astype(int)
    rows = np.arange(40)
    ahead = line[rows, node] - line[rows, node - 1]
    slope = ahead[:, 0] / np.linalg.norm(ahead, axis=1)
    clear = np.abs(slope) > 0.01
    np.testing.assert_array_equal(at.large_deflection.to_numpy()[clear], slope[clear] < 0.0)
    # The volume of the contacts within the paper's bounds, by the map's nodes and by its grid.
    grid = vb.sensitivity(gridded_map, at="grid")
    ends = np.isclose(grid.r, grid.r.min()) | np.isclose(grid.r, grid.r.max())
    by_grid = float((grid.volume * np.where(ends, 0.5, 1.0)).sum())
    by_nodes = float(nodes.volume.where(nodes.within_paper_bounds).sum())
    assert by_nodes == pytest.approx(by_grid, rel=0.05)


def test_the_best_triplet_has_the_least_error(gamma_map, nodes, rng):
    at = some(nodes, rng, 300).contact_point.transpose("contact", "space").to_numpy()
    found = vb.best_triplet(gamma_map, NOISE, at)
    assert found.sizes["triplet"] == 20
    assert float(found.share.sum()) == pytest.approx(1.0)
    one = vb.sensitivity(gamma_map, at=at, noise=NOISE)
    np.testing.assert_allclose(
        found.predicted_error.sel(triplet="Fx MB MD"), one.predicted_error, rtol=1e-9
    )
    least = found.predicted_error.min("triplet")
    for triplet in ("Fx MB MD", "Fx FT MD"):
        wins = (found.best == triplet).to_numpy()
        np.testing.assert_array_equal(
            found.predicted_error.sel(triplet=triplet).to_numpy()[wins], least.to_numpy()[wins]
        )
    # Twice the noise is twice the error, and no other triplet.
    louder = vb.best_triplet(gamma_map, 4.0 * NOISE, at)
    np.testing.assert_array_equal(louder.best, found.best)
    np.testing.assert_allclose(louder.median_error, 2.0 * found.median_error)
    # A sensor that is deaf to moments goes by forces.
    with pytest.warns(match="larger than all signals of this whisker"):
        deaf = vb.best_triplet(gamma_map, np.diag(np.repeat([1e-12, 1.0], 3)), at)
    assert float(deaf.share.sel(triplet="Fx FT FD")) > 0.99


def test_weighted_quantiles():
    values = np.random.default_rng(4).normal(size=501)
    assert weighted_quantile(values, np.ones(501)) == pytest.approx(np.median(values))
    doubled = weighted_quantile(
        np.concatenate([values, values[:100]]), np.ones(601), np.array([0.3])
    )
    weight = np.where(np.arange(501) < 100, 2.0, 1.0)
    assert weighted_quantile(values, weight, np.array([0.3])) == pytest.approx(doubled, abs=0.02)
    assert np.isnan(weighted_quantile(values, np.zeros(501)))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"triplet": "Fx MB"}, "exactly 3"),
        ({"at": "everywhere"}, "'grid'"),
        ({"at": "grid"}, "has no grid"),
        ({"at": xr.Dataset({"Fx": ("time", [0.0])})}, "got Fx"),
        ({"at": xr.Dataset({"force": (("whisker", "space"), np.zeros((2, 3)))})}, "one whisker"),
        ({"noise": {"Fx": 1.0}}, "lacks MB, MD"),
        ({"noise": np.eye(3)}, r"got shape \(3, 3\)"),
        ({"noise": {"Fx": -1.0, "MB": 1.0, "MD": 1.0}}, "≥ 0"),
    ],
)
def test_what_does_not_fit_is_said(gamma_map, arguments, words):
    with pytest.raises(ValueError, match=words):
        vb.sensitivity(gamma_map, **arguments)


def test_no_triplets_are_refused(gamma_map):
    with pytest.raises(ValueError, match="at least one triplet"):
        vb.best_triplet(gamma_map, NOISE, triplets=[])
