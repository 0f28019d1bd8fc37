"""From two videos to a whisker in space: trace, merge, pose, contact."""

from vibrissa.tracking.find import Found, find_whiskers
from vibrissa.tracking.trace import Follower, Trace, TraceOptions, start_at
from vibrissa.tracking.view import trace_video

__all__ = [
    "Follower",
    "Found",
    "Trace",
    "TraceOptions",
    "find_whiskers",
    "start_at",
    "trace_video",
]
