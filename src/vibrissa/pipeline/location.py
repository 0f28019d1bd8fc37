"""Contact estimates in the whisker frame from the measured wrench, with error propagation.

A contact is detected where the bending moment M_B exceeds five standard deviations of its noise.
If several contacts explain the signals, the one with the least force is listed first; continuity in
the laboratory frame selects among them later (`vibrissa.pipeline.estimates`).
Errors of contact points and normals follow from derivatives (`vibrissa.pipeline.touch_gains`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.contacts import (
    WRENCH,
    ContactMap,
    Contacts,
    Gravity,
    Prior,
    common_covariance,
    common_errors,
    estimate_around,
    estimate_from_wrench,
    estimate_jointly,
    read_at_rest,
    second_contact,
    whitening,
)
from vibrissa.deferred import xr
from vibrissa.numerics import Array
from vibrissa.objects import Surface
from vibrissa.pipeline.frames import CHANGE, Frames, Labelled
from vibrissa.pipeline.touch_gains import contact_normals, gains
from vibrissa.quantities import attributes
from vibrissa.recording import Group
from vibrissa.rod import resting
from vibrissa.sensors import component_noise
from vibrissa.signals import DETECTED, TRIPLET, selection
from vibrissa.status import Status, flag_attributes
from vibrissa.whisker import Whisker

# Standard deviation of the ratio of forces along and across the whisker, for the test of second
# contacts.
_FRICTION = 0.3
_OF_ROD = ("stiffness_sigma", "compliance_sigma")  # errors of the whisker and its base
_WHISKER = {"reference_frame": "whisker"}
_ANYWHERE = 1.0 / 12.0  # variance of a contact anywhere on the whisker, over L²
_FLAT = 1e-15  # least ratio of variances of a covariance of first order


def locate(
    contact_map: ContactMap,
    wrench: Labelled,
    triplet: tuple[str, ...] = TRIPLET,
    *,
    noise: ArrayLike | None,
    method: str = "exact",
    errors: Mapping[str, Any] | None = None,
    prior: Prior | None = None,
    friction: float = 0.0,
    gravity: Gravity | None = None,
    second_contacts: float = 0.0,
) -> Labelled:
    """Estimate the contact point in every frame with a contact.

    Parameters
    ----------
    contact_map : ContactMap
        Contact map of the whisker.
    wrench : xarray.Dataset
        Measured ``force`` and ``moment``, whisker frame, N and N·m, dimensions time, space. If it
        has a variable ``in_contact``, frames where this is false are without contact. If it has
        ``contact_force_change`` with its covariance, this is added to the forces for the normals.
    triplet : tuple of str
        Signals to estimate from, three or more.
    noise : array_like (6, 6) or (time, 6, 6), optional
        Covariance of (F, M), SI units, of all frames or of each; see `component_noise`. Without it
        no covariances are computed, and every frame with nonzero M_B counts as a contact.
    method : str
        Method, as for `estimates_of`.
    errors : mapping of str to float, optional
        Standard deviations of common errors, as for `estimates_of`.
    prior : Prior, optional
        Prior over contacts, as for `estimates_of`.
    friction : float
        Standard deviation of the ratio of forces, as for `estimates_of`; requires the exact method.
    gravity : Gravity, optional
        Gravity under which the whisker bends, as for ``ContactMap.estimate``; requires the exact
        method. It is in the laboratory frame if ``wrench`` has ``base_rotation``. Derivatives are
        computed for a weightless whisker with the shape at rest.
    second_contacts : float
        False-alarm rate of the test for more than one contact, as for `estimates_of`.

    Returns
    -------
    xarray.Dataset
        Contacts in all frames of ``wrench``, dimension time: ``contact_point_whisker`` with
        ``covariance``, ``arc_length``, the modelled ``force`` at the base; the same of all
        candidates (``candidate_points``, ``candidate_covariance``, ...) and their number
        ``candidates``; ``in_contact`` (detected) and ``status``; ``candidate_gain``, the
        derivatives of the candidates with respect to the wrench, reduced where an error of first
        order is larger than the estimate states, and ``candidate_widening`` and
        ``candidate_normal_widening``, the covariances in addition to it; ``wrench_covariance``,
        the covariance of the wrench from noise and common
        errors; and the variables that `with_events` needs. Covariances are those of the exact
        method whatever the method. Frames without a detected contact are NaN, with the status
        ``NOT_FELT``, or ``NO_CONTACT`` where force and moment are zero or ``in_contact`` is false.

    Raises
    ------
    ValueError
        If the shape of the noise is wrong.
    """
    names = selection(triplet)
    measured = _Measured.of(wrench, noise, errors, contact_map.whisker, gravity)
    signals = {n: getattr(measured, n)[measured.rows] for n in ("force", "moment")}
    if method == "exact":
        found = contact_map.estimate(
            signals,
            names,
            measured.typical,
            prior=prior,
            friction=friction,
            same_friction=True,
            gravity=gravity,
            base_rotation=measured.rotation,
            **(errors or {}),
        )
    else:
        from vibrissa.paper import estimate  # imports modules that only these methods need

        found = estimate(contact_map, signals, names, method=method, prior=prior)
    stated = found.candidates.covariance if method == "exact" else None
    whisker = measured.at_rest(contact_map.whisker, gravity)
    out = _located(whisker, names, measured, found, stated, friction)
    out = _mark_second_contacts(out, whisker, measured, errors, friction, second_contacts)
    labelled: Labelled = _like(wrench, out)
    return labelled


def without_contact(
    whisker: Whisker,
    wrench: xr.Dataset,
    triplet: tuple[str, ...] = TRIPLET,
    *,
    noise: ArrayLike | None,
) -> xr.Dataset | None:
    """Result of `locate` if no frame has a contact, for which no map is needed; None otherwise."""
    measured = _Measured.of(wrench, noise)
    if measured.rows.any():
        return None
    return _located(whisker, selection(triplet), measured, None).to_dataset()


def locate_from_wrench(
    whisker: Whisker,
    wrench: Labelled,
    noise: ArrayLike | None,
    errors: Mapping[str, Any] | None = None,
    prior: Prior | None = None,
    gravity: Gravity | None = None,
    second_contacts: float = 0.0,
) -> Labelled:
    """Locate contacts, with or without friction, from all six components of the wrench.

    Parameters
    ----------
    whisker : Whisker
        Whisker in contact.
    wrench : xarray.Dataset
        Measured wrench, as for `locate`.
    noise : array_like (6, 6) or (time, 6, 6), optional
        Covariance of (F, M), as for `locate`.
    errors : mapping of str to float, optional
        Standard deviations of common errors, as for `locate`.
    prior : Prior, optional
        Prior over contacts, as for `locate`.
    gravity : Gravity, optional
        Gravity under which the whisker bends, as for `locate`.
    second_contacts : float
        False-alarm rate, as for `locate`.

    Returns
    -------
    xarray.Dataset
        Contacts as returned by `locate`, with ``friction_angle``.
    """
    measured = _Measured.of(wrench, noise, errors, whisker, gravity)
    force, moment = measured.force[measured.rows], measured.moment[measured.rows]
    if gravity is None:
        found = estimate_from_wrench(
            whisker, force, moment, noise=measured.typical, prior=prior, **(errors or {})
        )
    else:
        found = estimate_jointly(
            whisker,
            None,
            {"force": force, "moment": moment},
            "wrench",
            measured.typical,
            measured.errors,
            prior,
            gravity=gravity,
            rotation=measured.rotation,
            **{n: v for n, v in (errors or {}).items() if n in _OF_ROD},
        )
    stated = found.candidates.covariance
    rest = measured.at_rest(whisker, gravity)
    out = _located(rest, WRENCH, measured, found, stated)
    out = _mark_second_contacts(out, rest, measured, errors, _FRICTION, second_contacts)
    labelled: Labelled = _like(wrench, out)
    return labelled


def locate_around(
    whisker: Whisker,
    wrench: xr.Dataset,
    noise: ArrayLike | None,
    objects: Sequence[Surface],
    position_sigma: float,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Locate contacts with known objects at one point, at several points or along an arc.

    Arguments and result are those of `locate` and `estimate_around`; with ``base_rotation`` and
    ``base_position`` in ``wrench`` the objects are in the laboratory frame.
    """
    measured, known = _Measured.of(wrench, noise), Group(wrench)
    pose: dict[str, Any] = {}
    rows = measured.rows
    if "base_rotation" in known:
        held = known["base_rotation"], known["base_position"]
        rows = rows & np.isfinite(held[0]).all(axis=(1, 2)) & np.isfinite(held[1]).all(axis=1)
        pose = dict(zip(("base_rotation", "base_position"), (a[rows] for a in held), strict=True))
    if measured.typical is None and rows.any():
        raise ValueError("the objects' position is weighted against the noise: give the noise")
    force, moment = measured.force[rows], measured.moment[rows]
    found = estimate_around(
        whisker,
        force,
        moment,
        objects,
        noise=np.eye(6) if measured.typical is None else measured.typical,
        position_sigma=position_sigma,
        progress=progress,
        **pose,
    )
    status = np.where(measured.known, int(Status.NOT_FELT), int(Status.MISSING)).astype(np.int8)
    status[measured.free] = int(Status.NO_CONTACT)
    status[measured.rows] = int(Status.MISSING)
    status[rows] = found["status"].values
    shift = found["object_shift"].values
    columns = {
        "contact_point_whisker": found["contact_point_whisker"].values,
        "covariance": found["covariance"].values,
        "arc_length": found["arc_length"].values,
        "last_arc_length": found["last_arc_length"].values,
        **{f"shift_{axis}": shift[:, i] for i, axis in enumerate("xyz")},
    }
    data: dict[str, Any] = {
        name: (("time", "space", "space_2")[: values.ndim], _everywhere(rows, values))
        for name, values in columns.items()
    }
    data["in_contact"] = ("time", rows)
    data["covariance_valid"] = ("time", rows)
    data = {name: (*each, attributes(name)) for name, each in data.items()}
    data["excess"] = (("time", "reading"), measured.excess)
    data["status"] = ("time", status, {**attributes("status"), **flag_attributes()})
    about = {"felt_above": measured.above, "friction": 0.0, "length": whisker.length}
    return Frames({"time": measured.time, **data}, about).to_dataset()


