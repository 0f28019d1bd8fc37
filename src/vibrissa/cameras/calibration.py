"""Calibration of cameras by simultaneous images of a checkerboard.

Each camera is first calibrated alone, which shows how many coefficients of its lens the corners
determine. Lenses and poses of all cameras and boards are then fitted together (bundle adjustment):
fitted one after the other, the errors of the focal lengths remain in the poses, and points in space
have errors ten times as large.

A board that looks the same after a rotation has several orders of its corners. They are chosen such
that the cameras keep their relative orientation from moment to moment.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras.camera import Camera, triangulate
from vibrissa.deferred import optimize, sparse, sparse_linalg, transform
from vibrissa.numerics import Array, Mask

Image = NDArray[np.uint8]
Board = NDArray[np.float32]
Seen = dict[tuple[str, int], Array]  # corners (n, 2), pixels, by camera and moment

_FEWEST = 4  # smallest number of moments at which all cameras must see the board
# Half width of the windows in which corners are refined, in sides of squares, and at most, pixels.
_WINDOW, _WIDEST = 0.4, 15
_EQUAL = 1e-3  # difference of mean agreements, up to 3, of orders of corners that are equally good
_DRAWS = 20  # number of draws that show the errors of points
# Relative changes at which the least squares, and the linear ones of each step, are solved.
_CONVERGED, _SOLVED = 1e-12, {"atol": 1e-14, "btol": 1e-14, "maxiter": 3000}
# Reprojection error, relative to the longer side of the image, of cameras that do not fit.
_UNFIT = 0.005
_ATTEMPTS = 200  # largest number of steps; cameras that explain the corners take some thirty
# Reprojection error of the images of one moment, relative to the median of all, that is doubted.
_DOUBTED = 3.0
# Error of points, over the extent of the boards, above which the images hardly determine cameras.
_VAGUE = 0.005
_TILT = "Take more images, with the board tilted by 20° and more, in various directions"


class Calibration(NamedTuple):
    """Cameras calibrated by a checkerboard.

    Attributes
    ----------
    cameras : tuple of Camera
        Cameras in the laboratory frame, which is that of the board at the first moment at which all
        cameras see it: origin at its first inner corner, x along its rows, y along its columns.
    error : float
        Root mean square reprojection error of the corners, pixels.
    point_sigma : float
        Root mean square error, m, that the uncertainty of the calibration causes in points among
        the boards, apart from a common displacement and rotation; of other errors, such as that of
        the board itself, it shows nothing.
    """

    cameras: tuple[Camera, ...]
    error: float
    point_sigma: float


def calibrate(
    images: Mapping[str, Sequence[Image]], corners: tuple[int, int], square: float
) -> Calibration:
    """Calibrate cameras from simultaneous images of one checkerboard.

    Parameters
    ----------
    images : mapping of str to sequence of array (height, width)
        Grey images of each camera by name, moment by moment; not all need to show the board.
    corners : tuple of int
        Numbers of inner corners along the longer and the shorter side of the board.
    square : float
        Side of a square of the board, m.

    Returns
    -------
    Calibration
        Cameras, their reprojection error, and the error of points that they triangulate.

    Raises
    ------
    ModuleNotFoundError
        If OpenCV is not installed.
    ValueError
        If the cameras have different numbers of images, too few show the board, no cameras
        explain the corners, or the boards are too much alike to determine them.

    Warns
    -----
    UserWarning
        If the images of one moment fit more than three times worse than those of most, or the
        boards, hardly tilted or all alike, do not determine the cameras to 0.5 % of their extent.
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
    found = {
        (name, i): _find_corners(np.asarray(image), corners)
        for name, series in images.items()
        for i, image in enumerate(series)
    }
    seen = {key: points for key, points in found.items() if points is not None}
    moments = range(next(iter(counts.values())))
    shared = [i for i in moments if all((name, i) in seen for name in images)]
    if len(shared) < _FEWEST:
        each = ", ".join(f"{name} in {sum(k == name for k, _ in seen)}" for name in images)
        raise ValueError(
            f"the board is seen by all cameras in {len(shared)} images (by {each}); {_FEWEST} are "
            "needed, with the board rotated and moved between them, and with as many inner corners "
            f"as stated, {corners[0]} × {corners[1]} (one less than squares)"
        )
    lenses = {
        name: _Lens.of([seen[key] for key in seen if key[0] == name], board, series[0].shape)
        for name, series in images.items()
    }
    largest = max(max(np.shape(image)) for series in images.values() for image in series)
    aligned = _aligned(seen, lenses, board, corners, shared)
    fit = _Bundle(board, aligned, lenses, tuple(shared))
    if not fit.error < _UNFIT * largest:
        # Poses of boards far away, which decide on orders, are ambiguous themselves.
        fit = _Bundle(board, seen, lenses, tuple(shared))
    doubt = fit.doubt()
    if not fit.error < _UNFIT * largest:
        raise ValueError(
            "no cameras explain the images of the board: their reprojection error is "
            f"{fit.error:.2g} pixels{doubt and f'; {doubt}'}. Were all images with the same number "
            "taken at the same moment, with cameras that did not move? Images by way of a mirror "
            f"must be mirrored back. {_TILT}"
        )
    if doubt:
        warnings.warn(
            f"{doubt}: did all cameras take it at the same moment, and was the board flat and at "
            "rest? Otherwise leave it out",
            stacklevel=2,
        )
    sigma, extent = fit.point_errors()
    if not sigma < extent:
        raise ValueError(f"the images do not determine the cameras. {_TILT}")
    if sigma > _VAGUE * extent:
        warnings.warn(
            f"the images hardly determine the cameras: points have errors of {1e3 * sigma:.2g} mm "
            f"(point_sigma) among boards that extend over {1e3 * extent:.2g} mm. {_TILT}",
            stacklevel=2,
        )
    return Calibration(fit.cameras(fit.solution.x), fit.error, sigma)


