"""A study as plain data: whiskers, and the tasks of each."""

from __future__ import annotations

import hashlib
import json
import time
import tomllib
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from vibrissa.contacts import seeding_triplet, signals_at_nodes
from vibrissa.rod import discretize, point_solver, stable_set
from vibrissa.signals import resting
from vibrissa.sweeps.population import Specimen, population
from vibrissa.sweeps.tasks import TASKS, Settings, settings_of
from vibrissa.whisker import Whisker

EXAMPLE = """\
# A study for `vibrissa sweep`: lengths in mm, radii in µm, moduli in GPa, angles in degrees.

name = "taper and curvature"
seed = 0

# Whiskers; repeat [[whiskers]] for more of them.
[[whiskers]]
kind = "grid"                    # all combinations of the values
length = 39.4
taper_ratio = [1, 2, 5, 15, 60]  # base radius over tip radius
curvature = [0.0, 0.4, 0.8]      # A L of the parabola y = A x²
# bend = 180                     # or: what the tangent turns by, at a constant rate,
# corkscrew = 360                # and what the plane of bending turns by
# base_radius = 100.0
# youngs_modulus = 3.0
# trim = 1.0                     # share of the length that is left
# group = "parabolas"            # a name; by default the kind

# [[whiskers]]
# kind = "random"                # values between [least, largest]
# count = 100
# length = [20, 60]
# taper_ratio = [2, 60]
# logarithmic = ["taper_ratio"]

# [[whiskers]]
# kind = "files"                 # digitised centrelines
# files = "whiskers/*.csv"

# [[whiskers]]
# kind = "array"                 # an average rat's
# side = "right"
# rows = "ABCDE"

[[tasks]]
kind = "uniqueness"
triplets = ["Fx MB MD", "Mx MB MD", "Fx FD MD"]   # or "all"
regions = ["all"]
cone = 2.0                       # about rest, left out, degrees
samples = 1024
resolution = true

[[tasks]]
kind = "estimation"
signals = ["Fx MB MD", "wrench"]
contacts = 1000
force_noise = 1.0                # µN
moment_noise = 0.02              # µN·m

# groups = ["grid"]              # only of these; by default of all whiskers

# Others: "map"; "sensitivity" (triplets, noise); "friction" (triplet, friction, contacts);
# "certificate", a proof for each whisker: cone (0: the smallest that may do), minutes, and folder,
# where certificates are kept and continued.
"""

_KEPT = (discretize, stable_set, point_solver, resting, signals_at_nodes, seeding_triplet)
"""Functions that cache results of the last whiskers; a study does not return to any."""
_OF_WHISKER, _OF_CELL = 16, 4
"""Numbers stored for each whisker, with its name, and for each cell."""


@dataclass(frozen=True)
class Cell:
    """One task for one whisker.

    Parameters
    ----------
    task : str
        Name of the task in the study.
    kind : str
        Kind of task, such as "map".
    settings : mapping
        Settings of the task.
    index : int
        Number of the whisker.
    specimen : Specimen
        The whisker.
    seed : int
        Seed of the cell: the same for the same whisker in any study with the same seed.
    identity : str
        Hash of whisker, task, settings and seed.
    """

    task: str
    kind: str
    settings: Settings
    index: int
    specimen: Specimen
    seed: int
    identity: str


@dataclass(frozen=True)
class Study:
    """Whiskers × tasks.

    Parameters
    ----------
    name : str
        Name of the study.
    seed : int
        Seed of all that is random.
    specimens : tuple of Specimen
        The whiskers.
    tasks : mapping
        Kind and settings of each task by its name.
    groups : mapping
        Groups of whiskers that a task is asked of, by its name; by default all.
    """

    name: str
    seed: int
    specimens: tuple[Specimen, ...]
    tasks: Mapping[str, tuple[str, Settings]]
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def asks(self, task: str, specimen: Specimen) -> bool:
        """Decide whether a task is asked of a whisker.

        Parameters
        ----------
        task : str
            Name of the task.
        specimen : Specimen
            The whisker.

        Returns
        -------
        bool
            True unless the task is for other groups.
        """
        return task not in self.groups or specimen.group in self.groups[task]

    def cells(self) -> Iterator[Cell]:
        """List what is to be done, one whisker after the other.

        Yields
        ------
        Cell
            One task for one whisker.
        """
        for index, specimen in enumerate(self.specimens):
            for task, (kind, settings) in self.tasks.items():
                if not self.asks(task, specimen):
                    continue
                asked = json.dumps(
                    [specimen.identity, kind, dict(settings), self.seed], default=list
                )
                digest = hashlib.sha256(asked.encode()).hexdigest()
                # The seed is the whisker's: a study with more whiskers has the same cells again.
                own = hashlib.sha256(f"{self.seed} {specimen.identity}".encode()).hexdigest()
                yield Cell(task, kind, settings, index, specimen, int(own[:7], 16), digest[:16])

    def count(self, task: str) -> int:
        """Count the whiskers of which a task is asked.

        Parameters
        ----------
        task : str
            Name of the task.

        Returns
        -------
        int
            Number of whiskers.
        """
        return sum(self.asks(task, specimen) for specimen in self.specimens)

    @property
    def size(self) -> int:
        """Number of cells."""
        return sum(map(self.count, self.tasks))

    @property
    def seconds(self) -> float:
        """Approximate time on one core, s."""
        return sum(
            TASKS[kind].seconds(settings) * self.count(task)
            for task, (kind, settings) in self.tasks.items()
        )

    @property
    def bytes(self) -> int:
        """Approximate size of its results on disk: eight bytes a number."""
        each = sum(TASKS[kind].numbers(settings) for kind, settings in self.tasks.values())
        return 8 * len(self.specimens) * (each + _OF_WHISKER + _OF_CELL * len(self.tasks))


