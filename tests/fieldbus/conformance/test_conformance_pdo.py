"""Points 30 and 37: PDOs at work, by raw frames. Source: CiA 301, "Process data object".

Every rule of their parameters: tests/fieldbus/node/test_pdo_engine.py.
"""

from __future__ import annotations

import pytest
from conformance_bench import ON_BOTH_BUSES

INITIAL = "04030201feff"


def syncs(bench, *counters):
    """SYNCs one by one; whether each caused TPDO 185h. An SDO behind each tells that it has been served."""
    seen = []
    for counter in counters:
        bench.send(0x80, "" if counter is None else f"{counter:02x}")
        bench.send(0x605, "4000100000000000")
        ids = []
        while (can_id := bench.next().can_id) != 0x585:
            ids.append(can_id)
        seen.append(ids)
    return seen


@pytest.mark.parametrize(("kind", "first"), [(252, INITIAL), (253, "aa000000feff")])
def test_cia301_pdo_30_types_252_and_253_are_sent_on_request_252_as_sampled_by_sync(tiny, kind, first):
    tiny.set((0x1800, 2, kind, 1))
    tiny.nmt(0x01)
    assert syncs(tiny, None) == [[]]
    tiny.set((0x2001, 0, 0xAA, 4))
    for told in (first, "aa000000feff"):
        tiny.send(0x40000185)
        tiny.expect((0x185, told))
        assert syncs(tiny, None) == [[]]


def test_cia301_pdo_30_no_request_where_bit_30_forbids_it(tiny):
    tiny.set((0x1800, 1, 0x40000185, 4), (0x1800, 2, 253, 1))
    tiny.nmt(0x01)
    tiny.send(0x40000185)
    tiny.read(0x1000)


@pytest.mark.parametrize(
    ("start", "every", "counters", "expected"),
    [(5, 2, range(2, 11), [5, 7, 9]), (4, 3, range(2, 11), [4, 7, 10]), (1, 2, [9, 10, 1, 2, 3, 5, 6], [1, 3, 5])],
)
@ON_BOTH_BUSES
def test_cia301_pdo_37_sync_start_value(tiny, start, every, counters, expected):
    tiny.configure(0x1800, cob_id=0x185, words=[0x20010020], type=every, start=start)
    tiny.set((0x1019, 0, 10, 1))
    tiny.nmt(0x01)
    heard = [counter for counter, ids in zip(counters, syncs(tiny, *counters), strict=True) if ids]
    assert heard == expected  # in the last row SYNC 4 is lost: the phase is kept
