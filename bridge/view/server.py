"""A viser server that says nothing on stdout and leaves nothing behind."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from typing import Any

from canprobe.errors import InterfaceError
from canprobe.lab.bridge.database import need


@contextlib.contextmanager
def open_server(port: int, host: str = "127.0.0.1") -> Iterator[Any]:
    """A server for browsers, stopped on leaving.

    Args:
        port: 0 lets the system choose; where it is taken, the next free one.
        host: 0.0.0.0 for other machines too.

    Raises:
        UsageError: viser is not installed.
        InterfaceError: no port can be had.
    """
    viser = need("viser", "view", "the view")
    with contextlib.redirect_stdout(io.StringIO()):  # viser greets and leaves with a box on stdout
        try:
            server = viser.ViserServer(host=host, port=port, label="canprobe", verbose=False)
        except OSError as error:
            raise InterfaceError(f"{host}:{port}: no port to show the cell on: {error.strerror or error}") from error
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def address(server: Any) -> str:
    """Where a browser finds a server."""
    host = server.get_host()
    return f"http://{'localhost' if host == '0.0.0.0' else host}:{server.get_port()}"
