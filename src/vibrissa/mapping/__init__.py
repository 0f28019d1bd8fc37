"""From signals back to contacts: the map of all contacts, and its inversion."""

from vibrissa.mapping.contact_map import ContactMap
from vibrissa.mapping.estimate import Estimate
from vibrissa.mapping.estimator import Estimator, Located

__all__ = ["ContactMap", "Estimate", "Estimator", "Located"]
