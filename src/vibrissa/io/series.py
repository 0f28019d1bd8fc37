"""Images that cameras took at the same moments: numbered image files, or a video each.

``top_01.png … front_01.png …`` are images of the cameras ``top`` and ``front``; where the names are
only numbers, the folder is the camera. Images of one number belong together. Of videos some frames
are taken, the same ones of each.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np

from vibrissa.io.kinds import Kind, recognise
from vibrissa.io.video import Frame, read_video, video_info

_NUMBERED = re.compile(r"^(.*?)[ _.-]*(\d+)$")


def load_series(paths: Sequence[str | PathLike[str]], most: int = 40) -> dict[str, list[Frame]]:
    """Read images of several cameras.

    Parameters
    ----------
    paths : sequence of str or path
        Images (PNG, JPEG, TIFF, …), or videos.
    most : int
        Frames that are taken of a video, evenly spread.

    Returns
    -------
    dict
        By name of the camera its grey images, moment by moment.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If one is neither image nor video, both are mixed, or the cameras' images do not belong
        together.
    """
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
    return {name: [_image(images[n]) for n in moments] for name, images in numbered.items()}


def _image(path: Path) -> Frame:
    return next(read_video(path)).copy()
