"""can-utils and tshark as witnesses: what they see on the bus, and what they read in it, is what our logs say."""

from __future__ import annotations

import re
import shutil
import signal
import struct
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import pytest
from patience import patience_s
from slow_scene import write_slow_scene

from canprobe.errors import UsageError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.bus.port import ERR_FLAG
from canprobe.fieldbus.protocol.frame_bits import best_case_bits, worst_case_bits
from canprobe.fieldbus.protocol.frames import EFF_FLAG, RTR_FLAG

pytestmark = pytest.mark.vcan
ON_VCAN0 = ("--bus", "socketcan", "--channel", "vcan0")
NODES = (5, 16)
MARKER = 0x7E6
"""Identifier of the frames by which a test sees that candump listens."""
Frames = list[tuple[int, bytes]]


def tool(name: str) -> str:
    """Where a tool is; without it the test is skipped."""
    path = shutil.which(name)
    if path is None:
        package = "tshark" if name == "tshark" else "can-utils"
        pytest.skip(f"{name} is NOT INSTALLED, so it bears no witness; type:  apt-get install -y {package}")
    return path


def test_the_line_that_makes_a_log_of_a_capture_is_right_as_it_is_typed(tmp_path: Path) -> None:
    tool("tshark")
    frames = [
        (1_002_500_000, "can0", 0x181, b"\x37\x06"),
        (1_500_000_000, "can0", 0x12345 | EFF_FLAG, bytes(8)),
        (1_750_000_000, "can0", 0x701 | RTR_FLAG, b""),
        (2_000_000_000, "can0", 0x201, bytes(12)),
    ]
    capture = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 227)  # pcap, LINKTYPE_CAN_SOCKETCAN
    for t_ns, _, can_id, data in [*frames, (3, "", ERR_FLAG | 4, bytes(8))]:
        packet = struct.pack(">IBB2x", can_id, len(data), 5 if len(data) > 8 else 0) + data
        stamp = (t_ns // 1_000_000_000, t_ns % 1_000_000_000 // 1000)
        capture += struct.pack("<IIII", *stamp, len(packet), len(packet)) + packet
    (tmp_path / "my capture.pcap").write_bytes(capture)
    with pytest.raises(UsageError) as raised:
        list(read_candump(tmp_path / "my capture.pcap"))
    subprocess.run(str(raised.value).rpartition("type: ")[2], shell=True, check=True, cwd=tmp_path)
    assert list(read_candump(tmp_path / "bus.log")) == frames


class Tool:
    """A tool that runs beside the test, its output in a file. A context manager: leaving it interrupts the tool."""

    def __init__(self, path: Path, *words: str) -> None:
        self._path = path
        with path.open("wb") as file:
            self._process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT)

    @property
    def out(self) -> str:
        return self._path.read_text()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(patience_s(20))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class Candump(Tool):
    """candump in its log format; it listens when the constructor returns."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, tool("candump"), "-L", "-r", "10000000", "vcan0")
        while f"{MARKER:03X}#" not in self.out:
            send(f"{MARKER:03X}#")
            time.sleep(0.1)

    @property
    def frames(self) -> Frames:
        return [frame for frame in read_log(self._path) if frame[0] != MARKER]


class Load(Tool):
    """canbusload, one line a second; it counts when the constructor returns."""

    def __init__(self, path: Path, *options: str) -> None:
        super().__init__(path, tool("stdbuf"), "-oL", tool("canbusload"), *options, "vcan0@1000000")
        self.wait_lines(1)

    def wait_lines(self, count: int) -> None:
        """Until it has counted for so many seconds more."""
        wanted = len(self.rows) + count
        while len(self.rows) < wanted:
            time.sleep(0.1)

    @property
    def rows(self) -> list[tuple[int, ...]]:
        """Frames, bits and data bits of each second."""
        found = re.findall(r"vcan0@1000000 +(\d+) +(\d+) +(\d+)", self.out)
        return [tuple(map(int, row)) for row in found]

    @property
    def total(self) -> tuple[int, ...]:
        return tuple(map(sum, zip(*self.rows, strict=True)))


def send(frame: str) -> None:
    """One frame as cansend writes it."""
    subprocess.run([tool("cansend"), "vcan0", frame], check=True)


@pytest.fixture(scope="module")
def emulator(start_shared: Any) -> Any:
    """A drive and a sensor from their EDS files, started once."""
    pairs = ("--eds", "puma260_joint", "--node-id", 5, "--eds", "tactile_array", "--node-id", 16)
    return start_shared("emulate", *pairs, "--channel", "vcan0").until_told("serving nodes")


@pytest.fixture
def served(emulator: Any, bench: Any) -> Iterator[Any]:
    """The two nodes, their heartbeats off so that the bus is silent."""
    for node_id in NODES:
        send(f"{0x600 + node_id:03X}#2B17100000000000")
        done = 0x580 + node_id, bytes.fromhex("6017100000000000")
        bench.bus.until(lambda frame, d=done: frame[:2] == d, emulator)
    bench.bus.hear()
    yield emulator
    assert emulator.running, emulator.err


SCREENS = ("-L", "", "-ta", "-tA", "-td", "-tz", "-ta -x", "-td -a -e")
"""Options of candump; the first prints its log format."""


def test_what_candump_prints_is_read_as_its_log_is(vcan0: str, tmp_path: Path) -> None:
    tools = [Tool(tmp_path / f"{n}", tool("candump"), *words.split(), vcan0) for n, words in enumerate(SCREENS)]
    try:
        time.sleep(patience_s(0.5))  # all of them listen
        for _ in range(3):
            for frame in ("080#", "181#0102030405060708", "12345678#AA", "601#R", "201##1000102030405060708090A0B"):
                send(frame)
        time.sleep(patience_s(0.5))
    finally:
        for one in tools:
            one.__exit__()
    log, *screens = [list(read_candump(tmp_path / f"{n}")) for n in range(len(SCREENS))]
    assert len(log) == 15
    for words, screen in zip(SCREENS[1:], screens, strict=True):
        assert [frame[1:] for frame in screen] == [frame[1:] for frame in log], words
        if words:
            assert [frame[0] - screen[0][0] for frame in screen] == [frame[0] - log[0][0] for frame in log], words


def by_id(frames: Frames) -> dict[int, list[bytes]]:
    found: dict[int, list[bytes]] = {}
    for can_id, data in frames:
        found.setdefault(can_id, []).append(data)
    return found


def read_log(path: Path) -> Frames:
    return [(can_id, data) for _, _, can_id, data in read_candump(path)]


# ---------------------------------------------------------------- a bring-up, seen by candump and read by tshark


@pytest.fixture(scope="module")
def bring_up(start_shared: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Frames, Frames, Path]:
    """Our log of a bring-up with drives and sensor, candump's of the same, and the path of ours."""
    folder = tmp_path_factory.mktemp("witness")
    with Candump(folder / "candump.log") as candump:
        scene = write_slow_scene(folder / "press-slow.toml", "press")
        command = start_shared("run", scene, *ON_VCAN0, "--duration", "0.2", "--out", folder / "results")
        status = command.wait()
        assert status == 0, command.err
    ours = folder / "results" / "bus.log"
    return read_log(ours), candump.frames, ours


