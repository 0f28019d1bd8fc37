"""Which signals locate a contact: witnesses, verdicts, critical cones, sensitivity."""

from vibrissa.identifiability.best_triplet import best_triplet
from vibrissa.identifiability.cones import critical_cones
from vibrissa.identifiability.sensitivity import sensitivity
from vibrissa.identifiability.summary import save_uniqueness, verdict_table
from vibrissa.identifiability.verdicts import uniqueness
from vibrissa.identifiability.witness_pair import witness_pairs

__all__ = [
    "best_triplet",
    "critical_cones",
    "save_uniqueness",
    "sensitivity",
    "uniqueness",
    "verdict_table",
    "witness_pairs",
]
