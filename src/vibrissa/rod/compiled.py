"""How kernels are compiled: cached on disk, errors as NumPy has them, contraction allowed.

Compiling takes seconds, once for a given installation; a listener says so while it happens, so that
a first call does not look as if it hung. Where no folder can be written to (a read-only
installation without a home folder) the kernels are compiled anew in each run instead.

Numba knows a cached kernel by its own file alone, and would go on using it after a function that it
inlines from another file has changed; here all files with kernels of its own package and of the
rod, whose helpers others use, are part of the key.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba
from numba.core import event
from numba.core.caching import FunctionCache
from numba.core.registry import CPUDispatcher

P = ParamSpec("P")
R = TypeVar("R")

# Reassociation stays off: results must not depend on how the compiler orders a sum.
_FASTMATH = {"contract", "nsz", "arcp"}
_ROD = Path(__file__).parent
_OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "fastmath": _FASTMATH,
    "nogil": True,
    "no_cfunc_wrapper": True,  # nobody calls a kernel from C
}


@cache
def _sources(package: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(path for folder in {package, _ROD} for path in folder.glob("*.py")):
        source = path.read_bytes()
        if b"@kernel" in source or b"@inlined" in source:
            digest.update(source)
    return digest.hexdigest()


class _PackageCache(FunctionCache):
    def _index_key(self, sig: object, codegen: object) -> tuple[object, ...]:
        package = Path(self._py_func.__code__.co_filename).parent
        return (*super()._index_key(sig, codegen), _sources(package))  # type: ignore[no-untyped-call]


class _Inlined(CPUDispatcher):
    """What only kernels can call: wrappers for Python would be a third of all compiling."""

    def __call__(self, *args: object, **options: object) -> object:
        raise TypeError(f"{self.py_func.__name__} can be called by kernels only")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that Python calls; cached on disk, releases the GIL."""
    compiled = numba.njit(**_OPTIONS)(function)
    with suppress(RuntimeError):  # numba finds no folder that it may write to
        compiled._cache = _PackageCache(function)  # type: ignore[no-untyped-call]
    return cast("Callable[P, R]", compiled)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a small function into its callers, so that their lane loops still vectorise."""
    compiled: Any = numba.njit(**_OPTIONS | {"forceinline": True, "no_cpython_wrapper": True})(
        function
    )
    compiled.__class__ = _Inlined
    return cast("Callable[P, R]", compiled)


@inlined
def copy(source: Any, target: Any) -> None:
    """Copy a row; Numba compiles this in a tenth of the time that a slice takes it."""
    for i in range(target.shape[0]):
        target[i] = source[i]


class _FirstCompilation(event.Listener):
    """Say once per process that kernels are being compiled."""

    def __init__(self) -> None:
        self.said = False

    def on_start(self, event: event.Event) -> None:
        dispatcher = (event.data or {}).get("dispatcher")
        module = getattr(getattr(dispatcher, "py_func", None), "__module__", "") or ""
        if not self.said and module.startswith("vibrissa."):
            self.said = True
            sys.stderr.write(
                "vibrissa: compiling kernels (once for this installation, under a minute) ...\n"
            )
            sys.stderr.flush()

    def on_end(self, event: event.Event) -> None:
        pass


event.register("numba:compile", _FirstCompilation())
