"""The recording: all that is known of a trial, declared once and read by one accessor."""

from vibrissa.recording.recording import ONE_VIEW, Group, Recording, recording_tree
from vibrissa.recording.schema import (
    VARIABLES,
    RecordedVariable,
    coordinates,
    faults_in,
    recorded,
)

__all__ = [
    "ONE_VIEW",
    "VARIABLES",
    "Group",
    "RecordedVariable",
    "Recording",
    "coordinates",
    "faults_in",
    "recorded",
    "recording_tree",
]
