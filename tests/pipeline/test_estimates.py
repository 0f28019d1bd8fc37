"""Estimates are as good as their noise says, whatever the signals and wherever they come from."""

from contextlib import nullcontext

import numpy as np
import pytest
import xarray as xr

from vibrissa import ContactMap, PointContact, Whisker, deflect, samples
from vibrissa.contour import shape_from_dataset
from vibrissa.io import load_recording, save_recording
from vibrissa.objects import Peg, Sphere
from vibrissa.pipeline import (
    AGREES,
    STRONG,
    compare_contacts,
    compare_shapes,
    distances_by_class,
    estimates_of,
    fit_contacts,
    locate,
    placed_by,
    reconstruct,
    signals_of,
    whisker_radii,
    with_contour,
    with_estimates,
    with_group,
    with_signals,
)
from vibrissa.pipeline.location import without_contact
from vibrissa.pipeline.reconstruction import frames_together
from vibrissa.recording import Recording, recorded
from vibrissa.sensors import component_noise
from vibrissa.simulation import facing_peg, measure, simulate, sweep_past
from vibrissa.status import Status

ALL = "Fx FT FD Mx MB MD"


def spread(error, covariance, axes=3):
    """Robust standard deviation of errors along the longest axes of their covariance, over its own.

    It is 1 where the covariance is right.
    """
    size, along = np.linalg.eigh(covariance)
    z = np.einsum("tji,tj->ti", along, error)[:, -axes:] / np.sqrt(size[:, -axes:])
    return np.median(np.abs(z)) / 0.6745


def errors(estimates, trial):
    """Errors of points in both frames, where the whisker is bent enough for derivatives to hold."""
    truth = trial["truth"].to_dataset().isel(whisker=0)
    one = estimates.isel(whisker=0)
    strong = np.linalg.norm(truth["moment"].values, axis=1) > 1e-6
    rows = np.flatnonzero(one["in_contact"].values & strong & (one["candidates"].values > 0))
    return truth.isel(time=rows), one.isel(time=rows)


@pytest.fixture(scope="module")
def felt(trial):
    return with_signals(trial)


@pytest.mark.parametrize("signals", ["Fx MB MD", "Fx FT MB MD", ALL, "wrench"])
def test_a_sensor_finds_contacts_as_its_noise_allows(felt, trial, contact_map, signals):
    estimates = estimates_of(felt, signals, contact_maps=[contact_map])
    truth, one = errors(estimates, trial)
    assert one.sizes["time"] > 30
    away = one["contact_point"].values - truth["contact_point"].values
    assert 0.75 < spread(away, one["contact_covariance"].values) < 1.35
    local = one["contact_point_whisker"].values - truth["contact_point_whisker"].values
    assert 0.75 < spread(local, one["covariance"].values) < 1.35
    normal = one["contact_normal"].values - truth["surface_normal"].values
    assert 0.75 < spread(normal, one["normal_covariance"].values, 2) < 1.35
    assert estimates.attrs["signals"] == " ".join(signals.split())


