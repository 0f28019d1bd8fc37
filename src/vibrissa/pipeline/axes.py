"""Detection of exchanged or sign-reversed axes in measured force and moment.

A contact at p, with friction or without, gives the moment M = p × F: M is normal to F, and the line
of action of the force meets the bent whisker. If two columns are exchanged, a sign is wrong or the
axes are left-handed, most measurements violate both conditions, and correcting the mistake restores
both. A mistake after which the wrench is still that of a possible contact, such as a rotation of a
straight whisker's axes about x, cannot be detected.
"""

from __future__ import annotations

import itertools

import numpy as np
import xarray as xr

from vibrissa.contacts import rubbing_misfits
from vibrissa.numerics import Array
from vibrissa.recording import Group
from vibrissa.whisker import Whisker

# Smallest and largest number of contacts tested, chosen from those with the larger moments.
_FEW, _MOST = 6, 24
# Model errors unrelated to the axes, such as those of stiffness, relative to force and moment.
_MODEL = 0.05
_EXPLAINED = 9.0  # largest χ² of an explained contact; a friction angle of 20° adds one to χ²
# The stated axes are doubted if they explain at most the share _DOUBTED of the contacts. Other axes
# are reported if they explain at least _BELIEVED, and _BETTER more than the stated ones; of those
# within _EQUAL of the best, the simplest is reported.
_DOUBTED, _BELIEVED, _BETTER, _EQUAL = 0.5, 0.9, 0.25, 0.05
# Axes with a larger median |F · M| / |F| |M| are rejected at once, which saves time.
_OBLIQUE = 0.2


def doubted_axes(whisker: Whisker, wrench: xr.Dataset, noise: Array) -> str:
    """Describe which axes of force and moment seem to be exchanged or to have the wrong sign.

    ``wrench`` has ``force`` and ``moment`` over (time, space) in the whisker frame, and ``noise``
    (6, 6) is the covariance of (F, M), SI units. The whisker's weight is neglected. The text is
    empty if the stated axes explain most contacts, or no other axes explain them.
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
        """Shares (n,) of the contacts explained after signed permutations (n, 2, 3, 3)."""
        f, m = np.moveaxis(turns @ np.array([force.T, moment.T]), 1, 0)
        size = np.linalg.norm(f, axis=1) * np.linalg.norm(m, axis=1)
        near = np.median(np.abs((f * m).sum(axis=1)) / size, axis=1) < _OBLIQUE
        shares = np.zeros(len(turns))
        f, m = (np.swapaxes(a[near], 1, 2).reshape(-1, 3) for a in (f, m))
        doubt = rubbing_misfits(whisker, f, m, covariance, fitted)
        shares[near] = (doubt <= _EXPLAINED).reshape(near.sum(), rows.size).mean(axis=1)
        return shares

    stated, own = np.eye(3)[None, None].repeat(2, axis=1), 0.0
    for fitted in (False, True):  # most recordings need neither the fits nor their kernels
        own = explained(stated, fitted)[0]
        if own > _DOUBTED:
            return ""
    turns = _mistakes()
    shares = explained(turns, True)
    simple = int(np.argmax(shares > shares.max() - _EQUAL))
    if shares[simple] < max(_BELIEVED, own + _BETTER):
        return ""
    columns = [
        f"{'-' if row.min() < 0.0 else ''}{kind}{'xyz'[int(np.abs(row).argmax())]}"
        for kind, row in zip("FFFMMM", turns[simple].reshape(6, 3), strict=True)
    ]
    return (
        f"the whisker explains {100 * own:.0f} % of {rows.size} strong contacts, and "
        f"{100 * shares[simple]:.0f} % for example with {', '.join(columns)} as Fx, Fy, Fz, Mx, "
        "My, Mz: are force and moment along the axes of the whisker's frame, a right hand, and of "
        "the object on the whisker?"
    )


def _mistakes() -> Array:
    """Signed axis permutations (n, 2, 3, 3) of force and moment, fewest changed columns first."""
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
