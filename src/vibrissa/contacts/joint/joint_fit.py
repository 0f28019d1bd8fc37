"""Least-squares fits of contacts together with uncertain parameters that all measurements share.

A forward model (:mod:`~vibrissa.contacts.joint.forward`) gives the channels T(x) of a contact and,
to first order, the effects of further unknowns c ~ N(0, 1) on them, N, and on the contact point,
p_c. With noise Σ, a prior of the friction ratio µ_x ~ N(0, σ²) if that is unknown too, and measured
T̃,

    χ²(x, c) = |T(x) + N c - T̃|²_Σ + |c|² + µ_x²/σ².

Its minimum over c is χ² of x alone with the covariance Σ + N Nᵀ, which is fitted; then
c = Nᵀ (Σ + N Nᵀ)⁻¹ (T̃ - T), and the contact point is p(x) + p_c c. Signals that determine no more
than the contact leave c at zero, and its uncertainty enters the covariance of the contact point:
that of all unknowns together, (JᵀJ)⁻¹ with J the derivatives with respect to (x, c), in standard
deviations.

Where this is not accurate enough, residuals and p are expanded to second order along its principal
axes, and the second moment about p is that of a cloud of contacts, weighted by residuals and
det ∂p/∂x, and widened for tails as in :mod:`~vibrissa.contacts.uncertainty.posterior`.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.contacts import Candidates
from vibrissa.contacts.fitting.least_squares import Fits
from vibrissa.contacts.joint.forward import Forward
from vibrissa.contacts.sensing.channels import (
    CHANNELS,
    CIRCULAR,
    Channels,
    channel_derivatives,
    channel_gradients,
    channels_of,
    friction_angle_derivatives,
    ratio_derivatives,
    ratio_of,
)
from vibrissa.contacts.sensing.noise import SensorNoise, explained, rank, whitening
from vibrissa.contacts.uncertainty.posterior import CERTAIN
from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.signals import within_turn
from vibrissa.status import Status
from vibrissa.whisker import Whisker

HELD = 1e-5  # tolerance for a held arc length
# Iterations in which the effects of shared unknowns, or the noise, are recomputed at the contact.
_ROUNDS, _STEADY = 3, 2
# Displacement along each axis for the second order, in standard deviations. Limits of a valid
# covariance: difference of the channels there from the second order, in standard deviations;
# kurtosis relative to a normal distribution's; and effective share of the cloud. Below the last
# share the covariance is that of the first order.
_REACH = 2.0
_MISSED, _TAILED, _COUNTING, _TOO_FEW = 0.03, 1.8, 0.3, 0.1
# Longest axis of the arc length, over L (and of the force, 1), and largest curvature of the log
# density along an axis.
_LONGEST, _SHARP = 0.25, 2.0
# Largest gain of the cloud's log density over that of a normal distribution.
_MOST_GAIN = 3.0
_CLOUD = 128
_SINGULAR = 1e-9
_MISFITS = (int(Status.NOT_FRICTIONLESS), int(Status.NOT_ONE_CONTACT))


class Joint(NamedTuple):
    """Contacts with their shared unknowns, to first order.

    χ² of the measurement and c alone (n,); all residuals (n, m), in standard deviations; the values
    with c (n, 6 or 9); the derivatives with respect to (x, c) of the residuals (n, m, u) and of the
    contact point (n, 3, u); and the weights of the channels (n, k, k).
    """

    misfit: Array
    residuals: Array
    values: Array
    design: Array
    moved: Array
    weights: Array

    def spread(self, first: int = 0) -> Array:
        """Covariances (n, u, u) of the unknowns from ``first`` on, the others being held."""
        back = np.linalg.pinv(np.nan_to_num(self.design[..., first:]), rcond=_SINGULAR)
        return np.asarray(back @ np.swapaxes(back, 1, 2))

    def covariance(self) -> Array:
        """Covariances (n, 3, 3) of the contact points."""
        return np.asarray(self.moved @ self.spread() @ np.swapaxes(self.moved, 1, 2))


class JointFit:
    """Fits of contacts to measurements of some signals."""

    def __init__(
        self,
        forward: Forward,
        channels: Channels,
        sensor: SensorNoise | None,
        least: float,
        friction: bool = False,
        ratio_sigma: float = np.inf,
    ) -> None:
        self.forward, self.channels, self.sensor = forward, channels, sensor
        self.least, self.friction, self.ratio_sigma = least, friction, ratio_sigma
        self.d, self.names = forward.d, channels.names
        self.free = [0, 1, 2, 3] if friction else [0, 2, 3]
        self._which = [CHANNELS.index(name) for name in self.names]
        self._turned = np.array([CIRCULAR[i] for i in self._which])

    def _errors(self, flat: Array, x: Array, values: Array) -> tuple[Array, Array, Array]:
        """Covariance of the channels, and the effects of c on them and on (F, p)."""
        own = self.channels.covariance(self.sensor, flat, values, self.d)
        wrench, moved = self.forward.by_errors(x, values)
        return own, channel_gradients(values, self.names) @ wrench, moved

    def fit(
        self, flat: Array, targets: Array, x: Array, values: Array | None = None, held: bool = False
    ) -> Fits:
        """Fit contacts from starts x (n, 4) to measured signals and channels, row by row.

        If ``values``, (F, p) of the starts, are given, these are near and one iteration suffices.
        If ``held``, arc lengths are held.
        """
        k, more = len(self.names), {"ratio": self.ratio_sigma, "s": HELD if held else np.inf}
        more = {name: sigma for name, sigma in more.items() if sigma < np.inf}
        names = (*self.names, *more)
        whole = np.column_stack([targets, np.zeros((len(x), len(more)))])
        if held:
            whole[:, -1] = x[:, 0]
        rounds = _ROUNDS if self.forward.errors else _STEADY
        if values is None:
            values = self.forward.values(x)
        elif not self.forward.errors:
            rounds = 1
        spread = np.empty(0)
        for _ in range(rounds):
            before, weights = spread, np.zeros((len(x), len(names), len(names)))
            own, change, _ = self._errors(flat, x, values)
            spread = own + change @ np.swapaxes(change, 1, 2)
            if np.array_equal(spread, before):
                break  # the noise does not depend on the contact
            weights[:, :k, :k] = whitening(spread)
            for i, sigma in enumerate(more.values()):
                weights[:, k + i, k + i] = 1.0 / sigma
            fits = self.forward.fit(
                names, whole, weights, x, friction=self.friction, least=self.least
            )
            x, values = fits.contacts, fits.values
        return fits

    def joint(self, flat: Array, targets: Array, fits: Fits) -> Joint:
        """Shared unknowns of fitted contacts, and the effects of all unknowns."""
        x, values = fits.contacts, fits.values
        own, change, moved = self._errors(flat, x, values)
        weights, n, m = whitening(own), len(self.free), change.shape[2]
        by_x = channel_derivatives(values, fits.tangents, self.names)[..., self.free]
        rows = [weights @ np.concatenate([by_x, change], axis=2), np.zeros((len(x), m, n + m))]
        rows[1][:, :, n:] = np.eye(m)
        if self.ratio_sigma < np.inf:
            rows.append(np.zeros((len(x), 1, n + m)))
            rows[2][:, 0, :n] = ratio_derivatives(x) / self.ratio_sigma
        away = within_turn(targets - channels_of(values)[:, self._which], self._turned)
        whole = whitening(own + change @ np.swapaxes(change, 1, 2)) if m else weights
        residual = (whole @ away[..., None])[..., 0]
        c = np.swapaxes(whole @ change, 1, 2) @ residual[..., None]
        left = [-(weights @ (away[..., None] - change @ c))[..., 0], c[..., 0]]
        if self.ratio_sigma < np.inf:
            left.append(ratio_of(x)[:, None] / self.ratio_sigma)
        moved = np.nan_to_num(moved)
        values = values.copy()
        values[:, :6] += (moved @ np.nan_to_num(c))[..., 0]
        point = np.concatenate([fits.tangents[:, 3:6][..., self.free], moved[:, 3:]], axis=2)
        return Joint(
            (residual**2).sum(axis=1),
            np.concatenate(left, axis=1),
            values,
            np.concatenate(rows, axis=1),
            point,
            weights,
        )

    def alone(self, joint: Joint) -> Joint:
        """The same contacts without shared unknowns and without the prior of friction."""
        n, k = len(self.free), len(self.names)
        return joint._replace(design=joint.design[:, :k, :n], moved=joint.moved[..., :n])

    def degrees(self, flat: Array, values: Array) -> int:
        """Number of independent channels minus that of the unknowns."""
        if self.sensor is None or not len(flat):
            return len(self.names) - len(self.free)
        own = self.channels.covariance(self.sensor, flat[:1], values[:1], self.d)
        return rank(own[0]) - len(self.free)

    def to_second_order(self, joint: Joint, fits: Fits) -> tuple[Array, AnyArray]:
        """Covariances (n, 3, 3) of contact points, and whether they are valid."""
        _, singular, v = np.linalg.svd(np.nan_to_num(joint.design), full_matrices=False)
        known = singular[:, -1] > _SINGULAR * singular[:, 0]
        axes = np.swapaxes(v, 1, 2) / np.where(known[:, None], singular, np.inf)[:, None, :]
        force = np.linalg.norm(fits.contacts[:, None, 1:], axis=2)
        stronger = np.linalg.norm(axes[:, 1 : len(self.free)], axis=1) / force
        longest = np.maximum(np.abs(axes[:, 0]) / _LONGEST, stronger)
        axes /= np.maximum(1.0, longest)[:, None]
        by_r, by_p = np.nan_to_num(joint.design) @ axes, joint.moved @ axes
        slopes, bent_r, bent_p, missed = self._second_order(joint, fits, axes)
        each = np.arange(axes.shape[2])
        bent = bent_r[..., each, each]
        level = (by_r**2).sum(axis=1) + np.einsum("nm,nmi->ni", joint.residuals, bent)
        level = np.maximum(level, np.linalg.norm(bent, axis=1))
        node = normal_cloud(each.size)
        u = node * np.where(level > _SHARP, np.maximum(level, _SHARP) ** -0.5, 1.0)[:, None]
        pairs = (0.5 * u[..., :, None] * u[..., None, :]).reshape(*u.shape[:2], -1)

        def moved(first: Array, second: Array) -> Array:
            bent = second.reshape(*second.shape[:2], -1)
            return np.asarray(u @ np.swapaxes(first, 1, 2) + pairs @ np.swapaxes(bent, 1, 2))

        away = moved(by_r, bent_r) + joint.residuals[:, None]
        log = (joint.residuals**2).sum(axis=1)[:, None] - (away**2).sum(axis=2)
        log += (node**2).sum(axis=1)
        det = np.linalg.det(slopes[:, :1] + np.einsum("nki,niab->nkab", u, slopes[:, 1:]))
        with np.errstate(divide="ignore", invalid="ignore"):
            det /= np.linalg.det(slopes[:, :1])
        arc = fits.contacts[:, :1] + np.einsum("nki,ni->nk", u, axes[:, 0])
        density = np.abs(det) if self.friction else np.maximum(det, 0.0)
        density *= np.exp(np.clip(0.5 * log, -700.0, _MOST_GAIN))
        density[(arc < self.least) | (arc > 1.0) | ~np.isfinite(density)] = 0.0
        linear = u @ np.swapaxes(by_p, 1, 2)
        covariance, fair = _moments(joint.covariance(), linear, moved(by_p, bent_p), density)
        return covariance, known & fair & (missed < _MISSED)

    def _second_order(
        self, joint: Joint, fits: Fits, axes: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Changes of derivatives for displacements along axes (n, u, a).

        Derivatives of the point, and with friction of its angle, with respect to x, and their
        changes for a unit of each axis (n, 1 + a, f, f); second derivatives along the axes of
        residuals (n, m, a, a) and points (n, 3, a, a); and the error of these for the channels
        (n,).
        """
        x, k = fits.contacts[:, None], len(self.names)
        along = axes[:, : len(self.free)]
        n, m = len(along), along.shape[2]
        seen, slopes = self._slopes(joint.weights, fits.values, fits.tangents, fits.contacts)
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.array([1.0 - x[..., 0], x[..., 0] - self.least])[:, :, 0, None]
            room = room / np.abs(along[:, 0])
        up, down = np.fmin(np.where(along[:, 0] < 0.0, room[::-1], room), _REACH)
        step = np.where(up >= down, up, -down)
        there = np.repeat(x, m, axis=1)
        there[..., self.free] += step[..., None] * np.swapaxes(along, 1, 2)
        there = there.reshape(n * m, 4)
        weights = np.repeat(joint.weights, m, axis=0)
        other, steeper = self._slopes(weights, *self.forward.near(there), there)
        change = (steeper.reshape(n, m, *slopes.shape[1:]) - slopes[:, None]) / step[
            ..., None, None
        ]
        mean = (slopes[:, None] + 0.5 * step[..., None, None] * change)[:, :, -k:]
        mean = np.einsum("namf,nfa->nam", mean, along)
        turned = within_turn(other.reshape(n, m, k) - seen[:, None], self._turned)
        off = (joint.weights[:, None] @ turned[..., None])[..., 0] - step[..., None] * mean
        far = np.linalg.norm(off, axis=2) * (_REACH / np.abs(step)) ** 3
        missed = np.where(np.isfinite(far), far, np.inf).max(axis=1, initial=0.0)
        second = np.swapaxes(np.nan_to_num(change @ along[:, None]), 1, 2)
        second = 0.5 * (second + np.swapaxes(second, 2, 3))
        residuals = np.zeros((n, joint.design.shape[1], m, m))
        residuals[:, :k] = second[:, -k:]
        changes = np.concatenate([slopes[:, None], np.nan_to_num(change)], axis=1)[:, :, :-k]
        return changes, residuals, second[:, :3], missed

    def _slopes(
        self, weights: Array, values: Array, tangents: Array, x: Array
    ) -> tuple[Array, Array]:
        """Channels (n, k); derivatives with respect to x of points, friction angle, channels."""
        rows = [tangents[:, 3:6]]
        if self.friction:
            rows.append(friction_angle_derivatives(x)[:, None])
        rows.append(weights @ channel_derivatives(values, tangents, self.names))
        return channels_of(values)[:, self._which], np.concatenate(rows, axis=1)[..., self.free]

    def allow(
        self, flat: Array, targets: Array, found: Candidates, status: IntArray
    ) -> tuple[Candidates, IntArray, Array]:
        """Candidates of the nominal rod with effects of shared unknowns; statuses, first χ²."""
        there = np.arange(found.x.shape[1]) < found.number[:, None]
        row, place = np.nonzero(there)
        out, degrees = found.allowed_first(there), 0  # a copy
        if row.size:
            fits = self.fit(flat[row], targets[row], out.x[row, place])
            joint = self.joint(flat[row], targets[row], fits)
            out.x[row, place], out.values[row, place] = fits.contacts, joint.values[:, :6]
            out.covariances[row, place] += joint.covariance() - self.alone(joint).covariance()
            out.chi_squared[row, place] = joint.misfit
            degrees = self.degrees(flat[row], fits.values)
        first = out.chi_squared[:, 0]
        better = np.isin(status, _MISFITS) & (found.number > 0) & (first <= explained(degrees))
        sure = (out.probability[:, 0] > CERTAIN) | (found.number == 1)
        known = np.where(sure, int(Status.UNIQUE), int(Status.AMBIGUOUS))
        return out, np.where(better, known, status), first.copy()


