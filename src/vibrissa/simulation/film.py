"""Synthetic videos of a simulated trial, as two cameras would record it.

Whisker, object and face are backlit: dark on an uneven bright background. The whisker has its true
tapering width, down to a fraction of a pixel; it is blurred by the lens, by the pixels and by its
motion during the exposure; objects between it and the camera hide it. Shot noise and read noise are
added.

A video has as many frames as the trial. The true traces, the centreline in pixels and a mask of its
visible part, are added to the recording's group ``truth``.

Occlusion works for any object with a signed distance (sphere tracing): from a point of a line of
sight the surface is at least the signed distance away, so that few steps lead past an object or
into it. The smallest distance along the line gives the share of a pixel that the object covers.

The image of a thin dark strip of half width w, blurred by a Gaussian of standard deviation σ, is

    c(d) = ½ [erf((w + d) / √2 σ) + erf((w − d) / √2 σ)]

at the distance d from its middle, for any w: a strip far thinner than a pixel is a faint line of
correct integrated darkness. σ includes both the blur of the lens and the size of a pixel.

Around the whiskers there may be fur with hairs, the animal's cheek, and wires. The texture and
hairs of the fur and the cheek move with the face; textures move by whole pixels. None of these is
part of the recorded truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.cameras import PIXEL_SIZE, Camera, cameras_dataset, orthogonal_views
from vibrissa.deferred import interpolate, ndimage, special
from vibrissa.io import Frame, write_video
from vibrissa.numerics import Array, kernel
from vibrissa.objects import Surface
from vibrissa.recording import Group, Recording, recorded

Image = NDArray[np.float32]

# Standard deviations of the fur's texture across and along its hairs, and of its tufts, pixels.
_GRAIN, _ALONG, _TUFTS = 0.8, 3.0, 6.0
_APART = 4.0  # spacing of hairs along the outline of the face, pixels
_HAIR = (4.0, 4.0)  # shape and scale, pixels, of the distribution of the lengths of hairs
_THICKNESS = (0.3, 0.7)  # smallest and largest half width of a hair, pixels
_WIRE = (0.6, 1.6)  # smallest and largest half width of a wire, pixels
# Smallest and largest length of the cheek, relative to the longest whisker in the image.
_BEHIND = (0.35, 0.5)
_CHEEK_GREY = 48.0  # grey value of the cheek


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Fur, cheek and wires in the images of one camera."""

    texture: Image
    hairs: list[Array]  # (4,): angle on the outline of the face, direction, length, half width
    wires: list[Array]  # (n, 3): column, row and half width
    cheek: float  # length, pixels; 0 if the camera does not see it
    contrast: float

    @classmethod
    def of(
        cls, camera: Camera, lines: Array, conditions: ImageConditions, seed: int
    ) -> Surroundings:
        """Generate surroundings at random, sized as the longest whisker in the first frame."""
        fur, cheek, ends = conditions.fur, conditions.cheek, camera.project(lines[0, :, [0, -1]])
        extent = float(np.nanmax(np.linalg.norm(ends[1] - ends[0], axis=-1)))
        random = np.random.default_rng([seed, 11])
        width, height = camera.size
        texture = np.zeros((height, width), dtype=np.float32)
        hairs: list[Array] = []
        if fur > 0.0 or cheek > 0.0:
            fine = ndimage.gaussian_filter(random.normal(size=texture.shape), (_GRAIN, _ALONG))
            tufts = ndimage.gaussian_filter(random.normal(size=texture.shape), _TUFTS)
            texture += (fine / fine.std() + 0.5 * tufts / tufts.std()).astype(np.float32)
            texture *= max(fur, 0.1 * _CHEEK_GREY if cheek > 0.0 else 0.0)
        if fur > 0.0:
            count = int(2.0 * extent / _APART)
            hairs = [
                np.array(
                    [
                        random.uniform(-np.pi, np.pi),
                        random.normal(0.0, 0.5),
                        random.gamma(*_HAIR),
                        random.uniform(*_THICKNESS),
                    ]
                )
                for _ in range(count)
            ]
        sees = abs(float(camera.rays([0.5 * width, 0.5 * height])[1][1])) > 0.7
        far = random.uniform(*_BEHIND) * extent if cheek > 0.0 and sees else 0.0
        wires = [_wire(width, height, random) for _ in range(int(conditions.wires))]
        return cls(texture, hairs, wires, far, cheek)

    def furred(self, light: Image, middle: Array, share: Image) -> None:
        """Add the fur's texture to an image, scaled by the face's share of each pixel."""
        row, column = (round(float(x)) for x in middle[::-1])
        light += share * np.roll(self.texture, (row, column), (0, 1))

    def before_cheek(self, light: Image, base: Array, toward: float) -> Image | None:
        """Draw the cheek behind a base; return the factor of a whisker's contrast, or None."""
        if not self.cheek:
            return None
        column = np.arange(light.shape[1])
        edge = base[0] + toward * self.cheek
        share = 1.0 / (1.0 + np.exp(np.clip(0.8 * toward * (column - edge), -30.0, 30.0)))
        row, shift = (round(float(x)) for x in base[::-1])
        grey = _CHEEK_GREY + np.roll(self.texture, (row, shift), (0, 1))
        np.maximum(grey, 2.0, out=grey)
        behind = share[None].astype(np.float32)
        light += (grey - light) * behind
        return np.asarray(1.0 - behind * (1.0 - min(self.contrast / _CHEEK_GREY, 1.0)), np.float32)

    def hair_lines(self, middle: Array, inverse: Array) -> list[tuple[Array, Array]]:
        """Lines (n, 2) and half widths (n,) of the hairs of an elliptical face."""
        values, axes = np.linalg.eigh(inverse)
        t = np.linspace(0.0, 1.0, 9)[:, None]
        found = []
        for at, turn, length, half in self.hairs:
            spoke = np.array([np.cos(at), np.sin(at)])
            root = axes @ (spoke / np.sqrt(values))
            normal = axes @ (spoke * np.sqrt(values))
            c, s = np.cos(turn), np.sin(turn)
            way = np.array([[c, -s], [s, c]]) @ (normal / np.linalg.norm(normal))
            side = np.array([-way[1], way[0]])
            line = middle + root + (t * length - 3.0) * way + 0.2 * turn * length * t**2 * side
            found.append((line, half * (1.0 - 0.8 * t[:, 0])))
        return found


