"""Simulated trials with ground truth: motion, dynamics, videos and sensor readings."""

from vibrissa.simulation.dynamics import (
    Dynamics,
    inertial_wrench as inertial_wrench,
    resonances as resonances,
)
from vibrissa.simulation.film import (
    ImageConditions,
    film,
    film_frames as film_frames,
    silhouette as silhouette,
    views_of as views_of,
    with_true_traces as with_true_traces,
)
from vibrissa.simulation.motion import (
    Motion,
    array_whisking,
    facing_peg,
    head_path,
    protracted as protracted,
    shared_whisking as shared_whisking,
    sweep_past,
    tabulated,
    whisking,
    within_reach,
)
from vibrissa.simulation.script import (
    EXAMPLE as EXAMPLE,
    Script as Script,
    read_objects as read_objects,
    read_script as read_script,
)
from vibrissa.simulation.simulate import measure, simulate
from vibrissa.simulation.vibration import FittedDynamics, Vibration, fit_dynamics

__all__ = [
    "Dynamics",
    "FittedDynamics",
    "ImageConditions",
    "Motion",
    "Vibration",
    "array_whisking",
    "facing_peg",
    "film",
    "fit_dynamics",
    "head_path",
    "measure",
    "simulate",
    "sweep_past",
    "tabulated",
    "whisking",
    "within_reach",
]
__dir__ = __all__.copy
