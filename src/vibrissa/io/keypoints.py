"""Readers of keypoints from DeepLabCut, LightningPose, SLEAP, *movement* and Anipose.

**DeepLabCut and LightningPose**: tables as CSV, or as HDF5 written by pandas.

The header of a column consists of scorer, (individual,) body part and coordinate: x, y, likelihood
in pixels, or x, y, z if DeepLabCut has triangulated two views. Other coordinates, such as the
spread of an ensemble, are ignored. An individual is a whisker, and its body parts are the nodes of
the whisker.

Tables of pandas are read without pandas. There are two formats: "table", one compound dataset whose
column names are pickled in attributes, and "fixed", plain arrays of values, levels and labels.
Nothing is unpickled, since a pickle can execute code: names are parsed from its instructions, and
blocks that are not numbers are rejected.

**SLEAP**: analysis files (HDF5), and labels (``.slp``, read by sleap-io). An analysis file contains
dense arrays of tracks, nodes and scores. If sleap-io wrote the file, an attribute names their
dimensions; SLEAP itself writes (track, xy, node, frame). Labels are lists of instances in frames of
one or several videos, which become views.

**movement**: datasets (NetCDF) with ``position`` and ``confidence`` of keypoints. Up to its version
0.16 the dimensions are called individuals and keypoints, since 0.17 individual and keypoint.
Datasets of several cameras have a dimension ``view``. Positions in a plane must be in pixels, the
default of the attribute ``space_unit``.

**Anipose**: its table of triangulated points (CSV),
``tip_x, tip_y, tip_z, tip_error, tip_ncams, …``.

The unit is that of the calibration board, usually mm, which the file does not state. Points have
already been transformed by the matrix M and the center in the last columns.

**Calibrations** of cameras by Anipose and aniposelib (TOML):

    [cam_0]
    name = "top"
    size = [1024, 1024]
    matrix = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    distortions = [k1, k2, p1, p2, k3]
    rotation = [rx, ry, rz]
    translation = [tx, ty, tz]

The rotation is a rotation vector, rad; the translation has the unit of the calibration board,
usually mm. As an extension, orthographic cameras have ``projection = "orthographic"``, and pixels
per unit on the diagonal of their matrix.
"""

from __future__ import annotations

import json
import pickletools
import re
from collections.abc import Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import xr
from vibrissa.io.netcdf import is_netcdf, naming, opened, read_dataset
from vibrissa.io.paths import check_readable, replacing
from vibrissa.io.table import (
    in_file,
    number,
    number_array,
    quoted,
    read_numbers,
    read_text,
    read_toml,
    table_rows,
)
from vibrissa.io.tracks import SPACE, RawTracks
from vibrissa.numerics import Array

if TYPE_CHECKING:
    import sleap_io


Names = list[tuple[str, ...]]

_LEVELS = ("scorer", "individuals", "bodyparts", "coords")
_NEEDED = "Columns headed by scorer, bodyparts (after individuals, if any) and coords are needed"
_LIGHTNING = re.compile("heatmap|regression|lightning|ensemble|eks", re.IGNORECASE)


def read_deeplabcut(path: str | PathLike[str]) -> RawTracks:
    """Read a table of DeepLabCut or LightningPose as raw tracks."""
    path = check_readable(path)
    names, values, index = _hdf5(path) if is_netcdf(path) else _csv(path)
    if len(set(names)) != len(names):
        raise ValueError(f"{path} has two columns of the same name")
    individuals = list(dict.fromkeys(name[1] for name in names))
    parts = list(dict.fromkeys(name[2] for name in names))
    axes = "xyz" if any(name[3] == "z" for name in names) else "xy"
    shape = (len(values), len(individuals), len(parts))
    points, sure = np.full((*shape, len(axes)), np.nan), np.full(shape, np.nan)
    for name, column in zip(names, values.T, strict=True):
        place = individuals.index(name[1]), parts.index(name[2])
        if name[3] in axes:
            points[:, *place, axes.index(name[3])] = column
        elif name[3] in ("likelihood", "confidence"):
            sure[:, *place] = column
    scorer = names[0][0]
    return RawTracks.of(
        points[:, :, None],
        sure[:, :, None],
        software="LightningPose" if _LIGHTNING.match(scorer) else "DeepLabCut",
        whiskers=[name or "whisker" for name in individuals],
        nodes=parts,
        frames=_frames(path, index, len(values)),
        about={"scorer": scorer},
    )


