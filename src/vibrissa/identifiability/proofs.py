"""Proofs of verdicts: witnesses that are proved, and brackets of critical cones."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from vibrissa.certificates import TRIPLET, Certificate, prove_witness
from vibrissa.identifiability.verdicts import SAMPLES, uniqueness
from vibrissa.signals import cone_angle

# Searches for a critical cone, each outside this share of the cone before.
_SEARCHES, _NEARLY = 2, 0.95

if TYPE_CHECKING:
    from vibrissa.contacts import ContactMap


def with_proved_witnesses(contact_map: ContactMap, verdicts: xr.Dataset) -> xr.Dataset:
    """Prove the witnesses of verdicts, for the continuous rod."""
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
    """Bound the critical cone of (F_x, M_B, M_D): a proved witness below, a certificate above."""
    high = certificate.cone if certificate.proved else np.inf
    if high == 0.0:
        return 0.0, 0.0
    low = 0.0
    for _ in range(_SEARCHES):  # the last one's witnesses are all near the largest angle
        found = uniqueness(
            contact_map,
            [TRIPLET],
            ["all"],
            cone=_NEARLY * low,
            samples=samples,
            resolution=False,
        )
        low = float(found["critical_cone"].squeeze())
    found = with_proved_witnesses(contact_map, found)
    angle = found["witness_cone"].where(found["witness_proved"] == 1)
    return float(angle.max().fillna(0.0)), float(high)
