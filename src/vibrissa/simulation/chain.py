"""Discrete whisker model for dynamics: a chain of rigid straight links and elastic joints.

The whisker is divided into segments of length h and bends and twists at one joint in the middle of
each. A joint rotates by a rotation vector θ, R' = R exp θ, against a spring whose compliance is
that of its segment, ∫ ds/B. Links cannot stretch or shear, so that the vectors θ are the only
degrees of freedom; statics and small vibrations agree with those of the Kirchhoff rod to second
order in h. A base of finite stiffness is one more joint, at s = 0.

A rotation of joint j by δφ_j = A_j δθ_j (laboratory frame, A = R times the left Jacobian of exp)
moves every point x beyond it by δφ_j × (x - p_j). Therefore the mass, two points per link, enters
only by its moments of order zero to two beyond each joint.

The smooth centreline, used for contact with objects, is the quadratic B-spline of the joints: on
each segment a parabola between its two ends, with the joint as control point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vibrissa.deferred import transform
from vibrissa.numerics import Array, IntArray, kernel
from vibrissa.whisker import Whisker

_GRADING = 0.4  # exponent of the radius in the lengths of segments, shorter where it is thin
_GAUSS = np.polynomial.legendre.leggauss(5)


@dataclass(frozen=True, eq=False)
class Chain:
    """Links, joints and point masses of a whisker, SI units.

    ``nodes`` (n + 1,) are arc lengths of the ends of segments and ``joints`` (m,) those of joints;
    ``stiffness`` and ``rest`` (m, 3) are the stiffness of each joint in twist and bending and its
    rotation vector at rest. ``mass``, ``mass_arc`` and ``mass_link`` (k,) are the point masses,
    their arc lengths and the indices of their links.
    """

    nodes: Array
    joints: Array
    stiffness: Array
    rest: Array
    mass: Array
    mass_arc: Array
    mass_link: IntArray

    @classmethod
    def of(cls, whisker: Whisker, density: tuple[float, float], segments: int) -> Chain:
        """Chain of a whisker of a density, kg/m³, with shorter segments where it is thin."""
        nodes = _nodes(whisker, segments)
        h = np.diff(nodes)
        joints = nodes[:-1] + 0.5 * h
        s = nodes[:-1, None] + 0.5 * h[:, None] * (1.0 + _GAUSS[0])
        bending = whisker.youngs_modulus * np.pi / 4.0 * whisker.radius(s) ** 4
        bend = 1.0 / (0.5 * h * (_GAUSS[1] / bending).sum(axis=1))
        twist = bend / (1.0 + whisker.poisson_ratio)
        stiffness = np.stack([twist, bend, bend], axis=1)
        frames = whisker.frame(nodes)
        rest = transform.Rotation.from_matrix(
            np.swapaxes(frames[:-1], 1, 2) @ frames[1:]
        ).as_rotvec()
        if whisker.base_stiffness is not None:
            soft_bend, soft_twist = whisker.base_stiffness
            joints = np.concatenate([[0.0], joints])
            stiffness = np.concatenate([[[soft_twist, soft_bend, soft_bend]], stiffness])
            rest = np.concatenate([np.zeros((1, 3)), rest])
        edges = np.concatenate([[0.0], joints, [whisker.length]])
        # Two points of half a link's mass approximate its centre of mass and moment of inertia.
        middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
        arc = (middle[:, None] + half[:, None] * np.array([-1.0, 1.0]) / np.sqrt(3.0)).ravel()
        rho = density[0] + (density[1] - density[0]) * arc / whisker.length
        mass = rho * np.pi * whisker.radius(arc) ** 2 * np.repeat(half, 2)
        link = np.repeat(np.arange(edges.size - 1), 2)
        return cls(nodes, joints, stiffness, rest, mass, arc, link)

    @property
    def soft_base(self) -> bool:
        """Whether the first joint is that of a compliant base."""
        return bool(self.joints[0] == 0.0)

    def places(
        self, frames: Array, pivots: Array, base: Array, arc: Array, link: IntArray
    ) -> Array:
        """Points (k, 3) of the links at arc lengths (k,), laboratory frame, m."""
        start = np.concatenate([base[None], pivots])[link]
        from_ = np.concatenate([[0.0], self.joints])[link]
        return np.asarray(start + (arc - from_)[:, None] * frames[link, :, 0])

    def controls(self, frames: Array, pivots: Array, base: Array) -> Array:
        """Control points (n, 3, 3) of the smooth centreline on each segment."""
        first = 1 if self.soft_base else 0
        links = np.arange(self.nodes.size) + first
        ends = self.places(frames, pivots, base, self.nodes, links)
        return np.stack([ends[:-1], pivots[first:], ends[1:]], axis=1)


def bezier(t: Array) -> Array:
    """Weights (..., 3) of the control points at the fractions t of a segment."""
    return np.stack([(1.0 - t) ** 2, 2.0 * t * (1.0 - t), t * t], axis=-1)


def _nodes(whisker: Whisker, segments: int) -> Array:
    """Arc lengths (segments + 1,) of the ends of the segments, m."""
    s = np.linspace(0.0, whisker.length, 1025)
    middle = 0.5 * (s[1:] + s[:-1])
    thin = np.maximum(whisker.radius(middle) / whisker.base_radius, 0.02)
    share = np.concatenate([[0.0], np.cumsum(thin**-_GRADING)])
    return np.interp(np.linspace(0.0, share[-1], segments + 1), share, s)


@kernel
def configure(
    exp: Array,
    left: Array,
    joints: Array,
    rotation: Array,
    base: Array,
    frames: Array,
    pivots: Array,
    turns: Array,
) -> None:
    """Compute the pose of the links from exp θ and its left Jacobian, and the pose of the base.

    Fills ``frames`` (m + 1, 3, 3), the rotations of the links; ``pivots`` (m, 3), the positions of
    the joints; and ``turns`` (m, 3, 3), the matrices A of the module.
    """
    for a in range(3):
        for b in range(3):
            frames[0, a, b] = rotation[a, b]
    for j in range(joints.shape[0]):
        length = joints[j] - (joints[j - 1] if j > 0 else 0.0)
        for a in range(3):
            start = pivots[j - 1, a] if j > 0 else base[a]
            pivots[j, a] = start + length * frames[j, a, 0]
        for a in range(3):
            for b in range(3):
                turned, moved = 0.0, 0.0
                for c in range(3):
                    turned += frames[j, a, c] * exp[j, c, b]
                    moved += frames[j, a, c] * left[j, c, b]
                frames[j + 1, a, b] = turned
                turns[j, a, b] = moved


@kernel
def inertia(
    places: Array,
    mass: Array,
    link: IntArray,
    pull: Array,
    pivots: Array,
    turns: Array,
    residual: Array,
    matrix: Array,
) -> None:
    """Fill the generalised forces of ``pull`` (k, 3) on the masses, and the mass matrix."""
    m = pivots.shape[0]
    total, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    force, moment = np.zeros(3), np.zeros(3)
    block, half = np.empty((3, 3)), np.empty((3, 3))
    i = mass.shape[0] - 1
    for l in range(m - 1, -1, -1):
        while i >= 0 and link[i] > l:
            total += mass[i]
            for a in range(3):
                b, c = (a + 1) % 3, (a + 2) % 3
                first[a] += mass[i] * places[i, a]
                force[a] += pull[i, a]
                moment[a] += places[i, b] * pull[i, c] - places[i, c] * pull[i, b]
                for b in range(3):
                    second[a, b] += mass[i] * places[i, a] * places[i, b]
            i -= 1
        p = pivots[l]
        for a in range(3):
            value = 0.0
            for b in range(3):
                c, d = (b + 1) % 3, (b + 2) % 3
                value += turns[l, b, a] * (moment[b] - p[c] * force[d] + p[d] * force[c])
            residual[3 * l + a] = value
        for j in range(l + 1):
            q = pivots[j]
            trace = 0.0
            for a in range(3):
                trace += second[a, a] - first[a] * (p[a] + q[a]) + total * p[a] * q[a]
            for a in range(3):
                for b in range(3):
                    # -Σ m (x - p)(x - q)ᵀ, and the trace on the diagonal.
                    block[a, b] = -(
                        second[a, b] - first[a] * q[b] - p[a] * first[b] + total * p[a] * q[b]
                    )
                block[a, a] += trace
            for a in range(3):
                for b in range(3):
                    half[a, b] = 0.0
                    for c in range(3):
                        half[a, b] += block[a, c] * turns[l, c, b]
            for a in range(3):
                for b in range(3):
                    value = 0.0
                    for c in range(3):
                        value += turns[j, c, a] * half[c, b]
                    matrix[3 * j + a, 3 * l + b] = value
                    matrix[3 * l + b, 3 * j + a] = value


def jacobian(points: Array, links: IntArray, weights: Array, pivots: Array, turns: Array) -> Array:
    """Derivatives (3, 3 m) of a weighted sum of points of links with respect to the joints."""
    out = np.zeros((3, pivots.shape[0], 3))
    for point, link, weight in zip(points, links, weights, strict=True):
        away = weight * (point - pivots[:link])
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            out[i, :link] += turns[:link, j] * away[:, k, None] - turns[:link, k] * away[:, j, None]
    return out.reshape(3, -1)
