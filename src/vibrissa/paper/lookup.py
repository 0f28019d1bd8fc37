"""The paper's look-up table, estimates with it or a network, and its interpolation errors.

Each reachable contact of the paper's grid is a point in the space of three signals, each divided by
its range, with (r, θ, φ) as values; the table interpolates between points by natural neighbours or
linearly. A direction is an axis of one turn; points within half a radian of ±π are repeated a turn
away, so that the table has no seam. For estimates, contacts within 2° of the resting whisker are
excluded, as in the paper's figures: near rest directions become undefined, and all contacts have
nearly the same signals.

Outside the convex hull of the points the result is NaN. The hull of a curved cloud also contains
signals that no contact comes near; there the table interpolates between contacts far apart, as the
paper's does. Where two contacts have the same signals it returns one contact, a mean of both.

Estimates by a table or a network are one contact point for three signals. Force, moment and arc
length are those of the exact contact at that point, and the misfit compares this contact's signals
with the measured ones, in shares of each signal's range. The covariance is computed from central
differences of the table or network, with steps of 0.05 % of each signal's range, as in the paper's
sensitivity.

Slices and errors describe the solid that contacts occupy in the space of three signals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.contacts import (
    Candidates,
    ContactMap,
    Contacts,
    Domain,
    Prior,
    SensorNoise,
    contacts_of,
    within_paper_bounds,
)
from vibrissa.identifiability import sensitivity
from vibrissa.numerics import AnyArray, Array
from vibrissa.paper.natural_neighbour import NaturalNeighbour
from vibrissa.paper.network import NetworkSolver, train_network
from vibrissa.quantities import attributes
from vibrissa.rod import PointContact, deflect
from vibrissa.signals import (
    CIRCULAR,
    SIGNALS,
    check_signals,
    circular_among,
    measured,
    selection,
    signal_scales,
    signals_of,
    spherical,
    within_cone,
    within_turn,
)
from vibrissa.status import Status

#: Natural-neighbour interpolation as in the paper, or linear, or a function of points (n, 3) and
#: values (n, 3) that returns a function of other points (m, 3).
Interpolation: TypeAlias = (
    Literal["natural", "linear"] | Callable[[Array, Array], Callable[[Array], Array]]
)

#: Step of the paper's central differences, as a share of a signal's range.
STEP = 5e-4
# Range, over the whisker's unit of force or moment, below which a signal is considered zero.
_ZERO_RANGE = 1e-9
# Distance from ±π, in turns, within which points are repeated a turn away.
_OVERLAP = 0.08


@dataclass(frozen=True, eq=False)
class LookupTable:
    """Contact points over the space of three signals; created by :meth:`of`.

    Attributes
    ----------
    names : tuple of str
        Names of the signals.
    low, span : (3,) arrays
        Start and size of each axis's range, SI units.
    components : bool
        Whether a magnitude and its direction are replaced by two Cartesian components.
    interpolation : callable
        Function from points over the ranges to (r, θ, φ); for a :class:`NaturalNeighbour`, the
        method is a second argument.
    """

    names: tuple[str, ...]
    low: Array
    span: Array
    components: bool
    interpolation: Callable[..., Array]

    @classmethod
    def of(
        cls,
        contact_map: ContactMap,
        names: tuple[str, ...],
        components: bool = False,
        *,
        near_rest: bool = False,
        interpolation: Interpolation | None = None,
    ) -> LookupTable:
        """Create the table of three signals.

        Parameters
        ----------
        contact_map : ContactMap
            Map with the paper's grid.
        names : tuple of str
            Names of the signals, in canonical order.
        components : bool
            Whether to replace a magnitude and its direction, if both are among the signals, by two
            Cartesian components: not the paper's method, but a better one.
        near_rest : bool
            Whether to include contacts within 2° of rest.
        interpolation : {"natural", "linear"} or callable, optional
            Fixed interpolation; by default natural or linear as chosen at each look-up.

        Returns
        -------
        LookupTable
            Table of the reachable contacts.

        Raises
        ------
        ValueError
            If the map has no grid, or a signal is practically zero everywhere.
        """
        if contact_map.grid is None:
            raise ValueError("the map has no grid to look up in: simulate it with grid=True")
        grid = contact_map.grid
        reached = grid["status"].to_numpy() == int(Status.OK)
        signals = np.stack([grid[name].to_numpy()[reached] for name in names], axis=1)
        axes = [grid[name].to_numpy() for name in ("r", "theta", "phi")]
        values = np.stack([a[reached] for a in np.meshgrid(*axes, indexing="ij")], axis=1)
        if not near_rest:
            away = ~within_cone(contact_map.whisker, cartesian(values))
            signals, values = signals[away], values[away]
        circular = circular_among(names)
        if components:
            signals, circular = _with_components(signals, names)
        low = np.where(circular, -np.pi, signals.min(axis=0))
        span = np.where(circular, 2.0 * np.pi, np.ptp(signals, axis=0))
        _check_ranges(contact_map, names, span)
        points, values = _close_circle((signals - low) / span, values, circular)
        found: Callable[..., Array]
        if callable(interpolation):
            found = interpolation(points, values)
        else:
            found = NaturalNeighbour(points, values, scale=np.ones(3))
            found = found if interpolation is None else partial(found, method=interpolation)
        return cls(names, low, span, components, found)

    def points(self, signals: Array) -> Array:
        """Convert signals to the table's coordinates.

        Parameters
        ----------
        signals : (n, 3) array
            Signals, SI units.

        Returns
        -------
        (n, 3) array
            Signals, or their components, over their ranges.
        """
        signals = within_turn(signals, circular_among(self.names))
        if self.components:
            signals, _ = _with_components(signals, self.names)
        return np.asarray((signals - self.low) / self.span)

    def __call__(self, signals: Array, *method: str) -> Array:
        """Look up contact points."""
        return cartesian(self.interpolation(self.points(signals), *method))


def cartesian(spheres: Array) -> Array:
    """Convert spherical coordinates (r, θ, φ) (..., 3) to points (..., 3)."""
    r, theta, phi = np.moveaxis(spheres, -1, 0)
    across = r * np.cos(phi)
    return np.stack([across * np.cos(theta), across * np.sin(theta), r * np.sin(phi)], axis=-1)


def _close_circle(points: Array, values: Array, circular: Array) -> tuple[Array, Array]:
    """Add copies a turn away, so that directions near ±π have neighbours on both sides."""
    for k in np.flatnonzero(circular):
        turn = np.eye(3)[k]
        start, end = points[:, k] < _OVERLAP, points[:, k] > 1.0 - _OVERLAP
        points = np.concatenate([points, points[start] + turn, points[end] - turn])
        values = np.concatenate([values, values[start], values[end]])
    return points, values


def _with_components(signals: Array, names: tuple[str, ...]) -> tuple[Array, AnyArray]:
    """Replace each magnitude and its direction by components; also mark remaining directions."""
    out, circular = signals.copy(), circular_among(names)
    for size, direction in (("FT", "FD"), ("MB", "MD")):
        if size in names and direction in names:
            i, j = names.index(size), names.index(direction)
            out[:, i] = signals[:, i] * np.cos(signals[:, j])
            out[:, j] = signals[:, i] * np.sin(signals[:, j])
            circular[j] = False
    return out, circular


def _check_ranges(contact_map: ContactMap, names: tuple[str, ...], span: Array) -> None:
    """Raise a ValueError if a signal is practically zero for every contact."""
    d = contact_map.chart.discretization
    unit = {"F": d.force, "M": d.moment}
    for name, size in zip(names, span, strict=True):
        if size < _ZERO_RANGE * unit[name[0]]:
            raise ValueError(
                f"{name} is practically zero for every contact of this whisker, so that "
                f"({', '.join(names)}) do not span a table"
            )


#: Methods of estimation other than the exact one.
METHODS = ("lookup", "lookup-linear", "network")

#: Function from signals (n, 3), SI units, to contact points (n, 3), m.
Solver = Callable[[Array], Array]

# Tables and networks of existing maps, by kind and signals.
_solvers: WeakKeyDictionary[
    ContactMap, dict[tuple[str, tuple[str, ...]], LookupTable | NetworkSolver]
] = WeakKeyDictionary()


def estimate(
    contact_map: ContactMap,
    signals: xr.Dataset | Mapping[str, ArrayLike],
    using: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    *,
    method: str = "lookup",
    noise: Mapping[str, float] | ArrayLike | None = None,
    prior: Prior | None = None,
) -> Contacts:
    """Estimate contacts from three signals by the paper's look-up table or network.

    Parameters
    ----------
    contact_map : ContactMap
        Map of the whisker's contacts; with the paper's grid, for a look-up table.
    signals : Dataset or mapping
        Measured signals by name, SI units, any shape.
    using : str or tuple of str
        Three signals to use.
    method : {"lookup", "lookup-linear", "network"}
        Look-up table, interpolated by natural neighbours or linearly, or network. Each is created
        at first use and kept with the map (a network takes ten seconds).
    noise : mapping or (6, 6) array_like, optional
        Standard deviation of each signal, or covariance of (F, M), SI units, for covariances.
    prior : Prior, optional
        Restriction of the possible contacts; others get the status ``OUTSIDE_PRIOR``.

    Returns
    -------
    Contacts
        Result with at most one candidate per measurement. The status is ``APPROXIMATE``, because
        neither table nor network shows ambiguity; ``OUTSIDE_MAP`` outside the table;
        ``OUTSIDE_PRIOR``; or ``MISSING``. ``chi_squared`` is the largest difference between the
        signals of the estimated contact and those measured, in shares of their ranges.

    Raises
    ------
    ValueError
        If the method is unknown, there are not three signals, the map has no grid, or signals or
        noise are invalid.
    """
    if method not in METHODS:
        known = ", ".join(repr(name) for name in METHODS)
        raise ValueError(f"method is one of {known}; got {method!r}")
    names = selection(using)
    if len(names) != 3:
        raise ValueError(
            f"a table or network takes three signals; got {len(names)}: {', '.join(names)}"
        )
    sensor = None if noise is None else SensorNoise.of(noise, names)
    values, dims, coords = measured(signals, names)
    check_signals(values, names)
    solve = _solver(contact_map, method, names)
    rows = values.reshape(-1, 3)
    point = solve(rows)
    chart = contact_map.chart
    load = PointContact(point)
    bent = deflect(contact_map.whisker, load, proximal=chart.proximal, steps=contact_map.steps)
    status = np.where(np.isfinite(point).all(axis=1), Status.APPROXIMATE, Status.OUTSIDE_MAP)
    status[~np.isfinite(rows).all(axis=1)] = Status.MISSING
    if prior is not None:
        rows_found = np.flatnonzero(status == Status.APPROXIMATE)
        contact = (array[rows_found] for array in (point, bent.arc_length, bent.contact_force))
        allowed = prior.allows(contact_map.whisker, *contact)
        status[rows_found[~allowed]] = Status.OUTSIDE_PRIOR
    found = status == Status.APPROXIMATE
    ranges = _ranges(contact_map, names)
    covariance = np.full((len(rows), 3, 3), np.nan)
    if sensor is not None:
        sigma = sensor.covariance(names, bent.force, bent.moment)
        slope = _differences(solve, rows, ranges)
        covariance = slope @ sigma @ np.swapaxes(slope, -1, -2)
    d, most = chart.discretization, Candidates.room(len(rows), 1)
    most.number[found] = 1
    most.x[found, 0, 0] = bent.arc_length[found] / d.length
    most.x[found, 0, 1:] = bent.contact_force[found] / d.force
    most.values[found, 0, :3] = bent.force[found] / d.force
    most.values[found, 0, 3:] = point[found] / d.length
    most.covariances[found, 0] = covariance[found] / d.length**2
    misfit = _misfit(rows, bent.force, bent.moment, names, ranges)
    most.chi_squared[found, 0] = misfit[found]
    return contacts_of(most, status, misfit, d, names, values.shape[:-1], dims, coords)


def _solver(contact_map: ContactMap, method: str, names: tuple[str, ...]) -> Solver:
    """Return the table or network for three signals, created at first use."""
    made = _solvers.setdefault(contact_map, {})
    key = (method.split("-", maxsplit=1)[0], names)
    if key not in made:
        make = train_network if method == "network" else LookupTable.of
        made[key] = make(contact_map, names)
    solver = made[key]
    if isinstance(solver, NetworkSolver):
        return solver
    return lambda signals: solver(signals, "natural" if method == "lookup" else "linear")


def _ranges(contact_map: ContactMap, names: tuple[str, ...]) -> Array:
    """Range of each signal over the map, SI units; of a direction, 2π."""
    d = contact_map.chart.discretization
    values = contact_map.chart.values.reshape(-1, 6)
    known = signals_of(values[:, :3], np.cross(values[:, 3:], values[:, :3]))
    which = [SIGNALS.index(name) for name in names]
    span = np.ptp(known[:, which], axis=0) * signal_scales(names, d.force, d.moment)
    return np.where([CIRCULAR[w] for w in which], 2.0 * np.pi, span)


def _differences(solve: Solver, signals: Array, ranges: Array) -> Array:
    """∂(contact point)/∂(signals), (n, 3, 3); NaN where a step leaves the table."""
    out = np.empty((len(signals), 3, 3))
    for k in range(3):
        step = STEP * ranges[k] * np.eye(3)[k]
        with np.errstate(divide="ignore", invalid="ignore"):
            out[..., k] = (solve(signals + step) - solve(signals - step)) / (2.0 * step[k])
    return out


def _misfit(
    signals: Array, force: Array, moment: Array, names: tuple[str, ...], ranges: Array
) -> Array:
    """Largest difference (n,) between signals of contacts and measured ones, over the ranges."""
    which = [SIGNALS.index(name) for name in names]
    away = signals_of(force, moment)[:, which] - signals
    away = within_turn(away, circular_among(names))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.abs(away / ranges).max(axis=1))


# Distance from the held value, as a share of the signal's range (of a turn for an angle), within
# which the map's nodes determine the extent of a slice.
_NEAR = 0.04


def signal_slice(
    contact_map: ContactMap,
    fixed: Mapping[str, float] | None = None,
    using: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    *,
    points: int = 160,
    domain: Domain = "paper",
    interpolation: Interpolation = "natural",
) -> xr.Dataset:
    """Compute the exact contacts on a plane through the space of three signals.

    Parameters
    ----------
    contact_map : ContactMap
        Map of the whisker.
    fixed : mapping, optional
        Signal that is held constant and its value, SI units; by default the paper's M_D = 3π/2,
        which is −π/2.
    using : str or tuple of str
        Three signals.
    points : int
        Number of samples along each of the other two signals.
    domain : {"paper", "reachable"}
        Domain of contacts: within the bounds of the paper's grid, or all of Ω.
    interpolation : {"natural", "linear"} or callable
        Interpolation of the look-up for which errors are computed.

    Returns
    -------
    Dataset
        Over the two other signals, sampled more densely near zero (linearly up to the attribute
        ``linear_width`` of the coordinate, then logarithmically): the contact point, ``r``,
        ``theta`` and ``phi``, the three signals, ``n_candidates`` and ``small_deflection``, NaN
        outside the solid; and ``error_distance`` of the paper's look-up, if the map has its grid.

    Raises
    ------
    ValueError
        If other than one signal of the triplet is held, or there are too few points.
    """
    names = selection(using, exactly=3)
    fixed = {"MD": -0.5 * np.pi} if fixed is None else fixed
    if len(fixed) != 1 or not set(fixed) <= set(names):
        raise ValueError(f"one of {', '.join(names)} is to be fixed; got {dict(fixed)}")
    if points < 2:
        raise ValueError(f"a slice needs at least 2 points per side; got {points}")
    ((held, value),) = fixed.items()
    free = [name for name in names if name != held]
    axes = _axes(contact_map, held, value, free, points, domain)
    signals = xr.Dataset(
        {held: ((), value, attributes(held))},
        {
            name: (name, axis, {**attributes(name), "linear_width": width})
            for name, (axis, width) in zip(free, axes, strict=True)
        },
    )
    found = contact_map.estimate({name: signals[name] for name in names}, names)
    dims, point = found.dims, found.point
    if domain == "paper":
        point = np.where(within_paper_bounds(contact_map.whisker, point)[..., None], point, np.nan)
    out = xr.Dataset(
        {
            "contact_point": ((*dims, "space"), point, attributes("contact_point_whisker")),
            "n_candidates": (dims, found.n_candidates, attributes("candidates")),
            "small_deflection": (
                dims,
                within_cone(contact_map.whisker, point),
                {"units": "1", "long_name": "within 2° of rest"},
            ),
            held: signals[held],
        },
        signals.coords,
        {"fixed": held, "value": value, "triplet": " ".join(names)},
    )
    for i, name in enumerate(("r", "theta", "phi")):
        out[name] = (dims, spherical(point)[..., i], attributes(name))
    if contact_map.grid is not None:
        there = signals.assign(contact_point=out["contact_point"])
        out["error_distance"] = interpolation_errors(contact_map, there, names, interpolation)
    return out


def error_solid(contact_map: ContactMap, stride: int = 3) -> xr.Dataset:
    """Errors of the look-up midway between contacts of the paper's grid, where they are largest."""
    if contact_map.grid is None:
        raise ValueError("the map has no grid to interpolate: simulate it with grid=True")
    axes = [contact_map.grid[name].to_numpy() for name in ("r", "theta", "phi")]
    r, theta, phi = (0.5 * (a[1:] + a[:-1]) for a in axes)
    between = np.meshgrid(r, theta[::stride], phi[::stride], indexing="ij")
    points = cartesian(np.stack(between, axis=-1)).reshape(-1, 3)
    out = sensitivity(contact_map, ("Fx", "MB", "MD"), points)
    return out.assign(error_distance=interpolation_errors(contact_map, out))


