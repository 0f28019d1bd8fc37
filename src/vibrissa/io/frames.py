"""Any frame of a video, in any order."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from os import PathLike
from pathlib import Path

from vibrissa.io.video import Frame, read_video

_MEMORY = 200e6


class FrameReader:
    """Frames of a video by number.

    Frames are decoded one after the other, so that their numbers are right in every kind of video;
    the latest are kept. Going back farther than that begins anew.

    Parameters
    ----------
    path : str or path
        Of the video.
    memory : float
        What is kept, bytes.
    """

    def __init__(self, path: str | PathLike[str], memory: float = _MEMORY) -> None:
        self.path = Path(path)
        self._memory = memory
        self._kept: OrderedDict[int, Frame] = OrderedDict()
        self._coming: Iterator[Frame] = read_video(self.path)
        self._next = 0
        self._count: int | None = None

    def __getitem__(self, number: int) -> Frame:
        """Give a frame, counted from 0; an ``IndexError`` if there are fewer."""
        if number < 0:
            raise IndexError(f"frame {number}; they are counted from 0")
        if number in self._kept:
            return self._kept[number]
        if self._count is not None and number >= self._count:
            raise self._beyond(number)
        if number < self._next:
            self._coming, self._next = read_video(self.path), 0
        while self._next <= number:
            frame = next(self._coming, None)
            if frame is None:
                # So that the next request does not go on with a decoder that is done.
                self._count, self._coming, self._next = self._next, read_video(self.path), 0
                raise self._beyond(number)
            self._keep(self._next, frame)
            self._next += 1
        return self._kept[number]

    def _beyond(self, number: int) -> IndexError:
        return IndexError(f"{self.path} has {self._count} frames; there is no frame {number}")

    def _keep(self, number: int, frame: Frame) -> None:
        self._kept[number] = frame.copy()
        self._kept.move_to_end(number)
        while len(self._kept) > max(2, int(self._memory / frame.nbytes)):
            self._kept.popitem(last=False)
