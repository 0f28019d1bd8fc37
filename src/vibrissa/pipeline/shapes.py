"""Which simple shape goes best with the estimated contacts.

Each shape is fitted to the contacts and asked how well they go with it: by χ² per degree of
freedom, which is 1 where shape and noise are right, and against the others by the Bayesian
information criterion on the contacts that all of them use. Contacts that err together from frame to
frame count as fewer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.contour import FittedShape, evidence_of
from vibrissa.pipeline.reconstruct import Shape, fit_contacts, frames_together, scores_of
from vibrissa.whisker import Whisker

SIMPLE: tuple[Shape, ...] = tuple(shape for shape in get_args(Shape) if shape != "free")
"""Shapes of a few numbers."""

GOES = 4.0
"""χ² per degree of freedom up to which contacts go with a shape: twice their noise."""

STRONG = 10.0
"""Difference of the information criterion from which one shape is better than another."""


def compare_shapes(
    estimates: xr.Dataset,
    whiskers: Sequence[Whisker],
    *,
    axis: ArrayLike | None = None,
    lean: float | None = None,
) -> xr.Dataset:
    """Fit all simple shapes to contacts, and tell how well each goes with them.

    Parameters
    ----------
    estimates : xarray.Dataset
        Of `estimates_of`, dims time, whisker.
    whiskers : sequence of Whisker
        That touched the object.
    axis : array_like (3,), optional
        Direction of a cylinder's axis where it is known.
    lean : float, optional
        See `fit_contacts`.

    Returns
    -------
    xarray.Dataset
        Dim ``shape``: ``misfit``, χ² per degree of freedom, and ``evidence``, by how much its
        information criterion exceeds that of the best, which has 0. Both are NaN for shapes that
        cannot be fitted, and for all where the contacts' noise is not known.

    Raises
    ------
    ValueError
        If whiskers or lean do not fit.
    """
    fits: dict[str, FittedShape] = {}
    for shape in SIMPLE:
        known = axis if shape == "cylinder" else None
        try:
            fits[shape] = fit_contacts(estimates, whiskers, shape, axis=known, lean=lean)
        except ValueError:
            continue  # perhaps there is none of this shape
    misfit, evidence = np.full((2, len(SIMPLE)), np.nan)
    if fits and min(fit.equations for fit in fits.values()) > 0:
        rows = np.all([fit.used for fit in fits.values()], axis=0)
        for i, shape in enumerate(SIMPLE):
            if shape in fits:
                fit = fits[shape]
                misfit[i] = fit.misfit
                unknowns = int(np.linalg.matrix_rank(fit.covariance, hermitian=True))
                evidence[i] = evidence_of(fit.chi_squared[rows], unknowns)
        best = fits[SIMPLE[int(np.nanargmin(evidence))]]
        together = frames_together(scores_of(best, estimates))
        evidence = (evidence - np.nanmin(evidence)) / together
    return xr.Dataset(
        {
            "misfit": ("shape", misfit, {"units": "1", "long_name": "χ² per degree of freedom"}),
            "evidence": ("shape", evidence, {"units": "1", "long_name": "evidence against it"}),
        },
        {"shape": list(SIMPLE)},
    )
