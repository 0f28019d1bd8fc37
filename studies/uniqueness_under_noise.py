"""How often answers called unique under noise are wrong, and the coverage of their regions.

`python studies/uniqueness_under_noise.py [WHISKER …]` prints a table for the γ whisker and for each
file of a whisker, with a row for each of the 20 triplets, sets of four and six signals, and the
wrench with friction; `--number` contacts (1000 by default) in each of five classes of load, and
`--noise` µN and µN·m (1 and 0.02). Contacts are uniform in arc length, bearing and root of the load
over the fold's. A minute or two for each whisker.

Columns: share of contacts without an answer, that are UNIQUE, of these beyond three standard
deviations (0.27 % of normal errors are), the same for UNIQUE with a valid covariance, and in each
class how many of those the 95 % region holds, and how many are beyond three. In brackets fewer than
100 contacts. Behind the share of all valid ones is the 95 % interval of Clopper and Pearson; a star
marks shares that are significantly (one-sided, 5 %) above 0.4 %: of 40 classes two are by chance.
Of 1,000 valid answers nine, 0.9 %, have a star. All whiskers and signals have the same noise.
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
from measures.contacts import CHI2, drawn
from scipy.stats import beta, binom

import vibrissa as vb
from vibrissa.signals import TRIPLETS

SETS = (
    *TRIPLETS,
    ("Fx", "FT", "MB", "MD"),
    ("Fx", "Mx", "MB", "MD"),
    ("Fx", "FT", "FD", "Mx", "MB", "MD"),
)
CLASSES = (0.01, 0.5, 0.9, 0.97, 0.99, 0.995)
"""Bounds of load over the fold's."""
BEYOND = 14.156
"""Squared Mahalanobis distance of three standard deviations in space, 99.73 %."""
FEW = 100
ASKED = 0.004
"""Largest share of valid answers beyond that is asked for."""


def above(beyond: int, number: int) -> str:
    """Mark a share that is significantly above what is asked."""
    return "*" if binom.sf(beyond - 1, number, ASKED) < 0.05 else ""


def interval(beyond: int, number: int) -> str:
    """Interval of a share, %."""
    low = beta.ppf(0.025, beyond, number - beyond + 1) if beyond else 0.0
    high = beta.ppf(0.975, beyond + 1, number - beyond) if beyond < number else 1.0
    return f"{100 * low:.2f}-{100 * high:.2f}"


def contacts_of_classes(whisker, number, rng):
    """Contact points, forces and moments (classes, number, 3)."""
    bent = [drawn(whisker, number, rng, np.sqrt(pair)) for pair in pairwise(CLASSES)]
    return (
        np.stack([getattr(one, name) for one in bent])
        for name in ("contact_point", "force", "moment")
    )


def judged(found, point) -> list[str]:
    """Cells of one row; see above."""
    unique = found.status == vb.Status.UNIQUE
    error = found.point - point
    with np.errstate(invalid="ignore"):
        inverse = np.linalg.inv(np.where(unique[..., None, None], found.covariance, np.eye(3)))
    away = np.einsum("...i,...ij,...j", error, inverse, error)
    none = ~np.isfinite(found.point).all(axis=-1)
    valid = unique & found.covariance_valid
    cells = [f"{100 * none.mean():.2f}"]
    for kept in (unique, valid):
        beyond = f"{100 * (away[kept] > BEYOND).mean():.2f}" if kept.any() else "–"
        cells += [f"{100 * kept.mean():.1f}", beyond]
    beyond, number = int((away[valid] > BEYOND).sum()), int(valid.sum())
    cells[-1] += above(beyond, number)
    cells.append(interval(beyond, number) if number else "–")
    for kept, far in zip(valid, away, strict=True):
        held, cell = far[kept] < CHI2[1], "–"
        if kept.any():
            wrong = far[kept] > BEYOND
            mark = above(int(wrong.sum()), len(wrong))
            cell = f"{100 * held.mean():.1f} {100 * wrong.mean():.2f}{mark}"
        cells.append(cell if len(held) >= FEW else f"({cell})")
    return cells


def table_of(whisker, number, noise, wanted, seed):
    """Print the rows of one whisker."""
    contact_map = vb.ContactMap.simulate(whisker, grid=False)
    rng = np.random.default_rng(seed)
    point, force, moment = contacts_of_classes(whisker, number, rng)
    sigma = np.repeat(noise, 3)
    force = force + sigma[:3] * rng.normal(size=force.shape)
    moment = moment + sigma[3:] * rng.normal(size=moment.shape)
    signals, covariance = vb.base_signals(force, moment), np.diag(sigma**2)
    classes = [f"to {high:g}" for high in CLASSES[1:]]
    head = ["none", "unique", "> 3σ", "valid", "> 3σ", "interval", *classes]
    print(f"{'%':22}" + "".join(f"{name:>13}" for name in head))
    for names in (*SETS, "wrench"):
        label = names if isinstance(names, str) else " ".join(names)
        if wanted and label not in wanted:
            continue
        if names == "wrench":
            found = vb.estimate_from_wrench(whisker, force, moment, noise=covariance)
        else:
            found = contact_map.estimate(signals, names, noise=covariance)
        print(f"{label:22}" + "".join(f"{cell:>13}" for cell in judged(found, point)), flush=True)


def main() -> None:
    """Read the arguments and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("whisker", nargs="*", type=Path)
    parser.add_argument("--number", type=int, default=1000)
    parser.add_argument("--noise", nargs=2, type=float, default=(1.0, 0.02), metavar=("µN", "µN·m"))
    parser.add_argument("--set", action="append", metavar="NAMES", help="e.g. 'Fx MB MD'")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    noise = 1e-6 * np.array(chosen.noise)
    whiskers = {"γ": vb.samples.gamma()}
    whiskers |= {path.stem: vb.load_whisker(path) for path in chosen.whisker}
    for name, whisker in whiskers.items():
        print(f"{name}: {chosen.number} contacts a class, {noise[0]:g} N and {noise[1]:g} N·m")
        table_of(whisker, chosen.number, noise, chosen.set, chosen.seed)


if __name__ == "__main__":
    main()
