"""Ways from the sensor's wrench to contacts, and how far these are from the truth."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.interpolate import CubicSpline

import vibrissa as vb
from vibrissa.contacts import ContactMap
from vibrissa.contour import axis_offset, fit_shape
from vibrissa.evaluation import REPLICATES
from vibrissa.pipeline import (
    CHANGE,
    SOLVED_TO,
    fit_contacts,
    in_laboratory,
    locate,
    locate_from_wrench,
    whisker_radii,
    with_signals,
)
from vibrissa.recording import Recording
from vibrissa.sensors import FORCE_NOISE, MOMENT_NOISE, component_noise
from vibrissa.signals import SIGNALS, nearest_on_rest
from vibrissa.simulation import Dynamics
from vibrissa.whisker import Whisker

NOISE = component_noise(FORCE_NOISE, MOMENT_NOISE)
TRIPLET = "Fx MB MD"
OTHER = "Fx FT MD"
SIX = "six signals"
WRENCH = "wrench"
PEG = ("offset", "tilt", "diameter", "sigma")
METHODS = (TRIPLET, OTHER, SIX, WRENCH)
RUBBING = {f"{of}, friction": of for of in ("Fx FT MB MD", SIX)}
"""Methods that allow for friction, and their signals."""
FRICTION = 0.3
"""Their prior: ratio of the forces along and across the whisker, one sigma."""
ASSUMED = Dynamics(
    density=tuple(0.85 * value for value in Dynamics().density),
    damping_ratio=0.85 * Dynamics().damping_ratio,
)
"""Mass and damping that inertia is removed with: those of the trials, and 15 % less."""

Pose = tuple[np.ndarray, np.ndarray]
"""Rotation (n, 3, 3) and position (n, 3) of the base in every frame."""


@dataclass(frozen=True)
class Truth:
    """What truly happened in every frame, laboratory frame unless stated."""

    touching: np.ndarray
    at_tip: np.ndarray
    point: np.ndarray
    point_whisker: np.ndarray
    force: np.ndarray
    moment: np.ndarray
    axes: np.ndarray
    """(n, 3, 3): along the whisker toward its tip, away from the object, and across both."""
    deflection: np.ndarray
    friction_angle: np.ndarray
    """Of the force from the plane normal to the whisker, positive toward the tip, rad."""
    pose: Pose


def truth_of(trial: xr.DataTree) -> Truth:
    true = trial["truth"].to_dataset().isel(whisker=0)
    root = trial.to_dataset().isel(whisker=0)
    whisker = Recording(trial).whisker()
    s, touching = true["arc_length"].values, true["in_contact"].values.astype(bool)
    line = true["centerline"].values
    nodes = np.linspace(0.0, whisker.length, line.shape[1])
    axes = np.full((len(s), 3, 3), np.nan)
    for i in np.flatnonzero(touching):
        axes[i, 0] = CubicSpline(nodes, line[i])(s[i], 1)
    axes[:, 0] /= np.linalg.norm(axes[:, 0], axis=1, keepdims=True)
    normal = true["surface_normal"].values
    axes[:, 2] = np.cross(axes[:, 0], normal)
    axes[:, 2] /= np.linalg.norm(axes[:, 2], axis=1, keepdims=True)
    axes[:, 1] = np.cross(axes[:, 2], axes[:, 0])
    force = true["contact_force"].values
    along = (force * axes[:, 0]).sum(axis=1) / np.linalg.norm(force, axis=1)
    point = true["contact_point_whisker"].values
    distance, nearest = nearest_on_rest(whisker, point)
    return Truth(
        touching=touching,
        at_tip=true["status"].values == vb.Status.TIP_CONTACT,
        point=true["contact_point"].values,
        point_whisker=point,
        force=true["force"].values,
        moment=true["moment"].values,
        axes=axes,
        deflection=np.degrees(np.arctan2(distance, nearest)),
        friction_angle=np.arcsin(np.clip(along, -1.0, 1.0)),
        pose=(root["base_rotation"].values, root["base_position"].values),
    )


def poses_of(tracked: xr.DataTree) -> Mapping[str, Pose]:
    """Of the rod that fits the traces, and the paper's, filtered at 85 Hz."""
    groups = {"rod": tracked.to_dataset(), "85 Hz": tracked["measured"].to_dataset()}
    return {
        name: tuple(
            group.isel(whisker=0)[part].values for part in ("base_rotation", "base_position")
        )
        for name, group in groups.items()
    }


def chart(whisker: Whisker) -> ContactMap:
    return ContactMap.simulate(whisker, grid=False)


def sensed(trial: xr.DataTree, removed: bool = False) -> xr.Dataset:
    """Wrench and pose of the sensor's whisker, as measured or without the whisker's inertia."""
    if removed:
        trial = with_signals(trial, "sensor", dynamics=ASSUMED)["signals"]
    return trial.to_dataset(inherit=False).isel(whisker=0)


