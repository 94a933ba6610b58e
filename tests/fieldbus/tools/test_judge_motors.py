"""The judge of masters of motors: every rule finds the master that has its fault, and no other rule does."""

from __future__ import annotations

import random

import pytest

from canprobe.fieldbus.motor.damiao import DamiaoMotor
from canprobe.fieldbus.motor.protocol import (
    REGISTER_ID,
    SPECIAL,
    TYPES,
    MitCommand,
    Mode,
    MotorStatus,
    RegisterOp,
    Rid,
    Special,
    pack_register,
    pack_target,
)
from canprobe.fieldbus.tools.judge import RULES, BusFrame, Judge
from canprobe.fieldbus.tools.judge.seen_motor import SeenMotor

RANGES = TYPES["dm4310"]
CYCLE_NS = 2_500_000


class Master:
    """A good master of motor 1, and the frames of its bus; a bad one is made of its steps."""

    def __init__(self, at: float = 0.3, mst_id: int = 0x11) -> None:
        self.motor, self.t_ns, self.frames = DamiaoMotor("dm4310", 1, mst_id, q=at), 0, list[BusFrame]()

    def send(self, data: bytes, can_id: int = 1, *, heard: bool = True) -> None:
        self.t_ns += CYCLE_NS
        self.frames.append(BusFrame(self.t_ns, can_id, data))
        answers = self.motor.receive(can_id, data, self.t_ns) if heard else []
        self.frames += [BusFrame(self.t_ns + 100_000, *answer) for answer in answers]

    def special(self, which: Special) -> None:
        self.send(SPECIAL + bytes((which,)))

    def read_ranges(self) -> None:
        for rid in (Rid.PMAX, Rid.VMAX, Rid.TMAX):
            self.send(pack_register(1, RegisterOp.READ, rid), REGISTER_ID)

    def set_timeout(self, ticks: int = 300) -> None:
        self.send(pack_register(1, RegisterOp.WRITE, Rid.TIMEOUT, ticks.to_bytes(4, "little")), REGISTER_ID)

    def bring_up(self) -> None:
        self.read_ranges()
        self.set_timeout()
        self.special(Special.DISABLE)
        self.special(Special.ENABLE)

    def command(self, times: int = 20, kp: float = 50.0, *, heard: bool = True) -> None:
        for _ in range(times):
            self.send(MitCommand(self.motor.joint.q, kp=kp, kd=1.0).pack(RANGES), heard=heard)

    def found(self, motor_id: int = 1) -> dict[int, str]:
        motor = SeenMotor(motor_id, int(self.motor.registers[Rid.MST_ID]), RANGES)
        judge = Judge({}, motors=[motor]).hear(self.frames)
        assert sorted(judge.cases) == sorted(rule.number for rule in RULES if rule.group == "motor")
        return {number: case.findings[0].what for number, case in judge.cases.items() if case.count}


def good(master: Master) -> None:
    master.bring_up()
    master.command()
    master.special(Special.DISABLE)


def kicks(master: Master) -> None:
    master.bring_up()
    master.send(MitCommand(0.0, kp=50.0).pack(RANGES))
    master.command()


def never_looks(master: Master) -> None:
    master.set_timeout()
    master.send(SPECIAL + bytes((Special.ENABLE,)), heard=False)
    master.send(MitCommand(0.3, kp=50.0).pack(RANGES))


def drives_hot_motor(master: Master) -> None:
    good(master)
    master.motor.turn(MotorStatus.ROTOR_OVERTEMPERATURE)
    master.command()


def drives_mute_motor(master: Master) -> None:
    good(master)
    master.command(heard=False)


def scales_otherwise(master: Master) -> None:
    master.motor.registers[Rid.VMAX] = 8.0
    good(master)


def dies_unwatched(master: Master) -> None:
    master.read_ranges()
    master.special(Special.DISABLE)
    master.special(Special.ENABLE)
    master.command()


def turns_watchdog_off(master: Master) -> None:
    master.read_ranges()
    master.set_timeout(0)
    master.special(Special.DISABLE)
    master.special(Special.ENABLE)
    master.command()


def polls_by_clearing(master: Master) -> None:
    good(master)
    for _ in range(4):
        master.special(Special.CLEAR)


BAD = [
    (kicks, 49, "0.000 rad with kp 50 at 0.300 rad: 15"),
    (never_looks, 49, "before any position"),
    (drives_hot_motor, 50, "rotor overtemperature"),
    (drives_mute_motor, 51, "without an answer"),
    (scales_otherwise, 52, "VMAX is 8, not 30"),
    (dies_unwatched, 53, "neither read nor written"),
    (turns_watchdog_off, 53, "is 0"),
    (polls_by_clearing, 54, "without a fault"),
]


@pytest.mark.parametrize("mst_id", [0x11, 0])
def test_a_good_master_raises_no_rule(mst_id):
    master = Master(mst_id=mst_id)
    good(master)
    assert master.found() == {}


def test_a_fault_that_is_cleared_and_answered_is_no_fault_of_the_master():
    master = Master()
    good(master)
    master.motor.turn(MotorStatus.UNDERVOLTAGE)
    master.command(2)
    master.special(Special.CLEAR)
    master.bring_up()
    master.command()
    assert master.found() == {}


@pytest.mark.parametrize(("play", "number", "what"), BAD, ids=[play.__name__ for play, *_ in BAD])
def test_a_bad_master_raises_its_rule_alone(play, number, what):
    master = Master()
    play(master)
    found = master.found()
    assert [*found] == [number], found
    assert what in found[number]


def test_every_rule_has_a_bad_master():
    assert {number for _, number, _ in BAD} == {rule.number for rule in RULES if rule.group == "motor"}


def test_other_modes_are_commands_too():
    master = Master()
    good(master)
    for _ in range(9):
        master.send(pack_target(Mode.VEL, 1.0), 0x201, heard=False)
    assert [*master.found()] == [51]


@pytest.mark.parametrize("seed", range(3))
def test_any_frames_are_judged_without_an_error(seed):
    rng, master = random.Random(seed), Master()
    for _ in range(2000):
        can_id = rng.choice((1, 0x11, 0x101, 0x201, 0x301, REGISTER_ID))
        data = rng.choice((SPECIAL + rng.randbytes(1), b"\1\0" + rng.randbytes(rng.randrange(7)), rng.randbytes(8)))
        master.send(data, can_id)
    master.found()
