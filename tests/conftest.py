"""How every test runs: figures without a window, one thread of BLAS, random inputs without a
deadline, one browser, and on several cores in an order that keeps them all busy."""

import functools
import gc
import importlib
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "Agg")
# The matrices are small and there is a worker on every core: threads of BLAS, which wait by turning
# on the spot, would only take the cores from each other. They are counted when NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Tests start many interpreters, workers too; each would compile the package's sources anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import numpy as np
import pytest
import typer.main
from hypothesis import settings

import vibrissa as vb
from vibrissa.contacts import contact_map

# Garbage is looked for less often: figures are many small objects, and it was a sixth of drawing.
gc.set_threshold(20_000, 20, 20)

# Typer makes the command line anew, with all verbs, whenever it is called.
typer.main.get_command = functools.cache(typer.main.get_command)

# Where all that the extra test names is installed, a test skipped for want of it hides a fault.
if os.environ.get("REQUIRE_EXTRAS"):
    pytest.importorskip = lambda name, **_: importlib.import_module(name)

# The first example of a law may compile a kernel, which takes seconds. In continuous integration
# the examples are the same in every run, so that a change fails by its own fault only.
settings.register_profile(
    "vibrissa", deadline=None, max_examples=40, derandomize=bool(os.environ.get("CI"))
)
settings.load_profile("vibrissa")

# Where files are shared out to workers, these come first, in this order. The first
# compiles the search's kernels while those of whiskers need none. `test_cli` then compiles the
# estimate's for a minute, and what follows it needs none of these, so that nobody compiles the same
# at the same time; then come those that take longest, so that no worker is left alone with one of
# them at the end.
_FIRST = [
    "identifiability/test_uniqueness.py",
    "whisker",
    "cli/test_cli.py",
    "contour",
    "io",
    "rod",
    "contacts/test_following.py",
    "report",
    "demo",
    "viewer/test_page.py",
    "viewer/test_watching.py",
    "sweeps",
    "contacts",
    "certificates",
    "streaming",
    "identifiability",
    "paper",
    "tracking",
    "plots",
    "simulation",
    "cli",
]
_HERE = Path(__file__).parent


def _turn(path):
    """When a file's turn is: the more particular line of ``_FIRST`` counts."""
    name = path.relative_to(_HERE).as_posix() if path.is_relative_to(_HERE) else ""
    for part in (name, name.partition("/")[0]):
        if part in _FIRST:
            return _FIRST.index(part)
    return len(_FIRST)


def pytest_configure(config):
    """Workers take files in the order above, not by how many tests are in them."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(config, items):
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: _turn(item.path))


def pytest_collection_finish():
    """Look for garbage only in what tests make."""
    gc.freeze()


@pytest.fixture
def interruptible():
    """Children start with the default action of signals that the tests themselves may ignore.

    A shell without job control starts a command in its background with SIGINT ignored, `nohup` one
    with SIGHUP ignored, and children inherit it.
    """
    default = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    if hasattr(signal, "SIGHUP"):
        default[signal.SIGHUP] = signal.SIG_DFL
    before = {number: signal.signal(number, action) for number, action in default.items()}
    yield
    for number, action in before.items():
        signal.signal(number, action)


_BROWSER = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]


@pytest.fixture(scope="session")
def browser():
    """Chromium, which draws 3D in software."""
    driver = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed", exc_type=ImportError
    )
    found = shutil.which("chromium") or shutil.which("chromium-browser")
    if found is None:
        pytest.skip("no browser called chromium is installed")
    with driver.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=found, args=_BROWSER)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def gamma_map() -> vb.ContactMap:
    """The default whisker's map."""
    return vb.ContactMap.simulate(vb.samples.gamma(), grid=False)


@pytest.fixture(scope="session")
def gridded_map(gamma_map) -> vb.ContactMap:
    """The default whisker's map with every third azimuth and elevation of the paper's grid."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("GRID_AZIMUTHS", "GRID_ELEVATIONS"):
            patch.setattr(contact_map, name, getattr(contact_map, name)[::3])
        return replace(gamma_map, grid=vb.ContactMap.simulate(gamma_map.whisker).grid)


@pytest.fixture
def coarse(monkeypatch):
    """Figures that are quicker to draw, where what they look like is not tested."""
    from vibrissa.plots.style import LOOK

    monkeypatch.setattr("vibrissa.scene.solids._SHAPE", (12, 24, 8))
    monkeypatch.setattr("vibrissa.plots.style.LOOK", {**LOOK, "savefig.dpi": 80.0})


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20)
