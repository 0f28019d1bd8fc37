"""Laws of the whisker: its shape, its frame, and what may be done to it."""

import json
import pickle
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp

from vibrissa import samples
from vibrissa.whisker import Pose, Whisker

LENGTH = 40e-3
KIRCHHOFF = Path(__file__).parents[3] / "shared" / "reference" / "kirchhoff.json"


def wavy(s):
    """A smooth three-dimensional curvature with a bump."""
    s = np.asarray(s)
    bump = 30.0 * np.exp(-(((s - 0.02) / 0.004) ** 2))
    return np.stack([20.0 * np.sin(90.0 * s), -800.0 * s + 5.0 * np.cos(200.0 * s), bump], -1)


def integrated(curvature, s):
    """Points and frames by SciPy's eighth-order method."""

    def slope(x, state):
        frame = state[3:].reshape(3, 3)
        twist, about_1, about_2 = curvature(x)
        turn = np.array([[0, -about_2, about_1], [about_2, 0, -twist], [-about_1, twist, 0]])
        return np.concatenate([frame[:, 0], (frame @ turn).ravel()])

    start = np.concatenate([np.zeros(3), np.eye(3).ravel()])
    found = solve_ivp(slope, (0, s[-1]), start, "DOP853", s, rtol=1e-12, atol=1e-14)
    return found.y[:3].T, found.y[3:].T.reshape(-1, 3, 3)


@pytest.mark.filterwarnings("ignore:the curvature is")
@given(st.floats(-200.0, 200.0), st.floats(1e-3, 0.3))
def test_constant_curvature_is_a_circle(kappa, length):
    whisker = Whisker.from_curvature(length, lambda s: (0.0, 0.0, kappa))
    s = np.linspace(0.0, length, 33)
    turn = kappa * s
    # sin x / x and (1 − cos x) / x, also where x is next to nothing.
    circle = np.stack(
        [s * np.sinc(turn / np.pi), s * np.sin(turn / 2) * np.sinc(turn / 2 / np.pi), 0 * s], -1
    )
    np.testing.assert_allclose(whisker.position(s), circle, rtol=0, atol=1e-12 * length)


def test_rest_shape_meets_an_independent_integration():
    whisker = Whisker.from_curvature(LENGTH, wavy)
    s = np.linspace(0.0, LENGTH, 41)
    points, frames = integrated(wavy, s)
    np.testing.assert_allclose(whisker.position(s), points, rtol=0, atol=1e-11 * LENGTH)
    np.testing.assert_allclose(whisker.frame(s), frames, rtol=0, atol=1e-10)
    np.testing.assert_allclose(whisker.curvature(s), wavy(s), rtol=0, atol=1e-10)


@pytest.mark.skipif(not KIRCHHOFF.exists(), reason="no reference data beside the repository")
def test_rest_shape_of_the_reference_whiskers():
    reference = json.loads(KIRCHHOFF.read_text())["whiskers"]
    length = reference["K2"]["L"]

    def ramp(s):
        return 0.0, 15.0 * max(s - 0.6 * length, 0.0) / (0.4 * length), 5.0 + 400.0 * s

    whiskers = {
        "K1": Whisker.from_curvature(reference["K1"]["L"], lambda s: (0.0, 0.0, 12.0)),
        "K2": Whisker.from_curvature(length, ramp, breaks=[0.6 * length]),
        "K3": Whisker.straight(reference["K3"]["L"]),
    }
    for name, whisker in whiskers.items():
        s, points = reference[name]["centreline_s"], reference[name]["centreline_xyz"]
        np.testing.assert_allclose(whisker.position(s), points, rtol=0, atol=1e-12)


def test_signs_of_curvature():
    up = Whisker.from_curvature(LENGTH, lambda s: (0.0, 0.0, 5.0)).position(LENGTH)
    down = Whisker.from_curvature(LENGTH, lambda s: (0.0, 5.0, 0.0)).position(LENGTH)
    assert up[1] > 0.0
    assert up[2] == 0.0
    assert down[2] < 0.0
    assert down[1] == 0.0


