"""Contacts of whiskers under their weight.

`tests/data/weighted_contacts.csv`: frictionless contacts of three rods, by integration in the
laboratory frame and shooting (`studies/weight.py --reference`), without vibrissa's equations.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_bvp
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli.app import app
from vibrissa.contacts import Gravity, read_at_rest
from vibrissa.contacts.joint_estimate import JointEstimate
from vibrissa.rod import resting
from vibrissa.sensors import Sensor, calibrate_weight
from vibrissa.signals import signals_of
from vibrissa.streaming import COMPONENTS, ContactStream, Poses, advice
from vibrissa.streaming.lines import ACCELERATION, POSITION, QUATERNION

REFERENCE = Path(__file__).parents[1] / "data" / "weighted_contacts.csv"
G = 9.81
RODS = {
    "PLA": (0.25, 2e-3, 0.8e-3, 2.3e9, 1240.0),
    "steel": (0.3, 0.5e-3, 0.25e-3, 200e9, 7850.0),
    "nitinol": (0.15, 0.15e-3, 0.08e-3, 60e9, 6450.0),
}
SIX = ("Fx", "FT", "FD", "Mx", "MB", "MD")


def rod(name):
    length, base, tip, modulus, density = RODS[name]
    return vb.Whisker.straight(
        length, base_radius=base, tip_radius=tip, youngs_modulus=modulus, density=density
    )


@pytest.fixture(scope="module")
def nitinol():
    return vb.ContactMap.simulate(rod("nitinol"), grid=False, cells=(8, 16, 8))


def unit(whisker):
    """Unit of force, N."""
    return whisker.base_bending_stiffness / whisker.length**2


def covariance(whisker):
    """Noise of a thousandth of the units of force and moment."""
    force = 1e-3 * unit(whisker)
    return np.diag(np.repeat([force, force * whisker.length], 3)) ** 2


def bent_by_random_forces(whisker, gravity, count):
    rng = np.random.default_rng(11)
    arc, angle = rng.uniform(0.4, 0.9, count), rng.uniform(0.0, 2.0 * np.pi, count)
    force = rng.uniform(0.3, 0.9, count) * unit(whisker)
    return vb.deflect(whisker, vb.PointForce(arc * whisker.length, force, angle), gravity=gravity)


def test_contacts_of_an_independent_integration_are_found(nitinol):
    rows = [line.split(",") for line in REFERENCE.read_text().splitlines()[1:]]
    for name, *cells in rows:
        values = np.array(cells, dtype=float)
        gravity, arc, force, moment, point = np.split(values, [3, 4, 7, 10])
        if name != "nitinol":  # two maps each are a second; the wrench needs none
            contact_map, sets = nitinol_like(name), ("wrench",)
        else:
            contact_map, sets = nitinol, (("Fx", "MB", "MD"), SIX, "wrench")
        whisker = contact_map.whisker
        for using in sets:
            signals = {"force": force, "moment": moment}
            found = contact_map.estimate(signals, using, gravity=gravity)
            away = np.linalg.norm(found.candidates.point - point, axis=-1)
            assert np.nanmin(away) < 2e-8 * whisker.length, (name, gravity, using)
            if using != ("Fx", "MB", "MD"):
                assert abs(found.arc_length - arc) < 1e-6 * whisker.length
        blind = contact_map.estimate(signals, "wrench")
        assert np.linalg.norm(blind.point - point) > 1e-3 * whisker.length


def nitinol_like(name):
    """A coarse map of another rod, of which only the whisker is used."""
    return vb.ContactMap.simulate(rod(name), grid=False, cells=(2, 4, 2))


@pytest.mark.slow
@pytest.mark.parametrize("gravity", [(0, 0, -G), (-G, 0, 0), (-0.5 * G, 0.5 * G, -0.7 * G)])
def test_errors_are_those_of_the_same_rod_without_weight(nitinol, gravity):
    whisker = nitinol.whisker
    noise = np.random.default_rng(2).normal(size=(300, 6)) @ np.sqrt(covariance(whisker))
    for using, largest in ((("Fx", "MB", "MD"), 1.2), (SIX, 1.2), ("wrench", 1.2)):
        errors, valid = [], []
        for pull in (None, gravity):
            bent = bent_by_random_forces(whisker, pull, 300)
            signals = {"force": bent.force + noise[:, :3], "moment": bent.moment + noise[:, 3:]}
            found = nitinol.estimate(signals, using, covariance(whisker), gravity=pull)
            away = found.point - bent.contact_point
            errors.append(np.nanmedian(np.linalg.norm(away, axis=1)))
            valid.append(found.covariance_valid.mean())
        assert errors[1] < largest * errors[0]
        assert valid[1] > valid[0] - 0.1
        inverse = np.linalg.pinv(found.covariance, rcond=1e-12)
        inside = np.einsum("ni,nij,nj->n", away, inverse, away) < 7.81
        assert 0.9 < inside.mean() < 0.99
        assert 0.93 < inside[found.covariance_valid].mean() < 0.99


def test_regions_of_light_contacts_hold_what_they_state(nitinol):
    """Long, bent valleys of contacts under weight; contacts deflected by 2 to 10 degrees."""
    whisker, gravity, n = nitinol.whisker, (-0.5 * G, 0.5 * G, -0.7 * G), 120
    rng = np.random.default_rng(5)
    arc, angle = rng.uniform(0.35, 0.95, n), rng.uniform(0.0, 2.0 * np.pi, n)
    force = np.deg2rad(rng.uniform(2.0, 10.0, n)) / arc**2 * unit(whisker)
    load = vb.PointForce(arc * whisker.length, force, angle)
    bent = vb.deflect(whisker, load, gravity=gravity)
    noise = rng.normal(size=(n, 6)) @ np.sqrt(covariance(whisker))
    signals = vb.base_signals(bent.force + noise[:, :3], bent.moment + noise[:, 3:])
    found = nitinol.estimate(signals, "Fx MB MD", covariance(whisker), gravity=gravity)
    away = found.point - bent.contact_point
    inverse = np.linalg.pinv(np.nan_to_num(found.covariance), rcond=1e-12)
    held = np.einsum("ni,nij,nj->n", away, inverse, away) < 7.81
    assert held.mean() > 0.87
    # As without weight, none nearer to the base than those of the map.
    assert np.nanmin(found.candidates.arc_length) > 0.3 * whisker.length - 1e-9


@pytest.mark.slow
def test_uncertain_direction_and_density_are_in_the_covariance(nitinol):
    whisker, rng = nitinol.whisker, np.random.default_rng(3)
    level = np.array([0.0, 0.0, -G])
    sigma, share, count = np.deg2rad(3.0), 0.1, 40
    gravity = vb.Gravity((0, 0, -G), direction_sigma=sigma, density_sigma=share)
    force = vb.PointForce(0.7 * whisker.length, 0.5 * unit(whisker), 1.0)
    noise = 1e-2 * covariance(whisker)
    ratios = []
    for _ in range(count):
        turned = level + G * sigma * np.array([*rng.normal(size=2), 0.0])
        other = whisker.with_properties(density=whisker.density * (1.0 + share * rng.normal()))
        bent = vb.deflect(other, force, gravity=turned)
        shaken = rng.normal(size=6) * np.sqrt(np.diag(noise))
        signals = {"force": bent.force + shaken[:3], "moment": bent.moment + shaken[3:]}
        found = nitinol.estimate(signals, SIX, noise, gravity=gravity)
        away = found.point - bent.contact_point
        ratios.append(away @ np.linalg.pinv(found.covariance, rcond=1e-12) @ away)
    exact = nitinol.estimate(signals, SIX, noise, gravity=(0, 0, -G))
    assert 1.5 < np.mean(ratios) < 5.0  # 3 if stated rightly
    assert np.trace(found.covariance) > 3.0 * np.trace(exact.covariance)


def test_a_tare_under_another_gravity_is_taken_away(nitinol):
    whisker = nitinol.whisker
    level, upright = (0.0, 0.0, -G), (-G, 0.0, 0.0)
    bent = bent_by_random_forces(whisker, upright, 5)
    now, before = vb.resting(whisker, upright), vb.resting(whisker, level)
    for tare, force, moment in (
        (level, now.force - before.force, now.moment - before.moment),
        ((0.0, 0.0, 0.0), now.force, now.moment),
    ):
        signals = {"force": bent.force + force, "moment": bent.moment + moment}
        # Arrays ended in a TypeError.
        stated = vb.Gravity(np.array(upright), np.array(tare))
        assert hash(stated) == hash(vb.Gravity(upright, tare))
        for using in (SIX, "wrench"):
            found = nitinol.estimate(signals, using, gravity=stated)
            np.testing.assert_allclose(found.point, bent.contact_point, atol=1e-7 * whisker.length)
    with pytest.raises(ValueError, match="FT and FD"):
        nitinol.estimate(signals, ("Fx", "FT", "MB"), gravity=vb.Gravity(upright, level))


@pytest.mark.parametrize("using", [("Fx", "MB", "MD"), ("Fx", "FD", "MB")])
@pytest.mark.parametrize(("taper", "curved"), [(4.0, True), (1.1, True), (1.1, False)])
def test_a_heavy_whisker_has_its_contacts_among_the_candidates(taper, curved, using):
    """Of 150, 11 were not, and most of these were called unique elsewhere, up to 0.3 L away.

    Of nearly uniform ones, 5 % had no contact, or were called unique elsewhere.
    """
    rng, length, count = np.random.default_rng(3), 0.1, 150
    bend = curved * rng.normal(size=3) * [0.2, 0.3, 0.8] / length
    whisker = vb.Whisker.from_curvature(
        length,
        lambda s: bend + 0.0 * s[..., None],
        base_radius=3e-4,
        tip_radius=3e-4 / taper,
        density=1e3,
    )
    force = whisker.base_bending_stiffness / length**2
    down = rng.normal(size=3)
    weight = np.linalg.norm(vb.resting(whisker, down / np.linalg.norm(down)).force)
    down *= 0.2 * force / weight / np.linalg.norm(down)
    s, angle = rng.uniform(0.35, 0.98, count), rng.uniform(0.0, 2.0 * np.pi, count)
    size = rng.uniform(0.05, 1.2, count) * (1.0 - (1.0 - 1.0 / taper) * s) ** 2 * force
    across = np.stack([0.0 * s, size * np.cos(angle), size * np.sin(angle)], axis=-1)
    pushed = vb.deflect(whisker, vb.PointForce(s * length, components=across), gravity=down)
    bent = vb.deflect(whisker, vb.PointContact(pushed.contact_point), gravity=down)
    same = np.abs(bent.arc_length - s * length) < 1e-6
    assert same.sum() > 0.9 * count
    signals = vb.base_signals(bent.force[same], bent.moment[same])
    chart = vb.ContactMap.simulate(whisker, grid=False)
    found = chart.estimate(signals, using, gravity=down)
    away = np.linalg.norm(found.candidates.point - bent.contact_point[same, None], axis=-1)
    missing = 1.0 - (np.nanmin(away, axis=1, initial=1.0) < 1e-4 * length).mean()
    assert missing < 0.01


def test_weight_does_not_twist_a_straight_whisker(nitinol):
    """M_x is zero; that of the sagged weightless whisker is not, and such contacts were unique."""
    bent = bent_by_random_forces(nitinol.whisker, (0.0, 0.0, -G), 20)
    np.testing.assert_allclose(bent.moment[:, 0], 0.0, atol=1e-9 * unit(nitinol.whisker))
    signals = vb.base_signals(bent.force, bent.moment)
    for using in (("Mx", "MB", "MD"), ("Fx", "FD", "Mx"), ("FT", "Mx", "MB")):
        for noise in (None, covariance(nitinol.whisker)):
            found = nitinol.estimate(signals, using, noise, gravity=(0.0, 0.0, -G))
            assert (found.status == vb.Status.DEGENERATE).all()


def pushed_until_it_slips(whisker, gravity):
    """Contacts of forces that grow in 10 directions, (10, 30), and which of them a whisker holds.

    These are the ones that `deflect` reaches from rest, by the displacement of the contact point.
    """
    length, shape = whisker.length, (10, 30)
    arc = np.linspace(0.4, 0.95, shape[0])[:, None] + np.zeros(shape)
    size = np.linspace(0.3, 18.0, shape[1]) * unit(whisker) * (1.0 - 0.6 * arc)
    angle = 0.6 * np.arange(shape[0])[:, None]
    pushed = vb.deflect(whisker, vb.PointForce(arc * length, size, angle), gravity=gravity)
    held = vb.deflect(whisker, vb.PointContact(pushed.contact_point), gravity=gravity)
    same = (pushed.status == vb.Status.OK) & (np.abs(held.arc_length - arc * length) < 1e-6)
    return pushed, np.logical_and.accumulate(same, axis=1)


@pytest.mark.parametrize("using", [("Fx", "MB", "MD"), ("Fx", "FT", "MB", "MD")])
def test_contacts_that_slip_off_are_not_the_answer_under_gravity_either(nitinol, using):
    """Equilibria beyond the fold were called unique: without weight, they are unexplained."""
    whisker = nitinol.whisker
    for gravity in ((0.0, 0.0, -1e-6), (0.0, 5.0, -8.0)):
        pushed, held = pushed_until_it_slips(whisker, gravity)
        beyond = ~held & (pushed.status == vb.Status.OK)
        assert beyond.sum() > 50
        signals = vb.base_signals(pushed.force[beyond], pushed.moment[beyond])
        found = nitinol.estimate(signals, using, covariance(whisker), gravity=gravity)
        reached = vb.deflect(whisker, vb.PointContact(found.point), gravity=gravity)
        apart = np.abs(reached.arc_length - found.arc_length)
        called = found.status == vb.Status.UNIQUE
        # At the fold itself the point may lie just beyond what is reached.
        assert (apart[called] < 5e-3 * whisker.length).all()
        if gravity[1] == 0.0:
            plain = nitinol.estimate(signals, using, covariance(whisker))
            np.testing.assert_array_equal(found.status, plain.status)
            assert (found.status == vb.Status.NOT_FRICTIONLESS).mean() > 0.5


def test_regions_hold_contacts_that_nearly_slip_off_under_gravity(nitinol):
    """At the last tenth of the force 80 % of the regions held them, and 6 % were far away."""
    whisker, gravity = nitinol.whisker, (0.0, 5.0, -8.0)
    pushed, held = pushed_until_it_slips(whisker, gravity)
    last = held.sum(axis=1) - 1
    near = held & (np.arange(held.shape[1]) > 0.85 * last[:, None])
    near &= ~held[:, -1:]
    assert near.sum() > 10
    truth = np.repeat(pushed.contact_point[near], 20, axis=0)
    noise = np.random.default_rng(4).normal(size=(len(truth), 6)) @ np.sqrt(covariance(whisker))
    wrench = [np.repeat(part[near], 20, axis=0) for part in (pushed.force, pushed.moment)]
    signals = vb.base_signals(wrench[0] + noise[:, :3], wrench[1] + noise[:, 3:])
    found = nitinol.estimate(signals, "Fx MB MD", covariance(whisker), gravity=gravity)
    assert 0.92 < inside(found, truth) < 0.985
    assert (found.status == vb.Status.UNIQUE).mean() > 0.98
    away = np.linalg.norm(found.point - truth, axis=1)
    assert away.max() < 0.05 * whisker.length


@pytest.mark.parametrize("using", ["Fx FT Mx MB", "Fx FD Mx MB"])
def test_the_twist_of_a_straight_whisker_proposes_no_contacts(nitinol, using):
    """Contacts were sought with that of the sagged whisker, and a third of them not found."""
    whisker = nitinol.whisker
    bent = bent_by_random_forces(whisker, (0.0, 0.0, -G), 60)
    signals = vb.base_signals(bent.force, bent.moment)
    found = nitinol.estimate(signals, using, gravity=(0.0, 0.0, -G))
    away = np.linalg.norm(found.candidates.point - bent.contact_point[:, None], axis=-1)
    assert (np.nanmin(away, axis=1) < 1e-4 * whisker.length).mean() > 0.97
    unique = found.status == vb.Status.UNIQUE
    assert (unique.mean() > 0.9) == ("FD" in using)
    np.testing.assert_array_less(away[unique, 0], 1e-4 * whisker.length)


def inside(found, truth):
    """Share of truths in the 95 % regions."""
    away = found.point - truth
    inverse = np.linalg.pinv(found.covariance, rcond=1e-12)
    return (np.einsum("ni,nij,nj->n", away, inverse, away) < 7.81).mean()


@pytest.mark.slow
def test_weight_friction_and_an_uncertain_base_are_found_together(nitinol):
    whisker, rng, level = nitinol.whisker, np.random.default_rng(21), (0.0, 0.0, -G)
    noise, sigma = covariance(whisker), whisker.length / (30.0 * whisker.base_bending_stiffness)
    points, wrenches = [], []
    for ratio in 0.2 * rng.normal(size=16):
        base = 1.0 / max(abs(rng.normal()) * sigma, 1e-3 * sigma)
        size, angle = rng.uniform(0.3, 0.7) * unit(whisker), rng.uniform(-3.0, 3.0)
        force = vb.PointForce(
            rng.uniform(0.5, 0.8) * whisker.length,
            components=size * np.array([ratio, np.cos(angle), np.sin(angle)]),
        )
        soft = whisker.with_properties(base_stiffness=(base, 1.0))
        bent = vb.deflect(soft, force, gravity=level)
        points.append(bent.contact_point)
        wrenches.append(np.concatenate([bent.force, bent.moment]))
    wrenches = np.array(wrenches) + rng.normal(size=(16, 6)) * np.sqrt(np.diag(noise))
    signals = {"force": wrenches[:, :3], "moment": wrenches[:, 3:]}
    using = ("Fx", "FT", "MB", "MD")
    every = {"gravity": level, "friction": 0.2, "compliance_sigma": sigma}
    assert inside(nitinol.estimate(signals, using, noise, **every), points) > 0.87
    for left_out in ("gravity", "friction"):
        some = {name: value for name, value in every.items() if name != left_out}
        assert inside(nitinol.estimate(signals, using, noise, **some), points) < 0.6, left_out


def turned(angles):
    """Rotations of a base about its y axis."""
    c, s, zero, one = np.cos(angles), np.sin(angles), 0 * angles, 1 + 0 * angles
    return np.moveaxis(np.array([[c, zero, s], [zero, one, zero], [-s, zero, c]]), -1, 0)


@pytest.fixture(scope="module")
def swung(nitinol):
    """One contact point of the laboratory, touched by a whisker that turns under its weight."""
    whisker, lab = nitinol.whisker, np.array([0.0, 0.0, -G])
    rotations = turned(np.linspace(-0.05, 0.12, 3))
    rest = vb.resting(whisker, rotations[0].T @ lab)
    load = vb.PointForce(0.7 * whisker.length, 0.5 * unit(whisker), 1.2)
    held = rotations[2] @ vb.deflect(whisker, load, gravity=rotations[2].T @ lab).contact_point
    rows, points = [], []
    for turn in rotations:
        pull, point = turn.T @ lab, turn.T @ held
        now = vb.resting(whisker, pull)
        bent = vb.deflect(whisker, vb.PointContact(point), gravity=pull)
        shift = np.concatenate([now.force - rest.force, now.moment - rest.moment])
        rows.append(np.concatenate([bent.force, bent.moment]) + shift)
        points.append(point)
    return rotations, np.array(rows), np.array(points)


def test_a_base_that_turns_under_gravity_of_the_laboratory(nitinol, swung):
    rotations, rows, points = swung
    how, lab, size = (
        {"noise": 1e-6 * covariance(nitinol.whisker)},
        (0, 0, -G),
        nitinol.whisker.length,
    )
    signals = {"force": rows[:, :3], "moment": rows[:, 3:]}
    for using in (("Fx", "MB", "MD"), SIX, "wrench"):
        found = nitinol.estimate(signals, using, **how, gravity=lab, base_rotation=rotations)
        assert np.linalg.norm(found.point - points, axis=1).max() < 2e-4 * size
        fixed = nitinol.estimate(signals, using, **how, gravity=lab)
        assert np.linalg.norm(fixed.point - points, axis=1).max() > 2e-3 * size
    locate = vb.Estimator(nitinol, ("Fx", "MB", "MD"), **how, gravity=lab)
    six = vb.base_signals(rows[:, :3], rows[:, 3:])
    values = np.column_stack([six[name] for name in ("Fx", "MB", "MD")])
    one = np.array([locate(v, r).point for v, r in zip(values, rotations, strict=True)])
    found = nitinol.estimate(
        signals, ("Fx", "MB", "MD"), **how, gravity=lab, base_rotation=rotations
    )
    np.testing.assert_allclose(one, found.point, atol=1e-9)
    with pytest.raises(ValueError, match="base_rotation has shape"):
        nitinol.estimate(signals, **how, gravity=lab, base_rotation=rotations[:-1])
    still = {name: value[:2] for name, value in signals.items()}
    one_turn = nitinol.estimate(still, **how, gravity=lab, base_rotation=rotations[0])
    each = nitinol.estimate(still, **how, gravity=lab, base_rotation=[rotations[0]] * 2)
    np.testing.assert_array_equal(one_turn.point, each.point)


def test_the_filter_follows_contacts_of_a_whisker_with_weight(nitinol, swung):
    rotations, rows, points = swung
    noise, held = 1e-2 * covariance(nitinol.whisker), rotations[0] @ points[0]
    shaken = rows + np.random.default_rng(4).normal(size=rows.shape) * np.sqrt(np.diag(noise))
    six = vb.base_signals(shaken[:, :3], shaken[:, 3:])
    values = np.column_stack([six[name] for name in ("Fx", "MB", "MD")])
    away = {}
    for gravity in ((0, 0, -G), None):
        locate = vb.Estimator(nitinol, ("Fx", "MB", "MD"), noise, gravity=gravity)
        follow = vb.ContactFilter(locate, speed=1e-3)
        for i, turn in enumerate(rotations):
            found = follow(0.01 * i, values[i], turn)
        away[gravity] = found.point - held
        size = away[gravity] @ np.linalg.solve(found.covariance, away[gravity])
        assert (size < 16.0) == (gravity is not None)
    assert np.linalg.norm(away[0, 0, -G]) < 0.1 * np.linalg.norm(away[None])
    uncertain = vb.Gravity((0, 0, -G), direction_sigma=0.1)
    locate = vb.Estimator(nitinol, ("Fx", "MB", "MD"), noise, gravity=uncertain)
    with pytest.raises(ValueError, match="uncertain gravity"):
        vb.ContactFilter(locate)


@pytest.mark.parametrize("angle", [0.0, 2.0])
def test_the_filter_states_light_contacts_of_a_whisker_that_sags_in_any_pose(nitinol, angle):
    """The sag of another pose is as large as the bending by a contact just detected."""
    whisker, turn = nitinol.whisker, Rotation.from_rotvec([angle, 0.0, 0.0]).as_matrix()
    pull = turn.T @ [0.0, 0.0, -G]
    noise = covariance(whisker)
    gravity = Gravity((0.0, 0.0, -G), tare=tuple(pull))
    follow = vb.ContactFilter(vb.Estimator(nitinol, SIX, noise, felt_above=5.0, gravity=gravity))
    rng, squares = np.random.default_rng(5), []
    forces = np.linspace(0.01, 0.04, 4) * unit(whisker)
    for arc, direction in zip(rng.uniform(0.4, 0.9, 30), rng.uniform(0, 6.28, 30), strict=True):
        # Touches of one point of the whisker; the base follows it.
        load = vb.PointForce(arc * whisker.length, forces, direction)
        bent = vb.deflect(whisker, load, gravity=pull)
        wrench = np.concatenate([bent.force, bent.moment], axis=1)
        wrench += rng.normal(size=wrench.shape) * np.sqrt(np.diag(noise))
        rows = np.stack([vb.base_signals(wrench[:, :3], wrench[:, 3:])[n] for n in SIX], axis=1)
        follow.reset()
        follow(0.0, np.zeros(6), turn, np.zeros(3))
        for i, row in enumerate(rows):
            base = turn @ (bent.contact_point[0] - bent.contact_point[i])
            known = follow(0.01 + 0.01 * i, row, turn, base)
            if known.probability > 0.99:
                away = known.point - turn @ bent.contact_point[0]
                squares.append(away @ np.linalg.solve(known.covariance, away))
    assert len(squares) > 80
    # The four samples of a contact share its first error.
    assert np.mean(squares) < 5.0
    assert np.mean(np.array(squares) < 7.81) > 0.85


def test_the_filter_states_why_a_complete_sample_of_a_heavy_whisker_has_no_contact(nitinol):
    """A contact that explains a sample least badly may not exist for the weightless whisker."""
    whisker, noise = nitinol.whisker, covariance(nitinol.whisker)
    follow = vb.ContactFilter(vb.Estimator(nitinol, SIX, noise, felt_above=5.0, gravity=(0, 0, -G)))
    wrenches = np.random.default_rng(8).normal(size=(40, 6)) * unit(whisker)
    wrenches[:, 3:] *= whisker.length
    rows = np.stack([vb.base_signals(wrenches[:, :3], wrenches[:, 3:])[n] for n in SIX], axis=1)
    found = [follow(0.01 * i, row, np.eye(3)).status for i, row in enumerate(rows)]
    assert vb.Status.MISSING not in found
    assert {vb.Status.NOT_FRICTIONLESS, vb.Status.OUTSIDE_MAP} & set(found)
    assert follow(1.0, np.full(6, np.nan), np.eye(3)).status == vb.Status.MISSING


def test_the_filter_takes_an_uncertain_stiffness_if_the_sag_hardly_depends_on_it(nitinol, swung):
    rotations, rows, points = swung
    noise = covariance(nitinol.whisker)
    shaken = rows + np.random.default_rng(4).normal(size=rows.shape) * np.sqrt(np.diag(noise))
    six = vb.base_signals(shaken[:, :3], shaken[:, 3:])
    softer = nitinol.whisker.with_properties(youngs_modulus=0.997 * RODS["nitinol"][3])
    assumed = vb.ContactMap.simulate(softer, grid=False, cells=(8, 16, 8))

    def filtered(sigma):
        how = {"gravity": (0, 0, -G), "stiffness_sigma": sigma}
        return vb.ContactFilter(vb.Estimator(assumed, ("Fx", "MB", "MD"), noise, **how), speed=1e-3)

    follow = filtered(0.003)
    for i, turn in enumerate(rotations):
        found = follow(0.01 * i, [six[name][i] for name in ("Fx", "MB", "MD")], turn)
    away = found.point - rotations[0] @ points[0]
    assert away @ np.linalg.solve(found.covariance, away) < 11.3  # 99 %
    with pytest.raises(ValueError, match="sag is then uncertain"):
        filtered(0.02)


def read_since(whisker, tare, pull, load):
    """Contact under a pull, and what a sensor reads of it that was tared under another."""
    bent = vb.deflect(whisker, load, gravity=pull)
    before, now = resting(whisker, tare), resting(whisker, pull)
    force = bent.force + now.force - before.force
    return bent.contact_point, force, bent.moment + now.moment - before.moment


def lines_of(samples):
    """Lines of a stream: force, moment, and what else is known."""
    for time, (_, force, moment, known) in enumerate(samples):
        wrench = dict(zip(COMPONENTS, [*force.tolist(), *moment.tolist()], strict=True))
        yield json.dumps({"time": 0.01 * time} | wrench | known)


@pytest.mark.parametrize("kind", ["signals", "sensor", "filter"])
def test_a_base_that_accelerates_is_known_by_its_accelerometer(nitinol, kind):
    """Of a carrier that turns the whisker by its mount; the first sample is the tare's."""
    whisker, level = nitinol.whisker, np.array([0.0, 0.0, -G])
    mount = Rotation.from_rotvec([0.3, -0.5, 1.1])
    noise, heavy = covariance(whisker), Sensor(noise=np.sqrt(np.diag(covariance(whisker))))
    heavy = replace(heavy, mass=2e-4, mass_moment=(1e-7, 2e-7, 0.0))
    touch = vb.PointForce(
        0.7 * whisker.length, components=(0.0, unit(whisker), 0.6 * unit(whisker))
    )
    samples = []
    for moved in np.array([[0.0, 0.0, 0.0], [3.0, -4.0, 2.0], [-6.0, 1.0, -5.0]]):
        pull = level - moved
        point, force, moment = read_since(whisker, level, pull, touch)
        if kind == "sensor":
            weight = heavy.weight(np.eye(3), pull)
            force, moment = force + weight[:3], moment + weight[3:]
        known = dict(zip(ACCELERATION, mount.apply(-pull), strict=True))
        samples.append((point, force, moment, known))
    how = {"gravity": tuple(level)}
    if kind == "sensor":
        how = {"gravity": Gravity(tuple(level), tare=tuple(level))}  # not in the sensor's mass
        locate, names = vb.Estimator.of_sensor(nitinol, heavy, **how), COMPONENTS
    else:
        locate, names = vb.Estimator(nitinol, SIX, noise, **how), None

    def answers(lines):
        locate.restart()
        follow = vb.ContactFilter(locate) if kind == "filter" else None
        running = ContactStream(locate, names, follow, Poses(mount.as_matrix()))
        running.warm_up()
        return list(running.records(lines)), running

    found, running = answers(lines_of(samples))
    limit = 2e-2 if kind == "filter" else 1e-5  # of a filter that took the first for a moving one
    for record, (point, *_) in zip(found, samples, strict=True):
        away = np.array([record[axis] for axis in "xyz"]) - point
        assert np.linalg.norm(away) < limit * whisker.length
    assert not advice(running)
    if kind == "signals":
        blind, _ = answers(lines_of([(*sample[:3], {}) for sample in samples]))
        assert abs(blind[2]["x"] - samples[2][0][0]) > 0.02 * whisker.length
        lost = {ACCELERATION[0]: None}
        found, _ = answers(lines_of([(*samples[1][:3], samples[1][3] | lost)]))
        assert found[0]["status"] == "missing"
        running = ContactStream(vb.Estimator(nitinol, SIX, noise))
        list(running.records(lines_of(samples)))
        assert "accelerometer" in advice(running)[0]


