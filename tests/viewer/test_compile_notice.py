"""What is compiled ahead, and what is said meanwhile."""

import threading
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="viser is not installed", exc_type=ImportError)

from vibrissa.viewer import server
from vibrissa.viewer.server import CompileNotice


def compiling(module):
    """An event as Numba has it when it compiles a function of a module."""
    function = SimpleNamespace(__module__=module)
    return SimpleNamespace(data={"dispatcher": SimpleNamespace(py_func=function)})


@pytest.fixture
def ahead(monkeypatch):
    """One that has not yet warmed up, and what it has reports."""
    monkeypatch.setattr(server, "_done", threading.Event())
    reports = []
    made = CompileNotice(reports.append)
    yield made, reports
    made.close()


def test_only_our_kernels_are_told_of_once_however_they_nest(ahead):
    made, reports = ahead
    made.on_start(compiling("numpy.linalg"))
    assert reports == []
    made.on_start(compiling("vibrissa.rod.kernels"))
    made.on_start(compiling("vibrissa.rod.points"))
    made.on_end(compiling("vibrissa.rod.points"))
    assert reports == [True]
    made.on_end(compiling("vibrissa.rod.kernels"))
    assert reports == [True, False]


def test_it_is_over_when_all_jobs_are_and_not_between_them(ahead):
    made, reports = ahead
    seen = []

    def job():
        made.on_start(compiling("vibrissa.rod.kernels"))
        made.on_end(compiling("vibrissa.rod.kernels"))
        seen.append(list(reports))

    made.start([job, job])
    assert server._done.wait(10.0)
    for thread in threading.enumerate():
        if thread.name == "warming":
            thread.join(10.0)
    assert seen == [[True], [True]]
    assert reports == [True, False]
    made.start([lambda: seen.append("again")])  # kernels stay
    assert len(seen) == 2


def test_a_job_that_fails_ends_the_matter(ahead):
    made, reports = ahead
    made.start([lambda: 1 / 0, lambda: reports.append("never")])
    for thread in threading.enumerate():
        if thread.name == "warming":
            thread.join(10.0)
    assert reports == []
    assert not server._done.is_set()
