"""Compilation of kernels: cached on disk, with NumPy's error model and contraction allowed.

Compilation takes seconds, once per installation (:mod:`~vibrissa.numerics.kernel_cache`). Numba
links and optimises every function by itself, again within each function that calls it, and so on up
to the one called by Python. Here only the latter is linked and optimised, together with all
functions it calls; functions called by kernels alone are only translated (:class:`_Part`). Large
functions that several kernels call are compiled once, and called by them (:func:`shared`).
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
from numba.core.compiler_machinery import register_pass
from numba.core.cpu import CPUContext
from numba.core.lowering import Lower
from numba.core.registry import CPUDispatcher
from numba.core.runtime.context import NRTContext
from numba.core.typed_passes import NativeLowering

from vibrissa.numerics.kernel_cache import Called, PackageCache

P = ParamSpec("P")
R = TypeVar("R")

# Reassociation is disabled: results must not depend on how the compiler orders a sum.
_FASTMATH = {"contract", "nsz", "arcp"}
_OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "nogil": True,
    "no_cfunc_wrapper": True,  # kernels are not called from C
    "fastmath": _FASTMATH,
}

#: Whether llvmlite supports function attributes; older versions attach them to return values, which
#: LLVM rejects.
_ATTRIBUTES = tuple(map(int, llvmlite.__version__.split(".")[:2])) >= (0, 48)
#: Number of functions above which a kernel is mostly bookkeeping around fast ones.
_LARGE = 40
#: Number of new objects that trigger garbage collection during compilation.
_YOUNG = 50_000
#: Parts of LLVM's names of functions whose loops are vectorised even in large kernels.
_VECTORISED: set[str] = set()
#: Code of shared kernels.
_SHARED: dict[JITCodeLibrary, Called] = {}
#: Expressions whose value refers to existing arrays.
_VIEWS = {"getitem", "static_getitem", "getattr", "build_tuple", "cast", "exhaust_iter", "phi"}


class _Part(JITCodeLibrary):
    """Code that is linked, optimised and run only as part of a kernel."""

    def finalize(self) -> None:
        """Keep the code for linking; numba looks up its environment in executable modules."""
        for variable in self._final_module.global_variables:
            if "NumbaEnv" in variable.name:
                self._codegen._add_module(parse_assembly(str(variable)))
        self._codegen._engine.finalize_object()
        self._finalized = True


class _Whole(JITCodeLibrary):
    """Code that is linked and optimised together with all its parts, apart from shared kernels."""

    #: Shared kernels called.
    calls: tuple[Called, ...] = ()

    def finalize(self) -> None:
        """Link each part once, rather than once per caller."""
        found: dict[JITCodeLibrary, None] = {}
        _collect_parts(self._linking_libraries, found)
        self.calls = tuple(_SHARED[library] for library in found if library in _SHARED)
        # Callers first: LLVM omits what nothing already linked refers to.
        self._linking_libraries = [each for each in reversed(found) if each not in _SHARED]
        super().finalize()  # type: ignore[no-untyped-call]

    def _finalize_final_module(self) -> None:
        """Restrict linked functions to this kernel.

        Otherwise a copy of a function from another kernel, optimised for that one, would be called:
        results would depend on what the process has compiled or loaded before.
        """
        self._finalized = True
        self._get_module_for_linking()  # type: ignore[no-untyped-call]
        for function in self._final_module.functions:
            if function.linkage is Linkage.linkonce_odr:
                function.linkage = Linkage.internal
        super()._finalize_final_module()  # type: ignore[no-untyped-call]


class _Compact(_Whole):
    """Such code optimised for size if large, except for fast functions: it halves LLVM's time."""

    def _optimize_final_module(self) -> None:
        fast = {
            function.name
            for library in self._linking_libraries
            if not isinstance(library, _Part)
            for function in library._get_module_for_linking().functions
        }
        own = [f for f in self._final_module.functions if not (f.is_declaration or f.name in fast)]
        for function in own if _ATTRIBUTES and len(own) > _LARGE else ():
            # Inlined into a function optimised for size, loops would not be vectorised.
            loops = any(name in function.name for name in _VECTORISED)
            function.add_function_attribute("noinline" if loops else "optsize")
        super()._optimize_final_module()  # type: ignore[no-untyped-call]


def _collect_parts(libraries: list[JITCodeLibrary], found: dict[JITCodeLibrary, None]) -> None:
    """Collect the parts of libraries, each once, parts of parts first."""
    for library in libraries:
        if library not in found:
            if isinstance(library, _Part):
                _collect_parts(library._linking_libraries, found)
            found[library] = None


