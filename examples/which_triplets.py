"""Which three signals locate a contact, for this whisker?

Aim: to choose what to measure. Data: the built-in γ whisker and three of the 20 triplets. Lesson:
most triplets leave pairs of contacts with the same signals; for this whisker (F_x, M_B, M_D) leaves
none.
"""

# %% Verdicts on three triplets; "all" 20 take about a minute
import sys
from pathlib import Path

import vibrissa as vb
from vibrissa import plots
from vibrissa.identifiability import verdict_table

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "output")
folder.mkdir(parents=True, exist_ok=True)

contact_map = vb.ContactMap.simulate(vb.samples.gamma(), grid=False)
triplets = ["Fx MB MD", "Fx FD MD", "Mx MB MD"]
verdicts = vb.uniqueness(contact_map, triplets, ["all", "CF", "CB"], samples=512, resolution=False)
print(verdict_table(verdicts))

# %% Evidence: pairs with the same signals are proofs, found to rounding
for triplet in triplets:
    one = verdicts.sel(triplet=triplet, region="all")
    if one.verdict == "unique":
        print(f"{triplet}: no two contacts have the same signals")
    else:
        print(
            f"{triplet}: contacts {1e3 * one.witness_separation.max():.1f} mm apart share it",
            f"to {one.witness_difference.max():.0e}",
        )

# %% The table as a figure
plots.save(plots.verdict_table(verdicts), folder / "which_triplets", ["png"])
