"""A free whisker's own mass, against the nonlinear chain that is stepped in time."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.objects import Peg
from vibrissa.simulation import Dynamics, Vibration, facing_peg, measure, simulate, sweep_past


@pytest.fixture(scope="module")
def whisker():
    return vb.Whisker.straight(30e-3, base_radius=80e-6, youngs_modulus=3.5e9)


def measured(trial):
    """Time, wrench and pose of the base."""
    data = trial.to_dataset().isel(whisker=0)
    wrench = np.concatenate([data.force.values, data.moment.values], axis=1)
    return data.time.values, wrench, data.base_rotation.values, data.base_position.values


def test_whisking_in_air_is_predicted(whisker):
    dynamics = Dynamics(step=2e-4)
    motion = sweep_past(whisker, facing_peg(whisker, 0.6), 0.2, 1000.0, seed=3, frequency=6.0)
    away = Peg(origin=np.array([1.0, 1.0, 0.0]), axis=np.array([0.0, 0.0, 1.0]), radius=1e-3)
    trial = simulate(whisker, motion, away, dynamics=dynamics, nodes=9)
    truth = trial["truth"].to_dataset().isel(whisker=0)
    time, _, rotation, position = measured(measure(trial, seed=1))
    predicted = Vibration.of(whisker, dynamics).in_air(time, rotation, position)
    for known, part in (
        (truth.force.values, predicted[:, :3]),
        (truth.moment.values, predicted[:, 3:]),
    ):
        left = np.linalg.norm((part - known)[20:], axis=1)
        assert np.median(left) < 0.1 * np.median(np.linalg.norm(known, axis=1))


def test_contact_is_distinguished_from_inertia_with_a_wrong_mass(whisker):
    density = tuple(0.85 * value for value in Dynamics().density)
    dynamics = Dynamics(density=density, damping_ratio=0.12, step=2e-4)
    peg = facing_peg(whisker, 0.6)
    motion = sweep_past(whisker, peg, 0.25, 1000.0, seed=5, frequency=6.0)
    trial = measure(simulate(whisker, motion, peg, dynamics=dynamics, nodes=9), seed=5)
    touching = trial["truth"].to_dataset().isel(whisker=0).in_contact.values.astype(bool)
    time, wrench, rotation, position = measured(trial)
    found = Vibration.of(whisker).in_contact(time, wrench, rotation, position, 2e-8)
    bare = np.hypot(wrench[:, 4], wrench[:, 5]) > 5.0 * 2e-8
    assert np.mean(bare[~touching]) > 0.3
    assert np.mean(found[~touching]) < 0.05
    assert np.mean(found[touching]) > 0.97
