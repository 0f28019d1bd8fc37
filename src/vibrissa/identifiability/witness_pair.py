"""The two whiskers of a witness: a pair of contacts that have the same signals, bent again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.rod import STEPS, Deflection, PointForce, deflect
from vibrissa.signals import base_signals
from vibrissa.whisker import Whisker

_NODES = 101
_AGREE = 1e-6
"""Largest difference of a saved witness's signals from those of the whisker."""

_NEEDED = {"witness_arc_length", "witness_contact_force", "witness_separation"}


def witness_pairs(
    whisker: Whisker, verdicts: xr.Dataset, triplets: Iterable[str]
) -> Iterator[tuple[str, xr.Dataset]]:
    """Bend a whisker into the farthest pair of contacts with the same signals, for some triplets.

    Parameters
    ----------
    whisker : Whisker
        The whisker that the verdicts are of.
    verdicts : xarray.Dataset
        Verdicts with witnesses, of `uniqueness`.
    triplets : iterable of str
        Names of the triplets that are wanted; those without a witness are left out.

    Yields
    ------
    str
        Name of the triplet.
    xarray.Dataset
        Dims pair, node, space: ``rest`` and ``centerline`` of both whiskers, ``contact_point``,
        ``force``, ``arc_length`` and the six signals.

    Raises
    ------
    ValueError
        If the verdicts are of another whisker.
    """
    if not set(verdicts.data_vars) >= _NEEDED:
        return
    known = set(map(str, verdicts["triplet"].values))
    for triplet in dict.fromkeys(triplets):
        if triplet not in known:
            continue
        found = verdicts.sel(triplet=triplet)
        if "all" in found["region"].values:
            found = found.sel(region=["all"])
        apart = found["witness_separation"].transpose("region", "witness").values
        if np.isfinite(apart).any():
            region, witness = np.unravel_index(np.nanargmax(apart), apart.shape)
            yield triplet, _bent(whisker, found.isel(region=int(region), witness=int(witness)))


def _bent(whisker: Whisker, witness: xr.Dataset) -> xr.Dataset:
    """The two whiskers of one witness."""
    force = witness["witness_contact_force"].transpose("pair", "component").values
    components = np.column_stack([np.zeros(2), force])
    load = PointForce(witness["witness_arc_length"].values, components=components)
    bent = deflect(whisker, load, steps=int(witness.get("witness_steps", STEPS)))
    signals = base_signals(bent.force, bent.moment)
    triplet = str(witness["triplet"].item())
    if "witness_signals" in witness:
        _check_whisker(bent, signals, triplet, witness["witness_signals"].values)
    data = xr.Dataset(
        {
            "rest": (("node", "space"), whisker.centerline(_NODES)),
            "centerline": (("pair", "node", "space"), bent.centerline(_NODES)),
            "contact_point": (("pair", "space"), bent.contact_point),
            "force": (("pair", "space"), bent.force),
            "arc_length": ("pair", bent.arc_length),
        },
        attrs={"triplet": triplet},
    )
    return data.assign({name: ("pair", values.values) for name, values in signals.items()})


def _check_whisker(
    bent: Deflection, signals: xr.Dataset, triplet: str, saved: NDArray[np.float64]
) -> None:
    """Raise unless the first contact has the signals here that it had in the verdicts."""
    names = triplet.split()
    here = np.array([signals[name].values[0] for name in names])
    force, moment = (float(np.linalg.norm(v[0])) for v in (bent.force, bent.moment))
    sizes = {"Fx": force, "FT": force, "Mx": moment, "MB": moment}
    gap = [
        abs(a - b) / sizes[name] if name in sizes else abs(np.angle(np.exp(1j * (a - b))))
        for name, a, b in zip(names, here, saved, strict=True)
    ]
    if not np.max(gap) < _AGREE:  # also where the whisker holds no such contact
        raise ValueError(
            f"the verdicts are not of this map's whisker: for ({triplet}) the first contact of a "
            f"witness has the signals {here} here, and {saved} where the verdicts were made"
        )
