"""Solids of arbitrary shape, given by closed triangle meshes.

A mesh is taken as a sample of a smooth body; whiskers slide over that body, not over facets. The
signed distance from the triangles is computed exactly at the nodes of a grid near the surface, with
the sign from the angle-weighted normals of Bærentzen & Aanæs (IEEE Trans. Vis. Comput. Graph. 11
(2005) 243-253). The cubic B-spline through the nodes is the signed distance used: it is twice
continuously differentiable, so that a contact can be followed over edges, which it rounds by about
the grid spacing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import ndimage
from vibrissa.numerics import Array, numbers
from vibrissa.objects.surface import Surface

Ints = NDArray[np.int64]

NODES = 1_200_000  # approximate number of nodes of the grid if no spacing is given
_MOST = 30_000_000
_BAND = 3
_PADDING = 8  # cells around the body, for the whisker's radius and the decay of the spline's ends
# B-spline weights of four neighbours at the fraction t between the middle two, as polynomials in t:
# rows are powers of t, columns are neighbours.
_SPLINE = (
    np.array(
        [[1.0, 4.0, 1.0, 0.0], [-3.0, 0.0, 3.0, 0.0], [3.0, -6.0, 3.0, 0.0], [-1.0, 3.0, -3.0, 1.0]]
    )
    / 6.0
)


@dataclass(frozen=True, eq=False)
class Mesh(Surface):
    """A solid bounded by a closed mesh of triangles.

    Parameters
    ----------
    vertices : array_like (n, 3)
        Vertices in the laboratory frame, m.
    faces : array_like of int (m, 3)
        Indices of each triangle's vertices, with consistent orientation.
    resolution : float, optional
        Grid spacing of the signed distance, m, which limits the detail; by default there are about
        a million nodes.
    stiffness : float
        Force over indentation, N/m; infinite if rigid.

    Raises
    ------
    ValueError
        If values are missing, the mesh is not closed, or the resolution needs too large a grid.

    Examples
    --------
    >>> corners = [[0, 0, 0], [4e-3, 0, 0], [0, 4e-3, 0], [0, 0, 4e-3]]
    >>> Mesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], resolution=0.2e-3)
    Mesh(4 vertices, 4 triangles, 4.000 × 4.000 × 4.000 mm, resolution 0.200 mm)
    """

    vertices: Array
    faces: Ints
    resolution: float | None = None
    stiffness: float = np.inf
    _low: Array = field(init=False, repr=False)
    _spline: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the mesh and compute its signed distance."""
        vertices = numbers("vertices", self.vertices).copy()
        faces = np.array(self.faces, dtype=np.int64)
        _check_mesh(vertices, faces, self.stiffness)
        if _volume(vertices, faces) < 0.0:
            faces = np.ascontiguousarray(faces[:, ::-1])
        size = np.ptp(vertices, axis=0)
        spacing = self.resolution
        spacing = _spacing(size) if spacing is None else float(spacing)
        shape = np.ceil(size / spacing).astype(int) + 1 + 2 * _PADDING if spacing > 0.0 else None
        if shape is None or not np.isfinite(spacing) or np.prod(shape.astype(float)) > _MOST:
            raise ValueError(
                f"no mesh: resolution is {self.resolution!r} m for a body of {_mm(size)}; a "
                f"positive one that needs no more than {_MOST} nodes is needed"
            )
        low = vertices.min(axis=0) - _PADDING * spacing
        distance = _grid_distance(vertices, faces, low, spacing, tuple(shape.tolist()))
        values: dict[str, Any] = {
            "vertices": vertices,
            "faces": faces,
            "resolution": spacing,
            "stiffness": float(self.stiffness),
            "_low": low,
            "_spline": ndimage.spline_filter(distance, order=3, mode="nearest"),
        }
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)

    @classmethod
    def load(
        cls,
        path: str | PathLike[str],
        unit: float = 1e-3,
        *,
        resolution: float | None = None,
        stiffness: float = np.inf,
    ) -> Mesh:
        """Read a mesh from a file, in laboratory coordinates.

        Parameters
        ----------
        path : str or path
            STL, OBJ, PLY or other file that trimesh can read.
        unit : float
            Unit of the file's lengths, m; by default a millimetre.
        resolution, stiffness : float, optional
            Grid spacing and stiffness of the surface; see `Mesh`.

        Returns
        -------
        Mesh
            Body in the file.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ModuleNotFoundError
            If trimesh is not installed.
        ValueError
            If the file does not contain a closed mesh.
        """
        if not Path(path).exists():
            raise FileNotFoundError(f"there is no file {path}")
        try:
            import trimesh
        except ImportError as error:
            raise ModuleNotFoundError(
                "meshes are read by trimesh: pip install 'vibrissa[mesh]'"
            ) from error
        body = trimesh.load_mesh(Path(path))
        if not isinstance(body, trimesh.Trimesh):
            raise ValueError(f"{path} holds no mesh of triangles")
        body.merge_vertices()
        vertices = np.asarray(body.vertices, dtype=np.float64) * unit
        return cls(vertices, np.asarray(body.faces), resolution, stiffness)

    @property
    def origin(self) -> Array:
        """Centre of the bounding box, m."""
        return np.asarray(0.5 * (self.vertices.min(axis=0) + self.vertices.max(axis=0)))

    def _distance(self, points: Array) -> Array:
        at = (points - self._low) / self._step
        inside = np.clip(at, 0.0, np.array(self._spline.shape) - 1.0)
        values = ndimage.map_coordinates(
            self._spline, inside.reshape(-1, 3).T, order=3, mode="nearest", prefilter=False
        )
        distance: Array = values.reshape(at.shape[:-1]) + self._step * np.linalg.norm(
            at - inside, axis=-1
        )
        return distance

    def _geometry(self, point: Array) -> tuple[float, Array, Array]:
        at = (point - self._low) / self._step
        # Beyond the grid there is no contact, so any normal will do.
        at = np.clip(at, 1.0, np.array(self._spline.shape) - 3.0 + 1e-9)
        first = np.floor(at).astype(int) - 1
        t = at - first - 1.0
        powers = np.stack([np.ones(3), t, t * t, t**3])
        slopes = np.stack([np.zeros(3), np.ones(3), 2.0 * t, 3.0 * t * t])
        bends = np.stack([np.zeros(3), np.zeros(3), np.full(3, 2.0), 6.0 * t])
        # Values and first two derivatives along each axis, contracted one axis at a time.
        along = np.stack([powers, slopes, bends]).transpose(2, 0, 1) @ _SPLINE
        i, j, k = first
        block = self._spline[i : i + 4, j : j + 4, k : k + 4]
        part = along[1] @ (block @ along[2].T)
        part = (along[0] @ part.reshape(4, 9)).reshape(3, 3, 3)
        value = float(part[0, 0, 0])
        gradient = np.array([part[1, 0, 0], part[0, 1, 0], part[0, 0, 1]]) / self._step
        hessian = (
            np.array(
                [
                    [part[2, 0, 0], part[1, 1, 0], part[1, 0, 1]],
                    [part[1, 1, 0], part[0, 2, 0], part[0, 1, 1]],
                    [part[1, 0, 1], part[0, 1, 1], part[0, 0, 2]],
                ]
            )
            / self._step**2
        )
        size = float(np.linalg.norm(gradient))
        normal = gradient / size
        turn = (np.eye(3) - np.outer(normal, normal)) @ hessian / size
        return value, normal, turn

    @property
    def _step(self) -> float:
        """Grid spacing, m."""
        assert self.resolution is not None
        return self.resolution

    def __repr__(self) -> str:
        size = np.ptp(self.vertices, axis=0)
        soft = "" if np.isinf(self.stiffness) else f", stiffness {self.stiffness:.3g} N/m"
        return (
            f"Mesh({len(self.vertices)} vertices, {len(self.faces)} triangles, {_mm(size)}, "
            f"resolution {self._step * 1e3:.3f} mm{soft})"
        )


