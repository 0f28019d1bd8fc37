"""Sensor signals without inertia, against the nonlinear chain that is stepped in time."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import vibrissa as vb
from vibrissa.contour import axis_offset
from vibrissa.pipeline import (
    estimates_of,
    predictors,
    reconstruct,
    signals_of,
    with_estimates,
    with_signals,
)
from vibrissa.recording import Recording
from vibrissa.simulation import (
    Dynamics,
    facing_peg,
    inertial_wrench,
    measure,
    simulate,
    sweep_past,
)

WHISKER = vb.Whisker.straight(30e-3, base_radius=80e-6, youngs_modulus=3.5e9)
TRUE = Dynamics(
    density=tuple(0.85 * value for value in Dynamics().density), damping_ratio=0.12, step=2e-4
)


def whisked(duration, dynamics=TRUE):
    peg = facing_peg(WHISKER, 0.5, 0.7e-3)
    motion = sweep_past(WHISKER, peg, duration, 1000.0, seed=5, frequency=8.0)
    return simulate(WHISKER, motion, peg, dynamics=dynamics, nodes=9)


@pytest.fixture(scope="module")
def trial():
    return whisked(0.16)


@pytest.fixture(scope="module")
def truth(trial):
    return trial["truth"].to_dataset().isel(whisker=0)


def settled(touching):
    """Frames in contact for 8 ms and more, and for 2 ms more."""
    return np.array([touching[max(i - 8, 0) : i + 3].all() and i > 8 for i in range(len(touching))])


def around_whisker(truth):
    """Unit vectors normal to the whisker and to the object at the contact."""
    nodes = np.linspace(0.0, WHISKER.length, truth.sizes["node"])
    line = CubicSpline(nodes, truth.centerline.values, axis=1)
    tangent = [line(s, 1)[i] for i, s in enumerate(truth.arc_length.values)]
    out = np.cross(tangent, truth.surface_normal.values)
    return out / np.linalg.norm(out, axis=1, keepdims=True)


@pytest.mark.slow
def test_what_is_left_is_the_wrench_of_a_rod_without_mass(trial, truth):
    touching = truth.in_contact.values.astype(bool)
    root = trial.to_dataset().isel(whisker=0)
    points = np.where(touching[:, None], truth.contact_point.values, np.nan)
    added, change = inertial_wrench(
        WHISKER,
        TRUE,
        root.time.values,
        root.base_rotation.values,
        root.base_position.values,
        points,
        truth.arc_length.values,
    )
    rows = settled(touching)
    bent = vb.deflect(WHISKER, vb.PointContact(truth.contact_point_whisker.values[rows]))
    for name, part in (("force", added[rows, :3]), ("moment", added[rows, 3:])):
        known, measured = getattr(bent, name), truth[name].values[rows]
        away = np.linalg.norm(measured - known, axis=1)
        left = np.linalg.norm(measured - part - known, axis=1)
        assert np.nanmedian(left) < 0.25 * np.nanmedian(away)
    # The massless rod's force is not normal to the object; the change leads to one that is.
    about = around_whisker(truth)[rows]
    turns = root.base_rotation.values[rows]
    oblique = [
        np.nanmedian(np.abs(np.einsum("ti,tij,tj->t", about, turns, force)))
        for force in (bent.force, bent.force + change[rows])
    ]
    assert oblique[1] < 0.3 * oblique[0]


@pytest.mark.slow
def test_normals_and_the_peg_are_as_near_as_stated(trial, truth):
    done = with_signals(measure(trial, 1e-6, 2e-8, seed=5), "sensor", dynamics=Dynamics())
    done = with_estimates(done, "wrench")
    found = done["estimates"].to_dataset().isel(whisker=0)
    away = found.contact_normal.values - truth.surface_normal.values
    covariance = found.normal_covariance.values
    rows = settled(truth.in_contact.values.astype(bool)) & np.isfinite(away).all(axis=1)
    about = around_whisker(truth)
    deviation = np.sqrt(np.einsum("ti,tij,tj->t", about, covariance, about))
    assert np.median(np.abs((away * about).sum(axis=1) / deviation)[rows]) < 1.0
    # Frames near onset and release, in which a contact may be anywhere, do not spoil the fit.
    peg = Recording(done).pegs[0]
    fit = reconstruct(done, lean=0.0)
    offset, tilt = axis_offset(fit.object_position, fit.object_axis, peg.origin, peg.axis)
    assert np.linalg.norm(offset) < 0.1e-3
    assert np.degrees(tilt) < 2.0
    # Mass and damping are wrong in all frames alike.
    covariance = fit.parameter_covariance.values
    away = fit.object_axis.values - peg.axis * np.sign(fit.object_axis.values @ peg.axis)
    across = np.linalg.svd(peg.axis[None])[2][1:]
    spread = across @ covariance[3:6, 3:6] @ across.T
    assert across @ away @ np.linalg.solve(spread, across @ away) < 12.0
    assert abs(fit.object_radius - peg.radius) < 3.0 * np.sqrt(covariance[6, 6])
    shared = found.contact_inertia.values[rows][:, :, :3]
    own = found.contact_covariance.values[rows] - np.einsum("tei,tej->tij", shared, shared)
    assert (np.linalg.eigvalsh(own)[:, 0] > -1e-16).all()


@pytest.mark.slow
def test_contacts_are_as_near_as_stated_with_a_wrong_mass(trial, truth):
    measured = measure(trial, 0.3e-6, 6e-9, seed=5)
    errors, stated = [], []
    for dynamics in (None, Dynamics()):
        done = with_signals(measured, "sensor", dynamics=dynamics)
        assert done["signals"]["force"].attrs["units"] == "N"
        found = estimates_of(done, "wrench").isel(whisker=0)
        away = found.contact_point_whisker.values - truth.contact_point_whisker.values
        rows = settled(truth.in_contact.values.astype(bool))
        errors.append(np.nanmedian(np.linalg.norm(away[rows], axis=1)))
        spread = np.einsum("tii->t", found.covariance.values[rows])
        stated.append(np.sqrt(np.nanmedian(spread)))
    touching = truth.in_contact.values.astype(bool)
    located = touching & np.isfinite(away).all(axis=1)
    assert located.sum() > 0.95 * touching.sum()
    # Also next to onsets and releases, where the covariance is large.
    whitened = np.linalg.solve(found.covariance.values[located], away[located][..., None])[..., 0]
    inside = (away[located] * whitened).sum(axis=1) < 7.8
    assert np.mean(inside) > 0.85
    assert errors[0] > 2.0 * stated[0]
    assert errors[1] < 0.6 * errors[0]
    assert errors[1] < 1.3 * stated[1]


def test_frames_that_are_not_equally_spaced_are_refused():
    trial = whisked(0.02)
    gap = measure(trial).isel(time=[*range(9), *range(11, 20)])
    with pytest.raises(ValueError, match="equal"):
        signals_of(gap, "sensor", dynamics=Dynamics())
    with pytest.raises(ValueError, match="sensor"):
        signals_of(trial, "contact point", dynamics=Dynamics())


def test_a_trial_without_inertia_has_none_to_remove():
    plain = measure(whisked(0.02, dynamics=None))
    with pytest.raises(ValueError, match="without inertia"):
        signals_of(plain, "sensor", dynamics=Dynamics())


def test_the_probability_of_contact_accompanies_the_flag():
    trial = measure(whisked(0.12), seed=1)
    trial["force"][5] = np.nan
    done = with_signals(trial, "sensor", dynamics=Dynamics())
    found, table = done["signals"], predictors(done)
    probability = found["contact_probability"].values[:, 0]
    np.testing.assert_array_equal(table["contact_probability"].values[:, 0], probability)
    known = np.isfinite(probability)
    assert np.flatnonzero(~known).tolist() == [5]
    flagged = found["in_contact"].values[:, 0].astype(bool)
    assert 0 < flagged.sum() < flagged.size
    np.testing.assert_array_equal(flagged[known], probability[known] > 0.5)
