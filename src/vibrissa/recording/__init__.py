"""The recording: one tree of labelled datasets for all that is known of a trial."""

from vibrissa.recording.tree import (
    recorded_cameras,
    recorded_objects,
    recorded_pegs,
    recorded_whisker,
)

__all__ = [
    "recorded_cameras",
    "recorded_objects",
    "recorded_pegs",
    "recorded_whisker",
]
