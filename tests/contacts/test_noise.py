"""Under noise: stated regions hold what they state, there is an answer, and its probability."""

import numpy as np
import pytest
from numba.core.types import Type
from scipy.optimize import least_squares
from scipy.stats import chi2

import vibrissa as vb
from vibrissa.contacts.engine import search
from vibrissa.contacts.engine.ranking import stages, stages_ahead
from vibrissa.contacts.uncertainty.posterior import ranked
from vibrissa.identifiability.twins import sample
from vibrissa.numerics import quick_exp
from vibrissa.rod import fold_forces, solve_forces
from vibrissa.signals import SIGNALS

SIGMA = np.repeat([1e-6, 2e-8], 3)
HELD, BEYOND = chi2.ppf([0.95, 0.9973], 3)
EVERY = " ".join(SIGNALS)


def contacts_of(contact_map, low, high, number, rng):
    """Force, moment and contact point, uniform over Ω between two loads (of the fold's)."""
    d, many = contact_map.chart.discretization, 12 * number
    load = rng.uniform(low, high, many)
    place = np.column_stack([rng.uniform(size=(many, 2)) * [1.0, 2.0 * np.pi], np.sqrt(load)])
    found = sample(contact_map, place, "reachable")
    volume = np.where(found.contacts.inside, found.volume, 0.0) / place[:, 2]
    values = found.contacts.values[rng.choice(many, number, p=volume / volume.sum())]
    force, point = values[:, :3] * d.force, values[:, 3:] * d.length
    return force, np.cross(point, force), point


def noisy_wrenches(force, moment, rng, sigma=SIGMA):
    wrench = np.concatenate([force, moment], axis=1)
    wrench = wrench + sigma * rng.normal(size=wrench.shape)
    return wrench[:, :3], wrench[:, 3:]


def distances(found, point, rows):
    """Squared distances of true contact points, in standard deviations of the estimates."""
    away = (found.point - point)[rows]
    return (away * np.linalg.solve(found.covariance[rows], away[..., None])[..., 0]).sum(axis=-1)


@pytest.fixture(scope="module")
def beside_slip_off(gamma_map):
    rng = np.random.default_rng(4)
    force, moment, point = contacts_of(gamma_map, 0.97, 0.995, 1500, rng)
    return *noisy_wrenches(force, moment, rng), point


@pytest.mark.parametrize(
    ("using", "share"),
    [("Fx MB MD", 0.96), ("Fx FT MB MD", 0.95), (EVERY, 0.95), ("wrench", 0.75)],
)
def test_regions_hold_what_they_state_up_to_slip_off(gamma_map, beside_slip_off, using, share):
    """Of 1,500 contacts, to three binomial standard deviations of 93 to 97 %, and of 0.4 %.

    Ellipsoids with the axes of the second moment held either the tails of bent sheets or 95 %, so
    that 87 to 93 % of all were valid.
    """
    force, moment, point = beside_slip_off
    covariance = np.diag(SIGMA**2)
    if using == "wrench":
        found = vb.estimate_from_wrench(gamma_map.whisker, force, moment, noise=covariance)
    else:
        found = gamma_map.estimate(vb.base_signals(force, moment), using, covariance)
    rows = (found.status == vb.Status.UNIQUE) & found.covariance_valid
    assert rows.mean() > share
    squares = distances(found, point, rows)
    error = 3.0 / np.sqrt(rows.sum())
    assert 0.93 - 0.25 * error < (squares <= HELD).mean() < 0.97 + 0.17 * error
    assert (squares > BEYOND).mean() < 0.004 + 0.063 * error


def test_mirror_images_are_found_and_flat_valleys_held(gamma_map, rng):
    """F_x, F_T and M_B: of UNIQUE answers a seventh had lost the image or the valley to it."""
    force, moment, point = contacts_of(gamma_map, 0.2, 0.97, 2000, rng)
    signals = vb.base_signals(*noisy_wrenches(force, moment, rng))
    found = gamma_map.estimate(signals, "Fx FT MB", np.diag(SIGMA**2))
    rows = found.status == vb.Status.UNIQUE
    assert rows.sum() > 100
    squares = distances(found, point, rows)
    assert (squares > BEYOND).mean() < 0.03
    assert (squares <= HELD).mean() > 0.9


