"""Sign conditions evaluated in floating point on a grid: whether a certificate can exist.

A certificate requires every sign on a whole domain. Where a sign is wrong at one contact it cannot
exist; where all are right on a grid it probably does. Near rest the determinant is decisive, so the
largest cone angle of a contact at which it has the wrong sign is a lower limit for the cones of
certificates, and for upper bounds of critical cones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vibrissa.certificates.conditions import PLANAR, SPATIAL
from vibrissa.certificates.domain import Bounds, bounds_of, room_within
from vibrissa.certificates.equations import exact_rod
from vibrissa.numerics import AnyArray, Array
from vibrissa.rod import fold_forces, solve_forces, with_normal_force
from vibrissa.signals import cone_angle

if TYPE_CHECKING:
    from vibrissa.contacts import ContactMap

_STATIONS, _BEARINGS, _LEVELS = 15, 24, 11
# Grid, and cones relative to the determinant's, for the search for the smallest cone.
_FINE, _SHARES = (29, 24, 21), 1.03 ** np.arange(2, 40)
_REST = 1e-3  # cone about rest that is excluded from a straight whisker's grid
# Number of bisections for the sign change of the determinant, and smallest load on rays.
_HALVINGS = 30
_LEAST_LOAD = 1e-3


class Outlook(NamedTuple):
    """What a grid shows about the existence of a certificate.

    Attributes
    ----------
    failing : dict of float
        Share of the grid on which each condition fails.
    possible : bool
        Whether no condition fails outside the cone.
    determinant_cone : float
        Smallest cone about rest outside which the determinant keeps its sign on the grid, rad;
        infinite if certificates do not apply to cones so large.
    """

    failing: dict[str, float]
    possible: bool
    determinant_cone: float


def outlook(contact_map: ContactMap, cone: float) -> Outlook:
    """Evaluate the sign conditions on a grid.

    Parameters
    ----------
    contact_map : ContactMap
        Map of the whisker.
    cone : float
        Half angle about the resting whisker within which contacts are excluded, rad.

    Returns
    -------
    Outlook
        Whether a certificate can exist, and outside which cone.
    """
    straight = bool(contact_map.whisker.is_straight)
    room = float(np.sin(_REST if straight else cone))
    failing = _failing_shares(contact_map, room, (_STATIONS, _BEARINGS, _LEVELS))
    angle = 0.0 if straight else _determinant_cone(contact_map)
    try:
        room_within(exact_rod(contact_map.whisker), angle)
    except ValueError:
        angle = np.inf
    return Outlook(failing, not any(failing.values()), angle)


def smallest_cone(contact_map: ContactMap) -> float:
    """Find the smallest cone outside which all signs are right on a grid.

    Parameters
    ----------
    contact_map : ContactMap
        Map of the whisker; its base must be rigid.

    Returns
    -------
    float
        Half angle about the resting whisker, rad; infinite if there is none, 0 for a straight
        whisker that needs none.
    """
    if contact_map.whisker.is_straight:
        return 0.0 if outlook(contact_map, 0.0).possible else np.inf
    rod = exact_rod(contact_map.whisker)
    low = max(_determinant_cone(contact_map), _REST)
    try:
        for share in _SHARES:
            failing = _failing_shares(contact_map, room_within(rod, low * share), _FINE)
            if not any(failing.values()):
                return float(low * share)
    except ValueError:  # certificates do not apply to larger cones
        pass
    return np.inf


def objection(contact_map: ContactMap, cone: float) -> str:
    """State what a grid shows against a certificate of a curved whisker; empty if nothing."""
    if contact_map.whisker.is_straight:
        return ""
    room = room_within(exact_rod(contact_map.whisker), cone)
    wrong = [
        name for name, share in _failing_shares(contact_map, room, _FINE).items() if share > 0.0
    ]
    if not wrong:
        return ""
    angle = float(np.rad2deg(smallest_cone(contact_map)))
    fault = f"in floats the sign of the {wrong[0]} is wrong on a grid"
    return fault + (f"; outside {angle:.3g}° all are right" if np.isfinite(angle) else "")


def _failing_shares(
    contact_map: ContactMap, room: float, shape: tuple[int, int, int]
) -> dict[str, float]:
    """Share of a grid on which each condition fails."""
    straight, near = bool(contact_map.whisker.is_straight), contact_map.chart.proximal
    s, level = np.linspace(near, 1.0, shape[0]), np.linspace(0.0, 1.0, shape[2])
    phi = np.array([0.0]) if straight else 2.0 * np.pi * np.arange(shape[1]) / shape[1]
    grid = np.meshgrid(s, phi, level, indexing="ij")
    names = PLANAR if straight else SPATIAL
    signs = _conditions(contact_map, bounds_of(contact_map, room), *grid)
    edge = (grid[0] == near) | (grid[0] == 1.0)
    wanted = np.stack([edge | (name not in _ON_FACES) for name in names])
    return {
        name: float((~(sign > 0.0) & on).sum() / on.sum())
        for name, sign, on in zip(names, signs, wanted, strict=True)
    }


_ON_FACES = ("ratio along the load", "direction", "direction and force")


def _derivatives(contact_map: ContactMap, xi: Array) -> tuple[Array, Array, Array]:
    """(F_x, M_y, M_z) at contacts ξ (n, 3), with derivatives (n, 3, 3), and points (n, 3)."""
    values, tangents = solve_forces(
        contact_map.chart.discretization, with_normal_force(xi), tangents=True
    )
    force, point = values[:, None, :3], values[:, None, 3:]
    by_xi = tangents.transpose(0, 2, 1)
    moment = np.cross(point, force)[:, 0]
    turned = np.cross(by_xi[..., 3:], force) + np.cross(point, by_xi[..., :3])
    value = np.stack([values[:, 0], moment[:, 1], moment[:, 2]], axis=1)
    slope = np.stack([by_xi[..., 0], turned[..., 1], turned[..., 2]], axis=1)
    return value, slope, values[:, 3:]


def _conditions(
    contact_map: ContactMap, bounds: Bounds, s: Array, phi: Array, level: Array
) -> Array:
    """Conditions (c, ...) over a grid, which should all be positive."""
    f, f_s, f_phi, f_l = bounds.force(s, phi, level)
    cos, sin = np.cos(phi), np.sin(phi)
    xi = np.stack([s, f * cos, f * sin], axis=-1).reshape(-1, 3)
    value, slope, _ = _derivatives(contact_map, xi)
    x, y, z = (value[:, i].reshape(s.shape) for i in range(3))
    raw = slope.reshape(*s.shape, 3, 3)
    along = raw[..., 1] * cos[..., None] + raw[..., 2] * sin[..., None]
    across = raw[..., 2] * cos[..., None] - raw[..., 1] * sin[..., None]
    by_s = raw[..., 0] + f_s[..., None] * along
    by_phi = f_phi[..., None] * along + f[..., None] * across
    by_l = f_l[..., None] * along
    if contact_map.whisker.is_straight:
        moment = np.hypot(y, z)
        grown = raw[..., 2, :] * np.sign(z)[..., None]  # all in one plane: M = |M_z|
        det = grown[..., 0] * raw[..., 0, 1] - grown[..., 1] * raw[..., 0, 0]
        fall = grown[..., 0] + f_s * grown[..., 1]
        ratio = -raw[..., 0, 1] * moment + 2.0 * x * grown[..., 1]
        return np.stack([f_l, moment, -fall, det, ratio])
    square = y**2 + z**2
    sign = _common_sign(np.linalg.det(raw))
    turn_phi, turn_l = (y * d[..., 2] - z * d[..., 1] for d in (by_phi, by_l))
    zeta_phi, zeta_l = (
        square * d[..., 0] - x * (y * d[..., 1] + z * d[..., 2]) for d in (by_phi, by_l)
    )
    return np.stack(
        [
            np.broadcast_to(bounds.force(s, phi, 0.0 * level)[0], f.shape),
            f_l,
            -(y * by_s[..., 1] + z * by_s[..., 2]),
            by_s[..., 2] * by_phi[..., 1] - by_s[..., 1] * by_phi[..., 2],
            sign * np.linalg.det(raw),
            turn_phi,
            sign * (turn_phi * zeta_l - turn_l * zeta_phi),
        ]
    )


def _common_sign(x: AnyArray) -> float:
    """Sign that most values have."""
    return 1.0 if (x > 0.0).mean() > 0.5 else -1.0


def _determinant_cone(contact_map: ContactMap) -> float:
    """Largest cone angle at which the determinant has the rarer sign, along rays from rest."""
    d = contact_map.chart.discretization
    s = np.linspace(contact_map.chart.proximal, 1.0, _STATIONS)
    phi = 2.0 * np.pi * np.arange(_BEARINGS) / _BEARINGS
    stations, bearings = (a.ravel() for a in np.meshgrid(s, phi, indexing="ij"))
    unit = np.stack([stations, np.cos(bearings), np.sin(bearings)], axis=1)
    fold = fold_forces(contact_map.chart.fold, unit)

    def determinant(force: Array) -> tuple[Array, Array]:
        xi = unit * np.stack([np.ones_like(force), force, force], axis=1)
        _, slope, point = _derivatives(contact_map, xi)
        return np.linalg.det(slope), point

    shares = np.linspace(1.0, _LEAST_LOAD, 41) ** 2
    signs = np.stack([np.sign(determinant(share * fold)[0]) for share in shares])
    common = _common_sign(signs)
    wrong = signs != common
    if not wrong.any():
        return 0.0
    first = np.argmax(wrong, axis=0)
    rays = np.flatnonzero(wrong.any(axis=0))
    low, high = shares[first[rays]], shares[np.maximum(first[rays] - 1, 0)]
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        force = np.zeros_like(fold)
        force[rays] = middle * fold[rays]
        bad = np.sign(determinant(force)[0][rays]) != common
        low, high = np.where(bad, middle, low), np.where(bad, high, middle)
    force = np.zeros_like(fold)
    force[rays] = high * fold[rays]
    point = determinant(force)[1][rays]
    return float(cone_angle(contact_map.whisker, point * d.length).max())
