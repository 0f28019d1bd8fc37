"""Motion of whisker bases: whisking of one whisker or a whole array, and suitable objects.

The laboratory frame has z up; the base is near its origin, the whisker points along x (away from
the head) at azimuth 0, and protraction, which increases the azimuth, moves it toward y (forward):

    x_lab = R x_whisker + o,    R = R_z(azimuth) R_y(−elevation) R_x(roll)

so that the base tangent is (cos el cos az, cos el sin az, sin el). At zero angles the whisker's
intrinsic curvature bends its tip forward; pushed against an object in front of it the whisker is
concave forward, and against an object behind it concave backward.

Elevation and roll change with the azimuth by ratios that depend on the row of the mystacial array
(Knutsen, Biess & Ahissar 2008). Slow drifts of set point, amplitude, elevation and position are
added, each a sum of three sinusoids with random phases, so that the motion is smooth.

All whiskers of an array protract by the same angle, forward on both sides, about their own rest
pose (`vibrissa.whisker.array`), with the ratios of their row. The two sides are mirror images of
each other. The face is not an obstacle to whiskers or objects.

Objects are placed at a share of the whisker's reach. The rotation at which a whisker slips past an
object depends on its shape and taper, and is found by a coarse sweep in each direction, until the
whisker is free again on the other side.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import interpolate
from vibrissa.numerics import Array, numbers, rotation_matrices
from vibrissa.objects import Box, Peg, Plane, Sphere, Surface
from vibrissa.rod import follow_surfaces
from vibrissa.status import Status
from vibrissa.whisker import Whisker, WhiskerArray, angles_of, base_rotation, mirrored

# Change of elevation per azimuth by row (Knutsen et al. 2008).
ELEVATION_PER_AZIMUTH: Mapping[str, float] = MappingProxyType(
    {"A": 0.12, "B": 0.30, "C": 0.30, "D": 0.14, "E": 0.02}
)
# Change of roll about the base tangent per azimuth by row (Knutsen et al. 2008).
ROLL_PER_AZIMUTH: Mapping[str, float] = MappingProxyType(
    {"A": -0.76, "B": -0.25, "C": 0.22, "D": 0.43, "E": 0.73}
)
# Frequencies of the slow drifts, Hz; their common period is far longer than a trial.
_DRIFT = np.array([0.31, 0.57, 0.93])


@dataclass(frozen=True, eq=False, repr=False)
class Motion:
    """Pose of the base over time.

    Parameters
    ----------
    time : array (n,)
        Times of the frames, s, strictly increasing.
    azimuth, elevation, roll : array (n,)
        Angles of the base, rad, as defined in the module; relative to the head if it rotates.
    base_position : array (n, 3)
        Position of the base in the laboratory frame, m.
    head_rotation : array (n, 3, 3), optional
        Rotation from the head frame to the laboratory frame, if the head rotates.
    head_position : array (n, 3), optional
        Origin of the head frame in the laboratory frame, m, if the head moves.
    """

    time: Array
    azimuth: Array
    elevation: Array
    roll: Array
    base_position: Array
    head_rotation: Array | None = None
    head_position: Array | None = None

    def __post_init__(self) -> None:
        n = np.size(self.time)
        faults = []
        shapes = {"base_position": (n, 3), "head_position": (n, 3), "head_rotation": (n, 3, 3)}
        for name in ("time", "azimuth", "elevation", "roll", *shapes):
            if getattr(self, name) is None and name.startswith("head"):
                continue
            values = numbers(name, getattr(self, name))
            shape = shapes.get(name, (n,))
            if values.shape != shape:
                faults.append(f"{name} has shape {values.shape}; {shape} is needed")
            elif not np.isfinite(values).all():
                faults.append(f"{name} has values that are not finite")
            elif len(shape) == 1 and name != "time" and (np.abs(values) > 2.0 * np.pi).any():
                largest = np.abs(values).max()
                faults.append(f"{name} is an angle in rad; got {largest:g}, as of degrees")
            object.__setattr__(self, name, values)
        if not faults and (np.diff(self.time) <= 0.0).any():
            faults.append("time does not increase")
        if faults:
            raise ValueError("the motion is not valid: " + "; ".join(faults))

    def __repr__(self) -> str:
        span = float(np.ptp(self.time)) if np.size(self.time) else 0.0
        return f"<Motion of {np.size(self.time)} frames, {span:.4g} s>"

    @property
    def base_rotation(self) -> Array:
        """Rotations (n, 3, 3) from the whisker frame to the laboratory frame."""
        on_head = base_rotation(self.azimuth, self.elevation, self.roll)
        return on_head if self.head_rotation is None else self.head_rotation @ on_head

    def on_head(self, rotation: ArrayLike, position: ArrayLike) -> Motion:
        """Combine this motion, relative to the head, with a motion of the head.

        Parameters
        ----------
        rotation : array_like (n, 3, 3) or (3, 3)
            Rotation from the head frame to the laboratory frame.
        position : array_like (n, 3) or (3,)
            Origin of the head frame in the laboratory frame, m.

        Returns
        -------
        Motion
            Combined motion.
        """
        if self.head_rotation is not None:
            raise ValueError("this motion already includes a motion of the head")
        n = len(self)
        turn = np.array(np.broadcast_to(rotation_matrices("rotation", rotation), (n, 3, 3)))
        shift = np.array(np.broadcast_to(np.asarray(position, dtype=np.float64), (n, 3)))
        if not np.isfinite(turn).all():
            raise ValueError("the head's rotation is not known in every frame")
        base = np.einsum("nij,nj->ni", turn, self.base_position) + shift
        return replace(self, base_position=base, head_rotation=turn, head_position=shift)

    def __len__(self) -> int:
        return int(self.time.size)


def whisking(
    duration: float = 3.0,
    rate: float = 1000.0,
    *,
    frequency: float = 5.0,
    amplitude: float = np.radians(30.0),
    set_point: float = 0.0,
    protraction: float = 0.5,
    row: str = "C",
    elevation: float = 0.0,
    elevation_per_azimuth: float | None = None,
    roll_per_azimuth: float | None = None,
    variation: float = 0.05,
    elevation_drift: float = np.radians(4.0),
    position_drift: float = 1e-3,
    seed: int = 0,
) -> Motion:
    """Simulate whisking: sweeps back and forth with slow drifts.

    Parameters
    ----------
    duration : float
        Duration of the trial, s.
    rate : float
        Frame rate, Hz.
    frequency : float
        Frequency of whisking, Hz.
    amplitude : float
        Half the range of a sweep, rad; the trial begins at the rear end of a sweep.
    set_point : float
        Azimuth in the middle of the sweep, rad.
    protraction : float
        Protraction's share of a whisk, from 0.3 to 0.7; above one half retraction is faster.
    row : {"A", "B", "C", "D", "E"}
        Row of the array, which sets the default ratios of elevation and roll to azimuth.
    elevation : float
        Elevation at the set point, rad.
    elevation_per_azimuth, roll_per_azimuth : float
        Ratios of elevation and roll to the azimuth from the set point; by default those of the row.
    variation : float
        Largest drift of amplitude and of set point, as a share of the amplitude.
    elevation_drift : float
        Largest drift of the elevation, rad.
    position_drift : float
        Largest drift of the base along each axis of the laboratory frame, m.
    seed : int
        Seed of the drifts.

    Returns
    -------
    Motion
        Motion with frames at 0, 1/rate, … below ``duration``.

    Examples
    --------
    >>> len(whisking(duration=1.0, rate=500.0))
    500
    """
    numbers = {"duration": duration, "rate": rate, "frequency": frequency}
    faults = [
        f"{name} is {value!r}; it must be positive"
        for name, value in numbers.items()
        if not (np.isfinite(value) and value > 0.0)
    ]
    if not faults and round(duration * rate) < 2:
        faults.append(f"{duration} s at {rate} frames/s are fewer than two frames")
    if not faults and 2.0 * frequency > rate:
        faults.append(f"{frequency:g} whisks/s are more than {rate:g} frames/s can show")
    if row not in ROLL_PER_AZIMUTH:
        faults.append(f"row is {row!r}; one of {', '.join(ROLL_PER_AZIMUTH)} is needed")
    if not 0.3 <= protraction <= 0.7:
        faults.append(f"protraction is {protraction!r}; a share from 0.3 to 0.7 is needed")
    if faults:
        raise ValueError("the whisking is not valid: " + "; ".join(faults))
    if elevation_per_azimuth is None:
        elevation_per_azimuth = ELEVATION_PER_AZIMUTH[row]
    if roll_per_azimuth is None:
        roll_per_azimuth = ROLL_PER_AZIMUTH[row]
    time = np.arange(round(duration * rate)) / rate
    drifts = _drifts(time, 6, seed)
    size = amplitude * (1.0 + variation * drifts[0])
    phase = 2.0 * np.pi * frequency * time
    # Turning points are where the warped phase is a multiple of π.
    forward = 2.0 * np.pi * protraction
    phase = phase + (np.pi - forward) / (1.0 - np.cos(forward)) * (1.0 - np.cos(phase))
    offset = amplitude * variation * drifts[1] - size * np.cos(phase)
    return Motion(
        time=time,
        azimuth=set_point + offset,
        elevation=elevation + elevation_per_azimuth * offset + elevation_drift * drifts[2],
        roll=roll_per_azimuth * offset,
        base_position=position_drift * drifts[3:].T,
    )


def tabulated(
    time: ArrayLike,
    azimuth: ArrayLike,
    elevation: ArrayLike = 0.0,
    roll: ArrayLike = 0.0,
    base_position: ArrayLike = (0.0, 0.0, 0.0),
    *,
    rate: float = 1000.0,
) -> Motion:
    """Interpolate the rows of a table smoothly to a motion.

    Parameters
    ----------
    time : array_like (m,)
        Times of the rows, s, strictly increasing.
    azimuth, elevation, roll : array_like (m,) or ()
        Angles of the base, rad.
    base_position : array_like (m, 3) or (3,)
        Position of the base in the laboratory frame, m.
    rate : float
        Frame rate, Hz.

    Returns
    -------
    Motion
        Motion with frames from the first to the last time at intervals of 1/rate, interpolated by
        cubic splines.

    Examples
    --------
    >>> len(tabulated([0.0, 0.05, 0.1], [0.0, 0.5, 0.0], rate=500.0))
    51
    """
    rows = numbers("time", time)
    angles = {"azimuth": azimuth, "elevation": elevation, "roll": roll}
    values = {}
    for name, column in angles.items():
        column = numbers(name, column)
        values[name] = np.full(rows.shape, column) if column.ndim == 0 else column
    place = np.asarray(base_position, dtype=np.float64)
    values["base_position"] = np.tile(place, (rows.size, 1)) if place.shape == (3,) else place
    table = Motion(time=rows, **values)
    count = int(np.floor((rows[-1] - rows[0]) * rate * (1.0 + 1e-12))) + 1 if rows.size else 0
    if not rate > 0.0 or count < 2:
        raise ValueError(f"{rows.size} rows at {rate} frames/s give fewer than two frames")
    frames = rows[0] + np.arange(count) / rate
    smooth = {
        name: interpolate.CubicSpline(rows, column)(frames)
        for name, column in ((name, getattr(table, name)) for name in values)
    }
    return Motion(time=frames, **smooth)


def array_whisking(
    array: WhiskerArray,
    duration: float = 0.5,
    rate: float = 1000.0,
    *,
    head_rotation: ArrayLike | None = None,
    head_position: ArrayLike | None = None,
    **motion: Any,
) -> dict[str, Motion]:
    """Simulate whisking of all whiskers of an array.

    Parameters
    ----------
    array : WhiskerArray
        Whiskers of the face.
    duration : float
        Duration of the trial, s.
    rate : float
        Frame rate, Hz.
    head_rotation : array_like (n, 3, 3) or (3, 3), optional
        Rotation from the head frame to the laboratory frame; by default the identity.
    head_position : array_like (n, 3) or (3,), optional
        Position of the snout in the laboratory frame, m; by default its origin.
    **motion
        Other parameters of `whisking`, except ``row`` and the ratios, which are those of each row.

    Returns
    -------
    dict of str to Motion
        Motion of each whisker, n frames, by its name.

    Examples
    --------
    >>> from vibrissa import whisker_array
    >>> sorted(array_whisking(whisker_array("left", rows="C", columns=[1, 2]), duration=0.1))
    ['LC1', 'LC2']
    """
    common = shared_whisking(duration, rate, **motion)
    return protracted(array, common, head_rotation, head_position)


def shared_whisking(
    duration: float = 0.5,
    rate: float = 1000.0,
    *,
    frequency: float = 8.0,
    amplitude: float = np.radians(25.0),
    set_point: float = np.radians(25.0),
    position_drift: float = 0.0,
    **motion: Any,
) -> Motion:
    """Whisking shared by all whiskers of an array; angles are relative to the rest pose."""
    return whisking(
        duration,
        rate,
        frequency=frequency,
        amplitude=amplitude,
        set_point=set_point,
        position_drift=position_drift,
        elevation_per_azimuth=0.0,
        roll_per_azimuth=0.0,
        **motion,
    )


def protracted(
    array: WhiskerArray,
    motion: Motion,
    head_rotation: ArrayLike | None = None,
    head_position: ArrayLike | None = None,
) -> dict[str, Motion]:
    """Motions of all whiskers of an array for one shared protraction.

    The azimuth of ``motion`` is the protraction from each whisker's rest pose; elevation and roll
    follow by the ratios of its row. The elevation, roll and displacement of ``motion``, those of
    the right side and mirrored for the left, are added.
    """
    turn = np.eye(3) if head_rotation is None else head_rotation
    shift = np.zeros(3) if head_position is None else head_position
    flat = np.array([-1.0, 1.0, 1.0])
    moves = {}
    for name, whisker in array.items():
        identity = array.identity(name)
        left = identity.side == "left"
        rest = angles_of(whisker.pose.rotation)
        # On the left side, angles are those of the mirror image and are mirrored back at the end.
        azimuth, elevation, roll = mirrored(rest) if left else rest
        angles = np.stack(
            [
                azimuth + motion.azimuth,
                elevation + ELEVATION_PER_AZIMUTH[identity.row] * motion.azimuth + motion.elevation,
                roll + ROLL_PER_AZIMUTH[identity.row] * motion.azimuth + motion.roll,
            ],
            axis=-1,
        )
        azimuth, elevation, roll = (mirrored(angles) if left else angles).T
        place = whisker.pose.origin + motion.base_position * (flat if left else 1.0)
        moves[name] = Motion(motion.time, azimuth, elevation, roll, place).on_head(turn, shift)
    return moves


def head_path(
    time: ArrayLike,
    position: ArrayLike = (0.0, 0.0, 0.0),
    angles: ArrayLike = (0.0, 0.0, 0.0),
    *,
    to_position: ArrayLike | None = None,
    to_angles: ArrayLike | None = None,
) -> tuple[Array, Array]:
    """Smooth path of a head from one pose to another, starting and ending at rest.

    Parameters
    ----------
    time : array_like (n,)
        Times of the frames, s.
    position : array_like (3,)
        Initial position of the snout, laboratory frame, m.
    angles : array_like (3,)
        Initial angles of the head, rad: azimuth turns it to its left, elevation raises its right
        side, roll raises its snout (`base_rotation`).
    to_position, to_angles : array_like (3,), optional
        Final position and angles; by default the initial ones.

    Returns
    -------
    tuple of array (n, 3, 3) and array (n, 3)
        Rotations from the head frame to the laboratory frame, and positions of the snout, m.
    """
    t = np.asarray(time, dtype=np.float64)
    share = (t - t[0]) / (t[-1] - t[0])
    # Minimum-jerk path.
    share = (share**3 * (10.0 - 15.0 * share + 6.0 * share**2))[:, None]
    ends = [(position, to_position), (angles, to_angles)]
    place, turned = (
        np.asarray(a) + share * (np.asarray(a if b is None else b) - np.asarray(a)) for a, b in ends
    )
    return base_rotation(*turned.T), place


def _drifts(time: Array, count: int, seed: int) -> Array:
    """Slow random functions (count, n) of time (n,), s, with values within ±1."""
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (count, _DRIFT.size))
    angles = 2.0 * np.pi * _DRIFT[:, None] * time + phases[..., None]
    return np.asarray(np.sin(angles).mean(axis=1))


PEG_RADIUS = 1.35e-3  # half the diameter of the paper's peg, m
_STEP = np.radians(1.5)  # step of the coarse sweep
_FARTHEST = np.radians(120.0)  # largest angle of the coarse sweep
_MARGIN = np.radians(5.0)  # margin beyond the angle at which the whisker slips


def facing_peg(whisker: Whisker, distance: float = 0.65, radius: float = PEG_RADIUS) -> Peg:
    """Vertical peg near the head, within reach of a whisker.

    Parameters
    ----------
    whisker : Whisker
        Whisker that should be able to touch the peg.
    distance : float
        Distance from the base to the peg's axis, as a share of the largest distance of the resting
        whisker from its base.
    radius : float
        Radius of the peg, m.

    Returns
    -------
    Peg
        Peg whose axis crosses the x axis of the laboratory frame.

    Raises
    ------
    ValueError
        If the distance is not in (0, 1), or the base would be too close to the peg.
    """
    if not 0.0 < distance < 1.0:
        raise ValueError(f"distance is {distance!r}; a share of the reach, in (0, 1), is needed")
    reach = float(np.linalg.norm(whisker.centerline(401), axis=1).max())
    if distance * reach < 1.5 * radius:
        raise ValueError(
            f"a peg of radius {radius * 1e3:.2f} mm at {distance * reach * 1e3:.2f} mm from the "
            f"base leaves no room for the whisker, which reaches {reach * 1e3:.2f} mm: choose a "
            "thinner peg or a larger distance"
        )
    return Peg(np.array([distance * reach, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), radius)


def within_reach(whisker: Whisker | WhiskerArray, kind: str | None = None) -> Surface:
    """Object within reach of a whisker, or of the whiskers of an array.

    Parameters
    ----------
    whisker : Whisker or WhiskerArray
        Whisker or whiskers that should be able to touch the object.
    kind : {"peg", "sphere", "box", "plane"}, optional
        Kind of the object; by default a peg for a whisker, and a sphere for an array.

    Returns
    -------
    Peg, Sphere, Box or Plane
        Object near the base of a whisker. For an array, the object is in front of the right side of
        a face at the origin of the laboratory frame, and whiskers at rest do not reach it until the
        head moves forward by 14 mm (a plane is perpendicular to this path).
    """
    things: dict[str, Surface]
    if isinstance(whisker, Whisker):
        reach = float(np.linalg.norm(whisker.centerline(401), axis=1).max())
        place = np.array([0.65 * reach, 0.0, 0.0])
        things = {
            "peg": facing_peg(whisker),
            "sphere": Sphere(place, 0.12 * reach),
            "box": Box(place, np.full(3, 0.2 * reach), edge_radius=0.02 * reach),
            "plane": Plane(np.array([0.0, 0.3 * reach, 0.0]), np.array([0.0, -1.0, 0.0])),
        }
    else:
        ahead = 1e-3 * np.array([22.0, 28.0, -10.0])
        things = {
            "sphere": Sphere(ahead, 15e-3),
            "peg": Peg(1e-3 * np.array([20.0, 22.0, 0.0]), np.array([0.0, 0.0, 1.0]), PEG_RADIUS),
            "box": Box(ahead, 1e-3 * np.array([24.0, 20.0, 24.0]), edge_radius=1e-3),
            "plane": Plane(np.array([0.0, 24e-3, 0.0]), np.array([0.0, -1.0, 0.0])),
        }
    chosen = next(iter(things)) if kind is None else kind
    if chosen not in things:
        raise ValueError(
            f"the object is of kind {kind!r}; one of {', '.join(things)} is needed (a mesh must be "
            "described in the trial's script)"
        )
    return things[chosen]


def sweep_past(
    whisker: Whisker,
    thing: Peg | Sphere | Box,
    duration: float = 3.0,
    rate: float = 1000.0,
    *,
    row: str = "C",
    seed: int = 0,
    **motion: Any,
) -> Motion:
    """Whisking in which the whisker slips past an object, forward and back.

    Parameters
    ----------
    whisker : Whisker
        Whisker to move.
    thing : Peg, Sphere or Box
        Object near the whisker; a peg should be approximately vertical.
    duration : float
        Duration of the trial, s.
    rate : float
        Frame rate, Hz.
    row : {"A", "B", "C", "D", "E"}
        Row of the array, which sets the default ratios of elevation and roll to azimuth.
    seed : int
        Seed of the drifts.
    **motion
        Other parameters of `whisking`.

    Returns
    -------
    Motion
        Motion whose set point and amplitude make the whisker slip off both sides of the object.

    Raises
    ------
    ValueError
        If the row is unknown, the whisker does not touch the object, or it does not slip past it
        within 120°.
    """
    if row not in ROLL_PER_AZIMUTH:
        raise ValueError(f"row is {row!r}; one of {', '.join(ROLL_PER_AZIMUTH)} is needed")
    motion.setdefault("elevation_per_azimuth", ELEVATION_PER_AZIMUTH[row])
    motion.setdefault("roll_per_azimuth", ROLL_PER_AZIMUTH[row])
    motion.setdefault("variation", 0.05)
    motion.setdefault("position_drift", 0.03 * whisker.length)
    ratios = motion["elevation_per_azimuth"], motion["roll_per_azimuth"]
    rear = _slip(whisker, thing, -1.0, ratios) - _MARGIN
    front = _slip(whisker, thing, 1.0, ratios) + _MARGIN
    # The whisker must slip in spite of drifts of set point and amplitude.
    amplitude = 0.5 * (front - rear) * (1.0 + 2.0 * motion["variation"])
    motion.setdefault("amplitude", amplitude)
    motion.setdefault("set_point", 0.5 * (front + rear))
    return whisking(duration, rate, seed=seed, **motion)


def _toward(whisker: Whisker, thing: Peg | Sphere | Box) -> float:
    """Azimuth of the base at which the resting whisker would pass through an object, rad."""
    points = whisker.centerline(801)
    distance = np.hypot(*thing.origin[:2])
    near = np.abs(np.hypot(points[:, 0], points[:, 1]) - distance)
    # If the whisker curls back to the same distance, the part nearer to the base is used.
    i = int(np.argmax(near <= near.min() + 1e-3 * whisker.length))
    there = np.arctan2(thing.origin[1], thing.origin[0])
    return float(there - np.arctan2(points[i, 1], points[i, 0]))


def _slip(
    whisker: Whisker, thing: Peg | Sphere | Box, sense: float, ratios: tuple[float, float]
) -> float:
    """Azimuth at which the whisker slips past an object in a forward (1) or backward (−1) sweep."""
    middle = _toward(whisker, thing)
    turned = np.arange(-0.5 * _FARTHEST, _FARTHEST, _STEP) * sense
    rotations = base_rotation(middle + turned, ratios[0] * turned, ratios[1] * turned)
    bent = follow_surfaces(whisker, [thing], rotations, np.zeros((turned.size, 3))).bent
    touching = np.isin(bent.status, (Status.OK, Status.TIP_CONTACT))
    if not touching.any():
        raise ValueError(f"{whisker} does not meet {thing}")
    first = int(np.argmax(touching))
    past = np.flatnonzero(~touching[first:])
    if not past.size:
        degrees = np.degrees(_FARTHEST)
        raise ValueError(f"{whisker} does not slip past {thing} within {degrees:.0f}°")
    status = Status(int(bent.status[first + past[0]]))
    if status in (Status.NOT_CONVERGED, Status.TOO_PROXIMAL):
        raise ValueError(f"the sweep past {thing} cannot be planned: {status}")
    return float(middle + turned[first + past[0]])