@pytest.mark.parametrize("signals", ["Fx MB MD", "Fx FT MB MD"])
def test_covariances_are_the_same_in_both_frames(felt, trial, contact_map, signals):
    """Also of light contacts, for which those of first order are too narrow, or without end."""
    one = estimates_of(felt, signals, contact_maps=[contact_map]).isel(whisker=0)
    rotation = trial["base_rotation"].values[:, 0]
    turned = rotation @ one["covariance"].values @ np.swapaxes(rotation, 1, 2)
    known = np.isfinite(turned).all(axis=(1, 2))
    light = known & (np.linalg.norm(trial["moment"].values[:, 0], axis=1) < 1e-6)
    assert 5 < light.sum() < known.sum()
    here = one["contact_covariance"].values
    scale = np.trace(turned[known], axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(here[known] / scale, turned[known] / scale, atol=1e-6)
    both = one["point_normal_covariance"].values
    joint = np.block([[here, both], [np.swapaxes(both, 1, 2), one["normal_covariance"].values]])
    least = np.linalg.eigvalsh(joint[known])
    assert (least[:, 0] > -1e-9 * least[:, -1]).all()


@pytest.mark.parametrize("first", range(0, 50, 10))
def test_a_peg_is_found_by_few_contacts_as_they_say(felt, trial, contact_map, first):
    """Light ones among them: their narrow covariances would move the peg by tens of its sigma."""
    estimates = estimates_of(felt, contact_maps=[contact_map])
    touched = np.flatnonzero(np.isfinite(estimates["contact_point"].values).all(axis=(1, 2)))
    few = estimates.isel(time=touched[first : first + 16])
    fit = fit_contacts(few, Recording(trial).whiskers, "cylinder")
    assert fit.misfit < 3.0
    assert abs(fit.radius - 1.35e-3) < 4.0 * np.sqrt(fit.covariance[-1, -1])


def test_point_and_normal_err_together_as_they_say(felt, trial, contact_map):
    """Half a diameter back along the normal the axis is found: its error needs all covariances."""
    truth, one = errors(estimates_of(felt, contact_maps=[contact_map]), trial)
    r = 5e-3
    away = one["contact_point"] - truth["contact_point"]
    turned = one["contact_normal"] - truth["surface_normal"]
    error = away.values - r * turned.values
    cross = one["point_normal_covariance"].values
    total = one["contact_covariance"].values + r**2 * one["normal_covariance"].values
    total = total - r * (cross + np.swapaxes(cross, 1, 2))
    assert 0.75 < spread(error, total) < 1.35


def test_the_contact_point_comes_back_the_papers_way(tracked, trial, contact_map):
    """Its signals know the point, so it comes back, and with it its covariance."""
    signals = with_signals(tracked, "contact point", None)
    estimates = estimates_of(signals, contact_maps=[contact_map])
    there = estimates["in_contact"].values[:, 0] & (estimates["candidates"].values[:, 0] == 1)
    assert there.sum() > 40
    np.testing.assert_allclose(
        estimates["contact_point"].values[there], tracked["contact_point"].values[there], atol=1e-7
    )
    got = estimates["contact_covariance"].values[there]
    expected = tracked["contact_covariance"].values[there]
    np.testing.assert_allclose(got, expected, atol=1e-3 * expected.max())
    truth = trial["truth"].to_dataset().isel(whisker=0, time=there)
    normal = estimates["contact_normal"].values[there, 0] - truth["surface_normal"].values
    assert 0.7 < spread(normal, estimates["normal_covariance"].values[there, 0], 2) < 1.4


def test_errors_of_the_pose_count(tracked, trial, contact_map):
    placed = with_group(tracked, "signals", placed_by(signals_of(trial), tracked))
    sharp = component_noise(1e-9, 1e-11)
    estimates = estimates_of(placed, noise=sharp, contact_maps=[contact_map])
    _, one = errors(estimates, trial)
    # The sensor in the recording has more noise than is said here; the pose makes up for some.
    honest = estimates_of(placed, contact_maps=[contact_map])
    truth, other = errors(honest, trial)
    pose = np.trace(one["contact_covariance"].values, axis1=1, axis2=2)
    arm = np.linalg.norm(one["contact_point_whisker"].values, axis=1)
    np.testing.assert_allclose(pose, 3 * (8e-6) ** 2 + 2 * (arm * 1e-3) ** 2, rtol=0.01)
    np.testing.assert_allclose(
        np.trace(one["normal_covariance"].values, axis1=1, axis2=2), 2e-6, rtol=0.1
    )
    away = other["contact_point"].values - truth["contact_point"].values
    assert 0.75 < spread(away, other["contact_covariance"].values) < 1.35


def test_the_rod_knows_what_pose_and_wrench_have_in_common(tracked, trial, contact_map):
    """If pose and wrench always err so that they cancel, the contact point is exact."""
    data = signals_of(trial).drop_attrs().assign_attrs(source="rod")
    n = data.sizes["time"]
    wrench = np.tile(component_noise(1e-6, 2e-8), (n, 1, 1, 1))
    pose = np.tile(np.diag(np.repeat([1e-10, 1e-6], 3)), (n, 1, 1, 1))
    data["wrench_covariance"] = (("time", "whisker", "component", "component_"), wrench)
    apart = data.assign(pose_covariance=(("time", "whisker", "pose", "pose_"), pose))
    alone = estimates_of(with_group(trial, "signals", data), contact_maps=[contact_map])
    both = estimates_of(with_group(trial, "signals", apart), contact_maps=[contact_map])
    tied = apart.assign(
        pose_wrench_covariance=(
            ("time", "whisker", "pose", "component_"),
            1e-3 * np.sqrt(np.einsum("twii,twjj->twij", pose, wrench)),
        )
    )
    other = estimates_of(with_group(trial, "signals", tied), contact_maps=[contact_map])
    felt = alone["in_contact"].values[:, 0] & (alone["candidates"].values[:, 0] == 1)
    sizes = [
        np.trace(e["contact_covariance"].values[felt, 0], axis1=1, axis2=2) for e in (alone, both)
    ]
    assert (sizes[1] > sizes[0]).all()
    change = other["contact_covariance"].values[felt] - both["contact_covariance"].values[felt]
    assert np.abs(change).max() > 0
    np.testing.assert_allclose(change, np.swapaxes(change, -1, -2), atol=1e-20)


def test_a_map_of_another_whisker_is_noted(tracked):
    other = ContactMap.simulate(samples.curved(), grid=False, cells=(8, 16, 8))
    with pytest.warns(UserWarning, match="map's whisker differs from the recording's"):
        estimates_of(with_signals(tracked), contact_maps=[other])


def test_frames_keep_why_they_have_no_signals(tracked, contact_map):
    data = tracked.copy()
    point = tracked["contact_point"].values.copy()
    row = int(np.flatnonzero(tracked["in_contact"].values[:, 0])[0])
    point[row, 0] += [0.0, 0.0, 0.05]
    dims = tracked["contact_point"].dims
    data.dataset = tracked.to_dataset().assign(contact_point=(dims, point))
    estimates = estimates_of(with_signals(data), contact_maps=[contact_map])
    assert estimates["status"].values[row, 0] in (Status.BEYOND_FOLD, Status.BEYOND_TIP)
    assert np.isnan(estimates["contact_point"].values[row]).all()


def test_a_peg_is_found_from_a_recording_alone(quiet):
    told = []
    done = with_contour(quiet, progress=lambda *step: told.append(step))
    contour = done["contour"].to_dataset()
    assert {stage for stage, *_ in told} == {"map of all contacts", "contact points"}
    assert np.linalg.norm(contour["axis_offset"]) < 1e-7
    assert float(contour["axis_tilt"]) < 1e-5
    assert abs(float(contour["diameter_error"])) < 1e-7
    felt = done["estimates"]["in_contact"].values
    assert (contour["inlier"].values <= felt).all()
    assert contour["inlier"].values.sum() > 0.9 * felt.sum()
    assert np.nanmedian(np.abs(contour["object_distance"].values[felt])) < 1e-8
    np.testing.assert_array_equal(done["force"], quiet["force"])
    assert set(quiet.children) == set(done.children) - {"signals", "estimates", "contour"}


@pytest.mark.parametrize(
    "shape",
    ["free", "plane", pytest.param("sphere", marks=pytest.mark.slow)],
)
def test_other_shapes_are_fitted_and_come_back_from_a_file(quiet, tmp_path, shape):
    said = pytest.warns(UserWarning, match=f"do not fit the shape '{shape}'")
    with nullcontext() if shape == "free" else said:
        done = with_contour(quiet, shape)
    save_recording(tmp_path / "t.nc", done)
    contour = load_recording(tmp_path / "t.nc")["contour"].to_dataset()
    fit = shape_from_dataset(contour)
    assert fit.kind == shape == contour.attrs["shape"]
    points = done["estimates"]["contact_point"].values[:, 0]
    radius = whisker_radii(done["estimates"].to_dataset(), [Recording(done).whisker()])[:, 0]
    there = contour["inlier"].values[:, 0]
    np.testing.assert_allclose(
        fit.signed_distance(points[there]) - radius[there],
        contour["surface_distance"].values[there, 0],
        atol=1e-9,
    )
    # A free surface is one of a peg too; a sphere and a plane are not.
    median = np.nanmedian(np.abs(contour["surface_distance"]))
    assert (median < 1e-5) == (shape == "free")
    assert np.nanmedian(np.abs(contour["object_distance"])) < 1e-8


def test_a_peg_is_found_with_noise(trial):
    done = with_contour(trial)
    contour = done["contour"].to_dataset()
    for name in ("surface_distance", "inlier", "chi_squared", "object_distance"):
        np.testing.assert_array_equal(Recording(done)["contour"][name], contour[name])
    assert np.linalg.norm(contour["axis_offset"]) < 0.2e-3
    sigma = np.sqrt(np.diag(contour["parameter_covariance"]))
    assert (np.abs(contour["axis_offset"].values[:2]) < 5 * sigma[:2]).all()


def scores(contour, peg):
    """Errors of a fitted peg in standard deviations: axis (2), direction (2) and radius."""
    covariance = contour["parameter_covariance"].values
    axis, origin = contour["object_axis"].values, contour["object_position"].values
    true = peg.axis * np.sign(axis @ peg.axis)
    across = np.linalg.svd(true[None])[2][1:]
    errors = np.concatenate(
        [
            across @ (origin - peg.origin),
            across @ (axis - true),
            [contour["object_radius"] - peg.radius],
        ]
    )
    by = np.zeros((5, 7))
    by[:2, :3] = by[2:4, 3:6] = across
    by[4, 6] = 1.0
    spread = by @ covariance @ by.T
    parts = slice(0, 2), slice(2, 4), slice(4, 5)
    squares = [errors[p] @ np.linalg.solve(spread[p, p], errors[p]) for p in parts]
    return np.sqrt(np.divide(squares, (2, 2, 1)))


def rubbing_peg(friction):
    """A peg and the signals of a whisker that rubs along it."""
    whisker = Whisker.straight(45e-3, base_radius=77e-6, tip_radius=9e-6, youngs_modulus=3.3e9)
    axis = np.array([0.15, 0.2, 1.0])
    peg = Peg(facing_peg(whisker, 0.5, 1.2e-3).origin, axis / np.linalg.norm(axis), 1.2e-3)
    moved = sweep_past(whisker, peg, 0.25, 300.0, row="A", seed=2)
    return peg, with_signals(measure(simulate(whisker, moved, peg, friction=friction), seed=3))


def test_weak_friction_is_that_of_all_frames():
    """Most frames would deny it if each decided for itself, and move the peg."""
    peg, rubbed = rubbing_peg(0.05)
    felt = with_estimates(rubbed, "Fx FT FD Mx MB MD", friction=0.3)
    assert (felt["estimates"]["friction_angle"] != 0.0).all()
    done = with_contour(felt)["contour"].to_dataset()
    assert (scores(done, peg) < 3.0).all()
    assert np.linalg.norm(done["axis_offset"]) < 0.05e-3


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.3])
def test_a_peg_that_rubs_is_as_near_as_stated(friction):
    """Friction across the whisker turns the forces of all contacts alike."""
    peg, rubbed = rubbing_peg(friction)
    felt = with_estimates(rubbed, "wrench")
    done = with_contour(felt)["contour"].to_dataset()
    assert (scores(done, peg) < 3.0).all()
    assert np.linalg.norm(done["axis_offset"]) < 0.05e-3
    said = pytest.warns(UserWarning, match="do not fit the shape 'cylinder'")
    with said if friction > 0.2 else nullcontext():
        exact = with_contour(felt, lean=0.0)["contour"].to_dataset()
    assert (scores(exact, peg)[1] > 10.0) == (friction > 0.0)
    with pytest.raises(ValueError, match="lean"):
        with_contour(felt, lean=-0.1)
    # Three signals and the assumption of friction: normals are as uncertain as the points.
    truth = rubbed["truth"].to_dataset().isel(whisker=0)
    found = with_estimates(rubbed, friction=0.3)["estimates"].to_dataset().isel(whisker=0)
    along = found["contact_tangent"].values
    away = np.einsum("ti,ti->t", truth["surface_normal"].values, along)
    spread = np.einsum("ti,tij,tj->t", along, found["normal_covariance"].values, along)
    assert np.nanmedian(np.abs(away) / np.sqrt(spread)) < 1.5


