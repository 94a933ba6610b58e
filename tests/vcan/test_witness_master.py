"""An unmodified canopen-python, with its own threads, drives nodes that `canprobe emulate --eds` serves."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import canopen
import pytest

from canprobe.fieldbus.eds.packaged import eds_path, load_eds

pytestmark = pytest.mark.vcan
MESSY = Path(__file__).parents[1] / "fieldbus" / "eds" / "messy"
PACKAGED, VENDORS, DATA = 5, 20, 30
PERIOD_S = 0.05
BLOCK = bytes(random.Random(402).randbytes(3001))


@pytest.fixture(scope="module")
def served(start_shared: Any) -> Any:
    """Our own drive, a vendor's drive and a vendor's other device; the last test of the module ends them."""
    files = ("puma260_joint", PACKAGED), (MESSY / "drive402.eds", VENDORS), (MESSY / "types.eds", DATA)
    pairs = [word for path, node_id in files for word in ("--eds", path, "--node-id", node_id)]
    return start_shared("emulate", *pairs, "--channel", "vcan0").until_told("serving nodes 5, 20, 30 on vcan0")


@pytest.fixture
def network(vcan0: str) -> Iterator[canopen.Network]:
    network = canopen.Network()
    network.connect(interface="socketcan", channel=vcan0)
    yield network
    network.disconnect()


def dictionary(node_id: int) -> Any:
    """As canopen itself reads it, or, where it cannot, as we read it."""
    return str(eds_path("puma260_joint")) if node_id == PACKAGED else load_eds(MESSY / "drive402.eds", node_id)


@pytest.mark.parametrize("node_id", [PACKAGED, VENDORS])
def test_base_node_402_drives_a_motion(served: Any, bench: Any, network: Any, node_id: int) -> None:
    node: Any = canopen.BaseNode402(node_id, dictionary(node_id))
    network.add_node(node)
    node.sdo.RESPONSE_TIMEOUT = 2.0
    node.nmt.state = "PRE-OPERATIONAL"
    node.sdo[0x60C2][1].raw, node.sdo[0x60C2][2].raw = round(PERIOD_S * 1e3), -3
    node.setup_402_state_machine()
    node.op_mode = "CYCLIC SYNCHRONOUS POSITION"
    assert node.sdo[0x6061].raw == 8
    bench.bus.hear()
    try:
        node.nmt.state = "OPERATIONAL"
        network.sync.start(PERIOD_S)
        node.rpdo[1].start(PERIOD_S)
        node.state = "OPERATION ENABLED"
        targets = [round(40_000 * (3 * s**2 - 2 * s**3)) for s in (n / 12 for n in range(13))]
        for target in [*targets, 40_000, 40_000, 40_000]:
            node.rpdo_pointers[0x607A].raw = target
            assert node.tpdo[1].wait_for_reception(1.0) is not None
        assert node.state == "OPERATION ENABLED"
        assert node.tpdo_pointers[0x6064].raw == 40_000 == node.sdo[0x6064].raw
        node.state = "SWITCHED ON"
        node.state = "SWITCH ON DISABLED"
        assert node.sdo[0x6041].raw & 0x4F == 0x40
    finally:
        node.rpdo[1].stop()
        network.sync.stop()
        node.nmt.state = "PRE-OPERATIONAL"
    assert node.emcy.log == []
    check_motion(bench.bus.hear(), node_id)
    assert served.running


def check_motion(frames: list[tuple[int, bytes, int]], node_id: int) -> None:
    """By the frames alone: what was received before a SYNC is latched there and reached one period later."""
    target, latched, enabled, seen = 0, [0, 0, 0], False, []
    for can_id, data, _ in frames:
        if can_id == 0x80:
            latched = [target if enabled else latched[0], *latched[:2]]
        elif can_id == 0x200 + node_id:
            target = int.from_bytes(data[2:6], "little", signed=True)
        elif can_id == 0x180 + node_id:
            position = int.from_bytes(data[2:6], "little", signed=True)
            assert min(latched) <= position <= max(latched), "between the targets of the last SYNCs"
            enabled = int.from_bytes(data[:2], "little") & 0x6F == 0x27
            seen.append(position)
    assert seen == sorted(seen) and seen[0] == 0 and seen[-1] == 40_000
    assert len(set(seen)) > 8, "in steps, not in one jump"


def test_sdo_block_and_segmented_transfers(served: Any, network: Any) -> None:
    node: Any = network.add_node(DATA, canopen.ObjectDictionary())
    node.sdo.RESPONSE_TIMEOUT = 2.0
    with node.sdo.open(0x200D, 0, "wb", buffering=1024, size=len(BLOCK), block_transfer=True) as file:
        file.write(BLOCK)
    with node.sdo.open(0x200D, 0, "rb", buffering=1024, block_transfer=True) as file:
        assert file.read() == BLOCK
    assert node.sdo.upload(0x200D, 0) == BLOCK, "segmented"
    node.sdo.download(0x200D, 0, BLOCK[:100])
    assert node.sdo.upload(0x200D, 0) == BLOCK[:100]
    with pytest.raises(canopen.SdoAbortedError) as caught:
        node.sdo.upload(0x2004, 0)
    assert caught.value.code == 0x06010001, "write-only in the vendor's file"


def test_the_vendors_name_is_served_as_written(served: Any, network: Any) -> None:
    node: Any = network.add_node(VENDORS, canopen.ObjectDictionary())
    node.sdo.RESPONSE_TIMEOUT = 2.0
    assert node.sdo.upload(0x1008, 0).decode("latin-1") == "Servoverstärker"


def test_serving_ends_with_an_interrupt_and_has_told_the_warnings(served: Any) -> None:
    served.send(2)
    *warnings, line = served.end(0)
    assert [row.partition(": ")[2].partition(";")[0] for row in warnings] == ["7 warnings", "4 warnings"]
    assert line == "serving nodes 5, 20, 30 on vcan0; Ctrl-C stops them"
