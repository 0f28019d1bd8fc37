"""Cache of compiled kernels on disk, and messages about compilation.

Numba identifies a cached kernel by its own file alone, and would continue to use it after a change
of a function in another file that is inlined into it. Here the key includes all files with kernels
of the same package, and of ``numerics``, ``rod`` and ``signals``, whose functions others use. They
are identified by content, because the modification time used by numba does not identify a copy.

Results must not depend on the cache. A truncated or altered file is ignored: each begins with its
SHA-256, because incomplete machine code would not be detected otherwise. If nothing can be written,
as on a full disk, kernels are compiled in each run.

Compilation is mostly Python code, which uses one core. If several kernels that do not call each
other are needed and not cached, another interpreter compiles some of them into the cache, from
which this process loads them when it needs them (`compile_together`). The helper has no other
effects; kernels that it does not finish are compiled here.
"""

from __future__ import annotations

import atexit
import gc
import hashlib
import io
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, cast

from numba.core import event, types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.runtime.nrt import rtsys

from vibrissa.numerics.arrays import Call, threads

_ROOT = Path(__file__).parents[1]
_SHARED = tuple(_ROOT / name for name in ("numerics", "rod", "signals"))
_DIGEST = hashlib.sha256().digest_size


@cache
def _source_digest(package: Path) -> str:
    """Hash of all files with kernels in a package and the shared packages."""
    digest = hashlib.sha256()
    for path in sorted(path for folder in {package, *_SHARED} for path in folder.rglob("*.py")):
        source = path.read_bytes()
        # Written such that this file, which has no kernels, does not match itself.
        if any(
            b"@" + name in source
            for name in (b"kernel", b"shared", b"specialised", b"vectorised", b"inlined")
        ):
            digest.update(source)
    return digest.hexdigest()


class _Files(IndexDataCacheFile):
    """Cache with one file per signature, named by its key and containing it.

    Numba numbers the files and writes an index first. If two processes save at once, or one is
    stopped in between, the index refers to code of another signature, which would be run.
    """

    def save(self, key: object, data: object) -> None:
        """Save data with their key."""
        self._save_data(self._name(key), (key, data))  # type: ignore[no-untyped-call]

    def load(self, key: object) -> Any:
        """Load the data saved with a key; None if the file is damaged or has another key."""
        content = Path(self._data_path(self._name(key))).read_bytes()  # type: ignore[no-untyped-call]
        digest, kept = content[:_DIGEST], io.BytesIO(content[_DIGEST:])
        whole = hashlib.sha256(kept.getbuffer()).digest() == digest
        return pickle.load(kept) if whole and pickle.load(kept) == key else None

    def holds(self, key: object) -> bool:
        """Whether there is a file for a key, intact or not."""
        return Path(self._data_path(self._name(key))).exists()  # type: ignore[no-untyped-call]

    def _name(self, key: object) -> str:
        number = int.from_bytes(hashlib.sha256(repr(key).encode()).digest()[:8])
        return str(self._data_name(number))  # type: ignore[no-untyped-call]

    def _dump(self, obj: tuple[object, object]) -> bytes:
        content = b"".join(map(super()._dump, obj))
        return hashlib.sha256(content).digest() + content


class Called:
    """Kernel that others call by its name in machine code, compiled for some types."""

    def __init__(self, function: Callable[..., object], compiled: Any) -> None:
        self._module, self._function = function.__module__, function.__name__
        self._types, self._name = compiled.signature.args, compiled.fndesc.llvm_func_name

    def prepare(self) -> None:
        """Load or compile it; a call of a name that is not in the process would crash."""
        kernel: Any = getattr(import_module(self._module), self._function)
        kernel.compile(self._types)
        name = kernel.overloads[self._types].fndesc.llvm_func_name
        if name != self._name:
            raise LookupError(f"{self._function} is called {name}, not {self._name}")


class _Linked(CompileResultCacheImpl):
    """Form in which compiled functions are kept: together with what they call."""

    def reduce(self, cres: Any) -> object:
        """Return what can be pickled.

        Environments of inlined functions are omitted if they hold no objects, as those of compiled
        code without Python objects do: loading one would import the module of its function.
        """
        *kept, environments = super().reduce(cres)  # type: ignore[no-untyped-call]
        held = tuple(environment for environment in environments if environment.consts)
        return cres.library.calls, (*kept, held)

    def rebuild(self, target_context: object, payload: tuple[Any, Any]) -> object:
        """Load a function after those it calls."""
        calls, kept = payload
        for called in calls:
            called.prepare()
        return super().rebuild(target_context, kept)  # type: ignore[no-untyped-call]


