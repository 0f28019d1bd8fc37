"""A contact followed over time: right among candidates, as sure as stated, from few signals too."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vibrissa as vb
from vibrissa.sensors import Sensor
from vibrissa.simulation import facing_peg, simulate, sweep_past

SIGMA = np.repeat([1e-6, 2e-8], 3)


@pytest.fixture(scope="module")
def curved():
    """A strongly curved whisker, on which triplets are ambiguous, and a sweep past a peg."""
    whisker = vb.Whisker.parabola(40e-3, 0.82 / 40e-3)
    peg = facing_peg(whisker)
    trial = simulate(whisker, sweep_past(whisker, peg, 0.6, 500.0, frequency=2.0), peg)
    return vb.ContactMap.simulate(whisker, grid=False), trial


def followed(contacts, trial, names, seed, **how):
    """Errors, their χ², and how often the first and the filter's candidate are the right one."""
    truth, top = trial["truth"].to_dataset(), trial.to_dataset()
    force, moment, point = (
        truth[name].values[:, 0] for name in ("force", "moment", "contact_point")
    )
    pose = truth if "base_rotation" in truth else top
    turn, base = (pose[name].values[:, 0] for name in ("base_rotation", "base_position"))
    noise = SIGMA * np.random.default_rng(seed).normal(size=(len(force), 6))
    wrench = np.concatenate([force, moment], axis=1) + noise
    signals = vb.base_signals(wrench[:, :3], wrench[:, 3:])
    rows = np.stack([signals[name] for name in names.split()], axis=-1)
    estimator = vb.Estimator(contacts, names, np.diag(SIGMA**2), felt_above=5.0)
    follow = vb.ContactFilter(estimator, **(how or {"speed": 0.1, "persistence": 0.01}))
    squares, first, ours, surely_wrong, seen = [], [], [], 0, 0
    for i, time in enumerate(top.time.values):
        known = follow(time, rows[i], turn[i], base[i])
        if not (np.isfinite(known.point).all() and np.isfinite(point[i]).all()):
            continue
        seen += 1
        away = known.point - point[i]
        squares.append(away @ np.linalg.solve(known.covariance, away))
        surely_wrong += known.probability > 0.99 and squares[-1] > 30.0
        candidates = known.located.candidates.point @ turn[i].T + base[i]
        if len(candidates) > 1:
            right = np.linalg.norm(candidates - point[i], axis=1).argmin()
            first.append(right == 0)
            ours.append(right == np.linalg.norm(candidates - known.point, axis=1).argmin())
    return np.array(squares), np.array(first), np.array(ours), surely_wrong / seen


@pytest.mark.parametrize(
    ("names", "several"), [("Fx FT MD", 60), ("FT FD MB", 60), ("FT MB MD", 60), ("Fx MB MD", 15)]
)
def test_the_right_one_of_several_contacts_is_followed_as_surely_as_said(curved, names, several):
    """More often than the contact of least force; the error has χ² of three degrees of freedom."""
    runs = [followed(*curved, names, seed) for seed in range(3)]
    squares, first, ours = (np.concatenate([run[i] for run in runs]) for i in range(3))
    assert len(first) > several
    assert ours.mean() >= first.mean()
    assert ours.mean() > 0.75
    if several == 60:
        assert ours.mean() > 0.9
        assert (1.0 - ours.mean()) < 0.6 * (1.0 - first.mean())
    assert len(squares) > 180
    assert 1.5 < squares.mean() < 4.5
    assert np.mean(squares > 7.81) < 0.12  # 5 % in theory
    assert np.mean([run[3] for run in runs]) < 0.01


@pytest.mark.parametrize("names", ["Fx MB MD", "FT FD MB"])
def test_a_contact_that_slides_is_followed_as_surely_as_stated_by_default(curved, names):
    """The peg is at rest, but without friction the contact slides along it at 2 L/s."""
    squares = np.concatenate([followed(*curved, names, s, persistence=0.05)[0] for s in range(3)])
    assert len(squares) > 180
    assert 1.8 < squares.mean() < 4.2
    assert np.mean(squares > 7.81) < 0.12  # 5 % in theory


@pytest.fixture(scope="module")
def wire():
    whisker = vb.Whisker.straight(
        0.3, base_radius=0.5e-3, tip_radius=0.25e-3, youngs_modulus=200e9, poisson_ratio=0.29
    )
    return vb.ContactMap.simulate(whisker, grid=False)


def swaying(whisker, point, time, share=1.0):
    """A base that turns and travels while the whisker touches one point of the laboratory."""
    turn = Rotation.from_euler("z", share * 0.1 * np.sin(6.28 * time)[:, None]).as_matrix()
    base = np.stack([0.02 * np.sin(9.4 * time), 0.0 * time, 0.005 * np.sin(4.4 * time)], axis=-1)
    base *= share
    bent = vb.deflect(whisker, vb.PointContact(np.einsum("tji,tj->ti", turn, point - base)))
    assert (bent.status == vb.Status.OK).all()
    return turn, base, np.concatenate([bent.force, bent.moment], axis=1)


