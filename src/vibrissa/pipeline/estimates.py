"""Contact points of every frame and whisker from the signals of a recording.

They are transformed to the laboratory, where continuity decides between several candidates.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.contacts import ContactMap, Gravity, Prior
from vibrissa.contour import continuing_candidates, to_laboratory
from vibrissa.numerics import Array, cross_matrix
from vibrissa.pipeline.events import EVENTS, with_events
from vibrissa.pipeline.frames import signals_in
from vibrissa.pipeline.locate import TRIPLET, locate, locate_from_wrench, without_contact
from vibrissa.pipeline.signals import sensor_noise
from vibrissa.quantities import attributes
from vibrissa.recording import Group, Recording, coordinates, recorded, recording_tree
from vibrissa.rod import PROXIMAL
from vibrissa.sensors import StageSweep, SuspendedWhisker, SweptContacts
from vibrissa.signals import selection, spherical
from vibrissa.status import Status, is_ok
from vibrissa.whisker import Whisker

Progress = Callable[[str, int, int], None]
"""Function called with the present stage, and the numbers of steps done and of all steps."""

WHOLE = "wrench"  # value of ``using`` for force and moment whole, instead of names of signals
# Standard deviation of the normals of swept surfaces, rad: friction across the wire turns them.
NORMAL_SIGMA = 0.1
_OTHER = 0.01  # share by which the whisker of a map may differ from that of a recording
_LABORATORY = {"reference_frame": "laboratory"}
_SQUARE = ("time", "space", "space_2")

_KEPT = (
    "contact_point",
    "contact_covariance",
    "contact_shared",
    "contact_normal",
    "normal_covariance",
    "point_normal_covariance",
    "contact_point_whisker",
    "covariance",
    "arc_length",
    "force",
    "friction_angle",
    "one_contact",
    "candidates",
    "in_contact",
    "status",
    *EVENTS,
)


def estimates_of(
    recording: xr.DataTree,
    signals: str | Sequence[str] | None = None,
    *,
    noise: ArrayLike | None = None,
    contact_maps: Sequence[ContactMap] | None = None,
    whiskers: Sequence[Whisker] | None = None,
    method: str = "exact",
    errors: Mapping[str, Any] | None = None,
    prior: Prior | None = None,
    friction: float = 0.0,
    second_contacts: float = 0.0,
    gravity: Gravity | None = None,
    proximal: float = PROXIMAL,
    progress: Progress | None = None,
) -> xr.Dataset:
    """Estimate the contact point in every frame with a contact.

    Parameters
    ----------
    recording : xarray.DataTree
        Recording with a group ``signals``; see `signals_of`.
    signals : str or sequence of str, optional
        Signals, three or more of the six, or "wrench": force and moment whole, which allows for
        friction. By default `TRIPLET`, but of the rod "wrench", whose friction is not zero.
    noise : array_like (6, 6), optional
        Covariance of (F, M), SI units; by default that stated with the signals. Signals of a sensor
        need one of the two; without any there are no covariances.
    contact_maps : sequence of ContactMap, optional
        Contact map of each whisker; by default simulated for those with a contact.
    whiskers : sequence of Whisker, optional
        Whiskers, where there are no maps; by default those of the recording.
    method : {"exact", "lookup", "lookup-linear", "network"}
        Exact, or one of the paper's methods, as of :func:`vibrissa.paper.estimate`.
    errors : mapping of str to float, optional
        ``stiffness_sigma``, ``gain_sigma`` and ``mixing_sigma``, as of ``ContactMap.estimate``:
        the same errors in all frames. They need noise.
    prior : Prior, optional
        Contacts that are possible; others are left out of the candidates.
    friction : float
        Standard deviation of the ratio of the force along the whisker to that across it, as of
        ``ContactMap.estimate``; 0, the default, for contacts without friction.
    second_contacts : float
        Rate of false alarms at which frames are detected that more than one contact explains, by
        force and moment whole (`second_contact`), such as 0.01; they get the status
        ``NOT_ONE_CONTACT``. 0, the default: no test. With the wrench ratios of friction are taken
        to be 0.3 (one sigma), otherwise as by ``friction``.
    gravity : Gravity, optional
        Gravity that whiskers of known density bend under, laboratory frame, as of
        ``ContactMap.estimate``; by default the sensor was tared in the first frame with a pose.
    proximal : float
        Smallest arc length of a contact of maps that are simulated, share of the length.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    xarray.Dataset
        Group ``estimates`` of a recording, dimensions time, whisker, space. In the laboratory
        ``contact_point`` with ``contact_covariance``, ``contact_normal`` with
        ``normal_covariance``, and ``point_normal_covariance``; in the whisker's frame
        ``contact_point_whisker`` with ``covariance``, ``arc_length`` and ``force``; how many
        ``candidates`` there were, of which the one that continues its neighbours in time is chosen;
        ``in_contact`` (detected) and ``status``; ``event`` (onset, loss or slip), and when each
        contact began, ``onset_time`` with ``onset_sigma``, s. Attributes ``signals``, ``source``
        and ``felt_above``, M_B from which contacts are detected, N·m, and ``friction``, as of
        `vibrissa.contacts.Contacts`. Frames whose signals have no
        answer keep the status that states the reason.

    Raises
    ------
    ValueError
        If there are no signals, their noise is not known, or names or numbers do not fit.

    Notes
    -----
    Covariances come from the noise of the signals and from that of the base's pose: of signals of
    the rod and of the tracked contact point both, with their correlation; of a sensor the pose's
    where a camera gives it (`placed_by`). So an error of the pose does not move a contact point
    that was tracked, as the same pose transforms it there and back, but it turns the normal.
    """
    data = signals_in(recording)
    if signals is None:
        signals = WHOLE if data.attrs.get("source") == "rod" else TRIPLET
    whole = signals == WHOLE
    names = TRIPLET if whole else selection(signals)
    count = data.sizes["whisker"]
    report = progress or (lambda stage, done, total: None)
    how: Any = {"errors": errors, "prior": prior, "second_contacts": second_contacts}
    how["gravity"] = gravity
    whiskers = _whiskers(recording, count, whiskers, contact_maps)
    if noise is None and data.attrs.get("source") == "sensor" and sensor_noise(data) is None:
        raise ValueError("the sensor's noise is not known: give the covariance of (F, M) as noise")
    parts, mapped = [], False
    tracked = Recording(recording)
    shaped = data.attrs.get("source") == "sensor" and "wrench_shared" in tracked.root
    for k, whisker in enumerate(whiskers):
        report("contact points", k, count)
        one = Group(data).whisker(k).data
        sigma = sensor_noise(one) if noise is None else np.asarray(noise, dtype=np.float64)
        wrench = one[["force", "moment"]]
        if data.attrs.get("source") != "sensor" or "density" in data.attrs:
            wrench = wrench.assign(in_contact=one["in_contact"])
        if gravity is not None:
            wrench = wrench.assign(base_rotation=one["base_rotation"])
        if whole:
            found = locate_from_wrench(whisker, wrench, sigma, **how)
        elif gravity is None and (
            (none := without_contact(whisker, wrench, names, noise=sigma)) is not None
        ):
            found = none
        else:
            if contact_maps is not None:
                contact_map = contact_maps[k]
            else:
                report("map of all contacts", k, count)
                mapped = True
                grid = method.startswith("lookup")
                contact_map = ContactMap.simulate(whisker, grid=grid, proximal=proximal)
                report("map of all contacts", k + 1, count)
            found = locate(
                contact_map, wrench, names, noise=sigma, method=method, friction=friction, **how
            )
        shared = None
        if shaped:
            same = np.isclose(whisker.length, tracked.whisker(k).length)
            shared = np.nan_to_num(tracked.root["wrench_shared"][:, k]) * same
        parts.append(_one_whisker(one, found, shared, other_noise=noise is not None))
        report("contact points", k + 1, count)
    if mapped:  # whiskers without contact need none
        report("map of all contacts", count, count)
    out = xr.concat(parts, "whisker").transpose("time", "whisker", ...)
    # What else was assumed is stated where it is not the default.
    out.attrs = {
        "signals": WHOLE if whole else " ".join(names),
        "source": str(data.attrs.get("source", "not known")),
        "felt_above": float(np.median([part.attrs["felt_above"] for part in parts])),
        **({"method": method} if method != "exact" else {}),
        **(errors or {}),
        "friction": np.inf if whole else friction,
        **({"prior": repr(prior)} if prior is not None else {}),
        **({"gravity": gravity.acceleration} if gravity is not None else {}),
    }
    return out.assign_coords({n: data[n].variable for n in ("time", "whisker", "space")})


def _whiskers(
    recording: xr.DataTree,
    count: int,
    given: Sequence[Whisker] | None,
    maps: Sequence[ContactMap] | None,
) -> Sequence[Whisker]:
    """Whiskers of so many signals: those given, those of the maps, or the recording's."""
    if given is None:
        given = Recording(recording).whiskers if maps is None else [one.whisker for one in maps]
    for things in (given, maps):
        if things is not None and len(things) != count:
            raise ValueError(f"there are signals of {count} whiskers; {len(things)} are given")
    known = Recording(recording).whiskers if maps and "whiskers" in recording.children else []
    for one, own in zip(maps or (), known, strict=False):
        if others := _differences(one.whisker, own):
            warnings.warn(
                f"the map is of another whisker than the recording's {own.name!r}: {others}",
                UserWarning,
                stacklevel=3,
            )
    return given