@pytest.mark.slow(reason="a bring-up for two tools; the default asks candump with less")
def test_candump_saw_every_frame_that_we_logged(bring_up: tuple[Frames, Frames, Path]) -> None:
    ours, theirs = by_id(bring_up[0]), by_id(bring_up[1])
    assert len(bring_up[0]) > 1000
    assert set(ours) == set(theirs)
    for can_id, frames in ours.items():
        assert theirs[can_id][: len(frames)] == frames, f"{can_id:03X}"
        rest = theirs[can_id][len(frames) :]
        assert all(can_id > 0x700 for _ in rest), f"{can_id:03X}: {len(rest)} frames that only candump saw"


FIELDS = (
    *("can.id", "can.len", "canopen.cob_id", "canopen.function_code", "canopen.node_id"),
    *("canopen.nmt_ctrl.cd", "canopen.nmt_ctrl.node_id", "canopen.nmt_guard.state", "canopen.sync.counter"),
    *("canopen.em.err_code", "canopen.em.err_reg", "canopen.em.err_field", "canopen.pdo.data.bytes"),
    *("canopen.sdo.cmd", "canopen.sdo.main_idx", "canopen.sdo.sub_idx", "canopen.sdo.data.bytes"),
    *("canopen.sdo.abort_code", "canopen.reserved", "_ws.malformed"),
)
LENGTHS = {  # bytes that a field stands for, in the order of the frame
    "canopen.nmt_ctrl.cd": 1,
    "canopen.nmt_ctrl.node_id": 1,
    "canopen.nmt_guard.state": 1,
    "canopen.sync.counter": 1,
    "canopen.em.err_code": 2,
    "canopen.em.err_reg": 1,
    "canopen.em.err_field": 0,
    "canopen.pdo.data.bytes": 0,
    "canopen.sdo.cmd": 1,
    "canopen.sdo.main_idx": 2,
    "canopen.sdo.sub_idx": 1,
    "canopen.sdo.data.bytes": 0,
    "canopen.sdo.abort_code": 4,
    "canopen.reserved": 0,
}


def rebuild(row: dict[str, str]) -> bytes:
    """A frame's data out of what tshark read in it."""
    data = b""
    for field, length in LENGTHS.items():
        if text := row[field]:
            data += int(text, 0).to_bytes(length, "little") if length else bytes.fromhex(text.replace(",", ""))
    return data


