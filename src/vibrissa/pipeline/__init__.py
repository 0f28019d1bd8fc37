"""The stages between tracks and a contour, each from a recording to a dataset of its own."""

from vibrissa.pipeline.estimates import (
    Progress,
    contact_columns,
    estimates_of,
    in_laboratory,
)
from vibrissa.pipeline.frames import check_recording, whisker_radii
from vibrissa.pipeline.locate import DETECTED, TRIPLET, component_noise, locate, locate_from_wrench
from vibrissa.pipeline.predictors import PREDICTORS, predictors
from vibrissa.pipeline.reconstruct import (
    AGREES,
    ANGLE_CLASSES,
    SOLVED_TO,
    STRONG,
    Shape,
    compare_contacts,
    compare_shapes,
    contour_points,
    distances_by_class,
    fit_contacts,
    reconstruct,
)
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
from vibrissa.pipeline.summary import TrialSummary, summarise

__all__ = [
    "AGREES",
    "ANGLE_CLASSES",
    "DETECTED",
    "PREDICTORS",
    "SOLVED_TO",
    "STAGES",
    "STRONG",
    "TRIPLET",
    "Progress",
    "Shape",
    "Source",
    "TrialSummary",
    "check_recording",
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
    "predictors",
    "reconstruct",
    "sensor_noise",
    "signals_of",
    "summarise",
    "whisker_radii",
    "with_contour",
    "with_estimates",
    "with_group",
    "with_signals",
]
