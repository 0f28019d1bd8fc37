"""An object is found from what all whiskers of a face feel of it together."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.objects import Mesh
from vibrissa.pipeline import with_contour
from vibrissa.simulation import array_whisking, head_path, measure, simulate, within_reach

SOME = vb.whisker_array("right", names=["B3", "C3", "C4", "D4"])


@pytest.fixture(scope="module")
def motions():
    time = np.arange(60) / 250.0
    turn, place = head_path(time, to_position=[0.0, 14e-3, 0.0])
    return array_whisking(SOME, 0.24, 250.0, head_rotation=turn, head_position=place)


@pytest.mark.slow
def test_a_sphere_from_all_whiskers(motions):
    ball = within_reach(SOME, "sphere")
    trial = measure(simulate(SOME, motions, ball), 0.0, 0.0)
    found = with_contour(trial, "sphere")
    truth, estimates = (found[part].to_dataset() for part in ("truth", "estimates"))
    error = np.linalg.norm(
        estimates["contact_point"].values - truth["contact_point"].values, axis=-1
    )
    known = np.isfinite(error)
    assert known.any(axis=0).sum() == len(SOME)
    # Contacts of the very tip are none that a frictionless shaft explains.
    side = known & (
        truth["arc_length"].values < 0.999 * np.array([w.length for w in SOME.values()])
    )
    assert np.median(error[side]) < 1e-6
    contour = found["contour"].to_dataset()
    assert np.linalg.norm(contour["center_offset"]) < 20e-6
    assert abs(float(contour["diameter_error"])) < 40e-6


@pytest.mark.slow
def test_a_mesh_is_touched_like_what_it_is_made_of(motions):
    trimesh = pytest.importorskip("trimesh")
    ball = within_reach(SOME, "sphere")
    surface = trimesh.creation.icosphere(subdivisions=3, radius=ball.radius)
    mesh = Mesh(np.array(surface.vertices) + ball.origin, np.array(surface.faces), resolution=1e-3)
    one = SOME.select(names=["C3"])
    by_mesh = simulate(one, motions, mesh)["truth"].to_dataset()
    by_ball = simulate(one, motions, ball)["truth"].to_dataset()
    both = by_mesh["in_contact"].values & by_ball["in_contact"].values
    assert both.sum() > 20
    apart = (by_mesh["contact_point"] - by_ball["contact_point"]).values[both]
    assert np.median(np.linalg.norm(apart, axis=-1)) < 0.3e-3
