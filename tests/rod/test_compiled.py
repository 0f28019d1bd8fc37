"""Compiling: said once, cached where possible, done without a cache where not."""

import os
import subprocess
import sys
import textwrap
from types import SimpleNamespace

import numpy as np
import pytest

from vibrissa.contacts.engine.ranking import judge_rows
from vibrissa.numerics import copy, kernel_cache, order_of
from vibrissa.rod.integration import integrate


def run(code, **environment):
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(code)],
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
        env=environment or None,
    )


def run_here(code):
    exec(textwrap.dedent(code), {"__name__": "made_up"})


def test_the_first_compilation_says_what_it_is_doing_once():
    """A kernel that is in nobody's cache, made in a module of the package's name; of no others."""
    said = run(
        """
        import sys

        import numba

        from vibrissa.numerics.compiled import kernel

        assert numba.njit(lambda x: 2.0 * x)(2.0) == 4.0
        sys.stderr.write("others' are compiled\\n")

        def twice(x):
            return 2.0 * x

        def thrice(x):
            return 3.0 * x

        for function in (twice, thrice):
            function.__module__ = "vibrissa.made_up"
            assert kernel(function)(2.0) in (4.0, 6.0)
        """
    )
    assert said.stderr.startswith("others' are compiled\n")
    assert said.stderr.count("vibrissa: compiling kernels") == 1
    assert said.stdout == ""


def test_what_is_compiled_is_said_with_the_verb():
    said = run(
        """
        import sys
        import vibrissa.cli.app
        from vibrissa.numerics.compiled import kernel

        sys.argv[1:] = ["--help", "estimate", "signals.csv"]

        def twice(x):
            return 2.0 * x

        for module in ("vibrissa.made_up", "vibrissa.other"):
            twice.__module__ = module
            assert kernel(twice)(2.0) == 4.0
        """
    )
    (line,) = said.stderr.splitlines()
    assert line.startswith("vibrissa: compiling kernels for `estimate` (once for this installation")


def test_a_kernel_is_compiled_within_those_that_call_it():
    """Not by itself too, unless Python calls it."""
    run_here(
        """
        from vibrissa.numerics.compiled import inlined, kernel

        @inlined
        def square(x):
            return x * x

        @kernel
        def inner(x, n):
            return square(x) + n

        @inlined
        def both(x):
            return inner(x, 1) + inner(x, 2)

        @kernel
        def outer(x):
            return both(x)

        assert outer(3.0) == 21.0
        assert not inner.overloads
        (part,) = inner.part.overloads.values()  # for both constants
        assert not part.fndesc.inline  # by force, as its caller is
        assert inner(3.0, 1) == 10.0
        """
    )


def test_only_arrays_that_a_kernel_creates_or_returns_are_counted():
    run_here(
        """
        import sys
        import numpy as np
        from vibrissa.numerics.compiled import kernel

        def total(rows):
            sums = np.zeros(3)
            for i in range(len(rows)):
                row = rows[i]
                sums[i] += row[0] + row[1]
            return sums.sum()

        def row_of(rows, i):
            row = rows[i]
            return row

        total, row_of, rows = kernel(total), kernel(row_of), np.ones((3, 2))
        assert total(rows) == 6.0
        (code,) = total.inspect_llvm().values()
        assert "call void @NRT_incref" not in code
        before = sys.getrefcount(rows)
        kept = [row_of(rows, 1) for _ in range(5)]
        assert sys.getrefcount(rows) > before
        del kept
        assert sys.getrefcount(rows) == before
        """
    )


