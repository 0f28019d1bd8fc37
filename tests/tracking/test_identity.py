"""Who is who, from all frames together: lines are drawn, so that seeing them costs nothing."""

from itertools import product

import numpy as np
import pytest

from vibrissa.tracking import Trace
from vibrissa.tracking.trace.follower import FEATURES, Appearance, features_of
from vibrissa.tracking.trace.identity import (
    LOST,
    Assignment,
    Seen,
    decided,
    settle_crossings,
    sideways,
)
from vibrissa.tracking.trace.trace import TraceOptions, overlap

BASES = np.array([[20.0, 60.0], [20.0, 72.0]])
FRAMES = 24


def straight(base, angle, length):
    along = np.arange(0.0, length, 2.0)[:, None] * [np.cos(angle), np.sin(angle)]
    return Trace(base + along, np.full(len(along), 0.1), np.ones(len(along), dtype=bool), 1.0)


def features(length, darkness):
    return np.array([np.log(length), *[np.log(darkness)] * 3, 0.0, 0.0, 0.0, 0.0])


def row(length=(100.0, 160.0), darkness=(0.3, 0.5)):
    """Two whiskers that sweep to and fro together, and what was seen of them."""
    seen = []
    for i in range(FRAMES):
        angle = 0.8 * np.sin(0.6 * i)
        lines = [straight(base, angle, long) for base, long in zip(BASES, length, strict=True)]
        each = [features(long, dark) for long, dark in zip(length, darkness, strict=True)]
        seen.append(Seen(lines, each, [0, 1], clear=i < 8))
    return seen


@pytest.mark.slow
def test_a_mix_up_that_was_followed_is_put_right():
    """From frame 12 on each was taken for the other."""
    seen = row()
    for frame in seen[12:]:
        frame.chosen = [1, 0]
    assert decided(seen, BASES) == [[0, 1]] * FRAMES


def test_a_stranger_is_not_taken_for_a_whisker_that_is_hidden():
    """Whisker 1 is not seen for five frames; a fainter line a little beside it is."""
    seen = row()
    for frame in seen[12:17]:
        other = straight(BASES[1] + [0.0, 4.0], 0.0, 60.0)
        frame.lines = [frame.lines[0], other]
        frame.features = [frame.features[0], features(60.0, 0.1)]
    found = decided(seen, BASES)
    assert [way[1] for way in found[12:17]] == [-1] * 5
    assert all(way[0] == 0 for way in found)
    assert all(way[1] == 1 for way in found[17:])


def test_what_a_person_says_holds():
    """Frame 15 is corrected: both on the line of the other, and there alone."""
    seen = row()
    swapped = list(seen[15].lines[::-1])
    for k in range(2):
        seen[15].settle(k, swapped[k])
    found = decided(seen, BASES)
    assert found[15] == [2, 3]
    assert found[:15] + found[16:] == [[0, 1]] * (FRAMES - 1)


def test_a_whisker_that_an_object_bends_is_not_lost():
    """Contact changes all turns of whisker 1 by more than they ever do without, and lets go."""
    seen = row()
    for i, bend in zip(range(12, 20), (0.1, 0.2, 0.3, 0.3, 0.3, 0.3, 0.2, 0.1), strict=True):
        seen[i].features[1] = seen[i].features[1] + np.array([0.0] * 4 + [bend] * 3 + [1.0])
        seen[i].clear = False
    assert decided(seen, BASES) == [[0, 1]] * FRAMES


def test_who_cannot_be_told_is_lost_rather_than_guessed():
    """Alike, and at one place from frame 12 on: nothing tells who is who."""
    seen = row((100.0, 100.0), (0.3, 0.3))
    for i in range(12, FRAMES):
        angles = 0.8 * np.sin(0.6 * i) + np.array([-0.05, 0.05])
        seen[i].lines = [straight(BASES.mean(axis=0), angle, 100.0) for angle in angles]
    found = decided(seen, BASES)
    assert found[:12] == [[0, 1]] * 12
    assert found[-1] == [-1, -1]


def test_the_appearance_of_a_line():
    """Length, contrast and turns of a bent line of a known grey value."""
    y, x = np.mgrid[:120, :200]
    place = 30.0 + 0.002 * (x - 10.0) ** 2
    frame = (200.0 - 100.0 * np.exp(-0.5 * ((y - place) / 1.4) ** 2)).astype(np.uint8)
    column = np.arange(10.0, 170.0, 1.9)
    line = np.stack([column, 30.0 + 0.002 * (column - 10.0) ** 2], axis=1)
    seen = features_of(frame, Trace(line, np.ones(len(line)), np.ones(len(line), dtype=bool), 1.0))
    assert seen[0] == pytest.approx(np.log(2.0 * len(line)))
    np.testing.assert_allclose(seen[1:3], np.log(0.5), atol=0.2)
    slopes = [np.arctan(0.004 * 1.9 * at) for at in (7.0, 24.0, 44.0, 64.0)]
    np.testing.assert_allclose(seen[4:-1], np.diff(slopes), atol=0.01)
    assert np.isnan(features_of(frame, Trace.lost())).all()
    usual = Appearance.of([seen] * 5)
    assert usual.unlikeness(seen) == 0.0
    shorter, longer = seen.copy(), seen.copy()
    shorter[0] -= 0.3
    longer[0] += 0.3
    assert 0.0 < usual.unlikeness(shorter) < usual.unlikeness(longer)
    assert Appearance.of([]).unlikeness(seen) == 0.0
    assert usual.middle.shape == (FEATURES,)


