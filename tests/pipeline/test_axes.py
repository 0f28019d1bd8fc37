"""Axes of a sensor that are not those of the whisker are noticed by what contacts they give."""

import numpy as np
import pytest
import xarray as xr

import vibrissa as vb
from vibrissa.pipeline import doubted_axes
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
    dims = ("time", "space")
    data = {"force": (dims, wrench[:, :3]), "moment": (dims, wrench[:, 3:])}
    return xr.Dataset(data, {"time": np.arange(len(wrench)) * 1.0})


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
    said = doubted_axes(vb.samples.gamma(), measured(vb.samples.gamma(), **how), NOISE)
    assert columns in said
    assert bool(said) == bool(columns)


def test_a_turn_of_a_straight_whisker_does_not_show():
    straight = vb.samples.straight()
    turned = measured(straight, SensorFrame(("x", "z", "-y")))
    assert doubted_axes(straight, turned, NOISE) == ""
    assert doubted_axes(straight, measured(straight, columns="021345"), NOISE)
    assert doubted_axes(straight, turned.isel(time=slice(3)), NOISE) == ""
