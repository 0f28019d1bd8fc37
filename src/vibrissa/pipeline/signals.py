"""What the whisker's base feels in every frame of a recording, from whichever source there is.

**The contact point** (the paper's way): the contact point that was tracked in the laboratory is
expressed in the frame of the whisker's base, whose pose is filtered without phase shift; the
frictionless rod that passes through it tells force and moment (`vibrissa.deflect`). Points that the
rod cannot reach keep their frame and say why. The wrench has the covariance of the point, and of
the pose: how far it usually is from that of the rod, where that is known.

**The rod**: force and moment of the rod that fits the whisker's images, with their covariance.

**A sensor**: force and moment as they were read, in a simulated or a robot's recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vibrissa.pipeline.laboratory import cross_matrices
from vibrissa.pipeline.locate import FELT
from vibrissa.pipeline.slopes import wrench_slopes
from vibrissa.quantities import attributes
from vibrissa.rod.deflection import deflect
from vibrissa.rod.loads import PointContact
from vibrissa.rod.reach import PROXIMAL
from vibrissa.signals import base_signals
from vibrissa.status import Status
from vibrissa.tracking.filtering import CUTOFF
from vibrissa.tracking.head import HeadPose
from vibrissa.tracking.pose import BasePose
from vibrissa.trial.recording import recorded, recorded_whisker
from vibrissa.whisker import Whisker
from vibrissa.whisker.emergence import angles_of

Array = NDArray[np.float64]

Source = Literal["contact point", "rod", "sensor"]
"""Where signals come from."""

_ELSEWHERE = {"in_contact": (False,), "status": (np.int8(Status.MISSING),)}
"""What frames without signals have instead of NaN."""

_SQUARES = {
    "wrench_covariance": ("component", "component_"),
    "pose_covariance": ("pose", "pose_"),
    "pose_wrench_covariance": ("pose", "component_"),
}


def signals_of(
    recording: xr.DataTree,
    source: Source | None = None,
    cutoff: float | None = CUTOFF,
    *,
    whiskers: Sequence[Whisker] | None = None,
    proximal: float = PROXIMAL,
) -> xr.Dataset:
    """Give force, moment and the six signals of every frame and whisker.

    Parameters
    ----------
    recording : xarray.DataTree
        Tracked, simulated or measured.
    source : {"contact point", "rod", "sensor"}, optional
        See the module; by default what `default_source` finds.
    cutoff : float, optional
        Of the low pass on the pose that the contact point is expressed in, Hz; None filters
        nothing. The other sources have a pose of their own.
    whiskers : sequence of Whisker, optional
        One for each along the dimension ``whisker``; by default those of the recording. Only the
        contact point needs them.
    proximal : float
        Contact points at less than this fraction of the length from the base get a status instead
        of signals.

    Returns
    -------
    xarray.Dataset
        Dims time, whisker, space: ``force``, ``moment`` and ``Fx`` … ``MD``, whisker's frame, zero
        without contact; ``base_position`` and ``base_rotation``, the pose that belongs to them;
        ``in_contact`` (of a sensor whose noise is known: where M_B exceeds five standard
        deviations), ``status``, and where known ``wrench_covariance`` and the pose's. Attributes
        ``source``, ``cutoff`` and, of a sensor, ``noise``: standard deviations of (F, M). The group
        ``signals`` of a recording.

    Raises
    ------
    ValueError
        If the recording lacks what the source needs, or the cut-off is not below half the rate.
    """
    check_recording(recording)
    chosen = default_source(recording) if source is None else source
    if chosen not in get_args(Source):
        raise ValueError(f"source is {chosen!r}; one of {', '.join(get_args(Source))} is needed")
    root = recording.to_dataset()
    if chosen == "sensor":
        return _by_sensor(root)
    if chosen == "rod":
        return _by_rod(root)
    count = root.sizes["whisker"]
    known = [recorded_whisker(recording, k) for k in range(count)] if whiskers is None else whiskers
    _needed(root, ("contact_point",), "contact point")
    if len(known) != count:
        raise ValueError(f"{len(known)} whiskers are given; the recording has {count}")
    pose = _paper_pose(recording, cutoff)
    data = xr.concat(
        [_by_point(root, pose[k], k, one, proximal) for k, one in enumerate(known)], "whisker"
    )
    about: dict[str, Any] = {"source": chosen}
    if cutoff is not None:
        about["cutoff"] = cutoff
    return _with_coordinates(data, root, about)


def check_recording(recording: xr.DataTree) -> None:
    """Make sure that a recording has frames and whiskers.

    Parameters
    ----------
    recording : xarray.DataTree
        Perhaps one.

    Raises
    ------
    ValueError
        If it has no time, or no dimension ``whisker``.
    """
    root = recording.to_dataset(inherit=False)
    missing = [name for name in ("time", "whisker") if name not in root.dims]
    if missing:
        got = ", ".join(str(name) for name in root.dims) or "none"
        raise ValueError(
            f"the recording lacks the dimensions {', '.join(missing)}; it has {got}: one that was "
            "tracked, simulated or measured is needed"
        )


def default_source(recording: xr.DataTree) -> Source:
    """Say which source of signals a recording has: a sensor or else the tracked contact point.

    The rod of a tracked recording is not chosen by itself. It fits the images with a little
    friction, which hardly moves the contact point but is a large share of the axial force, so that
    its wrench is to be used whole, not by signals that presume no friction.

    Parameters
    ----------
    recording : xarray.DataTree
        The recording.

    Returns
    -------
    str
        The first of these that it has.

    Raises
    ------
    ValueError
        If it has neither.
    """
    root = recording.to_dataset()
    if {"force", "moment"} <= set(root.data_vars) and "wrench_covariance" not in root:
        return "sensor"
    if "contact_point" in root:
        return "contact point"
    raise ValueError(
        f"the recording has no signals and nothing to make them of: it has {_names(root)}; force "
        "and moment, or contact_point with base_position and base_rotation, are needed"
    )


def _names(data: xr.Dataset) -> str:
    return ", ".join(sorted(map(str, data.data_vars))) or "no variables"


def _needed(root: xr.Dataset, names: Sequence[str], source: str) -> None:
    missing = [name for name in names if name not in root]
    if not missing:
        return
    if "reading" in root and "force" in missing:
        channels = ", ".join(map(str, root["channel"].values))
        raise ValueError(
            f"the sensor of this recording reads {channels}, not force and moment; see its reading "
            "and mixing"
        )
    raise ValueError(
        f"signals from the {source} need {', '.join(missing)}; the recording has {_names(root)}"
    )


def _by_sensor(root: xr.Dataset) -> xr.Dataset:
    _needed(root, ("force", "moment", "base_position", "base_rotation"), "sensor")
    if "wrench_covariance" in root:
        raise ValueError(
            "no sensor was there: force and moment of this recording are those of the rod that "
            "fits its images; take them from the source 'rod'"
        )
    noise = np.concatenate(
        [
            np.broadcast_to(np.asarray(root[name].attrs.get("noise", np.nan), np.float64), 3)
            for name in ("force", "moment")
        ]
    )
    about: dict[str, Any] = {"source": "sensor"}
    wrench = root[["force", "moment"]]
    known = _known(wrench)
    least = 0.0
    if np.isfinite(noise).all():
        about["noise"] = noise
        least = FELT * float(np.sqrt(0.5 * (noise[4] ** 2 + noise[5] ** 2)))
    moment = wrench["moment"].transpose("time", "whisker", "space").values
    touching = known & (np.hypot(moment[..., 1], moment[..., 2]) > least)
    status = np.where(touching, int(Status.OK), int(Status.NO_CONTACT))
    status[~known] = int(Status.MISSING)
    return _labelled(root, wrench, touching, status, about)


def _by_rod(root: xr.Dataset) -> xr.Dataset:
    names = ("force", "moment", "base_position", "base_rotation", "wrench_covariance")
    _needed(root, names, "rod")
    wrench = root[["force", "moment"]]
    known = _known(wrench)
    touching = known & (wrench["force"] != 0.0).any("space").values
    if "in_contact" in root:
        touching &= root["in_contact"].transpose("time", "whisker").values.astype(bool)
    status = np.where(touching, int(Status.OK), int(Status.NO_CONTACT))
    status[~known] = int(Status.MISSING)
    data = _labelled(root, wrench, touching, status, {"source": "rod"})
    kept = {name: root[name].variable for name in _SQUARES if name in root}
    return data.assign(kept)


def _known(wrench: xr.Dataset) -> NDArray[np.bool_]:
    """In which frames (time, whisker) force and moment are numbers."""
    whole = sum(wrench[name].transpose("time", "whisker", "space") for name in ("force", "moment"))
    return np.asarray(np.isfinite(np.asarray(whole)).all(axis=-1))


def _labelled(
    root: xr.Dataset,
    wrench: xr.Dataset,
    touching: NDArray[np.bool_],
    status: NDArray[np.int64],
    about: Mapping[str, Any],
) -> xr.Dataset:
    """Signals of a wrench that the recording itself has, with its own pose."""
    order = ("time", "whisker", "space")
    names = ("force", "moment", "base_position")
    values = {name: root[name].transpose(*order).values for name in names}
    turned = root["base_rotation"].transpose(*order, "whisker_axis").values
    parts = []
    for k in range(root.sizes["whisker"]):
        data = {name: array[:, k] for name, array in values.items()}
        data |= {"base_rotation": turned[:, k], "in_contact": touching[:, k]}
        parts.append(_one(data, status[:, k]))
    return _with_coordinates(xr.concat(parts, "whisker"), root, about)


def _one(values: Mapping[str, Any], status: NDArray[np.int64]) -> xr.Dataset:
    """Signals of one whisker as a dataset with a dimension ``whisker`` of length one."""
    data = {name: recorded(name, array) for name, array in values.items()}
    data["status"] = recorded("status", np.asarray(status, dtype=np.int8))
    six = base_signals(values["force"], values["moment"])
    for name, signal in six.data_vars.items():
        data[str(name)] = xr.Variable(("time", "whisker"), signal.values[:, None], signal.attrs)
    return xr.Dataset(data)


def _with_coordinates(data: xr.Dataset, root: xr.Dataset, about: Mapping[str, Any]) -> xr.Dataset:
    names = ("time", "whisker", "space", "whisker_axis")
    coordinates = {name: root[name].variable for name in names if name in root.coords}
    return data.assign_coords({"space": list("xyz"), **coordinates}).assign_attrs(about)


class _Pose(NamedTuple):
    """How one whisker is held: rotation (time, 3, 3), position (time, 3), laboratory frame.

    And the covariance of position and a small turn, (time, 6, 6); zero where it is not known.
    """

    rotation: Array
    position: Array
    covariance: Array


def _paper_pose(recording: xr.DataTree, cutoff: float | None) -> list[_Pose]:
    """How each whisker is held, filtered: from before the rod was fitted, or the recording's own.

    What is filtered is how it is held relative to the head.
    """
    root = recording.to_dataset()
    head = HeadPose.still(root.sizes["time"])
    if {"head_position", "head_rotation"} <= set(root.data_vars):
        head = HeadPose(root["head_position"].values, root["head_rotation"].values)
    rate = 1.0 / float(np.median(np.diff(root["time"].values))) if root.sizes["time"] > 1 else 1.0
    group = recording.children.get("measured")
    measured = None if group is None or "base_azimuth" not in group else group.to_dataset()
    prefix = "unfiltered_"
    if measured is None:
        _needed(root, ("contact_point", "base_position", "base_rotation"), "contact point")
    elif f"{prefix}base_azimuth" not in measured:
        if measured.attrs.get("cutoff", CUTOFF) != cutoff:
            raise ValueError(
                f"the pose of this recording is kept as it was filtered; a cut-off of {cutoff} Hz "
                "needs the unfiltered one: track the videos again"
            )
        prefix, cutoff = "", None
    poses = []
    for k in range(root.sizes["whisker"]):
        own = root.isel(whisker=k)
        if measured is None:
            place = own["base_position"].transpose("time", "space").values
            turned = own["base_rotation"].transpose("time", "space", "whisker_axis").values
            angles = angles_of(np.swapaxes(head.rotation, 1, 2) @ turned).T
        else:
            one = measured.isel(whisker=k)
            place = one[f"{prefix}base_position"].transpose("time", "space").values
            names = ("azimuth", "elevation", "roll")
            angles = np.stack([one[f"{prefix}base_{name}"].values for name in names])
        pose = BasePose(head.seen_from(place), *angles).filtered(rate, cutoff)
        rotation, position = head.rotation @ pose.rotation, head.put_in(pose.position)
        poses.append(_Pose(rotation, position, _pose_covariance(own, rotation, position)))
    return poses


def _pose_covariance(own: xr.Dataset, rotation: Array, position: Array) -> Array:
    """Covariance (time, 6, 6) of a pose beside that of the recording.

    As far as they differ, which is hardly of the same cause, the recording's counts as the truth,
    within its own covariance.
    """
    out = np.zeros((len(rotation), 6, 6))
    if "pose_covariance" not in own:
        return out
    out += own["pose_covariance"].transpose("time", "pose", "pose_").values
    turned = own["base_rotation"].transpose("time", "space", "whisker_axis").values
    there = np.isfinite(turned.sum(axis=(1, 2)) + rotation.sum(axis=(1, 2)))
    if "in_contact" in own:
        there &= own["in_contact"].values.astype(bool)
    if not there.any():
        return out
    turn = Rotation.from_matrix(rotation[there] @ np.swapaxes(turned[there], 1, 2)).as_rotvec()
    shift = (position - own["base_position"].transpose("time", "space").values)[there]
    away = np.concatenate([shift, turn], axis=1)
    return np.asarray(out + away.T @ away / len(away))


def _by_point(
    root: xr.Dataset, pose: _Pose, k: int, whisker: Whisker, proximal: float
) -> xr.Dataset:
    """Signals of the rod that passes through the tracked contact point."""
    rotation, position = pose.rotation, pose.position
    one = root.isel(whisker=k)
    point = one["contact_point"].transpose("time", "space").values
    held = np.isfinite(rotation.sum(axis=(1, 2)) + position.sum(axis=1))
    touching = np.isfinite(point).all(axis=1)
    if "in_contact" in one:
        touching = one["in_contact"].values.astype(bool)
    local = np.einsum("tji,tj->ti", rotation, point - position)
    bent = deflect(whisker, PointContact(local[touching]), proximal=proximal)
    status = np.where(held, int(Status.NO_CONTACT), int(Status.MISSING))
    status[touching] = bent.status
    wrench = {}
    for name, values in (("force", bent.force), ("moment", bent.moment)):
        wrench[name] = np.where(held[:, None], 0.0, np.nan) * np.ones(3)
        wrench[name][touching] = values
    data = _one(
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
    spread = one["contact_covariance"].transpose("time", "space", ...).values
    spread = np.where(touching[:, None, None], spread, 0.0)
    # The point is seen from a base that is a little elsewhere and turned by a little.
    moved = np.concatenate(
        [-np.eye(3) + np.zeros_like(spread), cross_matrices(point - position)], 2
    )
    moved = np.where(touching[:, None, None], moved, 0.0)
    both = pose.covariance @ np.swapaxes(moved, 1, 2)
    squares = {
        "wrench_covariance": slopes @ (spread + moved @ both) @ np.swapaxes(slopes, 1, 2),
        "pose_covariance": pose.covariance,
        "pose_wrench_covariance": both @ np.swapaxes(slopes, 1, 2),
    }
    return data.assign(
        {
            name: xr.Variable(
                ("time", "whisker", *_SQUARES[name]), square[:, None], attributes(name)
            )
            for name, square in squares.items()
        }
    )


def sensor_noise(signals: xr.Dataset) -> Array | None:
    """Give the noise that signals say they have.

    Parameters
    ----------
    signals : xarray.Dataset
        Of `signals_of`, of one whisker or more.

    Returns
    -------
    array (6, 6), (time, 6, 6), (time, whisker, 6, 6) or None
        Covariance of (F, M), SI units; None where it is not known.
    """
    if "wrench_covariance" in signals:
        dims = [d for d in ("time", "whisker") if d in signals["wrench_covariance"].dims]
        order = (*dims, *_SQUARES["wrench_covariance"])
        return np.asarray(signals["wrench_covariance"].transpose(*order).values)
    if "noise" in signals.attrs:
        return np.diag(np.asarray(signals.attrs["noise"], dtype=np.float64) ** 2)
    return None


def placed_by(signals: xr.Dataset, recording: xr.DataTree) -> xr.Dataset:
    """Place what a sensor felt by the pose that was tracked in another recording of the trial.

    Parameters
    ----------
    signals : xarray.Dataset
        Of `signals_of`, source "sensor".
    recording : xarray.DataTree
        Tracked, with as many whiskers in the same order.

    Returns
    -------
    xarray.Dataset
        In the frames and with the whiskers' names of the tracked recording: of each frame the
        signals that are nearest in time, at most half of the time between them away, with
        ``base_position``, ``base_rotation`` and, where known, ``pose_covariance`` as tracked.

    Raises
    ------
    ValueError
        If the numbers of whiskers differ, or there is no pose.
    """
    check_recording(recording)
    root = recording.to_dataset()
    names = ("base_position", "base_rotation")
    _needed(root, names, "sensor, placed by this recording,")
    if root.sizes["whisker"] != signals.sizes["whisker"]:
        raise ValueError(
            f"the signals are those of {signals.sizes['whisker']} whiskers, and the recording that "
            f"places them has {root.sizes['whisker']}"
        )
    time, wanted = signals["time"].values, root["time"].values
    near = np.abs(time[:, None] - wanted).argmin(axis=0)
    step = np.median(np.diff(time)) if time.size > 1 else np.inf
    there = xr.DataArray(np.abs(time[near] - wanted) <= 0.5001 * step, dims="time")
    kept = signals.drop_vars([*_SQUARES, *names], errors="ignore").isel(time=near)
    if "wrench_covariance" in signals:
        kept["wrench_covariance"] = signals["wrench_covariance"].isel(time=near)
    kept = kept.drop_vars(["time", "whisker"], errors="ignore")
    placed = {
        str(name): variable.where(there, *_ELSEWHERE.get(str(name), ())).assign_attrs(
            variable.attrs
        )
        for name, variable in kept.data_vars.items()
    }
    pose = {name: root[name].variable for name in (*names, "pose_covariance") if name in root}
    return _with_coordinates(xr.Dataset(placed).assign(pose), root, signals.attrs)
