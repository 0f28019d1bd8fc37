"""The map: its samples are equilibria, its domains are told apart, and files keep it whole."""

import h5py
import numpy as np
import pytest
import xarray as xr

import vibrissa as vb
from vibrissa.contacts import within_paper_bounds
from vibrissa.contacts.fitting.inversion import invert
from vibrissa.rod import (
    CELLS,
    MOST_CELLS,
    cells_around,
    contacts_at,
    seed_room,
    seeds,
    solve_forces,
    with_normal_force,
)
from vibrissa.signals import SIGNALS, signals_of, spherical


def test_samples_are_equilibria_of_their_contact_points(gamma_map):
    data = gamma_map.to_dataset().isel(station=slice(1, -1, 4), bearing=slice(0, -1, 5))
    data = data.isel(load=slice(2, -1, 4))
    bent = vb.deflect(gamma_map.whisker, vb.PointContact(data.contact_point.to_numpy()))
    assert (bent.status == vb.Status.OK).all()
    np.testing.assert_allclose(bent.arc_length, data.arc_length, atol=1e-9)
    np.testing.assert_allclose(bent.moment, data.moment, rtol=1e-6, atol=1e-14)


def test_derivatives_are_those_of_the_samples(gamma_map):
    """By a point force a little further along: first differences agree with the stored slopes."""
    data = gamma_map.to_dataset().isel(station=8, bearing=5, load=9)
    s, force = data.arc_length.item(), gamma_map.chart.contacts[8, 5, 9, 1:]
    force = force * gamma_map.chart.discretization.force
    ds = 1e-8
    ends = [
        vb.deflect(gamma_map.whisker, vb.PointForce(s + d, components=(0.0, *force)))
        for d in (ds, -ds)
    ]
    slope = (ends[0].contact_point - ends[1].contact_point) / (2.0 * ds)
    np.testing.assert_allclose(
        data.contact_point_derivative.sel(unknown="s"), slope, rtol=1e-5, atol=1e-6
    )


def test_paper_domain_keeps_the_grid_bounds(gamma_map):
    everything = gamma_map.to_dataset()
    paper = gamma_map.to_dataset("paper")
    inside = within_paper_bounds(gamma_map.whisker, everything.contact_point.to_numpy())
    assert 0.2 < inside.mean() < 1.0
    np.testing.assert_array_equal(np.isfinite(paper.Fx), inside)
    with pytest.raises(ValueError, match="'reachable' or 'paper'; got 'all'"):
        gamma_map.to_dataset("all")


def test_every_variable_says_what_it_is(gamma_map):
    data = gamma_map.to_dataset()
    for name in data.data_vars:
        assert data[name].attrs.get("long_name"), name
        assert "units" in data[name].attrs or "flag_values" in data[name].attrs, name


def test_files_keep_the_map_whole(gamma_map, tmp_path):
    path = tmp_path / "map.nc"
    gamma_map.save(path)
    again = vb.ContactMap.load(path)
    xr.testing.assert_identical(again.to_dataset(), gamma_map.to_dataset())
    np.testing.assert_array_equal(again.chart.values, gamma_map.chart.values)
    signals = {"Fx": 2e-5, "MB": 1.5e-6, "MD": 1.4}
    np.testing.assert_array_equal(
        again.estimate(signals).candidates.point, gamma_map.estimate(signals).candidates.point
    )


def test_a_file_of_another_kind_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        vb.ContactMap.load(tmp_path / "none.nc")
    text = tmp_path / "text.nc"
    text.write_text("not a map")
    with pytest.raises(ValueError, match="cannot be read as NetCDF-4"):
        vb.ContactMap.load(text)
    other = tmp_path / "other.nc"
    xr.Dataset({"a": 1.0}).to_netcdf(other, engine="h5netcdf")
    with pytest.raises(ValueError, match="not a contact map"):
        vb.ContactMap.load(other)
    trial = tmp_path / "trial.nc"
    xr.Dataset(coords={"whisker": ["a"]}, attrs={"kind": "vibrissa recording"}).to_netcdf(
        trial, engine="h5netcdf"
    )
    with pytest.raises(ValueError, match="it contains: vibrissa recording"):
        vb.ContactMap.load(trial)


