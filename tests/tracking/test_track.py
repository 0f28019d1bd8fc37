"""The whole way, from filmed frames to contact and wrench, against the simulated truth."""

import pickle
import sys
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_info, threadpool_limits

from vibrissa import PointContact, Whisker, deflect
from vibrissa.numerics import without_blas_threads
from vibrissa.recording import Recording
from vibrissa.status import Status
from vibrissa.tracking import (
    FitOptions,
    RestShape,
    TrackOptions,
    base_pose,
    rest_shape,
    trace_video,
    track,
    whisker_at_rest,
)
from vibrissa.tracking.refine.problem import Smoother
from vibrissa.tracking.refine.taper import tapered_as_it_bends
from vibrissa.tracking.space.exchange import exchanged
from vibrissa.tracking.space.rest_shape import Length, known_rest, length_shown
from vibrissa.tracking.trace.trace import STEP
from vibrissa.tracking.track import known_of, track_whisker
from vibrissa.whisker import angles_of, base_rotation


@pytest.fixture(scope="module")
def traces(traced):
    return traced


@pytest.fixture(scope="module")
def recording(filmed, traces):
    return track(filmed.cameras, traces, 1000.0)


@pytest.fixture(scope="module")
def found(recording):
    return recording.to_dataset().isel(whisker=0)


@pytest.fixture(scope="module")
def both(filmed, found):
    """Frames that are in contact in truth and in the result."""
    return (filmed.truth["in_contact"].values > 0) & (found["in_contact"].values > 0)


def test_contact_is_told_from_none(filmed, found):
    truly = filmed.truth["in_contact"].values > 0
    assert (truly == (found["in_contact"].values > 0)).mean() > 0.9
    np.testing.assert_array_equal(
        found["status"].values,
        np.where(found["in_contact"].values > 0, Status.OK, Status.NO_CONTACT),
    )


def test_the_whisker_is_where_it_is(filmed, found):
    true, line = filmed.truth["centerline"].values, found["centerline"].values
    for i in range(len(line)):
        distance = np.linalg.norm(line[i][:, None] - true[i][None], axis=2).min(axis=0)
        assert np.median(distance) < 60e-6


def test_the_rest_shape_is_the_whisker_s(filmed, recording):
    whisker, true = Recording(recording).whisker(), Recording(filmed.recording).whisker()
    assert whisker.length == pytest.approx(true.length, rel=0.03)
    s = np.linspace(0.0, 0.9 * true.length, 20)
    assert np.abs(whisker.position(s) - true.position(s)).max() < 100e-6


def test_the_base_is_held_as_it_is(filmed, found):
    truth = filmed.recording.to_dataset().isel(whisker=0)
    away = found["base_position"].values - truth["base_position"].values
    assert np.median(np.linalg.norm(away, axis=1)) < 80e-6
    for name in ("base_azimuth", "base_elevation"):
        assert np.median(np.abs(found[name].values - truth[name].values)) < np.radians(1.0)


def test_the_contact_is_where_it_is(filmed, found, both):
    away = found["contact_point"].values - filmed.truth["contact_point"].values
    assert both.sum() > 10
    assert np.median(np.linalg.norm(away[both], axis=1)) < 60e-6


def test_force_and_moment_are_those_of_the_rod(filmed, found, both):
    for name, allowed in (("force", 0.1), ("moment", 0.05)):
        true = filmed.truth[name].values[both]
        error = np.linalg.norm(found[name].values[both] - true, axis=1)
        assert np.median(error / np.linalg.norm(true, axis=1)) < allowed
    free = found["in_contact"].values == 0
    assert (found["force"].values[free] == 0.0).all()
    assert np.isnan(found["contact_point"].values[free]).all()


def pressed(whisker, share=0.0, hidden=0, begin_sigma=1.0):
    """What fits rods to traces without noise of one bent by a known force with friction.

    They lack some points at its base.
    """
    from vibrissa import PointForce
    from vibrissa.cameras import orthogonal_views
    from vibrissa.tracking import BasePose, HeadPose, Trace, TraceSeries
    from vibrissa.tracking.refine.fit import Fitter
    from vibrissa.tracking.trace.trace import even

    across = np.array([60e-6, 20e-6])
    along = share * np.linalg.norm(across)
    s = np.linspace(15e-3, 18e-3, 9)
    bent = deflect(whisker, PointForce(s, components=(along, *across)))
    curves = bent.centerline(101)
    pair = orthogonal_views(center=(0.012, 0.005, 0.0))
    traces = []
    for camera in pair:
        lines = [even(camera.project(curve))[hidden:] for curve in curves]
        whole = [
            Trace(line, np.full(len(line), 0.02), np.ones(len(line), bool), 1.0) for line in lines
        ]
        traces.append([trace._replace(begin_sigma=begin_sigma) for trace in whole])
    still = np.zeros(9)
    pose = BasePose(np.zeros((9, 3)), still, still, still)
    touching = np.ones(9, dtype=bool)
    series, head = TraceSeries.of(traces), HeadPose.still(9)
    fitter = Fitter(pair, series, touching, curves, 1000.0, FitOptions(), head)
    return fitter, pose, bent, s


@pytest.mark.parametrize("stated", [15.0, 6.0])
def test_bending_shows_how_a_whisker_tapers(stated):
    true = Whisker.parabola(length=30e-3, coefficient=10.0, tip_radius=100e-6 / 9.0)
    fitter, pose, _, _ = pressed(true)
    usual = Length(true.length, 0.04 * true.length, seen=True)
    other = true.with_properties(tip_radius=100e-6 / stated)
    found, length = tapered_as_it_bends(fitter, other, usual, pose)
    tips = np.array([each.radius(true.length) for each in (true, other, found)])
    assert abs(tips[2] - tips[0]) < 0.2 * abs(tips[1] - tips[0])
    assert length.sigma < 0.4 * usual.sigma
    assert found.notes[-1].startswith("radius of the tip: 1")


