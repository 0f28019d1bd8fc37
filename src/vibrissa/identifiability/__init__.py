"""Identifiability: which signals locate a contact, critical cones, sensitivity."""

from vibrissa.identifiability.cones import (
    cone_bracket as cone_bracket,
    critical_cones,
    with_proved_witnesses as with_proved_witnesses,
)
from vibrissa.identifiability.sensitivity import best_triplet, sensitivity
from vibrissa.identifiability.summary import (
    ENDINGS,
    save_uniqueness as save_uniqueness,
    twins_of as twins_of,
    verdict_rows as verdict_rows,
    verdict_table,
)
from vibrissa.identifiability.verdicts import uniqueness
from vibrissa.identifiability.witness_pair import witness_pairs

__all__ = [
    "ENDINGS",
    "best_triplet",
    "critical_cones",
    "sensitivity",
    "uniqueness",
    "verdict_table",
    "witness_pairs",
]
