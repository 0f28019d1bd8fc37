"""From two videos to a whisker in space: trace, merge, pose, contact, wrench."""

from vibrissa.tracking.recording import Tracked
from vibrissa.tracking.refine.fit import FitOptions, RodFit, fit_rod
from vibrissa.tracking.refine.trace_series import TraceSeries
from vibrissa.tracking.space.curve import SpaceCurve, merge
from vibrissa.tracking.space.frame_pairs import paired_frames
from vibrissa.tracking.space.pose import CUTOFF, BasePose, HeadPose, base_pose, low_pass
from vibrissa.tracking.space.rest_shape import RestShape, rest_shape, whisker_at_rest
from vibrissa.tracking.trace.curves import Found, find_whiskers
from vibrissa.tracking.trace.start import FRAMES, Start, find_bases, find_start, is_bright
from vibrissa.tracking.trace.trace import Trace, TraceOptions
from vibrissa.tracking.trace.video import partial_traces, start_frames, trace_file, trace_video
from vibrissa.tracking.track import TrackOptions, track, track_whisker
from vibrissa.tracking.tracker_points import TrackerTraces, tracker_traces

__all__ = [
    "CUTOFF",
    "FRAMES",
    "BasePose",
    "FitOptions",
    "Found",
    "HeadPose",
    "RestShape",
    "RodFit",
    "SpaceCurve",
    "Start",
    "Trace",
    "TraceOptions",
    "TraceSeries",
    "TrackOptions",
    "Tracked",
    "TrackerTraces",
    "base_pose",
    "find_bases",
    "find_start",
    "find_whiskers",
    "fit_rod",
    "is_bright",
    "low_pass",
    "merge",
    "paired_frames",
    "partial_traces",
    "rest_shape",
    "start_frames",
    "trace_file",
    "trace_video",
    "track",
    "track_whisker",
    "tracker_traces",
    "whisker_at_rest",
]
