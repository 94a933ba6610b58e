"""A viser server that writes nothing on stdout and is stopped at the end."""

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
        port: wanted port, or the next free one; 0 lets the system choose.
        host: address to listen on; 0.0.0.0 serves other machines too.

    Raises:
        UsageError: when viser is not installed.
        InterfaceError: when no port is free.
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
    """Address of a server for a browser."""
    host = server.get_host()
    return f"http://{'localhost' if host == '0.0.0.0' else host}:{server.get_port()}"
