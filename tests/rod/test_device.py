"""A GPU gives the answers of the CPU; without one Numba's simulator runs the same threads."""

import importlib.util
import os
import subprocess
import sys

import numpy as np
import pytest

import vibrissa as vb

COMPARE = """
from functools import partial
import os, numpy as np, vibrissa as vb
from vibrissa.numerics import device as gpu
from vibrissa.rod import discretize, solve_forces
if os.environ.get("NUMBA_ENABLE_CUDASIM"):
    gpu._THREADS = 1  # threads of a simulated block exchange a global name, and may lose it
whisker = vb.samples.gamma()
load = vb.PointForce([12e-3, 25e-3, 34e-3], [3e-4, 6e-5, 1e-5], [0.3, 2.0, -2.5])
bend = partial(vb.deflect, whisker, steps=12)  # the simulator is slow
one, other = (bend(load, device=device) for device in ("cpu", "cuda"))
assert (one.status == 0).all() and (one.force != 0.0).all()
np.testing.assert_allclose(other.moment, one.moment, rtol=1e-9)
d = discretize(whisker, 12)
rows = np.concatenate([one.arc_length[:, None] / d.length, one.contact_force / d.force], axis=1)
one, other = (solve_forces(d, rows[1:], True, device)[1] for device in ("cpu", "cuda"))
np.testing.assert_allclose(other, one, atol=1e-9)
points = bend(load).contact_point
points = np.stack([points[0], 1.5 * points[1], points[2] * np.nan])
one, other = (bend(vb.PointContact(points), device=d) for d in ("cpu", "cuda"))
assert (one.status == other.status).all() and len(set(one.status.tolist())) == 3
np.testing.assert_allclose(other.arc_length, one.arc_length, rtol=1e-9)
np.testing.assert_allclose(other.force, one.force, rtol=1e-9)
"""


def has_gpu():
    if importlib.util.find_spec("numba_cuda") is None:
        return False
    from numba import cuda

    return bool(cuda.is_available())


def test_the_gpu_gives_the_answers_of_the_cpu():
    """Forces, Jacobians, and points that are held, out of reach and missing."""
    environment = os.environ | ({} if has_gpu() else {"NUMBA_ENABLE_CUDASIM": "1"})
    done = subprocess.run(
        [sys.executable, "-c", COMPARE],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(has_gpu(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_reported_at_once():
    with pytest.raises((ImportError, ValueError), match=r"vibrissa\[gpu\]|NVIDIA GPU"):
        vb.deflect(vb.samples.gamma(), vb.PointForce(0.02, 1e-5, 0.0), device="cuda")


def test_what_a_gpu_does_not_solve_is_refused(monkeypatch):
    monkeypatch.setattr("vibrissa.rod.statics.check_device", lambda device: None)
    whisker = vb.samples.gamma().with_properties(density=1000.0)
    with pytest.raises(ValueError, match="got a PegContact"):
        vb.deflect(whisker, vb.PegContact([0.02, 0.0, 0.0], [0, 0, 1]), device="cuda")
    load = vb.PointForce(0.02, 1e-5, 0.0)
    with pytest.raises(ValueError, match="PointForce with gravity"):
        vb.deflect(whisker, load, gravity=np.array([0, 0, -9.81]), device="cuda")


def test_an_unknown_device_is_refused():
    with pytest.raises(ValueError, match="'gpu'; it must be 'cpu' or 'cuda'"):
        vb.deflect(vb.samples.gamma(), vb.PointForce(0.02, 1e-5, 0.0), device="gpu")
