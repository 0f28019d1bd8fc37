"""Signals as they come in, line by line, to contacts as they go out."""

from vibrissa.streaming.contacts import ContactStream
from vibrissa.streaming.lines import Lines, Sample
from vibrissa.streaming.sources import file_lines, udp_lines

__all__ = ["ContactStream", "Lines", "Sample", "file_lines", "udp_lines"]
