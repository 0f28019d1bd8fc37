"""The six signals over the space that the whisker can reach (the paper's Fig. 2C)."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from numpy.typing import ArrayLike

from vibrissa.plots.colours import cyclic, diverging, sequential
from vibrissa.plots.style import INK, LOOK, Array, Mask, new_figure, robust_limits, say
from vibrissa.quantities import axis_label, quantity, to_display
from vibrissa.status import is_ok

SIGNALS = ("Fx", "FT", "FD", "Mx", "MB", "MD")
DIRECTIONS = ("FD", "MD")
_CONE = np.deg2rad(2.0)
_MOST = 30_000
"""Points drawn in one cloud at most; more cannot be told apart on paper."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Contacts as a list.

    Parameters
    ----------
    points : array (n, 3)
        Contact points, whisker frame, m.
    signals : dict of str to array (n,)
        The six signals, SI units.
    """

    points: Array
    signals: dict[str, Array]


def cloud(samples: xr.Dataset, centerline: ArrayLike | None = None) -> Cloud:
    """Make a list of the contacts of a dataset that have an answer.

    Parameters
    ----------
    samples : Dataset
        Either nodes of a map, any dims, with ``contact_point`` (…, space); or the paper's grid over
        the coordinates ``r``, ``theta`` and ``phi``. Both with the six signals, SI units; with
        ``status`` and ``small_deflection`` if known.
    centerline : array_like (k, 3), optional
        Of the resting whisker, m. Where the dataset does not tell which deflections are small,
        contacts nearer to this line than tan 2° times the arc length there are left out.

    Returns
    -------
    Cloud
        Without missing points, contacts that have no answer, and small deflections.

    Raises
    ------
    ValueError
        If the dataset lacks signals or contact points.
    """
    missing = [name for name in SIGNALS if name not in samples]
    if "contact_point" not in samples and not {"r", "theta", "phi"} <= set(samples.coords):
        missing.append("contact_point (or the coordinates r, theta, phi)")
    if missing:
        raise ValueError(f"the samples lack {', '.join(missing)}")
    shape = samples["Fx"].dims
    points = _contact_points(samples)
    kept = np.isfinite(points).all(axis=1)
    signals = {name: samples[name].transpose(*shape).to_numpy().ravel() for name in SIGNALS}
    for values in signals.values():
        kept &= np.isfinite(values)
    if "status" in samples:
        kept &= is_ok(samples["status"].transpose(*shape).to_numpy().ravel())
    if "small_deflection" in samples:
        kept &= ~samples["small_deflection"].transpose(*shape).to_numpy().ravel().astype(bool)
    elif centerline is not None:
        kept[kept] = ~_near_rest(points[kept], np.asarray(centerline, dtype=np.float64))
    return Cloud(points[kept], {name: values[kept] for name, values in signals.items()})


def _contact_points(samples: xr.Dataset) -> Array:
    """Contact points (n, 3), m, in the order of the signals."""
    dims = samples["Fx"].dims
    if "contact_point" in samples:
        points = samples["contact_point"].transpose(*dims, "space").to_numpy()
        return np.asarray(points.reshape(-1, 3), dtype=np.float64)
    r, theta, phi = xr.broadcast(samples["r"], samples["theta"], samples["phi"])
    place = (r * np.cos(phi) * np.cos(theta), r * np.cos(phi) * np.sin(theta), r * np.sin(phi))
    return np.stack([axis.transpose(*dims).to_numpy().ravel() for axis in place], axis=1)


def _near_rest(points: Array, line: Array) -> Mask:
    """Whether points (n, 3) lie in the cone of small deflection about a line (k, 3)."""
    from scipy.spatial import cKDTree  # a tenth of a second, so only where it is needed

    count = max(1000, len(line))
    nodes = np.linspace(0.0, len(line) - 1.0, count)
    fine = np.stack([np.interp(nodes, np.arange(len(line)), c) for c in line.T], axis=1)
    step = np.linalg.norm(np.diff(fine, axis=0), axis=1)
    arc_length = np.concatenate([[0.0], np.cumsum(step)])
    distance, nearest = cKDTree(fine).query(points)
    return np.asarray(distance < arc_length[nearest] * np.tan(_CONE))


def signal_clouds(
    samples: xr.Dataset,
    centerline: ArrayLike | None = None,
    *,
    elevation: float = 22.0,
    azimuth: float = -62.0,
) -> Figure:
    """Draw the six signals over the space that the whisker can reach.

    Six clouds of contact points, one for each signal that gives the colour: forces above, moments
    below. Small deflections (2° about rest) are left out as in the paper. Limits of colours leave
    out the outermost 2 % of the values; where they do, the colour bar has pointed ends.

    Parameters
    ----------
    samples : Dataset
        ``ContactMap.grid`` or ``ContactMap.to_dataset()``; see :func:`cloud`.
    centerline : array_like (k, 3), optional
        Of the resting whisker, whisker frame, m; drawn in black.
    elevation, azimuth : float
        From where the clouds are seen, degrees.

    Returns
    -------
    Figure
        Two columns wide, with six 3D axes in mm and six colour bars; or the sentence "no contacts".

    Raises
    ------
    ValueError
        If the dataset lacks signals or contact points.
    """
    contacts = cloud(samples, centerline)
    line = None if centerline is None else to_display("centerline", centerline)
    with mpl.rc_context(dict(LOOK)):
        figure = new_figure("double", 112.0, None)
        if len(contacts.points) == 0:
            say(figure, "no contacts")
            return figure
        points = to_display("contact_point", contacts.points)
        limits = _limits(points, line)
        # An even stride would pick the same rows of a grid again and again.
        order = np.random.default_rng(0).permutation(len(points))[:_MOST]
        for i, name in enumerate(SIGNALS):
            left, bottom = (i % 3) / 3.0, 0.5 * (1 - i // 3)
            box = (left - 0.018, bottom + 0.035, 0.325, 0.45)
            axes = figure.add_axes(box, projection="3d", computed_zorder=False)
            assert isinstance(axes, Axes3D)
            _frame(axes, limits, (elevation, azimuth))
            values = to_display(name, contacts.signals[name])
            low, high, colours, extend = _scale(name, values)
            dots = axes.scatter(
                *points[order].T,
                c=values[order],
                cmap=colours,
                vmin=low,
                vmax=high,
                s=1.2,
                linewidths=0.0,
                depthshade=False,
                rasterized=True,
            )
            if line is not None:
                axes.plot(*line.T, color="black", linewidth=1.2, zorder=10)
            rail = figure.add_axes((left + 0.283, bottom + 0.13, 0.009, 0.25))
            bar = figure.colorbar(dots, cax=rail, extend=extend)
            _finish(bar, name)
            title = quantity(name).long_name
            figure.text(left + 0.015, bottom + 0.475, "abcdef"[i], fontweight="bold", fontsize=8.0)
            figure.text(left + 0.04, bottom + 0.475, title, fontsize=7.5)
        return figure


def _scale(name: str, values: Array) -> tuple[float, float, Colormap, str]:
    """Limits and map of the colours of a signal, and which ends are cut off."""
    if name in DIRECTIONS:
        return -180.0, 180.0, cyclic(), "neither"
    signed = name == "Mx"
    low, high = robust_limits(values, symmetric=signed)
    if name in ("FT", "MB"):
        low = 0.0
    below, above = values.min() < low, values.max() > high
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}
    return low, high, diverging() if signed else sequential(), extend[below, above]


def _finish(bar: Colorbar, name: str) -> None:
    bar.outline.set_linewidth(0.0)  # type: ignore[operator]
    bar.ax.tick_params(length=2.0, pad=1.5, labelsize=6.0)
    bar.ax.set_title(axis_label(name), fontsize=7.0, pad=5.0)
    if name in DIRECTIONS:
        bar.set_ticks([-180.0, -90.0, 0.0, 90.0, 180.0])


def _limits(points: Array, line: Array | None) -> Array:
    """Limits (3, 2) of x, y and z that hold all points, the base and the whisker."""
    everything = np.concatenate([points, np.zeros((1, 3)), *([] if line is None else [line])])
    low, high = everything.min(axis=0), everything.max(axis=0)
    room = 0.02 * (high - low).max()
    return np.stack([low - room, high + room], axis=1)


def _frame(axes: Axes3D, limits: Array, view: tuple[float, float]) -> None:
    axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
    axes.set_box_aspect(tuple(np.ptp(limits, axis=1)), zoom=1.1)
    axes.view_init(*view)
    axes.set_proj_type("persp", focal_length=1.4)
    for axis, name in ((axes.xaxis, "x"), (axes.yaxis, "y"), (axes.zaxis, "z")):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.line.set(color=INK, linewidth=0.5)
        axis._axinfo["grid"].update(color="#e2e2e2", linewidth=0.4)
        axis.set_label_text(axis_label(name), fontsize=6.0)
        axis.labelpad = -11.0
    axes.tick_params(labelsize=5.5, pad=-4.0)
    axes.locator_params(nbins=4)