def located(method: str, wrench: xr.Dataset, contact_map: ContactMap) -> xr.Dataset:
    """Contacts from the sensor's wrench, whisker frame."""
    noise = NOISE
    if "wrench_covariance" in wrench:
        noise = wrench["wrench_covariance"].values
        wrench = wrench[["force", "moment", "in_contact", *CHANGE]]
    else:
        wrench = wrench[["force", "moment"]]
    if method != WRENCH:
        using = RUBBING.get(method, method)
        names = SIGNALS if using == SIX else tuple(using.split())
        friction = FRICTION if method in RUBBING else 0.0
        return locate(contact_map, wrench, names, noise=noise, friction=friction)
    found = locate_from_wrench(contact_map.whisker, wrench, noise)
    rows = found["in_contact"].values
    force, moment = (wrench[name].values[rows] for name in ("force", "moment"))
    usual = noise if noise.ndim == 2 else np.median(noise[rows], axis=0)
    sigma = np.full(rows.size, np.nan)
    sigma[rows] = vb.estimate_from_wrench(
        contact_map.whisker, force, moment, noise=usual
    ).friction_angle_sigma
    return found.assign(friction_angle_sigma=("time", sigma))


def scored(
    found: xr.Dataset, truth: Truth, pose: Pose, trial: xr.DataTree, fits: bool = True
) -> xr.Dataset:
    """Place contacts and compare them with the truth, frame by frame; m and rad.

    ``predicted`` are errors drawn from the covariance, ``pose_error`` is how far the pose alone
    moves the true contact.
    """
    placed = in_laboratory(found, *pose)
    error = placed["contact_point"].values - truth.point
    covariance = placed["contact_covariance"].values
    known = np.isfinite(covariance).all(axis=(1, 2))
    size, direction = np.linalg.eigh(np.where(known[:, None, None], covariance, 0.0))
    root = direction * np.sqrt(np.maximum(size, 0.0))[:, None]
    draws = np.random.default_rng(0).normal(size=(REPLICATES, len(error), 3))
    drawn = np.linalg.norm(np.einsum("tij,rtj->rti", root, draws), axis=-1)
    moved = np.einsum("tij,tj->ti", pose[0], truth.point_whisker) + pose[1]
    out = {
        "touching": truth.touching,
        "detected": found["in_contact"].values,
        "at_tip": truth.at_tip,
        "deflection": truth.deflection,
        "status": found["status"].values,
        "candidates": found["candidates"].values,
        "distance": np.linalg.norm(error, axis=1),
        "pose_error": np.linalg.norm(moved - truth.point, axis=1),
        "friction_angle": truth.friction_angle,
    }
    if "friction_angle_sigma" in found:
        out["friction_found"] = found["friction_angle"].values
        out["friction_sigma"] = found["friction_angle_sigma"].values
    data = {name: ("frame", values) for name, values in out.items()}
    data["error"] = (("frame", "axis"), np.einsum("tij,tj->ti", truth.axes, error))
    data["predicted"] = (("frame", "replicate"), np.where(known, drawn, np.nan).T)
    if not fits:
        return xr.Dataset(data)
    touching = placed.where(xr.DataArray(truth.touching, dims="time"))
    kinds = {
        "detected": (placed, "uncertain"),
        "exact": (touching, "exact"),
        "points": (touching, "no"),
    }
    pegs = {
        f"{kind} {name}": value
        for kind, (contacts, normals) in kinds.items()
        for name, value in peg_error(contacts, trial, normals).items()
    }
    return xr.Dataset(data).assign_attrs(pegs)


def peg_error(placed: xr.Dataset, trial: xr.DataTree, normals: str) -> dict[str, float]:
    """Of the cylinder fitted to the contacts: metres and radians; NaN where there is none.

    With normals weighted by their covariance, exact normals, or none.
    """
    (peg,), whisker = Recording(trial).pegs, Recording(trial).whisker()
    each = placed.expand_dims(whisker=1, axis=1)
    try:
        if normals == "uncertain":
            fit = fit_contacts(each, [whisker], lean=0.0)
        else:
            fit = fit_shape(
                "cylinder",
                placed["contact_point"].values,
                placed["contact_covariance"].values + SOLVED_TO**2 * np.eye(3),
                whisker_radii(each, [whisker])[:, 0],
                normals=placed["contact_normal"].values if normals == "exact" else None,
            )
    except ValueError:
        return dict.fromkeys(PEG, np.nan)
    offset, tilt = axis_offset(fit.origin, fit.axis, peg.origin, peg.axis)
    values = (np.linalg.norm(offset), tilt, fit.diameter - 2.0 * peg.radius, fit.diameter_sigma)
    return {name: float(value) for name, value in zip(PEG, values, strict=True)}
