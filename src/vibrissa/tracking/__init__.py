"""From two videos to a whisker in space: trace, merge, pose, contact, wrench."""

from vibrissa.tracking.begin import Start, find_bases, find_start, is_bright
from vibrissa.tracking.filtering import low_pass
from vibrissa.tracking.find import Found, find_whiskers
from vibrissa.tracking.follow import Follower, start_at
from vibrissa.tracking.head import HeadPose
from vibrissa.tracking.pose import BasePose, base_pose
from vibrissa.tracking.refine import Refined, RefineOptions, refine
from vibrissa.tracking.rest import RestShape, rest_shape, whisker_at_rest
from vibrissa.tracking.sight import Sight
from vibrissa.tracking.space import SpaceCurve, merge
from vibrissa.tracking.timing import paired_frames
from vibrissa.tracking.trace import Trace, TraceOptions
from vibrissa.tracking.track import Tracked, TrackOptions, track, track_whisker
from vibrissa.tracking.video_file import partial_traces, start_frames, trace_file
from vibrissa.tracking.view import trace_video

__all__ = [
    "BasePose",
    "Follower",
    "Found",
    "HeadPose",
    "RefineOptions",
    "Refined",
    "RestShape",
    "Sight",
    "SpaceCurve",
    "Start",
    "Trace",
    "TraceOptions",
    "TrackOptions",
    "Tracked",
    "base_pose",
    "find_bases",
    "find_start",
    "find_whiskers",
    "is_bright",
    "low_pass",
    "merge",
    "paired_frames",
    "partial_traces",
    "refine",
    "rest_shape",
    "start_at",
    "start_frames",
    "trace_file",
    "trace_video",
    "track",
    "track_whisker",
    "whisker_at_rest",
]
