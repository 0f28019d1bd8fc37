"""Grey videos, read and written frame by frame.

Any container and codec that FFmpeg knows can be read; colour is turned into grey. Written are 8 bit
grey frames: FFV1 (lossless) in Matroska by default, H.264 in MP4.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain, pairwise
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.io.paths import refuse_whisk
from vibrissa.io.replace import replacing

if TYPE_CHECKING:
    from av.container import InputContainer

Frame = NDArray[np.uint8]

CODECS = {".mkv": "ffv1", ".mp4": "h264"}
"""By the ending of the file: what a video is written with."""

QUALITY = 16
"""H.264's constant rate factor: 0 is lossless, 23 its usual default; here faint tips must last."""

_FULL = 2
"""FFmpeg's word for: all grey values from 0 to 255 are meant."""


@dataclass(frozen=True)
class VideoInfo:
    """What a video says of itself.

    Parameters
    ----------
    width, height : int
        Of a frame, pixels.
    frames : int
        How many it says it has; 0 if it does not say.
    rate : float
        Frames per second at which it is to be shown, which for high-speed video is usually not the
        rate at which it was taken; 0 if it does not say.
    codec : str
        FFmpeg's name.
    """

    width: int
    height: int
    frames: int
    rate: float
    codec: str


def video_info(path: str | PathLike[str]) -> VideoInfo:
    """Say what a video holds.

    Parameters
    ----------
    path : str or path
        Of the video.

    Returns
    -------
    VideoInfo

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no video, or a damaged one.
    """
    with opened_video(path) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        frames = stream.frames
        if not frames and container.duration and stream.average_rate:
            frames = round(container.duration * 1e-6 * float(stream.average_rate))
        return VideoInfo(
            width=context.width,
            height=context.height,
            frames=int(frames),
            rate=float(stream.average_rate or 0.0),
            codec=context.name,
        )


def read_video(path: str | PathLike[str]) -> Iterator[Frame]:
    """Read a video frame by frame.

    Parameters
    ----------
    path : str or path
        Of the video.

    Yields
    ------
    array (height, width)
        Grey values, 0 is black and 255 white.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no video, or damaged from some frame on.
    """
    import av

    with opened_video(path) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        done = 0
        try:
            for frame in container.decode(stream):
                yield grey_frame(frame)
                done += 1
        except av.FFmpegError as error:
            raise ValueError(f"{path} is damaged after frame {done}: {error.strerror}") from error


def video_frames(path: str | PathLike[str], numbers: Iterable[int]) -> Iterator[Frame]:
    """Read some frames of a video, and decode no more than need be.

    Parameters
    ----------
    path : str or path
        Of the video.
    numbers : iterable of int
        Of the frames, counted from 0, never falling; one may come several times.

    Yields
    ------
    array (height, width)
        Grey values, one array for each number.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If numbers fall or are negative, the video has fewer frames, or it is none or damaged.
    """
    wanted = [int(number) for number in numbers]
    if any(b < a for a, b in pairwise([0, *wanted])):
        raise ValueError("numbers of frames must not be negative and must not fall")
    found = _decoded(Path(path), set(wanted))
    number, image = -1, None
    for want in wanted:
        while number < want or image is None:
            number, frame = next(found, (-1, None))
            if frame is None:
                raise ValueError(f"{path} has no frame {want}")
            image = grey_frame(frame) if number == want else None
        yield image


def _decoded(path: Path, wanted: set[int]) -> Iterator[tuple[int, Any]]:
    """Numbers and frames, in order: those wanted, and what decoding them takes."""
    import av

    with opened_video(path) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        last = max(wanted, default=-1)
        sent: deque[int] = deque()
        try:
            for number, (packet, following) in enumerate(_with_next(container.demux(stream))):
                # Between two key frames nothing else depends on a frame.
                alone = packet.is_keyframe and following is not None and following.is_keyframe
                if alone and number not in wanted:
                    continue
                if packet.size:
                    sent.append(number)
                for frame in stream.decode(packet):
                    at = sent.popleft()
                    yield at, frame
                    if at >= last:
                        return
        except av.FFmpegError as error:
            raise ValueError(f"{path} is damaged: {error.strerror}") from error


def _with_next(packets: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
    """Each packet and the one that follows; of the last one that is None."""
    return pairwise(chain(packets, [None]))


def write_video(
    path: str | PathLike[str],
    frames: Iterable[Frame],
    rate: float = 50.0,
    quality: int = QUALITY,
) -> int:
    """Write a grey video.

    Parameters
    ----------
    path : str or path
        With the ending ``.mkv`` (FFV1, lossless) or ``.mp4`` (H.264); an existing file is replaced
        once the new one is complete.
    frames : iterable of array (height, width)
        8 bit grey values, all of one size.
    rate : float
        Frames per second at which it is to be shown.
    quality : int
        Constant rate factor of H.264, 0 (lossless) to 51.

    Returns
    -------
    int
        How many frames were written.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    ValueError
        If the ending is another, there is no frame, or frames differ in size or type.
    """
    import av

    path = Path(path)
    codec = CODECS.get(path.suffix.lower())
    if codec is None:
        raise ValueError(f"{path} ends on {path.suffix!r}; one of {', '.join(CODECS)} is needed")
    container_format = {"ffv1": "matroska", "h264": "mp4"}[codec]
    # Of FFV1 every frame is a key frame, so that one can be read without those before it.
    options = {"ffv1": {"level": "3", "slices": "4", "g": "1"}}.get(
        codec, {"crf": str(quality), "preset": "ultrafast"}
    )
    count = 0
    with replacing(path) as part, av.open(part, "w", format=container_format) as container:
        stream: Any = None
        shape: tuple[int, ...] = ()
        for frame in frames:
            if stream is None:
                shape = frame.shape
                stream = container.add_stream(
                    "libx264" if codec == "h264" else codec,
                    rate=Fraction(rate).limit_denominator(1000),
                    options=options,
                )
                stream.height, stream.width = shape
                stream.pix_fmt = "gray"
                stream.codec_context.color_range = _FULL
            if frame.shape != shape or frame.dtype != np.uint8:
                raise ValueError(
                    f"frame {count} is {frame.shape} of {frame.dtype}; {shape} of uint8 is needed"
                )
            image = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="gray")
            image.color_range = _FULL
            container.mux(stream.encode(image))
            count += 1
        if stream is None:
            raise ValueError(f"{path}: there are no frames to write")
        container.mux(stream.encode())
    return count


def opened_video(path: str | PathLike[str]) -> InputContainer:
    """Open a file that holds a video, or raise what says why not."""
    import av

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    refuse_whisk(path)
    try:
        container = av.open(str(path))
    except av.FFmpegError as error:
        raise ValueError(f"{path} is no video that can be read: {error.strerror}") from error
    if not container.streams.video:
        container.close()
        raise ValueError(f"{path} holds no video")
    return container


def grey_frame(frame: Any) -> Frame:
    """Luminance over the full range, whatever the video's own format."""
    if frame.format.name in ("gray", "yuvj420p", "yuvj422p", "yuvj444p"):
        plane = frame.planes[0]
        rows = np.frombuffer(plane, dtype=np.uint8).reshape(-1, plane.line_size)
        grey: Frame = rows[: frame.height, : frame.width]
        return grey
    return np.asarray(frame.to_ndarray(format="gray"), dtype=np.uint8)
