"""Definition of a study as plain data: whiskers, and the tasks for each of them.

As a study may have thousands of whiskers, a `Specimen` contains only a name, a few numbers and a
recipe, and its whisker is constructed when it is needed.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from glob import glob
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from vibrissa.contacts import searched_by_name, seeding_triplet, signals_at_nodes
from vibrissa.io import check_keys, load_whisker, parsed_toml
from vibrissa.rod import discretize, point_solver, stable_set
from vibrissa.signals import resting
from vibrissa.sweeps.tasks import TASKS, Settings, settings_of
from vibrissa.whisker import Whisker, whisker_array

EXAMPLE = Path(__file__).with_name("example.toml").read_text(encoding="utf-8")

# Functions with caches by whisker, which are cleared after each cell, as whiskers do not recur.
_KEPT = (
    discretize,
    stable_set,
    point_solver,
    resting,
    signals_at_nodes,
    seeding_triplet,
    searched_by_name,
)
_OF_WHISKER, _OF_CELL = 16, 4  # numbers stored for each whisker, including its name, and each cell


@dataclass(frozen=True)
class Cell:
    """One task for one whisker, with its seed, and a hash of all that determines it as identity."""

    task: str
    kind: str
    settings: Settings
    index: int
    specimen: Specimen
    seed: int
    identity: str


@dataclass(frozen=True)
class Study:
    """Whiskers and tasks of a study.

    ``tasks`` are the kind and settings of each task by its name, and ``groups`` the groups of
    whiskers to which a task is restricted, by its name; by default it applies to all.
    """

    name: str
    seed: int
    specimens: tuple[Specimen, ...]
    tasks: Mapping[str, tuple[str, Settings]]
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def asks(self, task: str, specimen: Specimen) -> bool:
        """Whether a task applies to a whisker."""
        return task not in self.groups or specimen.group in self.groups[task]

    def cells(self) -> Iterator[Cell]:
        """Yield the cells, one whisker after the other."""
        for index, specimen in enumerate(self.specimens):
            for task, (kind, settings) in self.tasks.items():
                if not self.asks(task, specimen):
                    continue
                asked = json.dumps(
                    [specimen.identity, kind, dict(settings), self.seed], default=list
                )
                digest = hashlib.sha256(asked.encode()).hexdigest()
                # The seed depends on the whisker only, so that adding whiskers keeps other cells.
                own = hashlib.sha256(f"{self.seed} {specimen.identity}".encode()).hexdigest()
                yield Cell(task, kind, settings, index, specimen, int(own[:7], 16), digest[:16])

    def count(self, task: str) -> int:
        """Number of whiskers to which a task applies."""
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
        """Approximate size of the results on disk: eight bytes per number."""
        each = sum(TASKS[kind].numbers(settings) for kind, settings in self.tasks.values())
        return 8 * len(self.specimens) * (each + _OF_WHISKER + _OF_CELL * len(self.tasks))

    def faults(self, most: int) -> dict[str, str]:
        """Whiskers that cannot be constructed, and why, of at most ``most`` tried ones."""
        out = {}
        for specimen in self.specimens[:: -(-len(self.specimens) // most)]:
            try:
                specimen.make()
            except Exception as fault:
                out[specimen.name] = f"{type(fault).__name__}: {fault}"
        return out


def read_study(text: str, folder: Path) -> Study:
    """Read a study.

    Parameters
    ----------
    text : str
        Study in TOML, such as `EXAMPLE`.
    folder : Path
        Folder to which file names are relative.

    Returns
    -------
    Study
        Validated study.

    Raises
    ------
    ValueError
        If the text is not TOML, or has unknown keys or values out of range.
    """
    content = parsed_toml(text)
    check_keys(content, {"name", "seed", "whiskers", "tasks"}, "the study")
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
            groups[name] = tuple(_words(f"{where}: groups", table["groups"], empty=False))
    specimens = tuple(population(tables["whiskers"], folder, seed))
    known_groups = {specimen.group for specimen in specimens}
    for name, some in groups.items():
        if unknown := sorted(set(some) - known_groups):
            raise ValueError(
                f"task {name} is restricted to the groups {', '.join(unknown)}; there are "
                f"{', '.join(sorted(known_groups))}"
            )
    return Study(str(content.get("name", "study")), seed, specimens, tasks, groups)


def answer(cell: Cell) -> dict[str, Any]:
    """Compute one cell in the current process."""
    started = time.process_time()
    try:
        whisker = cell.specimen.make()
        # The number of threads in linear algebra would affect the last digits.
        with threadpool_limits(1):
            result = TASKS[cell.kind].run(whisker, cell.settings, cell.seed).load()
        tangent = whisker.frame(np.linspace(0.0, whisker.length, 401))[:, :, 0]
        chord = np.linalg.norm(np.diff(tangent, axis=0), axis=1)
        described = {
            "length": whisker.length,
            "base_radius": whisker.base_radius,
            "tip_radius": whisker.tip_radius,
            "taper_ratio": whisker.base_radius / whisker.tip_radius,
            "youngs_modulus": whisker.youngs_modulus,
            "turn": float(2.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)).sum()),
        }
    except Exception:
        return {"failure": traceback.format_exc(), "seconds": time.process_time() - started}
    finally:
        for kept in _KEPT:
            kept.cache_clear()
    return {"result": result, "whisker": described, "seconds": time.process_time() - started}


# Parameters of a grid or a random population: default, factor to SI units, exclusive minimum.
# ``curvature`` is A·L of the parabola y = A x². ``bend`` is the angle in degrees by which the
# tangent of an arc turns from base to tip, and ``corkscrew`` that by which its plane of bending
# turns. ``trim`` is the share of the length that is kept, with unchanged radii.
PARAMETERS: Mapping[str, tuple[float, float, float]] = {
    "length": (39.4, 1e-3, 0.0),
    "taper_ratio": (15.0, 1.0, 0.0),
    "curvature": (0.0, 1.0, -np.inf),
    "bend": (0.0, np.pi / 180.0, -np.inf),
    "corkscrew": (0.0, np.pi / 180.0, -np.inf),
    "base_radius": (100.0, 1e-6, 0.0),
    "youngs_modulus": (3.0, 1e9, 0.0),
    "trim": (1.0, 1.0, 0.0),
}

_MOST = 10_000_000  # largest number of whiskers, each of which takes 2.5 kB of memory


@dataclass(frozen=True)
class Specimen:
    """Recipe of a whisker, with its name and properties."""

    name: str
    parameters: Mapping[str, float]
    identity: str
    make: Callable[[], Whisker]
    group: str = ""


def population(tables: Sequence[Any], folder: Path, seed: int) -> list[Specimen]:
    """Whiskers of a study, from its tables ``[[whiskers]]``."""
    found: list[Specimen] = []
    for number, table in enumerate(tables):
        where = f"[[whiskers]] {number + 1}"
        if not isinstance(table, Mapping):
            raise ValueError(f"{where} is {table!r}; a table is needed")
        kind = table.get("kind", "grid")
        if not isinstance(kind, str) or kind not in _KINDS:
            raise ValueError(f"{where}: kind is {kind!r}; one of {', '.join(_KINDS)} is needed")
        stated = {key: value for key, value in table.items() if key not in ("kind", "group")}
        group = str(table.get("group", kind))
        try:
            some = _KINDS[kind](stated, folder, [seed, number])
            found += [replace(specimen, group=group) for specimen in some]
        except (TypeError, ValueError, OverflowError, OSError) as fault:
            raise ValueError(f"{where}: {fault}") from None
    counts = Counter(specimen.name for specimen in found)
    if twice := sorted(name for name, count in counts.items() if count > 1):
        raise ValueError(f"whiskers share the names {', '.join(twice[:5])}: give each a prefix")
    if not found:
        raise ValueError("the study has no whiskers: at least one [[whiskers]] is needed")
    return found


def _grid(stated: Mapping[str, Any], folder: Path, seed: Sequence[int]) -> Iterator[Specimen]:
    """Yield whiskers for all combinations of parameters."""
    check_keys(stated, {"prefix", *PARAMETERS}, "a grid")
    names = [name for name in PARAMETERS if name in stated]
    values = [_numbers(name, stated[name]) for name in names]
    _check_count(math.prod(map(len, values)))
    for row in itertools.product(*values):
        yield _formula(dict(zip(names, row, strict=True)), str(stated.get("prefix", "")))


def _random(stated: Mapping[str, Any], folder: Path, seed: Sequence[int]) -> Iterator[Specimen]:
    """Yield whiskers with random parameters between bounds."""
    check_keys(stated, {"prefix", "count", "logarithmic", *PARAMETERS}, "a random population")
    count = stated.get("count")
    if not isinstance(count, int) or isinstance(count, bool) or count < 1:
        raise ValueError(f"count is {count!r}; a whole number from 1 is needed")
    _check_count(count)
    logarithmic = _words("logarithmic", stated.get("logarithmic", []))
    if unknown := sorted(set(logarithmic) - set(PARAMETERS)):
        raise ValueError(f"logarithmic names {', '.join(unknown)}; known: {', '.join(PARAMETERS)}")
    generator = np.random.default_rng(list(seed))
    columns = {}
    for name in PARAMETERS:
        if name not in stated:
            continue
        bounds = _numbers(name, stated[name])
        if len(bounds) > 2 or bounds[0] > bounds[-1]:
            raise ValueError(f"{name} is {stated[name]!r}; a number or [least, largest] is needed")
        low, high = bounds[0], bounds[-1]
        share = generator.random(count)
        if name in logarithmic:
            if low <= 0.0:
                raise ValueError(f"{name} is logarithmic; its bounds {bounds} must be positive")
            columns[name] = low * (high / low) ** share
        else:
            columns[name] = low + (high - low) * share
    digits = len(str(count - 1))
    prefix = str(stated.get("prefix", "random "))
    for i in range(count):
        row = {name: float(column[i]) for name, column in columns.items()}
        yield _formula(row, "", f"{prefix}{i:0{digits}d}")


def _files(stated: Mapping[str, Any], folder: Path, seed: Sequence[int]) -> Iterator[Specimen]:
    """Yield digitised whiskers, one per file."""
    check_keys(stated, {"prefix", "files", "base_radius", "youngs_modulus"}, "files")
    pattern = stated.get("files")
    if not isinstance(pattern, str):
        raise ValueError(f"files is {pattern!r}; a pattern such as 'whiskers/*.csv' is needed")
    # The folder's own name may contain brackets, which are not part of the pattern.
    paths = sorted(folder / name for name in glob(pattern, root_dir=folder, recursive=True))
    paths = [path for path in paths if path.is_file()]
    if not paths:
        raise ValueError(f"no file is called {folder / pattern}")
    prefix, changes = str(stated.get("prefix", "")), {}
    for name in [one for one in ("base_radius", "youngs_modulus") if one in stated]:
        values = _numbers(name, stated[name])
        if len(values) > 1:
            raise ValueError(f"{name} is {stated[name]!r}; for files one number is needed")
        changes[name] = values[0] * PARAMETERS[name][1]
    for path in paths:
        content = _content(path)
        make = partial(_whisker_from_file, path.resolve(), changes, content)
        yield Specimen(f"{prefix}{path.stem}", {}, _hash([content, changes]), make)


def _array(stated: Mapping[str, Any], folder: Path, seed: Sequence[int]) -> Iterator[Specimen]:
    """Yield whiskers of an average rat's face."""
    check_keys(stated, {"prefix", "side", "rows", "columns", "names"}, "an array")
    choice = {key: value for key, value in stated.items() if key != "prefix"}
    choice.setdefault("side", "right")
    for name in ("rows", "names"):
        if not isinstance(choice.get(name, ""), str):
            _words(name, choice[name])
    if not isinstance(choice["side"], str):
        raise ValueError(f"side is {choice['side']!r}; right or left is needed")
    columns = choice.get("columns", [])
    if not isinstance(columns, list) or not all(type(one) is int for one in columns):
        raise ValueError(f"columns is {columns!r}; a list of whole numbers is needed")
    prefix = str(stated.get("prefix", ""))
    for name, whisker in whisker_array(**choice).items():
        identity = _hash(["array", choice["side"], name])
        yield Specimen(f"{prefix}{name}", {}, identity, partial(copy, whisker))


