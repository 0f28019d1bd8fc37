"""Domain of a certificate: bounds on the force that enclose the stable contacts outside a cone.

With q = 1/s - α, α = 1 - r_tip/r_base, the bounds are (:mod:`vibrissa.certificates.conditions`)

    f_min = q² P₀(s),    f_max = q² (P₁(s) + P₂(s) cos φ + P₃(s) sin φ + P₄(s) cos² φ),

polynomials fitted to the fold forces, slightly above all of them, and to the forces that deflect
the contact by the cone's angle, slightly below. Any polynomials define a valid domain; whether it
contains all stable contacts outside the cone is a condition of its own.

A contact p at s is within the cone of half angle c if f_min |∂p/∂f| ≤ `room` · s on the path from
rest, r₀(s), because then |p - r₀(s)| ≤ room · s, with room = √k sin c. Let r₀(s') be the nearest
point of the resting whisker, e = s - s' > 0, and κ ≤ π/L its largest curvature; then

    |p - r₀(s)|² ≥ |p - r₀(s')|² + e² k,    k = 1 - κD - κ²(πD)²/12,    D = s sin c ≥ |p - r₀(s')|,

because p - r₀(s') is normal to the whisker (s' is not its base, as e ≤ πD < s for π sin c < 1), and
the chord from s' to s, at most 2D, is at least that of a circle (Schur) and deviates from the
tangent by at most κe²/2. The largest |p - r₀(s')|/s' that remains is tan c. As s ≤ L, k is valid
for D = L sin c.

A certificate requires every sign on a whole domain. Where a sign is wrong at one contact it cannot
exist; where all are right on a grid it probably does (`outlook`). Near rest the determinant is
decisive, so the largest cone angle of a contact at which it has the wrong sign is a lower limit for
the cones of certificates, and for upper bounds of critical cones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vibrissa.certificates.conditions import DEGREES, PLANAR, SPATIAL
from vibrissa.certificates.equations import ExactRod, exact_rod
from vibrissa.contacts import need_map
from vibrissa.numerics import AnyArray, Array
from vibrissa.rod import fold_forces, solve_forces, with_normal_force
from vibrissa.signals import cone_angle

if TYPE_CHECKING:
    from vibrissa.contacts import ContactMap
    from vibrissa.whisker import Whisker


# Least shares by which the bounds exceed the fold, and are below the cone.
_BEYOND, _INSIDE = 2.5e-2, 0.03
# Largest κ sin c, at which k is zero.
_MOST_BENT = 0.65
_STATIONS, _BEARINGS = 40, 24


class Bounds(NamedTuple):
    """Bounds on the force, non-dimensional: the taper α, and the coefficients of P₀ … P₄.

    ``room`` is the largest deflection of contacts within the cone, as a share of the arc length.
    """

    alpha: float
    factors: Array
    room: float

    def packed(self) -> Array:
        """All numbers in one array, in the order expected by the kernel."""
        return np.concatenate([[self.alpha], self.factors.ravel(), [self.room]])

    def force(self, s: Array, phi: Array, level: Array) -> tuple[Array, Array, Array, Array]:
        """Force f at (s, φ, ℓ), and its derivatives by s, φ and ℓ."""
        q = 1.0 / s - self.alpha
        powers = s[..., None] ** np.arange(DEGREES)
        p = powers @ self.factors.T
        dp = (powers[..., :-1] * np.arange(1, DEGREES)) @ self.factors[:, 1:].T
        b = q[..., None] ** 2 * p
        db = q[..., None] ** 2 * dp - 2.0 * (q / s**2)[..., None] * p
        cos, sin = np.cos(phi), np.sin(phi)
        turn = np.stack([np.ones_like(cos), cos, sin, cos**2], axis=-1)
        swing = np.stack([np.zeros_like(cos), -sin, cos, -2.0 * cos * sin], axis=-1)
        most, dmost = ((x[..., 1:] * turn).sum(axis=-1) for x in (b, db))
        extent, dextent = most - b[..., 0], dmost - db[..., 0]
        return (
            b[..., 0] + extent * level,
            db[..., 0] + dextent * level,
            (b[..., 1:] * swing).sum(axis=-1) * level,
            extent,
        )


def room_within(rod: ExactRod, cone: float) -> float:
    """Largest deflection, as a share of the arc length, that keeps a contact within the cone."""
    largest = np.abs(rod.coefficients[:, 1:3]).sum(axis=(2, 3)) * (1.0 + 1e-12)
    kappa, sine = float(np.hypot(*largest.T).max()), float(np.sin(cone))
    limit = min(1.0 / np.pi, _MOST_BENT / max(kappa, _MOST_BENT))
    if kappa > 3.1 or sine >= limit:
        allowed, angle = np.rad2deg([np.arcsin(limit), cone])
        raise ValueError(
            f"certificates are for curvatures below 3.1/L and, of this whisker, cones below "
            f"{allowed:.3g}°; its curvature is up to {kappa:.3g}/L, and the cone {angle:.3g}°"
        )
    k = 1.0 - kappa * sine - (kappa * np.pi * sine) ** 2 / 12.0
    return float(np.sqrt(k) * sine * (1.0 - 1e-12))


def bounds_of(contact_map: ContactMap, room: float) -> Bounds:
    """Fit the bounds for a whisker."""
    whisker, chart = contact_map.whisker, contact_map.chart
    alpha = 1.0 - whisker.tip_radius / whisker.base_radius
    x = 0.5 - 0.5 * np.cos(np.pi * np.arange(_STATIONS) / (_STATIONS - 1))
    stations = chart.proximal + (1.0 - chart.proximal) * x
    bearings = 2.0 * np.pi * np.arange(_BEARINGS) / _BEARINGS
    s, phi = (a.ravel() for a in np.meshgrid(stations, bearings, indexing="ij"))
    q = 1.0 / s - alpha
    unit = np.stack([s, np.cos(phi), np.sin(phi)], axis=1)
    fold = fold_forces(chart.fold, unit)
    powers = s[:, None] ** np.arange(DEGREES)
    turn = np.stack([np.ones_like(phi), np.cos(phi), np.sin(phi), np.cos(phi) ** 2], axis=1)
    if whisker.is_straight:
        turn[:, 1:] = 0.0
    if is_planar(whisker):
        turn[:, 2] = 0.0
    basis = (turn[:, :, None] * powers[:, None, :]).reshape(len(s), -1)
    target = fold / q**2
    # Least squares of relative misfits.
    fitted = np.linalg.lstsq(basis / target[:, None], np.ones(len(s)), rcond=1e-9)[0]
    lift = (1.0 + _BEYOND) * (target / (basis @ fitted)).max()
    factors = np.zeros((5, DEGREES))
    factors[1:] = lift * fitted.reshape(4, DEGREES)
    if room > 0.0:
        least = _least_force(contact_map, s, phi, fold, room).reshape(_STATIONS, -1).min(axis=1)
        target = least / (1.0 / stations - alpha) ** 2
        basis = stations[:, None] ** np.arange(DEGREES)
        fitted = np.linalg.lstsq(basis / target[:, None], np.ones(_STATIONS), rcond=None)[0]
        factors[0] = (1.0 - _INSIDE) * (target / (basis @ fitted)).min() * fitted
    return Bounds(alpha, factors, room)


def is_planar(whisker: Whisker) -> bool:
    """Whether a whisker is exactly in the plane z = 0, and so its own mirror image."""
    return not np.any(whisker.intrinsic_curvature.coefficients[..., :2])


def _least_force(contact_map: ContactMap, s: Array, phi: Array, fold: Array, room: float) -> Array:
    """Forces f at which f |∂p/∂f|, with its largest value on the path from rest, is room · s."""

    def compliance(force: Array) -> Array:
        xi = np.stack([s, force * np.cos(phi), force * np.sin(phi)], axis=1)
        _, tangents = solve_forces(
            contact_map.chart.discretization, with_normal_force(xi), tangents=True
        )
        along = np.cos(phi)[:, None] * tangents[..., 1] + np.sin(phi)[:, None] * tangents[..., 2]
        return np.asarray(np.linalg.norm(along[:, 3:], axis=1))

    low, high = np.zeros_like(fold), fold.copy()
    resting = compliance(1e-6 * fold)
    for _ in range(30):
        force = 0.5 * (low + high)
        inside = force * np.maximum(resting, compliance(force)) < room * s
        low, high = np.where(inside, force, low), np.where(inside, high, force)
    return low


_COARSE, _DIRECTIONS, _LEVELS = 15, 24, 11
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
    need_map(contact_map)
    straight = bool(contact_map.whisker.is_straight)
    room = float(np.sin(_REST if straight else cone))
    failing = _failing_shares(contact_map, room, (_COARSE, _DIRECTIONS, _LEVELS))
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
    need_map(contact_map)
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
    fault = f"the sign of the {wrong[0]} is wrong at some contacts of a grid"
    if not np.isfinite(angle):
        return fault
    return f"{fault}; all signs are right outside {angle:.3g}°: try a cone of {1.2 * angle:.2g}°"


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
    s = np.linspace(contact_map.chart.proximal, 1.0, _COARSE)
    phi = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
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
