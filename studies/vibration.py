"""Contacts of whiskers with mass: which frames are in contact, and errors of contact points.

`python studies/vibration.py [--page]`: trials of 0.6 s past a peg, with the density and damping of
a rat's whisker assumed and others true. On the first three
numbers were set, on the others not. Fresh trials have random whiskers, pegs and speeds; on those of
`TUNED`, not on the others, the correlation of model errors was chosen.
"""

import argparse
from pathlib import Path

import numpy as np
from pages import put, table
from scipy.stats import chi2

import vibrissa as vb
from vibrissa.pipeline import estimates_of, with_signals
from vibrissa.sensors import FORCE_NOISE, MOMENT_NOISE, component_noise
from vibrissa.simulation import Dynamics, Vibration, facing_peg, measure, simulate, sweep_past

GAMMA = vb.samples.gamma()
STRAIGHT = vb.Whisker.straight(30e-3, base_radius=80e-6, youngs_modulus=3.5e9)
BENT = vb.Whisker.parabola(35e-3, 12.0)
SMALL = vb.Whisker.parabola(25e-3, 20.0, base_radius=70e-6)
BENT_28, BENT_30, BENT_38, BENT_42 = (
    vb.Whisker.parabola(1e-3 * length, bend, base_radius=1e-6 * radius)
    for length, bend, radius in ((28, 18.0, 70), (30, 16.0, 75), (38, 10.0, 90), (42, 9.0, 95))
)
STRAIGHT_26, STRAIGHT_32 = (
    vb.Whisker.straight(1e-3 * length, base_radius=1e-6 * radius)
    for length, radius in ((26, 70), (32, 85))
)
# Whisker, distance of the peg over L, its radius, whisks a second, seed, mass, damping ratio.
TRIALS = {
    "γ": (GAMMA, 0.65, 1e-3, 5.0, 0, 1.0, 0.14),
    "γ, mass + 20 %, 8 Hz": (GAMMA, 0.5, 0.6e-3, 8.0, 7, 1.2, 0.14),
    "straight, mass − 20 %, damping 0.11": (STRAIGHT, 0.6, 1e-3, 6.0, 3, 0.8, 0.11),
    "parabola, mass − 15 %, damping 0.16": (BENT, 0.55, 1e-3, 6.0, 22, 0.85, 0.16),
    "γ, mass + 20 %, damping 0.12, 7 Hz": (GAMMA, 0.6, 0.8e-3, 7.0, 21, 1.2, 0.12),
    "straight, mass + 20 %, damping 0.13, 9 Hz": (STRAIGHT, 0.5, 0.7e-3, 9.0, 31, 1.2, 0.13),
    "small parabola, mass − 20 %": (SMALL, 0.7, 1.5e-3, 5.0, 32, 0.8, 0.15),
}
# The same, and noise over the usual; only their contacts are found.
WRONG_MASSES = {
    "parabola of 30 mm, 8 Hz, − 20 %": (BENT_30, 0.58, 0.9e-3, 8.0, 81, 0.8, 0.13),
    "straight, 32 mm, 6 Hz, − 20 %": (STRAIGHT_32, 0.55, 1e-3, 6.0, 82, 0.8, 0.16),
    "parabola of 42 mm, 5 Hz, − 20 %, 3 × noise": (BENT_42, 0.6, 1e-3, 5.0, 88, 0.8, 0.12, 3.0),
    "γ, 7 Hz, − 10 %": (GAMMA, 0.58, 1e-3, 7.0, 83, 0.9, 0.12),
    "parabola of 38 mm, 6 Hz, 0 %": (BENT_38, 0.62, 1.2e-3, 6.0, 84, 1.0, 0.15),
    "straight, 26 mm, 9 Hz, + 10 %": (STRAIGHT_26, 0.6, 0.8e-3, 9.0, 85, 1.1, 0.14),
    "parabola of 28 mm, 7 Hz, + 20 %": (BENT_28, 0.55, 1e-3, 7.0, 86, 1.2, 0.16),
    "γ, 5 Hz, + 20 %, ⅓ noise": (GAMMA, 0.65, 0.7e-3, 5.0, 87, 1.2, 0.13, 1.0 / 3.0),
}
MASSES = (0.8, 1.2, 0.8, 1.2, 0.9, 1.1, 0.8, 1.2)
"""Masses of fresh trials, relative to the assumed one, by seed."""
TUNED, FRESH = range(100, 116, 2), (*range(20, 36), *range(40, 56))
HEAD_FRESH = ("mass", "trials", "in contact", "false, %", "untouched since the last, %", "found, %")
HEAD_FRESH = (*HEAD_FRESH, "97 % found", "1 % false", "both")
HEAD = ("trial", "in contact", "M_B > 5σ: false, %", "false, %", "untouched since the last, %")
HEAD = (*HEAD, "found, %", "onset late, ms")
BY_AGE = {"all": (0, 999), "0–8 ms": (0, 8), "8–20 ms": (8, 20), "later": (20, 999)}
HEAD_ERRORS = ("trial", "inertia", *BY_AGE, "in 95 % region", "located")
NOISE = component_noise(FORCE_NOISE, MOMENT_NOISE)
PARTS = 5
"""Number of steps of the simulation from frame to frame."""
STRONG = 20e-6
"""Contact force from which errors of contact points are compared, N."""


