"""Derivatives are those that finite differences of the whole way give."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.contacts import WRENCH
from vibrissa.pipeline.touch_gains import contact_normals, gains, wrench_slopes
from vibrissa.signals import base_signals

WHISKER = vb.samples.gamma()
LOAD = vb.PointForce(
    [22e-3, 28e-3, 33e-3], components=[[0, 8e-5, 3e-5], [0, -2e-5, 3e-5], [0, 1e-5, 6e-6]]
)
RUBBING = vb.PointForce([22e-3, 30e-3], components=[[9e-6, 8e-5, 3e-5], [-3e-6, -2e-5, 1e-5]])


def changed(bent, i, step):
    wrench = np.concatenate([bent.force, bent.moment], axis=1)
    wrench[:, i] += step
    return wrench[:, :3], wrench[:, 3:]


def steps(i):
    return 1e-4 * (1e-5 if i < 3 else 2e-7)


def differences(bent, found):
    """∂(p, n)/∂(F, M), (n, 6, 6), of a function of force and moment."""
    out = np.empty((len(bent.force), 6, 6))
    for i in range(6):
        ahead, back = (found(*changed(bent, i, sign * steps(i))) for sign in (1, -1))
        out[..., i] = (ahead - back) / (2 * steps(i))
    return out


def point_and_normal(arc_length, contact_force, point, change=0.0):
    normal, _, _ = contact_normals(WHISKER, arc_length, contact_force, change)
    return np.concatenate([point, normal], axis=1)


@pytest.mark.parametrize(
    "names", [("Fx", "MB", "MD"), ("FT", "FD", "MB"), ("Fx", "FT", "FD", "Mx", "MB", "MD")]
)
def test_contacts_move_with_the_wrench_as_the_gain_says(names):
    bent = vb.deflect(WHISKER, LOAD)
    contact_map = vb.ContactMap.simulate(WHISKER, grid=False)
    noise = np.diag(np.repeat([1e-12, 4e-16], 3))

    def found(force, moment):
        e = contact_map.estimate(base_signals(force, moment), names, noise)
        return point_and_normal(
            e.candidates.arc_length[:, 0], e.candidates.contact_force[:, 0], e.point
        )

    gain, _ = gains(WHISKER, names, bent.arc_length, bent.contact_force, noise)
    expected = differences(bent, found)
    for i in range(6):
        size = np.abs(gain[:, :, i]).max()
        np.testing.assert_allclose(gain[:, :, i], expected[:, :, i], atol=3e-3 * size)


@pytest.mark.parametrize("change", [0.0, np.array([[3e-6, -9e-6, 1e-5], [2e-6, 1e-6, 1e-6]])])
def test_contacts_that_rub_move_as_the_gain_says(change):
    bent = vb.deflect(WHISKER, RUBBING)
    noise = np.diag(np.repeat([1e-12, 4e-16], 3))

    def found(force, moment):
        e = vb.estimate_from_wrench(WHISKER, force, moment, noise=noise)
        return point_and_normal(e.arc_length, e.contact_force, e.point, change)

    gain, _ = gains(WHISKER, WRENCH, bent.arc_length, bent.contact_force, noise, change=change)
    expected = differences(bent, found)
    for i in range(6):
        size = np.abs(gain[:, :, i]).max()
        np.testing.assert_allclose(gain[:, :, i], expected[:, :, i], atol=3e-3 * size)


def test_the_covariance_is_that_of_the_map():
    """With noise so small that the first order, which slopes are, is all there is."""
    bent = vb.deflect(WHISKER, LOAD)
    contact_map = vb.ContactMap.simulate(WHISKER, grid=False)
    noise = 1e-8 * np.diag([1e-12, 4e-12, 1e-12, 1e-16, 4e-16, 9e-16])
    for names in (("Fx", "MB", "MD"), ("Fx", "FT", "Mx", "MB", "MD")):
        found = contact_map.estimate(base_signals(bent.force, bent.moment), names, noise)
        gain = gains(
            WHISKER,
            names,
            found.candidates.arc_length[:, 0],
            found.candidates.contact_force[:, 0],
            noise,
        )[0][:, :3]
        np.testing.assert_allclose(
            gain @ noise @ np.swapaxes(gain, 1, 2), found.covariance, rtol=1e-6
        )
    found = vb.estimate_from_wrench(WHISKER, bent.force, bent.moment, noise=noise)
    gain = gains(WHISKER, WRENCH, found.arc_length, found.contact_force, noise)[0][:, :3]
    scale = np.abs(found.covariance).max(axis=(1, 2), keepdims=True)
    got = gain @ noise @ np.swapaxes(gain, 1, 2)
    np.testing.assert_allclose(got / scale, found.covariance / scale, atol=1e-5)


def test_the_wrench_moves_with_the_point_as_its_slopes_say():
    bent = vb.deflect(WHISKER, LOAD)
    slopes = wrench_slopes(WHISKER, bent.arc_length, bent.contact_force)
    for i in range(3):
        step = np.eye(3)[i] * 1e-7
        ahead, back = (
            vb.deflect(WHISKER, vb.PointContact(bent.contact_point + sign * step))
            for sign in (1, -1)
        )
        change = np.concatenate([ahead.force - back.force, ahead.moment - back.moment], axis=1)
        size = np.abs(slopes[..., i]).max(axis=1, keepdims=True)
        np.testing.assert_allclose(change / 2e-7 / size, slopes[..., i] / size, atol=1e-4)


def test_normals_are_across_the_whisker():
    bent = vb.deflect(WHISKER, LOAD)
    normal, _, _ = contact_normals(WHISKER, bent.arc_length, bent.contact_force)
    size = np.linalg.norm(bent.force, axis=1, keepdims=True)
    np.testing.assert_allclose(normal, bent.force / size, atol=1e-12)
    rubbing = vb.deflect(WHISKER, RUBBING)
    along, _, _ = contact_normals(WHISKER, rubbing.arc_length, rubbing.contact_force)
    share = (along * rubbing.force).sum(axis=1) / np.linalg.norm(rubbing.force, axis=1)
    angle = np.arctan2(
        np.abs(rubbing.contact_force[:, 0]), np.linalg.norm(rubbing.contact_force[:, 1:], axis=1)
    )
    np.testing.assert_allclose(share, np.cos(angle), rtol=1e-9)


def test_normals_are_as_uncertain_as_the_change_of_the_force():
    bent = vb.deflect(WHISKER, LOAD)
    rng = np.random.default_rng(3)
    root = 1e-7 * rng.normal(size=(3, 3, 3))
    args = WHISKER, bent.arc_length, bent.contact_force
    _, covariance, _ = contact_normals(*args, 0.0, root @ np.swapaxes(root, 1, 2))
    draws = np.einsum("nij,knj->kni", root, rng.normal(size=(4000, 3, 3)))
    normals = np.array([contact_normals(*args, draw)[0] for draw in draws])
    for row, many in zip(covariance, np.swapaxes(normals, 0, 1), strict=True):
        np.testing.assert_allclose(np.cov(many.T), row, atol=0.1 * np.abs(row).max())


def test_without_a_contact_there_is_nothing():
    nothing, _ = gains(WHISKER, ("Fx", "MB", "MD"), np.full(2, np.nan), np.full((2, 3), np.nan))
    assert np.isnan(nothing).all()
    assert nothing.shape == (2, 6, 6)
    assert np.isnan(wrench_slopes(WHISKER, np.array([np.nan]), np.full((1, 3), np.nan))).all()
