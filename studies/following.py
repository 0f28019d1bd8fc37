"""Errors of contacts followed over time, compared with those located sample by sample.

    python studies/following.py [SEEDS]

Simulated whiskers sweep past pegs at four distances: each touch begins, slides along the whisker
and slips off. Under the noise of a sensor each sample is located alone, with the candidate of least
force taken for the contact, and by the filter. Printed are, for three whiskers and four triplets:
how often the candidate nearest to the truth is chosen where there are several (or one that noise
cannot tell from it), errors over the length, how many errors lie beyond the 95 % ellipsoid that is
stated, and how often the filter is right where it states some probability.
"""

import argparse

import numpy as np

import vibrissa as vb
from vibrissa.simulation import facing_peg, simulate, sweep_past

TRIPLETS = ("Fx MB MD", "Fx FT MD", "FT FD MB", "FT MB MD")
RAT = np.repeat([1e-6, 2e-8], 3)
WIRE = np.repeat([1e-3, 2e-4], 3)
WHISKERS = {
    "curved, A·L = 0.82": (vb.Whisker.parabola(40e-3, 0.82 / 40e-3), RAT),
    "γ": (vb.samples.gamma(), RAT),
    "steel wire": (
        vb.Whisker.straight(
            0.3, base_radius=0.5e-3, tip_radius=0.25e-3, youngs_modulus=200e9, poisson_ratio=0.29
        ),
        WIRE,
    ),
}
DISTANCES = (0.45, 0.6, 0.7, 0.85)
ONE = 9.0  # candidates nearer to each other (χ²) are indistinguishable
BEYOND = 7.81  # χ² of three degrees of freedom that one in twenty exceeds


def touches(whisker):
    """Time, pose of the base, wrench and contact point of whisks past pegs."""
    for i, distance in enumerate(DISTANCES):
        peg = facing_peg(whisker, distance, radius=0.02 * whisker.length)
        row = "ABCD"[i]
        moves = sweep_past(whisker, peg, 0.6, 500.0, frequency=2.0, seed=i, row=row)
        truth = simulate(whisker, moves, peg)["truth"].to_dataset()
        force, moment, point = (
            truth[name].values[:, 0] for name in ("force", "moment", "contact_point")
        )
        wrench = np.concatenate([force, moment], axis=1)
        yield moves.time, moves.base_rotation, moves.base_position, wrench, point


def followed(contacts, trial, names, sigma, seed):
    """Rows: whether right (least force, filter), errors, χ² (the same) and probability."""
    time, turn, base, wrench, point = trial
    wrench = wrench + sigma * np.random.default_rng(seed).normal(size=wrench.shape)
    signals = vb.base_signals(wrench[:, :3], wrench[:, 3:])
    rows = np.stack([signals[name] for name in names.split()], axis=-1)
    estimator = vb.Estimator(contacts, names, np.diag(sigma**2), felt_above=5.0)
    length = contacts.whisker.length
    follow = vb.ContactFilter(estimator)
    out = []
    for i in range(len(time)):
        known = follow(time[i], rows[i], turn[i], base[i])
        if known.located is None or not np.isfinite(point[i]).all():
            continue
        candidates = known.located.candidates.point @ turn[i].T + base[i]
        away = known.point - point[i]
        chi, own = chi_squared(away, known.covariance), np.nan
        first = ours = alone = np.nan
        if len(candidates):
            far = np.linalg.norm(candidates - point[i], axis=1)
            alone = far[0] / length
            spreads = turn[i] @ known.located.candidates.covariance @ turn[i].T
            own = chi_squared(candidates[0] - point[i], spreads[0])
            if len(candidates) > 1:
                best = far.argmin()
                nearest = np.linalg.norm(candidates - known.point, axis=1).argmin()
                first, ours = (
                    chi_squared(candidates[k] - candidates[best], spreads[k] + spreads[best]) < ONE
                    for k in (0, nearest)
                )
        error = np.linalg.norm(away) / length
        out.append((first, ours, alone, error, own, chi, known.probability))
    return np.array(out, dtype=np.float64).reshape(-1, 7)


def chi_squared(away, covariance):
    """Squared Mahalanobis distance; NaN where the covariance is none."""
    try:
        return away @ np.linalg.solve(covariance, away)
    except np.linalg.LinAlgError:
        return np.nan


def line(rows):
    """Of a table."""
    first, ours, alone, error, own, chi, _ = rows.T
    several = np.isfinite(first)
    right = [
        f"{100 * np.mean(part[several]):5.0f}" if several.any() else "    –"
        for part in (first, ours)
    ]
    sizes = [100 * np.nanquantile(part, q) for q in (0.5, 0.9) for part in (alone, error)]
    beyond = [100 * np.mean(part[np.isfinite(part)] > BEYOND) for part in (own, chi)]
    return (
        f"{len(rows):6d}{several.sum():6d}  {right[0]} {right[1]}  "
        f"{sizes[0]:6.2f} {sizes[1]:6.2f}  {sizes[2]:6.1f} {sizes[3]:6.1f}  "
        f"{beyond[0]:5.0f} {beyond[1]:5.0f}"
    )


def main(seeds):
    head = "samples several  right, %  median error, %  90 %, %  beyond 95 %, %"
    print(f"{'':31}{head}   (least force, filter)")
    everything = []
    for name, (whisker, sigma) in WHISKERS.items():
        contact_map = vb.ContactMap.simulate(whisker, grid=False)
        trials = list(touches(whisker))
        for names in TRIPLETS:
            runs = [
                followed(contact_map, trial, names, sigma, seed + 10 * i)
                for i, trial in enumerate(trials)
                for seed in range(seeds)
            ]
            rows = np.concatenate(runs)
            everything.append(rows)
            print(f"{name:20}{names:11}{line(rows)}", flush=True)
    rows = np.concatenate(everything)
    several = np.isfinite(rows[:, 1])
    for low, high in ((0.0, 0.7), (0.7, 0.9), (0.9, 0.99), (0.99, 1.1)):
        which = several & (rows[:, 6] >= low) & (rows[:, 6] < high)
        if which.any():
            stated, right = rows[which, 6].mean(), rows[which, 1].mean()
            print(f"stated {100 * stated:5.1f} %: right {100 * right:5.1f} % of {which.sum()}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("seeds", nargs="?", type=int, default=3, help="draws of noise")
    main(parser.parse_args().seeds)
