"""Noise of a sensor, and the resulting covariance of signals and weights of a fit.

Noise is one standard deviation per signal, the same everywhere, or a covariance of force and
moment, as for a force/torque sensor; then a direction is noisier the smaller its force or moment
is.

Errors that all measurements share, of the whisker's stiffness and of the sensor's gain and mixing,
are added: a measured wrench is (F, M) + Σ ε E (F, M, 1), with matrices E (6, 7) and ε of standard
deviation 1, the same for all measurements (:mod:`vibrissa.sensors.sensor`). So
Σ E (F, M, 1) (F, M, 1)ᵀ Eᵀ is part of the covariance of each measurement, but averaging many does
not reduce it.

Weights whiten: with WᵀW = Σ⁻¹, the components of W times an error have variance one. A component
whose variance is zero counts as exact compared with the others. Directions in which the covariance
of the others is singular carry no information: a wrench obeys M · F = 0, and noise that obeys it
too has rank five.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from statistics import NormalDist
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import special, xr
from vibrissa.numerics import Array, numbers, relative
from vibrissa.quantities import attributes
from vibrissa.sensors import Sensor
from vibrissa.signals import SIGNALS, wrench_derivatives
from vibrissa.whisker import Whisker

#: Relative error of force and moment components, as a share of |F| and |M|, if no noise is stated.
TRUSTED = 0.01
_EXACT = 1e-6  # standard deviation, relative to the others, below which a component is exact
_SINGULAR = 1e-10  # eigenvalues of a correlation matrix below this are rounding
_RARE = 1e-3  # tail probability of χ² above which a measurement is explained
#: Difference of χ² below which contacts are indistinguishable (odds below 200 to 1).
INDISTINCT = NormalDist().inv_cdf(1.0 - 0.5 * _RARE) ** 2
#: Standard deviation of each signal, or covariance (6, 6) of (F, M), SI units.
Noise: TypeAlias = Mapping[str, float] | ArrayLike


# Force and moment, in EI/L² and EI/L, that stable contacts beyond 0.3 L do not reach; and noise, in
# the same units, below that of any sensor.
_LARGEST, _FAINTEST = {"F": 100.0, "M": 10.0}, 1e-8
_WIDEST = 1.0  # largest plausible standard deviation of a direction, rad
_NONE = np.zeros((0, 6, 7))


@dataclass(frozen=True, eq=False)
class SensorNoise:
    """Noise of a sensor; made by :meth:`of`."""

    deviations: dict[str, float] | None  # standard deviation of each signal, SI units; or
    wrench: Array | None  # (6, 6), covariance of (F, M), SI units
    errors: Array = field(default_factory=_NONE.copy)  # (n, 6, 7), as of `common_errors`

    @classmethod
    def of(
        cls,
        noise: Noise,
        names: tuple[str, ...],
        errors: Array = _NONE,
        whisker: Whisker | None = None,
    ) -> SensorNoise:
        """Read and check the noise of signals, and errors (n, 6, 7) that all measurements share.

        If the whisker is stated, noise that is far too large or small for it is questioned.
        """
        out = cls._read(noise, names, errors)
        if whisker is not None:
            _question(out, names, whisker)
        return out

    @classmethod
    def _read(cls, noise: Noise, names: tuple[str, ...], errors: Array) -> SensorNoise:
        if isinstance(noise, Mapping):
            known = SIGNALS if set(names) <= set(SIGNALS) else names
            if unknown := [repr(name) for name in noise if name not in known]:
                raise ValueError(
                    f"noise of {', '.join(unknown)} is unknown here; known are {', '.join(known)}"
                )
            missing = [name for name in names if name not in noise]
            if missing:
                raise ValueError(
                    f"noise lacks {', '.join(missing)}; it has {', '.join(noise) or 'none'}"
                )
            try:
                sigma = {name: float(numbers(name, noise[name])) for name in names}
            except (TypeError, ValueError) as error:
                given = {name: noise[name] for name in names}
                raise ValueError(f"noise must be standard deviations ≥ 0; got {given}") from error
            if not all(0.0 <= value < np.inf for value in sigma.values()):
                raise ValueError(f"noise must be standard deviations ≥ 0; got {sigma}")
            return cls(sigma, None, errors)
        try:
            wrench = numbers("noise", noise)
        except ValueError as error:
            raise ValueError(
                "noise must be {signal: standard deviation} or a symmetric 6 × 6 covariance of "
                f"(F, M); got {noise!r}"
            ) from error
        if wrench.shape != (6, 6):
            raise ValueError(
                "noise must be {signal: standard deviation} or a symmetric 6 × 6 covariance of "
                f"(F, M); got shape {wrench.shape}"
            )
        apart = ~np.isclose(wrench, wrench.T, rtol=1e-9, atol=0.0, equal_nan=True)
        if apart.any():
            i, j = np.argwhere(apart)[0]
            raise ValueError(
                f"a covariance is symmetric; the entries ({i}, {j}) and ({j}, {i}) are "
                f"{wrench[i, j]:g} and {wrench[j, i]:g}"
            )
        variances = np.diag(wrench)
        if not np.isfinite(wrench).all() or (variances < 0.0).any():
            raise ValueError(f"a covariance has finite variances ≥ 0; got {variances}")
        size = np.sqrt(np.where(variances > 0.0, variances, 1.0))
        least = np.linalg.eigvalsh(wrench / np.outer(size, size))[0]
        if least < -1e-9:
            raise ValueError(
                f"a covariance has no negative eigenvalue; that of its correlations is {least:.3g}"
            )
        return cls(None, wrench, errors)

    def covariance(self, names: tuple[str, ...], force: Array, moment: Array) -> Array:
        """Covariances (n, k, k) of signals of force and moment (n, 3), SI units.

        They are NaN where a direction has no meaning.
        """
        if self.wrench is None:
            assert self.deviations is not None
            sigma = np.array([self.deviations[name] for name in names])
            own = np.broadcast_to(np.diag(sigma**2), (len(force), len(names), len(names)))
            if not len(self.errors):
                return own
        g = wrench_derivatives(force, moment)[:, [SIGNALS.index(name) for name in names]]
        with np.errstate(invalid="ignore"):
            if self.wrench is not None:
                own = np.asarray(g @ self.wrench @ np.swapaxes(g, -1, -2))
            wrenches = np.concatenate([force, moment], axis=-1)
            out = own + common_covariance(self.errors, g, wrenches)
        out[~np.isfinite(out)] = np.nan
        return out


def common_errors(
    stiffness_sigma: float = 0.0,
    gain_sigma: float | ArrayLike = 0.0,
    mixing_sigma: float | ArrayLike = 0.0,
) -> Array:
    """Errors that all measurements of force and moment share."""
    for name, sigma, shape in (("gain", gain_sigma, (6,)), ("mixing", mixing_sigma, (6, 6))):
        given = relative(f"{name}_sigma", sigma) if np.size(sigma) <= 6 else np.asarray(sigma)
        if given.shape not in ((), shape) or not (np.isfinite(given) & (given >= 0.0)).all():
            raise ValueError(
                f"{name}_sigma is one standard deviation ≥ 0, or has shape {shape}; got {sigma!r}"
            )
    sensor = Sensor(gain_error=gain_sigma, mixing_error=mixing_sigma)
    return np.concatenate([by_stiffness(np.eye(6), stiffness_sigma), sensor.common_errors])


def by_stiffness(mixing: Array, sigma: float) -> Array:
    """Error of force and moment channels due to the whisker's stiffness."""
    relative("stiffness_sigma", sigma)
    out = np.zeros((1 if sigma > 0.0 else 0, len(mixing), 7))
    out[..., :6] = sigma * mixing
    return out


