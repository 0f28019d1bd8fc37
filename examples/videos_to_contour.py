"""Two videos to the contour of an object.

Aim: to reconstruct a touched object from the videos of two cameras. Data: a whisk of 0.2 s past a
peg, simulated and filmed here, coarsely: 300 frames a second, 0.12 mm a pixel. Lesson: two films
give the whisker in space, the contact points and forces, and the peg.
"""

# %% Two small films of a whisk past a peg, to be replaced by your own
import sys
from pathlib import Path

import numpy as np

import vibrissa as vb
from vibrissa import plots
from vibrissa.cameras import orthogonal_views
from vibrissa.contour import shape_from_dataset
from vibrissa.io import read_video
from vibrissa.pipeline import with_contour
from vibrissa.recording import Recording
from vibrissa.scene import course_of
from vibrissa.simulation import facing_peg, film, simulate, sweep_past
from vibrissa.tracking import TrackOptions, trace_video, track

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "output")
folder.mkdir(parents=True, exist_ok=True)

whisker = vb.samples.gamma()
peg, rate = facing_peg(whisker), 300.0
trial = simulate(whisker, sweep_past(whisker, peg, duration=0.2, rate=rate, seed=1), peg)
cameras = orthogonal_views(0.12e-3, (360, 360), center=[15e-3, 2e-3, 0.0])
files = {camera.name: folder / f"{camera.name}.mp4" for camera in cameras}
film(trial, files, cameras, seed=1)

# %% Trace the whisker in each view, merge the views, fit the rod with the stated radii
# Your own cameras come from their calibration: vibrissa.cameras.load_cameras("cameras.toml").
traces = [trace_video(read_video(files[camera.name])) for camera in cameras]
known = {"base_radius": whisker.base_radius, "tip_radius": whisker.tip_radius}
tracked = track(cameras, traces, rate, TrackOptions(properties=known))

# %% What was tracked against what was filmed
truth, one = trial["truth"].to_dataset().isel(whisker=0), tracked.to_dataset().isel(whisker=0)
both = (truth["in_contact"].values & one["in_contact"].values).astype(bool)
away = np.linalg.norm(one["contact_point"].values - truth["contact_point"].values, axis=1)[both]
force = np.linalg.norm(one["force"].values, axis=1)[both]
print(f"{one.sizes['time']} frames, {both.sum()} in contact; ", end="")
print(f"error of the contact {1e6 * np.median(away):.0f} µm (median), ", end="")
print(f"force up to {1e6 * force.max():.0f} µN")

# %% Signals, contact points and the peg, one command: vibrissa reconstruct trial.nc
contour = with_contour(tracked)
fit = shape_from_dataset(contour["contour"].to_dataset())
print(f"peg: diameter {2e3 * fit.radius:.2f} mm (true: {2e3 * peg.radius:.2f} mm)")

# %% What the cameras saw, and where the contacts are
course = course_of(contour)
line = whisker.centerline(101)
figure = plots.contact_places(course, line, Recording(trial).objects, [fit])
plots.save(figure, folder / "videos_to_contour", ["png"])