def test_a_map_without_a_part_of_it_is_refused(tmp_path, gamma_map):
    whole, path = tmp_path / "whole.nc", tmp_path / "map.nc"
    gamma_map.save(whole)
    for lost in ("chart", "whisker", "chart/fold", "chart/values", "whisker/radius"):
        path.write_bytes(whole.read_bytes())
        with h5py.File(path, "r+") as file:
            del file[lost]
        with pytest.raises(ValueError, match=lost.rpartition("/")[2]) as caught:
            vb.ContactMap.load(path)
        assert str(path) in str(caught.value)


def test_the_papers_grid(tmp_path):
    """Signals on it are those of point contacts; unreachable points say why."""
    calls = []
    whisker = vb.samples.gamma()
    contact_map = vb.ContactMap.simulate(whisker, progress=lambda done, total: calls.append(done))
    grid = contact_map.grid
    assert grid.status.shape == (15, 131, 121)
    assert calls == list(range(1, 16))
    reached = (grid.status == vb.Status.OK).to_numpy()
    assert 0.1 < reached.mean() < 0.9
    assert not (grid.status == vb.Status.NOT_CONVERGED).any()
    assert np.isnan(grid.Fx.to_numpy()[~reached]).all()
    i, j, k = np.argwhere(reached)[1234]
    r, theta, phi = grid.r[i].item(), grid.theta[j].item(), grid.phi[k].item()
    point = r * np.array([np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi)])
    np.testing.assert_allclose(spherical(point), [r, theta, phi], rtol=1e-12)
    bent = vb.deflect(whisker, vb.PointContact(point))
    np.testing.assert_allclose(bent.moment, grid.moment[i, j, k], rtol=1e-9)
    contact_map.save(tmp_path / "map.nc")
    xr.testing.assert_identical(vb.ContactMap.load(tmp_path / "map.nc").grid, grid)


def test_cells_about_measurements_hold_the_contacts_that_noise_has_moved(gamma_map, rng):
    """Cells listed for signals that are wrong by less than the slack hold the true contact."""
    chart, triplet, number = gamma_map.chart, ("Fx", "MB", "MD"), 300
    charted = rng.uniform([0.02, -np.pi, 0.2], [0.98, np.pi, 0.98], (number, 3))
    contacts = contacts_at(chart.fold, charted)
    values, _ = solve_forces(chart.discretization, np.insert(contacts, 1, 0.0, axis=1))
    force, moment = values[:, :3], np.cross(values[:, 3:], values[:, :3])
    exact = signals_of(force, moment)[:, [SIGNALS.index(name) for name in triplet]]
    slack = 0.02 * np.abs(exact)
    wrong = exact + rng.uniform(-1.0, 1.0, exact.shape) * slack
    cell = np.array([1.0, 2.0 * np.pi, 1.0]) / CELLS
    spots, away = np.empty((MOST_CELLS, 3)), np.empty(MOST_CELLS)
    cells = np.empty(MOST_CELLS, np.int64)
    for aim, reach, true in zip(wrong, slack, charted, strict=True):
        n = cells_around(gamma_map.tree(triplet), aim, reach, cells, spots, away)
        assert n < MOST_CELLS
        apart = spots[:n] - true
        apart[:, 1] = (apart[:, 1] + np.pi) % (2.0 * np.pi) - np.pi
        assert (np.abs(apart) <= cell + 1e-9).all(axis=1).any()
        assert (away[:n] <= 1.0).all()


@pytest.mark.parametrize(
    ("straight", "triplet"),
    [(False, ("Fx", "MB", "MD")), (False, ("FD", "MB", "MD")), (True, ("Fx", "MB", "MD"))],
)
def test_the_lightest_contacts_are_found(gamma_map, rng, straight, triplet):
    """Signals vanish at rest, but over the force they locate a contact there as elsewhere.

    On a straight whisker F_x vanishes faster than the force.
    """
    if straight:
        gamma_map = vb.ContactMap.simulate(vb.Whisker.straight(length=0.04), grid=False)
    charted = rng.uniform([0.02, -np.pi, -3.0], [0.98, np.pi, -1.0], (500, 3))
    assert _share_found(gamma_map, triplet, charted) > 0.99


