"""Fitted contacts that nothing can hold, moved back to the fold.

At a fixed arc length and direction of the force across the whisker, the whisker slips off where
det ∂p/∂(s, f_y, f_z) first falls to zero as the force grows. Equilibria beyond this fold may have
the measured signals, but are not connected to rest. Where a fit ends at one of them, its contact is
replaced by that on the fold which fits the signals best: by Gauss-Newton steps along the fold, each
followed by a return to it along the force.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from vibrissa.contacts.fitting.least_squares import Fits
from vibrissa.contacts.joint.forward import Forward
from vibrissa.contacts.sensing.channels import ratio_of
from vibrissa.numerics import Array, IntArray, Mask

# Shares of a force at which the determinant is computed: a light one, those below that of the
# contact itself, and those above; and steps of the search for its zero.
_LIGHT, _BELOW, _ABOVE, _BRACKETED = 0.02, (0.25, 0.5, 0.75), (1.0, 1.1, 1.25, 1.5), 8
_SHARES = np.array([_LIGHT, *_BELOW, *_ABOVE])
_LITTLE_LEFT = 0.15  # of the determinant of a light force, at 0.7 of the fold
# Steps along the fold; the longest, of arc length (over L) and of force (over its size); the factor
# by which one that fits worse is shortened; and displacements for derivatives of the determinant.
_ROUNDS, _LONGEST, _STRONGER, _SHORTER = 8, 0.05, 0.3, 0.25
_NUDGE = 1e-6
# Resolution in which contacts are the same, and number of places from which a row's best is sought.
_SAME, _TRIED = 1e-3, 2


class _Fitting(Protocol):
    """What contacts are fitted with: a `JointFit`, which itself calls `held_back`."""

    forward: Forward
    least: float

    def joint(self, flat: Array, targets: Array, fits: Fits) -> Any:
        """Misfits, residuals and their derivatives."""


def held_back(
    fitting: _Fitting, flat: Array, targets: Array, row: IntArray, fits: Fits, limit: float
) -> Fits:
    """Fits (m,) of rows; those beyond the fold are moved to it where no other explains the row.

    Measurements and channels are those of all rows; χ² up to a limit explains them.
    """
    forward = fitting.forward
    # Many fits of a row end at the same contact.
    alike = np.column_stack([row, (fits.contacts / _SAME).round()])
    _, one, of = np.unique(alike, axis=0, return_index=True, return_inverse=True)
    beyond = slips_before(forward, fits.contacts[one])[of.reshape(-1)]
    beyond |= volumes(fits.contacts, fits.tangents) <= 0.0
    beyond &= np.isfinite(fits.misfits)
    if not beyond.any():
        return fits
    contacts, values, tangents, misfits, converged = (np.array(part) for part in fits)
    misfits[beyond] = np.inf
    explained = np.zeros(len(flat), dtype=bool)
    explained[row[misfits <= limit]] = True
    left = np.sort(one[beyond[one] & ~explained[row[one]]])
    start = _on_fold(forward, contacts[left])
    first = _fits(fitting, flat[row[left]], targets[row[left]], start).misfits
    order = np.lexsort((first, row[left]))
    place = np.arange(len(order)) - np.searchsorted(row[left][order], row[left][order])
    order = order[place < _TRIED]
    left, start = left[order], start[order]
    best = _along_fold(fitting, flat[row[left]], targets[row[left]], start)
    out = Fits(contacts, values, tangents, misfits, converged)
    for part, moved in zip(out, best, strict=True):
        part[left] = moved
    return out


def is_near_fold(forward: Forward, fits: Fits) -> Mask:
    """Whether contacts have more than about 0.7 of the force of the fold."""
    light = fits.contacts * [1.0, _LIGHT, _LIGHT, _LIGHT]
    now = volumes(fits.contacts, fits.tangents)
    return np.asarray(now < _LITTLE_LEFT * _volumes_at(forward, light))


def volumes(x: Array, tangents: Array) -> Array:
    """Det ∂p/∂(s, f_y, f_z) (n,), while the ratio of forces along and across is held.

    For contacts x (n, 4) and derivatives (n, 6 or more, 4) with respect to them.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        by_normal = (ratio_of(x) / np.hypot(x[:, 2], x[:, 3]))[:, None] * x[:, 2:]
        by = tangents[:, 3:6, [0, 2, 3]].copy()
        by[:, :, 1:] += tangents[:, 3:6, 1:2] * by_normal[:, None, :]
        return np.asarray(np.linalg.det(by))


def _volumes_at(forward: Forward, x: Array) -> Array:
    """The same of contacts x (..., 4), NaN where they have no equilibrium."""
    flat = x.reshape(-1, 4)
    return volumes(flat, forward.near(flat)[1]).reshape(x.shape[:-1])


def _scaled(x: Array, shares: Array) -> Array:
    """Contacts x (n, 4) with shares (n, m) of their forces, (n, m, 4)."""
    out = np.repeat(x[:, None], shares.shape[1], axis=1)
    out[..., 1:] *= shares[..., None]
    return out


