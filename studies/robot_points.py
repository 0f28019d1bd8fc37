"""Real whiskers over Hall sensors: errors by the number of touches that they were calibrated by.

Three wires of arXiv 2406.06038 (folder DATA): sensor 1, whose tip is curved; a straight wire; and a
second curved one. Of the last two no shape is published: it is that of the rows of their own
calibration in which the probe hardly touches. For each number of touches and some draws, at touches
that were not drawn: the error of readings, and that of contact points from single readings of all
three channels, of the rod on its suspension and of the thin plate of the published method (its
kernel and noise). Contact points are those of least squares, begun at the five drawn touches whose
readings are nearest. Median (90 %): of readings over draws, of points over draws and touches.

    python studies/robot_points.py ../shared/robot_whisker docs/images [DRAWS]
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
from robot_whisker import HERE
from scipy.interpolate import CubicSpline

import vibrissa as vb
from vibrissa.sensors import Stage, ThinPlate, calibrate_suspension

FIRST_DRAW = 6  # those before were looked at while constants were chosen
NUMBERS = (25, 50, 100, 300)
TESTED, STARTS, ROUNDS = 150, 5, 30
FARTHEST = 40.0  # mm, as in robot_whisker.toml
WEAK, OFTEN = 150.0, 7  # counts: the probe hardly touches; rows in which a ray begins or ends
PROCESS = 1e-5  # variance of the published noise over that of its process


class Wire(NamedTuple):
    """A whisker, touches of it, and its readings at rest."""

    whisker: vb.Whisker
    points: np.ndarray
    readings: np.ndarray
    rest: np.ndarray
    drift: np.ndarray
    base_sigma: float


def table(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Positions, mm, and readings of a calibration."""
    rows = np.genfromtxt(folder / "calibration" / name, delimiter=",", skip_header=1)
    return rows[:, 1:4], rows[:, 4:7]


def first(folder: Path) -> Wire:
    """Sensor 1."""
    stage = Stage((HERE / "robot_whisker.toml").read_text(), folder)
    points, readings, rest, drift = stage.touches()
    return Wire(stage.whisker(), points, readings, rest, drift, stage.base_sigma)


def wire_of(shape, at, readings, rest, base_sigma) -> Wire:
    """Touches (mm) of a wire whose points at rest are known, its base first."""
    line = 1e-3 * (shape - shape[0])
    whisker = vb.Whisker.from_points(
        line, noise=3e-4, youngs_modulus=200e9, any_length=True, base_radius=1e-4, tip_radius=1e-4
    )
    points = 1e-3 * (at - shape[0])
    near = np.linalg.norm(points, axis=1) <= 1e-3 * FARTHEST
    drift = np.full(3, 40.0)  # that of sensor 1: there are no recordings to find it from
    return Wire(whisker, points[near], readings[near], rest, drift, base_sigma)


def straight(folder: Path) -> Wire:
    """Straight wire: rays begin on it, at five stations, and are longer the farther from it."""
    at, readings = table(folder, "straight_calib_May_20.csv")
    places, number = np.unique(at, axis=0, return_counts=True)
    stations = places[number >= OFTEN]
    stations = stations[np.argsort(-stations[:, 1])]
    # Steps along the rays grow as the distance from the base, which so is known.
    steps = [
        np.linalg.norm(at[np.flatnonzero((at == p).all(axis=1)) + 2] - p, axis=1).max()
        for p in stations
    ]
    along = np.linalg.norm(stations - stations[0], axis=1)
    slope, least = np.polyfit(along, steps, 1)
    unit = (stations[-1] - stations[0]) / along[-1]
    s = np.linspace(-least / slope, along[-1] + 5.0, 40)
    shape = stations[0] + s[:, None] * unit
    # No row is of the free wire; the probe pushes it least at the farthest station.
    rest = np.median(readings[(at == stations[-1]).all(axis=1)], axis=0)
    once = ~(at[:, None] == stations).all(axis=2).any(axis=1)
    return wire_of(shape, at[once], readings[once], rest, 5e-4)


def curved(folder: Path) -> Wire:
    """Second curved wire: through the probe's weakest touches."""
    at, readings = table(folder, "curved_calib_May_22.csv")
    base = (at == at[0]).all(axis=1)
    rest = np.median(readings[base], axis=0)
    weak = (np.abs(readings - rest) < WEAK).all(axis=1)
    known, number = np.unique(np.round(at[weak], 2), axis=0, return_counts=True)
    known = known[number >= OFTEN]
    known = known[np.argsort(-known[:, 0])]
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(known, axis=0), axis=1)))
    shape = CubicSpline(along, known)(np.linspace(0.0, along[-1], 60))
    return wire_of(shape, at[~base], readings[~base], rest, 1.5e-4)


