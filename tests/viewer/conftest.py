"""What the page shows, in a real browser where there is one."""

import pytest


@pytest.fixture(scope="session")
def browser(browser):
    """The one of all tests, if there is a page to be shown in it."""
    pytest.importorskip("viser", reason="viser is not installed", exc_type=ImportError)
    return browser


@pytest.fixture(scope="session")
def recording():
    """A short trial against a peg, with the cameras that saw it."""
    import vibrissa as vb
    from vibrissa.simulation import facing_peg, simulate, sweep_past, views_of, with_true_traces

    whisker = vb.samples.gamma()
    peg = facing_peg(whisker)
    motion = sweep_past(whisker, peg, duration=0.4, rate=250.0)
    trial = simulate(whisker, motion, [peg])
    return with_true_traces(trial, views_of(trial, 120e-6))
