"""The figure of the page, from the results."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from friction_inertia.conditions import CONDITIONS
from friction_inertia.methods import METHODS, OTHER, SIX, TRIPLET, WRENCH
from friction_inertia.summaries import LABELS
from vibrissa.plots.style import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    conclude,
    head,
    looking,
    new_figure,
)

COLOURS = dict(zip(METHODS, (BLUE, MUTED, GREEN, ORANGE), strict=True))
MARKERS = dict(zip(METHODS, "osD^", strict=True))
SYMBOLS = {
    TRIPLET: "$F_x$, $M_B$, $M_D$",
    OTHER: "$F_x$, $F_T$, $M_D$",
    SIX: "six signals",
    WRENCH: "force and moment",
}
TRIALS = {
    "friction-0": ("#b8a9d9", "-"),
    "friction-01": ("#9677c2", "-"),
    "friction-03": ("#6f42a6", "-"),
    "friction-05": ("#3b1070", "-"),
    "dynamic": (INK, "--"),
    "fast": (INK, "--"),
}
"""Colours and lines of trials, none of them that of a method: the darker the more friction, broken
where the whisker moves fast."""

SHOWN = ("friction-0", "friction-03", "dynamic")
RUBBED = LABELS[-1]
LARGEST = 40.0
"""End of the axis of errors, mm."""


def draw(results: Mapping[str, Any]) -> Figure:
    """Errors by class in three trials, by friction; flags; the pose's filter, if filmed."""
    labels = {c.name: c.label for c in CONDITIONS}
    with looking():
        figure = new_figure("double", 108.0, "constrained")
        panels = figure.subplots(2, 3)
        for axes, letter, name in zip(panels[0], "abc", SHOWN, strict=True):
            errors(axes, results[name]["true"])
            head(axes, letter, labels[name])
        least = min(axes.get_ylim()[0] for axes in panels[0])
        for axes in panels[0]:
            # Predictions beyond a whisker's length mean only that nothing is known.
            axes.set_ylim(least, LARGEST)
        panels[0, 0].set_ylabel("3D error, median (mm)")
        lines = [
            Line2D(
                [],
                [],
                color=COLOURS[method],
                marker=MARKERS[method],
                markersize=3.0,
                label=SYMBOLS[method],
            )
            for method in METHODS
        ]
        predicted = Line2D([], [], color=INK, linestyle=":", label="predicted")
        by_friction(panels[1, 0], results)
        head(panels[1, 0], "d", f"by friction, {RUBBED}")
        flags(panels[1, 1], results, labels)
        head(panels[1, 1], "e", "called not frictionless")
        if any("cutoffs" in one for one in results.values()):
            cutoffs(panels[1, 2], results)
            head(panels[1, 2], "f", "low-pass filter of the pose")
            place, where = panels[0, 0], "upper right"
        else:
            panels[1, 2].set_axis_off()
            place, where = panels[1, 2], "center"
        place.legend(handles=[*lines, predicted], loc=where)
        conclude(figure, finding(results))
        return figure


def finding(results: Mapping[str, Any]) -> str:
    """State in a sentence what friction does to three signals, and to force and moment."""
    rows = results["friction-03"]["true"]
    (three, stated), (wrench, _) = (
        (1e3 * row["median"], 1e3 * row["predicted"])
        for row in (rows[method]["classes"][RUBBED] for method in (TRIPLET, WRENCH))
    )
    return (
        f"Friction of 0.3, {RUBBED}: errors of {three:.1f} mm from three signals ({stated:.2f} "
        f"predicted), {wrench:.2f} mm from force and moment"
    )


def errors(axes: Axes, one: Mapping[str, Any]) -> None:
    for method in METHODS:
        rows = [one[method]["classes"][label] for label in LABELS]
        method_lines(axes, method, range(len(LABELS)), rows)
    by_class(axes)


def method_lines(axes: Axes, method: str, x: Sequence[float], rows: list[dict[str, float]]) -> None:
    """Measured and predicted errors of a method, on a logarithmic axis."""
    for name, look in (("median", f"{MARKERS[method]}-"), ("predicted", ":")):
        values = [row[name] * 1e3 for row in rows]
        axes.plot(x, values, look, color=COLOURS[method], markersize=3.0)
    axes.set_yscale("log")


def by_class(axes: Axes) -> None:
    axes.set_xticks(range(len(LABELS)), [label.replace("over ", ">") for label in LABELS])
    axes.set_xlabel("deflection")


def by_friction(axes: Axes, results: Mapping[str, Any]) -> None:
    still = [c for c in CONDITIONS if not c.dynamic]
    at = [c.friction for c in still]
    for method in METHODS:
        rows = [results[c.name]["true"][method]["classes"][RUBBED] for c in still]
        method_lines(axes, method, at, rows)
    axes.set_xticks(at)
    axes.set_xlabel("coefficient of friction")
    axes.set_ylabel("3D error, median (mm)")


def flags(axes: Axes, results: Mapping[str, Any], labels: Mapping[str, str]) -> None:
    for name in [name for name in TRIALS if name in labels]:
        classes = results[name]["true"][SIX]["classes"]
        values = [100 * classes[label]["flagged"] for label in LABELS]
        trial_line(axes, name, values, labels[name])
    axes.set_ylim(-3, 145)  # room for the legend
    axes.set_yticks(range(0, 101, 20))
    axes.set_ylabel("share of contacts (%)")
    axes.legend(loc="upper center", ncols=2, columnspacing=1.0)
    by_class(axes)


def trial_line(axes: Axes, name: str, values: Any, label: str) -> None:
    colour, style = TRIALS[name]
    axes.plot(range(len(values)), values, f"o{style}", color=colour, label=label, markersize=2.5)


def cutoffs(axes: Axes, results: Mapping[str, Any]) -> None:
    """What the pose alone adds, and what the paper's method makes of the contact."""
    labels = {
        "friction-0": "5 whisks a second",
        "friction-03": "friction 0.3",
        "fast": "10 a second",
    }
    for name, label in labels.items():
        rows = results.get(name, {}).get("cutoffs")
        if not rows:
            continue
        values = np.array([row["moved"][0] for row in rows.values()]) * 1e6
        trial_line(axes, name, values, label)
        axes.set_xticks(range(len(rows)), list(rows))
    axes.set_xlabel("cut-off (Hz)")
    axes.set_ylabel("contact moved by the pose (µm)")
    axes.set_ylim(bottom=0.0)
    axes.legend()
