"""What bends: shape, section, material and frame of a whisker."""

from vibrissa.whisker.model import Whisker
from vibrissa.whisker.pose import Pose
from vibrissa.whisker.profile import Profile

__all__ = ["Pose", "Profile", "Whisker"]