def _arrays(wrench: xr.Dataset | Frames) -> Group | Frames:
    """Access to the variables of a wrench as arrays."""
    return wrench if isinstance(wrench, Frames) else Group(wrench)


def _like(wrench: object, found: Frames) -> Any:
    """Contacts as a dataset unless the wrench is plain."""
    return found if isinstance(wrench, Frames) else found.to_dataset()


def _of_wrench(errors: Mapping[str, Any] | None) -> dict[str, Any]:
    """Errors of the measured wrench, without that of the base's compliance."""
    return {name: value for name, value in (errors or {}).items() if name != "compliance_sigma"}


def _mark_second_contacts(
    found: Frames,
    whisker: Whisker,
    measured: _Measured,
    errors: Mapping[str, Any] | None,
    friction: float,
    rate: float,
) -> Frames:
    """Mark the frames that one contact does not explain, at a false-alarm rate; 0 marks none."""
    if not rate > 0.0:
        return found
    if measured.typical is None:
        raise ValueError("the test for second contacts needs the noise: give the noise")
    rows = measured.rows
    force, moment = measured.force[rows], measured.moment[rows]
    test = second_contact(
        whisker,
        force,
        moment,
        noise=measured.typical,
        friction=friction,
        false_alarms=rate,
        **_of_wrench(errors),
    )
    status = found["status"].copy()
    status[np.flatnonzero(rows)[test["second_contact"].values]] = int(Status.NOT_ONE_CONTACT)
    alone = _everywhere(rows, test["one_contact"].values)
    about = found.variables["status"][2]
    return found.assign(
        {
            "one_contact": ("time", alone, attributes("one_contact")),
            "status": ("time", status, about),
        }
    )


