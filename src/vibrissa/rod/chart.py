"""Chart of the stable set Ω of frictionless contacts of a whisker.

A frictionless contact is ξ = (s_c, f_y, f_z). At fixed s_c the force grows along a ray of bearing
ψ, f = f (cos ψ, sin ψ), from rest to the *fold*, where det ∂p/∂ξ first vanishes: there the stable
equilibrium meets an unstable one and a frictionless whisker slips off. The contacts between rest
and fold, for s_c between ``proximal`` and the tip, are the stable ones connected to rest. In terms
of the fold force f*(s_c, ψ) they are parametrised by

    ξ = (s(η), ρ² f*(s, ψ) cos ψ, ρ² f*(s, ψ) sin ψ),   0 ≤ η ≤ 1,   0 ≤ ρ ≤ 1,
    s(η) = 1 - (1 - proximal) ((1 - a)(1 - η) + a (1 - η)²),

a box in (η, ψ, ρ), periodic in ψ. Its cells are denser toward rest, where the signals vanish and
their ratios vary fast, and (by the grading a) toward a thin tip, where the fold force falls
steeply. Each node of the chart's grid holds the base force F, the contact point p and their exact
derivatives. ln f* is interpolated by bicubic Hermite patches.

Between the nodes (F, p) is interpolated (`interpolate`), fifteen times as fast as the rod is
integrated. In each cell it is a blend of the cubics along the cell's twelve edges that have the
values and slopes of the nodes, as in :mod:`vibrissa.rod.tree`. With l the linear and φ and χ the
two Hermite weights of a corner's side along an axis, and g = φ - l, a corner contributes

    (l l l + g l l + l g l + l l g) v + χ l l ∂v/∂η + l χ l ∂v/∂ψ + l l χ ∂v/∂ρ,

the three factors of a product belonging to η, ψ and ρ. All cubics are reproduced. Differences
between neighbouring contacts are accurate to about one part in a thousand: enough to explore the
uncertainty of a contact, not to locate it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from vibrissa.numerics import AnyArray, Array, Vector, inlined, kernel, vectorised
from vibrissa.rod.discretization import STEPS, Bendable, Discretization, Rod, discretize
from vibrissa.rod.integration import solve_forces

#: Default of the smallest arc length of a contact, over L.
PROXIMAL = 0.3
#: Cells of the chart along (η, ψ, ρ).
CELLS = (16, 32, 16)
# The fold is searched up to this multiple of the force that would deflect the contact by its own
# arc length if the whisker were linear; straight, curved, conical and cylindrical whiskers fold
# below 4.
_LARGEST_FORCE = 12.0
_SCAN = 0.0625  # increment of that multiple
# A nearly cylindrical whisker that is bent in its plane begins to slip off in the plane and out of
# it at nearly the same force; det ∂p/∂ξ < 0 only between the two. Where sampled values have a
# minimum, it is refined by this many parabolas, and counts as zero if it is below this share of the
# value at rest.
_PARABOLAS, _ZERO_DETERMINANT = 8, 1e-9
_GRADING = 0.85  # grading toward a tip of radius zero
#: Smallest arc length at which contacts are solved, over L.
LEAST_ARC = 0.05
_MOST_CURTAILMENTS = 6  # most rounds in which the chart is reduced to contacts that can be solved
#: Directions have no value at zero force; just above it, at this ρ, they have their limit.
LEAST_LOAD = 0.01


class Fold(NamedTuple):
    """The fold force over the chart, for the kernels."""

    bounds: Array  # (2,), smallest arc length, over L, and grading a of the chart
    # (n, m + 1, 4) ln f* and its derivatives by η, ψ, and both, at the chart's nodes.
    log_force: Array


@dataclass(frozen=True, eq=False)
class StableSet:
    """Chart of the stable contacts of one whisker, non-dimensional."""

    discretization: Discretization  # rod and units
    stations: Array  # (i,), arc lengths of the nodes, over L
    # (j,) Bearings ψ of the force at the nodes, rad; the last is the first plus 2π.
    bearings: Array
    loads: Array  # (k,), square roots ρ of the force at the nodes, relative to the fold force
    fold: Fold  # fold force over the chart
    contacts: Array  # (i, j, k, 3), contacts ξ = (s, f_y, f_z) at the nodes
    values: Array  # (i, j, k, 6), base force and contact point (F, p) there
    tangents: Array  # (i, j, k, 6, 3), derivatives of the values by ξ
    frames: Array  # (i, j, k, 3, 3), derivatives of ξ by (η, ψ, ρ)
    folded: AnyArray  # (i, j), whether a fold was found along each ray

    @property
    def proximal(self) -> float:
        """Smallest charted arc length, over L."""
        return float(self.stations[0])

    def charted(self, derivatives: Array) -> Array:
        """Convert derivatives by ξ at the nodes into derivatives by (η, ψ, ρ)."""
        return np.asarray(np.einsum("...ij,...jk->...ik", derivatives, self.frames))


@lru_cache(maxsize=16)
def stable_set(
    whisker: Bendable,
    proximal: float = PROXIMAL,
    cells: tuple[int, int, int] = CELLS,
    steps: int = STEPS,
) -> StableSet:
    """Compute the chart of a whisker's stable contacts; cached.

    ``proximal`` is the smallest arc length of a contact, over L, and ``cells`` the number of cells
    along (η, ψ, ρ).
    """
    if not 0.05 <= proximal < 1.0:
        raise ValueError(
            f"the smallest arc length is {proximal} L; it must be from 0.05 L to below L"
        )
    discretization = discretize(whisker, steps)
    grading = _GRADING * max(0.0, 1.0 - whisker.tip_radius / whisker.base_radius)
    eta = np.linspace(0.0, 1.0, cells[0] + 1)
    stations = 1.0 - (1.0 - proximal) * ((1.0 - grading) * (1.0 - eta) + grading * (1.0 - eta) ** 2)
    stretch = (1.0 - proximal) * (1.0 - grading + 2.0 * grading * (1.0 - eta))
    bearings = np.linspace(0.0, 2.0 * np.pi, cells[1] + 1)
    loads = np.linspace(0.0, 1.0, cells[2] + 1)
    force, folded = _fold_forces(discretization, stations, bearings[:-1])
    for _ in range(_MOST_CURTAILMENTS):
        log_fold = _log_fold(eta, bearings, force)
        contacts, frames = _nodes_of(log_fold, stations, bearings, loads, stretch)
        values, tangents = solve_forces(
            discretization, with_normal_force(contacts.reshape(-1, 3)), tangents=True
        )
        lost: AnyArray = np.isnan(tangents.sum(axis=(1, 2))).reshape(contacts.shape[:3])
        if discretization.rod.weight is None or not lost.any():
            break
        # Under its weight a whisker may topple before it slips off; the chart ends there.
        held = np.where(lost.any(axis=2), loads[np.maximum(lost.argmax(axis=2) - 1, 1)], 1.0)
        force *= np.minimum(held[:, :-1], 1.0) ** 2
    grid = contacts.shape[:3]
    return StableSet(
        discretization=discretization,
        stations=stations,
        bearings=bearings,
        loads=loads,
        fold=Fold(np.array([proximal, grading]), log_fold),
        contacts=contacts,
        values=values.reshape(*grid, 6),
        tangents=tangents.reshape(*grid, 6, 3),
        frames=frames,
        folded=np.concatenate([folded, folded[:, :1]], axis=1),
    )


def _nodes_of(
    log_fold: Array, stations: Array, bearings: Array, loads: Array, stretch: Array
) -> tuple[Array, Array]:
    """Contacts at the nodes, and their derivatives by (η, ψ, ρ)."""
    s, psi, rho = np.meshgrid(stations, bearings, np.maximum(loads, LEAST_LOAD), indexing="ij")
    log, by_eta, by_psi, _ = np.moveaxis(log_fold[:, :, None], -1, 0)
    f = np.exp(log)
    f_eta, f_psi = f * by_eta, f * by_psi
    cos, sin = np.cos(psi), np.sin(psi)
    contacts = np.stack([s, rho**2 * f * cos, rho**2 * f * sin], axis=-1)
    zero = np.zeros_like(s)
    frames = np.stack(
        [
            np.stack([zero + stretch[:, None, None], zero, zero], axis=-1),
            np.stack(
                [rho**2 * f_eta * cos, rho**2 * (f_psi * cos - f * sin), 2.0 * rho * f * cos],
                axis=-1,
            ),
            np.stack(
                [rho**2 * f_eta * sin, rho**2 * (f_psi * sin + f * cos), 2.0 * rho * f * sin],
                axis=-1,
            ),
        ],
        axis=-2,
    )
    return contacts, frames


def with_normal_force(contacts: Array) -> Array:
    """Convert ξ = (s, f_y, f_z) into (s, 0, f_y, f_z): frictionless forces are normal."""
    out = np.empty((*contacts.shape[:-1], 4))
    out[..., 0], out[..., 1], out[..., 2:] = contacts[..., 0], 0.0, contacts[..., 1:]
    return out


def determinant(tangents: Array) -> Array:
    """Det ∂p/∂ξ: positive at rest, zero at the fold."""
    a, b, c = (tangents[..., 3:, j] for j in range(3))
    return np.asarray(np.einsum("...i,...i->...", a, np.cross(b, c)))


def _fold_forces(
    discretization: Discretization, stations: Array, bearings: Array
) -> tuple[Array, AnyArray]:
    """Force (n, m) at the first zero of det ∂p/∂ξ along each ray, and whether there is one."""
    rest = np.zeros((stations.size, 4))
    rest[:, 0] = stations
    at_rest = determinant(solve_forces(discretization, rest, tangents=True)[1])
    # √det is the compliance at the contact: in linear theory this force deflects it by its arc
    # length.
    unit = np.repeat(stations / np.sqrt(at_rest), bearings.size)
    sign = np.repeat(at_rest, bearings.size)
    s = np.repeat(stations, bearings.size)
    psi = np.tile(bearings, stations.size)

    def relative_determinant(rays: AnyArray, force: Array) -> Array:
        f = force * unit[rays]
        contacts = np.stack(
            [s[rays], 0.0 * f, f * np.cos(psi[rays]), f * np.sin(psi[rays])], axis=-1
        )
        with np.errstate(invalid="ignore", over="ignore"):
            found = (
                determinant(solve_forces(discretization, contacts, tangents=True)[1]) / sign[rays]
            )
        # The integration may overflow far beyond a fold, where no contact is stable.
        return np.where(np.isfinite(found), found, -1.0)

    low, high = np.zeros(s.size), np.full(s.size, np.inf)
    at_low, at_high = np.ones(s.size), np.full(s.size, np.nan)
    before = np.full(s.size, -np.inf)  # determinant one step before ``low``
    open_rays = np.arange(s.size)
    force = _SCAN
    while open_rays.size and force <= _LARGEST_FORCE:
        found = relative_determinant(open_rays, np.full(open_rays.size, force))
        beyond = found <= 0.0
        high[open_rays[beyond]], at_high[open_rays[beyond]] = force, found[beyond]
        dips = (found > at_low[open_rays]) & (before[open_rays] > at_low[open_rays])
        rays = open_rays[dips]
        steps = force + np.array([[-2.0], [-1.0], [0.0]]) * _SCAN
        values = np.stack([before[rays], at_low[rays], found[dips]])
        where, least = _minimize_by_parabolas(
            partial(relative_determinant, rays), steps + 0.0 * values, values
        )
        crossed = least <= _ZERO_DETERMINANT
        rays = rays[crossed]
        high[rays], at_high[rays] = where[crossed], np.minimum(least[crossed], -_ZERO_DETERMINANT)
        low[rays], at_low[rays] = force - 2.0 * _SCAN, before[rays]
        on = ~np.isfinite(high[open_rays])
        open_rays = open_rays[on]
        before[open_rays] = at_low[open_rays]
        low[open_rays], at_low[open_rays] = force, found[on]
        force += _SCAN
    folded = np.isfinite(high)
    rays = np.flatnonzero(folded)
    for _ in range(40):  # regula falsi with the Illinois correction
        guess = low[rays] + (high[rays] - low[rays]) * at_low[rays] / (at_low[rays] - at_high[rays])
        found = relative_determinant(rays, guess)
        inside = found > 0.0
        a, b = rays[inside], rays[~inside]
        low[a], at_low[a], at_high[a] = guess[inside], found[inside], 0.5 * at_high[a]
        high[b], at_high[b], at_low[b] = guess[~inside], found[~inside], 0.5 * at_low[b]
        rays = rays[(np.abs(found) > 1e-10) & (high[rays] - low[rays] > 1e-12 * high[rays])]
        if not rays.size:
            break
    shape = (stations.size, bearings.size)
    # The lower end of the bracket is on the stable side.
    return (low * unit).reshape(shape), folded.reshape(shape)


def _minimize_by_parabolas(
    function: Callable[[Array], Array], x: Array, y: Array
) -> tuple[Array, Array]:
    """Minima by successive parabolas, from values y (3, n) at increasing x (3, n), y[1] least."""
    for _ in range(_PARABOLAS if x.size else 0):
        left, right = (y[1] - y[0]) / (x[1] - x[0]), (y[2] - y[1]) / (x[2] - x[1])
        vertex = 0.5 * (x[0] + x[1]) - 0.5 * left * (x[2] - x[0]) / (right - left)
        # Keep away from the point whose value is known already.
        apart = 1e-3 * (x[2] - x[0])
        vertex = np.where(np.abs(vertex - x[1]) < apart, x[1] + apart, vertex)
        at, value = [vertex, x[1]], [function(vertex), y[1]]
        lower = value[0] < value[1]
        middle, other = (np.where(lower, *both) for both in (at, at[::-1]))
        y_middle, y_other = (np.where(lower, *both) for both in (value, value[::-1]))
        ahead = other > middle
        x = np.stack([np.where(ahead, x[0], other), middle, np.where(ahead, other, x[2])])
        y = np.stack([np.where(ahead, y[0], y_other), y_middle, np.where(ahead, y_other, y[2])])
    return x[1], y[1]


def _log_fold(eta: Array, bearings: Array, force: Array) -> Array:
    """Table of ln f* at the nodes: value and derivatives by η, ψ, and both; periodic in ψ."""
    values = np.log(np.concatenate([force, force[:, :1]], axis=1))
    in_psi = _slopes(bearings, values.T, periodic=True).T
    in_s, in_both = _slopes(eta, values), _slopes(eta, in_psi)
    return np.ascontiguousarray(np.stack([values, in_s, in_psi, in_both], axis=-1))


def _slopes(x: Array, values: Array, periodic: bool = False) -> Array:
    """Slopes of the cubic spline through values (n, m) at x, periodic or not-a-knot.

    SciPy's `CubicSpline` gives the same, but importing it takes longer than solving for a contact.
    """
    if not periodic and len(x) < 4:  # slopes of a parabola or a line
        return np.asarray(np.gradient(values, x, axis=0, edge_order=2 if len(x) > 2 else 1))
    h, secants = np.diff(x), np.diff(values, axis=0) / np.diff(x)[:, None]
    i = np.arange(0 if periodic else 1, len(h))
    size = len(h) if periodic else len(x)
    system, right = np.zeros((size, size)), np.zeros((size, values.shape[1]))
    system[i, i - 1] += h[i]
    system[i, (i + 1) % size] += h[i - 1]  # with two periodic nodes, the same entry as above
    system[i, i] += 2.0 * (h[i - 1] + h[i])
    right[i] = 3.0 * (h[i, None] * secants[i - 1] + h[i - 1, None] * secants[i])
    if periodic:
        slopes = np.asarray(np.linalg.solve(system, right), dtype=np.float64)
        return np.concatenate([slopes, slopes[:1]])
    for end, next_ in ((0, 1), (-1, -2)):
        near, far = h[end], h[next_]
        share = near / (near + far)
        system[end, [end, next_]] = far, near + far
        right[end] = far * (2.0 + share) * secants[end] + near * share * secants[next_]
    return np.asarray(np.linalg.solve(system, right))


def contacts_at(fold: Fold, chart: Array) -> Array:
    """Convert chart coordinates (η, ψ, ρ) (n, 3) into contacts ξ (n, 3)."""
    contacts = np.empty((len(chart), 3))
    _contacts_at(fold, np.ascontiguousarray(chart), contacts)
    return contacts


@inlined
def _hermite(t: float) -> tuple[float, float, float, float]:
    """Cubic Hermite weights: value and slope at 0, value and slope at 1."""
    u = 1.0 - t
    return u * u * (1.0 + 2.0 * t), t * u * u, t * t * (3.0 - 2.0 * t), -t * t * u


@inlined
def along(bounds: Array, s: float) -> float:
    """Chart coordinate η of an arc length s; ``bounds`` is (proximal, a)."""
    rest = 1.0 - bounds[1]
    left = max(1.0 - s, 0.0) / (1.0 - bounds[0])
    return float(1.0 - 2.0 * left / (rest + np.sqrt(rest * rest + 4.0 * bounds[1] * left)))


@inlined
def arc_length(bounds: Array, eta: float) -> float:
    """Arc length s of a chart coordinate η; ``bounds`` is (proximal, a)."""
    left = 1.0 - eta
    return float(
        1.0 - (1.0 - bounds[0]) * ((1.0 - bounds[1]) * left + bounds[1] * abs(left) * left)
    )


@inlined
def _hermite_slopes(t: float) -> tuple[float, float, float, float]:
    """Derivatives of the cubic Hermite weights."""
    u = 1.0 - t
    return -6.0 * t * u, u * (1.0 - 3.0 * t), 6.0 * t * u, t * (3.0 * t - 2.0)


@inlined
def log_fold_force(fold: Fold, eta: float, psi: float) -> tuple[float, float, float]:
    """Ln f*(η, ψ) with its derivatives by η and ψ; η is clipped to the chart, ψ is any angle."""
    table = fold.log_force
    n, m = table.shape[0] - 1, table.shape[1] - 1
    dpsi = 2.0 * np.pi / m
    x = n * min(max(eta, 0.0), 1.0)
    y = psi / dpsi
    y -= m * np.floor(y / m)
    i, j = min(int(x), n - 1), min(int(y), m - 1)
    a, b = _hermite(x - i), _hermite(y - j)
    a_slope, b_slope = _hermite_slopes(x - i), _hermite_slopes(y - j)
    log, by_eta, by_psi = 0.0, 0.0, 0.0
    for di in range(2):
        for dj in range(2):
            node = table[i + di, j + dj]
            here = b[2 * dj] * node[0] + b[2 * dj + 1] * dpsi * node[2]
            rise = (b[2 * dj] * node[1] + b[2 * dj + 1] * dpsi * node[3]) / n
            log += a[2 * di] * here + a[2 * di + 1] * rise
            by_eta += n * (a_slope[2 * di] * here + a_slope[2 * di + 1] * rise)
            here = b_slope[2 * dj] / dpsi * node[0] + b_slope[2 * dj + 1] * node[2]
            rise = (b_slope[2 * dj] / dpsi * node[1] + b_slope[2 * dj + 1] * node[3]) / n
            by_psi += a[2 * di] * here + a[2 * di + 1] * rise
    return log, by_eta, by_psi


@inlined
def fold_force(fold: Fold, s: float, psi: float) -> float:
    """Fold force f*(s, ψ), non-dimensional; s is clipped to the chart, ψ is any angle."""
    return float(np.exp(log_fold_force(fold, along(fold.bounds, s), psi)[0]))


@inlined
def chart_to_contact(fold: Fold, chart: Array, xi: Array) -> None:
    """Convert (η, ψ, ρ) into ξ, written to ``xi``."""
    xi[0] = min(max(arc_length(fold.bounds, chart[0]), LEAST_ARC), 1.0)
    force = chart[2] * chart[2] * fold_force(fold, xi[0], chart[1])
    xi[1], xi[2] = force * np.cos(chart[1]), force * np.sin(chart[1])


@kernel
def _contacts_at(fold: Fold, chart: Array, contacts: Array) -> None:
    for i in range(chart.shape[0]):
        chart_to_contact(fold, chart[i], contacts[i])


def chart_of(fold: Fold, contacts: Array) -> Array:
    """Convert contacts ξ (n, 3) into chart coordinates (η, ψ, ρ)."""
    chart = np.empty((len(contacts), 3))
    _chart_of(fold, np.ascontiguousarray(contacts), chart)
    return chart


def fold_forces(fold: Fold, contacts: Array) -> Array:
    """Fold force (n,), over EI/L², at the arc length and bearing of each contact ξ (n, 3)."""
    forces = np.empty(len(contacts))
    _fold_forces_at(fold, np.ascontiguousarray(contacts), forces)
    return forces


@kernel
def _chart_of(fold: Fold, contacts: Array, chart: Array) -> None:
    for i in range(contacts.shape[0]):
        s, fy, fz = contacts[i, 0], contacts[i, 1], contacts[i, 2]
        psi = np.arctan2(fz, fy)
        chart[i, 0] = along(fold.bounds, s)
        chart[i, 1] = psi
        chart[i, 2] = np.sqrt(np.hypot(fy, fz) / fold_force(fold, s, psi))


@kernel
def _fold_forces_at(fold: Fold, contacts: Array, forces: Array) -> None:
    for i in range(contacts.shape[0]):
        psi = np.arctan2(contacts[i, 2], contacts[i, 1])
        forces[i] = fold_force(fold, contacts[i, 0], psi)


_PADDED = 8  # (F, p) and two of padding, for vectorisation
# Vectorisation needs one flat buffer: a corner's four rows, then the sums of values and slopes.
_SUMS = 4 * _PADDED
# Range of validity: ρ from one cell above rest, where the bearing is ill-defined, to slightly
# beyond the fold; η from slightly below the smallest arc length. Beyond the chart the outermost
# cells are extrapolated.
_LEAST, _MOST, _BEFORE = 1.0 / 16.0, 1.02, 1.0 / 32.0


class Charted(NamedTuple):
    """A rod with its chart, for the kernels."""

    rod: Rod
    fold: Fold
    nodes: Array  # (i, j, k, 32), from `interpolant`


@lru_cache(maxsize=16)
def interpolant(chart: StableSet) -> Array:
    """(F, p) at the chart's nodes, and its derivatives in cells along η, ψ, ρ: (i, j, k, 32)."""
    size = np.array([1.0, 2.0 * np.pi, 1.0]) / (np.array(chart.values.shape[:3]) - 1)
    nodes = np.zeros((*chart.values.shape[:3], 4, _PADDED))
    nodes[..., 0, :6] = chart.values
    nodes[..., 1:, :6] = np.swapaxes(chart.charted(chart.tangents) * size, -1, -2)
    return nodes.reshape(*chart.values.shape[:3], -1)


