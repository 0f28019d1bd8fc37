"""Contacts with friction along the whisker: the truth is in the regions that are stated."""

import numpy as np
import pytest
from scipy.stats import chi2

import vibrissa as vb
from vibrissa.contacts.joint.friction import _Nodes, _odds_of_all, _stated

NOISE = np.diag([1e-6**2] * 3 + [2e-8**2] * 3)
COUNT = 60


def rubbed(gamma_map, ratio, count=COUNT, seed=3):
    """Contacts whose force is oblique by so much, their friction angles and noisy signals."""
    rng = np.random.default_rng(seed)
    nodes = gamma_map.to_dataset().isel(station=slice(3, None), load=slice(3, -2))
    picked = rng.integers(0, nodes.arc_length.size, count)
    arc = nodes.arc_length.to_numpy().reshape(-1)[picked]
    bearing = np.broadcast_to(nodes.bearing.to_numpy()[:, None], nodes.arc_length.shape)
    force = np.broadcast_to(nodes.fold_force.to_numpy()[:, :, None], nodes.arc_length.shape)
    force = (force * nodes["load"].to_numpy() ** 2).reshape(-1)[picked]
    angle = bearing.reshape(-1)[picked]
    along = ratio * np.cos(rng.uniform(0.0, 2.0 * np.pi, count))
    components = force * np.stack([along, np.cos(angle), np.sin(angle)])
    bent = vb.deflect(gamma_map.whisker, vb.PointForce(arc, components=tuple(components)))
    noise = rng.normal(size=(count, 6)) * np.sqrt(np.diag(NOISE))
    signals = vb.base_signals(bent.force + noise[:, :3], bent.moment + noise[:, 3:])
    return bent.contact_point, np.arctan(along), signals


def held(found, truth):
    """Share of the truths in the 95 % regions."""
    away = found.point - truth
    size = np.einsum("ni,nij,nj->n", away, np.linalg.inv(found.covariance), away)
    return (size < chi2.isf(0.05, 3)).mean()


def missed(found, truth):
    return np.median(np.linalg.norm(found.point - truth, axis=1))


@pytest.mark.parametrize(
    "using", ["Fx FT MB MD", pytest.param("Fx FT FD Mx MB MD", marks=pytest.mark.slow)]
)
def test_with_the_transverse_force_friction_is_found(gamma_map, using):
    truth, angle, signals = rubbed(gamma_map, 0.4)
    found = gamma_map.estimate(signals, using, NOISE, friction=0.3)
    without = gamma_map.estimate(signals, using, NOISE)
    assert missed(found, truth) < 0.5 * missed(without, truth)
    assert held(found, truth) > 0.88
    assert held(without, truth) < 0.6
    assert (np.abs(found.friction_angle - angle) < 3.0 * found.friction_angle_sigma).mean() > 0.9


@pytest.mark.parametrize(("ratio", "absent"), [(0.05, 0.0), (0.0, 1.0)])
def test_whether_one_object_has_friction_is_one_question(gamma_map, ratio, absent):
    """Alone, most measurements deny weak friction, and their errors have the same sign."""
    truth, angle, signals = rubbed(gamma_map, ratio, seed=4)
    how = {"using": "Fx FT FD Mx MB MD", "noise": NOISE, "friction": 0.3}
    found = gamma_map.estimate(signals, **how, same_friction=True)
    alone = gamma_map.estimate(signals, **how)
    assert 0.1 < (alone.friction_angle == 0.0).mean() < 0.9
    assert (found.friction_angle == 0.0).mean() == absent
    assert held(found, truth) > 0.9
    clear = found.friction_angle_sigma < 0.05
    if ratio:
        slopes = [(one.friction_angle * angle)[clear].sum() for one in (alone, found)]
        before, now = np.array(slopes) / (angle[clear] ** 2).sum()
        assert before < 0.7 < now < 1.2
    else:
        assert missed(found, truth) < 0.8 * missed(alone, truth)


@pytest.mark.parametrize("using", ["Fx FT MB MD", "Fx FT FD Mx MB MD"])
def test_light_contacts_with_friction_are_not_drawn_towards_the_tip(gamma_map, using):
    """Signals hardly determine where they are, but most of the space within reach is there."""
    rng = np.random.default_rng(7)
    arc, bearing = 0.6 * gamma_map.whisker.length, rng.uniform(0.0, 2.0 * np.pi, COUNT)
    force = rng.uniform(6e-6, 12e-6, COUNT)
    along = 0.2 * np.cos(rng.uniform(0.0, 2.0 * np.pi, COUNT))
    components = force * np.stack([along, np.cos(bearing), np.sin(bearing)])
    bent = vb.deflect(
        gamma_map.whisker, vb.PointForce(np.full(COUNT, arc), components=tuple(components))
    )
    noise = rng.normal(size=(COUNT, 6)) * np.sqrt(np.diag(NOISE))
    light = vb.base_signals(bent.force + noise[:, :3], bent.moment + noise[:, 3:])
    # Whether there is friction is decided by others, which are clear.
    _, _, clear = rubbed(gamma_map, 0.3, count=20)
    signals = {name: np.append(light[name], clear[name]) for name in light}
    found = gamma_map.estimate(signals, using, NOISE, friction=0.3, same_friction=True)
    away = np.linalg.norm(found.point[:COUNT] - bent.contact_point, axis=1)
    predicted = np.sqrt(np.trace(found.covariance[:COUNT], axis1=1, axis2=2))
    assert np.median(away) < 1.1 * np.median(predicted)


