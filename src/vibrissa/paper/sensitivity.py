"""The paper's sensitivity by central differences of its look-up table, and its findings.

The derivative by a signal is the central difference over one step (0.05 % of the signal's range) to
either side. Its accuracy is limited by the table's, and it is undefined where a step leaves the
table; the exact derivatives are those of :func:`vibrissa.sensitivity`.

Huet, Emnett & Hartmann (2022) have three findings about the Jacobian ∂(r, θ, φ)/∂(M_D, M_B, F_x):
M_D acts mainly on θ and φ; the mapping is most sensitive where F_x and M_B are small; concave
forward and backward differ. :func:`sensitivity_findings` quantifies each by exact derivatives.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from vibrissa.contacts import At, ContactMap, Noise, SensorNoise, ellipsoids, spherical_derivatives
from vibrissa.identifiability import sensitivity
from vibrissa.numerics import Array, contact_weights, small_over_large, weighted_quantile
from vibrissa.paper.lookup import STEP, Interpolation, LookupTable
from vibrissa.signals import SIGNALS, measured, selection


def central_differences(
    contact_map: ContactMap,
    using: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    at: At = None,
    *,
    noise: Noise | None = None,
    interpolation: Interpolation = "natural",
    step: float = STEP,
) -> xr.Dataset:
    """Compute derivatives of the contact point by central differences of the paper's grid.

    Parameters
    ----------
    contact_map : ContactMap
        Map with the paper's grid.
    using : str or tuple of str
        Names of the three signals.
    at : Dataset, DataTree, mapping, array_like, "grid" or None
        Contacts, as for :func:`vibrissa.sensitivity`.
    noise : mapping or (6, 6) array_like, optional
        Standard deviation of each signal, or covariance of (F, M), SI units, from which error
        ellipsoids are computed.
    interpolation : {"natural", "linear"} or callable
        Natural-neighbour interpolation as in the paper, or linear; or a function that, called as
        ``interpolation(points, values)``, returns a function of other points.
    step : float
        Step of the differences, as a share of each signal's range; the paper's is 0.05 %.

    Returns
    -------
    Dataset
        Variables of :func:`vibrissa.sensitivity`; NaN where a step leaves the table, and everywhere
        if one of the signals is practically zero throughout.

    Raises
    ------
    ValueError
        If the map has no grid, or signals, contacts, noise or step are invalid.
    """
    if not 0.0 < step < 1.0:
        raise ValueError(f"the step is a share of the range, above 0 and below 1; got {step}")
    names = selection(using, exactly=3)
    out = sensitivity(contact_map, names, at, noise=noise)
    values, dims, _ = measured(out, names)
    table = LookupTable.of(contact_map, names, near_rest=True, interpolation=interpolation)
    in_sphere = _differences(table, values.reshape(-1, 3), step)
    point = out["contact_point"].transpose(*dims, "space").to_numpy().reshape(-1, 3)
    turned = spherical_derivatives(point)
    known = np.isfinite(turned).all(axis=(1, 2))
    turned[known], turned[~known] = np.linalg.inv(turned[known]), np.nan
    by_signal = turned @ in_sphere
    shape = values.shape[:-1]
    for name, matrix in (("sensitivity", in_sphere), ("point_sensitivity", by_signal)):
        exact = out[name].transpose(*dims, ...)
        out[name] = exact.copy(data=matrix.reshape(exact.shape))
    if noise is not None:
        sigma = SensorNoise.of(noise, names).covariance(names, *_wrench(out, dims))
        covariance = by_signal @ sigma @ np.swapaxes(by_signal, -1, -2)
        out = out.assign(ellipsoids(covariance, dims, shape).data_vars)
    return out.assign_attrs(method="differences")


def _differences(table: LookupTable, signals: Array, step: float) -> Array:
    """∂(r, θ, φ)/∂(signals), (n, 3, 3), at signals (n, 3)."""
    out = np.full((len(signals), 3, 3), np.nan)
    points = table.points(signals)
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    for k in range(3):
        aside = step * np.eye(3)[k]
        more, less = (
            np.asarray(table.interpolation(points[rows] + side)) for side in (aside, -aside)
        )
        out[rows, :, k] = (more - less) / (2.0 * step * table.span[k])
    return out


def _wrench(contacts: xr.Dataset, dims: tuple[str, ...]) -> tuple[Array, Array]:
    """Force and moment (n, 3) of contacts, from their six signals."""
    signals = {name: contacts[name].transpose(*dims).to_numpy().ravel() for name in SIGNALS}
    force, moment = (
        np.stack(
            [
                signals[along],
                signals[across] * np.cos(signals[direction]),
                signals[across] * np.sin(signals[direction]),
            ],
            axis=1,
        )
        for along, across, direction in (("Fx", "FT", "FD"), ("Mx", "MB", "MD"))
    )
    return force, moment


#: Central share of a quantity's values that defines its range.
RANGE = 0.99


def sensitivity_findings(data: xr.Dataset, region: xr.DataArray | None = None) -> xr.Dataset:
    """Summarise derivatives: effect of each signal, where it is large, and how the sides differ.

    Parameters
    ----------
    data : Dataset
        Result of :func:`~vibrissa.sensitivity`, for any triplet.
    region : DataArray of bool, optional
        Contacts to include, such as ``data.within_paper_bounds & ~data.small_deflection``; by
        default those outside the cone of 2° about rest.

    Returns
    -------
    Dataset
        Medians, with each contact weighted by the volume that it represents:

        - ``median_size`` (coordinate, signal): of |∂c/∂s|, SI units;
        - ``relative_size`` (coordinate, signal): of |∂c/∂s| times the range of s over the range
          of c (99 % of the values each): by how many of its ranges the coordinate would change for
          one range of the signal;
        - ``share_of_motion`` (coordinate, signal): the mean squared share of the motion of the
          contact point along r, θ and φ (all in m) when one signal changes;
        - ``small_over_large`` (coordinate, signal, sorted_by): the median of |∂c/∂s| over the
          fifth of contacts with the smallest |signal|, over that of the fifth with the largest;
        - ``rank_correlation`` (coordinate, signal, sorted_by): Spearman's, of |∂c/∂s| with
          |signal|;
        - ``backward_over_forward`` (coordinate, signal): the median for concave backward over that
          for concave forward.
    """
    weight = contact_weights(data, region)
    names = [str(n) for n in data["signal"].values]
    jacobian = data["sensitivity"].transpose(*data["status"].dims, "coordinate", "signal")
    size = np.abs(jacobian.to_numpy().reshape(-1, 3, 3))
    flat = {n: data[n].to_numpy().ravel() for n in ("r", "theta", "phi", *names)}
    sorted_by = [n for n in names if n not in ("FD", "MD")]
    backward = data["concave_backward"].to_numpy().ravel()
    ends = np.array([0.5 - 0.5 * RANGE, 0.5 + 0.5 * RANGE])
    ranges = {n: float(np.diff(weighted_quantile(v, weight, ends))[0]) for n, v in flat.items()}
    scale = np.array([[ranges[s] / ranges[c] for s in names] for c in ("r", "theta", "phi")])
    median = _medians(size, weight)
    both = ("coordinate", "signal")
    ratio = {"units": "1"}
    with np.errstate(divide="ignore", invalid="ignore"):
        out = xr.Dataset(
            {
                "median_size": (both, median, dict(data["sensitivity"].attrs)),
                "relative_size": (both, median * scale, ratio),
                "share_of_motion": (both, _motion(size, flat["r"], flat["phi"], weight), ratio),
                "small_over_large": (
                    (*both, "sorted_by"),
                    _stack_tables([_small_over_large(size, flat[n], weight) for n in sorted_by]),
                    ratio,
                ),
                "rank_correlation": (
                    (*both, "sorted_by"),
                    _stack_tables([_rank_correlations(size, flat[n], weight) for n in sorted_by]),
                    ratio,
                ),
                "backward_over_forward": (
                    both,
                    _medians(size, weight * backward) / _medians(size, weight * ~backward),
                    ratio,
                ),
            },
            {"coordinate": ["r", "theta", "phi"], "signal": names, "sorted_by": sorted_by},
        )
    for name, variable in out.data_vars.items():
        variable.attrs["long_name"] = str(name).replace("_", " ")
    return out


def _stack_tables(tables: list[Array]) -> Array:
    """Stack tables along a last axis."""
    return np.stack(tables, axis=-1) if tables else np.empty((3, 3, 0))


def _medians(size: Array, weight: Array) -> Array:
    """Weighted medians (3, 3) of sizes (n, 3, 3)."""
    return np.array(
        [[float(weighted_quantile(size[:, i, j], weight)) for j in range(3)] for i in range(3)]
    )


def _motion(size: Array, r: Array, phi: Array, weight: Array) -> Array:
    """Mean squared share (3, 3) of the motion along r, θ and φ, for each signal."""
    metres = size * np.stack([np.ones_like(r), r * np.cos(phi), r], axis=1)[:, :, None]
    squares = metres**2
    with np.errstate(invalid="ignore"):
        shares = squares / squares.sum(axis=1, keepdims=True)
    known = np.isfinite(shares).all(axis=(1, 2)) & (weight > 0.0)
    if not known.any():
        return np.full((3, 3), np.nan)
    return np.asarray(np.average(shares[known], axis=0, weights=weight[known]))


def _small_over_large(size: Array, signal: Array, weight: Array) -> Array:
    """Ratios (3, 3) of sizes (n, 3, 3) where the signal is small and where it is large."""
    return np.array(
        [[small_over_large(size[:, i, j], signal, weight) for j in range(3)] for i in range(3)]
    )


def _rank_correlations(size: Array, signal: Array, weight: Array) -> Array:
    """Spearman's rank correlation (3, 3) of sizes with |signal|, weighted."""
    out = np.full((3, 3), np.nan)
    for i in range(3):
        for j in range(3):
            rows = np.isfinite(size[:, i, j]) & np.isfinite(signal) & (weight > 0.0)
            if rows.sum() > 2:
                w = weight[rows]
                a, b = _ranks(size[rows, i, j], w), _ranks(np.abs(signal[rows]), w)
                c = np.cov(a, b, aweights=w)
                out[i, j] = c[0, 1] / np.sqrt(c[0, 0] * c[1, 1])
    return out


def _ranks(values: Array, weight: Array) -> Array:
    """Weighted ranks; ties, which practically do not occur, are broken by position."""
    order = np.argsort(values, kind="stable")
    ranks = np.empty_like(values)
    ranks[order] = np.cumsum(weight[order]) - 0.5 * weight[order]
    return ranks
