"""Measured signals in, contacts out: all that explain them, each with its covariance.

For three signals T with noise covariance Σ the contact point's covariance is A Σ Aᵀ with the exact
A = ∂p/∂ξ (∂T/∂ξ)⁻¹ at the solution. For a covariance of force and moment, Σ is carried over to
the signals by their derivatives.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from vibrissa.mapping.contact_map import spherical
from vibrissa.mapping.inversion import Contacts, invert, polish
from vibrissa.quantities import attributes
from vibrissa.rod.arrays import Array, IntArray
from vibrissa.rod.batch import solve_forces
from vibrissa.rod.newton import TOLERANCE
from vibrissa.rod.reach import with_normal_force
from vibrissa.signals import CIRCULAR, SIGNALS, Coordinates, measured, selection, signal_scales
from vibrissa.signals.base import signal_derivatives, signals_of, wrench_derivatives
from vibrissa.status import Status, flag_attributes

if TYPE_CHECKING:
    from vibrissa.mapping.contact_map import ContactMap


@dataclass(frozen=True, eq=False)
class Estimate:
    """Contacts that explain measured signals, whisker frame, SI units.

    Attributes
    ----------
    point : (..., 3) array
        Contact point of the most plausible candidate (least force), m; NaN where there is none.
    covariance : (..., 3, 3) array
        Its covariance, m²; NaN without ``noise``.
    status : (...) int array
        :class:`~vibrissa.Status`: ``UNIQUE``, ``AMBIGUOUS``, ``NOT_FRICTIONLESS``, ``OUTSIDE_MAP``
        or ``MISSING``.
    misfit : (...) array
        0 where the signals are explained; else how far, in shares of each signal's range, they are
        from the nearest ones that are.
    arc_length : (...) array
        Arc length of the contact, m.
    force, moment : (..., 3) arrays
        Base force and moment of the candidate, N and N·m.
    candidates : (..., k, 3) array
        Contact points of all candidates by rising force, padded with NaN, m.
    candidate_covariances : (..., k, 3, 3) array
        Their covariances, m²; NaN without ``noise``.
    n_candidates : (...) int array
        How many.
    triplet : tuple of str
        The signals used.
    dims : tuple of str
        Names of the leading dimensions.
    coords : dict
        Coordinates along them.
    """

    point: Array
    covariance: Array
    status: IntArray
    misfit: Array
    arc_length: Array
    force: Array
    moment: Array
    candidates: Array
    candidate_covariances: Array
    n_candidates: IntArray
    triplet: tuple[str, ...]
    dims: tuple[str, ...]
    coords: Coordinates

    @property
    def spherical(self) -> Array:
        """(r, θ, φ) of the contact point: m and rad, shape (..., 3)."""
        return spherical(self.point)

    def to_dataset(self) -> xr.Dataset:
        """Return everything as a labelled dataset.

        Returns
        -------
        Dataset
            Over the measurements' dimensions, ``space`` and ``candidate``.
        """
        dims, space = self.dims, (*self.dims, "space")
        r, theta, phi = np.moveaxis(self.spherical, -1, 0)
        return xr.Dataset(
            {
                "contact_point": (space, self.point, attributes("contact_point_whisker")),
                "r": (dims, r, attributes("r")),
                "theta": (dims, theta, attributes("theta")),
                "phi": (dims, phi, attributes("phi")),
                "covariance": ((*space, "space_2"), self.covariance, attributes("covariance")),
                "arc_length": (dims, self.arc_length, attributes("arc_length")),
                "force": (space, self.force, attributes("force")),
                "moment": (space, self.moment, attributes("moment")),
                "misfit": (dims, self.misfit, attributes("misfit")),
                "candidates": (
                    (*dims, "candidate", "space"),
                    self.candidates,
                    attributes("contact_point_whisker"),
                ),
                "candidate_covariances": (
                    (*dims, "candidate", "space", "space_2"),
                    self.candidate_covariances,
                    attributes("covariance"),
                ),
                "n_candidates": (
                    dims,
                    self.n_candidates,
                    {"units": "1", "long_name": "candidates"},
                ),
                "status": (dims, self.status, {**attributes("status"), **flag_attributes()}),
            },
            coords={**self.coords, "space": ["x", "y", "z"], "space_2": ["x", "y", "z"]},
            attrs={"triplet": " ".join(self.triplet)},
        )

    def __repr__(self) -> str:
        """Say how many there are and what became of them."""
        counts = ", ".join(
            f"{Status(code).name.lower().replace('_', ' ')} {count}"
            for code, count in zip(*np.unique(self.status, return_counts=True), strict=True)
        )
        return (
            f"<Estimate of {self.status.shape or 'one'} from ({', '.join(self.triplet)}): {counts}>"
        )


def estimate(
    contacts: ContactMap,
    signals: xr.Dataset | Mapping[str, ArrayLike],
    triplet: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    noise: Mapping[str, float] | ArrayLike | None = None,
    method: str = "exact",
) -> Estimate:
    """Find all frictionless contacts of a whisker that explain three measured signals.

    Parameters
    ----------
    contacts : ContactMap
        The whisker's map.
    signals : Dataset or mapping
        Measured signals by name, SI units, any shape; NaN means missing.
    triplet : str or tuple of str
        The three to use.
    noise : mapping or (6, 6) array_like, optional
        Standard deviation of each signal of the triplet, or covariance of (F, M), SI units.
    method : {"exact"}
        How.

    Returns
    -------
    Estimate
        Row by row.

    Raises
    ------
    ValueError
        If signals are missing or of different shapes, or the noise does not fit.
    """
    if method != "exact":
        raise ValueError(f"method is 'exact'; got {method!r}")
    names = selection(triplet, exactly=3)
    sigma = None if noise is None else _checked_noise(noise, names)
    values, dims, coords = measured(signals, names)
    _check_signals(values, names)
    shape = values.shape[:-1]
    flat = values.reshape(-1, 3)
    chart = contacts.chart
    d = chart.discretization
    scale = signal_scales(names, d.force, d.moment)
    found = invert(chart, contacts.tree(names), names, flat / scale)
    best = found.values[:, 0]
    force, point = best[:, :3] * d.force, best[:, 3:] * d.length
    status = np.where(found.number == 1, int(Status.UNIQUE), int(Status.AMBIGUOUS))
    misfit = np.zeros(len(flat))
    _explain(contacts, names, flat / scale, found, status, misfit)
    covariances = np.full((*found.contacts.shape[:2], 3, 3), np.nan)
    if sigma is not None:
        covariances = _covariances(contacts, names, found, sigma)
    most = max(1, int(found.number.max(initial=0)))
    return Estimate(
        point=point.reshape(*shape, 3),
        covariance=covariances[:, 0].reshape(*shape, 3, 3),
        status=status.reshape(shape),
        misfit=misfit.reshape(shape),
        arc_length=(found.contacts[:, 0, 0] * d.length).reshape(shape),
        force=force.reshape(*shape, 3),
        moment=np.cross(point, force).reshape(*shape, 3),
        candidates=(found.values[:, :most, 3:] * d.length).reshape(*shape, most, 3),
        candidate_covariances=covariances[:, :most].reshape(*shape, most, 3, 3),
        n_candidates=found.number.reshape(shape),
        triplet=names,
        dims=dims,
        coords=coords,
    )


def _check_signals(values: Array, names: tuple[str, ...]) -> None:
    """Raise a ValueError for what no sensor in SI units can say."""
    for k, name in enumerate(names):
        if name in ("FT", "MB") and (values[..., k] < 0.0).any():
            raise ValueError(
                f"{name} is a size and cannot be negative; got {np.nanmin(values[..., k])}"
            )
        if CIRCULAR[SIGNALS.index(name)] and (np.abs(values[..., k]) > 2.0 * np.pi).any():
            largest = np.nanmax(np.abs(values[..., k]))
            raise ValueError(
                f"{name} is an angle in rad; got {largest:g}, which looks like degrees"
            )


def _explain(
    contacts: ContactMap,
    names: tuple[str, ...],
    targets: Array,
    found: Contacts,
    status: IntArray,
    misfit: Array,
) -> None:
    """Say why measurements without a contact have none."""
    missing = ~np.isfinite(targets).all(axis=1)
    status[missing], misfit[missing] = int(Status.MISSING), np.nan
    rows = np.flatnonzero((found.number == 0) & ~missing)
    if not rows.size:
        return
    chart = contacts.chart
    which = [SIGNALS.index(name) for name in names]
    values = chart.values.reshape(-1, 6)
    known = signals_of(values[:, :3], np.cross(values[:, 3:], values[:, :3]))[:, which]
    size = np.where([CIRCULAR[w] for w in which], 1.0, np.ptp(known, axis=0))
    _, nearest = cKDTree(_on_circle(known, which, size)).query(
        _on_circle(targets[rows], which, size)
    )
    away = known[nearest] - targets[rows]
    turned = np.array([CIRCULAR[w] for w in which])
    away = np.where(turned, (away + np.pi) % (2.0 * np.pi) - np.pi, away)
    span = np.where(turned, 2.0 * np.pi, size)
    misfit[rows] = np.abs(away / span).max(axis=1)
    # Perhaps a contact nearer to the base than the map goes explains them.
    start = chart.contacts.reshape(-1, 3)[nearest]
    xi, _, residual, sign = polish(chart, names, targets[rows], start)
    nearer = (residual <= TOLERANCE) & (sign > 0.0) & (xi[:, 0] < chart.proximal)
    status[rows] = np.where(nearer, int(Status.OUTSIDE_MAP), int(Status.NOT_FRICTIONLESS))
    # Forces and moments of zero come from a whisker that touches nothing.
    sizes = np.where(turned, 0.0, np.abs(targets[rows]))
    status[rows[sizes.max(axis=1) == 0.0]] = int(Status.DEGENERATE)


def _on_circle(values: Array, which: list[int], size: Array) -> Array:
    """Signals as places in a space where distance means difference: angles on the unit circle."""
    parts = []
    for k, w in enumerate(which):
        v = values[:, k]
        parts += [np.cos(v), np.sin(v)] if CIRCULAR[w] else [v / size[k]]
    return np.stack(parts, axis=1)


def _covariances(
    contacts: ContactMap,
    names: tuple[str, ...],
    found: Contacts,
    noise: dict[str, float] | Array,
) -> Array:
    """Covariances (n, k, 3, 3) of the candidates' contact points, m²."""
    d = contacts.chart.discretization
    out = np.full((*found.contacts.shape[:2], 3, 3), np.nan)
    there = np.arange(out.shape[1]) < found.number[:, None]
    if not there.any():
        return out
    values, tangents = solve_forces(d, with_normal_force(found.contacts[there]), tangents=True)
    which = [SIGNALS.index(name) for name in names]
    by_contact = signal_derivatives(values, tangents)[:, which]
    sigma = _signal_covariance(noise, names, values, d.force, d.moment)
    with np.errstate(all="ignore"):
        determined = np.abs(np.linalg.det(by_contact)) > 0.0
        good = determined & np.isfinite(by_contact).all(axis=(1, 2))
        inverse = np.full_like(by_contact, np.nan)
        inverse[good] = np.linalg.inv(by_contact[good])
        a = d.length * tangents[:, 3:] @ inverse
        out[there] = a @ sigma @ np.swapaxes(a, -1, -2)
    return out