def test_a_taper_is_no_surer_than_where_the_base_is():
    """All frames in contact hide 16 pixels of a base that other frames show."""
    true = Whisker.parabola(length=30e-3, coefficient=10.0, tip_radius=100e-6 / 9.0)
    usual = Length(true.length, 0.04 * true.length, seen=True)
    found, sigmas = [], []
    for hidden, begin_sigma in ((0, 1.0), (8, 6.0)):
        fitter, pose, _, _ = pressed(true, 0.0, hidden, begin_sigma)
        whisker, length = tapered_as_it_bends(fitter, true, usual, pose)
        found.append(whisker.radius(true.length) / whisker.radius(0.0))
        sigmas.append(length.sigma)
    assert abs(found[1] - 1.0 / 9.0) < 0.01
    assert sigmas[1] > 1.2 * sigmas[0]


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_friction_is_found_in_the_shape(share):
    """A rod bent by a known force with friction, seen without noise: the force comes out."""
    whisker = Whisker.parabola(length=30e-3, coefficient=10.0)
    fitter, pose, bent, s = pressed(whisker, share)
    found, _ = fitter.fit(whisker, pose, 65, Length(whisker.length, 0.5e-3))
    np.testing.assert_allclose(found.arc_length, s, atol=100e-6)
    if share == 0.0:
        # A whisker that is longer by that is thicker: it pushes back more at the same points.
        ahead = whisker.length / (whisker.length + 0.5e-3)
        thicker = whisker.with_properties(radius=lambda s: whisker.radius(ahead * s))
        pushed = deflect(thicker, PointContact(bent.contact_point))
        more = np.concatenate([pushed.force - bent.force, pushed.moment - bent.moment], axis=1)
        size = np.abs(more).max(axis=0, keepdims=True)
        assert (np.abs(found.shared[:, -1, 9:] - more) < 0.1 * size.max()).all()
    # Friction along a hardly bent whisker hardly shows, and the covariance says so.
    error = found.force - bent.force
    sigma = np.sqrt(np.einsum("tii->ti", found.wrench_covariance[:, :3, :3]))
    assert np.abs(error / sigma).max() < 4.0
    moment = np.linalg.norm(found.moment - bent.moment, axis=1)
    assert (moment / np.linalg.norm(bent.moment, axis=1)).max() < 0.05
    away = np.linalg.norm(found.contact_point - bent.contact_point, axis=1)
    assert away.max() < 100e-6


def test_contacts_do_not_follow_a_roll_that_free_frames_do_not_show():
    """Expected 4° to either side, as contact takes the whisker beyond where it was free."""
    whisker = Whisker.parabola(length=30e-3, coefficient=10.0)
    fitter, pose, bent, _ = pressed(whisker)
    for roll in np.radians([-4.0, 4.0]):
        found, _ = fitter.fit(whisker, replace(pose, roll=pose.roll + roll), 65)
        away = np.linalg.norm(found.contact_point - bent.contact_point, axis=1)
        assert away.max() < 25e-6


def test_light_contacts_begin_near_those_of_the_frames_before_and_after():
    """Each by itself they were up to 0.3 L off, at which some fits were caught."""
    from vibrissa import Whisker
    from vibrissa.rod import discretize
    from vibrissa.tracking.refine.rods import State, first_contacts, rods

    d, count = discretize(Whisker.parabola(length=25e-3, coefficient=8.0)), 24
    contact = np.zeros((count, 4))
    contact[:, 0], contact[:, 3] = np.linspace(0.55, 0.72, count), 0.06
    s = np.linspace(0.0, 1.0, 101)
    waves = np.sin(np.outer(np.arange(1, 4) * np.pi, s))
    noise = np.random.default_rng(0).normal(0.0, 3e-5, (count, 3, 3))
    curves = rods(d, contact, s) * d.length + np.einsum("tki,kn->tni", noise, waves)
    upright = np.broadcast_to(np.eye(3), (count, 3, 3))
    state = State(upright, np.zeros((count, 3)), np.zeros((count, 4)))
    found = first_contacts(d, state, curves, np.ones(count, dtype=bool))
    assert np.abs(found[:, 0] - contact[:, 0]).max() < 0.1


def test_a_lower_minimum_along_the_whisker_is_found():
    """The fit is stopped where the contact is a millimetre from the one that was pressed."""
    from vibrissa.tracking.refine.fit import profiled

    whisker = Whisker.parabola(length=30e-3, coefficient=10.0)
    fitter, pose, _, s = pressed(whisker)
    problem, state, _ = fitter._problem(whisker, pose).trusted()
    away = state.contact + np.array([1e-3 / whisker.length, 0.0, 0.0, 0.0])
    stopped = replace(problem, begun=replace(state, contact=away))
    before, linear = replace(stopped, options=FitOptions(rounds=0)).solved()
    assert (before.contact == away).all()
    after, _, covariance = profiled(problem, before, linear)
    np.testing.assert_allclose(after.contact[:, 0] * whisker.length, s, atol=100e-6)
    assert (np.linalg.eigvalsh(covariance) > 0.0).all()


def test_a_profile_ends_where_no_rod_is_in_equilibrium(monkeypatch):
    from vibrissa.tracking.refine.fit import profiled
    from vibrissa.tracking.refine.problem import Problem

    whisker = Whisker.parabola(length=30e-3, coefficient=10.0)
    fitter, pose, _, _ = pressed(whisker)
    problem, state, linear = fitter._problem(whisker, pose).trusted()
    arcs, solved = [], Problem.solved

    def withstood(self):
        found, fit = solved(self)
        arcs.extend(arc for _, arc in self.held)
        if arcs and arcs[-1] > arcs[0]:
            fit = fit._replace(costs=np.full_like(fit.costs, np.inf))
        return found, fit

    monkeypatch.setattr(Problem, "solved", withstood)
    assert np.isfinite(profiled(problem, state, linear)[2]).all()


