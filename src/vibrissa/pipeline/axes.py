"""Whether force and moment are measured along the axes of the whisker.

A contact at p, with friction or without, gives the moment M = p × F: M is normal to F, and the line
of the force meets the bent whisker. With two columns exchanged, a sign wrong, or axes that form the
other hand, most contacts satisfy neither, and with the mistake undone all do. A mistake that leaves
a contact of the whisker, such as a turn of a straight whisker's axes about x, does not show.
"""

from __future__ import annotations

import itertools

import numpy as np
import xarray as xr

from vibrissa.contacts import rubbing_misfits
from vibrissa.numerics import Array
from vibrissa.recording import Group
from vibrissa.whisker import Whisker

# Contacts that are looked at, at least and at most, from those with the larger moments.
_FEW, _MOST = 6, 24
# Errors that are no matter of axes, such as those of stiffness: share of force and of moment.
_MODEL = 0.05
_EXPLAINED = 9.0  # a contact is explained up to this χ², to which a friction angle of 20° adds one
# Axes that explain no more than this share of the contacts are doubted; others are believed that
# explain so much, and so much more than these. Among others as good the simplest is stated.
_DOUBTED, _BELIEVED, _BETTER, _EQUAL = 0.5, 0.9, 0.25, 0.05
# Largest |F · M| / |F| |M| in the median of axes that are tried, which saves time.
_OBLIQUE = 0.2


def doubted_axes(whisker: Whisker, wrench: xr.Dataset, noise: Array) -> str:
    """State which axes of force and moment seem to be exchanged, or of a wrong sign.

    Parameters
    ----------
    whisker : Whisker
        Whisker that touches, without weight.
    wrench : xarray.Dataset
        Measured ``force`` and ``moment``, whisker's frame, N and N·m, dimensions time, space.
    noise : array (6, 6)
        Covariance of (F, M), SI units.

    Returns
    -------
    str
        A sentence; empty where the axes explain most contacts, or no other axes explain them.
    """
    force, moment = (Group(wrench)[name] for name in ("force", "moment"))
    size = np.linalg.norm(moment, axis=1)
    noisy = np.sqrt(np.trace(noise[3:, 3:]))
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero(np.isfinite(force.sum(axis=1)) & (size > 10.0 * noisy))
    if rows.size < _FEW:
        return ""
    rows = rows[size[rows] >= np.median(size[rows])]
    rows = rows[np.linspace(0, rows.size - 1, min(rows.size, _MOST)).round().astype(int)]
    force, moment = force[rows], moment[rows]
    spread = np.repeat([np.median(np.linalg.norm(a, axis=1)) for a in (force, moment)], 3)
    covariance = noise + np.diag((_MODEL * spread) ** 2)

    def explained(turns: Array, fitted: bool) -> Array:
        """Shares of the contacts that are explained with signed exchanges (n, 2, 3, 3)."""
        f, m = np.moveaxis(turns @ np.array([force.T, moment.T]), 1, 0)
        size = np.linalg.norm(f, axis=1) * np.linalg.norm(m, axis=1)
        near = np.median(np.abs((f * m).sum(axis=1)) / size, axis=1) < _OBLIQUE
        shares = np.zeros(len(turns))
        f, m = (np.swapaxes(a[near], 1, 2).reshape(-1, 3) for a in (f, m))
        doubt = rubbing_misfits(whisker, f, m, covariance, fitted)
        shares[near] = (doubt <= _EXPLAINED).reshape(near.sum(), rows.size).mean(axis=1)
        return shares

    stated, own = np.eye(3)[None, None].repeat(2, axis=1), 0.0
    for fitted in (False, True):  # most recordings need no fits, nor kernels for them
        own = explained(stated, fitted)[0]
        if own > _DOUBTED:
            return ""
    turns = _mistakes()
    shares = explained(turns, True)
    simple = int(np.argmax(shares > shares.max() - _EQUAL))
    if shares[simple] < max(_BELIEVED, own + _BETTER):
        return ""
    columns = [_column(*row) for row in zip("FFFMMM", turns[simple].reshape(6, 3), strict=True)]
    return (
        f"the whisker explains {100 * own:.0f} % of {rows.size} strong contacts, and "
        f"{100 * shares[simple]:.0f} % for example with {', '.join(columns)} as Fx, Fy, Fz, Mx, "
        "My, Mz: are force and moment along the axes of the whisker's frame, a right hand, and of "
        "the object on the whisker?"
    )


def _mistakes() -> Array:
    """Signed exchanges of axes (n, 2, 3, 3), of force and of moment, those of few columns first."""
    one = np.eye(3)
    signed = [
        np.diag(signs) @ one[list(order)]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]
    pairs = [
        pair
        for p in signed
        for pair in ((p, one), (one, p), (p, p), (p, np.linalg.det(p).round() * p))
    ]
    every = np.unique(pairs, axis=0)
    changed, negative = (every != one).any(axis=-1).sum(axis=(1, 2)), (every < 0.0).sum((1, 2, 3))
    return np.asarray(every[np.lexsort((negative, changed))][1:])


def _column(kind: str, row: Array) -> str:
    at = int(np.abs(row).argmax())
    return f"{'-' if row[at] < 0.0 else ''}{kind}{'xyz'[at]}"
