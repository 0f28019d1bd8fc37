"""All contacts side by side with what they feel like: the same contact is the same in all."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.scene import COORDINATES, values_of
from vibrissa.viewer.map import (
    SLICES,
    TURN,
    frame_drawing,
    picked,
    picked_drawing,
    solids,
    solids_drawing,
)
from vibrissa.viewer.readout import number
from vibrissa.viewer.state import charted


@pytest.fixture(scope="module")
def whole():
    return solids(charted(vb.samples.gamma()), cut=False)


def test_signals_are_laid_out_in_a_cylinder(whole):
    rows = whole.nodes.reshape(-1, whole.nodes.shape[-1])[::37]
    places = whole.signal_rows(rows)
    size = np.hypot(places[:, 0], places[:, 1])
    assert size.max() <= 0.5 * whole.length + 1e-9
    moment = values_of("MB", rows)
    np.testing.assert_allclose(size**2 * moment.max(), size.max() ** 2 * moment, rtol=1e-6)
    turn = np.arctan2(places[:, 1], places[:, 0]) - TURN
    felt = size > 1e-3
    gap = np.angle(np.exp(1j * (turn - values_of("MD", rows))))
    np.testing.assert_allclose(gap[felt], 0.0, atol=1e-9)
    height = places[:, 2] - whole.axis_height()
    force = values_of("Fx", rows)
    np.testing.assert_array_equal(
        np.sign(height[abs(force) > 1e-9]), np.sign(force[abs(force) > 1e-9])
    )


@pytest.mark.parametrize("name", SLICES)
def test_a_slice_holds_one_value(whole, name):
    triangles = whole.slice(name, 0.4)
    low, high = whole.range(name)
    assert len(triangles)
    values = values_of(name, triangles)
    np.testing.assert_allclose(values, whole.value(name, 0.4), atol=1e-6 * (high - low))
    ends = [whole.value(name, share) for share in (0.0, 1.0)]
    np.testing.assert_allclose(ends, [low, high], rtol=1e-12, atol=1e-18)


def test_what_is_cut_open_lacks_a_quarter(whole):
    opened = solids(whole.chart, cut=True)
    assert opened.nodes.shape[1] < whole.nodes.shape[1]
    assert len(opened.skin())


def test_every_space_shows_every_contact(whole):
    triangles = whole.skin()
    painted, legends = solids_drawing(whole, triangles, "theta")
    assert set(painted) == {"contacts", *COORDINATES}
    for thing in painted.values():
        assert thing.triangles.shape == (len(triangles), 3, 3)
        assert thing.colours.shape == (len(triangles), 3, 3)
    np.testing.assert_array_equal(painted["contacts"].colours, painted["theta"].colours)
    assert set(legends) == set(COORDINATES)
    assert "rest" in frame_drawing(whole, 5.0)


@pytest.mark.parametrize("space", [None, 0, 1, 2])
def test_a_ray_picks_the_contact_that_it_meets_first(whole, space):
    triangles = whole.skin()
    places = whole.seen(triangles, space)
    rng = np.random.default_rng(3)
    origin = places.reshape(-1, 3).mean(axis=0) + np.array([0.0, -200.0, 0.0])
    # Contact points are linear within a triangle; signals are off by less than its size.
    edges = np.linalg.norm(np.roll(places, 1, axis=1) - places, axis=-1)
    bound = 1e-9 if space is None else 0.5 * edges.max()
    met = 0
    for chosen in rng.integers(0, len(triangles), 12):
        aim = places[chosen].mean(axis=0)
        direction = (aim - origin) / np.linalg.norm(aim - origin)
        row = picked(triangles, places, origin, direction)
        if row is None:  # an edge
            continue
        met += 1
        away = whole.seen(row, space) - origin
        assert np.linalg.norm(np.cross(away, direction)) < bound
        assert away @ direction <= np.linalg.norm(aim - origin) + bound
    assert met >= 10


def test_a_ray_into_the_void_picks_nothing(whole):
    triangles = whole.skin()
    places = whole.seen(triangles, None)
    assert (
        picked(triangles, places, np.array([0.0, -500.0, 0.0]), np.array([0.0, -1.0, 0.0])) is None
    )


def test_what_is_picked_is_bent_exactly(whole):
    row = whole.nodes[12, 20, 6]
    drawn, words = picked_drawing(whole, row, 5.0)
    assert {"mark None", "mark 0", "mark 1", "mark 2", "bent"} == set(drawn)
    bent = vb.deflect(whole.chart.whisker, vb.PointContact(row[:3]))
    signals = vb.base_signals(bent.force, bent.moment)
    assert float(signals.MB) == pytest.approx(values_of("MB", row), rel=1e-3)
    assert 'data-quantity="MB"' in words


def test_on_the_edge_the_chart_tells_what_is_felt(whole):
    row = whole.nodes[12, 20, -1].copy()
    row[:3] += 1e-3 * (row[:3] - whole.chart.whisker.position(values_of("arc_length", row)))
    drawn, words = picked_drawing(whole, row, 5.0)
    assert "bent" in drawn
    assert "about to slip off" in words
    for name in ("MB", "arc_length"):
        assert number(name, float(values_of(name, row))) in words
