"""Base signals of every frame of a recording, from one of three sources.

**Contact point** (the paper's method): the contact point tracked in the laboratory frame is
expressed in the frame of the whisker's base, whose pose is filtered without phase shift; force and
moment are those of the frictionless rod through this point (`vibrissa.deflect`). A status marks
frames whose point the rod cannot reach. Contact points given to the tracker in a table take
precedence over those it found. The covariance of the wrench follows from those of the point and of
the pose; the latter includes the typical difference from the pose of the fitted rod, if known.

**Rod**: force and moment of the rod fitted to the images of the whisker, with their covariance.

**Sensor**: force and moment as measured, in a simulated or robotic recording, or computed from the
readings of other channels if these determine force and moment (six or more channels).

The contributions of the whisker's inertia and damping can be removed from sensor signals. Frames
are in contact if the motion of the base and free vibration do not explain the signals
(:class:`vibrissa.simulation.Vibration`). A whisker in contact that moves is bent differently from
one under the contact force alone, so that the correction is iterative. Just after an onset, the
bending lags behind the moment. Later, the contacts estimated with the current correction are
smoothed in the laboratory frame, where objects are at rest; a chain with mass and a massless one
are moved through them, and the difference of their wrenches
(:func:`vibrissa.simulation.chain.inertial_wrench`) is the next correction. The uncertainty of the
correction is added to the noise.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.contour import to_laboratory
from vibrissa.deferred import ndimage, signal, transform
from vibrissa.numerics import Array, contacts_in, cross_matrix
from vibrissa.pipeline.checks import (
    SQUARES,
    check_recording,
    names_of,
    needed,
    one_whisker,
    with_coordinates,
)
from vibrissa.pipeline.location import locate_from_wrench
from vibrissa.pipeline.touch_gains import wrench_slopes
from vibrissa.recording import Group, Recording, recorded
from vibrissa.rod import PROXIMAL, PointContact, deflect
from vibrissa.sensors import FORCE_NOISE, MOMENT_NOISE, Sensor, component_noise
from vibrissa.signals import DETECTED
from vibrissa.simulation import Dynamics, Vibration, fit_dynamics, inertial_wrench
from vibrissa.status import Status
from vibrissa.tracking import CUTOFF, BasePose, HeadPose, pieces
from vibrissa.whisker import Whisker, angles_of

Source = Literal["contact point", "rod", "sensor"]  # source of signals
# Fill values, other than NaN, in frames without signals.
_FILL_VALUES = {"in_contact": (False,), "status": (np.int8(Status.MISSING),)}


def signals_of(
    recording: xr.DataTree,
    source: Source | None = None,
    cutoff: float | None = CUTOFF,
    *,
    whiskers: Sequence[Whisker] | None = None,
    proximal: float = PROXIMAL,
    dynamics: Dynamics | Literal["fitted"] | None = None,
) -> xr.Dataset:
    """Force, moment and the six signals of every frame and whisker.

    Parameters
    ----------
    recording : xarray.DataTree
        Tracked, simulated or measured recording.
    source : {"contact point", "rod", "sensor"}, optional
        Source of the signals; by default the result of `default_source`.
    cutoff : float, optional
        Cut-off frequency of the low-pass filter of the base pose for the source "contact point",
        Hz; None disables filtering. The other sources use the pose of the recording.
    whiskers : sequence of Whisker, optional
        Whiskers along the dimension ``whisker``; by default those of the recording. They are used
        by the source "contact point" and to remove inertia.
    proximal : float
        Smallest arc length of a contact with signals, as a share of the whisker's length; contacts
        nearer to the base only have a status. Source "contact point" only.
    dynamics : Dynamics or "fitted", optional
        Density and damping, known to 20 %, of whiskers whose inertia is removed from sensor
        signals, or "fitted" to fit them to this recording (`vibrissa.simulation.fit_dynamics`). The
        motion of the base must be smooth. By default inertia is not removed.

    Returns
    -------
    xarray.Dataset
        Group ``signals`` of a recording, dimensions time, whisker, space: ``force``, ``moment`` and
        ``Fx`` … ``MD``, whisker frame, zero without contact; ``base_position`` and
        ``base_rotation``, the pose to which they refer; ``in_contact`` (for a sensor of known
        noise: M_B above five standard deviations), ``status``, and, if known,
        ``wrench_covariance`` and the covariances of the pose. Attributes: ``source``, ``cutoff``
        and, for a sensor, ``noise``, the standard deviations of (F, M).

    Raises
    ------
    ValueError
        If the recording lacks variables that the source needs, the cut-off is not below half the
        frame rate, or inertia is to be removed from a trial that was simulated without it.
    """
    check_recording(recording)
    chosen = default_source(recording) if source is None else source
    if chosen not in get_args(Source):
        raise ValueError(f"source is {chosen!r}; one of {', '.join(get_args(Source))} is needed")
    known_trial = Recording(recording)
    root = known_trial.root.data
    if chosen == "sensor":
        if dynamics is not None and "quasi-static" in str(recording.attrs.get("origin")):
            raise ValueError(
                "this trial was simulated without inertia, so none can be removed from its signals"
            )
        known = known_trial.whiskers if whiskers is None else whiskers
        return _by_sensor(root, known, dynamics)
    if dynamics is not None:
        raise ValueError(f"inertia can be removed from sensor signals only, not from the {chosen}")
    if chosen == "rod":
        return _by_rod(root)
    count = root.sizes["whisker"]
    known = known_trial.whiskers if whiskers is None else whiskers
    needed(root, ("contact_point",), "contact point")
    if len(known) != count:
        raise ValueError(f"{len(known)} whiskers are given; the recording has {count}")
    poses, table = paper_pose(known_trial, cutoff), _given_points(known_trial)
    parts = [
        signals_by_point(one, None if table is None else table[:, k], poses[k], known[k], proximal)
        for k, one in enumerate(known_trial.root.each_whisker())
    ]
    data = xr.concat(parts, "whisker")
    about: dict[str, Any] = {"source": chosen}
    if cutoff is not None:
        about["cutoff"] = cutoff
    return with_coordinates(data, root, about)


def default_source(recording: xr.DataTree) -> Source:
    """Source of a recording's signals: a sensor if there is one, else the tracked contact point.

    The fitted rod of a tracked recording is never the default. Its fit includes some friction,
    which hardly moves the contact point but is a large share of the axial force, so that its wrench
    must be used in full rather than by signals that assume no friction.
    """
    root = recording.to_dataset()
    measured = {"force", "moment"} <= set(root.data_vars) or "reading" in root
    if measured and "wrench_covariance" not in root:
        return "sensor"
    if "contact_point" in root:
        return "contact point"
    raise ValueError(
        f"the recording has no signals and lacks the variables to compute them: it has "
        f"{names_of(root)}; force and moment, or contact_point with base_position and "
        "base_rotation, are needed"
    )


def _given_points(recording: Recording) -> Array | None:
    """Contact points (time, whisker, 3) that were given in a table; None if there is none."""
    measured = recording.find("measured")
    if measured is None or "contact_point" not in measured:
        return None
    given = measured.data["contact_point"].attrs.get("source") == "table"
    return measured["contact_point"] if given else None


def _by_sensor(
    root: xr.Dataset, whiskers: Sequence[Whisker], dynamics: Dynamics | Literal["fitted"] | None
) -> xr.Dataset:
    """Signals measured by a sensor."""
    covariance: Array | None
    if "force" not in root and {"reading", "mixing"} <= set(root.data_vars):
        root, covariance = _from_channels(root)
    else:
        needed(root, ("force", "moment"), "sensor")
        covariance = _own_noise(root)
    needed(root, ("base_position", "base_rotation"), "sensor")
    if "wrench_covariance" in root:
        raise ValueError(
            "force and moment of this recording are not a sensor's but those of the rod fitted to "
            "its images; use the source 'rod'"
        )
    if dynamics is not None:
        noise = component_noise(FORCE_NOISE, MOMENT_NOISE) if covariance is None else covariance
        each = zip(Group(root).each_whisker(), whiskers, strict=True)
        parts = [without_inertia(one, whisker, dynamics, noise) for one, whisker in each]
        of_each = {name: np.ravel([part.attrs[name] for part in parts]) for name in parts[0].attrs}
        about = {"source": "sensor", **of_each, "fitted": int(dynamics == "fitted")}
        return with_coordinates(
            xr.concat(parts, "whisker", combine_attrs="drop_conflicts"), root, about
        )
    force, moment = (Group(root)[name] for name in ("force", "moment"))
    known = _known(force, moment)
    least = 0.0
    if covariance is not None:
        least = DETECTED * float(np.sqrt(0.5 * (covariance[4, 4] + covariance[5, 5])))
    touching = known & (np.hypot(moment[..., 1], moment[..., 2]) > least)
    nothing = ~force.any(axis=-1) & ~moment.any(axis=-1)
    status = np.where(nothing, int(Status.NO_CONTACT), int(Status.NOT_FELT))
    status[touching] = int(Status.OK)
    status[~known] = int(Status.MISSING)
    data = _labelled(root, touching, status, {"source": "sensor"})
    if covariance is None:
        return data
    if (covariance == np.diag(np.diag(covariance))).all():
        return data.assign_attrs(noise=np.sqrt(np.diag(covariance)))
    whole = np.broadcast_to(covariance, (*known.shape, 6, 6))
    return data.assign(wrench_covariance=recorded("wrench_covariance", whole))


def _own_noise(root: xr.Dataset) -> Array | None:
    """Covariance (6, 6) of force and moment from their attributes ``noise``; None without."""
    deviations = np.concatenate(
        [
            _deviations(name, root[name].attrs.get("noise", np.nan), 3)
            for name in ("force", "moment")
        ]
    )
    return np.diag(deviations**2) if np.isfinite(deviations).all() else None


def _deviations(name: str, noise: Any, count: int) -> Array:
    """Standard deviations (count,) of components from an attribute ``noise``."""
    given = np.ravel(noise)
    if given.dtype.kind not in "fiu" or given.size not in (1, count) or (given < 0.0).any():
        raise ValueError(
            f"the noise of {name} is {noise!r}; one or {count} standard deviations, not negative, "
            "are needed"
        )
    return np.broadcast_to(given.astype(np.float64), count)


def _from_channels(root: xr.Dataset) -> tuple[xr.Dataset, Array]:
    """Add force and moment computed from other channels; also return their covariance (6, 6)."""
    known = Group(root)
    sensor = Sensor(
        [str(name) for name in root["channel"].values],
        known["mixing"],
        noise=root["reading"].attrs.get("noise"),
    )
    wrench, covariance = sensor.to_wrench(known["reading"])
    parts = {"force": wrench[..., :3], "moment": wrench[..., 3:]}
    return root.assign({name: recorded(name, part) for name, part in parts.items()}), covariance


def _by_rod(root: xr.Dataset) -> xr.Dataset:
    """Signals of the rod fitted to the images."""
    names = ("force", "moment", "base_position", "base_rotation", "wrench_covariance")
    needed(root, names, "rod")
    trial = Group(root)
    known = _known(trial["force"], trial["moment"])
    touching = known & trial["force"].any(axis=-1)
    if "in_contact" in trial:
        touching &= trial["in_contact"]
    status = np.where(touching, int(Status.OK), int(Status.NO_CONTACT))
    status[~known] = int(Status.MISSING)
    data = _labelled(root, touching, status, {"source": "rod"})
    kept = {name: root[name].variable for name in SQUARES if name in root}
    return data.assign(kept)


def _known(force: Array, moment: Array) -> NDArray[np.bool_]:
    """Frames (time, whisker) in which force and moment are finite."""
    return np.asarray(np.isfinite(force + moment).all(axis=-1))


def _labelled(
    root: xr.Dataset,
    touching: NDArray[np.bool_],
    status: NDArray[np.int64],
    about: Mapping[str, Any],
) -> xr.Dataset:
    """Signals from the recording's own wrench and pose."""
    names = ("force", "moment", "base_position", "base_rotation")
    parts = []
    for k, one in enumerate(Group(root).each_whisker()):
        data = {name: one[name] for name in names} | {"in_contact": touching[:, k]}
        parts.append(one_whisker(data, status[:, k]))
    return with_coordinates(xr.concat(parts, "whisker"), root, about)


