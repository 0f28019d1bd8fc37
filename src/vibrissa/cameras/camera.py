"""Camera models and triangulation.

A camera maps points of the laboratory frame to the pixels of a view:

    x_camera = R x_laboratory + t,    pixel = K d(x_camera)

with d(x) = (x, y) for an orthographic camera (far away, or telecentric), and for a perspective one
the division by z followed by OpenCV's distortion. A pixel is (column, row); integers are centres of
pixels, (0, 0) the top left one. A mirror image has a negative focal length in K.

Points are triangulated from the pixels of several views, with their covariance. With a single view
the distance is unknown: points are then assumed to be in the laboratory's plane z = 0, which the
paper's top view sees from above.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import transform, xr
from vibrissa.io import in_file, read_calibration, write_calibration
from vibrissa.numerics import Array, numbers, vectors
from vibrissa.quantities import attributes

PIXEL_SIZE = 58e-6
"""Size of a pixel of the paper's cameras in object space, m."""

SIZE = (1024, 1024)
"""Width and height of the paper's frames, pixels."""

_MOST_COEFFICIENTS = 8  # largest number of OpenCV's distortion coefficients that is supported
_ROUNDS = 20  # largest number of Newton steps in the removal of distortion
_SINGULAR = 1e-9  # determinant of the unit image axes below which they are parallel


