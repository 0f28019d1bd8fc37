"""The main job from end to end: from a whisker's signals to the contour of what it touched."""

from vibrissa.demo.run import DemoResult, run_demo
from vibrissa.demo.scores import ErrorRow, Scores

__all__ = [
    "DemoResult",
    "ErrorRow",
    "Scores",
    "run_demo",
]