def _find_corners(image: Image, corners: tuple[int, int]) -> Any:
    """Pixels (n, 2) of the board's corners in an image, or None."""
    cv2 = _opencv()
    found, points = cv2.findChessboardCornersSB(image, corners)
    if not found:
        return None
    grid = points.reshape(corners[1], corners[0], 2)
    sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    # The detector's corners are biased by up to 0.1 pixels; windows reach no other corner.
    half = int(np.clip(_WINDOW * min(sides), 2, _WIDEST))
    until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    return cv2.cornerSubPix(image, points, (half, half), (-1, -1), until).reshape(-1, 2)


def _opencv() -> Any:
    """Import OpenCV."""
    try:
        import cv2
    except ImportError as error:
        raise ModuleNotFoundError(
            "calibrating needs OpenCV: pip install 'vibrissa[cameras]'"
        ) from error
    return cv2


@dataclass(frozen=True, eq=False)
class _Lens:
    """First estimate of a lens."""

    values: Array  # (9,): f_x, f_y, c_x, c_y, k1, k2, p1, p2, k3
    free: Mask  # which of them the corners determine
    size: tuple[int, int]  # width and height of the images

    @classmethod
    def of(cls, seen: Sequence[Array], board: Board, shape: tuple[int, ...]) -> _Lens:
        """Calibrate one camera alone.

        It has no more coefficients than the corners show (Bayesian information criterion): others
        would be arbitrary, and distort the parts of the image that the board never covered.
        """
        cv2 = _opencv()
        size, boards, number = (shape[1], shape[0]), [board] * len(seen), 2 * len(board) * len(seen)
        guess = cv2.initCameraMatrix2D(boards, seen, size, 1.0)
        fixed = (cv2.CALIB_FIX_K1, cv2.CALIB_FIX_K2, cv2.CALIB_ZERO_TANGENT_DIST, cv2.CALIB_FIX_K3)
        fits: list[tuple[Any, ...]] = []
        for square in (True, False):
            for i, terms in enumerate((0, 1, 2, 4, 5)):
                flags = cv2.CALIB_USE_INTRINSIC_GUESS | sum(fixed[i:])
                flags |= cv2.CALIB_FIX_ASPECT_RATIO * square
                fit = cv2.calibrateCamera(boards, seen, size, guess.copy(), None, flags=flags)
                free = np.arange(9) < 4 + terms
                free[1] = not square
                cost = number * np.log(fit[0] ** 2) + free.sum() * np.log(number)
                fits.append((cost, len(fits), free, fit[1:3]))
        free, (matrix, distortion) = min(fits)[2:]
        values = np.concatenate([matrix[[0, 1, 0, 1], [0, 1, 2, 2]], distortion.reshape(-1)[:5]])
        return cls(values, free, size)

    def with_free(self, free: Array) -> Array:
        """Values of the lens for other free ones; pixels are square if f_y is not free."""
        values = self.values.copy()
        values[self.free] = free
        values[1] = values[1] if self.free[1] else values[0]
        return values


def _matrix(lens: Array) -> Array:
    """Camera matrix (3, 3) of the values of a lens."""
    return np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])


def _pose(board: Board, seen: Array, lens: _Lens) -> tuple[Array, Array]:
    """Rotation (3, 3) and translation (3,) from the board to the camera that sees it."""
    cv2 = _opencv()
    _, turn, shift = cv2.solvePnP(board, seen, _matrix(lens.values), lens.values[4:])
    return cv2.Rodrigues(turn)[0], shift.reshape(3)