def sensor_noise(signals: xr.Dataset) -> Array | None:
    """Covariance of (F, M), (6, 6) or (time, ..., 6, 6), of signals; None if unknown."""
    if "wrench_covariance" in signals:
        return Group(signals)["wrench_covariance"]
    if "noise" in signals.attrs:
        return np.diag(_deviations("signals", signals.attrs["noise"], 6) ** 2)
    return None


def placed_by(signals: xr.Dataset, recording: xr.DataTree) -> xr.Dataset:
    """Combine sensor signals with the pose tracked in another recording of the same trial.

    Parameters
    ----------
    signals : xarray.Dataset
        Dataset of `signals_of`, source "sensor".
    recording : xarray.DataTree
        Tracked recording, with as many whiskers in the same order.

    Returns
    -------
    xarray.Dataset
        Signals at the times and with the whisker names of the tracked recording, with its
        ``base_position``, ``base_rotation`` and, if known, ``pose_covariance``. Each frame has the
        signals nearest in time, or none if these are more than half a sampling interval away.

    Raises
    ------
    ValueError
        If the numbers of whiskers differ, or there is no pose.
    """
    check_recording(recording)
    root = recording.to_dataset()
    names = ("base_position", "base_rotation")
    needed(root, names, "sensor, with the pose of this recording,")
    if root.sizes["whisker"] != signals.sizes["whisker"]:
        raise ValueError(
            f"there are signals of {signals.sizes['whisker']} whiskers, and the recording with the "
            f"pose has {root.sizes['whisker']}"
        )
    time, wanted = signals["time"].values, root["time"].values
    later = np.searchsorted(time, wanted).clip(0, time.size - 1)
    earlier = np.maximum(later - 1, 0)
    near = np.where(wanted - time[earlier] <= time[later] - wanted, earlier, later)
    step = np.median(np.diff(time)) if time.size > 1 else np.inf
    there = xr.DataArray(np.abs(time[near] - wanted) <= 0.5001 * step, dims="time")
    kept = signals.drop_vars([*SQUARES, *names], errors="ignore").isel(time=near)
    if "wrench_covariance" in signals:
        kept["wrench_covariance"] = signals["wrench_covariance"].isel(time=near)
    kept = kept.drop_vars(["time", "whisker"], errors="ignore")
    placed = {
        str(name): variable.where(there, *_FILL_VALUES.get(str(name), ())).assign_attrs(
            variable.attrs
        )
        for name, variable in kept.data_vars.items()
    }
    pose = {name: root[name].variable for name in (*names, "pose_covariance") if name in root}
    return with_coordinates(xr.Dataset(placed).assign(pose), root, signals.attrs)


