"""Files and nothing else: one module a format."""

from vibrissa.io.anipose import load_anipose
from vibrissa.io.array import load_array, save_array
from vibrissa.io.centerline import load_centerline, load_whisker, save_centerline
from vibrissa.io.contacts_table import load_contacts, save_contacts, save_contour
from vibrissa.io.deeplabcut import load_deeplabcut
from vibrissa.io.kinds import Kind, load_tracks, recognise
from vibrissa.io.matlab import load_matlab
from vibrissa.io.movement import load_movement
from vibrissa.io.movie import write_movie, write_video
from vibrissa.io.netcdf import is_netcdf, kind_of
from vibrissa.io.nwb import load_nwb, load_nwb_series
from vibrissa.io.nwb_writing import Session, save_nwb
from vibrissa.io.paths import check_folder, check_readable, check_writable
from vibrissa.io.recording import load_recording, save_recording
from vibrissa.io.signals_table import load_signals, save_signals
from vibrissa.io.sleap import load_sleap
from vibrissa.io.traces import load_corrections, load_traces, save_corrections, save_traces
from vibrissa.io.tracks import join_views
from vibrissa.io.tracks_file import load_tracks_table, save_tracks
from vibrissa.io.video import (
    FrameReader,
    VideoInfo,
    load_series,
    read_video,
    video_frames,
    video_info,
)
from vibrissa.io.video_tables import load_contact_points, load_head
from vibrissa.io.whisk import load_measurements, load_whiskers

__all__ = [
    "FrameReader",
    "Kind",
    "Session",
    "VideoInfo",
    "check_folder",
    "check_readable",
    "check_writable",
    "is_netcdf",
    "join_views",
    "kind_of",
    "load_anipose",
    "load_array",
    "load_centerline",
    "load_contact_points",
    "load_contacts",
    "load_corrections",
    "load_deeplabcut",
    "load_head",
    "load_matlab",
    "load_measurements",
    "load_movement",
    "load_nwb",
    "load_nwb_series",
    "load_recording",
    "load_series",
    "load_signals",
    "load_sleap",
    "load_traces",
    "load_tracks",
    "load_tracks_table",
    "load_whisker",
    "load_whiskers",
    "read_video",
    "recognise",
    "save_array",
    "save_centerline",
    "save_contacts",
    "save_contour",
    "save_corrections",
    "save_nwb",
    "save_recording",
    "save_signals",
    "save_traces",
    "save_tracks",
    "video_frames",
    "video_info",
    "write_movie",
    "write_video",
]
