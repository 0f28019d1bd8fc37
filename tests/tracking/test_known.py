"""What is known besides the videos: the head, the whisker, the contact."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

from vibrissa import Whisker
from vibrissa.objects import Peg
from vibrissa.recording import Recording
from vibrissa.rod import discretize
from vibrissa.simulation import Motion, simulate
from vibrissa.tracking import HeadPose, TrackOptions, trace_video, track
from vibrissa.tracking.recording import (
    force_scale,
    outside_video,
    remarks_on_fur,
    scale_sigma,
)
from vibrissa.tracking.refine.rods import Bent, State

FRAMES = 30
RATE = 1000.0


@pytest.fixture(scope="module")
def nodding(make_filmed):
    """A whisk past a peg by a head that turns to and fro, fast."""
    t = np.arange(FRAMES) / RATE
    azimuth = np.linspace(-0.10, 0.7, FRAMES)
    motion = Motion(t, azimuth, 0.05 + 0.2 * azimuth, 0.2 * azimuth, np.zeros((FRAMES, 3)))
    nod = 0.04 * np.sin(2.0 * np.pi * 60.0 * t)
    turn = Rotation.from_euler("ZY", np.stack([nod, 0.3 * nod], axis=1)).as_matrix()
    place = np.stack([0.2e-3 * np.sin(2.0 * np.pi * 60.0 * t), 0.02 * t, 0.0 * t], axis=1)
    whisker = Whisker.parabola(length=10e-3, coefficient=15.0)
    peg = Peg([6e-3, 1.2e-3, 0.0], [0.0, 0.0, 1.0], 0.5e-3)
    return make_filmed(simulate(whisker, motion.on_head(turn, place), peg))


@pytest.fixture(scope="module")
def traces(nodding):
    return [trace_video(frames) for frames in nodding.frames]


@pytest.fixture(scope="module")
def recording(nodding, traces):
    head = nodding.recording.to_dataset()[["head_position", "head_rotation"]]
    things = Recording(nodding.recording).objects
    return track(nodding.cameras, traces, RATE, head=head, objects=things)


def test_the_pose_is_given_relative_to_the_head(nodding, recording):
    truth = nodding.recording.to_dataset().isel(whisker=0)
    found = recording.to_dataset().isel(whisker=0)
    for name in ("base_azimuth", "base_elevation"):
        assert np.median(np.abs(found[name].values - truth[name].values)) < np.radians(1.0)
    assert np.median(np.linalg.norm(found["base_position_head"].values, axis=1)) < 80e-6
    away = found["base_position"].values - truth["base_position"].values
    assert np.median(np.linalg.norm(away, axis=1)) < 80e-6
    turned = found["base_rotation"].values[:, :, 0] - truth["base_rotation"].values[:, :, 0]
    assert np.median(np.linalg.norm(turned, axis=1)) < 0.02
    np.testing.assert_allclose(
        found["head_rotation"].values, truth["head_rotation"].values, atol=1e-12
    )
    assert found["base_position_head"].attrs["reference_frame"] == "head"


@pytest.mark.slow
def test_what_the_head_does_is_not_taken_for_whisking(nodding, traces, recording):
    """Filtered relative to the head, the pose keeps the head's fast motion; filtered alone not."""
    options = TrackOptions(cutoff=40.0)
    head = nodding.recording.to_dataset()[["head_position", "head_rotation"]]
    truth = nodding.recording.to_dataset().isel(whisker=0)["base_position"].values
    errors = []
    for known in (head, None):
        measured = track(nodding.cameras, traces, RATE, options, head=known)["measured"]
        place = measured["base_position"].values[:, 0]
        errors.append(np.sqrt(((place - truth) ** 2).sum(axis=1).mean()))
    assert errors[0] < 0.7 * errors[1]


