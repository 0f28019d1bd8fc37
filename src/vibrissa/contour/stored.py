"""Fitted shapes from the datasets that they were written to."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from vibrissa.contour.cylinder import CylinderFit
from vibrissa.contour.free import FreeFit
from vibrissa.contour.merging import Support
from vibrissa.contour.plane import PlaneFit
from vibrissa.contour.shape import FittedShape
from vibrissa.contour.sphere import SphereFit

_KINDS: dict[str, type[CylinderFit] | type[SphereFit] | type[PlaneFit]] = {
    fit.kind: fit for fit in (CylinderFit, SphereFit, PlaneFit)
}


def shape_from_dataset(dataset: xr.Dataset) -> FittedShape:
    """Make a fitted shape again.

    Parameters
    ----------
    dataset : xarray.Dataset
        Of ``FittedShape.to_dataset``.

    Returns
    -------
    CylinderFit, SphereFit, PlaneFit or FreeFit
        As it was; residuals and inliers in one row.

    Raises
    ------
    ValueError
        If it is of an unknown kind, or something is missing.
    """
    kind = dataset.attrs.get("shape")
    if kind not in (*_KINDS, FreeFit.kind):
        raise ValueError(f"the shape is {kind!r}; one of {', '.join(_KINDS)} or free is known")
    return _free(dataset) if kind == FreeFit.kind else _simple(dataset, _KINDS[kind])


def _simple(
    dataset: xr.Dataset, known: type[CylinderFit] | type[SphereFit] | type[PlaneFit]
) -> FittedShape:
    _complete(dataset, known.kind, {"parameter_covariance", *known.fields.values()})
    values: dict[str, Any] = {}
    for name, quantity in known.fields.items():
        value = dataset[quantity].values.astype(np.float64)
        values[name] = float(value) if value.ndim == 0 else value
    return known(covariance=dataset["parameter_covariance"].values, **_rows(dataset), **values)


def _free(dataset: xr.Dataset) -> FreeFit:
    support = ("support_point", "support_value", "support_variance")
    _complete(dataset, FreeFit.kind, {*support, "shape_amplitude", "shape_length"})
    base = dataset.attrs.get("base")
    if base not in _KINDS:
        raise ValueError(f"a free surface deviates from {base!r}; {', '.join(_KINDS)} are known")
    simple = _simple(dataset, _KINDS[base])
    return FreeFit(
        base=simple,
        support=Support(*(dataset[name].values for name in support)),
        amplitude=float(dataset["shape_amplitude"]),
        length=float(dataset["shape_length"]),
        covariance=simple.covariance,
        **_rows(dataset),
    )


def _complete(dataset: xr.Dataset, kind: str, names: set[str]) -> None:
    each = {"surface_distance", "inlier", "chi_squared"}
    missing = sorted((names | each) - set(dataset.data_vars))
    if missing:
        raise ValueError(f"a fitted {kind} lacks {', '.join(missing)}")


def _rows(dataset: xr.Dataset) -> dict[str, Any]:
    """Residuals and inliers in one row."""
    return {
        "residuals": dataset["surface_distance"].values.reshape(-1),
        "inliers": dataset["inlier"].values.reshape(-1).astype(bool),
        "chi_squared": dataset["chi_squared"].values.reshape(-1),
        "equations": int(dataset.attrs.get("equations", 0)),
    }
