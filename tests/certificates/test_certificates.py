"""Enclosures never miss, and the straight tapered whisker is a theorem."""

import copy
from fractions import Fraction

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from typer.testing import CliRunner

import vibrissa as vb
from vibrissa.certificates import (
    certificate as made,
    certify,
    check_certificate,
    checker,
    curved_checker,
    domain,
    load_certificate,
    outlook,
    prove_witness,
    smallest_cone,
)
from vibrissa.certificates.certificate import prepare_certificate
from vibrissa.certificates.checker import covers
from vibrissa.certificates.equations import enclose_rational
from vibrissa.certificates.search import bounds, cover
from vibrissa.cli.app import app
from vibrissa.identifiability import verdict_table
from vibrissa.io import write_netcdf


def charted(whisker):
    return vb.ContactMap.simulate(whisker, grid=False)


def straight(ratio):
    return charted(vb.Whisker.straight(40e-3, tip_radius=100e-6 / ratio))


@pytest.fixture(scope="module")
def curved():
    return charted(vb.Whisker.parabola(length=39.4e-3, coefficient=10.0))


@pytest.fixture(scope="module")
def steep():
    return charted(vb.Whisker.parabola(40e-3, 0.82 / 40e-3))


@pytest.fixture(scope="module")
def theorem(tmp_path_factory):
    """Certificate of a straight whisker: stopped at once, read again, continued."""
    path = tmp_path_factory.mktemp("certificates") / "straight.nc"
    contact_map = straight(15.0)
    stopped = certify(contact_map, path=path, seconds=0.0)
    return path, stopped, certify(contact_map, path=path)


def write_forged(path, data):
    """Write a certificate that was changed, with the hash of its new contents."""
    data.attrs["identity"] = checker.identity(data)
    write_netcdf(path, data)


def test_a_straight_tapered_whisker_is_located_by_fx_mb_md(theorem):
    _, stopped, found = theorem
    assert not stopped.proved
    assert "not finished" in stopped.summary()
    assert "interior 0.000 % (undecided: s 0.3 to 1, ℓ 0 to 1)" in stopped.summary()
    assert found.proved
    assert "unique (proved), for contacts from 0.3 L to the tip" in found.summary()
    assert repr(found) == f"<{found.summary()}>"
    assert found.share == 1.0
    assert set(found.parts) == {"interior", "proximal", "distal", "fold"}


@pytest.mark.parametrize("ratio", [60.0, 1.05])
def test_uniqueness_on_straight_whiskers_of_any_taper(ratio):
    assert certify(straight(ratio), seconds=60.0).proved


def test_a_cylinder_is_not_proved():
    # F_x = -M_B²/2EI for a cylinder: the determinant is zero everywhere.
    found = certify(straight(1.0), seconds=5.0)
    assert not found.proved
    assert "determinant" in found.refuted
    assert sum(part.evaluated for part in found.parts.values()) == 0


@pytest.mark.slow
def test_a_curved_whisker_with_wrong_signs_is_refuted_at_once(steep):
    found = certify(steep, np.deg2rad(3.0))
    assert not found.proved
    assert "outside 7.2" in found.refuted
    assert "try a cone of 8.7°" in found.refuted
    certain = prepare_certificate(steep, np.deg2rad(1.0))
    certain.probe()
    assert "is certainly wrong" in certain.refuted


@pytest.mark.slow
def test_the_smallest_cone_of_a_grid_is_that_from_where_on_no_sign_is_wrong(steep):
    cone = smallest_cone(steep)
    # Its determinant changes sign at 5.23°; forces begin a little within the cone.
    assert 6.0 < np.rad2deg(cone) < 8.0
    larger = prepare_certificate(steep, 1.01 * cone)
    larger.probe()
    assert not larger.refuted
    assert outlook(steep, 0.8 * cone).failing["determinant"] > 0.0
    with pytest.raises(ValueError, match="cones below 18"):
        prepare_certificate(steep, np.deg2rad(19.0))


