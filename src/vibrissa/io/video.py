"""Reading and writing of videos, frame by frame.

Frames can be read in sequence, selected, or accessed at random. Any container and codec supported
by FFmpeg can be read; colour is converted to grey.

Simultaneous images of several cameras are numbered files, or one video per camera:
``top_01.png … front_01.png …`` belong to the cameras ``top`` and ``front``; if the names are only
numbers, the folder is the name of the camera. Images with the same number belong together. From
several videos, the same frames are used.

A view may be a part of the images of a video, as with a mirror: wherever a video is read, its name
may be followed by ``#COLUMN,ROW,WIDTH,HEIGHT``, and by ``:mirrored`` to exchange left and right or
``:flipped`` to exchange up and down, as in ``film.mp4#512,0,512,512:mirrored``.

Videos for analysis are written as 8-bit grey frames: FFV1 (lossless) in Matroska, or H.264 in MP4.
Movies for viewing are written as colour frames by H.264 in MP4, which any player supports.
"""

from __future__ import annotations

import re
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain, pairwise
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.io.kinds import Kind, recognise
from vibrissa.io.paths import refuse_whisk, replacing, without_part

if TYPE_CHECKING:
    from av.container import InputContainer


Frame = NDArray[np.uint8]


@dataclass(frozen=True)
class VideoInfo:
    """Properties stated by a video: frame size, pixels; number of frames, 0 if not stated.

    The rate is that of playback, frames per second, which for high-speed video usually differs from
    the rate of recording; 0 if not stated. The codec is named as by FFmpeg.
    """

    width: int
    height: int
    frames: int
    rate: float
    codec: str


@dataclass(frozen=True)
class _Part:
    """Part of the images of a video."""

    left: int
    top: int
    width: int
    height: int
    turned: tuple[str, ...]

    @classmethod
    def of(cls, path: str | PathLike[str], container: InputContainer) -> _Part | None:
        """Part stated in a video's name; None if there is none."""
        file, text = without_part(path)
        if not text:
            return None
        sides, *turned = text.split(":")
        left, top, width, height = map(int, sides.split(","))
        context = container.streams.video[0].codec_context
        inside = left + width <= context.width and top + height <= context.height
        if not inside or not width * height or not {*turned} <= {"mirrored", "flipped"}:
            raise ValueError(
                f"the part {text} of {file}, whose images are {context.width} × {context.height} "
                "pixels, is not valid: COLUMN,ROW,WIDTH,HEIGHT within the images are needed, "
                "optionally followed by :mirrored or :flipped"
            )
        return cls(left, top, width, height, tuple(turned))

    def cut(self, frame: Frame) -> Frame:
        """Cut the part out of an image."""
        cut = frame[self.top : self.top + self.height, self.left : self.left + self.width]
        cut = cut[:, ::-1] if "mirrored" in self.turned else cut
        return np.ascontiguousarray(cut[::-1] if "flipped" in self.turned else cut)


def _grey_frames(path: str | PathLike[str], container: InputContainer) -> Callable[[Any], Frame]:
    """Function that converts a decoded frame to grey values and cuts out the stated part."""
    part = _Part.of(path, container)
    return grey_frame if part is None else lambda frame: part.cut(grey_frame(frame))


def video_info(path: str | PathLike[str]) -> VideoInfo:
    """Read the properties of a video."""
    with opened_video(path) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        frames = stream.frames
        if not frames and container.duration and stream.average_rate:
            frames = round(container.duration * 1e-6 * float(stream.average_rate))
        part = _Part.of(path, container)
        return VideoInfo(
            width=context.width if part is None else part.width,
            height=context.height if part is None else part.height,
            frames=int(frames),
            rate=float(stream.average_rate or 0.0),
            codec=context.name,
        )


def read_video(path: str | PathLike[str]) -> Iterator[Frame]:
    """Read a video frame by frame.

    Parameters
    ----------
    path : str or path
        Path of the video.

    Yields
    ------
    array (height, width)
        Grey values, 0 is black and 255 white.
    """
    import av

    with opened_video(path) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        done, grey = 0, _grey_frames(path, container)
        try:
            for frame in container.decode(stream):
                yield grey(frame)
                done += 1
        except av.FFmpegError as error:
            raise ValueError(f"{path} is damaged after frame {done}: {error.strerror}") from error


def video_frames(path: str | PathLike[str], numbers: Iterable[int]) -> Iterator[Frame]:
    """Read selected frames of a video, decoding no more than necessary."""
    wanted = [int(number) for number in numbers]
    if any(b < a for a, b in pairwise([0, *wanted])):
        raise ValueError("frame numbers must not be negative and must not decrease")
    found = _decoded(path, set(wanted))
    number, image = -1, None
    for want in wanted:
        while number < want or image is None:
            number, frame = next(found, (-1, None))
            if number < 0:
                raise ValueError(f"{path} has no frame {want}")
            image = frame if number == want else None
        yield image