def _four_levels(path: Path, name: tuple[str, ...]) -> tuple[str, ...]:
    """Split a column name into scorer, individual (empty if absent), body part and coordinate."""
    if len(name) not in (3, 4):
        raise ValueError(f"{path} has columns such as {'/'.join(name)}. {_NEEDED}")
    return name if len(name) == 4 else (name[0], "", *name[1:])


def _csv(path: Path) -> tuple[Names, Array, list[str]]:
    rows = table_rows(read_text(path))
    header = _header(path, rows)
    levels = [header[level] for level in _LEVELS if level in header]
    if len({len(level) for level in levels}) != 1:
        raise ValueError(f"{path} has lines of different length in its header")
    # Labelled images are named in one or three columns of their own, without a coordinate.
    first = next((i for i, cell in enumerate(header["coords"]) if i and cell), 1)
    names = [_four_levels(path, name) for name in list(zip(*levels, strict=True))[first:]]
    values, index = [], []
    for line, cells in rows:
        if cells[0] in _LEVELS:
            raise ValueError(
                f"{path}: line {line} repeats the header row {cells[0]}; concatenated tables must "
                "be read separately"
            )
        try:
            numbers = [number(cell) for cell in cells[first:]]
        except ValueError:
            raise ValueError(f"{path}: line {line} has cells that are not numbers") from None
        if len(numbers) != len(names):
            raise ValueError(
                f"{path}: line {line} has {len(cells)} cells and the header {len(names) + first}; "
                "it may be cut short"
            )
        values.append(numbers)
        index.append(cells[first - 1])
    if not values:
        raise ValueError(f"{path} has a header but no rows")
    return names, np.array(values), index


def _header(path: Path, rows: Iterator[tuple[int, list[str]]]) -> dict[str, list[str]]:
    """Header rows by their first cell, up to the row of coordinates."""
    header: dict[str, list[str]] = {}
    other = ""
    for line, cells in rows:
        if cells[0] in header:
            raise ValueError(f"{path}: line {line} is the header row {cells[0]} a second time")
        if cells[0] not in _LEVELS:
            other = f"; then a line begins with {cells[0]!r}"
            break
        header[cells[0]] = cells
        if cells[0] == "coords":
            break
    if missing := [name for name in ("scorer", "bodyparts", "coords") if name not in header]:
        raise ValueError(
            f"{path} is not a table of DeepLabCut, or cut short: its header rows are "
            f"{', '.join(header) or 'none'}{other}; it lacks {', '.join(missing)}. {_NEEDED}"
        )
    return header


def _hdf5(path: Path) -> tuple[Names, Array, list[str]]:
    with opened(path, "a table of DeepLabCut") as file:
        for _, group in pandas_tables(file):
            # Read the column names, values and index of one table of pandas.
            table = _as_str(group.attrs["pandas_type"]) == "frame_table"
            names, values, index = _appendable(group) if table else _fixed(group)
            if sum(block.shape[1] for block in values) != len(names):
                raise ValueError(f"the columns of the table {group.name} are not named by text")
            if names and names[0][-1] in "xyz":
                named = [_four_levels(path, name) for name in names]
                return named, np.concatenate(values, axis=1), index
    raise ValueError(f"{path} is not a table of DeepLabCut. {_NEEDED}")


def _frames(path: Path, index: list[str], count: int) -> NDArray[np.int64]:
    """Frame numbers from the index of rows, or from names of images such as img0042.png."""
    numbers = [re.search(r"(\d+)(?:\.0)?(?:\.[A-Za-z]+)?$", cell) for cell in index]
    if not index or any(number is None for number in numbers):
        return np.arange(count)
    frames = np.array([int(number[1]) for number in numbers if number is not None])
    # Images of several videos may have the same numbers; rows that are only numbered may not.
    plain = all(re.fullmatch(r"\d+(\.0)?", cell) for cell in index)
    return frames if plain or len(np.unique(frames)) == count else np.arange(count)


def pandas_tables(file: h5py.File) -> Iterator[tuple[str, h5py.Group]]:
    """Yield the names and groups of the tables in a file written by pandas."""
    for name, group in file.items():
        if isinstance(group, h5py.Group) and _as_str(group.attrs.get("pandas_type", "")) in (
            "frame",
            "frame_table",
        ):
            yield name, group


