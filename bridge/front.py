"""The public side of a server for browsers: it checks who asks before the server hears of it.

A page of any website can open a WebSocket to an address of this machine, and the browser sends it along: only the
headers `Origin` and `Host` show whose page it is. Neither the Foxglove SDK nor viser checks them or has a hook for
that. So the server listens on an address of the loopback network that is drawn by chance, where no page finds it, and
this front on the address that is announced. It reads the head of a request, answers 403 or hands the bytes on, and then
carries them both ways. One connection carries one request: both servers close it after an answer that is no WebSocket.

- `Host` names an address, this machine, or what the scene allows. A name that an attacker's DNS points to this machine
  (DNS rebinding) is neither; an address needs no DNS.
- `Origin` is on the same host as `Host`, or the scene or the bridge allows it. Programs other than browsers send none.

Source: RFC 6454, 7.2 and 7.3; RFC 6455, 10.2; RFC 9112, 3.2.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import secrets
import socket
import threading
from collections.abc import Collection
from urllib.parse import urlsplit

MAX_HEAD_BYTES, MAX_HEAD_S = 1 << 14, 10.0
"""Largest head of a request, and longest time in which it comes."""
_CHUNK_BYTES = 1 << 16


def hidden_address() -> str:
    """An address of the loopback network, one of sixteen million, for a server behind a front."""
    return str(ipaddress.IPv4Address("127.0.0.0") + 256 + secrets.randbelow((1 << 24) - 512))


class Front:
    """Listens at once; `forward_to` starts to serve.

    Args:
        host, port: public address; port 0: the system chooses.
        origins: further origins that the scene allows, and with them their hosts.
        own_origins: origins from which the server's own pages come; their hosts are no names of this machine.

    Attributes:
        port: public port.

    Raises:
        OSError: the address is taken, or does not belong to this machine.
    """

    def __init__(self, host: str, port: int, origins: Collection[str] = (), own_origins: Collection[str] = ()) -> None:
        family = min(info[0] for info in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM))  # IPv4 before IPv6
        self._socket = socket.create_server((host, port), family=family)
        self.port = int(self._socket.getsockname()[1])
        self._origins = frozenset(origin.lower() for origin in (*origins, *own_origins))
        here = socket.gethostname().lower()
        allowed = map(_name, self._origins - {*own_origins})
        self._hosts = {host.lower(), here, f"{here.partition('.')[0]}.local", *allowed}
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread: threading.Thread | None = None

    def forward_to(self, host: str, port: int) -> None:
        """Serve from now on, by the server on this address."""
        self._thread = threading.Thread(target=self._loop.run_until_complete, args=(self._serve(host, port),))
        self._thread.daemon = True
        self._thread.start()

    def close(self) -> None:
        """End all connections."""
        if self._thread is not None:
            self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join()
        self._socket.close()
        self._loop.close()

    def refusal(self, head: bytes) -> str | None:
        """Why a request with this head is refused, or None.

        Args:
            head: request line and header fields, with the empty line behind them.
        """
        found: dict[str, list[str]] = {"host": [], "origin": []}
        for line in head.decode("latin-1").split("\r\n")[1:-2]:
            name, colon, value = line.partition(":")
            if not colon or not name or name != name.strip():
                return f"expected a header field, got {line!r}"
            if name.lower() in found:
                found[name.lower()].append(value.strip().lower())
        if len(found["host"]) != 1 or len(found["origin"]) > 1:
            return "expected one Host and at most one Origin"
        host, origin = _name(f"//{found['host'][0]}"), next(iter(found["origin"]), None)
        if host is None or not (_address(host) is not None or _is_local(host) or host in self._hosts):
            return f"Host {found['host'][0]} is not this machine; bridge.origins allows further ones"
        if origin is None or origin in self._origins:
            return None
        of_origin = _name(origin)
        if of_origin is not None and (of_origin == host or (_is_local(of_origin) and _is_local(host))):
            return None
        return f"Origin {origin} may not see the cell; bridge.origins allows further ones"

    async def _serve(self, host: str, port: int) -> None:
        tasks: set[asyncio.Task[None]] = set()

        async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            task = asyncio.current_task()
            assert task is not None
            tasks.add(task)
            try:
                with contextlib.suppress(OSError, EOFError, asyncio.LimitOverrunError):
                    await self._carry(reader, writer, host, port)
                writer.close()
            except asyncio.CancelledError:
                writer.transport.abort()  # its client may have stopped reading
            finally:
                tasks.discard(task)

        async with await asyncio.start_server(connected, sock=self._socket, limit=MAX_HEAD_BYTES) as server:
            await self._stop.wait()
            server.close()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, host: str, port: int) -> None:
        """Check one request, and carry its connection."""
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), MAX_HEAD_S)
        if (why := self.refusal(head)) is not None:
            body = f"refused: {why}\n".encode("latin-1", "replace")
            fields = f"Content-Type: text/plain\r\nContent-Length: {len(body)}\r\nConnection: close"
            writer.write(f"HTTP/1.1 403 Forbidden\r\n{fields}\r\n\r\n".encode() + body)
            await writer.drain()
            return
        behind, into = await asyncio.open_connection(host, port)
        into.write(head)
        ways = [asyncio.create_task(_pump(reader, into)), asyncio.create_task(_pump(behind, writer))]
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)
            into.transport.abort()


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Carry bytes to the end of one side, no faster than the other takes them."""
    while data := await reader.read(_CHUNK_BYTES):
        writer.write(data)
        await writer.drain()


def _name(url: str) -> str | None:
    """The host of an address in lower case; None without one."""
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host)
    return None


def _is_local(host: str) -> bool:
    """Whether this is a name or an address of the loopback interface (RFC 6761: without DNS)."""
    address = _address(host)
    return host == "localhost" or host.endswith(".localhost") if address is None else address.is_loopback