@pytest.mark.parametrize(
    "triplet",
    [
        ("FT", "FD", "Mx"),
        ("Fx", "FT", "MB"),
        pytest.param(("FD", "Mx", "MD"), marks=pytest.mark.slow),
    ],
)
def test_light_contacts_near_the_plane_of_a_planar_whisker_are_found(gamma_map, rng, triplet):
    """Signals that do not change to first order across the plane have a fold on faces of cells.

    Far from rest, F_T and M_x vanish together on a curve: all along it they are nearly those of a
    light contact.
    """
    charted = rng.uniform([0.02, -0.15, -3.0], [0.98, 0.15, -1.0], (500, 3))
    charted[::2, 1] += np.pi
    assert _share_found(gamma_map, triplet, charted) > 0.99


def _wire(curvature, taper=1.0):
    """A steel wire of constant curvature (over 1/L)."""
    return vb.Whisker.from_curvature(
        0.15,
        lambda s: np.stack([0 * s, 0 * s, curvature / 0.15 + 0 * s], -1),
        base_radius=3e-4,
        tip_radius=3e-4 / taper,
        youngs_modulus=200e9,
    )


def _signals_of_contacts(contact_map, charted):
    """Signals and contact points (n, 3), in m, of positions in the chart."""
    chart, d = contact_map.chart, contact_map.chart.discretization
    contacts = contacts_at(chart.fold, charted)
    values, _ = solve_forces(d, np.insert(contacts, 1, 0.0, axis=1))
    force, point = values[:, :3] * d.force, values[:, 3:] * d.length
    return vb.base_signals(force, np.cross(point, force)), point


def _misses(found, point):
    """Whether each estimate contains no candidate at the contact point, though it claims to."""
    away = np.linalg.norm(found.candidates.point - point[:, None], axis=-1)
    near = np.nanmin(np.where(np.isnan(away), np.inf, away), axis=1) < 1e-5 * 0.15
    return ~near & (found.status != vb.Status.DEGENERATE)


@pytest.mark.parametrize(("curvature", "taper"), [(0.1, 1.0), (0.1, 1.02), (0.6, 1.3), (0.0, 1.05)])
def test_contacts_of_wires_are_right_or_called_undetermined(rng, curvature, taper):
    """F_x of a uniform wire nearly follows from its moment; what remains locates the contact."""
    contact_map = vb.ContactMap.simulate(_wire(curvature, taper), grid=False)
    for low, high in ((0.2, 0.95), (0.01, 0.2)):
        charted = rng.uniform([0.02, -np.pi, low], [0.98, np.pi, high], (500, 3))
        signals, point = _signals_of_contacts(contact_map, charted)
        found = contact_map.estimate(signals, "Fx MB MD")
        undetermined = found.status == vb.Status.DEGENERATE
        assert _misses(found, point).mean() < 0.01
        assert undetermined.mean() <= (0.4 if taper == 1.0 else 0.0)
        assert not (undetermined & np.isfinite(found.point[:, 0])).any()


def test_contacts_in_the_plane_of_a_uniform_wire_are_undetermined(rng):
    """In the plane the moment alone gives F_x, wherever the contact is."""
    contact_map = vb.ContactMap.simulate(_wire(0.4), grid=False)
    charted = rng.uniform([0.1, 0.0, 0.2], [0.9, 0.0, 0.6], (100, 3))
    signals, _ = _signals_of_contacts(contact_map, charted)
    found = contact_map.estimate(signals, "Fx MB MD")
    assert (found.status == vb.Status.DEGENERATE).mean() > 0.95
    assert not (found.status == vb.Status.UNIQUE).any()


