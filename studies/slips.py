"""Onset, loss and slip of contacts as a stream reports them, compared with simulated sweeps.

`python studies/slips.py [--first 20] [--sweeps 6]`: a carbon rod of 200 mm on a base that turns and
recedes slips off one peg and meets another, without inertia. Streams of F_x, M_B and M_D at 500 Hz
with noise of 0.001 EI/L² and EI/L, and poses. A slip of the truth is a step of the contact point of
more than 4 mm; it counts as reported within two samples. The rules were set on sweeps 20 to 25.
"""

import argparse
import json

import numpy as np
from scipy.spatial.transform import Rotation

import vibrissa as vb
from vibrissa.objects import Peg
from vibrissa.simulation import simulate, tabulated
from vibrissa.streaming import COMPONENTS, ContactStream

ROD = vb.Whisker.straight(
    0.2, base_radius=0.5e-3, tip_radius=0.25e-3, youngs_modulus=120e9, density=1600.0
)
NOISE = 1e-3 * ROD.base_bending_stiffness / ROD.length**2 * np.repeat([1.0, ROD.length], 3)
RATE, STEP, NEAR = 500.0, 4e-3, 4.5e-3
NAMES = ("time", *COMPONENTS, *(f"base_{n}" for n in ("x", "y", "z", "qw", "qx", "qy", "qz")))


def swept(seed):
    """Lines of a sweep, and the times of onsets, losses and slips."""
    rng = np.random.default_rng(seed)
    time, way = np.linspace(0.0, 1.0, 101), np.zeros((101, 3))
    way[:, 0], way[:, 2] = -rng.uniform(0.05, 0.12) * time, 0.02 * np.sin(6.0 * time + seed)
    turn = (0.4 + 0.1 * rng.uniform()) * time
    far = Peg([0.15 + 0.02 * rng.uniform(), 0.008, 0.0], [0.0, 0.0, 1.0], 1.5e-3)
    near = [0.06 + 0.03 * rng.uniform(), 0.01 + 0.02 * rng.uniform(), 0.0]
    pegs = [far, Peg(near, [0.1, 0.0, 1.0], 2e-3)]
    trial = simulate(ROD, tabulated(time, turn, base_position=way, rate=RATE), pegs)
    data, truth = (part.to_dataset().isel(whisker=0) for part in (trial, trial["truth"]))
    touching = np.diff(truth.in_contact.values.astype(int))
    moved = np.linalg.norm(np.diff(truth.contact_point.values, axis=0), axis=1)
    wrench = np.concatenate([data.force.values, data.moment.values], axis=1)
    wrench = wrench + rng.normal(size=wrench.shape) * NOISE
    turned = Rotation.from_matrix(data.base_rotation.values).as_quat()[:, [3, 0, 1, 2]]
    rows = np.column_stack([data.time.values, wrench, data.base_position.values, turned])
    lines = [json.dumps(dict(zip(NAMES, row, strict=True))) for row in rows.tolist()]
    what = {"onset": touching == 1, "loss": touching == -1, "slip": moved > STEP}
    return lines, {name: data.time.values[1:][there] for name, there in what.items()}


def dated_in(records):
    """Onsets as they are dated at last, of each contact."""
    found = []
    for before, one in zip([{}, *records], [*records, {}], strict=True):
        if "onset_time" in before and ("onset_time" not in one or one.get("event") == "onset"):
            found.append(before["onset_time"])
    return found


def main():
    """Print what is reported, with and without the filter."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--first", type=int, default=20)
    parser.add_argument("--sweeps", type=int, default=6)
    asked = parser.parse_args()
    contact_map = vb.ContactMap.simulate(ROD, grid=False)
    sweeps = [swept(seed) for seed in range(asked.first, asked.first + asked.sweeps)]
    for filtered in (False, True):
        true = reported = wrong = 0
        late, dated = {"onset": [], "loss": []}, []
        for lines, truth in sweeps:
            locate = vb.Estimator(contact_map, "Fx MB MD", np.diag(NOISE**2), felt_above=5.0)
            stream = ContactStream(locate, follow=vb.ContactFilter(locate) if filtered else None)
            records = list(stream.records(lines))
            events = [one for one in records if "event" in one]
            found = {n: [e["time"] for e in events if e["event"] == n] for n in (*late, "slip")}
            apart = np.abs(np.subtract.outer(truth["slip"], found["slip"]))
            true += len(apart)
            reported += int((apart.min(axis=1, initial=np.inf) < NEAR).sum())
            wrong += int((apart.min(axis=0, initial=np.inf) > NEAR).sum())
            for name, delays in late.items():
                for time in found[name]:
                    nearest = np.abs(truth[name] - time).argmin()
                    delays.append(1e3 * (time - truth[name][nearest]))
            for begun in dated_in(records):
                # A contact begins between this sample and the one before.
                away = begun - (truth["onset"] - 0.5 / RATE)
                dated.append(1e3 * np.abs(away).min(initial=np.inf))
        delays = ", ".join(f"{n} {min(v):.0f} to {max(v):.0f} ms late" for n, v in late.items())
        print(
            f"{'filter' if filtered else 'single samples'}: {reported} of {true} slips reported, "
            f"{wrong} others; {delays}; {len(dated)} onsets dated, "
            f"error {np.median(dated):.1f} ms in the median, {max(dated):.1f} ms at most"
        )


if __name__ == "__main__":
    main()