@dataclass(frozen=True, eq=False)
class Camera:
    """One calibrated view.

    Parameters
    ----------
    matrix : array (3, 3)
        Camera matrix K with focal lengths and principal point; pixels per m if orthographic.
    rotation : array (3, 3)
        Rotation R from the laboratory to the camera axes (right, down, forward).
    translation : array (3,)
        Translation t, m.
    distortion : array (n,), optional
        Distortion coefficients of OpenCV (k1, k2, p1, p2, k3, k4, k5, k6), or the first 4 or 5;
        perspective only.
    size : tuple of int
        Image width and height, pixels.
    projection : {"perspective", "orthographic"}
        Type of projection.
    name : str
        Name of the view.

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite, a focal length is zero, the last row of K is
        not (0, 0, 1), or R is not a rotation.
    """

    matrix: Array
    rotation: Array
    translation: Array
    distortion: Array = field(default_factory=lambda: np.zeros(_MOST_COEFFICIENTS))
    size: tuple[int, int] = SIZE
    projection: Literal["perspective", "orthographic"] = "perspective"
    name: str = "camera"

    def __post_init__(self) -> None:
        faults = []
        for name, shape in (("matrix", (3, 3)), ("rotation", (3, 3)), ("translation", (3,))):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != shape or not np.isfinite(values).all():
                faults.append(f"{name} has shape {values.shape}; finite {shape} is needed")
            object.__setattr__(self, name, values)
        bent = np.array(self.distortion, dtype=np.float64).reshape(-1)
        if bent.size > _MOST_COEFFICIENTS or not np.isfinite(bent).all():
            faults.append(f"distortion has {bent.size} coefficients; up to 8 finite ones are known")
        bent = np.pad(bent, (0, max(0, _MOST_COEFFICIENTS - bent.size)))
        object.__setattr__(self, "distortion", bent)
        if np.shape(self.size) != (2,) or min(self.size) < 1:
            faults.append(f"size is {self.size!r}; columns and rows of its images are needed")
        else:
            object.__setattr__(self, "size", (int(self.size[0]), int(self.size[1])))
        if self.projection not in ("perspective", "orthographic"):
            faults.append(
                f"projection is {self.projection!r}; perspective or orthographic is needed"
            )
        if self.projection == "orthographic" and bent.any():
            faults.append("an orthographic camera has no distortion")
        if not faults:
            faults += _faults_of_matrix(self.matrix)
            turn = self.rotation
            if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-5 or np.linalg.det(turn) < 0.0:
                faults.append("rotation is not a rotation; a mirror is a negative focal length")
        if faults:
            raise ValueError(f"no camera {self.name!r}: " + "; ".join(faults))

    def project(self, points: ArrayLike) -> Array:
        """Project points into the image.

        Parameters
        ----------
        points : array_like (..., 3)
            Points in the laboratory frame, m.

        Returns
        -------
        array (..., 2)
            Column and row, pixels, inside the image or not; NaN behind a perspective camera.
        """
        points = vectors("points", points)
        seen = self._seen(points)
        if self.projection == "orthographic":
            return self._in_image(seen[:2], points)
        flat = seen[:2] / np.where(seen[2] > 0.0, seen[2], np.nan)
        # Most of the time would be spent on derivatives.
        bent = _distort(flat, self.distortion)[0] if self.distortion.any() else flat
        return self._in_image(bent, points)

    def project_with_slopes(self, points: ArrayLike) -> tuple[Array, Array]:
        """Project points into the image, with derivatives.

        Parameters
        ----------
        points : array_like (..., 3)
            Points in the laboratory frame, m.

        Returns
        -------
        pixels : array (..., 2)
            Column and row.
        slopes : array (..., 2, 3)
            Derivatives of the pixels by the points, pixels per m.
        """
        points = vectors("points", points)
        seen = self._seen(points)
        focal, slopes = self.matrix[:2, :2], np.empty((*points.shape[:-1], 2, 3))
        if self.projection == "orthographic":
            slopes[:] = focal @ self.rotation[:2]
            bent = seen[:2]
        else:
            nearness = 1.0 / np.where(seen[2] > 0.0, seen[2], np.nan)
            flat = seen[:2] * nearness
            bent, jacobian = _distort(flat, self.distortion)
            for row, by_bent in zip(np.moveaxis(slopes, -2, 0), focal, strict=True):
                by_seen = np.empty_like(seen)
                np.einsum("i,ijn->jn", by_bent, jacobian * nearness, out=by_seen[:2])
                by_seen[2] = -(by_seen[:2] * flat).sum(axis=0)
                row[...] = (by_seen.T @ self.rotation).reshape(points.shape)
        return self._in_image(bent, points), slopes

    def _seen(self, points: Array) -> Array:
        """Points in the camera's frame, by coordinates: long arrays of which each takes little."""
        return np.asarray(self.rotation @ points.reshape(-1, 3).T + self.translation[:, None])

    def _in_image(self, bent: Array, points: Array) -> Array:
        """Column and row (..., 2) of points (..., 3) in directions (2, n)."""
        pixels = self.matrix[:2, :2] @ bent + self.matrix[:2, 2:]
        return np.ascontiguousarray(pixels.T).reshape(*points.shape[:-1], 2)

    def rays(self, pixels: ArrayLike) -> tuple[Array, Array]:
        """Compute the lines of sight of pixels.

        Parameters
        ----------
        pixels : array_like (..., 2)
            Column and row.

        Returns
        -------
        origin, direction : array (..., 3)
            Point on each line, m, and its unit direction away from the camera, laboratory frame.
        """
        pixels = numbers("pixels", pixels)
        flat = (pixels - self.matrix[:2, 2]) @ np.linalg.inv(self.matrix[:2, :2]).T
        if self.projection == "orthographic":
            start = np.concatenate([flat, np.zeros_like(flat[..., :1])], axis=-1)
            origin = (start - self.translation) @ self.rotation
            return origin, np.broadcast_to(self.rotation[2], origin.shape).copy()
        flat = np.moveaxis(_undistort(np.moveaxis(flat, -1, 0), self.distortion), 0, -1)
        ahead = np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1) @ self.rotation
        center = np.broadcast_to(-self.translation @ self.rotation, ahead.shape).copy()
        return center, ahead / np.linalg.norm(ahead, axis=-1, keepdims=True)


