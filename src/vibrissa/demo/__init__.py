"""The main job from end to end: from a whisker's signals to the contour of what it touched."""

from vibrissa.demo.run import DemoResult, Located, run_demo
from vibrissa.evaluation import ErrorRow, Scores, SignalRow, TrackingScores

__all__ = [
    "DemoResult",
    "ErrorRow",
    "Located",
    "Scores",
    "SignalRow",
    "TrackingScores",
    "run_demo",
]
