"""How kernels are compiled: cached on disk, errors as NumPy has them, contraction allowed.

Compiling takes seconds, once for a given installation (:mod:`~vibrissa.numerics.kernel_cache`).
Numba optimises every function by itself, and again within each function that calls it, and so on
up to what Python calls. Here that alone is optimised, with all that it consists of: functions that
kernels call are only translated (:class:`_Part`).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any, ParamSpec, TypeVar, cast

import numba
from llvmlite.binding import parse_assembly
from numba import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
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


class _Part(JITCodeLibrary):
    """Code that is neither optimised nor run by itself, but in what it is linked into."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        for variable in self._final_module.global_variables:
            if "NumbaEnv" in variable.name:  # numba looks for this in what can be run
                self._codegen._add_module(parse_assembly(str(variable)))
        self._codegen._engine.finalize_object()
        self._finalized = True


class _PartCompiler(Compiler):
    """Numba's compiler, with such a library."""

    def __init__(self, typing: Any, target: Any, library: Any, *rest: Any) -> None:
        library = _Part(target.codegen(), "part")  # type: ignore[no-untyped-call]
        super().__init__(typing, target, library, *rest)  # type: ignore[no-untyped-call]


class _Kernel(CPUDispatcher):
    """What Python calls; where kernels call it, it is a part of them."""

    part: Any

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Compile the part, once for all constants that it is called with."""
        return self.part.get_call_template(tuple(types.unliteral(a) for a in args), kws)

    def get_overload(self, sig: Any) -> Any:
        """Find the compiled part."""
        return self.part.get_overload(sig)


class _Inlined(CPUDispatcher):
    """What only kernels can call: wrappers for Python would be a third of all compiling."""

    def __call__(self, *args: object, **options: object) -> object:
        raise TypeError(f"{self.py_func.__name__} can be called by kernels only")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that Python calls; cached on disk, releases the GIL."""
    compiled: Any = specialised(function)
    compiled.__class__ = _Kernel
    compiled.part = _part(function)
    return cast("Callable[P, R]", compiled)


def specialised(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel anew for each constant that others call it with, so that it is faster."""
    compiled = numba.njit(**_OPTIONS)(function)
    with suppress(RuntimeError):  # numba finds no folder that it may write to
        compiled._cache = PackageCache(function)
    return cast("Callable[P, R]", compiled)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a small function into its callers, so that their lane loops still vectorise."""
    return cast("Callable[P, R]", _part(function, forceinline=True))


def _part(function: Callable[P, R], **options: bool) -> Any:
    compiled: Any = numba.njit(
        **_OPTIONS | {"no_cpython_wrapper": True} | options, pipeline_class=_PartCompiler
    )(function)
    compiled.__class__ = _Inlined
    return compiled


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
