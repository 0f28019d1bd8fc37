"""The whisker in three views, with its taper; bent ones, with their contacts and forces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from vibrissa.numerics import Array
from vibrissa.plots import style
from vibrissa.plots.verdicts import triplet_label
from vibrissa.quantities import axis_label, quantity, to_display
from vibrissa.scene import DIRECTIONS, SIGNALS

_MAGNIFICATIONS = (1, 2, 3, 5, 10, 20, 50, 100)
_WIDE = 0.02  # drawn width at the base, as a share of the whisker's extent, that is aimed at
# Room around and between the views, mm on paper.
_LEFT, _RIGHT, _BOTTOM, _TOP, _GAP = 10.0, 2.0, 8.5, 6.5, 3.5


_NARROWEST = 0.09  # smallest half of an axis, as a share of the whisker's extent


def whisker_views(
    centerline: ArrayLike,
    radius: ArrayLike,
    *,
    name: str | None = None,
    magnification: float | None = None,
    assumed: Sequence[str] = (),
    width: style.Width = "single",
) -> Figure:
    """Draw a whisker from above (x–y), from the side (x–z) and along its base (z–y), to one scale.

    Parameters
    ----------
    centerline : array_like (n, 3)
        Points from base to tip, whisker frame, m; those with NaN are left out.
    radius : array_like (n,) or float
        Radius of the whisker at these points, m.
    name : str, optional
        Title of the figure.
    magnification : float, optional
        Factor by which the width of the whisker is magnified, which the figure states; by default
        it is chosen so that the base is easily visible.
    assumed : sequence of str
        Properties of the whisker that were not measured, listed below the magnification.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        Three axes, in mm, or a sentence if there are fewer than two points.

    Raises
    ------
    ValueError
        If the shapes do not fit.
    """
    points = to_display("centerline", centerline)
    radii = to_display("x", radius)
    if points.ndim != 2 or points.shape[1] != 3 or radii.shape not in ((), (len(points),)):
        raise ValueError(
            f"centerline and radius have shapes {points.shape} and {radii.shape}; "
            "(n, 3) and (n,) are needed"
        )
    radii = np.broadcast_to(radii, (len(points),))
    known = np.isfinite(points).all(axis=1) & np.isfinite(radii)
    points, radii = points[known], radii[known]
    with style.looking():
        if len(points) < 2:
            return style.sentence("no whisker", width)
        figure, axes, magnification = _views(points, radii, magnification, width)
        length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
        size = f"{length:.3g} mm long, radius {1e3 * radii[0]:.3g} to {1e3 * radii[-1]:.3g} µm"
        _caption(axes, name, (size, *(f"assumed: {one}" for one in assumed)), magnification)
        return figure


def _views(
    points: Array, radii: Array, magnification: float | None, width: style.Width
) -> tuple[Figure, Axes, float]:
    extent = float(np.ptp(points, axis=0).max())
    if magnification is None:
        aim = _WIDE * extent / (2.0 * max(radii.max(), 1e-9))
        magnification = max([m for m in _MAGNIFICATIONS if m <= aim], default=1)
    margin = magnification * radii.max() + 0.02 * extent
    limits = style.limits_around(points, margin, _NARROWEST * extent)
    span = np.ptp(limits, axis=1)
    page = style.page_width(width)
    scale = (page - _LEFT - _RIGHT - _GAP) / (span[0] + span[2])  # mm on paper per mm
    height = _BOTTOM + _GAP + _TOP + scale * (span[1] + span[2])
    figure = style.new_figure(width, height, None)

    def place(left: float, bottom: float, i: int, j: int) -> Axes:
        box = (left, bottom, scale * span[i], scale * span[j])
        axes = style.box_axes(figure, box, xlim=limits[i], ylim=limits[j])
        outline = _tube(points[:, [i, j]], magnification * radii)
        axes.add_patch(PathPatch(outline, facecolor=style.INK, edgecolor="none"))
        return axes

    right, above = _LEFT + scale * span[0] + _GAP, _BOTTOM + scale * span[2] + _GAP
    top = place(_LEFT, above, 0, 1)
    side = place(_LEFT, _BOTTOM, 0, 2)
    end = place(right, above, 2, 1)
    top.tick_params(labelbottom=False)
    end.tick_params(labelleft=False)
    top.set_ylabel(axis_label("y"))
    side.set(xlabel=axis_label("x"), ylabel=axis_label("z"))
    end.set_xlabel(axis_label("z"))
    few = max(3, round(scale * span[1] / 12.0))
    for axis, ticks in ((top.yaxis, few), (end.yaxis, few), (side.yaxis, 3), (end.xaxis, 3)):
        axis.set_major_locator(MaxNLocator(ticks, integer=True))
    return figure, top, magnification


def _tube(places: Array, radii: Array) -> Path:
    """Outline of a tube seen from the side: quadrilaterals between nodes, and discs at some."""
    step = np.diff(places, axis=0)
    length = np.hypot(*step.T)
    along = step / np.where(length > 0.0, length, 1.0)[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    near, far = places[:-1], places[1:]
    a, b = radii[:-1, None] * normal, radii[1:, None] * normal
    corners = np.stack([near + a, near - a, far - b, far + b, near + a], axis=1)
    straight = np.einsum("ni,ni->n", along[1:], along[:-1]) > 0.995
    joined = straight & (np.minimum(length[1:], length[:-1]) > 0.1 * radii[1:-1])
    open_ends = np.concatenate([[True], ~joined, [True]])
    disc = Path.unit_circle()
    discs = [
        Path(place + radius * disc.vertices, disc.codes)
        for place, radius in zip(places[open_ends], radii[open_ends], strict=True)
    ]
    return Path.make_compound_path(*(Path(loop, closed=True) for loop in corners), *discs)


def _caption(axes: Axes, name: str | None, words: Sequence[str], magnification: float) -> None:
    """Write the whisker's name, its size and what is assumed, and the drawn width."""
    axes.set_title(name or "whisker", loc="left", fontsize=style.LARGE)
    lines = [f"width × {magnification:g}" if magnification != 1 else "true width", *words]
    axes.text(
        0.02,
        0.97,
        "\n".join(lines),
        transform=axes.transAxes,
        va="top",
        color=style.MUTED,
        fontsize=style.SMALL,
    )