def test_what_is_below_the_noise_is_not_felt_and_what_is_zero_is_no_contact(
    felt, quiet, tracked, contact_map
):
    estimates = estimates_of(felt, contact_maps=[contact_map])
    for data in (felt["signals"].to_dataset(), estimates):
        missed = ~data["in_contact"].values
        assert missed.any()
        assert (data["status"].values[missed] == Status.NOT_FELT).all()
    truly = quiet["truth"]["in_contact"].values.astype(bool)
    signals = signals_of(quiet)
    assert (signals["status"].values[~truly] == Status.NO_CONTACT).all()
    # Of a whisker that is seen to touch, but so lightly that its signals are within their noise.
    seen = with_signals(tracked, "contact point")
    loud = component_noise(1e-6, 0.5e-6)
    estimates = estimates_of(seen, contact_maps=[contact_map], noise=loud)
    touching = seen["signals"]["in_contact"].values.astype(bool)
    light = touching & ~estimates["in_contact"].values
    assert light.any()
    assert (estimates["status"].values[light] == Status.NOT_FELT).all()
    assert (estimates["status"].values[~touching] == Status.NO_CONTACT).all()


def test_shapes_are_told_apart(felt, contact_map):
    whiskers = [contact_map.whisker]
    felt = estimates_of(felt, contact_maps=[contact_map])
    found = compare_shapes(felt, whiskers)
    assert found["evidence"].sel(shape="cylinder") == 0.0
    assert found["misfit"].sel(shape="cylinder") < AGREES
    for other in ("sphere", "plane"):
        assert found["evidence"].sel(shape=other) > 10.0 * STRONG
        assert found["misfit"].sel(shape=other) > 100.0
    unknown = felt.assign(contact_covariance=felt["contact_covariance"] * np.nan)
    assert compare_shapes(unknown, whiskers)["evidence"].isnull().all()
    with pytest.raises(ValueError, match="have no covariance"):
        fit_contacts(unknown, whiskers, lean=0.1)
    # Normals that were moved by their errors are no longer of unit length.
    moved = felt.assign(contact_normal=1.001 * felt["contact_normal"])
    leaning, same = (fit_contacts(one, whiskers, lean=0.1) for one in (moved, felt))
    np.testing.assert_allclose(leaning.origin, same.origin, atol=1e-3 * same.origin_sigma.min())


