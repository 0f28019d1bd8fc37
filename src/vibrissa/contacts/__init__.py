"""From base signals to contacts: the map of all contacts and its inversion."""

from vibrissa.contacts.contact_map import ContactMap
from vibrissa.contacts.contacts import Contact, Contacts, spherical
from vibrissa.contacts.estimator import Estimator
from vibrissa.contacts.filter import ContactFilter, Followed
from vibrissa.contacts.prior import Prior
from vibrissa.contacts.wrench import estimate_from_wrench

__all__ = [
    "Contact",
    "ContactFilter",
    "ContactMap",
    "Contacts",
    "Estimator",
    "Followed",
    "Prior",
    "estimate_from_wrench",
    "spherical",
]
