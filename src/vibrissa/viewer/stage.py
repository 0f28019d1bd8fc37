"""Drawings onto the page: things are added, changed or taken away by name."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import trimesh
import viser

from vibrissa.viewer.drawing import Arrow, Body, Bytes, Cloud, Drawing, Label, Line, Painted, Thing


class Stage:
    """The 3D scene of a server, in layers of things by name.

    Parameters
    ----------
    server : viser.ViserServer
        Whose scene.
    """

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
                    cast_shadow=thing.opacity is None,
                    receive_shadow=False,
                )
            case Painted():
                return scene.add_mesh_trimesh(
                    path, _coloured(thing), cast_shadow=False, receive_shadow=False
                )
            case Cloud():
                return scene.add_point_cloud(
                    path,
                    thing.points,
                    thing.colours,
                    point_size=thing.size,
                    point_shape="circle",
                    precision="float32",
                )
            case Arrow():
                return scene.add_arrows(
                    path,
                    np.stack([thing.start, thing.end])[None],
                    thing.colour,
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


def _coloured(thing: Painted) -> trimesh.Trimesh:
    """A mesh that is dull, seen from both sides, and has the colours of its corners."""
    count = 3 * len(thing.triangles)
    mesh = trimesh.Trimesh(
        thing.triangles.reshape(-1, 3), np.arange(count).reshape(-1, 3), process=False
    )
    dull = trimesh.visual.material.PBRMaterial(
        metallicFactor=0.0, roughnessFactor=0.9, doubleSided=True
    )
    mesh.visual = trimesh.visual.TextureVisuals(material=dull)
    opaque = np.full((count, 1), 255, dtype=np.uint8)
    colours = _linear(thing.colours.reshape(-1, 3))
    mesh.visual.vertex_attributes["color"] = np.concatenate([colours, opaque], axis=1)
    return mesh


def _linear(colours: Bytes) -> Bytes:
    """Colours as light, which meshes with colours of their own are given in."""
    share = colours / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.round(255.0 * light), dtype=np.uint8)


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
        case Arrow(), Arrow() if (old.colour, old.thickness) == (new.colour, new.thickness):
            node.points = np.stack([new.start, new.end])[None].astype(np.float32)
        case Line(), Line() if _alike(old, new):
            node.points = new.pieces.astype(np.float32)
        case Label(), Label():
            node.text, node.position = new.text, _vector(new.position)
        case _:
            return False
    return True


def _same_faces(old: Body, new: Body) -> bool:
    return old.faces is new.faces or np.array_equal(old.faces, new.faces)


def _alike(old: Line, new: Line) -> bool:
    look = (old.colour, old.width, old.pieces.shape)
    return look == (new.colour, new.width, new.pieces.shape)


def _vector(values: Any) -> tuple[float, float, float]:
    x, y, z = np.asarray(values, dtype=np.float64).tolist()
    return x, y, z
