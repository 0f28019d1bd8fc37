"""Tasks of a study, each of which computes the same few numbers for any whisker.

A task is a function of a whisker, settings and a seed that returns a dataset, whose dimensions and
coordinates depend on the settings only. Words are stored as CF flags.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import xarray as xr
from scipy.interpolate import CubicSpline

from vibrissa.certificates import certify, smallest_cone
from vibrissa.contacts import ContactMap, estimate_from_wrench
from vibrissa.identifiability import best_triplet, uniqueness
from vibrissa.numerics import Array
from vibrissa.quantities import attributes
from vibrissa.rod import PointForce, deflect
from vibrissa.sensors import FORCE_NOISE, MOMENT_NOISE
from vibrissa.signals import REGIONS, SIGNALS, TRIPLETS, base_signals, selection
from vibrissa.status import Status
from vibrissa.whisker import Whisker

Settings = Mapping[str, Any]

PAPERS = ("Fx MB MD", "Mx MB MD", "Fx FD MD")  # the triplets that the paper found unique
VERDICTS = ("unique", "unique off a surface", "not unique")
PROOFS = ("proved", "refused", "not finished")
_MICRO = 1e-6
_MOST = 10_000_000  # largest number of samples per whisker, limited by memory
_STATIONS = np.linspace(0.3, 1.0, 15)


@dataclass(frozen=True)
class Task:
    """Definition of a task: its function, default settings, and estimates of time and size."""

    run: Callable[[Whisker, Settings, int], xr.Dataset]
    defaults: Settings
    seconds: Callable[[Settings], float]
    numbers: Callable[[Settings], int]


def settings_of(stated: Mapping[str, Any], where: str) -> tuple[str, Settings]:
    """Validated kind and settings of a task."""
    kind = stated.get("kind")
    if not isinstance(kind, str) or kind not in TASKS:
        raise ValueError(f"{where}: kind is {kind!r}; one of {', '.join(TASKS)} is needed")
    task = TASKS[kind]
    own = {key: value for key, value in stated.items() if key not in ("kind", "name")}
    if unknown := sorted(set(own) - set(task.defaults)):
        allowed = ", ".join(task.defaults) or "nothing"
        raise ValueError(f"{where} sets {', '.join(unknown)}; settings of {kind} are: {allowed}")
    settings = {**task.defaults, **own}
    try:
        _check(settings)
    except (TypeError, ValueError, AttributeError, OverflowError) as fault:
        raise ValueError(f"{where}: {fault}") from None
    return kind, settings


def _map_summary(whisker: Whisker, settings: Settings, seed: int) -> xr.Dataset:
    """Extents of the reachable space and of the signals."""
    data = ContactMap.simulate(whisker, grid=False).to_dataset()
    names = ("r", "theta", "phi", *SIGNALS)
    out = {}
    for name in names:
        for end, value in (("least", data[name].min()), ("largest", data[name].max())):
            out[f"{name}_{end}"] = ((), float(value), attributes(name))
    # The logarithm of the force is smooth, so that it can be interpolated between stations.
    least = np.log(np.nanmin(_fold_forces(data), axis=1))
    slip = np.exp(CubicSpline(data["station"].values, least)(_STATIONS))
    about = {"units": "N", "long_name": "least force at which the whisker slips off"}
    at = {"units": "1", "long_name": "arc length of the contact over the whisker's"}
    return xr.Dataset(
        {**out, "slip_force": ("station", slip, about)}, {"station": ("station", _STATIONS, at)}
    )


def _uniqueness(whisker: Whisker, settings: Settings, seed: int) -> xr.Dataset:
    """Uniqueness verdicts with the numbers on which they are based."""
    found = uniqueness(
        ContactMap.simulate(whisker, grid=False),
        _triplets(settings),
        list(settings["regions"]),
        cone=np.radians(float(settings["cone"])),
        samples=int(settings["samples"]),
        resolution=bool(settings["resolution"]),
        seed=seed,
    )
    kept = ["critical_cone", "twin_share", "minority_share"]
    if settings["resolution"]:
        kept.append("ambiguous_share")
    out = found[kept].assign(verdict=_flags(found["verdict"], VERDICTS))
    return out.drop_vars([name for name in out.coords if name not in out.dims])


def _flags(words: xr.DataArray, known: tuple[str, ...]) -> xr.DataArray:
    """Convert words to CF flags, -1 for unknown words."""
    codes = np.select([words.values == word for word in known], range(len(known)), -1)
    meanings = " ".join(word.replace(" ", "_") for word in known)
    flags = {"flag_values": np.arange(len(known), dtype=np.int8), "flag_meanings": meanings}
    return words.copy(data=codes.astype(np.int8)).assign_attrs(flags)


def _certificate(whisker: Whisker, settings: Settings, seed: int) -> xr.Dataset:
    """Proved uniqueness of (Fx, MB, MD) outside a cone; a cone of 0 selects the smallest one."""
    contact_map, path = ContactMap.simulate(whisker, grid=False), None
    cone = float(np.radians(settings["cone"])) or smallest_cone(contact_map)
    if not np.isfinite(cone):
        raise ValueError("on a grid no cone makes all signs right that a proof needs")
    if settings["folder"]:
        path = Path(settings["folder"]) / f"{seed}-{float(settings['cone']):g}.nc"
        path.parent.mkdir(parents=True, exist_ok=True)
    found = certify(contact_map, cone, path=path, seconds=60.0 * settings["minutes"])
    state = PROOFS[0 if found.proved else 1 if found.refuted else 2]
    boxes = float(sum(len(part.certified) for part in found.parts.values()))
    out = {
        "cone": ((), found.cone, {"units": "rad", "long_name": "cone that is left out"}),
        "share": ((), found.share, {"units": "1", "long_name": "share that is certain"}),
        "boxes": ((), boxes, {"units": "1", "long_name": "boxes on which signs are certain"}),
    }
    about = {"long_name": "how far (Fx, MB, MD) is proved to be unique"}
    return xr.Dataset(out).assign(proof=_flags(xr.DataArray(state, attrs=about), PROOFS))


def _sensitivity(whisker: Whisker, settings: Settings, seed: int) -> xr.Dataset:
    """Errors of contact points due to a sensor's noise, for each triplet."""
    found = best_triplet(
        ContactMap.simulate(whisker, grid=False), _noise(settings), triplets=_triplets(settings)
    )
    return found[["median_error", "determined", "share"]].drop_vars(
        [name for name in found.coords if name != "triplet"], errors="ignore"
    )