@pytest.mark.parametrize("drift", [0.0, 1.0])
def test_the_weight_is_no_offset_of_a_base_that_turns(nitinol, drift):
    """Not when the sensor is tared while the base turns, nor when its drift is followed."""
    noise = np.sqrt(np.diag(covariance(nitinol.whisker)))
    sensor = Sensor(noise=noise, drift=drift * noise).with_new_offset(20)
    locate = vb.Estimator.of_sensor(nitinol, sensor, felt_above=5.0, gravity=(0.0, 0.0, -G))
    turns = Rotation.from_rotvec(np.outer(0.005 * np.arange(200), [0.0, 1.0, 0.0]))
    readings = read_at_rest(nitinol.whisker, Gravity((0.0, 0.0, -G)), turns.as_matrix(), 200)
    running = ContactStream(locate, COMPONENTS, tare=20)
    samples = [
        (None, *np.split(reading, 2), dict(zip((*POSITION, *QUATERNION), pose, strict=True)))
        for reading, pose in zip(
            readings,
            np.column_stack([np.zeros((200, 3)), turns.as_quat()[:, [3, 0, 1, 2]]]),
            strict=True,
        )
    ]
    found = [record["status"] for record in running.records(lines_of(samples))]
    assert found == ["tare"] * 20 + ["not_felt"] * 180