def _differences(whisker: Whisker, other: Whisker) -> str:
    """State in what two whiskers differ by more than rounding; empty if they do not."""
    pair, tips = (whisker, other), [one.centerline(2)[1] for one in (whisker, other)]
    measures = {
        "length": (1e3, "mm", [one.length for one in pair]),
        "base radius": (1e6, "µm", [one.base_radius for one in pair]),
        "tip radius": (1e6, "µm", [one.tip_radius for one in pair]),
        "modulus": (1e-9, "GPa", [one.youngs_modulus for one in pair]),
    }
    found = [
        f"{name} {scale * mine:.4g}, not {scale * theirs:.4g} {unit}"
        for name, (scale, unit, (mine, theirs)) in measures.items()
        if abs(mine - theirs) > _OTHER * max(mine, theirs)
    ]
    apart = float(np.linalg.norm(tips[0] - tips[1]))
    found += [f"tip {1e3 * apart:.3g} mm away"] if apart > _OTHER * whisker.length else []
    return ", ".join(found)


def _one_whisker(
    signals: xr.Dataset, found: xr.Dataset, shared: Array | None, *, other_noise: bool
) -> xr.Dataset:
    """Contacts of one whisker in the laboratory, with the status of frames without signals."""
    known = Group(signals)
    names = ("pose_covariance", "pose_wrench_covariance")
    pose = {name: known[name] for name in names if name in known}
    if other_noise:
        # The noise is that of another instrument, without correlation with the pose.
        pose.pop("pose_wrench_covariance", None)
    held = known["base_rotation"], known["base_position"]
    placed = in_laboratory(found, *held, **pose, wrench_shared=shared)
    own = known["status"]
    status = np.where(is_ok(own), placed["status"].values, own).astype(np.int8)
    placed["status"] = placed["status"].copy(data=status)
    placed = with_events(placed, "contact_point", "contact_covariance", held)
    return placed[[name for name in _KEPT if name in placed]]


