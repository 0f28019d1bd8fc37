"""The store of a study: whole whenever a run ends, and nobody else's."""

import errno
import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

pytest.importorskip("zarr", reason="zarr (extra sweeps) is not installed")

import zarr

from vibrissa.sweeps import Busy, Store, failures, open_sweep, read_study, run_sweep
from vibrissa.sweeps import sweep_summary as summary
from vibrissa.sweeps.rows import Rows
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
    monkeypatch.setattr(
        "vibrissa.sweeps.run.answer", lambda cell: known[cell.identity], raising=True
    )


@pytest.fixture
def path(study, tmp_path):
    """A store with all that there is."""
    run_sweep(study, tmp_path / "s", workers=0)
    return tmp_path / "s"


@pytest.fixture(scope="module")
def whole(study, known, tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "s"
    with Store(path, study) as store:
        for cell in study.cells():
            assert store.write(cell, known[cell.identity])
    return open_sweep(path).load()


def test_any_zarr_library_opens_it(study, path, whole, known):
    found = xr.open_zarr(path / "map", chunks=None)
    expected = [one["result"]["slip_force"].values for one in known.values()]
    assert found["slip_force"].dims == ("whisker", "station")
    assert np.array_equal(found["slip_force"].values, expected)
    assert found["slip_force"].attrs["units"] == "N"
    tree = xr.open_datatree(path, engine="zarr")
    assert set(tree.children) == {"cells", "map", "whiskers"}
    # However many whiskers, up to thousands: one file for all of them.
    assert sorted(one.name for one in (path / "map" / "r_largest").iterdir()) == [
        ".zarray",
        ".zattrs",
        "0",
    ]


def test_rows_stand_where_zarr_looks_for_them(tmp_path, monkeypatch):
    import zarr

    from vibrissa.sweeps.rows import make_rows

    monkeypatch.setattr("vibrissa.sweeps.rows.WHISKERS", 3)
    group = zarr.open_group(tmp_path, mode="w", zarr_format=2)
    make_rows(group, "values", (8, 2, 5), "float64", np.nan, ["whisker", "a", "b"])
    make_rows(group, "codes", (8, 4), "int8", -1, ["whisker", "task"])
    values, codes = np.full((8, 2, 5), np.nan), np.full((8, 4), -1)
    generator = np.random.default_rng(0)
    for index in (7, 0, 4):
        values[index] = generator.normal(size=(2, 5))
        Rows(tmp_path / "values").write(values[index], index)
    for index, column in ((6, 3), (6, 0), (1, 2)):
        codes[index, column] = generator.integers(100)
        Rows(tmp_path / "codes").write(codes[index, column], index, column)
    np.testing.assert_array_equal(group["values"][...], values)
    np.testing.assert_array_equal(group["codes"][...], codes)


def test_what_is_done_is_not_done_again(study, path, whole):
    rows = [one for one in path.rglob("[0-9]*") if one.is_file()]
    before = [one.stat().st_mtime_ns for one in rows]
    outcome = run_sweep(study, path, workers=0)
    assert (outcome.done, outcome.skipped) == (0, 3)
    assert [one.stat().st_mtime_ns for one in rows] == before
    xr.testing.assert_identical(open_sweep(path).load(), whole)


class Killed(BaseException):
    """Here a process ends, and runs nothing more."""


def test_a_run_that_is_killed_at_any_write_loses_and_spoils_nothing(
    study, known, whole, tmp_path, monkeypatch
):
    write = Rows.write
    left = 0

    def killed_while_it_writes(self, values, index, column=0):
        nonlocal left
        left -= 1
        if left < 0:
            half = np.atleast_1d(values)
            # A number or a hash of which half is there.
            garbage = half[0][:8] if half.dtype.kind == "S" else np.resize(1e9, half.shape)
            if half.dtype.kind != "i":
                write(self, garbage, index, column)
            raise Killed
        write(self, values, index, column)

    writes = 2 + 6 + 5
    monkeypatch.setattr(Rows, "write", killed_while_it_writes)
    for last in range(writes):
        left = last
        with pytest.raises(Killed):
            run_sweep(study, tmp_path / "s", workers=0)
        found = open_sweep(tmp_path / "s").load()
        assert not (found["status"] > 0).any()
        if "map_slip_force" in found:
            assert np.isnan(found["map_slip_force"]).all()
    left = writes
    with pytest.raises(Killed):
        run_sweep(study, tmp_path / "s", workers=0)
    found = open_sweep(tmp_path / "s").load()
    assert list(found["status"].values[:, 0]) == [1, 0, 0]
    left = sys.maxsize
    outcome = run_sweep(study, tmp_path / "s", workers=0)
    assert (outcome.done, outcome.skipped) == (2, 1)
    xr.testing.assert_identical(open_sweep(tmp_path / "s").load(), whole)


@pytest.mark.parametrize("name", ["whiskers", "cells", ".study.json", "map"])
def test_a_run_that_is_killed_while_it_lays_out_is_begun_anew(
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
    xr.testing.assert_identical(open_sweep(tmp_path / "s").load(), whole)
    assert not list((tmp_path / "s").glob(".new*"))


def cut(file):
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def overwrite(file):
    content = bytearray(file.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 4] = bytes(byte ^ 0x55 for byte in content[middle : middle + 4])
    file.write_bytes(content)


@pytest.mark.parametrize("damage", [cut, overwrite, Path.unlink])
def test_whatever_is_damaged_is_noticed_and_done_again(study, path, whole, tmp_path, damage):
    """Files of every kind in turn; those at the root, for other libraries, are renewed."""
    files = [one.relative_to(path) for one in path.rglob("*") if one.is_file()]
    for others in (".zmetadata", ".zgroup", ".zattrs", ".sweep.lock"):
        files.remove(Path(others))
    assert len(files) > 30
    coordinates = {"whisker", "group", "task", "station"}
    kind = (cut, overwrite, Path.unlink).index(damage)
    for number, file in enumerate(sorted(files)[kind::3]):  # one after the other of an array
        store = tmp_path / f"{number}"
        shutil.copytree(path, store)
        damage(store / file)
        if not (store / file).exists() and file.name == ".study.json":
            assert run_sweep(study, store, workers=0).done == 3
            continue
        if file.name == ".study.json":
            with pytest.raises(ValueError, match=r"study\.json is damaged"):
                run_sweep(study, store, workers=0)
            continue
        if len(file.parts) < 3 or file.name.startswith(".") or file.parts[1] in coordinates:
            with pytest.raises(ValueError, match=f"{file.parts[0]} is damaged"):
                open_sweep(store)
        else:
            shown = open_sweep(store).load()
            damaged = shown["status"].values[:, 0] == 3
            assert damaged.any(), file
            assert np.isnan(shown["map_slip_force"].values[damaged]).all()
            assert "damaged (`vibrissa sweep` does them again)" in summary(shown)
        outcome = run_sweep(study, store, workers=0)
        assert outcome.done >= 1, file
        assert outcome.damaged or outcome.faults, file
        assert not list(store.glob(".new-*"))
        xr.testing.assert_identical(open_sweep(store).load(), whole)


def test_a_store_without_checksums_is_shown(path, whole):
    kept = json.loads((path / ".study.json").read_text())
    (path / ".study.json").write_text(json.dumps(kept | {"layout": 2}))
    group = zarr.open_group(path / "cells", mode="a", zarr_format=2)
    del group["checksum"]
    zarr.consolidate_metadata(path / "cells", zarr_format=2)
    xr.testing.assert_identical(open_sweep(path).load(), whole)


FULL = Path("/dev/full")


@pytest.mark.skipif(not FULL.exists(), reason="this system has no file that is always full")
@pytest.mark.parametrize("place", ["map/slip_force/0.0", "whiskers/length/0", "cells/status/0.0"])
def test_a_full_disk_is_told_and_the_run_can_go_on(study, whole, tmp_path, place):
    store = tmp_path / "new"

    def fill(so_far: int, total: int) -> None:
        # Put back before anybody reads: what is read from it has no end.
        if so_far == 1:
            (store / place).rename(tmp_path / "aside")
            (store / place).symlink_to(FULL)

    with pytest.raises(OSError, match=r"No space left .* the same call goes on") as raised:
        run_sweep(study, store, workers=0, progress=fill)
    assert raised.value.errno == errno.ENOSPC
    (tmp_path / "aside").replace(store / place)
    assert open_sweep(store)["status"].values[0, 0] == 1
    outcome = run_sweep(study, store, workers=0)
    assert (outcome.done, outcome.skipped) == (2, 1)
    xr.testing.assert_identical(open_sweep(store).load(), whole)


@pytest.mark.skipif(not FULL.exists(), reason="this system has no file that is always full")
def test_a_disk_that_has_no_room_for_more_whiskers_is_told(study, known, path):
    chunk = path / "map" / "slip_force" / "0.0"
    chunk.unlink()
    chunk.with_name("0.0.part").symlink_to(FULL)
    first = next(study.cells())
    with Store(path, study) as store, pytest.raises(OSError, match="No space left"):
        store.write(first, known[first.identity])
    assert not chunk.exists()


def test_two_runs_into_one_store_are_refused(study, tmp_path):
    def second(so_far: int, total: int) -> None:
        with pytest.raises(Busy, match="another run is writing"):
            run_sweep(study, tmp_path / "s", workers=0)

    run_sweep(study, tmp_path / "s", workers=0, progress=second)


def test_where_there_is_no_fcntl_the_other_way_of_locking_is_taken(study, tmp_path, monkeypatch):
    asked = []

    def locking(file: int, mode: int, count: int) -> None:
        asked.append((mode, count))
        if len(asked) > 1:
            raise PermissionError(errno.EACCES, "locked")

    monkeypatch.setattr("vibrissa.sweeps.lock.sys", SimpleNamespace(platform="win32"))
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
    xr.testing.assert_identical(open_sweep(path).load(), whole)


def test_a_store_of_another_version_is_refused_or_says_what_is_whose(
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
    assert f"2 cells by {libraries}" in summary(found)
    # Other libraries are no other version: it is told, not refused.
    monkeypatch.setattr("vibrissa.sweeps.store.origin", lambda: libraries + "1")
    assert run_sweep(study, path, workers=0).skipped == 3
    assert len(open_sweep(path).attrs["origins"]) == 3


def test_all_that_computes_is_part_of_the_origin():
    grimp = pytest.importorskip("grimp", reason="grimp (of import-linter) is not installed")
    from vibrissa.sweeps.origin import COMPUTING

    known = tuple(name.removesuffix(".py").replace("/", ".") for name in COMPUTING)
    graph = grimp.build_graph("vibrissa")
    below = graph.find_upstream_modules("vibrissa.identifiability", as_package=True)
    below |= graph.find_upstream_modules("vibrissa.rod", as_package=True)
    names = {name.removeprefix("vibrissa.") for name in below} - {"vibrissa"}
    assert {name for name in names if not name.startswith(known)} == set()


def test_what_is_no_store_is_left_alone(study, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match="no store"):
        run_sweep(study, tmp_path, workers=0)
    with pytest.raises(ValueError, match="is a file"):
        run_sweep(study, tmp_path / "mine.txt", workers=0)
    with pytest.raises(ValueError, match="no store of a sweep"):
        open_sweep(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    (tmp_path / ".study.json").write_text('{"name": "of long ago"}')
    with pytest.raises(ValueError, match="laid out as another version"):
        open_sweep(tmp_path)


def test_a_result_of_another_shape_is_a_failure(study, known, tmp_path, monkeypatch):
    def shorter_for_the_second(cell):
        found = known[cell.identity]
        cut = found["result"].isel(station=slice(5)) if cell.index == 1 else found["result"]
        return {**found, "result": cut}

    monkeypatch.setattr("vibrissa.sweeps.run.answer", shorter_for_the_second)
    outcome = run_sweep(study, tmp_path / "s", workers=0)
    assert (outcome.done, outcome.failed) == (3, 1)
    assert "that of other whiskers" in failures(tmp_path / "s")["map-1"]
