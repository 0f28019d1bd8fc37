"""What the noise of a sensor does to the signals, and to the contact point found from them.

Noise is told as one standard deviation a signal, the same everywhere, or as a covariance of force
and moment, as a force/torque sensor has it: then a direction is the noisier the smaller the force
or moment that it belongs to.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.quantities import attributes
from vibrissa.rod.arrays import Array
from vibrissa.signals import SIGNALS
from vibrissa.signals.base import wrench_derivatives

#: Standard deviation of each signal, or covariance (6, 6) of (F, M), SI units.
Noise: TypeAlias = Mapping[str, float] | ArrayLike


@dataclass(frozen=True, eq=False)
class SensorNoise:
    """Noise of a sensor; made by :meth:`of`.

    Attributes
    ----------
    deviations : dict of str to float, or None
        Standard deviation of each signal.
    wrench : (6, 6) array or None
        Covariance of (F, M).
    stiffness : float
        Relative standard deviation of the whisker's bending stiffness, to which all forces and
        moments are proportional: of E r⁴, so √(σ_E² + 16 σ_r²) of those of modulus and radius. It
        is the same error in every measurement.
    """

    deviations: dict[str, float] | None
    wrench: Array | None
    stiffness: float = 0.0

    @classmethod
    def of(cls, noise: Noise, names: tuple[str, ...], stiffness: float = 0.0) -> SensorNoise:
        """Read noise and check it.

        Parameters
        ----------
        noise : mapping or (6, 6) array_like
            Standard deviation of each signal, or covariance of (F, M), SI units.
        names : tuple of str
            The signals, or components of force and moment, that a mapping must have.
        stiffness : float
            Relative standard deviation of the whisker's bending stiffness.

        Returns
        -------
        SensorNoise
            The noise.

        Raises
        ------
        ValueError
            If it lacks a signal, or is no covariance.
        """
        if not 0.0 <= stiffness < np.inf:
            raise ValueError(
                f"the stiffness's relative standard deviation is not negative; got {stiffness}"
            )
        if isinstance(noise, Mapping):
            missing = [name for name in names if name not in noise]
            if missing:
                raise ValueError(
                    f"noise lacks {', '.join(missing)}; it has {', '.join(noise) or 'none'}"
                )
            try:
                sigma = {name: float(noise[name]) for name in names}
            except (TypeError, ValueError) as error:
                given = {name: noise[name] for name in names}
                raise ValueError(f"noise must be standard deviations ≥ 0; got {given}") from error
            if not all(0.0 <= value < np.inf for value in sigma.values()):
                raise ValueError(f"noise must be standard deviations ≥ 0; got {sigma}")
            return cls(sigma, None, float(stiffness))
        try:
            wrench = np.asarray(noise, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(
                "noise must be {signal: standard deviation} or a symmetric 6 × 6 covariance of "
                f"(F, M); got {noise!r}"
            ) from error
        if wrench.shape != (6, 6) or not np.allclose(wrench, wrench.T, rtol=1e-9, atol=0.0):
            raise ValueError(
                "noise must be {signal: standard deviation} or a symmetric 6 × 6 covariance of "
                f"(F, M); got shape {wrench.shape}"
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
        return cls(None, wrench, float(stiffness))

    def covariance(self, names: tuple[str, ...], force: Array, moment: Array) -> Array:
        """Covariance of signals.

        Parameters
        ----------
        names : tuple of str
            The k signals.
        force, moment : (n, 3) arrays
            At the base, N and N·m.

        Returns
        -------
        (n, k, k) array
            In SI units; NaN for a direction of what is zero, if it follows from force and moment.
        """
        if self.wrench is None:
            assert self.deviations is not None
            sigma = np.array([self.deviations[name] for name in names])
            own = np.broadcast_to(np.diag(sigma**2), (len(force), len(names), len(names)))
            if self.stiffness == 0.0:
                return own
        g = wrench_derivatives(force, moment)[:, [SIGNALS.index(name) for name in names]]
        with np.errstate(invalid="ignore"):
            if self.wrench is not None:
                own = np.asarray(g @ self.wrench @ np.swapaxes(g, -1, -2))
            out = own + self.common(g, np.concatenate([force, moment], axis=-1))
        out[~np.isfinite(out)] = np.nan
        return out

    def common(self, gradients: Array, wrenches: Array) -> Array:
        """Covariance that the uncertainty of the stiffness adds to channels.

        Parameters
        ----------
        gradients : (n, k, 6) array
            ∂(channels)/∂(F, M).
        wrenches : (n, 6) array
            (F, M), in the same units.

        Returns
        -------
        (n, k, k) array
            Of rank one: all channels grow together.
        """
        grown = self.stiffness * np.einsum("nki,ni->nk", gradients, wrenches)
        return np.asarray(grown[:, :, None] * grown[:, None, :])


def sensor_noise(
    noise: Noise | None, names: tuple[str, ...], stiffness: float = 0.0
) -> SensorNoise | None:
    """Read noise if there is any.

    Parameters
    ----------
    noise : mapping, (6, 6) array_like or None
        As for :meth:`SensorNoise.of`.
    names : tuple of str
        The signals.
    stiffness : float
        Relative standard deviation of the whisker's bending stiffness.

    Returns
    -------
    SensorNoise or None
        None for none.

    Raises
    ------
    ValueError
        If the noise does not fit, or the stiffness is uncertain but no noise is known.
    """
    if noise is not None:
        return SensorNoise.of(noise, names, stiffness)
    if stiffness != 0.0:
        raise ValueError(
            "the uncertainty of the stiffness adds to that of a sensor: give its noise"
        )
    return None


def ellipsoids(covariance: Array, dims: tuple[str, ...], shape: tuple[int, ...]) -> xr.Dataset:
    """Covariances (n, 3, 3), m², with the ellipsoids of one standard deviation, labelled."""
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
    """RMS 3D error of covariances (..., 3, 3), shape (...)."""
    return np.asarray(np.sqrt(np.trace(covariance, axis1=-2, axis2=-1)))
