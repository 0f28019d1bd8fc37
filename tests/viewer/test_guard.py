"""Only the page itself, and programs that are no browser, may talk to its server."""

import gzip
import http.client

import pytest

pytest.importorskip("viser", reason="viser is not installed", exc_type=ImportError)

import vibrissa as vb
from vibrissa.viewer import view
from vibrissa.viewer.save import SCRIPT, with_script
from vibrissa.viewer.server import free_port, from_own_page


@pytest.mark.parametrize(
    ("origin", "asked", "host", "own"),
    [
        (None, "127.0.0.1:8080", "127.0.0.1", True),
        ("http://127.0.0.1:8080", "127.0.0.1:8080", "127.0.0.1", True),
        ("http://localhost:9000", "localhost:9000", "127.0.0.1", True),  # a port that is forwarded
        ("http://[::1]:8080", "[::1]:8080", "::1", True),
        ("http://evil.example", "127.0.0.1:8080", "127.0.0.1", False),
        ("http://127.0.0.1:3000", "127.0.0.1:8080", "127.0.0.1", False),
        (
            "http://evil.example:8080",
            "evil.example:8080",
            "127.0.0.1",
            False,
        ),  # a name made to lead here
        ("http://lab.example:8080", "lab.example:8080", "0.0.0.0", True),
        ("http://evil.example", "lab.example:8080", "0.0.0.0", False),
        ("null", "127.0.0.1:8080", "127.0.0.1", False),
        ("http://[broken", "127.0.0.1:8080", "127.0.0.1", False),
        ("http://127.0.0.1:8080", None, "127.0.0.1", False),
    ],
)
def test_whose_page_it_is(origin, asked, host, own):
    assert from_own_page(origin, asked, host) is own


def answer(viewer, origin):
    """Status of opening the page's socket, as a browser with a page of that origin does."""
    host, port = viewer.page.server.get_host(), viewer.page.server.get_port()
    headers = {
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    } | ({} if origin is None else {"Origin": origin})
    connection = http.client.HTTPConnection(host, port, timeout=30)
    try:
        connection.request("GET", "/", headers=headers)
        return connection.getresponse().status
    finally:
        connection.close()


def test_pages_from_elsewhere_are_refused(capsys):
    with view(vb.samples.gamma()) as viewer:
        assert answer(viewer, "http://evil.example") == 403
        assert answer(viewer, viewer.url) == 101
        assert answer(viewer, None) == 101
        port = viewer.page.server.get_port()
        with pytest.raises(ValueError, match=f"port {port} of 127.0.0.1 is in use"):
            view(vb.samples.gamma(), port=port)


def test_the_page_comes_with_our_script_and_name():
    with view(vb.samples.gamma()) as viewer:
        page = viewer.page.server
        connection = http.client.HTTPConnection(page.get_host(), page.get_port(), timeout=30)
        plain, zipped = [], []
        for pages, headers in ((plain, {}), (zipped, {"Accept-Encoding": "gzip"})):
            connection.request("GET", "/", headers=headers)
            answer = connection.getresponse()
            pages.append(answer.read())
            assert answer.status == 200
            connection.close()
    assert gzip.decompress(zipped[0]) == plain[0]
    assert b"<title>vibrissa</title>" in plain[0][:20_000]
    assert SCRIPT.encode() in plain[0]
    assert with_script(b"no page") == b"no page"


@pytest.mark.parametrize(("host", "port"), [("192.0.2.1", 8080), ("127.0.0.1", 70_000)])
def test_where_no_page_can_be_served_is_said(host, port):
    with pytest.raises(ValueError, match=f"no page can be served at port {port} of {host}"):
        view(vb.samples.gamma(), host=host, port=port)
    if port < 2**16:
        with pytest.raises(ValueError, match="no page can be served"):
            free_port(host)
