"""Objects are what their signed distances say, and come back from files."""

import numpy as np
import pytest

from vibrissa import samples
from vibrissa.io import load_recording, save_recording
from vibrissa.objects import Box, Peg, Plane, Sphere
from vibrissa.recording import Recording
from vibrissa.simulation import Motion, simulate, sweep_past, tabulated, whisking
from vibrissa.whisker import base_rotation

WHISKER = samples.gamma()
OBJECTS = [
    Peg([25e-3, 0.0, 0.0], [0.1, 0.2, 1.0], 1.35e-3),
    Sphere([24e-3, 1e-3, 0.0], 4e-3, stiffness=10.0),
    Plane([0.0, 12e-3, 0.0], [0.1, -1.0, 0.0]),
    Box([24e-3, 0.0, 0.0], [4e-3, 6e-3, 20e-3], base_rotation(0.3, 0.1, 0.2), edge_radius=0.5e-3),
]


@pytest.mark.parametrize("thing", OBJECTS, ids=lambda thing: type(thing).__name__)
def test_gradients_of_signed_distances(thing):
    generator = np.random.default_rng(1)
    step = 1e-7 * np.eye(3)
    for point in thing.origin + generator.normal(scale=8e-3, size=(20, 3)):
        distance, normal, turn = thing.local_geometry(point)
        assert distance == pytest.approx(float(thing.signed_distance(point)), abs=1e-15)
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
        around = thing.signed_distance(np.stack([point + step, point - step]))
        np.testing.assert_allclose((around[0] - around[1]) / 2e-7, normal, atol=1e-6)
        if distance > 0.0:
            normals = [
                thing.local_geometry(point + s)[1] - thing.local_geometry(point - s)[1]
                for s in step
            ]
            numeric = np.array(normals).T / 2e-7
            np.testing.assert_allclose(turn, numeric, atol=1e-5 * (1.0 + np.abs(turn).max()))
        # From anywhere outside, the nearest point of the surface lies straight ahead.
        if distance > 0.0:
            assert thing.signed_distance(point - distance * normal) == pytest.approx(0, abs=1e-12)


def test_a_box_is_a_box():
    box = OBJECTS[3]
    corner = box.origin + box.rotation @ (0.5 * box.size)
    # The corner of the sharp box lies outside of the rounded one's.
    away = (np.sqrt(3.0) - 1.0) * box.edge_radius
    assert box.signed_distance(corner) == pytest.approx(away)
    assert box.signed_distance(box.origin) == pytest.approx(-0.5 * box.size.min())
    face = box.origin + box.rotation @ np.array([0.0, 0.0, 0.5 * box.size[2]])
    assert box.signed_distance(face) == pytest.approx(0.0, abs=1e-15)


def test_they_come_back_from_a_file(tmp_path):
    motion = whisking(duration=0.004, rate=1000.0, set_point=-2.5)
    trial = simulate(WHISKER, motion, OBJECTS)
    save_recording(tmp_path / "trial.nc", trial)
    read = Recording(load_recording(tmp_path / "trial.nc")).objects
    assert [repr(thing) for thing in read] == [repr(thing) for thing in OBJECTS]
    assert read[1].stiffness == 10.0
    np.testing.assert_array_equal(read[3].rotation, OBJECTS[3].rotation)
    assert len(Recording(trial).pegs) == 1


def test_a_second_contact_is_told():
    near = Peg([20e-3, 0.0, 0.0], [0.0, 0.0, 1.0], 1e-3)
    turn = np.linspace(-0.2, 0.2, 41)
    motion = Motion(np.arange(41) / 1e3, turn, 0 * turn, 0 * turn, np.zeros((41, 3)))
    alone = simulate(WHISKER, motion, near)["truth"]
    assert not alone["second_contact"].values.any()
    # The near peg holds the whisker, whose outer part swings back, against the far one.
    before, place = alone["centerline"].values[19:21, 0, 27]
    ahead = (place - before) * [1.0, 1.0, 0.0]
    far = Peg(place + 1e-3 * ahead / np.linalg.norm(ahead), [0.0, 0.0, 1.0], 1e-3)
    truth = simulate(WHISKER, motion, [far, near], friction=1e-9)["truth"]
    assert (truth["contact_object"].values == 1).all()
    overlap = truth["overlap"].values[:, 0]
    second = truth["second_contact"].values[:, 0]
    assert not second[:19].any()
    assert second[20:30].all()
    # The peg's surface goes through the centreline there: the whisker's radius lies inside.
    assert overlap[20] == pytest.approx(WHISKER.radius(27 / 32 * WHISKER.length), rel=0.05)
    # Without friction both contacts are solved, and the centreline passes outside of both pegs.
    both = simulate(WHISKER, motion, [far, near])["truth"]
    assert (both["second_contact"].values[:, 0] == second).all()
    assert not both["overlap"].values.any()
    line = both["centerline"].values[20:30, 0, 20:]
    assert far.signed_distance(line).min() > 0.5 * overlap[20]
    assert far.signed_distance(truth["centerline"].values[20:30, 0, 20:]).min() < 0.0
    np.testing.assert_allclose(both["force"].values[:19], truth["force"].values[:19], atol=1e-12)
    assert np.linalg.norm((both["force"] - truth["force"]).values[25, 0]) > 1e-6


