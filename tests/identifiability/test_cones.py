"""Critical cones over curvature and taper."""

import numpy as np
import pytest

from vibrissa import samples
from vibrissa.identifiability import critical_cones


@pytest.mark.slow
def test_taper_and_straightness_narrow_the_cone():
    found = critical_cones([0.0, 0.4, 0.8], [2.0, 15.0], ["Fx MB MD"], samples=128)
    cone = np.rad2deg(found.critical_cone.sel(triplet="Fx MB MD"))
    assert (cone.diff("curvature") >= 0.0).all()
    assert (cone.diff("taper_ratio") <= 0.0).all()
    # No witness for a straight tapered whisker; inside 2° at A·L = 0.4; about 5° at 0.82.
    assert float(cone.sel(curvature=0.0).max()) == 0.0
    assert 0.5 < float(cone.sel(curvature=0.4, taper_ratio=15.0)) < 2.0
    assert 4.0 < float(cone.sel(curvature=0.8, taper_ratio=15.0)) < 5.5


@pytest.mark.parametrize(
    ("curvatures", "ratios", "message"),
    [
        ([-0.1], [2.0], "≥ 0"),
        ([0.1], [0.5], "≥ 1"),
        (samples.straight(), [2.0], "curvatures must be numbers; got"),
    ],
)
def test_impossible_whiskers_are_refused(curvatures, ratios, message):
    with pytest.raises(ValueError, match=message):
        critical_cones(curvatures, ratios)
