"""How a whisker bends: the rod, its loads, and the stable contacts it can hold."""

from vibrissa.rod.deflection import Deflection, deflect
from vibrissa.rod.loads import Load, PegContact, PointContact, PointForce

__all__ = [
    "Deflection",
    "Load",
    "PegContact",
    "PointContact",
    "PointForce",
    "deflect",
]
