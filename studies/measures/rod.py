"""The rod against what vibrissa did not compute; the references are those of the tests."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from pages import percent, power, table
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import vibrissa as vb
from vibrissa.plots.style import (
    BLUE,
    GREEN,
    MUTED,
    ORANGE,
    box_axes,
    conclude,
    looking,
    new_figure,
)

DATA = Path(__file__).parents[2] / "tests" / "data"
LENGTH = 39.4e-3
STEPS = (18, 36, 72, 144)
QUARTILES = (0.25, 0.5, 0.75)
FORCE, MOMENT, POINT = slice(0, 3), slice(3, 6), slice(6, 9)


def blocks(quick: bool) -> dict[str, str]:
    """All of the page's section on the rod; all of it takes seconds."""
    return {
        "steps": convergence(),
        "elastica3d": paper_s_solver(),
        "published": published(),
    }


def reference(name: str) -> dict[str, Any]:
    return json.loads((DATA / f"{name}.json").read_text(encoding="utf-8"))


def relative(found, known):
    """|found - known| / |known| of vectors in the last axis."""
    return np.linalg.norm(found - known, axis=-1) / np.linalg.norm(known, axis=-1)


def convergence() -> str:
    rows = []
    for steps in STEPS:
        name = f"{steps} (default)" if steps == 36 else str(steps)
        rows.append([name, *(power(x) for x in (*kirchhoff(steps), cantilever(steps)))])
    return table(
        ["steps", "contact point, of L", "force", "moment", "cantilever's tip, of L"], rows
    )


def picture() -> Figure:
    """Errors by steps, of ours and of the paper's solver."""
    data, whisker = reference("elastica3d"), w1()
    ours = np.array([kirchhoff(steps) for steps in STEPS]).T
    theirs = {
        "force": ("force_nodes", by_force(whisker, data)[0].max(axis=0), "o"),
        "contact point": ("point_nodes", by_point(whisker, data)[0].max(axis=0), "s"),
    }
    with looking():
        figure = new_figure("double", 62.0, None)
        axes = box_axes(figure, (16.0, 10.0, 158.0, 50.0), xscale="log", yscale="log")
        for name, (nodes, errors, mark) in theirs.items():
            label = f"Elastica3D, known {name}"
            axes.plot(data[nodes], errors, f"{mark}-", markersize=3.0, color=MUTED, label=label)
        parts = zip(
            ("contact point, of L", "force", "moment"), ours, (BLUE, ORANGE, GREEN), strict=True
        )
        for name, errors, colour in parts:
            axes.plot(STEPS, errors, "o-", markersize=3.0, color=colour, label=f"vibrissa, {name}")
        axes.axvline(36, color=MUTED, linewidth=0.6, linestyle=":")
        axes.text(34.5, 1e-10, "default", color=MUTED, ha="right", fontsize=6.0)
        ticks = [18, 36, 72, 144, 400, 800, 1600]
        axes.set_xticks(ticks, [str(n) for n in ticks])
        axes.minorticks_off()
        axes.set(xlabel="steps, or nodes", ylabel="worst relative error")
        axes.legend(loc="center right")
        nodes, worst, _ = theirs["force"]
        conclude(
            figure,
            f"36 steps of vibrissa are accurate to {power(ours[:, STEPS.index(36)].max())}, "
            f"{data[nodes][-1]} nodes of Elastica3D to {power(worst[-1])}",
        )
        return figure