@pytest.mark.filterwarnings("ignore:the coefficient of the parabola")
@given(st.floats(0.0, 60.0), st.floats(5e-3, 80e-3))
def test_parabola_lies_on_its_parabola(coefficient, length):
    whisker = Whisker.parabola(length, coefficient)
    x, y, z = whisker.centerline(50).T
    np.testing.assert_allclose(y, coefficient * x**2, rtol=0, atol=1e-10 * length)
    assert not z.any()


def test_parabola_the_other_way_is_rolled_over():
    whisker = Whisker.parabola(LENGTH, -10.0)
    assert whisker.position(LENGTH)[1] > 0.0
    x, y, z = whisker.pose.to_source(whisker.centerline(20)).T
    np.testing.assert_allclose(y, -10.0 * x**2, rtol=0, atol=1e-13)
    assert not z.any()


def test_frames_are_orthonormal_and_tangents_are_slopes():
    whisker = samples.gamma()
    s = np.linspace(0.0, whisker.length, 30)
    frame = whisker.frame(s)
    np.testing.assert_allclose(
        frame.mT @ frame, np.broadcast_to(np.eye(3), frame.shape), atol=1e-13
    )
    inner, step = s[1:-1], 1e-6
    slope = (whisker.position(inner + step) - whisker.position(inner - step)) / (2 * step)
    np.testing.assert_allclose(slope, whisker.frame(inner)[..., 0], atol=1e-8)


@pytest.mark.parametrize("shape", [(), (1,), (5,), (2, 3), (0,)])
def test_any_shape_of_arc_lengths(shape):
    whisker = samples.gamma()
    s = np.full(shape, 0.3 * whisker.length)
    assert whisker.radius(s).shape == shape
    assert whisker.curvature(s).shape == (*shape, 3)
    assert whisker.position(s).shape == (*shape, 3)
    assert whisker.frame(s).shape == (*shape, 3, 3)


def test_arc_lengths_outside():
    whisker = Whisker.straight(LENGTH)
    np.testing.assert_array_equal(whisker.position(LENGTH * (1 + 1e-12)), [LENGTH, 0, 0])
    assert np.isnan(whisker.radius(np.nan))
    assert np.isnan(whisker.position(np.nan)).all()
    with pytest.raises(ValueError, match=r"reaches from 0 to 0\.04 m"):
        whisker.position(0.05)
    with pytest.raises(ValueError, match="reaches"):
        whisker.radius([-1e-3, 0.01])


def test_jump_in_curvature_is_seen_from_both_sides():
    whisker = Whisker.from_curvature(
        LENGTH, lambda s: (0.0, 0.0, 5.0 if s < 0.0123 else 9.0), breaks=[0.0123]
    )
    assert whisker.breaks == (0.0123,)
    assert whisker.curvature(0.0123, "left")[2] == pytest.approx(5.0, abs=1e-12)
    assert whisker.curvature(0.0123)[2] == pytest.approx(9.0, abs=1e-12)
    assert not whisker.notes
    unstated = Whisker.from_curvature(LENGTH, lambda s: (0.0, 0.0, 5.0 if s < 0.0123 else 9.0))
    np.testing.assert_allclose(unstated.breaks, [0.0123], rtol=1e-12)
    assert not unstated.notes


def test_more_jumps_than_can_be_found_are_noted():
    whisker = Whisker.from_curvature(LENGTH, lambda s: (0.0, 0.0, 5.0 + (s * 1e5 % 1.0)))
    assert "stated as breaks" in whisker.notes[0]


def test_curvature_functions_of_every_kind_agree():
    def arrays(s):
        return np.stack([0 * s, 100 * s, 5 + 400 * s], -1)

    kinds = [
        arrays,
        lambda s: (0.0, 100 * float(s), 5 + 400 * float(s)),
        lambda s: np.array([0 * s, 100 * s, 5 + 400 * s]),
        lambda s: np.column_stack([np.zeros(len(s)), 100 * s, 5 + 400 * s]),  # arrays only
    ]
    s = np.linspace(0, LENGTH, 7)
    for kind in kinds:
        np.testing.assert_allclose(
            Whisker.from_curvature(LENGTH, kind).curvature(s), arrays(s), rtol=0, atol=1e-13
        )