def _checked_noise(
    noise: Mapping[str, float] | ArrayLike, names: tuple[str, ...]
) -> dict[str, float] | Array:
    """Standard deviations of the signals, or a covariance of (F, M); a ValueError otherwise."""
    if isinstance(noise, Mapping):
        missing = [name for name in names if name not in noise]
        if missing:
            raise ValueError(
                f"noise lacks {', '.join(missing)}; it has {', '.join(noise) or 'none'}"
            )
        sigma = {name: float(noise[name]) for name in names}
        if not all(0.0 <= value < np.inf for value in sigma.values()):
            raise ValueError(f"noise must be standard deviations ≥ 0; got {sigma}")
        return sigma
    wrench = np.asarray(noise, dtype=np.float64)
    if wrench.shape != (6, 6) or not np.allclose(wrench, wrench.T, rtol=1e-9, atol=0.0):
        raise ValueError(
            "noise must be {signal: standard deviation} or a symmetric 6 × 6 covariance of (F, M); "
            f"got shape {wrench.shape}"
        )
    return wrench


def _signal_covariance(
    noise: dict[str, float] | Array,
    names: tuple[str, ...],
    values: Array,
    force: float,
    moment: float,
) -> Array:
    """Covariance of the chosen signals, non-dimensional, (n, 3, 3)."""
    if isinstance(noise, dict):
        scale = signal_scales(names, force, moment)
        sigma = np.array([noise[name] for name in names]) / scale
        return np.broadcast_to(np.diag(sigma**2), (len(values), 3, 3))
    sizes = np.repeat([force, moment], 3)
    which = [SIGNALS.index(name) for name in names]
    moments = np.cross(values[:, 3:], values[:, :3])
    g = wrench_derivatives(values[:, :3], moments)[:, which]
    return np.asarray(g @ (noise / np.outer(sizes, sizes)) @ np.swapaxes(g, -1, -2))