def _faults_of_matrix(matrix: Array) -> list[str]:
    """Faults of a camera matrix with which pixels would have no line of sight."""
    if not np.array_equal(matrix[2], (0.0, 0.0, 1.0)):
        row = ", ".join(f"{value:g}" for value in matrix[2])
        return [f"the last row of matrix is ({row}), not (0, 0, 1): is it transposed?"]
    focal = matrix[:2, :2]
    size = np.linalg.norm(focal, axis=1)
    if not size.all() or abs(np.linalg.det(focal / size[:, None])) < _SINGULAR:
        return [f"focal lengths are {focal[0, 0]:g} and {focal[1, 1]:g}; neither may be zero"]
    return []


def orthogonal_views(
    pixel_size: float = PIXEL_SIZE,
    size: tuple[int, int] = SIZE,
    center: ArrayLike = (0.0, 0.0, 0.0),
) -> tuple[Camera, Camera]:
    """Create the paper's two views, from the top and from the front, with equal scale.

    Parameters
    ----------
    pixel_size : float
        Size of a pixel in object space, m.
    size : tuple of int
        Image width and height, pixels.
    center : array_like (3,)
        Point at the centre of both images, laboratory frame, m.

    Returns
    -------
    top : Camera
        View with x to the right and y upward.
    front : Camera
        View with x to the right and z upward: the view from +y, mirrored so that both images have
        the same x in the same column.
    """
    if not (np.isfinite(pixel_size) and pixel_size > 0.0):
        raise ValueError(f"pixel_size is {pixel_size!r}; it must be positive, in m")
    middle = (np.asarray(size) - 1.0) / 2.0
    top = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    front = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
    views = []
    for name, rotation, sign in (("top", top, 1.0), ("front", front, -1.0)):
        matrix = np.diag([sign / pixel_size, 1.0 / pixel_size, 1.0])
        matrix[:2, 2] = middle
        shift = -rotation @ np.asarray(center, dtype=np.float64)
        views.append(
            Camera(matrix, rotation, shift, size=size, projection="orthographic", name=name)
        )
    return views[0], views[1]


def _distort(flat: Array, k: Array) -> tuple[Array, Array]:
    """Apply OpenCV's distortion to points (2, ...); also return derivatives (2, 2, ...)."""
    x, y = flat
    slopes = np.zeros((2, *flat.shape))
    if not k.any():
        slopes[0, 0] = slopes[1, 1] = 1.0
        return flat, slopes
    r2 = x * x + y * y
    below = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    radial = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / below
    change = k[0] + r2 * (2.0 * k[1] + 3.0 * r2 * k[4])
    change = (change - radial * (k[5] + r2 * (2.0 * k[6] + 3.0 * r2 * k[7]))) / below
    bent = np.stack(
        [
            x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x),
            y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y,
        ]
    )
    slopes[0, 0] = radial + 2.0 * x * x * change + 2.0 * k[2] * y + 6.0 * k[3] * x
    slopes[1, 1] = radial + 2.0 * y * y * change + 6.0 * k[2] * y + 2.0 * k[3] * x
    slopes[0, 1] = slopes[1, 0] = 2.0 * x * y * change + 2.0 * k[2] * x + 2.0 * k[3] * y
    return bent, slopes


def _undistort(bent: Array, k: Array) -> Array:
    """Invert `_distort` by Newton's method."""
    flat = bent.copy()
    if not k.any():
        return flat
    for _ in range(_ROUNDS):
        found, ((a, b), (c, d)) = _distort(flat, k)
        miss = bent - found
        step = np.stack([d * miss[0] - b * miss[1], a * miss[1] - c * miss[0]]) / (a * d - b * c)
        flat = flat + step
        if not np.nanmax(np.abs(step), initial=0.0) > 1e-14:
            break
    return flat


# Smallest sine of the angle between a single camera's viewing direction and the plane z = 0.
_STEEP = 0.2