def test_what_stages_add_is_kept_in_a_file(trial, tmp_path):
    done = with_contour(trial, axis=[0, 0, 1.0])
    save_recording(tmp_path / "t.nc", done)
    xr.testing.assert_identical(load_recording(tmp_path / "t.nc"), done)
    again = with_estimates(load_recording(tmp_path / "t.nc"), "Fx FT MB MD")
    assert "contour" not in again.children
    assert again["signals"].attrs["source"] == "sensor"


def test_frames_that_err_together_are_counted():
    generator = np.random.default_rng(0)
    white = generator.normal(size=(2000, 2))
    assert frames_together(white) == pytest.approx(1.0, abs=0.1)
    red = np.empty_like(white)
    red[0] = white[0]
    for i in range(1, len(red)):
        red[i] = 0.8 * red[i - 1] + white[i]
    # (1 + a) / (1 − a) for a first-order process.
    assert frames_together(red) == pytest.approx(9.0, rel=0.2)
    gaps = red.copy()
    gaps[::7] = np.nan
    assert frames_together(gaps) == pytest.approx(9.0, rel=0.25)
    assert frames_together(np.full((5, 1), np.nan)) == 1.0


def test_where_nothing_is_felt_no_map_is_needed(trial, contact_map):
    free = ~trial["truth"]["in_contact"].values[:, 0]
    wrench = trial.to_dataset().isel(whisker=0, time=free)[["force", "moment"]]
    noise = component_noise(1e-6, 0.02e-6)
    without = without_contact(contact_map.whisker, wrench, noise=noise)
    found = locate(contact_map, wrench, noise=noise)
    assert without is not None
    for name in ("contact_point_whisker", "covariance", "arc_length", "status", "in_contact"):
        xr.testing.assert_identical(without[name], found[name])
    assert without.attrs == found.attrs
    felt = trial.to_dataset().isel(whisker=0)[["force", "moment"]]
    assert without_contact(contact_map.whisker, felt, noise=noise) is None
    zeros = without_contact(contact_map.whisker, 0.0 * wrench, noise=noise)
    assert zeros is not None
    assert zeros.attrs["felt_above"] == found.attrs["felt_above"] > 0.0


