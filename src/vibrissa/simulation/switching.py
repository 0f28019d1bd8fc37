"""Switching between a free whisker and one in contact: which of the two each frame is.

A hidden Markov model, forward and backward. A whisker is in contact, or free since some frame, and
each such frame is a hypothesis of its own with a Kalman filter: its state are amplitude and speed
of each mode of free vibration, in units of the noise of the moment that they make, and the factor
by which the wrench in air is wrong, as the mass is. So what decides is the covariance of what is
left of the wrench: the sensor's noise, the state's own, and shares of the vibration that linear
modes do not explain, which grow with the deflection. A hypothesis that is young knows its state
badly, and explains the more.

In contact the wrench changes from frame to frame by what is usual for it, with long tails: a
Student distribution about the last frame, as wide as the noise and the change before. A contact
begins with a change that is well above the noise. All likelihoods are of (F, M_y, M_z).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, expm
from scipy.special import gammaln, logsumexp

from vibrissa.numerics import Array, IntArray

_CHANNELS = [0, 1, 2, 4, 5]
"""Components of the wrench: F_x, F_y, F_z, M_y, M_z; vibration hardly makes M_x."""

_FORCES, _MOMENTS = slice(1, 3), slice(3, 5)
"""Channels across the whisker."""

_RATE = 3.0
"""Onsets, and releases, per second."""

_MASS = 0.2
"""Relative standard deviation of the mass."""

_TURN = 0.12
"""Relative error of frequencies: share of a vibration that is unknown after a radian."""

_SHARE, _AXIAL = 0.15, 0.4
"""Share of the vibration that linear modes leave across the whisker, and its share along it."""

_BEND = 0.2
"""The same share for a tip that is deflected by the whisker's length."""

_FREEDOM, _FREEDOM_IN_CONTACT = 4.0, 1.0
"""Degrees of freedom of the Student distributions of a free whisker and of one in contact."""

_CHANGE, _ONSET, _AS_BEFORE = 1.5, 5.0, 0.6
"""Change from frame to frame in contact, and when it begins, over noise, and over the last one."""

_START, _RELEASED = 5.0, 0.35
"""Standard deviation of amplitudes at a release: least, over noise, and as a share of the moment,
which modes in some phase make together."""

_LOST, _MOST = 60.0, 64
"""Log likelihood below the best from which a hypothesis is dropped, and most hypotheses."""

_FINEST = 1e-4
"""Least noise, over the largest wrench."""


class Modes(NamedTuple):
    """Modes of free vibration: angular frequencies ω (k,), rad/s, and rates of their loss (k,).

    Also the wrench at the base (k, 6) that an acceleration of one makes, and the displacement of
    the tip (k, 3) over the whisker's reach.
    """

    rates: Array
    loss: Array
    wrench: Array
    tip: Array


class _Model(NamedTuple):
    """Modes in units of the noise: steps (d, d), wrench (5, d), tip over L (3, d), errors (d,).

    Also the noise (5,) of the channels and its correlation (5, 5).
    """

    step: Array
    wrench: Array
    tip: Array
    wrong: Array
    noise: Array
    correlation: Array

    @classmethod
    def of(cls, modes: Modes, step: float, noise: Array, largest: Array) -> _Model:
        """Model of a whisker."""
        square = noise[np.ix_(_CHANNELS, _CHANNELS)]
        sigma = np.maximum(np.sqrt(np.diag(square)), _FINEST * largest[_CHANNELS])
        correlation = square / np.outer(sigma, sigma)
        np.fill_diagonal(correlation, 1.0)
        rates, loss = modes.rates, modes.loss
        gains = modes.wrench[:, _CHANNELS] / sigma
        size = np.linalg.norm(gains[:, _MOMENTS], axis=1)
        # Per mode the state is (q, q̇ / ω) ω² size, so that q̈ = -(1, η ω) · state / size.
        wrench = -np.stack([gains.T / size, gains.T * loss / size], axis=2)
        tip = np.stack([modes.tip.T / (rates**2 * size), np.zeros((3, len(rates)))], axis=2)
        turns = [
            expm(step * w * np.array([[0.0, 1.0], [-1.0, -eta]]))
            for w, eta in zip(rates, loss, strict=True)
        ]
        return cls(
            np.asarray(block_diag(*turns, np.eye(1)), np.float64),
            wrench.reshape(len(sigma), -1),
            tip.reshape(3, -1),
            _TURN * np.minimum(rates * step, 1.0),
            sigma,
            correlation,
        )