class _Uncounted(CPUContext):
    """Target without reference counting, which can still read what references refer to."""

    @property
    def nrt(self) -> NRTContext:
        """Access to memory that is counted elsewhere."""
        return NRTContext(self, True)


class _Lower(Lower):
    """Numba's code generator, without reference counting of arrays that belong to the caller.

    Views of arguments refer to arrays that the caller keeps alive. Counting is atomic, so that
    threads that use the same map would wait for each other. Arrays that the function or a function
    called by it creates, or that it returns, are counted.
    """

    def __init__(self, context: Any, library: Any, description: Any, *rest: Any, **named: Any):
        kinds, counted = description.typemap, context.data_model_manager
        holding = {name for name in kinds if counted[kinds[name]].contains_nrt_meminfo()}
        values: dict[str, list[Any]] = {}
        returned = set()
        for block in rest[0].blocks.values():
            for statement in block.find_insts(ir.Assign):
                values.setdefault(statement.target.name, []).append(statement.value)
            returned |= {statement.value.name for statement in block.find_insts(ir.Return)}
        borrowed, before = (holding & values.keys()) - returned, -1
        while len(borrowed) != before:
            before, owned = len(borrowed), holding - borrowed
            borrowed = {
                name
                for name in borrowed
                if all(_is_view(value, owned, holding) for value in values[name])
            }
        uncounted = context.subtarget(enable_nrt=False)
        uncounted.__class__ = _Uncounted
        if not (holding & values.keys()) - borrowed:
            context = uncounted
        super().__init__(context, library, description, *rest, **named)  # type: ignore[no-untyped-call]
        self._borrowed, self._uncounted = borrowed, uncounted

    def lower_inst(self, statement: Any) -> Any:
        """Generate code for a statement, without counting if its variable is a borrowed array."""
        name = ""
        if isinstance(statement, ir.Assign):
            name = statement.target.name
        elif isinstance(statement, ir.Del):
            name = statement.value
        context = self.context
        if name in self._borrowed:
            self.context = self._uncounted
        try:
            return super().lower_inst(statement)  # type: ignore[no-untyped-call]
        finally:
            self.context = context


def _is_view(value: Any, owned: set[str], holding: set[str]) -> bool:
    """Whether a value refers to arrays that exist outside of a function, none of them ``owned``."""
    if not isinstance(value, ir.Expr):
        return not (isinstance(value, ir.Var) and value.name in owned)
    if value.op == "getitem" and value.index.name in holding:  # an array as an index makes a copy
        return False
    return value.op in _VIEWS and not any(used.name in owned for used in value.list_vars())


@register_pass(mutates_CFG=True, analysis_only=False)
class _Lowering(NativeLowering):
    """Code generation by `_Lower`."""

    _name = "lowering_without_counting"

    @property
    def lowering_class(self) -> type[Lower]:
        """Class of the code generator."""
        return _Lower


class _Flags(Flags):
    """Numba's options with fast hashing and comparison, which happen at every compiled call."""

    __slots__ = ()

    def __hash__(self) -> int:
        return _HASH

    def values(self) -> dict[str, Any]:
        """Return all options by name."""
        return {**_DEFAULTS, **self._values, **_FORM}


