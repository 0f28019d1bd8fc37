"""Contact estimates of every frame and whisker of a recording.

Contacts are estimated in the whisker frame and transformed to the laboratory frame, where
continuity in time selects among several candidates.
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
from vibrissa.numerics import Array, contacts_in, cross_matrix
from vibrissa.pipeline.checks import signals_in
from vibrissa.pipeline.events import EVENTS, with_events
from vibrissa.pipeline.frames import CHANGE, INERTIA
from vibrissa.pipeline.location import locate, locate_from_wrench, without_contact
from vibrissa.pipeline.signals import sensor_noise
from vibrissa.quantities import attributes
from vibrissa.recording import Group, Recording, coordinates, recorded, recording_tree
from vibrissa.rod import PROXIMAL
from vibrissa.sensors import StageSweep, SuspendedWhisker, SweptContacts
from vibrissa.signals import TRIPLET, selection
from vibrissa.status import Event, Status, is_ok
from vibrissa.whisker import Whisker

Progress = Callable[[str, int, int], None]
"""Function called with the name of the current stage, the steps done and the total steps."""

WHOLE = "wrench"  # value of ``signals`` that selects the full force and moment
# Standard deviation of the normals of swept surfaces, rad: friction across the wire rotates them.
NORMAL_SIGMA = 0.1
_OTHER = 0.01  # largest relative difference between the whiskers of a map and of a recording
_LABORATORY = {"reference_frame": "laboratory"}
_SQUARE = ("time", "space", "space_2")

_KEPT = (
    "contact_point",
    "contact_covariance",
    "contact_shared",
    "contact_normal",
    "normal_covariance",
    "point_normal_covariance",
    "contact_tangent",
    "contact_inertia",
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
        Three or more of the six signals, or "wrench" for the full force and moment, which allows
        for friction. The default is `TRIPLET`, or "wrench" for signals of the fitted rod, whose
        friction is not zero.
    noise : array_like (6, 6), optional
        Covariance of (F, M), SI units; by default that stored with the signals. Sensor signals
        require one of the two; for other signals without noise there are no covariances.
    contact_maps : sequence of ContactMap, optional
        Contact map of each whisker; by default maps are simulated for whiskers with a contact.
    whiskers : sequence of Whisker, optional
        Whiskers, used if no maps are given; by default those of the recording.
    method : {"exact", "lookup", "lookup-linear", "network"}
        Exact, or one of the paper's methods; see :func:`vibrissa.paper.estimate`.
    errors : mapping of str to float, optional
        Standard deviations ``stiffness_sigma``, ``gain_sigma`` and ``mixing_sigma`` of errors
        common to all frames; see ``ContactMap.estimate``. They require noise.
    prior : Prior, optional
        Prior over contacts; contacts that it excludes are not candidates.
    friction : float
        Standard deviation of the ratio of the force along the whisker to that across it; see
        ``ContactMap.estimate``. The default of 0 stands for frictionless contacts.
    second_contacts : float
        False-alarm rate, such as 0.01, of the test for frames whose full force and moment one
        contact does not explain (`second_contact`); these get the status ``NOT_ONE_CONTACT``.
        The default of 0 disables the test. For "wrench" the test assumes friction ratios of 0.3
        (one sigma), otherwise ``friction``.
    gravity : Gravity, optional
        Gravity under which whiskers of known density bend, laboratory frame; see
        ``ContactMap.estimate``. By default the sensor was tared in the first frame with a pose.
    proximal : float
        Smallest arc length of a contact in simulated maps, as a share of the whisker's length.
    progress : callable, optional
        Function called as ``progress(stage, done, total)``.

    Returns
    -------
    xarray.Dataset
        Group ``estimates`` of a recording, dimensions time, whisker, space. In the laboratory
        frame: ``contact_point`` with ``contact_covariance``, ``contact_normal`` with
        ``normal_covariance``, ``point_normal_covariance``, and ``contact_tangent``, the direction
        of the whisker. In the whisker frame: ``contact_point_whisker`` with ``covariance``,
        ``arc_length`` and ``force``. Also the number of ``candidates``, of which the one most
        continuous in time is selected; ``in_contact``
        (detected) and ``status``; ``event`` (onset, loss or slip) and the time of each contact's
        onset, ``onset_time`` with ``onset_sigma``, s. Attributes: ``signals``, ``source``,
        ``felt_above``, the M_B from which contacts are detected, N·m, and ``friction``, as in
        `vibrissa.contacts.Contacts`. In frames whose signals no contact explains, ``status`` states
        the reason.

    Raises
    ------
    ValueError
        If there are no signals, their noise is unknown, or names or numbers do not match.

    Notes
    -----
    Covariances combine the noise of the signals with that of the base pose. For signals of the
    fitted rod or the tracked contact point both are included, with their correlation; for sensor
    signals the pose covariance is included if a camera supplies it (`placed_by`). Thus an error of
    the pose does not move a tracked contact point, which the same pose transforms there and back,
    but it does rotate the normal.
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
        wrench = one[["force", "moment", *(n for n in CHANGE if n in one)]]
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
    if mapped:  # whiskers without contact have no map, so this stage may not be complete yet
        report("map of all contacts", count, count)
    out = xr.concat(parts, "whisker").transpose("time", "whisker", ...)
    # Other assumptions are stated where they are not the default.
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
    """Whiskers of ``count`` signals: those given, those of the maps, or those of the recording."""
    if given is None:
        given = Recording(recording).whiskers if maps is None else [one.whisker for one in maps]
    for things in (given, maps):
        if things is not None and len(things) != count:
            raise ValueError(f"there are signals of {count} whiskers; {len(things)} are given")
    known = Recording(recording).whiskers if maps and "whiskers" in recording.children else []
    for one, own in zip(maps or (), known, strict=False):
        if others := _differences(one.whisker, own):
            warnings.warn(
                f"the map's whisker differs from the recording's {own.name!r}: {others}",
                stacklevel=3,
            )
    return given


def _differences(whisker: Whisker, other: Whisker) -> str:
    """Describe the properties in which two whiskers differ by more than 1 %; empty if none."""
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
    """Contacts of one whisker in the laboratory frame; frames without signals keep their status."""
    known = Group(signals)
    names = ("pose_covariance", "pose_wrench_covariance")
    pose = {name: known[name] for name in names if name in known}
    if other_noise:
        # Noise given by the caller is that of another instrument, uncorrelated with the pose.
        pose.pop("pose_wrench_covariance", None)
    held = known["base_rotation"], known["base_position"]
    placed = in_laboratory(found, *held, **pose, wrench_shared=shared)
    if INERTIA[0] in known:
        placed = placed.assign(contact_inertia=_by_inertia(placed, known))
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
    """Transform contacts to the laboratory frame, selecting candidates by continuity there.

    ``wrench_shared`` (time, error, 6) is the change of force and moment, for a given contact point,
    by one standard deviation of each error of the whisker's shape. The opposite change of wrench
    moves the estimated contacts.
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
    normal, tangent = (
        np.einsum("tij,tj->ti", rotation, _chosen(contacts[f"candidate_{name}"], chosen).values)
        for name in ("normal", "tangent")
    )
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
    wider = _chosen(contacts["candidate_widening"], chosen).values
    for i in (slice(3), slice(3, 6)):
        for k in (slice(3), slice(3, 6)):
            spread[:, i, k] += rotation @ wider[:, i, k] @ np.swapaxes(rotation, 1, 2)
    squares = {
        "contact_covariance": spread[:, :3, :3],
        "normal_covariance": spread[:, 3:, 3:],
        "point_normal_covariance": spread[:, :3, 3:],
    }
    turned = np.einsum("tij,tajk->taik", rotation, gain.reshape(-1, 2, 3, 6)).reshape(gain.shape)
    kept["gain"] = xr.DataArray(turned, dims=("time", "contact_component", "component"))
    vectors = {"contact_point": placed, "contact_normal": normal, "contact_tangent": tangent}
    return contacts.assign(kept).assign(
        {name: (_SQUARE, v, attributes(name) | _LABORATORY) for name, v in squares.items()}
        | {name: (_SQUARE[:2], v, attributes(name) | _LABORATORY) for name, v in vectors.items()}
    )


