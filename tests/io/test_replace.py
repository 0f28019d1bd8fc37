"""A file is written whole or not at all, and what killed runs leave is removed."""

import os
import signal
import subprocess
import sys

import pytest

from vibrissa.io import replacing

WRITES = """
import sys
from vibrissa.io import replacing
with replacing(sys.argv[1]) as part:
    part.write_text("half")
    print("begun", flush=True)
    sys.stdin.read()
"""


def begun(path):
    """Another process that is in the middle of writing a file."""
    command = [sys.executable, "-c", WRITES, str(path)]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    )
    assert process.stdout.readline() == "begun\n"
    return process


def test_what_killed_runs_leave_is_removed_and_nothing_else(tmp_path):
    other = [tmp_path / name for name in (".a.abcdefgh.part.nc", "a.vibrissa-part-abcdefgh.nc")]
    for file in other:
        file.write_text("somebody else's")
    killed, living = begun(tmp_path / "a.nc"), begun(tmp_path / "b.nc")
    with killed, living:
        killed.send_signal(signal.SIGKILL)
        killed.wait()
        held = set(tmp_path.iterdir()) - set(other)
        assert len(held) == 2
        with replacing(tmp_path / "c.nc") as part:
            part.write_text("whole")
        left = set(tmp_path.iterdir()) - {*other, tmp_path / "c.nc"}
        if sys.platform != "win32":
            assert len(left) == 1
            assert left < held
        living.communicate("")
        assert living.returncode == 0
    assert (tmp_path / "b.nc").read_text() == "half"
    assert {file.name for file in tmp_path.iterdir()} == {
        *(file.name for file in other),
        "b.nc",
        "c.nc",
    }


def test_the_old_file_stays_where_writing_fails(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("old")

    class Spoilt(Exception):
        pass

    def fail():
        with replacing(path) as part:
            part.write_text("new")
            raise Spoilt

    with pytest.raises(Spoilt):
        fail()
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.csv"]


def test_a_file_is_as_open_as_any_other_new_one(tmp_path):
    (tmp_path / "plain").write_text("")
    with replacing(tmp_path / "ours") as part:
        part.write_text("")
    modes = {(tmp_path / name).stat().st_mode for name in ("plain", "ours")}
    assert len(modes) == 1


@pytest.mark.skipif(sys.platform == "win32", reason="links and permissions of POSIX")
def test_a_link_and_permissions_are_kept(tmp_path):
    """The link was replaced, and its file left as it was; private files became readable by all."""
    file, link = tmp_path / "archive" / "trial.csv", tmp_path / "trial.csv"
    file.parent.mkdir()
    file.write_text("old")
    file.chmod(0o600)
    link.symlink_to(file)
    with replacing(link) as part:
        part.write_text("new")
    assert link.is_symlink()
    assert file.read_text() == "new"
    assert file.stat().st_mode & 0o777 == 0o600
    file.unlink()
    file.parent.rmdir()
    with pytest.raises(FileNotFoundError, match="does not exist; make it first"), replacing(link):
        pass
