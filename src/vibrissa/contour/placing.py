"""Where on a simple shape contacts were, and how far off it the surface is there.

A contact point is often known badly along the surface (0.1 to 1 mm) and its normal well (10 mrad,
on a peg some 10 µm of its circumference). With N, T and H normal, tangents and curvature of the
simple shape at x₀, the surface lies a height h above it at the place τ from x₀, where

    Tᵀ (p − ρ n − x₀) = τ,    N·(p − ρ n − x₀) = h,    Tᵀ (n − N) = TᵀHT τ − ∇h,

with the errors of p and n, and the unknown slope ∇h of the surface as one more error of n. Solved
by weighted least squares, x₀ being moved until τ is zero. Without normals it is the foot of the
point.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.contour.shape import FittedShape
from vibrissa.contour.touches import Array

_ROUNDS = 5
_FLOOR = 1e-9
"""Standard deviation, m, of what is said to be exact."""


class Contacts(NamedTuple):
    """Usable contacts, SI units: points of the surface, normals, covariances."""

    surface: Array
    normal: Array | None
    covariance: Array


class Placed(NamedTuple):
    """Contacts on a simple shape."""

    foot: Array
    height: Array
    covariance: Array


def placed(base: FittedShape, contacts: Contacts, slope: float) -> Placed:
    """Place contacts on a simple shape."""
    p = contacts.surface
    foot = p - base.signed_distance(p)[:, None] * base.outward_normals(p)
    for _ in range(1 if contacts.normal is None else _ROUNDS):
        normal = base.outward_normals(foot)
        axes = _axes(normal)
        seen, design, spread = _equations(base, contacts, foot, axes, slope)
        weight = np.linalg.inv(spread)
        turned = np.swapaxes(design, 1, 2) @ weight
        covariance = np.linalg.inv(turned @ design)
        found = (covariance @ turned @ seen[..., None])[..., 0]
        moved = foot + np.einsum("ni,nij->nj", found[:, :2], axes[:, :2])
        # The place belongs to the shape; the height was found above its tangent plane.
        foot = moved - base.signed_distance(moved)[:, None] * base.outward_normals(moved)
    height = np.einsum("ni,ni->n", p - foot, base.outward_normals(foot))
    if contacts.normal is None:
        return Placed(foot, height, contacts.covariance)
    # Conditional on the place that was chosen, the height above it is that of the last round.
    bent = np.einsum("ni,nij,nj->n", found[:, :2], _bending(base, foot, axes), found[:, :2])
    height = found[:, 2] + 0.5 * bent
    return Placed(foot, height, np.swapaxes(axes, 1, 2) @ covariance @ axes)


def _equations(
    base: FittedShape, contacts: Contacts, foot: Array, axes: Array, slope: float
) -> tuple[Array, Array, Array]:
    """What is seen (n, m), its derivatives by place and height (n, m, 3), its covariance."""
    n = len(foot)
    seen = np.einsum("nij,nj->ni", axes, contacts.surface - foot)
    design = np.broadcast_to(np.eye(3), (n, 3, 3))
    if contacts.normal is None:
        spread = axes @ contacts.covariance @ np.swapaxes(axes, 1, 2)
        return seen, design, spread + _FLOOR**2 * np.eye(3)
    across = axes[:, :2]
    turned = np.einsum("nij,nj->ni", across, contacts.normal)
    bending = np.concatenate([_bending(base, foot, axes), np.zeros((n, 2, 1))], axis=2)
    by = np.zeros((n, 5, 6))
    by[:, :3, :3], by[:, 3:, 3:] = axes, across
    if contacts.covariance.shape[1] == 3:
        by = by[:, :, :3]
    spread = by @ contacts.covariance @ np.swapaxes(by, 1, 2)
    spread = spread + np.diag([_FLOOR**2] * 3 + [slope**2] * 2)
    return (
        np.concatenate([seen, turned], axis=1),
        np.concatenate([design, bending], axis=1),
        spread,
    )


def _bending(base: FittedShape, foot: Array, axes: Array) -> Array:
    """Curvature (n, 2, 2) along the tangents."""
    across = axes[:, :2]
    return np.asarray(across @ base._curvature(foot) @ np.swapaxes(across, 1, 2))


def _axes(normal: Array) -> Array:
    """Two tangents and the normal, in rows, (n, 3, 3)."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal), axis=1)])
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normal, first), normal], axis=1)
