"""Kernels of joint fits: channels of a rod with weight, their noise, and the fit."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.contacts.joint.forward import Forward, Gravity
from vibrissa.contacts.joint.joint_fit import JointFit
from vibrissa.contacts.sensing.channels import CHANNELS, WRENCH, Channels, channels_of
from vibrissa.contacts.sensing.noise import SensorNoise, common_errors
from vibrissa.numerics import kernel
from vibrissa.signals import signal_equations

SETS = [("Fx", "MB", "MD"), ("FT", "FD", "MB"), ("Fx", "FT", "FD", "Mx", "MB", "MD"), WRENCH]
PULL = Gravity((3.0, -6.0, -28.0), direction_sigma=0.01, density_sigma=0.05)


@pytest.fixture(scope="module")
def forward() -> Forward:
    steel = vb.Whisker.straight(0.3, base_radius=5e-4, youngs_modulus=200e9, density=7850.0)
    return Forward.of(steel, PULL)


def contacts(n: int) -> np.ndarray:
    rng = np.random.default_rng(7)
    psi = rng.uniform(0.0, 2.0 * np.pi, n)
    size = rng.uniform(0.2, 0.6, n)
    along = rng.uniform(-0.2, 0.2, n) * size
    return np.stack(
        [rng.uniform(0.4, 0.8, n), along, size * np.cos(psi), size * np.sin(psi)], axis=1
    )


def channels(names: tuple[str, ...]) -> Channels:
    return Channels(WRENCH, WRENCH) if names == WRENCH else Channels.of(names)


def covariance_of(weights: np.ndarray) -> np.ndarray:
    return np.linalg.inv(np.swapaxes(weights, 1, 2) @ weights)


def fitting(forward: Forward, names: tuple[str, ...], noise: object, **more: object) -> JointFit:
    sensor = SensorNoise.of(noise, names, common_errors(0.02, 0.01))
    whole = names == WRENCH
    return JointFit(forward, channels(names), sensor, 0.05, friction=whole, **more)


@kernel
def channels_at(value, t, codes, channel, slope):
    signal_equations(0.0, value, t, True, codes, channel, slope)


def test_channels_and_their_derivatives_include_the_moment_of_the_weight(forward: Forward) -> None:
    codes, step = np.arange(len(CHANNELS)), 1e-6
    for x in contacts(5):
        value, slope = np.empty(len(codes)), np.empty((len(codes), 4))
        solved = forward.solved(x[None])
        channels_at(solved.values[0], solved.tangents[0], codes, value, slope)
        assert np.abs(solved.values[0, 6:]).max() > 1e-4
        np.testing.assert_allclose(value, channels_of(solved.values)[0], rtol=1e-12, atol=1e-12)
        both = [channels_of(forward.values(x + way * step * np.eye(4))) for way in (1.0, -1.0)]
        np.testing.assert_allclose(slope, (both[0] - both[1]).T / (2.0 * step), atol=1e-5)


@pytest.mark.parametrize("names", SETS)
@pytest.mark.parametrize("by_name", [False, True])
def test_weights_are_those_of_the_covariance(
    forward: Forward, names: tuple[str, ...], by_name: bool
) -> None:
    sigma = np.repeat([1e-3, 2e-4], 3) * [1.0, 2.0, 3.0, 1.0, 2.0, 3.0]
    noise = dict(zip(names, sigma, strict=False)) if by_name else np.diag(sigma**2)
    fit, x = fitting(forward, names, noise), contacts(6)
    values = forward.values(x)
    d, which = fit.d, [CHANNELS.index(name) for name in fit.names]
    flat = channels_of(values)[:, [CHANNELS.index(name) for name in names]]
    found = fit._noise(flat, x, values)
    own = fit.channels.covariance(fit.sensor, flat, values, d)
    np.testing.assert_allclose(covariance_of(found.own), own, rtol=1e-7, atol=1e-15)
    # Effects of uncertain gravity, by differences of the channels of other rods.
    for k, (other, share) in enumerate(forward.errors):
        changed = share * (channels_of(other.values(x)) - channels_of(values))[:, which]
        np.testing.assert_allclose(found.change[..., k], changed, rtol=2e-3, atol=1e-6)
    whole = own + found.change @ np.swapaxes(found.change, 1, 2)
    np.testing.assert_allclose(found.spread, whole, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(covariance_of(found.whole), whole, rtol=1e-7, atol=1e-15)


@pytest.mark.parametrize("names", SETS)
def test_a_fit_recovers_contacts_and_ends_where_chi_squared_is_level(
    forward: Forward, names: tuple[str, ...]
) -> None:
    x = contacts(12)
    if names != WRENCH:
        x[:, 1] = 0.0
    fit = fitting(forward, names, np.diag(np.repeat([1e-3, 2e-4], 3) ** 2))
    exact = channels_of(forward.values(x))
    which = [CHANNELS.index(name) for name in fit.names]
    flat = exact[:, [CHANNELS.index(name) for name in names]]
    start = x * [0.97, 1.05, 0.95, 1.05]
    fits = fit.fit(flat, exact[:, which], start)
    np.testing.assert_allclose(fits.contacts, x, rtol=1e-6, atol=1e-7)
    if len(names) > 3:  # with noise that no contact explains
        off = 0.02 * np.random.default_rng(3).standard_normal((len(x), len(which)))
        fits = fit.fit(flat, exact[:, which] + off, start)
        joint = fit.joint(flat, exact[:, which] + off, fits)
        inside = fits.contacts[:, 0] < 1.0
        level = np.einsum("nru,nr->nu", joint.design, joint.residuals)[inside]
        size = np.linalg.norm(joint.design, axis=1)[inside]
        assert inside.sum() > 8
        assert (np.abs(level) < 1e-3 * size).all()
