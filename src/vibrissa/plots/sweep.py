"""What a study found, whisker by whisker: how it tapers and curves, and what came of it."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from vibrissa.plots.colours import sequential
from vibrissa.plots.style import INK, MUTED, Width, head, looking, new_figure, plain
from vibrissa.plots.verdicts import VERDICTS, triplet_label

_MARKS = dict(zip(VERDICTS, ("o", "D", "X"), strict=True))
_MOST = 3
"""Panels that are drawn."""


def sweep_overview(
    found: xr.Dataset, *, task: str | None = None, width: Width = "double"
) -> Figure:
    """Draw a study's verdicts over the whiskers' taper and curvature.

    A mark for each whisker, its shape the verdict, its colour the critical cone; a panel for each
    of the first three triplets.

    Parameters
    ----------
    found : Dataset
        As of ``vibrissa.sweeps.open_sweep``: over ``whisker``, with ``taper_ratio``, ``turn`` (what
        the tangent turns by from base to tip, rad), and ``TASK_verdict`` and
        ``TASK_critical_cone`` (rad) over triplet and region.
    task : str, optional
        Name of the task; by default the first that has verdicts.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        One axes for each triplet, and a colour bar.

    Raises
    ------
    ValueError
        If there are no verdicts.
    """
    known = [str(name)[: -len("_verdict")] for name in found if str(name).endswith("_verdict")]
    if not known or (task is not None and task not in known):
        raise ValueError(
            f"the study has no verdicts{'' if task is None else f' of {task}'}; tasks that have: "
            f"{', '.join(known) or 'none'}"
        )
    task = task or known[0]
    verdict = found[f"{task}_verdict"]
    triplets = verdict[verdict.dims[1]].values[:_MOST]
    cone = found[f"{task}_critical_cone"]
    degrees = cone.copy(data=np.degrees(cone.values))
    norm, colours = Normalize(0.0, max(float(degrees.max()), 5.0)), sequential().reversed()
    count = len(triplets)
    with looking():
        shape = (1, count) if width == "double" else (count, 1)
        tall = 78.0 if width == "double" else 56.0 * count + 18.0
        figure = new_figure(width, tall, "constrained")
        grid = figure.subplots(*shape, sharex=True, sharey=True, squeeze=False)
        for i, axes in enumerate(grid.ravel()):
            at = {verdict.dims[1]: i, verdict.dims[2]: 0}
            _panel(axes, found, verdict.isel(at), degrees.isel(at), norm, colours)
            head(axes, "abc"[i], triplet_label(str(triplets[i])))
        for axes in grid[:, 0]:
            axes.set_ylabel("the tangent turns along the whisker (°)")
        for axes in grid[-1]:
            axes.set_xlabel("base / tip radius")
        marks = [
            figure.axes[0].scatter([], [], marker=mark, color=MUTED, s=16, label=word)
            for word, mark in _MARKS.items()
        ]
        figure.legend(handles=marks, loc="outside lower center", ncols=3, frameon=False)
        bar = figure.colorbar(ScalarMappable(norm, colours), ax=list(grid.ravel()), aspect=30)
        plain(bar)
        bar.set_label("critical cone (°)")
        return figure


def _panel(
    axes: Axes,
    found: xr.Dataset,
    verdict: xr.DataArray,
    degrees: xr.DataArray,
    norm: Normalize,
    colours: object,
) -> None:
    x, y = found["taper_ratio"].values, np.degrees(found["turn"].values)
    for word, mark in _MARKS.items():
        here = verdict.values == word
        axes.scatter(
            x[here],
            y[here],
            c=degrees.values[here],
            norm=norm,
            cmap=colours,  # type: ignore[arg-type]
            marker=mark,
            s=20,
            edgecolors=INK,
            linewidths=0.4,
        )
    axes.set_xscale("log")
    ticks = [tick for tick in (1, 2, 5, 15, 30, 60) if 0.9 * np.nanmin(x) <= tick <= np.nanmax(x)]
    axes.set_xticks(ticks, labels=[f"{tick}" for tick in ticks])
    axes.minorticks_off()