def test_bad_curvature_functions():
    with pytest.raises(ValueError, match=r"shape \(2,\)"):
        Whisker.from_curvature(LENGTH, lambda s: (0.0, 1.0))
    with pytest.raises(ValueError, match="must be finite"):
        Whisker.from_curvature(LENGTH, lambda s: (0.0, 0.0, np.nan))
    with pytest.raises(ValueError, match="function of arc length"):
        Whisker.from_curvature(LENGTH, 5.0)
    with pytest.raises(ValueError, match=r"length is of type function; .* of type float; a func"):
        Whisker.from_curvature(wavy, LENGTH)
    for length in ("0.04", [LENGTH], None, True):
        with pytest.raises(ValueError, match="length is of type"):
            Whisker.straight(length)
    with pytest.raises(ValueError, match=r"breaks \[0.05\]"):
        Whisker.from_curvature(LENGTH, lambda s: (0, 0, 1), breaks=[0.05])


def test_curvature_keeps_the_frame_it_was_stated_in_until_aligned():
    whisker = Whisker.from_curvature(LENGTH, lambda s: (0.0, -3.0, -8.0))
    assert whisker.position(LENGTH)[1] < 0.0
    assert "toward −y" in whisker.notes[0]
    aligned = whisker.aligned()
    _, y, z = aligned.centerline(20).T
    assert (y[1:] > 0.0).all()
    np.testing.assert_allclose(z, 0.0, atol=1e-15)
    np.testing.assert_allclose(
        aligned.pose.to_source(aligned.centerline(20)), whisker.centerline(20), atol=1e-15
    )


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"youngs_modulus": 0.0}, "youngs_modulus is 0.0 Pa"),
        ({"youngs_modulus": 3.0}, "is it in Pa"),
        ({"youngs_modulus": 3000.0}, "1 MPa is 1e6"),
        ({"youngs_modulus": 3000e9}, "1 MPa is 1e6"),
        ({"base_radius": 0.1}, "millimetres given as metres"),
        ({"poisson_ratio": -1.0}, r"\(-1, 0.5\]"),
        ({"poisson_ratio": 0.51}, r"\(-1, 0.5\]"),
        ({"base_radius": -1e-6}, "base_radius is -1e-06 m"),
        ({"tip_radius": 0.0}, "tip_radius is 0.0 m"),
        ({"radius": lambda s: 1e-4 - s}, "must be positive from base to tip"),
        ({"radius": [1e-4, -1e-5]}, "sample 1"),
        ({"radius": np.ones((3, 3))}, r"shape \(3, 3\)"),
        ({"radius": [[0.0, 1e-4], [0.02, 1e-5]]}, "cover the whisker"),
        ({"radius": [1e-4, 1e-5], "tip_radius": 1e-5}, "give one of them"),
        ({"radius": [[0, 1e-4], [0.01, 1e-4], [0, 1e-5]]}, "increasing"),
        ({"radius": [[0, 1e-4], [0.02, 9e-5], [0.02, 8e-5], [0.04, 1e-5], [0.04, 1e-6]]}, "tip"),
        ({"base_stiffness": (1e-3, 0.0)}, "two positive"),
        ({"base_stiffness": 1e-3}, "two positive"),
    ],
)
def test_bad_properties(fault, message):
    with pytest.raises(ValueError, match=message):
        Whisker.straight(LENGTH, **fault)


def test_all_faults_come_in_one_message():
    with pytest.raises(ValueError, match=r"youngs_modulus.*poisson_ratio.*base_radius"):
        Whisker.straight(LENGTH, youngs_modulus=-1, poisson_ratio=1, base_radius=0)


@pytest.mark.parametrize("length", [40.0, 0.51, 4e-5, 0.0, -0.01, np.nan])
def test_bad_lengths(length):
    with pytest.raises(ValueError, match="length is"):
        Whisker.straight(length)


