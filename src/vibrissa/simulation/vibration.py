"""Vibration modes of a free whisker, fits of its mass and damping, and detection of contact.

**Modes.** A free whisker on a moving base vibrates about its rest shape in modes S_k, computed from
the chain of :mod:`vibrissa.simulation.chain`. If a is the acceleration of its points without
bending,

    q̈ + η ω² q̇ + ω² q = -Σ m S·a,    F = -Σ m (a + Σ S_k q̈_k),    M = -Σ m x × (a + Σ S_k q̈_k),

in the frame of the base, with material damping η = 2 ζ/ω₁. Two pairs of modes are sufficient. The
remaining wrench of a free whisker is free vibration after a release or an impact, which decays in
the same modes from unknown initial conditions.

**Mass, resonances and damping** are fitted to the wrench at the base while the whisker is free. The
motion of the base determines the mass; vibration after a release or a tap determines the
frequencies and the damping. All windows without contact are fitted together: in each, free
vibrations with arbitrary initial conditions are projected out of M_y and M_z, and the model error
is assumed to be a share of the size of the signal in the window. Three factors are fitted: those of
mass, of frequency and of the time constant of the damping.

**Contact** is detected by a hidden Markov model with forward and backward recursions. The whisker
is either in contact, or free since some frame. Each frame of release is a separate hypothesis with
a Kalman filter, whose state consists of the amplitude and velocity of each free mode, in units of
the noise of the moment they cause, of the relative error of the wrench in air, which is that of
the mass, and of the model error of the wrench: nonlinear shares of the vibration that grow with the
deflection. That error is an autoregressive process, since it changes with the vibration. If it were
independent in each frame, the wrench of a slow whisker that vibrates strongly would be better
predicted by a contact, in which it changes little. The covariance of the remaining wrench, which
includes the sensor's noise, decides between hypotheses. A recent release has a large covariance of
the state and therefore explains larger wrenches. An error of mass or stiffness scales all
frequencies by one factor and causes a growing error of phase; the factor is chosen by maximum
likelihood over all frames, in steps of 10 %.

In contact the change of the wrench from frame to frame, or, less often, the change of that change,
has a heavy-tailed (Student) distribution, whose width is given by the noise and the previous
change. A contact begins with a deviation from what the free whisker is predicted to do, which also
has a Student distribution, wider than that of a free whisker. It must not be the change since the
previous frame: where a vibration turns round, changes are small, and frames before an impact would
count as contact. All likelihoods are those of (F, M_y, M_z).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from vibrissa.deferred import interpolate, linalg, optimize, signal, special
from vibrissa.numerics import AnyArray, Array, IntArray, contacts_in
from vibrissa.simulation.chain import Chain, jacobian
from vibrissa.simulation.dynamics import Dynamics, at_rest, slowest
from vibrissa.whisker import Whisker

_MODES = 4  # number of modes: two pairs, as modes in the two directions come in pairs
_PERIODS = 1.2  # length of a window, in periods of the first mode


@dataclass(frozen=True, eq=False)
class Vibration:
    """Vibration modes of a whisker held at its base and otherwise free; see :meth:`of`.

    Attributes
    ----------
    rates : (k,) array
        Undamped angular frequencies of the modes, rad/s.
    damping : float
        Time constant η of the damping, s.
    mass : (m,) array
        Point masses of the whisker, kg.
    places : (m, 3) array
        Positions of the point masses at rest, whisker frame, m.
    shapes : (k, m, 3) array
        Displacements of the point masses in the modes, normalised to unit modal mass, 1/√kg.
    """

    rates: Array
    damping: float
    mass: Array
    places: Array
    shapes: Array

    @classmethod
    def of(cls, whisker: Whisker, dynamics: Dynamics | None = None) -> Vibration:
        """Compute the modes of a whisker.

        Parameters
        ----------
        whisker : Whisker
            Whisker at rest.
        dynamics : Dynamics, optional
            Density and damping.

        Returns
        -------
        Vibration
            The two lowest pairs of modes.
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
        """Length of a window in which free vibration is fitted, s."""
        return float(_PERIODS * 2.0 * np.pi / self.rates[0])

    def _base_wrench(self, accelerations: Array) -> Array:
        """Wrench (..., 6) at the base due to accelerations (..., m, 3) of the point masses, SI."""
        pull = -self.mass[:, None] * accelerations
        moment = np.cross(self.places, pull).sum(axis=-2)
        return np.concatenate([pull.sum(axis=-2), moment], axis=-1)

    def in_air(self, time: Array, rotation: Array, position: Array) -> Array:
        """Wrench at the base of a whisker without contact whose base moves.

        Parameters
        ----------
        time : (n,) array
            Times, s, equally spaced.
        rotation : (n, 3, 3) array
            Rotation from the whisker frame to the laboratory frame, smooth in time.
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
        return self._base_wrench(carried + np.einsum("tk,kma->tma", bent, self.shapes))

    def _free_moments(self, step: float, width: int) -> Array:
        """Basis (2 width, 2 k) of the moments of free vibrations over frames ``step`` apart, s.

        Rows are M_y of all frames, then M_z; columns two independent vibrations in each mode.
        """
        gains = self._base_wrench(self.shapes)[:, 4:]
        time = step * np.arange(width)
        columns = []
        for rate, gain in zip(self.rates, gains, strict=True):
            root = np.emath.sqrt((0.5 * self.damping * rate**2) ** 2 - rate**2 + 0.0j)
            wave = np.exp((-0.5 * self.damping * rate**2 + root) * time)
            columns += [np.concatenate([g * part for g in gain]) for part in (wave.real, wave.imag)]
        return np.asarray(np.column_stack(columns), dtype=np.float64)

    def contact_probability(
        self, time: Array, wrench: Array, rotation: Array, position: Array, noise: Array
    ) -> Array:
        """Probability that the whisker is in contact (:mod:`vibrissa.simulation.vibration`).

        Parameters
        ----------
        time : (n,) array
            Times, s, equally spaced.
        wrench : (n, 6) array
            Measured force and moment, whisker frame, N and N·m.
        rotation, position : (n, 3, 3) and (n, 3) arrays
            Pose of the base in the laboratory frame, as for `in_air`.
        noise : (6, 6) array
            Covariance of the noise of force and moment, SI units.

        Returns
        -------
        (n,) array
            Probability of contact in each frame, given all frames. A frame counts as in contact if
            it exceeds one half.
        """
        air = self.in_air(time, rotation, position)
        step = float(np.diff(time).mean())
        return _contact_probability(self, step, wrench - air, air, noise)


_LEAST_KNOWN = 0.3  # largest relative standard deviation of a quantity that counts as determined
_WITHIN = np.log(3.0)  # bound of the fitted factors, as a logarithm
_SHARE = 0.1  # model error of linear modes, relative to the size of the signal in a window
# Initial values of the frequency's factor in the fit, as logarithms.
_STARTS = np.log([0.8, 0.9, 1.0, 1.1, 1.25])
# Fitted quantities, and the condition under which each is determined.
_QUANTITIES = {
    "mass": "the base must be moved",
    "resonances": "the whisker must vibrate freely, after a release or a tap",
    "damping": "the whisker must vibrate freely, after a release or a tap",
}


@dataclass(frozen=True)
class FittedDynamics:
    """Mass, resonances and damping fitted by `fit_dynamics`.

    Parameters
    ----------
    dynamics : Dynamics
        Density and damping ratio.
    youngs_modulus : float
        Young's modulus consistent with the mass and the resonances, Pa.
    resonances : (4,) array
        Undamped frequencies of the modes, Hz.
    covariance : (3, 3) array
        Covariance of the logarithms of mass, resonances and time constant of the damping.
    misfit : float
        χ² per degree of freedom, by which the covariance is multiplied if it is above 1.
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
    """Fit mass, resonances and damping to the wrench of a whisker while it is not in contact.

    Parameters
    ----------
    whisker : Whisker
        Whisker at rest.
    time : (n,) array
        Times, s, equally spaced.
    wrench : (n, 6) array
        Measured force and moment, whisker frame, N and N·m.
    rotation : (n, 3, 3) array
        Rotation from the whisker frame to the laboratory frame, smooth in time.
    position : (n, 3) array
        Position of the base, laboratory frame, m.
    noise : (6, 6) array
        Covariance of the noise of force and moment, SI units.
    dynamics : Dynamics, optional
        Initial values of density and damping, correct to about 20 %.
    stiffness_sigma : float
        Relative standard deviation of the whisker's stiffness. If it is finite, the resonances
        also constrain the mass.

    Returns
    -------
    FittedDynamics
        Density, damping and resonances, with their covariance.

    Raises
    ------
    ValueError
        If there is no window without contact, or the data do not determine one of the quantities.
    """
    dynamics = dynamics or Dynamics()
    first = Vibration.of(whisker, dynamics)
    free = first.contact_probability(time, wrench, rotation, position, noise) <= 0.5
    step = float(time[-1] - time[0]) / (len(time) - 1)
    starts, width = _windows(free, step, first)
    if not starts.size:
        raise ValueError(
            f"no window of {1e3 * first.window:.3g} ms without contact was found in {len(time)} "
            "frames; a few seconds of motion in air and of free vibration are needed"
        )

    def residuals(factors: Array) -> Array:
        """Scaled residuals of all windows for factors (3,), as logarithms."""
        vibration = _scaled(first, *np.exp(factors))
        moments = (wrench - vibration.in_air(time, rotation, position))[:, 4:]
        windows = np.stack([moments[i : i + width].T.ravel() for i in starts])
        basis = np.linalg.qr(vibration._free_moments(step, width)).Q
        away = (windows - (windows @ basis) @ basis.T) / spread[:, None]
        return np.append(away, (factors[0] + 2.0 * factors[1]) / stiffness_sigma)

    size = np.array([np.mean(wrench[i : i + width, 4:] ** 2) for i in starts])
    # The nonlinear part of free vibration grows with its amplitude.
    driven = np.mean(first.in_air(time, rotation, position)[:, 4:] ** 2)
    spread = np.sqrt(
        0.5 * (noise[4, 4] + noise[5, 5])
        + _SHARE**2 * size * np.sqrt(np.maximum(size / driven, 1.0))
    )
    initial = [np.array([0.0, start, 0.0]) for start in _STARTS]
    best = min(initial, key=lambda one: float((residuals(one) ** 2).sum()))
    fit = optimize.least_squares(residuals, best, bounds=(-_WITHIN, _WITHIN))
    # The free vibration of each window uses two degrees of freedom per mode.
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
        raise ValueError(
            f"{starts.size} windows without contact do not determine {', '.join(unknown)}"
        )
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


