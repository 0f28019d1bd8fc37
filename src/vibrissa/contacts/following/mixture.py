"""Gaussian mixture over a contact's position and velocity, updated by one measurement; compiled.

Each hypothesis is a Gaussian over (p, v). A measurement moves it to the minimum in Ω of χ² of the
signals and of p - p_predicted together, with the exact rod in between. There may be several minima:
where two contacts with the same signals separate, a Gaussian that covers both becomes two. So the
minimum is searched for from the hypothesis and from each contact that gives the signals exactly and
is near the prediction. The posterior about each minimum is described to second order
(:mod:`~vibrissa.contacts.uncertainty.moments`), since noise leaves bent valleys and Ω ends at
folds. Its mean and covariance become those of the hypothesis, and its mass updates the weight,

    log w ← log w - χ²/2 + log ∫ exp((χ² - χ²(p))/2) dp - ½ log det P_before + log det W,

with the weights W of the signals, which differ between contacts if noise of force and moment
determines that of a direction.

An uncertain stiffness, and errors of a sensor's gain and mixing, are the same in all samples, and
averaging does not reduce them. So the dependence of the state on each, b = ∂(p, v)/∂ε for an error
ε of standard deviation one, is propagated too, and Σ bbᵀ is part of the covariance ("consider"
parameters, after Schmidt).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.contacts.fitting.fit_within import fit_rows_within
from vibrissa.contacts.fitting.least_squares import Fits, same_contact, settled
from vibrissa.contacts.sensing.weighing import Weighing, gradients, weigh, wrong_by
from vibrissa.contacts.uncertainty.moments import Onset, moments
from vibrissa.numerics import (
    AnyArray,
    Array,
    IntArray,
    cholesky,
    copy,
    forward,
    inlined,
    kernel,
    mahalanobis,
    order_of,
)
from vibrissa.rod import Charted

# Squared Mahalanobis distance from the prediction within which a contact that gives the signals is
# a starting point.
_GATE = 50.0
_NEAR = 4.0  # with a starting point this near, the hypothesis itself is not one
_PLACE = 11  # codes of px, py and pz among the channels


class Mixture(NamedTuple):
    """Hypotheses: Gaussians over (p, v), in L and L/s, with log weights, and the law of each."""

    mean: Array
    spread: Array
    by_errors: Array
    contact: Array
    value: Array
    weight: Array
    law: IntArray


@kernel
def predict(mixture: Mixture, moved: float, kept: float, grown: Array) -> None:
    """Predict the mixture after a time step.

    p changes by ``moved`` v, v keeps a share ``kept``, and ``grown`` (pp, pv, vv), of the law of
    each, is added to the covariance.
    """
    for i in range(mixture.mean.shape[0]):
        m, s, b = mixture.mean[i], mixture.spread[i], mixture.by_errors[i]
        added = grown[mixture.law[i]]
        for a in range(3):
            m[a] += moved * m[3 + a]
            m[3 + a] *= kept
            for e in range(b.shape[1]):
                b[a, e] += moved * b[3 + a, e]
                b[3 + a, e] *= kept
        for a in range(3):
            for c in range(3):
                pv, vp, vv = s[a, 3 + c], s[3 + a, c], s[3 + a, 3 + c]
                s[a, c] += moved * (pv + vp) + moved * moved * vv
                s[a, 3 + c] = kept * (pv + moved * vv)
                s[3 + a, c] = kept * (vp + moved * vv)
                s[3 + a, 3 + c] = kept * kept * vv
        for a in range(3):
            s[a, a] += added[0]
            s[a, 3 + a] += added[1]
            s[3 + a, a] += added[1]
            s[3 + a, 3 + a] += added[2]


def room(n: int, errors: int) -> Mixture:
    """Allocate n hypotheses with so many shared errors."""
    return Mixture(
        np.zeros((n, 6)),
        np.zeros((n, 6, 6)),
        np.zeros((n, 6, errors)),
        np.zeros((n, 4)),
        np.zeros((n, 6)),
        np.zeros(n),
        np.zeros(n, np.int64),
    )


@inlined
def _merge(mixture: Mixture, j: int, mean: Array, spread: Array, by: Array, weight: float) -> None:
    """Merge another Gaussian into row j, with the mean and covariance of both together."""
    top = mixture.weight[j]
    share = np.exp(weight - top) / (1.0 + np.exp(weight - top))
    apart = mean - mixture.mean[j]
    for a in range(6):
        mixture.mean[j, a] += share * apart[a]
        for e in range(by.shape[1]):
            old = mixture.by_errors[j, a, e]
            mixture.by_errors[j, a, e] = old + share * (by[a, e] - old)
        for b in range(6):
            old = mixture.spread[j, a, b]
            moved = share * (spread[a, b] - old) + share * (1.0 - share) * apart[a] * apart[b]
            mixture.spread[j, a, b] = old + moved
    mixture.weight[j] = top + np.log1p(np.exp(weight - top))


@inlined
def _put(mixture: Mixture, i: int, out: Mixture, row: int) -> None:
    """Copy hypothesis i to a row of ``out``."""
    copy(mixture.mean[i], out.mean[row])
    for a in range(6):
        copy(mixture.spread[i, a], out.spread[row, a])
        copy(mixture.by_errors[i, a], out.by_errors[row, a])
    copy(mixture.contact[i], out.contact[row])
    copy(mixture.value[i], out.value[row])
    out.weight[row], out.law[row] = mixture.weight[i], mixture.law[i]


@inlined
def _apart(mixture: Mixture, i: int, out: Mixture, j: int) -> float:
    """Squared Mahalanobis distance of two contact points, by the sum of both covariances."""
    both, away = np.empty((3, 3)), np.empty(3)
    for a in range(3):
        away[a] = mixture.mean[i, a] - out.mean[j, a]
        for b in range(3):
            both[a, b] = mixture.spread[i, a, b] + out.spread[j, a, b]
    return mahalanobis(both, away) if cholesky(both, both) else np.inf


@kernel
def switch(mixture: Mixture, gone: float, shares: Array, near: float, out: Mixture) -> int:
    """Fill ``out`` with hypotheses of which a share ``gone`` has taken a law anew; their number.

    What changes to a law joins the nearest hypothesis of that law, if one is near, as in the filter
    of interacting multiple models.
    """
    rows = len(mixture.weight)
    for i in range(rows):
        _put(mixture, i, out, i)
        out.weight[i] += np.log1p(-gone * (1.0 - shares[mixture.law[i]]))
    for i in range(len(mixture.weight)):
        for law in range(len(shares)):
            if law == mixture.law[i]:
                continue
            twin, least = -1, near
            for j in range(rows):
                if out.law[j] == law:
                    far = _apart(mixture, i, out, j)
                    if far < least:
                        twin, least = j, far
            weight = mixture.weight[i] + np.log(gone * shares[law])
            if twin >= 0:
                mean, spread, by = mixture.mean[i], mixture.spread[i], mixture.by_errors[i]
                _merge(out, twin, mean, spread, by, weight)
            else:
                _put(mixture, i, out, rows)
                out.weight[rows], out.law[rows] = weight, law
                rows += 1
    return rows


@kernel
def tidy(mixture: Mixture, number: int, least: float, most: int, near: float) -> int:
    """Sort and normalise hypotheses, drop improbable ones, and merge those that coincide."""
    order = order_of(-mixture.weight[:number])
    old = Mixture(
        mixture.mean[order],
        mixture.spread[order],
        mixture.by_errors[order],
        mixture.contact[order],
        mixture.value[order],
        mixture.weight[order],
        mixture.law[order],
    )
    kept = 0
    for i in range(number):
        if old.weight[i] < old.weight[0] + np.log(least) or not np.isfinite(old.weight[i]):
            break
        twin = -1
        for j in range(kept):
            if old.law[i] == mixture.law[j] and _apart(old, i, mixture, j) < near:
                twin = j
                break
        if twin >= 0:
            _merge(mixture, twin, old.mean[i], old.spread[i], old.by_errors[i], old.weight[i])
        elif kept < most:
            _put(old, i, mixture, kept)
            kept += 1
    if kept:
        top = mixture.weight[:kept].max()
        total = top + np.log(np.exp(mixture.weight[:kept] - top).sum())
        for j in range(kept):
            mixture.weight[j] -= total
    return kept


@kernel
def unaccounted(
    mixture: Mixture,
    points: Array,
    covariances: Array,
    far: float,
    out: AnyArray,
) -> None:
    """Fill which points (n, 3) of covariances (n, 3, 3) are ``far`` from all hypotheses."""
    both, away = np.empty((3, 3)), np.empty(3)
    for i in range(len(points)):
        out[i] = True
        for j in range(len(mixture.weight)):
            b = mixture.by_errors[j]
            for a in range(3):
                away[a] = points[i, a] - mixture.mean[j, a]
                for e in range(3):
                    both[a, e] = mixture.spread[j, a, e] + covariances[i, a, e]
                    for k in range(b.shape[1]):
                        both[a, e] += b[a, k] * b[e, k]
            if not (cholesky(both, both) and mahalanobis(both, away) > far):
                out[i] = False
                break


@inlined
def _log_determinant(a: Array) -> float:
    """Log determinant of a positive matrix (3, 3); -inf if it is not positive."""
    d = (
        a[0, 0] * (a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1])
        - a[0, 1] * (a[1, 0] * a[2, 2] - a[1, 2] * a[2, 0])
        + a[0, 2] * (a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0])
    )
    return float(np.log(d)) if d > 0.0 else -np.inf


@kernel
def log_weights(w: Array, q: int) -> float:
    """Half the log determinant of W Wᵀ over its first q rows, for W (k, k)."""
    low = np.zeros((q, q))
    total = 0.0
    for i in range(q):
        for j in range(i + 1):
            s = 0.0
            for a in range(w.shape[1]):
                s += w[i, a] * w[j, a]
            for a in range(j):
                s -= low[i, a] * low[j, a]
            if i > j:
                low[i, j] = s / low[j, j]
            elif s > 0.0:
                low[i, i] = np.sqrt(s)
                total += np.log(low[i, i])
            else:
                return -np.inf
    return total


@inlined
def _moment(value: Array) -> Array:
    """P × F."""
    out = np.empty(3)
    out[0] = value[4] * value[2] - value[5] * value[1]
    out[1] = value[5] * value[0] - value[3] * value[2]
    out[2] = value[3] * value[1] - value[4] * value[0]
    return out


@kernel
def _predictions(
    mixture: Mixture,
    turn: Array,
    base: Array,
    pose: float,
    prior: Array,
    before: Array,
    root: Array,
) -> bool:
    """Fill predictions in the whisker's frame: p, covariance P, and P^(-1/2); False if singular."""
    low, column = np.empty((3, 3)), np.empty(3)
    for i in range(len(mixture.weight)):
        away = mixture.mean[i, :3] - base
        for a in range(3):
            prior[i, a] = turn[0, a] * away[0] + turn[1, a] * away[1] + turn[2, a] * away[2]
        spread = mixture.spread[i, :3, :3].copy()
        for a in range(3):
            spread[a, a] += pose
        here = turn.T @ spread @ turn
        if not cholesky(here, low):
            return False
        for c in range(3):
            for a in range(3):
                column[a] = 1.0 if a == c else 0.0
            forward(low, column)
            for a in range(3):
                root[i, a, c] = column[a]
        for a in range(3):
            copy(here[a], before[i, a])
    return True


