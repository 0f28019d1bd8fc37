"""The six signals at the base of a whisker, their triplets, and regions of contact."""

from vibrissa.signals.base import (
    CIRCULAR,
    SIGNALS,
    Coordinates,
    base_signals,
    circular_among,
    labelled_wrench,
    measured,
    signal_derivatives,
    signal_equations,
    signal_scales,
    signals_of,
    within_turn,
    wrench_derivatives,
)
from vibrissa.signals.regions import (
    CONE,
    REGIONS,
    concave_backward,
    cone_angle,
    in_region,
    nearest_on_rest,
    resting,
    within_cone,
)
from vibrissa.signals.triplets import TRIPLETS, selection

__all__ = [
    "CIRCULAR",
    "CONE",
    "REGIONS",
    "SIGNALS",
    "TRIPLETS",
    "Coordinates",
    "base_signals",
    "circular_among",
    "concave_backward",
    "cone_angle",
    "in_region",
    "labelled_wrench",
    "measured",
    "nearest_on_rest",
    "resting",
    "selection",
    "signal_derivatives",
    "signal_equations",
    "signal_scales",
    "signals_of",
    "within_cone",
    "within_turn",
    "wrench_derivatives",
]