@pytest.mark.parametrize("using", ["Fx FD MD", pytest.param("Fx Mx MD", marks=pytest.mark.slow)])
def test_directions_are_the_less_certain_the_smaller_what_they_are_of(gamma_map, rng, using):
    """Their sizes are not measured, and valleys of χ² are bent: about 3 % were beyond."""
    force, moment, point = contacts_of(gamma_map, 0.0, 1.0, 1500, rng)
    signals = vb.base_signals(*noisy_wrenches(force, moment, rng))
    found = gamma_map.estimate(signals, using, np.diag(SIGMA**2))
    rows = found.status == vb.Status.UNIQUE
    assert rows.sum() > 500
    squares = distances(found, point, rows)
    assert (squares > BEYOND).mean() < 0.012
    assert (squares <= HELD).mean() > 0.93


@pytest.mark.parametrize(
    ("using", "measured", "point"),
    [
        ("FD Mx MB", [0.1564502, -7.422291e-10, 1.087948e-6], [23.7168, 8.55583, 0.434136]),
        ("Fx FD MD", [1.103575e-5, 3.03442, -1.679331], [17.2426, 0.342818, 0.271234]),
        ("FT Mx MD", [1.174818e-4, -3.964273e-9, -1.527729], [24.6586, -0.0969479, -0.223557]),
        ("FT Mx MD", [3.998972e-3, 3.718574e-6, -2.09295], [3.60341, -6.98225, 4.56964]),
    ],
)
def test_valleys_without_visible_ends_widen_regions(gamma_map, using, measured, point):
    """Where a valley of χ² went on farther than it was followed, it counted as nothing."""
    signals = dict(zip(using.split(), np.array(measured)[:, None], strict=True))
    found = gamma_map.estimate(signals, using, np.diag(SIGMA**2))
    assert found.status == vb.Status.UNIQUE
    assert distances(found, 1e-3 * np.array([point]), np.array([True])) < BEYOND


def test_contacts_of_other_bearings_are_looked_for(gamma_map):
    """Those between a known bearing below zero and zero counted as near to it."""
    signals = {"FD": [2.519141], "Mx": [-2.37944e-6], "MB": [8.087351e-6]}
    found = gamma_map.estimate(signals, "FD Mx MB", np.diag(SIGMA**2))
    true = np.array([9.49745e-3, 7.25646e-3, -10.018e-3])
    away = np.linalg.norm(found.candidates.point[0, : found.n_candidates[0]] - true, axis=1)
    assert found.status == vb.Status.AMBIGUOUS
    assert away.min() < 2e-3 < away.max()


@pytest.fixture(scope="module")
def bent_map():
    """A map of a whisker that nearly lies in a plane."""
    length = 40e-3
    whisker = vb.Whisker.from_curvature(
        length,
        lambda s: np.stack([0 * s, 8.0 + 0 * s, 25.0 - 20.0 * s / length], -1),
        base_radius=60e-6,
        tip_radius=3e-6,
    )
    return vb.ContactMap.simulate(whisker, grid=False)


def test_a_contact_whose_mirror_image_is_nearly_as_probable_is_not_unique(bent_map):
    """F_x, F_T and M_B hardly tell the sides of a plane that the whisker nearly lies in."""
    rng = np.random.default_rng(1)
    force, moment, point = contacts_of(bent_map, 0.2, 0.995, 2000, rng)
    signals = vb.base_signals(*noisy_wrenches(force, moment, rng))
    found = bent_map.estimate(signals, "Fx FT MB", np.diag(SIGMA**2))
    rows = found.status == vb.Status.UNIQUE
    assert rows.sum() > 200
    # Expanded along straight lines, which leave bent valleys, the image was lost in a fifth.
    assert (distances(found, point, rows) > BEYOND).mean() < 0.08