def test_two_whiskers_touch_one_peg(quiet):
    trial = quiet
    two = xr.DataTree.from_dict(
        {
            "/": xr.concat([trial.to_dataset()] * 2, "whisker").assign_coords(whisker=["a", "b"]),
            **{
                f"/whiskers/{k}": trial["whiskers/0"]
                .to_dataset(inherit=False)
                .assign_attrs(recorded_as=name)
                for k, name in enumerate("ab")
            },
        }
    )
    done = with_estimates(two)
    alone = with_estimates(trial)
    for k in range(2):
        np.testing.assert_array_equal(
            done["estimates"]["contact_point"].values[:, k],
            alone["estimates"]["contact_point"].values[:, 0],
        )
    contour = reconstruct(done, objects=Recording(trial).pegs)
    assert contour["inlier"].shape == (trial.sizes["time"], 2)
    one = reconstruct(alone, objects=Recording(trial).pegs)
    np.testing.assert_allclose(contour["object_radius"], one["object_radius"], atol=1e-6)
    assert "object_distance" not in reconstruct(done)
    # Half the variance of independent contacts; their residuals here are the solver's rounding.
    one_variance, variance = (
        np.diag(each["parameter_covariance"])[6] / each.attrs["frames_together"]
        for each in (one, contour)
    )
    assert one_variance / variance == pytest.approx(2.0, rel=0.05)