def _scaled(vibration: Vibration, mass: float, rate: float, damping: float) -> Vibration:
    """Scale mass, frequencies and the time constant of the damping by factors."""
    return replace(
        vibration,
        mass=mass * vibration.mass,
        shapes=vibration.shapes / np.sqrt(mass),
        rates=rate * vibration.rates,
        damping=damping * vibration.damping,
    )


def _windows(free: AnyArray, step: float, vibration: Vibration) -> tuple[AnyArray, int]:
    """First frames of the windows without contact, and their width in frames."""
    width = max(round(vibration.window / step), len(vibration.rates) + 1)
    starts = [
        i
        for first, end in contacts_in(free)
        # The end of a contact is uncertain by about two frames.
        for i in range(first + 2, end - 2 - width + 1, width)
    ]
    return np.array(starts, dtype=int), width


# Components F_x, F_y, F_z, M_y, M_z of the wrench; vibration hardly contributes to M_x.
_CHANNELS = [0, 1, 2, 4, 5]
_FORCES, _MOMENTS = slice(1, 3), slice(3, 5)  # channels across the whisker
# State variables after the modal ones: relative error of the wrench in air, and model errors.
_AIR, _ERRORS = -6, slice(-5, None)
_RATE = 3.0  # rate of onsets, and of releases, 1/s
_MASS = 0.2  # relative standard deviation of the mass
# Logarithm of the frequencies' factor: step, standard deviation, and largest number of steps.
_STEP, _FREQUENCY, _FARTHEST = 0.1, 0.1, 4
_TURN = 0.12  # relative error of frequencies: unknown share of a vibration after one radian
# Relative model error of the vibration across the whisker, and size of the axial force relative to
# the force across it.
_MODELLED, _AXIAL = 0.06, 0.4
_FADES = 0.9  # rate at which model errors lose correlation, relative to that of the first mode
_BEND = 0.2  # additional relative model error if the tip is deflected by the whisker's length
# Degrees of freedom of the Student distributions of a free whisker and of one in contact.
_FREEDOM, _FREEDOM_IN_CONTACT = 4.0, 1.0
# Width of the distribution of changes between frames in contact, in units of the noise and relative
# to the previous change; and that of the first frame in contact, in units of the uncertainty of a
# free whisker.
_CHANGE, _AS_BEFORE, _ONSET = 1.5, 0.6, 3.0
# Probability that a frame in contact continues the change, and the width for that, as _CHANGE.
_STEADY, _CHANGE_OF_CHANGE = 0.1, 2.6
# Standard deviation of modal amplitudes at a release: smallest value, in units of the noise, and
# relative to the moment, to which all modes contribute with unknown phases.
_START, _RELEASED = 5.0, 0.35
# Difference of log likelihood from the best at which hypotheses are dropped, and largest number.
_LOST, _MOST = 60.0, 64
_FINEST = 1e-4  # smallest noise, relative to the largest wrench