def test_a_stream_that_is_warm_counts_the_sensor_as_tared_in_its_first_pose(nitinol):
    whisker, upright = nitinol.whisker, Rotation.from_rotvec([0.0, 0.5 * np.pi, 0.0])
    pull = upright.inv().apply([0.0, 0.0, -G])
    touch = vb.PointForce(0.7 * whisker.length, components=(0.0, unit(whisker), 0.0))
    point, *wrench = read_since(whisker, pull, pull, touch)
    pose = dict(zip(QUATERNION, upright.as_quat()[[3, 0, 1, 2]], strict=True))
    pose |= dict.fromkeys(POSITION, 0.0)
    locate = vb.Estimator(nitinol, SIX, covariance(whisker), gravity=(0.0, 0.0, -G))
    running = ContactStream(locate)
    running.warm_up()
    (found,) = running.records(lines_of([(point, *wrench, pose)]))
    away = np.array([found[axis] for axis in "xyz"]) - point
    assert np.linalg.norm(away) < 1e-5 * whisker.length


def test_a_stream_that_is_warm_has_the_map_that_its_first_line_needs(nitinol, monkeypatch):
    whisker, oblique = nitinol.whisker, np.array([3.0, -5.0, -7.9])
    touch = vb.PointForce(0.7 * whisker.length, components=(0.0, unit(whisker), 0.0))
    point, *wrench = read_since(whisker, oblique, oblique, touch)
    running = ContactStream(vb.Estimator(nitinol, SIX, covariance(whisker), gravity=oblique))
    running.warm_up()
    maps, simulate = [], vb.ContactMap.simulate
    counted = classmethod(lambda cls, *args, **named: maps.append(1) or simulate(*args, **named))
    monkeypatch.setattr(vb.ContactMap, "simulate", counted)
    (found,) = running.records(lines_of([(point, *wrench, {})]))
    assert not maps
    assert np.linalg.norm([found[axis] for axis in "xyz"] - point) < 1e-5 * whisker.length


