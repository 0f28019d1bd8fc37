"""The store of a study: whole whenever a run ends, and nobody else's."""

import errno
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from vibrissa.sweeps import Busy, Store, failures, open_sweep, read_study, run_sweep, sweep_summary
from vibrissa.sweeps.study import answer

TEXT = """
name = "three"
[[whiskers]]
taper_ratio = [5, 15, 30]
curvature = 0.4
[[tasks]]
kind = "map"
"""


@pytest.fixture(scope="module")
def study():
    return read_study(TEXT, Path())


@pytest.fixture(scope="module")
def known(study):
    """Answers to all cells, found once, and with fewer numbers, for stores are all alike."""
    found = {cell.identity: answer(cell) for cell in study.cells()}
    for one in found.values():
        one["result"] = one["result"][["slip_force", "r_largest"]]
    return found


@pytest.fixture(autouse=True)
def nothing_is_computed(known, monkeypatch):
    monkeypatch.setattr("vibrissa.sweeps.run.answer", lambda cell: known[cell.identity])


@pytest.fixture(scope="module")
def written(study, known, tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "s"
    with Store(path, study) as store:
        for cell in study.cells():
            assert store.write(cell, known[cell.identity])
    return path


@pytest.fixture
def path(written, tmp_path):
    """A store with all that there is."""
    return Path(shutil.copytree(written, tmp_path / "s"))


@pytest.fixture(scope="module")
def whole(written):
    return open_sweep(written)


def test_all_that_is_answered_is_there_and_any_zarr_library_opens_it(study, known, tmp_path, whole):
    run_sweep(study, tmp_path / "s", workers=0)
    found = xr.open_zarr(tmp_path / "s" / "results", chunks=None).load()
    expected = [one["result"]["slip_force"].values for one in known.values()]
    assert found["map_slip_force"].dims == ("whisker", "station")
    np.testing.assert_array_equal(found["map_slip_force"].values, expected)
    assert found["map_slip_force"].attrs["units"] == "N"
    np.testing.assert_array_equal(
        found["length"], [one["whisker"]["length"] for one in known.values()]
    )
    xr.testing.assert_equal(open_sweep(tmp_path / "s"), whole)


def test_what_is_done_is_not_done_again(study, path, whole):
    before = (path / "map.cells").read_bytes()
    outcome = run_sweep(study, path, workers=0)
    assert (outcome.done, outcome.skipped) == (0, 3)
    assert (path / "map.cells").read_bytes() == before
    xr.testing.assert_identical(open_sweep(path), whole)


def test_a_run_that_is_killed_at_any_write_loses_and_spoils_nothing(study, path, whole):
    """Whatever part of the last record or line was written, those before it count."""
    records = path / "map.cells"
    content = records.read_bytes()
    size = len(content) // 3
    for kept in range(0, len(content), 41):
        records.write_bytes(content[:kept])
        found = open_sweep(path)
        assert (found["status"].values[:, 0] == 1).sum() == kept // size
        assert np.isnan(found["map_slip_force"].values[kept // size :]).all()
        np.testing.assert_array_equal(
            found["map_slip_force"].values[: kept // size],
            whole["map_slip_force"].values[: kept // size],
        )
    for kept in (0, size - 1, size, len(content) - 1):
        records.write_bytes(content[:kept])
        (path / "failures.jsonl").write_bytes(b'1234 {"task": "ma')
        outcome = run_sweep(study, path, workers=0)
        assert (outcome.done, outcome.skipped) == (3 - kept // size, kept // size)
        xr.testing.assert_identical(open_sweep(path), whole)


class Killed(BaseException):
    """Here a process ends, and runs nothing more."""


@pytest.mark.parametrize("name", [".study.json", "map.json", "results"])
def test_a_run_that_is_killed_while_it_renames_is_begun_anew(
    study, whole, tmp_path, monkeypatch, name
):
    def kill(real):
        def move(self, target):
            if target.name == name:
                raise Killed
            return real(self, target)

        return move

    with monkeypatch.context() as patch:
        for each in ("rename", "replace"):
            patch.setattr(Path, each, kill(getattr(Path, each)))
        with pytest.raises(Killed):
            run_sweep(study, tmp_path / "s", workers=0)
    run_sweep(study, tmp_path / "s", workers=0)
    xr.testing.assert_identical(open_sweep(tmp_path / "s"), whole)
    assert xr.open_zarr(tmp_path / "s" / "results", chunks=None).sizes["whisker"] == 3
    assert not list((tmp_path / "s").glob(".new*"))


def cut(file):
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def overwrite(file):
    content = bytearray(file.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 4] = bytes(byte ^ 0x55 for byte in content[middle : middle + 4])
    file.write_bytes(content)


@pytest.mark.parametrize("damage", [cut, overwrite, Path.unlink])
def test_records_that_are_damaged_are_noticed_and_done_again(study, path, whole, damage):
    damage(path / "map.cells")
    shown = open_sweep(path)
    status = shown["status"].values[:, 0]
    assert not (status == 1).all()
    assert np.isnan(shown["map_slip_force"].values[status != 1]).all()
    if damage is overwrite:
        assert list(status) == [1, 3, 1]
        assert "damaged (`vibrissa sweep` does them again)" in "\n".join(sweep_summary(shown))
    outcome = run_sweep(study, path, workers=0)
    assert outcome.done == (status != 1).sum()
    assert outcome.damaged == (status == 3).sum()
    xr.testing.assert_identical(open_sweep(path), whole)


@pytest.mark.parametrize("damage", [cut, overwrite, Path.unlink])
def test_results_that_are_damaged_are_noticed_and_written_anew(study, path, whole, damage):
    run_sweep(study, path, workers=0)
    assert run_sweep(study, path, workers=0).faults == ()
    chunk = next((path / "results" / "map_slip_force").glob("[0-9]*"))
    content = chunk.read_bytes()
    damage(chunk)
    outcome = run_sweep(study, path, workers=0)
    assert outcome.done == 0
    assert "results was damaged or of an earlier run" in outcome.faults[0]
    assert chunk.read_bytes() == content


def test_any_byte_of_a_record_that_changes_is_noticed(path, whole):
    records = path / "map.cells"
    content = records.read_bytes()
    for at in range(len(content) // 3, 2 * len(content) // 3, 7):
        records.write_bytes(content[:at] + bytes([content[at] ^ 0x10]) + content[at + 1 :])
        found = open_sweep(path)
        assert [found["status"].values[i, 0] for i in (0, 2)] == [1, 1]
        assert found["status"].values[1, 0] != 1
        assert np.isnan(found["map_slip_force"].values[1]).all()


@pytest.mark.parametrize("damage", [cut, overwrite, Path.unlink])
def test_descriptions_that_are_damaged_are_noticed(study, path, whole, damage):
    damage(path / "map.json")
    if damage is not Path.unlink:
        with pytest.raises(ValueError, match=r"map\.json is damaged"):
            open_sweep(path)
    outcome = run_sweep(study, path, workers=0)
    assert (outcome.done, len(outcome.faults)) == (3, 1)
    xr.testing.assert_identical(open_sweep(path), whole)
    damage(path / ".study.json")
    if damage is Path.unlink:
        assert run_sweep(study, path, workers=0).done == 3
        xr.testing.assert_identical(open_sweep(path), whole)
        return
    with pytest.raises(ValueError, match=r"study\.json is damaged"):
        run_sweep(study, path, workers=0)


FULL = Path("/dev/full")


@pytest.mark.skipif(not FULL.exists(), reason="this system has no file that is always full")
def test_a_full_disk_is_named_and_the_run_can_go_on(study, whole, tmp_path):
    store = tmp_path / "s"

    def fill(so_far: int, total: int) -> None:
        # Put back before anybody reads: what is read from it has no end.
        if so_far == 1:
            (store / "map.cells").rename(tmp_path / "aside")
            (store / "map.cells").symlink_to(FULL)

    with pytest.raises(OSError, match=r"No space left .*map\.cells.* continues") as raised:
        run_sweep(study, store, workers=0, progress=fill)
    assert raised.value.errno == errno.ENOSPC
    (tmp_path / "aside").replace(store / "map.cells")
    assert open_sweep(store)["status"].values[0, 0] == 1
    outcome = run_sweep(study, store, workers=0)
    assert (outcome.done, outcome.skipped) == (2, 1)
    xr.testing.assert_identical(open_sweep(store), whole)


@pytest.mark.skipif(not FULL.exists(), reason="this system has no file that is always full")
@pytest.mark.parametrize("name", ["map.json.part", ".study.json.part"])
def test_a_disk_without_room_for_a_description_is_named(study, whole, tmp_path, name):
    store = tmp_path / "s"
    store.mkdir()
    (store / ".sweep.lock").touch()
    (store / name).symlink_to(FULL)
    with pytest.raises(OSError, match=r"No space left .* the same call continues") as raised:
        run_sweep(study, store, workers=0)
    assert raised.value.errno == errno.ENOSPC
    assert name.removesuffix(".part") in str(raised.value)
    (store / name).unlink()
    assert run_sweep(study, store, workers=0).done == 3
    xr.testing.assert_identical(open_sweep(store), whole)


def test_of_a_record_that_does_not_fit_nothing_is_left(study, known, path, monkeypatch):
    """A disk that is full takes a part of a record."""
    before = (path / "map.cells").read_bytes()
    real = Path.open

    class Short:
        def __init__(self, file):
            self.file, self.tell, self.truncate = file, file.tell, file.truncate

        def __enter__(self):
            return self

        def __exit__(self, *fault):
            self.file.close()

        def write(self, content):
            if self.file.tell() > len(before):
                raise OSError(errno.ENOSPC, "No space left on device")
            return self.file.write(content[:10])

    def open_short(self, mode="r", *rest, **more):
        file = real(self, mode, *rest, **more)
        return Short(file) if mode == "ab" else file

    first = next(study.cells())
    with Store(path, study) as store:
        monkeypatch.setattr(Path, "open", open_short)
        with pytest.raises(OSError, match="No space left"):
            store.write(first, known[first.identity])
    monkeypatch.undo()
    assert (path / "map.cells").read_bytes() == before


def test_two_runs_into_one_store_are_refused(study, tmp_path):
    def second(so_far: int, total: int) -> None:
        with pytest.raises(Busy, match="another run is writing"):
            run_sweep(study, tmp_path / "s", workers=0)

    run_sweep(study, tmp_path / "s", workers=0, progress=second)


def test_where_there_is_no_fcntl_the_other_lock_is_used(study, tmp_path, monkeypatch):
    asked = []

    def locking(file: int, mode: int, count: int) -> None:
        asked.append((mode, count))
        if len(asked) > 1:
            raise PermissionError(errno.EACCES, "locked")

    monkeypatch.setattr("vibrissa.io.paths.sys", SimpleNamespace(platform="win32"))
    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_NBLCK=2))
    monkeypatch.setitem(sys.modules, "fcntl", None)
    with Store(tmp_path / "s", study), pytest.raises(Busy), Store(tmp_path / "s", study):
        pass
    assert asked == [(2, 1), (2, 1)]


def test_a_store_of_another_study_is_refused(study, path, whole):
    other = read_study(TEXT.replace("30]", "31]"), Path())
    with pytest.raises(ValueError, match=r"a study with other whiskers: give another store"):
        run_sweep(other, path, workers=0)
    with pytest.raises(ValueError, match="other seed"):
        run_sweep(read_study("seed = 3\n" + TEXT, Path()), path, workers=0)
    xr.testing.assert_identical(open_sweep(path), whole)


def test_a_store_of_another_version_is_refused_or_keeps_what_is_whose(
    study, known, tmp_path, monkeypatch
):
    path = tmp_path / "s"
    first = next(study.cells())
    with Store(path, study) as store:
        store.write(first, known[first.identity])
    libraries = "vibrissa 0.1 (sources 1), numpy 2, scipy 1"
    monkeypatch.setattr("vibrissa.sweeps.store.origin", lambda: libraries)
    with pytest.raises(ValueError, match=r"this is vibrissa 0\.1 \(sources 1\), .*--any-version"):
        run_sweep(study, path, workers=0)
    outcome = run_sweep(study, path, workers=0, any_version=True)
    assert (outcome.done, outcome.skipped) == (2, 1)
    found = open_sweep(path)
    assert list(found["origin"].values[:, 0]) == [0, 1, 1]
    assert found.attrs["origins"][1] == libraries
    assert f"2 cells by {libraries}" in "\n".join(sweep_summary(found))
    # Other libraries are not another version: it is kept, not refused.
    monkeypatch.setattr("vibrissa.sweeps.store.origin", lambda: libraries + "1")
    assert run_sweep(study, path, workers=0).skipped == 3
    assert len(open_sweep(path).attrs["origins"]) == 3


def test_all_that_computes_is_part_of_the_origin():
    grimp = pytest.importorskip("grimp", reason="grimp (of import-linter) is not installed")
    import vibrissa
    from vibrissa.sweeps.store import computing_sources

    root = Path(vibrissa.__file__).parent
    known = {path.relative_to(root).with_suffix("").as_posix() for path in computing_sources()}
    known = {name.removesuffix("/__init__").replace("/", ".") for name in known}
    graph = grimp.build_graph("vibrissa", exclude_type_checking_imports=True)
    below = {"vibrissa.sweeps.study"} | graph.find_upstream_modules("vibrissa.sweeps.study")
    needed = {name.removeprefix("vibrissa.") for name in below} - {"vibrissa", "sweeps"}
    assert "rod.kernels" in known
    assert needed <= known
    assert not {name.partition(".")[0] for name in known} & {"cli", "viewer", "plots", "report"}


def test_what_is_not_a_store_is_left_alone(study, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match="not a store"):
        run_sweep(study, tmp_path, workers=0)
    with pytest.raises(ValueError, match="is a file"):
        run_sweep(study, tmp_path / "mine.txt", workers=0)
    with pytest.raises(ValueError, match="not a store of a sweep"):
        open_sweep(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    (tmp_path / ".study.json").write_text('{"name": "of long ago", "layout": 1}')
    with pytest.raises(ValueError, match=r"has the layout of another version.*run the study again"):
        open_sweep(tmp_path)


def test_a_store_of_before_is_read_and_not_written_to(study, tmp_path):
    # Three cells of maps, one of which failed, and three of verdicts, as version 0.1.0 kept them
    # before one file held all cells of a task (commit 8748dad).
    data = Path(__file__).parents[1] / "data" / "old_study.zip"
    shutil.unpack_archive(data, tmp_path / "old")
    found = open_sweep(tmp_path / "old")
    assert found["status"].values.tolist() == [[1, 1], [1, 1], [2, 1]]
    np.testing.assert_allclose(found["map_slip_force"], [1e-4, 2e-4, np.nan], rtol=1e-15)
    np.testing.assert_allclose(found["map_r_largest"][1], [0.02, 0.04], rtol=1e-15)
    assert found["uniqueness_verdict"].values[:, 1].tolist() == [
        "unique",
        "unique off a surface",
        "not unique",
    ]
    np.testing.assert_allclose(found["taper_ratio"], [5.0, 15.0, 30.0])
    assert "broken" in failures(tmp_path / "old")["map-2"]
    with pytest.raises(ValueError, match="sweep show"):
        run_sweep(study, tmp_path / "old", workers=0)


def test_a_result_of_another_shape_is_a_failure_until_it_is_done(
    study, known, tmp_path, monkeypatch
):
    def shorter_for_the_second(cell):
        found = known[cell.identity]
        cut = found["result"].isel(station=slice(5)) if cell.index == 1 else found["result"]
        return {**found, "result": cut}

    with monkeypatch.context() as patch:
        patch.setattr("vibrissa.sweeps.run.answer", shorter_for_the_second)
        outcome = run_sweep(study, tmp_path / "s", workers=0)
    assert (outcome.done, outcome.failed) == (3, 1)
    assert "that of other whiskers" in failures(tmp_path / "s")["map-1"]
    assert list(open_sweep(tmp_path / "s")["status"].values[:, 0]) == [1, 2, 1]
    assert run_sweep(study, tmp_path / "s", workers=0, again=True).failed == 0
    assert failures(tmp_path / "s") == {}
    assert list(open_sweep(tmp_path / "s")["status"].values[:, 0]) == [1, 1, 1]
