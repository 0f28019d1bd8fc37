"""Hypotheses of a filter: a sum of Gaussians, kept small; compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.numerics import AnyArray, Array, copy, kernel


class Mixture(NamedTuple):
    """Hypotheses: Gaussians over (p, v) in the laboratory, in L and L/s, with log weights."""

    mean: Array
    spread: Array
    by_errors: Array
    contact: Array
    value: Array
    weight: Array


@kernel
def predict(mixture: Mixture, moved: float, kept: float, grown: Array) -> None:
    """Let time pass: p goes by `moved` v, v keeps a share; `grown` (pp, pv, vv) is added."""
    for i in range(mixture.mean.shape[0]):
        m, s, b = mixture.mean[i], mixture.spread[i], mixture.by_errors[i]
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
            s[a, a] += grown[0]
            s[a, 3 + a] += grown[1]
            s[3 + a, a] += grown[1]
            s[3 + a, 3 + a] += grown[2]


def room(n: int, errors: int) -> Mixture:
    """Make room for n hypotheses, and so many errors."""
    return Mixture(
        np.zeros((n, 6)),
        np.zeros((n, 6, 6)),
        np.zeros((n, 6, errors)),
        np.zeros((n, 4)),
        np.zeros((n, 6)),
        np.zeros(n),
    )


@kernel
def tidy(mixture: Mixture, number: int, least: float, most: int, near: float) -> int:
    """Sort, normalise, drop what is improbable, and put together what has become the same."""
    order = np.argsort(-mixture.weight[:number])
    mean, spread = mixture.mean[order], mixture.spread[order]
    by, contact = mixture.by_errors[order], mixture.contact[order]
    value, weight = mixture.value[order], mixture.weight[order]
    kept = 0
    for i in range(number):
        if weight[i] < weight[0] + np.log(least) or not np.isfinite(weight[i]):
            break
        twin = -1
        for j in range(kept):
            both = np.empty((3, 3))
            away = np.empty(3)
            for a in range(3):
                away[a] = mean[i, a] - mixture.mean[j, a]
                for b in range(3):
                    both[a, b] = spread[i, a, b] + mixture.spread[j, a, b]
            if away @ np.linalg.solve(both, away) < near:
                twin = j
                break
        if twin >= 0:
            top = mixture.weight[twin]
            share = np.exp(weight[i] - top) / (1.0 + np.exp(weight[i] - top))
            away = mean[i] - mixture.mean[twin]
            for a in range(6):
                mixture.mean[twin, a] += share * away[a]
                for e in range(by.shape[2]):
                    old = mixture.by_errors[twin, a, e]
                    mixture.by_errors[twin, a, e] = old + share * (by[i, a, e] - old)
                for b in range(6):
                    old = mixture.spread[twin, a, b]
                    mixture.spread[twin, a, b] = (
                        old
                        + share * (spread[i, a, b] - old)
                        + share * (1.0 - share) * away[a] * away[b]
                    )
            mixture.weight[twin] = top + np.log1p(np.exp(weight[i] - top))
            continue
        if kept == most:
            continue
        copy(mean[i], mixture.mean[kept])
        for a in range(6):
            copy(spread[i, a], mixture.spread[kept, a])
            copy(by[i, a], mixture.by_errors[kept, a])
        copy(contact[i], mixture.contact[kept])
        copy(value[i], mixture.value[kept])
        mixture.weight[kept] = weight[i]
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
    """Fill which points (n, 3) with covariances (n, 3, 3) are so far from all hypotheses."""
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
            if not away @ np.linalg.solve(both, away) > far:
                out[i] = False
                break