class _Model(NamedTuple):
    """Linear state-space model of k modes in units of the noise, with d = 2 k + 6 state variables.

    The variables are modal, then the relative error of the wrench in air and the model errors (5,).
    ``step`` (d, d) is the transition matrix and ``fading`` the factor of the model errors in it;
    ``wrench`` (5, 2 k) and ``tip`` (3, 2 k) map the modal state to the wrench and to the
    displacement of the tip over L; ``wrong`` (k,) is the error of each mode per step; ``noise``
    (5,) and ``correlation`` (5, 5) are those of the sensor.
    """

    step: Array
    fading: float
    wrench: Array
    tip: Array
    wrong: Array
    noise: Array
    correlation: Array

    @classmethod
    def of(cls, vibration: Vibration, step: float, noise: Array, largest: Array) -> _Model:
        """Model for frames ``step`` apart; ``largest`` (6,) is the largest wrench measured."""
        square = noise[np.ix_(_CHANNELS, _CHANNELS)]
        sigma = np.maximum(np.sqrt(np.diag(square)), _FINEST * largest[_CHANNELS])
        correlation = square / np.outer(sigma, sigma)
        np.fill_diagonal(correlation, 1.0)
        rates, loss = vibration.rates, vibration.damping * vibration.rates
        gains = vibration._base_wrench(vibration.shapes)[:, _CHANNELS] / sigma
        size = np.linalg.norm(gains[:, _MOMENTS], axis=1)
        # The state of a mode is (q, q̇ / ω) ω² size, so that q̈ = -(1, η ω) · state / size.
        wrench = -np.stack([gains.T / size, gains.T * loss / size], axis=2)
        reach = np.linalg.norm(vibration.places, axis=1).max()
        tip = vibration.shapes[:, -1].T / (reach * rates**2 * size)
        tip = np.stack([tip, np.zeros((3, len(rates)))], axis=2)
        turns = [
            linalg.expm(step * w * np.array([[0.0, 1.0], [-1.0, -eta]]))
            for w, eta in zip(rates, loss, strict=True)
        ]
        fading = float(np.exp(-_FADES * rates[0] * step))
        return cls(
            np.asarray(linalg.block_diag(*turns, np.eye(1), fading * np.eye(5)), np.float64),
            fading,
            wrench.reshape(len(sigma), -1),
            tip.reshape(3, -1),
            _TURN * np.minimum(rates * step, 1.0),
            sigma,
            correlation,
        )


