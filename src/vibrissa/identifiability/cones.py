"""Critical cones of whiskers over curvature and taper, and proved bounds of a critical cone."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.certificates import TRIPLET, Certificate, prove_witness
from vibrissa.contacts import ContactMap
from vibrissa.identifiability.verdicts import SAMPLES, SEPARATION, uniqueness
from vibrissa.numerics import numbers
from vibrissa.signals import cone_angle
from vibrissa.whisker import Whisker

#: Triplets that the paper finds to be unique for its γ whisker.
PAPER = ("Fx MB MD", "Mx MB MD", "Fx FD MD")
#: Default A·L of the whiskers y = A x², and ratios of base radius to tip radius.
CURVATURES = np.arange(16) / 10.0
TAPER_RATIOS = (1.0, 2.0, 4.0, 8.0, 15.0, 30.0, 60.0)

# Verdicts do not depend on size or stiffness, so one length and one base radius suffice.
_LENGTH, _BASE_RADIUS = 40e-3, 100e-6
_ROUNDS = 2  # number of searches, since one search for a verdict stops at the first witness
# Number of searches for a witness to be proved, and the share of the previous cone outside which
# the next one searches.
_SEARCHES, _NEARLY = 2, 0.95


def critical_cones(
    curvatures: ArrayLike = CURVATURES,
    taper_ratios: ArrayLike = TAPER_RATIOS,
    triplets: Sequence[str] = PAPER,
    *,
    samples: int = 1024,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Compute critical cones of planar whiskers y = A x² over curvature and taper.

    The critical cone is the smallest cone about the resting whisker outside which no two contacts
    have the same triplet; see :func:`vibrissa.uniqueness`. Contacts whose signals coincide only
    because the whisker is planar do not count.

    Parameters
    ----------
    curvatures : (n,) array_like
        Curvatures A·L of the whiskers, A the coefficient of the parabola and L the length.
    taper_ratios : (m,) array_like
        Ratios of base radius to tip radius.
    triplets : sequence of str
        Triplets, such as ``"Fx MB MD"``.
    samples : int
        Number of contacts of each whisker that are sampled.
    progress : callable, optional
        Function called as ``progress(done, total)`` after each whisker.

    Returns
    -------
    Dataset
        ``critical_cone`` (rad) over ``triplet``, ``taper_ratio`` and ``curvature``; 0 where no
        witness was found.
    """
    curved = np.atleast_1d(numbers("curvatures", curvatures))
    ratios = np.atleast_1d(numbers("taper_ratios", taper_ratios))
    if not (np.isfinite(curved).all() and (curved >= 0.0).all()):
        raise ValueError(f"curvatures A·L must be finite and ≥ 0; got {curved}")
    if not (np.isfinite(ratios).all() and (ratios >= 1.0).all()):
        raise ValueError(f"taper ratios must be finite and ≥ 1; got {ratios}")
    cone = np.full((len(triplets), ratios.size, curved.size), np.nan)
    for j, ratio in enumerate(ratios.tolist()):
        for k, curvature in enumerate(curved.tolist()):
            whisker = Whisker.parabola(
                _LENGTH,
                curvature / _LENGTH,
                base_radius=_BASE_RADIUS,
                tip_radius=_BASE_RADIUS / ratio,
            )
            contact_map = ContactMap.simulate(whisker, grid=False)
            for i, triplet in enumerate(triplets):
                cone[i, j, k] = _critical_cone(contact_map, triplet, samples)
            if progress is not None:
                progress(j * curved.size + k + 1, cone[0].size)
    about = {"units": "rad", "long_name": "smallest cone without witnesses outside it"}
    return xr.Dataset(
        {"critical_cone": (("triplet", "taper_ratio", "curvature"), cone, about)},
        {
            "triplet": list(triplets),
            "taper_ratio": ("taper_ratio", ratios, {"units": "1", "long_name": "taper ratio"}),
            "curvature": ("curvature", curved, {"units": "1", "long_name": "A·L of y = A x²"}),
        },
        {"kind": "vibrissa critical cones", "min_separation": SEPARATION, "samples": samples},
    )


def _critical_cone(contact_map: ContactMap, triplet: str, samples: int) -> float:
    """Critical cone of one triplet from a search, and further searches outside the cone found."""
    cone = 0.0
    for seed in range(_ROUNDS):
        found = uniqueness(
            contact_map, [triplet], ["all"], cone=cone, samples=samples, resolution=False, seed=seed
        )
        # Keep the cone below a right angle, at which it would be all of space.
        cone = min(max(cone, float(found["critical_cone"].squeeze())), 0.499 * np.pi)
    return cone


def with_proved_witnesses(contact_map: ContactMap, verdicts: xr.Dataset) -> xr.Dataset:
    """Add to verdicts which witnesses are proved for the continuous rod, and their cone angles."""
    order = ("triplet", "region", "witness")
    s = verdicts["witness_arc_length"].transpose(*order, "pair").values
    force = verdicts["witness_contact_force"].transpose(*order, "pair", "component").values
    point = verdicts["witness_point"].transpose(*order, "pair", "space").values
    proved, known = np.zeros(s.shape[:-1], dtype=np.int64), dict[bytes, int]()
    for cell in np.argwhere(np.isfinite(s).all(axis=-1)):
        at = tuple(cell)
        triplet = str(verdicts["triplet"].values[at[0]])
        key = triplet.encode() + s[at].tobytes() + force[at].tobytes()  # regions share witnesses
        if key not in known:
            known[key] = int(prove_witness(contact_map, triplet, s[at], force[at]).proved)
        proved[at] = known[key]
    angle = cone_angle(contact_map.whisker, point).min(axis=-1)
    about = {"long_name": "whether the witness is proved"}
    return verdicts.assign(
        witness_proved=(order, proved, about),
        witness_cone=(order, angle, {"units": "rad", "long_name": "cone angle of the witness"}),
    )


def cone_bracket(
    contact_map: ContactMap, certificate: Certificate, samples: int = SAMPLES
) -> tuple[float, float]:
    """Bound the critical cone of (F_x, M_B, M_D), by a proved witness and by a certificate."""
    high = certificate.cone if certificate.proved else np.inf
    if high == 0.0:
        return 0.0, 0.0
    low = 0.0
    for _ in range(_SEARCHES):  # the last search yields witnesses near the largest angle only
        found = uniqueness(
            contact_map, [TRIPLET], ["all"], cone=_NEARLY * low, samples=samples, resolution=False
        )
        low = float(found["critical_cone"].squeeze())
    found = with_proved_witnesses(contact_map, found)
    angle = found["witness_cone"].where(found["witness_proved"] == 1)
    return float(angle.max().fillna(0.0)), float(high)
