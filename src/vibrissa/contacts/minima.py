"""Which fitted contacts count, and how far their covariance can be relied on."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.channels import CHANNELS, CIRCULAR, channel_derivatives, channels_of
from vibrissa.contacts.fitting import Fits
from vibrissa.contacts.whitening import INDISTINCT
from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.rod import Discretization, solve_forces
from vibrissa.signals import within_turn

# Contacts within this (over L, and ten times that relative to the force) are one.
_SAME = 1e-3
# How far along each axis of the covariance its linearisation is checked, in standard deviations,
# and by how much it may err there, as a share of that.
_REACH = 2.0
_BENT = 0.25


class Candidates(NamedTuple):
    """Rows × candidates, NaN-padded.

    Their number (n,), x (n, k, 4), (F, p) (n, k, 6), ∂(F, p)/∂x (n, k, 6, 4) and χ² (n, k).
    """

    number: IntArray
    contacts: Array
    values: Array
    tangents: Array
    misfits: Array

    def replaced(self, row: IntArray, place: IntArray, fits: Fits) -> Candidates:
        """Put better fits in their places."""
        out = Candidates(self.number, *(a.copy() for a in self[1:]))
        for mine, theirs in zip(out[1:], fits[:4], strict=True):
            mine[row, place] = theirs
        return out


def candidates(
    rows: int, row: IntArray, fits: Fits, doubt: Array, limit: float, most: int
) -> Candidates:
    """Choose among fits those that explain their measurement and cannot be told apart."""
    misfit = np.where(np.isfinite(fits.values).all(axis=1), fits.misfits, np.inf)
    best = np.full(rows, np.inf)
    np.minimum.at(best, row, misfit)
    kept = (misfit <= np.minimum(best[row] + INDISTINCT, np.maximum(best[row], limit))) & (
        misfit < np.inf
    )
    kept &= (best[row] <= limit) | (misfit == best[row])
    order = np.flatnonzero(kept)
    order = order[np.lexsort((doubt[order], row[order]))]
    number = np.zeros(rows, np.int64)
    where = np.full((rows, most), -1)
    for fit in order:
        i = row[fit]
        known = any(same(fits.contacts[fit], fits.contacts[j]) for j in where[i, : number[i]])
        if not known and number[i] < most:
            where[i, number[i]] = fit
            number[i] += 1
    there = where >= 0

    def padded(values: Array) -> Array:
        out = np.full((rows, most, *values.shape[1:]), np.nan)
        out[there] = values[where[there]]
        return out

    return Candidates(number, *(padded(a) for a in fits[:4]))


def same(a: Array, b: Array) -> bool:
    """Whether two contacts x (4,) are one."""
    s, *force = (a - b).tolist()
    size = math.hypot(*a[1:].tolist())
    return abs(s) < _SAME and math.hypot(*force) < 10.0 * _SAME * size


def unknowns_covariance(
    names: tuple[str, ...], values: Array, tangents: Array, weights: Array, *, friction: bool
) -> Array:
    """Covariances of x, (n, 4, 4): (JᵀΣ⁻¹J)⁻¹; NaN where the channels do not determine x."""
    free = [0, 1, 2, 3] if friction else [0, 2, 3]
    j = weights @ channel_derivatives(values, tangents[..., free], names)
    out = np.zeros((len(values), 4, 4))
    usable: AnyArray = np.asarray(np.isfinite(j).all(axis=(1, 2)))
    size = np.where(
        usable[:, None], np.linalg.norm(np.where(usable[:, None, None], j, 1.0), axis=1), 1.0
    )
    usable &= (size > 0.0).all(axis=1)
    scaled = np.where(usable[:, None, None], j / np.where(size > 0.0, size, 1.0)[:, None, :], 0.0)
    _, singular, v = np.linalg.svd(scaled, full_matrices=False)
    usable &= singular[:, -1] > 1e-10
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.swapaxes(v, -1, -2) / singular[:, None, :] / size[:, :, None]
    out[np.ix_(range(len(out)), free, free)] = root @ np.swapaxes(root, -1, -2)
    out[~usable] = np.nan
    return out


def reliable(
    discretization: Discretization,
    names: tuple[str, ...],
    weights: Array,
    contacts: Array,
    values: Array,
    tangents: Array,
    covariance: Array,
    least: float,
) -> AnyArray:
    """Whether a covariance describes how the contact scatters: the map from x is tried out.

    From the contact, two standard deviations to both sides along each principal axis of the
    covariance of x, the rod is solved. There, channels (in standard deviations) and contact point
    (relative to its own scatter) must lie where the derivatives say, to a quarter of the way, and
    the contact must still lie on the whisker.
    """
    finite = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(values).all(axis=1)
    good: AnyArray = np.asarray(finite)
    rows = np.flatnonzero(good)
    if not rows.size:
        return good
    x, value, slope, w = contacts[rows], values[rows], tangents[rows], weights[rows]
    axes = _principal_axes(covariance[rows], x)
    if not covariance[rows, 1, 1].any():
        axes = axes[:, :, 1:]  # without friction the first axis has no length
    steps = _REACH * np.concatenate([axes, -axes], axis=2)  # (n, 4, 2 axes)
    places = x[:, None, :] + np.swapaxes(steps, 1, 2)
    on = (places[..., 0] >= least) & (places[..., 0] <= 1.0)
    places[..., 0] = np.clip(places[..., 0], least, 1.0)
    moved, _ = solve_forces(discretization, places.reshape(-1, 4))
    moved = moved.reshape(*places.shape[:2], 6)
    which = [CHANNELS.index(name) for name in names]
    away = (channels_of(moved) - channels_of(value)[:, None])[..., which]
    away = within_turn(away, [CIRCULAR[w] for w in which])
    told = np.swapaxes(channel_derivatives(value, slope, names) @ steps, 1, 2)
    bent = np.linalg.norm(np.einsum("nij,nmj->nmi", w, away - told), axis=2)
    point_told = np.swapaxes(slope[:, 3:] @ steps, 1, 2)
    off = np.linalg.norm(moved[..., 3:] - value[:, None, 3:] - point_told, axis=2)
    scatter = np.sqrt(np.einsum("nij,njk,nik->n", slope[:, 3:], covariance[rows], slope[:, 3:]))
    with np.errstate(divide="ignore", invalid="ignore"):  # without noise nothing scatters
        bent = np.maximum(bent, off / scatter[:, None])
    still = (steps == 0.0).all(axis=1)
    good[rows] = (on & (bent <= _BENT * _REACH) | still).all(axis=1)
    return good


def _principal_axes(covariance: Array, x: Array) -> Array:
    """Square roots of covariances along their principal axes (in columns), scaled by x."""
    force = np.linalg.norm(x[:, 1:], axis=1)
    size = np.stack([np.ones_like(force), force, force, force], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = np.nan_to_num(covariance / (size[:, :, None] * size[:, None, :]))
    values, vectors = np.linalg.eigh(scaled)
    values = np.where(values > 1e-14 * values[:, -1:], values, 0.0)
    return np.asarray(size[:, :, None] * vectors * np.sqrt(values)[:, None, :])
