"""Contacts of a rod with weight that explain three signals, sought along the whole whisker.

At each arc length s the force across the whisker is fitted to the signals. It cannot change their
misfit T - T̃ along the normal ν of ∂T/∂f_y and ∂T/∂f_z; what remains there,

    h(s) = ν · (T - T̃),   h'(s) = ν · ∂T/∂s,

is zero at contacts. The path y(s) = (h, s f_y, s f_z) is followed from a contact that a weightless
whisker proposes, and interpolated. On a nearly uniform rod h depends on weight more than on taper,
and zeros may be far from all contacts that explain the signals without weight.
"""

from __future__ import annotations

import numpy as np

from vibrissa.contacts.joint.forward import Forward
from vibrissa.contacts.joint.joint_fit import JointFit
from vibrissa.contacts.sensing.channels import Channels
from vibrissa.contacts.sensing.noise import SensorNoise
from vibrissa.deferred import interpolate
from vibrissa.numerics import Array, IntArray, Mask
from vibrissa.rod import STEPS

# Number of arc lengths at which forces are fitted, the least of them, and the number of parts into
# which the spaces between them are divided.
_NODES, _LEAST, _PARTS = 8, 0.1, 16
# Share of the largest misfit of a path below which its least misfits are also proposed.
_SMALL = 0.02
# Steps of Newton's method towards each zero, and the longest of these, over L.
_ROUNDS, _LONGEST = 2, 0.05
_SAME = 1e-3  # difference of s f, over EI/L, of paths that are the same


def leave_few_paths(names: tuple[str, ...]) -> bool:
    """Whether contacts are to be sought along the whisker for these signals.

    These are three with a direction, which leaves one path or two for a row, and without F_T, whose
    ratio to the moment nearly determines the arc length.
    """
    return len(names) == 3 and "FT" not in names and not {"FD", "MD"}.isdisjoint(names)


def evenly_weighted(forward: Forward, channels: Channels, least: float) -> JointFit:
    """Fits of contacts on the nominal rod with the same weight of all signals, in their units."""
    units = np.repeat([forward.d.force, forward.d.moment], 3)
    even = SensorNoise(None, np.diag(units**2))
    return JointFit(Forward(forward.rod, STEPS), channels, even, least)


def sought_along(
    fitting: JointFit, flat: Array, targets: Array, row: IntArray, x: Array
) -> tuple[IntArray, Array]:
    """Rows, and contacts (m, 4) near those that explain three signals of each row.

    Paths start from contacts x (n, 4) of rows; measurements and channels are those of all rows.
    """
    nodes = np.geomspace(max(fitting.least, _LEAST), 1.0, _NODES)
    # All paths of a row start at one node, where those that are the same are recognised.
    start = np.zeros(len(flat), np.int64)
    start[row] = np.abs(nodes - x[:, :1]).argmin(axis=1)
    y, slope = _held(fitting, flat[row], targets[row], nodes[start[row]], x[:, :1] * x[:, 2:])
    alike = np.column_stack([row, (y[:, 1:] / _SAME).round()])
    kept = np.unique(alike, axis=0, return_index=True)[1]
    kept = kept[np.isfinite(y[kept]).all(axis=1)]
    row, count = row[kept], len(kept)
    path, slopes = np.full((2, count, _NODES, 3), np.nan)
    each, place = np.arange(count), start[row]
    path[each, place], slopes[each, place] = y[kept], slope[kept]
    # Towards the tip and towards the base at once.
    each, place, ahead = np.tile(each, 2), np.tile(place, 2), np.repeat([1, -1], count)
    while each.size:
        going = (place + ahead >= 0) & (place + ahead < _NODES)
        going &= np.isfinite(path[each, place, 0])
        each, place, ahead = each[going], place[going], ahead[going]
        s, some = nodes[place + ahead], row[each]
        y, slope = path[each, place, 1:], slopes[each, place, 1:]
        y = y + slope * (s - nodes[place])[:, None]
        place = place + ahead
        path[each, place], slopes[each, place] = _held(fitting, flat[some], targets[some], s, y)
    each, s, y = _zeros(nodes, path, slopes)
    row = row[each]
    for _ in range(_ROUNDS):
        path, slopes = _held(fitting, flat[row], targets[row], s, y)
        with np.errstate(divide="ignore", invalid="ignore"):
            to = np.clip(s - path[:, 0] / slopes[:, 0], nodes[0], 1.0)
        to = np.where(np.abs(to - s) < _LONGEST, to, s)
        s, y = to, path[:, 1:] + slopes[:, 1:] * (to - s)[:, None]
    known = np.isfinite(y).all(axis=1)
    return row[known], np.column_stack([s, 0.0 * s, y / s[:, None]])[known]


def _held(
    fitting: JointFit, flat: Array, targets: Array, s: Array, near: Array
) -> tuple[Array, Array]:
    """Values and derivatives of paths (n, 3) at arc lengths s (n,), from s f (n, 2) near them."""
    start = np.column_stack([s, 0.0 * s, near / s[:, None]])
    fits = fitting.fit(flat, targets, start, held=True)
    joint = fitting.joint(flat, targets, fits)
    misfit, design = joint.residuals[:, :3, None], joint.design[:, :3, :3]
    by_force, by_arc = design[..., 1:], design[..., :1]
    normal = np.cross(by_force[..., 0], by_force[..., 1])
    # Weights are a root of the inverse covariance, whose determinant may have either sign.
    normal *= np.sign(np.linalg.det(joint.weights))[:, None]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    f = fits.contacts[:, 2:]
    turn = -(np.linalg.pinv(np.nan_to_num(by_force)) @ by_arc)[..., 0]
    h, slope = ((normal[:, None] @ part)[:, 0] for part in (misfit, by_arc))
    lever = s[:, None]
    return np.column_stack([h, lever * f]), np.column_stack([slope, f + lever * turn])


def _zeros(nodes: Array, path: Array, slopes: Array) -> tuple[IntArray, Array, Array]:
    """Paths, arc lengths (m,) and s f (m, 2) where h is zero or nearest to zero."""
    known: Mask = np.asarray(np.isfinite(path + slopes).all(axis=2))
    path, slopes = (np.where(known[..., None], part, 0.0) for part in (path, slopes))
    s = np.interp(np.arange(_PARTS * (_NODES - 1) + 1) / _PARTS, np.arange(_NODES), nodes)
    y = interpolate.CubicHermiteSpline(nodes, path, slopes, axis=1)(s)
    h, inside = y[..., 0], np.repeat(known[:, 1:] & known[:, :-1], _PARTS, axis=1)
    size = np.abs(h)
    each, place = np.nonzero(inside & (h[:, 1:] * h[:, :-1] <= 0.0))
    apart = h[each, place] - h[each, place + 1]
    share = h[each, place] / np.where(apart == 0.0, 1.0, apart)
    # Two zeros may be closer to one another than the interpolation is exact: from both sides.
    least = inside[:, 1:] & inside[:, :-1]
    least &= np.less(size[:, 1:-1], _SMALL * size.max(axis=1, keepdims=True))
    for other in (h[:, 2:], h[:, :-2]):
        least &= np.greater(np.abs(other), size[:, 1:-1]) & np.greater(other * h[:, 1:-1], 0.0)
    near, low = np.nonzero(least)
    each, place = np.concatenate([each, near, near]), np.concatenate([place, low, low + 1])
    share = np.concatenate([share, 0.0 * low, 0.0 * low + 1.0])
    arc = s[place] + share * (s[place + 1] - s[place])
    share = share[:, None]
    return each, arc, (1.0 - share) * y[each, place, 1:] + share * y[each, place + 1, 1:]
