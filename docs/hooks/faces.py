"""API pages that show everything that a package exports.

The documentation's parser keeps one object for each path, and a module hides a function that has
its name, which then is on no page. In Python the face of the package wins, so it does here.
"""

import importlib
import inspect
import logging
import re
from typing import Any

import griffe

_log = logging.getLogger("mkdocs.hooks.faces")
_SHOWN = re.compile(r"^::: ([\w.]+)", re.MULTILINE)


class Faces(griffe.Extension):
    """Objects that a package exports, in place of its modules of the same names."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Put every such object where its module is.

        Parameters
        ----------
        pkg : griffe.Module
            The package that was read.
        **_ : Any
            Other arguments of the event.
        """
        packages = [pkg, *(each for each in pkg.modules.values() if each.is_init_module)]
        for package in packages:
            for name, path in package.imports.items():
                module = package.members.get(name)
                if module is None or path != f"{package.path}.{name}.{name}":
                    continue
                value = module.members[name]
                # What else is in the module is found by its path, and by going through the package.
                value.members |= module.members
                package.members[f"{name}.py"] = module
                package.set_member(name, griffe.Alias(name, value, parent=package))


def on_page_content(content: str, *, page: Any, **_: Any) -> str:
    """Warn of functions and classes that a page should show and does not.

    Parameters
    ----------
    content : str
        The page, HTML.
    page : mkdocs.structure.pages.Page
        The page's source.
    **_ : Any
        Other arguments of the event.

    Returns
    -------
    str
        The page as it is.
    """
    for path in _SHOWN.findall(page.markdown or ""):
        module = importlib.import_module(path)
        for name in getattr(module, "__all__", ()):
            value = getattr(module, name)
            documented = inspect.isfunction(value) or isinstance(value, type)
            if documented and f'id="{path}.{name}"' not in content:
                _log.warning("%s: %s.%s is exported and not shown", page.file.src_uri, path, name)
    return content
