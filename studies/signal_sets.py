"""How well three, four and six noisy signals locate the contacts of the γ whisker.

`python studies/signal_sets.py [MICRONEWTON [MICRONEWTON_METRE]]`, 1 and 0.02 by default, prints a
row for each set of signals; about a minute. 2048 contacts outside the 2° cone stand for equal
volumes of space; to each one's force and moment the sensor's noise is added once.
"""

import sys

import numpy as np

import vibrissa as vb
from vibrissa.mapping.places import sample, spread

SETS = (
    ("Fx", "MB", "MD"),
    ("Fx", "FT", "MD"),
    ("FT", "MB", "MD"),
    ("Mx", "MB", "MD"),
    ("Fx", "FT", "MB", "MD"),
    ("Fx", "Mx", "MB", "MD"),
    ("Fx", "FT", "FD", "Mx", "MB", "MD"),
)
NUMBER = 2048

force_noise = float(sys.argv[1]) * 1e-6 if len(sys.argv) > 1 else 1e-6
moment_noise = float(sys.argv[2]) * 1e-6 if len(sys.argv) > 2 else 2e-8
rng = np.random.default_rng(0)
whisker = vb.samples.gamma()
contacts = vb.ContactMap.simulate(whisker, grid=False)
scale = contacts.chart.discretization

spread_out = sample(contacts, spread(8 * NUMBER, 0), "reachable")
volume = spread_out.volume * (spread_out.places.inside & (spread_out.places.angle > np.deg2rad(2)))
rows = rng.choice(len(volume), NUMBER, p=volume / volume.sum())
values = spread_out.places.values[rows]
point = values[:, 3:] * scale.length
force = values[:, :3] * scale.force
moment = np.cross(point, force)

felt_force = force + force_noise * rng.standard_normal(force.shape)
felt_moment = moment + moment_noise * rng.standard_normal(moment.shape)
noise = np.diag([force_noise] * 3 + [moment_noise] * 3) ** 2
felt = vb.base_signals(felt_force, felt_moment)


def report(name, found):
    """Print errors in mm, of the candidate named first and of the nearest one."""
    first = 1e3 * np.linalg.norm(found.point - point, axis=1)
    nearest = 1e3 * np.linalg.norm(found.candidates - point[:, None], axis=2)
    best = np.where(np.isfinite(nearest), nearest, np.inf).min(axis=1)
    none, several = found.n_candidates == 0, found.n_candidates > 1
    shown = [*np.quantile(first[~none], [0.5, 0.9]), np.quantile(best[~none], 0.9)]
    shares = [100 * several.mean(), 100 * none.mean()]
    print(
        f"{name:18}" + "".join(f"{x:10.3f}" for x in shown) + "".join(f"{x:9.1f}" for x in shares)
    )


print(f"{'mm and %':18}{'median':>10}{'90 %':>10}{'nearest':>10}{'several':>9}{'none':>9}")
for names in SETS:
    report(" ".join(names), contacts.estimate(felt, names, noise=noise))
report("wrench", vb.estimate_from_wrench(whisker, felt_force, felt_moment, noise=noise))