class _Measured(NamedTuple):
    """Measured wrench of n frames, its noise, and the frames in contact.

    ``force`` and ``moment`` are (n, 3), and ``covariance`` is (n, 6, 6), NaN if unknown. ``known``,
    ``rows`` and ``free`` (n,) mark the frames in which the wrench is known, a contact is detected,
    and there is no contact; ``clear`` (n,) those in which M_B is above the threshold. ``excess``
    (n, 6) is the whitened difference from the wrench of a free whisker, or (n, 0) if contact is not
    detected from it. ``typical`` (6, 6) is the typical noise of the frames, if known; ``errors``
    (k, 6, 7) are the errors that all frames share; ``above`` is the M_B above which contacts are
    detected, N·m; ``steady`` is true if all frames have the same noise; ``rotation`` (rows, 3, 3)
    is that of the base in the frames with a contact, under gravity and if known. ``change`` (n, 3)
    and ``change_covariance`` (n, 3, 3) are those of the contact force by inertia that was removed,
    or zero.
    """

    time: tuple[str, Array, Mapping[str, Any]]
    force: Array
    moment: Array
    covariance: Array
    known: NDArray[np.bool_]
    rows: NDArray[np.bool_]
    free: NDArray[np.bool_]
    clear: NDArray[np.bool_]
    excess: Array
    typical: Array | None
    errors: Array
    above: float
    steady: bool
    rotation: Array | None
    change: Array
    change_covariance: Array

    @classmethod
    def of(
        cls,
        wrench: xr.Dataset | Frames,
        noise: ArrayLike | None,
        errors: Mapping[str, Any] | None = None,
        whisker: Whisker | None = None,
        gravity: Gravity | None = None,
    ) -> _Measured:
        """Measurement of a wrench."""
        given = _arrays(wrench)
        force, moment = (given[name] for name in ("force", "moment"))
        n = len(force)
        covariance = _noise_of_frames(noise, n)
        known = np.isfinite(force.sum(axis=1) + moment.sum(axis=1))
        excess, rotation = np.concatenate([force, moment], axis=1), None
        if gravity is not None and whisker is not None:
            rotation = given.get("base_rotation")
            excess = excess - read_at_rest(whisker, gravity, rotation, n)
        size = np.hypot(excess[:, 4], excess[:, 5])
        least = 0.0 * size
        if noise is not None:
            least = DETECTED * np.sqrt(0.5 * (covariance[:, 4, 4] + covariance[:, 5, 5]))
            least = np.nan_to_num(least)
        with np.errstate(invalid="ignore"):
            rows = clear = known & (size > least)
        free = known & ~force.any(axis=1) & ~moment.any(axis=1)
        if "in_contact" in given:
            touching = given["in_contact"]
            # If inertia was removed, `in_contact` already is the result of a detection.
            rows = known & touching if "density" in wrench.attrs else rows & touching
            free |= known & ~touching
        # If no contact is detected, the threshold is that of the frames that could have had one.
        possible = next((few for few in (rows, known & ~free, known) if few.any()), known)
        above = float(np.median(least[possible])) if possible.any() else 0.0
        typical, steady = None, bool((covariance == covariance[:1]).all())
        if noise is not None:
            typical = covariance[0] if steady else _typical(covariance[rows])
        by_size = typical is not None and "in_contact" not in given
        excess = excess @ whitening(typical).T if by_size and typical is not None else excess[:, :0]
        shared = common_errors(**_of_wrench(errors))
        if len(shared):
            whole = np.concatenate([force, moment], axis=1)
            covariance = covariance + common_covariance(shared, np.eye(6), whole)
        about = {} if isinstance(wrench, Frames) else wrench["time"].attrs
        time = ("time", np.asarray(wrench["time"]), about)
        if rotation is not None:
            rotation = rotation[rows]
        return cls(
            time,
            force,
            moment,
            covariance,
            known,
            rows,
            free,
            clear,
            excess,
            typical,
            shared,
            above,
            steady,
            rotation,
            *(
                given[name] if name in given else np.zeros((n, *shape))
                for name, shape in zip(CHANGE, ((3,), (3, 3)), strict=True)
            ),
        )

    def at_rest(self, whisker: Whisker, gravity: Gravity | None) -> Whisker:
        """Weightless whisker with the resting shape for the mean direction of gravity."""
        if gravity is None:
            return whisker
        pull = np.array(gravity.acceleration)
        if self.rotation is not None and len(self.rotation):
            pull = np.nanmean(self.rotation, axis=0).T @ pull
        return resting(whisker, pull).shape()


