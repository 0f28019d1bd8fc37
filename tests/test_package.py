import importlib.metadata
import subprocess
import sys

import pytest

import vibrissa


@pytest.mark.parametrize("name", vibrissa.__all__)
def test_every_public_name_resolves(name):
    assert getattr(vibrissa, name) is not None
    assert name in dir(vibrissa)


def test_every_public_name_comes_from_its_home():
    assert {*vibrissa._HOMES, *vibrissa._MODULES, "__version__"} == set(vibrissa.__all__)


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'wisker'"):
        _ = vibrissa.wisker


def test_version_is_that_of_the_distribution():
    assert importlib.metadata.version("vibrissa") == vibrissa.__version__


def test_import_loads_nothing_heavy():
    heavy = {"numpy", "numba", "scipy", "xarray", "h5netcdf", "matplotlib", "typer", "rich"}
    code = f"import sys, vibrissa; print(sorted({heavy} & set(sys.modules)))"
    loaded = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout
    assert loaded.strip() == "[]"
