"""Whiskers of a study: each a name, numbers that describe it, and how it is made.

A study may have thousands: a `Specimen` is a few numbers, and its whisker is made when it is
needed.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vibrissa.io import check_keys
from vibrissa.whisker import Whisker, whisker_array

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
"""Parameters of a grid or a random population: default, factor to SI units, exclusive minimum.

``curvature`` is A·L of the parabola y = A x². ``bend`` instead turns the tangent at a constant
rate by so many degrees from base to tip, and ``corkscrew`` turns the plane of bending by so many.
``trim`` is the share of the length that is left, the radius being what it was.
"""


_MOST = 10_000_000
"""Largest number of whiskers: the calling process holds them all, 2.5 kB each."""


@dataclass(frozen=True)
class Specimen:
    """A whisker that can be made."""

    name: str
    parameters: Mapping[str, float]
    identity: str
    make: Callable[[], Whisker]
    group: str = ""


def population(tables: Sequence[Any], folder: Path, seed: int) -> list[Specimen]:
    """List the whiskers of a study."""
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
    """All combinations of values."""
    check_keys(stated, {"prefix", *PARAMETERS}, "a grid")
    names = [name for name in PARAMETERS if name in stated]
    values = [_numbers(name, stated[name]) for name in names]
    _check_count(math.prod(map(len, values)))
    for row in itertools.product(*values):
        yield _formula(dict(zip(names, row, strict=True)), str(stated.get("prefix", "")))


def _random(stated: Mapping[str, Any], folder: Path, seed: Sequence[int]) -> Iterator[Specimen]:
    """Values drawn between bounds."""
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
    """Digitised whiskers, one a file."""
    check_keys(stated, {"prefix", "files", "base_radius", "youngs_modulus"}, "files")
    pattern = stated.get("files")
    if not isinstance(pattern, str):
        raise ValueError(f"files is {pattern!r}; a pattern such as 'whiskers/*.csv' is needed")
    path = folder / pattern
    root = Path(path.anchor) if path.anchor else Path()
    rest = str(path.relative_to(root))
    paths = sorted(path for path in root.glob(rest) if path.is_file())
    if not paths:
        raise ValueError(f"no file is called {path}")
    prefix = str(stated.get("prefix", ""))
    changes = {
        name: _numbers(name, stated[name])[0] * PARAMETERS[name][1]
        for name in ("base_radius", "youngs_modulus")
        if name in stated
    }
    for path in paths:
        identity = _hash([hashlib.sha256(path.read_bytes()).hexdigest(), changes])
        yield Specimen(f"{prefix}{path.stem}", {}, identity, _FromFile(path.resolve(), changes))


def _array(stated: Mapping[str, Any], folder: Path, seed: Sequence[int]) -> Iterator[Specimen]:
    """Whiskers of an average rat's face."""
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
        yield Specimen(f"{prefix}{name}", {}, identity, _Made(whisker))


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
    return Specimen(name, whole, _hash(["formula", whole]), _Formula(name, whole))


@dataclass(frozen=True)
class _Formula:
    """Makes a parabola or an arc."""

    name: str
    stated: Mapping[str, float]

    def __call__(self) -> Whisker:
        value = {key: self.stated[key] * PARAMETERS[key][1] for key in PARAMETERS}
        length, bend, corkscrew = value["length"], value["bend"], value["corkscrew"]
        properties: dict[str, Any] = {
            "base_radius": value["base_radius"],
            "tip_radius": value["base_radius"] / value["taper_ratio"],
            "youngs_modulus": value["youngs_modulus"],
            "name": self.name,
        }
        if bend or corkscrew:

            def curvature(s: Any) -> Any:
                turned = corkscrew * np.asarray(s) / length
                rate = bend / length
                # About d2: it bends toward +y at the base.
                return np.stack([0 * turned, -rate * np.sin(turned), rate * np.cos(turned)], -1)

            whisker = Whisker.from_curvature(length, curvature, **properties)
        elif value["curvature"]:
            whisker = Whisker.parabola(length, value["curvature"] / length, **properties)
        else:
            whisker = Whisker.straight(length, **properties)
        return whisker if value["trim"] == 1.0 else whisker.trimmed(value["trim"] * length)


@dataclass(frozen=True)
class _FromFile:
    """Reads a whisker."""

    path: Path
    changes: Mapping[str, float]

    def __call__(self) -> Whisker:
        from vibrissa.io import load_whisker

        whisker = load_whisker(self.path)
        return whisker.with_properties(**self.changes) if self.changes else whisker  # type: ignore[arg-type]


@dataclass(frozen=True)
class _Made:
    """Returns a whisker that is made already."""

    whisker: Whisker

    def __call__(self) -> Whisker:
        return self.whisker


def _check_count(count: int) -> None:
    if count > _MOST:
        raise ValueError(f"these are {count:.3g} whiskers; a study can have {_MOST:g}")


def _words(name: str, value: Any) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(one, str) for one in value):
        raise ValueError(f"{name} is {value!r}; a list of words is needed")
    return value


def _numbers(name: str, value: Any) -> list[float]:
    """One number or several of a parameter, within its bounds."""
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
            raise ValueError(f"trim is {one!r}; it is the share that is left, at most 1")
    if not values:
        raise ValueError(f"{name} is an empty list")
    return [float(one) for one in values]


def _hash(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, default=float)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