class PackageCache(FunctionCache):
    """Cache of a compiled function, valid as long as the kernels of its package are unchanged."""

    _impl_class = _Linked
    _warned = False

    def __init__(self, function: object) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._cache_file.__class__ = _Files

    def _index_key(self, sig: object, codegen: object) -> tuple[object, ...]:
        package = Path(self._py_func.__code__.co_filename).parent
        while _ROOT in package.parents and package.parent != _ROOT:  # a folder of the package
            package = package.parent
        return (*super()._index_key(sig, codegen), _source_digest(package))  # type: ignore[no-untyped-call]

    def holds(self, sig: object, codegen: object) -> bool:
        """Whether there is a file for a signature."""
        files = cast("_Files", self._cache_file)
        return files.holds(self._index_key(sig, codegen))

    def load_overload(self, sig: object, target_context: object) -> Any:
        """Load a compiled function; None if there is no usable one.

        Numba would first import all that it can compile, which takes longer than loading.
        """
        try:
            self._await_helper(sig, target_context)
            rtsys.initialize(target_context)
            return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except Exception:
            return None

    def _await_helper(self, sig: object, target_context: Any) -> None:
        """Wait for a helper that compiles this, within limits."""
        function = self._py_func
        asked, helper = _asked.pop((function.__module__, function.__name__, sig), (0.0, None))
        if helper is None:
            return
        now, codegen = time.monotonic(), target_context.codegen()
        until = now + _PATIENCE * (now - asked) + _AT_LEAST
        while helper.poll() is None and not self.holds(sig, codegen):
            if time.monotonic() > until:
                _end(helper)
            time.sleep(_INTERVAL)

    def save_overload(self, sig: object, data: object) -> None:
        """Save a compiled function if possible; warn once if not."""
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except (OSError, pickle.PickleError) as fault:
            if not PackageCache._warned:
                PackageCache._warned = True
                _write_message(
                    f"compiled kernels cannot be kept and are compiled in each run: {fault}"
                )


class _FirstCompilation(event.Listener):
    """Listener that reports compilation once per verb, or in a library once per package."""

    def __init__(self) -> None:
        self.reported: set[str] = set()

    def on_start(self, event: event.Event) -> None:
        dispatcher = (event.data or {}).get("dispatcher")
        module = getattr(getattr(dispatcher, "py_func", None), "__module__", "") or ""
        package = ".".join(module.split(".")[:2])
        verb = _verb()
        what = f"for `{verb}`" if verb else f"of {package}"
        if module.startswith("vibrissa.") and what not in self.reported:
            self.reported.add(what)
            _write_message(
                f"compiling kernels {what} (once for this installation, a minute or two) ..."
            )

    def on_end(self, event: event.Event) -> None:
        pass


def _verb() -> str:
    """Verb of the command line with which this process was called; empty in a library."""
    if "vibrissa.cli.app" not in sys.modules:
        return ""
    return next((word for word in sys.argv[1:] if not word.startswith("-")), "")


def _write_message(sentence: str) -> None:
    """Write a message to standard error."""
    sys.stderr.write(f"vibrissa: {sentence}\n")
    sys.stderr.flush()


event.register("numba:compile", _FirstCompilation())

# The helper gets this process's search path, so that it imports the same sources. It ends at once:
# freeing its memory piece by piece would take half a second.
_HELPER = (
    "import os, pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "from vibrissa.numerics.kernel_cache import compile_listed; compile_listed(sys.stdin.buffer); "
    "os._exit(0)"
)
# Longest wait for a helper: this many times the time since it was asked, plus this many seconds;
# and the interval at which its results are looked for, s.
_PATIENCE, _AT_LEAST, _INTERVAL = 1.0, 10.0, 0.01
#: What helpers compile (module, name, types of the arguments): when they were asked, and which.
_asked: dict[tuple[object, ...], tuple[float, subprocess.Popen[bytes]]] = {}
_lock = threading.Lock()


def compile_together(here: list[Call], there: list[Call]) -> None:
    """Compile kernels that will be called, ``here`` in this process and ``there`` in a helper.

    Does not wait for the helper: who calls a kernel does. Does nothing if there is nothing to gain:
    kernels have been used or are cached, there is one core, or the helper could not hand over its
    results.
    """
    if any(kernel.overloads for kernel, _ in there):  # type: ignore[attr-defined]
        return
    with _lock:
        others, mine = _not_cached(there), _not_cached(here)
        if mine and (_leave(others) if others else _asked):
            with _without_collection():
                for kernel, signature in mine:
                    kernel.compile(signature)


def _leave(calls: list[tuple[Any, tuple[types.Type, ...]]]) -> bool:
    """Leave kernels to a helper, if there can be one."""
    names = [_name(kernel) for kernel, _ in calls]
    if threads() < 2 or not _runs_python() or any(name is None for name in names):
        return False
    if (helper := _start_helper(calls)) is None:
        return False
    atexit.register(_end, helper)
    for name, (_, signature) in zip(names, calls, strict=True):
        _asked[*cast("tuple[str, str]", name), signature] = time.monotonic(), helper
    return True


@contextmanager
def _without_collection() -> Iterator[None]:
    """Collect no garbage, which takes a tenth of the time of compilation."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _end(helper: subprocess.Popen[bytes]) -> None:
    """End a helper."""
    helper.kill()
    helper.wait()


def compile_listed(file: BinaryIO) -> None:
    """Compile the kernels listed in a file into the cache; run by the helper."""
    with _without_collection():
        for module, name in pickle.load(file):
            kernel = getattr(import_module(module), name)
            kernel.compile(pickle.load(file))


def _not_cached(calls: list[Call]) -> list[tuple[Any, tuple[types.Type, ...]]]:
    """Kernels neither cached nor left to a helper, with the types of their arguments."""
    found = []
    for call, arguments in calls:
        kernel: Any = call
        signature = tuple(
            one if isinstance(one, types.Type) else kernel.typeof_pyval(one) for one in arguments
        )
        cache, codegen = kernel._cache, kernel.targetctx.codegen()
        # Without a writable folder numba uses another kind of cache.
        left = (*(_name(kernel) or ()), signature) in _asked
        if isinstance(cache, PackageCache) and not (left or cache.holds(signature, codegen)):
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
            # Numba composes messages, which nobody reads, also where it tries something in vain.
            env=os.environ | {"NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"},
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
