"""Where lines come from: a file, pipe or serial device, or UDP datagrams."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

# A datagram holds no more.
_LARGEST = 65535
# Bytes that may wait to be read.
_WAITING = 1 << 22


def file_lines(path: Path) -> Iterator[str]:
    """Read lines as they come, from a file, named pipe or device, until it ends.

    Parameters
    ----------
    path : Path
        A serial device is read as it is set up (``stty``); bytes that are no UTF-8 are replaced.

    Yields
    ------
    str
        A line.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    """
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    with path.open("rb") as file:
        for line in file:
            yield line.decode("utf-8", errors="replace")


def udp_address(text: str) -> tuple[str, int]:
    """Read ``HOST:PORT``.

    Parameters
    ----------
    text : str
        Such as ``127.0.0.1:5005``, or ``:5005`` for all of this machine's addresses.

    Returns
    -------
    host : str
        Empty for all.
    port : int
        Its number.

    Raises
    ------
    ValueError
        If it is something else.
    """
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdigit() or int(port) > 65535:
        raise ValueError(f"an address is HOST:PORT, such as 127.0.0.1:5005; got {text!r}")
    return host.strip("[]"), int(port)


def udp_socket(host: str, port: int) -> socket.socket:
    """Open the socket that `udp_lines` reads.

    Parameters
    ----------
    host : str
        An address of this machine; empty for all.
    port : int
        Number; 0 for any that is free.

    Returns
    -------
    socket
        Bound.

    Raises
    ------
    ValueError
        If it cannot be bound.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    opened = socket.socket(family, socket.SOCK_DGRAM)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _WAITING)  # or what the system allows
    try:
        opened.bind((host, port))
    except OSError as error:
        opened.close()
        raise ValueError(f"no UDP socket at {host or '*'}:{port}: {error}") from error
    return opened


def udp_lines(opened: socket.socket) -> Iterator[str]:
    """Receive lines without end; a datagram holds one or several whole ones.

    Parameters
    ----------
    opened : socket
        Of `udp_socket`.

    Yields
    ------
    str
        A line.
    """
    while True:
        data = opened.recv(_LARGEST)
        yield from data.decode("utf-8", errors="replace").splitlines()
