"""From where everyone looks: what is shown stands in the middle of what the panel leaves free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser

from vibrissa.viewer.drawing import Array

PANEL = 0.52
"""Width of the panel and its margin, over the height of a usual window; in a narrow one at most
half of the width counts. How many pixels it has is not known: screens have one or more to each of
the page's."""

_WIDTH = 1.25
"""How wide what is shown is, over the distance from which it is looked at."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A place to be looked at."""

    centre: Array
    distance: float
    way: Array


def framed(shot: Shot, width: float, height: float, fov: float) -> tuple[Array, Array]:
    """Where someone stands and looks, mm, whose window is so large."""
    free = max(width - PANEL * height, 0.5 * width)
    across = 2.0 * np.tan(0.5 * fov) / height  # of a pixel, over the distance
    distance = shot.distance * max(1.0, _WIDTH / (free * across))
    direction = shot.way / np.linalg.norm(shot.way)
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= np.linalg.norm(right)
    middle = shot.centre + 0.5 * (width - free) * across * distance * right
    return middle + distance * direction, middle


class Framing:
    """Lets everyone look at a shot, now and when they come."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._shot: Shot | None = None
        server.on_client_connect(self._came)

    def show(self, shot: Shot) -> None:
        """Let everyone look at this."""
        self._shot = shot
        camera = self._server.initial_camera
        place, target = framed(shot, 1280.0, 720.0, camera.fov)
        camera.position, camera.look_at = _triple(place), _triple(target)
        for client in self._server.get_clients().values():
            self._turn(client, shot)

    def _came(self, client: viser.ClientHandle) -> None:
        if self._shot is not None:
            self._turn(client, self._shot)

    def _turn(self, client: viser.ClientHandle, shot: Shot) -> None:
        camera = client.camera
        place, target = framed(shot, camera.image_width, camera.image_height, camera.fov)
        with client.atomic():
            camera.position = _triple(place)
            camera.look_at = _triple(target)


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
