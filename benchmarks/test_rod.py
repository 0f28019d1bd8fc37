"""Speed of the mechanics. Nothing here fails for being slow; answers are checked."""

import subprocess
import sys

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.rod import discretize, point_solver, solve_forces


@pytest.mark.quick
def test_force_to_signals(whisker, contacts, flops_of, scipy_solve, report):
    d = discretize(whisker)
    values, _ = report(
        "force → base force and contact point",
        lambda: solve_forces(d, contacts.rows),
        len(contacts.rows),
        scipy_solve,
        "0.3 µs, 50 %",
        rounds=30,
        flops=flops_of(),
    )
    assert np.isfinite(values).all()


@pytest.mark.quick
def test_force_to_signals_with_jacobian(whisker, contacts, flops_of, scipy_solve, report):
    d = discretize(whisker)
    _, tangents = report(
        "the same with the exact Jacobian",
        lambda: solve_forces(d, contacts.rows, tangents=True),
        len(contacts.rows),
        scipy_solve,
        "1 µs, 40 %",
        rounds=12,
        flops=flops_of(tangents=3),
    )
    assert np.isfinite(tangents).all()


@pytest.mark.quick
def test_points_to_contacts(whisker, contacts, scipy_solve, report):
    load = vb.PointContact(contacts.points)
    bent = report(
        "contact point → contact and signals",
        lambda: vb.deflect(whisker, load),
        len(contacts.rows),
        scipy_solve,
        "2 µs",
        rounds=8,
    )
    assert (bent.status == vb.Status.OK).all()
    assert (np.abs(bent.arc_length / whisker.length - contacts.rows[:, 0]) < 1e-6).all()


def test_the_paper_s_grid(whisker, report):
    """15 values of r, θ ±65°, φ ±60° in steps of 1°: 237,765 points, each with a status."""
    r = np.linspace(0.3, 1.0, 15) * whisker.length
    theta, phi = np.radians(np.arange(-65, 66)), np.radians(np.arange(-60, 61))
    r, theta, phi = np.meshgrid(r, theta, phi, indexing="ij")
    flat = r * np.cos(phi)
    points = np.stack([flat * np.cos(theta), flat * np.sin(theta), r * np.sin(phi)], axis=-1)
    load = vb.PointContact(points)
    bent = report(
        "the paper's grid, 237,765 points",
        lambda: vb.deflect(whisker, load),
        target="0.5 s",
        rounds=3,
    )
    assert bent.status.size == 237_765
    assert not np.isin(bent.status, (vb.Status.NOT_CONVERGED, vb.Status.MISSING)).any()


@pytest.mark.quick
def test_one_point(whisker, contacts, scipy_solve, report):
    """One contact at a time, as in a control loop."""
    load = vb.PointContact(contacts.points[0])
    bent = report(
        "one contact point at a time",
        lambda: vb.deflect(whisker, load),
        reference=scipy_solve,
        rounds=500,
    )
    assert bent.status == vb.Status.OK


def test_pegs(whisker, scipy_solve, report):
    """A vertical peg of 2.7 mm, from rest, at 2,000 places."""
    rng = np.random.default_rng(4)
    s = rng.uniform(0.4, 0.9, 2000) * whisker.length
    places = whisker.position(s)
    places[:, 1] -= 1.35e-3 + rng.uniform(-1.0, 0.1, 2000) * 0.05 * s
    load = vb.PegContact(places, (0, 0, 1), radius=1.35e-3, side=(0, 1, 0))
    bent = report(
        "solid peg from rest → contact and signals",
        lambda: vb.deflect(whisker, load),
        2000,
        scipy_solve,
        rounds=10,
    )
    assert not (bent.status == vb.Status.NOT_CONVERGED).any()


def test_tables(report):
    """What a new whisker costs before its first contact point."""

    def prepare():
        return point_solver(vb.Whisker.parabola(40e-3, 10.0), 0.3, 36)

    assert report("tables for a new whisker", prepare, rounds=5) is not None


@pytest.mark.quick
def test_import(report):
    def load():
        subprocess.run([sys.executable, "-c", "import vibrissa"], check=True)

    report("python -c 'import vibrissa'", load, target="0.1 s", rounds=5)
    assert load() is None


def test_python_alone(report):
    def load():
        subprocess.run([sys.executable, "-c", ""], check=True)

    report("python alone", load)
    assert load() is None
