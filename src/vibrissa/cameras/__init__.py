"""Cameras: projection, calibration, triangulation, files."""

from vibrissa.cameras.calibration import calibrate
from vibrissa.cameras.camera import Camera, orthogonal_views
from vibrissa.cameras.files import load_cameras, save_cameras
from vibrissa.cameras.triangulation import triangulate

__all__ = [
    "Camera",
    "calibrate",
    "load_cameras",
    "orthogonal_views",
    "save_cameras",
    "triangulate",
]
