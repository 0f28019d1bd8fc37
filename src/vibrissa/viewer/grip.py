"""What is taken hold of with the mouse: a ball that goes anywhere, and arrows along the axes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import viser
from numpy.typing import ArrayLike
from viser import transforms

from vibrissa.quantities import quantity
from vibrissa.viewer.drawing import Array
from vibrissa.viewer.meshes import across

_MM = quantity("length").display_factor

Moved = Callable[[Array, Array], None]
"""Called with the place (3,), m, and the orientation (3, 3) to which it was dragged."""


class Grip:
    """A ball and a gizmo at one place of the scene."""

    def __init__(self, server: viser.ViserServer, size: float, moved: Moved) -> None:
        self._moved = moved
        self._gizmo = server.scene.add_transform_controls(
            "/grip",
            scale=size,
            line_width=2.5,
            disable_rotations=True,
            depth_test=False,
            opacity=0.75,
            visible=False,
        )
        self._ball = server.scene.add_icosphere(
            "/grip ball",
            radius=0.096 * size,
            color=(213, 94, 0),
            subdivisions=2,
            opacity=0.35,
            side="front",
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
        )
        self._turning = False
        self._by_ball = False

        # Coroutines run one after the other, so that no older place can overtake a newer one.
        @self._gizmo.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            if event.phase == "update":
                self._by_ball = False
                self._tell(event.target.position)

        @self._ball.on_drag
        async def _(event: viser.SceneNodeDragEvent[viser.IcosphereHandle]) -> None:
            # What is not held would only be drawn in vain.
            self._gizmo.visible = event.phase == "end" and self._ball.visible
            if event.phase == "update":
                self._by_ball = True
                self._tell(event.end_position)

    def _tell(self, place: ArrayLike) -> None:
        turn = np.array(transforms.SO3(self._gizmo.wxyz).as_matrix(), dtype=np.float64)
        self._moved(np.array(place, dtype=np.float64) / _MM, turn)

    def follow(self, place: Array) -> None:
        """Be where it was dragged to, (3,), m, as far as the mouse does not do that itself."""
        x, y, z = (_MM * place).tolist()
        self._ball.position = (x, y, z)
        if self._by_ball:
            self._gizmo.position = (x, y, z)

    def show(self, place: Array | None, axis: Array | None = None) -> None:
        """Stand at a place (3,), m; with arcs that turn an axis, if there is one; None hides it."""
        if place is not None:
            x, y, z = (_MM * place).tolist()
            self._gizmo.position = self._ball.position = (x, y, z)
        if axis is not None:
            first, second = across(axis)
            turn = np.stack([first, second, axis / np.linalg.norm(axis)], axis=1)
            self._gizmo.wxyz = transforms.SO3.from_matrix(turn).wxyz
        elif self._turning:
            self._gizmo.wxyz = (1.0, 0.0, 0.0, 0.0)
        if (axis is not None) != self._turning:
            self._turning = axis is not None
            self._gizmo.disable_rotations = not self._turning
        self._gizmo.visible = self._ball.visible = place is not None

    def remove(self) -> None:
        """Take it away."""
        self._gizmo.remove()
        self._ball.remove()