def _wire(width: int, height: int, random: Any) -> Array:
    """Random thin curve (n, 3) between two borders of the image: column, row, half width."""
    ends = np.array(
        [
            [random.uniform(0.3, 0.95) * width, -5.0],
            [random.uniform(0.3, 1.0) * width, height + 5.0],
        ]
    )
    if random.random() < 0.5:
        ends = np.array([[0.3 * width, -5.0], [width + 5.0, random.uniform(0.3, 0.95) * height]])
    t = np.linspace(0.0, 1.0, 80)[:, None]
    line = ends[0] + t * (ends[1] - ends[0]) + np.sin(np.pi * t) * random.uniform(-40.0, 40.0, 2)
    return np.column_stack([line, np.full(80, random.uniform(*_WIRE))])


Progress = Callable[[int, int], None]
"""Function called with the number of frames done and the total number."""

_STEP = 2.0  # length of a rendered piece of whisker, pixels
_CHEEK = 0.5e-3  # margin of the face of several whiskers beyond their bases, m
_MARGIN = 0.05  # margin of the image of several whiskers, as a share of their extent
_REACH = 0.15  # distance in front of and behind the scene at which objects are considered, m
_STEPS = 200  # largest number of steps along a line of sight
_COARSE = 8  # spacing of the coarse grid used to find an object's outline, pixels
_SOFT = 3.0  # half width of the outline computed pixel by pixel, standard deviations of the blur
_TAIL = 3.5  # distance beyond which a strip's image is zero, standard deviations of the blur
_NEXT_SEED = 7919  # difference between the seeds of two cameras
_FUR = 2.0  # softness of the face's edge, standard deviation, pixels


