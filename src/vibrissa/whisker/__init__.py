"""Whiskers: shape, cross-section, material and pose, and the whisker array of a rat."""

from vibrissa.whisker import morphology
from vibrissa.whisker.array import WhiskerArray, whisker_array
from vibrissa.whisker.model import Whisker
from vibrissa.whisker.morphology import (
    Identity,
    published_note as published_note,
    published_radii as published_radii,
)
from vibrissa.whisker.pose import (
    ORTHOGONALITY as ORTHOGONALITY,
    Pose,
    angles_of as angles_of,
    base_rotation,
    mirrored,
)
from vibrissa.whisker.profile import (
    Profile as Profile,
    constant as constant,
    parabola_curvature as parabola_curvature,
)
from vibrissa.whisker.section import (
    TAPER as TAPER,
    Properties as Properties,
    length_faults as length_faults,
)

__all__ = [
    "Identity",
    "Pose",
    "Whisker",
    "WhiskerArray",
    "base_rotation",
    "mirrored",
    "morphology",
    "whisker_array",
]
__dir__ = __all__.copy
