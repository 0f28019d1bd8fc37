"""Effects that the model of one contact leaves out: the errors they cause, without and with remedy.

`python studies/remedies.py [--count N] [--whisker FILE] [--page]` prints two tables: median errors
of three signals, six, and force and moment whole, ignoring the effect and with its remedy; and
how often second contacts are detected. Contacts are deflected by more than 5°, with noise of 1 µN
and 0.02 µN·m in each component; rods under their weight are those of `studies/weight.py`, with
noise of a thousandth of the units of force and moment. `--page` writes them to
`docs/remedies.md`.
"""

import argparse
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import weight
from friction import DEFLECTED, NOISE, rubbed, scored
from pages import put, table
from scipy.interpolate import RegularGridInterpolator

import vibrissa as vb
from vibrissa.contacts import bent_by_forces
from vibrissa.simulation import Dynamics, facing_peg, measure, simulate, sweep_past

SETS = ("Fx MB MD", "Fx FT FD Mx MB MD", "wrench")
HEAD = (
    "effect",
    "remedy",
    *(f"{name}{part}" for name in ("F_x, M_B, M_D", "six", "wrench") for part in ("", ": remedy")),
)
DETECTION = (
    "distance of the contacts",
    "force and moment, no friction",
    "friction 0.3",
    "and shape, no friction",
    "and shape, friction 0.3",
)
APART = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3)
PRIOR, FALSE_ALARMS = 0.3, 0.01
# Tracked centrelines: points, and their standard deviation across the whisker, m.
POINTS, TRACKED = 25, 20e-6
SPRING = 30.0  # EI/L
SOFTER = 0.1


def noisy(force, moment, rng):
    """Signals of each set from force and moment with the sensor's noise."""
    noise = rng.normal(size=(len(force), 6)) * np.sqrt(np.diag(NOISE))
    force, moment = force + noise[:, :3], moment + noise[:, 3:]
    six = vb.base_signals(force, moment)
    return dict.fromkeys(SETS[:2], six) | {"wrench": {"force": force, "moment": moment}}


def single(contact_map, asked, *, coefficient=0.0, whisker=None, stiffer=1.0):
    """Signals and contact points of single contacts on the whisker that is true."""
    rng = np.random.default_rng(asked.seed)
    kept, bent = rubbed(contact_map, coefficient, asked.count, rng, whisker)
    return noisy(stiffer * bent.force[kept], stiffer * bent.moment[kept], rng), bent.contact_point[
        kept
    ]


def remedied(name, remedy, contact_map, signals, truth, how):
    """A row: errors without and with the remedy, for each set of signals."""
    cells = []
    for using in SETS:
        cells.append(scored(contact_map.estimate(signals[using], using, NOISE), truth))
        # The wrench allows for any friction.
        needed = how and not (using == "wrench" and "friction" in how)
        found = contact_map.estimate(signals[using], using, NOISE, **how) if needed else None
        cells.append(scored(found, truth) if needed else "–")
    return [name, remedy, *cells]


