"""Points 8, 9, 44, 45 and 89: heartbeat and guarding. Source: CiA 301, "Error control protocols"."""

from __future__ import annotations

from canprobe.fieldbus.protocol.emcy import HEARTBEAT_LOST_CODE
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE, RTR_FLAG, NmtState
from canprobe.fieldbus.tools.conform import accepted
from canprobe.fieldbus.tools.conform.bench import Bench
from canprobe.fieldbus.tools.conform.outcome import Deviation, PointNotApplicable
from canprobe.fieldbus.tools.conform.point import PointGroup

point = PointGroup("heartbeat", "CiA 301")
_PERIOD_MS, _CONSUMED_MS, _GUARD_MS, _LIFE_FACTOR = 50, 200, 100, 2
_SHARE = 0.1
"""Share by which a period of the device may be off."""
_PRODUCED = 20
"""Heartbeats of a mean: so many that what one may be late, `slack_s`, hides no wrong period."""


def _consumer(bench: Bench, period_ms: int = _CONSUMED_MS) -> int:
    """Let 1016h:01 watch an id that nobody has; return the id. The other entries are cleared."""
    bench.need((0x1016, 1))
    producer = next(n for n in range(126, 0, -1) if n != bench.node_id and n not in bench.permits.surroundings.others)
    for subindex in range(1, bench.device.number(0x1016) + 1):
        if bench.device.number(0x1016, subindex):
            bench.put(0x1016, subindex, 0)
    bench.put(0x1016, 1, producer << 16 | period_ms)
    return producer


def _beat(bench: Bench, producer: int) -> int:
    return bench.send(HEARTBEAT_BASE + producer, bytes((NmtState.OPERATIONAL,)))


@point(8, "producer", "1017h", "a write acts at once: the period is kept within 10 %, 0 is silence")
def producer(bench: Bench) -> None:
    """Heartbeats every 50 ms for a second, then none."""
    bench.need((0x1017, 0))
    bench.put(0x1017, 0, _PERIOD_MS)
    period_s = _PERIOD_MS * 1e-3
    listen_s = (1 + _SHARE) * (_PRODUCED + 1) * period_s + bench.times.slack_s
    frames = bench.during(listen_s, bench.beat_id)
    bench.expect(len(frames) >= _PRODUCED, f"{len(frames)} heartbeats in {listen_s:.2f} s, 1017h is {_PERIOD_MS} ms")
    mean_s = (frames[-1].t_ns - frames[0].t_ns) * 1e-9 / (len(frames) - 1)
    if abs(mean_s - period_s) > _SHARE * period_s + bench.times.slack_s / len(frames):
        bench.deviates(f"the heartbeat comes every {mean_s * 1e3:.1f} ms, expected {_PERIOD_MS} ms")
    bench.put(0x1017, 0, 0)
    bench.pass_time(bench.times.slack_s)
    bench.expect(not bench.during(3 * period_s, bench.beat_id), "heartbeats come although 1017h is 0")


def _need_guarding(bench: Bench) -> None:
    """Check that the device has guarding, and switch its heartbeat off."""
    bench.need((0x100C, 0), (0x100D, 0))
    if bench.device.writable(0x1017):
        bench.put(0x1017, 0, 0)
    elif bench.device.number(0x1017):
        bench.does_not_apply("the heartbeat cannot be switched off, and excludes guarding")


@point(9, "guarding", "node guarding", "the state, with a bit that toggles, from 0 on", needs="nmt")
def guarding(bench: Bench) -> None:
    """Remote requests: the state of each answer, and its toggle bit."""
    try:
        bench.reset()  # the toggle bit begins anew
    except Deviation as error:
        raise PointNotApplicable("the device does not boot when it is told to, which is point 1") from error
    _need_guarding(bench)
    answers = []
    for state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL, NmtState.STOPPED, NmtState.PRE_OPERATIONAL):
        bench.settle(state)
        answers.append(bench.guarded())
    if answers != (wanted := [0x7F, 0x85, 0x04, 0xFF]):
        got = ", ".join("none" if one is None else f"{one:02X}h" for one in answers)
        bench.deviates(f"guarding answers {got}; expected {', '.join(f'{one:02X}h' for one in wanted)}")


