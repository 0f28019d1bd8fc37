"""Mass, resonances and damping of a whisker from the wrench at its base while it is free.

The motion of the base gives the mass, ringing after a release or a tap the frequencies and the
damping. All windows in which nothing is touched are fitted at once: in each, free vibrations of an
unknown start are left out of M_y and M_z (:class:`vibrissa.simulation.Vibration`), and what the
model leaves besides the noise is a share of the window's own size. Three factors are fitted, of
mass, of frequency and of the time constant of the damping.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vibrissa.deferred import optimize
from vibrissa.numerics import AnyArray, Array
from vibrissa.simulation.dynamics import Dynamics
from vibrissa.simulation.vibration import Vibration
from vibrissa.whisker import Whisker

_LEAST_KNOWN = 0.3
"""Relative standard deviation from which a quantity is not determined."""

_WITHIN = np.log(3.0)
"""Largest factor that is tried, as a logarithm."""

_SHARE = 0.1
"""Share of a window's own size that linear modes do not explain."""

_STARTS = np.log([0.8, 0.9, 1.0, 1.1, 1.25])
"""Factors of the frequency that the fit is begun from, as logarithms."""

_QUANTITIES = {
    "mass": "the base must be moved",
    "resonances": "the whisker must ring, after a release or a tap",
    "damping": "the whisker must ring, after a release or a tap",
}
"""Quantities that are fitted, and what determines each."""


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
