"""A force and torque sensor at the base, with noise."""

from __future__ import annotations

import numpy as np
import xarray as xr

FORCE_NOISE = 1e-6
"""Standard deviation of a component of the measured force, N."""

MOMENT_NOISE = 0.02e-6
"""Standard deviation of a component of the measured moment, N·m."""


def measure(
    recording: xr.DataTree,
    force_noise: float = FORCE_NOISE,
    moment_noise: float = MOMENT_NOISE,
    seed: int = 0,
) -> xr.DataTree:
    """Measure the wrench of a simulated trial with noise.

    Parameters
    ----------
    recording : xarray.DataTree
        A recording with ``force`` and ``moment`` in the group ``truth``.
    force_noise : float
        Standard deviation of each component of the force, N: white, Gaussian.
    moment_noise : float
        Standard deviation of each component of the moment, N·m.
    seed : int
        Of the noise.

    Returns
    -------
    xarray.DataTree
        A new recording, whose ``force`` and ``moment`` at the top are truth plus noise and say in
        the attribute ``noise`` how much. Missing frames stay missing.

    Raises
    ------
    ValueError
        If a noise is negative, or if the recording has no true wrench.
    """
    for name, value in (("force_noise", force_noise), ("moment_noise", moment_noise)):
        if not (np.isfinite(value) and value >= 0.0):
            raise ValueError(f"{name} is {value!r}; it must not be negative")
    truth = recording.children.get("truth")
    if truth is None or not {"force", "moment"} <= set(truth.data_vars):
        raise ValueError("the recording has no true force and moment to measure")
    generator = np.random.default_rng(seed)
    noisy = {}
    for name, noise in (("force", force_noise), ("moment", moment_noise)):
        true = truth[name].variable
        values = true.values + generator.normal(scale=noise, size=true.shape)
        noisy[name] = xr.Variable(true.dims, values, {**true.attrs, "noise": float(noise)})
    measured = recording.copy()
    measured.dataset = recording.to_dataset().assign(noisy)
    return measured
