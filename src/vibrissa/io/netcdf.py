"""What a NetCDF-4 file holds."""

from __future__ import annotations

from os import PathLike
from pathlib import Path


def kind_of(path: str | PathLike[str]) -> str:
    """Read what a NetCDF-4 file says it holds.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    str
        Its attribute ``kind``, such as ``vibrissa recording``; empty if it has none.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is a folder, empty, cut off, or no NetCDF-4 file.
    """
    import h5netcdf

    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    if path.is_dir():
        raise ValueError(f"{path} is a folder; a NetCDF file is needed")
    if path.stat().st_size == 0:
        raise ValueError(f"{path} is empty")
    try:
        with h5netcdf.File(path, "r") as file:
            kind = file.attrs.get("kind", "")
    except OSError as error:
        raise ValueError(
            f"{path} cannot be read as NetCDF-4: it is of another format, cut off or damaged "
            f"({error})"
        ) from error
    return kind.decode() if isinstance(kind, bytes) else str(kind)
