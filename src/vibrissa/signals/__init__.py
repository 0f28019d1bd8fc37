"""What the follicle feels: six signals, their triplets, and regions of contact."""

from vibrissa.signals.base import CIRCULAR, SIGNALS, base_signals, measured, signal_scales
from vibrissa.signals.regions import concave_backward, nearest_on_rest, within_cone
from vibrissa.signals.triplets import TRIPLETS, selection

__all__ = [
    "CIRCULAR",
    "SIGNALS",
    "TRIPLETS",
    "base_signals",
    "concave_backward",
    "measured",
    "nearest_on_rest",
    "selection",
    "signal_scales",
    "within_cone",
]
