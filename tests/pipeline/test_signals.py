"""Signals of a recording are those of the truth, as far as their source knows it."""

import numpy as np
import pytest
import xarray as xr

from vibrissa.pipeline import (
    default_source,
    estimates_of,
    placed_by,
    sensor_noise,
    signals_of,
    with_signals,
    without_faulty_stages,
)
from vibrissa.sensors import Sensor
from vibrissa.signals import SIGNALS, base_signals
from vibrissa.simulation import measure
from vibrissa.status import Status
from vibrissa.tracking import low_pass


def exact(tracked, trial):
    """Contact point and pose as they truly are."""
    root = tracked.to_dataset()
    pose = trial.to_dataset()[["base_position", "base_rotation"]]
    point = trial["truth"].to_dataset()["contact_point"]
    out = tracked.copy()
    out.dataset = root.assign(contact_point=point, **pose)
    return out


def test_a_sensor_is_taken_as_it_reads(trial):
    signals = signals_of(trial)
    assert signals.attrs["source"] == "sensor"
    np.testing.assert_array_equal(signals["force"], trial["force"])
    six = base_signals(trial["force"], trial["moment"])
    for name in SIGNALS:
        np.testing.assert_array_equal(signals[name], six[name])
    np.testing.assert_allclose(
        np.sqrt(np.diag(sensor_noise(signals))), np.repeat([1e-6, 2e-8], 3), rtol=1e-12
    )
    truth = trial["truth"]["in_contact"].values
    assert (signals["in_contact"].values <= truth).all()
    assert signals["in_contact"].values.sum() > 0.9 * truth.sum()


@pytest.mark.parametrize("noise", [-1e-6, "1 µN", [1e-6] * 4, [1e-6, -1e-6, 1e-6]])
def test_noise_that_is_none_is_refused(trial, noise):
    data = trial.to_dataset()
    edited = trial.copy()
    edited.dataset = data.assign(force=data["force"].assign_attrs(noise=noise))
    with pytest.raises(ValueError, match="the noise of force is"):
        signals_of(edited)


def test_infinite_forces_are_missing(trial):
    data = trial.to_dataset()
    force = data["force"].values.copy()
    force[3, 0], force[4, 0, 1] = [np.inf, -np.inf, 0.0], np.inf
    edited = trial.copy()
    edited.dataset = data.assign(force=data["force"].copy(data=force))
    signals = signals_of(edited)
    assert (signals["status"].values[3:5, 0] == Status.MISSING).all()
    assert np.isnan(signals["FT"].values[3:5, 0]).all()


def test_channels_that_tell_all_are_brought_back_to_force_and_moment(trial):
    generator = np.random.default_rng(1)
    mixing = generator.normal(size=(8, 6)) * np.repeat([1.0, 50.0], 3)
    sensor = Sensor([f"gauge {i}" for i in range(8)], mixing, noise=1e-6)
    signals = signals_of(measure(trial, sensor=sensor, seed=4))
    assert signals.attrs["source"] == "sensor"
    truth = trial["truth"].to_dataset()
    error = np.concatenate([signals[n].values - truth[n].values for n in ("force", "moment")], -1)
    covariance = sensor_noise(signals.isel(whisker=0))
    assert covariance.shape == (trial.sizes["time"], 6, 6)
    z = np.einsum("ti,tij,tj->t", error[:, 0], np.linalg.inv(covariance), error[:, 0])
    assert 5.4 < z.mean() < 6.6


def test_the_true_contact_point_gives_the_true_wrench(tracked, trial):
    signals = signals_of(exact(tracked, trial), "contact point", None)
    truth = trial["truth"].to_dataset()
    for name in ("force", "moment"):
        size = np.abs(truth[name].values).max()
        np.testing.assert_allclose(signals[name], truth[name], atol=1e-5 * size)
    np.testing.assert_array_equal(signals["status"], truth["status"])
    for name, variable in signals.data_vars.items():
        assert {"units", "long_name"} <= set(variable.attrs), name


def test_the_covariance_of_the_wrench_is_how_it_scatters(tracked, trial):
    signals = signals_of(tracked, "contact point", None)
    truth = trial["truth"].to_dataset()
    there = truth["in_contact"].values[:, 0] & (signals["status"].values[:, 0] == Status.OK)
    error = np.concatenate([signals[n].values - truth[n].values for n in ("force", "moment")], -1)
    covariance = sensor_noise(signals)[there, 0]
    assert there.sum() > 30
    z = error[there, 0] / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert 0.8 < np.sqrt(np.median(z**2) / 0.455) < 1.25


