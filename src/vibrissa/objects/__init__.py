"""Objects that a whisker can touch: solids with signed distance, normal and curvature."""

from vibrissa.objects.mesh import Mesh
from vibrissa.objects.solids import (
    Box,
    Peg,
    Plane,
    Sphere,
    object_from_dataset as object_from_dataset,
    objects_datasets as objects_datasets,
)
from vibrissa.objects.surface import (
    Placement as Placement,
    Surface,
    between as between,
    listed_objects as listed_objects,
)

__all__ = ["Box", "Mesh", "Peg", "Plane", "Sphere", "Surface"]
__dir__ = __all__.copy
