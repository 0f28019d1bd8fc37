"""Bent rods of many frames at once: their places, and how these change with pose and contact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vibrissa.rod import Discretization, shapes, solve_forces

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

UNKNOWNS = 10
"""Of a frame: shift (3), turn (3), s_c, f_x, f_y, f_z."""

_SAMPLES = 48
_STARTS = np.array([0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
_LIMITS = (0.1, 0.995)
_STEP = 1e-5


@dataclass(frozen=True, eq=False)
class State:
    """Pose and contact of some frames."""

    rotation: Array
    position: Array
    contact: Array

    def moved(self, step: Array) -> State:
        """Change by (t, 10): shift, turn about the axes in which it is held, contact."""
        turn = Rotation.from_rotvec(step[:, 3:6]).as_matrix()
        contact = self.contact + step[:, 6:]
        contact[:, 0] = np.clip(contact[:, 0], *_LIMITS)
        return State(turn @ self.rotation, self.position + step[:, :3], contact)


def bent(d: Discretization, state: State, touching: Mask) -> tuple[Array, Array]:
    """Points of the bent rods and their derivatives."""
    s = np.linspace(0.0, 1.0, _SAMPLES)
    local = rods(d, state.contact, s)
    turned = np.einsum("tij,tnj->tni", state.rotation, local)
    slopes = np.zeros((*local.shape, UNKNOWNS))
    slopes[..., :3] = np.eye(3)
    x, y, z = np.moveaxis(turned, -1, 0)
    slopes[..., 0, 4], slopes[..., 0, 5] = z, -y
    slopes[..., 1, 3], slopes[..., 1, 5] = -z, x
    slopes[..., 2, 3], slopes[..., 2, 4] = y, -x
    rows = np.flatnonzero(touching)
    for k in range(4):
        ahead, back = (state.contact[rows].copy() for _ in range(2))
        step = _STEP if k == 0 else 1e-4
        ahead[:, k] += step
        back[:, k] -= step
        change = (rods(d, ahead, s) - rods(d, back, s)) / (2.0 * step)
        slopes[rows, :, :, 6 + k] = np.einsum("tij,tnj->tni", state.rotation[rows], change)
    return turned + state.position[:, None], slopes


def rods(d: Discretization, contact: Array, s: Array) -> Array:
    """Places (t, n, 3) of rods with contacts (t, 4), whisker frame, units of L."""
    values, _ = solve_forces(d, contact)
    return shapes(d, values, np.ascontiguousarray(contact[:, 0]), s)


def tangents(d: Discretization, contact: Array) -> Array:
    """Derivatives (t, 6, 4) of base force and contact point by the contact."""
    columns = []
    for k in range(4):
        step = np.zeros(4)
        step[k] = _STEP if k == 0 else 1e-4
        ahead, back = (solve_forces(d, contact + sign * step)[0] for sign in (1.0, -1.0))
        columns.append((ahead - back) / (2.0 * step[k]))
    return np.stack(columns, axis=-1)


def first_contacts(
    d: Discretization, state: State, curves: Array, touching: Mask
) -> tuple[Array, Array]:
    """Contacts (n, 4) of the touching frames that make the rod look most like the curves."""
    rows = np.flatnonzero(touching)
    if not rows.size:
        return np.empty((0, 4)), np.empty(0)
    s = np.linspace(0.0, 0.95, 25)
    target = at_lengths(curves[rows], s * d.length) / d.length
    away = target - state.position[rows, None]
    wanted = np.einsum("tji,tnj->tni", state.rotation[rows], away).reshape(len(rows), -1)
    known = np.isfinite(wanted)
    wanted = np.where(known, wanted, 0.0)
    best, least = np.zeros((len(rows), 4)), np.full(len(rows), np.inf)
    for place in _STARTS:
        contact = np.zeros((len(rows), 4))
        contact[:, 0] = place
        for _ in range(5):
            now = rods(d, contact, s).reshape(len(rows), -1) * known
            columns = []
            for k in (2, 3):
                ahead = contact.copy()
                ahead[:, k] += 1e-4
                columns.append((rods(d, ahead, s).reshape(len(rows), -1) * known - now) / 1e-4)
            design = np.stack(columns, axis=-1)
            square = np.swapaxes(design, 1, 2) @ design
            right = (np.swapaxes(design, 1, 2) @ (wanted - now)[..., None])[..., 0]
            step = np.linalg.solve(square + 1e-9 * np.eye(2), right[..., None])[..., 0]
            size = np.linalg.norm(step, axis=1, keepdims=True)
            limit = 2.0 / place**2
            contact[:, 2:] += step * np.minimum(1.0, limit / np.maximum(size, 1e-12))
        missed = rods(d, contact, s).reshape(len(rows), -1) * known - wanted
        cost = (missed**2).sum(axis=1)
        better = cost < least
        best[better], least[better] = contact[better], cost[better]
    return best, least


def at_lengths(curves: Array, s: Array) -> Array:
    """Points (t, n, 3) of curves at arc lengths (n,), m; NaN beyond their ends."""
    out = np.empty((len(curves), len(s), 3))
    for i, curve in enumerate(curves):
        at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
        for k in range(3):
            out[i, :, k] = np.interp(s, at, curve[:, k], right=np.nan)
    return out
