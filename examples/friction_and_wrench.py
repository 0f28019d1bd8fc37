"""Friction, estimated from all six components of force and moment.

Aim: to locate contacts with friction. Data: the built-in γ whisker, touched at the same
point with and without friction along it. Lesson: three signals, used as if there were no friction,
have errors of millimetres; force and moment together give the right point, and the friction.
"""

# %% The same contact without friction, and with 0.3 along the whisker toward the tip or the base
import sys
from pathlib import Path

import numpy as np

import vibrissa as vb
from vibrissa import plots

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "output")
folder.mkdir(parents=True, exist_ok=True)

whisker = vb.samples.gamma()
friction = np.array([0.0, 0.3, -0.3])
press = 60e-6  # N, from the concave side and a little from above
force = np.array([[mu * press, 0.8 * press, -0.6 * press] for mu in friction])
bent = vb.deflect(whisker, vb.PointForce(0.7 * whisker.length, components=force))

# %% A sensor reads all of force and moment, 1 µN and 0.02 µN·m
rng = np.random.default_rng(2)
noise = {"Fx": 1e-6, "Fy": 1e-6, "Fz": 1e-6, "Mx": 2e-8, "My": 2e-8, "Mz": 2e-8}
sigma = np.array(list(noise.values())).reshape(2, 3)
read_force, read_moment = (
    true + rng.normal(size=true.shape) * s
    for true, s in zip((bent.force, bent.moment), sigma, strict=True)
)

# %% Three signals without friction, and the wrench
contact_map = vb.ContactMap.simulate(whisker, grid=False)
signals = vb.base_signals(read_force, read_moment)
three = contact_map.estimate(signals, ("Fx", "MB", "MD"))
six = vb.estimate_from_wrench(whisker, read_force, read_moment, noise=noise)
for i, mu in enumerate(friction):
    true = bent.contact_point[i]
    error = [1e3 * np.linalg.norm(found.point[i] - true) for found in (three, six)]
    predicted = 1e3 * np.sqrt(np.trace(six.covariance[i]))
    angle, spread = np.degrees([six.friction_angle[i], six.friction_angle_sigma[i]])
    print(
        f"friction {mu:+.1f}: error of three signals {error[0]:5.2f} mm, wrench {error[1]:.2f} mm",
        end=" ",
    )
    print(f"(± {predicted:.2f}); angle {angle:.1f}° ± {spread:.1f}°, true:", end=" ")
    print(f"{np.degrees(np.arctan(mu)):.1f}°")

# %% The three bent whiskers with the forces on them: friction is a small part of the shape
names = ["no friction", "0.3 toward the tip", "0.3 toward the base"]
distance = [
    1e3 * np.linalg.norm(found.point - bent.contact_point, axis=1)[1:].max()
    for found in (three, six)
]
figure = plots.bent_views(
    whisker.centerline(101),
    bent.centerline(101),
    bent.contact_point,
    bent.force,
    labels=names,
    finding="With friction contacts from three signals (×) have errors of up to {:.1f} mm, "
    "those of force and moment (+) of {:.2f} mm".format(*distance),
)
lines, _ = figure.axes[0].get_legend_handles_labels()
for axes, side in zip(figure.axes, (1, 2), strict=False):
    for found, mark in ((three, "x"), (six, "+")):
        for point, line in zip(1e3 * found.point, lines, strict=True):
            axes.plot(point[0], point[side], mark, color=line.get_color(), markersize=7, zorder=5)
plots.save(figure, folder / "friction_and_wrench", ["png"])