def test_points_that_are_out_of_reach_keep_their_frame(tracked, trial):
    data = exact(tracked, trial)
    point = data["contact_point"].values.copy()
    touching = np.flatnonzero(data["in_contact"].values[:, 0])
    point[touching[0], 0] += [0.0, 0.0, 0.05]
    point[touching[1], 0] = data["base_position"].values[touching[1], 0]
    point[touching[2], 0] = np.nan
    data.dataset = data.to_dataset().assign(contact_point=(("time", "whisker", "space"), point))
    signals = signals_of(data, "contact point", None)
    status = signals["status"].values[touching[:3], 0]
    assert set(status[:2]) <= {Status.BEYOND_TIP, Status.BEYOND_FOLD, Status.TOO_PROXIMAL}
    assert status[2] == Status.MISSING
    assert np.isnan(signals["force"].values[touching[:3], 0]).all()
    assert signals.sizes["time"] == trial.sizes["time"]


def test_frames_without_a_pose_are_missing(tracked):
    data = tracked.copy()
    rotation = tracked["base_rotation"].values.copy()
    rotation[5] = np.nan
    dims = tracked["base_rotation"].dims
    data.dataset = tracked.to_dataset().assign(base_rotation=(dims, rotation))
    signals = signals_of(data)
    assert signals["status"].values[5, 0] == Status.MISSING
    assert np.isnan(signals["Fx"].values[5, 0])
    assert not signals["in_contact"].values[5, 0]


@pytest.mark.parametrize("cutoff", [None, 20.0, 60.0])
def test_the_pose_is_filtered_as_asked(tracked, cutoff):
    signals = signals_of(tracked, "contact point", cutoff)
    expected = low_pass(tracked["base_position"].values[:, 0], 300.0, cutoff)
    np.testing.assert_allclose(signals["base_position"].values[:, 0], expected, atol=1e-12)
    turned = signals["base_rotation"].values[:, 0]
    np.testing.assert_allclose(
        turned @ np.swapaxes(turned, 1, 2), np.eye(3)[None] + 0 * turned, atol=1e-12
    )
    assert signals.attrs.get("cutoff") == cutoff


def test_frames_that_are_missing_are_stated(tracked):
    part = tracked.isel(time=np.r_[0:40, 90 : tracked.sizes["time"]])
    with pytest.warns(UserWarning, match="0.17 s in a row: the base pose is filtered in 2"):
        signals = signals_of(part, "contact point", 60.0)
    whole = signals_of(tracked, "contact point", 60.0).sel(time=part["time"])
    np.testing.assert_allclose(signals["base_position"], whole["base_position"], atol=3e-5)


def measured(tracked, unfiltered=True):
    """With the pose of before the rod was fitted in its group."""
    from vibrissa.tracking import BasePose
    from vibrissa.whisker import angles_of

    root = tracked.to_dataset()
    pose = BasePose(
        root["base_position"].values[:, 0], *angles_of(root["base_rotation"].values[:, 0]).T
    )
    smooth = pose.filtered(300.0, 85.0)
    data = {}
    for prefix, one in (("", smooth), *((("unfiltered_", pose),) if unfiltered else ())):
        data[f"{prefix}base_position"] = (("time", "whisker", "space"), one.position[:, None])
        for name, angle in (
            ("azimuth", one.azimuth),
            ("elevation", one.elevation),
            ("roll", one.roll),
        ):
            data[f"{prefix}base_{name}"] = (("time", "whisker"), angle[:, None])
    tree = tracked.copy()
    tree["measured"] = xr.DataTree(xr.Dataset(data, attrs={"cutoff": 85.0}))
    return tree


def test_another_cutoff_is_tried_on_the_unfiltered_pose(tracked):
    for cutoff in (85.0, 30.0):
        direct = signals_of(tracked, "contact point", cutoff)
        again = signals_of(measured(tracked), "contact point", cutoff)
        np.testing.assert_allclose(again["force"], direct["force"], rtol=1e-6, atol=1e-9)
    old = measured(tracked, unfiltered=False)
    np.testing.assert_allclose(
        signals_of(old, "contact point")["force"],
        signals_of(tracked, "contact point")["force"],
        rtol=1e-6,
        atol=1e-9,
    )
    with pytest.raises(ValueError, match="track the videos again"):
        signals_of(old, "contact point", 30.0)


