"""What a whisker touches: solids with their signed distance, gradient and curvature."""

from vibrissa.objects.dataset import object_from_dataset, objects_datasets
from vibrissa.objects.mesh import Mesh
from vibrissa.objects.solids import Box, Peg, Plane, Sphere
from vibrissa.objects.surface import Placement, Surface, between

__all__ = [
    "Box",
    "Mesh",
    "Peg",
    "Placement",
    "Plane",
    "Sphere",
    "Surface",
    "between",
    "object_from_dataset",
    "objects_datasets",
]