def simulated(whisker, distance, radius, frequency, seed, mass, damping, noise=1.0):
    """Trial with a sensor's noise, its truth, and frames touched since the one before."""
    density = tuple(mass * value for value in Dynamics().density)
    peg = facing_peg(whisker, distance, radius)
    motion = sweep_past(whisker, peg, 0.6, 1000.0 * PARTS, seed=seed, frequency=frequency)
    dynamics = Dynamics(density=density, damping_ratio=damping, step=1e-3 / PARTS)
    fine = simulate(whisker, motion, peg, dynamics=dynamics, nodes=9)
    touching = fine["truth"].in_contact.values.astype(bool)[:, 0]
    lately = [touching[max(i - PARTS + 1, 0) : i + 1].any() for i in range(0, len(touching), PARTS)]
    trial = fine.isel(time=slice(None, None, PARTS))
    trial = measure(trial, noise * FORCE_NOISE, noise * MOMENT_NOISE, seed=seed)
    return trial, trial["truth"].to_dataset().isel(whisker=0), np.array(lately)


def fresh(seed):
    """Whisker and conditions of a fresh trial."""
    rng = np.random.default_rng(1000 + seed)
    length, slenderness = rng.uniform(24e-3, 42e-3), rng.uniform(2.2e-3, 2.8e-3)
    thickness = {"base_radius": length * slenderness}
    kind = rng.integers(3)
    if kind == 0:
        modulus = rng.uniform(2.5e9, 4e9)
        whisker = vb.Whisker.straight(length, youngs_modulus=modulus, **thickness)
    elif kind == 1:
        whisker = vb.Whisker.parabola(length, rng.uniform(6, 20), **thickness)
    else:
        whisker = GAMMA
    where = rng.uniform(0.5, 0.68), rng.uniform(0.6e-3, 1.5e-3), rng.uniform(4.5, 9.0)
    damping, noise = rng.uniform(0.11, 0.17), float(rng.choice([1.0 / 3.0, 1.0, 1.0, 3.0]))
    return whisker, *where, 500 + seed, MASSES[seed % 8], damping, noise


def detected(seed):
    """Frames in contact, frames untouched since the last, and frames called contact."""
    whisker, *how = fresh(seed)
    trial, truth, lately = simulated(whisker, *how)
    found = called_contact(whisker, trial, how[-1])[0]
    return truth.in_contact.values.astype(bool), ~lately, found


def fresh_rows(seeds):
    """Rows of the table of fresh trials, by the error of the mass, and of all."""
    done = {seed: detected(seed) for seed in seeds}
    rows = []
    for mass in (0.8, 0.9, 1.1, 1.2, None):
        some = [one for seed, one in done.items() if mass in (None, MASSES[seed % 8])]
        hits = np.array([found[touching].mean() for touching, _, found in some])
        wrong = np.array([found[untouched].mean() for _, untouched, found in some])
        touching, untouched, found = (np.concatenate(each) for each in zip(*some, strict=True))
        parts = (found[~touching], found[untouched], found[touching])
        right, clean = hits >= 0.97, wrong <= 0.01
        rows.append(
            [
                "all"
                if mass is None
                else f"{'−' if mass < 1 else '+'} {100 * abs(mass - 1):.0f} %",
                *(str(number) for number in (len(some), touching.sum())),
                *(f"{100 * one.mean():.1f}" for one in parts),
                *(str(one.sum()) for one in (right, clean, right & clean)),
            ]
        )
    return rows


