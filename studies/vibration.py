"""Contacts of whiskers with mass, distinguished from the motion of the base and from vibration.

`python studies/vibration.py [--page]`: trials of 0.6 s past a peg, with the density and damping of
a rat's whisker assumed and others true. On the first trial numbers were set, on the others not.
"""

import sys
from pathlib import Path

import numpy as np
from pages import put, table

import vibrissa as vb
from vibrissa.sensors import MOMENT_NOISE
from vibrissa.simulation import Dynamics, Vibration, facing_peg, measure, simulate, sweep_past

GAMMA = vb.samples.gamma()
STRAIGHT = vb.Whisker.straight(30e-3, base_radius=80e-6, youngs_modulus=3.5e9)
BENT = vb.Whisker.parabola(35e-3, 12.0)
# Whisker, distance of the peg over L, its radius, whisks a second, seed, mass, damping ratio.
TRIALS = {
    "γ (numbers set on it)": (GAMMA, 0.65, 1e-3, 5.0, 0, 1.0, 0.14),
    "γ, mass + 20 %, 8 Hz": (GAMMA, 0.5, 0.6e-3, 8.0, 7, 1.2, 0.14),
    "straight, mass − 20 %, damping 0.11": (STRAIGHT, 0.6, 1e-3, 6.0, 3, 0.8, 0.11),
    "γ, mass − 20 %, damping 0.17": (GAMMA, 0.75, 2e-3, 4.0, 11, 0.8, 0.17),
    "γ, mass + 20 %, damping 0.12, 7 Hz": (GAMMA, 0.6, 0.8e-3, 7.0, 21, 1.2, 0.12),
    "parabola, mass − 15 %, damping 0.16": (BENT, 0.55, 1e-3, 6.0, 22, 0.85, 0.16),
}
HEAD = ("trial", "touching", "M_B > 5σ: false, %", "false, %", "found, %", "onset late, ms")


def row(name, whisker, distance, radius, frequency, seed, mass, damping):
    """Shares of untouched frames called contact, and of contact frames found."""
    density = tuple(mass * value for value in Dynamics().density)
    peg = facing_peg(whisker, distance, radius)
    motion = sweep_past(whisker, peg, 0.6, 1000.0, seed=seed, frequency=frequency)
    dynamics = Dynamics(density=density, damping_ratio=damping, step=2e-4)
    trial = measure(simulate(whisker, motion, peg, dynamics=dynamics, nodes=9), seed=seed)
    data = trial.to_dataset().isel(whisker=0)
    touching = trial["truth"].to_dataset().isel(whisker=0).in_contact.values.astype(bool)
    wrench = np.concatenate([data.force.values, data.moment.values], axis=1)
    pose = (data.base_rotation.values, data.base_position.values)
    found = Vibration.of(whisker).in_contact(data.time.values, wrench, *pose, MOMENT_NOISE)
    bare = np.hypot(wrench[:, 4], wrench[:, 5]) > 5.0 * MOMENT_NOISE
    # Onsets after some quiet: how long until the frame is called contact.
    onsets = [i for i in np.flatnonzero(np.diff(touching.astype(int)) == 1) + 1 if i > 5]
    onsets = [i for i in onsets if not touching[i - 5 : i].any()]
    late = [int(np.argmax(found[i:])) for i in onsets]
    shares = (bare[~touching].mean(), found[~touching].mean(), found[touching].mean())
    return [name, str(touching.sum()), *(f"{100 * one:.1f}" for one in shares), str(max(late))]


if __name__ == "__main__":
    text = table(HEAD, [row(name, *trial) for name, trial in TRIALS.items()])
    print(text)
    if "--page" in sys.argv:
        put(Path(__file__).parents[1] / "docs" / "validation.md", {"vibration": text})
