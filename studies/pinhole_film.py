"""Films by a renderer of its own: polygons, supersampled, seen through pinhole lenses.

It shares nothing with the simulation's film maker but the true positions of the whisker: cameras
are the equations of a pinhole, bodies are filled polygons, and edges are softened by averaging
subpixels. The peg may shine, with a glint and a dark stripe, and hides what is behind it; fur may
lie over the base. `film` gives frames of two views; tracking is judged with what it was drawn from.
"""

import io
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFilter
from scipy.interpolate import CubicSpline

FINE = 5
"""Subpixels of a pixel along each side."""

HALF = 25e-3
"""Half the length of the peg, m."""


@dataclass(frozen=True)
class Pinhole:
    """A lens at a distance from the origin (m), in units of pixels at that distance.

    Parameters
    ----------
    axes : array (3, 3)
        Directions right, down and forward in the laboratory.
    distance : float
        Distance of the lens from the origin, m.
    pixel : float
        Size of a pixel at that distance, m.
    size : int
        Width and height, pixels.
    """

    axes: np.ndarray
    distance: float
    pixel: float
    size: int

    def __call__(self, points):
        """Columns and rows of points (..., 3)."""
        right, down, ahead = np.moveaxis(np.asarray(points) @ self.axes.T, -1, 0)
        scale = self.distance / (self.distance + ahead) / self.pixel
        return (self.size - 1) / 2 + np.stack([right * scale, down * scale], axis=-1)


def views(distance=0.6, angle=90.0, turned=0.0, pixel=80e-6, size=300):
    """A lens above, and one in front at an angle from it, mirrored as the front view is."""
    top = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
    a, b = np.radians(angle), np.radians(turned)
    # The front view looks along -y; its images are mirrored so that x is to the right.
    ahead = np.array([0.0, -np.sin(a), -np.cos(a)])
    down = np.array([0.0, np.cos(a), -np.sin(a)])
    right = np.array([1.0, 0.0, 0.0])
    right, down = np.cos(b) * right + np.sin(b) * down, np.cos(b) * down - np.sin(b) * right
    front = np.array([right, down, ahead])
    return [Pinhole(axes, distance, pixel, size) for axes in (top, front)]


@dataclass(frozen=True)
class Look:
    """What images look like.

    Parameters
    ----------
    blur : float
        Standard deviation of the lens's blur, pixels.
    noise : float
        Standard deviation of the noise, grey values.
    side : float
        Brightening of one flank of the whisker by light from the side, grey values.
    quality : int
        Quality of JPEG compression of each frame; 0 for none.
    shine : float
        Grey value of a shiny peg, with a glint and a dark stripe; 0 for a dull dark one.
    fur : int
        Number of hairs at the face's edge, some of which lie over the base.
    """

    blur: float = 0.6
    noise: float = 2.0
    side: float = 0.0
    quality: int = 0
    shine: float = 0.0
    fur: int = 0


def film(trial, lenses, peg=None, look=None, seed=0, radii=(1e-4, 1e-4 / 15.0)):
    """Frames of every view (view, time) of a simulated trial's first whisker."""
    look, rng = look or Look(), np.random.default_rng(seed)
    nodes = trial["truth/centerline"].values[:, 0]
    share = np.linspace(0.0, 1.0, 6 * nodes.shape[1])
    lines = CubicSpline(np.linspace(0.0, 1.0, nodes.shape[1]), nodes, axis=1)(share)
    radius = np.linspace(*radii, lines.shape[1])
    return [_view(view, lines, radius, peg, look, rng) for view in lenses]


def _view(view, lines, radius, peg, look, rng):
    """Frames of one view: bright ground, dark face, peg and whisker."""
    still = Image.new("L", (view.size * FINE, view.size * FINE), 190)
    if peg is not None:
        _peg(ImageDraw.Draw(still), view, *peg, look.shine, rng)
    hairs = np.column_stack(
        [
            rng.normal(0.0, 0.5, look.fur),
            rng.normal(0.0, 0.5, look.fur),
            rng.gamma(4.0, 3.0, look.fur),
            rng.uniform(30.0, 110.0, look.fur),
        ]
    )
    frames = []
    for line in lines:
        shown = np.ones(len(line), bool) if peg is None else ~_behind(view, line, *peg)
        fine = still.copy()
        _whisker(ImageDraw.Draw(fine), view, line, radius, shown, look)
        _face(ImageDraw.Draw(fine), view, line, hairs)
        frames.append(_exposed(fine, look, rng))
    return frames


def _subpixels(pixels):
    return [tuple(p) for p in (np.asarray(pixels) + 0.5) * FINE]


def _disc(pen, center, radius, fill):
    (x, y), r = (np.asarray(center) + 0.5) * FINE, radius * FINE
    pen.ellipse([x - r, y - r, x + r, y + r], fill=int(fill))