def test_light_contacts_are_unique_where_a_wide_region_holds_them(bent_map):
    """Covariances where the second order fails were too narrow: 1.8 % beyond, some not finite."""
    rng = np.random.default_rng(0)
    force, moment, point = contacts_of(bent_map, 0.0, 0.5, 2000, rng)
    signals = vb.base_signals(*noisy_wrenches(force, moment, rng))
    found = bent_map.estimate(signals, "Fx FT MD", np.diag(SIGMA**2))
    unique = found.status == vb.Status.UNIQUE
    assert unique.mean() > 0.77
    assert np.isfinite(found.covariance[unique]).all()
    rows = unique & ~found.covariance_valid
    assert rows.sum() > 300
    assert (distances(found, point, rows) > BEYOND).mean() < 0.01


def test_where_it_cannot_be_relied_on_a_covariance_is_wide(gamma_map, rng):
    """Light contacts of a wrench, where to first order a fifth of the truths is not held."""
    force, moment, point = contacts_of(gamma_map, 0.0, 0.2, 1500, rng)
    noisy = noisy_wrenches(force, moment, rng)
    found = vb.estimate_from_wrench(gamma_map.whisker, *noisy, noise=np.diag(SIGMA**2))
    rows = (found.status == vb.Status.UNIQUE) & ~found.covariance_valid
    assert rows.sum() > 100
    assert (distances(found, point, rows) <= HELD).mean() > 0.86


@pytest.fixture(scope="module")
def wire():
    """A steel wire of one diameter: much of what noise does to it no contact of it gives."""
    wire = vb.Whisker.straight(0.15, base_radius=5e-4, tip_radius=5e-4, youngs_modulus=200e9)
    return vb.ContactMap.simulate(wire, grid=False)


@pytest.mark.parametrize("using", ["Fx FT MD", "Fx FT FD"])
def test_with_noise_there_is_an_answer(wire, rng, using):
    number, sigma = 300, np.repeat([1e-3, 20e-6], 3)
    load = vb.PointForce(
        rng.uniform(0.35, 0.99, number) * wire.whisker.length,
        rng.uniform(10e-3, 50e-3, number),
        rng.uniform(-np.pi, np.pi, number),
    )
    bent = vb.deflect(wire.whisker, load)
    signals = vb.base_signals(*noisy_wrenches(bent.force, bent.moment, rng, sigma))
    found = wire.estimate(signals, using, np.diag(sigma**2))
    answered = np.isin(found.status, [vb.Status.UNIQUE, vb.Status.AMBIGUOUS])
    assert answered.mean() > 0.99
    assert np.isfinite(found.covariance[answered]).all()
    moved = found.chi_squared > 1e-6
    assert moved.mean() > 0.02  # those had no answer without noise
    without = wire.estimate(signals, using)
    assert (without.n_candidates[moved] == 0).mean() > 0.95
    assert (without.n_candidates[answered & ~moved] > 0).all()


def test_an_answer_beside_the_map_is_the_contact_of_least_misfit(gamma_map, beside_slip_off):
    """No true contact has a smaller χ² of its own noise, in the signals' own deviations."""
    force, moment, point = beside_slip_off
    measured = vb.base_signals(force, moment)
    sigma = {"Fx": 1e-6, "MB": 2.5e-8, "MD": 0.01}
    found = gamma_map.estimate(measured, tuple(sigma), sigma)
    moved = np.flatnonzero(found.chi_squared > 1e-3)
    assert moved.size > 20
    true = vb.deflect(gamma_map.whisker, vb.PointContact(point[moved]))

    def misfit(signals):
        away = [measured[name].to_numpy()[moved] - signals[name].to_numpy() for name in sigma]
        away[2] = np.angle(np.exp(1j * away[2]))
        return sum((a / one) ** 2 for a, one in zip(away, sigma.values(), strict=True))

    own = misfit(vb.base_signals(found.force[moved], found.moment[moved]))
    # Size and direction of M are fitted as components: the same to second order in the noise.
    np.testing.assert_allclose(own, found.chi_squared[moved], rtol=1e-2)
    assert (own <= 1.01 * misfit(vb.base_signals(true.force, true.moment)) + 1e-3).all()


