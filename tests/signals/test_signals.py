"""Signals: their definition, their derivatives, and the regions the paper tells apart."""

import numpy as np
import pytest
import xarray as xr

import vibrissa as vb
from vibrissa.rod import discretize, solve_forces
from vibrissa.signals import (
    SIGNALS,
    TRIPLETS,
    concave_backward,
    measured,
    nearest_on_rest,
    selection,
    signal_derivatives,
    signals_of,
    within_cone,
    wrench_derivatives,
)


def test_definition_on_a_known_wrench():
    signals = vb.base_signals([1.0, 3.0, -4.0], [-2.0, -5.0, 12.0])
    expected = {
        "Fx": 1.0,
        "FT": 5.0,
        "FD": np.arctan2(-4.0, 3.0),
        "Mx": -2.0,
        "MB": 13.0,
        "MD": np.arctan2(12.0, -5.0),
    }
    assert list(signals.data_vars) == list(SIGNALS)
    for name, value in expected.items():
        assert signals[name].item() == pytest.approx(value, rel=1e-15)
        assert signals[name].attrs["long_name"]
    assert [signals[n].attrs["units"] for n in SIGNALS] == ["N", "N", "rad", "N m", "N m", "rad"]


def test_force_and_moment_in_the_wrong_order_are_noticed():
    bent = vb.deflect(vb.samples.gamma(), vb.PointForce([15e-3, 25e-3], 5e-5, [0.4, 2.0]))
    vb.base_signals(bent.force, bent.moment)
    with pytest.warns(UserWarning, match="force, N, comes before moment"):
        vb.base_signals(bent.moment, bent.force)
    vb.base_signals(np.zeros((2, 3)), np.ones((2, 3)))


def test_dimensions_follow_the_input():
    plain = vb.base_signals(np.ones((2, 4, 3)), np.ones((2, 4, 3)))
    assert plain.sizes == {"axis_0": 2, "axis_1": 4}
    labelled = xr.DataArray(np.ones((3, 5)), dims=("space", "time"))
    assert vb.base_signals(labelled, labelled).sizes == {"time": 5}
    with pytest.raises(ValueError, match=r"same shape .* got \(3,\) and \(2, 3\)"):
        vb.base_signals(np.ones(3), np.ones((2, 3)))


def test_there_are_twenty_triplets():
    assert len(TRIPLETS) == len(set(TRIPLETS)) == 20


@pytest.mark.parametrize("said", ["MD Fx MB", "Fx,MB,MD", "fx,mb,md", ("MB", "MD", "Fx")])
def test_a_choice_of_signals_is_put_in_order(said):
    assert selection(said) == ("Fx", "MB", "MD")


@pytest.mark.parametrize("said", ["Fx MB", "Fx MB MQ", "Fx Fx MB"])
def test_a_bad_choice_says_what_is_allowed(said):
    with pytest.raises(ValueError, match="Fx, FT, FD, Mx, MB, MD"):
        selection(said)


def test_missing_signals_are_named():
    with pytest.raises(ValueError, match=r"lack MB, MD; they have Fx"):
        measured({"Fx": 1.0}, ("Fx", "MB", "MD"))


def test_components_and_signals_state_the_same():
    """As of a table of six components, or of six signals for the wrench; in rad."""
    force, moment = np.random.default_rng(4).normal(size=(2, 5, 3))
    components = dict(zip(("Fx", "Fy", "Fz", "Mx", "My", "Mz"), [*force.T, *moment.T], strict=True))
    six = {name: values.values for name, values in vb.base_signals(force, moment).items()}
    for given, wanted in ((components, six), (six, components)):
        found, _, _ = measured(given, tuple(wanted))
        np.testing.assert_allclose(found, np.stack(list(wanted.values()), axis=-1), atol=1e-14)
    labelled = xr.Dataset({name: ("time", value) for name, value in components.items()})
    values, dims, _ = measured(labelled, ("Fx", "MB", "MD"))
    np.testing.assert_allclose(values[:, 1], six["MB"])
    assert dims == ("time",)
    with pytest.raises(ValueError, match="MD is an angle in rad; got"):
        measured({**six, "MD": np.degrees(six["MD"])}, tuple(components))
    with pytest.raises(ValueError, match="lack MB, MD; they have Fx, My"):
        measured({"Fx": 1.0, "My": 1.0}, ("Fx", "MB", "MD"))


