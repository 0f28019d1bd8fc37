"""What a file on the command line holds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr

    from vibrissa.mapping import ContactMap
    from vibrissa.whisker import Whisker


def whisker_from(path: Path | None) -> Whisker:
    """Read a whisker: a centreline as CSV, or out of a map or recording; by default the γ whisker.

    Parameters
    ----------
    path : Path or None
        The file.

    Returns
    -------
    Whisker
        That it holds.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it holds no whisker.
    """
    from vibrissa import samples
    from vibrissa.io import is_netcdf, kind_of, load_recording, load_whisker

    if path is None:
        return samples.gamma()
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    if not is_netcdf(path):
        return load_whisker(path)
    kind = kind_of(path)
    if kind == "vibrissa recording":
        from vibrissa.trial import recorded_whisker

        return recorded_whisker(load_recording(path))
    if kind == "vibrissa contact map":
        return map_from(path).whisker
    raise ValueError(f"{path} holds {kind or 'data of another kind'}, and no whisker")


def map_from(path: Path) -> ContactMap:
    """Read a map.

    Parameters
    ----------
    path : Path
        NetCDF.

    Returns
    -------
    ContactMap
        The map.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no map.
    """
    from vibrissa.mapping import ContactMap

    return ContactMap.load(path)


def wrench_from(path: Path) -> tuple[xr.Dataset, Whisker | None]:
    """Read force and moment over time from a table of signals or a recording.

    Parameters
    ----------
    path : Path
        CSV or NetCDF.

    Returns
    -------
    wrench : Dataset
        Dims time, space: ``force``, ``moment``.
    whisker : Whisker or None
        That rides along in a recording.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it holds no signals.
    """
    from vibrissa.io import is_netcdf, kind_of, load_recording, load_signals

    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    if not (is_netcdf(path) and kind_of(path) == "vibrissa recording"):
        return load_signals(path), None
    from vibrissa.trial import recorded_whisker

    recording = load_recording(path)
    if not {"force", "moment"} <= set(recording.data_vars):
        raise ValueError(f"{path} is a recording without force and moment")
    wrench = recording.to_dataset()[["force", "moment"]]
    if wrench.sizes["whisker"] != 1:
        raise ValueError(f"{path} is a recording of {wrench.sizes['whisker']} whiskers, not of one")
    return wrench.isel(whisker=0), recorded_whisker(recording)