def test_a_rod_is_no_sensor_and_a_sensor_no_rod(tracked, trial):
    rod = tracked.copy()
    truth = trial["truth"].to_dataset()
    n = tracked.sizes["time"]
    covariance = (("time", "whisker", "component", "component_"), np.tile(np.eye(6), (n, 1, 1, 1)))
    rod.dataset = tracked.to_dataset().assign(
        force=truth["force"], moment=truth["moment"], wrench_covariance=covariance
    )
    signals = signals_of(rod, "rod")
    np.testing.assert_array_equal(signals["in_contact"], truth["in_contact"])
    np.testing.assert_array_equal(signals["force"], truth["force"])
    assert sensor_noise(signals).shape == (n, 1, 6, 6)
    assert "pose_covariance" in signals
    assert default_source(rod) == "contact point"
    with pytest.raises(ValueError, match="source 'rod'"):
        signals_of(rod, "sensor")
    with pytest.raises(ValueError, match="wrench_covariance"):
        signals_of(trial, "rod")


def test_a_sensor_is_placed_by_what_a_camera_saw(tracked, trial):
    signals = signals_of(trial)
    renamed = tracked.copy()
    later = tracked.to_dataset().isel(time=slice(10, None, 2))
    renamed = xr.DataTree(later.assign_coords(whisker=["seen"], time=later["time"] + 1e-9))
    placed = placed_by(signals, renamed)
    assert list(placed["whisker"].values) == ["seen"]
    np.testing.assert_array_equal(placed["time"], renamed["time"])
    np.testing.assert_array_equal(placed["Fx"].values, signals["Fx"].values[10::2])
    np.testing.assert_array_equal(placed["base_position"], renamed["base_position"])
    assert "pose_covariance" in placed
    far = xr.DataTree(later.assign_coords(time=later["time"] + 10.0))
    nowhere = placed_by(signals, far)
    assert (nowhere["status"].values == Status.MISSING).all()
    assert not nowhere["in_contact"].values.any()
    assert nowhere["in_contact"].dtype == bool
    for shift in (-0.4 / 300, 0.4 / 300):
        near = xr.DataTree(later.assign_coords(time=later["time"] + shift))
        np.testing.assert_array_equal(placed_by(signals, near)["Fx"].values, placed["Fx"].values)
    with pytest.raises(ValueError, match="2 whiskers"):
        placed_by(xr.concat([signals, signals], "whisker"), tracked)


def test_a_fast_sensor_is_placed_in_little_memory(tracked, trial):
    """A table of all samples by all frames would have 10¹⁰ numbers."""
    felt = signals_of(trial)[["Fx", "status"]]
    pose = tracked.to_dataset()[["base_position", "base_rotation"]]
    times = [np.linspace(0.0, 1.0, count) for count in (200_000, 50_000)]
    signals, seen = (
        data.isel(time=np.zeros(time.size, dtype=int)).assign_coords(time=time)
        for data, time in zip((felt, pose), times, strict=True)
    )
    signals["Fx"] = signals["Fx"].copy(data=times[0][:, None])
    placed = placed_by(signals, xr.DataTree(seen))
    np.testing.assert_allclose(placed["Fx"].values[:, 0], times[1], rtol=0, atol=0.51 / 199_999)


def test_what_is_missing_is_said(tracked, trial):
    bare = xr.DataTree(trial.to_dataset()[["base_position"]])
    with pytest.raises(ValueError, match="force and moment, or contact_point"):
        signals_of(bare)
    with pytest.raises(ValueError, match="need contact_point"):
        signals_of(trial, "contact point")
    with pytest.raises(ValueError, match="'magic'; one of contact point, rod, sensor"):
        signals_of(trial, "magic")
    with pytest.raises(ValueError, match="lacks the dimensions time, whisker"):
        signals_of(xr.DataTree(xr.Dataset()))
    without = xr.DataTree.from_dict({"/": tracked.to_dataset()})
    with pytest.raises(ValueError, match="shapes of 0 whiskers"):
        with_signals(without)
    with pytest.raises(ValueError, match="below half of"):
        signals_of(tracked, "contact point", 200.0)
    with pytest.raises(ValueError, match="do not determine all six components"):
        signals_of(measure(trial, sensor=Sensor(("Fx", "My", "Mz"))))


