"""Kernels that do not call each other are compiled at the same time, by this process and a helper.

Compiling is mostly Python, which keeps one core busy. Where several kernels are needed and none of
them is on disk, another interpreter compiles some of them, and this one finds them in the cache.
The helper prints nothing and changes nothing else; whatever it does not finish is compiled here
when it is called, as without it.
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

# The helper has the sources that this process has, wherever they were found.
_HELPER = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "from vibrissa.numerics.together import compile_asked; compile_asked(sys.stdin.buffer)"
)
# The helper has about as much to do: it is waited for so many times as long as this process took
# for its own share, and so many seconds more.
_PATIENCE, _AT_LEAST = 2.0, 10.0
_lock = threading.Lock()


def compile_together(here: list[Call], there: list[Call]) -> None:
    """Compile kernels that will be called, some ``here`` and some ``there``, in a helper.

    Nothing is done where that gains nothing: kernels were used before or are on disk, there is one
    core, or what a helper compiles cannot be handed over.
    """
    if any(kernel.overloads for kernel, _ in there):  # type: ignore[attr-defined]
        return
    with _lock:
        mine, others = _missing(here), _missing(there)
        if not (mine and others and threads() > 1 and _runs_python()):
            return
        if any(_name(kernel) is None for kernel, _ in others):
            return
        helper = _started(others)
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


def compile_asked(file: BinaryIO) -> None:
    """Compile the kernels that a file lists, into the cache: all that a helper does."""
    for module, name in pickle.load(file):
        kernel = getattr(import_module(module), name)
        kernel.compile(pickle.load(file))


def _missing(calls: list[Call]) -> list[tuple[Any, tuple[types.Type, ...]]]:
    """Kernels that are not on disk, with the types of their arguments."""
    found = []
    for call, arguments in calls:
        kernel: Any = call
        signature = tuple(
            one if isinstance(one, types.Type) else kernel.typeof_pyval(one) for one in arguments
        )
        cache, codegen = kernel._cache, kernel.targetctx.codegen()
        # Where there is no folder for a cache, numba has another kind of it.
        if isinstance(cache, PackageCache) and not cache.holds(signature, codegen):
            found.append((kernel, signature))
    return found


def _runs_python() -> bool:
    """Whether the executable of this process is an interpreter, not a program that holds one."""
    name = Path(sys.executable or "").stem.lower()
    return name.startswith("python") and not getattr(sys, "frozen", False)


def _name(kernel: Any) -> tuple[str, str] | None:
    """Module and name by which a helper finds a kernel; None if it does not."""
    function = kernel.py_func
    module = sys.modules.get(function.__module__)
    if function.__module__ == "__main__" or getattr(module, function.__name__, None) is not kernel:
        return None
    return function.__module__, function.__name__


def _started(calls: list[tuple[Any, tuple[types.Type, ...]]]) -> subprocess.Popen[bytes] | None:
    """Start a helper that compiles kernels; None where no process can be started."""
    parts = [sys.path, [_name(kernel) for kernel, _ in calls], *(each for _, each in calls)]
    try:
        asked = b"".join(map(pickle.dumps, parts))
        helper = subprocess.Popen(
            [sys.executable, "-c", _HELPER],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),  # a window, on Windows
        )
    except (OSError, pickle.PicklingError):
        return None
    assert helper.stdin is not None
    try:
        with helper.stdin:
            helper.stdin.write(asked)
    except OSError:  # it has ended already
        pass
    return helper
