"""Videos and movies, written frame by frame.

Videos for computers are 8 bit grey frames, of which every value counts: FFV1 (lossless) in
Matroska, or H.264 in MP4. Movies for people are coloured frames as H.264 in MP4, such as any
player shows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.io.paths import replacing

Frame = NDArray[np.uint8]

CODECS = {".mkv": "ffv1", ".mp4": "h264"}
"""Codec of a video by the ending of its file."""

QUALITY = 16
"""H.264's constant rate factor: 0 is lossless, 23 its usual default; here faint tips must last."""

_MOVIE_QUALITY = 20
"""H.264's constant rate factor that is good enough for thin lines."""

# FFmpeg's numbers for: grey values from 0 to 255; from 16 to 235, as players expect; and the
# colours of HD television (BT.709).
_FULL, _TELEVISION, _HD = 2, 1, 1


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
        File with the ending ``.mkv`` (FFV1, lossless) or ``.mp4`` (H.264); an existing file is
        replaced once the new one is complete.
    frames : iterable of array (height, width)
        Grey values of 8 bits, all of one size.
    rate : float
        Frames per second at which it is to be shown.
    quality : int
        Constant rate factor of H.264, 0 (lossless) to 51.

    Returns
    -------
    int
        Number of frames written.

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
    # Of FFV1 every frame is a key frame, so that one can be read without those before it.
    options = {"level": "3", "slices": "4", "g": "1"}
    if codec == "h264":
        options = {"crf": str(quality), "preset": "ultrafast"}

    def start(container: Any, shape: tuple[int, ...]) -> Any:
        name = "libx264" if codec == "h264" else codec
        stream = _stream(container, name, shape, rate, options, "gray")
        stream.codec_context.color_range = _FULL
        return stream

    def coded(frame: Frame) -> Any:
        image = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="gray")
        image.color_range = _FULL
        return image

    return _write(path, {"ffv1": "matroska", "h264": "mp4"}[codec], frames, start, coded)


def write_movie(path: str | PathLike[str], frames: Iterable[Frame], rate: float = 25.0) -> int:
    """Write a movie.

    Parameters
    ----------
    path : str or path
        File with the ending ``.mp4``; an existing file is replaced once the new one is complete.
    frames : iterable of array (height, width, 3 or 4)
        Red, green, blue (and opacity, which is not used) of 8 bits, all of one even size.
    rate : float
        Frames per second at which it is to be shown.

    Returns
    -------
    int
        Number of frames written.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    ValueError
        If the ending is another, the rate is not positive, there is no frame, or frames differ in
        size or type or have an odd size.
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise ValueError(f"{path} ends on {path.suffix!r}; a movie ends on .mp4")
    if not (np.isfinite(rate) and rate > 0.0):
        raise ValueError(f"rate is {rate!r}; it must be positive, in frames per second")
    # A key frame every two seconds, so that one can wind to and fro.
    options = {"crf": str(_MOVIE_QUALITY), "preset": "veryfast", "g": str(max(1, round(2 * rate)))}

    def start(container: Any, shape: tuple[int, ...]) -> Any:
        if len(shape) != 3 or shape[2] not in (3, 4) or shape[0] % 2 or shape[1] % 2:
            raise ValueError(
                f"frames are {shape}; an even height and width and 3 or 4 colours are needed"
            )
        stream = _stream(container, "libx264", shape, rate, options, "yuv420p")
        context = stream.codec_context
        context.color_range = _TELEVISION
        context.colorspace = context.color_primaries = context.color_trc = _HD
        return stream

    # The index comes first, so that a player can begin before it has read everything.
    return _write(path, "mp4", frames, start, _coloured, {"movflags": "+faststart"})


def _coloured(frame: Frame) -> Any:
    """Brightness and colours as players expect them."""
    import av

    kind = "rgb24" if frame.shape[2] == 3 else "rgba"
    image = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format=kind)
    return image.reformat(
        format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG", interpolation="AREA"
    )


def _stream(
    container: Any,
    codec: str,
    shape: tuple[int, ...],
    rate: float,
    options: Mapping[str, str],
    pixels: str,
) -> Any:
    limited = Fraction(rate).limit_denominator(1000)
    stream = container.add_stream(codec, rate=limited, options=dict(options))
    stream.height, stream.width = shape[:2]
    stream.pix_fmt = pixels
    return stream


def _write(
    path: Path,
    container_format: str,
    frames: Iterable[Frame],
    start: Callable[[Any, tuple[int, ...]], Any],
    coded: Callable[[Frame], Any],
    options: Mapping[str, str] | None = None,
) -> int:
    """Encode frames of one shape; `start` adds the stream, `coded` makes a frame of the codec."""
    import av

    count = 0
    shape: tuple[int, ...] = ()
    stream: Any = None
    with (
        replacing(path) as part,
        av.open(part, "w", format=container_format, options=dict(options or {})) as container,
    ):
        for frame in frames:
            if stream is None:
                shape = frame.shape
                stream = start(container, shape)
            if frame.shape != shape or frame.dtype != np.uint8:
                raise ValueError(
                    f"frame {count} is {frame.shape} of {frame.dtype}; {shape} of uint8 is needed"
                )
            container.mux(stream.encode(coded(frame)))
            count += 1
        if stream is None:
            raise ValueError(f"{path}: there are no frames to write")
        container.mux(stream.encode())
    return count
