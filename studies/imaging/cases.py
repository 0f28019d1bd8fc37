"""Trials that differ from an ordinary one in one thing each.

The ordinary one: a whisker of 24 mm sweeps past a peg and slips, 0.15 s at 1,000 frames/s, seen
from two sides at 58 µm a pixel in images of 512 × 512.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from vibrissa import Whisker
from vibrissa.cameras import Camera, orthogonal_views
from vibrissa.samples import gamma
from vibrissa.simulation import (
    ImageConditions,
    facing_peg,
    film_frames,
    simulate,
    sweep_past,
    with_true_traces,
    within_reach,
)

Array = NDArray[np.float64]
Frames = list[NDArray[np.uint8]]

WHISKER = Whisker.parabola(length=24e-3, coefficient=17.0, base_radius=80e-6)
PIXEL = 58e-6


@dataclass(frozen=True)
class Case:
    """One trial, how it is filmed, and what happens to the film.

    Parameters
    ----------
    name, group : str
        What is different, and what kind of difference that is.
    whisker : Whisker
        That whisks.
    rate, duration : float
        Frames per second, and how long, s.
    motion : mapping
        Of `sweep_past`.
    pixel : float
        What a pixel sees, m.
    size : tuple of int
        Of a frame, pixels.
    shift : tuple of float
        Shift of the middle of the images from the middle of where the whisker goes, m.
    angle : float, optional
        Between the views, rad; by default the paper's two.
    distance : float, optional
        Of perspective cameras, m.
    conditions : ImageConditions
        Light and blur.
    change : callable
        Makes of the frames of a view what is tracked: ``change(frames, view)``.
    shown : callable
        Frame of the trial for each frame of a view: ``shown(count, view)``.
    peg : float
        Its radius, as a share of the ordinary one.
    kind : str
        What the whisker touches, of `within_reach`.
    friction : float
        Between whisker and object.
    offset : int, optional
        Given to the tracking.
    """

    name: str
    group: str = ""
    whisker: Whisker = WHISKER
    rate: float = 1000.0
    duration: float = 0.15
    motion: Mapping[str, Any] = field(default_factory=dict)
    pixel: float = PIXEL
    size: tuple[int, int] = (512, 512)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angle: float | None = None
    distance: float | None = None
    conditions: ImageConditions = field(default_factory=ImageConditions)
    change: Callable[[Frames, int], Frames] = lambda frames, view: frames
    shown: Callable[[int, int], NDArray[np.intp]] = lambda count, view: np.arange(count)
    peg: float = 1.0
    kind: str = "peg"
    friction: float = 0.0
    offset: int | None = 0


@dataclass(frozen=True, eq=False)
class Filmed:
    """What is tracked, and the truth."""

    trial: Any
    cameras: tuple[Camera, ...]
    frames: list[Frames]
    shown: list[NDArray[np.intp]]


def filmed(case: Case, seed: int = 0) -> Filmed:
    """Simulate and film."""
    thing = facing_peg(case.whisker)
    scale = case.whisker.length / 40e-3
    thing = facing_peg(case.whisker, radius=case.peg * scale * thing.radius)
    if case.kind != "peg":
        thing = within_reach(case.whisker, case.kind)
    motion = {"frequency": 1.0 / case.duration, **case.motion}
    sweep = sweep_past(case.whisker, thing, case.duration, case.rate, seed=seed, **motion)
    trial = simulate(case.whisker, sweep, thing, friction=case.friction)
    cameras = views(case, trial)
    trial = with_true_traces(trial, cameras)
    frames, shown = [], []
    for view, camera in enumerate(cameras):
        film = list(film_frames(trial, camera, case.conditions, seed=seed + view))
        rows = case.shown(len(film), view)
        frames.append(case.change([film[i] for i in rows], view))
        shown.append(rows)
    return Filmed(trial, cameras, frames, shown)


def views(case: Case, trial: Any) -> tuple[Camera, ...]:
    lines = trial["truth"]["centerline"].values
    low, high = np.nanmin(lines, axis=(0, 1, 2)), np.nanmax(lines, axis=(0, 1, 2))
    center = 0.5 * (low + high) + case.shift
    pair = orthogonal_views(case.pixel, case.size, center)
    if case.angle is None and case.distance is None:
        return pair
    angle = np.pi / 2.0 if case.angle is None else case.angle
    return tuple(
        _camera(name, turn, case, center) for name, turn in (("top", 0.0), ("side", angle))
    )


def _camera(name: str, turn: float, case: Case, center: Array) -> Camera:
    """ImageConditions down along −z, turned about x."""
    forward = np.array([0.0, -np.sin(turn), -np.cos(turn)])
    rotation = np.stack([[1.0, 0.0, 0.0], np.cross(forward, [1.0, 0.0, 0.0]), forward])
    middle = (np.asarray(case.size) - 1.0) / 2.0
    matrix = np.eye(3)
    matrix[:2, 2] = middle
    shift = -rotation @ center
    if case.distance is None:
        matrix[[0, 1], [0, 1]] = 1.0 / case.pixel
        kind = "orthographic"
    else:
        matrix[[0, 1], [0, 1]] = case.distance / case.pixel
        shift = shift + np.array([0.0, 0.0, case.distance])
        kind = "perspective"
    return Camera(matrix, rotation, shift, size=case.size, projection=kind, name=name)  # type: ignore[arg-type]


# What happens to films.


def each(change: Callable[[Array], Array]) -> Callable[[Frames, int], Frames]:
    """Change every frame by itself."""
    return lambda frames, view: [_grey(change(f.astype(np.float64))) for f in frames]


def _grey(values: Array) -> NDArray[np.uint8]:
    return np.asarray(np.clip(np.rint(values), 0.0, 255.0), dtype=np.uint8)


def defocus(sigma: float) -> Callable[[Frames, int], Frames]:
    """Blur the scene; the noise of the sensor comes after it."""
    noise = np.random.default_rng(1).normal(0.0, 2.0, (512, 512))
    return each(lambda f: gaussian_filter(f, sigma) + np.roll(noise, int(f[0, 0]), 1))


def flicker(
    frequency: float, depth: float, rate: float = 1000.0
) -> Callable[[Frames, int], Frames]:
    """A lamp on the mains."""

    def change(frames: Frames, view: int) -> Frames:
        t = np.arange(len(frames)) / rate
        light = 1.0 - depth * (0.5 + 0.5 * np.sin(2.0 * np.pi * 2.0 * frequency * t + view))
        return [_grey(f * s) for f, s in zip(frames, light, strict=True)]

    return change


def drift(end: float) -> Callable[[Frames, int], Frames]:
    """The light changes steadily."""
    return lambda frames, view: [
        _grey(f * s) for f, s in zip(frames, np.linspace(1.0, end, len(frames)), strict=True)
    ]


def noisy(sigma: float) -> Callable[[Frames, int], Frames]:
    def change(frames: Frames, view: int) -> Frames:
        generator = np.random.default_rng(view)
        return [_grey(f + generator.normal(0.0, sigma, f.shape)) for f in frames]

    return change


def shaded(depth: float) -> Callable[[Frames, int], Frames]:
    """Light that falls from one corner to the other."""

    def one(f: Array) -> Array:
        y, x = np.mgrid[: f.shape[0], : f.shape[1]]
        return np.asarray(f * (1.0 - depth * (x / f.shape[1] + y / f.shape[0]) / 2.0))

    return each(one)


def textured(size: float, depth: float) -> Callable[[Frames, int], Frames]:
    """A background that is not even: grey values by so much, over so many pixels."""

    def one(f: Array) -> Array:
        cloth = gaussian_filter(np.random.default_rng(5).normal(size=f.shape), size, mode="wrap")
        return np.asarray(f * (1.0 + depth / 200.0 * cloth / cloth.std()))

    return each(one)


def lines(count: int, depth: float) -> Callable[[Frames, int], Frames]:
    """Thin dark lines in the background, as seams or scratches are."""

    def one(f: Array) -> Array:
        y, x = np.mgrid[: f.shape[0], : f.shape[1]]
        dark = np.zeros_like(f)
        generator = np.random.default_rng(3)
        for _ in range(count):
            angle, at = generator.uniform(0.0, np.pi), generator.uniform(0.2, 0.8, 2)
            away = np.cos(angle) * (x - at[0] * f.shape[1]) + np.sin(angle) * (
                y - at[1] * f.shape[0]
            )
            dark = np.maximum(dark, np.exp(-0.5 * (away / 1.2) ** 2))
        return np.asarray(f * (1.0 - depth / 200.0 * dark))

    return each(one)


def bar(place: float, wide: float) -> Callable[[Frames, int], Frames]:
    """A dark upright bar before one view."""

    def change(frames: Frames, view: int) -> Frames:
        if view == 0:
            return frames
        out = []
        for f in frames:
            g = f.copy()
            a = int((place - 0.5 * wide) * f.shape[1])
            g[:, a : a + int(wide * f.shape[1])] = 20
            out.append(g)
        return out

    return change


def coded(codec: str, **options: str) -> Callable[[Frames, int], Frames]:
    """Compress and decode."""

    def change(frames: Frames, view: int) -> Frames:
        file = io.BytesIO()
        kind = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        with av.open(file, "w", format="matroska") as out:
            stream: Any = out.add_stream(codec, rate=50, options=options)
            stream.height, stream.width = frames[0].shape
            stream.pix_fmt = kind
            for f in frames:
                out.mux(stream.encode(av.VideoFrame.from_ndarray(f, format="gray")))
            out.mux(stream.encode())
        file.seek(0)
        with av.open(file) as source:
            return [np.asarray(f.to_ndarray(format="gray")) for f in source.decode(video=0)]

    return change


def inverted(frames: Frames, view: int) -> Frames:
    """Bright on dark."""
    return [np.asarray(255 - f) for f in frames]


def without(view: int, frame: int) -> Callable[[int, int], NDArray[np.intp]]:
    """One view lacks a frame."""
    return lambda count, v: np.delete(np.arange(count), frame) if v == view else np.arange(count)


def shorter(view: int, by: int) -> Callable[[int, int], NDArray[np.intp]]:
    return lambda count, v: np.arange(count - by if v == view else count)


def late(view: int, by: int) -> Callable[[int, int], NDArray[np.intp]]:
    """One view begins later."""
    return lambda count, v: np.arange(by if v == view else 0, count)


_CURVED = Whisker.parabola(length=12e-3, coefficient=70.0, base_radius=50e-6)
_LONG = Whisker.straight(length=55e-3, base_radius=100e-6)
_WIRE = Whisker.straight(
    length=0.3, base_radius=0.4e-3, tip_radius=0.4e-3, youngs_modulus=200e9, poisson_ratio=0.3
)
_ARM = ImageConditions(face=(60e-3, 30e-3, 40e-3))

CASES = (
    Case("reference", "ordinary"),
    Case("lens out of focus, 2 pixels", "blur", change=defocus(2.0)),
    Case("lens out of focus, 3 pixels", "blur", change=defocus(3.0)),
    Case("shutter open for 1 ms", "blur", conditions=ImageConditions(exposure=1e-3)),
    Case("contrast a quarter", "light", conditions=ImageConditions(contrast=0.85 / 4.0)),
    Case("a third of the light", "light", conditions=ImageConditions(light=65.0, dark=6.0)),
    Case("light falls by half", "light", change=drift(0.5)),
    Case("lamp at 60 Hz, 60 %", "light", change=flicker(60.0, 0.6)),
    Case("overexposed, background white", "light", change=each(lambda f: 1.6 * f)),
    Case(
        "underexposed, face and half of the whisker black", "light", change=each(lambda f: f - 60.0)
    ),
    Case("bright whisker on dark", "light", change=inverted),
    Case("light falls across the image by 80 %", "light", change=shaded(0.8)),
    Case("no face", "background", conditions=ImageConditions(face=(0.0, 0.0, 0.0))),
    Case("bright face", "background", conditions=ImageConditions(dark=150.0)),
    Case("noise of 6 grey values", "noise", change=noisy(6.0)),
    Case("noise of 12 grey values", "noise", change=noisy(12.0)),
    Case("cloth, 8 grey values over 3 pixels", "background", change=textured(3.0, 8.0)),
    Case("six dark lines in the background", "background", change=lines(6, 60.0)),
    Case("a bar hides 15 % of one view", "hidden", change=bar(0.62, 0.15)),
    Case("H.264, rate factor 28", "compression", change=coded("libx264", crf="28")),
    Case("H.264, rate factor 36", "compression", change=coded("libx264", crf="36")),
    Case("MJPEG, quantiser 15", "compression", change=coded("mjpeg", qmin="15", qmax="15")),
    Case("250 frames/s", "rate", rate=250.0, duration=0.3),
    Case("2,000 frames/s", "rate", rate=2000.0, duration=0.1),
    Case("320 × 240, 110 µm a pixel", "size", size=(320, 240), pixel=110e-6),
    Case("1280 × 1024, 25 µm a pixel", "size", size=(1280, 1024), pixel=25e-6),
    Case("views at 60°", "cameras", angle=np.radians(60.0)),
    Case("views at 120°", "cameras", angle=np.radians(120.0)),
    Case("perspective, 80 mm away, 75°", "cameras", angle=np.radians(75.0), distance=80e-3),
    Case("short, strongly curved", "whisker", whisker=_CURVED, pixel=29e-6),
    Case("long, straight, 120 µm a pixel", "whisker", whisker=_LONG, pixel=120e-6),
    Case(
        "steel wire, 300 mm, 1 mm a pixel",
        "whisker",
        whisker=_WIRE,
        pixel=1e-3,
        rate=250.0,
        duration=0.6,
        conditions=_ARM,
    ),
    Case("tip leaves the image", "frame", size=(380, 512), shift=(-2.8e-3, 0.0, 0.0)),
    Case(
        "base leaves the image",
        "frame",
        motion={"position_drift": 2e-3},
        shift=(2.6e-3, 0.0, 0.0),
    ),
    Case("thick peg", "hidden", peg=2.5),
    Case("one frame dropped, offset not stated", "frames", shown=without(1, 70)),
    Case("one frame dropped, offset auto", "frames", shown=without(1, 70), offset=None),
    Case("one view 30 frames shorter", "frames", shown=shorter(1, 30)),
    Case("one frame out of step, offset not stated", "frames", shown=late(1, 1)),
    Case("one frame out of step, offset auto", "frames", shown=late(1, 1), offset=None),
    Case("γ whisker, 0.3 s", "ordinary", whisker=gamma(), duration=0.3, pixel=95e-6),
    Case("γ whisker, friction 0.3", "object", gamma(), duration=0.3, pixel=95e-6, friction=0.3),
    Case("sphere", "object", kind="sphere"),
    Case("box", "object", kind="box"),
)
