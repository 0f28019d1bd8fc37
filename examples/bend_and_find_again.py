"""Bend one whisker, measure at its base, and find the contact again from three signals.

Aim: a short overview of the method. Data: the built-in γ whisker. Lesson: force and moment at the
base determine where a frictionless whisker is touched; near rest a small error of the signals
causes a large error of the position, and several contacts may have the same signals.
"""

# %% A whisker: 40 mm long, tapered, curved, its tip bent out of the plane
import sys
from pathlib import Path

import numpy as np

import vibrissa as vb
from vibrissa import plots

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "output")
folder.mkdir(parents=True, exist_ok=True)

whisker = vb.samples.gamma()
print(whisker)

# %% Touch it at three points (whisker frame, m): light, firm, and where it would have slipped off
points = np.array([[0.030, 0.0115, 0.000], [0.024, 0.014, 0.002], [0.010, 0.030, 0.000]])
bent = vb.deflect(whisker, vb.PointContact(points))
for point, force, status in zip(points, bent.force, bent.status, strict=True):
    print(point * 1e3, "mm:", np.round(force * 1e6, 2), "µN.", vb.Status(status).explanation)

# %% Base signals
signals = vb.base_signals(bent.force, bent.moment)
print(signals)

# %% Back to the contact from axial force, bending moment and its direction, with a sensor's noise
contact_map = vb.ContactMap.simulate(whisker, grid=False)
noise = np.diag([1e-6] * 3 + [0.02e-6] * 3) ** 2  # 1 µN, 0.02 µN·m
found = contact_map.estimate(signals, using=("Fx", "MB", "MD"), noise=noise)
for true, guess, covariance, n in zip(
    points, found.point, found.covariance, found.n_candidates, strict=True
):
    if n:
        sigma = np.sqrt(np.trace(covariance))
        error = np.linalg.norm(guess - true)
        print(
            f"{n} candidate(s), error {error * 1e9:.3f} nm, ± {sigma * 1e3:.2f} mm with the sensor"
        )

# %% The bent whiskers with the forces on them; the contact that slipped off is not drawn
names = [f"{1e6 * np.linalg.norm(force):.1f} µN" for force in bent.force]
held = np.isfinite(bent.force).all(axis=1)
sigma = 1e3 * np.sqrt(np.trace(found.covariance[held], axis1=1, axis2=2))
spread = " and ".join(f"{one:.1f}" for one in sigma)
figure = plots.bent_views(
    whisker.centerline(101),
    bent.centerline(101),
    bent.contact_point,
    bent.force,
    labels=names,
    finding=f"The whisker slips off {len(points) - held.sum()} of {len(points)} points; three "
    f"noisy signals locate the others to {spread} mm",
)
plots.save(figure, folder / "bend_and_find_again", ["png"])
