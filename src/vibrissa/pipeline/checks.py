"""Validation of recordings before each stage, and construction of labelled signal datasets.

Checksums of the inputs of each stage detect later edits of a recording. Each frame and whisker has
its own checksum, which therefore survives selection and reordering.

Exchanged or sign-reversed axes in measured force and moment are detected by two conditions. A
contact at p, with friction or without, gives the moment M = p × F: M is normal to F, and the line
of action of the force meets the bent whisker. If two columns are exchanged, a sign is wrong or the
axes are left-handed, most measurements violate both conditions, and correcting the mistake restores
both. A mistake after which the wrench is still that of a possible contact, such as a rotation of a
straight whisker's axes about x, cannot be detected.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.contacts import rubbing_misfits
from vibrissa.deferred import xr
from vibrissa.io import slow_steps
from vibrissa.numerics import Array, Mask
from vibrissa.pipeline.frames import CHANGE
from vibrissa.quantities import quantity, unit_fault
from vibrissa.recording import VARIABLES, Group, Recording, faults_in, recorded
from vibrissa.signals import base_signals
from vibrissa.whisker import Whisker

EACH = ("time", "whisker")  # dimensions of contacts
# Covariances of the wrench and the pose, and their cross-covariance.
SQUARES = ("wrench_covariance", "pose_covariance", "pose_wrench_covariance")
# Required variables of the group ``signals``.
MEASURED = ("force", "moment", "base_position", "base_rotation", "in_contact", "status")
# Required variables of the group ``estimates``.
ESTIMATED = (
    "contact_point",
    "contact_covariance",
    "contact_normal",
    "normal_covariance",
    "point_normal_covariance",
    "contact_point_whisker",
    "arc_length",
    "in_contact",
    "status",
)


def check_frames(recording: xr.DataTree) -> None:
    """Raise ValueError unless a recording has frames and whiskers."""
    root = recording.to_dataset(inherit=False)
    if missing := [name for name in ("time", "whisker") if name not in root.dims]:
        got = ", ".join(str(name) for name in root.dims) or "none"
        raise ValueError(
            f"the recording lacks the dimensions {', '.join(missing)}; it has {got}: a tracked, "
            "simulated or measured recording is needed (one whisker: isel(whisker=[0]))"
        )
    if not root.sizes["time"] or not root.sizes["whisker"]:
        raise ValueError(
            f"the recording cannot be used: it has {root.sizes['time']} frames of "
            f"{root.sizes['whisker']} whiskers"
        )


def check_recording(recording: xr.DataTree) -> None:
    """Raise ValueError unless a recording has frames and whiskers, and variables of valid shape."""
    check_frames(recording)
    root = recording.to_dataset(inherit=False)
    faults = [*faults_in(root), *_label_faults(root)]
    for name in ("truth", "measured"):  # later groups are computed anew
        group = recording.children.get(name)
        found = [] if group is None else faults_in(group.to_dataset())
        faults += [f"in the group {name}, {fault}" for fault in found]
    time = np.asarray(root["time"].values)
    if time.dtype.kind not in "fiu":
        faults.append(f"its time is {time.dtype}; numbers are needed, in seconds")
    elif not np.isfinite(time).all() or (np.diff(time) <= 0).any():
        faults.append("its time does not increase from frame to frame, or is missing in some")
    if faults := faults or _position_faults(Recording(recording)):
        raise ValueError(f"the recording cannot be used: {'; '.join(faults)}")
    if not root["time"].attrs.get("numbered") and (usual := slow_steps(time)):
        warnings.warn(
            f"the recording has frames {usual:.3g} s apart: its time has to be in seconds, and "
            "rates of change are wrong if it is in ms",
            stacklevel=1,
        )
    elif fast := _unlikely_speed(root):
        warnings.warn(
            f"the base moves at {fast:.3g} m/s: is base_position in mm, where m is needed?",
            UserWarning,
            stacklevel=1,
        )
    if changed := edited(recording):
        warnings.warn(
            f"the recording was edited after its {changed[0]} had been computed: these, and all "
            "that depends on them, are out of date until `vibrissa reconstruct` has run",
            stacklevel=1,
        )


def _unlikely_speed(root: xr.Dataset) -> float:
    """Speed that bases often exceed, m/s, if it is implausible; else 0."""
    base = Group(root).known("base_position")
    if base is None or len(base) < 2:
        return 0.0
    speed = np.linalg.norm(np.diff(base, axis=0), axis=2)
    speed /= np.diff(np.asarray(root["time"].values, dtype=np.float64))[:, None]
    known = speed[np.isfinite(speed)]
    often = float(np.quantile(known, _OFTEN)) if known.size else 0.0
    return often if often > _FASTEST else 0.0


def _label_faults(root: xr.Dataset) -> list[str]:
    """List faults of the time and whisker coordinates."""
    if bare := [f"it is without a coordinate {d}" for d in ("time", "whisker") if d not in root]:
        return bare
    faults = [fault] if (fault := unit_fault("time", root["time"].attrs.get("units", "s"))) else []
    names = [str(name) for name in root["whisker"].values]
    if len(set(names)) < len(names):
        faults.append(f"whiskers share a name: {', '.join(names)}")
    return faults


def _position_faults(recording: Recording) -> list[str]:
    """List a centreline or a base of another scale than the whisker, as by its unit."""
    base = recording.root.known("base_position")
    groups = (recording.root, recording.find("truth"))
    lines = [group.known("centerline") for group in groups if group is not None]
    if (line := next((line for line in lines if line is not None), None)) is None:
        return []
    length = np.linalg.norm(np.diff(line, axis=2), axis=3).sum(axis=2)
    if "whiskers" in recording.tree.children:
        scales = np.nanmedian(length, axis=0) / [one.length for one in recording.whiskers]
        if np.nanmax(scales) > _SCALE or np.nanmin(scales) < 1.0 / _SCALE:
            listed = ", ".join(f"{scale:.3g}" for scale in scales)
            return [
                f"its centerline is {listed} times as long as its whisker; are millimetres given "
                "as metres?"
            ]
    if base is None:
        return []
    ratio = np.linalg.norm(line[:, :, 0] - base, axis=2) / length
    ratio = ratio[np.isfinite(ratio)]
    if not ratio.size or (away := float(np.median(ratio))) <= 1.0:
        return []
    return [
        f"base_position is {away:.3g} lengths of the whisker from the base of its centerline; are "
        "millimetres given as metres?"
    ]


def names_of(data: xr.Dataset) -> str:
    """Names of the variables of a dataset, as text for a message."""
    return ", ".join(sorted(map(str, data.data_vars))) or "no variables"


def needed(root: xr.Dataset, names: Sequence[str], source: str) -> None:
    """Raise ValueError if the root lacks variables that signals of this source require."""
    missing = [name for name in names if name not in root]
    if not missing:
        return
    raise ValueError(
        f"signals from the {source} need {', '.join(missing)}; the recording has {names_of(root)}"
    )


def one_whisker(values: Mapping[str, Any], status: NDArray[np.int64]) -> xr.Dataset:
    """Dataset of one whisker's variables and six signals; dimension ``whisker`` of length one."""
    six = base_signals(values["force"], values["moment"])
    known = {
        **values,
        "status": np.asarray(status, dtype=np.int8),
        **{str(name): signal.values for name, signal in six.data_vars.items()},
    }
    return xr.Dataset({name: recorded(name, array) for name, array in known.items()})


