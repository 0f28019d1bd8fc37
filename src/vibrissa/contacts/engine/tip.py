"""Contacts of the tip itself, whose force is normal to the object and not to the whisker.

Such a contact has s = L and three unknowns too: its force f in the material frame at the tip. The
whisker is on one side of the object, so that f_x ≤ 0; with f_x = 0 it is a contact of the side. It
is stable if, on the path from rest at a constant direction of f, the tip never becomes able to
slide along the plane normal to f, and p never becomes the tip of a second equilibrium: with the
stiffness K = (∂F/∂f) (∂p/∂f)⁻¹ and the projection P on that plane, P K P and det ∂p/∂f are
positive.

The forces that explain a measurement are found by least squares. A cloud of forces about each, of
covariance C_f = (JᵀJ)⁻¹, gives the second moment of the contact point, and the evidence

    w = √det C_f · mean of exp(|z|²/2 - χ²/2) |det ∂p/∂f|

over its possible members, z being their distances in standard deviations. A cloud about the best
contact of the side, in its unknowns (s, f_y, f_z), gives the evidence of that. For a slender
whisker the noise may leave much of the surface that the tip can reach possible, which a cloud about
one contact does not represent: if enough nodes of all stable contacts of the tip count, the sums
are over these. Second moments are widened where regions of 95 % would hold less. Contact points of
either kind are uniformly probable, and those of the tip have the prior's probability together: w is
divided by the volume that they fill.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from vibrissa.contacts.charted_whisker import ChartedWhisker
from vibrissa.contacts.contacts import Candidates
from vibrissa.contacts.engine.readout import Mixed, Named
from vibrissa.contacts.fitting.least_squares import Fits, charted
from vibrissa.contacts.joint.forward import Forward
from vibrissa.contacts.joint.joint_fit import JointFit, normal_cloud
from vibrissa.contacts.sensing.channels import CHANNELS, CIRCULAR, channel_derivatives, channels_of
from vibrissa.contacts.sensing.noise import INDISTINCT, explained, whitening
from vibrissa.contacts.uncertainty.posterior import CERTAIN
from vibrissa.deferred import interpolate, spatial
from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.signals import within_turn
from vibrissa.status import Status

# Numbers of nodes by direction, around the whisker and away from its normal plane, and by load; and
# the largest load, over the force at which the side slips off at the tip.
_AROUND, _AWAY, _LOADS, _FARTHEST = 24, np.deg2rad(np.linspace(0.0, 80.0, 9)), 32, 3.0
# Number of nodes from which fits start, and relative difference below which forces are the same.
_STARTS, _SAME = 6, 1e-3
# Largest standard deviation of a cloud, of s over L and of forces relative to their size; and its
# smallest effective share for a valid covariance.
_LONGEST, _COUNTING = 1.0, 0.2
# Width of the cloud over that of the normal distribution, whose tails are often shorter.
_WIDER = 1.5
_DENSE = 4.0  # effective number of nodes from which they replace a cloud
# Share of a 95 % region, and its squared radius in standard deviations.
_WITHIN, _REGION = 0.95, 7.815
# Unknowns of contacts of the side and of the tip: indices into (s, f_x, f_y, f_z).
_SIDE, _TIP = [0, 2, 3], [1, 2, 3]
_SOLVED = (int(Status.UNIQUE), int(Status.AMBIGUOUS))
_UNSOLVED = (int(Status.NOT_FRICTIONLESS), int(Status.OUTSIDE_MAP))


class _Nodes(NamedTuple):
    """Stable contacts of the tip: x (n, 4), (F, p) (n, 6), and the largest forces by direction.

    Each represents contact points of volume ``cells`` (n,); ``volume`` is that of all contact
    points of the tip over that of the side's.
    """

    x: Array
    values: Array
    cells: Array
    largest: Any
    volume: float


class _Weighed(NamedTuple):
    """Log evidence (n,), the most probable contacts, and the second moment of contact points."""

    log: Array
    x: Array
    values: Array
    misfit: Array
    covariance: Array
    valid: AnyArray


def _stable(values: Array, tangents: Array) -> AnyArray:
    """Whether contacts of the tip are stable, from (F, p) and their derivatives in x."""
    by_force = np.nan_to_num(tangents[..., 1:4])
    det = np.linalg.det(by_force[..., 3:6, :])
    by_point = by_force[..., 3:6, :] + np.where(det == 0.0, 1.0, 0.0)[..., None, None] * np.eye(3)
    stiffness = by_force[..., :3, :] @ np.linalg.inv(by_point)
    force = values[..., :3] / np.linalg.norm(values[..., :3], axis=-1, keepdims=True)
    across = np.eye(3) - force[..., :, None] * force[..., None, :]
    plane = across @ (stiffness + np.swapaxes(stiffness, -1, -2)) @ across
    # Along the force it is zero, so the smallest of the three is never positive.
    least = np.linalg.eigvalsh(np.nan_to_num(plane))
    return np.asarray((det > 0.0) & (least[..., 0] > -1e-9 * np.abs(least[..., 2])))


@lru_cache(maxsize=16)
def _nodes(contact_map: ChartedWhisker) -> _Nodes:
    """Solve contacts of the tip along rays of force, up to where the tip slides off."""
    chart = contact_map.chart
    forward = Forward(contact_map.whisker, contact_map.steps)
    bearing = 2.0 * np.pi * np.arange(_AROUND) / _AROUND
    fold = np.linalg.norm(chart.contacts[-1, :, -1, 1:], axis=-1)
    fold = np.interp(bearing, chart.bearings, fold, period=2.0 * np.pi)
    share = np.arange(1, _LOADS + 1) / _LOADS
    size = _FARTHEST * fold[:, None, None] * share**2 + np.zeros((1, len(_AWAY), 1))
    psi, beta = bearing[:, None], _AWAY
    toward = [-np.sin(beta) + 0.0 * psi, np.cos(beta) * np.cos(psi), np.cos(beta) * np.sin(psi)]
    force = size[..., None] * np.stack(toward, axis=-1)[:, :, None]
    x = np.concatenate([np.ones((*size.shape, 1)), force], axis=-1)
    values, tangents = (
        a.reshape(*size.shape, *a.shape[1:]) for a in forward.near(x.reshape(-1, 4))
    )
    stable = np.logical_and.accumulate(_stable(values, tangents), axis=2)
    by_force = np.abs(np.linalg.det(np.nan_to_num(tangents[..., 3:6, 1:4])))
    by_force *= size**2 * np.cos(beta)[:, None] * 2.0 * share * _FARTHEST * fold[:, None, None]
    by_force[:, 0] *= 0.5  # half of the cell pulls at the tip
    cells = by_force[stable] * 2.0 * np.pi * _AWAY[1] / (_AROUND * _LOADS)
    by_chart = np.linalg.det(chart.tangents[..., 3:, :] @ chart.frames)[:, :-1]
    # Include the first node that slides off: noise may carry signals slightly beyond the stable
    # ones.
    largest = size.max(axis=2) * ((stable.sum(axis=2) + 1.0) / _LOADS) ** 2
    largest = interpolate.RegularGridInterpolator(
        (np.append(bearing, 2.0 * np.pi), beta), np.concatenate([largest, largest[:1]])
    )
    side = float(np.nan_to_num(np.abs(by_chart)).mean() * 2.0 * np.pi)
    return _Nodes(x[stable], values[stable], cells, largest, float(cells.sum()) / side)


class TipContacts:
    """Adds contacts of the tip, touched with a ``probability`` beforehand, to those of the side."""

    def __init__(
        self, contact_map: ChartedWhisker, readout: Named | Mixed, probability: float
    ) -> None:
        if not isinstance(readout, Named) or readout.sensor is None:
            raise ValueError(
                "contacts of the tip are compared with those of the side by noise: they need three "
                "of the six signals or more, and their noise"
            )
        self._readout = readout
        self._nodes = _nodes(contact_map)
        odds = probability / (1.0 - probability) / self._nodes.volume
        self._log_odds = float(np.log(odds))
        forward = Forward(contact_map.whisker, contact_map.steps)
        names, self._chart = readout.channels.names, contact_map.chart
        least = self._chart.proximal
        self._fit = JointFit(forward, readout.channels, readout.sensor, least, friction=True)
        self._which = [CHANNELS.index(name) for name in names]
        self._turned = np.array([CIRCULAR[i] for i in self._which])
        self._known = channels_of(self._nodes.values)[:, self._which]
        self._span = np.where(self._turned, 1.0, self._known.std(axis=0))
        self._tree = spatial.cKDTree(self._embedded(self._known))
        self._limit = explained(len(names) - 3)

    def _embedded(self, channels: Array) -> Array:
        """Channels (n, k) as points of a Euclidean space, angles as points of a circle."""
        turned = channels[:, self._turned]
        rest = channels[:, ~self._turned] / self._span[~self._turned]
        return np.concatenate([np.cos(turned), np.sin(turned), rest], axis=1)

    def allow(
        self, measured: tuple[Array, Array], found: Candidates, status: IntArray, chi_squared: Array
    ) -> tuple[Candidates, IntArray, Array]:
        """Candidates of measurements including the tip's, with statuses and first χ²."""
        rows = np.flatnonzero(np.isin(status, (*_SOLVED, *_UNSOLVED)))
        if not rows.size:
            return found, status, chi_squared
        flat, targets = measured[0][rows], measured[1][rows]
        at_tip, log_tip = self._found(flat, targets)
        parts: list[Any] = [part[rows] for part in found]
        side = Candidates(*parts)
        there = np.arange(side.x.shape[1]) < side.number[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            log_side = np.asarray(np.log(side.probability / side.probability[:, :1]))
        log_side[~there | np.isnan(log_side)] = -np.inf
        one = np.flatnonzero(there[:, 0])
        fits = self._side(side.x[one, 0])
        log_side[one] += self._weighed(flat[one], targets[one], fits, _SIDE).log[:, None]
        log = np.concatenate([log_side, log_tip + self._log_odds], axis=1)
        whole = [np.concatenate(both, axis=1) for both in zip(side[1:], at_tip[1:], strict=True)]
        misfit = np.concatenate([side.chi_squared, at_tip.chi_squared], axis=1)
        misfit[~np.isfinite(log)] = np.inf
        log[misfit > misfit.min(axis=1, keepdims=True) + INDISTINCT] = -np.inf
        order = np.argsort(-log, axis=1, kind="stable")[:, : there.shape[1]]
        top = log.max(axis=1, keepdims=True)
        some = np.isfinite(top[:, 0])
        with np.errstate(invalid="ignore"):
            weight = np.exp(log - top)
            probability = weight / weight.sum(axis=1, keepdims=True)
        number = np.minimum(np.isfinite(log).sum(axis=1), there.shape[1])
        together = Candidates(number, *whole)._replace(probability=probability)
        merged = together.ordered(order, number)
        parts = [part.copy() for part in found]
        out = Candidates(*parts)
        for mine, theirs in zip(out, merged, strict=True):
            mine[rows[some]] = theirs[some]
        status, chi_squared = status.copy(), chi_squared.copy()
        tip = order[:, 0] >= there.shape[1]
        sure = merged.probability[:, 0] > CERTAIN
        now = np.where(sure, np.where(tip, int(Status.TIP_CONTACT), int(Status.UNIQUE)), _SOLVED[1])
        good = some & (merged.chi_squared[:, 0] <= self._limit)
        status[rows[good]] = now[good]
        chi_squared[rows[some]] = merged.chi_squared[some, 0]
        return out, status, chi_squared

    def _found(self, flat: Array, targets: Array) -> tuple[Candidates, Array]:
        """Candidates of the tip (n, starts), by rising χ², and the log evidence of each."""
        n, most = len(flat), min(_STARTS, len(self._nodes.x))
        _, nearest = self._tree.query(self._embedded(targets), most)
        start = nearest.reshape(-1)
        row = np.repeat(np.arange(n), most)
        fits = self._fit.fit(flat[row], targets[row], self._nodes.x[start], None, held=True)
        order = np.argsort(fits.misfits.reshape(n, most), axis=1, kind="stable")
        order = (order + most * np.arange(n)[:, None]).reshape(-1)
        fits = Fits(*(part[order] for part in fits))
        force = fits.contacts[:, 1:].reshape(n, most, 3)
        apart = np.linalg.norm(force[:, :, None] - force[:, None], axis=-1)
        near = apart < _SAME * np.linalg.norm(force, axis=-1)[:, :, None]
        new = ~np.tril(near, -1).any(axis=2).reshape(-1)
        good = new & np.isfinite(fits.misfits) & np.isfinite(fits.values).all(axis=1)
        out, log = Candidates.room(n, most), np.full((n, most), -np.inf)
        row, place = row[good], np.tile(np.arange(most), n)[good]
        if row.size:
            some = Fits(*(part[good] for part in fits))
            some.contacts[:, 0] = 1.0  # the arc length was held to 1e-5
            weighed = self._weighed(flat[row], targets[row], some, _TIP)
            log[row, place] = weighed.log
            out.x[row, place], out.values[row, place] = weighed.x, weighed.values
            out.chi_squared[row, place] = weighed.misfit
            out.covariances[row, place], out.valid[row, place] = weighed.covariance, weighed.valid
            self._over_nodes(flat, targets, out, log)
        there = np.isfinite(log)
        return out._replace(number=there.sum(axis=1)), log

    def _over_nodes(self, flat: Array, targets: Array, found: Candidates, log: Array) -> None:
        """Replace clouds by the nodes where these are dense, about the contact of minimum χ²."""
        best = np.where(np.isfinite(log), found.chi_squared, np.inf).argmin(axis=1)
        line = np.arange(len(best))
        rows = np.flatnonzero(np.isfinite(log[line, best]))
        values = found.values[rows, best[rows]]
        fitting, points = self._fit, self._nodes.values[:, 3:6]
        own = fitting.channels.covariance(fitting.sensor, flat[rows], values, fitting.d)
        for i, weights, point in zip(rows, whitening(own), values[:, 3:6], strict=True):
            away = within_turn(self._known - targets[i], self._turned) @ weights.T
            misfit = (away**2).sum(axis=1)
            share = self._nodes.cells * np.exp(-0.5 * (misfit - misfit.min()))
            total = share.sum()
            if total**2 < _DENSE * (share**2).sum():
                continue
            moved, k = points - point, best[i]
            log[i] = -np.inf
            log[i, k] = np.log(total) - 0.5 * misfit.min() - 1.5 * np.log(2.0 * np.pi)
            found.covariances[i, k] = _covariance(share, moved)
            found.valid[i, k] = True

    def _side(self, x: Array) -> Fits:
        """Contacts of the side, with derivatives."""
        values, tangents = self._fit.forward.near(x)
        return Fits(x, values, tangents, np.zeros(len(x)), np.ones(len(x), np.bool_))

    def _weighed(self, flat: Array, targets: Array, fits: Fits, free: list[int]) -> _Weighed:
        """Weigh fits by clouds in their free unknowns."""
        fitting = self._fit
        own = fitting.channels.covariance(fitting.sensor, flat, fits.values, fitting.d)
        weights = whitening(own)
        size = np.linalg.norm(fits.contacts[:, 1:], axis=1)
        scale = np.stack([np.ones(len(size)), size, size, size], axis=1)[:, free]
        by = channel_derivatives(fits.values, fits.tangents, fitting.names)[..., free]
        by = np.nan_to_num(weights @ by * scale[:, None])
        _, strength, axes = np.linalg.svd(by, full_matrices=False)
        with np.errstate(divide="ignore"):
            sigma = np.minimum(_WIDER / strength, _LONGEST)
        node = np.concatenate([np.zeros((1, 3)), normal_cloud(3)])
        n, m = len(size), len(node)
        x = np.repeat(fits.contacts[:, None], m, axis=1)
        x[..., free] += np.einsum("ki,ni,nij->nkj", node, sigma, axes) * scale[:, None]
        values, tangents = fitting.forward.near(x.reshape(-1, 4))
        away = channels_of(values)[:, self._which].reshape(n, m, -1) - targets[:, None]
        away = np.einsum("nij,nkj->nki", weights, within_turn(away, self._turned))
        possible = self._possible(x.reshape(-1, 4), values, tangents, free).reshape(n, m)
        with np.errstate(divide="ignore", invalid="ignore"):
            log = np.log(np.abs(np.linalg.det(np.nan_to_num(tangents[:, 3:6][..., free]))))
            misfit = np.where(possible, (away**2).sum(axis=2), np.inf)
            misfit[np.isnan(misfit)] = np.inf
            log = log.reshape(n, m) + 0.5 * (node**2).sum(axis=1) - 0.5 * misfit
            top = np.maximum(log[:, 1:].max(axis=1), -1e300)
            share = np.exp(log[:, 1:] - top[:, None])
            total = share.sum(axis=1)
            size = np.log(sigma).sum(axis=1) + np.log(scale).sum(axis=1)
            evidence = np.where(total > 0.0, np.log(total / (m - 1)) + top + size, -np.inf)
            line, best = np.arange(n), np.where(possible[:, 0], 0, misfit.argmin(axis=1))
            values = values.reshape(n, m, -1)
            moved = np.nan_to_num(values[:, 1:, 3:6] - values[line, best, None, 3:6])
            second = _covariance(share, moved)
            counting = total**2 / (share**2).sum(axis=1) / (m - 1)
        best_values = values[line, best, :6]
        return _Weighed(
            evidence, x[line, best], best_values, misfit[line, best], second, counting > _COUNTING
        )

    def _possible(self, x: Array, values: Array, tangents: Array, free: list[int]) -> AnyArray:
        """Whether contacts (n, 4) are stable, and those of the tip press on the object."""
        if free == _SIDE:
            fits = Fits(x, values, tangents, np.zeros(len(x)), np.ones(len(x), np.bool_))
            return charted(self._chart, fits, self._chart.proximal) & (x[:, 0] <= 1.0)
        size = np.linalg.norm(x[:, 1:], axis=1)
        psi = np.arctan2(x[:, 3], x[:, 2]) % (2.0 * np.pi)
        with np.errstate(divide="ignore", invalid="ignore"):
            beta = np.arcsin(np.clip(-x[:, 1] / size, 0.0, np.sin(_AWAY[-1])))
        largest = self._nodes.largest(np.stack([psi, np.nan_to_num(beta)], axis=-1))
        return np.asarray((x[:, 1] <= 0.0) & (size <= largest))


def _covariance(share: Array, moved: Array) -> Array:
    """Second moment (..., 3, 3) of differences (..., m, 3) with weights (..., m).

    It is widened so that its 95 % region holds that share of them.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        share = share / share.sum(axis=-1, keepdims=True)
        second = np.swapaxes(share[..., None] * moved, -1, -2) @ moved
        inverse = np.linalg.pinv(np.nan_to_num(second), hermitian=True)
        size = ((moved @ inverse) * moved).sum(axis=-1)
        order = np.argsort(size, axis=-1)
        held = np.cumsum(np.take_along_axis(share, order, axis=-1), axis=-1)
        last = (held < _WITHIN).sum(axis=-1, keepdims=True).clip(max=size.shape[-1] - 1)
        wide = np.take_along_axis(np.take_along_axis(size, order, axis=-1), last, axis=-1)
    return np.asarray(second * np.maximum(wide / _REGION, 1.0)[..., None])


@lru_cache(maxsize=16)
def tip_contacts(
    contact_map: ChartedWhisker, readout: Named | Mixed, probability: float
) -> TipContacts:
    """Contacts of the tip, cached for a map and its signals."""
    return TipContacts(contact_map, readout, probability)