@kernel
def _starts(
    mixture: Mixture,
    prior: Array,
    root: Array,
    contacts: Array,
    values: Array,
    of: IntArray,
    x: Array,
    v: Array,
) -> int:
    """Fill starting points for the minimum, and the hypothesis of each; return their number."""
    n, c = len(mixture.weight), len(contacts)
    away, rows = np.empty(3), 0
    for i in range(n):
        near = False
        for j in range(c):
            for a in range(3):
                away[a] = values[j, 3 + a] - prior[i, a]
            far = 0.0
            for a in range(3):
                total = 0.0
                for b in range(a + 1):
                    total += root[i, a, b] * away[b]
                far += total * total
            if far > _GATE:
                continue
            near = near or far < _NEAR
            copy(contacts[j], x[rows])
            copy(values[j], v[rows])
            of[rows] = i
            rows += 1
        if not near:
            copy(mixture.contact[i], x[rows])
            copy(mixture.value[i], v[rows])
            of[rows] = i
            rows += 1
    return rows


@kernel
def _fits(
    rod: Charted,
    proximal: float,
    how: Weighing,
    codes: IntArray,
    targets: Array,
    measured: Array,
    passes: int,
    weights: Array,
    fits: Fits,
) -> None:
    """Move contacts to the minimum in Ω of χ² of measurement and prediction, and fill the rest."""
    k = how.codes.shape[0]
    own, before, rest = np.empty((k, k)), fits.contacts.copy(), False
    for _ in range(passes):
        if rest:
            break
        for row in range(len(targets)):
            copy(fits.contacts[row], before[row])
            if not weigh(how, fits.values[row], measured, own):
                own[:] = 0.0
            for a in range(k):
                copy(own[a], weights[row, a, :k])
        fit_rows_within(rod, proximal, how, codes, targets, measured, weights, fits)
        rest = True
        for row in range(len(targets)):
            still = settled(before[row], fits.contacts[row]) or not fits.misfits[row] < np.inf
            rest = rest and still