def two(contact_map, apart, asked):
    """Frictionless contacts so far apart (over L; 0: one), their wrenches and centrelines.

    Both forces press to the same side, up to 6° (one sigma), and share what is between a twentieth
    and four fifths of the force that the outer contact alone could hold.
    """
    whisker, rng, n = contact_map.whisker, np.random.default_rng(asked.seed), 2 * asked.count
    unit = whisker.base_bending_stiffness / whisker.length**2
    data = contact_map.to_dataset()
    log_fold = RegularGridInterpolator(
        (data.station.to_numpy(), data.bearing.to_numpy()), np.log(data.fold_force.to_numpy())
    )
    middle = rng.uniform(0.35 + apart / 2, 0.97 - apart / 2, n)
    arc = np.column_stack([middle - apart / 2, middle + apart / 2])[:, : 2 if apart else 1]
    bearing = rng.uniform(0.0, 2.0 * np.pi, n)
    force = np.exp(log_fold(np.column_stack([arc[:, -1], bearing])))
    force *= rng.uniform(0.05, 0.8, n) / unit
    share = rng.uniform(0.3, 0.7, n) if apart else np.ones(n)
    size = force[:, None] * np.column_stack([share, 1.0 - share])[:, : arc.shape[1]]
    angle = bearing[:, None] + 0.1 * rng.normal(size=arc.shape)
    bent = bent_by_forces(whisker, arc, np.stack([0 * size, *_across(size, angle)], axis=-1))
    rest = whisker.centerline(2001)[np.rint(2000 * arc[:, 0]).astype(int)] / whisker.length
    turned = np.linalg.norm(bent.contacts[:, 0] - rest, axis=1) / arc[:, 0]
    kept = np.flatnonzero((turned > DEFLECTED) & np.isfinite(bent.wrench).all(axis=1))
    kept = kept[: asked.count]
    wrench = bent.wrench[kept] * np.repeat([unit, unit * whisker.length], 3)
    line = bent.shape(np.tile(np.linspace(0.02, 1.0, POINTS), (n, 1)))[0][kept] * whisker.length
    line += TRACKED * rng.normal(size=line.shape)
    return noisy(wrench[:, :3], wrench[:, 3:], rng), bent.contacts[kept] * whisker.length, line


def _across(size, angle):
    return size * np.cos(angle), size * np.sin(angle)


def marked(contact_map, signals, line, friction):
    """Which measurements are detected as second contacts, by the wrench, and with the shape."""
    wrench = signals["wrench"].values()
    how = {"noise": NOISE, "friction": friction, "false_alarms": FALSE_ALARMS}
    shape = {"centerline": line, "centerline_sigma": TRACKED}
    tests = [vb.second_contact(contact_map.whisker, *wrench, **how, **more) for more in ({}, shape)]
    return [test.second_contact.values for test in tests]


def touching_twice(contact_map, apart, asked):
    """A row: errors of all, and of those that wrench and shape do not mark; the nearer counts."""
    signals, points, line = two(contact_map, apart, asked)
    found_out = marked(contact_map, signals, line, PRIOR)[1]
    cells = []
    for using in SETS:
        found = contact_map.estimate(signals[using], using, NOISE)
        far = np.linalg.norm(found.point[:, None] - points, axis=2)
        truth = points[np.arange(len(points)), np.nan_to_num(far, nan=9.0).argmin(axis=1)]
        cells.append(scored(found, truth))
        if found_out.all():
            cells.append("–")
            continue
        signals_left = {name: np.asarray(v)[~found_out] for name, v in signals[using].items()}
        left = contact_map.estimate(signals_left, using, NOISE)
        cells.append(scored(left, truth[~found_out]))
    remedy = f"marked by shape: {100 * found_out.mean():.0f} %; the others"
    return [f"two contacts {apart:g} L apart", remedy, *cells]


def quick(contact_map, asked):
    """A row: contacts of a whisker with mass, whisking past a peg; its mass is known to 15 %."""
    whisker, true = contact_map.whisker, 0.85
    usual = Dynamics()
    dynamics = Dynamics(
        density=tuple(true * value for value in usual.density), damping_ratio=0.12, step=2e-4
    )
    peg = facing_peg(whisker, 0.65, 1e-3)
    motion = sweep_past(whisker, peg, 0.4, 1000.0, seed=asked.seed, frequency=5.0)
    trial = simulate(whisker, motion, peg, dynamics=dynamics, nodes=9)
    data = measure(trial, seed=asked.seed)
    truth = trial["truth"].to_dataset().isel(whisker=0)
    points = truth.contact_point_whisker.to_numpy()
    arc = truth.arc_length.to_numpy()
    resting = np.rint(2000 * np.nan_to_num(arc) / whisker.length).astype(int)
    with np.errstate(invalid="ignore"):
        turned = np.linalg.norm(points - whisker.centerline(2001)[resting], axis=1) / arc
        kept = truth.in_contact.to_numpy().astype(bool) & (turned > DEFLECTED)
    corrected = [vb.pipeline.with_signals(data, "sensor", dynamics=one) for one in (None, usual)]
    cells = []
    for using in SETS:
        for signals in corrected:
            found = vb.pipeline.estimates_of(signals, using, contact_maps=[contact_map])
            one = found.isel(whisker=0)
            both = one.contact_point_whisker.to_numpy(), one.covariance.to_numpy()
            part = SimpleNamespace(point=both[0][kept], covariance=both[1][kept])
            cells.append(scored(part, points[kept]))
    return ["inertia", "inertia removed", *cells]