@pytest.mark.parametrize("jump", [False, True])
def test_a_contact_that_moves_on_is_that_of_a_search(nitinol, monkeypatch, jump):
    """A robot's arm turns the whisker while the contact slides, or is suddenly elsewhere."""
    whisker, level = nitinol.whisker, np.array([0.0, 0.0, -G])
    turns = Rotation.from_rotvec(np.linspace(0.0, 0.15, 12)[:, None] * [0.3, 1.0, -0.2])
    first, searches, proposed = turns[0].inv().apply(level), [], JointEstimate._proposed
    search, follow = (vb.Estimator(nitinol, SIX, covariance(whisker), gravity=level) for _ in "ab")

    def counted(self, targets):
        searches.append(i)
        return proposed(self, targets)

    for i, turn in enumerate(turns.as_matrix()):
        there = jump and i >= 6
        arc, angle = (0.45, 2.5) if there else (0.7 + 0.002 * i, 0.2 + 0.01 * i)
        load = unit(whisker) * np.array([0.0, np.cos(angle), np.sin(angle)])
        touch = vb.PointForce(arc * whisker.length, components=load)
        point, *wrench = read_since(whisker, first, turn.T @ level, touch)
        search.reset()
        searched = search(signals_of(*wrench), turn)
        with monkeypatch.context() as patch:
            patch.setattr(JointEstimate, "_proposed", counted)
            followed = follow(signals_of(*wrench), turn)
        assert followed.status is searched.status is vb.Status.UNIQUE
        for found in (followed, searched):
            np.testing.assert_allclose(found.point, point, atol=1e-5 * whisker.length)
        away = np.abs(followed.covariance - searched.covariance).max()
        assert away < 0.05 * np.trace(searched.covariance)
    assert searches == ([0, 6] if jump else [0])


