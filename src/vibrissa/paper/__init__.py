"""Methods of Huet, Emnett & Hartmann (2022), for comparison."""

from vibrissa.paper.lookup import (
    METHODS,
    LookupTable,
    error_solid as error_solid,
    estimate,
    interpolation_errors as interpolation_errors,
    signal_slice,
)
from vibrissa.paper.natural_neighbour import NaturalNeighbour
from vibrissa.paper.network import (
    DrawnContacts as DrawnContacts,
    NetworkSolver,
    draw_contacts as draw_contacts,
    train_network,
    with_network_errors,
)
from vibrissa.paper.sensitivity import central_differences, sensitivity_findings

__all__ = [
    "METHODS",
    "LookupTable",
    "NaturalNeighbour",
    "NetworkSolver",
    "central_differences",
    "estimate",
    "sensitivity_findings",
    "signal_slice",
    "train_network",
    "with_network_errors",
]
__dir__ = __all__.copy