def heavy(asked):
    """Rows of rods under their weight, held level."""
    for name, title in weight.NAMES.items():
        contact_map = vb.ContactMap.simulate(weight.RODS[name], grid=False)
        bent, force, moment = weight.bent_at_random(weight.RODS[name], weight.LEVEL, asked.count)
        cells = []
        for using in weight.SETS:
            for gravity in (None, weight.LEVEL):
                found = weight.located(contact_map, using, force, moment, gravity=gravity)
                cells.append(scored(found, bent.contact_point))
        yield [f"weight, level: {title}", "gravity", *cells]


def rows(contact_map, asked):
    """Rows of the first table."""
    whisker = contact_map.whisker
    spring = SPRING * whisker.base_bending_stiffness / whisker.length
    soft = whisker.with_properties(base_stiffness=(spring, spring))
    rubbing = {"friction": PRIOR}
    cases = (
        ("none", "friction 0.3", {}, rubbing),
        ("friction 0.1", "friction 0.3", {"coefficient": 0.1}, rubbing),
        ("friction 0.3", "friction 0.3", {"coefficient": 0.3}, rubbing),
        ("modulus or relaxation + 10 %", "σ 10 %", {"stiffer": 1.1}, {"stiffness_sigma": SOFTER}),
        (
            "base spring of 30 EI/L",
            "σ L/30 EI",
            {"whisker": soft},
            {"compliance_sigma": 1.0 / spring},
        ),
    )
    for name, remedy, true, how in cases:
        signals, truth = single(contact_map, asked, **true)
        yield remedied(name, remedy, contact_map, signals, truth, how)
    for apart in (0.05, 0.15):
        yield touching_twice(contact_map, apart, asked)
    yield quick(contact_map, asked)
    yield from heavy(asked)


def detection(contact_map, asked):
    """Rows of the second table."""
    for apart in APART:
        signals, _, line = two(contact_map, apart, asked)
        free, rubbing = (marked(contact_map, signals, line, mu) for mu in (0.0, PRIOR))
        shares = [f"{100 * one.mean():.1f} %" for one in (free[0], rubbing[0], free[1], rubbing[1])]
        yield [f"{apart:g} L" if apart else "one contact (false alarms)", *shares]


def main():
    """Print the tables, or write them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--whisker", help="file of a whisker; by default the γ whisker")
    parser.add_argument("--count", type=int, default=200, help="contacts of each row")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--detection", action="store_true", help="only the second table")
    parser.add_argument("--page", action="store_true")
    asked = parser.parse_args()
    whisker = vb.load_whisker(asked.whisker) if asked.whisker else vb.samples.gamma()
    contact_map = vb.ContactMap.simulate(whisker, grid=False)
    blocks = {}
    if not asked.detection:
        blocks["remedies"] = table(HEAD, list(rows(contact_map, asked)), texts=2)
        print(blocks["remedies"], flush=True)
    blocks["second contacts"] = table(DETECTION, list(detection(contact_map, asked)))
    print(blocks["second contacts"])
    if asked.page:
        docs = Path(__file__).parents[1] / "docs"
        put([docs / "remedies.md", docs / "several-contacts.md"], blocks)


if __name__ == "__main__":
    main()