class _Free(NamedTuple):
    """Hypotheses (n,) "free since a frame": state (n, d), covariance (n, d, d) and log weight."""

    since: IntArray
    state: Array
    covariance: Array
    weight: Array

    def kept(self, which: IntArray) -> _Free:
        """Subset of the hypotheses."""
        return _Free._make(each[which] for each in self)

    def predicted(self, model: _Model) -> _Free:
        """Predict the state one frame later; errors of the frequencies increase its covariance."""
        state = self.state @ model.step.T
        covariance = model.step @ self.covariance @ model.step.T
        number = np.arange(model.wrench.shape[1])
        square = state[:, number] ** 2 + covariance[:, number, number]
        energy = square[:, ::2] + square[:, 1::2]
        covariance[:, number, number] += np.repeat(energy * model.wrong**2, 2, axis=1)
        return self._replace(state=state, covariance=covariance)

    def with_release(self, frame: int, size: float, weight: float) -> _Free:
        """Add the hypothesis of a release in ``frame``, where the moment has the given size."""
        covariance = np.diag(np.full(self.state.shape[1], (_RELEASED * size + _START) ** 2))
        covariance[_AIR, _AIR] = _MASS**2
        covariance[_ERRORS, _ERRORS] = 0.0
        return _Free(
            np.append(self.since, frame),
            np.concatenate([self.state, np.zeros_like(covariance[:1])]),
            np.concatenate([self.covariance, covariance[None]]),
            np.append(self.weight, weight),
        )

    def observed(self, model: _Model, measured: Array, air: Array) -> tuple[_Free, Array, Array]:
        """Update the hypotheses by one measurement (5,).

        Also return its log likelihoods (n,) if the whisker is free, and if a contact begins.
        """
        slopes = np.column_stack([model.wrench, air, np.eye(len(_CHANNELS))])
        covariance = self.covariance + self._renewed(model)
        spread = slopes @ covariance @ slopes.T + model.correlation
        away = measured - self.state @ slopes.T
        solved = np.linalg.solve(spread, away[..., None])
        gain = np.swapaxes(np.linalg.solve(spread, slopes @ covariance), 1, 2)
        far = (away[:, None] @ solved)[:, 0, 0]
        size = 0.5 * np.linalg.slogdet(spread)[1]
        found = _student(far, _FREEDOM) - size
        return (
            self._replace(
                state=self.state + (gain @ away[..., None])[..., 0],
                covariance=covariance - gain @ slopes @ covariance,
                weight=self.weight + found,
            ),
            found,
            _student(far / _ONSET**2, _FREEDOM_IN_CONTACT) - len(_CHANNELS) * np.log(_ONSET) - size,
        )

    def _renewed(self, model: _Model) -> Array:
        """Covariance (n, d, d) that the model errors gain in one frame."""
        modes = model.wrench.shape[1]
        state, vibration = self.state[:, :modes], self.covariance[:, :modes, :modes]
        mean = state @ model.wrench.T
        square = mean**2 + np.einsum("ij,njk,ik->ni", model.wrench, vibration, model.wrench)
        bent = ((state @ model.tip.T) ** 2).sum(axis=1)
        bent += np.einsum("ij,njk,ik->n", model.tip, vibration, model.tip)
        share = _MODELLED**2 + _BEND**2 * np.minimum(bent, 1.0)
        across = square[:, _FORCES].sum(axis=1)
        axial, moment = _AXIAL**2 * across, share * square[:, _MOMENTS].sum(axis=1)
        errors = np.column_stack([axial, *[share * across] * 2, *[moment] * 2])
        number = np.arange(modes + 1, self.state.shape[1])
        # At a release, in which they have no variance yet, model errors have their whole size.
        new = self.covariance[:, number, number] == 0.0
        gained = np.zeros_like(self.covariance)
        gained[:, number, number] = np.where(new, 1.0, 1.0 - model.fading**2) * errors
        return gained


