"""Fits of an object's shape to contact points, in the laboratory frame."""

from vibrissa.contour.comparison import axis_offset as axis_offset, compare_with, distances_by
from vibrissa.contour.drawing import Ellipsoids, ellipsoids, surface_grid
from vibrissa.contour.fit import fit_shape
from vibrissa.contour.fitted_shape import (
    FittedShape,
    continuing_candidates,
    evidence_of as evidence_of,
    to_laboratory as to_laboratory,
)
from vibrissa.contour.free_surface import FreeFit, fit_free, shape_from_dataset
from vibrissa.contour.simple_shapes import CylinderFit, PlaneFit, SphereFit

__all__ = [
    "CylinderFit",
    "Ellipsoids",
    "FittedShape",
    "FreeFit",
    "PlaneFit",
    "SphereFit",
    "compare_with",
    "continuing_candidates",
    "distances_by",
    "ellipsoids",
    "fit_free",
    "fit_shape",
    "shape_from_dataset",
    "surface_grid",
]
__dir__ = __all__.copy