def _appendable(group: h5py.Group) -> tuple[Names, list[Array], list[str]]:
    table = group["table"]
    rows = table[:]
    blocks = [name for name in table.dtype.names if name.startswith("values_block_")]
    names: Names = []
    for block in blocks:
        names += _column_names(table.attrs[f"{block}_kind"])
    values = [_block(block, rows[block]).reshape(len(rows), -1) for block in blocks]
    return (
        _as_text(names),
        values,
        _labels_of(rows["index"]) if "index" in rows.dtype.names else [],
    )


def _fixed(group: h5py.Group) -> tuple[Names, list[Array], list[str]]:
    names: Names = []
    values = []
    for i in range(int(group.attrs["nblocks"])):
        items = f"block{i}_items"
        if f"{items}_level0" not in group:
            columns = [(name,) for name in group[items].asstr()[:]]
        else:
            count = int(group.attrs[f"{items}_nlevels"])
            levels = [group[f"{items}_level{k}"][:] for k in range(count)]
            kind = "label" if f"{items}_label0" in group else "code"
            labels = [group[f"{items}_{kind}{k}"][:] for k in range(count)]
            columns = list(
                zip(
                    *(level[label] for level, label in zip(levels, labels, strict=True)),
                    strict=True,
                )
            )
        names += columns
        block = _block(f"block{i}_values", group[f"block{i}_values"][:])
        values.append(block.reshape(-1, len(columns)))
    return _as_text(names), values, _labels_of(group["axis1"][:]) if "axis1" in group else []


def _labels_of(values: NDArray[Any]) -> list[str]:
    return [_as_str(value) for value in values.tolist()] if values.ndim == 1 else []


def _as_text(names: Names) -> Names:
    return [tuple(_as_str(part) for part in name) for name in names]


def _as_str(value: Any) -> str:
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)


def _column_names(value: Any) -> Names:
    """Parse column names from a pickle without executing it.

    A pickle is a program and is not unpickled. Its instructions are disassembled, and only those
    that build text, numbers, tuples and lists are interpreted; any other raises ValueError.
    """
    content = value.encode("latin-1") if isinstance(value, str) else bytes(value)
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    for operation, argument, _ in pickletools.genops(content):
        name = operation.name
        if name.endswith(_PLAIN):
            stack.append(argument)
        elif name in ("MARK", "EMPTY_LIST", "EMPTY_TUPLE"):
            stack.append({"MARK": _MARK, "EMPTY_LIST": [], "EMPTY_TUPLE": ()}[name])
        elif name in ("LIST", "TUPLE"):
            stack.append({"LIST": list, "TUPLE": tuple}[name](_above_mark(stack)))
        elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
            count = int(name[-1])
            stack[-count:] = [tuple(stack[-count:])]
        elif name in ("APPEND", "APPENDS"):
            more = [stack.pop()] if name == "APPEND" else _above_mark(stack)
            stack[-1].extend(more)
        elif name.endswith("GET"):
            stack.append(memo[int(argument or 0)])
        elif name.endswith("PUT") or name == "MEMOIZE":
            memo[len(memo) if argument is None else int(argument)] = stack[-1]
        elif name not in ("PROTO", "FRAME", "STOP"):
            raise ValueError(
                f"the names of its columns are a pickle with {name} {argument or ''}, which is not "
                "read: text in lists and tuples is; save the table as CSV"
            )
    return _checked_names(stack)


_PLAIN = ("INT", "INT1", "INT2", "LONG", "LONG1", "FLOAT", "STRING", "UNICODE")
_MARK = object()


def _above_mark(stack: list[Any]) -> list[Any]:
    """Remove and return the items above the last mark of a stack, and remove the mark."""
    at = len(stack) - 1
    while stack[at] is not _MARK:  # from above: a pickle may be made of marks
        at -= 1
    taken = stack[at + 1 :]
    del stack[at:]
    return taken


def _checked_names(stack: list[Any]) -> Names:
    """Validate the parsed contents of a pickle: a list of text or of tuples of text."""
    if len(stack) != 1 or not isinstance(stack[0], list):
        raise ValueError("the names of its columns are not a list")
    names: Names = [name if isinstance(name, tuple) else (name,) for name in stack[0]]
    if not all(isinstance(part, str | int | float) for name in names for part in name):
        raise ValueError("the names of its columns are more than text and numbers")
    return names


