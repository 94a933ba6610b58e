"""Who may ask the servers for browsers: real handshakes with good, bad and missing headers, at both of them."""

from __future__ import annotations

import contextlib
import re
import socket
from dataclasses import replace
from pathlib import Path

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import canprobe
from canprobe.cell.scene.load import parse_scene
from canprobe.cell.scene.model import BridgeSettings
from canprobe.errors import SceneError
from canprobe.lab.bridge.front import Front, hidden_address
from canprobe.lab.bridge.process import BridgeProcess

LAB = "https://viewer.lab.example:8443"


@pytest.fixture(scope="module")
def served():
    """Ports of a Foxglove server and a 3-D view, by name: of the cell as it is, and with a further origin."""
    scene = canprobe.load_scene("free")
    with contextlib.ExitStack() as stack:
        ports = {}
        for widened in (False, True):
            bridge = BridgeSettings(foxglove_port=0, view_port=0, origins=(LAB,) if widened else ())
            plan = canprobe.plan(replace(scene, bridge=bridge))
            for name in ("foxglove", "view"):
                one = BridgeProcess(name, plan, None, virtual=True)
                stack.callback(one.kill)
                ports[name, widened] = int(re.match(r"\w+://127\.0\.0\.1:(\d+)", one.await_ready())[1])
        yield ports


def handshake(port, name, host, origin):
    """Status of a WebSocket handshake, and the body of a refusal."""
    subprotocols = ["foxglove.sdk.v1"] if name == "foxglove" else ["viser-v1.1.1"]
    try:
        with (
            socket.create_connection(("127.0.0.1", port)) as sock,
            connect(f"ws://{host}/", sock=sock, origin=origin, subprotocols=subprotocols, proxy=None),
        ):
            return 101, ""
    except InvalidStatus as error:
        return error.response.status_code, error.response.body.decode()


def status(port, request):
    """Status that a request gets, byte by byte as written; None where the connection just ends."""
    with socket.create_connection(("127.0.0.1", port), 10) as sock:
        sock.sendall(request)
        answer = sock.makefile("rb").readline().split()
    return int(answer[1]) if answer else None


SAME = ["localhost:1", "127.0.0.1:1", "127.3.4.5", "[::1]:1", "cell.localhost", "LocalHost", socket.gethostname()]
FOREIGN_HOSTS = ["evil.example", "evil.example:8765", "localhost.evil.example", "127.0.0.1.evil.example", "localhostx"]
FOREIGN_ORIGINS = [
    *("http://evil.example", "https://localhost.evil.example", "http://127.0.0.1.evil.example", "http://10.1.2.3"),
    *("https://app.foxglove.dev.evil.example", "http://app.foxglove.dev", "https://foxglove.dev", "null"),
]
FOXGLOVES = ["https://app.foxglove.dev", "https://studio.foxglove.dev", "https://embed.foxglove.dev", "file://"]


@pytest.mark.parametrize("name", ["foxglove", "view"])
def test_who_may_connect(name, served):
    port = served[name, False]
    for host in (*SAME, "192.168.7.7:8765"):  # a page cannot give itself an address, only a name
        assert handshake(port, name, host, None)[0] == 101, host
        assert handshake(port, name, host, f"http://{host}")[0] == 101, host
        assert handshake(port, name, host, "http://evil.example")[0] == 403, host
    assert handshake(port, name, "127.0.0.1", "http://localhost:3000")[0] == 101
    for host in FOREIGN_HOSTS:  # the name that a rebound page was loaded by, which is its origin too
        for origin in (None, f"http://{host}", *FOXGLOVES):
            code, why = handshake(port, name, host, origin)
            assert (code, why) == (
                403,
                f"refused: Host {host} is not this machine; bridge.origins allows further ones\n",
            )
    for origin in FOREIGN_ORIGINS:
        code, why = handshake(port, name, "localhost", origin)
        assert (code, why) == (
            403,
            f"refused: Origin {origin} may not see the cell; bridge.origins allows further ones\n",
        )
    for origin in FOXGLOVES:
        assert handshake(port, name, "localhost:8765", origin)[0] == (101 if name == "foxglove" else 403), origin