def _peg(pen, view, origin, axis, size, shine, rng):
    """A cylinder, from its far end to its near one, or a bar if it is seen from aside."""
    ends = view(origin + np.outer([-HALF, HALF], axis))
    along = ends[1] - ends[0]
    half = np.linalg.norm(view(origin + size * view.axes[0]) - view(origin))
    share, place = np.linspace(-1.0, 1.0, 41), rng.uniform(-0.6, 0.6, 2)
    grey = np.full(41, 35.0)
    if shine:
        grey = shine * (1.0 + 0.2 * share)
        grey += (245.0 - grey) * np.exp(-0.5 * ((share - place[0]) / 0.12) ** 2)
        grey *= 1.0 - 0.85 * np.exp(-0.5 * ((share - place[1]) / 0.1) ** 2)
    if np.linalg.norm(along) < 12.0 * half:
        near = np.argsort([-(view.axes[2] @ (origin + t * axis)) for t in (-HALF, HALF)])
        for center in np.linspace(ends[near[0]], ends[near[1]], 40):
            _disc(pen, center, half, 0.5 * shine if shine else 35)
        if shine:
            _disc(pen, ends[near[1]], 0.8 * half, shine)
            _disc(pen, ends[near[1]] + 0.3 * half * place, 0.3 * half, 240)
        return
    across = half * np.array([-along[1], along[0]]) / np.linalg.norm(along)
    for a, b, fill in zip(share[:-1], share[1:], grey, strict=False):
        outline = [ends[0] + a * across, ends[1] + a * across]
        pen.polygon(
            _subpixels([*outline, *(p + (b - a) * across for p in outline[::-1])]), int(fill)
        )


def _behind(view, line, origin, axis, size):
    """Which points the peg hides: their line of sight meets it before the lens."""
    sight = -view.distance * view.axes[2] - line
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    flat = np.eye(3) - np.outer(axis, axis)
    way, away = sight @ flat, (line - origin) @ flat
    a, b = (way**2).sum(1), (way * away).sum(1)
    # The whisker is on the surface where it touches: what is one pixel deep is not hidden.
    inside = b**2 - a * ((away**2).sum(1) - (size - 0.5 * view.pixel) ** 2)
    hidden = np.zeros(len(line), bool)
    for side in (-1.0, 1.0):
        ahead = (-b + side * np.sqrt(np.maximum(inside, 0.0))) / a
        along = (line + ahead[:, None] * sight - origin) @ axis
        hidden |= (inside > 0.0) & (ahead > 0.0) & (np.abs(along) < HALF)
    return hidden


def _whisker(pen, view, line, radius, shown, look):
    pixels = view(line)
    tangent = np.gradient(pixels, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1) * (radius / view.pixel)[:, None]
    for part in np.split(np.arange(len(line)), np.flatnonzero(np.diff(shown)) + 1):
        if len(part) < 2 or not shown[part[0]]:
            continue
        p, a = pixels[part], across[part]
        pen.polygon(_subpixels(np.concatenate([p + a, (p - a)[::-1]])), fill=45)
        if look.side:
            flank = np.concatenate([p + a, (p + 0.3 * a)[::-1]])
            pen.polygon(_subpixels(flank), fill=int(45 + look.side))


def _face(pen, view, line, hairs, size=2.5e-3):
    """A dark face that ends where the whisker begins, with hairs at its edge."""
    pixels = view(line[:2])
    tangent = np.diff(pixels, axis=0)[0]
    tangent /= np.linalg.norm(tangent)
    left, r = np.array([-tangent[1], tangent[0]]), size / view.pixel
    back = pixels[0] - r * tangent
    _disc(pen, back, r, 25)
    far = back - tangent * 400.0
    pen.polygon(
        _subpixels(
            [back + 1.2 * r * left, back - 1.2 * r * left, far - 5 * r * left, far + 5 * r * left]
        ),
        fill=25,
    )
    for at, turn, length, grey in hairs:
        spoke = np.cos(at) * tangent + np.sin(at) * left
        way = np.cos(at + turn) * tangent + np.sin(at + turn) * left
        root = back + (r - 2.0) * spoke
        pen.line(_subpixels([root, root + length * way]), fill=int(grey), width=FINE // 2)


def _exposed(fine, look, rng):
    """Blur, pixels, noise and compression."""
    size = fine.size[0] // FINE
    image = fine.filter(ImageFilter.GaussianBlur(look.blur * FINE))
    image = np.asarray(image, dtype=float).reshape(size, FINE, size, FINE).mean((1, 3))
    image = image + rng.normal(0.0, look.noise, image.shape)
    grey = np.clip(np.round(image), 0, 255).astype(np.uint8)
    if look.quality:
        file = io.BytesIO()
        Image.fromarray(grey).save(file, "JPEG", quality=look.quality)
        grey = np.asarray(Image.open(file))
    return grey
