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
from vibrissa.contacts.joint.fold import held_back
from vibrissa.contacts.joint.forward import Forward
from vibrissa.contacts.joint.second_order import (
    SINGULAR,
    Unknowns,
    cloud_rows,
    displace_rows,
    join_rows,
)
from vibrissa.contacts.joint.weighted_fit import weigh_rows
from vibrissa.contacts.sensing.channels import Channels
from vibrissa.contacts.sensing.noise import SensorNoise, explained
from vibrissa.contacts.sensing.weighing import weighing_of
from vibrissa.contacts.uncertainty.posterior import CERTAIN
from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.signals import signal_scales
from vibrissa.status import Status
from vibrissa.whisker import Whisker

HELD = 1e-5  # tolerance for a held arc length
# Iterations in which the effects of shared unknowns, or the noise, are recomputed at the contact.
_ROUNDS, _STEADY = 3, 2
_CLOUD = 128
_LOOSEST = 10.0  # turn of the base by EI/L, rad, above which its compliance is in other units
_SOLVED = 1e-5  # χ² below which as many signals as unknowns are solved
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
        back = np.linalg.pinv(np.nan_to_num(self.design[..., first:]), rcond=SINGULAR)
        return np.asarray(back @ np.swapaxes(back, 1, 2))

    def covariance(self) -> Array:
        """Covariances (n, 3, 3) of the contact points."""
        return np.asarray(self.moved @ self.spread() @ np.swapaxes(self.moved, 1, 2))


