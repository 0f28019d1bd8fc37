"""Painted surfaces as files: where they are, from where they are seen, and in which colours."""

import json
import struct

import numpy as np
import pytest

from vibrissa.viewer.stage import before_tone_mapping, glb


def filmic(light):
    """The page's tone mapping, as three.js writes it (ACES filmic, exposure 1)."""
    v = (light / 0.6) @ [
        [0.59719, 0.076, 0.0284],
        [0.35458, 0.90834, 0.13383],
        [0.04823, 0.01566, 0.83777],
    ]
    v = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.4329510) + 0.238081)
    return v @ [
        [1.60475, -0.10208, -0.00327],
        [-0.53108, 1.10813, -0.07276],
        [-0.07367, -0.00605, 1.07602],
    ]


def read(content):
    """Header, places, colours and faces of a file."""
    magic, version, size = struct.unpack("<4sII", content[:12])
    assert (magic, version, size) == (b"glTF", 2, len(content))
    length, kind = struct.unpack("<I4s", content[12:20])
    assert (kind, length % 4) == (b"JSON", 0)
    tree = json.loads(content[20 : 20 + length])
    body = content[28 + length :]
    assert len(body) == tree["buffers"][0]["byteLength"]
    parts = []
    for accessor in tree["accessors"]:
        view = tree["bufferViews"][accessor["bufferView"]]
        dtype = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        part = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        parts.append(np.frombuffer(part, dtype).reshape(accessor["count"], -1))
    return tree, parts[0], parts[1], parts[2].reshape(-1, 3)


@pytest.fixture
def square():
    """Two triangles in the plane z = 0 with a common edge."""
    corners = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    triangles = corners[[[0, 1, 2], [0, 2, 3]]]
    colours = np.array([[10, 20, 30], [200, 100, 0], [90, 90, 90], [0, 250, 120]], np.uint8)
    return triangles, colours[[[0, 1, 2], [0, 2, 3]]]


def test_the_screen_shows_the_colours_that_are_asked_for():
    colours = np.random.default_rng(0).uniform(0.02, 0.75, (500, 3))
    seen = filmic(before_tone_mapping(colours))
    inside = (before_tone_mapping(colours) > 0.0).all(axis=1)  # the rest is beyond what it can show
    assert inside.mean() > 0.9
    np.testing.assert_allclose(seen[inside], colours[inside], atol=1e-4)


def test_corners_at_one_place_are_one(square):
    tree, places, colours, faces = read(glb(*square))
    assert len(places) == len(colours) == 4
    np.testing.assert_allclose(np.sort(places[faces], axis=0), np.sort(square[0], axis=0))
    assert tree["materials"][0]["doubleSided"] is True
    assert "alphaMode" not in tree["materials"][0]


def test_what_is_seen_from_its_back_is_turned_around(square):
    def normals(side):
        _, places, _, faces = read(glb(*square, 0.5, side))
        a, b, c = places[faces].transpose(1, 0, 2)
        return np.cross(b - a, c - a)[:, 2]

    assert (normals("front") > 0.0).all()
    assert (normals("back") < 0.0).all()
    tree, *_ = read(glb(*square, 0.5, "back"))
    material = tree["materials"][0]
    assert (material["doubleSided"], material["alphaMode"]) == (False, "BLEND")
    assert material["pbrMetallicRoughness"]["baseColorFactor"][3] == 0.5
