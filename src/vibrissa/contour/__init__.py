"""From contact points to the object's contour, in the laboratory; knows no solver."""

from vibrissa.contour.compare import axis_offset, surface_distances
from vibrissa.contour.continuity import continuing_candidates
from vibrissa.contour.cylinder import CylinderFit, fit_cylinder
from vibrissa.contour.frames import covariance_to_laboratory, to_laboratory
from vibrissa.contour.plane import PlaneFit, fit_plane
from vibrissa.contour.shape import FittedShape
from vibrissa.contour.sphere import SphereFit, fit_sphere
from vibrissa.contour.stored import shape_from_dataset

__all__ = [
    "CylinderFit",
    "FittedShape",
    "PlaneFit",
    "SphereFit",
    "axis_offset",
    "continuing_candidates",
    "covariance_to_laboratory",
    "fit_cylinder",
    "fit_plane",
    "fit_sphere",
    "shape_from_dataset",
    "surface_distances",
    "to_laboratory",
]
