"""The whole job, from two videos to a peg, and pegs fitted over and over."""

import numpy as np
from pages import few, percent, table

import vibrissa as vb
from vibrissa.contour import CylinderFit, shape_from_dataset
from vibrissa.demo import DemoResult, Located, run_demo
from vibrissa.pipeline import with_contour, with_estimates
from vibrissa.recording import Recording
from vibrissa.simulation import facing_peg, measure, simulate, sweep_past

WAYS = ("measured by a sensor", "the paper's method")


def blocks(quick: bool) -> dict[str, str]:
    """`vibrissa demo` as it is, and its peg in draws of noise; two or three minutes."""
    result = run_demo(duration=0.12 if quick else 0.5)
    return {
        "tracking": tracking(result),
        "signals": signals(result),
        "errors": errors(result),
        "peg": peg(result),
        "pegs": draws(0.2 if quick else 0.5, 3 if quick else 40),
    }


def ways(result: DemoResult) -> list[Located]:
    assert result.seen is not None
    return [result.sensed, result.seen]


def tracking(result: DemoResult) -> str:
    found = result.tracking
    assert found is not None
    rows = [
        ["frames, lost", f"{found.frames}, {found.lost}", ""],
        ["contact classified correctly", f"{100 * found.classified:.1f} %", ""],
    ]
    for name, (median, most) in zip(("top", "front"), found.trace, strict=True):
        rows.append([f"trace, {name}", f"{median:.3f} px", f"{most:.3f} px"])
    for name, spread in (
        ("centreline in space", found.centerline),
        ("base", found.base),
        ("contact point", found.contact),
    ):
        rows.append([name, *(f"{few(1e6 * value)} µm" for value in spread)])
    return table(["", "median", "95 %"], rows)


def signals(result: DemoResult) -> str:
    sensed, seen = ({row.label: row for row in one.signals} for one in ways(result))
    rows = []
    for label, row in sensed.items():
        cells = [
            percent(getattr(one[label], name)[0]) if label in one else "–"
            for name in ("force", "moment")
            for one in (sensed, seen)
        ]
        rows.append([label, str(row.contacts), *cells])
    head = [f"{name}: {way}" for name in ("force", "moment") for way in WAYS]
    return table(["deflection", "contacts", *head], rows)


def errors(result: DemoResult) -> str:
    sensed, seen = ({row.label: row for row in one.scores.by_angle} for one in ways(result))
    rows = []
    for label, row in sensed.items():
        cells = [few(1e3 * value) for value in (*row.measured[:2], *row.predicted[:2])]
        other = [few(1e3 * v) for v in seen[label].measured[:2]] if label in seen else ["–", "–"]
        rows.append([label, str(row.contacts), *cells, *other])
    head = ["deflection", "contacts", "median", "95 %", "median predicted", "95 % predicted"]
    return table([*head, "the paper's method: median", "95 %"], rows)


def peg(result: DemoResult) -> str:
    rows = []
    for way, one in zip(WAYS, ways(result), strict=True):
        fit, scores = one.fit, one.scores
        for name, error, sigma in (
            ("axis, x", scores.offset[0], fit.origin_sigma[0]),
            ("axis, y", scores.offset[1], fit.origin_sigma[1]),
            ("diameter", scores.diameter_error, fit.diameter_sigma),
        ):
            rows.append([way, name, f"{1e6 * error:.1f}".replace("-", "−"), f"{1e6 * sigma:.1f}"])
    return table(["signals", "parameter", "error, µm", "standard deviation, µm"], rows, 2)


def draws(duration: float, number: int) -> str:
    """The peg from one trial with so many draws of the sensor's noise, true pose."""
    whisker = vb.samples.gamma()
    contact_map, thing = vb.ContactMap.simulate(whisker, grid=False), facing_peg(whisker)
    trial = simulate(whisker, sweep_past(whisker, thing, duration), thing)
    away = []
    for seed in range(number):
        measured = with_contour(
            with_estimates(measure(trial, seed=seed), contact_maps=[contact_map])
        )
        fit = shape_from_dataset(measured["contour"].to_dataset())
        (true,) = Recording(measured).objects
        assert isinstance(fit, CylinderFit)
        along = (true.origin[2] - fit.origin[2]) / fit.axis[2]
        place = fit.origin + along * fit.axis - true.origin
        away.append(
            [
                *(place[:2] / fit.origin_sigma[:2]),
                2.0 * (fit.radius - true.radius) / fit.diameter_sigma,
            ]
        )
    rows = []
    for name, column in zip(("axis, x", "axis, y", "diameter"), np.transpose(away), strict=True):
        mean = f"{column.mean():.2f} ± {column.std() / np.sqrt(number):.2f}".replace("-", "−")
        inside = f"{100 * (np.abs(column) < 1.96).mean():.0f} %"
        rows.append([name, str(number), mean, f"{column.std():.2f}", inside])
    head = ["parameter", "draws", "mean error, σ", "standard deviation, σ", "within 1.96 σ"]
    return table(head, rows)
