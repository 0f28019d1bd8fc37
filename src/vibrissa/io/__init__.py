"""Files and nothing else: one module a format."""

from vibrissa.io.centerline import load_centerline, load_whisker, save_centerline
from vibrissa.io.contacts_table import load_contacts, save_contacts
from vibrissa.io.netcdf import is_netcdf, kind_of
from vibrissa.io.paths import check_folder, check_readable, check_writable
from vibrissa.io.recording import load_recording, save_recording
from vibrissa.io.signals_table import load_signals, save_signals
from vibrissa.io.video import VideoInfo, read_video, video_info, write_video

__all__ = [
    "VideoInfo",
    "check_folder",
    "check_readable",
    "check_writable",
    "is_netcdf",
    "kind_of",
    "load_centerline",
    "load_contacts",
    "load_recording",
    "load_signals",
    "load_whisker",
    "read_video",
    "save_centerline",
    "save_contacts",
    "save_recording",
    "save_signals",
    "video_info",
    "write_video",
]
