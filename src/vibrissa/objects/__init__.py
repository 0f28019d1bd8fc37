"""What a whisker touches: solids with their signed distance, gradient and curvature."""

from vibrissa.objects.mesh import Mesh
from vibrissa.objects.solids import Box, Peg, Plane, Sphere

__all__ = [
    "Box",
    "Mesh",
    "Peg",
    "Plane",
    "Sphere",
]
