"""Signals as they come in, line by line, to contacts as they go out."""

from vibrissa.streaming.advice import advice
from vibrissa.streaming.contacts import ContactStream
from vibrissa.streaming.lines import LineKind, Lines, Sample
from vibrissa.streaming.poses import Pose, Poses
from vibrissa.streaming.sources import NewestLines, file_lines, udp_lines

__all__ = [
    "ContactStream",
    "LineKind",
    "Lines",
    "NewestLines",
    "Pose",
    "Poses",
    "Sample",
    "advice",
    "file_lines",
    "udp_lines",
]
