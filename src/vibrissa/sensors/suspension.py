"""Calibration of a suspended whisker from contacts ("touches") at known points.

The unknowns are the two compliances and, given enough touches, the pivot and the position and
direction of the base, each with its prior; optionally also the rest curvature, the taper and the
friction. The readings are linear in the weights of the features, which are eliminated from the fit
(variable projection), so that 2 to 19 nonlinear unknowns remain. The weights have a normal prior
whose size maximises the likelihood of the readings. With enough touches, a thin-plate Gaussian
process models the remaining error.
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

# Number of touches that are required, above which more than the compliances may be free, and from
# which a Gaussian process is used.
FEWEST, SOME, PLENTY = 20, 40, 100
# Numbers of mechanical unknowns that may be free: the compliances; the pivot too; and the pose of
# the base. The choice is made by cross-validation on whole regions of touches: errors that
# neighbouring touches share, and that superfluous unknowns absorb, then show in the prediction, as
# they would not with single touches left out. Below `PLENTY` there are too few touches for this,
# and no process that absorbs the remaining error: the pose is free. Curvature, taper and friction
# do more harm than good.
CHOICES = (2, 5, 11)
# Number of regions for cross-validation, and largest number of touches used for it.
_REGIONS, _ENOUGH_TO_CHOOSE = 5, 300
# Candidate ratios of the variance of the noise to that of the (scaled) weights.
_RATIOS = np.logspace(-6, 1, 15)
# Largest numbers of Gauss-Newton steps and of dampings of each; relative gain at which they end.
_ROUNDS, _TRIES, _ENOUGH = 20, 6, 2e-3
# Posterior standard deviation, relative to the prior one, above which an unknown is undetermined.
_OPEN = 0.7
_LOST = 5.0  # residual of a touch without equilibrium, in units of the noise
# Residual above which a touch is an outlier, relative to the channel's median (which outliers
# hardly affect), and to the channel's range. Of the repeated touches of a real wire, one in 1,200
# differed by 15 % of the range, the others by less than 4 %.
_OUTLYING, _LEAST_OUTLYING = 10.0, 0.05
# Initial logarithms of compliances in L/EI and L³/EI, of which the best is used; the middle one is
# the mean of the prior.
_STARTS = [(np.log(r), np.log(t)) for r in (0.1, 0.5, 2.0) for t in (3e-4, 3e-3, 3e-2)]


class Unknown(NamedTuple):
    """Mechanical unknown: name, standard deviation of its prior, and finite-difference step."""

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
    """Suspended whisker, calibrated by touches at known points.

    Attributes
    ----------
    sensor : SuspendedWhisker
        Whisker with the fitted suspension, read-out and noise.
    names : tuple of str
        Free mechanical unknowns; lengths are relative to the whisker's, compliances in units of
        L/EI and L³/EI, curvatures as coefficients of Legendre polynomials of arc length, times L.
    values : (p,) array
        Values of the unknowns, as changes of the stated values.
    covariance : (p, p) array
        Covariance of the values.
    undetermined : tuple of str
        Unknowns that the readings hardly determine: their uncertainty is nearly that of the prior.
    readout_covariance : (k, 13, 13) array
        Covariance of each channel's read-out for given mechanics.
    residual : (k,) array
        Root mean square error of the readings by the rod model.
    used : (n,) bool array
        Touches used for the fit; the others have no equilibrium in this model, or are outliers.
    outliers : (n,) bool array
        Touches with a residual more than ten times the median, as when the probe slipped or the
        wire was caught.
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
        Whisker at rest, as returned by `Whisker.from_points` for points in the sensor's frame.
    points : array_like (n, 3)
        Contact points, sensor frame, m; rows with NaN are ignored.
    readings : array_like (n, k)
        Readings of the channels, in any unit.
    channels : tuple of str, optional
        Names of the channels.
    rest : array_like (k,), optional
        Readings of the untouched whisker; by default zero.
    base_sigma : float
        Standard deviation of the stated position of the base, m.
    drift : array_like (k,)
        Standard deviation of the change of readings from one recording to the next.
    free : int, optional
        Number of free mechanical unknowns, 2 to 19. By default 2 (the compliances) for up to 40
        touches, and 11 (with pivot and pose of the base) below 100. For more touches a Gaussian
        process models the remaining error, and the best of 2, 5 (with the pivot) and 11 is chosen
        by cross-validation on regions of touches.

    Returns
    -------
    SuspensionCalibration
        Calibrated sensor, with covariances.

    Raises
    ------
    ValueError
        If shapes do not match, or there are too few touches or no signal.
    """
    p, y = numbers("points", points), numbers("readings", readings, channels or (), any_unit=True)
    if p.ndim != 2 or p.shape[1] != 3 or y.ndim != 2 or len(y) != len(p):
        raise ValueError(
            f"points (n, 3) and readings (n, k) are needed; got {p.shape} and {y.shape}"
        )
    names = channels or tuple(f"channel {i + 1}" for i in range(y.shape[1]))
    zero = np.zeros(y.shape[1]) if rest is None else numbers("rest", rest, any_unit=True)
    if len(names) != y.shape[1] or zero.shape != (y.shape[1],):
        raise ValueError(f"{y.shape[1]} channels have names {names} and rest {zero.tolist()}")
    if not 0.0 < base_sigma < whisker.length:
        raise ValueError(
            f"base_sigma is {base_sigma:g} m; more than 0 and less than the whisker's length, "
            f"{whisker.length:.3g} m, is needed"
        )
    known = np.isfinite(p).all(axis=1) & np.isfinite(y).all(axis=1)
    if known.sum() < FEWEST:
        raise ValueError(f"{known.sum()} touches are too few; {FEWEST} are needed")
    if idle := [n for n, size in zip(names, np.ptp(y[known], axis=0), strict=True) if size == 0.0]:
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
    """Number of unknowns that best predicts regions of touches left out of the fit."""
    if len(points) < PLENTY:
        return CHOICES[0] if len(points) <= SOME else CHOICES[-1]
    from scipy.cluster.vq import kmeans2  # a slow import that nothing else needs

    kept = np.random.default_rng(0).permutation(len(points))[:_ENOUGH_TO_CHOOSE]
    points, readings = points[kept], readings[kept]
    region = kmeans2(points / np.abs(points).max(), _REGIONS, seed=0, minit="++")[1]
    spread = readings.std(axis=0)
    start = _Problem(whisker, points, readings, unknowns[: CHOICES[0]]).minimise().values
    misses = []
    for number in CHOICES:
        miss = np.ones_like(readings)  # without a prediction, the error is that of the mean
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
    """Model, linear fit and cost for given values of the unknowns."""

    values: Array
    sensor: SuspendedWhisker
    contacts: Array
    touches: Touches
    ok: AnyArray
    fit: _Weights
    cost: float


class _Weights(NamedTuple):
    """Ridge regression of readings on scaled features; see `_weights`."""

    scale: Array
    design: Array
    weights: Array
    residuals: Array
    ratio: Array
    leverage: Array


class _Problem:
    """Nonlinear least-squares fit of the mechanical unknowns to touches."""

    def __init__(
        self, whisker: Whisker, points: Array, readings: Array, unknowns: tuple[Unknown, ...]
    ) -> None:
        self.whisker, self.points, self.readings = whisker, points, readings
        self.unknowns = unknowns
        self.sigma = np.array([one.sigma for one in unknowns])
        self.mean = np.append(_STARTS[len(_STARTS) // 2], np.zeros(len(unknowns) - 2))
        self.noise = 0.02 * np.ptp(readings, axis=0)

    def model(self, x: Array) -> SuspendedWhisker:
        """Suspended whisker for given values of the unknowns."""
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
        """Solve for all contacts and for the weights of the features."""
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
        """Part of the cost due to the prior."""
        return float((((x - self.mean) / self.sigma) ** 2).sum())

    def slopes(self, at: _State) -> Array:
        """Derivatives of scaled residuals by the unknowns, by Kaufman's variable projection."""
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

    def minimise(self, starts: Sequence[Any] = _STARTS) -> _State:
        """Minimise the cost from the best initial compliances."""
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
            # The noise, and with it the weight of each channel, is estimated from the current fit.
            self.noise = np.maximum(self.left(new), 1e-9 * np.ptp(self.readings, axis=0))
            settled = gain < _ENOUGH * at.cost
            at = self.state(new.values, new.contacts)
            if settled:
                break
        return at

    def check(self, at: _State) -> None:
        """Raise ValueError if the whisker reaches too few of the touches."""
        held, length = int(at.ok.sum()), self.whisker.length
        if held >= min(FEWEST, len(self.points) // 2):
            return
        near, far = np.quantile(np.linalg.norm(self.points, axis=1), (0.1, 0.9))
        raise ValueError(
            f"this whisker can reach only {held} of {len(at.ok)} touches: most are "
            f"{1e3 * near:.3g} to {1e3 * far:.3g} mm from its base, and its length is "
            f"{1e3 * length:.3g} mm. Are origin, axes and unit of the touches right, and does its "
            "shape begin at the base?"
        )

    def misses(self, at: _State) -> Array:
        """Leave-one-out residuals of the touches."""
        free = at.fit.leverage[at.ok] + len(self.unknowns) / max(at.ok.sum(), 1) / 3.0
        return np.asarray(at.fit.residuals[at.ok] / np.maximum(1.0 - free, 0.1))

    def left(self, at: _State) -> Array:
        """Standard deviation of the leave-one-out residuals."""
        return np.asarray(np.sqrt((self.misses(at) ** 2).mean(axis=0)))

    def outliers(self) -> AnyArray:
        """Mask (n,) of touches with a reading far from the model."""
        at = self.minimise()
        size = np.abs(self.misses(at))
        usual = 1.4826 * np.median(size, axis=0)
        most = np.maximum(_OUTLYING * usual, _LEAST_OUTLYING * np.ptp(self.readings, axis=0))
        out = np.zeros(len(self.points), dtype=bool)
        out[at.ok] = (size > most).any(axis=1)
        return out

    def solved(
        self, names: tuple[str, ...], rest: Array, known: AnyArray, starts: Sequence[Any] = _STARTS
    ) -> SuspensionCalibration:
        """Fit the model and return the calibration."""
        at = self.minimise(starts)
        jacobian = self.slopes(at)
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
    """Regress readings on all features but the constant, with a ridge on all but rotations."""
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
    """Whisker with changed curvature and taper."""
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
            any_length=True,
        ),
        youngs_modulus=whisker.youngs_modulus,
        poisson_ratio=whisker.poisson_ratio,
        pose=whisker.pose,
        name=whisker.name,
    )
