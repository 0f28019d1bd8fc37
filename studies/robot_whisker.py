"""A real whisker over a Hall sensor: errors by the number of touches that it was calibrated by.

Data: sensor 1 of arXiv 2406.06038, in the folder that is named. For each number of touches, several
random draws: the error of readings at touches that were not drawn, of the rod on its suspension and
of the published thin-plate process; then sweeps past a cylinder of 30 mm (distance from it, about a
fitted axis) and a cone (distance from its mesh, placed as published), with the first 15 samples
left out, and those whose contact is beyond 0.9 of the wire, where the rod is beyond what touches
within 40 mm of the base calibrate.

    python studies/robot_whisker.py ../shared/robot_whisker 50 10
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from vibrissa.objects import Mesh
from vibrissa.sensors import Stage, ThinPlate, calibrate_suspension, follow_sweep

HERE = Path(__file__).parent
FIRST_DRAW = 100  # draws below were looked at while the filter's constants were chosen
TUNED = ("cylinder_trial1", "cone_trial1", "cone_trial3")
REPORTED = tuple(f"{what}_trial{k}" for what in ("cylinder", "cone") for k in (0, 2, 4))
MESH_ORIGIN = np.array([0.5e-3, 12.5e-3, -0.5e-3])
RADIUS = 15e-3
SKIPPED, SIGNAL, FARTHEST = 15, 250.0, 0.9
STEP = 1e-5  # of differences, m


def cone(folder: Path) -> Mesh:
    """Cone as published: its z turned over, and moved."""
    mesh = Mesh.load(folder / "objects" / "ConeFixture.stl", resolution=3e-3)
    turned = mesh.vertices * [1.0, 1.0, -1.0] + MESH_ORIGIN
    return Mesh(turned, mesh.faces[:, ::-1], resolution=0.35e-3)


def placed(surface, points: np.ndarray, start: np.ndarray):
    """Distances from a surface that is moved in x and y to where they are least; and normals."""
    fit = least_squares(
        lambda t: surface(points + np.append(t, 0.0)), start, diff_step=1e-4, x_scale=1e-3
    )
    at, steps = points + np.append(fit.x, 0.0), STEP * np.eye(3)
    return fit, np.stack([(surface(at + e) - surface(at - e)) / (2 * STEP) for e in steps], axis=1)


def cylinder(points: np.ndarray) -> np.ndarray:
    """Distances from a cylinder along z."""
    return np.linalg.norm(points[:, :2], axis=1) - RADIUS


def distances(stage: Stage, sensor, folder: Path, name: str, mesh: Mesh):
    """Distances of contacts from the surface, m, and their standard deviations.

    First where the surface was published to be (NaN for the cylinder), then about a fitted place:
    what contacts have in common is then neither in the distances nor in their prediction.
    """
    sweep = stage.sweep(folder / "sweeps" / f"{name}.csv")
    found = follow_sweep(sensor, *sweep)
    strong = np.hypot(sweep.readings[:, 0], sweep.readings[:, 1]) > SIGNAL
    rows = np.flatnonzero(found.in_contact & strong)[SKIPPED:]
    rows = rows[found.arc_length[rows] < FARTHEST * sensor.length]
    points, covariance = found.points[rows], found.covariance[rows]
    if "cylinder" in name:
        middle = -points[:, :2].mean(axis=0)
        tries = [
            placed(cylinder, points, middle + np.array([0.0, side * RADIUS]))
            for side in (-1.0, 1.0)
        ]
        fit, normal = min(tries, key=lambda one: one[0].cost)
        published = np.full(len(rows), np.nan)
    else:

        def surface(at: np.ndarray) -> np.ndarray:
            return mesh.signed_distance(at * [1.0, 1.0, -1.0])

        published = surface(points)
        fit, normal = placed(surface, points, np.zeros(2))
    variance = np.einsum("ki,kij,kj->k", normal, covariance, normal)
    common = np.einsum("mki,ki->km", found.shared[:, rows], normal)
    own = np.maximum(variance - (common**2).sum(axis=1), 0.0)
    left = np.eye(len(rows)) - normal[:, :2] @ np.linalg.pinv(normal[:, :2])
    after = ((left @ common) ** 2).sum(axis=1) + left**2 @ own
    return (published, np.sqrt(variance)), (fit.fun, np.sqrt(after))


def spread(values) -> str:
    """Median and 90 % of draws."""
    return f"{np.median(values):.3g} ({np.quantile(values, 0.9):.3g})"


def main(folder: Path, number: int, draws: int) -> None:
    """Print a line for each kind of error."""
    stage = Stage((HERE / "robot_whisker.toml").read_text(), folder)
    points, readings, rest, drift = stage.touches()
    whisker, mesh = stage.whisker(), cone(folder)
    rod, plate, swept = [], [], {name: [] for name in REPORTED}
    for draw in range(FIRST_DRAW, FIRST_DRAW + draws):
        chosen = np.random.default_rng(draw).permutation(len(points))
        train, test = chosen[:number], chosen[number:][:300]
        found = calibrate_suspension(
            whisker, points[train], readings[train], channels=stage.channels, rest=rest, drift=drift
        )
        predicted, _ = found.sensor.read(points[test])
        rod.append(np.sqrt(np.nanmean((predicted - readings[test]) ** 2)))
        mean = readings[train].mean(axis=0)
        process = ThinPlate.fit(points[train], readings[train] - mean, ratio=1e-5)
        there = process(points[test])[0] + mean
        plate.append(np.sqrt(np.mean((there - readings[test]) ** 2)))
        for name in REPORTED:
            swept[name].append(
                [
                    (1e3 * np.abs(gap).mean(), 1e3 * np.abs(gap).max(), np.mean((gap / sigma) ** 2))
                    for gap, sigma in distances(stage, found.sensor, folder, name, mesh)
                ]
            )
    print(f"{number} touches, {draws} draws; median (90 %)")
    print(f"  readings, rms counts: rod {spread(rod)}, thin plate {spread(plate)}")
    for what, k in (("cylinder", 1), ("cone", 0), ("cone", 1)):
        of = np.array([swept[name] for name in REPORTED if what in name])[:, :, k]
        mean, largest, nees = of.mean(axis=0)[:, 0], of.max(axis=0)[:, 1], of.mean(axis=0)[:, 2]
        print(
            f"  {what}, {('where published', 'place fitted')[k]}: mean distance {spread(mean)} mm, "
            f"largest {spread(largest)} mm, squared over predicted {spread(nees)}",
            flush=True,
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path, help="folder of the data")
    parser.add_argument("touches", type=int, help="touches that calibrate")
    parser.add_argument("draws", type=int, help="random draws of them")
    main(*vars(parser.parse_args()).values())