def test_what_cannot_be_done_is_said(trial, felt, contact_map):
    with pytest.raises(ValueError, match="no group signals"):
        estimates_of(trial)
    with pytest.raises(ValueError, match="no group estimates"):
        reconstruct(felt)
    with pytest.raises(ValueError, match="different signals"):
        estimates_of(felt, "Fx MB")
    with pytest.raises(ValueError, match="noise has shape"):
        estimates_of(felt, noise=np.eye(3), contact_maps=[contact_map])
    with pytest.raises(ValueError, match="signals of 1 whiskers; 2 are given"):
        estimates_of(felt, contact_maps=[contact_map] * 2)
    with pytest.raises(ValueError, match="'cube'; one of cylinder, sphere, plane, free"):
        reconstruct(felt, "cube")
    unknown = trial.copy()
    root = trial.to_dataset()
    unknown.dataset = root.assign({name: root[name].drop_attrs() for name in ("force", "moment")})
    with pytest.raises(ValueError, match="noise is not known"):
        with_estimates(unknown, contact_maps=[contact_map])
    few = with_estimates(trial.isel(time=slice(0, 5)), contact_maps=[contact_map])
    with pytest.raises(ValueError, match=r"no cylinder.*contacts were estimated in \d of 5 frames"):
        reconstruct(few)
    nowhere = trial.copy()
    nowhere.dataset = root.assign(base_position=np.nan * root["base_position"])
    with pytest.raises(ValueError, match="frames: The pose of the base is not known"):
        reconstruct(with_estimates(with_signals(nowhere, "sensor"), contact_maps=[contact_map]))
    with pytest.raises(ValueError, match="frames and whiskers"):
        with_group(trial, "signals", felt["signals"].to_dataset().isel(time=slice(5)))
    with pytest.raises(ValueError, match="one of signals, estimates, contour"):
        with_group(trial, "other", felt["signals"].to_dataset())


