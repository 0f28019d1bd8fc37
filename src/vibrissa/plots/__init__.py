"""Figures of datasets and arrays, one function each; nothing is computed here."""

from vibrissa.plots.array import array_views
from vibrissa.plots.contact_surfaces import contact_surfaces, solid_slices
from vibrissa.plots.contacts import contact_places, estimated_against_true
from vibrissa.plots.contour import contour_views, distances_by_class
from vibrissa.plots.movies import contour_frames, signal_frames
from vibrissa.plots.overview import (
    Sight as Sight,
    key_frames as key_frames,
    start_views as start_views,
    trial_overview,
)
from vibrissa.plots.sensitivity import sensitivity_panels
from vibrissa.plots.signals import signal_clouds, signals_over_time as signals_over_time
from vibrissa.plots.style import (
    looking as looking,
    png,
    save,
    scale_of as scale_of,
    sequential as sequential,
)
from vibrissa.plots.sweep import drawable as drawable, sweep_overview as sweep_overview
from vibrissa.plots.verdicts import (
    HIGHLIGHTED as HIGHLIGHTED,
    critical_cones,
    resolution,
    verdict_table,
)
from vibrissa.plots.whisker import bent_views, whisker_views, witness_pair
from vibrissa.plots.windows import correct as correct, pick as pick

__all__ = [
    "array_views",
    "bent_views",
    "contact_places",
    "contact_surfaces",
    "contour_frames",
    "contour_views",
    "critical_cones",
    "distances_by_class",
    "estimated_against_true",
    "png",
    "resolution",
    "save",
    "sensitivity_panels",
    "signal_clouds",
    "signal_frames",
    "solid_slices",
    "trial_overview",
    "verdict_table",
    "whisker_views",
    "witness_pair",
]
__dir__ = __all__.copy
