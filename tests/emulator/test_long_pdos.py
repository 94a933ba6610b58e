"""A TPDO of more than 64 bits: only where the device has them, and only when they were switched on."""

import pytest

from canprobe.eds import LONG_PDOS, load_eds
from canprobe.emulator.aborts import Abort, SdoAbort
from canprobe.emulator.dictionary import Dictionary
from canprobe.emulator.entries import key_of
from canprobe.emulator.pdo_rules import PdoRules


@pytest.mark.parametrize(("eds", "switch", "fits"), [
    ("tactile_array_fd", 1, True), ("tactile_array_fd", 0, False), ("tactile_array", 1, False),
])  # fmt: skip
def test_mapping_of_512_bits(eds, switch, fits):
    dictionary = Dictionary(load_eds(eds, 16))
    dictionary.put(LONG_PDOS, 0, switch)
    rules = PdoRules(dictionary, 0x1801, 0x1A01, True)
    count = 8 if eds.endswith("fd") else 4
    for subindex in range(1, count + 1):
        dictionary.values[key_of(0x1A01, subindex)] = 0x21000040 | subindex << 8
    if fits:
        assert len(rules.entries(8)) == 8
        return
    with pytest.raises(SdoAbort) as refused:
        rules.entries(2)
    assert refused.value.code == Abort.MAPPING_LENGTH
