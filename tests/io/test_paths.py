"""Where files may go and what can be read: said before anything is computed."""

import os
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

from vibrissa.io import (
    CSV,
    NETCDF,
    check_folder,
    check_readable,
    check_writable,
    is_netcdf,
    read_text,
    replacing,
)


def test_where_a_file_can_be_written(tmp_path):
    for good in (tmp_path / "a.nc", str(tmp_path / "A.NC")):
        check_writable(good, NETCDF)
    check_writable(tmp_path / "anything")
    with pytest.raises(ValueError, match="is a folder"):
        check_writable(tmp_path, CSV)
    with pytest.raises(ValueError, match=r"a.txt ends in .txt; .csv is needed"):
        check_writable(tmp_path / "a.txt", CSV)
    with pytest.raises(ValueError, match=r"has no ending; .nc or .nc4"):
        check_writable(tmp_path / "a", NETCDF)
    with pytest.raises(FileNotFoundError, match="none does not exist"):
        check_writable(tmp_path / "none" / "a.csv", CSV)
    assert not list(tmp_path.iterdir())


def test_where_a_folder_can_be_made(tmp_path):
    check_folder(tmp_path)
    check_folder(tmp_path / "a" / "b")
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "a"):
        with pytest.raises(ValueError, match="file is a file"):
            check_folder(path)


@contextmanager
def without_rights():
    """Not as root, to whom nothing is forbidden."""
    if os.geteuid() != 0:
        yield
        return
    os.setresuid(65534, 65534, 0)
    try:
        yield
    finally:
        os.setresuid(0, 0, 0)


@pytest.mark.skipif(not hasattr(os, "setresuid"), reason="this system has no such users")
def test_a_folder_that_cannot_be_written_to():
    # Folders of the other tests are closed to others than their owner.
    with tempfile.TemporaryDirectory() as base:
        Path(base).chmod(0o755)
        locked = Path(base) / "locked"
        locked.mkdir(mode=0o555)
        for check, path in ((check_writable, locked / "a.csv"), (check_folder, locked / "a")):
            with without_rights(), pytest.raises(PermissionError, match="locked"):
                check(path)


def test_what_can_be_read(tmp_path):
    path = tmp_path / "a.csv"
    with pytest.raises(FileNotFoundError, match="no file"):
        check_readable(path)
    path.write_bytes(b"")
    with pytest.raises(ValueError, match=r"a.csv is empty"):
        check_readable(path)
    with pytest.raises(ValueError, match="is a folder"):
        check_readable(tmp_path)
    with pytest.raises(ValueError, match="is a pipe or device"):
        check_readable(os.devnull)
    for content, message in (
        (b"time,Fx\n\xff\xfe\x00", "a.csv is not a text table in UTF-8: byte 8 is 0xff"),
        (b"time,Fx\n\0", "a.csv is not a text table: byte 8 is zero"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            read_text(path)


def test_netcdf_is_told_by_its_beginning_or_its_name(tmp_path):
    assert is_netcdf(tmp_path / "none.nc")
    assert not is_netcdf(tmp_path / "none.csv")
    path = tmp_path / "data"
    path.write_bytes(b"\x89HDF\r\n\x1a\n")
    assert is_netcdf(path)


def test_a_file_is_left_alone_when_writing_fails(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("old")

    def fail():
        with replacing(path) as part:
            part.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.csv"]
