"""Checks of paths before reading and writing, and atomic writing of files.

Commands check output paths before they compute, so that no result is lost because it cannot be
written.

A file is either written completely or left unchanged: it is written under a temporary name next to
the target and renamed at the end. The temporary file is locked, and the lock ends with the process.
A temporary file without a lock was therefore left by a killed process, and the next process that
writes to the folder removes it.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

NETCDF = (".nc", ".nc4", ".netcdf", ".cdf", ".h5", ".hdf5")  # endings of NetCDF-4 files
CSV = (".csv",)  # endings of tables as text
NWB = (".nwb",)  # endings of Neurodata Without Borders files

# First bytes of whisk's binary files, and the names of these files.
_WHISK = {b"bwhiskbin": "traces of whisk (.whiskers)", b"measv": "measurements of whisk"}

_VIDEO_PART = re.compile(r"^(?P<file>.+)#(?P<part>\d+,\d+,\d+,\d+(?::[a-z]+)*)$", re.DOTALL)


def without_part(path: str | PathLike[str]) -> tuple[Path, str]:
    """Split a video's name into its path and the suffix that selects a part of the images."""
    path = Path(path)
    match = _VIDEO_PART.match(str(path))
    return (path, "") if match is None or path.exists() else (Path(match["file"]), match["part"])


def refuse_whisk(path: str | PathLike[str]) -> None:
    """Raise ValueError for a file of whisk, where another format is needed."""
    path = Path(path)
    if not path.is_file():
        return
    with path.open("rb") as file:
        head = file.read(16)
    for begin, kind in _WHISK.items():
        if head.startswith(begin):
            raise ValueError(
                f"{path} contains {kind}: whiskers traced in one video, in pixels. `vibrissa "
                "import` converts it to a recording, which the other commands accept"
            )


def check_readable(path: str | PathLike[str]) -> Path:
    """Raise an error unless a path is a file that is not empty."""
    file, _ = without_part(path)
    if not file.exists():
        raise FileNotFoundError(f"there is no file {file}")
    if file.is_dir():
        raise ValueError(f"{file} is a folder; the name of a file is needed")
    if not file.is_file():
        raise ValueError(f"{file} is a pipe or device; save its contents to a file first")
    if file.stat().st_size == 0:
        raise ValueError(f"{file} is empty")
    return Path(path)


def check_writable(path: str | PathLike[str], endings: Sequence[str] = ()) -> Path:
    """Raise an error unless a file can be created or replaced at a path."""
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path} is a folder; the name of a file is needed")
    if endings and path.suffix.lower() not in endings:
        refuse_whisk(path)
        got = f"ends in {path.suffix}" if path.suffix else "has no ending"
        raise ValueError(f"{path} {got}; {' or '.join(endings)} is needed")
    _check_folder(path.parent)
    return path


def check_folder(path: str | PathLike[str]) -> Path:
    """Raise an error unless a folder for results exists or can be created."""
    path = Path(path)
    above = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not above.is_dir():
        raise ValueError(f"{above} is a file; the name of a folder is needed")
    _check_folder(above)
    return path


def _check_folder(folder: Path) -> None:
    if not folder.is_dir():
        raise FileNotFoundError(f"the folder {folder} does not exist; make it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(f"the folder {folder} cannot be written to")


_MARK = ".vibrissa-part-"
_LOCKS = sys.platform != "win32"  # where open files cannot be renamed
_PART = re.compile(rf"\..+{re.escape(_MARK)}[a-z0-9_]{{8}}(\.[^.]*)?")


@contextmanager
def replacing(path: str | PathLike[str]) -> Iterator[Path]:
    """Context with a temporary path that replaces the file, also behind a link, at the end."""
    path = Path(path)
    path = check_writable(path.resolve() if path.is_symlink() else path)
    _remove_left(path.parent)
    with _failing(path):
        # Some writers depend on the ending.
        handle, name = tempfile.mkstemp(
            prefix=f".{path.stem}{_MARK}", suffix=path.suffix, dir=path.parent
        )
    part = Path(name)
    if _LOCKS:
        held(handle)
    else:
        os.close(handle)
    try:
        with _failing(path):
            yield part
            _finish(part, path)
            part.replace(path)
    finally:
        if _LOCKS:
            os.close(handle)
        part.unlink(missing_ok=True)


@contextmanager
def _failing(path: Path) -> Iterator[None]:
    """Replace the name of the temporary file in errors by that of the target."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        reason = os.strerror(error.errno)
        left = "; what was there is as it was" if path.exists() else ""
        raise OSError(error.errno, f"{path} cannot be written: {reason}{left}") from error


def _finish(part: Path, path: Path) -> None:
    """Flush a file to disk, and give it the permissions of the one it replaces, or the default."""
    with part.open("r+b") as file:
        os.fsync(file.fileno())
    # A temporary file is readable by its owner only.
    mask = os.umask(0)
    os.umask(mask)
    part.chmod(path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~mask)


def held(handle: int) -> bool:
    """Acquire the lock of an open file, which ends with the process; False if this fails."""
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _remove_left(folder: Path) -> None:
    """Remove temporary files that killed processes left in a folder; others are locked."""
    for part in [one for one in folder.iterdir() if _LOCKS and _PART.fullmatch(one.name)]:
        with contextlib.suppress(OSError):
            handle = os.open(part, os.O_RDWR)
            try:
                if held(handle):
                    part.unlink()
            finally:
                os.close(handle)