def interpolation_errors(
    contact_map: ContactMap,
    contacts: xr.Dataset,
    using: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    interpolation: Interpolation = "natural",
) -> xr.DataArray:
    """Distances of contacts looked up in the interpolated grid from the true ones."""
    names = selection(using, exactly=3)
    values, dims, _ = measured(contacts, names)
    table = LookupTable.of(contact_map, names, near_rest=True, interpolation=interpolation)
    rows = values.reshape(-1, 3)
    known = np.isfinite(rows).all(axis=1)
    true = contacts["contact_point"].transpose(*dims, "space").to_numpy().reshape(-1, 3)
    error = np.full(len(rows), np.nan)
    error[known] = np.linalg.norm(table(rows[known]) - true[known], axis=1)
    return xr.DataArray(
        error.reshape(values.shape[:-1]),
        dims=dims,
        name="error_distance",
        attrs=attributes("error_distance"),
    )


def _axes(
    contact_map: ContactMap, held: str, value: float, free: list[str], points: int, domain: Domain
) -> list[tuple[Array, float]]:
    """Samples of the free signals over contacts near the slice, and widths of the linear parts."""
    nodes = contact_map.to_dataset(domain)
    away = np.abs(nodes[held].to_numpy() - value)
    if CIRCULAR[SIGNALS.index(held)]:
        turn = 2.0 * np.pi
        away = np.minimum(away % turn, turn - away % turn) / turn
    else:
        away /= float(nodes[held].max() - nodes[held].min())
    near = away <= max(_NEAR, float(np.nanmin(away)))
    out = []
    for name in free:
        values = nodes[name].to_numpy()[near]
        width = float(np.quantile(np.abs(values), 0.5)) or 1.0
        low, high = np.arcsinh(np.array([values.min(), values.max()]) / width)
        out.append((width * np.sinh(np.linspace(float(low), float(high), points)), width))
    return out