@dataclass(frozen=True)
class ImageConditions:
    """Light, optics and noise of a synthetic video.

    Parameters
    ----------
    light : float
        Brightest grey value of the background.
    unevenness : float
        Relative loss of light in the corners and between brighter patches.
    dark : float
        Grey value of face and objects.
    contrast : float
        Share of the light that a whisker blocks in a pixel it covers.
    blur : float
        Standard deviation of the blur of the lens, pixels.
    exposure : float
        Exposure time, s.
    gain : float
        Electrons per grey value, which set the shot noise.
    read_noise : float
        Standard deviation of the read noise, grey values.
    face : tuple of float
        Half the length, width and height of the face, m; zeros for no face. The base is on its
        surface. With several whiskers the face just encloses their bases; with fur it has at least
        the stated size.
    fur : float
        Standard deviation of the texture of the face, grey values. If positive, hairs also protrude
        from the edge of the face and cover the bases.
    cheek : float
        Contrast of a whisker in front of the animal's grey cheek, grey values: 0 for no cheek,
        10–20 in the paper's videos. The cheek is behind half of the whisker in views along y.
    wires : int
        Number of thin, stationary dark lines in the background.
    side_light : float
        Brightness of the whisker's side-lit edge relative to the darkness of its middle, 0 to 1.
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
    fur: float = 0.0
    cheek: float = 0.0
    wires: int = 0
    side_light: float = 0.0

    def __post_init__(self) -> None:
        kinds: tuple[tuple[tuple[str, ...], Callable[[float], bool], str], ...] = (
            (
                ("unevenness", "contrast", "side_light"),
                lambda x: 0.0 <= x <= 1.0,
                "a share, 0 to 1, is needed",
            ),
            (("light", "blur", "gain"), lambda x: x > 0.0, "it must be positive"),
            (
                ("dark", "exposure", "read_noise", "fur", "cheek", "wires"),
                lambda x: x >= 0.0,
                "it must not be negative",
            ),
        )
        faults = [
            f"{name} is {getattr(self, name)!r}; {needed}"
            for names, right, needed in kinds
            for name in names
            if not right(getattr(self, name))
        ]
        if faults:
            raise ValueError("the image conditions are not valid: " + "; ".join(faults))

    @property
    def sigma(self) -> float:
        """Standard deviation of the blur of lens and pixel together, pixels."""
        return float(np.sqrt(self.blur**2 + 1.0 / 12.0))


def views_of(recording: xr.DataTree, pixel_size: float | None = None) -> tuple[Camera, Camera]:
    """Cameras of the paper, centred on the region that a trial's whiskers sweep."""
    lines = _truth(recording)["centerline"].values
    low, high = np.nanmin(lines, axis=(0, 1, 2)), np.nanmax(lines, axis=(0, 1, 2))
    # Rounded to a tenth of a millimetre for readability.
    middle = np.round(0.5 * (low + high), 4)
    if pixel_size is None:
        whole = (1.0 + _MARGIN) * float((high - low).max()) / min(orthogonal_views()[0].size)
        pixel_size = PIXEL_SIZE if lines.shape[1] == 1 else max(PIXEL_SIZE, whole)
    return orthogonal_views(pixel_size, center=middle)


def film(
    recording: xr.DataTree,
    paths: Mapping[str, str | PathLike[str]],
    cameras: Sequence[Camera] | None = None,
    conditions: ImageConditions | None = None,
    *,
    seed: int = 0,
    rate: float = 50.0,
    progress: Progress | None = None,
) -> xr.DataTree:
    """Render the videos of a simulated trial.

    Parameters
    ----------
    recording : xarray.DataTree
        Recording of `vibrissa.simulation.simulate`.
    paths : mapping of str to path
        Path of the video, ``.mkv`` (lossless) or ``.mp4``, by the name of its view.
    cameras : sequence of Camera, optional
        Cameras, with the names of the views; by default the result of `views_of`.
    conditions : ImageConditions, optional
        Light, blur and noise of the images.
    seed : int
        Seed of the noise.
    rate : float
        Frame rate at which the videos are played, Hz.
    progress : callable, optional
        Function called after every frame with the number of frames done and the total number.

    Returns
    -------
    xarray.DataTree
        New recording with the cameras in the group ``cameras``, and in ``truth`` the variables
        ``trace`` and ``trace_visible``.

    Raises
    ------
    ValueError
        If the recording has no true centrelines, or the names of cameras and paths differ.
    """
    cameras = views_of(recording) if cameras is None else tuple(cameras)
    names = [camera.name for camera in cameras]
    if sorted(names) != sorted(paths):
        raise ValueError(f"there are cameras {names} and paths for {list(paths)}; they must agree")
    total = len(cameras) * recording.sizes["time"]
    for i, camera in enumerate(cameras):

        def counted(frames: Iterator[Frame], before: int) -> Iterator[Frame]:
            for done, frame in enumerate(frames):
                yield frame
                if progress is not None:
                    progress(before + done + 1, total)

        frames = film_frames(recording, camera, conditions, seed=seed + _NEXT_SEED * i)
        write_video(paths[camera.name], counted(frames, i * recording.sizes["time"]), rate)
    return with_true_traces(recording, cameras)