def test_the_equations_hold_the_derivatives_of_the_residuals():
    whisker = Whisker.parabola(length=30e-3, coefficient=10.0)
    fitter, pose, _, _ = pressed(whisker)
    problem, state, _ = fitter._problem(whisker, pose).trusted()
    problem = replace(problem, touching=np.arange(9) != 4, variance=None)
    state = replace(state, position=state.position + 1e-4)
    here, size = problem.linear(state).data, 1e-6
    for unknown in range(10):
        step = np.zeros((9, 10))
        step[:, unknown] = size
        there = problem.linear(state.moved(step)).data
        for view in range(2):
            change = (here.misses[view] - there.misses[view]) / size
            stated = here.designs[view][:, :-2, unknown]
            # The rod of the frame without contact is as at rest, far from its trace.
            assert unknown < 6 or not stated[4].any()
            stated, change = np.delete(stated, 4, axis=0), np.delete(change, 4, axis=0)
            # Where another point of a trace becomes the nearest, a difference is not a derivative.
            assert np.quantile(np.abs(change - stated), 0.95) <= 0.02 * np.abs(stated).max()
    design = np.concatenate(here.designs, axis=1)
    np.testing.assert_allclose(here.hessian, np.swapaxes(design, 1, 2) @ design, atol=1e-6)


def test_a_frame_that_becomes_worse_does_not_stop_the_others(monkeypatch):
    from vibrissa.tracking.refine.problem import Problem

    whisker = Whisker.parabola(length=30e-3, coefficient=10.0)
    fitter, pose, _, s = pressed(whisker)
    problem, state, _ = fitter._problem(whisker, pose).trusted()
    begun = replace(state, contact=state.contact + np.array([0.02, 0.0, 0.0, 0.0]))
    compared = Problem._compared

    def stuck(self, state):
        data = compared(self, state)
        if state.contact[4, 0] != begun.contact[4, 0]:
            data.squares[4] = np.inf
        return data

    monkeypatch.setattr(Problem, "_compared", stuck)
    apart = replace(problem, begun=begun, frames=2 * problem.frames)
    found = apart.solved()[0].contact[:, 0] * whisker.length
    assert found[4] == begun.contact[4, 0] * whisker.length
    np.testing.assert_allclose(np.delete(found - s, 4), 0.0, atol=200e-6)


def test_a_slip_makes_the_frame_before_it_uncertain():
    """While that frame is exposed the whisker may be on both sides of the slip."""
    whisker = Whisker.parabola(length=30e-3, coefficient=10.0)
    fitter, pose, _, _ = pressed(whisker)
    free = whisker.centerline(101)
    for view, camera in enumerate(fitter.cameras):
        fitter.traces.line[5:, view] = camera.project(free)
    fitter.curves[5:] = free
    fitter.touching[5:] = False
    found, _ = fitter.fit(whisker, pose, 65)
    spread = np.sqrt(found.contact_covariance[:, 1, 1])
    away = np.linalg.norm(found.contact_point[4] - free, axis=1).min()
    assert spread[4] > 0.03 * away
    assert (spread[1:4] < 0.015 * away).all()


def test_a_step_to_a_contact_that_no_rod_withstands_is_not_taken():
    from vibrissa import samples
    from vibrissa.cameras import orthogonal_views
    from vibrissa.objects import Peg
    from vibrissa.rod import discretize
    from vibrissa.tracking import FitOptions, HeadPose, Trace, TraceSeries
    from vibrissa.tracking.refine.problem import Problem
    from vibrissa.tracking.refine.rods import State
    from vibrissa.tracking.trace.trace import even

    whisker = samples.gamma()
    pair = orthogonal_views(center=(0.012, 0.005, 0.0))
    lines = [even(camera.project(whisker.centerline(101))) for camera in pair]
    seen = [Trace(one, np.full(len(one), 0.02), np.ones(len(one), bool), 1.0) for one in lines]
    sight = TraceSeries.of([[one, one] for one in seen])
    # Near the thin tip this force is far beyond what any rod is in balance with.
    contact = np.array([[0.5, 0.0, 0.1, 0.0], [0.93, 1.4, -40.0, -40.0]])
    state = State(np.array([np.eye(3)] * 2), np.zeros((2, 3)), contact)
    touching, frames = np.ones(2, dtype=bool), np.arange(2)
    still = HeadPose.still(2)
    problem = Problem(
        whisker,
        discretize(whisker),
        pair,
        sight,
        touching,
        frames,
        state,
        1000.0,
        FitOptions(),
        still,
        (),
        None,
        ~touching,
    )
    for objects in ((), (Peg([0.012, 0.005, 0.0], [0.0, 0.0, 1.0], 1e-3),)):
        fit = replace(problem, objects=objects, near=touching).linear(state)
        assert fit.data.wild.tolist() == [False, True]
        assert fit.cost == np.inf
        assert np.isfinite(fit.smoother.solved(1.0)[0]).all()


def test_the_covariance_of_the_contact_is_of_the_size_of_its_errors(filmed, found, both):
    away = (found["contact_point"].values - filmed.truth["contact_point"].values)[both]
    spread = found["contact_covariance"].values[both]
    squares = np.einsum("ti,tij,tj->t", away, np.linalg.inv(spread), away)
    assert 0.1 < np.median(squares) < 30.0


