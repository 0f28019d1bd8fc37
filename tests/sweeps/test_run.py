"""Studies that are done: anywhere the same, whatever dies."""

import errno
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

pytest.importorskip("zarr", reason="zarr (extra sweeps) is not installed")

from vibrissa import Whisker
from vibrissa.sweeps import Busy, Study, failures, open_sweep, read_study, run_sweep
from vibrissa.sweeps import tasks as tasks_module
from vibrissa.sweeps.population import Specimen

QUICK = """
name = "quick"
[[whiskers]]
taper_ratio = [5, 15, 30]
curvature = 0.4
[[tasks]]
kind = "map"
"""


@pytest.fixture(scope="module")
def quick() -> Study:
    return read_study(QUICK, Path())


@pytest.fixture
def spoilt(quick):
    """The quick study with one more whisker, which a function makes, in second place."""

    def spoil(make, *arguments) -> Study:
        bad = Specimen("bad", {}, "bad", partial(make, *arguments))
        first, second, third = quick.specimens
        return Study("spoilt", 0, (first, bad, second, third), quick.tasks)

    return spoil


@pytest.fixture(scope="module")
def done(quick, tmp_path_factory):
    """The quick study, done in this process."""
    path = tmp_path_factory.mktemp("done") / "store.zarr"
    run_sweep(quick, path, workers=0)
    return results(path)


def results(path) -> xr.Dataset:
    """All that is found, but how long it took."""
    return open_sweep(path).drop_vars("seconds").load()


def without_bad(path) -> xr.Dataset:
    found = results(path)
    return found.sel(whisker=found["whisker"] != "bad")


def same_but_widths(first, second):
    """Identical to the bit; names may be stored in wider fields."""
    names = [list(map(str, one["whisker"].values)) for one in (first, second)]
    assert names[0] == names[1]
    xr.testing.assert_identical(
        first.drop_vars("whisker").drop_attrs(deep=False),
        second.drop_vars("whisker").drop_attrs(deep=False),
    )


def test_results_are_one_labelled_dataset(done):
    assert (done["status"] == 1).all()
    assert list(done["taper_ratio"].values) == pytest.approx([5, 15, 30])
    assert done["map_slip_force"].dims == ("whisker", "station")
    assert done["map_slip_force"].attrs["units"] == "N"
    # A whisker that tapers more is more slender where it is touched, and slips off sooner.
    assert (done["map_slip_force"].isel(station=-2).diff("whisker") < 0).all()


def test_processes_give_the_same_to_the_bit(quick, done, tmp_path, monkeypatch):
    # One process after the other, as in a large study.
    monkeypatch.setattr("vibrissa.sweeps.workers._LIFE", 1)
    told = []
    outcome = run_sweep(
        quick, tmp_path / "s", workers=2, progress=lambda *so_far: told.append(so_far)
    )
    assert (outcome.done, outcome.failed, outcome.skipped) == (3, 0, 0)
    assert told == [(0, 3), (1, 3), (2, 3), (3, 3)]
    xr.testing.assert_identical(results(tmp_path / "s"), done)
    assert not multiprocessing.active_children()


def test_what_is_done_is_not_done_again(quick, tmp_path):
    run_sweep(quick, tmp_path / "s", workers=0)
    before = {path: path.stat().st_mtime_ns for path in files(tmp_path / "s")}
    outcome = run_sweep(quick, tmp_path / "s", workers=0)
    assert (outcome.done, outcome.skipped) == (0, 3)
    assert {path: path.stat().st_mtime_ns for path in files(tmp_path / "s")} == before


def files(path: Path) -> list[Path]:
    return sorted(one for one in path.rglob("*") if one.is_file() and one.name != ".sweep.lock")