@inlined
def _known(x: Array, out: Mixture, first: int, found: int) -> bool:
    """Whether a contact is one of those found before."""
    known = False
    for other in range(first, found):
        known = known or same_contact(x, out.contact[other])
    return known


@inlined
def _widen(least: Array, covariance: Array) -> None:
    """Widen a covariance (3, 3) in directions in which another is wider.

    A Gaussian that contains a bent valley is wide across it, and at its ends not on it. The product
    with the next valley is thus shorter, sample by sample, although neither shows where along the
    valley the contact is. The first order does not become shorter.
    """
    low, other = np.empty((3, 3)), np.empty((3, 3))
    if not cholesky(covariance, low):
        return
    for _ in range(2):
        for c in range(3):
            column = least[:, c].copy()
            forward(low, column)
            for a in range(3):
                other[c, a] = column[a]
        least = other.copy()
    values, axes = np.linalg.eigh(least)
    for i in range(3):
        if values[i] > 1.0:
            wide = np.sqrt(values[i] - 1.0) * (np.tril(low) @ np.ascontiguousarray(axes[:, i]))
            for a in range(3):
                for c in range(3):
                    covariance[a, c] += wide[a] * wide[c]


@kernel
def _moved(
    rod: Charted,
    proximal: float,
    how: Weighing,
    codes: IntArray,
    target: Array,
    weights: Array,
    turn: Array,
    pose: float,
    mixture: Mixture,
    i: int,
    prior: Array,
    before: Array,
    root: Array,
    x: Array,
    v: Array,
    t: Array,
    chi: float,
    out: Mixture,
    row: int,
) -> bool:
    """Fill a row with hypothesis i updated at a minimum; False if it is not a Gaussian."""
    k = how.codes.shape[0]
    shift, after, by_channels = np.empty(3), np.empty((3, 3)), np.empty((3, k + 3))
    own = np.ascontiguousarray(weights[:k, :k])
    onset = Onset(np.zeros((2, 3)), 0.0)
    mass = moments(
        rod, proximal, onset, codes, target, weights, x, v, t, False, shift, after, by_channels
    )
    _widen(by_channels @ by_channels.T, after)
    inverse = root.T @ root
    weight = np.log(mass) if mass > 0.0 else -np.inf
    weight -= 0.5 * (_log_determinant(before) + chi)
    weight += log_weights(own, how.mixing.shape[0])
    if not np.isfinite(weight):
        return False
    # In the laboratory frame; G is the gain from p to v.
    after, inverse = turn @ after @ turn.T, turn @ inverse @ turn.T
    spread = mixture.spread[i]
    gain = np.ascontiguousarray(spread[:, :3]) @ inverse
    through = gain @ (np.eye(3) - after @ inverse)
    keep = np.eye(6)
    for a in range(6):
        for c in range(3):
            keep[a, c] -= through[a, c]
    noise = after - after @ inverse @ after
    b, g, wrong = mixture.by_errors[i].copy(), np.empty((k, 6)), np.empty(6)
    gradients(how.codes, v[:3], _moment(v), g)
    for e in range(b.shape[1]):
        wrong_by(how.errors[e], v[:3], _moment(v), wrong)
        pushed = turn @ (np.ascontiguousarray(by_channels[:, :k]) @ (own @ (g @ wrong)))
        for a in range(3):
            for c in range(3):
                noise[a, c] -= pushed[a] * pushed[c]
        copy(keep @ np.ascontiguousarray(b[:, e]) + gain @ pushed, b[:, e])
    # The error of the base passes through the same gain.
    whole = keep @ spread @ keep.T + gain @ noise @ gain.T + pose * (through @ through.T)
    step = gain @ (turn @ (v[3:] + shift - prior))
    for a in range(6):
        out.mean[row, a] = mixture.mean[i, a] + step[a]
        copy(b[a], out.by_errors[row, a])
        out.value[row, a] = v[a]
        for e in range(6):
            out.spread[row, a, e] = 0.5 * (whole[a, e] + whole[e, a])
    copy(x, out.contact[row])
    out.weight[row], out.law[row] = mixture.weight[i] + weight, mixture.law[i]
    return True