def with_coordinates(data: xr.Dataset, root: xr.Dataset, about: Mapping[str, Any]) -> xr.Dataset:
    """Assign the coordinates of a recording, and attributes, to a dataset."""
    names = ("time", "whisker", "space", "whisker_axis")
    coordinates = {name: root[name].variable for name in names if name in root.coords}
    return data.assign_coords({"space": list("xyz"), **coordinates}).assign_attrs(about)


def estimates_in(recording: xr.DataTree) -> xr.Dataset:
    """Group ``estimates`` of a recording, checked for completeness."""
    return _group_in(recording, "estimates", ESTIMATED)


def signals_in(recording: xr.DataTree) -> xr.Dataset:
    """Group ``signals`` of a recording, checked for completeness."""
    return _group_in(recording, "signals", MEASURED)


# Function and command-line verb that compute each group.
_VERBS = {"signals": ("signals_of", "signals"), "estimates": ("estimates_of", "estimate")}


def _group_in(recording: xr.DataTree, name: str, needs: Sequence[str]) -> xr.Dataset:
    """Group of a recording, with all variables that later stages need."""
    group = recording.children.get(name)
    function, verb = _VERBS[name]
    if group is None:
        got = ", ".join(sorted(recording.children)) or "no groups"
        raise ValueError(
            f"the recording has no group {name} (it has {got}): compute it first by {function} or "
            f"`vibrissa {verb}`"
        )
    data = group.to_dataset()
    missing = [variable for variable in needs if variable not in data]
    faults = [f"it lacks {', '.join(missing)}"] if missing else []
    faults += faults_in(data)
    if faults:
        raise ValueError(
            f"the group {name} of the recording cannot be used: {'; '.join(faults)}; compute it "
            f"again by `vibrissa {verb}`"
        )
    return data