_DEFAULTS = {name: option.default for name, option in Flags.options.items()}
#: Options that do not affect the called function, which is compiled once for all their values.
_FORM = {"forceinline": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_HASH = hash(Flags())  # depends on the names of the options alone


class _SharedFlags(_Flags):
    """The same for shared kernels, whose names do not depend on what calls them first."""

    __slots__ = ()

    def get_mangle_string(self) -> str:
        """Return the part of names in machine code that else lists the options."""
        return "shared"


class _WholeCompiler(Compiler):
    """Numba's compiler with such a library."""

    library_type: type[JITCodeLibrary] = _Whole
    flags_type: type[_Flags] = _Flags

    def __init__(self, typing: Any, target: Any, library: Any, *rest: Any) -> None:
        library = self.library_type(target.codegen(), "kernel")
        library.enable_object_caching()
        args, returned, flags, types_of_locals = rest
        flags = self.flags_type(flags)
        super().__init__(typing, target, library, args, returned, flags, types_of_locals)  # type: ignore[no-untyped-call]

    def compile_extra(self, func: Any) -> Any:
        """Compile with less frequent garbage collection, which else takes a sixth of the time."""
        young, *older = gc.get_threshold()
        gc.set_threshold(max(young, _YOUNG) if young else 0, *older)
        try:
            return super().compile_extra(func)  # type: ignore[no-untyped-call]
        finally:
            gc.set_threshold(young, *older)

    def define_pipelines(self) -> list[Any]:
        """Generate code without reference counting where possible."""
        (manager,) = super().define_pipelines()  # type: ignore[no-untyped-call]
        manager.passes = [
            (_Lowering if step is NativeLowering else step, text) for step, text in manager.passes
        ]
        manager.finalize()
        return [manager]


class _CompactCompiler(_WholeCompiler):
    library_type = _Compact


class _SharedCompiler(_CompactCompiler):
    """Compiler of a kernel whose name in machine code is the same in all processes."""

    flags_type = _SharedFlags

    def _compile_bytecode(self) -> Any:
        """Replace Numba's number of the function, by which cached callers would not find it."""
        self.state.func_id.unique_id = 0
        return super()._compile_bytecode()  # type: ignore[no-untyped-call]


class _PartCompiler(_WholeCompiler):
    library_type = _Part


class _Kernel(CPUDispatcher):
    """Dispatcher of a function called by Python; in kernels its part is called."""

    part: Any

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Compile the part once for all constant arguments."""
        return self.part.get_call_template(tuple(types.unliteral(a) for a in args), kws)

    def get_overload(self, sig: Any) -> Any:
        """Return the compiled part."""
        return self.part.get_overload(sig)


class _Specialised(CPUDispatcher):
    """Dispatcher of a kernel called, in the same compiled form, by Python and by kernels."""

    def add_overload(self, cres: Any) -> None:
        """Note what is compiled, so that callers do not contain it."""
        super().add_overload(cres)
        _SHARED[cres.library] = Called(self.py_func, cres)


class _Shared(_Specialised):
    """The same, compiled once for all constant arguments."""

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Compile without the values of constants."""
        return super().get_call_template(tuple(map(types.unliteral, args)), kws)


class _Inlined(CPUDispatcher):
    """Dispatcher for kernels only: wrappers for Python would take a third of the compilation."""

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Compile once for all constant arguments: where inlined, LLVM propagates them."""
        return super().get_call_template(tuple(map(types.unliteral, args)), kws)

    def __call__(self, *args: object, **options: object) -> object:
        raise TypeError(f"{self.py_func.__name__} can be called by kernels only")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function for calls from Python; it is cached on disk and releases the GIL."""
    compiled = _compile_cached(function, pipeline_class=_CompactCompiler)
    compiled.__class__ = _Kernel
    compiled.part = _compile_part(function, forceinline=False)  # otherwise that of its first caller
    return cast("Callable[P, R]", compiled)


def vectorised(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel with long loops, which are vectorised even within large kernels."""
    name = function.__name__
    _VECTORISED.add(f"{len(name)}{name}B")
    return kernel(function)


def shared(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel once for Python and all kernels, which call it instead of containing it.

    For large functions: a call takes some nanoseconds, and nothing is inlined across it.
    """
    compiled = _compile_cached(function, pipeline_class=_SharedCompiler)
    compiled.__class__ = _Shared
    return cast("Callable[P, R]", compiled)


def specialised(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a shared kernel separately for each constant argument, so that it is faster."""
    compiled: Any = shared(function)
    compiled.__class__ = _Specialised
    return cast("Callable[P, R]", compiled)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a small function inline into its callers, so that their lane loops vectorise."""
    return cast("Callable[P, R]", _compile_part(function, forceinline=True))


def rigorous(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function with IEEE 754 rounding of every operation."""
    return cast("Callable[P, R]", _compile_cached(function, fastmath=False))


def inlined_rigorous(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a small function, for callers of the kind :func:`rigorous`."""
    return cast("Callable[P, R]", _compile_part(function, fastmath=False))


def _compile_cached(function: Any, **options: Any) -> Any:
    """Compile a function with the cache on disk."""
    compiled: Any = numba.njit(**_OPTIONS | {"pipeline_class": _WholeCompiler} | options)(function)
    with suppress(RuntimeError):  # numba finds no writable folder
        compiled._cache = PackageCache(function)
    return compiled


def _compile_part(function: Any, **options: Any) -> Any:
    """Compile a function for calls from kernels only."""
    compiled: Any = numba.njit(
        **_OPTIONS | {"no_cpython_wrapper": True, "pipeline_class": _PartCompiler} | options
    )(function)
    compiled.__class__ = _Inlined
    return compiled


@inlined
def copy(source: Any, target: Any) -> None:
    """Copy a row; Numba compiles this in a tenth of the time of a slice assignment."""
    for i in range(target.shape[0]):
        target[i] = source[i]
