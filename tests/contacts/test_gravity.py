"""Contacts of whiskers under their weight.

`tests/data/weighted_contacts.csv`: frictionless contacts of three rods, by integration in the
laboratory frame and shooting (`studies/weight.py --reference`), without vibrissa's equations.
"""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.cli.app import app

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


@pytest.mark.parametrize("gravity", [(0, 0, -G), (-G, 0, 0), (-0.5 * G, 0.5 * G, -0.7 * G)])
def test_errors_are_those_of_the_same_rod_without_weight(nitinol, gravity):
    whisker = nitinol.whisker
    noise = np.random.default_rng(2).normal(size=(300, 6)) @ np.sqrt(covariance(whisker))
    for using, largest in ((("Fx", "MB", "MD"), 1.2), (SIX, 1.2), ("wrench", 1.2)):
        errors = []
        for pull in (None, gravity):
            bent = bent_by_random_forces(whisker, pull, 300)
            signals = {"force": bent.force + noise[:, :3], "moment": bent.moment + noise[:, 3:]}
            found = nitinol.estimate(signals, using, covariance(whisker), gravity=pull)
            away = found.point - bent.contact_point
            errors.append(np.nanmedian(np.linalg.norm(away, axis=1)))
        assert errors[1] < largest * errors[0]
        inverse = np.linalg.pinv(found.covariance, rcond=1e-12)
        inside = np.einsum("ni,nij,nj->n", away, inverse, away) < 7.81
        assert 0.9 < inside.mean() < 0.99


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
        for using in (SIX, "wrench"):
            found = nitinol.estimate(signals, using, gravity=vb.Gravity(upright, tare))
            np.testing.assert_allclose(found.point, bent.contact_point, atol=1e-7 * whisker.length)
    with pytest.raises(ValueError, match="FT and FD"):
        nitinol.estimate(signals, ("Fx", "FT", "MB"), gravity=vb.Gravity(upright, level))


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
    with pytest.raises(ValueError, match="friction"):
        nitinol.estimate(signals, gravity=(0, 0, -G), friction=0.3)
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


def run(*words, fails=False):
    """Run a verb; what it prints."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert (result.exit_code != 0) == fails, result.output
    return f"{result.output} {result.exception}"
