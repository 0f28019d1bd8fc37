"""Figures of the results of a study: uniqueness, critical cones and errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from vibrissa.numerics import Array
from vibrissa.plots import style
from vibrissa.plots.verdicts import PAPERS_CONE, VERDICTS, WORDS, triplet_label
from vibrissa.scene import root, squared

# Look of marks in the legend: their shape is the verdict, their colour the critical cone.
_MARKS = dict(zip(VERDICTS, ("o", "D", "X"), strict=True))
_KEY: Any = {"facecolors": "white", "edgecolors": style.INK, "linewidths": 0.6}
_MOST = 3  # triplets that get panels of their own; more share one
_CONES = (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 90.0)  # classes of critical cones, degrees
_NORM = BoundaryNorm(_CONES, 256)

_TURNS = (0, 20, 50, 90, 180, 360)
# Range of errors drawn, mm: smaller ones are exact, larger ones do not locate the contact.
_ERRORS = (1e-4, 1e3)
# Distance, as a share of a panel, and number of neighbours from which on marks are drawn small.
_NEAR, _SEVERAL = 0.04, 4
_ROW, _FRAME = 4.4, 20.0  # heights of a row of marks and of the margins together, mm


def sweep_overview(
    found: xr.Dataset, *, task: str | None = None, width: style.Width = "double"
) -> Figure:
    """Draw the results of a task of a study.

    For verdicts there is a row of panels per triplet: the left one shows every whisker by its taper
    and turning angle, coloured by the critical cone, and the right one the critical cones by group
    of whiskers. For more than three triplets only the critical cones are drawn, in a line per
    triplet. For errors there is a line per set of signals or friction coefficient. The shape of a
    mark is the verdict.
    """
    known = drawable(found)
    if not known or (task is not None and task not in known):
        raise ValueError(
            f"the study has no verdicts or errors{'' if task is None else f' of {task}'}; tasks "
            f"that have: {', '.join(known) or 'none'}"
        )
    task = task or known[0]
    with style.looking():
        if f"{task}_verdict" not in found:
            return _errors(found, task, width)
        verdict = found[f"{task}_verdict"]
        verdict = verdict.isel({verdict.dims[2]: 0})
        degrees = np.degrees(found[f"{task}_critical_cone"].values[:, :, 0])
        done = (verdict.values != "").any(axis=1)
        names = [str(name) for name in verdict[verdict.dims[1]].values]
        words, degrees = verdict.values[done], degrees[done]
        if len(names) > _MOST:
            return _of_many(names, words, degrees, width)
        return _of_few(found.isel(whisker=done), names, words, degrees, width)


def drawable(found: xr.Dataset) -> list[str]:
    """List the drawable results of a study."""
    return [
        task
        for task in map(str, found["task"].values)
        if f"{task}_verdict" in found or f"{task}_median_error" in found
    ]


def _of_many(
    names: Sequence[str], verdict: NDArray[np.str_], degrees: Array, width: style.Width
) -> Figure:
    """Draw one row per triplet, with all whiskers together."""
    figure = style.new_figure(width, _FRAME + _ROW * len(names), "constrained")
    axes = figure.subplots()
    _lines(axes, [triplet_label(name) for name in names])
    for i in range(len(names)):
        _spread(axes, degrees[:, i], verdict[:, i], np.full(len(degrees), i))
    _cone_axis(axes)
    _key(figure, verdict)
    among = f"on all {len(degrees)} whiskers"
    if held := np.flatnonzero((verdict == VERDICTS[0]).all(axis=0)).tolist():
        shown = ", ".join(f"({triplet_label(names[i])})" for i in held)
        style.conclude(figure, f"Unique (no counterexample found) {among}: {shown}")
        return figure
    largest = np.nan_to_num(degrees, nan=90.0).max(axis=0)
    off = (verdict == VERDICTS[1]).all(axis=0)
    first, second = (
        f"({triplet_label(names[i])}) "
        + ("off a surface" if off[i] else f"outside {largest[i]:.1f}°")
        for i in np.argsort(largest, kind="stable")[:2].tolist()
    )
    style.conclude(
        figure,
        f"No triplet is unique {among} outside {PAPERS_CONE:g}°; next are {first} and {second}",
    )
    return figure


def _of_few(
    found: xr.Dataset,
    names: Sequence[str],
    verdict: NDArray[np.str_],
    degrees: Array,
    width: style.Width,
) -> Figure:
    """Draw two panels per triplet: whiskers by shape, and by group."""
    groups = found["group"].values.astype(str)
    rows = list(dict.fromkeys(groups))
    at = np.array([rows.index(group) for group in groups], dtype=int)
    tall = max(52.0, 16.0 + _ROW * len(rows)) * len(names) + 8.0
    figure = style.new_figure(width, tall if width == "double" else 1.7 * tall, "constrained")
    shape = (len(names), 2) if width == "double" else (2 * len(names), 1)
    panels = figure.subplots(*shape, squeeze=False).ravel()
    for i, name in enumerate(names):
        left, right = panels[2 * i], panels[2 * i + 1]
        _chart(left, found, verdict[:, i], degrees[:, i])
        style.head(left, "ace"[i], f"{triplet_label(name)} by taper and turn")
        _lines(right, rows)
        _spread(right, degrees[:, i], verdict[:, i], at)
        _cone_axis(right)
        style.head(right, "bdf"[i], "by group of whiskers")
    bar = style.colour_bar(
        figure,
        ScalarMappable(_NORM, style.sequential().reversed()),
        ax=list(panels[::2]),
        aspect=30,
        spacing="uniform",
    )
    bar.set_label("critical cone (°)")
    _key(figure, verdict)
    unique = (verdict == VERDICTS[0]).sum(axis=0)
    parts = [
        f"no two contacts outside {PAPERS_CONE:g}° have the same ({triplet_label(name)}) on {held}"
        for name, held in zip(names, unique, strict=True)
    ]
    searched = f"As far as was searched, {', '.join(parts)} of {len(degrees)} whiskers"
    style.conclude(figure, searched)
    return figure


def _chart(axes: Axes, found: xr.Dataset, words: NDArray[np.str_], degrees: Array) -> None:
    """Draw whiskers by taper and turning angle, those with the widest cones first."""
    x, y = found["taper_ratio"].values, np.degrees(found["turn"].values)
    size = 9.0 + 15.0 * np.clip(degrees / _CONES[-1], 0.0, 1.0) ** 0.5
    crowded = _crowded(x, y)
    size[crowded] *= 0.4
    for k in np.argsort(-degrees):
        if words[k]:
            look = _look(degrees[k : k + 1], 0.15 if crowded[k] else 0.3)
            axes.scatter(x[k], y[k], s=size[k], marker=_MARKS[str(words[k])], **look)
    axes.set_xscale("log")
    low, high = (np.nanmin(x), np.nanmax(x)) if x.size else (1.0, 60.0)
    ticks = [tick for tick in (1, 2, 5, 15, 30, 60) if 0.9 * low <= tick <= 1.1 * high]
    axes.set_xticks(ticks, labels=[f"{tick}" for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel("base / tip radius")
    most = float(np.nanmax(y, initial=20.0))
    axes.set_yscale("function", functions=_ROOT)
    axes.set_yticks([turn for turn in _TURNS if turn <= 1.05 * most])
    axes.set_ylim(-0.002 * most, 1.15 * most)  # marks at 0 stay whole
    axes.set_ylabel("tangent turns, base to tip (°)")


def _crowded(x: Array, y: Array) -> NDArray[np.bool_]:
    """Whiskers with several others almost at the same taper and turn, as those of an array."""
    if x.size == 0:
        return np.zeros(0, dtype=bool)
    scaled = [v / max(np.nanmax(v) - np.nanmin(v), 1e-9) for v in (np.log(x), np.sqrt(y))]
    apart = np.hypot(*(v[:, None] - v for v in scaled))
    return np.asarray((apart < _NEAR).sum(axis=1) > _SEVERAL)


def _lines(axes: Axes, labels: list[str]) -> None:
    axes.set_yticks(range(len(labels)), labels=labels)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0.0)
    axes.spines["left"].set_visible(False)
    for line in range(1, len(labels)):
        axes.axhline(line - 0.5, color=style.SHADE, linewidth=0.6, zorder=0)


def _spread(axes: Axes, x: Array, words: NDArray[np.str_], line: NDArray[np.int_]) -> None:
    """Draw marks along lines, with small vertical offsets of neighbours."""
    place = np.argsort(np.argsort(x)) * 2 % 5
    for word, mark in _MARKS.items():
        here = words == word
        there = (line + 0.13 * (place - 2.0))[here]
        axes.scatter(x[here], there, s=13, marker=mark, **_look(x[here], 0.3))


def _look(degrees: Array, edge: float) -> dict[str, Any]:
    """Settings of marks coloured by critical cones, with a given edge width."""
    colours: dict[str, Any] = {"norm": _NORM, "cmap": style.sequential().reversed()}
    return {"c": degrees, "edgecolors": style.INK, "linewidths": edge, **colours}


def _cone_axis(axes: Axes) -> None:
    axes.set_xscale("function", functions=_ROOT)
    axes.set_xticks(_CONES[1:], labels=[f"{cone:.0f}" for cone in _CONES[1:]])
    axes.set_xlim(-0.02, 1.08 * _CONES[-1])
    axes.axvspan(-0.02, PAPERS_CONE, color=style.SHADE, linewidth=0.0, zorder=-1)
    axes.set_xlabel("critical cone (°; shaded: the paper's 2°)")


def _key(figure: Figure, words: NDArray[np.str_]) -> None:
    marks = [
        figure.axes[0].scatter([], [], marker=mark, s=14, label=WORDS[word], **_KEY)
        for word, mark in _MARKS.items()
        if word in words
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=3, frameon=False)


def _errors(found: xr.Dataset, task: str, width: style.Width) -> Figure:
    error = found[f"{task}_median_error"]
    dim = error.dims[1]
    labels = [_label(value, str(dim)) for value in error[dim].values]
    figure = style.new_figure(width, _FRAME + 1.6 * _ROW * len(labels), "constrained")
    axes = figure.subplots()
    _lines(axes, labels)
    for i in range(len(labels)):
        values = error.values[:, i] * 1e3
        values = np.sort(np.clip(values[~np.isnan(values)], *_ERRORS))
        place = np.arange(values.size) * 2 % 5 - 2.0
        axes.scatter(values, i + 0.13 * place, s=11, color=style.BLUE, alpha=0.75, linewidths=0.0)
        if values.size:
            axes.plot(2 * [np.median(values)], [i - 0.42, i + 0.42], color=style.INK, linewidth=1.0)
    axes.set_xscale("log")
    axes.grid(axis="x", which="major")
    axes.tick_params(axis="x", which="minor", color=style.MUTED)
    axes.set_xlabel("median error of the contact point (mm); a mark for each whisker")
    return figure


def _label(value: object, dim: str) -> str:
    text = str(value)
    if isinstance(value, float):
        return f"{dim.rpartition('_')[2]} {value:g}"
    return text if text == "wrench" else triplet_label(text)


_ROOT = (root, squared)  # room for the small without losing the large