def test_the_contact_nearest_to_the_object_agrees(nodding, recording):
    measured = recording["measured"].to_dataset().isel(whisker=0)
    found = recording.to_dataset().isel(whisker=0)
    touching = (found["in_contact"].values > 0) & (nodding.truth["in_contact"].values > 0)
    away = measured["contact_point"].values - nodding.truth["contact_point"].values
    assert touching.sum() > 8
    assert np.median(np.linalg.norm(away[touching], axis=1)) < 250e-6
    expected = np.linalg.norm(
        measured["contact_point"].values - found["contact_point"].values, axis=1
    )
    np.testing.assert_allclose(measured["contact_difference"].values, expected)
    assert np.isnan(measured["contact_point"].values[found["in_contact"].values == 0]).all()
    assert measured["contact_point"].attrs["source"] == "nearest to the object"
    assert isinstance(Recording(recording).objects[0], Peg)


def test_whiskers_are_tangent_to_a_known_object(nodding, traces):
    """Even if traces waver in other frames, which then seem to be in contact."""
    random = np.random.default_rng(3)
    touching = nodding.truth["in_contact"].values > 0
    wrong = random.choice(np.flatnonzero(~touching), 5, replace=False)

    def wavering(trace):
        share = np.linspace(0.0, 1.0, len(trace.line))[:, None]
        wave = np.cos(3.0 * np.pi * share + random.uniform(0.0, 3.0)) * random.normal(0.0, 6.0, 2)
        return trace._replace(line=trace.line + share**2 * wave)

    poor = [
        [[wavering(one) if i in wrong else one for i, one in enumerate(row)] for row in view]
        for view in traces
    ]
    head = nodding.recording.to_dataset()[["head_position", "head_rotation"]]
    things = Recording(nodding.recording).objects
    found = track(nodding.cameras, poor, RATE, head=head, objects=things)
    data = found.to_dataset().isel(whisker=0)
    assert data["in_contact"].values[wrong].sum() > 2
    away = data["contact_point"].values - nodding.truth["contact_point"].values
    errors = np.linalg.norm(away[touching & (data["in_contact"].values > 0)], axis=1)
    assert np.median(errors) < 5e-6
    assert np.percentile(errors, 95.0) < 15e-6


def test_derivatives_of_tangents_are_those_of_differences():
    random = np.random.default_rng(1)
    turn = Rotation.random(4, random_state=1).as_matrix()
    contact = np.column_stack([random.uniform(0.4, 0.9, 4), random.normal(0.0, 0.5, (4, 3))])
    state = State(turn, random.normal(size=(4, 3)), contact)
    rod = discretize(Whisker.parabola(length=10e-3, coefficient=15.0))
    touching = np.array([True, False, True, True])

    def tangents(state):
        return Bent.of(rod, state, touching).tangents(state.contact[:, 0])

    slopes = tangents(state)[1]
    for unknown in range(10):
        step = np.zeros((4, 10))
        step[touching, unknown] = 1e-4
        ahead, back = (tangents(state.moved(one))[0] for one in (step, -step))
        difference = ((ahead - back) / 2e-4)[touching]
        np.testing.assert_allclose(slopes[touching, :, unknown], difference, atol=2e-3)


@pytest.mark.slow
def test_contacts_of_poor_traces_are_on_a_known_object(nodding, traces):
    """Traces that waver by more than a pixel: without the object contacts are somewhere near it."""
    random = np.random.default_rng(4)

    def wavering(trace):
        share = np.linspace(0.0, 1.0, len(trace.line))
        phase = random.uniform(0.0, np.pi)
        wave = np.cos(3.0 * np.pi * share[:, None] + phase) * random.normal(0.0, 1.4, 2)
        return trace._replace(line=trace.line + wave)

    poor = [[[wavering(trace) for trace in row] for row in view] for view in traces]
    head = nodding.recording.to_dataset()[["head_position", "head_rotation"]]
    whisker, objects = Recording(nodding.recording).whisker(), Recording(nodding.recording).objects
    true, gaps, errors = nodding.truth["contact_point"].values, [], []
    for things in ((), objects):
        found = track(nodding.cameras, poor, RATE, head=head, objects=things)
        data = found.to_dataset().isel(whisker=0)
        points, known = data["contact_point"].values, np.isfinite(data["arc_length"].values)
        radius = whisker.radius(data["arc_length"].values[known])
        gaps.append(np.median(np.abs(objects[0].signed_distance(points[known]) - radius)))
        errors.append(np.nanmedian(np.linalg.norm(points - true, axis=1)))
    assert gaps[1] < 0.6 * gaps[0]
    assert errors[1] < errors[0]


