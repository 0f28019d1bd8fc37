"""Sensor signals without the whisker's inertia and damping.

Frames are in contact if the motion of the base and free vibration do not explain the signals
(:class:`vibrissa.simulation.Vibration`). A whisker in contact that moves is bent differently from
one under the contact force alone, so that the correction is iterative. Just after an onset, the
bending lags behind the moment. Later, the contacts estimated with the current correction are
smoothed in the laboratory frame, where objects are at rest; a chain with mass and a massless one
are moved through them, and the difference of their wrenches
(:func:`vibrissa.simulation.inertial_wrench`) is the next correction. The uncertainty of the
correction is added to the noise.

The corrected wrench is that of a massless whisker through the same contact point. Its contact
force is not the true one: inertia between base and contact also bends the whisker there, and the
massless whisker needs a force to be bent alike. The difference of the chains' contact forces
therefore determines the direction of the true force, which is the normal of the object.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.contour import to_laboratory
from vibrissa.deferred import ndimage, signal
from vibrissa.numerics import Array, contacts_in
from vibrissa.pipeline.checks import one_whisker
from vibrissa.pipeline.frames import CHANGE, INERTIA
from vibrissa.pipeline.location import locate_from_wrench
from vibrissa.recording import Group, recorded
from vibrissa.simulation import Dynamics, Vibration, fit_dynamics, inertial_wrench
from vibrissa.status import Status
from vibrissa.whisker import Whisker

_ROUNDS = 2  # number of corrections
# Components Fx and Mx, along the whisker at its base.
_ALONG = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 0.0])
_SETTLED = 10e-3  # time after an onset over which the chain takes over from the lag model, s
_COLLISION = 4e-3  # time after an onset over which the chain's contact force settles, s
_KNOWN_TO = 0.2  # relative standard deviation of mass and damping
# Relative standard deviation of the stiffness, which lets the vibration frequency give the mass.
_STIFFNESS_KNOWN_TO = 0.1
# Standard deviation of the correction relative to the difference between the two models, and
# relative to the local root mean square of that difference and of the correction.
_APART, _LEFT = 0.3, 0.15
# Largest plausible contact force of the chain, relative to the largest measured force.
_SLIPS = 2.0
_MEMORY = 4e-3  # standard deviation of the window of that root mean square, s
_SMOOTH = 3e-3  # standard deviation of the window in which contact points are smoothed, s
_ONSET = 4e-3  # time constant by which the weight of contact points rises after an onset, s
_POINT = 1e-6  # smallest standard deviation of a contact point, m
_FEWEST = 8  # smallest number of frames with force and moment
_UNEQUAL = 1e-3  # largest range of frame intervals, relative to their mean
_LEAST = 4  # smallest number of usable frames of a contact for the chain


class _Trial(NamedTuple):
    """Measured wrench (n, 6) of a whisker, its covariance, and the motion of the base."""

    whisker: Whisker
    time: Array
    wrench: Array
    noise: Array
    rotation: Array
    position: Array
    touching: NDArray[np.bool_]

    @property
    def step(self) -> float:
        """Time between frames, s."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)


def without_inertia(
    own: Group, whisker: Whisker, dynamics: Dynamics | Literal["fitted"], noise: Array
) -> xr.Dataset:
    """Signals of one whisker without inertia and damping, which its attributes state."""
    trial, known = _trial(own, whisker, noise)
    course = trial.time, trial.wrench, trial.rotation, trial.position
    if dynamics == "fitted":
        dynamics = fit_dynamics(
            whisker, *course, noise, stiffness_sigma=_STIFFNESS_KNOWN_TO
        ).dynamics
    vibration = Vibration.of(whisker, dynamics)
    probability = vibration.contact_probability(*course, noise)
    trial = trial._replace(touching=probability > 0.5)
    removed = _removed(trial, dynamics, vibration)
    left = trial.wrench - removed.wrench
    left[~known] = np.nan
    touching = trial.touching & known
    status = np.where(touching, int(Status.OK), int(Status.NOT_FELT))
    status[~known] = int(Status.MISSING)
    values = {"force": left[:, :3], "moment": left[:, 3:], "in_contact": touching}
    values |= {"base_position": trial.position, "base_rotation": trial.rotation}
    of_wrench, of_change = _uncertainties(trial, removed, vibration)
    probability[~known] = np.nan
    more = {
        "contact_probability": probability,
        "wrench_covariance": trial.noise + of_wrench,
    }
    more |= dict(zip(CHANGE, (removed.change, of_change), strict=True))
    more |= dict(zip(INERTIA, removed.shared(), strict=True))
    about = {"density": dynamics.density, "damping_ratio": dynamics.damping_ratio}
    return (
        one_whisker(values, status)
        .assign({name: recorded(name, value) for name, value in more.items()})
        .assign_attrs(about)
    )