def located(model, start, target, sigma):
    """Least squares from several starts (n, m, 3): points of the best, (n, 3)."""
    n, m, _ = start.shape
    x, aim = start.reshape(-1, 3).copy(), np.repeat(target, m, axis=0)
    damping = np.full(n * m, 1e-3)
    point, value, slope = model(x)
    cost = (((value - aim) / sigma) ** 2).sum(axis=1)
    for _ in range(ROUNDS):
        jacobian = slope / sigma[:, None]
        normal = np.swapaxes(jacobian, 1, 2) @ jacobian
        pull = np.swapaxes(jacobian, 1, 2) @ ((value - aim) / sigma)[:, :, None]
        size = np.einsum("nii->ni", normal)
        scaled = normal + np.eye(3) * (damping[:, None] * size + 1e-12)[:, None, :]
        step = np.linalg.solve(scaled, pull)[:, :, 0]
        new = model(x - step)
        after = (((new[1] - aim) / sigma) ** 2).sum(axis=1)
        good = after < cost
        damping = np.where(good, 0.2 * damping, 5.0 * damping)
        x[good] -= step[good]
        cost[good] = after[good]
        for old, one in zip((point, value, slope), new, strict=True):
            old[good] = one[good]
    best = cost.reshape(n, m).argmin(axis=1)
    return point.reshape(n, m, 3)[np.arange(n), best]


def rod_model(sensor):
    """Points, readings and slopes of contacts ξ."""

    def model(x):
        within = np.stack([np.clip(x[:, 0], 0.05, 1.0), *np.clip(x[:, 1:], -60.0, 60.0).T], axis=1)
        touches = sensor.touches(within)
        return (touches.points * sensor.length, *sensor.readings(touches))

    return model


def plate_model(plate, mean):
    """Points, readings and slopes of contact points, mm."""

    def model(x):
        value, slope = plate(1e-3 * x)
        return 1e-3 * x, value + mean, 1e-3 * slope

    return model


def errors(wire: Wire, number: int, draw: int):
    """Errors of readings, counts, and of contact points, mm, of the rod and of the plate."""
    chosen = np.random.default_rng(draw).permutation(len(wire.points))
    train, test = chosen[:number], chosen[number:][:TESTED]
    points, readings = wire.points[train], wire.readings[train]
    found = calibrate_suspension(
        wire.whisker, points, readings, rest=wire.rest, drift=wire.drift,
        base_sigma=wire.base_sigma,
    )  # fmt: skip
    mean = readings.mean(axis=0)
    plate = ThinPlate.fit(points, readings - mean, ratio=PROCESS)
    target, truth = wire.readings[test], wire.points[test]
    nearest = np.linalg.norm(target[:, None] - readings[found.used], axis=2).argsort(axis=1)
    nearest = np.flatnonzero(found.used)[nearest[:, :STARTS]]
    contacts, _ = found.sensor.solve(points)
    sigma = found.sensor.noise
    rod = located(rod_model(found.sensor), contacts[nearest], target, sigma)
    flat = located(plate_model(plate, mean), 1e3 * points[nearest], target, sigma)
    predicted, _ = found.sensor.read(truth)
    misses = predicted - target, plate(truth)[0] + mean - target
    return (
        [np.sqrt(np.nanmean(miss**2)) for miss in misses],
        [1e3 * np.linalg.norm(place - truth, axis=1) for place in (rod, flat)],
    )


def drawn(found: dict, folder: Path) -> None:
    """Figure: errors by the number of touches, one column for each wire."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(10, 6), sharex=True, layout="constrained")
    for column, (name, by_number) in enumerate(found.items()):
        for row, what in enumerate(("readings, counts", "contact point, mm")):
            ax = axes[row, column]
            for k, (model, colour) in enumerate((("rod", "C0"), ("thin plate alone", "C1"))):
                numbers = list(by_number)
                median, high = np.array([by_number[n][row][k] for n in numbers]).T
                ax.fill_between(numbers, median, high, color=colour, alpha=0.2)
                ax.plot(numbers, median, "o-", color=colour, label=model)
            ax.set(xscale="log", yscale="log")
            ax.set_xticks(NUMBERS, [str(n) for n in NUMBERS], minor=False)
            ax.xaxis.set_minor_formatter("")
            if row == 0:
                ax.set_title(name)
            else:
                ax.set_xlabel("touches of the calibration")
            if column == 0:
                ax.set_ylabel(f"error of {what}")
    axes[0, 0].legend(frameon=False)
    figure.savefig(folder / "robot_points.png", dpi=130)
    plt.close(figure)


def main(folder: Path, images: Path, draws: int) -> None:
    """Print a row of the table for each wire and number of touches, and draw them."""
    wires = {"sensor 1": first(folder), "straight": straight(folder), "curved": curved(folder)}
    found = {name: {} for name in wires}
    print("| wire | touches | readings, rod | plate | point, rod | plate |", flush=True)
    for number in NUMBERS:
        for name, wire in wires.items():
            if len(wire.points) < number + 50:
                continue
            many = range(FIRST_DRAW, FIRST_DRAW + draws)
            readings, points = zip(*(errors(wire, number, draw) for draw in many), strict=True)
            rows = [
                [np.quantile(values, [0.5, 0.9]) for values in np.swapaxes(readings, 0, 1)],
                [
                    np.quantile(np.concatenate(values), [0.5, 0.9])
                    for values in zip(*points, strict=True)
                ],
            ]
            found[name][number] = rows
            cells = " | ".join(f"{a:.3g} ({b:.3g})" for row in rows for a, b in row)
            print(f"| {name} | {number} | {cells} |", flush=True)
        drawn(found, images)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path, help="folder of the data")
    parser.add_argument("images", type=Path, help="folder for the figure")
    parser.add_argument("draws", nargs="?", type=int, default=2, help="random draws of touches")
    main(*vars(parser.parse_args()).values())