def test_what_does_not_fit_is_refused(nitinol):
    signals = {"force": np.ones((2, 3)), "moment": np.ones((2, 3))}
    light = nitinol.whisker.with_properties(density=None)
    bare = vb.ContactMap.simulate(light, grid=False, cells=(2, 4, 2))
    with pytest.raises(ValueError, match="density"):
        bare.estimate(signals, gravity=(0, 0, -G))
    with pytest.raises(ValueError, match="give its noise"):
        nitinol.estimate(signals, gravity=vb.Gravity((0, 0, -G), density_sigma=0.1))
    with pytest.raises(ValueError, match="negative"):
        vb.Gravity((0, 0, -G), direction_sigma=-1.0)
    with pytest.raises(ValueError, match="friction is weighed against the noise"):
        nitinol.estimate(signals, gravity=(0, 0, -G), friction=0.3)
    known = {"noise": dict.fromkeys(("Fx", "MB", "MD"), 1e-3), "friction": 0.3}
    for more in ({"gravity": (0, 0, -G)}, {"compliance_sigma": 1.0}):
        with pytest.raises(ValueError, match="at least 4 signals"):
            nitinol.estimate(signals, "Fx MB MD", **known, **more)
    with pytest.raises(ValueError, match="three signals or more"):
        vb.Estimator(nitinol, ("MB", "MD"), gravity=(0, 0, -G))
    signals["force"] = np.full((2, 3), np.nan)
    missing = nitinol.estimate(signals, gravity=(0, 0, -G))
    assert (missing.status == vb.Status.MISSING).all()