def test_a_certificate_with_a_hole_or_a_wrong_whisker_is_noticed(theorem):
    path, _, found = theorem
    again = load_certificate(path)
    assert again.identity == found.identity
    assert again.proved
    interior = again.parts["interior"]
    interior.certified = np.delete(interior.certified, 77, axis=0)
    assert not again.proved
    data = found.to_dataset()
    data["factors"] = data["factors"] * 1.1
    with pytest.raises(ValueError, match="modified since"):
        type(found).from_dataset(data)
    with pytest.raises(ValueError, match="another whisker"):
        certify(straight(8.0), path=path)


def test_a_certificate_of_which_anything_was_changed_is_refused(theorem, tmp_path):
    _, _, found = theorem
    for name, value in found.to_dataset().attrs.items():
        data = found.to_dataset()
        data.attrs[name] = value + " " if isinstance(value, str) else np.multiply(value, 1.5) + 1
        with pytest.raises(ValueError, match=r"has been modified|not a certificate"):
            type(found).from_dataset(data)
    data = found.to_dataset().isel(interior_certified_box=slice(1))
    data["interior_certified"] *= 0  # one box for the whole
    write_netcdf(tmp_path / "changed.nc", data)
    with pytest.raises(ValueError, match=r"changed\.nc: .*has been modified.*compute a new one"):
        load_certificate(tmp_path / "changed.nc")


def test_a_certificate_that_lacks_something_says_what(theorem, tmp_path):
    path = tmp_path / "incomplete.nc"
    whole = theorem[2].to_dataset()
    for name in ("factors", "fold_domain", "rod_edges", "straight", "room"):
        data = whole.copy(deep=True)
        (data.attrs if name in data.attrs else data).__delitem__(name)
        write_forged(path, data)
        for read in (check_certificate, load_certificate):
            with pytest.raises(ValueError, match=rf"not a complete certificate: .*\b{name}\b"):
                read(path)


def test_an_unfinished_certificate_does_not_state_100_percent(theorem):
    certificate = copy.deepcopy(theorem[2])
    interior = certificate.parts["interior"]
    interior.undecided, interior.certified = np.array([[[12, 5], [12, 7]]]), interior.certified[:-1]
    assert "interior 99.999 % (undecided: s " in certificate.summary()
    assert "fold 100 %" in certificate.summary()


@pytest.mark.slow
def test_an_independent_check_confirms_boxes_and_no_others(theorem, tmp_path, monkeypatch):
    path, _, found = theorem
    monkeypatch.setattr(checker, "_ROUNDS", 4)
    seed = 7  # boxes of small loads, which are integrated in few steps
    checked = check_certificate(path, 1, seed)
    assert checked.covers
    assert checked.confirmed == checked.boxes == 4
    # Half the force: that face is not beyond the fold.
    forged = tmp_path / "forged.nc"
    changed = load_certificate(path)
    changed.bounds = changed.bounds._replace(factors=0.5 * changed.bounds.factors)
    changed.save(forged)
    assert check_certificate(forged, 1, seed, parts=["fold"])[1:] == (1, 0)
    data = found.to_dataset()
    data["distal_domain"][0, 0] = 0.5
    write_forged(forged, data)
    assert not check_certificate(forged, 1, parts=["distal"]).covers
    data = found.to_dataset()
    data["factors"] = data["factors"] * 1.1
    write_netcdf(forged, data)
    with pytest.raises(ValueError, match="modified since"):
        check_certificate(forged)
    changed = load_certificate(path)
    curvature = changed.rod.coefficients.copy()
    curvature[0, 2, 0, 0] = 0.1  # called straight, but bent
    changed.rod = changed.rod._replace(coefficients=curvature)
    changed.save(forged)
    assert not check_certificate(forged, 0).covers


def test_what_cannot_be_checked_is_not_called_a_hole(theorem, tmp_path):
    """The check of straight whiskers is for linear radii; others were called full of holes."""
    for wrong in ({"parts": ["sides"]}, {"parts": []}, {"number": -1}):
        with pytest.raises(ValueError, match=r"parts is|number of boxes is"):
            check_certificate(theorem[0], **wrong)
    bent = vb.Whisker.straight(30e-3, radius=lambda s: 60e-6 * (1.0 - 0.9 * (s / 30e-3) ** 1.1))
    path = tmp_path / "certificate.nc"
    assert certify(charted(bent), path=path).proved
    with pytest.raises(ValueError, match="only those whose radius is linear can be verified"):
        check_certificate(path)
    shown = " ".join(CliRunner().invoke(app, ["info", str(path), "--all"]).output.split())
    assert "checked no: " in shown
    assert "do not fill" not in shown