def test_without_noise_there_is_no_covariance_but_a_fit(trial):
    """Signals of the contact point whose covariance nobody knows."""
    data = signals_of(trial).drop_attrs().assign_attrs(source="contact point")
    done = with_estimates(with_group(trial, "signals", data))
    assert np.isnan(done["estimates"]["contact_covariance"].values).all()
    assert Recording(done).whisker().length == pytest.approx(40e-3)
    contour = reconstruct(done)
    assert float(contour["object_radius"]) > 0


@pytest.mark.parametrize("of_pose", [False, True])
def test_an_error_that_all_contacts_share_is_in_the_covariance_of_the_object(trial, of_pose):
    """Of tracked contacts that of the traces; of a sensor's that of the pose that places them."""
    done = with_estimates(trial)
    shift = np.array([20e-6, -10e-6, 5e-6])
    errors = {"contact_shared": shift}
    if of_pose:
        errors = {"contact_shared": 3.0 * shift, "pose_shared": np.append(shift, np.zeros(3))}
    each = (trial.sizes["time"], 1, 1)
    known = done.copy()
    known.dataset = done.to_dataset().assign(
        {name: recorded(name, np.tile(error, (*each, 1))) for name, error in errors.items()}
    )
    more, less = (reconstruct(one)["parameter_covariance"].values for one in (known, done))
    # Contacts that are all shifted shift the object with them, and change nothing else of it.
    expected = np.zeros((7, 7))
    expected[:3, :3] = np.outer(shift, shift)
    sigma = np.sqrt(np.diag(more))
    assert (np.abs(more - less - expected) <= 1e-3 * np.outer(sigma, sigma)).all()


def test_a_pose_that_is_turned_in_all_frames_turns_the_object_of_a_sensor(trial):
    """A turn of the laboratory about the peg's own axis: the peg moves with the base, not else."""
    done = with_estimates(trial)
    turn = np.array([0.0, 0.0, 1e-3])
    shared = np.tile(np.append(np.zeros(3), turn), (trial.sizes["time"], 1, 1, 1))
    errors = {"pose_shared": shared, "contact_shared": 0.0 * shared[..., :3]}
    known = done.copy()
    known.dataset = done.to_dataset().assign({n: recorded(n, v) for n, v in errors.items()})
    more, less = (reconstruct(one) for one in (known, done))
    added = more["parameter_covariance"].values - less["parameter_covariance"].values
    base = done["base_position"].values[:, 0].mean(axis=0)
    moved = np.cross(turn, less["object_position"].values - base)
    sigma = np.sqrt(np.diag(added)[:2])
    np.testing.assert_allclose(sigma, np.abs(moved[:2]), atol=0.1 * np.linalg.norm(moved))


