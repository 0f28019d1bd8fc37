"""The six signals over the space that the whisker can reach (the paper's Fig. 2C)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from vibrissa.plots.colours import cyclic, diverging, sequential
from vibrissa.plots.style import (
    INK,
    WIDTHS,
    Array,
    Mask,
    looking,
    new_figure,
    plain,
    robust_limits,
    say,
)
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
    kept: Mask = np.asarray(np.isfinite(points).all(axis=1))
    signals = {name: samples[name].transpose(*shape).to_numpy().ravel() for name in SIGNALS}
    for values in signals.values():
        kept &= np.isfinite(values)
    if "status" in samples:
        kept &= is_ok(samples["status"].transpose(*shape).to_numpy().ravel())
    if "small_deflection" in samples:
        kept &= ~samples["small_deflection"].transpose(*shape).to_numpy().ravel().astype(bool)
    elif centerline is not None:
        rows = np.flatnonzero(kept)
        line = np.asarray(centerline, dtype=np.float64)
        kept[rows[_near_rest(points[rows], line)]] = False
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
    cutaway: bool = True,
    elevation: float = 24.0,
    azimuth: float = -58.0,
) -> Figure:
    """Draw the six signals over the space that the whisker can reach.

    Six clouds of contact points, one for each signal that gives the colour: forces above, moments
    below. Small deflections (2° about rest) are left out as in the paper. Limits of colours leave
    out the outermost 2 % of the values; where they do, the colour bar has a pointed end.

    Parameters
    ----------
    samples : Dataset
        ``ContactMap.grid`` or ``ContactMap.to_dataset()``; see :func:`cloud`.
    centerline : array_like (k, 3), optional
        Of the resting whisker, whisker frame, m; drawn in black.
    cutaway : bool
        Whether the quarter that faces the viewer is taken away, along the resting whisker, so that
        the whisker and what lies about it are seen.
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
    points = to_display("contact_point", contacts.points)
    line = None if centerline is None else to_display("centerline", centerline)
    with looking():
        figure = new_figure("double", _HEIGHT, None)
        if len(points) == 0:
            say(figure, "no contacts")
            return figure
        limits = _limits(points, line)
        # In an order of its own: an even stride would pick the same rows of a grid again and again.
        shown = np.random.default_rng(0).permutation(len(points))
        if cutaway:
            shown = shown[~_facing(points[shown], line, elevation, azimuth)]
        shown = shown[:_MOST]
        # Fewer contacts are drawn as larger dots.
        dot = _DOTS | {"s": float(np.clip(6e4 / max(len(shown), 1), 2.0, 8.0))}
        for i, name in enumerate(SIGNALS):
            left, bottom = (i % 3) / 3.0, 0.5 * (1 - i // 3)
            axes = _axes(figure, left, bottom, limits, (elevation, azimuth))
            values = to_display(name, contacts.signals[name])
            scale, ends = _scale(name, values)
            dots = axes.scatter(*points[shown].T, c=values[shown], **scale, **dot)
            if line is not None:
                axes.plot(*line.T, color="black", linewidth=1.4, zorder=10)
            rail = figure.add_axes((left + 0.07, bottom + 0.066, 0.2, 0.013))
            _bar(figure.colorbar(dots, cax=rail, extend=ends, orientation="horizontal"), name)
            for text, right, look in (("abcdef"[i], 0.012, _BOLD), (_title(name), 0.034, _WORDS)):
                figure.text(left + right, bottom + 0.467, text, **look)
        return figure


_HEIGHT = 124.0
"""Of the figure, mm."""

_DOTS: dict[str, Any] = {"linewidths": 0.0, "depthshade": False, "rasterized": True}
_BOLD: dict[str, Any] = {"fontsize": 8.0, "fontweight": "bold"}
_WORDS: dict[str, Any] = {"fontsize": 7.0}


def _title(name: str) -> str:
    return quantity(name).long_name


def _facing(points: Array, line: Array | None, elevation: float, azimuth: float) -> Mask:
    """Whether points (n, 3) lie in the quarter before the resting whisker, toward the viewer."""
    rest = np.zeros((2, len(points)))
    if line is not None:
        reach = np.linalg.norm(line, axis=1)
        order = np.argsort(reach)
        r = np.linalg.norm(points, axis=1)
        rest = np.array([np.interp(r, reach[order], line[order, k]) for k in (1, 2)])
    toward = np.sign(np.sin(np.radians(azimuth))), np.sign(elevation)
    aside, above = points[:, 1] - rest[0], points[:, 2] - rest[1]
    return np.asarray((aside * toward[0] > 0.0) & (above * toward[1] > 0.0))


def _scale(name: str, values: Array) -> tuple[dict[str, Any], str]:
    """Limits and map of the colours of a signal, and which ends of the map are exceeded."""
    if name in DIRECTIONS:
        return {"vmin": -180.0, "vmax": 180.0, "cmap": cyclic()}, "neither"
    signed = name == "Mx"
    low, high = robust_limits(values, symmetric=signed)
    if name in ("FT", "MB"):
        low = 0.0
    below, above = bool(values.min() < low), bool(values.max() > high)
    ends = ("neither", "max", "min", "both")[2 * below + above]
    return {"vmin": low, "vmax": high, "cmap": diverging() if signed else sequential()}, ends


def _bar(bar: Colorbar, name: str) -> None:
    plain(bar)
    bar.ax.tick_params(length=2.0, pad=1.5)
    bar.ax.set_xlabel(axis_label(name))
    if name in DIRECTIONS:
        bar.set_ticks([-180.0, -90.0, 0.0, 90.0, 180.0])
    else:
        bar.locator = MaxNLocator(4)
        bar.update_ticks()


def _limits(points: Array, line: Array | None) -> Array:
    """Limits (3, 2) of x, y and z that hold all points, the base and the whisker."""
    everything = np.concatenate([points, np.zeros((1, 3)), *([] if line is None else [line])])
    low, high = np.nanmin(everything, axis=0), np.nanmax(everything, axis=0)
    room = 0.02 * (high - low).max()
    return np.stack([low - room, high + room], axis=1)


def _axes(
    figure: Figure, left: float, bottom: float, limits: Array, view: tuple[float, float]
) -> Any:
    """Three-dimensional axes to one scale in a sixth of the figure."""
    # Matplotlib's 3D axes carry no types, and stay square: the box reaches beyond the panel.
    tall = 0.36 * WIDTHS["double"] / _HEIGHT
    box = (left - 0.031, bottom + 0.297 - 0.5 * tall, 0.36, tall)
    axes: Any = figure.add_axes(box, projection="3d", computed_zorder=False)
    axes.patch.set_visible(False)
    axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
    axes.set_box_aspect(tuple(np.ptp(limits, axis=1)), zoom=0.86)
    axes.view_init(*view)
    axes.set_proj_type("persp", focal_length=1.6)
    for name, pad in (("x", -9.0), ("y", -10.0), ("z", -11.0)):
        axis = getattr(axes, f"{name}axis")
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.line.set(color=INK, linewidth=0.5)
        axis._axinfo["grid"].update(color="#e2e2e2", linewidth=0.4)
        axis.set_label_text(axis_label(name), fontsize=6.0)
        axis.labelpad = pad
    axes.tick_params(labelsize=5.5, pad=-4.0)
    axes.locator_params(nbins=4)
    return axes
