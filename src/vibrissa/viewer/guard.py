"""Who may talk to the page's server: the page itself, and programs that are no browser.

A browser lets every web page, from wherever it is, open a WebSocket to this machine; only the
server can refuse, by the origin that browsers tell. Without that, any page that is open beside this
one could look at a recording and move what is shown.
"""

from __future__ import annotations

import ipaddress
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from vibrissa.viewer.page_script import amended

_ONE_AT_A_TIME = threading.Lock()


def is_loopback(host: str) -> bool:
    """Whether an address or name is that of this machine, for this machine alone."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def from_own_page(origin: str | None, asked: str | None, host: str) -> bool:
    """Tell whether a request comes from a page of this server, or from no browser."""
    if origin is None:
        return True
    try:
        page = urlsplit(origin)
        name = page.hostname
    except ValueError:
        return False
    if not name or asked is None or page.netloc.lower() != asked.lower():
        return False
    return is_loopback(name) or not is_loopback(host)


@contextmanager
def guarded(host: str) -> Iterator[None]:
    """Let servers that start meanwhile refuse pages from elsewhere.

    viser has no place for such a check, so what it calls to listen is wrapped while it starts.
    """
    from websockets.asyncio import server

    module: Any = server
    plain = module.serve
    used = []

    def serve(*args: Any, process_request: Any = None, **options: Any) -> Any:
        used.append(True)

        def checked(connection: Any, request: Any) -> Any:
            headers = request.headers
            if not from_own_page(headers.get("Origin"), headers.get("Host"), host):
                return connection.respond(HTTPStatus.FORBIDDEN, "This is for its own page only.\n")
            if process_request is None:
                return None
            return amended(process_request(connection, request))

        return plain(*args, process_request=checked, **options)

    with _ONE_AT_A_TIME:
        module.serve = serve
        try:
            yield
        finally:
            module.serve = plain
    if not used:
        warnings.warn(
            "with this version of viser, other web pages in this browser can talk to this one",
            UserWarning,
            stacklevel=2,
        )
