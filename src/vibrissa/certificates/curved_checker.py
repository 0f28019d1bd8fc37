"""Verification of a curved whisker's certificate on boxes, by other means than the search.

It shares nothing with the search but the file and the lemma. Backwards along the rod, with n, m and
q the force, the moment and the contact point relative to the current cross-section,

    n' = u × n,   m' = u × m - n × e₁,   q' = u × q + e₁,   u = κ + c∘m,   c = b⁻⁴,

polynomials X in t and in the unknowns are computed in plain floating point, step by step. The
distance of the true solution from them is bounded through their defect. With balls of radius e
about n, m, q and their derivatives, as u × rotates a difference without enlarging it,

    e_n' ≤ c|n| e_m + d_n,    e_m' ≤ ν c|m| e_m + e_n + d_m,

with ν the additional compliance in twist (a difference of moments is normal to what it turns), and
likewise for q and for derivatives. The defect d bounds X' - u × X - …: the terms of high order,
which are the sizes of all products minus those of the products that X contains. A step from the
contact, whose arc length is an unknown, to the middle of the box comes first; its polynomials are
made to agree at the contact.
"""

from __future__ import annotations

from itertools import product as combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

Array = NDArray[np.float64]

CURVED_PARTS = ("interior", "proximal", "distal", "fold", "rest")
DEGREE, ORDER = 3, 8
TOLERANCE = 1e-8  # ratio of the last Taylor coefficient to the states that determines a step
# Number of boxes computed together.
_SIDE_BY_SIDE = 64
_MOST_STEPS = 200
# Rounding errors, over the sum of the sizes of all products of a step (at most 400 units each of
# 2⁻⁵³), and of bounds themselves.
_LOST, _UP = 1e-12, 1.0 + 1e-10
_ARCS = 64  # number of arcs of the circle on which the turning of M_D is verified

_ROWS = sorted(
    (e for e in combinations(range(DEGREE + 1), repeat=3) if sum(e) <= DEGREE),
    key=lambda e: (sum(e), e),
)
_DEGREES = np.array([sum(e) for e in _ROWS])
# First monomial of each degree, and number of monomials up to each.
_FIRST, _UP_TO = (np.searchsorted(_DEGREES, range(DEGREE + 1), side) for side in ("left", "right"))
# For each monomial: number of others with which its product is kept, and indices of the products.
_MATES = _UP_TO[DEGREE - _DEGREES]
_TO = [
    np.array([_ROWS.index(tuple(np.add(a, b))) for b in _ROWS[:m]])
    for a, m in zip(_ROWS, _MATES, strict=True)
]


class Poly(NamedTuple):
    """Polynomials over n boxes: coefficients (monomials, n), and radii (n,) of the remainder."""

    coef: Array
    rest: Array

    def __add__(self, other: Poly | float) -> Poly:  # type: ignore[override]
        if not isinstance(other, Poly):
            other = _constant(other, self.rest.size)
        coef = self.coef + other.coef
        lost = _LOST * (np.abs(self.coef) + np.abs(other.coef)).sum(axis=0)
        return Poly(coef, (self.rest + other.rest + lost) * _UP)

    def __neg__(self) -> Poly:
        return Poly(-self.coef, self.rest)

    def __sub__(self, other: Poly) -> Poly:
        return self + -other

    def __mul__(self, other: Poly | float) -> Poly:  # type: ignore[override]
        if not isinstance(other, Poly):
            other = _constant(other, self.rest.size)
        coef = np.zeros_like(self.coef)
        for row, (to, mates) in enumerate(zip(_TO, _MATES, strict=True)):
            coef[to] += self.coef[row] * other.coef[:mates]
        a, b = (np.add.reduceat(np.abs(x.coef), _FIRST, axis=0)[None] for x in (self, other))
        rest = a.sum(axis=(0, 1)) * other.rest + (b.sum(axis=(0, 1)) + other.rest) * self.rest
        return Poly(coef, (_bound_dropped_products(a, b, 1) + rest) * _UP)

    @property
    def least(self) -> Array:
        """Lower bound."""
        return np.asarray(self.coef[0] - (np.abs(self.coef[1:]).sum(axis=0) + self.rest) * _UP)


