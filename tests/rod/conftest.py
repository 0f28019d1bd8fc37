"""Whiskers with a story, and the reference solutions they are compared with."""

import json
from pathlib import Path

import numpy as np
import pytest

import vibrissa as vb

DATA = Path(__file__).parent.parent / "data"
LENGTH = 39.4e-3


@pytest.fixture(scope="session")
def reference():
    """Read a reference by name; each file says where it is from."""

    def read(name):
        return json.loads((DATA / f"{name}.json").read_text())

    return read


@pytest.fixture(scope="session")
def gamma():
    """A γ whisker out of its plane: what most tests bend."""
    return vb.Whisker.from_curvature(
        LENGTH,
        lambda s: np.stack(
            [0 * s, np.where(s < 0.5 * LENGTH, 0.0, 15.0), 8.0 + 500.0 * s], axis=-1
        ),
        breaks=(0.5 * LENGTH,),
    )


@pytest.fixture(scope="session")
def straight():
    return vb.Whisker.straight(LENGTH)


@pytest.fixture(scope="session")
def parabola():
    """Planar, so that it has a mirror image."""
    return vb.Whisker.parabola(LENGTH, 10.0)