def test_derivatives_agree_with_differences():
    rng = np.random.default_rng(1)
    wrench = rng.normal(size=(50, 6))
    exact = wrench_derivatives(wrench[:, :3], wrench[:, 3:])
    step = 1e-6
    for column in range(6):
        up, down = wrench.copy(), wrench.copy()
        up[:, column] += step
        down[:, column] -= step
        slope = signals_of(up[:, :3], up[:, 3:]) - signals_of(down[:, :3], down[:, 3:])
        slope[:, [2, 5]] = (slope[:, [2, 5]] + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(exact[:, :, column], slope / (2 * step), rtol=1e-6, atol=1e-6)


def test_derivatives_by_the_contact_agree_with_differences():
    rod = discretize(vb.samples.gamma())
    contacts = np.array([[0.5, 0.0, 3.0, 1.0], [0.8, 0.0, -0.2, 0.3], [0.95, 0.0, 0.02, 0.03]])
    values, tangents = solve_forces(rod, contacts, tangents=True)
    exact = signal_derivatives(values, tangents)
    for j, column in enumerate((0, 2, 3)):
        step = 1e-6 * max(1e-2, np.abs(contacts[:, column]).max())
        both = []
        for sign in (1.0, -1.0):
            moved = contacts.copy()
            moved[:, column] += sign * step
            v = solve_forces(rod, moved)[0]
            both.append(signals_of(v[:, :3], np.cross(v[:, 3:], v[:, :3])))
        slope = (both[0] - both[1]) / (2.0 * step)
        np.testing.assert_allclose(exact[..., j], slope, rtol=2e-4, atol=2e-4)


def test_concave_backward_is_toward_the_intrinsic_curvature():
    whisker = vb.Whisker.parabola(0.04, 10.0)
    place = whisker.position(np.linspace(0.3, 1.0, 8) * whisker.length)
    radius = np.linalg.norm(place, axis=1, keepdims=True)
    for shift, expected in ((1e-4, True), (-1e-4, False)):
        moved = place + np.array([0.0, shift, 0.0])
        moved *= radius / np.linalg.norm(moved, axis=1, keepdims=True)
        assert (concave_backward(whisker, moved) == expected).all()


def test_a_straight_whisker_is_divided_by_y():
    whisker = vb.Whisker.straight(0.04)
    points = np.array([[0.03, 0.01, 0.0], [0.03, -0.01, 0.0]])
    assert concave_backward(whisker, points).tolist() == [True, False]


def test_where_r_doubles_back_the_nearest_branch_counts():
    whisker = vb.Whisker.from_curvature(
        0.04, lambda s: np.stack([0 * s, 0 * s, 90.0 + 0 * s], axis=-1)
    )
    s = 0.95 * whisker.length
    tip_side = whisker.position(np.array(s))
    tangent = whisker.frame(np.array(s))[:, 0]
    assert np.dot(tip_side, tangent) < 0.0, "the distal part comes back toward the base"
    outward = tip_side * (1.0 + 1e-9) + [0.0, 1e-4, 0.0]
    outward *= np.linalg.norm(tip_side) / np.linalg.norm(outward)
    assert concave_backward(whisker, outward)


def test_distance_from_rest_and_cone():
    whisker = vb.Whisker.straight(0.04)
    points = np.array([[0.02, 0.001, 0.0], [0.02, 0.0005, 0.0005], [0.02, 0.0, 0.0], [np.nan] * 3])
    distance, arc_length = nearest_on_rest(whisker, points)
    np.testing.assert_allclose(distance[:3], [1e-3, 5e-4 * np.sqrt(2.0), 0.0], atol=1e-15)
    np.testing.assert_allclose(arc_length[:3], 0.02, rtol=1e-12)
    assert np.isnan(distance[3])
    inside = 0.02 * np.tan(np.deg2rad(2.0))
    assert within_cone(whisker, np.array([0.02, 0.99 * inside, 0.0]))
    assert not within_cone(whisker, np.array([0.02, 1.01 * inside, 0.0]))