def _constant(value: Array | float, number: int) -> Poly:
    """Constant polynomial."""
    coef = np.zeros((len(_ROWS), number))
    coef[0] = value
    return Poly(coef, np.zeros(number))


def _function(axis: int, half: Array, derivatives: list[Array], beyond: Array) -> Poly:
    """Taylor polynomial of a function of one unknown, whose next derivative ``beyond`` bounds."""
    out = _constant(derivatives[0], half.size)
    power, each = 1.0 + 0.0 * half, np.eye(3, dtype=int)[axis]
    for k, value in enumerate(derivatives):
        out.coef[_ROWS.index(tuple(k * each))] = value * power
        power = power * half / (k + 1)
    lost = 1e-13 * np.abs(derivatives).sum(axis=0)
    return Poly(out.coef, (beyond * power + lost) * _UP)


def _norms(x: Array, h: Array) -> Array:
    """Sizes (order, degree, ..., n) over a step h of vector series (order, monomial, ..., 3, n)."""
    size = np.sqrt((np.add.reduceat(np.abs(x), _FIRST, axis=1) ** 2).sum(axis=-2))
    power = h ** np.arange(len(x))[:, None]
    return np.asarray(size * power.reshape(len(x), *(1,) * (size.ndim - 2), h.size) * _UP)


def _bound_dropped_products(a: Array, b: Array, order: int) -> Array:
    """Bound on products of high order or degree, from sizes (order, degree, ...), and rounding."""
    total = a.sum(axis=(0, 1)) * b.sum(axis=(0, 1))
    below = b[:order].cumsum(axis=0).cumsum(axis=1)
    kept = 0.0 * total
    for k in range(min(len(a), order)):
        for degree in range(DEGREE + 1):
            kept += a[k, degree] * below[min(order - 1 - k, len(below) - 1), DEGREE - degree]
    return np.asarray(np.maximum(total - kept, 0.0) + _LOST * total)


class Rod(NamedTuple):
    """Local polynomials of the whisker about one point for each box, backwards along the rod.

    known: Taylor coefficients of the curvatures and of the radius (4, d, n); soft: those of the
    compliance; wrong: largest errors (2, n) of curvature and compliance over a step; twist: the
    compliance in twist over that in bending.
    """

    known: Array
    soft: Array
    wrong: Array
    twist: float


def _local_rod(data: xr.Dataset, piece: NDArray[np.int64], s: Array) -> Rod:
    """Taylor coefficients at s, without error bounds."""
    local, stored = data["rod_local"].values[piece], data["rod_coefficients"].values[piece]
    offset = (local[..., 0, 0] * s[:, None] + local[..., 1, 0]).T
    shift, size = -local[..., 0, 0].T, stored.shape[2]
    column = np.moveaxis(stored[..., 0], 0, -1).swapaxes(0, 1).copy()  # (d, 4, n)
    known = []
    for k in range(size):  # repeated Horner scheme: coefficients about the offset
        for j in range(size - 2, k - 1, -1):
            column[j] += offset * column[j + 1]
        known.append(column[k] * shift**k)
    b = np.stack(known)[:, 3]
    soft = [b[0] ** -4.0]
    for k in range(1, ORDER + 1):
        terms = ((-4.0 * j - (k - j)) * b[j] * soft[k - j] for j in range(1, min(k, size - 1) + 1))
        soft.append(sum(terms, 0.0 * s) / (k * b[0]))
    twist = float(data["rod_twist"].values[0])
    return Rod(np.stack(known, axis=1), np.stack(soft), np.zeros((2, len(s))), twist)