def triangulate(
    cameras: Sequence[Camera], pixels: ArrayLike, sigma: ArrayLike = 1.0
) -> tuple[Array, Array]:
    """Triangulate points from the pixels of one or more cameras.

    Parameters
    ----------
    cameras : sequence of Camera
        Cameras of the views; with a single one, points are assumed to be in the plane z = 0.
    pixels : array_like (camera, ..., 2)
        Column and row of each point in each camera; NaN gives NaN.
    sigma : array_like
        Standard deviation of pixel coordinates, broadcast to (camera, ...).

    Returns
    -------
    points : array (..., 3)
        Points with least squared pixel errors, weighted by sigma, m.
    covariance : array (..., 3, 3)
        Covariance of the points, m².

    Raises
    ------
    ValueError
        If shapes do not match, or a single camera looks along the plane z = 0.
    """
    pixels = numbers("pixels", pixels)
    if not cameras or pixels.ndim < 2 or pixels.shape[:: pixels.ndim - 1] != (len(cameras), 2):
        raise ValueError(
            f"{len(cameras)} cameras and pixels of shape {pixels.shape} do not fit; "
            "(camera, ..., 2) is needed"
        )
    if not (np.nan_to_num(sigma, nan=1.0) > 0.0).all():
        raise ValueError(f"sigma is a positive standard deviation, pixels; got {sigma!r}")
    if len(cameras) == 1:
        return _in_plane(cameras[0], pixels[0], np.broadcast_to(sigma, pixels.shape[:-1])[0])
    weight = 1.0 / np.broadcast_to(np.asarray(sigma, np.float64), pixels.shape[:-1])
    points = _nearest_to_rays(cameras, pixels)
    hessian = np.zeros((*points.shape, 3))
    for _ in range(8):
        hessian = np.zeros((*points.shape, 3))
        gradient = np.zeros(points.shape)
        for camera, wanted, w in zip(cameras, pixels, weight, strict=True):
            seen, slopes = camera.project_with_slopes(points)
            scaled = slopes * w[..., None, None]
            miss = (wanted - seen) * w[..., None]
            hessian += np.swapaxes(scaled, -1, -2) @ scaled
            gradient += (np.swapaxes(scaled, -1, -2) @ miss[..., None])[..., 0]
        step = np.linalg.solve(_regularise(hessian), gradient[..., None])[..., 0]
        points = points + step
        # The next step would be smaller by orders of magnitude.
        if not np.nanmax(np.abs(step), initial=0.0) > 1e-9:
            break
    return points, np.asarray(np.linalg.inv(_regularise(hessian)), dtype=np.float64)


def _in_plane(camera: Camera, pixels: Array, sigma: ArrayLike) -> tuple[Array, Array]:
    """Points (..., 3) in the plane z = 0, and their covariance, which is zero normal to it."""
    if abs(camera.rotation[2, 2]) < _STEEP:
        raise ValueError(
            f"camera {camera.name!r} looks along the plane z = 0 of the laboratory, in which a "
            "whisker seen by one camera is assumed to be; the camera must look onto this plane"
        )
    origin, direction = camera.rays(pixels)
    points = origin - direction * (origin[..., 2:] / direction[..., 2:])
    points[..., 2] = 0.0
    slopes = np.linalg.inv(camera.project_with_slopes(points)[1][..., :2])
    covariance = np.zeros((*points.shape, 3))
    inside = slopes @ np.swapaxes(slopes, -1, -2)
    covariance[..., :2, :2] = inside * np.square(sigma)[..., None, None]
    return points, covariance


def _regularise(hessian: Array) -> Array:
    """Regularise Hessians, so that parallel rays have a finite, huge uncertainty; NaN is kept."""
    scale = np.trace(hessian, axis1=-2, axis2=-1)[..., None, None]
    return np.asarray(hessian + 1e-12 * scale * np.eye(3))


def _nearest_to_rays(cameras: Sequence[Camera], pixels: Array) -> Array:
    """Points (..., 3) with least squared distance from all rays."""
    matrix: Array = np.zeros((*pixels.shape[1:-1], 3, 3))
    right: Array = np.zeros((*pixels.shape[1:-1], 3))
    for camera, seen in zip(cameras, pixels, strict=True):
        origin, direction = camera.rays(seen)
        across: Array = np.eye(3) - direction[..., :, None] * direction[..., None, :]
        matrix += across
        right += (across @ origin[..., None])[..., 0]
    solved = np.linalg.solve(_regularise(matrix), right[..., None])[..., 0]
    return np.asarray(solved, dtype=np.float64)


