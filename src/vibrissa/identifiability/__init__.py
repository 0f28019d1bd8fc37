"""Identifiability of contacts: unique triplets of signals, critical cones, and sensitivity."""

from vibrissa.identifiability.cones import (
    cone_bracket as cone_bracket,
    critical_cones,
    with_proved_witnesses as with_proved_witnesses,
)
from vibrissa.identifiability.sensitivity import best_triplet, sensitivity
from vibrissa.identifiability.twins import witness_pairs
from vibrissa.identifiability.verdicts import (
    ENDINGS,
    save_uniqueness as save_uniqueness,
    twins_of as twins_of,
    uniqueness,
    verdict_rows as verdict_rows,
    verdict_table,
)

__all__ = [
    "ENDINGS",
    "best_triplet",
    "critical_cones",
    "sensitivity",
    "uniqueness",
    "verdict_table",
    "witness_pairs",
]
__dir__ = __all__.copy
