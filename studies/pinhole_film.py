"""Films by a renderer of its own: polygons, supersampled, seen through pinhole lenses.

It shares nothing with the simulation's film maker but the true positions of the whisker: cameras
are the equations of a pinhole, bodies are filled polygons, and edges are softened by averaging
subpixels. `Film` gives frames of two views; tracking is judged with what it was drawn from.
"""

import io
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

FINE = 5
"""Subpixels of a pixel along each side."""


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
    """

    blur: float = 0.6
    noise: float = 2.0
    side: float = 0.0
    quality: int = 0


def draw(view, line, radius, peg=None, look=None, rng=None, face=2.5e-3):
    """One image (rows, columns): bright ground, dark face, peg and whisker."""
    look, rng = look or Look(), rng or np.random.default_rng(0)
    fine = Image.new("L", (view.size * FINE, view.size * FINE), 190)
    pen = ImageDraw.Draw(fine)

    def subpixels(pixels):
        return [tuple(p) for p in (np.asarray(pixels) + 0.5) * FINE]

    if peg is not None:
        origin, axis, size = peg
        ends = view(origin + np.outer([-25e-3, 25e-3], axis))
        along = ends[1] - ends[0]
        half = size / view.pixel
        if np.linalg.norm(along) < 6.0 * half:
            x, y = view(np.asarray(origin))
            box = [(x - half + 0.5) * FINE, (y - half + 0.5) * FINE]
            pen.ellipse([*box, (x + half + 0.5) * FINE, (y + half + 0.5) * FINE], fill=35)
        else:
            across = half * np.array([-along[1], along[0]]) / np.linalg.norm(along)
            outline = [ends[0] + across, ends[1] + across, ends[1] - across, ends[0] - across]
            pen.polygon(subpixels(outline), fill=35)
    pixels = view(line)
    tangent = np.gradient(pixels, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1) * (radius / view.pixel)[:, None]
    pen.polygon(subpixels(np.concatenate([pixels + across, (pixels - across)[::-1]])), fill=45)
    if look.side:
        flank = np.concatenate([pixels + across, (pixels + 0.3 * across)[::-1]])
        pen.polygon(subpixels(flank), fill=int(45 + look.side))
    # The face ends where the whisker begins.
    back = pixels[0] - tangent[0] * face / view.pixel
    r = face / view.pixel
    box = [*((back - r + 0.5) * FINE), *((back + r + 0.5) * FINE)]
    pen.ellipse(box, fill=25)
    far = back - tangent[0] * 400.0
    side = 1.2 * r * np.array([-tangent[0, 1], tangent[0, 0]])
    pen.polygon(subpixels([back + side, back - side, far - 4 * side, far + 4 * side]), fill=25)
    image = fine.filter(ImageFilter.GaussianBlur(look.blur * FINE))
    image = np.asarray(image, dtype=float).reshape(view.size, FINE, view.size, FINE).mean((1, 3))
    image = image + rng.normal(0.0, look.noise, image.shape)
    grey = np.clip(np.round(image), 0, 255).astype(np.uint8)
    if look.quality:
        file = io.BytesIO()
        Image.fromarray(grey).save(file, "JPEG", quality=look.quality)
        grey = np.asarray(Image.open(file))
    return grey


def film(trial, lenses, peg=None, look=None, seed=0, radii=(1e-4, 1e-4 / 15.0)):
    """Frames of every view (view, time) of a simulated trial's first whisker."""
    rng = np.random.default_rng(seed)
    lines = trial["truth/centerline"].values[:, 0]
    radius = np.linspace(*radii, lines.shape[1])
    return [[draw(view, line, radius, peg, look, rng) for line in lines] for view in lenses]