def _mm(size: Array) -> str:
    """Format a size in mm."""
    return " × ".join(f"{x * 1e3:.3f}" for x in size) + " mm"


def _check_mesh(vertices: Array, faces: Ints, stiffness: float) -> None:
    """Raise a ValueError that lists the faults of a mesh."""
    faults = []
    if vertices.ndim != 2 or vertices.shape[-1] != 3 or not np.isfinite(vertices).all():
        faults.append(f"vertices have shape {vertices.shape}; finite (n, 3) are needed")
    if faces.ndim != 2 or faces.shape[-1] != 3 or not len(faces):
        faults.append(f"faces have shape {faces.shape}; (m, 3) are needed")
    elif faces.min() < 0 or faces.max() >= len(vertices):
        faults.append(f"faces refer to vertices {faces.min()} to {faces.max()} of {len(vertices)}")
    else:
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        code = edges[:, 0] * len(vertices) + edges[:, 1]
        back = edges[:, 1] * len(vertices) + edges[:, 0]
        open_edges = int((~np.isin(back, code)).sum())
        if open_edges or np.unique(code).size != code.size:
            faults.append(
                f"it is not closed: {open_edges} edges have a triangle on one side only, or "
                "triangles are not consistently oriented"
            )
    if not stiffness > 0.0:
        faults.append(f"stiffness is {stiffness!r}; it must be positive, or infinite, in N/m")
    if faults:
        raise ValueError("no mesh: " + "; ".join(faults))