def _with_error_bounds(
    data: xr.Dataset, piece: NDArray[np.int64], s: Array, rod: Rod, h: Array
) -> Rod:
    """Add error bounds over a step h, for the compliance c̃ from b⁴c̃ - 1."""
    local, stored = data["rod_local"].values[piece], data["rod_coefficients"].values[piece]
    size, order = stored.shape[2], len(rod.soft)
    reach = np.abs(local[..., 0, 0]) * (np.abs(s)[:, None] + h[:, None]) + np.abs(local[..., 1, 0])
    # The local variable is a difference of numbers of this size, with a proportional error.
    inside = np.maximum(np.abs(local[..., 0, 0] * s[:, None] + local[..., 1, 0]), 1.0)
    inside = inside + np.abs(local[..., 0, 0]) * h[:, None]
    power = inside[..., None] ** np.arange(size)
    lost = 1e-14 * (1.0 + np.arange(size) * (reach / inside)[..., None])
    spread = ((stored[..., 1] + np.abs(stored[..., 0]) * lost) * power).sum(axis=-1).T
    series = rod.known[3] * h ** np.arange(size)[:, None]
    fourth = np.zeros((4 * (size - 1) + 1, h.size))
    fourth[0] = 1.0
    for _ in range(4):
        fourth = sum(np.roll(fourth, k, axis=0) * series[k] for k in range(size))
    soft = rod.soft * h ** np.arange(order)[:, None]
    residual = np.zeros((len(fourth) + order, h.size))
    for k in range(order):
        residual[k : k + len(fourth)] += soft[k] * fourth
    residual[0] -= 1.0
    lost_here = _LOST * np.abs(fourth).sum(axis=0) * np.abs(soft).sum(axis=0)
    least = series[0] - np.abs(series[1:]).sum(axis=0) - spread[3]
    least = np.where(least > 0.0, least, np.nan)
    wrong = (np.abs(residual).sum(axis=0) + lost_here) / least**4 + 4.0 * spread[3] / least**5
    curvature = np.sqrt((spread[:3] ** 2).sum(axis=0)) + 0.0 * h
    bounds = np.stack([curvature, wrong * rod.twist]) * _UP
    return rod._replace(wrong=bounds)


def _series(rod: Rod, start: Array, order: int) -> tuple[Array, Array]:
    """Taylor coefficients of the vectors (monomial, vector, group, 3, n), and of the curvature u.

    Vectors are n, m and optionally q; groups are the values and their derivatives by s_c, f_y, f_z.
    """
    monomials, vectors, groups, _, number = start.shape
    x = np.zeros((order + 1, *start.shape))
    x[0] = start
    u = np.zeros((order, monomials, groups, 3, number))
    left, right = np.zeros((2, *u.shape)), np.zeros((2, *x.shape))
    for k in range(order):
        u[k] = np.einsum("rn,rcgin->cgin", rod.soft[: k + 1], x[k::-1, :, 1])
        u[k, :, :, 0] *= rod.twist
        if k < rod.known.shape[1]:
            u[k, 0, 0] += rod.known[:3, k]
        for e, turn in enumerate((-1, -2)):
            left[e, k] = np.roll(u[k], turn, axis=-2) * (1.0, -1.0)[e]
            right[e, k] = np.roll(x[k], -3 - turn, axis=-2)
        rate = np.zeros_like(start)
        for row, (to, mates) in enumerate(zip(_TO, _MATES, strict=True)):
            a, b = left[:, : k + 1, row], right[:, k::-1, :mates]
            rate[to] += np.einsum("erin,erbvgin->bvgin", a[:, :, 0], b)
            rate[to, :, 1:] += np.einsum("ergin,erbvin->bvgin", a[:, :, 1:], b[:, :, :, :, 0])
        rate[:, 1, :, 1] -= x[k, :, 0, :, 2]
        rate[:, 1, :, 2] += x[k, :, 0, :, 1]
        if vectors > 2 and k == 0:
            rate[0, 2, 0, 0] += 1.0
        x[k + 1] = rate / (k + 1)
    return x, u


class Step(NamedTuple):
    """Bounds over a step: vectors (v, g, n), u (g, n), defects (v, g, n) and compliance (n,)."""

    size: Array
    turning: Array
    defect: Array
    soft: Array


