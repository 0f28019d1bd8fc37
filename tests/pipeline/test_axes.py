"""Axes of a sensor that are not those of the whisker are noticed by what contacts they give."""

import re

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.contacts import rubbing_misfits
from vibrissa.pipeline import checks, doubted_axes, doubted_noise
from vibrissa.sensors import SensorFrame, component_noise

NOISE = component_noise(1e-6, 2e-8)


def measured(whisker, frame=None, columns="012345"):
    """Contacts with friction as a sensor of this frame measures them, and its columns exchanged."""
    rng = np.random.default_rng(4)
    arc, angle = rng.uniform(0.4, 0.8, 30), rng.uniform(0.0, 2.0 * np.pi, 30)
    size = 30e-6 * (1.0 - 0.9 * arc) ** 3 / (0.4 * arc) ** 2
    part = 0.3 * rng.uniform(-1.0, 1.0, 30), np.cos(angle), np.sin(angle)
    load = vb.PointForce(arc * whisker.length, components=np.transpose(size * np.array(part)))
    bent = vb.deflect(whisker, load)
    wrench = np.concatenate([bent.force, bent.moment], axis=1)
    wrench = (wrench + rng.normal(size=wrench.shape) * np.sqrt(np.diag(NOISE)))[bent.status == 0]
    wrench = (wrench @ (frame or SensorFrame()).from_base().T)[:, [int(c) for c in columns]]
    return np.hsplit(wrench, 2)


@pytest.mark.parametrize(
    ("how", "columns"),
    [
        ({"columns": "021345"}, "Fx, Fz, Fy, Mx, My, Mz"),
        ({"columns": "021354"}, "Fx, Fz, Fy, Mx, Mz, My"),
        ({"frame": SensorFrame(("x", "y", "-z"))}, ""),
        ({"frame": SensorFrame(("z", "x", "y"))}, "Fy, Fz, Fx, My, Mz, Mx"),
        ({}, ""),
    ],
)
def test_exchanged_axes_are_named(how, columns):
    """The γ whisker is nearly plane: its mirror image, by a left hand, has the same contacts."""
    said = doubted_axes(vb.samples.gamma(), *measured(vb.samples.gamma(), **how), NOISE)
    assert columns in said
    assert bool(said) == bool(columns)


def test_a_turn_of_a_straight_whisker_does_not_show():
    straight = vb.samples.straight()
    turned = measured(straight, SensorFrame(("x", "z", "-y")))
    assert doubted_axes(straight, *turned, NOISE) == ""
    assert doubted_axes(straight, *measured(straight, columns="021345"), NOISE)
    assert doubted_axes(straight, *(rows[:3] for rows in turned), NOISE) == ""


def test_axes_that_are_right_need_no_fits(monkeypatch):
    """Nor their kernels, which a first estimate would wait for."""
    asked = []

    def noted(*given):
        asked.append(given[-1])
        return rubbing_misfits(*given)

    monkeypatch.setattr(checks, "rubbing_misfits", noted)
    assert doubted_axes(vb.samples.gamma(), *measured(vb.samples.gamma()), NOISE) == ""
    assert asked == [False]


def test_fits_are_never_worse_than_where_moments_vanish():
    whisker = vb.samples.gamma()
    given = whisker, *measured(whisker), NOISE + 1e-13 * np.eye(6)
    fitted, seen = rubbing_misfits(*given, True), rubbing_misfits(*given, False)
    assert (fitted < 9.0).mean() >= (seen < 9.0).mean()
    assert (seen < 9.0).any()


def test_noise_that_is_far_from_the_scatter_without_contact_is_doubted():
    rng = np.random.default_rng(3)
    size = np.repeat([1e-6, 2e-8], 3)
    free = np.arange(400) % 100 < 70
    # Contacts, and a drift, are not noise.
    loads = np.where(free[:, None], np.linspace(0.0, 4.0, 400)[:, None], 80.0) * size
    readings = loads + size * rng.normal(size=(400, 6))

    def doubt(force=1.0, moment=1.0, rows=free, seen=readings):
        return doubted_noise(seen, np.diag((np.repeat([force, moment], 3) * size) ** 2), rows)

    assert not doubt()
    assert not doubt(5.0, 0.2)
    assert not doubt(rows=np.zeros(400, bool))
    assert not doubt(seen=loads)
    assert re.search(r"force by [12](\.\d)? µN, with noise of 1e\+03 µN", doubt(1e3))
    assert "moment" not in doubt(1e3)
    assert "with noise of 2e-05 µN·m" in doubt(moment=1e-3)
    assert "successive readings" in doubt(moment=1e-4, rows=np.zeros(400, bool))


def test_contacts_one_by_one_show_no_noise():
    """Rows of a table of separate contacts differ as these do; none is free."""
    rng = np.random.default_rng(5)
    contacts = np.repeat([1e-6, 2e-8], 3) * 10.0 ** rng.uniform(1.5, 3.5, (300, 1))
    contacts = contacts * rng.normal(size=(300, 6))
    assert not doubted_noise(contacts, NOISE, np.zeros(300, bool))
