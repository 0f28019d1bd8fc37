"""The default whisker's map, made once."""

import numpy as np
import pytest

import vibrissa as vb


@pytest.fixture(scope="session")
def gamma_map() -> vb.ContactMap:
    return vb.ContactMap.simulate(vb.samples.gamma(), grid=False)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20)
