"""Readers and writers of files, one module per format.

Readers raise FileNotFoundError if a file does not exist, and ValueError with a one-line message
that names the file and the fault if it is of another kind, empty, truncated or damaged. Nothing in
a file is executed or unpickled, and references to other files are not followed.
"""

from __future__ import annotations

from vibrissa.io.annotations import (
    Clicks as Clicks,
    Points as Points,
    ViewClicks as ViewClicks,
    load_clicks as load_clicks,
    load_contact_points,
    load_corrections,
    load_head,
    polygon_of as polygon_of,
    save_clicks as save_clicks,
    save_corrections as save_corrections,
    together as together,
)
from vibrissa.io.keypoints import (
    read_calibration as read_calibration,
    write_calibration as write_calibration,
)
from vibrissa.io.kinds import READERS as READERS, Kind, load_tracks, recognise
from vibrissa.io.matlab import load_matlab
from vibrissa.io.netcdf import (
    COMPRESSED as COMPRESSED,
    all_groups as all_groups,
    is_netcdf as is_netcdf,
    kind_of as kind_of,
    naming as naming,
    netcdf_image as netcdf_image,
    opened as opened,
    read_dataset as read_dataset,
    read_groups as read_groups,
    read_parts as read_parts,
    read_tree as read_tree,
    write_netcdf as write_netcdf,
)
from vibrissa.io.nwb import load_nwb_series
from vibrissa.io.nwb_writing import Session, save_nwb
from vibrissa.io.paths import (
    CSV as CSV,
    NETCDF as NETCDF,
    check_folder as check_folder,
    check_readable as check_readable,
    check_writable as check_writable,
    held as held,
    refuse_whisk as refuse_whisk,
    replacing as replacing,
    without_part as without_part,
)
from vibrissa.io.recording import (
    RECORDING_KIND as RECORDING_KIND,
    check_units as check_units,
    load_recording,
    save_recording,
)
from vibrissa.io.rosbag import (
    BagMessage as BagMessage,
    ContactBag as ContactBag,
    bag_poses as bag_poses,
    bag_topics as bag_topics,
    bag_wrenches as bag_wrenches,
    is_bag as is_bag,
)
from vibrissa.io.table import (
    cells_of as cells_of,
    check_keys as check_keys,
    check_one_column_each as check_one_column_each,
    delimiter_of as delimiter_of,
    in_file as in_file,
    is_number as is_number,
    number as number,
    number_array as number_array,
    one_number as one_number,
    parsed_toml as parsed_toml,
    quoted as quoted,
    read_numbers as read_numbers,
    read_text as read_text,
    read_toml as read_toml,
    signal_column as signal_column,
    signal_columns as signal_columns,
    subtable as subtable,
    table_rows as table_rows,
    three_numbers as three_numbers,
    unit_factor as unit_factor,
    with_point as with_point,
    write_table as write_table,
)
from vibrissa.io.time_tables import (
    NUMBERED as NUMBERED,
    check_scale as check_scale,
    events_in as events_in,
    holds_contour as holds_contour,
    load_contacts,
    load_signals,
    read_signals as read_signals,
    save_contacts,
    save_contour,
    save_predictors as save_predictors,
    save_signals,
    slow_steps as slow_steps,
    time_notes as time_notes,
)
from vibrissa.io.tracks import (
    RawTracks as RawTracks,
    join_views,
    labelled as labelled,
    load_traces as load_traces,
    save_traces as save_traces,
    save_tracks,
)
from vibrissa.io.video import (
    Footage as Footage,
    Frame as Frame,
    FrameReader as FrameReader,
    VideoInfo as VideoInfo,
    interlaced as interlaced,
    load_series as load_series,
    read_video,
    video_frames as video_frames,
    video_info as video_info,
    write_movie,
    write_video as write_video,
)
from vibrissa.io.whiskers import (
    load_array,
    load_centerline,
    load_whisker,
    save_array,
    save_centerline,
)

__all__ = [
    "Kind",
    "Session",
    "join_views",
    "load_array",
    "load_centerline",
    "load_contact_points",
    "load_contacts",
    "load_corrections",
    "load_head",
    "load_matlab",
    "load_nwb_series",
    "load_recording",
    "load_signals",
    "load_tracks",
    "load_whisker",
    "read_video",
    "recognise",
    "save_array",
    "save_centerline",
    "save_contacts",
    "save_contour",
    "save_nwb",
    "save_recording",
    "save_signals",
    "save_tracks",
    "write_movie",
]
__dir__ = __all__.copy