def test_contacts_are_as_far_from_the_known_object_as_predicted(trial):
    done = with_estimates(trial)
    other = Sphere([0.1, 0.1, 0.1], 1e-3)
    compared = compare_contacts(done, [other, *Recording(trial).pegs])
    assert compared.attrs["object"] == 1
    there = done["estimates"]["candidates"].values > 0
    assert (np.isfinite(compared["surface_distance"].values) == there).all()
    tables = distances_by_class(compared)
    assert set(tables) == {"deflection_angle", "r", "MB"}
    by_moment = tables["MB"]
    assert int(by_moment["contacts"].sum()) == there.sum()
    # The more is felt the less it errs, and as the covariance says.
    median = by_moment["median"].values
    assert median[-1] < 0.3 * median[0]
    assert 0.5 < np.median(median / by_moment["median_predicted"].values) < 2.0
    with pytest.raises(ValueError, match="no object is known"):
        compare_contacts(done, [])
    nothing = with_group(done, "estimates", done["estimates"].to_dataset() * np.nan)
    with pytest.raises(ValueError, match="no contacts"):
        compare_contacts(nothing)


@pytest.mark.slow
def test_an_unknown_length_of_the_whisker_is_in_contacts_by_a_sensor(trial, quiet, contact_map):
    """Forces of a whisker that is 1 % longer than it is taken to be move contacts as stated."""
    truth = quiet["truth"].to_dataset().isel(whisker=0)
    whisker = contact_map.whisker
    rows = np.flatnonzero(np.linalg.norm(truth["moment"].values, axis=1) > 1e-6)
    longer = whisker.with_properties(radius=lambda s: whisker.radius(s / 1.01))
    at = PointContact(truth["contact_point_whisker"].values[rows])
    more, same = (deflect(one, at) for one in (longer, whisker))
    shared = np.zeros((truth.sizes["time"], 1, 1, 6))
    for k, name in enumerate(("force", "moment")):
        change = getattr(more, name) - getattr(same, name)
        shared[rows, 0, 0, 3 * k : 3 * k + 3] = change
    known = with_signals(trial)
    pushed = known["signals"].to_dataset()
    for k, name in enumerate(("force", "moment")):
        pushed[name] = pushed[name] + shared[:, :, 0, 3 * k : 3 * k + 3]
    none = np.zeros((*shared.shape[:3], 6))
    zero = {"contact_shared": none[..., :3], "pose_shared": none, "wrench_shared": shared}
    known.dataset = trial.to_dataset().assign({n: recorded(n, v) for n, v in zero.items()})
    before = estimates_of(known, contact_maps=[contact_map])
    known["signals"] = xr.DataTree(pushed)
    after = estimates_of(known, contact_maps=[contact_map])
    moved = (after["contact_point"] - before["contact_point"]).values[rows, 0]
    stated = before["contact_shared"].values[rows, 0, 0]
    fine = np.isfinite(moved).all(axis=1) & np.isfinite(stated).all(axis=1)
    assert fine.sum() > 20
    error = np.linalg.norm(moved + stated, axis=1)[fine]
    assert np.median(error / np.linalg.norm(moved, axis=1)[fine]) < 0.1
    # It is in the covariance of contacts and, as one error of all of them, in that of the object.
    plain = with_estimates(trial, contact_maps=[contact_map])
    more = before["contact_covariance"] - plain["estimates"]["contact_covariance"]
    np.testing.assert_allclose(
        more.values[rows, 0][fine], stated[fine, :, None] * stated[fine, None], atol=1e-12
    )
    alone = before.drop_vars("contact_shared")
    aside = alone.assign(contact_point=before["contact_point"] + before["contact_shared"][:, :, 0])
    wider, less, other = (
        reconstruct(with_group(known, "estimates", one)) for one in (before, alone, aside)
    )
    added = wider["parameter_covariance"].values - less["parameter_covariance"].values
    apart = float(other["object_radius"] - less["object_radius"])
    assert abs(apart) > 5e-6
    assert added[6, 6] == pytest.approx(apart**2, rel=1e-2)
