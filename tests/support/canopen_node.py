"""CANopenNode's demo device, built from its source, on a lockstep bus: examined in its own code, in virtual time.

`python tests/support/canopen_node.py NODE DEMO` prints what `conform` finds, as docs/measure.py wants it; NODE and DEMO
are clones of github.com/CANopenNode/CANopenNode and /CANopenDemo. It needs gcc.
"""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus, Participant
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.protocol.frames import RTR_FLAG, Frame
from canprobe.fieldbus.tools.conform import Examination, ExaminationSettings, WriteList
from canprobe.fieldbus.tools.reports import Verdict

HERE = Path(__file__).parent / "canopen_node"
NODE_ID = 5
TICK_NS = 1_000_000
PERMITTED = "2110h-2122h,6200h-6411h,history"
SOURCES = (
    *(f"301/CO_{name}" for name in ("ODinterface", "NMT_Heartbeat", "HBconsumer", "Emergency", "SDOserver", "TIME")),
    *(f"301/CO_{name}" for name in ("SYNC", "PDO", "Node_Guarding", "fifo")),
    *("301/crc16-ccitt", "303/CO_LEDs", "305/CO_LSSslave", "storage/CO_storage", "CANopen"),
)
OF_DEMO = ("OD", "CO_identificators", "domainDemo", "objectAccessOD")


def build(node: Path, demo: Path, folder: Path) -> Path:
    """Compile the device."""
    program = folder / "device"
    files = [HERE / "device.c", *(node / f"{name}.c" for name in SOURCES)]
    files += [demo / "demo" / f"{name}.c" for name in OF_DEMO]
    folders = [HERE, node, demo / "demo", demo / "demo" / "linux"]
    subprocess.run(["gcc", "-w", *(f"-I{one}" for one in folders), *files, "-lm", "-o", program], check=True)
    return program


class PipedDevice(Participant):
    """The device as a participant: its program gets frames and passed time, and answers with frames."""

    name = "CANopenNode"
    next_deadline_ns: int | None = None

    def __init__(self, program: Path) -> None:
        self.process = subprocess.Popen([program, str(NODE_ID)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._t_ns = 0

    def start(self, t_ns: int) -> Sequence[Frame]:
        self._t_ns, self.next_deadline_ns = t_ns, t_ns + TICK_NS
        return ()

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        ident = can_id & ~RTR_FLAG
        if ident > 0x7FF or len(data) > 8:
            return ()  # its controller takes frames of classical CAN with 11 bits
        before = self._passed(t_ns)
        remote = 0x800 if can_id & RTR_FLAG else 0
        return before + self._answers(b"F" + struct.pack("<IB", ident | remote, len(data)) + data.ljust(8, b"\0"))

    def advance(self, t_ns: int) -> Sequence[Frame]:
        self.next_deadline_ns = t_ns + TICK_NS
        return self._passed(t_ns)

    def _passed(self, t_ns: int) -> list[Frame]:
        passed_us, self._t_ns = (t_ns - self._t_ns) // 1000, t_ns
        return self._answers(b"T" + struct.pack("<I", passed_us))

    def _answers(self, order: bytes) -> list[Frame]:
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(order)
        self.process.stdin.flush()
        frames: list[Frame] = []
        while (kind := self.process.stdout.read(1)) == b"f":
            ident, length = struct.unpack("<IB", self.process.stdout.read(5))
            frames.append((ident, self.process.stdout.read(8)[:length]))
        assert kind == b"E", "the device has ended"
        return frames


def commit_of(folder: Path) -> str:
    return subprocess.run(
        ["git", "-C", folder, "rev-parse", "--short", "HEAD"], check=True, capture_output=True, text=True
    ).stdout.strip()


def main(node: Path, demo: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        device = PipedDevice(build(node, demo, Path(folder)))
        bus = LockstepBus(VirtualClock(), fd=True)
        bus.attach(device)
        description = Description(load_eds(demo / "demo" / "demoDevice.eds", NODE_ID))
        settings = ExaminationSettings(fd=True, written=WriteList.parse(PERMITTED))
        report = Examination(bus.port(), NODE_ID, description, settings).run()
        device.process.kill()
        device.process.communicate()
    bad = (Verdict.FAIL, Verdict.ERROR)
    rows = [[row.clause, f"{row.group} {row.name}", row.detail] for row in report.rows if row.verdict in bad]
    counts = ", ".join(f"{number} {verdict}" for verdict, number in report.counts().items())
    where = f"CANopenNode {commit_of(node)}, CANopenDemo {commit_of(demo)}, --write {PERMITTED}: {counts}"
    verdicts: dict[str, str] = {}
    worst = [Verdict.NOT_APPLICABLE, Verdict.PASS, Verdict.ERROR, Verdict.FAIL]
    for row in report.rows:
        for key in (row.name.split()[0], row.name):
            verdicts[key] = max(row.verdict, verdicts.get(key, Verdict.NOT_APPLICABLE), key=worst.index)
    table = [["clause", "point", "what it does"], *sorted(rows)]
    print(json.dumps({"table": table, "findings": [where], "verdicts": verdicts}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