@pytest.mark.parametrize("length", [0.9, 3.0, 2e-4])
def test_any_length_that_is_confirmed(length):
    radius = {"base_radius": 0.01 * length}
    for make in (
        lambda **how: Whisker.straight(length, **how),
        lambda **how: Whisker.parabola(length, 0.4 / length, **how),
        lambda **how: Whisker.from_curvature(length, lambda s: (0.0, 0.0, 0.3 / length), **how),
        lambda **how: Whisker.from_points(
            samples.gamma().scaled(length / 40e-3).centerline(20), **how
        ),
    ):
        with pytest.raises(ValueError, match=r"any_length=True \(Python\) or --any-length"):
            make(**radius)
        whisker = make(any_length=True, **radius)
        assert whisker.length == pytest.approx(length, rel=1e-3)
        assert Whisker.from_dataset(whisker.to_dataset()).length == whisker.length
        assert whisker.with_properties(name="rod").length == whisker.length


def test_metres_for_millimetres_are_named():
    with pytest.raises(ValueError, match="millimetres given as metres"):
        Whisker.parabola(39.4, 0.02)


def test_radius_profiles():
    s = np.linspace(0, LENGTH, 9)
    line = 1e-4 * (1 - 0.9 * s / LENGTH)
    for radius in (line, np.column_stack([s, line]), lambda x: 1e-4 * (1 - 0.9 * x / LENGTH)):
        whisker = Whisker.straight(LENGTH, radius=radius)
        np.testing.assert_allclose(whisker.radius(s), line, rtol=1e-12)
        assert whisker.base_radius == pytest.approx(1e-4)
        assert whisker.tip_radius == pytest.approx(1e-5)
    default = Whisker.straight(LENGTH)
    assert default.base_radius / default.tip_radius == pytest.approx(15.0)
    assert default.base_bending_stiffness == pytest.approx(3e9 * np.pi * 1e-16 / 4)


@pytest.mark.slow
@settings(max_examples=40)
@given(st.integers(8, 300), st.floats(0.5, 1.3), st.sampled_from([0.0, 1e-3, 0.02]), st.data())
def test_a_tapered_radius_with_noise_has_no_breaks(count, power, noise, data):
    random = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    s = np.linspace(0.0, LENGTH, count)
    radius = 1e-4 * (1.0 - 0.95 * s / LENGTH) ** power
    radius *= 1.0 + noise * random.standard_normal(count)
    whisker = Whisker.straight(LENGTH, radius=np.column_stack([s, radius]))
    assert whisker.breaks == ()


@pytest.mark.parametrize("noise", [0.0, 0.005])
@pytest.mark.parametrize("count", [61, 400])
def test_steps_among_samples_are_found(count, noise):
    edges = LENGTH * np.array([0.21, 0.517, 0.83])
    s = np.linspace(0.0, LENGTH, count)
    radius = np.array([1e-4, 8e-5, 9e-5, 4e-5])[np.searchsorted(edges, s)]
    radius *= 1.0 + noise * np.random.default_rng(count).standard_normal(count)
    whisker = Whisker.straight(LENGTH, radius=np.column_stack([s, radius]))
    np.testing.assert_allclose(whisker.breaks, edges, rtol=0, atol=0.5 * LENGTH / (count - 1))
    assert "jumps at 3 arc lengths" in whisker.notes[0]
    again = whisker.with_properties(base_radius=1e-4)
    assert again.breaks == ()
    assert Whisker.from_dataset(whisker.to_dataset()).breaks == whisker.breaks


def test_breaks_can_be_stated_for_every_shape():
    for whisker in (
        Whisker.straight(LENGTH, breaks=(0.01,)),
        Whisker.parabola(LENGTH, 10.0, breaks=(0.01,)),
        Whisker.from_points(samples.gamma().centerline(20), breaks=(0.01,)),
    ):
        assert whisker.breaks == (0.01,)
    with pytest.raises(ValueError, match=r"breaks \[0.05\]"):
        Whisker.straight(LENGTH, breaks=(0.05,))


