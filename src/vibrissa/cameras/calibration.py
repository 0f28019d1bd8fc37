"""Calibrate cameras from images of a checkerboard (needs OpenCV: the extra ``cameras``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras.camera import Camera, triangulate

Image = NDArray[np.uint8]
Board = NDArray[np.float32]

_FEWEST = 4
"""Smallest number of moments in which all cameras see the board."""


def calibrate(
    images: Mapping[str, Sequence[Image]], corners: tuple[int, int], square: float
) -> tuple[tuple[Camera, ...], float]:
    """Calibrate cameras that look at one checkerboard at the same moments.

    Parameters
    ----------
    images : mapping of str to sequence of array (height, width)
        Grey images of each camera by its name, moment by moment; the board need not be seen in all.
    corners : tuple of int
        Numbers of inner corners along the longer and along the shorter side of the board.
    square : float
        Side of a square, m.

    Returns
    -------
    cameras : tuple of Camera
        Cameras in the laboratory frame that is that of the board in the first moment in which all
        cameras see it: origin at its first inner corner, x along its rows, y along its columns.
    error : float
        Root mean square distance of the corners from where the cameras see them, pixels.

    Raises
    ------
    ImportError
        If OpenCV is not installed.
    ValueError
        If the cameras differ in their number of images, or the board is seen too seldom.
    """
    counts = {name: len(series) for name, series in images.items()}
    if len(counts) < 2 or len(set(counts.values())) != 1:
        raise ValueError(f"images of the cameras: {counts}; two cameras, as many each, are needed")
    for name, series in images.items():
        sizes = {np.shape(image)[::-1] for image in series}
        if len(sizes) > 1:
            raise ValueError(f"images of camera {name} differ in size: {sorted(sizes)}")
    board: Board = np.zeros((corners[0] * corners[1], 3), np.float32)
    board[:, :2] = np.indices(corners).T.reshape(-1, 2) * square
    seen = {
        name: [_corners(np.asarray(image), corners) for image in series]
        for name, series in images.items()
    }
    moments = range(next(iter(counts.values())))
    shared = [i for i in moments if all(rows[i] is not None for rows in seen.values())]
    if len(shared) < _FEWEST:
        raise ValueError(
            f"the board is seen by all cameras in {len(shared)} images; {_FEWEST} are needed, with "
            "the board turned and at different places"
        )
    cameras = tuple(
        _camera(name, rows, board, images[name][0].shape, shared[0]) for name, rows in seen.items()
    )
    cameras = _together(cameras, seen, board, shared)
    return cameras, _error(cameras, seen, board, shared)


def _corners(image: Image, corners: tuple[int, int]) -> Any:
    cv2 = _opencv()
    found, points = cv2.findChessboardCornersSB(image, corners)
    return points.reshape(-1, 2) if found else None


def _opencv() -> Any:
    try:
        import cv2
    except ImportError as error:
        raise ImportError("calibrating needs OpenCV: pip install 'vibrissa[cameras]'") from error
    return cv2


def _camera(
    name: str, rows: Sequence[Any], board: Board, shape: tuple[int, ...], first: int
) -> Camera:
    """One camera by itself, in the frame of the board's first shared moment."""
    cv2 = _opencv()
    usable = [i for i, points in enumerate(rows) if points is not None]
    size = (shape[1], shape[0])
    _, matrix, distortion, turns, shifts = cv2.calibrateCamera(
        [board] * len(usable), [rows[i] for i in usable], size, None, None
    )
    k = usable.index(first)
    return Camera(
        matrix=matrix,
        rotation=cv2.Rodrigues(turns[k])[0],
        translation=shifts[k].reshape(3),
        distortion=distortion.reshape(-1)[:8],
        size=size,
        name=name,
    )


def _together(
    cameras: tuple[Camera, ...], seen: Mapping[str, Sequence[Any]], board: Board, shared: list[int]
) -> tuple[Camera, ...]:
    """Pose of every camera relative to the first from all shared moments, not from one."""
    cv2 = _opencv()
    main = cameras[0]
    placed = [main]
    for camera in cameras[1:]:
        answer = cv2.stereoCalibrate(
            [board] * len(shared),
            [seen[main.name][i] for i in shared],
            [seen[camera.name][i] for i in shared],
            main.matrix,
            main.distortion,
            camera.matrix,
            camera.distortion,
            main.size,
            flags=cv2.CALIB_FIX_INTRINSIC,
        )
        turn, shift = answer[5], answer[6].reshape(3)
        rotation, translation = turn @ main.rotation, turn @ main.translation + shift
        placed.append(replace(camera, rotation=rotation, translation=translation))
    return tuple(placed)


def _error(
    cameras: Sequence[Camera], seen: Mapping[str, Sequence[Any]], board: Board, shared: list[int]
) -> float:
    """Root mean square distance of the corners from the images of the points they give."""
    squares = []
    for i in shared:
        pixels = np.stack([seen[camera.name][i] for camera in cameras]).astype(np.float64)
        points, _ = triangulate(cameras, pixels)
        squares += [
            ((camera.project(points) - row) ** 2).sum(axis=1)
            for camera, row in zip(cameras, pixels, strict=True)
        ]
    return float(np.sqrt(np.mean(squares)))