def _bound_step(rod: Rod, x: Array, u: Array, h: Array) -> Step:
    """Bound the defect of the polynomials over |t| ≤ h."""
    order = len(u)
    turns, vectors = _norms(u, h), _norms(x, h)
    size, turning = vectors.sum(axis=(0, 1)), turns.sum(axis=(0, 1))
    soft = np.zeros((len(rod.soft), DEGREE + 1, 1, h.size))
    soft[:, 0, 0] = np.abs(rod.soft) * h ** np.arange(len(rod.soft))[:, None]
    most = soft.sum(axis=(0, 1, 2)) * _UP + rod.wrong[1]
    turned = (
        rod.twist * _bound_dropped_products(soft, vectors[:, :, 1], order) + rod.wrong[1] * size[1]
    )
    late = np.sqrt((rod.known[:3, order:] ** 2).sum(axis=0))
    late = (late * h ** np.arange(order, order + len(late))[:, None]).sum(axis=0)
    first = np.sqrt((rod.known[:3, :order] ** 2).sum(axis=0)).sum(axis=0)
    turned[0] += rod.wrong[0] + late * _UP + _LOST * first
    defect = _bound_dropped_products(turns[:, :, None, :1], vectors, order) + turned[0] * size
    defect[:, 1:] += _bound_dropped_products(turns[:, :, None, 1:], vectors[:, :, :, :1], order)
    defect[:, 1:] += turned[1:] * size[:, :1]
    defect[1] += vectors[order, :, 0].sum(axis=0)
    return Step(size, turning, (defect + _LOST * size) * _UP, most)


def _propagate_radii(step: Step, radii: Array, h: Array, twist: float) -> Array:
    """Radii (v, g, n) after a step, from the linear equations that bound them."""
    vectors, groups, number = radii.shape
    size, softest, uneven = step.size, step.soft * max(twist, 1.0), step.soft * abs(twist - 1.0)
    scale = (size + 1e-200).reshape(-1, number)
    start = (radii + h * step.defect).reshape(-1, number) / scale
    out = np.zeros_like(radii)
    for _ in range(2):  # radii of derivatives depend on those of the values, but not vice versa
        by = np.zeros((vectors, groups, vectors, groups, number))
        for v, g in np.ndindex(vectors, groups):
            soft = uneven if v == 1 else softest
            by[v, g, 1, 0] += soft * size[v, g]
            if g:
                by[v, g, v, 0] += soft * size[1, g]
                by[v, g, 1, g] += soft * size[v, 0] + softest * out[v, 0]
            if v == 1:
                by[v, g, 0, g] += 1.0
        matrix = h * by.reshape(len(start), len(start), number) * scale / scale[:, None]
        term, total = start, start.copy()
        for k in range(1, 30):
            term = np.einsum("ijn,jn->in", matrix, term) / k
            total += term
        total += 2.0 * term.max(axis=0)
        total[:, matrix.sum(axis=1).max(axis=0) > 10.0] = np.nan
        out = (total * scale * _UP).reshape(radii.shape)
    return out


def _compose(x: Array, half: Array) -> tuple[Array, Array]:
    """Σ x_k t^k at t = -half ε₁, and a bound on the omitted terms."""
    out = np.zeros_like(x[0])
    for k in range(min(len(x), DEGREE + 1)):
        row = _ROWS.index((k, 0, 0))
        out[_TO[row]] += x[k, : _MATES[row]] * (-half) ** k
    size = _norms(x, half)
    over = [size[k, max(DEGREE + 1 - k, 0) :].sum(axis=0) for k in range(len(x))]
    return out, np.asarray(np.sum(over, axis=0) + _LOST * size.sum(axis=(0, 1)))


def _from_contact(
    rod: Rod, half: Array, force: tuple[Poly, Poly], vectors: int
) -> tuple[Array, Array]:
    """States at the middle of the box's arc lengths, on the rod cut at the contact, and radii."""
    shape = (len(_ROWS), vectors, 4, 3, half.size)
    contact = np.zeros(shape)
    contact[:, 0, 0, 1:] = np.stack([one.coef for one in force], axis=1)
    contact[0, 0, 2, 1] = contact[0, 0, 3, 2] = 1.0
    state, missing, order = contact.copy(), np.zeros(shape), DEGREE + 1
    many = np.arange(1, order + 1)[(..., *(None,) * 5)]
    for _ in range(DEGREE + 3):
        state = state + missing
        x, u = _series(rod, state, order)
        there, left_out = _compose(x, half)
        # The contact moves and the load with it: this derivative is dx/dt of the values.
        rate, rate_left = _compose(x[1:, :, :, :1] * many, half)
        contact[:, :, 1] = rate[:, :, 0]
        missing = contact - there
    step = _bound_step(rod, x, u, half)
    off = np.sqrt((np.abs(missing).sum(axis=0) ** 2).sum(axis=-2)) + left_out
    off[0, 0] += sum(one.rest for one in force)
    values = off[:, 0]
    slope = step.turning[0] * values + step.soft * rod.twist * values[1] * (
        step.size[:, 0] + values
    )
    slope[1] += values[0]
    off[:, 1] += slope + step.defect[:, 0] + rate_left[:, 0]
    return state, _propagate_radii(step, off * _UP, half, rod.twist)