def _noise_of_frames(noise: ArrayLike | None, n: int) -> Array:
    """Covariances (n, 6, 6) of all frames; NaN without noise."""
    if noise is None:
        return np.full((n, 6, 6), np.nan)
    array = np.asarray(noise, dtype=np.float64)
    if array.shape not in ((6, 6), (n, 6, 6)):
        raise ValueError(f"noise has shape {array.shape}; (6, 6) or ({n}, 6, 6) is needed")
    return np.broadcast_to(array, (n, 6, 6))


def _typical(covariance: Array) -> Array | None:
    """Typical noise (6, 6) of frames (n, 6, 6), isotropic in force and in moment."""
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    variances = variances[np.isfinite(variances).all(axis=1)]
    if not variances.size:
        return None
    force, moment = (np.sqrt(np.median(v.mean(axis=1))) for v in np.hsplit(variances, 2))
    return component_noise(float(force), float(moment))


def _located(
    whisker: Whisker,
    names: tuple[str, ...],
    measured: _Measured,
    found: Contacts | None,
    stated: Array | None = None,
    friction: float = 0.0,
) -> Frames:
    """Contacts of all frames from the candidates of those with a contact, None if there are none.

    Covariances are of first order, unless all frames have the same noise: then the covariances
    ``stated`` (n, candidates, 3, 3) by the estimate, which remain valid up to slip-off, are used:
    ``candidate_gain`` with the addition ``candidate_widening`` gives them.
    """
    rows = measured.rows
    points = forces = contact_forces = np.empty((0, 1, 3))
    arc_lengths = points[..., 0]
    status = np.where(measured.known, int(Status.NOT_FELT), int(Status.MISSING)).astype(np.int8)
    status[measured.free] = int(Status.NO_CONTACT)
    number, valid = np.zeros(rows.size, dtype=np.int64), np.zeros(rows.size, dtype=np.bool_)
    if found is not None:
        one = found.candidates
        points, arc_lengths, forces = one.point, one.arc_length, one.force
        contact_forces, status[rows] = one.contact_force, found.status
        number[rows], valid[rows] = found.n_candidates, found.covariance_valid
    gain, spread, widening, normals, tangents = _errors(
        whisker, names, measured, arc_lengths, contact_forces, stated, friction
    )
    columns = {
        "points": ("contact_point_whisker", points),
        "covariance": ("covariance", spread),
        "arc_length": ("arc_length", arc_lengths),
        "force": ("force", forces),
    }
    data: dict[str, Any] = {}
    for short, (name, values) in columns.items():
        dims = ("time", "candidate", "space", "space_2")[: values.ndim]
        everywhere = _everywhere(rows, values)
        data[name] = ((dims[0], *dims[2:]), everywhere[:, 0], attributes(name))
        data[f"candidate_{short}"] = (dims, everywhere, attributes(name))
    wider = "covariance of contact point and normal by other errors"
    by_wrench = "contact point and normal by force and moment"
    pair, mixed = (("contact_component", n) for n in ("contact_component_", "component"))
    more = (
        ("normal", ("space",), normals, attributes("contact_normal") | _WHISKER),
        ("tangent", ("space",), tangents, attributes("contact_tangent") | _WHISKER),
        ("widening", pair, widening, {"units": "(m, 1)^2", "long_name": wider}),
        ("gain", mixed, gain, {"units": "(m, 1)/(N, N m)", "long_name": by_wrench}),
    )
    for short, dims, values, attrs in more:
        whole = _everywhere(rows, values)
        data[f"candidate_{short}"] = (("time", "candidate", *dims), whole, attrs)
    if names == WRENCH or friction > 0.0:
        along, across = contact_forces[:, 0, 0], contact_forces[:, 0, 1:]
        angle = np.arctan2(along, np.linalg.norm(across, axis=-1))
        data["friction_angle"] = ("time", _everywhere(rows, angle), attributes("friction_angle"))
    data["wrench_covariance"] = (
        ("time", "component", "component_"),
        measured.covariance,
        attributes("wrench_covariance"),
    )
    data["candidates"] = ("time", number, attributes("candidates"))
    data["in_contact"] = ("time", rows, attributes("in_contact"))
    data["covariance_valid"] = ("time", valid, attributes("covariance_valid"))
    data["excess"] = (("time", "reading"), measured.excess)
    data["status"] = ("time", status, {**attributes("status"), **flag_attributes()})
    assumed = np.inf if names == WRENCH else friction
    about = {"triplet": " ".join(names), "felt_above": measured.above, "friction": assumed}
    about["length"] = whisker.length
    return Frames({"time": measured.time, **data}, about)