def _trial(own: Group, whisker: Whisker, noise: Array) -> tuple[_Trial, NDArray[np.bool_]]:
    """Trial with gaps in the wrench interpolated, and a mask of frames with a measured wrench."""
    time = np.asarray(own.data["time"].values, dtype=np.float64)
    rotation, position = own["base_rotation"], own["base_position"]
    wrench = np.concatenate([own["force"], own["moment"]], axis=1)
    known = np.isfinite(wrench).all(axis=1)
    posed = np.isfinite(rotation).all(axis=(1, 2)) & np.isfinite(position).all(axis=1)
    steps = np.diff(time)
    faults = []
    if known.sum() < _FEWEST:
        faults.append(f"{known.sum()} frames have force and moment; {_FEWEST} are needed")
    elif np.ptp(steps) > _UNEQUAL * steps.mean():
        faults.append(
            f"frames are {1e3 * steps.min():.3g} to {1e3 * steps.max():.3g} ms apart; equal "
            "spacing is needed"
        )
    if not posed.all():
        faults.append(f"the pose of the base is missing in {np.sum(~posed)} frames")
    if faults:
        raise ValueError(f"inertia cannot be removed: {'; '.join(faults)}")
    for column in wrench.T:
        column[~known] = np.interp(time[~known], time[known], column[known])
    return _Trial(whisker, time, wrench, noise, rotation, position, known), known


class _Removed(NamedTuple):
    """Inertia and damping: wrench (n, 6), and change (n, 3) of the contact force.

    ``apart`` (n, 6) is the difference between two models of the wrench, ``unsettled`` (n, 3) the
    change of the force in which the chain is not trusted yet. ``failed`` (n,) marks the frames
    without a result of the chain.
    """

    wrench: Array
    apart: Array
    change: Array
    unsettled: Array
    failed: NDArray[np.bool_]

    def shared(self) -> tuple[Array, Array]:
        """Changes (n, 2, 6) of the wrench and (n, 2, 3) of the contact force by shared errors.

        These are one standard deviation of mass and damping, and of the difference between the
        models; both are part of the covariances.
        """
        known = _KNOWN_TO * self.wrench, _KNOWN_TO * self.change
        return (
            np.stack([known[0], _APART * self.apart], axis=1),
            np.stack([known[1], np.zeros_like(known[1])], axis=1),
        )


def _removed(trial: _Trial, dynamics: Dynamics, vibration: Vibration) -> _Removed:
    """Wrench and contact force due to inertia and damping.

    The first model holds after an onset: bending lags behind the moment by the time constant of the
    damping, and only the inertia along the whisker reaches the base. Later a chain held at
    the contact points is more accurate.
    """
    along = vibration.in_air(trial.time, trial.rotation, trial.position) * _ALONG
    quick = trial.wrench - _lagged(trial.wrench - along, trial.step / vibration.damping)
    size = np.abs(trial.wrench).reshape(-1, 2, 3).max(axis=(0, 2)).repeat(3)
    most = float(np.linalg.norm(trial.wrench[:, :3], axis=1).max())
    since = np.full((len(quick), 1), np.inf)
    for first, end in contacts_in(trial.touching):
        since[first:end, 0] = trial.step * np.arange(end - first)
    added = quick
    for _ in range(_ROUNDS):
        points, arc_length = _smoothed(trial, trial.wrench - added, added)
        pose = trial.rotation, trial.position
        held, change = inertial_wrench(
            trial.whisker, dynamics, trial.time, *pose, points, arc_length, _SLIPS * most
        )
        apart = held - quick
        # A correction larger than the largest measured value means that the chain has failed.
        failed = (np.abs(apart) > size).any(axis=1)
        apart[failed], change[failed] = 0.0, 0.0
        added = quick - np.expm1(-((since / _SETTLED) ** 2)) * apart
    failed |= np.isnan(points[:, 0])
    unsettled = np.exp(-((since / _COLLISION) ** 2)) * change
    return _Removed(added, apart, change - unsettled, unsettled, failed)


