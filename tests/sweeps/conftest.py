"""Sweeps need zarr: imported when the first runs, not in each worker that collects tests."""

import pytest


@pytest.fixture(autouse=True, scope="session")
def zarr():
    pytest.importorskip("zarr", reason="zarr (extra sweeps) is not installed")