def whisker_radii(estimates: xr.Dataset, whiskers: Sequence[Whisker]) -> Array:
    """Radii (time, whisker) of the whiskers at their contacts, m; NaN without contact."""
    arc_length = Group(estimates)["arc_length"]
    radius = np.full(arc_length.shape, np.nan)
    for k, whisker in enumerate(whiskers):
        known = np.isfinite(arc_length[:, k])
        radius[known, k] = whisker.radius(arc_length[known, k])
    return radius


# Speed of bases, m/s, that must not be exceeded in a tenth of the steps.
_FASTEST, _OFTEN = 20.0, 0.9
_SCALE = 10.0  # ratio of the lengths of centreline and whisker from which the unit is wrong
MADE_FROM = "made_from"
_POSE = ("base_position", "base_rotation", "pose_covariance")
_WRENCH = ("force", "moment", "wrench_covariance", "in_contact")
_POINT = ("contact_point", "contact_covariance", "in_contact")
_ANGLES = tuple(f"unfiltered_base_{name}" for name in ("position", "azimuth", "elevation", "roll"))
# Groups and variables from which each stage is computed.
_INPUTS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "signals": {
        "": (*_WRENCH, "reading", *_POINT[:2], *_POSE, "head_position", "head_rotation"),
        "measured": ("contact_point", *_ANGLES),
    },
    "estimates": {"signals": (*_WRENCH, *_POSE, "status", "pose_wrench_covariance", *CHANGE)},
    "contour": {"estimates": (*_POINT, "contact_normal", "normal_covariance", "arc_length")},
}


def made_from(recording: xr.DataTree, stage: str) -> xr.Variable:
    """Checksums (time, whisker) of the values from which a stage is computed."""
    check_frames(recording)
    record = Recording(recording)
    shape = tuple(record.root.data.sizes[dim] for dim in ("time", "whisker"))
    parts = [np.zeros((*shape, 1))]
    for name, variables in _INPUTS[stage].items():
        for variable in variables if name == "" or name in record else ():
            if (values := record[name].get(variable)) is not None:
                each = shape[1] if "whisker" in VARIABLES[variable].dims else 1
                values = values.reshape(shape[0], each, -1)
                parts.append(np.broadcast_to(values, (*shape, values.shape[2])))
    numbers = np.concatenate(parts, axis=2, dtype=np.float64) + 0.0  # −0 is 0
    numbers[np.isnan(numbers)] = np.nan
    # With odd factors, any change of a single value changes the sum (modulo 2^64).
    factors = np.random.default_rng(0).integers(2**62, size=numbers.shape[2], dtype=np.uint64)
    total = np.einsum("twi,i->tw", numbers.view(np.uint64), 2 * factors + 1)
    return recorded(MADE_FROM, total.view(np.int64))