def scaled_errors(errors: Array, force: float, moment: float) -> Array:
    """Make errors (n, 6, 7) of wrenches non-dimensional, for these units of force and moment."""
    sizes = np.repeat([force, moment], 3)
    return np.ascontiguousarray(errors * np.append(sizes, 1.0) / sizes[:, None])


def common_channels(errors: Array, gradients: Array, wrenches: Array) -> Array:
    """Changes of channels due to errors of one standard deviation."""
    wrong = np.einsum("nac,mc->man", errors[..., :6], wrenches) + errors[..., 6].T
    return np.asarray(gradients @ wrong)


def common_covariance(errors: Array, gradients: Array, wrenches: Array) -> Array:
    """Covariance of channels due to shared errors."""
    changed = common_channels(errors, gradients, wrenches)
    return np.asarray(changed @ np.swapaxes(changed, -1, -2))


def sensor_noise(
    noise: Noise | None, names: tuple[str, ...], errors: Array, whisker: Whisker
) -> SensorNoise | None:
    """Read the noise of measurements of a whisker, if any is stated."""
    if noise is not None:
        return SensorNoise.of(noise, names, errors, whisker)
    if len(errors):
        raise ValueError(
            "the uncertainty of stiffness, gain and mixing adds to that of a sensor: give its noise"
        )
    return None