def called_contact(whisker, trial, noise):
    """Frames called contact, and the wrench."""
    data = trial.to_dataset().isel(whisker=0)
    wrench = np.concatenate([data.force.values, data.moment.values], axis=1)
    pose = (data.base_rotation.values, data.base_position.values)
    vibration = Vibration.of(whisker)
    course = data.time.values, wrench, *pose
    return vibration.contact_probability(*course, noise**2 * NOISE) > 0.5, wrench


def shares(name, whisker, trial, truth, lately, noise=1.0):
    """Shares of untouched frames called contact, and of contact frames found."""
    touching = truth.in_contact.values.astype(bool)
    found, wrench = called_contact(whisker, trial, noise)
    bare = np.hypot(wrench[:, 4], wrench[:, 5]) > 5.0 * noise * MOMENT_NOISE
    # Onsets after some quiet: how long until the frame is called contact.
    onsets = [i for i in np.flatnonzero(np.diff(touching.astype(int)) == 1) + 1 if i > 5]
    onsets = [i for i in onsets if not touching[i - 5 : i].any()]
    late = [int(np.argmax(found[i:])) for i in onsets]
    parts = (bare[~touching], found[~touching], found[~lately], found[touching])
    return [
        name,
        str(touching.sum()),
        *(f"{100 * one.mean():.1f}" for one in parts),
        str(max(late)),
    ]


def errors(name, trial, truth, dynamics, rng):
    """Median errors of contacts by the wrench (and predicted), mm, by the age of the contact."""
    done = with_signals(trial, "sensor", dynamics=dynamics)
    found = estimates_of(done, "wrench").isel(whisker=0)
    touching = truth.in_contact.values.astype(bool)
    age = np.arange(len(touching)) - np.maximum.accumulate(
        np.where(touching, 0, np.arange(len(touching)) + 1)
    )
    strong = touching & (np.linalg.norm(truth.contact_force.values, axis=1) > STRONG)
    away = found.contact_point_whisker.values - truth.contact_point_whisker.values
    spread = found.covariance.values
    known = strong & np.isfinite(away).all(axis=1) & np.isfinite(spread).all(axis=(1, 2))
    value, axes = np.linalg.eigh(np.where(known[:, None, None], spread, np.eye(3)))
    root = np.sqrt(np.maximum(value, 0.0))
    drawn = np.einsum("tij,tj,tjn->tin", axes, root, rng.standard_normal((len(age), 3, 25)))
    along = np.einsum("tij,ti->tj", axes, away) / np.maximum(root, 1e-6)
    distance, predicted = np.linalg.norm(away, axis=1), np.linalg.norm(drawn, axis=1)
    cells = []
    for low, high in BY_AGE.values():
        rows = known & (age >= low) & (age < high)
        pair = np.median(distance[rows]), np.median(predicted[rows])
        cells.append("{:.2f} ({:.2f})".format(*(1e3 * one for one in pair)))
    inside = (along[known] ** 2).sum(axis=1) < chi2.ppf(0.95, 3)
    how = "removed" if dynamics else "–"
    shares = (inside.mean(), known.sum() / strong.sum())
    return [name, how, *cells, *(f"{100 * one:.0f} %" for one in shares)]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--page", action="store_true", help="write the tables into the page")
    page = parser.parse_args().page
    contact, away, rng = [], [], np.random.default_rng(0)
    for name, (whisker, *how) in TRIALS.items():
        trial, truth, lately = simulated(whisker, *how)
        contact.append(shares(name, whisker, trial, truth, lately))
        away += [errors(name, trial, truth, one, rng) for one in (None, Dynamics())]
    wrong = [
        shares(name, whisker, *simulated(whisker, *how), *how[6:])
        for name, (whisker, *how) in WRONG_MASSES.items()
    ]
    blocks = {"vibration": table(HEAD, contact), "inertia in contact": table(HEAD_ERRORS, away, 2)}
    blocks["wrong mass"] = table(HEAD, wrong)
    blocks["fresh"] = table(HEAD_FRESH, fresh_rows(FRESH))
    print("\n\n".join(blocks.values()))
    if page:
        put(Path(__file__).parents[1] / "docs" / "validation-inertia.md", blocks)
