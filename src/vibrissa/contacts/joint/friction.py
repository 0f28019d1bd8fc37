"""Contacts with unknown friction along the whisker, from three signals or more.

Friction adds one unknown: the ratio µ_x of the force along the whisker to that across it. With the
prior µ_x ~ N(0, σ²) as one more channel, three signals give as many equations as unknowns.

The contacts that explain measured signals form a curve: one contact for each arc length s, since
the force there has three components. The curve is short if four or more signals determine µ_x; for
three it bends too much for an ellipsoid. So it is traced along the whisker, more finely where
contacts are probable. At each s the force has, to first order, a covariance C_f. With the stated
prior of ratios, and contacts distributed evenly along the whisker and over the distance y from its
rest shape to which they bend it, the density of s is

    exp(-χ²/2 - µ_x²/2σ²) |∂(p, µ_x)/∂(s, f)| √det C_f / y,

with y² increased by its variance. Contact points that are distributed evenly in space, without
1/y, would be too near the tip if signals hardly determine s: most of the space that a moment can
reach is there. The contact point is a mixture along the curve. Its second moment about the contact
nearest to its mean, widened for tails as in :mod:`~vibrissa.contacts.uncertainty.posterior`, is the
covariance. If the density has several peaks with valleys between them, these are separate
candidates.

If four or more signals determine µ_x, the prior probability that there is no friction is one half:
the prior of µ_x is (δ(µ_x) + N(0, σ²)) / 2. With the density p(0) of µ_x at zero on the curve, the
odds of no friction are p(0) √(2π) σ (the Savage-Dickey ratio). The more probable of the two is the
answer, and the covariance contains both. Decided for each measurement alone, weak friction is
missed in most of them, with errors of one sign. For measurements of one object it is one question:
the ratios are all zero, or they are N(0, τ²) with the same unknown τ up to σ, or equal.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from vibrissa.contacts.contacts import MOST_CANDIDATES, Candidates
from vibrissa.contacts.fitting.least_squares import Fits
from vibrissa.contacts.joint.fold import slips_before, volumes
from vibrissa.contacts.joint.joint_fit import HELD, Joint, JointFit
from vibrissa.contacts.sensing.channels import (
    friction_angle,
    friction_angle_derivatives,
    ratio_derivatives,
)
from vibrissa.contacts.sensing.noise import SensorNoise
from vibrissa.contacts.uncertainty.posterior import ranked
from vibrissa.numerics import AnyArray, Array, IntArray

_UNKNOWNS = 4
LARGEST_FRICTION = 3.0
"""Largest ratio of forces along and across a whisker that friction is believed to have."""

_LEAST = 0.01  # smallest standard deviation of the prior; below it there is no friction
# Number of arc lengths at which curves are traced; number of further ones about each peak, and how
# far from it, in standard deviations of s.
_STATIONS = 33
_FINE, _REACH = 17, 4.0
# Log density below the highest peak at which another one is dropped; and depth of the valley below
# two peaks from which they are separate candidates.
_LOW, _VALLEY = 15.0, 3.0
# Number of values of the standard deviation τ of several ratios. Largest log odds of friction that
# one of them contributes, as one with another error must not decide for all; and of all together.
_SCALES = 9
_TELLING, _CERTAIN = 4.0, 30.0
_PARTS = 8  # number of parts of each step for the moments
_TOGETHER = 1000  # number of measurements whose curves are traced together, in some tens of MB
# Largest kurtosis of a valid covariance, relative to a normal distribution's.
_TAILED = 3.0
_NORMAL_KURTOSIS = 15.0  # fourth moment of the distance of three normally distributed coordinates


class _Nodes(NamedTuple):
    """Contacts on curves, by curve and arc length.

    ``log`` is the log density of s; ``spread`` and ``angle_spread`` are the covariance of the
    contact point and the variance of the friction angle at this s.
    """

    curve: IntArray
    x: Array
    values: Array
    log: Array
    spread: Array
    angle_spread: Array
    misfit: Array

    @property
    def s(self) -> Array:
        return self.x[:, 0]

    def rows(self, kept: AnyArray) -> _Nodes:
        """The nodes selected by indices or a mask."""
        parts: list[Any] = [part[kept] for part in self]
        return _Nodes(*parts)


def _joined(parts: list[_Nodes]) -> _Nodes:
    """Nodes of the same curves in order of s, each arc length once."""
    together = _Nodes(*(np.concatenate(part) for part in zip(*parts, strict=True)))
    together = together.rows(np.lexsort((together.s, together.curve)))
    new = (np.diff(together.curve, prepend=-1) > 0) | (np.diff(together.s, prepend=-1.0) > HELD)
    return together.rows(new)


class _Curves:
    """Curves of contacts with friction that explain measurements."""

    def __init__(self, fitting: JointFit, flat: Array, targets: Array) -> None:
        self.fitting, self.flat, self.targets = fitting, flat, targets

    def fit(self, row: IntArray, x: Array, values: Array, held: bool = True) -> tuple[Fits, Joint]:
        """Fit contacts to rows from starts x, at their arc lengths or anywhere."""
        measured = self.flat[row], self.targets[row]
        fits = self.fitting.fit(*measured, x, values, held)
        return fits, self.fitting.joint(*measured, fits)

    def nodes(self, curve: IntArray, row: IntArray, x: Array, values: Array) -> _Nodes:
        """Contacts at the arc lengths of x that explain measurements best, where there are any."""
        fits, joint = self.fit(row, x, values)
        others = np.nan_to_num(joint.design[..., 1:])
        information = np.swapaxes(others, 1, 2) @ others
        f = ratio_derivatives(fits.contacts)
        whole = np.concatenate([fits.tangents[:, 3:6], f[:, None]], axis=1)
        with np.errstate(all="ignore"):
            log = np.log(np.abs(np.linalg.det(np.nan_to_num(whole))))
            log = log - 0.5 * np.linalg.slogdet(information)[1] - 0.5 * fits.misfits
        there = np.isfinite(log) & (np.abs(fits.contacts[:, 0] - x[:, 0]) < 10.0 * HELD)
        there &= np.isfinite(fits.misfits)
        log[~(volumes(fits.contacts, fits.tangents) > 0.0)] = -np.inf
        x, moved, values = fits.contacts[there], joint.moved[there][..., 1:], joint.values[there]
        spread = np.linalg.inv(information[there])
        across = moved @ spread @ np.swapaxes(moved, 1, 2)
        away = (values - self.fitting.forward.values(x * [1.0, 0.0, 0.0, 0.0]))[:, 3:6]
        size = (away**2).sum(axis=1) + np.trace(across, 0, 1, 2)
        size = np.where(size > 0.0, size, np.inf)  # negative only if the inverse is rounding error
        log = log[there] - 0.5 * np.log(size)
        turn = friction_angle_derivatives(x)[:, 1:]
        turned = np.einsum("ni,nij,nj->n", turn, spread[:, :3, :3], turn)
        return _Nodes(curve[there], x, values, log, across, turned, joint.misfit[there])

    def along(self, row: IntArray, x: Array, values: Array) -> _Nodes:
        """Trace curves through contacts x of rows, from station to station both ways."""
        stations = np.linspace(self.fitting.least, 1.0, _STATIONS)
        nearest = np.abs(stations - x[:, :1]).argmin(axis=1)
        parts = []
        for way in (1, -1):
            steps = range(_STATIONS)
            now, at, v = np.arange(len(row)), x, values
            for step in steps if way > 0 else steps[1:]:
                place = nearest[now] + way * step
                inside = (place >= 0) & (place < _STATIONS)
                guess = at[inside]
                guess[:, 0] = stations[place[inside]]
                guess[:, 1:] *= at[inside, :1] / guess[:, :1]  # with the same moment
                found = self.nodes(now[inside], row[now[inside]], guess, v[inside])
                parts.append(found)
                now, at, v = found.curve, found.x, found.values
        return _joined(parts)

    def finer(self, row: IntArray, nodes: _Nodes, starts: _Nodes) -> tuple[_Nodes, IntArray]:
        """Insert contacts about the peaks of the density, and about the start of each curve.

        The stable part of a curve may consist of several pieces, of which some are not connected to
        rest and left out: return also the row of each.
        """
        peaks = _joined([nodes.rows(_peaks(nodes)), starts])
        curve = peaks.curve
        fits, joint = self.fit(row[curve], peaks.x, peaks.values, held=False)
        with np.errstate(all="ignore"):
            spread = joint.spread()[:, 0, :_UNKNOWNS]
            sigma = np.sqrt(spread[:, 0])
            along = spread / spread[:, :1]
        usable = np.isfinite(along).all(axis=1) & np.isfinite(fits.misfits)
        curve, x = curve[usable], fits.contacts[usable]
        sigma, along = sigma[usable], along[usable]
        step = np.linspace(-_REACH, _REACH, _FINE)[:, None] * np.minimum(sigma, 0.25)
        guess = x + step[..., None] * along
        inside = (guess[..., 0] >= self.fitting.least) & (guess[..., 0] <= 1.0)
        curves = np.broadcast_to(curve, step.shape)[inside]
        values = fits.values[usable]
        values = np.broadcast_to(values, (*step.shape, values.shape[1]))[inside]
        more = self.nodes(curves, row[curves], guess[inside], values)
        every = _joined([nodes, more])
        stable = np.isfinite(every.log)
        gap = np.cumsum(~stable) + every.curve
        curve, number = every.curve[stable], np.cumsum(np.diff(gap[stable], prepend=-1) > 0) - 1
        first = np.flatnonzero(np.diff(number, prepend=-1))
        pieces, held = every.rows(stable), np.ones(len(first), np.bool_)
        if first.size:
            held = ~slips_before(self.fitting.forward, pieces.x[first])
        number, kept = (np.cumsum(held) - 1)[number], held[number]
        return pieces._replace(curve=number).rows(kept), row[curve[first[held]]]


def _peaks(nodes: _Nodes) -> IntArray:
    """Indices of local maxima of the density."""
    log = np.concatenate([[-np.inf], nodes.log, [-np.inf]])
    curve = np.concatenate([[-1], nodes.curve, [-1]])
    left = np.where(curve[:-2] == curve[1:-1], log[:-2], -np.inf)
    right = np.where(curve[2:] == curve[1:-1], log[2:], -np.inf)
    return np.flatnonzero((nodes.log >= left) & (nodes.log > right) & np.isfinite(nodes.log))


class _Parts(NamedTuple):
    """Parts of the steps after nodes: log probability, and other fields as in nodes."""

    node: IntArray
    log: Array
    point: Array
    spread: Array
    angle: Array
    angle_spread: Array


def _parts(nodes: _Nodes) -> _Parts:
    """Divide the steps between nodes; the log density is a cubic between these, the rest linear."""
    same = nodes.curve[1:] == nodes.curve[:-1]
    h = np.where(same, np.diff(nodes.s), np.nan)
    rise = np.diff(nodes.log) / h
    before, after = np.append(np.nan, h), np.append(h, np.nan)
    left, right = np.append(np.nan, rise), np.append(rise, np.nan)
    slope = (left * after + right * before) / (before + after)
    slope = np.where(np.isnan(left), right, np.where(np.isnan(right), left, slope))
    a = np.flatnonzero(same)
    u = ((np.arange(_PARTS) + 0.5) / _PARTS)[:, None]
    low, high = nodes.log[a], nodes.log[a + 1]
    log = low * (1.0 + 2.0 * u) * (1.0 - u) ** 2 + high * u**2 * (3.0 - 2.0 * u)
    log += h[a] * (slope[a] * u * (1.0 - u) ** 2 + slope[a + 1] * u**2 * (u - 1.0))
    log = np.clip(log, np.minimum(low, high), np.maximum(low, high) + 0.5)

    def between(values: Array) -> Array:
        along = u.reshape(-1, *[1] * values.ndim)
        inner = values[a] * (1.0 - along) + values[a + 1] * along
        return np.asarray(inner.reshape(-1, *values.shape[1:]))

    return _Parts(
        np.tile(a, _PARTS),
        (log + np.log(h[a] / _PARTS)).reshape(-1),
        between(nodes.values[:, 3:6]),
        between(nodes.spread),
        between(friction_angle(nodes.x)),
        between(nodes.angle_spread),
    )


def _divided(nodes: _Nodes) -> IntArray:
    """Index of the candidate that each node belongs to: curves are divided in their valleys."""
    out, number = np.zeros(len(nodes.log), np.int64), -1
    first = np.flatnonzero(np.diff(nodes.curve, prepend=-1))
    for begin, end in zip(first.tolist(), [*first[1:].tolist(), len(out)], strict=True):
        number += 1
        peak = valley = begin
        for i in range(begin, end):
            rising = nodes.log[i] - nodes.log[valley]
            if nodes.log[i] < nodes.log[valley]:
                valley = i
            elif rising > _VALLEY and nodes.log[peak] - nodes.log[valley] > _VALLEY:
                number += 1
                out[valley:i] = number
                peak = valley = i
            if nodes.log[i] > nodes.log[peak]:
                peak = valley = i
            out[i] = number
    return out


def _fourth(root: Array, away: Array, spread: Array) -> Array:
    """Fourth moments (n,) of normal parts (n, 3), (n, 3, 3), in standard deviations."""
    z = np.einsum("nij,nj->ni", root, away)
    s = root @ spread @ np.swapaxes(root, 1, 2)
    out = ((z**2).sum(axis=1) + np.trace(s, axis1=1, axis2=2)) ** 2
    out += 2.0 * (s**2).sum(axis=(1, 2)) + 4.0 * np.einsum("ni,nij,nj->n", z, s, z)
    return np.asarray(out)


def _stated(nodes: _Nodes, row: IntArray, n: int) -> Candidates:
    """Candidates of n measurements from the curves of rows."""
    part, own = _parts(nodes), _divided(nodes)
    of, m = own[part.node], int(own.max(initial=-1)) + 1
    top = np.full(m, -np.inf)
    np.maximum.at(top, of, part.log)
    share = np.exp(part.log - top[of])
    total = np.bincount(of, share, m)
    with np.errstate(invalid="ignore"):
        share /= total[of]

    def mean(values: Array) -> Array:
        out = np.zeros((m, *values.shape[1:]))
        np.add.at(out, of, share.reshape(-1, *[1] * (values.ndim - 1)) * values)
        return out

    middle = mean(part.point)
    away = np.linalg.norm(nodes.values[:, 3:6] - middle[own], axis=1)
    order = np.lexsort((away, own))
    lead = order[np.flatnonzero(np.diff(own[order], prepend=-1))]
    y = part.point - nodes.values[lead, 3:6][of]
    second = mean(part.spread + y[:, :, None] * y[:, None, :])
    of_row = row[nodes.curve[lead]]
    weight, best = np.full(m, -np.inf), np.full(n, -np.inf)
    weight[total > 0.0] = np.log(total[total > 0.0]) + top[total > 0.0]
    np.maximum.at(best, of_row, weight)
    # Improbable contacts near slip-off may have covariances that rounding makes indefinite.
    usable = weight > best[of_row] - _LOW
    known = np.where(usable[:, None, None], second, np.eye(3))
    root = np.asarray(np.linalg.inv(np.linalg.cholesky(known)), dtype=np.float64)
    tails = mean(_fourth(root[of], y, part.spread)) / _NORMAL_KURTOSIS
    second *= (np.maximum(tails, 1.0) ** 0.75)[:, None, None]
    turned = part.angle - friction_angle(nodes.x[lead])[of]
    angle_sigma = np.sqrt(mean(turned**2 + part.angle_spread))
    misfit = np.full(m, np.inf)
    np.minimum.at(misfit, own, nodes.misfit)

    out = Candidates.room(n)
    rank = np.full((n, MOST_CANDIDATES), -np.inf)
    order = np.argsort(-weight)
    for one in order[usable[order]]:
        i = of_row[one]
        j = out.number[i]
        if j == MOST_CANDIDATES:
            continue
        out.number[i], rank[i, j] = j + 1, weight[one]
        out.x[i, j], out.values[i, j] = nodes.x[lead[one]], nodes.values[lead[one], :6]
        out.covariances[i, j], out.chi_squared[i, j] = second[one], misfit[one]
        out.valid[i, j] = tails[one] < _TAILED
        out.angle_sigma[i, j] = angle_sigma[one]
    probability, _ = ranked(rank, out.number)
    return out._replace(probability=probability)


def along_curves(
    fitting: JointFit, flat: Array, targets: Array, x: Array, values: Array
) -> Candidates:
    """Candidates of measurements whose contacts without friction are x with (F, p), if any."""
    parts = [
        _found(_Curves(fitting, flat[part], targets[part]), x[part], values[part])
        for part in (slice(i, i + _TOGETHER) for i in range(0, max(len(flat), 1), _TOGETHER))
    ]
    return Candidates(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _found(curves: _Curves, x: Array, values: Array) -> Candidates:
    rows = np.flatnonzero(np.isfinite(x).all(axis=1))
    if not rows.size:
        return Candidates.room(len(x))
    x, values = x[rows], values[rows]
    starts = curves.nodes(np.arange(rows.size), rows, x, values)
    nodes = curves.along(rows, x, values)
    return _stated(*curves.finer(rows, nodes, starts), len(curves.flat))


def or_without(
    found: Candidates, without: Candidates, sigma: float, alike: bool = False
) -> Candidates:
    """Combine candidates with friction of this prior and the nearest one without friction.

    If measurements are ``alike``, friction is absent from all of them or from none.
    """
    row = np.flatnonzero(
        (found.number > 0) & np.isfinite(without.covariances[:, 0]).all(axis=(1, 2))
    )
    none = [part[row, 0] for part in without[1:]]
    x0, values0, spread0, misfit0, _, valid0, _ = none
    away = np.linalg.norm(found.values[row, :, 3:6] - values0[:, None, 3:6], axis=2)
    place = np.where(np.isfinite(away), away, np.inf).argmin(axis=1)
    out = found._replace(**{name: getattr(found, name).copy() for name in found._fields})
    angle = friction_angle(out.x[row, place])
    turned = out.angle_sigma[row, place]
    share = out.probability[row, place]
    odds = share * sigma / turned * np.exp(-0.5 * (angle / turned) ** 2)
    if alike and len(row) > 1:
        odds = np.full_like(odds, _odds_of_all(angle, turned, sigma))
    weight = odds / (share + odds)
    likelier = weight > 0.5
    points = np.stack([values0[:, 3:6], out.values[row, place, 3:6]])
    spreads = np.stack([spread0, out.covariances[row, place]])
    y = points - np.where(likelier[:, None], points[0], points[1])
    both = np.stack([weight, 1.0 - weight])
    second = (both[..., None, None] * (spreads + y[..., :, None] * y[..., None, :])).sum(axis=0)
    root = np.asarray(np.linalg.inv(np.linalg.cholesky(second)), dtype=np.float64)
    fourth = [_fourth(root, *one) for one in zip(y, spreads, strict=True)]
    tails = (both * fourth).sum(axis=0) / _NORMAL_KURTOSIS
    second *= (np.maximum(tails, 1.0) ** 0.75)[:, None, None]
    variance = (1.0 - weight) * turned**2 + np.where(likelier, 1.0 - weight, weight) * angle**2
    out.covariances[row, place], out.angle_sigma[row, place] = second, np.sqrt(variance)
    valid = np.where(likelier, valid0, out.valid[row, place])
    out.valid[row, place] = valid & (tails < _TAILED)
    out.probability[row] /= (1.0 + odds)[:, None]
    out.probability[row, place] = (share + odds) / (1.0 + odds)
    row, place = row[likelier], place[likelier]
    out.x[row, place], out.values[row, place] = x0[likelier], values0[likelier, :6]
    out.chi_squared[row, place] = misfit0[likelier]
    order = np.argsort(-np.nan_to_num(out.probability, nan=-1.0), axis=1, kind="stable")
    line = np.arange(len(order))[:, None]
    return Candidates(out.number, *(part[line, order] for part in out[1:]))


def _odds_of_all(ratio: Array, spread: Array, sigma: float) -> float:
    """Odds that there is no friction in any of several measurements of ratios (n,) ± ``spread``."""
    information = 1.0 / spread**2 - 1.0 / sigma**2
    known = information > 0.0
    variance = 1.0 / information[known]
    square = (ratio[known] / spread[known] ** 2) ** 2 * variance
    share = variance / (variance + np.geomspace(_LEAST, sigma, _SCALES)[:, None] ** 2)
    each = np.clip(0.5 * (np.log(share) + square * (1.0 - share)), -_TELLING, _TELLING)
    scattered = np.logaddexp.reduce(each.sum(axis=1)) - np.log(_SCALES)
    # Equal ratios may be too small to be seen in any one measurement.
    z = np.sign(ratio[known]) * np.sqrt(np.minimum(square, 2.0 * _TELLING))
    alone = 1.0 / (1.0 + sigma**2 * (1.0 / variance).sum())
    mean = (z / np.sqrt(variance)).sum() ** 2 / max((1.0 / variance).sum(), 1.0)
    equal = 0.5 * (np.log(alone) + mean * (1.0 - alone))
    evidence = np.logaddexp(scattered, equal) - np.log(2.0)
    return float(np.exp(np.clip(-evidence, -_CERTAIN, _CERTAIN)))


def check_ratio(spread: float, sensor: SensorNoise | None) -> None:
    """Refuse a prior of friction that is not a standard deviation, or one without noise."""
    if sensor is None:
        raise ValueError("friction is weighed against the noise of the signals: give its noise")
    if not _LEAST <= spread <= LARGEST_FRICTION:
        raise ValueError(
            "friction is the standard deviation of the force along the whisker over that across "
            f"it, {_LEAST:g} to {LARGEST_FRICTION:g}, such as 0.3; got {spread!r}"
        )