def _volume(vertices: Array, faces: Ints) -> float:
    """Signed volume enclosed by a mesh."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.einsum("ni,ni->", a, np.cross(b, c)) / 6.0)


def _spacing(size: Array) -> float:
    """Grid spacing at which a body of given size has about `NODES` nodes."""
    spacing = float(size.max()) / 50.0
    for _ in range(50):
        nodes = np.prod(size / spacing + 1.0 + 2.0 * _PADDING)
        spacing *= float((nodes / NODES) ** (1.0 / 3.0))
    return spacing


def _grid_distance(
    vertices: Array, faces: Ints, low: Array, spacing: float, shape: tuple[int, ...]
) -> Array:
    """Signed distance at the nodes: exact near the surface, approximate elsewhere."""
    nearest = np.full(shape, np.inf)
    closest, sign = np.zeros((*shape, 3)), np.ones(shape)
    corner, edge, face = _normals(vertices, faces)
    for f, triangle in enumerate(vertices[faces]):
        first = np.floor((triangle.min(axis=0) - low) / spacing).astype(int) - _BAND
        last = np.ceil((triangle.max(axis=0) - low) / spacing).astype(int) + _BAND + 1
        window = tuple(
            slice(max(a, 0), min(b, n)) for a, b, n in zip(first, last, shape, strict=True)
        )
        axes = [low[i] + spacing * np.arange(w.start, w.stop) for i, w in enumerate(window)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        weights = _nearest_weights(nodes, triangle)
        place = weights @ triangle
        away = nodes - place
        distance = np.linalg.norm(away, axis=-1)
        closer = distance < nearest[window] - 1e-9 * spacing
        normals = _feature_normal(weights[closer], corner[faces[f]], edge[f], face[f])
        side = np.where(np.einsum("ni,ni->n", away[closer], normals) < 0.0, -1.0, 1.0)
        nearest[window][closer] = distance[closer]
        closest[window][closer], sign[window][closer] = place[closer], side
    # The limit is not a whole number of cells, where rounding would select among a plane's nodes.
    known = nearest < (_BAND - 0.5) * spacing
    _, there = ndimage.distance_transform_edt(~known, return_indices=True)
    # Farther away, the surface point closest to the nearest exact node is a good approximation.
    away = low + spacing * np.moveaxis(np.indices(shape), 0, -1) - closest[tuple(there)]
    return np.asarray(sign[tuple(there)] * np.linalg.norm(away, axis=-1))


def _normals(vertices: Array, faces: Ints) -> tuple[Array, Array, Array]:
    """Angle-weighted normals of vertices, edges and faces, which determine the sign."""
    triangles = vertices[faces]
    sides = np.roll(triangles, -1, axis=1) - triangles
    face = np.cross(sides[:, 0], sides[:, 1])
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    unit = sides / np.linalg.norm(sides, axis=2, keepdims=True)
    angle = np.arccos(np.clip(-np.einsum("mij,mij->mi", unit, np.roll(unit, 1, axis=1)), -1, 1))
    corner = np.zeros_like(vertices)
    for i in range(3):
        np.add.at(corner, faces[:, i], angle[:, i, None] * face)
    # The adjacent triangle has the edge in the opposite direction.
    start = faces[:, [1, 2, 0]]
    end = faces[:, [2, 0, 1]]
    code = (start * len(vertices) + end).ravel()
    order = np.argsort(code)
    other = order[np.searchsorted(code[order], (end * len(vertices) + start).ravel())] // 3
    return corner, face[:, None] + face[other].reshape(-1, 3, 3), face


def _nearest_weights(points: Array, triangle: Array) -> Array:
    """Barycentric weights (..., 3) of the points of a triangle that are closest to given points."""
    a, b, c = triangle
    ab, ac, ap = b - a, c - a, points - a
    d = np.array([[ab @ ab, ab @ ac], [ab @ ac, ac @ ac]])
    right = np.stack([ap @ ab, ap @ ac], axis=-1)
    inner = right @ np.linalg.inv(d).T
    weights = np.concatenate([1.0 - inner.sum(axis=-1, keepdims=True), inner], axis=-1)
    out = (weights < 0.0).any(axis=-1)
    # If the projection is outside, the closest point is on one of the three edges.
    outside = points[out]
    best = np.full(len(outside), np.inf)
    nearest = np.zeros((len(outside), 3))
    for i in range(3):
        j = (i + 1) % 3
        along = triangle[j] - triangle[i]
        t = np.clip((outside - triangle[i]) @ along / (along @ along), 0.0, 1.0)
        distance = np.linalg.norm(outside - triangle[i] - t[:, None] * along, axis=1)
        closer = distance < best
        best = np.where(closer, distance, best)
        here = np.zeros_like(nearest)
        here[:, i], here[:, j] = 1.0 - t, t
        nearest[closer] = here[closer]
    weights[out] = nearest
    return weights


def _feature_normal(weights: Array, corner: Array, edge: Array, face: Array) -> Array:
    """Normals (n, 3) of the vertex, edge or face on which the closest points are."""
    zero = weights <= 0.0
    count = zero.sum(axis=1)
    normals = np.broadcast_to(face, (len(weights), 3)).copy()
    for i in range(3):
        normals[(count == 1) & zero[:, i]] = edge[i]
        normals[(count == 2) & ~zero[:, i]] = corner[i]
    return normals