def test_friction_is_recorded():
    peg = OBJECTS[0]
    motion = sweep_past(WHISKER, peg, duration=0.2, rate=200.0)
    trial = simulate(WHISKER, motion, peg, friction=0.3)
    truth = trial["truth"]
    contact = truth["in_contact"].values[:, 0]
    force = np.einsum(
        "tij,tj->ti", trial["base_rotation"].values[:, 0], truth["force"].values[:, 0]
    )[contact]
    normal = truth["surface_normal"].values[contact, 0]
    pressing = np.einsum("ti,ti->t", force, normal)
    along = np.linalg.norm(force - pressing[:, None] * normal, axis=1)
    assert (along <= 0.3 * pressing * (1.0 + 1e-9)).all()
    assert along.max() > 0.1 * pressing.max()
    assert "friction 0.3" in trial.attrs["origin"]


def test_sweeps_past_spheres_and_boxes_too():
    for thing in (Sphere([24e-3, 0.0, 0.0], 4e-3), OBJECTS[3]):
        motion = sweep_past(WHISKER, thing, duration=0.2, rate=250.0)
        contact = simulate(WHISKER, motion, thing)["truth"]["in_contact"].values[:, 0]
        assert contact.any()
        assert not contact[-1]


class TestMotion:
    @pytest.mark.parametrize("share", [0.3, 0.4, 0.6, 0.7])
    def test_protraction_takes_its_share(self, share):
        motion = whisking(
            1.0, 2000.0, frequency=4.0, variation=0.0, protraction=share, elevation_drift=0.0
        )
        rising = np.diff(motion.azimuth) > 0.0
        assert rising.mean() == pytest.approx(share, abs=0.005)
        assert np.ptp(motion.azimuth) == pytest.approx(np.radians(60.0), rel=1e-4)

    def test_a_table_is_met_at_its_rows(self):
        time = np.linspace(0.0, 0.2, 21)
        angle = np.sin(20.0 * time)
        place = np.stack([time, 0 * time, -time], axis=1)
        motion = tabulated(time, angle, 0.1, 0.2 * angle, place, rate=1000.0)
        assert len(motion) == 201
        np.testing.assert_allclose(motion.azimuth[::10], angle, atol=1e-14)
        np.testing.assert_allclose(motion.azimuth, np.sin(20.0 * motion.time), atol=1e-4)
        np.testing.assert_allclose(motion.elevation, 0.1)
        np.testing.assert_allclose(motion.base_position[:, 2], -motion.time, atol=1e-15)

    def test_the_head_carries_the_whisker(self):
        motion = whisking(0.1, 100.0)
        turn = base_rotation(np.linspace(0.0, 0.5, 10), 0.1, 0.0)
        shift = np.linspace(0.0, 1e-3, 30).reshape(10, 3)
        carried = motion.on_head(turn, shift)
        np.testing.assert_allclose(carried.base_rotation, turn @ motion.base_rotation)
        expected = np.einsum("nij,nj->ni", turn, motion.base_position) + shift
        np.testing.assert_allclose(carried.base_position, expected)
        np.testing.assert_array_equal(carried.azimuth, motion.azimuth)
        trial = simulate(WHISKER, carried, OBJECTS[2])
        np.testing.assert_array_equal(trial["head_position"].values, shift)

    def test_faults(self):
        with pytest.raises(ValueError, match=r"protraction is 0\.8"):
            whisking(protraction=0.8)
        with pytest.raises(ValueError, match="rotation is not a rotation"):
            whisking(0.1).on_head(2.0 * np.eye(3), np.zeros(3))
        with pytest.raises(ValueError, match="already includes a motion"):
            whisking(0.1).on_head(np.eye(3), np.zeros(3)).on_head(np.eye(3), np.zeros(3))
        with pytest.raises(ValueError, match="azimuth has shape"):
            tabulated([0.0, 1.0], [0.0, 1.0, 2.0])


def test_faulty_objects():
    with pytest.raises(ValueError, match=r"radius is 0\.0; it must be positive, in m"):
        Sphere([0, 0, 0], 0.0)
    with pytest.raises(ValueError, match=r"radius has shape \(2,\); one number"):
        Sphere([0, 0, 0], [1e-3, 2e-3])
    with pytest.raises(ValueError, match="normal is"):
        Plane([0, 0, 0], [0, 0, 0])
    with pytest.raises(ValueError, match=r"edge_radius is 0\.01; at most half"):
        Box([0, 0, 0], [1e-2, 1e-2, 1e-2], edge_radius=1e-2)
    with pytest.raises(ValueError, match="not a rotation matrix"):
        Box([0, 0, 0], [1e-2, 1e-2, 1e-2], 2 * np.eye(3))
    with pytest.raises(ValueError, match="stiffness is -1"):
        Peg([0, 0, 0], [0, 0, 1], 1e-3, stiffness=-1.0)


def test_what_rounds_to_zero_has_no_sign():
    peg = Peg([25e-3, -1e-9, 0.0], [-1e-9, 0.0, 1.0], 1e-3)
    assert repr(peg).startswith("Peg(origin=(25.000, 0.000, 0.000) mm, axis=(0.000, 0.000, 1.000)")
    assert peg.in_words().startswith("peg: origin (25.000, 0.000, 0.000) mm, axis (0.000, 0.000, 1")