@cache
def normal_cloud(dimension: int) -> Array:
    """Symmetric points (n, dimension) with the covariance of a normal distribution."""
    half = np.random.default_rng(0).standard_normal((_CLOUD // 2, dimension))
    points = np.concatenate([half, -half])
    root = np.linalg.cholesky(points.T @ points / _CLOUD)
    return np.asarray(points @ np.linalg.inv(root).T)


def _moments(first: Array, linear: Array, points: Array, density: Array) -> tuple[Array, AnyArray]:
    """Covariances (n, 3, 3) of a cloud (n, c, 3) with density (n, c), and which are usable.

    Tails are relative to those of its linear part, whose covariances are ``first``.
    """
    total = np.maximum(density.sum(axis=1), 1e-300)
    counting = total**2 / (_CLOUD * np.maximum((density**2).sum(axis=1), 1e-300))
    share = density / total[:, None]
    second = np.einsum("nk,nki,nkj->nij", share, points, points)
    few = counting <= _TOO_FEW

    def fourth(cloud: Array, covariance: Array) -> Array:
        inverse = np.asarray(np.linalg.pinv(covariance, 1e-12, hermitian=True))
        return np.asarray((cloud @ inverse * cloud).sum(axis=2) ** 2)

    own = np.where(few[:, None, None], first, second)
    tailed = (share * fourth(points, own)).sum(axis=1)
    tailed /= np.maximum(fourth(linear, first).mean(axis=1), 1e-300)
    wider = np.maximum(tailed, 1.0) ** 0.75 / np.maximum(counting, _TOO_FEW)
    out = np.where(few[:, None, None], first + second, second * wider[:, None, None])
    return out, (tailed < _TAILED) & (counting > _COUNTING)


def check_compliance(sigma: float, sensor: SensorNoise | None) -> None:
    """Refuse what is not a standard deviation, or one without noise."""
    if not 0.0 <= sigma < np.inf:
        raise ValueError(
            f"compliance_sigma is a standard deviation, rad/(N·m), not negative; got {sigma!r}"
        )
    if sigma > 0.0 and sensor is None:
        raise ValueError(
            "the uncertainty of the base's compliance adds to that of a sensor: give its noise"
        )


def soft_base(
    whisker: Whisker,
    steps: int,
    channels: Channels,
    sensor: SensorNoise | None,
    sigma: float,
    friction: bool = False,
) -> JointFit | None:
    """Fit with an uncertain compliance of the base, rad/(N·m); None if it is certain."""
    check_compliance(sigma, sensor)
    if sigma == 0.0:
        return None
    forward = Forward.of(whisker, None, sigma, steps=steps)
    return JointFit(forward, channels, sensor, 0.0, friction)
