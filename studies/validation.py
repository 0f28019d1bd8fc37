"""What the page on validation reports: the rod against references, contacts found again.

`python studies/validation.py`, a minute or two. References are those of the tests, in
`tests/data`; what they are and where they come from is written in each file.
"""

import json
from pathlib import Path

import numpy as np

import vibrissa as vb
from vibrissa.rod.discretize import discretize
from vibrissa.rod.reach import contacts_at, reach
from vibrissa.signals import TRIPLETS, within_cone

DATA = Path(__file__).parent.parent / "tests" / "data"
LENGTH = 39.4e-3
STEPS = (18, 36, 72, 144)
FINE = 500


def relative(found, known):
    """|found - known| / |known| of vectors in the last axis."""
    return np.linalg.norm(found - known, axis=-1) / np.linalg.norm(known, axis=-1)


def kirchhoff(steps):
    """Worst p/L, F and M of 120 loads against the independent integration."""

    def ramp(s):
        out = np.maximum(0.0, 15.0 * (s - 0.6 * LENGTH) / (0.4 * LENGTH))
        return np.stack([0.0 * s, out, 5.0 + 400.0 * s], axis=-1)

    whiskers = {
        "K1": vb.Whisker.from_curvature(LENGTH, lambda s: [0.0, 0.0, 12.0]),
        "K2": vb.Whisker.from_curvature(LENGTH, ramp, breaks=(0.6 * LENGTH,)),
        "K3": vb.Whisker.from_curvature(LENGTH, lambda s: [0.0, 0.0, 0.0]),
    }
    worst = np.zeros(3)
    cases = json.loads((DATA / "kirchhoff.json").read_text())["cases"]
    for name, whisker in whiskers.items():
        rows = [case for case in cases if case[0] == name]
        s, force, angle = np.array([case[1:4] for case in rows]).T
        p, f, m = (np.array([case[i] for case in rows]) for i in (4, 5, 6))
        bent = vb.deflect(whisker, vb.PointForce(s * LENGTH, force, angle), steps=steps)
        place = np.linalg.norm(bent.contact_point - p, axis=1).max() / LENGTH
        found = [place, relative(bent.force, f).max(), relative(bent.moment, m).max()]
        worst = np.maximum(worst, found)
    return worst


def cantilever(steps):
    """Worst tip place/L of a cylinder under dead and follower loads, by elliptic integrals."""
    rod = vb.Whisker.straight(LENGTH, tip_radius=100e-6)
    rows = json.loads((DATA / "elliptic.json").read_text())["rows"]
    load, q, slope, x, y = (np.array(column) for column in zip(*rows, strict=True))
    unit = rod.base_bending_stiffness / LENGTH**2
    follower = load == "follower"
    along = np.where(follower, 0.0, q * np.sin(slope)) * unit
    across = np.where(follower, q, q * np.cos(slope)) * unit
    bent = vb.deflect(rod, vb.PointForce(LENGTH, components=(along, across, 0.0)), steps=steps)
    tip = np.stack([x, y, 0 * x], axis=-1)
    return [
        np.linalg.norm(bent.contact_point / LENGTH - tip, axis=1).max(),
        np.degrees(slope).max(),
    ]


def published_whisk():
    """Worst difference from Quist & Hartmann 2012, Fig. 8, in force and moment."""
    whisker = vb.Whisker.parabola(35e-3, 23.3, base_radius=81.5e-6)
    x, y, _ = whisker.position(17.5e-3)
    turned = -np.radians([5.0, 10.0, 15.0, 20.0, 25.0, 30.0])
    cos, sin = np.cos(turned), np.sin(turned)
    points = np.stack([x * cos - y * sin, x * sin + y * cos, 0.0 * turned], axis=-1)
    bent = vb.deflect(whisker, vb.PointContact(points))
    fx = [21.9, 29.4, 20.8, -5.0, -47.8, -106.6]
    fy = [-42.4, -92.2, -145.0, -196.3, -241.1, -274.3]
    mz = np.array([-0.803, -1.650, -2.516, -3.374, -4.197, -4.953])
    force = relative(bent.force[:, :2] * 1e6, np.stack([fx, fy], axis=-1)).max()
    return [force, np.abs(bent.moment[:, 2] * 1e6 / mz - 1.0).max()]


def contacts(whisker, n, rng, load=(0.0, 0.99)):
    """Contacts spread over Ω: arc length, bearing, root of the load as a share of the fold's."""
    low, high = [0.0, -np.pi, load[0]], [1.0, np.pi, load[1]]
    return contacts_at(reach(whisker).fold, rng.uniform(low, high, (n, 3)))


def found_again(triplet, n, rng):
    """Share of contacts of the γ whisker, outside the cone, found again; share with several."""
    s, fy, fz = contacts(CHART.whisker, n, rng).T
    unit = discretize(CHART.whisker).force
    load = vb.PointForce(s * CHART.whisker.length, components=(0.0 * s, fy * unit, fz * unit))
    bent = vb.deflect(CHART.whisker, load)
    found = CHART.estimate(vb.base_signals(bent.force, bent.moment), triplet)
    away = np.linalg.norm(found.candidates - bent.contact_point[:, None], axis=-1)
    away = np.where(np.isnan(away), np.inf, away).min(axis=1) / CHART.whisker.length
    outside = ~within_cone(CHART.whisker, bent.contact_point)
    return (away[outside] <= 1e-6).mean(), (found.n_candidates[outside] > 1).mean(), outside.sum()


def with_friction(whisker, n, rng):
    """Worst place/L of the nearest candidate from a wrench with friction; share that is unique."""
    s, fy, fz = contacts(whisker, n, rng, (0.1, 0.99)).T
    fx = rng.uniform(-0.5, 0.5, n) * np.hypot(fy, fz)
    unit = discretize(whisker).force
    load = vb.PointForce(s * whisker.length, components=(fx * unit, fy * unit, fz * unit))
    bent = vb.deflect(whisker, load, steps=FINE)
    found = vb.estimate_from_wrench(whisker, bent.force, bent.moment)
    away = np.linalg.norm(found.candidates - bent.contact_point[:, None], axis=-1)
    nearest = np.nanmin(away, axis=1).max() / whisker.length
    return nearest, (found.status == vb.Status.UNIQUE).mean()


for steps in STEPS:
    print(f"{steps} steps: p, F, M", *(f"{x:.1e}" for x in kirchhoff(steps)), end="; ")
    print("cantilever {:.1e}, turned up to {:.0f}°".format(*cantilever(steps)))
print("Quist & Hartmann: force {:.2%}, moment {:.2%}".format(*published_whisk()))
CHART = vb.ContactMap.simulate(vb.samples.gamma(), grid=False)
share, several, n = found_again(("Fx", "MB", "MD"), 100_000, np.random.default_rng(0))
print(f"Fx MB MD: {share:.4%} of {n} found again, {several:.3%} with several candidates")
for names in TRIPLETS:
    share, several, n = found_again(names, 5000, np.random.default_rng(1))
    print(f"{' '.join(names)}: {share:.2%} of {n}, {several:.1%} with several")
for name in ("gamma", "curved", "straight", "curved_cylinder", "straight_cylinder"):
    whisker = getattr(vb.samples, name)()
    worst, unique = with_friction(whisker, 2000, np.random.default_rng(2))
    print(f"wrench with friction, {whisker.name}: {worst:.1e} L, {unique:.1%} unique")
