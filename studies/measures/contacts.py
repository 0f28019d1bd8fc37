"""Contacts found again: from three signals, from force and moment, and through noise."""

import numpy as np
from pages import few, percent, power, table

import vibrissa as vb
from vibrissa.rod import contacts_at, discretize, stable_set
from vibrissa.signals import SIGNALS, TRIPLETS, within_cone

FINE = 500
NOISE = np.diag([1e-6] * 3 + [2e-8] * 3) ** 2
SAMPLES = ("gamma", "curved", "straight", "curved_cylinder", "straight_cylinder")
CHI2 = (3.5058, 7.8147)
"""68 and 95 % of χ² of three degrees of freedom."""

BEST = ("Fx", "MB", "MD")
FOLDED = (
    ("gamma", ("Mx", "MB", "MD")),
    ("gamma", ("Fx", "FT", "MD")),
    ("gamma", ("Fx", "FD", "MB")),
    ("gamma", ("FT", "FD", "MB")),
    ("straight", ("Fx", "FT", "MD")),
    ("straight", ("FT", "FD", "MB")),
)


def blocks(quick: bool) -> dict[str, str]:
    """All of the page's section on contacts; a minute or two."""
    share = 0.04 if quick else 1.0
    charts = {name: chart(name) for name in ("gamma", "straight")}
    return {
        "found": triplets(charts["gamma"], share),
        "folds": beside_folds(charts, int(4000 * share)),
        "wrench": wrenches(int(2000 * share)),
        "noise": noise(charts["gamma"], int(4000 * share)),
    }


def chart(name):
    return vb.ContactMap.simulate(getattr(vb.samples, name)(), grid=False)


def name_of(signals):
    return ", ".join(f"{one[0]}_{one[1]}" for one in signals)


def drawn(whisker, n, rng, load=(0.0, 0.99), friction=0.0, steps=36):
    """Contacts all over Ω: uniform in arc length, bearing and root of the load over the fold's."""
    low, high = [0.0, -np.pi, load[0]], [1.0, np.pi, load[1]]
    s, fy, fz = contacts_at(stable_set(whisker).fold, rng.uniform(low, high, (n, 3))).T
    fx = rng.uniform(-friction, friction, n) * np.hypot(fy, fz)
    unit = discretize(whisker).force
    load_at = vb.PointForce(s * whisker.length, components=(fx * unit, fy * unit, fz * unit))
    return vb.deflect(whisker, load_at, steps=steps)


def away(found, bent, whisker):
    """Distance/L of the nearest candidate."""
    gap = np.linalg.norm(found.candidates.point - bent.contact_point[:, None], axis=-1)
    return np.where(np.isnan(gap), np.inf, gap).min(axis=1) / whisker.length


def found_again(contacts, names, n, rng, load=(0.0, 0.99)):
    """Which contacts outside the cone are found again, and which have several candidates."""
    bent = drawn(contacts.whisker, n, rng, load)
    found = contacts.estimate(vb.base_signals(bent.force, bent.moment), names)
    outside = ~within_cone(contacts.whisker, bent.contact_point)
    hit = away(found, bent, contacts.whisker) <= 1e-6
    return hit[outside], found.n_candidates[outside] > 1


def triplets(contacts, share) -> str:
    """All 20; the one that is unique in many contacts."""
    results = []
    for names in TRIPLETS:
        n, seed = (100_000, 0) if names == BEST else (5000, 1)
        hit, several = found_again(contacts, names, int(n * share), np.random.default_rng(seed))
        results.append((hit.mean(), several.mean(), hit.size, names))
    results.sort(key=lambda one: -one[0])
    rows = [
        [name_of(names), f"{100 * hit:.3f} %", f"{n:,}", f"{100 * several:.1f} %"]
        for hit, several, n, names in results
    ]
    return table(["triplet", "found", "contacts", "with several candidates"], rows)


def beside_folds(charts, n) -> str:
    """Contacts under nearly as much load as slips off."""
    rows = []
    for whisker, names in FOLDED:
        hit, _ = found_again(charts[whisker], names, n, np.random.default_rng(3), (0.5, 0.999))
        rows.append([LABELS[whisker], name_of(names), f"{hit.size:,}", f"{(~hit).sum()}"])
    return table(["whisker", "triplet", "contacts", "not found"], rows, 2)


LABELS = {
    "gamma": "γ",
    "curved": "planar, curved",
    "straight": "straight",
    "curved_cylinder": "curved cylinder",
    "straight_cylinder": "straight cylinder",
}


def wrenches(n) -> str:
    """Friction coefficients up to 0.5 either way, forces by a finer integration."""
    rows = []
    for name in SAMPLES:
        whisker = getattr(vb.samples, name)()
        bent = drawn(whisker, n, np.random.default_rng(2), (0.1, 0.99), 0.5, FINE)
        found = vb.estimate_from_wrench(whisker, bent.force, bent.moment)
        worst = power(away(found, bent, whisker).max())
        unique = (found.status == vb.Status.UNIQUE).mean()
        rows.append([LABELS[name], f"{n:,}", worst, f"{100 * unique:.1f} %"])
    return table(["whisker", "loads", "largest distance, of L", "one candidate only"], rows)


def noise(contacts, n) -> str:
    """Whether errors are what covariances say, where these call themselves reliable."""
    whisker, rng = contacts.whisker, np.random.default_rng(4)
    bent = drawn(whisker, n, rng, (0.2, 0.95))
    spread = np.sqrt(np.diag(NOISE))
    wrench = np.concatenate([bent.force, bent.moment], axis=1)
    force, moment = np.split(wrench + spread * rng.normal(size=wrench.shape), 2, axis=1)
    signals = vb.base_signals(force, moment)
    rows = []
    for label, found in (
        (name_of(BEST), contacts.estimate(signals, BEST, NOISE)),
        ("F_x, F_T, M_B, M_D", contacts.estimate(signals, ("Fx", "FT", "MB", "MD"), NOISE)),
        ("all six", contacts.estimate(signals, SIGNALS, NOISE)),
        (
            "force and moment, with friction",
            vb.estimate_from_wrench(whisker, force, moment, noise=NOISE),
        ),
    ):
        rows.append([label, *judged(found, bent.contact_point)])
    head = ["from", "contacts", "reliable", "median error, mm", "within 68 %", "within 95 %"]
    return table(head, rows)


def judged(found, true):
    """How many covariances call themselves reliable, and how many errors lie within them."""
    kept = found.covariance_valid & (found.status == vb.Status.UNIQUE)
    error = (found.point - true)[kept]
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance[kept]), error)
    inside = [f"{100 * (squared < limit).mean():.1f} %" for limit in CHI2]
    median = few(1e3 * np.median(np.linalg.norm(error, axis=1)))
    return [f"{len(true):,}", percent(kept.mean()), median, *inside]
