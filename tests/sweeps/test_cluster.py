"""Studies on a Dask cluster: the same results, whatever dies."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import xarray as xr

from vibrissa.sweeps import Study, failures, open_sweep, read_study, run_sweep
from vibrissa.sweeps.study import Specimen

TEXT = """
[[whiskers]]
taper_ratio = [5, 15]
curvature = 0.4
[[tasks]]
kind = "map"
"""


@pytest.fixture(autouse=True, scope="module")
def dask():
    pytest.importorskip("distributed", reason="dask[distributed] (extra cluster) is not installed")
    return pytest.importorskip("dask")


@pytest.fixture
def study() -> Study:
    return read_study(TEXT, Path())


@pytest.fixture
def scheduler(tmp_path):
    """A scheduler and a worker of their own, found by the address in a file."""
    address = tmp_path / "scheduler.json"
    common = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    head = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "distributed.cli.dask_scheduler",
            "--port",
            "0",
            "--no-dashboard",
            "--host",
            "127.0.0.1",
            "--scheduler-file",
            str(address),
        ],
        **common,
    )
    hand = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "distributed.cli.dask_worker",
            "--scheduler-file",
            str(address),
            "--nthreads",
            "1",
            "--no-dashboard",
            "--no-nanny",
            "--death-timeout",
            "60",
        ],
        **common,
    )
    try:
        end = time.monotonic() + 60.0
        while not address.exists():
            assert time.monotonic() < end, "the scheduler does not start"
            time.sleep(0.05)
        yield json.loads(address.read_text())["address"], head
    finally:
        for process in (hand, head):
            process.kill()
            process.wait()


@pytest.mark.slow
def test_a_local_cluster_gives_the_same_and_a_cell_that_kills_fails_alone(study, tmp_path, dask):
    run_sweep(study, tmp_path / "here", workers=0)
    bad = Specimen("bad", {}, "bad", partial(signal.raise_signal, signal.SIGKILL))
    spoilt = Study("spoilt", 0, (*study.specimens, bad), study.tasks)
    # By default Dask gives a cell to four workers, one after the other, before it gives up.
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}):
        outcome = run_sweep(spoilt, tmp_path / "there", workers=1, scheduler="local")
    assert (outcome.done, outcome.failed) == (3, 1)
    assert "died" in failures(tmp_path / "there")["map-2"]
    found = open_sweep(tmp_path / "there").isel(whisker=slice(2)).drop_vars(["seconds", "whisker"])
    here = open_sweep(tmp_path / "here").drop_vars(["seconds", "whisker"])
    xr.testing.assert_identical(found.load().drop_attrs(), here.load().drop_attrs())


@pytest.mark.slow
def test_a_scheduler_that_is_killed_ends_the_run_and_the_next_goes_on(
    study, scheduler, tmp_path, monkeypatch
):
    address, head = scheduler
    with monkeypatch.context() as patch:
        patch.setenv("ORIGIN", "newer")
        patch.setattr("vibrissa.sweeps.run.origin", partial(os.getenv, "ORIGIN", "older"))
        with pytest.raises(ValueError, match="has older; newer is needed"):
            run_sweep(study, tmp_path / "other", scheduler=address)

    def kill(done: int, total: int) -> None:
        if done == 1:
            head.kill()

    slow = Specimen("slow", {}, "slow", partial(time.sleep, 600))
    longer = Study("longer", 0, (study.specimens[0], slow), study.tasks)
    with pytest.raises(ValueError, match="is gone"):
        run_sweep(longer, tmp_path / "s", scheduler=address, progress=kill)
    assert list(open_sweep(tmp_path / "s")["status"].values[:, 0]) == [1, 0]
    # The same whisker, made sooner.
    quicker = replace(slow, make=study.specimens[1].make)
    resumed = Study("longer", 0, (study.specimens[0], quicker), study.tasks)
    outcome = run_sweep(resumed, tmp_path / "s", workers=0)
    assert (outcome.done, outcome.failed, outcome.skipped) == (1, 0, 1)
    assert list(open_sweep(tmp_path / "s")["status"].values[:, 0]) == [1, 1]


def test_no_scheduler_is_told(study, tmp_path, monkeypatch):
    monkeypatch.setattr("vibrissa.sweeps.run._PATIENCE", 0.2)
    with pytest.raises(ValueError, match=r"no Dask scheduler at tcp://127\.0\.0\.1:9"):
        run_sweep(study, tmp_path / "s", scheduler="tcp://127.0.0.1:9")
