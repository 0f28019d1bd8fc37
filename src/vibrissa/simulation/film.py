"""Film a trial: what two cameras would have seen of it.

Backlit, the whisker, the object and the face are dark on uneven light. The whisker has its true
tapering width, down to a fraction of a pixel; it is blurred by the lens, by the pixel and by its
movement while the shutter is open; an object between it and the camera hides it. Photons and
electronics add noise.

A film is as long as its trial and frame by frame in step with it. What it truly shows goes beside
it: the centreline in pixels and which part of it is hidden, in the recording's group ``truth``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from vibrissa.cameras.camera import PIXEL_SIZE, Camera, orthogonal_views
from vibrissa.cameras.files import cameras_dataset
from vibrissa.io.video import Frame, write_video
from vibrissa.objects.surface import Surface
from vibrissa.recording import Group, Recording, recorded
from vibrissa.simulation.shadows import hidden, silhouette

Array = NDArray[np.float64]
Image = NDArray[np.float32]

Progress = Callable[[int, int], None]
"""Called with the number of frames done and of all frames."""

_STEP = 2.0
"""Length of a piece of painted whisker, pixels."""

_CHEEK = 0.5e-3
"""How far the face of several whiskers reaches beyond their bases, m."""

_MARGIN = 0.05
"""Room around several whiskers, as a share of how far they reach."""

_FUR = 2.0
"""Softness of the face's edge, standard deviation, pixels."""


@dataclass(frozen=True)
class Look:
    """How a film looks.

    Parameters
    ----------
    light : float
        Brightest grey value of the background.
    unevenness : float
        Share of the light that is missing at the corners and between brighter patches.
    dark : float
        Grey value of face and objects.
    contrast : float
        Share of the light that the whisker keeps away where it covers a pixel.
    blur : float
        Of the lens, standard deviation, pixels.
    exposure : float
        How long the shutter is open, s.
    gain : float
        Electrons per grey value, which sets the shot noise.
    read_noise : float
        Standard deviation, grey values.
    face : tuple of float
        Half the length, width and height of the face, m. The base is on its surface. Zeros: none.
        That of several whiskers is as large as they stand on it.
    """

    light: float = 200.0
    unevenness: float = 0.3
    dark: float = 18.0
    contrast: float = 0.85
    blur: float = 0.7
    exposure: float = 1e-4
    gain: float = 40.0
    read_noise: float = 1.5
    face: tuple[float, float, float] = (12e-3, 5e-3, 7e-3)

    def __post_init__(self) -> None:
        """Check every number."""
        kinds: tuple[tuple[tuple[str, ...], Callable[[float], bool], str], ...] = (
            (("unevenness", "contrast"), lambda x: 0.0 <= x <= 1.0, "a share, 0 to 1, is needed"),
            (("light", "blur", "gain"), lambda x: x > 0.0, "it must be positive"),
            (("dark", "exposure", "read_noise"), lambda x: x >= 0.0, "it must not be negative"),
        )
        faults = [
            f"{name} is {getattr(self, name)!r}; {needed}"
            for names, right, needed in kinds
            for name in names
            if not right(getattr(self, name))
        ]
        if faults:
            raise ValueError("no film: " + "; ".join(faults))

    @property
    def sigma(self) -> float:
        """Blur of lens and pixel together, pixels."""
        return float(np.sqrt(self.blur**2 + 1.0 / 12.0))


def views_of(recording: xr.DataTree, pixel_size: float | None = None) -> tuple[Camera, Camera]:
    """Point the two cameras of the paper at the middle of where a trial's whiskers go.

    Parameters
    ----------
    recording : xarray.DataTree
        Of a simulated trial.
    pixel_size : float, optional
        What a pixel sees, m; by default 58 µm, or for several whiskers what it takes to see all.

    Returns
    -------
    tuple of Camera
        Top and front view.
    """
    lines = _truth(recording)["centerline"].values
    low, high = np.nanmin(lines, axis=(0, 1, 2)), np.nanmax(lines, axis=(0, 1, 2))
    # A whole tenth of a millimetre is easier to write down.
    middle = np.round(0.5 * (low + high), 4)
    if pixel_size is None:
        whole = (1.0 + _MARGIN) * float((high - low).max()) / min(orthogonal_views()[0].size)
        pixel_size = PIXEL_SIZE if lines.shape[1] == 1 else max(PIXEL_SIZE, whole)
    return orthogonal_views(pixel_size, center=middle)


