"""Compiled kernels are kept on disk, and a listener reports compilation.

Numba knows a cached kernel by its own file alone, and would go on using it after a function that it
inlines from another file has changed; here all files with kernels of its own package, and of
``numerics``, ``rod`` and ``signals``, whose helpers others use, are part of the key. By their
content: the time at which a file was written, by which numba knows it, does not identify a copy.

A result must not depend on the cache. A file in it that is not as it was written, whatever cut it
or changed it, counts as none: each has its SHA-256 in front, for machine code that is not whole
would not be noticed otherwise. Where nothing can be written, as on a full disk, kernels are
compiled anew in each run.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import sys
from functools import cache
from pathlib import Path
from typing import Any, cast

from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile

_SHARED = tuple(Path(__file__).parents[1] / name for name in ("numerics", "rod", "signals"))
_DIGEST = hashlib.sha256().digest_size


@cache
def _sources(package: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(path for folder in {package, *_SHARED} for path in folder.glob("*.py")):
        source = path.read_bytes()
        # Written so that this file, which has no kernels, is none of them.
        if any(
            b"@" + name in source for name in (b"kernel", b"specialised", b"vectorised", b"inlined")
        ):
            digest.update(source)
    return digest.hexdigest()


class _Files(IndexDataCacheFile):
    """A file for each signature, named by its key, which it holds; damaged ones count as none.

    Numba numbers files, and writes an index of them first. Where two processes save at once, or one
    is stopped in between, the index names code of another signature, which is run.
    """

    def save(self, key: object, data: object) -> None:
        """Keep data with their key."""
        self._save_data(self._name(key), (key, data))  # type: ignore[no-untyped-call]

    def load(self, key: object) -> Any:
        """Load what was kept with a key; None if that is not what the file holds."""
        content = Path(self._data_path(self._name(key))).read_bytes()  # type: ignore[no-untyped-call]
        digest, kept = content[:_DIGEST], io.BytesIO(content[_DIGEST:])
        whole = hashlib.sha256(kept.getbuffer()).digest() == digest
        return pickle.load(kept) if whole and pickle.load(kept) == key else None

    def holds(self, key: object) -> bool:
        """Whether there is a file of a key, whole or not."""
        return Path(self._data_path(self._name(key))).exists()  # type: ignore[no-untyped-call]

    def _name(self, key: object) -> str:
        number = int.from_bytes(hashlib.sha256(repr(key).encode()).digest()[:8])
        return str(self._data_name(number))  # type: ignore[no-untyped-call]

    def _dump(self, obj: tuple[object, object]) -> bytes:
        content = b"".join(map(super()._dump, obj))
        return hashlib.sha256(content).digest() + content


class PackageCache(FunctionCache):
    """Keeps a compiled function on disk, as long as the kernels of its package are the same."""

    _told = False

    def __init__(self, function: object) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._cache_file.__class__ = _Files

    def _index_key(self, sig: object, codegen: object) -> tuple[object, ...]:
        package = Path(self._py_func.__code__.co_filename).parent
        return (*super()._index_key(sig, codegen), _sources(package))  # type: ignore[no-untyped-call]

    def holds(self, sig: object, codegen: object) -> bool:
        """Whether what was compiled for a signature is on disk."""
        files = cast("_Files", self._cache_file)
        return files.holds(self._index_key(sig, codegen))

    def load_overload(self, sig: object, target_context: object) -> Any:
        """Load what was compiled; None if there is none that can be used."""
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except Exception:
            return None

    def save_overload(self, sig: object, data: object) -> None:
        """Keep what was compiled, if that is possible; say once if it is not."""
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except (OSError, pickle.PickleError) as fault:
            if not PackageCache._told:
                PackageCache._told = True
                _say(f"compiled kernels cannot be kept and are compiled in each run: {fault}")


class _FirstCompilation(event.Listener):
    """Say once for a verb, in a library once a package, that kernels are being compiled."""

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
            _say(f"compiling kernels {what} (once for this installation, a minute or two) ...")

    def on_end(self, event: event.Event) -> None:
        pass


def _verb() -> str:
    """Verb of the command line that this process was called with; nothing in a library."""
    if "vibrissa.cli.app" not in sys.modules:
        return ""
    return next((word for word in sys.argv[1:] if not word.startswith("-")), "")


def _say(sentence: str) -> None:
    sys.stderr.write(f"vibrissa: {sentence}\n")
    sys.stderr.flush()


event.register("numba:compile", _FirstCompilation())
