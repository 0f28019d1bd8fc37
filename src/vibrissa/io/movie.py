"""Movies for people: coloured frames as H.264 in MP4, such as any player shows."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.io.paths import replacing

Picture = NDArray[np.uint8]

_QUALITY = 20
"""H.264's constant rate factor, good enough for thin lines."""

_HD = 1
"""FFmpeg's word for: colours are those of HD television (BT.709)."""

_TELEVISION = 1
"""FFmpeg's word for: grey values from 16 to 235, which is what players expect."""


def write_movie(path: str | PathLike[str], frames: Iterable[Picture], rate: float = 25.0) -> int:
    """Write a movie.

    Parameters
    ----------
    path : str or path
        With the ending ``.mp4``; an existing file is replaced once the new one is complete.
    frames : iterable of array (height, width, 3 or 4)
        8 bit red, green, blue (and opacity, which is not looked at), all of one even size.
    rate : float
        Frames per second at which it is to be shown.

    Returns
    -------
    int
        How many frames were written.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    ValueError
        If the ending is another, the rate is not positive, there is no frame, or frames differ in
        size or type or have an odd size.
    """
    import av

    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise ValueError(f"{path} ends on {path.suffix!r}; a movie ends on .mp4")
    if not (np.isfinite(rate) and rate > 0.0):
        raise ValueError(f"rate is {rate!r}; it must be positive, in frames per second")
    # The index comes first, so that a player can begin before it has read everything.
    options = {"movflags": "+faststart"}
    count = 0
    with replacing(path) as part, av.open(part, "w", format="mp4", options=options) as container:
        stream: Any = None
        shape: tuple[int, ...] = ()
        for frame in frames:
            if stream is None:
                shape = _checked(frame)
                stream = _stream(container, shape, rate)
            if frame.shape != shape or frame.dtype != np.uint8:
                raise ValueError(
                    f"frame {count} is {frame.shape} of {frame.dtype}; {shape} of uint8 is needed"
                )
            container.mux(stream.encode(_coded(frame)))
            count += 1
        if stream is None:
            raise ValueError(f"{path}: there are no frames to write")
        container.mux(stream.encode())
    return count


def _checked(frame: Picture) -> tuple[int, ...]:
    """Shape of the frames."""
    shape = frame.shape
    if len(shape) != 3 or shape[2] not in (3, 4) or shape[0] % 2 or shape[1] % 2:
        raise ValueError(
            f"frames are {shape}; an even height and width and 3 or 4 colours are needed"
        )
    return shape


def _stream(container: Any, shape: tuple[int, ...], rate: float) -> Any:
    stream = container.add_stream(
        "libx264",
        rate=Fraction(rate).limit_denominator(1000),
        # A key frame every two seconds, so that one can wind to and fro.
        options={"crf": str(_QUALITY), "preset": "veryfast", "g": str(max(1, round(2 * rate)))},
    )
    stream.height, stream.width = shape[:2]
    stream.pix_fmt = "yuv420p"
    context = stream.codec_context
    context.color_range = _TELEVISION
    context.colorspace = context.color_primaries = context.color_trc = _HD
    return stream


def _coded(frame: Picture) -> Any:
    """Brightness and colours as players expect them."""
    import av

    kind = "rgb24" if frame.shape[2] == 3 else "rgba"
    image = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format=kind)
    return image.reformat(
        format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG", interpolation="AREA"
    )
