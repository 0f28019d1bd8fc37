"""Contacts by the paper's methods, a look-up table or a network, for comparison.

Either gives one contact point for three signals. Its force, moment and arc length are those of the
exact contact at that point, and the misfit compares that contact's signals with the measured ones,
in shares of each signal's range. The covariance comes from central differences of the table or
network, steps of 0.05 % of each signal's range, as in the paper's sensitivity.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from weakref import WeakKeyDictionary

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.contacts import (
    Candidates,
    ContactMap,
    Contacts,
    Prior,
    SensorNoise,
    check_signals,
    contacts_of,
)
from vibrissa.numerics import Array
from vibrissa.paper.lookup import STEP, LookupTable
from vibrissa.paper.network import NetworkSolver, train_network
from vibrissa.rod import PointContact, deflect
from vibrissa.signals import (
    CIRCULAR,
    SIGNALS,
    circular_among,
    measured,
    selection,
    signal_scales,
    signals_of,
    within_turn,
)
from vibrissa.status import Status

#: Methods of estimating other than the exact one.
METHODS = ("lookup", "lookup-linear", "network")

#: Signals (n, 3), SI units, to contact points (n, 3), m.
Solver = Callable[[Array], Array]

# Tables and networks of each map that is alive, by kind and signals.
_made: WeakKeyDictionary[
    ContactMap, dict[tuple[str, tuple[str, ...]], LookupTable | NetworkSolver]
] = WeakKeyDictionary()


def estimate(
    contact_map: ContactMap,
    signals: xr.Dataset | Mapping[str, ArrayLike],
    using: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    *,
    method: str = "lookup",
    noise: Mapping[str, float] | ArrayLike | None = None,
    prior: Prior | None = None,
) -> Contacts:
    """Estimate contacts from three signals by the paper's look-up table or network.

    Parameters
    ----------
    contact_map : ContactMap
        Map of the whisker's contacts; with the paper's grid, for a look-up table.
    signals : Dataset or mapping
        Measured signals by name, SI units, any shape.
    using : str or tuple of str
        Three signals to use.
    method : {"lookup", "lookup-linear", "network"}
        Look-up table interpolated by natural neighbours or linearly, or a network. Either is made
        at the first use and kept as long as the map (the network: ten seconds).
    noise : mapping or (6, 6) array_like, optional
        Standard deviation of each signal, or covariance of (F, M), SI units; gives covariances.
    prior : Prior, optional
        Possible contacts; others get the status ``OUTSIDE_PRIOR``.

    Returns
    -------
    Contacts
        At most one candidate for each measurement. The status is ``APPROXIMATE``, as neither table
        nor network shows whether contacts are ambiguous; ``OUTSIDE_MAP`` outside the table;
        ``OUTSIDE_PRIOR``; or ``MISSING``. ``chi_squared`` is the largest difference between the
        signals of the contact given and those measured, in shares of their ranges.

    Raises
    ------
    ValueError
        If the method is not known, there are not three signals, the map has no grid to look up in,
        or signals or noise do not fit.
    """
    if method not in METHODS:
        known = ", ".join(repr(name) for name in METHODS)
        raise ValueError(f"method is one of {known}; got {method!r}")
    names = selection(using)
    if len(names) != 3:
        raise ValueError(
            f"a table or network takes three signals; got {len(names)}: {', '.join(names)}"
        )
    sensor = None if noise is None else SensorNoise.of(noise, names)
    values, dims, coords = measured(signals, names)
    check_signals(values, names)
    solve = _solver(contact_map, method, names)
    rows = values.reshape(-1, 3)
    point = solve(rows)
    chart = contact_map.chart
    load = PointContact(point)
    bent = deflect(contact_map.whisker, load, proximal=chart.proximal, steps=contact_map.steps)
    status = np.where(np.isfinite(point).all(axis=1), Status.APPROXIMATE, Status.OUTSIDE_MAP)
    status[~np.isfinite(rows).all(axis=1)] = Status.MISSING
    if prior is not None:
        rows_found = np.flatnonzero(status == Status.APPROXIMATE)
        contact = (array[rows_found] for array in (point, bent.arc_length, bent.contact_force))
        allowed = prior.allows(contact_map.whisker, *contact)
        status[rows_found[~allowed]] = Status.OUTSIDE_PRIOR
    found = status == Status.APPROXIMATE
    ranges = _ranges(contact_map, names)
    covariance = np.full((len(rows), 3, 3), np.nan)
    if sensor is not None:
        sigma = sensor.covariance(names, bent.force, bent.moment)
        slope = _differences(solve, rows, ranges)
        covariance = slope @ sigma @ np.swapaxes(slope, -1, -2)
    d, most = chart.discretization, Candidates.room(len(rows), 1)
    most.number[found] = 1
    most.x[found, 0, 0] = bent.arc_length[found] / d.length
    most.x[found, 0, 1:] = bent.contact_force[found] / d.force
    most.values[found, 0, :3] = bent.force[found] / d.force
    most.values[found, 0, 3:] = point[found] / d.length
    most.covariances[found, 0] = covariance[found] / d.length**2
    misfit = _misfit(rows, bent.force, bent.moment, names, ranges)
    most.chi_squared[found, 0] = misfit[found]
    return contacts_of(most, status, misfit, d, names, values.shape[:-1], dims, coords)


def _solver(contact_map: ContactMap, method: str, names: tuple[str, ...]) -> Solver:
    """The table or network of three signals, made if it is not there yet."""
    made = _made.setdefault(contact_map, {})
    key = (method.split("-", maxsplit=1)[0], names)
    if key not in made:
        make = train_network if method == "network" else LookupTable.of
        made[key] = make(contact_map, names)
    solver = made[key]
    if isinstance(solver, NetworkSolver):
        return solver
    return lambda signals: solver(signals, "natural" if method == "lookup" else "linear")


def _ranges(contact_map: ContactMap, names: tuple[str, ...]) -> Array:
    """Range of each signal over the map, SI units; of a direction, a turn."""
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
