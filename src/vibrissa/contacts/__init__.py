"""From base signals to contacts: the map of all contacts and its inversion."""

from vibrissa.contacts.around import estimate_around
from vibrissa.contacts.charted_whisker import need_map as need_map
from vibrissa.contacts.chosen_contacts import (
    At,
    ChosenContacts as ChosenContacts,
    chosen_contacts as chosen_contacts,
    large_deflection as large_deflection,
)
from vibrissa.contacts.contact_map import (
    ContactMap,
    Domain,
    Progress,
    within_paper_bounds as within_paper_bounds,
)
from vibrissa.contacts.contacts import (
    Candidates as Candidates,
    Contact,
    Contacts,
    contacts_of as contacts_of,
    friction_assumed as friction_assumed,
)
from vibrissa.contacts.engine.prior import Prior
from vibrissa.contacts.engine.readout import searched_by_name as searched_by_name
from vibrissa.contacts.engine.search import signals_at_nodes as signals_at_nodes
from vibrissa.contacts.estimator import Estimator
from vibrissa.contacts.fitting.inversion import (
    invert as invert,
    polish as polish,
    seeding_triplet as seeding_triplet,
)
from vibrissa.contacts.following.events import (
    SLIPPING as SLIPPING,
    ContactEvents as ContactEvents,
    Place as Place,
    in_order as in_order,
)
from vibrissa.contacts.following.filter import ContactFilter, Followed as Followed
from vibrissa.contacts.joint.forward import Gravity, read_at_rest as read_at_rest
from vibrissa.contacts.joint_estimate import estimate_jointly as estimate_jointly
from vibrissa.contacts.sensing.channels import (
    RANK as RANK,
    WRENCH,
    Channels as Channels,
    channel_derivatives as channel_derivatives,
    channel_gradients as channel_gradients,
    contact_signal_derivatives as contact_signal_derivatives,
    deficient as deficient,
    ratio_derivatives as ratio_derivatives,
    spherical_derivatives as spherical_derivatives,
)
from vibrissa.contacts.sensing.noise import (
    Noise,
    SensorNoise as SensorNoise,
    common_covariance as common_covariance,
    common_errors as common_errors,
    ellipsoids,
    rms_error as rms_error,
    whitening as whitening,
)
from vibrissa.contacts.two_contacts import bent_by_forces as bent_by_forces, second_contact
from vibrissa.contacts.wrench import estimate_from_wrench, rubbing_misfits as rubbing_misfits

__all__ = [
    "WRENCH",
    "At",
    "Contact",
    "ContactFilter",
    "ContactMap",
    "Contacts",
    "Domain",
    "Estimator",
    "Gravity",
    "Noise",
    "Prior",
    "Progress",
    "ellipsoids",
    "estimate_around",
    "estimate_from_wrench",
    "second_contact",
]
__dir__ = __all__.copy