def _estimation(whisker: Whisker, settings: Settings, seed: int) -> xr.Dataset:
    """Errors of contacts estimated from noisy signals."""
    contact_map = ContactMap.simulate(whisker, grid=False)
    s, load = _some_contacts(contact_map, int(settings["contacts"]), seed)
    bent = deflect(whisker, PointForce(s, components=tuple(load)))
    noise = _noise(settings)
    generator = np.random.default_rng(seed + 1)
    scatter = generator.multivariate_normal(np.zeros(6), noise, size=len(s))
    measured = np.concatenate([bent.force, bent.moment], axis=-1) + scatter
    force, moment = measured[:, :3], measured[:, 3:]
    sets = _sets(settings)
    rows = []
    for names in sets:
        if names == "wrench":
            found: Any = estimate_from_wrench(whisker, force, moment, noise=noise)
        else:
            found = contact_map.estimate(
                base_signals(force, moment), tuple(names.split()), noise=noise
            )
        error = np.linalg.norm(found.point - bent.contact_point, axis=-1)
        predicted = np.sqrt(np.einsum("nii->n", found.covariance))
        rows.append(
            [
                *_quantiles(error),
                _quantiles(predicted)[0],
                float(np.isfinite(error).mean()),
                float((found.status == Status.UNIQUE).mean()),
            ]
        )
    columns = ("median_error", "error_95", "predicted_rms", "found_share", "unique_share")
    return _table(columns, rows, "signals", list(sets))


