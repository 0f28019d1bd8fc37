"""Forces at the very tip that are normal to an object, not to the whisker: are they found?

`python studies/tip.py [--count N] [--whisker FILE] [--page]`: contacts of the side and of the tip,
drawn evenly over the contact points of either kind, with noise of force and moment of a share of
EI/L² and EI/L, once without and once with a prior that makes both equally probable. `--page` writes
the table to `docs/several-contacts.md`.
"""

import argparse
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from friction import scored
from pages import put, table

import vibrissa as vb

SETS = ("Fx MB MD", "Fx FT MB MD", "Fx FT FD Mx MB MD")
RODS = {
    "plastic, 100 mm, ratio 3": (
        vb.Whisker.parabola(0.1, 2.0, base_radius=5e-4, tip_radius=1.7e-4, youngs_modulus=2.3e9),
        0.003,
    ),
    "steel wire, 150 mm": (
        vb.Whisker.straight(0.15, base_radius=2.5e-4, tip_radius=2.5e-4, youngs_modulus=2e11),
        0.01,
    ),
    "γ, 40 mm, ratio 15": (vb.samples.gamma(), 0.007),
}
HEAD = ("whisker, noise", "signals", "side only", "with the tip", "valid, %")
HEAD = (*HEAD, "`TIP_CONTACT`, of the tip %", "of the side %", "tip `UNIQUE`, %")
EVEN = vb.Prior(tip=0.5)
STEEPEST = np.deg2rad(75.0)
SMALLEST = 0.01
"""Smallest force that is drawn, of the largest."""
_STEP = 1e-4


def of_the_tip(contact_map, count, rng):
    """Forces (count, 3) at the tip, N, of which contact points are uniform while they are stable.

    Many are drawn, sizes evenly in their logarithm because stable forces are small on some rods;
    some are kept with a chance proportional to det ∂p/∂f over the density of the draws. Which are
    stable is found along the way from rest, by differences of what `deflect` solves.
    """
    whisker = contact_map.whisker
    unit = whisker.base_bending_stiffness / whisker.length**2
    largest = 3.0 * float(contact_map.to_dataset().fold_force.values[-1].max() / unit)
    n = max(60 * count, 2000)
    beta, psi = rng.uniform(0.1, STEEPEST, n), rng.uniform(0.0, 2.0 * np.pi, n)
    toward = np.stack([-np.sin(beta), np.cos(beta) * np.cos(psi), np.cos(beta) * np.sin(psi)], 1)
    size = largest * SMALLEST ** rng.uniform(size=n)
    good, chance = np.ones(n, bool), np.zeros(n)
    for share in np.linspace(0.1, 1.0, 10):
        stable, chance = _stable(whisker, share * size[:, None] * toward * unit)
        good &= stable
    weight = np.where(good, chance * np.cos(beta) * size**3, 0.0)
    pick = rng.choice(n, count, replace=False, p=weight / weight.sum())
    return size[pick, None] * toward[pick] * unit


def _stable(whisker, force):
    """Whether a plate that is normal to the force holds the tip, and |det ∂p/∂f| (relative)."""
    step = _STEP * np.linalg.norm(force, axis=1).max()

    def solved(force):
        bent = vb.deflect(whisker, vb.PointForce(whisker.length, components=tuple(force.T)))
        return np.concatenate([bent.force, bent.contact_point], axis=1)

    slopes = [(solved(force + e) - solved(force - e)) / (2.0 * step) for e in step * np.eye(3)]
    slopes = np.nan_to_num(np.stack(slopes, axis=2))
    by_point = slopes[:, 3:]
    det = np.linalg.det(by_point)
    held = slopes[:, :3] @ np.linalg.pinv(by_point)
    at_base = solved(force)[:, :3]
    normal = np.nan_to_num(at_base / np.linalg.norm(at_base, axis=1, keepdims=True))
    plane = np.eye(3) - normal[:, :, None] * normal[:, None, :]
    least = np.linalg.eigvalsh(plane @ (held + np.swapaxes(held, 1, 2)) @ plane)
    return (det > 0.0) & (least[:, 0] > -1e-6 * least[:, 2]), np.abs(det)


def of_the_side(contact_map, count, rng):
    """Arc lengths and forces of contacts of the side, about uniform over contact points."""
    data = contact_map.to_dataset()
    chart = contact_map.chart
    size = np.abs(np.linalg.det(chart.tangents[..., 3:, :] @ chart.frames))
    size = np.nan_to_num(np.where(np.arange(size.shape[2]) < size.shape[2] - 1, size, 0.0))
    pick = rng.choice(size.size, count, p=size.ravel() / size.sum())
    arc = np.broadcast_to(data.arc_length.values, size.shape).ravel()[pick]
    force = chart.contacts.reshape(-1, 3)[pick, 1:] * chart.discretization.force
    return arc, force * rng.uniform(0.92, 1.0, (count, 1))


def rows(name, whisker, level, asked):
    """A row for each set of signals."""
    rng = np.random.default_rng(asked.seed)
    contact_map = vb.ContactMap.simulate(whisker, grid=False)
    unit = whisker.base_bending_stiffness / whisker.length**2
    tip = of_the_tip(contact_map, asked.count, rng)
    arc, across = of_the_side(contact_map, asked.count, rng)
    bent = vb.deflect(
        whisker,
        vb.PointForce(
            np.append(np.full(len(tip), whisker.length), arc),
            components=tuple(np.concatenate([tip, np.column_stack([0.0 * arc, across])]).T),
        ),
    )
    of_tip = np.arange(2 * asked.count) < asked.count
    noise = np.diag(np.repeat([level * unit, level * unit * whisker.length], 3) ** 2)
    for using in SETS:
        if not contact_map.determines(tuple(using.split())):
            continue
        drawn = rng.normal(size=(len(of_tip), 6)) * np.sqrt(np.diag(noise))
        signals = vb.base_signals(bent.force + drawn[:, :3], bent.moment + drawn[:, 3:])
        plain, found = (
            contact_map.estimate(signals, using, noise, prior=one) for one in (None, EVEN)
        )
        called, unique = (
            found.status == status for status in (vb.Status.TIP_CONTACT, vb.Status.UNIQUE)
        )
        errors = [
            scored(
                SimpleNamespace(point=one.point[of_tip], covariance=one.covariance[of_tip]),
                bent.contact_point[of_tip],
            )
            for one in (plain, found)
        ]
        shares = (found.covariance_valid[called], called[of_tip], called[~of_tip], unique[of_tip])
        label = f"{name}, {100 * level:g} %"
        yield [label, using, *errors, *(f"{100 * one.mean():.1f}" for one in shares)]


def main():
    """Print the table, or write it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--whisker", help="file of a whisker instead of the three of the page")
    parser.add_argument("--count", type=int, default=200, help="contacts of either kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--page", action="store_true")
    asked = parser.parse_args()
    rods = RODS
    if asked.whisker:
        rods = {Path(asked.whisker).stem: (vb.load_whisker(asked.whisker), 0.007)}
    every = [row for name, rod in rods.items() for row in rows(name, *rod, asked)]
    block = table(HEAD, every, texts=2)
    print(block)
    if asked.page and not asked.whisker:
        put(Path(__file__).parents[1] / "docs" / "several-contacts.md", {"tip": block})


if __name__ == "__main__":
    main()