@pytest.mark.slow
def test_contact_points_of_a_table_are_compared(nodding, traces, recording):
    """Truth as a table, in space by time and in pixels by frame, comes out as it went in."""
    true = nodding.truth["contact_point"].values
    rows = np.flatnonzero(np.isfinite(true).all(axis=1))
    by_time = xr.Dataset(
        {"contact_point": (("time", "whisker", "space"), true[rows][:, None])},
        {"time": rows / RATE + 0.2e-3, "whisker": [0]},
    )
    pixels = np.stack([camera.project(true[rows]) for camera in nodding.cameras], axis=1)
    by_view = xr.Dataset(
        {"contact_pixel": (("frame", "whisker", "view", "image_axis"), pixels[:, None])},
        {"frame": rows, "whisker": [0], "view": [0, 1]},
    )
    for table in (by_time, by_view):
        tracked = track(nodding.cameras, traces, RATE, contacts=table)
        measured = tracked["measured"].to_dataset().isel(whisker=0)
        np.testing.assert_allclose(measured["contact_point"].values, true, atol=1e-9)
        both = np.isfinite(measured["contact_difference"].values)
        arc = nodding.truth["arc_length"].values
        assert np.abs(measured["arc_length"].values - arc)[both].max() < 300e-6
    late = by_time.assign_coords(time=by_time["time"] + 1.0)
    with pytest.raises(ValueError, match="no frame of the videos"):
        track(nodding.cameras, traces, RATE, contacts=late)


