"""Camera models, triangulation, and calibration by a checkerboard."""

from vibrissa.cameras.calibration import Calibration, calibrate
from vibrissa.cameras.camera import (
    PIXEL_SIZE,
    Camera,
    cameras_dataset as cameras_dataset,
    cameras_from_dataset as cameras_from_dataset,
    load_cameras,
    orthogonal_views,
    save_cameras,
    triangulate,
)

__all__ = [
    "PIXEL_SIZE",
    "Calibration",
    "Camera",
    "calibrate",
    "load_cameras",
    "orthogonal_views",
    "save_cameras",
    "triangulate",
]
__dir__ = __all__.copy