def film_frames(
    recording: xr.DataTree,
    camera: Camera,
    conditions: ImageConditions | None = None,
    *,
    seed: int = 0,
) -> Iterator[Frame]:
    """Yield the frames of a simulated trial in one camera view."""
    conditions = conditions or ImageConditions()
    truth = _truth(recording)
    lines = truth["centerline"].values
    objects = Recording(recording).objects
    moves = _moves(lines, truth["time"].values, conditions.exposure)
    whiskers = [Recording(recording).whisker(i) for i in range(lines.shape[1])]
    generator = np.random.default_rng(seed)
    width, height = camera.size
    scene = _scene(camera, objects, conditions, np.nanmean(lines, axis=(0, 1, 2)))
    total, covered = np.zeros_like(scene), np.zeros_like(scene)
    around = Surroundings.of(camera, lines, conditions, seed)
    for wire in around.wires:
        cover(covered, wire[:, :2], wire[:, 2], np.ones(len(wire)), conditions.sigma, 1.0)
    scene += (conditions.dark - scene) * covered
    covered[:] = 0.0
    light, box = scene.copy(), np.zeros(4, np.int64)
    noise = generator.standard_normal(1 << 20).astype(np.float32)
    frame = np.empty((height, width), np.uint8)
    furry = conditions.fur > 0.0 or around.cheek > 0.0
    for i in range(len(lines)):
        faint, hairs = None, []
        if furry:
            light[:] = scene
        if around.cheek:
            ends = camera.project(lines[i, :, [0, -1]].mean(axis=1))
            faint = around.before_cheek(light, ends[0], float(np.sign(ends[1, 0] - ends[0, 0])))
        if all(conditions.face):
            if not furry:
                light[box[0] : box[1], box[2] : box[3]] = scene[box[0] : box[1], box[2] : box[3]]
            middle, inverse, box = _face(camera, lines[i, :, 0], conditions)
            shade(light, middle, inverse, conditions.dark, _FUR, box)
            if conditions.fur > 0.0:
                shade(covered, middle, inverse, 1.0, _FUR, box)
                around.furred(light, middle, covered)
                covered[:] = 0.0
                hairs = around.hair_lines(middle, inverse)
        total[:] = 0.0
        for whisker, line, move in zip(whiskers, lines[i], moves[i], strict=True):
            radius = whisker.radius(np.linspace(0.0, whisker.length, line.shape[0]))
            smooth, wide = _fine(line, radius, camera)
            shift = _at(move, smooth, line)
            shown = 1.0 - hidden(smooth, camera, objects)
            pixels, slopes = camera.project_with_slopes(smooth)
            wide = wide * np.linalg.norm(slopes, axis=(-2, -1)) / np.sqrt(2.0)
            drift = (slopes @ shift[..., None])[..., 0]
            _expose_whisker(covered, total, pixels, drift, wide, shown, conditions)
        if faint is not None:
            total *= faint
        for hair, half in hairs:
            cover(covered, hair, half, np.ones(len(hair)), conditions.sigma, conditions.contrast)
            collect(covered, total, hair, 1.0 + 4.0 * conditions.sigma, 1.0)
        starts = generator.integers(0, noise.size - width, height)
        expose(light, total, noise, starts, conditions.gain, conditions.read_noise, frame)
        yield frame.copy()


