"""Between the chart's nodes (F, p) is nearly that of the rod, and its slopes are its own."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.numerics import kernel
from vibrissa.rod import (
    BUFFER_SIZE,
    contacts_at,
    interpolant,
    interpolate,
    solve_forces,
    stable_set,
    with_normal_force,
)


@kernel
def interpolated(nodes, fold, x, values, tangents, known, slopes):
    b = np.zeros(BUFFER_SIZE)
    for i in range(len(x)):
        known[i] = interpolate(nodes, fold, b, x[i], values[i], tangents[i], slopes)


def followed(chart, x):
    """(F, p), ∂(F, p)/∂ξ of contacts between the nodes, and which are known."""
    values, tangents = np.full((len(x), 6), np.nan), np.zeros((len(x), 6, 4))
    alone, known = values.copy(), np.zeros(len(x), bool)
    interpolated(interpolant(chart), chart.fold, x, alone, tangents, known, False)
    assert not tangents.any()
    interpolated(interpolant(chart), chart.fold, x, values, tangents, known, True)
    np.testing.assert_array_equal(values, alone)
    return values, tangents[:, :, [0, 2, 3]], known


def drawn(chart, rng, least, most, n=2000):
    """Contacts spread over a part of the chart."""
    eta, psi, rho = rng.uniform(size=(3, n))
    spots = np.stack([eta, 2.0 * np.pi * psi - np.pi, least + (most - least) * rho], axis=-1)
    return with_normal_force(contacts_at(chart.fold, spots))


@pytest.fixture(
    params=[
        vb.samples.gamma(),
        vb.Whisker.straight(length=0.04),
        vb.Whisker.parabola(length=0.03, coefficient=15.0, base_radius=50e-6, tip_radius=25e-6),
    ],
    ids=["gamma", "straight", "blunt"],
)
def chart(request):
    return stable_set(request.param)


def test_nodes_are_those_of_the_rod(chart):
    inside = (slice(1, -1), slice(1, -1), slice(2, -1))
    x = with_normal_force(chart.contacts[inside].reshape(-1, 3))
    values, tangents, known = followed(chart, x)
    assert known.all()
    np.testing.assert_allclose(values, chart.values[inside].reshape(-1, 6), atol=1e-9)
    size = np.linalg.norm(chart.tangents[inside].reshape(-1, 6, 3), axis=1, keepdims=True)
    away = (tangents - chart.tangents[inside].reshape(-1, 6, 3)) / size
    assert np.abs(away).max() < 1e-6


@pytest.mark.parametrize(("least", "most", "off"), [(0.15, 0.8, 0.005), (0.8, 0.95, 0.01)])
def test_changes_of_the_point_are_known_to_a_part_in_hundreds(chart, rng, least, most, off):
    """Relative to each other, whatever the direction: E of (1 + E) ∂p/∂ξ, 99 % of contacts."""
    x = drawn(chart, rng, least, most)
    _, tangents, known = followed(chart, x)
    _, true = solve_forces(chart.discretization, x, tangents=True)
    assert known.all()
    wrong = (tangents - true)[:, 3:] @ np.linalg.inv(true[:, 3:])
    assert np.quantile(np.linalg.norm(wrong, axis=(1, 2)), 0.99) < off


def test_slopes_are_those_of_the_values(chart, rng):
    x = drawn(chart, rng, 0.2, 0.95, 300)
    _, tangents, _ = followed(chart, x)
    size = np.linalg.norm(x[:, 2:], axis=1)
    for i, column in enumerate((0, 2, 3)):
        step = 1e-6 * (np.ones(len(x)) if column == 0 else size)
        ahead, back = x.copy(), x.copy()
        ahead[:, column] += step
        back[:, column] -= step
        (after, _, one), (before, _, two) = followed(chart, ahead), followed(chart, back)
        slope = (after - before) / (2.0 * step)[:, None]
        away = np.abs(slope - tangents[:, :, i]) / np.abs(tangents).max(axis=2)
        # Slopes may jump between two cells.
        assert np.quantile(away[one & two], 0.98) < 1e-5


def test_what_is_not_on_the_map_is_not_known(chart):
    x = drawn(chart, np.random.default_rng(0), 1.1, 1.2, 50)
    near_rest = drawn(chart, np.random.default_rng(0), 1e-3, 0.06, 50)
    before = drawn(chart, np.random.default_rng(0), 0.3, 0.6, 50)
    before[:, 0] = chart.proximal - 0.1
    for contacts in (x, near_rest, before):
        assert not followed(chart, contacts)[2].any()
