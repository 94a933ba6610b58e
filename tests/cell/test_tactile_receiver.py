"""The delay contract of tactile frames: never in the cycle of their trigger, and placed when they were sampled."""

import numpy as np
import pytest

from canprobe.cell.tactile import TactileReceiver
from canprobe.protocol.tactile import FrameAssembler, TactileHeader, TactileMode, pack_frame

IDS = [0x511, *range(0x512, 0x51A)]
PERIOD = 2_500_000


def payloads(counter, sync_counter, age_us=5000):
    header = TactileHeader(
        frame_counter=counter,
        sync_counter=sync_counter,
        origin_row=4,
        origin_col=5,
        mode=TactileMode.WINDOW,
        overload=False,
        sample_age_us=age_us,
        crc=0,
    )
    return pack_frame(header, np.full((16, 16), counter, np.uint8))


def make_receiver():
    return TactileReceiver(FrameAssembler(IDS, TactileMode.WINDOW, 2 * PERIOD), IDS, sync_overflow=240)


def push(receiver, frame, t_ns=0):
    for can_id, data in zip(IDS, frame, strict=True):
        receiver.push(can_id, data, t_ns)


def times(cycle):
    return [k * PERIOD for k in range(cycle + 1)]


def test_a_frame_is_not_usable_in_the_cycle_that_triggered_it():
    receiver = make_receiver()
    push(receiver, payloads(1, sync_counter=5))
    assert receiver.take(4, 5, times(4)) is None
    sample = receiver.take(5, 6, times(5))
    assert sample is not None and sample.cycle == 4
    assert sample.t_sample_ns == 4 * PERIOD - 5_000_000
    assert receiver.take(6, 7, times(6)) is None


def test_the_sync_counter_wraps():
    receiver = make_receiver()
    push(receiver, payloads(1, sync_counter=240))
    sample = receiver.take(240, 1, times(240)[-240:])
    assert sample is not None and sample.cycle == 239


def test_sample_times_follow_the_real_syncs_not_the_period():
    receiver = make_receiver()
    push(receiver, payloads(1, sync_counter=3, age_us=0))
    sample = receiver.take(3, 4, [0, PERIOD, 9 * PERIOD, 10 * PERIOD])  # an overrun before SYNC 3
    assert sample is not None and sample.t_sample_ns == 9 * PERIOD


def test_a_frame_older_than_every_known_sync_is_stale():
    receiver = make_receiver()
    push(receiver, payloads(1, sync_counter=200))
    assert receiver.take(2, 3, times(2)) is None
    assert receiver.stale == 1


@pytest.mark.parametrize("lost", range(9))
def test_a_frame_with_a_lost_pdo_is_never_handed_out(lost):
    receiver = make_receiver()
    for i, (can_id, data) in enumerate(zip(IDS, payloads(1, 1), strict=True)):
        if i != lost:
            receiver.push(can_id, data, 0)
    push(receiver, payloads(2, sync_counter=3))
    sample = receiver.take(3, 4, times(3))
    assert sample is not None and sample.frame.header.frame_counter == 2
    assert receiver.assembler.torn + receiver.assembler.orphans > 0
