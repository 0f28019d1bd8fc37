"""Proofs for digitised whiskers: (F_x, M_B, M_D) is unique outside a cone.

`python studies/proofs.py WHISKER.csv … [--share 1.2] [--minutes 10] [--folder output/proofs]`. The
rest shape of a digitised whisker is a spline of some fifty pieces, at each of which a step of the
validated integration ends. Here its curvature is one polynomial of degree 5 in arc length, and the
theorem is about that whisker; how far it is from the spline is printed. `--share` is the cone over
the smallest that a grid in floats allows. A certificate that is in the folder already is continued.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from numpy.polynomial import Chebyshev
from pages import table

import vibrissa as vb

DEGREE = 5


def smooth(whisker: vb.Whisker) -> tuple[vb.Whisker, float]:
    """The whisker with polynomial curvature, and its largest distance from the stored one, m."""
    s = np.linspace(0.0, whisker.length, 400)
    fits = [Chebyshev.fit(s, one, DEGREE) for one in whisker.curvature(s).T]
    found = vb.Whisker.from_curvature(
        whisker.length,
        lambda at: np.stack([fit(at) for fit in fits], axis=-1),
        base_radius=whisker.base_radius,
        tip_radius=whisker.tip_radius,
        youngs_modulus=whisker.youngs_modulus,
        poisson_ratio=whisker.poisson_ratio,
        name=whisker.name,
    )
    away = np.linalg.norm(found.position(s) - whisker.position(s), axis=1)
    return found, float(away.max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("whiskers", nargs="+", type=Path, help="digitised centrelines")
    parser.add_argument("--share", type=float, default=1.2, help="cone over the smallest")
    parser.add_argument("--minutes", type=float, default=10.0, help="longest time for each")
    parser.add_argument("--folder", type=Path, default=Path("output/proofs"))
    chosen = parser.parse_args()
    chosen.folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for path in chosen.whiskers:
        began = time.process_time()
        whisker, away = smooth(vb.load_whisker(path))
        contact_map = vb.ContactMap.simulate(whisker, grid=False)
        least = vb.certificates.smallest_cone(contact_map)
        row = [path.stem, f"{1e6 * away:.1f}", f"{np.rad2deg(least):.2f}°"]
        if not np.isfinite(least):
            rows.append([*row, "–", "–", "–", "no cone on the grid"])
            continue
        certificate = vb.certificates.certify(
            contact_map,
            chosen.share * least,
            path=chosen.folder / f"{path.stem}.nc",
            seconds=60.0 * chosen.minutes,
            progress=lambda done, total: print(f"\r{done / total:.3f}", end="", flush=True),
        )
        boxes = sum(part.evaluated for part in certificate.parts.values())
        cone, spent = np.rad2deg(certificate.cone), time.process_time() - began
        rows.append([*row, f"{cone:.2f}°", f"{boxes:,}", f"{spent:.0f}", certificate.summary()])
        print(f"\r{' | '.join(rows[-1])}", flush=True)
    head = ["whisker", "moved by, µm", "smallest cone", "cone", "boxes", "CPU, s", "result"]
    print(table(head, rows))


if __name__ == "__main__":
    main()