def _at_base(
    data: xr.Dataset, s: Array, half: Array, force: tuple[Poly, Poly], vectors: int
) -> list[list[list[Poly]]]:
    """States at the base, by vector, group and component."""
    edges = data["rod_edges"].values
    piece = np.clip(np.searchsorted(edges, s, side="left") - 1, 0, len(edges) - 2)
    rod = _local_rod(data, piece, s)
    state, radii = _from_contact(
        _with_error_bounds(data, piece, s, rod, half), half, force, vectors
    )
    at = s.copy()
    for _ in range(_MOST_STEPS):
        x, u = _series(rod, state, ORDER)
        size = np.sqrt((np.abs(x).sum(axis=1) ** 2).sum(axis=-2))
        scale = np.maximum(size[0], 1e-2 * size[0].max(axis=0))
        with np.errstate(divide="ignore"):
            h = (TOLERANCE * scale / size[ORDER]).min(axis=(0, 1)) ** (1.0 / ORDER)
        end = edges[piece]
        low = np.where(at - h > end + 0.05 * (at - end), at - h, end)
        h = (at - low) * (1.0 + 1e-15)
        step = _bound_step(_with_error_bounds(data, piece, at, rod, h), x, u, h)
        radii = _propagate_radii(step, radii, h, rod.twist) + _LOST * step.size
        state = x[ORDER]
        for k in range(ORDER - 1, -1, -1):
            state = state * h + x[k]
        at, piece = low, np.where(low == end, np.maximum(piece - 1, 0), piece)
        if not (at > 0.0).any():
            break
        rod = _local_rod(data, piece, at)
    radii[..., at > 0.0] = np.nan
    return [
        [[Poly(state[:, v, g, i], radii[v, g]) for i in range(3)] for g in range(4)]
        for v in range(vectors)
    ]


class _Load(NamedTuple):
    """Unknowns and force on boxes, with the force's derivatives by s, φ and ℓ."""

    s: Poly
    cos: Poly
    sin: Poly
    least: Poly
    extent: Poly
    f: Poly
    by_s: Poly
    by_phi: Poly


def _loads(data: xr.Dataset, bounds: Array, rest: bool) -> _Load:
    """Evaluate the bounds on the force; for contacts near rest the force is f_min ℓ."""
    middle, half = bounds.mean(axis=-1).T, 0.5 * np.ptp(bounds, axis=-1).T * (1.0 + 1e-12) + 1e-15
    one, none = np.ones_like(middle[0]), np.zeros_like(middle[0])
    s = _function(0, half[0], [middle[0], one], none)
    level = _function(2, half[2], [middle[2], one], none)
    c, d = np.cos(middle[1]), np.sin(middle[1])
    cos = _function(1, half[1], [c, -d, -c, d], one)
    sin = _function(1, half[1], [d, c, -d, -c], one)
    inverse = [(-1.0) ** k * np.prod(range(1, k + 1)) / middle[0] ** (k + 1) for k in range(4)]
    over = _function(0, half[0], inverse, 24.0 / (middle[0] - half[0]) ** 5)
    q = over + -float(data.attrs["alpha"])
    turn = [_constant(1.0, one.size), cos, sin, cos * cos]
    limits: list[Poly] = []
    slopes: list[Poly] = []
    for row in data["factors"].values:
        p, dp = _constant(0.0, one.size), _constant(0.0, one.size)
        for factor in row[::-1]:
            dp = dp * s + p
            p = p * s + float(factor)
        limits.append(q * q * p)
        slopes.append(q * q * dp - q * (over * over) * p * 2.0)
    least, by_s, none_ = limits[0], slopes[0], _constant(0.0, one.size)
    if rest:
        return _Load(s, cos, sin, least, least, least * level, by_s * level, none_)
    extent = sum((a * b for a, b in zip(limits[1:], turn, strict=True)), -least)
    slope = sum((a * b for a, b in zip(slopes[1:], turn, strict=True)), -by_s)
    swing = limits[3] * cos - limits[2] * sin - limits[4] * cos * sin * 2.0
    return _Load(
        s, cos, sin, least, extent, least + extent * level, by_s + slope * level, swing * level
    )