@pytest.mark.slow
def test_an_independent_check_of_a_curved_whisker(curved, tmp_path, monkeypatch):
    path, certificate = tmp_path / "curved.nc", prepare_certificate(curved, np.deg2rad(2.0))
    certificate.pursue("rest", 10**4)
    certificate.save(path)
    whole = check_certificate(path, 2, parts=["rest"], whisker=curved.whisker)
    assert whole == (True, 2, 2)
    with pytest.raises(ValueError, match="another whisker"):
        check_certificate(path, whisker=vb.samples.gamma())
    boxes = certificate.parts["rest"].certified
    larger = boxes.copy()
    larger[5, 1] = larger[5, 1, 0] - 1, larger[5, 1, 1] // 2  # its parent
    assert covers(boxes)
    assert not covers(larger)
    assert not covers(np.delete(boxes, 5, axis=0))
    data = certificate.to_dataset()
    data.attrs["cone"] *= 0.99  # contacts that are left out are not within this one
    write_forged(path, data)
    assert not check_certificate(path, 0).covers
    # Without a cone: the square of this room is that of one so large that all contacts are in it.
    data = certificate.to_dataset()
    data.attrs |= {"cone": -0.1, "room": -0.5}
    write_forged(path, data)
    assert not check_certificate(path, 0).covers
    monkeypatch.setattr(checker, "_ROUNDS", 1)
    small, large = np.array([[[10, 600], [7, 30], [6, 30]]]), np.array([[[4, 9], [1, 0], [1, 0]]])
    for sign, box, confirmed in ((1.0, small, 1), (-1.0, small, 0), (1.0, large, 0)):
        certificate.parts["interior"].certified = box
        data = certificate.to_dataset()
        data.attrs["sign"] *= sign
        write_forged(path, data)
        assert check_certificate(path, parts=["interior"]).confirmed == confirmed


def test_verdicts_name_their_evidence(theorem):
    _, _, certificate = theorem
    contact_map = straight(15.0)
    asked = {"regions": ["all"], "samples": 64, "resolution": False}
    triplets = ["Fx MB MD", "Mx MB MD", "Fx FD MB"]
    found = vb.uniqueness(contact_map, triplets, certificate=certificate, **asked)
    assert found.evidence.values[:, 0].tolist() == ["proved", "witness", "proved"]
    assert found.attrs["certificate_possible"]
    assert "unique (proved)" in verdict_table(found)
    without = vb.uniqueness(contact_map, triplets[:1], **asked)
    assert without.evidence.values[0, 0] == "no counterexample found"
    with pytest.raises(ValueError, match="another whisker"):
        vb.uniqueness(straight(8.0), triplets, certificate=certificate, **asked)


def test_a_certificate_is_made_and_shown_by_commands(theorem, tmp_path):
    path, _, _ = theorem
    straight(15.0).save(tmp_path / "map.nc")
    command = ["uniqueness", str(tmp_path / "map.nc"), "--using", "Fx,MB,MD", "--region", "all"]
    command += ["--samples", "64", "--no-resolution", "--certify", str(path)]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert "Certificate: (Fx, MB, MD) is unique (proved)" in result.output
    shown = CliRunner().invoke(app, ["info", str(path)])
    assert "unique (proved)" in " ".join(shown.output.split())
    assert "0 undecided" in shown.output


@pytest.mark.slow
def test_witnesses_are_proved_and_other_pairs_are_not(curved):
    found = vb.uniqueness(curved, ["FT FD MB"], ["all"], samples=64, resolution=False)
    found = vb.identifiability.with_proved_witnesses(curved, found.isel(witness=[0]))
    pair = found.isel(triplet=0, region=0, witness=0)
    assert pair.witness_proved == 1
    s, force = pair.witness_arc_length.values, pair.witness_contact_force.values
    length = curved.whisker.length
    whole = prove_witness(curved, "FT FD MB", s, force)
    assert whole.proved
    assert whole.separation == pytest.approx(float(pair.witness_separation) / length, abs=1e-4)
    assert whole.reach < 1e-5
    # The same contact twice; one whose force is beyond the fold; signals that fix no contact.
    assert "same" in prove_witness(curved, "FT FD MB", s[[0, 0]], force[[0, 0]]).doubt
    s, beyond = np.array([0.5, 0.5]) * length, np.array([[1.0, 0.0], [1.0, 0.0]])
    beyond *= 3.0 * float(np.hypot(*force.T).max())
    assert not prove_witness(curved, "FT FD MB", s, beyond).proved
    assert not prove_witness(straight(1.0), "Fx MB MD", s, force).proved


