"""Answers of a stream are drawn as they come."""

import json
import time
from functools import cache

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed", exc_type=ImportError)

import vibrissa as vb
from vibrissa.scene import Arrows, Cloud
from vibrissa.streaming import Answers
from vibrissa.viewer import view_stream
from vibrissa.viewer.server import Live

WHISKER = vb.Whisker.straight(0.3, base_radius=0.5e-3, tip_radius=0.25e-3, youngs_modulus=200e9)


@cache
def bent():
    """The whisker in contact; not when tests are collected, as this compiles kernels."""
    return vb.deflect(WHISKER, vb.PointForce(0.2, 0.03, 0.4))


def answer(**changes):
    point = dict(zip("xyz", bent().contact_point.tolist(), strict=True))
    covariance = np.diag([4e-6, 1e-6, 1e-6]).tolist()
    known = {"status": "unique", **point, "force": bent().force.tolist(), "covariance": covariance}
    return json.dumps(known | changes)


def test_the_newest_contact_is_drawn_on_the_bent_whisker():
    live = Live(WHISKER)
    assert "contact" not in live.drawing(1.0)
    live.put(answer(x=0.19, y=0.0, z=0.0))
    live.put(answer())
    drawn = live.drawing(1.0)
    middle = 0.5 * (drawn["contact"].vertices.max(axis=0) + drawn["contact"].vertices.min(axis=0))
    np.testing.assert_allclose(middle, 1e3 * bent().contact_point, atol=1e-6)
    half = 0.5 * np.ptp(drawn["contact"].vertices, axis=0)
    np.testing.assert_allclose(
        half, 2.0 * np.sqrt([4.0 + 1.65**2, *[1.0 + 1.65**2] * 2]), rtol=0.02
    )
    line = 1e3 * bent().centerline(48)
    vertices = drawn["whisker"].vertices
    away = np.linalg.norm(vertices[:, None] - line, axis=2).min(axis=1)
    assert away.max() < 0.6
    assert isinstance(drawn["force"], Arrows)
    assert isinstance(drawn["points"], Cloud)
    assert len(drawn["points"].points) == 2


@pytest.mark.parametrize("line", ["", "no JSON", "[1]", '{"status": 3}', '{"status": "odd"}'])
def test_what_is_no_answer_is_counted(line):
    live = Live(WHISKER)
    live.put(line)
    assert (live.number, live.faults) == (0, 1)
    assert "contact" not in live.drawing(1.0)


def test_answers_without_a_point_and_of_other_whiskers():
    live = Live(WHISKER, "left")
    live.put(answer(whisker="right"))
    assert live.number == 0
    live.put(answer(whisker="left"))
    live.put(json.dumps({"status": "not_felt", "whisker": "left"}))
    assert live.number == 2
    drawn = live.drawing(1.0)
    assert "contact" not in drawn
    assert len(drawn["points"].points) == 1
    assert "2 results" in live.html()


def test_a_page_follows_a_stream():
    with view_stream(WHISKER, "127.0.0.1:0") as served:
        page = served.shown
        with Answers(f"udp://{page.address}") as sent:
            for _ in range(3):
                sent.send(answer())
                time.sleep(0.1)
        end = time.monotonic() + 60.0
        while page._stage.node("live", "contact") is None and time.monotonic() < end:
            time.sleep(0.05)
        assert page._stage.node("live", "contact") is not None
        assert "results" in page._text.content
