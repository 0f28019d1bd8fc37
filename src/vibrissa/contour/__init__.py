"""From contact points to the object's contour, in the laboratory; knows no solver."""

from vibrissa.contour.compare import axis_offset, surface_distances
from vibrissa.contour.continuity import continuing_candidates
from vibrissa.contour.cylinder import CylinderFit, fit_cylinder
from vibrissa.contour.distances import compare_with, distances_by
from vibrissa.contour.ellipsoids import Ellipsoids, ellipsoids
from vibrissa.contour.frames import covariance_to_laboratory, to_laboratory
from vibrissa.contour.free import FreeFit
from vibrissa.contour.free_fitting import fit_free
from vibrissa.contour.mesh import surface_grid
from vibrissa.contour.plane import PlaneFit, fit_plane
from vibrissa.contour.shape import FittedShape
from vibrissa.contour.sphere import SphereFit, fit_sphere
from vibrissa.contour.stored import shape_from_dataset

__all__ = [
    "CylinderFit",
    "Ellipsoids",
    "FittedShape",
    "FreeFit",
    "PlaneFit",
    "SphereFit",
    "axis_offset",
    "compare_with",
    "continuing_candidates",
    "covariance_to_laboratory",
    "distances_by",
    "ellipsoids",
    "fit_cylinder",
    "fit_free",
    "fit_plane",
    "fit_sphere",
    "shape_from_dataset",
    "surface_distances",
    "surface_grid",
    "to_laboratory",
]
