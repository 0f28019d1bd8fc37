"""Concurrent compilation of kernels in this process and a helper process.

Compilation is mostly Python code, which uses one core. If several kernels that do not call each
other are needed and not cached, another interpreter compiles some of them into the cache, from
which this process loads them. The helper has no other effects; kernels that it does not finish are
compiled here when they are called.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
import threading
import time
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

from numba.core import types

from vibrissa.numerics.arrays import Call, threads
from vibrissa.numerics.kernel_cache import PackageCache

# The helper gets this process's search path, so that it imports the same sources.
_HELPER = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "from vibrissa.numerics.together import compile_listed; compile_listed(sys.stdin.buffer)"
)
# Longest wait for the helper, whose share is about as large: this many times the duration of this
# process's own share, plus this many seconds.
_PATIENCE, _AT_LEAST = 2.0, 10.0
_lock = threading.Lock()


def compile_together(here: list[Call], there: list[Call]) -> None:
    """Compile kernels that will be called, ``here`` in this process and ``there`` in a helper.

    Does nothing if there is nothing to gain: kernels have been used or are cached, there is one
    core, or the helper could not hand over its results.
    """
    if any(kernel.overloads for kernel, _ in there):  # type: ignore[attr-defined]
        return
    with _lock:
        mine, others = _not_cached(here), _not_cached(there)
        if not (mine and others and threads() > 1 and _runs_python()):
            return
        if any(_name(kernel) is None for kernel, _ in others):
            return
        helper = _start_helper(others)
        begun = time.monotonic()
        try:
            for kernel, signature in mine:
                kernel.compile(signature)
            if helper is not None:
                helper.wait(_PATIENCE * (time.monotonic() - begun) + _AT_LEAST)
        except subprocess.TimeoutExpired:
            pass
        finally:
            if helper is not None:
                helper.kill()
                helper.wait()


def compile_listed(file: BinaryIO) -> None:
    """Compile the kernels listed in a file into the cache; run by the helper."""
    for module, name in pickle.load(file):
        kernel = getattr(import_module(module), name)
        kernel.compile(pickle.load(file))


def _not_cached(calls: list[Call]) -> list[tuple[Any, tuple[types.Type, ...]]]:
    """Kernels that are not cached, with the types of their arguments."""
    found = []
    for call, arguments in calls:
        kernel: Any = call
        signature = tuple(
            one if isinstance(one, types.Type) else kernel.typeof_pyval(one) for one in arguments
        )
        cache, codegen = kernel._cache, kernel.targetctx.codegen()
        # Without a writable folder numba uses another kind of cache.
        if isinstance(cache, PackageCache) and not cache.holds(signature, codegen):
            found.append((kernel, signature))
    return found


def _runs_python() -> bool:
    """Whether this process's executable is a Python interpreter, not an embedding program."""
    name = Path(sys.executable or "").stem.lower()
    return name.startswith("python") and not getattr(sys, "frozen", False)


def _name(kernel: Any) -> tuple[str, str] | None:
    """Module and name under which a helper can import a kernel; None if it cannot."""
    function = kernel.py_func
    module = sys.modules.get(function.__module__)
    if function.__module__ == "__main__" or getattr(module, function.__name__, None) is not kernel:
        return None
    return function.__module__, function.__name__


def _start_helper(
    calls: list[tuple[Any, tuple[types.Type, ...]]],
) -> subprocess.Popen[bytes] | None:
    """Start a helper that compiles kernels; None if no process can be started."""
    parts = [sys.path, [_name(kernel) for kernel, _ in calls], *(each for _, each in calls)]
    try:
        asked = b"".join(map(pickle.dumps, parts))
        helper = subprocess.Popen(
            [sys.executable, "-c", _HELPER],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),  # no window on Windows
        )
    except (OSError, pickle.PicklingError):
        return None
    assert helper.stdin is not None
    try:
        with helper.stdin:
            helper.stdin.write(asked)
    except OSError:  # the helper has ended already
        pass
    return helper