def test_a_moving_head_takes_everything_along(tracked):
    """Seen from the head nothing changes, so the filter lets it pass unharmed."""
    from scipy.spatial.transform import Rotation

    root = tracked.to_dataset()
    n = root.sizes["time"]
    fast = 0.3 * np.sin(np.linspace(0.0, 60.0, n))
    turn = Rotation.from_rotvec(fast[:, None] * [0.2, -0.4, 0.9]).as_matrix()
    shift = np.stack([0.01 * fast, 0.02 * np.cos(fast), -0.01 * fast], axis=1)

    def moved(name):
        points = np.einsum("tij,twj->twi", turn, root[name].values)
        return root[name].dims, points + shift[:, None]

    rotation = np.einsum("tij,twjk->twik", turn, root["base_rotation"].values)
    square = np.einsum("tij,twjk,tlk->twil", turn, root["contact_covariance"].values, turn)
    other = root.assign(
        contact_point=moved("contact_point"),
        base_position=moved("base_position"),
        base_rotation=(root["base_rotation"].dims, rotation),
        contact_covariance=(root["contact_covariance"].dims, square),
        head_position=(("time", "space"), shift),
        head_rotation=(("time", "space", "head_axis"), turn),
    )
    tree = tracked.copy()
    tree.dataset = other
    still, moving = (signals_of(one, "contact point", 40.0) for one in (tracked, tree))
    for name in ("force", "moment"):
        size = np.nanmax(np.abs(still[name]))
        np.testing.assert_allclose(moving[name], still[name], atol=1e-7 * size)
    turned = np.einsum("tij,twjk->twik", turn, still["base_rotation"].values)
    np.testing.assert_allclose(moving["base_rotation"], turned, atol=1e-9)


def test_contact_points_from_a_table_count_more(tracked, trial):
    data = measured(tracked)
    n = data.sizes["time"]
    touching = np.flatnonzero(tracked["in_contact"].values[:, 0])
    point = np.full((n, 1, 3), np.nan)
    point[touching[:3]] = tracked["contact_point"].values[touching[:3]] + [2e-4, 0.0, 0.0]
    for source in ("table", "nearest to the object"):
        given = data.copy()
        about = {"source": source}
        given["measured"] = xr.DataTree(
            data["measured"]
            .to_dataset(inherit=False)
            .assign(contact_point=(("time", "whisker", "space"), point, about))
        )
        before, after = signals_of(data, cutoff=None), signals_of(given, cutoff=None)
        changed = np.flatnonzero((before["force"] != after["force"]).any(("whisker", "space")))
        assert changed.tolist() == (touching[:3].tolist() if source == "table" else [])
    unknown = np.isnan(signals_of(given, cutoff=None)["wrench_covariance"].values)
    assert not unknown[touching[3:]].any()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.assign(force=d["force"].isel(space=0, drop=True)), "force has the dim"),
        (
            lambda d: d.assign(base_rotation=2.0 * d["base_rotation"]),
            "is not a rotation",
        ),
        (lambda d: d.assign_coords(time=d["time"].values[::-1]), "its time does not increase"),
        (lambda d: d.assign_coords(time=d["time"] * np.nan), "its time does not increase"),
        (lambda d: d.assign(force=d["force"].astype(str)), "not numbers"),
        (lambda d: d.assign(base_position=1e3 * d["base_position"] + 1.0), "millimetres given"),
    ],
)
def test_recordings_from_elsewhere_are_checked(trial, change, said):
    truth = trial["truth"].to_dataset(inherit=False)
    tree = xr.DataTree.from_dict({"/": change(trial.to_dataset()), "/truth": truth})
    with pytest.raises(ValueError, match=said):
        signals_of(tree)


def test_a_centreline_in_millimetres_is_rejected(trial):
    tree = trial.copy()
    tree["truth"].dataset = (data := trial["truth"].to_dataset(inherit=False)).assign(
        centerline=1e3 * data["centerline"]
    )
    with pytest.raises(ValueError, match="1e\\+03 times as long as its whisker"):
        signals_of(tree)


def test_what_a_group_lacks_is_said(trial):
    tree = with_signals(trial)
    tree["signals"] = xr.DataTree(tree["signals"].to_dataset(inherit=False).drop_vars("moment"))
    with pytest.raises(ValueError, match=r"group signals .* lacks moment; compute it again"):
        estimates_of(tree)
    with pytest.warns(UserWarning, match="lacks moment.* until then it is ignored"):
        assert "signals" not in without_faulty_stages(tree).children
