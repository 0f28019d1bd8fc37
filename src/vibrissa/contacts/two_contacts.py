"""Test for a second contact: whisker under several point forces, and residuals of one contact.

Between contacts the rod carries the force n and the moment m of all contacts beyond; in the
material frame, from the tip (n = m = 0) to the base,

    n' = n × u,   m' = m × u + n × e₁,   q' = q × u - e₁,   v' = v × u,   u = u₀(s) + c(s) ∘ m,

where n increases by f at each contact; q is the vector from r(s) to the tip, and v are axes fixed
in space, which give the frames and so the shape.

One contact with x = (s, f), and a ratio µ_x = 0 ± σ of its force along the whisker to that across,
explains a measurement z up to the residual of minimum χ²(x) = |W (z(x) - z)|² + µ_x²/σ². If it is
the only contact, the residual is noise. Six components leave three degrees of freedom for χ². With
the shape of the whisker there are many more, but a second force changes few of them: with J the
derivatives with respect to x, K those with respect to forces elsewhere, and P = 1 - J J⁺, these are
the singular vectors of P W K that a force half as large as the first would move by some standard
deviations; χ² is that of the residual along these. The shape is compared up to a rigid motion, so
that errors of the pose do not count.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contacts.fitting.least_squares import Fits, fit
from vibrissa.contacts.joint.friction import LARGEST_FRICTION
from vibrissa.contacts.sensing.channels import WRENCH
from vibrissa.contacts.sensing.noise import Noise, SensorNoise, common_errors
from vibrissa.contacts.wrench import PROXIMAL, estimate_components, wrench_on, wrench_weights
from vibrissa.deferred import special, xr
from vibrissa.numerics import AnyArray, Array, IntArray, numbers
from vibrissa.quantities import attributes
from vibrissa.rod import Discretization, discretize
from vibrissa.whisker import Whisker

#: Rate of false alarms.
FALSE_ALARMS = 0.01
_STEPS = 24  # steps of the rod between two contacts, and between the last one and each end
_TOGETHER = 2000  # number of rows integrated together, in some tens of MB
# Tail probability of χ² below which a fit to a wrench is repeated from these arc lengths.
_DOUBTFUL, _ELSEWHERE = 0.2, (0.25, 0.45, 0.65, 0.85, 0.97)
# Arc lengths of the second force; its expected size, over that of the first; and the displacement
# of the measurement by it, in standard deviations, from which a direction counts.
_PLACES = np.linspace(0.15, 1.0, 12)
_SHARE, _CLEAR = 0.5, 3.0
# Steps of finite differences, and iterations of the fit to wrench and shape.
_STEP, _ROUNDS = 1e-4, 10
# Longest step of arc length (over L), and a third of that of the force (relative to it).
_LONGEST = 0.1
# Residual of a meaningless model, such as a force that winds the whisker up.
_LOST = 1e6
# Median load, over EI/L² and EI/L, above which it may be, and is, in other units; and largest
# distance of points from the base, over the length.
_LARGE_LOAD, _LARGEST_LOAD, _STRETCHED = 10.0, 1000.0, 1.1
_SOME = np.array([0.5, 0.0, 0.1, 0.0])
_NEAREST = 201  # points of the undeformed whisker


class Bent(NamedTuple):
    """Rod under point forces: n rows of m nodes, non-dimensional."""

    wrench: Array  # (n, 6), force and moment at the base
    arc: Array  # (n, m), arc lengths of the nodes, from the tip to the base
    places: Array  # (n, m, 3), points of the centreline there
    frames: Array  # (n, m, 3, 3), material frames there, in columns
    contacts: Array  # (n, k, 3), contact points

    def shape(self, s: Array) -> tuple[Array, Array]:
        """Points and unit tangents (n, j, 3) at arc lengths (n, j)."""
        arc = self.arc[:, ::-1]
        size = arc.shape[1]
        # One sorted array for all rows, offset by row.
        shift = 2.0 * np.arange(len(arc))[:, None]
        at = np.searchsorted((arc + shift).ravel(), (s + shift).ravel(), side="right")
        at = at.reshape(s.shape) - size * np.arange(len(arc))[:, None] - 1
        at = size - 1 - np.clip(at, 0, size - 2)
        row = np.arange(len(arc))[:, None]
        low, h = self.arc[row, at], self.arc[row, at - 1] - self.arc[row, at]
        h = np.maximum(h, 1e-12)
        t = ((s - low) / h)[..., None]
        a, b = self.places[row, at], self.places[row, at - 1]
        da, db = (h[..., None] * self.frames[row, i, :, 0] for i in (at, at - 1))
        point = a * (1 + 2 * t) * (1 - t) ** 2 + b * t * t * (3 - 2 * t)
        point = point + da * t * (1 - t) ** 2 - db * t * t * (1 - t)
        tangent = 6 * t * (1 - t) * (b - a) + da * (1 - t) * (1 - 3 * t) + db * t * (3 * t - 2)
        return point, tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)


@np.errstate(over="ignore", invalid="ignore")
def bent_by_forces(whisker: Whisker, arc: Array, forces: Array) -> Bent:
    """Bend a whisker by several point forces."""
    parts = [
        _bent(whisker, arc[i : i + _TOGETHER], forces[i : i + _TOGETHER])
        for i in range(0, max(len(arc), 1), _TOGETHER)
    ]
    return Bent(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _bent(whisker: Whisker, arc: Array, forces: Array) -> Bent:
    n, k = arc.shape
    nodes = _nodes(whisker, arc)
    middle = 0.5 * (nodes[:, 1:] + nodes[:, :-1])
    sections = [_section(whisker, s) for s in (nodes, middle)]
    state = np.zeros((n, 6, 3))  # n, m, q, and the axes at the tip
    state[:, 3:] = np.eye(3)
    states = np.empty((n, nodes.shape[1], 6, 3))
    states[:, 0] = state
    for i in range(nodes.shape[1] - 1):
        if i and i % _STEPS == 0:
            state[:, 0] += forces[:, k - i // _STEPS]
        h = (nodes[:, i + 1] - nodes[:, i])[:, None, None]
        near, half, far = (_at(sections[part], j) for part, j in ((0, i), (1, i), (0, i + 1)))
        state = _step(state, h, near, half, far)
        states[:, i + 1] = state
    state = _joint(whisker, state)
    frames = np.einsum("nai,nmaj->nmij", state[:, 3:], states[:, :, 3:])
    places = state[:, None, 2] - np.einsum("nmij,nmj->nmi", frames, states[:, :, 2])
    wrench = state[:, :2].reshape(n, 6)
    touched = _STEPS * np.arange(k, 0, -1)
    return Bent(wrench, nodes, places, frames, places[:, touched])


def _nodes(whisker: Whisker, arc: Array) -> Array:
    """Arc lengths (n, m) of nodes from the tip to the base, denser where the whisker is thin."""
    s = np.linspace(0.0, 1.0, 257)
    density = (whisker.radius(s * whisker.length) / whisker.base_radius) ** -0.4
    even = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    ends = np.column_stack([np.ones(len(arc)), arc[:, ::-1], np.zeros(len(arc))])
    share = np.linspace(0.0, 1.0, _STEPS + 1)[:-1]
    at = np.interp(ends, s, even)
    between = at[:, :-1, None] + np.diff(at, axis=1)[..., None] * share
    inner = np.interp(between, even, s)
    inner[:, :, 0] = ends[:, :-1]
    return np.column_stack([inner.reshape(len(arc), -1), ends[:, -1]])


def _section(whisker: Whisker, s: Array) -> tuple[Array, Array]:
    """Intrinsic curvature and compliance (n, m, 3) at arc lengths."""
    curvature = whisker.curvature(s * whisker.length) * whisker.length
    soft = (whisker.radius(s * whisker.length) / whisker.base_radius) ** -4.0
    return curvature, soft[..., None] * np.array([1.0 + whisker.poisson_ratio, 1.0, 1.0])


def _at(section: tuple[Array, Array], i: int) -> tuple[Array, Array]:
    return section[0][:, i], section[1][:, i]


def _rates(state: Array, section: tuple[Array, Array], extent: float = 1.0) -> Array:
    u = section[0] + section[1] * state[:, 1]
    out = np.empty_like(state)
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, :, a] = state[:, :, b] * u[:, None, c] - state[:, :, c] * u[:, None, b]
    out[:, 1, 1] += extent * state[:, 0, 2]
    out[:, 1, 2] -= extent * state[:, 0, 1]
    out[:, 2, 0] -= extent
    return out


def _step(
    y: Array,
    h: Array | float,
    near: tuple[Array, Array],
    half: tuple[Array, Array],
    far: tuple[Array, Array],
    extent: float = 1.0,
) -> Array:
    """One step of the fourth-order Runge-Kutta method."""
    a = _rates(y, near, extent)
    b = _rates(y + 0.5 * h * a, half, extent)
    c = _rates(y + 0.5 * h * b, half, extent)
    d = _rates(y + h * c, far, extent)
    return np.asarray(y + h / 6.0 * (a + 2.0 * b + 2.0 * c + d))


def _joint(whisker: Whisker, state: Array) -> Array:
    """Carry a state through a compliant base, which turns and has no length."""
    if whisker.base_stiffness is None:
        return state
    bending, twist = whisker.base_stiffness
    moment = whisker.base_bending_stiffness / whisker.length
    soft = np.broadcast_to(moment / np.array([twist, bending, bending]), (len(state), 3))
    section = np.zeros_like(soft), soft
    for _ in range(4):
        state = _step(state, -0.25, section, section, section, 0.0)
    return state


def second_contact(
    whisker: Whisker,
    force: ArrayLike | xr.DataArray,
    moment: ArrayLike | xr.DataArray,
    *,
    noise: Noise,
    friction: float = 0.3,
    stiffness_sigma: float = 0.0,
    gain_sigma: float | ArrayLike = 0.0,
    mixing_sigma: float | ArrayLike = 0.0,
    centerline: ArrayLike | None = None,
    centerline_sigma: float | ArrayLike = 0.0,
    false_alarms: float = FALSE_ALARMS,
) -> xr.Dataset:
    """Detect that a whisker is touched in more than one point.

    Parameters
    ----------
    whisker : Whisker
        Whisker.
    force, moment : array_like or DataArray
        Force and moment at the base, whisker frame, N and N·m, shape (..., 3); NaN: missing.
    noise : mapping or (6, 6) array_like
        Standard deviations of ``Fx``, ``Fy``, ``Fz``, ``Mx``, ``My`` and ``Mz``, or the covariance
        of (F, M), SI units.
    friction : float
        Standard deviation of the ratio of the force along the whisker to that across it, as of
        `ContactMap.estimate`; 0 where there is no friction, which makes the test far more powerful.
    stiffness_sigma : float
        Relative standard deviation of the whisker's bending stiffness.
    gain_sigma : float or (6,) array_like
        Relative standard deviation of the sensor's gains.
    mixing_sigma : float or (6, 6) array_like
        Standard deviations of what each component reads of the others.
    centerline : array_like, optional
        Points of the bent whisker, whisker frame, m, shape (..., j, 3), such as tracked ones.
    centerline_sigma : float or (j,) array_like
        Standard deviation of each point across the whisker, m, independent of the others.
    false_alarms : float
        Share of measurements of one contact that may be taken for two.

    Returns
    -------
    Dataset
        ``one_contact``, the probability that one contact leaves a residual as large as this;
        ``second_contact``, whether it is below ``false_alarms``; ``chi_squared`` and its
        ``degrees`` of freedom; ``contact_point_whisker`` of the one contact that explains all best.
        Where force and moment are zero or missing the probability is NaN.

    Raises
    ------
    ValueError
        If shapes do not fit, or a standard deviation is not positive, or loads or points are in
        other units, or points go from the tip to the base.

    Warns
    -----
    UserWarning
        If force and moment are typically too large for the whisker, as in other units.
    """
    if not (0.0 <= friction <= LARGEST_FRICTION and 0.0 < false_alarms < 1.0):
        raise ValueError(
            f"friction is a standard deviation from 0 to {LARGEST_FRICTION:g}, and false_alarms a "
            f"share between 0 and 1; got {friction!r} and {false_alarms!r}"
        )
    if centerline is None and np.any(centerline_sigma):
        raise ValueError("centerline_sigma is of a centerline, and none is given")
    f, m, dims, coords = wrench_on(whisker, force, moment)
    _check_scale(whisker, f, m)
    errors = common_errors(stiffness_sigma, gain_sigma, mixing_sigma)
    sensor = SensorNoise.of(noise, WRENCH, errors, whisker)
    test = _Test(whisker, sensor, friction)
    wrench = np.concatenate([f, m], axis=-1).reshape(-1, 6)
    rows = np.flatnonzero(np.isfinite(wrench).all(axis=1) & wrench.any(axis=1))
    lines = None
    if centerline is not None:
        lines = _checked(whisker, centerline, centerline_sigma, f.shape[:-1])
        rows = rows[np.isfinite(lines[0][rows]).all(axis=(1, 2))]
        lines = lines[0][rows] / whisker.length, lines[1] / whisker.length
    chi_squared, degrees = np.full(len(wrench), np.nan), np.zeros(len(wrench), np.int64)
    points = np.full((len(wrench), 3), np.nan)
    if rows.size:
        chi_squared[rows], degrees[rows], points[rows] = test(wrench[rows], lines)
    with np.errstate(invalid="ignore"):
        probability = special.chdtrc(np.maximum(degrees, 1), chi_squared)

    def whole(values: AnyArray) -> AnyArray:
        return values.reshape((*f.shape[:-1], *values.shape[1:]))

    about = {"units": "1", "long_name": "degrees of freedom"}
    found = {"units": "1", "long_name": "more than one contact", "false_alarms": false_alarms}
    data = {
        "one_contact": (dims, whole(probability), attributes("one_contact")),
        "second_contact": (dims, whole(probability < false_alarms), found),
        "chi_squared": (dims, whole(chi_squared), attributes("chi_squared")),
        "degrees": (dims, whole(degrees), about),
        "contact_point_whisker": (
            (*dims, "space"),
            whole(points * whisker.length),
            attributes("contact_point_whisker"),
        ),
    }
    return xr.Dataset(data, {**coords, "space": list("xyz")})


def _check_scale(whisker: Whisker, force: Array, moment: Array) -> None:
    """Question force and moment too large for this whisker; raise ValueError if far too large."""
    stiff, length = whisker.base_bending_stiffness, whisker.length
    sizes = np.linalg.norm([force * length**2, moment * length], axis=-1).reshape(2, -1) / stiff
    known = sizes[:, np.isfinite(sizes).all(axis=0) & sizes.any(axis=0)]
    of_force, of_moment = np.median(known, axis=1).tolist() if known.size else (0.0, 0.0)
    typical = min(of_force, of_moment)
    # Near the base both are large, but not the bend M²/(F EI) over the arm M/F.
    if typical <= _LARGE_LOAD or of_moment**2 <= _LARGE_LOAD * of_force:
        return
    text = (
        f"force and moment are typically {typical:.2g} times what is natural to this whisker, "
        "EI/L² and EI/L: N and N·m are needed; are these mN, µN, mN·m or µN·m?"
    )
    if typical > _LARGEST_LOAD:
        raise ValueError(text)
    warnings.warn(text, UserWarning, stacklevel=3)


def _checked(
    whisker: Whisker, line: ArrayLike, sigma: float | ArrayLike, shape: tuple[int, ...]
) -> tuple[Array, Array]:
    """Centrelines (n, j, 3) and standard deviations (j,)."""
    points = numbers("centerline", line)
    if points.shape[:-2] != shape or points.shape[-1:] != (3,) or points.shape[-2] < 4:
        raise ValueError(
            f"centerline has shape {points.shape}; {(*shape, 'j', 3)} with four points or more is "
            "needed"
        )
    deviations = np.broadcast_to(np.asarray(sigma, dtype=np.float64), points.shape[-2:-1])
    if not ((deviations > 0.0) & np.isfinite(deviations)).all():
        raise ValueError(f"centerline_sigma is positive, m; got {sigma!r}")
    length = whisker.length
    if deviations.min() > length:
        raise ValueError(
            f"centerline_sigma is {deviations.min():.3g} m on a whisker of {length:.3g} m: it has "
            "to be in m"
        )
    lines = points.reshape(-1, *points.shape[-2:])
    lines = lines[np.isfinite(lines).all(axis=(1, 2))]
    if len(lines):
        most = np.median(np.linalg.norm(lines, axis=2).max(axis=1))
        if most > _STRETCHED * length:
            raise ValueError(
                f"the centerline reaches {most:.3g} m from the base of a whisker of {length:.3g} "
                "m: points in the whisker frame, in m, are needed"
            )
        # The nearest points of the undeformed whisker show the direction, wherever a line begins.
        rest = whisker.centerline(_NEAREST)
        ends = np.median(lines[:, [0, -1]], axis=0)
        first, last = np.linalg.norm(rest - ends[:, None], axis=2).argmin(axis=1)
        if last < first:
            raise ValueError("points of the centerline go from the base to the tip; these go back")
    return points.reshape(-1, *points.shape[-2:]), deviations


class _Test:
    """Fits of one contact to measurements, and χ² of their residuals."""

    def __init__(self, whisker: Whisker, sensor: SensorNoise, friction: float) -> None:
        self.whisker, self.sensor, self.friction = whisker, sensor, friction
        self.d: Discretization = discretize(whisker)
        self.scale = np.repeat([self.d.force, self.d.moment], 3)
        self.free = [0, 1, 2, 3] if friction > 0.0 else [0, 2, 3]

    def __call__(
        self, wrench: Array, lines: tuple[Array, Array] | None
    ) -> tuple[Array, IntArray, Array]:
        """χ², degrees of freedom and contact points of measured wrenches, SI units."""
        flat = wrench / self.scale
        weights = wrench_weights(self.sensor, self.d, flat)
        fits = self._fitted(wrench, flat, weights)
        left = (np.abs(weights).max(axis=2) > 0.0).sum(axis=1) - len(self.free)
        degrees = left + (1 if self.friction > 0.0 else 0)
        if lines is None:
            return fits.misfits, degrees, fits.values[:, 3:]
        return self._with_shapes(flat, weights, fits.contacts, *lines)

    def _fitted(self, wrench: Array, flat: Array, weights: Array) -> Fits:
        """Contacts of minimum χ² with the prior of friction."""
        signals = dict(zip(WRENCH, wrench.T, strict=True))
        noise = self.sensor.deviations if self.sensor.wrench is None else self.sensor.wrench
        found = estimate_components(self.whisker, signals, noise, self.sensor.errors, None)
        arc, force = found.candidates.arc_length, found.candidates.contact_force
        row, place = np.nonzero(np.isfinite(arc))
        seeds = np.column_stack([arc[row, place] / self.d.length, force[row, place] / self.d.force])
        best = self._best(len(flat), row, self._fit(flat[row], weights[row], seeds))
        again = np.flatnonzero(~(best.misfits < special.chdtri(3, _DOUBTFUL)))
        if again.size:
            more = np.repeat(again, len(_ELSEWHERE))
            starts = np.tile(_ELSEWHERE, again.size)
            seeds = np.column_stack([starts, flat[more, :3]])
            others = self._fit(flat[more], weights[more], seeds)
            row = np.concatenate([np.arange(len(flat)), more])
            both = Fits(*(np.concatenate(pair) for pair in zip(best, others, strict=True)))
            best = self._best(len(flat), row, both)
        return best

    def _fit(self, flat: Array, weights: Array, seeds: Array) -> Fits:
        n = len(flat)
        rubbing = self.friction > 0.0
        seeds = seeds.copy()
        small = np.hypot(seeds[:, 2], seeds[:, 3]) < 1e-6
        seeds[small, 2] = np.maximum(np.linalg.norm(seeds[small, 1:], axis=1), 1e-6)
        if not rubbing:
            seeds[:, 1] = 0.0
            return fit(self.d, WRENCH, flat, weights, seeds, friction=False, least=PROXIMAL)
        whole = np.zeros((n, 7, 7))
        whole[:, :6, :6], whole[:, 6, 6] = weights, 1.0 / self.friction
        targets = np.column_stack([flat, np.zeros(n)])
        names = (*WRENCH, "ratio")
        return fit(self.d, names, targets, whole, seeds, friction=True, least=PROXIMAL)

    @staticmethod
    def _best(n: int, row: IntArray, fits: Fits) -> Fits:
        """Fit of minimum χ² of each row."""
        lost = ~np.isfinite(fits.values).all(axis=1) | np.isnan(fits.misfits)
        fits.misfits[lost] = np.inf
        order = np.lexsort((fits.misfits, row))
        first = order[np.flatnonzero(np.diff(row[order], prepend=-1))]
        out = Fits(
            np.full((n, 4), np.nan),
            np.full((n, 6), np.nan),
            np.full((n, 6, 4), np.nan),
            np.full(n, np.inf),
            np.zeros(n, np.bool_),
        )
        for mine, theirs in zip(out, fits, strict=True):
            mine[row[first]] = theirs[first]
        return out

    def _with_shapes(
        self, flat: Array, weights: Array, x: Array, lines: Array, sigma: Array
    ) -> tuple[Array, IntArray, Array]:
        """χ² along the directions that a second contact moves, with centrelines."""
        measured = _Measured(self.whisker, flat, weights, lines, sigma, self.friction)
        # A wrench without a contact is fitted from an arbitrary one.
        x, residual, slopes = self._joint(measured, np.where(np.isfinite(x), x, _SOME))
        basis, size, _ = np.linalg.svd(slopes, full_matrices=False)
        basis = basis * (size > 1e-9 * size[:, :1])[:, None, :]
        second = measured.by_second(x)
        second -= basis @ (np.swapaxes(basis, 1, 2) @ second)
        vectors, size, _ = np.linalg.svd(second, full_matrices=False)
        clear = size > _CLEAR
        along = np.einsum("nki,nk->ni", vectors, residual)
        chi_squared = np.where(clear, along**2, 0.0).sum(axis=1)
        return chi_squared, clear.sum(axis=1), measured.bent(x).contacts[:, 0]

    def _joint(self, measured: _Measured, x: Array) -> tuple[Array, Array, Array]:
        """Fit to wrench and shape together by Gauss-Newton steps; also residuals and slopes."""
        share = np.ones(len(x))
        residual = measured.residuals(x)
        for _ in range(_ROUNDS):
            slopes = measured.slopes(x)[..., self.free]
            step = -(np.linalg.pinv(slopes) @ residual[..., None])[..., 0]
            force = np.linalg.norm(x[:, 1:], axis=1)
            long = np.maximum(np.abs(step[:, 0]) / _LONGEST, 1.0)
            long = np.maximum(long, np.linalg.norm(step[:, 1:], axis=1) / (_LONGEST * 3 * force))
            tried = x.copy()
            tried[:, self.free] += (share / long)[:, None] * step
            tried[:, 0] = np.clip(tried[:, 0], PROXIMAL, 1.0)
            new = measured.residuals(tried)
            better = (new**2).sum(axis=1) <= (residual**2).sum(axis=1)
            x[better], residual[better] = tried[better], new[better]
            share = np.where(better, np.minimum(1.0, 2.0 * share), 0.25 * share)
        return x, residual, measured.slopes(x)[..., self.free]


class _Measured:
    """Wrenches and centrelines, and their residuals for one contact, in standard deviations."""

    def __init__(
        self,
        whisker: Whisker,
        flat: Array,
        weights: Array,
        lines: Array,
        sigma: Array,
        friction: float,
    ) -> None:
        self.whisker, self.flat, self.weights = whisker, flat, weights
        self.lines, self.sigma, self.friction = lines, sigma, friction
        step = np.linalg.norm(np.diff(lines, axis=1), axis=2)
        self.arc = np.concatenate([np.zeros((len(lines), 1)), step.cumsum(axis=1)], axis=1)
        self.arc += np.linalg.norm(lines[:, :1], axis=2)
        tangent = np.gradient(lines, axis=1)
        across = np.linalg.svd(tangent[..., None, :], full_matrices=True)[2][..., 1:, :]
        self.across = across / sigma[:, None, None]
        turned = np.stack([np.cross(axis, lines) for axis in np.eye(3)], axis=-1)
        moved = np.broadcast_to(np.eye(3), turned.shape)
        rigid = self.across @ np.concatenate([turned, moved], axis=-1)
        self.rigid = np.linalg.svd(rigid.reshape(len(flat), -1, 6), full_matrices=False)[0]

    def bent(self, x: Array, extra: tuple[float, Array] | None = None) -> Bent:
        """Rod bent by one contact, or by two."""
        if extra is None:
            return bent_by_forces(self.whisker, x[:, :1], x[:, None, 1:])
        arc = np.column_stack([x[:, 0], np.full(len(x), extra[0])])
        forces = np.stack([x[:, 1:], extra[1]], axis=1)
        order = np.argsort(arc, axis=1)
        row = np.arange(len(x))[:, None]
        return bent_by_forces(self.whisker, arc[row, order], forces[row, order])

    def _model(self, one: Bent) -> Array:
        """Residuals of the wrench, and of the centreline across the whisker up to its pose."""
        points, tangents = one.shape(np.minimum(self.arc, 1.0))
        past = np.maximum(self.arc - 1.0, 0.0)[..., None]
        points = points + past * tangents
        # Only the part across the whisker counts: along it the points may be anywhere.
        away = points - self.lines
        shape = np.einsum("njai,nji->nja", self.across, away).reshape(len(self.flat), -1)
        shape -= (self.rigid @ (np.swapaxes(self.rigid, 1, 2) @ shape[..., None]))[..., 0]
        wrench = np.einsum("nij,nj->ni", self.weights, one.wrench - self.flat)
        out = np.concatenate([wrench, shape], axis=1)
        return np.where(np.isfinite(out), out, _LOST)

    def residuals(self, x: Array) -> Array:
        """Residuals (n, k); the last is the friction ratio, if friction is possible."""
        out = self._model(self.bent(x))
        if self.friction > 0.0:
            ratio = x[:, 1] / np.hypot(x[:, 2], x[:, 3]) / self.friction
            out = np.column_stack([out, ratio])
        return out

    def slopes(self, x: Array) -> Array:
        """Derivatives (n, k, 4) of the residuals with respect to x."""
        size = np.linalg.norm(x[:, 1:], axis=1)
        out = []
        for i in range(4):
            step = np.full(len(x), _STEP) if i == 0 else _STEP * size
            ahead, back = x.copy(), x.copy()
            ahead[:, i] += step
            back[:, i] -= step
            if i == 0:
                ahead[:, 0] = np.minimum(ahead[:, 0], 1.0)
            width = (ahead[:, i] - back[:, i])[:, None]
            out.append((self.residuals(ahead) - self.residuals(back)) / width)
        return np.stack(out, axis=2)

    def by_second(self, x: Array) -> Array:
        """Change (n, k, positions × 2) due to second forces, each a share of the first."""
        force = _SHARE * np.linalg.norm(x[:, 1:], axis=1)
        small = 0.02
        before = self._model(self.bent(x))
        out = []
        for place in _PLACES:
            for axis in (1, 2):
                extra = np.zeros((len(x), 3))
                extra[:, axis] = small * force
                out.append((self._model(self.bent(x, (float(place), extra))) - before) / small)
        changed = np.stack(out, axis=2)
        if self.friction > 0.0:
            changed = np.concatenate([changed, np.zeros_like(changed[:, :1])], axis=1)
        return changed
