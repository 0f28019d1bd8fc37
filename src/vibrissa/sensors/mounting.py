"""How a sensor sits at the whisker, from known loads: axes, handedness, sign and origin.

Forces give P = σQ, by the rotation or reflection that fits them best; moments then follow P or -P,
which tells a left hand or a reaction from their opposites; and what is left of the moments gives
the origin. All six unknowns of a frame are then fitted together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from vibrissa.sensors.frame import SensorFrame, cross_matrix
from vibrissa.sensors.linear import solve
from vibrissa.sensors.misfit import warn_of_misfit

Array = NDArray[np.float64]

_ADVICE = "apply forces in at least two directions, at two places or more"
# Of two readings of the moments' sign the better must be this much better.
_CLEARLY = 2.0
# Forces so many times the loads are in another unit, or have an offset.
_GAIN = 2.0


@dataclass(frozen=True, eq=False)
class FrameCalibration:
    """A sensor's frame as known loads tell it.

    Attributes
    ----------
    frame : SensorFrame
        The frame.
    covariance : (6, 6) array
        Of a small rotation of the axes (about x, y, z of the whisker's frame, rad) and of the
        origin (m).
    force_residual, moment_residual : float
        RMS of what is left of a component, N and N·m.
    misfit : float
        χ² over its degrees of freedom: near 1, unless noise, loads or gain are not as stated.
    """

    frame: SensorFrame
    covariance: Array
    force_residual: float
    moment_residual: float
    misfit: float


def calibrate_frame(
    readings: ArrayLike,
    wrenches: ArrayLike,
    *,
    force_noise: float,
    moment_noise: float,
) -> FrameCalibration:
    """Find how a six-component sensor sits at the whisker from known loads.

    Parameters
    ----------
    readings : array_like (n, 6)
        (F, M) in the sensor's frame, offset taken away, N and N·m.
    wrenches : array_like (n, 6)
        The loads: (F, M) at the whisker's base, whisker's frame.
    force_noise, moment_noise : float
        Standard deviations of the readings' components, N and N·m.

    Returns
    -------
    FrameCalibration
        The frame, with its uncertainty.

    Raises
    ------
    ValueError
        If shapes do not fit, readings are in other units, or the loads do not determine the frame.

    Warns
    -----
    UserWarning
        If residuals are more than five times the noise.
    """
    seen, true = np.asarray(readings, dtype=np.float64), np.asarray(wrenches, dtype=np.float64)
    if seen.ndim != 2 or seen.shape[1:] != (6,) or seen.shape != true.shape:
        raise ValueError(f"readings and wrenches (n, 6) are needed; got {seen.shape}, {true.shape}")
    if not (force_noise > 0.0 and moment_noise > 0.0):
        raise ValueError(f"noises are positive; got {force_noise} N and {moment_noise} N·m")
    known = np.isfinite(seen).all(axis=1) & np.isfinite(true).all(axis=1)
    seen, true = seen[known], true[known]
    _check_units(seen, true)
    force = _matched(seen[:, :3], true[:, :3])
    options = [_placed(seen, true, force, hand) for hand in (1, -1)]
    left = [option[1] for option in options]
    if max(left) < _CLEARLY * max(min(left), moment_noise):
        raise ValueError(
            "the moments fit a right-handed sensor as well as a left-handed one: " + _ADVICE
        )
    hand = 1 if left[0] < left[1] else -1
    position = options[0 if hand == 1 else 1][0]
    sign = hand * round(float(np.linalg.det(force)))
    noise = np.repeat([force_noise, moment_noise], 3)

    def frame(unknowns: Array) -> SensorFrame:
        turn = Rotation.from_rotvec(unknowns[:3]).as_matrix()
        return SensorFrame(turn @ (sign * force), unknowns[3:], reaction=sign < 0)

    def residuals(unknowns: Array) -> Array:
        return np.asarray(((seen - true @ frame(unknowns).from_base().T) / noise).ravel())

    # The lever arm's scale, so that both kinds of unknowns count alike.
    scale = max(float(np.linalg.norm(position)), moment_noise / force_noise)
    found = least_squares(
        residuals,
        np.concatenate([np.zeros(3), position]),
        x_scale=[1.0] * 3 + [scale] * 3,
        method="lm",
    )
    misfit = float((found.fun**2).sum() / max(found.fun.size - 6, 1))
    warn_of_misfit(misfit, "the loads and where they pull, their signs, offset and units")
    rows = found.fun.reshape(-1, 6) * noise
    jacobian = np.asarray(found.jac, dtype=np.float64)
    spread = np.asarray(np.linalg.inv(jacobian.T @ jacobian), dtype=np.float64)
    return FrameCalibration(
        frame(found.x),
        spread,
        float(np.sqrt((rows[:, :3] ** 2).mean())),
        float(np.sqrt((rows[:, 3:] ** 2).mean())),
        misfit,
    )


def _check_units(seen: Array, true: Array) -> None:
    """Refuse forces of another size than the loads: a frame turns, and does not stretch."""
    loads = float(np.linalg.norm(true[:, :3]))
    gain = float(np.linalg.norm(seen[:, :3])) / loads if loads > 0.0 else 1.0
    if not 1.0 / _GAIN < gain < _GAIN:
        raise ValueError(
            f"the forces read are {gain:.3g} times the loads: readings are needed in N and N·m, "
            "with the offset taken away"
        )


def _matched(seen: Array, true: Array) -> Array:
    """The rotation or reflection P for which P seen comes nearest to true."""
    u, size, v = np.linalg.svd(true.T @ seen)
    if not size[0] > 0.0 or size[1] < 1e-4 * size[0]:
        raise ValueError("all forces lie along one line, so the turn about it is open: " + _ADVICE)
    if size[2] < 1e-6 * size[0]:
        raise ValueError(
            "all forces lie in one plane, so a left hand cannot be told from a right hand: apply "
            "forces in three directions"
        )
    return np.asarray(u @ v)


def _placed(seen: Array, true: Array, force: Array, hand: int) -> tuple[Array, float]:
    """Origin and RMS of what is left of the moments, for moments that follow ±P."""
    arms = -cross_matrix(true[:, :3]).reshape(-1, 3)  # o × F = -F × o
    rest = (true[:, 3:] - hand * seen[:, 3:] @ force.T).reshape(-1)
    size = np.abs(arms).max()
    found = solve(arms / size, rest / size, ("x", "y", "z of the origin"), _ADVICE)
    return found.unknowns, float(np.sqrt((found.residuals**2).mean()) * size)