class _Effects(NamedTuple):
    """Effects of shared unknowns on (F, p) (n, 6, m), and the noise of the channels.

    The sensor's weights (n, k, k), effects on channels (n, k, m), the covariance with these, and
    its weights.
    """

    moved: Array
    own: Array
    change: Array
    spread: Array
    whole: Array


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
        d = self.d
        scale = signal_scales(channels.signals, d.force, d.moment)
        self._how = weighing_of(channels, sensor, d.force, d.moment, scale)
        free = np.array(self.free)
        self._unknowns = Unknowns(self._how.codes, free, float(least), float(ratio_sigma))

    def _weighed(self, flat: Array, values: Array, wrench: Array) -> tuple[Array, ...]:
        """Weights, effects, covariance and its weights as of `_Effects`, for effects on (F, M)."""
        n, k, m = len(values), len(self.names), wrench.shape[2]
        out = tuple(np.empty((n, k, a)) for a in (k, m, k, k))
        values, flat = np.ascontiguousarray(values), np.ascontiguousarray(flat)
        weigh_rows(self._how, values, flat, wrench, *out)
        return out

    def _noise(self, flat: Array, x: Array, values: Array) -> _Effects:
        """Noise of the channels, and the effects of c on them and on (F, p)."""
        wrench, moved = self.forward.by_errors(x, values)
        return _Effects(moved, *self._weighed(flat, values, wrench))

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
        rounds, known = _ROUNDS if self.forward.errors else _STEADY, None
        if values is None and self.forward.weighted:
            known = self.forward.solved(x if self.friction else x * [1.0, 0.0, 1.0, 1.0])
            values = known.values
        elif values is None:
            values = self.forward.values(x)
        elif not self.forward.errors:
            rounds = 1
        spread = np.empty(0)
        for _ in range(rounds):
            before, noise = spread, self._noise(flat, x, values)
            spread = noise.spread
            if np.array_equal(spread, before):
                break  # the noise does not depend on the contact
            weights = np.zeros((len(x), len(names), len(names)))
            weights[:, :k, :k] = noise.whole
            for i, sigma in enumerate(more.values()):
                weights[:, k + i, k + i] = 1.0 / sigma
            fits, known = self.forward.fit(
                names, whole, weights, x, known, friction=self.friction, least=self.least
            )
            x, values = fits.contacts, fits.values
        return fits

    def joint(self, flat: Array, targets: Array, fits: Fits) -> Joint:
        """Shared unknowns of fitted contacts, and the effects of all unknowns."""
        x, values = np.ascontiguousarray(fits.contacts), np.array(fits.values, order="C")
        noise = self._noise(flat, x, values)
        n, k, m = len(x), len(self.names), noise.moved.shape[2]
        u, r = len(self.free) + m, k + m + (self.ratio_sigma < np.inf)
        out = Joint(
            np.empty(n),
            np.empty((n, r)),
            values,
            np.empty((n, r, u)),
            np.empty((n, 3, u)),
            noise.own,
        )
        join_rows(
            self._unknowns,
            np.ascontiguousarray(targets),
            x,
            values,
            np.ascontiguousarray(fits.tangents),
            (noise.own, noise.change, noise.whole),
            noise.moved,
            out.misfit,
            out.residuals,
            out.design,
            out.moved,
        )
        return out

    def shared(self, joint: Joint) -> Array:
        """Part of the covariances (n, 3, 3) that is due to shared unknowns and to friction."""
        n, k = len(self.free), len(self.names)
        if joint.design.shape[1:] == (k, n):
            return np.zeros((len(joint.design), 3, 3))
        alone = joint._replace(design=joint.design[:, :k, :n], moved=joint.moved[..., :n])
        return joint.covariance() - alone.covariance()

    def _curved(self, targets: Array, fits: Fits, joint: Joint) -> Array:
        """Second-order part of the covariances (n, 3, 3) due to shared unknowns.

        Signals that determine no more than the contact leave the unknowns at their full width,
        over which the contact follows an arc: p(c) = p + b c + a c², with E c⁴ = 3.
        """
        n, k = len(self.free), len(self.names)
        by_unknown = -np.linalg.pinv(joint.design[:, :k, :n]) @ joint.design[:, :k, n:]
        slopes = joint.moved[..., n:] + joint.moved[..., :n] @ by_unknown
        out = np.zeros((len(targets), 3, 3))
        for i, (other, share) in enumerate(self.forward.errors):
            by, x = joint.weights, fits.contacts
            moved, _ = other.fit(
                self.names, targets, by, x, friction=self.friction, least=self.least
            )
            arc = share * (moved.values - fits.values)[:, 3:6] - slopes[..., i]
            arc[~(moved.misfits < _SOLVED)] = 0.0
            out += 3.0 * arc[:, :, None] * arc[:, None, :]
        return out

    def degrees(self, flat: Array, values: Array) -> int:
        """Number of independent channels minus that of the unknowns."""
        if self.sensor is None or not len(flat):
            return len(self.names) - len(self.free)
        own = self._weighed(flat[:1], values[:1], np.zeros((1, 6, 0)))[0]
        return int(np.abs(own[0]).max(axis=1).astype(bool).sum()) - len(self.free)

    def to_second_order(self, joint: Joint, fits: Fits) -> tuple[Array, AnyArray]:
        """Covariances (n, 3, 3) of contact points, and whether they are valid."""
        (n, _, u), x = joint.design.shape, np.ascontiguousarray(fits.contacts)
        axes, steps, there = np.empty((n, u, u)), np.empty((n, u)), np.empty((n, u, 4))
        first, valid = np.empty((n, 3, 3)), np.empty(n, np.bool_)
        shape = joint.design, joint.moved, axes, steps, there, first, valid
        displace_rows(self._unknowns, x, *shape)
        values, tangents = self.forward.near(there.reshape(n * u, 4))
        covariance = np.empty((n, 3, 3))
        cloud_rows(
            self._unknowns,
            joint.weights,
            (np.ascontiguousarray(fits.values), np.ascontiguousarray(fits.tangents), x),
            (values.reshape(n, u, -1), tangents.reshape(n, u, -1, 4), there),
            (joint.residuals, joint.design, joint.moved),
            (axes, steps),
            normal_cloud(u),
            first,
            covariance,
            valid,
        )
        return covariance, valid

    def allow(
        self, flat: Array, targets: Array, found: Candidates, status: IntArray
    ) -> tuple[Candidates, IntArray, Array]:
        """Candidates of the nominal rod with effects of shared unknowns; statuses, first χ²."""
        there = np.arange(found.x.shape[1]) < found.number[:, None]
        row, place = np.nonzero(there)
        out, degrees = found.allowed_first(there), 0  # a copy
        if row.size:
            fits = self.fit(flat[row], targets[row], out.x[row, place])
            degrees = self.degrees(flat[row], fits.values)
            if not self.friction:
                fits = held_back(self, flat, targets, row, fits, explained(degrees))
                there[row, place] = np.isfinite(fits.misfits)
            joint = self.joint(flat[row], targets[row], fits)
            out.x[row, place], out.values[row, place] = fits.contacts, joint.values[:, :6]
            out.covariances[row, place] += self.shared(joint)
            if joint.design.shape[1:] == (len(self.names) + len(self.forward.errors),) * 2:
                out.covariances[row, place] += self._curved(targets[row], fits, joint)
            out.chi_squared[row, place] = joint.misfit
            out = out.allowed_first(there)
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


def check_compliance(sigma: float, sensor: SensorNoise | None, whisker: Whisker) -> None:
    """Refuse what is not a standard deviation of the base of a whisker, or one without noise."""
    if not 0.0 <= sigma < np.inf:
        raise ValueError(
            f"compliance_sigma is a standard deviation, rad/(N·m), not negative; got {sigma!r}"
        )
    turn = sigma * whisker.base_bending_stiffness / whisker.length
    if turn > _LOOSEST:
        raise ValueError(
            f"compliance_sigma is {sigma:.3g} rad/(N·m), a turn of {turn:.3g} rad by the moment "
            "EI/L that bends this whisker: is it per mN·m or µN·m?"
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
    check_compliance(sigma, sensor, whisker)
    if sigma == 0.0:
        return None
    forward = Forward.of(whisker, None, sigma, steps=steps)
    return JointFit(forward, channels, sensor, 0.0, friction)
