"""How kernels are compiled: cached on disk, errors as NumPy has them, contraction allowed.

Compiling takes seconds, once for a given installation (:mod:`~vibrissa.numerics.kernel_cache`).
Numba links and optimises every function by itself, and again within each function that calls it,
and so on up to what Python calls. Here that alone is linked and optimised, with all that it
consists of: functions that kernels call are only translated (:class:`_Part`).
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from contextlib import suppress
from typing import Any, ParamSpec, TypeVar, cast

import llvmlite
import numba
from llvmlite.binding import Linkage, parse_assembly
from numba import types
from numba.core import ir
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NopythonTypeInference

from vibrissa.numerics.kernel_cache import PackageCache

P = ParamSpec("P")
R = TypeVar("R")

# Reassociation stays off: results must not depend on how the compiler orders a sum.
_FASTMATH = {"contract", "nsz", "arcp"}
_OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "nogil": True,
    "no_cfunc_wrapper": True,  # nobody calls a kernel from C
    "fastmath": _FASTMATH,
}


#: Older ones put attributes of functions at what these return, which LLVM refuses.
_ATTRIBUTES = tuple(map(int, llvmlite.__version__.split(".")[:2])) >= (0, 48)
#: Number of functions from which on a kernel is mostly bookkeeping around fast ones.
_LARGE = 40
#: Objects that may be new before garbage among them is looked for.
_YOUNG = 50_000
#: Ends of LLVM's names of functions whose loops are worth their size in large kernels, too.
_VECTORISED: set[str] = set()
#: Expressions whose value refers to arrays that are there already.
_VIEWS = {"getitem", "static_getitem", "getattr", "build_tuple", "cast", "exhaust_iter", "phi"}


class _Part(JITCodeLibrary):
    """Code that is not linked, optimised or run by itself, but in what it is a part of."""

    def finalize(self) -> None:
        """Keep the code for linking; numba looks for its environment in what can be run."""
        for variable in self._final_module.global_variables:
            if "NumbaEnv" in variable.name:
                self._codegen._add_module(parse_assembly(str(variable)))
        self._codegen._engine.finalize_object()
        self._finalized = True


class _Whole(JITCodeLibrary):
    """Code that is linked with all its parts, and optimised with them."""

    def finalize(self) -> None:
        """Link each part once, not once more for each that calls it."""
        found: dict[JITCodeLibrary, None] = {}
        _visit(self._linking_libraries, found)
        # Callers first: LLVM leaves out what nothing that is linked already refers to.
        self._linking_libraries = list(reversed(found))
        super().finalize()  # type: ignore[no-untyped-call]

    def _finalize_final_module(self) -> None:
        """Bind what is linked in to this code alone.

        Otherwise a copy that other code has brought, and that was optimised with that, would be
        run in its place: results would depend on what a process has compiled or loaded before.
        """
        self._finalized = True
        self._get_module_for_linking()  # type: ignore[no-untyped-call]
        for function in self._final_module.functions:
            if function.linkage is Linkage.linkonce_odr:
                function.linkage = Linkage.internal
        super()._finalize_final_module()  # type: ignore[no-untyped-call]


class _Compact(_Whole):
    """Such code, for size where it is large, but for what is to be fast: half of LLVM's time."""

    def _optimize_final_module(self) -> None:
        fast = {
            function.name
            for library in self._linking_libraries
            if not isinstance(library, _Part)
            for function in library._get_module_for_linking().functions
        }
        own = [f for f in self._final_module.functions if not (f.is_declaration or f.name in fast)]
        for function in own if _ATTRIBUTES and len(own) > _LARGE else ():
            if not any(name in function.name for name in _VECTORISED):
                function.add_function_attribute("optsize")
        super()._optimize_final_module()  # type: ignore[no-untyped-call]


def _visit(libraries: list[JITCodeLibrary], found: dict[JITCodeLibrary, None]) -> None:
    for library in libraries:
        if library not in found:
            if isinstance(library, _Part):
                _visit(library._linking_libraries, found)
            found[library] = None