@pytest.mark.slow
def test_two_moments_and_a_moving_base_locate_a_contact(wire):
    time, point = np.arange(0.0, 0.6, 0.005), np.array([0.18, 0.03, 0.01])
    turn, base, wrench = swaying(wire.whisker, point, time)
    sensor = Sensor(("My", "Mz"), noise=2e-4)
    squares, last = [], []
    for seed in range(3):
        readings = sensor.read(time, wrench, seed)
        estimator = vb.Estimator.of_sensor(wire, sensor, felt_above=5.0)
        follow = vb.ContactFilter(estimator, speed=0.01, persistence=0.1)
        errors = []
        for i, reading in enumerate(readings):
            known = follow(time[i], reading, turn[i], base[i])
            away = known.point - point
            errors.append(np.linalg.norm(away))
            squares.append(away @ np.linalg.solve(known.covariance, away))
        assert errors[0] > 0.03  # one sample leaves a curve
        last.append(errors[-1])
    assert max(last) < 0.012
    assert 1.0 < np.mean(squares) < 5.0


def test_two_moments_of_a_base_that_hardly_moves_are_as_uncertain_as_stated(wire):
    """A speed above the true one, or long Gaussians on bent curves, draw contacts to the tip."""
    time, point = np.arange(0.0, 0.4, 0.005), np.array([0.18, 0.03, 0.01])
    turn, base, wrench = swaying(wire.whisker, point, time, share=0.2)
    sensor = Sensor(("My", "Mz"), noise=2e-4)
    estimator = vb.Estimator.of_sensor(wire, sensor, felt_above=5.0)
    squares, last = [], []
    for seed in range(3):
        follow = vb.ContactFilter(estimator)
        for i, reading in enumerate(sensor.read(time, wrench, seed)):
            known = follow(time[i], reading, turn[i], base[i])
            away = known.point - point
            squares.append(away @ np.linalg.solve(known.covariance, away))
        last.append(np.linalg.norm(away))
    assert np.mean(squares) < 4.5  # 3 in theory
    assert np.mean(np.array(squares) > 7.81) < 0.12
    assert max(last) < 0.04
    assert known.status in (vb.Status.UNIQUE, vb.Status.AMBIGUOUS)
    assert vb.ContactFilter(estimator)(0.0, reading).status == vb.Status.UNDERDETERMINED


def test_a_contact_at_rest_is_averaged_by_default(wire):
    """A filter that finds the speed is as exact as one for which contacts hardly move."""
    time, point = np.arange(0.0, 0.3, 0.005), np.array([0.18, 0.03, 0.01])
    turn, base, wrench = swaying(wire.whisker, point, time)
    noise = np.repeat([1e-3, 1e-4], 3)
    errors = {None: [], 0.015: [], 1.25: []}
    estimator = vb.Estimator.of_sensor(wire, Sensor(noise=noise), felt_above=5.0)
    for seed in range(4):
        seen = wrench + noise * np.random.default_rng(seed).normal(size=wrench.shape)
        for how, out in errors.items():
            follow = vb.ContactFilter(estimator, speed=how)
            for i in range(len(time)):
                known = follow(time[i], seen[i], turn[i], base[i])
                if i >= 20:
                    out.append(np.linalg.norm(known.point - point))
                assert known.probability > 0.99 or i < 3
                assert len(known.points) < 6  # at most one of each speed: one contact
    late = {how: np.median(out) for how, out in errors.items()}
    assert late[None] < late[0.015]
    assert late[None] < 0.7 * late[1.25]


@pytest.mark.slow
def test_an_uncertain_stiffness_is_not_averaged_away(wire):
    """A whisker 3 % stiffer than its map, or softer: the same error in all samples."""
    time, point = np.arange(0.0, 0.2, 0.005), np.array([0.18, 0.03, 0.01])
    turn, base, wrench = swaying(wire.whisker, point, time)
    noise = np.repeat([1e-4, 1e-5], 3)
    squares = {0.03: [], 0.0: []}
    for seed in range(10):
        rng = np.random.default_rng(seed)
        seen = (1.0 + 0.03 * rng.normal()) * wrench + noise * rng.normal(size=wrench.shape)
        signals = vb.base_signals(seen[:, :3], seen[:, 3:])
        rows = np.stack([signals[name] for name in ("Fx", "MB", "MD")], axis=-1)
        for stiffness, out in squares.items():
            estimator = vb.Estimator(wire, "Fx MB MD", np.diag(noise**2), stiffness)
            follow = vb.ContactFilter(estimator, speed=0.01, persistence=0.1)
            for i in range(len(time)):
                known = follow(time[i], rows[i], turn[i], base[i])
            away = known.point - point
            out.append(away @ np.linalg.solve(known.covariance, away))
    assert 1.0 < np.mean(squares[0.03]) < 7.0
    assert np.median(squares[0.0]) > 20.0


