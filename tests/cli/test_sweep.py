"""Studies on the command line: planned, done, stopped, gone on with, shown."""

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from vibrissa.cli.app import app
from vibrissa.sweeps import open_sweep, read_study

RUN = CliRunner()
STUDY = """
name = "small"
[[whiskers]]
taper_ratio = [5, 15]
curvature = 0.4
[[whiskers]]
group = "others"
curvature = 0.2
[[tasks]]
kind = "map"
[[tasks]]
kind = "uniqueness"
groups = ["others"]
triplets = ["Fx MB MD"]
samples = 64
resolution = false
"""


@pytest.fixture(autouse=True, scope="module")
def zarr():
    pytest.importorskip("zarr", reason="zarr (extra sweeps) is not installed")


def done(*words):
    result = RUN.invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture
def study(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    return path


def test_the_example_is_a_study():
    assert read_study(done("sweep", "--example"), Path()).size == 30


def test_a_dry_run_counts_and_does_nothing(study, tmp_path):
    said = done("sweep", study, "-o", tmp_path / "s", "--dry-run", "--workers", 2)
    assert "4 cells: 3 whiskers, map of 3, uniqueness of 1" in said
    assert "min of one core" in said
    assert "about 1 MB" in said
    assert not (tmp_path / "s").exists()


def test_a_dry_run_constructs_the_whiskers(tmp_path):
    path = tmp_path / "study.toml"
    text = "[[whiskers]]\nlength = {}\n[[tasks]]\nkind = 'map'\n"
    path.write_text(text.format("[40, 0.04, 0.05, 0.06, 0.07]"))
    result = RUN.invoke(app, ["sweep", str(path), "--dry-run"])
    assert result.exit_code == 1
    assert "5 cells" in result.output
    assert "failed: length 0.04: ValueError: " in result.output
    assert "and 1 more" in result.output


def test_a_failed_cell_shows_in_the_exit_status(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text("[[whiskers]]\nlength = [0.04, 40]\n[[tasks]]\nkind = 'map'\n")
    for _ in range(2):
        result = RUN.invoke(app, ["sweep", str(path), "-o", str(tmp_path / "s"), "--workers", "0"])
        assert result.exit_code == 1
        assert "map: 1 done, 1 failed" in result.output


@pytest.mark.slow
def test_done_shown_and_not_done_again(study, tmp_path):
    store = tmp_path / "s.zarr"
    said = done("sweep", study, "-o", store, "--workers", 0)
    assert "4 cells done, 0 of them failed" in said
    assert "map: 3 done, 0 failed, 0 to do" in said
    said = done("sweep", study, "-o", store, "--workers", 0)
    assert "0 cells done, 0 of them failed; 4 were there before and skipped" in said
    said = done("sweep", "show", store, "-o", tmp_path / "figures")
    assert "uniqueness: 1 done" in said
    assert "unique (no counterexample found)" in said
    assert "contacts with a twin" in said
    assert "Fx MB MD" in said
    figure = tmp_path / "figures" / "s-uniqueness.png"
    assert figure.stat().st_size > 10_000
    figure.write_text("kept")
    assert "was not changed" in done("sweep", "show", store, "-o", tmp_path / "figures")
    assert figure.read_text() == "kept"
    status = open_sweep(store)["status"]
    assert status.sel(task="uniqueness").values.tolist() == [-1, -1, 1]


@pytest.mark.slow
@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_stops_and_says_how_to_go_on(study, tmp_path):
    study.write_text(STUDY.replace("taper_ratio = [5, 15]", f"length = {list(range(20, 60))}"))
    store = tmp_path / "s.zarr"
    command = "from vibrissa.cli import main; main()"
    words = ["sweep", str(study), "-o", str(store), "--workers", "1"]
    with subprocess.Popen(
        [sys.executable, "-c", command, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as client:
        end = time.monotonic() + 120.0
        records = store / "map.cells"
        while not (records.exists() and records.stat().st_size):
            assert client.poll() is None
            assert time.monotonic() < end
            time.sleep(0.05)
        # As a terminal does: to the workers as well.
        os.killpg(client.pid, signal.SIGINT)
        _, said = client.communicate(timeout=60)
    assert client.returncode == 130
    assert "the same command continues" in " ".join(said.split())
    assert "Traceback" not in said
    assert (open_sweep(store)["status"] == 1).any()


def test_a_full_disk_is_named_in_one_line(study, tmp_path, monkeypatch):
    """Wherever it is found: when the store is begun, when a cell is written."""
    store = tmp_path / "s.zarr"

    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("vibrissa.sweeps.run_sweep", full)
    done = RUN.invoke(app, ["sweep", str(study), "-o", str(store), "--workers", "0"])
    assert isinstance(done.exception, OSError)
    assert f"{store} cannot be written: No space left" in str(done.exception)


def test_what_is_wrong_is_told(study, tmp_path):
    for words, said in (
        (["sweep"], "a study is needed"),
        (["sweep", "show"], "what to show"),
        (["sweep", str(study), "more"], "is not expected here"),
        (["sweep", "show", str(tmp_path)], "not a store of a sweep"),
    ):
        result = RUN.invoke(app, words)
        assert isinstance(result.exception, ValueError)
        assert said in str(result.exception)