@point(9, "life guarding", "life guarding, 100Ch 100Dh", "EMCY 8130h when requests stop", needs="nmt")
def life_guarding(bench: Bench) -> None:
    """Two requests, then none for the life time."""
    _need_guarding(bench)
    bench.require(bench.guarded() is not None, "the device does not answer guarding")
    bench.put(0x100C, 0, _GUARD_MS)
    bench.put(0x100D, 0, _LIFE_FACTOR)
    bench.nmt(0x01)
    for _ in range(2):
        bench.expect(bench.guarded() is not None, "guarding is not answered while life guarding runs")
    bench.emcy(HEARTBEAT_LOST_CODE, _GUARD_MS * _LIFE_FACTOR * 1e-3)
    bench.put(0x100D, 0, 0)


@point(89, "before guarding", "error control", "with 1017h set the heartbeat comes, not guarding")
def heartbeat_wins(bench: Bench) -> None:
    """Guard and life time are set beside the heartbeat: heartbeats come, and no request starts life guarding."""
    bench.need((0x100C, 0), (0x100D, 0), (0x1017, 0))
    bench.put(0x1017, 0, _PERIOD_MS)
    bench.put(0x100C, 0, _GUARD_MS)
    bench.put(0x100D, 0, 1)
    bench.taken(bench.beat_id)
    bench.send(bench.beat_id | RTR_FLAG)
    bench.pass_time(3 * _GUARD_MS * 1e-3)
    frames = bench.taken(bench.beat_id)
    bench.expect(len(frames) >= 3, "no heartbeat comes while guarding is configured, too")
    if any(len(frame.data) != 1 or frame.data[0] & 0x80 for frame in frames):
        bench.deviates("a heartbeat has the toggle bit of guarding")


@point(
    44,
    "consumer",
    "1016h",
    "watched from the first heartbeat on: silence in time, EMCY 8130h when it is late",
    needs="nmt",
)
def consumer(bench: Bench) -> None:
    """A producer that begins, goes on, and stops."""
    producer = _consumer(bench)
    bench.nmt(0x01)
    period_s = _CONSUMED_MS * 1e-3
    bench.pass_time(1.5 * period_s)
    bench.expect(not bench.errors(), "EMCY before the first heartbeat of the producer")
    last_ns = 0
    for _ in range(4):
        last_ns = _beat(bench, producer)
        bench.pass_time(0.5 * period_s)
    bench.expect(not bench.errors(), "EMCY although the heartbeats come in time")
    _, t_ns = bench.emcy(HEARTBEAT_LOST_CODE, period_s)
    if (t_ns - last_ns) * 1e-9 < (1 - _SHARE) * period_s - bench.times.slack_s:
        bench.deviates(f"EMCY 8130h after {(t_ns - last_ns) * 1e-6:.0f} ms, the consumer time is {_CONSUMED_MS} ms")
    bench.nmt(0x80)
    bench.put(0x1016, 1, 0)


@point(44, "duplicate consumer", "1016h", accepted.DUPLICATE)
def duplicate_consumer(bench: Bench) -> None:
    """Two entries for one producer."""
    bench.need((0x1016, 2))
    producer = _consumer(bench)
    bench.must_refuse_write(0x1016, 2, producer << 16 | 500, accepted.DUPLICATE, "a second entry for one producer")


@point(45, "error behaviour", "1029h:01", "after the loss 0: pre-operational, 1: no change, 2: stopped", needs="nmt")
def error_behaviour(bench: Bench) -> None:
    """The loss of a producer in operational, with each behaviour that the device takes."""
    bench.need((0x1029, 1), (0x1016, 1))
    goals = {0: NmtState.PRE_OPERATIONAL, 1: NmtState.OPERATIONAL, 2: NmtState.STOPPED}
    for behaviour, goal in goals.items():
        bench.nmt(0x80)
        bench.watch_state()
        if not bench.takes(0x1029, 1, behaviour):
            bench.notes.append(f"1029h:01 does not take {behaviour}")
            continue
        producer = _consumer(bench, _CONSUMED_MS // 2)
        bench.go(NmtState.OPERATIONAL)
        _beat(bench, producer)
        bench.emcy(HEARTBEAT_LOST_CODE, _CONSUMED_MS * 1e-3)
        if (state := bench.state()) != goal:
            bench.deviates(f"state {state:02X}h after the loss with 1029h:01 = {behaviour}, expected {goal:02X}h")
    bench.nmt(0x80)
    bench.put(0x1016, 1, 0)