def charted_rod(chart: StableSet) -> Charted:
    """Rod, fold and interpolation table of a chart, for the kernels."""
    return Charted(chart.discretization.rod, chart.fold, interpolant(chart))


@inlined
def _side(t: float, upper: bool) -> tuple[float, float, float, float, float, float]:
    """Weights l, g and χ of one side of a cell at its fraction t, and their derivatives."""
    u = 1.0 - t
    bent = 6.0 * t * u
    if upper:
        return t, t * t * (3.0 - 2.0 * t) - t, -t * t * u, 1.0, bent - 1.0, t * (3.0 * t - 2.0)
    return u, u * u * (1.0 + 2.0 * t) - u, t * u * u, -1.0, 1.0 - bent, u * (1.0 - 3.0 * t)


@inlined
def _add_values(b: Array, n: int, v: float, x: float, y: float, z: float) -> None:
    """Add the corner in the buffer to the n sums of values, with the weights of its four rows."""
    for q in range(n):
        rows = v * b[q] + x * b[_PADDED + q]
        b[_SUMS + q] += rows + y * b[2 * _PADDED + q] + z * b[3 * _PADDED + q]


@inlined
def _add_slopes(b: Array, n: int, by_v: Vector, by_x: Vector, by_y: Vector, by_z: Vector) -> None:
    """Add the corner in the buffer to the n sums of slopes, with the derivatives of the weights."""
    for q in range(n):
        v, x, y, z = b[q], b[_PADDED + q], b[2 * _PADDED + q], b[3 * _PADDED + q]
        b[_SUMS + _PADDED + q] += by_v[0] * v + by_x[0] * x + by_y[0] * y + by_z[0] * z
        b[_SUMS + 2 * _PADDED + q] += by_v[1] * v + by_x[1] * x + by_y[1] * y + by_z[1] * z
        b[_SUMS + 3 * _PADDED + q] += by_v[2] * v + by_x[2] * x + by_y[2] * y + by_z[2] * z


