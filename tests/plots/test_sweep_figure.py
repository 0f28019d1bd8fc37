"""Figures of studies."""

import numpy as np
import pytest
import xarray as xr

from vibrissa import plots

WHISKERS = 6
WORDS = np.array(["unique", "unique", "not unique", "not unique", "unique off a surface", ""])


def study(triplets: int) -> xr.Dataset:
    """What a study of six whiskers has found; nothing is known of the last one yet."""
    cone = np.radians([0.0, 1.5, 3.0, 90.0, 0.5, np.nan])
    shape = (WHISKERS, triplets, 1)
    dims = ("whisker", "triplet", "region")
    return xr.Dataset(
        {
            "job_verdict": (dims, np.broadcast_to(WORDS[:, None, None], shape)),
            "job_critical_cone": (dims, np.broadcast_to(cone[:, None, None], shape)),
            "noise_median_error": (
                ("whisker", "signals"),
                np.array(
                    [[1e-4, 2e-5], [2e-4, 0.0], [3e-4, 1e-4], [1e-3, 1e-3]] + 2 * [2 * [np.nan]]
                ),
            ),
            "noise_wrench_median_error": (("whisker",), np.zeros(WHISKERS)),
        },
        {
            "task": ["job", "noise", "later"],
            "triplet": ["Fx MB MD", "Fx FD MD", "FD MB MD", "Mx MB MD"][:triplets],
            "region": ["all"],
            "signals": ["Fx MB MD", "wrench"],
            "group": ("whisker", ["grid"] * 3 + ["array"] * 3),
            "taper_ratio": ("whisker", [1.0, 2.0, 15.0, 1.0, 36.0, 36.0]),
            "turn": ("whisker", np.radians([0.0, 20.0, 50.0, 360.0, 40.0, 40.0])),
        },
    )


def marks(axes) -> np.ndarray:
    """Where marks are."""
    places = [np.ma.filled(one.get_offsets(), np.nan) for one in axes.collections]
    return np.concatenate([np.reshape(p, (-1, 2)) for p in places])


def test_each_whisker_that_is_known_is_once_in_each_panel():
    chart, groups, *_ = plots.sweep_overview(study(1)).axes
    known = [[1.0, 0.0], [2.0, 20.0], [15.0, 50.0], [1.0, 360.0], [36.0, 40.0]]
    assert sorted(map(tuple, np.round(marks(chart)[: len(known)], 9))) == sorted(map(tuple, known))
    assert np.sort(marks(groups)[:, 0]) == pytest.approx([0.0, 0.5, 1.5, 3.0, 90.0])
    assert [text.get_text() for text in groups.get_yticklabels()] == ["grid", "array"]
    assert sorted(np.round(marks(groups)[:, 1])) == [0, 0, 0, 1, 1]


def test_many_triplets_share_a_panel():
    (axes,) = plots.sweep_overview(study(4), task="job").axes
    assert len(axes.get_yticklabels()) == 4
    assert sorted(np.round(marks(axes)[:, 1])) == sorted(5 * [0, 1, 2, 3])


def test_errors_are_drawn_for_each_set_of_signals():
    (axes,) = plots.sweep_overview(study(1), task="noise").axes
    drawn = marks(axes)
    assert np.sort(drawn[np.round(drawn[:, 1]) == 0, 0]) == pytest.approx([0.1, 0.2, 0.3, 1.0])
    assert np.sort(drawn[np.round(drawn[:, 1]) == 1, 0]) == pytest.approx([1e-4, 0.02, 0.1, 1.0])


def test_what_can_be_drawn():
    assert plots.drawable(study(1)) == ["job", "noise"]
    with pytest.raises(ValueError, match=r"no verdicts or errors of later; .* job, noise"):
        plots.sweep_overview(study(1), task="later")