def _student(square: Array, freedom: float) -> Array:
    """Log density of Student's distribution in five dimensions at squared distances."""
    n = len(_CHANNELS)
    constant = special.gammaln(0.5 * (freedom + n)) - special.gammaln(0.5 * freedom)
    constant -= 0.5 * n * np.log(freedom * np.pi)
    return np.asarray(constant - 0.5 * (freedom + n) * np.log1p(square / freedom))


def _touching(measured: Array, correlation: Array) -> Array:
    """Log likelihoods (n,) of frames in contact."""
    change = np.diff(measured, axis=0, prepend=measured[:1])
    second = np.diff(change, axis=0, prepend=change[:1])
    found = np.logaddexp(
        np.log1p(-_STEADY) + _changed(change, correlation, _CHANGE),
        np.log(_STEADY) + _changed(second, correlation, _CHANGE_OF_CHANGE),
    )
    return np.asarray(found - 0.5 * np.linalg.slogdet(correlation)[1])


def _changed(change: Array, correlation: Array, width: float) -> Array:
    """Log likelihoods (n,) of changes (n, 5), about as large as before or as the given width."""
    n = len(_CHANNELS)
    square = (change * np.linalg.solve(correlation, change.T).T).sum(axis=1)
    scale = width**2 + _AS_BEFORE**2 * np.append(square[:1], square[:-1]) / n
    return _student(square / scale, _FREEDOM_IN_CONTACT) - 0.5 * n * np.log(scale)


