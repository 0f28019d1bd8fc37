"""A free whisker's own mass, against the nonlinear chain that is stepped in time."""

import numpy as np
import pytest
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli.app import app
from vibrissa.objects import Peg
from vibrissa.sensors import FORCE_NOISE, MOMENT_NOISE, component_noise
from vibrissa.simulation import (
    Dynamics,
    Vibration,
    facing_peg,
    fit_dynamics,
    measure,
    resonances,
    simulate,
    sweep_past,
)
from vibrissa.simulation.vibration import _Free, _Model

NOISE = component_noise(FORCE_NOISE, MOMENT_NOISE)


@pytest.fixture(scope="module")
def whisker():
    return vb.Whisker.straight(30e-3, base_radius=80e-6, youngs_modulus=3.5e9)


def measured(trial):
    """Time, wrench and pose of the base."""
    data = trial.to_dataset().isel(whisker=0)
    wrench = np.concatenate([data.force.values, data.moment.values], axis=1)
    return data.time.values, wrench, data.base_rotation.values, data.base_position.values


@pytest.fixture(scope="module")
def in_air(whisker):
    motion = sweep_past(whisker, facing_peg(whisker, 0.6), 0.2, 1000.0, seed=3, frequency=6.0)
    away = Peg(origin=np.array([1.0, 1.0, 0.0]), axis=np.array([0.0, 0.0, 1.0]), radius=1e-3)
    return simulate(whisker, motion, away, dynamics=Dynamics(step=2e-4), nodes=9)


TRUE = Dynamics(
    density=tuple(0.85 * value for value in Dynamics().density), damping_ratio=0.12, step=2e-4
)


@pytest.fixture(scope="module")
def past_peg(whisker):
    peg = facing_peg(whisker, 0.6)
    motion = sweep_past(whisker, peg, 0.25, 1000.0, seed=5, frequency=6.0)
    return measure(simulate(whisker, motion, peg, dynamics=TRUE, nodes=9), seed=5)


@pytest.mark.slow
def test_whisking_in_air_is_predicted(whisker, in_air):
    trial, dynamics = in_air, Dynamics()
    truth = trial["truth"].to_dataset().isel(whisker=0)
    time, _, rotation, position = measured(measure(trial, seed=1))
    predicted = Vibration.of(whisker, dynamics).in_air(time, rotation, position)
    for known, part in (
        (truth.force.values, predicted[:, :3]),
        (truth.moment.values, predicted[:, 3:]),
    ):
        left = np.linalg.norm((part - known)[20:], axis=1)
        assert np.median(left) < 0.1 * np.median(np.linalg.norm(known, axis=1))


@pytest.mark.slow
@pytest.mark.parametrize("assumed", [pytest.param(1.0, marks=pytest.mark.slow), 1.3])
def test_contact_is_distinguished_from_inertia_with_a_wrong_mass(whisker, past_peg, assumed):
    trial = past_peg
    touching = trial["truth"].to_dataset().isel(whisker=0).in_contact.values.astype(bool)
    time, wrench, rotation, position = measured(trial)
    dynamics = Dynamics(density=tuple(assumed * value for value in Dynamics().density))
    vibration = Vibration.of(whisker, dynamics)
    found = vibration.contact_probability(time, wrench, rotation, position, NOISE) > 0.5
    bare = np.hypot(wrench[:, 4], wrench[:, 5]) > 5.0 * 2e-8
    assert np.mean(bare[~touching]) > 0.3
    # A contact that begins or ends between two frames may be called either in both.
    about = np.convolve(touching, np.ones(3), "same") > 0
    assert not found[~about].any()
    assert np.mean(found[~touching]) < 0.02
    assert np.mean(found[touching]) > 0.98


def test_quiet_and_constant_wrenches_are_free_and_in_contact(whisker):
    # The sensor's noise alone, then a moment that vibration about zero does not imitate.
    rng, time = np.random.default_rng(2), 1e-3 * np.arange(120)
    wrench = rng.normal(size=(120, 6)) * np.repeat([1e-6, 2e-8], 3)
    touching = time >= 0.06
    wrench[touching] += [2e-6, 8e-6, 0.0, 0.0, 0.0, 1.5e-7]
    still = np.broadcast_to(np.eye(3), (120, 3, 3)), np.zeros((120, 3))
    found = Vibration.of(whisker).contact_probability(time, wrench, *still, NOISE) > 0.5
    np.testing.assert_array_equal(found, touching)