def test_a_kernel_runs_its_own_copies_of_what_it_calls():
    """Not those that other kernels have brought: digits would depend on what was compiled first."""
    run_here(
        """
        import math

        from llvmlite.binding import Linkage

        from vibrissa.numerics.compiled import kernel

        @kernel
        def chaos(x, n):
            for _ in range(n):
                x = math.sin(x) + math.cos(3.0 * x) + math.atan2(x, 1.0 + x * x)
                x += math.exp(-x * x) + math.tanh(x) - math.sinh(0.1 * x) / (1.0 + math.cosh(x))
                x -= math.log1p(x * x) * math.erf(x) + math.gamma(1.0 + x * x) - math.hypot(x, 2.0)
                x *= math.asinh(x) + math.expm1(-abs(x)) * math.sqrt(abs(x)) - math.atan(x)
            return x

        @kernel
        def outer(x, n):
            for k in range(n):
                x += chaos(x, k) * chaos(x, 2 * k) / (1.0 + chaos(x, 3 * k)) * chaos(1.0, n)
            return x

        outer(0.5, 4)
        (compiled,) = outer.overloads.values()
        called = [f for f in compiled.library.get_defined_functions() if "chaos" in f.name]
        assert called  # it is too large to be inlined
        assert {f.linkage for f in called} == {Linkage.internal}
        """
    )


MADE = """
import math

from vibrissa.numerics.compiled import kernel, shared, specialised

@specialised
def power(x, n):
    return x**n

@shared
def root(x, n):
    if x < 0.0:
        raise ValueError("below 0")
    return math.sqrt(power(x, 2)) + n

@kernel
def inner(x):
    return root(x, 1) + root(x, 2)

@kernel
def outer(x):
    return inner(x) + root(x, 3)
"""
CALLED = """
from made import inner, outer, power, root

assert outer(2.0) == 12.0
try:
    outer(-1.0)
except ValueError as fault:
    assert str(fault) == "below 0"
else:
    raise AssertionError
assert len(root.overloads) == 1  # for all constants
if not outer.stats.cache_hits:
    assert not inner.overloads
    ((compiled,), (own,)) = outer.overloads.values(), root.overloads.values()
    name = own.fndesc.llvm_func_name
    (called,) = [f for f in compiled.library._final_module.functions if f.name == name]
    assert called.is_declaration
print(*(sum(each.stats.cache_hits.values()) for each in (outer, root, power)))
"""


def test_a_shared_kernel_is_compiled_once_and_called(tmp_path):
    """Also by kernels from the cache, which need it in the process: without it they would crash."""
    (tmp_path / "made.py").write_text(MADE)
    kept = tmp_path / "kept"
    kept.mkdir()
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    settings = os.environ | {"NUMBA_CACHE_DIR": str(kept), "PYTHONPATH": path}
    assert run(CALLED, **settings).stdout == "0 0 0\n"
    for file in kept.rglob("made.root*.nbc"):
        file.unlink()
    assert run(CALLED, **settings).stdout == "1 0 1\n"


SQUARE = """
import resource, sys

import numpy as np

from vibrissa.numerics.compiled import kernel

if len(sys.argv) > 1:
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), -1))

@kernel
def square(x):
    return x * x

assert square(3.0) == 9.0
assert (square(np.arange(3.0)) == [0.0, 1.0, 4.0]).all()
print(sum(square.stats.cache_hits.values()))
"""


@pytest.fixture
def square(tmp_path):
    """Runs a script with a kernel of two signatures; its cache is in a folder of its own."""
    script, folder = tmp_path / "script.py", tmp_path / "kept"
    script.write_text(SQUARE)
    folder.mkdir()

    def call(*limit):
        return subprocess.run(
            [sys.executable, "-B", "-W", "error", script, *map(str, limit)],
            capture_output=True,
            text=True,
            check=True,
            timeout=300,
            env=os.environ | {"NUMBA_CACHE_DIR": str(folder)},
        )

    return call, folder


@pytest.mark.slow
def test_kernels_are_known_by_what_their_files_contain(square, tmp_path):
    """A file that was copied or checked out anew has another time, and the same kernels."""
    call, _ = square
    script = tmp_path / "script.py"
    assert [call().stdout, call().stdout] == ["0\n", "2\n"]
    os.utime(script, (1e9, 1e9))
    assert call().stdout == "2\n"
    script.write_text(SQUARE.replace("return x * x", "return x**2"))
    assert call().stdout == "0\n"


