"""Whiskers that their own mass bends, by traces that no film was made for."""

import importlib
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import vibrissa as vb
from vibrissa.cameras import orthogonal_views
from vibrissa.evaluation import distances_from_curves, refine_curves
from vibrissa.objects import Peg
from vibrissa.simulation import Dynamics, simulate, whisking
from vibrissa.simulation.dynamics import resonances
from vibrissa.tracking import TrackOptions, rest_shape, track
from vibrissa.tracking.refine.inertia import _Swung, inertia_of
from vibrissa.tracking.refine.peg import UncertainPeg
from vibrissa.tracking.trace.trace import Trace

tracking = importlib.import_module("vibrissa.tracking.track")

RATE, FRAMES, DAMPING = 500.0, 90, 0.12
WHISKER = vb.Whisker.parabola(
    length=36e-3, coefficient=7.0, base_radius=90e-6, tip_radius=6e-6, youngs_modulus=3e9
)
POINTS, NOISE = 150, 0.02  # pixels
AWAY = Peg(np.array([90e-3, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), 1e-3)
NEAR = Peg(np.array([20e-3, 8e-3, 0.0]), np.array([0.0, 0.0, 1.0]), 1e-3)
OPTIONS = TrackOptions(properties={"base_radius": WHISKER.base_radius})


def whisked(peg, dynamics, sample=()):
    """Track the traces of a whisker that whisks near a peg; the recording, and the truth."""
    motion = whisking(
        FRAMES / RATE, RATE, frequency=9.0, amplitude=np.radians(24.0), set_point=np.radians(5.0)
    )
    truth = simulate(WHISKER, motion, peg, dynamics=dynamics)["truth"].to_dataset()
    lines = truth["centerline"].values[:, 0]
    share = np.linspace(0.0, 1.0, POINTS)
    lines = CubicSpline(np.linspace(0.0, 1.0, lines.shape[1]), lines, axis=1)(share)
    middle = 0.5 * (lines.min(axis=(0, 1)) + lines.max(axis=(0, 1)))
    views = orthogonal_views(90e-6, (500, 500), middle)
    # Errors of traces change slowly along them.
    waves = np.cos(np.pi * share * np.arange(6)[:, None])
    draw, sigma = np.random.default_rng(3), np.full(POINTS, NOISE)
    seen = np.ones(POINTS, dtype=bool)
    traces = [
        [
            Trace(line + NOISE * (draw.normal(size=(2, 6)) @ waves).T, sigma, seen, 1.0)
            for line in view.project(lines)
        ]
        for view in views
    ]
    found = track(views, [[one] for one in traces], RATE, OPTIONS, sample=sample)
    return found, truth.isel(whisker=0)


@pytest.fixture(scope="module")
def in_air():
    return whisked(AWAY, Dynamics(damping_ratio=DAMPING))


def test_a_whisker_that_whisks_in_air_touches_nothing(in_air):
    """Its inertia bends it by more than light contacts do."""
    found, _ = in_air
    root = found.to_dataset().isel(whisker=0)
    assert not root["in_contact"].any()
    assert np.nanmedian(root["trace_misfit"]) < 2.0
    assert "its inertia bends it" in found.attrs["remarks"]


def test_the_shape_of_a_whisker_in_air_is_that_which_is_seen(in_air):
    found, truth = in_air
    lines = found["centerline"].values[:, 0]
    away = distances_from_curves(lines, refine_curves(truth["centerline"].values))
    # The motion of the ends of the trial is not seen from both sides.
    assert np.median(away[5:-5]) < 10e-6


def test_mass_and_damping_of_a_whisker_are_those_of_its_motion(in_air):
    found, _ = in_air
    (remark,) = [line for line in found.attrs["remarks"].splitlines() if "its inertia" in line]
    scale = float(remark.split("stiffness is ")[1].split()[0])
    delay = 1e-3 * float(remark.split("its damping ")[1].split()[0])
    whole = resonances(WHISKER, Dynamics(damping_ratio=DAMPING), 1)[0]
    assert abs(scale - 1.0) < 0.25
    assert abs(delay - 2.0 * DAMPING / (2.0 * np.pi * whole)) < 0.5e-3


def test_contacts_of_a_whisker_with_mass_are_found():
    found, truth = whisked(NEAR, Dynamics(damping_ratio=DAMPING))
    root = found.to_dataset().isel(whisker=0)
    touched, true = root["in_contact"].values > 0, truth["in_contact"].values > 0
    assert true.sum() > 20
    assert (touched == true).mean() > 0.93
    both = touched & true
    away = np.linalg.norm(root["contact_point"] - truth["contact_point"], axis=-1)[both]
    assert np.median(away) < 0.2e-3


def test_a_peg_that_is_seen_is_where_inertia_has_contacts(monkeypatch):
    """Without what inertia adds to them, contacts of a whisker that rings are off the peg."""
    seen = UncertainPeg(NEAR, 1e-2 * np.eye(5))
    monkeypatch.setattr(tracking, "peg_in_images", lambda *_: seen)
    blank = [np.zeros((500, 500), dtype=np.uint8)]
    found, truth = whisked(NEAR, Dynamics(damping_ratio=DAMPING), sample=[blank, blank])
    root = found.to_dataset().isel(whisker=0)
    remarks = found.attrs["remarks"]
    assert "its inertia bends it" in remarks
    assert "touches a peg that both views show" in remarks
    both = (root["in_contact"].values > 0) & (truth["in_contact"].values > 0)
    assert both.sum() > 20
    points = root["contact_point"].values[both]
    assert np.median(np.linalg.norm(points - truth["contact_point"].values[both], axis=1)) < 60e-6
    away = np.abs(NEAR.signed_distance(points))
    assert np.quantile(away, 0.75) < 0.1e-3


def test_a_whisker_without_mass_is_not_bent_by_inertia():
    found, truth = whisked(NEAR, None)
    root = found.to_dataset().isel(whisker=0)
    assert "inertia" not in found.attrs.get("remarks", "")
    assert ((root["in_contact"] > 0) == (truth["in_contact"] > 0)).mean() > 0.97


def rotating(frames, rate):
    """Points (frame, node, 3) of a rigid whisker that swings about its base, m."""
    angle = 0.3 * np.sin(2.0 * np.pi * 10.0 * np.arange(frames) / rate)
    along = np.linspace(0.0, WHISKER.length, 40)
    toward = np.stack([np.cos(angle), np.sin(angle), np.zeros(frames)], axis=1)
    return along[:, None] * toward[:, None]


@pytest.mark.parametrize("frames", [12, 20])
def test_trials_shorter_than_the_time_over_which_motion_is_fitted_have_no_inertia(frames):
    def rest(*_):
        raise AssertionError

    curves = rotating(frames, 1e4)
    before = rest_shape(curves)
    assert inertia_of(curves, before, WHISKER, rest, 1e4, 90e-6, stated=True) is None


def test_shapes_that_do_not_fit_one_another_without_inertia_keep_it():
    """The rest shape may not be found where displacements are far too large."""
    curves, calls = rotating(60, 500.0), []

    def rest(shapes, errors):
        calls.append(shapes)
        raise ValueError("hardly any two frames show the whisker over the same length")

    before = replace(rest_shape(curves), deviation=np.full(len(curves), 1e-3))
    assert inertia_of(curves, before, WHISKER, rest, 500.0, 90e-6, stated=True) is None
    assert len(calls) == 1


@pytest.mark.parametrize(
    ("frequency", "amplitude", "rate", "peg"),
    [
        (19.0, 8.0, 300.0, (19.1, 1.5)),
        (12.0, 11.0, 300.0, (24.8, 3.1)),
        (17.0, 16.0, 500.0, (17.1, -0.9)),
    ],
)
def test_contacts_most_of_the_time_are_not_inertia(frequency, amplitude, rate, peg):
    """They bend a whisker in step with its acceleration, or with its velocity."""
    motion = whisking(
        2.5 / frequency,
        rate,
        frequency=frequency,
        amplitude=np.radians(amplitude),
        set_point=np.radians(5.0),
    )
    peg = Peg(1e-3 * np.array([*peg, 0.0]), np.array([0.0, 0.0, 1.0]), 0.5e-3)
    truth = simulate(WHISKER, motion, peg)["truth"].to_dataset().isel(whisker=0)
    lines, share = truth["centerline"].values, np.linspace(0.0, 1.0, 40)
    curves = CubicSpline(np.linspace(0.0, 1.0, lines.shape[1]), lines, axis=1)(share)
    waves = np.cos(np.pi * share * np.arange(6)[:, None])
    draw = np.random.default_rng(3).normal(size=(len(curves), 6, 3))
    curves += 2e-6 * np.einsum("tkd,kn->tnd", draw, waves)
    assert (truth["in_contact"] > 0).mean() > 0.65

    def rest(shapes, _):
        return rest_shape(shapes)

    before = rest_shape(curves)
    assert inertia_of(curves, before, WHISKER, rest, rate, 90e-6, stated=True) is None


@pytest.mark.parametrize("lost", [slice(50, 51), slice(50, 57), slice(0, 5), slice(50, 75, 8)])
def test_lost_frames_do_not_accelerate_a_whisker(lost):
    rate, seen = 1000.0, np.ones(120, dtype=bool)
    curves = rotating(120, rate)
    whole = _Swung.of(curves, seen, WHISKER, rate, 1e-6).by_mass
    seen[lost] = False
    curves[lost] = np.nan
    with_lost = _Swung.of(curves, seen, WHISKER, rate, 1e-6).by_mass
    assert np.abs(with_lost - whole)[seen].max() < 0.15 * np.abs(whole).max()
