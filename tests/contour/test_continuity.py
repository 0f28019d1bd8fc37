"""Of several candidates the one that goes on from its neighbours is chosen."""

import numpy as np
import pytest

from vibrissa.contour import continuing_candidates

NAN = [np.nan] * 3


def at(x):
    return [x, 0.0, 0.0]


def test_the_candidate_next_to_the_unbroken_run_is_chosen():
    candidates = [
        [at(0.0), NAN],
        [at(9.0), at(0.1)],  # goes on from frame 0
        [at(9.0), at(0.2)],
        [NAN, NAN],
        [at(9.1), NAN],
        [at(9.0), at(0.3)],  # nearer in time to frame 4
        [at(9.0), at(0.0)],  # another run, without any that is sure: the more plausible
    ]
    frames = [0, 1, 2, 3, 4, 5, 9]
    assert continuing_candidates(candidates, frames).tolist() == [0, 1, 1, -1, 0, 0, 0]


def test_nothing_to_choose():
    assert continuing_candidates(np.empty((0, 1, 3)), np.empty(0, dtype=int)).size == 0
    with pytest.raises(ValueError, match=r"\(n, k, 3\)"):
        continuing_candidates(np.zeros((4, 3)), np.arange(4))
