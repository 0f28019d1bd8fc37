"""What bends: shape, section, material and frame of a whisker, and the array on the face."""

from vibrissa.whisker import morphology
from vibrissa.whisker.array import WhiskerArray
from vibrissa.whisker.average import whisker_array
from vibrissa.whisker.identity import Identity
from vibrissa.whisker.model import Whisker
from vibrissa.whisker.morphology import published_note, published_radii
from vibrissa.whisker.pose import ORTHOGONALITY, Pose, angles_of, base_rotation, mirrored
from vibrissa.whisker.profile import Profile, constant
from vibrissa.whisker.rest import parabola_curvature
from vibrissa.whisker.section import TAPER, Properties, length_faults

__all__ = [
    "ORTHOGONALITY",
    "TAPER",
    "Identity",
    "Pose",
    "Profile",
    "Properties",
    "Whisker",
    "WhiskerArray",
    "angles_of",
    "base_rotation",
    "constant",
    "length_faults",
    "mirrored",
    "morphology",
    "parabola_curvature",
    "published_note",
    "published_radii",
    "whisker_array",
]