def test_the_command_line_takes_gravity(tmp_path):
    whisker = rod("nitinol")
    bent = bent_by_random_forces(whisker, (-G, 0.0, 0.0), 3)
    wrench = np.column_stack([bent.force, bent.moment])
    lines = ["time,Fx,Fy,Fz,Mx,My,Mz"]
    lines += [",".join(f"{v:.12g}" for v in (0.1 * i, *row)) for i, row in enumerate(wrench)]
    (tmp_path / "signals.csv").write_text("\n".join(lines) + "\n")
    made = "--length 150 --base-radius 0.15 --tip-radius 0.08 --modulus 60 --density 6450"
    run("map", *made.split(), "--any-length", "--no-grid", "-o", tmp_path / "map.nc")
    table, how = tmp_path / "contacts.csv", "--gravity -9.81,0,0 --gravity-sigma 0.1 --using wrench"
    where = ["--map", tmp_path / "map.nc", "-o", table]
    run("estimate", tmp_path / "signals.csv", *how.split(), *where)
    found = np.genfromtxt(table, delimiter=",", names=True, dtype=None, encoding="utf-8")
    points = np.column_stack([found[name] for name in "xyz"])
    np.testing.assert_allclose(points, bent.contact_point, atol=1e-6)
    assert "has no weight" in run("estimate", table, "--density", "1000", fails=True)
    # The same lines as a stream.
    how = "--gravity -9.81,0,0 --using Fx,FT,FD,Mx,MB,MD --force-noise 0.001 --moment-noise 1e-5"
    said = run("stream", tmp_path / "signals.csv", "--map", tmp_path / "map.nc", *how.split())
    records = [json.loads(line) for line in said.splitlines() if line.startswith("{")]
    streamed = np.array([[one[name] for name in "xyz"] for one in records])
    np.testing.assert_allclose(streamed, bent.contact_point, atol=1e-5)