def in_laboratory(
    contacts: xr.Dataset,
    base_rotation: ArrayLike,
    base_position: ArrayLike,
    pose_covariance: ArrayLike | None = None,
    pose_wrench_covariance: ArrayLike | None = None,
    wrench_shared: Array | None = None,
) -> xr.Dataset:
    """Contacts in the laboratory, chosen among candidates by continuity there.

    Errors of the whisker's shape move them as the force and moment (time, error, 6) would that they
    add to those of the same contact point.
    """
    rotation, position = np.asarray(base_rotation), np.asarray(base_position)
    points = contacts["candidate_points"].values
    lab = to_laboratory(points, rotation[:, None], position[:, None])
    touching = np.flatnonzero(contacts["in_contact"].values)
    chosen = np.full(len(points), -1)
    chosen[touching] = continuing_candidates(lab[touching], touching)
    kept = {
        name: _chosen(contacts[f"candidate_{source}"], chosen).assign_attrs(attributes(name))
        for name, source in (
            ("contact_point_whisker", "points"),
            ("covariance", "covariance"),
            ("arc_length", "arc_length"),
            ("force", "force"),
        )
    }
    rows = np.flatnonzero(chosen >= 0)
    placed = np.full((len(points), 3), np.nan)
    placed[rows] = lab[rows, chosen[rows]]
    normal = _chosen(contacts["candidate_normal"], chosen).values
    normal = np.einsum("tij,tj->ti", rotation, normal)
    gain = _chosen(contacts["candidate_gain"], chosen).values
    wrench = contacts["wrench_covariance"].values
    if wrench_shared is not None:
        wrench = wrench + np.einsum("tei,tej->tij", wrench_shared, wrench_shared)
        moved = -np.einsum("tij,tej->tei", gain[:, :3], wrench_shared)
        own = kept["covariance"]
        kept["covariance"] = own.copy(data=own + np.einsum("tei,tej->tij", moved, moved))
        moved = np.einsum("tij,tej->tei", rotation, moved)
        about = attributes("contact_shared") | _LABORATORY
        kept["contact_shared"] = xr.DataArray(moved, dims=("time", "error", "space"), attrs=about)
    spread = _laboratory_covariance(
        gain,
        wrench,
        rotation,
        placed - position,
        normal,
        None if pose_covariance is None else np.asarray(pose_covariance),
        None if pose_wrench_covariance is None else np.asarray(pose_wrench_covariance),
    )
    squares = {
        "contact_covariance": spread[:, :3, :3],
        "normal_covariance": spread[:, 3:, 3:],
        "point_normal_covariance": spread[:, :3, 3:],
    }
    vectors = {"contact_point": placed, "contact_normal": normal}
    return contacts.assign(kept).assign(
        {name: (_SQUARE, v, attributes(name) | _LABORATORY) for name, v in squares.items()}
        | {name: (_SQUARE[:2], v, attributes(name) | _LABORATORY) for name, v in vectors.items()}
    )


