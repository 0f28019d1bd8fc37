"""Frame of a sensor relative to the whisker (axes, handedness, origin, sign) and its calibration.

With the sensor's axes as the columns of Q, in the whisker's frame, and its origin at o,

    x = Q x_s + o,    F = σ Q F_s,    M = σ det(Q) Q M_s + o × F,

where σ = -1 for a sensor that reports its own force on the whisker instead of that of the object on
the whisker. Left-handed axes have det Q = -1, and their moments follow the left-hand rule:
M_s = x_s × F_s in the sensor's coordinates.

Known loads determine the frame. Forces give P = σQ as the best-fitting rotation or reflection;
moments then transform by P or -P, which separates handedness from sign; the remaining part of the
moments gives the origin. Finally, all six unknowns are fitted together.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import optimize, transform
from vibrissa.numerics import Array, cross_matrix, numbers
from vibrissa.sensors.regression import solve, warn_of_misfit

_ORTHOGONAL = 1e-3  # largest deviation from orthonormal axes, as of rounded digits, to be corrected


@dataclass(frozen=True, eq=False)
class SensorFrame:
    """Frame of a sensor relative to the whisker frame at its base.

    Parameters
    ----------
    axes : array_like (3, 3) or sequence of str
        Axes of the sensor as columns, in the whisker frame; or the directions of its x, y and z
        as signed names: ``("x", "-z", "y")``. Left-handed axes are allowed.
    position : array_like (3,)
        Reference point of the sensor's moments, whisker frame, m.
    reaction : bool
        Whether the sensor reports the force that it exerts on the whisker instead of that on
        itself: all six components then have the opposite sign.

    Examples
    --------
    >>> SensorFrame(("x", "-y", "z")).handedness
    -1
    """

    axes: Any = ("x", "y", "z")
    position: Any = (0.0, 0.0, 0.0)
    reaction: bool = False

    def __post_init__(self) -> None:
        """Validate the fields, and make the axes exactly orthonormal."""
        axes = _axes(self.axes)
        position = numbers("position", self.position)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise ValueError(f"a sensor's position is three numbers, m; got {self.position!r}")
        object.__setattr__(self, "axes", axes)
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "reaction", bool(self.reaction))

    @property
    def handedness(self) -> int:
        """Sign of the handedness of the axes: 1 for right-handed, -1 for left-handed."""
        return 1 if np.linalg.det(self.axes) > 0.0 else -1

    def to_base(self) -> Array:
        """Matrix from the sensor's (F, M) to (F, M) at the whisker's base.

        Returns
        -------
        array (6, 6)
            Matrix, SI units.
        """
        sign = -1.0 if self.reaction else 1.0
        force = sign * self.axes
        out = np.zeros((6, 6))
        out[:3, :3], out[3:, 3:] = force, self.handedness * force
        out[3:, :3] = cross_matrix(self.position) @ force
        return out

    def from_base(self) -> Array:
        """Matrix from (F, M) at the whisker's base to the sensor's.

        Returns
        -------
        array (6, 6)
            Matrix, SI units.
        """
        return np.asarray(np.linalg.inv(self.to_base()))


def _axes(value: Any) -> Array:
    """Orthonormal axes (3, 3) from numbers or names."""
    if isinstance(value, str):
        value = value.replace(",", " ").split()
    if isinstance(value, Sequence) and all(isinstance(name, str) for name in value):
        return _named_axes(value)
    axes = numbers("axes", value)
    if axes.shape != (3, 3) or not np.isfinite(axes).all():
        raise ValueError(f"a sensor's axes are three columns of three numbers; got {value!r}")
    u, size, v = np.linalg.svd(axes)
    if np.abs(size - 1.0).max() > _ORTHOGONAL:
        raise ValueError(
            "a sensor's axes are of unit length and at right angles to each other; the stretches "
            f"of these are {', '.join(f'{s:.4g}' for s in size)}, not 1"
        )
    return np.asarray(u @ v)


def _named_axes(names: Sequence[str]) -> Array:
    """Axes (3, 3) from signed names."""
    axes = np.zeros((3, 3))
    letters = [name.lstrip("+-") for name in names]
    if sorted(letters) != ["x", "y", "z"]:
        raise ValueError(
            f"a sensor's axes by name are x, y and z once each, with signs; got {list(names)!r}"
        )
    for column, (name, letter) in enumerate(zip(names, letters, strict=True)):
        axes["xyz".index(letter), column] = -1.0 if name.startswith("-") else 1.0
    return axes


_ADVICE = "apply forces in at least two directions, at two points or more"
_MISFIT = 5.0  # smallest ratio of the residuals of moments to the noise that it does not explain
_CLEARLY = 2.0  # smallest ratio of the residuals of the two signs of moments that decides
# Ratio of the shares of moments along forces below which these are loads, and the others readings.
_LOADS = 0.1
_GAIN = 2.0  # largest ratio of measured forces to loads without an error of units or offset
# Relative spreads of forces below which these are on one line, or in one plane.
_ALONG, _FLAT = 1e-4, 1e-6


@dataclass(frozen=True, eq=False)
class FrameCalibration:
    """Frame of a sensor, calibrated by known loads.

    Attributes
    ----------
    frame : SensorFrame
        Frame of the sensor.
    covariance : (6, 6) array
        Covariance of a small rotation of the axes (about x, y, z of the whisker frame, rad) and
        of the origin (m).
    force_residual, moment_residual : float
        Root mean square residuals of components, N and N·m.
    misfit : float
        χ² per degree of freedom: near 1, unless noise, loads or gain are not as stated; if it is
        above 1, the covariance is multiplied by it.
    """

    frame: SensorFrame
    covariance: Array
    force_residual: float
    moment_residual: float
    misfit: float


def component_noise(force_noise: float, moment_noise: float) -> Array:
    """Covariance (6, 6) of (F, M) with independent noise of equal size in force and in moment."""
    for name, value in (("force_noise", force_noise), ("moment_noise", moment_noise)):
        given = numbers(name, value)
        if given.ndim or not (np.isfinite(given) and given >= 0.0):
            raise ValueError(f"{name} must be one finite number, not negative; got {value!r}")
    return np.diag(np.repeat([force_noise**2, moment_noise**2], 3))


def calibrate_frame(
    readings: ArrayLike, wrenches: ArrayLike, *, force_noise: float, moment_noise: float
) -> FrameCalibration:
    """Fit the frame of a six-component sensor to known loads.

    Parameters
    ----------
    readings : array_like (n, 6)
        Readings (F, M) in the sensor's frame, without offset, N and N·m.
    wrenches : array_like (n, 6)
        Loads (F, M) at the whisker's base, whisker frame, N and N·m.
    force_noise, moment_noise : float
        Standard deviations of the readings' components, N and N·m.

    Returns
    -------
    FrameCalibration
        Frame with its uncertainty.

    Raises
    ------
    ValueError
        If shapes or units do not match, or the loads do not determine the frame.

    Warns
    -----
    UserWarning
        If residuals are more than five times the noise or less than a hundredth of it, or loads and
        readings seem to be exchanged.
    """
    read, true = numbers("readings", readings), numbers("wrenches", wrenches)
    if read.ndim != 2 or read.shape[1:] != (6,) or read.shape != true.shape:
        raise ValueError(f"readings and wrenches (n, 6) are needed; got {read.shape}, {true.shape}")
    noise = np.sqrt(np.diag(component_noise(force_noise, moment_noise)))
    if not noise.all():
        raise ValueError(f"noises are positive; got {force_noise} N and {moment_noise} N·m")
    known = np.isfinite(read).all(axis=1) & np.isfinite(true).all(axis=1)
    read, true = read[known], true[known]
    _check_units(read, true)
    _check_order(read, true)
    force = _matched(read[:, :3], true[:, :3])
    options = [_placed(read, true, force, hand) for hand in (1, -1)]
    left = [option[1] for option in options]
    if max(left) < _CLEARLY * max(min(left), moment_noise):
        if min(left) > _MISFIT * moment_noise:
            raise ValueError(
                "the moments fit neither a right-handed sensor nor a left-handed one (residuals "
                f"of {min(left) / moment_noise:.0f} times the noise): check the order of rows and "
                "columns of loads and readings, and that all moments are in N·m"
            )
        raise ValueError(
            "the moments fit a right-handed sensor as well as a left-handed one: " + _ADVICE
        )
    hand = 1 if left[0] < left[1] else -1
    position = options[0 if hand == 1 else 1][0]
    sign = hand * round(float(np.linalg.det(force)))

    def frame(unknowns: Array) -> SensorFrame:
        turn = transform.Rotation.from_rotvec(unknowns[:3]).as_matrix()
        return SensorFrame(turn @ (sign * force), unknowns[3:], reaction=sign < 0)

    def residuals(unknowns: Array) -> Array:
        return np.asarray(((read - true @ frame(unknowns).from_base().T) / noise).ravel())

    # Typical lever arm, by which rotations and positions have comparable scales.
    scale = max(float(np.linalg.norm(position)), moment_noise / force_noise)
    fit = optimize.least_squares(
        residuals,
        np.concatenate([np.zeros(3), position]),
        x_scale=[1.0] * 3 + [scale] * 3,
        method="lm",
    )
    misfit = float((fit.fun**2).sum() / max(fit.fun.size - 6, 1))
    warn_of_misfit(
        misfit,
        "the loads and where they pull, their signs, offset and units, and the sensor's gain and "
        "cross-talk (`calibrate_mixing` fits these)",
    )
    rows = fit.fun.reshape(-1, 6) * noise
    jacobian = np.asarray(fit.jac, dtype=np.float64)
    spread = np.asarray(max(1.0, misfit) * np.linalg.inv(jacobian.T @ jacobian))
    return FrameCalibration(
        frame(fit.x),
        spread,
        float(np.sqrt((rows[:, :3] ** 2).mean())),
        float(np.sqrt((rows[:, 3:] ** 2).mean())),
        misfit,
    )


def _check_units(read: Array, true: Array) -> None:
    """Raise ValueError if forces and loads differ in size, which a frame cannot cause."""
    loads = float(np.linalg.norm(true[:, :3]))
    gain = float(np.linalg.norm(read[:, :3])) / loads if loads > 0.0 else 1.0
    if not 1.0 / _GAIN < gain < _GAIN:
        raise ValueError(
            f"the measured forces are {gain:.3g} times the loads: readings are needed in N and "
            "N·m, without offset"
        )


def _check_order(read: Array, true: Array) -> None:
    """Warn if the readings are those of exact forces at points, as only known loads are.

    The moment of a force has no component along it, in any frame; noise adds one.
    """
    along = [np.linalg.norm((wrench[:, :3] * wrench[:, 3:]).sum(axis=1)) for wrench in (read, true)]
    if along[0] < _LOADS * along[1]:
        warnings.warn(
            "the readings have smaller moments along their forces than the known loads, which have "
            "no noise: are `readings` and `wrenches` exchanged?",
            stacklevel=3,
        )


def _matched(read: Array, true: Array) -> Array:
    """Rotation or reflection P that minimises |P read − true|."""
    u, size, v = np.linalg.svd(true.T @ read)
    if not size[0] > 0.0 or size[1] < _ALONG * size[0]:
        raise ValueError(
            "all forces are along one line, so the rotation about it is not determined: " + _ADVICE
        )
    if size[2] < _FLAT * size[0]:
        raise ValueError(
            "all forces are in one plane, so the axes' handedness is not determined: apply forces "
            "in three directions"
        )
    return np.asarray(u @ v)


def _placed(read: Array, true: Array, force: Array, hand: int) -> tuple[Array, float]:
    """Origin, and root mean square residual of the moments if these transform by ``hand`` × P."""
    arms = -cross_matrix(true[:, :3]).reshape(-1, 3)  # o × F = -F × o
    rest = (true[:, 3:] - hand * read[:, 3:] @ force.T).reshape(-1)
    size = np.abs(arms).max()
    origin = solve(arms / size, rest / size, ("x", "y", "z of the origin"), _ADVICE)
    return origin.unknowns, float(np.sqrt((origin.residuals**2).mean()) * size)
