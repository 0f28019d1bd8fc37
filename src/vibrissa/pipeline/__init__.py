"""Processing stages of a recording: signals, contact estimates and the object's contour.

Each stage is a function that takes a recording and returns a new dataset. Names are imported on
first use, as contacts of a table need neither tracking nor xarray.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vibrissa.deferred import names_from

if TYPE_CHECKING:
    from vibrissa.pipeline.checks import (
        check_recording as check_recording,
        doubted_axes as doubted_axes,
        doubted_noise as doubted_noise,
        edited as edited,
        whisker_radii as whisker_radii,
    )
    from vibrissa.pipeline.estimates import (
        Progress as Progress,
        contact_events,
        estimates_of,
        in_laboratory as in_laboratory,
        swept_recording as swept_recording,
    )
    from vibrissa.pipeline.events import (
        EVENTS as EVENTS,
        contact_columns as contact_columns,
        with_events as with_events,
    )
    from vibrissa.pipeline.frames import CHANGE as CHANGE, Frames as Frames
    from vibrissa.pipeline.location import (
        locate,
        locate_around as locate_around,
        locate_from_wrench,
    )
    from vibrissa.pipeline.predictor_table import PREDICTORS as PREDICTORS, predictors
    from vibrissa.pipeline.reconstruction import (
        AGREES as AGREES,
        ANGLE_CLASSES as ANGLE_CLASSES,
        SOLVED_TO as SOLVED_TO,
        STRONG as STRONG,
        Shape as Shape,
        compare_contacts as compare_contacts,
        compare_shapes,
        contour_points as contour_points,
        distances_by_class as distances_by_class,
        fit_contacts,
        reconstruct,
    )
    from vibrissa.pipeline.signals import (
        Source as Source,
        default_source as default_source,
        placed_by,
        sensor_noise as sensor_noise,
        signals_of,
    )
    from vibrissa.pipeline.stages import (
        STAGES as STAGES,
        TrialSummary as TrialSummary,
        due_stages as due_stages,
        with_contour,
        with_estimates,
        with_group as with_group,
        with_signals,
        without_faulty_stages as without_faulty_stages,
    )

__all__ = [
    "compare_shapes",
    "contact_events",
    "estimates_of",
    "fit_contacts",
    "locate",
    "locate_from_wrench",
    "placed_by",
    "predictors",
    "reconstruct",
    "signals_of",
    "with_contour",
    "with_estimates",
    "with_signals",
]
__dir__ = __all__.copy

__getattr__ = names_from(
    __name__,
    {
        "checks": "check_recording doubted_axes doubted_noise edited whisker_radii",
        "estimates": "Progress contact_events estimates_of in_laboratory swept_recording",
        "events": "EVENTS contact_columns with_events",
        "frames": "CHANGE Frames",
        "location": "locate locate_around locate_from_wrench",
        "predictor_table": "PREDICTORS predictors",
        "reconstruction": "AGREES ANGLE_CLASSES SOLVED_TO STRONG Shape compare_contacts "
        "compare_shapes contour_points distances_by_class fit_contacts reconstruct",
        "signals": "Source default_source placed_by sensor_noise signals_of",
        "stages": "STAGES TrialSummary due_stages with_contour with_estimates with_group "
        "with_signals without_faulty_stages",
    },
)
