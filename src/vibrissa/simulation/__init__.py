"""Simulated trials with known truth: motion, dynamics, film, sensor readings."""

from vibrissa.simulation.array_motion import array_whisking, head_path, protracted, shared_whisking
from vibrissa.simulation.dynamics import Dynamics, resonances
from vibrissa.simulation.film import Look, film, views_of
from vibrissa.simulation.measured import measure
from vibrissa.simulation.motion import Motion, tabulated, whisking
from vibrissa.simulation.plan import facing_peg, sweep_past, within_reach
from vibrissa.simulation.simulate import simulate

__all__ = [
    "Dynamics",
    "Look",
    "Motion",
    "array_whisking",
    "facing_peg",
    "film",
    "head_path",
    "measure",
    "protracted",
    "resonances",
    "shared_whisking",
    "simulate",
    "sweep_past",
    "tabulated",
    "views_of",
    "whisking",
    "within_reach",
]