@register_pass(mutates_CFG=False, analysis_only=True)
class _Borrowing(AnalysisPass):
    """References are not counted in a function that only uses arrays of its caller.

    An array that something else makes or returns, or the function itself returns, is counted.
    """

    _name = "borrowing"

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]

    def run_pass(self, state: Any) -> bool:
        """Compile without counting where nothing is there to count."""
        counted = state.targetctx.data_model_manager
        made = [state.return_type]
        for block in state.func_ir.blocks.values():
            for statement in block.find_insts(ir.Assign):
                value = statement.value
                if isinstance(value, ir.Expr) and value.op not in _VIEWS:
                    made.append(state.typemap[statement.target.name])
        if not any(counted[kind].contains_nrt_meminfo() for kind in made):
            state.targetctx = state.targetctx.subtarget(enable_nrt=False)
        return False


class _Flags(Flags):
    """Numba's options, which it compares at every call that it compiles; here quickly."""

    __slots__ = ()

    def __hash__(self) -> int:
        return _HASH

    def values(self) -> dict[str, Any]:
        """Give all options by name."""
        return {**_DEFAULTS, **self._values, **_FORM}


_DEFAULTS = {name: option.default for name, option in Flags.options.items()}
#: Options that make no difference to what is called: that is compiled once for all of them.
_FORM = {"forceinline": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_HASH = hash(Flags())  # of the names of all options alone


class _WholeCompiler(Compiler):
    """Numba's compiler, with such a library."""

    library_type: type[JITCodeLibrary] = _Whole

    def __init__(self, typing: Any, target: Any, library: Any, *rest: Any) -> None:
        library = self.library_type(target.codegen(), "kernel")
        library.enable_object_caching()
        args, returned, flags, types_of_locals = rest
        flags = _Flags(flags)  # type: ignore[no-untyped-call]
        super().__init__(typing, target, library, args, returned, flags, types_of_locals)  # type: ignore[no-untyped-call]

    def compile_extra(self, func: Any) -> Any:
        """Compile while cyclic garbage is looked for less often: else that is a sixth of all."""
        young, *older = gc.get_threshold()
        gc.set_threshold(max(young, _YOUNG) if young else 0, *older)
        try:
            return super().compile_extra(func)  # type: ignore[no-untyped-call]
        finally:
            gc.set_threshold(young, *older)

    def define_pipelines(self) -> list[Any]:
        """Decide about references when types are known."""
        (manager,) = super().define_pipelines()  # type: ignore[no-untyped-call]
        manager.add_pass_after(_Borrowing, NopythonTypeInference)
        manager.finalize()
        return [manager]


class _CompactCompiler(_WholeCompiler):
    library_type = _Compact


class _PartCompiler(_WholeCompiler):
    library_type = _Part


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

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Compile it once for all constants: where it is inlined, LLVM sees them."""
        return super().get_call_template(tuple(map(types.unliteral, args)), kws)

    def __call__(self, *args: object, **options: object) -> object:
        raise TypeError(f"{self.py_func.__name__} can be called by kernels only")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that Python calls; cached on disk, releases the GIL."""
    compiled = _cached(function, pipeline_class=_CompactCompiler)
    compiled.__class__ = _Kernel
    compiled.part = _part(function)
    return cast("Callable[P, R]", compiled)


def vectorised(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel with long loops, which stay side by side within large kernels."""
    name = function.__name__
    _VECTORISED.add(f"{len(name)}{name}B")
    return kernel(function)


def specialised(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel anew for each constant that others call it with, so that it is faster."""
    return cast("Callable[P, R]", _cached(function))


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a small function into its callers, so that their lane loops still vectorise."""
    return cast("Callable[P, R]", _part(function, forceinline=True))


def rigorous(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function whose rounding is that of IEEE 754, operation by operation."""
    return cast("Callable[P, R]", _cached(function, fastmath=False))


def inlined_rigorous(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a small function into its callers as :func:`rigorous` ones are compiled."""
    return cast("Callable[P, R]", _part(function, fastmath=False))


def _cached(function: Any, **options: Any) -> Any:
    compiled: Any = numba.njit(**_OPTIONS | {"pipeline_class": _WholeCompiler} | options)(function)
    with suppress(RuntimeError):  # numba finds no folder that it may write to
        compiled._cache = PackageCache(function)
    return compiled


def _part(function: Any, **options: Any) -> Any:
    compiled: Any = numba.njit(
        **_OPTIONS | {"no_cpython_wrapper": True, "pipeline_class": _PartCompiler} | options
    )(function)
    compiled.__class__ = _Inlined
    return compiled


@inlined
def copy(source: Any, target: Any) -> None:
    """Copy a row; Numba compiles this in a tenth of the time that a slice takes it."""
    for i in range(target.shape[0]):
        target[i] = source[i]
