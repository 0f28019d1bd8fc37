"""Datasets and arrays to figures, one function each; nothing is solved here."""

from vibrissa.plots.array import array_views
from vibrissa.plots.bent import bent_views
from vibrissa.plots.clouds import signal_clouds
from vibrissa.plots.contour import contour_views
from vibrissa.plots.contour_movie import contour_frames
from vibrissa.plots.course import Course, course_of, deflection_angles
from vibrissa.plots.distances import distances_by_class
from vibrissa.plots.estimates import estimated_against_true
from vibrissa.plots.evidence import critical_cones, resolution
from vibrissa.plots.overview import telling_rows, trial_overview
from vibrissa.plots.places import contact_places
from vibrissa.plots.sensitivity import sensitivity_panels
from vibrissa.plots.sights import Sight
from vibrissa.plots.signal_movie import signal_frames
from vibrissa.plots.signals import signals_over_time
from vibrissa.plots.slices import solid_slices
from vibrissa.plots.start import start_views
from vibrissa.plots.style import png, save
from vibrissa.plots.surfaces import contact_surfaces
from vibrissa.plots.sweep import drawable, sweep_overview
from vibrissa.plots.things import object_triangles
from vibrissa.plots.verdicts import verdict_table
from vibrissa.plots.whisker import whisker_views
from vibrissa.plots.witness import witness_pair

__all__ = [
    "Course",
    "Sight",
    "array_views",
    "bent_views",
    "contact_places",
    "contact_surfaces",
    "contour_frames",
    "contour_views",
    "course_of",
    "critical_cones",
    "deflection_angles",
    "distances_by_class",
    "drawable",
    "estimated_against_true",
    "object_triangles",
    "png",
    "resolution",
    "save",
    "sensitivity_panels",
    "signal_clouds",
    "signal_frames",
    "signals_over_time",
    "solid_slices",
    "start_views",
    "sweep_overview",
    "telling_rows",
    "trial_overview",
    "verdict_table",
    "whisker_views",
    "witness_pair",
]
