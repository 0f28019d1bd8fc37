"""What a NetCDF-4 file holds."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

from vibrissa.io.paths import NETCDF, check_readable

_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def is_netcdf(path: str | PathLike[str]) -> bool:
    """Tell whether a file is to be read as NetCDF-4.

    Parameters
    ----------
    path : str or path
        The file; it need not exist.

    Returns
    -------
    bool
        Whether it begins as HDF5, of which NetCDF-4 is a kind, or is named like one.
    """
    path = Path(path)
    if path.suffix.lower() in NETCDF:
        return True
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_SIGNATURE)) == _SIGNATURE


@contextmanager
def reading(path: str | PathLike[str]) -> Iterator[None]:
    """Name the file where it turns out to be damaged while it is read.

    Parameters
    ----------
    path : str or path
        That is being read.

    Yields
    ------
    None
        To read in.

    Raises
    ------
    ValueError
        Instead of what the libraries below raise.
    """
    try:
        yield
    except (OSError, KeyError, RuntimeError) as error:
        raise ValueError(f"{path} cannot be read: it is cut off or damaged ({error})") from error


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

    path = check_readable(path)
    try:
        with h5netcdf.File(path, "r") as file:
            kind = file.attrs.get("kind", "")
    except (OSError, KeyError, RuntimeError) as error:
        raise ValueError(
            f"{path} cannot be read as NetCDF-4: it is of another format, cut off or damaged "
            f"({error})"
        ) from error
    return kind.decode() if isinstance(kind, bytes) else str(kind)
