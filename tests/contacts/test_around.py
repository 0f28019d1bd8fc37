"""Contacts with a known object, where a whisker lies along it."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.objects import Peg, Placement, Plane, Sphere
from vibrissa.rod import NearObjects, discretize

WIRE = vb.Whisker.from_curvature(0.1, lambda s: [0.0, 0.0, 8.0], base_radius=0.2e-3)
PIPE = Peg([0.055, 0.138, 0.0], [0.3, 0.0, 1.0], 0.14)
NAMES = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")


@pytest.mark.slow
def test_an_arc_is_found_with_the_object():
    d = discretize(WIRE)
    scale = np.repeat([d.force, d.moment], 3)
    shift = np.array([0.6e-3, -0.7e-3, 0.5e-3])
    place = Placement(np.eye(3), -shift)
    found = NearObjects(WIRE, PIPE, 48).from_outside(place, np.zeros(3))
    s, _, _, push = found.contacts()
    arc, point, _ = found.first_contact()
    assert s.size > 20
    noise = dict(zip(NAMES, 0.005 * scale, strict=True))
    wrench = scale * (found.wrench() + 0.005 * np.random.default_rng(2).normal(size=6))
    rows = np.stack([wrench, np.full(6, np.nan)])
    out = vb.estimate_around(WIRE, rows[:, :3], rows[:, 3:], PIPE, noise=noise, position_sigma=1e-3)
    assert out.status.values.tolist() == [vb.Status.OK, vb.Status.MISSING]
    assert out.contacts.values[0] > 10
    assert np.isnan(out.contact_point_whisker.values[1]).all()
    away = out.contact_point_whisker.values[0] - point * d.length
    predicted = np.sqrt(np.trace(out.covariance.values[0]))
    assert np.linalg.norm(away) < min(3.0 * predicted, 0.4e-3)
    assert out.arc_length.values[0] == pytest.approx(arc * d.length, abs=0.4e-3)
    assert out.last_arc_length.values[0] == pytest.approx(d.length)
    # The wrench says where the surface is; along the pipe only the prior does.
    off = (out.object_shift.values[0] - shift) @ push[0] / np.linalg.norm(push[0])
    assert abs(off) < 0.15e-3
    spread = PIPE.axis @ out.object_shift_covariance.values[0] @ PIPE.axis
    assert 0.9e-3 < np.sqrt(spread) < 1.01e-3
    one = vb.estimate_from_wrench(WIRE, wrench[:3], wrench[3:], noise=noise)
    assert np.linalg.norm(one.point - point * d.length) > 2.0 * np.linalg.norm(away)
    # No pipe there exerts another force.
    wrong = vb.estimate_around(
        WIRE,
        wrench[:3] + np.array([0.0, 0.0, 30.0 * noise["Fx"]]),
        wrench[3:],
        PIPE,
        noise=noise,
        position_sigma=1e-3,
    )
    assert int(wrong.status) == vb.Status.NOT_FRICTIONLESS


@pytest.mark.slow
def test_regions_hold_a_contact_between_coarse_nodes():
    """Against a wall the γ whisker's first contact is known to 10 µm across it."""
    whisker = vb.samples.gamma()
    d, shift = discretize(whisker), np.array([0.3e-3, -0.4e-3, 0.5e-3])
    wall = Plane([0.0, 6e-3, 0.0], [0.05, -1.0, -0.3])
    found = NearObjects(whisker, wall, 160).from_outside(Placement(np.eye(3), -shift), np.zeros(3))
    scale = np.repeat([d.force, d.moment], 3)
    wrench, noise = scale * found.wrench(), dict(zip(NAMES, 7e-3 * scale, strict=True))
    out = vb.estimate_around(
        whisker, wrench[:3], wrench[3:], wall, noise=noise, position_sigma=1e-3
    )
    away = out.contact_point_whisker.values - found.first_contact()[1] * d.length
    spread = out.covariance.values
    assert away @ np.linalg.solve(spread, away) < 3.0
    assert np.linalg.eigvalsh(spread)[1] < (20e-6) ** 2


def test_it_is_known_how_far_along_the_whisker_a_thin_peg_may_be():
    """Nodes follow its contact; held where they were, the shift seemed ten times as certain."""
    whisker = vb.samples.gamma()
    d = discretize(whisker)
    peg = Peg(whisker.position(25e-3) - [0.0, 1.45e-3, 0.0], [0.0, 0.0, 1.0], 1.35e-3)
    near, place = NearObjects(whisker, peg, 96), Placement(np.eye(3), np.array([0, -1.5e-3, 0]))
    true = near.from_outside(place, np.zeros(3))
    scale = np.repeat([d.force, d.moment], 3)
    wrench, noise = true.wrench() * scale, np.repeat([1e-6, 2e-8], 3)
    found = vb.estimate_around(
        whisker,
        wrench[:3],
        wrench[3:],
        peg,
        noise=dict(zip(NAMES, noise, strict=True)),
        position_sigma=0.5e-3,
        base_position=place.position,
    )
    assert found.status == vb.Status.OK
    step = 0.1e-3
    ways = [near.moved(place, way * step / d.length, true) for way in (*np.eye(3), *-np.eye(3))]
    wrenches = np.array([one.wrench() for one in ways]) * scale / noise
    slopes = (wrenches[:3] - wrenches[3:]) / (2.0 * step)
    expected = np.linalg.inv(slopes @ slopes.T + np.eye(3) / 0.5e-3**2)
    np.testing.assert_allclose(np.diag(found.object_shift_covariance), np.diag(expected), rtol=0.2)


def test_bad_input_is_refused():
    noise = dict.fromkeys(NAMES, 1e-6)
    force = np.zeros((2, 3))
    with pytest.raises(ValueError, match="position_sigma is positive, m; got 0"):
        vb.estimate_around(WIRE, force, force, PIPE, noise=noise, position_sigma=0)
    with pytest.raises(ValueError, match=r"base_position \(2, 3\); got \(3, 3\) and \(3, 3\)"):
        vb.estimate_around(
            WIRE,
            force,
            force,
            PIPE,
            noise=noise,
            position_sigma=1e-3,
            base_position=np.zeros((3, 3)),
        )
    soft = Sphere([0.05, 0.0, 0.0], 0.01, stiffness=10.0)
    with pytest.raises(ValueError, match="rigid objects only"):
        vb.estimate_around(WIRE, force, force, soft, noise=noise, position_sigma=1e-3)
