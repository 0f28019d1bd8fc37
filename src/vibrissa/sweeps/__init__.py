"""Studies of many whiskers on one machine or a cluster, with results in one labelled store."""

from vibrissa.sweeps.run import (
    Outcome as Outcome,
    failures,
    open_sweep,
    run_sweep,
    sweep_summary as sweep_summary,
)
from vibrissa.sweeps.store import Busy as Busy, Store as Store
from vibrissa.sweeps.study import EXAMPLE as EXAMPLE, Cell as Cell, Study as Study, read_study

__all__ = ["failures", "open_sweep", "read_study", "run_sweep"]
__dir__ = __all__.copy
