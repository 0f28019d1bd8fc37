"""A whisking trial: what stands in the way, how the base moves, what the whisker then feels."""

from vibrissa.trial.motion import Motion, whisking
from vibrissa.trial.objects import Peg
from vibrissa.trial.plan import facing_peg, sweep_past
from vibrissa.trial.recording import recorded_pegs, recorded_whisker
from vibrissa.trial.sensors import measure
from vibrissa.trial.simulate import simulate

__all__ = [
    "Motion",
    "Peg",
    "facing_peg",
    "measure",
    "recorded_pegs",
    "recorded_whisker",
    "simulate",
    "sweep_past",
    "whisking",
]