def read_study(text: str, folder: Path) -> Study:
    """Read a study.

    Parameters
    ----------
    text : str
        Study in TOML, as `EXAMPLE`.
    folder : Path
        Folder that file names are relative to.

    Returns
    -------
    Study
        Checked, nothing done.

    Raises
    ------
    ValueError
        If it is not TOML, or has keys that are not known or values out of range.
    """
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as fault:
        raise ValueError(f"this is not TOML: {fault}") from None
    known = {"name", "seed", "whiskers", "tasks"}
    if unknown := sorted(set(content) - known):
        raise ValueError(
            f"the study has {', '.join(unknown)}; known are {', '.join(sorted(known))}"
        )
    seed = content.get("seed", 0)
    if not isinstance(seed, int) or isinstance(seed, bool) or seed < 0:
        raise ValueError(f"seed is {seed!r}; a whole number from 0 is needed")
    tables = {name: content.get(name, []) for name in ("whiskers", "tasks")}
    for name, table in tables.items():
        if not isinstance(table, list) or not table:
            raise ValueError(f"the study has no {name}: at least one [[{name}]] is needed")
    tasks: dict[str, tuple[str, Settings]] = {}
    groups: dict[str, tuple[str, ...]] = {}
    for number, table in enumerate(tables["tasks"]):
        where = f"[[tasks]] {number + 1}"
        if not isinstance(table, Mapping):
            raise ValueError(f"{where} is {table!r}; a table is needed")
        asked = {key: value for key, value in table.items() if key != "groups"}
        kind, settings = settings_of(asked, where)
        name = str(table.get("name", kind))
        if name in tasks or not name.replace("_", "").isalnum():
            raise ValueError(
                f"{where} is called {name!r}; letters and digits are needed, and another name for "
                "each task (name = ...)"
            )
        tasks[name] = (kind, settings)
        if "groups" in table:
            groups[name] = _groups(table["groups"], where)
    specimens = tuple(population(tables["whiskers"], folder, seed))
    known_groups = {specimen.group for specimen in specimens}
    for name, some in groups.items():
        if unknown := sorted(set(some) - known_groups):
            raise ValueError(
                f"task {name} is asked of the groups {', '.join(unknown)}; there are "
                f"{', '.join(sorted(known_groups))}"
            )
    return Study(str(content.get("name", "study")), seed, specimens, tasks, groups)


def _groups(value: Any, where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not value or not all(isinstance(one, str) for one in value):
        raise ValueError(f"{where}: groups is {value!r}; a list of names is needed")
    return tuple(value)


def answer(cell: Cell) -> dict[str, Any]:
    """Do one task for one whisker, wherever this runs."""
    started = time.process_time()
    try:
        whisker = cell.specimen.make()
        # Threads of linear algebra would change the last digits with their number.
        with threadpool_limits(1):
            result = TASKS[cell.kind].run(whisker, cell.settings, cell.seed).load()
        described = _described(whisker)
    except Exception:
        return {"failure": traceback.format_exc(), "seconds": time.process_time() - started}
    finally:
        for kept in _KEPT:
            kept.cache_clear()
    return {
        "result": result,
        "whisker": described,
        "seconds": time.process_time() - started,
    }


def _described(whisker: Whisker) -> dict[str, float]:
    tangent = whisker.frame(np.linspace(0.0, whisker.length, 401))[:, :, 0]
    chord = np.linalg.norm(np.diff(tangent, axis=0), axis=1)
    return {
        "length": whisker.length,
        "base_radius": whisker.base_radius,
        "tip_radius": whisker.tip_radius,
        "taper_ratio": whisker.base_radius / whisker.tip_radius,
        "youngs_modulus": whisker.youngs_modulus,
        "turn": float(2.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)).sum()),
    }
