"""Kernels compiled by two processes at the same time; and by one, where that cannot be."""

import os
import subprocess
import sys
import textwrap

import numba
import pytest

import vibrissa as vb
from vibrissa.rod import discretize, search

KERNELS = """
from vibrissa.numerics import kernel

@kernel
def twice(x):
    return 2.0 * x

@kernel
def thrice(x):
    return 3.0 * x

@kernel
def half_of(x):
    return 0.5 * x
"""


@pytest.fixture
def run(tmp_path):
    """Runs a script that compiles `twice` here and `thrice` in a helper; a line for each hit."""
    (tmp_path / "apart.py").write_text(KERNELS)
    (tmp_path / "kept").mkdir()

    def call(before="", after="", between="", **environment):
        script = f"""
            import sys
            sys.path.insert(0, {str(tmp_path)!r})
            from apart import half_of, thrice, twice
            from vibrissa.numerics import kernel_cache
            {before}
            kernel_cache.compile_together([(twice, (1.0,))], [(thrice, (1.0,))])
            {between}
            assert (twice(2.0), thrice(2.0)) == (4.0, 6.0)
            for kernel in (twice, thrice):
                print(kernel.py_func.__name__, sum(kernel.stats.cache_hits.values()))
            {after}
        """
        done = subprocess.run(
            [sys.executable, "-W", "error", "-c", textwrap.dedent(script)],
            capture_output=True,
            text=True,
            check=True,
            timeout=300,
            env=os.environ
            | {"NUMBA_CACHE_DIR": str(tmp_path / "kept"), "VIBRISSA_THREADS": "2"}
            | environment,
        )
        assert done.stderr == ""
        return done.stdout.split("\n")[:2]

    return call


def test_a_helper_compiles_what_is_found_on_disk_here(run):
    assert run() == ["twice 0", "thrice 1"]
    # Another process finds both, and asks nobody.
    nobody = "kernel_cache.subprocess.Popen = None"
    assert run(nobody) == ["twice 1", "thrice 1"]


def test_a_helper_is_waited_for_when_its_kernel_is_called(run):
    asked = "assert [key[1] for key in kernel_cache._asked] == ['thrice']"
    assert run(between=asked, after="assert not kernel_cache._asked") == ["twice 0", "thrice 1"]


def test_what_a_helper_was_asked_for_is_not_asked_for_again(run):
    """The rest is compiled meanwhile, not only when it is called."""
    again = """
            kernel_cache.subprocess.Popen = None
            half = [(half_of, (1.0,)), (thrice, (1.0,))]
            kernel_cache.compile_together(half, [(thrice, (1.0,))])
            assert half_of.overloads and not thrice.overloads
    """
    assert run(between=again.strip()) == ["twice 0", "thrice 1"]


@pytest.mark.parametrize(
    "why",
    [
        pytest.param("kernel_cache.threads = lambda: 1", id="one core"),
        pytest.param("sys.frozen = True", id="a frozen program", marks=pytest.mark.slow),
        pytest.param(
            "sys.executable = '/usr/bin/matlab'", id="embedded in a program", marks=pytest.mark.slow
        ),
        pytest.param("sys.executable = None", id="no executable", marks=pytest.mark.slow),
        pytest.param(
            "thrice.py_func.__module__ = '__main__'", id="not in a module", marks=pytest.mark.slow
        ),
    ],
)
def test_nobody_is_asked_where_that_gains_nothing(run, why):
    assert run(f"kernel_cache.subprocess.Popen = None; {why}") == ["twice 0", "thrice 0"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="the stand-ins for Python are shell scripts")
@pytest.mark.parametrize(
    "does",
    [
        "exit 3",
        "exec sleep 1000",
        "head -c 1; kill -9 $$",
    ],
)
def test_a_helper_that_fails_or_hangs_is_done_without(run, tmp_path, does):
    helper = tmp_path / "python"
    helper.write_text(f"#!/bin/sh\n{does}\n")
    helper.chmod(0o755)
    impatient = "kernel_cache._PATIENCE = kernel_cache._AT_LEAST = 0.01"
    assert run(f"sys.executable = {str(helper)!r}; {impatient}") == ["twice 0", "thrice 0"]


@pytest.mark.slow
def test_no_process_can_be_started(run, tmp_path):
    missing = str(tmp_path / "python-that-is-not-there")
    assert run(f"sys.executable = {missing!r}") == ["twice 0", "thrice 0"]


@pytest.mark.slow
def test_no_folder_can_be_written_to(run):
    """A helper could hand nothing over, and none is started."""
    nowhere = "; ".join(
        [
            "from numba.core.caching import NullCache",
            "thrice._cache = NullCache()",
            "kernel_cache.subprocess.Popen = None",
        ]
    )
    assert run(nowhere) == ["twice 0", "thrice 0"]


def test_the_search_is_compiled_ahead_for_the_types_of_its_callers(gamma):
    """Otherwise what the helper compiles would not be used."""
    vb.deflect(gamma, vb.PointContact([25e-3, 12e-3, 1e-3]))
    calls = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "compile_together", lambda here, there: calls.extend(here + there))
        patch.setattr(search.seeds, "overloads", {}, raising=False)
        search.compile_seeds(discretize(gamma).rod)
    assert calls[-1][0] is search.seeds
    for kernel, arguments in calls:
        assert tuple(map(numba.typeof, arguments)) in kernel.overloads
    assert len(search.seeds.overloads) == 1