def test_a_known_whisker_needs_no_free_frames(filmed):
    """All frames in contact: without the whisker's shape nothing says that it is bent."""
    whisker = Recording(filmed.recording).whisker()
    touching = np.flatnonzero(filmed.truth["in_contact"].values > 0)
    # After the first touch, so that no frame is nearly free.
    rows = touching[len(touching) // 2 :]
    cut = [[view[i] for i in rows] for view in filmed.frames]
    traces = [trace_video(frames) for frames in cut]
    recording = track(filmed.cameras, traces, RATE, TrackOptions(whisker=whisker))
    known = recording.to_dataset().isel(whisker=0)
    assert (known["in_contact"].values > 0).all()
    away = known["contact_point"].values - filmed.truth["contact_point"].values[rows]
    assert np.median(np.linalg.norm(away, axis=1)) < 150e-6
    for name in ("force", "moment"):
        true = filmed.truth[name].values[rows]
        error = np.linalg.norm(known[name].values - true, axis=1) / np.linalg.norm(true, axis=1)
        assert np.median(error) < 0.1
    assert Recording(recording).whisker().length == pytest.approx(whisker.length)


def test_a_known_whisker_distinguishes_contact_from_none(filmed, traced):
    whisker = Recording(filmed.recording).whisker()
    found = track(filmed.cameras, traced, RATE, TrackOptions(whisker=whisker)).to_dataset()
    truly = filmed.truth["in_contact"].values > 0
    assert (truly == (found["in_contact"].values[:, 0] > 0)).mean() > 0.9
    with pytest.raises(ValueError, match="another, or the scale is wrong"):
        track(filmed.cameras, traced, RATE, TrackOptions(whisker=Whisker.straight(length=5e-3)))


def head_table(dim, values, turns=None):
    n = len(values)
    turns = np.broadcast_to(np.eye(3), (n, 3, 3)) if turns is None else turns
    return xr.Dataset(
        {
            "head_position": ((dim, "space"), np.outer(values, [1.0, 0.0, 0.0])),
            "head_rotation": ((dim, "space", "head_axis"), turns),
        },
        {dim: values},
    )


def test_a_head_is_found_in_every_frame():
    turns = Rotation.from_euler("Z", [[0.0], [0.2], [0.6]]).as_matrix()
    table = head_table("time", np.array([0.0, 2e-3, 6e-3]), turns)
    head = HeadPose.of(table, np.arange(7), RATE)
    np.testing.assert_allclose(head.position[:, 0], np.arange(7) * 1e-3, atol=1e-15)
    angle = np.arctan2(head.rotation[:, 1, 0], head.rotation[:, 0, 0])
    np.testing.assert_allclose(angle, 0.1 * np.arange(7), atol=1e-12)
    points = np.random.default_rng(0).normal(size=(7, 4, 3))
    np.testing.assert_allclose(head.put_in(head.seen_from(points)), points, atol=1e-12)
    with pytest.raises(ValueError, match=r"from 0 to 0\.006 s in 3 rows; the video lasts"):
        HeadPose.of(table, np.arange(9), RATE)
    rows = head_table("frame", np.array([0, 1, 2, 4, 5]))
    np.testing.assert_array_equal(HeadPose.of(rows, np.array([1, 4]), RATE).position[:, 0], [1, 4])
    with pytest.raises(ValueError, match="missing for 1 frames of the video, the first"):
        HeadPose.of(rows, np.arange(6), RATE)


def test_contact_points_outside_of_the_videos_are_stated():
    pairs = np.stack([np.arange(10), np.arange(10)], axis=1)
    table = xr.Dataset(coords={"frame": np.arange(4, 14)})
    (remark,) = outside_video(table, pairs, 1000.0)
    assert remark.startswith("4 of the 10 moments")
    assert "frames 0 to 9" in remark
    assert outside_video(table.isel(frame=slice(6)), pairs, 1000.0) == []
    timed = xr.Dataset(coords={"time": np.arange(-2, 8) / 1000.0})
    assert outside_video(timed, pairs, 1000.0)[0].startswith("2 of the 10")


@pytest.mark.parametrize("hidden", [0.2e-3, 1e-3])
def test_forces_scale_with_the_radius_before_the_base(hidden):
    """The rod that begins in the fur is the same cone, and is stiffer at its base."""
    seen = Whisker.straight(25e-3, base_radius=80e-6, tip_radius=8e-6)
    slope = (80e-6 - 8e-6) / 25e-3
    stiffer = ((80e-6 + slope * hidden) / 80e-6) ** 4
    assert force_scale(seen, hidden) == pytest.approx(stiffer, rel=1e-12)


def test_what_fur_may_do_to_forces_is_said_where_the_radius_is_stated():
    whisker = Whisker.straight(25e-3, base_radius=80e-6, tip_radius=8e-6)
    percent = 100.0 * (force_scale(whisker, 1e-3) - 1.0)
    one = SimpleNamespace(whisker=whisker, scale=scale_sigma(whisker, 0.0, 0.0))
    (said,) = remarks_on_fur(one, 0.0, "C2")
    assert f"{percent:.0f} % too large" in said
    assert f"{100.0 * one.scale:.1f} % (standard deviation)" in said
    assert "--fur" in said
    assert not remarks_on_fur(SimpleNamespace(whisker=whisker, scale=np.nan), 0.0, "C2")
    stated = SimpleNamespace(whisker=whisker, scale=scale_sigma(whisker, 0.8e-3, 0.0))
    assert stated.scale == pytest.approx(np.log(force_scale(whisker, 0.2e-3)), rel=1e-12)
    assert stated.scale < scale_sigma(whisker, 0.8e-3, 1e-3) < one.scale
    (said,) = remarks_on_fur(stated, 0.8e-3, "C2")
    assert "taken to be hidden by fur" in said


def test_the_scale_of_forces_that_fur_leaves_open_is_one_number(filmed, traced):
    """A radius is stated; one view shows 24 pixels of the base less than the other."""
    later = [
        t._replace(line=t.line[12:], sigma=t.sigma[12:], seen=t.seen[12:]) for t in traced[0][0]
    ]
    found = []
    for properties, rows in (({}, traced[0]), ({"base_radius": 50e-6}, [later])):
        options = TrackOptions(properties=properties, length=10e-3)
        found.append(track(filmed.cameras, [rows, traced[1]], 1000.0, options))
    none, data = (tree.to_dataset()["wrench_scale_sigma"].values for tree in found)
    assert none.shape == data.shape == (1,)
    assert np.isnan(none).all()
    whisker = Recording(found[1]).whisker()
    more = 24.0 * 10e-3 / 172.0
    assert whisker.radius(0.0) == pytest.approx(50e-6 - 45e-6 * more / 10e-3, rel=0.05)
    assert data[0] == pytest.approx(scale_sigma(whisker, 0.0, more), rel=0.05)
    assert "before which front shows the stated radius" in found[1].attrs["remarks"]
