"""Videos, read and written frame by frame.

Frames are read one after the other, some of them, or any in any order. Any container and codec that
FFmpeg knows can be read; colour is turned into grey. Images that several cameras took at the same
moments are numbered files or a video each: ``top_01.png … front_01.png …`` are of the cameras
``top`` and ``front``; where the names are only numbers, the folder is the camera. Images of one
number belong together. Of videos the same frames of each are taken.

A view may be a part of the images of a video, as where a mirror shows the other side: wherever a
video is read its name may be followed by ``#COLUMN,ROW,WIDTH,HEIGHT``, and by ``:mirrored`` if left
and right, ``:flipped`` if up and down are to be exchanged, as in
``film.mp4#512,0,512,512:mirrored``.

Videos that are written for computers are 8 bit grey frames, of which every value counts: FFV1
(lossless) in Matroska, or H.264 in MP4. Movies for people are coloured frames as H.264 in MP4, such
as any player shows.
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
    """Properties that a video states: size of a frame, pixels; number of frames, 0 if not stated.

    The rate is that at which it is to be shown, frames per second, which for high-speed video is
    usually not the rate at which it was taken; 0 if it does not say. The codec is FFmpeg's name.
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
        """The part that a video's name states, if it does."""
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
                "pixels, cannot be: COLUMN,ROW,WIDTH,HEIGHT within them are needed, and then "
                "nothing, :mirrored or :flipped"
            )
        return cls(left, top, width, height, tuple(turned))

    def cut(self, frame: Frame) -> Frame:
        """Take the part of an image."""
        cut = frame[self.top : self.top + self.height, self.left : self.left + self.width]
        cut = cut[:, ::-1] if "mirrored" in self.turned else cut
        return np.ascontiguousarray(cut[::-1] if "flipped" in self.turned else cut)


def _grey_frames(path: str | PathLike[str], container: InputContainer) -> Callable[[Any], Frame]:
    """The function that turns a decoded frame of a video into what its name states."""
    part = _Part.of(path, container)
    return grey_frame if part is None else lambda frame: part.cut(grey_frame(frame))


def video_info(path: str | PathLike[str]) -> VideoInfo:
    """Read what a video holds."""
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
    """Read some frames of a video, and decode no more than need be."""
    wanted = [int(number) for number in numbers]
    if any(b < a for a, b in pairwise([0, *wanted])):
        raise ValueError("numbers of frames must not be negative and must not fall")
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
    """Numbers and images, in order, of all that is decoded; None of what is not wanted."""
    import av

    with opened_video(path) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        last, grey = max(wanted, default=-1), _grey_frames(path, container)
        sent: deque[int] = deque()
        packets: Iterator[Any] = pairwise(chain(container.demux(stream), [None]))
        try:
            for number, (packet, following) in enumerate(packets):
                # Between two key frames nothing else depends on a frame.
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
    """Open a file that holds a video, or raise an error that states why not."""
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


AHEAD = 60  # frames that are rather decoded one after another than jumped over


class Footage:
    """A video to look at frame by frame, open until `close`, which jumps to a frame by its time."""

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
                self._last = self._grey(frame)
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


_MEMORY = 200e6


class FrameReader:
    """Frames of a video by number.

    Frames are decoded one after the other, so that their numbers are right in every kind of video;
    the latest are kept, in so many bytes of memory. Going back farther than that begins anew.
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


_NUMBERED = re.compile(r"^(.*?)[ _.-]*(\d+)$")


def load_series(paths: Sequence[str | PathLike[str]], most: int = 40) -> dict[str, list[Frame]]:
    """Read images of several cameras."""
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
        raise ValueError("a video does not say how many frames it has: save frames as images")
    chosen = set(np.linspace(0, count - 1, min(most, count)).astype(int).tolist())
    return {
        name: [frame.copy() for i, frame in enumerate(read_video(path)) if i in chosen]
        for name, path in zip(names, files, strict=True)
    }


def _of_images(files: Sequence[Path]) -> dict[str, list[Frame]]:
    numbered: dict[str, dict[int, Path]] = {}
    for path in files:
        match = _NUMBERED.match(path.stem)
        if match is None:
            raise ValueError(f"{path} has no number; images are called like top_01.png")
        name, number = match[1] or path.resolve().parent.name, int(match[2])
        if number in numbered.setdefault(name, {}):
            raise ValueError(f"{path} and {numbered[name][number]} have the same camera and number")
        numbered[name][number] = path
    moments = sorted(set().union(*numbered.values()))
    for name, images in numbered.items():
        missing = [number for number in moments if number not in images]
        if missing:
            raise ValueError(
                f"camera {name} has no image {missing[0]} ({len(missing)} are missing of "
                f"{len(moments)}): images of one number belong together"
            )
    return {
        name: [next(read_video(images[n])).copy() for n in moments]
        for name, images in numbered.items()
    }


CODECS = {".mkv": "ffv1", ".mp4": "h264"}  # codec of a video by the ending of its file
# H.264's constant rate factor: 0 is lossless, 23 its usual default; here faint tips must last.
QUALITY = 16
_MOVIE_QUALITY = 20  # H.264's constant rate factor that is good enough for thin lines
# FFmpeg's numbers for: grey values from 0 to 255; from 16 to 235, as players expect; and the
# colours of HD television (BT.709).
_FULL, _TELEVISION, _HD = 2, 1, 1


def write_video(
    path: str | PathLike[str],
    frames: Iterable[Frame],
    rate: float = 50.0,
    quality: int = QUALITY,
) -> int:
    """Write a grey video, and return the number of its frames.

    Frames are (height, width) of 8 bits, all of one size. The ending ``.mkv`` is for FFV1,
    lossless, ``.mp4`` for H.264 of a constant rate factor from 0 (lossless) to 51; the rate is
    that at which it is to be shown. An existing file is replaced once the new one is complete.
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
