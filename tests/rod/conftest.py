"""Whiskers with a story, random loads for them, and the references they are compared with."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import vibrissa as vb
from vibrissa.rod import discretize, fold_forces, stable_set

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
    """A γ whisker that leaves its plane halfway: what most tests bend."""
    kink = 0.5 * LENGTH
    return vb.Whisker.from_curvature(
        LENGTH,
        lambda s: np.stack([0.0 * s, 1000.0 * np.maximum(0.0, s - kink), 8.0 + 500.0 * s], axis=-1),
        breaks=(kink,),
    )


@pytest.fixture(scope="session")
def straight():
    return vb.Whisker.straight(LENGTH)


@pytest.fixture(scope="session")
def parabola():
    """Planar, so that it is its own mirror image."""
    return vb.Whisker.parabola(LENGTH, 10.0)


@pytest.fixture(scope="session", params=["gamma", "straight", "parabola"])
def whisker(request):
    """Each of them in turn."""
    return request.getfixturevalue(request.param)


@dataclass(frozen=True)
class Loads:
    """Many normal forces: where, in which direction, and what share of the one that slips off."""

    s: np.ndarray
    bearing: np.ndarray
    share: np.ndarray

    def forces(self, whisker, most=1.0):
        """Forces in N, from a share of ``most`` of the fold force down to nothing."""
        places = np.stack([self.s, np.cos(self.bearing), np.sin(self.bearing)], axis=-1)
        force = self.share * fold_forces(stable_set(whisker).fold, places)
        return most * force * discretize(whisker).force

    def on(self, whisker, most=0.98):
        """The same as a load of a whisker."""
        return vb.PointForce(self.s * whisker.length, self.forces(whisker, most), self.bearing)


@st.composite
def random_loads(draw, n=12):
    """Draw loads, with the neighbourhoods of the special ones: rest, tip, steps' ends, planes."""
    edges = [0.3, 0.5, 1.0, 1.0 - 1e-9, *(np.arange(3) / 3 + 1 / 3), np.nextafter(0.5, 1.0)]
    quarters = [0.0, np.pi / 2, np.pi, -np.pi / 2, -np.pi, 1e-9]

    def column(low, high, special):
        ordinary = st.floats(low, high).filter(lambda x: x == 0.0 or abs(x) > 1e-100)
        element = st.one_of(ordinary, st.sampled_from(special))
        return draw(arrays.arrays(np.float64, n, elements=element, fill=st.nothing()))

    return Loads(
        s=column(0.3, 1.0, edges),
        bearing=column(-np.pi, np.pi, quarters),
        share=column(0.0, 1.0, [0.0, 1e-100, 1e-12, 1e-6, 1.0]),
    )


@pytest.fixture(scope="session")
def loads():
    """The strategy, for tests to draw from."""
    return random_loads()
