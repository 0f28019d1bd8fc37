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
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vibrissa.certificates.conditions import DEGREES
from vibrissa.certificates.equations import ExactRod
from vibrissa.numerics import Array
from vibrissa.rod import fold_forces, solve_forces, with_normal_force

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