def film(
    recording: xr.DataTree,
    paths: Mapping[str, str | PathLike[str]],
    cameras: Sequence[Camera] | None = None,
    look: Look | None = None,
    *,
    seed: int = 0,
    rate: float = 50.0,
    progress: Progress | None = None,
) -> xr.DataTree:
    """Film a simulated trial.

    Parameters
    ----------
    recording : xarray.DataTree
        Of `vibrissa.simulation.simulate`.
    paths : mapping of str to path
        Name of each view and where its video is written, ``.mkv`` (lossless) or ``.mp4``.
    cameras : sequence of Camera, optional
        The views, whose names are those of the paths; by default `views_of` the trial.
    look : Look, optional
        Light, blur, noise.
    seed : int
        Of the noise.
    rate : float
        Frames per second at which the videos are to be shown.
    progress : callable, optional
        Told after every frame how many are done, of how many.

    Returns
    -------
    xarray.DataTree
        A new recording: with the cameras in the group ``cameras``, and in ``truth`` the variables
        ``trace`` and ``trace_visible``.

    Raises
    ------
    ValueError
        If the recording has no true centrelines, or views and paths differ.
    """
    cameras = views_of(recording) if cameras is None else tuple(cameras)
    names = [camera.name for camera in cameras]
    if sorted(names) != sorted(paths):
        raise ValueError(f"there are cameras {names} and paths for {list(paths)}; they must agree")
    total = len(cameras) * recording.sizes["time"]
    for i, camera in enumerate(cameras):

        def told(frames: Iterator[Frame], before: int) -> Iterator[Frame]:
            for done, frame in enumerate(frames):
                yield frame
                if progress is not None:
                    progress(before + done + 1, total)

        frames = film_frames(recording, camera, look, seed=seed + 7919 * i)
        write_video(paths[camera.name], told(frames, i * recording.sizes["time"]), rate)
    return with_true_traces(recording, cameras)


def film_frames(
    recording: xr.DataTree, camera: Camera, look: Look | None = None, *, seed: int = 0
) -> Iterator[Frame]:
    """Film a simulated trial with one camera."""
    from vibrissa.simulation import painting

    look = look or Look()
    truth = _truth(recording)
    lines = truth["centerline"].values
    objects = Recording(recording).objects
    moves = _moves(lines, truth["time"].values, look.exposure)
    whiskers = [Recording(recording).whisker(i) for i in range(lines.shape[1])]
    generator = np.random.default_rng(seed)
    width, height = camera.size
    scene = _scene(camera, objects, look, np.nanmean(lines, axis=(0, 1, 2)))
    light, box = scene.copy(), np.zeros(4, np.int64)
    total, covered = np.zeros_like(light), np.zeros_like(light)
    noise = generator.standard_normal(1 << 20).astype(np.float32)
    frame = np.empty((height, width), np.uint8)
    for i in range(len(lines)):
        if all(look.face):
            light[box[0] : box[1], box[2] : box[3]] = scene[box[0] : box[1], box[2] : box[3]]
            middle, inverse, box = _face(camera, lines[i, :, 0], look)
            painting.shade(light, middle, inverse, look.dark, _FUR, box)
        total[:] = 0.0
        for whisker, line, move in zip(whiskers, lines[i], moves[i], strict=True):
            radius = whisker.radius(np.linspace(0.0, whisker.length, line.shape[0]))
            smooth, wide = _fine(line, radius, camera)
            shift = _at(move, smooth, line)
            behind = hidden(smooth, camera, objects)
            pixels, slopes = camera.project_with_slopes(smooth)
            per_m = np.linalg.norm(slopes, axis=(-2, -1)) / np.sqrt(2.0)
            drift = (slopes @ shift[..., None])[..., 0]
            count = max(1, int(np.ceil(np.nanmax(np.linalg.norm(drift, axis=1), initial=0.0))))
            for k in range(count):
                at = pixels + ((k + 0.5) / count - 0.5) * drift
                painting.cover(
                    covered, at, wide * per_m, 1.0 - behind, look.sigma, look.contrast / count
                )
                reach = float((wide * per_m).max()) + 4.0 * look.sigma
                painting.collect(covered, total, at, reach)
        starts = generator.integers(0, noise.size - width, height)
        painting.expose(light, total, noise, starts, look.gain, look.read_noise, frame)
        yield frame.copy()


