"""Whiskers of an array move and feel as each does alone, both sides as mirror images."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.io import load_recording, save_recording
from vibrissa.objects import Plane, Sphere
from vibrissa.recording import Recording
from vibrissa.rod import follow_surfaces
from vibrissa.simulation import (
    Dynamics,
    ImageConditions,
    Motion,
    array_whisking,
    film_frames,
    head_path,
    measure,
    protracted,
    simulate,
    views_of,
)
from vibrissa.simulation.motion import ELEVATION_PER_AZIMUTH, ROLL_PER_AZIMUTH
from vibrissa.whisker import angles_of, base_rotation

ARRAY = vb.whisker_array(rows="BCD", columns=[1, 2])
MIRROR = np.array([-1.0, 1.0, 1.0])
TIME = np.arange(60) / 400.0
WALL = Plane([0.0, 21e-3, 0.0], [0.0, -1.0, 0.0])


@pytest.fixture(scope="module")
def motions():
    turn, place = head_path(TIME, to_position=[0.0, 14e-3, 0.0], to_angles=[0.0, 0.0, 0.1])
    return array_whisking(
        ARRAY,
        0.15,
        400.0,
        amplitude=np.radians(30.0),
        set_point=np.radians(35.0),
        head_rotation=turn,
        head_position=place,
        seed=2,
    )


@pytest.fixture(scope="module")
def trial(motions):
    return simulate(ARRAY, motions, WALL)


# Motion


def test_whiskers_begin_where_they_rest():
    still = np.zeros(3)
    motion = Motion(np.arange(3.0), still, still, still, np.zeros((3, 3)))
    assert repr(motion) == "<Motion of 3 frames, 2 s>"
    for name, moves in protracted(ARRAY, motion).items():
        pose = ARRAY[name].pose
        np.testing.assert_allclose(moves.base_rotation, [pose.rotation] * 3, atol=1e-14)
        np.testing.assert_allclose(moves.base_position, [pose.origin] * 3, atol=1e-15)


def test_protraction_is_forward_on_both_sides_and_by_the_rows_ratios():
    protraction = np.radians([0.0, 10.0])
    level = np.zeros(2)
    motion = Motion(np.arange(2.0), protraction, level, level, np.zeros((2, 3)))
    for name, moves in protracted(ARRAY, motion).items():
        row = ARRAY.identity(name).row
        tangent = moves.base_rotation[:, :, 0]
        assert tangent[1, 1] > tangent[0, 1]
        rest, now = angles_of(moves.base_rotation)
        sign = -1.0 if name.startswith("L") else 1.0
        ratios = [sign, ELEVATION_PER_AZIMUTH[row], sign * ROLL_PER_AZIMUTH[row]]
        np.testing.assert_allclose(now - rest, protraction[1] * np.array(ratios), atol=1e-12)


def test_both_sides_move_as_mirror_images():
    motions = array_whisking(ARRAY, 0.1, 200.0, position_drift=1e-3, seed=4)
    flat = np.diag(MIRROR)
    for name in ("B1", "C2", "D1"):
        left, right = motions["L" + name], motions["R" + name]
        np.testing.assert_allclose(left.base_position, right.base_position * MIRROR, atol=1e-15)
        image = flat @ right.base_rotation @ np.diag([1.0, 1.0, -1.0])
        np.testing.assert_allclose(left.base_rotation, image, atol=1e-12)


def test_a_head_goes_from_pose_to_pose():
    turn, place = head_path(TIME, [0, 0, 1e-3], to_position=[2e-3, 0, 0], to_angles=[0.3, 0, 0.1])
    np.testing.assert_allclose(place[[0, -1]], [[0, 0, 1e-3], [2e-3, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(turn[-1], base_rotation(0.3, 0.0, 0.1), atol=1e-14)
    steps = np.linalg.norm(np.diff(place, axis=0), axis=1)
    assert steps[0] < 0.02 * steps.max()
    assert steps[-1] < 0.02 * steps.max()


def test_bases_are_carried_by_the_head(motions):
    for name, moves in motions.items():
        on_head = np.einsum(
            "tji,tj->ti", moves.head_rotation, moves.base_position - moves.head_position
        )
        np.testing.assert_allclose(on_head, [ARRAY[name].pose.origin] * len(moves), atol=1e-15)


# Trial


def test_one_recording_of_all(trial, motions):
    assert list(trial["whisker"].values) == list(ARRAY)
    assert trial["force"].dims == ("time", "whisker", "space")
    assert trial.sizes["whisker"] == len(ARRAY)
    for i, (name, moves) in enumerate(motions.items()):
        np.testing.assert_array_equal(trial["base_position"].values[:, i], moves.base_position)
        np.testing.assert_array_equal(trial["base_rotation"].values[:, i], moves.base_rotation)
        assert Recording(trial).whisker(i).name == name
        np.testing.assert_array_equal(
            Recording(trial).whisker(i).pose.origin, ARRAY[name].pose.origin
        )
    np.testing.assert_array_equal(trial["head_position"].values, moves.head_position)
    touched = trial["truth"]["in_contact"].values.any(axis=0)
    assert touched.sum() >= 6


@pytest.mark.parametrize("name", ["LC1", "RB2"])
def test_a_whisker_feels_the_same_alone(trial, motions, name):
    alone = simulate(ARRAY[name], motions[name], WALL)
    for part in ("/", "truth"):
        one = alone[part].to_dataset()
        among = trial[part].to_dataset().sel(whisker=[name])
        assert one.drop_attrs().equals(among.drop_attrs())


def test_forces_are_those_of_the_rod(trial, motions):
    name = "RC2"
    found = follow_surfaces(
        ARRAY[name], [WALL], motions[name].base_rotation, motions[name].base_position
    )
    truth = trial["truth"].to_dataset().sel(whisker=name)
    np.testing.assert_array_equal(truth["force"].values, found.bent.force)


def test_contacts_of_all_whiskers_outline_the_object(trial):
    truth = trial["truth"].to_dataset()
    points = truth["contact_point"].values
    touching = truth["in_contact"].values
    s = truth["arc_length"].values
    (wall,) = Recording(trial).objects
    for i, whisker in enumerate(ARRAY.values()):
        rows = touching[:, i]
        gap = wall.signed_distance(points[rows, i]) - whisker.radius(s[rows, i])
        np.testing.assert_allclose(gap, 0.0, atol=1e-8)


def test_what_lies_symmetrically_is_felt_symmetrically(trial):
    # The wall is square to the head, whose path is in the y–z plane.
    truth = trial["truth"].to_dataset()
    for name in ("B1", "C2", "D2"):
        left, right = (truth.sel(whisker=side + name) for side in "LR")
        np.testing.assert_allclose(
            left["contact_force"].values, right["contact_force"].values * MIRROR, atol=1e-12
        )
        # In whisker frames that are mirror images, forces are the same but for z.
        np.testing.assert_allclose(
            left["force"].values, right["force"].values * [1.0, 1.0, -1.0], atol=1e-12
        )


def test_sensors_of_all_whiskers_have_noise_of_their_own(trial, tmp_path):
    measured = measure(trial, seed=3)
    noise = measured["force"].values - trial["truth"]["force"].values
    assert np.std(noise) == pytest.approx(1e-6, rel=0.1)
    assert abs(np.corrcoef(noise[:, 0].ravel(), noise[:, 1].ravel())[0, 1]) < 0.3
    save_recording(tmp_path / "array.nc", measured)
    again = load_recording(tmp_path / "array.nc")
    assert list(again["whisker"].values) == list(ARRAY)
    np.testing.assert_array_equal(again["force"].values, measured["force"].values)


@pytest.mark.slow
def test_whiskers_with_inertia():
    names = ["LC1", "RC1"]
    some = ARRAY.select(names=names)
    motions = array_whisking(some, 0.01, 500.0)
    trial = simulate(some, motions, WALL, dynamics=Dynamics(segments=8, step=2e-4))
    assert trial["truth"].sizes["whisker"] == 2
    assert np.isfinite(trial["force"].values).all()


def test_progress_counts_all_frames():
    some = ARRAY.select(names=["C1"])
    told = []
    motions = array_whisking(some, 0.01, 500.0)
    simulate(some, motions, WALL, progress=lambda done, total: told.append((done, total)))
    assert told == [(i + 1, 10) for i in range(10)]


def test_whiskers_and_motions_must_belong_together(motions):
    pair = [ARRAY["LC1"], ARRAY["LC2"]]
    both = [motions["LC1"], motions["LC2"]]
    with pytest.raises(ValueError, match="2 whiskers and 1 motions"):
        simulate(pair, both[:1], WALL)
    with pytest.raises(ValueError, match="no motion of LB1, LB2, LC1"):
        simulate(ARRAY, {"RC1": both[0]}, WALL)
    with pytest.raises(ValueError, match="several whiskers are called LC1"):
        simulate([pair[0], pair[0]], both, WALL)
    other = array_whisking(ARRAY.select(names=["LC2"]), 0.15, 200.0)["LC2"]
    with pytest.raises(ValueError, match="LC1 and LC2 differ in time"):
        simulate(pair, [both[0], other], WALL)
    free = array_whisking(ARRAY, 0.15, 400.0, head_position=[0.0, 0.0, 1e-3])["LC2"]
    with pytest.raises(ValueError, match="differ in head"):
        simulate(pair, [both[0], free], Sphere([0.0, 0.05, 0.0], 5e-3))


def test_a_film_shows_the_face_between_the_whiskers(trial):
    (top, _) = views_of(trial)
    tips = top.project(trial["truth"]["centerline"].values[:, :, -1])
    assert (tips > 0).all()
    assert (tips < np.array(top.size) - 1).all()
    first = next(iter(film_frames(trial, top, ImageConditions(unevenness=0.0))))
    snout = top.project(trial["base_position"].values[0].mean(axis=0))
    shaft = top.project(trial["truth"]["centerline"].values[0, 0, 10])
    column, row = snout.round().astype(int)
    assert first[row, column] < 40
    column, row = shaft.round().astype(int)
    around = first[row - 2 : row + 3, column - 2 : column + 3]
    assert np.median(first) > 150
    assert around.min() < np.median(first) - 15