@pytest.mark.slow
def test_light_contacts_of_a_wire_that_is_a_full_circle_are_found(rng):
    """Dozens of cells nearly contain a light target there, and must not crowd out the right one."""
    contact_map = vb.ContactMap.simulate(_wire(2.0 * np.pi), grid=False)
    charted = rng.uniform([0.1, -np.pi, 0.01], [0.9, np.pi, 0.1], (40, 3))
    signals, point = _signals_of_contacts(contact_map, charted)
    assert _misses(contact_map.estimate(signals, "Fx MB MD"), point).mean() < 0.05


@pytest.mark.parametrize(("triplet", "curvature"), [("Fx FD MB", 0.2), ("Fx Mx MB", 1.0)])
def test_contacts_near_the_plane_of_a_wire_are_found(rng, triplet, curvature):
    """Where a direction is hardly determined, steps along it must not leave the right cell."""
    contact_map = vb.ContactMap.simulate(_wire(curvature), grid=False)
    charted = rng.uniform([0.1, -0.1, 0.2], [0.9, 0.1, 0.9], (400, 3))
    charted[::2, 1] += np.pi
    signals, point = _signals_of_contacts(contact_map, charted)
    assert _misses(contact_map.estimate(signals, triplet), point).mean() < 0.01


def _share_found(contact_map, triplet, charted):
    """Share of contacts (n, 3), given by η, ψ and log ρ, that are found from exact signals."""
    chart = contact_map.chart
    charted[:, 2] = 10.0 ** charted[:, 2]  # 10⁻⁶ to 10⁻² of the force that slips off
    contacts = contacts_at(chart.fold, charted)
    values, _ = solve_forces(chart.discretization, np.insert(contacts, 1, 0.0, axis=1))
    signals = signals_of(values[:, :3], np.cross(values[:, 3:], values[:, :3]))
    aims = np.ascontiguousarray(signals[:, [SIGNALS.index(name) for name in triplet]])
    found = invert(chart, contact_map.tree(triplet), triplet, aims)
    away = np.abs(found.contacts - contacts[:, None])
    away[..., 1:] /= np.linalg.norm(contacts[:, None, 1:], axis=-1, keepdims=True)
    away = away.max(axis=-1)
    return (np.nanmin(np.where(np.isnan(away), 1.0, away), axis=1) < 1e-4).mean()


def test_cells_in_which_a_force_vanishes_are_told_apart_by_its_lever(gamma_map, rng):
    """Its moment about the axis vanishes there as well, so that dozens of cells have both."""
    names, chart = ("FT", "FD", "Mx"), gamma_map.chart
    tree = gamma_map.tree(names)
    without = tree._replace(vector=tree.vector._replace(lever=np.empty((0, 4))))
    charted = rng.uniform([0.0, 0.0, 0.1], [1.0, 2.0 * np.pi, 0.99], (500, 3))
    values, _ = solve_forces(
        chart.discretization, with_normal_force(contacts_at(chart.fold, charted))
    )
    signals = signals_of(values[:, :3], np.cross(values[:, 3:], values[:, :3]))
    aims = np.ascontiguousarray(signals[:, [SIGNALS.index(name) for name in names]])
    found, expected = (invert(chart, each, names, aims) for each in (tree, without))
    np.testing.assert_array_equal(found.number, expected.number)
    np.testing.assert_allclose(found.values, expected.values, rtol=1e-9, atol=1e-9)
    room = seed_room.py_func()
    started, before = (sum(seeds(each, aim, room) for aim in aims) for each in (tree, without))
    assert started < 0.7 * before


@pytest.mark.parametrize("cells", [8, (8, 16), None, (8.0, 16.0, 8.0), (8, 0, 8)])
def test_cells_are_three_whole_numbers(cells):
    with pytest.raises(ValueError, match="three whole numbers"):
        vb.ContactMap.simulate(vb.samples.gamma(), grid=False, cells=cells)


def test_a_coarse_map_states_which_signals_determine_contacts():
    """It has fewer contacts than are tried by default."""
    coarse = vb.ContactMap.simulate(vb.samples.gamma(), grid=False, cells=(4, 8, 4))
    assert coarse.determines(("Fx", "MB", "MD"))