_COLOURS = (style.BLUE, style.ORANGE, style.GREEN, style.INK)
_REST = "#c4c4c4"
_ARROW = 0.2  # length of the longest arrow, as a share of the whiskers' extent
_BENT_GAP = 10.0  # room around and between the views, mm on paper
_ROW = 4.0  # room of a row of the legend, mm
_FORCES = 25.0  # room below the side view from which on forces are drawn there, mm
_BENT_NARROWEST = 0.11  # smallest half of an axis, as a share of the whiskers' extent


class _Drawn(NamedTuple):
    rest: Array
    lines: Array
    points: Array
    arrows: Array
    forces: Array
    colours: list[str]
    labels: Sequence[str]
    dashes: Sequence[Any] = ()


def bent_views(
    rest: ArrayLike,
    centerlines: ArrayLike,
    contact_points: ArrayLike | None = None,
    forces: ArrayLike | None = None,
    *,
    labels: Sequence[str] = (),
    finding: str | None = None,
    width: style.Width = "double",
) -> Figure:
    """Draw bent shapes of a whisker from above (x–y) and from the side (x–z), to one scale.

    Parameters
    ----------
    rest : array_like (n, 3)
        Resting whisker, from base to tip, whisker frame, m.
    centerlines : array_like (m, k, 3)
        Bent whiskers, m; those with NaN, which have no equilibrium, are left out.
    contact_points : array_like (m, 3), optional
        Contact point of each whisker, m.
    forces : array_like (m, 3), optional
        Forces on the whisker, whisker frame, N, drawn as arrows that end at the contact points; the
        longest arrow is a fifth as long as the whisker.
    labels : sequence of str, optional
        Labels of the bent whiskers. Up to four have distinct colours; more are shaded from first to
        last.
    finding : str, optional
        Sentence above the figure; by default the range of the forces.
    width : {"single", "double"}
        Columns of the page: the views are side by side in two, one below the other in one.

    Returns
    -------
    Figure
        Two axes in mm and, if there is room, the sizes of the forces; or the sentence "nothing
        bent".

    Raises
    ------
    ValueError
        If shapes do not fit, or there are forces without contact points.
    """
    straight, lines, points, force = _check(rest, centerlines, contact_points, forces)
    if labels and len(labels) != len(lines):
        raise ValueError(f"there are {len(labels)} labels for {len(lines)} bent whiskers")
    colours = _colours(len(lines))
    known = np.flatnonzero(np.isfinite(lines).all(axis=(1, 2)))
    with style.looking():
        if not known.size:
            return style.sentence("nothing bent", width)
        extent = float(np.ptp(straight, axis=0).max())
        size = np.linalg.norm(force[known], axis=1)
        largest = float(np.nanmax(size)) if np.isfinite(size).any() else 0.0
        arrows = force[known] * (_ARROW * extent / largest if largest > 0.0 else np.nan)
        drawn = _Drawn(
            straight,
            lines[known],
            points[known],
            arrows,
            to_display("force", size),
            [colours[i] for i in known],
            [labels[int(i)] for i in known] if labels else (),
        )
        figure = _bent_figure(drawn, _limits(drawn, extent), width)
        if largest > 0.0 and finding is None:
            low, high = to_display("force", np.array([np.nanmin(size), largest]))
            finding = f"Contacts held by forces from {low:.3g} to {high:.3g} µN"
        if finding:
            style.conclude(figure, finding)
        return figure