class Pose(NamedTuple):
    """Pose of one whisker's base in every frame, laboratory frame, with covariances (n, 6, 6)."""

    rotation: Array
    position: Array
    covariance: Array


def paper_pose(recording: Recording, cutoff: float | None) -> list[Pose]:
    """Pose of each whisker's base, low-pass filtered relative to the head.

    The pose measured before the rod was fitted is used if there is one, otherwise that of the
    recording.
    """
    root = recording.root
    head = HeadPose.still(root.data.sizes["time"])
    if "head_position" in root and "head_rotation" in root:
        head = HeadPose(root["head_position"], root["head_rotation"])
    time = root.data["time"].values
    if time.size < 2:
        cutoff = None  # a single frame is not filtered
    measured = recording.find("measured")
    if measured is not None and "base_azimuth" not in measured:
        measured = None
    prefix = "unfiltered_"
    if measured is None:
        needed(root.data, ("contact_point", "base_position", "base_rotation"), "contact point")
    elif f"{prefix}base_azimuth" not in measured:
        if measured.data.attrs.get("cutoff", CUTOFF) != cutoff:
            raise ValueError(
                f"this recording contains the filtered pose only; a cut-off of {cutoff} Hz needs "
                "the unfiltered one: track the videos again"
            )
        prefix, cutoff = "", None
    poses = []
    for k, own in enumerate(root.each_whisker()):
        if measured is None:
            place = own["base_position"]
            angles = angles_of(np.swapaxes(head.rotation, 1, 2) @ own["base_rotation"]).T
        else:
            one = measured.whisker(k)
            place = one[f"{prefix}base_position"]
            names = ("azimuth", "elevation", "roll")
            angles = np.stack([one[f"{prefix}base_{name}"] for name in names])
        pose = BasePose(head.seen_from(place), *angles).filtered(time, cutoff)
        rotation, position = head.rotation @ pose.rotation, head.put_in(pose.position)
        poses.append(Pose(rotation, position, _pose_covariance(own, rotation, position)))
    if cutoff is not None and (count := len(pieces(time, cutoff))) > 1:
        warnings.warn(
            f"frames are missing, up to {np.diff(time).max():.3g} s in a row: the base pose is "
            f"filtered in {count} pieces; those of a single frame are not filtered",
            UserWarning,
            stacklevel=3,
        )
    return poses


