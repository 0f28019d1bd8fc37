"""Contents of pictures without a renderer: marks, triangulated shapes, solids and trials.

Figures, the viewer and the report draw these.
"""

from vibrissa.scene.course import (
    TRIPLET as TRIPLET,
    Course,
    course_of,
    deflection_angles as deflection_angles,
)
from vibrissa.scene.solids import (
    COORDINATES as COORDINATES,
    DIRECTIONS as DIRECTIONS,
    SIGNALS as SIGNALS,
    Arrows as Arrows,
    Body as Body,
    Bytes as Bytes,
    Cloud as Cloud,
    Colour as Colour,
    Drawing as Drawing,
    Ints as Ints,
    Label as Label,
    Line as Line,
    Mark as Mark,
    Painted as Painted,
    Side as Side,
    across as across,
    clip as clip,
    column as column,
    cylinder as cylinder,
    ellipsoid as ellipsoid,
    error_ellipsoid as error_ellipsoid,
    head_surfaces as head_surfaces,
    is_bounded as is_bounded,
    level_surface as level_surface,
    object_surface as object_surface,
    pieces as pieces,
    robust_limits as robust_limits,
    root as root,
    sample_contacts as sample_contacts,
    sheet as sheet,
    solid_surface as solid_surface,
    squared as squared,
    subdivide as subdivide,
    tube as tube,
    values_of as values_of,
)

__all__ = ["Course", "course_of"]
__dir__ = __all__.copy
