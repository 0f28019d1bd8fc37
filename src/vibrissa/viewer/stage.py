"""Drawings onto the page: things are added, changed or taken away by name."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import viser

from vibrissa.viewer.drawing import Arrows, Body, Cloud, Drawing, Label, Line, Painted, Thing
from vibrissa.viewer.glb import glb


def lit(scene: viser.SceneApi) -> None:
    """Light a scene from above and a little from everywhere.

    Reflections of a surrounding, which viser lights with, take most of the time of a frame where
    there is no graphics card, and nothing here is shiny; so do shadows.
    """
    scene.configure_environment_map(None)
    scene.configure_default_lights(cast_shadow=False)
    scene.add_light_hemisphere(
        "/light",
        sky_color=(255, 255, 255),
        ground_color=(200, 205, 215),
        intensity=2.0,
        position=(0.0, 0.0, 1.0),
    )


class Stage:
    """The 3D scene of a server, in layers of things by name."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._shown: dict[str, dict[str, tuple[Thing, viser.SceneNodeHandle]]] = {}

    def show(self, layer: str, drawing: Drawing) -> None:
        """Make a layer look like a drawing; all changes come into sight together."""
        before = self._shown.get(layer, {})
        after: dict[str, tuple[Thing, viser.SceneNodeHandle]] = {}
        with self._server.atomic():
            for name in before.keys() - drawing.keys():
                before[name][1].remove()
            for name, thing in drawing.items():
                old = before.get(name)
                if old is not None and (old[0] is thing or _changed(old[1], old[0], thing)):
                    after[name] = (thing, old[1])
                else:
                    after[name] = (thing, self._added(f"/{layer}/{name}", thing))
        self._shown[layer] = after

    def node(self, layer: str, name: str) -> viser.SceneNodeHandle | None:
        """What stands for a thing on the page, if it does."""
        found = self._shown.get(layer, {}).get(name)
        return None if found is None else found[1]

    def _added(self, path: str, thing: Thing) -> viser.SceneNodeHandle:
        scene = self._server.scene
        match thing:
            case Body():
                return scene.add_mesh_simple(
                    path,
                    thing.vertices,
                    thing.faces,
                    color=thing.colour,
                    opacity=thing.opacity,
                    side=thing.side,
                    position=thing.place,
                    cast_shadow=False,
                    receive_shadow=False,
                )
            case Painted():
                content = glb(thing.triangles, thing.colours, thing.opacity, thing.side)
                return scene.add_glb(path, content, cast_shadow=False, receive_shadow=False)
            case Cloud():
                return scene.add_point_cloud(
                    path,
                    thing.points,
                    thing.colours,
                    point_size=thing.size,
                    point_shape="circle",
                    precision="float32",
                )
            case Arrows():
                return scene.add_arrows(
                    path,
                    np.stack([thing.start, thing.end], axis=1),
                    thing.colours,
                    shaft_radius=thing.thickness,
                    head_radius=2.4 * thing.thickness,
                    head_length=6.0 * thing.thickness,
                )
            case Line():
                return scene.add_line_segments(
                    path,
                    thing.pieces,
                    thing.colour,
                    thickness=thing.width,
                    thickness_units="screen",
                )
            case Label():
                return scene.add_label(
                    path, thing.text, position=_vector(thing.position), anchor="bottom-left"
                )


def _changed(handle: viser.SceneNodeHandle, old: Thing, new: Thing) -> bool:
    """Change what is on the page into a new thing, if it is near enough to the old one."""
    node = cast(Any, handle)  # every kind has attributes of its own
    match old, new:
        case Body(), Body() if old.side == new.side and _same_faces(old, new):
            if new.vertices is not old.vertices:
                node.vertices = new.vertices.astype(np.float32)
            node.color, node.opacity = new.colour, new.opacity
            if new.place != old.place:
                node.position = new.place
        case Cloud(), Cloud() if old.size == new.size:
            node.points, node.colors = new.points.astype(np.float32), new.colours
        case Arrows(), Arrows() if _like(old, new):
            node.points = np.stack([new.start, new.end], axis=1).astype(np.float32)
        case Line(), Line() if _alike(old, new):
            node.points = new.pieces.astype(np.float32)
        case Label(), Label():
            node.text, node.position = new.text, _vector(new.position)
        case _:
            return False
    return True


def _same_faces(old: Body, new: Body) -> bool:
    return old.faces is new.faces or np.array_equal(old.faces, new.faces)


def _like(old: Arrows, new: Arrows) -> bool:
    return old.thickness == new.thickness and np.array_equal(old.colours, new.colours)


def _alike(old: Line, new: Line) -> bool:
    look = (old.colour, old.width, old.pieces.shape)
    return look == (new.colour, new.width, new.pieces.shape)


def _vector(values: Any) -> tuple[float, float, float]:
    x, y, z = np.asarray(values, dtype=np.float64).tolist()
    return x, y, z
