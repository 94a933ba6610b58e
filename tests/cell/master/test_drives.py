"""The drive group: bytes in, joint angles out; joint targets in, bytes out; late is late."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from puma_arm import MODELS

import canprobe
from canprobe.cell.master.array import TactileReceiver
from canprobe.cell.master.drives import DriveAxis, DriveGroup, SetPointOffer
from canprobe.cell.master.position_track import MIN_REST_COUNTS, REST_NS, PositionTrack, rest_counts
from canprobe.fieldbus.protocol.cia402 import DriveState, OperationMode
from canprobe.fieldbus.protocol.pdo import PdoEntry, PdoLayout
from canprobe.fieldbus.protocol.tactile import FrameAssembler, TactileHeader, TactileMode, pack_whole
from canprobe.mechanics.robot.model import joints_to_units, units_to_joints

STATUS, POSITION, TORQUE = PdoEntry(0x6041, 0, 16), PdoEntry(0x6064, 0, 32, True), PdoEntry(0x6077, 0, 16, True)
WORD, TARGET = PdoEntry(0x6040, 0, 16), PdoEntry(0x607A, 0, 32, True)
MODEL = MODELS["puma260"]
BASE = 8
"""Counts: a milliradian of a joint of the PUMA, about."""
ENABLED = DriveState.OPERATION_ENABLED.value
NAN = float("nan")


def make_group(torque=range(1, 7), target=TARGET, transmission=1, repeat=40, **options):
    axes = []
    for i in range(1, 7):
        feedback = PdoLayout(0x180 + i, (STATUS, POSITION, TORQUE) if i in torque else (STATUS, POSITION))
        axes.append(DriveAxis(i, (feedback,), (PdoLayout(0x200 + i, (WORD, target), transmission),), **options))
    return DriveGroup(tuple(axes), MODEL, repeat)


def hear(group, counts, status=ENABLED, skip=()):
    for i, axis in enumerate(group.axes):
        if i not in skip:
            (feedback,) = axis.feedback
            torque = [-7] * (len(feedback.entries) - 2)
            group.push(feedback.cob_id, feedback.pack(status, round(counts[i]), *torque))


@pytest.mark.parametrize(("torque", "told"), [((1, 4), [-7, NAN, NAN, -7, NAN, NAN]), ((), [])])
def test_a_drive_without_torque_in_its_tpdo_is_heard_like_the_others(torque, told):
    group = make_group(torque=torque)
    group.begin(0)
    hear(group, [10.0] * 6)
    assert group.complete and group.ages() == (0,) * 6
    assert group.torque_permille == pytest.approx(told, nan_ok=True)


def test_a_tpdo_twice_or_after_the_window_is_late_and_not_used():
    group = make_group()
    group.begin(0)
    hear(group, [10.0] * 6)
    hear(group, [99.0] * 6)
    assert group.late == 6
    group.end_collect()
    hear(group, [98.0] * 6)
    assert group.late == 12
    group.begin(1)
    hear(group, [15.0] * 6, skip=(2,))
    group.end_collect()
    assert group.missed == 1
    assert group.ages() == (0, 0, 1, 0, 0, 0)
    counts = joints_to_units(MODEL, group.joints())
    assert counts == pytest.approx([15, 15, 10, 15, 15, 15], abs=1e-6)


def test_a_fault_reset_that_did_not_take_gets_a_new_edge():
    group = make_group()
    words = []
    for cycle in range(4):
        group.begin(cycle)
        hear(group, [0] * 6, status=DriveState.FAULT.value)
        words.append(group.targets.frames()[0][1][0] >> 7)
    assert words == [1, 0, 1, 0]


# Drives of other makes: several PDOs each way, more in them than is needed, interpolated position.


def test_feedback_in_two_tpdos_and_values_that_nobody_reads():
    speed, mode = PdoEntry(0x6081, 0, 32), PdoEntry(0x6061, 0, 8, True)
    axes = [
        DriveAxis(
            i,
            (PdoLayout(0x180 + i, (STATUS, mode)), PdoLayout(0x280 + i, (mode, POSITION, TORQUE))),
            (PdoLayout(0x200 + i, (WORD,)), PdoLayout(0x300 + i, (TARGET, speed))),
            constants={(0x6081, 0): 9},
        )
        for i in range(1, 7)
    ]
    group = DriveGroup(tuple(axes), MODEL)

    def send(k, *values):
        for axis in axes:
            group.push(axis.feedback[k].cob_id, axis.feedback[k].pack(*values))

    group.begin(0)
    send(0, ENABLED, 8)
    assert not group.complete and not group.heard_all and group.targets.frames() == []
    send(1, 8, -55, 7)
    assert group.complete and group.enabled and group.torque_permille == [7] * 6
    assert dict(group.targets.frames())[0x301] == (-55).to_bytes(4, "little", signed=True) + (9).to_bytes(4, "little")
    group.begin(1)
    send(1, 8, -55, 7)
    group.end_collect()
    assert group.missed == 6 and group.ages() == (0,) * 6


def test_what_a_frame_has_beyond_its_mapping_is_not_read():
    group = make_group(torque=())
    group.begin(0)
    group.push(0x181, group.axes[0].feedback[0].pack(ENABLED, 77) + b"\xff\xff")
    assert group.malformed == 0 and group.statuswords[0] == ENABLED
    assert dict(group.targets.frames())[0x201][2:6] == (77).to_bytes(4, "little")
    group.push(0x182, group.axes[1].feedback[0].pack(ENABLED, 77)[:-1])
    assert group.malformed == 1


def test_no_rpdo_goes_to_a_drive_that_was_never_heard():
    """Its target would be 0 and not where it is."""
    group = make_group()
    group.begin(0)
    hear(group, [4000] * 6, skip=(2,))
    assert sorted(can_id for can_id, _ in group.targets.frames()) == [0x201, 0x202, 0x204, 0x205, 0x206]
    group.begin(1)
    hear(group, [4000] * 6)
    frames = dict(group.targets.frames())
    assert len(frames) == 6 and {data[2:] for data in frames.values()} == {(4000).to_bytes(4, "little")}


def test_interpolated_position_sets_bit_4_while_operation_is_enabled():
    record = PdoEntry(0x60C1, 1, 32, True)
    group, words = make_group(torque=(), target=record, mode=OperationMode.INTERPOLATED_POSITION), []
    for cycle, status in enumerate([0x40, 0x21, 0x23, 0x27, 0x27]):
        group.begin(cycle)
        hear(group, [5] * 6, status)
        frame = group.targets.frames()[0][1]
        words.append(int.from_bytes(frame[:2], "little"))
        assert frame[2:] == (5).to_bytes(4, "little")
    assert words == [0x06, 0x07, 0x0F, 0x1F, 0x1F]
    group.targets.goal = DriveState.QUICK_STOP_ACTIVE
    assert int.from_bytes(group.targets.frames()[0][1][:2], "little") == 0x02
    group.targets.goal = DriveState.SWITCH_ON_DISABLED
    assert int.from_bytes(group.targets.frames()[0][1][:2], "little") & 0x10 == 0


# Positions that a motor can and cannot have reached, and where it is when nobody says.

PERIOD = 2_500_000


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans()), min_size=1, max_size=60))
def test_a_set_point_is_taken_whatever_frames_are_lost_and_however_late_it_is_acknowledged(cycles):
    """By CiA 402 a rising bit 4 takes the target, and bit 12 follows some cycles later. In the end nothing is lost."""
    set_point, seen, word, acknowledged, taken = SetPointOffer(), 0, 0, False, []
    for k, (heard, sent, prompt) in enumerate([*cycles, *[(True, True, True)] * 6]):
        target = min(k, len(cycles)) // 3
        bits, told = set_point.step(seen, 0x0F, target)
        if sent:
            if bits & 0x10 and not word & 0x10:
                assert bits & 0x20, "at once"
                taken.append(told)
            word = bits
        acknowledged = bool(word & 0x10) if prompt else acknowledged
        seen = ENABLED | acknowledged << 12 if heard else seen
    assert taken[-1] == target and taken == sorted(set(taken)), "each once, in their order"
    assert set_point.step(ENABLED, 0x0F, target)[0] == 0x0F, "an arm at rest gets no set-points"
    assert set_point.step(0x0007, 0x0F, 99) == (0x0F, 99) and set_point.step(ENABLED, 0x02, 99) == (0x02, 99)


def moving(rate=10, cycles=20, track=None, period_ns=PERIOD):
    track = track or PositionTrack(BASE)
    for k in range(cycles):
        track.aim(abs(rate), 1)
        assert track.take(rate * k, k, k * period_ns, guarded=True) or k == 0
    return track


@pytest.mark.parametrize("period_ns", [1_000_000, 20_000_000])
@pytest.mark.parametrize("rate", [0, 10, -300])
def test_a_steady_motion_is_believed_and_carried_on_for_three_periods_of_time(rate, period_ns):
    """One cycle, some missed TPDOs, and a SYNC that comes many periods late."""
    track = moving(rate, track=PositionTrack(BASE, period_ns), period_ns=period_ns)
    for periods, carried in ((1, 1), (2.5, 2.5), (4, 3), (250, 3)):
        assert track.position(20, round((19 + periods) * period_ns)) == pytest.approx(rate * (19 + carried))


@pytest.mark.parametrize("rate", [10, -10])
@pytest.mark.parametrize(("periods", "followed"), [(1, 1), (2, 2), (20, 20), (34, 20)], ids=str)
def test_a_report_after_a_late_cycle_is_believed_as_far_as_the_drive_can_have_come(rate, periods, followed):
    """It goes on as before for three periods at most, and follows within twenty what its targets asked of it."""
    carried = min(periods, 3)
    most = carried * 10 + BASE + carried * 10 + followed * 10
    for way, believed in (
        (most, True),
        (most + 1, False),
        (-BASE - followed * 10, True),
        (-BASE - followed * 10 - 1, False),
    ):
        track = moving(rate)
        report = rate * 19 + way * (1 if rate > 0 else -1)
        assert track.take(report, 20, (19 + periods) * PERIOD, guarded=True) is believed, way


def test_what_a_target_asked_fades_with_the_time_and_not_with_the_cycles():
    """Twenty periods later an eighth of it counts, whether they are one cycle or twenty."""
    for cycles in (1, 20):
        track = moving(0)
        track.aim(1000, 1)
        for _ in range(cycles):
            track.aim(0, 20 / cycles)
        track.take(0, 20, 40 * PERIOD, guarded=True)
        left = 1000 * 0.9**20
        assert track.take(round(left) + BASE - 1, 21, 41 * PERIOD, guarded=True)
        track.take(0, 22, 42 * PERIOD, guarded=False)
        assert not track.take(round(left) + BASE + 5, 23, 43 * PERIOD, guarded=True)


@pytest.mark.parametrize("turned", [1, -1])
def test_a_drive_that_was_not_heard_while_it_moved_is_believed_when_all_hold(turned):
    """Its way since the last report does not fade, however long nobody hears it: it went there."""
    track = moving(20)
    position = 20 * 19
    for _ in range(20, 24):
        position += turned * 40
        track.aim(40, 1)
    for _ in range(24, 60):
        track.aim(0, 1)
    assert track.take(position, 60, 60 * PERIOD, guarded=True)


def test_the_group_takes_the_time_from_its_syncs():
    group = make_group()
    for cycle in range(20):
        group.begin(cycle, 0, cycle * PERIOD)
        hear(group, [10 * cycle] * 6)
        group.targets.set(units_to_joints(MODEL, np.full(6, 10.0 * (cycle + 1))))
        group.targets.frames()
    group.begin(20, 0, (19 + 34) * PERIOD)
    hear(group, [190] * 6, skip=(2,))
    group.end_collect()
    assert joints_to_units(MODEL, group.joints()) == pytest.approx([190, 190, 220, 190, 190, 190])


def test_a_drive_that_was_missed_while_its_target_moved_is_believed_where_it_went():
    """As far as its targets asked in that time, and no further; a cycle may be late, too."""
    for late, way, believed in ((1, 30, True), (1, 110, False), (7, 90, True), (7, 170, False)):
        group = make_group()
        for cycle in range(22):
            group.begin(cycle, 0, (cycle + (late - 1) * (cycle > 20)) * PERIOD)
            hear(group, [10 * cycle] * 6, skip=(2,) if cycle > 19 else ())
            group.targets.set(units_to_joints(MODEL, np.full(6, 10.0 * (cycle + 1))))
            group.targets.frames()
        group.begin(22, 0, (21 + late) * PERIOD)
        hear(group, [190 + way if i == 2 else 220 for i in range(6)])
        assert (group.ages()[2] == 0) is believed, (late, way)
        assert group.implausible == (not believed) and group.disbelieved is not believed


@pytest.mark.parametrize(
    ("goal", "word"),
    [(DriveState.OPERATION_ENABLED, 0x02), (DriveState.QUICK_STOP_ACTIVE, 0x02), (DriveState.SWITCH_ON_DISABLED, 0x00)],
)
def test_a_drive_in_no_known_state_is_stopped(goal, word):
    group = make_group()
    group.targets.goal = goal
    group.begin(0)
    hear(group, [0] * 6, status=0x0601)
    assert group.states == (None,) * 6 and not any(group.enabled_ones()) and not group.enabled
    assert {int.from_bytes(data[:2], "little") for _, data in group.targets.frames()} == {word}


@pytest.mark.parametrize(("transmission", "sent"), [(240, [6, 6, 6, 6]), (241, [6, 0, 6, 0])])
def test_what_follows_sync_is_sent_in_every_cycle_and_the_rest_on_change_and_again(transmission, sent):
    group, counts = make_group(transmission=transmission, repeat=2), []
    for cycle in range(4):
        group.begin(cycle)
        hear(group, [5] * 6)
        counts.append(len(group.targets.frames()))
    assert counts == sent


def test_a_tpdo_from_before_the_sync_is_late_and_the_times_of_answers_count_from_it():
    group = make_group()

    def hear_at(i, t_ns):
        group.push(0x180 + i, group.axes[i - 1].feedback[0].pack(ENABLED, 0, 0), t_ns)

    group.begin(0, 1000)
    hear_at(1, 1300)
    assert group.answer_ns == 300
    group.begin(1, 5000)
    hear_at(2, 4999)
    assert (group.late, group.ages()[1]) == (1, 2)
    hear_at(2, 5000)
    hear_at(3, 5200)
    hear_at(3, 5700)
    assert (group.late, group.ages()[1]) == (2, 0)
    assert (group.answer_ns, group.lateness_ns[1], group.lateness_ns[2]) == (200, 3999, 700)


def test_drives_that_are_stopped_get_a_quick_stop_at_once_and_the_others_go_on():
    """As in a lift-off, where nothing else changes: neither the goal nor a statusword."""
    group, words = make_group(), []
    for cycle in range(5):
        if cycle == 3:
            group.targets.stopped = frozenset({2, 5})
        if cycle == 4:
            group.targets.goal = DriveState.SWITCH_ON_DISABLED
        group.begin(cycle)
        hear(group, [0] * 6)
        words.append([int.from_bytes(data[:2], "little") for _, data in group.targets.frames()])
    assert group.enabled_ones() == (True,) * 6 and words[:3] == [[0x0F] * 6] * 3
    assert words[3] == [0x0F, 0x02, 0x0F, 0x0F, 0x02, 0x0F]
    assert words[4] == [0x00] * 6, "the way out is for all"


@pytest.mark.parametrize("sign", [1, -1])
def test_a_jump_is_not_believed_and_the_next_right_one_is(sign):
    track = moving(10)
    assert not track.take(200 + sign * 60, 20, 20 * PERIOD, guarded=True)
    assert (track.counts, track.cycle) == (190, 19)
    assert track.take(210, 21, 21 * PERIOD, guarded=True)
    assert track.position(22, 22 * PERIOD) == pytest.approx(220)


def test_before_the_drive_is_enabled_everything_is_believed_but_nothing_at_rest():
    track = PositionTrack(BASE)
    for k in range(6):
        assert track.rested_ns < REST_NS
        track.take(1000, k, k * PERIOD, guarded=False)
    assert track.rested_ns == REST_NS
    assert track.take(5000, 9, 9 * PERIOD, guarded=False)
    assert track.rested_ns == 0
    track.take(1000, 10, 10 * PERIOD, guarded=False)
    assert track.rested_ns == 0


def test_a_milliradian_in_the_counts_of_each_drive():
    milliradians = np.abs(np.diag(MODEL.units_per_q)) / 1000
    assert milliradians.min() < MIN_REST_COUNTS < milliradians.max(), "the PUMA's encoders are coarse at the wrist"
    assert rest_counts(MODEL) == pytest.approx(np.maximum(milliradians, MIN_REST_COUNTS))
    fine = dataclasses.replace(MODEL, units_per_q=100 * MODEL.units_per_q)
    assert rest_counts(fine) == pytest.approx(100 * milliradians)


@pytest.mark.parametrize("sign", [1, -1])
def test_wrong_reports_at_rest_do_not_grow_into_a_motion(sign):
    """Each of them is near to where the one before would lead, and the target asks for nothing of the kind."""
    track = moving(0)
    assert track.take(sign * BASE, 20, 20 * PERIOD, guarded=True), "noise of some counts"
    assert track.position(23, 23 * PERIOD) == sign * BASE
    assert not track.take(sign * 3 * BASE, 21, 21 * PERIOD, guarded=True)
    assert track.take(0, 22, 22 * PERIOD, guarded=True)


# The delay contract of tactile frames: never in the cycle of their trigger, and placed when they were sampled.

IDS = [0x511, *range(0x512, 0x51A)]


def payloads(counter, sync_counter):
    header = TactileHeader(
        frame_counter=counter,
        sync_counter=sync_counter,
        origin_row=4,
        origin_col=5,
        mode=TactileMode.WINDOW,
        overload=False,
        sample_age_us=5000,
        crc=0,
    )
    whole = pack_whole(header, bytes([counter]) * header.window**2)
    return [whole[i : i + 8] for i in range(0, len(whole), 8)]


def make_receiver():
    return TactileReceiver(FrameAssembler(IDS, TactileMode.WINDOW, 2 * PERIOD), IDS, sync_overflow=240)


def push(receiver, frame):
    for can_id, data in zip(IDS, frame, strict=True):
        receiver.push(can_id, data, 0)


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


@pytest.mark.parametrize(
    ("named", "cycle", "counter", "syncs", "sampled"),
    [
        (240, 240, 1, times(240)[-240:], (239, 239 * PERIOD - 5_000_000)),
        (3, 3, 4, [0, PERIOD, 9 * PERIOD, 10 * PERIOD], (2, 9 * PERIOD - 5_000_000)),
        (200, 2, 3, times(2), None),
    ],
    ids=["the counter wraps", "an overrun before SYNC 3", "older than every known SYNC"],
)
def test_a_frame_is_placed_at_the_sync_that_it_names(named, cycle, counter, syncs, sampled):
    receiver = make_receiver()
    push(receiver, payloads(1, sync_counter=named))
    sample = receiver.take(cycle, counter, syncs)
    assert (sample and (sample.cycle, sample.t_sample_ns)) == sampled
    assert receiver.stale == (sampled is None)


# The borders of what a motor can have reached.


def test_at_a_sync_before_the_last_report_a_motor_is_where_it_was_reported():
    """Nothing is carried back: the report is the better word for it."""
    track = moving(10)
    assert [track.position(cycle, cycle * PERIOD) for cycle in (17, 18, 19)] == [190.0] * 3
    assert PositionTrack(BASE).position(5, 5 * PERIOD) == 0.0, "nor is anything carried on before the first report"


def test_a_report_at_the_border_of_rest_is_rest():
    track = PositionTrack(BASE)
    for k, counts in enumerate((0, BASE, -BASE, 0)):
        track.take(counts, k, k * PERIOD, guarded=False)
        assert track.rested_ns == k * PERIOD
    track.take(BASE + 1, 4, 4 * PERIOD, guarded=False)
    assert track.rested_ns == 0


def test_a_slide_rests_within_a_fifth_of_a_millimetre():
    model = canprobe.plan("gantry").setup.arm.model
    assert rest_counts(model) == pytest.approx(np.maximum(2e-4 * np.abs(np.diag(model.units_per_q)), MIN_REST_COUNTS))
    assert max(rest_counts(model)) > MIN_REST_COUNTS
