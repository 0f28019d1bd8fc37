"""Errors like those of contacts that a whisker felt."""

import numpy as np
import pytest


@pytest.fixture
def joint_errors():
    """How contacts err: a function of generator and normals."""
    return _joint_errors


def _joint_errors(generator, normal):
    """Matrices (n, 6, 3) from three unknowns to the errors of point, m, and of normal.

    As for a whisker: the point errs most along one direction across the normal, and where it does
    the normal is turned.
    """
    n = len(normal)
    along = np.cross(normal, generator.normal(size=(n, 3)))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    third = np.cross(normal, along)
    size = np.exp(generator.uniform(*np.log([5e-5, 4e-4]), n))[:, None]
    out = np.zeros((n, 6, 3))
    out[:, :3, 0] = size * (along + 0.2 * normal)
    out[:, :3, 1] = 4e-5 * normal
    out[:, :3, 2] = 3e-5 * third
    out[:, 3:, 0] = 50.0 * size * along
    out[:, 3:, 1] = 2e-3 * along
    out[:, 3:, 2] = 6e-3 * third
    return out