_KINDS: Mapping[str, Callable[..., Iterator[Specimen]]] = {
    "grid": _grid,
    "random": _random,
    "files": _files,
    "array": _array,
}


def _formula(stated: dict[str, float], prefix: str, name: str | None = None) -> Specimen:
    if stated.get("curvature", 0.0) and (stated.get("bend", 0.0) or stated.get("corkscrew", 0.0)):
        raise ValueError(
            "curvature is that of a parabola; it cannot be combined with bend or corkscrew"
        )
    whole = {key: stated.get(key, PARAMETERS[key][0]) for key in PARAMETERS}
    if name is None:
        varied = [f"{key.replace('_', ' ')} {value:g}" for key, value in stated.items()]
        name = prefix + (", ".join(varied) or "default")
    make = partial(_whisker_of_parameters, name, whole)
    return Specimen(name, whole, _hash(["formula", whole]), make)


def _whisker_of_parameters(name: str, stated: Mapping[str, float]) -> Whisker:
    """Construct a parabola or an arc."""
    value = {key: stated[key] * PARAMETERS[key][1] for key in PARAMETERS}
    length, bend, corkscrew = value["length"], value["bend"], value["corkscrew"]
    properties: dict[str, Any] = {
        "base_radius": value["base_radius"],
        "tip_radius": value["base_radius"] / value["taper_ratio"],
        "youngs_modulus": value["youngs_modulus"],
        "name": name,
    }
    if bend or corkscrew:

        def curvature(s: Any) -> Any:
            turned = corkscrew * np.asarray(s) / length
            rate = bend / length
            # Curvature about d2 bends toward +y at the base.
            return np.stack([0 * turned, -rate * np.sin(turned), rate * np.cos(turned)], -1)

        whisker = Whisker.from_curvature(length, curvature, **properties)
    elif value["curvature"]:
        whisker = Whisker.parabola(length, value["curvature"] / length, **properties)
    else:
        whisker = Whisker.straight(length, **properties)
    return whisker if value["trim"] == 1.0 else whisker.trimmed(value["trim"] * length)