@pytest.mark.parametrize(
    ("ratio", "triplet", "turn"),
    [
        (15.0, "FT MB MD", 0.3),
        pytest.param(15.0, "Mx MB MD", 0.3, marks=pytest.mark.slow),
        pytest.param(15.0, "Fx FT MB", 2.0, marks=pytest.mark.slow),
        pytest.param(1.0, "Fx MB MD", 0, marks=pytest.mark.slow),
    ],
)
def test_witnesses_in_one_plane_are_proved(ratio, triplet, turn):
    """Signals that do not fix a contact where a straight whisker is its own mirror image."""
    contact_map = straight(ratio)
    found = vb.uniqueness(contact_map, [triplet], ["all"], samples=64, resolution=False)
    pair = found.isel(triplet=0, region=0, witness=0)
    s, force = pair.witness_arc_length.values, pair.witness_contact_force.values
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    whole = prove_witness(contact_map, triplet, s, force @ rotation.T)
    assert whole.proved, whole.doubt
    assert whole.separation > 0.01
    # Turned against each other they have other directions.
    if "MD" in triplet:
        assert not prove_witness(contact_map, triplet, s, [force[0], -force[1]]).proved


def test_boxes_cover_or_leave_a_hole():
    rng = np.random.default_rng(0)
    boxes = [np.zeros((3, 2), dtype=np.int64)]
    for _ in range(60):
        box = boxes.pop(rng.integers(len(boxes)))
        axis = rng.integers(3)
        for half in (0, 1):
            child = box.copy()
            child[axis] = child[axis, 0] + 1, 2 * child[axis, 1] + half
            boxes.append(child)
    everything = np.stack(boxes)
    assert covers(everything)
    assert not covers(np.concatenate([everything, everything[:1]]))
    assert not any(covers(np.delete(everything, i, axis=0)) for i in range(len(boxes)))


