"""The rest shape of a whisker: its intrinsic curvature, integrated.

    R' = R [u₀]ₓ,    r' = R e₁,    R(0) = 1,    r(0) = 0

R has columns (tangent, d1, d2) and u₀ = (twist, curvature about d1, curvature about d2), so that
R' e₁ = R (0, u_z, −u_y). Both together are one motion g = (R, r) with g' = g ξ, ξ = (u₀, e₁) in
se(3), integrated by the sixth-order Magnus method (Blanes, Casas & Ros 2000) on three Gauss
points a step, with the exponential in closed form. Points in between are reached by one shorter
step of the same kind, so they are as accurate as the nodes.

The planar parabola, the usual picture of a whisker's intrinsic shape.

    y = A x²,    s = (sinh w cosh w + w) / (4 A),    κ(s) = 2 A / cosh³ w,    sinh w = 2 A x

It is given by its arc length, not by its extent along x. w(s) is found by Newton's method; the
left side is convex and increasing in w, so that it converges from anywhere.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from vibrissa.numerics import Array
from vibrissa.whisker.profile import Profile, approximate, constant

Rate = Callable[[Array], Array]

STEPS = 96
"""Least number of steps along a whisker."""

TURN = 0.04
"""Largest angle a step may turn, rad: keeps the method's error near rounding."""

_GAUSS = 0.5 + np.sqrt(15.0) / 10.0 * np.array([-1.0, 0.0, 1.0])