def _whisker_from_file(path: Path, changes: Mapping[str, Any], content: str) -> Whisker:
    """Read a whisker from a file, which must have the same contents as when the study was read."""
    if _content(path) != content:
        raise ValueError(f"{path} was changed while the study ran: run it again")
    whisker = load_whisker(path)
    return whisker.with_properties(**changes) if changes else whisker


def _check_count(count: int) -> None:
    if count > _MOST:
        raise ValueError(f"these are {count:.3g} whiskers; a study can have {_MOST:g}")


def _words(name: str, value: Any, empty: bool = True) -> list[str]:
    words = isinstance(value, list) and all(isinstance(one, str) for one in value)
    if not words or not (value or empty):
        raise ValueError(f"{name} is {value!r}; a list of words is needed")
    return list(value)


def _numbers(name: str, value: Any) -> list[float]:
    """Numbers of a parameter, checked against its bounds."""
    values = value if isinstance(value, list) else [value]
    least = PARAMETERS[name][2]
    for one in values:
        if (
            isinstance(one, bool)
            or not isinstance(one, int | float)
            or not abs(one) <= sys.float_info.max
        ):
            raise ValueError(f"{name} is {value!r}; a number or a list of numbers is needed")
        if one <= least:
            raise ValueError(f"{name} is {one!r}; it must be above {least:g}")
        if name == "trim" and one > 1.0:
            raise ValueError(f"trim is {one!r}; it is the share that is kept, at most 1")
    if not values:
        raise ValueError(f"{name} is an empty list")
    return [float(one) for one in values]


def _content(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _hash(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, default=float)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