def test_recordings_are_estimated_under_gravity(tmp_path, nitinol, swung):
    rotations, rows, points = swung
    n, level = len(rows), {"units": "1"}
    time, axes = np.arange(n) * 0.01, ("time", "whisker", "space")
    signals = xr.Dataset(
        {
            "force": (axes, rows[:, None, :3], {"units": "N"}),
            "moment": (axes, rows[:, None, 3:], {"units": "N m"}),
            "base_position": (axes, np.zeros((n, 1, 3)), {"units": "m"}),
            "base_rotation": ((*axes, "whisker_axis"), rotations[:, None], level),
            "in_contact": (axes[:2], np.ones((n, 1), bool)),
            "status": (axes[:2], np.zeros((n, 1), np.int8)),
        },
        {"time": time, "whisker": ["one"], "space": list("xyz")},
        {"source": "sensor"},
    )
    recording = xr.DataTree.from_dict({"signals": signals})
    noise = 1e-6 * covariance(nitinol.whisker)
    for using in (("Fx", "MB", "MD"), "wrench"):
        found = vb.pipeline.estimates_of(
            recording,
            using,
            noise=noise,
            contact_maps=[nitinol],
            gravity=vb.Gravity((0.0, 0.0, -G)),
        )
        lab = found.contact_point.values[:, 0]
        assert np.linalg.norm(lab - rotations[0] @ points[0], axis=1).max() < 2e-4 * 0.15


