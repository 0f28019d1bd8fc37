"""The paper, claim by claim: what can be tested of Huet, Emnett & Hartmann (2022) and its S1 Text.

`python studies/paper.py [FOLDER]` tests the claims for the built-in γ whisker and writes tables to
the folder (`output/paper` by default); `--page` writes them into `docs/paper.md`, `--quick` takes
fewer contacts; with `--whiskers FILES` it asks instead what a fourth signal does for these. The γ
whisker of the paper is not public: this one has its length, curvature and taper, and leaves its
plane by 1.5 mm at the tip.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from pages import few, percent, put, table

import vibrissa as vb
from vibrissa.identifiability import save_uniqueness
from vibrissa.signals import nearest_on_rest

ROOT = Path(__file__).parent.parent

TABLE_A = {
    "Fx MB MD": ("all",),
    "Mx MB MD": ("all",),
    "Fx FD MD": ("all",),
    "Fx FT MD": ("ELD",),
    "FT MB MD": ("ELD",),
    "FT FD MD": ("ELD", "CB"),
    "FD Mx MD": ("CB",),
    "Fx Mx MB": ("CB",),
    "Fx Mx MD": ("CF", "CB"),
    "FD MB MD": ("ELD CF", "CB"),
    "Fx FT Mx": ("ELD CF", "ELD CB"),
    "FT Mx MB": ("ELD CF", "ELD CB"),
    "FT Mx MD": ("ELD CF", "ELD CB"),
    "FD Mx MB": ("ELD CF",),
    "FT FD Mx": ("ELD CF",),
    "Fx FD MB": ("ELD CB",),
    "FT FD MB": ("ELD CB",),
    "Fx FT FD": ("ELD CB",),
    "Fx FT MB": (),
    "Fx FD Mx": (),
}
"""Regions in which S1 Text, Table A, calls each triplet unique."""

LARGEST = np.array([1.5e-3, np.radians(1.0), np.radians(1.0)])
"""Median errors of r, θ and φ up to which S1 Text calls a triplet unique, m and rad."""

PROFILES = {
    "straight, tapered": vb.samples.straight,
    "curved, tapered": vb.samples.curved,
    "straight cylinder": vb.samples.straight_cylinder,
    "curved cylinder": vb.samples.curved_cylinder,
}
"""The four profiles of Huet, Rudnicki & Hartmann (2017)."""

LARGEST_2017 = np.array([1e-3, np.radians(1.5), np.radians(1.5)])
"""Median errors of r, θ and φ up to which that study calls a triplet unique, m and rad."""

COORDINATES = ("r", "theta", "phi")
SPLIT = (0.35, 0.075)
"""Shares of the contacts that train the network and that stop its training; half judge it."""


def table_a(verdicts: xr.Dataset) -> str:
    """Table A of S1 Text against witnesses."""
    rows = []
    for triplet, regions in TABLE_A.items():
        cell = verdicts.sel(triplet=triplet)
        found = {r: str(cell.verdict.sel(region=r).item()) for r in verdicts.region.values}
        against = [r for r in regions if found[r] == "not unique"]
        found_at = np.rad2deg([float(cell.critical_cone.sel(region=r)) for r in against])
        cones = np.floor(10.0 * found_at) / 10.0  # lower bounds
        twins = ", ".join(f"{r}: {c:.1f}°" for r, c in zip(against, cones, strict=True))
        own = str(cell.notation.item())
        if against:
            verdict = "refuted (witness)"
        elif not regions:
            verdict = "confirmed (witness)" if found["all"] == "not unique" else "refuted"
        else:
            verdict = "confirmed (no counterexample found)"
        rows.append([triplet, " / ".join(regions) or "–", own, twins or "–", verdict])
    head = [
        "triplet",
        "the paper: unique in",
        "vibrissa: unique in",
        "twins in the paper's regions",
    ]
    return table([*head, "verdict"], rows, texts=5)


class Network(NamedTuple):
    """Weights of the supplement's 3-10-10-3 network."""

    w1: np.ndarray
    b1: np.ndarray
    w2: np.ndarray
    b2: np.ndarray
    w3: np.ndarray
    b3: np.ndarray

    def moved(self, step: np.ndarray) -> "Network":
        """The network with all weights changed by a step."""
        parts = np.split(step, np.cumsum([w.size for w in self])[:-1])
        pairs = zip(self, parts, strict=True)
        return Network(*(w + part.reshape(w.shape) for w, part in pairs))

    def layers(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Both hidden layers and the output."""
        first = np.tanh(x @ self.w1 + self.b1)
        second = np.tanh(first @ self.w2 + self.b2)
        return first, second, second @ self.w3 + self.b3

    def normal_equations(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """JᵀJ and Jᵀe of the residuals y − f(x)."""
        first, second, out = self.layers(x)
        size = sum(w.size for w in self)
        matrix, right = np.zeros((size, size)), np.zeros(size)
        for k in range(3):
            outer = self.w3[:, k] * (1.0 - second**2)
            inner = (outer @ self.w2.T) * (1.0 - first**2)
            chosen = np.zeros((len(x), 3))
            chosen[:, k] = 1.0
            blocks = [
                x[:, :, None] * inner[:, None],
                inner,
                first[:, :, None] * outer[:, None],
                outer,
                second[:, :, None] * chosen[:, None],
                chosen,
            ]
            jacobian = np.hstack([block.reshape(len(x), -1) for block in blocks])
            matrix += jacobian.T @ jacobian
            right += jacobian.T @ (y[:, k] - out[:, k])
        return matrix, right


def trained(x: np.ndarray, y: np.ndarray, stop: tuple[np.ndarray, np.ndarray]) -> Network:
    """Train by Levenberg and Marquardt's method until six steps bring no gain on held-out data."""
    rng = np.random.default_rng(0)
    sizes = ((3, 10), (10,), (10, 10), (10,), (10, 3), (3,))
    net = best = Network(*(rng.normal(0.0, 0.5, size) for size in sizes))
    damping, failures, least = 1e-3, 0, np.inf
    loss = float(((y - net.layers(x)[2]) ** 2).sum())
    for _ in range(300):
        matrix, right = net.normal_equations(x, y)
        while damping < 1e10:
            step = np.linalg.solve(matrix + damping * np.eye(len(matrix)), right)
            moved = net.moved(step)
            after = float(((y - moved.layers(x)[2]) ** 2).sum())
            if after < loss:
                break
            damping *= 10.0
        else:
            break
        net, loss, damping = moved, after, max(0.1 * damping, 1e-20)
        held = float(((stop[1] - net.layers(stop[0])[2]) ** 2).mean())
        failures = 0 if held < least else failures + 1
        if held < least:
            least, best = held, net
        if failures == 6:
            break
    return best


def grid_contacts(contact_map: vb.ContactMap) -> dict[str, np.ndarray]:
    """Reachable contacts of the paper's grid outside 2°: signals, coordinates, point and weight."""
    assert contact_map.grid is not None
    grid = contact_map.grid
    r, theta, phi = np.meshgrid(*(grid[n].values for n in COORDINATES), indexing="ij")
    level = r * np.cos(phi)
    point = np.stack([level * np.cos(theta), level * np.sin(theta), r * np.sin(phi)], axis=-1)
    out = {n: grid[n].transpose(*COORDINATES).values for n in vb.signals.SIGNALS}
    out |= {"r": r, "theta": theta, "phi": phi, "weight": r**2 * np.cos(phi)}
    kept = grid["status"].transpose(*COORDINATES).values == int(vb.Status.OK)
    out = {name: values[kept] for name, values in out.items()} | {"point": point[kept]}
    away, along = nearest_on_rest(contact_map.whisker, out["point"])
    out |= {"angle": np.degrees(np.arctan2(away, along)), "along": along}
    outside = out["angle"] > 2.0
    return {name: values[outside] for name, values in out.items()}


def weighted_quantile(values: np.ndarray, weight: np.ndarray, share: float) -> float:
    """The value below which a share of the weight is."""
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(total, share * total[-1])]])


