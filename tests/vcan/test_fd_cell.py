"""CAN FD on SocketCAN: a vcan of its own with the MTU of FD, so that vcan0 stays as the other tests need it."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rights import type_as_root

from canprobe.errors import InterfaceError
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.real.socketcan import SocketCanPort

pytestmark = pytest.mark.vcan
CHANNEL = "vcanfd0"
FAST = 5_000_000
LONG = bytes(range(64))


def delete(link: str) -> None:
    subprocess.run(["ip", "link", "del", link], capture_output=True, check=False)


@pytest.fixture(scope="module")
def fd_channel() -> Iterator[str]:
    """A vcan that carries CAN FD: ip link set … mtu 72, while it is down."""
    delete(CHANNEL)  # of a test that was killed
    for words in (("add", "dev", CHANNEL, "type", "vcan"), ("set", CHANNEL, "mtu", "72"), ("set", CHANNEL, "up")):
        type_as_root("ip", "link", *words)
    yield CHANNEL
    delete(CHANNEL)


def heard(port: SocketCanPort, count: int) -> list[tuple[int, bytes]]:
    found: list[tuple[int, bytes]] = []
    until = port.clock.now_ns() + 20_000_000_000
    while len(found) < count and port.clock.now_ns() < until:
        port.wait(until)
        found += [frame[:2] for frame in port.drain()]
    return found


def test_long_frames_pass_and_a_classical_socket_is_spared_them(fd_channel: str) -> None:
    clock = MonotonicClock()
    one, two, classic = (SocketCanPort(fd_channel, clock, data_bitrate=fast) for fast in (FAST, FAST, None))
    frames = [(0x181, b"\x01"), (0x512, LONG), (0x513, LONG[:12]), (0x80, b"")]
    try:
        one.send_batch(frames)
        assert heard(two, len(frames)) == frames
        assert heard(classic, 2) == [frames[0], frames[3]]
        with pytest.raises(InterfaceError, match="13 bytes is no CAN or CAN FD frame"):
            one.send_batch([(0x512, LONG[:13])])
    finally:
        for port in (one, two, classic):
            port.close()


def test_deferred_frames_may_be_long_too(fd_channel: str) -> None:
    clock = MonotonicClock()
    one, two = (SocketCanPort(fd_channel, clock, data_bitrate=FAST) for _ in range(2))
    try:
        two.defer([0x512])
        one.send_batch([(0x512, LONG), (0x80, b"\x01")])
        assert heard(two, 2) == [(0x512, LONG), (0x80, b"\x01")]
    finally:
        one.close()
        two.close()


def test_an_interface_without_fd_says_what_to_type(vcan0: str) -> None:
    mtu = int(Path(f"/sys/class/net/{vcan0}/mtu").read_text())
    if mtu >= 72:
        pytest.skip(f"{vcan0} carries CAN FD here")
    with pytest.raises(InterfaceError, match=f"ip link set {vcan0} mtu 72"):
        SocketCanPort(vcan0, MonotonicClock(), data_bitrate=FAST)


@pytest.mark.slow(reason="a touch over CAN FD on a real bus; in lockstep: tests/cell/integration/test_fd_cell.py")
def test_the_full_image_beside_the_arm_in_two_processes(bench: Any, fd_channel: str) -> None:
    scene = bench.scene("press")
    text = scene.read_text().replace("[sensor]\n", '[sensor]\nmode = "image"\neds = "tactile_array_fd.eds"\n')
    scene.write_text(f"{text}\n[bus]\nfd = true\n")
    command = bench.start(
        "run", scene, "--bus", "socketcan", "--channel", fd_channel, "--duration", 1, "--out", "results"
    )
    assert command.end(0) == []
    results = bench.results("results")
    assert results.summary["completed"] is True
    assert results.summary["contact"]["contact_fraction"] == 1.0
    assert results.summary["contact"]["force_max_n"] < 4.0
    long = [frame for frame in results.frames if len(frame[3]) > 8]
    headers = [frame for frame in results.frames if frame[2] == 0x511]
    assert {frame[2] for frame in long} == {0x512, 0x513, 0x514, 0x515}
    assert {len(frame[3]) for frame in long} == {64}
    assert abs(len(long) - 4 * len(headers)) <= 4 and len(headers) > 50
    assert results.summary["cycle"]["torn_frames"] <= 0.02 * len(headers)