def test_an_answer_in_a_bent_valley_is_the_contact_of_least_misfit(gamma_map, rng):
    """Of light contacts that noise has carried out of T(Ω); SciPy, confined to Ω, gains nothing."""
    chart = gamma_map.chart
    d, sigma = chart.discretization, 1e-2 * SIGMA
    force, moment, _ = contacts_of(gamma_map, 0.0, 0.02, 900, rng)
    force, moment = noisy_wrenches(force, moment, rng, sigma)
    found = gamma_map.estimate(vb.base_signals(force, moment), "Fx MB MD", np.diag(sigma**2))
    moved = np.flatnonzero(found.chi_squared > 1e-3)[:30]
    assert moved.size == 30
    unit = np.array([d.force, d.moment, d.moment])

    def residuals(z, row):
        s, psi, load = z
        place = np.array([[s, np.cos(psi), np.sin(psi)]])
        fy, fz = load * fold_forces(chart.fold, place)[0] * place[0, 1:]
        value = solve_forces(d, np.array([[s, 0.0, fy, fz]]))[0][0]
        own = np.append(value[0], np.cross(value[3:], value[:3])[1:]) * unit
        return (own - np.append(force[row, 0], moment[row, 1:])) / sigma[[0, 3, 3]]

    for row in moved:
        s, (fy, fz) = found.arc_length[row] / d.length, found.contact_force[row, 1:] / d.force
        psi = np.arctan2(fz, fy)
        fold = fold_forces(chart.fold, np.array([[s, np.cos(psi), np.sin(psi)]]))[0]
        start = np.array([min(s, 1.0 - 1e-9), psi, min(np.hypot(fy, fz) / fold, 1.0 - 1e-9)])
        low, high = [chart.proximal - 1e-6, -np.inf, 0.0], [1.0, np.inf, 1.0]
        best = least_squares(residuals, start, bounds=(low, high), x_scale="jac", args=(row,))
        assert found.chi_squared[row] < 2.0 * best.cost + 0.02


def test_what_is_seen_at_nodes_is_within_the_bounds_of_their_block(gamma_map):
    of = vb.Estimator(
        gamma_map, "Fx FD MD", dict.fromkeys(("Fx", "FD", "MD"), 1e-3)
    ).readout.searched
    block = np.repeat(np.arange(of.blocks.size - 1), np.diff(of.blocks))
    assert of.blocks[-1] == of.seen.shape[1] == np.unique(of.contacts, axis=0).shape[0]
    away = of.seen - of.extent[0][:, block]
    away -= 2.0 * np.pi * np.rint(away * of.turns[:, None])
    assert (np.abs(away) <= of.extent[1][:, block] + 1e-9).all()
    assert np.median(of.extent[1], axis=1).max() < 0.5


@pytest.mark.slow
def test_probabilities_are_how_often_candidates_are_true(gamma_map, rng):
    """Calibration: of candidates called 5-35 and 35-65 % probable as many are the truth."""
    force, moment, point = contacts_of(gamma_map, 0.05, 0.9, 2000, rng)
    noisy = noisy_wrenches(force, moment, rng)
    found = gamma_map.estimate(vb.base_signals(*noisy), "Fx FT MB", np.diag(SIGMA**2))
    several = found.n_candidates > 1
    assert several.sum() > 100
    chance = found.candidates.probability[several]
    total = np.nansum(chance, axis=1)  # the rest is that of contacts that no candidate stands for
    assert (total <= 1.0 + 1e-9).all()
    assert (np.isclose(total, 1.0) | ~found.candidates.covariance_valid[several, 0]).all()
    assert (np.diff(chance, axis=1)[np.isfinite(chance[:, 1:])] <= 0.0).all()
    assert ((found.probability > 0.95) == (found.status == vb.Status.UNIQUE))[several].all()
    away = found.candidates.point[several] - point[several, None]
    away = np.linalg.norm(away, axis=2)
    true = away == np.nanmin(away, axis=1, keepdims=True)
    for low, high in ((0.05, 0.35), (0.35, 0.65)):
        within = (chance > low) & (chance <= high)
        error = 0.5 / np.sqrt(within.sum())
        assert abs(true[within].mean() - chance[within].mean()) < 3.0 * error + 0.05


