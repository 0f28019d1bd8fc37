"""Check the docstrings of everything public in vibrissa against the numpydoc standard.

Public is a name without a leading underscore in a module without one, and the methods and
properties of such a class. What a package exports by name in its ``__init__``, and what a module
that ``vibrissa`` itself exports defines, is its face and describes every parameter and what it
returns. Elsewhere a summary will do. The objects
themselves are looked at rather than their source, so that the parameters of a dataclass and of a
named tuple are its fields, which it may describe under Attributes too. An enumeration has no
parameters to describe, and a compiled kernel is called by our own code only. What describes a
parameter or a result begins with a noun, everywhere.
"""

import dataclasses
import enum
import importlib
import inspect
import pkgutil
import re
import sys
from collections.abc import Iterator, Mapping

from numpydoc.docscrape import Parameter, get_doc_object
from numpydoc.validate import validate

import vibrissa

CHECKS = {
    "GL01",  # text on the first line
    "GL03",  # no double blank lines
    "GL06",  # no unknown sections
    "GL07",  # sections in order
    "GL08",  # there is one
    "SS03",  # the summary ends with a period
    "SS06",  # and fits on a line
    "PR01",  # every parameter
    "PR02",  # no other
    "PR03",  # in order
    "PR04",  # with a type
    "PR07",  # and a meaning
    "PR10",  # blanks around the colon
    "RT01",  # what is returned
    "YD01",  # what is yielded
}
PARAMETERS = {"PR01", "PR02", "PR03"}
SUMMARY = {"GL08", "SS03", "SS06"}
NO_NOUN = re.compile(
    "(about|after|as|before|by|for|from|how|in|instead|it|its|of|on|only|see|that|their|they|this"
    "|those|to|under|what|when|where|which|who|with|without)\\b",
    re.IGNORECASE,
)
"""Words with which no description of a parameter begins: it names the thing, with a noun."""


def modules() -> Iterator[str]:
    """Names of all public modules."""
    yield "vibrissa"
    for module in pkgutil.walk_packages(vibrissa.__path__, "vibrissa."):
        if not any(part.startswith("_") for part in module.name.split(".")):
            yield module.name


def members(cls: type) -> Iterator[tuple[str, object]]:
    """Public methods and properties that a class itself defines."""
    for name, member in vars(cls).items():
        if name.startswith("_"):
            continue
        if isinstance(member, classmethod | staticmethod):
            member = member.__func__
        if inspect.isfunction(member) or isinstance(member, property):
            yield name, member


def exported() -> Iterator[object]:
    """Everything on the face of a package or of a module directly under vibrissa."""
    for name in modules():
        module = importlib.import_module(name)
        face = name.removeprefix("vibrissa.") in vibrissa.__all__
        if hasattr(module, "__path__") or (face and hasattr(module, "__all__")):
            yield from (getattr(module, key) for key in getattr(module, "__all__", ()))
        elif face:
            own = (v for v in vars(module).values() if getattr(v, "__module__", None) == name)
            yield from own


def public(module_name: str) -> Iterator[tuple[str, object, object]]:
    """Name, object and owner of the public functions, kernels, classes, methods of a module."""
    module = importlib.import_module(module_name)
    for name, value in vars(module).items():
        own = getattr(value, "__module__", None) == module_name
        if name.startswith("_") or not own or getattr(value, "__name__", None) != name:
            continue
        yield f"{module_name}.{name}", value, value
        if inspect.isclass(value):
            for member_name, member in members(value):
                yield f"{module_name}.{name}.{member_name}", member, value


def field_names(cls: type) -> set[str]:
    """Fields of a dataclass or of a named tuple; none of another class."""
    if dataclasses.is_dataclass(cls):
        return {f.name for f in dataclasses.fields(cls) if f.init and not f.name.startswith("_")}
    return set(getattr(cls, "_fields", ()))


def described(doc: Mapping[str, list[Parameter]]) -> set[str]:
    """Names under Parameters and Attributes."""
    rows = [*doc["Parameters"], *doc["Attributes"]]
    return {name.strip() for row in rows for name in row.name.split(",")}


def field_faults(cls: type, doc: Mapping[str, list[Parameter]]) -> Iterator[tuple[str, str]]:
    """Fields that neither a class nor its bases describe, and parameters that are not fields.

    Other Parameters are left out: they are those that its constructors share.
    """
    fields = field_names(cls)
    bases = [get_doc_object(base) for base in cls.__mro__[1:] if field_names(base)]
    if missing := fields - described(doc).union(*map(described, bases)):
        yield "PR01", f"Fields {sorted(missing)} not documented"
    parameters = {name.strip() for row in doc["Parameters"] for name in row.name.split(",")}
    if parameters - fields:
        yield "PR02", f"Unknown parameters {sorted(parameters - fields)}"


def noun_faults(doc: Mapping[str, list[Parameter]]) -> Iterator[tuple[str, str]]:
    """Descriptions that do not begin with what the thing is."""
    for section in ("Parameters", "Other Parameters", "Attributes", "Returns", "Yields"):
        for row in doc[section]:
            if found := NO_NOUN.match(" ".join(row.desc)):
                yield "NOUN", f"{section}, {row.name or row.type}: begins with {found[0]!r}"


def faults(value: object, on_face: bool) -> Iterator[tuple[str, str]]:
    """Code and message of every fault in one docstring."""
    function = getattr(value, "py_func", value)  # a compiled kernel keeps what it was made from
    doc = get_doc_object(function)
    yield from noun_faults(doc)
    checks = CHECKS
    if function is not value or isinstance(value, property) or not on_face:
        checks = SUMMARY
    elif inspect.isclass(value) and issubclass(value, enum.Enum | BaseException):
        checks = CHECKS - PARAMETERS
    elif inspect.isclass(value) and field_names(value):
        checks = CHECKS - PARAMETERS
        yield from field_faults(value, doc)
    for code, message in validate(doc)["errors"]:
        if code in checks:
            yield code, message


def main() -> int:
    """Print every fault; the exit status says whether there was one."""
    count = objects = 0
    face = {id(value) for value in exported()}
    for module in modules():
        for name, value, owner in public(module):
            objects += 1
            for code, message in faults(value, id(owner) in face):
                count += 1
                print(f"{name}: {code} {message}")
    print(f"{objects} docstrings, {count} faults")
    return int(count > 0)


if __name__ == "__main__":
    sys.exit(main())
