"""Vibrations: what a whisker's mass adds to the wrench at its base, and detection of contact.

About its rest shape a free whisker that is held at a moving base vibrates in modes S_k, which
:mod:`vibrissa.simulation.chain` has: with a the acceleration of its points if it did not bend,

    q̈ + η ω² q̇ + ω² q = -Σ m S·a,    F = -Σ m (a + Σ S_k q̈_k),    M = -Σ m x × (a + Σ S_k q̈_k),

in the frame of the base, with η = 2 ζ/ω₁ for a damping of the material. Two pairs of modes are
enough. What is left of the measured wrench of a free whisker is vibration after a release or an
impact, which decays in the same modes from an unknown start; which frames are of a free whisker,
the switching below finds.

**Mass, resonances and damping** from the wrench at the base while the whisker is free.

The motion of the base gives the mass, ringing after a release or a tap the frequencies and the
damping. All windows in which nothing is touched are fitted at once: in each, free vibrations of an
unknown start are left out of M_y and M_z (`Vibration`), and what the
model leaves besides the noise is a share of the window's own size. Three factors are fitted, of
mass, of frequency and of the time constant of the damping.

**Switching** between a free whisker and one in contact: which of the two each frame is.

A hidden Markov model, forward and backward. A whisker is in contact, or free since some frame, and
each such frame is a hypothesis of its own with a Kalman filter: its state are amplitude and speed
of each mode of free vibration, in units of the noise of the moment that they make, and the factor
by which the wrench in air is wrong, as the mass is. So what decides is the covariance of what is
left of the wrench: the sensor's noise, the state's own, and shares of the vibration that linear
modes do not explain, which grow with the deflection. A hypothesis that is young knows its state
badly, and explains the more. A wrong mass or stiffness makes all frequencies wrong by one factor,
and with it the phase of every vibration ever more; the factor is that by which all frames are most
probable, in steps of 10 %.

In contact the wrench changes from frame to frame by what is usual for it, with long tails: a
Student distribution about the last frame, as wide as the noise and the change before. A contact
begins with a change that is well above the noise, and is as improbable without one: otherwise a
vibration just before an onset, which a wrong mass explains badly, is called contact too. All
likelihoods are of (F, M_y, M_z).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from vibrissa.deferred import interpolate, linalg, optimize, signal, special
from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.simulation.chain import Chain, jacobian
from vibrissa.simulation.dynamics import Dynamics, at_rest, slowest
from vibrissa.whisker import Whisker

_MODES = 4  # modes, a pair of them for each number of nodes
_PERIODS = 1.2  # length of a window, in periods of the first mode


@dataclass(frozen=True, eq=False)
class Vibration:
    """Vibration of a free whisker that is held at its base; made by :meth:`of`.

    Attributes
    ----------
    rates : (k,) array
        Angular frequencies of the modes without damping, rad/s.
    damping : float
        Time constant η of the damping, s.
    mass : (m,) array
        Masses of points of the whisker, kg.
    places : (m, 3) array
        Places of these points at rest, whisker frame, m.
    shapes : (k, m, 3) array
        Displacements of the modes, of mass one, 1/√kg.
    """

    rates: Array
    damping: float
    mass: Array
    places: Array
    shapes: Array

    @classmethod
    def of(cls, whisker: Whisker, dynamics: Dynamics | None = None) -> Vibration:
        """Find the modes of a whisker.

        Parameters
        ----------
        whisker : Whisker
            Whisker at rest.
        dynamics : Dynamics, optional
            Density and damping, known to 20 %.

        Returns
        -------
        Vibration
            Vibration in the two lowest pairs of modes.
        """
        dynamics = dynamics or Dynamics()
        chain = Chain.of(whisker, dynamics.density, dynamics.segments)
        state = at_rest(chain)
        slow, turns = slowest(state, _MODES)
        turns = turns / np.sqrt(slow)
        moved = [
            jacobian(place[None], link[None], np.ones(1), state.pivots, state.turns)
            for place, link in zip(state.masses, chain.mass_link, strict=True)
        ]
        shapes = np.einsum("man,nk->kma", np.array(moved), turns)
        rates = 1.0 / np.sqrt(slow)
        damping = 2.0 * dynamics.damping_ratio / float(rates[0])
        return cls(rates, damping, chain.mass, state.masses.copy(), shapes)

    @property
    def window(self) -> float:
        """Time over which free vibration is recognised, s."""
        return float(_PERIODS * 2.0 * np.pi / self.rates[0])

    def base_wrench(self, accelerations: Array) -> Array:
        """Wrench at the base of points that are accelerated.

        Parameters
        ----------
        accelerations : (..., m, 3) array
            Accelerations of the points, whisker frame, m/s².

        Returns
        -------
        (..., 6) array
            Force, N, and moment, N·m.
        """
        pull = -self.mass[:, None] * accelerations
        moment = np.cross(self.places, pull).sum(axis=-2)
        return np.concatenate([pull.sum(axis=-2), moment], axis=-1)

    def in_air(self, time: Array, rotation: Array, position: Array) -> Array:
        """Wrench of a whisker that touches nothing while its base moves.

        Parameters
        ----------
        time : (n,) array
            Times, s, equally spaced.
        rotation : (n, 3, 3) array
            Rotation of the base, from the whisker's to the laboratory frame; smooth.
        position : (n, 3) array
            Position of the base, laboratory frame, m.

        Returns
        -------
        (n, 6) array
            Force, N, and moment, N·m, whisker frame.
        """
        places = np.einsum("tij,mj->tmi", rotation, self.places) + position[:, None]
        carried = interpolate.CubicSpline(time, places)(time, 2)
        carried = np.einsum("tij,tmi->tmj", rotation, carried)
        loads = -np.einsum("m,kma,tma->tk", self.mass, self.shapes, carried)
        bent = np.zeros_like(loads)
        for k, (rate, load) in enumerate(zip(self.rates, loads.T, strict=True)):
            loss = self.damping * rate**2
            a, c = [[0.0, 1.0], [-(rate**2), -loss]], [[-(rate**2), -loss]]
            still = [load[0] / rate**2, 0.0]
            mode: Any = signal.StateSpace(a, [[0.0], [1.0]], c, [[1.0]])
            bent[:, k] = signal.lsim(mode, load, time - time[0], still)[1]
        return self.base_wrench(carried + np.einsum("tk,kma->tma", bent, self.shapes))

    def free_moments(self, scale: float, step: float, width: int) -> Array:
        """Moments of free vibrations.

        Parameters
        ----------
        scale : float
            Factor of all frequencies.
        step : float
            Time between frames, s.
        width : int
            Number of frames.

        Returns
        -------
        (2 width, 2 k) array
            M_y of all frames, then M_z, of two vibrations of each mode.
        """
        gains = self.base_wrench(self.shapes)[:, 4:]
        time = step * np.arange(width)
        columns = []
        for rate, gain in zip(scale * self.rates, gains, strict=True):
            root = np.emath.sqrt((0.5 * self.damping * rate**2) ** 2 - rate**2 + 0.0j)
            wave = np.exp((-0.5 * self.damping * rate**2 + root) * time)
            columns += [np.concatenate([g * part for g in gain]) for part in (wave.real, wave.imag)]
        return np.asarray(np.column_stack(columns), dtype=np.float64)

    def in_contact(
        self, time: Array, wrench: Array, rotation: Array, position: Array, noise: Array
    ) -> AnyArray:
        """Frames in which something is touched.

        Parameters
        ----------
        time : (n,) array
            Times, s, equally spaced.
        wrench : (n, 6) array
            Measured force and moment, whisker frame, N and N·m.
        rotation, position : (n, 3, 3) and (n, 3) arrays
            Pose of the base in the laboratory, as for `in_air`.
        noise : (6, 6) array
            Covariance of the noise of force and moment, SI units.

        Returns
        -------
        (n,) array
            True where contact is more probable than free vibration and the motion of the base, by
            all frames (:mod:`vibrissa.simulation.vibration`).
        """
        air = self.in_air(time, rotation, position)
        step = float(np.diff(time).mean())
        reach = np.linalg.norm(self.places, axis=1).max()
        modes = Modes(
            self.rates,
            self.damping * self.rates,
            self.base_wrench(self.shapes),
            self.shapes[:, -1] / reach,
        )
        return contact_probability(modes, step, wrench - air, air, noise) > 0.5


_LEAST_KNOWN = 0.3  # relative standard deviation from which a quantity is not determined
_WITHIN = np.log(3.0)  # largest factor that is tried, as a logarithm
_SHARE = 0.1  # share of a window's own size that linear modes do not explain
# Factors of the frequency that the fit is begun from, as logarithms.
_STARTS = np.log([0.8, 0.9, 1.0, 1.1, 1.25])
# Quantities that are fitted, and what determines each.
_QUANTITIES = {
    "mass": "the base must be moved",
    "resonances": "the whisker must ring, after a release or a tap",
    "damping": "the whisker must ring, after a release or a tap",
}


@dataclass(frozen=True)
class FittedDynamics:
    """Mass, resonances and damping that were fitted by `fit_dynamics`.

    Parameters
    ----------
    dynamics : Dynamics
        Density and damping ratio.
    youngs_modulus : float
        Young's modulus with which the whisker has these resonances, Pa.
    resonances : (4,) array
        Frequencies of the modes without damping, Hz.
    covariance : (3, 3) array
        Covariance of the logarithms of mass, resonances and time constant of the damping.
    misfit : float
        χ² per degree of freedom; the covariance is larger by it where it is above 1.
    """

    dynamics: Dynamics
    youngs_modulus: float
    resonances: Array
    covariance: Array
    misfit: float


def fit_dynamics(
    whisker: Whisker,
    time: Array,
    wrench: Array,
    rotation: Array,
    position: Array,
    noise: Array,
    dynamics: Dynamics | None = None,
    stiffness_sigma: float = np.inf,
) -> FittedDynamics:
    """Fit mass, resonances and damping to the wrench of a whisker that is free at times.

    Parameters
    ----------
    whisker : Whisker
        Whisker at rest.
    time : (n,) array
        Times, s, equally spaced.
    wrench : (n, 6) array
        Measured force and moment, whisker frame, N and N·m.
    rotation : (n, 3, 3) array
        Rotation of the base, from the whisker's to the laboratory frame; smooth.
    position : (n, 3) array
        Position of the base, laboratory frame, m.
    noise : (6, 6) array
        Covariance of the noise of force and moment, SI units.
    dynamics : Dynamics, optional
        Density and damping to begin from, known to 20 % or so.
    stiffness_sigma : float
        Relative standard deviation of the whisker's stiffness, by which resonances also give the
        mass; by default it is not known.

    Returns
    -------
    FittedDynamics
        Density, damping and resonances, with their covariance.

    Raises
    ------
    ValueError
        If no window is free, or the data do not determine one of the three.
    """
    dynamics = dynamics or Dynamics()
    first = Vibration.of(whisker, dynamics)
    free = ~first.in_contact(time, wrench, rotation, position, noise)
    step = float(time[-1] - time[0]) / (len(time) - 1)
    starts, width = _windows(free, step, first)
    if not starts.size:
        raise ValueError(
            f"no free window of {1e3 * first.window:.3g} ms was found in {len(time)} frames; a few "
            "seconds of motion in air and of ringing are needed"
        )

    def left(factors: Array) -> Array:
        varied = _varied(first, *np.exp(factors))
        moments = (wrench - varied.in_air(time, rotation, position))[:, 4:]
        windows = np.stack([moments[i : i + width].T.ravel() for i in starts])
        basis = np.linalg.qr(varied.free_moments(1.0, step, width)).Q
        away = (windows - (windows @ basis) @ basis.T) / spread[:, None]
        return np.append(away, (factors[0] + 2.0 * factors[1]) / stiffness_sigma)

    size = np.array([np.mean(wrench[i : i + width, 4:] ** 2) for i in starts])
    # What is not linear in ringing grows with its size.
    driven = np.mean(first.in_air(time, rotation, position)[:, 4:] ** 2)
    spread = np.sqrt(
        0.5 * (noise[4, 4] + noise[5, 5])
        + _SHARE**2 * size * np.sqrt(np.maximum(size / driven, 1.0))
    )
    begun = [np.array([0.0, start, 0.0]) for start in _STARTS]
    best = min(begun, key=lambda one: float((left(one) ** 2).sum()))
    fit = optimize.least_squares(left, best, bounds=(-_WITHIN, _WITHIN))
    # Each window gives as many numbers to its own vibration as there are amplitudes.
    misfit = 2.0 * fit.cost / (starts.size * (2 * width - 2 * len(first.rates)) - 3)
    slopes = np.asarray(fit.jac, dtype=np.float64)
    covariance: Array = np.linalg.pinv(slopes.T @ slopes, rcond=1e-15).astype(np.float64)
    covariance *= max(misfit, 1.0)
    deviation = np.sqrt(np.diag(covariance))
    unknown = [
        f"{name} (σ {100 * one:.0f} %; {how})"
        for one, (name, how) in zip(deviation, _QUANTITIES.items(), strict=True)
        if not 0.0 < one < _LEAST_KNOWN
    ]
    if unknown:
        raise ValueError(f"{starts.size} free windows do not determine {', '.join(unknown)}")
    mass, rate, damping = (float(one) for one in np.exp(fit.x))
    base, tip = dynamics.density
    return FittedDynamics(
        replace(
            dynamics,
            density=(mass * base, mass * tip),
            damping_ratio=dynamics.damping_ratio * damping * rate,
        ),
        whisker.youngs_modulus * mass * rate**2,
        rate * first.rates / (2.0 * np.pi),
        covariance,
        misfit,
    )


def _varied(vibration: Vibration, mass: float, rate: float, damping: float) -> Vibration:
    """Vibration with factors of mass, frequency and time constant of the damping."""
    return replace(
        vibration,
        mass=mass * vibration.mass,
        shapes=vibration.shapes / np.sqrt(mass),
        rates=rate * vibration.rates,
        damping=damping * vibration.damping,
    )


def _windows(free: AnyArray, step: float, vibration: Vibration) -> tuple[AnyArray, int]:
    """First frames of windows in which nothing is touched, and their width in frames."""
    width = max(round(vibration.window / step), len(vibration.rates) + 1)
    edges = np.flatnonzero(np.diff(free.astype(int), prepend=0, append=0))
    # The end of a contact is known to two frames or so.
    runs = zip(edges[::2] + 2, edges[1::2] - 2, strict=True)
    starts = [i for first, end in runs for i in range(first, end - width + 1, width)]
    return np.array(starts, dtype=int), width


# Components of the wrench: F_x, F_y, F_z, M_y, M_z; vibration hardly makes M_x.
_CHANNELS = [0, 1, 2, 4, 5]
_FORCES, _MOMENTS = slice(1, 3), slice(3, 5)  # channels across the whisker
_RATE = 3.0  # onsets, and releases, per second
_MASS = 0.2  # relative standard deviation of the mass
# Logarithms of factors of the frequencies: step, standard deviation, and most steps.
_STEP, _FREQUENCY, _FARTHEST = 0.1, 0.1, 4
_TURN = 0.12  # relative error of frequencies: share of a vibration that is unknown after a radian
# Share of the vibration that linear modes leave across the whisker, and its share along it.
_MODELLED, _AXIAL = 0.15, 0.4
_BEND = 0.2  # the same share for a tip that is deflected by the whisker's length
# Degrees of freedom of the Student distributions of a free whisker and of one in contact.
_FREEDOM, _FREEDOM_IN_CONTACT = 4.0, 1.0
# Change from frame to frame in contact, and when it begins, over noise, and over the last one.
_CHANGE, _ONSET, _AS_BEFORE = 1.5, 5.0, 0.6
# Power of the change with which the density of an onset begins, over two; 2 to 5 do as well.
_ABRUPT = 2.0
# Standard deviation of amplitudes at a release: least, over noise, and as a share of the moment,
# which modes in some phase make together.
_START, _RELEASED = 5.0, 0.35
# Log likelihood below the best from which a hypothesis is dropped, and most hypotheses.
_LOST, _MOST = 60.0, 64
_FINEST = 1e-4  # least noise, over the largest wrench


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
            linalg.expm(step * w * np.array([[0.0, 1.0], [-1.0, -eta]]))
            for w, eta in zip(rates, loss, strict=True)
        ]
        return cls(
            np.asarray(linalg.block_diag(*turns, np.eye(1)), np.float64),
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
        share = _MODELLED**2 + _BEND**2 * np.minimum(bent, 1.0)
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
    constant = special.gammaln(0.5 * (freedom + n)) - special.gammaln(0.5 * freedom)
    constant -= 0.5 * n * np.log(freedom * np.pi)
    return np.asarray(constant - 0.5 * (freedom + n) * np.log1p(square / freedom))


def _touching(measured: Array, correlation: Array) -> tuple[Array, Array]:
    """Log likelihoods (n,) of frames in contact, and of those in which it begins."""
    n = len(_CHANNELS)
    change = np.diff(measured, axis=0, prepend=measured[:1])
    square = (change * np.linalg.solve(correlation, change.T).T).sum(axis=1)
    before = _AS_BEFORE**2 * np.append(square[:1], square[:-1]) / n
    constant = 0.5 * np.linalg.slogdet(correlation)[1]
    out = []
    for least in (_CHANGE, _ONSET):
        width = least**2 + before
        found = _student(square / width, _FREEDOM_IN_CONTACT) - constant
        out.append(found - 0.5 * n * np.log(width))
    # The share of a Student variable's square that is not its scale's has a beta distribution;
    # its power, over the mean of that, takes small changes away and leaves a density.
    ratio = square / width / _FREEDOM_IN_CONTACT
    share = _ABRUPT * np.log(np.maximum(ratio / (1.0 + ratio), np.finfo(np.float64).tiny))
    share -= special.betaln(0.5 * n + _ABRUPT, 0.5 * _FREEDOM_IN_CONTACT)
    share += special.betaln(0.5 * n, 0.5 * _FREEDOM_IN_CONTACT)
    return out[0], out[1] + share


def contact_probability(modes: Modes, step: float, left: Array, air: Array, noise: Array) -> Array:
    """Probability (n,) that a whisker is in contact, by all frames, which also show frequencies.

    The wrench (n, 6) minus that in air and the latter, its noise (6, 6), SI units, and the time
    between frames.
    """

    def tried(number: int) -> tuple[float, Array]:
        factor = np.exp(_STEP * number)
        now = modes._replace(rates=factor * modes.rates, loss=factor * modes.loss)
        log, probability = _switching(now, step, left, air, noise)
        return log - 0.5 * (_STEP * number / _FREQUENCY) ** 2, probability

    best, number = tried(0), 0
    for way in (1, -1):
        while abs(number + way) <= _FARTHEST and (other := tried(number + way))[0] > best[0]:
            best, number = other, number + way
        if number:
            break
    return best[1]


def _switching(
    modes: Modes, step: float, left: Array, air: Array, noise: Array
) -> tuple[float, Array]:
    """Log likelihood of all frames, and the probability (n,) of contact in each."""
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
        begun = special.logsumexp(free.weight) + switch + onset[frame]
        forward[frame] = np.logaddexp(last + stay + contact[frame], begun)
        free = free.predicted(model)._replace(weight=free.weight + stay)
        free = free.with_release(frame, size[frame], last + switch)
        free, found = free.observed(model, now, driven_now)
        best = max(forward[frame], free.weight.max())
        some = np.argsort(free.weight)[-_MOST:]
        some = np.sort(some[free.weight[some] > best - _LOST])
        free, last = free.kept(some), forward[frame]
        history.append((free.since, found[some], free.weight))
    whole = special.logsumexp(np.append(history[-1][2], last))
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
    return float(whole), np.asarray(np.exp(np.minimum(log, 0.0)))