def _determinant(rows: list[list[Poly]]) -> Poly:
    """Determinant of a (3, 3) matrix of polynomials."""
    a, b, c = rows
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


def is_certificate_of(data: xr.Dataset, whisker: Whisker) -> bool:
    """Whether the file's polynomials agree with a whisker's at many points."""
    edges, length = data["rod_edges"].values, whisker.length
    s = (edges[:-1, None] + np.diff(edges)[:, None] * np.linspace(0.05, 0.95, 9)).ravel()
    rod = _local_rod(data, np.arange(len(edges) - 1).repeat(9), s)
    curvature = np.asarray(whisker.intrinsic_curvature(s * length)).T * length
    radius = np.asarray(whisker.section_radius(s * length)) / whisker.base_radius
    same = np.abs(np.stack([*curvature, radius]) - rod.known[:, 0]) < 1e-12
    alike = abs(rod.twist - 1.0 - whisker.poisson_ratio) < 1e-12
    return bool(same.all() and alike and whisker.base_stiffness is None)


def domains_match(data: xr.Dataset) -> bool:
    """Whether the parts match the lemma, the excluded contacts are in the cone, and M_D turns."""
    attrs, edges, stations = data.attrs, data["rod_edges"].values, data["stations"].values
    near, angle = float(stations[0]), data["interior_domain"].values[1]
    # A planar whisker is its own mirror image; half of a domain then represents the whole.
    planar = not data["rod_coefficients"].values[:, :2].any()
    circle = angle[1] > np.pi and (angle[0] == -angle[1] or (planar and angle[0] == 0.0))
    for part in CURVED_PARTS:
        reach = {"proximal": [near, near], "distal": [1.0, 1.0]}.get(part, [near, 1.0])
        level = [1.0, 1.0] if part == "fold" else [0.0, 1.0]
        if not np.array_equal(data[f"{part}_domain"].values, [reach, angle, level]):
            return False
    inner = edges[(edges > near) & (edges < 1.0)]
    rising = all((np.diff(one) > 0.0).all() for one in (stations, edges))
    ends = edges[0] == 0.0 < near and edges[-1] == stations[-1] == 1.0
    pieces = rising and ends and np.isin(inner, stations).all()
    slope, offset = np.moveaxis(data["rod_local"].values[..., 0], -1, 0)
    within = (
        np.abs([slope * e[:, None] + offset for e in (edges[:-1], edges[1:])]).max() < 1 + 1e-12
    )
    kappa = float(
        np.hypot(*np.abs(data["rod_coefficients"].values[:, 1:3]).sum(axis=(2, 3)).T).max()
    )
    # Only the square of `room` is compared, so that a negative one would allow any deflection.
    acute = 0.0 < attrs["cone"] < 0.5 * np.pi and attrs["room"] > 0.0
    sine = float(np.sin(attrs["cone"]))
    k = 1.0 - kappa * sine - (kappa * np.pi * sine) ** 2 / 12.0
    small = kappa < np.pi and np.pi * sine < 1.0 and k > 0.0
    cone = acute and small and attrs["room"] <= np.sqrt(k) * sine
    return bool(circle and pieces and within and cone) and _direction_turns_once(data, angle)


