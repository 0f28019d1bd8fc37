"""Contacts fitted together with unknowns that all measurements share: one least squares for all.

A forward model (:mod:`~vibrissa.contacts.forward`) gives channels T(x) of a contact and, to first
order, what further unknowns c ~ N(0, 1) change of them, N, and of the contact point, p_c. With the
noise Σ, a prior of the friction ratio µ_x ~ N(0, σ²) where that is unknown too, and T̃ measured,

    χ²(x, c) = |T(x) + N c - T̃|²_Σ + |c|² + µ_x²/σ².

The least by c is χ² of x alone with the covariance Σ + N Nᵀ, which is fitted; then
c = Nᵀ (Σ + N Nᵀ)⁻¹ (T̃ - T), and the contact point is p(x) + p_c c. Signals that determine no more
than the contact leave c zero, and the covariance of the contact point takes up what c may move: it
is that of all unknowns together, (JᵀJ)⁻¹ with J by (x, c) in standard deviations.

To second order along each principal axis u of it p changes by h = (p_uu - p_y J⁺ r_uu)/2 at
unchanged signals; its second moment is added.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.contacts.channels import (
    CHANNELS,
    CIRCULAR,
    Channels,
    channel_derivatives,
    channel_gradients,
    channels_of,
    ratio_derivatives,
)
from vibrissa.contacts.contacts import Candidates
from vibrissa.contacts.forward import Forward
from vibrissa.contacts.least_squares import Fits
from vibrissa.contacts.noise import SensorNoise, explained, rank, whitening
from vibrissa.contacts.posterior import CERTAIN
from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.signals import within_turn
from vibrissa.status import Status
from vibrissa.whisker import Whisker

# How exactly an arc length is held.
HELD = 1e-5
# Rounds in which the effects of shared unknowns, or the noise, are taken anew at the contact.
_ROUNDS, _STEADY = 3, 2
# The second order is taken from this far along each axis, in standard deviations; the covariance is
# relied on where the contact point moves there by less than one in addition.
_REACH, _BENT = 2.0, 1.0
_SINGULAR = 1e-9
_MISFITS = (int(Status.NOT_FRICTIONLESS), int(Status.NOT_ONE_CONTACT))


class Joint(NamedTuple):
    """Contacts with their shared unknowns, to first order.

    χ² of the measurement and c alone (n,); the values with c (n, 6 or 9); the derivatives of all
    residuals by (x, c) (n, m, u), in standard deviations, those of the contact point (n, 3, u); and
    the weights of the channels (n, k, k).
    """

    misfit: Array
    values: Array
    design: Array
    moved: Array
    weights: Array

    def spread(self, first: int = 0) -> Array:
        """Covariances (n, u, u) of the unknowns from this one on, the others being held."""
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
        """Covariance of the channels, and what c changes of them and of (F, p)."""
        own = self.channels.covariance(self.sensor, flat, values, self.d)
        wrench, moved = self.forward.by_errors(x, values)
        return own, channel_gradients(values, self.names) @ wrench, moved

    def fit(
        self, flat: Array, targets: Array, x: Array, values: Array | None = None, held: bool = False
    ) -> Fits:
        """Fit contacts from starts x (n, 4) to measured signals and channels, row by row.

        With ``values`` (F, p) of the starts, which are near, once; at their arc lengths if held.
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
        for _ in range(rounds):
            weights = np.zeros((len(x), len(names), len(names)))
            own, change, _ = self._errors(flat, x, values)
            weights[:, :k, :k] = whitening(own + change @ np.swapaxes(change, 1, 2))
            for i, sigma in enumerate(more.values()):
                weights[:, k + i, k + i] = 1.0 / sigma
            fits = self.forward.fit(
                names, whole, weights, x, friction=self.friction, least=self.least
            )
            x, values = fits.contacts, fits.values
        return fits

    def joint(self, flat: Array, targets: Array, fits: Fits) -> Joint:
        """Shared unknowns of fitted contacts, and what all unknowns change."""
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
        moved = np.nan_to_num(moved)
        values = values.copy()
        values[:, :6] += (moved @ np.nan_to_num(c))[..., 0]
        point = np.concatenate([fits.tangents[:, 3:6][..., self.free], moved[:, 3:]], axis=2)
        return Joint(
            (residual**2).sum(axis=1),
            values,
            np.concatenate(rows, axis=1),
            point,
            weights,
        )

    def degrees(self, flat: Array, values: Array) -> int:
        """Number of independent channels less that of the unknowns."""
        if self.sensor is None or not len(flat):
            return len(self.names) - len(self.free)
        own = self.channels.covariance(self.sensor, flat[:1], values[:1], self.d)
        return rank(own[0]) - len(self.free)

    def to_second_order(self, joint: Joint, fits: Fits) -> tuple[Array, AnyArray]:
        """Covariances (n, 3, 3) of contact points, and whether they are valid."""
        design, n = np.nan_to_num(joint.design), len(self.free)
        _, singular, v = np.linalg.svd(design, full_matrices=False)
        axes = np.swapaxes(v, 1, 2) / np.maximum(singular, 1e-300)[:, None, :]
        back = joint.moved @ np.linalg.pinv(design, rcond=_SINGULAR)
        bends = np.stack(
            [self._bend(joint, fits, axes[:, :n, i], back) for i in range(axes.shape[2])], axis=2
        )
        out = joint.covariance()
        valid = np.isfinite(bends).all(axis=(1, 2))
        bends = np.nan_to_num(bends)
        inverse = np.linalg.pinv(out, rcond=1e-12, hermitian=True)
        far = _REACH**2 * np.sqrt(np.einsum("nai,nab,nbi->ni", bends, inverse, bends).max(axis=1))
        mean = bends.sum(axis=2)
        out += 2.0 * bends @ np.swapaxes(bends, 1, 2) + mean[:, :, None] * mean[:, None, :]
        return out, valid & (far < _BENT)

    def _bend(self, joint: Joint, fits: Fits, axis: Array, back: Array) -> Array:
        """Second-order changes h (n, 3) of points along an axis of x (n, free), to one side."""
        x = fits.contacts
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.array([1.0 - x[:, 0], x[:, 0] - self.least]) / np.abs(axis[:, 0])
        up, down = np.minimum(np.where(axis[:, 0] < 0.0, room[::-1], room), _REACH)
        step = np.where(up >= down, up, -down)[:, None]
        there = x.copy()
        there[:, self.free] += step * axis
        values, tangents = self.forward.near(there)
        k = len(self.names)

        def slopes(values: Array, tangents: Array) -> Array:
            channels = joint.weights @ channel_derivatives(values, tangents, self.names)
            both = np.concatenate([tangents[:, 3:6], channels], axis=1)[..., self.free]
            return np.asarray(both @ axis[..., None])[..., 0]

        second = (slopes(values, tangents) - slopes(fits.values, fits.tangents)) / step
        by_channels = np.einsum("nij,nj->ni", back[..., :k], second[:, 3:])
        return np.asarray(0.5 * (second[:, :3] - by_channels))

    def allow(
        self, flat: Array, targets: Array, found: Candidates, status: IntArray
    ) -> tuple[Candidates, IntArray, Array]:
        """Candidates of the stated rod with what its shared unknowns move; statuses, first χ²."""
        there = np.arange(found.x.shape[1]) < found.number[:, None]
        row, place = np.nonzero(there)
        out, degrees = found.allowed_first(there), 0  # a copy
        if row.size:
            fits = self.fit(flat[row], targets[row], out.x[row, place])
            joint = self.joint(flat[row], targets[row], fits)
            n, k = len(self.free), len(self.names)
            alone = joint._replace(design=joint.design[:, :k, :n], moved=joint.moved[..., :n])
            out.x[row, place], out.values[row, place] = fits.contacts, joint.values[:, :6]
            out.covariances[row, place] += joint.covariance() - alone.covariance()
            out.chi_squared[row, place] = joint.misfit
            degrees = self.degrees(flat[row], fits.values)
        first = out.chi_squared[:, 0]
        better = np.isin(status, _MISFITS) & (found.number > 0) & (first <= explained(degrees))
        sure = (out.probability[:, 0] > CERTAIN) | (found.number == 1)
        known = np.where(sure, int(Status.UNIQUE), int(Status.AMBIGUOUS))
        return out, np.where(better, known, status), first.copy()


def check_compliance(sigma: float, sensor: SensorNoise | None) -> None:
    """Refuse what is not a standard deviation, or one without noise to weigh it against."""
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
    """Fit with an uncertain compliance of the base, rad/(N·m); None where it is certain."""
    check_compliance(sigma, sensor)
    if sigma == 0.0:
        return None
    forward = Forward.of(whisker, None, sigma, steps=steps)
    return JointFit(forward, channels, sensor, 0.0, friction)
