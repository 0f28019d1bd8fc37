"""The main job from end to end: from a whisker's signals to the contour of what it touched."""

from vibrissa.demo.locate import contact_columns, in_laboratory, locate
from vibrissa.demo.run import DemoResult, run_demo
from vibrissa.demo.scores import ErrorRow, Scores

__all__ = [
    "DemoResult",
    "ErrorRow",
    "Scores",
    "contact_columns",
    "in_laboratory",
    "locate",
    "run_demo",
]