def network_errors(contacts: dict[str, np.ndarray], rows: np.ndarray, triplet: str) -> np.ndarray:
    """Weighted median errors of r, θ and φ on the half of the contacts that judges the network."""
    signals = np.stack([contacts[name][rows] for name in triplet.split()], axis=1)
    goal = np.stack([contacts[name][rows] for name in COORDINATES], axis=1)
    count = len(rows)
    train, hold = (int(share * count) for share in SPLIT)

    def normalised(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        low, high = values[:train].min(axis=0), values[:train].max(axis=0)
        half = np.where(high > low, 0.5 * (high - low), 1.0)
        return (values - 0.5 * (low + high)) / half, 0.5 * (low + high), half

    (x, *_), (y, middle, half) = normalised(signals), normalised(goal)
    judged = slice(count // 2, None)
    net = trained(x[:train], y[:train], (x[train : train + hold], y[train : train + hold]))
    away = net.layers(x[judged])[2] * half + middle - goal[judged]
    away[:, 1:] = np.angle(np.exp(1j * away[:, 1:]))
    weight = contacts["weight"][rows][judged]
    return np.array([weighted_quantile(error, weight, 0.5) for error in np.abs(away).T])


def network_test(contacts: dict[str, np.ndarray], samples: int) -> str:
    """The supplement's own test of uniqueness on all triplets, over all contacts outside 2°."""
    chosen = np.random.default_rng(0).permutation(len(contacts["r"]))[:samples]
    rows = []
    for triplet, regions in TABLE_A.items():
        errors = network_errors(contacts, chosen, triplet)
        passed = bool((errors <= LARGEST).all())
        shown = [few(1e3 * errors[0]), few(np.degrees(errors[1])), few(np.degrees(errors[2]))]
        claim = "yes" if regions == ("all",) else "no"
        rows.append([triplet, *shown, "passes" if passed else "fails", claim])
    rows.sort(key=lambda row: max(float(row[1]) / 1.5, float(row[2]), float(row[3])))
    head = ["triplet", "r, mm", "θ, °", "φ, °", "thresholds", "unique in the paper"]
    return table(head, rows)


def profiles(samples: int) -> str:
    """The network and thresholds of 2017 for (F_x, M_B, M_D), and exact verdicts, by profile."""
    rows = []
    for name, sample in PROFILES.items():
        contact_map = vb.ContactMap.simulate(sample())
        contacts = grid_contacts(contact_map)
        chosen = np.random.default_rng(0).permutation(len(contacts["r"]))[:samples]
        errors = network_errors(contacts, chosen, "Fx MB MD")
        passed = bool((errors <= LARGEST_2017).all())
        found = vb.uniqueness(
            contact_map, ["Fx MB MD"], ["all", "ELD"], samples=1024, resolution=False
        )
        pairs = zip(found.verdict.values[0], found.evidence.values[0], strict=True)
        exact = [f"{verdict} ({evidence})" for verdict, evidence in pairs]
        shown = [few(1e3 * errors[0]), few(np.degrees(errors[1])), few(np.degrees(errors[2]))]
        rows.append([name, *shown, "passes" if passed else "fails", *exact])
    head = ["profile", "r, mm", "θ, °", "φ, °", "1 mm, 1.5°", "exact: all", "exact: ELD"]
    return table(head, rows)


def laws(whisker: vb.Whisker, contacts: dict[str, np.ndarray]) -> str:
    """Statements of the paper about the signals themselves, over all contacts outside 2°."""
    weight = contacts["weight"]
    rest = whisker.position(contacts["along"])
    forward = contacts["point"][:, 1] < rest[:, 1]
    pulled = contacts["Fx"] > 0.0
    apart = np.abs(np.degrees(np.angle(np.exp(1j * (contacts["MD"] - contacts["FD"])))))

    def share(kept: np.ndarray, of: np.ndarray) -> str:
        return percent(float(weight[kept & of].sum() / weight[of].sum()))

    def among(name: str, at: float) -> float:
        return weighted_quantile(contacts[name][pulled], weight[pulled], at)

    everywhere = np.ones(len(weight), dtype=bool)
    far = weighted_quantile(np.abs(apart - 90.0), weight, 0.95)
    near, middle = (among("r", at) / whisker.length for at in (0.05, 0.5))
    rows = [
        ["contacts with F_x > 0", share(pulled, everywhere)],
        ["of these concave forward", share(forward, pulled)],
        ["their r / L: 5 % below, median", f"{near:.2f}, {middle:.2f}"],
        [
            "their deflection angle: median, 95 % below",
            f"{among('angle', 0.5):.1f}°, {among('angle', 0.95):.1f}°",
        ],
        ["angle between M_D and F_D, median", f"{weighted_quantile(apart, weight, 0.5):.1f}°"],
        ["its difference from a right angle: 95 % below", f"{far:.1f}°"],
    ]
    head = ["over the reachable contacts of the paper's grid outside 2°, by volume", "found"]
    return table(head, rows)


def fourth_signal(paths: list[Path]) -> str:
    """By how much F_T differs between contacts with the same (F_x, M_B, M_D), for whiskers."""
    rows = []
    for path in paths:
        contact_map = vb.ContactMap.simulate(vb.load_whisker(path), grid=False)
        asked = {"regions": ["all"], "samples": 512, "resolution": False}
        found = vb.uniqueness(contact_map, ["Fx MB MD"], **asked).isel(triplet=0)
        cone, differ = float(np.rad2deg(found.critical_cone.item())), []
        for i in np.flatnonzero(np.isfinite(found.witness_separation.values.ravel())):
            one = found.expand_dims("triplet").isel(witness=[i])
            ((_, pair),) = vb.identifiability.witness_pairs(contact_map.whisker, one, ["Fx MB MD"])
            differ.append(float(np.ptp(pair["FT"].values) / pair["FT"].values.mean()))
        bound = f"{np.floor(10.0 * cone) / 10.0:.1f}°"
        rows.append([path.stem, bound, f"{min(differ):.3f}" if differ else "–"])
        print(*rows[-1], flush=True)
    return table(["whisker", "critical cone ≥", "F_T differs by, least"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "output" / "paper")
    parser.add_argument("--page", action="store_true", help="write docs/paper.md")
    parser.add_argument("--quick", action="store_true", help="fewer contacts, to try it out")
    parser.add_argument("--whiskers", nargs="+", type=Path, help="ask about a fourth signal")
    chosen = parser.parse_args()
    if chosen.whiskers:
        print(fourth_signal(chosen.whiskers))
        return
    chosen.folder.mkdir(parents=True, exist_ok=True)
    contact_map = vb.ContactMap.simulate(vb.samples.gamma())
    contacts = grid_contacts(contact_map)
    blocks = {"laws": laws(contact_map.whisker, contacts)}
    count = 2_000 if chosen.quick else 8_000
    blocks["network test"] = network_test(contacts, count)
    blocks["profiles"] = profiles(count)
    verdicts = vb.uniqueness(
        contact_map, list(TABLE_A), samples=512 if chosen.quick else 4096, resolution=False
    )
    save_uniqueness(verdicts, chosen.folder / "uniqueness.nc")
    blocks["table a"] = table_a(verdicts)
    for name, block in blocks.items():
        print(f"\n{name}\n{block}", flush=True)
    if chosen.page:
        put(ROOT / "docs" / "paper.md", blocks)
    else:
        text = "\n\n".join(f"## {name}\n\n{block}" for name, block in blocks.items())
        (chosen.folder / "paper.md").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