def test_what_is_unique_is_the_truth(gamma_map, rng):
    """Other contacts are not taken for it, though these signals often have two."""
    force, moment, point = contacts_of(gamma_map, 0.05, 0.9, 3000, rng)
    noisy = noisy_wrenches(force, moment, rng)
    found = gamma_map.estimate(vb.base_signals(*noisy), "Fx FT MD", np.diag(SIGMA**2))
    rows = found.status == vb.Status.UNIQUE
    assert 0.6 < rows.mean() < 0.9
    assert (distances(found, point, rows) > BEYOND).mean() < 0.012


@pytest.mark.parametrize(
    "using", ["Fx MB MD", "Fx FT MB", pytest.param("Fx FT MB MD", marks=pytest.mark.slow)]
)
def test_a_stream_answers_as_a_batch_beside_the_map(gamma_map, beside_slip_off, using):
    signals = vb.base_signals(beside_slip_off[0], beside_slip_off[1])
    batch = gamma_map.estimate(signals, using, np.diag(SIGMA**2))
    rows = np.stack([signals[name] for name in using.split()], axis=-1)
    locate = vb.Estimator(gamma_map, using, np.diag(SIGMA**2))
    lost = np.flatnonzero(gamma_map.estimate(signals, using).n_candidates == 0)[:20]
    for i in [*range(20), *lost]:
        locate.reset()
        one = locate(rows[i])
        assert one.status == batch.status[i]
        assert one.covariance_valid == batch.covariance_valid[i]
        np.testing.assert_allclose(one.point, batch.point[i], atol=2e-3 * SIGMA[3] / SIGMA[0])
        np.testing.assert_allclose(one.probability, batch.probability[i], atol=0.02)


def test_without_noise_nothing_is_probable(gamma_map, beside_slip_off):
    signals = vb.base_signals(beside_slip_off[0][:20], beside_slip_off[1][:20])
    found = gamma_map.estimate(signals)
    assert np.isnan(found.probability).all()
    assert not found.covariance_valid.any()
    assert set(found.to_dataset().probability.dims) == set(found.dims)


def test_quick_exponentials_are_exact_enough_for_densities():
    x = np.linspace(-20.0, 20.0, 401)
    quick = np.array([quick_exp.py_func(one) for one in x])
    np.testing.assert_allclose(quick, np.exp(x), rtol=2e-7)
    assert 0.0 <= quick_exp.py_func(-1e6) < 1e-290


def test_ranks_are_probabilities(rng):
    weight = rng.normal(size=(50, 6)) * 10.0
    number = rng.integers(0, 7, 50)
    probability, order = ranked(weight, number)
    for row, n in enumerate(number):
        assert sorted(order[row]) == list(range(6))
        expected = np.exp(weight[row, order[row, :n]])
        np.testing.assert_allclose(probability[row, :n], expected / expected.sum(), rtol=1e-12)
        assert (np.diff(probability[row, :n]) <= 0.0).all()
        assert np.isnan(probability[row, n:]).all()


def located(gamma_map, triplet, rng, s, psi, load):
    """Contacts under some share of the fold's force, with noise: what is found, and its error."""
    d = gamma_map.chart.discretization
    fold = fold_forces(gamma_map.chart.fold, np.column_stack([s, np.cos(psi), np.sin(psi)]))
    force = load * fold
    contacts = np.column_stack([s, 0.0 * s, force * np.cos(psi), force * np.sin(psi)])
    values, _ = solve_forces(d, contacts)
    force, point = values[:, :3] * d.force, values[:, 3:] * d.length
    noisy = noisy_wrenches(force, np.cross(point, force), rng)
    found = gamma_map.estimate(vb.base_signals(*noisy), triplet, np.diag(SIGMA**2))
    return found, np.linalg.norm(found.point - point, axis=1) / d.length