def test_sideways_of_lines_that_stand_still():
    line = straight(BASES[0], 0.3, 80.0).line
    normal = np.array([-np.sin(0.3), np.cos(0.3)])
    np.testing.assert_allclose(sideways(line, line + 2.0 * normal), 2.0, atol=1e-9)
    assert np.isfinite(sideways(np.zeros((40, 2)), line)).all()


def test_lines_overlap_where_some_point_is_near():
    generator = np.random.default_rng(7)
    for _ in range(20):
        line, other = (np.cumsum(generator.normal(0.5, 2.0, (n, 2)), axis=0) for n in (40, 60))
        distance = np.linalg.norm(line[:, None] - other[None], axis=2).min(axis=1)
        assert overlap(line, other, 3.0) == (distance < 3.0).mean()
    assert overlap(line, other[:0]) == overlap(line[:0], other) == 0.0


def test_the_usual_look_is_the_median_of_what_is_known():
    generator = np.random.default_rng(8)
    features = generator.normal(size=(12, FEATURES))
    features[generator.random(features.shape) < 0.4] = np.nan
    features[:, 0] = np.nan
    usual = Appearance.of(list(features))
    np.testing.assert_array_equal(usual.middle[1:], np.nanmedian(features[:, 1:], axis=0))
    assert np.isnan(usual.middle[0])
    assert np.isfinite(usual.spread).all()


def test_the_cheapest_ways_are_those_of_all():
    """Every way that is allowed, by hand: no line twice, none too dear, swapped bases cost."""
    random = np.random.default_rng(3)
    lines = [straight(random.uniform(0.0, 40.0, 2), 0.1 * k, 60.0) for k in range(5)]
    problem = Assignment(lines, np.array([[20.0, 60.0], [20.0, 72.0], [20.0, 84.0]]))
    price, lost = random.uniform(0.0, 15.0, (3, 5)), np.array([6.0, 6.0, 5.0])
    every = {}
    for way in product(range(-1, 5), repeat=3):
        pairs = [(j, k) for k in range(3) for j in range(k) if way[j] >= 0 and way[k] >= 0]
        if any(problem.clash[way[j], way[k]] for j, k in pairs):
            continue
        each = [lost[k] if c < 0 else price[k, c] for k, c in enumerate(way)]
        if all(c < 0 or cost < 2.0 * LOST for c, cost in zip(way, each, strict=True)):
            every[way] = sum(each) + sum(problem.swaps[k, j, way[k], way[j]] for j, k in pairs)
    expected = sorted(every.values())
    cost, ways = problem.ways(price, lost, limit=expected[20], most=12)
    np.testing.assert_allclose(cost, expected[:12])
    np.testing.assert_allclose([every[tuple(way)] for way in ways.tolist()], cost)
    assert len(problem.ways(price, lost, limit=expected[4])[0]) == 4


def arc(base, angle, bend, length=200.0):
    """A whisker of even bend, seen except next to the others."""
    turned = angle + bend * np.arange(0.0, length, 2.0)
    line = base + np.cumsum(2.0 * np.stack([np.cos(turned), np.sin(turned)], axis=1), axis=0)
    return Trace(line, np.full(len(line), 0.1), np.ones(len(line), dtype=bool), 1.0)


def crossed(one, other):
    """Each goes on as the other from where they meet, and nothing is seen next to that."""
    away = np.linalg.norm(one.line[:, None] - other.line[None], axis=2)
    a, b = np.unravel_index(np.argmin(away), away.shape)
    seen = [trace.seen & (away.min(axis=axis) > 5.0) for axis, trace in ((1, one), (0, other))]
    cuts = [(one.line, seen[0], a), (other.line, seen[1], b)]
    return [
        Trace(
            np.concatenate([mine[:n], others[m:]]),
            np.full(n + len(others) - m, 0.1),
            np.concatenate([shown[:n], beyond[m:]]),
            1.0,
        )
        for (mine, shown, n), (others, beyond, m) in (cuts, cuts[::-1])
    ]


def test_far_ends_exchanged_at_a_crossing_are_put_right():
    """From frame 8 to 15 each of two goes on as the other; a third one crosses both."""
    bends, bases = (4e-4, 2e-3, -1e-3), (60.0, 42.0, 120.0)
    sweep = 0.05 * np.sin(0.3 * np.arange(FRAMES))
    right = [
        [arc(np.array([20.0, y]), a, bend) for a in turn + sweep]
        for y, turn, bend in zip(bases, (0.0, 0.1, -0.3), bends, strict=True)
    ]
    traces = [list(each) for each in right]
    for i in range(8, 16):
        traces[0][i], traces[1][i] = crossed(right[0][i], right[1][i])
    found = settle_crossings(traces, [set()] * FRAMES, TraceOptions())
    for row_, true in zip(found, right, strict=True):
        assert all(overlap(a.line, b.line, 1.0) == 1.0 for a, b in zip(row_, true, strict=True))
    # What a person marked is not changed.
    kept = settle_crossings(traces, [{0}] * FRAMES, TraceOptions())
    assert all(
        a is b
        for one, other in zip(kept, traces, strict=True)
        for a, b in zip(one, other, strict=True)
    )