def _block(name: str, data: Any) -> Array:
    """Values of a block of numbers; other types are rejected, as they may be pickles."""
    if data.dtype.kind not in "fiub":
        raise ValueError(f"{name} is of type {data.dtype}; numbers are needed")
    return np.asarray(data, dtype=np.float64)


_SCORES = (0.0, 1.0)  # the peaks of confidence maps can slightly exceed 1
_OWN = {"tracks": ("track", "xy", "node", "frame"), "point_scores": ("track", "node", "frame")}


def read_sleap_analysis(path: str | PathLike[str]) -> RawTracks:
    """Read an analysis file (``.h5``) as raw tracks."""
    path = Path(path)
    with opened(path, "an analysis file of SLEAP") as file:
        if "tracks" not in file or "node_names" not in file:
            raise ValueError(
                f"{path} is not an analysis file of SLEAP: it lacks tracks or node_names"
            )
        points = _ordered(file["tracks"], ("frame", "track", "node", "xy"))
        sure = None
        if "point_scores" in file:
            sure = _ordered(file["point_scores"], ("frame", "track", "node"))
        nodes = [str(name) for name in file["node_names"].asstr()[:]]
        named = "track_names" in file and file["track_names"].size
        names = [str(name) for name in file["track_names"].asstr()[:]] if named else []
        fps = file.attrs.get("fps")
    whiskers = names or _numbered(points.shape[1])
    if points.shape[1:] != (len(whiskers), len(nodes), 2):
        raise ValueError(
            f"{path}: tracks have shape {points.shape}, and names are given for {len(whiskers)} "
            f"tracks and {len(nodes)} nodes"
        )
    return RawTracks(
        software="SLEAP",
        whiskers=whiskers,
        image=points[:, :, None],
        image_confidence=None if sure is None else np.clip(sure, *_SCORES)[:, :, None],
        nodes=nodes,
        fps=None if fps is None else float(fps),
    )


def read_sleap_labels(path: str | PathLike[str]) -> RawTracks:
    """Read labels as raw tracks."""
    path = check_readable(path)
    try:
        import sleap_io
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{path} holds labels of SLEAP: to read them, install vibrissa[labs], or export the "
            "tracks from SLEAP as an analysis file"
        ) from error
    with opened(path, "labels of SLEAP") as file:
        if "frames" not in file or "instances" not in file:
            raise ValueError(f"{path} holds no labels of SLEAP: it lacks frames or instances")
    try:
        labels = sleap_io.load_slp(path, open_videos=False)
        parts = [_of_video(labels, video) for video in labels.videos]
    except Exception as error:  # What sleap-io raises for a damaged file is not documented.
        raise ValueError(f"{path} cannot be read as labels of SLEAP ({error})") from error
    if not any(len(values) for _, values in parts):
        raise ValueError(f"{path} holds no labelled frame")
    start = min(first for first, values in parts if len(values))
    end = max(first + len(values) for first, values in parts)
    tracks, nodes = (max(values.shape[axis] for _, values in parts) for axis in (1, 2))
    found = np.full((end - start, tracks, len(parts), nodes, 3), np.nan)
    for view, (first, values) in enumerate(parts):
        rows = slice(first - start, first - start + len(values))
        found[rows, : values.shape[1], view] = values
    names = [track.name for track in labels.tracks]
    stems = [Path(str(video.filename)).stem for video in labels.videos]
    if len(set(stems)) < len(stems):
        stems = [f"view {i + 1}" for i in range(len(stems))]
    return RawTracks(
        software="SLEAP",
        whiskers=names if len(names) == tracks else _numbered(tracks),
        image=found[..., :2],
        image_confidence=np.clip(found[..., 2], *_SCORES),
        nodes=list(labels.skeletons[0].node_names),
        views=stems if len(stems) > 1 else (),
        frames=np.arange(start, end),
    )


