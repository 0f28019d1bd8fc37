"""Contacts by the paper's ways, a table or a network, as estimates.

An approximation gives one contact point for three signals. Its force, moment and arc length are
those of the exact contact at that point, and the misfit is how far that contact's signals are from
the measured ones, in shares of each signal's range. The covariance comes from central differences
of the approximation, steps of 0.05 % of each signal's range, as in the paper's sensitivity.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import numpy as np

from vibrissa.contacts.explanation import Explanation
from vibrissa.contacts.noise import SensorNoise
from vibrissa.numerics import Array
from vibrissa.paper.differences import STEP
from vibrissa.paper.lookup import LookupTable
from vibrissa.paper.network import train_network
from vibrissa.rod import PointContact, deflect
from vibrissa.signals import (
    CIRCULAR,
    SIGNALS,
    circular_among,
    signal_scales,
    signals_of,
    within_turn,
)
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

#: Ways to estimate but the exact one.
Approximate = Literal["lookup", "lookup-linear", "network"]
APPROXIMATE: tuple[Approximate, ...] = ("lookup", "lookup-linear", "network")

#: Signals (n, 3), SI units, to contact points (n, 3), m.
Solver = Callable[[Array], Array]


def solver(contact_map: ContactMap, method: str, names: tuple[str, ...]) -> Solver:
    """Make what approximates contact points; the map keeps tables and networks."""
    kept = contact_map.approximations
    key = (method.split("-", maxsplit=1)[0], names)
    if method == "network":
        if key not in kept:
            kept[key] = train_network(contact_map, names)
        return kept[key]
    if key not in kept:
        kept[key] = LookupTable.of(contact_map, names)
    table = kept[key]
    assert isinstance(table, LookupTable)
    return lambda signals: table(signals, "natural" if method == "lookup" else "linear")


def by_approximation(
    method: str,
    contact_map: ContactMap,
    names: tuple[str, ...],
    targets: Array,
    sensor: SensorNoise | None,
) -> Explanation:
    """Find one contact for three signals by a table or a network."""
    if len(names) != 3:
        raise ValueError(
            f"a table or network takes three signals; got {len(names)}: {', '.join(names)}"
        )
    solve = solver(contact_map, method, names)
    d = contact_map.chart.discretization
    signals = targets * signal_scales(names, d.force, d.moment)
    point = solve(signals)
    found = np.asarray(np.isfinite(point).all(axis=1))
    bent = deflect(
        contact_map.whisker,
        PointContact(point),
        proximal=contact_map.chart.proximal,
        steps=contact_map.steps,
    )
    status = np.where(found, int(Status.APPROXIMATE), int(Status.OUTSIDE_MAP))
    status[~np.isfinite(targets).all(axis=1)] = int(Status.MISSING)
    covariances = np.full((len(targets), 3, 3), np.nan)
    if sensor is not None:
        sigma = sensor.covariance(names, bent.force, bent.moment)
        slope = _differences(solve, signals, _ranges(contact_map, names))
        covariances = slope @ sigma @ np.swapaxes(slope, -1, -2) / d.length**2
    return Explanation(
        number=np.where(found, 1, 0),
        contacts=np.concatenate(
            [bent.arc_length[:, None] / d.length, bent.contact_force / d.force], axis=1
        )[:, None],
        values=np.concatenate([bent.force / d.force, point / d.length], axis=1)[:, None],
        covariances=covariances[:, None],
        misfit=_misfit(signals, bent.force, bent.moment, names, _ranges(contact_map, names)),
        status=status,
        linear=np.zeros(len(targets), dtype=bool),
        probability=np.full((len(targets), 1), np.nan),
    )


def _ranges(contact_map: ContactMap, names: tuple[str, ...]) -> Array:
    """Of each signal over the map, SI units; of directions a turn."""
    d = contact_map.chart.discretization
    values = contact_map.chart.values.reshape(-1, 6)
    known = signals_of(values[:, :3], np.cross(values[:, 3:], values[:, :3]))
    which = [SIGNALS.index(name) for name in names]
    span = np.ptp(known[:, which], axis=0) * signal_scales(names, d.force, d.moment)
    return np.where([CIRCULAR[w] for w in which], 2.0 * np.pi, span)


def _differences(solve: Solver, signals: Array, ranges: Array) -> Array:
    """∂(contact point)/∂(signals), (n, 3, 3); NaN where a step leaves what is known."""
    out = np.empty((len(signals), 3, 3))
    for k in range(3):
        step = STEP * ranges[k] * np.eye(3)[k]
        with np.errstate(divide="ignore", invalid="ignore"):
            out[..., k] = (solve(signals + step) - solve(signals - step)) / (2.0 * step[k])
    return out


def _misfit(
    signals: Array, force: Array, moment: Array, names: tuple[str, ...], ranges: Array
) -> Array:
    which = [SIGNALS.index(name) for name in names]
    away = signals_of(force, moment)[:, which] - signals
    away = within_turn(away, circular_among(names))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.abs(away / ranges).max(axis=1))
