"""Simulation of trials, and of sensor readings.

By default the simulation is quasi-static. Each frame continues the previous one: the objects,
relative to the base, move a little, and the contact sticks or slides on the stable branch of
equilibria (:mod:`vibrissa.rod.surfaces`). Where that branch ends, the whisker slips off and springs
back to rest, free of the object (or against it, if it obstructs the rest shape), and next meets the
object from that side. A whisker is therefore never pulled through a peg.

The simulated contact is with the object touched first. Where the bent whisker would penetrate
another object, or the same one elsewhere, ``second_contact`` is true. Without friction and with
rigid objects, all contacts are then solved (:mod:`vibrissa.rod.around`) and the strongest is
recorded; otherwise the depth of penetration is recorded as ``overlap``, and the wrench lacks the
contribution of the other contacts.

Several whiskers are simulated independently, without contact among them.

With `vibrissa.simulation.dynamics` the whisker has inertia and damping: it collides, vibrates after
a slip, and may have several contacts, of which the strongest is recorded.

`measure` simulates the readings of a sensor at the base.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np
import xarray as xr

from vibrissa.numerics import Array
from vibrissa.objects import Surface, listed_objects
from vibrissa.recording import Recording, coordinates, recorded, recording_tree
from vibrissa.rod import SurfaceDeflection, around, check_objects, follow_surfaces
from vibrissa.sensors import COMPONENTS, FORCE_NOISE, MOMENT_NOISE, Sensor, component_noise
from vibrissa.simulation.dynamics import Dynamics, Moment, move_dynamically
from vibrissa.simulation.motion import Motion
from vibrissa.status import Status
from vibrissa.whisker import Whisker

_ROUGHEST = 5.0  # largest coefficient of friction; a larger value is taken for an angle in degrees

NODES = 33  # number of points of the recorded centrelines

Progress = Callable[[int, int], None]
"""Function called with the number of frames done and the total number."""

T = TypeVar("T")
Whiskers = Whisker | Sequence[Whisker] | Mapping[str, Whisker]
Motions = Motion | Sequence[Motion] | Mapping[str, Motion]


def simulate(
    whisker: Whiskers,
    motion: Motions,
    objects: Surface | Sequence[Surface],
    *,
    friction: float = 0.0,
    dynamics: Dynamics | None = None,
    nodes: int = NODES,
    progress: Progress | None = None,
) -> xr.DataTree:
    """Simulate a trial of one whisker, or of several, among objects.

    Parameters
    ----------
    whisker : Whisker, sequence or mapping of Whisker
        Whisker or whiskers, such as a `WhiskerArray`.
    motion : Motion, sequence or mapping of Motion
        Motion of each whisker's base, in the same order or by the same names, with the same frames
        and the same motion of the head.
    objects : Peg, Sphere, Plane, Box, Mesh or a sequence of them
        Objects in the laboratory frame. With friction, or if objects are not rigid, only the object
        touched first exerts a force in the quasi-static simulation.
    friction : float
        Coefficient of Coulomb friction between whisker and objects.
    dynamics : Dynamics, optional
        Inertia and damping; by default the simulation is quasi-static.
    nodes : int
        Number of points of the recorded centrelines, equally spaced in arc length.
    progress : callable, optional
        Function called after every frame of every whisker with the number of frames done and the
        total number.

    Returns
    -------
    xarray.DataTree
        Recording (`vibrissa.recording`) with the noise-free force and moment at the base, the pose
        of the base, and all other variables in the group ``truth``.
    """
    pairs = _pairs(whisker, motion)
    solids = listed_objects(objects)
    if not 0.0 <= friction <= _ROUGHEST:
        raise ValueError(
            f"friction is {friction!r}; a coefficient from 0 to {_ROUGHEST:g} is needed"
        )
    for one, moves in pairs:
        check_objects(one, solids, moves.base_position)
    touch = "frictionless" if friction == 0.0 else f"friction {friction:g}"
    how = "quasi-static"
    if dynamics is not None:
        how = f"with inertia, damping ratio {dynamics.damping_ratio:g}"
    truths: list[dict[str, Array]] = []
    for one, moves in pairs:
        before, total = len(truths) * len(moves), len(pairs) * len(moves)

        def counted(done: int, _: int, before: int = before, total: int = total) -> None:
            if progress is not None:
                progress(before + done, total)

        if dynamics is not None:
            moments = move_dynamically(
                one, solids, moves, dynamics, friction=friction, progress=counted
            )
            truths.append(_dynamic_truth(one, moves, moments, nodes))
            continue
        found = follow_surfaces(
            one,
            solids,
            moves.base_rotation,
            moves.base_position,
            friction=friction,
            progress=counted,
        )
        truths.append(_truth(one, moves, solids, found, friction, nodes))
    whiskers, motions = zip(*pairs, strict=True)
    return _recording(whiskers, motions, solids, truths, f"simulated: {how}, {touch}")


def _recording(
    whiskers: Sequence[Whisker],
    motions: Sequence[Motion],
    solids: Sequence[Surface],
    truths: Sequence[Mapping[str, Array]],
    origin: str,
) -> xr.DataTree:
    """Assemble a recording of a simulated trial."""
    pose = {
        "base_position": [motion.base_position for motion in motions],
        "base_rotation": [motion.base_rotation for motion in motions],
        "base_azimuth": [motion.azimuth for motion in motions],
        "base_elevation": [motion.elevation for motion in motions],
        "base_roll": [motion.roll for motion in motions],
    }
    truth = {
        name: recorded(name, np.stack([one[name] for one in truths], axis=1)) for name in truths[0]
    }
    known = {name: recorded(name, np.stack(values, axis=1)) for name, values in pose.items()}
    known |= {name: truth[name].copy() for name in ("force", "moment")}
    first = motions[0]
    head = {"head_position": first.head_position, "head_rotation": first.head_rotation}
    known |= {name: recorded(name, array) for name, array in head.items() if array is not None}
    return recording_tree(
        xr.Dataset(known, coordinates(first.time, [whisker.name for whisker in whiskers])),
        whiskers,
        origin,
        groups={"truth": xr.Dataset(truth)},
        objects=solids,
    )


def _pairs(whisker: Whiskers, motion: Motions) -> list[tuple[Whisker, Motion]]:
    """Pair whiskers with their motions, and check that these match."""
    if isinstance(whisker, Mapping) and isinstance(motion, Mapping):
        if missing := [name for name in whisker if name not in motion]:
            raise ValueError(f"there is no motion of {', '.join(missing)}")
        motion = [motion[name] for name in whisker]
    whiskers = [whisker] if isinstance(whisker, Whisker) else _listed(whisker)
    motions = [motion] if isinstance(motion, Motion) else _listed(motion)
    if not whiskers or len(whiskers) != len(motions):
        raise ValueError(
            f"there are {len(whiskers)} whiskers and {len(motions)} motions; one motion per "
            "whisker, and at least one whisker, is needed"
        )
    names = [one.name for one in whiskers]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"several whiskers are called {', '.join(twice)}; names must differ")
    first = motions[0]
    for name, other in zip(names, motions, strict=True):
        for what in ("time", "head_rotation", "head_position"):
            if not np.array_equal(getattr(first, what), getattr(other, what)):
                raise ValueError(f"the motions of {names[0]} and {name} differ in {what}")
    return list(zip(whiskers, motions, strict=True))


def _listed(things: Sequence[T] | Mapping[str, T]) -> list[T]:
    """List of the items of a sequence or the values of a mapping."""
    return list(things.values() if isinstance(things, Mapping) else things)


def _truth(
    whisker: Whisker,
    motion: Motion,
    solids: Sequence[Surface],
    found: SurfaceDeflection,
    friction: float,
    nodes: int,
) -> dict[str, Array]:
    """Variables of the group ``truth`` of a quasi-static simulation."""
    rotation, position = motion.base_rotation, motion.base_position
    solvable = friction == 0.0 and all(np.isinf(solid.stiffness) for solid in solids)
    bent = around(whisker, solids, rotation, position, found, several=solvable)
    turn = "tij,t...j->t...i"
    arc, point, push, surface = bent.strongest()
    contact, several = np.isfinite(arc), bent.several
    touched = np.einsum(turn, rotation, point) + position
    push = np.einsum(turn, rotation, push)
    normal, surface_point = found.normal.copy(), found.surface_point.copy()
    normal[several] = push[several] / np.linalg.norm(push[several], axis=1, keepdims=True)
    away = whisker.radius(arc[several])[:, None] * normal[several]
    surface_point[several] = touched[several] - away
    return {
        "force": bent.force,
        "moment": bent.moment,
        "centerline": bent.centerline(nodes) @ np.swapaxes(rotation, 1, 2) + position[:, None],
        "contact_point": touched,
        "contact_point_whisker": point,
        "arc_length": arc,
        "in_contact": contact,
        "confidence": np.isin(bent.status, [s for s in Status if s.ok]).astype(np.float64),
        "status": bent.status.astype(np.int8),
        "contact_force": push,
        "contact_object": surface.astype(np.int16),
        "surface_point": surface_point,
        "surface_normal": normal,
        "sliding": found.sliding | (several & contact),
        "overlap": bent.overlap,
        "second_contact": bent.second_contact,
    }


def _dynamic_truth(
    whisker: Whisker, motion: Motion, moments: Sequence[Moment], nodes: int
) -> dict[str, Array]:
    """Variables of the group ``truth`` of a dynamic simulation."""
    rotation, position = motion.base_rotation, motion.base_position
    n = len(moments)
    truth = {
        name: np.full((n, 3), np.nan)
        for name in ("contact_point", "contact_force", "surface_point", "surface_normal")
    }
    arc_length, surface = np.full(n, np.nan), np.full(n, -1, dtype=np.int16)
    second, status = np.zeros(n, dtype=bool), np.full(n, int(Status.NO_CONTACT), dtype=np.int8)
    for i, moment in enumerate(moments):
        if not moment.contacts:
            continue
        first = moment.contacts[0]
        arc_length[i], surface[i] = first.arc_length, first.surface
        truth["contact_point"][i], truth["surface_normal"][i] = first.point, first.normal
        truth["contact_force"][i] = moment.contact_force
        away = first.gap + float(whisker.radius(first.arc_length))
        truth["surface_point"][i] = first.point - away * first.normal
        second[i] = len(moment.contacts) > 1
        at_tip = first.arc_length >= whisker.length * (1.0 - 1e-9)
        status[i] = int(Status.TIP_CONTACT if at_tip else Status.OK)
    to_whisker = "tji,tj->ti"
    return truth | {
        "force": np.einsum(to_whisker, rotation, np.array([m.force for m in moments])),
        "moment": np.einsum(to_whisker, rotation, np.array([m.moment for m in moments])),
        "centerline": np.array([m.centerline(nodes) for m in moments]),
        "contact_point_whisker": np.einsum(to_whisker, rotation, truth["contact_point"] - position),
        "arc_length": arc_length,
        "in_contact": surface >= 0,
        "confidence": np.ones(n),
        "status": status,
        "contact_object": surface,
        "sliding": np.array([m.sliding for m in moments]),
        "overlap": np.zeros(n),
        "second_contact": second,
    }


def measure(
    recording: xr.DataTree,
    force_noise: float = FORCE_NOISE,
    moment_noise: float = MOMENT_NOISE,
    seed: int = 0,
    *,
    sensor: Sensor | None = None,
) -> xr.DataTree:
    """Simulate the readings of a sensor at the base in a simulated trial.

    Parameters
    ----------
    recording : xarray.DataTree
        Recording with ``force`` and ``moment`` in the group ``truth``.
    force_noise : float
        Standard deviation of white Gaussian noise in each component of the force, N.
    moment_noise : float
        Standard deviation of white Gaussian noise in each component of the moment, N·m.
    seed : int
        Seed of the noise.
    sensor : Sensor, optional
        Sensor to use instead of one with this white noise only.

    Returns
    -------
    xarray.DataTree
        New recording whose ``force`` and ``moment`` in the root are the sensor's readings, with
        their noise in the attribute ``noise``. Missing frames stay missing. For a sensor with other
        channels, ``reading`` and ``mixing`` replace them.
    """
    names = ("force", "moment")
    truth = Recording(recording).find("truth")
    if truth is None or not all(name in truth for name in names):
        raise ValueError("the recording has no true force and moment, which a sensor would measure")
    if sensor is None:
        sensor = Sensor(noise=np.sqrt(np.diag(component_noise(force_noise, moment_noise))))
    wrench = np.concatenate([truth[name] for name in names], axis=-1)
    time = np.asarray(recording.to_dataset()["time"].values, dtype=np.float64)
    # One sensor per whisker, with independent noise.
    readings = [sensor.read(time, wrench[:, i], seed + i) for i in range(wrench.shape[1])]
    reading = np.stack(readings, axis=1)
    measured = recording.copy()
    if sensor.reads_wrench:
        parts = {"force": slice(0, 3), "moment": slice(3, 6)}
        rows = {name: recorded(name, reading[..., part]) for name, part in parts.items()}
        for name, part in parts.items():
            rows[name].attrs["noise"] = _one(sensor.noise[part])
        measured.dataset = recording.to_dataset().assign(rows)
        return measured
    channels = recorded("reading", reading)
    channels.attrs["noise"] = np.asarray(sensor.noise)
    dataset = recording.to_dataset().drop_vars(names, errors="ignore")
    measured.dataset = dataset.assign(
        reading=channels, mixing=recorded("mixing", sensor.mixing)
    ).assign_coords(channel=list(sensor.channels), component=list(COMPONENTS))
    return measured


def _one(values: Array) -> float | Array:
    """The first value if all are equal, otherwise all values."""
    return float(values[0]) if (values == values[0]).all() else values