def test_a_cell_that_fails_is_recorded_and_the_rest_goes_on(spoilt, done, tmp_path):
    study = spoilt(Whisker.straight, -1.0)
    outcome = run_sweep(study, tmp_path / "s", workers=0)
    assert (outcome.done, outcome.failed) == (4, 1)
    assert list(open_sweep(tmp_path / "s")["status"].values[:, 0]) == [1, 2, 1, 1]
    (said,) = failures(tmp_path / "s").values()
    assert said.startswith("bad\nTraceback")
    assert "ValueError" in said
    same_but_widths(without_bad(tmp_path / "s"), done)
    again = run_sweep(study, tmp_path / "s", workers=0)
    assert (again.done, again.skipped, again.failed_before) == (0, 4, 1)
    again = run_sweep(study, tmp_path / "s", workers=0, again=True)
    assert (again.done, again.failed, again.skipped) == (1, 1, 3)


def test_a_cell_that_kills_its_process_fails_alone(spoilt, done, tmp_path):
    study = spoilt(signal.raise_signal, signal.SIGKILL)
    outcome = run_sweep(study, tmp_path / "s", workers=1)
    assert (outcome.done, outcome.failed) == (4, 1)
    assert "died" in failures(tmp_path / "s")["map-1"]
    same_but_widths(without_bad(tmp_path / "s"), done)


def test_a_worker_that_somebody_kills_costs_no_cell(quick, done, tmp_path):
    def kill_one(so_far: int, total: int) -> None:
        if so_far == 1:
            os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)

    outcome = run_sweep(quick, tmp_path / "s", workers=1, progress=kill_one)
    assert (outcome.done, outcome.failed) == (3, 0)
    xr.testing.assert_identical(results(tmp_path / "s"), done)


RUN = """
import sys
from pathlib import Path
from vibrissa.sweeps import read_study, run_sweep
if __name__ == "__main__":
    run_sweep(read_study(Path(sys.argv[1]).read_text(), Path()), sys.argv[2], workers=1,
        progress=lambda done, total: print(done, flush=True))
"""


def test_a_client_that_is_killed_leaves_a_store_that_is_gone_on_with(quick, done, tmp_path):
    (tmp_path / "run.py").write_text(RUN)
    (tmp_path / "study.toml").write_text(QUICK)
    store = tmp_path / "s"
    client = subprocess.Popen(
        [sys.executable, tmp_path / "run.py", tmp_path / "study.toml", store],
        stdout=subprocess.PIPE,
        text=True,
    )
    with client:
        assert client.stdout is not None
        while client.stdout.readline().strip() != "1":
            assert client.poll() is None
        workers = children(client.pid)
        client.kill()
    assert len(workers) >= 1
    end = time.monotonic() + 60.0
    while any(alive(pid) for pid in workers):
        assert time.monotonic() < end, "workers outlive their client"
        time.sleep(0.05)
    kept = {path: path.stat().st_mtime_ns for path in files(store)}
    before = int((open_sweep(store)["status"] == 1).sum())
    assert before >= 1
    outcome = run_sweep(quick, store, workers=0)
    assert (outcome.done, outcome.skipped) == (3 - before, before)
    xr.testing.assert_identical(results(store), done)
    # Identities and all else of cells that were there are the same files.
    whole = [path for path in kept if path.parent.name == "identity"]
    assert all(path.stat().st_mtime_ns == kept[path] for path in whole)


def children(pid: int) -> list[int]:
    listed = Path(f"/proc/{pid}/task/{pid}/children")
    if not listed.exists():
        pytest.skip("this system does not list the children of a process")
    return [int(one) for one in listed.read_text().split()]


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("place", ["map/slip_force/1.0", "whiskers/length/1", "cells/status/1.0"])
def test_a_full_disk_is_told_and_the_run_can_go_on(quick, done, tmp_path, monkeypatch, place):
    from zarr.storage import LocalStore

    real = LocalStore.set

    async def full(self, key, value):
        if place.split("/", 1)[1] in f"{self.root.name}/{key}":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return await real(self, key, value)

    with monkeypatch.context() as patch:
        patch.setattr(LocalStore, "set", full)
        with pytest.raises(OSError, match=r"No space left .* the same call goes on") as raised:
            run_sweep(quick, tmp_path / "s", workers=0)
    assert raised.value.errno == errno.ENOSPC
    assert results(tmp_path / "s")["status"].values[0, 0] == 1
    outcome = run_sweep(quick, tmp_path / "s", workers=0)
    assert (outcome.done, outcome.skipped) == (2, 1)
    xr.testing.assert_identical(results(tmp_path / "s"), done)


