"""The methods of Huet, Emnett & Hartmann (2022), for comparison."""

from vibrissa.paper.findings import sensitivity_findings
from vibrissa.paper.lookup import LookupTable
from vibrissa.paper.natural import NaturalNeighbour
from vibrissa.paper.network import NetworkSolver, train_network

__all__ = [
    "LookupTable",
    "NaturalNeighbour",
    "NetworkSolver",
    "sensitivity_findings",
    "train_network",
]