def with_true_traces(recording: xr.DataTree, cameras: Sequence[Camera]) -> xr.DataTree:
    """Say what cameras truly see of a simulated trial."""
    truth = _truth(recording)
    line = Group(truth)["centerline"]
    objects = Recording(recording).objects
    trace = np.stack([camera.project(line) for camera in cameras], axis=2)
    inside = np.stack(
        [
            (trace[:, :, i] > -0.5).all(-1) & (trace[:, :, i] < np.array(camera.size) - 0.5).all(-1)
            for i, camera in enumerate(cameras)
        ],
        axis=2,
    )
    behind = np.stack([hidden(line, camera, objects) for camera in cameras], axis=2)
    seen = {
        "trace": recorded("trace", trace),
        "trace_visible": recorded("trace_visible", inside & (behind < 0.5)),
    }
    filmed = recording.copy()
    filmed["truth"].dataset = truth.drop_vars("time").assign(seen)
    filmed["cameras"] = xr.DataTree(cameras_dataset(cameras))
    return filmed


def _truth(recording: xr.DataTree) -> xr.Dataset:
    truth = recording.children.get("truth")
    if truth is None or "centerline" not in truth.data_vars:
        raise ValueError("the recording has no true centrelines to film")
    return truth.to_dataset().assign_coords(time=recording["time"])


def _moves(lines: Array, time: Array, exposure: float) -> Array:
    """How far each node moves while the shutter is open, (time, whisker, node, 3), m.

    Of the way to the frame before and after the shorter one counts, so that a whisker that springs
    free is not smeared over the way that it jumped.
    """
    if len(lines) < 2:
        return np.zeros_like(lines)
    step = np.diff(lines, axis=0) / np.diff(time)[:, None, None, None]
    before, after = np.concatenate([step[:1], step]), np.concatenate([step, step[-1:]])
    sizes = [np.linalg.norm(v, axis=-1, keepdims=True) for v in (before, after)]
    return np.where(sizes[0] < sizes[1], before, after) * exposure


def _fine(line: Array, radius: Array, camera: Camera) -> tuple[Array, Array]:
    """Points (n, 3) about two pixels apart and radii (n,), m."""
    pixels = camera.project(line)
    length = float(np.linalg.norm(np.diff(pixels, axis=0), axis=1).sum())
    s = np.linspace(0.0, 1.0, len(line))
    fine = np.linspace(0.0, 1.0, max(int(length / _STEP), 2 * len(line)))
    return CubicSpline(s, line)(fine), np.interp(fine, s, radius)


def _at(move: Array, fine: Array, line: Array) -> Array:
    s = np.linspace(0.0, 1.0, len(line))
    t = np.linspace(0.0, 1.0, len(fine))
    return np.stack([np.interp(t, s, move[:, k]) for k in range(3)], axis=-1)


def _scene(camera: Camera, objects: Sequence[Surface], look: Look, center: Array) -> Image:
    """Light and objects, (height, width)."""
    width, height = camera.size
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, width), np.linspace(-1.0, 1.0, height))
    patches = np.sin(3.1 * x + 1.0) * np.cos(2.3 * y - 0.5) + np.cos(5.3 * x - 3.7 * y)
    missing = 0.3 * (x**2 + y**2) + 0.1 * (2.0 - patches)
    light = look.light * (1.0 - look.unevenness * np.clip(missing, 0.0, 1.0))
    covered = silhouette(camera, objects, center, look.sigma)
    light = light * (1.0 - covered) + look.dark * covered
    return np.asarray(light, dtype=np.float32)


def _face(camera: Camera, bases: Array, look: Look) -> tuple[Array, Array, NDArray[np.int64]]:
    """Middle (2,) and matrix (2, 2) of the ellipse that the face shows, and the box around it."""
    if len(bases) == 1:
        center, size = bases[0] - [look.face[0], 0.0, 0.0], np.array(look.face)
    else:
        center = bases.mean(axis=0)
        size = np.abs(bases - center).max(axis=0) + _CHEEK
    middle, slopes = camera.project_with_slopes(center)
    half = slopes * size
    square = half @ half.T
    reach = np.sqrt(np.diag(square)) + 4.0 * _FUR
    ends = np.stack([middle - reach, middle + reach + 1.0])[:, ::-1].T.reshape(-1)
    height, width = camera.size[1], camera.size[0]
    box = np.clip(ends, 0, [height, height, width, width]).astype(np.int64)
    return middle, np.linalg.inv(square), box