def _contact_probability(
    vibration: Vibration, step: float, left: Array, air: Array, noise: Array
) -> Array:
    """Probability (n,) that a whisker is in contact in each frame, given all frames.

    ``left`` (n, 6) is the measured wrench minus that in air, ``air`` (n, 6) the wrench in air,
    ``noise`` (6, 6) the covariance of the wrench, SI units, and ``step`` the time between frames,
    s. The factor of the frequencies is fitted by maximum likelihood.
    """

    def evaluate(number: int) -> tuple[float, Array]:
        """Log posterior of a step of the frequencies' factor, and probabilities of contact."""
        now = replace(vibration, rates=np.exp(_STEP * number) * vibration.rates)
        log, probability = _switching(now, step, left, air, noise)
        return log - 0.5 * (_STEP * number / _FREQUENCY) ** 2, probability

    best, number = evaluate(0), 0
    for way in (1, -1):
        while abs(number + way) <= _FARTHEST and (other := evaluate(number + way))[0] > best[0]:
            best, number = other, number + way
        if number:
            break
    return best[1]


def _switching(
    vibration: Vibration, step: float, left: Array, air: Array, noise: Array
) -> tuple[float, Array]:
    """Log likelihood of all frames, and the probability (n,) of contact in each."""
    model = _Model.of(vibration, step, noise, np.abs(left).max(axis=0))
    measured, driven = (part[:, _CHANNELS] / model.noise for part in (left, air))
    contact = _touching(measured, model.correlation)
    size = np.linalg.norm(measured[:, _MOMENTS], axis=1)
    rate = min(_RATE * step, 0.5)
    switch, stay = np.log(rate), np.log1p(-rate)
    d = model.step.shape[0]
    free = _Free(np.empty(0, np.int64), np.empty((0, d)), np.empty((0, d, d)), np.empty(0))
    forward, history = np.empty(len(left)), []
    last = np.log(0.5)
    free = free.with_release(-1, size[0], last)
    for frame, (now, driven_now) in enumerate(zip(measured, driven, strict=True)):
        before = free.weight
        free = free.predicted(model)._replace(weight=before + stay)
        free = free.with_release(frame, size[frame], last + switch)
        free, found, onset = free.observed(model, now, driven_now)
        begins = switch + onset[:-1]
        starting = special.logsumexp(before + begins)
        forward[frame] = np.logaddexp(last + stay + contact[frame], starting)
        best = max(forward[frame], free.weight.max())
        some = np.argsort(free.weight)[-_MOST:]
        some = np.sort(some[free.weight[some] > best - _LOST])
        free, last = free.kept(some), forward[frame]
        history.append((free.since, found[some], begins, free.weight))
    whole = special.logsumexp(np.append(history[-1][-1], last))
    later, ahead = 0.0, np.zeros(len(history[-1][0]))
    log = forward - whole
    for frame in range(len(left) - 2, -1, -1):
        since, found, begins, _ = history[frame + 1]
        goes_on = dict(zip(since.tolist(), found + ahead, strict=True))
        released = switch + goes_on.get(frame + 1, -np.inf)
        still = [stay + goes_on.get(one, -np.inf) for one in history[frame][0].tolist()]
        ahead = np.logaddexp(still, begins + later)
        later = np.logaddexp(stay + contact[frame + 1] + later, released)
        log[frame] += later
    return float(whole), np.asarray(np.exp(np.minimum(log, 0.0)))