def test_a_filter_forgets_a_contact_that_is_lost_and_waits_for_what_is_missing(wire):
    time, point = np.arange(0.0, 0.05, 0.005), np.array([0.18, 0.03, 0.01])
    turn, base, wrench = swaying(wire.whisker, point, time)
    estimator = vb.Estimator.of_sensor(
        wire, Sensor(noise=np.repeat([1e-3, 1e-4], 3)), felt_above=5.0
    )
    follow = vb.ContactFilter(estimator, speed=0.01)
    good = follow(time[0], wrench[0], turn[0], base[0])
    assert good.status == vb.Status.UNIQUE
    np.testing.assert_allclose(
        turn[0] @ good.point_whisker + base[0], good.point, rtol=1e-12, atol=1e-15
    )
    unknown = good.located._found._replace(covariances=np.full((1, 1, 3, 3), np.nan))
    nowhere = replace(good.located, _found=unknown)
    there = np.r_[np.zeros(3), good.located.point / 0.3][None]
    assert follow._unaccounted(there, nowhere, turn[0], base[0] / 0.3).tolist() == [False]
    wrong = vb.ContactFilter(estimator, speed=0.01)  # a reaction: all signs are the others
    strange = [wrong(time[i], -wrench[i], turn[i], base[i]).status for i in range(3)]
    assert set(strange) <= {vb.Status.NOT_FRICTIONLESS, vb.Status.OUTSIDE_MAP}
    missing = follow(time[1], np.full(6, np.nan), turn[1], base[1])
    assert missing.status == vb.Status.MISSING
    assert np.linalg.norm(missing.point - good.point) < 1e-3
    assert np.trace(missing.covariance) > np.trace(good.covariance)
    lost = follow(time[1] + 1e-3, wrench[1], np.full((3, 3), np.nan), base[1])
    assert lost.status == vb.Status.MISSING
    assert np.linalg.norm(lost.point - good.point) < 1e-3
    gone = follow(time[2], np.zeros(6), turn[2], base[2])
    assert gone.status == vb.Status.NOT_FELT
    assert np.isnan(gone.point).all()
    again = follow(time[3], wrench[3], turn[3], base[3])
    assert np.linalg.norm(again.point - point) < 0.01
    with pytest.raises(ValueError, match="time is a finite number, s"):
        follow(np.datetime64("2026-01-01T00:00:01"), wrench[3], turn[3], base[3])
    with pytest.raises(ValueError, match="time is a finite number, s"):
        follow(wrench[3], time[3], turn[3], base[3])
    with pytest.raises(ValueError, match="times must increase"):
        follow(time[3], wrench[3], turn[3], base[3])
    with pytest.raises(ValueError, match="finite"):
        follow(np.nan, wrench[3], turn[3], base[3])
    after_a_gap = follow(time[3] + 1e4, wrench[4], turn[4], base[4])
    assert np.linalg.norm(after_a_gap.point - point) < 0.01
    heavy = Sensor(noise=np.repeat([1e-3, 1e-4], 3), mass=1e-3)
    with pytest.raises(ValueError, match="the rotation from whisker to laboratory is needed"):
        vb.ContactFilter(vb.Estimator.of_sensor(wire, heavy))(0.0, wrench[0], position=base[0])
    with pytest.raises(ValueError, match="needs an estimator with noise"):
        vb.ContactFilter(vb.Estimator(wire))
    with pytest.raises(ValueError, match="between 0 and 1"):
        vb.ContactFilter(estimator, birth=2.0)


def test_times_in_ms_and_positions_in_mm_are_questioned(wire):
    time, point = np.arange(0.0, 0.05, 0.005), np.array([0.18, 0.03, 0.01])
    turn, base, wrench = swaying(wire.whisker, point, time)
    estimator = vb.Estimator.of_sensor(
        wire, Sensor(noise=np.repeat([1e-3, 1e-4], 3)), felt_above=5.0
    )

    def follow(times, bases):
        filtered = vb.ContactFilter(estimator)
        for each in zip(times, wrench, turn, bases, strict=True):
            filtered(*each)

    follow(time, base)  # in s and m, without a warning
    with pytest.warns(UserWarning, match="are their times in ms"):
        follow(1e3 * time, base)
    with pytest.warns(UserWarning, match="is its position in mm"):
        follow(time, 1e3 * base)
    for name, value in {"speed": 50.0, "pose_sigma": 0.1, "persistence": 50.0}.items():
        with pytest.warns(UserWarning, match=f"{name} is .*: is it in m"):
            vb.ContactFilter(estimator, **{name: value})
    vb.ContactFilter(estimator, persistence=np.inf)  # a steady velocity, without a warning
