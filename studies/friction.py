"""Errors of estimates under friction along the whisker, without and with a prior for it.

`python studies/friction.py [--whisker FILE] [--count N]` prints the table of the page on choosing
signals: contacts deflected by more than 5°, whose force has a component along the whisker of up to
µ times that across it, in any direction of sliding; noise of 1 µN and 0.02 µN·m in each component.
"""

import argparse

import numpy as np
from scipy.stats import chi2

import vibrissa as vb

NOISE = np.diag([1e-6**2] * 3 + [2e-8**2] * 3)
SETS = ("Fx MB MD", "Fx FT MB MD", "Fx FT FD Mx MB MD")
COEFFICIENTS = (0.0, 0.1, 0.3, 0.5)
PRIOR = 0.3
DEFLECTED = np.deg2rad(5.0)


def rubbed(
    contact_map: vb.ContactMap,
    coefficient: float,
    count: int,
    rng: np.random.Generator,
    whisker: vb.Whisker | None = None,
) -> tuple[np.ndarray, vb.Deflection]:
    """Contact points of oblique forces on the map's whisker or another, and what they do to it."""
    whisker = whisker or contact_map.whisker
    nodes = contact_map.to_dataset().isel(station=slice(2, None), load=slice(2, -1))
    shape = nodes.arc_length.shape
    picked = rng.integers(0, nodes.arc_length.size, 5 * count)
    fold = np.broadcast_to(nodes.fold_force.to_numpy()[..., None], shape)
    force = (fold * nodes["load"].to_numpy() ** 2).reshape(-1)[picked]
    bearing = np.broadcast_to(nodes.bearing.to_numpy()[:, None], shape).reshape(-1)[picked]
    force *= rng.uniform(0.97, 1.0, force.size)
    arc = nodes.arc_length.to_numpy().reshape(-1)[picked] * rng.uniform(0.97, 1.0, force.size)
    along = coefficient * np.cos(rng.uniform(0.0, 2.0 * np.pi, force.size))
    components = force * np.stack([along, np.cos(bearing), np.sin(bearing)])
    bent = vb.deflect(whisker, vb.PointForce(arc, components=tuple(components)))
    rest = whisker.centerline(2001)[np.rint(2000 * arc / whisker.length).astype(int)]
    turned = np.linalg.norm(bent.contact_point - rest, axis=1) / arc
    kept = np.flatnonzero((turned > DEFLECTED) & (bent.status == vb.Status.OK))[:count]
    return kept, bent


def scored(found: vb.Contacts, truth: np.ndarray) -> str:
    """Median error with its prediction, and the share of truths in the 95 % region."""
    known = np.isfinite(found.covariance).all(axis=(1, 2))
    away, covariance = (found.point - truth)[known], found.covariance[known]
    size = np.einsum("ni,nij,nj->n", away, np.linalg.pinv(covariance, 1e-12, hermitian=True), away)
    draws = np.random.default_rng(0).normal(size=(len(away), 200, 3))
    variance, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(variance, 0.0))[:, None]
    drawn = np.einsum("nij,nmj->nmi", root, draws)
    error, predicted = (
        np.median(np.linalg.norm(away, axis=1)),
        np.median(np.linalg.norm(drawn, axis=2)),
    )
    inside = np.mean(size < chi2.isf(0.05, 3))
    return f"{1e3 * error:.2f} ({1e3 * predicted:.2f}), {100.0 * inside:.0f} %"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--whisker", help="file of a whisker; by default the γ whisker")
    parser.add_argument("--count", type=int, default=300, help="contacts of each coefficient")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    whisker = vb.load_whisker(chosen.whisker) if chosen.whisker else vb.samples.gamma()
    contact_map = vb.ContactMap.simulate(whisker, grid=False)
    print("| signals | µ | no friction assumed | µ_x unknown, prior 0.3 |\n|---|---:|---:|---:|")
    for using in SETS:
        for coefficient in COEFFICIENTS:
            rng = np.random.default_rng(chosen.seed)
            kept, bent = rubbed(contact_map, coefficient, chosen.count, rng)
            noise = rng.normal(size=(kept.size, 6)) * np.sqrt(np.diag(NOISE))
            signals = vb.base_signals(
                bent.force[kept] + noise[:, :3], bent.moment[kept] + noise[:, 3:]
            )
            truth = bent.contact_point[kept]
            row = [
                scored(contact_map.estimate(signals, using, NOISE, friction=sigma), truth)
                for sigma in (0.0, PRIOR)
            ]
            print(f"| {using.replace(' ', ', ')} | {coefficient} | {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
