"""From a table of signals to contact points.

Aim: to locate contacts from a sensor's readings. Data: a CSV of force and moment over time, from a
trial that is simulated here with a noisy sensor. Lesson: a table, a whisker and the sensor's noise
are all that is needed; every contact has a stated uncertainty.
"""

# %% The table: time, Fx, Fy, Fz, Mx, My, Mz in s, N and N·m, whisker frame
import sys
from pathlib import Path

import numpy as np

import vibrissa as vb
from vibrissa import plots
from vibrissa.io import load_signals, save_contacts, save_signals
from vibrissa.pipeline import contact_columns, locate
from vibrissa.sensors import component_noise
from vibrissa.signals import spherical
from vibrissa.simulation import facing_peg, measure, simulate, sweep_past

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "output")
folder.mkdir(parents=True, exist_ok=True)

whisker = vb.samples.gamma()
peg = facing_peg(whisker)
motion = sweep_past(whisker, peg, duration=0.4, rate=500, seed=3)
trial = measure(simulate(whisker, motion, peg), 1e-6, 2e-8, seed=3).isel(whisker=0)
save_signals(folder / "signals.csv", trial.to_dataset())

# %% Your own is read in the same way, with vb.load_whisker("whisker.csv") as whisker
wrench = load_signals(folder / "signals.csv")
contact_map = vb.ContactMap.simulate(whisker, grid=False)
found = locate(contact_map, wrench, ("Fx", "MB", "MD"), noise=component_noise(1e-6, 2e-8))
save_contacts(folder / "contacts.csv", contact_columns(found))
# The same on the command line: vibrissa estimate signals.csv --whisker whisker.csv -o contacts.csv

# %% Errors, compared with the truth, which is known in a simulation only
truth = trial["truth"].to_dataset()
true, guess = truth["contact_point_whisker"].values, found["contact_point_whisker"].values
error = np.linalg.norm(guess - true, axis=1)
predicted = np.sqrt(np.einsum("tii->t", found["covariance"].values))
known = np.isfinite(error)
touching = int(truth["in_contact"].sum())
print(f"{len(error)} frames, {touching} in contact, {known.sum()} located", end="; ")
print(f"{int((found.candidates.values > 1).sum())} with several candidates")
for name, some in (("surest", predicted < 0.3e-3), ("others", predicted >= 0.3e-3)):
    middle = 1e3 * np.median(error[known & some]), 1e3 * np.median(predicted[known & some])
    print(f"{name}: error {middle[0]:.2f} mm, predicted {middle[1]:.2f} mm (medians)")

# %% Estimated against true contacts, and over time
figure = plots.estimated_against_true(spherical(true), spherical(guess), time=found["time"].values)
plots.save(figure, folder / "signals_to_contacts", ["png"])
