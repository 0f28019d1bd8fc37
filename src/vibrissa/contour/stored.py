"""Fitted shapes from the datasets that they were written to."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from vibrissa.contour.cylinder import CylinderFit
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
    CylinderFit, SphereFit or PlaneFit
        As it was; residuals and inliers in one row.

    Raises
    ------
    ValueError
        If it is of an unknown kind, or something is missing.
    """
    kind = dataset.attrs.get("shape")
    if kind not in _KINDS:
        raise ValueError(f"the shape is {kind!r}; one of {', '.join(_KINDS)} is known")
    known = _KINDS[kind]
    stored = {"parameter_covariance", "surface_distance", "inlier", *known.fields.values()}
    missing = sorted(stored - set(dataset.data_vars))
    if missing:
        raise ValueError(f"a fitted {kind} lacks {', '.join(missing)}")
    values: dict[str, Any] = {}
    for name, quantity in known.fields.items():
        value = dataset[quantity].values.astype(np.float64)
        values[name] = float(value) if value.ndim == 0 else value
    return known(
        covariance=dataset["parameter_covariance"].values,
        residuals=dataset["surface_distance"].values.reshape(-1),
        inliers=dataset["inlier"].values.reshape(-1).astype(bool),
        **values,
    )
