"""A controller as its driver shows it: bit rate and states."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from serial_adapter import SerialAdapter
from waiting import wait_until

from canprobe.bus.clock import MonotonicClock
from canprobe.bus.link import LinkState, read_link, setting_line
from canprobe.bus.open import open_port
from canprobe.cli import main
from canprobe.errors import InterfaceError

pytestmark = pytest.mark.vcan
MakeAdapter = Callable[..., SerialAdapter]


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
    assert read_link(name) == LinkState(
        name, "can", True, 20, 250_000, restart_ms=0, state="ERROR-ACTIVE", bus_errors=0, bus_offs=0
    )


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