def _check(
    rest: ArrayLike,
    centerlines: ArrayLike,
    contact_points: ArrayLike | None,
    forces: ArrayLike | None,
) -> tuple[Array, Array, Array, Array]:
    """Check shapes; return positions in mm, and forces, NaN where they are not given."""
    straight, lines = to_display("centerline", rest), to_display("centerline", centerlines)
    none = np.full((len(lines), 3), np.nan) if lines.ndim else np.empty((0, 3))
    points = none if contact_points is None else to_display("contact_point", contact_points)
    force = none if forces is None else np.asarray(forces, dtype=np.float64)
    right = straight.ndim == 2 and lines.ndim == 3 and straight.shape[-1] == lines.shape[-1] == 3
    if not right or points.shape != none.shape or force.shape != none.shape:
        raise ValueError(
            f"rest, centerlines, contact points and forces have shapes {straight.shape}, "
            f"{lines.shape}, {points.shape} and {force.shape}; (n, 3), (m, k, 3), (m, 3) and "
            "(m, 3) are needed"
        )
    if forces is not None and contact_points is None:
        raise ValueError("there are forces without contact points: give both")
    return straight, lines, points, force


def _colours(count: int) -> list[str]:
    if count <= len(_COLOURS):
        return list(_COLOURS[:count])
    shades = mpl.colormaps["viridis"](np.linspace(0.0, 0.9, count))
    return [mpl.colors.to_hex(shade) for shade in shades]


def _limits(drawn: _Drawn, extent: float, tail: float = 1.0) -> Array:
    """Limits (3, 2), mm, that include whiskers, and arrows lengthened by the factor ``tail``."""
    ends = drawn.points - tail * drawn.arrows
    parts = (drawn.rest, drawn.lines.reshape(-1, 3), drawn.points, ends)
    everything = np.concatenate(parts)
    return style.limits_around(everything, 0.03 * extent, _BENT_NARROWEST * extent)


