"""A controller as its driver shows it: bit rate, states, and a transmit queue that fills while nobody acknowledges."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator

import pytest
from serial_adapter import SerialAdapter
from waiting import wait_until

from canprobe.cell.session.terminal import StepReport
from canprobe.cli import main
from canprobe.errors import InterfaceError
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.port import Reports
from canprobe.fieldbus.bus.real.link import LinkState, read_link, setting_line
from canprobe.fieldbus.bus.real.opening import open_port
from canprobe.fieldbus.bus.real.socketcan import SocketCanPort

pytestmark = pytest.mark.vcan
MakeAdapter = Callable[..., SerialAdapter]
FRAMES = [(0x100 + k, bytes(8)) for k in range(400)]
"""More than a socket's send buffer holds."""
USERS_PATH = "/usr/local/bin:/usr/bin:/bin"
"""As Debian gives it to who is not root."""


@pytest.fixture
def make_adapter(vcan0: str) -> Iterator[MakeAdapter]:
    made: list[SerialAdapter] = []

    def make(**options: int) -> SerialAdapter:
        try:
            made.append(SerialAdapter(**options))
        except OSError as error:
            pytest.skip(f"slcan on a pseudo terminal: {error}")
        return made[-1]

    yield make
    for adapter in made:
        adapter.__exit__()


def test_an_interface_that_is_down_is_set_up_by_the_line_that_is_told(make_adapter: MakeAdapter) -> None:
    adapter = make_adapter(bitrate=250_000, queue=10)
    name = adapter.name
    adapter.set("down")
    with pytest.raises(InterfaceError) as caught:
        open_port("socketcan", name, 500_000, MonotonicClock())
    why, _, line = str(caught.value).partition("; type: ")
    assert (why, line) == (f"{name}: interface is down", setting_line(name, 500_000))
    settings = line.removeprefix("ip link set ").split(" && ip link set ")
    assert settings == [
        f"{name} down",
        f"{name} type can bitrate 500000 sample-point 0.875 restart-ms 100",
        f"{name} txqueuelen 1000 up",
    ]


def test_its_setting_and_its_state_are_read(make_adapter: MakeAdapter) -> None:
    adapter = make_adapter(bitrate=250_000, queue=20)
    name = adapter.name
    assert read_link(name) == LinkState(name, "can", True, 20, 250_000, restart_ms=0, state="ERROR-ACTIVE", bus_offs=0)


@pytest.mark.parametrize(
    ("queue", "what", "permitted"),
    [(10, "the transmit queue stays full", False), (1000, "the socket's send buffer stays full", True)],
)
def test_what_is_full_while_nobody_acknowledges(
    make_adapter: MakeAdapter, monkeypatch: pytest.MonkeyPatch, queue: int, what: str, permitted: bool
) -> None:
    adapter = make_adapter(queue=queue)
    monkeypatch.setenv("PATH", USERS_PATH)
    told: list[str] = []
    port = SocketCanPort(adapter.name, MonotonicClock(), reports=Reports(say=told.append))
    adapter.acknowledge(False)
    with pytest.raises(InterfaceError, match=f"^{adapter.name}: {what}") as caught:
        port.send_batch(FRAMES)
    assert ("type: ip link set" in str(caught.value)) is (queue == 10)
    if not permitted:
        monkeypatch.setattr("canprobe.fieldbus.bus.real.link.drop_queued", lambda _: False)
    port.close()
    (line,) = told
    if not permitted:
        assert line.startswith(f"{adapter.name}: frames wait in its transmit queue that nobody acknowledges")
        assert line.endswith(f"type: ip link set {adapter.name} down && ip link set {adapter.name} up")
        return
    assert line == f"{adapter.name}: frames that nobody acknowledged were dropped from its transmit queue"
    adapter.acknowledge(True)
    later = SocketCanPort(adapter.name, MonotonicClock())
    later.send_batch([(0x7FF, b"")])
    wait_until(lambda: 0x7FF in adapter.frames, lambda: True, str)
    assert len(adapter.frames) <= 3, "what the controller held, and no more"
    later.close()


@pytest.mark.parametrize("queue", [10, pytest.param(1000, marks=pytest.mark.slow(reason="a longer queue"))])
def test_a_device_waits_for_its_bus_and_leaves_nothing_behind(make_adapter: MakeAdapter, queue: int) -> None:
    adapter = make_adapter(queue=queue)
    told: list[str] = []

    def say(line: str) -> None:
        told.append(line)
        adapter.acknowledge(True)

    port = SocketCanPort(adapter.name, MonotonicClock(), waits=True, reports=Reports(say=say))
    adapter.acknowledge(False)
    port.send_batch(FRAMES)
    port.close()
    (line,) = told
    assert "stays full, as nobody acknowledges or the bus is overloaded: waiting for the bus" in line
    wait_until(lambda: len(adapter.frames) >= len(FRAMES), lambda: True, str)  # the terminal held some
    assert adapter.frames == [can_id for can_id, _ in FRAMES]


def test_emulated_nodes_wait_for_their_bus_until_ctrl_c(
    make_adapter: MakeAdapter, monkeypatch: pytest.MonkeyPatch
) -> None:
    adapter = make_adapter(queue=1)
    adapter.acknowledge(False)
    told: list[str] = []

    def say(_: StepReport, line: str) -> None:
        told.append(line)
        if "waiting for the bus" in line:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(StepReport, "say", say)
    nodes = [word for n in range(1, 7) for word in ("--eds", "puma260_joint", "--node-id", str(n))]
    assert main(["emulate", *nodes, "--channel", adapter.name]) == 0
    assert told[-1] == f"{adapter.name}: frames that nobody acknowledged were dropped from its transmit queue"


def test_a_scan_that_nobody_acknowledges_says_so(make_adapter: MakeAdapter, capsys: pytest.CaptureFixture[str]) -> None:
    adapter = make_adapter()
    name = adapter.name
    adapter.acknowledge(False)
    adapter.tell_state("p", 128, 0)
    wait_until(lambda: read_state(name) == "ERROR-PASSIVE", lambda: True, str)
    assert main(["scan", "--channel", name]) == 3
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith(f"canprobe: {name}: its CAN controller is error-passive: nobody acknowledges what it sends")
    assert line.endswith(f"then type: ip link set {name} down && ip link set {name} up")


def read_state(name: str) -> str | None:
    link = read_link(name)
    return link.state if link is not None else None
