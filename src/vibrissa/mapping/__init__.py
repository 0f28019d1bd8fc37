"""From signals back to contacts: the map of all contacts, and its inversion."""

from vibrissa.mapping.best_triplet import best_triplet
from vibrissa.mapping.cones import critical_cones
from vibrissa.mapping.contact_map import ContactMap
from vibrissa.mapping.estimate import Estimate
from vibrissa.mapping.estimator import Estimator
from vibrissa.mapping.findings import sensitivity_findings
from vibrissa.mapping.following import ContactFilter
from vibrissa.mapping.hypotheses import Followed
from vibrissa.mapping.located import Located
from vibrissa.mapping.lookup import LookupTable
from vibrissa.mapping.natural import NaturalNeighbour
from vibrissa.mapping.network import NetworkSolver, train_network
from vibrissa.mapping.prior import Prior
from vibrissa.mapping.sensitivity import sensitivity
from vibrissa.mapping.slices import error_solid, signal_slice
from vibrissa.mapping.summary import save_uniqueness, verdict_table
from vibrissa.mapping.verdicts import uniqueness
from vibrissa.mapping.wrench import WrenchEstimate, estimate_from_wrench

__all__ = [
    "ContactFilter",
    "ContactMap",
    "Estimate",
    "Estimator",
    "Followed",
    "Located",
    "LookupTable",
    "NaturalNeighbour",
    "NetworkSolver",
    "Prior",
    "WrenchEstimate",
    "best_triplet",
    "critical_cones",
    "error_solid",
    "estimate_from_wrench",
    "save_uniqueness",
    "sensitivity",
    "sensitivity_findings",
    "signal_slice",
    "train_network",
    "uniqueness",
    "verdict_table",
]
