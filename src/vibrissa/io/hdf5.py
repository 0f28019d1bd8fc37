"""Files in HDF5, opened with errors that name them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike

import h5py

from vibrissa.io.paths import check_readable


@contextmanager
def opened(path: str | PathLike[str], what: str) -> Iterator[h5py.File]:
    """Open a file in HDF5 for reading.

    Parameters
    ----------
    path : str or path
        The file.
    what : str
        It is read as, such as ``a table of DeepLabCut``.

    Yields
    ------
    h5py.File
        Open, and closed after.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it cannot be opened, or while it is read something is not there or of another kind.
    """
    path = check_readable(path)
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError) as error:
        raise ValueError(
            f"{path} cannot be read as HDF5: it is of another format, cut off or damaged ({error})"
        ) from error
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise ValueError(f"{path} is not {what} as it is known: {error!r}") from error
    except ValueError as error:
        # Those of our own name the file already.
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: {error}") from error