def kirchhoff(steps):
    """Worst p/L, F and M of 120 loads against the independent integration."""

    def ramp(s):
        out = np.maximum(0.0, 15.0 * (s - 0.6 * LENGTH) / (0.4 * LENGTH))
        return np.stack([0.0 * s, out, 5.0 + 400.0 * s], axis=-1)

    whiskers = {
        "K1": vb.Whisker.from_curvature(LENGTH, lambda s: [0.0, 0.0, 12.0]),
        "K2": vb.Whisker.from_curvature(LENGTH, ramp, breaks=(0.6 * LENGTH,)),
        "K3": vb.Whisker.from_curvature(LENGTH, lambda s: [0.0, 0.0, 0.0]),
    }
    worst = np.zeros(3)
    for name, whisker in whiskers.items():
        rows = [case for case in reference("kirchhoff")["cases"] if case[0] == name]
        s, force, angle = np.array([case[1:4] for case in rows]).T
        p, f, m = (np.array([case[i] for case in rows]) for i in (4, 5, 6))
        bent = vb.deflect(whisker, vb.PointForce(s * LENGTH, force, angle), steps=steps)
        place = np.linalg.norm(bent.contact_point - p, axis=1).max() / LENGTH
        found = [place, relative(bent.force, f).max(), relative(bent.moment, m).max()]
        worst = np.maximum(worst, found)
    return worst


def cantilever(steps):
    """Worst tip place/L of a cylinder under dead and follower loads, by elliptic integrals."""
    rod = vb.Whisker.straight(LENGTH, tip_radius=100e-6)
    rows = reference("elliptic")["rows"]
    load, q, slope, x, y = (np.array(column) for column in zip(*rows, strict=True))
    unit = rod.base_bending_stiffness / LENGTH**2
    follower = load == "follower"
    along = np.where(follower, 0.0, q * np.sin(slope)) * unit
    across = np.where(follower, q, q * np.cos(slope)) * unit
    bent = vb.deflect(rod, vb.PointForce(LENGTH, components=(along, across, 0.0)), steps=steps)
    tip = np.stack([x, y, 0 * x], axis=-1)
    return np.linalg.norm(bent.contact_point / LENGTH - tip, axis=1).max()


def paper_s_solver() -> str:
    """Elastica3D's results at rising numbers of nodes against ours."""
    data = reference("elastica3d")
    whisker = w1()
    rows = []
    nodes = sorted({*data["force_nodes"], *data["point_nodes"]})
    for label, of, (errors, limit) in (
        ("known force: force, moment, contact point", "force_nodes", by_force(whisker, data)),
        ("known contact point: force, moment", "point_nodes", by_point(whisker, data)),
    ):
        worst = dict(zip(data[of], errors.max(axis=0), strict=True))
        cells = [percent(worst[n]) if n in worst else "" for n in nodes]
        low, middle, high = np.quantile(np.log2(errors[:, -3:-1] / errors[:, -2:]), QUARTILES)
        rows.append([label, *cells, power(limit), f"{middle:.2f} ({low:.2f}–{high:.2f})"])
    head = [f"{n} nodes" for n in nodes]
    return table(["worst error of", *head, "extrapolated", "order (quartiles)"], rows)


def by_force(whisker, data):
    """Errors (cases, nodes) of three vectors in each case, and the worst of extrapolated ones."""
    errors, limits = [], []
    for (s, force, zeta), *conditions in data["force_mode"]:
        for runs in map(np.array, conditions):
            limit = (8.0 * runs[-1] - 6.0 * runs[-2] + runs[-3]) / 3.0

            def rolled(roll, s=s, force=force, zeta=zeta):
                bent = vb.deflect(whisker, vb.PointForce(s, force, zeta + np.pi + roll[0]))
                return np.concatenate([bent.force, bent.moment, bent.contact_point])

            def miss(roll, rolled=rolled, known=limit[FORCE] / force, force=force):
                return rolled(roll)[FORCE] / force - known

            # Its frame at the contact is rolled against ours where the whisker is not planar.
            ours = rolled(least_squares(miss, 0.0).x)
            for part in (FORCE, MOMENT, POINT):
                errors.append(relative(runs[:, part], ours[part]))
                limits.append(relative(limit[part], ours[part]))
    return np.array(errors), max(limits)


def by_point(whisker, data):
    """The same of two vectors for known contact points; the last has slipped off."""
    errors, limits = [], []
    for point, *nodes in data["point_mode"][:-1]:
        bent, runs = vb.deflect(whisker, vb.PointContact(point)), np.array(nodes)
        for ours, part in ((bent.force, FORCE), (bent.moment, MOMENT)):
            errors.append(relative(runs[:, part], ours))
            limits.append(relative(2.0 * runs[-1, part] - runs[-2, part], ours))
    return np.array(errors), max(limits)


