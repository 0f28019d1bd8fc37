"""The picture of the page on tracking: what is traced, and the force and moment that follow."""

import tempfile
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import vibrissa as vb
from vibrissa.cameras import orthogonal_views
from vibrissa.io import read_video
from vibrissa.numerics import Array
from vibrissa.plots.overview import size_bar
from vibrissa.plots.style import (
    MUTED,
    ORANGE,
    RED,
    TRACE,
    box_axes,
    conclude,
    head,
    looking,
    new_figure,
    size_label,
)
from vibrissa.quantities import axis_label, to_display
from vibrissa.simulation import facing_peg, film, simulate, sweep_past, with_true_traces
from vibrissa.tracking import TrackOptions, trace_video, track

RATE, DURATION = 500.0, 0.2
HEIGHT = 92.0
TALL = 38.0
PIXEL = 58e-6
"""Size of a pixel in space, m."""

DETAIL = 14
"""Half of the detail's width, pixels."""


def tracking_picture() -> Figure:
    """Track a whisk past a peg in two films, and draw a frame and what comes out."""
    whisker = vb.samples.gamma()
    peg = facing_peg(whisker)
    trial = simulate(whisker, sweep_past(whisker, peg, DURATION, RATE, seed=1), peg)
    cameras = orthogonal_views(PIXEL, (760, 620), center=[18e-3, 0.0, 0.0])
    truth = with_true_traces(trial, cameras)["truth"].to_dataset().isel(whisker=0)
    with tempfile.TemporaryDirectory() as folder:
        files = {camera.name: Path(folder) / f"{camera.name}.mp4" for camera in cameras}
        film(trial, files, cameras, seed=1)
        frames = [np.stack(list(read_video(file))) for file in files.values()]
        traces = [trace_video(images) for images in frames]
    known = {"base_radius": whisker.base_radius, "tip_radius": whisker.tip_radius}
    found = track(cameras, traces, RATE, TrackOptions(properties=known)).to_dataset()
    found = found.isel(whisker=0)
    row = int(np.nanargmax(np.linalg.norm(found["moment"].values, axis=-1)))
    with looking():
        figure = new_figure("double", HEIGHT, None)
        sights(figure, [images[row] for images in frames], found, row)
        away = curves(figure, found, truth)
        conclude(
            figure, f"Tracked forces are {100.0 * away:.1f} % from the true ones in the median"
        )
        return figure


def sights(figure: Figure, images: list[Array], found: xr.Dataset, row: int) -> None:
    """The frame in both views, and a detail about the contact."""
    traces = found["trace"].transpose("view", "time", "node", "image_axis").values[:, row]
    seen = found["trace_visible"].transpose("view", "time", "node").values[:, row].astype(bool)
    wide = TALL * 760 / 620
    for i, (image, trace, there) in enumerate(zip(images, traces, seen, strict=True)):
        axes = picture(figure, (1.0 + i * (wide + 2.0), HEIGHT - TALL - 6.0, wide, TALL), image)
        axes.plot(*trace[there].T, **TRACE)
        size_bar(axes, 5e-3 / PIXEL / image.shape[1], "5 mm")
        head(axes, "ab"[i], ("from the top, and the trace", "from the front")[i])
    middle = traces[0][np.flatnonzero(seen[0])[int(0.35 * seen[0].sum())]].round()
    box = (2.0 * (wide + 2.0) + 1.0, HEIGHT - TALL - 6.0, 178.0 - 2.0 * (wide + 2.0) - 2.0, TALL)
    axes = picture(figure, box, images[0])
    half = np.array([DETAIL, DETAIL * TALL / box[2]])
    (left, top), (right, bottom) = middle - half, middle + half
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.plot(*traces[0].T, "o-", color=RED, linewidth=0.9, markersize=2.0)
    size_bar(axes, 0.5e-3 / PIXEL / (right - left), "0.5 mm")
    head(axes, "c", "points of the trace on pixels of the image")


def picture(figure: Figure, box: tuple[float, float, float, float], image: Array) -> Axes:
    """An image that fills a panel."""
    axes = box_axes(figure, box)
    axes.imshow(image, cmap="gray", vmin=0, vmax=255, aspect="auto", interpolation="nearest")
    axes.set_axis_off()
    return axes


def curves(figure: Figure, found: xr.Dataset, truth: xr.Dataset) -> float:
    """Sizes of force and moment over time, and their truth; the relative error of the force."""
    touching = found["in_contact"].values.astype(bool)
    for i, name in enumerate(("force", "moment")):
        axes = box_axes(figure, (12.0 + 90.0 * i, 9.0, 74.0, 30.0))
        size, true = (
            to_display(name, np.linalg.norm(data[name].transpose("time", "space"), axis=1))
            for data in (found, truth)
        )
        time = found["time"].values
        axes.plot(time, true, color=MUTED, linewidth=2.2, label="true")
        axes.plot(time, np.where(touching, size, np.nan), color=ORANGE, label="tracked")
        axes.set(xlabel=axis_label("time"), ylabel=size_label(name))
        axes.locator_params(nbins=5)
        head(axes, "de"[i], f"size of the {name}")
        if i == 0:
            axes.legend(loc="upper right")
            away = np.abs(size / np.where(true > 0.0, true, np.nan) - 1.0)[touching]
    return float(np.nanmedian(away))
