"""A viser server that says nothing on stdout and leaves nothing behind."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from typing import Any

from canprobe.errors import InterfaceError, UsageError

PIP = "pip install 'canprobe[view]'"
DEFAULT_PORT = 8080


@contextlib.contextmanager
def open_server(port: int, host: str = "127.0.0.1", title: str = "canprobe") -> Iterator[Any]:
    """A server for browsers, stopped on leaving.

    Args:
        port: 0 lets the system choose; where it is taken, the next free one.
        host: 0.0.0.0 for other machines too.
        title: above the panel.

    Raises:
        UsageError: viser is not installed.
        InterfaceError: no port can be had.
    """
    viser = import_viser()
    with contextlib.redirect_stdout(io.StringIO()):  # viser greets and leaves with a box on stdout
        try:
            server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        except OSError as error:
            raise InterfaceError(f"{host}:{port}: no port to show the cell on: {error.strerror or error}") from error
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def import_viser() -> Any:
    """The package, or a `UsageError` with the line that installs it."""
    try:
        import viser
    except ImportError as error:
        raise UsageError(f"the view needs viser: {PIP}") from error
    return viser


def address(server: Any) -> str:
    """Where a browser finds a server."""
    host = server.get_host()
    return f"http://{'localhost' if host == '0.0.0.0' else host}:{server.get_port()}"