def test_two_samples_of_a_radius_are_a_cone():
    """They were taken for a step in the middle, and forces were three times too large."""
    pairs = [[0.0, 1e-4], [0.04, 1e-5]]
    for radius in ([1e-4, 1e-5], pairs):
        whisker = Whisker.straight(0.04, radius=radius)
        s = np.linspace(0.0, 0.04, 9)
        np.testing.assert_allclose(whisker.radius(s), np.linspace(1e-4, 1e-5, 9), rtol=1e-9)
        assert whisker.notes == ()


@pytest.mark.parametrize(
    ("properties", "message"),
    [
        ({"radius": [1e-4, 1e-5], "base_radius": 2e-4}, "both given"),
        ({"radius": [[0.0, 1e-4], [40.0, 1e-5]]}, "arc lengths are in m"),
        ({"radius": [[0.0, 1e-4], [1.0, 1e-5]]}, "arc lengths are in m"),
    ],
)
def test_radii_that_contradict_each_other_or_the_length(properties, message):
    with pytest.raises(ValueError, match=message):
        Whisker.straight(0.04, **properties)


def test_a_curvature_per_mm_is_questioned():
    with pytest.warns(UserWarning, match=r"by less than 0.046°: is it per mm"):
        Whisker.from_curvature(0.04, lambda s: np.array([0.0, 0.0, 0.02]))


def test_a_material_of_several_numbers_is_refused_with_its_name():
    with pytest.raises(ValueError, match=r"youngs_modulus is \[.*\]; one number is needed"):
        Whisker.straight(0.04, youngs_modulus=[3e9, 2e9])
    with pytest.raises(ValueError, match=r"poisson_ratio is '0\.3'; one number is needed"):
        Whisker.straight(0.04, poisson_ratio="0.3")


@pytest.mark.parametrize(
    ("properties", "message"),
    [
        ({"youngs_modulus": 200e3, "poisson_ratio": 0.29}, "is it in MPa"),
        ({"base_stiffness": (177.0, 177.0)}, "so that the base is rigid: is it in µN·m"),
    ],
)
def test_properties_of_possible_size_in_other_units_are_questioned(properties, message):
    """Steel in MPa would be as soft as silicone, and a base in µN·m would be rigid."""
    with pytest.warns(UserWarning, match=message):
        Whisker.straight(0.04, **properties)
    with pytest.warns(UserWarning, match=message) as caught:
        other = Whisker.straight(0.04).with_properties(**properties)
    assert caught[0].filename == __file__
    other.with_properties(name="as before")


def test_soft_silicone_and_a_compliant_base_are_not_questioned():
    Whisker.straight(0.04, youngs_modulus=200e3, poisson_ratio=0.49)
    Whisker.straight(0.04, base_stiffness=(177e-6, 177e-6))


def test_a_coefficient_per_millimetre_is_questioned():
    """As publications state it: 0.0233 per mm is 23.3 per m."""
    with pytest.warns(UserWarning, match="is it per mm, as in the literature"):
        Whisker.parabola(35e-3, 0.0233)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for coefficient in (0.0, 0.5, 23.3):
            Whisker.parabola(35e-3, coefficient)


def test_radii_that_are_changed_to_other_units_are_refused():
    whisker = Whisker.straight(0.04)
    for radius, message in ((1e-7, "multiply by 1e3"), (0.1, "multiply by 1e-3")):
        with pytest.raises(ValueError, match=message):
            whisker.with_properties(base_radius=radius)


def test_curves_sharper_than_a_rod_of_this_radius_are_questioned():
    sharp = r"at 0 mm the radius of curvature is 0\.0025 of the whisker's radius"
    with pytest.warns(UserWarning, match=sharp):
        Whisker.parabola(0.04, 2e6)
    with pytest.warns(UserWarning, match="which no rod has"):
        Whisker.from_curvature(0.04, lambda s: np.stack([0 * s, 0 * s, 2e4 + 0 * s], -1))
    Whisker.parabola(0.04, 1e3)


def test_tip_thicker_than_base_is_noted():
    assert Whisker.straight(LENGTH, tip_radius=2e-4).notes == ("the tip is thicker than the base",)


def test_a_robots_whisker():
    whisker = Whisker.parabola(0.3, 2.0, base_radius=4e-3, tip_radius=1e-3, youngs_modulus=60e9)
    assert whisker.radius(0.15) == pytest.approx(2.5e-3)


