"""The tables of the page, from the results; mm, degrees, per cent."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pages import put, table

from friction_inertia.conditions import CONDITIONS, FAST
from friction_inertia.methods import METHODS, RUBBING, SIX, TRIPLET, WRENCH
from friction_inertia.summaries import LABELS, limit

Results = Mapping[str, Any]

NAMES = {
    "Fx MB MD": "F_x, M_B, M_D",
    "Fx FT MD": "F_x, F_T, M_D",
    "Fx FT MB MD": "F_x, F_T, M_B, M_D",
    SIX: "six signals",
    WRENCH: "wrench",
}
NAMES |= {name: f"{NAMES[of]}, friction" for name, of in RUBBING.items()}
EVERY = (*METHODS, *RUBBING)
CLASSES = (*LABELS, "all")


def write(pages: Sequence[Path], results: Results) -> None:
    """Put the tables between their marks on the pages."""
    made = {name: make(results) for name, make in TABLES.items()}
    # What was not filmed leaves the tables of videos as they are.
    put(pages, {name: text for name, text in made.items() if text.count("\n") > 1})


def mm(value: float) -> str:
    size = abs(value) * 1e3
    if not np.isfinite(size):
        return "–"
    digits = 3 if size < 0.1 else 2 if size < 1.0 else 1
    return f"{value * 1e3:.{digits}f}".replace("-", "−")


def median(row: Mapping[str, float]) -> str:
    """In bold where it is not as expected."""
    shown = mm(row["median"])
    return f"**{shown}**" if row["median"] > limit(row) else shown


def percent(value: float) -> str:
    return "–" if not np.isfinite(value) else f"{100 * value:.1f}"


def degrees(value: float) -> str:
    return "–" if not np.isfinite(value) else f"{np.degrees(value):.1f}".replace("-", "−")


def part(row: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    return row["all"] if name == "all" else row["classes"][name]


def found(results: Results, of: str) -> list[tuple[str, Any]]:
    """Label and results of the conditions that have such."""
    conditions = (*CONDITIONS, FAST) if of == "cutoffs" else CONDITIONS
    kept = ((c.label, results.get(c.name, {})) for c in conditions)
    return [(label, one) for label, one in kept if of in one]


def picked(results: Results, of: str) -> list[tuple[str, Any]]:
    return [(label, one[of]) for label, one in found(results, of)]


def trials(results: Results) -> str:
    rows = []
    for label, one in picked(results, "true"):
        row, counts = one[TRIPLET], [part(one[TRIPLET], name)["contacts"] for name in CLASSES]
        angle = one[WRENCH]["friction"]["true"]
        rows.append(
            [label, str(row["touching"]), str(row["detected"]), str(row["false"]), degrees(angle)]
            + [str(n) for n in counts[:-1]]
        )
    head = ["trial", "touching", "detected", "falsely detected", "friction angle", *LABELS]
    return table(head, rows)


def by_class(results: Results) -> str:
    rows = []
    for label, one in picked(results, "true"):
        for method in EVERY:
            parts = [part(one[method], name) for name in CLASSES]
            cells = [f"{median(row)} ({mm(row['predicted'])})" for row in parts]
            high = f"{mm(one[method]['all']['high'])} ({mm(one[method]['all']['predicted_high'])})"
            rows.append([label, NAMES[method], *cells, high])
    return table(["trial", "from", *CLASSES, "all, 95 %"], rows, 2)


def answers(results: Results) -> str:
    rows = [
        [label, NAMES[method], percent(one[method]["none"]), percent(one[method]["several"])]
        + [mm(value) for value in (one[method]["pulled"], *one[method]["bias"])]
        for label, one in picked(results, "true")
        for method in EVERY
    ]
    head = ["trial", "from", "none, %", "several, %", "with friction", "along", "off", "sideways"]
    return table(head, rows, 2)


def flags(results: Results) -> str:
    rows = []
    for label, one in picked(results, "true"):
        six, wrench = one[SIX], one[WRENCH]
        cells = [percent(part(six, name)["flagged"]) for name in CLASSES]
        left = f"{mm(six['unflagged']['median'])} ({six['unflagged']['count']})"
        rows.append([label, *cells, left, percent(wrench["flagged"])])
    return table(["trial", *CLASSES, "error where not flagged", "wrench, all"], rows)


def friction(results: Results) -> str:
    rows = []
    for label, one in picked(results, "true"):
        row = one[WRENCH]["friction"]
        names = ("true", "found", "bias", "error", "predicted")
        rows.append([label, *(degrees(row[name]) for name in names), percent(row["within"])])
    head = ["trial", "true", "found", "bias", "error", "predicted", "within 2σ, %"]
    return table(head, rows)


def pegs(results: Results) -> str:
    shown = [f"detected {name}" for name in ("offset", "tilt", "diameter", "sigma")]
    shown += [f"{kind} {name}" for kind in ("exact", "points") for name in ("offset", "diameter")]
    rows = []
    for label, one in picked(results, "true"):
        for method in EVERY:
            row = one[method]["peg"]
            cells = [
                degrees(row[name]) if name.endswith("tilt") else mm(row[name]) for name in shown
            ]
            rows.append([label, NAMES[method], *cells])
    head = ["trial", "from", "axis, mm", "tilt, °", "diameter, mm", "its σ, mm"]
    head += ["axis*, mm", "diameter*, mm", "axis†, mm", "diameter†, mm"]
    return table(head, rows, 2)


def tracked(results: Results) -> str:
    """Median errors against their limits; bold where above."""
    rows = []
    for label, one in picked(results, "rod"):
        for method in METHODS:
            cells = []
            for name in CLASSES:
                row = part(one[method], name)
                cells.append(f"{median(row)} / {mm(limit(row))}")
            rows.append([label, NAMES[method], *cells])
    return table(["trial", "from", *CLASSES], rows, 2)


def poses(results: Results) -> str:
    """The same estimates by where they are placed."""
    rows = []
    for label, trial in found(results, "rod"):
        cells = [mm(trial[of][TRIPLET]["all"]["median"]) for of in ("true", "rod", "85 Hz")]
        cells.append(mm(trial["whisker"][TRIPLET]["all"]["median"]))
        cells += [mm(trial[of][TRIPLET]["all"]["pose"]) for of in ("rod", "85 Hz")]
        pegs = [trial[of][TRIPLET]["peg"]["exact offset"] for of in ("true", "rod", "85 Hz")]
        rows.append([label, *cells, *(mm(value) for value in pegs)])
    head = ["trial", "true pose", "rod", "85 Hz", "rod, tracked shape"]
    head += ["rod, pose alone", "85 Hz, pose alone", "axis, true pose", "axis, rod", "axis, 85 Hz"]
    return table(head, rows)


def circular(results: Results) -> str:
    rows = []
    for label, one in picked(results, "paper"):
        pairs = ("agreement", "error", "force", "moment")
        micrometres = ["< 0.001" if v < 1e-9 else f"{v * 1e6:.3f}" for v in one["agreement"]]
        rows.append(
            [label, str(one["count"]), percent(one["none"])]
            + micrometres
            + [mm(v) for v in one["error"]]
            + [percent(one[name][0]) for name in pairs[2:]]
        )
    head = ["trial", "contacts", "none, %", "disagreement, µm", "95 %", "true error, mm", "95 %"]
    return table([*head, "force, %", "moment, %"], rows)


def cutoffs(results: Results) -> str:
    rows = []
    for label, one in picked(results, "cutoffs"):
        for cutoff, row in one.items():
            rows.append(
                [
                    label,
                    cutoff,
                    f"{row['place'][0] * 1e6:.0f}",
                    f"{np.degrees(row['direction'][0]):.2f}",
                    f"{np.degrees(row['roll'][0]):.2f}",
                    mm(row["contact"][0]),
                    percent(row["force"][0]),
                    percent(row["moment"][0]),
                    mm(row["moved"][0]),
                    mm(row["sensed"][0]),
                ]
            )
    head = ["trial", "cut-off, Hz", "base, µm", "direction, °", "roll, °", "contact, mm"]
    head += ["force, %", "moment, %", "placed, pose alone, mm", "placed, mm"]
    return table(head, rows, 2)


TABLES = {
    "trials": trials,
    "by class": by_class,
    "answers": answers,
    "flags": flags,
    "friction": friction,
    "pegs": pegs,
    "tracked": tracked,
    "poses": poses,
    "circular": circular,
    "cut-offs": cutoffs,
}
