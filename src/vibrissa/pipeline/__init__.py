"""The stages between tracks and a contour, each from a recording to a dataset of its own."""

from vibrissa.pipeline.comparison import compare_contacts, distances_by_class
from vibrissa.pipeline.estimates import estimates_of
from vibrissa.pipeline.frames import whisker_radii
from vibrissa.pipeline.laboratory import contact_columns, in_laboratory
from vibrissa.pipeline.locate import FELT, TRIPLET, component_noise, locate, locate_from_wrench
from vibrissa.pipeline.reconstruct import (
    SOLVED_TO,
    Shape,
    contour_points,
    fit_contacts,
    reconstruct,
)
from vibrissa.pipeline.shapes import compare_shapes
from vibrissa.pipeline.signals import (
    Source,
    default_source,
    placed_by,
    sensor_noise,
    signals_of,
)
from vibrissa.pipeline.stages import (
    STAGES,
    due_stages,
    with_contour,
    with_estimates,
    with_group,
    with_signals,
)

__all__ = [
    "FELT",
    "SOLVED_TO",
    "STAGES",
    "TRIPLET",
    "Shape",
    "Source",
    "compare_contacts",
    "compare_shapes",
    "component_noise",
    "contact_columns",
    "contour_points",
    "default_source",
    "distances_by_class",
    "due_stages",
    "estimates_of",
    "fit_contacts",
    "in_laboratory",
    "locate",
    "locate_from_wrench",
    "placed_by",
    "reconstruct",
    "sensor_noise",
    "signals_of",
    "whisker_radii",
    "with_contour",
    "with_estimates",
    "with_group",
    "with_signals",
]