def _by_inertia(contacts: xr.Dataset, signals: Group) -> xr.DataArray:
    """Changes of contact points and normals by errors that all corrections for inertia share."""
    rotation, (wrench, change) = signals["base_rotation"], (signals[name] for name in INERTIA)
    # The removed wrench is subtracted, and the change of the contact force is added.
    moved = -np.einsum("tij,tej->tei", contacts["gain"].values, wrench)
    force = contacts["force"].values + signals[CHANGE[0]]
    force, change = (np.einsum("tij,t...j->t...i", rotation, v) for v in (force, change))
    normal, tangent = contacts["contact_normal"].values, contacts["contact_tangent"].values
    turned = np.cross(tangent, normal)
    share = np.einsum("ti,tei->te", turned, change) / (force * normal).sum(axis=1)[:, None]
    moved[..., 3:] += share[..., None] * turned[:, None]
    dims = ("time", "inertia_error", "contact_component")
    return xr.DataArray(moved, dims=dims, attrs=attributes("contact_inertia") | _LABORATORY)


def _laboratory_covariance(
    gain: Array,
    wrench: Array,
    rotation: Array,
    arm: Array,
    normal: Array,
    pose: Array | None,
    pose_wrench: Array | None,
) -> Array:
    """Covariances (n, 6, 6) of contact point and normal in the laboratory frame.

    Wrench errors propagate by the gain. A pose error, a shift and a small rotation, moves the point
    by shift + rotation × arm and the normal by rotation × normal.
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
    """Recording of a sweep with a suspended whisker, its contacts, and errors that they share."""
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
    root["time"].attrs["numbered"] = 1  # rows have no time
    return recording_tree(root, [sensor.whisker], "swept by a stage", groups={"estimates": group})


def _chosen(candidates: xr.DataArray, chosen: NDArray[np.int64]) -> xr.DataArray:
    """Chosen candidate of each frame; NaN where the index is -1."""
    which = xr.DataArray(np.maximum(chosen, 0), dims="time")
    return candidates.isel(candidate=which).where(xr.DataArray(chosen >= 0, dims="time"))


def contact_events(contacts: xr.Dataset) -> xr.Dataset:
    """List contacts with their onset and release.

    Parameters
    ----------
    contacts : xarray.Dataset
        Group ``estimates`` or ``signals`` of a recording, as returned by `estimates_of` or
        `signals_of`. Inertia does not cause spurious contacts in signals made with ``dynamics``.

    Returns
    -------
    xarray.Dataset
        Dataset with the dimension ``contact``, in order of time: name of the ``whisker``, ``onset``
        and ``release``, s, NaN where the recording begins or ends in contact, and
        ``largest_force``, N. For estimates also ``onset_sigma``, s, and the number of ``slips``.
    """
    time, rows = contacts["time"].values, []
    dated = all(name in contacts for name in EVENTS)
    for k, name in enumerate(contacts["whisker"].values):
        one = contacts.isel(whisker=k)
        size = np.linalg.norm(one["force"].values, axis=-1)
        seen = one["status"].values != Status.MISSING if "status" in one else None
        for first, end in contacts_in(one["in_contact"].values.astype(bool), seen):
            onset = time[first] if first else np.nan
            release = time[end] if end < len(time) else np.nan
            row = [first, str(name), onset, release, largest_of(size[first:end])]
            if dated:
                inside = one.isel(time=slice(first, end))
                begun = inside["onset_time"].values[-1]
                row[2] = begun if first and np.isfinite(begun) else onset
                row += [inside["onset_sigma"].values[-1]]
                row += [int((inside["event"].values == Event.SLIP).sum())]
            rows.append(tuple(row))
    rows.sort()
    names = ("onset", "release", "largest_force", *(("onset_sigma", "slips") if dated else ()))
    columns: list[Any] = list(zip(*(row[1:] for row in rows), strict=True)) or [()] * 6
    data: dict[str, Any] = {"whisker": ("contact", list(columns[0]))}
    for name, values in zip(names, columns[1 : len(names) + 1], strict=True):
        data[name] = ("contact", np.array(values), attributes(name))
    return xr.Dataset(data)


def largest_of(sizes: Array) -> float:
    """Largest finite value; NaN if there is none."""
    return float(np.nanmax(sizes)) if np.isfinite(sizes).any() else np.nan