@settings(max_examples=30)
@given(st.floats(0.05, 1.0))
def test_trimming_changes_nothing_proximal(share):
    whisker = samples.gamma()
    short = whisker.trimmed(share * whisker.length)
    s = np.linspace(0.0, short.length, 11)[:-1]
    np.testing.assert_array_equal(short.curvature(s), whisker.curvature(s))
    np.testing.assert_array_equal(short.radius(s), whisker.radius(s))
    np.testing.assert_allclose(short.position(s), whisker.position(s), rtol=0, atol=1e-15)


@settings(max_examples=30)
@given(st.floats(0.2, 5.0), st.floats(0.2, 5.0))
def test_scaling(length_factor, radius_factor):
    whisker = samples.gamma()
    scaled = whisker.scaled(length_factor, radius_factor)
    np.testing.assert_allclose(
        scaled.centerline(11), length_factor * whisker.centerline(11), rtol=0, atol=1e-14
    )
    np.testing.assert_allclose(
        scaled.radius(scaled.length / 3), radius_factor * whisker.radius(whisker.length / 3)
    )


def test_properties_can_be_changed():
    whisker = samples.gamma()
    stiff = whisker.with_properties(youngs_modulus=6e9, tip_radius=5e-5, name="stiff")
    assert (stiff.youngs_modulus, stiff.tip_radius, stiff.name) == (
        6e9,
        pytest.approx(5e-5),
        "stiff",
    )
    assert stiff.base_radius == whisker.base_radius
    assert replace(whisker, base_stiffness=(1, 2)).base_stiffness == (1.0, 2.0)
    with pytest.raises(ValueError, match="poisson_ratio"):
        replace(whisker, poisson_ratio=0.7)


def test_pickled_it_is_the_same():
    whisker = Whisker.from_curvature(LENGTH, wavy, base_stiffness=(1e-3, 2e-3))
    again = pickle.loads(pickle.dumps(whisker))
    np.testing.assert_array_equal(again.centerline(9), whisker.centerline(9))
    assert again.base_stiffness == whisker.base_stiffness


@pytest.mark.parametrize(
    ("make", "stiffness"),
    [
        (samples.gamma, (1e-3, 2e-3)),
        (samples.straight, None),
        (lambda: Whisker.parabola(0.03, -9), (1e-3, 2e-3)),
    ],
)
def test_stored_it_is_the_same(make, stiffness, tmp_path):
    whisker = replace(make(), base_stiffness=stiffness, notes=("a note", "über µm"))
    path = tmp_path / "whisker.nc"
    dataset = whisker.to_dataset()
    assert all({"units", "long_name"} <= set(v.attrs) for v in dataset.data_vars.values())
    dataset.to_netcdf(path, engine="h5netcdf", group="whisker")
    with xr.open_dataset(path, engine="h5netcdf", group="whisker") as stored:
        again = Whisker.from_dataset(stored)
    for what in ("length", "youngs_modulus", "poisson_ratio", "base_stiffness", "breaks", "notes"):
        assert getattr(again, what) == getattr(whisker, what)
    assert again.name == whisker.name
    s = np.linspace(0, whisker.length, 100)
    np.testing.assert_array_equal(again.curvature(s), whisker.curvature(s))
    np.testing.assert_array_equal(again.radius(s), whisker.radius(s))
    np.testing.assert_array_equal(again.pose.rotation, whisker.pose.rotation)


def test_density_gives_the_mass_and_is_stored():
    rod = Whisker.straight(0.1, base_radius=1e-3, tip_radius=0.5e-3, density=2000.0)
    frustum = np.pi * 0.1 * (1.0 + 0.5 + 0.25) / 3.0 * 1e-6
    assert rod.mass == pytest.approx(2000.0 * frustum, rel=1e-12)
    assert Whisker.from_dataset(rod.to_dataset()).density == 2000.0
    unknown = samples.gamma()
    assert np.isnan(unknown.mass)
    assert Whisker.from_dataset(unknown.to_dataset()).density is None
    assert rod.trimmed(0.05).density == 2000.0
    for wrong in (-1.0, 1.2, np.nan):
        with pytest.raises(ValueError, match="density is"):
            rod.with_properties(density=wrong)


