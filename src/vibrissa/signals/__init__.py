"""What the follicle feels: six signals, their triplets, and regions of contact."""

from vibrissa.signals.base import (
    CIRCULAR,
    SIGNALS,
    Coordinates,
    base_signals,
    circular_among,
    labelled_wrench,
    measured,
    signal_scales,
    within_turn,
)
from vibrissa.signals.regions import (
    CONE,
    REGIONS,
    concave_backward,
    cone_angle,
    in_region,
    nearest_on_rest,
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
    "selection",
    "signal_scales",
    "within_cone",
    "within_turn",
]
