"""Files and nothing else: one module a format.

Every reader raises FileNotFoundError where there is no such file, and ValueError, in one line that
names the file and what is wrong with it, where it is of another kind, empty, cut short or damaged.
Nothing in a file is run or unpickled, and no file leads to another.
"""

from vibrissa.io.anipose import load_anipose, read_calibration, write_calibration
from vibrissa.io.array import load_array, save_array
from vibrissa.io.centerline import load_centerline, load_whisker, save_centerline
from vibrissa.io.contacts_table import holds_contour, load_contacts, save_contacts, save_contour
from vibrissa.io.deeplabcut import load_deeplabcut
from vibrissa.io.kinds import READERS, Kind, load_tracks, recognise
from vibrissa.io.matlab import load_matlab
from vibrissa.io.movement import load_movement
from vibrissa.io.movie import write_movie, write_video
from vibrissa.io.netcdf import (
    COMPRESSED,
    is_netcdf,
    kind_of,
    naming,
    netcdf_image,
    opened,
    read_dataset,
    read_tree,
    write_netcdf,
)
from vibrissa.io.nwb import load_nwb, load_nwb_series
from vibrissa.io.nwb_writing import Session, save_nwb
from vibrissa.io.paths import (
    CSV,
    NETCDF,
    check_folder,
    check_readable,
    check_writable,
    refuse_whisk,
    replacing,
    without_part,
)
from vibrissa.io.predictor_table import save_predictors
from vibrissa.io.recording import RECORDING_KIND, load_recording, save_recording
from vibrissa.io.rosbag import BagMessage, ContactBag, bag_poses, bag_wrenches, is_bag
from vibrissa.io.signals_table import check_scale, load_signals, save_signals
from vibrissa.io.sleap import load_sleap
from vibrissa.io.table import (
    cells_of,
    delimiter_of,
    is_number,
    number,
    read_numbers,
    read_text,
    signal_column,
    signal_columns,
    table_rows,
    with_point,
    write_table,
)
from vibrissa.io.toml import (
    check_keys,
    in_file,
    number_array,
    one_number,
    parsed_toml,
    quoted,
    read_toml,
    subtable,
    three_numbers,
)
from vibrissa.io.traces import load_corrections, load_traces, save_corrections, save_traces
from vibrissa.io.tracks import RawTracks, join_views, labelled
from vibrissa.io.tracks_file import load_tracks_table, save_tracks
from vibrissa.io.video import (
    Footage,
    Frame,
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
    "COMPRESSED",
    "CSV",
    "NETCDF",
    "READERS",
    "RECORDING_KIND",
    "BagMessage",
    "ContactBag",
    "Footage",
    "Frame",
    "FrameReader",
    "Kind",
    "RawTracks",
    "Session",
    "VideoInfo",
    "bag_poses",
    "bag_wrenches",
    "cells_of",
    "check_folder",
    "check_keys",
    "check_readable",
    "check_scale",
    "check_writable",
    "delimiter_of",
    "holds_contour",
    "in_file",
    "is_bag",
    "is_netcdf",
    "is_number",
    "join_views",
    "kind_of",
    "labelled",
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
    "naming",
    "netcdf_image",
    "number",
    "number_array",
    "one_number",
    "opened",
    "parsed_toml",
    "quoted",
    "read_calibration",
    "read_dataset",
    "read_numbers",
    "read_text",
    "read_toml",
    "read_tree",
    "read_video",
    "recognise",
    "refuse_whisk",
    "replacing",
    "save_array",
    "save_centerline",
    "save_contacts",
    "save_contour",
    "save_corrections",
    "save_nwb",
    "save_predictors",
    "save_recording",
    "save_signals",
    "save_traces",
    "save_tracks",
    "signal_column",
    "signal_columns",
    "subtable",
    "table_rows",
    "three_numbers",
    "video_frames",
    "video_info",
    "with_point",
    "without_part",
    "write_calibration",
    "write_movie",
    "write_netcdf",
    "write_table",
    "write_video",
]