def test_contacts_where_signals_fold_are_counted(gamma_map):
    """(FT, Mx, MB) folds near bearings of ±1.6 rad: noise moves what such contacts signal off it.

    Another contact, a quarter of the length away, explains the signals exactly. It is not the only
    one that is probable.
    """
    rng, number = np.random.default_rng(0), 60
    s, psi = rng.uniform(0.38, 0.46, number), rng.choice([-1.6, 1.6], number)
    load = rng.uniform(0.1, 0.3, number)
    found, away = located(gamma_map, "FT Mx MB", rng, s, psi, load)
    assert (found.status == vb.Status.AMBIGUOUS).mean() > 0.9
    assert (found.covariance_valid & (away > 0.1)).mean() < 0.05


@pytest.mark.parametrize(
    ("triplet", "low", "high"),
    [("Fx FT FD", 0.35, 0.6), ("FT MB MD", 0.65, 0.95), ("FT FD MB", 0.65, 0.85)],
)
def test_contacts_near_slip_off_are_counted(gamma_map, triplet, low, high):
    """They fill little space, but of two contacts that explain signals either may be the true."""
    rng, number = np.random.default_rng(1), 100
    s, psi = rng.uniform(low, high, number), rng.uniform(-np.pi, np.pi, number)
    load = rng.uniform(0.97, 0.995, number)
    found, away = located(gamma_map, triplet, rng, s, psi, load)
    wrong = away > 0.1
    assert wrong.mean() > 0.1
    assert (found.status[wrong] == vb.Status.AMBIGUOUS).mean() > 0.9


def test_near_another_contact_the_fold_is_counted(gamma_map):
    """Noise carries signals that fold at slip-off past it; a contact next to it then gives them."""
    rng, number = np.random.default_rng(3), 150
    s, psi = rng.uniform(0.6, 0.9, number), rng.uniform(-np.pi, np.pi, number)
    found, away = located(gamma_map, "Fx FT MD", rng, s, psi, rng.uniform(0.97, 0.995, number))
    sure = (found.status == vb.Status.UNIQUE) & found.covariance_valid
    deviation = np.sqrt(np.linalg.eigvalsh(found.covariance)[:, -1])
    far = away * gamma_map.whisker.length > 4.0 * deviation
    assert sure.sum() > 20
    assert (sure & far).sum() <= 1


@pytest.mark.parametrize(
    ("using", "force", "moment", "point"),
    [
        (
            "FT MB MD",
            (-417.158, -73.801, -69.545),
            (1199.513, -2700.669, -4290.484),
            (19.183, -6.954, 9.628),
        ),
        (
            "FT FD MD",
            (-1984.633, -98.508, 1199.818),
            (-4029.745, 12094.481, -5705.729),
            (7.404, -2.511, -10.578),
        ),
    ],
)
def test_a_minimum_at_the_fold_is_found_from_anywhere_on_it(gamma_map, using, force, moment, point):
    """Steps from the fold led to the contact inside that explains the signals exactly.

    Between it and the fold, where the true contact is, χ² is 26 and 420.
    """
    wrench = 1e-6 * np.array(force), 1e-9 * np.array(moment)
    found = gamma_map.estimate(vb.base_signals(*wrench), using, np.diag(SIGMA**2))
    assert found.status == vb.Status.AMBIGUOUS
    true = distances(found.candidates, 1e-3 * np.array(point), slice(int(found.n_candidates)))
    assert true.min() < HELD < BEYOND < true.max()


