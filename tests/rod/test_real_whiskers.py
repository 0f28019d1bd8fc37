"""Contacts of real whiskers are found again; all of them, at length, in ``benchmarks``."""

import importlib.util
import sys
from pathlib import Path

import pytest

import vibrissa as vb

ROOT = Path(__file__).parents[2]
WHISKERS = ROOT.parent / "shared" / "real_whiskers"

pytestmark = pytest.mark.skipif(not WHISKERS.is_dir(), reason="needs the digitised real whiskers")


@pytest.fixture(scope="module")
def acceptance():
    """The script, as a module."""
    path = ROOT / "benchmarks" / "acceptance_real_whiskers.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look there for their own module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "1LC01",
        "1LA05",
        "1LD02",
    ],
)
@pytest.mark.parametrize("crowded", [False, True], ids=["up to the fold", "near the fold"])
def test_every_contact_is_found_again(acceptance, name, crowded):
    """A γ whisker, the shortest of a row and the most slender: all of 2,000 contacts of each."""
    whisker = vb.load_whisker(WHISKERS / f"{name}.csv")
    found = acceptance.examine(whisker, name, 2000, crowded=crowded)
    assert found.missed == 0, found.details
    assert found.slipped == 0, found.details
    assert found.worst_point < 1e-9
    assert found.worst_moment < 1e-6
    if not crowded:
        assert found.tip_wrong == 0, found.details
        assert found.fold_wrong <= 1e-3 * found.fold_asked, found.details