def _of_video(labels: sleap_io.Labels, video: sleap_io.Video) -> tuple[int, Array]:
    """First frame of a video's labels; their column, row and score (frame, track, node, 3)."""
    numbers = [frame.frame_idx for frame in labels.labeled_frames if frame.video == video]
    if not numbers:
        return 0, np.full((0, 1, 1, 3), np.nan)
    # Tracks may be listed although no instance has one.
    tracked = any(one.track is not None for frame in labels.labeled_frames for one in frame)
    found = labels.numpy(video=video, untracked=not tracked, return_confidence=True)
    # Depending on its version, sleap-io starts at frame 0 or at the first labelled frame.
    first = min(numbers) if len(found) == max(numbers) - min(numbers) + 1 else 0
    return first, found.astype(np.float64)


def _ordered(array: h5py.Dataset, wanted: tuple[str, ...]) -> Array:
    """Transpose an array to the wanted order of dimensions."""
    stated = array.attrs.get("dims")
    dims = tuple(json.loads(stated)) if stated is not None else _OWN[array.name.strip("/")]
    values: Array = np.asarray(array[:], dtype=np.float64)
    if sorted(dims) != sorted(wanted) or values.ndim != len(wanted):
        raise ValueError(f"{array.name} has dimensions {dims} of sizes {values.shape}")
    return values.transpose([dims.index(dim) for dim in wanted])


def _numbered(count: int) -> list[str]:
    return [str(i) for i in range(count)] if count != 1 else ["whisker"]


Frames = NDArray[np.int64]

_NAMES = {"individuals": "individual", "keypoints": "keypoint"}
_DIMS = ("time", "individual", "view", "keypoint", "space")
_PIXELS = ("", "px", "pixel", "pixels")


def read_movement(path: str | PathLike[str]) -> RawTracks:
    """Read a poses dataset as raw tracks."""
    path = Path(path)
    with naming(path, "a poses dataset of movement"):
        return _raw(path, read_dataset(path))


def _raw(path: Path, poses: xr.Dataset) -> RawTracks:
    poses = poses.rename({old: new for old, new in _NAMES.items() if old in poses.dims})
    if "position" not in poses or not {"time", "keypoint", "space"} <= set(poses["position"].dims):
        got = ", ".join(str(name) for name in poses.variables) or "nothing"
        raise ValueError(
            f"{path} is not a poses dataset of movement: it has {got}, and position along time, "
            "space, keypoint(s) and individual(s) is needed"
        )
    views = [str(name) for name in poses["view"].values] if "view" in poses.dims else []
    if "individual" not in poses.dims:
        poses = poses.expand_dims(individual=["whisker"])
    if not views:
        poses = poses.expand_dims("view")
    points = poses["position"].transpose(*_DIMS).values.astype(np.float64)
    sure = None
    if "confidence" in poses:
        sure = poses["confidence"].transpose(*_DIMS[:-1]).values.astype(np.float64)
    unit = str(poses.attrs.get("space_unit", ""))
    flat = points.shape[-1] == 2
    fps, time, frames = _clock(poses)
    if flat and unit not in _PIXELS:
        raise ValueError(f"{path} has positions in a plane in {unit}; pixels are needed")
    if not flat and points.shape[2] > 1:
        raise ValueError(f"{path} has points in space for {points.shape[2]} views; one is needed")
    return RawTracks.of(
        points,
        sure,
        software=f"movement ({poses.attrs.get('source_software', 'unknown')})",
        whiskers=[str(name) for name in poses["individual"].values],
        nodes=[str(name) for name in poses["keypoint"].values],
        views=views,
        unit="" if unit in _PIXELS else unit,
        fps=fps,
        time=time,
        frames=frames,
    )


def _clock(poses: xr.Dataset) -> tuple[float | None, Array | None, Frames | None]:
    """Frame rate, times and frame numbers, each None if unknown."""
    fps = poses.attrs.get("fps")
    time = poses["time"].values.astype(np.float64)
    if poses.attrs.get("time_unit", "frames") == "frames":
        return None, None, time.astype(np.int64)
    if fps is None:
        return None, time, None
    return float(fps), time, np.rint(time * float(fps)).astype(np.int64)