def _question(sensor: SensorNoise, names: tuple[str, ...], whisker: Whisker) -> None:
    """Warn of noise above all signals of this whisker, or below that of any sensor."""
    length, stiffness = whisker.length, whisker.base_bending_stiffness
    for name in names:
        kind, axes = name[0], {"T": "yz", "B": "yz", "D": ""}.get(name[1], name[1])
        if sensor.deviations is not None:
            sigma = sensor.deviations[name]
            if not axes and sigma > _WIDEST:
                warnings.warn(
                    f"the noise of {name}, an angle in rad, is {sigma:.2g}: is it in degrees?",
                    stacklevel=5,
                )
            sigma = sigma if axes else 0.0
        else:
            assert sensor.wrench is not None
            rows = [3 * "FM".index(kind) + "xyz".index(axis) for axis in axes]
            sigma = math.sqrt(max(np.diag(sensor.wrench)[rows], default=0.0))
        natural = stiffness / length ** (2 if kind == "F" else 1)
        if sigma > _LARGEST[kind] * natural:
            fault = "larger than all signals of this whisker"
        elif 0.0 < sigma < _FAINTEST * natural:
            fault = "smaller than any sensor's"
        else:
            continue
        warnings.warn(
            f"the noise of {name}, {sigma:.2g} {'N' if kind == 'F' else 'N·m'}, is {fault}: is it "
            "in another unit (N and N·m in Python, µN and µN·m on the command line), or a variance "
            "in place of a standard deviation or the reverse? A signal that is not measured is "
            "better left out.",
            stacklevel=5,
        )
        return


def ellipsoids(covariance: Array, dims: tuple[str, ...], shape: tuple[int, ...]) -> xr.Dataset:
    """Covariances with the ellipsoids of one standard deviation, labelled.

    Parameters
    ----------
    covariance : (n, 3, 3) array
        Covariances of contact points, m².
    dims : tuple of str
        Names of the leading dimensions.
    shape : tuple of int
        Sizes of them, n in all.

    Returns
    -------
    Dataset
        ``covariance``, ``semi_axes``, ``axis_directions`` and ``predicted_error``.
    """
    n = len(covariance)
    sizes, directions = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
    known = np.isfinite(covariance).all(axis=(1, 2))
    squares, columns = np.linalg.eigh(covariance[known])
    sizes[known] = np.sqrt(np.maximum(squares[:, ::-1], 0.0))
    directions[known] = columns[:, :, ::-1]
    return xr.Dataset(
        {
            "covariance": (
                (*dims, "space", "space_2"),
                covariance.reshape(*shape, 3, 3),
                attributes("covariance"),
            ),
            "semi_axes": (
                (*dims, "axis"),
                sizes.reshape(*shape, 3),
                {"units": "m", "long_name": "semi-axes of the error ellipsoid, one sigma"},
            ),
            "axis_directions": (
                (*dims, "space", "axis"),
                directions.reshape(*shape, 3, 3),
                {"units": "1", "long_name": "unit vectors along the semi-axes"},
            ),
            "predicted_error": (
                dims,
                rms_error(covariance).reshape(shape),
                attributes("predicted_error"),
            ),
        },
        {"space": ["x", "y", "z"], "space_2": ["x", "y", "z"], "axis": [1, 2, 3]},
    )


def rms_error(covariance: Array) -> Array:
    """Root mean square distance that covariances predict."""
    return np.asarray(np.sqrt(np.trace(covariance, axis1=-2, axis2=-1)))


def trusted(wrenches: Array) -> Array:
    """Covariances (n, 6, 6) of wrenches (n, 6) for errors in proportion to |F| and |M|."""
    force, moment = (np.linalg.norm(part, axis=1) for part in (wrenches[:, :3], wrenches[:, 3:]))
    out = np.zeros((len(wrenches), 6, 6))
    for i in range(6):
        out[:, i, i] = (TRUSTED * (force if i < 3 else moment)) ** 2
    return out


def whitening(covariance: Array) -> Array:
    """Weights W with WᵀW = Σ⁻¹, see the module; zero where Σ is not finite."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    noisy = variance > 0.0
    size = np.sqrt(np.where(noisy, variance, 1.0))
    typical = np.log(size).sum(axis=-1, keepdims=True) / np.maximum(
        noisy.sum(axis=-1, keepdims=True), 1
    )
    size = np.where(noisy, size, _EXACT * np.exp(typical))
    with np.errstate(all="ignore"):
        correlation = covariance / (size[..., :, None] * size[..., None, :])
    k = covariance.shape[-1]
    exact = (variance == 0.0)[..., None] & np.eye(k, dtype=bool)
    correlation = np.where(exact, 1.0, correlation)
    usable = np.asarray(np.isfinite(correlation).all(axis=(-2, -1)))[..., None, None]
    values, vectors = np.linalg.eigh(np.where(usable, correlation, np.eye(k)))
    root = np.where(values > _SINGULAR, 1.0 / np.sqrt(np.maximum(values, _SINGULAR)), 0.0)
    weights = root[..., :, None] * np.swapaxes(vectors, -1, -2) / size[..., None, :]
    return np.where(usable, weights, 0.0)


def rank(covariance: Array) -> int:
    """Number of independent values of a measurement with this covariance (k, k)."""
    weights = whitening(covariance)
    return int((np.abs(weights).max(axis=-1) > 0.0).sum())


@cache
def explained(degrees: int) -> float:
    """Largest χ² of a measurement that counts as explained, for so many degrees of freedom."""
    return INDISTINCT if degrees <= 1 else float(special.chdtri(degrees, _RARE))
