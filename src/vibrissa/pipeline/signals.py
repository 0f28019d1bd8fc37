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

The contributions of the whisker's inertia and damping can be removed from sensor signals; see
:mod:`vibrissa.pipeline.inertia`.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.deferred import transform
from vibrissa.numerics import Array, cross_matrix
from vibrissa.pipeline.checks import (
    SQUARES,
    check_recording,
    names_of,
    needed,
    one_whisker,
    with_coordinates,
)
from vibrissa.pipeline.inertia import without_inertia
from vibrissa.pipeline.touch_gains import wrench_slopes
from vibrissa.recording import Group, Recording, recorded
from vibrissa.rod import PROXIMAL, PointContact, deflect
from vibrissa.sensors import FORCE_NOISE, MOMENT_NOISE, Sensor, component_noise
from vibrissa.signals import DETECTED
from vibrissa.simulation import Dynamics
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
        and, for a sensor, ``noise``, the standard deviations of (F, M). Without inertia also
        ``contact_probability``, above one half in contact, and ``contact_force_change`` with its
        covariance: the true contact force minus that which the signals give.

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
    """Pose of each base, filtered relative to the head; that before the rod's fit if known."""
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
