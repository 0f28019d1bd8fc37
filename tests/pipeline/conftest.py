"""Trials whose truth is known, and a tracked recording of one that is as good as its errors say."""

import numpy as np
import pytest
import xarray as xr

from vibrissa import samples
from vibrissa.contacts import ContactMap
from vibrissa.quantities import attributes
from vibrissa.recording import recorded
from vibrissa.simulation import facing_peg, measure, simulate, sweep_past

WHISKER = samples.gamma()
PEG = facing_peg(WHISKER)
POINT_NOISE, TURN_NOISE, SHIFT_NOISE = 15e-6, 1e-3, 8e-6


@pytest.fixture(scope="session")
def whisked():
    """Without a sensor's noise."""
    return simulate(WHISKER, sweep_past(WHISKER, PEG, 0.6, 300.0, seed=2), PEG)


@pytest.fixture(scope="session")
def trial(whisked):
    """With a sensor of 1 µN and 0.02 µN·m."""
    return measure(whisked, seed=3)


@pytest.fixture(scope="session")
def quiet(whisked):
    """With a perfect sensor."""
    return measure(whisked, 0.0, 0.0)


@pytest.fixture(scope="session")
def contact_map():
    return ContactMap.simulate(WHISKER, grid=False)


def turned_by(vectors):
    """Rotations (n, 3, 3) by rotation vectors (n, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vectors).as_matrix()


@pytest.fixture(scope="session")
def tracked(trial):
    """What a tracker would make of it: pose and contact with errors that it knows of."""
    generator = np.random.default_rng(5)
    truth = trial["truth"].to_dataset().isel(whisker=0)
    root = trial.to_dataset().isel(whisker=0)
    n = root.sizes["time"]
    point = truth["contact_point"].values + POINT_NOISE * generator.normal(size=(n, 3))
    rotation = turned_by(TURN_NOISE * generator.normal(size=(n, 3))) @ root["base_rotation"].values
    place = root["base_position"].values + SHIFT_NOISE * generator.normal(size=(n, 3))
    values = {
        "base_position": place,
        "base_rotation": rotation,
        "contact_point": point,
        "in_contact": truth["in_contact"].values,
    }
    data = {name: recorded(name, array) for name, array in values.items()}
    spread = {
        "contact_covariance": (("space", "space_"), POINT_NOISE**2 * np.eye(3)),
        "pose_covariance": (
            ("pose", "pose_"),
            np.diag(np.repeat([SHIFT_NOISE**2, TURN_NOISE**2], 3)),
        ),
    }
    for name, (dims, matrix) in spread.items():
        whole = np.tile(matrix, (n, 1, 1, 1))
        data[name] = xr.Variable(("time", "whisker", *dims), whole, attributes(name))
    tree = trial.copy()
    tree.dataset = trial.to_dataset().drop_vars(["force", "moment"]).assign(data)
    return tree