def edited(recording: xr.DataTree) -> list[str]:
    """Stages whose inputs in the recording have changed since they were computed."""
    present = [(name, recording.children[name]) for name in _INPUTS if name in recording.children]
    return [
        name
        for name, group in present
        if MADE_FROM in group
        and not np.array_equal(np.asarray(group[MADE_FROM]), made_from(recording, name))
    ]


# Smallest and largest number of contacts tested, chosen from those with the larger moments.
_FEW, _MOST = 6, 24
# Number of steps without contact that show the noise; ratio of their scatter to the stated noise
# above which, or below whose inverse, this is doubted; largest differences of successive readings,
# over a quantile of the deviations of all, that may be noise; and standard deviation over median
# size.
_FREE, _DISTRUSTED, _GRADUAL, _RANGE, _TO_SIGMA, _ROOT_2 = 20, 10.0, 0.05, 0.95, 1.4826, 2.0**0.5
# Model errors unrelated to the axes, such as those of stiffness, relative to force and moment.
_MODEL = 0.05
_EXPLAINED = 9.0  # largest χ² of an explained contact; a friction angle of 20° adds one to χ²
# The stated axes are doubted if they explain at most the share _DOUBTED of the contacts. Other axes
# are reported if they explain at least _BELIEVED, and _BETTER more than the stated ones; of those
# within _EQUAL of the best, the simplest is reported.
_DOUBTED, _BELIEVED, _BETTER, _EQUAL = 0.5, 0.9, 0.25, 0.05
# Axes with a larger median |F · M| / |F| |M| are rejected at once, which saves time.
_OBLIQUE = 0.2


def doubted_axes(whisker: Whisker, force: Array, moment: Array, noise: Array) -> str:
    """Describe which axes of force and moment seem to be exchanged or to have the wrong sign.

    ``force`` and ``moment`` (n, 3) are in the whisker frame, and ``noise`` (6, 6) is the covariance
    of (F, M), SI units. The whisker's weight is neglected. The text is empty if the stated axes
    explain most contacts, or no other axes explain them.
    """
    size = np.linalg.norm(moment, axis=1)
    noisy = np.sqrt(np.trace(noise[3:, 3:]))
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero(np.isfinite(force.sum(axis=1)) & (size > 10.0 * noisy))
    if rows.size < _FEW:
        return ""
    rows = rows[size[rows] >= np.median(size[rows])]
    rows = rows[np.linspace(0, rows.size - 1, min(rows.size, _MOST)).round().astype(int)]
    force, moment = force[rows], moment[rows]
    spread = np.repeat([np.median(np.linalg.norm(a, axis=1)) for a in (force, moment)], 3)
    covariance = noise + np.diag((_MODEL * spread) ** 2)

    def explained(turns: Array, fitted: bool) -> Array:
        """Shares (n,) of the contacts explained after signed permutations (n, 2, 3, 3)."""
        f, m = np.moveaxis(turns @ np.array([force.T, moment.T]), 1, 0)
        size = np.linalg.norm(f, axis=1) * np.linalg.norm(m, axis=1)
        near = np.median(np.abs((f * m).sum(axis=1)) / size, axis=1) < _OBLIQUE
        shares = np.zeros(len(turns))
        f, m = (np.swapaxes(a[near], 1, 2).reshape(-1, 3) for a in (f, m))
        doubt = rubbing_misfits(whisker, f, m, covariance, fitted)
        shares[near] = (doubt <= _EXPLAINED).reshape(near.sum(), rows.size).mean(axis=1)
        return shares

    stated, own = np.eye(3)[None, None].repeat(2, axis=1), 0.0
    for fitted in (False, True):  # most recordings need neither the fits nor their kernels
        own = explained(stated, fitted)[0]
        if own > _DOUBTED:
            return ""
    turns = _mistakes()
    shares = explained(turns, True)
    simple = int(np.argmax(shares > shares.max() - _EQUAL))
    if shares[simple] < max(_BELIEVED, own + _BETTER):
        return ""
    columns = [
        f"{'-' if row.min() < 0.0 else ''}{kind}{'xyz'[int(np.abs(row).argmax())]}"
        for kind, row in zip("FFFMMM", turns[simple].reshape(6, 3), strict=True)
    ]
    return (
        f"the whisker explains {100 * own:.0f} % of {rows.size} strong contacts, and "
        f"{100 * shares[simple]:.0f} % for example with {', '.join(columns)} as Fx, Fy, Fz, Mx, "
        "My, Mz: are force and moment along the axes of the whisker's frame, a right hand, and of "
        "the object on the whisker?"
    )


