"""Studies that are done: anywhere the same, whatever dies."""

import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import weakref
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from vibrissa import Whisker
from vibrissa.certificates import load_certificate
from vibrissa.sweeps import Study, failures, open_sweep, read_study, run_sweep
from vibrissa.sweeps.study import Specimen, answer
from vibrissa.sweeps.tasks import TASKS

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
    assert numbers(done, "map") == 3 * TASKS["map"].numbers({})


def numbers(found: xr.Dataset, task: str) -> int:
    return sum(found[name].size for name in found if str(name).startswith(f"{task}_"))


@pytest.mark.slow
def test_processes_give_the_same_to_the_bit_whatever_kills_them(spoilt, done, tmp_path):
    # One whisker kills its process, and somebody kills another.
    told = []

    def kill_one(*so_far: int) -> None:
        told.append(so_far)
        if so_far[0] == 1:
            os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)

    study = spoilt(signal.raise_signal, signal.SIGKILL)
    outcome = run_sweep(study, tmp_path / "s", workers=2, progress=kill_one)
    assert (outcome.done, outcome.failed, outcome.skipped) == (4, 1, 0)
    assert told == [(k, 4) for k in range(5)]
    (said,) = failures(tmp_path / "s").values()
    assert said.startswith("bad\nthe process that worked on this cell died")
    same_but_widths(without_bad(tmp_path / "s"), done)
    assert not multiprocessing.active_children()


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


RUN = """
import sys
from pathlib import Path
from vibrissa.sweeps import read_study, run_sweep
if __name__ == "__main__":
    run_sweep(read_study(Path(sys.argv[1]).read_text(), Path()), sys.argv[2], workers=1,
        progress=lambda done, total: print(done, flush=True))
"""


@pytest.mark.slow
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
        workers = offspring(client.pid)
        client.kill()
    assert len(workers) >= 2
    end = time.monotonic() + 60.0
    while any(alive(pid) for pid in workers):
        assert time.monotonic() < end, "workers outlive their client"
        time.sleep(0.05)
    found = open_sweep(store).load()
    kept = (found["status"] == 1).values[:, 0]
    assert kept.any()
    outcome = run_sweep(quick, store, workers=0)
    assert (outcome.done, outcome.skipped) == ((~kept).sum(), kept.sum())
    xr.testing.assert_identical(results(store), done)
    # How long a cell took is never the same twice: those that were there are still the same.
    seconds = open_sweep(store)["seconds"].values
    assert (seconds[kept] == found["seconds"].values[kept]).all()


def offspring(pid: int) -> list[int]:
    listed = Path(f"/proc/{pid}/task/{pid}/children")
    if not listed.exists():
        pytest.skip("this system does not list the children of a process")
    found = [int(one) for one in listed.read_text().split()]
    return found + [one for child in found for one in offspring(child)]


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.slow
def test_tasks_with_other_triplets_keep_their_own_and_words_not_known_yet_are_empty(tmp_path):
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
    good = read_study(text, Path())
    bad = Specimen("bad", {}, "bad", partial(Whisker.straight, -1.0))
    run_sweep(Study("two", 0, (*good.specimens, bad), good.tasks), tmp_path / "s", workers=0)
    found = open_sweep(tmp_path / "s")
    assert list(found["triplet"].values) == ["Fx MB MD"]
    assert list(found["others_triplet"].values) == ["Fx FT FD", "Mx MB MD"]
    verdicts = {"unique", "unique off a surface", "not unique"}
    for name in ("uniqueness_verdict", "others_verdict"):
        known, failed = found[name].values
        assert set(known.ravel()) <= verdicts
        assert set(failed.ravel()) == {""}
    assert list(np.isnan(found["length"].values)) == [False, True]
    kind, settings = good.tasks["others"]
    assert numbers(found, "others") == 2 * TASKS[kind].numbers(settings)


@pytest.mark.slow
def test_certificates_are_tasks_that_go_on_from_their_files(tmp_path):
    text = QUICK.replace("[5, 15, 30]", "[1, 15]").replace("curvature = 0.4", "curvature = 0.0")
    settings = f'kind = "certificate"\nfolder = "{(tmp_path / "kept").as_posix()}"'
    study = read_study(text.replace('kind = "map"', settings), Path())
    run_sweep(study, tmp_path / "s", workers=0)
    found = open_sweep(tmp_path / "s")
    assert list(found["certificate_proof"].values) == ["", "proved"]
    assert found["certificate_share"].values[1] == 1.0
    (failure,) = failures(tmp_path / "s").values()
    assert "no cone" in failure
    (path,) = (tmp_path / "kept").iterdir()
    assert load_certificate(path).proved
    again = read_study(text.replace('kind = "map"', settings + "\nminutes = 0"), Path())
    result = answer(list(again.cells())[1])["result"]
    assert int(result["proof"]) == 0


@pytest.mark.parametrize(
    "task",
    [
        'kind = "map"',
        'kind = "estimation"\nsignals = ["Fx MB MD", "Fx FT FD MB", "wrench"]\ncontacts = 20',
        *(
            pytest.param(task, marks=pytest.mark.slow)
            for task in (
                'kind = "certificate"\nminutes = 0',
                'kind = "uniqueness"\ntriplets = ["Fx MB MD"]\nsamples = 16',
                'kind = "sensitivity"\ntriplets = ["Fx MB MD"]',
                'kind = "friction"\ncontacts = 20',
            )
        ),
    ],
)
def test_nothing_is_kept_of_a_whisker_that_is_done(task):
    study = read_study(QUICK.replace('kind = "map"', task).replace("[5, 15, 30]", "[15]"), Path())
    (cell,) = study.cells()
    made = []

    def make():
        whisker = cell.specimen.make()
        made.append(weakref.ref(whisker))
        return whisker

    found = answer(replace(cell, specimen=replace(cell.specimen, make=make)))
    assert "result" in found
    gc.collect()
    assert made[0]() is None
