"""How kernels are compiled: cached on disk, errors as NumPy has them, contraction allowed.

Compiling takes seconds, once for a given installation (:mod:`~vibrissa.numerics.kernel_cache`).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any, ParamSpec, TypeVar, cast

import numba
from numba import types
from numba.core.registry import CPUDispatcher

from vibrissa.numerics.kernel_cache import PackageCache

P = ParamSpec("P")
R = TypeVar("R")

# Reassociation stays off: results must not depend on how the compiler orders a sum.
_FASTMATH = {"contract", "nsz", "arcp"}
_STRICT: dict[str, Any] = {
    "error_model": "numpy",
    "nogil": True,
    "no_cfunc_wrapper": True,  # nobody calls a kernel from C
}
_OPTIONS = _STRICT | {"fastmath": _FASTMATH}


class _Kernel(CPUDispatcher):
    """What is compiled once for all constants that other kernels call it with."""

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Forget which constants the arguments are."""
        args = tuple(types.unliteral(a) for a in args)
        return super().get_call_template(args, kws)


class _Inlined(CPUDispatcher):
    """What only kernels can call: wrappers for Python would be a third of all compiling."""

    def __call__(self, *args: object, **options: object) -> object:
        raise TypeError(f"{self.py_func.__name__} can be called by kernels only")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that Python calls; cached on disk, releases the GIL."""
    compiled: Any = specialised(function)
    compiled.__class__ = _Kernel
    return cast("Callable[P, R]", compiled)


def specialised(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel anew for each constant that others call it with, so that it is faster."""
    compiled = numba.njit(**_OPTIONS)(function)
    with suppress(RuntimeError):  # numba finds no folder that it may write to
        compiled._cache = PackageCache(function)
    return cast("Callable[P, R]", compiled)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a small function into its callers, so that their lane loops still vectorise."""
    compiled: Any = numba.njit(**_OPTIONS | {"forceinline": True, "no_cpython_wrapper": True})(
        function
    )
    compiled.__class__ = _Inlined
    return cast("Callable[P, R]", compiled)


def rigorous(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function whose rounding is that of IEEE 754, operation by operation."""
    compiled = numba.njit(**_STRICT)(function)
    with suppress(RuntimeError):
        compiled._cache = PackageCache(function)
    return cast("Callable[P, R]", compiled)


def inlined_rigorous(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a small function into its callers as :func:`rigorous` ones are compiled."""
    compiled: Any = numba.njit(**_STRICT | {"no_cpython_wrapper": True})(function)
    compiled.__class__ = _Inlined
    return cast("Callable[P, R]", compiled)


@inlined
def copy(source: Any, target: Any) -> None:
    """Copy a row; Numba compiles this in a tenth of the time that a slice takes it."""
    for i in range(target.shape[0]):
        target[i] = source[i]
