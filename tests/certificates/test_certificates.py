"""Enclosures never miss, and the straight tapered whisker is a theorem."""

from fractions import Fraction

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.certificates import certify, outlook
from vibrissa.certificates.equations import enclosed
from vibrissa.certificates.search import covers


def charted(whisker):
    return vb.ContactMap.simulate(whisker, grid=False)


def straight(ratio):
    return charted(vb.Whisker.straight(40e-3, tip_radius=100e-6 / ratio))


@pytest.fixture(scope="module")
def curved():
    return charted(vb.Whisker.parabola(length=39.4e-3, coefficient=10.0))


@pytest.fixture(scope="module")
def theorem(tmp_path_factory):
    path = tmp_path_factory.mktemp("certificates") / "straight.nc"
    return path, certify(straight(15.0), path=path)


def test_a_straight_tapered_whisker_is_located_by_fx_mb_md(theorem):
    _, found = theorem
    assert found.proved
    assert not found.refuted
    assert found.share == 1.0
    assert set(found.parts) == {"interior", "proximal", "distal", "fold"}
    assert all(covers(part.certified) for part in found.parts.values())


def test_a_grid_shows_whether_a_certificate_can_exist(curved):
    seen = outlook(curved, np.deg2rad(2.0))
    assert seen.possible
    assert 0.9 < np.rad2deg(seen.determinant_cone) < 1.3
    strongly = outlook(charted(vb.Whisker.parabola(40e-3, 0.82 / 40e-3)), np.deg2rad(2.0))
    assert not strongly.possible
    assert strongly.failing["determinant"] > 0.0
    assert 4.9 < np.rad2deg(strongly.determinant_cone) < 5.6
    assert not outlook(straight(1.0), np.deg2rad(2.0)).possible


def test_rational_numbers_are_enclosed():
    centre, radius = enclosed(Fraction(14, 15))
    assert abs(Fraction(14, 15) - Fraction(centre)) <= Fraction(radius)
    assert radius < 1e-15
