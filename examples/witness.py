"""A witness: two contacts that three signals cannot distinguish.

Aim: to see what "not unique" means. Data: a whisker that is curved as strongly as a rat's C2,
y = A x² with A·L = 0.82. Lesson: for this whisker even (F_x, M_B, M_D), which is unique for less
curved whiskers, has pairs of contacts with the same signals, a third of the whisker apart.
"""

# %% A strongly curved whisker, and the search for such pairs
import sys
from pathlib import Path

import numpy as np
import xarray as xr

import vibrissa as vb
from vibrissa import plots

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "output")
folder.mkdir(parents=True, exist_ok=True)

triplet = "Fx MB MD"
whisker = vb.Whisker.parabola(length=40e-3, coefficient=20.5)
contact_map = vb.ContactMap.simulate(whisker, grid=False)
verdicts = vb.uniqueness(contact_map, [triplet], ["all"], samples=1024, resolution=False)
found = verdicts.sel(triplet=triplet, region="all")
print(
    f"({triplet}) is {found.verdict.item()};",
    f"twins are found up to {np.degrees(found.critical_cone.item()):.1f}° from rest",
)

# %% The pair that is farthest apart, verified by bending the whisker again
pair = found.isel(witness=int(np.nanargmax(found.witness_separation)))
forces = np.column_stack([np.zeros(2), pair.witness_contact_force.transpose("pair", "component")])
bent = vb.deflect(whisker, vb.PointForce(pair.witness_arc_length.values, components=forces))
signals = vb.base_signals(bent.force, bent.moment)
for name in signals:
    one, other = signals[name].values
    print(f"{name}: {one:.10g} and {other:.10g} {signals[name].attrs['units']}")

# %% An estimator gives both, with its status
estimate = contact_map.estimate(signals.isel(sample=0), tuple(triplet.split()))
print(vb.Status(int(estimate.status)).explanation)
print("candidates, mm:", (1e3 * estimate.candidates.point).round(2).tolist())

# %% Both of them, and all six signals
witness = xr.Dataset(
    {
        "rest": (("node", "space"), whisker.centerline(101)),
        "centerline": (("pair", "node", "space"), bent.centerline(101)),
        "contact_point": (("pair", "space"), bent.contact_point),
        "force": (("pair", "space"), bent.force),
        "arc_length": ("pair", bent.arc_length),
        **{name: ("pair", signals[name].values) for name in signals},
    },
    attrs={"triplet": triplet},
)
plots.save(plots.witness_pair(witness), folder / "witness", ["png"])
