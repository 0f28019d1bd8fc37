"""Rows that lie on one another in one view are traced by where the other view shows them."""

import sys

import numpy as np
import pytest
from rows import RowFilm, curve, scored

from vibrissa.tracking import Trace, retraced, trace_video
from vibrissa.tracking.trace import guided

FRAMES = 16


class Row:
    """A film of three whiskers whose bases are at one height, and the traces of each view."""

    def __init__(self, seed, apart):
        self.film = RowFilm(seed, 3, frames=FRAMES, apart=apart)
        self.bases = [truth[0, :, 0] for truth in self.film.truth]
        views = zip(self.film.images, self.bases, strict=True)
        self.traces = [trace_video(images, bases) for images, bases in views]

    def frames(self, view):
        """A function that gives the frames of a view anew."""
        return lambda: iter(self.film.images[view])

    def retraced(self, **options):
        """Traces after the views have been compared, and remarks."""
        videos = [self.frames(view) for view in range(2)]
        samples = self.film.images
        return retraced(
            self.film.cameras, videos, self.bases, self.traces, samples=samples, **options
        )

    def right(self, traces, view):
        """Share of the images of distinguishable whiskers that are right."""
        score = scored(traces[view], self.film.truth[view])
        assert np.isfinite(score).sum() > FRAMES
        return float((score[np.isfinite(score)] == 1.0).mean())


@pytest.fixture(scope="module")
def flat():
    return Row(2, (1.5e-3, 1e-4))


@pytest.fixture(scope="module")
def retraced_flat(flat):
    return flat.retraced()


def test_a_row_that_lies_on_itself_is_traced_by_the_other_view(flat, retraced_flat):
    traces, remarks = retraced_flat
    assert flat.right(flat.traces, 1) < 0.5
    assert flat.right(traces, 1) > 0.93
    assert not (scored(traces[1], flat.film.truth[1]) == -1.0).any()
    assert len(remarks) == 1
    assert "front" in remarks[0]


def test_the_view_that_guides_keeps_its_traces(flat, retraced_flat):
    traces, _ = retraced_flat
    pairs = zip(flat.traces[0], traces[0], strict=True)
    assert all(a is b for one, other in pairs for a, b in zip(one, other, strict=True))


def test_its_traces_begin_on_the_whiskers(flat, retraced_flat):
    """Within three of the standard deviations that traces state where others hide their bases."""
    (front,) = retraced_flat[0][1:]
    seen = [(k, i, t) for k, row in enumerate(front) for i, t in enumerate(row) if len(t.line)]
    assert len(seen) > 0.9 * 3 * FRAMES
    for k, i, trace in seen:
        away = np.linalg.norm(curve(flat.film.truth[1][i, k]) - trace.line[0], axis=1).min()
        assert away < 3.0 * max(trace.sigma[0], 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3, 5])
def test_other_rows_that_lie_on_themselves(seed):
    row = Row(seed, (1.5e-3, 1e-4))
    assert row.right(row.retraced()[0], 1) > 0.93


def test_views_that_agree_are_left_alone():
    row = Row(1, (1.5e-3, 1.3e-3))
    traces, remarks = row.retraced()
    assert not remarks
    assert traces[1][0][0] is row.traces[1][0][0]


def test_corrections_stay_as_they_are(flat):
    line = flat.film.truth[1][5, 2]
    traces, _ = flat.retraced(corrections={1: {(5, 2): line}})
    np.testing.assert_allclose(traces[1][2][5].line[0], line[0], atol=0.1)
    assert flat.right(traces, 1) > 0.93


def test_a_whisker_that_the_other_view_loses_is_lost(flat):
    known = [list(row) for row in flat.traces[0]]
    known[1][4] = Trace.lost()
    traces, _ = guided.trace_guided(
        flat.frames(1), flat.bases[1], flat.film.cameras, known, sample=flat.film.images[1]
    )
    assert not len(traces[1][4].line)
    assert len(traces[1][5].line)
    assert len(traces[0][4].line)


def test_a_whisker_that_the_other_view_hardly_shows_guides_nothing_far_away(flat):
    """Two points, as beside an object, were continued by a parabola to 700,000 pixels."""
    row = Row(2, (1.5e-3, 1e-4))
    row.traces[0][1] = list(row.traces[0][1])
    for i in (3, 4):
        trace = row.traces[0][1][i]
        line, few = np.add(trace.line[:2], [[0.3, 0.0], [0.0, -0.9]]), slice(2)
        row.traces[0][1][i] = trace._replace(
            line=line, sigma=trace.sigma[few], seen=trace.seen[few], tip_seen=False
        )
    traces, _ = row.retraced()
    assert flat.right(traces, 1) > 0.9


def test_whiskers_whose_lines_are_as_likely_those_of_others_are_named(flat, monkeypatch):
    """Two lines of a whisker and one of another, 20 pixels apart: what does the choice gain?"""
    place = np.array([[0.0, 0.0], [20.0, 20.0], [0.0, 1.0], [np.nan, np.nan]])
    ways = np.array([[0, 2], [1, 2], [1, -1], [0, -1]])
    margins = guided._margins(ways, np.array([-9.0, -8.0, -3.0, -2.0]), place, [0, 2])
    np.testing.assert_allclose(margins, [1.0, 6.0])
    assert np.isnan(guided._margins(ways[1:], np.array([0.0, 1.0, 2.0]), place, [0, 2])).all()
    monkeypatch.setattr(sys.modules["vibrissa.tracking.space.retrace"], "_SURE", np.inf)
    remark = flat.retraced()[1][1]
    assert remark.startswith("not sure which lines in front are those of whisker 0, whisker 1, wh")


def test_whiskers_about_which_the_views_still_disagree_need_clearer_lines(flat, monkeypatch):
    """One that is shown by too short a line, with the margin with which the others are sure."""
    module = sys.modules["vibrissa.tracking.space.retrace"]
    whole, _ = flat.retraced()
    cut = [t._replace(line=t.line[: len(t.line) // 4]) for t in whole[1][1]]
    new = [whole[1][0], cut, whole[1][2]]
    monkeypatch.setattr(module, "trace_guided", lambda *_, **__: (new, np.full(3, 2.0)))
    remark = flat.retraced()[1][1]
    assert remark.startswith("not sure which lines in front are those of whisker 1: others")


def test_long_films_are_decided_in_blocks(flat, monkeypatch):
    monkeypatch.setattr(guided, "_BLOCK", FRAMES // 2)
    traces, _ = flat.retraced()
    assert [len(row) for row in traces[1]] == [FRAMES] * 3
    assert flat.right(traces, 1) > 0.93


def test_a_single_whisker_is_not_traced_anew(flat):
    one = [view[:1] for view in flat.traces]
    videos = [flat.frames(view) for view in range(2)]
    bases = [view[:1] for view in flat.bases]
    traces, remarks = retraced(flat.film.cameras, videos, bases, one, samples=flat.film.images)
    assert not remarks
    assert traces[1][0][3] is one[1][0][3]


def test_the_lines_of_many_whiskers_can_be_combined():
    """With fewer candidates of each, as the number of combinations grows with that of whiskers."""
    line = np.stack([np.arange(0.0, 80.0, 4.0), np.zeros(20)], axis=1)
    rows = [
        [
            guided._Candidate(
                line + np.array([0, 30 * k + 7 * c]), np.ones(20), c - 5.0, np.zeros(3)
            )
            for c in range(3)
        ]
        for k in range(20)
    ]
    choice = guided._combined(rows)
    assert choice.cost[0] == pytest.approx(20 * -5.0)
    assert (choice.ways[0] >= 0).all()