def _pose_covariance(own: Group, rotation: Array, position: Array) -> Array:
    """Covariance (time, 6, 6) of a pose: the recording's, plus the mean square difference from it.

    The two are added because the error of the recording's pose and the difference from it have
    largely independent causes.
    """
    out = np.zeros((len(rotation), 6, 6))
    if "pose_covariance" not in own:
        return out
    out += own["pose_covariance"]
    turned = own["base_rotation"]
    there = np.isfinite(turned.sum(axis=(1, 2)) + rotation.sum(axis=(1, 2)))
    if "in_contact" in own:
        there &= own["in_contact"]
    if not there.any():
        return out
    turn = transform.Rotation.from_matrix(
        rotation[there] @ np.swapaxes(turned[there], 1, 2)
    ).as_rotvec()
    shift = (position - own["base_position"])[there]
    away = np.concatenate([shift, turn], axis=1)
    return np.asarray(out + away.T @ away / len(away))


def signals_by_point(
    one: Group, given: Array | None, pose: Pose, whisker: Whisker, proximal: float
) -> xr.Dataset:
    """Signals of the frictionless rod through the tracked or tabulated contact points."""
    rotation, position = pose.rotation, pose.position
    point = one["contact_point"]
    tabulated = np.zeros(len(point), dtype=bool)
    if given is not None:
        tabulated = np.asarray(np.isfinite(given).all(axis=1))
        point = np.where(tabulated[:, None], given, point)
    held = np.isfinite(rotation.sum(axis=(1, 2)) + position.sum(axis=1))
    touching = np.isfinite(point).all(axis=1)
    if "in_contact" in one:
        touching = tabulated | one["in_contact"]
    local = np.einsum("tji,tj->ti", rotation, point - position)
    bent = deflect(whisker, PointContact(local[touching]), proximal=proximal)
    status = np.where(held, int(Status.NO_CONTACT), int(Status.MISSING))
    status[touching] = bent.status
    wrench = {}
    for name, values in (("force", bent.force), ("moment", bent.moment)):
        wrench[name] = np.where(held[:, None], 0.0, np.nan) * np.ones(3)
        wrench[name][touching] = values
    data = one_whisker(
        {
            **wrench,
            "base_position": position,
            "base_rotation": rotation,
            "in_contact": touching & held,
        },
        status,
    )
    if "contact_covariance" not in one:
        return data
    slopes = np.zeros((len(point), 6, 3))
    slopes[touching] = wrench_slopes(whisker, bent.arc_length, bent.contact_force)
    slopes = slopes @ np.swapaxes(rotation, 1, 2)
    spread = one["contact_covariance"]
    spread = np.where(touching[:, None, None], spread, 0.0)
    spread[tabulated] = np.nan
    # Effect of small errors of the base's position and rotation on the point in the whisker frame.
    moved = np.concatenate([-np.eye(3) + np.zeros_like(spread), cross_matrix(point - position)], 2)
    moved = np.where(touching[:, None, None], moved, 0.0)
    both = pose.covariance @ np.swapaxes(moved, 1, 2)
    squares = {
        "wrench_covariance": slopes @ (spread + moved @ both) @ np.swapaxes(slopes, 1, 2),
        "pose_covariance": pose.covariance,
        "pose_wrench_covariance": both @ np.swapaxes(slopes, 1, 2),
    }
    return data.assign({name: recorded(name, square) for name, square in squares.items()})


