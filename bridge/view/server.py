"""A viser server behind a front that checks who asks; it writes nothing on stdout and is stopped at the end."""

from __future__ import annotations

import contextlib
import errno
import io
from collections.abc import Collection, Iterator
from typing import Any

from canprobe.errors import InterfaceError, needed_module
from canprobe.lab.bridge.front import Front, hidden_address

_MAX_PORT = 65_535


@contextlib.contextmanager
def open_server(port: int, host: str = "127.0.0.1", origins: Collection[str] = ()) -> Iterator[tuple[Any, str]]:
    """A server for browsers and its address, stopped on leaving.

    Args:
        port: wanted port, or the next free one; 0 lets the system choose.
        host: address to listen on; 0.0.0.0 serves other machines too.
        origins: origins of other hosts whose pages may show the cell.

    Raises:
        UsageError: when viser is not installed.
        InterfaceError: when no port is free.
    """
    viser = needed_module("viser", "view", "the view needs viser; type:")
    with contextlib.closing(_front(port, host, origins)) as front:
        hidden = hidden_address()
        with contextlib.redirect_stdout(io.StringIO()):  # viser greets and leaves with a box on stdout
            server = viser.ViserServer(host=hidden, port=0, label="canprobe", verbose=False)
        try:
            front.forward_to(hidden, server.get_port())
            yield server, f"http://{'localhost' if host == '0.0.0.0' else host}:{front.port}"
        finally:
            with contextlib.redirect_stdout(io.StringIO()):
                server.stop()


def _front(port: int, host: str, origins: Collection[str]) -> Front:
    """A front on this port, or on the next free one."""
    while True:
        try:
            return Front(host, port, origins)
        except OSError as error:
            if error.errno != errno.EADDRINUSE or not 0 < port < _MAX_PORT:
                raise InterfaceError(
                    f"{host}:{port}: no port to show the cell on: {error.strerror or error}"
                ) from error
        port += 1