def test_two_runs_into_one_store_are_refused(quick, tmp_path):
    def second(so_far: int, total: int) -> None:
        with pytest.raises(Busy, match="another run is writing"):
            run_sweep(quick, tmp_path / "s", workers=0)

    run_sweep(quick, tmp_path / "s", workers=0, progress=second)


def test_a_store_of_another_study_is_refused(quick, spoilt, tmp_path):
    run_sweep(quick, tmp_path / "s", workers=0)
    before = results(tmp_path / "s")
    other = read_study(QUICK.replace("30]", "31]"), Path())
    with pytest.raises(ValueError, match=r"a study with other whiskers: give another store"):
        run_sweep(other, tmp_path / "s", workers=0)
    with pytest.raises(ValueError, match="other seed"):
        run_sweep(read_study("seed = 3\n" + QUICK, Path()), tmp_path / "s", workers=0)
    xr.testing.assert_identical(results(tmp_path / "s"), before)


def test_what_is_no_store_is_left_alone(quick, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match="no store"):
        run_sweep(quick, tmp_path, workers=0)
    with pytest.raises(ValueError, match="is a file"):
        run_sweep(quick, tmp_path / "mine.txt", workers=0)
    with pytest.raises(ValueError, match="no store of a sweep"):
        open_sweep(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_result_of_another_shape_is_a_failure(quick, tmp_path, monkeypatch):
    real = tasks_module.TASKS["map"].run

    def shorter_for_the_second(whisker, settings, seed):
        found = real(whisker, settings, seed)
        ratio = whisker.base_radius / whisker.tip_radius
        return found.isel(station=slice(5)) if 10 < ratio < 20 else found

    changed = tasks_module.Task(
        shorter_for_the_second, {}, lambda settings: None, lambda settings: 0.1, 19
    )
    monkeypatch.setattr("vibrissa.sweeps.study.TASKS", {**tasks_module.TASKS, "map": changed})
    outcome = run_sweep(quick, tmp_path / "s", workers=0)
    assert (outcome.done, outcome.failed) == (3, 1)
    assert "that of other whiskers" in failures(tmp_path / "s")["map-1"]


def test_tasks_with_other_triplets_keep_their_own(tmp_path):
    text = QUICK.replace("[5, 15, 30]", "[15]").replace(
        'kind = "map"',
        """kind = "uniqueness"
triplets = ["Fx MB MD"]
samples = 64
resolution = false
[[tasks]]
kind = "uniqueness"
name = "others"
triplets = ["Fx FT FD", "Mx MB MD"]
samples = 64
resolution = false
""",
    )
    study = read_study(text, Path())
    run_sweep(study, tmp_path / "s", workers=0)
    found = open_sweep(tmp_path / "s")
    assert list(found["triplet"].values) == ["Fx MB MD"]
    assert list(found["others_triplet"].values) == ["Fx FT FD", "Mx MB MD"]
    verdicts = {"unique", "unique off a surface", "not unique"}
    for name in ("uniqueness_verdict", "others_verdict"):
        assert set(found[name].values.ravel()) <= verdicts


def test_words_not_known_yet_are_empty(tmp_path):
    text = QUICK.replace("[5, 15, 30]", "[15]").replace(
        'kind = "map"',
        'kind = "uniqueness"\ntriplets = ["Fx MB MD"]\nsamples = 64\nresolution = false',
    )
    good = read_study(text, Path())
    bad = Specimen("bad", {}, "bad", partial(Whisker.straight, -1.0))
    study = Study("two", 0, (*good.specimens, bad), good.tasks)
    run_sweep(study, tmp_path / "s", workers=0)
    first, second = open_sweep(tmp_path / "s")["uniqueness_verdict"].values.ravel()
    assert first
    assert second == ""
    assert np.isnan(open_sweep(tmp_path / "s")["length"].values[1])
