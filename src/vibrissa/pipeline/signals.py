"""What the whisker's base feels in every frame of a recording, from whichever source there is.

**The contact point** (the paper's way): the contact point that was tracked in the laboratory is
expressed in the frame of the whisker's base, whose pose is filtered without phase shift; the
frictionless rod that passes through it tells force and moment (`vibrissa.deflect`). Points that the
rod cannot reach keep their frame and say why. The wrench has the covariance of the point, and of
the pose: how far it usually is from that of the rod, where that is known.

**The rod**: force and moment of the rod that fits the whisker's images, with their covariance.

**A sensor**: force and moment as they were read, in a simulated or a robot's recording; or what its
channels read, if these are six or more that tell force and moment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.pipeline.frames import (
    SQUARES,
    check_recording,
    names_of,
    needed,
    one_whisker,
    with_coordinates,
)
from vibrissa.pipeline.locate import FELT
from vibrissa.pipeline.tracked_points import paper_pose, signals_by_point
from vibrissa.recording import Group, Recording, recorded
from vibrissa.rod import PROXIMAL
from vibrissa.sensors import Sensor
from vibrissa.status import Status
from vibrissa.tracking import CUTOFF
from vibrissa.whisker import Whisker

Array = NDArray[np.float64]

Source = Literal["contact point", "rod", "sensor"]
"""Where signals come from."""

_ELSEWHERE = {"in_contact": (False,), "status": (np.int8(Status.MISSING),)}
"""What frames without signals have instead of NaN."""


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
    known_trial = Recording(recording)
    root = known_trial.root.data
    if chosen == "sensor":
        return _by_sensor(root)
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
    felt = {"force", "moment"} <= set(root.data_vars) or "reading" in root
    if felt and "wrench_covariance" not in root:
        return "sensor"
    if "contact_point" in root:
        return "contact point"
    raise ValueError(
        f"the recording has no signals and nothing to make them of: it has {names_of(root)}; force "
        "and moment, or contact_point with base_position and base_rotation, are needed"
    )


def _given_points(recording: Recording) -> Array | None:
    """Contact points (time, whisker, 3) that were not tracked but given in a table."""
    measured = recording.find("measured")
    if measured is None or "contact_point" not in measured:
        return None
    given = measured.data["contact_point"].attrs.get("source") == "table"
    return measured["contact_point"] if given else None


def _by_sensor(root: xr.Dataset) -> xr.Dataset:
    covariance: Array | None
    if "force" not in root and {"reading", "mixing"} <= set(root.data_vars):
        root, covariance = _from_channels(root)
    else:
        needed(root, ("force", "moment"), "sensor")
        covariance = _own_noise(root)
    needed(root, ("base_position", "base_rotation"), "sensor")
    if "wrench_covariance" in root:
        raise ValueError(
            "no sensor was there: force and moment of this recording are those of the rod that "
            "fits its images; take them from the source 'rod'"
        )
    force, moment = (Group(root)[name] for name in ("force", "moment"))
    known = _known(force, moment)
    least = 0.0
    if covariance is not None:
        least = FELT * float(np.sqrt(0.5 * (covariance[4, 4] + covariance[5, 5])))
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
    """Covariance (6, 6) of force and moment, where they say how noisy they are."""
    deviations = np.concatenate(
        [
            np.broadcast_to(np.asarray(root[name].attrs.get("noise", np.nan), np.float64), 3)
            for name in ("force", "moment")
        ]
    )
    return np.diag(deviations**2) if np.isfinite(deviations).all() else None


def _from_channels(root: xr.Dataset) -> tuple[xr.Dataset, Array]:
    """Force and moment, and their covariance (6, 6), from what other channels read of them."""
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
    """In which frames (time, whisker) force and moment are numbers."""
    return np.asarray(np.isfinite(force + moment).all(axis=-1))


def _labelled(
    root: xr.Dataset,
    touching: NDArray[np.bool_],
    status: NDArray[np.int64],
    about: Mapping[str, Any],
) -> xr.Dataset:
    """Signals of a wrench that the recording itself has, with its own pose."""
    names = ("force", "moment", "base_position", "base_rotation")
    parts = []
    for k, one in enumerate(Group(root).each_whisker()):
        data = {name: one[name] for name in names} | {"in_contact": touching[:, k]}
        parts.append(one_whisker(data, status[:, k]))
    return with_coordinates(xr.concat(parts, "whisker"), root, about)


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
        return Group(signals)["wrench_covariance"]
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
    needed(root, names, "sensor, placed by this recording,")
    if root.sizes["whisker"] != signals.sizes["whisker"]:
        raise ValueError(
            f"the signals are those of {signals.sizes['whisker']} whiskers, and the recording that "
            f"places them has {root.sizes['whisker']}"
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
        str(name): variable.where(there, *_ELSEWHERE.get(str(name), ())).assign_attrs(
            variable.attrs
        )
        for name, variable in kept.data_vars.items()
    }
    pose = {name: root[name].variable for name in (*names, "pose_covariance") if name in root}
    return with_coordinates(xr.Dataset(placed).assign(pose), root, signals.attrs)