# Variables of a dataset of cameras: attribute of a camera, and dimensions.
_VARIABLES: dict[str, tuple[str, tuple[str, ...]]] = {
    "camera_matrix": ("matrix", ("row", "column")),
    "camera_rotation": ("rotation", ("row", "column")),
    "camera_translation": ("translation", ("row",)),
    "camera_distortion": ("distortion", ("coefficient",)),
    "image_size": ("size", ("side",)),
    "projection": ("projection", ()),
}


def load_cameras(path: str | PathLike[str], unit: float = 1e-3) -> tuple[Camera, ...]:
    """Read calibrated cameras.

    Parameters
    ----------
    path : str or path
        File in Anipose's TOML format (`vibrissa.io.anipose`).
    unit : float
        Unit of the file's lengths, m; that of the calibration board, usually mm.

    Returns
    -------
    tuple of Camera
        Cameras in the file's order.
    """
    cameras = []
    for table in read_calibration(path):
        kind = table.get("projection", "perspective")
        scale = np.diag([1.0 / unit, 1.0 / unit, 1.0]) if kind == "orthographic" else np.eye(3)
        with in_file(path):
            camera = Camera(
                matrix=np.asarray(table["matrix"]) @ scale,
                rotation=transform.Rotation.from_rotvec(table["rotation"]).as_matrix(),
                translation=np.asarray(table["translation"]) * unit,
                distortion=np.asarray(table["distortions"]),
                size=(table["size"][0], table["size"][1]),
                projection=kind,
                name=str(table["name"]),
            )
        cameras.append(camera)
    return tuple(cameras)


def save_cameras(path: str | PathLike[str], cameras: Sequence[Camera], unit: float = 1e-3) -> None:
    """Write cameras to a file for `load_cameras` and, if perspective, for Anipose.

    Parameters
    ----------
    path : str or path
        File to write, usually with the suffix ``.toml``.
    cameras : sequence of Camera
        Cameras of the views.
    unit : float
        Unit of the file's lengths, m.
    """
    tables = []
    for camera in cameras:
        flat = camera.projection == "orthographic"
        scale = np.diag([unit, unit, 1.0]) if flat else np.eye(3)
        table = {
            "name": camera.name,
            "size": camera.size,
            "matrix": (camera.matrix @ scale).tolist(),
            "distortions": camera.distortion.tolist(),
            "rotation": transform.Rotation.from_matrix(camera.rotation).as_rotvec().tolist(),
            "translation": (camera.translation / unit).tolist(),
        }
        tables.append(table | ({"projection": camera.projection} if flat else {}))
    write_calibration(path, tables)


def cameras_dataset(cameras: Sequence[Camera]) -> xr.Dataset:
    """Convert cameras to a dataset, the group ``cameras`` of a recording."""
    return xr.Dataset(
        {
            name: (
                ("view", *axes),
                np.array([getattr(camera, part) for camera in cameras]),
                attributes(name),
            )
            for name, (part, axes) in _VARIABLES.items()
        },
        {"view": [camera.name for camera in cameras]},
        {"reference_frame": "laboratory"},
    )


def cameras_from_dataset(dataset: xr.Dataset) -> tuple[Camera, ...]:
    """Restore cameras from the dataset of `cameras_dataset`."""
    views = [dataset.isel(view=i) for i in range(dataset.sizes["view"])]
    known: list[dict[str, Any]] = [
        {part: row[name].values for name, (part, _) in _VARIABLES.items()}
        | {"projection": str(row["projection"].values), "name": str(row["view"].values)}
        for row in views
    ]
    return tuple(Camera(**values) for values in known)
