"""From base signals to contacts: the map of all contacts and its inversion."""

from vibrissa.contacts.contact_map import ContactMap
from vibrissa.contacts.estimate import Estimate
from vibrissa.contacts.estimator import Estimator
from vibrissa.contacts.following import ContactFilter
from vibrissa.contacts.hypotheses import Followed
from vibrissa.contacts.located import Located
from vibrissa.contacts.prior import Prior
from vibrissa.contacts.wrench import WrenchEstimate, estimate_from_wrench

__all__ = [
    "ContactFilter",
    "ContactMap",
    "Estimate",
    "Estimator",
    "Followed",
    "Located",
    "Prior",
    "WrenchEstimate",
    "estimate_from_wrench",
]