def test_ringing_gives_mass_resonances_and_damping(whisker, past_peg):
    # The whisker does not move along with its base before the first frames.
    fit = fit_dynamics(whisker, *(x[20:] for x in measured(past_peg)), NOISE, stiffness_sigma=0.05)
    known = (TRUE.density[0], resonances(whisker, TRUE)[0], TRUE.damping_ratio)
    found = (fit.dynamics.density[0], fit.resonances[0], fit.dynamics.damping_ratio)
    away = np.log(np.divide(found, known))
    deviation = np.sqrt(np.diag(fit.covariance))
    assert (np.abs(away) < [0.1, 0.04, 0.3]).all()
    assert (np.abs(away[:2]) < 3.0 * deviation[:2]).all()


@pytest.mark.slow
def test_a_recording_states_its_own_dynamics_and_its_contacts(past_peg, tmp_path):
    trial = past_peg.isel(time=slice(20, None))
    vb.io.save_recording(path := tmp_path / "trial.nc", trial)
    table = tmp_path / "contacts.csv"
    command = ["signals", str(path), "--inertia", "--fit-dynamics", "--events", str(table)]
    done = CliRunner().invoke(app, command, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    about = vb.load_recording(path)["signals"].attrs
    assert abs(about["density"][0] / TRUE.density[0] - 1.0) < 0.15
    assert abs(about["damping_ratio"] / TRUE.damping_ratio - 1.0) < 0.3
    rows = [line.split(",") for line in table.read_text().splitlines()[1:]]
    found = np.array([[float(cell) for cell in row[1:3]] for row in rows])
    truth = trial["truth"].to_dataset().isel(whisker=0)
    touching = np.flatnonzero(np.diff(truth.in_contact.values.astype(int)))
    known = truth.time.values[touching + 1].reshape(-1, 2)
    assert len(found) == len(known)
    np.testing.assert_allclose(found, known, atol=3.1e-3)


@pytest.mark.slow
def test_what_is_not_determined_is_stated(whisker, in_air):
    air = [x[25:] for x in measured(measure(in_air, seed=1))]
    with pytest.raises(ValueError, match="damping"):
        fit_dynamics(whisker, *air, NOISE)
    with pytest.raises(ValueError, match=r"no window of .* without contact"):
        fit_dynamics(whisker, *(x[:9] for x in air), NOISE)


def test_a_contact_begins_where_the_whisker_deviates_from_free_vibration(whisker):
    vibration = Vibration.of(whisker)
    model = _Model.of(vibration, 1e-3, NOISE, np.zeros(6))
    size = len(model.step)
    free = _Free(np.zeros(1, int), np.zeros((1, size)), 0.1 * np.eye(size)[None], np.zeros(1))
    free.state[0, :4] = 60.0, 10.0, -40.0, 30.0
    expected = model.wrench @ free.state[0, : model.wrench.shape[1]]
    likelihoods = []
    for deviation in (0.0, 100.0):
        measured = expected + deviation * np.eye(5)[4]
        _, still, begins = free.observed(model, measured, np.zeros(5))
        likelihoods.append(float((begins - still)[0]))
    assert likelihoods[0] < -3.0
    assert likelihoods[1] > 1.0


def test_a_model_error_is_expected_to_persist(whisker):
    model = _Model.of(Vibration.of(whisker), 1e-3, NOISE, np.zeros(6))
    size = len(model.step)
    free = _Free(np.zeros(1, int), np.zeros((1, size)), np.zeros((1, size, size)), np.zeros(1))
    free.state[0, :4] = 60.0, 10.0, -40.0, 30.0
    deviation = np.array([20.0, 0.0, 0.0, 0.0, 0.0])
    found = []
    for _ in range(3):
        free = free.predicted(model)
        expected = model.wrench @ free.state[0, : model.wrench.shape[1]]
        free, likelihood, _ = free.observed(model, expected + deviation, np.zeros(5))
        found.append(likelihood[0])
    assert found[1] > found[0] + 0.5
    assert found[2] > found[0] + 0.5


@pytest.mark.slow
def test_strong_vibration_of_a_slow_whisker_is_not_contact():
    shape = {"base_radius": 115e-6, "tip_radius": 29e-6, "youngs_modulus": 2.5e9}
    slow = vb.Whisker.parabola(43e-3, 9.0, **shape)
    peg = facing_peg(slow, 0.74, 0.36e-3)
    motion = sweep_past(slow, peg, 0.3, 1000.0, seed=5, frequency=9.2)
    density = tuple(1.2 * value for value in Dynamics().density)
    dynamics = Dynamics(density=density, damping_ratio=0.103, step=2e-4)
    trial = measure(simulate(slow, motion, peg, dynamics=dynamics, nodes=9), 3e-6, 6e-8, seed=5)
    touching = trial["truth"].to_dataset().isel(whisker=0).in_contact.values.astype(bool)
    found = Vibration.of(slow).contact_probability(*measured(trial), 9.0 * NOISE) > 0.5
    about = np.convolve(touching, np.ones(5), "same") > 0
    assert np.mean(found[~about]) < 0.1
    assert np.mean(found[touching]) > 0.7
