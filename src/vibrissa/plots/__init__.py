"""Datasets and arrays to figures, one function each; nothing is solved here."""

from vibrissa.plots.clouds import signal_clouds
from vibrissa.plots.contour import contour_views
from vibrissa.plots.estimates import estimated_against_true
from vibrissa.plots.signals import signals_over_time
from vibrissa.plots.style import save
from vibrissa.plots.whisker import whisker_views

__all__ = [
    "contour_views",
    "estimated_against_true",
    "save",
    "signal_clouds",
    "signals_over_time",
    "whisker_views",
]
