"""The SDO server against canopen's own client: an implementation that knows nothing of ours."""

from __future__ import annotations

import canopen
import pytest
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo import SdoClient


class _Loop(canopen.Network):
    """Feeds the slave and gives its answers to the client, at once."""

    def __init__(self, node):
        super().__init__()
        self.node = node

    def send_message(self, can_id, data, remote=False):
        for answer_id, answer in self.node.receive(can_id, bytes(data), 0):
            self.notify(answer_id, bytearray(answer), 0.0)


@pytest.fixture
def client(bench):
    network = _Loop(bench.node)
    made = SdoClient(0x605, 0x585, ObjectDictionary())
    made.RESPONSE_TIMEOUT = 0.01
    made.network = network
    network.subscribe(0x585, made.on_response)
    return made


@pytest.mark.parametrize("block", [False, True], ids=["segmented", "block"])
@pytest.mark.parametrize("size", [1, 4, 5, 7, 8, 14, 888, 889, 890, 5000])
def test_writes_and_reads_back(client, block, size):
    sent = bytes(i * 7 % 256 for i in range(size))
    with client.open(0x2004, 0, "wb", size=size, block_transfer=block) as file:
        file.write(sent)
    with client.open(0x2004, 0, "rb", block_transfer=block) as file:
        assert file.read() == sent


@pytest.mark.parametrize("force_segment", [False, True])
def test_writes_a_number_expedited_and_segmented(client, bench, force_segment):
    client.download(0x2001, 0, b"\x0d\xf0\xad\x0b", force_segment=force_segment)
    assert bench.node.dictionary.values[0x200100] == 0x0BADF00D
