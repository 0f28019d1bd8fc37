"""Estimates of contacts: all that explain measured signals, each with its covariance.

Three signals T have as many unknowns ξ: every contact with T(ξ) = T is a candidate. More signals
are explained by weighted least squares, χ² = |T(ξ) - T|² in standard deviations. With noise, three
signals are treated in this way too: contacts on the boundary of T(Ω) explain signals that noise has
carried out of it. For noise of covariance Σ the covariance of the contact point is, to first order,
∂p/∂ξ (JᵀΣ⁻¹J)⁻¹ ∂p/∂ξᵀ with J = ∂T/∂ξ; see :mod:`~vibrissa.contacts.uncertainty.posterior`. A
covariance of force and moment is transformed to the signals by their derivatives. Fewer than three
signals leave a curve or a surface of contacts; see :mod:`~vibrissa.contacts.engine.ambiguity`.

Batches and single measurements pass through the same compiled kernels
(:mod:`~vibrissa.contacts.engine.candidates`). Each is searched for in the whole map, so that no
candidate is missed by searching only near the last one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache, partial

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contacts.charted_whisker import ChartedWhisker
from vibrissa.contacts.contacts import Candidates, Contacts, Room, candidates_within, contacts_of
from vibrissa.contacts.engine.candidates import UNEXPLAINED
from vibrissa.contacts.engine.prior import Prior, among_allowed, refuse_tip
from vibrissa.contacts.engine.ranking import compile_stages, estimate_rows
from vibrissa.contacts.engine.readout import Bounds, Measurement, Mixed, Named, independent
from vibrissa.contacts.engine.task import Problem, task
from vibrissa.contacts.fitting.inversion import polish
from vibrissa.contacts.joint.joint_fit import soft_base
from vibrissa.contacts.sensing.noise import explained, sensor_noise
from vibrissa.deferred import spatial, xr
from vibrissa.numerics import AnyArray, Array, IntArray, share_out
from vibrissa.rod import TOLERANCE
from vibrissa.signals import (
    SIGNALS,
    check_signals,
    circular_among,
    measured,
    selection,
    signal_scales,
    signals_of,
    within_turn,
)
from vibrissa.status import Status

#: Signals that determine a contact.
UNKNOWNS = 3
#: Limit that larger values are reduced to: as implausible in any unit, and its square is finite.
LARGEST = 1e100
# Non-dimensional force or moment that 5 % of values exceed only if they are in another unit.
_LARGEST_SCALE, _OFTEN = 100.0, 0.95
# Number and share of implausible values above which a table is in other units; fewer get a status.
_TABLE = 20
# Number of measurements for which the most candidates are allocated at a time; few have more than
# one.
_AT_ONCE = 1 << 16
#: Statuses by number.
STATUSES = {int(status): status for status in Status}


class Search:
    """Finds the contacts that explain measurements of three or more signals."""

    def __init__(self, contact_map: ChartedWhisker, readout: Named | Mixed) -> None:
        self.contact_map, self.readout = contact_map, readout
        exact = isinstance(readout, Named) and len(readout.names) == UNKNOWNS
        limit = explained(independent(contact_map, readout) - UNKNOWNS)
        self._problem = Problem(exact, readout.noisy, readout.passes, limit)
        if readout.noisy:
            compile_stages(readout.searched, readout.how, self._problem)
        self._task = task(readout.searched, readout.how, self._problem)

    def __reduce__(self) -> tuple[type[Search], tuple[ChartedWhisker, Named | Mixed]]:
        """Copy what the search is made of, as memory of compiled code cannot be copied."""
        return Search, (self.contact_map, self.readout)

    def batch(self, values: Array, targets: Array) -> tuple[Candidates, IntArray, Array]:
        """Candidates of measurements (n, k), with statuses and χ² of the first (n,)."""
        readout = self.readout
        assert isinstance(readout, Named)
        known = np.isfinite(values).all(axis=1)
        status = np.where(known, int(Status.UNIQUE), int(Status.MISSING))
        nothing = known & readout.bounds.nothing(values)
        beyond = known & readout.bounds.exceeded(values)
        status[beyond], status[nothing] = self._beyond, self._nothing
        aims = np.where((status == Status.UNIQUE)[:, None], targets, np.nan)
        values = np.ascontiguousarray(values)
        if len(values) <= _AT_ONCE:
            return self._rows(values, aims, status)
        parts, chi_squared = [], np.empty(len(values))
        for start in range(0, len(values), _AT_ONCE):
            rows = slice(start, start + _AT_ONCE)
            found, status[rows], chi_squared[rows] = self._rows(
                values[rows], aims[rows], status[rows]
            )
            parts.append(found.trimmed())
        return Candidates.joined(parts), status, chi_squared

    def one(self, measurement: Measurement) -> tuple[Candidates, Status, float]:
        """Candidates of one measurement, with its status and χ² of the first."""
        readout = self.readout
        values, targets = measurement.measured[None], measurement.target[None]
        code = int(Status.UNIQUE)
        if readout.nothing(measurement):
            code, targets = self._nothing, np.full(targets.shape, np.nan)
        elif readout.beyond(measurement):
            code, targets = self._beyond, np.full(targets.shape, np.nan)
        status, room = np.array([code]), Room.of(1)
        estimate_rows(self._task, self._problem, targets, values, room, status, 0, 1)
        out = candidates_within(*room)
        chi_squared = out.chi_squared[0, :1]
        if status[0] == UNEXPLAINED:
            chi_squared = self._reasons(values, out, status)
        return out, STATUSES[int(status[0])], float(chi_squared[0])

    @property
    def _nothing(self) -> int:
        return UNEXPLAINED if self._problem.exact else int(Status.DEGENERATE)

    @property
    def _beyond(self) -> int:
        return UNEXPLAINED if self._problem.exact else int(Status.OUTSIDE_MAP)

    def _rows(
        self, values: Array, targets: Array, status: IntArray
    ) -> tuple[Candidates, IntArray, Array]:
        room = Room.of(len(values))
        given = self._task, self._problem, targets, values, room, status
        share_out(len(values), partial(estimate_rows, *given))
        out = candidates_within(*room)
        return out, status, self._reasons(values, out, status)

    def _reasons(self, values: Array, found: Candidates, status: IntArray) -> Array:
        """Fill why rows of three signals have no contact; χ² of the first candidates (n,)."""
        chi_squared = found.chi_squared[:, 0].copy()
        rows = np.flatnonzero(status == UNEXPLAINED)
        if rows.size:
            assert isinstance(self.readout, Named)
            status[rows], away = why_none(self.contact_map, self.readout.names, values[rows])
            none = found.number[rows] == 0
            chi_squared[rows[none]] = away[none]
        return chi_squared


def why_none(
    contact_map: ChartedWhisker, names: tuple[str, ...], targets: Array
) -> tuple[IntArray, Array]:
    """Reasons why three signals have no contact; distances of the nearest signals that have one."""
    chart, turned = contact_map.chart, circular_among(names)
    known, size, tree, bounds = signals_at_nodes(contact_map, names)
    _, nearest = tree.query(_on_circle(targets, turned, size))
    away = within_turn(known[nearest] - targets, turned)
    span = np.where(turned, 2.0 * np.pi, size)
    misfit = np.abs(away / span).max(axis=1)
    # Perhaps a contact nearer to the base than the map's limit explains them.
    start = chart.contacts.reshape(-1, 3)[nearest]
    xi, _, residual, sign = polish(chart, names, targets, start)
    nearer = (residual <= TOLERANCE) & (sign > 0.0) & (xi[:, 0] < chart.proximal)
    nearer |= bounds.exceeded(targets)
    status = np.where(nearer, int(Status.OUTSIDE_MAP), int(Status.NOT_FRICTIONLESS))
    status[bounds.nothing(targets)] = int(Status.DEGENERATE)
    return status, misfit


@lru_cache(maxsize=16)
def signals_at_nodes(
    contact_map: ChartedWhisker, names: tuple[str, ...]
) -> tuple[Array, Array, spatial.cKDTree, Bounds]:
    """Signals at the nodes of the chart, with the structures to search among them."""
    values = contact_map.chart.values.reshape(-1, 6)
    which = [SIGNALS.index(name) for name in names]
    known = signals_of(values[:, :3], np.cross(values[:, 3:], values[:, :3]))[:, which]
    turned = circular_among(names)
    size = np.where(turned, 1.0, np.ptp(known, axis=0))
    tree = spatial.cKDTree(_on_circle(known, turned, size))
    return known, size, tree, Bounds.of(contact_map, names)


def _on_circle(values: Array, turned: AnyArray, size: Array) -> Array:
    """Signals as points whose distance is their difference, angles as points of the circle."""
    parts = []
    for k, turns in enumerate(turned.tolist()):
        v = values[:, k]
        parts += [np.cos(v), np.sin(v)] if turns else [np.clip(v / size[k], -LARGEST, LARGEST)]
    return np.stack(parts, axis=1)


def estimate(
    contact_map: ChartedWhisker,
    signals: xr.Dataset | Mapping[str, ArrayLike],
    using: str | Sequence[str],
    noise: Mapping[str, float] | ArrayLike | None,
    errors: Array,
    prior: Prior | None,
    compliance_sigma: float = 0.0,
) -> Contacts:
    """Find all frictionless contacts of a whisker that explain measured signals."""
    names = selection(using)
    sensor = sensor_noise(noise, names, errors, contact_map.whisker)
    values, dims, coords = measured(signals, names)
    check_signals(values, names)
    d = contact_map.chart.discretization
    flat = values.reshape(-1, len(names)) / signal_scales(names, d.force, d.moment)
    check_scale(flat, names)
    if contact_map.determines(names):
        readout = Named(contact_map, names, sensor)
        search = Search(contact_map, readout)
        targets = readout.channels.targets(flat)
        found, status, chi_squared = search.batch(flat, targets)
        if prior is not None:
            found, status, chi_squared = among_allowed(
                prior, contact_map, readout, (flat, targets), found, status, chi_squared
            )
        if compliance_sigma:
            refuse_tip(prior, "an uncertain base is stated")
        rod = contact_map.whisker, contact_map.steps
        if (base := soft_base(*rod, readout.channels, sensor, compliance_sigma)) is not None:
            found, status, chi_squared = base.allow(flat, targets, found, status)
    else:
        found, chi_squared = Candidates.room(len(flat), 1), np.full(len(flat), np.nan)
        known = np.isfinite(flat).all(axis=1)
        status = np.where(known, int(Status.DEGENERATE), int(Status.MISSING))
    return contacts_of(found, status, chi_squared, d, names, values.shape[:-1], dims, coords)


def check_scale(flat: Array, names: tuple[str, ...]) -> None:
    """Refuse forces and moments far too large to have bent the whisker, as in other units."""
    for values, name, turned in zip(flat.T, names, circular_among(names), strict=True):
        size = np.abs(values[np.isfinite(values)])
        if turned or size.size < _TABLE:
            continue
        reached = np.quantile(size, _OFTEN, method="lower")
        if reached > _LARGEST_SCALE:
            raise ValueError(
                f"{name} reaches {reached:.2g} times what is natural to this "
                "whisker: SI units are needed, N and N·m; are these mN, µN, mN·m or µN·m?"
            )