def w1():
    """The whisker that Elastica3D was given: y = A x², z = B max(0, σ - 0.6 L)², σ the parabola's
    arc length; d1' = -(k·d1) t, with k the curvature vector."""
    a, kink = 10.0, 0.6 * LENGTH
    b = 1.5e-3 / (0.4 * LENGTH) ** 2

    def along(x, sigma, out):
        slope, rise = 2.0 * a * x, 2.0 * b * (sigma - kink) * out
        c, g = np.hypot(1.0, slope), np.hypot(1.0, rise)
        t = np.array([1.0 / c, slope / c, rise]) / g
        turn = np.array([-slope, 1.0, 0.0]) * 2.0 * a / c**4 + np.array([0.0, 0.0, 2.0 * b * out])
        return t, (turn - t * (t @ turn)) / g**2, c, g

    def rate(_, y, out):
        t, k, c, g = along(y[0], y[1], out)
        return [1.0 / (c * g), 1.0 / g, *(-(k @ y[2:]) * t)]

    pieces, start = [], [0.0, 0.0, 0.0, 1.0, 0.0]
    for out, span in ((0.0, (0.0, kink)), (1.0, (kink, LENGTH))):
        look = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-14, "dense_output": True}
        piece = solve_ivp(rate, span, start, args=(out,), **look)
        start = piece.y[:, -1]
        pieces.append(piece.sol)

    def curvature(s):
        if np.ndim(s):
            return np.array([curvature(one) for one in s])
        out = float(s >= kink)
        y = pieces[int(out)](s)
        t, k, _, _ = along(y[0], y[1], out)
        return np.array([0.0, -k @ np.cross(t, y[2:]), k @ y[2:]])

    return vb.Whisker.from_curvature(LENGTH, curvature, breaks=(kink,))


def published() -> str:
    """A published whisk, and beam theory for small angles."""
    force, moment = whisk()
    rows = [
        ["Quist & Hartmann 2012, Fig. 8, six angles: force", power(force)],
        ["the same: moment", power(moment)],
        ["beam theory, 10⁻⁴ rad: moment of a cylinder, 3 EI θ / r", power(beam(1.0, 0.0))],
        ["the same of a cone, times 1 − r/L", power(beam(1e-4, 1.0))],
    ]
    return table(["", "worst relative difference"], rows)


def whisk():
    """Worst difference from Quist & Hartmann 2012, Fig. 8, in force and moment."""
    whisker = vb.Whisker.parabola(35e-3, 23.3, base_radius=81.5e-6)
    x, y, _ = whisker.position(17.5e-3)
    turned = -np.radians([5.0, 10.0, 15.0, 20.0, 25.0, 30.0])
    cos, sin = np.cos(turned), np.sin(turned)
    points = np.stack([x * cos - y * sin, x * sin + y * cos, 0.0 * turned], axis=-1)
    bent = vb.deflect(whisker, vb.PointContact(points))
    fx = [21.9, 29.4, 20.8, -5.0, -47.8, -106.6]
    fy = [-42.4, -92.2, -145.0, -196.3, -241.1, -274.3]
    mz = np.array([-0.803, -1.650, -2.516, -3.374, -4.197, -4.953])
    force = relative(bent.force[:, :2] * 1e6, np.stack([fx, fy], axis=-1)).max()
    return force, np.abs(bent.moment[:, 2] * 1e6 / mz - 1.0).max()


def beam(tip, slimming):
    """Worst difference of the moment from that of a slender beam."""
    angle, r = 1e-4, np.array([0.3, 0.5, 0.7, 0.9]) * LENGTH
    rod = vb.Whisker.straight(LENGTH, tip_radius=tip * 100e-6)
    points = np.stack([r * np.cos(angle), r * np.sin(angle), 0.0 * r], axis=-1)
    moment = vb.deflect(rod, vb.PointContact(points)).moment[:, 2]
    known = 3.0 * rod.base_bending_stiffness * angle * (1.0 - slimming * r / LENGTH) / r
    return np.abs(moment / known - 1.0).max()