@pytest.mark.slow(reason="a bring-up for two tools; the default asks candump with less")
def test_tshark_reads_every_frame_of_the_bring_up_as_we_wrote_it(bring_up: tuple[Frames, Frames, Path]) -> None:
    ours, _, path = bring_up
    words = [tool("tshark"), "-r", str(path), "-d", "can.subdissector,canopen", "-T", "fields", "-E", "separator=/t"]
    done = subprocess.run(
        [*words, *(word for field in FIELDS for word in ("-e", field))], capture_output=True, text=True, check=True
    )
    rows = [dict(zip(FIELDS, line.split("\t"), strict=True)) for line in done.stdout.splitlines()]
    assert len(rows) == len(ours)
    kinds: dict[int, int] = {}
    for row, (can_id, data) in zip(rows, ours, strict=True):
        assert row["_ws.malformed"] == ""
        assert (int(row["can.id"]), int(row["can.len"])) == (can_id, len(data))
        assert (int(row["canopen.function_code"], 0), int(row["canopen.node_id"], 0)) == divmod(can_id, 128)
        assert rebuild(row) == data, f"{can_id:03X}#{data.hex()} {row}"
        kinds[can_id >> 7] = kinds.get(can_id >> 7, 0) + 1
    assert kinds.keys() >= {0, 1, 3, 4, 0xB, 0xC, 0xE}, "NMT, SYNC, PDOs, SDO both ways, heartbeats"


# ---------------------------------------------------------------- can-utils against served nodes


def test_cansend_asks_and_candump_hears_the_answer(served: Any, bench: Any) -> None:
    vendor, product = bytes.fromhex("431810015eca0000"), bytes.fromhex("4318100216160000")
    absent, heartbeat_off = bytes.fromhex("80ff5f0000000206"), bytes.fromhex("4b17100000000000")
    wanted = {0x585: [vendor, absent, heartbeat_off], 0x590: [product]}
    heard: Frames = []

    def complete(frame: tuple[int, bytes, int]) -> bool:
        heard.append(frame[:2])
        return {can_id: by_id(heard).get(can_id) for can_id in wanted} == wanted

    with Candump(bench.folder / "candump.log") as candump:
        bench.bus.hear()
        for request in ("605#4018100100000000", "610#4018100200000000", "605#40FF5F0000000000"):
            send(request)
        send("000#0105")
        send("605#4017100000000000")
        bench.bus.until(complete, served)
    assert candump.frames == heard
    assert 0x185 not in by_id(heard), "TPDO1 of the drive is synchronous, and nobody sends a SYNC"


@pytest.mark.slow(reason="one more tool of can-utils")
def test_canbusload_counts_the_frames_and_bits_that_we_count(served: Any, bench: Any) -> None:
    """Bits for the worst stuffing, as canbusload counts unless it is told to leave stuffing out."""
    with Load(bench.folder / "worst.txt") as worst, Load(bench.folder / "best.txt", "-i") as best:
        subprocess.run([tool("cangen"), "vcan0", "-g", "5", "-n", "150", "-I", "7E5", "-L", "r", "-D", "r"], check=True)
        sizes = [len(data) for can_id, data, _ in bench.bus.hear() if can_id == 0x7E5]
        worst.wait_lines(2)
        best.wait_lines(1)
        assert bench.bus.hear() == [], "a silent bus"
    assert len(sizes) == 150
    assert worst.total == (150, sum(map(worst_case_bits, sizes)), 8 * sum(sizes))
    assert best.total == (150, sum(map(best_case_bits, sizes)), 8 * sum(sizes))


@pytest.mark.slow(reason="one more tool of can-utils")
def test_nodes_survive_what_cangen_throws_at_them(served: Any, bench: Any) -> None:
    """Random identifiers and lengths, NMT commands and broken SDO requests among them."""
    words = [tool("cangen"), "vcan0", "-g", "1", "-n", "1500", "-I", "r", "-L", "r", "-D", "r", "-v"]
    out = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    lines = [line.split()[1].partition("#") for line in out.splitlines()]
    thrown = [(int(can_id, 16), bytes.fromhex(data.replace(".", ""))) for can_id, _, data in lines]
    assert len(thrown) == 1500
    heard = by_id([frame[:2] for frame in bench.bus.hear()])
    for can_id, datas in by_id(thrown).items():
        left = iter(heard[can_id])
        assert all(data in left for data in datas), f"{can_id:03X}: in this order in what we heard"
    for node_id in NODES:
        send(f"000#81{node_id:02X}")
        bench.bus.until(lambda frame, n=node_id: frame[:2] == (0x700 + n, b"\0"), served)
        send(f"{0x600 + node_id:03X}#4018100100000000")
        answer = 0x580 + node_id, bytes.fromhex("431810015eca0000")
        bench.bus.until(lambda frame, a=answer: frame[:2] == a, served)
