"""Which side of a peg, where a peg goes through the whisker, and pegs at the base."""

import numpy as np
import pytest

import vibrissa as vb

RADIUS = 1.35e-3


@pytest.fixture(scope="module")
def whisker():
    return vb.samples.gamma()


@pytest.mark.parametrize("offset", [0.0, 1e-7, 1e-5, 1e-4])
def test_a_peg_through_the_whisker_pushes_it_out_somewhere(whisker, offset):
    rng = np.random.default_rng(3)
    s = rng.uniform(0.35, 1.0, 200) * whisker.length
    origin = whisker.position(s) + offset * rng.normal(size=(200, 3))
    bent = vb.deflect(whisker, vb.PegContact(origin, [0, 0, 1], radius=RADIUS))
    assert (bent.status == vb.Status.OK).all()


def test_a_peg_at_the_base_is_too_proximal_not_slipped(whisker):
    origin = whisker.position(np.array([0.0, 0.02, 0.1, 0.2]) * whisker.length)
    bent = vb.deflect(whisker, vb.PegContact(origin, [0, 0, 1], radius=RADIUS))
    assert (bent.status == vb.Status.TOO_PROXIMAL).all()
    assert np.isnan(bent.force).all()


def test_a_line_in_the_plane_of_the_whisker_is_no_numerical_accident(whisker):
    bent = vb.deflect(whisker, vb.PegContact([0.02, 0.005, 0.0], [1, 0, 0]))
    assert bent.status in (vb.Status.OK, vb.Status.NO_CONTACT)
    straight = vb.deflect(vb.Whisker.straight(0.04), vb.PegContact([0.02, 1e-3, 0.0], [1, 0, 0]))
    assert straight.status != vb.Status.NOT_CONVERGED


@pytest.mark.parametrize("side", [[0, 0, 0], [0, 0, 1], [0, 0, -2.5]])
def test_a_side_that_is_no_side_is_refused(side):
    with pytest.raises(ValueError, match="side must not be"):
        vb.PegContact([0.02, 0.005, 0.0], [0, 0, 1], radius=RADIUS, side=side)


def test_start_must_be_a_deflection_by_a_peg(whisker):
    with pytest.raises(ValueError, match="got one by int"):
        vb.PegContact([0.02, 0.005, 0.0], [0, 0, 1], start=5)
    bent = vb.deflect(whisker, vb.PointContact([0.024, 0.014, 0.002]))
    with pytest.raises(ValueError, match="got one by PointContact"):
        vb.PegContact([0.02, 0.005, 0.0], [0, 0, 1], start=bent)
