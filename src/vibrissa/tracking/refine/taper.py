"""Taper of a whisker from how contacts bend it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vibrissa.tracking.refine.fit import Fitter
from vibrissa.tracking.space.pose import BasePose
from vibrissa.tracking.space.rest_shape import Length, likeliest_taper
from vibrissa.whisker import Whisker, morphology

# Smallest number of frames in contact that show a taper or a length, and largest that is used.
_FEWEST, _FRAMES = 3, 24
# Standard deviation, along it, of where a whisker ends that frames in contact share, pixels.
_ENDED = 1.5


def some_in_contact(fitter: Fitter) -> Fitter | None:
    """The same fit restricted to some of the frames in contact, if there are enough."""
    rows = np.flatnonzero(fitter.touching)
    if len(rows) < _FEWEST:
        return None
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), _FRAMES)).astype(int)]
    curves = np.full_like(fitter.curves, np.nan)
    curves[rows] = fitter.curves[rows]
    return replace(fitter, curves=curves)


def tapered_as_it_bends(
    fitter: Fitter, whisker: Whisker, length: Length, pose: BasePose
) -> tuple[Whisker, Length]:
    """Whisker with the taper inferred from its bending, and the uncertainty of its length."""
    some = some_in_contact(fitter)
    if some is None:
        return whisker, length
    at_base, at_tip = whisker.radius(np.array([0.0, whisker.length]))

    def thicker(share: float) -> Whisker:
        return whisker.with_properties(
            tip_radius=float(at_base - (at_base - at_tip) / (1.0 + share))
        )

    thinnest = (1.0 - at_tip / at_base) / (1.0 - 1.0 / morphology.MOST_TAPER) - 1.0

    # A part of the base that views hide is that in all frames of a contact, so that errors of where
    # they show it to begin are one error; then the tip shows where it is.
    apart, count = some.traces.begun_apart, np.isfinite(some.curves[:, 0, 0]).sum()
    ends = np.array([1.0, 1.0 / _ENDED]) / np.sqrt(count) if apart else np.array([1.0, 0.0])

    def cost(share: float) -> Callable[[float], float]:
        # The first whisker sets the variance of the traces; a wrong taper would enlarge it.
        of = some.costs(min(length.shown, whisker.length), (ends[0], ends[1]))
        of(thicker(share), pose)
        return lambda other: of(thicker(other), pose)

    usual, shown = length.sigma / length.value, length.shown / length.value
    share, _ = likeliest_taper(usual, float(thinnest), cost(0.0), shown, apart)
    share, sigma = likeliest_taper(usual, float(thinnest), cost(share), shown, apart)
    found = thicker(share)
    tip = 100.0 * float(found.radius(whisker.length) / at_base)
    either = 100.0 * sigma * float(1.0 - at_tip / at_base) / (1.0 + share) ** 2
    note = f"radius of the tip: {tip:.1f} ± {either:.1f} % of the base's, from how it bends"
    found = replace(found, notes=(*found.notes, note))
    return found, length._replace(sigma=sigma * length.value)
