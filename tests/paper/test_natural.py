"""Natural neighbours: weights against Voronoi volumes, and the laws that they obey."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Voronoi

from vibrissa.paper import NaturalNeighbour

METHODS = ("natural", "linear")
UNSCALED = np.ones(3)


def lattice(n):
    return np.stack(np.meshgrid(*[np.arange(float(n))] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def cells(points, which):
    """Volumes of bounded Voronoi cells."""
    diagram = Voronoi(points)
    regions = [diagram.regions[diagram.point_region[i]] for i in which]
    return np.array([ConvexHull(diagram.vertices[region]).volume for region in regions])


def weights_by_volumes(points, query):
    """What each cell loses to the query's, from two Voronoi diagrams within eight far points."""
    far = points.mean(axis=0) + 50.0 * np.ptp(points) * (2.0 * lattice(2) - 1.0)
    n = len(points)
    before = cells(np.concatenate([points, far]), range(n))
    after = cells(np.concatenate([points, query[None], far]), range(n + 1))
    return (before - after[:n]) / after[n]


SCATTERED = np.random.default_rng(1).uniform(size=(150, 3))
INNER = np.random.default_rng(2).uniform(0.3, 0.7, (12, 3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("points", "queries"),
    [
        (SCATTERED, INNER),
        (lattice(5), 1.0 + 2.0 * INNER),
        # On faces, edges and centres of cubes, where up to eight points lie on one sphere.
        (lattice(5), np.array([[1.5, 2, 2], [1.5, 1.5, 1.5], [1.5, 1.5, 2], [1.25, 1.5, 2]])),
    ],
    ids=["scattered", "lattice", "between lattice points"],
)
def test_weights_are_the_volumes_that_a_query_takes(points, queries):
    f = NaturalNeighbour(points, points, scale=UNSCALED)
    for query in queries:
        indices, weights = f.weights(query)
        found = np.zeros(len(points))
        np.add.at(found, indices, weights)
        # The tolerance is that of the volumes by convex hulls in so large a box.
        np.testing.assert_allclose(found, weights_by_volumes(points, query), atol=2e-9)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["uniform", "lattice", "sphere", "clustered", "stretched"])
def test_linear_functions_are_exact(kind, method, rng):
    points = rng.uniform(size=(2000, 3))
    queries = rng.uniform(size=(1000, 3))
    if kind == "lattice":
        points = lattice(9) / 8.0
        queries[::2] = rng.integers(0, 17, (500, 3)) / 16.0
        queries[1::4, 0] = np.round(8.0 * queries[1::4, 0]) / 8.0
    elif kind == "sphere":
        points = rng.normal(size=(200, 3))
        points /= np.linalg.norm(points, axis=1)[:, None]
        queries -= 0.5
    elif kind == "clustered":
        points, queries = rng.normal(size=(2000, 3)) ** 3, rng.normal(size=(1000, 3)) ** 3
    elif kind == "stretched":
        points, queries = points * [1e-6, 1.0, 1e3], queries * [1e-6, 1.0, 1e3]
    slope = rng.normal(size=(3, 2)) / np.ptp(points, axis=0)[:, None]
    f = NaturalNeighbour(points, points @ slope + 3.0)
    found = f(queries, method)
    inside = np.isfinite(found).all(axis=1)
    assert inside.mean() > 0.6
    np.testing.assert_allclose(found[inside], (queries @ slope + 3.0)[inside], atol=1e-9)


def test_weights_are_positive_and_few_are_barycentric(rng):
    """Barycentric weights, four of them, are for where roundoff spoils Sibson's."""
    f = NaturalNeighbour(rng.uniform(size=(1000, 3)), np.zeros((1000, 1)))
    counts = []
    for query in rng.uniform(0.1, 0.9, (500, 3)):
        _, weights = f.weights(query)
        assert weights.min() >= -1e-12
        assert weights.sum() == pytest.approx(1.0, abs=1e-13)
        counts.append(len(weights))
    assert min(counts) > 4
    assert 13 < np.mean(counts) < 17


def test_exact_at_the_points(rng):
    points, values = rng.normal(size=(800, 3)), rng.normal(size=(800, 4))
    f = NaturalNeighbour(points, values)
    np.testing.assert_allclose(f(points), values, atol=1e-9)
    near = f(points + 1e-10)
    inside = np.isfinite(near).all(axis=1)
    assert inside.mean() > 0.9
    np.testing.assert_allclose(near[inside], values[inside], atol=1e-6)


def test_smooth_between_points(rng):
    """The slope along a line has jumps where natural neighbours are exchanged linearly only."""
    points = rng.uniform(size=(400, 3))
    f = NaturalNeighbour(points, np.sin(4.0 * points))
    line = np.array([0.3, 0.3, 0.35]) + np.linspace(0, 0.4, 4001)[:, None] * np.array([1, 0.9, 0.8])
    jumps = {method: np.abs(np.diff(f(line, method), n=2, axis=0)).max() for method in METHODS}
    assert jumps["natural"] < 0.1 * jumps["linear"]


def test_on_the_hull_the_limit_is_barycentric(rng):
    points = rng.uniform(size=(300, 3))
    values = np.sin(5.0 * points)
    hull = ConvexHull(points).simplices
    share = rng.dirichlet([2.0, 2.0, 2.0], len(hull))
    on = np.einsum("nk,nkc->nc", share, points[hull])
    limit = np.einsum("nk,nkc->nc", share, values[hull])
    f = NaturalNeighbour(points, values)
    away = [
        np.abs(f(on + d * (points.mean(axis=0) - on)) - limit).max() for d in (1e-7, 1e-9, 1e-11)
    ]
    assert away[0] < 1e-2
    assert away[1] < 0.02 * away[0] + 1e-9
    assert away[2] < 0.02 * away[1] + 1e-9


def test_nothing_outside(rng):
    points = rng.uniform(size=(100, 3))
    f = NaturalNeighbour(points, points)
    queries = np.array([[2.0, 0.5, 0.5], [np.nan, 0.5, 0.5], [0.5, 0.5, 0.5]])
    for method in METHODS:
        assert np.isnan(f(queries, method)).all(axis=1).tolist() == [True, True, False]
    assert f.weights(queries[0])[0].size == 0
    assert f(np.empty((0, 3))).shape == (0, 3)


def test_what_it_refuses(rng):
    points = rng.uniform(size=(20, 3))
    with pytest.raises(ValueError, match=r"points must be \(n, 3\)"):
        NaturalNeighbour(points[:, :2], points)
    with pytest.raises(ValueError, match="finite"):
        NaturalNeighbour(np.where(points > 0.9, np.nan, points), points)
    with pytest.raises(ValueError, match="above zero"):
        NaturalNeighbour(points * [1, 0, 1], points)
    with pytest.raises(ValueError, match="one plane"):
        NaturalNeighbour(points @ [[1, 0, 1], [0, 1, 1], [0, 0, 0]], points)
    f = NaturalNeighbour(points, points)
    with pytest.raises(ValueError, match="'natural' or 'linear'"):
        f(points, "cubic")
    with pytest.raises(ValueError, match=r"queries must be \(m, 3\)"):
        f(points[0])
