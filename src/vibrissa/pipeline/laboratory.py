"""From the whisker's frame to the laboratory: contact points and normals, and which of several."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.contacts import spherical
from vibrissa.contour import continuing_candidates, to_laboratory
from vibrissa.quantities import attributes

Array = NDArray[np.float64]

_LABORATORY = {"reference_frame": "laboratory"}
_SQUARE = ("time", "space", "space_2")


def in_laboratory(
    contacts: xr.Dataset,
    base_rotation: ArrayLike,
    base_position: ArrayLike,
    pose_covariance: ArrayLike | None = None,
    pose_wrench_covariance: ArrayLike | None = None,
) -> xr.Dataset:
    """Bring contacts to the laboratory, and choose among candidates by continuity there.

    Parameters
    ----------
    contacts : xarray.Dataset
        Of `locate`.
    base_rotation : array_like (n, 3, 3)
        From the whisker's to the laboratory frame, frame by frame.
    base_position : array_like (n, 3)
        The base in the laboratory, m.
    pose_covariance : array_like (n, 6, 6), optional
        Of that position, m, and of a small turn about the laboratory's axes, rad; exact by default.
    pose_wrench_covariance : array_like (n, 6, 6), optional
        Of position and turn with (F, M); none by default, as for a sensor that knows of no camera.

    Returns
    -------
    xarray.Dataset
        With ``contact_point``, ``contact_covariance`` and ``contact_normal`` with
        ``normal_covariance`` and ``point_normal_covariance``, laboratory frame; all of the
        candidate chosen.
    """
    rotation, position = np.asarray(base_rotation), np.asarray(base_position)
    points = contacts["candidate_points"].values
    lab = to_laboratory(points, rotation[:, None], position[:, None])
    felt = np.flatnonzero(contacts["in_contact"].values)
    chosen = np.full(len(points), -1)
    chosen[felt] = continuing_candidates(lab[felt], felt)
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
    spread = _placed_covariance(
        gain,
        contacts["wrench_covariance"].values,
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


def _placed_covariance(
    gain: Array,
    wrench: Array,
    rotation: Array,
    arm: Array,
    normal: Array,
    pose: Array | None,
    pose_wrench: Array | None,
) -> Array:
    """Covariances (n, 6, 6) of contact point and normal in the laboratory.

    An error of the wrench moves both through the gain; one of the pose, a shift and a turn, moves
    the point by shift + turn × arm and the normal by turn × normal.
    """
    turned = np.zeros((len(gain), 6, 6))
    turned[:, :3, :3] = turned[:, 3:, 3:] = rotation
    felt = turned @ gain
    out = felt @ wrench @ np.swapaxes(felt, 1, 2)
    if pose is not None:
        held = np.zeros((len(gain), 6, 6))
        held[:, :3, :3] = np.eye(3)
        held[:, :3, 3:], held[:, 3:, 3:] = -cross_matrices(arm), -cross_matrices(normal)
        out = out + held @ pose @ np.swapaxes(held, 1, 2)
        if pose_wrench is not None:
            both = held @ pose_wrench @ np.swapaxes(felt, 1, 2)
            out = out + both + np.swapaxes(both, 1, 2)
    return np.asarray(out)


def cross_matrices(vectors: Array) -> Array:
    """Write cross products with vectors as matrices."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)


def _chosen(candidates: xr.DataArray, chosen: NDArray[np.int64]) -> xr.DataArray:
    """One candidate of each frame; NaN where the number is -1."""
    which = xr.DataArray(np.maximum(chosen, 0), dims="time")
    return candidates.isel(candidate=which).where(xr.DataArray(chosen >= 0, dims="time"))


def contact_columns(contacts: xr.Dataset) -> xr.Dataset:
    """Spread contacts over the columns of a table of contacts, whisker's frame.

    Parameters
    ----------
    contacts : xarray.Dataset
        Of `locate` or `in_laboratory`.

    Returns
    -------
    xarray.Dataset
        Dim time: x, y, z, r, theta, phi, sigma_x, sigma_y, sigma_z and status.
    """
    point = contacts["contact_point_whisker"].values
    variance = np.einsum("tii->ti", contacts["covariance"].values)
    values = np.concatenate([point, spherical(point), np.sqrt(variance)], axis=1)
    names = ("x", "y", "z", "r", "theta", "phi", "sigma_x", "sigma_y", "sigma_z")
    columns = {name: ("time", values[:, i], attributes(name)) for i, name in enumerate(names)}
    table = xr.Dataset(columns, {"time": contacts["time"]}, contacts.attrs)
    return table.assign(status=contacts["status"])
