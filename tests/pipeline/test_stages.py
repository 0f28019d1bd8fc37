"""Which stages of a recording are due."""

import numpy as np
import pytest
import xarray as xr

from vibrissa.pipeline import STAGES, due_stages


@pytest.mark.parametrize(
    ("there", "last", "asked", "due"),
    [
        ((), "contour", (), STAGES),
        ((), "signals", (), ("signals",)),
        (("signals",), "signals", (), ("signals",)),
        (("signals",), "contour", (), ("estimates", "contour")),
        (STAGES, "contour", (), ("contour",)),
        (STAGES, "contour", ("estimates",), ("estimates", "contour")),
        (STAGES, "contour", ("signals",), STAGES),
        # Estimates that came without their signals are used as they are.
        (("estimates",), "contour", (), ("contour",)),
    ],
)
def test_what_is_missing_or_asked_for_is_due_and_all_that_depends_on_it(there, last, asked, due):
    groups = {f"/{name}": xr.Dataset({"x": ("time", np.zeros(1))}) for name in there}
    assert due_stages(xr.DataTree.from_dict({"/": xr.Dataset(), **groups}), last, asked) == due


def test_other_stages_are_refused():
    with pytest.raises(ValueError, match="one of signals, estimates, contour"):
        due_stages(xr.DataTree(), "tracks")
