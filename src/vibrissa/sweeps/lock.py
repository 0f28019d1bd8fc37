"""One run at a time: a lock that the system lets go of when its holder ends, however it ends."""

from __future__ import annotations

import errno
import sys
from pathlib import Path
from typing import IO


def hold(path: Path) -> IO[str]:
    """Take a lock."""
    file = path.open("a", encoding="utf-8")
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(0)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as fault:
        file.close()
        if fault.errno in (errno.EAGAIN, errno.EACCES):
            raise BlockingIOError(fault.errno, f"{path} is locked") from fault
        raise
    return file
