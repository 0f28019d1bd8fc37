"""Weights of a measurement's channels from the noise of the sensor; compiled.

A measurement is z = A c(x) + noise: a mix A of channels c, the identity for signals by name.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.sensing.channels import CHANNELS, WRENCH, Channels
from vibrissa.contacts.sensing.noise import TRUSTED, SensorNoise, scaled_errors
from vibrissa.numerics import Array, IntArray, copy, inlined, kernel
from vibrissa.signals import FT, FX, FY, FZ, MB, MX, MY, MZ

# Share of a channel's variance that the others do not explain; the covariance is singular below.
_SINGULAR = 1e-10
_EXACT = 1e-6  # what counts as exact, relative to the other deviations


class Weighing(NamedTuple):
    """Noise of a sensor and the channels it applies to, non-dimensional."""

    codes: IntArray
    mixing: Array
    own: Array
    components: Array
    share: float
    deviations: Array
    errors: Array


def weighing_of(
    channels: Channels, sensor: SensorNoise | None, force: float, moment: float, scale: Array
) -> Weighing:
    """Weighing of channels for the noise of a sensor, with the units of their signals."""
    k = len(channels.names)
    sizes = np.repeat([force, moment], 3)
    components, deviations = np.zeros((6, 6)), np.full(k, np.nan)
    if sensor is not None and sensor.wrench is not None:
        components = sensor.wrench / np.outer(sizes, sizes)
    elif sensor is not None and sensor.deviations is not None:
        sigma = np.array([sensor.deviations[name] for name in channels.signals]) / scale
        if channels.signals == WRENCH:  # components, not sizes with their directions
            components = np.diag(sigma**2)
        else:
            deviations = sigma
    return Weighing(
        np.array([CHANNELS.index(name) for name in channels.names]),
        np.eye(k),
        np.zeros((k, k)),
        np.ascontiguousarray(components, dtype=np.float64),
        TRUSTED if sensor is None else 0.0,
        deviations,
        np.zeros((0, 6, 7)) if sensor is None else scaled_errors(sensor.errors, force, moment),
    )


@inlined
def gradients(codes: IntArray, force: Array, moment: Array, out: Array) -> None:
    """Fill ∂(channels)/∂(F, M), (k, 6)."""
    for k in range(codes.shape[0]):
        for a in range(6):
            out[k, a] = 0.0
        w = codes[k]
        if w in (FX, MX):
            out[k, w] = 1.0
        elif w in (FY, FZ):
            out[k, 1 + w - FY] = 1.0
        elif w in (MY, MZ):
            out[k, 4 + w - MY] = 1.0
        else:
            first = 0 if w < MX else 3
            y, z = (force[1], force[2]) if w < MX else (moment[1], moment[2])
            size = np.sqrt(y * y + z * z)
            if w in (FT, MB):
                out[k, first + 1], out[k, first + 2] = y / size, z / size
            else:
                out[k, first + 1], out[k, first + 2] = -z / size**2, y / size**2


@inlined
def wrong_by(error: Array, force: Array, moment: Array, out: Array) -> None:
    """Fill the error E (F, M, 1), (6,), of a wrench for an error matrix E (6, 7)."""
    for a in range(6):
        out[a] = error[a, 6]
        for c in range(3):
            out[a] += error[a, c] * force[c] + error[a, 3 + c] * moment[c]


@inlined
def wrench_covariance(
    how: Weighing, force: Array, moment: Array, measured: Array, sigma: Array
) -> None:
    """Covariance (k, k) of the channels of a force and moment."""
    codes, deviations = how.codes, how.deviations
    k = codes.shape[0]
    g = np.empty((k, 6))
    gradients(codes, force, moment, g)
    f2 = force[0] ** 2 + force[1] ** 2 + force[2] ** 2
    m2 = moment[0] ** 2 + moment[1] ** 2 + moment[2] ** 2
    common, wrong = how.components.copy(), np.empty(6)
    for error in how.errors:
        wrong_by(error, force, moment, wrong)
        for a in range(6):
            for c in range(6):
                common[a, c] += wrong[a] * wrong[c]
    for i in range(k):
        for j in range(k):
            total = 0.0
            for a in range(6):
                size = f2 if a < 3 else m2
                total += how.share**2 * size * g[i, a] * g[j, a]
                for c in range(6):
                    total += g[i, a] * common[a, c] * g[j, c]
            sigma[i, j] = total
    if not deviations[0] >= 0.0:
        return
    for i in range(k):
        w = codes[i]
        if w in (FY, MY):  # a size is followed by its direction
            size, cos, sin = measured[i], np.cos(measured[i + 1]), np.sin(measured[i + 1])
            along, across = deviations[i] ** 2, (size * deviations[i + 1]) ** 2
            sigma[i, i] += cos * cos * along + sin * sin * across
            sigma[i + 1, i + 1] += sin * sin * along + cos * cos * across
            sigma[i, i + 1] += cos * sin * (along - across)
            sigma[i + 1, i] += cos * sin * (along - across)
        elif w not in (FZ, MZ):
            sigma[i, i] += deviations[i] ** 2


@inlined
def channel_covariance(how: Weighing, value: Array, measured: Array, sigma: Array) -> None:
    """Covariance (k, k) of the channels at a contact with (F, p)."""
    force, moment = np.empty(3), np.empty(3)
    copy(value[:3], force)
    px, py, pz = value[3], value[4], value[5]
    moment[0] = py * force[2] - pz * force[1]
    moment[1] = pz * force[0] - px * force[2]
    moment[2] = px * force[1] - py * force[0]
    wrench_covariance(how, force, moment, measured, sigma)


@kernel
def weigh(how: Weighing, value: Array, measured: Array, out: Array) -> bool:
    """Fill weights W (k, k), rows beyond the rank q zero, at a contact with (F, p)."""
    mixing = how.mixing
    q, k = mixing.shape
    sigma, mixed, low = np.empty((k, k)), np.zeros((q, k)), np.zeros((q, q))
    channel_covariance(how, value, measured, sigma)
    for i in range(q):
        for j in range(k):
            for a in range(k):
                mixed[i, j] += mixing[i, a] * sigma[a, j]
    for i in range(q):
        for j in range(i + 1):
            total = how.own[i, j]
            for a in range(k):
                total += mixed[i, a] * mixing[j, a]
            whole = total
            for a in range(j):
                total -= low[i, a] * low[j, a]
            if i > j:
                low[i, j] = total / low[j, j]
            elif total > _SINGULAR * whole and total < np.inf:
                low[i, i] = np.sqrt(total)
            else:
                return False
    for j in range(k):
        for i in range(k):
            total = mixing[i, j] if i < q else 0.0
            if i < q:
                for a in range(i):
                    total -= low[i, a] * out[a, j]
                total /= low[i, i]
            out[i, j] = total
    return True


@inlined
def whitened(sigma: Array, out: Array) -> bool:
    """Fill weights W (k, k) for a covariance, possibly singular, as `noise.whitening` does.

    The covariance becomes that of the correlations. False where it is not finite.
    """
    k = sigma.shape[0]
    size, typical, noisy = np.empty(k), 0.0, 0
    for i in range(k):
        for j in range(k):
            if not abs(sigma[i, j]) < np.inf:
                return False
        if sigma[i, i] > 0.0:
            typical, noisy = typical + 0.5 * math.log(sigma[i, i]), noisy + 1
    for i in range(k):
        exact = _EXACT * math.exp(typical / max(noisy, 1))
        size[i] = math.sqrt(sigma[i, i]) if sigma[i, i] > 0.0 else exact
    for i in range(k):
        for j in range(k):
            sigma[i, j] /= size[i] * size[j]
        if sigma[i, i] == 0.0:
            sigma[i, i] = 1.0
    least, vectors = np.linalg.eigh(sigma)
    for i in range(k):
        root = 1.0 / math.sqrt(least[i]) if least[i] > _SINGULAR else 0.0
        for j in range(k):
            out[i, j] = root * vectors[j, i] / size[j]
    return True


@kernel
def weigh_any(how: Weighing, value: Array, measured: Array, out: Array) -> bool:
    """Fill weights W (k, k) as `weigh` does, also for singular noise; False if there are none."""
    if weigh(how, value, measured, out):
        return True
    sigma = np.empty((how.codes.shape[0], how.codes.shape[0]))
    channel_covariance(how, value, measured, sigma)
    return whitened(sigma, out)


@inlined
def sharpness(weights: Array) -> float:
    """Logarithm of the noise's peak density for these weights, up to a common constant."""
    total = 0.0
    for i in range(weights.shape[0]):
        if abs(weights[i, i]) > 0.0:
            total += math.log(abs(weights[i, i]))
    return total
