"""How every test runs: figures without a window, one thread of BLAS, random inputs without a
deadline, one browser."""

import os
import shutil

os.environ.setdefault("MPLBACKEND", "Agg")
# The matrices are small and there is a worker on every core: threads of BLAS, which wait by turning
# on the spot, would only take the cores from each other. They are counted when NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from hypothesis import settings

# The first example of a law may compile a kernel, which takes seconds. In continuous integration
# the examples are the same in every run, so that a change fails by its own fault only.
settings.register_profile("vibrissa", deadline=None, derandomize=bool(os.environ.get("CI")))
settings.load_profile("vibrissa")


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
