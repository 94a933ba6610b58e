"""Rules on masters of motors that do not speak CANopen: what they command, and what they read of the answers."""

from __future__ import annotations

from canprobe.fieldbus.motor.protocol import REGISTERS, MotorStatus, Rid, Special, status_name
from canprobe.fieldbus.tools.judge.rule import Case, Watch, rule
from canprobe.fieldbus.tools.judge.seen_motor import MotorSeen, SeenMotor

_KICK_SHARE = 0.1
"""Share of TMAX by which the first command may pull the joint."""
_COMMANDS = 3
"""Commands in a row after which a master has not noticed."""


@rule(49)
def kick(case: Case, motor: SeenMotor) -> Watch[MotorSeen]:
    """The first command after the motor was enabled pulls its joint elsewhere."""
    fresh = False
    while event := (yield):
        fresh = fresh or event.special is Special.ENABLE
        if not fresh or event.command is None:
            continue
        fresh, command, answer = False, event.command, motor.answer
        at = command.p if answer is None else answer.p
        pull, most = command.kp * abs(command.p - at), _KICK_SHARE * motor.ranges.t
        what = f"first command is {command.p:.3f} rad with kp {command.kp:.0f} at {at:.3f} rad: {pull:.1f} N·m"
        unread = answer is None and command.kp > 0.0
        what = "commanded before any position of it was read" if unread else what
        case.expect(motor, pull <= most and not unread, what, motor.shown, event)


@rule(50, answers=True)
def fault_passed_over(case: Case, motor: SeenMotor) -> Watch[MotorSeen]:
    """Commands go on to a motor whose status is a fault."""
    while event := (yield):
        if not event.drives or motor.answer is None:
            continue
        if case.in_a_row(motor, motor.answer.status >= MotorStatus.OVERVOLTAGE, _COMMANDS):
            case.blame(motor, f"commands go on at {status_name(motor.answer.status)}", motor.shown, event)


@rule(51, answers=True)
def silence_passed_over(case: Case, motor: SeenMotor) -> Watch[MotorSeen]:
    """Commands go on to a motor that does not answer."""
    while event := (yield):
        if event.drives and case.in_a_row(motor, motor.unanswered > _COMMANDS, _COMMANDS):
            case.blame(motor, f"{motor.unanswered} commands without an answer", motor.shown, event)


@rule(52, answers=True)
def other_ranges(case: Case, motor: SeenMotor) -> Watch[MotorSeen]:
    """The motor has said that its ranges are others than those of the type by which its master scales."""
    told = False
    while event := (yield):
        scales = zip((Rid.PMAX, Rid.VMAX, Rid.TMAX), motor.ranges, strict=True)
        known = [(rid, motor.registers[rid], scale) for rid, scale in scales if rid in motor.registers]
        if told or not event.drives or not known:
            continue
        told = True
        wrong = [f"{REGISTERS[rid].name} is {value:g}, not {scale:g}" for rid, value, scale in known if value != scale]
        case.expect(motor, not wrong, "; ".join(wrong), event)


@rule(53)
def no_watchdog(case: Case, motor: SeenMotor) -> Watch[MotorSeen]:
    """The motor is enabled without a TIMEOUT: it goes on with the last command when the master dies."""
    while event := (yield):
        if event.special is Special.ENABLE:
            value = motor.registers.get(Rid.TIMEOUT)
            what = "neither read nor written" if value is None else "0"
            case.expect(motor, bool(value), f"enabled while register 9, TIMEOUT, is {what}", event)


@rule(54)
def clears_while_polling(case: Case, motor: SeenMotor) -> Watch[MotorSeen]:
    """Faults are cleared again and again, whether there is one or not."""
    while event := (yield):
        fault = motor.answer is not None and motor.answer.status >= MotorStatus.OVERVOLTAGE
        if event.special is Special.CLEAR and case.in_a_row(motor, not fault, _COMMANDS):
            case.blame(motor, f"cleared {_COMMANDS} times without a fault", event)