@pytest.mark.parametrize(
    ("force", "moment", "point"),
    [
        (
            (-1154.806, 252.094, 55.715),
            (-314.302, 801.463, -10576.929),
            (12.371, -11.842, -1.276),
        ),
        ((1.853, -0.789, 0.545), (-14.524, 0.347, 19.232), (35.167, 12.614, 1.0)),
    ],
)
def test_misfits_are_those_with_the_noise_at_the_contact(gamma_map, force, moment, point):
    """A direction is uncertain where its vector nearly vanishes; fits from there stated small χ².

    They ended at contacts whose directions are 140° from those measured, with valid covariances.
    """
    wrench = 1e-6 * np.array(force), 1e-9 * np.array(moment)
    found = gamma_map.estimate(vb.base_signals(*wrench), "FD Mx MD", np.diag(SIGMA**2))
    assert found.status == vb.Status.UNIQUE
    assert distances(found, 1e-3 * np.array(point), ()) < HELD


def test_a_light_contact_is_one_candidate(gamma_map):
    """What noise leaves open is a long valley, not several contacts in it."""
    rng, number = np.random.default_rng(2), 60
    s, psi = rng.uniform(0.6, 0.9, number), rng.uniform(-np.pi, np.pi, number)
    found, _ = located(gamma_map, "Fx MB MD", rng, s, psi, rng.uniform(0.01, 0.05, number))
    assert (found.n_candidates == 1).mean() > 0.95


def test_a_contact_behind_cells_where_a_force_may_vanish_is_found(gamma_map):
    """These hold any direction and gave one basin to two minima, of which one remained."""
    measured = {"FT": 1.79700712e-4, "Mx": 1.70035075e-7, "MD": 1.61170998}
    found = gamma_map.estimate(measured, "FT Mx MD", np.diag(SIGMA**2))
    assert found.status == vb.Status.AMBIGUOUS
    away = found.candidates.point[:2] - [8.81903e-3, 10.56042e-3, 0.34622e-3]
    spread = found.candidates.covariance[:2]
    squares = (away * np.linalg.solve(spread, away[..., None])[..., 0]).sum(axis=1)
    assert squares.min() < BEYOND < squares.max()


@pytest.mark.parametrize("using", ["Fx MB MD", "Fx FT MB MD"])
def test_kernels_are_compiled_beforehand_for_what_they_are_called_with(
    gamma_map, monkeypatch, using
):
    """Otherwise they would be compiled once more when they are called."""
    monkeypatch.setattr(search, "compile_stages", lambda *_: None)
    noise = dict.fromkeys(using.split(), 1e-7)
    locate = vb.Estimator(gamma_map, using=using, noise=noise)
    locate(np.full(len(noise), 1e-6))
    gamma_map.estimate({name: np.full(3, 1e-6) for name in noise}, using, noise)
    one = locate._search
    here, there = stages(one.readout.searched, one.readout.how, one._problem)
    ahead = stages_ahead(gamma_map.chart.discretization.rod) if len(noise) == 3 else []
    for kernel, arguments in here + there + ahead:
        types = (
            each if isinstance(each, Type) else kernel.typeof_pyval(each) for each in arguments
        )
        assert tuple(types) in kernel.overloads, kernel.py_func.__name__


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ({"Fx": 1e-12, "MB": 4e-16, "MD": 1e-4}, "noise of Fx, 1e-12 N, is smaller"),
        (np.diag(SIGMA), "noise of MB, 0.00014 N·m, is larger"),
        ({"Fx": 1.0, "MB": 0.02, "MD": 0.01}, "noise of Fx, 1 N, is larger"),
        ({"Fx": 1e-6, "MB": 2e-8, "MD": 5.0}, "noise of MD, an angle in rad, is 5"),
    ],
    ids=["variances", "deviations", "µN", "degrees"],
)
def test_noise_squared_or_in_other_units_is_questioned(gamma_map, noise, message):
    using = ("Fx", "MB", "MD")
    with pytest.warns(UserWarning, match=message):
        vb.Estimator(gamma_map, using, noise)
    signals = vb.base_signals([-65e-6, 28e-6, 15e-6], [0.14e-6, -0.5e-6, 1.52e-6])
    with pytest.warns(UserWarning, match=message):
        gamma_map.estimate(signals, using, noise)
    with pytest.warns(UserWarning, match=message):
        vb.sensitivity(gamma_map, noise=noise)
