"""Display of drawings on the page: named objects are added, changed and removed.

A surface with vertex colours is sent to the browser as a GLB file (binary glTF 2.0) with the
material `KHR_materials_unlit`, as lighting a surface in the browser is many times slower than
interpolating its colours, and colours that represent numbers must not depend on the light. Slight
shading, which makes the shape visible, is included in the colours. The page's tone mapping (ACES,
as in three.js), which would make colours paler than those of the legend, is inverted beforehand.
"""

from __future__ import annotations

import json
import struct
from typing import Any, cast

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from vibrissa.numerics import Array
from vibrissa.scene import (
    Arrows,
    Body,
    Bytes,
    Cloud,
    Drawing,
    Ints,
    Label,
    Line,
    Mark,
    Painted,
    Side,
)


def lit(scene: viser.SceneApi) -> None:
    """Set the lights of a scene: one from above, and weak ambient light.

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
    """The 3D scene of a server, in layers of named objects."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._shown: dict[str, dict[str, tuple[Mark, viser.SceneNodeHandle]]] = {}

    def show(self, layer: str, drawing: Drawing) -> None:
        """Update a layer to a drawing; all changes become visible together."""
        before = self._shown.get(layer, {})
        after: dict[str, tuple[Mark, viser.SceneNodeHandle]] = {}
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
        """Scene node of an object; None if it does not exist."""
        found = self._shown.get(layer, {}).get(name)
        return None if found is None else found[1]

    def _added(self, path: str, thing: Mark) -> viser.SceneNodeHandle:
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
                    position=thing.position,
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
                position = triple(thing.position)
                return scene.add_label(path, thing.text, position=position, anchor="bottom-left")


def _changed(handle: viser.SceneNodeHandle, old: Mark, new: Mark) -> bool:
    """Change an object into a similar new one; return whether this is possible."""
    node = cast(Any, handle)  # each kind of node has other attributes
    match old, new:
        case Body(), Body() if old.side == new.side and np.array_equal(old.faces, new.faces):
            if new.vertices is not old.vertices:
                node.vertices = new.vertices.astype(np.float32)
            node.color, node.opacity = new.colour, new.opacity
            if new.position != old.position:
                node.position = new.position
        case Cloud(), Cloud() if old.size == new.size:
            node.points, node.colors = new.points.astype(np.float32), new.colours
        case Arrows(), Arrows() if old.thickness == new.thickness and np.array_equal(
            old.colours, new.colours
        ):
            node.points = np.stack([new.start, new.end], axis=1).astype(np.float32)
        case Line(), Line() if (old.colour, old.width, old.pieces.shape) == (
            new.colour,
            new.width,
            new.pieces.shape,
        ):
            node.points = new.pieces.astype(np.float32)
        case Label(), Label():
            node.text, node.position = new.text, triple(new.position)
        case _:
            return False
    return True


def triple(values: ArrayLike) -> tuple[float, float, float]:
    """Three numbers as a tuple."""
    x, y, z = np.asarray(values, dtype=np.float64).tolist()
    return x, y, z


_TO_LIGHT = np.array([-0.25, -0.55, 0.8]) / np.linalg.norm([-0.25, -0.55, 0.8])
_SHADE = 0.75  # brightness of surfaces in grazing light, over the full brightness
# ACES filmic tone mapping of three.js: in, a curve per channel, out; and its exposure.
_IN = np.array(
    [[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]]
)
_OUT = np.array(
    [[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]]
)
_EXPOSURE = 1.0 / 0.6
_WELD = 1e-6


def glb(
    triangles: Array, colours: Bytes, opacity: float | None = None, side: Side = "double"
) -> bytes:
    """Write triangles with coloured corners as a GLB file."""
    # The brightness of each triangle is the same from both sides.
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    size = np.linalg.norm(across, axis=1)
    facing = np.abs(across @ _TO_LIGHT) / np.where(size > 0.0, size, 1.0)
    shades = np.repeat(_SHADE + (1.0 - _SHADE) * facing, 3)
    vertices, first, which = _welded(triangles.reshape(-1, 3))
    shade = np.bincount(which, shades) / np.bincount(which)
    seen = colours.reshape(-1, 3)[first] * (shade[:, None] / 255.0)
    faces = which.reshape(-1, 3)
    if side == "back":
        faces = faces[:, ::-1]
    material: dict[str, Any] = {
        "extensions": {"KHR_materials_unlit": {}},
        "doubleSided": side == "double",
        "pbrMetallicRoughness": {"baseColorFactor": [1.0, 1.0, 1.0, 1.0]},
    }
    if opacity is not None:
        material["alphaMode"] = "BLEND"
        material["pbrMetallicRoughness"]["baseColorFactor"][3] = opacity
    # From sRGB to linear light.
    linear = np.where(seen <= 0.04045, seen / 12.92, ((seen + 0.055) / 1.055) ** 2.4)
    return _file(vertices, before_tone_mapping(linear), faces, material)


def before_tone_mapping(light: Array) -> Array:
    """Inverse of the page's tone mapping for light (..., 3)."""
    y = np.clip(light, 0.0, 1.0) @ np.linalg.inv(_OUT).T
    a, b, c = 1.0 - 0.983729 * y, 0.0245786 - 0.432951 * y, -(0.000090537 + 0.238081 * y)
    curve = (-b + np.sqrt(np.maximum(b * b - 4.0 * a * c, 0.0))) / (2.0 * a)
    return np.asarray(np.maximum(curve @ np.linalg.inv(_IN).T, 0.0) / _EXPOSURE)


def _welded(corners: Array) -> tuple[Array, Ints, Ints]:
    """Distinct vertices (m, 3), the first corner at each (m,), and the vertex of each corner."""
    size = float(np.ptp(corners)) or 1.0
    cells = np.round(corners / (_WELD * size)).astype(np.int64)
    _, first, which = np.unique(cells, return_index=True, return_inverse=True, axis=0)
    return corners[first], first, which.ravel()


def _file(vertices: Array, colours: Array, faces: Ints, material: dict[str, Any]) -> bytes:
    """GLB file of vertices (n, 3) with linear colours (n, 3), triangles and a material."""
    parts: list[NDArray[Any]] = [
        np.asarray(vertices, dtype="<f4"),
        np.asarray(colours, dtype="<f4"),
        np.asarray(faces, dtype="<u4").ravel(),
    ]
    views: list[dict[str, int]] = []
    accessors: list[dict[str, Any]] = []
    start = 0
    for part, kind in zip(parts, ("VEC3", "VEC3", "SCALAR"), strict=True):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": part.nbytes})
        number = 5126 if part.dtype.kind == "f" else 5125
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": number,
                "count": len(part),
                "type": kind,
            }
        )
        start += part.nbytes
    accessors[0] |= {"min": parts[0].min(axis=0).tolist(), "max": parts[0].max(axis=0).tolist()}
    mesh = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
    tree = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [mesh]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(part.tobytes() for part in parts)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