def test_another_dataset_is_refused():
    with pytest.raises(ValueError, match="lacks base_bending_stiffness"):
        Whisker.from_dataset(samples.gamma().to_dataset().drop_vars("base_bending_stiffness"))


@pytest.mark.parametrize("name", ["arc_length", "centerline", "radius"])
def test_a_dataset_whose_drawing_was_lost_or_changed_is_refused(name):
    """The polynomials count; who changed only the radius would be given the old one in silence."""
    dataset = samples.gamma().to_dataset()
    with pytest.raises(ValueError, match=f"lacks {name}"):
        Whisker.from_dataset(dataset.drop_vars(name))
    for factor in (1.01, np.nan):
        with pytest.raises(ValueError, match="was changed: centerline and radius"):
            Whisker.from_dataset(dataset.assign({name: dataset[name] * factor}))


angles = st.floats(-np.pi, np.pi)


@given(st.tuples(angles, angles, angles), st.tuples(*[st.floats(-1, 1)] * 3))
def test_pose_goes_there_and_back(euler, origin):
    from scipy.spatial.transform import Rotation

    pose = Pose(Rotation.from_euler("xyz", euler).as_matrix(), origin)
    points = np.arange(12.0).reshape(2, 2, 3)
    np.testing.assert_allclose(pose.to_whisker(pose.to_source(points)), points, atol=1e-13)
    np.testing.assert_allclose(
        pose.vectors_to_source(points),
        pose.to_source(points) - pose.to_source([0, 0, 0]),
        atol=1e-13,
    )
    assert not pose.rotation.flags.writeable


def test_bad_poses():
    with pytest.raises(ValueError, match=r"not orthogonal.*origin"):
        Pose(2 * np.eye(3), [0.0, np.nan, 0.0])
    with pytest.raises(ValueError, match="reflection"):
        Pose(-np.eye(3))
    with pytest.raises(ValueError, match="must have shape"):
        Pose().to_source([1.0, 2.0])


def test_gamma_is_as_published():
    whisker = samples.gamma()
    z = whisker.position(whisker.length)[2] * 1e3
    assert whisker.length == pytest.approx(40e-3)
    assert 1.3 < z < 1.6
    # Planar to 0.3 mm over the proximal 65 % (Towal et al. 2011).
    proximal = whisker.position(np.linspace(0, 0.65 * whisker.length, 50))
    assert np.abs(proximal[:, 2]).max() < 0.05e-3
    np.testing.assert_allclose(proximal[:, 1], 10 * proximal[:, 0] ** 2, atol=0.01e-3)
    assert "gamma" in repr(whisker)


@pytest.mark.parametrize(
    "make", [samples.straight, samples.straight_cylinder, samples.curved, samples.curved_cylinder]
)
def test_canonical_rods(make):
    whisker = make()
    assert whisker.is_straight == ("straight" in whisker.name)
    cylinder = "cylinder" in whisker.name
    assert whisker.tip_radius == pytest.approx(whisker.base_radius / (1 if cylinder else 15))


def test_a_base_radius_is_still_assumed_if_only_the_tip_s_is_stated():
    whisker = Whisker.from_points(Whisker.parabola(20e-3, 10.0).centerline(21))
    notes = whisker.with_properties(tip_radius=12e-6).notes
    (note,) = [each for each in notes if each.startswith("radius assumed")]
    assert "100 µm at the base, 12 µm at the tip" in note
    assert not any("radius assumed" in n for n in whisker.with_properties(base_radius=5e-5).notes)


@pytest.mark.parametrize("radius", [0.1e-6, 1e-10])
def test_a_radius_in_another_unit_is_not_that_of_a_hair(radius):
    with pytest.raises(ValueError, match="millimetres given as micrometres"):
        Whisker.straight(length=20e-3, base_radius=radius)
    Whisker.straight(length=0.1, base_radius=3.5e-6)  # a carbon fibre