def signals(whisker, s, force):
    """(M_y, M_z, F_x), (3, k), by the rod's equations in SciPy's hands, contacts (k,) to base."""
    length, radius = whisker.length, whisker.base_radius
    softness = np.array([[1.0 + whisker.poisson_ratio], [1.0], [1.0]])

    def rate(t, state):
        at = s * (1.0 - t) * length
        n, q = state.reshape(2, 3, -1)
        stretch = softness * (whisker.section_radius(at) / radius) ** -4
        u = whisker.intrinsic_curvature(at).T * length + stretch * np.cross(q, n, axis=0)
        turned = [-np.cross(n, u, axis=0), np.eye(3)[:, :1] - np.cross(q, u, axis=0)]
        return (s * np.stack(turned)).ravel()

    start = np.concatenate([np.zeros((1, len(s))), force, np.zeros((3, len(s)))])
    end = solve_ivp(rate, (0.0, 1.0), start.ravel(), "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    n, q = end.reshape(2, 3, -1)
    moment = np.cross(q, n, axis=0)
    return moment[1], moment[2], n[0]


def located(certificate, whisker, at):
    """(ln M_B, M_D, F_x/M_B), (3, k), M_B, f and ∂f/∂ℓ at (s, φ, ℓ), (k, 3)."""
    s, phi, level = at.T
    f, _, _, f_level = certificate.bounds.force(s, phi, level)
    if certificate.straight:
        f = np.sqrt(level) * certificate.bounds.force(s, 0.0 * s, 0.0 * s + 1.0)[0]
    y, z, x = signals(whisker, s, f * np.array([np.cos(phi), np.sin(phi)]))
    moment = np.hypot(y, z)
    return np.array([np.log(moment), np.arctan2(z, y), x / moment]), moment, f, f_level


def conditions(certificate, whisker, at):
    """The conditions by their definition, with differences of fourth order."""
    steps = 2e-3 * np.array([1.0, 1.0, 0.3])
    around = [at + k * step for step in np.diag(steps) for k in (-2, -1, 1, 2)]
    values, *others = located(certificate, whisker, np.array([at, *around]))
    value, (moment, f, f_level) = values[:, 0], (other[0] for other in others)
    near = values[:, 1:].reshape(3, 3, 4)
    near[1] -= 2.0 * np.pi * np.round((near[1] - value[1]) / (2.0 * np.pi))
    slope = near @ [1 / 12, -2 / 3, 2 / 3, -1 / 12] / steps
    if certificate.straight:
        # F = f² = ℓ b², R = -F_x/M², μ = M/f: by s at fixed f, and by f.
        b, b_s = (one[0] for one in certificate.bounds.force(*np.array([[at[0], 0, 1.0]]).T)[:2])
        ratio = -value[2] / moment
        by_level = f / (2.0 * at[2])
        log_f = slope[0, 2] / by_level
        log_s = slope[0, 0] - log_f * f * b_s / b
        ratio_f = (-slope[2, 2] / moment - ratio * slope[0, 2]) / by_level
        ratio_s = -slope[2, 0] / moment - ratio * slope[0, 0] - ratio_f * f * b_s / b
        mu = moment / f
        det = moment * (log_s * ratio_f - log_f * ratio_s)
        return np.array([b, mu, -b * mu * slope[0, 0], -(mu**3) * det, mu**3 * ratio_f / (2 * f)])
    minor = np.linalg.det(slope[:2, :2])
    raw = -(moment**3) / (f * f_level) * np.linalg.det(slope)
    both = moment**5 * np.linalg.det(slope[1:, 1:])
    least = f - f_level * at[2]
    sign = certificate.sign
    return np.array(
        [
            least,
            f_level,
            -(moment**2) * slope[0, 0],
            -(moment**2) * minor,
            sign * raw,
            moment**2 * slope[1, 1],
            sign * both,
        ]
    )


@pytest.mark.parametrize("kind", ["straight", pytest.param("curved", marks=pytest.mark.slow)])
def test_enclosures_over_boxes_never_miss_a_point(curved, kind, monkeypatch):
    """Those of the search, and those of the check of curved whiskers."""
    contact_map = curved if kind == "curved" else straight(15.0)
    certificate, rng = prepare_certificate(contact_map), np.random.default_rng(3)
    data = certificate.to_dataset()
    keep = [0, 1, 2] if kind == "curved" else [0, 2]
    count = 7 if kind == "curved" else 5
    for half, tolerance in ((0.0, 1e-11), (2e-4, 1e-6), (2e-3, 1e-6), (1e-2, 1e-6)):
        monkeypatch.setattr(made, "_TOLERANCE", tolerance)
        near = rng.random((2, 3)) * [0.6, 2.8, 0.8] + [0.35, 0.1, 0.1]
        near[0, 0] = 0.36  # where forces are large
        ends = np.stack([near - half, near + half], axis=-1)[:, keep]
        found, _ = certificate.evaluate("interior", ends, list(range(count)))
        checks = (
            curved_checker.condition_polynomials(data, "interior", ends) if kind == "curved" else []
        )
        for row, (box, enclosure) in enumerate(zip(near, found, strict=True)):
            centre, reach = enclosure[:, 0], enclosure[:, 1:].sum(axis=1)
            at = box + half * (2.0 * rng.random(3) - 1.0)
            true = conditions(certificate, contact_map.whisker, at)
            size = np.abs(centre) + 1e-3
            assert (np.abs(true - centre) <= reach + 2e-8 * size).all()
            for value, form in zip(true, checks, strict=False):
                spread = np.abs(form.coef[1:, row]).sum() + form.rest[row]
                assert abs(value - form.coef[0, row]) <= spread + 2e-8 * (abs(value) + 1e-3)
                assert spread <= (300.0 * half + 1e-5) * (abs(value) + 1.0)
            assert (reach <= (300.0 * half + 100.0 * tolerance + 3e-7) * (size + 1.0)).all()


def test_enclosures_are_a_few_times_as_wide_as_the_ranges(curved):
    """On boxes as wide as those that certify, against contacts of the discretised rod."""
    certificate, rng = prepare_certificate(curved, np.deg2rad(2.0)), np.random.default_rng(0)
    low = rng.random((24, 3)) * [0.64, 3.0, 0.9] + [0.35, 0.05, 0.05]
    boxes = np.stack([low, low + np.array([0.006, 0.06, 0.03])], axis=-1)
    found, _ = certificate.evaluate("interior", boxes, list(range(7)))
    inside = rng.random((24, 64, 3))
    at = boxes[:, None, :, 0] + np.diff(boxes)[:, None, :, 0] * inside
    true = domain._conditions(curved, certificate.bounds, *np.moveaxis(at, -1, 0))
    known = np.isfinite(found).all(axis=(1, 2)) & ~np.isin(0.5, boxes[:, 0])
    centre, reach = found[..., 0].T[..., None], found[..., 1:].sum(axis=-1).T[..., None]
    assert known.sum() > 12
    away = np.abs(true - centre)[:, known]
    assert (away <= reach[:, known] + 1e-7 * np.abs(centre[:, known])).all()
    ratio = 2.0 * reach[:, known, 0] / np.ptp(true[:, known], axis=-1)
    assert (np.median(ratio, axis=1) < 5.0).all()


def test_a_box_across_an_end_of_polynomials_is_not_enclosed(curved):
    # Contacts on both sides have different equations.
    certificate = prepare_certificate(curved)
    box = np.array([[[0.499, 0.501], [1.0, 1.0], [0.5, 0.5]]])
    assert np.isnan(certificate.evaluate("interior", box, [0])[0]).all()
    assert 0.5 in certificate.stations


def test_a_grid_shows_whether_a_certificate_can_exist(curved, steep):
    seen = outlook(curved, np.deg2rad(2.0))
    assert seen.possible
    assert 0.9 < np.rad2deg(seen.determinant_cone) < 1.3
    strongly = outlook(steep, np.deg2rad(2.0))
    assert not strongly.possible
    assert strongly.failing["determinant"] > 0.0
    assert 4.9 < np.rad2deg(strongly.determinant_cone) < 5.6
    assert not outlook(straight(1.0), np.deg2rad(2.0)).possible


def test_rational_numbers_are_enclosed():
    centre, radius = enclose_rational(Fraction(14, 15))
    assert abs(Fraction(14, 15) - Fraction(centre)) <= Fraction(radius)
    assert radius < 1e-15


def test_a_compliant_base_is_refused():
    whisker = vb.Whisker.straight(40e-3, base_stiffness=(1e-4, 1e-4))
    with pytest.raises(ValueError, match="rigid base"):
        certify(charted(whisker))


@pytest.mark.parametrize("cause", [0, 1, 2])
def test_boxes_are_halved_in_the_unknown_that_makes_remainders_small(cause):
    """Whatever the widths say: remainders are large until one unknown is halved six times."""

    def evaluate(boxes):
        found = np.zeros((len(boxes), 1, 6))
        found[..., 0] = 1.0
        found[..., -1] = 2.0 ** (8 * (6 - boxes[:, cause, 0]))[:, None] / 10.0
        widths = np.ones((len(boxes), 3))
        widths[:, cause] = 1e-3
        return found, widths

    found = cover(evaluate, np.zeros((1, 3, 2), dtype=np.int64))
    assert not len(found.undecided)
    assert covers(found.certified)
    assert found.certified[:, cause, 0].max() <= 7
    assert not np.delete(found.certified[..., 0], cause, axis=1).any()


def test_the_most_bent_tip_of_a_curved_whisker_takes_few_boxes(curved):
    certificate = prepare_certificate(curved, np.deg2rad(2.0))
    domain, stations = certificate.parts["interior"].domain, certificate.stations
    cell = np.array([[[4, 15], [3, 4], [4, 13]]])  # contacts from 0.96 L to the tip, near the fold

    def evaluate(boxes):
        where = bounds(boxes, domain, stations)
        return certificate.evaluate("interior", where, [0, 1, 2, 3, 4])

    found = cover(evaluate, cell, 500)
    assert not len(found.undecided)
    assert len(found.certified) >= 8
    assert found.evaluated < 100