def _friction(whisker: Whisker, settings: Settings, seed: int) -> xr.Dataset:
    """Errors if friction, fully mobilised along the whisker, is neglected in the estimate."""
    contact_map = ContactMap.simulate(whisker, grid=False)
    s, (_, fy, fz) = _some_contacts(contact_map, int(settings["contacts"]), seed)
    across = np.hypot(fy, fz)
    sign = np.random.default_rng(seed + 1).choice([-1.0, 1.0], size=len(s))
    rows = []
    for mu in settings["friction"]:
        bent = deflect(whisker, PointForce(s, components=(mu * sign * across, fy, fz)))
        found = contact_map.estimate(
            base_signals(bent.force, bent.moment), selection(settings["triplet"], exactly=3)
        )
        whole = estimate_from_wrench(whisker, bent.force, bent.moment)
        error = np.linalg.norm(found.point - bent.contact_point, axis=-1)
        of_wrench = np.linalg.norm(whole.point - bent.contact_point, axis=-1)
        rows.append(
            [*_quantiles(error), float(np.isfinite(error).mean()), _quantiles(of_wrench)[0]]
        )
    columns = ("median_error", "error_95", "found_share", "wrench_median_error")
    return _table(columns, rows, "friction", [float(mu) for mu in settings["friction"]])


def _some_contacts(contact_map: ContactMap, count: int, seed: int) -> tuple[Array, Array]:
    """Arc lengths (n,) and material forces (3, n) of contacts spread over the reachable space."""
    data = contact_map.to_dataset()
    fold = _fold_forces(data)
    generator = np.random.default_rng(seed)
    i = generator.integers(1, data.sizes["station"], count)
    j = generator.integers(0, data.sizes["bearing"], count)
    share = generator.uniform(0.05, 0.9, count)
    size = share**2 * fold[i, j]
    bearing = data["bearing"].values[j]
    s = data["station"].values[i] * contact_map.whisker.length
    zero = np.zeros(count)
    return s, np.stack([zero, size * np.cos(bearing), size * np.sin(bearing)])


def _fold_forces(data: xr.Dataset) -> Array:
    """Force (station, bearing) at which the whisker slips off, N."""
    force = data["force"].transpose("station", "bearing", "load", "space").values
    return np.asarray(np.linalg.norm(force[:, :, -1], axis=-1))


def _quantiles(values: Array) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    if not known.size:
        return np.nan, np.nan
    median, high = np.percentile(known, [50.0, 95.0])
    return float(median), float(high)


def _table(
    columns: Sequence[str], rows: Sequence[Sequence[float]], dim: str, labels: Sequence[Any]
) -> xr.Dataset:
    values = np.array(rows, dtype=np.float64)
    data = {}
    for k, name in enumerate(columns):
        units = "1" if name.endswith("share") else "m"
        about = {"units": units, "long_name": name.replace("_", " ")}
        data[name] = (dim, values[:, k], about)
    return xr.Dataset(data, {dim: labels})


def _triplets(settings: Settings) -> list[str]:
    if settings["triplets"] == "all":
        return [" ".join(triplet) for triplet in TRIPLETS]
    return _several(settings, "triplets", lambda one: " ".join(selection(one, exactly=3)))


def _sets(settings: Settings) -> list[str]:
    return _several(
        settings, "signals", lambda one: one if one == "wrench" else " ".join(selection(one))
    )


def _several(
    settings: Settings, name: str, spelt: Callable[[Any], Any] = lambda one: one
) -> list[Any]:
    """Items of a list, spelt in one way, without repetitions."""
    value = settings[name]
    items = [spelt(one) for one in value] if isinstance(value, list | tuple) else []
    if not items or len(set(items)) < len(items):
        raise ValueError(f"{name} is {value!r}; a list without repetitions is needed")
    return items


def _noise(settings: Settings) -> Array:
    sigma = np.repeat([settings["force_noise"] * _MICRO, settings["moment_noise"] * _MICRO], 3)
    return np.diag(sigma**2)


