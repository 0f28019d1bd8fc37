"""What bends: shape, section, material and frame of a whisker, and the array on the face."""

from vibrissa.whisker.array import WhiskerArray
from vibrissa.whisker.average import whisker_array
from vibrissa.whisker.identity import Identity
from vibrissa.whisker.model import Whisker
from vibrissa.whisker.pose import Pose
from vibrissa.whisker.profile import Profile

__all__ = [
    "Identity",
    "Pose",
    "Profile",
    "Whisker",
    "WhiskerArray",
    "whisker_array",
]
