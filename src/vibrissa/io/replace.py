"""A file is either written whole or left as it was."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

from vibrissa.io.paths import check_writable


@contextmanager
def replacing(path: str | PathLike[str]) -> Iterator[Path]:
    """Give a place to write to, and put what was written in place of the file at the end.

    Parameters
    ----------
    path : str or path
        What is to be written or replaced.

    Yields
    ------
    Path
        A file beside it. If writing raises, it is removed and the old file stays.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    PermissionError
        If it cannot be written to.
    ValueError
        If the path is a folder.
    """
    path = check_writable(path)
    # Some writers look at the ending.
    handle, name = tempfile.mkstemp(
        prefix=f".{path.stem}.", suffix=f".part{path.suffix}", dir=path.parent
    )
    os.close(handle)
    part = Path(name)
    try:
        yield part
        # A temporary file is private; the finished one is as open as any other new file.
        mask = os.umask(0)
        os.umask(mask)
        part.chmod(0o666 & ~mask)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
