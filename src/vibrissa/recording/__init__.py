"""The recording: all that is known of a trial, declared once and read by one accessor."""

from vibrissa.recording.recording import (
    ONE_VIEW as ONE_VIEW,
    Group,
    Recording,
    recording_tree as recording_tree,
)
from vibrissa.recording.schema import (
    VARIABLES,
    RecordedVariable as RecordedVariable,
    coordinates as coordinates,
    faults_in as faults_in,
    recorded as recorded,
)

__all__ = [
    "VARIABLES",
    "Group",
    "Recording",
]
