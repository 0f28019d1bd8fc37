"""Films of one whisker as laboratories have them, by a small renderer of their own.

A face with furry texture, hairs at its edge and over the base of the whisker; a shiny peg with a
glint and a dark stripe, past which the whisker bends; uneven light, shadows, scale bar, wire and
pipette, which stand still; noise and compression. Nothing here knows any mechanics: the whisker
turns about its base, and where the peg is in its way it bends until it touches it. Whatever is not
said is drawn from the seed.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import av
import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, shift

from vibrissa.cameras import orthogonal_views
from vibrissa.simulation.film import cover

PIXEL = 58e-6


@dataclass(frozen=True)
class Setup:
    """What is in front of the cameras; all else is drawn from the seed."""

    seed: int = 0
    size: tuple[int, int] = (512, 512)
    frames: int = 60
    rate: float = 500.0
    whisker: bool = True
    peg: bool = True
    clutter: bool = True
    cheek: bool = False  # behind the whisker, in the front view: grey fur
    bright: bool = False  # all grey values the other way round
    still: bool = False  # the whisker does not whisk
    noise: float | None = None
    crf: int | None = None  # H.264's
    face: float | None = None  # grey value


class Film:
    """Frames of two views, and where the whisker truly is in them.

    `frames[view][i]` are images, `curves[view][i]` the middle of the whisker (n, 2), from where it
    leaves the fur on.
    """

    def __init__(self, setup: Setup) -> None:
        self.setup, self._random = setup, np.random.default_rng([setup.seed, 77])
        draw = self._random.uniform
        width = setup.size[0]
        self.length = draw(0.62, 0.78) * width * PIXEL
        # It points to the right, seen from the top obliquely; half of the seeds are mirrored.
        self._mirrored = bool(self._random.integers(2))
        self._oblique = draw(-0.5, 0.5)
        middle = (
            0.40 * width * PIXEL * np.array([np.cos(self._oblique), np.sin(self._oblique), 0.0])
        )
        self.cameras = orthogonal_views(
            PIXEL, setup.size, middle * [-1.0 if self._mirrored else 1.0, 1.0, 1.0]
        )
        self._levels = {
            "light": draw(165.0, 215.0),
            "dark": draw(15.0, 55.0) if setup.face is None else setup.face,
        }
        self._motion()
        self._shapes()
        self.curves: list[list[Any]] = [[], []]
        self.frames = [self._filmed(view) for view in range(2)]

    # What moves, and how.

    def _motion(self) -> None:
        s, draw = self.setup, self._random.uniform
        t = np.arange(s.frames) / s.rate
        phase, rate = draw(0.0, 2.0 * np.pi), draw(7.0, 11.0)
        swing = 0.0 if s.still else np.radians(draw(9.0, 22.0))
        wave = np.sin(2.0 * np.pi * rate * t + phase)
        self.azimuth = self._oblique + swing * wave
        self.elevation = draw(-0.35, 0.35) + 0.25 * swing * np.sin(
            2.0 * np.pi * rate * t + phase + draw(0.3, 1.2)
        )
        nod = draw(0.5, 2.0) * PIXEL * (0.2 if s.still else 1.0)
        self.head = nod * np.stack(
            [np.sin(2.0 * np.pi * draw(1.0, 4.0) * t + draw(0.0, 6.0)) for _ in range(3)], axis=1
        )
        # The pad moves with the whisk.
        self.base = self.head + (0.0 if s.still else draw(2.0, 5.0)) * PIXEL * wave[:, None] * [
            0.3,
            1.0,
            0.2,
        ]

    def _shapes(self) -> None:
        s, draw = self.setup, self._random.uniform
        self.bend = draw(0.3, 1.1) * self._random.choice([-1.0, 1.0])
        rest = [self._curve(i, 0.0) for i in range(s.frames)]
        at = draw(0.5, 0.75)
        index = int(at * 200)
        places = np.array([curve[index] for curve in rest])
        side = np.quantile(places[:, 1], 0.65)
        middle = places[np.argmin(np.abs(places[:, 1] - side))]
        self.peg_radius = draw(0.7e-3, 1.35e-3) * s.size[0] / 800
        self.peg = middle + np.array([0.0, self.peg_radius, 0.0])
        self.centerlines = [self._past_peg(i, index) if s.peg else rest[i] for i in range(s.frames)]

    def _curve(self, i: int, extra: float, contact: float = 0.65) -> Any:
        s = np.linspace(0.0, 1.0, 201)
        u = np.minimum(s, contact)
        angle = self.bend * s * 0.7 + extra * (2.0 * contact * u - u * u)
        step = self.length / 200.0
        plane = np.zeros((201, 3))
        plane[1:, 0] = np.cumsum(np.cos(angle[:-1])) * step
        plane[1:, 1] = np.cumsum(np.sin(angle[:-1])) * step
        a, e = self.azimuth[i] - 0.35 * self.bend, self.elevation[i]
        ca, sa, ce, se = np.cos(a), np.sin(a), np.cos(e), np.sin(e)
        turn = np.array([[ca, -sa, 0.0], [sa, ca, 0.0], [0.0, 0.0, 1.0]])
        turn = turn @ np.array([[ce, 0.0, -se], [0.0, 1.0, 0.0], [se, 0.0, ce]])
        curve = plane @ turn.T + self.base[i]
        return curve * [-1.0 if self._mirrored else 1.0, 1.0, 1.0]

    def _past_peg(self, i: int, index: int) -> Any:
        """Bend back until it no longer runs through the peg."""
        low, high = -6.0, 0.0
        reach = self.peg_radius + 1.2 * PIXEL

        def inside(extra: float) -> bool:
            curve = self._curve(i, extra, index / 200.0)[20:]
            off = curve[:, :2] - self.peg[:2]
            return bool(
                (np.hypot(*off.T) < reach).any() or (off[np.argmin(np.abs(off[:, 0])), 1] > 0.0)
            )

        if not inside(0.0):
            return self._curve(i, 0.0)
        if inside(low):
            return self._curve(i, 0.0)
        for _ in range(20):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if inside(middle) else (middle, high)
        return self._curve(i, low, index / 200.0)

    # How it looks.

    def _filmed(self, view: int) -> list[Any]:
        s, random = self.setup, np.random.default_rng([self.setup.seed, view, 5])
        width, height = s.size
        still = self._still(view, random)
        fur, mask, hairs = self._face(view, random)
        level = random.uniform(2.0, 5.0) if s.noise is None else s.noise
        pool = random.normal(0.0, level, (height + 64, width + 64))
        camera, out = self.cameras[view], []
        for i in range(s.frames):
            move = (camera.project(self.head[i] * self._sign) - camera.project(np.zeros(3)))[::-1]
            face = shift(mask, move, order=1, mode="nearest")
            skin = shift(fur, move, order=1, mode="nearest")
            image = still * (1.0 - face) + skin * face
            line = camera.project(self.centerlines[i])
            if s.whisker:
                image = self._strip(image, line, self._widths(), 0.1 if s.bright else 0.0, 22.0)
            # The face hides what is behind its edge, hairs what is below them.
            back = map_coordinates(face, line.T[::-1], order=1, mode="nearest")
            cheek = s.cheek and view == 1
            first = (
                0 if cheek else int(np.flatnonzero(back > 0.5)[-1]) + 1 if (back > 0.5).any() else 0
            )
            if not cheek:
                image = np.where(face > 0.5, skin, image)
            for hair, wide, grey in hairs:
                image = self._strip(image, hair + move[::-1], wide, 0.15, grey)
            self.curves[view].append(line[first:])
            row, column = random.integers(0, 64, 2)
            out.append(image + pool[row : row + height, column : column + width])
        grey = [np.clip(np.rint(f), 0, 255).astype(np.uint8) for f in out]
        if s.bright:
            grey = [np.asarray(255 - f) for f in grey]
        return grey if s.crf is None else coded(grey, s.crf)

    @property
    def _sign(self) -> Any:
        return np.array([-1.0 if self._mirrored else 1.0, 1.0, 1.0])

    def _widths(self) -> Any:
        return np.linspace(1.7, 0.15, 201) * self.setup.size[0] / 640

    def _strip(self, image: Any, line: Any, half: Any, clear: float, grey: float) -> Any:
        """Paint a line of a half width, pixels, and a grey value; ``clear`` lets light through."""
        share = np.zeros_like(image)
        cover(
            share,
            np.ascontiguousarray(line),
            np.asarray(half, float),
            np.ones(len(line)),
            0.8,
            1.0 - clear,
        )
        return image * (1.0 - share) + grey * share

    def _still(self, view: int, random: Any) -> Any:
        """Light, peg, and what else never moves."""
        s, draw = self.setup, random.uniform
        width, height = s.size
        y, x = np.mgrid[:height, :width] / max(s.size)
        patches = gaussian_filter(random.normal(size=(height, width)), 0.08 * width)
        slope = draw(-0.3, 0.3) * (x - 0.5) + draw(-0.3, 0.3) * (y - 0.5)
        image = self._levels["light"] * (1.0 + slope + 0.06 * patches / patches.std())
        image -= draw(0.05, 0.3) * image * ((x - 0.5) ** 2 + (y - 0.5) ** 2)
        if s.clutter:
            image = self._clutter(image, random)
        if s.peg:
            image = self._peg(image, view)
        return image

    def _clutter(self, image: Any, random: Any) -> Any:
        height, width = image.shape
        draw = random.uniform
        row, column = int(draw(0.05, 0.15) * height), int(draw(0.5, 0.75) * width)
        image[row : row + 4, column : column + width // 6] = 25.0
        for tick in range(0, width // 6, 12):
            image[row : row + 12, column + tick : column + tick + 2] = 25.0
        t = np.linspace(0.0, 1.0, 80)[:, None]
        ends = np.array([[draw(0.3, 0.9) * width, -5.0], [width + 5.0, draw(0.4, 0.9) * height]])
        wire = ends[0] + t * (ends[1] - ends[0]) + np.sin(np.pi * t) * draw(-40.0, 40.0, 2)
        image = self._strip(image, wire, np.full(80, draw(0.6, 1.6)), 0.1, 30.0)
        tip = np.array([draw(0.55, 0.85) * width, draw(0.8, 0.9) * height])
        for side in (-1.0, 1.0):
            wall = (
                tip
                + t * np.array([draw(0.1, 0.2) * width, 0.2 * height])
                + side * (3.0 + 6.0 * t) * [1.0, -0.6]
            )
            image = self._strip(image, wall, np.full(80, 0.9), 0.3, 60.0)
        return image

    def _peg(self, image: Any, view: int) -> Any:
        """Dark, with a glint along it and a darker stripe beside, and a soft shadow."""
        height, width = image.shape
        y, x = np.mgrid[:height, :width].astype(float)
        cx, cy = self.cameras[view].project(self.peg)
        r = self.peg_radius / PIXEL
        across = x - cx
        inside = np.hypot(across, y - cy) < r if view == 0 else np.abs(across) < r
        shadow = np.exp(-0.5 * ((across - 1.6 * r) / (0.8 * r)) ** 2)
        if view == 0:
            shadow = shadow * np.exp(-0.5 * ((y - cy - 0.8 * r) / r) ** 2)
        image = image * (1.0 - 0.25 * shadow)
        body = 70.0 + 25.0 * across / r
        glint = np.exp(-0.5 * ((across + 0.35 * r) / 2.2) ** 2)
        stripe = np.exp(-0.5 * ((across - 0.15 * r) / 1.6) ** 2)
        body = body * (1.0 - 0.8 * stripe) * (1.0 - glint) + 245.0 * glint
        soft = gaussian_filter(inside.astype(float), 0.8)
        return image * (1.0 - soft) + body * soft

    def _face(self, view: int, random: Any) -> tuple[Any, Any, list[Any]]:
        """Fur (grey values), how much it covers (0 to 1), and hairs (line, half width, grey)."""
        s, draw = self.setup, random.uniform
        width, height = s.size
        y, x = np.mgrid[:height, :width].astype(float)
        base = self.cameras[view].project(np.zeros(3))
        out = np.array([-1.0 if self._mirrored else 1.0, 0.0])
        if view == 0:
            # Pixels count downward, y upward.
            out = np.array([out[0] * np.cos(self._oblique), -np.sin(self._oblique)])
        normal = np.array([-out[1], out[0]])
        big = np.array([draw(0.5, 0.8), draw(0.22, 0.5)]) * width
        center = base - out * big[0]
        u = ((x - center[0]) * out[0] + (y - center[1]) * out[1]) / big[0]
        v = ((x - center[0]) * normal[0] + (y - center[1]) * normal[1]) / big[1]
        rough = gaussian_filter(random.normal(size=(height, width)), 6.0)
        distance = (np.hypot(u, v) - 1.0) * big.mean() + 2.0 * rough / rough.std()
        mask = 1.0 / (1.0 + np.exp(np.clip(1.2 * distance, -30, 30)))
        fur = gaussian_filter(random.normal(size=(height, width)), (0.8, 3.0))
        coarse = gaussian_filter(random.normal(size=(height, width)), 5.0)
        dark = self._levels["dark"]
        shade = dark + draw(5.0, 11.0) * fur / fur.std() + 6.0 * coarse / coarse.std()
        if s.cheek and view == 1:
            # The animal's cheek behind the whisker: grey, as far as half of the whisker.
            grey = 46.0 + draw(4.0, 7.0) * fur / fur.std()
            edge = base[0] + out[0] * draw(0.3, 0.45) * width
            mask = np.maximum(
                mask, 1.0 / (1.0 + np.exp(np.clip(0.8 * out[0] * (x - edge), -30, 30)))
            )
            shade = grey
        return np.maximum(shade, 2.0), mask, self._hairs(center, out, normal, big, random)

    def _hairs(self, center: Any, out: Any, normal: Any, big: Any, random: Any) -> list[Any]:
        hairs = []
        t = np.linspace(0.0, 1.0, 14)[:, None]
        scale = self.setup.size[0] / 512
        for k in range(int(220 * scale)):
            # More of them near the base, and some over it.
            angle = random.normal(0.0, 0.5) if k % 3 else random.normal(0.0, 0.06)
            place = center + big[0] * np.cos(angle) * out * 0.98 + big[1] * np.sin(angle) * normal
            way = np.cos(angle) * out + np.sin(angle) * normal + random.normal(0.0, 0.5, 2)
            way /= np.linalg.norm(way)
            side = np.array([-way[1], way[0]])
            long = random.gamma(4.0, 4.0) * scale
            line = (
                place - 4.0 * way + t * long * way + t**2 * random.normal(0.0, 0.25) * long * side
            )
            grey = random.uniform(30.0, 110.0)
            hairs.append((line, np.linspace(random.uniform(0.3, 0.7), 0.1, 14), grey))
        return hairs


def coded(frames: list[Any], crf: int) -> list[Any]:
    """Compress with H.264 and decode."""
    file = io.BytesIO()
    with av.open(file, "w", format="matroska") as out:
        stream: Any = out.add_stream(
            "libx264", rate=50, options={"crf": str(crf), "preset": "ultrafast"}
        )
        stream.height, stream.width = frames[0].shape
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))
        out.mux(stream.encode())
    file.seek(0)
    with av.open(file) as source:
        return [np.asarray(f.to_ndarray(format="gray")) for f in source.decode(video=0)]