def _bent_figure(drawn: _Drawn, limits: Array, width: style.Width) -> Figure:
    page, span = style.page_width(width), np.ptp(limits, axis=1)
    abreast = width == "double"
    room = page - _LEFT - _RIGHT
    scale = ((room - _BENT_GAP - _LEFT) / 2.0 if abreast else room) / span[0]
    tall = scale * span[1:]
    below = 0.0 if abreast else tall[1] + _BENT_GAP + _BOTTOM
    columns = 2 if abreast else 1
    rows = -(-len(drawn.labels) // (2 * columns))
    height = (max(tall) if abreast else tall[0]) + below + _BOTTOM + _TOP + _ROW * rows
    figure = style.new_figure(width, height, None)
    for number, j in enumerate((1, 2)):
        across = abreast * number
        left = _LEFT + across * (scale * span[0] + _BENT_GAP + _LEFT)
        above = 0.0 if abreast else number * (tall[0] + _BENT_GAP + _BOTTOM)
        top = height - _TOP - _ROW * rows - above
        box = (left, top - tall[number], scale * span[0], tall[number])
        axes = _panel(figure, box, drawn, limits, j)
        axes.set_xlabel(axis_label("x"))
        style.head(axes, "ab"[number], ("from above", "from the side")[number])
    below_side = tall[0] - tall[1] - _BENT_GAP - _BOTTOM
    if abreast and below_side > _FORCES and np.isfinite(drawn.forces).any():
        corner = _LEFT + scale * span[0] + _BENT_GAP + _LEFT, _BOTTOM
        _forces(style.box_axes(figure, (*corner, scale * span[0], below_side - _TOP)), drawn)
    if drawn.labels:
        handles, texts = figure.axes[0].get_legend_handles_labels()
        # Above the views, from where the first begins.
        place = (_LEFT / page, 1.0 - 0.5 / height)
        figure.legend(
            handles, texts, loc="upper left", bbox_to_anchor=place, ncols=2 * columns, borderpad=0.0
        )
    return figure


def _forces(axes: Axes, drawn: _Drawn) -> None:
    """Draw the sizes of the forces over the distances of the contacts from rest."""
    away = np.linalg.norm(drawn.points[:, None] - drawn.rest, axis=-1).min(axis=1)
    axes.scatter(away, drawn.forces, 14.0, color=drawn.colours, zorder=3)
    axes.set(xlabel="distance of the contact from rest (mm)", ylabel=style.size_label("force"))
    axes.set(xlim=(0.0, None), ylim=(0.0, None))
    style.head(axes, "c", "force on each whisker, in its colour")


def _panel(figure: Figure, box: style.Box, drawn: _Drawn, limits: Array, j: int) -> Axes:
    """Whiskers, contacts and forces, seen along y or z."""
    axes = style.box_axes(figure, box, xlim=limits[0], ylim=limits[j])
    axes.yaxis.set_major_locator(MaxNLocator(max(3, round(box[3] / 10.0)), integer=True))
    axes.set_ylabel(axis_label("xyz"[j]))
    rest = drawn.rest
    axes.plot(rest[:, 0], rest[:, j], color=_REST, linewidth=1.6, solid_capstyle="round")
    for i, (line, colour) in enumerate(zip(drawn.lines, drawn.colours, strict=True)):
        label = drawn.labels[i] if drawn.labels else None
        dashes = drawn.dashes[i] if drawn.dashes else "-"
        axes.plot(
            line[:, 0], line[:, j], color=colour, linestyle=dashes, linewidth=1.1, label=label
        )
        point, arrow = drawn.points[i], drawn.arrows[i]
        if np.isfinite(arrow).all():
            ends = (point - arrow)[[0, j]], point[[0, j]]
            style.force_arrow(axes, *ends, colour, 1.0)
        axes.plot(point[0], point[j], "o", color=colour, markersize=2.6, zorder=5)
    return axes


_PAIR_COLOURS = (style.BLUE, style.ORANGE)
_DASHES = ("-", (0, (5, 1.5)))
_NAMES = ("A", "B")
_PAIR_ARROW = 0.22  # length of the longer force's arrow, as a share of the whisker's extent
_CENTRED: dict[str, Any] = {"ha": "center", "va": "center"}

# Width of the table next to the views, mm; its height is as large where it is below them.
_TABLE = 70.0


def witness_pair(witness: xr.Dataset, *, width: style.Width = "double") -> Figure:
    """Draw two bent whiskers with three equal signals, and list all six.

    Parameters
    ----------
    witness : Dataset
        Two contacts in the whisker frame, SI units: ``rest`` (node, space) and ``centerline``
        (pair, node, space), m; ``contact_point`` (pair, space), m; ``force`` (pair, space), N;
        ``arc_length`` (pair), m; the six signals ``Fx`` … ``MD`` (pair). The attribute ``triplet``
        names the three that are the same, such as ``"Fx MB MD"``.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        Views from above (x–y) and from the side (x–z), and a table.

    Raises
    ------
    ValueError
        If something is missing or not finite, or if there are not two contacts.
    """
    triplet = _checked_pair(witness)
    witness = witness.transpose("pair", "node", "space", ..., missing_dims="ignore")
    extent = float(np.ptp(to_display("centerline", witness["rest"].values), axis=0).max())
    drawn = _pair(witness, extent)
    limits = _limits(drawn, extent, 1.3)  # with the letters at the arrows' tails
    span = np.ptp(limits, axis=1)
    page = style.page_width(width)
    abreast = width == "double"
    left, gap, bottom, top = 12.0, 3.0, 9.0, 2.0
    room = page - left - 2.0 - (_TABLE + 6.0 if abreast else 0.0)
    scale = min(room / span[0], 70.0 / (span[1] + span[2]))
    views = bottom + gap + top + scale * (span[1] + span[2])
    height = max(views, 60.0) if abreast else views + 52.0
    shift = height - views
    with style.looking():
        figure = style.new_figure(width, height, None)

        low = shift + bottom
        across, up, aside = scale * span
        side = _panel(figure, (left, low, across, aside), drawn, limits, 2)
        above = _panel(figure, (left, low + aside + gap, across, up), drawn, limits, 1)
        above.tick_params(labelbottom=False)
        side.set_xlabel(axis_label("x"))
        tails = drawn.points - 1.2 * drawn.arrows
        for tail, name, colour in zip(tails, _NAMES, _PAIR_COLOURS, strict=True):
            above.text(tail[0], tail[1], name, color=colour, fontweight="bold", **_CENTRED)
        apart = np.linalg.norm(drawn.points[1] - drawn.points[0])
        style.conclude(
            figure,
            f"Two contacts {apart:.1f} mm apart have the same ({triplet_label(' '.join(triplet))})",
        )
        start = left + scale * span[0] + 8.0 if abreast else 3.0
        box = (
            start / page,
            (height - 58.0) / height if abreast else 0.0,
            (page - start - 1.5) / page,
            (57.0 if abreast else 50.0) / height,
        )
        _table(figure, box, witness, triplet)
        return figure


def _checked_pair(witness: xr.Dataset) -> tuple[str, ...]:
    needed = ("rest", "centerline", "contact_point", "force", "arc_length", *SIGNALS)
    if missing := [name for name in needed if name not in witness]:
        raise ValueError(f"the witness lacks {', '.join(missing)}")
    if witness.sizes.get("pair") != 2:
        raise ValueError(f"a witness is a pair of contacts; got {witness.sizes.get('pair', 0)}")
    if lacking := [name for name in needed if not np.isfinite(witness[name].values).all()]:
        raise ValueError(f"the witness has missing values in {', '.join(lacking)}")
    triplet = tuple(str(witness.attrs.get("triplet", "")).split())
    if len(triplet) < 1 or not set(triplet) <= set(SIGNALS):
        raise ValueError(
            f"the witness's triplet is {witness.attrs.get('triplet')!r}; names of signals are "
            f"needed, of {', '.join(SIGNALS)}"
        )
    return triplet


def _sizes(witness: xr.Dataset) -> Array:
    """Sizes of the two forces, N."""
    return np.asarray(np.linalg.norm(witness["force"].values, axis=1))


def _pair(witness: xr.Dataset, extent: float) -> _Drawn:
    """The two whiskers with their contacts and forces."""
    sizes = _sizes(witness)
    return _Drawn(
        to_display("centerline", witness["rest"].values),
        to_display("centerline", witness["centerline"].values),
        to_display("contact_point", witness["contact_point"].values),
        _PAIR_ARROW * extent * witness["force"].values / sizes.max(),
        to_display("force", sizes),
        list(_PAIR_COLOURS),
        (),
        _DASHES,
    )


def _table(
    figure: Figure,
    box: tuple[float, float, float, float],
    witness: xr.Dataset,
    triplet: tuple[str, ...],
) -> None:
    """Draw a table of the signals and contacts of both, with equal signals shaded."""
    axes = figure.add_axes(box, xlim=(0.0, 1.0), ylim=(13.2, -0.6))
    axes.set_axis_off()
    look: dict[str, Any] = {"va": "center_baseline"}
    for x, name, colour in zip((0.62, 0.97), _NAMES, _PAIR_COLOURS, strict=True):
        axes.text(x, 0.0, name, color=colour, fontweight="bold", ha="right", **look)
    axes.axhline(0.6, color=style.INK, linewidth=0.5)
    rows: list[tuple[str, Array]] = [(name, witness[name].values) for name in SIGNALS]
    rows += [("arc_length", witness["arc_length"].values)]
    rows += [("force", _sizes(witness))]
    for i, (name, values) in enumerate(rows):
        y = i + 1.2 + (0.3 if i >= len(SIGNALS) else 0.0)
        same = name in triplet
        if same:
            axes.fill_between([0.0, 1.0], y - 0.5, y + 0.5, color=style.SHADE, linewidth=0.0)
        own = {"force": "|\\mathbf{F}|", "arc_length": "s_c"}
        symbol = f"${own.get(name) or quantity(name).symbol}$"
        axes.text(0.02, y, f"{symbol}  ({quantity(name).display_unit})", **look)
        for x, value in zip((0.62, 0.97), to_display(name, values), strict=True):
            text = f"{value:#.{7 if same else 4}g}".rstrip(".").replace("-", "−")
            if "e" in text:
                text = _power(value, 3)
            axes.text(x, y, text, ha="right", color=style.INK if same else style.MUTED, **look)
    axes.axhline(9.2, color=style.INK, linewidth=0.5)
    for line, text in enumerate(_sentences(witness, triplet)):
        axes.text(0.02, 10.0 + line, text, **(look | {"fontsize": style.SMALL}))


def _sentences(witness: xr.Dataset, triplet: tuple[str, ...]) -> list[str]:
    """State how equal the signals are, and how far apart the contacts."""
    apart = float(np.linalg.norm(np.diff(witness["contact_point"].values, axis=0)))
    step = np.diff(witness["rest"].values, axis=0)
    length = float(np.linalg.norm(step, axis=1).sum())
    return [
        f"the shaded signals differ by {_power(_difference(witness, triplet))} of their size",
        f"the contacts are {1e3 * apart:.2f} mm = {apart / length:.3f} $L$ apart",
        "arrows: force on the whisker; grey: at rest",
    ]


def _power(value: float, decimals: int = 0) -> str:
    if value == 0.0:
        return "0"
    digits, power = f"{value:.{decimals}e}".split("e")
    return rf"${digits} \cdot 10^{{{int(power)}}}$"


def _difference(witness: xr.Dataset, triplet: tuple[str, ...]) -> float:
    """Largest relative difference of the signals that are the same; of directions, in rad."""
    worst = 0.0
    for name in triplet:
        one, other = (float(v) for v in witness[name].values)
        if name in DIRECTIONS:
            gap = abs(np.angle(np.exp(1j * (one - other))))
        else:
            gap = abs(one - other) / max(abs(one), abs(other), 1e-300)
        worst = max(worst, float(gap))
    return worst
