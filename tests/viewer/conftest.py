"""A real browser without a window, where there is one."""

import shutil

import pytest

ARGUMENTS = [
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
    pytest.importorskip("viser", reason="viser is not installed", exc_type=ImportError)
    found = shutil.which("chromium") or shutil.which("chromium-browser")
    if found is None:
        pytest.skip("no browser called chromium is installed")
    with driver.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=found, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def recording():
    """A short trial against a peg, with the cameras that saw it."""
    import vibrissa as vb
    from vibrissa.trial import facing_peg, simulate, sweep_past, views_of
    from vibrissa.trial.film import with_true_traces

    whisker = vb.samples.gamma()
    peg = facing_peg(whisker)
    motion = sweep_past(whisker, peg, duration=0.4, rate=250.0)
    trial = simulate(whisker, motion, [peg])
    return with_true_traces(trial, views_of(trial, 120e-6))