def _errors(
    whisker: Whisker,
    names: tuple[str, ...],
    measured: _Measured,
    arc_lengths: Array,
    contact_forces: Array,
    stated: Array | None,
    friction: float,
) -> tuple[Array, Array, Array, Array, Array]:
    """Gains, covariances of points, normals and the whisker's tangents of candidates.

    The third result is the part of the covariances of points and normals that is not due to the
    gains.
    """
    rows = measured.rows
    shape = arc_lengths.shape
    flat = (arc_lengths.reshape(-1), contact_forces.reshape(-1, 3))
    change, doubt = (
        np.repeat(of[rows], shape[1], axis=0)
        for of in (measured.change, measured.change_covariance)
    )
    gain, rubbed = gains(whisker, names, *flat, measured.typical, measured.errors, friction, change)
    gain, rubbed = gain.reshape(*shape, 6, 6), rubbed.reshape(*shape, 6)
    normals, turning, tangents = contact_normals(whisker, *flat, change, doubt)
    first = gain @ measured.covariance[rows][:, None] @ np.swapaxes(gain, -1, -2)
    first += rubbed[..., :, None] * rubbed[..., None, :]
    point_gain, spread = gain[..., :3, :], first[..., :3, :3]
    wider = np.zeros_like(spread)
    # Second-order terms: normals turn, and errors of points follow an arc whose radius is of the
    # order of the length. Unclear contacts may be anywhere.
    unclear = np.where(measured.clear[rows], 0.0, 1.0)[:, None, None, None] * np.eye(3)
    turning = turning.reshape(*shape, 3, 3) + unclear
    turning += 0.5 * np.einsum("ncii->nc", first[..., 3:, 3:])[..., None, None] ** 2 * np.eye(3)
    if not measured.steady:
        size = np.einsum("ncii->nc", spread) / whisker.length
        wider = size[..., None, None] ** 2 * np.eye(3) + _ANYWHERE * whisker.length**2 * unclear
        spread = spread + wider
    elif stated is not None:
        k = stated.shape[1]
        factor, wider[:, :k] = _as_stated(spread[:, :k], stated)
        point_gain[:, :k] = factor @ point_gain[:, :k]
        rubbed[:, :k, :3] = np.einsum("ncij,ncj->nci", factor, rubbed[:, :k, :3])
        spread[:, :k] = np.where(np.isfinite(stated), stated, spread[:, :k])
    widening = rubbed[..., :, None] * rubbed[..., None, :]
    widening[..., :3, :3] += wider
    widening[..., 3:, 3:] += turning
    return gain, spread, widening, normals.reshape(*shape, 3), tangents.reshape(*shape, 3)