def doubted_noise(readings: Array, noise: Array, free: Mask) -> str:
    """Describe noise that is far from the scatter of readings without contact.

    ``readings`` (n, 6) are force and moment, ``noise`` (6, 6) is their covariance, SI units, and
    ``free`` (n,) are the rows without contact. The text is empty if the noise is plausible. Noise
    is too small if successive readings differ far more, which a drift does not cause, and too large
    if all readings are far closer together, filtered or not. If hardly any row is free, as with
    noise that is far too small, all count, which differ more as the whisker moves; separate
    contacts, which differ as much as any two, do not show noise.
    """
    some = np.count_nonzero(free) > _FREE
    rest = np.where(free[:, None] | (not some), readings, np.nan)
    most = _DISTRUSTED if some else _DISTRUSTED**2
    doubts = []
    for name, part in (("force", slice(0, 3)), ("moment", slice(3, 6))):
        stated, each = np.sqrt(np.diag(noise))[part], rest[:, part]
        known = (np.isfinite(np.diff(each, axis=0)).sum(axis=0) >= _FREE) & (stated > 0.0)
        if not known.any():
            continue
        each, stated = each[:, known], stated[known]
        away = np.abs(each - np.nanmedian(each, axis=0)), np.abs(np.diff(each, axis=0)) / _ROOT_2
        scatter, change = (_TO_SIGMA * np.nanmedian(one, axis=0) for one in away)
        little, much = float(np.median(scatter / stated)), float(np.median(change / stated))
        gradual = change < _GRADUAL * np.nanquantile(away[0], _RANGE, axis=0)
        much *= some or bool(gradual.mean() > 0.5)
        # Readings that never change are not those of a sensor.
        if much > most or 0.0 < little < 1.0 / _DISTRUSTED:
            about = quantity(name)
            seen, asked = (
                f"{about.display_factor * float(np.median(one)):.2g} {about.display_unit}"
                for one in (change if much > most else scatter, stated)
            )
            doubts.append(f"{name} by {seen}, with noise of {asked}")
    if not doubts:
        return ""
    return (
        f"{'readings without contact' if some else 'successive readings'} do not scatter as the "
        f"noise states, but {'; '.join(doubts)}: which contacts are detected, and their "
        "covariances, depend on the noise"
    )


def _mistakes() -> Array:
    """Signed axis permutations (n, 2, 3, 3) of force and moment, fewest changed columns first."""
    one = np.eye(3)
    signed = [
        np.diag(signs) @ one[list(order)]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]
    pairs = [
        pair
        for p in signed
        for pair in ((p, one), (one, p), (p, p), (p, np.linalg.det(p).round() * p))
    ]
    every = np.unique(pairs, axis=0)
    changed, negative = (every != one).any(axis=-1).sum(axis=(1, 2)), (every < 0.0).sum((1, 2, 3))
    return np.asarray(every[np.lexsort((negative, changed))][1:])