@pytest.mark.parametrize("name", ["foxglove", "view"])
def test_the_scene_allows_further_origins_and_their_hosts(name, served):
    for port, code in ((served[name, False], 403), (served[name, True], 101)):
        assert handshake(port, name, "localhost", LAB)[0] == code
        assert handshake(port, name, "viewer.lab.example", LAB)[0] == code
        assert handshake(port, name, "localhost", "https://viewer.lab.example")[0] == 403  # another port
        assert handshake(port, name, "app.foxglove.dev", "https://app.foxglove.dev")[0] == 403


@pytest.mark.parametrize(
    ("head", "code"),
    [
        ("GET / HTTP/1.1\r\n\r\n", 403),
        ("GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n", 403),
        ("GET / HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\nOrigin: http://evil.example\r\n\r\n", 403),
        ("GET / HTTP/1.1\r\nHost : localhost\r\n\r\n", 403),
        ("GET / HTTP/1.1\r\nHost: localhost\r\n Origin: http://evil.example\r\n\r\n", 403),
        ("GET / HTTP/1.1\r\nHost: \r\n\r\n", 403),
        ("GET / HTTP/1.1\r\nHost: [::1\r\n\r\n", 403),
        ("GET / HTTP/1.1\r\nHost: localhost\r\nX: " + 20_000 * "x" + "\r\n\r\n", None),
    ],
    ids=["no host", "two hosts", "two origins", "space", "folded", "empty", "bracket", "long"],
)
def test_a_head_that_could_be_read_in_two_ways_is_refused(head, code, served):
    assert status(served["view", False], head.encode()) == code


def test_pages_are_refused_too_and_come_whole_where_they_are_not(served):
    port = served["view", False]
    assert status(port, b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n") == 403
    with socket.create_connection(("127.0.0.1", port), 10) as sock:
        sock.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        answer = sock.makefile("rb").read()
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 200") and len(body) > 10_000
    assert len(body) == int(re.search(rb"Content-Length: (\d+)", head)[1])


def test_the_servers_themselves_are_on_no_address_that_a_page_could_know(served):
    """Each process listens on its public port and on an address of the loopback network drawn by chance."""
    listening = [line.split()[1:4] for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    addresses = {local.partition(":")[0] for local, _, state in listening if state == "0A"}
    hidden = {address for address in addresses if address.endswith("7F") and address != "0100007F"}
    assert len(hidden) >= len(served)
    assert len({hidden_address() for _ in range(100)}) > 95


def test_a_front_carries_both_ways_to_the_end_and_lets_go():
    """A server that sends 3 MB to a client that reads slowly loses none; an end of the front ends its connections."""
    front = Front("127.0.0.1", 0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(10)
        front.forward_to(*server.getsockname())
        with socket.create_connection(("127.0.0.1", front.port), 10) as client:
            client.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\nbehind")
            with server.accept()[0] as behind:
                behind.settimeout(10)
                got = b""
                while not got.endswith(b"behind"):
                    got += behind.recv(1000)
                assert got == b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\nbehind"
                behind.setblocking(False)
                sent = 0
                with contextlib.suppress(BlockingIOError):
                    while True:
                        sent += behind.send(b"x" * 1000)
            assert sent > 1000
            assert len(client.makefile("rb").read()) == sent
        with socket.create_connection(("127.0.0.1", front.port), 10) as client:
            client.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            with server.accept()[0]:
                front.close()
                with contextlib.suppress(ConnectionResetError):
                    assert client.recv(10) == b""


@pytest.mark.parametrize("origin", ["viewer.lab", "null", "*", "https://viewer.lab/page", "https://a b"])
def test_an_origin_of_the_scene_has_scheme_and_host_alone(origin):
    with pytest.raises(SceneError, match=r"bridge\.origins.*such as \"https://viewer\.lab:8443\""):
        parse_scene(f'[cell]\nname = "free"\n[bridge]\norigins = ["{origin}"]\n')