def read_anipose(path: str | PathLike[str]) -> RawTracks:
    """Read a table of Anipose as raw tracks; ``cameras`` is the number of cameras per point."""
    path = Path(path)
    names, values = read_numbers(path)
    parts = [name.removesuffix("_ncams") for name in names if name.endswith("_ncams")]
    missing = [
        f"{part}_{axis}" for part in parts for axis in "xyz" if f"{part}_{axis}" not in names
    ]
    if not parts or missing:
        got = f"it lacks {', '.join(missing)}" if missing else "no column ends in _ncams"
        raise ValueError(f"{path} is not a table of Anipose: {got}")

    def column(part: str, what: str) -> Array:
        name = f"{part}_{what}"
        return values[:, names.index(name)] if name in names else np.full(len(values), np.nan)

    points = np.stack(
        [np.stack([column(part, axis) for axis in "xyz"], axis=-1) for part in parts], axis=1
    )
    measured = {
        what: np.stack([column(part, what) for part in parts], axis=1)[:, None]
        for what in ("score", "error", "ncams")
    }
    # Where no camera saw a point the score is a placeholder above 1.
    score = np.where(measured["score"] > 1.0, np.nan, measured["score"])
    frames = values[:, names.index("fnum")] if "fnum" in names else np.arange(len(values))
    about = {"reprojection_error": ("pixel", "error"), "cameras": ("1", "ncams")}
    return RawTracks(
        software="Anipose",
        whiskers=["whisker"],
        space=points[:, None],
        space_confidence=score,
        nodes=parts,
        frames=frames.astype(np.int64),
        extra={
            name: xr.Variable(
                SPACE[:-1], measured[what], {"units": unit, "long_name": name.replace("_", " ")}
            )
            for name, (unit, what) in about.items()
        },
    )


_CAMERA_NEEDED = ("size", "matrix", "rotation", "translation")
_SHAPES = {"size": (2,), "matrix": (3, 3), "rotation": (3,), "translation": (3,), "distortions": ()}
_NUMBERS = {
    "size": "width and height",
    "matrix": "three rows of three numbers",
    "rotation": "three numbers",
    "translation": "three numbers",
    "distortions": "a list of numbers",
}


def read_calibration(path: str | PathLike[str]) -> list[dict[str, Any]]:
    """Read the calibration of each camera."""
    path = Path(path)
    cameras = []
    for name, table in read_toml(path).items():
        if not isinstance(table, dict) or name == "metadata":
            continue
        if missing := [key for key in _CAMERA_NEEDED if key not in table]:
            raise ValueError(f"{path}: [{name}] has no {', '.join(missing)}")
        with in_file(f"{path}: [{name}]"):
            cameras.append({"name": name} | table | _checked(table))
    if not cameras:
        raise ValueError(f"{path} holds no camera")
    return cameras


def _checked(table: Mapping[str, Any]) -> dict[str, Any]:
    """Validated parameters of a camera."""
    out: dict[str, Any] = {}
    for key, shape in _SHAPES.items():
        values = number_array(table.get(key, []), key)
        if values.shape != shape and not (key == "distortions" and values.ndim == 1):
            raise ValueError(f"{key} is {quoted(table[key])}; {_NUMBERS[key]} are needed")
        if not np.isfinite(values).all():
            raise ValueError(f"{key} is {quoted(table[key])}; its numbers must be finite")
        out[key] = values.tolist()
    kind = table.get("projection", "perspective")
    if kind not in ("perspective", "orthographic"):
        raise ValueError(f"projection is {quoted(kind)}; perspective or orthographic is needed")
    if table.get("fisheye"):
        raise ValueError(
            "fisheye is true; only lenses with radial and tangential distortion are known"
        )
    if float(np.linalg.norm(out["rotation"])) > 2.0 * np.pi:
        raise ValueError(
            f"rotation is {quoted(table['rotation'])}; a rotation vector, rad, is needed"
        )
    width, height = out["size"]
    if not (width % 1.0 == height % 1.0 == 0.0 and min(width, height) >= 1.0):
        raise ValueError(f"size is {quoted(table['size'])}; whole numbers of pixels are needed")
    out["size"] = [int(width), int(height)]
    return out


def write_calibration(path: str | PathLike[str], cameras: Sequence[Mapping[str, Any]]) -> None:
    """Write a calibration to a file for `read_calibration`."""
    lines = []
    for i, camera in enumerate(cameras):
        lines.append(f"[cam_{i}]")
        lines += [f"{key} = {_toml(value)}" for key, value in camera.items()]
        lines.append("")
    with replacing(path) as part:
        part.write_text("\n".join([*lines, "[metadata]", "adjusted = false", ""]), encoding="utf-8")


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, int | float):
        return repr(value)
    return "[" + ", ".join(_toml(part) for part in value) + "]"
