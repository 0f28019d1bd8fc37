"""From base signals to contacts: the map of all contacts and its inversion."""

from vibrissa.contacts.channels import WRENCH, Channels, channel_derivatives, channel_gradients
from vibrissa.contacts.chosen_contacts import At, ChosenContacts, chosen_contacts, large_deflection
from vibrissa.contacts.contact_map import ContactMap, Domain, Progress, within_paper_bounds
from vibrissa.contacts.contacts import Candidates, Contact, Contacts, contacts_of, spherical
from vibrissa.contacts.estimator import Estimator
from vibrissa.contacts.filter import ContactFilter, Followed
from vibrissa.contacts.friction import ratio_derivatives
from vibrissa.contacts.inversion import invert, seeding_triplet
from vibrissa.contacts.jacobian import (
    RANK,
    contact_signal_derivatives,
    deficient,
    spherical_derivatives,
)
from vibrissa.contacts.noise import (
    Noise,
    SensorNoise,
    common_covariance,
    common_errors,
    ellipsoids,
    rms_error,
    whitening,
)
from vibrissa.contacts.prior import Prior
from vibrissa.contacts.readout import check_signals
from vibrissa.contacts.search import signals_at_nodes
from vibrissa.contacts.weight import Gravity, estimate_with_weight
from vibrissa.contacts.wrench import estimate_from_wrench

__all__ = [
    "RANK",
    "WRENCH",
    "At",
    "Candidates",
    "Channels",
    "ChosenContacts",
    "Contact",
    "ContactFilter",
    "ContactMap",
    "Contacts",
    "Domain",
    "Estimator",
    "Followed",
    "Gravity",
    "Noise",
    "Prior",
    "Progress",
    "SensorNoise",
    "channel_derivatives",
    "channel_gradients",
    "check_signals",
    "chosen_contacts",
    "common_covariance",
    "common_errors",
    "contact_signal_derivatives",
    "contacts_of",
    "deficient",
    "ellipsoids",
    "estimate_from_wrench",
    "estimate_with_weight",
    "invert",
    "large_deflection",
    "ratio_derivatives",
    "rms_error",
    "seeding_triplet",
    "signals_at_nodes",
    "spherical",
    "spherical_derivatives",
    "whitening",
    "within_paper_bounds",
]
