"""Your own object: a mesh that a whisker explores, and a free surface through its contacts.

Aim: to estimate the shape of an unknown object. Data: a rounded stone as a closed
mesh, and a whisker that whisks while its base rises. Lesson: a surface through the contacts gives
the shape where the stone was touched, with its uncertainty; elsewhere it is only extrapolated.
"""

# %% A stone: corners and triangles; your own is read with Mesh.load("stone.stl") (extra mesh)
import sys
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

import vibrissa as vb
from vibrissa import plots
from vibrissa.contour import shape_from_dataset
from vibrissa.objects import Mesh
from vibrissa.pipeline import contour_points, with_contour
from vibrissa.simulation import measure, simulate, tabulated

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "output")
folder.mkdir(parents=True, exist_ok=True)

rng = np.random.default_rng(5)
way = rng.normal(size=(250, 3))
way /= np.sum(np.abs(way) ** 3, axis=1, keepdims=True) ** (1 / 3)  # a little boxy
hull = ConvexHull(way * [6e-3, 5e-3, 7e-3] + [26e-3, 1e-3, 0.0])
corners = hull.points[hull.simplices]
outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
inside_out = np.einsum("ij,ij->i", outward, hull.equations[:, :3]) < 0.0
faces = np.where(inside_out[:, None], hull.simplices[:, ::-1], hull.simplices)
stone = Mesh(hull.points, faces, resolution=0.4e-3)
print(stone)

# %% Whisk against it from behind, again and again, while the base rises by 10 mm and sways
whisker = vb.samples.gamma()
time = np.linspace(0.0, 0.5, 101)
azimuth = np.radians(-32.0 + 14.0 * np.sin(2.0 * np.pi * 10.0 * time))
base = np.stack([3e-3 * np.cos(15.0 * time), 0.0 * time, np.linspace(-5e-3, 5e-3, 101)], axis=1)
motion = tabulated(time, azimuth, base_position=base, rate=300)
trial = measure(simulate(whisker, motion, stone), 0.3e-6, 5e-9)

# %% Contacts from three noisy signals, and a free surface through them
trial = with_contour(trial, "free")
surface = shape_from_dataset(trial["contour"].to_dataset())
points = contour_points(trial)
places = np.stack([points[name].values for name in "xyz"], axis=1)
skin = np.stack([points[f"surface_{name}"].values for name in "xyz"], axis=1)
apart = stone.signed_distance(skin)
print(f"{len(places)} contacts, {1e3 * np.median(np.abs(apart)):.2f} mm from the stone (median)")

# %% Its uncertainty: at the contacts, and 4 mm above the highest of them
beyond = np.vstack([places[:1], places[[np.argmax(places[:, 2])]] + [0.0, 0.0, 4e-3]])
for name, sigma in zip(("touched", "4 mm above"), surface.distance_sigma(beyond), strict=True):
    print(f"{name}: ± {1e3 * sigma:.2f} mm")

# %% Contacts, the stone (grey) and the surface with its 95 % band
figure = plots.contour_views(
    places, stone, surface, colour=points["time"].values, colour_name="time"
)
plots.save(figure, folder / "own_object", ["png"])