def run(*words, fails=False):
    """Run a verb; what it prints."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert (result.exit_code != 0) == fails, result.output
    return f"{result.output} {result.exception}"


def test_gravity_of_a_moving_base_is_as_exact_as_the_noise_is_small(nitinol):
    whisker = nitinol.whisker
    turn = Rotation.from_euler("yz", [[0.1, 0.0], [0.10013, 0.02007], [0.11, 0.03]]).as_matrix()
    bent, rest = [], []
    for one in turn:
        force = vb.PointForce(0.7 * whisker.length, 0.5 * unit(whisker), 0.4)
        bent.append(vb.deflect(whisker, force, gravity=tuple(one.T @ [0.0, 0.0, -G])))
        rest.append(resting(whisker, one.T @ [0.0, 0.0, -G]))
    wrench = {
        name: np.stack(
            [getattr(b, name) + getattr(r, name) for b, r in zip(bent, rest, strict=True)]
        )
        - getattr(rest[0], name)
        for name in ("force", "moment")
    }
    points = np.stack([one.contact_point for one in bent])
    errors = []
    for share in (1e-3, 1e-6):  # a finer step costs a solution for each pose
        noise = share**2 * 1e6 * covariance(whisker)
        found = nitinol.estimate(
            vb.base_signals(*wrench.values()), noise=noise, gravity=(0, 0, -G), base_rotation=turn
        )
        away = np.linalg.norm(found.point - points, axis=1)
        assert (away < 0.1 * np.sqrt(np.linalg.eigvalsh(found.covariance)[:, -1])).all()
        errors.append(away.max())
    assert errors[1] < 2e-7 * whisker.length


def rest_wrench(gravity):
    """Force and moment of the nitinol rod's weight, by collocation of the whole rod."""
    length, base, tip, modulus, density = RODS["nitinol"]

    def radius(s):
        return base + (tip - base) * s / length

    def beyond(s):  # the weight's size beyond s
        return size * density * np.pi * length * (radius(s) ** 3 - tip**3) / (3.0 * (base - tip))

    size = np.linalg.norm(gravity)
    toward = np.array(gravity) / size

    def rates(s, y):  # the tangent and the moment of what is beyond
        stiffness = modulus * np.pi / 4.0 * radius(s) ** 4
        bend = np.cross(y[3:].T / stiffness[:, None], y[:3].T)
        return np.concatenate([bend.T, -np.cross(y[:3].T, beyond(s)[:, None] * toward).T])

    s = np.linspace(0.0, length, 41)
    start = np.concatenate([np.outer([1.0, 0.0, 0.0], np.ones(41)), np.zeros((3, 41))])
    found = solve_bvp(
        rates, lambda a, b: np.append(a[:3] - [1.0, 0.0, 0.0], b[3:]), s, start, tol=1e-9
    )
    assert found.success
    return np.append(beyond(0.0) * toward, found.y[3:, 0])


def test_a_free_whisker_on_a_moving_base_reads_what_an_independent_integration_reads(nitinol):
    whisker = nitinol.whisker
    turn = Rotation.from_euler("yz", [[0.1, 0.0], [0.10013, 0.02007], [0.11, 0.03]]).as_matrix()
    read = read_at_rest(whisker, Gravity((0.0, 0.0, -G)), turn, len(turn))
    known = np.array([rest_wrench(one.T @ [0.0, 0.0, -G]) for one in turn])
    scale = unit(whisker) * np.repeat([1.0, whisker.length], 3)
    np.testing.assert_allclose(read / scale, (known - known[0]) / scale, atol=3e-8)


def test_the_whiskers_weight_is_taken_away_once_if_the_sensor_carries_it(nitinol):
    """Calibrated while free, touched in other poses, by an independent integration."""
    rows = [line.split(",") for line in REFERENCE.read_text().splitlines()[1:]]
    values = np.array([cells for name, *cells in rows if name == "nitinol"], dtype=float)
    down, noise = np.array([0.0, 0.0, -G]), np.sqrt(np.diag(covariance(nitinol.whisker)))
    free = Rotation.from_euler("xyz", np.random.default_rng(3).uniform(-3.0, 3.0, (8, 3)))
    readings = np.array([rest_wrench(one) for one in free.inv().apply(down)])
    sensor = calibrate_weight(Sensor(noise=noise), readings, free.as_matrix(), gravity=down).sensor
    locate = vb.Estimator.of_sensor(nitinol, sensor, gravity=tuple(down))
    locate(readings[0], free.as_matrix()[0])
    for gravity, _, force, moment, point in (np.split(row, [3, 4, 7, 10]) for row in values):
        turn = Rotation.align_vectors(down[None], gravity[None])[0].as_matrix()
        found = locate(np.concatenate([force, moment]) + rest_wrench(gravity), turn)
        away = found.point - point
        # The calibrated weight is that of a rigid body, which this rod, sagging by 0.2 L, is not.
        assert away @ np.linalg.solve(found.covariance, away) < 4.0


@pytest.mark.slow
def test_contacts_of_a_moving_base_are_those_of_an_independent_integration(nitinol):
    """Tared free in a pose that no grid of directions holds, then touched in another."""
    rows = [line.split(",") for line in REFERENCE.read_text().splitlines()[1:]]
    values = np.array([cells for name, *cells in rows if name == "nitinol"], dtype=float)
    tared = Rotation.from_euler("yz", [0.10013, 0.02007]).as_matrix()
    for gravity, _, force, moment, point in (np.split(row, [3, 4, 7, 10]) for row in values):
        down = np.array([0.0, 0.0, -np.linalg.norm(gravity)])
        touched = Rotation.align_vectors(down[None], gravity[None])[0].as_matrix()
        rest = rest_wrench(gravity) - rest_wrench(tared.T @ down)
        wrench = np.concatenate([force, moment]) + rest
        for level in (1e-3, 1e-6):
            found = nitinol.estimate(
                {"force": [np.zeros(3), wrench[:3]], "moment": [np.zeros(3), wrench[3:]]},
                "wrench",
                noise=(1e3 * level) ** 2 * covariance(nitinol.whisker),
                gravity=down,
                base_rotation=np.array([tared, touched]),
            )
            assert found.status[0] not in (vb.Status.UNIQUE, vb.Status.AMBIGUOUS)  # free
            away = np.linalg.norm(found.point[1] - point)
            assert away < 0.02 * np.sqrt(np.linalg.eigvalsh(found.covariance[1])[-1])
        assert away < 1e-7 * nitinol.whisker.length
