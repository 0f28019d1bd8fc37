"""Common style of all figures: sizes, fonts, colours, colormaps, labels, files.

Figures are made for print at the width of one or two columns (85 and 178 mm), with lettering of 6
to 8 points at that size. Only Matplotlib's object-oriented interface is used: no window opens, no
global state changes, and figures are garbage collected. Colours can be distinguished with
any colour vision (Okabe & Ito 2008, https://jfly.uni-koeln.de/color/); colormaps are perceptual.
The cyclic one is a closed curve in OKLab (B. Ottosson 2020,
https://bottosson.github.io/posts/oklab/) through blue, magenta, yellow and green, at equal steps of
colour. Its green is light and its magenta dark, so that opposite directions also differ for readers
who do not distinguish green from red, and no colour is too pale for white paper.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Colormap, FuncNorm, ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from vibrissa.io import replacing
from vibrissa.numerics import Array
from vibrissa.quantities import quantity
from vibrissa.scene import DIRECTIONS, SIGNALS, robust_limits, root, squared

Width = Literal["single", "double"]
Box = tuple[float, float, float, float]
"""Left, bottom, width and height, mm."""

# Widths of figures, mm.
WIDTHS: Mapping[str, float] = MappingProxyType({"single": 85.0, "double": 178.0})
_LETTER = 1.5  # mean width of a letter of 8 points, mm
_MARKS = re.compile(r"[$_{}]|(?<=\\)[A-Za-z]+")  # marks of formulas; a command leaves a letter
# Sizes of type, points: findings and the letters of panels; titles and axes; all else.
LARGE, PLAIN, SMALL = 8.0, 7.0, 6.0
# Colours of text, secondary items, shaded areas, three kinds of lines, and a traced whisker.
INK = "#1a1a1a"
MUTED = "#8c8c8c"
SHADE = "#e3ebf2"
BLUE = "#0072b2"
ORANGE = "#d55e00"
GREEN = "#009e73"
RED = "#e8000b"
# Look of a traced whisker: dots, so that the whisker is seen between them.
TRACE: Mapping[str, Any] = MappingProxyType(
    {"color": RED, "linewidth": 1.0, "linestyle": (0, (1.0, 3.0)), "dash_capstyle": "round"}
)
# Matplotlib's settings for creating and drawing these figures.
LOOK: Mapping[str, Any] = MappingProxyType(
    {
        "font.family": "sans-serif",
        "font.sans-serif": ["DejaVu Sans"],  # comes with Matplotlib: the same look everywhere
        "mathtext.fontset": "dejavusans",
        "font.size": PLAIN,
        "axes.labelsize": PLAIN,
        "axes.titlesize": PLAIN,
        "axes.titlepad": 4.0,
        "axes.labelpad": 2.5,
        "xtick.labelsize": SMALL,
        "ytick.labelsize": SMALL,
        "legend.fontsize": SMALL,
        "legend.frameon": False,
        "legend.handlelength": 1.6,
        "axes.linewidth": 0.6,
        "axes.edgecolor": INK,
        "axes.labelcolor": INK,
        "axes.titlecolor": INK,
        "text.color": INK,
        "xtick.color": INK,
        "ytick.color": INK,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": False,
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "xtick.major.size": 2.5,
        "ytick.major.size": 2.5,
        "xtick.major.pad": 2.0,
        "ytick.major.pad": 2.0,
        "xtick.direction": "out",
        "ytick.direction": "out",
        "lines.linewidth": 0.8,
        "patch.linewidth": 0.6,
        "grid.linewidth": 0.4,
        "grid.color": "#d9d9d9",
        "figure.facecolor": "white",
        "axes.facecolor": "white",
        "figure.dpi": 150.0,
        "savefig.dpi": 300.0,
        "pdf.fonttype": 42,  # text stays text when the figure is edited
        "svg.fonttype": "none",
        "svg.hashsalt": "vibrissa",  # the same names of its parts each time
    }
)


class _StyledFigure(Figure):
    """Figure that is drawn with the settings with which it was created."""

    above = 0.0
    """Height of the text above the panels, mm."""

    def draw(self, renderer: RendererBase) -> None:
        """Draw."""
        with looking():
            super().draw(renderer)

    def savefig(self, fname: Any, **how: Any) -> None:
        """Save the figure with the text above its panels."""
        if self.above:
            wide, tall = self.get_size_inches()
            how.setdefault("bbox_inches", Bbox([[0.0, 0.0], [wide, tall + self.above / 25.4]]))
            if (layout := self.get_layout_engine()) is not None:
                layout.execute(self)
            self.set_layout_engine("none")
            for legend in self.legends:
                # Legends without an anchor would move to the top of the enlarged figure.
                if legend.get_bbox_to_anchor() is self.bbox:
                    legend.set_bbox_to_anchor((0.0, 0.0, 1.0, 1.0), self.transFigure)
        super().savefig(fname, **how)


def looking() -> AbstractContextManager[None]:
    """Context that applies the style of these figures to Matplotlib."""
    settings: Any = dict(LOOK)
    return mpl.rc_context(settings)


def new_figure(width: Width, height: float, layout: Literal["constrained"] | None) -> Figure:
    """Create an empty figure."""
    return sized_figure(page_width(width), height, layout)


def sized_figure(
    width: float, height: float, layout: Literal["constrained"] | None = None
) -> Figure:
    """Create an empty figure of any size."""
    return _StyledFigure(figsize=(width / 25.4, height / 25.4), layout=layout)


def box_axes(figure: Figure, box: Box, **settings: Any) -> Axes:
    """Add a panel at a position in mm."""
    wide, tall = 25.4 * figure.get_size_inches()
    left, bottom, width, height = box
    return figure.add_axes((left / wide, bottom / tall, width / wide, height / tall), **settings)


def page_width(width: Width) -> float:
    """Width of a figure, mm."""
    if width not in WIDTHS:
        raise ValueError(f"width is {width!r}; one of {', '.join(WIDTHS)} is needed")
    return WIDTHS[width]


def sentence(message: str, width: Width) -> Figure:
    """Create a figure of one sentence, for cases with nothing to draw."""
    figure = new_figure(width, 40.0, None)
    say(figure, message)
    return figure


def say(figure: Figure, message: str) -> None:
    """Write one sentence in a panel with nothing to draw."""
    figure.text(0.5, 0.5, message, ha="center", va="center", color=MUTED, fontsize=LARGE)


def conclude(figure: Figure, finding: str) -> None:
    """Write a sentence above a figure that states its main finding."""
    assert isinstance(figure, _StyledFigure)
    wide, tall = 25.4 * figure.get_size_inches()
    lines = [""]
    for word in finding.split(" "):
        longer = f"{lines[-1]} {word}".lstrip()
        seen = _MARKS.sub("", longer)
        lines = [*lines[:-1], longer] if len(seen) <= (wide - 4.0) / _LETTER else [*lines, word]
    figure.above = 2.5 + 3.6 * len(lines)
    figure.text(
        1.5 / wide, 1.0 + 1.0 / tall, "\n".join(lines), fontsize=LARGE, ha="left", va="bottom"
    )


def head(axes: Axes, letter: str, title: str, left: float = 0.0) -> None:
    """Write a bold letter and a title above the upper left corner of a panel."""
    for text, right, look in ((letter, 0.0, "bold"), (title, 11.0, "normal")):
        axes.annotate(
            text,
            (0.0, 1.0),
            xycoords="axes fraction",
            xytext=(right - left, 4.0),
            textcoords="offset points",
            ha="left",
            va="bottom",
            fontsize=LARGE if look == "bold" else PLAIN,
            fontweight=look,
        )


def corner_title(figure: Figure, box: Box, letter: str, title: str) -> None:
    """Write a bold letter and a title at the upper left of a 3D panel."""
    wide, tall = 25.4 * figure.get_size_inches()
    left, bottom, _, height = box
    for text, right, size, weight in ((letter, 1.5, LARGE, "bold"), (title, 5.5, PLAIN, "normal")):
        place = (left + right) / wide, (bottom + height) / tall
        figure.text(*place, text, fontsize=size, fontweight=weight, ha="left", va="top")


def size_label(name: str) -> str:
    """Label an axis with the size of a vector."""
    q = quantity(name)
    return f"$|{q.symbol}|$ ({q.display_unit})"


def force_arrow(axes: Axes, start: Array, end: Array, colour: str, width: float) -> None:
    """Draw a force (2,) as an arrow that ends where it acts."""
    look = {"arrowstyle": "-|>,head_width=0.16,head_length=0.35", "shrinkA": 0.0, "shrinkB": 0.0}
    axes.annotate(
        "", tuple(end), tuple(start), arrowprops={**look, "color": colour, "linewidth": width}
    )


def limits_around(points: Array, margin: float, narrowest: float) -> Array:
    """Limits (3, 2) that include points, wide enough for readable axes."""
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low) + margin, narrowest)
    return np.stack([middle - half, middle + half], axis=1)


def usable_rows(
    shade: Array | None, wanted: Mapping[str, tuple[Array | None, tuple[int, ...]]]
) -> NDArray[np.intp]:
    """Find rows in which nothing is missing, those of the largest shade last, to be on top."""
    given = {name: (np.asarray(v), shape) for name, (v, shape) in wanted.items() if v is not None}
    faults = [
        f"{name} has shape {values.shape}; {shape} is needed"
        for name, (values, shape) in given.items()
        if values.shape != shape
    ]
    if faults:
        raise ValueError("; ".join(faults))
    known = [np.isfinite(v).all(axis=tuple(range(1, v.ndim))) for v, _ in given.values()]
    rows = np.flatnonzero(np.all(known, axis=0))
    return rows if shade is None else rows[np.argsort(shade[rows], kind="stable")]


def colour_bar(figure: Any, coloured: ScalarMappable, **place: Any) -> Colorbar:
    """Draw a colour bar without a frame."""
    bar: Colorbar = figure.colorbar(coloured, **place)
    outline: Any = bar.outline  # a spine, whatever Matplotlib's stubs say
    outline.set_visible(False)
    return bar


def scale_near_zero(axes: Axes, axis: str, limits: Array, width: float | None) -> None:
    """Scale an axis linearly near zero and logarithmically beyond, ticks at powers of ten."""
    panel: Any = axes  # methods selected by name have no type
    if width is not None:
        getattr(panel, f"set_{axis}scale")("asinh", linear_width=width)
    getattr(panel, f"set_{axis}lim")(*limits)
    if width is not None:
        first = int(np.ceil(np.log10(width)))
        tens = 10.0 ** np.arange(first, first + 12)
        at = [*(-t for t in tens[::-1] if -t >= limits[0]), 0.0]
        at += [t for t in tens if t <= limits[1]]
        at = [t for t in at if limits[0] <= t <= limits[1]]
        getattr(panel, f"set_{axis}ticks")(at, [f"{t:g}".replace("-", "−") for t in at])
        panel.minorticks_off()


def save(
    figure: Figure, path_stem: str | Path, formats: Sequence[str] = ("png", "pdf")
) -> list[Path]:
    """Write a figure to files.

    Parameters
    ----------
    figure : Figure
        The figure.
    path_stem : str or Path
        Path without the ending; the folder must exist.
    formats : sequence of str
        Endings, such as ``"png"``, ``"pdf"`` or ``"svg"``.

    Returns
    -------
    list of Path
        The files, in the order of ``formats``.
    """
    stem = Path(path_stem)
    files = [stem.with_name(f"{stem.name}.{ending}") for ending in formats]
    # Without a date the same figure gives the same file.
    dated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
    for file, ending in zip(files, formats, strict=True):
        with replacing(file) as part:
            part.write_bytes(_drawn(figure, format=ending, metadata=dated.get(ending)))
    return files


def png(figure: Figure, dots: float = 200.0) -> bytes:
    """Write a figure to memory.

    Parameters
    ----------
    figure : Figure
        The figure.
    dots : float
        Per inch.

    Returns
    -------
    bytes
        A PNG file.
    """
    return _drawn(figure, format="png", dpi=dots)


def _drawn(figure: Figure, **how: Any) -> bytes:
    # In memory, because some writers break where a disk is full.
    file = BytesIO()
    with looking():
        figure.savefig(file, **how)
    return file.getvalue()


# OKLab of the directions −180° (blue), −90° (magenta), 0° (yellow) and 90° (green).
_QUARTERS = np.array(
    [[0.50, -0.03, -0.20], [0.47, 0.185, 0.0], [0.86, 0.0, 0.17], [0.82, -0.13, 0.01]]
)
_LMS_FROM_LAB = np.array(
    [
        [1.0, 0.3963377774, 0.2158037573],
        [1.0, -0.1055613458, -0.0638541728],
        [1.0, -0.0894841775, -1.2914855480],
    ]
)
_RGB_FROM_LMS = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)


def cyclic() -> Colormap:
    """Create a cyclic colormap for directions from −π to π."""
    quarters = np.arange(len(_QUARTERS) + 1)
    curve = CubicSpline(quarters, np.vstack([_QUARTERS, _QUARTERS[:1]]), bc_type="periodic")
    fine = np.linspace(0.0, quarters[-1], 2001)
    steps = np.linalg.norm(np.diff(curve(fine), axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    # Equal steps of colour within each quarter, so that the four directions keep their colours.
    share = np.interp(along, np.interp(quarters, fine, along), quarters)
    turns = np.linspace(0.0, quarters[-1], 512, endpoint=False)
    lab = curve(np.interp(turns, share, fine))
    linear = np.clip((lab @ _LMS_FROM_LAB.T) ** 3 @ _RGB_FROM_LMS.T, 0.0, 1.0)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return ListedColormap(srgb, name="vibrissa_cyclic")


def sequential() -> Colormap:
    """Create a sequential colormap without the pale end, which is hardly visible on white."""
    return ListedColormap(
        mpl.colormaps["viridis"](np.linspace(0.0, 0.93, 256)), name="vibrissa_sequential"
    )


def diverging() -> Colormap:
    """Create a diverging colormap for signed quantities."""
    return mpl.colormaps["coolwarm"]


def scale_of(name: str, values: Array) -> tuple[Normalize, Colormap]:
    """Choose limits, scale and colours of a quantity in display units.

    Directions go round; sizes and signed signals go with the square root, as most contacts are
    light; predicted errors with the logarithm. The outermost 2 % of the values are left out.
    """
    if name in DIRECTIONS:
        return Normalize(-180.0, 180.0), cyclic()
    if name == "predicted_error":
        low, high = robust_limits(values[values > 0.0], 0.95)
        return LogNorm(max(low, 1e-3 * high), high), sequential()
    if name not in SIGNALS:
        return Normalize(*robust_limits(values)), sequential()
    low, high = robust_limits(values, symmetric=name == "Mx")
    low = 0.0 if name in ("FT", "MB") else low
    norm = FuncNorm((root, squared), vmin=low, vmax=high)
    return norm, diverging() if name == "Mx" else sequential()


def shading(values: Array | None) -> dict[str, Any]:
    """Settings of a scatter plot that colour its points."""
    if values is None:
        return {"color": INK, "linewidths": 0.0}
    low, high = robust_limits(values)
    return {"c": values, "cmap": sequential(), "vmin": low, "vmax": high, "linewidths": 0.0}
