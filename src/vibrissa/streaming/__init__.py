"""Signals as they come in, line by line, to contacts as they go out."""

from vibrissa.streaming.advice import advice
from vibrissa.streaming.bag import ContactRecorder, bag_lines
from vibrissa.streaming.contacts import COMPONENTS, ContactStream, ContactStreams, as_json
from vibrissa.streaming.lines import LineKind, Lines, Sample, rotation_of
from vibrissa.streaming.poses import Pose, Poses
from vibrissa.streaming.sources import (
    Answers,
    NewestLines,
    bounded_lines,
    file_lines,
    udp_address,
    udp_lines,
    udp_lost,
    udp_socket,
)

__all__ = [
    "COMPONENTS",
    "Answers",
    "ContactRecorder",
    "ContactStream",
    "ContactStreams",
    "LineKind",
    "Lines",
    "NewestLines",
    "Pose",
    "Poses",
    "Sample",
    "advice",
    "as_json",
    "bag_lines",
    "bounded_lines",
    "file_lines",
    "rotation_of",
    "udp_address",
    "udp_lines",
    "udp_lost",
    "udp_socket",
]
