"""Variables of consecutive frames without xarray, whose import takes longer than a short table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from vibrissa.deferred import xr
from vibrissa.numerics import AnyArray

if TYPE_CHECKING:
    import xarray

# Change of the contact force by inertia that was removed from signals, and its covariance.
CHANGE = ("contact_force_change", "contact_force_change_covariance")
# Changes of the wrench and of the contact force by errors of that correction in all frames.
INERTIA = ("wrench_inertia", "contact_force_inertia")


@dataclass(frozen=True)
class Frames:
    """Variables over time, as in a dataset: dimensions, values and attributes by name."""

    variables: Mapping[str, tuple[Any, ...]]
    attrs: Mapping[str, Any] = field(default_factory=dict)

    def __contains__(self, name: object) -> bool:
        return name in self.variables

    def __getitem__(self, name: str) -> AnyArray:
        return np.asarray(self.variables[name][1])

    def get(self, name: str) -> AnyArray | None:
        """Values of a variable; None if it is missing."""
        return np.asarray(self.variables[name][1]) if name in self else None

    def assign(self, variables: Mapping[str, tuple[Any, ...]]) -> Frames:
        """Add or replace variables."""
        return Frames({**self.variables, **variables}, self.attrs)

    def to_dataset(self) -> xr.Dataset:
        """Label the variables by xarray."""
        data = {**self.variables}
        return xr.Dataset(data, {"time": data.pop("time"), "space": list("xyz")}, self.attrs)


#: Both kinds of variables over time: what is computed from one kind is of the same kind.
Labelled = TypeVar("Labelled", Frames, "xarray.Dataset")
