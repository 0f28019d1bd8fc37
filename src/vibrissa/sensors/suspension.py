"""Calibration of a suspended whisker from touches at known points.

Unknown are the two compliances, and with more touches, each with its prior, the pivot, and the
place and direction of the base; on request the rest curvature, the taper and the friction. The
read-out is linear in its weights, which are solved for within the fit (variable projection), so
that it is a problem of 2 to 19 unknowns. The prior of the weights is a normal distribution, of a
size that makes the readings most probable. What remains is given to a thin-plate Gaussian process
where there are touches enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import interpolate, transform
from vibrissa.numerics import AnyArray, Array, numbers
from vibrissa.rod import discretize
from vibrissa.sensors.regression import ThinPlate
from vibrissa.sensors.suspended import SuspendedWhisker, Touches
from vibrissa.status import Status
from vibrissa.whisker import Whisker

# Touches that are needed, above which more than the compliances may be free, and from which on
# there is a Gaussian process.
FEWEST, SOME, PLENTY = 20, 40, 100
# Mechanical unknowns that may be free: the compliances; the pivot too; and the pose of the base.
# Chosen are those that predict whole regions of touches which were left out: what neighbours share,
# and unknowns take up that the wire does not have, misleads there. Single touches that are left out
# do not show it, for they have neighbours. Below `PLENTY` too few would be left to judge by, and no
# process takes up what is left: the pose is free. Curvature, taper and friction mislead more than
# they help.
CHOICES = (2, 5, 11)
# Regions that are left out in turn, and touches that the choice is made with at most.
_REGIONS, _ENOUGH_TO_CHOOSE = 5, 300
# Variances of the noise over those of the (scaled) weights that are tried.
_RATIOS = np.logspace(-6, 1, 15)
# Gauss-Newton steps, dampings of each, and the relative gain below which they end.
_ROUNDS, _TRIES, _ENOUGH = 20, 6, 2e-3
# Share of its prior's standard deviation from which an unknown counts as not determined.
_OPEN = 0.7
_LOST = 5.0  # residual of a touch without equilibrium, in units of the noise
# Residual from which a touch is an outlier: over the usual one of a channel (the median, so that
# outliers do not hide themselves), and over the channel's range. Of the real touches of a wire one
# in 1,200 was 15 % of the range from the same touch made again, the others less than 4 %.
_OUTLYING, _LEAST_OUTLYING = 10.0, 0.05
# Logarithms of compliances in L/EI and L³/EI from which the best is improved; the prior's mean is
# the middle one.
_STARTS = [(np.log(r), np.log(t)) for r in (0.1, 0.5, 2.0) for t in (3e-4, 3e-3, 3e-2)]


class Unknown(NamedTuple):
    """A mechanical unknown: its name, standard deviation of its prior, and step of differences."""

    name: str
    sigma: float
    step: float = 1e-5


def _unknowns(length: float, base_sigma: float) -> tuple[Unknown, ...]:
    """All unknowns, non-dimensional, in the order in which they are freed."""
    place, bend = base_sigma / length, (0.15, 0.3, 0.3)
    return (
        Unknown("log rotation compliance", 2.0),
        Unknown("log shift compliance", 2.0),
        *(Unknown(f"pivot {a} / L", 0.06) for a in "xyz"),
        *(Unknown(f"base {a} / L", place) for a in "xyz"),
        *(Unknown(f"direction {a}", 0.02) for a in "xyz"),
        *(Unknown(f"curvature d{i} P{k}", bend[k]) for i in (1, 2) for k in range(3)),
        Unknown("taper", 0.15, 1e-3),
        Unknown("friction", 0.15, 1e-3),
    )


@dataclass(frozen=True, eq=False)
class SuspensionCalibration:
    """A suspended whisker as determined by touches at known points.

    Attributes
    ----------
    sensor : SuspendedWhisker
        Whisker, suspension, read-out and noise that were found.
    names : tuple of str
        Mechanical unknowns that were free; lengths are over the whisker's, compliances those over
        L/EI and L³/EI, curvature in Legendre polynomials of arc length, times L.
    values : (p,) array
        Values of the parameters, as changes of what was stated.
    covariance : (p, p) array
        Covariance of the values.
    undetermined : tuple of str
        Parameters that the readings hardly determine: their uncertainty is that of their prior.
    readout_covariance : (k, 13, 13) array
        Covariance of each channel's read-out, the mechanics being known.
    residual : (k,) array
        Root mean square of what the rod leaves unexplained.
    used : (n,) bool array
        Touches that were used; the others have no equilibrium in this model, or are outliers.
    outliers : (n,) bool array
        Touches with a reading more than ten times as far from the model as is usual: the probe
        slipped, or the wire was caught.
    """

    sensor: SuspendedWhisker
    names: tuple[str, ...]
    values: Array
    covariance: Array
    undetermined: tuple[str, ...]
    readout_covariance: Array
    residual: Array
    used: AnyArray
    outliers: AnyArray


def calibrate_suspension(
    whisker: Whisker,
    points: ArrayLike,
    readings: ArrayLike,
    *,
    channels: tuple[str, ...] | None = None,
    rest: ArrayLike | None = None,
    base_sigma: float = 0.15e-3,
    drift: ArrayLike = 0.0,
    free: int | None = None,
) -> SuspensionCalibration:
    """Calibrate a whisker on a compliant suspension by touches at known points.

    Parameters
    ----------
    whisker : Whisker
        Whisker at rest, as `Whisker.from_points` makes it of points in the sensor's frame.
    points : array_like (n, 3)
        Contact points, sensor frame, m; rows with NaN are left out.
    readings : array_like (n, k)
        Readings of the channels, in any unit.
    channels : tuple of str, optional
        Names of the channels.
    rest : array_like (k,), optional
        Readings of the untouched whisker; by default they are zero.
    base_sigma : float
        Standard deviation of the stated place of the base, m.
    drift : array_like (k,)
        Standard deviation of what readings change by from one recording to the next.
    free : int, optional
        Number of mechanical unknowns that are free, 2 to 19; by default the two compliances up to
        40 touches, and with pivot and pose of the base 11 below 100. From there on a Gaussian
        process explains what is left, and those of 2, 5 (with the pivot) and 11 are free that
        predict regions of touches best which are left out of the fit.

    Returns
    -------
    SuspensionCalibration
        Calibrated sensor, with covariances.

    Raises
    ------
    ValueError
        If shapes do not fit, or there are too few touches or no signal.
    """
    p, y = numbers("points", points), numbers("readings", readings, channels or ())
    if p.ndim != 2 or p.shape[1] != 3 or y.ndim != 2 or len(y) != len(p):
        raise ValueError(
            f"points (n, 3) and readings (n, k) are needed; got {p.shape} and {y.shape}"
        )
    names = channels or tuple(f"channel {i + 1}" for i in range(y.shape[1]))
    zero = np.zeros(y.shape[1]) if rest is None else np.asarray(rest, dtype=np.float64)
    if len(names) != y.shape[1] or zero.shape != (y.shape[1],):
        raise ValueError(f"{y.shape[1]} channels have names {names} and rest {zero.tolist()}")
    known = np.isfinite(p).all(axis=1) & np.isfinite(y).all(axis=1)
    if known.sum() < FEWEST:
        raise ValueError(f"{known.sum()} touches are too few; {FEWEST} are needed")
    idle = [n for n, size in zip(names, np.ptp(y[known], axis=0), strict=True) if size == 0.0]
    if idle:
        raise ValueError(f"{', '.join(idle)} read the same at all touches")
    unknowns = _unknowns(whisker.length, base_sigma)
    outliers = np.zeros_like(known)
    outliers[known] = _Problem(whisker, p[known], y[known] - zero, unknowns[:2]).outliers()
    known &= ~outliers
    number = free or _chosen(whisker, p[known], y[known] - zero, unknowns)
    if not 2 <= number <= len(unknowns):
        raise ValueError(f"free is {free}; 2 to {len(unknowns)} mechanical unknowns can be free")
    problem = _Problem(whisker, p[known], y[known] - zero, unknowns[:number])
    found = problem.solved(names, zero, np.asarray(known))
    return replace(found, sensor=replace(found.sensor, drift=drift), outliers=outliers)


def _chosen(whisker: Whisker, points: Array, readings: Array, unknowns: tuple[Unknown, ...]) -> int:
    """Number of unknowns that predicts regions best which are left out."""
    if len(points) < PLENTY:
        return CHOICES[0] if len(points) <= SOME else CHOICES[-1]
    from scipy.cluster.vq import kmeans2  # imports much that nothing else needs

    kept = np.random.default_rng(0).permutation(len(points))[:_ENOUGH_TO_CHOOSE]
    points, readings = points[kept], readings[kept]
    region = kmeans2(points / np.abs(points).max(), _REGIONS, seed=0, minit="++")[1]
    spread = readings.std(axis=0)
    start = _Problem(whisker, points, readings, unknowns[: CHOICES[0]]).minimise()[0].values
    misses = []
    for number in CHOICES:
        miss = np.ones_like(readings)  # where nothing is predicted: as bad as their mean
        for one in range(_REGIONS):
            out = region == one
            if (~out).sum() < FEWEST:
                continue
            problem = _Problem(whisker, points[~out], readings[~out], unknowns[:number])
            names = ("",) * spread.size
            fit = problem.solved(names, 0.0 * spread, np.ones(len(problem.points), bool), [start])
            found, _ = fit.sensor.read(points[out])
            miss[out] = np.nan_to_num((found - readings[out]) / spread, nan=1.0)
        misses.append((miss**2).mean())
    return CHOICES[int(np.argmin(misses))]


class _State(NamedTuple):
    """The model for some values of the unknowns, its linear fit, and the cost."""

    values: Array
    sensor: SuspendedWhisker
    contacts: Array
    touches: Touches
    ok: AnyArray
    fit: _Weights
    cost: float


class _Weights(NamedTuple):
    """Weights of the features with ridge: scaled design, weights, residuals, leverages, noise."""

    scale: Array
    design: Array
    weights: Array
    residuals: Array
    ratio: Array
    leverage: Array


class _Problem:
    """Touches, and what is fitted to them."""

    def __init__(
        self, whisker: Whisker, points: Array, readings: Array, unknowns: tuple[Unknown, ...]
    ) -> None:
        self.whisker, self.points, self.readings = whisker, points, readings
        self.unknowns = unknowns
        self.sigma = np.array([one.sigma for one in unknowns])
        self.mean = np.append(_STARTS[len(_STARTS) // 2], np.zeros(len(unknowns) - 2))
        self.noise = 0.02 * np.ptp(readings, axis=0)

    def model(self, x: Array) -> SuspendedWhisker:
        """Suspended whisker of some values."""
        full = np.zeros(19)
        full[: x.size] = x
        whisker, d = self.whisker, discretize(self.whisker)
        if full[11:18].any():
            whisker = _reshaped(whisker, full[11:14], full[14:17], full[17])
        turn = transform.Rotation.from_rotvec(full[8:11]).as_matrix() @ whisker.pose.rotation
        origin = whisker.pose.origin + full[5:8] * d.length
        return SuspendedWhisker(
            replace(whisker, pose=type(whisker.pose)(turn, origin)),
            rotation_compliance=float(np.exp(full[0])) / d.moment,
            shift_compliance=float(np.exp(full[1])) * d.length / d.force,
            pivot=full[2:5] * d.length,
            friction=float(full[18]),
        )

    def state(self, x: Array, contacts: Array | None) -> _State:
        """Solve all touches, and the weights."""
        sensor = self.model(x)
        found, status = sensor.solve(self.points, contacts)
        ok = status == int(Status.OK)
        touches = sensor.touches(found)
        fit = _weights(touches.features * ok[:, None], self.readings * ok[:, None])
        cost = float(((fit.residuals / self.noise) ** 2).sum())
        cost += float(((fit.weights / self.noise) ** 2 * fit.ratio).sum())
        cost += self.readings.shape[1] * _LOST**2 * (~ok).sum() + self.penalty(x)
        return _State(x, sensor, found, touches, ok, fit, cost)

    def penalty(self, x: Array) -> float:
        """Part of the cost that is the prior's."""
        return float((((x - self.mean) / self.sigma) ** 2).sum())

    def slopes(self, at: _State) -> Array:
        """Derivatives of the residuals by the unknowns, with weights that follow (Kaufman)."""
        q = np.linalg.qr(
            np.concatenate([at.fit.design, np.diag(np.sqrt(at.fit.ratio.mean(axis=1)))])
        )[0]
        q = q[: len(self.points)]
        out = []
        for k, one in enumerate(self.unknowns):
            moved = at.values.copy()
            moved[k] += one.step
            there = self.model(moved).touches(at.contacts)
            shift = (there.points - at.touches.points) / one.step
            features = (there.features - at.touches.features) / one.step
            regular = np.where(at.ok[:, None, None], at.touches.point_slopes, np.eye(3))
            back = np.linalg.solve(regular, shift[:, :, None])
            features = features - (at.touches.feature_slopes @ back)[:, :, 0]
            change = -(features * at.ok[:, None] / at.fit.scale) @ at.fit.weights
            out.append(((change - q @ (q.T @ change)) / self.noise).ravel())
        return np.array(out).T

    def minimise(self, starts: Sequence[Any] = _STARTS) -> tuple[_State, Array]:
        """Least cost from the best start of the compliances, and the derivatives there."""
        p = len(self.unknowns)
        begin = [np.append(pair, np.zeros(p - 2)) for pair in starts]
        at = min((self.state(x, None) for x in begin), key=lambda one: one.cost)
        self.check(at)
        prior = np.diag(1.0 / self.sigma)
        damping = 1e-3
        for _ in range(_ROUNDS):
            jacobian = self.slopes(at)
            system = np.concatenate([jacobian, prior])
            wrong = np.append(
                (at.fit.residuals / self.noise).ravel(), prior @ (at.values - self.mean)
            )
            size = np.linalg.norm(system, axis=0)
            for _ in range(_TRIES):
                padded = np.concatenate([system, np.sqrt(damping) * np.diag(size)])
                step = np.linalg.lstsq(padded, -np.append(wrong, np.zeros(p)), rcond=None)[0]
                x = at.values + np.clip(step, -1.0, 1.0)
                x[18:] = np.maximum(x[18:], 0.0)
                new = self.state(x, at.contacts)
                if new.cost < at.cost:
                    break
                damping *= 10.0
            else:
                break
            gain, damping = at.cost - new.cost, max(0.1 * damping, 1e-7)
            # What is noise shows as the fit improves; the weights of the channels follow.
            self.noise = np.maximum(self.left(new), 1e-9 * np.ptp(self.readings, axis=0))
            settled = gain < _ENOUGH * at.cost
            at = self.state(new.values, new.contacts)
            if settled:
                break
        return at, self.slopes(at)

    def check(self, at: _State) -> None:
        """Refuse touches of which the whisker reaches too few."""
        held, length = int(at.ok.sum()), self.whisker.length
        if held >= min(FEWEST, len(self.points) // 2):
            return
        near, far = np.quantile(np.linalg.norm(self.points, axis=1), (0.1, 0.9))
        raise ValueError(
            f"{held} of {len(at.ok)} touches can be of this whisker: most are {1e3 * near:.3g} to "
            f"{1e3 * far:.3g} mm from its base, and it is {1e3 * length:.3g} mm long. Are origin, "
            "axes and unit of the touches right, and does its shape begin at the base?"
        )

    def misses(self, at: _State) -> Array:
        """Residuals of touches that were left out one by one."""
        free = at.fit.leverage[at.ok] + len(self.unknowns) / max(at.ok.sum(), 1) / 3.0
        return np.asarray(at.fit.residuals[at.ok] / np.maximum(1.0 - free, 0.1))

    def left(self, at: _State) -> Array:
        """Standard deviation of those residuals."""
        return np.asarray(np.sqrt((self.misses(at) ** 2).mean(axis=0)))

    def outliers(self) -> AnyArray:
        """Touches (n,) with a reading that is far from the model."""
        at, _ = self.minimise()
        size = np.abs(self.misses(at))
        usual = 1.4826 * np.median(size, axis=0)
        most = np.maximum(_OUTLYING * usual, _LEAST_OUTLYING * np.ptp(self.readings, axis=0))
        out = np.zeros(len(self.points), dtype=bool)
        out[at.ok] = (size > most).any(axis=1)
        return out

    def solved(
        self,
        names: tuple[str, ...],
        rest: Array,
        known: AnyArray,
        starts: Sequence[Any] = _STARTS,
    ) -> SuspensionCalibration:
        """Fit, and describe the result."""
        at, jacobian = self.minimise(starts)
        noise, spread = self.left(at), np.diag(1.0 / self.sigma**2)
        covariance = np.linalg.inv(jacobian.T @ jacobian + spread)
        sigma = np.sqrt(np.diag(covariance))
        readout = (at.fit.weights / at.fit.scale[:, None]).T
        readout[:, 0] += rest
        inverse = [
            np.linalg.inv(at.fit.design.T @ at.fit.design + np.diag(r)) for r in at.fit.ratio.T
        ]
        by_scale = np.outer(at.fit.scale, at.fit.scale)
        residual = None
        if at.ok.sum() >= PLENTY:
            residual = ThinPlate.fit(self.points[at.ok], at.fit.residuals[at.ok])
            noise = residual.noise
        sensor = replace(at.sensor, channels=names, readout=readout, noise=noise, residual=residual)
        used = known.copy()
        used[known] = at.ok
        every = tuple(one.name for one in self.unknowns)
        return SuspensionCalibration(
            sensor,
            every,
            at.values,
            np.asarray(covariance, dtype=np.float64),
            tuple(n for n, s, o in zip(every, sigma, self.sigma, strict=True) if s > _OPEN * o),
            np.array([v**2 * one / by_scale for v, one in zip(noise, inverse, strict=True)]),
            np.sqrt((at.fit.residuals[at.ok] ** 2).mean(axis=0)),
            used,
            np.zeros_like(used),
        )


def _weights(features: Array, readings: Array) -> _Weights:
    """Weights of the features without the constant; of all but rotations with a ridge."""
    design = features[:, 1:]
    n = len(design)
    scale = np.sqrt((design**2).mean(axis=0))
    scale = np.where(scale > 0.0, scale, 1.0)
    design = design / scale
    rotations, others = design[:, :3], design[:, 3:]
    q, r = np.linalg.qr(rotations)
    u, s, v = np.linalg.svd(others - q @ (q.T @ others), full_matrices=False)
    left = readings - q @ (q.T @ readings)
    inside = u.T @ left
    outside = (left**2).sum(axis=0) - (inside**2).sum(axis=0)
    cost = []
    for one in _RATIOS:
        shrunk = one / (s**2 + one)
        variance = (outside + (shrunk[:, None] * inside**2).sum(axis=0)) / n
        cost.append(n * np.log(variance + np.finfo(np.float64).tiny) - np.log(shrunk).sum())
    ratio = _RATIOS[np.argmin(cost, axis=0)]
    gain = s[:, None] / (s[:, None] ** 2 + ratio)
    second = v.T @ (gain * inside)
    first = np.linalg.lstsq(r, q.T @ (readings - others @ second), rcond=None)[0]
    weights = np.concatenate([first, second])
    none = np.zeros((3, ratio.size))
    return _Weights(
        np.append(1.0, scale),
        np.concatenate([np.zeros((n, 1)), design], axis=1),
        np.concatenate([none[:1], weights]),
        readings - design @ weights,
        np.concatenate([np.ones_like(none[:1]), none, np.tile(ratio, (others.shape[1], 1))]),
        (u**2) @ (gain * s[:, None]) + (q**2).sum(axis=1)[:, None],
    )


def _reshaped(whisker: Whisker, first: Array, second: Array, taper: float) -> Whisker:
    """Whisker with other curvature and taper."""
    length = whisker.length
    s = np.linspace(0.0, length, 65)
    t = 2.0 * s / length - 1.0
    curvature = whisker.curvature(s)
    curvature[:, 1] += np.polynomial.legendre.legval(t, first) / length
    curvature[:, 2] += np.polynomial.legendre.legval(t, second) / length
    return replace(
        type(whisker).from_curvature(
            length,
            interpolate.CubicSpline(s, curvature),
            radius=whisker.radius(s) * (1.0 - taper * s / length),
            youngs_modulus=whisker.youngs_modulus,
            poisson_ratio=whisker.poisson_ratio,
            any_length=True,
        ),
        pose=whisker.pose,
        name=whisker.name,
    )