def test_one_measurement_of_an_object_decides_by_itself(gamma_map):
    """Evidence that each of several contributes is bounded, which would widen its covariance."""
    _, _, signals = rubbed(gamma_map, 0.3, seed=4)
    how = {"using": "Fx FT FD Mx MB MD", "noise": NOISE, "friction": 0.3}
    one = {name: values[:1] for name, values in signals.items()}
    alone, found = (gamma_map.estimate(one, **how, same_friction=same) for same in (False, True))
    np.testing.assert_array_equal(found.covariance, alone.covariance)


@pytest.mark.parametrize("using", ["Fx FT MB MD", "Fx FT FD Mx MB MD"])
def test_a_prior_of_friction_costs_little_where_there_is_none(gamma_map, using):
    """Half of it is that there is none, which signals that determine friction then decide."""
    truth, _, signals = rubbed(gamma_map, 0.0)
    found = gamma_map.estimate(signals, using, NOISE, friction=0.3)
    without = gamma_map.estimate(signals, using, NOISE)
    assert missed(found, truth) < 1.5 * missed(without, truth)
    assert held(found, truth) > 0.9
    assert (found.friction_angle == 0.0).mean() > 0.8
    assert (found.friction_angle_sigma > 0.0).all()


@pytest.mark.parametrize("ratio", [0.0, 0.4])
def test_three_signals_state_what_friction_leaves_open(gamma_map, ratio):
    truth, _, signals = rubbed(gamma_map, ratio)
    found = gamma_map.estimate(signals, noise=NOISE, friction=0.3)
    assert np.isfinite(found.point).all()
    assert held(found, truth) > 0.88
    predicted = np.sqrt(np.trace(found.covariance, axis1=1, axis2=2))
    assert missed(found, truth) < np.median(predicted)


def test_shapes_missing_samples_and_priors(gamma_map):
    _, _, signals = rubbed(gamma_map, 0.3, count=4)
    columns = {name: signals[name].to_numpy().reshape(2, 2).copy() for name in ("Fx", "MB", "MD")}
    columns["Fx"][1, 1] = np.nan
    far = vb.Prior({"theta": (3.0, 3.1)})
    found = gamma_map.estimate(columns, noise=NOISE, friction=0.2)
    assert found.point.shape == (2, 2, 3)
    assert found.status[1, 1] == vb.Status.MISSING
    assert np.isfinite(found.point[0]).all()
    nothing = gamma_map.estimate(columns, noise=NOISE, friction=0.2, prior=far)
    assert (nothing.status[0] == vb.Status.OUTSIDE_PRIOR).all()


def test_without_noise_there_is_nothing_to_weigh_friction_against(gamma_map):
    signals = {"Fx": [-1e-5], "MB": [1e-6], "MD": [0.2]}
    with pytest.raises(ValueError, match="noise"):
        gamma_map.estimate(signals, friction=0.3)
    with pytest.raises(ValueError, match="standard deviation"):
        gamma_map.estimate(signals, noise=NOISE, friction=-0.3)


def test_every_result_states_what_it_assumes_of_friction(gamma_map):
    _, _, signals = rubbed(gamma_map, 0.0, 4)
    wrench = vb.estimate_from_wrench(gamma_map.whisker, [1e-5, 3e-5, 0.0], [0.0, 0.0, 8e-7])
    how = {"friction": 0.3, "noise": NOISE}
    one = [float(signals[name][0]) for name in ("Fx", "FT", "MB", "MD")]
    for found, friction, text in (
        (gamma_map.estimate(signals, noise=NOISE), 0.0, "no friction assumed"),
        (
            gamma_map.estimate(signals, "Fx FT MB MD", **how),
            0.3,
            "friction along the whisker of 0.3",
        ),
        (vb.Estimator(gamma_map, "Fx FT MB MD", **how)(one), 0.3, "0.3 (one sigma) allowed for"),
        (wrench, np.inf, "any friction along the whisker allowed for"),
    ):
        assert found.friction == found.candidates.friction == friction
        assert found.to_dataset().attrs["friction"] == friction
        assert text in " ".join(str(found).split())


def test_improbable_contacts_with_indefinite_covariances_are_left_out():
    """Rounding makes them so near slip-off, and one ended the estimates of a whole recording."""
    curve, s = np.repeat([0, 1], 3), np.tile([0.5, 0.51, 0.52], 2)
    x = np.column_stack([s, np.zeros(6), np.ones(6), np.zeros(6)])
    values = np.column_stack([np.zeros((6, 3)), s, np.zeros((6, 2))])
    spread = np.where(curve[:, None, None] > 0, -1.0, 1.0) * 1e-3 * np.eye(3)
    log = np.array([-1.0, 0.0, -1.0, -3001.0, -3000.0, -3001.0])
    nodes = _Nodes(curve, x, values, log, spread, np.full(6, 1e-4), np.where(curve, 6e3, 0.1))
    found = _stated(nodes, np.zeros(2, int), 1)
    assert found.number.tolist() == [1]
    assert found.x[0, 0, 0] == 0.51
    assert np.linalg.eigvalsh(found.covariances[0, 0])[0] > 0.0


def test_equal_ratios_that_no_single_measurement_shows_are_friction():
    rng, spread = np.random.default_rng(4), np.full(70, 0.024)
    odds = [_odds_of_all(mean + 0.025 * rng.normal(size=70), spread, 0.3) for mean in (0.0, 0.02)]
    assert odds[0] > 2.0
    assert odds[1] < 1e-3
