"""From signals back to contacts: the map of all contacts, and its inversion."""

from vibrissa.mapping.best_triplet import best_triplet
from vibrissa.mapping.contact_map import ContactMap
from vibrissa.mapping.estimate import Estimate
from vibrissa.mapping.estimator import Estimator, Located
from vibrissa.mapping.findings import sensitivity_findings
from vibrissa.mapping.sensitivity import sensitivity

__all__ = [
    "ContactMap",
    "Estimate",
    "Estimator",
    "Located",
    "best_triplet",
    "sensitivity",
    "sensitivity_findings",
]
