"""What the paper found about sensitivity, as numbers for any whisker.

Huet, Emnett & Hartmann (2022) found three things of the Jacobian ∂(r, θ, φ)/∂(M_D, M_B, F_x): M_D
acts mainly on θ and φ; the mapping is most sensitive where F_x and M_B are small; concave forward
and backward differ. Each has a number here, from the exact derivatives; see
:func:`sensitivity_findings`.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from vibrissa.numerics import Array, contact_weights, weighted_quantile

#: Central share of a quantity's values that makes its range.
RANGE = 0.99
_FIFTH = 0.2


def sensitivity_findings(data: xr.Dataset, region: xr.DataArray | None = None) -> xr.Dataset:
    """Sum up derivatives: which signal acts on what, where they are large, which side differs.

    Parameters
    ----------
    data : Dataset
        From :func:`~vibrissa.sensitivity`, of any triplet.
    region : DataArray of bool, optional
        Contacts to sum up, such as ``data.within_paper_bounds & ~data.small_deflection``; by
        default those outside the cone of 2° about rest.

    Returns
    -------
    Dataset
        Medians, each contact counted by the volume that it stands for:

        - ``median_size`` (coordinate, signal): of |∂c/∂s|, SI units;
        - ``relative_size`` (coordinate, signal): of |∂c/∂s| times the range of s over the range
          of c (99 % of the values each): how many ranges the coordinate would move for one range of
          the signal;
        - ``share_of_motion`` (coordinate, signal): the mean squared share of the motion of the
          contact point that goes along r, θ and φ (all in m) when one signal changes;
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
    ranges = {n: _range(flat[n], weight) for n in flat}
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
                    _stacked([_small_over_large(size, flat[n], weight) for n in sorted_by]),
                    ratio,
                ),
                "rank_correlation": (
                    (*both, "sorted_by"),
                    _stacked([_rank_correlations(size, flat[n], weight) for n in sorted_by]),
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


def _stacked(tables: list[Array]) -> Array:
    return np.stack(tables, axis=-1) if tables else np.empty((3, 3, 0))


def _range(values: Array, weight: Array) -> float:
    low, high = weighted_quantile(values, weight, np.array([0.5 - 0.5 * RANGE, 0.5 + 0.5 * RANGE]))
    return float(high - low)


def _medians(size: Array, weight: Array) -> Array:
    """Medians (3, 3) of sizes (n, 3, 3)."""
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
    """Medians over the fifth with the smallest |signal|, over those with the largest."""
    signal = np.abs(signal)
    low, high = weighted_quantile(signal, weight, np.array([_FIFTH, 1.0 - _FIFTH]))
    return _medians(size, weight * (signal <= low)) / _medians(size, weight * (signal >= high))


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
    """Weighted ranks; equal values are as good as never there."""
    order = np.argsort(values, kind="stable")
    ranks = np.empty_like(values)
    ranks[order] = np.cumsum(weight[order]) - 0.5 * weight[order]
    return ranks