def test_kernels_in_folders_are_known_by_all_of_their_package(monkeypatch):
    """They contain functions from other folders of the package."""
    packages = []
    monkeypatch.setattr(kernel_cache, "_source_digest", packages.append)
    for kernel in (integrate, judge_rows):
        kernel._cache._index_key((), SimpleNamespace(magic_tuple=tuple))
    assert [folder.name for folder in packages] == ["rod", "contacts"]


@pytest.mark.slow
def test_a_damaged_cache_counts_as_none(square):
    """Nor is code of one signature run for another, as where two processes have written at once."""
    call, folder = square
    assert call().stdout == "0\n"
    assert call().stdout == "2\n"
    files = sorted(folder.rglob("*.nbc"))
    contents = [file.read_bytes() for file in files]
    middle = len(contents[0]) // 2
    flipped = contents[0][:middle] + bytes([contents[0][middle] ^ 1]) + contents[0][middle + 1 :]
    cut, exchanged = contents[0][:middle], contents[::-1]
    for written, kept in (([flipped], 1), ([cut], 1), (exchanged, 0)):
        for file, content in zip(files, written, strict=False):
            file.write_bytes(content)
        again = call()
        assert (again.stdout, again.stderr) == (f"{kept}\n", "")
    assert call().stdout == "2\n"


@pytest.mark.skipif(sys.platform == "win32", reason="this system cannot limit the size of files")
def test_what_cannot_be_kept_is_said_once_and_the_result_is_there(square):
    """As on a full disk."""
    call, _ = square
    result = call(100)
    assert result.stdout == "0\n"
    (said,) = result.stderr.splitlines()
    assert "compiled kernels cannot be kept and are compiled in each run" in said
    assert call().stdout == "0\n"


@pytest.mark.slow
def test_where_nothing_can_be_written_kernels_are_compiled_without_a_cache():
    """As in a read-only installation without a home folder: numba then finds no place for one."""
    said = run(
        """
        from numba.core import caching

        # None of numba's places for a cache can be used.
        for locator in caching.CacheImpl._locator_classes:
            locator.from_function = classmethod(lambda cls, function, file: None)

        from vibrissa.numerics.compiled import inlined, kernel, specialised

        @inlined
        def square(x):
            return x * x

        @specialised
        def power(x, n):
            return square(x) if n == 2 else x

        @kernel
        def fourth(x):
            return power(power(x, 2), 2)

        assert fourth(2.0) == 16.0
        """
    )
    assert "Error" not in said.stderr


def test_importing_the_package_loads_no_compiler():
    said = run(
        """
        import sys
        import vibrissa
        vibrissa.Status
        print([name for name in ("numba", "scipy", "xarray", "matplotlib") if name in sys.modules])
        """
    )
    assert said.stdout.strip() == "[]"


def test_loading_a_kernel_imports_nothing_that_only_compiling_needs(tmp_path):
    """Not even the modules of NumPy's functions that are inlined into it."""
    code = """
        import sys
        import numpy as np
        from vibrissa.contacts.following.mixture import log_weights

        print(log_weights(np.eye(3), 2), "numba.np.arrayobj" in sys.modules)
        """
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    compiled, loaded = (run(code, **environment).stdout.split() for _ in range(2))
    assert compiled == ["0.0", "True"]
    assert loaded == ["0.0", "False"]


def test_what_is_inlined_cannot_be_called_from_python():
    """It has no wrapper for that; without this guard the interpreter would crash."""
    with pytest.raises(TypeError, match="copy can be called by kernels only"):
        copy([0.0], [1.0])


def test_a_few_values_are_put_in_order():
    values = np.array([3.0, np.nan, 1.0, np.inf, np.nan, -1.0, 1.0])
    assert order_of.py_func(values).tolist() == [5, 2, 6, 0, 3, 1, 4]
