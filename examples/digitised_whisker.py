"""A real whisker: from noisy points, digitised in any frame, to a whisker that bends.

Aim: to obtain a whisker from the points of a microscope or a scanner. Data: a centreline that is
digitised here, from a known whisker, with noise of 20 µm. Lesson: noise and frame are estimated
automatically, and the remaining error changes the signals by a hundredth.
"""

# %% Points along a whisker, in the scanner's frame, mm
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import vibrissa as vb
from vibrissa import plots

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "output")
folder.mkdir(parents=True, exist_ok=True)

true = vb.Whisker.parabola(length=36e-3, coefficient=11.0, base_radius=85e-6, tip_radius=5e-6)
turn = Rotation.from_euler("xyz", [120.0, -40.0, 25.0], degrees=True)
rng = np.random.default_rng(4)
points = turn.apply(true.centerline(90)) + np.array([12e-3, -3e-3, 7e-3])
points += rng.normal(scale=20e-6, size=points.shape)

file = folder / "digitised_whisker.csv"
np.savetxt(file, 1e3 * points, fmt="%.4f", delimiter=",", header="x_mm,y_mm,z_mm", comments="")

# %% Your own is read in the same way: columns x_mm,y_mm,z_mm or x,y,z (m), from base to tip
# Radius and material, which no picture shows, are given; base="last" if the base comes last.
whisker = vb.load_whisker(file, base_radius=85e-6, tip_radius=5e-6, youngs_modulus=3e9)
print(whisker)

# %% Its own frame: the base at the origin, x along the tangent there, curved toward +y
tangent = whisker.pose.rotation[:, 0]
off = np.degrees(np.arccos(tangent @ turn.as_matrix()[:, 0]))
rms = np.sqrt(np.mean(np.sum((whisker.centerline(200) - true.centerline(200)) ** 2, axis=1)))
print(f"Length {1e3 * whisker.length:.2f} mm (true: {1e3 * true.length:.2f} mm).")
print(f"Error of the direction at the base {off:.2f}°, of the shape {1e6 * rms:.0f} µm.")

# %% The effect on the signals: both whiskers are pushed to the same point
touch = vb.PointContact([22e-3, 11e-3, 1e-3])
bent, expected = vb.deflect(whisker, touch), vb.deflect(true, touch)
for name in ("force", "moment"):
    found, right = getattr(bent, name), getattr(expected, name)
    error = np.linalg.norm(found - right) / np.linalg.norm(right)
    print(f"{name}: error {100 * error:.1f} %")

# %% The whisker in three views
s = np.linspace(0.0, whisker.length, 201)
name = f"From points with 20 µm of noise: a shape with an error of {1e6 * rms:.0f} µm"
figure = plots.whisker_views(whisker.centerline(201), whisker.radius(s), name=name, width="double")
plots.save(figure, folder / "digitised_whisker", ["png"])