def skew(w: Array) -> Array:
    """Matrices (..., 3, 3) of the cross product with vectors (..., 3)."""
    matrix = np.zeros((*w.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    return matrix - np.swapaxes(matrix, -1, -2)


def exponential(w: Array, v: Array) -> tuple[Array, Array]:
    """Rotation (..., 3, 3) and translation (..., 3) of the motions exp(w, v).

    Below 0.1 rad the coefficients come from their series, which are exact to rounding there while
    (θ − sin θ)/θ³ is not.
    """
    x = np.sum(w * w, axis=-1)[..., np.newaxis, np.newaxis]
    small = x < 1e-2
    theta = np.sqrt(np.where(small, 1.0, x))
    a = np.where(small, _series(x, 1.0, (6, 20, 42, 72)), np.sin(theta) / theta)
    b = np.where(small, _series(x, 1 / 2, (12, 30, 56, 90)), (1.0 - np.cos(theta)) / theta**2)
    c = np.where(small, _series(x, 1 / 6, (20, 42, 72, 110)), (theta - np.sin(theta)) / theta**3)
    k = skew(w)
    k2 = k @ k
    rotation = np.eye(3) + a * k + b * k2
    translation = ((np.eye(3) + b * k + c * k2) @ v[..., np.newaxis])[..., 0]
    return rotation, translation


def _series(x: Array, first: float, ratios: tuple[int, ...]) -> Array:
    total, term = np.full_like(x, first), np.full_like(x, first)
    for ratio in ratios:
        term = -term * x / ratio
        total = total + term
    return total


Screw = tuple[Array, Array]


def _bracket(left: Screw, right: Screw) -> Screw:
    """Commutator in se(3), with the sign that g' = g ξ asks for (opposite to g' = ξ g)."""
    (w1, v1), (w2, v2) = left, right
    return np.cross(w2, w1), np.cross(w2, v1) - np.cross(w1, v2)


def _sum(*terms: tuple[float, Screw]) -> Screw:
    return (
        np.sum([factor * screw[0] for factor, screw in terms], axis=0),
        np.sum([factor * screw[1] for factor, screw in terms], axis=0),
    )


def advance(rate: Rate, start: Array, step: Array, direction: Array) -> tuple[Array, Array]:
    """Motions over the steps [start, start + step], all (...), m."""
    u = rate(start[..., np.newaxis] + _GAUSS * step[..., np.newaxis])
    h = step[..., np.newaxis]
    still = np.zeros_like(u[..., 0, :])
    a1 = (h * u[..., 1, :], h * np.broadcast_to(direction, still.shape))
    a2 = (np.sqrt(15.0) / 3.0 * h * (u[..., 2, :] - u[..., 0, :]), still)
    a3 = (10.0 / 3.0 * h * (u[..., 2, :] - 2.0 * u[..., 1, :] + u[..., 0, :]), still)
    c1 = _bracket(a1, a2)
    c2 = _bracket(a1, _sum((-1 / 30, a3), (-1 / 60, c1)))
    outer = _bracket(_sum((-20.0, a1), (-1.0, a3), (1.0, c1)), _sum((1.0, a2), (1.0, c2)))
    return exponential(*_sum((1.0, a1), (1 / 12, a3), (1 / 240, outer)))


@dataclass(frozen=True, eq=False)
class Path:
    """Frames and points along a curve, known at nodes and reached in between by one step."""

    rate: Rate
    nodes: Array
    rotations: Array
    points: Array
    direction: Array

    @classmethod
    def integrate(cls, rate: Rate, joints: Array, direction: tuple[float, float, float]) -> "Path":
        """Integrate from joints[0], where the frame is the identity, to joints[-1]."""
        nodes = _step_ends(rate, joints)
        along = np.array(direction)
        turns, moves = advance(rate, nodes[:-1], np.diff(nodes), along)
        rotations = np.empty((nodes.size, 3, 3))
        points = np.empty((nodes.size, 3))
        rotations[0], points[0] = np.eye(3), 0.0
        for k in range(nodes.size - 1):
            rotations[k + 1] = rotations[k] @ turns[k]
            points[k + 1] = points[k] + rotations[k] @ moves[k]
        return cls(rate, nodes, rotations, points, along)

    def at(self, s: Array) -> tuple[Array, Array]:
        """Frames (..., 3, 3) and points (..., 3), m, at arc lengths (...), m."""
        k = np.clip(np.searchsorted(self.nodes, s, side="right") - 1, 0, self.nodes.size - 2)
        turn, move = advance(self.rate, self.nodes[k], s - self.nodes[k], self.direction)
        frame = self.rotations[k]
        return frame @ turn, self.points[k] + (frame @ move[..., np.newaxis])[..., 0]


def _step_ends(rate: Rate, joints: Array) -> Array:
    """Joints, and between them equal steps, short enough."""
    longest = (joints[-1] - joints[0]) / STEPS
    ends = [joints[:1]]
    for start, end in pairwise(joints):
        inside = start + (end - start) * np.linspace(0.02, 0.98, 25)
        fastest = float(np.linalg.norm(rate(inside), axis=-1).max())
        count = int(np.ceil((end - start) * max(1.0 / longest, fastest / TURN) - 1e-9))
        ends.append(np.linspace(start, end, max(count, 1) + 1)[1:])
    return np.concatenate(ends)


def proximal_roll(points: Array, weights: Array) -> float:
    """Roll about x that brings the proximal part closest to the x–y plane, bending toward +y."""
    across = points[:, 1:]
    moments = (weights[:, np.newaxis] * across).T @ across
    _, axes = np.linalg.eigh(moments)
    y, z = axes[:, 1]
    if weights @ (across @ axes[:, 1]) < 0.0:
        y, z = -y, -z
    return float(np.arctan2(z, y))


def parabola_curvature(length: float, coefficient: float) -> Profile:
    """Intrinsic curvature of y = A x², bending toward +y."""
    if coefficient == 0.0:
        return constant(np.zeros(3), length)

    def curvature(s: Array) -> Array:
        w = _parameter(4.0 * coefficient * s)
        kappa = 2.0 * coefficient / np.cosh(w) ** 3
        return np.stack([np.zeros_like(s), np.zeros_like(s), kappa], axis=-1)

    return approximate(curvature, np.array([0.0, length]))


def _parameter(arc: Array) -> Array:
    """Solve sinh w cosh w + w = arc ≥ 0."""
    w = np.arcsinh(0.5 * arc)
    for _ in range(60):
        change = (0.5 * np.sinh(2.0 * w) + w - arc) / (2.0 * np.cosh(w) ** 2)
        w = w - change
        if np.abs(change).max(initial=0.0) < 1e-15 * (1.0 + np.abs(w).max(initial=0.0)):
            break
    return w