_ROUNDS = 2  # number of corrections
# Components Fx and Mx, along the whisker at its base.
_ALONG = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 0.0])
_SETTLED = 10e-3  # time after an onset over which the chain takes over from the lag model, s
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
    """Signals of one whisker corrected for inertia and damping.

    Density and damping ratio, given or fitted, are attributes of the result.
    """
    trial, known = _trial(own, whisker, noise)
    course = trial.time, trial.wrench, trial.rotation, trial.position
    if dynamics == "fitted":
        dynamics = fit_dynamics(
            whisker, *course, noise, stiffness_sigma=_STIFFNESS_KNOWN_TO
        ).dynamics
    vibration = Vibration.of(whisker, dynamics)
    trial = trial._replace(touching=vibration.in_contact(*course, noise))
    added, apart = _added(trial, dynamics, vibration)
    left = trial.wrench - added
    left[~known] = np.nan
    touching = trial.touching & known
    status = np.where(touching, int(Status.OK), int(Status.NOT_FELT))
    status[~known] = int(Status.MISSING)
    values = {"force": left[:, :3], "moment": left[:, 3:], "in_contact": touching}
    values |= {"base_position": trial.position, "base_rotation": trial.rotation}
    covariance = trial.noise + _uncertainty(trial, added, apart, vibration)
    about = {"density": dynamics.density, "damping_ratio": dynamics.damping_ratio}
    covariances = recorded("wrench_covariance", covariance)
    return one_whisker(values, status).assign(wrench_covariance=covariances).assign_attrs(about)


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