@inlined
def _blend(nodes: Array, x: float, y: float, z: float, b: Array, slopes: bool) -> None:
    """Compute values, and if requested slopes, at (x, y, z) in cells; left in the buffer."""
    i = min(int(x), nodes.shape[0] - 2)
    j = min(int(y), nodes.shape[1] - 2)
    k = min(int(z), nodes.shape[2] - 2)
    size = nodes.shape[3]  # not a constant: short loops would be unrolled instead of vectorised
    for q in range(size):
        b[_SUMS + q] = 0.0
    for m in range(2):
        lx, gx, cx, dlx, dgx, dcx = _side(x - i, m == 1)
        for n in range(2):
            ly, gy, cy, dly, dgy, dcy = _side(y - j, n == 1)
            for o in range(2):
                lz, gz, cz, dlz, dgz, dcz = _side(z - k, o == 1)
                node = nodes[i + m, j + n, k + o]
                for q in range(size):
                    b[q] = node[q]
                _add_values(
                    b,
                    size // 4,
                    (lx + gx) * ly * lz + lx * (gy * lz + ly * gz),
                    cx * ly * lz,
                    lx * cy * lz,
                    lx * ly * cz,
                )
                if slopes:
                    by_v = (
                        (dlx + dgx) * ly * lz + dlx * (gy * lz + ly * gz),
                        (dly + dgy) * lx * lz + dly * (gx * lz + lx * gz),
                        (dlz + dgz) * lx * ly + dlz * (gx * ly + lx * gy),
                    )
                    by_x = (dcx * ly * lz, cx * dly * lz, cx * ly * dlz)
                    by_y = (dlx * cy * lz, lx * dcy * lz, lx * cy * dlz)
                    by_z = (dlx * ly * cz, lx * dly * cz, lx * ly * dcz)
                    _add_slopes(b, size // 4, by_v, by_x, by_y, by_z)


@vectorised
def interpolate(
    nodes: Array, fold: Fold, b: Array, x: Array, value: Array, tangents: Array, slopes: bool
) -> bool:
    """Fill (F, p), and if requested ∂(F, p)/∂x (6, 4), of a contact x = (s, 0, f_y, f_z).

    Return whether x is in the range of the interpolation; otherwise nothing is filled.
    """
    s, fy, fz = x[0], x[2], x[3]
    force = math.hypot(fy, fz)
    eta = along(fold.bounds, s)
    psi = math.atan2(fz, fy)
    log, by_eta, by_psi = log_fold_force(fold, eta, psi)
    rho = math.sqrt(force * math.exp(-log))
    if not (_LEAST <= rho <= _MOST and -_BEFORE <= eta <= 1.0):
        return False
    n, m, k = nodes.shape[0] - 1, nodes.shape[1] - 1, nodes.shape[2] - 1
    turn = psi / (2.0 * math.pi)
    _blend(nodes, n * eta, m * (turn - math.floor(turn)), k * rho, b, slopes)
    grading = fold.bounds[1]
    stretch = (1.0 - fold.bounds[0]) * (1.0 - grading + 2.0 * grading * (1.0 - eta))
    cos, sin, share = fy / force, fz / force, 0.5 * rho / force
    for q in range(6):
        value[q] = b[_SUMS + q]
    for q in range(6 if slopes else 0):
        along_eta, along_psi = (
            n * b[_SUMS + _PADDED + q],
            m / (2.0 * math.pi) * b[_SUMS + 2 * _PADDED + q],
        )
        along_rho = k * b[_SUMS + 3 * _PADDED + q]
        tangents[q, 0] = (along_eta - 0.5 * rho * by_eta * along_rho) / stretch
        tangents[q, 1] = 0.0
        tangents[q, 2] = share * along_rho * (cos + by_psi * sin) - along_psi * sin / force
        tangents[q, 3] = share * along_rho * (sin - by_psi * cos) + along_psi * cos / force
    return True
