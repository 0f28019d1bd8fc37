"""Single frames of a video, in any order."""

from __future__ import annotations

from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.io.video import grey_frame, opened_video, video_info

Frame = NDArray[np.uint8]

AHEAD = 60
"""Frames that are rather decoded one after another than jumped over."""


class Footage:
    """A video to look at frame by frame; keeps the file open until it is closed."""

    def __init__(self, path: str | PathLike[str]) -> None:
        self.info = video_info(path)
        self._path = path
        self._container = opened_video(path)
        self._stream = self._container.streams.video[0]
        self._stream.thread_type = "AUTO"
        self._start = self._stream.start_time or 0
        self._frames: Any = self._container.decode(self._stream)
        self._shown = -1
        self._last: Frame | None = None

    def frame(self, number: int) -> Frame:
        """Give one frame."""
        import av

        if number < 0:
            raise ValueError(f"frames are numbered from 0; got {number}")
        if number == self._shown and self._last is not None:
            return self._last
        try:
            if not self._shown < number <= self._shown + AHEAD:
                self._jump(number)
            while self._shown < number:
                frame = next(self._frames, None)
                if frame is None:
                    raise ValueError(f"{self._path} ends before frame {number}")
                self._shown = self._number(frame)
                self._last = grey_frame(frame)
        except av.FFmpegError as error:
            raise ValueError(f"{self._path} is damaged near frame {number}") from error
        assert self._last is not None  # a frame was decoded
        return self._last

    def _jump(self, number: int) -> None:
        """Go on from the last frame before that can be decoded by itself."""
        rate, base = self._stream.average_rate, self._stream.time_base
        place = 0 if rate is None or base is None else round(number / rate / base)
        self._container.seek(self._start + place, stream=self._stream)
        self._frames = self._container.decode(self._stream)
        self._shown = -1

    def _number(self, frame: Any) -> int:
        rate = self._stream.average_rate
        if frame.pts is None or rate is None:
            return self._shown + 1
        number: int = round((frame.pts - self._start) * frame.time_base * rate)
        return number

    def close(self) -> None:
        """Close the file."""
        self._container.close()