def _as_stated(first: Array, stated: Array) -> tuple[Array, Array]:
    """Change covariances of first order (..., 3, 3) to stated ones: factors A and covariances E.

    A first Aᵀ + E = stated: in the axes in which both are diagonal, errors larger than stated are
    reduced, and independent errors are added to smaller ones. Unknown covariances are not changed.
    """
    known = np.asarray(np.isfinite(first + stated).all(axis=(-2, -1)))
    size, axes = np.linalg.eigh(np.where(known[..., None, None], first, np.eye(3)))
    known &= size[..., -1] > 0.0
    root = np.sqrt(np.maximum(size, _FLAT * np.maximum(size[..., -1:], _FLAT)))[..., None, :]
    root, back = axes * root, np.swapaxes(axes / root, -1, -2)
    whole = np.where(known[..., None, None], stated, root @ np.swapaxes(root, -1, -2))
    ratio, turn = np.linalg.eigh(back @ whole @ np.swapaxes(back, -1, -2))
    root, back, ratio = root @ turn, np.swapaxes(turn, -1, -2) @ back, ratio[..., None, :]
    factor = (root * np.sqrt(np.clip(ratio, 0.0, 1.0))) @ back
    wider = (root * np.maximum(ratio - 1.0, 0.0)) @ np.swapaxes(root, -1, -2)
    return factor, wider


def _everywhere(rows: NDArray[np.bool_], values: Array) -> Array:
    """Expand values (n, ...) of the marked rows to all rows, with NaN elsewhere."""
    out = np.full((rows.size, *values.shape[1:]), np.nan)
    out[rows] = values
    return out
