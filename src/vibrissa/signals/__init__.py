"""What the follicle feels: six signals, their triplets, and regions of contact."""

from vibrissa.signals.base import (
    CIRCULAR,
    SIGNALS,
    Coordinates,
    base_signals,
    labelled_wrench,
    measured,
    signal_scales,
)
from vibrissa.signals.regions import concave_backward, nearest_on_rest, within_cone
from vibrissa.signals.triplets import TRIPLETS, selection

__all__ = [
    "CIRCULAR",
    "SIGNALS",
    "TRIPLETS",
    "Coordinates",
    "base_signals",
    "concave_backward",
    "labelled_wrench",
    "measured",
    "nearest_on_rest",
    "selection",
    "signal_scales",
    "within_cone",
]
