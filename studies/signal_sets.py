"""How well three, four and six noisy signals locate the contacts of the γ whisker.

`python studies/signal_sets.py [MICRONEWTON [MICRONEWTON_METRE]]`, 1 and 0.02 by default, prints a
row for each set of signals; about a minute. 2048 contacts outside the 2° cone stand for equal
volumes of space; to each one's force and moment the sensor's noise is added once. `--figure` draws
the errors for this noise and for ten times as much into `docs/images/signal_sets.png`.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from pages import save

import vibrissa as vb
from vibrissa.identifiability.twins import sample, spread
from vibrissa.plots.style import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    conclude,
    head,
    looking,
    new_figure,
)

SETS = (
    ("Fx", "MB", "MD"),
    ("Fx", "FT", "MD"),
    ("FT", "MB", "MD"),
    ("Mx", "MB", "MD"),
    ("Fx", "FT", "MB", "MD"),
    ("Fx", "Mx", "MB", "MD"),
    ("Fx", "FT", "FD", "Mx", "MB", "MD"),
)
WRENCH = "wrench"
SHOWN = {
    "Fx MB MD": ("$F_x$, $M_B$, $M_D$", BLUE),
    "Fx FT MD": ("$F_x$, $F_T$, $M_D$", ORANGE),
    "Mx MB MD": ("$M_x$, $M_B$, $M_D$", MUTED),
    "Fx FT FD Mx MB MD": ("all six signals", INK),
    WRENCH: ("force and moment, friction allowed", GREEN),
}
NUMBER = 2048
IMAGE = Path(__file__).parents[1] / "docs" / "images" / "signal_sets.png"


def drawn(contacts):
    """Contact points and forces that stand for equal volumes."""
    rng, scale = np.random.default_rng(0), contacts.chart.discretization
    spread_out = sample(contacts, spread(8 * NUMBER, 0), "reachable")
    drawn = spread_out.contacts
    volume = spread_out.volume * (drawn.inside & (drawn.angle > np.deg2rad(2)))
    values = drawn.values[rng.choice(len(volume), NUMBER, p=volume / volume.sum())]
    return values[:, 3:] * scale.length, values[:, :3] * scale.force, rng


def located(force_noise, moment_noise):
    """Contact points and, by set of signals, what is found."""
    whisker = vb.samples.gamma()
    contact_map = vb.ContactMap.simulate(whisker, grid=False)
    point, force, rng = drawn(contact_map)
    moment = np.cross(point, force)
    measured_force = force + force_noise * rng.standard_normal(force.shape)
    measured_moment = moment + moment_noise * rng.standard_normal(moment.shape)
    noise = np.diag([force_noise] * 3 + [moment_noise] * 3) ** 2
    signals = vb.base_signals(measured_force, measured_moment)
    found = {" ".join(names): contact_map.estimate(signals, names, noise=noise) for names in SETS}
    found[WRENCH] = vb.estimate_from_wrench(whisker, measured_force, measured_moment, noise=noise)
    return point, found


def errors(point, found):
    """3D errors in mm of the candidate named first and of the nearest one; infinite without any."""
    first = 1e3 * np.linalg.norm(found.point - point, axis=1)
    nearest = 1e3 * np.linalg.norm(found.candidates.point - point[:, None], axis=2)
    return np.where(np.isfinite(first), first, np.inf), np.where(
        np.isfinite(nearest), nearest, np.inf
    ).min(axis=1)


def report(name, point, found):
    """Print a row of the table."""
    first, best = errors(point, found)
    none, several = found.n_candidates == 0, found.n_candidates > 1
    shown = [*np.quantile(first[~none], [0.5, 0.9]), np.quantile(best[~none], 0.9)]
    shares = [100 * several.mean(), 100 * none.mean()]
    print(
        f"{name:18}" + "".join(f"{x:10.3f}" for x in shown) + "".join(f"{x:9.1f}" for x in shares)
    )


def picture(results) -> Figure:
    """Share of contacts that are found to within an error, for each noise."""
    share = np.arange(1, NUMBER + 1) / NUMBER
    with looking():
        figure = new_figure("double", 62.0, "constrained")
        panels = figure.subplots(1, 2, sharey=True)
        for axes, letter, (title, (point, found)) in zip(
            panels, "ab", results.items(), strict=True
        ):
            for name, (label, colour) in SHOWN.items():
                first = np.sort(errors(point, found[name])[0])
                # Green and grey look alike to some readers.
                line = "--" if name == WRENCH else "-"
                axes.step(first, 100.0 * share, line, where="post", color=colour, label=label)
            axes.set(xscale="log", xlim=(1e-3, 30.0), ylim=(0.0, 100.0), xlabel="3D error (mm)")
            axes.set_xticks([0.001, 0.01, 0.1, 1, 10], ["0.001", "0.01", "0.1", "1", "10"])
            head(axes, letter, title)
        panels[0].set_ylabel("contacts with a smaller error (%)")
        panels[1].legend(loc="upper left")
        point, found = next(iter(results.values()))
        medians = [(np.median(errors(point, found[name])[0]), SHOWN[name][0]) for name in SHOWN]
        least, middle, most = min(medians), medians[0], max(medians)
        conclude(
            figure,
            f"Median errors in a: {least[1]} {least[0]:.2f} mm; {middle[1]} {middle[0]:.2f} mm; "
            f"{most[1]} {most[0]:.2f} mm",
        )
        return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("force_noise", nargs="?", type=float, default=1.0, help="µN")
    parser.add_argument("moment_noise", nargs="?", type=float, default=0.02, help="µN·m")
    parser.add_argument("--figure", action="store_true", help=f"draw {IMAGE.name}")
    chosen = parser.parse_args()
    results = {}
    for times in (1.0, 10.0) if chosen.figure else (1.0,):
        force, moment = times * chosen.force_noise, times * chosen.moment_noise
        title = f"noise of {force:g} µN and {moment:g} µN·m"
        results[title] = located(1e-6 * force, 1e-6 * moment)
        print(f"{title}; mm and %")
        print(f"{'':18}{'median':>10}{'90 %':>10}{'nearest':>10}{'several':>9}{'none':>9}")
        for name, found in results[title][1].items():
            report(name, results[title][0], found)
    if chosen.figure:
        save(picture(results), IMAGE)


if __name__ == "__main__":
    main()
