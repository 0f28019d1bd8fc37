"""Tracking: from two videos to a whisker's 3D shape, pose, contact and wrench in every frame."""

from vibrissa.tracking.recording import Tracked as Tracked, unexplained_frames as unexplained_frames
from vibrissa.tracking.refine.fit import RodFit as RodFit
from vibrissa.tracking.refine.problem import FitOptions as FitOptions
from vibrissa.tracking.refine.rods import TraceSeries as TraceSeries
from vibrissa.tracking.space.curve import SpaceCurve as SpaceCurve, merge
from vibrissa.tracking.space.frame_pairs import paired_frames as paired_frames
from vibrissa.tracking.space.pose import (
    CUTOFF,
    BasePose as BasePose,
    HeadPose as HeadPose,
    base_pose,
    low_pass as low_pass,
    pieces as pieces,
    usual_cutoff as usual_cutoff,
)
from vibrissa.tracking.space.rest_shape import (
    RestShape as RestShape,
    rest_shape,
    whisker_at_rest as whisker_at_rest,
)
from vibrissa.tracking.space.retrace import retraced
from vibrissa.tracking.trace.curves import Found as Found, find_whiskers as find_whiskers
from vibrissa.tracking.trace.start import (
    FRAMES,
    Candidate,
    Start,
    find_start,
    is_bright as is_bright,
)
from vibrissa.tracking.trace.trace import (
    Trace,
    TraceOptions,
    doubtful_frames as doubtful_frames,
    given as given,
)
from vibrissa.tracking.trace.video import (
    partial_traces as partial_traces,
    start_frames as start_frames,
    trace_file as trace_file,
    trace_video,
)
from vibrissa.tracking.track import TrackOptions, track, track_whisker as track_whisker
from vibrissa.tracking.tracker_points import (
    TrackerTraces as TrackerTraces,
    tracker_traces as tracker_traces,
)

__all__ = [
    "CUTOFF",
    "FRAMES",
    "Candidate",
    "Start",
    "Trace",
    "TraceOptions",
    "TrackOptions",
    "base_pose",
    "find_start",
    "merge",
    "rest_shape",
    "retraced",
    "trace_video",
    "track",
]
__dir__ = __all__.copy
