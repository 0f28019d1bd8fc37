"""What can be shown: whiskers, maps and recordings, by what they are."""

from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="viser is not installed", exc_type=ImportError)

import vibrissa as vb
from vibrissa.viewer import view
from vibrissa.viewer.server import _of_one


def test_a_recording_brings_its_whisker(recording):
    with view(recording) as viewer:
        assert "Trial" in viewer.page.modes
        assert viewer.page.mode is viewer.page.modes["Trial"]
        assert viewer.page.original.length == pytest.approx(vb.samples.gamma().length)
        assert viewer.page.work.wait()


@pytest.mark.parametrize("wrong", ["whisker.csv", None, 3.0], ids=["path", "nothing", "number"])
def test_what_cannot_be_shown_is_said(wrong):
    with pytest.raises(ValueError, match="a Whisker, a ContactMap or a recording"):
        view(wrong)


def test_nothing_is_given_twice(recording):
    with pytest.raises(ValueError, match="two recordings"):
        view(recording, recording=recording)


def test_a_map_is_that_of_the_whisker():
    whisker, other = vb.samples.gamma(), vb.samples.curved()
    assert _of_one(SimpleNamespace(whisker=whisker), vb.samples.gamma()) is whisker
    with pytest.raises(ValueError, match="the map is that of another whisker"):
        _of_one(SimpleNamespace(whisker=other), whisker)