def _added(trial: _Trial, dynamics: Dynamics, vibration: Vibration) -> tuple[Array, Array]:
    """Wrench (n, 6) due to inertia and damping, and the difference between two models of it.

    The first model holds after an onset: bending lags behind the moment by the time constant of the
    damping, and only the inertia along the whisker reaches the base. Later a chain held at
    the contact points is more accurate.
    """
    along = vibration.in_air(trial.time, trial.rotation, trial.position) * _ALONG
    quick = trial.wrench - _lagged(trial.wrench - along, trial.step / vibration.damping)
    size = np.abs(trial.wrench).reshape(-1, 2, 3).max(axis=(0, 2)).repeat(3)
    most = float(np.linalg.norm(trial.wrench[:, :3], axis=1).max())
    added, apart = quick, np.zeros_like(quick)
    for _ in range(_ROUNDS):
        points, arc_length = _smoothed(trial, trial.wrench - added, added)
        pose = trial.rotation, trial.position
        held = inertial_wrench(
            trial.whisker, dynamics, trial.time, *pose, points, arc_length, _SLIPS * most
        )
        apart, share = held - quick, np.full((len(quick), 1), np.inf)
        # A correction larger than the largest measured value means that the chain has failed.
        apart[(np.abs(apart) > size).any(axis=1)] = 0.0
        for first, end in contacts_in(trial.touching):
            share[first:end, 0] = trial.step * np.arange(end - first) / _SETTLED
        added = quick - np.expm1(-(share**2)) * apart
    return added, apart


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


def _uncertainty(trial: _Trial, added: Array, apart: Array, vibration: Vibration) -> Array:
    """Covariance (n, 6, 6) of the correction.

    It grows with the correction and with the difference between its two models. It is as large as
    the wrench itself for about one radian of the first mode before a release, when no contact is in
    equilibrium, and for half as long after an onset.
    """
    out = _KNOWN_TO**2 * np.einsum("ti,tj->tij", added, added)
    out += _APART**2 * np.einsum("ti,tj->tij", apart, apart)
    near = np.zeros((len(added), 1))
    for first, end in contacts_in(trial.touching):
        since = np.arange(1, end - first + 1)
        turned = trial.step * vibration.rates[0] * np.minimum(2 * since, since[::-1])
        near[first:end, 0] = np.exp(-turned)
    parts = (_LEFT**2 * (added**2 + apart**2), trial.wrench**2)
    left, whole = (
        ndimage.gaussian_filter1d(part.reshape(-1, 2, 3).mean(axis=2), _MEMORY / trial.step, axis=0)
        for part in parts
    )
    out[:, range(6), range(6)] += np.repeat(left + near**2 * whole, 3, axis=1)
    return np.asarray(out)
