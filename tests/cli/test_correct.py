"""`vibrissa correct`, as far as it goes without a screen."""

import numpy as np
import pytest

from vibrissa import plots
from vibrissa.cli.app import app
from vibrissa.io import load_corrections, save_corrections, write_video

typer_testing = pytest.importorskip("typer.testing")


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "v.mkv"
    write_video(path, [np.full((60, 80), 10 * i, np.uint8) for i in range(5)])
    return path


def run(*words):
    return typer_testing.CliRunner().invoke(app, [str(word) for word in words])


def test_corrections_of_other_views_are_kept(video, tmp_path, monkeypatch):
    """A person who adds one trace and saves."""
    path = tmp_path / "c.csv"
    line = np.array([[1.0, 2.0], [3.0, 4.0]])
    save_corrections(path, {0: {(3, 0): line}, 1: {(4, 0): line + 1.0}})

    def person(frames, count, corrections, traces, save):
        assert count == 5
        assert frames[2][0, 0] == 20
        assert traces == {}
        found = {**corrections, (2, 0): line + 5.0}
        save(found)
        return found

    monkeypatch.setattr(plots, "correct", person)
    done = run("correct", video, "-o", path, "--view", "1")
    assert done.exit_code == 0, done.exception
    assert "2 corrected traces of view 1" in done.stdout
    found = load_corrections(path)
    assert sorted(found[0]) == [(3, 0)]
    assert sorted(found[1]) == [(2, 0), (4, 0)]


def test_without_a_screen_it_says_so(video, tmp_path):
    done = run("correct", video, "-o", tmp_path / "c.csv")
    assert "no screen" in str(done.exception)
    assert ".csv is needed" in str(run("correct", video, "-o", tmp_path / "c.txt").exception)
    done = run("correct", video, "-o", tmp_path / "c.csv", "--view", "-1")
    assert "counted from 0" in str(done.exception)