@pytest.mark.slow
def test_light_from_the_side_is_in_the_covariances_where_profiles_show_it(
    filmed, traces, found, both
):
    """Traces of one view that all are shifted, with the skew of profiles that such light makes."""
    ends = filmed.cameras[1].project(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1e-4]]))
    base = float(np.linalg.norm(ends[1] - ends[0]))  # 0.1 mm, pixels
    at_base, nearer = base, base * (1.0 - 0.25 * 14.0 / 15.0)
    shift = 0.1
    skew = shift / 3.2 * nearer**3 / at_base
    lit = [[one._replace(skew=skew) for one in row] for row in traces[1]]

    def shifted(one):
        down = np.outer(np.linspace(shift, 0.0, len(one.line)), [0.0, 1.0])
        return one._replace(line=one.line + down)

    aside = [[shifted(one) for one in row] for row in lit]
    known, wrong = (
        track(filmed.cameras, [traces[0], one], 1000.0).to_dataset().isel(whisker=0)
        for one in (lit, aside)
    )
    moved = (wrong["contact_point"].values - known["contact_point"].values)[both]
    assert np.median(np.linalg.norm(moved, axis=1)) > 2e-6
    spread, shared = (known[f"contact_{n}"].values[both] for n in ("covariance", "shared"))
    together = np.einsum("tki,tkj->tij", shared, shared)
    assert (np.linalg.eigvalsh(spread - together) > -1e-14).all()
    held = np.einsum("ti,tij,tj->t", moved, np.linalg.inv(spread), moved)
    alone = np.einsum("ti,tij,tj->t", moved, np.linalg.inv(spread - together), moved)
    assert np.percentile(held, 95.0) < 7.8 < np.median(alone)
    # Where profiles are even the light is not counted.
    even = found["contact_covariance"].values[both]
    square = np.einsum("ti,tij,tj->t", moved, np.linalg.inv(even), moved)
    assert np.median(square) > 2.0 * np.median(held)


def test_the_whisker_s_frame_is_known_as_well_as_stated(filmed, found):
    """The axis and the roll of its frame are those of the rest shape: no residuals show them."""
    true = filmed.recording["base_rotation"].values[:, 0]
    error = found["base_rotation"].values @ np.swapaxes(true, 1, 2)
    turn = Rotation.from_matrix(error).as_rotvec()
    spread = found["pose_covariance"].values[:, 3:, 3:]
    shared = found["pose_shared"].values[..., 3:]
    together = np.einsum("tki,tkj->tij", shared, shared)
    assert (np.linalg.eigvalsh(spread - together) > -1e-9).all()
    square = np.einsum("ti,tij,tj->t", turn, np.linalg.inv(spread), turn)
    assert 0.02 < np.median(square) < 7.8


def test_the_paper_s_way_is_beside_it(filmed, recording):
    measured = recording["measured"].to_dataset().isel(whisker=0)
    truth = filmed.recording.to_dataset().isel(whisker=0)
    away = measured["base_position"].values - truth["base_position"].values
    assert np.median(np.linalg.norm(away, axis=1)) < 80e-6
    assert np.nanmedian(measured["centerline_sigma"].values) < 50e-6


def test_a_recording_says_what_it_holds(recording, tmp_path):
    from vibrissa.io import load_recording, save_recording

    data = recording.to_dataset()
    assert data["trace"].dims == ("time", "whisker", "view", "node", "image_axis")
    for name, variable in data.data_vars.items():
        assert {"units", "long_name"} <= set(variable.attrs), name
    save_recording(tmp_path / "t.nc", recording)
    again = load_recording(tmp_path / "t.nc")
    np.testing.assert_array_equal(again["force"].values, data["force"].values)


def test_lost_frames_are_missing(filmed, traces):
    from vibrissa.tracking import Trace

    holes = [[list(row) for row in view] for view in traces]
    holes[1][0][12] = Trace.lost()
    data = track(filmed.cameras, holes, 1000.0).to_dataset().isel(whisker=0)
    assert data["status"].values[12] == Status.MISSING
    assert data["confidence"].values[12] == 0.0
    assert np.isnan(data["force"].values[12]).all()
    assert np.isfinite(data["base_position"].values[13]).all()


def test_views_of_different_whiskers_are_refused(filmed, traces):
    aside = np.array([30.0, 0.0])
    moved = [trace._replace(line=trace.line + aside) for trace in traces[1][0]]
    with pytest.raises(ValueError, match=r"the views do not show one whisker.* by 1[0-9] pixels"):
        track(filmed.cameras, [traces[0], [moved]], 1000.0)


@pytest.mark.parametrize("spoilt", ["views", pytest.param("lost", marks=pytest.mark.slow)])
def test_a_whisker_that_cannot_be_tracked_does_not_cost_the_others(
    filmed, traces, recording, spoilt
):
    from vibrissa.tracking import Trace

    first, second = (view[0] for view in traces)
    moved = [trace._replace(line=trace.line + np.array([60.0, 0.0])) for trace in second]
    lost = [Trace.lost()] * len(first)
    bad = [first, moved] if spoilt == "views" else [lost, lost]
    both = [[worse, good] for worse, good in zip(bad, (first, second), strict=True)]
    found = track(filmed.cameras, both, 1000.0, names=["bad", "good"])
    assert list(found["whisker"].values) == ["good"]
    one = found.to_dataset().drop_vars("whisker")
    xr.testing.assert_identical(
        one.drop_attrs(), recording.to_dataset().drop_vars("whisker").drop_attrs()
    )
    assert "bad could not be tracked and is left out: " in found.attrs["remarks"]
    with pytest.raises(ValueError, match=r"no whisker could be tracked: .*bad could.*worse could"):
        track(filmed.cameras, [[row, row] for row in bad], 1000.0, names=["bad", "worse"])