def _aligned(
    seen: Seen,
    lenses: Mapping[str, _Lens],
    board: Board,
    corners: tuple[int, int],
    shared: Sequence[int],
) -> Seen:
    """Corners in orders such that cameras keep their relative orientation."""
    turns = 4 if corners[0] == corners[1] else 2

    def orders(points: Array) -> Iterator[Array]:
        grid = points.reshape(corners[1], corners[0], 2)
        return (np.rot90(grid, k * 4 // turns).reshape(-1, 2) for k in range(turns))

    aligned = dict(seen)
    main, *others = lenses
    first = {i: _pose(board, seen[main, i], lenses[main])[0] for i in shared}
    for name in others:
        relative = np.array(
            [
                [_pose(board, one, lenses[name])[0] @ first[i].T for one in orders(seen[name, i])]
                for i in shared
            ]
        )
        # Of the orders at the first moment, that with which those of the others agree best; the
        # detector's, if the board was not rotated and all agree.
        agreement = np.einsum("kab,imab->kim", relative[0], relative)
        total = agreement.max(axis=2).mean(axis=1)
        best = agreement[(total > total.max() - _EQUAL).argmax()].argmax(axis=1)
        for i, order in zip(shared, best, strict=True):
            aligned[name, i] = np.ascontiguousarray(list(orders(seen[name, i]))[order])
    return aligned


@dataclass(frozen=True, eq=False)
class _Bundle:
    """Lenses and poses of all cameras and boards, fitted to all corners.

    The unknowns are the free values of each lens, the pose of each camera, and that of each board
    but the first shared one, as rotation vector and translation, in the frame of that one. Boards
    that not all cameras see are unknown for each camera.
    """

    board: Board
    seen: Seen
    lenses: Mapping[str, _Lens]
    shared: tuple[int, ...]

    @cached_property
    def boards(self) -> dict[tuple[str, int], int]:
        """Index of the pose of the board in each image; -1 for the first shared one."""
        keys = {key: key[1] if key[1] in self.shared else key for key in self.seen}
        order: dict[Any, int] = {self.shared[0]: -1}
        for key in keys.values():
            order.setdefault(key, len(order) - 1)
        return {key: order[value] for key, value in keys.items()}

    def _start(self) -> Array:
        """First guess of the unknowns."""
        poses = {
            key: _pose(self.board, points, self.lenses[key[0]]) for key, points in self.seen.items()
        }
        cameras = {name: poses[name, self.shared[0]] for name in self.lenses}
        boards = {}
        for key, (turn, shift) in poses.items():
            rotation, translation = cameras[key[0]]
            boards[self.boards[key]] = rotation.T @ turn, rotation.T @ (shift - translation)
        placed = [*cameras.values(), *(boards[k] for k in range(len(boards) - 1))]
        vectors = [(transform.Rotation.from_matrix(r).as_rotvec(), t) for r, t in placed]
        free = [lens.values[lens.free] for lens in self.lenses.values()]
        return np.concatenate([*free, np.ravel(vectors)])

    def _split(self, x: Array) -> tuple[dict[str, Array], dict[str, Array], Array]:
        """Lenses (9,) and poses (2, 3) of the cameras, and poses (n, 2, 3) of the boards."""
        lenses, at = {}, 0
        for name, lens in self.lenses.items():
            count = int(lens.free.sum())
            lenses[name] = lens.with_free(x[at : at + count])
            at += count
        poses = x[at:].reshape(-1, 2, 3)
        return lenses, dict(zip(lenses, poses, strict=False)), poses[len(lenses) :]

    def _compared(self, x: Array) -> tuple[Array, Any]:
        """Differences of projected and seen corners, pixels, flat; sparse derivatives of them."""
        cv2 = _opencv()
        lenses, cameras, boards = self._split(x)
        lens_at = np.cumsum([0, *(lens.free.sum() for lens in self.lenses.values())])
        pose_at = lens_at[-1] + 6 * np.arange(len(cameras) + len(boards))
        order = {name: i for i, name in enumerate(self.lenses)}
        misses, values, columns = [], [], []
        for (name, moment), points in self.seen.items():
            lens, free, i = lenses[name], self.lenses[name].free, order[name]
            (turn, shift), by_camera = cameras[name], np.eye(6)
            unknown, parts = [np.arange(*lens_at[i : i + 2]), pose_at[i] + np.arange(6)], []
            if (k := self.boards[name, moment]) >= 0:
                turn, shift, *by = cv2.composeRT(*boards[k], turn, shift)
                by_camera = np.block([[by[2], by[3]], [by[6], by[7]]])
                parts.append(np.block([[by[0], by[1]], [by[4], by[5]]]))
                unknown.append(pose_at[len(cameras) + k] + np.arange(6))
            pixels, slopes = cv2.projectPoints(self.board, turn, shift, _matrix(lens), lens[4:])
            by_lens, by_pose = slopes[:, 6:15], slopes[:, :6]
            if not free[1]:
                by_lens[:, 0] += by_lens[:, 1]
            misses.append((pixels.reshape(-1, 2) - points.astype(np.float64)).ravel())
            values.append(
                np.hstack([by_lens[:, free], *(by_pose @ p for p in (by_camera, *parts))])
            )
            columns.append(np.tile(np.concatenate(unknown), (len(slopes), 1)))
        ends = np.cumsum([0, *(row.size for block in columns for row in block)])
        flat = [np.concatenate([block.ravel() for block in each]) for each in (values, columns)]
        return np.concatenate(misses), sparse.csr_matrix((*flat, ends), (len(ends) - 1, len(x)))

    @cached_property
    def solution(self) -> optimize.OptimizeResult:
        """Least squares."""

        def misses(x: Array) -> Array:
            return self._compared(x)[0]

        def slopes(x: Array) -> Any:
            return self._compared(x)[1]

        return optimize.least_squares(
            misses,
            self._start(),
            slopes,
            x_scale="jac",
            max_nfev=_ATTEMPTS,
            xtol=_CONVERGED,
            ftol=_CONVERGED,
            gtol=_CONVERGED,
            tr_options={"regularize": False, **_SOLVED},
        )

    @property
    def error(self) -> float:
        """Root mean square distance of corners from where they are seen, pixels."""
        return float(np.sqrt(2.0 * np.mean(self.solution.fun**2)))

    def doubt(self) -> str:
        """State which moment's images fit far worse than the others; "" if none do."""
        misses = self.solution.fun.reshape(len(self.seen), len(self.board), 2)
        squares = (misses**2).sum(axis=2).mean(axis=1)
        moments = np.array([moment for _, moment in self.seen])
        numbers = np.unique(moments)
        errors = np.sqrt([squares[moments == number].mean() for number in numbers])
        worst, usual = int(errors.argmax()), float(np.median(errors))
        if errors[worst] < _DOUBTED * usual:
            return ""
        return (
            f"number {numbers[worst] + 1} (from 1) of the images used has an error of "
            f"{errors[worst]:.2g} pixels, the others {usual:.2g} (median)"
        )

    def cameras(self, x: Array) -> tuple[Camera, ...]:
        """Cameras of the unknowns."""
        lenses, poses, _ = self._split(x)
        return tuple(
            Camera(
                matrix=_matrix(values),
                rotation=transform.Rotation.from_rotvec(poses[name][0]).as_matrix(),
                translation=poses[name][1],
                distortion=values[4:],
                size=self.lenses[name].size,
                name=name,
            )
            for name, values in lenses.items()
        )

    def point_errors(self) -> tuple[float, float]:
        """Root mean square error of points among the shared boards, and their extent, m."""
        x, count = self.solution.x, len(self.solution.fun)
        noise = np.linalg.norm(self.solution.fun) / np.sqrt(max(count - len(x), 1))
        scale = sparse_linalg.norm(self.solution.jac, axis=0)
        jacobian = self.solution.jac @ sparse.diags(1.0 / scale)
        normal = sparse_linalg.splu((jacobian.T @ jacobian).tocsc())
        placed = self._split(x)[2]
        name = next(iter(self.lenses))
        others = [placed[self.boards[name, i]] for i in self.shared[1:]]
        turns = [transform.Rotation.from_rotvec(turn).as_matrix() for turn, _ in others]
        moved = [
            self.board @ turn.T + shift for turn, (_, shift) in zip(turns, others, strict=True)
        ]
        true = np.concatenate([self.board, *moved])
        pixels = np.stack([camera.project(true) for camera in self.cameras(x)])
        centred = true - true.mean(axis=0)
        extent, squares = float(np.sqrt((centred**2).sum(axis=1).mean())), []
        for draw in np.random.default_rng(0).normal(0.0, noise, (_DRAWS, count)):
            step = normal.solve(jacobian.T @ draw) / scale
            points = triangulate(self.cameras(x + step), pixels)[0]
            if not np.isfinite(points).all():  # behind one of the cameras
                return np.inf, extent
            misfit = transform.Rotation.align_vectors(points - points.mean(axis=0), centred)[1]
            squares.append(misfit**2 / len(true))
        return float(np.sqrt(np.mean(squares))), extent
