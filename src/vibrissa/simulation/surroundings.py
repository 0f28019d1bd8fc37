"""Surroundings of the whiskers in a synthetic video: fur with hairs, the animal's cheek, wires.

The texture and hairs of the fur and the cheek move with the face; textures move by whole pixels.
None of these is part of the recorded truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras import Camera
from vibrissa.deferred import ndimage
from vibrissa.numerics import Array

Image = NDArray[np.float32]

# Standard deviations of the fur's texture across and along its hairs, and of its tufts, pixels.
_GRAIN, _ALONG, _COARSE = 0.8, 3.0, 6.0
_APART = 4.0  # spacing of hairs along the outline of the face, pixels
_HAIR = (4.0, 4.0)  # shape and scale, pixels, of the distribution of the lengths of hairs
_THICKNESS = (0.3, 0.7)  # smallest and largest half width of a hair, pixels
_WIRE = (0.6, 1.6)  # smallest and largest half width of a wire, pixels
# Smallest and largest length of the cheek, relative to the longest whisker in the image.
_BEHIND = (0.35, 0.5)
_CHEEK = 48.0  # grey value of the cheek


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
        cls, camera: Camera, fur: float, cheek: float, wires: int, extent: float, seed: int
    ) -> Surroundings:
        """Generate surroundings at random; ``extent`` is the length of whiskers, pixels."""
        random = np.random.default_rng([seed, 11])
        width, height = camera.size
        texture = np.zeros((height, width), dtype=np.float32)
        hairs: list[Array] = []
        if fur > 0.0 or cheek > 0.0:
            fine = ndimage.gaussian_filter(random.normal(size=texture.shape), (_GRAIN, _ALONG))
            tufts = ndimage.gaussian_filter(random.normal(size=texture.shape), _COARSE)
            texture += (fine / fine.std() + 0.5 * tufts / tufts.std()).astype(np.float32)
            texture *= max(fur, 0.1 * _CHEEK if cheek > 0.0 else 0.0)
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
        lines = [_wire(width, height, random) for _ in range(int(wires))]
        return cls(texture, hairs, lines, far, cheek)

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
        grey = _CHEEK + np.roll(self.texture, (row, shift), (0, 1))
        np.maximum(grey, 2.0, out=grey)
        behind = share[None].astype(np.float32)
        light += (grey - light) * behind
        return np.asarray(1.0 - behind * (1.0 - min(self.contrast / _CHEEK, 1.0)), np.float32)

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
