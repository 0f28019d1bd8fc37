"""`vibrissa view` serves a page, says where, and ends when it is told to."""

import re
import signal
import socket
import subprocess
import sys
import threading
import urllib.request

import pytest

pytest.importorskip("viser", reason="viser is not installed", exc_type=ImportError)

COMMAND = [sys.executable, "-c", "from vibrissa.cli import main; main()", "view", "--no-browser"]


@pytest.mark.usefixtures("interruptible")
def test_the_page_is_served_until_interrupted():
    serving = subprocess.Popen(COMMAND, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        said = serving.stdout.readline()
        url = re.match(r"http://127\.0\.0\.1:\d+", said)[0]
        with urllib.request.urlopen(url) as answer:
            assert b"<!doctype html>" in answer.read().lower()
    finally:
        serving.send_signal(signal.SIGINT)
        rest, complaints = serving.communicate(timeout=30)
    assert serving.returncode == 0
    assert rest.strip() == "stopped"
    # Kernels are compiled meanwhile, unless that was done before.
    assert [line for line in complaints.splitlines() if "compiling kernels" not in line] == []


def test_videos_need_a_trial(tmp_path):
    import vibrissa as vb
    from vibrissa.viewer import view

    with pytest.raises(ValueError, match="the trial has 0 cameras; got 1 videos"):
        view(vb.samples.gamma(), videos=[tmp_path / "top.mp4"])


def test_edited_recordings_are_checked(tmp_path, monkeypatch, capsys):
    """As by the other verbs."""
    import numpy as np
    import xarray as xr

    import vibrissa as vb
    from vibrissa.cli import main
    from vibrissa.recording import coordinates, recorded, recording_tree

    turns = recorded("base_rotation", 2.0 * np.tile(np.eye(3), (2, 1, 1, 1)))
    root = xr.Dataset({"base_rotation": turns}, coordinates([0.0, 1.0], ["w"]))
    tree = recording_tree(root, [vb.samples.gamma()], "test")
    vb.io.save_recording(tmp_path / "trial.nc", tree)
    monkeypatch.setattr(
        sys, "argv", ["vibrissa", "view", "--no-browser", str(tmp_path / "trial.nc")]
    )
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    assert "base_rotation is not a rotation" in capsys.readouterr().err


def test_a_taken_port_is_passed_over():
    from vibrissa.viewer.server import PORT, free_port

    first = free_port("127.0.0.1")
    assert first >= PORT
    with socket.create_server(("127.0.0.1", first)):
        assert free_port("127.0.0.1") > first


def test_stopped_before_it_is_there_it_ends_as_well(monkeypatch):
    from typer.testing import CliRunner

    from vibrissa.cli.app import app

    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("vibrissa.viewer.server.view", stopped)
    result = CliRunner().invoke(app, ["view", "--no-browser"])
    assert result.exit_code == 0
    assert result.stdout.strip() == "stopped"


def test_what_was_opened_is_closed_if_a_later_step_fails(monkeypatch):
    import vibrissa as vb
    from vibrissa.viewer import view
    from vibrissa.viewer.server import free_port, is_free

    def broken(page):
        raise RuntimeError("no such mode")

    monkeypatch.setattr("vibrissa.viewer.server.MapMode", broken)
    port = free_port("127.0.0.1")
    with pytest.raises(RuntimeError, match="no such mode"):
        view(vb.samples.gamma(), port=port)
    assert is_free("127.0.0.1", port)
    assert not {"viewer", "player"} & {thread.name for thread in threading.enumerate()}