def _direction_turns_once(data: xr.Dataset, angle: Array) -> bool:
    """Whether M_D turns once with φ on the circle s = 1, ℓ = 1/2, or by π on half of it."""
    bounds = np.tile([[1.0, 1.0], [0.0, 0.0], [0.5, 0.5]], (_ARCS, 1, 1))
    ends = np.linspace(angle[0], angle[1], _ARCS + 1)
    bounds[:, 1] = np.stack([ends[:-1], ends[1:]], axis=1)
    moment = _states_on_boxes(data, bounds, _loads(data, bounds, False), 2)[1][0][1:]
    # On each arc M_D is within 45° of its middle, so neighbouring middles differ by less than 90°.
    reach = sum((np.abs(one.coef[1:]).sum(axis=0) + one.rest) ** 2 for one in moment)
    y, z = (one.coef[0] for one in moment)
    turn = np.unwrap(np.arctan2(np.append(z, z[:1]), np.append(y, y[:1])))
    whole = turn[-1 if angle[0] < 0.0 else -2] - turn[0]
    expected = 2.0 * np.pi if angle[0] < 0.0 else np.pi
    return bool((2.1 * reach < y**2 + z**2).all() and abs(whole - expected) < 1.5)


def conditions_hold(data: xr.Dataset, part: str, bounds: Array, _step: float) -> NDArray[np.bool_]:
    """Whether all conditions of a part are proved on each box (n, 3, 2)."""
    order = np.argsort(bounds[:, 0, 0])
    inner = data["rod_edges"].values[1:-1, None]
    apart = ((inner > bounds[:, 0, 0] + 1e-11) & (inner < bounds[:, 0, 1] - 1e-11)).any(axis=0)
    holds = np.zeros(len(bounds), dtype=bool)
    for start in range(0, len(bounds), _SIDE_BY_SIDE):
        rows = order[start : start + _SIDE_BY_SIDE]
        with np.errstate(all="ignore"):  # failed enclosures overflow
            forms = condition_polynomials(data, part, bounds[rows])
            holds[rows] = np.min([one.least for one in forms], axis=0) > 0.0
    return holds & ~apart


def _states_on_boxes(
    data: xr.Dataset, bounds: Array, load: _Load, vectors: int
) -> list[list[list[Poly]]]:
    """States at the base over boxes (n, 3, 2)."""
    middle, half = bounds[:, 0].mean(axis=1), 0.5 * np.ptp(bounds[:, 0], axis=1) * (1.0 + 1e-12)
    return _at_base(data, middle, half + 1e-15, (load.f * load.cos, load.f * load.sin), vectors)


def condition_polynomials(data: xr.Dataset, part: str, bounds: Array) -> list[Poly]:
    """Polynomials of the conditions of a part, all of which must be positive."""
    load = _loads(data, bounds, part == "rest")
    states = _states_on_boxes(data, bounds, load, 3 if part in ("fold", "rest") else 2)
    if part == "fold":
        return [-_determinant([states[2][g] for g in (1, 2, 3)])]
    if part == "rest":
        along = [load.cos * y + load.sin * z for y, z in zip(*states[2][2:], strict=True)]
        moved = [load.least * one for one in along]
        allowed = load.s * float(data.attrs["room"])
        return [allowed * allowed - moved[0] * moved[0] - moved[1] * moved[1] - moved[2] * moved[2]]
    # M_y, M_z and F_x, and their derivatives by s_c, f_y, f_z; then by s, φ and ℓ.
    value, *raw = ([states[1][g][1], states[1][g][2], states[0][g][0]] for g in range(4))
    y, z, x = value
    along = [load.cos * a + load.sin * b for a, b in zip(raw[1], raw[2], strict=True)]
    across = [load.cos * b - load.sin * a for a, b in zip(raw[1], raw[2], strict=True)]
    by_s = [a + load.by_s * b for a, b in zip(raw[0], along, strict=True)]
    by_phi = [load.by_phi * a + load.f * b for a, b in zip(along, across, strict=True)]
    by_level = [load.extent * a for a in along]
    out = [load.least, load.extent]
    sign = float(data.attrs["sign"])
    if part == "interior":
        out.append(-(y * by_s[0] + z * by_s[1]))
        out.append(by_s[1] * by_phi[0] - by_s[0] * by_phi[1])
        out.append(_determinant(raw) * sign)
        return out
    square = y * y + z * z

    def turned(by: list[Poly]) -> tuple[Poly, Poly]:
        return y * by[1] - z * by[0], square * by[2] - x * (y * by[0] + z * by[1])

    (turn_phi, force_phi), (turn_level, force_level) = turned(by_phi), turned(by_level)
    out.append(turn_phi)
    out.append((turn_phi * force_level - turn_level * force_phi) * sign)
    return out
