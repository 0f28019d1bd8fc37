"""Estimation of contacts from streams of signals, line by line."""

from vibrissa.sensors import COMPONENTS
from vibrissa.streaming.contacts import (
    ContactStream,
    ContactStreams,
    advice as advice,
    as_json as as_json,
)
from vibrissa.streaming.lines import (
    LineKind as LineKind,
    Lines as Lines,
    Pose,
    Poses,
    Sample as Sample,
    rotation_of as rotation_of,
)
from vibrissa.streaming.offset import OFF_ZERO as OFF_ZERO, Zero as Zero
from vibrissa.streaming.sources import (
    Answers as Answers,
    ContactRecorder as ContactRecorder,
    NewestLines as NewestLines,
    bag_lines as bag_lines,
    bounded_lines as bounded_lines,
    file_lines as file_lines,
    udp_address as udp_address,
    udp_lines as udp_lines,
    udp_lost as udp_lost,
    udp_socket as udp_socket,
)

__all__ = ["COMPONENTS", "ContactStream", "ContactStreams", "Pose", "Poses"]
__dir__ = __all__.copy