@pytest.mark.parametrize("row", [False, True])
def test_a_trace_next_to_a_crossing_is_no_contact_in_a_row(filmed, traces, row):
    """In the front view it is drawn aside by up to 0.5 pixels in a frame that is free."""
    mine = [list(view[0]) for view in traces]
    free = np.flatnonzero(~track_whisker(filmed.cameras, mine, 1000.0, TrackOptions()).touching)
    i = int(free[len(free) // 2])
    bump = np.exp(-(np.linspace(-3.0, 3.0, len(mine[1][i].line)) ** 2))
    aside = mine[1][i].line + 0.5 * bump[:, None] * [0.0, 1.0]
    mine[1][i] = mine[1][i]._replace(line=aside)
    found = track_whisker(filmed.cameras, mine, 1000.0, TrackOptions(), row=row)
    assert found.touching[i] == (not row)


def test_the_far_end_of_a_bent_whisker_is_given_back(filmed, traces):
    """In the front view a line crosses the whisker that an object bends, and has its far end."""
    mine = [list(view[0]) for view in traces]
    one = track_whisker(filmed.cameras, mine, 1000.0, TrackOptions())
    most = np.argsort(np.where(one.touching, one.shape.deviation, 0.0))[-3:]
    known = known_of(filmed.cameras, one, 1000.0, FitOptions())
    doubtful = known.doubtful | np.isin(np.arange(len(known.doubtful)), most)
    other = [[t._replace(line=t.line + np.array([20.0, 0.0])) for t in view] for view in mine]
    rows = [[list(view) for view in mine], other]
    for i in most:
        right = mine[1][i]
        n, half = len(right.line), len(right.line) // 2
        ahead = right.line[half + 5] - right.line[half - 5]
        along = np.exp(0.2j) * complex(*ahead / np.hypot(*ahead))
        steps = STEP * np.arange(-half, n - half)[:, None]
        crossing = right.line[half] + steps * [along.real, along.imag]
        for row, (begin, end) in zip(
            rows, ((right.line, crossing), (crossing, right.line)), strict=True
        ):
            line = np.concatenate([begin[:half], end[half:]])
            row[1][i] = right._replace(line=line)
    found = exchanged(filmed.cameras, rows, [known._replace(doubtful=doubtful), None])
    for i in most:
        np.testing.assert_allclose(found[0][1][i].line, mine[1][i].line, atol=1e-9)
        assert found[0][0][i] is mine[0][i]


@pytest.mark.parametrize("usual", [0.8, 2.3])
def test_frames_are_contradicted_if_they_differ_from_the_others(usual):
    """In a compressed video, whose traces are all less well explained, none was left."""
    misfit = usual * np.random.default_rng(0).uniform(0.7, 1.3, 200)
    misfit[:5] = np.nan
    wrong = np.arange(200) % 9 == 0
    contradicted = sys.modules["vibrissa.tracking.track"]._contradicted
    assert not contradicted(misfit).any()
    np.testing.assert_array_equal(contradicted(np.where(wrong, 9.0, misfit)), wrong)


@pytest.mark.slow
@pytest.mark.parametrize("views", [1, 2])
def test_frames_that_no_rod_explains_are_left_out_if_two_views_contradict_each_other(
    filmed, traces, monkeypatch, views
):
    """In a single view whiskers that turn out of the plane are not explained, yet seen.

    Only their contacts, which may be a neighbour's line, are left out.
    """
    few = [[view[0][:40]] * 2 for view in traces[:views]]
    every_fifth = np.arange(40) % 5 == 0
    module = sys.modules["vibrissa.tracking.track"]
    monkeypatch.setattr(module, "_contradicted", lambda misfit: every_fifth)
    found = track(filmed.cameras[:views], few, 1000.0)
    lost = np.isnan(found["base_position"].values).any(axis=2)
    contact = filmed.truth["in_contact"].values[:40] > 0
    assert 0 < (every_fifth & contact).sum() < every_fifth.sum()
    expected = every_fifth if views == 2 else every_fifth & contact
    np.testing.assert_array_equal(lost, np.stack([expected, expected], axis=1))


def squared_errors(recording, filmed):
    """Squared errors of contact points over their covariance, in every other frame filmed."""
    found = recording.to_dataset().isel(whisker=0)
    truth = filmed.truth.isel(time=slice(None, None, 2))
    both = (truth["in_contact"].values > 0) & (found["in_contact"].values > 0)
    away = (found["contact_point"].values - truth["contact_point"].values)[both]
    spread = found["contact_covariance"].values[both]
    return np.einsum("ti,tij,tj->t", away, np.linalg.inv(spread), away)


def test_a_tip_that_is_not_seen_is_found_by_how_the_whisker_bends(filmed, traces):
    """Without the last 3 to 9 % of every trace, said to go on; of every other frame.

    What is shown of the last tenth wanders, as where noise is followed.
    """
    cut, generator = [], np.random.default_rng(0)
    bent = np.flatnonzero(filmed.truth["in_contact"].values[::2] > 0)
    for (whole,) in traces:
        row = []
        for trace in whole[::2]:
            last = np.linspace(-9.0, 1.0, len(trace.line)).clip(0.0)[:, None]
            row.append(trace._replace(line=trace.line + generator.normal(0.0, 3.0, 2) * last**2))
        ends = [int(generator.uniform(0.91, 0.97) * len(trace.line)) for trace in row]
        # An object hides most of it in one frame of a contact.
        ends[bent[len(bent) // 2]] //= 5
        cut.append(
            [
                t._replace(line=t.line[:n], sigma=t.sigma[:n], seen=t.seen[:n], tip_seen=False)
                for t, n in zip(row, ends, strict=True)
            ]
        )
    how = TrackOptions(fit=FitOptions(rounds=6))
    recording = track(filmed.cameras, [[row] for row in cut], 500.0, how)
    true = Recording(filmed.recording).whisker().length
    assert Recording(recording).whisker().length == pytest.approx(true, rel=0.03)
    assert "its tip is too faint" in recording.attrs["remarks"]
    squares = squared_errors(recording, filmed)
    assert np.nanmedian(squares) < 2.366 * 2.0**2


def test_lengths_for_which_a_frame_has_no_pose_are_compared(filmed, traces, monkeypatch):
    """All lengths are compared by the same frames, in contact with an object."""
    module, calls = import_module("vibrissa.tracking.track"), []
    usual = module._poses
    bent = np.flatnonzero(filmed.truth["in_contact"].values[::2] > 0)

    def poses(fitter, *rest):
        found = usual(fitter, *rest)
        calls.append(fitter)
        for pose in found:
            pose.azimuth[bent[3]] = np.nan if len(calls) % 2 == 0 else pose.azimuth[bent[3]]
        return found

    monkeypatch.setattr(module, "_poses", poses)
    cut = []
    for (row,) in traces:
        ends = [int(0.94 * len(trace.line)) for trace in row[::2]]
        cut.append(
            [
                t._replace(line=t.line[:n], sigma=t.sigma[:n], seen=t.seen[:n], tip_seen=False)
                for t, n in zip(row[::2], ends, strict=True)
            ]
        )
    recording = track(filmed.cameras, [[row] for row in cut], 500.0)
    assert len(calls) > 6
    true = Recording(filmed.recording).whisker().length
    assert Recording(recording).whisker().length == pytest.approx(true, rel=0.05)


@pytest.mark.parametrize("stated", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_contact_beyond_what_is_seen_is_as_uncertain_as_stated(filmed, traces, stated):
    """The image ends before the contact: that follows from the length, which bending hardly shows.

    Every other frame; the seen part is so short that the whisker may be of any length above it.
    """
    cut = []
    for (whole,) in traces:
        row = []
        for t in whole[::2]:
            n = int(0.55 * len(t.line))
            row.append(
                t._replace(line=t.line[:n], sigma=t.sigma[:n], seen=t.seen[:n], tip_seen=False)
            )
        cut.append(row)
    true = Recording(filmed.recording).whisker().length
    how = TrackOptions(fit=FitOptions(rounds=6), length=true if stated else None)
    recording = track(filmed.cameras, [[row] for row in cut], 500.0, how)
    squares = squared_errors(recording, filmed)
    assert (squares < 7.81).mean() > 0.8
    assert "not sure where whisker 0 touches" in recording.attrs["remarks"]
    assert ("(--length)" in recording.attrs["remarks"]) != stated


def test_a_whisker_that_a_wall_cuts_in_one_view_goes_on_as_the_other_shows(filmed, traces):
    cut = [list(whole[::2]) for (whole,) in traces]
    for i, t in enumerate(cut[1]):
        n = int(0.55 * len(t.line))
        cut[1][i] = t._replace(line=t.line[:n], sigma=t.sigma[:n], seen=t.seen[:n], tip_seen=False)
    how = TrackOptions(fit=FitOptions(rounds=6))
    recording = track(filmed.cameras, [[row] for row in cut], 500.0, how)
    true = Recording(filmed.recording).whisker().length
    assert Recording(recording).whisker().length == pytest.approx(true, rel=0.03)
    assert (squared_errors(recording, filmed) < 7.81).mean() > 0.88


def test_the_smoother_solves_its_equations():
    """Against the dense normal equations."""
    generator = np.random.default_rng(0)
    count, n = 7, 4
    root = generator.normal(size=(count, n, n))
    hessian = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(n)
    gradient = generator.normal(size=(count, n))
    smoother = Smoother(hessian, gradient)
    dense = np.zeros((count * n, count * n))
    for i in range(count):
        dense[i * n : (i + 1) * n, i * n : (i + 1) * n] = hessian[i]
    right = gradient.reshape(-1).copy()
    value, weight = generator.normal(size=(count, n)), np.array([1.0, 2.0, 0.5, 0.0])
    at, seconds = np.arange(1, count - 1), np.diff(value, n=2, axis=0)
    smoother.add_second(at, seconds, np.tile(weight, (len(at), 1)))
    for i, second in zip(at, seconds, strict=True):
        rows = np.zeros((n, count * n))
        for j, factor in ((i - 1, 1.0), (i, -2.0), (i + 1, 1.0)):
            rows[:, j * n : (j + 1) * n] += factor * np.diag(weight)
        dense += rows.T @ rows
        right -= rows.T @ (weight * second)
    step, _ = smoother.solved()
    np.testing.assert_allclose(step.reshape(-1), np.linalg.solve(dense, right))
    inverse = np.linalg.inv(dense)
    blocks = [inverse[i * n : (i + 1) * n, i * n : (i + 1) * n] for i in range(count)]
    np.testing.assert_allclose(smoother.covariances(), blocks, rtol=1e-6, atol=1e-9)


def test_without_any_contact_there_is_none(filmed, traces):
    free = [[row[:5] for row in view] for view in traces]
    data = track(filmed.cameras, free, 1000.0).to_dataset().isel(whisker=0)
    assert not data["in_contact"].values.any()
    assert (data["status"].values == Status.NO_CONTACT).all()
    assert (data["force"].values == 0.0).all()


def test_a_base_that_the_border_of_the_image_cuts_off_is_stated(filmed, traces):
    cut = [[[t._replace(base_seen=False) for t in row] for row in traces[0]], traces[1]]
    shown = "which is shown by top in 0 of 40 frames, front in 40 of 40 frames"
    with pytest.raises(ValueError, match=shown):
        track(filmed.cameras, cut, 1000.0)


def test_angles_of_an_orientation():
    angles = np.random.default_rng(0).uniform(-1.2, 1.2, (50, 3))
    np.testing.assert_allclose(angles_of(base_rotation(*angles.T)), angles, atol=1e-12)


def test_a_whisker_that_is_never_free_or_seen_says_so(filmed, traces):
    with pytest.raises(ValueError, match="at least 3 are needed"):
        rest_shape(np.full((5, 20, 3), np.nan))
    with pytest.raises(ValueError, match="every view needs all whiskers"):
        track(filmed.cameras, [traces[0], []], 1000.0)
    with pytest.raises(ValueError, match="rate is 0"):
        track(filmed.cameras, traces, 0.0, TrackOptions())
    few = track(filmed.cameras, [[row[:3] for row in view] for view in traces], 1000.0)
    assert not few["in_contact"].any()
    assert np.isfinite(few["base_position"]).all()


def test_the_rest_shape_ignores_how_it_is_held():
    """Shapes that are the same but for rigid motions are one; the bent ones are left out."""
    from scipy.spatial.transform import Rotation

    generator = np.random.default_rng(0)
    s = np.linspace(0.0, 20e-3, 101)
    rest = np.stack([s, 8.0 * s**2, 0.0 * s], axis=1)
    curves = []
    for i in range(30):
        bent = rest + np.outer(s**2, [0.0, 3.0 if i % 3 == 0 else 0.0, 0.0])
        # As wide as whiskers are moved: by azimuth, elevation and roll.
        angles = generator.uniform(-1.0, 1.0, 3) * [80.0, 40.0, 50.0]
        turn = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
        noise = generator.normal(0.0, 1e-6, rest.shape)
        curves.append(bent @ turn.T + generator.normal(size=3) + noise)
    shape = rest_shape(np.array(curves))
    np.testing.assert_array_equal(shape.free, np.arange(30) % 3 != 0)
    whisker = whisker_at_rest(shape)
    expected = 2.0 * 8.0 / (1.0 + (2.0 * 8.0 * 10e-3) ** 2) ** 1.5
    assert whisker.curvature(10e-3)[2] == pytest.approx(expected, rel=0.05)


def test_noisy_points_of_a_whisker_in_contact_most_of_the_time():
    """Straightened by a peg it keeps its shape near the turning point, to within the noise."""
    rng, s = np.random.default_rng(1), np.linspace(0.0, 25e-3, 101)
    azimuth = 0.6 * np.cos(np.linspace(-0.5 * np.pi, 0.5 * np.pi, 60))
    push = np.maximum(azimuth - 0.3, 0.0) / 0.3
    shapes = np.stack(np.broadcast_arrays(s, (10.0 - 9.0 * push[:, None]) * s**2, 0.0), axis=-1)
    held = base_rotation(azimuth, np.zeros(60), np.zeros(60))
    waves = np.cos(np.pi * np.outer(s / 25e-3, np.arange(6)))
    noise = 15e-6 * np.einsum("nk,tki->tni", waves, rng.normal(size=(60, 6, 3)))
    shape = rest_shape(np.einsum("tij,tnj->tni", held, shapes) + noise)
    assert shape.free[push == 0.0].all()
    assert not shape.free[push > 0.2].any()


def test_noisy_points_do_not_straighten_a_whisker():
    """Errors of separate points are averaged over the frames, unlike those of traces."""
    s = np.linspace(0.0, 32e-3, 33)
    points = np.stack([s, 5.0 * s**2, 0.0 * s], axis=-1)
    points += 18e-6 * np.random.default_rng(0).normal(size=points.shape)
    free = np.ones(40, dtype=bool)
    shape = RestShape(points, free, np.full(40, 70e-6), 70e-6, sparse=True)
    assert whisker_at_rest(shape).curvature(10e-3)[2] == pytest.approx(9.85, rel=0.1)


def test_the_rest_shape_ignores_where_hairs_let_a_trace_begin():
    """In two of three frames hairs hide 0.4 mm of a whisker that curves more and more."""
    rng, s = np.random.default_rng(2), np.linspace(0.0, 20e-3, 101)
    hidden = np.where(np.arange(90) < 30, 0.0, 0.4e-3)
    x = hidden[:, None] + s * (1.0 - hidden[:, None] / 20e-3)
    touched = np.arange(90) % 10 == 0
    shapes = np.stack([x, 600.0 * x**3 + 2.0 * touched[:, None] * x**2, 0.0 * x], axis=-1)
    held = base_rotation(0.8 * np.sin(np.linspace(0.0, np.pi, 90)), np.zeros(90), np.zeros(90))
    curves = np.einsum("tij,tnj->tni", held, shapes) + rng.normal(0.0, 2e-6, shapes.shape)
    np.testing.assert_array_equal(rest_shape(curves).free, ~touched)


@pytest.mark.parametrize(("share", "whole"), [(0.45, True), (0.3, False)])
def test_ends_that_scatter_are_tips_if_they_are_seen_often(share, whole):
    lengths = np.random.default_rng(0).normal(24e-3, 0.5e-3, 200)
    found, ends = length_shown(lengths, np.arange(200) < 200 * share)
    assert ends == whole
    assert found == pytest.approx(24.3e-3, rel=0.02)


@pytest.mark.parametrize("known", [False, True])
def test_fur_that_draws_a_base_aside_is_no_contact(known):
    """By up to 80 µm, over a few per cent of the length, as the whisker turns toward the fur."""
    rng, s = np.random.default_rng(5), np.linspace(0.0, 20e-3, 101)
    azimuth = 0.6 * np.sin(np.linspace(0.0, 4.0 * np.pi, 120))
    touched = (np.arange(120) >= 20) & (np.arange(120) < 30)
    shapes = np.stack(np.broadcast_arrays(s, (8.0 + 2.0 * touched[:, None]) * s**2, 0.0), axis=-1)
    shapes[..., 1] += 80e-6 * np.maximum(azimuth, 0.0)[:, None] / 0.6 * np.exp(-s / 0.3e-3)
    curves = np.einsum("tij,tnj->tni", base_rotation(azimuth, *np.zeros((2, 120))), shapes)
    curves += rng.normal(0.0, 1e-6, shapes.shape)
    whisker = Whisker.from_points(np.column_stack([s, 8.0 * s**2, 0.0 * s]), noise=0.0)
    found = known_rest(curves, whisker) if known else rest_shape(curves)
    np.testing.assert_array_equal(found.free, ~touched)


def test_a_whisker_that_rests_for_long_and_then_whisks_is_not_touched():
    """Errors of traces repeat while it rests; as it moves, they differ from frame to frame."""
    rng, s, rest = np.random.default_rng(3), np.linspace(0.0, 20e-3, 101), np.arange(150) < 100
    touched = (np.arange(150) >= 120) & (np.arange(150) < 135)
    bent = 8.0 + 2.0 * touched
    shapes = np.stack(np.broadcast_arrays(s, bent[:, None] * s**2, 0.0), axis=-1)
    azimuth = np.where(rest, 0.0, 0.5 * np.sin(np.linspace(-4.0 * np.pi, 2.0 * np.pi, 150)))
    held = base_rotation(azimuth, np.zeros(150), np.zeros(150))
    size = np.where(rest, 0.7e-6, 2.5e-6)[:, None, None]
    waves = np.cos(np.pi * np.outer(s / 20e-3, np.arange(4)))
    noise = size * np.einsum("nk,tki->tni", waves, rng.normal(size=(150, 4, 3)))
    curves = np.einsum("tij,tnj->tni", held, shapes) + noise
    np.testing.assert_array_equal(rest_shape(curves).free, ~touched)


def test_ringing_does_not_roll_the_base():
    # A curved whisker that whisks, and rings across its plane after each of four releases.
    rng, time, s = np.random.default_rng(4), np.arange(600) / 1000.0, np.linspace(0.0, 0.04, 81)
    rest = np.stack([s, 8.0 * s**2, 0.0 * s], axis=1)
    since = time % 0.15
    ringing = 3e-3 * np.exp(-since / 0.035) * np.cos(2.0 * np.pi * 55.0 * since)
    bend = (s / 0.04) ** 2
    shapes = rest + ringing[:, None, None] * bend[:, None] * [0.0, 0.5, 0.8]
    azimuth = 0.5 * np.sin(2.0 * np.pi * 5.0 * time)
    held = base_rotation(azimuth, 0.2 * azimuth, 0.3 * azimuth)
    noise = 10e-6 * rng.normal(size=(600, 3, 1, 3)) * np.array([1.0, 2.0, 3.0])[:, None, None]
    smooth = np.polynomial.polynomial.polyvander(s / 0.04, 2)
    curves = np.einsum("tij,tnj->tni", held, shapes) + np.einsum("nk,tkoi->tni", smooth, noise)
    shape = rest_shape(curves)
    whisker = whisker_at_rest(shape)
    turned = base_pose(curves, shape, whisker).rotation
    # The whisker's frame turns the rest shape in the frame that it is drawn in by the same always.
    mean = Rotation.from_matrix(np.swapaxes(held, 1, 2) @ turned).mean()
    away = (mean.inv() * Rotation.from_matrix(np.swapaxes(held, 1, 2) @ turned)).magnitude()
    assert np.median(np.rad2deg(away)) < 0.3
    assert np.quantile(np.rad2deg(away), 0.95) < 1.0
    assert shape.still.sum() < 0.7 * shape.free.sum()


def test_a_whisker_pressed_to_its_mirror_image_is_not_at_rest():
    """It slows down against an object in most frames, bent the other way as much as it curves."""
    from scipy.spatial.transform import Rotation

    azimuth = 0.8 * np.sin(np.linspace(0.0, np.pi, 90))
    s = np.linspace(0.0, 20e-3, 101)
    straightened = np.maximum(azimuth - 0.4, 0.0) / 0.4
    coefficient = 8.0 * (1.0 - 2.0 * straightened)
    curves = np.zeros((90, 101, 3))
    curves[..., 0], curves[..., 1] = s, coefficient[:, None] * s**2
    turn = Rotation.from_euler("z", azimuth[:, None]).as_matrix()
    noise = np.random.default_rng(0).normal(0.0, 1e-5, curves.shape)
    shape = rest_shape(np.einsum("tij,tnj->tni", turn, curves) + noise)
    assert (straightened > 0).mean() > 0.6
    clear = (straightened == 0) | (straightened > 0.2)
    np.testing.assert_array_equal(shape.free[clear], straightened[clear] == 0)


def test_the_rest_shape_of_a_whisker_whose_tip_is_mostly_hidden():
    """The frame that most others resemble may show less than the length that some show."""
    s = np.linspace(0.0, 1.0, 101)
    lengths = np.where(np.arange(60) % 10 == 0, 20e-3, 11e-3)
    noise = np.random.default_rng(0).normal(0.0, 1e-6, (60, 101, 3))
    along = lengths[:, None] * s
    curves = np.stack([along, 8.0 * along**2, 0.0 * along], axis=-1) + noise
    shape = rest_shape(curves, 0.9, lengths > 15e-3)
    assert shape.length == pytest.approx(20e-3, rel=0.05)
    assert shape.free.all()


def test_linear_algebra_does_not_wait_for_threads_of_its_own():
    """Where other work keeps cores busy, that took most of the time of following and fitting."""

    @without_blas_threads
    def used():
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    with threadpool_limits(2, user_api="blas"):
        assert used() == {1}
        assert used.__wrapped__() == {2}
    assert trace_video.__wrapped__
    assert track.__wrapped__


def test_options_can_be_sent_to_processes():
    assert pickle.loads(pickle.dumps(TrackOptions())) == TrackOptions()
