"""A whisking trial: what stands in the way, how the base moves, what the whisker then feels."""

from vibrissa.sensing import Sensor
from vibrissa.trial.array_motion import array_whisking, head_path, protracted, shared_whisking
from vibrissa.trial.calibration import calibrate
from vibrissa.trial.camera_files import load_cameras, save_cameras
from vibrissa.trial.cameras import Camera, orthogonal_views
from vibrissa.trial.dynamics import Dynamics, resonances
from vibrissa.trial.film import Look, film, views_of
from vibrissa.trial.mesh import Mesh
from vibrissa.trial.motion import Motion, tabulated, whisking
from vibrissa.trial.objects import Box, Peg, Plane, Sphere
from vibrissa.trial.plan import facing_peg, sweep_past, within_reach
from vibrissa.trial.recording import (
    recorded_cameras,
    recorded_objects,
    recorded_pegs,
    recorded_whisker,
)
from vibrissa.trial.sensors import measure
from vibrissa.trial.simulate import simulate
from vibrissa.trial.triangulation import triangulate

__all__ = [
    "Box",
    "Camera",
    "Dynamics",
    "Look",
    "Mesh",
    "Motion",
    "Peg",
    "Plane",
    "Sensor",
    "Sphere",
    "array_whisking",
    "calibrate",
    "facing_peg",
    "film",
    "head_path",
    "load_cameras",
    "measure",
    "orthogonal_views",
    "protracted",
    "recorded_cameras",
    "recorded_objects",
    "recorded_pegs",
    "recorded_whisker",
    "resonances",
    "save_cameras",
    "shared_whisking",
    "simulate",
    "sweep_past",
    "tabulated",
    "triangulate",
    "views_of",
    "whisking",
    "within_reach",
]