class _Free(NamedTuple):
    """Hypotheses: free since a frame (k,), with state (k, d), covariance (k, d, d), log weight."""

    since: IntArray
    state: Array
    covariance: Array
    weight: Array

    def kept(self, which: IntArray) -> _Free:
        """Some of the hypotheses."""
        return _Free(
            self.since[which], self.state[which], self.covariance[which], self.weight[which]
        )

    def predicted(self, model: _Model) -> _Free:
        """State a frame later: what the frequencies' error makes of a vibration is unknown."""
        state = self.state @ model.step.T
        covariance = model.step @ self.covariance @ model.step.T
        number = np.arange(state.shape[1] - 1)
        square = state[:, :-1] ** 2 + covariance[:, number, number]
        energy = square[:, ::2] + square[:, 1::2]
        covariance[:, number, number] += np.repeat(energy * model.wrong**2, 2, axis=1)
        return self._replace(state=state, covariance=covariance)

    def with_release(self, frame: int, size: float, weight: float) -> _Free:
        """Add a release in this frame, at a moment of this size."""
        covariance = np.diag(np.full(self.state.shape[1], (_RELEASED * size + _START) ** 2))
        covariance[-1, -1] = _MASS**2
        return _Free(
            np.append(self.since, frame),
            np.concatenate([self.state, np.zeros_like(covariance[:1])]),
            np.concatenate([self.covariance, covariance[None]]),
            np.append(self.weight, weight),
        )

    def observed(self, model: _Model, measured: Array, air: Array) -> tuple[_Free, Array]:
        """Hypotheses after one measurement (5,), and its log likelihoods (k,)."""
        slopes = np.column_stack([model.wrench, air])
        spread = slopes @ self.covariance @ slopes.T + model.correlation
        vibration = self.covariance[:, :-1, :-1]
        mean = self.state[:, :-1] @ model.wrench.T
        square = mean**2 + np.einsum("ij,njk,ik->ni", model.wrench, vibration, model.wrench)
        bent = ((self.state[:, :-1] @ model.tip.T) ** 2).sum(axis=1)
        bent += np.einsum("ij,njk,ik->n", model.tip, vibration, model.tip)
        share = _SHARE**2 + _BEND**2 * np.minimum(bent, 1.0)
        across = square[:, _FORCES].sum(axis=1)
        axial, moment = _AXIAL**2 * across, share * square[:, _MOMENTS].sum(axis=1)
        errors = np.column_stack([axial, *[share * across] * 2, *[moment] * 2])
        spread[:, range(5), range(5)] += errors
        away = measured - self.state @ slopes.T
        solved = np.linalg.solve(spread, away[..., None])
        gain = np.swapaxes(np.linalg.solve(spread, slopes @ self.covariance), 1, 2)
        far = (away[:, None] @ solved)[:, 0, 0]
        found = _student(far, _FREEDOM) - 0.5 * np.linalg.slogdet(spread)[1]
        return (
            self._replace(
                state=self.state + (gain @ away[..., None])[..., 0],
                covariance=self.covariance - gain @ slopes @ self.covariance,
                weight=self.weight + found,
            ),
            found,
        )


def _student(square: Array, freedom: float) -> Array:
    """Log density of Student's distribution in five dimensions, of squared distances."""
    n = len(_CHANNELS)
    constant = gammaln(0.5 * (freedom + n)) - gammaln(0.5 * freedom)
    constant -= 0.5 * n * np.log(freedom * np.pi)
    return np.asarray(constant - 0.5 * (freedom + n) * np.log1p(square / freedom))


def _touching(measured: Array, correlation: Array) -> tuple[Array, Array]:
    """Log likelihoods (n,) of frames in contact, and of those in which it begins."""
    change = np.diff(measured, axis=0, prepend=measured[:1])
    square = (change * np.linalg.solve(correlation, change.T).T).sum(axis=1)
    before = _AS_BEFORE**2 * np.append(square[:1], square[:-1]) / len(_CHANNELS)
    constant = 0.5 * np.linalg.slogdet(correlation)[1]
    out = []
    for least in (_CHANGE, _ONSET):
        width = least**2 + before
        found = _student(square / width, _FREEDOM_IN_CONTACT) - constant
        out.append(found - 0.5 * len(_CHANNELS) * np.log(width))
    return out[0], out[1]


def contact_probability(modes: Modes, step: float, left: Array, air: Array, noise: Array) -> Array:
    """Probability (n,) that a whisker is in contact, by all frames.

    The wrench (n, 6) minus that in air and the latter, its noise (6, 6), SI units, and the time
    between frames.
    """
    model = _Model.of(modes, step, noise, np.abs(left).max(axis=0))
    measured, driven = (part[:, _CHANNELS] / model.noise for part in (left, air))
    contact, onset = _touching(measured, model.correlation)
    size = np.linalg.norm(measured[:, _MOMENTS], axis=1)
    rate = min(_RATE * step, 0.5)
    switch, stay = np.log(rate), np.log1p(-rate)
    d = model.step.shape[0]
    free = _Free(np.empty(0, np.int64), np.empty((0, d)), np.empty((0, d, d)), np.empty(0))
    forward, history = np.empty(len(left)), []
    last = np.log(0.5)
    free = free.with_release(-1, size[0], last)
    for frame, (now, driven_now) in enumerate(zip(measured, driven, strict=True)):
        begun = logsumexp(free.weight) + switch + onset[frame]
        forward[frame] = np.logaddexp(last + stay + contact[frame], begun)
        free = free.predicted(model)._replace(weight=free.weight + stay)
        free = free.with_release(frame, size[frame], last + switch)
        free, found = free.observed(model, now, driven_now)
        best = max(forward[frame], free.weight.max())
        some = np.argsort(free.weight)[-_MOST:]
        some = np.sort(some[free.weight[some] > best - _LOST])
        free, last = free.kept(some), forward[frame]
        history.append((free.since, found[some], free.weight))
    whole = logsumexp(np.append(history[-1][2], last))
    later, ahead = 0.0, np.zeros(len(history[-1][0]))
    log = forward - whole
    for frame in range(len(left) - 2, -1, -1):
        since, found, _ = history[frame + 1]
        goes_on = dict(zip(since.tolist(), found + ahead, strict=True))
        released = switch + goes_on.get(frame + 1, -np.inf)
        touched = switch + onset[frame + 1] + later
        still = [stay + goes_on.get(one, -np.inf) for one in history[frame][0].tolist()]
        ahead = np.logaddexp(still, touched)
        later = np.logaddexp(stay + contact[frame + 1] + later, released)
        log[frame] += later
    return np.asarray(np.exp(np.minimum(log, 0.0)))