def slips_before(forward: Forward, x: Array) -> Mask:
    """Whether a whisker slips off well before the force of contacts x (n, 4) is reached."""
    before = np.broadcast_to(_BELOW, (len(x), len(_BELOW)))
    return np.asarray((_volumes_at(forward, _scaled(x, before)) <= 0.0).any(axis=1))


def _on_fold(forward: Forward, x: Array) -> Array:
    """Contacts x (n, 4) with the force at which the whisker slips off, if it does so near it."""
    shares = np.broadcast_to(_SHARES, (len(x), len(_SHARES)))
    values = _volumes_at(forward, _scaled(x, shares))
    first = (values <= 0.0).argmax(axis=1)
    some = np.flatnonzero(first > 0)
    row, first = np.arange(len(some)), first[some]
    values, near = values[some], x[some]
    low, high = _SHARES[first - 1], _SHARES[first]
    above, below = values[row, first - 1], values[row, first]
    for _ in range(_BRACKETED):  # regula falsi, with half the value of an end that stays (Illinois)
        with np.errstate(invalid="ignore", divide="ignore"):
            middle = np.clip(low + (high - low) * above / (above - below), low, high)
        value = _volumes_at(forward, _scaled(near, middle[:, None]))[:, 0]
        up = value > 0.0
        below, above = np.where(up, 0.5 * below, value), np.where(up, value, 0.5 * above)
        low, high = np.where(up, middle, low), np.where(up, high, middle)
    out = x.copy()
    out[some, 1:] *= low[:, None]
    return out


def _along_fold(fitting: _Fitting, flat: Array, targets: Array, x: Array) -> Fits:
    """Contacts on the fold that fit measurements best, from starts x (n, 4) on it."""
    forward, n = fitting.forward, len(x)
    best, shorten, step = _fits(fitting, flat, targets, x), np.ones(n), np.empty((n, 3))
    new: Mask = np.ones(n, dtype=bool)
    for _ in range(_ROUNDS):
        if new.any():
            some = Fits(*(part[new] for part in best))
            step[new] = _step(fitting, flat[new], targets[new], some)
        to = best.contacts.copy()
        to[:, [0, 2, 3]] += shorten[:, None] * step
        to[:, 0] = np.clip(to[:, 0], fitting.least, 1.0)
        other = _fits(fitting, flat, targets, _on_fold(forward, to))
        new = np.asarray(other.misfits < best.misfits)
        shorten = np.where(new, 1.0, _SHORTER * shorten)
        for part, moved in zip(best, other, strict=True):
            part[new] = moved[new]
    return best


def _fits(fitting: _Fitting, flat: Array, targets: Array, x: Array) -> Fits:
    """Contacts x (n, 4) as fits of measurements."""
    values, tangents = fitting.forward.near(x)
    known: Mask = np.asarray(np.isfinite(values).all(axis=1))
    fits = Fits(x, values, tangents, np.zeros(len(x)), known)
    misfits = fitting.joint(flat, targets, fits).misfit
    return fits._replace(misfits=np.where(known & np.isfinite(misfits), misfits, np.inf))


def _step(fitting: _Fitting, flat: Array, targets: Array, fits: Fits) -> Array:
    """Steps (n, 3) of s, f_y and f_z to the least misfit on the plane that touches the fold."""
    joint, x = fitting.joint(flat, targets, fits), fits.contacts
    design, residuals = np.nan_to_num(joint.design), np.nan_to_num(joint.residuals)
    force = np.linalg.norm(x[:, 1:], axis=1)
    normal, held = np.zeros((2, len(x), 1, design.shape[2]))
    nudge = np.stack([np.full(len(x), -_NUDGE), force * _NUDGE, force * _NUDGE], axis=1)
    ahead = np.repeat(x[:, None], 4, axis=1)
    ahead[:, [1, 2, 3], [0, 2, 3]] += nudge
    values = _volumes_at(fitting.forward, ahead)
    normal[:, 0, :3] = np.nan_to_num((values[:, 1:] - values[:, :1]) / nudge)
    held[..., 0] = 1.0
    step = _within(design, residuals, normal)
    ends = (x[:, 0] >= 1.0) & (step[:, 0] > 0.0) | (x[:, 0] <= fitting.least) & (step[:, 0] < 0.0)
    both = np.concatenate([normal, held], axis=1)
    step[ends] = _within(design[ends], residuals[ends], both[ends])
    far = np.maximum(
        np.abs(step[:, 0]) / _LONGEST,
        np.linalg.norm(step[:, 1:], axis=1) / (_STRONGER * np.maximum(force, 1e-300)),
    )
    return np.asarray(step / np.maximum(far, 1.0)[:, None])


def _within(design: Array, residuals: Array, held: Array) -> Array:
    """Least-squares steps (n, 3) of contacts that change nothing ``held`` (n, k, u)."""
    free = np.linalg.svd(held)[2][:, held.shape[1] :]
    along = np.linalg.pinv(design @ np.swapaxes(free, 1, 2)) @ residuals[..., None]
    return np.asarray(-(np.swapaxes(free, 1, 2) @ along)[:, :3, 0])
