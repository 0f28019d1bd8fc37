"""A file is either written whole or left as it was.

What is being written has a name of its own beside the target and a lock, which ends with whoever
writes. So what a killed run left behind is known by its name and by nobody holding it, and the
next one who writes into that folder removes it.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

from vibrissa.io.paths import check_writable

_MARK = ".vibrissa-part-"
_LOCKS = sys.platform != "win32"
_PART = re.compile(rf"\..+{re.escape(_MARK)}[a-z0-9_]{{8}}(\.[^.]*)?")


@contextmanager
def replacing(path: str | PathLike[str]) -> Iterator[Path]:
    """Give a place to write to, and put what was written in place of the file at the end."""
    path = check_writable(path)
    _remove_left(path.parent)
    with _failing(path):
        # Some writers look at the ending.
        handle, name = tempfile.mkstemp(
            prefix=f".{path.stem}{_MARK}", suffix=path.suffix, dir=path.parent
        )
    part = Path(name)
    _held(handle)
    if not _LOCKS:  # and what is open cannot be renamed
        os.close(handle)
    try:
        with _failing(path):
            yield part
            _finish(part)
            part.replace(path)
    finally:
        if _LOCKS:
            os.close(handle)
        part.unlink(missing_ok=True)


@contextmanager
def _failing(path: Path) -> Iterator[None]:
    """Name the file that the user asked for, not the temporary one."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        reason = os.strerror(error.errno)
        left = "; what was there is as it was" if path.exists() else ""
        raise OSError(error.errno, f"{path} cannot be written: {reason}{left}") from error


def _finish(part: Path) -> None:
    """Have the system say now if it has no room, and open the file as any other new one."""
    with part.open("r+b") as file:
        os.fsync(file.fileno())
    # A temporary file is private; only its owner could read the finished one.
    mask = os.umask(0)
    os.umask(mask)
    part.chmod(0o666 & ~mask)


def _held(handle: int) -> bool:
    """Take the lock of a part; False if somebody has it, or there are no locks here."""
    if not _LOCKS:
        return False
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _remove_left(folder: Path) -> None:
    """Remove what runs that were killed left in a folder; of those that live the lock is held."""
    for part in [one for one in folder.iterdir() if _PART.fullmatch(one.name)]:
        with contextlib.suppress(OSError):
            handle = os.open(part, os.O_RDWR)
            try:
                if _held(handle):
                    part.unlink()
            finally:
                os.close(handle)
