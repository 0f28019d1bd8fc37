"""Execution of row kernels on a GPU: the CPU's functions compiled for one row per thread.

A row kernel ``kernel(*tables, *inputs, *outputs, first, last)`` processes rows ``first`` to
``last``. On the GPU each thread processes one row. The kernel and the functions it calls are
compiled from the same source with few changes: arrays created inside are local to the thread, and
names may have substitutes. There are no lanes, because the threads take their role.
"""

from __future__ import annotations

import ast
import inspect
from collections import namedtuple
from collections.abc import Callable, Mapping
from functools import cache
from importlib.util import find_spec
from types import FunctionType
from typing import Any

import numpy as np

from vibrissa.numerics.arrays import AnyArray

# Number of rows on the GPU at a time, so that its memory does not limit a call.
_ROWS = 1 << 20
_THREADS = 128
_ARRAYS = ("empty", "zeros", "ones")
# NumPy functions that Numba does not compile for a GPU.
_ROUNDING = ("exp", "floor", "rint", "sqrt")


def check_device(device: str) -> None:
    """Raise an error unless kernels can run on a device."""
    if device not in ("cpu", "cuda"):
        raise ValueError(f"device is {device!r}; it must be 'cpu' or 'cuda'")
    if device == "cpu":
        return
    from numba import cuda

    if not _is_simulated() and find_spec("numba_cuda") is None:
        raise ModuleNotFoundError("a GPU needs numba-cuda: pip install 'vibrissa[gpu]'")
    if not cuda.is_available():
        raise ValueError("device is 'cuda', but no NVIDIA GPU with a driver was found; use 'cpu'")


def _is_simulated() -> bool:
    """Whether Numba's CUDA simulator is enabled."""
    from numba.core import config

    return bool(config.ENABLE_CUDASIM)  # type: ignore[attr-defined]


class Translation:
    """Compiler of row kernels for the GPU.

    Global names used by the kernels and the functions they call can be replaced by ``substitutes``:
    functions of the CPU, or numbers.
    """

    def __init__(self, substitutes: Mapping[str, Any]) -> None:
        self._substitutes = dict(substitutes)
        self._compiled: dict[Any, Any] = {}
        self._launchers: dict[Any, Any] = {}

    def run(
        self,
        kernel: Callable[..., Any],
        tables: tuple[Any, ...],
        inputs: tuple[AnyArray, ...],
        outputs: tuple[AnyArray, ...],
    ) -> None:
        """Run a row kernel over all rows."""
        from numba import cuda

        if kernel not in self._launchers:
            scope = _gpu_functions() | {"_gpu_kernel": self._translate(kernel)}
            self._launchers[kernel] = cuda.jit(FunctionType(_launch.__code__, scope, "launch"))
        launch, shared = self._launchers[kernel], _on_gpu(tables)
        for first in range(0, len(inputs[0]), _ROWS):
            part = slice(first, min(first + _ROWS, len(inputs[0])))
            count = part.stop - first
            rows = tuple(cuda.to_device(np.ascontiguousarray(a[part])) for a in inputs + outputs)
            self.launch(launch[-(-count // _THREADS), _THREADS], count, shared, rows)
            for target, row in zip(outputs, rows[len(inputs) :], strict=True):
                if target.size:
                    row.copy_to_host(target[part])

    @staticmethod
    def launch(configured: Any, *args: Any) -> None:
        """Launch a compiled kernel; a separate method so that benchmarks can time it."""
        configured(*args)

    def _translate(self, function: Any) -> Any:
        """Compile a CPU function, and those it calls, for the GPU."""
        if function not in self._compiled:
            from numba import cuda

            self._compiled[function] = cuda.jit(device=True)(self._source(function.py_func))
        return self._compiled[function]

    def _source(self, function: Any) -> FunctionType:
        """The function rewritten so that the GPU can compile it."""
        scope = dict(function.__globals__) | _gpu_functions()
        scope |= {name: self._substitutes[name] for name in self._substitutes if name in scope}
        tree = ast.parse(inspect.getsource(function))
        definition = tree.body[0]
        assert isinstance(definition, ast.FunctionDef)
        definition.decorator_list, definition.returns = [], None
        for argument in definition.args.args:
            argument.annotation = None
        tree = ast.fix_missing_locations(_Local(scope).visit(tree))
        ast.increment_lineno(tree, function.__code__.co_firstlineno - 1)
        code = compile(tree, function.__code__.co_filename, "exec").co_consts[0]
        for name in code.co_names:
            if hasattr(scope.get(name), "py_func") and name not in _gpu_functions():
                scope[name] = self._translate(scope[name])
        return FunctionType(code, scope, function.__name__, function.__defaults__)


class _Local(ast.NodeTransformer):
    """Rewriter that makes arrays local to a thread and replaces NumPy functions."""

    def __init__(self, scope: Mapping[str, Any]) -> None:
        self._scope = dict(scope)

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        module, _, name = ast.unparse(node.func).partition(".")
        if module != "np" or (f"_gpu_{name}" not in self._scope and name not in _ARRAYS):
            return node
        text = f"_gpu_{name}({', '.join(ast.unparse(a) for a in node.args)})"
        if name in _ARRAYS:
            shape = eval(ast.unparse(node.args[0]), self._scope)  # of constants alone
            kind = ast.unparse(node.args[1]) if len(node.args) > 1 else "np.float64"
            text = f"_gpu_cuda.local.array({shape!r}, _gpu_types.{kind[3:]})"
            if name != "empty":
                text = f"_gpu_fill({text}, {int(name == 'ones')})"
        return ast.copy_location(ast.parse(text, mode="eval").body, node)


def _fill(array: Any, value: Any) -> Any:
    """Set all elements of an array."""
    for i in range(array.shape[0]):
        array[i] = value
    return array


def _sign(x: float) -> float:
    """Sign of a number."""
    return 1.0 if x > 0.0 else (-1.0 if x < 0.0 else x)


@cache
def _gpu_functions() -> dict[str, Any]:
    """Functions available to translated code under reserved names."""
    from numba import cuda, types

    library: Any = np
    if not _is_simulated():
        from numba.cuda import libdevice as library
    own = {f"_gpu_{name}": getattr(library, name) for name in _ROUNDING}
    own |= {"_gpu_fill": cuda.jit(device=True)(_fill), "_gpu_sign": cuda.jit(device=True)(_sign)}
    return own | {"_gpu_cuda": cuda, "_gpu_types": types}


# Names defined in the scope in which each launch is compiled.
_gpu_cuda: Any
_gpu_kernel: Any


def _launch(count: Any, tables: Any, rows: Any) -> None:
    """Process the row of this thread."""
    row = _gpu_cuda.grid(1)  # noqa: F821
    if row < count:
        _gpu_kernel(*(tables + rows + (row, row + 1)))  # noqa: F821


@cache
def _namedtuple_type(kind: str, names: tuple[str, ...]) -> Any:
    """Named tuple type with some of the fields."""
    return namedtuple(kind, names)


def _on_gpu(value: Any) -> Any:
    """Copy arrays, also those in named tuples, to the GPU; fields that are None are omitted."""
    if isinstance(value, np.ndarray):
        from numba import cuda

        return cuda.to_device(np.ascontiguousarray(value))
    if hasattr(value, "_fields"):
        parts = {name: _on_gpu(part) for name, part in value._asdict().items() if part is not None}
        return _namedtuple_type(type(value).__name__, tuple(parts))(**parts)
    return tuple(_on_gpu(part) for part in value) if isinstance(value, tuple) else value