def _decoded(path: str | PathLike[str], wanted: set[int]) -> Iterator[tuple[int, Frame | None]]:
    """Yield number and image of each frame in order; the image is None if it is not wanted."""
    import av

    with opened_video(path) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        last, grey = max(wanted, default=-1), _grey_frames(path, container)
        sent: deque[int] = deque()
        packets: Iterator[Any] = pairwise(chain(container.demux(stream), [None]))
        try:
            for number, (packet, following) in enumerate(packets):
                # No other frame depends on a key frame that is followed by a key frame.
                alone = packet.is_keyframe and following is not None and following.is_keyframe
                if alone and number not in wanted:
                    continue
                if packet.size:
                    sent.append(number)
                for frame in stream.decode(packet):
                    at = sent.popleft()
                    yield at, grey(frame) if at in wanted else None
                    if at >= last:
                        return
        except av.FFmpegError as error:
            raise ValueError(f"{path} is damaged: {error.strerror}") from error


def opened_video(path: str | PathLike[str]) -> InputContainer:
    """Open a video file; raise an error that states why if it cannot be read."""
    import av

    path, _ = without_part(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    refuse_whisk(path)
    try:
        container = av.open(str(path))
    except av.FFmpegError as error:
        what = recognise(path) if path.stat().st_size else Kind.UNKNOWN
        known = "" if what in (Kind.VIDEO, Kind.UNKNOWN) else f" (what it holds: {what})"
        raise ValueError(
            f"{path} is not a video that can be read: {error.strerror}{known}"
        ) from error
    if not container.streams.video:
        container.close()
        raise ValueError(f"{path} contains no video")
    return container


# Formats with a plane of luminance; grey values of luminances that range from 16 to 235; FFmpeg's
# number of the range 0 to 255.
_VIDEO = ("yuv420p", "yuv422p", "yuv444p")
_WHOLE = ("gray", "yuvj420p", "yuvj422p", "yuvj444p")
_LIMITED, _FULL = bytes(min(max((510 * y - 7941) // 438, 0), 255) for y in range(256)), 2


def grey_frame(frame: Any) -> Frame:
    """Luminance of a frame over the full range 0 to 255, whatever the video's format."""
    name = frame.format.name
    if name not in _VIDEO + _WHOLE:
        return np.asarray(frame.to_ndarray(format="gray"), dtype=np.uint8)
    plane, limited = frame.planes[0], name in _VIDEO and frame.color_range != _FULL
    copied = bytearray(plane)  # writable, and translated in half the time that bytes take
    grey = np.frombuffer(copied.translate(_LIMITED) if limited else copied, dtype=np.uint8)
    # Contiguous as other images: kernels are compiled for one layout.
    return np.ascontiguousarray(grey.reshape(-1, plane.line_size)[: frame.height, : frame.width])


# Contrast of alternate rows, grey values; their smallest number a frame; how much more frequent
# they must be than alternate columns; and the share of all alternate rows that motion must explain:
# the hairs of a face that moves alternate where they do not move, too.
_ALTERNATE, _COMBED, _RATHER, _BY_MOTION = 8, 20, 10, 0.6


def interlaced(frames: Sequence[Frame]) -> bool:
    """Whether odd and even rows show different moments: rows alternate where something moves."""
    pairs = list(pairwise(frame.astype(np.int16) for frame in frames))
    rows = sum(_combed(after, after - before) for before, after in pairs)
    columns = sum(_combed(after.T, (after - before).T) for before, after in pairs)
    every = sum(_combed(after) for _, after in pairs)
    return rows > max(_COMBED * len(pairs), _RATHER * columns, _BY_MOTION * every)


def _combed(*images: NDArray[np.int16]) -> int:
    """Number of pixels from which on four in a column are dark and bright in turn in all images."""
    alternates = np.ones(images[0][3:].shape, dtype=bool)
    for image in images:
        steps = image[1:] - image[:-1]
        up, down = steps > _ALTERNATE, steps < -_ALTERNATE
        alternates &= up[:-2] & down[1:-1] & up[2:] | down[:-2] & up[1:-1] & down[2:]
    return int(alternates.sum())


AHEAD = 60  # number of frames up to which decoding in sequence is preferred to seeking


class Footage:
    """Random access to the frames of a video, by seeking to their times; open until `close`."""

    def __init__(self, path: str | PathLike[str]) -> None:
        self.info = video_info(path)
        self._path = path
        self._container = opened_video(path)
        self._stream = self._container.streams.video[0]
        self._stream.thread_type = "AUTO"
        self._grey = _grey_frames(path, self._container)
        self._start = self._stream.start_time or 0
        self._frames: Any = self._container.decode(self._stream)
        self._shown = -1
        self._last: Frame | None = None

    def frame(self, number: int) -> Frame:
        """Frame by its number, counted from 0."""
        import av

        if number < 0:
            raise ValueError(f"frames are numbered from 0; got {number}")
        if number == self._shown and self._last is not None:
            return self._last
        try:
            if not self._shown < number <= self._shown + AHEAD:
                self._jump(number)
            while self._shown < number:
                if (frame := next(self._frames, None)) is None:
                    raise ValueError(f"{self._path} ends before frame {number}")
                self._shown = self._number(frame)
                self._last = self._grey(frame)
        except av.FFmpegError as error:
            raise ValueError(f"{self._path} is damaged near frame {number}") from error
        assert self._last is not None  # a frame was decoded
        return self._last

    def _jump(self, number: int) -> None:
        """Seek to the last key frame before a frame."""
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


_MEMORY = 200e6


class FrameReader:
    """Frames of a video by number.

    Frames are decoded in sequence, so that their numbers are correct in every kind of video. The
    latest are cached, in at most ``memory`` bytes; access to earlier frames restarts the decoding.
    """

    def __init__(self, path: str | PathLike[str], memory: float = _MEMORY) -> None:
        self.path = Path(path)
        self._memory = memory
        self._kept: OrderedDict[int, Frame] = OrderedDict()
        self._coming: Iterator[Frame] = read_video(self.path)
        self._next = 0
        self._count: int | None = None

    def __getitem__(self, number: int) -> Frame:
        """Frame by its number, counted from 0; raise IndexError if there are fewer."""
        if number < 0:
            raise IndexError(f"frame {number}; they are counted from 0")
        if number in self._kept:
            return self._kept[number]
        if self._count is not None and number >= self._count:
            raise self._beyond(number)
        if number < self._next:
            self._coming, self._next = read_video(self.path), 0
        while self._next <= number:
            if (frame := next(self._coming, None)) is None:
                # The next request must not continue with an exhausted decoder.
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


_NUMBERED = re.compile(r"^(.*?)[ _.-]*(\d+)$")


def load_series(paths: Sequence[str | PathLike[str]], most: int = 40) -> dict[str, list[Frame]]:
    """Read simultaneous images of several cameras, by the names of the cameras."""
    files = [Path(path) for path in paths]
    videos = [recognise(path) == Kind.VIDEO for path in files]
    if all(videos):
        return _of_videos(files, most)
    if any(videos):
        raise ValueError(f"{files[videos.index(True)]} is a video; give images or videos, not both")
    return _of_images(files)


def _of_videos(files: Sequence[Path], most: int) -> dict[str, list[Frame]]:
    names = [path.stem for path in files]
    if len(set(names)) < len(names):
        names = [f"{path.parent.name} {path.stem}" for path in files]
    if len(set(names)) < len(names):
        raise ValueError(f"two videos have the same name: {', '.join(sorted(names))}")
    count = min(video_info(path).frames for path in files)
    if not count:
        raise ValueError("a video does not state its number of frames: save frames as images")
    chosen = set(np.linspace(0, count - 1, min(most, count)).astype(int).tolist())
    return {
        name: [frame.copy() for i, frame in enumerate(read_video(path)) if i in chosen]
        for name, path in zip(names, files, strict=True)
    }


def _of_images(files: Sequence[Path]) -> dict[str, list[Frame]]:
    numbered: dict[str, dict[int, Path]] = {}
    for path in files:
        if (match := _NUMBERED.match(path.stem)) is None:
            raise ValueError(f"{path} has no number; names of images must be like top_01.png")
        name, number = match[1] or path.resolve().parent.name, int(match[2])
        if number in numbered.setdefault(name, {}):
            raise ValueError(f"{path} and {numbered[name][number]} have the same camera and number")
        numbered[name][number] = path
    moments = sorted(set().union(*numbered.values()))
    for name, images in numbered.items():
        if missing := [number for number in moments if number not in images]:
            raise ValueError(
                f"camera {name} has no image {missing[0]} ({len(missing)} are missing of "
                f"{len(moments)}): images of one number belong together"
            )
    return {
        name: [next(read_video(images[n])).copy() for n in moments]
        for name, images in numbered.items()
    }


# Constant rate factor of H.264: 0 is lossless, 23 the usual default; 16 preserves faint tips.
QUALITY = 16
_MOVIE_QUALITY = 20  # constant rate factor of H.264 sufficient for thin lines
# FFmpeg's codes for grey values from 0 to 255, for those from 16 to 235 as players expect, and for
# the colours of HD television (BT.709).
_FULL, _TELEVISION, _HD = 2, 1, 1


def write_video(
    path: str | PathLike[str], frames: Iterable[Frame], rate: float = 50.0, quality: int = QUALITY
) -> int:
    """Write a grey video, and return the number of frames.

    Frames are 8-bit arrays (height, width) of equal size. The ending ``.mkv`` selects FFV1
    (lossless), ``.mp4`` H.264 with the constant rate factor ``quality`` from 0 (lossless) to 51.
    ``rate`` is that of playback, Hz. An existing file is replaced once the new one is complete.
    """
    import av

    path = Path(path)
    kind = path.suffix.lower()
    # With FFV1 every frame is a key frame, so that frames can be read independently.
    options = {"level": "3", "slices": "4", "g": "1"}
    if kind == ".mp4":
        options = {"crf": str(quality), "preset": "ultrafast"}
    elif kind != ".mkv":
        raise ValueError(f"{path} ends in {path.suffix!r}; one of .mkv, .mp4 is needed")

    def coded(frame: Frame) -> Any:
        image = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="gray")
        image.color_range = _FULL
        return image

    container, codec = ("mp4", "libx264") if kind == ".mp4" else ("matroska", "ffv1")
    about = {"color_range": _FULL}
    return _write(path, container, frames, coded, rate, codec, "gray", options, about)


def write_movie(path: str | PathLike[str], frames: Iterable[Frame], rate: float = 25.0) -> int:
    """Write a movie.

    Parameters
    ----------
    path : str or path
        File with the ending ``.mp4``; an existing file is replaced once the new one is complete.
    frames : iterable of array (height, width, 3 or 4)
        8-bit values of red, green, blue (and opacity, which is ignored), all of one even size.
    rate : float
        Frame rate of playback, Hz.

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
    import av

    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise ValueError(f"{path} ends in {path.suffix!r}; a movie must end in .mp4")
    if not (np.isfinite(rate) and rate > 0.0):
        raise ValueError(f"rate is {rate!r}; it must be positive, in frames per second")
    # A key frame every two seconds allows quick seeking.
    options = {"crf": str(_MOVIE_QUALITY), "preset": "veryfast", "g": str(max(1, round(2 * rate)))}

    def coded(frame: Frame) -> Any:
        shape = frame.shape
        if len(shape) != 3 or shape[2] not in (3, 4) or shape[0] % 2 or shape[1] % 2:
            raise ValueError(
                f"frames are {shape}; an even height and width and 3 or 4 colours are needed"
            )
        kind = "rgb24" if shape[2] == 3 else "rgba"
        image = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format=kind)
        return image.reformat(
            format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG", interpolation="AREA"
        )

    about = dict.fromkeys(("colorspace", "color_primaries", "color_trc"), _HD)
    about["color_range"] = _TELEVISION
    return _write(path, "mp4", frames, coded, rate, "libx264", "yuv420p", options, about)


def _write(
    path: Path,
    container_format: str,
    frames: Iterable[Frame],
    coded: Callable[[Frame], Any],
    rate: float,
    codec: str,
    pixels: str,
    options: Mapping[str, str],
    about: Mapping[str, int],
) -> int:
    """Encode frames of one shape; ``coded`` converts a frame, ``about`` has codes of colours."""
    import av

    count = 0
    shape: tuple[int, ...] = ()
    stream: Any = None
    # The index of MP4 comes first, so that playback can start before the whole file is read.
    first = {"movflags": "+faststart"} if pixels != "gray" else {}
    with (
        replacing(path) as part,
        av.open(part, "w", format=container_format, options=first) as container,
    ):
        for frame in frames:
            shape = shape or frame.shape
            if frame.shape != shape or frame.dtype != np.uint8:
                raise ValueError(
                    f"frame {count} is {frame.shape} of {frame.dtype}; {shape} of uint8 is needed"
                )
            image = coded(frame)
            if stream is None:
                limited = Fraction(rate).limit_denominator(1000)
                stream = container.add_stream(codec, rate=limited, options=dict(options))
                stream.height, stream.width = shape[:2]
                stream.pix_fmt = pixels
                for name, value in about.items():
                    setattr(stream.codec_context, name, value)
            container.mux(stream.encode(image))
            count += 1
        if stream is None:
            raise ValueError(f"{path}: there are no frames to write")
        container.mux(stream.encode())
    return count
