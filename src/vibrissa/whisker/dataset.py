"""Conversion of a whisker to and from a labelled dataset, without loss.

Curvature and radius are stored as their polynomials, Σ c_k τ^k with τ ∈ [−1, 1] on each interval,
so that what is read back equals what was written to the last bit. Centreline and radius at 101
equally spaced points are included for other tools; a file in which one of them is missing, or
contradicts the polynomials, has been modified and is rejected.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from vibrissa.deferred import xr
from vibrissa.numerics import Array
from vibrissa.quantities import attributes
from vibrissa.whisker.pose import Pose
from vibrissa.whisker.profile import Profile

NODES = 101  # points of the stored centreline
_PROFILE = ("knots", "coefficients", "error")  # variables of a profile


def whisker_dataset(whisker: Any) -> xr.Dataset:
    """Convert a whisker to a dataset."""
    bending, twist = whisker.base_stiffness or (np.inf, np.inf)
    s = np.linspace(0.0, whisker.length, NODES)
    known: dict[str, tuple[tuple[str, ...], object]] = {
        "length": ((), whisker.length),
        "youngs_modulus": ((), whisker.youngs_modulus),
        "poisson_ratio": ((), whisker.poisson_ratio),
        "base_bending_stiffness": ((), bending),
        "base_twist_stiffness": ((), twist),
        "arc_length": (("node",), s),
        "centerline": (("node", "space"), whisker.position(s)),
        "radius": (("node",), whisker.radius(s)),
        "pose_rotation": (("source_axis", "whisker_axis"), whisker.pose.rotation),
        "pose_origin": (("source_axis",), whisker.pose.origin),
        "breaks": (("break",), np.array(whisker.breaks, dtype=np.float64)),
    }
    if whisker.density is not None:
        known["density"] = ((), whisker.density)
    known |= _profile_parts("curvature", whisker.intrinsic_curvature)
    known |= _profile_parts("section", whisker.section_radius)
    variables = {
        name: xr.Variable(dims, np.asarray(values), attributes(name))
        for name, (dims, values) in known.items()
    }
    labels = {
        "source_axis": ["x", "y", "z"],
        "whisker_axis": ["x", "y", "z"],
        "space": ["x", "y", "z"],
        "curvature_component": ["twist", "about d1", "about d2"],
    }
    about = {
        "kind": "vibrissa whisker",
        "name": whisker.name,
        "notes": json.dumps(whisker.notes, ensure_ascii=False),
    }
    return xr.Dataset(variables, labels, about)


def _profile_parts(name: str, profile: Profile) -> dict[str, tuple[tuple[str, ...], object]]:
    """Variables of one profile."""
    dims = (f"{name}_power", f"{name}_interval", *((f"{name}_component",) * len(profile.shape)))
    return {
        f"{name}_knots": ((f"{name}_knot",), profile.knots),
        f"{name}_coefficients": (dims, profile.coefficients),
        f"{name}_error": ((), profile.error),
    }


def _profile(value: Mapping[str, Array], name: str) -> Profile:
    """Profile from its variables."""
    knots, coefficients, error = (value[f"{name}_{part}"] for part in _PROFILE)
    return Profile(knots, coefficients, float(error))


class Stored(Protocol):
    """Contents of a whisker's file: a dataset, or an object with plain arrays."""

    @property
    def variables(self) -> Mapping[Any, Any]:
        """Arrays by name."""

    @property
    def attrs(self) -> Mapping[Any, Any]:
        """Attributes by name."""


def check_centerline(dataset: Stored, whisker: Any) -> None:
    """Raise a ValueError if a file's centreline or radius contradict its polynomials."""
    if dataset.variables.keys().isdisjoint(_REDUNDANT):
        return
    s, line, radius = (np.asarray(dataset.variables[name], dtype=np.float64) for name in _REDUNDANT)
    if s.ndim == 1 and line.shape == (*s.shape, 3) and radius.shape == s.shape:
        inside = (s >= 0.0).all() and (s <= whisker.length * (1.0 + _TOLERANCE)).all()
        s = np.minimum(s, whisker.length)
        drawn = {"centerline": (line, whisker.position), "radius": (radius, whisker.radius)}
        if inside and all(
            np.abs(stored - own(s)).max() <= _TOLERANCE * np.abs(own(s)).max()
            for stored, own in drawn.values()
        ):
            return
    raise ValueError(
        "this dataset of a whisker was changed: centerline and radius at arc_length are not those "
        "of its curvature and section coefficients, which define the whisker; create a new one "
        "from points (Whisker.from_points) instead of changing the file"
    )


# Variables that the polynomials determine, and the tolerance relative to their largest value.
_REDUNDANT = ("arc_length", "centerline", "radius")
_TOLERANCE = 1e-6


def whisker_fields(dataset: Stored) -> dict[str, Any]:
    """Read the fields of a `Whisker` from a dataset that `whisker_dataset` wrote."""
    needed = {"length", "youngs_modulus", "poisson_ratio", "breaks", "pose_rotation", "pose_origin"}
    needed |= {"base_bending_stiffness", "base_twist_stiffness"}
    needed |= {f"{name}_{part}" for name in ("curvature", "section") for part in _PROFILE}
    if not dataset.variables.keys().isdisjoint(_REDUNDANT):  # files of many whiskers omit them
        needed |= set(_REDUNDANT)
    if missing := sorted(needed - set(dataset.variables)):
        raise ValueError(f"this is not a dataset of a whisker: it lacks {', '.join(missing)}")
    value = {name: np.asarray(dataset.variables[name], dtype=np.float64) for name in needed}
    stiffness = float(value["base_bending_stiffness"]), float(value["base_twist_stiffness"])
    return {
        "length": float(value["length"]),
        "intrinsic_curvature": _profile(value, "curvature"),
        "section_radius": _profile(value, "section"),
        "youngs_modulus": float(value["youngs_modulus"]),
        "poisson_ratio": float(value["poisson_ratio"]),
        "density": (
            float(dataset.variables["density"]) if "density" in dataset.variables else None
        ),
        "base_stiffness": None if np.isinf(stiffness).all() else stiffness,
        "pose": Pose(value["pose_rotation"], value["pose_origin"]),
        "breaks": tuple(float(s) for s in value["breaks"]),
        "name": str(dataset.attrs.get("name", "whisker")),
        "notes": tuple(json.loads(dataset.attrs.get("notes", "[]"))),
    }