@kernel
def learn(
    rod: Charted,
    proximal: float,
    how: Weighing,
    target: Array,
    measured: Array,
    passes: int,
    turn: Array,
    base: Array,
    pose: float,
    mixture: Mixture,
    contacts: Array,
    values: Array,
    out: Mixture,
    misfits: Array,
) -> int:
    """Update hypotheses by a measurement; their number, 0 if a covariance is singular."""
    n, c, k = len(mixture.weight), len(contacts), how.codes.shape[0]
    most = n * (1 + c)
    prior, before, root = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3, 3))
    if not _predictions(mixture, turn, base, pose, prior, before, root):
        return 0
    x, v, of = np.zeros((most, 4)), np.empty((most, 6)), np.empty(most, np.int64)
    rows = _starts(mixture, prior, root, contacts, values, of, x, v)
    codes, targets = np.empty(k + 3, np.int64), np.empty((rows, k + 3))
    weights = np.zeros((rows, k + 3, k + 3))
    copy(how.codes, codes[:k])
    for a in range(3):
        codes[k + a] = _PLACE + a
    for row in range(rows):
        copy(target, targets[row, :k])
        copy(prior[of[row]], targets[row, k:])
        for a in range(3):
            copy(root[of[row], a], weights[row, k + a, k:])
    fits = Fits(
        x[:rows], v[:rows], np.zeros((rows, 6, 4)), np.full(rows, np.inf), np.zeros(rows, np.bool_)
    )
    _fits(rod, proximal, how, codes, targets, measured, passes, weights, fits)
    found, first, own = 0, 0, np.empty((k, k))
    for row in range(rows):
        i, chi = of[row], fits.misfits[row]
        if row > 0 and of[row - 1] != i:
            first = found
        if not chi < np.inf or _known(x[row], out, first, found):
            continue
        if not weigh(how, v[row], measured, own):
            continue
        for a in range(k):
            copy(own[a], weights[row, a, :k])
        if _moved(
            rod,
            proximal,
            how,
            codes,
            targets[row],
            weights[row],
            turn,
            pose,
            mixture,
            i,
            prior[i],
            before[i],
            root[i],
            x[row],
            v[row],
            fits.tangents[row],
            chi,
            out,
            found,
        ):
            misfits[found] = chi
            found += 1
    return found