def _expose_whisker(
    covered: Image,
    total: Image,
    line: Array,
    drift: Array,
    wide: Array,
    shown: Array,
    conditions: ImageConditions,
) -> None:
    """Add the light blocked by a whisker to ``total``, with motion blur by its ``drift``."""
    sigma = conditions.sigma
    count = max(1, int(np.ceil(np.nanmax(np.linalg.norm(drift, axis=1), initial=0.0))))
    reach = float(wide.max()) + 4.0 * sigma
    for k in range(count):
        at = line + ((k + 0.5) / count - 0.5) * drift
        cover(covered, at, wide, shown, sigma, conditions.contrast / count)
        collect(covered, total, at, reach, 1.0)
        if conditions.side_light > 0.0:
            lit = at + _to_the_left(at) * (wide + sigma)[:, None]
            share = conditions.side_light * conditions.contrast / count
            cover(covered, lit, wide, shown, sigma, share)
            collect(covered, total, lit, reach, -1.0)


def _to_the_left(line: Array) -> Array:
    """Unit normals (−dy, dx) of a line (n, 2)."""
    dx, dy = np.gradient(line, axis=0).T
    left = np.stack([-dy, dx], axis=1)
    return np.asarray(left / np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-9))


def with_true_traces(recording: xr.DataTree, cameras: Sequence[Camera]) -> xr.DataTree:
    """Add cameras, and the true traces in their images, to the recording of a simulated trial."""
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
    """Group ``truth`` of a recording, with the coordinate ``time``."""
    truth = recording.children.get("truth")
    if truth is None or "centerline" not in truth.data_vars:
        raise ValueError("the recording has no true centrelines, which a video needs")
    return truth.to_dataset().assign_coords(time=recording["time"])


def _moves(lines: Array, time: Array, exposure: float) -> Array:
    """Displacement (time, whisker, node, 3) of each node during the exposure, m."""
    if len(lines) < 2:
        return np.zeros_like(lines)
    step = np.diff(lines, axis=0) / np.diff(time)[:, None, None, None]
    before, after = np.concatenate([step[:1], step]), np.concatenate([step, step[-1:]])
    sizes = [np.linalg.norm(v, axis=-1, keepdims=True) for v in (before, after)]
    return np.where(sizes[0] < sizes[1], before, after) * exposure


def _fine(line: Array, radius: Array, camera: Camera) -> tuple[Array, Array]:
    """Resample a centreline to points (n, 3) about two pixels apart, with radii (n,), m."""
    pixels = camera.project(line)
    length = float(np.linalg.norm(np.diff(pixels, axis=0), axis=1).sum())
    s = np.linspace(0.0, 1.0, len(line))
    fine = np.linspace(0.0, 1.0, max(int(length / _STEP), 2 * len(line)))
    return interpolate.CubicSpline(s, line)(fine), np.interp(fine, s, radius)


def _at(move: Array, fine: Array, line: Array) -> Array:
    """Displacements of the nodes of a line, interpolated to its resampled points."""
    s = np.linspace(0.0, 1.0, len(line))
    t = np.linspace(0.0, 1.0, len(fine))
    return np.stack([np.interp(t, s, move[:, k]) for k in range(3)], axis=-1)


def _scene(
    camera: Camera, objects: Sequence[Surface], conditions: ImageConditions, center: Array
) -> Image:
    """Image (height, width) of the background light and the objects."""
    width, height = camera.size
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, width), np.linspace(-1.0, 1.0, height))
    patches = np.sin(3.1 * x + 1.0) * np.cos(2.3 * y - 0.5) + np.cos(5.3 * x - 3.7 * y)
    missing = 0.3 * (x**2 + y**2) + 0.1 * (2.0 - patches)
    light = conditions.light * (1.0 - conditions.unevenness * np.clip(missing, 0.0, 1.0))
    covered = silhouette(camera, objects, center, conditions.sigma)
    light = light * (1.0 - covered) + conditions.dark * covered
    return np.asarray(light, dtype=np.float32)


