"""What a file on the command line holds."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from functools import wraps
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast, get_type_hints

import typer

if TYPE_CHECKING:
    import xarray as xr

    from vibrissa.contacts import ContactMap
    from vibrissa.whisker import Whisker
    from vibrissa.whisker.section import Properties

_RAT = Annotated[
    str | None,
    typer.Option(
        "--rat",
        help="Radii of the whisker of a file by published regressions: row and column of a rat's "
        "whisker, such as C2, or any, where only its length is known.",
        metavar="NAME",
    ),
]
_ANY_LENGTH = Annotated[
    bool,
    typer.Option(
        "--any-length", help="A whisker shorter than 0.5 mm or longer than 0.5 m is meant."
    ),
]
_NOTHING: Mapping[str, Any] = MappingProxyType({})
_stated: ContextVar[Mapping[str, Any]] = ContextVar("stated of a whisker", default=_NOTHING)
"""Keywords of `load_whisker` that the verb was called with."""

Verb = TypeVar("Verb", bound=Callable[..., None])


def about_whisker(verb: Verb) -> Verb:
    """Give a verb that reads a whisker the options on what its file does not state."""

    @wraps(verb)
    def wrapped(*args: Any, rat: str | None, any_length: bool, **others: Any) -> None:
        about = [others[name] for name in ("whisker", "length") if name in others]
        if (rat is not None or any_length) and about and all(one is None for one in about):
            raise ValueError("--rat and --any-length are about a --whisker, and none is given")
        before = _stated.set({"rat": rat, "any_length": any_length})
        try:
            verb(*args, **others)
        finally:
            _stated.reset(before)

    keyword = inspect.Parameter.KEYWORD_ONLY
    new = [
        inspect.Parameter("rat", keyword, default=None, annotation=_RAT),
        inspect.Parameter("any_length", keyword, default=False, annotation=_ANY_LENGTH),
    ]
    hints = get_type_hints(verb, include_extras=True)
    own = inspect.signature(verb).parameters.values()
    wrapped.__annotations__ = hints | {one.name: one.annotation for one in new}
    wrapped.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [*(one.replace(annotation=hints[one.name]) for one in own), *new]
    )
    return cast(Verb, wrapped)


def stated() -> Properties:
    """Say what ``--rat`` and ``--any-length`` state."""
    return cast("Properties", dict(_stated.get()))


def refuse_stated(path: Path | None) -> None:
    """Raise where ``--rat`` or ``--any-length`` is given for what is not a file of a whisker."""
    if any(_stated.get().values()):
        raise ValueError(f"--rat and --any-length are about a whisker, and {path} is not its file")


def whisker_from(path: Path | None) -> Whisker:
    """Read a whisker from a CSV centreline, a map or a recording; the γ whisker by default."""
    from vibrissa import samples
    from vibrissa.io import is_netcdf, kind_of, load_recording, load_whisker

    if path is None:
        return samples.gamma()
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    if not is_netcdf(path):
        return load_whisker(path, **stated())
    kind, rat = kind_of(path), _stated.get().get("rat")
    if kind == "vibrissa recording":
        from vibrissa.recording import Recording

        whisker = Recording(load_recording(path)).whisker()
        return whisker if rat is None else whisker.with_properties(rat=rat)
    if kind == "vibrissa contact map":
        whisker = map_from(path).whisker
        return whisker if rat is None else whisker.with_properties(rat=rat)
    raise ValueError(f"{path} holds {kind or 'data of another kind'}, and no whisker")


def tell_notes(*whiskers: Whisker) -> None:
    """Print what is assumed about whiskers, and all else that their user should know."""
    from vibrissa.cli.terminal import errors

    for note in dict.fromkeys(note for whisker in whiskers for note in whisker.notes):
        errors.print(f"note: {note}", highlight=False, markup=False, soft_wrap=True)


def map_from(path: Path) -> ContactMap:
    """Read a map."""
    from vibrissa.contacts import ContactMap

    return ContactMap.load(path)


def wrench_from(path: Path) -> tuple[xr.Dataset, Whisker | None]:
    """Read force and moment over time from a table of signals or a recording."""
    from vibrissa.io import is_netcdf, kind_of, load_recording, load_signals

    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    if not (is_netcdf(path) and kind_of(path) == "vibrissa recording"):
        return load_signals(path), None
    from vibrissa.recording import Recording

    recording = load_recording(path)
    if not {"force", "moment"} <= set(recording.data_vars):
        raise ValueError(f"{path} is a recording without force and moment")
    wrench = recording.to_dataset()[["force", "moment"]]
    if wrench.sizes["whisker"] != 1:
        raise ValueError(f"{path} is a recording of {wrench.sizes['whisker']} whiskers, not of one")
    return wrench.isel(whisker=0), Recording(recording).whisker()