def _laboratory_covariance(
    gain: Array,
    wrench: Array,
    rotation: Array,
    arm: Array,
    normal: Array,
    pose: Array | None,
    pose_wrench: Array | None,
) -> Array:
    """Covariances (n, 6, 6) of contact point and normal in the laboratory.

    An error of the wrench moves both by the gain; one of the pose, a shift and a turn, moves the
    point by shift + turn × arm and the normal by turn × normal.
    """
    turned = np.zeros((len(gain), 6, 6))
    turned[:, :3, :3] = turned[:, 3:, 3:] = rotation
    by_wrench = turned @ gain
    out = by_wrench @ wrench @ np.swapaxes(by_wrench, 1, 2)
    if pose is not None:
        held = np.zeros((len(gain), 6, 6))
        held[:, :3, :3] = np.eye(3)
        held[:, :3, 3:], held[:, 3:, 3:] = -cross_matrix(arm), -cross_matrix(normal)
        out = out + held @ pose @ np.swapaxes(held, 1, 2)
        if pose_wrench is not None:
            both = held @ pose_wrench @ np.swapaxes(by_wrench, 1, 2)
            out = out + both + np.swapaxes(both, 1, 2)
    return np.asarray(out)


def swept_recording(
    sensor: SuspendedWhisker, sweep: StageSweep, found: SweptContacts
) -> xr.DataTree:
    """Recording of a sweep with a suspended whisker, with its contacts as estimates.

    Its time is the number of the sample, and it has the errors that contacts share.
    """
    pose, n, on = sensor.whisker.pose, len(found.points), found.in_contact
    held = {
        "in_contact": on,
        "base_position": sweep.position + sweep.rotation @ pose.origin,
        "base_rotation": np.broadcast_to(sweep.rotation @ pose.rotation, (n, 3, 3)),
    }
    normal = found.normal
    across = NORMAL_SIGMA**2 * (np.eye(3) - normal[:, :, None] * normal[:, None, :])
    estimates = {
        "contact_point": found.points,
        "contact_covariance": found.covariance,
        "contact_normal": normal,
        "normal_covariance": across,
        "point_normal_covariance": 0.0 * across,
        "contact_point_whisker": (found.points - held["base_position"]) @ held["base_rotation"][0],
        "arc_length": found.arc_length,
        "in_contact": on,
        "status": np.where(on, int(Status.OK), int(Status.NO_CONTACT)).astype(np.int8),
    }
    shared = {"contact_shared": np.swapaxes(found.shared, 0, 1)}
    root, group = (
        xr.Dataset(
            {name: recorded(name, values) for name, values in given.items()},
            coordinates(np.arange(n, dtype=np.float64), [sensor.whisker.name or "wire"]),
        )
        for given in (held | shared, estimates)
    )
    return recording_tree(root, [sensor.whisker], "swept by a stage", groups={"estimates": group})


def _chosen(candidates: xr.DataArray, chosen: NDArray[np.int64]) -> xr.DataArray:
    """One candidate of each frame; NaN where the number is -1."""
    which = xr.DataArray(np.maximum(chosen, 0), dims="time")
    return candidates.isel(candidate=which).where(xr.DataArray(chosen >= 0, dims="time"))


def contact_columns(contacts: xr.Dataset) -> xr.Dataset:
    """Columns of a table of contacts, whisker's frame."""
    point = contacts["contact_point_whisker"].values
    variance = np.einsum("tii->ti", contacts["covariance"].values)
    values = np.concatenate([point, spherical(point), np.sqrt(variance)], axis=1)
    names = ("x", "y", "z", "r", "theta", "phi", "sigma_x", "sigma_y", "sigma_z")
    columns = {name: ("time", values[:, i], attributes(name)) for i, name in enumerate(names)}
    assumed = np.full(len(values), contacts.attrs["friction"])
    columns["friction"] = ("time", assumed, attributes("friction"))
    table = xr.Dataset(columns, {"time": contacts["time"]}, contacts.attrs)
    if "event" not in contacts:
        contacts = with_events(contacts, "contact_point_whisker", "covariance")
    around = ("arc_length", "last_arc_length", "shift_x", "shift_y", "shift_z")
    kept = ("one_contact", "status", *EVENTS, *(around if "shift_x" in contacts else ()))
    return table.assign({name: contacts[name] for name in kept if name in contacts})