def _check(settings: Settings) -> None:
    """Validate settings."""
    for name in settings:
        if name in _BOUNDS:
            _check_number(settings, name, *_BOUNDS[name])
        elif name in _READ:
            _READ[name](settings)
    known = (*REGIONS,)
    if unknown := [one for one in settings.get("regions", ()) if one not in known]:
        raise ValueError(f"regions has {unknown[0]!r}; known are {', '.join(known)}")
    for name, kind, needed in (
        ("resolution", bool, "true or false"),
        ("folder", str, "a path, or nothing,"),
    ):
        if not isinstance(settings.get(name, kind()), kind):
            raise ValueError(f"{name} is {settings[name]!r}; {needed} is needed")
    values = settings.get("friction", ())
    if not all(isinstance(mu, int | float) and 0.0 <= mu < np.inf for mu in values):
        raise ValueError(f"friction is {tuple(values)!r}; a list of coefficients from 0 is needed")


def _check_number(settings: Settings, name: str, least: float, most: float = np.inf) -> None:
    value = settings[name]
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not (least <= value <= most and value < np.inf):
        upto = f" to {most:g}" if most < np.inf else ""
        raise ValueError(f"{name} is {value!r}; a number from {least:g}{upto} is needed")
    if name in _SENSOR and 0.0 < value < _FAINT * _SENSOR[name]:
        raise ValueError(f"{name} is {value!r}, smaller than any sensor's: it is in µN or µN·m")


# Smallest and largest values of numbers.
_BOUNDS = {
    **dict.fromkeys(("minutes", "force_noise", "moment_noise"), (0.0, np.inf)),
    "cone": (0.0, 89.0),
    "samples": (16, _MOST),
    "contacts": (1, _MOST),
}
# Functions that parse a setting and raise ValueError if it is not valid.
_READ: Mapping[str, Callable[[Settings], object]] = {
    "triplets": _triplets,
    "signals": _sets,
    "triplet": lambda settings: selection(settings["triplet"], exactly=3),
    "regions": lambda settings: _several(settings, "regions"),
    "friction": lambda settings: _several(settings, "friction"),
}

# Noise of a sensor, µN and µN·m, and the share of it below which it is probably in other units.
_FAINT = 1e-4
_SENSOR = {"force_noise": FORCE_NOISE / _MICRO, "moment_noise": MOMENT_NOISE / _MICRO}

TASKS: Mapping[str, Task] = MappingProxyType(
    {
        "map": Task(_map_summary, {}, lambda settings: 0.3, lambda settings: 33),
        "uniqueness": Task(
            _uniqueness,
            {
                "triplets": PAPERS,
                "regions": ("all",),
                "cone": 2.0,
                "samples": 1024,
                "resolution": True,
            },
            # Measured with one core, 512 to 4096 samples.
            lambda settings: (
                0.7
                + (1.6 if settings["resolution"] else 0.6)
                * len(_triplets(settings))
                * math.sqrt(len(settings["regions"]))
            ),
            lambda settings: (
                (8 if settings["resolution"] else 4)
                * len(_triplets(settings))
                * len(settings["regions"])
            ),
        ),
        "certificate": Task(
            _certificate,
            {"cone": 0.0, "minutes": 30.0, "folder": ""},
            lambda settings: min(60.0 * settings["minutes"], 300.0),
            lambda settings: 4,
        ),
        "sensitivity": Task(
            _sensitivity,
            {"triplets": PAPERS, **_SENSOR},
            lambda settings: 0.5,
            lambda settings: 3 * len(_triplets(settings)),
        ),
        "estimation": Task(
            _estimation,
            {"signals": ("Fx MB MD", "wrench"), "contacts": 1000, **_SENSOR},
            lambda settings: 0.5 + 1e-4 * settings["contacts"] * len(settings["signals"]),
            lambda settings: 5 * len(settings["signals"]),
        ),
        "friction": Task(
            _friction,
            {"triplet": "Fx MB MD", "friction": (0.0, 0.1, 0.3, 0.5), "contacts": 1000},
            lambda settings: 0.5 + 1e-4 * settings["contacts"] * len(settings["friction"]),
            lambda settings: 4 * len(settings["friction"]),
        ),
    }
)
