"""Cameras: projection, calibration, triangulation, files."""

from vibrissa.cameras.calibration import calibrate
from vibrissa.cameras.camera import PIXEL_SIZE, Camera, orthogonal_views, triangulate
from vibrissa.cameras.files import (
    cameras_dataset as cameras_dataset,
    cameras_from_dataset as cameras_from_dataset,
    load_cameras,
    save_cameras,
)

__all__ = [
    "PIXEL_SIZE",
    "Camera",
    "calibrate",
    "load_cameras",
    "orthogonal_views",
    "save_cameras",
    "triangulate",
]
