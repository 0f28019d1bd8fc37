"""The space that a whisker can reach, and its signals there.

Aim: to see all contacts of a whisker at once. Data: the built-in γ whisker. Lesson: the points that
a whisker can touch form a solid around its resting shape, bounded by slip-off. The largest
displacement and force depend on the side and on where along the whisker it is touched.
"""

# %% All contacts between 0.3 L and the tip that the whisker can hold
import sys
from pathlib import Path

import numpy as np

import vibrissa as vb
from vibrissa import plots

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "output")
folder.mkdir(parents=True, exist_ok=True)

whisker = vb.samples.gamma()
contact_map = vb.ContactMap.simulate(whisker, grid=False)
samples = contact_map.to_dataset()
print(contact_map)

# %% How far it can be pushed aside, and how hard, before it slips off
length = whisker.length
aside = np.linspace(0.0, 0.8, 161) * length
for share in (0.4, 0.6, 0.8):
    at = whisker.centerline(1001)[int(1000 * share)]
    for name, way in (("backward", 1.0), ("forward", -1.0)):
        bent = vb.deflect(whisker, vb.PointContact(at + way * aside[:, None] * [0.0, 1.0, 0.0]))
        held = np.flatnonzero(bent.status == vb.Status.OK)
        force = np.linalg.norm(bent.force[held], axis=1).max()
        most, why = aside[held[-1]], vb.Status(int(bent.status[min(held[-1] + 1, 160)]))
        print(
            f"at {share:.1f} L, {name:8s}: {1e3 * most:4.1f} mm and {1e6 * force:5.0f} µN;",
            f"then: {why.name}",
        )

# %% The solid of contacts, a quarter cut out, and the six signals over it
figure = plots.signal_clouds(samples, whisker.centerline(101))
plots.save(figure, folder / "reachable_space", ["png"])