def _lagged(values: Array, steps: float) -> Array:
    """Filter values (n, k) by a first-order lag whose time constant is 1 / ``steps`` samples."""
    old = np.exp(-steps)
    mean = (1.0 - old) / steps
    # Exact for values that change linearly between samples.
    start = (values[0] * old - values[0] * (mean - old))[None]
    return np.asarray(
        signal.lfilter([1.0 - mean, mean - old], [1.0, -old], values, axis=0, zi=start)[0]
    )


def _smoothed(trial: _Trial, left: Array, added: Array) -> tuple[Array, Array]:
    """Smoothed contact points (n, 3), laboratory frame, and arc lengths (n,); NaN elsewhere."""
    wrench = xr.Dataset(
        {"force": (("time", "space"), left[:, :3]), "moment": (("time", "space"), left[:, 3:])},
        {"time": trial.time},
    ).assign(in_contact=("time", trial.touching))
    covariance = trial.noise + _KNOWN_TO * np.einsum("ti,tj->tij", added, added)
    found = locate_from_wrench(trial.whisker, wrench, covariance)
    points = found["contact_point_whisker"].values
    points = to_laboratory(points, trial.rotation, trial.position)
    rows = np.column_stack([points, found["arc_length"].values])
    spread = np.einsum("tii->t", found["covariance"].values)
    usable = np.isfinite(rows).all(axis=1) & np.isfinite(spread)
    rows[~usable] = 0.0
    weight = np.where(usable, 1.0 / np.where(usable, spread + _POINT**2, 1.0), 0.0)
    out = np.full_like(rows, np.nan)
    for first, end in contacts_in(trial.touching):
        if usable[first:end].sum() < _LEAST:
            continue
        since = trial.step * (np.arange(end - first) + 0.5)
        rising = weight[first:end] * (1.0 - np.exp(-since / _ONSET)) ** 2
        out[first:end] = _local_quadratic(rows[first:end], rising, _SMOOTH / trial.step)
    return out[:, :3], out[:, 3]


def _local_quadratic(rows: Array, weight: Array, width: float) -> Array:
    """Smooth rows (n, k) by weighted local quadratics in Gaussian windows, ``width`` in rows."""
    number = np.arange(len(rows))
    out = np.empty_like(rows)
    # Weak regularisation: a window with too few data for a quadratic is fitted by a line.
    stiff = np.diag([0.0, 1e-3, 1e-2])
    for i in number:
        apart = (number - i) / width
        near = np.sqrt(weight * np.exp(-0.5 * apart**2))
        basis = np.vander(apart, 3, increasing=True) * near[:, None]
        basis = np.concatenate([basis, stiff * near.max()])
        values = np.concatenate([rows * near[:, None], np.zeros((3, rows.shape[1]))])
        out[i] = np.linalg.lstsq(basis, values, rcond=None)[0][0]
    return out


def _uncertainties(trial: _Trial, removed: _Removed, vibration: Vibration) -> tuple[Array, Array]:
    """Covariances (n, 6, 6) of the wrench removed and (n, 3, 3) of the change of the contact force.

    They grow with the correction and with the difference between its two models. They are as large
    as the wrench itself for about one radian of the first mode before a release, when no contact is
    in equilibrium, and for half as long after an onset; that of the change also where the chain
    failed.
    """
    near = np.zeros((len(removed.wrench), 1))
    for first, end in contacts_in(trial.touching):
        since = np.arange(1, end - first + 1)
        turned = trial.step * vibration.rates[0] * np.minimum(2 * since, since[::-1])
        near[first:end, 0] = np.exp(-turned)
    lost = np.where(removed.failed[:, None], 1.0, near)

    def covariance(known: Array, doubted: Array, of: Array, unknown: Array, share: float) -> Array:
        out = _KNOWN_TO**2 * np.einsum("ti,tj->tij", known, known)
        out += share**2 * np.einsum("ti,tj->tij", doubted, doubted)
        left, whole = (
            ndimage.gaussian_filter1d(
                part.reshape(len(part), -1, 3).mean(axis=2), _MEMORY / trial.step, axis=0
            )
            for part in (_LEFT**2 * (known**2 + doubted**2), of**2)
        )
        more = np.repeat(left + unknown**2 * whole, 3, axis=1)
        return np.asarray(out + more[:, :, None] * np.eye(more.shape[1]))

    return (
        covariance(removed.wrench, removed.apart, trial.wrench, near, _APART),
        covariance(removed.change, removed.unsettled, trial.wrench[:, :3], lost, 1.0),
    )