def _face(
    camera: Camera, bases: Array, conditions: ImageConditions
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Middle (2,) and matrix (2, 2) of the face's ellipse in the image, and the box around it."""
    if len(bases) == 1:
        center, size = bases[0] - [conditions.face[0], 0.0, 0.0], np.array(conditions.face)
    else:
        center = bases.mean(axis=0)
        size = np.abs(bases - center).max(axis=0) + _CHEEK
        if conditions.fur > 0.0:
            # A furry face has at least the stated size, with the foremost base on its surface.
            size = np.maximum(size, conditions.face)
            center[0] = bases[:, 0].max() - size[0]
    middle, slopes = camera.project_with_slopes(center)
    half = slopes * size
    square = half @ half.T
    reach = np.sqrt(np.diag(square)) + 4.0 * _FUR
    ends = np.stack([middle - reach, middle + reach + 1.0])[:, ::-1].T.reshape(-1)
    height, width = camera.size[1], camera.size[0]
    box = np.clip(ends, 0, [height, height, width, width]).astype(np.int64)
    return middle, np.linalg.inv(square), box


def hidden(points: Array, camera: Camera, objects: Sequence[Surface]) -> Array:
    """Mask (...) of the points (..., 3) hidden by an object: 1 hidden, 0 visible."""
    flat = points.reshape(-1, 3)
    out = np.zeros(len(flat))
    known = np.isfinite(flat).all(axis=1)
    _, away = camera.rays(camera.project(flat[known]))
    step = 1.0 / _pixels_per_m(camera, flat[known].mean(axis=0)) if known.any() else 1.0
    for thing in objects:
        nearest = _least(thing, flat[known], -away, _REACH, 0.5 * step)
        out[known] = np.maximum(out[known], nearest < -0.25 * step)
    return out.reshape(points.shape[:-1])


def silhouette(camera: Camera, objects: Sequence[Surface], center: Array, soft: float) -> Array:
    """Share of each pixel (height, width) covered by objects, with edges of width ``soft``."""
    width, height = camera.size
    covered = np.zeros((height, width))
    if not objects:
        return covered
    scale = _pixels_per_m(camera, center)
    margin = _COARSE + (_SOFT + 1.0) * soft
    rows, columns = np.arange(0, height + _COARSE, _COARSE), np.arange(0, width + _COARSE, _COARSE)
    corners = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    for thing in objects:
        rough = _nearest(camera, thing, corners, center, scale) * scale
        inside = rough < -margin
        near = np.abs(rough) <= margin
        for column, row in corners[inside]:
            covered[_block(row), _block(column)] = 1.0
        mask = np.zeros((height, width), dtype=bool)
        for column, row in corners[near]:
            mask[_block(row), _block(column)] = True
        pixels = np.stack(np.nonzero(mask)[::-1], axis=-1)
        if len(pixels):
            distance = _nearest(camera, thing, pixels, center, scale) * scale
            covered[mask] = np.maximum(covered[mask], special.ndtr(-distance / soft))
    return covered


def _block(place: int) -> slice:
    """Pixels nearest to a point of the coarse grid, along one axis."""
    return slice(max(place - _COARSE // 2, 0), place + _COARSE // 2)


def _pixels_per_m(camera: Camera, point: Array) -> float:
    """Scale of the image at a point, pixels per metre."""
    return float(np.linalg.norm(camera.project_with_slopes(point)[1]) / np.sqrt(2.0))


def _nearest(
    camera: Camera, thing: Surface, pixels: NDArray[np.int64], center: Array, scale: float
) -> Array:
    """Smallest signed distance of an object from the line of sight of each pixel (n, 2), m."""
    origin, direction = camera.rays(pixels)
    along = ((center - origin) * direction).sum(axis=1) - _REACH
    start = origin + along[:, None] * direction
    return _least(thing, start, direction, 2.0 * _REACH, 0.5 / scale)


def _least(thing: Surface, start: Array, direction: Array, reach: float, step: float) -> Array:
    """Smallest signed distance from an object along the line from each start (n, 3), m."""
    least = np.full(len(start), np.inf)
    gone = np.zeros(len(start))
    active = np.arange(len(start))
    for _ in range(_STEPS):
        distance = thing.signed_distance(start[active] + gone[active, None] * direction[active])
        least[active] = np.minimum(least[active], distance)
        gone[active] += np.maximum(np.abs(distance), step)
        # Deep inside the object, the exact distance no longer matters.
        active = active[(gone[active] < reach) & (least[active] > -20.0 * step)]
        if not active.size:
            break
    return least


@kernel
def cover(image: Any, line: Any, half_width: Any, shown: Any, sigma: float, share: float) -> None:
    """Draw the coverage of pixels by a strip, scaled by ``share``, as a maximum with the image."""
    rows, columns = image.shape
    last = line.shape[0] - 2
    scale = 1.0 / (math.sqrt(2.0) * sigma)
    for k in range(last + 1):
        x0, y0 = line[k, 0], line[k, 1]
        ex, ey = line[k + 1, 0] - x0, line[k + 1, 1] - y0
        length = math.sqrt(ex * ex + ey * ey)
        if not (length > 1e-9 and (shown[k] > 0.0 or shown[k + 1] > 0.0)):
            continue
        ex, ey = ex / length, ey / length
        reach = max(half_width[k], half_width[k + 1]) + _TAIL * sigma
        left = max(0, math.floor(min(x0, line[k + 1, 0]) - reach))
        right = min(columns - 1, math.ceil(max(x0, line[k + 1, 0]) + reach))
        top = max(0, math.floor(min(y0, line[k + 1, 1]) - reach))
        bottom = min(rows - 1, math.ceil(max(y0, line[k + 1, 1]) + reach))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                along = (column - x0) * ex + (row - y0) * ey
                t = max(along, 0.0)
                end = 1.0
                if k == last:
                    end = 0.5 * (1.0 + math.erf((length - along) * scale))
                else:
                    t = min(t, length)
                dx, dy = column - x0 - t * ex, row - y0 - t * ey
                d = math.sqrt(dx * dx + dy * dy)
                if d > reach:
                    continue
                f = min(t / length, 1.0)
                w = half_width[k] + f * (half_width[k + 1] - half_width[k])
                seen = shown[k] + f * (shown[k + 1] - shown[k])
                c = 0.5 * (math.erf((w + d) * scale) + math.erf((w - d) * scale))
                value = share * c * end * seen
                if value > image[row, column]:
                    image[row, column] = value


@kernel
def collect(covered: Any, total: Any, line: Any, reach: float, sign: float) -> None:
    """Add the coverage near a line to ``total``, times ``sign``, and clear it."""
    rows, columns = covered.shape
    for k in range(line.shape[0] - 1):
        left = max(0, math.floor(min(line[k, 0], line[k + 1, 0]) - reach))
        right = min(columns - 1, math.ceil(max(line[k, 0], line[k + 1, 0]) + reach))
        top = max(0, math.floor(min(line[k, 1], line[k + 1, 1]) - reach))
        bottom = min(rows - 1, math.ceil(max(line[k, 1], line[k + 1, 1]) + reach))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                if covered[row, column] > 0.0:
                    total[row, column] += sign * covered[row, column]
                    covered[row, column] = 0.0


@kernel
def expose(
    light: Any, total: Any, noise: Any, starts: Any, gain: float, read_noise: float, frame: Any
) -> None:
    """Convert light into grey values with shot and read noise."""
    rows, columns = frame.shape
    for row in range(rows):
        start = starts[row]
        for column in range(columns):
            value = max(light[row, column], 0.0) * (1.0 - min(total[row, column], 1.0))
            spread = math.sqrt(value / gain + read_noise * read_noise)
            value += spread * noise[start + column] + 0.5
            frame[row, column] = np.uint8(min(max(value, 0.0), 255.0))


@kernel
def shade(image: Any, center: Any, inverse: Any, level: float, edge: float, box: Any) -> None:
    """Draw an ellipse of grey value ``level`` with a soft edge, within a box of the image."""
    scale = 1.0 / (math.sqrt(2.0) * edge)
    a, b, c = inverse[0, 0], inverse[0, 1], inverse[1, 1]
    for row in range(box[0], box[1]):
        y = row - center[1]
        for column in range(box[2], box[3]):
            x = column - center[0]
            gx, gy = a * x + b * y, b * x + c * y
            m = math.sqrt(x * gx + y * gy) + 1e-12
            # Distance from the edge, to first order, over √2 times its standard deviation.
            v = (m - 1.0) * m / (math.sqrt(gx * gx + gy * gy) + 1e-12) * scale
            if v <= 2.5:
                w = 1.0 if v < -2.5 else 0.5 * (1.0 - math.erf(v))
                image[row, column] += (level - image[row, column]) * w
