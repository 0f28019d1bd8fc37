"""From contact points to the object's contour, in the laboratory; knows no solver."""

from vibrissa.contour.compare import axis_offset, surface_distances
from vibrissa.contour.continuity import continuing_candidates
from vibrissa.contour.cylinder import CylinderFit, fit_cylinder
from vibrissa.contour.frames import covariance_to_laboratory, to_laboratory

__all__ = [
    "CylinderFit",
    "axis_offset",
    "continuing_candidates",
    "covariance_to_laboratory",
    "fit_cylinder",
    "surface_distances",
    "to_laboratory",
]
